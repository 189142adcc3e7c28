//! States of steady sliding, and the roots about them, are those that numpy and scipy find from the same contact data
//! (`tests/peers/steady_states.py`).

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use crate::program::{self, python};
use faer::{Mat, c64};
use serde_json::{Value, json};
use squealcast::contact::{
    FreeModes, MeasuredLoad, PressureLaw, StaticResponse, Statics, StaticsParts, TruncatedResponse,
};
use squealcast::physics::{
    ContactLaw, ContactPairs, Law, MapOptions, Model, OperatingPoint, ResidualFlexibility, Solver, Spectrum,
    StabilityMap, Stribeck, Term, Vectors, WindowKind,
};
use squealcast::proof::synthetic::Uniform;

const MODES: usize = 10;
const PAIRS: usize = 12;

/// A random pad and disc in contact; the same numbers go to Python.
struct Rig {
    data: Value,
    model: Model,
    free: Model,
    pairs: ContactPairs,
}

fn rows(matrix: &Mat<f64>) -> Value {
    let row = |i: usize| (0..matrix.ncols()).map(|j| matrix[(i, j)]).collect::<Vec<f64>>();
    (0..matrix.nrows()).map(row).collect()
}

fn laws() -> [(PressureLaw, Value); 5] {
    let power = |exponent: f64, roughness_m: f64| {
        let law = PressureLaw::Power { stiffness: 0.2, reference_m: 100.0, exponent, roughness_m };
        let data = json!({
            "law": "power", "stiffness": 0.2, "reference_m": 100.0, "exponent": exponent, "roughness_m": roughness_m,
        });
        (law, data)
    };
    [
        (PressureLaw::Linear { stiffness: 0.2 }, json!({ "law": "linear", "stiffness": 0.2 })),
        power(1.5, 0.0),
        power(2.0, 0.0),
        power(2.0, 40.0),
        (
            PressureLaw::Exponential { pressure: 15.0, roughness_m: 150.0 },
            json!({ "law": "exponential", "pressure": 15.0, "roughness_m": 150.0 }),
        ),
    ]
}

impl Rig {
    fn new(seed: u64, law: &(PressureLaw, Value), damping_ratio: f64, flexible: bool, friction: ContactLaw) -> Self {
        let mut uniform = Uniform::new(seed);
        let omega: Vec<f64> = (0..MODES).map(|_| 1.0 + 4.0 * uniform.draw().abs()).collect();
        let mut random = |rows: usize, columns: usize| Mat::from_fn(rows, columns, |_, _| uniform.draw());
        let [normal, sliding, lateral] = [(); 3].map(|()| random(PAIRS, MODES));
        let size = if flexible { 0.2 } else { 0.0 };
        let [bent, skewed] = [(); 2].map(|()| random(PAIRS, 4) * faer::Scale(size));
        let (r_nn, r_nt) = (&bent * bent.transpose(), &bent * skewed.transpose());
        let pressed: Vec<f64> = (0..MODES).map(|k| -(0..PAIRS).map(|i| normal[(i, k)]).sum::<f64>()).collect();
        let gaps_m: Vec<f64> = (0..PAIRS).map(|_| 60.0 * uniform.draw().abs()).collect();
        // Far from the axis, so that lateral damping is small beside these soft springs.
        let radius_m: Vec<f64> = (0..PAIRS).map(|_| 1e3 + 200.0 * uniform.draw()).collect();
        let relaxation_s = 0.2 * damping_ratio;
        let omega_squared: Vec<f64> = omega.iter().map(|omega| omega * omega).collect();
        let modes = FreeModes {
            omega_squared: &omega_squared,
            normal: normal.as_ref(),
            sliding: sliding.as_ref(),
            load: &pressed,
        };
        let truncated =
            TruncatedResponse { normal: r_nn.as_ref(), sliding: r_nt.as_ref(), gap_per_load: &[0.0; PAIRS] };
        let statics = Statics::new(StaticsParts {
            law: law.0.clone(),
            area: vec![1.0; PAIRS],
            gap_m: gaps_m.clone(),
            response: StaticResponse::from_modes(&modes, Some(&truncated)).expect("well formed"),
            measured: MeasuredLoad::Back,
        });
        let data = json!({
            "name": format!("seed {seed}, {}", law.1["law"]), "law": law.1, "omega": omega,
            "damping_ratio": damping_ratio, "normal": rows(&normal), "sliding": rows(&sliding),
            "lateral": rows(&lateral), "pressed": pressed, "gaps_m": gaps_m, "radius_m": radius_m,
            "relaxation_s": vec![relaxation_s; PAIRS], "r_nn": rows(&r_nn), "r_nt": rows(&r_nt),
            "slope_s_per_m": friction.slope_s_per_m,
            "stribeck": friction.stribeck.map(|law| [law.drop, law.speed_m_s, law.exponent]), "lateral_damping": friction.lateral_damping,
        });
        let diagonal = |value: &dyn Fn(f64) -> f64| Term {
            matrix: Mat::from_fn(MODES, MODES, |i, j| if i == j { value(omega[i]) } else { 0.0 }),
            law: Law::Constant,
        };
        let stiffness = vec![diagonal(&|omega| omega * omega)];
        let damping = vec![diagonal(&|omega| 2.0 * damping_ratio * omega)];
        let free = Model::new(MODES, stiffness, damping, friction, Some(MODES / 2)).expect("well formed");
        let pairs = ContactPairs {
            normal,
            sliding,
            lateral,
            stiffness_n_per_m: vec![0.2; PAIRS],
            damping_n_s_per_m: vec![0.2 * relaxation_s; PAIRS],
            radius_m,
        };
        let residual = ResidualFlexibility { normal: r_nn, sliding: r_nt, inertia: None };
        let statics = Arc::new(statics.expect("well formed"));
        let model = free.clone().with_steady_contact(&pairs, statics, flexible.then_some(&residual));
        Self { data, model: model.expect("well formed"), free, pairs }
    }

