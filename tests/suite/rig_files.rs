//! Invalid rig files and files they refer to: each fault has an error that names file, field,
//! value and limit; and no bytes at all that make a reader panic.

use std::io::{Cursor, Write};

use crate::program::{npz_bytes, rig_file as file};
use npyz::zip::write::FileOptions;
use proptest::prelude::*;
use squealcast::physics::{Law, OperatingPoint};
use squealcast::rig::{Rig, RigError, RigFile, matrix_market, npz, scale};

/// One mode at some nodes.
fn side(nodes: &[f64]) -> Vec<u8> {
    let count = nodes.len() as u64 / 3;
    npz_bytes(&[("omega_rad_s", &[1], &[100.0]), ("phi", &[count, 3, 1], nodes), ("nodes_m", &[count, 3], nodes)])
}

const PAD: &[f64] = &[0.105, 0.002, 0.01, 0.11, 0.003, 0.01];
const DISC: &[f64] = &[0.1, 0.0, 0.01, 0.12, 0.0, 0.01, 0.1, 0.01, 0.01, 0.12, 0.01, 0.01];

const INLINE: &str = r#"name = "x"
[pad]
mass = [[1.0, 0.0], [0.0, 1.0]]
stiffness = [[1.5, 0.75], [0.75, 0.5]]
[[contact]]
pad_normal = [0.0, -1.0]
pad_sliding = [1.0, 0.0]
stiffness_n_per_m = 1.0
"#;

const MODAL: &str = r#"name = "x"
[pad]
modal = "pad.npz"
[disc]
modal = "disc.npz"
[[contact_patch]]
axis_point_m = [0.0, 0.0, 0.0]
axis_direction = [0.0, 0.0, 1.0]
normal = [0.0, 0.0, 1.0]
stiffness_n_per_m = 1e5
"#;

const SYSTEM: &str = r#"name = "x"
[system]
mass = "M.mtx"
[[system.stiffness]]
matrix = "K.mtx"
scale = "friction_coefficient / 0.3 + 1"
"#;

const UNIT: &str = "%%MatrixMarket matrix coordinate real general\n2 2 2\n1 1 1\n2 2 1\n";

fn refused(files: &[RigFile]) -> (RigError, String) {
    let error = Rig::from_files(files).map(|_| ()).unwrap_err();
    let refused = error.to_string();
    (error, refused)
}

fn inline(from: &str, to: &str) -> (RigError, String) {
    assert!(INLINE.contains(from), "{from}");
    refused(&[file("x.toml", INLINE.replace(from, to))])
}

fn modal(from: &str, to: &str, pad: &[u8]) -> (RigError, String) {
    assert!(MODAL.contains(from), "{from}");
    refused(&[file("x.toml", MODAL.replace(from, to)), file("pad.npz", pad), file("disc.npz", side(DISC))])
}

fn system(from: &str, to: &str, mass: &str, stiffness: &str) -> (RigError, String) {
    assert!(SYSTEM.contains(from), "{from}");
    refused(&[file("x.toml", SYSTEM.replace(from, to)), file("M.mtx", mass), file("K.mtx", stiffness)])
}

macro_rules! refused {
    ($found:expr, $pattern:pat, $text:expr) => {{
        let (error, refused) = $found;
        assert!(matches!(error, $pattern), "{error:?}");
        assert_eq!(refused, $text);
    }};
}

#[test]
fn a_rig_file_says_its_format() {
    Rig::from_files(&[file("x.toml", format!("format = 1\n{INLINE}"))]).unwrap();
    // Keys of a later format are unknown here: the format is what is wrong.
    for (format, rest) in [(2, "colour = 3\n"), (0, ""), (-1, "")] {
        refused!(
            refused(&[file("x.toml", format!("format = {format}\n{rest}{INLINE}"))]),
            RigError::Format { limit: 1, .. },
            format!("x.toml: `format` is {format}, expected 1, the format that this version of squealcast reads")
        );
    }
    let (error, text) = inline("name =", "format = \"1\"\nname =");
    assert!(matches!(error, RigError::Syntax { line: 1, .. }), "{text}");
}

