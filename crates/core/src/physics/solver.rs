//! Complex eigenvalues of `(λ² I + λ C + K) x = 0`, by the cheapest exact eigenvalue problem, with a residual for
//! each root.
//!
//! | situation | problem solved | roots |
//! |---|---|---|
//! | undamped, `K` symmetric | `K x = -λ² x`, symmetric, `n×n` | `λ² = -κ` |
//! | undamped | `K x = -λ² x`, unsymmetric, `n×n` | `λ² = -κ`; a complex pair `κ` gives a growing and a decaying mode |
//! | damped | `[0 S; -K S⁻¹ -C]`, `S = diag(√K_ii)`, `2n×2n` | `λ` |
//!
//! The scaling by `S` is not optional: without it the state-space roots lose half their digits.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par, c64};

use super::dense_eigen::{Dense, Packed, Packing, packing};
use super::model::Model;
use super::operating_point::OperatingPoint;
use super::spectrum::{Root, RootError, SolveError, Spectrum, Vectors, order, square_root};
use super::steady_contact::Situation;

/// Residual above which a root is rejected.
pub const RESIDUAL_LIMIT: f64 = 1e-9;

/// Assumed backward error of the dense solvers, in units of `ε` times the Frobenius norm of the matrix. It exceeds
/// every observed error; the tests of the error bounds check it.
pub const ROUNDING: f64 = 8.0;

/// Workspace that computes the spectra of one model, allocated once.
pub struct Solver {
    stiffness: Mat<f64>,
    damping: Mat<f64>,
    stiffness_slope: Mat<f64>,
    damping_slope: Mat<f64>,
    state: Mat<f64>,
    dense: Dense,
    /// Displacement part of the right vectors, packed.
    shapes: Mat<f64>,
    /// `K X`, `C X`, `dK/dμ X` and `dC/dμ X`, packed. One matrix product each is far cheaper than a product for each
    /// root.
    products: [Mat<f64>; 4],
}

/// The eigenvalue problem that is solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Problem {
    Symmetric,
    Undamped,
    Damped,
}

impl Problem {
    /// Whether the eigenvalues are roots `λ` of the state space, `2n×2n`; otherwise they are `-λ²` of `K`, `n×n`.
    fn is_damped(self) -> bool {
        match self {
            Self::Damped => true,
            Self::Symmetric | Self::Undamped => false,
        }
    }

    /// Whether the left vectors are the right ones.
    fn is_symmetric(self) -> bool {
        match self {
            Self::Symmetric => true,
            Self::Undamped | Self::Damped => false,
        }
    }
}

/// A root before sorting, with the columns of its vectors.
struct Raw {
    root: Root,
    packing: Packing,
    /// `‖x‖`.
    length: f64,
    left: Option<Left>,
}

/// Quantities of a root that need its left vector.
#[derive(Clone, Copy)]
struct Left {
    /// `yᴴx`; in a damped model `yᴴ(2λ I + C)x`.
    weight: c64,
    /// `d(λ²)/dμ`.
    sensitivity: c64,
    /// Condition number of the eigenvalue in the problem that was solved, `‖y‖‖x‖ / |yᴴx|`.
    condition: f64,
}

impl Solver {
    /// A solver for models of `dimension` coordinates.
    pub fn new(dimension: usize) -> Self {
        let square = || Mat::zeros(dimension, dimension);
        Self {
            stiffness: square(),
            damping: square(),
            stiffness_slope: square(),
            damping_slope: square(),
            state: Mat::new(),
            dense: Dense::new(),
            shapes: Mat::new(),
            products: [const { Mat::new() }; 4],
        }
    }

    /// The spectrum of `model` at `p`. Uncoupled coordinates are solved in closed form, outside the eigenvalue
    /// problem: see `physics::decoupled`.
    ///
    /// # Errors
    /// [`SolveError::Model`] if the model cannot be evaluated at `p`; [`SolveError::NoConvergence`];
    /// [`SolveError::Trace`] and [`SolveError::Residual`] if the result fails a check.
    pub fn solve(&mut self, model: &Model, p: &OperatingPoint, vectors: Vectors) -> Result<Spectrum, SolveError> {
        self.solve_in(model, &model.at(p)?, vectors)
    }

