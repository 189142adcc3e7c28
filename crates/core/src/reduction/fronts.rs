//! Multifrontal elimination of `A = K + s M`: dense fronts along the elimination tree, on all cores.
//!
//! ```text
//! front = [A₁₁ A₂₁ᵀ; A₂₁ U],   A₁₁ = L₁₁ L₁₁ᵀ,   L₂₁ = A₂₁ L₁₁⁻ᵀ,   U ← U - L₂₁ L₂₁ᵀ
//! ```
//!
//! The update `U` of a front is added to the front of its parent. Disjoint subtrees are eliminated by different threads;
//! large fronts above them are divided into blocks. The blocks do not depend on the number of threads, and updates are
//! added in a fixed order: the result is the same on any number of cores.
//!
//! Source: Duff, Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", ACM Trans. Math.
//! Softw. 9 (1983) 302-325.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::{Mat, MatMut};

use super::SparseMatrix;
use super::elimination_tree::Tree;
use super::front_blocks::{Broken, positive, signed, subtract_lower};
use super::precision::Values;
use super::threads::shared;

/// Number of rows of a front below which it is not divided among threads.
const DIVIDED: usize = 768;
/// The place of a row that a front does not have.
const ABSENT: u32 = u32::MAX;

/// A matrix `K + s M` with the structure of its factor. `K` is called `matrix`, since the mass matrix may stand for it.
pub(super) struct Fronts<'a> {
    pub(super) matrix: &'a SparseMatrix,
    pub(super) mass: &'a SparseMatrix,
    pub(super) shift: f64,
    pub(super) supernodes: &'a SymbolicSupernodalCholesky<usize>,
    /// The tree of all supernodes.
    pub(super) tree: &'a Tree,
    /// The row eliminated at each position, and the position of each row.
    pub(super) order: (&'a [usize], &'a [usize]),
}

/// How the pivots of a front are eliminated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pivots {
    /// `L Lᵀ`.
    Positive,
    /// `L D Lᵀ`, whose negative pivots are counted.
    Signed,
}

/// The rows of a front: `columns` that it eliminates, from position `start` on, then `rest`.
#[derive(Clone, Copy)]
struct Shape<'a> {
    start: usize,
    columns: usize,
    rest: &'a [usize],
}

/// What a front leaves to its parent: a lower triangle over the rows that remain.
struct Update {
    supernode: usize,
    value: Mat<f64>,
}

/// The factor to be filled, by supernodes.
enum Kept<'f> {
    Nothing,
    Double(Vec<Mutex<&'f mut [f64]>>),
    Single(Vec<Mutex<&'f mut [f32]>>),
}

/// One sweep through the tree.
struct Sweep<'a, 'f> {
    fronts: &'f Fronts<'a>,
    pivots: Pivots,
    factor: Kept<'f>,
    pending: Vec<Mutex<Vec<Update>>>,
    negative: AtomicUsize,
    indefinite: AtomicBool,
    broken: AtomicBool,
}

impl Fronts<'_> {
    /// Fills `values` with the factor `L` of `L Lᵀ` in the layout of the supernodes.
    pub(super) fn cholesky(&self, values: &mut [f64]) -> Result<(), Broken> {
        self.sweep(Pivots::Positive, Kept::Double(self.divided(values))).map(|_| ())
    }

    /// Fills `values` with the factor `L` of `L D Lᵀ` in the layout of the supernodes, `D` on its diagonal. It is computed
    /// in double precision and rounded to that of `values`.
    pub(super) fn ldlt(&self, values: &mut Values) -> Result<(), Broken> {
        let kept = match values {
            Values::Double(values) => Kept::Double(self.divided(values)),
            Values::Single(values) => Kept::Single(self.divided(values)),
        };
        self.sweep(Pivots::Signed, kept).map(|_| ())
    }

    /// The number of negative pivots of `L D Lᵀ`. Nothing of the factor is kept.
    pub(super) fn count_negative(&self) -> Result<usize, Broken> {
        self.sweep(Pivots::Signed, Kept::Nothing)
    }

    /// The parts of `values` that belong to each supernode.
    fn divided<'v, T>(&self, values: &'v mut [T]) -> Vec<Mutex<&'v mut [T]>> {
        let mut rest = values;
        let part = |ends: &[usize]| {
            let (mine, others) = std::mem::take(&mut rest).split_at_mut(ends[1] - ends[0]);
            rest = others;
            Mutex::new(mine)
        };
        self.supernodes.col_ptr_for_val().windows(2).map(part).collect()
    }

    /// Estimated bytes that a sweep takes in addition to a kept factor.
    pub(super) fn bytes(tree: &Tree) -> usize {
        size_of::<f64>() * tree.peak_entries()
    }

    /// Eliminates all supernodes. Returns the number of negative pivots.
    fn sweep<'f>(&'f self, pivots: Pivots, factor: Kept<'f>) -> Result<usize, Broken> {
        let sweep = Sweep::new(self, pivots, factor);
        shared(self.tree.subtrees.iter().collect(), true, |subtree: &Vec<usize>| {
            let mut place = vec![ABSENT; self.order.0.len()];
            subtree.iter().for_each(|&s| sweep.supernode(s, &mut place, false));
        });
        let mut place = vec![ABSENT; self.order.0.len()];
        self.tree.above.iter().for_each(|&s| sweep.supernode(s, &mut place, true));
        sweep.outcome()?;
        Ok(sweep.negative.into_inner())
    }
}

