//! A way past the queue: an input that can be answered at once is answered on the thread that heard it. To wake another
//! thread takes as long as to predict.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam_channel::Sender;

use super::{Incoming, Node};
use crate::io::heard::Heard;
use crate::wire;

/// Where a node is while it runs, for whoever holds the lock.
#[derive(Clone, Default)]
pub(super) struct Place(Arc<Mutex<Option<Node>>>);

impl Place {
    pub(super) fn lock(&self) -> MutexGuard<'_, Option<Node>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A queue to a node, and the way past it.
#[derive(Clone)]
pub struct Shortcut {
    queue: Sender<Incoming>,
    pub(super) place: Place,
}

impl Shortcut {
    /// For the node that will read the other end of `queue` and is made with [`Node::with_shortcut`].
    pub fn new(queue: Sender<Incoming>) -> Self {
        Self { queue, place: Place::default() }
    }

    /// Has an input predicted on this thread if nothing waits before it, nor on the bus behind it (`more_waits`), the node is
    /// idle, and the prediction takes no dense solve; otherwise queues it. Never waits. False where the queue is full: the
    /// input is lost.
    pub fn input(&self, heard: Heard<wire::OperatingPoint>, more_waits: bool) -> bool {
        // What waits in the queue is taken out of it under the lock alone, so that no input overtakes another.
        if !more_waits
            && let Ok(mut place) = self.place.0.try_lock()
            && self.queue.is_empty()
            && let Some(node) = place.as_mut()
            && node.answers_at_once(&heard.message)
        {
            node.answer(heard);
            return true;
        }
        self.queue.try_send(Incoming::Input(heard)).is_ok()
    }
}
