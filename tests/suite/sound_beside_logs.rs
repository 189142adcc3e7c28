//! Samples in files beside a log: aligned, recorded, searched as by a running node, and found again.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::program::{self, folder, number, run, text};
use serde_json::Value;
use squealcast::import::samples::SampleFile;
use squealcast::msgs::{Heard, OperatingPoint, Waveform, heard_state, heard_verdict, to_cdr};
use squealcast::offline::verify_sound::recorded_settings;
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording, recordings_at};
use squealcast::sound::search::end_ns;
use tempfile::TempDir;

/// Relative times of a log count from 2000-01-01.
const LOG_START_NS: i64 = 946_684_800_000_000_000;

/// A simulated session of 8 s that squeals, its sound, and its conditions as a tribometer's log.
pub struct Simulated {
    pub folder: TempDir,
    pub sessions: String,
    pub log: String,
    pub sound: String,
    pub truth: Value,
}

pub fn simulated() -> Simulated {
    let folder = folder();
    let (sessions, sound) = (text(&folder.path().join("sessions")), text(&folder.path().join("sound.wav")));
    let profile = "[[point]]\ntime_s = 0\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = 0.3\n\
        [[point]]\ntime_s = 3\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = 0.9\n\
        [[point]]\ntime_s = 5\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = 0.9\n\
        [[point]]\ntime_s = 6\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = 0.3\n";
    let profile = program::write(folder.path(), "profile.toml", profile);
    let args = ["simulate", "--rig", "tribometer", "--profile", &profile, "--record", &sessions, "--sound", &sound];
    run(args.iter().copied().chain(["--rate", "50", "--duration", "8"])).exits(0).complains("s of sound");
    let truth = std::fs::read(folder.path().join("sound.json")).expect("the squeals");
    let mut csv = "time_s,normal_load_n,disc_speed_rad_s,friction_coefficient\n".to_owned();
    let points = content(Path::new(&sessions)).points;
    for OperatingPoint { header, normal_load_n, disc_speed_rad_s, friction_coefficient, .. } in &points {
        let time_s = (header.stamp.as_ns() - points[0].header.stamp.as_ns()) as f64 * 1e-9;
        let _ = writeln!(csv, "{time_s:.3},{normal_load_n},{disc_speed_rad_s},{friction_coefficient}");
    }
    let log = program::write(folder.path(), "log.csv", &csv);
    Simulated { sessions, log, sound, truth: serde_json::from_slice(&truth).expect("JSON"), folder }
}

/// What a recording contains.
#[derive(Default)]
struct Content {
    points: Vec<OperatingPoint>,
    blocks: BTreeMap<String, Vec<Waveform>>,
    heard: Vec<Heard>,
    /// Log times of all messages, in order.
    log_times_ns: Vec<u64>,
    stamps_of_blocks_ns: Vec<(u64, i64)>,
}

fn content(at: &Path) -> Content {
    let [path] = &recordings_at(at).expect("recordings")[..] else { panic!("one recording in {}", at.display()) };
    let mut content = Content::default();
    for entry in Recording::open(path).expect("a recording").messages() {
        content.log_times_ns.push(entry.log_time_ns);
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(point)) => content.points.push(point),
            Recorded::Known(Payload::Waveform(block)) => {
                content.stamps_of_blocks_ns.push((entry.log_time_ns, end_ns(&block)));
                content.blocks.entry(block.channel.clone()).or_default().push(block);
            }
            Recorded::Known(Payload::Heard(heard)) => content.heard.push(heard),
            _ => {}
        }
    }
    content
}

/// All samples of a file, channel by channel.
fn samples_of(file: &str) -> Vec<Vec<f32>> {
    let mut file = SampleFile::open(Path::new(file)).expect("a file of samples");
    let mut samples = vec![vec![]; file.channel_count()];
    while file.read(1 << 16, &mut samples).expect("read") > 0 {}
    samples
}

