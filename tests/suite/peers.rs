//! The program against peers that share no code with it: rclpy, CycloneDDS, iceoryx2's Python binding, the readers of
//! recordings. `tests/peers/setup.sh` installs them; without them a test says on standard error that it was skipped.
//!
//! `SQUEALCAST_PEERS` names another folder than `target/peers`; with it set, missing peers are a failure.
//! `SQUEALCAST_SHARED` names another folder with the real brake's matrices than `../shared`.

use std::collections::{HashMap, HashSet};
use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::domain::Domain;
use crate::program::{self, PATIENCE, cache_folder, promised, until as wait_until};
use crossbeam_channel::{Receiver, unbounded};
use serde_json::Value;
use squealcast::bus::received::Received;
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::{Ros2Options, Ros2Source};
use squealcast::bus::shm::{ShmOptions, ShmSink, ShmSource, ShmVibrationSource};
use squealcast::msgs::{Header, OperatingPoint, Prediction, RigInfo, Sensitivity, Time, Vibration};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};
use tempfile::TempDir;

const RIG: &str = "nine-dof-case-2";
/// The critical friction coefficient of [`RIG`] (`squealcast critical`; proven in the tests of the physics).
const CRITICAL: &str = "0.355928058261";

/// Two nodes at a time would take each other's processor.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Says something that the test runner does not capture.
fn say(text: &str) {
    program::aloud(&format!("peers: {text}"));
}

fn manifest_dir() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A program that `setup.sh` leaves: `python` or `ros-python`. `None`, said aloud, where it is not there.
fn peer_program(name: &str) -> Option<PathBuf> {
    peer_program_in("", name)
}

/// The same in the folder beside it that was set up with `PEERS_ROS=jazzy`, whose name ends with `-jazzy`.
fn peer_program_in(suffix: &str, name: &str) -> Option<PathBuf> {
    let given = std::env::var_os("SQUEALCAST_PEERS").map(|folder| PathBuf::from(folder_with(folder, suffix)));
    let folder = given.clone().unwrap_or_else(|| manifest_dir().join(format!("target/peers{suffix}")));
    let program = [folder.join("bin").join(name), folder.join(name)].into_iter().find(|path| path.is_file());
    match (&program, given) {
        (None, Some(folder)) => panic!("SQUEALCAST_PEERS={}: no {name}", folder.display()),
        (None, None) => say(&format!("skipped: no {name} in {}; run tests/peers/setup.sh", folder.display())),
        _ => {}
    }
    program
}

fn folder_with(mut folder: OsString, suffix: &str) -> OsString {
    folder.push(suffix);
    folder
}

/// Says which versions of some Python packages a peer has.
fn say_versions(python: &Path, packages: &[&str]) {
    let script = "import importlib.metadata as m, platform, sys; \
                  print(', '.join(f'{p} {m.version(p)}' for p in sys.argv[1:]), 'on Python', platform.python_version())";
    let output = Command::new(python).args(["-c", script]).args(packages).output().expect("started");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let test = thread::current().name().unwrap_or_default().to_owned();
    let versions = String::from_utf8_lossy(&output.stdout);
    say(&format!("{test}: squealcast {} against {}", env!("CARGO_PKG_VERSION"), versions.trim()));
}

/// Runs a script of `tests/peers` to its end and gives back its one line of JSON.
fn peer(python: &Path, script: &str, arguments: &[&str]) -> Value {
    peer_by(Command::new(python), script, arguments)
}

/// The same by a command that gets the script's path and arguments.
fn peer_by(mut command: Command, script: &str, arguments: &[&str]) -> Value {
    let mut child = command
        .arg(manifest_dir().join("tests/peers").join(script))
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map(Killed)
        .expect("started");
    // They bound their own run time; no pipe of theirs fills up.
    let output = child.output();
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{script} {arguments:?}: {}\n{text}\n{errors}", output.status);
    serde_json::from_str(text.trim()).unwrap_or_else(|error| panic!("{script}: {error}\n{text}\n{errors}"))
}

/// A process that does not outlive its test.
struct Killed(Child);