    /// The spectrum of `model` in the situation `here`, of this model or of another one with the same statics.
    ///
    /// # Errors
    /// Those of [`Self::solve`].
    pub(crate) fn solve_in(
        &mut self,
        model: &Model,
        here: &Situation,
        vectors: Vectors,
    ) -> Result<Spectrum, SolveError> {
        let damped = model.is_damped(&here.point);
        match &model.division {
            None => self.solve_coupled(model, here, vectors, damped),
            Some(division) => {
                let coupled = self.solve_coupled(&division.coupled, here, vectors, damped)?;
                division.complete(model, coupled, vectors)
            }
        }
    }

    /// The spectrum of `model` as one eigenvalue problem. `damped` selects the state-space form, even if the damping
    /// of these coordinates is zero.
    pub(super) fn solve_coupled(
        &mut self,
        model: &Model,
        here: &Situation,
        vectors: Vectors,
        damped: bool,
    ) -> Result<Spectrum, SolveError> {
        if self.stiffness.nrows() != model.dimension() {
            *self = Self::new(model.dimension());
        }
        let values = [&mut self.stiffness, &mut self.damping];
        let structure = if vectors == Vectors::Both {
            let slopes = [&mut self.stiffness_slope, &mut self.damping_slope];
            model.assemble_with_friction_slopes(here, values, slopes)?
        } else {
            let [stiffness, damping] = values;
            model.assemble_at(here, stiffness, damping)?
        };
        let stiffness_norm = self.stiffness.norm_l2();
        let (problem, matrix_norm) = if damped {
            self.assemble_state();
            (Problem::Damped, self.state.norm_l2())
        } else if structure.symmetric_stiffness {
            (Problem::Symmetric, stiffness_norm)
        } else {
            (Problem::Undamped, stiffness_norm)
        };
        match problem {
            Problem::Symmetric => self.dense.symmetric_eigen(self.stiffness.as_ref(), vectors)?,
            Problem::Undamped => self.dense.eigen(self.stiffness.as_ref(), matrix_norm, vectors)?,
            Problem::Damped => self.dense.eigen(self.state.as_ref(), matrix_norm, vectors)?,
        }
        let mut raw = self.roots(problem, stiffness_norm, matrix_norm);
        if vectors != Vectors::None {
            self.multiply(problem, vectors);
            self.judge(&mut raw, problem, stiffness_norm, model)?;
        }
        if vectors == Vectors::Both {
            self.read_left(&mut raw, problem);
        }
        raw.sort_by(|a, b| order(&a.root, &b.root));
        bound_errors(&mut raw, problem.is_damped(), matrix_norm);
        let (shapes, left) = self.vectors(&raw, problem);
        Ok(Spectrum {
            point: here.point,
            state: here.state.clone(),
            mode_count: raw.iter().filter(|r| r.root.oscillates()).count(),
            undamped: !problem.is_damped(),
            matrix_norm,
            shapes,
            left,
            friction_sensitivity: raw.iter().filter_map(|r| r.left.map(|left| left.sensitivity)).collect(),
            roots: raw.into_iter().map(|r| r.root).collect(),
        })
    }

