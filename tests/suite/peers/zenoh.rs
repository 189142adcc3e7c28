//! ROS 2 over Zenoh: the node beside Zenoh's own Python binding, through a router, alone and together with DDS.

use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use super::types::{file_of_rosidl, folder_of};
use super::{
    CRITICAL, Content, Killed, Node, RIG, alone, manifest_dir, peer, peer_program, say, say_exchange, say_versions,
    signal, verify,
};
use crate::program::{self, command, until as wait_until};
use serde_json::{Value, json};

/// A router of its own on 127.0.0.1.
struct Router {
    _process: Killed,
    port: u16,
}

impl Router {
    /// `None`, with a note, if the Python has no Zenoh.
    fn start(python: &Path) -> Option<Self> {
        Self::start_on(python, free_port())
    }

    fn start_on(python: &Path, port: u16) -> Option<Self> {
        if !program::python_has(python, "zenoh") {
            return None;
        }
        let mut process: Child = Command::new(python)
            .arg(manifest_dir().join("tests/peers/zenoh_router.py"))
            .arg(port.to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("started");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("read");
        assert_eq!(line.trim(), port.to_string(), "the router listens");
        Some(Self { _process: Killed(process), port })
    }

    /// What makes programs use this router.
    fn environment(&self) -> (&'static str, String) {
        of_router(self.port)
    }
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port()
}

fn of_router(port: u16) -> (&'static str, String) {
    let endpoints = format!("connect/endpoints=[\"tcp/127.0.0.1:{port}\"];listen/endpoints=[\"tcp/127.0.0.1:0\"]");
    ("ZENOH_CONFIG_OVERRIDE", endpoints)
}

fn node(environment: (&str, String), rmw: &str, record: bool) -> Node {
    let (name, value) = environment;
    Node::start_in(RIG, record, &["--rmw", rmw], &[(name, &value)])
}

/// Inputs at a rate for some seconds from a peer in Python, every one of which must be answered.
fn exchange(python: &Path, router: u16, domain: &str, rate: &str, seconds: &str) -> Value {
    let expected = ["--expect-rig", RIG, "--expect-modes", "9", "--expect-unstable-above", CRITICAL];
    let router = router.to_string();
    let pace = ["--router", &router, "--domain", domain, "--rate", rate, "--seconds", seconds];
    let report = peer(python, "zenoh_peer.py", &[&pace[..], &expected[..]].concat());
    say_exchange(&report);
    assert_eq!(report["sent"], report["answered"], "{report}");
    assert_eq!(report["rig"]["version"], env!("CARGO_PKG_VERSION"), "{report}");
    report
}

#[test]
fn zenoh_is_answered_at_500_hz_and_a_late_joiner_gets_the_rig() {
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    let Some(router) = Router::start(&python) else { return };
    say_versions(&python, &["eclipse-zenoh", "rosbags"]);
    let mut node = node(router.environment(), "zenoh", true);
    let report = exchange(&python, router.port, &node.domain(), "500", "10");
    assert_eq!(report["sent"], 5000, "{report}");
    node.interrupt();
    let content = Content::read(&node.recording());
    assert_eq!(content.inputs.len(), 5000);
    assert!((1..=5000).all(|seq| content.answers(seq) == 1));
    assert_eq!(content.count("messages_dropped"), 0);
    verify(&node.recording());
}

/// Services of a node on Zenoh. Their hashes come from rosidl.
#[test]
fn parameters_and_types_are_served_over_zenoh() {
    let (Some(python), Some(ros_python)) = (peer_program("python"), peer_program("ros-python")) else { return };
    let _alone = alone();
    let Some(router) = Router::start(&python) else { return };
    let mut node = node(router.environment(), "zenoh", true);
    let file = hashes_of_services(&ros_python, node.folder.path());
    let (port, domain) = (router.port.to_string(), node.domain());
    let arguments = ["--router", &port, "--domain", &domain, "--services", &file, "--rate", "50", "--seconds", "1"];
    let report = peer(&python, "zenoh_peer.py", &arguments);
    assert_eq!(report["failures"], json!([]), "{report}");
    node.interrupt();
    // What was set is part of the session, and verifies.
    verify(&node.recording());
}

/// A file with the hashes of rosidl.
fn hashes_of_services(ros_python: &Path, folder: &Path) -> String {
    let parameters = ["Get", "Set", "List", "Describe"].map(|verb| format!("rcl_interfaces/srv/{verb}Parameters"));
    let others = ["rcl_interfaces/srv/GetParameterTypes", "rcl_interfaces/srv/SetParametersAtomically"];
    let others = others.into_iter().chain(["type_description_interfaces/srv/GetTypeDescription"]).map(str::to_owned);
    let lifecycle = ["ChangeState", "GetState", "GetAvailableStates", "GetAvailableTransitions"];
    let lifecycle = lifecycle.map(|name| format!("lifecycle_msgs/srv/{name}"));
    let hash = |name: &str| file_of_rosidl(&folder_of(ros_python), name)["type_hashes"][0]["hash_string"].clone();
    let all = parameters.into_iter().chain(others).chain(lifecycle);
    let hashes: serde_json::Map<String, Value> = all.map(|name| (name.clone(), hash(&name))).collect();
    let file = folder.join("hashes.json");
    std::fs::write(&file, Value::from(hashes).to_string()).expect("written");
    file.display().to_string()
}

/// Managed life, the log and the choice of quality of service over Zenoh.
#[test]
fn a_managed_node_follows_a_zenoh_peer() {
    let (Some(python), Some(ros_python)) = (peer_program("python"), peer_program("ros-python")) else { return };
    let _alone = alone();
    let Some(router) = Router::start(&python) else { return };
    let (variable, endpoints) = router.environment();
    let chosen = "qos_overrides./squealcast/prediction.publisher";
    let [reliability, depth] = [format!("{chosen}.reliability:=best_effort"), format!("{chosen}.depth:=10")];
    let options = ["--rmw", "zenoh", "--managed", "--plain", "--ros-args", "-p", &reliability, "-p", &depth];
    let mut node = Node::start_in(RIG, true, &options, &[(variable, &endpoints)]);
    let file = hashes_of_services(&ros_python, node.folder.path());
    let (port, domain) = (router.port.to_string(), node.domain());
    // The script fails unless every state is the expected one and predictions come only while the node is active.
    let report = peer(&python, "zenoh_managed.py", &["--router", &port, "--domain", &domain, "--services", &file]);
    say(&format!("phases: {}", report["phases"]));
    assert_eq!((&report["first"], &report["available"]), (&json!("unconfigured"), &json!(["configure", "shutdown"])));
    assert_eq!(report["phases"][0]["success"], false, "it cannot be activated before it is configured");
    assert_eq!((&report["states"]["finalized"], &report["graph"]), (&json!(4), &json!(7 + 5)), "{report}");
    let events = report["events"].as_array().expect("events");
    assert_eq!(
        events[..2],
        [json!(["unconfigured", "configure", "configuring"]), json!(["configuring", "transition_success", "inactive"])]
    );
    assert_eq!(events.len(), 2 * 5, "{report}");
    let log = report["log"].as_array().expect("lines");
    assert!(log.contains(&json!(["squealcast", 20, "the node is active"])), "{report}");
    let expected = json!({ format!("{chosen}.reliability"): "best_effort", format!("{chosen}.depth"): 10 });
    assert_eq!((&report["overrides"], &report["qos"]), (&expected, &json!("2::,10:,:,:,,")), "{report}");
    node.interrupt();
    verify(&node.recording());
}

/// The same inputs over shared memory, DDS and Zenoh: each is predicted and recorded once.
#[test]
fn inputs_that_come_over_three_buses_are_predicted_once() {
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    let Some(router) = Router::start(&python) else { return };
    let (variable, value) = router.environment();
    let mut node = node((variable, value.clone()), "both", true);
    let domain = node.domain();
    wait_until("the node listens", || node.said().contains("ROS 2 over Zenoh"));
    let arguments = ["simulate", "--rmw", "both", "--loopback", "--domain", &domain, "--shm-prefix", &node.prefix];
    let simulated = command(arguments).args(["--rate", "200", "--duration", "5"]).env(variable, value).output();
    let simulated = simulated.expect("started");
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    thread::sleep(Duration::from_secs(2)); // a report of the diagnostics
    node.interrupt();
    let content = Content::read(&node.recording());
    let mut numbers: Vec<u64> = content.inputs.iter().map(|input| input.seq).collect();
    let recorded = numbers.len();
    numbers.sort_unstable();
    numbers.dedup();
    assert_eq!(numbers.len(), recorded, "inputs were recorded twice");
    assert!(recorded > 900, "only {recorded} of 1000 inputs came");
    let again = content.count("inputs_twice");
    assert!(again > 1000, "{again} came again: not over both other buses");
    say(&format!("{recorded} inputs, {again} times again over another bus"));
    verify(&node.recording());
}

#[test]
fn a_node_joins_when_its_router_appears_and_survives_the_end_of_its_process() {
    let Some(python) = peer_program("python") else { return };
    if !program::python_has(&python, "zenoh") {
        return;
    }
    let _alone = alone();
    let port = free_port();
    let mut node = node(of_router(port), "zenoh", false);
    wait_until("the node runs without a router", || node.said().contains("ROS 2 over Zenoh"));
    let Some(_router) = Router::start_on(&python, port) else { return };
    exchange(&python, port, &node.domain(), "100", "2");
    let side = side_of(&node).expect("a process of its own");
    let killed = Command::new("kill").args(["-KILL", &side.to_string()]).status().expect("started");
    assert!(killed.success());
    wait_until("it is restarted", || side_of(&node).is_some_and(|another| another != side));
    assert!(node.said().contains("the Zenoh side ended and is restarted"), "{}", node.said());
    exchange(&python, port, &node.domain(), "100", "2");
    node.interrupt();
}

/// The process that contains Zenoh.
fn side_of(node: &Node) -> Option<u32> {
    let parent = node.process.0.id();
    let children = std::fs::read_to_string(format!("/proc/{parent}/task/{parent}/children")).unwrap_or_default();
    let of_threads = std::fs::read_dir(format!("/proc/{parent}/task")).ok()?.flatten();
    let all = of_threads.map(|thread| std::fs::read_to_string(thread.path().join("children")).unwrap_or_default());
    all.chain([children]).flat_map(|text| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>()).find_map(
        |id| {
            let arguments = std::fs::read_to_string(format!("/proc/{id}/cmdline")).ok()?;
            arguments.contains("ros2-side").then(|| id.parse().ok())?
        },
    )
}

/// A subscriber that does not read delays no other, neither while it is there nor when it is given up, after 2 s: closing the
/// link to it could hold up the node for 10 s (`bus/zenoh/linger.rs`).
#[test]
fn a_frozen_zenoh_peer_harms_nobody() {
    let Some(python) = peer_program("python") else { return };
    let _alone = alone();
    let Some(router) = Router::start(&python) else { return };
    let mut node = node(router.environment(), "zenoh", false);
    let frozen = Command::new(&python)
        .arg(manifest_dir().join("tests/peers/zenoh_peer.py"))
        .args(["--router", &router.port.to_string(), "--domain", &node.domain(), "--seconds", "60", "--rate", "1"])
        .args(["--lease-ms", "2000"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .map(Killed)
        .expect("started");
    wait_until("it is answered", || node.said().contains("seq 1 "));
    signal(&frozen.0, "-STOP");
    let report = exchange(&python, router.port, &node.domain(), "500", "10");
    assert_eq!(report["sent"], 5000, "{report}");
    drop(frozen);
    node.interrupt();
}