impl Killed {
    fn output(&mut self) -> Output {
        use std::io::Read;
        let (mut stdout, mut stderr) = (self.0.stdout.take().expect("piped"), self.0.stderr.take().expect("piped"));
        let errors = thread::spawn(move || {
            let mut bytes = Vec::new();
            stderr.read_to_end(&mut bytes).map(|_| bytes).unwrap_or_default()
        });
        let mut bytes = Vec::new();
        stdout.read_to_end(&mut bytes).expect("read");
        Output { status: self.0.wait().expect("waited"), stdout: bytes, stderr: errors.join().expect("read") }
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A running node with a domain and a prefix of its own.
struct Node {
    process: Killed,
    domain: Domain,
    prefix: String,
    folder: TempDir,
}

impl Node {
    /// Starts `squealcast run RIG`.
    fn start(rig: &str, record: bool) -> Self {
        let folder = TempDir::new().expect("a folder");
        let (domain, prefix) = names();
        let mut arguments = vec!["run", rig, "--loopback"].into_iter().map(str::to_owned).collect::<Vec<_>>();
        arguments.extend(["--domain".to_owned(), domain.id.to_string(), "--shm-prefix".to_owned(), prefix.clone()]);
        if record {
            arguments.extend(["--record".to_owned(), folder.path().join("recordings").display().to_string()]);
        }
        let program = Path::new(env!("CARGO_BIN_EXE_squealcast"));
        Self { process: start(program, &arguments, folder.path()), domain, prefix, folder }
    }

    fn domain(&self) -> String {
        self.domain.id.to_string()
    }

    /// What it said so far.
    fn said(&self) -> String {
        ["stdout", "stderr"].map(|name| fs::read_to_string(self.folder.path().join(name)).unwrap_or_default()).concat()
    }

    /// SIGINT; it must end well, within 2 s as promised.
    fn interrupt(&mut self) {
        let asked = Instant::now();
        signal(&self.process.0, "-INT");
        let status = wait(&mut self.process.0, PATIENCE).unwrap_or_else(|| panic!("does not end: {}", self.said()));
        promised("SIGINT", asked.elapsed(), Duration::from_secs(2));
        assert!(status.success(), "{status}: {}", self.said());
    }

    /// The one recording it made.
    fn recording(&self) -> PathBuf {
        only_entry(&self.folder.path().join("recordings"))
    }
}

/// A domain, and a prefix of shared memory, that nobody else on this machine uses now.
fn names() -> (Domain, String) {
    let domain = Domain::claim();
    let prefix = format!("peers-{}-{}/", std::process::id(), domain.id);
    (domain, prefix)
}

fn start(program: &Path, arguments: &[String], folder: &Path) -> Killed {
    let file = |name| File::create(folder.join(name)).expect("created");
    let child = Command::new(program)
        .args(arguments)
        .current_dir(folder)
        .env_remove("ROS_DOMAIN_ID")
        .env("XDG_CACHE_HOME", cache_folder())
        .stdin(Stdio::null())
        .stdout(file("stdout"))
        .stderr(file("stderr"))
        .spawn();
    Killed(child.expect("started"))
}

fn signal(process: &Child, signal: &str) {
    let status = Command::new("kill").args([signal, &process.id().to_string()]).status().expect("started");
    assert!(status.success());
}

fn wait(process: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let until = Instant::now() + limit;
    while Instant::now() < until {
        if let Some(status) = process.try_wait().expect("waited") {
            return Some(status);
        }
        thread::sleep(Duration::from_millis(5));
    }
    None
}

fn only_entry(folder: &Path) -> PathBuf {
    let entries: Vec<PathBuf> =
        fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("one").path()).collect();
    let [entry] = entries.as_slice() else { panic!("not one but {entries:?}") };
    entry.clone()
}

/// Charts are not taken from the nodes that were recorded: a replay makes its own.
fn squealcast(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_squealcast"));
    command.args(arguments).env("XDG_CACHE_HOME", cache_folder().join("replay")).stdin(Stdio::null());
    command.output().expect("started")
}

/// `replay --verify`: the same bytes again.
fn verify(recording: &Path) {
    let output = squealcast(&["replay", &recording.display().to_string(), "--verify"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}: {text}{}", output.status, String::from_utf8_lossy(&output.stderr));
    assert!(text.contains(" 0 different, 0 missing, 0 extra"), "{text}");
    say(&format!("replay --verify: {}", text.trim()));
}

/// What PyPI mcap, mcap-ros2-support and rosbags find in a recording: the same.
fn read_by_others(python: &Path, recording: &Path) -> Value {
    let found = peer(python, "read_recording.py", &["--summary", &recording.display().to_string()]);
    assert_eq!(found["same"], true, "{found}");
    say(&format!("read by {}: {}", found["versions"], found["topics"]));
    found
}

fn say_exchange(report: &Value) {
    let of = |name| &report[name];
    say(&format!(
        "{} of {} answered at {} Hz, latency {} ms, levels {}",
        of("answered"),
        of("sent"),
        of("rate_hz"),
        of("latency_ms"),
        of("levels")
    ));
}

/// Everything in a recording, by kind.
#[derive(Default)]
struct Content {
    inputs: Vec<OperatingPoint>,
    predictions: Vec<Prediction>,
    rigs: Vec<RigInfo>,
    sensitivities: Vec<Sensitivity>,
    vibrations: Vec<Vibration>,
    /// FAULTs for silence with inputs before and after.
    silences_between: usize,
    /// The values of the last diagnostics.
    diagnostics: HashMap<String, String>,
    last_log_time_ns: u64,
}

impl Content {
    fn read(path: &Path) -> Self {
        let recording = Recording::open(path).expect("a recording");
        assert!(recording.is_complete(), "{:?}", recording.damage());
        let mut content = Self::default();
        let mut silences = 0;
        for entry in recording.messages() {
            content.last_log_time_ns = entry.log_time_ns;
            match entry.message {
                Recorded::Known(Payload::OperatingPoint(input)) => {
                    content.silences_between += if content.inputs.is_empty() { 0 } else { silences };
                    silences = 0;
                    content.inputs.push(input);
                }
                Recorded::Known(Payload::Prediction(prediction)) => {
                    silences += usize::from(prediction.reason.starts_with("stale"));
                    content.predictions.push(prediction);
                }
                Recorded::Known(Payload::RigInfo(rig)) => content.rigs.push(rig),
                Recorded::Known(Payload::Diagnostics(array)) => {
                    let values = array.status.into_iter().flat_map(|status| status.values);
                    content.diagnostics = values.map(|pair| (pair.key, pair.value)).collect();
                }
                Recorded::Known(Payload::SessionEvent(_)) => {}
                Recorded::Known(Payload::Vibration(vibration)) => content.vibrations.push(vibration),
                Recorded::Known(Payload::Sensitivity(sensitivity)) => content.sensitivities.push(sensitivity),
                other => panic!("{other:?}"),
            }
        }
        content
    }

    fn count(&self, key: &str) -> u64 {
        self.diagnostics[key].parse().unwrap_or_else(|_| panic!("{key}: {}", self.diagnostics[key]))
    }

    /// How many predictions answer the input with a sequence number.
    fn answers(&self, seq: u64) -> usize {
        let silence = |prediction: &&Prediction| !prediction.reason.starts_with("stale");
        self.predictions.iter().filter(|prediction| prediction.input_seq == seq).filter(silence).count()
    }
}

fn now_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_nanos() as i64
}

fn point(seq: u64) -> OperatingPoint {
    OperatingPoint {
        header: Header { stamp: Time::from_ns(now_ns()), frame_id: String::new() },
        seq,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.3 + 1e-4 * (seq % 1000) as f64,
    }
}

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

/// Two network namespaces with a link between them that loses 5 % of the frames, delays them by 50 ms and lets them overtake
/// each other. It goes when its standard input closes.
struct BadLink {
    process: Killed,
    near: String,
    far: String,
}

impl BadLink {
    /// `None`, said aloud, where this process may make none; with `SQUEALCAST_PEERS` set that is a failure.
    fn make(python: &Path) -> Option<Self> {
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

/// rclpy with a deep queue at 500 Hz over a bad link: reliable means that nothing is lost, however late it comes.
fn nothing_is_lost_over_a_bad_link(ros: &str) {
    const COUNT: u64 = 10_000;
    let (Some(ros_python), Some(python)) = (peer_program_in(ros, "ros-python"), peer_program("python")) else { return };
    let Some(link) = BadLink::make(&python) else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-rmw-fastrtps-cpp"]);
    let folder = TempDir::new().expect("a folder");
    // Nobody else is in these namespaces, but for shared memory.
    let (domain, prefix) = names();
    let arguments =
        ["--net", "--target", &link.near, env!("CARGO_BIN_EXE_squealcast"), "run", RIG, "--no-shm", "--record"];
    let mut arguments: Vec<String> = arguments.iter().map(|&argument| argument.to_owned()).collect();
    arguments.extend([
        folder.path().join("recordings").display().to_string(),
        "--domain".to_owned(),
        domain.id.to_string(),
    ]);
    let process = start(Path::new("nsenter"), &arguments, folder.path());
    let mut node = Node { process, domain, prefix, folder };
    // Somebody at the node's end who hears the same inputs.
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
    // What comes too late to be predicted is passed over, and a stall is a silence until it ends.
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
         rclpy beside the node: {received}",
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

/// Ours on both buses at once: the node must not care over which of them it hears first.
#[test]
fn what_comes_over_both_buses_is_answered_once() {
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

/// A measured vibration over both buses, or one of them, into a recording that others read: each once, beside inputs.
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
    // Until the node has discovered us in its turn: an answer, and vibrations with numbers of their own until then.
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
        // What came over shared memory first has lost its frame.
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
    // As launched, but for the name of shared memory, which a node of somebody else may have.
    let mut arguments = command[1..].to_vec();
    arguments.splice(2..2, ["--shm-prefix".to_owned(), prefix.clone()]);
    let process = start(Path::new(&command[0]), &arguments, folder.path());
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
            // The node comes after the peer: DDS then takes up to three seconds until it hears of it.
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
