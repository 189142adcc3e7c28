//! Projection of terms on a basis.

use faer::{Mat, MatRef};

use super::sparse::{SparseMatrix, times};

/// `Φᵀ A Φ` of a sparse `A`, `n×n`, on `basis`, `n×k`; exactly symmetric where `symmetric` says that `A` is.
pub fn project_sparse(matrix: &SparseMatrix, basis: MatRef<'_, f64>, symmetric: bool) -> Mat<f64> {
    mirrored(basis.transpose() * times(matrix, basis), symmetric)
}

/// `Φᵀ A Φ` of a dense `A`, `n×n`, on `basis`, `n×k`; exactly symmetric where `symmetric` says that `A` is.
pub fn project_dense(matrix: MatRef<'_, f64>, basis: MatRef<'_, f64>, symmetric: bool) -> Mat<f64> {
    mirrored(basis.transpose() * (matrix * basis), symmetric)
}

/// Copies the lower triangle to the upper one: rounding must not hide a symmetry that the solver looks for.
fn mirrored(matrix: Mat<f64>, symmetric: bool) -> Mat<f64> {
    if !symmetric {
        return matrix;
    }
    Mat::from_fn(matrix.nrows(), matrix.ncols(), |i, j| matrix[(i.max(j), i.min(j))])
}
