//! The ROS 2 side of a node as a process of its own, seen from the node: started, watched, and started again.
//!
//! Nothing of the node waits for it: what is published goes into a bounded queue.

use std::borrow::Cow;
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
use crate::io::heard::{Bus, Counts, Heard};
use crate::wire::{DiagnosticArray, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent, Vibration, topic};

/// The command that is the ROS 2 side of a node.
pub const COMMAND: &str = "ros2-side";
/// This program, even where its file was replaced meanwhile.
const THIS_PROGRAM: &str = "/proc/self/exe";
/// Messages that may wait for the ROS 2 side; what comes then is lost and counted.
const QUEUE: usize = 4096;
/// The longest wait for anything from the ROS 2 side before the next look at the state of affairs.
const READ_TIMEOUT: Duration = Duration::from_millis(100);
/// After this many timeouts in a row the ROS 2 side counts as hanging: 10 s while it joins the network, 5 s then. Counted
/// in timeouts, not by a clock, so that a pause of the node itself is no fault of its ROS 2 side.
const MAX_TIMEOUTS_JOINING: u32 = 100;
const MAX_TIMEOUTS: u32 = 50;
/// How long the ROS 2 side may take to leave the network.
const LEAVE_WITHIN: Duration = Duration::from_millis(500);
/// Pause before the second start in a row; it doubles up to the longest. After a run of `STEADY` the next start is at once.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
const STEADY: Duration = Duration::from_secs(10);
/// How long the first start may be tried again when the ROS 2 side falls before it has joined the network.
const START_WITHIN: Duration = Duration::from_secs(10);
/// How much of the end of its standard error is kept, bytes.
const MAX_LAST_WORDS: usize = 500;

/// What the node does with what its ROS 2 side hears; called on a thread that may not wait.
pub struct Sinks {
    pub input: Box<dyn FnMut(Heard<OperatingPoint>) + Send>,
    pub vibration: Box<dyn FnMut(Heard<Vibration>) + Send>,
    /// A peer set a parameter.
    pub parameter: Box<dyn FnMut(&str, f64) + Send>,
    /// The ROS 2 side fell, and why; another is being started.
    pub fell: Box<dyn FnMut(&str) + Send>,
}

/// How the ROS 2 side has fared.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Health {
    /// It is there and has joined the network.
    pub up: bool,
    /// How often it fell, and why it did last.
    pub falls: u64,
    pub last_fall: String,
    /// Messages that DDS refused to publish, and the latest reason.
    pub refused: u64,
    pub last_refusal: String,
    /// Its process; 0 before the first.
    pub process_id: u32,
}

/// The ROS 2 side of a node: hears operating points and the measured vibration, publishes everything else.
pub struct Ros2Process {
    /// `None` once it is to end.
    queue: Option<Sender<Vec<u8>>>,
    shared: Arc<Shared>,
    supervisor: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    seen: Mutex<Seen>,
    stopping: AtomicBool,
}

/// What is known of the ROS 2 side.
#[derive(Default)]
struct Seen {
    health: Health,
    status: Status,
    /// Of the processes before the present one.
    counts_before: Counts,
    refused_before: u64,
    full_name: String,
    /// Sent to every new one: readers that come later want it.
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
    /// As [`super::Ros2::start`], or the process cannot be started.
    pub fn start(options: &Ros2Options, parameters: Vec<(String, f64)>, sinks: Sinks) -> Result<Self, Ros2Error> {
        Self::start_program(THIS_PROGRAM.into(), options, parameters, sinks)
    }

    /// As [`Self::start`]; `program` is the one that has the [`COMMAND`].
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_program(
        program: PathBuf,
        options: &Ros2Options,
        parameters: Vec<(String, f64)>,
        sinks: Sinks,
    ) -> Result<Self, Ros2Error> {
        let (queue, queued) = bounded(QUEUE);
        let shared = Arc::new(Shared::default());
        let start = Start { options: options.clone(), parameters };
        let (joined, waiting) = bounded(1);
        let mut supervisor = Supervisor { program, start, sinks, queued, shared: shared.clone(), joined: Some(joined) };
        let supervisor = thread::Builder::new().name("ros2 side".to_owned()).spawn(move || supervisor.run())?;
        let this = Self { queue: Some(queue), shared, supervisor: Some(supervisor) };
        // The supervisor bounds the wait. It says nothing only if it panicked.
        waiting.recv().unwrap_or_else(|_| Err(Ros2Error::Side("its supervisor failed".to_owned())))?;
        Ok(this)
    }

    fn send(&self, topic: &'static str, frame: &ToSide<'_>) -> Result<(), Ros2Error> {
        let failed = |reason: String| Ros2Error::Publish { topic, reason };
        self.send_bytes(topic, encode(frame).map_err(|error| failed(error.to_string()))?)
    }

    fn send_bytes(&self, topic: &'static str, bytes: Vec<u8>) -> Result<(), Ros2Error> {
        let sent = self.queue.as_ref().is_some_and(|queue| queue.try_send(bytes).is_ok());
        let full = || Ros2Error::Publish { topic, reason: format!("{QUEUE} messages wait for the ROS 2 side") };
        if sent { Ok(()) } else { Err(full()) }
    }

    /// Publishes a prediction, without waiting.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`], as for the others: the queue is full. What DDS refuses later is in [`Self::health`].
    pub fn publish_prediction(&self, prediction: &Prediction) -> Result<(), Ros2Error> {
        self.send(topic::PREDICTION, &ToSide::Prediction(Cow::Borrowed(prediction)))
    }

