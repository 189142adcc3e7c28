//! What the page shows of sound: scores with their counts, and a spectrogram as a picture.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::figures::png::png;
use crate::figures::spectrogram::{highest, pixels};
use crate::offline::score::MetChannel;
use crate::sound::matching::{Slots, median};
use crate::sound::spectrogram::{STEP_DB, Spectrogram};

/// Channels and scores.
#[derive(Clone, Debug, Default, Serialize)]
pub struct SoundShown {
    /// Names of the channels with a spectrogram.
    pub channels: Vec<String>,
    pub scores: Vec<ScoreShown>,
}

/// The scores of a channel with their counts.
#[derive(Clone, Debug, Serialize)]
pub struct ScoreShown {
    pub channel: String,
    /// Time with both sound and predictions, s.
    pub judged_s: f64,
    pub hits: u64,
    pub misses: u64,
    pub confirmed: u64,
    pub false_alarms: u64,
    pub recall: Option<f64>,
    pub precision: Option<f64>,
    pub mcc: Option<f64>,
    pub slots: Slots,
    /// Of the hits, from the warning to the onset.
    pub median_lead_s: Option<f64>,
}

/// A spectrogram as a picture, and the time and frequencies it covers.
#[derive(Clone, Debug)]
pub struct SpectrogramPicture {
    width: u32,
    height: u32,
    pixels: Vec<u8>,
    pub covers: Covers,
}

impl SpectrogramPicture {
    /// The picture as a PNG file. It takes longer than making the picture, during which the search of a node may wait.
    pub fn png(&self) -> Vec<u8> {
        png(self.width, self.height, &self.pixels)
    }
}

/// From the left to the right and from the bottom to the top of a spectrogram.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Covers {
    /// s since the epoch.
    pub from_s: f64,
    pub to_s: f64,
    pub bottom_hz: f64,
    pub top_hz: f64,
    /// Height of a row.
    pub row_hz: f64,
    /// Level of the lightest colour, dB; the darkest is 80 dB below.
    pub highest_db: f64,
    /// Length up to which a part of it can be shown in detail, s; 0 if none can, since samples are not kept.
    pub longest_part_s: f64,
}

impl SoundShown {
    pub fn new(spectrograms: &BTreeMap<String, Spectrogram>, met: &[MetChannel]) -> Self {
        let score = |met: &MetChannel| {
            let (score, slots) = (met.meeting.score, met.meeting.slots);
            ScoreShown {
                channel: met.channel.clone(),
                judged_s: met.judged_s,
                hits: score.hits,
                misses: score.misses,
                confirmed: score.confirmed,
                false_alarms: score.false_alarms,
                recall: score.recall(),
                precision: score.precision(),
                mcc: slots.mcc(),
                slots,
                median_lead_s: median(&met.meeting.leads_s()),
            }
        };
        Self { channels: spectrograms.keys().cloned().collect(), scores: met.iter().map(score).collect() }
    }
}

/// The picture of a spectrogram; `None` if it is empty. A part of another one has the colours of that, `whole`.
pub fn picture(spectrogram: &Spectrogram, whole: &Spectrogram, longest_part_s: f64) -> Option<SpectrogramPicture> {
    let first = spectrogram.columns().front()?.index;
    let highest = highest(whole);
    let (width, height, pixels) = pixels(spectrogram, highest);
    let column_s = spectrogram.column_ns() as f64 * 1e-9;
    let covers = Covers {
        from_s: first as f64 * column_s,
        to_s: (first + i64::from(width)) as f64 * column_s,
        bottom_hz: spectrogram.bottom_hz(),
        top_hz: spectrogram.top_hz(),
        row_hz: (spectrogram.top_hz() - spectrogram.bottom_hz()) / f64::from(height),
        highest_db: spectrogram.lowest_db() + STEP_DB * f64::from(highest),
        longest_part_s,
    };
    Some(SpectrogramPicture { width, height, pixels, covers })
}
