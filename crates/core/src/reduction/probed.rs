//! Factors of a pencil, and what is left of it after elimination, each probed before it is used: threads share the work.

use faer::{Mat, MatMut, MatRef};

use super::ReductionError;
use super::front_blocks::Broken;
use super::fronts::{Border, Condensed};
use super::krylov::random_block;
use super::pencil::{Ldlt, Llt, Pencil};
use super::sparse::{one_norm, symmetric_times};

/// Largest `|A x - b|` of the probe of a factor, relative to `|A| |x| + |b|`.
const PROBE_LIMIT: f64 = 1e-12;
/// As [`PROBE_LIMIT`], for the derivative of a condensed matrix, relative to `|M| |x|`.
const SLOPE_LIMIT: f64 = 1e-8;

impl Pencil<'_> {
    /// `(K + s M) x`.
    pub(super) fn shifted_times(&self, shift: f64, x: MatRef<'_, f64>) -> Mat<f64> {
        symmetric_times(self.stiffness, x) + faer::Scale(shift) * symmetric_times(self.mass, x)
    }

    /// Cholesky factor `K + s M = L Lᵀ`, probed by a solve; `None` if the matrix is not positive definite.
    pub(super) fn llt(&self, shift: f64) -> Result<Option<Llt<'_>>, ReductionError> {
        let mut values = self.room(self.factor_entries())?;
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
        self.probe(shift, |x| factor.solve(x))?;
        Ok(Some(factor))
    }

    /// Factorises `P (K + s M) Pᵀ = L D Lᵀ`, probed by a solve if it is definite. There is no numerical pivoting, so that of
    /// an indefinite matrix may be less accurate: callers must check their solves.
    pub(super) fn ldlt(&self, shift: f64) -> Result<Ldlt, ReductionError> {
        let factor = self.factored(&self.fronts(shift))?;
        if factor.pivots().iter().all(|pivot| *pivot > 0.0) {
            self.probe(shift, |x| factor.solve(x))?;
        }
        Ok(factor)
    }

    /// Checks that `solve` solves with `K + s M`.
    fn probe(&self, shift: f64, solve: impl FnOnce(MatMut<'_, f64>)) -> Result<(), ReductionError> {
        let b = random_block(self.dimension(), 1, 3);
        let mut x = b.clone();
        solve(x.as_mut());
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

    /// Eliminates all but the last rows of `K + s M`, bordered by `columns`, with the derivative by `s`; `None` if the
    /// matrix is not positive definite. What is left is probed: `x` random, `b = A x` is condensed with the matrix, and
    /// the condensed equations must hold for the last rows of `x`, as must their derivatives.
    pub(super) fn condense(
        &self,
        shift: f64,
        last: &[usize],
        columns: MatRef<'_, f64>,
    ) -> Result<Option<Condensed>, ReductionError> {
        let (n, c, k) = (self.dimension(), last.len(), columns.ncols());
        let x = random_block(n, 1, 5);
        let last_slope = symmetric_times(self.mass, x.as_ref());
        let mut value = Mat::zeros(n, k + 1);
        value.subcols_mut(0, k).copy_from(columns);
        value.subcols_mut(k, 1).copy_from(self.shifted_times(shift, x.as_ref()));
        let border = Border { value: value.as_ref(), last_slope: last_slope.as_ref() };
        let found = match self.fronts(shift).condense(c, &border) {
            Ok(found) => found,
            Err(Broken::Indefinite) => return Ok(None),
            Err(Broken::Pivot) => return Err(self.broken()),
        };
        #[cfg(test)]
        let found = {
            let mut found = found;
            if crate::spoil::spoilt(crate::spoil::Spoil::Factor) {
                found.value[(0, 0)] *= 1.0 + 1e-6;
            }
            if crate::spoil::spoilt(crate::spoil::Spoil::Slope) {
                found.slope[(0, 0)] *= 1.0 + 1e-4;
            }
            found
        };
        for (matrix, norm, limit) in [
            (&found.value, one_norm(self.stiffness) + shift.abs() * one_norm(self.mass), PROBE_LIMIT),
            (&found.slope, one_norm(self.mass), SLOPE_LIMIT),
        ] {
            let mut rest: Vec<f64> = (0..c).map(|i| -matrix[(c + k, i)]).collect();
            for j in 0..c {
                for i in 0..c {
                    rest[i] += matrix[(i.max(j), i.min(j))] * x[(last[j], 0)];
                }
            }
            let size = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
            let value = size(&mut rest.into_iter()) / (norm * size(&mut last.iter().map(|&row| x[(row, 0)])));
            if value.is_nan() || value > limit {
                return Err(self.failed(format!(
                    "condensed to its contact, it differs by {value:.1e} from its entries, limit {limit:.1e}"
                )));
            }
        }
        Ok(Some(found))
    }
}
