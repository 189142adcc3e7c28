//! What the reduction needs of a sparse solver: factors of matrices, and the lowest modes of a symmetric system.
//!
//! [`OwnEngine`](super::OwnEngine) solves in this process. Another engine is *foreign*: its results come from other
//! processes, and each one is checked before it is used. Modes and roots by their residuals, modes also by their
//! products `Φᵀ M Φ` and their number, solves by `|A x - b|`.

use faer::sparse::SparseColMat;
use faer::{Mat, c64};

use super::ReductionError;
use super::pencil::{Llt, Pencil};
use super::sparse::SparseMatrix;

/// Relative gap of two neighbouring `ω²` that is wide enough for an inertia (Sturm) count between them.
pub(super) const GAP: f64 = 1e-7;

/// Sparse complex matrix in compressed columns.
pub type ComplexSparseMatrix = SparseColMat<usize, c64>;

/// Progress of a computation of modes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Progress {
    /// The system is being ordered and analysed.
    Analysing,
    /// The system is ordered and symbolically analysed. `factor_entries` is the number of entries of a factor; `bytes`
    /// is the memory needed in addition to what is already held.
    Analysed {
        /// Number of entries of a factor.
        factor_entries: usize,
        /// Estimated memory, bytes.
        bytes: usize,
    },
    /// `K + s M` is factorised with the shift `s`, rad²/s².
    Factored {
        /// The shift `σ` of `K - σ M`, rad²/s².
        shift: f64,
    },
    /// Lanczos vectors built so far, and how many of the wanted modes have converged.
    Iterated {
        /// Number of vectors built.
        vectors: usize,
        /// Number of converged modes.
        converged: usize,
        /// Number of modes wanted; 0 if not known yet.
        wanted: usize,
    },
    /// The inertia of `K - σ M` gave the number of modes below `ω² = σ`, rad²/s².
    Counted {
        /// Number of modes.
        modes: usize,
        /// Below this `ω²`, rad²/s².
        below: f64,
        /// Whose factor counted.
        by: CountedBy,
    },
    /// Number of unit loads at the contact whose static response has been computed, of `loads`.
    Loaded {
        /// Number of loads solved.
        solved: usize,
        /// Number of loads in all.
        loads: usize,
    },
}

/// Whose factor gave a count of modes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CountedBy {
    /// A factor of ours, in this process.
    Us,
    /// The factor of a foreign engine, because there was no memory for one of ours.
    Engine,
}

/// Solves with one factorised matrix `A`.
pub trait Factor<T>: Sync {
    /// `A⁻¹ B` in place, or `A⁻ᵀ B` if `transposed`.
    ///
    /// # Errors
    /// [`ReductionError::Engine`] if the engine failed.
    fn solve(&self, rhs: &mut Mat<T>, transposed: bool) -> Result<(), ReductionError>;
}

/// Lowest modes wanted of `K φ = ω² M φ`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lowest {
    /// The first shift `s` to try: `K + s M` is factorised, with a larger one if that is not positive definite, rad²/s².
    pub first_shift: f64,
    /// Number of modes, at least.
    pub count: usize,
    /// All of them are below this `ω²`, rad²/s². Without it, modes follow until a gap lies after `count` of them.
    pub cutoff: Option<f64>,
    /// Number of attempts that have missed a mode. Another attempt begins with another vector.
    pub attempt: u64,
}

/// Eigenpairs of `K φ = ω² M φ` as an engine found them.
pub struct Eigenpairs<'p> {
    /// `ω²`, rad²/s², ascending.
    pub omega_squared: Vec<f64>,
    /// `Φ`, a column per `ω²`, mass-normalised.
    pub phi: Mat<f64>,
    /// The shift `s` used, rad²/s².
    pub shift: f64,
    /// The factor of `K + s M`, if it is in this process.
    pub(super) factor: Option<Llt<'p>>,
}

impl Eigenpairs<'_> {
    /// Eigenpairs from another process.
    pub fn foreign(omega_squared: Vec<f64>, phi: Mat<f64>, shift: f64) -> Self {
        Self { omega_squared, phi, shift, factor: None }
    }

    /// The `count` lowest.
    pub(super) fn first(self, count: usize) -> Self {
        let phi = self.phi.subcols(0, count).to_owned();
        Self { omega_squared: self.omega_squared[..count].to_vec(), phi, ..self }
    }
}

/// A sparse solver.
pub trait Engine: Sync {
    /// Whether results come from outside this process. They are checked then, and factors take no memory here.
    fn foreign(&self) -> bool;

    /// The lowest modes of a symmetric system.
    ///
    /// # Errors
    /// [`ReductionError`]: `NoShift`, `NotConverged`, `Factorisation`, `Engine`.
    fn lowest<'p>(
        &self,
        pencil: &'p Pencil<'_>,
        wanted: &Lowest,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Eigenpairs<'p>, ReductionError>;

    /// Number of `ω²` below `square`, rad²/s², by the inertia of `K - σ M`.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `Engine`.
    fn count_below(&self, pencil: &Pencil<'_>, square: f64) -> Result<usize, ReductionError>;

    /// A factor of `K + s M`; `None` if that is not positive definite.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `Engine`.
    fn definite<'a>(
        &'a self,
        pencil: &'a Pencil<'_>,
        shift: f64,
    ) -> Result<Option<Box<dyn Factor<f64> + 'a>>, ReductionError>;

    /// A factor of a matrix of any symmetry; `what` names it in errors.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `Engine`.
    fn real<'a>(&'a self, what: &str, matrix: &SparseMatrix) -> Result<Box<dyn Factor<f64> + 'a>, ReductionError>;

    /// A factor of a complex matrix of any symmetry; `what` names it in errors.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `Engine`.
    fn complex<'a>(
        &'a self,
        what: &str,
        matrix: &ComplexSparseMatrix,
    ) -> Result<Box<dyn Factor<c64> + 'a>, ReductionError>;
}

/// Smallest number of values, at least `count`, that is followed by a gap; `None` if there is none.
pub(super) fn gap_after(squares: &[f64], count: usize) -> Option<usize> {
    let largest = squares.iter().fold(0.0, |largest: f64, square| largest.max(square.abs()));
    (count..squares.len()).find(|&k| squares[k] - squares[k - 1] > GAP * squares[k].abs().max(1e-6 * largest))
}
