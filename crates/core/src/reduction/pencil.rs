//! The pencil `K - σ M` of a sparse symmetric system: analysed once, factorised at many shifts.

use std::sync::Arc;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::{solve_unit_lower_triangular_in_place, solve_unit_upper_triangular_in_place};
use faer::perm::Perm;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::supernodal::{SupernodalLdltRef, SupernodalLltRef, SymbolicSupernodalCholesky};
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMat, SparseColMatRef, SymbolicSparseColMat};
use faer::{Accum, Conj, Mat, MatMut, Par, Side};

use super::fronts::Fronts;
use super::krylov::random_block;
use super::ordering::nested_dissection;
use super::sparse::{entries, symmetric_times, worst_asymmetry};
use super::threads::shared;
use super::{ReductionError, SEMIDEFINITE_TOLERANCE, SparseMatrix};

/// Largest number of columns that a thread solves at a time.
const SOLVED_TOGETHER: usize = 8;
/// Upper limit of the shifts to try, relative to `tr K / tr M`.
const LARGEST_SHIFT: f64 = 1e5;
/// Number of Lanczos steps to estimate the smallest eigenvalue of a scaled mass matrix.
const MASS_STEPS: usize = 40;
/// Estimated smallest eigenvalue of a scaled mass matrix above which it counts as positive definite without a
/// factorisation.
const CLEARLY_DEFINITE: f64 = 1e-3;

/// A symmetric pencil `K - σ M`: the lower triangles on a common pattern, ordered and symbolically analysed.
pub struct Pencil<'a> {
    /// Names the system in errors.
    pub what: &'a str,
    /// `M`, kg, both triangles.
    pub mass: &'a SparseMatrix,
    /// `K`, N/m, both triangles.
    pub stiffness: &'a SparseMatrix,
    pattern: SymbolicSparseColMat<usize>,
    lower_mass: Vec<f64>,
    lower_stiffness: Vec<f64>,
    pub(super) symbolic: Arc<SymbolicCholesky<usize>>,
}

impl<'a> Pencil<'a> {
    /// Checks both matrices, orders their common pattern by nested dissection and analyses it symbolically; `what`
    /// names the system in errors.
    pub(super) fn new(
        what: &'a str,
        mass: &'a SparseMatrix,
        stiffness: &'a SparseMatrix,
    ) -> Result<Self, ReductionError> {
        Self::with_last(what, mass, stiffness, &[])
    }

    /// Like [`Self::new`], with the rows `last` eliminated after all others, in the given order.
    pub(super) fn with_last(
        what: &'a str,
        mass: &'a SparseMatrix,
        stiffness: &'a SparseMatrix,
        last: &[usize],
    ) -> Result<Self, ReductionError> {
        let n = mass.nrows();
        check("mass", what, mass, n)?;
        check("stiffness", what, stiffness, n)?;
        let (mut starts, mut rows) = (vec![0], vec![]);
        let (mut lower_mass, mut lower_stiffness) = (vec![], vec![]);
        for column in 0..n {
            merge(mass, stiffness, column, |row, m, k| {
                if row >= column {
                    rows.push(row);
                    lower_mass.push(m);
                    lower_stiffness.push(k);
                }
            });
            starts.push(rows.len());
        }
        let pattern = SymbolicSparseColMat::new_checked(n, n, starts, None, rows);
        let failed = |reason| ReductionError::Factorisation { what: what.to_owned(), reason };
        let order = ordered(mass, stiffness, last).map_err(failed)?;
        let symbolic = factorize_symbolic_cholesky(
            pattern.as_ref(),
            Side::Lower,
            SymmetricOrdering::Custom(order.as_ref()),
            CholeskySymbolicParams {
                supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
                ..Default::default()
            },
        )
        .map_err(|error| failed(format!("symbolic analysis failed: {error:?}")))?;
        let symbolic = Arc::new(symbolic);
        let pencil = Self { what, mass, stiffness, pattern, lower_mass, lower_stiffness, symbolic };
        pencil.check_mass()?;
        Ok(pencil)
    }

