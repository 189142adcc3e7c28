//! Charts: the roots of a model over a box of conditions, as piecewise Chebyshev expansions of the symmetric
//! functions of clusters of roots. A chart is built once, in the background, and evaluated in microseconds, with
//! error bounds.
//!
//! On each leaf of the box every root of the band belongs to a cluster. A root that is analytic on the leaf is a
//! separate cluster; roots that merge somewhere share one. The remainders, which are the traces of the matrix and
//! of its square minus the contributions of the charted roots, are expanded too. Every evaluation is checked against
//! the exact traces, so a root that is missing or counted twice is detected.

pub mod build;
mod channels;
mod cluster;
mod derivatives;
mod fit;
mod lateral;
mod leaf;
pub(crate) mod pairing;
mod pieces;
mod samples;
mod totals;
mod tree;
mod words;

use faer::c64;

use super::law::Parameter;
use super::numbering::Census;
use super::operating_point::OperatingPoint;
use super::spectrum::{Root, RootError, magnitude, square_root};
use super::traces::Exact;
use channels::Channels;
use cluster::MAX_SIZE;
use fit::Basis;
use lateral::Speeds;
use totals::Totals;
use tree::Branch;

#[cfg(any(test, feature = "proof"))]
pub(crate) use leaf::MERGING;
pub use words::{BUILDER, FORMAT};

/// A condition that a chart depends on, and its coordinate inside a box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Axis {
    /// Friction coefficient; the coordinate is `μ`.
    Friction,
    /// Normal load; the coordinate is its logarithm.
    Load,
    /// Disc speed, of one sign; the coordinate is `-1/ω`, in which lateral friction is linear.
    Speed,
    /// Ratio of load to speed, if the model depends on both only through it.
    LoadOverSpeed,
    /// Damping coefficient of lateral friction, `μ N / |ω|`, if the speed matters to nothing else; see [`lateral`].
    LateralDamping,
}

impl Axis {
    /// Coordinate of `p` on this axis.
    fn coordinate(self, p: &OperatingPoint) -> f64 {
        match self {
            Self::Friction => p.friction_coefficient,
            Self::Load => p.normal_load_n.ln(),
            Self::Speed => -1.0 / p.disc_speed_rad_s,
            Self::LoadOverSpeed => p.normal_load_n / p.disc_speed_rad_s,
            Self::LateralDamping => p.friction_coefficient * p.normal_load_n / p.disc_speed_rad_s.abs(),
        }
    }

    /// Moves `p` to `coordinate` on this axis. With an axis of lateral damping, `p` is a point of the model
    /// [`lateral::in_place_of_speed`].
    fn place(self, p: &mut OperatingPoint, coordinate: f64) {
        match self {
            Self::Friction => p.friction_coefficient = coordinate,
            Self::Load => p.normal_load_n = coordinate.exp(),
            Self::Speed => p.disc_speed_rad_s = -1.0 / coordinate,
            Self::LoadOverSpeed => p.normal_load_n = coordinate * p.disc_speed_rad_s,
            Self::LateralDamping => lateral::place(p, coordinate),
        }
    }

    /// The parameter along this axis, and its derivative with respect to the coordinate. For a ratio of load to speed,
    /// the load.
    fn derivative(self, p: &OperatingPoint) -> (Parameter, f64) {
        match self {
            Self::Friction => (Parameter::Friction, 1.0),
            Self::Load => (Parameter::Load, p.normal_load_n),
            Self::Speed => (Parameter::Speed, p.disc_speed_rad_s * p.disc_speed_rad_s),
            Self::LoadOverSpeed => (Parameter::Load, p.disc_speed_rad_s),
            Self::LateralDamping => (Parameter::Speed, p.disc_speed_rad_s.signum()),
        }
    }

    /// Whether steps along the coordinate change the speed, beyond whose range in the box laws may be undefined.
    fn involves_speed(self) -> bool {
        match self {
            Self::Speed | Self::LoadOverSpeed => true,
            Self::Friction | Self::Load | Self::LateralDamping => false,
        }
    }

    /// Coordinate in which conditions are uniformly distributed, if loads and speeds are. Not with an axis of lateral damping.
    fn condition(self, coordinate: f64) -> f64 {
        match self {
            Self::Friction | Self::LateralDamping => coordinate,
            Self::Load => coordinate.exp(),
            Self::Speed | Self::LoadOverSpeed => -1.0 / coordinate,
        }
    }
}

/// Maximum number of axes of a chart.
const MAX_AXES: usize = 3;

