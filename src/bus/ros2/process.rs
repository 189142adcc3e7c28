//! The ROS 2 side of a node as a child process, as the node sees it: started, watched and restarted.
//!
//! The node never waits for it: messages to publish go into a bounded queue.

use std::borrow::Cow;
use std::collections::HashMap;
use std::io::{BufRead, BufReader, BufWriter, Read, Write};
use std::net::Shutdown;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, ChildStderr, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded, select};

use super::frame::{Frames, FromSide, MAX_FROM_SIDE, Next, Start, Status, ToSide, encode};
use super::{NOTE, Ros2Error, Ros2Options};
use crate::bus::lifecycle::State;
use crate::bus::log::{ROSOUT, Severity};
use crate::bus::received::{Counts, Received};
use crate::msgs::{
    DiagnosticArray, Heard, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent, SessionEventKind,
    Temperature, Vibration, Waveform, topic,
};

/// The command that runs the ROS 2 side of a node.
pub const COMMAND: &str = "ros2-side";
/// This program, even if its file has been replaced since.
const THIS_PROGRAM: &str = "/proc/self/exe";
/// Capacity of the queue to the ROS 2 side; messages beyond it are lost and counted.
const QUEUE: usize = 4096;
/// Read timeout of the socket, after which the supervisor checks the state of the process.
const READ_TIMEOUT: Duration = Duration::from_millis(100);
/// Number of consecutive timeouts after which the ROS 2 side counts as hanging: 10 s while it joins the network, 5 s
/// later. Timeouts are counted instead of time, so that a pause of the node itself is not taken for a fault of its ROS
/// 2 side.
const MAX_TIMEOUTS_JOINING: u32 = 100;
const MAX_TIMEOUTS: u32 = 50;
/// Time that the ROS 2 side may take to leave the network.
const LEAVE_WITHIN: Duration = Duration::from_millis(500);
/// Pause before the second consecutive start. It doubles up to `LONGEST_PAUSE`; after a run of `STEADY` the next start
/// is immediate.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
const STEADY: Duration = Duration::from_secs(10);
/// Time within which the first start is repeated if the ROS 2 side fails before it has joined the network.
const START_WITHIN: Duration = Duration::from_secs(10);
/// Bytes kept of the end of its standard error.
const MAX_LAST_WORDS: usize = 500;

/// Called with the name and the value of a parameter.
type ParameterSink = Box<dyn FnMut(&str, f64) + Send>;

/// Callbacks for what the ROS 2 side receives. They run on a thread that must not block.
pub struct Sinks {
    pub input: Box<dyn FnMut(Received<OperatingPoint>) + Send>,
    pub vibration: Box<dyn FnMut(Received<Vibration>) + Send>,
    pub temperature: Box<dyn FnMut(Received<Temperature>) + Send>,
    pub waveform: Box<dyn FnMut(Received<Waveform>) + Send>,
    /// A peer set a parameter.
    pub parameter: ParameterSink,
    /// A peer brought the node into this state.
    pub lifecycle: Box<dyn FnMut(State) + Send>,
    /// The ROS 2 side failed, and why; it is being restarted.
    pub fell: Box<dyn FnMut(&str) + Send>,
}

/// State of the ROS 2 side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Health {
    /// Whether it is running and has joined the network.
    pub up: bool,
    /// Number of failures, and the latest reason.
    pub falls: u64,
    pub last_fall: String,
    /// Messages that DDS refused to publish, and the latest reason.
    pub refused: u64,
    pub last_refusal: String,
    /// Its process id; 0 before the first start.
    pub process_id: u32,
}

/// The ROS 2 side of a node: receives operating points, the measured vibration and samples, and publishes all other topics.
pub struct Ros2Process {
    /// `None` once it has to end.
    queue: Option<Sender<Vec<u8>>>,
    /// What it is called.
    side: &'static str,
    shared: Arc<Shared>,
    supervisor: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    seen: Mutex<Seen>,
    stopping: AtomicBool,
}

