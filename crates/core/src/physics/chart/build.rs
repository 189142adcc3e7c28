//! Builds a chart: solve at points of a box, follow the roots, cluster the roots that are not analytic on their own,
//! and split boxes that do not converge.
//!
//! When a box is split, its halves inherit its points, so nearly every solve serves a leaf. Work is divided into
//! units, each of which begins with the pending box that holds the most conditions. Boxes that become much smaller
//! than the box the unit began with stay pending and lose their points. Most conditions are therefore charted early
//! and the difficult corners last. An interrupted build resumes after its last finished unit and gives the same
//! chart.

use std::panic::resume_unwind;
use std::sync::{Mutex, PoisonError};

use super::fit::{Basis, Fit};
use super::lateral::{Speeds, in_place_of_speed};
use super::leaf::Branches;
use super::pairing::within_bounds;
use super::samples::{Sample, Sampler, follow, spread};
use super::totals::{Domain, Totals};
use super::{Axis, Branch, Chart, Leaf, MAX_AXES, Scratch};
use crate::physics::model::Model;
use crate::physics::operating_point::OperatingPoint;
use crate::physics::solver::Solver;
use crate::physics::spectrum::{SolveError, Spectrum};
use crate::physics::traces::Traces;

/// Box and accuracy of a chart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChartOptions {
    /// Lower corner of the box of conditions; load and speed positive.
    pub low: OperatingPoint,
    /// Upper corner of the box.
    pub high: OperatingPoint,
    /// Upper limit of the band, Hz. Roots that are above it everywhere on a leaf are charted only as members of a
    /// cluster.
    pub band_max_hz: Option<f64>,
    /// Required relative error of `λ²`, away from merging points.
    pub tolerance: f64,
    /// Boxes with a smaller share of the conditions are not charted.
    pub smallest_share: f64,
    /// Maximum number of dense solves; boxes pending then are not charted.
    pub max_solves: usize,
    /// Number of threads that solve.
    pub threads: usize,
}

/// Why a chart could not be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChartError {
    /// A range of conditions cannot be charted.
    #[error("{what} from {low} to {high}: expected a finite range{limit}")]
    Range {
        /// The condition.
        what: &'static str,
        /// Lower end.
        low: f64,
        /// Upper end.
        high: f64,
        /// What the range must fulfil besides.
        limit: &'static str,
    },
    /// A dense solve failed.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// The caller stopped the build.
    #[error("stopped")]
    Stopped,
}

/// Number of held-out points at which each leaf is checked.
const HELD_OUT: usize = 3;
/// A box split off within a unit of work stays pending if its share is below this fraction of the unit's.
const UNIT: f64 = 0.04;
/// The same with an axis of lateral damping, of whose halves the upper one holds few conditions.
const LATERAL_UNIT: f64 = 0.005;
/// Number of boxes tried concurrently. It is independent of the number of threads because it decides the order of
/// boxes.
const SIDE_BY_SIDE: usize = 4;

/// Progress of a build.
pub struct Progress<'a> {
    /// The chart so far.
    pub chart: &'a Chart,
    /// Share of the conditions that is charted or left to dense solves.
    pub share: f64,
    /// Whether a unit of work has just been finished: the chart can then be resumed from.
    pub unit_finished: bool,
}

/// Builds a chart of `model`.
///
/// `go_on` receives the share of the box that is done; the build stops if it returns false.
///
/// # Errors
/// [`ChartError`].
pub fn build(model: &Model, options: &ChartOptions, go_on: &dyn Fn(f64) -> bool) -> Result<Chart, ChartError> {
    resume(model, options, None, &mut |progress| go_on(progress.share))
}

