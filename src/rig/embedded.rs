//! Rigs that come with the program: ordinary rig files, read by the ordinary parser.

/// Name and text of every embedded rig.
pub const EMBEDDED: [(&str, &str); 6] = [
    ("nine-dof", include_str!("../../launch/rigs/nine-dof.toml")),
    ("nine-dof-case-2", include_str!("../../launch/rigs/nine-dof-case-2.toml")),
    ("nine-dof-3+2", include_str!("../../launch/rigs/nine-dof-3+2.toml")),
    ("nine-dof-4+2", include_str!("../../launch/rigs/nine-dof-4+2.toml")),
    ("nine-dof-case-2-3+2", include_str!("../../launch/rigs/nine-dof-case-2-3+2.toml")),
    ("nine-dof-case-2-4+2", include_str!("../../launch/rigs/nine-dof-case-2-4+2.toml")),
];

/// The text of the embedded rig of that name.
pub fn text(name: &str) -> Option<&'static str> {
    EMBEDDED.iter().find(|(embedded, _)| *embedded == name).map(|(_, text)| *text)
}
