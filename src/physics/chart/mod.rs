//! Charts: the roots of a model over a box of conditions, as piecewise Chebyshev expansions of the symmetric functions
//! of clusters of roots. Built once, in the background; evaluated in microseconds, with bounds.
//!
//! On each leaf of the box every root of the band belongs to a cluster: alone where it is analytic by itself, with the
//! roots it merges with elsewhere. What the charted roots leave of the traces of the matrix and of its square is
//! expanded too, so that every evaluation is checked against traces that are known exactly: a root that was missed or
//! taken twice shows.

pub mod build;
pub(super) mod chebyshev;
mod cluster;

use faer::c64;

use super::operating_point::OperatingPoint;
use super::spectrum::{Root, RootError};
use super::summary::Mode;
use cluster::MAX_SIZE;

/// A condition that a chart depends on; its coordinate inside a box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axis {
    /// Friction coefficient, as it is.
    Friction,
    /// Normal load, by its logarithm.
    Load,
    /// Disc speed, by its logarithm; one direction of rotation.
    Speed,
}

impl Axis {
    fn coordinate(self, p: &OperatingPoint) -> f64 {
        match self {
            Self::Friction => p.friction_coefficient,
            Self::Load => p.normal_load_n.ln(),
            Self::Speed => p.disc_speed_rad_s.ln(),
        }
    }

    fn place(self, p: &mut OperatingPoint, coordinate: f64) {
        match self {
            Self::Friction => p.friction_coefficient = coordinate,
            Self::Load => p.normal_load_n = coordinate.exp(),
            Self::Speed => p.disc_speed_rad_s = coordinate.exp(),
        }
    }
}

/// The most axes of a chart.
const MAX_AXES: usize = 3;

/// Why a chart has no answer at a point.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum NotCharted {
    #[error("outside the charted conditions")]
    Outside,
    #[error("in a part of the box that did not converge")]
    NotConverged,
    #[error("the charted roots and the trace differ by {difference:e}, more than {limit:e}")]
    Incomplete { difference: f64, limit: f64 },
}

/// A node of the tree of boxes.
#[derive(Clone, Debug)]
enum Branch {
    /// Split along an axis at a coordinate.
    Split {
        axis: usize,
        at: f64,
        below: usize,
        above: usize,
    },
    Leaf(usize),
    /// Not converged: a dense solve is due there.
    Dense,
}

/// Some roots of a leaf.
#[derive(Clone, Debug)]
struct Cluster {
    /// Identities, ascending.
    ids: Vec<u32>,
    /// Where its channels begin.
    channel: usize,
    /// Bound of the error of each symmetric function.
    errors: Vec<f64>,
    /// Where the pad's share of a root that is alone is expanded, to [`build::SHARE_TOLERANCE`].
    share: Option<usize>,
    /// Of a pair that is apart: whether the lower identity has the lower frequency.
    ascending: bool,
}

/// A box on which everything converged.
#[derive(Clone, Debug)]
struct Leaf {
    low: [f64; MAX_AXES],
    high: [f64; MAX_AXES],
    clusters: Vec<Cluster>,
    /// Channels, the last two (or three) of them what the charted roots leave of the traces.
    channels: usize,
    /// `basis × channels`, channel fastest.
    coefficients: Vec<f64>,
    /// Error bounds of the two remainders.
    remainder_errors: [f64; 2],
}

/// The roots of a model over a box of conditions.
#[derive(Clone, Debug)]
pub struct Chart {
    axes: Vec<Axis>,
    low: [f64; MAX_AXES],
    high: [f64; MAX_AXES],
    nodes_per_axis: usize,
    branches: Vec<Branch>,
    leaves: Vec<Leaf>,
    /// Roots are charted by `λ²` where no damping takes part, by `λ` otherwise.
    undamped: bool,
    /// Dense solves that building it took.
    solves: usize,
}

/// What evaluation needs besides the chart; reused, it makes evaluation free of allocation.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    basis: Vec<f64>,
    channels: Vec<f64>,
}

