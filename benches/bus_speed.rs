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
use squealcast::bus::shm_waveform::ShmWaveformSource;
use squealcast::bus::{Received, ShmConnection, Sink};
use squealcast::msgs::{Header, OperatingPoint, Prediction, Time, Waveform};
use squealcast::node::{Incoming, Inlet, Node, Outputs, Watch};
use squealcast::physics::{Chart, ContactLaw};
use squealcast::proof::synthetic::{Synthetic, rig};
use squealcast::rig::Rig;
use squealcast::session::computed::session_chart;
use squealcast::session::settings::Settings;
use squealcast::sound::simulated::{Drive, SimulatedSound, SoundSettings};
use squealcast::sound::waveform::stamp_ns;
use squealcast::system::clock;

/// Conditions sent at 1 kHz in a block; blocks to the node and bare blocks alternate.
const BLOCK: usize = 1000;
/// Turns.
const BLOCKS: usize = 10;
/// Conditions sent at 10 kHz.
const COUNT: u64 = 600_000;
/// Channels of sound, their sample rate, and samples in a block.
const CHANNELS: [&str; 4] = ["microphone", "pad", "caliper", "disc"];
const SAMPLE_RATE_HZ: f64 = 51_200.0;
const SAMPLES: usize = 1024;
/// Four channels may take this share of one core.
const SHARE_OF_A_CORE: f64 = 0.08;

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
        let (node, inlet) = Node::new(rig.clone(), settings, watch.clone());
        let sink: Arc<dyn Sink> = Arc::new(inlet.clone());
        let shm = ShmConnection::of_node(options, &sink).expect("shared memory");
        let outputs = Outputs { buses: vec![Box::new(shm)], ..Default::default() };
        if let Some(chart) = chart {
            assert!(inlet.send(Incoming::Chart { rig, chart: Ok(chart) }), "room");
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

/// The same while the load moves between 100 and 1900 N, at 1 kHz of stamps.
fn wave_of_load(seq: u64) -> OperatingPoint {
    let header = Header { stamp: Time::from_ns(1_000_000 * (1_000_000 + seq as i64)), frame_id: String::new() };
    OperatingPoint { header, normal_load_n: 1000.0 + 900.0 * (7e-4 * seq as f64).sin(), ..wave(seq) }
}

/// Sends conditions to a bus and receives the answers.
struct Asker {
    source: ShmSource,
    received: Receiver<Received<Prediction>>,
    sink: ShmSink,
    conditions: fn(u64) -> OperatingPoint,
    seq: u64,
}

impl Asker {
    fn new(options: &ShmOptions, conditions: fn(u64) -> OperatingPoint) -> Self {
        let (predictions, received) = unbounded();
        let sink = ShmSink::spawn(options, into(predictions)).expect("sink");
        Self { source: ShmSource::new(options).expect("source"), received, sink, conditions, seq: 0 }
    }

    /// One round trip, from before the condition is written to when its prediction is taken off the bus.
    fn ask(&mut self) -> Duration {
        self.seq += 1;
        let sent_ns = clock::monotonic_ns();
        self.source.publish(&(self.conditions)(self.seq)).expect("published");
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

/// Four channels of sound that squeals half of the time, until this is dropped.
struct Sounding {
    go_on: Arc<AtomicBool>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Sounding {
    fn start(options: &ShmOptions) -> Self {
        let mut sound = SimulatedSound::new(SoundSettings { sample_rate_hz: SAMPLE_RATE_HZ, ..Default::default() });
        let mut samples = vec![];
        for drives in [vec![], vec![Drive { mode_id: 1, frequency_hz: 2345.6, growth_rate_per_s: 100.0 }]] {
            sound.advance(&drives, 50.0, 50 * SAMPLES, &mut samples);
        }
        let source = ShmWaveformSource::new(options).expect("source");
        let go_on = Arc::new(AtomicBool::new(true));
        let going_on = go_on.clone();
        let thread = thread::spawn(move || {
            let (started, start_ns) = (Instant::now(), clock::now_ns());
            let blocks = (0u64..).zip(samples.chunks(SAMPLES).cycle()).take_while(|_| going_on.load(Ordering::Relaxed));
            for (k, block) in blocks {
                let first = k * SAMPLES as u64;
                let complete = Duration::from_secs_f64((first + SAMPLES as u64) as f64 / SAMPLE_RATE_HZ);
                thread::sleep(complete.saturating_sub(started.elapsed()));
                for channel in CHANNELS {
                    let stamp = Time::from_ns(stamp_ns(start_ns, first, SAMPLE_RATE_HZ));
                    let waveform = Waveform {
                        header: Header { stamp, frame_id: String::new() },
                        channel: channel.to_owned(),
                        sample_rate_hz: SAMPLE_RATE_HZ,
                        unit: "Pa".to_owned(),
                        sensitivity: String::new(),
                        samples: block.to_vec(),
                    };
                    assert_eq!(source.publish(&waveform).expect("published"), 1, "readers");
                }
            }
        });
        Self { go_on, thread: Some(thread) }
    }
}

impl Drop for Sounding {
    fn drop(&mut self) {
        self.go_on.store(false, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().expect("every block was taken");
        }
    }
}

/// Processor time so far of the threads that receive samples and search them, s.
fn time_of_sound_s() -> f64 {
    const TICKS_PER_S: f64 = 100.0;
    let read = |path: std::path::PathBuf| std::fs::read_to_string(path).unwrap_or_default();
    let tasks = std::fs::read_dir("/proc/self/task").expect("threads").flatten();
    let of_sound = tasks.filter(|task| matches!(read(task.path().join("comm")).trim(), "sound" | "shm waveform"));
    // Fields 14 and 15 are the time in the program and in the kernel; the name before them ends with a bracket.
    let ticks = of_sound.map(|task| {
        let stat = read(task.path().join("stat"));
        let after_name = stat.rsplit(')').next().unwrap_or_default();
        after_name.split_whitespace().skip(11).take(2).map(|ticks| ticks.parse().unwrap_or(0.0)).sum::<f64>()
    });
    ticks.sum::<f64>() / TICKS_PER_S
}

/// At 1 kHz, alternating in blocks with a bare round trip over the same bus: alone, while four channels of sound arrive, for a
/// rig whose contact state follows load and friction, and while a chart is built; then 10 kHz for a minute, while a chart is
/// built.
fn main() {
    let rig = rig_of_160_modes();
    let first = {
        // Nothing is cached, nothing is charted.
        let options = shm("speed-first");
        let _node = NodeOnShm::start(&options, rig.clone(), None);
        Asker::new(&options, wave).ask()
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
    let (mut ask_node, mut ask_bare) = (Asker::new(&node_bus, wave), Asker::new(&bare_bus, wave));
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
    let (sounding, begun, spent_s) = (Sounding::start(&node_bus), Instant::now(), time_of_sound_s());
    let beside_sound = alternate("while four channels of sound arrive", &mut ask_node, BLOCKS);
    let share = (time_of_sound_s() - spent_s) / begun.elapsed().as_secs_f64();
    drop(sounding);
    let squeals = node.watch.snapshot().squeals_in_sound;
    println!("four channels at 51.2 kHz: {:.2} % of one core, {squeals} squeals", 100.0 * share);
    // Squeals of 1 s, 2 s apart in each channel; those at the start and at the end may be incomplete.
    assert!(squeals >= 4 * (begun.elapsed().as_secs() / 2 - 2), "squeals are missing");
    let alone_again = alternate("alone again", &mut ask_node, BLOCKS);
    let with_state = {
        let rough = Arc::new(Rig::load("rough-pad").expect("embedded"));
        let chart = Arc::new(session_chart(&rough, 2, &|| true).expect("charted"));
        let bus = shm("speed-rough-pad");
        let node = NodeOnShm::start(&bus, rough, Some(chart));
        let mut ask = Asker::new(&bus, wave_of_load);
        ask.block();
        wait_until("the map", || node.watch.snapshot().map.is_some());
        let ratio = alternate("rough-pad with its contact state, load moving", &mut ask, BLOCKS);
        println!("rough-pad: {:?}", node.watch.snapshot().counters);
        ratio
    };
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
    for ratio in [alone, beside_sound, alone_again, with_state, beside_build] {
        assert!(ratio <= 2.0, "the node takes {ratio} times a bare round trip");
    }
    assert!(share <= SHARE_OF_A_CORE, "sound takes {share} of one core");
}
