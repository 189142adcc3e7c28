//! The node: feeds what it receives to the session and carries out the session's requests.
//!
//! # Locking
//!
//! One mutex (`inlet::Running`) guards the `Worker`: the session and everything that is done for it. The node's own
//! thread takes it for a whole `Worker::work_off` and waits for items without it. A thread that received an input may
//! take it in [`Inlet::input`], by `try_lock`, so it never waits. Items are put into the queue without the lock, but
//! taken out of it only under the lock: whoever holds it and finds queue and backlog empty knows that every earlier input
//! has been handled, and overtakes none. Publishing and recording happen under the lock and put messages into bounded
//! queues or shared memory without waiting, so it is held no longer than the computation takes. Everything that affects
//! predictions is recorded in the order in which the session gets it, so that a replay can reproduce it.

mod detection;
mod inlet;
mod lifecycle;
mod log;
mod mapper;
mod outputs;
#[cfg(test)]
mod recorded_tests;
mod remembered;
mod sensitivity;
pub mod sound_view;
mod statistics;
pub mod status;
mod temperature;
#[cfg(test)]
mod tests;
mod watch;

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Select, Sender, TryRecvError, bounded};

pub use detection::{SoundOptions, in_force};
pub use inlet::Inlet;
pub use mapper::{kept_chart, yield_to_predictions};
pub use outputs::{NodeName, Outputs};
pub use sensitivity::end_derivatives;
pub use watch::{SAMPLE_MODES, Sample, Snapshot, TemperatureSeen, UnstableMode, VibrationSample, Watch};

use crate::bus::Received;
use crate::bus::lifecycle::State;
use crate::files::chart_file::ChartFile;
use crate::msgs::{self, Header, RigInfo, Time};
use crate::physics::{Chart, OperatingPoint, StabilityMap};
use crate::recording::message::Payload;
use crate::rig::{Certificate, Rig};
use crate::session::computed::{Request, parameter_record, record_of};
use crate::session::{Event, Session, map_serves};
use crate::session::{conditions, settings::Settings};
use crate::system::clock;
use detection::DetectionInlet;
use inlet::Running;
use lifecycle::{Charting, Lifecycle};
use mapper::Mapper;
use remembered::Remembered;
use sensitivity::Question;
use statistics::Statistics;

/// Capacity of the node's queue. Inputs that do not fit are lost before they are recorded, and counted.
const QUEUE: usize = 16_384;
/// A backlog is predicted completely if that takes at most this time; of a longer one only the newest input is
/// predicted.
const CATCH_UP: Duration = Duration::from_millis(100);
/// An input older than this is passed over, unless it is the newest.
const LATEST: Duration = Duration::from_millis(500);
/// The time of a prediction is estimated as the minimum over this many, since on a busy machine any of them may have
/// been interrupted.
const TIMED: usize = 16;
/// Number of inputs, of measured vibrations, and of temperatures, whose stamp and sequence number are remembered. A message
/// that arrives over both buses is recognised by them and handled once.
const REMEMBERED: usize = 8192;
const VIBRATIONS_REMEMBERED: usize = 1024;
const TEMPERATURES_REMEMBERED: usize = 64;
/// Interval between diagnostics.
const DIAGNOSTICS_EVERY: Duration = Duration::from_secs(1);
/// Minimum interval between sensitivities.
const SENSITIVITY_EVERY: Duration = Duration::from_secs(1);

