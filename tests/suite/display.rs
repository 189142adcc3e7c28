//! The display against a real `demo`: over plain sockets, and in Debian's Chromium where it and Node.js are there.
//!
//! `tests/browser/setup.sh` installs the programs that browser tests need. Without them they are skipped with a note; with
//! `SQUEALCAST_BROWSER_TESTS=required` that is a failure.

use std::collections::HashMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::program::{self, PATIENCE, measuring, npz_bytes};
use crate::sound_beside_logs::simulated;
use squealcast::msgs::{OperatingPoint, Prediction};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};

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

/// Predictions of a recording with their conditions, by sequence number.
fn predictions(directory: &Path) -> HashMap<u64, (OperatingPoint, Prediction)> {
    let session = std::fs::read_dir(directory).unwrap().next().unwrap().unwrap().path();
    let mut inputs = HashMap::new();
    let mut predictions = HashMap::new();
    for entry in Recording::open(&session).unwrap().messages() {
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => drop(inputs.insert(input.seq, input)),
            Recorded::Known(Payload::Prediction(prediction)) => {
                if let Some(input) = inputs.get(&prediction.input_seq) {
                    predictions.insert(prediction.input_seq, (OperatingPoint::clone(input), prediction));
                }
            }
            _ => {}
        }
    }
    predictions
}

#[test]
fn the_page_shows_a_demo_as_it_is() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&["--rate", "200", "--record", directory.path().to_str().unwrap()]);
    let seen = browse("live.mjs", &[&format!("http://{}/", shown.address)]);
    shown.stop();

    // Every number on the page against the prediction that was published for the same input.
    let published = predictions(directory.path());
    let moments = seen["shown"].as_array().unwrap();
    assert!(moments.len() > 10);
    for moment in moments {
        let seq: u64 = moment["seq"].as_str().unwrap().parse().unwrap();
        let (input, prediction) = &published[&seq];
        // The level is there at once, the numbers follow every 0.3 s: within 0.5 s of them there was such a prediction.
        let level = moment["level"].as_str().unwrap();
        let near = (seq.saturating_sub(100)..seq + 100).filter_map(|seq| published.get(&seq));
        let levels: Vec<String> =
            near.map(|(_, near)| squealcast::msgs::level::name(near.level).to_lowercase()).collect();
        assert!(levels.iter().any(|near| near == level), "{level} about input {seq}");
        let numbers = &moment["numbers"];
        for (name, value) in [
            ("margin", prediction.friction_margin),
            ("growth", prediction.max_growth_rate_per_s),
            ("worst", prediction.worst_frequency_hz),
            ("unstable", f64::from(prediction.unstable_modes)),
            ("mu", input.friction_coefficient),
            ("load", input.normal_load_n),
            ("speed", input.disc_speed_rad_s),
        ] {
            let (exact, text) =
                (numbers[name]["value"].as_str().unwrap(), numbers[name]["text"].as_str().unwrap().replace('−', "-"));
            if value.is_finite() {
                assert_eq!(exact.parse::<f64>().unwrap().to_bits(), value.to_bits(), "{name} of input {seq}");
                let decimals = text.split_once('.').map_or(0, |(_, decimals)| decimals.len());
                let half = 0.5 * 10f64.powi(-(decimals as i32)) * (1.0 + 1e-9);
                assert!((text.parse::<f64>().unwrap() - value).abs() <= half, "{name} of input {seq}: {text}, {value}");
            } else {
                assert_eq!((exact, text.as_str()), ("", "–"), "{name} of input {seq}");
            }
        }
        // What squeals next is the end of a window that the margin is measured to.
        if let Ok(end) = numbers["answer-mu"]["value"].as_str().unwrap().parse::<f64>() {
            let (away, margin) = ((end - input.friction_coefficient).abs(), prediction.friction_margin.abs());
            assert!(
                (away - margin).abs() < 1e-6,
                "input {seq}: the end at {end} is {away} away, the margin is {margin}"
            );
        }
        let modes = moment["modes"].as_array().unwrap();
        assert_eq!(modes.len(), prediction.modes.len());
        for mode in modes {
            let known =
                prediction.modes.iter().find(|known| u64::from(known.id) == mode["id"].as_u64().unwrap()).unwrap();
            let values = [
                known.frequency_hz,
                known.growth_rate_per_s,
                known.damping_ratio,
                known.pad_participation,
                known.frequency_error_hz,
                known.growth_rate_error_per_s,
            ];
            assert_eq!(mode["values"].as_array().unwrap().len(), values.len());
            for (shown, value) in mode["values"].as_array().unwrap().iter().zip(values) {
                // Unknown values, such as the pad's share of a charted cluster, are shown as empty.
                let exact = shown.as_str().unwrap().parse().ok();
                assert_eq!(exact, value.is_finite().then_some(value), "mode {} of input {seq}", known.id);
            }
        }
    }
    let squealed = |moment: &&serde_json::Value| {
        let seq: u64 = moment["seq"].as_str().unwrap().parse().unwrap();
        published[&seq].1.level == squealcast::msgs::level::SQUEAL
    };
    assert!(moments.iter().any(|moment| squealed(&moment)) && !moments.iter().all(|moment| squealed(&moment)));
    println!("first paint {} ms, page work {} of a core", seen["first_paint_ms"], seen["work"]);
    if measuring() {
        assert!(seen["first_paint_ms"].as_f64().unwrap() < 1000.0, "first paint after {} ms", seen["first_paint_ms"]);
        assert!(seen["work"].as_f64().unwrap() < 0.2, "the page takes {} of a core", seen["work"]);
    }
    assert!(seen["csv"].as_str().unwrap().contains(",SQUEAL,"));
}

