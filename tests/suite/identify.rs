//! `identify` against the nine-DoF rig's natural frequencies in 30-digit arithmetic (its contact springs are 1 N/m).

use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

use crate::program::{json, launch, number, run, text, tribometer, write};
use squealcast::full_model::FullModelFile;
use squealcast::physics::{Solver, Vectors};
use squealcast::reduction::lowest_modes;
use squealcast::rig::Rig;

/// rad/s, without friction, contact springs of 1 N/m.
const NINE_DOF_RAD_S: [f64; 9] =
    [1.0, 1.030686177, 1.101320323, 1.324675571, 1.563283353, 1.781280315, 2.030436593, 2.238727073, 5.497147271];

#[test]
fn the_stiffness_behind_known_frequencies_is_found() {
    let temp = tempfile::tempdir().unwrap();
    let rig_file = fs::read_to_string(launch("nine-dof.toml")).unwrap();
    let softer = rig_file.replace("stiffness_n_per_m = 1.0", "stiffness_n_per_m = 0.125");
    assert_eq!(softer.matches("stiffness_n_per_m = 0.125").count(), 2);
    let rig = write(temp.path(), "softer.toml", &softer);
    // In any order: targets are sorted.
    let listed: String = NINE_DOF_RAD_S.iter().rev().map(|w| format!("m,{}\n", w / TAU)).collect();
    let targets = write(temp.path(), "measured.csv", &format!("mode,frequency_hz\n{listed}"));
    let svg = temp.path().join("identification.svg");

    let found = json(["identify", &rig, "--targets", &targets, "--json", "--svg", &text(&svg)]);
    // Ten digits in the targets: 5e-10 of a frequency, whose square moves by at most itself with the stiffness.
    assert!((number(&found, "stiffness_factor") - 8.0).abs() < 1e-6, "{found}");
    assert!(number(&found, "largest_error") < 2e-9, "{found}");
    let figure = fs::read_to_string(&svg).unwrap();
    assert!(figure.starts_with("<svg") && figure.contains("contact stiffness of a pair"), "{figure:.200}");

    // As a spreadsheet in a country of decimal commas saves it.
    let german = format!("mode;frequency_hz\n{}", listed.replace(',', ";").replace('.', ","));
    let german = write(temp.path(), "german.csv", &german);
    assert_eq!(json(["identify", &rig, "--targets", &german, "--json"]), found);
    let mixed = write(temp.path(), "mixed.csv", "mode;frequency_hz\nm;1.234,5\n");
    run(["identify", &rig, "--targets", &mixed]).exits(1).complains("line 2: frequency_hz is `1.234,5`");

    run(["identify", &rig, "--targets", &targets]).exits(0).says("1.000000e0 N/m a pair").says("0.8749");

    // Written, the rig has the stiffness found and fits as it is; on standard output it is the same but for its name.
    let stiffer = text(&temp.path().join("stiffer.toml"));
    assert_eq!(json(["identify", &rig, "--targets", &targets, "--json", "-o", &stiffer]), found);
    let fitted = json(["identify", &stiffer, "--targets", &targets, "--json"]);
    assert!((number(&fitted, "stiffness_factor") - 1.0).abs() < 1e-6, "{fitted}");
    let [softer, stiffer] = [&rig, &stiffer].map(|rig| Rig::load(rig).expect("a rig"));
    let of = |rig: &Rig| rig.contact_stiffness_n_per_m();
    assert!(of(&stiffer).iter().zip(of(&softer)).all(|(k, before)| (k / before - 8.0).abs() < 1e-6));
    assert_eq!((stiffer.name.as_str(), stiffer.limits), ("stiffer", softer.limits));
    run(["identify", &rig, "--targets", &targets, "--json", "-o", "-"]).exits(0).says("times its contact stiffness");
    let few = json(["identify", &rig, "--targets", &targets, "--json", "--first", "5"]);
    assert!((number(&few, "stiffness_factor") - 8.0).abs() < 1e-5, "{few}");

    // Of the lowest alone, which know the contact less, less is known: with the same relative errors in the frequencies
    // the range widens. Where the fit is quadratic, errors that no stiffness removes double `sqrt(3) rms / S` away.
    let sign = |index: usize| if index.is_multiple_of(2) { 1.0 } else { -1.0 };
    let off = |(index, w): (usize, &f64)| format!("{}\n", w / TAU * (1.0 + 1e-3 * sign(index)));
    let wrong: String = NINE_DOF_RAD_S.iter().enumerate().map(off).collect();
    let wrong = write(temp.path(), "wrong.csv", &format!("frequency_hz\n{wrong}"));
    let [all, few] = ["9", "5"].map(|first| {
        let found = json(["identify", &rig, "--targets", &wrong, "--json", "--first", first]);
        let width = (number(&found, "factor_to") / number(&found, "factor_from")).ln();
        let expected = 2.0 * 3.0_f64.sqrt() * number(&found, "rms_error") / number(&found, "sensitivity");
        // What is beyond the quadratic changes the width by its own square, if it is the same to both sides.
        assert!((width / expected - 1.0).abs() < width.max(0.05), "{width} {expected} {found}");
        width
    });
    assert!(few > 1.5 * all, "{few} {all}");
}

