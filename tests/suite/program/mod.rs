//! The binary as a test runs it: separate folders, exit code, both outputs.

pub mod side;

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::{OnceLock, mpsc};
use std::time::{Duration, Instant};

use npyz::WriterBuilder;
use npyz::zip::write::FileOptions;
use serde_json::Value;
use squealcast::rig::RigFile;
use tempfile::TempDir;

/// Longer than anything takes on any machine, however busy.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// Whether times are judged: `SQUEALCAST_MEASURE` is set on a quiet machine.
pub fn measuring() -> bool {
    std::env::var_os("SQUEALCAST_MEASURE").is_some()
}

/// Writes a line to standard error that the test runner does not capture.
pub fn aloud(line: &str) {
    // Standard error may be closed, which is no reason to fail.
    drop(writeln!(std::io::stderr(), "{line}"));
}

/// Reports that a test is skipped because a peer is missing; with `SQUEALCAST_PEERS` every peer is required, and it fails.
#[track_caller]
pub fn skipped(why: &str) {
    assert!(std::env::var_os("SQUEALCAST_PEERS").is_none(), "SQUEALCAST_PEERS is set, but {why}");
    aloud(&format!("skipped: {why}"));
}

/// Whether `python` has these modules; where it has not, the test is [`skipped`].
#[track_caller]
pub fn python_has(python: &Path, modules: &str) -> bool {
    let found = Command::new(python).args(["-c", &format!("import {modules}")]).output();
    let has = found.is_ok_and(|output| output.status.success());
    if !has {
        skipped(&format!("{} has no {modules} (tests/peers/setup.sh installs them)", python.display()));
    }
    has
}

/// Asserts that something took no longer than promised; on a machine that is not quiet it only says how long it took.
#[track_caller]
pub fn promised(what: &str, took: Duration, limit: Duration) {
    eprintln!("{what}: {took:.1?}, promised {limit:?}");
    assert!(!measuring() || took < limit, "{what} took {took:?}, promised {limit:?}");
}

/// Result of a run.
pub struct Run {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

/// The program with some arguments, its working directory aside from the project's.
pub fn command<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_squealcast"));
    command.args(args).current_dir(std::env::temp_dir()).env("XDG_CACHE_HOME", cache_folder()).stdin(Stdio::null());
    command
}

/// The folder for charts of the programs that this test starts: a separate one, so that no chart of an older program, or of
/// the user, answers for this one.
pub fn cache_folder() -> PathBuf {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    let made = || {
        let all = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cache");
        std::fs::create_dir_all(&all).expect("a folder of the test");
        // Folders of ended runs; several tests may search at the same time.
        for entry in std::fs::read_dir(&all).expect("just made").flatten() {
            if !Path::new("/proc").join(entry.file_name()).exists() {
                let _ = std::fs::remove_dir_all(entry.path());
            }
        }
        let folder = all.join(std::process::id().to_string());
        std::fs::create_dir_all(&folder).expect("a folder of the test");
        folder
    };
    FOLDER.get_or_init(made).clone()
}

/// Runs the program to its end.
pub fn run<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Run {
    ended(command(args).output().expect("the program starts"))
}

/// Output as text; a program that a signal killed has no exit code, and that is a failure of every test.
pub fn ended(output: Output) -> Run {
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("output is UTF-8");
    let (stdout, stderr) = (text(output.stdout), text(output.stderr));
    let code = output.status.code().unwrap_or_else(|| panic!("ended by a signal: {}\n{stderr}", output.status));
    Run { code, stdout, stderr }
}

impl Run {
    /// Asserts an exit code, showing both outputs where it is another.
    #[track_caller]
    pub fn exits(self, code: i32) -> Self {
        assert_eq!(self.code, code, "exit code\nstdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        self
    }

    /// Asserts that standard error holds `text`.
    #[track_caller]
    pub fn complains(self, text: &str) -> Self {
        assert!(self.stderr.contains(text), "no {text:?} in stderr:\n{}", self.stderr);
        self
    }

    /// Asserts that standard output holds `text`.
    #[track_caller]
    pub fn says(self, text: &str) -> Self {
        assert!(self.stdout.contains(text), "no {text:?} in stdout:\n{}", self.stdout);
        self
    }

    /// Standard output as JSON.
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|error| panic!("{error}: {}", self.stdout))
    }
}

/// Runs the program, which must end with 0, and reads its JSON.
#[track_caller]
pub fn json<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Value {
    run(args).exits(0).json()
}