/// Fields of an answer, sorted.
fn fields(answer: &serde_json::Value) -> Vec<&str> {
    let mut fields: Vec<&str> = answer.as_object().unwrap().keys().map(String::as_str).collect();
    fields.sort_unstable();
    fields
}

/// Made-up answers lead the page into every status; that they are as a node's answers, a demo shows.
#[test]
fn the_page_shows_every_status_and_the_next_squeal() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let made_up = browse("states.mjs", &[]);
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "100"]);
    let json = |path: &str| serde_json::from_str::<serde_json::Value>(&shown.get(path).2).unwrap_or_default();
    let began = Instant::now();
    let state = loop {
        let state = json("/state.json");
        if state["fastest"].is_object() && state["next"].is_object() && state["map"].as_u64() > Some(0) {
            break state;
        }
        assert!(began.elapsed() < PATIENCE, "no mode grows: {state}");
        std::thread::sleep(Duration::from_millis(50));
    };
    let (about, events) = (json("/about.json"), json("/events.json"));
    let map = json(&format!("/map.json?number={}", state["map"]));
    let shape = json(&format!("/shape.json?id={}", state["fastest"]["id"]));
    shown.stop();
    for (name, answer) in [
        ("state", &state),
        ("fastest", &state["fastest"]),
        ("next", &state["next"]),
        ("about", &about),
        ("map", &map),
        ("curve", &map["modes"][0]),
        ("window", &map["windows"][0]),
        ("shape", &shape),
        ("part", &shape["parts"][0]),
        ("growth_change", &shape["growth_change"]),
        ("event", &events[0]),
        ("moment", &events[0]["onset"]),
    ] {
        let known: Vec<&str> = made_up[name].as_array().unwrap().iter().map(|field| field.as_str().unwrap()).collect();
        assert_eq!(fields(answer), known, "{name}");
    }
    assert_eq!(about["event_columns"], made_up["event_columns"]);
    let disc = serde_json::to_value(tribometer_axis()).unwrap();
    assert_eq!(serde_json::json!(fields(&disc)), made_up["disc"]);
}

