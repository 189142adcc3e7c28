//! Linear solves with a full model whose parts are joined by contact only: symmetric factors of the parts, and a
//! low-rank correction for the contact.
//!
//! ```text
//! Q(s) = A + Lᵀ W R,   A = diag(K + s² M) of the parts,   W = k + s c,   R and L rows of contact pairs
//! Q⁻¹ b = A⁻¹ (b - Lᵀ y),   y = (I + W G)⁻¹ W R A⁻¹ b,   G = R A⁻¹ Lᵀ
//! ```
//!
//! This is the Woodbury formula. At `s = iω`, `A` is real and `A = P L D Lᵀ Pᵀ`. The contact rows are eliminated last,
//! so that `G` only needs the trailing block of the factor. A solve is then one forward pass, a dense solve for the
//! contact, and one backward pass. With factors in single precision it is refined by products with `Q`.
//!
//! Source: Hager, "Updating the inverse of a matrix", SIAM Review 31 (1989) 221-239.

use faer::linalg::solvers::{PartialPivLu, Solve};
use faer::linalg::triangular_solve::{solve_unit_lower_triangular_in_place, solve_unit_upper_triangular_in_place};
use faer::{Mat, MatRef, Par, c64};

use super::ReductionError;
use super::full_model::{FullModel, LowRank, SparseRow};
use super::krylov::Number;
use super::ldlt::Ldlt;
use super::pencil::Pencil;
use super::precision::Precision;
use super::refinement::{Stalled, refined};

/// The parts of a full model, ordered and symbolically analysed.
pub(super) struct Parts<'a> {
    pencils: Vec<Pencil<'a>>,
    /// First row of every part in the full model.
    offsets: Vec<usize>,
    /// Rows of every part that belong to contact pairs.
    touched: Vec<Vec<usize>>,
}

impl<'a> Parts<'a> {
    /// Checks, orders and analyses every part, with its contact rows eliminated last.
    pub(super) fn new(model: &'a FullModel) -> Result<Self, ReductionError> {
        let (rows, offsets) = (model.contact_rows(), model.offsets());
        let (mut pencils, mut touched) = (vec![], vec![]);
        for (part, &offset) in model.parts.iter().zip(&offsets) {
            let range = offset..offset + part.mass.nrows();
            let of_part: Vec<usize> = rows.iter().filter(|row| range.contains(row)).map(|row| row - offset).collect();
            pencils.push(Pencil::with_last(&part.name, &part.mass, &part.stiffness, &of_part)?);
            touched.push(of_part);
        }
        Ok(Self { pencils, offsets, touched })
    }

    /// Estimated memory.
    pub(super) fn bytes(&self, precision: Precision) -> PartBytes {
        let float = size_of::<f64>();
        let dense = |rows: &Vec<usize>| float * rows.len() * rows.len();
        let pencils = self.pencils.iter();
        // In addition to a factor: its pivots, and `L` and `A⁻¹` of the contact rows, with temporaries of the same
        // size.
        let (factors, pivots) = pencils.clone().fold((0, 0), |(bytes, pivots), pencil| {
            (bytes + precision.bytes() * pencil.factor_entries(), pivots + float * pencil.dimension())
        });
        PartBytes {
            held: pencils.clone().map(Pencil::held_bytes).sum(),
            factors: factors + pivots + 2 * self.touched.iter().map(dense).sum::<usize>(),
            factoring: pencils
                .map(Pencil::factoring_bytes)
                .chain(self.touched.iter().map(|rows| 3 * dense(rows)))
                .max()
                .unwrap_or(0),
        }
    }

    /// Number of `ω²` of the separate parts below `square`, rad²/s².
    pub(super) fn count_below(&self, square: f64) -> Result<usize, ReductionError> {
        self.pencils.iter().map(|pencil| pencil.count_below(square)).sum()
    }

    /// Factorises `K - ω² M` of every part, where `square` is `ω²`, rad²/s².
    pub(super) fn at(&self, square: f64, precision: Precision) -> Result<Shifted, ReductionError> {
        let mut parts = vec![];
        for (index, pencil) in self.pencils.iter().enumerate() {
            let ldlt = pencil.ldlt(-square, precision)?;
            parts.push(PartFactor::new(ldlt, self.offsets[index], self.touched[index].len()));
        }
        Ok(Shifted { square, precision, parts })
    }
}

/// Memory of the parts, bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct PartBytes {
    /// Held after the symbolic analysis.
    pub held: usize,
    /// Factors at one shift.
    pub factors: usize,
    /// Additional memory while a factor is computed.
    pub factoring: usize,
}

