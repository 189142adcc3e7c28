//! Building a chart: solve at points of a box, follow the roots, cluster what is not analytic alone, split what does
//! not converge.
//!
//! A box that fails hands its points down to its halves, so that nearly every solve serves a leaf. What is split off
//! much smaller than the box that work began with waits, without its points; the box that holds the most conditions is
//! next. So most conditions are charted early and the hard corners last, and a build that was interrupted goes on from
//! its last such unit of work to the same chart.

use faer::{Mat, c64};

use super::chebyshev::{Basis, Fit, Fitted};
use super::cluster::{MAX_SIZE, symmetric_functions, symmetric_slopes};
use super::hold_out::within_bounds;
use super::samples::{Sample, Sampler, follow, spread};
use super::{Axis, Branch, Chart, Cluster, Leaf, MAX_AXES, Scratch};
use crate::physics::model::{Model, Traces};
use crate::physics::operating_point::OperatingPoint;
use crate::physics::spectrum::{SolveError, Solver, Spectrum};
use crate::physics::stability_map::{MapOptions, StabilityMap};
use crate::physics::tracking::tracked;

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
    /// Boxes that hold a smaller share of the conditions are not charted.
    pub smallest_share: f64,
    /// Dense solves after which what is left stays without a chart.
    pub max_solves: usize,
    /// Threads that solve.
    pub threads: usize,
}

/// Why there is no chart.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChartError {
    #[error("{what} from {low} to {high}: expected a finite range{limit}")]
    Range { what: &'static str, low: f64, high: f64, limit: &'static str },
    #[error(transparent)]
    Solve(#[from] SolveError),
    #[error("stopped")]
    Stopped,
}

/// Bounds are this many times what was estimated or seen.
const SAFETY: f64 = 4.0;
/// Error of a charted share of the pad; where it is not reached the share is NaN.
pub const SHARE_TOLERANCE: f64 = 1e-4;
/// Distance of two roots, relative to their size, below which they count as merging.
pub const MERGING: f64 = 1e-4;
/// Points besides those of the fit at which a leaf is checked.
const HELD_OUT: usize = 3;
/// Boxes split off a unit of work that are smaller than it by this factor wait.
const UNIT: f64 = 0.04;

/// How far a build has come.
pub struct Progress<'a> {
    /// What there is by now.
    pub chart: &'a Chart,
    /// Share of the box that is charted or given up.
    pub share: f64,
    /// Whether a unit of work was finished: the chart is as good as any to go on from.
    pub unit_finished: bool,
}

/// Builds a chart of `model`.
///
/// `go_on` is told the share of the box that is done, and stops the work by saying no.
///
/// # Errors
/// [`ChartError`].
pub fn build(model: &Model, options: &ChartOptions, go_on: &dyn Fn(f64) -> bool) -> Result<Chart, ChartError> {
    resume(model, options, None, &mut |progress| go_on(progress.share))
}

