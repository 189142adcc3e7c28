//! Peers that publish operating points and are answered: rclpy, CycloneDDS and iceoryx2 in Python, over one bus and over both.

use std::collections::HashMap;
use std::fs;
use std::thread;
use std::time::Duration;

use super::{
    CRITICAL, Content, Node, RIG, alone, now_ns, peer, peer_program, point, read_by_others, say, say_exchange,
    say_versions, verify,
};
use crate::program::{PATIENCE, until as wait_until};
use crossbeam_channel::{Receiver, unbounded};
use serde_json::Value;
use squealcast::bus::received::Received;
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::{Ros2Options, Ros2Source};
use squealcast::bus::shm::{ShmOptions, ShmSink, ShmSource, ShmTemperatureSource, ShmVibrationSource};
use squealcast::msgs::{Header, Prediction, Temperature, Time, Vibration};

#[test]
fn rclpy_is_answered_at_500_hz_for_30_s_and_the_recording_serves_others() {
    let (Some(ros_python), Some(python)) = (peer_program("ros-python"), peer_program("python")) else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-rmw-fastrtps-cpp"]);
    let mut node = Node::start(RIG, true);
    let report = peer(
        &ros_python,
        "rclpy_peer.py",
        &[
            "--domain",
            &node.domain(),
            "--expect-rig",
            RIG,
            "--expect-modes",
            "9",
            "--expect-unstable-above",
            CRITICAL,
            "--rate",
            "500",
            "--seconds",
            "30",
        ],
    );
    say_exchange(&report);
    assert_eq!((&report["sent"], &report["answered"]), (&Value::from(15_000), &Value::from(15_000)), "{report}");
    assert_eq!(report["rig"]["version"], env!("CARGO_PKG_VERSION"));
    node.interrupt();

    let recording = node.recording();
    let names = fs::read_dir(&recording).expect("a folder").map(|entry| entry.expect("one").file_name());
    let names: Vec<String> = names.map(|name| name.to_string_lossy().into_owned()).collect();
    assert!(names.iter().any(|name| name.ends_with(".mcap")), "{names:?}");
    assert!(!names.iter().any(|name| name.ends_with(".active")), "{names:?}");
    let found = read_by_others(&python, &recording);
    assert_eq!(found["topics"]["/rig/operating_point"], 15_000, "{found}");
    assert_eq!(found["predictions_of_an_input"], serde_json::json!({"1": 15_000}), "{found}");
    assert_eq!(found["attachments"], serde_json::json!([format!("{RIG}.toml")]));
    let content = Content::read(&recording);
    assert_eq!(content.count("messages_dropped"), 0);
    assert!(!content.sensitivities.is_empty());
    assert_eq!(found["topics"]["/squealcast/sensitivity"], content.sensitivities.len(), "{found}");
    verify(&recording);
}

#[test]
fn cyclone_dds_is_answered() {
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    say_versions(&python, &["cyclonedds"]);
    let mut node = Node::start(RIG, false);
    let domain = node.domain();
    let expected = ["--expect-modes", "9", "--expect-unstable-above", CRITICAL];
    let pace = ["--domain", &domain, "--rate", "500", "--seconds", "10"];
    let report = peer(&python, "cyclone_peer.py", &[&pace[..], &expected[..]].concat());
    say_exchange(&report);
    assert_eq!((&report["sent"], &report["answered"]), (&Value::from(5000), &Value::from(5000)), "{report}");
    node.interrupt();
}

#[test]
fn iceoryx2_in_python_is_answered() {
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    say_versions(&python, &["iceoryx2"]);
    let mut node = Node::start(RIG, false);
    let report = peer(
        &python,
        "shm_peer.py",
        &["--prefix", &node.prefix, "--rate", "500", "--count", "5000", "--first-seq", "1", "--patience", "15"],
    );
    say(&format!("{} of {} answered, latency {} us", report["answered"], report["sent"], report["latency_us"]));
    assert_eq!((&report["sent"], &report["answered"]), (&Value::from(5000), &Value::from(5000)), "{report}");
    node.interrupt();
}

