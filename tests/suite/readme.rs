//! Every command that README.md shows is run: those of its `sh` and `console` blocks that begin with `squealcast` or
//! `cargo run --release --`. One that says `# needs ...` behind it is skipped (`# needs a rig`), one that says
//! `# exits with N` must do so. They run one after another in one folder, with a copy of the repository's files.

use std::fs::{self, File};
use std::io::Write;
use std::os::unix::fs::symlink;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use crate::domain;
use crate::program;
use tempfile::TempDir;

/// A command that ends by itself must do so within this.
const LIMIT: Duration = Duration::from_secs(300);
/// A command that goes on is let run for this, then it gets Ctrl-C.
const LET_RUN: Duration = Duration::from_secs(3);

#[derive(Debug, PartialEq, Eq)]
struct Shown {
    /// As a shell gets it, the program's own name in front.
    command: String,
    /// A requirement that a test cannot meet.
    needs: Option<String>,
    exit_code: i32,
}

/// The commands of a Markdown text.
fn commands(text: &str) -> Vec<Shown> {
    let mut shown = Vec::new();
    let mut in_shell: Option<bool> = None;
    let mut begun = String::new();
    for line in text.lines().map(str::trim) {
        if let Some(language) = line.strip_prefix("```") {
            let language = language.split_whitespace().next().unwrap_or_default();
            in_shell = if in_shell.is_some() { None } else { Some(["sh", "console"].contains(&language)) };
            continue;
        }
        if in_shell != Some(true) {
            continue;
        }
        if let Some(part) = line.strip_suffix('\\') {
            begun += part;
            continue;
        }
        let line = std::mem::take(&mut begun) + line;
        let line = line.strip_prefix("$ ").unwrap_or(&line);
        let (command, comment) = line.split_once(" #").unwrap_or((line, ""));
        let command = command.trim();
        let own = ["squealcast", "cargo run --release --"]
            .iter()
            .find_map(|start| command.strip_prefix(start).filter(|rest| rest.starts_with(' ')));
        let Some(arguments) = own else { continue };
        let comment = comment.trim();
        shown.push(Shown {
            command: format!("squealcast{arguments}"),
            needs: comment.starts_with("needs ").then(|| comment.to_owned()),
            exit_code: comment.strip_prefix("exits with ").map_or(0, |code| code.parse().expect("an exit code")),
        });
    }
    shown
}

/// Whether a command goes on until it is stopped, or for long.
fn goes_on(command: &str) -> bool {
    let words: Vec<&str> = command.split_whitespace().collect();
    match words[1] {
        "run" | "demo" | "view" => true,
        "simulate" => !words.contains(&"--record"),
        "replay" => !words.contains(&"--verify"),
        _ => false,
    }
}

fn say(text: &str) {
    // Not held back by the test harness.
    let _ = writeln!(std::io::stderr(), "readme: {text}");
}

fn wait(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let until = Instant::now() + limit;
    while Instant::now() < until {
        if let Some(status) = child.try_wait().expect("waited") {
            return Some(status);
        }
        thread::sleep(Duration::from_millis(10));
    }
    None
}

/// Everything it started.
fn signal(child: &Child, signal: &str) {
    let _ = Command::new("kill").args([signal, "--", &format!("-{}", child.id())]).status();
}

/// A process group that does not outlive the test.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        if self.0.try_wait().is_ok_and(|status| status.is_none()) {
            signal(&self.0, "-KILL");
            let _ = self.0.wait();
        }
    }
}

fn run(shown: &Shown, folder: &Path) {
    let program = Path::new(env!("CARGO_BIN_EXE_squealcast"));
    let path =
        format!("{}:{}", program.parent().expect("a folder").display(), std::env::var("PATH").unwrap_or_default());
    let (stdout, stderr) = (folder.join(".stdout"), folder.join(".stderr"));
    let domain = domain::Domain::claim();
    // Where it is one program, Ctrl-C reaches it and the exit code is its exit code, not the shell's.
    let exec = if shown.command.contains(['|', ';', '&']) { "" } else { "exec " };
    let child = Command::new("sh")
        .args(["-c", &format!("{exec}{}", shown.command)])
        .current_dir(folder)
        .env("PATH", path)
        // Away from nodes that run on this machine.
        .env("XDG_CACHE_HOME", program::cache_folder())
        .env("ROS_DOMAIN_ID", domain.id.to_string())
        .stdin(Stdio::null())
        .stdout(File::create(&stdout).expect("created"))
        .stderr(File::create(&stderr).expect("created"))
        .process_group(0)
        .spawn()
        .expect("started");
    let mut child = Killed(child);
    let started = Instant::now();
    let mut status = wait(&mut child.0, if goes_on(&shown.command) { LET_RUN } else { LIMIT });
    let interrupted = status.is_none() && goes_on(&shown.command);
    if interrupted {
        signal(&child.0, "-INT");
        let asked = Instant::now();
        status = wait(&mut child.0, LIMIT);
        program::promised("Ctrl-C", asked.elapsed(), Duration::from_secs(2));
    }
    let said = || [&stdout, &stderr].map(|path| fs::read_to_string(path).unwrap_or_default()).concat();
    let Some(status) = status else { panic!("{}: does not end\n{}", shown.command, said()) };
    assert_eq!(status.code(), Some(shown.exit_code), "{}: {status}\n{}", shown.command, said());
    let how = if interrupted { ", Ctrl-C" } else { "" };
    say(&format!("{} ({:.1?}{how})", shown.command, started.elapsed()));
}

#[test]
fn every_command_of_the_readme_works() {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR"));
    let shown = commands(&fs::read_to_string(repository.join("README.md")).unwrap_or_default());
    if shown.is_empty() {
        say("skipped: README.md shows no command of squealcast");
        return;
    }
    let folder = TempDir::new().expect("a folder");
    for entry in fs::read_dir(repository).expect("read").map(|entry| entry.expect("one")) {
        let name = entry.file_name();
        if name != "target" && !name.to_string_lossy().starts_with('.') {
            symlink(entry.path(), folder.path().join(name)).expect("linked");
        }
    }
    say(&format!("squealcast {}", env!("CARGO_PKG_VERSION")));
    for shown in &shown {
        match &shown.needs {
            Some(needs) => say(&format!("not run: {}, {needs}", shown.command)),
            None => run(shown, folder.path()),
        }
    }
}

#[test]
fn commands_are_found() {
    let text = "`squealcast no`\n```sh\ncargo run --release -- demo\ncargo test --release\n```\n\
                1. x\n   ```console\n   $ squealcast run a \\\n       --record b   # needs a rig\n   output\n   ```\n\
                ```toml\nsquealcast = 1\n```\n```sh\nsquealcast check bad.toml # exits with 1\n```\n";
    let plain = |command: &str| Shown { command: command.to_owned(), needs: None, exit_code: 0 };
    let expected = [
        plain("squealcast demo"),
        Shown { needs: Some("needs a rig".to_owned()), ..plain("squealcast run a --record b") },
        Shown { exit_code: 1, ..plain("squealcast check bad.toml") },
    ];
    assert_eq!(commands(text), expected);
}
