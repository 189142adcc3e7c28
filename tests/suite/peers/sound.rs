//! Peers that publish the samples of a microphone: rclpy and iceoryx2 in Python, at 48 kHz in blocks of 1024.

use serde_json::Value;
use squealcast::msgs::{Waveform, heard_state};
use squealcast::recording::reader::Recording;
use tempfile::TempDir;

use super::{
    Content, Node, RIG, alone, peer, peer_program, peer_program_in, read_by_others, say, say_versions, verify,
};
use crate::program;

const BLOCKS: usize = 141;

/// The peer's tone of 2345.6 Hz and 0.5 Pa lasts from 1 to 2 s. A-weighting of IEC 61672-1 at 2.35 kHz: 1.25 dB,
/// between 1.3 dB at 2.5 kHz and 1.2 dB at 2 kHz; 0.5 Pa of amplitude are 84.95 dB.
fn check(report: &Value, node: &Node) {
    assert_eq!(report["blocks"], BLOCKS, "{report}");
    let start_ns = report["start_ns"].as_i64().expect("a time");
    let content = Content::read(&node.recording());
    let samples: usize = content.waveforms.iter().map(|block: &Waveform| block.samples.len()).sum();
    assert_eq!((content.waveforms.len(), samples), (BLOCKS, BLOCKS * 1024), "no block is missing");
    assert_eq!(content.waveforms[0].header.stamp.as_ns(), start_ns);
    let ended: Vec<_> = content.heard.iter().filter(|heard| heard.state == heard_state::ENDED).collect();
    let [heard] = &ended[..] else { panic!("{:?}", content.heard) };
    assert!((heard.frequency_hz - 2345.6).abs() < 0.1 && (heard.level_db - 86.2).abs() < 0.2, "{heard:?}");
    let after_s = |ns: i64| (ns - start_ns) as f64 * 1e-9;
    let (onset_s, end_s) = (after_s(heard.header.stamp.as_ns()), after_s(heard.end_stamp.as_ns()));
    assert!((onset_s - 1.0).abs() < 0.005 && (end_s - 2.0).abs() < 0.005, "{heard:?}");
    // The peer received what was recorded.
    let received: Vec<&Value> = report["heard"].as_array().expect("a list").iter().collect();
    assert_eq!(received.len(), content.heard.len(), "{report}");
    for (received, recorded) in received.iter().zip(&content.heard) {
        assert_eq!(received["frequency_hz"].as_f64(), Some(recorded.frequency_hz), "{received}");
        assert_eq!(received["end_ns"].as_i64(), Some(recorded.end_stamp.as_ns()), "{received}");
        assert_eq!(received["state"], recorded.state, "{received}");
    }
    say(&format!("{:.2} Hz, {:.2} dB(A), from {onset_s:.4} to {end_s:.4} s", heard.frequency_hz, heard.level_db));
}

/// A rig publishes conditions as well, so that the recording can be verified.
fn with_conditions(node: &Node, python: &std::path::Path) {
    let conditions =
        ["--prefix", &node.prefix, "--rate", "100", "--count", "50", "--first-seq", "1", "--patience", "15"];
    let report = peer(python, "shm_peer.py", &conditions);
    assert_eq!(report["answered"], 50, "{report}");
}

#[test]
fn a_squeal_in_samples_of_rclpy_is_found_published_and_recorded() {
    rclpy_is_heard("");
}

#[test]
fn a_squeal_in_samples_of_rclpy_of_jazzy_is_found_published_and_recorded() {
    rclpy_is_heard("-jazzy");
}

/// `ros` is the suffix of the folder of peers.
fn rclpy_is_heard(ros: &str) {
    let (Some(ros_python), Some(python)) = (peer_program_in(ros, "ros-python"), peer_program("python")) else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-rmw-fastrtps-cpp"]);
    let mut node = Node::start_with(RIG, true, &["--record-sound"]);
    with_conditions(&node, &python);
    let report = peer(&ros_python, "rclpy_sound.py", &["--domain", &node.domain()]);
    node.interrupt();
    check(&report, &node);
    let found = read_by_others(&python, &node.recording());
    assert_eq!(found["topics"]["/rig/waveform"], BLOCKS, "{found}");
    verify(&node.recording());
}

#[test]
fn a_squeal_in_samples_of_iceoryx2_in_python_is_found_published_and_recorded() {
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    say_versions(&python, &["iceoryx2"]);
    let mut node = Node::start_with(RIG, true, &["--record-sound"]);
    with_conditions(&node, &python);
    let report = peer(&python, "shm_sound.py", &["--prefix", &node.prefix]);
    node.interrupt();
    check(&report, &node);
    assert!(Recording::open(&node.recording()).expect("a recording").is_complete());
    verify(&node.recording());
}

/// A simulated rig at a friction coefficient of 0.9, at which mode 15 of the tribometer squeals at 3112.7 Hz (`predict
/// tribometer --mu 0.9 --load 500 --speed 13`), is heard by a node over each bus.
#[test]
fn the_sound_of_a_simulated_rig_is_heard_over_both_buses() {
    let _alone = alone();
    let profile = TempDir::new().expect("a folder");
    let point = |time_s: f64| {
        format!(
            "[[point]]\ntime_s = {time_s}\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = 0.9\n"
        )
    };
    let profile = program::write(profile.path(), "profile.toml", &(point(0.0) + &point(60.0)));
    for other in ["--no-ros", "--no-shm"] {
        let mut node = Node::start_with("tribometer", true, &["--record-sound", other]);
        let simulate =
            ["simulate", "--sound-of", "tribometer", "--profile", &profile, "--rate", "50", "--duration", "12"];
        let buses = [other, "--loopback", "--domain", &node.domain(), "--shm-prefix", &node.prefix];
        program::run(simulate.iter().chain(&buses)).exits(0);
        node.interrupt();
        let content = Content::read(&node.recording());
        assert!(content.waveforms.len() > 300, "{other}: {} blocks", content.waveforms.len());
        let near = |heard: &&squealcast::msgs::Heard| (heard.frequency_hz - 3112.7).abs() < 2.0;
        let heard = content.heard.iter().find(near).unwrap_or_else(|| panic!("{other}: {:?}", content.heard));
        say(&format!("{other}: {:.2} Hz, {:.2} dB(A)", heard.frequency_hz, heard.level_db));
    }
}