    /// The matrix whose eigenvalues gave `spectrum`, as left by the last solve, for the coupled coordinates only.
    /// Undamped: `K`, whose eigenvalues are `-λ²`. Damped: the scaled state matrix.
    pub fn matrix(&self, spectrum: &Spectrum) -> MatRef<'_, f64> {
        if spectrum.undamped { self.stiffness.as_ref() } else { self.state.as_ref() }
    }

    /// Left vectors of the problem that was solved, packed; for a symmetric problem these are the right vectors.
    fn left_vectors(&self, problem: Problem) -> &Mat<f64> {
        if problem.is_symmetric() { &self.dense.right } else { &self.dense.left }
    }

    /// Writes the state matrix `[0 S; -K S⁻¹ -C]`.
    fn assemble_state(&mut self) {
        let n = self.stiffness.nrows();
        if self.state.nrows() != 2 * n {
            self.state = Mat::zeros(2 * n, 2 * n);
        }
        for (j, s) in displacement_scale(self.stiffness.as_ref()).into_iter().enumerate() {
            self.state[(j, n + j)] = s;
            let stiffness = self.stiffness.col_as_slice(j);
            let below = &mut self.state.col_as_slice_mut(j)[n..];
            below.iter_mut().zip(stiffness).for_each(|(out, k)| *out = -k / s);
            let damping = self.damping.col_as_slice(j);
            let below = &mut self.state.col_as_slice_mut(n + j)[n..];
            below.iter_mut().zip(damping).for_each(|(out, c)| *out = -c);
        }
    }

    /// Converts eigenvalues to roots; of a conjugate pair of a damped model, only the root with `ω ≥ 0` is kept.
    fn roots(&self, problem: Problem, stiffness_norm: f64, matrix_norm: f64) -> Vec<Raw> {
        let rounding = 16.0 * self.stiffness.nrows() as f64 * f64::EPSILON;
        // `|λ²|` up to which a root is set to zero. Rounding splits a double root at the origin into `±√(rounding)`,
        // whose square is zero up to rounding.
        let mut zero = rounding * stiffness_norm;
        let near_origin = self.dense.values.iter().filter(|value| value.norm_sqr() <= zero).count();
        if problem.is_damped() && near_origin == 1 {
            // A simple root near the origin, as where a static root crosses zero, is much more accurate.
            zero = (rounding * matrix_norm).powi(2);
        }
        let mut raw = Vec::with_capacity(self.stiffness.nrows() + 8);
        for (&value, packing) in self.dense.values.iter().zip(packing(&self.dense.values)) {
            let (lambda, square) = match problem {
                Problem::Damped if value.im < 0.0 => continue, // represented by its conjugate
                Problem::Damped => (value, value * value),
                // The subtraction from zero turns the -0 of a real root into 0.
                Problem::Symmetric | Problem::Undamped => (square_root(c64::ZERO - value), c64::ZERO - value),
            };
            let lambda = if square.norm() <= zero { c64::ZERO } else { lambda };
            let (residual, pad_participation) = (f64::NAN, f64::NAN);
            let root = Root { lambda, square, residual, pad_participation, error: RootError::UNKNOWN };
            raw.push(Raw { root, packing, length: f64::NAN, left: None });
        }
        raw
    }

    /// Extracts the displacements of the right vectors and multiplies them by the matrices.
    fn multiply(&mut self, problem: Problem, vectors: Vectors) {
        let n = self.stiffness.nrows();
        let damped = problem.is_damped();
        let columns = self.dense.right.ncols();
        if self.shapes.ncols() != columns {
            self.shapes = Mat::zeros(n, columns);
            self.products = std::array::from_fn(|_| Mat::zeros(n, columns));
        }
        if damped {
            let scale = displacement_scale(self.stiffness.as_ref());
            for packing in packing(&self.dense.values) {
                let state = Packed::new(&self.dense.right, packing);
                let (displacement, velocity) = (state.rows(..n), state.rows(n..));
                // `x` is taken from the larger half of the state `[S x; λ x]`.
                let from_velocity = velocity.norm_sqr() >= displacement.norm_sqr();
                for j in std::iter::once(packing.re).chain(packing.im) {
                    let state = self.dense.right.col_as_slice(j);
                    let shape = self.shapes.col_as_slice_mut(j);
                    if from_velocity {
                        shape.copy_from_slice(&state[n..]);
                    } else {
                        shape.iter_mut().zip(state).zip(&scale).for_each(|((x, q), s)| *x = q / s);
                    }
                }
            }
        } else {
            self.shapes.copy_from(&self.dense.right);
        }
        let with_left = vectors == Vectors::Both;
        let matrices = [
            (&self.stiffness, true),
            (&self.damping, damped),
            (&self.stiffness_slope, with_left),
            (&self.damping_slope, with_left && damped),
        ];
        for ((matrix, needed), product) in matrices.into_iter().zip(&mut self.products) {
            if needed {
                matmul(product, Accum::Replace, matrix, &self.shapes, 1.0, Par::Seq);
            }
        }
    }

    /// Computes residual and pad participation of every root, and fails if a residual exceeds its limit.
    fn judge(&self, raw: &mut [Raw], problem: Problem, stiffness_norm: f64, model: &Model) -> Result<(), SolveError> {
        let n = self.stiffness.nrows();
        let of_pad = model.pad_mass().map(|mass| mass * &self.shapes);
        let damped = problem.is_damped();
        let damping_norm = if damped { self.damping.norm_l2() } else { 0.0 };
        for (j, entry) in raw.iter_mut().enumerate() {
            let [x, kx, cx] =
                [&self.shapes, &self.products[0], &self.products[1]].map(|m| Packed::new(m, entry.packing));
            let size = x.norm_sqr();
            let weight = |root: &Root| {
                root.square.norm() * (n as f64).sqrt() + root.lambda.norm() * damping_norm + stiffness_norm
            };
            let off = |root: &Root, i: usize| {
                let r = root.square * x.at(i) + kx.at(i);
                if damped { r + root.lambda * cx.at(i) } else { r }
            };
            let residual_of = |root: &Root| {
                let off: f64 = (0..n).map(|i| off(root, i).norm_sqr()).sum();
                if off == 0.0 { 0.0 } else { off.sqrt() / (weight(root) * size.sqrt()) }
            };
            let mut residual = residual_of(&entry.root);
            if damped && residual > RESIDUAL_LIMIT {
                // Near the origin the state space loses relative accuracy. One Gauss-Newton step for the given shape
                // restores it.
                let slope = |i: usize| 2.0 * entry.root.lambda * x.at(i) + cx.at(i);
                let along: c64 = (0..n).map(|i| slope(i).conj() * off(&entry.root, i)).sum();
                let lambda = entry.root.lambda - along / (0..n).map(|i| slope(i).norm_sqr()).sum::<f64>();
                let refined = Root { lambda, square: lambda * lambda, ..entry.root };
                let refined_residual = residual_of(&refined);
                if refined_residual < residual {
                    (entry.root, residual) = (refined, refined_residual);
                }
            }
            if residual.is_nan() || residual > RESIDUAL_LIMIT {
                let frequency_hz = entry.root.frequency_hz();
                return Err(SolveError::Residual { root: j, frequency_hz, residual, limit: RESIDUAL_LIMIT });
            }
            entry.root.residual = residual;
            entry.length = size.sqrt();
            entry.root.pad_participation = match (&of_pad, model.pad_modes()) {
                (Some(of_pad), _) => (x.dot(Packed::new(of_pad, entry.packing)).re / size).clamp(0.0, 1.0),
                (None, Some(pad_modes)) => x.rows(..pad_modes.min(n)).norm_sqr() / size,
                (None, None) => f64::NAN,
            };
        }
        Ok(())
    }

    /// Computes weight, friction sensitivity and condition number of every root from its left vector.
    fn read_left(&self, raw: &mut [Raw], problem: Problem) {
        let n = self.stiffness.nrows();
        for entry in raw {
            let packed = |m| Packed::new(m, entry.packing);
            let (state, whole) = (packed(&self.dense.right), packed(self.left_vectors(problem)));
            let [cx, slope_kx, slope_cx] = [1, 2, 3].map(|k| packed(&self.products[k]));
            let product = whole.dot(state);
            let condition = if problem.is_symmetric() { 1.0 } else { whole.norm() * state.norm() / product.norm() };
            entry.left = Some(if problem.is_damped() {
                let (y, lambda) = (whole.rows(n..), entry.root.lambda);
                let weight = 2.0 * lambda * y.dot(packed(&self.shapes)) + y.dot(cx);
                let change = lambda * y.dot(slope_cx) + y.dot(slope_kx);
                Left { weight, sensitivity: -2.0 * lambda * change / weight, condition }
            } else {
                Left { weight: product, sensitivity: -whole.dot(slope_kx) / product, condition }
            });
        }
    }

    /// Right and left vectors in the order of `raw`, scaled as documented in [`Spectrum`].
    fn vectors(&self, raw: &[Raw], problem: Problem) -> (Mat<c64>, Mat<c64>) {
        let n = self.stiffness.nrows();
        let known = raw.iter().filter(|entry| !entry.length.is_nan()).count();
        let with_left = raw.iter().filter(|entry| entry.left.is_some()).count();
        let (mut shapes, mut left) = (Mat::zeros(n, known), Mat::zeros(n, with_left));
        for (j, entry) in raw.iter().enumerate().take(known) {
            let x = Packed::new(&self.shapes, entry.packing);
            let share = entry.length.recip();
            shapes.col_as_slice_mut(j).iter_mut().enumerate().for_each(|(i, out)| *out = share * x.at(i));
            let Some(Left { weight, .. }) = entry.left else { continue };
            let whole = Packed::new(self.left_vectors(problem), entry.packing);
            let y = if problem.is_damped() { whole.rows(n..) } else { whole };
            let share = entry.length / weight.conj();
            left.col_as_slice_mut(j).iter_mut().enumerate().for_each(|(i, out)| *out = share * y.at(i));
        }
        (shapes, left)
    }
}

