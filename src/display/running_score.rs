//! The running score of a node: its predictions of the last ten minutes against the squeals found in its samples.

use std::collections::BTreeMap;

use crate::msgs::Heard;
use crate::node::Sample;
use crate::node::status::Status;
use crate::offline::score::{HeardAndPredicted, MetChannel};
use crate::recording::message::Payload;
use crate::sound::matching::{Criteria, Unstable};
use crate::sound::spectrogram::Spectrogram;

/// Time that is judged: that of the spectrogram, ns.
const JUDGED_NS: i64 = 600_000_000_000;
/// Of predictions of one level, one in this time is judged, ns.
const EVERY_NS: i64 = 10_000_000;
/// Time between two removals of what is older, ns.
const FORGET_EVERY_NS: i64 = 10_000_000_000;

/// Predictions and squeals of the last ten minutes.
pub struct RunningScore {
    found: HeardAndPredicted,
    /// Stamp and status of the latest prediction judged.
    latest: Option<(i64, Status)>,
    forgotten_ns: i64,
}

impl Default for RunningScore {
    fn default() -> Self {
        Self { found: HeardAndPredicted::new([0.0, f64::MAX]), latest: None, forgotten_ns: i64::MIN }
    }
}

impl RunningScore {
    /// Adds a prediction.
    pub fn predicted(&mut self, sample: &Sample) {
        let (stamp_ns, status) = (sample.stamp_ns, sample.status);
        let squeals = status == Status::Squeal;
        let soon =
            |(before_ns, before): (i64, Status)| before == status && stamp_ns.saturating_sub(before_ns) < EVERY_NS;
        if !status.is_known() || self.latest.is_some_and(soon) {
            return;
        }
        self.latest = Some((stamp_ns, status));
        let modes = sample.unstable.iter().flatten().filter(|_| squeals).map(|mode| Unstable {
            mode_id: mode.id,
            frequency_hz: mode.frequency_hz,
            growth_rate_per_s: mode.growth_rate_per_s,
        });
        self.found.predicted(stamp_ns, squeals || status == Status::Warn, &modes.collect::<Vec<_>>());
        if stamp_ns.saturating_sub(self.forgotten_ns) > FORGET_EVERY_NS {
            self.forgotten_ns = stamp_ns;
            self.found.forget_before(stamp_ns.saturating_sub(JUDGED_NS));
        }
    }

    /// Adds a squeal.
    pub fn heard(&mut self, heard: &Heard) {
        self.found.take(&Payload::Heard(heard.clone()));
    }

    /// The comparison of every channel in the time and band of its spectrogram.
    pub fn meet(&self, spectrograms: &BTreeMap<String, Spectrogram>) -> Vec<MetChannel> {
        let mut found = self.found.clone();
        for (name, shown) in spectrograms {
            let columns = shown.columns();
            if let Some((first, last)) = columns.front().zip(columns.back()) {
                found.set_band_hz(shown.band_hz());
                found.listened(name, first.index * shown.column_ns(), (last.index + 1) * shown.column_ns());
            }
        }
        found.meet(&Criteria::default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::events::tests::sample;
    use crate::msgs::{Header, Time, heard_state};
    use crate::node::sound_view::SoundView;
    use crate::sound::{Channel, Unit};

    const S: i64 = 1_000_000_000;

    fn heard(number: u64, from_s: i64, frequency_hz: f64) -> Heard {
        let header = Header { stamp: Time::from_ns(from_s * S), frame_id: String::new() };
        let (channel, end_stamp) = ("microphone".to_owned(), Time::from_ns((from_s + 2) * S));
        Heard { header, channel, number, state: heard_state::ENDED, end_stamp, frequency_hz, ..Heard::default() }
    }

    /// Mode 3 at 1500 Hz is predicted to squeal from 700 to 710 s and from 720 to 725 s; a squeal of its frequency is found
    /// in the first, one of another frequency later, and one was found long ago.
    #[test]
    fn the_last_minutes_are_scored_with_counts_and_what_is_older_is_forgotten() {
        let view = SoundView::default();
        let channel =
            Channel { name: "microphone".to_owned(), sample_rate_hz: 8000.0, unit: Unit::Pascal, sensitivity: None };
        let second = vec![0.01_f32; 8000];
        view.push(&channel, [1250.0, 4000.0], 0, &second);
        view.with(|shown| assert!(shown.is_empty(), "nobody follows"));
        view.follow();
        let mut score = RunningScore::default();
        score.heard(&heard(1, 5, 1500.0));
        for k in 0..80_000 {
            let time_ns = k * S / 100;
            let squeals = [(700, 710), (720, 725)].iter().any(|&(a, b)| (a * S..b * S).contains(&time_ns));
            score.predicted(&sample(time_ns, 0.5, if squeals { Status::Squeal } else { Status::Ok }));
            if k % 100 == 0 {
                view.push(&channel, [1250.0, 4000.0], time_ns, &second);
            }
        }
        score.heard(&heard(2, 702, 1510.0));
        score.heard(&heard(3, 740, 3000.0));
        let [met] = &view.with(|shown| score.meet(shown))[..] else { panic!("one channel") };
        let found = met.meeting.score;
        assert_eq!((found.hits, found.misses, found.confirmed, found.false_alarms), (1, 1, 1, 1));
        assert_eq!((met.meeting.squeals_not_judged, met.squeals.len()), (0, 2), "the first is forgotten");
        assert!((met.judged_s - 600.0).abs() < 11.0, "{}", met.judged_s);
    }
}