    fn map(&self, p: &OperatingPoint) -> StabilityMap {
        let options =
            MapOptions { mu_min: 0.0, mu_max: 1.5, band_max_hz: None, instability_threshold: 1e-6, windows: true };
        StabilityMap::build(&self.model, &mut Solver::new(MODES), p, &options).expect("it can be mapped")
    }
}

const PLAIN: ContactLaw =
    ContactLaw { exponent: 0.0, reference_n: 500.0, slope_s_per_m: 0.0, stribeck: None, lateral_damping: false };
const FRICTION: ContactLaw = ContactLaw { slope_s_per_m: -1e-4, lateral_damping: true, ..PLAIN };
/// Pairs are 1 km from the axis: they slide with some 10 km/s.
const FALLING: ContactLaw =
    ContactLaw { stribeck: Some(Stribeck { drop: 1.0, speed_m_s: 1e4, exponent: 2.0 }), ..FRICTION };

fn point(normal_load_n: f64, disc_speed_rad_s: f64, friction_coefficient: f64) -> OperatingPoint {
    OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient }
}

fn solve(model: &Model, p: &OperatingPoint) -> Spectrum {
    Solver::new(MODES).solve(model, p, Vectors::Both).expect("it solves")
}

/// Whether a mode grows.
fn squeals(spectrum: &Spectrum) -> bool {
    spectrum.modes().iter().any(|root| root.is_unstable(1e-6))
}

/// A pair of conditions and what squealcast predicts there.
struct Case {
    input: Value,
    spectrum: Spectrum,
    merging: bool,
}

/// The power law with exponent 1.5 has a tangent like a square root where a pair opens: a closure known to 1e-16 of the
/// largest leaves 1e-8 of the tangent there, of a pair that carries 1e-12 of the force.
const TOLERANCE: f64 = 1e-9;

