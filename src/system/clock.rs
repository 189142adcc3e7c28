//! The only module that reads clocks. Predictions depend on the stamps of messages, never on these clocks.

use std::sync::LazyLock;
use std::time::{SystemTime, UNIX_EPOCH};

use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// Both clocks at one moment early in this process; log times are counted from there.
static START: LazyLock<Reading> = LazyLock::new(|| Reading { wall_ns: now_ns(), monotonic_ns: monotonic_ns() });

/// Both clocks, read at the same moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reading {
    /// Wall clock, ns since the epoch; jumps when the clock is set.
    pub wall_ns: i64,
    /// Time since the machine was started, ns; the same in every process, never runs backward. For durations.
    pub monotonic_ns: u64,
}

impl Reading {
    /// Reads both clocks.
    pub fn now() -> Self {
        Self { wall_ns: now_ns(), monotonic_ns: monotonic_ns() }
    }

    /// The log time: the wall clock at the start of this process plus the time elapsed since. It does not jump when the
    /// wall clock is set, so that a replay takes as long as the recording did. The current wall clock is
    /// [`Reading::wall_ns`].
    pub fn log_ns(&self) -> u64 {
        let start = *START;
        let start_ns = u64::try_from(start.wall_ns).unwrap_or(0);
        start_ns.saturating_add(self.monotonic_ns).saturating_sub(start.monotonic_ns)
    }
}

/// Wall clock in ns since the epoch; negative before it, saturates in the year 2262.
pub fn now_ns() -> i64 {
    match SystemTime::now().duration_since(UNIX_EPOCH) {
        Ok(since) => i64::try_from(since.as_nanos()).unwrap_or(i64::MAX),
        Err(before) => i64::try_from(before.duration().as_nanos()).map_or(i64::MIN, |ns| -ns),
    }
}

/// Time since the machine was started, including suspension, ns; never runs backward.
pub fn monotonic_ns() -> u64 {
    let time = clock_gettime(ClockId::Boottime);
    let [seconds, ns] = [time.tv_sec, time.tv_nsec].map(|part| u64::try_from(part).unwrap_or(0));
    seconds.saturating_mul(1_000_000_000).saturating_add(ns)
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

    /// Log times begin at the wall clock and advance with monotonic time, even if the wall clock is set.
    #[test]
    fn log_time_does_not_follow_a_clock_that_is_set() {
        let now = Reading::now();
        // Both clocks were read since the start of the process and advance alike.
        assert!(now.log_ns().abs_diff(now.wall_ns as u64) < 1_000_000_000, "{now:?}");
        let second = 1_000_000_000;
        for step_ns in [-3_600 * second, 3_600 * second] {
            let later = Reading { wall_ns: now.wall_ns + step_ns, monotonic_ns: now.monotonic_ns + 5 };
            assert_eq!(later.log_ns(), now.log_ns() + 5);
        }
    }

    /// 2020-01-01 in nanoseconds: an earlier time means that the unit is wrong.
    #[test]
    fn wall_time_is_in_nanoseconds_since_the_epoch() {
        assert!(now_ns() > 1_577_836_800_000_000_000);
    }
}