fn bytes(heard: &[Heard]) -> Vec<Vec<u8>> {
    heard.iter().map(|one| to_cdr(one).expect("CDR").to_vec()).collect()
}

/// Predicts with the tribometer and returns what was recorded.
fn predicted(folder: &Path, name: &str, args: &[&str]) -> (PathBuf, Content) {
    let output = folder.join(name);
    let out = text(&output);
    run(["predict-log", "--rig", "tribometer", "-o", &out].iter().chain(args)).exits(0);
    let content = content(&output);
    (output, content)
}

/// The planted squeals above 1250 Hz are found at their times in the log, and were predicted; the samples are in the
/// recording unchanged; a replay finds the same squeals, byte for byte; and so does a prediction of the imported log, whose
/// recording has the samples too.
#[test]
fn sound_beside_a_log_is_recorded_searched_compared_and_verified() {
    let Simulated { folder, log, sound, truth, .. } = simulated();
    let folder = folder.path();
    let beside = [&*log, "--sound", &sound, "--unit", "Pa", "--threshold-db", "72"];
    let (output, found) = predicted(folder, "out", &beside);
    let blocks = &found.blocks["1"];
    assert_eq!(blocks[0].header.stamp.as_ns(), LOG_START_NS);
    let recorded: Vec<f32> = blocks.iter().flat_map(|block| block.samples.iter().copied()).collect();
    assert!(recorded == samples_of(&sound)[0], "the samples are unchanged");
    assert!(found.log_times_ns.is_sorted());
    assert!(found.stamps_of_blocks_ns.iter().all(|&(log_ns, end_ns)| log_ns as i64 == end_ns));

    let ended: Vec<&Heard> = found.heard.iter().filter(|one| one.state == heard_state::ENDED).collect();
    let planted = truth["squeals"].as_array().expect("squeals").iter();
    let planted: Vec<&Value> = planted.filter(|squeal| number(squeal, "frequency_hz") > 1250.0).collect();
    assert!(!planted.is_empty(), "{truth}");
    for planted in planted {
        // The onset is where the level passes 72 instead of 70 dB(A).
        let near = |one: &&&Heard| {
            let onset_s = (one.header.stamp.as_ns() - LOG_START_NS) as f64 * 1e-9;
            (one.frequency_hz / number(planted, "frequency_hz") - 1.0).abs() < 0.01
                && (onset_s - number(planted, "onset_s")).abs() < 0.05
        };
        let heard = ended.iter().find(near).unwrap_or_else(|| panic!("{planted} is not among {ended:?}"));
        assert_eq!(heard.verdict, heard_verdict::HIT, "{heard:?}");
        assert!((heard.predicted_frequency_hz / heard.frequency_hz - 1.0).abs() < 0.05, "{heard:?}");
    }
    let count = found.heard.len();
    let verified = format!("messages about squeals: {count} identical, 0 different, 0 missing, 0 extra");
    run(["replay", &text(&output), "--verify"]).exits(0).says(&verified);
    let [path] = &recordings_at(&output).expect("recordings")[..] else { panic!("one recording") };
    assert_eq!(recorded_settings(&Recording::open(path).expect("a recording")).threshold_db, 72.0);

    let imported = text(&folder.join("log.mcap"));
    run(["import", &log, "-o", &imported, "--sound", &sound, "--unit", "Pa"]).exits(0).complains("blocks of samples");
    let (again, same) = predicted(folder, "again", &[&imported, "--threshold-db", "72"]);
    assert_eq!(same.blocks, found.blocks);
    assert_eq!(bytes(&same.heard), bytes(&found.heard));
    run(["replay", &text(&again), "--verify"]).exits(0).says(&verified);
    run(["predict-log", &imported, "--rig", "tribometer", "-o", &text(folder), "--sound", &sound, "--unit", "Pa"])
        .exits(1)
        .complains("already holds samples");
    let (_, without) = predicted(folder, "without", &[&log]);
    assert!(without.blocks.is_empty() && without.heard.is_empty());
}