    /// Number of degrees of freedom.
    pub fn dimension(&self) -> usize {
        self.mass.nrows()
    }

    /// `tr K / tr M`, rad²/s².
    pub(super) fn typical_square(&self) -> f64 {
        let trace = |matrix: &SparseMatrix| entries(matrix).filter(|e| e.0 == e.1).map(|e| e.2.abs()).sum::<f64>();
        (trace(self.stiffness) / trace(self.mass)).max(f64::MIN_POSITIVE)
    }

    /// The shifts `s` to try until `K + s M` is positive definite: `first`, 100 `first`, ..., rad²/s².
    pub fn shifts(&self, first: f64) -> impl Iterator<Item = f64> + use<> {
        let most = self.typical_square() * LARGEST_SHIFT;
        std::iter::successors(Some(first), |shift| Some(shift * 100.0)).take_while(move |shift| *shift < most)
    }

    /// The error where none of [`Self::shifts`] serves.
    pub fn no_shift(&self) -> ReductionError {
        ReductionError::NoShift { what: self.what.to_owned(), value: self.typical_square() * LARGEST_SHIFT }
    }

    /// Number of entries of a factor.
    pub(super) fn factor_entries(&self) -> usize {
        self.symbolic.len_val()
    }

    /// Bytes held after the analysis in addition to the two given matrices: their lower triangles and the symbolic
    /// factor.
    pub(super) fn held_bytes(&self) -> usize {
        let (index, float) = (size_of::<usize>(), size_of::<f64>());
        let supernodes = supernodal(&self.symbolic);
        // Row indices of the supernodes, by columns and by rows; the permutation and its inverse; offsets of columns
        // and supernodes.
        let analysis = 2 * supernodes.row_idx().len() + 6 * self.dimension();
        (index + 2 * float) * self.lower_mass.len() + index * analysis
    }

    /// Bytes of one factor.
    pub(super) fn factor_bytes(&self) -> usize {
        size_of::<f64>() * self.factor_entries()
    }

    /// Additional bytes needed while a factor is computed: the shifted matrix and the workspace of faer.
    pub(super) fn factoring_bytes(&self) -> usize {
        let ldlt = self.symbolic.factorize_numeric_ldlt_scratch::<f64>(Par::Seq, Default::default());
        let fronts = Fronts::bytes(supernodal(&self.symbolic), 0, false);
        fronts.max(size_of::<f64>() * self.lower_mass.len() + ldlt.size_bytes())
    }

    /// Bytes needed to condense to the last rows with a border of `border` columns.
    pub(super) fn condensing_bytes(&self, border: usize) -> usize {
        Fronts::bytes(supernodal(&self.symbolic), border, true)
    }

    /// The lower triangle of `k K + m M`.
    fn sum(&self, k: f64, m: f64) -> Vec<f64> {
        self.lower_stiffness.iter().zip(&self.lower_mass).map(|(stiffness, mass)| k * stiffness + m * mass).collect()
    }

