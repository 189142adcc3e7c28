//! States of sliding contact are those that numpy and scipy find on the same random flexibilities
//! (`tests/peers/contact_states.py`).

use std::path::Path;
use std::process::Command;

use crate::program::{self, number, python};
use faer::Mat;
use serde_json::Value;
use squealcast::contact::{
    MeasuredLoad, PressureLaw, RigidMotions, StaticResponse, Statics, StaticsError, StaticsParts,
};

/// Of the largest force. Exact sets of closed pairs leave rounding times the condition, at most 1e5, of their matrices;
/// scipy's states leave 1e-11 of their equations.
const TOLERANCE: f64 = 1e-9;

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("a list").iter().map(|entry| entry.as_f64().expect("a number")).collect()
}

fn matrix(value: &Value) -> Mat<f64> {
    let rows: Vec<Vec<f64>> = value.as_array().expect("rows").iter().map(numbers).collect();
    Mat::from_fn(rows.len(), rows.len(), |i, j| rows[i][j])
}

fn statics(case: &Value) -> Statics {
    let (name, values) = case["law"].as_object().expect("a law").iter().next().expect("its name");
    let values = numbers(values);
    let law = match name.as_str() {
        "linear" => PressureLaw::Linear { stiffness: values[0] },
        "power" => PressureLaw::Power {
            stiffness: values[0],
            reference_m: values[1],
            exponent: values[2],
            roughness_m: values[3],
        },
        "exponential" => PressureLaw::Exponential { pressure: values[0], roughness_m: values[1] },
        name => panic!("no law {name}"),
    };
    let area = numbers(&case["area"]);
    let c = area.len();
    let response = StaticResponse {
        normal_flexibility: matrix(&case["normal_flexibility"]),
        sliding_flexibility: matrix(&case["sliding_flexibility"]),
        gap_per_load: numbers(&case["gap_per_load"]),
        rigid: RigidMotions { normal: Mat::zeros(c, 0), sliding: Mat::zeros(c, 0), load: vec![] },
    };
    let gap_m = numbers(&case["gap_m"]);
    Statics::new(StaticsParts { law, area, gap_m, response, measured: MeasuredLoad::Back }).expect("valid statics")
}

/// The largest difference of two lists of forces, relative to the largest force; infinite if other pairs are closed.
fn difference(found: &[f64], expected: &[f64]) -> f64 {
    let largest = expected.iter().fold(0.0f64, |most, force| most.max(force.abs()));
    let same = found.iter().zip(expected).all(|(found, expected)| (*found > 0.0) == (*expected > 0.0));
    let most = found.iter().zip(expected).map(|(found, expected)| (found - expected).abs()).fold(0.0, f64::max);
    match (same, most) {
        (false, _) => f64::INFINITY,
        (true, 0.0) => 0.0,
        (true, most) => most / largest,
    }
}

#[test]
fn scipy_finds_the_same_contact_states() {
    let python = python();
    if !program::python_has(&python, "numpy, scipy") {
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/contact_states.py");
    let output = Command::new(&python).arg(script).output().expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let expected: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let (mut unique, mut none, mut followed, mut worst) = (0, 0, 0, 0.0f64);
    for case in expected["cases"].as_array().expect("cases") {
        let (statics, load) = (statics(case), number(case, "load_n"));
        for state in case["states"].as_array().expect("states") {
            let mu = number(state, "friction");
            let found = statics.state(load, mu);
            let at = format!("{}, load {load}, friction coefficient {mu}", case["law"]);
            let forces = found.as_ref().map(|state| state.force_n.as_slice());
            let off = match state["all"].as_array().map(Vec::as_slice) {
                // The state that follows from one without friction, found by steps.
                None => {
                    followed += 1;
                    difference(forces.unwrap_or_else(|error| panic!("{at}: {error}")), &numbers(&state["force"]))
                }
                Some([]) => {
                    none += 1;
                    assert!(matches!(found, Err(StaticsError::NoEquilibrium { .. })), "{at}: {found:?}");
                    0.0
                }
                Some([only]) => {
                    unique += 1;
                    difference(forces.unwrap_or_else(|error| panic!("{at}: {error}")), &numbers(only))
                }
                // One of several, or none if the states have turned back.
                Some(several) => match (&found, forces) {
                    (_, Ok(forces)) => {
                        several.iter().map(|one| difference(forces, &numbers(one))).fold(f64::INFINITY, f64::min)
                    }
                    (Err(StaticsError::NoEquilibrium { .. }), _) => 0.0,
                    (found, _) => panic!("{at}: {found:?}"),
                },
            };
            assert!(off < TOLERANCE, "{at}: forces differ by {off:e}");
            worst = worst.max(off);
        }
    }
    eprintln!(
        "{}: {unique} unique states, {none} conditions without one, {followed} followed; forces differ by {worst:.1e}",
        expected["versions"]
    );
    assert!(unique > 250 && none > 0 && followed > 80, "{unique} {none} {followed}");
}
