//! Searches one channel for squeal, and makes the messages about what it finds: in the running node and offline.

use std::collections::BTreeMap;

use super::in_force::{self, InForce};
use super::matching::Criteria;
use super::waveform::stamp_ns;
use super::{Channel, Counts, Detection, Detector, DetectorError, Interruption, Settings, Squeal};
use crate::msgs::{Heard, Waveform, heard_state};

/// The search of one channel. Should the channel change (its rate, unit or sensitivity), a new detector continues it.
pub struct ChannelSearch {
    channel: Channel,
    settings: Settings,
    criteria: Criteria,
    detector: Detector,
    /// Squeals of earlier detectors of this channel, and of all.
    earlier: u64,
    squeals: u64,
    lasting: BTreeMap<u64, Lasting>,
    /// Counts of earlier detectors.
    counts_before: Counts,
}

/// A squeal that lasts, and the prediction it is compared with.
struct Lasting {
    began: Squeal,
    chosen: Option<InForce>,
    /// Whether all predictions within the time tolerance have been considered.
    decided: bool,
}

/// The channel that a block describes.
///
/// # Errors
/// Why its unit or sensitivity is invalid.
pub fn channel_of(block: &Waveform) -> Result<Channel, String> {
    let Waveform { channel, sample_rate_hz, unit, sensitivity, .. } = block;
    let failed = |error: String| format!("channel `{channel}`: {error}");
    let sensitivity = if sensitivity.is_empty() {
        None
    } else {
        Some(sensitivity.parse().map_err(|error: super::waveform::SensitivityError| failed(error.to_string()))?)
    };
    let unit = unit.parse().map_err(|error: super::waveform::UnitError| failed(error.to_string()))?;
    Ok(Channel { name: channel.clone(), sample_rate_hz: *sample_rate_hz, unit, sensitivity })
}

/// When a block of samples is complete: one interval after its last sample, ns.
pub fn end_ns(block: &Waveform) -> i64 {
    stamp_ns(block.header.stamp.as_ns(), block.samples.len() as u64, block.sample_rate_hz)
}

impl ChannelSearch {
    /// A search for squeal as `settings` define it, compared with predictions by `criteria`.
    ///
    /// # Errors
    /// [`DetectorError`]: the channel cannot be searched.
    pub fn new(channel: Channel, settings: Settings, criteria: Criteria) -> Result<Self, DetectorError> {
        Ok(Self {
            detector: Detector::new(&channel, settings)?,
            channel,
            settings,
            criteria,
            earlier: 0,
            squeals: 0,
            lasting: BTreeMap::new(),
            counts_before: Counts::default(),
        })
    }

    /// The channel as its latest block described it.
    pub fn channel(&self) -> &Channel {
        &self.channel
    }

    /// Squeals announced so far.
    pub fn squeals(&self) -> u64 {
        self.squeals
    }

    /// Counts of samples of all detectors.
    pub fn counts(&self) -> Counts {
        let (now, before) = (self.detector.counts(), &self.counts_before);
        Counts {
            samples: before.samples + now.samples,
            missing: before.missing.saturating_add(now.missing),
            repeated: before.repeated + now.repeated,
            not_finite: before.not_finite + now.not_finite,
            interruptions: before.interruptions + now.interruptions,
            named: vec![],
            tones_not_followed: before.tones_not_followed + now.tones_not_followed,
        }
    }

    /// The interruptions named since the last call.
    pub fn take_interruptions(&mut self) -> Vec<Interruption> {
        self.detector.take_interruptions()
    }

    /// Takes over a changed channel: its squeals that last end. Returns their messages.
    ///
    /// # Errors
    /// [`DetectorError`]: the changed channel cannot be searched; the search is then unchanged.
    pub fn change(
        &mut self,
        channel: Channel,
        choose: impl Fn(&Squeal, &Criteria) -> Option<InForce>,
    ) -> Result<Vec<Heard>, DetectorError> {
        let detector = Detector::new(&channel, self.settings)?;
        let ended = self.finish(choose);
        self.counts_before = self.counts();
        (self.detector, self.channel, self.earlier) = (detector, channel, self.squeals);
        self.lasting.clear();
        Ok(ended)
    }

    /// Searches a block of samples, the first of them taken at `first_stamp_ns`; returns the messages about what was
    /// found. `choose` gives the prediction that a squeal is compared with ([`in_force::choose`]) among those made up to
    /// now.
    pub fn push(
        &mut self,
        first_stamp_ns: i64,
        samples: &[f32],
        choose: impl Fn(&Squeal, &Criteria) -> Option<InForce>,
    ) -> Vec<Heard> {
        let mut found = vec![];
        self.detector.push(first_stamp_ns, samples, &mut found);
        let messages = found.into_iter().map(|detection| self.heard(detection, &choose)).collect();
        self.decide(stamp_ns(first_stamp_ns, samples.len() as u64, self.channel.sample_rate_hz), &choose);
        messages
    }

    /// Ends the squeals that last; returns their messages.
    pub fn finish(&mut self, choose: impl Fn(&Squeal, &Criteria) -> Option<InForce>) -> Vec<Heard> {
        let mut found = vec![];
        self.detector.finish(&mut found);
        found.into_iter().map(|detection| self.heard(detection, &choose)).collect()
    }

    /// The message about a finding.
    fn heard(&mut self, detection: Detection, choose: &impl Fn(&Squeal, &Criteria) -> Option<InForce>) -> Heard {
        let criteria = self.criteria;
        let (squeal, state, chosen) = match detection {
            Detection::Began(squeal) => {
                let chosen = choose(&squeal, &criteria);
                self.lasting.insert(squeal.number, Lasting { began: squeal, chosen, decided: false });
                self.squeals = self.earlier + squeal.number;
                (squeal, heard_state::BEGAN, chosen)
            }
            Detection::Ended(squeal) => {
                let decided = self.lasting.remove(&squeal.number).filter(|lasting| lasting.decided);
                let chosen = decided.map_or_else(|| choose(&squeal, &criteria), |lasting| lasting.chosen);
                (squeal, heard_state::ENDED, chosen)
            }
        };
        let quantity = self.detector.quantity();
        in_force::message(&self.channel.name, quantity, self.earlier, &squeal, state, chosen.as_ref(), &criteria)
    }

    /// Chooses the predictions of lasting squeals once more, when all within the time tolerance have been made: samples
    /// up to `until_ns` have been received.
    fn decide(&mut self, until_ns: i64, choose: &impl Fn(&Squeal, &Criteria) -> Option<InForce>) {
        let tolerance_ns = (self.criteria.time_tolerance_s * 1e9) as i64;
        for lasting in self.lasting.values_mut().filter(|lasting| !lasting.decided) {
            if until_ns > lasting.began.onset_ns.saturating_add(tolerance_ns) {
                lasting.chosen = choose(&lasting.began, &self.criteria);
                lasting.decided = true;
            }
        }
    }
}
