//! Messages received over buses, and the counts of the receivers.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use super::Bus;
use crate::system::clock::Reading;

/// A message received over a bus.
#[derive(Clone, Debug, PartialEq)]
pub struct Received<M> {
    pub bus: Bus,
    /// When it was taken from the bus.
    pub at: Reading,
    pub message: M,
}

impl<M> Received<M> {
    /// A message received now.
    pub fn now(bus: Bus, message: M) -> Self {
        Self { bus, at: Reading::now(), message }
    }
}

/// Counts of one receiver so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Messages received.
    pub received: u64,
    /// Messages lost on the way, according to gaps in their sequence numbers. A publisher must count by one: numbers
    /// that it skips on purpose cannot be distinguished from losses.
    pub missed: u64,
    /// Samples that could not be decoded.
    pub malformed: u64,
    /// Failures of the bus to deliver or to wait.
    pub failures: u64,
    /// Known peers that cannot be connected because their quality of service is incompatible.
    pub incompatible: u64,
    /// Known peers that publish predictions on the topic of this node.
    pub rivals: u64,
}

impl Counts {
    /// The sum of these counts and those of a receiver that replaced the first.
    pub(super) fn plus(self, others: Self) -> Self {
        Self {
            received: self.received + others.received,
            missed: self.missed + others.missed,
            malformed: self.malformed + others.malformed,
            failures: self.failures + others.failures,
            // Not counts: the peers known now.
            incompatible: others.incompatible,
            rivals: others.rivals,
        }
    }
}

/// The counters behind [`Counts`], shared with the receiving thread.
#[derive(Debug, Default)]
pub(super) struct Counters {
    received: AtomicU64,
    missed: AtomicU64,
    malformed: AtomicU64,
    failures: AtomicU64,
    incompatible: AtomicU64,
    rivals: AtomicU64,
}

impl Counters {
    pub(super) fn received(&self, missed: u64) {
        self.received.fetch_add(1, Ordering::Relaxed);
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

    pub(super) fn set_rivals(&self, peers: u64) {
        self.rivals.store(peers, Ordering::Relaxed);
    }

    pub(super) fn counts(&self) -> Counts {
        Counts {
            received: self.received.load(Ordering::Relaxed),
            missed: self.missed.load(Ordering::Relaxed),
            malformed: self.malformed.load(Ordering::Relaxed),
            failures: self.failures.load(Ordering::Relaxed),
            incompatible: self.incompatible.load(Ordering::Relaxed),
            rivals: self.rivals.load(Ordering::Relaxed),
        }
    }
}

/// Number of publishers whose sequence numbers are tracked. Beyond it all are forgotten, and with them their gaps.
const MAX_PUBLISHERS: usize = 256;

/// Detects gaps in the sequence numbers of each publisher.
#[derive(Debug)]
pub(super) struct Gaps<K> {
    last: HashMap<K, u64>,
}

impl<K: Eq + Hash> Gaps<K> {
    pub(super) fn new() -> Self {
        Self { last: HashMap::new() }
    }

    /// Number of sequence numbers missing between `seq` and the previous one of the same publisher. Zero for the first
    /// message of a publisher, after a restart of its numbering, and for a repeated number.
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
