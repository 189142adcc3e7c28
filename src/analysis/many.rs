//! Predictions for any number of given conditions, each as a session makes it, on all processors.
//!
//! Every condition is predicted independently: by a [`Session`] without dead-band and hysteresis, so results depend
//! neither on the order of the conditions nor on the number of threads.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use crossbeam_channel::{Sender, bounded};
use faer::c64;

use super::condition::in_parallel;
use super::{AnalysisError, check, including};
use crate::msgs::{self, level};
use crate::physics::{Chart, ContactState, MapOptions, Mode, OperatingPoint, Solver, StabilityMap};
use crate::rig::Rig;
use crate::session::settings::Settings;
use crate::session::{Event, Session, map_options};

/// Conditions that a thread takes at once.
const BATCH: usize = 1024;

/// At which loads and speeds stability maps give identities, margins and levels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Maps {
    /// At the load and speed of every condition, as far as the rig depends on them: identities and margins are exact.
    Each,
    /// At the rig's reference load and speed, once for each direction of rotation. A session numbers modes by such a map
    /// until it has a newer one. Conditions where its windows do not count have no margin.
    Reference,
}

/// How conditions are predicted.
#[derive(Clone, Copy, Debug)]
pub struct Options<'a> {
    /// The chart of the rig: what it covers is evaluated, all else is solved.
    pub chart: Option<&'a Arc<Chart>>,
    pub maps: Maps,
    /// Whether the modes are returned, or their number and the fastest growing one only.
    pub modes: bool,
    pub threads: usize,
}

/// How a prediction was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Route {
    #[default]
    Solved,
    Charted,
    /// There is none: [`Predictions::faults`] says why.
    Fault,
}

/// Predictions, one for each condition, in the order of the conditions.
#[derive(Clone, Debug, Default)]
pub struct Predictions {
    pub routes: Vec<Route>,
    /// Of [`level`], as in a session without hysteresis.
    pub levels: Vec<u8>,
    pub unstable_modes: Vec<u32>,
    /// The fields of [`msgs::Prediction`]; NaN where it says so, and for faults.
    pub max_growth_rate_per_s: Vec<f64>,
    pub worst_frequency_hz: Vec<f64>,
    pub critical_friction: Vec<f64>,
    pub friction_margin: Vec<f64>,
    pub friction_margin_error: Vec<f64>,
    pub modes: Modes,
    /// Conditions without a prediction, ascending, and why.
    pub faults: Vec<(usize, String)>,
}

/// Modes of the band in ascending frequency: a row of `width` for each condition, filled up with identity -1 and NaN.
#[derive(Clone, Debug, Default)]
pub struct Modes {
    pub width: usize,
    pub id: Vec<i32>,
    /// `λ = σ + iω`, 1/s.
    pub eigenvalue_per_s: Vec<c64>,
    /// The pad's share, 0 to 1; NaN if unknown.
    pub pad_participation: Vec<f64>,
    /// Scaled residual of a solved root; for a charted one, a bound of it.
    pub residual: Vec<f64>,
    /// Bounds of the errors of frequency, rad/s, and growth rate, 1/s.
    pub error_rad_s: Vec<f64>,
    pub error_per_s: Vec<f64>,
}

/// Conditions that share a stability map.
struct Group {
    /// Load and speed of the map; `None` where nothing slides or the condition is refused.
    at: Option<OperatingPoint>,
    options: MapOptions,
    map: OnceLock<Result<Arc<StabilityMap>, String>>,
}

/// A part of the conditions, all of one group: positions in the order of work.
struct Task {
    group: usize,
    positions: Range<usize>,
}

/// The predictions of a task.
struct Block {
    positions: Range<usize>,
    rows: Vec<Row>,
    /// The modes of all rows, one after the other.
    modes: Vec<Mode>,
}

/// The prediction for one condition, without its modes.
struct Row {
    route: Route,
    level: u8,
    unstable_modes: u32,
    /// Growth rate, frequency, critical friction coefficient, margin and its error.
    values: [f64; 5],
    modes: usize,
    fault: Option<String>,
}

/// What all threads work on.
struct Work<'a> {
    rig: Arc<Rig>,
    points: &'a [OperatingPoint],
    order: Vec<usize>,
    groups: Vec<Group>,
    tasks: Vec<Task>,
    next: AtomicUsize,
    options: Options<'a>,
    stopped: &'a AtomicBool,
}