/// Our peers on both buses at once: the result must not depend on the bus an input arrives over first.
#[test]
fn an_input_received_over_both_buses_is_answered_once() {
    const COUNT: u64 = 1000;
    let _alone = alone();
    say(&format!("both buses: squealcast {} against its own mirror", env!("CARGO_PKG_VERSION")));
    let mut node = Node::start(RIG, true);
    let (on_ros, heard_on_ros) = unbounded();
    let (on_shm, heard_on_shm) = unbounded();
    let options = Ros2Options::new(Some(node.domain.id), true, RosArgs::default()).expect("valid");
    let ros = Ros2Source::start(&options, move |received: Received<Prediction>| drop(on_ros.send(received.message)))
        .expect("joined");
    let options = ShmOptions { service_prefix: node.prefix.clone(), ..Default::default() };
    let shm = ShmSource::new(&options).expect("joined");
    let _sink = ShmSink::spawn(&options, move |received: Received<Prediction>| drop(on_shm.send(received.message)))
        .expect("joined");
    wait_until("discovery", || ros.readers() > 0 && ros.prediction_writers() == 1);
    // The node's own discovery of us is not to be seen from here: until it is there, inputs of another kind.
    let mut seq = COUNT;
    wait_until("an answer over both buses", || {
        ros.publish(&point(seq)).expect("published");
        seq += 1;
        thread::sleep(Duration::from_millis(20));
        !heard_on_ros.is_empty() && !heard_on_shm.is_empty()
    });
    let before = seq - COUNT;

    for seq in 0..COUNT {
        let point = point(seq);
        if seq % 2 == 0 {
            ros.publish(&point).expect("published");
        }
        assert!(shm.publish(&point).expect("published") > 0, "the node reads");
        if seq % 2 == 1 {
            ros.publish(&point).expect("published");
        }
        thread::sleep(Duration::from_millis(2));
    }
    for (bus, received) in [("ROS 2", &heard_on_ros), ("shared memory", &heard_on_shm)] {
        let answered = collect(received, COUNT);
        assert_eq!(answered.len() as u64, COUNT, "answered over {bus}");
        assert!(answered.values().all(|&count| count == 1), "over {bus}: {answered:?}");
    }
    node.interrupt();
    // Nothing came twice, late: the node has ended.
    for received in [&heard_on_ros, &heard_on_shm] {
        assert!(!received.try_iter().any(|prediction| answers(&prediction, COUNT)));
    }
    let content = Content::read(&node.recording());
    assert_eq!(content.inputs.iter().filter(|input| input.seq < COUNT).count() as u64, COUNT);
    assert_eq!(content.count("inputs_twice"), COUNT);
    assert!(content.inputs.len() as u64 <= COUNT + before);
    verify(&node.recording());
}

/// A measured vibration over both buses, or one of them, into a recording that others read: each once, together with inputs.
#[test]
fn a_vibration_over_both_buses_is_recorded_once_and_read_by_others() {
    const COUNT: u64 = 100;
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    let mut node = Node::start(RIG, true);
    let (on_ros, heard_on_ros) = unbounded();
    let options = Ros2Options::new(Some(node.domain.id), true, RosArgs::default()).expect("valid");
    let ros = Ros2Source::start(&options, move |received: Received<Prediction>| drop(on_ros.send(received.message)))
        .expect("joined");
    let options = ShmOptions { service_prefix: node.prefix.clone(), ..Default::default() };
    let shm = ShmVibrationSource::new(&options).expect("joined");
    wait_until("discovery", || ros.readers() > 0 && ros.vibration_readers() > 0);
    let vibration = |k: u64| Vibration {
        header: Header { stamp: Time::from_ns(now_ns()), frame_id: "accelerometer".to_owned() },
        frequency_hz: 1500.0 + k as f64,
        level_db: 60.0 + 0.1 * k as f64,
    };
    // Until the node has discovered us: an answer, and vibrations with separate numbers until then.
    let mut seq = 0;
    wait_until("an answer", || {
        seq += 1;
        ros.publish(&point(seq)).expect("published");
        ros.publish_vibration(&vibration(10_000 + seq)).expect("published");
        thread::sleep(Duration::from_millis(20));
        !heard_on_ros.is_empty() && shm.publish(&vibration(20_000 + seq)).expect("published") > 0
    });
    // Over both with either first, over one, over the other.
    let sent: Vec<Vibration> = (0..3 * COUNT).map(vibration).collect();
    for (k, vibration) in (0..).zip(&sent) {
        let (to_ros, to_shm) = (k < 2 * COUNT, !(COUNT..2 * COUNT).contains(&k));
        let over_shm = || assert!(!to_shm || shm.publish(vibration).expect("published") > 0, "the node reads");
        if k % 2 == 0 {
            over_shm();
        }
        if to_ros {
            ros.publish_vibration(vibration).expect("published");
        }
        if k % 2 == 1 {
            over_shm();
        }
        ros.publish(&point(seq + 1 + k)).expect("published");
        thread::sleep(Duration::from_millis(2));
    }
    // The last input was sent after the last vibration: its answer comes once that is recorded.
    let last = seq + 3 * COUNT;
    wait_until("the last answer", || heard_on_ros.try_iter().any(|prediction| prediction.input_seq == last));
    node.interrupt();

    let recording = node.recording();
    let content = Content::read(&recording);
    for expected in &sent {
        let found = content.vibrations.iter().filter(|found| found.frequency_hz == expected.frequency_hz);
        // Messages that arrived over shared memory first have no frame.
        let found: Vec<_> = found.map(|found| (found.header.stamp, found.level_db)).collect();
        assert_eq!(found, [(expected.header.stamp, expected.level_db)], "{expected:?}");
    }
    let found = read_by_others(&python, &recording);
    assert_eq!(found["topics"]["/rig/vibration"], content.vibrations.len(), "{found}");
    assert_eq!(found["topics"]["/rig/operating_point"], content.inputs.len(), "{found}");
    verify(&recording);
}

