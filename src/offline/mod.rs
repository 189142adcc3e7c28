//! A session without buses: predicts and records measured inputs as fast as possible.
//!
//! Time is that of the stamps, also for silences. In contrast to a node, every stability map is computed before the
//! input that needs it.

mod ahead;
pub mod score;
pub mod score_table;
mod sound_search;
pub mod verify;
pub mod verify_sound;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use crate::msgs::{Header, Heard, OperatingPoint, Temperature, Time, Vibration, Waveform};
use crate::node::rig_info;
use crate::physics::{self, Chart, Solver};
use crate::recording::message::{Message, Payload};
use crate::recording::reader::{Entry, Recorded, Recording};
use crate::recording::recorder::{Recorder, RecorderConfig, RecorderError};
use crate::rig::Rig;
use crate::session::computed::{Request, compute, parameter_record, record_of, session_rig};
use crate::session::{Event, Session};
use crate::session::{conditions, settings::Settings};
use crate::sound;
use crate::sound::search::end_ns;
use ahead::Ahead;
pub use sound_search::SoundFound;
use sound_search::SoundSearch;
use verify_sound::settings_metadata;

/// Stamp of the first input of a simulated offline session, ns since the epoch: 2024-01-01T00:00:00Z. Fixed, so that
/// equal commands give equal messages.
pub const START_NS: i64 = 1_704_067_200_000_000_000;

/// Largest number of messages waiting to be written to disk.
const MOST_QUEUED: usize = 1000;

/// Why a session could not be recorded.
#[derive(Debug, thiserror::Error)]
pub enum OfflineError {
    #[error(transparent)]
    Recorder(#[from] RecorderError),
    #[error("{dropped} messages were not recorded: {reason}")]
    Dropped { dropped: u64, reason: String },
}

/// A measured quantity with the times of its recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Measured {
    pub log_time_ns: u64,
    pub publish_time_ns: u64,
    pub quantity: Quantity,
}

/// A measured quantity.
#[derive(Clone, Debug, PartialEq)]
pub enum Quantity {
    Conditions(OperatingPoint),
    Vibration(Vibration),
    Temperature(Temperature),
    /// Consecutive samples of a channel of sound or acceleration.
    Samples(Waveform),
}

impl Measured {
    /// A quantity whose recording times equal its stamp; of samples, the time of the last one.
    pub fn at_its_stamp(quantity: Quantity) -> Self {
        let stamp = match &quantity {
            Quantity::Conditions(input) => input.header.stamp,
            Quantity::Vibration(vibration) => vibration.header.stamp,
            Quantity::Temperature(measured) => measured.header.stamp,
            Quantity::Samples(block) => Time::from_ns(end_ns(block)),
        };
        let time_ns = u64::try_from(stamp.as_ns()).unwrap_or(0);
        Self { log_time_ns: time_ns, publish_time_ns: time_ns, quantity }
    }
}

/// What a recording holds of the rig: what a session predicts from, and what it records beside its predictions.
pub fn measured(entry: Entry) -> Option<Measured> {
    let quantity = match entry.message {
        Recorded::Known(Payload::OperatingPoint(input)) => Quantity::Conditions(input),
        Recorded::Known(Payload::Vibration(vibration)) => Quantity::Vibration(vibration),
        Recorded::Known(Payload::Temperature(measured)) => Quantity::Temperature(measured),
        Recorded::Known(Payload::Waveform(block)) => Quantity::Samples(block),
        // Of the rig's messages only these are predicted or recorded again; the node's own are made anew.
        Recorded::Known(
            Payload::Prediction(_)
            | Payload::SessionEvent(_)
            | Payload::RigInfo(_)
            | Payload::Sensitivity(_)
            | Payload::Diagnostics(_)
            | Payload::Heard(_),
        )
        | Recorded::Unreadable(_)
        | Recorded::Other => return None,
    };
    Some(Measured { log_time_ns: entry.log_time_ns, publish_time_ns: entry.publish_time_ns, quantity })
}

/// The operating points of a recording.
pub fn points(recording: &Recording) -> impl Iterator<Item = physics::OperatingPoint> {
    recording.messages().filter_map(|entry| match entry.message {
        Recorded::Known(Payload::OperatingPoint(input)) => Some(conditions(&input)),
        _ => None,
    })
}

/// Summary of a session that was predicted and recorded.
#[derive(Clone, Debug, PartialEq)]
pub struct Predicted {
    /// Directory of its recording.
    pub directory: PathBuf,
    pub inputs: u64,
    /// Number of predictions of each level: OK, WARN, SQUEAL, FAULT.
    pub levels: [u64; 4],
    /// Why the first stability map, or rig at another temperature, that failed could not be computed.
    pub map_failure: Option<String>,
    /// `None` if samples were not searched.
    pub sound: Option<SoundFound>,
}