/// Predicts for all `points`. Once `stopped` is set, no further condition is predicted.
///
/// # Errors
/// [`AnalysisError::Stopped`]. A condition that cannot be predicted is no error but a fault.
pub fn predict(
    rig: &Arc<Rig>,
    points: &[OperatingPoint],
    options: Options<'_>,
    stopped: &AtomicBool,
) -> Result<Predictions, AnalysisError> {
    let work = Work::new(rig, points, options, stopped);
    let threads = options.threads.clamp(1, work.tasks.len().max(1));
    let mut predictions = Predictions::of(points.len());
    std::thread::scope(|scope| {
        let (done, blocks) = bounded(2 * threads);
        for _ in 0..threads {
            let (work, done) = (&work, done.clone());
            scope.spawn(move || work.run(&done));
        }
        drop(done);
        for block in blocks {
            predictions.place(&work.order, block, options.modes);
        }
    });
    if stopped.load(Ordering::Relaxed) {
        return Err(AnalysisError::Stopped);
    }
    predictions.faults.sort_by_key(|(index, _)| *index);
    Ok(predictions)
}

/// The smallest friction coefficient up to `mu_max` at which each load and speed of `points` becomes unstable; `None` if
/// none does. Once `stopped` is set, no further map is computed.
///
/// # Errors
/// [`AnalysisError`] of the first of `points` that fails.
pub fn critical_friction(
    rig: &Rig,
    points: &[OperatingPoint],
    mu_max: f64,
    stopped: &AtomicBool,
) -> Result<Vec<Option<f64>>, AnalysisError> {
    let options = MapOptions { mu_max, ..map_options(rig) };
    let one = |point: OperatingPoint, solver: &mut Solver| {
        if stopped.load(Ordering::Relaxed) {
            return Err(AnalysisError::Stopped);
        }
        check(rig, &point)?;
        Ok(StabilityMap::build(&rig.model, solver, &point, &options)?.critical_friction())
    };
    in_parallel(points, rig.model.dimension(), one).into_iter().collect()
}

impl<'a> Work<'a> {
    fn new(rig: &Arc<Rig>, points: &'a [OperatingPoint], options: Options<'a>, stopped: &'a AtomicBool) -> Self {
        let (load, speed) = rig.model.depends_on_load_and_speed();
        let each = options.maps == Maps::Each;
        // 0 without a map, else the direction of rotation, and the load and speed that count.
        let key = |point: &OperatingPoint| {
            if rig.limits.check(point).is_err() || rig.model.contact_state(point) != ContactState::Sliding {
                return (0, 0, 0);
            }
            let counts = |counts: bool, value: f64| if each && counts { value.to_bits() } else { 0 };
            let direction = if point.disc_speed_rad_s < 0.0 { 2 } else { 1 };
            (direction, counts(load, point.normal_load_n), counts(speed, point.disc_speed_rad_s))
        };
        let keys: Vec<_> = points.iter().map(key).collect();
        let mut order: Vec<usize> = (0..points.len()).collect();
        if keys.windows(2).any(|pair| pair[0] != pair[1]) {
            order.sort_by_key(|&index| keys[index]);
        }
        let (mut groups, mut tasks, mut start) = (vec![], vec![], 0);
        for run in order.chunk_by(|&a, &b| keys[a] == keys[b]) {
            let friction = || run.iter().map(|&index| points[index].friction_coefficient);
            let (from, to) = (friction().fold(0.0, f64::min), friction().fold(0.0, f64::max));
            let first = points[run[0]];
            let at = match options.maps {
                Maps::Each => first,
                Maps::Reference => OperatingPoint {
                    disc_speed_rad_s: rig.reference.disc_speed_rad_s.abs().copysign(first.disc_speed_rad_s),
                    ..rig.reference
                },
            };
            let at = (keys[run[0]].0 > 0).then_some(at);
            let group = groups.len();
            groups.push(Group { at, options: including(rig, from, to, true), map: OnceLock::new() });
            tasks.extend(
                (0..run.len())
                    .step_by(BATCH)
                    .map(|part| Task { group, positions: start + part..start + (part + BATCH).min(run.len()) }),
            );
            start += run.len();
        }
        Self { rig: rig.clone(), points, order, groups, tasks, next: AtomicUsize::new(0), options, stopped }
    }

    /// Does tasks until none is left.
    fn run(&self, done: &Sender<Block>) {
        let settings = Settings { squeal_hysteresis: 0.0, ..Settings::for_rig(&self.rig) };
        let mut session = Session::new(self.rig.clone(), settings);
        if let Some(chart) = self.options.chart {
            let _ = session.step(Event::ChartReady(chart.clone())); // only a parameter can be refused
        }
        let mut solver = Solver::new(self.rig.model.dimension());
        let mut in_force = None;
        while let Some(task) = self.tasks.get(self.next.fetch_add(1, Ordering::Relaxed)) {
            let map = self.map(&self.groups[task.group], &mut solver);
            if let Some(Ok(map)) = map
                && in_force != Some(task.group)
            {
                let _ = session.step(Event::MapReady(map.clone()));
                in_force = Some(task.group);
            }
            let fault = map.and_then(|map| map.as_ref().err());
            let Some(block) = self.block(&mut session, task, fault) else { return };
            if done.send(block).is_err() {
                return;
            }
        }
    }

