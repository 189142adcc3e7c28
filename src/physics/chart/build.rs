//! Building a chart: solve at the nodes of a box, follow the roots, cluster what is not analytic alone, split what does
//! not converge.

use std::collections::HashMap;

use faer::c64;

use super::cluster::{MAX_SIZE, symmetric_functions};
use super::{Axis, Branch, Chart, Cluster, Leaf, MAX_AXES, NotCharted, Scratch, chebyshev};
use crate::physics::model::{Model, Traces};
use crate::physics::operating_point::OperatingPoint;
use crate::physics::spectrum::{ROUNDING, SolveError, Solver, Spectrum, Vectors};
use crate::physics::stability_map::{MapError, MapOptions, StabilityMap};
use crate::physics::summary::Mode;
use crate::physics::tracking::{continue_roots, tracked};

/// What to chart, and how well.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChartOptions {
    /// One corner of the box of conditions.
    pub low: OperatingPoint,
    /// The opposite corner; speed and load positive.
    pub high: OperatingPoint,
    /// Roots above are not charted one by one, Hz.
    pub band_max_hz: Option<f64>,
    /// Relative error of `λ²` that is asked for, away from merging points.
    pub tolerance: f64,
    /// Boxes are not split further than this many times.
    pub max_depth: usize,
    /// Dense solves after which what is left stays without a chart.
    pub max_solves: usize,
    /// Threads that solve at the nodes.
    pub threads: usize,
}

/// Why there is no chart.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChartError {
    #[error("{what} from {low} to {high}: expected a finite range{limit}")]
    Range { what: &'static str, low: f64, high: f64, limit: &'static str },
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Solve(#[from] SolveError),
    #[error("stopped")]
    Stopped,
}

/// Bounds are this many times what was estimated or seen.
const SAFETY: f64 = 4.0;
/// Error of a charted share of the pad; where it is not reached the share is NaN.
pub const SHARE_TOLERANCE: f64 = 1e-4;
/// Stability maps kept while a chart is built.
const KEPT_MAPS: usize = 16;
/// Points besides the nodes at which a leaf is checked.
const HELD_OUT: usize = 5;

/// Builds a chart of `model`.
///
/// `go_on` is told the share of the box that is done, and stops the work by saying no.
///
/// # Errors
/// [`ChartError`].
pub fn build(model: &Model, options: &ChartOptions, go_on: &dyn Fn(f64) -> bool) -> Result<Chart, ChartError> {
    let (load, speed) = model.depends_on_load_and_speed();
    let mut axes = vec![Axis::Friction];
    axes.extend(load.then_some(Axis::Load));
    axes.extend(speed.then_some(Axis::Speed));
    let (mut low, mut high) = ([0.0; MAX_AXES], [0.0; MAX_AXES]);
    for (k, axis) in axes.iter().enumerate() {
        (low[k], high[k]) = (axis.coordinate(&options.low), axis.coordinate(&options.high));
        if !(low[k].is_finite() && high[k].is_finite() && low[k] < high[k]) {
            let (what, limit) = match axis {
                Axis::Friction => ("friction coefficient", ""),
                Axis::Load => ("normal load", " above 0"),
                Axis::Speed => ("disc speed", " above 0"),
            };
            return Err(ChartError::Range { what, low: low[k], high: high[k], limit });
        }
    }
    let nodes_per_axis = chebyshev::nodes_per_axis(axes.len());
    let mut builder = Builder {
        model,
        options,
        traces: Traces::new(model),
        maps: HashMap::new(),
        solvers: (0..options.threads.max(1)).map(|_| Solver::new(model.dimension())).collect(),
        chart: Chart { axes, low, high, nodes_per_axis, branches: vec![], leaves: vec![], undamped: true, solves: 0 },
    };
    let mut pending = vec![(builder.reserve(), low, high, 0)];
    let mut done = 0.0;
    while let Some((slot, low, high, depth)) = pending.pop() {
        if !go_on(done) {
            return Err(ChartError::Stopped);
        }
        if builder.chart.solves >= options.max_solves {
            break;
        }
        let outcome = builder.leaf(&low, &high)?;
        builder.chart.branches[slot] = match outcome {
            Outcome::Converged(leaf) => {
                done += 0.5f64.powi(depth as i32);
                builder.chart.leaves.push(leaf);
                Branch::Leaf(builder.chart.leaves.len() - 1)
            }
            Outcome::Split(axis) if depth < options.max_depth => {
                let at = 0.5 * (low[axis] + high[axis]);
                let (below, above) = (builder.reserve(), builder.reserve());
                let (mut middle_high, mut middle_low) = (high, low);
                (middle_high[axis], middle_low[axis]) = (at, at);
                pending.push((above, middle_low, high, depth + 1));
                pending.push((below, low, middle_high, depth + 1));
                Branch::Split { axis, at, below, above }
            }
            Outcome::Split(_) => {
                done += 0.5f64.powi(depth as i32);
                Branch::Dense
            }
        };
    }
    Ok(builder.chart)
}

