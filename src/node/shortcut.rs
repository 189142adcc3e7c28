//! A path past the channel: an input that needs no dense solve is predicted on the thread that received it. Waking
//! another thread would take as long as the prediction itself.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam_channel::Sender;

use super::{Incoming, Node};
use crate::bus::received::Received;
use crate::msgs;

/// Holds the node while it runs; whoever has the lock may use it.
#[derive(Clone, Default)]
pub(super) struct Place(Arc<Mutex<Option<Node>>>);

impl Place {
    pub(super) fn lock(&self) -> MutexGuard<'_, Option<Node>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The sending side of a node's channel, with the path past it.
#[derive(Clone)]
pub struct Shortcut {
    queue: Sender<Incoming>,
    pub(super) place: Place,
}

impl Shortcut {
    /// A shortcut to the node that reads the other end of `queue` and is built with [`Node::with_shortcut`].
    pub fn new(queue: Sender<Incoming>) -> Self {
        Self { queue, place: Place::default() }
    }

    /// Predicts for an input on this thread if it needs no dense solve, the node is idle, and no input waits in the
    /// channel or on the bus (`more_waits`). Otherwise queues it. Never blocks. False if the channel is full and the
    /// input is lost.
    pub fn input(&self, received: Received<msgs::OperatingPoint>, more_waits: bool) -> bool {
        // Items are only taken out of the channel under this lock. If the channel is empty here, no input can be
        // overtaken.
        if !more_waits
            && let Ok(mut place) = self.place.0.try_lock()
            && self.queue.is_empty()
            && let Some(node) = place.as_mut()
            && node.answers_at_once(&received.message)
        {
            node.answer(received);
            return true;
        }
        self.queue.try_send(Incoming::Input(received)).is_ok()
    }
}
