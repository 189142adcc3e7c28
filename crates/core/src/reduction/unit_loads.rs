//! Responses of a factorised part to unit loads at its contact, computed subtree by subtree.
//!
//! `A = K + s M = L Lᵀ` is the factor of a part whose contact rows are eliminated last, `F` a unit load at each of them, and
//! `Φ` the kept modes, with `B = M Φ` and the contact rows `Φ_c`:
//!
//! ```text
//! A X = F - B Φ_cᵀ   =>   X = L⁻ᵀ (L⁻¹ F - Y Φ_cᵀ),   Y = L⁻¹ B
//! ```
//!
//! `L⁻¹ F` is zero above the contact rows, so that only the backward solve takes work. The rows of `X` in a subtree of the
//! elimination tree depend on those above it alone. Hence `X` is never held as a whole: each subtree adds its part of
//! `Xᵀ M X` and `Bᵀ X`, and its rows of `X` are dropped. Threads share the subtrees, whose parts are added in a fixed order:
//! the result is the same on any number of cores.
//!
//! `X` is stored transposed, a column for each row of the part, since its rows are copied as a whole.

use std::convert::Infallible;
use std::ops::AddAssign;

use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Accum, Mat, MatMut, MatRef, Par};

use super::ReductionError;
use super::elimination_tree::Tree;
use super::krylov::random_block;
use super::pencil::{Llt, Pencil};
use super::sparse::{one_norm, symmetric_times};
use super::threads::{on_threads, row_blocks, shared, threads_for};
use super::triangle::Triangle;

/// Number of loads that a thread solves at a time above the subtrees. This and the next two are smaller in tests, whose parts
/// are small.
const LOADS: usize = if cfg!(test) { 2 } else { 112 };
/// Number of rows of a part whose products are formed at a time.
const ROWS: usize = if cfg!(test) { 5 } else { 512 };
/// Number of rows above the subtrees whose products a thread forms at a time.
const ABOVE: usize = if cfg!(test) { 20 } else { 8192 };
/// Largest `|A x - b|` of a combination `x` of the responses, relative to `|A| |x| + |b|`.
const SOLVE_LIMIT: f64 = 1e-12;
/// Largest difference between `xᵀ M x` or `Bᵀ x` and the same from the sums over subtrees, relative to `xᵀ M x` or its root.
/// Rounding leaves 1e-12 or less; a subtree that is left out or added twice changes them by its share.
const SUM_LIMIT: f64 = 1e-9;
/// The column of a row that is not among some responses.
const ABSENT: u32 = u32::MAX;

/// What is kept of the responses `X` to the loads.
pub(super) struct Responses {
    /// The rows of `X` at the contact, loads by loads.
    pub(super) at_contact: Mat<f64>,
    /// `Xᵀ M X`, loads by loads, symmetric.
    pub(super) inertia: Mat<f64>,
    /// `Bᵀ X`, modes by loads.
    pub(super) of_modes: Mat<f64>,
}

/// Some rows of `X`, transposed.
#[derive(Clone, Copy)]
struct Rows<'a> {
    x: MatRef<'a, f64>,
    /// The column of each position in the order of elimination.
    place: &'a [u32],
}

impl<'a> Rows<'a> {
    fn at(&self, position: usize) -> Option<&'a [f64]> {
        let column = self.place[position];
        if column == ABSENT { None } else { self.x.col(column as usize).try_as_col_major().map(|x| x.as_slice()) }
    }
}

/// The part of some rows in the sums over all rows.
struct Share {
    /// The lower triangle of `Xᵀ M X`.
    inertia: Mat<f64>,
    /// `Xᵀ B`.
    of_modes: Mat<f64>,
    /// Row of the part and entry of `X z`.
    combined: Vec<(usize, f64)>,
}

