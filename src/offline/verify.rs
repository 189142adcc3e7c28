//! Predicts a recorded session again and compares byte for byte.
//!
//! Exactly the inputs that were predicted are predicted again, in the recorded order, with the recorded session events
//! between them. Stability maps and ends of windows are recomputed at the load and speed that their events give.
//! Sensitivities are ignored, because no prediction depends on them. Dense spectra of coming inputs are solved in
//! parallel ahead of the session (`ahead`).

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;

use bytes::Bytes;

use super::ahead::Ahead;
use crate::files::chart_file::ChartFile;
use crate::msgs::{self, Prediction, SessionEvent, SessionEventKind, Time};
use crate::physics::{Chart, OperatingPoint, Solver, StabilityMap};
use crate::recording::message::Payload;
use crate::recording::reader::{FileDamage, Recorded, Recording};
use crate::rig::Rig;
use crate::session::computed::{Request, chart_hash, compute, record_of, session_chart, session_rig};
use crate::session::{Event, Session};
use crate::session::{conditions, settings::Settings};

/// Number of differences described in words; all others are only counted.
const DESCRIBED: usize = 10;

/// Result of a verification.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verification {
    /// Number of operating points in the recording, and how many of them were predicted.
    pub inputs: u64,
    pub predicted: u64,
    /// Number of predictions that agree byte for byte.
    pub identical: u64,
    /// Number of predictions that differ.
    pub different: u64,
    /// Number of predictions that are only in the recording, and that were only computed now.
    pub missing: u64,
    pub extra: u64,
    /// Number of stability maps, ends of windows and charts whose hash differs.
    pub different_maps: u64,
    /// Largest relative difference of frequencies, and largest difference of growth rates (1/s), of modes of equal
    /// identity.
    pub frequency_difference: f64,
    pub growth_rate_difference_per_s: f64,
    /// Descriptions of the first differences.
    pub described: Vec<String>,
    /// Damaged parts of the recording.
    pub damage: Vec<FileDamage>,
}

impl Verification {
    /// Whether all predictions and all computed maps, ends and charts agree.
    pub fn agrees(&self) -> bool {
        self.different + self.missing + self.extra + self.different_maps == 0
    }

    fn describe(&mut self, text: impl FnOnce() -> String) {
        if self.described.len() < DESCRIBED {
            self.described.push(text());
        }
    }
}

/// Where a verification takes charts from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Charts {
    /// From disk, if the chart there has the recorded hash; otherwise built.
    Kept,
    /// Always built, which verifies the builder too.
    Anew,
}

/// Why a recording could not be verified.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    #[error("the recording holds no prediction that can be read{}", .damage.iter().map(|d| format!("; {d}")).collect::<String>())]
    NoPredictions { damage: Vec<FileDamage> },
    #[error("cannot compute the stability map at {normal_load_n} N, {disc_speed_rad_s} rad/s: {reason}")]
    Map { normal_load_n: f64, disc_speed_rad_s: f64, reason: String },
    #[error("cannot build the rig at {celsius} °C: {reason}")]
    Temperature { celsius: f64, reason: String },
    #[error("cannot chart the rig: {0}")]
    Chart(String),
    #[error("session event of unknown kind {kind}: recorded by a later version?")]
    EventKind { kind: u8 },
    #[error("{0}")]
    Encode(String),
}

/// Predicts the session in `recording` again with `rig` and compares.
///
/// A file from the middle of a session can be verified alone, because it begins with the settings, map, ends and chart
/// in force. Two things are not recorded in it: whether its first input reused the previous prediction, and whether the hysteresis of
/// SQUEAL was active.
///
/// # Errors
/// [`VerifyError`].
pub fn verify(recording: &Recording, rig: &Arc<Rig>, charts: Charts) -> Result<Verification, VerifyError> {
    let mut answered: HashSet<(Time, u64)> = HashSet::new();
    let mut messages = recording.messages();
    for entry in messages.by_ref() {
        if let Recorded::Known(Payload::Prediction(prediction)) = &entry.message {
            answered.insert((prediction.header.stamp, prediction.input_seq));
        }
    }
    let damage = messages.damage().to_vec();
    if answered.is_empty() {
        return Err(VerifyError::NoPredictions { damage });
    }

    let mut found = Verification { damage, ..Verification::default() };
    let mut events = NewEvents::default();
    let mut session = Session::new(rig.clone(), Settings::for_rig(rig));
    let mut solver = Solver::new(rig.model.dimension());
    let mut computed: VecDeque<Prediction> = VecDeque::new();
    let step = |session: &mut Session, computed: &mut VecDeque<Prediction>, event: Event| {
        // A parameter that the session refuses now was refused when recorded, too, and changed nothing.
        let effects = session.step(event).unwrap_or_default();
        computed.extend(effects.publish.cloned());
    };
    let predicted = recording.messages().filter_map(|entry| match entry.message {
        Recorded::Known(Payload::OperatingPoint(input)) => {
            answered.contains(&(input.header.stamp, input.seq)).then(|| conditions(&input))
        }
        _ => None,
    });
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let mut ahead = Ahead::new(predicted, &rig.model, threads);
    for entry in recording.messages() {
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => {
                found.inputs += 1;
                if answered.contains(&(input.header.stamp, input.seq)) {
                    found.predicted += 1;
                    ahead.step(&mut session);
                    step(&mut session, &mut computed, Event::Input(input));
                }
            }
            Recorded::Known(Payload::SessionEvent(event)) if events.take(&event, &entry.cdr) => {
                let (rig, map) = (session.rig().clone(), session.map().cloned());
                let event = session_event(event, &rig, charts, map.as_deref(), &mut solver, &mut found)?;
                step(&mut session, &mut computed, event);
            }
            Recorded::Known(Payload::Prediction(recorded)) => match computed.pop_front() {
                Some(computed) => compare(&entry.cdr, &recorded, &computed, &mut found)?,
                None => {
                    found.missing += 1;
                    found.describe(|| format!("seq {}: recorded, not predicted now", recorded.input_seq));
                }
            },
            // Predictions do not depend on these.
            Recorded::Known(
                Payload::SessionEvent(_)
                | Payload::RigInfo(_)
                | Payload::Sensitivity(_)
                | Payload::Diagnostics(_)
                | Payload::Vibration(_)
                | Payload::Temperature(_)
                | Payload::Waveform(_)
                | Payload::Heard(_),
            )
            | Recorded::Unreadable(_)
            | Recorded::Other => {}
        }
    }
    for prediction in computed {
        found.extra += 1;
        found.describe(|| format!("seq {}: predicted now, not recorded", prediction.input_seq));
    }
    Ok(found)
}

