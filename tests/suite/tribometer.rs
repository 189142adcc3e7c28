//! The reference tribometer as files: sizes agree, the contact nodes of pad and disc coincide, matrices are symmetric
//! and positive on the diagonal.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::program::{self, Running, command, files_below, python, run, text, tribometer, until};
use squealcast::full_model::FullModelFile;
use squealcast::rig::Rig;

/// Rows of a CSV file below its header.
fn rows(text: &str) -> Vec<Vec<&str>> {
    text.lines().skip(1).map(|line| line.split(',').collect()).collect()
}

#[test]
fn its_files_agree_with_each_other() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("rig");
    tribometer(&folder, 5000);
    let file = |name: &str| fs::read_to_string(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
    let full: toml::Table = file("tribometer.toml").parse().unwrap();
    let (mut sizes, mut contact, mut node_count) = (vec![], vec![], 0);
    for part in ["pad", "disc"] {
        let (nodes_csv, rows_csv) = (file(&format!("{part}-nodes.csv")), file(&format!("{part}-rows.csv")));
        let (nodes, degrees) = (rows(&nodes_csv), rows(&rows_csv));
        node_count += nodes.len();
        sizes.push(degrees.len());
        for what in ["mass", "stiffness"] {
            let matrix = file(full[part][what].as_str().unwrap());
            let mut lines = matrix.lines();
            assert_eq!(lines.next(), Some("%%MatrixMarket matrix coordinate real symmetric"), "{part} {what}");
            let mut lines = lines.filter(|line| !line.starts_with('%'));
            let size = format!("{} {} ", degrees.len(), degrees.len());
            let entries = lines.next().unwrap().strip_prefix(&size).expect("as many rows as listed").parse().unwrap();
            let (mut found, mut on_diagonal) = (0usize, 0);
            for line in lines {
                let values: Vec<&str> = line.split_whitespace().collect();
                let value: f64 = values[2].parse().unwrap();
                found += 1;
                if values[0] == values[1] {
                    on_diagonal += 1;
                    assert!(value > 0.0, "{part} {what}: {line}");
                }
            }
            assert_eq!((found, on_diagonal), (entries, degrees.len()), "{part} {what}");
        }
        let of_patch = full[part]["interface_nodes"].as_array().unwrap();
        let place = |node: &toml::Value| {
            let node = &nodes[usize::try_from(node.as_integer().unwrap()).unwrap()];
            node.iter().map(|x| x.parse::<f64>().unwrap()).collect::<Vec<_>>()
        };
        contact.push(of_patch.iter().map(place).collect::<Vec<_>>());
    }
    assert!(sizes.iter().sum::<usize>() >= 5000, "{sizes:?}");
    // The paper's 14 by 21 pairs. Coordinates are millimetres with few decimals, the same arithmetic on both sides.
    assert_eq!((contact[0].len(), contact[1].len()), (294, 294));
    for place in &contact[0] {
        let nearest = contact[1]
            .iter()
            .map(|other| place.iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
            .fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-12, "{place:?} is {nearest:e} m off its partner");
    }
    let mesh = fs::read(folder.join("tribometer.vtk")).unwrap();
    let points = format!("POINTS {node_count} double");
    assert!(mesh.windows(points.len()).any(|window| window == points.as_bytes()));
    for part in ["pad.inp", "disc.inp"] {
        assert!(file(part).contains("C3D8I"), "{part}");
    }
    run(["tribometer", "--dof", "10", "-o", &text(&folder)]).exits(2).complains("5000");
}

/// By meshio 5.3.5: the nodes of the tables to the last bit, bricks of positive volume, ten components.
#[test]
fn another_program_reads_the_mesh() {
    let python = python();
    if !program::python_has(&python, "meshio") {
        return;
    }
    let temp = tempfile::tempdir().unwrap();
    tribometer(temp.path(), 5000);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/read_mesh.py");
    let output = Command::new(&python).arg(script).arg(temp.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said = String::from_utf8_lossy(&output.stdout);
    eprint!("read by {said}");
    assert!(said.contains(" 10 components"), "{said}");
}

/// An interruption leaves no file that is not whole, and no `tribometer.toml`, which comes last.
#[test]
fn an_interruption_leaves_no_half_file() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("rig");
    let is_part = |path: &std::path::PathBuf| path.extension().is_some_and(|extension| extension == "part");
    let begun = || folder.is_dir() && files_below(&folder).iter().any(is_part);
    let writing = Running::start(command(["tribometer", "--dof", "200000", "-o", &text(&folder)]));
    until("a file that is being written", begun);
    writing.signal("INT").exits(130).complains("stopped");
    assert!(!begun() && !folder.join("tribometer.toml").exists(), "{:?}", files_below(&folder));
}

