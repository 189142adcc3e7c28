//! `identify` against the nine-DoF rig's natural frequencies in 30-digit arithmetic (its contact springs are 1 N/m).
#![cfg(feature = "node")]

mod program;

use std::f64::consts::TAU;
use std::fs;

use program::{json, launch, number, run, text, write};

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
    // In any order: the natural frequencies of a rig have none of their own.
    let listed: String = NINE_DOF_RAD_S.iter().rev().map(|w| format!("m,{}\n", w / TAU)).collect();
    let targets = write(temp.path(), "measured.csv", &format!("mode,frequency_hz\n{listed}"));
    let svg = temp.path().join("identification.svg");

    let found = json(["identify", &rig, "--targets", &targets, "--json", "--svg", &text(&svg)]);
    // Ten digits in the targets: 5e-10 of a frequency, whose square moves by at most itself with the stiffness.
    assert!((number(&found, "stiffness_factor") - 8.0).abs() < 1e-6, "{found}");
    assert!(number(&found, "largest_error") < 2e-9, "{found}");
    let figure = fs::read_to_string(&svg).unwrap();
    assert!(figure.starts_with("<svg") && figure.contains("contact stiffness of a pair"), "{figure:.200}");

    // Of the lowest alone, which hardly know the contact, less is known: the range widens.
    run(["identify", &rig, "--targets", &targets]).exits(0).says("1.000000e0 N/m a pair").says("0.8749");
    let few = json(["identify", &rig, "--targets", &targets, "--json", "--first", "5"]);
    assert!((number(&few, "stiffness_factor") - 8.0).abs() < 1e-5, "{few}");
}

#[test]
fn what_cannot_be_fitted_is_refused() {
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