/// A number of a JSON object.
#[track_caller]
pub fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("{key} is no number: {value}"))
}

/// A rig file of `launch/rigs`.
pub fn launch(name: &str) -> String {
    format!("{}/launch/rigs/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// The Python of the peers: as the environment says, the one set up here, or the machine's.
pub fn python() -> PathBuf {
    let peers = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/peers/bin/python");
    match std::env::var_os("SQUEALCAST_PEERS_PYTHON") {
        Some(path) => path.into(),
        None if peers.exists() => peers,
        None => "python3".into(),
    }
}

/// Writes the tribometer's full model, of at least `dof` degrees of freedom, into `folder` and says where its TOML file is.
pub fn tribometer(folder: &Path, dof: usize) -> PathBuf {
    run(["tribometer", "--dof", &dof.to_string(), "-o", &text(folder)]).exits(0).complains("degrees of freedom");
    folder.join("tribometer.toml")
}

/// A path as an argument.
pub fn text(path: &Path) -> String {
    path.to_str().expect("a path of a test is UTF-8").to_owned()
}

/// A folder that goes when the test ends.
pub fn folder() -> TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// A file of a rig, in memory.
pub fn rig_file(name: &str, bytes: impl Into<Vec<u8>>) -> RigFile {
    RigFile { name: name.to_owned(), bytes: bytes.into() }
}

/// An NPZ archive of arrays with name, shape and values in C order.
pub fn npz_bytes(arrays: &[(&str, &[u64], &[f64])]) -> Vec<u8> {
    let mut bytes = Cursor::new(vec![]);
    let mut archive = npyz::npz::NpzWriter::new(&mut bytes);
    for (name, shape, values) in arrays {
        let array = archive.array(name, FileOptions::default()).expect("an entry");
        let mut writer = array.default_dtype().shape(shape).begin_nd().expect("an array");
        writer.extend(values.iter().copied()).expect("its values");
        writer.finish().expect("as many as its shape says");
    }
    drop(archive);
    bytes.into_inner()
}

/// Writes a file and says where.
pub fn write(directory: &Path, name: &str, content: &str) -> String {
    let path = directory.join(name);
    std::fs::write(&path, content).expect("a test can write its files");
    text(&path)
}

/// Everything below a directory.
pub fn files_below(directory: &Path) -> Vec<PathBuf> {
    let mut found = vec![];
    for entry in std::fs::read_dir(directory).expect("a directory of the test") {
        let path = entry.expect("its entry").path();
        if path.is_dir() { found.extend(files_below(&path)) } else { found.push(path) }
    }
    found.sort();
    found
}

/// A program left running; ended when dropped.
pub struct Running(Option<Child>);

impl Running {
    pub fn start(mut command: Command) -> Self {
        Self(Some(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the program starts")))
    }

    /// Sends a signal (`HUP`) and does not wait for the effect.
    pub fn send(&self, signal: &str) {
        let id = self.0.as_ref().expect("still running").id().to_string();
        let sent = Command::new("kill").args([&format!("-{signal}"), &id]).status();
        assert!(sent.expect("kill is there").success(), "the program had ended before SIG{signal}");
    }

    /// Sends a signal (`INT`, `TERM`) and waits for the end, which is promised within 2 s. Three more are granted to a machine that
    /// does much else.
    pub fn signal(mut self, signal: &str) -> Run {
        let child = self.0.take().expect("still running");
        let id = child.id().to_string();
        let kill = move |signal: &str| Command::new("kill").args([&format!("-{signal}"), &id]).status();
        assert!(kill(signal).expect("kill is there").success(), "the program had ended before SIG{signal}");
        let started = Instant::now();
        // One that does not end at all is a failure, not a test that hangs.
        let (done, waiting) = mpsc::channel::<()>();
        let watch = std::thread::spawn(move || {
            if waiting.recv_timeout(PATIENCE) == Err(mpsc::RecvTimeoutError::Timeout) {
                let _ = kill("KILL");
            }
        });
        let output = child.wait_with_output().expect("the program ends");
        drop(done);
        watch.join().expect("the watch ends");
        promised(&format!("SIG{signal}"), started.elapsed(), Duration::from_secs(2));
        assert!(started.elapsed() < Duration::from_secs(5), "SIG{signal}: ended after {:.1?}", started.elapsed());
        ended(output)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Waits until something holds.
#[track_caller]
pub fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let started = Instant::now();
    while !holds() {
        assert!(started.elapsed() < PATIENCE, "waited {PATIENCE:?} for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