/// What is known about the ROS 2 side.
#[derive(Default)]
struct Seen {
    health: Health,
    status: Status,
    /// Counts of the previous processes.
    counts_before: Counts,
    waveform_counts_before: Counts,
    refused_before: u64,
    full_name: String,
    /// The parameters that the session has taken.
    parameters: HashMap<String, f64>,
    /// The rig message, sent to every new process for its late subscribers.
    rig: Option<Vec<u8>>,
}

impl Shared {
    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }
}

impl Ros2Process {
    /// Starts the ROS 2 side and waits until it has joined the network.
    ///
    /// # Errors
    /// As [`super::Ros2::start`]; the process cannot be started.
    pub fn start(
        options: &Ros2Options,
        parameters: Vec<(String, f64)>,
        state: State,
        sinks: Sinks,
    ) -> Result<Self, Ros2Error> {
        Self::start_program(THIS_PROGRAM.into(), options, parameters, state, sinks)
    }

    /// As [`Self::start`], with `program` as the executable that has the [`COMMAND`].
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_program(
        program: PathBuf,
        options: &Ros2Options,
        parameters: Vec<(String, f64)>,
        state: State,
        sinks: Sinks,
    ) -> Result<Self, Ros2Error> {
        let (queue, queued) = bounded(QUEUE);
        let shared = Arc::new(Shared::default());
        let start = Start { options: options.clone(), parameters, state };
        let (joined, waiting) = bounded(1);
        let mut supervisor = Supervisor { program, start, sinks, queued, shared: shared.clone(), joined: Some(joined) };
        let supervisor = thread::Builder::new().name("ros2 side".to_owned()).spawn(move || supervisor.run())?;
        let side = options.middleware.side();
        let this = Self { queue: Some(queue), side, shared, supervisor: Some(supervisor) };
        // The supervisor limits the waiting time. It only fails to answer if it panicked.
        waiting.recv().unwrap_or_else(|_| Err(Ros2Error::Side("its supervisor failed".to_owned())))?;
        Ok(this)
    }

    fn send(&self, topic: &'static str, frame: &ToSide<'_>) -> Result<(), Ros2Error> {
        let failed = |reason: String| Ros2Error::Publish { topic, reason };
        self.send_bytes(topic, encode(frame).map_err(|error| failed(error.to_string()))?)
    }

    fn send_bytes(&self, topic: &'static str, bytes: Vec<u8>) -> Result<(), Ros2Error> {
        let sent = self.queue.as_ref().is_some_and(|queue| queue.try_send(bytes).is_ok());
        let full = || Ros2Error::Publish { topic, reason: format!("{QUEUE} messages wait for {}", self.side) };
        if sent { Ok(()) } else { Err(full()) }
    }

    /// Publishes a prediction without blocking.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`], as for the other topics: the queue is full. Errors of DDS appear in [`Self::health`].
    pub fn publish_prediction(&self, prediction: &Prediction) -> Result<(), Ros2Error> {
        self.send(topic::PREDICTION, &ToSide::Prediction(Cow::Borrowed(prediction)))
    }

