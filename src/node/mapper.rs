//! Computes stability maps, window ends and sensitivities on a background thread.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Sender, bounded};
use sha2::{Digest, Sha256};

use super::Incoming;
use super::sensitivity::{self, Question};
use crate::files::chart_file::ChartFile;
use crate::physics::chart::build::{ChartOptions, build, resume};
use crate::physics::{Chart, Ends, OperatingPoint, Solver, StabilityMap};
use crate::rig::Rig;
use crate::session::{chart_options, map_options};
use crate::text::hex::hex;

/// Interval between saves of an unfinished chart.
const SAVE_EVERY: Duration = Duration::from_secs(20);

/// The stability map that a session uses at the load and speed of `point`.
///
/// # Errors
/// Why it cannot be computed, as text.
pub fn session_map(rig: &Rig, solver: &mut Solver, point: &OperatingPoint) -> Result<StabilityMap, String> {
    StabilityMap::build(&rig.model, solver, point, &map_options(rig)).map_err(|error| error.to_string())
}

/// The window ends of `map` that a session uses at the load and speed of `point`; `None` if a new map is needed there.
///
/// # Errors
/// Why they cannot be computed, as text.
pub fn session_ends(
    rig: &Rig,
    solver: &mut Solver,
    map: &StabilityMap,
    point: &OperatingPoint,
) -> Result<Option<Ends>, String> {
    Ends::carried(&rig.model, solver, map, point).map_err(|error| error.to_string())
}

/// The chart that a session uses. It does not depend on the number of threads. The build stops when `go_on` returns
/// false.
///
/// # Errors
/// Why it cannot be built, as text.
pub fn session_chart(rig: &Rig, threads: usize, go_on: &dyn Fn() -> bool) -> Result<Chart, String> {
    let options = ChartOptions { threads, ..chart_options(rig) };
    build(&rig.model, &options, &|_| go_on()).map_err(|error| error.to_string())
}

/// The chart that a session uses, loaded from the file `kept` or continued from an unfinished one there. The build
/// stops when `go_on` returns false.
///
/// # Errors
/// Why it cannot be built, as text.
pub fn kept_chart(rig: &Rig, kept: &ChartFile, threads: usize, go_on: &dyn Fn() -> bool) -> Result<Chart, String> {
    let begun = kept.load().unwrap_or_else(|error| {
        note!("{error}: the rig is charted anew");
        None
    });
    if let Some(chart) = begun.as_ref().filter(|chart| chart.is_complete()) {
        return Ok(chart.clone());
    }
    let mut saved = Instant::now();
    let save = |chart: &Chart| {
        if let Err(error) = kept.save(chart) {
            note!("the chart is not kept: {error}");
        }
    };
    let options = ChartOptions { threads, ..chart_options(rig) };
    let chart = resume(&rig.model, &options, begun, &mut |progress| {
        if progress.unit_finished && saved.elapsed() >= SAVE_EVERY {
            save(progress.chart);
            saved = Instant::now();
        }
        go_on()
    });
    let chart = chart.map_err(|error| error.to_string())?;
    save(&chart);
    Ok(chart)
}

/// SHA-256 of all numbers of a map that can affect predictions, hexadecimal.
pub fn map_hash(map: &StabilityMap) -> String {
    hash(map.words().into_iter())
}

/// SHA-256 of all numbers of window ends that can affect predictions, hexadecimal.
pub fn ends_hash(ends: &Ends) -> String {
    hash(ends.words())
}

/// SHA-256 of all numbers of a chart that can affect predictions, hexadecimal.
pub fn chart_hash(chart: &Chart) -> String {
    hash(chart.words().into_iter())
}

fn hash(words: impl Iterator<Item = u64>) -> String {
    let mut hasher = Sha256::new();
    for word in words {
        hasher.update(word.to_le_bytes());
    }
    hex(&hasher.finalize())
}

/// Gives the calling thread the lowest priority. If the system does not allow it, the priority stays as it is.
pub fn yield_to_predictions() {
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
}

/// Builds the chart on a thread of the lowest priority, so that predictions come first. The build stops early when the
/// node has ended. With `kept` the chart is stored there and reused by later runs.
pub fn spawn_chart(rig: Arc<Rig>, kept: Option<ChartFile>, done: Sender<Incoming>, stopped: Arc<AtomicBool>) {
    std::thread::spawn(move || {
        yield_to_predictions();
        let go_on = || !stopped.load(Ordering::Relaxed);
        let built = catch_unwind(AssertUnwindSafe(|| match &kept {
            Some(kept) => kept_chart(&rig, kept, 1, &go_on),
            None => session_chart(&rig, 1, &go_on),
        }));
        let chart = built.unwrap_or_else(|_| Err("internal error while the rig was charted".to_owned()));
        if go_on() {
            let _ = done.send(Incoming::Chart(chart.map(Arc::new)));
        }
    });
}

