//! The pencil `K - σ M` of a sparse symmetric system: analysed once, factorised at many shifts.

use std::sync::Arc;

use faer::perm::Perm;
use faer::sparse::SymbolicSparseColMat;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::{Mat, MatMut, Side};

use super::elimination_tree::Tree;
use super::fronts::Fronts;
use super::krylov::random_block;
use super::ordering::nested_dissection;
use super::precision::Precision;
use super::sparse::{Asymmetry, entries, first_asymmetry, symmetric_times};
use super::triangle::Triangle;
use super::{ReductionError, SEMIDEFINITE_TOLERANCE, SparseMatrix};

/// Upper limit of the shifts to try, relative to `tr K / tr M`.
const LARGEST_SHIFT: f64 = 1e5;
/// Number of Lanczos steps to estimate the smallest eigenvalue of a scaled mass matrix.
const MASS_STEPS: usize = 40;
/// Estimated smallest eigenvalue of a scaled mass matrix above which it counts as positive definite without a
/// factorisation.
const CLEARLY_DEFINITE: f64 = 1e-3;

/// A symmetric pencil `K - σ M`, ordered and symbolically analysed.
pub struct Pencil<'a> {
    /// Names the system in errors.
    pub what: &'a str,
    /// `M`, kg, both triangles.
    pub mass: &'a SparseMatrix,
    /// `K`, N/m, both triangles.
    pub stiffness: &'a SparseMatrix,
    pub(super) symbolic: Arc<SymbolicCholesky<usize>>,
    pub(super) tree: Arc<Tree>,
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
        for column in 0..n {
            merge(mass, stiffness, column, |row| rows.extend((row >= column).then_some(row)));
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
        let supernodes = supernodal(&symbolic);
        let tree = Arc::new(Tree::new(supernodes, supernodes.n_supernodes()));
        let pencil = Self { what, mass, stiffness, symbolic: Arc::new(symbolic), tree };
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

    /// Bytes held after the analysis in addition to the two given matrices: the symbolic factor.
    pub(super) fn held_bytes(&self) -> usize {
        // Row indices of the supernodes, by columns and by rows; the permutation and its inverse; offsets of columns
        // and supernodes.
        size_of::<usize>() * (2 * supernodal(&self.symbolic).row_idx().len() + 6 * self.dimension())
    }

    /// Bytes of one factor in double precision.
    pub(super) fn factor_bytes(&self) -> usize {
        Precision::Double.bytes() * self.factor_entries()
    }

    /// Additional bytes needed while a factor is computed: the fronts.
    pub(super) fn factoring_bytes(&self) -> usize {
        Fronts::bytes(&self.tree)
    }

    /// The structure of a factor.
    pub(super) fn supernodes(&self) -> &SymbolicSupernodalCholesky<usize> {
        supernodal(&self.symbolic)
    }

    /// The row eliminated at each position, and the position of each row.
    pub(super) fn order(&self) -> (&[usize], &[usize]) {
        self.symbolic.perm().expect("a permutation was given").arrays()
    }

    /// `K + s M`, to be eliminated front by front.
    pub(super) fn fronts(&self, shift: f64) -> Fronts<'_> {
        self.fronts_of(self.stiffness, shift)
    }

    fn fronts_of<'f>(&'f self, matrix: &'f SparseMatrix, shift: f64) -> Fronts<'f> {
        let (supernodes, order) = (self.supernodes(), self.order());
        Fronts { matrix, mass: self.mass, shift, supernodes, tree: &self.tree, order }
    }

    /// Number of `ω²` below `square`, rad²/s²: the number of negative pivots of `K - σ M = L D Lᵀ` (Sylvester's law of
    /// inertia).
    pub(super) fn count_below(&self, square: f64) -> Result<usize, ReductionError> {
        self.fronts(-square).count_negative().map_err(|_| self.broken())
    }

    pub(super) fn broken(&self) -> ReductionError {
        self.failed("a pivot is 0 or not finite".to_owned())
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
        let mut raised = self.mass.clone();
        for (row, value) in diagonal.iter().enumerate() {
            if let Some(entry) = raised.get_mut(row, row) {
                *entry += SEMIDEFINITE_TOLERANCE * value;
            }
        }
        let pivots = self.factored(&self.fronts_of(&raised, 0.0), Precision::Double)?.pivots();
        match forward(&self.symbolic).iter().zip(pivots).find(|(_, value)| value.is_nan() || *value <= 0.0) {
            Some((&row, value)) => Err(ReductionError::Indefinite { what, row, value, limit: 0.0 }),
            None => Ok(()),
        }
    }

    /// The error where memory for a factor is insufficient.
    pub(super) fn no_memory(&self) -> ReductionError {
        self.failed(format!("no memory for a factor of {} numbers", self.factor_entries()))
    }

    pub(super) fn failed(&self, reason: String) -> ReductionError {
        ReductionError::Factorisation { what: self.what.to_owned(), reason }
    }
}