/// Predicts the `measured` inputs with `rig` and records the session into a new directory in `directory`. Predictions
/// are charted if `chart` is given. `points` are the conditions in `measured`, in the same order, to be solved ahead of
/// the session; they may end early. Samples are recorded and searched for squeal as `sound` defines it, against the
/// predictions made up to then; without a definition they are omitted.
///
/// # Errors
/// [`OfflineError`].
pub fn record(
    rig: &Arc<Rig>,
    chart: Option<Arc<Chart>>,
    points: impl Iterator<Item = physics::OperatingPoint>,
    measured: impl Iterator<Item = Measured>,
    sound: Option<sound::Settings>,
    directory: &Path,
) -> Result<Predicted, OfflineError> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let mut ahead = Ahead::new(points, &rig.model, threads);
    let mut offline = Offline::start(rig, sound, directory)?;
    let mut chart = Some(chart);
    for Measured { log_time_ns, publish_time_ns, quantity } in measured {
        match quantity {
            Quantity::Vibration(vibration) => {
                offline.write(log_time_ns, publish_time_ns, Payload::Vibration(vibration));
            }
            Quantity::Samples(block) => offline.samples(log_time_ns, publish_time_ns, block),
            Quantity::Temperature(measured) => {
                if let Some(chart) = chart.take() {
                    offline.begin(measured.header.stamp, log_time_ns, chart);
                }
                offline.temperature(measured, log_time_ns, publish_time_ns);
            }
            Quantity::Conditions(input) => {
                if let Some(chart) = chart.take() {
                    offline.begin(input.header.stamp, log_time_ns, chart);
                }
                offline.silence(input.header.stamp, log_time_ns);
                offline.prepare(&input, log_time_ns);
                ahead.step(&mut offline.session);
                offline.input(input, log_time_ns, publish_time_ns);
            }
        }
    }
    offline.finish()
}

/// A session that is being recorded.
struct Offline {
    recorder: Recorder,
    session: Session,
    solver: Solver,
    /// Stamp and log time of the latest input.
    last: Option<(Time, u64)>,
    /// Load and speed at which the map cannot be computed; not tried again.
    given_up: Option<physics::OperatingPoint>,
    inputs: u64,
    levels: [u64; 4],
    map_failure: Option<String>,
    sound: Option<SoundSearch>,
    /// Log time of the latest message.
    latest_ns: u64,
}

impl Offline {
    fn start(rig: &Arc<Rig>, sound: Option<sound::Settings>, directory: &Path) -> Result<Self, OfflineError> {
        let recorder = Recorder::start(RecorderConfig {
            rig_name: rig.name.clone(),
            rig_content_hash: rig.content_hash.clone(),
            rig_files: rig.files.clone(),
            metadata: sound.map(settings_metadata).unwrap_or_default(),
            ..RecorderConfig::new(directory)
        })?;
        Ok(Self {
            session: Session::new(rig.clone(), Settings::for_rig(rig)),
            solver: Solver::new(rig.model.dimension()),
            recorder,
            last: None,
            given_up: None,
            inputs: 0,
            levels: [0; 4],
            map_failure: None,
            sound: sound.map(SoundSearch::new),
            latest_ns: 0,
        })
    }

