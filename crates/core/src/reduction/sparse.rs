//! Sparse matrices: sums, products, norms and symmetry.

use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, MatMut, MatRef};

use super::threads::{row_blocks, shared};
use super::{ReductionError, SYMMETRY_TOLERANCE};

/// Sparse matrix in compressed columns; both triangles of a symmetric matrix are stored.
pub type SparseMatrix = SparseColMat<usize, f64>;

/// Number of dense columns multiplied at a time, so that each sparse entry is read once for all of them.
const TOGETHER: usize = 16;
/// Number of rows of a product that a thread computes at a time.
const ROWS_TOGETHER: usize = 16384;

/// Every entry of a sparse matrix as `(row, column, value)`.
pub(super) fn entries(matrix: &SparseMatrix) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
    matrix.as_ref().triplet_iter().map(|Triplet { row, col, val }| (row, col, *val))
}

/// Whether the matrix is symmetric up to [`SYMMETRY_TOLERANCE`] times its largest entry.
pub fn is_symmetric(matrix: &SparseMatrix) -> bool {
    first_asymmetry(matrix, 1.0).is_none()
}

/// An entry that differs from its mirrored one by more than [`SYMMETRY_TOLERANCE`] allows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Asymmetry {
    /// Its row.
    pub row: usize,
    /// Its column.
    pub column: usize,
    /// Its value.
    pub value: f64,
    /// The value at row `column` and column `row`; 0 where there is none.
    pub mirrored: f64,
    /// Largest difference allowed: [`SYMMETRY_TOLERANCE`] times the largest entry.
    pub limit: f64,
}

/// The first entry, by columns, that differs too much from `sign` times its mirrored entry. `sign` is 1 for a symmetric
/// matrix and -1 for a skew one, whose mirrored entries have the opposite sign.
pub fn first_asymmetry(matrix: &SparseMatrix, sign: f64) -> Option<Asymmetry> {
    let limit = SYMMETRY_TOLERANCE * matrix.val().iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    let (starts, rows, values) = (matrix.col_ptr(), matrix.row_idx(), matrix.val());
    // Rows ascend in each column, so the mirrored entries of a column are passed in the order of the columns: a search for
    // each of them would take longer than reading the matrix.
    let mut next = starts.to_vec();
    for column in 0..matrix.ncols() {
        for k in starts[column]..starts[column + 1] {
            let (row, value) = (rows[k], values[k]);
            let mut mirrored = 0.0;
            if row < matrix.ncols() {
                let place = &mut next[row];
                while *place < starts[row + 1] && rows[*place] < column {
                    *place += 1;
                }
                if *place < starts[row + 1] && rows[*place] == column {
                    mirrored = values[*place];
                }
            }
            if (value - sign * mirrored).abs() > limit {
                return Some(Asymmetry { row, column, value, mirrored, limit });
            }
        }
    }
    None
}

/// The weighted sum `Σ w A` of `n×n` matrices, given as `(w, A)`.
///
/// # Errors
/// [`ReductionError::Shape`]; [`ReductionError::Factorisation`] if memory is insufficient.
pub fn weighted_sum(n: usize, terms: &[(f64, &SparseMatrix)]) -> Result<SparseMatrix, ReductionError> {
    let mut triplets = Vec::with_capacity(terms.iter().map(|(_, matrix)| matrix.compute_nnz()).sum());
    for (weight, matrix) in terms {
        if matrix.shape() != (n, n) {
            let (rows, columns) = matrix.shape();
            return Err(ReductionError::Shape { what: "term".to_owned(), rows, columns, expected: n });
        }
        triplets.extend(entries(matrix).map(|(row, column, value)| Triplet::new(row, column, weight * value)));
    }
    SparseMatrix::try_new_from_triplets(n, n, &triplets).map_err(|error| ReductionError::Factorisation {
        what: "sum of terms".to_owned(),
        reason: format!("could not be stored: {error:?}"),
    })
}

/// `A X`, `A` sparse.
pub(super) fn times(matrix: &SparseMatrix, x: MatRef<'_, f64>) -> Mat<f64> {
    let (rows, columns) = (matrix.nrows(), x.ncols());
    let mut product = Mat::zeros(rows, columns);
    let (mut from, mut to) = (vec![], vec![]);
    for first in (0..columns).step_by(TOGETHER) {
        let width = TOGETHER.min(columns - first);
        // Stored row by row, so that the innermost loop runs over adjacent memory.
        from.clear();
        from.extend((0..x.nrows()).flat_map(|i| (0..width).map(move |k| x[(i, first + k)])));
        to.clear();
        to.resize(rows * width, 0.0);
        for j in 0..matrix.ncols() {
            let source = &from[j * width..(j + 1) * width];
            for (i, value) in matrix.as_ref().row_idx_of_col(j).zip(matrix.as_ref().val_of_col(j)) {
                for (sum, factor) in to[i * width..(i + 1) * width].iter_mut().zip(source) {
                    *sum += value * factor;
                }
            }
        }
        for k in 0..width {
            for i in 0..rows {
                product[(i, first + k)] = to[i * width + k];
            }
        }
    }
    product
}