    /// The map of a group, computed by the thread that comes first; `None` where there is none.
    fn map<'g>(&self, group: &'g Group, solver: &mut Solver) -> Option<&'g Result<Arc<StabilityMap>, String>> {
        let at = group.at?;
        Some(group.map.get_or_init(|| {
            let map = StabilityMap::build(&self.rig.model, solver, &at, &group.options);
            map.map(Arc::new).map_err(|error| format!("no stability map: {error}"))
        }))
    }

    /// The predictions of a task, or a `fault` for each of its conditions; `None` once stopped.
    fn block(&self, session: &mut Session, task: &Task, fault: Option<&String>) -> Option<Block> {
        let mut block =
            Block { positions: task.positions.clone(), rows: Vec::with_capacity(task.positions.len()), modes: vec![] };
        let mut route = Route::Solved;
        for &index in &self.order[task.positions.clone()] {
            if self.stopped.load(Ordering::Relaxed) {
                return None;
            }
            if let Some(fault) = fault {
                block.rows.push(Row::fault(fault.clone()));
                continue;
            }
            let before = session.counters();
            let _ = session.step(Event::Input(input(&self.points[index])));
            let after = session.counters();
            let prediction = session.prediction();
            if prediction.level == level::FAULT {
                block.rows.push(Row::fault(prediction.reason.clone()));
                continue;
            }
            // Equal to the one before: its route stays.
            if after.worked() > before.worked() {
                route = if after.charted > before.charted { Route::Charted } else { Route::Solved };
            }
            let modes = if self.options.modes { session.modes() } else { &[] };
            block.modes.extend_from_slice(modes);
            block.rows.push(Row::new(prediction, route, modes.len()));
        }
        Some(block)
    }
}

/// The condition as an input; all have the same stamp.
fn input(point: &OperatingPoint) -> msgs::OperatingPoint {
    msgs::OperatingPoint {
        normal_load_n: point.normal_load_n,
        disc_speed_rad_s: point.disc_speed_rad_s,
        friction_coefficient: point.friction_coefficient,
        ..Default::default()
    }
}

impl Row {
    fn new(prediction: &msgs::Prediction, route: Route, modes: usize) -> Self {
        let values = [
            prediction.max_growth_rate_per_s,
            prediction.worst_frequency_hz,
            prediction.critical_friction,
            prediction.friction_margin,
            prediction.friction_margin_error,
        ];
        let (level, unstable_modes) = (prediction.level, prediction.unstable_modes);
        Self { route, level, unstable_modes, values, modes, fault: None }
    }

    fn fault(reason: String) -> Self {
        let (level, values) = (level::FAULT, [f64::NAN; 5]);
        Self { route: Route::Fault, level, unstable_modes: 0, values, modes: 0, fault: Some(reason) }
    }
}

impl Predictions {
    /// Room for `count` predictions.
    fn of(count: usize) -> Self {
        let unknown = || vec![f64::NAN; count];
        Self {
            routes: vec![Route::default(); count],
            levels: vec![level::OK; count],
            unstable_modes: vec![0; count],
            max_growth_rate_per_s: unknown(),
            worst_frequency_hz: unknown(),
            critical_friction: unknown(),
            friction_margin: unknown(),
            friction_margin_error: unknown(),
            modes: Modes::default(),
            faults: vec![],
        }
    }

    /// Puts the rows of a block where their conditions are.
    fn place(&mut self, order: &[usize], block: Block, modes: bool) {
        if modes {
            self.modes.widen(self.routes.len(), block.rows.iter().map(|row| row.modes).max().unwrap_or(0));
        }
        let mut rest = block.modes.as_slice();
        for (&index, row) in order[block.positions].iter().zip(block.rows) {
            let Row { route, level, unstable_modes, values, modes, fault } = row;
            (self.routes[index], self.levels[index], self.unstable_modes[index]) = (route, level, unstable_modes);
            let columns = [
                &mut self.max_growth_rate_per_s,
                &mut self.worst_frequency_hz,
                &mut self.critical_friction,
                &mut self.friction_margin,
                &mut self.friction_margin_error,
            ];
            columns.into_iter().zip(values).for_each(|(column, value)| column[index] = value);
            self.faults.extend(fault.map(|fault| (index, fault)));
            let (own, others) = rest.split_at(modes);
            self.modes.place(index, own);
            rest = others;
        }
    }
}

