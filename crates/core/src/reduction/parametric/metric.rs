//! The norm in which vectors of a parametric basis are orthogonal and errors are measured.

use faer::{Mat, MatRef};

use super::super::full_model::FullModel;
use super::super::sparse::{SparseMatrix, transposed};
use super::super::{ReductionError, weighted_sum};
use super::request::ParametricRequest;
use crate::physics::Situation;

/// Square root of the shift `σ` of `S`, relative to the end of the band. The shift only makes `S` definite where the
/// model has rigid-body modes.
const SHIFT: f64 = 0.05;
/// Number of columns multiplied with `S` at a time.
const TOGETHER: usize = 16;

/// The metric `S = sym K + σ M` at the middle of the box, without friction.
pub struct Metric<'a> {
    full: &'a FullModel,
    /// Middle of the box, without friction.
    pub middle: Situation,
    /// The shift, rad²/s².
    pub sigma: f64,
}

impl<'a> Metric<'a> {
    /// # Errors
    /// [`ReductionError::State`] if the middle has no contact state.
    pub fn new(full: &'a FullModel, request: &ParametricRequest) -> Result<Self, ReductionError> {
        let middle = full.at(&request.range.at([0.5; 3]).with_friction(0.0))?;
        Ok(Self { full, middle, sigma: (SHIFT * request.counted.band_rad_s).powi(2) })
    }

    /// `M` and `sym K`.
    pub fn assembled(&self) -> Result<[SparseMatrix; 2], ReductionError> {
        let [mass, _, stiffness] = self.full.matrices_in(&self.middle)?;
        let symmetric = weighted_sum(self.full.dimension(), &[(0.5, &stiffness), (0.5, &transposed(&stiffness)?)])?;
        Ok([mass, symmetric])
    }

    pub fn times(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        let mut product = Mat::zeros(x.nrows(), x.ncols());
        for first in (0..x.ncols()).step_by(TOGETHER) {
            let columns = TOGETHER.min(x.ncols() - first);
            let x = x.subcols(first, columns);
            let mass = faer::Scale(self.sigma) * self.full.mass_times(x);
            let sum = mass + self.full.symmetric_stiffness_times(&self.middle, x);
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
