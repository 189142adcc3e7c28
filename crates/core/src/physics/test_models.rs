//! Small models with known answers, shared by the tests of this folder.

use faer::{Mat, Side, mat};

use super::law::{ContactLaw, Law};
use super::model::{ContactPairs, Model, Term};
use super::operating_point::OperatingPoint;
use crate::proof::synthetic::Uniform;

pub const REFERENCE: OperatingPoint =
    OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.35 };

fn constant(matrix: Mat<f64>) -> Term {
    Term { matrix, law: Law::Constant }
}

/// The paper's 9-degree-of-freedom slider on a belt, with all modes kept. `m` is the belt mass, `k` the stiffness of
/// the belt springs in `y`, `kc` that of the contact springs. Case 1 is (1, 1, 1), case 2 is (2, 2, 5).
pub fn nine_dof(m: f64, k: f64, kc: f64) -> Model {
    let mut stiffness = Mat::<f64>::zeros(9, 9);
    let slider = mat![
        [2.0, -1.0, 0.0, 0.0, 0.0, 0.0],
        [-1.0, 3.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, 0.0, 2.0, 0.0, 0.0, -1.0],
        [0.0, -1.0, 0.0, 2.5, 0.5, 0.0],
        [0.0, 0.0, 0.0, 0.5, 1.5, 0.0],
        [0.0, 0.0, -1.0, 0.0, 0.0, 2.0],
    ];
    stiffness.get_mut(..6, ..6).copy_from(&slider);
    (stiffness[(6, 6)], stiffness[(7, 7)], stiffness[(8, 8)]) = (1.0, k, k);
    let mut mass = Mat::<f64>::identity(9, 9);
    let j = m / 12.0;
    mass[(6, 6)] = m;
    (mass[(7, 7)], mass[(8, 8)]) = (0.25 * (m + j), 0.25 * (m + j));
    (mass[(7, 8)], mass[(8, 7)]) = (0.25 * (m - j), 0.25 * (m - j));
    // Contact rows with `n = -y` and `t = +x`; pad minus disc.
    let belt = |l: f64| (0.5 * (1.0 + l), 0.5 * (1.0 - l));
    let mut normal = Mat::<f64>::zeros(2, 9);
    let mut sliding = Mat::<f64>::zeros(2, 9);
    for (pair, (x, y, l)) in [(1, 2, 0.5), (3, 4, -0.5)].into_iter().enumerate() {
        (normal[(pair, y)], normal[(pair, 7)], normal[(pair, 8)]) = (-1.0, belt(l).0, belt(l).1);
        (sliding[(pair, x)], sliding[(pair, 6)]) = (1.0, -1.0);
    }
    // Mass-normalised coordinates: `M = L Lᵀ`, `x = L⁻ᵀ q`.
    let factor = mass.llt(Side::Lower).expect("the mass is positive definite");
    let mut to_q = Mat::<f64>::identity(9, 9);
    faer::linalg::triangular_solve::solve_lower_triangular_in_place(factor.L(), to_q.as_mut(), faer::Par::Seq);
    let product = &to_q * &stiffness * to_q.transpose();
    let stiffness = Mat::from_fn(9, 9, |i, j| product[(i.min(j), i.max(j))]);
    let pairs = ContactPairs {
        normal: &normal * to_q.transpose(),
        sliding: &sliding * to_q.transpose(),
        lateral: Mat::zeros(2, 9),
        stiffness_n_per_m: vec![kc; 2],
        damping_n_s_per_m: vec![0.0; 2],
        radius_m: vec![0.0; 2],
    };
    let model = Model::new(9, vec![constant(stiffness)], vec![], ContactLaw::default(), Some(6));
    model.and_then(|model| model.with_contact(&pairs)).expect("the model is well formed")
}

/// Hultén's two-degree-of-freedom model: `K = [[ω1², -μω2²], [μω1², ω2²]]`, `C = diag(η1 ω1, η2 ω2)`, 100 and 75 Hz.
pub fn hulten(eta_1: f64, eta_2: f64) -> Model {
    let (w1, w2) = (100.0 * std::f64::consts::TAU, 75.0 * std::f64::consts::TAU);
    let diagonal = mat![[w1 * w1, 0.0], [0.0, w2 * w2]];
    let friction = Term { matrix: mat![[0.0, -w2 * w2], [w1 * w1, 0.0]], law: Law::FrictionStiffness };
    let damping = constant(mat![[eta_1 * w1, 0.0], [0.0, eta_2 * w2]]);
    Model::new(2, vec![constant(diagonal), friction], vec![damping], ContactLaw::default(), None)
        .expect("the model is well formed")
}

/// A random pad and disc with `n` modes and `pairs` contact pairs. The disc modes are doublets; `damping` is the
/// damping ratio of every mode.
pub fn random_rig(seed: u64, n: usize, pairs: usize, damping: f64) -> Model {
    let mut uniform = Uniform::new(seed);
    let pad = n / 2;
    let mut omega: Vec<f64> = (0..n).map(|_| 1.0 + 4.0 * uniform.draw().abs()).collect();
    for doublet in (pad..n.saturating_sub(1)).step_by(2) {
        omega[doublet + 1] = omega[doublet] * (1.0 + 1e-3 * uniform.draw());
    }
    let mut rows = || Mat::from_fn(pairs, n, |_, _| uniform.draw());
    let (normal, sliding) = (rows(), rows());
    let diagonal =
        |value: &dyn Fn(f64) -> f64| constant(Mat::from_fn(n, n, |i, j| if i == j { value(omega[i]) } else { 0.0 }));
    let contact = ContactPairs {
        normal,
        sliding,
        lateral: Mat::zeros(pairs, n),
        stiffness_n_per_m: vec![0.6; pairs],
        damping_n_s_per_m: vec![0.2 * damping; pairs],
        radius_m: vec![0.1; pairs],
    };
    let stiffness = vec![diagonal(&|w| w * w)];
    let damping = vec![diagonal(&|w| 2.0 * damping * w)];
    let model = Model::new(n, stiffness, damping, ContactLaw::default(), Some(pad));
    model.and_then(|model| model.with_contact(&contact)).expect("the model is well formed")
}
