//! Round trips to the node over shared memory, compared with a bare round trip over the same bus. For a quiet machine:
//! `cargo bench --bench bus_speed`.

#[path = "../tests/suite/bus/mod.rs"]
mod bus;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use bus::{answer, into, next, point, shm, wait_until};
use crossbeam_channel::{Receiver, unbounded};
use squealcast::bus::shm::{ShmInput, ShmOptions, ShmOutput, ShmSink, ShmSource};
use squealcast::bus::{Received, ShmConnection, Sink};
use squealcast::msgs::{OperatingPoint, Prediction};
use squealcast::node::{Incoming, Inlet, Node, Outputs, Watch};
use squealcast::physics::{Chart, ContactLaw};
use squealcast::proof::synthetic::{Synthetic, rig};
use squealcast::rig::Rig;
use squealcast::session::computed::session_chart;
use squealcast::session::settings::Settings;
use squealcast::system::clock;

/// Conditions sent at 1 kHz in a block; blocks to the node and bare blocks alternate.
const BLOCK: usize = 1000;
/// Turns.
const BLOCKS: usize = 10;
/// Conditions sent at 10 kHz.
const COUNT: u64 = 600_000;

/// Median and 99th percentile of round trips in us.
fn median_and_p99(times: &mut [Duration]) -> [f64; 2] {
    times.sort_unstable();
    [times.len() / 2, times.len() * 99 / 100].map(|k| times[k].as_secs_f64() * 1e6)
}

/// A node of a rig on shared memory, as `run` starts it.
struct NodeOnShm {
    inlet: Inlet,
    thread: Option<thread::JoinHandle<Outputs>>,
    watch: Watch,
}

impl NodeOnShm {
    fn start(options: &ShmOptions, rig: Arc<Rig>, chart: Option<Arc<Chart>>) -> Self {
        // Without inputs between its blocks there is no silence.
        let settings = Settings { silence_timeout_s: 1e6, ..Settings::for_rig(&rig) };
        let watch = Watch::default();
        let (node, inlet) = Node::new(rig, settings, watch.clone());
        let sink: Arc<dyn Sink> = Arc::new(inlet.clone());
        let shm = ShmConnection::of_node(options, &sink).expect("shared memory");
        let outputs = Outputs { buses: vec![Box::new(shm)], ..Default::default() };
        if let Some(chart) = chart {
            assert!(inlet.send(Incoming::Chart(Ok(chart))), "room");
        }
        let thread = thread::spawn(move || node.run(outputs));
        Self { inlet, thread: Some(thread), watch }
    }
}

