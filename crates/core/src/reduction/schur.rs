//! Complex Schur form of a small matrix, with eigenvalues in any order.
//!
//! ```text
//! A = U T Uᴴ,   Uᴴ U = I,   T upper triangular
//! ```
//!
//! The matrix is reduced to Hessenberg form by Householder reflections, then to triangular form by QR iterations with
//! Wilkinson's shift. A rotation exchanges neighbouring eigenvalues. All steps are backward stable, even for nearly
//! parallel eigenvectors.
//!
//! Source: Golub, Van Loan, "Matrix computations" (2013), sections 7.4 to 7.6.

use faer::{Mat, MatRef, c64};

/// Largest number of QR iterations per eigenvalue.
const MOST_ITERATIONS: usize = 60;

/// `A = U T Uᴴ`.
pub(super) struct Schur {
    pub t: Mat<c64>,
    pub u: Mat<c64>,
}

const ZERO: c64 = c64::new(0.0, 0.0);
const ONE: c64 = c64::new(1.0, 0.0);

impl Schur {
    /// Schur form of `matrix`, `m×m`; `None` if an eigenvalue does not converge.
    pub(super) fn new(matrix: MatRef<'_, c64>) -> Option<Self> {
        let m = matrix.nrows();
        let mut schur = Self { t: matrix.to_owned(), u: Mat::identity(m, m) };
        let converged = pulp::Arch::new().dispatch(
            #[inline(always)]
            || {
                schur.hessenberg();
                schur.iterate()
            },
        );
        converged.then_some(schur)
    }

    /// Reduces `T` to Hessenberg form: zero below the first subdiagonal. All loops run along columns, which are
    /// contiguous.
    #[inline(always)]
    fn hessenberg(&mut self) {
        let m = self.t.nrows();
        let mut along = vec![ZERO; m];
        for k in 0..m.saturating_sub(2) {
            let mut v = self.t.col_as_slice(k)[k + 1..].to_vec();
            let norm = v.iter().map(|x| x.norm_sqr()).sum::<f64>().sqrt();
            if norm == 0.0 {
                continue;
            }
            let phase = if v[0] == ZERO { ONE } else { v[0] / v[0].norm() };
            v[0] += phase * norm;
            let scale = 2.0 / v.iter().map(|x| x.norm_sqr()).sum::<f64>();
            for j in k..m {
                let column = &mut self.t.col_as_slice_mut(j)[k + 1..];
                let factor = dot(&v, column) * scale;
                column.iter_mut().zip(&v).for_each(|(t, x)| *t -= factor * x);
            }
            for matrix in [&mut self.t, &mut self.u] {
                along.fill(ZERO);
                for (j, x) in v.iter().enumerate() {
                    along.iter_mut().zip(matrix.col_as_slice(k + 1 + j)).for_each(|(sum, t)| *sum += t * x);
                }
                for (j, x) in v.iter().enumerate() {
                    let factor = x.conj() * scale;
                    let column = matrix.col_as_slice_mut(k + 1 + j);
                    column.iter_mut().zip(&along).for_each(|(t, sum)| *t -= sum * factor);
                }
            }
            self.t.col_as_slice_mut(k)[k + 2..].fill(ZERO);
        }
    }

    /// QR iterations until `T` is triangular; `false` if an eigenvalue does not converge.
    #[inline(always)]
    fn iterate(&mut self) -> bool {
        let m = self.t.nrows();
        let size = self.t.norm_max().max(f64::MIN_POSITIVE);
        let (mut end, mut iterations) = (m, 0);
        while end > 1 {
            let small = |l: usize| {
                let near = self.t[(l, l)].norm() + self.t[(l - 1, l - 1)].norm();
                self.t[(l, l - 1)].norm() <= f64::EPSILON * if near > 0.0 { near } else { size }
            };
            let start = (1..end).rev().find(|&l| small(l)).unwrap_or(0);
            if start > 0 {
                self.t[(start, start - 1)] = ZERO;
            }
            if start == end - 1 {
                end -= 1;
                iterations = 0;
                continue;
            }
            iterations += 1;
            if iterations > MOST_ITERATIONS {
                return false;
            }
            self.sweep(start, end, self.shift(end, iterations));
        }
        true
    }