/// Whether it answers one of the first `count` inputs; a FAULT for the silence after them does not.
fn answers(prediction: &Prediction, count: u64) -> bool {
    prediction.input_seq < count && !prediction.reason.starts_with("stale")
}

/// How often each of the first `count` sequence numbers is answered, until all are.
fn collect(received: &Receiver<Prediction>, count: u64) -> HashMap<u64, u32> {
    let mut answered = HashMap::new();
    while (answered.len() as u64) < count {
        let Ok(prediction) = received.recv_timeout(PATIENCE) else { break };
        if answers(&prediction, count) {
            *answered.entry(prediction.input_seq).or_insert(0) += 1;
        }
    }
    answered
}

/// A temperature from rclpy, by the best effort of its profile for sensors, and one over shared memory: the rig follows both,
/// and the recording holds them.
#[test]
fn a_rig_follows_the_temperature_that_rclpy_publishes() {
    let (Some(ros_python), Some(python)) = (peer_program("ros-python"), peer_program("python")) else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-rmw-fastrtps-cpp"]);
    let folder = tempfile::tempdir().expect("a folder");
    let mut node = Node::start(&crate::temperature::softening(folder.path()), true);
    let report = peer(&ros_python, "rclpy_temperature.py", &["--domain", &node.domain(), "--celsius", "150.5"]);
    assert_eq!(report["followed"], serde_json::json!([150.5]), "{report}");
    // Conditions, so that the recording can be verified.
    let conditions =
        ["--prefix", &node.prefix, "--rate", "100", "--count", "50", "--first-seq", "1", "--patience", "15"];
    assert_eq!(peer(&python, "shm_peer.py", &conditions)["answered"], 50);
    let options = ShmOptions { service_prefix: node.prefix.clone(), ..Default::default() };
    let shm = ShmTemperatureSource::new(&options).expect("joined");
    let header = Header { stamp: Time::from_ns(now_ns()), frame_id: String::new() };
    let colder = Temperature { header, temperature: 60.25, variance: 0.0 };
    assert!(shm.publish(&colder).expect("published") > 0, "the node reads");
    let more = ["--prefix", &node.prefix, "--rate", "100", "--count", "50", "--first-seq", "51", "--patience", "15"];
    assert_eq!(peer(&python, "shm_peer.py", &more)["answered"], 50);
    node.interrupt();
    let content = Content::read(&node.recording());
    let (last, from_rclpy) = content.temperatures.split_last().expect("temperatures");
    assert_eq!((last.temperature, last.header.stamp), (60.25, colder.header.stamp));
    assert!(!from_rclpy.is_empty() && from_rclpy.iter().all(|t| (t.temperature, t.variance) == (150.5, 0.25)));
    assert!(from_rclpy.iter().all(|t| t.header.frame_id == "pad"));
    let found = read_by_others(&python, &node.recording());
    assert_eq!(found["topics"]["/rig/temperature"], content.temperatures.len(), "{found}");
    verify(&node.recording());
}