/// Cholesky factor `P (K + s M) Pᵀ = L Lᵀ`.
pub(super) struct Llt<'a> {
    pencil: &'a Pencil<'a>,
    values: Vec<f64>,
}

impl<'a> Llt<'a> {
    pub(super) fn new(pencil: &'a Pencil<'a>, values: Vec<f64>) -> Self {
        Self { pencil, values }
    }

    pub(super) fn pencil(&self) -> &Pencil<'_> {
        self.pencil
    }

    /// `L`, to solve with.
    pub(super) fn triangle(&self) -> Triangle<'_> {
        let Pencil { symbolic, tree, .. } = self.pencil;
        Triangle { supernodes: supernodal(symbolic), tree, values: &self.values, unit: false }
    }

    /// `A⁻¹ B` in place.
    pub(super) fn solve(&self, mut rhs: MatMut<'_, f64>) {
        let x = self.unwhiten(self.whiten(&rhs.to_owned()));
        rhs.copy_from(x);
    }

    /// `L⁻¹ P X`.
    pub(super) fn whiten(&self, x: &Mat<f64>) -> Mat<f64> {
        let forward = forward(&self.pencil.symbolic);
        let mut y = Mat::from_fn(x.nrows(), x.ncols(), |i, j| x[(forward[i], j)]);
        self.triangle().forward(y.as_mut());
        y
    }

    /// `Pᵀ L⁻ᵀ Y`.
    pub(super) fn unwhiten(&self, mut y: Mat<f64>) -> Mat<f64> {
        self.triangle().backward(y.as_mut());
        let mut x = Mat::zeros(y.nrows(), y.ncols());
        for (position, &row) in forward(&self.pencil.symbolic).iter().enumerate() {
            for column in 0..y.ncols() {
                x[(row, column)] = y[(position, column)];
            }
        }
        x
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
            merge(mass, stiffness, others[position], |other| out.push(place[other]));
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
pub(super) fn forward(symbolic: &SymbolicCholesky<usize>) -> &[usize] {
    symbolic.perm().expect("a permutation was given").arrays().0
}

pub(super) fn supernodal(symbolic: &SymbolicCholesky<usize>) -> &SymbolicSupernodalCholesky<usize> {
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
    match first_asymmetry(matrix, 1.0) {
        None => Ok(()),
        Some(Asymmetry { row, column, value, mirrored, limit }) => {
            Err(ReductionError::Unsymmetric { what, row, column, value, mirrored, limit })
        }
    }
}

/// Calls `each(row)` for every row of a column in which either matrix has an entry, in ascending order.
fn merge(a: &SparseMatrix, b: &SparseMatrix, column: usize, mut each: impl FnMut(usize)) {
    let mut left = a.as_ref().row_idx_of_col(column).peekable();
    let mut right = b.as_ref().row_idx_of_col(column).peekable();
    while let Some(row) = left.peek().into_iter().chain(right.peek()).min().copied() {
        each(row);
        left.next_if_eq(&row);
        right.next_if_eq(&row);
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
