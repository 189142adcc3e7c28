use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::display::CriteriaOptions;
use super::{Outcome, print, view, write_file};
use crate::display::report::{Origin, report};

/// Write a report of a recording: one HTML file that needs nothing else, and the events as CSV
#[derive(Debug, Args)]
pub struct Options {
    /// A recording: a file, or the directory of all its files
    file: PathBuf,
    /// Directory to write into; it is made where it is missing
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Maps of this rig instead of the recorded one
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,
    #[command(flatten)]
    criteria: CriteriaOptions,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let (recording, recorded) = view::read(&self.file, self.rig.as_deref(), self.criteria.criteria())?;
        let origin = Origin {
            file: self.file.file_name().unwrap_or(self.file.as_os_str()).to_string_lossy().into_owned(),
            version: recording.session_metadata("squealcast_version").map(str::to_owned),
        };
        let html = report(&recorded, &origin)?;
        let directory = &self.output;
        std::fs::create_dir_all(directory).with_context(|| format!("{}: cannot make it", directory.display()))?;
        write_file(&directory.join("report.html"), html.as_bytes())?;
        write_file(&directory.join("events.csv"), recorded.events.to_csv().as_bytes())?;
        print(&format!("{}\n", directory.join("report.html").display()))?;
        let lost = recorded.damage.iter().any(|damage| damage.damage.loses_data);
        Ok(if lost { Outcome::Differences } else { Outcome::Done })
    }
}
