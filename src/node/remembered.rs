//! Which messages have been received recently: the same message comes over several buses.

use std::collections::{HashMap, VecDeque};

use crate::bus::Bus;
use crate::msgs::Time;

/// Recent stamps and sequence numbers, each with the bus that delivered it first.
pub(super) struct Remembered {
    count: usize,
    bus: HashMap<(Time, u64), Bus>,
    order: VecDeque<(Time, u64)>,
}

impl Remembered {
    /// Remembers the latest `count`. All memory is allocated here. Twice the capacity is reserved, so that the map
    /// reuses the slots of removed entries instead of growing.
    pub(super) fn new(count: usize) -> Self {
        Self { count, bus: HashMap::with_capacity(2 * (count + 1)), order: VecDeque::with_capacity(count + 1) }
    }

    /// Whether this was not recently received over another bus. A repetition over the same bus counts as new: a
    /// recording may be played again.
    pub(super) fn is_new(&mut self, bus: Bus, stamp: Time, seq: u64) -> bool {
        let key = (stamp, seq);
        if let Some(&first) = self.bus.get(&key) {
            return first == bus;
        }
        self.bus.insert(key, bus);
        self.order.push_back(key);
        if self.order.len() > self.count
            && let Some(oldest) = self.order.pop_front()
        {
            self.bus.remove(&oldest);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bus_may_repeat_itself_but_not_another() {
        let mut received = Remembered::new(4);
        let stamp = Time::from_ns(1);
        assert!(received.is_new(Bus::Shm, stamp, 1));
        assert!(!received.is_new(Bus::Ros2, stamp, 1), "answered over shared memory already");
        assert!(received.is_new(Bus::Shm, stamp, 1), "a recording played again");
        assert!(!received.is_new(Bus::Ros2, stamp, 1));
    }

    #[test]
    fn old_inputs_are_forgotten_and_their_memory_reused() {
        let mut received = Remembered::new(100);
        let room = (received.bus.capacity(), received.order.capacity());
        for seq in 0..100_000 {
            assert!(received.is_new(Bus::Shm, Time::from_ns(0), seq));
            assert_eq!(seq >= 100, received.is_new(Bus::Ros2, Time::from_ns(0), seq.saturating_sub(100)), "{seq}");
        }
        // Slots of removed entries reduce the capacity that a map reports.
        assert!(received.bus.capacity() <= room.0 && received.order.capacity() == room.1);
    }
}