/// The page of a node whose contact pairs open and close shows their forces: those of the state at the conditions it names.
#[test]
fn the_page_shows_the_contact() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let shown = Shown::demo(&["rough-pad", "--rate", "100"]);
    let found = browse("contact.mjs", &[&format!("http://{}/", shown.address)]);
    let answer: serde_json::Value = serde_json::from_str(&shown.get("/contact.json").2).unwrap();
    shown.stop();
    let made_up = |name: &str| -> Vec<&str> {
        found["fields"][name].as_array().unwrap().iter().map(|field| field.as_str().unwrap()).collect()
    };
    assert_eq!(fields(&answer), made_up("contact"));
    let place = squealcast::display::contact::Place { along_m: 0.0, outward_m: 0.0, opposite: false };
    assert_eq!(fields(&serde_json::to_value(place).unwrap()), made_up("place"));
    let number = |name: &str| answer[name].as_f64().unwrap();
    let rig = squealcast::rig::Rig::load("rough-pad").unwrap();
    let point = squealcast::physics::OperatingPoint {
        normal_load_n: number("normal_load_n"),
        disc_speed_rad_s: number("disc_speed_rad_s"),
        friction_coefficient: number("friction_coefficient"),
    };
    let state = rig.model.at(&point).unwrap().state().unwrap().clone();
    let forces: Vec<f64> = answer["force_n"].as_array().unwrap().iter().map(|force| force.as_f64().unwrap()).collect();
    assert_eq!(forces, state.force_n);
    // The page shows a bar for each pair, as high as its force is of the largest.
    let page = &found["shown"];
    assert!(page["note"].as_str().unwrap().starts_with("7 of 7 pairs closed at "), "{page}");
    let bars: Vec<f64> = page["bars"].as_array().unwrap().iter().map(|bar| bar.as_f64().unwrap()).collect();
    let forces: Vec<f64> = page["titles"]
        .as_array()
        .unwrap()
        .iter()
        .map(|title| title.as_str().unwrap().split([' ']).nth(2).unwrap().parse().unwrap())
        .collect();
    let most = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
    assert_eq!((bars.len(), forces.len()), (7, 7));
    for (bar, force) in bars.iter().zip(&forces) {
        // Forces are written with two decimals.
        assert!((bar / most(&bars) - force / most(&forces)).abs() < 0.01 / most(&forces), "{page}");
    }
}

fn tribometer_axis() -> squealcast::rig::DiscAxis {
    squealcast::rig::Rig::load("tribometer").unwrap().disc_axis.unwrap()
}