impl<'a, 'f> Sweep<'a, 'f> {
    fn new(fronts: &'f Fronts<'a>, pivots: Pivots, factor: Kept<'f>) -> Self {
        let pending = fronts.tree.parents.iter().map(|_| Mutex::new(vec![])).collect();
        let (negative, indefinite, broken) = (AtomicUsize::new(0), AtomicBool::new(false), AtomicBool::new(false));
        Self { fronts, pivots, factor, pending, negative, indefinite, broken }
    }

    fn outcome(&self) -> Result<(), Broken> {
        if self.broken.load(Ordering::Relaxed) {
            return Err(Broken::Pivot);
        }
        if self.indefinite.load(Ordering::Relaxed) { Err(Broken::Indefinite) } else { Ok(()) }
    }

    /// Eliminates supernode `s`, whose children are eliminated. `place` is memory for the places of rows.
    fn supernode(&self, s: usize, place: &mut [u32], parallel: bool) {
        if self.outcome().is_err() {
            return;
        }
        let supernodes = self.fronts.supernodes;
        let start = supernodes.supernode_begin()[s];
        let shape =
            Shape { start, columns: supernodes.supernode_end()[s] - start, rest: supernodes.supernode(s).pattern() };
        let children = self.pending[s].lock().map(|mut children| std::mem::take(&mut *children)).unwrap_or_default();
        let update = self.front(s, shape, children, place, parallel);
        if !shape.rest.is_empty()
            && let Ok(mut of_parent) = self.pending[self.fronts.tree.parents[s]].lock()
        {
            of_parent.push(update);
        }
    }

    /// Assembles a front and eliminates its columns.
    fn front(
        &self,
        s: usize,
        shape: Shape<'_>,
        mut children: Vec<Update>,
        place: &mut [u32],
        parallel: bool,
    ) -> Update {
        let (columns, remaining) = (shape.columns, shape.rest.len());
        let rows = columns + remaining;
        let own = || (shape.start..shape.start + columns).chain(shape.rest.iter().copied());
        own().enumerate().for_each(|(local, row)| place[row] = local as u32);
        let mut memory;
        let mut kept = match &self.factor {
            Kept::Double(factor) => factor[s].lock().ok(),
            Kept::Nothing | Kept::Single(_) => None,
        };
        let panel = match &mut kept {
            Some(values) => &mut ***values,
            None => {
                memory = vec![0.0; rows * columns];
                &mut memory[..]
            }
        };
        let mut panel = MatMut::from_column_major_slice_mut(panel, rows, columns);
        let mut update = Mat::<f64>::zeros(remaining, remaining);
        let mut value = Lower { panel: panel.as_mut(), update: update.as_mut(), columns };
        self.assemble(shape, place, &mut value);
        children.sort_unstable_by_key(|child| child.supernode);
        for child in children {
            let rest = self.fronts.supernodes.supernode(child.supernode).pattern();
            let local: Vec<u32> = rest.iter().map(|&row| place[row]).collect();
            value.add(&child.value, &local);
        }
        own().for_each(|row| place[row] = ABSENT);
        let parallel = parallel && rows >= DIVIDED;
        match self.pivots {
            Pivots::Positive => {
                if positive(panel.as_mut(), parallel).is_err() {
                    self.indefinite.store(true, Ordering::Relaxed);
                } else {
                    let below = panel.as_ref().subrows(columns, remaining);
                    subtract_lower(update.as_mut(), below, below, parallel);
                }
            }
            Pivots::Signed => match signed(panel.as_mut(), update.as_mut(), parallel) {
                Some(negative) => drop(self.negative.fetch_add(negative, Ordering::Relaxed)),
                None => self.broken.store(true, Ordering::Relaxed),
            },
        }
        if let Kept::Single(factor) = &self.factor
            && let Ok(mut kept) = factor[s].lock()
        {
            let rounded = panel.col_iter().flat_map(|column| column.iter().map(|value| *value as f32));
            kept.iter_mut().zip(rounded).for_each(|(to, value)| *to = value);
        }
        Update { supernode: s, value: update }
    }