    /// `K + s M`, to be eliminated front by front.
    pub(super) fn fronts(&self, shift: f64) -> Fronts<'_> {
        let order = self.symbolic.perm().expect("a permutation was given").arrays();
        Fronts { stiffness: self.stiffness, mass: self.mass, shift, supernodes: supernodal(&self.symbolic), order }
    }

    /// Number of `ω²` below `square`, rad²/s²: the number of negative pivots of `K - σ M = L D Lᵀ` (Sylvester's law of
    /// inertia).
    pub(super) fn count_below(&self, square: f64) -> Result<usize, ReductionError> {
        self.fronts(-square).count_negative().map_err(|_| self.broken())
    }

    pub(super) fn broken(&self) -> ReductionError {
        self.failed("a pivot is 0 or not finite".to_owned())
    }

    /// Factorises `P (K - σ M) Pᵀ = L D Lᵀ` with `σ = square`. There is no numerical pivoting, so callers must check
    /// the accuracy of solves.
    pub(super) fn ldlt(&self, square: f64) -> Result<Ldlt, ReductionError> {
        self.factor_ldlt(&self.sum(1.0, -square))
    }

    fn factor_ldlt(&self, lower: &[f64]) -> Result<Ldlt, ReductionError> {
        let mut values = self.room(self.symbolic.len_val())?;
        let mut memory =
            MemBuffer::new(self.symbolic.factorize_numeric_ldlt_scratch::<f64>(Par::Seq, Default::default()));
        self.symbolic
            .factorize_numeric_ldlt(
                &mut values,
                SparseColMatRef::new(self.pattern.as_ref(), lower),
                Side::Lower,
                Default::default(),
                Par::Seq,
                MemStack::new(&mut memory),
                Default::default(),
            )
            .map_err(|error| self.failed(format!("L D Lᵀ met a zero pivot: {error:?}")))?;
        Ok(Ldlt { symbolic: self.symbolic.clone(), values })
    }

    /// The pivots of `L D Lᵀ`, each with its row.
    fn pivots(&self, lower: &[f64]) -> Result<Vec<(usize, f64)>, ReductionError> {
        let factor = self.factor_ldlt(lower)?;
        Ok(forward(&self.symbolic).iter().copied().zip(factor.pivots()).collect())
    }

    /// Checks that `M` is positive semidefinite with a positive diagonal. The mass matrix of a mesh, scaled to a unit
    /// diagonal, has eigenvalues well above zero, which a short Lanczos recurrence usually shows. Otherwise `M` is
    /// factorised with its diagonal raised by [`SEMIDEFINITE_TOLERANCE`]: a singular `M` is valid, because CalculiX
    /// assigns a singular mass to the incompatible modes of its bricks.
    fn check_mass(&self) -> Result<(), ReductionError> {
        let what = format!("{}.mass", self.what);
        let diagonal: Vec<f64> =
            (0..self.dimension()).map(|row| self.mass.as_ref().get(row, row).copied().unwrap_or(0.0)).collect();
        if let Some((row, &value)) = diagonal.iter().enumerate().find(|(_, value)| **value <= 0.0) {
            return Err(ReductionError::Indefinite { what, row, value, limit: 0.0 });
        }
        if smallest_scaled(self.mass, &diagonal).is_some_and(|smallest| smallest > CLEARLY_DEFINITE) {
            return Ok(());
        }
        let mut raised = self.sum(0.0, 1.0);
        for (column, &start) in self.pattern.col_ptr()[..self.dimension()].iter().enumerate() {
            // The first entry of a column of the lower triangle is its diagonal.
            raised[start] += SEMIDEFINITE_TOLERANCE * diagonal[column];
        }
        match self.pivots(&raised)?.into_iter().find(|(_, value)| value.is_nan() || *value <= 0.0) {
            Some((row, value)) => Err(ReductionError::Indefinite { what, row, value, limit: 0.0 }),
            None => Ok(()),
        }
    }

    /// A vector of zeros, or an error if memory is insufficient.
    pub(super) fn room(&self, length: usize) -> Result<Vec<f64>, ReductionError> {
        let mut values = vec![];
        values
            .try_reserve_exact(length)
            .map_err(|_| self.failed(format!("no memory for a factor of {length} numbers")))?;
        values.resize(length, 0.0);
        Ok(values)
    }

    pub(super) fn failed(&self, reason: String) -> ReductionError {
        ReductionError::Factorisation { what: self.what.to_owned(), reason }
    }
}

/// Cholesky factor `P (K + s M) Pᵀ = L Lᵀ`.
pub(super) struct Llt<'a> {
    pub(super) symbolic: &'a SymbolicCholesky<usize>,
    pub(super) values: Vec<f64>,
}