/// Builds a chart of `model`, going on from one of the same model and options that was interrupted: the chart is the same as
/// without the interruption.
///
/// `go_on` is told how far it has come, and stops the work by saying no.
///
/// # Errors
/// [`ChartError`].
pub fn resume(
    model: &Model,
    options: &ChartOptions,
    begun: Option<Chart>,
    go_on: &mut dyn FnMut(&Progress<'_>) -> bool,
) -> Result<Chart, ChartError> {
    let (axes, low, high) = domain(model, options)?;
    let sampler = Sampler { model, traces: Traces::new(model), axes: axes.clone(), low, high, base: options.low };
    let mut solvers: Vec<Solver> = (0..options.threads.max(1)).map(|_| Solver::new(model.dimension())).collect();
    let chart = match begun {
        Some(chart) => chart,
        None => {
            let middle = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
            let undamped = sampler.solve(&mut solvers[0], &middle)?.spectrum.undamped;
            let basis = Basis::for_axes(axes.len());
            Chart { axes, low, high, basis, branches: vec![Branch::Pending], leaves: vec![], undamped, solves: 1 }
        }
    };
    let mut builder = Builder { options, sampler, solvers, chart };
    while let Some(unit) = builder.largest_pending() {
        if builder.chart.solves >= options.max_solves || unit.share < options.smallest_share {
            builder.give_up();
            break;
        }
        builder.unit(unit, go_on)?;
    }
    Ok(builder.chart)
}

/// One end of a box on every axis.
type Corner = [f64; MAX_AXES];

/// The axes that matter for `model`, and the box in their coordinates.
fn domain(model: &Model, options: &ChartOptions) -> Result<(Vec<Axis>, Corner, Corner), ChartError> {
    let (load, speed) = model.depends_on_load_and_speed();
    let mut axes = vec![Axis::Friction];
    if model.depends_on_load_over_speed_only() {
        axes.push(Axis::LoadOverSpeed);
    } else {
        axes.extend(load.then_some(Axis::Load));
        axes.extend(speed.then_some(Axis::Speed));
    }
    let (mut low, mut high) = ([0.0; MAX_AXES], [0.0; MAX_AXES]);
    for (k, axis) in axes.iter().enumerate() {
        let corner = |load: &OperatingPoint, speed: &OperatingPoint| {
            axis.coordinate(&OperatingPoint { disc_speed_rad_s: speed.disc_speed_rad_s, ..*load })
        };
        (low[k], high[k]) = match axis {
            Axis::LoadOverSpeed => (corner(&options.low, &options.high), corner(&options.high, &options.low)),
            _ => (corner(&options.low, &options.low), corner(&options.high, &options.high)),
        };
        if !(low[k].is_finite() && high[k].is_finite() && low[k] < high[k]) {
            let (what, limit) = match axis {
                Axis::Friction => ("friction coefficient", ""),
                Axis::Load => ("normal load", " above 0"),
                Axis::Speed => ("disc speed", " above 0"),
                Axis::LoadOverSpeed => ("normal load over disc speed", " above 0"),
            };
            return Err(ChartError::Range { what, low: low[k], high: high[k], limit });
        }
    }
    Ok((axes, low, high))
}

/// A box to be charted.
struct Work {
    slot: usize,
    low: [f64; MAX_AXES],
    high: [f64; MAX_AXES],
    /// Share of the conditions that it holds.
    share: f64,
    samples: Vec<Sample>,
}

enum Outcome {
    Converged(Leaf),
    Split(usize),
}

struct Builder<'a> {
    options: &'a ChartOptions,
    sampler: Sampler<'a>,
    solvers: Vec<Solver>,
    chart: Chart,
}

/// The samples of a box, and which of their roots are one.
struct Branches<'a> {
    samples: Vec<&'a Sample>,
    units: Vec<[f64; MAX_AXES]>,
    /// Half the widths of the box.
    half: [f64; MAX_AXES],
    /// `[sample][branch]`.
    roots: Vec<Vec<usize>>,
    ids: Vec<u32>,
    /// Rounding error of a well-conditioned root.
    rounding: f64,
    undamped: bool,
}

impl Branches<'_> {
    fn count(&self) -> usize {
        self.ids.len()
    }

    fn z(&self, sample: usize, branch: usize) -> c64 {
        self.samples[sample].z[self.roots[sample][branch]]
    }

    /// Slopes along the unit coordinates.
    fn slope(&self, sample: usize, branch: usize, axis: usize) -> c64 {
        self.samples[sample].slopes[self.roots[sample][branch]][axis] * self.half[axis]
    }

    fn condition(&self, sample: usize, branch: usize) -> f64 {
        self.samples[sample].conditions[self.roots[sample][branch]]
    }
}