/// The loads on a factorised part.
struct UnitLoads<'a> {
    pencil: &'a Pencil<'a>,
    /// `L`, with the tree of what is eliminated before the last rows.
    triangle: Triangle<'a>,
    /// First position of the last rows, which end with those of the contact.
    last: usize,
    /// `B`, `n×k`.
    border: MatRef<'a, f64>,
    /// `Y`, in the order of elimination.
    whitened: Mat<f64>,
    /// `Φ_c`.
    phi: Mat<f64>,
    /// The combination `z` of the loads that is checked.
    probe: Mat<f64>,
}

impl Llt<'_> {
    /// Responses to a unit load at each of the rows `contact`, which are eliminated last in this order, less those of the
    /// modes `phi`, `Φ`. `shift` is `s`.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`] if a combination of the responses does not solve its equations, or if its products
    /// differ from the sums.
    pub(super) fn responses(
        &self,
        shift: f64,
        contact: &[usize],
        phi: MatRef<'_, f64>,
    ) -> Result<Responses, ReductionError> {
        let pencil = self.pencil();
        let (tree, last) = before_last(pencil, contact.len());
        let border = symmetric_times(pencil.mass, phi);
        let loads = UnitLoads {
            pencil,
            triangle: Triangle { tree: &tree, ..self.triangle() },
            last,
            border: border.as_ref(),
            whitened: self.whiten(&border),
            phi: Mat::from_fn(contact.len(), phi.ncols(), |load, mode| phi[(contact[load], mode)]),
            probe: random_block(contact.len(), 1, 7),
        };
        let (responses, combined) = loads.solve();
        loads.check(shift, contact, &responses, &combined)?;
        Ok(responses)
    }

    /// Estimated bytes that [`Self::responses`] takes for `loads` and `modes`, in addition to factor and modes.
    pub(super) fn response_bytes(pencil: &Pencil<'_>, loads: usize, modes: usize) -> usize {
        let (tree, last) = before_last(pencil, loads);
        let supernodes = pencil.supernodes();
        let columns = |s: &usize| supernodes.supernode_end()[*s] - supernodes.supernode_begin()[*s];
        let rows = |supernodes: &[usize]| supernodes.iter().map(columns).sum::<usize>();
        let above = rows(&tree.above) + pencil.dimension() - last;
        let subtree = tree.subtrees.iter().map(|subtree| rows(subtree)).max().unwrap_or(0);
        let of_threads = threads_for(tree.subtrees.len()) * (subtree + 2 * ROWS);
        let shares = (tree.subtrees.len() + above.div_ceil(ABOVE)) * (loads + modes);
        size_of::<f64>() * (loads * (above + of_threads + shares) + 3 * pencil.dimension() * modes)
    }
}

/// The tree of the supernodes eliminated before the `count` last rows, and the position at which it ends.
fn before_last(pencil: &Pencil<'_>, count: usize) -> (Tree, usize) {
    let supernodes = pencil.supernodes();
    let first = pencil.dimension() - count;
    let before = supernodes.supernode_end().iter().take_while(|end| **end <= first).count();
    let last = supernodes.supernode_begin().get(before).copied().unwrap_or(pencil.dimension());
    (Tree::new(supernodes, before), last)
}