/// The embedded rigs are what `reduce` makes of the full model that `squealcast tribometer` writes today, and say how far they are
/// from it; one held-out point of the smaller one is solved again.
#[test]
fn the_embedded_rigs_stand_for_the_default_tribometer() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("full");
    run(["tribometer", "-o", &text(&folder)]).exits(0);
    let path = folder.join("tribometer.toml");
    let full = FullModelFile::load(&path).unwrap();
    assert_eq!(full.model.dimension(), 22_032);
    // 60 vectors within 1e-4 % and 0.05 %; 80+80 within 0.005 % and 0.5 %.
    for (name, most, frequency, critical) in [("tribometer", 60, 1e-6, 5e-4), ("tribometer-80+80", 160, 5e-5, 5e-3)] {
        let rig = Rig::load(name).unwrap();
        let known = rig.reduction.clone().expect("a certificate");
        assert_eq!(known.full_model_hash, full.content_hash, "{name}");
        assert!(rig.model.dimension() <= most, "{name}: {}", rig.model.dimension());
        assert!(known.points >= 3 && known.missed == 0 && known.invented == 0, "{known:?}");
        assert!(known.max_frequency_error < frequency, "{known:?}");
        assert!(known.critical_friction_error.is_some_and(|error| error < critical), "{known:?}");
        run(["check", name])
            .exits(0)
            .says("294 pairs")
            .says("held-out points up to 4000 Hz")
            .says("0 unstable modes or windows missed");
    }
    let args = ["verify", "tribometer", "--against", &text(&path), "--points", "1", "--seed", "7", "--no-windows"];
    run(args.into_iter().chain(["--tolerance", "1e-6"])).exits(0);
}

/// The contact of the rig with a lining follows the load: at a friction coefficient of 0.19 it squeals at 500 N, and not at 200 N
/// or 1000 N. The contact force is the load in the full model as in the embedded rig, which is what `reduce` makes of the full
/// model that the program writes today.
#[test]
fn the_load_on_a_lining_decides_whether_it_squeals() {
    let temp = tempfile::tempdir().unwrap();
    let folder = text(&temp.path().join("lining"));
    run(["tribometer", "--lining", "--dof", "5000", "-o", &folder]).exits(0);
    let full = run(["full", &format!("{folder}/tribometer.toml"), "--mu", "0.3", "--load", "500", "--band-hz", "1500"]);
    let full = full.exits(0).stdout;
    assert!(full.contains("294 of 294 pairs closed, contact force 500.000 N"), "{full}");
    let whole = text(&temp.path().join("whole"));
    run(["tribometer", "--lining", "-o", &whole]).exits(0);
    let hash = FullModelFile::load(&Path::new(&whole).join("tribometer.toml")).unwrap().content_hash;
    let known = Rig::load("tribometer-lining").unwrap().reduction.expect("it was compared with its full model");
    assert_eq!((known.missed, known.invented, known.full_model_hash), (0, 0, hash));
    let squeals = |load: &str| {
        let found = run(["predict", "tribometer-lining", "--load", load, "--mu", "0.19", "--json"]).exits(0).stdout;
        let found: serde_json::Value = serde_json::from_str(&found).unwrap();
        let force = found["contact"]["contact_force_n"].as_f64().unwrap();
        assert!((force / load.parse::<f64>().unwrap() - 1.0).abs() < 1e-9, "{force} N at {load} N");
        found["max_growth_rate_per_s"].as_f64().unwrap() > 1.0
    };
    assert_eq!(["200", "500", "1000"].map(squeals), [false, true, false]);
}

/// A basis over load and friction coefficient holds its tolerance at points that `reduce` did not see, also where the pad is near
/// divergence (from 0.495 at 2000 N) or beyond. The law is a power law rounded over 2 µm.
#[test]
fn a_basis_over_contact_states_holds_its_tolerance_near_divergence() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("tribometer");
    run(["tribometer", "--lining", "--dof", "5000", "-o", &text(&folder)]).exits(0);
    let path = folder.join("tribometer.toml");
    let mut full: toml::Table = toml::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    let state = full["contact_state"].as_table_mut().unwrap();
    for key in ["pressure_pa", "area_m2"] {
        state.remove(key).unwrap();
    }
    state["law"] = "power".into();
    for (key, value) in [("exponent", 2.0), ("reference_m", 5e-6), ("roughness_m", 2e-6)] {
        state.insert(key.to_owned(), value.into());
    }
    full["contact_patch"][0]["stiffness_n_per_m"] = 1e5.into();
    std::fs::write(&path, toml::to_string(&full).unwrap()).unwrap();
    let (full, rig) = (text(&path), text(&temp.path().join("rig.toml")));
    let range = "mu=0:0.6,load=50:2000,speed=13";
    run(["reduce", &full, "--range", range, "--points", "0", "-o", &rig]).exits(0);
    assert!(Rig::load(&rig).unwrap().model.dimension() <= 60);
    run(["verify", &rig, "--against", &full, "--points", "24", "--no-windows", "--tolerance", "1e-6"])
        .exits(0)
        .says("the same pairs closed");
}