/// `S`: scale of the displacements in the state, which makes them as large as the velocities, rad/s.
///
/// `√|K_ii|`, at least 1e-6 of the largest: without this limit a free coordinate would give a huge column of `K S⁻¹`.
pub(super) fn displacement_scale(stiffness: MatRef<'_, f64>) -> Vec<f64> {
    let diagonal = || (0..stiffness.nrows()).map(|i| stiffness[(i, i)].abs().sqrt());
    let largest = diagonal().fold(0.0, f64::max);
    if largest == 0.0 {
        return vec![1.0; stiffness.nrows()];
    }
    diagonal().map(|s| s.max(1e-6 * largest)).collect()
}

/// Bounds the error of every root whose left vector is known, from its condition number and the gaps to its
/// neighbours.
///
/// A backward stable solver returns the exact eigenvalues of a matrix perturbed by `E`; to first order a root then
/// moves by `κ E`. Where `m` roots approach each other, `κ` grows like the inverse product of the gaps between them.
/// The error is then of the order of the `m`-th root of `κ E g₁ … g₍ₘ₋₁₎`: half of the digits are left at a merging
/// point of two modes, a third where three merge.
fn bound_errors(raw: &mut [Raw], damped: bool, matrix_norm: f64) {
    let backward_error = ROUNDING * f64::EPSILON * matrix_norm;
    // The solver does not resolve smaller gaps, and neither does a condition number computed from its vectors.
    let least_gap = f64::EPSILON * matrix_norm;
    let values: Vec<c64> = raw.iter().map(|raw| if damped { raw.root.lambda } else { raw.root.square }).collect();
    for (k, entry) in raw.iter_mut().enumerate() {
        let Some(left) = entry.left else { continue };
        let z = values[k];
        // In a damped model the complex conjugate is a neighbour too.
        let mirror = if damped && z.im != 0.0 { 4.0 * z.im * z.im } else { f64::INFINITY };
        let mut gaps = [mirror, f64::INFINITY, f64::INFINITY];
        for (j, other) in values.iter().enumerate() {
            let mut gap = if j == k { f64::INFINITY } else { (other - z).norm_sqr() };
            for kept in &mut gaps {
                if gap < *kept {
                    std::mem::swap(kept, &mut gap);
                }
            }
        }
        let gaps = gaps.map(|gap| gap.sqrt().max(least_gap));
        let mut product = 2.0 * left.condition * backward_error;
        let mut error = product;
        for (together, gap) in (2..).zip(gaps) {
            product *= gap;
            let power = f64::from(together);
            error = error.min(power * product.powf(power.recip()));
        }
        // Left and right vector are orthogonal up to rounding: the condition number only shows that roots have
        // merged.
        let error = if error.is_finite() { error } else { 4.0 * matrix_norm * f64::EPSILON.powf(0.25) };
        let error = error.max(backward_error);
        entry.root.error = if damped {
            RootError::from_lambda(entry.root.lambda, error)
        } else {
            RootError::from_square(entry.root.lambda, error, z.im == 0.0 && 2.0 * error < gaps[0])
        };
    }
}