impl Builder<'_> {
    /// The box without an outcome that holds the most conditions.
    fn largest_pending(&self) -> Option<Work> {
        let pending = self.chart.boxes().filter(|(slot, ..)| matches!(self.chart.branches[*slot], Branch::Pending));
        let largest = pending.max_by(|a, b| self.chart.share(&a.1, &a.2).total_cmp(&self.chart.share(&b.1, &b.2)));
        largest.map(|(slot, low, high)| Work { slot, low, high, share: self.chart.share(&low, &high), samples: vec![] })
    }

    fn give_up(&mut self) {
        let open = self.chart.branches.iter_mut().filter(|branch| matches!(branch, Branch::Pending));
        open.for_each(|branch| *branch = Branch::Dense);
    }

    /// Charts a box, and its halves as long as they are not much smaller.
    fn unit(&mut self, unit: Work, go_on: &mut dyn FnMut(&Progress<'_>) -> bool) -> Result<(), ChartError> {
        let smallest = (UNIT * unit.share).max(self.options.smallest_share);
        let mut stack = vec![unit];
        while let Some(mut work) = stack.pop() {
            let unit_finished = stack.is_empty() && work.samples.is_empty();
            let progress = Progress { chart: &self.chart, share: self.chart.settled_share(), unit_finished };
            if !go_on(&progress) {
                return Err(ChartError::Stopped);
            }
            let outcome = self.leaf(&work.low, &work.high, &mut work.samples);
            self.chart.branches[work.slot] = match outcome {
                Outcome::Converged(leaf) => {
                    self.chart.leaves.push(leaf);
                    Branch::Leaf(self.chart.leaves.len() - 1)
                }
                Outcome::Split(axis) => {
                    let Work { low, high, samples, .. } = work;
                    let at = 0.5 * (low[axis] + high[axis]);
                    let slot = self.chart.branches.len();
                    self.chart.branches.extend([Branch::Pending, Branch::Pending]);
                    let (mut middle_high, mut middle_low) = (high, low);
                    (middle_high[axis], middle_low[axis]) = (at, at);
                    let (left, right) = samples.into_iter().partition(|sample| sample.at[axis] < at);
                    for (slot, low, high, samples) in
                        [(slot + 1, middle_low, high, right), (slot, low, middle_high, left)]
                    {
                        let share = self.chart.share(&low, &high);
                        if share >= smallest {
                            stack.push(Work { slot, low, high, share, samples });
                        }
                    }
                    Branch::Split { axis, at, below: slot, above: slot + 1 }
                }
            };
        }
        Ok(())
    }

    /// Tries to chart a box; `samples` gains what was solved.
    fn leaf(&mut self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES], samples: &mut Vec<Sample>) -> Outcome {
        let axes = self.chart.axes.len();
        let share = |k: usize| (high[k] - low[k]) / (self.chart.high[k] - self.chart.low[k]);
        let longest = (0..axes).max_by(|&a, &b| share(a).total_cmp(&share(b))).unwrap_or(0);
        let half: [f64; MAX_AXES] = std::array::from_fn(|k| 0.5 * (high[k] - low[k]));
        let unit_of = |x: &[f64; MAX_AXES]| -> [f64; MAX_AXES] {
            std::array::from_fn(|k| if k < axes { (x[k] - low[k]) / half[k] - 1.0 } else { 0.0 })
        };
        let wanted = points_wanted(&self.chart.basis, axes);
        let taken: Vec<_> = samples.iter().map(|sample| unit_of(&sample.at)).collect();
        let fresh = spread(axes, &taken, wanted.saturating_sub(taken.len()) + HELD_OUT);
        let fresh: Vec<[f64; MAX_AXES]> =
            fresh.iter().map(|unit| std::array::from_fn(|k| low[k] + half[k] * (unit[k] + 1.0))).collect();
        self.chart.solves += fresh.len();
        // Where a solve fails there is nothing to chart; what is around it may converge.
        let Ok(solved) = self.sampler.solve_all(&mut self.solvers, &fresh) else { return Outcome::Split(longest) };
        samples.extend(solved);
        let undamped = self.chart.undamped;
        if samples.iter().any(|s| s.spectrum.undamped != undamped) || may_diverge(samples.iter().map(|s| &s.spectrum)) {
            return Outcome::Split(longest);
        }
        let (fitted, held_out) = samples.split_at(samples.len() - HELD_OUT);
        let units: Vec<_> = fitted.iter().map(|sample| unit_of(&sample.at)).collect();
        let off = |k: usize| units[k].iter().map(|u| u * u).sum::<f64>();
        let start = (0..units.len()).min_by(|&a, &b| off(a).total_cmp(&off(b))).unwrap_or(0);
        let all: Vec<&Sample> = fitted.iter().collect();
        let Some(roots) = follow(&all, &units, start) else { return Outcome::Split(longest) };
        let mut branches = Branches {
            ids: (0..all[start].z.len() as u32).collect(),
            rounding: all.iter().map(|sample| sample.rounding).fold(0.0, f64::max),
            samples: all,
            units,
            half,
            roots,
            undamped,
        };
        let Some(fit) = Fit::new(&self.chart.basis, &branches.units, &vec![true; branches.units.len()]) else {
            return Outcome::Split(longest);
        };
        let settled = match self.cluster(&branches, &fit) {
            Ok(settled) => settled,
            Err(axis) => return Outcome::Split(axis),
        };
        // Identities last: they take solves of their own.
        let Some(ids) = self.identify(&fitted[start].spectrum) else { return Outcome::Split(longest) };
        branches.ids = ids;
        let leaf = match self.assemble(&branches, settled, low, high) {
            Ok(leaf) => leaf,
            Err(axis) => return Outcome::Split(axis),
        };
        if self.check(&leaf, held_out) { Outcome::Converged(leaf) } else { Outcome::Split(longest) }
    }

    /// Identities of the tracked roots of a spectrum, as [`StabilityMap`] gives them at its load and speed.
    fn identify(&mut self, spectrum: &Spectrum) -> Option<Vec<u32>> {
        let mu = spectrum.point.friction_coefficient;
        let options = MapOptions {
            mu_min: mu.min(0.0),
            mu_max: mu.max(0.0),
            band_max_hz: self.options.band_max_hz,
            instability_threshold: 1e-6,
            windows: false,
        };
        let map = StabilityMap::build(self.sampler.model, &mut self.solvers[0], &spectrum.point, &options).ok()?;
        self.chart.solves += map.nodes.len();
        map.identify(spectrum).into_iter().take(tracked(spectrum)).collect()
    }

    /// Clusters the branches of the band until every symmetric function converges; else the axis to split along.
    fn cluster(&self, branches: &Branches<'_>, fit: &Fit) -> Result<Vec<(Vec<usize>, Expansion)>, usize> {
        let omega = |z: c64| if branches.undamped { (-z.re).max(0.0).sqrt() } else { z.im };
        let limit = self.options.band_max_hz.map_or(f64::INFINITY, |hz| hz * std::f64::consts::TAU);
        let in_band = |branch: usize| (0..branches.samples.len()).any(|k| omega(branches.z(k, branch)) <= limit);
        let mut settled: Vec<(Vec<usize>, Expansion)> = vec![];
        let mut open: Vec<Vec<usize>> = (0..branches.count()).filter(|&k| in_band(k)).map(|k| vec![k]).collect();
        while let Some(members) = open.pop() {
            let expansion = self.expand(branches, fit, &members);
            let Some(axis) = expansion.failing else {
                settled.push((members, expansion));
                continue;
            };
            if members.len() >= MAX_SIZE {
                return Err(axis);
            }
            // Whatever comes closest to a member joins, with all it was already clustered with.
            let nearest = (0..branches.count())
                .filter(|k| !members.contains(k))
                .map(|k| (closeness(branches, &members, k), k))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let Some((_, nearest)) = nearest else { return Err(axis) };
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
        Ok(settled)
    }

    /// The expansions of the symmetric functions of some branches.
    fn expand(&self, branches: &Branches<'_>, fit: &Fit, members: &[usize]) -> Expansion {
        let (axes, size, count) = (self.chart.axes.len(), members.len(), branches.samples.len());
        let parts = if branches.undamped { 1 } else { 2 };
        // An error of λ counts twice in λ².
        let tolerance = self.options.tolerance / parts as f64;
        let mut data = Mat::zeros(count * (1 + axes), size * parts);
        let (mut radius, mut scale, mut stray) = (0.0f64, f64::INFINITY, 0.0f64);
        let mut sound = vec![true; count];
        let mut allowed = vec![f64::INFINITY; size];
        let mut condition = 1.0f64;
        for node in 0..count {
            let z: Vec<c64> = members.iter().map(|&k| branches.z(node, k)).collect();
            let functions = symmetric_functions(&z);
            sound[node] = members.iter().all(|&k| branches.samples[node].is_sound(branches.roots[node][k]));
            scale = scale.min(functions[0].norm());
            radius = z.iter().map(|z| (z - functions[0]).norm()).fold(radius, f64::max);
            if size == 1 {
                condition = condition.max(branches.condition(node, members[0]));
            }
            allow(&z, functions[0], tolerance, &mut allowed);
            for (k, function) in functions.iter().enumerate() {
                data[(node * (1 + axes), k * parts)] = function.re;
                if parts == 2 {
                    data[(node * (1 + axes), k * parts + 1)] = function.im;
                } else {
                    stray = stray.max(function.im.abs() / function.norm().max(f64::MIN_POSITIVE));
                }
            }
            for axis in 0..axes {
                let dz: Vec<c64> = members.iter().map(|&k| branches.slope(node, k, axis)).collect();
                for (k, slope) in symmetric_slopes(&z, &dz).into_iter().enumerate() {
                    data[(node * (1 + axes) + 1 + axis, k * parts)] = slope.re;
                    if parts == 2 {
                        data[(node * (1 + axes) + 1 + axis, k * parts + 1)] = slope.im;
                    }
                }
            }
        }
        let mut expansion = Expansion { channels: vec![], errors: vec![0.0; size], degree: 0, failing: Some(0) };
        // A cluster that is not closed under conjugation lacks its mirror image.
        if stray > 1e-6 {
            return expansion;
        }
        let fitted = if sound.iter().all(|&sound| sound) {
            fit.expand(data)
        } else {
            match Fit::new(&self.chart.basis, &branches.units, &sound) {
                Some(fit) => fit.expand(data),
                None => return expansion,
            }
        };
        let mut failing: Option<(f64, usize)> = None;
        for k in 0..size {
            let floor = branches.rounding * size as f64 * condition * radius.max(branches.rounding).powi(k as i32);
            for fitted in &fitted[k * parts..(k + 1) * parts] {
                let missing = SAFETY * fitted.missing;
                expansion.errors[k] += missing + floor;
                let excess = missing / (allowed[k] / parts as f64 + 8.0 * floor);
                if excess.is_nan() || excess > 1.0 && failing.is_none_or(|(worst, _)| excess > worst) {
                    failing = Some((excess, fitted.worst_axis));
                }
            }
        }
        expansion.channels = fitted.into_iter().map(|fitted| fitted.coefficients).collect();
        // What is not needed is cut off, for all functions of the cluster alike.
        let basis = &self.chart.basis;
        let beyond = |column: usize, degree: usize| basis.beyond(&expansion.channels[column], degree);
        let enough =
            |degree: &usize| (0..size * parts).all(|column| beyond(column, *degree) <= 0.1 * allowed[column / parts]);
        let degree = (0..basis.degree()).find(enough).unwrap_or(basis.degree());
        for column in 0..size * parts {
            expansion.errors[column / parts] += basis.beyond(&expansion.channels[column], degree);
        }
        expansion.degree = degree;
        expansion.failing = failing.map(|(_, axis)| axis);
        expansion
    }

    /// Lays the coefficients out and adds what the charted roots leave of the traces.
    fn assemble(
        &self,
        branches: &Branches<'_>,
        settled: Vec<(Vec<usize>, Expansion)>,
        low: &[f64; MAX_AXES],
        high: &[f64; MAX_AXES],
    ) -> Result<Leaf, usize> {
        let axes = self.chart.axes.len();
        let weight = if branches.undamped { 1.0 } else { 2.0 };
        let mut rest = Mat::zeros(branches.samples.len() * (1 + axes), 2);
        let mut largest = [0.0f64; 2];
        for (node, sample) in branches.samples.iter().enumerate() {
            let row = node * (1 + axes);
            for k in 0..2 {
                largest[k] = largest[k].max(sample.totals[k].abs());
                rest[(row, k)] = sample.totals[k];
                for axis in 0..axes {
                    rest[(row + 1 + axis, k)] = sample.total_slopes[axis][k] * branches.half[axis];
                }
            }
            for &branch in settled.iter().flat_map(|(members, _)| members) {
                let z = branches.z(node, branch);
                rest[(row, 0)] -= weight * z.re;
                rest[(row, 1)] -= weight * (z * z).re;
                for axis in 0..axes {
                    let slope = branches.slope(node, branch, axis);
                    rest[(row + 1 + axis, 0)] -= weight * slope.re;
                    rest[(row + 1 + axis, 1)] -= weight * 2.0 * (z * slope).re;
                }
            }
        }
        let sound: Vec<bool> = (0..branches.samples.len())
            .map(|node| {
                let members = || settled.iter().flat_map(|(members, _)| members);
                members().all(|&k| branches.condition(node, k) < 1e5)
            })
            .collect();
        let Some(fit) = Fit::new(&self.chart.basis, &branches.units, &sound) else { return Err(0) };
        let mut remainders = vec![];
        let mut remainder_errors = [0.0; 2];
        for (k, fitted) in fit.expand(rest).into_iter().enumerate() {
            let floor = 64.0 * f64::EPSILON * largest[k] * self.sampler.model.dimension() as f64;
            remainder_errors[k] = SAFETY * fitted.missing + floor;
            if remainder_errors[k] > 1e-6 * largest[k] + 2.0 * floor {
                return Err(fitted.worst_axis);
            }
            remainders.push(fitted.coefficients);
        }
        let shares = self.shares(branches, &settled);
        let mut blocks = vec![(self.chart.basis.degree(), Part::Remainders, remainders)];
        let mut clusters = vec![];
        for ((members, expansion), share) in settled.into_iter().zip(shares) {
            let mut ids: Vec<u32> = members.iter().map(|&k| branches.ids[k]).collect();
            ids.sort_unstable();
            let ascending = is_ascending(branches, &members);
            let Expansion { channels, errors, degree, .. } = expansion;
            blocks.push((degree, Part::Cluster(clusters.len()), channels));
            blocks.extend(share.map(|(degree, channel)| (degree, Part::Share(clusters.len()), vec![channel])));
            clusters.push(Cluster { ids, channel: 0, errors, share: None, ascending });
        }
        // Channels of high degree first: those that take part in a degree stand together.
        blocks.sort_by_key(|(degree, ..)| std::cmp::Reverse(*degree));
        let (mut remainder, mut columns, mut widths) =
            (0, Vec::<Vec<f64>>::new(), vec![0; self.chart.basis.degree() + 1]);
        for (degree, part, channels) in blocks {
            match part {
                Part::Remainders => remainder = columns.len(),
                Part::Cluster(k) => clusters[k].channel = columns.len(),
                Part::Share(k) => clusters[k].share = Some(columns.len()),
            }
            columns.extend(channels);
            widths[..=degree].iter_mut().for_each(|width| *width = columns.len());
        }
        let mut coefficients = vec![];
        for (degree, &width) in widths.iter().enumerate() {
            let rows = self.chart.basis.of_degree(degree);
            for row in rows {
                coefficients.extend(columns[..width].iter().map(|column: &Vec<f64>| column[row]));
            }
        }
        Ok(Leaf { low: *low, high: *high, clusters, widths, remainder, coefficients, remainder_errors })
    }

    /// Coefficients of the pad's share of every root that is alone, where they converge. Slopes of shares are not known: the
    /// fit is of as low a degree as the points allow.
    fn shares(&self, branches: &Branches<'_>, settled: &[(Vec<usize>, Expansion)]) -> Vec<Option<(usize, Vec<f64>)>> {
        let axes = self.chart.axes.len();
        let points = branches.units.len();
        let degree = (0..=self.chart.basis.degree())
            .take_while(|&degree| 4 * Basis::new(axes, degree).len() <= 3 * points)
            .last()
            .unwrap_or(0);
        let basis = Basis::new(axes, degree);
        let alone: Vec<usize> =
            settled.iter().map(|(members, _)| if members.len() == 1 { members[0] } else { usize::MAX }).collect();
        let Some(fit) = Fit::new(&basis, &branches.units, &vec![false; points]) else {
            return vec![None; settled.len()];
        };
        let share = |node: usize, branch: usize| match alone[branch] {
            usize::MAX => f64::NAN,
            branch => branches.samples[node].spectrum.roots[branches.roots[node][branch]].pad_participation,
        };
        let data = Mat::from_fn(points * (1 + axes), settled.len(), |row, k| {
            if row % (1 + axes) == 0 { share(row / (1 + axes), k) } else { 0.0 }
        });
        // NaN is no share.
        let converged = |fitted: &Fitted| SAFETY * fitted.missing <= SHARE_TOLERANCE;
        fit.expand(data).into_iter().map(|f| converged(&f).then_some((degree, f.coefficients))).collect()
    }

    /// Compares a leaf with dense solves that took no part in its fit; errors seen above a bound refuse it.
    fn check(&self, leaf: &Leaf, held_out: &[Sample]) -> bool {
        let alone = self.chart.with_only(leaf);
        let (mut scratch, mut modes) = (Scratch::default(), vec![]);
        held_out.iter().all(|sample| {
            modes.clear();
            alone.evaluate(&sample.spectrum.point, sample.totals, &mut scratch, &mut modes).is_ok()
                && within_bounds(&modes, &sample.spectrum)
        })
    }
}

