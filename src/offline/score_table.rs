//! Scores of recordings as rows of a table.

use serde::Serialize;

use super::score::{HeardAndPredicted, MetChannel};
use super::verify_sound::recorded_settings;
use crate::recording::reader::{Recorded, Recording};
use crate::sound::matching::{Criteria, Score, Slots, median};

/// The scores of a channel of a recording, or their sum; a line of the CSV file. Every score stands beside its counts.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    /// Empty in the sum.
    pub recording: String,
    pub channel: String,
    pub judged_s: f64,
    /// Squeals found in the sound: predicted, not predicted, harmonics of others, and outside the time of predictions.
    pub hits: u64,
    pub misses: u64,
    pub harmonics: u64,
    pub squeals_not_judged: u64,
    /// Predicted squeals: found in the sound, not found, and outside the time or band of the sound.
    pub confirmed: u64,
    pub false_alarms: u64,
    pub predictions_not_judged: u64,
    pub recall: Option<f64>,
    pub precision: Option<f64>,
    /// Of slots of time of `slot_s`: with a hit, a miss, a false alarm, and with nothing.
    pub mcc: Option<f64>,
    pub slot_s: f64,
    pub slots_hit: u64,
    pub slots_missed: u64,
    pub slots_false_alarm: u64,
    pub slots_quiet: u64,
    /// Of the hits: from the warning to the onset.
    pub least_lead_s: Option<f64>,
    pub median_lead_s: Option<f64>,
    pub longest_lead_s: Option<f64>,
}

/// Sums of rows, from which their scores follow.
#[derive(Default)]
pub struct Sum {
    row: Row,
    score: Score,
    slots: Slots,
    leads_s: Vec<f64>,
}

impl Sum {
    /// Adds a channel.
    pub fn add(&mut self, met: &MetChannel) {
        let meeting = &met.meeting;
        self.score += meeting.score;
        self.slots += meeting.slots;
        self.leads_s.extend(meeting.leads_s());
        self.row.judged_s += met.judged_s;
        self.row.harmonics += meeting.harmonics;
        self.row.squeals_not_judged += meeting.squeals_not_judged;
        self.row.predictions_not_judged += meeting.predictions_not_judged;
        self.row.slot_s = self.row.slot_s.max(meeting.slot_s);
    }

    /// Counts and scores of all that was added.
    pub fn row(mut self) -> Row {
        self.leads_s.sort_by(f64::total_cmp);
        let (score, slots, leads) = (self.score, self.slots, &self.leads_s);
        Row {
            hits: score.hits,
            misses: score.misses,
            confirmed: score.confirmed,
            false_alarms: score.false_alarms,
            recall: score.recall(),
            precision: score.precision(),
            mcc: slots.mcc(),
            slots_hit: slots.hits,
            slots_missed: slots.misses,
            slots_false_alarm: slots.false_alarms,
            slots_quiet: slots.quiet,
            least_lead_s: leads.first().copied(),
            median_lead_s: median(leads),
            longest_lead_s: leads.last().copied(),
            ..self.row
        }
    }
}

/// The comparison of the channels of a recording, and whether data of it was lost.
pub fn met(recording: &Recording, criteria: &Criteria) -> (Vec<MetChannel>, bool) {
    let mut found = HeardAndPredicted::new(recorded_settings(recording).band_hz);
    let mut messages = recording.messages();
    for entry in messages.by_ref() {
        if let Recorded::Known(payload) = entry.message {
            found.take(&payload);
        }
    }
    let lost = recording.damage().iter().chain(messages.damage()).any(|damage| damage.damage.loses_data);
    (found.meet(criteria), lost)
}