/// Four channels with a pulse of 0.8 at 0.3 s in the second: with the marker the pulse was at the offset; without, the
/// first sample was.
#[test]
fn files_are_aligned_by_an_offset_or_a_marker_and_found_by_the_name_of_their_log() {
    let folder = folder();
    let folder = folder.path();
    let log = "time_s,normal_load_n,disc_speed_rad_s,friction_coefficient\n0,500,13,0.3\n1,500,13,0.3\n";
    let log = program::write(folder, "run.csv", log);
    let mut csv = "time [s],microphone [Pa],trigger [V],pad [g],mute [Pa]\n".to_owned();
    for k in 0..8000 {
        let trigger = if (2400..2500).contains(&k) { "0.8" } else { "0.01" };
        let _ = writeln!(csv, "{:.6},0.001,{trigger},0.5,{}", f64::from(k) / 8000.0, k % 7);
    }
    std::fs::create_dir(folder.join("sound")).expect("a folder");
    let samples = program::write(&folder.join("sound"), "run.csv", &csv);
    let first_s = |name: &str, more: &[&str]| {
        let args = [&[&*log, "--sensitivity", "100 mV/g", "--band-hz", "1250:3900"], more].concat();
        let (_, found) = predicted(folder, name, &args);
        assert_eq!(
            found.blocks.keys().map(String::as_str).collect::<Vec<_>>(),
            ["microphone", "mute", "pad", "trigger"]
        );
        assert!(found.blocks["pad"].iter().flat_map(|block| &block.samples).all(|&sample| sample == 0.5));
        // 0.1 V/g, with g = 9.80665 m/s².
        assert!(found.blocks["trigger"][0].sensitivity.starts_with("0.0101971621297792"));
        (found.blocks["pad"][0].header.stamp.as_ns() - LOG_START_NS) as f64 * 1e-9
    };
    let near = |found: f64, expected: f64| assert!((found - expected).abs() < 1e-8, "{found} s, expected {expected} s");
    near(first_s("a", &["--sound", &samples, "--sound-offset-s", "-0.25"]), -0.25);
    near(first_s("b", &["--sound", &samples, "--sound-marker", "2:0.5"]), -0.3);
    let sound = text(&folder.join("sound"));
    near(first_s("c", &["--sound", &sound, "--sound-marker", "2:0.5", "--sound-offset-s", "1"]), 0.7);

    let fails = |args: &[&str], code: i32, why: &str| {
        let out = text(&folder.join("none"));
        run(["predict-log", "--rig", "tribometer", "-o", &out, &log].iter().chain(args)).exits(code).complains(why);
        assert!(!folder.join("none").exists(), "nothing is recorded");
    };
    let sound = ["--sound", &samples, "--band-hz", "1250:3900"];
    fails(
        &[&sound[..], &["--sound-marker", "2:5", "--sensitivity", "1 V/g"]].concat(),
        1,
        "channel 2 never comes to reach 5",
    );
    fails(
        &[&sound[..], &["--sound-marker", "9:5", "--sensitivity", "1 V/g"]].concat(),
        1,
        "has 4 channels, --sound-marker",
    );
    fails(&[&sound[..], &["--sound-marker", "0:5"]].concat(), 2, "the channel is counted from 1");
    fails(&sound, 1, "channel `trigger`: its samples are in V; a sensitivity is needed");
    fails(
        &[&sound[..], &["--sensitivity", "1 V/g", "--sensitivity", "2 V/g"]].concat(),
        1,
        "given 2 times, expected once",
    );
    fails(&[&sound[..], &[&log]].concat(), 1, "belongs to one log, 2 are given");
    fails(&["--sound-offset-s", "1"], 2, "--sound <FILE>");
    fails(
        &["--sound", &samples, "--sensitivity", "1 V/g", "--band-hz", "5000:6000"],
        1,
        "no frequency of the band 5000 to 6000",
    );
    run(["import", &log, "-o", &text(&folder.join("a.mcap")), "--sound", &samples]).exits(1).complains("trigger");
}
