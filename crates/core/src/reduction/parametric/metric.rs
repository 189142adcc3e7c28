//! The norm in which vectors of a parametric basis are orthogonal and errors are measured.

use faer::{Mat, MatRef};

use super::super::full_model::FullModel;
use super::super::sparse::{SparseMatrix, symmetric_times, transposed};
use super::super::{ReductionError, weighted_sum};
use crate::physics::Situation;

/// Square root of the shift `σ` of `S`, relative to the end of the band. The shift only makes `S` definite where the
/// model has rigid-body modes.
const SHIFT: f64 = 0.05;
/// Number of columns multiplied with `S` at a time.
const TOGETHER: usize = 16;

/// The metric `S = sym K + σ M` in one situation.
pub struct Metric<'a> {
    full: &'a FullModel,
    pub here: Situation,
    /// The shift, rad²/s².
    pub sigma: f64,
    /// `S` of a model that is not just parts joined by contact; products with one matrix are several times faster.
    sum: Option<SparseMatrix>,
}

impl<'a> Metric<'a> {
    /// The metric `here`, for a band up to `band_rad_s`.
    pub fn new(full: &'a FullModel, here: Situation, band_rad_s: f64) -> Self {
        Self { full, here, sigma: (SHIFT * band_rad_s).powi(2), sum: None }
    }

    /// Assembles `S` for faster products; returns `M` and `sym K`.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`] if memory is insufficient.
    pub fn assemble(&mut self) -> Result<[SparseMatrix; 2], ReductionError> {
        let n = self.full.dimension();
        let [mass, _, stiffness] = self.full.matrices_in(&self.here)?;
        let symmetric = weighted_sum(n, &[(0.5, &stiffness), (0.5, &transposed(&stiffness)?)])?;
        self.sum = Some(weighted_sum(n, &[(self.sigma, &mass), (1.0, &symmetric)])?);
        Ok([mass, symmetric])
    }

    pub fn times(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        if let Some(sum) = &self.sum {
            return symmetric_times(sum, x);
        }
        let mut product = Mat::zeros(x.nrows(), x.ncols());
        for first in (0..x.ncols()).step_by(TOGETHER) {
            let columns = TOGETHER.min(x.ncols() - first);
            let x = x.subcols(first, columns);
            let mass = faer::Scale(self.sigma) * self.full.mass_times(x);
            let sum = mass + self.full.symmetric_stiffness_times(&self.here, x);
            product.subcols_mut(first, columns).copy_from(sum);
        }
        product
    }

    /// `Xᵀ S X`, exactly symmetric.
    pub fn gram(&self, x: &Mat<f64>) -> Mat<f64> {
        let gram = x.transpose() * self.times(x.as_ref());
        Mat::from_fn(gram.nrows(), gram.ncols(), |i, j| 0.5 * (gram[(i, j)] + gram[(j, i)]))
    }
}