/// A ring of 24 nodes with a pair of modes, `z = cos 2θ` and `z = sin 2θ`, and two contact points that couple them:
/// one feels the first along the normal and the second along the sliding direction, the other the reverse. So
///
/// ```text
/// K = (ω² + k) I + μ k [0 -1; 1 0],   λ² = -(ω² + k) ± i μ k
/// ```
///
/// and the growing mode is `(1, i)`: `z = Re((cos 2θ + i sin 2θ) e^{iωt}) = cos(2θ + ωt)`.
fn ring(directory: &Path) -> PathBuf {
    let nodes = 24;
    let mut nodes_m = vec![];
    let mut phi = vec![];
    for k in 0..nodes {
        let theta = std::f64::consts::TAU * f64::from(k) / f64::from(nodes);
        nodes_m.extend([0.1 * theta.cos(), 0.1 * theta.sin(), 0.0]);
        phi.extend([0.0, 0.0, 0.0, 0.0, (2.0 * theta).cos(), (2.0 * theta).sin()]);
    }
    // At (r, 0) the disc slides along +y, at (0, r) along -x. Rows x, y, z; columns the two modes.
    nodes_m.extend([0.12, 0.0, 0.0, 0.0, 0.12, 0.0]);
    phi.extend([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
    phi.extend([1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    let arrays: [(&str, &[u64], &[f64]); 3] =
        [("omega_rad_s", &[2], &[600.0, 600.0]), ("phi", &[26, 3, 2], &phi), ("nodes_m", &[26, 3], &nodes_m)];
    std::fs::write(directory.join("pad.npz"), npz_bytes(&arrays)).unwrap();
    let rig = "name = \"ring\"\n[pad]\nmodal = \"pad.npz\"\n[[contact_patch]]\npad_nodes = [24, 25]\n\
               axis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 0.0, 1.0]\nnormal = [0.0, 0.0, 1.0]\n\
               stiffness_n_per_m = 1e5\n[search]\nmu_max = 2.0\n";
    let path = directory.join("ring.toml");
    std::fs::write(&path, rig).unwrap();
    path
}

#[test]
fn a_travelling_wave_travels_the_right_way() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&[ring(directory.path()).to_str().unwrap()]);
    browse("wave.mjs", &[&format!("http://{}/", shown.address)]);
    shown.stop();
}

/// Tests that time something are for a quiet machine: with `SQUEALCAST_MEASURE=1`.
fn measures() -> bool {
    if !measuring() {
        program::aloud("skipped: it measures times; SQUEALCAST_MEASURE=1 runs it");
    }
    measuring()
}

/// A minute at 1 kHz; ten where times are measured.
#[test]
fn a_long_recording_opens_at_once_and_is_reported() {
    let minutes = if measures() { 10 } else { 1 };
    let at_once = |took: Duration| !measuring() || took < Duration::from_secs(3);
    let _alone = alone();
    let directory = tempfile::tempdir().unwrap();
    let simulated = Command::new(env!("CARGO_BIN_EXE_squealcast"))
        .args(["simulate", "--rig", "nine-dof-case-2", "--rate", "1000", "--record"])
        .arg(directory.path())
        .args(["--duration", &(60 * minutes).to_string()])
        .output()
        .unwrap();
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    let session = std::fs::read_dir(directory.path()).unwrap().next().unwrap().unwrap().path();
    let session = session.to_str().unwrap();

    let began = Instant::now();
    let shown = Shown::start(&["view", session]);
    let took = began.elapsed();
    println!("served in {took:?}");
    assert!(at_once(took), "opened in {took:?}");
    let about: serde_json::Value = serde_json::from_str(&shown.get("/about.json").2).unwrap();
    let span: Vec<f64> = about["span_s"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert!((span[1] - span[0] - 60.0 * f64::from(minutes)).abs() < 0.5, "{span:?}");
    // The paper's profile passes the critical value three times a round of 30 s.
    let events: serde_json::Value = serde_json::from_str(&shown.get("/events.json").2).unwrap();
    let squeals = 6 * minutes as usize;
    assert_eq!(events.as_array().unwrap().len(), squeals);
    if browser_ready() {
        let speed = browse("view.mjs", &[&format!("http://{}/", shown.address)]);
        println!("{speed}");
        assert!(at_once(Duration::from_secs_f64(1e-3 * speed["opened_ms"].as_f64().unwrap())), "{speed}");
        let waits = speed["scrub_ms"].as_array().unwrap();
        let longest = waits.iter().map(|wait| wait.as_f64().unwrap()).fold(0.0, f64::max);
        assert!(!measuring() || longest < 500.0, "{speed}");
    }
    shown.stop();

    let out = directory.path().join("report");
    let began = Instant::now();
    let reported = Command::new(env!("CARGO_BIN_EXE_squealcast"))
        .args(["report", session, "-o", out.to_str().unwrap()])
        .output()
        .unwrap();
    let took = began.elapsed();
    assert!(reported.status.success(), "{}", String::from_utf8_lossy(&reported.stderr));
    println!("reported in {took:?}");
    assert!(at_once(took), "reported in {took:?}");
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(
        html.contains(&format!("Squeal was predicted {squeals} times"))
            && html.contains("Stability maps at the worst moments")
    );
    for part in ["<script", "src=", "href=", "@import", "url("] {
        assert!(!html.contains(part), "it needs something else: {part}");
    }
    assert!(html.len() < 5_000_000, "{} bytes", html.len());
    let csv = std::fs::read_to_string(out.join("events.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + squeals);
}

#[test]
fn a_recording_of_faults_is_not_called_quiet() {
    let directory = tempfile::tempdir().unwrap();
    let (profile, recorded, out) =
        (directory.path().join("crushing.toml"), directory.path().join("recorded"), directory.path().join("report"));
    let point = |time_s: f64| {
        format!(
            "[[point]]\ntime_s = {time_s}\nnormal_load_n = 2e6\ndisc_speed_rad_s = 13\nfriction_coefficient = 0.2\n"
        )
    };
    std::fs::write(&profile, point(0.0) + &point(1.0)).unwrap();
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_squealcast")).args(arguments).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let [profile, recorded, out] = [&profile, &recorded, &out].map(|path| path.to_str().unwrap());
    let rate = ["--rate", "20", "--duration", "1"];
    run(&[&["simulate", "--rig", "nine-dof-case-2", "--profile", profile, "--record", recorded], &rate[..]].concat());
    let session = std::fs::read_dir(recorded).unwrap().next().unwrap().unwrap().path();
    run(&["report", session.to_str().unwrap(), "-o", out]);
    let html = std::fs::read_to_string(Path::new(out).join("report.html")).unwrap();
    assert!(html.contains("20 of 20 predictions are faults") && !html.contains("No squeal was predicted"));
    // Table and CSV file say why.
    let csv = std::fs::read_to_string(Path::new(out).join("events.csv")).unwrap();
    for text in [&html, &csv] {
        assert!(text.contains("normal_load_n is 2000000"), "{text}");
    }
}

/// A report shows the contact of a rig with a contact state where it squeals worst, or at the end, and of no other rig.
#[test]
fn a_report_shows_the_contact() {
    let directory = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_squealcast")).args(arguments).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let report = |rig: &str, mu: f64| {
        let [profile, recorded, out] =
            ["profile.toml", "recorded", "report"].map(|name| directory.path().join(format!("{rig}-{mu}-{name}")));
        let point = |time_s: f64, mu: f64| {
            format!(
                "[[point]]\ntime_s = {time_s}\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = {mu}\n"
            )
        };
        std::fs::write(&profile, point(0.0, 0.1) + &point(1.0, mu)).unwrap();
        let [profile, recorded, out] = [&profile, &recorded, &out].map(|path| path.to_str().unwrap());
        let rate = ["--rate", "20", "--duration", "1"];
        run(&[&["simulate", "--rig", rig, "--profile", profile, "--record", recorded], &rate[..]].concat());
        let session = std::fs::read_dir(recorded).unwrap().next().unwrap().unwrap().path();
        run(&["report", session.to_str().unwrap(), "-o", out]);
        std::fs::read_to_string(Path::new(out).join("report.html")).unwrap()
    };
    for mu in [0.12, 0.6] {
        let html = report("rough-pad", mu);
        let (_, contact) = html.split_once("<h2>Contact</h2>").expect("a section");
        let (contact, _) = contact.split_once("</section>").unwrap();
        assert!(contact.contains("7 of 7 pairs closed") && contact.contains(" N on the back of the pad."), "{contact}");
        assert!(contact.contains("contact pair") && contact.contains("force, N"), "axes");
        // A dot for each pair, and two in the legend.
        assert_eq!(contact.matches("<circle").count(), 9, "{contact}");
        assert_eq!(html.contains("No squeal was predicted"), mu == 0.12, "worth testing");
    }
    assert!(!report("nine-dof-case-2", 0.2).contains("<h2>Contact</h2>"));
}

#[test]
fn a_silent_connection_is_closed() {
    let shown = Shown::demo(&[]);
    let mut silent = TcpStream::connect(shown.address).unwrap();
    silent.set_read_timeout(Some(PATIENCE)).unwrap();
    assert_eq!(silent.read(&mut [0; 16]).expect("it is closed before this test has lost its patience"), 0);
    shown.stop();
}

/// Plateaus of the friction coefficient, 0.1 apart per second between them, no noise: of 0.33, 0.40 and 0.60 at 500 N and
/// 13 rad/s, each 4 s long and from 0.30 and back, of which `nine-dof-case-2` is unstable in the last two (its critical
/// value is 0.3559).
fn plateaus(directory: &Path) -> PathBuf {
    let mut text = String::new();
    let mut time_s = 0.0;
    let mut corner = |after_s: f64, mu: f64| {
        time_s += after_s;
        text += &format!(
            "[[point]]\ntime_s = {time_s:.3}\nnormal_load_n = 500\ndisc_speed_rad_s = 13\nfriction_coefficient = {mu}\n"
        );
    };
    corner(0.0, 0.30);
    for mu in [0.33, 0.40, 0.60] {
        corner(4.0, 0.30);
        corner((mu - 0.30) / 0.1, mu);
        corner(4.0, mu);
        corner((mu - 0.30) / 0.1, 0.30);
    }
    corner(4.0, 0.30);
    let path = directory.join("plateaus.toml");
    std::fs::write(&path, text).unwrap();
    path
}

/// The answer is known by construction: the rig squeals above a friction coefficient of our choice.
#[test]
fn a_report_lists_hits_misses_and_false_alarms() {
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_squealcast")).args(arguments).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let critical: serde_json::Value = serde_json::from_str(&run(&["critical", "nine-dof-case-2", "--json"])).unwrap();
    let (mu, hz) =
        (critical["critical_friction"].as_f64().unwrap(), critical["windows"][0]["frequency_hz"].as_f64().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let profile = plateaus(folder.path());
    // Above what the rig squeals, at what part of the predicted frequency; hits, misses and false alarms then, and after
    // how many seconds from the predicted onset: friction rises by 0.1 a second.
    let cases: [(f64, f64, [usize; 3], Option<f64>); 4] = [
        (0.45, 1.0, [1, 0, 1], Some((0.45 - mu) / 0.1)),
        (0.32, 1.0, [2, 1, 0], Some((0.32 - mu) / 0.1)),
        (0.45, 1.5, [0, 1, 2], None),
        (0.90, 1.0, [0, 0, 2], None),
    ];
    for (case, (above, share, expected, lead_s)) in cases.into_iter().enumerate() {
        let directory = folder.path().join(case.to_string());
        let vibration = format!("{above}:{}", share * hz);
        let recorded = ["--profile", profile.to_str().unwrap(), "--vibration", &vibration];
        run(&[&["simulate", "--rig", "nine-dof-case-2", "--record", directory.to_str().unwrap()], &recorded[..]]
            .concat());
        let session = std::fs::read_dir(&directory).unwrap().next().unwrap().unwrap().path();
        let session = session.to_str().unwrap();
        let out = directory.join("report");
        run(&["report", session, "-o", out.to_str().unwrap()]);
        let html = std::fs::read_to_string(out.join("report.html")).unwrap();
        let row = |name: &str| {
            let (_, rest) = html.split_once(&format!("<th scope=\"row\">{name}</th><td>")).unwrap();
            rest.split_once("</td>").unwrap().0.to_owned()
        };
        let counts: [usize; 3] =
            ["hits", "misses", "false alarms"].map(|name| row(name).split_once(':').unwrap().0.parse().unwrap());
        assert_eq!(counts, expected, "squeals above {above}, {share} of {hz} Hz");
        assert!(html.contains("of at least 70 dB") && html.contains("widened by 0.5 s") && html.contains("within 5 %"));
        if let Some(expected_s) = lead_s {
            // Measured every 0.05 s and predicted every 0.01 s; the prediction waits for a damping ratio of -0.001, which
            // a friction coefficient 1e-4 above the critical one has passed.
            let found_s: f64 = row("lead").split_once(' ').unwrap().0.parse().unwrap();
            assert!((found_s - expected_s).abs() < 0.07, "lead {found_s} s, by construction {expected_s} s");
        }
        // With a threshold above the tone there is no measured squeal.
        run(&["report", session, "-o", out.to_str().unwrap(), "--vibration-threshold", "120"]);
        let html = std::fs::read_to_string(out.join("report.html")).unwrap();
        assert!(
            html.contains("<td>0: measured squeals that were predicted") && html.contains("<td>2: predicted squeals")
        );
        // It is no input of the prediction.
        assert!(run(&["replay", session, "--verify"]).contains(" 0 different, 0 missing, 0 extra"));
    }
    let silent = folder.path().join("silent");
    run(&["simulate", "--rig", "nine-dof-case-2", "--duration", "1", "--record", silent.to_str().unwrap()]);
    let session = std::fs::read_dir(&silent).unwrap().next().unwrap().unwrap().path();
    run(&["report", session.to_str().unwrap(), "-o", silent.to_str().unwrap()]);
    let html = std::fs::read_to_string(silent.join("report.html")).unwrap();
    assert!(html.contains("holds no measured vibration"));
}

/// No page, one, twenty of which one never reads, and none again, in one run.
#[test]
fn pages_do_not_slow_the_node() {
    if !measures() {
        return;
    }
    let _alone = alone();
    const PHASE: Duration = Duration::from_secs(5);
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "1000", "--record", directory.path().to_str().unwrap()]);
    std::thread::sleep(Duration::from_secs(1));
    let wall_ns = || std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as u64;
    let stop = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let mut pages = vec![];
    let mut stalled = None;
    let mut phases = vec![];
    for count in [0, 1, 20] {
        while pages.len() + usize::from(stalled.is_some()) < count {
            let mut page = shown.listen();
            if count == 20 && stalled.is_none() {
                stalled = Some(page);
                continue;
            }
            let stop = stop.clone();
            pages.push(std::thread::spawn(move || {
                let mut buffer = vec![0; 1 << 16];
                while !stop.load(std::sync::atomic::Ordering::Relaxed) && page.read(&mut buffer).unwrap() > 0 {}
            }));
        }
        std::thread::sleep(Duration::from_millis(300));
        let from = wall_ns();
        std::thread::sleep(PHASE);
        phases.push((count, from, wall_ns()));
    }
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    pages.drain(..).for_each(|page| page.join().unwrap());
    drop(stalled);
    std::thread::sleep(Duration::from_millis(300));
    let from = wall_ns();
    std::thread::sleep(PHASE);
    phases.push((0, from, wall_ns()));
    shown.stop();

    // From hearing an input to publishing its prediction, as recorded.
    let session = std::fs::read_dir(directory.path()).unwrap().next().unwrap().unwrap().path();
    let mut received = HashMap::new();
    let mut latencies: Vec<Vec<f64>> = vec![vec![]; phases.len()];
    for entry in Recording::open(&session).unwrap().messages() {
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => drop(received.insert(input.seq, entry.log_time_ns)),
            Recorded::Known(Payload::Prediction(prediction)) => {
                let Some(&at) = received.get(&prediction.input_seq) else { continue };
                if let Some(phase) = phases.iter().position(|&(_, from, to)| (from..to).contains(&at)) {
                    latencies[phase].push(entry.log_time_ns.saturating_sub(at) as f64 * 1e-3);
                }
            }
            _ => {}
        }
    }
    let reason: Vec<(usize, f64, f64, f64)> = phases
        .iter()
        .zip(&mut latencies)
        .map(|((count, ..), latencies)| {
            latencies.sort_by(f64::total_cmp);
            let quantile = |q: f64| latencies[(q * (latencies.len() - 1) as f64) as usize];
            (*count, latencies.len() as f64 / PHASE.as_secs_f64(), quantile(0.5), quantile(0.99))
        })
        .collect();
    for (count, rate, median, p99) in &reason {
        println!("{count:>2} pages: {rate:.0} predictions/s, latency {median:.0} us median, {p99:.0} us p99");
    }
    for (count, rate, median, _) in &reason {
        // A machine busy with something else delays some inputs past the end of a phase.
        assert!((950.0..1050.0).contains(rate), "{count} pages: {rate} predictions/s");
        // Twice what it is without a page is more than any machine's noise and less than any wait for a page.
        assert!(*median < 2.0 * reason[0].2 + 100.0, "{count} pages: {median} us, without {} us", reason[0].2);
    }
}

/// Resident memory of a node at 1 kHz with three pages that read and one that does not, every minute for ten.
#[test]
fn memory_is_flat_with_pages_attached() {
    if !measures() {
        return;
    }
    let _alone = alone();
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "1000", "--vibration", "0.36:0.33"]);
    let _stalled = shown.listen();
    for _ in 0..3 {
        let mut page = shown.listen();
        // Until the node ends.
        std::thread::spawn(move || {
            let mut buffer = vec![0; 1 << 16];
            while page.read(&mut buffer).is_ok_and(|count| count > 0) {}
        });
    }
    let resident_kb = || -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", shown.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    };
    let mut minutes = vec![];
    for minute in 1..=10 {
        std::thread::sleep(Duration::from_secs(60));
        for path in ["/history.json", "/events.json", "/map.json?number=1"] {
            assert_eq!(shown.get(path).0, 200);
        }
        minutes.push(resident_kb());
        println!("{minute:>2} min: {:.1} MB resident", minutes[minutes.len() - 1] / 1024.0);
    }
    shown.stop();
    let (first, last) = (minutes[4], minutes[9]);
    assert!(last - first < 0.02 * first, "{first} kB after 5 minutes, {last} kB after 10");
}