impl UnitLoads<'_> {
    /// The responses, and the entries `(row, value)` of `X z`.
    fn solve(&self) -> (Responses, Vec<(usize, f64)>) {
        let (n, loads) = (self.pencil.dimension(), self.phi.nrows());
        let supernodes = self.triangle.supernodes;
        let above: Vec<usize> = self.triangle.own(&self.triangle.tree.above).chain(self.last..n).collect();
        let mut place = vec![ABSENT; n];
        above.iter().enumerate().for_each(|(column, &position)| place[position] = column as u32);

        let mut x = Mat::zeros(loads, above.len());
        let last = self.at_last();
        x.subcols_mut(above.len() - last.nrows(), last.nrows()).copy_from(last.transpose());
        shared(row_blocks(x.as_mut(), LOADS), true, |(first, mut x): (usize, MatMut<'_, f64>)| {
            let mut below = Mat::zeros(x.nrows(), 0);
            for &s in self.triangle.tree.above.iter().rev() {
                let rows = Rows { x: x.as_ref(), place: &place };
                self.gather(s, &mut below, |position| rows.at(position));
                let of_node = x.as_mut().subcols_mut(
                    place[supernodes.supernode_begin()[s]] as usize,
                    supernodes.supernode_end()[s] - supernodes.supernode_begin()[s],
                );
                self.backward(s, self.phi.subrows(first, of_node.nrows()), of_node, below.as_ref());
            }
        });
        let outer = Rows { x: x.as_ref(), place: &place };

        let mut places = vec![vec![ABSENT; n]; threads_for(self.triangle.tree.subtrees.len())];
        let shares = on_threads(&mut places, &self.triangle.tree.subtrees, &mut |()| (), &|place, subtree, _| {
            let own: Vec<usize> = self.triangle.own(subtree).collect();
            own.iter().enumerate().for_each(|(column, &position)| place[position] = column as u32);
            let mut x = Mat::zeros(loads, own.len());
            let mut below = Mat::zeros(loads, 0);
            for &s in subtree.iter().rev() {
                let rows = Rows { x: x.as_ref(), place };
                self.gather(s, &mut below, |position| rows.at(position).or_else(|| outer.at(position)));
                let columns = supernodes.supernode_end()[s] - supernodes.supernode_begin()[s];
                let of_node = x.subcols_mut(place[supernodes.supernode_begin()[s]] as usize, columns);
                self.backward(s, self.phi.as_ref(), of_node, below.as_ref());
            }
            let share = self.share(&own, Rows { x: x.as_ref(), place }, Some(outer));
            own.iter().for_each(|&position| place[position] = ABSENT);
            Ok::<_, Infallible>(share)
        });
        let Ok(mut shares) = shares;
        #[cfg(test)]
        if crate::spoil::spoilt(crate::spoil::Spoil::Share)
            && let Some(share) = shares.first_mut()
        {
            share.inertia.fill(0.0);
        }
        let blocks: Vec<&[usize]> = above.chunks(ABOVE).collect();
        let mut threads = vec![(); threads_for(blocks.len())];
        let of_blocks = on_threads(&mut threads, &blocks, &mut |()| (), &|(), block, _| {
            Ok::<_, Infallible>(self.share(block, outer, None))
        });
        let Ok(of_blocks) = of_blocks;
        shares.extend(of_blocks);

        let mut sum = Share::none(loads, self.phi.ncols());
        shares.into_iter().for_each(|share| sum += share);
        let responses = Responses {
            at_contact: last.subrows(last.nrows() - loads, loads).to_owned(),
            inertia: Mat::from_fn(loads, loads, |i, j| sum.inertia[(i.max(j), i.min(j))]),
            of_modes: sum.of_modes.transpose().to_owned(),
        };
        (responses, sum.combined)
    }

    /// The last rows of `X`, from the dense end of the factor.
    fn at_last(&self) -> Mat<f64> {
        let (size, loads) = (self.pencil.dimension() - self.last, self.phi.nrows());
        let lower = self.triangle.trailing(size);
        let mut x = Mat::from_fn(size, loads, |i, load| if i + loads == size + load { 1.0 } else { 0.0 });
        solve_lower_triangular_in_place(lower.as_ref(), x.as_mut(), Par::Seq);
        x -= self.whitened.subrows(self.last, size) * self.phi.transpose();
        solve_upper_triangular_in_place(lower.transpose(), x.as_mut(), Par::Seq);
        x
    }

    /// Copies the rows of `X` below the columns of supernode `s` to `below`.
    fn gather<'x>(&self, s: usize, below: &mut Mat<f64>, at: impl Fn(usize) -> Option<&'x [f64]>) {
        let (_, pattern) = self.triangle.panel(s);
        below.resize_with(below.nrows(), pattern.len(), |_, _| 0.0);
        for (column, &position) in pattern.iter().enumerate() {
            if let Some(row) = at(position) {
                below.col_as_slice_mut(column).copy_from_slice(row);
            }
        }
    }

    /// `x`: the rows of `X` at the columns of supernode `s`, for the loads whose modes at the contact are `phi`; `below`: those
    /// of the rows below.
    fn backward(&self, s: usize, phi: MatRef<'_, f64>, mut x: MatMut<'_, f64>, below: MatRef<'_, f64>) {
        let (panel, _) = self.triangle.panel(s);
        let (top, rest) = panel.split_at_row(panel.ncols());
        let whitened = self.whitened.subrows(self.triangle.supernodes.supernode_begin()[s], top.ncols());
        matmul(x.as_mut(), Accum::Replace, phi, whitened.transpose(), -1.0, Par::Seq);
        matmul(x.as_mut(), Accum::Add, below, rest, -1.0, Par::Seq);
        solve_upper_triangular_in_place(top.transpose(), x.transpose_mut(), Par::Seq);
    }

    /// The part of the rows at `positions` in the sums. `own` has these rows and all others that count products with them;
    /// products with rows of `outer` are counted here alone, and therefore twice.
    fn share(&self, positions: &[usize], own: Rows<'_>, outer: Option<Rows<'_>>) -> Share {
        let (loads, modes) = self.phi.shape();
        let (forward, inverse) = self.pencil.order();
        let mut share = Share::none(loads, modes);
        for block in positions.chunks(ROWS) {
            let x = own.x.subcols(own.place[block[0]] as usize, block.len());
            let mut product = Mat::<f64>::zeros(loads, block.len());
            let mut crossing = vec![];
            for (column, &position) in block.iter().enumerate() {
                let mass = self.pencil.mass.as_ref();
                let mut across: Option<Vec<f64>> = None;
                for (other, &entry) in mass.row_idx_of_col(forward[position]).zip(mass.val_of_col(forward[position])) {
                    if let Some(row) = own.at(inverse[other]) {
                        add_multiple(product.col_as_slice_mut(column), entry, row);
                    } else if let Some(row) = outer.and_then(|outer| outer.at(inverse[other])) {
                        add_multiple(across.get_or_insert_with(|| vec![0.0; loads]), entry, row);
                    }
                }
                crossing.extend(across.map(|across| (column, across)));
            }
            let mut add = |a: MatRef<'_, f64>, b: MatRef<'_, f64>| {
                triangular::matmul(
                    share.inertia.as_mut(),
                    BlockStructure::TriangularLower,
                    Accum::Add,
                    a,
                    BlockStructure::Rectangular,
                    b.transpose(),
                    BlockStructure::Rectangular,
                    1.0,
                    Par::Seq,
                );
            };
            add(product.as_ref(), x);
            let across = Mat::from_fn(loads, crossing.len(), |load, k| crossing[k].1[load]);
            let beside = Mat::from_fn(loads, crossing.len(), |load, k| x[(load, crossing[k].0)]);
            add(across.as_ref(), beside.as_ref());
            add(beside.as_ref(), across.as_ref());
            let border = Mat::from_fn(block.len(), modes, |i, mode| self.border[(forward[block[i]], mode)]);
            matmul(share.of_modes.as_mut(), Accum::Add, x, border.as_ref(), 1.0, Par::Seq);
            let combined = x.transpose() * &self.probe;
            share.combined.extend(block.iter().enumerate().map(|(i, &position)| (forward[position], combined[(i, 0)])));
        }
        share
    }

    /// Checks `x = X z` and the products of it.
    fn check(
        &self,
        shift: f64,
        contact: &[usize],
        responses: &Responses,
        combined: &[(usize, f64)],
    ) -> Result<(), ReductionError> {
        let (pencil, z) = (self.pencil, &self.probe);
        let n = pencil.dimension();
        let mut x = Mat::<f64>::zeros(n, 1);
        combined.iter().for_each(|&(row, value)| x[(row, 0)] = value);
        let mut b = self.border * (self.phi.transpose() * z) * faer::Scale(-1.0);
        contact.iter().enumerate().for_each(|(load, &row)| b[(row, 0)] += z[(load, 0)]);
        let norm = one_norm(pencil.stiffness) + shift.abs() * one_norm(pencil.mass);
        let rest = (pencil.shifted_times(shift, x.as_ref()) - &b).norm_l2();
        let energy = (x.transpose() * symmetric_times(pencil.mass, x.as_ref()))[(0, 0)];
        let of_sums = (z.transpose() * &responses.inertia * z)[(0, 0)];
        let of_modes = (self.border.transpose() * &x - &responses.of_modes * z).norm_l2();
        for (what, value, limit) in [
            ("equations", rest / (norm * x.norm_l2() + b.norm_l2()), SOLVE_LIMIT),
            ("inertia", (of_sums - energy).abs() / energy, SUM_LIMIT),
            ("products with the modes", of_modes / energy.sqrt(), SUM_LIMIT),
        ] {
            if value.is_nan() || value > limit {
                return Err(pencil.failed(format!(
                    "the {what} of responses to loads at the contact differ by {value:.1e}, limit {limit:.1e}"
                )));
            }
        }
        Ok(())
    }
}