impl Modes {
    /// Makes the rows of `count` conditions at least `width` wide.
    fn widen(&mut self, count: usize, width: usize) {
        if width > self.width {
            let before = self.width;
            self.id = widened(&self.id, count, before, width, -1);
            self.eigenvalue_per_s = widened(&self.eigenvalue_per_s, count, before, width, c64::new(f64::NAN, f64::NAN));
            for column in
                [&mut self.pad_participation, &mut self.residual, &mut self.error_rad_s, &mut self.error_per_s]
            {
                *column = widened(column, count, before, width, f64::NAN);
            }
            self.width = width;
        }
    }

    /// Writes the modes of one condition.
    fn place(&mut self, index: usize, modes: &[Mode]) {
        for (at, Mode { id, root }) in (index * self.width..).zip(modes) {
            self.id[at] = i32::try_from(*id).unwrap_or(i32::MAX);
            self.eigenvalue_per_s[at] = root.lambda;
            self.pad_participation[at] = root.pad_participation;
            self.residual[at] = root.residual;
            self.error_rad_s[at] = root.error.omega;
            self.error_per_s[at] = root.error.sigma;
        }
    }
}

/// Rows of `before` values as rows of `width`, filled up with `fill`.
fn widened<T: Copy>(rows: &[T], count: usize, before: usize, width: usize, fill: T) -> Vec<T> {
    let mut wide = vec![fill; count * width];
    if before > 0 {
        wide.chunks_exact_mut(width)
            .zip(rows.chunks_exact(before))
            .for_each(|(to, from)| to[..before].copy_from_slice(from));
    }
    wide
}

#[cfg(test)]
mod tests {
    use super::*;

    fn predicted(rig: &Arc<Rig>, points: &[OperatingPoint], maps: Maps, threads: usize) -> Predictions {
        let options = Options { chart: None, maps, modes: true, threads };
        predict(rig, points, options, &AtomicBool::new(false)).unwrap()
    }

    /// More conditions than a thread takes at once, at two loads, in no order.
    fn points(rig: &Rig) -> Vec<OperatingPoint> {
        let mu = |k: usize| (k * 7919 % 1500) as f64 / 1500.0;
        let load = |k: usize| if k.is_multiple_of(3) { 300.0 } else { rig.reference.normal_load_n };
        (0..1500).map(|k| OperatingPoint { normal_load_n: load(k), ..rig.reference.with_friction(mu(k)) }).collect()
    }

    #[test]
    fn each_prediction_is_that_of_its_condition_alone_on_any_number_of_threads() {
        let rig = Arc::new(Rig::load("rough-pad").unwrap());
        let points = points(&rig);
        let [one, three] = [1, 3].map(|threads| predicted(&rig, &points, Maps::Each, threads));
        assert_eq!(format!("{one:?}"), format!("{three:?}"));
        for (index, point) in points.iter().enumerate().step_by(100) {
            let (alone, _) = crate::analysis::predict(&rig, point).unwrap();
            let row = index * one.modes.width..index * one.modes.width + alone.modes.len();
            let expected: Vec<(i32, c64)> = alone.modes.iter().map(|mode| (mode.id as i32, mode.root.lambda)).collect();
            let found: Vec<(i32, c64)> = row.map(|at| (one.modes.id[at], one.modes.eigenvalue_per_s[at])).collect();
            assert_eq!(found, expected, "{point:?}");
            assert_eq!(one.unstable_modes[index], alone.unstable_modes);
        }
    }

    #[test]
    fn a_condition_out_of_limits_is_a_fault_among_predictions() {
        let rig = Arc::new(Rig::load("nine-dof-case-2").unwrap());
        let mut points: Vec<OperatingPoint> = points(&rig)[..5].to_vec();
        points[3].friction_coefficient = f64::NAN;
        let found = predicted(&rig, &points, Maps::Reference, 2);
        assert_eq!(found.faults, [(3, "friction_coefficient is NaN, expected a finite number".to_owned())]);
        assert_eq!((found.routes[3], found.levels[3]), (Route::Fault, level::FAULT));
        assert!(found.max_growth_rate_per_s[3].is_nan() && found.max_growth_rate_per_s[2].is_finite());
        assert!(found.modes.id[3 * found.modes.width..][..found.modes.width].iter().all(|&id| id == -1));
    }

    #[test]
    fn a_stop_ends_the_work() {
        let rig = Arc::new(Rig::load("nine-dof").unwrap());
        let options = Options { chart: None, maps: Maps::Each, modes: false, threads: 1 };
        let stopped = predict(&rig, &points(&rig), options, &AtomicBool::new(true));
        assert!(matches!(stopped, Err(AnalysisError::Stopped)));
        let stopped = critical_friction(&rig, &points(&rig), 1.0, &AtomicBool::new(true));
        assert!(matches!(stopped, Err(AnalysisError::Stopped)));
    }
}