#[test]
fn bad_files_of_kind_1() {
    Rig::from_files(&[file("x.toml", INLINE)]).unwrap();
    let missing = Rig::load("nowhere/rig.toml").map(|_| ()).unwrap_err().to_string();
    assert!(missing.starts_with("nowhere/rig.toml: neither a readable rig file (No such file"), "{missing}");
    assert!(missing.contains("nine-dof, nine-dof-case-2,"), "{missing}");
    let (error, text) = inline("[pad]", "[pad]\ncolour = 3");
    assert!(matches!(error, RigError::UnknownKey { line: 3, .. }), "{error:?}");
    assert!(text.starts_with("x.toml, line 3: unknown key `colour`; expected one of `mass`, `stiffness`"), "{text}");
    refused!(
        inline("[0.0, 1.0]]", "[0.0]]"),
        RigError::Shape { .. },
        "x.toml: `pad.mass[1]` has shape 1 values, expected 2, as many as rows"
    );
    refused!(
        inline("pad_normal = [0.0, -1.0]", "pad_normal = [0.0]"),
        RigError::Shape { .. },
        "x.toml: `contact[0].pad_normal` has shape 1 values, expected one for each of 2 degrees of freedom"
    );
    refused!(
        inline("0.75], [", "nan], ["),
        RigError::NotFinite { .. },
        "x.toml: `pad.stiffness[0][1]` is NaN, expected a finite number"
    );
    refused!(
        inline("[[1.0, 0.0], [0.0, 1.0]]", "[[1.0, 0.5], [0.25, 1.0]]"),
        RigError::Reduction { .. },
        "x.toml: pad.mass is not symmetric: entry (1, 0) is 0.25, entry (0, 1) is 0.5; they may differ by 1.000e-12"
    );
    refused!(
        inline("[[1.0, 0.0], [0.0, 1.0]]", "[[1.0, 2.0], [2.0, 1.0]]"),
        RigError::Reduction { .. },
        "x.toml: pad.mass is not positive definite: its pivot at row 1 is -3.000000e0, expected more than 0.000e0"
    );
    refused!(
        inline("stiffness_n_per_m = 1.0", "stiffness_n_per_m = -1.0"),
        RigError::Range { .. },
        "x.toml: `contact[0].stiffness_n_per_m` is -1, expected at least 0"
    );
    refused!(
        inline("[pad]", "[pad]\nmodes = 3"),
        RigError::Reduction { .. },
        "x.toml: pad.modes: 3 modes requested, expected 1 to 2"
    );
    refused!(
        inline("[pad]", "[pad]\ndamping_ratio = [0.1]"),
        RigError::Shape { .. },
        "x.toml: `pad.damping_ratio` has shape 1, expected one value or one for each of 2 modes"
    );
    refused!(
        inline("pad_sliding", "disc_normal = [1.0]\npad_sliding"),
        RigError::Kind { .. },
        "x.toml: `contact[0].disc_normal` is given for a rigid disc; expected [disc], or no row for it"
    );
    refused!(
        inline("name = \"x\"", "name = \"x\"\n[system]\nmass = \"M.mtx\""),
        RigError::Kind { .. },
        "x.toml: `pad` cannot be combined with [system]; expected either [system] or [pad] with its contact"
    );
    refused!(
        inline("name = \"x\"", "name = \"x\"\n[band]\nmax_hz = -1"),
        RigError::Range { .. },
        "x.toml: `band.max_hz` is -1, expected more than 0"
    );
    refused!(
        inline("name = \"x\"", "name = \"x\"\n[limits]\nnormal_load_n = [2.0, 1.0]"),
        RigError::Range { .. },
        "x.toml: `limits.normal_load_n[1]` is 1, expected at least limits.normal_load_n[0] = 2"
    );
    refused!(
        inline("name = \"x\"\n", ""),
        RigError::MissingKey { .. },
        "x.toml: `name` is missing; expected it in the table of line 1"
    );
    refused!(
        inline("name = \"x\"", "name = \"x\"\n[friction]\nlateral_damping = true"),
        RigError::Model { .. },
        "x.toml: contact pair 0: radius_m is 0, expected more than 0 for lateral damping and for friction that falls \
         with speed"
    );
}