#[cfg(test)]
mod tests {
    use faer::mat;

    use super::super::law::{ContactLaw, Law};
    use super::super::model::Term;
    use super::super::test_models::{REFERENCE, nine_dof};
    use super::*;

    fn solve(model: &Model, mu: f64) -> Spectrum {
        Solver::new(model.dimension()).solve(model, &REFERENCE.with_friction(mu), Vectors::Right).expect("it solves")
    }

    /// Expected values: 30-digit arithmetic on the matrices of the paper's 9-degree-of-freedom model, case 1, printed
    /// to 10 digits.
    #[test]
    fn nine_dof_frequencies() {
        let at_rest = [
            1.0,
            1.030686177,
            1.101320323,
            1.324675571,
            1.563283353,
            1.781280315,
            2.030436593,
            2.238727073,
            5.497147271,
        ];
        let sliding =
            [1.0, 1.072048036, 1.072048036, 1.380851129, 1.569768144, 1.77178793, 1.999133465, 2.23128655, 5.496957816];
        let model = nine_dof(1.0, 1.0, 1.0);
        for (mu, expected) in [(0.0, at_rest), (1.0, sliding)] {
            let spectrum = solve(&model, mu);
            assert_eq!(spectrum.mode_count, 9);
            for (root, omega) in spectrum.modes().iter().zip(expected) {
                // Tolerance: half a unit of the last printed digit.
                assert!((root.lambda.im - omega).abs() < 0.6e-9 * omega.max(1.0), "{} is not {omega}", root.lambda.im);
            }
        }
        let unstable = solve(&model, 1.0);
        assert!((unstable.roots[1].lambda.re - 0.0149638).abs() < 1e-7);
        assert!((unstable.roots[2].lambda.re + 0.0149638).abs() < 1e-7);
        assert!(unstable.modes().iter().all(|r| (0.0..=1.0).contains(&r.pad_participation)));
    }

