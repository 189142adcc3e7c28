//! The program against peers that share no code with it: rclpy, CycloneDDS, iceoryx2's Python binding, the readers of
//! recordings. `tests/peers/setup.sh` installs them; without them a test says on standard error that it was skipped.
//!
//! `SQUEALCAST_PEERS` names another folder than `target/peers`; with it set, missing peers are a failure.
//! `SQUEALCAST_SHARED` names another folder with the real brake's matrices than `../shared`.

mod bad_link;
mod crowd;
mod exchange;
mod managed;
mod operation;
mod sound;
mod types;
#[cfg(feature = "zenoh")]
mod zenoh;

use std::collections::HashMap;
use std::ffi::OsString;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::domain::Domain;
use crate::program::{self, PATIENCE, cache_folder, promised};
use serde_json::Value;
use squealcast::msgs::{
    Header, Heard, OperatingPoint, Prediction, RigInfo, Sensitivity, Temperature, Time, Vibration, Waveform,
};
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

/// A program that `setup.sh` installs: `python` or `ros-python`. `None`, with a note, if it is missing.
fn peer_program(name: &str) -> Option<PathBuf> {
    peer_program_in("", name)
}

/// The same in the neighbouring folder that was set up with `PEERS_ROS=jazzy`, whose name ends with `-jazzy`.
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

/// A running node with a separate domain and prefix.
struct Node {
    process: Killed,
    domain: Domain,
    prefix: String,
    folder: TempDir,
}

impl Node {
    /// Starts `squealcast run RIG`.
    fn start(rig: &str, record: bool) -> Self {
        Self::start_with(rig, record, &[])
    }

    /// The same with more arguments.
    fn start_with(rig: &str, record: bool, more: &[&str]) -> Self {
        Self::start_in(rig, record, more, &[])
    }

    /// The same with more variables in its environment.
    fn start_in(rig: &str, record: bool, more: &[&str], variables: &[(&str, &str)]) -> Self {
        let folder = TempDir::new().expect("a folder");
        let (domain, prefix) = names();
        let mut arguments = vec!["run", rig, "--loopback"].into_iter().map(str::to_owned).collect::<Vec<_>>();
        arguments.extend(["--domain".to_owned(), domain.id.to_string(), "--shm-prefix".to_owned(), prefix.clone()]);
        if record {
            arguments.extend(["--record".to_owned(), folder.path().join("recordings").display().to_string()]);
        }
        arguments.extend(more.iter().map(|&argument| argument.to_owned()));
        let program = Path::new(env!("CARGO_BIN_EXE_squealcast"));
        Self { process: start(program, &arguments, variables, folder.path()), domain, prefix, folder }
    }

    fn domain(&self) -> String {
        self.domain.id.to_string()
    }

    /// Its output so far.
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

/// A domain, and a prefix of shared memory, that no other process on this machine uses.
fn names() -> (Domain, String) {
    let domain = Domain::claim();
    let prefix = format!("peers-{}-{}/", std::process::id(), domain.id);
    (domain, prefix)
}

fn start(program: &Path, arguments: &[String], variables: &[(&str, &str)], folder: &Path) -> Killed {
    let file = |name| File::create(folder.join(name)).expect("created");
    let child = Command::new(program)
        .args(arguments)
        .current_dir(folder)
        .env_remove("ROS_DOMAIN_ID")
        .envs(variables.iter().copied())
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
    temperatures: Vec<Temperature>,
    waveforms: Vec<Waveform>,
    heard: Vec<Heard>,
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
                Recorded::Known(Payload::Temperature(measured)) => content.temperatures.push(measured),
                Recorded::Known(Payload::Waveform(waveform)) => content.waveforms.push(waveform),
                Recorded::Known(Payload::Heard(heard)) => content.heard.push(heard),
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
