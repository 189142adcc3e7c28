//! Complex eigenvalues of `(λ² I + λ C + K) x = 0`, by the cheapest exact problem, with a residual for each root.
//!
//! | situation | problem solved | roots |
//! |---|---|---|
//! | undamped, `K` symmetric | `K x = -λ² x`, symmetric, `n×n` | `λ² = -κ` |
//! | undamped | `K x = -λ² x`, unsymmetric, `n×n` | `λ² = -κ`, a complex pair `κ` gives a growing and a decaying mode |
//! | damped | `[0 S; -K S⁻¹ -C]`, `S = diag(√K_ii)`, `2n×2n` | `λ` |
//!
//! The scaling by `S` is not optional: without it the state-space roots lose half their digits.

use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::evd::{
    ComputeEigenvectors, EvdParams, SelfAdjointEvdParams, evd_real, evd_scratch, self_adjoint_evd,
    self_adjoint_evd_scratch,
};
use faer::{Auto, Col, Mat, MatRef, Par, Spec, c64};

use super::model::{Model, ModelError, Parameter};
use super::operating_point::OperatingPoint;

/// Residual above which a root counts as not found.
pub const RESIDUAL_LIMIT: f64 = 1e-9;

/// Backward error of the dense solvers, in units of `ε` times the Frobenius norm of the matrix: above what is seen, by the
/// tests of the bounds that rest on it.
pub const ROUNDING: f64 = 8.0;

/// One root of the characteristic equation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Root {
    /// `λ = σ + iω`, 1/s; `ω ≥ 0`. A static root of an undamped model stands for the pair `±λ`, `λ ≥ 0`.
    pub lambda: c64,
    /// `λ²`, 1/s²: analytic in the operating point where `λ` itself is not.
    pub square: c64,
    /// `‖(λ²I + λC + K)x‖ / ((|λ|²‖I‖ + |λ|‖C‖ + ‖K‖)‖x‖)`, Frobenius norms.
    pub residual: f64,
    /// The pad's share of `Σ|q|²`, 0 to 1; NaN where pad and disc are not told apart.
    pub pad_participation: f64,
    /// Bounds of what rounding can have done to it; NaN unless asked for.
    pub error: RootError,
}

/// Bounds of the error of a root.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RootError {
    /// Of `λ²`, 1/s².
    pub square: f64,
    /// Of `ω`, rad/s.
    pub omega: f64,
    /// Of `σ`, 1/s.
    pub sigma: f64,
}

impl RootError {
    /// Nothing is known.
    pub const UNKNOWN: Self = Self { square: f64::NAN, omega: f64::NAN, sigma: f64::NAN };

    /// From a bound `δ` of the error of `λ²`: `|δλ| ≤ δ / (|λ| + √(|λ|² - δ))`, near the origin `|λ| + √δ`. A root whose
    /// square is known to be `real` and negative has no growth rate, exactly.
    pub fn from_square(lambda: c64, square: f64, real: bool) -> Self {
        let size = lambda.norm();
        let rest = size * size - square;
        let error = if rest > 0.0 { square / (size + rest.sqrt()) } else { size + square.max(0.0).sqrt() };
        let sigma = if real && lambda.re == 0.0 && rest > 0.0 { 0.0 } else { error };
        Self { square, omega: error, sigma }
    }

    /// From a bound of the error of `λ`.
    pub fn from_lambda(lambda: c64, error: f64) -> Self {
        Self { square: error * (2.0 * lambda.norm() + error), omega: error, sigma: error }
    }
}

impl Root {
    /// Whether it oscillates (`ω > 0`), that is, whether it is a mode.
    pub fn oscillates(&self) -> bool {
        self.lambda.im > 0.0
    }

    /// `f = ω/2π`, Hz.
    pub fn frequency_hz(&self) -> f64 {
        self.lambda.im / std::f64::consts::TAU
    }

    /// `σ`, 1/s.
    pub fn growth_rate_per_s(&self) -> f64 {
        self.lambda.re
    }

