//! Static displacement under a self-equilibrated load.

use faer::Mat;

use super::pencil::Pencil;
use super::sparse::{entries, symmetric_times};
use super::{ReductionError, SparseMatrix};

/// Shift of the stiffness, relative to `tr K / tr M`, that makes the matrix of a free body definite.
const SHIFT: f64 = 1e-6;
/// Change of the displacement, relative to it, at which the iteration ends; both are measured by their strain energy,
/// which a drift as a rigid body does not have.
const SETTLED: f64 = 1e-12;
/// Largest number of steps. The error falls by `s / (ω² + s)` in each, with the lowest `ω` that the load excites.
const MOST_STEPS: usize = 100;

/// The displacement `u`, `n×1`, m, of `K u = f` under a `load` `f`, `n×1`, N. `K` may have rigid-body motions, if the
/// load does no work on them; `u` then contains a small part of these motions, from rounding, which causes no strain.
///
/// `(K + s M) Δu = f - K u` is iterated, so that the shift `s` leaves no error.
///
/// # Errors
/// Those of [`lowest_modes`](super::lowest_modes) for unsuitable matrices; [`ReductionError::Factorisation`] if the
/// stiffness is indefinite or the iteration does not settle.
pub fn balanced_displacement(
    mass: &SparseMatrix,
    stiffness: &SparseMatrix,
    load: Mat<f64>,
) -> Result<Mat<f64>, ReductionError> {
    let pencil = Pencil::new("structure", mass, stiffness)?;
    let failed =
        |reason: &str| ReductionError::Factorisation { what: "structure".to_owned(), reason: reason.to_owned() };
    let trace = |matrix: &SparseMatrix| entries(matrix).filter(|e| e.0 == e.1).map(|e| e.2.abs()).sum::<f64>();
    let shift = SHIFT * trace(stiffness) / trace(mass);
    let factor = pencil.llt(shift)?.ok_or_else(|| failed("the stiffness is not positive semidefinite"))?;
    let mut displacement = Mat::<f64>::zeros(load.nrows(), load.ncols());
    for _ in 0..MOST_STEPS {
        let mut step = &load - symmetric_times(stiffness, displacement.as_ref());
        factor.solve(step.as_mut());
        displacement += &step;
        let energy = |u: &Mat<f64>| u.col(0).transpose() * symmetric_times(stiffness, u.as_ref()).col(0);
        if energy(&step).max(0.0) <= SETTLED * SETTLED * energy(&displacement) {
            return Ok(displacement);
        }
    }
    Err(failed("the displacement under a static load does not settle"))
}
