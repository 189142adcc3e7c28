//! Computes stability maps, window ends, sensitivities and rigs at other temperatures on a background thread, and builds the
//! chart on another.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Sender, bounded};

use super::Incoming;
use super::sensitivity::{self, Question};
use crate::files::chart_file::ChartFile;
use crate::physics::chart::build::{ChartOptions, resume};
use crate::physics::{Chart, Ends, OperatingPoint, Solver, StabilityMap};
use crate::rig::Rig;
use crate::session::computed::{Request, compute, session_chart, session_rig};
use crate::session::{Event, chart_options};

/// Interval between saves of an unfinished chart.
const SAVE_EVERY: Duration = Duration::from_secs(20);

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

/// Gives the calling thread the lowest priority. If the system does not allow it, the priority stays as it is.
pub fn yield_to_predictions() {
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
}

/// Builds the chart on a thread of the lowest priority, so that predictions come first. The build stops early once it is
/// `stopped`. With `kept` the chart is stored there and reused by later runs.
fn spawn_chart(rig: Arc<Rig>, kept: Option<ChartFile>, done: Sender<Incoming>, stopped: Arc<AtomicBool>) {
    std::thread::spawn(move || {
        yield_to_predictions();
        let go_on = || !stopped.load(Ordering::Relaxed);
        let built = catch_unwind(AssertUnwindSafe(|| match &kept {
            Some(kept) => kept_chart(&rig, kept, 1, &go_on),
            None => session_chart(&rig, 1, &go_on),
        }));
        let chart = built.unwrap_or_else(|_| Err("internal error while the rig was charted".to_owned()));
        if go_on() {
            let _ = done.send(Incoming::Chart { rig: rig.clone(), chart: chart.map(Arc::new) });
        }
    });
}

/// Niceness of the background thread, relative to the thread that predicts.
const NICENESS: i32 = 10;

/// A task for the background thread.
#[derive(Clone, Debug)]
enum Work {
    /// A request of the session, with the map in force when it was made.
    Request {
        request: Request,
        map: Option<Arc<StabilityMap>>,
    },
    Sensitivity {
        question: Question,
        map: Option<Arc<StabilityMap>>,
        ends: Option<Ends>,
    },
    /// The rig at another temperature, with the map at the load and speed of `point`.
    Rig {
        celsius: f64,
        point: OperatingPoint,
    },
}

/// Runs one task at a time: rigs before maps before ends before sensitivities, and of each kind the newest request.
pub struct Mapper {
    rig: Arc<Rig>,
    work: Sender<(Arc<Rig>, Work)>,
    done: Sender<Incoming>,
    pending: bool,
    next_map: Option<OperatingPoint>,
    next_ends: Option<(Arc<StabilityMap>, OperatingPoint)>,
    given_up: Option<OperatingPoint>,
    /// Stops the build of the chart; `None` if the rig is not charted.
    chart_stopped: Option<Arc<AtomicBool>>,
}

impl Mapper {
    /// Starts the thread; it ends when the mapper is dropped.
    pub fn spawn(rig: Arc<Rig>, done: Sender<Incoming>) -> Self {
        let (work, requests) = bounded::<(Arc<Rig>, Work)>(1);
        let answers = done.clone();
        let mut solver = Solver::new(rig.model.dimension());
        std::thread::spawn(move || {
            // If the system does not allow it, the priority stays as it is.
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
            for (rig, work) in requests {
                if answers.send(answer(&rig, &mut solver, work)).is_err() {
                    return;
                }
            }
        });
        Self { rig, work, done, pending: false, next_map: None, next_ends: None, given_up: None, chart_stopped: None }
    }

    /// Builds the chart of the rig, and of every rig that replaces it. Only the first is stored in the file `kept`.
    pub fn chart(&mut self, kept: Option<ChartFile>) {
        let stopped = Arc::<AtomicBool>::default();
        spawn_chart(self.rig.clone(), kept, self.done.clone(), stopped.clone());
        self.chart_stopped = Some(stopped);
    }