impl Chart {
    /// Number of boxes it consists of.
    pub fn leaf_count(&self) -> usize {
        self.leaves.len()
    }

    /// Dense solves that building it took.
    pub fn solve_count(&self) -> usize {
        self.solves
    }

    /// Bytes it holds.
    pub fn size_bytes(&self) -> usize {
        self.leaves.iter().map(|leaf| 8 * leaf.coefficients.len()).sum()
    }

    /// Share of the box, by volume in its coordinates, that did not converge.
    pub fn dense_share(&self) -> f64 {
        let total: f64 = (0..self.axes.len()).map(|k| self.high[k] - self.low[k]).product();
        let charted: f64 = self
            .leaves
            .iter()
            .map(|leaf| (0..self.axes.len()).map(|k| leaf.high[k] - leaf.low[k]).product::<f64>())
            .sum();
        1.0 - charted / total
    }

    /// Every number that a prediction can depend on, as bits: two charts with equal words predict the same.
    pub fn words(&self) -> impl Iterator<Item = u64> {
        let branches = self.branches.iter().flat_map(|branch| match *branch {
            Branch::Split { axis, at, below, above } => [axis as u64, at.to_bits(), below as u64, above as u64],
            Branch::Leaf(leaf) => [u64::MAX, leaf as u64, 0, 0],
            Branch::Dense => [u64::MAX, u64::MAX, 0, 0],
        });
        let leaves = self.leaves.iter().flat_map(|leaf| {
            let clusters = leaf.clusters.iter().flat_map(|cluster| {
                let ids = cluster.ids.iter().map(|&id| u64::from(id));
                let errors = cluster.errors.iter().map(|error| error.to_bits());
                let rest =
                    [cluster.channel, cluster.share.map_or(0, |share| share + 1), usize::from(cluster.ascending)];
                ids.chain(errors).chain(rest.map(|number| number as u64))
            });
            let numbers = leaf.coefficients.iter().chain(&leaf.remainder_errors).chain(&leaf.low).chain(&leaf.high);
            clusters.chain(numbers.map(|number| number.to_bits()))
        });
        branches.chain(leaves)
    }

    /// The charted roots at `p`, appended to `out` in no particular order, without residuals, with shares of the
    /// pad where they are charted, and checked against `traces` (see [`Traces`](super::Traces)).
    ///
    /// # Errors
    /// [`NotCharted`]; `out` is then as it was.
    pub fn evaluate(
        &self,
        p: &OperatingPoint,
        traces: [f64; 2],
        scratch: &mut Scratch,
        out: &mut Vec<Mode>,
    ) -> Result<(), NotCharted> {
        let mut x = [0.0; MAX_AXES];
        for (k, axis) in self.axes.iter().enumerate() {
            x[k] = axis.coordinate(p);
            // Written so that NaN is outside.
            if !(x[k] >= self.low[k] && x[k] <= self.high[k]) {
                return Err(NotCharted::Outside);
            }
        }
        let leaf = &self.leaves[self.find(&x)?];
        self.expand(leaf, &x, scratch);
        let values = &scratch.channels;
        let before = out.len();
        let mut found = [0.0; 2];
        let mut limit = [0.0; 2];
        let mut roots = [(c64::ZERO, 0.0); MAX_SIZE];
        for cluster in &leaf.clusters {
            let size = cluster.ids.len();
            let mut functions = [c64::ZERO; MAX_SIZE];
            for (m, function) in functions[..size].iter_mut().enumerate() {
                *function = if self.undamped {
                    c64::new(values[cluster.channel + m], 0.0)
                } else {
                    c64::new(values[cluster.channel + 2 * m], values[cluster.channel + 2 * m + 1])
                };
            }
            cluster::roots(&functions[..size], &cluster.errors, &mut roots);
            self.sort_pair(cluster, &mut roots);
            let gap = if size == 2 { (roots[0].0 - roots[1].0).norm() } else { f64::INFINITY };
            for (&id, &(z, error)) in cluster.ids.iter().zip(&roots[..size]) {
                let mut root = self.charted(z, error, size <= 2 && z.im == 0.0 && 2.0 * error < gap);
                root.pad_participation = cluster.share.map_or(f64::NAN, |share| values[share].clamp(0.0, 1.0));
                let weight = if self.undamped { 1.0 } else { 2.0 };
                found[0] += weight * z.re;
                found[1] += weight * (z * z).re;
                limit[0] += weight * error;
                limit[1] += weight * 2.0 * z.norm() * error;
                out.push(Mode { id, root });
            }
        }
        for moment in 0..2 {
            let rest = values[leaf.channels - 2 + moment];
            let difference = (found[moment] + rest - traces[moment]).abs();
            let limit = limit[moment] + leaf.remainder_errors[moment];
            if difference.is_nan() || difference > limit {
                out.truncate(before);
                return Err(NotCharted::Incomplete { difference, limit });
            }
        }
        Ok(())
    }

