//! The time of what was recorded is that of its stamps: a recording that was played at ten times the speed into a node still
//! lasts as long as the measurement did.

use crate::wire::Time;

/// Stamps that run backward by more than this begin anew, ns: a recording that was played again.
const BACKWARD_NS: i64 = 1_000_000_000;

/// Places messages, in the order in which they were recorded, at a time in ns.
#[derive(Clone, Copy, Debug, Default)]
pub struct TimeLine {
    /// When the latest message with a stamp was recorded, and its place.
    latest: Option<(i64, i64)>,
    /// From stamps to places; changes where stamps begin anew.
    shift_ns: i64,
}

impl TimeLine {
    /// The place of a prediction with its input's stamp; never before the one before. Where stamps begin anew, time goes on as
    /// it did while recording.
    pub fn stamped(&mut self, stamp: Time, log_ns: i64) -> i64 {
        if stamp == Time::default() {
            return self.unstamped(log_ns); // nobody has set it
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

    /// The place of a message with a stamp of the same clock that is not an input's.
    pub fn beside(&self, stamp: Time, log_ns: i64) -> i64 {
        if stamp == Time::default() { self.unstamped(log_ns) } else { stamp.as_ns().saturating_add(self.shift_ns) }
    }

    /// The place of what the node did by its own clock: as long after the latest stamped message as it was recorded after it.
    pub fn unstamped(&self, log_ns: i64) -> i64 {
        self.latest.map_or(log_ns, |(logged, place)| place.saturating_add(log_ns.saturating_sub(logged).max(0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn stamps_decide_and_what_has_none_follows_the_recording() {
        let mut line = TimeLine::default();
        assert_eq!(line.unstamped(90 * S), 90 * S, "nothing is known of the stamps");
        // Recorded at ten times the speed.
        assert_eq!(line.stamped(Time::from_ns(5 * S), 100 * S), 5 * S);
        assert_eq!(line.stamped(Time::from_ns(15 * S), 101 * S), 15 * S);
        assert_eq!(line.unstamped(103 * S), 17 * S);
        assert_eq!(line.beside(Time::from_ns(16 * S), 101 * S), 16 * S);
    }

    #[test]
    fn time_does_not_run_backward() {
        let mut line = TimeLine::default();
        line.stamped(Time::from_ns(50 * S), 200 * S);
        assert_eq!(line.stamped(Time::from_ns(50 * S - 5), 200 * S), 50 * S, "two sources that are not quite in step");
        // Played again: the stamps of before.
        assert_eq!(line.stamped(Time::from_ns(10 * S), 203 * S), 53 * S);
        assert_eq!(line.stamped(Time::from_ns(12 * S), 204 * S), 55 * S);
        assert_eq!(line.beside(Time::from_ns(12 * S), 204 * S), 55 * S);
    }

    #[test]
    fn without_stamps_the_recording_decides() {
        let mut line = TimeLine::default();
        assert_eq!(line.stamped(Time::default(), 7 * S), 7 * S);
        assert_eq!(line.stamped(Time::default(), 9 * S), 9 * S);
    }
}
