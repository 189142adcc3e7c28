//! The sound of a simulated session: modes that are predicted to be unstable grow at their predicted rates.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;

use super::against::for_each_prediction;
use super::{finite, write_file};
use crate::files::whole_file::write_whole;
use crate::import::wav;
use crate::msgs::{Header, Prediction, Time, Waveform};
use crate::offline::score::unstable;
use crate::recording::reader::Recording;
use crate::simulator;
use crate::sound::simulated::{Drive, Planted, SimulatedSound, SoundSettings};
use crate::sound::waveform::stamp_ns;

/// Modes that are not unstable decay at least at this rate, 1/s.
const LEAST_DECAY_PER_S: f64 = 50.0;
/// A prediction holds for at most this long, s.
const HOLDS_S: f64 = 0.5;
/// Longest sound, s.
const LONGEST_S: f64 = 4.0 * 3600.0;

/// Whether a simulated session sounds
#[derive(Clone, Debug, Args)]
pub struct SoundOptions {
    /// Also write the sound of the session, in Pa, and its squeals as JSON: unstable modes grow at their
    /// predicted rates up to 95 dB(A). `hear WAV --unit Pa --against DIR/...` compares them with the predictions
    #[arg(long, value_name = "WAV", requires = "record")]
    sound: Option<PathBuf>,
    /// Level of a squeal above the noise in the band from 1.25 to 16 kHz, dB
    #[arg(long, value_name = "DB", value_parser = finite, default_value = "30", requires = "sound", allow_negative_numbers = true)]
    snr_db: f64,
}

/// Samples in a block of live sound: 20 ms.
const BLOCK: usize = 1024;
/// Level of the squeals of live sound above the noise, dB.
const LIVE_SNR_DB: f64 = 30.0;

/// The JSON file with the squeals of the sound.
#[derive(Serialize)]
struct Truth {
    /// Stamp of the first sample and of the first prediction, ns since the epoch.
    start_ns: i64,
    sample_rate_hz: f64,
    unit: &'static str,
    saturated_db: f64,
    noise_db: f64,
    threshold_db: f64,
    squeals: Vec<Planted>,
}

/// The modes of a prediction that sound until the next one.
struct Sounding {
    stamp_ns: i64,
    drives: Vec<Drive>,
}

/// Squeals `snr_db` above the noise.
fn settings(seed: u64, snr_db: f64) -> SoundSettings {
    let defaults = SoundSettings::default();
    SoundSettings { seed, noise_db: defaults.saturated_db - snr_db, ..defaults }
}

/// The unstable modes of a prediction, which grow.
fn drives(prediction: &Prediction) -> Vec<Drive> {
    let growing = unstable(prediction).into_iter().map(|mode| Drive {
        mode_id: mode.mode_id,
        frequency_hz: mode.frequency_hz,
        growth_rate_per_s: mode.growth_rate_per_s,
    });
    growing.collect()
}

/// The microphone of a rig that is simulated while the node runs.
pub struct LiveSound {
    sound: SimulatedSound,
    sample_rate_hz: f64,
    /// Stamp of the first sample.
    start_ns: i64,
    /// Number of samples so far.
    count: u64,
}

impl LiveSound {
    /// Sound whose first sample has the stamp `start_ns`.
    pub fn new(seed: u64, start_ns: i64) -> Self {
        let settings = settings(seed, LIVE_SNR_DB);
        Self { sample_rate_hz: settings.sample_rate_hz, sound: SimulatedSound::new(settings), start_ns, count: 0 }
    }

    /// The next block, in which the unstable modes of the `latest` prediction grow; `None` if it is not complete before
    /// `time_s`, the time since the first sample.
    pub fn next_before(&mut self, time_s: f64, latest: impl FnOnce() -> Option<Prediction>) -> Option<Waveform> {
        let end_s = (self.count + BLOCK as u64) as f64 / self.sample_rate_hz;
        if end_s > time_s {
            return None;
        }
        let mut samples = Vec::with_capacity(BLOCK);
        let drives = latest().as_ref().map(drives).unwrap_or_default();
        self.sound.advance(&drives, LEAST_DECAY_PER_S, BLOCK, &mut samples);
        let stamp = Time::from_ns(stamp_ns(self.start_ns, self.count, self.sample_rate_hz));
        self.count += BLOCK as u64;
        Some(Waveform {
            header: Header { stamp, frame_id: simulator::FRAME_ID.to_owned() },
            channel: "microphone".to_owned(),
            sample_rate_hz: self.sample_rate_hz,
            unit: "Pa".to_owned(),
            sensitivity: String::new(),
            samples,
        })
    }
}