/// An item of the node's queue.
#[derive(Clone, Debug)]
pub enum Incoming {
    /// An operating point received over a bus.
    Input(Received<msgs::OperatingPoint>),
    /// A measured vibration received over a bus. It is recorded and shown, and does not affect predictions.
    Vibration(Received<msgs::Vibration>),
    /// A temperature of the contact received over a bus. It is recorded and shown, and the rig follows it.
    Temperature(Received<msgs::Temperature>),
    /// A squeal found in received samples. It is published, recorded and shown, and does not affect predictions.
    Heard(Box<msgs::Heard>),
    /// A changed setting; its value is already validated.
    Parameter { name: String, value: f64 },
    /// The result of a request of the session, as [`compute`] returns it, with the map in force when it was made.
    ///
    /// [`compute`]: crate::session::computed::compute
    Computed { request: Request, map: Option<Arc<StabilityMap>>, result: Result<Option<Event>, String> },
    /// The requested sensitivities, or why they could not be computed.
    Sensitivity(Box<Result<msgs::Sensitivity, String>>),
    /// The chart of `rig`, or why it could not be built.
    Chart { rig: Arc<Rig>, chart: Result<Arc<Chart>, String> },
    /// The rig at a temperature, followed by its map if it has one, or why it could not be built.
    Rig { celsius: f64, result: Result<Vec<Event>, String> },
    /// A peer has requested another state.
    Lifecycle,
    /// End of the run.
    Stop,
}

/// A node that is not running yet.
pub struct Node {
    worker: Worker,
    sender: Sender<Incoming>,
    queue: Receiver<Incoming>,
    running: Running,
    detection: detection::Prepared,
}

/// A session with its backlog, outputs, background computations and statistics.
struct Worker {
    session: Session,
    rig: Arc<Rig>,
    outputs: Outputs,
    mapper: Mapper,
    statistics: Statistics,
    log: log::NodeLog,
    lifecycle: Lifecycle,
    /// The state that was last followed.
    state: State,
    charting: Charting,
    watch: Watch,
    received_before: Remembered,
    vibration_received_before: Remembered,
    temperature_received_before: Remembered,
    /// The latest temperature, °C, and the last one at which the rig could not be built.
    temperature: Option<f64>,
    temperature_refused: Option<f64>,
    /// The latest operating point that was predicted.
    point: OperatingPoint,
    /// When the latest input was received. `None` before the first: silence is only a FAULT after an input.
    last_received: Option<Instant>,
    /// Whether the current silence has been published.
    silent: bool,
    /// Items taken from the channel and not yet handled.
    backlog: VecDeque<Incoming>,
    /// Number of inputs in `backlog`.
    inputs_waiting: usize,
    prediction_times: Times,
    /// Whether inputs are being passed over: the backlog was too long, and until it is empty only the newest input is
    /// predicted.
    passing_over: bool,
    next_diagnostics: Instant,
    next_sensitivity: Instant,
    detection: DetectionInlet,
}

impl Node {
    /// A node for `rig` with initial `settings`, and the inlet that hands items to it.
    pub fn new(rig: Arc<Rig>, settings: Settings, watch: Watch) -> (Self, Inlet) {
        // Anchors of a contact state are computed with its first state, for which the first input would wait.
        if let Some(statics) = rig.model.statics() {
            statics.anchors();
        }
        let (sender, queue) = bounded(QUEUE);
        let (running, lost) = (Running::default(), Arc::<AtomicU64>::default());
        let (detection, samples) = detection::Prepared::new();
        let lifecycle = Lifecycle::default();
        let inlet = Inlet::new(sender.clone(), running.clone(), lost.clone(), lifecycle.clone(), samples.clone());
        let worker = Worker {
            session: Session::new(rig.clone(), settings),
            mapper: Mapper::spawn(rig.clone(), sender.clone()),
            temperature: None,
            temperature_refused: None,
            point: rig.reference,
            rig,
            outputs: Outputs::default(),
            statistics: Statistics::new(lost),
            log: log::NodeLog::new(),
            lifecycle: lifecycle.clone(),
            state: State::Active,
            charting: Charting::default(),
            watch,
            received_before: Remembered::new(REMEMBERED),
            vibration_received_before: Remembered::new(VIBRATIONS_REMEMBERED),
            temperature_received_before: Remembered::new(TEMPERATURES_REMEMBERED),
            last_received: None,
            silent: false,
            backlog: VecDeque::new(),
            inputs_waiting: 0,
            prediction_times: Times::default(),
            passing_over: false,
            next_diagnostics: Instant::now() + DIAGNOSTICS_EVERY,
            next_sensitivity: Instant::now(),
            detection: samples,
        };
        (Self { worker, sender, queue, running, detection }, inlet)
    }

