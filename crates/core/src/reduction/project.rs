//! Projection of matrices on a basis.

use faer::{Mat, MatRef};

use super::sparse::{SparseMatrix, symmetric_times, times};

/// `Φᵀ A Φ`, `k×k`, for a sparse `A`, `n×n`, and a `basis` `Φ`, `n×k`. The result is exactly symmetric if `symmetric`
/// states that `A` is.
pub fn project_sparse(matrix: &SparseMatrix, basis: MatRef<'_, f64>, symmetric: bool) -> Mat<f64> {
    let product = if symmetric { symmetric_times(matrix, basis) } else { times(matrix, basis) };
    mirrored(basis.transpose() * product, symmetric)
}

/// `Φᵀ A Φ`, `k×k`, for a dense `A`, `n×n`, and a `basis` `Φ`, `n×k`. The result is exactly symmetric if `symmetric`
/// states that `A` is.
pub fn project_dense(matrix: MatRef<'_, f64>, basis: MatRef<'_, f64>, symmetric: bool) -> Mat<f64> {
    mirrored(basis.transpose() * (matrix * basis), symmetric)
}

/// Copies the lower triangle to the upper one if `symmetric`: the solver tests for exact symmetry, which rounding would
/// destroy.
fn mirrored(matrix: Mat<f64>, symmetric: bool) -> Mat<f64> {
    if !symmetric {
        return matrix;
    }
    Mat::from_fn(matrix.nrows(), matrix.ncols(), |i, j| matrix[(i.max(j), i.min(j))])
}
