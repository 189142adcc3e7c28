//! Errors of model reduction.

use crate::physics::SolveError;

/// Bytes in a GiB.
pub const GIB: f64 = (1_u64 << 30) as f64;

/// Error of model reduction, with the offending value and the limit it broke. Rows, columns and modes are counted from
/// 0.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReductionError {
    #[error("{what} is {rows}x{columns}, expected {expected}x{expected}")]
    Shape { what: String, rows: usize, columns: usize, expected: usize },
    #[error("{what}: entry ({row}, {column}) is {value}, expected a finite number")]
    NotFinite { what: String, row: usize, column: usize, value: f64 },
    #[error(
        "{what} is not symmetric: entry ({row}, {column}) is {value}, entry ({column}, {row}) is {mirrored}; \
         they may differ by {limit:.3e}"
    )]
    Unsymmetric { what: String, row: usize, column: usize, value: f64, mirrored: f64, limit: f64 },
    #[error("{what} is not positive definite: its pivot at row {row} is {value:.6e}, expected more than {limit:.3e}")]
    Indefinite { what: String, row: usize, value: f64, limit: f64 },
    #[error(
        "{what} is not positive semidefinite: mode {mode} has omega^2 = {value:.6e} rad^2/s^2, \
         expected at least {limit:.3e}"
    )]
    NegativeStiffness { what: String, mode: usize, value: f64, limit: f64 },
    #[error("{what}: {value} requested, expected {limit}")]
    ModeCount { what: String, value: String, limit: String },
    #[error("{what}: no shift up to {value:.3e} rad^2/s^2 makes K + shift M positive definite")]
    NoShift { what: String, value: f64 },
    #[error(
        "{what}: {modes} modes kept, all of them motions of a rigid body; expected more for the residual of the others"
    )]
    OnlyRigid { what: String, modes: usize },
    #[error("{what}: mode {mode} has residual {value:.3e} after {vectors} vectors, limit {limit:.1e}")]
    NotConverged { what: String, mode: usize, value: f64, limit: f64, vectors: usize },
    #[error(
        "{what}: {found} modes found below {below:.6e} rad^2/s^2, but the inertia of K - shift M counts {counted} there"
    )]
    MissedModes { what: String, found: usize, counted: usize, below: f64 },
    #[error("{what}: mode {mode} has |K phi - omega^2 M phi| = {value:.3e} of its parts, limit {limit:.1e}")]
    Residual { what: String, mode: usize, value: f64, limit: f64 },
    #[error(
        "{what}: the root {growth_per_s:e} + {omega_rad_s:e}i found around {found:e} rad/s was not found around \
         {missed:e} rad/s"
    )]
    MissedRoot { what: String, growth_per_s: f64, omega_rad_s: f64, found: f64, missed: f64 },
    #[error("{what}: shifts covered the band up to {covered:.6e} rad/s only, expected {band:.6e} rad/s")]
    NotCovered { what: String, covered: f64, band: f64 },
    #[error(
        "{what}: it needs {:.2} GiB of memory in addition to what is already in use, more than the {:.2} GiB allowed",
        *bytes as f64 / GIB, *limit as f64 / GIB
    )]
    Memory { what: String, bytes: usize, limit: usize },
    #[error("{what} is {low} to {high}, expected {limit}")]
    Range { what: String, low: f64, high: f64, limit: String },
    #[error(
        "{what}: |dlambda|/|lambda| is {value:.1e} with {vectors} vectors from {samples} operating points, limit {limit:.1e}"
    )]
    Tolerance { what: String, value: f64, limit: f64, vectors: usize, samples: usize },
    #[error("{what}: {source}")]
    Solve { what: String, source: Box<SolveError> },
    #[error("{what}: {reason}")]
    Factorisation { what: String, reason: String },
}
