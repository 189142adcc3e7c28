//! Files of sampled sound and acceleration: WAV, Universal Files and CSV, told apart by their first bytes.
//!
//! WAV files are read in pieces; the others whole, up to [`input_file::SAMPLES`].

use std::fs::File;
use std::io::{BufReader, Read as _, Seek as _};
use std::path::Path;

use super::wav::{Wav, WavError};
use super::{samples_csv, uff58};
use crate::files::input_file;
use crate::sound::Unit;

/// Most channels of a file.
pub const MOST_CHANNELS: usize = 64;

/// A channel of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct FileChannel {
    /// Empty if the file gives none.
    pub name: String,
    pub sample_rate_hz: f64,
    /// `None` if the file gives none.
    pub unit: Option<Unit>,
    pub samples: Vec<f32>,
}

/// Why a file of samples cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum SamplesError {
    #[error("{file}: {source}")]
    Read { file: String, source: std::io::Error },
    #[error("{file}, {place}: {found}, expected {expected}")]
    Expected { file: String, place: String, found: String, expected: String },
    #[error(transparent)]
    Wav(#[from] WavError),
}

/// A file of samples that is being read.
#[derive(Debug)]
pub enum SampleFile {
    Wav(Box<Wav<BufReader<File>>>),
    Loaded {
        format: &'static str,
        channels: Vec<FileChannel>,
        /// Columns that are not read, and why.
        omitted: Vec<String>,
        /// Samples of each channel that were read.
        read: usize,
    },
}

impl SampleFile {
    /// Opens a file.
    ///
    /// # Errors
    /// [`SamplesError`], naming file, place, what is there and what was expected.
    pub fn open(path: &Path) -> Result<Self, SamplesError> {
        let file = path.display().to_string();
        let failed = |source| SamplesError::Read { file: file.clone(), source };
        let mut opened = input_file::open(path, input_file::ANY_SIZE).map_err(failed)?;
        let mut first = vec![];
        (&mut opened).take(4).read_to_end(&mut first).map_err(failed)?;
        if [b"RIFF", b"RF64", b"BW64"].iter().any(|id| first == id[..]) {
            opened.rewind().map_err(failed)?;
            return Ok(Self::Wav(Box::new(Wav::open(&file, BufReader::new(opened))?)));
        }
        let bytes = input_file::read(path, input_file::SAMPLES).map_err(failed)?;
        if uff58::is_universal_file(&bytes) {
            let channels = uff58::read(&file, &bytes)?;
            return Ok(Self::Loaded { format: "UFF 58", channels, omitted: vec![], read: 0 });
        }
        let (channels, omitted) = samples_csv::read(&file, &bytes)?;
        Ok(Self::Loaded { format: "CSV", channels, omitted, read: 0 })
    }

    /// Format and encoding, for people.
    pub fn format(&self) -> &'static str {
        match self {
            Self::Wav(wav) => wav.encoding.name(),
            Self::Loaded { format, .. } => format,
        }
    }

    pub fn channel_count(&self) -> usize {
        match self {
            Self::Wav(wav) => usize::from(wav.channels),
            Self::Loaded { channels, .. } => channels.len(),
        }
    }

    /// Sample rate of a channel, counted from 0.
    pub fn sample_rate_hz(&self, channel: usize) -> f64 {
        match self {
            Self::Wav(wav) => f64::from(wav.sample_rate_hz),
            Self::Loaded { channels, .. } => channels[channel].sample_rate_hz,
        }
    }

    /// Name of a channel; empty if the file gives none.
    pub fn name(&self, channel: usize) -> &str {
        match self {
            Self::Wav(_) => "",
            Self::Loaded { channels, .. } => &channels[channel].name,
        }
    }

    /// Unit of a channel; `None` if the file gives none.
    pub fn unit(&self, channel: usize) -> Option<Unit> {
        match self {
            Self::Wav(_) => None,
            Self::Loaded { channels, .. } => channels[channel].unit,
        }
    }

    /// Length of a channel, s.
    pub fn duration_s(&self, channel: usize) -> f64 {
        let samples = match self {
            Self::Wav(wav) => wav.frames as f64,
            Self::Loaded { channels, .. } => channels[channel].samples.len() as f64,
        };
        samples / self.sample_rate_hz(channel)
    }

    /// Bytes of samples that the file claims and does not have.
    pub fn missing_bytes(&self) -> u64 {
        match self {
            Self::Wav(wav) => wav.missing_bytes,
            Self::Loaded { .. } => 0,
        }
    }

    /// Columns that are not read, and why.
    pub fn omitted(&self) -> &[String] {
        match self {
            Self::Wav(_) => &[],
            Self::Loaded { omitted, .. } => omitted,
        }
    }

    /// Files whose channels have one sample rate, together with all channels of this one in their order.
    pub fn by_rate(self) -> Vec<Self> {
        match self {
            Self::Wav(_) => vec![self],
            Self::Loaded { format, channels, omitted: _, read } => channels
                .into_iter()
                .map(|channel| Self::Loaded { format, channels: vec![channel], omitted: vec![], read })
                .collect(),
        }
    }

    /// Appends the next samples of each channel, at most `most`; fewer, or none, of a channel that ends. Returns the
    /// largest number appended to a channel.
    ///
    /// # Errors
    /// A WAV file that cannot be read.
    pub fn read(&mut self, most: usize, samples: &mut [Vec<f32>]) -> Result<usize, SamplesError> {
        match self {
            Self::Wav(wav) => Ok(wav.read(most, samples)?),
            Self::Loaded { channels, read, .. } => {
                let mut appended = 0;
                for (channel, samples) in channels.iter().zip(samples) {
                    let rest = channel.samples.get(*read..).unwrap_or_default();
                    let next = &rest[..rest.len().min(most)];
                    samples.extend_from_slice(next);
                    appended = appended.max(next.len());
                }
                *read += appended;
                Ok(appended)
            }
        }
    }
}

/// The roundest sample rate within a relative `precision` of `rate_hz`: a multiple of the largest power of ten, else
/// `rate_hz` itself.
pub fn roundest_rate(rate_hz: f64, precision: f64) -> f64 {
    let steps = [1000.0, 100.0, 10.0, 1.0, 0.1, 0.01];
    let rounded = steps.into_iter().map(|step| (rate_hz / step).round() * step);
    rounded.into_iter().find(|rounded| (rounded / rate_hz - 1.0).abs() <= precision).unwrap_or(rate_hz)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_roundest_rate_within_the_precision_counts() {
        assert_eq!(roundest_rate(51_199.87, 5e-6), 51_200.0);
        assert_eq!(roundest_rate(44_100.1, 5e-6), 44_100.0);
        assert_eq!(roundest_rate(65_536.2, 5e-6), 65_536.0);
        assert_eq!(roundest_rate(65_536.2, 1e-9), 65_536.2);
    }
}
