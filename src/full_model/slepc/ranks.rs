//! The processes that solve: started by a launcher, commanded through files in a folder that all of them see, and gone when
//! this program ends, however it ends.

use std::fs::{self, File};
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};
use serde::Deserialize;
use serde_json::{Value, json};

use super::Launch;
use crate::text::terminal::printable;

/// The program of the ranks.
const PROGRAM: &str = include_str!("ranks.py");
/// How often the ranks are told that this program runs. They end after a minute without that.
const BEAT: Duration = Duration::from_secs(5);
/// Longest pause between two looks for an answer.
const LOOK: Duration = Duration::from_millis(20);
/// Time for the ranks to end by themselves before they are killed.
const PATIENCE: Duration = Duration::from_secs(3);
/// After this time without a sign of the ranks, people are told what is waited for.
const SLOW_START: Duration = Duration::from_secs(60);
/// Lines of what the ranks printed that an error shows.
const LINES: usize = 20;

/// Process groups of launchers and their folders, to be removed if this program is stopped.
static RUNNING: Mutex<Vec<(Pid, PathBuf)>> = Mutex::new(vec![]);

/// Ends all ranks and removes their folders, for a program that is about to end.
pub fn end_all() {
    let running = RUNNING.lock().unwrap_or_else(PoisonError::into_inner);
    for (group, _) in running.iter() {
        // A group that is gone needs no signal.
        let _ = kill_process_group(*group, Signal::TERM);
    }
    if !running.is_empty() {
        // The launcher passes the signal on to ranks on other hosts.
        std::thread::sleep(Duration::from_millis(500));
    }
    for (group, folder) in running.iter() {
        let _ = kill_process_group(*group, Signal::KILL);
        let _ = fs::remove_dir_all(folder);
    }
}

/// What the ranks say when they are ready.
#[derive(Clone, Debug, Deserialize)]
pub struct Ready {
    pub ranks: usize,
    pub petsc: String,
    pub slepc: String,
}

/// Running ranks. They work on one command at a time.
pub struct Ranks {
    folder: PathBuf,
    state: Mutex<State>,
    beating: Arc<AtomicBool>,
    beat: Option<JoinHandle<()>>,
    launcher: String,
    pub ready: Ready,
}

struct State {
    child: Child,
    /// Number of the last command.
    number: u64,
    /// Once failed, no further command is given.
    failed: Option<String>,
}

impl Ranks {
    /// Starts ranks for `real` or `complex` numbers and waits until they are ready.
    ///
    /// # Errors
    /// The launcher cannot be started, or ended, or the ranks miss something; with what they printed.
    pub fn start(launch: &Launch, scalar: &str) -> Result<Self, String> {
        let scratch = launch.scratch.clone().unwrap_or_else(std::env::temp_dir);
        let made = tempfile::Builder::new().prefix("squealcast-slepc-").tempdir_in(&scratch);
        let folder =
            made.map_err(|error| format!("{}: cannot make a folder for the ranks: {error}", scratch.display()))?;
        let folder = folder.keep();
        let started = Self::start_in(launch, scalar, &folder);
        if started.is_err() {
            let _ = fs::remove_dir_all(&folder);
        }
        started
    }

    fn start_in(launch: &Launch, scalar: &str, folder: &Path) -> Result<Self, String> {
        let at = |error: io::Error| format!("{}: {error}", folder.display());
        let (program, alive) = (folder.join("ranks.py"), folder.join("alive"));
        fs::write(&program, PROGRAM).map_err(at)?;
        fs::write(&alive, "0").map_err(at)?;
        let output = File::create_new(folder.join("output")).map_err(at)?;
        let words = launch.words();
        let launcher = words.join(" ");
        let mut command = Command::new(&words[0]);
        command.args(&words[1..]).arg(&launch.python).arg(&program).arg(folder).arg(scalar);
        command.stdin(Stdio::null()).stdout(output.try_clone().map_err(at)?).stderr(output);
        // A Ctrl-C reaches this program alone, which then ends the ranks.
        command.process_group(0);
        let child = command.spawn().map_err(|error| {
            let hint = match error.kind() {
                io::ErrorKind::NotFound => "; expected MPI's launcher (Debian: openmpi-bin), or another --launch",
                _ => "",
            };
            format!("cannot start `{launcher}`: {error}{hint}")
        })?;
        if let Some(group) = Pid::from_raw(child.id().cast_signed()) {
            RUNNING.lock().unwrap_or_else(PoisonError::into_inner).push((group, folder.to_owned()));
        }
        let beating = Arc::new(AtomicBool::new(true));
        let beat = std::thread::spawn({
            let beating = beating.clone();
            move || {
                for count in 1_u64.. {
                    std::thread::park_timeout(BEAT);
                    if !beating.load(Ordering::Relaxed) {
                        return;
                    }
                    // Ranks that do not see it end; the next command then fails.
                    let _ = fs::write(&alive, count.to_string());
                }
            }
        });
        let mut ranks = Self {
            folder: folder.to_owned(),
            state: Mutex::new(State { child, number: 0, failed: None }),
            beating,
            beat: Some(beat),
            launcher,
            ready: Ready { ranks: 0, petsc: String::new(), slepc: String::new() },
        };
        let answer = {
            let mut state = ranks.state.lock().unwrap_or_else(PoisonError::into_inner);
            ranks.answer(&mut state.child, 0)?
        };
        ranks.ready = serde_json::from_value(answer).map_err(|error| ranks.broken(&error.to_string()))?;
        Ok(ranks)
    }

