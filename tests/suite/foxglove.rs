//! The servers for Foxglove, against Foxglove's own npm client (`tests/browser/setup.sh` installs it).

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use crate::domain::Domain;
use crate::program::{self, cache_folder};
use crate::ros2_side::ParameterClient;
use serde_json::{Value, json};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};

/// A running command, and the address of its server for Foxglove.
struct Served {
    child: Child,
    url: String,
}

impl Served {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_squealcast"))
            .args(arguments)
            .args(["--plain", "--foxglove", "0"])
            .env("XDG_CACHE_HOME", cache_folder())
            .env_remove("ROS_DOMAIN_ID")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("started");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let url = lines
            .by_ref()
            .map(|line| line.expect("text"))
            .find_map(|line| line.strip_prefix("Foxglove: ").map(|url| url.trim_end_matches('/').to_owned()));
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, url: url.expect("it says where it listens") }
    }

    fn stop(&mut self) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args(["-INT", &id]).status().expect("started").success());
        assert!(self.child.wait().expect("waited").success());
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What the npm client reports; `None`, with a note, where it is missing.
fn client(mode: &str, url: &str) -> Option<Value> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser");
    let output = Command::new("node").arg(folder.join("foxglove.mjs")).args([mode, url]).output().expect("node");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(serde_json::from_slice(&output.stdout).expect("a line of JSON"))
}

fn is_ready() -> bool {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser/node_modules/@foxglove/ws-protocol");
    let node = Command::new("node").arg("--version").output().is_ok_and(|output| output.status.success());
    if node && folder.exists() {
        return true;
    }
    let reason = "no @foxglove/ws-protocol, or no node: tests/browser/setup.sh installs it";
    assert!(std::env::var_os("SQUEALCAST_BROWSER_TESTS").is_none_or(|value| value != "required"), "{reason}");
    program::aloud(&format!("skipped: {reason}"));
    false
}

/// Foxglove's client reads the topics of a live node with their schemas, reads its parameters and sets one, which the
/// session, the recording and ROS 2 get too.
#[test]
fn the_npm_client_reads_a_live_node_and_sets_a_parameter() {
    if !is_ready() {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let domain = Domain::claim();
    let recordings = folder.path().join("recordings");
    let mut served = Served::start(&[
        "demo",
        "--no-shm",
        "--no-display",
        "--domain",
        &domain.id.to_string(),
        "--record",
        &recordings.display().to_string(),
    ]);
    let report = client("live", &served.url).expect("ready");
    assert_eq!((&report["before"], &report["parameters"]["warn_margin"]), (&json!(0.05), &json!(0.125)), "{report}");
    let refusal = "parameter `warn_margin` = -1: expected a number from 0 to 100";
    assert_eq!(report["statuses"], json!([refusal]), "{report}");
    assert_eq!(
        report["parameters"].as_object().expect("values").len(),
        squealcast::session::settings::PARAMETERS.len()
    );
    let prediction = &report["schemas"]["/squealcast/prediction"];
    assert_eq!(
        [&prediction["encoding"], &prediction["schemaName"], &prediction["schemaEncoding"]],
        ["cdr", "squealcast_msgs/msg/Prediction", "ros2msg"],
        "{report}"
    );
    assert_eq!(report["schemas"].as_object().expect("topics").len(), 9, "all but the blocks of samples: {report}");
    assert!(report["topics"]["/rig/operating_point"].as_u64().is_some_and(|count| count > 10), "{report}");
    assert_eq!(ParameterClient::join(domain.id).get("warn_margin"), 0.125, "ROS 2 knows it too");
    served.stop();
    let entry = std::fs::read_dir(&recordings).expect("a folder").next().expect("one").expect("entry").path();
    let recording = Recording::open(&entry).expect("a recording");
    let sets = recording.messages().filter(|entry| {
        matches!(&entry.message, Recorded::Known(Payload::SessionEvent(event))
            if (&*event.name, event.value) == ("warn_margin", 0.125))
    });
    assert_eq!(sets.count(), 1, "once, although it came back from ROS 2");
}

/// Foxglove's playback bar pauses a recording, seeks to its middle and plays it to the end.
#[test]
fn the_npm_client_controls_the_playback_of_a_recording() {
    if !is_ready() {
        return;
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/ramp");
    let recording = Recording::open(&path).expect("a recording");
    let mut served = Served::start(&["replay", &path.display().to_string()]);
    let report = client("playback", &served.url).expect("ready");
    let number = |value: &Value| value.as_str().expect("a time").parse::<u64>().expect("a number");
    assert!(report["capabilities"].as_array().expect("names").contains(&json!("playbackControl")), "{report}");
    let times: Vec<u64> = recording.messages().map(|entry| entry.log_time_ns).collect();
    let (begin, end) = (times.iter().min().expect("one"), times.iter().max().expect("one"));
    assert_eq!((number(&report["begin"]), number(&report["end"])), (*begin, *end), "{report}");
    assert_eq!((&report["paused"]["status"], &report["whilePaused"]), (&json!("paused"), &json!(0)), "{report}");
    let middle = number(&report["middle"]);
    assert_eq!(
        (&report["sought"]["status"], &report["sought"]["sought"]),
        (&json!("playing"), &json!(true)),
        "{report}"
    );
    assert_eq!((number(&report["sought"]["at"]), &report["sought"]["speed"]), (middle, &json!(4)), "{report}");
    assert!(number(&report["first"]) >= middle, "{report}");
    let inputs = recording.messages().filter(|entry| {
        entry.log_time_ns >= middle && matches!(entry.message, Recorded::Known(Payload::OperatingPoint(_)))
    });
    assert_eq!(report["inputs"], inputs.count(), "all inputs of the second half: {report}");
    assert_eq!((&report["ended"]["status"], number(&report["ended"]["at"])), (&json!("ended"), *end), "{report}");
    served.stop();
}
