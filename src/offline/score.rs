//! Scores the predictions of a recording against the squeals that were found in its sound.

use std::collections::BTreeMap;

use crate::msgs::{Heard, Prediction, level};
use crate::recording::message::Payload;
use crate::sound::matching::{Criteria, Listened, Meeting, Predictions, Unstable};
use crate::sound::search::end_ns;
use crate::sound::{Growth, Harmonic, Squeal};

/// The predictions and squeals of a recording.
#[derive(Clone, Debug)]
pub struct HeardAndPredicted {
    band_hz: [f64; 2],
    predictions: Predictions,
    channels: BTreeMap<String, HeardChannel>,
}

/// A channel of sound.
#[derive(Clone, Debug, Default)]
struct HeardChannel {
    /// By number; of a squeal whose end was recorded, as it was at its end.
    squeals: BTreeMap<u64, Squeal>,
    /// Time of the first recorded sample, and after the last.
    listened_ns: Option<(i64, i64)>,
}

/// The comparison of a channel.
#[derive(Clone, Debug, PartialEq)]
pub struct MetChannel {
    pub channel: String,
    pub squeals: Vec<Squeal>,
    /// Time judged: in which there were both sound and predictions, s.
    pub judged_s: f64,
    /// Whether the samples were recorded. If not, the channel is taken to have been received all the time.
    pub has_samples: bool,
    pub meeting: Meeting,
}

/// The unstable modes of a prediction.
pub fn unstable(prediction: &Prediction) -> Vec<Unstable> {
    let mut growing: Vec<Unstable> = prediction
        .modes
        .iter()
        .filter(|mode| mode.growth_rate_per_s > 0.0)
        .map(|mode| Unstable {
            mode_id: mode.id,
            frequency_hz: mode.frequency_hz,
            growth_rate_per_s: mode.growth_rate_per_s,
        })
        .collect();
    // Modes that grow by less than the threshold of instability are counted as stable.
    growing.sort_by(|a, b| b.growth_rate_per_s.total_cmp(&a.growth_rate_per_s));
    growing.truncate(prediction.unstable_modes as usize);
    growing
}

/// Adds a prediction to those that squeals are compared with.
pub fn add(predictions: &mut Predictions, prediction: &Prediction) {
    let squealing = if prediction.level == level::SQUEAL { unstable(prediction) } else { vec![] };
    let warns = matches!(prediction.level, level::WARN | level::SQUEAL);
    predictions.push(prediction.header.stamp.as_ns(), warns, &squealing);
}

/// The squeal that a message is about.
fn squeal_of(heard: &Heard) -> Squeal {
    let (rate_per_s, low_per_s, high_per_s) =
        (heard.growth_rate_per_s, heard.growth_rate_low_per_s, heard.growth_rate_high_per_s);
    let order = heard.harmonic_order;
    Squeal {
        number: heard.number,
        onset_ns: heard.header.stamp.as_ns(),
        end_ns: heard.end_stamp.as_ns(),
        cut: [heard.cut_at_onset, heard.cut_at_end],
        frequency_hz: heard.frequency_hz,
        level_db: heard.level_db,
        peak_level_db: heard.peak_level_db,
        prominence_db: heard.prominence_db,
        growth: rate_per_s.is_finite().then_some(Growth { rate_per_s, low_per_s, high_per_s, span_db: f64::NAN }),
        harmonic: (order > 0).then_some(Harmonic { order, of: heard.harmonic_of }),
    }
}

impl HeardAndPredicted {
    /// Nothing yet; squeal is searched for in `band_hz`.
    pub fn new(band_hz: [f64; 2]) -> Self {
        Self { band_hz, predictions: Predictions::default(), channels: BTreeMap::new() }
    }

    /// Adds a recorded message; others than predictions, samples and squeals are ignored.
    pub fn take(&mut self, payload: &Payload) {
        match payload {
            Payload::Prediction(prediction) => add(&mut self.predictions, prediction),
            Payload::Heard(heard) => {
                let channel = self.channels.entry(heard.channel.clone()).or_default();
                channel.squeals.insert(heard.number, squeal_of(heard));
            }
            Payload::Waveform(block) => {
                let (from_ns, to_ns) = (block.header.stamp.as_ns(), end_ns(block));
                let channel = self.channels.entry(block.channel.clone()).or_default();
                let (first, last) = channel.listened_ns.unwrap_or((from_ns, to_ns));
                channel.listened_ns = Some((first.min(from_ns), last.max(to_ns)));
            }
            Payload::OperatingPoint(_)
            | Payload::Vibration(_)
            | Payload::Temperature(_)
            | Payload::SessionEvent(_)
            | Payload::RigInfo(_)
            | Payload::Sensitivity(_)
            | Payload::Diagnostics(_) => {}
        }
    }

    /// Sets the band in which squeal is searched for.
    pub fn set_band_hz(&mut self, band_hz: [f64; 2]) {
        self.band_hz = band_hz;
    }

    /// Adds a prediction: its stamp, whether its level is at least WARN, and the modes that squeal in it.
    pub fn predicted(&mut self, stamp_ns: i64, warns: bool, squealing: &[Unstable]) {
        self.predictions.push(stamp_ns, warns, squealing);
    }

    /// Sets the time of the samples of a channel.
    pub fn listened(&mut self, channel: &str, from_ns: i64, to_ns: i64) {
        self.channels.entry(channel.to_owned()).or_default().listened_ns = Some((from_ns, to_ns));
    }

    /// Forgets squeals and predicted squeals that ended before `stamp_ns`.
    pub fn forget_before(&mut self, stamp_ns: i64) {
        self.predictions.forget_before(stamp_ns);
        for channel in self.channels.values_mut() {
            channel.squeals.retain(|_, squeal| squeal.end_ns >= stamp_ns);
        }
    }

    /// The predicted squeals, to which false alarms are indices.
    pub fn predictions(&self) -> &Predictions {
        &self.predictions
    }

    /// The comparison of every channel that has a time in common with the predictions.
    pub fn meet(&self, criteria: &Criteria) -> Vec<MetChannel> {
        let Some(span) = self.predictions.span_ns() else { return vec![] };
        let met = self.channels.iter().filter_map(|(name, channel)| {
            let (from_ns, to_ns) = channel.listened_ns.unwrap_or(span);
            let mut squeals: Vec<Squeal> = channel.squeals.values().copied().collect();
            squeals.sort_by_key(|squeal| (squeal.onset_ns, squeal.number));
            let listened = Listened { from_ns, to_ns, band_hz: self.band_hz };
            let meeting = self.predictions.meet(&squeals, &listened, criteria)?;
            let judged_ns = to_ns.min(span.1).saturating_sub(from_ns.max(span.0));
            Some(MetChannel {
                channel: name.clone(),
                squeals,
                judged_s: judged_ns as f64 * 1e-9,
                has_samples: channel.listened_ns.is_some(),
                meeting,
            })
        });
        met.collect()
    }
}