/// The latest session event of each kind and name. Used to skip the copies of events at the start of each file of a
/// recording.
#[derive(Default)]
struct NewEvents(HashMap<(u8, String), Bytes>);

impl NewEvents {
    /// Whether an event differs in any byte from the last one of its kind and name. The bytes include the stamp in
    /// nanoseconds.
    fn take(&mut self, event: &SessionEvent, cdr: &Bytes) -> bool {
        self.0.insert((event.kind, event.name.clone()), cdr.clone()).is_none_or(|before| before != cdr)
    }
}

/// Converts a recorded session event. Maps, ends and charts are recomputed and their hashes compared.
fn session_event(
    recorded: SessionEvent,
    rig: &Rig,
    charts: Charts,
    map: Option<&StabilityMap>,
    solver: &mut Solver,
    found: &mut Verification,
) -> Result<Event, VerifyError> {
    let SessionEvent { normal_load_n, disc_speed_rad_s, .. } = recorded;
    let point = OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient: 0.0 };
    let failed = |reason: String| VerifyError::Map { normal_load_n, disc_speed_rad_s, reason };
    let mut computed = |request: Request| {
        let event = compute(rig, solver, map, &request).map_err(failed)?;
        event.ok_or_else(|| failed("the ends of its windows are not found again".to_owned()))
    };
    let kind = SessionEventKind::of(&recorded).ok_or(VerifyError::EventKind { kind: recorded.kind })?;
    let (event, what) = match kind {
        SessionEventKind::Parameter => return Ok(Event::Parameter { name: recorded.name, value: recorded.value }),
        SessionEventKind::Silence => return Ok(Event::Silence { stamp: recorded.header.stamp }),
        SessionEventKind::Temperature => {
            let celsius = recorded.value;
            let failed = |reason| VerifyError::Temperature { celsius, reason };
            return session_rig(rig, celsius).map(Event::RigReady).map_err(failed);
        }
        SessionEventKind::StabilityMap => {
            (computed(Request::Map(point))?, format!("stability map at {normal_load_n} N, {disc_speed_rad_s} rad/s"))
        }
        SessionEventKind::WindowEnds => {
            (computed(Request::Ends(point))?, format!("window ends at {normal_load_n} N, {disc_speed_rad_s} rad/s"))
        }
        SessionEventKind::Chart => {
            (Event::ChartReady(Arc::new(chart(rig, charts, &recorded.hash)?)), "chart".to_owned())
        }
    };
    let again = record_of(&event, recorded.header).map(|record| record.hash);
    if again != Some(recorded.hash) {
        found.different_maps += 1;
        found.describe(|| format!("{what}: other numbers than recorded"));
    }
    Ok(event)
}

/// The chart of `rig`: the kept one if it has the recorded hash, for it is then identical to the recorded one, whoever
/// built it; otherwise a new one.
fn chart(rig: &Rig, charts: Charts, recorded_hash: &str) -> Result<Chart, VerifyError> {
    let kept = match charts {
        Charts::Kept => ChartFile::locate(&rig.name, rig.path.as_deref(), &rig.content_hash),
        Charts::Anew => None,
    };
    let kept = kept.and_then(|file| file.load().ok().flatten());
    match kept.filter(|chart| chart.is_complete() && chart_hash(chart) == recorded_hash) {
        Some(chart) => Ok(chart),
        None => session_chart(rig, std::thread::available_parallelism().map_or(1, usize::from), &|| true)
            .map_err(VerifyError::Chart),
    }
}

fn compare(
    recorded_bytes: &[u8],
    recorded: &Prediction,
    computed: &Prediction,
    found: &mut Verification,
) -> Result<(), VerifyError> {
    let computed_bytes = msgs::to_cdr(computed).map_err(|error| VerifyError::Encode(error.to_string()))?;
    if recorded_bytes == computed_bytes {
        found.identical += 1;
        return Ok(());
    }
    found.different += 1;
    for mode in &recorded.modes {
        let Some(other) = computed.modes.iter().find(|other| other.id == mode.id) else { continue };
        let frequency = (other.frequency_hz / mode.frequency_hz - 1.0).abs();
        found.frequency_difference = found.frequency_difference.max(frequency);
        let growth = (other.growth_rate_per_s - mode.growth_rate_per_s).abs();
        found.growth_rate_difference_per_s = found.growth_rate_difference_per_s.max(growth);
    }
    found.describe(|| {
        let words = |p: &Prediction| {
            let (level, count) = (msgs::level::name(p.level), p.modes.len());
            format!("{level}, {count} modes, margin {}, growth {} 1/s", p.friction_margin, p.max_growth_rate_per_s)
        };
        format!("seq {}: recorded {}; now {}", recorded.input_seq, words(recorded), words(computed))
    });
    Ok(())
}