/// The keys of the Stribeck law; a law of drop 0 is none, so the model is the same to the last bit.
#[test]
fn friction_that_falls_is_checked() {
    let with = |friction: &str| {
        let radius = INLINE.replacen("[[contact]]\n", "[[contact]]\nradius_m = 0.1\n", 1);
        assert_ne!(radius, INLINE);
        [file("x.toml", radius.replacen("name = \"x\"", &format!("name = \"x\"\n[friction]\n{friction}"), 1))]
    };
    refused!(
        refused(&with("stribeck_drop = 0.1")),
        RigError::MissingKey { .. },
        "x.toml: `friction.stribeck_speed_m_s` is missing; expected the sliding speed, m/s, over which friction falls by \
         stribeck_drop = 0.1"
    );
    refused!(
        refused(&with("stribeck_drop = 0.1\nstribeck_speed_m_s = 0.0")),
        RigError::Range { .. },
        "x.toml: `friction.stribeck_speed_m_s` is 0, expected more than 0"
    );
    refused!(
        refused(&with("stribeck_drop = 0.1\nstribeck_speed_m_s = 0.5\nstribeck_exponent = 0.9")),
        RigError::Range { .. },
        "x.toml: `friction.stribeck_exponent` is 0.9, expected 1 to 10"
    );
    let falls = Rig::from_files(&with("stribeck_drop = 0.1\nstribeck_speed_m_s = 1.3")).unwrap();
    // By hand: -2 · 0.1 / 1.3 · e^-1 at the reference speed of 13 rad/s.
    let line = "friction   falls with the sliding speed v by 0.1 (1 - exp(-(v / 1.3 m/s)^2)): slope -5.660e-2 to -5.660e-2 \
                s/m at 13 rad/s";
    assert!(falls.describe().contains(line), "{}", falls.describe());
    assert_eq!(falls.model.depends_on_load_and_speed(), (true, true));
    let none = Rig::from_files(&with("stribeck_drop = 0.0\nstribeck_speed_m_s = 1.3")).unwrap();
    assert_eq!(none.model.depends_on_load_and_speed(), (false, false));
}

#[test]
fn bad_files_of_kind_2() {
    let all = |pad: Vec<u8>| [file("x.toml", MODAL), file("pad.npz", pad), file("disc.npz", side(DISC))];
    Rig::from_files(&all(side(PAD))).unwrap();
    refused!(
        refused(&all(side(PAD))[..2]),
        RigError::MissingFile { .. },
        "x.toml: disc.modal = \"disc.npz\" cannot be read: it is not among the files of the rig; expected one of pad.npz"
    );
    let (error, text) = modal("normal =", "norm = [0, 0, 1]\nnormal =", &side(PAD));
    assert!(matches!(error, RigError::UnknownKey { .. }) && text.contains("unknown key `norm`"), "{text}");
    let with = |omega: f64, phi: &[f64], shape: &[u64]| {
        npz_bytes(&[("omega_rad_s", &[1], &[omega]), ("phi", shape, phi), ("nodes_m", &[1, 3], &[0.1, 0.0, 0.01])])
    };
    let zero = [0.0; 6];
    refused!(
        modal("normal =", "normal =", &with(1.0, &zero, &[1, 3, 2])),
        RigError::Npz { .. },
        "pad.npz: array `phi` has shape (1, 3, 2); expected (1, 3, 1), by nodes_m and omega_rad_s"
    );
    refused!(
        modal("normal =", "normal =", &npz_bytes(&[("omega_rad_s", &[1], &[1.0]), ("nodes_m", &[1, 3], &zero[..3])])),
        RigError::Npz { .. },
        "pad.npz: array `phi` is missing; expected an array of shape (c, 3, i)"
    );
    refused!(
        modal("normal =", "normal =", &with(1.0, &[0.0, f64::NAN, 0.0], &[1, 3, 1])),
        RigError::NotFinite { .. },
        "pad.npz: `phi[0, 1, 0]` is NaN, expected a finite number"
    );
    refused!(
        modal("normal =", "normal =", &with(-1.0, &zero[..3], &[1, 3, 1])),
        RigError::Npz { .. },
        "pad.npz: array `omega_rad_s[0]` is -1; expected at least 0"
    );
    refused!(
        modal("normal =", "normal =", &side(&[0.1, 0.0, 0.01, 0.3, 0.0, 0.01])),
        RigError::NoPartner { node: 1, .. },
        "x.toml: `contact_patch[0]`: pad node 1 at (0.3, 0, 0.01) m finds no partner on the disc: \
         it lies 1.800000e-1 m outside the surface, expected at most 1.000000e-2 m (search_distance_m)"
    );
    refused!(
        modal("normal =", "normal =", &side(&[0.0, 0.0, 0.01])),
        RigError::NoTriad { node: 0, .. },
        "x.toml: `contact_patch[0]`: pad node 0 at (0, 0, 0.01) m has no sliding direction: \
         it lies on the axis, expected a node off the axis"
    );
    refused!(
        modal("\nnormal = [0.0, 0.0, 1.0]", "\nnormal = [0.0, 0.0, 0.0]", &side(PAD)),
        RigError::Range { .. },
        "x.toml: `contact_patch[0].normal` is [0, 0, 0], expected a direction"
    );
    // The direction of a rim brake: the disc's axis is [0, 0, 1].
    refused!(
        modal("\nnormal = [0.0, 0.0, 1.0]", "\nnormal = [1.0, 0.0, 0.1]", &side(PAD)),
        RigError::Range { .. },
        "x.toml: `contact_patch[0].normal` is [1.0, 0.0, 0.1], 84 degrees off the axis, expected at most 60 degrees: \
         the pad presses along the axis of the disc"
    );
    refused!(
        modal("normal =", "pad_nodes = [0, 2]\nnormal =", &side(PAD)),
        RigError::Range { .. },
        "x.toml: `contact_patch[0].pad_nodes[1]` is 2, expected 0 to 1"
    );
    refused!(
        modal("[disc]", "mass = [[1.0]]\n[disc]", &side(PAD)),
        RigError::Kind { .. },
        "x.toml: `pad.modal` cannot be combined with mass and stiffness; \
         expected mass and stiffness on both sides, or modal on both sides"
    );
}