    /// `ζ = -σ/|λ|`; 0 for a root at the origin.
    pub fn damping_ratio(&self) -> f64 {
        // Adding zero turns the -0 of an undamped mode into 0.
        let magnitude = self.lambda.norm();
        if magnitude > 0.0 { -self.lambda.re / magnitude + 0.0 } else { 0.0 }
    }

    /// Whether it grows: `σ > threshold · |λ|`. At the origin, within rounding, nothing grows.
    pub fn is_unstable(&self, threshold: f64) -> bool {
        self.lambda.re > threshold * self.lambda.norm()
    }
}

/// What else than roots to compute.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Vectors {
    /// Right vectors only: residuals and shapes.
    Right,
    /// Left vectors too, and from them the conditioning of every root, bounds of its error, and `d(λ²)/dμ`.
    Both,
}

/// The roots of a model at one operating point.
///
/// `roots` holds the modes (`ω > 0`) first, ascending in `ω` and among equals descending in `σ`, then the static
/// roots, descending in `σ`. An undamped model has exactly `n` roots, each standing for `±λ`; a damped one lists
/// each static root by itself.
#[derive(Clone, Debug)]
pub struct Spectrum {
    /// The point it was solved at.
    pub point: OperatingPoint,
    /// Every root, ordered as said above.
    pub roots: Vec<Root>,
    /// How many of them are modes.
    pub mode_count: usize,
    /// No damping took part: every root stands for `±λ`.
    pub undamped: bool,
    /// `n×roots`: right vectors `x`, one column for each root, norm 1.
    pub shapes: Mat<c64>,
    /// `d(λ²)/dμ` for each root, 1/s²; empty unless asked for.
    pub friction_sensitivity: Vec<c64>,
    /// Frobenius norm of the matrix whose eigenvalues were computed: `K`, 1/s², or the scaled state matrix, 1/s.
    pub matrix_norm: f64,
}

/// Why there are no roots to be had.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SolveError {
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("the eigenvalue iteration did not converge on a {dimension}x{dimension} matrix")]
    NoConvergence { dimension: usize },
    #[error("the roots sum to {found:e}, the trace is {expected:e}: they differ by more than {limit:e}")]
    Trace { found: f64, expected: f64, limit: f64 },
    #[error("root {root} at {frequency_hz} Hz: residual {residual:e} exceeds {limit:e}")]
    Residual { root: usize, frequency_hz: f64, residual: f64, limit: f64 },
}

impl Spectrum {
    /// The modes: roots with `ω > 0`, ascending.
    pub fn modes(&self) -> &[Root] {
        &self.roots[..self.mode_count]
    }

    /// Growth rates of the roots that do not oscillate, 1/s, descending; of an undamped model both signs.
    pub fn nonoscillatory_growth_per_s(&self) -> Vec<f64> {
        let statics = &self.roots[self.mode_count..];
        let mut growth: Vec<f64> = statics.iter().map(|root| root.lambda.re).collect();
        if self.undamped {
            growth.extend(statics.iter().map(|root| 0.0 - root.lambda.re));
        }
        growth.sort_by(|a, b| b.total_cmp(a));
        growth
    }
}

/// Workspace for the spectra of one model, allocated once.
pub struct Solver {
    stiffness: Mat<f64>,
    damping: Mat<f64>,
    stiffness_slope: Mat<f64>,
    damping_slope: Mat<f64>,
    state: Mat<f64>,
    dense: Dense,
}

/// Workspace of the dense unsymmetric eigenvalue problem, and its vectors in LAPACK's packing: a complex pair in two
/// columns, real and imaginary part.
struct Dense {
    left: Mat<f64>,
    right: Mat<f64>,
    memory: MemBuffer,
}

/// Roots and vectors before they are judged and ordered.
struct Raw {
    root: Root,
    shape: Vec<c64>,
    left: Option<Left>,
}

