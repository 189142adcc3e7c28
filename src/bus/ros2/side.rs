//! The ROS 2 side of a node: the process that contains RustDDS, under a memory limit.
//!
//! RustDDS allocates what a datagram claims (a HEARTBEAT over 2^40 samples, a fragment of 4 GiB). In this arrangement
//! only this process dies of it, and the node starts another.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};
use rustix::process::{Resource, Rlimit, Signal, set_parent_process_death_signal, setrlimit};
use serde::Serialize;

use super::frame::{Frames, FromSide, MAX_TO_SIDE, Next, Start, Status, ToSide, encode};
use super::member::Member;
use super::{Beside, Describe, Middleware, Parameters, Ros2, Ros2Error};
use crate::bus::Outgoing;
use crate::bus::received::Received;
use crate::bus::zenoh::{self, Receivers, Take};
use crate::msgs::schema::Topic;
use crate::msgs::{MAX_WAVEFORM_SAMPLES, OperatingPoint, Prediction, Temperature, Vibration, Waveform};
use crate::system::memory;

/// Limit on the private memory of this process, bytes (`RLIMIT_DATA`). An allocation beyond it aborts the process.
const MEMORY_LIMIT: u64 = 256 << 20;
/// Resident memory above which this process ends in order to be restarted, bytes. RustDDS keeps part of the memory of
/// every peer that died.
const RESIDENT_LIMIT: usize = 128 << 20;
/// Capacity of the queue to a node that is held up, in messages: 8 s of inputs at 1 kHz.
const QUEUE: usize = 8192;
/// Largest CDR form of an input or vibration that is passed to the node, bytes. Larger ones count as malformed.
const MAX_INPUT: usize = 4096;
/// Largest CDR form of a block of samples that is passed to the node, bytes: its samples and 1024 bytes of text.
const MAX_BLOCK: usize = 4 * MAX_WAVEFORM_SAMPLES + 1024;
/// Blocks of samples beyond this are lost while the node is held up, bytes in the queue to it.
const MAX_BYTES_QUEUED: usize = 32 << 20;
/// Interval between checks of the numbers of readers and writers.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Interval between status frames while nothing changes.
const STATUS_EVERY: Duration = Duration::from_millis(250);
/// Predictions that a reader may leave unacknowledged before the publisher is renewed: 8 s at 1 kHz. With 64 modes each
/// they take 40 MB.
const MAX_UNANSWERED: i32 = 1 << 13;
/// Time for which predictions are held back after the publisher was renewed, so that its readers can find it.
const SETTLING: Duration = Duration::from_millis(100);
/// Time for which the previous publisher continues to retransmit lost samples.
const RETIREMENT: Duration = Duration::from_secs(1);
/// Number of predictions that are held back at most.
const MAX_HELD_BACK: usize = 8192;
/// Number of predictions held back that are published with each new one.
const HELD_BACK_AT_ONCE: usize = 4;
/// Number of checks without a beat of the receiving thread after which this process gives up: 5 s.
const MAX_LOOKS_WITHOUT_BEAT: u32 = 250;

/// Checks the value of a parameter; the error text is sent to the peer.
type Validate = fn(&str, f64) -> Result<(), String>;