    /// Publishes the description of the rig, which is kept for late subscribers.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_rig(&self, rig: &RigInfo) -> Result<(), Ros2Error> {
        let failed = |reason: String| Ros2Error::Publish { topic: topic::RIG, reason };
        let bytes = encode(&ToSide::Rig(Cow::Borrowed(rig))).map_err(|error| failed(error.to_string()))?;
        self.shared.seen().rig = Some(bytes.clone());
        self.send_bytes(topic::RIG, bytes)
    }

    /// Publishes a session event.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_session_event(&self, event: &SessionEvent) -> Result<(), Ros2Error> {
        if SessionEventKind::of(event) == Some(SessionEventKind::Parameter) {
            self.shared.seen().parameters.insert(event.name.clone(), event.value);
        }
        self.send(topic::SESSION_EVENT, &ToSide::SessionEvent(Cow::Borrowed(event)))
    }

    /// Publishes sensitivities.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_sensitivity(&self, sensitivity: &Sensitivity) -> Result<(), Ros2Error> {
        self.send(topic::SENSITIVITY, &ToSide::Sensitivity(Cow::Borrowed(sensitivity)))
    }

    /// Publishes diagnostics.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_diagnostics(&self, diagnostics: &DiagnosticArray) -> Result<(), Ros2Error> {
        self.send(topic::DIAGNOSTICS, &ToSide::Diagnostics(Cow::Borrowed(diagnostics)))
    }

    /// Publishes a squeal found in sound.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_heard(&self, heard: &Heard) -> Result<(), Ros2Error> {
        self.send(topic::HEARD, &ToSide::Heard(Cow::Borrowed(heard)))
    }

    /// Writes a line to `/rosout`.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn log(&self, severity: Severity, text: &str) -> Result<(), Ros2Error> {
        self.send(ROSOUT, &ToSide::Log(severity, Cow::Borrowed(text)))
    }

    /// Number of readers of the predictions, including killed ones whose lease has not expired.
    pub fn prediction_readers(&self) -> usize {
        self.shared.seen().status.prediction_readers as usize
    }

    /// Number of readers of the sensitivities, including killed ones whose lease has not expired.
    pub fn sensitivity_readers(&self) -> usize {
        self.shared.seen().status.sensitivity_readers as usize
    }

    /// Number of known publishers of operating points, including killed ones whose lease has not expired.
    pub fn operating_point_writers(&self) -> usize {
        self.shared.seen().status.operating_point_writers as usize
    }

    /// Counts of operating points so far, over all processes.
    pub fn counts(&self) -> Counts {
        let seen = self.shared.seen();
        seen.counts_before.plus(seen.status.counts)
    }

    /// Counts of blocks of samples so far, over all processes.
    pub fn waveform_counts(&self) -> Counts {
        let seen = self.shared.seen();
        seen.waveform_counts_before.plus(seen.status.waveform_counts)
    }

    /// The current state of the ROS 2 side.
    pub fn health(&self) -> Health {
        let seen = self.shared.seen();
        Health { refused: seen.refused_before + seen.status.refused, ..seen.health.clone() }
    }

    /// The node's full name, after remapping.
    pub fn full_name(&self) -> String {
        self.shared.seen().full_name.clone()
    }

    /// Leaves the network, as dropping does.
    pub fn stop(self) {}
}

impl Drop for Ros2Process {
    fn drop(&mut self) {
        self.shared.stopping.store(true, Ordering::Relaxed);
        self.queue = None;
        if let Some(supervisor) = self.supervisor.take() {
            // A panic of a sink was reported on that thread.
            let _ = supervisor.join();
        }
    }
}

/// Starts the ROS 2 side, and restarts it whenever it fails.
struct Supervisor {
    program: PathBuf,
    start: Start,
    sinks: Sinks,
    queued: Receiver<Vec<u8>>,
    shared: Arc<Shared>,
    /// Waiting for the result of the first start.
    joined: Option<Sender<Result<(), Ros2Error>>>,
}

/// Why a ROS 2 side has ended.
enum End {
    /// On request.
    Stopped,
    /// It cannot join the network, and why.
    Refused(String),
    Fell(String),
}

impl Supervisor {
    fn run(&mut self) {
        let (begun, mut pause) = (Instant::now(), Duration::ZERO);
        loop {
            let started = Instant::now();
            let end = self.serve_one().unwrap_or_else(|error| End::Fell(error.to_string()));
            let (why, is_final) = match end {
                End::Stopped => return,
                End::Refused(why) => (why, true),
                End::Fell(why) => (why, begun.elapsed() > START_WITHIN),
            };
            if is_final && let Some(joined) = self.joined.take() {
                // The first start failed: report it to the caller.
                let _ = joined.send(Err(Ros2Error::Side(why)));
                return;
            }
            self.fell(why);
            pause = if started.elapsed() >= STEADY {
                Duration::ZERO
            } else {
                (2 * pause).clamp(FIRST_PAUSE, LONGEST_PAUSE)
            };
            let until = Instant::now() + pause;
            while Instant::now() < until && !self.shared.stopping() {
                thread::sleep(READ_TIMEOUT.min(until.saturating_duration_since(Instant::now())));
            }
            if self.shared.stopping() {
                return;
            }
        }
    }