/// Builds a chart of `model`, resuming from `begun`, an interrupted chart of the same model and options. The result
/// is the same as without the interruption.
///
/// `go_on` receives the progress; the build stops if it returns false.
///
/// # Errors
/// [`ChartError`].
pub fn resume(
    model: &Model,
    options: &ChartOptions,
    begun: Option<Chart>,
    go_on: &mut dyn FnMut(&Progress<'_>) -> bool,
) -> Result<Chart, ChartError> {
    let (mut axes, mut low, mut high) = domain(model, options)?;
    let lateral = speeds_and_model(model, options, &axes);
    let speeds = lateral.as_ref().map(|(speeds, _)| *speeds);
    if let (Some(speeds), Some(last)) = (speeds, axes.len().checked_sub(1)) {
        axes[last] = Axis::LateralDamping;
        [low[last], high[last]] = speeds.range(&options.low, &options.high);
    }
    let model = lateral.as_ref().map_or(model, |(_, model)| model);
    let sampler = Sampler { model, traces: Traces::new(model), axes: axes.clone(), low, high, base: options.low };
    let mut solvers: Vec<Solver> = (0..options.threads.max(1)).map(|_| Solver::new(model.dimension())).collect();
    let chart = match begun {
        Some(chart) => chart,
        None => {
            let middle = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
            let undamped = sampler.solve(&mut solvers[0], &middle)?.spectrum.undamped;
            let basis = Basis::for_axes(axes.len());
            let branches = vec![Branch::Pending];
            let mut chart =
                Chart { axes, low, high, speeds, basis, branches, leaves: vec![], undamped, solves: 1, totals: None };
            if model.statics().is_some() {
                let smallest_share = options.smallest_share;
                let (axes, base) = (&sampler.axes, options.low);
                let domain = Domain { model, axes, low, high, base, smallest_share };
                let mut go_on = || go_on(&Progress { chart: &chart, share: 0.0, unit_finished: false });
                let totals = Totals::build(&domain, &mut go_on).ok_or(ChartError::Stopped)?;
                chart.totals = Some(totals);
            }
            chart
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

/// A corner of a box: one coordinate for each axis.
type Corner = [f64; MAX_AXES];

/// The axes that `model` depends on, and the lower and upper corner of the box in their coordinates.
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
            Axis::Friction | Axis::Load | Axis::Speed | Axis::LateralDamping => {
                (corner(&options.low, &options.low), corner(&options.high, &options.high))
            }
        };
        if !(low[k].is_finite() && high[k].is_finite() && low[k] < high[k]) {
            let (what, limit) = match axis {
                Axis::Friction => ("friction coefficient", ""),
                Axis::Load => ("normal load", " above 0"),
                Axis::Speed | Axis::LateralDamping => ("disc speed", " above 0"),
                Axis::LoadOverSpeed => ("normal load over disc speed", " above 0"),
            };
            return Err(ChartError::Range { what, low: low[k], high: high[k], limit });
        }
    }
    Ok((axes, low, high))
}

/// The speeds of a chart and its model with lateral damping in place of the speed, if an axis of lateral damping replaces that
/// of the speed.
fn speeds_and_model(model: &Model, options: &ChartOptions, axes: &[Axis]) -> Option<(Speeds, Model)> {
    let [low, high] = [options.low, options.high].map(|p| p.disc_speed_rad_s);
    let one_way = low * high > 0.0;
    if axes != [Axis::Friction, Axis::Load, Axis::Speed] || !one_way || options.low.friction_coefficient < 0.0 {
        return None;
    }
    let speeds = Speeds { low: low.abs().min(high.abs()), high: low.abs().max(high.abs()) };
    in_place_of_speed(model).map(|model| (speeds, model))
}

/// A box to be charted.
struct Work {
    slot: usize,
    low: Corner,
    high: Corner,
    /// Share of the conditions that lie in it.
    share: f64,
    samples: Vec<Sample>,
}

impl Work {
    /// Splits the box along an axis: the branch of the split, and the lower and upper half, each trimmed to its conditions
    /// and with the samples that lie in it. The halves become pending in `chart`; one without conditions is left out.
    fn halves(self, axis: usize, chart: &mut Chart) -> (Branch, Vec<Self>) {
        let Self { low, high, samples, .. } = self;
        let at = 0.5 * (low[axis] + high[axis]);
        let slot = chart.branches.len();
        let (mut middle_high, mut middle_low) = (high, low);
        (middle_high[axis], middle_low[axis]) = (at, at);
        let (below, above): (Vec<Sample>, Vec<Sample>) = samples.into_iter().partition(|sample| sample.at[axis] < at);
        let mut halves = vec![];
        for (slot, low, high, mut samples) in [(slot, low, middle_high, below), (slot + 1, middle_low, high, above)] {
            let Some((low, high)) = chart.trimmed(&low, &high) else {
                chart.branches.push(Branch::Dense);
                continue;
            };
            chart.branches.push(Branch::Pending);
            samples.retain(|sample| (0..chart.axes.len()).all(|k| (low[k]..=high[k]).contains(&sample.at[k])));
            halves.push(Self { slot, low, high, share: chart.share(&low, &high), samples });
        }
        (Branch::Split { axis, at, below: slot, above: slot + 1 }, halves)
    }
}

/// Result of trying to chart a box: a leaf, or the axis to split along.
enum Outcome {
    Converged(Leaf),
    Split(usize),
}

/// State of a build.
pub(super) struct Builder<'a> {
    pub options: &'a ChartOptions,
    pub sampler: Sampler<'a>,
    solvers: Vec<Solver>,
    pub chart: Chart,
}

