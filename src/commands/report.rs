use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::Args;

use super::display::CriteriaOptions;
use super::recordings::Recordings;
use super::{Outcome, print, view, write_file};
use crate::display::report::{Origin, report};

const EXAMPLES: &str = "\
Examples:
  squealcast report recordings/ramp -o report  one self-contained HTML file and a CSV file";

/// Write a report of each recording: one self-contained HTML file, and the events as CSV
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    #[command(flatten)]
    recordings: Recordings,
    /// Directory for the report, created if missing. With several recordings, each gets a subdirectory named after it
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Use this rig for stability maps instead of the recorded one
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,
    #[command(flatten)]
    criteria: CriteriaOptions,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let paths = self.recordings.paths()?;
        let mut names = BTreeSet::new();
        let mut outcome = Outcome::Done;
        for path in &paths {
            let name = path.file_stem().unwrap_or(path.as_os_str());
            let directory = if paths.len() == 1 { self.output.clone() } else { self.output.join(name) };
            ensure!(names.insert(name), "{}: another recording has this name too", path.display());
            outcome = outcome.max(self.write(path, &directory)?);
        }
        Ok(outcome)
    }

    /// Writes the report of one recording.
    fn write(&self, path: &Path, directory: &Path) -> anyhow::Result<Outcome> {
        let recording = Arc::new(self.recordings.open(path)?);
        let recorded = view::read(path, &recording, self.rig.as_deref(), self.criteria.criteria())?;
        let origin = Origin {
            file: path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
            version: recording.session_metadata("squealcast_version").map(str::to_owned),
        };
        let html = report(&recorded, &origin)?;
        std::fs::create_dir_all(directory).with_context(|| format!("{}: cannot be created", directory.display()))?;
        write_file(&directory.join("report.html"), html.as_bytes())?;
        write_file(&directory.join("events.csv"), recorded.events.to_csv().as_bytes())?;
        print(&format!("{}\n", directory.join("report.html").display()))?;
        let lost = recording.damage().iter().chain(&recorded.damage).any(|damage| damage.damage.loses_data);
        Ok(if lost { Outcome::Differences } else { Outcome::Done })
    }
}
