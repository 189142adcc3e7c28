//! What the buses hand over, and what they count while they listen.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use super::clock::Reading;

/// The bus a message came over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Bus {
    /// Shared memory (iceoryx2).
    Shm,
    /// ROS 2.
    Ros2,
    /// No bus: the rig simulator of a demonstration, in this process.
    Simulator,
}

/// A message that came over a bus.
#[derive(Clone, Debug, PartialEq)]
pub struct Heard<M> {
    pub bus: Bus,
    /// When it was taken off the bus.
    pub at: Reading,
    pub message: M,
}

impl<M> Heard<M> {
    /// Heard now.
    pub fn now(bus: Bus, message: M) -> Self {
        Self { bus, at: Reading::now(), message }
    }
}

/// What one listener counted so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Messages handed over.
    pub heard: u64,
    /// Messages that were lost on the way, by the gaps in their sequence numbers. A publisher that leaves numbers out on purpose
    /// cannot be told from one whose messages were lost: it has to count by one.
    pub missed: u64,
    /// Samples that were no message.
    pub malformed: u64,
    /// Times the bus itself failed to deliver or to wait.
    pub failures: u64,
    /// Peers that are known now but cannot be connected, because their quality of service is incompatible.
    pub incompatible: u64,
}

impl Counts {
    /// These and `others`, of a listener that took the place of the first.
    pub(super) fn plus(self, others: Self) -> Self {
        Self {
            heard: self.heard + others.heard,
            missed: self.missed + others.missed,
            malformed: self.malformed + others.malformed,
            failures: self.failures + others.failures,
            incompatible: others.incompatible, // who is known now
        }
    }
}

/// The counters behind [`Counts`], shared with the thread that listens.
#[derive(Debug, Default)]
pub(super) struct Counters {
    heard: AtomicU64,
    missed: AtomicU64,
    malformed: AtomicU64,
    failures: AtomicU64,
    incompatible: AtomicU64,
}

impl Counters {
    pub(super) fn heard(&self, missed: u64) {
        self.heard.fetch_add(1, Ordering::Relaxed);
        self.missed.fetch_add(missed, Ordering::Relaxed);
    }

    pub(super) fn malformed(&self) {
        self.malformed.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn failure(&self) {
        self.failures.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn set_incompatible(&self, peers: u64) {
        self.incompatible.store(peers, Ordering::Relaxed);
    }

    pub(super) fn counts(&self) -> Counts {
        Counts {
            heard: self.heard.load(Ordering::Relaxed),
            missed: self.missed.load(Ordering::Relaxed),
            malformed: self.malformed.load(Ordering::Relaxed),
            failures: self.failures.load(Ordering::Relaxed),
            incompatible: self.incompatible.load(Ordering::Relaxed),
        }
    }
}

/// At most this many publishers are told apart; beyond that the memory of all is dropped, and gaps with it.
const MAX_PUBLISHERS: usize = 256;

/// The gaps in the sequence numbers of each publisher.
#[derive(Debug)]
pub(super) struct Gaps<K> {
    last: HashMap<K, u64>,
}

impl<K: Eq + Hash> Gaps<K> {
    pub(super) fn new() -> Self {
        Self { last: HashMap::new() }
    }

    /// How many numbers are missing between `seq` and the one before it from the same publisher. The first of a
    /// publisher misses none, nor does one that started over or sends a number again.
    pub(super) fn note(&mut self, publisher: K, seq: u64) -> u64 {
        if self.last.len() >= MAX_PUBLISHERS && !self.last.contains_key(&publisher) {
            self.last.clear();
        }
        match self.last.insert(publisher, seq) {
            Some(last) if seq > last => seq - last - 1,
            _ => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_counted_per_publisher() {
        let mut gaps = Gaps::new();
        assert_eq!([gaps.note('a', 5), gaps.note('a', 6), gaps.note('a', 9)], [0, 0, 2]);
        assert_eq!([gaps.note('b', 100), gaps.note('a', 10)], [0, 0]);
        assert_eq!([gaps.note('a', 0), gaps.note('a', 0), gaps.note('a', 2)], [0, 0, 1], "started over, repeated");
        assert_eq!(gaps.note('a', u64::MAX), u64::MAX - 3);
    }

    #[test]
    fn publishers_are_bounded() {
        let mut gaps = Gaps::new();
        for publisher in 0..10 * MAX_PUBLISHERS {
            gaps.note(publisher, 1);
            assert!(gaps.last.len() <= MAX_PUBLISHERS);
        }
    }
}