/// `A X`, `A` sparse and symmetric with both triangles.
pub(super) fn symmetric_times(matrix: &SparseMatrix, x: MatRef<'_, f64>) -> Mat<f64> {
    times_transposed(matrix, x)
}

/// `Aᵀ X`, `A` sparse; on all cores.
pub(super) fn times_transposed(matrix: &SparseMatrix, x: MatRef<'_, f64>) -> Mat<f64> {
    let mut product = Mat::zeros(matrix.ncols(), x.ncols());
    let mut first = 0;
    while first < x.ncols() {
        let left = x.ncols() - first;
        let width = [TOGETHER, 8, 4, 1].into_iter().find(|width| *width <= left).unwrap_or(1);
        let (from, to) = (x.subcols(first, width), product.subcols_mut(first, width));
        match width {
            TOGETHER => gather::<TOGETHER>(matrix, from, to),
            8 => gather::<8>(matrix, from, to),
            4 => gather::<4>(matrix, from, to),
            _ => gather::<1>(matrix, from, to),
        }
        first += width;
    }
    product
}

/// `Aᵀ X` of `W` columns.
fn gather<const W: usize>(matrix: &SparseMatrix, x: MatRef<'_, f64>, product: MatMut<'_, f64>) {
    // Stored row by row, so that the innermost loop runs over adjacent memory.
    let mut from = vec![[0.0; W]; x.nrows()];
    for k in 0..W {
        from.iter_mut().zip(x.col(k).iter()).for_each(|(row, value)| row[k] = *value);
    }
    let (starts, rows, values) = (matrix.col_ptr(), matrix.row_idx(), matrix.val());
    shared(row_blocks(product, ROWS_TOGETHER), true, |(first, mut block): (usize, MatMut<'_, f64>)| {
        for j in 0..block.nrows() {
            let entries = starts[first + j]..starts[first + j + 1];
            let mut sum = [0.0; W];
            for (&row, value) in rows[entries.clone()].iter().zip(&values[entries]) {
                sum.iter_mut().zip(&from[row]).for_each(|(sum, factor)| *sum += value * factor);
            }
            sum.iter().enumerate().for_each(|(k, value)| block[(j, k)] = *value);
        }
    });
}

/// `Aᵀ`.
pub(super) fn transposed(matrix: &SparseMatrix) -> Result<SparseMatrix, ReductionError> {
    matrix.as_ref().transpose().to_col_major().map_err(|error| ReductionError::Factorisation {
        what: "transposed matrix".to_owned(),
        reason: format!("could not be stored: {error:?}"),
    })
}

/// The 1-norm, the largest column sum of magnitudes. For a symmetric matrix it bounds the 2-norm.
pub(super) fn one_norm(matrix: &SparseMatrix) -> f64 {
    (0..matrix.ncols()).map(|j| matrix.as_ref().val_of_col(j).iter().map(|value| value.abs()).sum()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use faer::sparse::Triplet;

    use super::*;

    /// Entries without a mirrored one, in each triangle and at the ends of columns.
    #[test]
    fn the_first_asymmetry_is_that_of_a_dense_comparison() {
        let n = 12;
        for missing in 0..40 {
            let stored = |i: usize, j: usize| (i * j + i + j) % 3 != 1;
            let lost = |i: usize, j: usize| (5 * i + 7 * j) % 40 == missing && i != j;
            let places = (0..n).flat_map(|j| (0..n).map(move |i| (i, j)));
            let triplets: Vec<_> = places
                .filter(|&(i, j)| stored(i, j) && !lost(i, j))
                .map(|(i, j)| Triplet::new(i, j, 1.0 + (i * j) as f64))
                .collect();
            let matrix = SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap();
            let dense = matrix.to_dense();
            let places = (0..n).flat_map(|j| (0..n).map(move |i| (i, j)));
            let expected = places.filter(|&(i, j)| dense[(i, j)] != 0.0).find(|&(i, j)| dense[(i, j)] != dense[(j, i)]);
            let found = first_asymmetry(&matrix, 1.0);
            assert_eq!(found.map(|found| (found.row, found.column)), expected, "{missing}");
            assert!(found.is_none_or(|found| found.mirrored == 0.0 && found.value == dense[(found.row, found.column)]));
        }
    }
}