    /// Builds the chart of the rig in the background once the node runs, or loads it from the file `kept`. Predictions
    /// use the chart as soon as it is available.
    pub fn with_chart(mut self, kept: Option<ChartFile>) -> Self {
        self.worker.charting = Charting::Wanted(kept);
        self
    }

    /// Starts in this state instead of active. Buses change it later.
    pub fn starting_as(mut self, state: State) -> Self {
        self.worker.lifecycle.set(state);
        self.worker.state = state;
        self
    }

    /// Defines what counts as squeal in received samples.
    pub fn with_sound(mut self, options: SoundOptions) -> Self {
        self.detection.options = options;
        self
    }

    /// Runs until [`Incoming::Stop`], then returns the outputs.
    pub fn run(self, outputs: Outputs) -> Outputs {
        let Self { mut worker, sender, queue, running, detection } = self;
        let detection = detection.start(sender, outputs.recorder.clone(), worker.watch.sound());
        worker.outputs = outputs;
        worker.begin();
        let mut next = Next::Wait(worker.deadline());
        *running.lock() = Some(worker);
        loop {
            // The queue is only waited on here; items are taken out under the lock, see `Inlet::input`.
            if let Next::Wait(deadline) = next {
                let mut ready = Select::new();
                ready.recv(&queue);
                let _ = ready.ready_deadline(deadline);
            }
            let mut running = running.lock();
            next = running.as_mut().map_or(Next::Stop, |worker| worker.work_off(&queue));
            if matches!(next, Next::Stop)
                && let Some(mut worker) = running.take()
            {
                drop(running);
                worker.mapper.stop_chart();
                let lasted = detection.stop();
                let found = queue.try_iter().filter_map(|item| match item {
                    Incoming::Heard(heard) => Some(*heard),
                    _ => None,
                });
                found.chain(lasted).for_each(|heard| worker.heard(heard));
                worker.diagnose(0);
                return worker.outputs;
            }
        }
    }
}

impl Worker {
    /// Handles all items, until none is left or diagnostics are due; then detects silence and publishes diagnostics.
    fn work_off(&mut self, incoming: &Receiver<Incoming>) -> Next {
        loop {
            self.follow_lifecycle();
            while self.backlog.len() < QUEUE {
                match incoming.try_recv() {
                    Ok(later) => self.admit(later),
                    Err(TryRecvError::Disconnected) if self.backlog.is_empty() => return Next::Stop,
                    Err(_) => break,
                }
            }
            match self.backlog.pop_front() {
                None => break,
                Some(Incoming::Stop) => return Next::Stop,
                Some(Incoming::Input(received)) => {
                    self.inputs_waiting -= 1;
                    // It came before the node was deactivated.
                    if self.state == State::Active || self.lifecycle.receives() {
                        self.input(received);
                    }
                }
                Some(Incoming::Vibration(received)) => self.vibration(received),
                Some(Incoming::Temperature(received)) => self.temperature(received),
                Some(Incoming::Heard(heard)) => self.heard(*heard),
                Some(Incoming::Parameter { name, value }) => self.parameter(name, value),
                Some(Incoming::Computed { request, map, result }) => self.computed(&request, map.as_ref(), result),
                Some(Incoming::Sensitivity(found)) => self.sensitivity(*found),
                Some(Incoming::Chart { rig, chart }) => self.chart(&rig, chart),
                Some(Incoming::Rig { celsius, result }) => self.rig_ready(celsius, result),
                Some(Incoming::Lifecycle) => {}
            }
            if Instant::now() >= self.next_diagnostics {
                break;
            }
        }
        let nothing_waits = self.backlog.is_empty() && incoming.is_empty();
        if nothing_waits && self.silence_deadline().is_some_and(|deadline| Instant::now() >= deadline) {
            self.silence();
        }
        if Instant::now() >= self.next_diagnostics {
            self.next_diagnostics = Instant::now() + DIAGNOSTICS_EVERY;
            self.diagnose(self.backlog.len() + incoming.len());
        }
        // Diagnostics may have interrupted a backlog: wait only if it is empty.
        if self.backlog.is_empty() { Next::Wait(self.deadline()) } else { Next::GoOn }
    }

