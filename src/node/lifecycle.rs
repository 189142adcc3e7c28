//! The lifecycle of a managed node: what it does in which state, and how the threads that receive learn of it.
//!
//! The session does not know of it. A node that is not active feeds it no inputs and detects no silence, so a replay
//! needs nothing but the recorded events.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};

use super::Worker;
use crate::bus::lifecycle::State;
use crate::files::chart_file::ChartFile;

/// The state of a node, shared with the threads that receive.
#[derive(Clone, Default)]
pub(super) struct Lifecycle(Arc<Shared>);

#[derive(Default)]
struct Shared {
    /// The number of the state; 0 for the default.
    state: AtomicU8,
    unheard: AtomicU64,
}

impl Lifecycle {
    pub(super) fn state(&self) -> State {
        State::of_id(self.0.state.load(Ordering::Acquire)).unwrap_or_default()
    }

    pub(super) fn set(&self, state: State) {
        self.0.state.store(state.id(), Ordering::Release);
    }

    /// Whether the node receives; if not, the message in question is counted.
    pub(super) fn receives(&self) -> bool {
        let receives = self.state() == State::Active;
        self.0.unheard.fetch_add(u64::from(!receives), Ordering::Relaxed);
        receives
    }

    /// Messages that came while the node was not active.
    pub(super) fn unheard(&self) -> u64 {
        self.0.unheard.load(Ordering::Relaxed)
    }
}

/// Whether and how the rig is charted once the node is configured.
#[derive(Clone, Default)]
pub(super) enum Charting {
    #[default]
    Never,
    /// With the file that keeps the chart.
    Wanted(Option<ChartFile>),
}

impl Worker {
    /// Takes the state that a peer has requested since the last call.
    pub(super) fn follow_lifecycle(&mut self) {
        let (before, now) = (self.state, self.lifecycle.state());
        if before == now {
            return;
        }
        self.state = now;
        note!("the node is {now}");
        match (before.is_prepared(), now.is_prepared()) {
            (false, true) => self.prepare(),
            (true, false) => {
                self.mapper.stop_chart();
            }
            (true, true) | (false, false) => {}
        }
        if before == State::Active {
            (self.last_received, self.silent) = (None, false);
        }
        self.statistics.state(now);
        self.watch.state(now);
    }

    /// Publishes the rig, records the settings, requests the map at the reference conditions and has the rig charted.
    pub(super) fn prepare(&mut self) {
        self.outputs.rig_info(super::rig_info(&self.rig));
        let settings: Vec<(&str, f64)> = self.session.settings().values().collect();
        for (name, value) in settings {
            self.outputs.session_event(super::parameter_record(super::now_header(), name, value));
        }
        self.mapper.request_map(self.rig.reference);
        if let Charting::Wanted(kept) = self.charting.clone()
            && !self.statistics.is_charted()
        {
            self.mapper.chart(kept);
        }
    }
}
