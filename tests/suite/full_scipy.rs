//! Full models written by numpy and scipy, with rotation, structural damping and contact states: `full`, `reduce` and
//! `verify` against dense eigenvalues of the same matrices (`tests/peers/scipy_full.py`).

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use faer::c64;
use serde_json::Value;
use squealcast::physics::{OperatingPoint, Solver, Vectors};
use squealcast::rig::Rig;

use crate::program::{self, json, number, python, run, text};

/// The promise. Both programs have backward errors of 1e-13 of these matrices, and no two roots merge.
const TOLERANCE: f64 = 1e-9;
/// Largest difference of a contact force, relative to the largest. Both programs solve the statics to rounding, times the
/// condition of the flexibility between the pairs, below 1e3.
const FORCES: f64 = 1e-11;
/// Models with a contact state.
const STATES: [&str; 3] = ["opening", "crowned", "rough"];

/// Writes the models and returns what scipy found, once for all tests; `None` without scipy.
fn expected() -> Option<&'static Value> {
    static EXPECTED: OnceLock<Option<Value>> = OnceLock::new();
    let made = || {
        let python = python();
        if !program::python_has(&python, "numpy, scipy") {
            return None;
        }
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/scipy_full.py");
        std::fs::create_dir_all(folder()).expect("a folder of the test");
        let output = Command::new(&python).arg(script).arg(folder()).output().expect("Python starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let expected: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        eprintln!("scipy {}", expected["scipy"]);
        Some(expected)
    };
    EXPECTED.get_or_init(made).as_ref()
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("scipy-full")
}

/// Load, speed and friction coefficient of a case as arguments.
fn conditions(case: &Value) -> Vec<String> {
    [("--load", "normal_load_n"), ("--speed", "disc_speed_rad_s"), ("--mu", "friction_coefficient")]
        .into_iter()
        .flat_map(|(option, key)| [option.to_owned(), number(case, key).to_string()])
        .collect()
}

fn point(case: &Value) -> OperatingPoint {
    OperatingPoint {
        normal_load_n: number(case, "normal_load_n"),
        disc_speed_rad_s: number(case, "disc_speed_rad_s"),
        friction_coefficient: number(case, "friction_coefficient"),
    }
}

fn root(growth: f64, omega: f64) -> c64 {
    c64::new(growth, omega)
}

/// All roots of a case with `ω > 0`.
fn of_scipy(case: &Value) -> Vec<c64> {
    let roots = case["roots"].as_array().unwrap();
    roots.iter().map(|value| root(value[0].as_f64().unwrap(), value[1].as_f64().unwrap())).collect()
}

/// Largest difference of the contact forces of a case, relative to the largest; `found` has those of the same pairs. 0 for a
/// case without a contact state.
fn forces_off(case: &Value, found: &[f64]) -> f64 {
    let Some(expected) = case["force_n"].as_array() else { return 0.0 };
    assert_eq!(expected.len(), found.len());
    let expected: Vec<f64> = expected.iter().map(|force| force.as_f64().unwrap()).collect();
    let largest = expected.iter().copied().fold(0.0, f64::max);
    for (pair, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert_eq!(*found > 0.0, *expected > 0.0, "pair {pair}: {found} N, {expected} N");
    }
    found.iter().zip(&expected).map(|(found, expected)| (found - expected).abs() / largest).fold(0.0, f64::max)
}

/// Largest `|Δλ|/|λ|` between each of `roots` and the nearest of `among`.
fn off(roots: &[c64], among: &[c64]) -> f64 {
    let nearest =
        |lambda: &c64| among.iter().map(|other| (other - lambda).norm() / lambda.norm()).fold(f64::INFINITY, f64::min);
    roots.iter().map(nearest).fold(0.0, f64::max)
}

