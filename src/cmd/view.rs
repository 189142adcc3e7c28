use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::Args;
use crossbeam_channel::bounded;

use super::display::{self, CriteriaOptions, DisplayOptions};
use super::replay::recorded_rig;
use super::{Outcome, signals};
use crate::display::comparison::Criteria;
use crate::display::recorded::Recorded;
use crate::io::recording::Recording;
use crate::rig::Rig;

/// Open a recording in the page, with a time line
#[derive(Debug, Args)]
pub struct Options {
    /// A recording: a file, or the directory of all its files
    file: PathBuf,
    /// Maps and shapes of this rig instead of the recorded one
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,
    #[command(flatten)]
    criteria: CriteriaOptions,
    #[command(flatten)]
    display: DisplayOptions,
}

/// Reads a recording for people, with its own rig or the one given; `criteria` say what squeal is in a measured vibration.
///
/// # Errors
/// No recording, no rig, or no prediction in it.
pub fn read(file: &std::path::Path, rig: Option<&str>, criteria: Criteria) -> anyhow::Result<(Recording, Recorded)> {
    let recording = Recording::open(file)?;
    let rig = match rig {
        Some(rig) => Rig::load(rig)?,
        None => recorded_rig(&recording)?,
    };
    let recorded = Recorded::read(&recording, Arc::new(rig), criteria);
    for damage in recording.damage().iter().chain(&recorded.damage) {
        note!("damaged: {damage}");
    }
    ensure!(!recorded.moments.is_empty(), "{}: holds no predictions", file.display());
    Ok((recording, recorded))
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let addresses = self.display.addresses()?;
        ensure!(!addresses.is_empty(), "--no-display leaves nothing to view");
        let (_, recorded) = read(&self.file, self.rig.as_deref(), self.criteria.criteria())?;
        let (stop, stopped) = bounded::<()>(1);
        signals::on_stop(move || {
            // Nobody waits any more: it has stopped.
            let _ = stop.send(());
        })?;
        let server = display::serve(&addresses, Arc::new(recorded)).context("there is nowhere to show it")?;
        let _ = stopped.recv();
        drop(server);
        Ok(Outcome::Done)
    }
}