    /// Path of a file for the ranks.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// Gives a command and waits for the answer.
    ///
    /// # Errors
    /// The ranks failed or ended, now or before.
    pub fn command(&self, command: &Value) -> Result<Value, String> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(reason) = &state.failed {
            return Err(reason.clone());
        }
        state.number += 1;
        let number = state.number;
        let path = self.file(&format!("command-{number}.json"));
        let written = fs::write(&path, format!("{command}\n")).map_err(|error| format!("{}: {error}", path.display()));
        let answered = written.and_then(|()| self.answer(&mut state.child, number));
        let _ = fs::remove_file(path);
        if let Err(reason) = &answered {
            state.failed = Some(reason.clone());
        }
        answered
    }

    /// The answer with this number.
    fn answer(&self, child: &mut Child, number: u64) -> Result<Value, String> {
        let (path, began) = (self.file(&format!("reply-{number}.json")), Instant::now());
        let (mut pause, mut said) = (Duration::from_millis(1), number > 0);
        let text = loop {
            let ended = child.try_wait().map_err(|error| self.broken(&error.to_string()))?;
            match fs::read_to_string(&path) {
                Ok(text) => break text,
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(format!("{}: {error}", path.display()));
                }
                Err(_) => {}
            }
            if let Some(status) = ended {
                return Err(self.ended(status));
            }
            if began.elapsed() > SLOW_START && !said {
                said = true;
                note!("waiting for `{}` to start the ranks; Ctrl-C ends this", self.launcher);
            }
            std::thread::sleep(pause);
            pause = LOOK.min(pause.mul_f64(1.2));
        };
        let _ = fs::remove_file(&path);
        let answer: Value = serde_json::from_str(&text).map_err(|error| self.broken(&error.to_string()))?;
        match answer.get("error").and_then(Value::as_str) {
            Some(reason) => Err(format!("`{}`: {}", self.launcher, printable(reason))),
            None => Ok(answer),
        }
    }

    fn broken(&self, reason: &str) -> String {
        format!("`{}`: the answer of the ranks cannot be read: {reason}{}", self.launcher, self.output())
    }

    fn ended(&self, status: ExitStatus) -> String {
        format!("`{}` ended ({status}) before the ranks had answered{}", self.launcher, self.output())
    }

    /// The last lines that the ranks and their launcher printed.
    fn output(&self) -> String {
        let bytes = fs::read(self.file("output")).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes);
        let lines: Vec<&str> = text.lines().filter(|line| !line.trim_matches(['-', ' ']).is_empty()).collect();
        let last = &lines[lines.len().saturating_sub(LINES)..];
        if last.is_empty() {
            return "; they printed nothing".to_owned();
        }
        last.iter().fold("; they printed:".to_owned(), |all, line| all + "\n  " + &printable(line))
    }
}

impl Drop for Ranks {
    fn drop(&mut self) {
        self.beating.store(false, Ordering::Relaxed);
        if let Some(beat) = self.beat.take() {
            beat.thread().unpark();
            let _ = beat.join();
        }
        let state = self.state.get_mut().unwrap_or_else(PoisonError::into_inner);
        if state.failed.is_none() {
            let end = format!("{}\n", json!({ "do": "end" }));
            let _ = fs::write(self.folder.join(format!("command-{}.json", state.number + 1)), end);
            let began = Instant::now();
            while began.elapsed() < PATIENCE && matches!(state.child.try_wait(), Ok(None)) {
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        let group = Pid::from_raw(state.child.id().cast_signed());
        if let (Ok(None), Some(group)) = (state.child.try_wait(), group) {
            let _ = kill_process_group(group, Signal::TERM);
            let began = Instant::now();
            while began.elapsed() < PATIENCE && matches!(state.child.try_wait(), Ok(None)) {
                std::thread::sleep(Duration::from_millis(5));
            }
            let _ = kill_process_group(group, Signal::KILL);
            let _ = state.child.wait();
        }
        let _ = fs::remove_dir_all(&self.folder);
        RUNNING.lock().unwrap_or_else(PoisonError::into_inner).retain(|(_, folder)| *folder != self.folder);
    }
}