    /// Takes note of a failure and keeps the counts.
    fn fell(&mut self, why: String) {
        let mut seen = self.shared.seen();
        let status = std::mem::take(&mut seen.status);
        seen.counts_before = seen.counts_before.plus(status.counts);
        seen.waveform_counts_before = seen.waveform_counts_before.plus(status.waveform_counts);
        seen.refused_before += status.refused;
        seen.health.up = false;
        seen.health.falls += 1;
        seen.health.last_fall.clone_from(&why);
        drop(seen);
        (self.sinks.fell)(&why);
    }

    /// Starts a ROS 2 side and serves it until it ends.
    fn serve_one(&mut self) -> std::io::Result<End> {
        let (socket, theirs) = UnixStream::pair()?;
        let mut process = Command::new(&self.program)
            .arg0("squealcast")
            .arg(COMMAND)
            .stdin(Stdio::from(OwnedFd::from(theirs)))
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Terminal signals are for the node, which ends its ROS 2 side itself.
            .process_group(0)
            .spawn()?;
        self.shared.seen().health.process_id = process.id();
        let last_words = process.stderr.take().map(|stderr| thread::spawn(move || last_words(stderr)));
        let end = self.converse(&socket);
        let status = end_process(&mut process, !matches!(end, Err(_) | Ok(Some(End::Fell(_)))))?;
        let last_words = last_words.and_then(|thread| thread.join().ok()).unwrap_or_default();
        Ok(match end? {
            Some(end) => end,
            None => End::Fell(why_it_ended(status, &last_words)),
        })
    }

    /// Exchanges frames with a ROS 2 side; `None` if it closed its socket.
    fn converse(&mut self, socket: &UnixStream) -> std::io::Result<Option<End>> {
        socket.set_read_timeout(Some(READ_TIMEOUT))?;
        for (name, value) in &mut self.start.parameters {
            *value = self.shared.seen().parameters.get(name).copied().unwrap_or(*value);
        }
        let start = encode(&ToSide::Start(self.start.clone())).map_err(std::io::Error::other)?;
        let first: Vec<Vec<u8>> = std::iter::once(start).chain(self.shared.seen().rig.clone()).collect();
        let (writing, queued) = (socket.try_clone()?, self.queued.clone());
        let (over, is_over) = bounded::<()>(0);
        thread::scope(|scope| {
            scope.spawn(move || write(writing, first, &queued, &is_over));
            let end = self.listen(socket);
            // Unblocks the writer, whatever it waits for.
            drop(over);
            let _ = socket.shutdown(Shutdown::Both);
            end
        })
    }

    fn listen(&mut self, socket: &UnixStream) -> std::io::Result<Option<End>> {
        let mut frames = Frames::new(socket, MAX_FROM_SIDE);
        let (mut timeouts, mut patience, mut stopping_since) = (0, MAX_TIMEOUTS_JOINING, None::<Instant>);
        loop {
            timeouts += 1;
            match frames.next::<FromSide>() {
                Ok(Next::Frame(FromSide::Refused(why))) => return Ok(Some(End::Refused(why))),
                Ok(Next::Frame(frame)) => {
                    self.take(frame);
                    timeouts = 0;
                }
                Ok(Next::Nothing) => {}
                Ok(Next::End) if self.shared.stopping() => return Ok(Some(End::Stopped)),
                Ok(Next::End) => return Ok(None),
                Err(error) => return Ok(Some(End::Fell(error.to_string()))),
            }
            if timeouts == 0 {
                patience = MAX_TIMEOUTS; // any frame means that it has joined
            }
            if timeouts >= patience {
                let seconds = (patience * READ_TIMEOUT).as_secs();
                return Ok(Some(End::Fell(format!("no message for {seconds} s"))));
            }
            if self.shared.stopping() && stopping_since.get_or_insert_with(Instant::now).elapsed() > LEAVE_WITHIN {
                return Ok(Some(End::Stopped));
            }
        }
    }