impl Share {
    fn none(loads: usize, modes: usize) -> Self {
        Self { inertia: Mat::zeros(loads, loads), of_modes: Mat::zeros(loads, modes), combined: vec![] }
    }
}

impl AddAssign for Share {
    fn add_assign(&mut self, other: Self) {
        self.inertia += other.inertia;
        self.of_modes += other.of_modes;
        self.combined.extend(other.combined);
    }
}

/// `sum += factor * x`.
fn add_multiple(sum: &mut [f64], factor: f64, x: &[f64]) {
    sum.iter_mut().zip(x).for_each(|(sum, x)| *sum += factor * x);
}

#[cfg(test)]
mod tests {
    use faer::linalg::solvers::Solve;

    use super::super::fronts::tests::cube;
    use super::*;

    /// A cube with many subtrees and the rows of a contact scattered over it, against a dense solve.
    #[test]
    fn responses_of_a_cube_against_a_dense_solve() {
        let [mass, stiffness] = cube(9);
        let (n, shift) = (mass.nrows(), 3.0);
        let contact: Vec<usize> = (0..n).filter(|i| i % 31 == 7 || (300..330).contains(i)).collect();
        let pencil = Pencil::with_last("cube", &mass, &stiffness, &contact).unwrap();
        let (tree, last) = before_last(&pencil, contact.len());
        assert!(tree.subtrees.len() > 2 && !tree.above.is_empty() && last <= n - contact.len());
        let phi = Mat::from_fn(n, 3, |i, j| ((i * (j + 2)) as f64).sin());
        let found = pencil.llt(shift).unwrap().unwrap().responses(shift, &contact, phi.as_ref()).unwrap();

        let dense = mass.to_dense();
        let border = &dense * &phi;
        let mut loads = Mat::zeros(n, contact.len());
        contact.iter().enumerate().for_each(|(load, &row)| loads[(row, load)] = 1.0);
        loads -= &border * (phi.transpose() * &loads);
        let x = (stiffness.to_dense() + faer::Scale(shift) * &dense).partial_piv_lu().solve(&loads);
        let at_contact = Mat::from_fn(contact.len(), contact.len(), |i, j| x[(contact[i], j)]);
        let expected = [at_contact, x.transpose() * dense * &x, border.transpose() * &x];
        // Both solves lose `n ε` times the condition, which is below 33² (see the test of triangular solves).
        let tolerance = 33.0 * 33.0 * n as f64 * f64::EPSILON;
        for (found, expected) in [found.at_contact, found.inertia, found.of_modes].iter().zip(&expected) {
            assert!((found - expected).norm_max() < tolerance * expected.norm_max());
        }
    }
}