/// Points of a fit: a half more data than coefficients.
fn points_wanted(basis: &Basis, axes: usize) -> usize {
    (3 * basis.len()).div_ceil(2 * (1 + axes))
}

/// Lowers `allowed` to the error of each symmetric function of the roots `z` that leaves each of them the asked tolerance; the
/// nearest other root counts as no closer than [`MERGING`].
fn allow(z: &[c64], mean: c64, tolerance: f64, allowed: &mut [f64]) {
    let size = mean.norm();
    allowed[0] = allowed[0].min(if z.len() == 1 { 0.8 } else { 0.4 } * tolerance * size);
    for (i, &root) in z.iter().enumerate() {
        let mut gaps: Vec<f64> = (0..z.len()).filter(|&j| j != i).map(|j| (z[j] - root).norm()).collect();
        gaps.sort_by(f64::total_cmp);
        let near = MERGING * size;
        let product: f64 =
            gaps.iter().enumerate().map(|(rank, &gap)| if rank == 0 { near } else { gap.max(near) }).product();
        let reach = (root - mean).norm().max(near);
        for (m, allowed) in allowed.iter_mut().enumerate().skip(1) {
            let weight = reach.powi((z.len() - 1 - m) as i32) * (2 * z.len() * (z.len() - 1)) as f64;
            *allowed = allowed.min(tolerance * size * product / weight);
        }
    }
}