/// Frequencies of `rig` at rest under several loads, as a CSV file with a column of loads.
pub fn targets_at_loads(folder: &Path, rig: &str, loads_n: &[f64]) -> String {
    let mut lines = "normal_load_n,frequency_hz\n".to_owned();
    for load in loads_n {
        let found = json(["predict", rig, "--mu", "0", "--speed", "0", "--load", &load.to_string(), "--json"]);
        for mode in found["modes"].as_array().unwrap() {
            lines += &format!("{load},{}\n", number(mode, "frequency_hz"));
        }
    }
    write(folder, "at-loads.csv", &lines)
}

/// Frequencies at several loads tell how the stiffness follows the load: factor and exponent of the rig that made them.
#[test]
fn the_exponent_of_the_load_is_found() {
    let temp = tempfile::tempdir().unwrap();
    let nine = fs::read_to_string(launch("nine-dof.toml")).unwrap();
    let stiffer = nine.replace("stiffness_n_per_m = 1.0", "stiffness_n_per_m = 2.5");
    let made = write(temp.path(), "made.toml", &format!("{stiffer}\n[load]\nexponent = 0.4\nreference_n = 500.0\n"));
    let targets = targets_at_loads(temp.path(), &made, &[100.0, 500.0, 2000.0]);
    let fitted = text(&temp.path().join("fitted.toml"));
    let found = json(["identify", "nine-dof", "--targets", &targets, "--json", "-o", &fitted]);
    // Frequencies are printed with all digits.
    assert!((number(&found, "stiffness_factor") - 2.5).abs() < 1e-6, "{found}");
    assert!((number(&found, "exponent") - 0.4).abs() < 1e-6, "{found}");
    assert!(number(&found, "exponent_standard_error") < 1e-6, "{found}");
    assert_eq!(found["normal_load_n"].as_array().unwrap().len(), 27);
    let at = ["predict", "--mu", "0.5", "--load", "900", "--json"];
    let [fitted, made] = [&fitted, &made].map(|rig| json([&at[..1], &[rig.as_str()], &at[1..]].concat()));
    for (a, b) in fitted["modes"].as_array().unwrap().iter().zip(made["modes"].as_array().unwrap()) {
        assert!((number(a, "frequency_hz") / number(b, "frequency_hz") - 1.0).abs() < 1e-6, "{a} {b}");
    }
    run(["identify", "nine-dof", "--targets", &targets]).exits(0).says("exponent           0.4000").says("2000.00");
    run(["identify", "nine-dof", "--targets", &targets, "--load", "100"]).exits(1).complains("expected one of them");
    run(["identify", "nine-dof", "--targets", &targets, "--first", "12"]).exits(1).complains("1 to the 9 frequencies");
    let wrong = write(temp.path(), "wrong.csv", "normal_load_n,frequency_hz\n-5,1.0\n");
    run(["identify", "nine-dof", "--targets", &wrong]).exits(1).complains("line 2: normal_load_n is `-5`");
}