/// Serves the node at the other end of standard input until it closes that socket. `validate` checks the values of
/// parameters, `describe` says what they are.
///
/// # Errors
/// Standard input is not a socket of a node, or the limits cannot be set.
pub fn serve(validate: Validate, describe: Describe) -> Result<(), Ros2Error> {
    let socket = UnixStream::from(io::stdin().as_fd().try_clone_to_owned()?);
    if socket.peer_addr().is_err() {
        return Err(Ros2Error::Side("standard input is no socket of a node: this command is for `run`".to_owned()));
    }
    contain()?;
    let (queue, queued) = bounded(QUEUE);
    let node = ToNode {
        queue,
        lost: Arc::default(),
        malformed: Arc::default(),
        blocks: Arc::default(),
        bytes_queued: Arc::default(),
    };
    let (to_node, bytes_queued) = (socket.try_clone()?, node.bytes_queued.clone());
    let writer =
        thread::Builder::new().name("to node".to_owned()).spawn(move || write(&to_node, &queued, &bytes_queued))?;
    let mut frames = Frames::new(socket.try_clone()?, MAX_TO_SIDE);
    let start = loop {
        match frames.next::<ToSide>().map_err(|error| Ros2Error::Side(error.to_string()))? {
            Next::Frame(ToSide::Start(start)) => break start,
            Next::Frame(other) => return Err(Ros2Error::Side(format!("{other:?} before the start"))),
            Next::Nothing => {}
            Next::End => return Ok(()),
        }
    };
    match join(start, validate, describe, &node) {
        Ok(ros2) => {
            node.send(&FromSide::Joined(ros2.full_name()));
            socket.set_read_timeout(Some(LOOK_EVERY))?;
            let side =
                Side { ros2, node, renewed: None, held_back: VecDeque::new(), refused: 0, last_refusal: String::new() };
            side.serve(&mut frames);
        }
        Err(error) => {
            node.send(&FromSide::Refused(error.to_string()));
            drop(node);
            // If the writer fails, it ends the process.
            let _ = writer.join();
        }
    }
    Ok(())
}

/// Limits the resources of this process, and ends it with its node or at the first panic. If a RustDDS thread panicked
/// alone, the process would stop receiving while appearing to work.
fn contain() -> io::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let limit = |most| Rlimit { current: Some(most), maximum: Some(most) };
    setrlimit(Resource::Data, limit(MEMORY_LIMIT))?;
    setrlimit(Resource::Core, limit(0))?;
    std::panic::set_hook(Box::new(|panic| {
        let payload = panic.payload();
        let message = payload.downcast_ref::<&str>().copied().or(payload.downcast_ref::<String>().map(String::as_str));
        let message = message.unwrap_or("no message").replace('\n', " ");
        let place = panic.location().map(ToString::to_string).unwrap_or_default();
        note!("panicked at {place}: {message}");
        process::abort();
    }));
    Ok(())
}

fn join(start: Start, validate: Validate, describe: Describe, node: &ToNode) -> Result<Box<dyn Member>, Ros2Error> {
    let [inputs, vibrations, temperatures, waveforms, parameters, states] = std::array::from_fn(|_| node.clone());
    let input: Take<OperatingPoint> =
        Box::new(move |Received { at, message, .. }| inputs.send_short(&FromSide::Input { at, message }));
    let vibration: Take<Vibration> =
        Box::new(move |Received { at, message, .. }| vibrations.send_short(&FromSide::Vibration { at, message }));
    let temperature: Take<Temperature> =
        Box::new(move |Received { at, message, .. }| temperatures.send_short(&FromSide::Temperature { at, message }));
    let waveform: Take<Waveform> =
        Box::new(move |Received { at, message, .. }| waveforms.send_block(&FromSide::Waveform { at, message }));
    let declared = Parameters {
        values: start.parameters,
        describe,
        validate: Box::new(validate),
        accepted: Box::new(move |name, value| {
            parameters.send(&FromSide::Parameter { name: name.to_owned(), value });
        }),
    };
    let changed = Box::new(move |state| states.send(&FromSide::Lifecycle(state)));
    match start.options.middleware {
        Middleware::Dds => {
            let beside = Some(Beside { temperature, waveform, state: start.state, changed });
            let ros2 = Ros2::start_with(&start.options, declared, MAX_UNANSWERED, input, vibration, beside)?;
            Ok(Box::new(ros2))
        }
        Middleware::Zenoh => zenoh::member(
            &start.options,
            Receivers {
                input: Some(input),
                vibration: Some(vibration),
                temperature: Some(temperature),
                waveform: Some(waveform),
                prediction: None,
            },
            declared,
            start.state,
            changed,
        ),
    }
}

/// The queue to the node. It never blocks: frames that do not fit are lost and counted.
#[derive(Clone)]
struct ToNode {
    queue: Sender<Vec<u8>>,
    lost: Arc<AtomicU64>,
    /// Messages that cannot be encoded as a frame, or only as one that is too long.
    malformed: Arc<AtomicU64>,
    /// The same of blocks of samples.
    blocks: Arc<Blocks>,
    bytes_queued: Arc<AtomicUsize>,
}

