//! The sound of a simulated session: modes that are predicted to be unstable grow at their predicted rates.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;

use super::against::{for_each_prediction, unstable};
use super::{finite, write_file};
use crate::files::whole_file::write_whole;
use crate::import::wav;
use crate::recording::reader::Recording;
use crate::sound::simulated::{Drive, Planted, SimulatedSound, SoundSettings};

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
            let growing = unstable(prediction).into_iter().map(|mode| Drive {
                mode_id: mode.mode_id,
                frequency_hz: mode.frequency_hz,
                growth_rate_per_s: mode.growth_rate_per_s,
            });
            predictions.push(Sounding { stamp_ns: prediction.header.stamp.as_ns(), drives: growing.collect() });
        });
        let (Some(first), Some(last)) = (predictions.first(), predictions.last()) else {
            bail!("--sound: the session holds no predictions");
        };
        let start_ns = first.stamp_ns;
        let duration_s = last.stamp_ns.saturating_sub(start_ns) as f64 * 1e-9 + HOLDS_S;
        if !(0.0..=LONGEST_S).contains(&duration_s) {
            bail!("--sound: the session lasts {duration_s:.0} s, expected at most {LONGEST_S}");
        }
        let defaults = SoundSettings::default();
        let settings = SoundSettings { seed, noise_db: defaults.saturated_db - self.snr_db, ..defaults };
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