impl Builder<'_> {
    /// The pending box that holds the most conditions.
    fn largest_pending(&self) -> Option<Work> {
        let pending = self.chart.boxes().filter(|(slot, ..)| matches!(self.chart.branches[*slot], Branch::Pending));
        let largest = pending.max_by(|a, b| self.chart.share(&a.1, &a.2).total_cmp(&self.chart.share(&b.1, &b.2)));
        largest.map(|(slot, low, high)| Work { slot, low, high, share: self.chart.share(&low, &high), samples: vec![] })
    }

    /// Leaves all pending boxes to dense solves.
    fn give_up(&mut self) {
        let open = self.chart.branches.iter_mut().filter(|branch| matches!(branch, Branch::Pending));
        open.for_each(|branch| *branch = Branch::Dense);
    }

    /// Charts a box, and recursively its halves until they are much smaller than it.
    fn unit(&mut self, unit: Work, go_on: &mut dyn FnMut(&Progress<'_>) -> bool) -> Result<(), ChartError> {
        let part = if self.chart.speeds.is_some() { LATERAL_UNIT } else { UNIT };
        let smallest = (part * unit.share).max(self.options.smallest_share);
        let mut stack = vec![unit];
        let mut unit_finished = true;
        while !stack.is_empty() {
            if !go_on(&Progress { chart: &self.chart, share: self.chart.settled_share(), unit_finished }) {
                return Err(ChartError::Stopped);
            }
            unit_finished = false;
            let mut boxes = stack.split_off(stack.len().saturating_sub(SIDE_BY_SIDE));
            let outcomes = self.side_by_side(&mut boxes);
            for (work, (outcome, solves)) in boxes.into_iter().zip(outcomes) {
                self.chart.solves += solves;
                let slot = work.slot;
                self.chart.branches[slot] = match outcome {
                    Outcome::Converged(leaf) => {
                        self.chart.leaves.push(leaf);
                        Branch::Leaf(self.chart.leaves.len() - 1)
                    }
                    Outcome::Split(axis) => {
                        let (split, halves) = work.halves(axis, &mut self.chart);
                        stack.extend(halves.into_iter().rev().filter(|half| half.share >= smallest));
                        split
                    }
                };
            }
        }
        Ok(())
    }

    /// Tries to chart some boxes concurrently. Returns the outcome and the number of solves of each.
    fn side_by_side(&mut self, boxes: &mut [Work]) -> Vec<(Outcome, usize)> {
        let mut solvers = std::mem::take(&mut self.solvers);
        let each = solvers.len().div_ceil(boxes.len());
        let (this, queue) = (&*self, &Mutex::new(boxes.iter_mut().enumerate()));
        let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
        let work = |solvers: &mut [Solver]| -> Vec<_> {
            std::iter::from_fn(next)
                .map(|(k, work)| {
                    let mut solves = 0;
                    (k, this.leaf(work, solvers, &mut solves), solves)
                })
                .collect()
        };
        let mut outcomes: Vec<(usize, Outcome, usize)> = std::thread::scope(|scope| {
            let workers: Vec<_> = solvers.chunks_mut(each).map(|solvers| scope.spawn(move || work(solvers))).collect();
            let joined = workers.into_iter().map(|worker| worker.join().unwrap_or_else(|panic| resume_unwind(panic)));
            joined.flatten().collect()
        });
        self.solvers = solvers;
        outcomes.sort_by_key(|(k, ..)| *k);
        outcomes.into_iter().map(|(_, outcome, solves)| (outcome, solves)).collect()
    }

    /// Tries to chart a box. New samples are added to the box, and their number to `solves`.
    fn leaf(&self, work: &mut Work, solvers: &mut [Solver], solves: &mut usize) -> Outcome {
        let Work { low, high, samples, .. } = work;
        let axes = self.chart.axes.len();
        let share = |k: usize| (high[k] - low[k]) / (self.chart.high[k] - self.chart.low[k]);
        let longest = (0..axes).max_by(|&a, &b| share(a).total_cmp(&share(b))).unwrap_or(0);
        if let Some(axis) = self.sampler.pieces().and_then(|pieces| pieces.broken(low, high, longest)) {
            return Outcome::Split(axis);
        }
        let half: [f64; MAX_AXES] = std::array::from_fn(|k| 0.5 * (high[k] - low[k]));
        let unit_of = |x: &[f64; MAX_AXES]| -> [f64; MAX_AXES] {
            std::array::from_fn(|k| if k < axes { (x[k] - low[k]) / half[k] - 1.0 } else { 0.0 })
        };
        let wanted = points_wanted(&self.chart.basis, axes);
        let taken: Vec<_> = samples.iter().map(|sample| unit_of(&sample.at)).collect();
        let fresh = spread(axes, &taken, wanted.saturating_sub(taken.len()) + HELD_OUT);
        let fresh: Vec<[f64; MAX_AXES]> =
            fresh.iter().map(|unit| std::array::from_fn(|k| low[k] + half[k] * (unit[k] + 1.0))).collect();
        *solves += fresh.len();
        // If a solve fails the box cannot be charted, but the half without that point may converge.
        let Ok(solved) = self.sampler.solve_all(solvers, &fresh) else { return Outcome::Split(longest) };
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
        let branches = Branches {
            count: all[start].z.len(),
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
        let leaf = match self.assemble(&branches, settled, low, high) {
            Ok(leaf) => leaf,
            Err(axis) => return Outcome::Split(axis),
        };
        if self.check(&leaf, held_out) { Outcome::Converged(leaf) } else { Outcome::Split(longest) }
    }

    /// Checks a leaf against the solves at its held-out points; fails if an error exceeds its bound.
    fn check(&self, leaf: &Leaf, held_out: &[Sample]) -> bool {
        let alone = self.chart.with_only(leaf);
        let (mut scratch, mut modes) = (Scratch::default(), vec![]);
        held_out.iter().all(|sample| {
            modes.clear();
            alone.evaluate_at(&sample.at, sample.totals, &mut scratch, &mut modes).is_ok()
                && within_bounds(&modes, &sample.spectrum)
        })
    }
}

/// Number of points of a fit: 1.5 times as many data as coefficients.
fn points_wanted(basis: &Basis, axes: usize) -> usize {
    (3 * basis.len()).div_ceil(2 * Basis::orders(axes).len())
}

/// Whether a static root of a damped model, which is not charted, grows at one of the points or may grow between
/// them. It may if its distance from zero is less than its change over the box.
fn may_diverge<'a>(spectra: impl Iterator<Item = &'a Spectrum>) -> bool {
    let largest = |s: &Spectrum| s.roots[s.mode_count..].iter().map(|root| root.lambda.re).reduce(f64::max);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for growth in spectra.filter(|s| !s.undamped).filter_map(largest) {
        (low, high) = (low.min(growth), high.max(growth));
    }
    // A free root stays at exactly zero.
    high > 0.0 || (high > f64::NEG_INFINITY && high != low && high + (high - low) > 0.0)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use faer::Mat;

    use super::*;
    use crate::contact::PressureLaw;
    use crate::physics::chart::NotCharted;
    use crate::physics::law::{ContactLaw, Law};
    use crate::physics::model::Term;
    use crate::physics::spectrum::Vectors;
    use crate::physics::stribeck::Stribeck;
    use crate::physics::test_models::nine_dof;
    use crate::proof::held_out::{HoldOut, hold_out};
    use crate::proof::synthetic::{Synthetic, Uniform, rig, statics, turning_parts};

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

    /// Builds a chart and compares it with dense solves: no error exceeds its bound, no root is missing, and away
    /// from merging points errors are at most the tolerance.
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

    /// One axis and two axes, with and without damping.
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

    /// Three axes down to low speeds, where `μN/ω` moves the roots far and makes some static, whichever way the disc turns. Nearly
    /// all conditions are charted after this number of solves; over the speed instead of `μN/ω`, none.
    #[test]
    fn three_axes_down_to_low_speeds() {
        let contact_law =
            ContactLaw { exponent: 1.0 / 3.0, slope_s_per_m: -0.02, lateral_damping: true, ..Default::default() };
        let model = rig(&Synthetic { modes: 24, pairs: 48, damping_ratio: 5e-3, contact_law, seed: 1 }).unwrap();
        for (from, to) in [(1.0, 60.0), (-60.0, -1.0)] {
            let options =
                ChartOptions { max_solves: 2000, ..options((0.0, 50.0, from), (1.0, 2000.0, to), Some(5000.0)) };
            let found = held_out(&model, &options, 300);
            assert!(found.charted > 290, "{from} to {to} rad/s: {found:?}");
        }
    }

    /// Conditions beyond the speeds are outside a chart over lateral damping, though `μN/ω` is within it.
    #[test]
    fn speeds_beyond_those_of_a_chart_are_outside() {
        let contact_law = ContactLaw { exponent: 0.3, lateral_damping: true, ..Default::default() };
        let model = rig(&Synthetic { modes: 4, pairs: 6, damping_ratio: 5e-3, contact_law, seed: 1 }).unwrap();
        let options = options((0.0, 400.0, 10.0), (0.4, 600.0, 20.0), None);
        let chart = build(&model, &options, &|_| true).expect("the chart can be built");
        let chart = Chart::from_words(&chart.words()).expect("words of a chart");
        let traces = Traces::new(&model);
        let answer = |disc_speed_rad_s: f64| {
            let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s, friction_coefficient: 0.2 };
            chart.evaluate(&p, traces.at(&model, &p), &mut Scratch::default(), &mut vec![]).map(|_| ())
        };
        assert_eq!([10.0, 15.0, 20.0].map(answer), [Ok(()); 3]);
        assert_eq!([9.9, 20.1].map(answer), [Err(NotCharted::Outside); 2]);
    }

    /// Friction that falls with speed: the damping of each of 48 pairs at different radii follows the disc speed. On the
    /// reciprocal of the speed, which is the coordinate of a chart, the slope is a function with every derivative 0 at
    /// infinite speed.
    #[test]
    fn falling_friction_over_speed() {
        for (exponent, low, high) in
            [(2.0, (0.0, 500.0, 1.0), (0.8, 501.0, 60.0)), (1.0, (0.0, 300.0, 5.0), (0.5, 600.0, 20.0))]
        {
            let stribeck = Some(Stribeck { drop: 0.02, speed_m_s: 0.5, exponent });
            let contact_law = ContactLaw { stribeck, ..Default::default() };
            let model = rig(&Synthetic { modes: 12, pairs: 48, damping_ratio: 5e-3, contact_law, seed: 1 }).unwrap();
            let found = held_out(&model, &options(low, high, Some(5000.0)), 600);
            assert!(found.charted > 580, "exponent {exponent}: {found:?}");
        }
    }

    /// Static divergence. An undamped root is charted through `λ² = 0`. Static roots of a damped model are not
    /// charted, and where one grows the chart gives no roots.
    #[test]
    fn static_roots() {
        for damping in [0.0, 0.02] {
            let mut uniform = Uniform::new(8);
            let mut random = Mat::from_fn(6, 6, |_, _| 0.1 * uniform.draw());
            random[(0, 0)] = -1.5;
            let term = |matrix, law| Term { matrix, law };
            let free = Mat::from_fn(6, 6, |i, j| if i == j { 1.0 + 1.3 * i as f64 } else { 0.0 });
            let stiffness = vec![term(free, Law::Constant), term(random, Law::FrictionStiffness)];
            let damping_term = term(Mat::<f64>::identity(6, 6) * faer::Scale(damping), Law::Constant);
            let model = Model::new(6, stiffness, vec![damping_term], ContactLaw::default(), None).unwrap();
            let options = options((0.0, 500.0, 13.0), (1.5, 501.0, 14.0), None);
            let chart = build(&model, &options, &|_| true).expect("the chart can be built");
            let (traces, mut solver) = (Traces::new(&model), Solver::new(6));
            let (mut scratch, mut modes) = (Scratch::default(), vec![]);
            let (mut charted, mut growing) = (0, 0);
            for k in 0..500 {
                let p = options.low.with_friction(0.003 * f64::from(k) + 0.0005);
                modes.clear();
                let dense = solver.solve(&model, &p, Vectors::Both).expect("it solves");
                let grows = dense.nonoscillatory_growth_per_s().first().is_some_and(|&growth| growth > 0.0);
                growing += usize::from(grows);
                if chart.evaluate(&p, traces.at(&model, &p), &mut scratch, &mut modes).is_ok() {
                    charted += 1;
                    let found = modes.iter().any(|root| !root.oscillates() && root.lambda.re > 0.0);
                    assert_eq!(found, grows, "{p:?}, damping {damping}: {modes:?}");
                    assert!(!(grows && damping > 0.0), "{p:?}: charted where a static root grows");
                }
            }
            assert!(
                growing > 100 && charted >= if damping > 0.0 { 200 } else { 490 },
                "{growing} grow, {charted} charted"
            );
        }
    }

    /// A wrong coefficient and a lost root violate the traces: the chart then gives no roots.
    #[test]
    fn the_traces_reveal_a_wrong_coefficient_and_a_lost_root() {
        let model = nine_dof(2.0, 2.0, 5.0);
        let options = options((0.0, 500.0, 13.0), (2.0, 501.0, 14.0), None);
        let chart = build(&model, &options, &|_| true).expect("the chart can be built");
        let (traces, mut scratch) = (Traces::new(&model), Scratch::default());
        let p = options.low.with_friction(0.7);
        let mut evaluate = |chart: &Chart| {
            let mut roots = vec![];
            let answer = chart.evaluate(&p, traces.at(&model, &p), &mut scratch, &mut roots);
            assert!(answer.is_ok() || roots.is_empty(), "nothing of a wrong answer is given");
            answer.map(|_| roots.len())
        };
        assert_eq!(evaluate(&chart), Ok(9));
        let (mut wrong, mut lost) = (chart.clone(), chart.clone());
        for leaf in &mut wrong.leaves {
            // The constant coefficient of the mean of the first cluster.
            leaf.functions.coefficients[leaf.clusters[0].channel] *= 1.0 + 1e-6;
        }
        lost.leaves.iter_mut().for_each(|leaf| drop(leaf.clusters.pop()));
        for chart in [wrong, lost] {
            let Err(NotCharted::Incomplete { difference, limit }) = evaluate(&chart) else { panic!("it is answered") };
            assert!(difference > limit, "{difference:e} {limit:e}");
        }
    }

    /// A static root of a damped model whose distance from zero is less than its change may cross zero between the
    /// points.
    #[test]
    fn a_static_root_may_grow_between_the_points() {
        // `λ² + 3 λ + k = 0`: the slower root is nearly `-k / 3`.
        let term = |value: f64, law| Term { matrix: faer::mat![[value]], law };
        let stiffness = vec![term(1.0, Law::FrictionStiffness)];
        let model = Model::new(1, stiffness, vec![term(3.0, Law::Constant)], ContactLaw::default(), None).unwrap();
        let mut solver = Solver::new(1);
        let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.0 };
        let mut at = |k: f64| solver.solve(&model, &p.with_friction(k), Vectors::Right).expect("it solves");
        let mut may = |values: &[f64]| may_diverge(values.iter().map(|&k| at(k)).collect::<Vec<_>>().iter());
        assert!(!may(&[0.9, 1.0]) && !may(&[1.0, 1.0]), "far from zero");
        assert!(may(&[0.3, 1.0]), "it moved by more than it is away");
        assert!(may(&[1.0, -0.1]), "it grows at one of the points");
    }

    /// The chart is independent of the number of threads.
    #[test]
    fn any_number_of_threads_gives_the_same_chart() {
        let contact_law = ContactLaw { exponent: 0.3, ..Default::default() };
        let model = rig(&Synthetic { modes: 10, pairs: 12, damping_ratio: 0.0, contact_law, seed: 2 }).unwrap();
        let options = options((0.0, 50.0, 1.0), (1.0, 2000.0, 60.0), Some(5000.0));
        let words = |threads: usize| {
            let options = ChartOptions { threads, ..options };
            build(&model, &options, &|_| true).expect("the chart can be built").words()
        };
        let one = words(1);
        for threads in [2, 3, 5, 8] {
            assert!(words(threads) == one, "{threads} threads");
        }
    }

    /// A build resumed after an interruption gives the same chart to the last bit.
    #[test]
    fn goes_on_to_the_same_chart() {
        let contact_law = ContactLaw { exponent: 0.3, ..Default::default() };
        let model = rig(&Synthetic { modes: 12, pairs: 12, damping_ratio: 2e-3, contact_law, seed: 2 }).unwrap();
        // The tolerance is tight so that there is more than one unit of work.
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

    /// The matrix `C` of a disc that turns without damping is skew: its trace vanishes, and so does the sum of all roots.
    /// Such rigs are charted over the speed like damped ones, with springs that are always closed and about a contact state.
    #[test]
    fn a_disc_that_turns_without_damping_is_charted() {
        let synthetic =
            Synthetic { modes: 8, pairs: 6, damping_ratio: 0.0, contact_law: ContactLaw::default(), seed: 1 };
        let parts = turning_parts(&synthetic).unwrap();
        let closed = parts.free.clone().with_contact(&parts.pairs).unwrap();
        let law = PressureLaw::Exponential { pressure: 10.0, roughness_m: 1e-5 };
        let statics = Arc::new(statics(&parts, law, 0.0).unwrap());
        let about_a_state = parts.free.clone().with_steady_contact(&parts.pairs, statics, None).unwrap();
        for (model, axes) in [(closed, 2), (about_a_state, 3)] {
            let options = options((0.0, 400.0, 5.0), (0.4, 600.0, 15.0), None);
            let chart = build(&model, &options, &|_| true).unwrap();
            assert_eq!(chart.axes.len(), axes);
            let found = held_out(&model, &options, 500);
            assert_eq!(found.charted, 500, "{found:?}");
        }
    }
}
