//! Roots of the characteristic equation with their error bounds, and the spectrum of all roots at one operating
//! point.

use std::sync::Arc;

use faer::{Mat, c64};

use super::model_error::ModelError;
use super::operating_point::OperatingPoint;
use super::steady_contact::Situation;
use crate::contact::SteadyState;

/// One root of the characteristic equation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Root {
    /// `λ = σ + iω`, 1/s; `ω ≥ 0`. A static root of an undamped model is listed as `λ ≥ 0` and represents the pair
    /// `±λ`.
    pub lambda: c64,
    /// `λ²`, 1/s²: analytic in the operating point even where `λ` is not.
    pub square: c64,
    /// `‖(λ²I + λC + K)x‖ / ((|λ|²‖I‖ + |λ|‖C‖ + ‖K‖)‖x‖)`, Frobenius norms. For a charted root, whose shape is
    /// unknown, a bound of the residual with the exact shape.
    pub residual: f64,
    /// The pad's share of `Σ|q|²`, 0 to 1. NaN if coordinates are not separated into pad and disc, and for a charted
    /// root of a cluster: where roots merge, neither the shares nor their mean are analytic functions.
    pub pad_participation: f64,
    /// Bounds of the error due to rounding; NaN unless requested.
    pub error: RootError,
}

/// Bounds of the absolute error of a root.
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
    /// No bound is known.
    pub const UNKNOWN: Self = Self { square: f64::NAN, omega: f64::NAN, sigma: f64::NAN };

    /// Bounds from a bound `δ` of the error of `λ²`: `|δλ| ≤ δ / (|λ| + √(|λ|² - δ))`; near the origin, where
    /// `δ ≥ |λ|²`, `|λ| + √δ`. If `λ²` is known to be `real` and is negative, the growth rate is exactly zero.
    pub fn from_square(lambda: c64, square: f64, real: bool) -> Self {
        let size = magnitude(lambda);
        let rest = size * size - square;
        let error = if rest > 0.0 { square / (size + rest.sqrt()) } else { size + square.max(0.0).sqrt() };
        let sigma = if real && lambda.re == 0.0 && rest > 0.0 { 0.0 } else { error };
        Self { square, omega: error, sigma }
    }

    /// Bounds from a bound of the error of `λ`.
    pub fn from_lambda(lambda: c64, error: f64) -> Self {
        Self { square: error * (2.0 * magnitude(lambda) + error), omega: error, sigma: error }
    }
}

impl Root {
    /// Whether the root oscillates (`ω > 0`) and therefore is a mode.
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
        let size = magnitude(self.lambda);
        if size > 0.0 { -self.lambda.re / size + 0.0 } else { 0.0 }
    }

    /// Bound of the residual of this root `λ` with the exact shape `x̂` of the exact root `λ̂`. It follows from the
    /// error bounds and the Frobenius `norms` of `I`, `C` and `K`, since the residual vector is
    /// `(λ² - λ̂²) x̂ + (λ - λ̂) C x̂`.
    pub fn residual_bound(&self, norms: [f64; 3]) -> f64 {
        let [unit, damping, stiffness] = norms;
        let size = magnitude(self.lambda);
        (self.error.square + self.error.omega * damping) / (size * size * unit + size * damping + stiffness)
    }

    /// Whether the root is unstable: `σ > threshold · |λ|`. A root that is zero up to rounding is never unstable.
    pub fn is_unstable(&self, threshold: f64) -> bool {
        self.lambda.re > threshold * magnitude(self.lambda)
    }
}

/// Which eigenvectors to compute.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Vectors {
    /// None: no residuals, shapes or bounds. The roots are checked by the traces of the matrix only.
    None,
    /// Right vectors only: residuals and shapes.
    Right,
    /// Left vectors too: also condition numbers, error bounds and `d(λ²)/dμ` of every root.
    Both,
}