#[test]
fn bad_files_of_kind_3() {
    Rig::from_files(&[file("x.toml", SYSTEM), file("M.mtx", UNIT), file("K.mtx", UNIT)]).unwrap();
    refused!(
        refused(&[file("x.toml", SYSTEM), file("M.mtx", UNIT)]),
        RigError::MissingFile { .. },
        "x.toml: system.stiffness[0].matrix = \"K.mtx\" cannot be read: it is not among the files of the rig; \
         expected one of M.mtx"
    );
    let (error, text) = system("scale", "skale", UNIT, UNIT);
    assert!(matches!(error, RigError::UnknownKey { .. }), "{text}");
    assert!(text.ends_with("unknown key `skale`; expected `matrix` or `scale`"), "{text}");
    refused!(
        system("x", "x", UNIT, "%%MatrixMarket matrix array real general\n1 1\n3\n"),
        RigError::Shape { .. },
        "x.toml: `system.stiffness[0].matrix` has shape 1x1 (K.mtx), expected 2x2, as system.mass"
    );
    refused!(
        system("x", "x", UNIT, &UNIT.replace("1 1 1", "1 1 nan")),
        RigError::Line { line: 3, .. },
        "K.mtx, line 3: value is `nan`; expected a finite number"
    );
    // A header that claims a great many rows allocates no memory.
    let (error, _) =
        system("x", "x", "%%MatrixMarket matrix coordinate real general\n99999999999999 99999999999999 0", UNIT);
    assert!(matches!(error, RigError::Shape { .. }));
    let unsymmetric = "%%MatrixMarket matrix array real general\n2 2\n1\n0.5\n0.25\n1\n";
    let indefinite = "%%MatrixMarket matrix array real general\n2 2\n1\n2\n2\n1\n";
    for modes in ["mass = \"M.mtx\"", "mass = \"M.mtx\"\nmodes = 1"] {
        let (error, text) = system("mass = \"M.mtx\"", modes, unsymmetric, UNIT);
        assert!(matches!(error, RigError::Reduction { .. }));
        assert!(text.starts_with("x.toml (M.mtx): system.mass is not symmetric: entry (1, 0) is 0.5, "), "{text}");
        assert!(text.ends_with("they may differ by 1.000e-12"), "{text}");
        let (error, text) = system("mass = \"M.mtx\"", modes, indefinite, UNIT);
        assert!(matches!(error, RigError::Reduction { .. }));
        assert!(text.starts_with("x.toml (M.mtx): system.mass is not positive definite: its pivot at row "), "{text}");
        assert!(text.contains("is -3.000000e0, expected more than "), "{text}");
    }
    refused!(
        system("friction_coefficient", "mu", UNIT, UNIT),
        RigError::Scale { .. },
        "x.toml: `system.stiffness[0].scale` = \"mu / 0.3 + 1\": unknown name `mu`; \
         expected disc_speed_rad_s, friction_coefficient, normal_load_n"
    );
    refused!(
        system("/ 0.3", "/ (disc_speed_rad_s - 13)", UNIT, UNIT),
        RigError::Scale { .. },
        "x.toml: `system.stiffness[0].scale` = \"friction_coefficient / (disc_speed_rad_s - 13) + 1\": is inf at the \
         reference point (500 N, 13 rad/s, friction coefficient 0.35); expected a finite number"
    );
}

