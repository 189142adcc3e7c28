//! Stability maps, ends of windows and sensitivities, computed beside the hot path on a thread of their own.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Sender, bounded};
use sha2::{Digest, Sha256};

use super::Incoming;
use super::sensitivity::{self, Question};
use crate::hex::hex;
use crate::io::chart_file::ChartFile;
use crate::physics::chart::build::{ChartOptions, build, resume};
use crate::physics::{Chart, Ends, OperatingPoint, Solver, StabilityMap};
use crate::rig::Rig;
use crate::session::{chart_options, map_options};

/// A chart on the way is kept this often.
const SAVE_EVERY: Duration = Duration::from_secs(20);

/// The map a session uses at the load and speed of `point`.
///
/// # Errors
/// Why there is none, in words.
pub fn session_map(rig: &Rig, solver: &mut Solver, point: &OperatingPoint) -> Result<StabilityMap, String> {
    StabilityMap::build(&rig.model, solver, point, &map_options(rig)).map_err(|error| error.to_string())
}

/// The ends of the windows of `map` a session uses at the load and speed of `point`; `None` where another map is due.
///
/// # Errors
/// Why there are none, in words.
pub fn session_ends(
    rig: &Rig,
    solver: &mut Solver,
    map: &StabilityMap,
    point: &OperatingPoint,
) -> Result<Option<Ends>, String> {
    Ends::carried(&rig.model, solver, map, point).map_err(|error| error.to_string())
}

/// The chart a session uses, the same whatever the number of threads; `go_on` stops the work by saying no.
///
/// # Errors
/// Why there is none, in words.
pub fn session_chart(rig: &Rig, threads: usize, go_on: &dyn Fn() -> bool) -> Result<Chart, String> {
    let options = ChartOptions { threads, ..chart_options(rig) };
    build(&rig.model, &options, &|_| go_on()).map_err(|error| error.to_string())
}

/// The chart a session uses, from where it is `kept`, or built on from what is; `go_on` stops the work by saying no.
///
/// # Errors
/// Why there is none, in words.
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

/// SHA-256 of every number of a map that a prediction can depend on, hexadecimal.
pub fn map_hash(map: &StabilityMap) -> String {
    hash(map.words().into_iter())
}

/// SHA-256 of every number of ends that a prediction can depend on, hexadecimal.
pub fn ends_hash(ends: &Ends) -> String {
    hash(ends.words())
}

/// SHA-256 of every number of a chart that a prediction can depend on, hexadecimal.
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

/// Gives the calling thread the lowest priority. Where the system does not allow it, it competes like any thread.
pub fn yield_to_predictions() {
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
}

/// Builds the chart on a thread of its own, of the lowest priority: predictions come first. It ends early when nobody
/// listens any more; with `kept` it is built only once.
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

/// Nicer than predictions by this much: what is computed beside them gives way.
const NICENESS: i32 = 10;

/// Something to compute.
#[derive(Clone, Debug)]
enum Work {
    Map(OperatingPoint),
    Ends { map: Arc<StabilityMap>, point: OperatingPoint },
    Sensitivity { question: Question, map: Option<Arc<StabilityMap>>, ends: Option<Ends> },
}

/// Computes one thing at a time: maps before ends before sensitivities, of each the newest that was asked for.
pub struct Mapper {
    work: Sender<Work>,
    pending: bool,
    next_map: Option<OperatingPoint>,
    next_ends: Option<(Arc<StabilityMap>, OperatingPoint)>,
    given_up: Option<OperatingPoint>,
}

impl Mapper {
    /// Starts the thread; it ends when the mapper is gone.
    pub fn spawn(rig: Arc<Rig>, done: Sender<Incoming>) -> Self {
        let (work, requests) = bounded::<Work>(1);
        std::thread::spawn(move || {
            // Where the system does not allow it, it competes like any thread.
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

    /// Asks for the map at the load and speed of `point`; while something is being computed, for the newest wish after
    /// it.
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

    /// Asks for the ends of the windows of `map` at the load and speed of `point`.
    pub fn want_ends(&mut self, map: Arc<StabilityMap>, point: OperatingPoint) {
        if self.pending {
            self.next_ends = Some((map, point));
        } else {
            self.start(Work::Ends { map, point });
        }
    }

    /// Asks for sensitivities, unless something is being computed: there is always another prediction to ask about.
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

    /// What was asked for is there, or cannot be had. Starts on the wish that came meanwhile, unless `served` says that
    /// the newest map serves it.
    pub fn done(&mut self, served: impl Fn(&OperatingPoint) -> bool) {
        self.pending = false;
        if let Some(point) = self.next_map.take().filter(|point| !served(point)) {
            self.want(point);
        }
        if let Some((map, point)) = self.next_ends.take() {
            self.want_ends(map, point);
        }
    }

    /// No map can be had there: it is not asked for again until another was.
    pub fn give_up_on(&mut self, point: OperatingPoint) {
        self.given_up = Some(point);
    }

    /// Whether something is being computed.
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
