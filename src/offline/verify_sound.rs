//! Searches recorded samples for squeal again and compares with the recorded messages about squeals, byte for byte.
//!
//! The prediction that a squeal was compared with is the one that its message names: which predictions were known in time
//! is not recorded.

use std::collections::{BTreeMap, HashMap, HashSet};

use bytes::Bytes;

use crate::msgs::{self, Heard, Time, heard_state};
use crate::node::in_force;
use crate::recording::message::Payload;
use crate::recording::reader::{Recorded, Recording};
use crate::sound::in_force::{InForce, message};
use crate::sound::matching::Criteria;
use crate::sound::search::channel_of;
use crate::sound::{Channel, Detection, Detector, Quantity, Settings, Squeal};

/// Number of differences described in words; all others are only counted.
const DESCRIBED: usize = 10;

/// Result of a verification of sound.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SoundVerification {
    pub channels: usize,
    pub samples: u64,
    /// Samples that are not in the recording.
    pub missing_samples: u64,
    /// Messages about squeals that agree byte for byte, and that differ.
    pub identical: u64,
    pub different: u64,
    /// Messages that are only in the recording, and that were only found now.
    pub missing: u64,
    pub extra: u64,
    /// Descriptions of the first differences.
    pub described: Vec<String>,
}

impl SoundVerification {
    /// Whether every recorded squeal was found again, and no other.
    pub fn agrees(&self) -> bool {
        self.different + self.missing + self.extra == 0
    }

    fn describe(&mut self, text: impl FnOnce() -> String) {
        if self.described.len() < DESCRIBED {
            self.described.push(text());
        }
    }
}

/// The definition of squeal with which `recording` was made; the default if it does not say.
pub fn recorded_settings(recording: &Recording) -> Settings {
    let mut settings = Settings::default();
    for (name, value) in settings.values_mut() {
        let recorded = recording.session_metadata(&metadata_key(name)).and_then(|text| text.parse().ok());
        *value = recorded.unwrap_or(*value);
    }
    settings
}

/// The metadata of a recording that name the definition of squeal.
pub fn settings_metadata(mut settings: Settings) -> Vec<(String, String)> {
    settings.values_mut().map(|(name, value)| (metadata_key(name), value.to_string())).into()
}

fn metadata_key(setting: &str) -> String {
    format!("sound_{setting}")
}

type Key = (String, u64, u8);

/// Searches the samples of `recording` with these settings. `None` if it contains no samples.
pub fn verify_sound(recording: &Recording, settings: Settings) -> Option<SoundVerification> {
    let mut recorded: HashMap<Key, (Heard, Bytes)> = HashMap::new();
    let mut samples = false;
    for entry in recording.messages() {
        match entry.message {
            Recorded::Known(Payload::Heard(heard)) => {
                recorded.insert((heard.channel.clone(), heard.number, heard.state), (heard, entry.cdr));
            }
            Recorded::Known(Payload::Waveform(_)) => samples = true,
            _ => {}
        }
    }
    if !samples {
        return None;
    }
    let named: HashSet<(Time, u64)> =
        recorded.values().map(|(heard, _)| (heard.prediction_stamp, heard.input_seq)).collect();
    let mut predictions: HashMap<(Time, u64), InForce> = HashMap::new();
    let mut search = Search { recorded, settings, channels: BTreeMap::new(), found: SoundVerification::default() };
    let mut findings = vec![];
    for entry in recording.messages() {
        match entry.message {
            Recorded::Known(Payload::Prediction(prediction)) => {
                let key = (prediction.header.stamp, prediction.input_seq);
                if named.contains(&key) {
                    predictions.insert(key, in_force(&prediction));
                }
            }
            Recorded::Known(Payload::Waveform(block)) => search.block(&block, &mut findings),
            _ => {}
        }
    }
    search.finish(&mut findings);
    for finding in findings {
        search.compare(&finding, &predictions);
    }
    for (heard, _) in std::mem::take(&mut search.recorded).into_values() {
        search.found.missing += 1;
        search.found.describe(|| format!("{}: recorded, not found now", words(&heard)));
    }
    Some(search.found)
}