    /// Wilkinson's shift: the eigenvalue of the trailing 2x2 block nearer to its last entry. Every tenth iteration uses
    /// an exceptional shift instead.
    fn shift(&self, end: usize, iterations: usize) -> c64 {
        let (i, j) = (end - 2, end - 1);
        let (a, b, c, d) = (self.t[(i, i)], self.t[(i, j)], self.t[(j, i)], self.t[(j, j)]);
        if iterations.is_multiple_of(10) {
            return d + c.norm();
        }
        let half = (a - d) * 0.5;
        let root = (half * half + b * c).sqrt();
        let (plus, minus) = (half + root, half - root);
        d + if plus.norm() < minus.norm() { plus } else { minus }
    }

    /// One QR step on the active block, rows `start` to `end` (exclusive).
    #[inline(always)]
    fn sweep(&mut self, start: usize, end: usize, shift: c64) {
        let (mut x, mut y) = (self.t[(start, start)] - shift, self.t[(start + 1, start)]);
        for k in start..end - 1 {
            let norm = (x.norm_sqr() + y.norm_sqr()).sqrt();
            if norm > 0.0 {
                let (c, s) = (x / norm, y / norm);
                self.mix_rows(k, [c, s], k.saturating_sub(1).max(start));
                self.mix_columns(k, [c, s], (k + 3).min(end));
            }
            if k + 2 < end {
                (x, y) = (self.t[(k + 1, k)], self.t[(k + 2, k)]);
            }
        }
    }

    /// Multiplies rows `k` and `k + 1` of `T`, from column `first` on, by `[[c̄, s̄], [-s, c]]`.
    #[inline(always)]
    fn mix_rows(&mut self, k: usize, [c, s]: [c64; 2], first: usize) {
        for j in first..self.t.ncols() {
            let [p, q] = &mut self.t.col_as_slice_mut(j)[k..k + 2] else { unreachable!("two rows") };
            (*p, *q) = (c.conj() * *p + s.conj() * *q, c * *q - s * *p);
        }
    }

    /// Multiplies columns `k` and `k + 1` of `T`, down to row `rows`, and of `U` by `[[c, -s̄], [s, c̄]]`.
    #[inline(always)]
    fn mix_columns(&mut self, k: usize, [c, s]: [c64; 2], rows: usize) {
        let m = self.u.nrows();
        for (matrix, rows) in [(&mut self.t, rows), (&mut self.u, m)] {
            let (left, right) = matrix.as_mut().split_at_col_mut(k + 1);
            let [left, right] = [left.col_mut(k), right.col_mut(0)].map(|column| {
                let Some(column) = column.try_as_col_major_mut() else { unreachable!("columns are contiguous") };
                &mut column.as_slice_mut()[..rows]
            });
            for (p, q) in left.iter_mut().zip(right) {
                (*p, *q) = (*p * c + *q * s, *q * c.conj() - *p * s.conj());
            }
        }
    }

    /// Exchanges the eigenvalues at `k` and `k + 1`.
    fn swap(&mut self, k: usize) {
        let (first, second, above) = (self.t[(k, k)], self.t[(k + 1, k + 1)], self.t[(k, k + 1)]);
        let (x, y) = (above, second - first);
        let norm = (x.norm_sqr() + y.norm_sqr()).sqrt();
        if norm == 0.0 {
            return;
        }
        let (c, s) = (x / norm, y / norm);
        self.mix_rows(k, [c, s], k);
        self.mix_columns(k, [c, s], k + 2);
        self.t[(k + 1, k)] = ZERO;
        self.t[(k, k)] = second;
        self.t[(k + 1, k + 1)] = first;
    }

    /// Orders the eigenvalues by magnitude, largest first.
    pub(super) fn sort(&mut self) {
        let m = self.t.nrows();
        for place in 0..m {
            let size = |k: usize| self.t[(k, k)].norm_sqr();
            let largest = (place..m).max_by(|&a, &b| size(a).total_cmp(&size(b)).then(b.cmp(&a))).unwrap_or(place);
            (place..largest).rev().for_each(|k| self.swap(k));
        }
    }