/// What a left vector tells of a root.
#[derive(Clone, Copy)]
struct Left {
    /// `d(λ²)/dμ`.
    sensitivity: c64,
    /// Condition of the eigenvalue, `‖y‖‖x‖ / |yᴴx|`, in the problem that was solved.
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
            dense: Dense { left: Mat::new(), right: Mat::new(), memory: MemBuffer::new(StackReq::EMPTY) },
        }
    }

    /// The spectrum of `model` at `p`.
    ///
    /// # Errors
    /// [`SolveError::Model`] where the model cannot be evaluated there, [`SolveError::NoConvergence`],
    /// [`SolveError::Trace`] and [`SolveError::Residual`] where the answer is not one.
    pub fn solve(&mut self, model: &Model, p: &OperatingPoint, vectors: Vectors) -> Result<Spectrum, SolveError> {
        let n = model.dimension();
        let structure = model.assemble(p, &mut self.stiffness, &mut self.damping)?;
        let with_left = vectors == Vectors::Both;
        if with_left {
            model.assemble_derivative(p, Parameter::Friction, &mut self.stiffness_slope, &mut self.damping_slope)?;
        }
        let mut raw = if structure.damped {
            self.damped(n, with_left)?
        } else if structure.symmetric_stiffness {
            self.symmetric(n, with_left)?
        } else {
            self.undamped(n, with_left)?
        };
        self.judge(&mut raw, structure.damped, model.pad_modes())?;
        raw.sort_by(|a, b| order(&a.root, &b.root));
        let matrix_norm = if structure.damped { self.state.norm_l2() } else { self.stiffness.norm_l2() };
        bound_errors(&mut raw, structure.damped, ROUNDING * f64::EPSILON * matrix_norm);
        let mode_count = raw.iter().filter(|r| r.root.oscillates()).count();
        let shapes = Mat::from_fn(n, raw.len(), |i, j| raw[j].shape[i]);
        Ok(Spectrum {
            point: *p,
            mode_count,
            undamped: !structure.damped,
            matrix_norm,
            shapes,
            friction_sensitivity: raw.iter().filter_map(|r| r.left.map(|left| left.sensitivity)).collect(),
            roots: raw.into_iter().map(|r| r.root).collect(),
        })
    }

    /// `|κ|` below which an eigenvalue of `K` is a zero disturbed by rounding: `16 n ε ‖K‖`.
    fn zero_square(&self, n: usize) -> f64 {
        16.0 * n as f64 * f64::EPSILON * self.stiffness.norm_l2()
    }

    fn symmetric(&mut self, n: usize, with_left: bool) -> Result<Vec<Raw>, SolveError> {
        let params: Spec<SelfAdjointEvdParams, f64> = <SelfAdjointEvdParams as Auto<f64>>::auto().into();
        let request = self_adjoint_evd_scratch::<f64>(n, ComputeEigenvectors::Yes, Par::Seq, params);
        let mut memory = MemBuffer::new(request);
        let mut kappa = Col::<f64>::zeros(n);
        let mut shapes = Mat::<f64>::zeros(n, n);
        // faer stops at an absolute tolerance near 1e-16: entries are brought near 1, by a power of two so that no
        // digit changes.
        let exponent = self.stiffness.norm_max().log2().ceil();
        let unit = if exponent.is_finite() { exponent.exp2() } else { 1.0 };
        self_adjoint_evd(
            (&self.stiffness * faer::Scale(unit.recip())).as_ref(),
            kappa.as_mut().as_diagonal_mut(),
            Some(shapes.as_mut()),
            Par::Seq,
            MemStack::new(&mut memory),
            params,
        )
        .map_err(|_| SolveError::NoConvergence { dimension: n })?;
        let zero = self.zero_square(n);
        Ok((0..n)
            .map(|k| {
                let shape: Vec<c64> = (0..n).map(|i| c64::new(shapes[(i, k)], 0.0)).collect();
                let left = with_left.then(|| Left {
                    sensitivity: -bilinear(&shape, self.stiffness_slope.as_ref(), &shape) / inner(&shape, &shape),
                    condition: 1.0,
                });
                Raw { root: from_square(c64::new(-kappa[k] * unit, 0.0), zero), shape, left }
            })
            .collect())
    }

    fn undamped(&mut self, n: usize, with_left: bool) -> Result<Vec<Raw>, SolveError> {
        let kappa = self.dense.eigen(self.stiffness.as_ref(), with_left)?;
        let zero = self.zero_square(n);
        Ok((0..n)
            .map(|k| {
                let shape = column(self.dense.right.as_ref(), &kappa, k, 0..n);
                let left = with_left.then(|| {
                    let left = column(self.dense.left.as_ref(), &kappa, k, 0..n);
                    let product = inner(&left, &shape);
                    Left {
                        sensitivity: -bilinear(&left, self.stiffness_slope.as_ref(), &shape) / product,
                        condition: norm(&left) * norm(&shape) / product.norm(),
                    }
                });
                Raw { root: from_square(-kappa[k], zero), shape, left }
            })
            .collect())
    }

    fn damped(&mut self, n: usize, with_left: bool) -> Result<Vec<Raw>, SolveError> {
        let scale = displacement_scale(self.stiffness.as_ref());
        if self.state.nrows() != 2 * n {
            self.state = Mat::zeros(2 * n, 2 * n);
        }
        for (j, &s) in scale.iter().enumerate() {
            self.state[(j, n + j)] = s;
            for i in 0..n {
                self.state[(n + i, j)] = -self.stiffness[(i, j)] / s;
                self.state[(n + i, n + j)] = -self.damping[(i, j)];
            }
        }
        let lambda = self.dense.eigen(self.state.as_ref(), with_left)?;
        // A double root at the origin splits into ±√(rounding): as a square it is zero to rounding.
        let zero = self.zero_square(n);
        let mut raw = Vec::with_capacity(n + 8);
        for (k, &value) in lambda.iter().enumerate() {
            if value.im < 0.0 {
                continue; // its conjugate stands for it
            }
            let displacement = column(self.dense.right.as_ref(), &lambda, k, 0..n);
            let velocity = column(self.dense.right.as_ref(), &lambda, k, n..2 * n);
            // x from whichever half of the state holds more of it: [S x; λ x].
            let shape: Vec<c64> = if inner(&velocity, &velocity).re >= inner(&displacement, &displacement).re {
                velocity
            } else {
                displacement.iter().zip(&scale).map(|(x, s)| x / s).collect()
            };
            let square = value * value;
            let value = if square.norm() <= zero { c64::ZERO } else { value };
            let left = with_left.then(|| {
                let whole = column(self.dense.left.as_ref(), &lambda, k, 0..2 * n);
                let left = &whole[n..];
                let change = value * bilinear(left, self.damping_slope.as_ref(), &shape)
                    + bilinear(left, self.stiffness_slope.as_ref(), &shape);
                let weight = 2.0 * value * inner(left, &shape) + bilinear(left, self.damping.as_ref(), &shape);
                let state = column(self.dense.right.as_ref(), &lambda, k, 0..2 * n);
                Left {
                    sensitivity: -2.0 * value * change / weight,
                    condition: norm(&whole) * norm(&state) / inner(&whole, &state).norm(),
                }
            });
            let root = Root {
                lambda: value,
                square,
                residual: f64::NAN,
                pad_participation: f64::NAN,
                error: RootError::UNKNOWN,
            };
            raw.push(Raw { root, shape, left });
        }
        Ok(raw)
    }

    /// Normalises the shapes, fills in residual and pad share, and refuses a root that does not satisfy the equation.
    fn judge(&self, raw: &mut [Raw], damped: bool, pad_modes: Option<usize>) -> Result<(), SolveError> {
        let n = self.stiffness.nrows();
        let stiffness_norm = self.stiffness.norm_l2();
        let damping_norm = if damped { self.damping.norm_l2() } else { 0.0 };
        let shapes = Mat::from_fn(n, raw.len(), |i, j| raw[j].shape[i]);
        let re = Mat::from_fn(n, raw.len(), |i, j| shapes[(i, j)].re);
        let im = Mat::from_fn(n, raw.len(), |i, j| shapes[(i, j)].im);
        let stiffness = (&self.stiffness * &re, &self.stiffness * &im);
        let damping = damped.then(|| (&self.damping * &re, &self.damping * &im));
        for (j, entry) in raw.iter_mut().enumerate() {
            let size = entry.shape.iter().map(|x| x.norm_sqr()).sum::<f64>();
            let product = |(re, im): &(Mat<f64>, Mat<f64>), i: usize| c64::new(re[(i, j)], im[(i, j)]);
            let residual_of = |root: &Root| {
                let (mut off, mut along, mut slope_size) = (0.0, c64::ZERO, 0.0);
                for (i, &x) in entry.shape.iter().enumerate() {
                    let cx = damping.as_ref().map_or(c64::ZERO, |damping| product(damping, i));
                    let r = root.square * x + root.lambda * cx + product(&stiffness, i);
                    let slope = 2.0 * root.lambda * x + cx;
                    off += r.norm_sqr();
                    along += slope.conj() * r;
                    slope_size += slope.norm_sqr();
                }
                let weight =
                    root.square.norm() * (n as f64).sqrt() + root.lambda.norm() * damping_norm + stiffness_norm;
                let residual = if off == 0.0 { 0.0 } else { off.sqrt() / (weight * size.sqrt()) };
                (residual, along / slope_size)
            };
            let (mut residual, correction) = residual_of(&entry.root);
            if damped && residual > RESIDUAL_LIMIT {
                // Near the origin the state space loses relative accuracy; the best root for the given shape does not.
                let lambda = entry.root.lambda - correction;
                let refined = Root { lambda, square: lambda * lambda, ..entry.root };
                let (refined_residual, _) = residual_of(&refined);
                if refined_residual < residual {
                    (entry.root, residual) = (refined, refined_residual);
                }
            }
            if residual.is_nan() || residual > RESIDUAL_LIMIT {
                let frequency_hz = entry.root.frequency_hz();
                return Err(SolveError::Residual { root: j, frequency_hz, residual, limit: RESIDUAL_LIMIT });
            }
            let pad = pad_modes.map(|pad_modes| entry.shape.iter().take(pad_modes).map(|x| x.norm_sqr()).sum::<f64>());
            entry.root.residual = residual;
            entry.root.pad_participation = pad.map_or(f64::NAN, |pad| pad / size);
            let length = size.sqrt();
            entry.shape.iter_mut().for_each(|x| *x /= length);
        }
        Ok(())
    }
}