/// Blocks of samples that were not passed to the node.
#[derive(Default)]
struct Blocks {
    lost: AtomicU64,
    malformed: AtomicU64,
}

impl ToNode {
    fn send(&self, frame: &impl Serialize) {
        self.send_up_to(usize::MAX, frame);
    }

    /// Sends a frame whose length depends on peers.
    fn send_short(&self, frame: &impl Serialize) {
        self.send_up_to(MAX_INPUT, frame);
    }

    fn send_up_to(&self, limit: usize, frame: &impl Serialize) {
        match encode(frame) {
            Ok(bytes) if bytes.len() <= limit => self.queue(bytes, &self.lost),
            _ => drop(self.malformed.fetch_add(1, Ordering::Relaxed)),
        }
    }

    /// Sends a block of samples. Blocks must not fill the memory of this process.
    fn send_block(&self, frame: &impl Serialize) {
        match encode(frame) {
            Ok(bytes) if bytes.len() > MAX_BLOCK => drop(self.blocks.malformed.fetch_add(1, Ordering::Relaxed)),
            Ok(bytes) if self.bytes_queued.load(Ordering::Relaxed) + bytes.len() <= MAX_BYTES_QUEUED => {
                self.queue(bytes, &self.blocks.lost);
            }
            Ok(_) => drop(self.blocks.lost.fetch_add(1, Ordering::Relaxed)),
            Err(_) => drop(self.blocks.malformed.fetch_add(1, Ordering::Relaxed)),
        }
    }

