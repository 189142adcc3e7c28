//! The server of the page, over plain sockets.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};

use serde_json::{Value, json};

use super::{Shown, alone};
use crate::program::{self, PATIENCE, measuring};

#[test]
fn nothing_can_be_changed_and_no_other_site_gets_in() {
    let shown = Shown::demo(&[]);
    let (status, head, body) = shown.get("/");
    assert_eq!(status, 200);
    assert!(body.starts_with("<!doctype html>"));
    let policy = head.lines().find_map(|line| line.strip_prefix("content-security-policy: ")).unwrap();
    assert!(policy.starts_with("default-src 'none'; script-src 'self'; style-src 'self';"), "{policy}");
    assert!(!policy.contains("unsafe") && !policy.contains('*'), "{policy}");
    assert!(!head.contains("access-control-allow"), "{head}");
    for method in ["POST", "PUT", "DELETE", "PATCH"] {
        for path in ["/", "/stream", "/state.json", "/map.json", "/events.csv"] {
            let address = shown.address;
            let request = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
            assert_eq!(shown.ask(&request).0, 405, "{method} {path}");
        }
    }
    let foreign = shown.ask("GET /state.json HTTP/1.1\r\nHost: elsewhere.example\r\nConnection: close\r\n\r\n");
    assert_eq!(foreign.0, 403);
    for path in ["/../Cargo.toml", "/nothing", "/map.json", "/map.json?number=99", "/shape.json?id=12345"] {
        let status = shown.get(path).0;
        assert!((400..500).contains(&status), "{path}: {status}");
    }
    assert_eq!(shown.get("/vendor/three.core.min.js").0, 200);
    shown.stop();
}

#[test]
fn the_page_gets_at_most_thirty_states_a_second_at_any_input_rate() {
    let _alone = alone();
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "2000"]);
    let mut lines = BufReader::new(shown.listen()).lines();
    let mut states = lines.by_ref().map_while(Result::ok).filter(|line| line.starts_with("data: "));
    let mut state = || serde_json::from_str::<serde_json::Value>(&states.next().unwrap()[6..]).unwrap();
    let time_s = |state: &serde_json::Value| state["time_s"].as_f64().unwrap();
    let first = state();
    let mut last = first.clone();
    let mut count = 0;
    while time_s(&last) - time_s(&first) < 3.0 {
        let next = state();
        assert!(next["seq"].as_u64() >= last["seq"].as_u64());
        last = next;
        count += 1;
    }
    // By the node's own clock. A tick is never less than 34 ms after the one before; the work between a tick and the time
    // it writes can move the first and the last, so that one more fits.
    let span_s = time_s(&last) - time_s(&first);
    assert!(f64::from(count) <= span_s / 0.034 + 2.0, "{count} states in {span_s} s");
    if measuring() {
        assert!((25.0..30.5).contains(&(f64::from(count) / span_s)), "{count} states in {span_s} s");
        assert!(last["rate_hz"].as_f64().unwrap() > 1900.0, "{last}");
    }
    shown.stop();
}

#[test]
fn an_address_that_is_asked_for_and_taken_is_an_error() {
    let records = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let output = Command::new(env!("CARGO_BIN_EXE_squealcast"))
        .args(["demo", "--plain", "--no-shm", "--no-ros", "--duration", "1", "--display", &address, "--record"])
        .arg(records.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains(&format!("error: no display on {address}")) && said.contains("--no-display"), "{said}");
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(!records.path().read_dir().unwrap().any(|_| true), "a start that fails leaves no recording");
}

#[test]
fn others_can_look_only_where_that_is_asked_for() {
    let run = |more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_squealcast"))
            .args(["demo", "--plain", "--no-shm", "--no-ros", "--duration", "0.2"])
            .args(more)
            .output()
            .unwrap()
    };
    let refused = run(&["--display", "0.0.0.0:0"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--display-anywhere"));
    let allowed = run(&["--display", "0.0.0.0:0", "--display-anywhere"]);
    assert!(String::from_utf8_lossy(&allowed.stderr).contains("display: http://0.0.0.0:"));
    let none = run(&["--no-display"]);
    assert!(none.status.success() && !String::from_utf8_lossy(&none.stderr).contains("display"));
}

#[test]
fn a_silent_connection_is_closed() {
    let shown = Shown::demo(&[]);
    let mut silent = TcpStream::connect(shown.address).unwrap();
    silent.set_read_timeout(Some(PATIENCE)).unwrap();
    assert_eq!(silent.read(&mut [0; 16]).expect("it is closed before this test has lost its patience"), 0);
    shown.stop();
}

/// The metrics of a node that predicts, hears and records, read by prometheus_client. Every value of the diagnostics has a
/// type there: one that is not listed in `src/display/metrics.rs` is untyped.
#[test]
fn metrics_are_read_by_prometheus_client() {
    let python = program::python();
    if !program::python_has(&python, "prometheus_client") {
        return;
    }
    let folder = program::folder();
    let records = program::text(folder.path());
    let shown = Shown::demo(&["--record", &records, "--set", "warn_margin=0.125"]);
    let sample = |families: &Value, family: &str, labels: Value| -> f64 {
        let samples = families[family]["samples"].as_array().unwrap_or_else(|| panic!("no {family}: {families}"));
        let found =
            samples.iter().find(|sample| sample[1] == labels).unwrap_or_else(|| panic!("{labels}: {samples:?}"));
        found[2].as_f64().unwrap()
    };
    let mut families = Value::Null;
    program::until("a prediction, sound and diagnostics", || {
        let (status, head, text) = shown.get("/metrics");
        assert!(status == 200 && head.contains("content-type: text/plain; version=0.0.4"), "{head}");
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/peers/read_metrics.py");
        let mut reader =
            Command::new(&python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        reader.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        let output = reader.wait_with_output().unwrap();
        assert!(output.status.success(), "refused by prometheus_client:\n{text}");
        families = serde_json::from_slice(&output.stdout).unwrap();
        let has = |name: &str| families[format!("squealcast_{name}")].is_object();
        has("samples") && has("recording_bytes") && has("growth_rate_per_second")
    });
    let untyped: Vec<&String> = families
        .as_object()
        .unwrap()
        .iter()
        .filter(|(_, family)| family["type"] == "unknown")
        .map(|(name, _)| name)
        .collect();
    assert!(untyped.is_empty(), "not in KEYS of src/display/metrics.rs: {untyped:?}");
    assert_eq!(families["squealcast_inputs"]["type"], "counter");
    assert!(sample(&families, "squealcast_inputs", json!({"bus": "simulator"})) > 0.0);
    assert_eq!(sample(&families, "squealcast_inputs", json!({"bus": "shm"})), 0.0);
    assert!(sample(&families, "squealcast_recording_bytes", json!({})) > 1000.0);
    assert!(sample(&families, "process_resident_memory_bytes", json!({})) > 1e6);
    assert_eq!(sample(&families, "squealcast_setting", json!({"name": "warn_margin"})), 0.125);
    let status: f64 =
        families["squealcast_status"]["samples"].as_array().unwrap().iter().map(|s| s[2].as_f64().unwrap()).sum();
    assert_eq!(status, 1.0, "one status is in force");
    shown.stop();

    let recording = Shown::start(&["view", concat!(env!("CARGO_MANIFEST_DIR"), "/recordings/ramp")]);
    assert_eq!(recording.get("/metrics").0, 404, "a recording has none");
    recording.stop();
}