#[test]
fn full_models_have_the_roots_that_scipy_finds() {
    let Some(expected) = expected() else { return };
    let (mut worst, mut forces, mut open) = (0.0_f64, 0.0_f64, 0);
    for (name, model) in expected["models"].as_object().unwrap() {
        let (file, band_hz) = (model["file"].as_str().unwrap(), number(model, "band_hz"));
        for case in model["cases"].as_array().unwrap() {
            let mut args = vec!["full".to_owned(), file.to_owned(), "--json".to_owned()];
            args.extend(conditions(case));
            let found = json(args);
            assert_eq!(found["contact"].is_object(), STATES.contains(&name.as_str()));
            if let Some(of_pairs) = found["contact"]["force_n"].as_array() {
                let of_pairs: Vec<f64> = of_pairs.iter().map(|force| force.as_f64().unwrap()).collect();
                open += of_pairs.iter().filter(|force| **force == 0.0).count();
                let off = forces_off(case, &of_pairs);
                assert!(off < FORCES, "{name} at {}: forces off by {off:.1e}", conditions(case).join(" "));
                forces = forces.max(off);
            }
            // Every root of the band that decays or grows less than what the search covered, and no other.
            let within = |lambda: &c64, share: f64| {
                lambda.im < share * TAU * band_hz && lambda.re.abs() < share * number(&found, "covered_growth_per_s")
            };
            let roots = found["roots"].as_array().unwrap().iter();
            let roots: Vec<c64> =
                roots.map(|value| root(number(value, "growth_rate_per_s"), number(value, "omega_rad_s"))).collect();
            let of_scipy = of_scipy(case);
            let counted: Vec<c64> = of_scipy.iter().copied().filter(|lambda| within(lambda, 0.999)).collect();
            assert!(counted.len() > 40, "{name}: {} roots", counted.len());
            let (missed, invented) = (off(&counted, &roots), off(&roots, &of_scipy));
            worst = worst.max(missed).max(invented);
            let told = conditions(case).join(" ");
            assert!(missed < TOLERANCE && invented < TOLERANCE, "{name} at {told}: {missed:.1e}, {invented:.1e}");
        }
    }
    eprintln!("roots off by {worst:.1e} at most, contact forces by {forces:.1e}; {open} pairs open");
    assert!(open > 10, "{open} pairs are open");
}

/// Without a state of steady sliding there is no spectrum, and the reason is given. A pad that only the contact holds takes
/// the whole load, to rounding.
#[test]
fn full_models_say_why_there_is_no_contact_state() {
    let Some(expected) = expected() else { return };
    let crowned = expected["models"]["crowned"]["file"].as_str().unwrap();
    run(["full", crowned, "--load", "500", "--mu", "0"]).exits(0).says("of 12 pairs closed, contact force 500.000 N");
    let toml = std::fs::read_to_string(crowned).unwrap();
    let changed = |name: &str, from: &str, to: &str| {
        assert!(toml.contains(from), "{from}");
        program::write(&folder(), &format!("crowned-{name}.toml"), &toml.replace(from, to))
    };
    let refused = |name: &str, from: &str, to: &str, reason: &str| {
        run(["full", &changed(name, from, to)]).exits(1).complains(reason);
    };
    let load = "load_file = \"crowned-load.csv\"";
    refused("none", load, "", "`contact_state.load_nodes` is missing; expected where the load of 1 N presses");
    refused("half", load, "load_nodes = [24]", "`contact_state.load_direction` is missing");
    let both = format!("{load}\nload_nodes = [24]");
    refused("both", load, &both, "`contact_state.load_file` is given beside other keys of the load");
    let nodes = |list: &str, direction: &str| format!("load_nodes = {list}\nload_direction = {direction}");
    refused("flat", load, &nodes("[24]", "[0.0, 0.0, 0.0]"), "`contact_state.load_direction` is [0.0, 0.0, 0.0]");
    refused(
        "far",
        load,
        &nodes("[24, 99]", "[0.0, -1.0, 0.0]"),
        "`contact_state.load_nodes[1]` is 99, expected a node",
    );
    refused("twice", load, &nodes("[24, 24]", "[0.0, -1.0, 0.0]"), "is 24 again, expected every node at most once");
    let pulls = "the load does not press free-floating parts together";
    refused("up", load, &nodes("[24, 25]", "[0.0, 1.0, 0.0]"), pulls);
    refused("modal", load, "load_coordinates = [1.0]", "`contact_state.load_coordinates` is given for a full model");
    refused("law", "[friction]", "[load]\nexponent = 0.5\n[friction]", "[load] exponent 0.5 with a contact state");
    let forces = std::fs::read_to_string(folder().join("crowned-load.csv")).unwrap();
    let with_forces = |name: &str, from: &str, to: &str, reason: &str| {
        program::write(&folder(), &format!("{name}-load.csv"), &forces.replacen(from, to, 1));
        refused(name, load, &format!("load_file = \"{name}-load.csv\""), reason);
    };
    with_forces(
        "header",
        "force_n",
        "force",
        "line 1: header is `node,direction,force`; expected node,direction,force_n",
    );
    with_forces("cell", "24,y,", "24,y,x", "line 2: force is `24,y,x");
    with_forces("node", "24,y,", "240,y,", "expected a node of the pad that moves along this direction");
    with_forces("again", "24,x,", "24,y,", "line 3: force is `24,y,0.002`; expected every direction of a node once");
}