    fn find(&self, x: &[f64; MAX_AXES]) -> Result<usize, NotCharted> {
        let mut at = 0;
        loop {
            match self.branches[at] {
                Branch::Split { axis, at: middle, below, above } => at = if x[axis] < middle { below } else { above },
                Branch::Leaf(leaf) => return Ok(leaf),
                Branch::Dense => return Err(NotCharted::NotConverged),
            }
        }
    }

    /// All channels of `leaf` at `x`.
    fn expand(&self, leaf: &Leaf, x: &[f64; MAX_AXES], scratch: &mut Scratch) {
        let (m, axes) = (self.nodes_per_axis, self.axes.len());
        scratch.basis.clear();
        scratch.basis.push(1.0);
        let mut polynomials = [0.0; 32];
        for (k, x) in x[..axes].iter().enumerate() {
            let unit = 2.0 * (x - leaf.low[k]) / (leaf.high[k] - leaf.low[k]) - 1.0;
            chebyshev::polynomials(unit, &mut polynomials[..m]);
            let inner = scratch.basis.len();
            scratch.basis.resize(inner * m, 0.0);
            // From the highest degree down, so that the lower ones are still there to multiply.
            for degree in (0..m).rev() {
                for i in 0..inner {
                    scratch.basis[degree * inner + i] = scratch.basis[i] * polynomials[degree];
                }
            }
        }
        scratch.channels.clear();
        scratch.channels.resize(leaf.channels, 0.0);
        for (weight, row) in scratch.basis.iter().zip(leaf.coefficients.chunks_exact(leaf.channels)) {
            for (channel, coefficient) in scratch.channels.iter_mut().zip(row) {
                *channel += weight * coefficient;
            }
        }
    }

    /// The root for a charted `z`; `apart` where an undamped one is known not to be one of a complex pair.
    fn charted(&self, z: c64, error: f64, apart: bool) -> Root {
        let (lambda, square, error) = if self.undamped {
            let lambda = super::spectrum::square_root(z);
            (lambda, z, RootError::from_square(lambda, error, apart))
        } else {
            (z, z * z, RootError::from_lambda(z, error))
        };
        Root { lambda, square, residual: f64::NAN, pad_participation: f64::NAN, error }
    }

    /// Puts the roots of a pair in the order of its identities: the growing one first while it is coupled, by
    /// frequency while it is apart.
    fn sort_pair(&self, cluster: &Cluster, roots: &mut [(c64, f64); MAX_SIZE]) {
        if cluster.ids.len() != 2 {
            return;
        }
        let (a, b) = (roots[0].0, roots[1].0);
        let in_order = if self.undamped && a.im != 0.0 {
            a.im > 0.0 // Im λ² = 2 σ ω
        } else if self.undamped {
            (a.re > b.re) == cluster.ascending // λ² = -ω²
        } else {
            (a.im < b.im) == cluster.ascending
        };
        if !in_order {
            roots.swap(0, 1);
        }
    }
}
