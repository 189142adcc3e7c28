//! Rigs written by numpy and scipy predict what scipy does on matrices that it assembles for itself
//! (`tests/peers/scipy_rigs.py`).

use std::f64::consts::TAU;
use std::path::Path;
use std::process::Command;

use crate::program::{self, json, number, python};
use faer::c64;
use serde_json::Value;

#[test]
fn scipy_predicts_the_same() {
    let python = python();
    if !program::python_has(&python, "numpy, scipy") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/scipy_rigs.py");
    let output = Command::new(&python).arg(script).arg(folder.path()).output().expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let expected: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    eprintln!("compared with {}", expected["versions"]);

    let cases = expected["cases"].as_array().expect("cases");
    let mut comparison = Comparison::default();
    cases.iter().for_each(|case| comparison.predict(case));
    let Comparison { root_off, root_off_at, share_off, merging, differences, .. } = comparison;
    eprintln!("{} predictions: roots off by {root_off:.1e} at most ({root_off_at})", cases.len());
    eprintln!("pad shares off by {share_off:.1e} at most; {merging} mergings");
    assert!(differences.is_empty(), "{} differences:\n{}", differences.len(), differences.join("\n"));
    assert!(cases.len() > 150 && merging == 2, "{} cases, {merging} mergings", cases.len());
}

/// The documented accuracy is 1e-9, relative; LAPACK's and our backward errors leave 1e-12 of these roots.
const TOLERANCE: f64 = 1e-9;

/// What differs, and by how much the rest does.
#[derive(Default)]
struct Comparison {
    at: String,
    root_off: f64,
    root_off_at: String,
    share_off: f64,
    merging: usize,
    differences: Vec<String>,
}

impl Comparison {
    /// Predicts one case and compares everything that scipy says of it.
    fn predict(&mut self, case: &Value) {
        let rig = case["rig"].as_str().expect("a path");
        let [load, speed, mu] =
            ["normal_load_n", "disc_speed_rad_s", "friction_coefficient"].map(|key| number(case, key).to_string());
        let name = Path::new(rig).file_name().expect("a name").display();
        self.at = format!("{name} at {load} N, {speed} rad/s, {mu}");
        let found = json(["predict", rig, "--json", "--load", &load, "--speed", &speed, "--mu", &mu]);

        let expected: Vec<Root> = case["modes"].as_array().expect("modes").iter().map(Root::of_scipy).collect();
        let mut left: Vec<Root> = found["modes"].as_array().expect("modes").iter().map(Root::of_prediction).collect();
        if left.len() != expected.len() {
            return self.differs(&format!("{} modes instead of {}", left.len(), expected.len()));
        }
        let pair = if case["merging"] == true { closest_pair(&expected) } else { vec![] };
        let mut merged = vec![];
        for (index, root) in expected.iter().enumerate() {
            let found = take_nearest(&mut left, root.lambda);
            if pair.contains(&index) {
                merged.push((root.lambda * root.lambda, found.lambda * found.lambda));
            } else {
                self.root(root.lambda, found.lambda);
                self.share(root, &found);
            }
        }
        if let &[first, second] = merged.as_slice() {
            self.merging(first, second);
        }

        let (statics, statics_found) = (numbers(&case["statics"]), numbers(&found["nonoscillatory_growth_per_s"]));
        if statics.len() != statics_found.len() {
            self.differs(&format!("static roots {statics_found:?} instead of {statics:?}"));
        }
        for (growth, found) in statics.iter().zip(&statics_found) {
            self.root(c64::new(*growth, 0.0), c64::new(*found, 0.0));
        }
        if let Some(unstable) = case["unstable"].as_u64().filter(|&count| found["unstable_modes"] != count) {
            self.differs(&format!("{} unstable instead of {unstable}", found["unstable_modes"]));
        }
    }

    fn differs(&mut self, what: &str) {
        self.differences.push(format!("{}: {what}", self.at));
    }

    fn root(&mut self, expected: c64, found: c64) {
        // A disc that turns freely has its roots at 0 in both programs, exactly.
        let off = if found == expected { 0.0 } else { (found - expected).norm() / expected.norm() };
        if off > self.root_off {
            (self.root_off, self.root_off_at) = (off, self.at.clone());
        }
        if off.is_nan() || off > TOLERANCE {
            self.differs(&format!("{found} instead of {expected}, off by {off:.1e}"));
        }
    }

    fn share(&mut self, expected: &Root, found: &Root) {
        match (expected.pad_share, found.pad_share) {
            (None, None) => {}
            // Shapes lose what lies between a root and the next: 1e-3 of λ² in the worst case here, 1e-6 next to the
            // merging. That leaves 1e-12.
            (Some(share), Some(found)) if (found - share).abs() <= TOLERANCE => {
                self.share_off = self.share_off.max((found - share).abs());
            }
            shares => self.differs(&format!("pad share {shares:?} of {}", expected.lambda)),
        }
    }

    /// At a merging two roots are only known through what stays analytic there: the mean of their squares, and the
    /// discriminant `((z₁-z₂)/2)²`, which is 0. Rounding moves the discriminant by some ε z², and so the roots by √ε.
    fn merging(&mut self, first: (c64, c64), second: (c64, c64)) {
        let (mean, found) = (0.5 * (first.0 + second.0), 0.5 * (first.1 + second.1));
        self.root(mean, found);
        let half = 0.5 * (first.1 - second.1);
        let discriminant = (half * half).norm() / mean.norm_sqr();
        // n = 15 coordinates, ‖K‖ some hundred times the λ² of the pair: 1e-12.
        if discriminant.is_nan() || discriminant > 1e-12 {
            self.differs(&format!("discriminant {discriminant:e} of its square at a merging"));
        }
        self.merging += 1;
    }
}

/// A mode as printed by either program.
struct Root {
    lambda: c64,
    pad_share: Option<f64>,
}

impl Root {
    fn of_scipy(mode: &Value) -> Self {
        let part = |index: usize| mode[index].as_f64();
        let (re, im) = (part(0).expect("a number"), part(1).expect("a number"));
        Self { lambda: c64::new(re, im), pad_share: part(2) }
    }

    fn of_prediction(mode: &Value) -> Self {
        let lambda = c64::new(number(mode, "growth_rate_per_s"), TAU * number(mode, "frequency_hz"));
        Self { lambda, pad_share: mode["pad_participation"].as_f64() }
    }
}

/// Numbers of a JSON list.
fn numbers(list: &Value) -> Vec<f64> {
    list.as_array().expect("a list").iter().map(|value| value.as_f64().expect("a number")).collect()
}

/// Takes the root nearest to `lambda` out of `left`.
fn take_nearest(left: &mut Vec<Root>, lambda: c64) -> Root {
    let distance = |k: &usize| (left[*k].lambda - lambda).norm();
    let index = (0..left.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("as many roots");
    left.swap_remove(index)
}

/// The two roots nearest to each other.
fn closest_pair(roots: &[Root]) -> Vec<usize> {
    let pairs = (0..roots.len()).flat_map(|b| (0..b).map(move |a| vec![a, b]));
    let distance = |pair: &[usize]| (roots[pair[0]].lambda - roots[pair[1]].lambda).norm();
    pairs.min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("two roots")
}
