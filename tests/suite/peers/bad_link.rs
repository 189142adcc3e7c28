//! rclpy over a link that loses, delays and reorders frames.

use std::collections::HashSet;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use super::{
    Content, Killed, Node, RIG, alone, manifest_dir, names, peer_by, peer_program, peer_program_in, say, say_versions,
    start, verify, wait,
};
use crate::program::{self, PATIENCE};
use serde_json::Value;
use tempfile::TempDir;

/// Two network namespaces with a link between them that loses 5 % of the frames, delays them by 50 ms and lets them overtake
/// each other. It goes when its standard input closes.
pub struct BadLink {
    process: Killed,
    near: String,
    far: String,
}

impl BadLink {
    /// `None`, with a note, if this process may not create them; with `SQUEALCAST_PEERS` set that is a failure.
    pub fn make(python: &Path) -> Option<Self> {
        let apart = Command::new("unshare").args(["--net", "true"]).stderr(Stdio::null()).status();
        if !Path::new("/dev/net/tun").exists() || !apart.is_ok_and(|status| status.success()) {
            let why = "no network namespaces, or no /dev/net/tun: it takes root, and a machine that has them";
            program::skipped(why);
            return None;
        }
        let script = manifest_dir().join("tests/peers/bad_link.py");
        let child = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut process = Killed(child.expect("started"));
        let mut line = String::new();
        BufReader::new(process.0.stdout.as_mut().expect("piped")).read_line(&mut line).expect("read");
        let ends: Value = serde_json::from_str(&line).expect("its two ends");
        Some(Self { process, near: ends["near"].to_string(), far: ends["far"].to_string() })
    }

    /// A program at the end away from the node.
    pub fn at_far(&self, program: &Path) -> Command {
        Self::at(&self.far, program)
    }

    /// A program at one end.
    fn at(end: &str, program: &Path) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--net", "--target", end]).arg(program).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET");
        command
    }
}

impl Drop for BadLink {
    fn drop(&mut self) {
        drop(self.process.0.stdin.take());
        let _ = wait(&mut self.process.0, PATIENCE);
    }
}

/// A node at the near end that records.
pub fn node_at(link: &BadLink, more: &[&str]) -> Node {
    let folder = TempDir::new().expect("a folder");
    // No other process is in these namespaces, except through shared memory.
    let (domain, prefix) = names();
    let arguments =
        ["--net", "--target", &link.near, env!("CARGO_BIN_EXE_squealcast"), "run", RIG, "--no-shm", "--record"];
    let mut arguments: Vec<String> = arguments.iter().map(|&argument| argument.to_owned()).collect();
    arguments.extend([
        folder.path().join("recordings").display().to_string(),
        "--domain".to_owned(),
        domain.id.to_string(),
    ]);
    arguments.extend(more.iter().map(|&argument| argument.to_owned()));
    let process = start(Path::new("nsenter"), &arguments, &[], folder.path());
    Node { process, domain, prefix, folder }
}

/// rclpy with a deep queue at 500 Hz over a bad link: reliable means that nothing is lost, however late it comes.
fn nothing_is_lost_over_a_bad_link(ros: &str) {
    const COUNT: u64 = 10_000;
    let (Some(ros_python), Some(python)) = (peer_program_in(ros, "ros-python"), peer_program("python")) else { return };
    let Some(link) = BadLink::make(&python) else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-rmw-fastrtps-cpp"]);
    let mut node = node_at(&link, &[]);
    // A second subscriber at the node's end, which receives the same inputs.
    let script = manifest_dir().join("tests/peers/patient_listener.py");
    let listener = BadLink::at(&link.near, &ros_python)
        .arg(script)
        .args(["--domain", &node.domain()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn();
    let mut listener = Killed(listener.expect("started"));
    let mut received = BufReader::new(listener.0.stdout.take().expect("piped")).lines();
    assert_eq!(received.next().expect("a line").expect("read"), "listening");

    let seconds = (COUNT / 500).to_string();
    let pace = ["--rate", "500", "--seconds", &seconds, "--depth", "20000", "--settle", "3", "--drain", "30"];
    // Inputs that arrive too late are passed over, and a stall is a silence until it ends.
    let only = ["--only-exchange", "--allow-passed-over", "--allow-silence", "--wait", "60"];
    let domain = node.domain();
    let report = peer_by(
        BadLink::at(&link.far, &ros_python),
        "rclpy_peer.py",
        &[&["--domain", &domain], &pace[..], &only].concat(),
    );
    drop(listener.0.stdin.take());
    let received: Value = serde_json::from_str(&received.next().expect("a line").expect("read")).expect("its account");
    node.interrupt();

    let content = Content::read(&node.recording());
    let seqs: HashSet<u64> = content.inputs.iter().map(|input| input.seq).collect();
    say(&format!(
        "bad link: {} of {COUNT} inputs recorded, {} missed, {} passed over, {} answered, first answer after {} s, {} silences; \
         rclpy next to the node: {received}",
        seqs.len(),
        content.count("ros2_missed"),
        content.count("inputs_passed_over"),
        report["answered"],
        report["first_answer_s"],
        content.silences_between,
    ));
    assert_eq!((seqs.len() as u64, content.inputs.len() as u64, content.count("ros2_missed")), (COUNT, COUNT, 0));
    verify(&node.recording());
}

#[test]
fn nothing_of_kilted_is_lost_over_a_bad_link() {
    nothing_is_lost_over_a_bad_link("");
}

#[test]
fn nothing_of_jazzy_is_lost_over_a_bad_link() {
    nothing_is_lost_over_a_bad_link("-jazzy");
}
