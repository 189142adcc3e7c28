//! LU factors of a matrix, in arrays that serve one matrix after the other.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::lu::partial_pivoting::{factor, solve};
use faer::perm::PermRef;
use faer::{Mat, MatMut, MatRef, Par};

/// Factors of the last matrix; none at first.
#[derive(Clone, Debug)]
pub(super) struct Factors {
    /// Both factors, in its first `size` rows and columns.
    lu: Mat<f64>,
    size: usize,
    /// The permutation of rows, and its inverse.
    rows: [Vec<usize>; 2],
}

impl Default for Factors {
    fn default() -> Self {
        Self { lu: Mat::new(), size: 0, rows: [vec![], vec![]] }
    }
}

impl Factors {
    /// Factorises the matrix of `size` rows that `fill` writes.
    pub fn factorise(&mut self, size: usize, fill: impl FnOnce(MatMut<'_, f64>)) {
        if self.lu.nrows() < size {
            self.lu = Mat::zeros(size, size);
        }
        self.size = size;
        fill(self.lu.get_mut(..size, ..size));
        let [forward, inverse] = &mut self.rows;
        forward.resize(size, 0);
        inverse.resize(size, 0);
        let (par, params) = (Par::Seq, faer::Spec::default());
        let mut memory = MemBuffer::new(factor::lu_in_place_scratch::<usize, f64>(size, size, par, params));
        let matrix = self.lu.get_mut(..size, ..size);
        factor::lu_in_place(matrix, forward, inverse, par, MemStack::new(&mut memory), params);
    }

    /// Both factors in one matrix.
    fn both(&self) -> MatRef<'_, f64> {
        self.lu.get(..self.size, ..self.size)
    }

    /// Solves for several right-hand sides, in place.
    pub fn solve(&self, right: MatMut<'_, f64>) {
        let [forward, inverse] = &self.rows;
        let rows = PermRef::new_checked(forward, inverse, self.size);
        let mut memory =
            MemBuffer::new(solve::solve_in_place_scratch::<usize, f64>(self.size, right.ncols(), Par::Seq));
        solve::solve_in_place(self.both(), self.both(), rows, right, Par::Seq, MemStack::new(&mut memory));
    }

    /// The pivots.
    pub fn pivots(&self) -> impl Iterator<Item = f64> {
        (0..self.size).map(|k| self.lu[(k, k)])
    }

    /// The sign of the determinant, 0 if a pivot vanishes to working precision.
    pub fn sign(&self) -> i8 {
        let mut negative = false;
        for pivot in self.pivots() {
            if pivot == 0.0 || !pivot.is_finite() {
                return 0;
            }
            negative ^= pivot < 0.0;
        }
        let mut seen = vec![false; self.size];
        for start in 0..self.size {
            let (mut k, mut length) = (start, 0);
            while !seen[k] {
                seen[k] = true;
                k = self.rows[0][k];
                length += 1;
            }
            negative ^= length > 0 && length % 2 == 0;
        }
        if negative { -1 } else { 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Matrices of different sizes in the same arrays: `A x = b` with a known `x`, and determinants that are known in closed
    /// form. Tolerance: rounding errors times the condition of these matrices, at most 30.
    #[test]
    fn arrays_serve_matrices_of_any_size() {
        let mut factors = Factors::default();
        for (size, swapped) in [(3, false), (7, true), (2, true), (7, false)] {
            // `I + u vᵀ` with determinant `1 + vᵀu`; swapping two rows changes its sign.
            let entry = |i: usize, j: usize| {
                let i = match i {
                    0 if swapped => 1,
                    1 if swapped => 0,
                    i => i,
                };
                f64::from(u8::from(i == j)) + (i as f64 - 0.5) * 0.3 / (1.0 + j as f64)
            };
            factors.factorise(size, |mut matrix| {
                for j in 0..size {
                    for i in 0..size {
                        matrix[(i, j)] = entry(i, j);
                    }
                }
            });
            let x = |j: usize, column: usize| 1.0 + j as f64 - 0.2 * column as f64;
            let mut right =
                Mat::from_fn(size, 2, |i, column| (0..size).map(|j| entry(i, j) * x(j, column)).sum::<f64>());
            factors.solve(right.as_mut());
            for column in 0..2 {
                for j in 0..size {
                    assert!((right[(j, column)] - x(j, column)).abs() < 1e-13, "{size}, {j}: {right:?}");
                }
            }
            let determinant = 1.0 + (0..size).map(|k| (k as f64 - 0.5) * 0.3 / (1.0 + k as f64)).sum::<f64>();
            assert!(determinant > 0.1);
            assert_eq!(factors.sign(), if swapped { -1 } else { 1 });
        }
        factors.factorise(2, |mut matrix| matrix.fill(1.0));
        assert_eq!(factors.sign(), 0);
    }
}