impl Dense {
    /// Eigenvalues of `matrix`; its right (and left) vectors land in `self`.
    fn eigen(&mut self, matrix: MatRef<'_, f64>, left_too: bool) -> Result<Vec<c64>, SolveError> {
        let dimension = matrix.nrows();
        let params: Spec<EvdParams, f64> = <EvdParams as Auto<f64>>::auto().into();
        if self.right.nrows() != dimension {
            use ComputeEigenvectors::Yes;
            self.memory = MemBuffer::new(evd_scratch::<f64>(dimension, Yes, Yes, Par::Seq, params));
            self.right = Mat::zeros(dimension, dimension);
            self.left = Mat::zeros(dimension, dimension);
        }
        let mut re = Col::<f64>::zeros(dimension);
        let mut im = Col::<f64>::zeros(dimension);
        evd_real(
            matrix,
            re.as_mut().as_diagonal_mut(),
            im.as_mut().as_diagonal_mut(),
            left_too.then(|| self.left.as_mut()),
            Some(self.right.as_mut()),
            Par::Seq,
            MemStack::new(&mut self.memory),
            params,
        )
        .map_err(|_| SolveError::NoConvergence { dimension })?;
        // faer does not report whether the iteration converged; the trace of what it left tells.
        let expected: f64 = (0..dimension).map(|i| matrix[(i, i)]).sum();
        let found: f64 = re.iter().sum();
        let limit = 64.0 * dimension as f64 * f64::EPSILON * matrix.norm_l2();
        if (found - expected).abs() > limit || !found.is_finite() {
            return Err(SolveError::Trace { found, expected, limit });
        }
        Ok((0..dimension).map(|k| c64::new(re[k], im[k])).collect())
    }
}