    fn one(stiffness: f64, damping: f64) -> Model {
        let term = |value: f64| Term { matrix: mat![[value]], law: Law::Constant };
        Model::new(1, vec![term(stiffness)], vec![term(damping)], ContactLaw::default(), None).expect("well formed")
    }

    /// Two masses on two springs, with the stiffness scaled over 24 decades: `ω² = k (3 ± √5)/2`.
    #[test]
    fn symmetric_route_is_independent_of_scale() {
        for k in [1e-12, 1e-6, 1.0, 1e6, 1e12] {
            let matrix = mat![[2.0 * k, -k], [-k, k]];
            let term = Term { matrix, law: Law::Constant };
            let model = Model::new(2, vec![term], vec![], ContactLaw::default(), None).unwrap();
            let spectrum = solve(&model, 0.0);
            for (root, sign) in spectrum.modes().iter().zip([-1.0, 1.0]) {
                let expected = -k * 0.5 * (3.0 + sign * 5.0f64.sqrt());
                assert!((root.square.re / expected - 1.0).abs() < 1e-14, "{k}: {} is not {expected}", root.square.re);
            }
        }
    }

    /// `λ² + c λ + k = 0` solved by hand: underdamped, overdamped, free and divergent.
    #[test]
    fn single_degree_of_freedom() {
        let under = solve(&one(25.0, 6.0), 0.0);
        assert!((under.roots[0].lambda - c64::new(-3.0, 4.0)).norm() < 1e-14);
        assert!((under.roots[0].damping_ratio() - 0.6).abs() < 1e-15);
        assert_eq!(under.roots.len(), 1, "one root stands for a conjugate pair");
        let over = solve(&one(4.0, 5.0), 0.0);
        assert_eq!(over.mode_count, 0);
        let growth = over.nonoscillatory_growth_per_s();
        assert!((growth[0] + 1.0).abs() < 1e-14 && (growth[1] + 4.0).abs() < 1e-14, "{growth:?}");
        assert_eq!(solve(&one(0.0, 0.0), 0.0).nonoscillatory_growth_per_s(), vec![0.0, 0.0]);
        assert_eq!(solve(&one(-9.0, 0.0), 0.0).nonoscillatory_growth_per_s(), vec![3.0, -3.0]);
    }

    /// Proportional damping: the roots of `λ² + β λ + ω² = 0` for every undamped `ω²`, complex ones included.
    #[test]
    fn damped_route_agrees_with_closed_form() {
        let model = nine_dof(1.0, 1.0, 1.0);
        let undamped = solve(&model, 0.5);
        let beta = 1e-2;
        let (mut stiffness, mut none) = (Mat::zeros(9, 9), Mat::zeros(9, 9));
        model.assemble(&REFERENCE.with_friction(0.5), &mut stiffness, &mut none).unwrap();
        let constant = |matrix| Term { matrix, law: Law::Constant };
        let damping = constant(Mat::<f64>::identity(9, 9) * faer::Scale(beta));
        let damped = Model::new(9, vec![constant(stiffness)], vec![damping], ContactLaw::default(), None);
        let damped = solve(&damped.unwrap(), 0.5);
        for (a, b) in undamped.modes().iter().zip(damped.modes()) {
            let oscillation = (a.square + 0.25 * beta * beta).sqrt();
            let expected = oscillation * oscillation.im.signum() - 0.5 * beta;
            assert!((b.lambda - expected).norm() < 1e-12 * expected.norm(), "{} is not {expected}", b.lambda);
        }
    }

