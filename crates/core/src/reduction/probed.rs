//! Factors of a pencil, each probed before it is used, since threads share the work.

use faer::{Mat, MatRef};

use super::ReductionError;
use super::front_blocks::Broken;
use super::krylov::random_block;
use super::ldlt::Ldlt;
use super::pencil::{Llt, Pencil};
use super::precision::{Precision, zeros};
use super::refinement::{Stalled, refined};
use super::sparse::{one_norm, symmetric_times};

/// Largest `|A x - b|` of the probe of a factor, relative to `|A| |x| + |b|`.
const PROBE_LIMIT: f64 = 1e-12;

impl Pencil<'_> {
    /// `(K + s M) x`.
    pub(super) fn shifted_times(&self, shift: f64, x: MatRef<'_, f64>) -> Mat<f64> {
        symmetric_times(self.stiffness, x) + faer::Scale(shift) * symmetric_times(self.mass, x)
    }

    /// Cholesky factor `K + s M = L Lᵀ`, probed by a solve; `None` if the matrix is not positive definite.
    pub(super) fn llt(&self, shift: f64) -> Result<Option<Llt<'_>>, ReductionError> {
        let mut values = zeros(self.factor_entries()).ok_or_else(|| self.no_memory())?;
        match self.fronts(shift).cholesky(&mut values) {
            Ok(()) => {}
            Err(Broken::Indefinite) => return Ok(None),
            Err(Broken::Pivot) => return Err(self.broken()),
        }
        #[cfg(test)]
        if crate::spoil::spoilt(crate::spoil::Spoil::Factor) {
            values[0] *= 1.0 + 1e-6;
        }
        let factor = Llt::new(self, values);
        self.probe(shift, |b| {
            let mut x = b.to_owned();
            factor.solve(x.as_mut());
            Ok(x)
        })?;
        Ok(Some(factor))
    }

    /// Factorises `P (K + s M) Pᵀ = L D Lᵀ`, probed by a solve if it is definite. There is no numerical pivoting, so that of
    /// an indefinite matrix may be less accurate: callers must check their solves.
    pub(super) fn ldlt(&self, shift: f64, precision: Precision) -> Result<Ldlt, ReductionError> {
        let factor = self.factored(&self.fronts(shift), precision)?;
        if factor.pivots().iter().all(|pivot| *pivot > 0.0) {
            self.probe(shift, |b| match precision {
                Precision::Double => Ok(factor.solve(b)),
                Precision::Single => refined(b, |x| self.shifted_times(shift, x), |r| factor.solve(r)),
            })?;
        }
        Ok(factor)
    }

    /// Checks that `solve` solves with `K + s M`.
    fn probe(
        &self,
        shift: f64,
        solve: impl FnOnce(MatRef<'_, f64>) -> Result<Mat<f64>, Stalled>,
    ) -> Result<(), ReductionError> {
        let b = random_block(self.dimension(), 1, 3);
        let x = solve(b.as_ref()).map_err(|stalled| self.failed(stalled.reason()))?;
        let norm = one_norm(self.stiffness) + shift.abs() * one_norm(self.mass);
        let rest = (self.shifted_times(shift, x.as_ref()) - &b).norm_l2();
        let value = rest / (norm * x.norm_l2() + b.norm_l2());
        if value.is_nan() || value > PROBE_LIMIT {
            return Err(
                self.failed(format!("a solve leaves |A x - b| = {value:.1e} of its parts, limit {PROBE_LIMIT:.1e}"))
            );
        }
        Ok(())
    }
}
