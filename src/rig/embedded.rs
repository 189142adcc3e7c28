//! Rigs embedded in the program: ordinary rig files, read by the ordinary parser.

use super::RigFile;

/// An embedded rig.
#[derive(Clone, Copy, Debug)]
pub struct Embedded {
    pub name: &'static str,
    /// A description in one line.
    pub about: &'static str,
    /// The text of the rig file.
    text: &'static str,
    /// Name and content of each file the rig file refers to.
    attached: &'static [(&'static str, &'static [u8])],
}

/// Embeds a rig file of `launch/rigs` and the files it refers to.
macro_rules! embedded {
    ($name:literal, $about:literal $(, $attached:literal)*) => {
        Embedded {
            name: $name,
            about: $about,
            text: include_str!(concat!("../../launch/rigs/", $name, ".toml")),
            attached: &[$(($attached, include_bytes!(concat!("../../launch/rigs/", $attached)))),*],
        }
    };
}

/// All embedded rigs. The first is the default of `run` and `demo`. A static: of a constant, the program would hold a copy of
/// all files for each use.
pub static EMBEDDED: [Embedded; 10] = [
    embedded!(
        "tribometer",
        "pad-on-disc tribometer of 22032 degrees of freedom on a basis of 55 vectors (default)",
        "tribometer-pad-565599e19c40.npz",
        "tribometer-disc-545e876cea94.npz"
    ),
    embedded!(
        "tribometer-80+80",
        "the same tribometer on 80 modes of the pad and 80 of the disc, with residual flexibility",
        "tribometer-80+80-pad-a17eb7113e19.npz",
        "tribometer-80+80-disc-694d2050be74.npz",
        "tribometer-80+80-residual-c3ebf5556a34.npz"
    ),
    embedded!(
        "tribometer-lining",
        "the same tribometer on 40 modes of each part, with a lining whose stiffness follows the load",
        "tribometer-lining-pad-e276271e8232.npz",
        "tribometer-lining-disc-11354b9969ed.npz",
        "tribometer-lining-residual-a70ab997edd5.npz"
    ),
    embedded!(
        "rough-pad",
        "a friction pad of 3 degrees of freedom on rough contact: the load decides whether it squeals"
    ),
    embedded!("nine-dof", "the paper's nine-degree-of-freedom model, case 1"),
    embedded!("nine-dof-case-2", "the paper's nine-degree-of-freedom model, case 2"),
    embedded!("nine-dof-3+2", "case 1 reduced to 3 modes of the pad and 2 of the disc"),
    embedded!("nine-dof-4+2", "case 1 reduced to 4 modes of the pad and 2 of the disc"),
    embedded!("nine-dof-case-2-3+2", "case 2 reduced to 3 modes of the pad and 2 of the disc"),
    embedded!("nine-dof-case-2-4+2", "case 2 reduced to 4 modes of the pad and 2 of the disc"),
];

impl Embedded {
    /// The embedded rig of that name.
    pub fn named(name: &str) -> Option<Self> {
        EMBEDDED.into_iter().find(|embedded| embedded.name == name)
    }

    /// The names of all embedded rigs, separated by commas, for messages.
    pub fn names() -> String {
        EMBEDDED.map(|embedded| embedded.name).join(", ")
    }

    /// The rig file, then the files it refers to.
    pub fn files(&self) -> Vec<RigFile> {
        let file = |name: &str, bytes: &[u8]| RigFile { name: name.to_owned(), bytes: bytes.to_vec() };
        let rig_file = file(&format!("{}.toml", self.name), self.text.as_bytes());
        std::iter::once(rig_file).chain(self.attached.iter().map(|(name, bytes)| file(name, bytes))).collect()
    }
}
