//! Tests of a node with a recorder: silences, inputs passed over, sensitivities, and what the recording holds of them.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::*;
use crate::bus::Bus;
use crate::msgs::SessionEventKind;
use crate::recording::reader::{Recorded, Recording};
use crate::recording::recorder::{QUEUE_MESSAGES, Recorder, RecorderConfig};

/// Longer than any step takes on any machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A recording node on its own thread.
struct Recorded9Dof {
    inlet: Inlet,
    watch: Watch,
    node: std::thread::JoinHandle<Outputs>,
    recorder: Recorder,
    folder: tempfile::TempDir,
}

impl Recorded9Dof {
    /// Starts the node with `waiting` in its channel.
    fn start(change: impl FnOnce(&mut Settings), waiting: Vec<Incoming>) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let recorder = Recorder::start(RecorderConfig::new(folder.path())).expect("a recorder");
        let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
        let mut settings = Settings::for_rig(&rig);
        change(&mut settings);
        let (watch, outputs) = (Watch::default(), Outputs { recorder: Some(recorder.handle()), ..Default::default() });
        let (node, inlet) = Node::new(rig, settings, watch.clone());
        waiting.into_iter().for_each(|incoming| assert!(inlet.send(incoming)));
        let node = std::thread::spawn(move || node.run(outputs));
        Self { inlet, watch, node, recorder, folder }
    }

    fn send(&self, incoming: Incoming) {
        assert!(self.inlet.send(incoming), "it runs");
    }

    fn level(&self) -> Option<u8> {
        self.watch.snapshot().prediction.map(|prediction| prediction.level)
    }

    /// Waits until a condition holds.
    #[track_caller]
    fn until(&self, what: &str, holds: impl Fn(&Self) -> bool) {
        let began = Instant::now();
        while !holds(self) {
            assert!(began.elapsed() < PATIENCE, "waited for {what}: {:?}", self.watch.snapshot());
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Stops the node and returns what it recorded, in order.
    fn recorded(self) -> Vec<Payload> {
        self.send(Incoming::Stop);
        self.node.join().expect("it ended");
        self.recorder.finish(PATIENCE).expect("finished");
        read(self.folder.path())
    }
}

fn read(folder: &Path) -> Vec<Payload> {
    let session = std::fs::read_dir(folder).expect("the folder").next().expect("a session").expect("readable").path();
    let recording = Recording::open(&session).expect("a recording");
    let known = |recorded| if let Recorded::Known(payload) = recorded { Some(payload) } else { None };
    recording.messages().filter_map(|entry| known(entry.message)).collect()
}

fn conditions(seq: u64) -> msgs::OperatingPoint {
    msgs::OperatingPoint {
        header: Header { stamp: Time::from_ns(1_000_000_000 + seq as i64), ..Default::default() },
        seq,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.2 + 1e-6 * seq as f64,
    }
}

fn heard_now(seq: u64) -> Incoming {
    Incoming::Input(Received::now(Bus::Shm, conditions(seq)))
}

fn inputs(recorded: &[Payload]) -> Vec<u64> {
    recorded
        .iter()
        .filter_map(|p| if let Payload::OperatingPoint(input) = p { Some(input.seq) } else { None })
        .collect()
}

fn predicted(recorded: &[Payload]) -> Vec<(u64, bool)> {
    let fault = |level| level == msgs::level::FAULT;
    let of = |p: &Payload| if let Payload::Prediction(p) = p { Some((p.input_seq, fault(p.level))) } else { None };
    recorded.iter().filter_map(of).collect()
}

#[test]
fn silence_is_a_fault_once_and_the_next_input_ends_it() {
    const TIMEOUT: Duration = Duration::from_millis(50);
    let fault = |node: &Recorded9Dof| node.level() == Some(msgs::level::FAULT);
    let change = |settings: &mut Settings| settings.silence_timeout_s = TIMEOUT.as_secs_f64();
    let node = Recorded9Dof::start(change, vec![heard_now(0)]);
    node.until("a fault", fault);
    // The absence of further messages can only be checked by waiting.
    std::thread::sleep(6 * TIMEOUT);
    node.send(heard_now(1));
    node.until("a prediction", |node| !fault(node));
    node.until("another fault", fault);
    let recorded = node.recorded();
    let silences = recorded.iter().filter(
        |p| matches!(p, Payload::SessionEvent(event) if SessionEventKind::of(event) == Some(SessionEventKind::Silence)),
    );
    assert_eq!(silences.count(), 2);
    assert_eq!(predicted(&recorded), [(0, false), (0, true), (1, false), (1, true)]);
}

#[test]
fn inputs_that_waited_too_long_are_passed_over_and_recorded() {
    let began = Instant::now();
    while clock::monotonic_ns() < 2 * LATEST.as_nanos() as u64 {
        assert!(began.elapsed() < PATIENCE);
        std::thread::sleep(Duration::from_millis(10));
    }
    let aged = |seq, age: Duration| {
        let mut received = Received::now(Bus::Shm, conditions(seq));
        received.at.monotonic_ns -= age.as_nanos() as u64;
        Incoming::Input(received)
    };
    let old = |seq| aged(seq, LATEST + LATEST / 10);
    let node = Recorded9Dof::start(|_| (), vec![old(0), old(1), old(2)]);
    node.until("the newest", |node| node.watch.snapshot().prediction.is_some_and(|p| p.input_seq == 2));
    // A new input is predicted, and an old one if it is the newest.
    node.send(heard_now(3));
    node.until("a new one", |node| node.watch.snapshot().prediction.is_some_and(|p| p.input_seq == 3));
    node.send(old(4));
    node.until("the newest again", |node| node.watch.snapshot().prediction.is_some_and(|p| p.input_seq == 4));
    let recorded = node.recorded();
    assert_eq!(inputs(&recorded), [0, 1, 2, 3, 4]);
    assert_eq!(predicted(&recorded), [(2, false), (3, false), (4, false)]);
}

#[test]
fn sensitivities_are_computed_once_a_second_at_most() {
    let began = Instant::now();
    let node = Recorded9Dof::start(|_| (), vec![]);
    // Inputs for more than one second, so that two sensitivities are due; each input could have had its own.
    let mut seq = 0;
    while began.elapsed() < SENSITIVITY_EVERY * 3 / 2 {
        node.send(heard_now(seq));
        seq += 1;
        node.until("the answer", |node| node.watch.snapshot().prediction.is_some_and(|p| p.input_seq == seq - 1));
    }
    let recorded = node.recorded();
    let sensitivities = recorded.iter().filter(|p| matches!(p, Payload::Sensitivity(_))).count() as u32;
    let most = began.elapsed().as_millis() / SENSITIVITY_EVERY.as_millis() + 1;
    assert!((1..=most).contains(&sensitivities.into()), "{sensitivities} in {:?}, {seq} inputs", began.elapsed());
}

/// The wall clock is set back and forth: log times stay evenly spaced, publish times follow the wall clock.
#[test]
fn a_clock_that_is_set_does_not_bend_a_recording() {
    const SECOND: i64 = 1_000_000_000;
    let folder = tempfile::tempdir().expect("a folder");
    let recorder = Recorder::start(RecorderConfig::new(folder.path())).expect("a recorder");
    let outputs = Outputs { recorder: Some(recorder.handle()), ..Default::default() };
    let start = clock::Reading::now();
    let steps = [0, -7200 * SECOND, -7200 * SECOND, 7200 * SECOND, 0];
    for (k, step) in (0..).zip(steps) {
        let wall_ns = start.wall_ns + step + k * SECOND;
        let at = clock::Reading { wall_ns, monotonic_ns: start.monotonic_ns + k as u64 * SECOND as u64 };
        outputs.record(at, Payload::OperatingPoint(conditions(k as u64)));
    }
    let finished = recorder.finish(PATIENCE).expect("finished");
    assert_eq!(finished.files.len(), 1, "a step of two hours is no reason for another file");
    let recording = Recording::open(&finished.directory).expect("a recording");
    let entries: Vec<_> = recording.messages().collect();
    for (k, entry) in entries.iter().enumerate() {
        assert_eq!(entry.log_time_ns - entries[0].log_time_ns, k as u64 * SECOND as u64);
        assert_eq!(entry.publish_time_ns as i64, start.wall_ns + steps[k] + k as i64 * SECOND);
    }
    assert_eq!(entries.len(), steps.len());
}

/// After a stop, shared memory and ROS 2 deliver the inputs they kept all at once. Each is recorded with its
/// prediction.
#[test]
fn the_recorder_queue_holds_twice_the_depth_of_the_buses() {
    use crate::msgs::shm::{Form, OperatingPointForm};
    let kept = 2 * OperatingPointForm::WAITING_SAMPLES;
    assert!(QUEUE_MESSAGES >= 2 * 2 * kept, "{QUEUE_MESSAGES} for {kept} inputs");
}
