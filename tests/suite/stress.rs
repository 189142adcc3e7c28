//! Extremes for the numerics: every case of `proof::stress`, and random rigs compared with methods that need no eigenvalue solver.

use faer::{Mat, c64};
use proptest::prelude::*;
use squealcast::physics::{ContactLaw, Law, Model, OperatingPoint, Solver, Term, Vectors};
use squealcast::proof::stress::{Checked, cases, follow, scan};
use squealcast::proof::synthetic::{Synthetic, rig};

#[test]
fn every_extreme_comes_out_as_it_should() {
    let mut wrong = vec![];
    for case in cases() {
        match (case.run)() {
            Ok(said) => eprintln!("{}: {said}", case.what),
            Err(said) => wrong.push(format!("{}: {said}", case.what)),
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The paper's nine-degree-of-freedom models, friction coefficients 0 to 20.
#[test]
fn every_window_of_the_nine_dof_models_is_found_and_no_mode_changes_its_name() {
    for name in ["nine-dof", "nine-dof-case-2"] {
        let rig = squealcast::rig::Rig::load(name).expect("it is embedded");
        scan_and_follow(name, &rig.model, &rig.reference, 20.0, [100_000, 2000]);
    }
}

/// A synthetic rig of a tribometer's structure that squeals, half of its modes the pad's.
fn synthetic(modes: usize, pairs: usize, seed: u64) -> Model {
    let contact_law = ContactLaw::default();
    rig(&Synthetic { modes, pairs, damping_ratio: 0.0, contact_law, seed }).expect("the rig is well formed")
}

const AT: OperatingPoint = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.0 };

fn scan_and_follow(name: &str, model: &Model, at: &OperatingPoint, mu_max: f64, [points, steps]: [usize; 2]) {
    let said = scan(model, at, mu_max, points).and_then(|windows| Ok((windows, follow(model, at, mu_max, steps)?)));
    let (windows, modes) = said.unwrap_or_else(|said| panic!("{name}: {said}"));
    eprintln!("{name}: {windows}; {modes}");
}

#[test]
fn no_mode_of_40_changes_its_name() {
    let said = follow(&synthetic(40, 48, 7), &AT, 1.0, 500);
    eprintln!("{}", said.unwrap_or_else(|said| panic!("{said}")));
}

/// The tribometer on its basis and in 80 + 80 modes, friction coefficients from 0 to 1: 1000, or 100 000 and many minutes with
/// `SQUEALCAST_MEASURE`.
#[test]
fn every_window_of_the_tribometer_is_found_and_no_mode_changes_its_name() {
    let count = if std::env::var_os("SQUEALCAST_MEASURE").is_some() { [100_000, 500] } else { [1000, 500] };
    for name in ["tribometer", "tribometer-80+80"] {
        let rig = squealcast::rig::Rig::load(name).expect("it is embedded");
        scan_and_follow(name, &rig.model, &rig.reference, 1.0, count);
    }
}

/// `Σ zᵢ^m = tr(A^m)` for `m` up to the dimension determines every eigenvalue (Newton's identities), and powers of a matrix need no
/// eigenvalue solver.
fn power_sums_agree(matrix: &Mat<f64>, roots: &[c64]) {
    let n = matrix.nrows();
    let size = matrix.norm_l2();
    let mut power = Mat::<f64>::identity(n, n);
    for m in 1..=n {
        power = &power * matrix;
        let trace: f64 = (0..n).map(|i| power[(i, i)]).sum();
        let sum: c64 = roots.iter().map(|z| z.powi(m as i32)).sum();
        // A backward error of some ε‖A‖ moves a trace of m factors by m ‖A‖^(m-1) times that; the products round likewise.
        let limit = 64.0 * (n * m) as f64 * f64::EPSILON * size.powi(m as i32);
        assert!((sum - trace).norm() <= limit, "power {m}: {sum} is not {trace}, limit {limit:e}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_rigs(n in 2usize..9, entries in prop::collection::vec(-1.0f64..1.0, 128), exponents in prop::collection::vec(-3.0f64..3.0, 8), damped: bool) {
        let diagonal = |i: usize| 10f64.powf(0.5 * exponents[i]);
        let stiffness =
            Mat::from_fn(n, n, |i, j| if i == j { diagonal(i) } else { 0.3 * entries[8 * i + j] * (diagonal(i) * diagonal(j)).sqrt() });
        let damping = Mat::from_fn(n, n, |i, j| if damped { 0.1 * entries[64 + 8 * i.min(j) + i.max(j)] } else { 0.0 });
        let term = |matrix: &Mat<f64>| Term { matrix: matrix.clone(), law: Law::Constant };
        let model = Model::new(n, vec![term(&stiffness)], vec![term(&damping)], ContactLaw::default(), None).unwrap();
        let p = OperatingPoint { normal_load_n: 1.0, disc_speed_rad_s: 1.0, friction_coefficient: 0.0 };
        Checked::default().solve(&model, &p).map_err(TestCaseError::fail)?;
        for vectors in [Vectors::None, Vectors::Both] {
            let spectrum = Solver::new(n).solve(&model, &p, vectors).unwrap();
            if spectrum.undamped {
                power_sums_agree(&stiffness, &spectrum.roots.iter().map(|root| -root.square).collect::<Vec<_>>());
            } else {
                // The companion form without scaling.
                let state = Mat::from_fn(2 * n, 2 * n, |i, j| match (i < n, j < n) {
                    (true, _) => if j == n + i { 1.0 } else { 0.0 },
                    (false, true) => -stiffness[(i - n, j)],
                    (false, false) => -damping[(i - n, j - n)],
                });
                let (modes, statics) = spectrum.roots.split_at(spectrum.mode_count);
                let conjugates = modes.iter().flat_map(|root| [root.lambda, root.lambda.conj()]);
                let all: Vec<c64> = conjugates.chain(statics.iter().map(|root| root.lambda)).collect();
                power_sums_agree(&state, &all);
            }
        }
    }
}