    fn take(&mut self, frame: FromSide) {
        let bus = self.start.options.middleware.bus();
        match frame {
            FromSide::Joined(full_name) => {
                let mut seen = self.shared.seen();
                seen.full_name = full_name;
                seen.health.up = true;
                if let Some(joined) = self.joined.take() {
                    let _ = joined.send(Ok(()));
                }
            }
            FromSide::Refused(_) => {}
            FromSide::Input { at, message } => (self.sinks.input)(Received { bus, at, message }),
            FromSide::Vibration { at, message } => (self.sinks.vibration)(Received { bus, at, message }),
            FromSide::Temperature { at, message } => (self.sinks.temperature)(Received { bus, at, message }),
            FromSide::Waveform { at, message } => (self.sinks.waveform)(Received { bus, at, message }),
            FromSide::Parameter { name, value } => {
                if let Some(parameter) = self.start.parameters.iter_mut().find(|(known, _)| *known == name) {
                    parameter.1 = value;
                }
                (self.sinks.parameter)(&name, value);
            }
            FromSide::Lifecycle(state) => {
                self.start.state = state;
                (self.sinks.lifecycle)(state);
            }
            FromSide::Status(status) => {
                let mut seen = self.shared.seen();
                if !status.last_refusal.is_empty() {
                    seen.health.last_refusal.clone_from(&status.last_refusal);
                }
                seen.status = status;
            }
        }
    }
}

/// Writes `first`, then the queued frames, until all senders are gone, the socket fails, or `is_over` is closed.
fn write(socket: UnixStream, first: Vec<Vec<u8>>, queued: &Receiver<Vec<u8>>, is_over: &Receiver<()>) {
    let mut out = BufWriter::new(&socket);
    for bytes in first {
        if out.write_all(&bytes).is_err() {
            return;
        }
    }
    loop {
        if queued.is_empty() && out.flush().is_err() {
            return;
        }
        select! {
            recv(queued) -> bytes => match bytes {
                Ok(bytes) if out.write_all(&bytes).is_ok() => {}
                Ok(_) => return,
                Err(_) => break,
            },
            recv(is_over) -> _ => return,
        }
    }
    let _ = out.flush();
    let _ = socket.shutdown(Shutdown::Write);
}

/// Waits for a process to end. With `gently` it gets [`LEAVE_WITHIN`] to do so itself before it is killed.
fn end_process(process: &mut Child, gently: bool) -> std::io::Result<ExitStatus> {
    let until = Instant::now() + LEAVE_WITHIN;
    while gently && Instant::now() < until {
        if let Some(status) = process.try_wait()? {
            return Ok(status);
        }
        thread::sleep(Duration::from_millis(2));
    }
    process.kill()?;
    process.wait()
}

/// The last line that a process wrote to its standard error, except Rust's hint about backtraces. Its notes are written
/// to this process's standard error.
fn last_words(stderr: ChildStderr) -> String {
    let (mut kept, mut line, mut stderr) = (Vec::new(), Vec::new(), BufReader::new(stderr));
    while let Ok(1..) = (&mut stderr).take(MAX_LAST_WORDS as u64).read_until(b'\n', &mut line) {
        if line.starts_with(NOTE.as_bytes()) {
            note!("{}", String::from_utf8_lossy(&line).trim_end());
        }
        kept.append(&mut line);
        kept.drain(..kept.len().saturating_sub(MAX_LAST_WORDS));
    }
    let text = String::from_utf8_lossy(&kept);
    let says_why = |line: &&str| !line.trim().is_empty() && !line.starts_with("note: ");
    let line = text.lines().rev().find(says_why).unwrap_or_default();
    line.chars().filter(|character| !character.is_control()).collect()
}

fn why_it_ended(status: ExitStatus, last_words: &str) -> String {
    if last_words.is_empty() { status.to_string() } else { format!("{last_words} ({status})") }
}