/// A finding, with what its message is made of.
struct Finding {
    channel: String,
    quantity: Quantity,
    earlier: u64,
    squeal: Squeal,
    state: u8,
    /// Whether the end of the recording ended it.
    cut_off: bool,
}

struct Searched {
    channel: Channel,
    detector: Detector,
    earlier: u64,
    squeals: u64,
}

struct Search {
    recorded: HashMap<Key, (Heard, Bytes)>,
    settings: Settings,
    channels: BTreeMap<String, Searched>,
    found: SoundVerification,
}

impl Search {
    fn block(&mut self, block: &msgs::Waveform, findings: &mut Vec<Finding>) {
        let channel = match channel_of(block) {
            Ok(channel) => channel,
            Err(why) => return self.found.describe(|| why),
        };
        if self.channels.get(&block.channel).is_none_or(|searched| searched.channel != channel) {
            let detector = match Detector::new(&channel, self.settings) {
                Ok(detector) => detector,
                Err(error) => return self.found.describe(|| error.to_string()),
            };
            let mut before = self.channels.remove(&block.channel);
            if let Some(before) = &mut before {
                self.end(before, false, findings);
            }
            let earlier = before.map_or(0, |before| before.squeals);
            let searched = Searched { channel, detector, earlier, squeals: earlier };
            self.channels.insert(block.channel.clone(), searched);
        }
        let Some(searched) = self.channels.get_mut(&block.channel) else { return };
        let mut found = vec![];
        searched.detector.push(block.header.stamp.as_ns(), &block.samples, &mut found);
        searched.take(found, false, findings);
    }

    /// Ends the squeals of a channel that last; `cut_off` at the end of the recording.
    fn end(&mut self, searched: &mut Searched, cut_off: bool, findings: &mut Vec<Finding>) {
        let mut found = vec![];
        searched.detector.finish(&mut found);
        searched.take(found, cut_off, findings);
        let counts = searched.detector.counts();
        self.found.samples += counts.samples;
        self.found.missing_samples = self.found.missing_samples.saturating_add(counts.missing);
    }

    fn finish(&mut self, findings: &mut Vec<Finding>) {
        for (_, mut searched) in std::mem::take(&mut self.channels) {
            self.found.channels += 1;
            self.end(&mut searched, true, findings);
        }
    }

    fn compare(&mut self, finding: &Finding, predictions: &HashMap<(Time, u64), InForce>) {
        let Finding { channel, quantity, earlier, squeal, state, cut_off } = finding;
        let recorded = self.recorded.remove(&(channel.clone(), earlier + squeal.number, *state));
        let chosen =
            recorded.as_ref().and_then(|(heard, _)| predictions.get(&(heard.prediction_stamp, heard.input_seq)));
        let heard = message(channel, *quantity, *earlier, squeal, *state, chosen, &Criteria::default());
        match recorded {
            Some((_, bytes)) if msgs::to_cdr(&heard).is_ok_and(|found| found == bytes) => self.found.identical += 1,
            Some((recorded, _)) => {
                self.found.different += 1;
                self.found.describe(|| format!("recorded {}; now {}", words(&recorded), words(&heard)));
            }
            // A node that was killed did not end its squeals.
            None if *cut_off => {}
            None => {
                self.found.extra += 1;
                self.found.describe(|| format!("{}: found now, not recorded", words(&heard)));
            }
        }
    }
}

impl Searched {
    fn take(&mut self, found: Vec<Detection>, cut_off: bool, findings: &mut Vec<Finding>) {
        for detection in found {
            let (squeal, state) = match detection {
                Detection::Began(squeal) => (squeal, heard_state::BEGAN),
                Detection::Ended(squeal) => (squeal, heard_state::ENDED),
            };
            self.squeals = self.squeals.max(self.earlier + squeal.number);
            findings.push(Finding {
                channel: self.channel.name.clone(),
                quantity: self.detector.quantity(),
                earlier: self.earlier,
                squeal,
                state,
                cut_off,
            });
        }
    }
}

fn words(heard: &Heard) -> String {
    let Heard { channel, number, frequency_hz, level_db, .. } = heard;
    let state = if heard.state == heard_state::BEGAN { "began" } else { "ended" };
    format!("squeal {number} of `{channel}` {state}, {frequency_hz} Hz, {level_db} dB")
}