/// Every path of the Foxglove layout names a topic and a field that there is.
#[test]
fn the_foxglove_layout_names_existing_topics_and_fields() {
    use squealcast::msgs::schema::Topic;
    let text = include_str!("../../launch/foxglove-layout.json");
    let layout: serde_json::Value = serde_json::from_str(text).unwrap();
    let panels = layout["configById"].as_object().unwrap();
    let paths: Vec<&str> = panels
        .values()
        .flat_map(|panel| {
            let plotted = panel["paths"].as_array().into_iter().flatten().filter_map(|path| path["value"].as_str());
            plotted.chain(panel["topicPath"].as_str()).collect::<Vec<_>>()
        })
        .collect();
    assert!(paths.len() > 8);
    for path in paths {
        let (topic, field) = path.split_once('.').unwrap();
        let topic = [Topic::OperatingPoint, Topic::Prediction, Topic::Vibration]
            .into_iter()
            .find(|known| known.name() == topic)
            .unwrap();
        let declared = |line: &str| line.split_whitespace().nth(1) == Some(field);
        assert!(topic.definition().lines().any(declared), "{path}");
    }
    for panel in panels.keys() {
        assert!(layout["layout"].to_string().contains(&format!("\"{panel}\"")), "{panel} has no place");
    }
}

