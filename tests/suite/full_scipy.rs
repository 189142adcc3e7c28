//! Full models written by numpy and scipy, with rotation and structural damping: `full`, `reduce` and `verify` against
//! dense eigenvalues of the same matrices (`tests/peers/scipy_full.py`).

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

/// Largest `|Δλ|/|λ|` between each of `roots` and the nearest of `among`.
fn off(roots: &[c64], among: &[c64]) -> f64 {
    let nearest =
        |lambda: &c64| among.iter().map(|other| (other - lambda).norm() / lambda.norm()).fold(f64::INFINITY, f64::min);
    roots.iter().map(nearest).fold(0.0, f64::max)
}

#[test]
fn full_models_have_the_roots_that_scipy_finds() {
    let Some(expected) = expected() else { return };
    let mut worst = 0.0_f64;
    for (name, model) in expected["models"].as_object().unwrap() {
        let (file, band_hz) = (model["file"].as_str().unwrap(), number(model, "band_hz"));
        for case in model["cases"].as_array().unwrap() {
            let mut args = vec!["full".to_owned(), file.to_owned(), "--json".to_owned()];
            args.extend(conditions(case));
            let found = json(args);
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
    eprintln!("roots off by {worst:.1e} at most");
}

/// All modes of pad and disc leave nothing out: a rig of them has the roots of the full model, with rotation and damping.
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
        assert_eq!(told, name == "both" || name.contains("turning"), "{}", loaded.describe());
        for case in model["cases"].as_array().unwrap() {
            let spectrum = Solver::new(loaded.model.dimension()).solve(&loaded.model, &point(case), Vectors::Right);
            let modes: Vec<c64> = spectrum.unwrap().modes().iter().map(|root| root.lambda).collect();
            let band = 0.999 * TAU * number(model, "band_hz");
            let counted: Vec<c64> = of_scipy(case).into_iter().filter(|lambda| lambda.im < band).collect();
            let off = off(&counted, &modes);
            worst = worst.max(off);
            assert!(off < TOLERANCE && counted.len() > 40, "{rig} at {}: {off:.1e}", conditions(case).join(" "));
        }
    }
    eprintln!("roots off by {worst:.1e} at most");
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
    run(["full", &changed("d", "[disc]\n", "[disc]\nrayleigh_beta_s = -1e-7\n")])
        .exits(1)
        .complains("disc.rayleigh_beta_s")
        .complains("at least 0");
}