/// All modes of pad and disc leave nothing out: a rig of them has the roots of the full model, with rotation and damping, and
/// its contact states.
#[test]
fn all_modes_of_the_parts_keep_rotation_and_damping() {
    let Some(expected) = expected() else { return };
    let mut worst = 0.0_f64;
    for (name, model) in expected["models"].as_object().unwrap() {
        // A single damping ratio is of every mode of such a rig, but in the full model of those up to 2.5 times the band.
        if name == "modal" {
            continue;
        }
        let file = model["file"].as_str().unwrap();
        let rig = text(&folder().join(format!("{name}-all.toml")));
        run(["reduce", file, "--modes", "108+168", "--no-residual", "--points", "0", "-o", &rig]).exits(0);
        let loaded = Rig::load(&rig).unwrap();
        let told = loaded.describe().contains("rotation   gyroscopic and spin terms of the disc");
        assert_eq!(told, name == "both" || name.contains("turning") || name == "rough", "{}", loaded.describe());
        for case in model["cases"].as_array().unwrap() {
            let spectrum = Solver::new(loaded.model.dimension()).solve(&loaded.model, &point(case), Vectors::Right);
            let spectrum = spectrum.unwrap();
            assert_eq!(spectrum.state.is_some(), STATES.contains(&name.as_str()));
            if let Some(state) = &spectrum.state {
                // The modes of both parts have errors of 1e-12.
                let off = forces_off(case, &state.force_n);
                assert!(off < 10.0 * FORCES, "{rig}: forces off by {off:.1e}");
            }
            let modes: Vec<c64> = spectrum.modes().iter().map(|root| root.lambda).collect();
            let band = 0.999 * TAU * number(model, "band_hz");
            let counted: Vec<c64> = of_scipy(case).into_iter().filter(|lambda| lambda.im < band).collect();
            let off = off(&counted, &modes);
            worst = worst.max(off);
            assert!(off < TOLERANCE && counted.len() > 40, "{rig} at {}: {off:.1e}", conditions(case).join(" "));
        }
    }
    eprintln!("roots off by {worst:.1e} at most");
}

/// With residual flexibility few modes give the contact states of the full model, the response of the truncated ones to the
/// load included; so does a basis of the full model, which holds the roots to its tolerance over load and friction
/// coefficient. `verify` compares both.
#[test]
fn reduced_models_keep_the_contact_states() {
    let Some(expected) = expected() else { return };
    for name in STATES {
        let model = &expected["models"][name];
        let file = model["file"].as_str().unwrap();
        let rig = |kind: &str| text(&folder().join(format!("{name}-{kind}.toml")));
        let (compact, few, basis) = (rig("compact"), rig("few"), rig("basis"));
        let modes = ["--modes", "50+70", "--points", "0", "-q", "-o"];
        run(["reduce", file].into_iter().chain(modes).chain([few.as_str()])).exits(0);
        run(["reduce", file, "--compact"].into_iter().chain(modes).chain([compact.as_str()])).exits(0);
        // Rounding of the modes, times the same condition as above.
        for (rig, limit) in [(&few, 1e-9), (&compact, 1e-9)] {
            let loaded = Rig::load(rig).unwrap();
            for case in model["cases"].as_array().unwrap() {
                let state = loaded.model.at(&point(case)).unwrap().state().unwrap().clone();
                let off = forces_off(case, &state.force_n);
                assert!(off < limit, "{rig} at {}: forces off by {off:.1e}", conditions(case).join(" "));
            }
        }
        // The wide band of these few degrees of freedom would need nearly all of them: a narrower one is sampled.
        let toml = std::fs::read_to_string(file).unwrap();
        let band = toml.lines().find(|line| line.starts_with("max_hz")).unwrap();
        let narrow = program::write(&folder(), &format!("{name}-narrow.toml"), &toml.replace(band, "max_hz = 400.0"));
        let range = "mu=0:0.4,load=300:1500,speed=13";
        run(["reduce", &narrow, "--range", range, "--points", "0", "-q", "-o", &basis]).exits(0);
        let loaded = Rig::load(&basis).unwrap();
        for p in [(300.0, 0.0), (700.0, 0.2), (1500.0, 0.4)] {
            let (load, mu) = (p.0.to_string(), p.1.to_string());
            let found = json(["full", &narrow, "--load", &load, "--mu", &mu, "--speed", "13", "--json", "-q"]);
            let p = OperatingPoint { normal_load_n: p.0, disc_speed_rad_s: 13.0, friction_coefficient: p.1 };
            let spectrum = Solver::new(loaded.model.dimension()).solve(&loaded.model, &p, Vectors::Right).unwrap();
            // The statics are those of the full model.
            let forces = &spectrum.state.as_ref().unwrap().force_n;
            let off_forces = forces_off(&found["contact"], forces);
            let roots: Vec<c64> = spectrum.modes().iter().map(|root| root.lambda).collect();
            let full: Vec<c64> = found["roots"]
                .as_array()
                .unwrap()
                .iter()
                .map(|value| root(number(value, "growth_rate_per_s"), number(value, "omega_rad_s")))
                .filter(|lambda| lambda.re > -20.0 && lambda.im > 0.0)
                .collect();
            let off = off(&full, &roots);
            assert!(
                off < 1e-6 && !full.is_empty() && off_forces < 1e-12,
                "{basis} at {p:?}: {off:.1e} {off_forces:.1e}"
            );
        }
    }
    let (opening, without) =
        (folder().join("opening-few.toml"), expected["models"]["rayleigh"]["file"].as_str().unwrap());
    run(["verify", &text(&opening), "--against", without, "--points", "1"])
        .exits(1)
        .complains("opening-few: `contact_state` is given, but the pairs of rayleigh are always closed");
    let file = expected["models"]["opening"]["file"].as_str().unwrap();
    let args = ["--points", "2", "--no-windows", "--tolerance", "0.01", "-q", "--json"];
    let found = json(["verify", &text(&opening), "--against", file].into_iter().chain(args));
    let certificate = &found["certificate"];
    assert!(number(certificate, "max_force_error") < 1e-9 && certificate["pairs_differ"] == 0, "{certificate}");
    assert_eq!(found["points"].as_array().unwrap().len(), 2);
}