impl Llt<'_> {
    fn supernodal(&self) -> SupernodalLltRef<'_, usize, f64> {
        SupernodalLltRef::new(supernodal(self.symbolic), &self.values)
    }

    /// Solves for blocks of columns, on all cores; the blocks do not depend on their number.
    fn in_blocks(&self, rhs: MatMut<'_, f64>, solve: impl Fn(MatMut<'_, f64>, &mut MemStack) + Sync) {
        let (mut blocks, mut rest) = (vec![], rhs);
        let width = rest.ncols().div_ceil(rest.ncols().div_ceil(SOLVED_TOGETHER).max(1));
        while rest.ncols() > 0 {
            let at = width.min(rest.ncols());
            let (block, others) = rest.split_at_col_mut(at);
            blocks.push(block);
            rest = others;
        }
        shared(blocks, true, |block: MatMut<'_, f64>| {
            let mut memory = MemBuffer::new(self.symbolic.solve_in_place_scratch::<f64>(block.ncols(), Par::Seq));
            solve(block, MemStack::new(&mut memory));
        });
    }

    /// `A⁻¹ B` in place.
    pub(super) fn solve(&self, rhs: MatMut<'_, f64>) {
        let factor = LltRef::new(self.symbolic, &self.values);
        self.in_blocks(rhs, |block, stack| factor.solve_in_place_with_conj(Conj::No, block, Par::Seq, stack));
    }

    /// `L⁻¹ P X`.
    pub(super) fn whiten(&self, x: &Mat<f64>) -> Mat<f64> {
        let forward = forward(self.symbolic);
        let mut y = Mat::from_fn(x.nrows(), x.ncols(), |i, j| x[(forward[i], j)]);
        let factor = self.supernodal();
        self.in_blocks(y.as_mut(), |block, stack| factor.l_solve_with_conj(Conj::No, block, Par::Seq, stack));
        y
    }

    /// `Pᵀ L⁻ᵀ Y`.
    pub(super) fn unwhiten(&self, mut y: Mat<f64>) -> Mat<f64> {
        let factor = self.supernodal();
        self.in_blocks(y.as_mut(), |block, stack| factor.l_transpose_solve_with_conj(Conj::No, block, Par::Seq, stack));
        let mut x = Mat::zeros(y.nrows(), y.ncols());
        for (position, &row) in forward(self.symbolic).iter().enumerate() {
            for column in 0..y.ncols() {
                x[(row, column)] = y[(position, column)];
            }
        }
        x
    }
}

/// The factor `P (K - σ M) Pᵀ = L D Lᵀ`; vectors are in the order of elimination.
pub(super) struct Ldlt {
    symbolic: Arc<SymbolicCholesky<usize>>,
    values: Vec<f64>,
}