/// Why a chart gives no roots at a point.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum NotCharted {
    /// The point is outside the box of the chart.
    #[error("outside the charted conditions")]
    Outside,
    /// No leaf holds the point: the expansions did not converge there, or have not been built yet.
    #[error("in a part of the box that did not converge")]
    NotConverged,
    /// The charted roots contradict the traces of the matrix, so one is missing or counted twice.
    #[error("the charted roots and the trace differ by {difference:e}, more than {limit:e}")]
    Incomplete {
        /// Difference from the exact trace.
        difference: f64,
        /// Largest difference that the error bounds allow.
        limit: f64,
    },
}

/// Roots of a leaf that are expanded together.
#[derive(Clone, Debug)]
struct Cluster {
    /// Index of its first channel in [`Leaf::functions`].
    channel: usize,
    /// Error bound of each symmetric function.
    errors: Vec<f64>,
    /// For a single root, the channel of [`Leaf::auxiliary`] with its pad participation, accurate to
    /// [`leaf::SHARE_TOLERANCE`]; `None` if that did not converge.
    share: Option<usize>,
}

impl Cluster {
    /// Number of roots.
    fn size(&self) -> usize {
        self.errors.len()
    }
}

/// A box on which every expansion converged.
#[derive(Clone, Debug)]
struct Leaf {
    low: [f64; MAX_AXES],
    high: [f64; MAX_AXES],
    clusters: Vec<Cluster>,
    /// Number of followed roots, charted or not; constant over the box.
    tracked: usize,
    /// Expansions of the symmetric functions of the clusters.
    functions: Channels,
    /// The other expansions: the two remainders of the traces, in the first channels, and the pad participations.
    auxiliary: Channels,
    /// Error bounds of the two remainders.
    remainder_errors: [f64; 2],
}

/// Number of channels of [`Leaf::auxiliary`] that hold remainders of the traces.
const REMAINDERS: usize = 2;

/// The roots of a model over a box of conditions.
#[derive(Clone, Debug)]
pub struct Chart {
    axes: Vec<Axis>,
    low: [f64; MAX_AXES],
    high: [f64; MAX_AXES],
    /// Range of speeds, if one axis is that of lateral damping.
    speeds: Option<Speeds>,
    basis: Basis,
    branches: Vec<Branch>,
    leaves: Vec<Leaf>,
    /// Whether the model is undamped: `λ²` is charted then, otherwise `λ`.
    undamped: bool,
    /// Number of dense solves the build has taken.
    solves: usize,
    /// Traces and norms of a model whose contact follows a state.
    totals: Option<Totals>,
}

/// Work arrays of an evaluation. Reusing them makes evaluation free of allocation.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    basis: Vec<f64>,
    functions: Vec<f64>,
    auxiliary: Vec<f64>,
}

impl Chart {
    /// Number of leaves.
    pub fn leaf_count(&self) -> usize {
        self.leaves.len()
    }

    /// Number of dense solves the build has taken.
    pub fn solve_count(&self) -> usize {
        self.solves
    }

    /// Size of the coefficients in bytes.
    pub fn size_bytes(&self) -> usize {
        let numbers = |leaf: &Leaf| leaf.functions.coefficients.len() + leaf.auxiliary.coefficients.len();
        self.leaves.iter().map(|leaf| 8 * numbers(leaf)).sum()
    }

    /// Share of the conditions not covered by a leaf. Conditions are taken as uniformly distributed over friction
    /// coefficient, load and speed; on an axis of load over speed, over the speeds at any one load.
    pub fn dense_share(&self) -> f64 {
        1.0 - self.leaves.iter().map(|leaf| self.share(&leaf.low, &leaf.high)).sum::<f64>()
    }