    fn write(&mut self, log_time_ns: u64, publish_time_ns: u64, payload: Payload) {
        // Nothing is live here: wait for the disk instead of dropping messages.
        while self.recorder.status().queued > MOST_QUEUED {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.latest_ns = self.latest_ns.max(log_time_ns);
        self.recorder.record(Message { log_time_ns, publish_time_ns, payload });
    }

    /// Records an event that is not an input, then hands it to the session.
    fn event(&mut self, stamp: Time, log_time_ns: u64, event: Event) {
        if let Some(record) = record_of(&event, Header { stamp, ..Default::default() }) {
            self.write(log_time_ns, log_time_ns, Payload::SessionEvent(record));
        }
        self.step(log_time_ns, event);
    }

    /// One step of the session. Records its prediction and returns the computation it requests.
    fn step(&mut self, log_time_ns: u64, event: Event) -> Option<Request> {
        // Settings are those of the rig and no event changes them, so the session refuses nothing.
        let effects = self.session.step(event).unwrap_or_default();
        let (prediction, request) = (effects.publish.cloned(), effects.request);
        if let Some(prediction) = prediction {
            self.levels[usize::from(prediction.level).min(3)] += 1;
            if let Some(sound) = &mut self.sound {
                sound.predicted(&prediction);
            }
            self.write(log_time_ns, log_time_ns, Payload::Prediction(prediction));
        }
        request
    }

    /// Records the initial state of the session: rig, settings and chart.
    fn begin(&mut self, stamp: Time, log_time_ns: u64, chart: Option<Arc<Chart>>) {
        self.write(log_time_ns, log_time_ns, Payload::RigInfo(rig_info(self.session.rig())));
        let header = Header { stamp, ..Default::default() };
        let settings: Vec<(&str, f64)> = self.session.settings().values().collect();
        for (name, value) in settings {
            let event = parameter_record(header.clone(), name, value);
            self.write(log_time_ns, log_time_ns, Payload::SessionEvent(event));
        }
        if let Some(chart) = chart {
            self.event(stamp, log_time_ns, Event::ChartReady(chart));
        }
    }

    /// Inserts a silence before an input whose stamp follows the previous one by more than the silence timeout.
    fn silence(&mut self, stamp: Time, log_time_ns: u64) {
        let timeout = Duration::try_from_secs_f64(self.session.settings().silence_timeout_s).ok();
        let timeout_ns = timeout.and_then(|timeout| i64::try_from(timeout.as_nanos()).ok());
        if let (Some((last, last_log_ns)), Some(timeout_ns)) = (self.last, timeout_ns)
            && stamp.as_ns().saturating_sub(last.as_ns()) > timeout_ns
        {
            let silent = Time::from_ns(last.as_ns() + timeout_ns);
            let log_ns = last_log_ns.saturating_add(timeout_ns.unsigned_abs()).min(log_time_ns);
            self.event(silent, log_ns, Event::Silence { stamp: silent });
        }
        self.last = Some((stamp, log_time_ns));
    }

    /// Computes the stability map that the prediction for `input` needs, if the session does not have it.
    fn prepare(&mut self, input: &OperatingPoint, log_time_ns: u64) {
        let point = conditions(input);
        if self.session.has_no_map(&point) {
            self.compute(input.header.stamp, log_time_ns, Request::Map(point));
        }
    }

    fn input(&mut self, input: OperatingPoint, log_time_ns: u64, publish_time_ns: u64) {
        self.inputs += 1;
        let stamp = input.header.stamp;
        self.write(log_time_ns, publish_time_ns, Payload::OperatingPoint(input.clone()));
        if let Some(request) = self.step(log_time_ns, Event::Input(input)) {
            self.compute(stamp, log_time_ns, request);
        }
    }

    /// Records a temperature. A rig that follows it and has another one is built for it.
    fn temperature(&mut self, measured: Temperature, log_time_ns: u64, publish_time_ns: u64) {
        let (stamp, celsius) = (measured.header.stamp, measured.temperature);
        self.write(log_time_ns, publish_time_ns, Payload::Temperature(measured));
        if !self.session.leaves_temperature(celsius) {
            return;
        }
        match session_rig(self.session.rig(), celsius) {
            Ok(rig) => {
                self.given_up = None;
                self.event(stamp, log_time_ns, Event::RigReady(rig));
            }
            Err(reason) => drop(self.map_failure.get_or_insert(reason)),
        }
    }

    /// Records a block of samples and what is found in it; nothing if samples are not searched.
    fn samples(&mut self, log_time_ns: u64, publish_time_ns: u64, block: Waveform) {
        let Some(sound) = &mut self.sound else { return };
        let heard = sound.block(&block);
        self.write(log_time_ns, publish_time_ns, Payload::Waveform(block));
        self.heard(log_time_ns, heard);
    }

    fn heard(&mut self, log_time_ns: u64, heard: Vec<Heard>) {
        for heard in heard {
            self.write(log_time_ns, log_time_ns, Payload::Heard(heard));
        }
    }

    /// Computes what the session requested, records it and hands it to the session.
    fn compute(&mut self, stamp: Time, log_time_ns: u64, request: Request) {
        let place = request.point().with_friction(0.0);
        let is_map = matches!(request, Request::Map(_));
        if is_map && self.given_up == Some(place) {
            return;
        }
        let (rig, map) = (self.session.rig().clone(), self.session.map().cloned());
        match compute(&rig, &mut self.solver, map.as_deref(), &request) {
            Ok(Some(event)) => self.event(stamp, log_time_ns, event),
            Ok(None) => self.compute(stamp, log_time_ns, Request::Map(*request.point())),
            Err(reason) => {
                if is_map {
                    self.given_up = Some(place);
                }
                self.map_failure.get_or_insert(reason);
            }
        }
    }

    fn finish(mut self) -> Result<Predicted, OfflineError> {
        let lasting = self.sound.as_mut().map(SoundSearch::finish).unwrap_or_default();
        self.heard(self.latest_ns, lasting);
        let Self { recorder, inputs, levels, map_failure, sound, .. } = self;
        let sound = sound.map(SoundSearch::found);
        let finished = recorder.finish(Duration::from_secs(600))?;
        match finished.status.dropped() {
            0 => Ok(Predicted { directory: finished.directory, inputs, levels, map_failure, sound }),
            dropped => {
                let reason = finished.status.why_dropped().unwrap_or_default();
                Err(OfflineError::Dropped { dropped, reason })
            }
        }
    }
}
