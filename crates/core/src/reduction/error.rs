//! Errors of model reduction.

use crate::physics::{ModelError, SolveError};

/// Bytes in a GiB.
pub const GIB: f64 = (1_u64 << 30) as f64;

/// Error of model reduction, with the offending value and the limit it broke. Rows, columns and modes are counted from
/// 0.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReductionError {
    /// A matrix has the wrong shape.
    #[error("{what} is {rows}x{columns}, expected {expected}x{expected}")]
    Shape {
        /// Name of the part, model or matrix.
        what: String,
        /// Number of rows found.
        rows: usize,
        /// Number of columns found.
        columns: usize,
        /// Number of rows and columns expected.
        expected: usize,
    },
    /// A matrix has an entry that is no finite number.
    #[error("{what}: entry ({row}, {column}) is {value}, expected a finite number")]
    NotFinite {
        /// Name of the part, model or matrix.
        what: String,
        /// Row of the entry, from 0.
        row: usize,
        /// Column of the entry, from 0.
        column: usize,
        /// The entry.
        value: f64,
    },
    /// A matrix that must be symmetric is not.
    #[error(
        "{what} is not symmetric: entry ({row}, {column}) is {value}, entry ({column}, {row}) is {mirrored}; \
         they may differ by {limit:.3e}"
    )]
    Unsymmetric {
        /// Name of the part, model or matrix.
        what: String,
        /// Row of the entry, from 0.
        row: usize,
        /// Column of the entry, from 0.
        column: usize,
        /// The entry.
        value: f64,
        /// The mirrored entry.
        mirrored: f64,
        /// Largest difference accepted.
        limit: f64,
    },
    /// A mass matrix is not positive definite.
    #[error("{what} is not positive definite: its pivot at row {row} is {value:.6e}, expected more than {limit:.3e}")]
    Indefinite {
        /// Name of the part, model or matrix.
        what: String,
        /// Row of the pivot.
        row: usize,
        /// The pivot.
        value: f64,
        /// The pivot must exceed this.
        limit: f64,
    },
    /// A stiffness matrix is not positive semidefinite.
    #[error(
        "{what} is not positive semidefinite: mode {mode} has omega^2 = {value:.6e} rad^2/s^2, \
         expected at least {limit:.3e}"
    )]
    NegativeStiffness {
        /// Name of the part, model or matrix.
        what: String,
        /// Index of the mode.
        mode: usize,
        /// Its `ω²`, rad²/s².
        value: f64,
        /// Smallest `ω²` accepted as rounding, rad²/s².
        limit: f64,
    },
    /// The number of modes asked for cannot be kept.
    #[error("{what}: {value} requested, expected {limit}")]
    ModeCount {
        /// Name of the part, model or matrix.
        what: String,
        /// What was asked for.
        value: String,
        /// What is possible.
        limit: String,
    },
    /// No shift makes the pencil positive definite.
    #[error("{what}: no shift up to {value:.3e} rad^2/s^2 makes K + shift M positive definite")]
    NoShift {
        /// Name of the part, model or matrix.
        what: String,
        /// Largest shift tried, rad²/s².
        value: f64,
    },
    /// All modes kept are rigid-body motions, so truncated modes have no residual flexibility.
    #[error(
        "{what}: {modes} modes kept, all of them motions of a rigid body; expected more for the residual of the others"
    )]
    OnlyRigid {
        /// Name of the part, model or matrix.
        what: String,
        /// Number of modes kept.
        modes: usize,
    },
    /// An iteration did not converge.
    #[error("{what}: mode {mode} has residual {value:.3e} after {vectors} vectors, limit {limit:.1e}")]
    NotConverged {
        /// Name of the part, model or matrix.
        what: String,
        /// Index of the first pair that did not converge.
        mode: usize,
        /// Its residual, relative.
        value: f64,
        /// The limit it broke.
        limit: f64,
        /// Number of vectors built.
        vectors: usize,
    },
    /// Fewer or more modes were found than the inertia counts.
    #[error(
        "{what}: {found} modes found below {below:.6e} rad^2/s^2, but the inertia of K - shift M counts {counted} there"
    )]
    MissedModes {
        /// Name of the part, model or matrix.
        what: String,
        /// Number of modes found.
        found: usize,
        /// Number of modes by Sylvester's law of inertia.
        counted: usize,
        /// Both counted below this `ω²`, rad²/s².
        below: f64,
    },
    /// A mode or root and its vector do not fulfil the equation.
    #[error("{what}: mode {mode} has |K phi - omega^2 M phi| = {value:.3e} of its parts, limit {limit:.1e}")]
    Residual {
        /// Name of the part, model or matrix.
        what: String,
        /// Index of the mode or root.
        mode: usize,
        /// Its scaled residual.
        value: f64,
        /// Largest residual accepted.
        limit: f64,
    },
    /// A root inside two discs was found in one only.
    #[error(
        "{what}: the root {growth_per_s:e} + {omega_rad_s:e}i found around {found:e} rad/s was not found around \
         {missed:e} rad/s"
    )]
    MissedRoot {
        /// Name of the part, model or matrix.
        what: String,
        /// `Re λ`, 1/s.
        growth_per_s: f64,
        /// `Im λ`, rad/s.
        omega_rad_s: f64,
        /// Shift around which it was found, rad/s.
        found: f64,
        /// Shift around which it was not, rad/s.
        missed: f64,
    },
    /// The discs around the shifts do not cover the band.
    #[error("{what}: shifts covered the band up to {covered:.6e} rad/s only, expected {band:.6e} rad/s")]
    NotCovered {
        /// Name of the part, model or matrix.
        what: String,
        /// Upper end of what is covered, rad/s.
        covered: f64,
        /// Upper end of the band, rad/s.
        band: f64,
    },
    /// The work needs more memory than allowed; refused before it began.
    #[error(
        "{what}: it needs {:.2} GiB of memory in addition to what is already in use, more than the {:.2} GiB allowed",
        *bytes as f64 / GIB, *limit as f64 / GIB
    )]
    Memory {
        /// Name of the part, model or matrix.
        what: String,
        /// Estimated need, bytes.
        bytes: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// A range of conditions cannot be sampled.
    #[error("{what} is {low} to {high}, expected {limit}")]
    Range {
        /// Name of the part, model or matrix.
        what: String,
        /// Lower end.
        low: f64,
        /// Upper end.
        high: f64,
        /// What the range must fulfil.
        limit: String,
    },
    /// The basis does not reach its tolerance.
    #[error(
        "{what}: |dlambda|/|lambda| is {value:.1e} with {vectors} vectors from {samples} operating points, limit {limit:.1e}"
    )]
    Tolerance {
        /// Name of the part, model or matrix.
        what: String,
        /// Largest relative error of a root.
        value: f64,
        /// The tolerance.
        limit: f64,
        /// Number of vectors in the basis.
        vectors: usize,
        /// Number of operating points sampled.
        samples: usize,
    },
    /// A solve of the reduced model failed.
    #[error("{what}: {source}")]
    Solve {
        /// Name of the part, model or matrix.
        what: String,
        /// Why.
        source: Box<SolveError>,
    },
    /// There is no state of steady sliding.
    #[error(transparent)]
    State(Box<ModelError>),
    /// An engine outside this process failed, or gave a wrong result.
    #[error("{what}: {reason}")]
    Engine {
        /// Name of the part, model or matrix.
        what: String,
        /// Why, and what to do.
        reason: String,
    },
    /// A factorisation or a small dense problem failed.
    #[error("{what}: {reason}")]
    Factorisation {
        /// Name of the part, model or matrix.
        what: String,
        /// Why.
        reason: String,
    },
}