/// A rig of kind 2 with the residual of the truncated modes, against the full model's own frequencies with another
/// stiffness; and against its own, where nothing is left out.
#[test]
fn the_stiffness_of_a_full_model_is_found_on_a_rig_with_residuals() {
    const FACTOR: f64 = 0.6;
    const COUNT: usize = 18;
    let temp = tempfile::tempdir().unwrap();
    let path = tribometer(temp.path(), 5000);
    let rig_file = text(&temp.path().join("rig.toml"));
    run(["reduce", &text(&path), "--modes", "40+40", "--points", "0", "-o", &rig_file])
        .exits(0)
        .says("residual   of pad");

    let written = fs::read_to_string(&path).unwrap();
    let frequencies = |factor: f64| -> Vec<f64> {
        let other = written.replace("= 1.251e7", &format!("= {:?}", factor * 1.251e7));
        assert_ne!(other, written);
        let full = FullModelFile::load(Path::new(&write(temp.path(), "other.toml", &other))).unwrap();
        let rest = full.settings.reference.with_friction(0.0);
        let [mass, _, stiffness] = full.model.matrices_at(&rest).unwrap();
        let modes = lowest_modes("full", &mass, &stiffness, COUNT).unwrap();
        modes.omega_squared.iter().map(|square| square.sqrt() / TAU).collect()
    };
    let list = |name: &str, hz: &[f64]| {
        let lines: String = hz.iter().map(|hz| format!("{hz}\n")).collect();
        write(temp.path(), name, &format!("frequency_hz\n{lines}"))
    };
    let rms = |a: &[f64], b: &[f64]| {
        let squares: f64 = a.iter().zip(b).map(|(a, b)| (a / b).ln().powi(2)).sum();
        (squares / COUNT as f64).sqrt()
    };
    let (exact, stiffer) = (frequencies(FACTOR), frequencies(1.02 * FACTOR));
    let found = json(["identify", &rig_file, "--targets", &list("full.csv", &exact), "--json"]);
    eprintln!("{found}");
    // The sensitivity by the full model's own frequencies; those of the rig differ by the remaining truncation error.
    let sensitivity = rms(&stiffer, &exact) / 1.02_f64.ln();
    assert!((number(&found, "sensitivity") / sensitivity - 1.0).abs() < 0.05, "{sensitivity} {found}");
    let rig = Rig::load(&rig_file).unwrap().with_contact_stiffness_times(FACTOR).unwrap();
    let at_rest = rig.reference.with_friction(0.0);
    let spectrum = Solver::new(rig.model.dimension()).solve(&rig.model, &at_rest, Vectors::Right).unwrap();
    let reduced: Vec<f64> = spectrum.modes().iter().map(|root| root.frequency_hz()).take(COUNT).collect();
    let error = rms(&reduced, &exact);
    // 40 + 40 modes with residuals are good to 0.0713 %; no least-squares fit is further off than those errors over S.
    assert!(error < 7.13e-4, "{error:e}");
    let off = (number(&found, "stiffness_factor") / FACTOR).ln().abs();
    assert!(off < 1.1 * error / sensitivity, "{off:e}, {error:e} / {sensitivity}");
    // Where the error doubles: what no stiffness removes is small, and the fit quadratic. Ends are found to 0.1 %, and the
    // sensitivity is the full model's, above, within 5 %.
    let [from, to] = ["factor_from", "factor_to"].map(|key| number(&found, key));
    let expected = 2.0 * 3.0_f64.sqrt() * number(&found, "rms_error") / sensitivity;
    assert!(((to / from).ln() / expected - 1.0).abs() < 0.1, "{from} {to}, expected a width of {expected:e}");
    // Against the rig's own frequencies the error falls linearly to 0: rounding of 1e-12 and the last bracket are left.
    let own = json(["identify", &rig_file, "--targets", &list("own.csv", &reduced), "--json"]);
    assert!((number(&own, "stiffness_factor") / FACTOR - 1.0).abs() < 1e-7, "{own}");
    // Written into another folder, the rig brings its archives along; archives with another content are not replaced.
    let folder = temp.path().join("fitted");
    fs::create_dir(&folder).unwrap();
    let targets = text(&temp.path().join("own.csv"));
    let fitted_file = text(&folder.join("fitted.toml"));
    let write_fitted = ["identify", &rig_file, "--targets", &targets, "-o", &fitted_file];
    run(write_fitted).exits(0);
    run(write_fitted).exits(0);
    let fitted = Rig::load(&fitted_file).unwrap();
    let ratio = |(a, b): (f64, f64)| (a / b - 1.0).abs() < 1e-7;
    assert!(fitted.contact_stiffness_n_per_m().into_iter().zip(rig.contact_stiffness_n_per_m()).all(ratio));
    assert_eq!(fitted.files[1..], rig.files[1..]);
    assert!(!fitted.files[1..].is_empty());
    fs::write(folder.join(&fitted.files[1].name), "another").unwrap();
    run(write_fitted).exits(1).complains("is there with another content");
}

/// Frequencies that many stiffnesses fit about as well are reported as such.
#[test]
fn stiffness_that_is_poorly_determined_is_called_so() {
    let temp = tempfile::tempdir().unwrap();
    // 20 % off, up and down in turn: the best fit is bad, and so are many others.
    let sign = |index: usize| if index.is_multiple_of(2) { 1.2 } else { 0.8 };
    let lines: String =
        NINE_DOF_RAD_S.iter().enumerate().map(|(index, w)| format!("{}\n", w / TAU * sign(index))).collect();
    let targets = write(temp.path(), "off.csv", &format!("frequency_hz\n{lines}"));
    run(["identify", &launch("nine-dof.toml"), "--targets", &targets, "--first", "5"])
        .exits(0)
        .says("poorly determined: ");
}

#[test]
fn targets_that_cannot_be_fitted_are_refused() {
    let temp = tempfile::tempdir().unwrap();
    let rig = launch("nine-dof.toml");
    let targets = |content: &str| write(temp.path(), "targets.csv", content);
    let refused = |content: &str, complaint: &str| {
        run(["identify", &rig, "--targets", &targets(content)]).exits(1).complains(complaint).complains("targets.csv");
    };
    refused("hz\n1\n", "expected `frequency_hz`");
    refused("frequency_hz\n0.2\n-3\n", "line 3: frequency_hz is `-3`, expected a number above 0");
    refused("frequency_hz\n", "expected at least one");
    refused("frequency_hz\n1\n2\n3\n4\n5\n6\n7\n8\n9\n10\n", "9 natural frequencies, expected at least the 10");
    // No stiffness within reach makes frequencies that high.
    refused(&("frequency_hz".to_owned() + &"\n1e6".repeat(9)), "the end of the search");
    let one = targets("frequency_hz\n0.2\n");
    run(["identify", &rig, "--targets", &one, "--first", "2"]).exits(1).complains("--first is 2, expected 1 to the 1");
    run(["identify", &rig, "--targets", "/none.csv"]).exits(1).complains("/none.csv");
    run(["identify", &launch("hulten.toml"), "--targets", &one]).exits(1).complains("no contact stiffness");
}