    fn queue(&self, bytes: Vec<u8>, lost: &AtomicU64) {
        let length = bytes.len();
        // Before it is queued: the writer subtracts it.
        self.bytes_queued.fetch_add(length, Ordering::Relaxed);
        if self.queue.try_send(bytes).is_err() {
            self.bytes_queued.fetch_sub(length, Ordering::Relaxed);
            lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Writes the queued frames until all senders are gone. Ends the process if the node has gone.
fn write(mut socket: &UnixStream, queued: &Receiver<Vec<u8>>, bytes_queued: &AtomicUsize) {
    for bytes in queued {
        bytes_queued.fetch_sub(bytes.len(), Ordering::Relaxed);
        if socket.write_all(&bytes).is_err() {
            process::exit(0);
        }
    }
}

/// A ROS 2 side that has joined the network.
struct Side {
    ros2: Box<dyn Member>,
    node: ToNode,
    /// When the publisher of predictions was renewed; `None` once the previous one is dropped.
    renewed: Option<Instant>,
    held_back: VecDeque<Prediction>,
    refused: u64,
    last_refusal: String,
}

impl Side {
    /// Publishes what the node sends and reports the status to it, until the node closes the socket.
    fn serve(mut self, frames: &mut Frames<UnixStream>) {
        let (mut looked, mut reported) = (Instant::now(), None::<Instant>);
        let (mut last_status, mut last_beat, mut looks_without_beat) = (Status::default(), 0, 0);
        loop {
            match frames.next::<ToSide>() {
                Ok(Next::Frame(frame)) => self.publish(frame),
                Ok(Next::Nothing) => {}
                Ok(Next::End) => return,
                Err(error) => {
                    note!("socket of the node: {error}");
                    return;
                }
            }
            if looked.elapsed() < LOOK_EVERY {
                continue;
            }
            looked = Instant::now();
            self.publish_held_back();
            let beat = self.ros2.beats();
            looks_without_beat = if beat == last_beat { looks_without_beat + 1 } else { 0 };
            last_beat = beat;
            if looks_without_beat > MAX_LOOKS_WITHOUT_BEAT {
                give_up("its thread that receives hangs");
            }
            let status = self.status();
            let due = reported.is_none_or(|reported| reported.elapsed() >= STATUS_EVERY);
            if due && let Some(resident) = memory::resident_bytes().filter(|&bytes| bytes > RESIDENT_LIMIT) {
                give_up(&format!("{} MB in memory, more than {} MB", resident >> 20, RESIDENT_LIMIT >> 20));
            }
            if due || status != last_status {
                reported = Some(looked);
                last_status.clone_from(&status);
                self.node.send(&FromSide::Status(status));
            }
        }
    }

    fn publish(&mut self, frame: ToSide) {
        let published = match frame {
            ToSide::Start(_) => Ok(()),
            ToSide::Prediction(message) => self.publish_prediction(message.into_owned()),
            ToSide::Rig(message) => self.ros2.publish(Outgoing::RigInfo(&message)),
            ToSide::SessionEvent(message) => {
                self.ros2.take_setting(&message);
                self.ros2.publish(Outgoing::SessionEvent(&message))
            }
            ToSide::Sensitivity(message) => self.ros2.publish(Outgoing::Sensitivity(&message)),
            ToSide::Diagnostics(message) => self.ros2.publish(Outgoing::Diagnostics(&message)),
            ToSide::Heard(message) => self.ros2.publish(Outgoing::Heard(&message)),
            ToSide::Log(severity, text) => self.ros2.publish(Outgoing::Log(severity, &text)),
        };
        self.count_refusal(published);
    }

    /// Publishes a prediction. If that fails because a reader has not acknowledged for too long, the publisher is
    /// renewed, so that this reader delays no other.
    fn publish_prediction(&mut self, prediction: Prediction) -> Result<(), Ros2Error> {
        if !self.settling() && self.held_back.is_empty() {
            let published = self.ros2.publish(Outgoing::Prediction(&prediction));
            if published.is_ok() || self.renewed.is_some() {
                return published;
            }
            if !self.ros2.renew_prediction_publisher()? {
                return published;
            }
            self.renewed = Some(Instant::now());
            // Publish a single one: some readers never request samples that the first heartbeat of a publisher
            // announces before they arrive.
            return self.ros2.publish(Outgoing::Prediction(&prediction));
        }
        self.held_back.push_back(prediction);
        if self.held_back.len() > MAX_HELD_BACK {
            self.held_back.pop_front();
            self.refused += 1;
        }
        self.publish_held_back();
        Ok(())
    }

    /// Whether readers may not have found the renewed publisher yet.
    fn settling(&self) -> bool {
        self.renewed.is_some_and(|renewed| renewed.elapsed() < SETTLING)
    }

    /// Publishes some of the predictions held back, in order, and drops the previous publisher when its time is over.
    fn publish_held_back(&mut self) {
        if self.renewed.is_some_and(|renewed| renewed.elapsed() >= RETIREMENT) {
            self.renewed = None;
            self.ros2.retire();
        }
        if self.settling() {
            return;
        }
        // Not all at once: readers keep no more than their history depth.
        for _ in 0..HELD_BACK_AT_ONCE {
            let Some(prediction) = self.held_back.pop_front() else { return };
            let published = self.ros2.publish(Outgoing::Prediction(&prediction));
            self.count_refusal(published);
        }
    }

    fn count_refusal(&mut self, published: Result<(), Ros2Error>) {
        if let Err(error) = published {
            self.refused += 1;
            self.last_refusal = error.to_string();
        }
    }

    fn status(&self) -> Status {
        let mut counts = self.ros2.counts();
        counts.malformed += self.node.malformed.load(Ordering::Relaxed);
        counts.missed += self.node.lost.load(Ordering::Relaxed);
        let mut waveform_counts = self.ros2.waveform_counts();
        waveform_counts.malformed += self.node.blocks.malformed.load(Ordering::Relaxed);
        waveform_counts.missed += self.node.blocks.lost.load(Ordering::Relaxed);
        Status {
            waveform_counts,
            prediction_readers: self.ros2.readers(Topic::Prediction) as u64,
            sensitivity_readers: self.ros2.readers(Topic::Sensitivity) as u64,
            operating_point_writers: self.ros2.operating_point_writers() as u64,
            counts,
            refused: self.refused,
            last_refusal: self.last_refusal.clone(),
        }
    }
}

/// Ends this process with an error. The node reads the reason and starts another.
fn give_up(why: &str) -> ! {
    note!("{why}");
    process::exit(1);
}
