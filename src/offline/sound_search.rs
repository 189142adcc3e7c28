//! Searches the samples of an offline session for squeal, as the node does, in the time of the stamps.

use std::collections::{BTreeMap, VecDeque};

use crate::msgs::{Heard, Prediction, Waveform, heard_state, level};
use crate::node::in_force;
use crate::sound::Settings;
use crate::sound::in_force::{InForce, choose};
use crate::sound::matching::Criteria;
use crate::sound::search::{ChannelSearch, channel_of};

/// Predictions that are kept for comparison: 1.6 s at 40 kHz. A squeal is compared when it is announced, 0.2 s after its
/// onset, and again 0.5 s after it, with predictions from 0.5 s before.
const PREDICTIONS: usize = 1 << 16;
/// Number of channels; blocks of further ones are refused.
const MOST_CHANNELS: usize = 64;

/// What was found in the samples of a session.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SoundFound {
    pub channels: usize,
    pub samples: u64,
    pub missing_samples: u64,
    pub squeals: u64,
    /// Blocks that cannot be searched, and why the first of them.
    pub refused: u64,
    pub why_refused: Option<String>,
}

/// The search of a session.
pub(super) struct SoundSearch {
    settings: Settings,
    channels: BTreeMap<String, ChannelSearch>,
    predictions: VecDeque<InForce>,
    found: SoundFound,
}

impl SoundSearch {
    pub fn new(settings: Settings) -> Self {
        Self { settings, channels: BTreeMap::new(), predictions: VecDeque::new(), found: SoundFound::default() }
    }

    /// Keeps a prediction for comparison.
    pub fn predicted(&mut self, prediction: &Prediction) {
        if prediction.level == level::FAULT {
            return;
        }
        if self.predictions.len() == PREDICTIONS {
            self.predictions.pop_front();
        }
        self.predictions.push_back(in_force(prediction));
    }

    /// Searches a block; returns the messages about what was found.
    pub fn block(&mut self, block: &Waveform) -> Vec<Heard> {
        let heard = self.search(block).unwrap_or_else(|why| {
            self.found.refused += 1;
            self.found.why_refused.get_or_insert(why);
            vec![]
        });
        self.count(heard)
    }

    /// # Errors
    /// Why the block cannot be searched.
    fn search(&mut self, block: &Waveform) -> Result<Vec<Heard>, String> {
        let Self { settings, channels, predictions, .. } = self;
        let choose = |squeal: &_, criteria: &_| choose(squeal, predictions.iter(), criteria);
        let channel = channel_of(block)?;
        let mut heard = vec![];
        let is_full = channels.len() == MOST_CHANNELS;
        match channels.get_mut(&block.channel) {
            Some(known) if *known.channel() == channel => {}
            Some(known) => heard = known.change(channel, choose).map_err(|error| error.to_string())?,
            None if is_full => {
                return Err(format!("channel `{}`: there are {MOST_CHANNELS} channels already", block.channel));
            }
            None => {
                let search = ChannelSearch::new(channel, *settings, Criteria::default());
                channels.insert(block.channel.clone(), search.map_err(|error| error.to_string())?);
            }
        }
        if let Some(search) = channels.get_mut(&block.channel) {
            heard.extend(search.push(block.header.stamp.as_ns(), &block.samples, choose));
        }
        Ok(heard)
    }

    /// Ends the squeals that last.
    pub fn finish(&mut self) -> Vec<Heard> {
        let Self { channels, predictions, .. } = self;
        let choose = |squeal: &_, criteria: &_| choose(squeal, predictions.iter(), criteria);
        let heard = channels.values_mut().flat_map(|search| search.finish(choose)).collect();
        self.count(heard)
    }

    fn count(&mut self, heard: Vec<Heard>) -> Vec<Heard> {
        self.found.squeals += heard.iter().filter(|heard| heard.state == heard_state::ENDED).count() as u64;
        heard
    }

    /// What was found so far.
    pub fn found(self) -> SoundFound {
        let mut found = self.found;
        found.channels = self.channels.len();
        for counts in self.channels.values().map(ChannelSearch::counts) {
            found.samples += counts.samples;
            found.missing_samples = found.missing_samples.saturating_add(counts.missing);
        }
        found
    }
}