/// Niceness of the background thread, relative to the thread that predicts.
const NICENESS: i32 = 10;

/// A task for the background thread.
#[derive(Clone, Debug)]
enum Work {
    Map(OperatingPoint),
    Ends { map: Arc<StabilityMap>, point: OperatingPoint },
    Sensitivity { question: Question, map: Option<Arc<StabilityMap>>, ends: Option<Ends> },
}

/// Runs one task at a time: maps before ends before sensitivities, and of each kind the newest request.
pub struct Mapper {
    work: Sender<Work>,
    pending: bool,
    next_map: Option<OperatingPoint>,
    next_ends: Option<(Arc<StabilityMap>, OperatingPoint)>,
    given_up: Option<OperatingPoint>,
}

impl Mapper {
    /// Starts the thread; it ends when the mapper is dropped.
    pub fn spawn(rig: Arc<Rig>, done: Sender<Incoming>) -> Self {
        let (work, requests) = bounded::<Work>(1);
        std::thread::spawn(move || {
            // If the system does not allow it, the priority stays as it is.
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
            let mut solver = Solver::new(rig.model.dimension());
            for work in requests {
                let computed = catch_unwind(AssertUnwindSafe(|| compute(&rig, &mut solver, &work)));
                let answer = computed.unwrap_or_else(|_| {
                    solver = Solver::new(rig.model.dimension());
                    let reason = "internal error beside the predictions".to_owned();
                    match work {
                        Work::Map(point) => Incoming::Map { point, map: Err(reason) },
                        Work::Ends { map, .. } => Incoming::Ends { map, ends: Err(reason) },
                        Work::Sensitivity { .. } => Incoming::Sensitivity(Box::new(Err(reason))),
                    }
                });
                if done.send(answer).is_err() {
                    return;
                }
            }
        });
        Self { work, pending: false, next_map: None, next_ends: None, given_up: None }
    }

    /// Requests the map at the load and speed of `point`. While a task runs, only the newest request is kept.
    pub fn want(&mut self, point: OperatingPoint) {
        let same = |other: OperatingPoint| other.with_friction(0.0) == point.with_friction(0.0);
        if self.given_up.is_some_and(same) {
            return;
        }
        if self.pending {
            self.next_map = Some(point);
        } else {
            self.start(Work::Map(point));
        }
    }

    /// Requests the window ends of `map` at the load and speed of `point`.
    pub fn want_ends(&mut self, map: Arc<StabilityMap>, point: OperatingPoint) {
        if self.pending {
            self.next_ends = Some((map, point));
        } else {
            self.start(Work::Ends { map, point });
        }
    }

    /// Requests sensitivities unless a task is running; returns whether it was accepted. Refused requests are not kept,
    /// since the next prediction does as well.
    pub fn want_sensitivity(&mut self, question: Question, map: Option<Arc<StabilityMap>>, ends: Option<Ends>) -> bool {
        if !self.pending {
            self.start(Work::Sensitivity { question, map, ends });
            return true;
        }
        false
    }

    fn start(&mut self, work: Work) {
        self.pending = self.work.try_send(work).is_ok();
    }

    /// Takes note that a task has ended and starts the next request, unless `served` says that the newest map already
    /// serves it.
    pub fn done(&mut self, served: impl Fn(&OperatingPoint) -> bool) {
        self.pending = false;
        if let Some(point) = self.next_map.take().filter(|point| !served(point)) {
            self.want(point);
        }
        if let Some((map, point)) = self.next_ends.take() {
            self.want_ends(map, point);
        }
    }

    /// Takes note that the map at `point` cannot be computed. It is not requested again until another point fails.
    pub fn give_up_on(&mut self, point: OperatingPoint) {
        self.given_up = Some(point);
    }

    /// Whether a task is running.
    pub fn pending(&self) -> bool {
        self.pending
    }
}

fn compute(rig: &Rig, solver: &mut Solver, work: &Work) -> Incoming {
    match work {
        Work::Map(point) => Incoming::Map { point: *point, map: session_map(rig, solver, point).map(Arc::new) },
        Work::Ends { map, point } => {
            let ends = session_ends(rig, solver, map, point);
            let ends = ends.map(|found| found.map(Arc::new).ok_or(*point));
            Incoming::Ends { map: map.clone(), ends }
        }
        Work::Sensitivity { question, map, ends } => {
            Incoming::Sensitivity(Box::new(sensitivity::answer(rig, solver, question, map.as_deref(), ends.as_ref())))
        }
    }
}
