//! Sparse matrices: sums, products, symmetry and the `L D Lᵀ` factor with its inertia.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LdltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMat, Triplet};
use faer::{Conj, Mat, MatMut, MatRef, Par, Side};

use super::{ReductionError, SYMMETRY_TOLERANCE};

/// Compressed columns, both triangles stored.
pub type SparseMatrix = SparseColMat<usize, f64>;

/// Every entry of a sparse matrix as `(row, column, value)`.
pub(super) fn entries(matrix: &SparseMatrix) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
    matrix.as_ref().triplet_iter().map(|Triplet { row, col, val }| (row, col, *val))
}

/// Whether the matrix is symmetric up to [`SYMMETRY_TOLERANCE`] times its largest entry.
pub fn is_symmetric(matrix: &SparseMatrix) -> bool {
    worst_asymmetry(matrix).is_none()
}

/// The first pair of mirrored entries that differ by too much: `(row, column, value, mirrored, limit)`.
pub(super) fn worst_asymmetry(matrix: &SparseMatrix) -> Option<(usize, usize, f64, f64, f64)> {
    let limit = SYMMETRY_TOLERANCE * entries(matrix).fold(0.0, |largest: f64, (_, _, value)| largest.max(value.abs()));
    let view = matrix.as_ref();
    entries(matrix).find_map(|(row, column, value)| {
        let mirrored = view.get(column, row).copied().unwrap_or(0.0);
        ((value - mirrored).abs() > limit).then_some((row, column, value, mirrored, limit))
    })
}

/// `Σ w A`, every `A` `n×n`.
///
/// # Errors
/// [`ReductionError::Shape`], [`ReductionError::Factorisation`] where memory does not suffice.
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
    let mut product = Mat::zeros(matrix.nrows(), x.ncols());
    for column in 0..x.ncols() {
        for j in 0..matrix.ncols() {
            let factor = x[(j, column)];
            for (i, value) in matrix.as_ref().row_idx_of_col(j).zip(matrix.as_ref().val_of_col(j)) {
                product[(i, column)] += value * factor;
            }
        }
    }
    product
}

/// `P A Pᵀ = L D Lᵀ` of a symmetric matrix, without pivoting: `D` is diagonal and its signs are the inertia of `A`.
pub(super) struct Ldlt {
    symbolic: std::sync::Arc<SymbolicCholesky<usize>>,
    values: Vec<f64>,
}

/// Orders and analyses the pattern of a symmetric matrix once for all shifts.
pub(super) fn analyse(
    what: &str,
    matrix: &SparseMatrix,
) -> Result<std::sync::Arc<SymbolicCholesky<usize>>, ReductionError> {
    factorize_symbolic_cholesky(
        matrix.symbolic(),
        Side::Lower,
        SymmetricOrdering::Amd,
        CholeskySymbolicParams { supernodal_flop_ratio_threshold: SupernodalThreshold::AUTO, ..Default::default() },
    )
    .map(std::sync::Arc::new)
    .map_err(|error| ReductionError::Factorisation {
        what: what.to_owned(),
        reason: format!("symbolic analysis failed: {error:?}"),
    })
}

impl Ldlt {
    /// Factors `matrix`, whose pattern is the analysed one.
    pub(super) fn new(
        what: &str,
        symbolic: &std::sync::Arc<SymbolicCholesky<usize>>,
        matrix: &SparseMatrix,
    ) -> Result<Self, ReductionError> {
        let mut values = vec![0.0; symbolic.len_val()];
        let mut memory = MemBuffer::new(symbolic.factorize_numeric_ldlt_scratch::<f64>(Par::Seq, Default::default()));
        symbolic
            .factorize_numeric_ldlt(
                &mut values,
                matrix.as_ref(),
                Side::Lower,
                Default::default(),
                Par::Seq,
                MemStack::new(&mut memory),
                Default::default(),
            )
            .map_err(|error| ReductionError::Factorisation {
                what: what.to_owned(),
                reason: format!("L D Lᵀ met a zero pivot: {error:?}"),
            })?;
        Ok(Self { symbolic: symbolic.clone(), values })
    }

    /// The pivots `D` with the row of the matrix each belongs to.
    pub(super) fn pivots(&self) -> Vec<(usize, f64)> {
        let forward: Option<&[usize]> = self.symbolic.perm().map(|perm| perm.arrays().0);
        let original = |k: usize| forward.map_or(k, |forward| forward[k]);
        match self.symbolic.raw() {
            SymbolicCholeskyRaw::Simplicial(symbolic) => (0..symbolic.nrows())
                .map(|column| (original(column), self.values[symbolic.col_ptr()[column]]))
                .collect(),
            SymbolicCholeskyRaw::Supernodal(symbolic) => {
                let factor = faer::sparse::linalg::cholesky::supernodal::SupernodalLdltRef::new(symbolic, &self.values);
                (0..symbolic.n_supernodes())
                    .flat_map(|s| {
                        let supernode = factor.supernode(s);
                        let (start, block) = (supernode.start(), supernode.val());
                        (0..block.ncols()).map(move |k| (start + k, block[(k, k)])).collect::<Vec<_>>()
                    })
                    .map(|(column, value)| (original(column), value))
                    .collect()
            }
        }
    }

    /// How many eigenvalues of the factored matrix are below zero (Sylvester's law of inertia).
    pub(super) fn negative_pivots(&self) -> usize {
        self.pivots().iter().filter(|(_, pivot)| *pivot < 0.0).count()
    }

    /// `A⁻¹ B` in place.
    pub(super) fn solve(&self, rhs: MatMut<'_, f64>) {
        let mut memory = MemBuffer::new(self.symbolic.solve_in_place_scratch::<f64>(rhs.ncols(), Par::Seq));
        LdltRef::new(&self.symbolic, &self.values).solve_in_place_with_conj(
            Conj::No,
            rhs,
            Par::Seq,
            MemStack::new(&mut memory),
        );
    }
}
