//! A node as it is operated: started by a launch file, killed, and with the real brake.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use super::{
    Content, Node, RIG, alone, manifest_dir, names, now_ns, peer, peer_program, point, read_by_others, say,
    say_exchange, say_versions, signal, squealcast, start, verify, wait,
};
use crate::program::{PATIENCE, promised, until as wait_until};
use squealcast::bus::shm::{ShmOptions, ShmSource};
use tempfile::TempDir;

#[test]
fn the_launch_file_puts_the_node_into_a_namespace() {
    let Some(python) = peer_program("python") else { return };
    let file = manifest_dir().join("launch/squealcast.launch.py").display().to_string();
    for namespace in ["left", "/left"] {
        let loaded = peer(&python, "load_launch.py", &[&file, &format!("namespace:={namespace}")]);
        let command: Vec<String> = serde_json::from_value(loaded["command"].clone()).expect("a command line");
        assert!(command.windows(2).any(|pair| pair == ["-r", "__ns:=/left"]), "{command:?}");
    }
    let loaded = peer(&python, "load_launch.py", &[&file]);
    assert!(!loaded["command"].to_string().contains("__ns"), "{loaded}");
}

#[test]
fn the_launch_file_starts_the_node() {
    let (Some(ros_python), Some(python)) = (peer_program("ros-python"), peer_program("python")) else { return };
    let _alone = alone();
    let folder = TempDir::new().expect("a folder");
    let (domain, prefix) = names();
    // Another value than the node's own default: it must come from the file.
    let params = fs::read_to_string(manifest_dir().join("launch/params.yaml")).expect("parameters");
    assert!(params.contains("warn_margin: 0.05"), "{params}");
    let params_file = folder.path().join("params.yaml");
    fs::write(&params_file, params.replace("warn_margin: 0.05", "warn_margin: 0.0625")).expect("written");
    let loaded = peer(
        &python,
        "load_launch.py",
        &[
            &manifest_dir().join("launch/squealcast.launch.py").display().to_string(),
            "rig:=nine-dof",
            &format!("domain:={}", domain.id),
            "loopback:=true",
            &format!("record:={}", folder.path().join("recordings").display()),
            &format!("params_file:={}", params_file.display()),
            &format!("executable:={}", env!("CARGO_BIN_EXE_squealcast")),
        ],
    );
    let command: Vec<String> = serde_json::from_value(loaded["command"].clone()).expect("a command line");
    say(&format!("launch file, loader {}: squealcast {}", loaded["loader"], command[1..].join(" ")));
    say_versions(&ros_python, &["ros-rclpy"]);
    // As launched, but for the name of shared memory, which another user's node may have.
    let mut arguments = command[1..].to_vec();
    arguments.splice(2..2, ["--shm-prefix".to_owned(), prefix.clone()]);
    let process = start(Path::new(&command[0]), &arguments, &[], folder.path());
    let mut node = Node { process, domain, prefix, folder };
    let report = peer(
        &ros_python,
        "rclpy_peer.py",
        &["--domain", &node.domain(), "--expect-rig", "nine-dof", "--rate", "100", "--seconds", "2"],
    );
    say_exchange(&report);
    assert_eq!(report["parameters"]["values"][0], 0.0625, "{report}");
    node.interrupt();
    verify(&node.recording());
}

