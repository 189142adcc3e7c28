//! Stability maps, computed beside the hot path on a thread of their own.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam_channel::{Sender, bounded};
use sha2::{Digest, Sha256};

use super::Incoming;
use crate::physics::chart::build::{ChartOptions, build};
use crate::physics::{Chart, OperatingPoint, Solver, StabilityMap};
use crate::rig::Rig;
use crate::session::{chart_options, map_options};

/// The map a session uses at the load and speed of `point`.
///
/// # Errors
/// Why there is none, in words.
pub fn session_map(rig: &Rig, solver: &mut Solver, point: &OperatingPoint) -> Result<StabilityMap, String> {
    StabilityMap::build(&rig.model, solver, point, &map_options(rig)).map_err(|error| error.to_string())
}

/// The chart a session uses, the same whatever the number of threads; `go_on` stops the work by saying no.
///
/// # Errors
/// Why there is none, in words.
pub fn session_chart(rig: &Rig, threads: usize, go_on: &dyn Fn() -> bool) -> Result<Chart, String> {
    let options = ChartOptions { threads, ..chart_options(rig) };
    build(&rig.model, &options, &|_| go_on()).map_err(|error| error.to_string())
}

/// SHA-256 of every number of a map that a prediction can depend on, hexadecimal.
pub fn map_hash(map: &StabilityMap) -> String {
    hash(map.words().into_iter())
}

/// SHA-256 of every number of a chart that a prediction can depend on, hexadecimal.
pub fn chart_hash(chart: &Chart) -> String {
    hash(chart.words())
}

fn hash(words: impl Iterator<Item = u64>) -> String {
    let mut hasher = Sha256::new();
    for word in words {
        hasher.update(word.to_le_bytes());
    }
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Builds the chart on a thread of its own, of the lowest priority: predictions come first. It ends early when nobody
/// listens any more.
pub fn spawn_chart(rig: Arc<Rig>, done: Sender<Incoming>, stopped: Arc<AtomicBool>) {
    std::thread::spawn(move || {
        // Where the system does not allow it, the chart competes like any thread.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
        let go_on = || !stopped.load(Ordering::Relaxed);
        let built = catch_unwind(AssertUnwindSafe(|| session_chart(&rig, 1, &go_on)));
        let chart = built.unwrap_or_else(|_| Err("internal error while the rig was charted".to_owned()));
        if go_on() {
            let _ = done.send(Incoming::Chart(chart.map(Arc::new)));
        }
    });
}

/// Computes one map at a time.
pub struct Mapper {
    wanted: Sender<OperatingPoint>,
    pending: bool,
    /// The newest that was asked for meanwhile.
    next: Option<OperatingPoint>,
    given_up: Option<OperatingPoint>,
}

impl Mapper {
    /// Starts the thread; it ends when the mapper is gone.
    pub fn spawn(rig: Arc<Rig>, done: Sender<Incoming>) -> Self {
        let (wanted, requests) = bounded::<OperatingPoint>(1);
        std::thread::spawn(move || {
            let mut solver = Solver::new(rig.model.dimension());
            for point in requests {
                let built = catch_unwind(AssertUnwindSafe(|| session_map(&rig, &mut solver, &point)));
                let map = match built {
                    Ok(map) => map.map(Arc::new),
                    Err(_) => {
                        solver = Solver::new(rig.model.dimension());
                        Err("internal error while the stability map was computed".to_owned())
                    }
                };
                if done.send(Incoming::Map { point, map }).is_err() {
                    return;
                }
            }
        });
        Self { wanted, pending: false, next: None, given_up: None }
    }

    /// Asks for the map at the load and speed of `point`; while one is being computed, for the newest wish after it.
    pub fn want(&mut self, point: OperatingPoint) {
        let same = |other: OperatingPoint| other.with_friction(0.0) == point.with_friction(0.0);
        if self.given_up.is_some_and(same) {
            return;
        }
        if self.pending {
            self.next = Some(point);
        } else {
            self.pending = self.wanted.try_send(point).is_ok();
        }
    }

    /// The map that was asked for is there, or cannot be had.
    pub fn done(&mut self) {
        self.pending = false;
    }

    /// Starts on the wish that came meanwhile, unless `served` says that the newest map serves it.
    pub fn go_on(&mut self, served: impl Fn(&OperatingPoint) -> bool) {
        if let Some(point) = self.next.take().filter(|point| !served(point)) {
            self.want(point);
        }
    }

    /// No map can be had there: it is not asked for again until another was.
    pub fn give_up_on(&mut self, point: OperatingPoint) {
        self.given_up = Some(point);
    }

    /// Whether a map is being computed.
    pub fn pending(&self) -> bool {
        self.pending
    }
}