    /// The time of the next diagnostics or silence.
    fn deadline(&self) -> Instant {
        self.silence_deadline().map_or(self.next_diagnostics, |silence| silence.min(self.next_diagnostics))
    }

    /// Whether `input` can be predicted on the receiving thread: nothing waits before it and it needs no dense solve.
    /// The first input, and the first after a silence, are queued instead: they wake the node's thread, which then
    /// watches for the next silence.
    fn answers_at_once(&self, input: &msgs::OperatingPoint) -> bool {
        let received_lately = self.last_received.is_some() && !self.silent;
        self.backlog.is_empty() && received_lately && self.session.answers_at_once(&conditions(input))
    }

    /// Predicts for an input on the thread that received it.
    fn answer(&mut self, received: Received<msgs::OperatingPoint>) {
        if self.is_new(&received) {
            self.input(received);
        }
    }

    fn begin(&mut self) {
        self.watch.settings(self.session.settings());
        self.statistics.state(self.state);
        self.watch.state(self.state);
        if self.state.is_prepared() {
            self.prepare();
        }
    }

    /// Appends an item to the backlog. Duplicates from the other bus are dropped here: once queued, a duplicate would
    /// count as a newer input, and the original would be passed over for it.
    fn admit(&mut self, next: Incoming) {
        if let Incoming::Input(received) = &next {
            if !self.is_new(received) {
                return;
            }
            self.inputs_waiting += 1;
        }
        self.backlog.push_back(next);
    }

    /// Whether the input has not already come over the other bus.
    fn is_new(&mut self, received: &Received<msgs::OperatingPoint>) -> bool {
        let is_new = self.received_before.is_new(received.bus, received.message.header.stamp, received.message.seq);
        self.statistics.duplicates += u64::from(!is_new);
        is_new
    }

    /// Predicts for an input. If it is too old, or too many inputs wait behind it, it is recorded but passed over.
    fn input(&mut self, received: Received<msgs::OperatingPoint>) {
        self.last_received = Some(Instant::now());
        self.silent = false;
        self.statistics.received(received.bus);
        let started = clock::monotonic_ns();
        let age = Duration::from_nanos(started.saturating_sub(received.at.monotonic_ns));
        let too_many = self.prediction_times.least() * self.inputs_waiting as u32 > CATCH_UP;
        self.passing_over = self.inputs_waiting > 0 && (self.passing_over || too_many || age > LATEST);
        if self.passing_over {
            self.statistics.passed_over += 1;
            self.outputs.record(received.at, Payload::OperatingPoint(received.message));
            return;
        }
        let point = conditions(&received.message);
        self.point = point;
        let worked_before = self.session.counters().worked();
        self.step(Event::Input(received.message.clone()), Some(received));
        let took = Duration::from_nanos(clock::monotonic_ns().saturating_sub(started));
        self.statistics.predicted(took);
        self.sensitivity_due(point);
        if self.session.counters().worked() > worked_before {
            self.prediction_times.note(took);
        }
    }

    /// Shows and records a measured vibration. The session does not get it, so predictions are the same with and
    /// without.
    fn vibration(&mut self, received: Received<msgs::Vibration>) {
        // A vibration has no sequence number. The copies that come over both buses have the same stamp and the same
        // frequency bit by bit.
        let vibration = received.message;
        if self.vibration_received_before.is_new(received.bus, vibration.header.stamp, vibration.frequency_hz.to_bits())
        {
            self.watch.vibration(received.at.wall_ns, &vibration);
            self.outputs.record(received.at, Payload::Vibration(vibration));
        }
    }

    /// Takes note that a task of the background thread has ended and starts the next one.
    fn task_done(&mut self, served: impl Fn(&OperatingPoint) -> bool) {
        self.mapper.done();
        self.follow_temperature();
        self.mapper.start_next(served);
    }

