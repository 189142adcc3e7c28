use std::path::Path;
use std::sync::Arc;

use anyhow::ensure;
use clap::Args;
use crossbeam_channel::bounded;

use super::display::{self, CriteriaOptions, DisplayOptions};
use super::recordings::{Recordings, without_predictions};
use super::replay::recorded_rig;
use super::{Outcome, signals};
use crate::display::comparison::Criteria;
use crate::display::recorded::Recorded;
use crate::msgs::schema::Topic;
use crate::recording::reader::Recording;
use crate::rig::Rig;

/// Show a recording on the page, with a time line
#[derive(Debug, Args)]
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

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let addresses = self.display.addresses()?;
        ensure!(!addresses.is_empty(), "--no-display leaves nothing to view");
        let (path, recording) = self.recordings.only()?;
        let recorded = read(&path, &Arc::new(recording), self.rig.as_deref(), self.criteria.criteria())?;
        let (stop, stopped) = bounded::<()>(1);
        signals::on_stop(move || {
            // The receiver may have gone: the command has then stopped already.
            let _ = stop.send(());
        })?;
        let server = display::serve(&addresses, Arc::new(recorded))?;
        let _ = stopped.recv();
        drop(server);
        Ok(Outcome::Done)
    }
}