impl Ldlt {
    fn supernodal(&self) -> SupernodalLdltRef<'_, usize, f64> {
        SupernodalLdltRef::new(supernodal(&self.symbolic), &self.values)
    }

    /// The row eliminated at each position of the elimination order.
    pub(super) fn order(&self) -> &[usize] {
        forward(&self.symbolic)
    }

    /// The pivots, the diagonal of `D`.
    pub(super) fn pivots(&self) -> Vec<f64> {
        let factor = self.supernodal();
        let mut pivots = vec![0.0; self.symbolic.nrows()];
        for s in 0..supernodal(&self.symbolic).n_supernodes() {
            let (start, block) = (factor.supernode(s).start(), factor.supernode(s).val());
            (0..block.ncols()).for_each(|k| pivots[start + k] = block[(k, k)]);
        }
        pivots
    }

    /// Trailing block of `L` for the `count` rows eliminated last, dense.
    pub(super) fn trailing(&self, count: usize) -> Mat<f64> {
        let first = self.symbolic.nrows() - count;
        let factor = self.supernodal();
        let mut lower = Mat::<f64>::identity(count, count);
        for s in 0..supernodal(&self.symbolic).n_supernodes() {
            let node = factor.supernode(s);
            let (start, block, pattern) = (node.start(), node.val(), node.pattern());
            for k in first.saturating_sub(start)..block.ncols() {
                for i in k + 1..block.nrows() {
                    let row = if i < block.ncols() { start + i } else { pattern[i - block.ncols()] };
                    lower[(row - first, start + k - first)] = block[(i, k)];
                }
            }
        }
        lower
    }

    /// `L⁻¹ Z` in place.
    pub(super) fn forward(&self, z: &mut Mat<f64>) {
        let (factor, columns) = (self.supernodal(), z.ncols());
        let mut below = Mat::<f64>::zeros(0, columns);
        for s in 0..supernodal(&self.symbolic).n_supernodes() {
            let node = factor.supernode(s);
            let (start, block, pattern) = (node.start(), node.val(), node.pattern());
            let (top, rest) = block.split_at_row(block.ncols());
            let mut of_node = z.subrows_mut(start, block.ncols());
            solve_unit_lower_triangular_in_place(top, of_node.as_mut(), Par::Seq);
            below.resize_with(pattern.len(), columns, |_, _| 0.0);
            matmul(below.as_mut(), Accum::Replace, rest, of_node.as_ref(), 1.0, Par::Seq);
            for column in 0..columns {
                let (from, to) = (below.col_as_slice(column), z.col_as_slice_mut(column));
                pattern.iter().zip(from).for_each(|(&row, value)| to[row] -= value);
            }
        }
    }

    /// `L⁻ᵀ Z` in place.
    pub(super) fn backward(&self, z: &mut Mat<f64>) {
        let (factor, columns) = (self.supernodal(), z.ncols());
        let mut below = Mat::<f64>::zeros(0, columns);
        for s in (0..supernodal(&self.symbolic).n_supernodes()).rev() {
            let node = factor.supernode(s);
            let (start, block, pattern) = (node.start(), node.val(), node.pattern());
            let (top, rest) = block.split_at_row(block.ncols());
            below.resize_with(pattern.len(), columns, |_, _| 0.0);
            for column in 0..columns {
                let (from, to) = (z.col_as_slice(column), below.col_as_slice_mut(column));
                pattern.iter().zip(to).for_each(|(&row, value)| *value = from[row]);
            }
            let mut of_node = z.subrows_mut(start, block.ncols());
            matmul(of_node.as_mut(), Accum::Add, rest.transpose(), below.as_ref(), -1.0, Par::Seq);
            solve_unit_upper_triangular_in_place(top.transpose(), of_node, Par::Seq);
        }
    }
}

/// The order of elimination: nested dissection of all rows except `last`, followed by `last`.
fn ordered(mass: &SparseMatrix, stiffness: &SparseMatrix, last: &[usize]) -> Result<Perm<usize>, String> {
    let n = mass.nrows();
    let mut place = vec![0; n];
    last.iter().for_each(|&row| place[row] = usize::MAX);
    let others: Vec<usize> = (0..n).filter(|&row| place[row] != usize::MAX).collect();
    others.iter().enumerate().for_each(|(position, &row)| place[row] = position);
    let mut forward: Vec<usize> = if others.is_empty() {
        vec![]
    } else {
        let order = nested_dissection(others.len(), &|position, out: &mut Vec<usize>| {
            out.clear();
            merge(mass, stiffness, others[position], |other, _, _| out.extend(Some(place[other])));
            out.retain(|&other| other != usize::MAX);
        })?;
        order.arrays().0.iter().map(|&position| others[position]).collect()
    };
    forward.extend_from_slice(last);
    let mut inverse = vec![0; n];
    forward.iter().enumerate().for_each(|(position, &row)| inverse[row] = position);
    Ok(Perm::new_checked(forward.into(), inverse.into(), n))
}

/// The row eliminated at each position of the elimination order.
fn forward(symbolic: &SymbolicCholesky<usize>) -> &[usize] {
    symbolic.perm().expect("a permutation was given").arrays().0
}

fn supernodal(symbolic: &SymbolicCholesky<usize>) -> &SymbolicSupernodalCholesky<usize> {
    match symbolic.raw() {
        SymbolicCholeskyRaw::Supernodal(symbolic) => symbolic,
        SymbolicCholeskyRaw::Simplicial(_) => unreachable!("supernodes were requested"),
    }
}