    /// Publishes, shows and records a squeal found in received samples.
    fn heard(&mut self, heard: msgs::Heard) {
        self.watch.heard(&heard);
        self.outputs.heard(heard);
    }

    /// Changes a setting. One that has this value already is no event.
    fn parameter(&mut self, name: String, value: f64) {
        if self.session.settings().values().any(|setting| setting == (name.as_str(), value)) {
            return;
        }
        self.record_and_step(Event::Parameter { name, value }, now_header());
        self.watch.settings(self.session.settings());
    }

    /// Hands the result of a request to the session. `requested_of` is the map in force when it was made.
    fn computed(
        &mut self,
        request: &Request,
        requested_of: Option<&Arc<StabilityMap>>,
        result: Result<Option<Event>, String>,
    ) {
        let (rig, tolerance) = (self.rig.clone(), self.session.settings().map_tolerance);
        match &result {
            Ok(Some(Event::MapReady(map))) => self.task_done(|wish| map_serves(&rig.model, map, wish, tolerance)),
            Err(_) if matches!(request, Request::Map(_)) => {
                self.mapper.give_up_on(*request.point());
                self.task_done(|_| false);
            }
            Ok(_) | Err(_) => self.task_done(|_| false),
        }
        // Ends belong to their map: those of a map that is no longer in force are discarded.
        let in_force = match (self.session.map(), requested_of) {
            (Some(map), Some(of)) => Arc::ptr_eq(map, of),
            (None, _) | (_, None) => false,
        };
        match (request, result) {
            (_, Err(reason)) => self.statistics.map_failure = Some(reason),
            (Request::Map(_), Ok(event)) => {
                self.statistics.maps += 1;
                self.statistics.map_failure = None;
                if let Some(event) = event {
                    self.record_and_step(event, now_header());
                }
            }
            (Request::Ends(_), Ok(Some(event))) if in_force => {
                self.statistics.ends += 1;
                self.record_and_step(event, now_header());
            }
            (Request::Ends(point), Ok(None)) if in_force => self.mapper.request_map(*point),
            (Request::Ends(_), Ok(_)) => {}
        }
    }

    /// Requests the sensitivities of the prediction at `point`, at most every [`SENSITIVITY_EVERY`] and only if they
    /// are subscribed to or recorded.
    fn sensitivity_due(&mut self, point: OperatingPoint) {
        let now = Instant::now();
        if now < self.next_sensitivity {
            return;
        }
        self.next_sensitivity = now + SENSITIVITY_EVERY;
        let prediction = self.session.prediction();
        if prediction.level == msgs::level::FAULT || !self.outputs.want_sensitivities() {
            return;
        }
        let question = Question::new(prediction, point);
        let map = self.session.numbering_at(&point).cloned();
        let ends = self.session.map_at(&point).and_then(|_| self.session.ends().cloned());
        if !self.mapper.request_sensitivity(question, map, ends) {
            self.next_sensitivity = now; // busy: the next prediction will do as well
        }
    }

    fn sensitivity(&mut self, found: Result<msgs::Sensitivity, String>) {
        self.task_done(|_| false);
        match found {
            Ok(sensitivity) => {
                self.statistics.sensitivities += 1;
                self.outputs.sensitivity(sensitivity);
            }
            Err(reason) => self.statistics.sensitivity_failure = Some(reason),
        }
    }

    fn chart(&mut self, rig: &Arc<Rig>, chart: Result<Arc<Chart>, String>) {
        // The chart of a rig that was replaced before its build was stopped is discarded.
        if !Arc::ptr_eq(rig, &self.rig) {
            return;
        }
        match chart {
            Ok(chart) => {
                self.statistics.charted(&chart);
                self.record_and_step(Event::ChartReady(chart), now_header());
            }
            Err(reason) => self.statistics.chart_failure = Some(reason),
        }
    }

    /// When the current silence exceeds its timeout; `None` before the first input and once the silence is published.
    fn silence_deadline(&self) -> Option<Instant> {
        let timeout = Duration::try_from_secs_f64(self.session.settings().silence_timeout_s).ok()?;
        self.last_received.filter(|_| !self.silent)?.checked_add(timeout)
    }

