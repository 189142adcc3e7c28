//! The recordings a command reads.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;

use crate::msgs::schema::Topic;
use crate::recording::reader::{ReadOptions, Recording, recordings_at};

/// Which recordings to read, and how
#[derive(Clone, Debug, Args)]
pub struct Recordings {
    /// Recordings: files, directories with the files of one recording, or folders with several
    #[arg(value_name = "RECORDING", required = true)]
    recordings: Vec<PathBuf>,
    #[command(flatten)]
    topics: TopicOptions,
}

/// Which topics of a recording to read
#[derive(Clone, Debug, Args)]
pub struct TopicOptions {
    /// Read this recorded topic instead of the node's own topic of the same type, such as /brake1/operating_point
    /// instead of /rig/operating_point; may be repeated
    #[arg(long = "read-topic", value_name = "TOPIC")]
    read_topics: Vec<String>,
}

impl TopicOptions {
    /// Opens a recording and reports what cannot be read.
    ///
    /// # Errors
    /// There is no recording, or the requested topics are not in it.
    pub fn open(&self, path: &Path) -> anyhow::Result<Recording> {
        let recording = Recording::open_with(path, ReadOptions { topics: self.read_topics.clone() })?;
        for damage in recording.damage() {
            note!("damaged: {damage}");
        }
        for unread in recording.topics().unread() {
            note!("{}: {unread}", path.display());
        }
        Ok(recording)
    }
}

impl Recordings {
    /// All recordings, at least one.
    ///
    /// # Errors
    /// A path contains no recording.
    pub fn paths(&self) -> anyhow::Result<Vec<PathBuf>> {
        let mut paths = vec![];
        for path in &self.recordings {
            paths.extend(recordings_at(path)?);
        }
        Ok(paths)
    }

    /// Opens one of [`Recordings::paths`] and reports what cannot be read.
    ///
    /// # Errors
    /// There is no recording, or the requested topics are not in it.
    pub fn open(&self, path: &Path) -> anyhow::Result<Recording> {
        self.topics.open(path)
    }

    /// The recording for a command that takes only one. Of a folder with several it is the last by name, which for
    /// sessions is the latest.
    ///
    /// # Errors
    /// As [`Recordings::paths`]; several paths were given.
    pub fn only(&self) -> anyhow::Result<(PathBuf, Recording)> {
        if self.recordings.len() > 1 {
            let [first, ..] = &self.recordings[..] else { unreachable!("more than one") };
            bail!("{} recordings are given, expected one, such as {}", self.recordings.len(), first.display());
        }
        let path = last(self.paths()?);
        let recording = self.open(&path)?;
        Ok((path, recording))
    }
}

/// The last by name of at least one recording, reported if there are several.
fn last(mut paths: Vec<PathBuf>) -> PathBuf {
    let count = paths.len();
    let Some(path) = paths.pop() else { unreachable!("at least one") };
    if count > 1 {
        note!("{count} recordings: the last by name, {}", path.display());
    }
    path
}

/// Opens the recording at a path; of a folder with several, the last by name. Reports what cannot be read.
///
/// # Errors
/// The path contains no recording.
pub fn open_last(path: &Path) -> anyhow::Result<(PathBuf, Recording)> {
    let path = last(recordings_at(path)?);
    let recording = TopicOptions { read_topics: vec![] }.open(&path)?;
    Ok((path, recording))
}

/// The error for a recording without predictions, with advice.
pub fn without_predictions(path: &Path, recording: &Recording) -> anyhow::Error {
    let path = path.display();
    match recording.topics().name_of(Topic::OperatingPoint) {
        Some(_) => anyhow::anyhow!(
            "{path}: holds no predictions; `squealcast predict-log {path} --rig RIG -o DIR` makes a recording with them"
        ),
        None => anyhow::anyhow!("{path}: holds no predictions, and no operating points to predict"),
    }
}