#[test]
fn a_killed_node_loses_a_second_at_most() {
    let _alone = alone();
    let python = peer_program("python");
    for run_ms in [900, 3300] {
        let mut node = Node::start(RIG, true);
        let options = ShmOptions { service_prefix: node.prefix.clone(), ..Default::default() };
        let shm = ShmSource::new(&options).expect("joined");
        wait_until("the node", || shm.publish(&point(0)).expect("published") > 0);
        let started = Instant::now();
        let mut seq = 0;
        while started.elapsed() < Duration::from_millis(run_ms) {
            seq += 1;
            shm.publish(&point(seq)).expect("published");
            thread::sleep(Duration::from_millis(2));
        }
        let killed_ns = now_ns() as u64;
        signal(&node.process.0, "-KILL");
        wait(&mut node.process.0, PATIENCE).expect("ended");

        let directory = node.recording();
        let output = squealcast(&["recover", &directory.display().to_string()]);
        let text = String::from_utf8_lossy(&output.stdout);
        // 3: the last chunk may be torn.
        assert!(matches!(output.status.code(), Some(0 | 3)), "{}: {text}", output.status);
        assert!(text.contains("restored"), "{text}");
        let content = Content::read(&directory);
        assert_eq!(content.rigs.len(), 1);
        // The node got some of 0 from before it was there, too.
        let seqs: Vec<u64> = content.inputs.iter().map(|input| input.seq).filter(|&seq| seq > 0).collect();
        assert_eq!(seqs, (1..=seqs.len() as u64).collect::<Vec<_>>(), "inputs are missing in between");
        let lost = Duration::from_nanos(killed_ns.saturating_sub(content.last_log_time_ns));
        say(&format!(
            "killed after {run_ms} ms: {} of {seq} inputs restored, the last {lost:.0?} lost, recover exits with {}",
            seqs.len(),
            output.status.code().unwrap_or(-1),
        ));
        promised("what a kill loses", lost, Duration::from_secs(1));
        verify(&directory);
        if let Some(python) = &python {
            read_by_others(python, &directory);
        }
        // A second repair finds nothing to do.
        assert!(squealcast(&["recover", &directory.display().to_string()]).status.success());
    }
}

/// The brake of `shared/data`: too large to predict each of 50 inputs a second.
#[test]
fn the_real_brake_runs_live() {
    let Some(ros_python) = peer_program("ros-python") else { return };
    let shared = std::env::var_os("SQUEALCAST_SHARED").map_or_else(|| manifest_dir().join("../shared"), PathBuf::from);
    let matrices = shared.join("data/brake4669");
    let Ok(files) = fs::read_dir(&matrices) else {
        say(&format!("skipped: no {}", matrices.display()));
        return;
    };
    let _alone = alone();
    let folder = TempDir::new().expect("a folder");
    for file in files.map(|file| file.expect("one").path()).filter(|path| path.extension().is_some_and(|e| e == "mtx"))
    {
        symlink(fs::canonicalize(&file).expect("there"), folder.path().join(file.file_name().expect("named")))
            .expect("linked");
    }
    let rig = folder.path().join("brake4669.toml");
    fs::copy(manifest_dir().join("launch/rigs/brake4669.toml"), &rig).expect("copied");

    say_versions(&ros_python, &["ros-rclpy"]);
    let mut node = Node::start(&rig.display().to_string(), true);
    let report = peer(
        &ros_python,
        "rclpy_peer.py",
        &[
            "--domain",
            &node.domain(),
            "--expect-rig",
            "brake4669",
            "--wait",
            "120",
            // The node comes after the peer: DDS then takes up to three seconds to discover it.
            "--settle",
            "5",
            "--speed",
            "6.283185307179586",
            "--mu-from",
            "0.34",
            "--mu-to",
            "0.36",
            "--rate",
            "50",
            "--seconds",
            "15",
            "--allow-passed-over",
        ],
    );
    say_exchange(&report);
    // Its reference conditions squeal: the table of the matrices' README.
    assert_eq!(report["levels"]["SQUEAL"], report["answered"], "{report}");
    node.interrupt();

    let content = Content::read(&node.recording());
    let (sent, answered) = (report["sent"].as_u64().expect("a count"), report["answered"].as_u64().expect("a count"));
    assert_eq!(content.inputs.len() as u64, sent, "those passed over are recorded too");
    assert_eq!(content.count("inputs_passed_over"), sent - answered, "{:?}", content.diagnostics);
    assert_eq!(content.answers(sent), 1, "the newest is predicted");
    assert!(answered >= 30, "{report}");
    say(&format!("{} inputs passed over, recorded and counted", sent - answered));
    verify(&node.recording());
}

/// What `bloom` and `colcon` read of the message package: package.xml, changelog, licences and the list of messages.
#[test]
fn the_message_package_is_ready_for_release() {
    let Some(ros_python) = peer_program("ros-python") else { return };
    let found = peer(&ros_python, "message_package.py", &[&manifest_dir().display().to_string()]);
    assert_eq!(found["problems"], serde_json::json!([]), "{found}");
    say(&format!("{} {}: {} messages", found["name"], found["version"], found["messages"]));
}
