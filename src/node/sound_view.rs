//! Spectrograms of the samples that a node receives, for displays.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::sound::Channel;
use crate::sound::spectrogram::Spectrogram;

/// Number of channels shown: those received first.
const MOST_CHANNELS: usize = 8;
/// Length of a column, ns.
const COLUMN_NS: i64 = 200_000_000;
/// Number of columns: 10 minutes.
const COLUMNS: usize = 3000;

/// The spectrograms of the last ten minutes. A display looks at them; the thread that searches the samples adds to them.
#[derive(Default)]
pub struct SoundView {
    followed: AtomicBool,
    shown: Mutex<BTreeMap<String, Spectrogram>>,
}

impl SoundView {
    /// From now on, samples are added.
    pub fn follow(&self) {
        self.followed.store(true, Ordering::Relaxed);
    }

    /// Adds samples of a channel, if a display follows. A channel that changes is shown anew.
    pub fn push(&self, channel: &Channel, band_hz: [f64; 2], first_stamp_ns: i64, samples: &[f32]) {
        if !self.followed.load(Ordering::Relaxed) {
            return;
        }
        let mut shown = self.shown.lock().unwrap_or_else(PoisonError::into_inner);
        let known = shown.get(&channel.name).map(|known| known.channel() == channel);
        if known == Some(false) || known.is_none() && shown.len() < MOST_CHANNELS {
            let new = Spectrogram::latest(channel, band_hz, COLUMN_NS, COLUMNS);
            shown.extend(new.ok().map(|new| (channel.name.clone(), new)));
        }
        if let Some(spectrogram) = shown.get_mut(&channel.name) {
            spectrogram.push(first_stamp_ns, samples);
        }
    }

    /// Looks at the spectrograms by channel; the search waits meanwhile.
    pub fn with<T>(&self, look: impl FnOnce(&BTreeMap<String, Spectrogram>) -> T) -> T {
        look(&self.shown.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