/// The page shows the scores of `score` and the planted squeal in its spectrogram, with the predicted frequency over it.
#[test]
fn the_page_shows_the_sound_of_a_recording_with_predictions_over_it_and_their_score() {
    let _alone = alone();
    let simulated = simulated();
    let out = simulated.folder.path().join("out");
    let out = out.to_str().unwrap();
    let args = ["predict-log", &simulated.log, "--rig", "tribometer", "-o", out, "--sound", &simulated.sound];
    program::run(args.iter().chain(&["--unit", "Pa"])).exits(0);
    let shown = Shown::start(&["view", out]);
    let sound: serde_json::Value = serde_json::from_str(&shown.get("/sound.json").2).unwrap();
    let score = program::json(["score", out, "--json"]);
    for count in ["hits", "misses", "confirmed", "false_alarms", "recall", "precision", "mcc", "judged_s"] {
        assert_eq!(sound["scores"][0][count], score["rows"][0][count], "{count}");
    }
    assert_eq!(sound["channels"], serde_json::json!(["1"]));
    if browser_ready() {
        let planted = simulated.truth["squeals"].as_array().unwrap().iter();
        let planted = planted.filter(|squeal| squeal["frequency_hz"].as_f64().unwrap() > 1250.0).map(|squeal| {
            let middle_s = 0.5 * (squeal["onset_s"].as_f64().unwrap() + squeal["end_s"].as_f64().unwrap());
            // Relative times of a log count from 2000-01-01.
            serde_json::json!({ "hz": squeal["frequency_hz"], "time_s": 946_684_800.0 + middle_s })
        });
        let planted = serde_json::Value::from(planted.collect::<Vec<_>>()).to_string();
        let seen = browse("sound.mjs", &[&format!("http://{}/", shown.address), &planted]);
        let text = seen["scores"][0].as_str().unwrap();
        let hits = format!("{} hits, {} misses", score["rows"][0]["hits"], score["rows"][0]["misses"]);
        assert!(text.contains(&hits), "{text}");
    }
    shown.stop();
}