    /// The eigenvalue at position `k`.
    pub(super) fn value(&self, k: usize) -> c64 {
        self.t[(k, k)]
    }

    /// Eigenvector of the original matrix for the eigenvalue at position `k`, 2-norm 1.
    pub(super) fn vector(&self, k: usize) -> Mat<c64> {
        self.last_rows_of_vector(k, self.u.nrows())
    }

    /// The last `rows` rows of [`Self::vector`].
    pub(super) fn last_rows_of_vector(&self, k: usize, rows: usize) -> Mat<c64> {
        let tiny = f64::EPSILON * self.t.norm_max();
        // Back substitution column by column: `y` holds the right-hand side above the row reached.
        let mut y: Vec<c64> = self.t.col_as_slice(k)[..k].iter().map(|t| -t).collect();
        y.push(ONE);
        for i in (0..k).rev() {
            let gap = self.t[(i, i)] - self.t[(k, k)];
            y[i] /= if gap.norm() > tiny { gap } else { c64::new(tiny, 0.0) };
            let (above, solved) = y.split_at_mut(i);
            above.iter_mut().zip(self.t.col_as_slice(i)).for_each(|(sum, t)| *sum -= t * solved[0]);
        }
        let norm = y.iter().map(|x| x.norm_sqr()).sum::<f64>().sqrt();
        let y = Mat::from_fn(k + 1, 1, |i, _| y[i] / norm);
        self.u.submatrix(self.u.nrows() - rows, 0, rows, k + 1) * y
    }
}

/// `aᴴ b`, in four independent partial sums.
#[inline(always)]
fn dot(a: &[c64], b: &[c64]) -> c64 {
    let mut sums = [ZERO; 4];
    let (mut a, mut b) = (a.chunks_exact(4), b.chunks_exact(4));
    for (a, b) in (&mut a).zip(&mut b) {
        sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a.conj() * b);
    }
    sums.iter().sum::<c64>() + a.remainder().iter().zip(b.remainder()).map(|(a, b)| a.conj() * b).sum::<c64>()
}

#[cfg(test)]
mod tests {
    use super::super::krylov::random_block;
    use super::*;

    /// Backward stability: `|U T Uᴴ - A|`, `|Uᴴ U - I|` and `|A x - θ x|` are a modest multiple of `ε √m` (of 60).
    #[test]
    fn it_gives_the_matrix_back_in_any_order() {
        let m = 60;
        let (re, im) = (random_block(m, m, 3), random_block(m, m, 4));
        let mut matrix = Mat::from_fn(m, m, |i, j| c64::new(re[(i, j)], im[(i, j)]));
        // Add a defective pair and a multiple eigenvalue.
        for j in 0..m {
            for i in [10, 11, 12] {
                matrix[(i, j)] = ZERO;
            }
        }
        matrix[(10, 10)] = ONE;
        matrix[(11, 11)] = ONE;
        matrix[(12, 12)] = ONE;
        matrix[(10, 11)] = ONE;
        let mut schur = Schur::new(matrix.as_ref()).unwrap();
        schur.sort();
        let limit = 100.0 * f64::EPSILON * (m as f64).sqrt() * matrix.norm_l2();
        let back = &schur.u * &schur.t * schur.u.adjoint();
        assert!((back - &matrix).norm_l2() < limit);
        assert!((schur.u.adjoint() * &schur.u - Mat::<c64>::identity(m, m)).norm_l2() < limit);
        for k in 0..m {
            assert!(k == 0 || schur.value(k).norm() <= schur.value(k - 1).norm() * (1.0 + 1e-12));
            assert!((k + 1..m).all(|i| schur.t[(i, k)].norm() < limit));
            let x = schur.vector(k);
            assert!((&matrix * &x - &x * faer::Scale(schur.value(k))).norm_l2() < limit, "{k}");
        }
    }
}