    /// A falsified eigenvector is rejected by its residual. A falsified eigenvalue is rejected by the traces if no
    /// vectors are requested.
    #[test]
    fn a_falsified_solution_is_rejected() {
        use crate::spoil::{Spoil, with};
        let (model, mut solver) = (nine_dof(1.0, 1.0, 1.0), Solver::new(9));
        let mut solve =
            |vectors| solver.solve(&model, &REFERENCE.with_friction(0.5), vectors).map(|found| found.mode_count);
        for vectors in [Vectors::Right, Vectors::Both] {
            let found = with(Spoil::Vector, || solve(vectors));
            let Err(SolveError::Residual { residual, limit, .. }) = found else { panic!("{found:?}") };
            assert!(residual > limit && limit == RESIDUAL_LIMIT);
        }
        let found = with(Spoil::Value, || solve(Vectors::None));
        assert!(matches!(found, Err(SolveError::Trace { power: 1, .. })), "{found:?}");
        assert_eq!(solve(Vectors::None), Ok(9));
    }

    /// Finite terms whose sum overflows: every kind of problem fails, with and without vectors.
    #[test]
    fn matrices_that_overflow_do_not_converge() {
        let term = |matrix: Mat<f64>, law: Law| Term { matrix, law };
        let constant = || term(Mat::identity(5, 5), Law::Constant);
        let symmetric = Mat::from_fn(5, 5, |i, j| if i.abs_diff(j) == 1 { 1e300 } else { 0.0 });
        let unsymmetric = Mat::from_fn(5, 5, |i, j| if j == i + 1 { 1e300 } else { 0.0 });
        let huge = |matrix| term(matrix, Law::FrictionStiffness);
        for (stiffness, damping) in [
            (huge(symmetric.clone()), vec![]),
            (huge(unsymmetric.clone()), vec![]),
            (huge(symmetric), vec![constant()]),
            (huge(unsymmetric), vec![constant()]),
        ] {
            // The state of a damped model also has the velocities.
            let dimension = if damping.is_empty() { 5 } else { 10 };
            let model = Model::new(5, vec![constant(), stiffness], damping, ContactLaw::default(), None).unwrap();
            for vectors in [Vectors::None, Vectors::Right, Vectors::Both] {
                let solve = |mu| Solver::new(5).solve(&model, &REFERENCE.with_friction(mu), vectors);
                assert_eq!(solve(1e10).err(), Some(SolveError::NoConvergence { dimension }));
                assert!(solve(1e-300).is_ok());
            }
        }
    }

    /// A root is unstable if its growth rate exceeds the threshold times `|λ|`.
    #[test]
    fn the_threshold_of_instability() {
        let root = |growth: f64| Root { lambda: c64::new(growth, 1.0), ..solve(&one(25.0, 6.0), 0.0).roots[0] };
        assert!(!root(0.99e-6).is_unstable(1e-6) && root(1.01e-6).is_unstable(1e-6));
    }

    /// A pair of roots `λ² = -100 ± 1e-10`, closer than the matrix is resolved. The bound is of the order of the square
    /// root of the rounding error; the condition number alone, which is infinite in the limit, gives more than 1.
    #[test]
    fn the_bound_of_a_nearly_double_root_is_a_square_root() {
        let matrix = mat![[100.0, 1.0], [1e-20, 100.0]];
        let term = Term { matrix, law: Law::Constant };
        let model = Model::new(2, vec![term], vec![], ContactLaw::default(), None).unwrap();
        let spectrum = Solver::new(2).solve(&model, &REFERENCE, Vectors::Both).unwrap();
        for root in &spectrum.roots {
            let bound = root.error.square;
            assert!(((root.square.re + 100.0).abs() - 1e-10).abs() <= bound && bound < 1e-3, "{root:?}");
        }
    }

    /// `d(λ²)/dμ` from left and right vectors, compared with a central difference of the roots.
    #[test]
    fn friction_sensitivity_is_the_derivative() {
        let model = nine_dof(1.0, 1.0, 1.0);
        let mut solver = Solver::new(9);
        let point = REFERENCE.with_friction(0.5);
        let spectrum = solver.solve(&model, &point, Vectors::Both).unwrap();
        let step = 1e-5;
        let (up, down) = (solve(&model, 0.5 + step), solve(&model, 0.5 - step));
        for k in 0..9 {
            let difference = (up.roots[k].square - down.roots[k].square) / (2.0 * step);
            // Truncation (step²/6 times the third derivative) and rounding (ε/step) are both near 1e-10.
            assert!((spectrum.friction_sensitivity[k] - difference).norm() < 1e-8, "root {k}");
        }
    }
}