    fn silence(&mut self) {
        self.silent = true;
        self.watch.silence();
        self.statistics.silence();
        let header = now_header();
        self.record_and_step(Event::Silence { stamp: header.stamp }, header);
    }

    /// Records and publishes an event that is not an input, shows it, then hands it to the session.
    fn record_and_step(&mut self, event: Event, header: Header) {
        if let Some(record) = record_of(&event, header) {
            self.outputs.session_event(record);
        }
        match &event {
            Event::MapReady(map) => self.watch.map(map),
            Event::EndsReady(ends) => self.watch.ends(ends),
            Event::RigReady(rig) => {
                self.rig = rig.clone();
                self.mapper.take_rig(rig.clone());
                self.watch.rig(rig);
                self.statistics.rig_replaced();
            }
            Event::Input(_) | Event::Parameter { .. } | Event::Silence { .. } | Event::ChartReady(_) => {}
        }
        self.step(event, None);
    }

    /// Feeds an event to the session; `input` is the received message if the event is one. The prediction is published
    /// first, since readers wait for it. Then input and prediction are recorded, in this order.
    fn step(&mut self, event: Event, input: Option<Received<msgs::OperatingPoint>>) {
        match self.session.step(event) {
            Ok(effects) => {
                if let Some(prediction) = effects.publish {
                    self.statistics.published(prediction.level);
                    self.outputs.prediction(prediction);
                    if let Some(received) = input {
                        self.watch.input(&received.message);
                        self.outputs.record(received.at, Payload::OperatingPoint(received.message));
                    }
                    self.outputs.record_prediction(prediction);
                    self.watch.prediction(prediction);
                    self.detection.predicted(prediction);
                }
                match effects.request {
                    Some(Request::Map(point)) => self.mapper.request_map(point),
                    Some(Request::Ends(point)) => {
                        if let Some(map) = self.session.map() {
                            self.mapper.request_ends(map.clone(), point);
                        }
                    }
                    None => {}
                }
            }
            Err(refused) => self.statistics.refused = Some(refused.to_string()),
        }
    }

    fn diagnose(&mut self, queued: usize) {
        let counters = self.session.counters();
        let pending = self.mapper.pending();
        let sound = self.detection.report();
        let outputs = &mut self.outputs;
        self.statistics.unheard = self.lifecycle.unheard();
        self.statistics.temperature_timeout_s = self.session.settings().temperature_timeout_s;
        let array = self.statistics.report(now_header(), &self.rig, counters, queued, pending, sound, outputs);
        self.watch.diagnostics(&array, counters, self.statistics.passed_over, self.statistics.restarts);
        self.watch.recording_problem(self.outputs.recorder.as_ref().and_then(|recorder| recorder.status().problem()));
        self.log.write(&array, &mut self.outputs);
        self.outputs.diagnostics(array);
    }
}

/// What the node's thread does next.
enum Next {
    Wait(Instant),
    GoOn,
    Stop,
}

/// Durations of the latest predictions.
#[derive(Default)]
struct Times {
    latest: [Duration; TIMED],
    count: usize,
}

impl Times {
    fn note(&mut self, took: Duration) {
        self.latest[self.count % TIMED] = took;
        self.count += 1;
    }

    /// The shortest of them; zero if there are none.
    fn least(&self) -> Duration {
        self.latest[..self.count.min(TIMED)].iter().min().copied().unwrap_or_default()
    }
}

/// The message that describes the rig of a node.
pub fn rig_info(rig: &Rig) -> RigInfo {
    RigInfo {
        name: rig.name.clone(),
        content_hash: rig.content_hash.clone(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        mode_count: rig.model.dimension() as u32,
        band_max_hz: rig.band_max_hz.unwrap_or(f64::NAN),
        reduction: rig.reduction.as_ref().map(Certificate::summary).unwrap_or_default(),
    }
}

fn now_header() -> Header {
    Header { stamp: Time::from_ns(clock::now_ns()), frame_id: String::new() }
}