    /// Adds the entries of the matrix that belong to a front. A front has the rows of the lower triangle; an entry that only
    /// the upper triangle stores is 0 within [`SYMMETRY_TOLERANCE`](super::SYMMETRY_TOLERANCE) and left out.
    fn assemble(&self, shape: Shape<'_>, place: &[u32], value: &mut Lower<'_>) {
        let Fronts { matrix, mass, shift, order: (forward, inverse), supernodes: _, tree: _ } = *self.fronts;
        for position in shape.start..shape.start + shape.columns {
            let (row, column) = (forward[position], place[position] as usize);
            let (matrix, mass) = (matrix.as_ref(), mass.as_ref());
            let below = |other: usize| {
                let local = place[inverse[other]];
                (inverse[other] >= position && local != ABSENT).then_some(local as usize)
            };
            for (other, entry) in matrix.row_idx_of_col(row).zip(matrix.val_of_col(row)) {
                if let Some(local) = below(other) {
                    value.panel[(local, column)] += entry;
                }
            }
            for (other, entry) in mass.row_idx_of_col(row).zip(mass.val_of_col(row)) {
                if let Some(local) = below(other) {
                    value.panel[(local, column)] += shift * entry;
                }
            }
        }
    }
}

/// The lower triangle of a front: the columns to eliminate, and what remains.
struct Lower<'a> {
    panel: MatMut<'a, f64>,
    update: MatMut<'a, f64>,
    columns: usize,
}

impl Lower<'_> {
    /// Adds the lower triangle of the update of a child, whose rows have the places `local`, ascending.
    fn add(&mut self, child: &Mat<f64>, local: &[u32]) {
        for (j, &column) in local.iter().enumerate() {
            let from = &child.col_as_slice(j)[j..];
            let (to, first) = match (column as usize).checked_sub(self.columns) {
                None => (self.panel.as_mut().col_mut(column as usize), 0),
                Some(column) => (self.update.as_mut().col_mut(column), self.columns),
            };
            let Some(to) = to.try_as_col_major_mut() else { continue };
            let to = to.as_slice_mut();
            local[j..].iter().zip(from).for_each(|(&row, value)| to[row as usize - first] += value);
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::pencil::Pencil;
    use super::*;
    use faer::sparse::Triplet;

    /// A cube of `side³` masses with springs between neighbours along its edges and diagonals, held at one corner.
    pub(in crate::reduction) fn cube(side: usize) -> [SparseMatrix; 2] {
        let at = |x: usize, y: usize, z: usize| (x * side + y) * side + z;
        let n = side * side * side;
        let (mut mass, mut stiffness) = (vec![], vec![Triplet::new(0, 0, 10.0)]);
        for i in 0..n {
            let [x, y, z] = [i / (side * side), i / side % side, i % side];
            mass.push(Triplet::new(i, i, 2.0 + (i as f64).sin()));
            for [a, b, c] in [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 1, 1]] {
                let [x2, y2, z2] = [x + a, y + b, z + c];
                if x2 < side && y2 < side && z2 < side {
                    let (other, spring) = (at(x2, y2, z2), 100.0 + 30.0 * (0.3 * i as f64).cos());
                    for (row, column, sign) in [(i, i, 1.0), (other, other, 1.0), (i, other, -1.0), (other, i, -1.0)] {
                        stiffness.push(Triplet::new(row, column, sign * spring));
                        mass.push(Triplet::new(row, column, if row == column { 0.3 } else { 0.1 }));
                    }
                }
            }
        }
        [mass, stiffness].map(|triplets| SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap())
    }

    /// Entries that one triangle stores and the other does not, which must be 0 within the tolerance of symmetry.
    #[test]
    fn entries_of_one_triangle_alone_change_nothing() {
        let [mass, stiffness] = cube(6);
        let n = mass.nrows();
        let alone = |matrix: &SparseMatrix, value: f64| {
            let view = matrix.as_ref();
            let stored = (0..n).flat_map(|column| {
                view.row_idx_of_col(column)
                    .zip(view.val_of_col(column))
                    .map(move |(row, v)| Triplet::new(row, column, *v))
            });
            let far =
                (0..n).flat_map(|i| [Triplet::new(i, (5 * i + 90) % n, value), Triplet::new(i, n - 1 - i, value)]);
            SparseMatrix::try_new_from_triplets(n, n, &stored.chain(far).collect::<Vec<_>>()).unwrap()
        };
        let solved = |mass: &SparseMatrix, stiffness: &SparseMatrix| {
            let pencil = Pencil::new("cube", mass, stiffness).unwrap();
            let mut x = Mat::<f64>::ones(n, 1);
            pencil.llt(3.0).unwrap().unwrap().solve(x.as_mut());
            (x, pencil.count_below(150.0).unwrap())
        };
        let (expected, count) = solved(&mass, &stiffness);
        assert!(0 < count && count < n);
        // In 2-norms: the entries are two permutations times 1e-11, and the inverse of `K + 3 M` is at most 1/3, since `M ≥ 1`.
        let change = 2e-11 / 3.0 * (n as f64).sqrt();
        for value in [0.0, 1e-11] {
            let (found, counted) = solved(&alone(&mass, 0.0), &alone(&stiffness, value));
            assert!((found - &expected).norm_max() < change * expected.norm_max());
            assert_eq!(counted, count);
        }
    }
}