/// Matrices of rotation with a wrong symmetry, and for the pad, are refused with file, entry, value and limit.
#[test]
fn wrong_matrices_of_rotation_are_refused() {
    let Some(expected) = expected() else { return };
    let file = expected["models"]["turning"]["file"].as_str().unwrap();
    let toml = std::fs::read_to_string(file).unwrap();
    let changed = |name: &str, from: &str, to: &str| {
        assert!(toml.contains(from), "{from}");
        program::write(&folder(), &format!("{name}.toml"), &toml.replace(from, to))
    };
    // An entry above the diagonal, with another exponent.
    let entries = std::fs::read_to_string(folder().join("turning-spin.mtx")).unwrap();
    let listed = entries.lines().filter(|line| !line.starts_with('%')).skip(1);
    let mut places = listed.map(|line| (line, line.split(' ').take(2).collect::<Vec<_>>()));
    let (entry, place) = places.find(|(_, place)| place[0] != place[1]).unwrap();
    let mirrored = format!("{} {} ", place[1], place[0]);
    let line = 1 + entries.lines().position(|line| line.starts_with(&mirrored)).unwrap();
    let wrong = entries.replace(&format!("\n{entry}\n"), &format!("\n{entry}1\n"));
    program::write(&folder(), "unsymmetric.mtx", &wrong);
    let told = run(["full", &changed("a", "turning-spin.mtx", "unsymmetric.mtx")]).exits(1);
    told.complains(&format!("unsymmetric.mtx, line {line}: ")).complains("a symmetric matrix");
    let told = run(["full", &changed("b", "turning-gyroscopic.mtx", "turning-spin.mtx")]).exits(1);
    told.complains("turning-spin.mtx").complains("a skew-symmetric matrix; mirrored entries with opposite signs");
    run(["full", &changed("c", "[pad]\n", "[pad]\nspin = \"turning-spin.mtx\"\n")])
        .exits(1)
        .complains("`pad.spin` is given for the pad, which does not turn; expected disc.spin");
    run(["full", &changed("f", "[disc]\n", "[disc]\nloss_factor = 0.02\n")])
        .exits(1)
        .complains("`disc.loss_factor` is 0.02, but a complex stiffness")
        .complains("expected damping_ratio = 0.01 for the same damping");
    run(["full", &changed("d", "[disc]\n", "[disc]\nrayleigh_beta_s = -1e-7\n")])
        .exits(1)
        .complains("disc.rayleigh_beta_s")
        .complains("at least 0");
}