impl Drop for NodeOnShm {
    fn drop(&mut self) {
        self.inlet.stop();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// 80 + 80 modes.
fn rig_of_160_modes() -> Arc<Rig> {
    let contact_law = ContactLaw::default();
    let model = rig(&Synthetic { modes: 160, pairs: 48, damping_ratio: 0.0, contact_law, seed: 1 });
    let like = Rig::load("nine-dof-case-2").expect("embedded");
    Arc::new(Rig { model: model.expect("well formed"), band_max_hz: Some(5000.0), mu_max: 1.0, ..like })
}

/// Conditions all over the chart, none like the one before.
fn wave(seq: u64) -> OperatingPoint {
    OperatingPoint { friction_coefficient: 0.5 + 0.49 * (0.01 * seq as f64).sin(), ..point(seq) }
}

/// Sends conditions to a bus and receives the answers.
struct Asker {
    source: ShmSource,
    received: Receiver<Received<Prediction>>,
    sink: ShmSink,
    seq: u64,
}

impl Asker {
    fn new(options: &ShmOptions) -> Self {
        let (predictions, received) = unbounded();
        let sink = ShmSink::spawn(options, into(predictions)).expect("sink");
        Self { source: ShmSource::new(options).expect("source"), received, sink, seq: 0 }
    }

    /// One round trip, from before the condition is written to when its prediction is taken off the bus.
    fn ask(&mut self) -> Duration {
        self.seq += 1;
        let sent_ns = clock::monotonic_ns();
        self.source.publish(&wave(self.seq)).expect("published");
        let answered = next(&self.received);
        assert_eq!(answered.message.input_seq, self.seq);
        Duration::from_nanos(answered.at.monotonic_ns - sent_ns)
    }

    /// Round trips at 1 kHz.
    fn block(&mut self) -> Vec<Duration> {
        let round_trip = |_| {
            let sent = Instant::now();
            let time = self.ask();
            thread::sleep(Duration::from_millis(1).saturating_sub(sent.elapsed()));
            time
        };
        (0..BLOCK).map(round_trip).collect()
    }
}

/// A chart of a rig that is built over and over, as the node builds it, until this is dropped.
struct Building {
    go_on: Arc<AtomicBool>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Building {
    fn start(rig: Arc<Rig>) -> Self {
        let go_on = Arc::new(AtomicBool::new(true));
        let going_on = go_on.clone();
        let thread = thread::spawn(move || {
            squealcast::node::yield_to_predictions();
            while going_on.load(Ordering::Relaxed) {
                let _ = session_chart(&rig, 1, &|| going_on.load(Ordering::Relaxed));
            }
        });
        Self { go_on, thread: Some(thread) }
    }
}

impl Drop for Building {
    fn drop(&mut self) {
        self.go_on.store(false, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// At 1 kHz, alternating in blocks with a bare round trip over the same bus, alone and while a chart is built; then 10 kHz
/// for a minute, while a chart is built.
fn main() {
    let rig = rig_of_160_modes();
    let first = {
        // Nothing is cached, nothing is charted.
        let options = shm("speed-first");
        let _node = NodeOnShm::start(&options, rig.clone(), None);
        Asker::new(&options).ask()
    };
    let building = Instant::now();
    let chart = Arc::new(session_chart(&rig, 2, &|| true).expect("charted"));
    println!("first prediction {first:.1?}; chart of the friction coefficient {:.1?}", building.elapsed());

    let (node_bus, bare_bus) = (shm("speed-node"), shm("speed-bare"));
    let node = NodeOnShm::start(&node_bus, rig.clone(), Some(chart));
    let bare = ShmOutput::new(&bare_bus).expect("output");
    let _echo = ShmInput::spawn(&bare_bus, move |received: Received<OperatingPoint>| {
        bare.publish(&answer(&received.message)).expect("published");
    })
    .expect("input");
    let (mut ask_node, mut ask_bare) = (Asker::new(&node_bus), Asker::new(&bare_bus));
    // The first block lets the node compute its map.
    ask_node.block();
    wait_until("the map", || node.watch.snapshot().map.is_some());
    let mut alternate = |what: &str, ask_node: &mut Asker, blocks: usize| {
        let (mut through_node, mut through_bus) = (vec![], vec![]);
        for _ in 0..blocks {
            through_node.extend(ask_node.block());
            through_bus.extend(ask_bare.block());
        }
        let (node_times, bus_times) = (median_and_p99(&mut through_node), median_and_p99(&mut through_bus));
        let ratio = node_times[0] / bus_times[0];
        println!("1 kHz, {what}, median and p99 in us: node {node_times:.1?}, bare {bus_times:.1?}, ratio {ratio:.2}");
        ratio
    };
    let alone = alternate("alone", &mut ask_node, BLOCKS);
    let building = Building::start(rig);
    let beside_build = alternate("while a chart is built", &mut ask_node, BLOCKS / 2);

    // 10 kHz for a minute: every answer in its order, none missing.
    let begun = Instant::now();
    let (mut last, mut answered, mut missing) = (ask_node.seq, 0, 0);
    let mut longest_delay = Duration::ZERO;
    let mut take = |prediction: Prediction| {
        missing += prediction.input_seq - last - 1;
        last = prediction.input_seq;
        answered += 1;
    };
    for k in 0..COUNT {
        let due = Duration::from_micros(100 * k);
        while begun.elapsed() < due {
            match ask_node.received.recv_timeout(due.saturating_sub(begun.elapsed())) {
                Ok(received) => take(received.message),
                Err(_) => break,
            }
        }
        longest_delay = longest_delay.max(begun.elapsed().saturating_sub(due));
        ask_node.source.publish(&wave(ask_node.seq + 1 + k)).expect("published");
    }
    let sent_in = begun.elapsed();
    while let Ok(received) = ask_node.received.recv_timeout(Duration::from_secs(1)) {
        take(received.message);
    }
    drop(building);
    println!("10 kHz while a chart is built: {COUNT} sent in {sent_in:.1?}, {answered} answered, {missing} missing");
    let seen = node.watch.snapshot();
    println!("{:?}, {} passed over; sink {:?}", seen.counters, seen.passed_over, ask_node.sink.counts());
    println!("longest delay of the sender itself {longest_delay:.1?}");
    assert_eq!((answered, missing), (COUNT, 0));
    assert!(sent_in < Duration::from_secs(61), "the sender itself did not keep up: {sent_in:?}");
    assert!(first < Duration::from_millis(50), "{first:?}");
    assert!(alone <= 2.0 && beside_build <= 2.0, "the node takes more than twice a bare round trip");
}