/// Factor of one part.
struct PartFactor {
    ldlt: Ldlt,
    offset: usize,
    pivots: Vec<f64>,
    /// Trailing block of `L`, for the contact rows.
    last: Mat<f64>,
    /// Block of `A⁻¹` for the contact rows.
    flexibility: Mat<f64>,
}

impl PartFactor {
    fn new(ldlt: Ldlt, offset: usize, touched: usize) -> Self {
        let (pivots, last) = (ldlt.pivots(), ldlt.trailing(touched));
        let first = pivots.len() - touched;
        let mut inverse = Mat::<f64>::identity(touched, touched);
        solve_unit_lower_triangular_in_place(last.as_ref(), inverse.as_mut(), Par::Seq);
        let scaled = Mat::from_fn(touched, touched, |i, j| inverse[(i, j)] / pivots[first + i]);
        let flexibility = inverse.transpose() * scaled;
        Self { ldlt, offset, pivots, last, flexibility }
    }

    /// Position of the first contact row in the order of elimination.
    fn first(&self) -> usize {
        self.pivots.len() - self.last.nrows()
    }

    /// The contact rows in the order of elimination.
    fn contact_rows(&self) -> &[usize] {
        &self.ldlt.order()[self.first()..]
    }
}

/// Factors of `K - ω² M` of every part at one shift.
pub(super) struct Shifted {
    /// `ω²`, rad²/s².
    pub square: f64,
    precision: Precision,
    parts: Vec<PartFactor>,
}

/// Rows of the contact pairs, for each part, indexed by position among its contact rows.
type Placed = Vec<Vec<SparseRow>>;

/// Solver with `Q(s)`, or its transpose, at one shift and operating point.
pub(super) struct Coupled<'a, T: Number> {
    shifted: &'a Shifted,
    left: Placed,
    right: Placed,
    weights: Vec<T>,
    /// LU factors of `I + W G`.
    factor: PartialPivLu<T>,
}

impl Shifted {
    /// Whether `K - ω² M` of every part is positive definite.
    pub(super) fn is_definite(&self) -> bool {
        self.parts.iter().flat_map(|part| &part.pivots).all(|pivot| *pivot > 0.0)
    }

    /// Couples the parts by the pairs of `low_rank`; `weights` are `k + s c`. With `transposed` the result solves with
    /// `Q(s)ᵀ`.
    pub(super) fn couple<T: Number>(&self, low_rank: &LowRank, weights: Vec<T>, transposed: bool) -> Coupled<'_, T>
    where
        PartialPivLu<T>: Solver<T>,
    {
        let (mut left, mut right) = (self.placed(&low_rank.left), self.placed(&low_rank.right));
        if transposed {
            std::mem::swap(&mut left, &mut right);
        }
        let rank = weights.len();
        let mut g = Mat::<f64>::zeros(rank, rank);
        for (part, (left, right)) in self.parts.iter().zip(left.iter().zip(&right)) {
            let touched = part.last.nrows();
            for (a, row) in right.iter().enumerate() {
                let mut response = vec![0.0; touched];
                for &(i, weight) in row {
                    let column = part.flexibility.col_as_slice(i);
                    response.iter_mut().zip(column).for_each(|(sum, value)| *sum += weight * value);
                }
                for (b, row) in left.iter().enumerate() {
                    g[(a, b)] += row.iter().map(|&(j, weight)| weight * response[j]).sum::<f64>();
                }
            }
        }
        let real = |value: f64| T::from_complex(c64::new(value, 0.0));
        let matrix = Mat::from_fn(rank, rank, |i, j| {
            let coupled = weights[i] * real(g[(i, j)]);
            if i == j { T::from_complex(coupled.complex() + 1.0) } else { coupled }
        });
        Coupled { shifted: self, left, right, weights, factor: <PartialPivLu<T> as Solver<T>>::of(matrix.as_ref()) }
    }

    /// Converts rows over all degrees of freedom to rows over the contact rows of each part.
    fn placed(&self, rows: &[SparseRow]) -> Placed {
        let of_part = |part: &PartFactor| {
            let order = part.contact_rows();
            let place: std::collections::HashMap<usize, usize> =
                order.iter().enumerate().map(|(place, row)| (part.offset + row, place)).collect();
            rows.iter()
                .map(|row| row.iter().filter_map(|(index, weight)| Some((*place.get(index)?, *weight))).collect())
                .collect()
        };
        self.parts.iter().map(of_part).collect()
    }
}