fn check(field: &str, what: &str, matrix: &SparseMatrix, n: usize) -> Result<(), ReductionError> {
    let what = format!("{what}.{field}");
    let (rows, columns) = matrix.shape();
    if rows != n || columns != n || n == 0 {
        return Err(ReductionError::Shape { what, rows, columns, expected: n.max(1) });
    }
    if let Some((row, column, value)) = entries(matrix).find(|(_, _, value)| !value.is_finite()) {
        return Err(ReductionError::NotFinite { what, row, column, value });
    }
    match worst_asymmetry(matrix, 1.0) {
        None => Ok(()),
        Some((row, column, value, mirrored, limit)) => {
            Err(ReductionError::Unsymmetric { what, row, column, value, mirrored, limit })
        }
    }
}

/// Calls `each(row, entry of a, entry of b)` for every row of a column in which either matrix has an entry, in
/// ascending order.
fn merge(
    a: &SparseColMat<usize, f64>,
    b: &SparseColMat<usize, f64>,
    column: usize,
    mut each: impl FnMut(usize, f64, f64),
) {
    let (a, b) = (a.as_ref(), b.as_ref());
    let mut left = a.row_idx_of_col(column).zip(a.val_of_col(column)).peekable();
    let mut right = b.row_idx_of_col(column).zip(b.val_of_col(column)).peekable();
    loop {
        match (left.peek().copied(), right.peek().copied()) {
            (Some((i, x)), Some((j, y))) if i == j => {
                each(i, *x, *y);
                left.next();
                right.next();
            }
            (Some((i, x)), other) if other.is_none_or(|(j, _)| i < j) => {
                each(i, *x, 0.0);
                left.next();
            }
            (_, Some((j, y))) => {
                each(j, 0.0, *y);
                right.next();
            }
            (_, None) => return,
        }
    }
}

/// Lower estimate of the smallest eigenvalue of `D^-1/2 A D^-1/2`, where `D` is the diagonal of `A`: the smallest Ritz
/// value minus its residual. `None` if the smallest Ritz value is not positive.
fn smallest_scaled(matrix: &SparseMatrix, diagonal: &[f64]) -> Option<f64> {
    let n = diagonal.len();
    let scale: Vec<f64> = diagonal.iter().map(|value| value.sqrt().recip()).collect();
    let mut vector = random_block(n, 1, 1);
    let norm = vector.norm_l2();
    vector *= faer::Scale(1.0 / norm);
    let (mut previous, mut beta) = (Mat::<f64>::zeros(n, 1), 0.0);
    let mut tridiagonal = Mat::<f64>::zeros(0, 0);
    for step in 0..MASS_STEPS.min(n) {
        let mut next = symmetric_times(matrix, Mat::from_fn(n, 1, |i, _| scale[i] * vector[(i, 0)]).as_ref());
        for i in 0..n {
            next[(i, 0)] = scale[i] * next[(i, 0)] - beta * previous[(i, 0)];
        }
        let alpha = (vector.transpose() * &next)[(0, 0)];
        next -= faer::Scale(alpha) * &vector;
        tridiagonal.resize_with(step + 1, step + 1, |_, _| 0.0);
        tridiagonal[(step, step)] = alpha;
        if step > 0 {
            tridiagonal[(step, step - 1)] = beta;
            tridiagonal[(step - 1, step)] = beta;
        }
        beta = next.norm_l2();
        if beta < 1e-12 {
            beta = 0.0;
            break;
        }
        previous = std::mem::replace(&mut vector, faer::Scale(1.0 / beta) * next);
    }
    let (values, vectors) = super::dense::symmetric_eigen("mass", tridiagonal.as_ref()).ok()?;
    let last = tridiagonal.nrows() - 1;
    (values[0] > 0.0).then(|| values[0] - beta * vectors[(last, 0)].abs())
}