enum Outcome {
    Converged(Leaf),
    Split(usize),
}

struct Builder<'a> {
    model: &'a Model,
    options: &'a ChartOptions,
    traces: Traces,
    /// Stability maps by the bits of load and speed.
    maps: HashMap<(u64, u64), StabilityMap>,
    solvers: Vec<Solver>,
    chart: Chart,
}

/// The roots of a box, by identity: `z[branch][node]`.
struct Branches {
    ids: Vec<u32>,
    z: Vec<Vec<c64>>,
    /// The pad's share, likewise; NaN where pad and disc are not told apart.
    shares: Vec<Vec<f64>>,
    /// Traces less the charted roots are taken from these sums over all roots, per node.
    totals: Vec<[f64; 2]>,
    /// Rounding error of a root, per node: `ROUNDING ε ‖·‖`.
    rounding: f64,
}

impl Builder<'_> {
    fn reserve(&mut self) -> usize {
        self.chart.branches.push(Branch::Dense);
        self.chart.branches.len() - 1
    }

    /// A point of the box by its unit coordinates.
    fn point(&self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES], unit: &[f64]) -> OperatingPoint {
        let mut p = self.options.low;
        for (k, axis) in self.chart.axes.iter().enumerate() {
            axis.place(&mut p, low[k] + 0.5 * (unit[k] + 1.0) * (high[k] - low[k]));
        }
        p
    }

    fn leaf(&mut self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> Result<Outcome, ChartError> {
        let (m, axes) = (self.chart.nodes_per_axis, self.chart.axes.len());
        let unit = chebyshev::nodes(m);
        let count = m.pow(axes as u32);
        let points: Vec<OperatingPoint> = (0..count)
            .map(|index| {
                let at: Vec<f64> = chebyshev::degrees(index, m, axes).map(|k| unit[k]).collect();
                self.point(low, high, &at)
            })
            .collect();
        let longest = (0..axes).max_by(|&a, &b| {
            let share = |k: usize| (high[k] - low[k]) / (self.chart.high[k] - self.chart.low[k]);
            share(a).total_cmp(&share(b))
        });
        let longest = longest.unwrap_or(0);
        // Where a solve fails there is nothing to chart; what is around it may converge.
        let Ok(spectra) = self.solve(&points) else { return Ok(Outcome::Split(longest)) };
        self.chart.undamped = spectra.first().is_none_or(|s| s.undamped);
        if spectra.iter().any(|s| s.undamped != self.chart.undamped) || may_diverge(&spectra) {
            return Ok(Outcome::Split(longest));
        }
        let Some(branches) = self.follow(&spectra, m, axes)? else { return Ok(Outcome::Split(longest)) };
        match self.cluster(&branches, low, high) {
            Ok(leaf) => {
                if self.check(&leaf, low, high)? {
                    Ok(Outcome::Converged(leaf))
                } else {
                    Ok(Outcome::Split(longest))
                }
            }
            Err(axis) => Ok(Outcome::Split(axis)),
        }
    }

    /// Spectra at `points`, spread over the threads.
    fn solve(&mut self, points: &[OperatingPoint]) -> Result<Vec<Spectrum>, SolveError> {
        self.chart.solves += points.len();
        let share = points.len().div_ceil(self.solvers.len());
        let model = self.model;
        std::thread::scope(|scope| {
            let workers: Vec<_> = self
                .solvers
                .iter_mut()
                .zip(points.chunks(share))
                .map(|(solver, points)| {
                    scope.spawn(move || {
                        points.iter().map(|p| solver.solve(model, p, Vectors::Right)).collect::<Result<Vec<_>, _>>()
                    })
                })
                .collect();
            let mut all = Vec::with_capacity(points.len());
            for worker in workers {
                match worker.join() {
                    Ok(spectra) => all.extend(spectra?),
                    Err(panic) => std::panic::resume_unwind(panic),
                }
            }
            Ok(all)
        })
    }

    /// Identities at the middle of the box, carried to every node from the nearest node that has them; `None` where
    /// the number of roots changes within the box.
    fn follow(&mut self, spectra: &[Spectrum], m: usize, axes: usize) -> Result<Option<Branches>, ChartError> {
        let roots = tracked(&spectra[0]);
        if spectra.iter().any(|s| tracked(s) != roots) {
            return Ok(None);
        }
        let start = (m / 2) * (0..axes).map(|k| m.pow(k as u32)).sum::<usize>();
        let Ok(map) = self.map(&spectra[start].point) else { return Ok(None) };
        let mut ids: Vec<Vec<Option<u32>>> = vec![vec![]; spectra.len()];
        ids[start] = map.identify(&spectra[start]);
        let degrees = |index: usize| chebyshev::degrees(index, m, axes).collect::<Vec<_>>();
        let centre = degrees(start);
        let distance = |a: &[usize], b: &[usize]| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).sum::<usize>();
        let mut order: Vec<usize> = (0..spectra.len()).filter(|&k| k != start).collect();
        order.sort_by_key(|&k| distance(&degrees(k), &centre));
        for &k in &order {
            // One step towards the middle, along the axis that is farthest off it.
            let at = degrees(k);
            let axis = (0..axes).max_by_key(|&axis| at[axis].abs_diff(centre[axis])).unwrap_or(0);
            let stride = m.pow(axis as u32);
            let from = if at[axis] > centre[axis] { k - stride } else { k + stride };
            let link = continue_roots(&spectra[from], &spectra[k]);
            ids[k] = (0..spectra[k].roots.len()).map(|j| link.source[j].and_then(|i| ids[from][i])).collect();
        }
        let mut known: Vec<u32> = ids[start].iter().flatten().copied().collect();
        known.sort_unstable();
        let undamped = self.chart.undamped;
        let value = |s: &Spectrum, k: usize| if undamped { s.roots[k].square } else { s.roots[k].lambda };
        let mut z = vec![Vec::with_capacity(spectra.len()); known.len()];
        let mut shares = vec![Vec::with_capacity(spectra.len()); known.len()];
        for (spectrum, ids) in spectra.iter().zip(&ids) {
            for ((branch, shares), &id) in z.iter_mut().zip(&mut shares).zip(&known) {
                let Some(k) = ids.iter().position(|&other| other == Some(id)) else { return Ok(None) };
                branch.push(value(spectrum, k));
                shares.push(spectrum.roots[k].pad_participation);
            }
        }
        let mut rounding: f64 = 0.0;
        let mut totals = Vec::with_capacity(spectra.len());
        for spectrum in spectra {
            totals.push(self.traces.at(self.model, &spectrum.point));
            rounding = rounding.max(ROUNDING * f64::EPSILON * spectrum.matrix_norm);
        }
        Ok(Some(Branches { ids: known, z, shares, totals, rounding }))
    }

    fn map(&mut self, point: &OperatingPoint) -> Result<&StabilityMap, ChartError> {
        let key = (point.normal_load_n.to_bits(), point.disc_speed_rad_s.to_bits());
        if !self.maps.contains_key(&key) {
            // Neighbouring boxes share maps; all of them would fill the memory.
            if self.maps.len() >= KEPT_MAPS {
                self.maps.clear();
            }
            let options = MapOptions {
                mu_min: self.options.low.friction_coefficient.min(0.0),
                mu_max: self.options.high.friction_coefficient.max(0.0),
                band_max_hz: self.options.band_max_hz,
                instability_threshold: 1e-6,
                windows: false,
            };
            let map = StabilityMap::build(self.model, &mut self.solvers[0], point, &options)?;
            self.chart.solves += map.nodes.len();
            self.maps.insert(key, map);
        }
        Ok(&self.maps[&key])
    }

    /// Clusters the branches of the band until every symmetric function converges; else the axis to split along.
    fn cluster(&self, branches: &Branches, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> Result<Leaf, usize> {
        let (m, axes) = (self.chart.nodes_per_axis, self.chart.axes.len());
        let omega = |z: c64| if self.chart.undamped { (-z.re).max(0.0).sqrt() } else { z.im };
        let limit = self.options.band_max_hz.map_or(f64::INFINITY, |hz| hz * std::f64::consts::TAU);
        let in_band = |branch: usize| branches.z[branch].iter().any(|&z| omega(z) <= limit);
        let mut settled: Vec<(Vec<usize>, Expansion)> = vec![];
        let mut open: Vec<Vec<usize>> = (0..branches.ids.len()).filter(|&k| in_band(k)).map(|k| vec![k]).collect();
        while let Some(members) = open.pop() {
            let expansion = self.expand(branches, &members, m, axes);
            let Some(axis) = expansion.failing else {
                settled.push((members, expansion));
                continue;
            };
            if members.len() >= MAX_SIZE {
                return Err(axis);
            }
            // Whatever comes closest to a member joins, with all it was already clustered with.
            let nearest = (0..branches.ids.len()).filter(|k| !members.contains(k)).min_by(|&a, &b| {
                let gap = |k: usize| closeness(branches, &members, k);
                gap(a).total_cmp(&gap(b))
            });
            let Some(nearest) = nearest else { return Err(axis) };
            let mut joined = members;
            let taken = |cluster: &Vec<usize>| cluster.contains(&nearest);
            if let Some(at) = settled.iter().position(|(cluster, _)| taken(cluster)) {
                joined.extend(settled.swap_remove(at).0);
            } else if let Some(at) = open.iter().position(taken) {
                joined.extend(open.swap_remove(at));
            } else {
                joined.push(nearest);
            }
            if joined.len() > MAX_SIZE {
                return Err(axis);
            }
            open.push(joined);
        }
        self.assemble(branches, settled, low, high, m, axes)
    }

    /// The expansions of the symmetric functions of some branches.
    fn expand(&self, branches: &Branches, members: &[usize], m: usize, axes: usize) -> Expansion {
        let count = branches.totals.len();
        let size = members.len();
        let parts = if self.chart.undamped { 1 } else { 2 };
        let mut channels = vec![Vec::with_capacity(count); size * parts];
        let (mut radius, mut scale, mut stray) = (0.0f64, 0.0f64, 0.0f64);
        for node in 0..count {
            let z: Vec<c64> = members.iter().map(|&k| branches.z[k][node]).collect();
            let functions = symmetric_functions(&z);
            scale = scale.max(functions[0].norm());
            radius = z.iter().map(|z| (z - functions[0]).norm()).fold(radius, f64::max);
            for (k, function) in functions.iter().enumerate() {
                channels[k * parts].push(function.re);
                if parts == 2 {
                    channels[k * parts + 1].push(function.im);
                } else {
                    stray = stray.max(function.im.abs() / function.norm().max(f64::MIN_POSITIVE));
                }
            }
        }
        // A cluster that is not closed under conjugation lacks its mirror image.
        if stray > 1e-6 {
            return Expansion { channels, errors: vec![], failing: Some(0), ascending: true };
        }
        let mut errors = vec![0.0; size];
        let mut failing: Option<(f64, usize)> = None;
        for (k, error) in errors.iter_mut().enumerate() {
            // A root of relative tolerance; of a product, what keeps roots of ordinary distance to it.
            let tolerance = self.options.tolerance * scale * if k == 0 { 0.25 } else { 1e-4 * scale.powi(k as i32) };
            let floor = branches.rounding * (size as f64) * radius.max(branches.rounding).powi(k as i32);
            for part in 0..parts {
                let channel = &mut channels[k * parts + part];
                chebyshev::coefficients(channel, m, axes);
                let (tail, axis) = chebyshev::tail(channel, m, axes);
                *error += SAFETY * tail + floor;
                let excess = tail / (tolerance + floor * (m as f64).sqrt());
                if excess > 1.0 && failing.is_none_or(|(worst, _)| excess > worst) {
                    failing = Some((excess, axis));
                }
            }
        }
        let ordered = members.len() == 2
            && (0..count)
                .map(|node| {
                    let (first, second) = (branches.z[members[0]][node], branches.z[members[1]][node]);
                    let first_is_lower = branches.ids[members[0]] < branches.ids[members[1]];
                    let (low, high) = if first_is_lower { (first, second) } else { (second, first) };
                    match (self.chart.undamped, low.im == 0.0) {
                        (true, true) => (low.re - high.re).signum(),
                        (true, false) => 0.0,
                        (false, _) => (high.im - low.im).signum(),
                    }
                })
                .sum::<f64>()
                >= 0.0;
        Expansion { channels, errors, failing: failing.map(|(_, axis)| axis), ascending: ordered }
    }

    /// Lays the coefficients out and adds what the charted roots leave of the traces.
    fn assemble(
        &self,
        branches: &Branches,
        settled: Vec<(Vec<usize>, Expansion)>,
        low: &[f64; MAX_AXES],
        high: &[f64; MAX_AXES],
        m: usize,
        axes: usize,
    ) -> Result<Leaf, usize> {
        let mut rest = branches.totals.clone();
        let weight = if self.chart.undamped { 1.0 } else { 2.0 };
        for (members, _) in &settled {
            for &branch in members {
                for (rest, z) in rest.iter_mut().zip(&branches.z[branch]) {
                    rest[0] -= weight * z.re;
                    rest[1] -= weight * (z * z).re;
                }
            }
        }
        let mut remainders: Vec<Vec<f64>> = (0..2).map(|k| rest.iter().map(|r| r[k]).collect()).collect();
        let mut remainder_errors = [0.0; 2];
        for (k, remainder) in remainders.iter_mut().enumerate() {
            let total = branches.totals.iter().map(|t| t[k].abs()).fold(0.0, f64::max);
            chebyshev::coefficients(remainder, m, axes);
            let (tail, axis) = chebyshev::tail(remainder, m, axes);
            let floor = 64.0 * f64::EPSILON * total * self.model.dimension() as f64;
            if tail > 1e-7 * total + floor {
                return Err(axis);
            }
            remainder_errors[k] = SAFETY * tail + floor;
        }
        let mut clusters = vec![];
        let mut columns: Vec<Vec<f64>> = vec![];
        for (members, expansion) in settled {
            let mut ids: Vec<u32> = members.iter().map(|&k| branches.ids[k]).collect();
            ids.sort_unstable();
            let channel = columns.len();
            let Expansion { channels, errors, ascending, .. } = expansion;
            columns.extend(channels);
            let mut share = None;
            if let [alone] = members.as_slice() {
                let mut shares = branches.shares[*alone].clone();
                chebyshev::coefficients(&mut shares, m, axes);
                // NaN stays NaN and is no share.
                if SAFETY * chebyshev::tail(&shares, m, axes).0 <= SHARE_TOLERANCE {
                    share = Some(columns.len());
                    columns.push(shares);
                }
            }
            clusters.push(Cluster { ids, channel, errors, share, ascending });
        }
        columns.extend(remainders);
        let channels = columns.len();
        let coefficients = (0..channels * branches.totals.len()).map(|k| columns[k % channels][k / channels]).collect();
        Ok(Leaf { low: *low, high: *high, clusters, channels, coefficients, remainder_errors })
    }

    /// Compares a leaf with dense solves at points that are no nodes; errors seen above a bound refuse it.
    fn check(&mut self, leaf: &Leaf, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> Result<bool, ChartError> {
        let axes = self.chart.axes.len();
        let points: Vec<OperatingPoint> = (1..=HELD_OUT)
            .map(|k| {
                // Additive recurrence of the plastic number: spread evenly, repeatable (Roberts 2018).
                let unit: Vec<f64> = (1..=axes)
                    .map(|axis| 2.0 * (0.5 + k as f64 * 0.754_877_666_246_69f64.powi(axis as i32)).fract() - 1.0)
                    .collect();
                self.point(low, high, &unit)
            })
            .collect();
        let Ok(spectra) = self.solve(&points) else { return Ok(false) };
        let mut alone = self.chart.clone_for(leaf);
        let (mut scratch, mut roots) = (Scratch::default(), vec![]);
        for spectrum in &spectra {
            roots.clear();
            let traces = self.traces.at(self.model, &spectrum.point);
            match alone.evaluate(&spectrum.point, traces, &mut scratch, &mut roots) {
                Ok(()) => {}
                Err(NotCharted::Incomplete { .. }) => return Ok(false),
                Err(_) => return Ok(false),
            }
            if !within_bounds(&roots, spectrum, self.chart.undamped) {
                return Ok(false);
            }
        }
        alone.leaves.clear();
        Ok(true)
    }
}

/// Whether a static root of a damped model, which is not charted, grows at one of the nodes or may grow between them:
/// comes closer to zero than it moves over the box.
fn may_diverge(spectra: &[Spectrum]) -> bool {
    let largest = |s: &Spectrum| s.roots[s.mode_count..].iter().map(|root| root.lambda.re).reduce(f64::max);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for growth in spectra.iter().filter(|s| !s.undamped).filter_map(largest) {
        (low, high) = (low.min(growth), high.max(growth));
    }
    // A free root stays at zero, exactly.
    high > 0.0 || (high > f64::NEG_INFINITY && high != low && high + (high - low) > 0.0)
}

/// Whether every charted root has a dense root within its bound, each dense root taken once.
fn within_bounds(modes: &[Mode], spectrum: &Spectrum, undamped: bool) -> bool {
    let rounding = ROUNDING * f64::EPSILON * spectrum.matrix_norm;
    let mut left: Vec<c64> = spectrum.roots[..tracked(spectrum)].iter().map(|r| r.square).collect();
    modes.iter().map(|mode| &mode.root).all(|root| {
        let nearest =
            (0..left.len()).min_by(|&a, &b| (left[a] - root.square).norm().total_cmp(&(left[b] - root.square).norm()));
        let Some(nearest) = nearest else { return false };
        let off = (left.swap_remove(nearest) - root.square).norm();
        let slack = if undamped { rounding } else { 2.0 * root.lambda.norm() * rounding };
        off <= root.error.square + slack
    })
}

/// How close branch `k` comes to any of `members` or to its mirror image, relative to its size.
fn closeness(branches: &Branches, members: &[usize], k: usize) -> f64 {
    let nodes = 0..branches.totals.len();
    let gap = |node: usize| {
        let z = branches.z[k][node];
        let member = |&j: &usize| {
            let other = branches.z[j][node];
            (other - z).norm().min((other.conj() - z).norm())
        };
        let off = members.iter().map(member).fold(f64::INFINITY, f64::min);
        off / z.norm()
    };
    nodes.map(gap).fold(f64::INFINITY, f64::min)
}

struct Expansion {
    channels: Vec<Vec<f64>>,
    errors: Vec<f64>,
    /// The axis along which it does not converge.
    failing: Option<usize>,
    ascending: bool,
}

impl Chart {
    /// A chart of one leaf, to try it.
    fn clone_for(&self, leaf: &Leaf) -> Self {
        Self {
            axes: self.axes.clone(),
            low: leaf.low,
            high: leaf.high,
            nodes_per_axis: self.nodes_per_axis,
            branches: vec![Branch::Leaf(0)],
            leaves: vec![leaf.clone()],
            undamped: self.undamped,
            solves: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::model::ContactLaw;
    use crate::physics::synthetic::{Synthetic, Uniform, rig};
    use crate::physics::test_models::nine_dof;

    fn options(low: (f64, f64, f64), high: (f64, f64, f64), band_max_hz: Option<f64>) -> ChartOptions {
        let point = |(friction_coefficient, normal_load_n, disc_speed_rad_s)| OperatingPoint {
            normal_load_n,
            disc_speed_rad_s,
            friction_coefficient,
        };
        ChartOptions {
            low: point(low),
            high: point(high),
            band_max_hz,
            tolerance: 1e-8,
            max_depth: 40,
            max_solves: 100_000,
            threads: 2,
        }
    }

    /// Every charted root has a dense root within its bound, at random conditions; the 99th percentile of the relative
    /// errors, and how many of the conditions were charted.
    fn hold_out(model: &Model, options: &ChartOptions, points: usize) -> (f64, usize) {
        let chart = build(model, options, &|_| true).expect("the chart can be built");
        let traces = Traces::new(model);
        let mut solver = Solver::new(model.dimension());
        let (mut scratch, mut roots) = (Scratch::default(), vec![]);
        let mut uniform = Uniform::new(5);
        let (mut charted, mut errors) = (0, vec![]);
        for _ in 0..points {
            let mut between = |a: f64, b: f64| a + 0.5 * (uniform.draw() + 1.0) * (b - a);
            let (low, high) = (options.low, options.high);
            let p = OperatingPoint {
                friction_coefficient: between(low.friction_coefficient, high.friction_coefficient),
                normal_load_n: between(low.normal_load_n, high.normal_load_n),
                disc_speed_rad_s: between(low.disc_speed_rad_s, high.disc_speed_rad_s),
            };
            roots.clear();
            let answer = chart.evaluate(&p, traces.at(model, &p), &mut scratch, &mut roots);
            if answer == Err(NotCharted::NotConverged) {
                continue;
            }
            answer.expect("inside the box the chart is complete");
            charted += 1;
            let spectrum = solver.solve(model, &p, Vectors::Right).unwrap();
            assert!(within_bounds(&roots, &spectrum, spectrum.undamped), "a bound is broken at {p:?}");
            for Mode { root, .. } in &roots {
                let off = spectrum.roots.iter().map(|r| (r.square - root.square).norm()).fold(f64::INFINITY, f64::min);
                errors.push(off / root.square.norm());
                let same = spectrum.roots.iter().find(|r| (r.square - root.square).norm() == off);
                let share = same.map_or(f64::NAN, |r| (r.pad_participation - root.pad_participation).abs());
                assert!(share.is_nan() || share <= SHARE_TOLERANCE, "share of the pad off by {share} at {p:?}");
            }
        }
        errors.sort_by(f64::total_cmp);
        (errors[errors.len() * 99 / 100], charted)
    }

    #[test]
    fn nine_dof_in_friction() {
        let model = nine_dof(2.0, 2.0, 5.0);
        let (_, charted) = hold_out(&model, &options((0.0, 500.0, 13.0), (2.0, 501.0, 14.0), None), 2000);
        assert!(charted > 1990);
        // Far beyond the first windows the members of a pair are farther from each other than from other modes.
        let (_, charted) = hold_out(&model, &options((0.0, 500.0, 13.0), (20.0, 501.0, 14.0), None), 2000);
        assert!(charted > 1990);
    }

    /// One axis and two, with and without damping: nothing is beyond its bound, and away from merging points errors
    /// are at most the tolerance asked for.
    #[test]
    fn synthetic_rigs() {
        for (modes, damping_ratio, exponent, tolerance) in
            [(20, 0.0, 0.0, 1e-8), (20, 0.0, 0.3, 1e-8), (80, 0.0, 0.0, 1e-8), (12, 2e-3, 0.3, 1e-8)]
        {
            let contact_law = ContactLaw { exponent, ..Default::default() };
            let model = rig(&Synthetic { modes, pairs: 48, damping_ratio, contact_law, seed: 1 }).unwrap();
            let options = options((0.0, 50.0, 1.0), (1.0, 2000.0, 60.0), Some(5000.0));
            let (median, charted) = hold_out(&model, &options, 300);
            assert!(median < tolerance && charted > 290, "{modes} modes: {median:e}, {charted} charted");
        }
    }
}
