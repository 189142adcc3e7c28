//! Files of sound and acceleration beside a log.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, bail, ensure};
use clap::Args;

use super::hear::CalibrationArgs;
use super::{Outcome, finite};
use crate::import::samples::SampleFile;
use crate::import::sound_blocks::{SoundBlocks, marker_s};
use crate::sound::{Channel, Detector, Settings};

/// Sound and acceleration that were sampled beside the conditions
#[derive(Clone, Debug, Args)]
pub struct SoundFileArgs {
    /// File of samples (WAV, Universal File or CSV) that was recorded beside the conditions; may be repeated. Of a folder,
    /// the files that have the name of the log are taken
    #[arg(long = "sound", value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Time of the first sample, or of the marker, after the first operating point, s
    #[arg(long, value_name = "S", value_parser = finite, default_value = "0", allow_negative_numbers = true, requires = "files")]
    sound_offset_s: f64,
    /// Marker in the samples: where this channel first reaches this level, in the unit of the file. A negative level is
    /// reached from above
    #[arg(long, value_name = "CHANNEL:LEVEL", requires = "files")]
    sound_marker: Option<Marker>,
    #[command(flatten)]
    calibration: CalibrationArgs,
}

/// A moment by which a file of samples is aligned.
#[derive(Clone, Copy, Debug)]
struct Marker {
    /// Counted from 1.
    channel: usize,
    level: f32,
}

impl FromStr for Marker {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (channel, level) = text.split_once(':').ok_or("expected a channel and a level, such as 2:0.5")?;
        let channel = channel.parse().ok().filter(|&channel| channel > 0);
        let channel = channel.ok_or("the channel is counted from 1")?;
        Ok(Self { channel, level: finite(level)? as f32 })
    }
}

/// The samples beside one log.
pub struct SoundBeside {
    pub blocks: SoundBlocks,
    /// Whether a file is shorter than it says.
    pub outcome: Outcome,
}

impl SoundFileArgs {
    /// Checks that each of `logs` has samples of its own: several have them in folders.
    ///
    /// # Errors
    /// A file of samples beside several logs.
    pub fn check(&self, logs: usize) -> anyhow::Result<()> {
        match self.files.iter().find(|file| logs > 1 && !file.is_dir()) {
            Some(file) => bail!(
                "--sound {} belongs to one log, {logs} are given; expected a folder with files named after the logs",
                file.display()
            ),
            None => Ok(()),
        }
    }

    /// Whether any samples are given.
    pub fn is_given(&self) -> bool {
        !self.files.is_empty()
    }

    /// Opens the samples beside `log`, whose first operating point has the stamp `first_ns`. They are to be searched with
    /// `settings`, if any.
    ///
    /// # Errors
    /// A file cannot be read; a channel cannot be searched; a marker is not found.
    pub fn open(&self, log: &Path, first_ns: i64, settings: Option<Settings>) -> anyhow::Result<SoundBeside> {
        let mut beside = SoundBeside { blocks: SoundBlocks::default(), outcome: Outcome::Done };
        let files = self.files_of(log)?;
        let mut names = BTreeSet::new();
        for path in &files {
            let file = path.display();
            let samples = SampleFile::open(path)?;
            samples.omitted().iter().for_each(|omitted| note!("{file}: omitted {omitted}"));
            if samples.missing_bytes() > 0 {
                note!("{file}: {} bytes of samples are missing at its end", samples.missing_bytes());
                beside.outcome = Outcome::Differences;
            }
            let channels = self.channels(path, &samples, files.len() > 1)?;
            for channel in &channels {
                let twice = !names.insert(channel.name.clone());
                ensure!(!twice, "{file}: another channel is named `{}` too", channel.name);
                let checked = match settings {
                    Some(settings) => Detector::new(channel, settings).map(drop),
                    None => channel.calibration().map(drop).map_err(Into::into),
                };
                checked.with_context(|| file.to_string())?;
            }
            let start_ns = self.start_ns(path, first_ns)?;
            note!(
                "{file}: {} channels, the first sample {:.6} s after the first operating point",
                channels.len(),
                start_ns.saturating_sub(first_ns) as f64 * 1e-9
            );
            beside.blocks.add(samples, channels, start_ns);
        }
        Ok(beside)
    }

    /// The files of samples beside a log, in order.
    fn files_of(&self, log: &Path) -> anyhow::Result<Vec<PathBuf>> {
        let mut files = vec![];
        for path in &self.files {
            if !path.is_dir() {
                files.push(path.clone());
                continue;
            }
            let failed = || path.display().to_string();
            let mut found = vec![];
            for entry in std::fs::read_dir(path).with_context(failed)? {
                let file = entry.with_context(failed)?.path();
                let same_file = || file.canonicalize().ok() == log.canonicalize().ok();
                if file.is_file() && file.file_stem() == log.file_stem() && !same_file() {
                    found.push(file);
                }
            }
            if found.is_empty() {
                note!("{}: holds no samples named as {}", path.display(), log.display());
            }
            found.sort();
            files.extend(found);
        }
        Ok(files)
    }

    /// The channels of a file. They have their names in the file, else their numbers; among several files also the name of
    /// theirs.
    fn channels(&self, path: &Path, samples: &SampleFile, several: bool) -> anyhow::Result<Vec<Channel>> {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let channel = |index: usize| {
            let name = match samples.name(index) {
                "" => (index + 1).to_string(),
                name => name.to_owned(),
            };
            let name = if several { format!("{stem} {name}") } else { name };
            self.calibration.channel(samples, index, name).with_context(|| path.display().to_string())
        };
        (0..samples.channel_count()).map(channel).collect()
    }

    /// Time of the first sample of a file.
    fn start_ns(&self, path: &Path, first_ns: i64) -> anyhow::Result<i64> {
        let reference_ns = first_ns.saturating_add((self.sound_offset_s * 1e9).round() as i64);
        let Some(Marker { channel, level }) = self.sound_marker else { return Ok(reference_ns) };
        let mut samples = SampleFile::open(path)?;
        let (file, channels) = (path.display(), samples.channel_count());
        ensure!(channel <= channels, "{file}: has {channels} channels, --sound-marker names channel {channel}");
        let found = marker_s(&mut samples, channel - 1, level)?;
        let marker_s = found.with_context(|| format!("{file}: channel {channel} never comes to reach {level}"))?;
        Ok(reference_ns.saturating_sub((marker_s * 1e9).round() as i64))
    }
}
