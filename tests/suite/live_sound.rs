//! Samples received by a running node: squeals found, compared with predictions, published, recorded and found again.

use std::f64::consts::TAU;
use std::sync::Arc;
use std::thread;

use crate::bus::{next, shm};
use crate::program::{folder, run, text};
use crossbeam_channel::unbounded;
use squealcast::bus::received::Received;
use squealcast::bus::shm::{ShmHeardSink, ShmOptions, ShmSink, ShmSource};
use squealcast::bus::shm_waveform::{ShmWaveformInput, ShmWaveformSource};
use squealcast::bus::{Bus, Connection, ShmConnection, Sink};
use squealcast::msgs::{
    Header, Heard, OperatingPoint, Prediction, Time, Waveform, heard_quantity, heard_state, heard_verdict,
};
use squealcast::node::{Node, Outputs, SoundOptions, Watch};
use squealcast::offline::verify_sound::{recorded_settings, settings_metadata, verify_sound};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording, recordings_at};
use squealcast::recording::recorder::{Recorder, RecorderConfig};
use squealcast::rig::Rig;
use squealcast::session::settings::Settings;
use squealcast::sound;

const RATE_HZ: f64 = 48_000.0;
const BLOCK: usize = 4096;
/// Stamp of the first sample and of the first condition, ns.
const START_NS: i64 = 1_700_000_000_000_000_000;

fn header(time_s: f64) -> Header {
    Header { stamp: Time::from_ns(START_NS + (time_s * 1e9).round() as i64), frame_id: String::new() }
}

/// Block `k` of a channel that sounds with `amplitude` from 0.6 to 1.2 s, with flanks of 10 ms.
fn block(channel: &str, k: usize, frequency_hz: f64, amplitude: f64, unit: &str, sensitivity: &str) -> Waveform {
    let sample = |k: usize| {
        let t = k as f64 / RATE_HZ;
        let flank = ((t - 0.6).min(1.2 - t) / 0.01).clamp(0.0, 1.0);
        (amplitude * (0.25 * TAU * flank).sin().powi(2) * (TAU * frequency_hz * t).sin()) as f32
    };
    Waveform {
        header: header((k * BLOCK) as f64 / RATE_HZ),
        channel: channel.to_owned(),
        sample_rate_hz: RATE_HZ,
        unit: unit.to_owned(),
        sensitivity: sensitivity.to_owned(),
        samples: (k * BLOCK..(k + 1) * BLOCK).map(sample).collect(),
    }
}

#[test]
fn shared_memory_carries_samples_of_any_length_unchanged() {
    let options = shm("waveform");
    let (sender, received) = unbounded();
    let input = ShmWaveformInput::spawn(&options, move |block| drop(sender.send(block))).expect("input");
    let source = ShmWaveformSource::new(&options).expect("source");
    for length in [1, 1024, 16_384, 7] {
        let mut sent = block("microphone", 3, 2000.0, 0.3, "Pa", "");
        sent.samples = (0..length).map(f32::from_bits).collect();
        assert_eq!(source.publish(&sent).expect("published"), 1);
        let found = next(&received);
        assert_eq!((found.bus, found.message), (Bus::Shm, sent));
    }
    assert_eq!((input.counts().received, input.counts().malformed), (4, 0));
    let long = Waveform { samples: vec![0.0; 16_385], ..block("microphone", 0, 2000.0, 0.3, "Pa", "") };
    let error = source.publish(&long).expect_err("too long").to_string();
    assert_eq!(error, "16385 samples, at most 16384 are carried");
}

/// A running node in this process, on shared memory alone.
struct Running {
    options: ShmOptions,
    sink: Arc<dyn Sink>,
    stop: Box<dyn Fn()>,
    thread: thread::JoinHandle<Outputs>,
    recorder: Recorder,
}

