//! A session without buses and without waiting: given inputs, predicted and recorded as fast as possible.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use crate::io::message::{Message, Payload};
use crate::io::recorder::{Recorder, RecorderConfig, RecorderError};
use crate::node::{at_load_and_speed, ends_hash, map_hash, parameter_event, rig_info, session_ends, session_map};
use crate::physics::Solver;
use crate::rig::Rig;
use crate::session::{Event, Session, Want};
use crate::settings::Settings;
use crate::wire::{Header, OperatingPoint, SessionEvent, Time, Vibration, event_kind};

/// Stamp of the first input of an offline session, ns since the epoch: 2024-01-01T00:00:00Z, so that the same command
/// makes the same messages.
pub const START_NS: i64 = 1_704_067_200_000_000_000;

/// Why a session could not be recorded.
#[derive(Debug, thiserror::Error)]
pub enum OfflineError {
    #[error(transparent)]
    Recorder(#[from] RecorderError),
    #[error("no stability map: {0}")]
    Map(String),
    #[error("{dropped} messages were not recorded: {reason}")]
    Dropped { dropped: u64, reason: String },
}

/// Predicts conditions with `rig` and records the session, with the vibration measured at the same time, into a new directory in `directory`; that directory.
///
/// # Errors
/// [`OfflineError`].
pub fn record(
    rig: &Arc<Rig>,
    measured: impl Iterator<Item = (OperatingPoint, Option<Vibration>)>,
    directory: &Path,
) -> Result<PathBuf, OfflineError> {
    let recorder = Recorder::start(RecorderConfig {
        rig_name: rig.name.clone(),
        rig_content_hash: rig.content_hash.clone(),
        rig_files: rig.files.clone(),
        ..RecorderConfig::new(directory)
    })?;
    // There is no hurry here: rather wait for the disk than drop.
    let write = |stamp: Time, payload: Payload| {
        let time_ns = u64::try_from(stamp.as_ns()).unwrap_or(0);
        while recorder.status().queued > 1000 {
            std::thread::sleep(Duration::from_millis(1));
        }
        recorder.record(Message { log_time_ns: time_ns, publish_time_ns: time_ns, payload });
    };
    let mut session = Session::new(rig.clone(), Settings::for_rig(rig));
    let mut solver = Solver::new(rig.model.dimension());
    let mut begun = false;
    for (input, vibration) in measured {
        let stamp = input.header.stamp;
        let header = Header { stamp, ..Default::default() };
        if !begun {
            begun = true;
            write(stamp, Payload::RigInfo(rig_info(rig)));
            for (name, value) in session.settings().values() {
                write(stamp, Payload::SessionEvent(parameter_event(header.clone(), name, value)));
            }
        }
        if let Some(vibration) = vibration {
            write(stamp, Payload::Vibration(vibration));
        }
        write(stamp, Payload::OperatingPoint(input.clone()));
        // Settings are the rig's own here, and inputs are no settings: nothing can be refused.
        let effects = session.step(Event::Input(input)).unwrap_or_default();
        if let Some(prediction) = effects.publish {
            write(stamp, Payload::Prediction(prediction.clone()));
        }
        let Some(want) = effects.want else { continue };
        let (kind, point, hash, event) = match want {
            Want::Map(point) => {
                let map = session_map(rig, &mut solver, &point).map_err(OfflineError::Map)?;
                (event_kind::STABILITY_MAP, point, map_hash(&map), Event::MapReady(Arc::new(map)))
            }
            Want::Ends(point) => {
                let Some(map) = session.map() else { continue };
                let found = session_ends(rig, &mut solver, map, &point).map_err(OfflineError::Map)?;
                let Some(ends) = found else { continue };
                (event_kind::WINDOW_ENDS, point, ends_hash(&ends), Event::EndsReady(Arc::new(ends)))
            }
        };
        let event_at = SessionEvent { header, ..at_load_and_speed(kind, &point, hash) };
        write(stamp, Payload::SessionEvent(event_at));
        let _ = session.step(event);
    }
    let finished = recorder.finish(Duration::from_secs(600))?;
    match finished.status.dropped() {
        0 => Ok(finished.directory),
        dropped => {
            let reason = finished.status.last_error.unwrap_or_else(|| "the queue was full".to_owned());
            Err(OfflineError::Dropped { dropped, reason })
        }
    }
}
