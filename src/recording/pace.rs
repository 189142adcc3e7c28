//! Computes when each message of a replay is due. Pure: reads no clock and does not sleep.

/// How a recording is played back; the options of `ros2 bag play`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pacing {
    /// Playback speed: 2 plays twice as fast.
    pub rate: f64,
    /// Recorded time to skip at the start, s.
    pub start_offset_s: f64,
    /// Recorded time to play, s; `None` plays to the end.
    pub playback_duration_s: Option<f64>,
    /// Start again at the end, forever.
    pub repeat: bool,
}

impl Default for Pacing {
    fn default() -> Self {
        Self { rate: 1.0, start_offset_s: 0.0, playback_duration_s: None, repeat: false }
    }
}

/// An invalid value in a [`Pacing`].
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PacingError {
    #[error("rate {0}: must be finite and greater than 0")]
    Rate(f64),
    #[error("start offset {0} s: must be finite and not negative")]
    StartOffset(f64),
    #[error("playback duration {0} s: must be greater than 0")]
    PlaybackDuration(f64),
}

/// The part of a recording that is played, and its speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pacer {
    pacing: Pacing,
    from_ns: u64,
    until_ns: u64,
}

/// What to do with a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Due {
    /// It lies before the part that is played.
    Skip,
    /// Publish it this long after the start of playback, ns.
    After(u64),
    /// It lies after the part that is played: the round is over.
    End,
}

impl Pacer {
    /// A pacer for a recording whose first message has the log time `first_log_time_ns`.
    ///
    /// # Errors
    ///
    /// An invalid value in `pacing`.
    pub fn new(pacing: Pacing, first_log_time_ns: u64) -> Result<Self, PacingError> {
        if !(pacing.rate.is_finite() && pacing.rate > 0.0) {
            return Err(PacingError::Rate(pacing.rate));
        }
        if !(pacing.start_offset_s.is_finite() && pacing.start_offset_s >= 0.0) {
            return Err(PacingError::StartOffset(pacing.start_offset_s));
        }
        if let Some(duration) = pacing.playback_duration_s
            && (duration.is_nan() || duration <= 0.0)
        {
            return Err(PacingError::PlaybackDuration(duration));
        }
        let from_ns = first_log_time_ns.saturating_add(to_ns(pacing.start_offset_s));
        let until_ns = pacing.playback_duration_s.map_or(u64::MAX, |duration| from_ns.saturating_add(to_ns(duration)));
        Ok(Self { pacing, from_ns, until_ns })
    }

    /// When the message logged at `log_time_ns` is due, in a round that began `round_start_ns` after the start of
    /// playback. Messages before the start offset are skipped; messages at `from + duration` or later end the round.
    pub fn due(&self, round_start_ns: u64, log_time_ns: u64) -> Due {
        if log_time_ns < self.from_ns {
            Due::Skip
        } else if log_time_ns >= self.until_ns {
            Due::End
        } else {
            Due::After(round_start_ns.saturating_add(self.scaled(log_time_ns - self.from_ns)))
        }
    }

    /// Start of the round after the one that began at `round_start_ns` and whose last message was logged at
    /// `last_log_time_ns`; `None` if playback does not repeat. Rounds are separated by `gap_ns` of recorded time, so
    /// that the last and the first message do not coincide. The separation is at least 1 ms of real time, so that a
    /// recording with one message does not use the whole processor.
    pub fn next_round(&self, round_start_ns: u64, last_log_time_ns: u64, gap_ns: u64) -> Option<u64> {
        let played = last_log_time_ns.saturating_sub(self.from_ns).saturating_add(gap_ns);
        self.pacing.repeat.then(|| round_start_ns.saturating_add(self.scaled(played).max(1_000_000)))
    }

    fn scaled(&self, recorded_ns: u64) -> u64 {
        // Integer arithmetic at rate 1 is exact.
        if self.pacing.rate == 1.0 { recorded_ns } else { (recorded_ns as f64 / self.pacing.rate) as u64 }
    }
}

/// Seconds in ns, saturating.
fn to_ns(seconds: f64) -> u64 {
    (seconds * 1e9) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    const T0: u64 = 1_700_000_000_123_456_789;
    const S: u64 = 1_000_000_000;

    #[test]
    fn real_time_is_exact() {
        let pacer = Pacer::new(Pacing::default(), T0).unwrap();
        assert_eq!(pacer.due(0, T0), Due::After(0));
        assert_eq!(pacer.due(0, T0 + 86_400 * S + 1), Due::After(86_400 * S + 1));
        assert_eq!(pacer.due(0, T0 - 1), Due::Skip);
        assert_eq!(pacer.next_round(0, T0 + S, 0), None);
    }

    #[test]
    fn offset_duration_and_rate() {
        let pacing = Pacing { rate: 4.0, start_offset_s: 2.0, playback_duration_s: Some(3.0), repeat: true };
        let pacer = Pacer::new(pacing, T0).unwrap();
        assert_eq!(pacer.due(0, T0 + 2 * S - 1), Due::Skip);
        assert_eq!(pacer.due(0, T0 + 2 * S), Due::After(0));
        assert_eq!(pacer.due(0, T0 + 4 * S), Due::After(S / 2));
        assert_eq!(pacer.due(0, T0 + 5 * S), Due::End);
        let second = pacer.next_round(0, T0 + 4 * S, 2 * S).unwrap();
        assert_eq!(second, S);
        assert_eq!(pacer.due(second, T0 + 4 * S), Due::After(S + S / 2));
    }

    #[test]
    fn a_recording_of_one_message_repeats_without_spinning() {
        let pacer = Pacer::new(Pacing { repeat: true, rate: 1e9, ..Pacing::default() }, T0).unwrap();
        assert_eq!(pacer.next_round(5, T0, 0), Some(1_000_005));
    }

    #[test]
    fn times_at_the_ends_of_their_range_saturate() {
        let pacing =
            Pacing { rate: 1e-12, start_offset_s: 1e300, playback_duration_s: Some(f64::INFINITY), repeat: true };
        let pacer = Pacer::new(pacing, u64::MAX).unwrap();
        assert_eq!(pacer.due(u64::MAX, u64::MAX), Due::End);
        assert_eq!(pacer.next_round(u64::MAX, u64::MAX, u64::MAX), Some(u64::MAX));
    }

    #[test]
    fn numbers_that_make_no_sense_are_named() {
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(Pacer::new(Pacing { rate, ..Pacing::default() }, 0), Err(PacingError::Rate(_))));
        }
        let pacing = Pacing { start_offset_s: -1.0, ..Pacing::default() };
        assert_eq!(Pacer::new(pacing, 0), Err(PacingError::StartOffset(-1.0)));
        let pacing = Pacing { playback_duration_s: Some(0.0), ..Pacing::default() };
        assert_eq!(Pacer::new(pacing, 0), Err(PacingError::PlaybackDuration(0.0)));
    }
}
