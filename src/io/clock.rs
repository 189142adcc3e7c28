//! The only place that reads clocks. What a prediction depends on are the stamps of messages, never these.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use iceoryx2_bb_posix::clock::{ClockType, Time};
use serde::{Deserialize, Serialize};

/// Both clocks, read together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reading {
    /// Nanoseconds since the epoch; may jump.
    pub wall_ns: i64,
    /// Nanoseconds since some moment of this machine, the same for all processes; never goes back. For durations.
    pub monotonic_ns: u64,
}

impl Reading {
    /// Now.
    pub fn now() -> Self {
        Self { wall_ns: now_ns(), monotonic_ns: monotonic_ns() }
    }
}

/// Wall time in nanoseconds since the epoch; negative before it, saturating in the year 2262.
pub fn now_ns() -> i64 {
    match SystemTime::now().duration_since(UNIX_EPOCH) {
        Ok(since) => i64::try_from(since.as_nanos()).unwrap_or(i64::MAX),
        Err(before) => i64::try_from(before.duration().as_nanos()).map_or(i64::MIN, |ns| -ns),
    }
}

/// Nanoseconds since some moment of this machine, the same for all processes; never goes back.
pub fn monotonic_ns() -> u64 {
    // It fails only where a system has no such clock.
    let now = Time::now_with_clock(ClockType::Monotonic).map_or_else(|_| Duration::ZERO, |now| now.as_duration());
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn monotonic_time_never_goes_back() {
        let mut last = monotonic_ns();
        for _ in 0..1000 {
            let now = monotonic_ns();
            assert!(now >= last);
            last = now;
        }
    }

    /// 2020-01-01 in nanoseconds: a clock before that is one read in the wrong unit.
    #[test]
    fn wall_time_is_in_nanoseconds_since_the_epoch() {
        assert!(now_ns() > 1_577_836_800_000_000_000);
    }
}