/// Of a pair: whether the lower identity has the lower frequency where it is apart.
fn is_ascending(branches: &Branches<'_>, members: &[usize]) -> bool {
    let [a, b] = *members else { return true };
    let (lower, upper) = if branches.ids[a] < branches.ids[b] { (a, b) } else { (b, a) };
    let order = |node: usize| {
        let (lower, upper) = (branches.z(node, lower), branches.z(node, upper));
        match (branches.undamped, lower.im == 0.0) {
            (true, true) => (lower.re - upper.re).signum(),
            (true, false) => 0.0,
            (false, _) => (upper.im - lower.im).signum(),
        }
    };
    (0..branches.samples.len()).map(order).sum::<f64>() >= 0.0
}

/// Whether a static root of a damped model, which is not charted, grows at one of the nodes or may grow between them:
/// comes closer to zero than it moves over the box.
fn may_diverge<'a>(spectra: impl Iterator<Item = &'a Spectrum>) -> bool {
    let largest = |s: &Spectrum| s.roots[s.mode_count..].iter().map(|root| root.lambda.re).reduce(f64::max);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for growth in spectra.filter(|s| !s.undamped).filter_map(largest) {
        (low, high) = (low.min(growth), high.max(growth));
    }
    // A free root stays at zero, exactly.
    high > 0.0 || (high > f64::NEG_INFINITY && high != low && high + (high - low) > 0.0)
}

