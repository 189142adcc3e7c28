//! Places recorded messages by their stamps, so that a recording made from a tenfold playback still spans the time of
//! the original measurement.

use crate::msgs::Time;

/// Stamps that run backward by more than this start again, ns: a recording was played another time.
const BACKWARD_NS: i64 = 1_000_000_000;

/// Assigns a time in ns to messages, in the order in which they were recorded.
#[derive(Clone, Copy, Debug, Default)]
pub struct TimeLine {
    /// Log time and assigned time of the latest message with a stamp, ns.
    latest: Option<(i64, i64)>,
    /// Difference between assigned times and stamps; changes when stamps start again.
    shift_ns: i64,
}

impl TimeLine {
    /// The time of a prediction by its input's stamp; never earlier than the previous one. If stamps start again, the
    /// elapsed log time is used instead.
    pub fn stamped(&mut self, stamp: Time, log_ns: i64) -> i64 {
        if stamp == Time::default() {
            return self.unstamped(log_ns); // the stamp is not set
        }
        let stamp_ns = stamp.as_ns();
        let mut place = stamp_ns.saturating_add(self.shift_ns);
        if let Some((_, before)) = self.latest {
            if place < before.saturating_sub(BACKWARD_NS) {
                place = self.unstamped(log_ns);
                self.shift_ns = place.saturating_sub(stamp_ns);
            }
            place = place.max(before);
        }
        self.latest = Some((log_ns, place));
        place
    }

    /// The time of a message that is not an input but has a stamp of the same clock.
    pub fn of_stamp(&self, stamp: Time, log_ns: i64) -> i64 {
        if stamp == Time::default() { self.unstamped(log_ns) } else { stamp.as_ns().saturating_add(self.shift_ns) }
    }

    /// Whether stamps have the same places as on another time line.
    pub fn runs_as(&self, other: &Self) -> bool {
        self.shift_ns == other.shift_ns
    }

    /// The time of something that the node did by its own clock: the time of the latest stamped message plus the log
    /// time elapsed since.
    pub fn unstamped(&self, log_ns: i64) -> i64 {
        self.latest.map_or(log_ns, |(logged, place)| place.saturating_add(log_ns.saturating_sub(logged).max(0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn messages_are_placed_by_stamp_or_else_by_log_time() {
        let mut line = TimeLine::default();
        assert_eq!(line.unstamped(90 * S), 90 * S, "nothing is known of the stamps");
        // Recorded during a tenfold playback.
        assert_eq!(line.stamped(Time::from_ns(5 * S), 100 * S), 5 * S);
        assert_eq!(line.stamped(Time::from_ns(15 * S), 101 * S), 15 * S);
        assert_eq!(line.unstamped(103 * S), 17 * S);
        assert_eq!(line.of_stamp(Time::from_ns(16 * S), 101 * S), 16 * S);
    }

    #[test]
    fn time_does_not_run_backward() {
        let mut line = TimeLine::default();
        line.stamped(Time::from_ns(50 * S), 200 * S);
        assert_eq!(line.stamped(Time::from_ns(50 * S - 5), 200 * S), 50 * S, "two sources that are not quite in step");
        // Played again, with the same stamps.
        assert_eq!(line.stamped(Time::from_ns(10 * S), 203 * S), 53 * S);
        assert_eq!(line.stamped(Time::from_ns(12 * S), 204 * S), 55 * S);
        assert_eq!(line.of_stamp(Time::from_ns(12 * S), 204 * S), 55 * S);
    }

    #[test]
    fn without_stamps_the_recording_decides() {
        let mut line = TimeLine::default();
        assert_eq!(line.stamped(Time::default(), 7 * S), 7 * S);
        assert_eq!(line.stamped(Time::default(), 9 * S), 9 * S);
    }
}
