//! Triangular solves with a supernodal factor along its elimination tree, on all cores.
//!
//! ```text
//! supernode = [L₁₁; L₂₁]:   y₁ = L₁₁⁻¹ b₁,  b₂ ← b₂ - L₂₁ y₁   (forward)
//!                           x₁ = L₁₁⁻ᵀ (y₁ - L₂₁ᵀ x₂)          (backward)
//! ```
//!
//! Disjoint subtrees are solved by different threads, each on a copy of its rows. What their forward solves leave for the
//! rows above is added in a fixed order. The supernodes above them are solved one after the other, in blocks that threads
//! share. The blocks do not depend on the number of threads: the result is the same on any number of cores.

use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::{
    solve_lower_triangular_in_place, solve_unit_lower_triangular_in_place, solve_unit_upper_triangular_in_place,
    solve_upper_triangular_in_place,
};
use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::{Accum, Mat, MatMut, MatRef, Par};

use super::elimination_tree::Tree;
use super::precision::Real;
use super::threads::{on_threads, row_blocks, shared, threads_for};

/// Number of columns of a supernode that are solved at a time, and of rows below them. This and the next two are smaller
/// in tests, whose supernodes are small.
const BLOCK: usize = if cfg!(test) { 24 } else { 256 };
/// Number of columns of a block, each a scalar product per right side, that a thread takes at a time.
const COLUMNS: usize = if cfg!(test) { 7 } else { 32 };
/// Number of entries of a block of a supernode below which threads do not share it.
const DIVIDED: usize = if cfg!(test) { 1 << 9 } else { 1 << 19 };
/// Largest number of right sides solved at a time.
const TOGETHER: usize = 24;

/// A supernodal factor `L`.
#[derive(Clone, Copy)]
pub(super) struct Triangle<'a, T = f64> {
    pub(super) supernodes: &'a SymbolicSupernodalCholesky<usize>,
    pub(super) tree: &'a Tree,
    pub(super) values: &'a [T],
    /// Whether the diagonal of `L` is 1; the stored one is then ignored.
    pub(super) unit: bool,
}