    /// Stops the build of the chart, if one is being built. Returns whether the rig is charted.
    pub fn stop_chart(&mut self) -> bool {
        let stopped = self.chart_stopped.take();
        stopped.inspect(|stopped| stopped.store(true, Ordering::Relaxed)).is_some()
    }

    /// Replaces the rig by the same rig at another temperature. Requests for the former are dropped.
    pub fn take_rig(&mut self, rig: Arc<Rig>) {
        self.rig = rig;
        (self.next_map, self.next_ends, self.given_up) = (None, None, None);
        if self.stop_chart() {
            self.chart(None);
        }
    }

    /// Requests the rig at a temperature, with its map at the load and speed of `point`, unless a task is running.
    pub fn request_rig(&mut self, celsius: f64, point: OperatingPoint) {
        if !self.pending {
            self.start(Work::Rig { celsius, point });
        }
    }

    /// Requests the map at the load and speed of `point`. While a task runs, only the newest request is kept.
    pub fn request_map(&mut self, point: OperatingPoint) {
        let same = |other: OperatingPoint| other.with_friction(0.0) == point.with_friction(0.0);
        if self.given_up.is_some_and(same) {
            return;
        }
        if self.pending {
            self.next_map = Some(point);
        } else {
            self.start(Work::Request { request: Request::Map(point), map: None });
        }
    }

    /// Requests the window ends of `map` at the load and speed of `point`.
    pub fn request_ends(&mut self, map: Arc<StabilityMap>, point: OperatingPoint) {
        if self.pending {
            self.next_ends = Some((map, point));
        } else {
            self.start(Work::Request { request: Request::Ends(point), map: Some(map) });
        }
    }

    /// Requests sensitivities unless a task is running; returns whether it was accepted. Refused requests are not kept,
    /// since the next prediction does as well.
    pub fn request_sensitivity(
        &mut self,
        question: Question,
        map: Option<Arc<StabilityMap>>,
        ends: Option<Ends>,
    ) -> bool {
        if !self.pending {
            self.start(Work::Sensitivity { question, map, ends });
            return true;
        }
        false
    }

    fn start(&mut self, work: Work) {
        self.pending = self.work.try_send((self.rig.clone(), work)).is_ok();
    }

    /// Takes note that a task has ended.
    pub fn done(&mut self) {
        self.pending = false;
    }

    /// Starts the next request, unless `served` says that the newest map already serves it.
    pub fn start_next(&mut self, served: impl Fn(&OperatingPoint) -> bool) {
        if let Some(point) = self.next_map.take().filter(|point| !served(point)) {
            self.request_map(point);
        }
        if let Some((map, point)) = self.next_ends.take() {
            self.request_ends(map, point);
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

/// Carries out a task for `rig`.
fn answer(rig: &Rig, solver: &mut Solver, work: Work) -> Incoming {
    match work {
        Work::Request { request, map } => {
            let result = guarded(rig, solver, |solver| compute(rig, solver, map.as_deref(), &request));
            Incoming::Computed { request, map, result }
        }
        Work::Sensitivity { question, map, ends } => {
            let answer =
                |solver: &mut Solver| sensitivity::answer(rig, solver, &question, map.as_deref(), ends.as_ref());
            Incoming::Sensitivity(Box::new(guarded(rig, solver, answer)))
        }
        Work::Rig { celsius, point } => {
            let result = guarded(rig, solver, |solver| {
                let rig = session_rig(rig, celsius)?;
                let map = compute(&rig, solver, None, &Request::Map(point)).ok().flatten();
                Ok(std::iter::once(Event::RigReady(rig)).chain(map).collect())
            });
            Incoming::Rig { celsius, result }
        }
    }
}

/// The result of `task`. A task that panics is an error, and its solver is replaced.
fn guarded<T>(
    rig: &Rig,
    solver: &mut Solver,
    task: impl FnOnce(&mut Solver) -> Result<T, String>,
) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(|| task(solver))).unwrap_or_else(|_| {
        *solver = Solver::new(rig.model.dimension());
        Err("internal error in the background thread".to_owned())
    })
}