fn start(name: &str, rig: &Arc<Rig>, directory: &std::path::Path, sound: SoundOptions) -> Running {
    let options = shm(name);
    let (node, inlet) = Node::new(rig.clone(), Settings::for_rig(rig), Watch::default());
    let sink: Arc<dyn Sink> = Arc::new(inlet.clone());
    let connection = ShmConnection::of_node(&options, &sink).expect("joined");
    let config = RecorderConfig {
        rig_name: rig.name.clone(),
        rig_content_hash: rig.content_hash.clone(),
        rig_files: rig.files.clone(),
        metadata: settings_metadata(sound.settings),
        ..RecorderConfig::new(directory)
    };
    let recorder = Recorder::start(config).expect("a recorder");
    let buses: Vec<Box<dyn Connection>> = vec![Box::new(connection)];
    let outputs = Outputs { buses, recorder: Some(recorder.handle()), ..Outputs::default() };
    let thread = thread::spawn(move || node.with_sound(sound).run(outputs));
    Running { options, sink, stop: Box::new(move || inlet.stop()), thread, recorder }
}

/// The tribometer is predicted to squeal at a friction coefficient of 0.9. A tone at the predicted frequency is a hit; one
/// that no mode has is a miss. A block that is missing is named; the same samples over another bus are not searched
/// twice; a channel in an unknown unit is refused by name.
#[test]
fn squeals_are_found_compared_published_recorded_and_found_again() {
    let folder = folder();
    let rig = Arc::new(Rig::load("tribometer").expect("embedded"));
    let settings = sound::Settings { threshold_db: 75.5, ..Default::default() };
    let node = start("live-sound", &rig, folder.path(), SoundOptions { settings, record_samples: true });
    let (to_heard, heard) = unbounded();
    let (to_predictions, predictions) = unbounded();
    let _heard = ShmHeardSink::spawn(&node.options, move |one| drop(to_heard.send(one))).expect("sink");
    let _predictions = ShmSink::spawn(&node.options, move |one| drop(to_predictions.send(one))).expect("sink");
    let conditions = ShmSource::new(&node.options).expect("source");
    let samples = ShmWaveformSource::new(&node.options).expect("source");

    // Predictions are kept for comparison from the first block on, which this sink takes at once.
    let bad = block("strange", 0, 2000.0, 0.3, "kN", "");
    node.sink.waveform(Received::now(Bus::Shm, bad));
    for k in 0..30 {
        let point = OperatingPoint {
            header: header(0.05 * f64::from(k)),
            seq: k as u64,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.9,
        };
        conditions.publish(&point).expect("published");
        let prediction: Received<Prediction> = next(&predictions);
        assert_eq!(prediction.message.input_seq, k as u64);
    }
    conditions
        .publish(&OperatingPoint { header: header(1.5), seq: 30, friction_coefficient: 0.9, ..point_at_rest() })
        .expect("published");
    let prediction = next(&predictions).message;
    let in_band = |hz: f64| (1300.0..15_000.0).contains(&hz);
    let growing = prediction.modes.iter().filter(|mode| mode.growth_rate_per_s > 1.0 && in_band(mode.frequency_hz));
    let mode = growing.max_by(|a, b| a.growth_rate_per_s.total_cmp(&b.growth_rate_per_s)).expect("a mode squeals");
    // Half way between two modes that differ by more than the tolerance of 5 % on both sides: no mode squeals there.
    let unstable: Vec<f64> =
        prediction.modes.iter().filter(|mode| mode.growth_rate_per_s > 0.0).map(|mode| mode.frequency_hz).collect();
    let quiet_hz = (1300..15_000)
        .map(f64::from)
        .find(|hz| {
            unstable
                .iter()
                .all(|mode_hz| (hz / mode_hz - 1.0).abs() > 0.06 && (hz / mode.frequency_hz - 1.0).abs() > 0.2)
        })
        .expect("a frequency that is not predicted");

    let mut published: Vec<Heard> = vec![];
    let mut until_ended = |channel: &str| loop {
        let one: Heard = next(&heard).message;
        published.push(one.clone());
        if one.channel == channel && one.state == heard_state::ENDED {
            return one;
        }
    };
    // Over shared memory, up to the end of the squeal.
    for k in 0..17 {
        samples.publish(&block("shared", k, 3000.0, 0.3, "Pa", "")).expect("published");
    }
    until_ended("shared");
    // Whole and in order: the blocks after 1.5 s are quiet, and one of them is missing.
    let mut sent = vec![];
    for k in (0..35).filter(|&k| k != 25) {
        for (channel, hz, unit, sensitivity) in
            [("microphone", mode.frequency_hz, "Pa", ""), ("pad", quiet_hz, "V", "100 mV/g")]
        {
            let block = block(channel, k, hz, 0.3, unit, sensitivity);
            node.sink.waveform(Received::now(Bus::Shm, block.clone()));
            sent.push(block);
        }
    }
    // The last block over the other bus too.
    node.sink.waveform(Received::now(Bus::Ros2, sent.last().expect("blocks").clone()));
    // The end of this squeal shows that everything before it has been searched.
    for k in 0..17 {
        node.sink.waveform(Received::now(Bus::Shm, block("last", k, 3000.0, 0.3, "Pa", "")));
    }
    until_ended("last");
    (node.stop)();
    drop(node.thread.join().expect("it ended"));
    node.recorder.finish(crate::records::LIMIT).expect("finished");

    let ended = |channel: &str| {
        published.iter().find(|one| one.channel == channel && one.state == heard_state::ENDED).expect("it ended")
    };
    let (found, missed) = (ended("microphone"), ended("pad"));
    assert_eq!((found.number, found.quantity), (1, heard_quantity::SOUND_PRESSURE));
    assert!((found.frequency_hz - mode.frequency_hz).abs() < 0.1, "{found:?}");
    assert_eq!((found.verdict, found.mode_id), (heard_verdict::HIT, mode.id), "{found:?}");
    assert!(found.input_seq < 31 && found.prediction_stamp != Time::default());
    let time_s = |stamp: Time| (stamp.as_ns() - START_NS) as f64 * 1e-9;
    assert!(
        (time_s(found.header.stamp) - 0.6).abs() < 0.005 && (time_s(found.end_stamp) - 1.2).abs() < 0.005,
        "{found:?}"
    );
    // 0.3 V at 100 mV/g are 3 g or 29.4 m/s²: 20 lg(29.4 / √2 / 1e-6) = 146.4 dB.
    assert_eq!(missed.quantity, heard_quantity::ACCELERATION);
    assert!((missed.level_db - 146.4).abs() < 0.1 && missed.verdict == heard_verdict::MISS, "{missed:?}");

    let [path] = &recordings_at(folder.path()).expect("recordings")[..] else { panic!("one recording") };
    let recording = Recording::open(path).expect("a recording");
    let (mut blocks, mut heards, mut named) = (vec![], vec![], String::new());
    for entry in recording.messages() {
        match entry.message {
            Recorded::Known(Payload::Waveform(block)) => blocks.push(block),
            Recorded::Known(Payload::Heard(heard)) => heards.push(heard),
            Recorded::Known(Payload::Diagnostics(array)) => {
                let sound = array.status.iter().filter(|status| status.name.ends_with(": sound"));
                sound.for_each(|status| named += &format!("{}\n{:?}\n", status.message, status.values));
            }
            _ => {}
        }
    }
    assert!(blocks.iter().filter(|block| block.channel == "shared").count() >= 16, "those with the squeal");
    blocks.retain(|block: &Waveform| ["microphone", "pad"].contains(&&*block.channel));
    assert_eq!(blocks, sent, "every block once, in order, unchanged");
    let bytes = |all: &[Heard]| all.iter().map(|one| squealcast::msgs::to_cdr(one).expect("CDR")).collect::<Vec<_>>();
    assert_eq!(bytes(&heards), bytes(&published));
    assert!(named.contains("microphone: 4096 samples are missing after 1700000002.133333 s"), "{named}");
    assert!(named.contains("channel `strange`: unit `kN`: expected Pa"), "{named}");
    assert!(named.contains("key: \"blocks_twice\", value: \"1\""), "{named}");

    assert_eq!(recorded_settings(&recording), settings);
    let again = verify_sound(&recording, settings).expect("samples");
    assert_eq!((again.identical, again.different, again.missing, again.extra), (8, 0, 0, 0), "{again:?}");
    assert_eq!((again.channels, again.missing_samples), (4, 2 * 4096));
    // Another definition of squeal finds others.
    let louder = sound::Settings { threshold_db: 76.0, ..settings };
    assert!(!verify_sound(&recording, louder).expect("samples").agrees());
    let none = sound::Settings { threshold_db: 200.0, ..settings };
    assert_eq!(verify_sound(&recording, none).expect("samples").missing, 8);
    run(["replay", &text(folder.path()), "--verify"])
        .exits(0)
        .says("messages about squeals: 8 identical, 0 different, 0 missing, 0 extra");
}

fn point_at_rest() -> OperatingPoint {
    OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, ..OperatingPoint::default() }
}