/// Dense LU factors of a real or complex matrix.
pub(super) trait Solver<T: Number> {
    fn of(matrix: MatRef<'_, T>) -> Self;
    fn solved(&self, rhs: Mat<T>) -> Mat<T>;
}

impl Solver<f64> for PartialPivLu<f64> {
    fn of(matrix: MatRef<'_, f64>) -> Self {
        matrix.partial_piv_lu()
    }
    fn solved(&self, mut rhs: Mat<f64>) -> Mat<f64> {
        self.solve_in_place(rhs.as_mut());
        rhs
    }
}

impl Solver<c64> for PartialPivLu<c64> {
    fn of(matrix: MatRef<'_, c64>) -> Self {
        matrix.partial_piv_lu()
    }
    fn solved(&self, mut rhs: Mat<c64>) -> Mat<c64> {
        self.solve_in_place(rhs.as_mut());
        rhs
    }
}

impl<T: Number> Coupled<'_, T>
where
    PartialPivLu<T>: Solver<T>,
{
    /// Whether the factors are kept in single precision.
    pub(super) fn is_single(&self) -> bool {
        self.shifted.precision == Precision::Single
    }

    /// `Q⁻¹ B`. `times` returns `Q X`, with which solves in single precision are refined.
    ///
    /// # Errors
    /// [`Stalled`] if factors in single precision are too inaccurate.
    pub(super) fn solve(&self, b: MatRef<'_, T>, times: impl Fn(MatRef<'_, T>) -> Mat<T>) -> Result<Mat<T>, Stalled> {
        match self.shifted.precision {
            Precision::Double => Ok(self.solve_unrefined(b)),
            Precision::Single => refined(b, times, |r| self.solve_unrefined(r)),
        }
    }

    /// `Q⁻¹ B` as exactly as the factors are kept: in single precision to a few digits.
    pub(super) fn solve_unrefined(&self, b: MatRef<'_, T>) -> Mat<T> {
        let (columns, real) = (b.ncols(), real_columns::<T>(b.ncols()));
        let mut u = Mat::<f64>::zeros(self.weights.len(), real);
        let mut reduced = vec![];
        for (part, right) in self.shifted.parts.iter().zip(&self.right) {
            let (order, n) = (part.ldlt.order(), part.pivots.len());
            let mut z = Mat::from_fn(n, real, |i, j| component(b[(part.offset + order[i], j % columns)], j < columns));
            part.ldlt.forward(z.as_mut());
            let touched = part.last.nrows();
            let mut x = Mat::from_fn(touched, real, |i, j| z[(part.first() + i, j)] / part.pivots[part.first() + i]);
            solve_unit_upper_triangular_in_place(part.last.transpose(), x.as_mut(), Par::Seq);
            for (pair, row) in right.iter().enumerate() {
                for &(place, weight) in row {
                    (0..real).for_each(|j| u[(pair, j)] += weight * x[(place, j)]);
                }
            }
            reduced.push(z);
        }
        let loads = Mat::from_fn(u.nrows(), columns, |pair, j| self.weights[pair] * joined::<T>(&u, pair, j, columns));
        let y = self.factor.solved(loads);
        let mut x = Mat::<T>::zeros(b.nrows(), columns);
        for ((part, left), mut z) in self.shifted.parts.iter().zip(&self.left).zip(reduced) {
            let (order, n, first) = (part.ldlt.order(), part.pivots.len(), part.first());
            let mut pushed = Mat::<f64>::zeros(n - first, real);
            for (pair, row) in left.iter().enumerate() {
                for &(place, weight) in row {
                    (0..real)
                        .for_each(|j| pushed[(place, j)] += weight * component(y[(pair, j % columns)], j < columns));
                }
            }
            solve_unit_lower_triangular_in_place(part.last.as_ref(), pushed.as_mut(), Par::Seq);
            let mut of_touched = z.subrows_mut(first, n - first);
            of_touched -= pushed;
            for j in 0..real {
                z.col_as_slice_mut(j).iter_mut().zip(&part.pivots).for_each(|(value, pivot)| *value /= pivot);
            }
            part.ldlt.backward(z.as_mut());
            for j in 0..columns {
                for (i, &row) in order.iter().enumerate() {
                    x[(part.offset + row, j)] = joined(&z, i, j, columns);
                }
            }
        }
        x
    }
}

/// Number of real columns for a block of `columns`. One of complex numbers is solved as all real parts, then all imaginary
/// parts.
fn real_columns<T: Number>(columns: usize) -> usize {
    if T::REAL { columns } else { 2 * columns }
}

/// The real component of a number, or the imaginary one.
fn component<T: Number>(value: T, real: bool) -> f64 {
    let value = value.complex();
    if real { value.re } else { value.im }
}

/// The number at `(i, j)` of a block of `columns`, from its components.
fn joined<T: Number>(components: &Mat<f64>, i: usize, j: usize, columns: usize) -> T {
    T::from_complex(c64::new(components[(i, j)], if T::REAL { 0.0 } else { components[(i, columns + j)] }))
}