    /// Publishes what the node predicts for; kept for readers that come later.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_rig(&self, rig: &RigInfo) -> Result<(), Ros2Error> {
        let failed = |reason: String| Ros2Error::Publish { topic: topic::RIG, reason };
        let bytes = encode(&ToSide::Rig(Cow::Borrowed(rig))).map_err(|error| failed(error.to_string()))?;
        self.shared.seen().rig = Some(bytes.clone());
        self.send_bytes(topic::RIG, bytes)
    }

    /// Publishes what else shaped predictions.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_session_event(&self, event: &SessionEvent) -> Result<(), Ros2Error> {
        self.send(topic::SESSION_EVENT, &ToSide::SessionEvent(Cow::Borrowed(event)))
    }

    /// Publishes how predictions change with conditions and contact.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_sensitivity(&self, sensitivity: &Sensitivity) -> Result<(), Ros2Error> {
        self.send(topic::SENSITIVITY, &ToSide::Sensitivity(Cow::Borrowed(sensitivity)))
    }

    /// Publishes how the node does.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_diagnostics(&self, diagnostics: &DiagnosticArray) -> Result<(), Ros2Error> {
        self.send(topic::DIAGNOSTICS, &ToSide::Diagnostics(Cow::Borrowed(diagnostics)))
    }

    /// How many readers the predictions have, those included that were killed less than their lease ago.
    pub fn prediction_readers(&self) -> usize {
        self.shared.seen().status.prediction_readers as usize
    }

    /// How many readers the sensitivities have, those included that were killed less than their lease ago.
    pub fn sensitivity_readers(&self) -> usize {
        self.shared.seen().status.sensitivity_readers as usize
    }

    /// How many publishers of operating points are known, those included that were killed less than their lease ago.
    pub fn operating_point_writers(&self) -> usize {
        self.shared.seen().status.operating_point_writers as usize
    }

    /// What was counted of the operating points so far.
    pub fn counts(&self) -> Counts {
        let seen = self.shared.seen();
        seen.counts_before.plus(seen.status.counts)
    }

    /// How the ROS 2 side has fared so far.
    pub fn health(&self) -> Health {
        let seen = self.shared.seen();
        Health { refused: seen.refused_before + seen.status.refused, ..seen.health.clone() }
    }

    /// The node's full name, after remapping.
    pub fn full_name(&self) -> String {
        self.shared.seen().full_name.clone()
    }

    /// Leaves the network; dropping does the same.
    pub fn stop(self) {}
}

impl Drop for Ros2Process {
    fn drop(&mut self) {
        self.shared.stopping.store(true, Ordering::Relaxed);
        self.queue = None;
        if let Some(supervisor) = self.supervisor.take() {
            // A sink that panicked has said so on its own thread.
            let _ = supervisor.join();
        }
    }
}

/// Starts the ROS 2 side again and again.
struct Supervisor {
    program: PathBuf,
    start: Start,
    sinks: Sinks,
    queued: Receiver<Vec<u8>>,
    shared: Arc<Shared>,
    /// Whoever waits for the first start.
    joined: Option<Sender<Result<(), Ros2Error>>>,
}

/// Why a ROS 2 side is no more.
enum End {
    /// It was to end.
    Stopped,
    /// It cannot join the network.
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
                // The first start failed: that is for whoever started the node.
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

    /// Takes note of a fall. What was counted stays.
    fn fell(&mut self, why: String) {
        let mut seen = self.shared.seen();
        let status = std::mem::take(&mut seen.status);
        seen.counts_before = seen.counts_before.plus(status.counts);
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
            // Signals of the terminal are for the node, which ends it when it is time.
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

    /// Exchanges frames with a ROS 2 side; `None` where it closed its socket.
    fn converse(&mut self, socket: &UnixStream) -> std::io::Result<Option<End>> {
        socket.set_read_timeout(Some(READ_TIMEOUT))?;
        let start = encode(&ToSide::Start(self.start.clone())).map_err(std::io::Error::other)?;
        let first: Vec<Vec<u8>> = std::iter::once(start).chain(self.shared.seen().rig.clone()).collect();
        let (writing, queued) = (socket.try_clone()?, self.queued.clone());
        let (over, is_over) = bounded::<()>(0);
        thread::scope(|scope| {
            scope.spawn(move || write(writing, first, &queued, &is_over));
            let end = self.listen(socket);
            // Whatever the writer waits for, it waits no longer.
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
                patience = MAX_TIMEOUTS; // the first frame says that it has joined
            }
            if timeouts >= patience {
                let seconds = (patience * READ_TIMEOUT).as_secs();
                return Ok(Some(End::Fell(format!("no sign of life for {seconds} s"))));
            }
            if self.shared.stopping() && stopping_since.get_or_insert_with(Instant::now).elapsed() > LEAVE_WITHIN {
                return Ok(Some(End::Stopped));
            }
        }
    }

    fn take(&mut self, frame: FromSide) {
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
            FromSide::Input { at, message } => (self.sinks.input)(Heard { bus: Bus::Ros2, at, message }),
            FromSide::Vibration { at, message } => (self.sinks.vibration)(Heard { bus: Bus::Ros2, at, message }),
            FromSide::Parameter { name, value } => {
                if let Some(parameter) = self.start.parameters.iter_mut().find(|(known, _)| *known == name) {
                    parameter.1 = value;
                }
                (self.sinks.parameter)(&name, value);
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

/// Writes `first`, then what is queued, until nobody can queue any more, the socket fails, or it `is_over`.
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

/// Waits for the end of a process, which it may find by itself, or ends it.
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

/// The last line that a process wrote to its standard error, Rust's hint about backtraces aside. Its notes are repeated here.
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
