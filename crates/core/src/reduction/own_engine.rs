//! The engine of this crate: nested dissection, supernodal factors and block Lanczos in this process.

use faer::sparse::linalg::solvers::Lu;
use faer::{Mat, c64};

use super::ReductionError;
use super::engine::{ComplexSparseMatrix, Eigenpairs, Engine, Factor, Lowest, Progress, gap_after};
use super::lanczos::{Iteration, capacity};
use super::pencil::{Llt, Pencil};
use super::sparse::{SparseMatrix, symmetric_times};

/// Largest residual of an eigenpair of `C`, relative to its `θ`.
const RESIDUAL_LIMIT: f64 = 1e-12;
/// Number of vectors transformed back at a time.
pub(super) const TOGETHER: usize = 24;

/// Solves in this process.
#[derive(Clone, Copy, Debug, Default)]
pub struct OwnEngine;

impl Engine for OwnEngine {
    fn foreign(&self) -> bool {
        false
    }

    /// Block Lanczos on `L⁻¹ M L⁻ᵀ`.
    fn lowest<'p>(
        &self,
        pencil: &'p Pencil<'_>,
        wanted: &Lowest,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Eigenpairs<'p>, ReductionError> {
        let (n, count) = (pencil.dimension(), wanted.count);
        // One more, because a test removes one.
        #[cfg(test)]
        let count = count + usize::from(crate::spoil::spoilt(crate::spoil::Spoil::Mode));
        let (factor, shift) = factor_from(pencil, wanted.first_shift)?;
        progress(Progress::Factored { shift });
        let square = |theta: f64| 1.0 / theta - shift;
        let iteration = Iteration {
            what: pencil.what,
            dimension: n,
            count,
            capacity: capacity(n, count),
            residual_limit: RESIDUAL_LIMIT,
            seed: wanted.attempt,
        };
        let enough = |theta: &[f64]| match wanted.cutoff {
            Some(_) => theta.len() >= count,
            None => {
                let squares: Vec<f64> = theta.iter().map(|&theta| square(theta)).collect();
                gap_after(&squares, count).is_some()
            }
        };
        let largest = iteration.run(
            &|y| factor.whiten(&symmetric_times(pencil.mass, factor.unwhiten(y).as_ref())),
            &enough,
            &mut |vectors, converged| progress(Progress::Iterated { vectors, converged, wanted: count }),
        )?;
        let mut basis = largest.vectors;
        for first in (0..basis.ncols()).step_by(TOGETHER) {
            let columns = TOGETHER.min(basis.ncols() - first);
            let phi = factor.unwhiten(basis.subcols(first, columns).to_owned());
            basis.subcols_mut(first, columns).copy_from(&phi);
        }
        for (k, theta) in largest.theta.iter().enumerate() {
            basis.col_mut(k).iter_mut().for_each(|value| *value /= theta.sqrt());
        }
        // Copied out of the larger allocation of the basis.
        let phi = basis.as_ref().to_owned();
        let omega_squared = largest.theta.into_iter().map(square).collect();
        let found = Eigenpairs { omega_squared, phi, shift, factor: Some(factor) };
        #[cfg(test)]
        let found = if crate::spoil::spoilt(crate::spoil::Spoil::Mode) { without(found, 2) } else { found };
        Ok(found)
    }

    fn count_below(&self, pencil: &Pencil<'_>, square: f64) -> Result<usize, ReductionError> {
        pencil.count_below(square)
    }

    fn definite<'a>(
        &'a self,
        pencil: &'a Pencil<'_>,
        shift: f64,
    ) -> Result<Option<Box<dyn Factor<f64> + 'a>>, ReductionError> {
        Ok(pencil.llt(shift)?.map(|factor| Box::new(factor) as Box<dyn Factor<f64>>))
    }

    fn real<'a>(&'a self, what: &str, matrix: &SparseMatrix) -> Result<Box<dyn Factor<f64> + 'a>, ReductionError> {
        let factor: Lu<usize, f64> = matrix.sp_lu().map_err(|error| failed(what, &format!("{error:?}")))?;
        Ok(Box::new(factor))
    }

    fn complex<'a>(
        &'a self,
        what: &str,
        matrix: &ComplexSparseMatrix,
    ) -> Result<Box<dyn Factor<c64> + 'a>, ReductionError> {
        let factor: Lu<usize, c64> = matrix.sp_lu().map_err(|error| failed(what, &format!("{error:?}")))?;
        Ok(Box::new(factor))
    }
}

impl Factor<f64> for Llt<'_> {
    fn solve(&self, rhs: &mut Mat<f64>, _transposed: bool) -> Result<(), ReductionError> {
        Llt::solve(self, rhs.as_mut());
        Ok(())
    }
}

impl<T: faer::traits::ComplexField> Factor<T> for Lu<usize, T> {
    fn solve(&self, rhs: &mut Mat<T>, transposed: bool) -> Result<(), ReductionError> {
        use faer::linalg::solvers::Solve;
        if transposed {
            self.solve_transpose_in_place(rhs.as_mut());
        } else {
            self.solve_in_place(rhs.as_mut());
        }
        Ok(())
    }
}

/// Factorises `K + s M = L Lᵀ` with the smallest `s` of the sequence `first`, 100 `first`, ... for which it is positive
/// definite.
///
/// # Errors
/// [`ReductionError`]: `NoShift`, `Factorisation`.
fn factor_from<'p>(pencil: &'p Pencil<'_>, first: f64) -> Result<(Llt<'p>, f64), ReductionError> {
    for shift in pencil.shifts(first) {
        if let Some(factor) = pencil.llt(shift)? {
            return Ok((factor, shift));
        }
    }
    Err(pencil.no_shift())
}

fn failed(what: &str, reason: &str) -> ReductionError {
    ReductionError::Factorisation { what: what.to_owned(), reason: format!("the sparse factor failed: {reason}") }
}

/// `found` without the mode at index `lost`.
#[cfg(test)]
fn without(found: Eigenpairs<'_>, lost: usize) -> Eigenpairs<'_> {
    let Eigenpairs { mut omega_squared, phi, shift, factor } = found;
    omega_squared.remove(lost);
    let kept = |column: usize| if column < lost { column } else { column + 1 };
    let phi = Mat::from_fn(phi.nrows(), omega_squared.len(), |i, j| phi[(i, kept(j))]);
    Eigenpairs { omega_squared, phi, shift, factor }
}