/// The roots of a model at one operating point.
///
/// `roots` holds the modes (`ω > 0`) first, ascending in `ω` and, for equal `ω`, descending in `σ`. The static roots
/// follow, descending in `σ`. An undamped model has exactly `n` roots, each representing `±λ`; a damped one lists
/// each static root separately.
#[derive(Clone, Debug)]
pub struct Spectrum {
    /// The operating point.
    pub point: OperatingPoint,
    /// The state of steady sliding there, if the model's contact has one.
    pub state: Option<Arc<SteadyState>>,
    /// All roots, in the order given above.
    pub roots: Vec<Root>,
    /// Number of modes.
    pub mode_count: usize,
    /// Whether all damping was zero, so that every root represents `±λ`.
    pub undamped: bool,
    /// `n×roots`: right vectors `x`, one column for each root, of norm 1; empty unless requested.
    pub shapes: Mat<c64>,
    /// `n×roots`: left vectors `y`; empty unless requested. They are scaled so that changes `dK` and `dC` of the
    /// matrices move an undamped root by `d(λ²) = -yᴴ dK x` and a damped one by `dλ = -yᴴ (λ dC + dK) x`.
    pub left: Mat<c64>,
    /// `d(λ²)/dμ` of each root, 1/s²; empty unless requested.
    pub friction_sensitivity: Vec<c64>,
    /// Frobenius norm of the matrix whose eigenvalues were computed: `K`, 1/s², or the scaled state matrix, 1/s.
    pub matrix_norm: f64,
}

/// Why a solve failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// The matrices could not be assembled.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The eigenvalue iteration did not converge.
    #[error("the eigenvalue iteration did not converge on a {dimension}x{dimension} matrix")]
    NoConvergence {
        /// Size of the matrix.
        dimension: usize,
    },
    /// The roots contradict the trace of the matrix or of its square.
    #[error(
        "powers {power} of the roots sum to {found:e}, the trace is {expected:e}: they differ by more than {limit:e}"
    )]
    Trace {
        /// Power of the matrix: 1 or 2.
        power: u32,
        /// Sum of the powers of the roots.
        found: f64,
        /// The trace.
        expected: f64,
        /// Largest difference accepted.
        limit: f64,
    },
    /// A root and its vector do not fulfil the equation.
    #[error("root {root} at {frequency_hz} Hz: residual {residual:e} exceeds {limit:e}")]
    Residual {
        /// Index of the root.
        root: usize,
        /// Its frequency, Hz.
        frequency_hz: f64,
        /// Its scaled residual.
        residual: f64,
        /// Largest residual accepted.
        limit: f64,
    },
}

impl Spectrum {
    /// The operating point with its contact state.
    pub(crate) fn situation(&self) -> Situation {
        Situation { point: self.point, state: self.state.clone() }
    }

    /// The modes: roots with `ω > 0`, ascending in frequency.
    pub fn modes(&self) -> &[Root] {
        &self.roots[..self.mode_count]
    }

    /// Growth rates of the static roots, 1/s, descending; for an undamped model both signs are listed.
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

/// `λ` with `ω ≥ 0` from `λ²`. The two members of a complex conjugate pair of squares give two modes, one growing as
/// fast as the other decays.
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

/// `|z|`, without a square root for real and imaginary numbers.
pub(super) fn magnitude(z: c64) -> f64 {
    if z.re == 0.0 {
        z.im.abs()
    } else if z.im == 0.0 {
        z.re.abs()
    } else {
        z.norm()
    }
}

/// Order of roots: modes before static roots; modes ascending in `ω`, then descending in `σ`; static roots descending
/// in `σ`.
pub(super) fn order(a: &Root, b: &Root) -> std::cmp::Ordering {
    let by_growth = b.lambda.re.total_cmp(&a.lambda.re);
    match (a.oscillates(), b.oscillates()) {
        (true, false) => std::cmp::Ordering::Less,
        (false, true) => std::cmp::Ordering::Greater,
        (true, true) => a.lambda.im.total_cmp(&b.lambda.im).then(by_growth),
        (false, false) => by_growth,
    }
}