/// How close branch `k` comes to any of `members` or to its mirror image, relative to its size.
fn closeness(branches: &Branches<'_>, members: &[usize], k: usize) -> f64 {
    let gap = |node: usize| {
        let z = branches.z(node, k);
        let member = |&j: &usize| {
            let other = branches.z(node, j);
            (other - z).norm().min((other.conj() - z).norm())
        };
        members.iter().map(member).fold(f64::INFINITY, f64::min) / z.norm()
    };
    (0..branches.samples.len()).map(gap).fold(f64::INFINITY, f64::min)
}

/// What a block of channels is for.
enum Part {
    Remainders,
    Cluster(usize),
    Share(usize),
}

struct Expansion {
    channels: Vec<Vec<f64>>,
    errors: Vec<f64>,
    /// Total degree beyond which coefficients are not needed.
    degree: usize,
    /// The axis along which it does not converge.
    failing: Option<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::chart::hold_out::{HoldOut, hold_out};
    use crate::physics::model::ContactLaw;
    use crate::physics::synthetic::{Synthetic, rig};
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
            smallest_share: 1e-5,
            max_solves: 100_000,
            threads: 2,
        }
    }

    /// Nothing is beyond its bound, no root is missing, and away from merging points errors are at most the tolerance.
    fn held_out(model: &Model, options: &ChartOptions, conditions: usize) -> HoldOut {
        let chart = build(model, options, &|_| true).expect("the chart can be built");
        let found = hold_out(model, options, &chart, conditions, 5).expect("dense solves succeed");
        assert_eq!((found.violations, found.incomplete), (0, 0), "{found:?}");
        assert!(found.largest_error <= 1e-8 && found.largest_mean_error <= 1e-8, "{found:?}");
        found
    }

    #[test]
    fn nine_dof_in_friction() {
        let model = nine_dof(2.0, 2.0, 5.0);
        let found = held_out(&model, &options((0.0, 500.0, 13.0), (2.0, 501.0, 14.0), None), 2000);
        assert!(found.charted > 1990, "{found:?}");
        // Far beyond the first windows the members of a pair are farther from each other than from other modes.
        let found = held_out(&model, &options((0.0, 500.0, 13.0), (20.0, 501.0, 14.0), None), 2000);
        assert!(found.charted > 1990, "{found:?}");
    }

    /// One axis and two, with and without damping.
    #[test]
    fn synthetic_rigs() {
        for (modes, damping_ratio, exponent) in [(20, 0.0, 0.0), (20, 0.0, 0.3), (80, 0.0, 0.0), (12, 2e-3, 0.3)] {
            let contact_law = ContactLaw { exponent, ..Default::default() };
            let model = rig(&Synthetic { modes, pairs: 48, damping_ratio, contact_law, seed: 1 }).unwrap();
            let options = options((0.0, 50.0, 1.0), (1.0, 2000.0, 60.0), Some(5000.0));
            let found = held_out(&model, &options, 300);
            assert!(found.charted > 290, "{modes} modes: {found:?}");
        }
    }

    /// An interrupted build goes on to the same chart, to the last bit.
    #[test]
    fn goes_on_to_the_same_chart() {
        let contact_law = ContactLaw { exponent: 0.3, ..Default::default() };
        let model = rig(&Synthetic { modes: 12, pairs: 12, damping_ratio: 2e-3, contact_law, seed: 2 }).unwrap();
        // A narrow tolerance, so that there is more than one unit of work.
        let options = ChartOptions { tolerance: 1e-10, ..options((0.0, 50.0, 1.0), (1.5, 2000.0, 60.0), Some(5000.0)) };
        let mut units = vec![];
        let whole = resume(&model, &options, None, &mut |progress| {
            units.extend(progress.unit_finished.then(|| progress.chart.clone()));
            true
        });
        let whole = whole.expect("the chart can be built");
        assert!(units.len() > 1 && whole.is_complete(), "{} units", units.len());
        for begun in [units.len() / 2, units.len() - 1].map(|k| units[k].clone()) {
            let begun = Chart::from_words(&begun.words()).expect("words of a chart");
            assert!(!begun.is_complete());
            let resumed = resume(&model, &options, Some(begun), &mut |_| true).expect("the chart can be built");
            assert_eq!(resumed.words(), whole.words());
        }
    }
}