impl<T: Real> Triangle<'_, T> {
    /// `L⁻¹ Z` in place.
    pub(super) fn forward(&self, z: MatMut<'_, T>) {
        in_blocks(z, |mut z| {
            for (subtree, solved) in self.tree.subtrees.iter().zip(self.subtrees(z.as_ref(), false)) {
                let own = self.own(subtree).count();
                for j in 0..z.ncols() {
                    for (i, row) in self.own(subtree).enumerate() {
                        z[(row, j)] = solved[(i, j)];
                    }
                    for (i, &row) in self.above(subtree).iter().enumerate() {
                        z[(row, j)] += solved[(own + i, j)];
                    }
                }
            }
            for &s in &self.tree.above {
                let (panel, pattern) = self.panel(s);
                let (start, columns) = (self.supernodes.supernode_begin()[s], panel.ncols());
                let mut front = Mat::zeros(panel.nrows(), z.ncols());
                front.subrows_mut(0, columns).copy_from(z.as_ref().subrows(start, columns));
                self.forward_in(panel, front.as_mut());
                z.as_mut().subrows_mut(start, columns).copy_from(front.subrows(0, columns));
                for j in 0..z.ncols() {
                    pattern
                        .iter()
                        .zip(&front.col_as_slice(j)[columns..])
                        .for_each(|(&row, value)| z[(row, j)] += *value);
                }
            }
        });
    }

    /// `L⁻ᵀ Z` in place.
    pub(super) fn backward(&self, z: MatMut<'_, T>) {
        in_blocks(z, |mut z| {
            for &s in self.tree.above.iter().rev() {
                let (panel, pattern) = self.panel(s);
                let (start, columns) = (self.supernodes.supernode_begin()[s], panel.ncols());
                let mut front = Mat::zeros(panel.nrows(), z.ncols());
                front.subrows_mut(0, columns).copy_from(z.as_ref().subrows(start, columns));
                for j in 0..z.ncols() {
                    let below = &mut front.col_as_slice_mut(j)[columns..];
                    pattern.iter().zip(below).for_each(|(&row, value)| *value = z[(row, j)]);
                }
                self.backward_in(panel, front.as_mut());
                z.as_mut().subrows_mut(start, columns).copy_from(front.subrows(0, columns));
            }
            for (subtree, solved) in self.tree.subtrees.iter().zip(self.subtrees(z.as_ref(), true)) {
                for j in 0..z.ncols() {
                    self.own(subtree).enumerate().for_each(|(i, row)| z[(row, j)] = solved[(i, j)]);
                }
            }
        });
    }

    /// Solves every subtree on a copy of its rows of `z`, followed by the rows above: forward from 0 there, backward from
    /// `z`.
    fn subtrees(&self, z: MatRef<'_, T>, backward: bool) -> Vec<Mat<T>> {
        let subtrees = &self.tree.subtrees;
        let mut places = vec![vec![0_u32; z.nrows()]; threads_for(subtrees.len())];
        let solved = on_threads(&mut places, subtrees, &mut |()| (), &|place: &mut Vec<u32>, subtree, _| {
            let rows = || self.own(subtree).chain(self.above(subtree).iter().copied());
            rows().enumerate().for_each(|(local, row)| place[row] = local as u32);
            let (own, all) = (self.own(subtree).count(), rows().count());
            let mut local = Mat::zeros(all, z.ncols());
            for j in 0..z.ncols() {
                let values = rows().take(if backward { all } else { own }).map(|row| z[(row, j)]);
                local.col_as_slice_mut(j).iter_mut().zip(values).for_each(|(to, value)| *to = value);
            }
            let mut below = Mat::zeros(0, z.ncols());
            if backward {
                subtree.iter().rev().for_each(|&s| self.backward_at(s, place, &mut local, &mut below));
            } else {
                subtree.iter().for_each(|&s| self.forward_at(s, place, &mut local, &mut below));
            }
            Ok::<_, std::convert::Infallible>(local)
        });
        let Ok(solved) = solved;
        solved
    }

    /// Forward solve with supernode `s`; row `i` is at `place[i]` of `local`. `below` is memory.
    fn forward_at(&self, s: usize, place: &[u32], local: &mut Mat<T>, below: &mut Mat<T>) {
        let (panel, pattern) = self.panel(s);
        let (top, rest) = panel.split_at_row(panel.ncols());
        let first = place[self.supernodes.supernode_begin()[s]] as usize;
        let mut of_node = local.subrows_mut(first, panel.ncols());
        self.solve_top(top, of_node.as_mut(), false);
        below.resize_with(pattern.len(), of_node.ncols(), |_, _| T::zero());
        matmul(below.as_mut(), Accum::Replace, rest, of_node.as_ref(), T::one(), Par::Seq);
        for j in 0..below.ncols() {
            let (from, to) = (below.col_as_slice(j), local.col_as_slice_mut(j));
            pattern.iter().zip(from).for_each(|(&row, value)| to[place[row] as usize] -= *value);
        }
    }

    /// As [`Self::forward_at`], backward.
    fn backward_at(&self, s: usize, place: &[u32], local: &mut Mat<T>, below: &mut Mat<T>) {
        let (panel, pattern) = self.panel(s);
        let (top, rest) = panel.split_at_row(panel.ncols());
        let first = place[self.supernodes.supernode_begin()[s]] as usize;
        below.resize_with(pattern.len(), local.ncols(), |_, _| T::zero());
        for j in 0..below.ncols() {
            let (from, to) = (local.col_as_slice(j), below.col_as_slice_mut(j));
            pattern.iter().zip(to).for_each(|(&row, value)| *value = from[place[row] as usize]);
        }
        let mut of_node = local.subrows_mut(first, panel.ncols());
        matmul(of_node.as_mut(), Accum::Add, rest.transpose(), below.as_ref(), -T::one(), Par::Seq);
        self.solve_top(top, of_node, true);
    }

    /// Forward solve with a large supernode: `front` has its columns, solved, and what is added to the rows below.
    fn forward_in(&self, panel: MatRef<'_, T>, mut front: MatMut<'_, T>) {
        let columns = panel.ncols();
        for first in (0..columns).step_by(BLOCK) {
            let width = BLOCK.min(columns - first);
            let block = panel.submatrix(first, first, panel.nrows() - first, width);
            let (top, rest) = block.split_at_row(width);
            let (mut of_block, below) = front.as_mut().subrows_mut(first, block.nrows()).split_at_row_mut(width);
            self.solve_top(top, of_block.as_mut(), false);
            let of_block = of_block.as_ref();
            let chunks = row_blocks(below, BLOCK);
            shared(chunks, rest.nrows() * width >= DIVIDED, |(at, below): (usize, MatMut<'_, T>)| {
                let rest = rest.subrows(at, below.nrows());
                matmul(below, Accum::Add, rest, of_block, -T::one(), Par::Seq);
            });
        }
    }

    /// Backward solve with a large supernode: `front` has its columns and the values of the rows below.
    fn backward_in(&self, panel: MatRef<'_, T>, mut front: MatMut<'_, T>) {
        let columns = panel.ncols();
        for first in (0..columns).step_by(BLOCK).rev() {
            let width = BLOCK.min(columns - first);
            let block = panel.submatrix(first, first, panel.nrows() - first, width);
            let (top, rest) = block.split_at_row(width);
            let (mut of_block, below) = front.as_mut().subrows_mut(first, block.nrows()).split_at_row_mut(width);
            let below = below.as_ref();
            let chunks = row_blocks(of_block.as_mut(), COLUMNS);
            shared(chunks, rest.nrows() * width >= DIVIDED, |(at, of_columns): (usize, MatMut<'_, T>)| {
                let rest = rest.subcols(at, of_columns.nrows());
                matmul(of_columns, Accum::Add, rest.transpose(), below, -T::one(), Par::Seq);
            });
            self.solve_top(top, of_block, true);
        }
    }

    /// `L₁₁⁻¹ B`, or `L₁₁⁻ᵀ B` if `transposed`, in place.
    fn solve_top(&self, top: MatRef<'_, T>, b: MatMut<'_, T>, transposed: bool) {
        match (self.unit, transposed) {
            (false, false) => solve_lower_triangular_in_place(top, b, Par::Seq),
            (false, true) => solve_upper_triangular_in_place(top.transpose(), b, Par::Seq),
            (true, false) => solve_unit_lower_triangular_in_place(top, b, Par::Seq),
            (true, true) => solve_unit_upper_triangular_in_place(top.transpose(), b, Par::Seq),
        }
    }

    /// Trailing block of `L` for the `count` rows eliminated last, dense.
    pub(super) fn trailing(&self, count: usize) -> Mat<f64> {
        let first = self.supernodes.nrows() - count;
        let mut lower = Mat::<f64>::identity(count, count);
        for s in 0..self.supernodes.n_supernodes() {
            let (start, (panel, pattern)) = (self.supernodes.supernode_begin()[s], self.panel(s));
            for k in first.saturating_sub(start)..panel.ncols() {
                for i in k + usize::from(self.unit)..panel.nrows() {
                    let row = if i < panel.ncols() { start + i } else { pattern[i - panel.ncols()] };
                    lower[(row - first, start + k - first)] = panel[(i, k)].double();
                }
            }
        }
        lower
    }

    /// The diagonal of `L` as stored.
    pub(super) fn diagonal(&self) -> Vec<f64> {
        let panels = (0..self.supernodes.n_supernodes()).map(|s| self.panel(s).0);
        panels.flat_map(|panel| (0..panel.ncols()).map(move |k| panel[(k, k)].double())).collect()
    }

    /// `[L₁₁; L₂₁]` of supernode `s`, and the rows of `L₂₁`.
    pub(super) fn panel(&self, s: usize) -> (MatRef<'_, T>, &[usize]) {
        let ends = self.supernodes.col_ptr_for_val();
        let pattern = self.supernodes.supernode(s).pattern();
        let columns = self.supernodes.supernode_end()[s] - self.supernodes.supernode_begin()[s];
        let values = &self.values[ends[s]..ends[s + 1]];
        (MatRef::from_column_major_slice(values, columns + pattern.len(), columns), pattern)
    }

    /// The rows eliminated in a subtree.
    pub(super) fn own(&self, subtree: &[usize]) -> impl Iterator<Item = usize> {
        let [begin, end] = [self.supernodes.supernode_begin(), self.supernodes.supernode_end()];
        subtree.iter().flat_map(move |&s| begin[s]..end[s])
    }

    /// The rows above a subtree that it meets: those below the columns of its root.
    fn above(&self, subtree: &[usize]) -> &[usize] {
        subtree.last().map_or(&[], |&root| self.supernodes.supernode(root).pattern())
    }
}