#[test]
fn scipy_finds_the_same_states_and_roots() {
    let python = python();
    if !program::python_has(&python, "numpy, scipy") {
        return;
    }
    let mut cases = vec![];
    for (k, law) in laws().iter().enumerate() {
        for seed in 0..6 {
            let seed = 10 * k as u64 + seed;
            let kind = seed % 3;
            let friction = match (kind, seed % 2) {
                (2, 0) => FALLING,
                (2, _) => FRICTION,
                _ => PLAIN,
            };
            let rig = Rig::new(seed, law, [0.0, 1e-2, 1e-2][kind as usize], seed % 2 == 1, friction);
            let mut points: Vec<(OperatingPoint, bool)> =
                [point(500.0, 13.0, 0.0), point(500.0, 13.0, 0.4), point(150.0, -13.0, 0.3), point(2000.0, 4.0, 0.6)]
                    .map(|p| (p, false))
                    .into();
            if kind == 0 {
                let p = point(500.0, 13.0, 0.0);
                let merging = |kind: WindowKind| kind == WindowKind::Coalescence;
                let map = rig.map(&p);
                for (window, (from, _)) in map.windows.iter().zip(&map.ends.windows) {
                    if merging(window.kind) && !from.is_jump() && window.mu_from > 0.0 {
                        points.push((p.with_friction(window.mu_from), true));
                    }
                }
            }
            for (p, merging) in points {
                let input = json!({
                    "data": rig.data, "load": p.normal_load_n, "speed": p.disc_speed_rad_s,
                    "mu": p.friction_coefficient,
                });
                cases.push(Case { input, spectrum: solve(&rig.model, &p), merging });
            }
        }
    }
    let folder = program::folder();
    let file = folder.path().join("cases.json");
    let inputs: Vec<&Value> = cases.iter().map(|case| &case.input).collect();
    std::fs::write(&file, serde_json::to_vec(&inputs).expect("JSON")).expect("it can be written");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/steady_states.py");
    let output = Command::new(&python).arg(script).arg(&file).output().expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    eprintln!("compared with {}", found["versions"]);

    let (mut force_off, mut root_off, mut open, mut merging) = (0.0f64, 0.0f64, 0, 0);
    for (case, expected) in cases.iter().zip(found["cases"].as_array().expect("cases")) {
        let at = format!("{} at {:?}", case.input["data"]["name"], case.spectrum.point);
        let state = case.spectrum.state.as_ref().expect("the contact is loaded");
        let forces: Vec<f64> = numbers(&expected["force_n"]);
        let largest = forces.iter().copied().fold(0.0, f64::max);
        for (found, expected) in state.force_n.iter().zip(&forces) {
            force_off = force_off.max((found - expected).abs() / largest);
        }
        let closed: Vec<f64> =
            (0..PAIRS).filter(|&pair| state.tangent_n_per_m[pair] > 0.0).map(|pair| pair as f64).collect();
        assert_eq!(closed, numbers(&expected["closed"]), "{at}");
        open += PAIRS - closed.len();
        let mut squares: Vec<c64> = expected["squares"]
            .as_array()
            .expect("roots")
            .iter()
            .map(|z| c64::new(numbers(z)[0], numbers(z)[1]))
            .collect();
        let roots: Vec<c64> = case.spectrum.modes().iter().map(|root| root.square).collect();
        if case.spectrum.undamped {
            // Python lists static roots too.
            squares.retain(|z| z.re < 0.0 || z.im != 0.0);
        }
        assert_eq!(roots.len(), squares.len(), "{at}: {roots:?}, {squares:?}");
        let near = if case.merging { nearest_two(&roots) } else { vec![] };
        let mut merged = vec![];
        for (k, root) in roots.iter().enumerate() {
            let off = |z: &c64| (z - root).norm();
            let nearest = (0..squares.len()).min_by(|&a, &b| off(&squares[a]).total_cmp(&off(&squares[b])));
            let other = squares.swap_remove(nearest.expect("as many roots"));
            if near.contains(&k) {
                merged.push([*root, other]);
            } else {
                let off = (other - root).norm() / root.norm();
                root_off = root_off.max(off);
                assert!(off < TOLERANCE, "{at}: {root} is not {other}, off by {off:e}");
            }
        }
        if let [first, second] = merged[..] {
            // Where two roots merge only their mean and the square of their difference are known.
            let [mean, expected] = [0, 1].map(|k| 0.5 * (first[k] + second[k]));
            assert!((mean - expected).norm() < TOLERANCE * mean.norm(), "{at}: {mean} is not {expected}");
            let half = 0.5 * (first[1] - second[1]);
            let discriminant = (half * half).norm() / mean.norm_sqr();
            assert!(discriminant < TOLERANCE, "{at}: discriminant {discriminant:e} where roots merge");
            merging += 1;
        }
    }
    eprintln!(
        "{} cases: forces off by {force_off:.1e}, roots by {root_off:.1e}; {open} pairs open, {merging} mergings",
        cases.len()
    );
    assert!(force_off < 1e-10, "{force_off:e}");
    assert!(cases.len() >= 120 && open > 100 && merging > 3, "{} cases, {open} open, {merging} mergings", cases.len());
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("numbers").iter().map(|x| x.as_f64().expect("a number")).collect()
}

/// The two roots nearest to each other.
fn nearest_two(roots: &[c64]) -> Vec<usize> {
    let pairs = (0..roots.len()).flat_map(|i| (0..i).map(move |j| [i, j]));
    let distance = |[i, j]: &[usize; 2]| (roots[*i] - roots[*j]).norm();
    pairs.min_by(|a, b| distance(a).total_cmp(&distance(b))).map(Vec::from).unwrap_or_default()
}

/// Which pairs are open decides whether a rig squeals: there are rigs with a growing mode at the state and none with all
/// pairs closed, and the reverse. Both models are checked against scipy above.
#[test]
fn the_contact_state_decides_whether_a_rig_squeals() {
    let law = &laws()[0];
    let (mut only_open, mut only_closed) = (0, 0);
    for seed in 0..60 {
        let rig = Rig::new(seed, law, 0.0, false, PLAIN);
        let closed = rig.free.clone().with_contact(&rig.pairs).expect("well formed");
        let p = point(500.0, 13.0, 0.5);
        let at_state = solve(&rig.model, &p);
        let open = PAIRS - at_state.state.as_ref().expect("the contact is loaded").pairs_closed();
        match (squeals(&at_state), squeals(&solve(&closed, &p))) {
            (true, false) => only_open += usize::from(open > 0),
            (false, true) => only_closed += usize::from(open > 0),
            (true, true) | (false, false) => {}
        }
    }
    eprintln!("{only_open} of 60 rigs squeal only with pairs open, {only_closed} only with all closed");
    assert!(only_open > 2 && only_closed > 2, "{only_open} {only_closed}");
}
