//! The receiving end of a node: its queue, and a way past it. An input that needs no dense solve is predicted on the
//! thread that received it, since waking another thread would take as long as the prediction itself.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam_channel::Sender;

use super::detection::DetectionInlet;
use super::lifecycle::Lifecycle;
use super::{Incoming, Worker};
use crate::bus::lifecycle::State;
use crate::bus::{Received, Sink};
use crate::msgs;

/// Holds the worker while the node runs; whoever has the lock may use it.
#[derive(Clone, Default)]
pub(super) struct Running(Arc<Mutex<Option<Worker>>>);

impl Running {
    pub(super) fn lock(&self) -> MutexGuard<'_, Option<Worker>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Hands items to the node it was made with. Clones belong to the same node.
#[derive(Clone)]
pub struct Inlet {
    queue: Sender<Incoming>,
    running: Running,
    lost: Arc<AtomicU64>,
    takes_bus_inputs: bool,
    lifecycle: Lifecycle,
    detection: DetectionInlet,
}

impl Inlet {
    pub(super) fn new(
        queue: Sender<Incoming>,
        running: Running,
        lost: Arc<AtomicU64>,
        lifecycle: Lifecycle,
        detection: DetectionInlet,
    ) -> Self {
        Self { queue, running, lost, takes_bus_inputs: true, lifecycle, detection }
    }

    /// The same inlet for buses that deliver parameters only, since the inputs come from this process.
    pub fn for_parameters(&self) -> Self {
        Self { takes_bus_inputs: false, ..self.clone() }
    }

    /// Queues an item; waits while the queue is full. Returns false if the node has ended.
    pub fn send(&self, item: Incoming) -> bool {
        self.queue.send(item).is_ok()
    }

    /// Ends the node after the items that are already queued.
    pub fn stop(&self) {
        self.send(Incoming::Stop);
    }

    /// Predicts for an input on this thread if `may_predict`, it needs no dense solve, and the node is idle with an empty
    /// queue. Otherwise queues it. Never blocks. Returns false if the queue is full: the input is lost and counted. A node
    /// that is not active drops it.
    pub fn input(&self, received: Received<msgs::OperatingPoint>, may_predict: bool) -> bool {
        if !self.lifecycle.receives() {
            return true;
        }
        // Items are only taken out of the queue under this lock. If the queue is empty here, no input can be overtaken.
        if may_predict
            && let Ok(mut running) = self.running.0.try_lock()
            && self.queue.is_empty()
            && let Some(worker) = running.as_mut()
            && worker.answers_at_once(&received.message)
        {
            worker.answer(received);
            return true;
        }
        self.queue_or_lose(Incoming::Input(received))
    }

    fn queue_or_lose(&self, item: Incoming) -> bool {
        let queued = self.queue.try_send(item).is_ok();
        self.lost.fetch_add(u64::from(!queued), Ordering::Relaxed);
        queued
    }
}

impl Sink for Inlet {
    fn takes_inputs(&self) -> bool {
        self.takes_bus_inputs
    }

    fn operating_point(&self, received: Received<msgs::OperatingPoint>, may_predict: bool) {
        self.input(received, may_predict);
    }

    fn vibration(&self, received: Received<msgs::Vibration>) {
        if self.lifecycle.receives() {
            self.queue_or_lose(Incoming::Vibration(received));
        }
    }

    fn temperature(&self, received: Received<msgs::Temperature>) {
        if self.lifecycle.receives() {
            self.queue_or_lose(Incoming::Temperature(received));
        }
    }

    fn waveform(&self, received: Received<msgs::Waveform>) {
        if self.lifecycle.receives() {
            self.detection.waveform(received);
        }
    }

    fn parameter(&self, name: &str, value: f64) {
        if self.queue.try_send(Incoming::Parameter { name: name.to_owned(), value }).is_err() {
            note!("parameter {name} = {value} is ignored: the node's queue is full");
        }
    }

    fn lifecycle(&self, state: State) {
        self.lifecycle.set(state);
        // Wakes the node. If the queue is full, it is awake.
        let _ = self.queue.try_send(Incoming::Lifecycle);
    }
}