impl SoundOptions {
    /// Writes the sound of a recorded session.
    ///
    /// # Errors
    /// The recording holds no predictions or lasts too long; a file cannot be written.
    pub fn write(&self, recording: &Path, seed: u64) -> anyhow::Result<()> {
        let Some(path) = &self.sound else { return Ok(()) };
        let recording = Recording::open(recording)?;
        let mut predictions: Vec<Sounding> = vec![];
        for_each_prediction(&recording, |prediction| {
            predictions.push(Sounding { stamp_ns: prediction.header.stamp.as_ns(), drives: drives(prediction) });
        });
        let (Some(first), Some(last)) = (predictions.first(), predictions.last()) else {
            bail!("--sound: the session holds no predictions");
        };
        let start_ns = first.stamp_ns;
        let duration_s = last.stamp_ns.saturating_sub(start_ns) as f64 * 1e-9 + HOLDS_S;
        if !(0.0..=LONGEST_S).contains(&duration_s) {
            bail!("--sound: the session lasts {duration_s:.0} s, expected at most {LONGEST_S}");
        }
        let settings = settings(seed, self.snr_db);
        let SoundSettings { sample_rate_hz, saturated_db, noise_db, threshold_db, .. } = settings;
        let count = (duration_s * sample_rate_hz) as u32;
        let mut sound = SimulatedSound::new(settings);
        write_whole(path, |out| {
            wav::write_header(out, sample_rate_hz as u32, count)?;
            let mut samples = vec![];
            let mut written = 0;
            let stamps = predictions.iter().skip(1).map(|next| next.stamp_ns).chain([i64::MAX]);
            for (prediction, next_ns) in predictions.iter().zip(stamps) {
                let until = |ns: i64| (ns.saturating_sub(start_ns) as f64 * 1e-9 * sample_rate_hz).round() as u64;
                let holds_ns = prediction.stamp_ns.saturating_add((HOLDS_S * 1e9) as i64);
                for (end_ns, drives) in [(next_ns.min(holds_ns), prediction.drives.as_slice()), (next_ns, &[])] {
                    // In pieces: a long silence takes no more memory than a short one.
                    let end = until(end_ns).min(count.into());
                    while written < end {
                        let piece = (end - written).min(sample_rate_hz as u64) as usize;
                        samples.clear();
                        sound.advance(drives, LEAST_DECAY_PER_S, piece, &mut samples);
                        wav::write_samples(out, &samples)?;
                        written += piece as u64;
                    }
                }
            }
            Ok(())
        })?;
        let squeals = sound.planted();
        let truth = Truth { start_ns, sample_rate_hz, unit: "Pa", saturated_db, noise_db, threshold_db, squeals };
        let json = path.with_extension("json");
        write_file(&json, (serde_json::to_string_pretty(&truth)? + "\n").as_bytes())
            .with_context(|| json.display().to_string())?;
        note!("{}: {duration_s:.1} s of sound; {}: {} squeals", path.display(), json.display(), truth.squeals.len());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::Mode;
    use crate::sound::{Channel, Detection, Detector, Settings, Unit};

    /// A mode of 3112.7 Hz that grows by 400 1/s from 0.5 s on. From 30 to 95 dB(A) it needs 0.02 s, and it passes the
    /// threshold of 70 dB(A) after 0.012 s.
    #[test]
    fn live_sound_squeals_at_the_predicted_frequency() {
        let mode = Mode { id: 15, frequency_hz: 3112.7, growth_rate_per_s: 400.0, ..Mode::default() };
        let unstable = Prediction { modes: vec![mode], unstable_modes: 1, ..Prediction::default() };
        let mut microphone = LiveSound::new(1, 7);
        let channel =
            Channel { name: "microphone".to_owned(), sample_rate_hz: 51_200.0, unit: Unit::Pascal, sensitivity: None };
        let mut detector = Detector::new(&channel, Settings::default()).expect("the defaults are valid");
        let (mut blocks, mut found) = (0, vec![]);
        for millisecond in 0..=1500 {
            let time_s = 1e-3 * f64::from(millisecond);
            while let Some(block) = microphone.next_before(time_s, || (time_s >= 0.5).then(|| unstable.clone())) {
                assert!(block.header.stamp.as_ns() == 7 + 20_000_000 * blocks && block.samples.len() == BLOCK);
                detector.push(block.header.stamp.as_ns(), &block.samples, &mut found);
                blocks += 1;
            }
        }
        detector.finish(&mut found);
        assert_eq!(blocks, 75);
        let squeals: Vec<_> = found.into_iter().filter_map(Detection::ended).collect();
        let [squeal] = &squeals[..] else { panic!("{squeals:?}") };
        assert!((squeal.frequency_hz - 3112.7).abs() < 1.0, "{squeal:?}");
        // The block that is complete at 0.5 s is the first to sound; it begins 0.02 s before.
        assert!((squeal.onset_ns as f64 * 1e-9 - 0.492).abs() < 0.01, "{squeal:?}");
    }
}