/// `S`: what each displacement is multiplied by, so that it weighs as much as its velocity, rad/s.
///
/// `√|K_ii|`, kept within six decades of the largest so that a free coordinate does not blow up its column.
pub(super) fn displacement_scale(stiffness: MatRef<'_, f64>) -> Vec<f64> {
    let diagonal = || (0..stiffness.nrows()).map(|i| stiffness[(i, i)].abs().sqrt());
    let largest = diagonal().fold(0.0, f64::max);
    if largest == 0.0 {
        return vec![1.0; stiffness.nrows()];
    }
    diagonal().map(|s| s.max(1e-6 * largest)).collect()
}

/// Bounds every root's error from its condition and the distance of its nearest neighbour, where left vectors are known.
///
/// A backward stable solver is exact for a matrix that is off by `E`; to first order a root is then off by `κ E`. Close
/// to a merging point `κ` grows like one over the gap `g`, and what remains is `√(g κ E)`: half the digits.
fn bound_errors(raw: &mut [Raw], damped: bool, backward_error: f64) {
    let value = |raw: &Raw| if damped { raw.root.lambda } else { raw.root.square };
    let values: Vec<c64> = raw.iter().map(value).collect();
    for (k, entry) in raw.iter_mut().enumerate() {
        let Some(left) = entry.left else { continue };
        let z = values[k];
        let others = || values.iter().enumerate().filter(|&(j, _)| j != k).map(|(_, other)| (other - z).norm());
        // In a damped model the conjugate is a neighbour too.
        let mirror = if damped && z.im != 0.0 { 2.0 * z.im.abs() } else { f64::INFINITY };
        let gap = others().fold(mirror, f64::min);
        let first_order = 2.0 * left.condition * backward_error;
        let error = if gap.is_finite() {
            first_order.min(2.0 * (gap * first_order).sqrt()).max(backward_error)
        } else {
            first_order
        };
        // At a gap of nothing the condition is infinite and the product is not known: the scale of rounding remains.
        let error = if error.is_finite() { error } else { (backward_error * (z.norm() + backward_error)).sqrt() };
        entry.root.error = if damped {
            RootError::from_lambda(entry.root.lambda, error)
        } else {
            RootError::from_square(entry.root.lambda, error, z.im == 0.0 && 2.0 * error < gap)
        };
    }
}

