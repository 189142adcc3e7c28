//! The elimination tree of a sparse factor, divided for several threads.

use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;

/// Largest share of the work in one subtree that a single thread eliminates.
const SHARE: f64 = 1.0 / 12.0;

/// The elimination tree of supernodes, divided into subtrees for single threads and the supernodes above them.
pub(super) struct Tree {
    /// The parent of each eliminated supernode; the number of them denotes what follows the tree.
    pub(super) parents: Vec<usize>,
    /// Supernodes of disjoint subtrees, ascending, the most work first.
    pub(super) subtrees: Vec<Vec<usize>>,
    /// The supernodes above them, ascending.
    pub(super) above: Vec<usize>,
    /// Numbers of columns and of remaining rows of each front.
    sizes: Vec<(usize, usize)>,
}

impl Tree {
    /// The tree of the first `count` supernodes.
    pub(super) fn new(supernodes: &SymbolicSupernodalCholesky<usize>, count: usize) -> Self {
        let mut of_row = vec![0; supernodes.nrows()];
        for s in 0..supernodes.n_supernodes() {
            of_row[supernodes.supernode_begin()[s]..supernodes.supernode_end()[s]].fill(s);
        }
        let parent =
            |s: usize| supernodes.supernode(s).pattern().iter().min().map_or(count, |&row| of_row[row].min(count));
        let parents: Vec<usize> = (0..count).map(parent).collect();
        let size = |s: usize| {
            let columns = supernodes.supernode_end()[s] - supernodes.supernode_begin()[s];
            (columns, supernodes.supernode(s).pattern().len())
        };
        let sizes: Vec<(usize, usize)> = (0..count).map(size).collect();
        let mut work: Vec<f64> =
            sizes.iter().map(|&(columns, rest)| columns as f64 * ((columns + rest) as f64).powi(2)).collect();
        let all: f64 = work.iter().sum();
        for s in 0..count {
            if parents[s] < count {
                work[parents[s]] += work[s];
            }
        }
        // A subtree is as large as its share of the work allows.
        let small = |s: usize| work[s] <= SHARE * all;
        let mut root_of = vec![count; count];
        let (mut roots, mut above) = (vec![], vec![]);
        for s in (0..count).rev() {
            let parent = parents[s];
            if parent < count && root_of[parent] < count {
                root_of[s] = root_of[parent];
            } else if small(s) {
                root_of[s] = s;
                roots.push(s);
            } else {
                above.push(s);
            }
        }
        above.reverse();
        roots.sort_unstable_by(|a, b| work[*b].total_cmp(&work[*a]));
        let mut place = vec![0; count + 1];
        roots.iter().enumerate().for_each(|(position, &root)| place[root] = position);
        let mut subtrees = vec![vec![]; roots.len()];
        (0..count).filter(|&s| root_of[s] < count).for_each(|s| subtrees[place[root_of[s]]].push(s));
        Self { parents, subtrees, above, sizes }
    }

    /// Estimated largest number of entries held at a time, without a kept factor: the updates that wait, and a front.
    pub(super) fn peak_entries(&self) -> usize {
        let count = self.parents.len();
        let entries = |s: usize| self.sizes[s].1.pow(2);
        let mut of_children = vec![0; count + 1];
        (0..count).for_each(|s| of_children[self.parents[s]] += entries(s));
        let run = |supernodes: &[usize], held: usize| {
            supernodes.iter().fold((held, held), |(peak, held), &s| {
                let (columns, rest) = self.sizes[s];
                let front = 3 * columns * (columns + rest) + rest * rest;
                let after = (held + rest * rest).saturating_sub(of_children[s]);
                (peak.max(held + front), after)
            })
        };
        let mut peaks: Vec<(usize, usize)> = self.subtrees.iter().map(|subtree| run(subtree, 0)).collect();
        let waiting: usize = peaks.iter().map(|(_, left)| left).sum();
        peaks.sort_unstable();
        let at_once: usize = peaks.iter().rev().take(super::threads::count()).map(|(peak, _)| peak).sum();
        (waiting + at_once).max(run(&self.above, waiting).0)
    }
}
