//! The display of a real `demo` and of recordings, over plain sockets, and in Debian's Chromium where it and Node.js are
//! there.
//!
//! `tests/browser/setup.sh` installs the programs that browser tests need. Without them they are skipped with a note; with
//! `SQUEALCAST_BROWSER_TESTS=required` that is a failure.

mod load;
mod page;
mod reports;
mod server;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::program::{self, PATIENCE, measuring};

/// What measures time, or keeps the processors busy, does so alone.
static BUSY: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    BUSY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A running command with a display.
struct Shown {
    child: Child,
    address: SocketAddr,
}

impl Shown {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_squealcast"))
            .args(arguments)
            .args(["--display", "127.0.0.1:0"])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let address = lines
            .by_ref()
            .map(|line| line.unwrap())
            .find_map(|line| line.strip_prefix("display: http://")?.strip_suffix('/')?.parse().ok())
            .expect("it says where the display is");
        // The pipe is read to its end so that the command never waits for it.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, address }
    }

    fn demo(more: &[&str]) -> Self {
        Self::start(&[&["demo", "--plain", "--no-shm", "--no-ros", "--duration", "1800"], more].concat())
    }

    fn stop(mut self) {
        interrupt(&self.child);
        let asked = Instant::now();
        while self.child.try_wait().unwrap().is_none() {
            assert!(asked.elapsed() < PATIENCE, "it does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Status, head and body of an answer that ends.
    fn ask(&self, request: &str) -> (u16, String, String) {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = vec![];
        stream.read_to_end(&mut answer).unwrap();
        let text = String::from_utf8_lossy(&answer).into_owned();
        let (head, body) = text.split_once("\r\n\r\n").unwrap();
        (head[9..12].parse().unwrap(), head.to_lowercase(), body.to_owned())
    }

    fn get(&self, path: &str) -> (u16, String, String) {
        self.ask(&format!("GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n", self.address))
    }

    /// A page that listens: the lines of its stream.
    fn listen(&self) -> TcpStream {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "GET /stream HTTP/1.1\r\nHost: {}\r\n\r\n", self.address).unwrap();
        stream
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn interrupt(child: &Child) {
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
}

/// Tests that time something are for a quiet machine: with `SQUEALCAST_MEASURE=1`.
fn measures() -> bool {
    if !measuring() {
        program::aloud("skipped: it measures times; SQUEALCAST_MEASURE=1 runs it");
    }
    measuring()
}

/// Whether the browser tests can run; says why not.
fn browser_ready() -> bool {
    let node = Command::new("node").arg("--version").output().is_ok_and(|output| output.status.success());
    let chromium = std::env::var("CHROMIUM").unwrap_or_else(|_| "/usr/bin/chromium".to_owned());
    let missing = [
        (!node, "node"),
        (!Path::new(&chromium).exists(), "chromium"),
        (!browser_tests().join("node_modules/playwright-core").exists(), "playwright-core"),
        (!browser_tests().join("node_modules/axe-core").exists(), "axe-core"),
    ];
    let missing: Vec<&str> = missing.iter().filter(|(missing, _)| *missing).map(|(_, name)| *name).collect();
    if !missing.is_empty() {
        let reason = format!("no {}: tests/browser/setup.sh installs it", missing.join(", no "));
        assert!(std::env::var_os("SQUEALCAST_BROWSER_TESTS").is_none_or(|value| value != "required"), "{reason}");
        eprintln!("SKIPPED: {reason}");
    }
    missing.is_empty()
}

fn browser_tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser")
}

/// Output of a browser test.
fn browse(script: &str, arguments: &[&str]) -> serde_json::Value {
    let pictures = std::env::var("SQUEALCAST_PICTURES").unwrap_or_default();
    let output = Command::new("node").arg(browser_tests().join(script)).args(arguments).arg(pictures).output().unwrap();
    assert!(output.status.success(), "{script}:\n{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}