/// The root of an undamped model from its square `λ² = -κ`, with what lies within `zero` of the origin put there.
fn from_square(square: c64, zero: f64) -> Root {
    let lambda = if square.norm() <= zero { c64::ZERO } else { square_root(square) };
    Root { lambda, square, residual: f64::NAN, pad_participation: f64::NAN, error: RootError::UNKNOWN }
}

/// `λ` with `ω ≥ 0` from `λ²`. Both members of a complex pair of squares are modes: the one grows as fast as the other
/// decays.
pub(super) fn square_root(square: c64) -> c64 {
    if square.im == 0.0 && square.re < 0.0 {
        c64::new(0.0, (-square.re).sqrt())
    } else if square.im == 0.0 {
        c64::new(square.re.sqrt(), 0.0)
    } else {
        let root = square.sqrt();
        if root.im < 0.0 { -root } else { root }
    }
}

/// Modes before static roots; modes ascending in `ω`, then descending in `σ`; static roots descending in `σ`.
pub(super) fn order(a: &Root, b: &Root) -> std::cmp::Ordering {
    let by_growth = b.lambda.re.total_cmp(&a.lambda.re);
    match (a.oscillates(), b.oscillates()) {
        (true, false) => std::cmp::Ordering::Less,
        (false, true) => std::cmp::Ordering::Greater,
        (true, true) => a.lambda.im.total_cmp(&b.lambda.im).then(by_growth),
        (false, false) => by_growth,
    }
}