/// Changes, inserts, removes or cuts off bytes of a valid file.
fn mutate(valid: &[u8], changes: &[(usize, u8, u8)]) -> Vec<u8> {
    let mut bytes = valid.to_vec();
    for &(at, byte, how) in changes {
        let at = at % bytes.len().max(1);
        match how {
            1 => bytes.insert(at, byte),
            2 if at < bytes.len() => drop(bytes.remove(at)),
            3 => bytes.truncate(at.max(bytes.len() / 2)),
            _ if at < bytes.len() => bytes[at] = byte,
            _ => {}
        }
    }
    bytes
}

fn changes() -> impl Strategy<Value = Vec<(usize, u8, u8)>> {
    prop::collection::vec((any::<usize>(), any::<u8>(), prop_oneof![9 => 0_u8..3, 1 => 3_u8..4]), 1..6)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300), text in "[ -~\n]{0,200}") {
        let _ = matrix_market::read("a", &bytes);
        let _ = npz::read("a", &bytes);
        let _ = Rig::from_files(&[file("a.toml", bytes)]);
        let _ = matrix_market::read("a", text.as_bytes());
        let _ = scale::parse(&text);
        let _ = Rig::from_files(&[file("a.toml", text)]);
    }

    #[test]
    fn random_scales_never_panic(
        text in "([0-9.e+*/^() -]|disc_speed_rad_s|normal_load_n|friction_coefficient){0,30}"
    ) {
        if let Ok(Law::Custom(law)) = scale::parse(&text) {
            (law.evaluate)(&OperatingPoint { normal_load_n: 1.0, disc_speed_rad_s: 2.0, friction_coefficient: 3.0 });
        }
    }

    #[test]
    fn mutated_rig_files_never_panic(changes in changes()) {
        let _ = Rig::from_files(&[file("x.toml", mutate(INLINE.as_bytes(), &changes))]);
        let system = mutate(SYSTEM.as_bytes(), &changes);
        let _ = Rig::from_files(&[file("x.toml", system), file("M.mtx", UNIT), file("K.mtx", UNIT)]);
        let modal = mutate(MODAL.as_bytes(), &changes);
        let _ = Rig::from_files(&[file("x.toml", modal), file("pad.npz", side(PAD)), file("disc.npz", side(DISC))]);
    }

    #[test]
    fn mutated_matrices_never_panic(changes in changes()) {
        let mutated = mutate(UNIT.as_bytes(), &changes);
        let _ = Rig::from_files(&[file("x.toml", SYSTEM), file("M.mtx", mutated.clone()), file("K.mtx", UNIT)]);
        let _ = Rig::from_files(&[file("x.toml", SYSTEM), file("M.mtx", UNIT), file("K.mtx", mutated)]);
    }

    /// An archive's checksum hides most mutations from the arrays in it, so these are mutated before they are packed.
    #[test]
    fn mutated_arrays_never_panic(changes in changes(), which in 0_usize..3, numbers in any::<[u64; 3]>()) {
        let header = |shape: &str| format!("{{'descr': '<f8', 'fortran_order': True, 'shape': ({shape}), }}");
        let array = |shape: &str, values: &[f64]| {
            let header = header(shape);
            let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
            bytes.extend((header.len() as u16).to_le_bytes());
            bytes.extend(header.as_bytes());
            bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            bytes
        };
        let lying = array(&format!("{}, {}, {}", numbers[0], numbers[1], numbers[2]), PAD);
        let good = [array("1,", &[1.0]), array("2, 3, 1", PAD), array("2, 3", PAD)];
        for lies in [false, true] {
            let mut bytes = Cursor::new(vec![]);
            let mut archive = npyz::npz::NpzWriter::new(&mut bytes);
            for (index, (name, array)) in ["omega_rad_s", "phi", "nodes_m"].iter().zip(&good).enumerate() {
                let zip = archive.zip_writer();
                zip.start_file(format!("{name}.npy"), FileOptions::default()).unwrap();
                let array = match (index == which, lies) {
                    (true, true) => lying.clone(),
                    (true, false) => mutate(array, &changes),
                    _ => array.clone(),
                };
                zip.write_all(&array).unwrap();
            }
            archive.zip_writer().finish().unwrap();
            drop(archive);
            let _ = npz::read("a", &bytes.into_inner());
        }
    }

    #[test]
    fn mutated_archives_never_panic(changes in changes()) {
        let pad = mutate(&side(PAD), &changes);
        let _ = Rig::from_files(&[file("x.toml", MODAL), file("pad.npz", pad), file("disc.npz", side(DISC))]);
    }
}