    /// Share of all conditions that lie in a box.
    fn share(&self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> f64 {
        if let Some(speeds) = &self.speeds {
            return speeds.volume(low, high) / speeds.volume(&self.low, &self.high);
        }
        let width = |axis: &Axis, low: f64, high: f64| axis.condition(high) - axis.condition(low);
        let along = |k: usize| width(&self.axes[k], low[k], high[k]) / width(&self.axes[k], self.low[k], self.high[k]);
        (0..self.axes.len()).map(along).product()
    }

    /// The part of a box that holds conditions; `None` if it holds none.
    fn trimmed(&self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> Option<([f64; MAX_AXES], [f64; MAX_AXES])> {
        self.speeds.map_or(Some((*low, *high)), |speeds| speeds.trimmed(low, high))
    }

    /// Every box of the tree that holds conditions, with its index among the branches.
    fn boxes(&self) -> impl Iterator<Item = (usize, [f64; MAX_AXES], [f64; MAX_AXES])> {
        let mut open = vec![(0, self.low, self.high)];
        std::iter::from_fn(move || {
            let (slot, low, high): (usize, [f64; MAX_AXES], [f64; MAX_AXES]) = open.pop()?;
            if let Branch::Split { axis, at, below, above } = self.branches[slot] {
                let (mut middle_high, mut middle_low) = (high, low);
                (middle_high[axis], middle_low[axis]) = (at, at);
                let halves = [(above, middle_low, high), (below, low, middle_high)];
                let part = |(slot, low, high)| self.trimmed(&low, &high).map(|(low, high)| (slot, low, high));
                open.extend(halves.into_iter().filter_map(part));
            }
            Some((slot, low, high))
        })
    }

    /// Share of the conditions that is either charted or left to dense solves for good.
    fn settled_share(&self) -> f64 {
        let pending = self.boxes().filter(|(slot, ..)| matches!(self.branches[*slot], Branch::Pending));
        1.0 - pending.map(|(_, low, high)| self.share(&low, &high)).sum::<f64>()
    }

    /// A chart of a single leaf, used to check it.
    fn with_only(&self, leaf: &Leaf) -> Self {
        Self {
            axes: self.axes.clone(),
            low: leaf.low,
            high: leaf.high,
            speeds: self.speeds,
            basis: self.basis.clone(),
            branches: vec![Branch::Leaf(0)],
            leaves: vec![leaf.clone()],
            undamped: self.undamped,
            solves: 0,
            totals: None,
        }
    }

    /// The chart without one of the roots of each leaf.
    #[cfg(test)]
    pub(super) fn without_a_root(&self) -> Self {
        let mut lost = self.clone();
        lost.leaves.iter_mut().for_each(|leaf| drop(leaf.clusters.pop()));
        lost
    }

    /// Whether no box is pending; otherwise a build can be resumed from this chart.
    pub fn is_complete(&self) -> bool {
        !self.branches.iter().any(|branch| matches!(branch, Branch::Pending))
    }

    /// Appends the charted roots at `p` to `out`, in no particular order, with bounds of their residuals and, where
    /// charted, pad participations. The roots are checked against `known`, the exact sums and norms at `p` (see
    /// [`Traces`](super::Traces)); with a contact state, against the chart's own expansions of these. The returned census counts the roots that numbering needs. A chart gives no
    /// identities: [`StabilityMap`](super::StabilityMap) does.
    ///
    /// # Errors
    /// [`NotCharted`]; `out` is unchanged then.
    pub fn evaluate(
        &self,
        p: &OperatingPoint,
        known: Exact,
        scratch: &mut Scratch,
        out: &mut Vec<Root>,
    ) -> Result<Census, NotCharted> {
        self.evaluate_at(&self.coordinates(p)?, known, scratch, out)
    }

    /// Does the same as [`Self::evaluate`] at coordinates in the box.
    fn evaluate_at(
        &self,
        x: &[f64; MAX_AXES],
        known: Exact,
        scratch: &mut Scratch,
        out: &mut Vec<Root>,
    ) -> Result<Census, NotCharted> {
        let leaf = self.expand(x, scratch)?;
        let known = match &self.totals {
            Some(totals) => totals.at(x)?,
            None => known,
        };
        leaf.auxiliary.evaluate(&self.basis, &scratch.basis, &mut scratch.auxiliary);
        let (values, auxiliary) = (&scratch.functions, &scratch.auxiliary);
        let before = out.len();
        let mut found = [0.0; 2];
        let mut limit = [0.0; 2];
        let mut roots = [(c64::ZERO, 0.0); MAX_SIZE];
        for cluster in &leaf.clusters {
            let size = cluster.size();
            let functions = self.functions(cluster, values);
            cluster::roots(&functions[..size], &cluster.errors, &mut roots);
            let gap = if size == 2 { magnitude(roots[0].0 - roots[1].0) } else { f64::INFINITY };
            for &(z, error) in &roots[..size] {
                let mut root = self.charted(z, error, size <= 2 && z.im == 0.0 && 2.0 * error < gap);
                root.residual = root.residual_bound(known.norms);
                root.pad_participation = cluster.share.map_or(f64::NAN, |share| auxiliary[share].clamp(0.0, 1.0));
                let weight = if self.undamped { 1.0 } else { 2.0 };
                found[0] += weight * z.re;
                found[1] += weight * (z * z).re;
                limit[0] += weight * error;
                limit[1] += weight * 2.0 * magnitude(z) * error;
                out.push(root);
            }
        }
        for moment in 0..2 {
            let rest = auxiliary[moment];
            let difference = (found[moment] + rest - known.powers[moment]).abs();
            let limit = limit[moment] + leaf.remainder_errors[moment] + known.errors[moment];
            if difference.is_nan() || difference > limit {
                out.truncate(before);
                return Err(NotCharted::Incomplete { difference, limit });
            }
        }
        let statics = if self.undamped { out[before..].iter().filter(|root| !root.oscillates()).count() } else { 0 };
        Ok(Census { undamped: self.undamped, tracked: leaf.tracked, statics })
    }

    /// Whether `p` lies in a leaf.
    pub fn covers(&self, p: &OperatingPoint) -> bool {
        self.coordinates(p).is_ok_and(|x| tree::find(&self.branches, &x).is_some())
    }

    /// Coordinates of `p` in the box of the chart.
    fn coordinates(&self, p: &OperatingPoint) -> Result<[f64; MAX_AXES], NotCharted> {
        let mut x = [0.0; MAX_AXES];
        for (k, axis) in self.axes.iter().enumerate() {
            x[k] = axis.coordinate(p);
            // The negated form treats NaN as outside.
            if !(x[k] >= self.low[k] && x[k] <= self.high[k]) {
                return Err(NotCharted::Outside);
            }
        }
        if self.speeds.is_some_and(|speeds| !speeds.hold(p)) {
            return Err(NotCharted::Outside);
        }
        Ok(x)
    }

    /// Appends the values of the charted roots at `p` to `out`, in no particular order: `λ²` of an undamped model,
    /// `λ` of a damped one. Bounds and the check against the traces are omitted.
    ///
    /// # Errors
    /// [`NotCharted`]; `out` is unchanged then.
    pub fn values(&self, p: &OperatingPoint, scratch: &mut Scratch, out: &mut Vec<c64>) -> Result<(), NotCharted> {
        let leaf = self.expand(&self.coordinates(p)?, scratch)?;
        for cluster in &leaf.clusters {
            let size = cluster.size();
            let functions = self.functions(cluster, &scratch.functions);
            if size == 1 {
                out.push(functions[0]);
            } else {
                out.extend(cluster::offsets(&functions[..size])[..size].iter().map(|w| functions[0] + w));
            }
        }
        Ok(())
    }

    /// The symmetric functions of a cluster, read from the channels of its leaf.
    fn functions(&self, cluster: &Cluster, channels: &[f64]) -> [c64; MAX_SIZE] {
        let mut functions = [c64::ZERO; MAX_SIZE];
        for (m, function) in functions[..cluster.size()].iter_mut().enumerate() {
            *function = if self.undamped {
                c64::new(channels[cluster.channel + m], 0.0)
            } else {
                c64::new(channels[cluster.channel + 2 * m], channels[cluster.channel + 2 * m + 1])
            };
        }
        functions
    }

    /// The leaf that contains the coordinates `x`. `scratch` then holds the basis polynomials and the symmetric functions there.
    fn expand(&self, x: &[f64; MAX_AXES], scratch: &mut Scratch) -> Result<&Leaf, NotCharted> {
        let leaf = &self.leaves[tree::find(&self.branches, x).ok_or(NotCharted::NotConverged)?];
        let mut unit = [0.0; MAX_AXES];
        for (k, unit) in unit[..self.axes.len()].iter_mut().enumerate() {
            *unit = 2.0 * (x[k] - leaf.low[k]) / (leaf.high[k] - leaf.low[k]) - 1.0;
        }
        self.basis.values(&unit, &mut scratch.basis);
        leaf.functions.evaluate(&self.basis, &scratch.basis, &mut scratch.functions);
        Ok(leaf)
    }

    /// The root for a charted value `z`. `apart` states that an undamped `z` is real, not one of a complex conjugate
    /// pair.
    fn charted(&self, z: c64, error: f64, apart: bool) -> Root {
        let (lambda, square, error) = if self.undamped {
            let lambda = square_root(z);
            (lambda, z, RootError::from_square(lambda, error, apart))
        } else {
            (z, z * z, RootError::from_lambda(z, error))
        };
        Root { lambda, square, residual: f64::NAN, pad_participation: f64::NAN, error }
    }
}