/// Calls `solve` with at most [`TOGETHER`] columns at a time.
fn in_blocks<T>(mut z: MatMut<'_, T>, mut solve: impl FnMut(MatMut<'_, T>)) {
    while z.ncols() > 0 {
        let (block, rest) = {
            let at = TOGETHER.min(z.ncols());
            z.split_at_col_mut(at)
        };
        solve(block);
        z = rest;
    }
}

#[cfg(test)]
mod tests {
    use super::super::fronts::tests::cube;
    use super::super::pencil::Pencil;
    use super::super::precision::Precision;
    use super::*;

    /// Both solves with both kinds of factor, against dense substitution.
    #[test]
    fn solves_with_factors_of_a_cube_against_dense_substitution() {
        let [mass, stiffness] = cube(12);
        let n = mass.nrows();
        let pencil = Pencil::new("cube", &mass, &stiffness).unwrap();
        let ldlt = pencil.ldlt(-150.0, Precision::Double).unwrap();
        assert!(ldlt.pivots().iter().any(|pivot| *pivot < 0.0));
        let lower = ldlt.trailing(n);
        let llt = pencil.llt(3.0).unwrap().unwrap();
        let z = Mat::from_fn(n, TOGETHER + 5, |i, j| ((i * (j + 3)) as f64).sin());
        // Substitution loses `n ε` times the condition of `L`. For `L Lᵀ = K + 3 M` that is below 33: springs of at most 130
        // to 12 neighbours give eigenvalues of at most 3120 + 3 · 20, and `M ≥ 1` gives at least 3.
        let tolerance = 33.0 * n as f64 * f64::EPSILON;
        let near = |a: &Mat<f64>, b: &Mat<f64>| (a - b).norm_max() < tolerance * b.norm_max();

        assert!(pencil.tree.subtrees.len() > 2 && !pencil.tree.above.is_empty());
        let (mut found, mut expected) = (z.clone(), z.clone());
        ldlt.forward(found.as_mut());
        solve_unit_lower_triangular_in_place(lower.as_ref(), expected.as_mut(), Par::Seq);
        assert!(near(&found, &expected));
        let (mut found, mut expected) = (z.clone(), z.clone());
        ldlt.backward(found.as_mut());
        solve_unit_upper_triangular_in_place(lower.transpose(), expected.as_mut(), Par::Seq);
        assert!(near(&found, &expected));

        let mut found = z.clone();
        llt.solve(found.as_mut());
        assert!(near(&pencil.shifted_times(3.0, found.as_ref()), &z));
        // `L⁻¹ P A Pᵀ L⁻ᵀ = I`.
        assert!(near(&llt.whiten(&pencil.shifted_times(3.0, llt.unwhiten(z.clone()).as_ref())), &z));
    }
}