/// Rows `rows` of eigenvector `k` out of LAPACK's packing.
fn column(packed: MatRef<'_, f64>, values: &[c64], k: usize, rows: std::ops::Range<usize>) -> Vec<c64> {
    let value = values[k];
    if value.im == 0.0 {
        return rows.map(|i| c64::new(packed[(i, k)], 0.0)).collect();
    }
    // The first of a pair holds (re, im) of its own vector; the second is its conjugate.
    let first = is_first_of_pair(values, k);
    let (re, im, sign) = if first { (k, k + 1, 1.0) } else { (k - 1, k, -1.0) };
    rows.map(|i| c64::new(packed[(i, re)], sign * packed[(i, im)])).collect()
}

/// Whether complex eigenvalue `k` is the first of its conjugate pair: an even number of complex ones stand before it.
fn is_first_of_pair(values: &[c64], k: usize) -> bool {
    values[..k].iter().rev().take_while(|v| v.im != 0.0).count() % 2 == 0
}

/// `aᴴ b`.
fn inner(a: &[c64], b: &[c64]) -> c64 {
    a.iter().zip(b).map(|(a, b)| a.conj() * b).sum()
}

fn norm(a: &[c64]) -> f64 {
    a.iter().map(|a| a.norm_sqr()).sum::<f64>().sqrt()
}

/// `aᴴ M b`.
fn bilinear(a: &[c64], m: MatRef<'_, f64>, b: &[c64]) -> c64 {
    (0..b.len()).map(|j| b[j] * (0..a.len()).map(|i| a[i].conj() * m[(i, j)]).sum::<c64>()).sum()
}

#[cfg(test)]
mod tests {
    use faer::mat;

    use super::super::model::{ContactLaw, Law, Term};
    use super::super::test_models::{REFERENCE, nine_dof};
    use super::*;

    fn solve(model: &Model, mu: f64) -> Spectrum {
        Solver::new(model.dimension()).solve(model, &REFERENCE.with_friction(mu), Vectors::Right).expect("it solves")
    }

    /// 30-digit arithmetic on the matrices of the paper's 9-degree-of-freedom model, case 1, printed to 10 digits.
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
                // Half a digit of the print.
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

    /// Two springs on two masses, stiffness scaled over 24 decades: `ω² = k (3 ± √5)/2`.
    #[test]
    fn symmetric_route_knows_no_scale() {
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

    /// `λ² + c λ + k = 0` by hand: under-damped, over-damped, free, divergent.
    #[test]
    fn single_degree_of_freedom() {
        let under = solve(&one(25.0, 6.0), 0.0);
        assert!((under.roots[0].lambda - c64::new(-3.0, 4.0)).norm() < 1e-14);
        assert!((under.roots[0].damping_ratio() - 0.6).abs() < 1e-15);
        let over = solve(&one(4.0, 5.0), 0.0);
        assert_eq!(over.mode_count, 0);
        let growth = over.nonoscillatory_growth_per_s();
        assert!((growth[0] + 1.0).abs() < 1e-14 && (growth[1] + 4.0).abs() < 1e-14, "{growth:?}");
        assert_eq!(solve(&one(0.0, 0.0), 0.0).nonoscillatory_growth_per_s(), vec![0.0, 0.0]);
        assert_eq!(solve(&one(-9.0, 0.0), 0.0).nonoscillatory_growth_per_s(), vec![3.0, -3.0]);
    }

    /// Proportional damping: the modes of `λ² + β λ + ω² = 0` for every undamped `ω²`, complex ones included.
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

    /// `d(λ²)/dμ` from left and right vectors against a central difference of the roots.
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
            // Truncation (step²/6 of the third derivative) and rounding (ε/step) are both near 1e-10.
            assert!((spectrum.friction_sensitivity[k] - difference).norm() < 1e-8, "root {k}");
        }
    }
}
