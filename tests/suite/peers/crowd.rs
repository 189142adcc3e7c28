//! A crowd of participants that come and go over a bad link.

use std::collections::HashMap;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use super::bad_link::{BadLink, node_at};
use super::{Content, alone, manifest_dir, peer_by, peer_program, say, say_versions, verify};
use crate::ros2_side::{children, resident_bytes};

/// Duration of the test, s, unless `SQUEALCAST_CROWD_S` says otherwise; the figures of launch/ROS2.md are of 600.
const SECONDS: u64 = 45;
/// As in `crowd.py`.
const ROOM: u64 = 1_000_000;

/// 20 participants come and go, some killed, one frozen, over a link that loses 5 % of the frames, delays them by 50 ms and
/// lets them overtake each other: what was acknowledged is recorded and answered or passed over, or counted as missed.
#[test]
fn every_input_of_a_crowd_is_accounted_for_over_a_bad_link() {
    let (Some(ros_python), Some(python)) = (peer_program("ros-python"), peer_program("python")) else { return };
    let Some(link) = BadLink::make(&python) else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-rmw-fastrtps-cpp"]);
    let seconds = std::env::var("SQUEALCAST_CROWD_S").ok().and_then(|text| text.parse().ok()).unwrap_or(SECONDS);
    let mut node = node_at(&link, &["--plain"]);
    // `nsenter` becomes the node.
    let id = node.process.0.id();
    let profile = manifest_dir().join("launch/heartbeat-kilted.xml");
    let (over, is_over) = channel::<()>();
    let watched = std::thread::spawn(move || memory(id, &is_over));
    let mut crowd = link.at_far(&ros_python);
    crowd.env("FASTDDS_DEFAULT_PROFILES_FILE", profile);
    let report = peer_by(crowd, "crowd.py", &["--domain", &node.domain(), "--seconds", &seconds.to_string()]);
    drop(over);
    let memory = watched.join().expect("measured");
    node.interrupt();

    let content = Content::read(&node.recording());
    let mut recorded: HashMap<u64, Vec<u64>> = HashMap::new();
    for input in &content.inputs {
        recorded.entry(input.seq / ROOM).or_default().push(input.seq % ROOM);
    }
    let publishers = report["publishers"].as_array().expect("publishers");
    let (mut sent, mut unrecorded, mut lost, mut acknowledged) = (0, 0, 0, 0);
    for publisher in publishers {
        let count = publisher["sent"].as_u64().expect("a number");
        let got = recorded.get(&(publisher["first"].as_u64().expect("a number") / ROOM)).map_or(0, Vec::len) as u64;
        sent += count;
        if publisher["acknowledged"] == true {
            acknowledged += 1;
            lost += count - got;
        } else {
            // One line of its account may be missing: it was killed between publishing and writing.
            unrecorded += count.saturating_sub(got);
        }
    }
    // What is missing between the first and the last of a publisher.
    let holes: u64 = recorded
        .values()
        .map(|seqs| {
            let (first, last) = (seqs.iter().min().expect("one"), seqs.iter().max().expect("one"));
            last - first + 1 - seqs.len() as u64
        })
        .sum();
    let silences = content.predictions.iter().filter(|prediction| prediction.reason.starts_with("stale")).count();
    let answered = (content.predictions.len() - silences) as u64;
    let (missed, passed_over) = (content.count("ros2_missed"), content.count("inputs_passed_over"));
    say(&format!(
        "crowd: {seconds} s, {} publishers ({} killed, {acknowledged} acknowledged), {sent} inputs sent, {} recorded, {answered} \
         answered, {passed_over} passed over, {missed} missed, {holes} holes, {lost} acknowledged and not recorded, {unrecorded} \
         gone with their killed publishers; {} restarts; memory {memory:?}",
        publishers.len(),
        report["killed"],
        content.inputs.len(),
        content.count("ros2_side_falls"),
    ));
    assert_eq!(report["failed"], 0, "{report}");
    assert_eq!(content.inputs.len() as u64, answered + passed_over);
    assert_eq!(missed, holes);
    assert!(lost <= missed, "{lost} inputs were acknowledged, and neither recorded nor counted as missed");
    assert!(acknowledged > 10 && sent > 100 * seconds, "{report}");
    assert_eq!(content.count("ros2_side_falls"), 0, "{}", node.said());
    verify(&node.recording());
}

/// Resident memory of a node and of its ROS 2 side, kB: after a quarter of the time, at the end, and the most.
#[derive(Debug)]
#[expect(dead_code, reason = "printed")]
struct Memory {
    node: [u64; 3],
    side: [u64; 3],
}

fn memory(id: u32, is_over: &Receiver<()>) -> Memory {
    let mut seen: Vec<[u64; 2]> = vec![];
    while is_over.recv_timeout(Duration::from_secs(1)) == Err(RecvTimeoutError::Timeout) {
        if let [side] = children(id)[..] {
            seen.push([id, side].map(|id| resident_bytes(id) / 1000));
        }
    }
    let of = |which: usize| {
        let values: Vec<u64> = seen.iter().map(|pair| pair[which]).collect();
        let most = values.iter().copied().max().unwrap_or_default();
        [values.get(values.len() / 4).copied().unwrap_or_default(), values.last().copied().unwrap_or_default(), most]
    };
    Memory { node: of(0), side: of(1) }
}
