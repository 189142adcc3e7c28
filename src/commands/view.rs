use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::ensure;
use clap::Args;
use crossbeam_channel::bounded;

use super::display::{self, CriteriaOptions, DisplayOptions};
use super::recordings::{Recordings, without_predictions};
use super::{Outcome, signals};
use crate::display::comparison::Criteria;
use crate::display::recorded::Recorded;
use crate::display::server::Pages;
use crate::display::shelf::Shelf;
use crate::msgs::schema::Topic;
use crate::recording::reader::Recording;
use crate::recording::recorded_rig;
use crate::rig::Rig;

const EXAMPLES: &str = "\
Examples:
  squealcast view recordings/ramp  the page of one recording
  squealcast view sessions         of all recordings in a folder";

/// Show recordings on the page, with a time line. Of several, the page shows the last by name and lets you choose
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    #[command(flatten)]
    recordings: Recordings,
    /// Use this rig for maps and shapes instead of the recorded one
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,
    #[command(flatten)]
    criteria: CriteriaOptions,
    #[command(flatten)]
    display: DisplayOptions,
}

/// Reads a recording for display, with its own rig or the one given. `criteria` define squeal in a measured vibration.
///
/// # Errors
/// The recording contains no prediction or no rig.
pub fn read(
    path: &Path,
    recording: &Arc<Recording>,
    rig: Option<&str>,
    criteria: Criteria,
) -> anyhow::Result<Recorded> {
    if recording.topics().name_of(Topic::Prediction).is_none() {
        return Err(without_predictions(path, recording));
    }
    let rig = match rig {
        Some(rig) => Rig::load(rig)?,
        None => recorded_rig(recording)?,
    };
    let recorded = Recorded::read(recording, Arc::new(rig), criteria);
    for damage in recorded.damage.iter().filter(|damage| !recording.damage().contains(damage)) {
        note!("damaged: {damage}");
    }
    ensure!(!recorded.moments.is_empty(), "{}: holds no prediction that can be read", path.display());
    Ok(recorded)
}

/// How the page names recordings: by their own names, or, if two have the same, by their paths.
fn names(paths: &[PathBuf]) -> Vec<String> {
    let own = |path: &PathBuf| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let names: Vec<String> = paths.iter().map(own).collect();
    let distinct: std::collections::BTreeSet<&String> = names.iter().collect();
    if distinct.len() == names.len() { names } else { paths.iter().map(|path| path.display().to_string()).collect() }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let addresses = self.display.addresses()?;
        ensure!(!addresses.is_empty(), "--no-display leaves nothing to view");
        let pages = self.pages()?;
        let (stop, stopped) = bounded::<()>(1);
        signals::on_stop(move || {
            // The receiver may have gone: the command has then stopped already.
            let _ = stop.send(());
        })?;
        let server = display::serve(&addresses, pages)?;
        let _ = stopped.recv();
        drop(server);
        Ok(Outcome::Done)
    }

    /// The page of one recording, or those of several, which are read when they are looked at.
    fn pages(self) -> anyhow::Result<Pages> {
        let Self { recordings, rig, criteria, .. } = self;
        let paths = recordings.paths()?;
        let names = names(&paths);
        let open = move |path: &Path| {
            let recording = Arc::new(recordings.open(path)?);
            read(path, &recording, rig.as_deref(), criteria.criteria())
        };
        if let [path] = &paths[..] {
            return Ok(Pages::One(Arc::new(open(path)?)));
        }
        note!("{} recordings: the page begins with the last, {}", paths.len(), names[names.len() - 1]);
        Ok(Pages::Recordings(Shelf::new(
            names,
            Box::new(move |index| match open(&paths[index]) {
                Ok(recorded) => Ok(Arc::new(recorded)),
                Err(error) => Err(super::failure(&error)),
            }),
        )))
    }
}
