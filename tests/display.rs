//! The display against a real `demo`: over plain sockets, and in Debian's Chromium where it and Node.js are there.
//!
//! `tests/browser/setup.sh` puts in place what the browser tests need. Without it they are skipped and say so; with
//! `SQUEALCAST_BROWSER_TESTS=required` that is a failure.
#![cfg(feature = "node")]

use std::collections::HashMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use squealcast::io::message::Payload;
use squealcast::io::recording::{Recorded, Recording};
use squealcast::wire::{OperatingPoint, Prediction};

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
        Self::start(&[&["demo", "--plain", "--no-shm", "--no-ros", "--duration", "300"], more].concat())
    }

    fn stop(mut self) {
        interrupt(&self.child);
        let asked = Instant::now();
        while self.child.try_wait().unwrap().is_none() {
            assert!(asked.elapsed() < Duration::from_secs(5), "it does not end");
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
        stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
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
fn a_state_comes_at_most_thirty_times_a_second_whatever_the_input_rate() {
    let _alone = alone();
    let shown = Shown::demo(&["--rate", "2000"]);
    let mut lines = BufReader::new(shown.listen()).lines();
    let mut states = lines.by_ref().map_while(Result::ok).filter(|line| line.starts_with("data: "));
    let first = states.next().unwrap();
    let began = Instant::now();
    let mut count = 0;
    let mut last: serde_json::Value = serde_json::from_str(&first[6..]).unwrap();
    while began.elapsed() < Duration::from_secs(3) {
        let next: serde_json::Value = serde_json::from_str(&states.next().unwrap()[6..]).unwrap();
        assert!(next["seq"].as_u64() >= last["seq"].as_u64());
        last = next;
        count += 1;
    }
    let rate = f64::from(count) / began.elapsed().as_secs_f64();
    assert!((10.0..31.0).contains(&rate), "{rate} states a second");
    assert!(last["rate_hz"].as_f64().unwrap() > 1000.0, "{last}");
    shown.stop();
}

#[test]
fn a_port_that_is_taken_is_said_and_the_node_goes_on() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let output = Command::new(env!("CARGO_BIN_EXE_squealcast"))
        .args(["demo", "--plain", "--no-shm", "--no-ros", "--duration", "0.5", "--display", &address])
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains(&format!("warning: no display on {address}")), "{told}");
    assert!(output.status.success(), "{told}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("seq"));
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
        let told = format!("no {}: tests/browser/setup.sh installs it", missing.join(", no "));
        assert!(std::env::var_os("SQUEALCAST_BROWSER_TESTS").is_none_or(|value| value != "required"), "{told}");
        eprintln!("SKIPPED: {told}");
    }
    missing.is_empty()
}

fn browser_tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser")
}

/// What a browser test printed.
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
        let numbers = &moment["numbers"];
        for (name, value) in [
            ("margin", prediction.friction_margin),
            ("critical", prediction.critical_friction),
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
        let modes = moment["modes"].as_array().unwrap();
        assert_eq!(modes.len(), prediction.modes.len());
        for mode in modes {
            let known =
                prediction.modes.iter().find(|known| u64::from(known.id) == mode["id"].as_u64().unwrap()).unwrap();
            let values = [
                known.frequency_hz,
                known.growth_rate_per_s,
                known.damping_ratio,
                known.frequency_error_hz,
                known.pad_participation,
            ];
            for (shown, value) in mode["values"].as_array().unwrap().iter().zip(values) {
                // What is not known, such as the pad's share where a chart does not tell it, is shown as nothing.
                let exact = shown.as_str().unwrap().parse().ok();
                assert_eq!(exact, value.is_finite().then_some(value), "mode {} of input {seq}", known.id);
            }
        }
    }
    let squealed = |moment: &&serde_json::Value| {
        let seq: u64 = moment["seq"].as_str().unwrap().parse().unwrap();
        published[&seq].1.level == squealcast::wire::level::SQUEAL
    };
    assert!(moments.iter().any(|moment| squealed(&moment)) && !moments.iter().all(|moment| squealed(&moment)));
    println!("first paint {} ms, page work {} of a core", seen["first_paint_ms"], seen["work"]);
    eprintln!("the page takes {} of a core", seen["work"]);
    assert!(seen["csv"].as_str().unwrap().contains(",SQUEAL,"));
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
    use npyz::WriterBuilder;
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
    let mut archive = npyz::npz::NpzWriter::create(directory.join("pad.npz")).unwrap();
    let arrays: [(&str, &[u64], &[f64]); 3] =
        [("omega_rad_s", &[2], &[600.0, 600.0]), ("phi", &[26, 3, 2], &phi), ("nodes_m", &[26, 3], &nodes_m)];
    for (name, shape, values) in arrays {
        let array = archive.array(name, Default::default()).unwrap();
        let mut writer = array.default_dtype().shape(shape).begin_nd().unwrap();
        writer.extend(values.iter().copied()).unwrap();
        writer.finish().unwrap();
    }
    drop(archive);
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
    let asked = std::env::var_os("SQUEALCAST_MEASURE").is_some();
    if !asked {
        eprintln!("skipped: it measures times; SQUEALCAST_MEASURE=1 runs it");
    }
    asked
}

/// Ten minutes at 1 kHz.
#[test]
fn a_long_recording_opens_at_once_and_is_reported() {
    if !measures() {
        return;
    }
    let _alone = alone();
    let directory = tempfile::tempdir().unwrap();
    let simulated = Command::new(env!("CARGO_BIN_EXE_squealcast"))
        .args(["simulate", "--rig", "nine-dof-case-2", "--rate", "1000", "--duration", "600", "--record"])
        .arg(directory.path())
        .output()
        .unwrap();
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    let session = std::fs::read_dir(directory.path()).unwrap().next().unwrap().unwrap().path();
    let session = session.to_str().unwrap();

    let began = Instant::now();
    let shown = Shown::start(&["view", session]);
    let took = began.elapsed();
    assert!(took < Duration::from_secs(3), "opened in {took:?}");
    let about: serde_json::Value = serde_json::from_str(&shown.get("/about.json").2).unwrap();
    let span: Vec<f64> = about["span_s"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert!((span[1] - span[0] - 600.0).abs() < 0.5, "{span:?}");
    // The paper's profile passes the critical value three times a round of 30 s.
    let events: serde_json::Value = serde_json::from_str(&shown.get("/events.json").2).unwrap();
    assert_eq!(events.as_array().unwrap().len(), 60);
    if browser_ready() {
        let speed = browse("view.mjs", &[&format!("http://{}/", shown.address)]);
        assert!(speed["opened_ms"].as_f64().unwrap() < 3000.0, "{speed}");
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
    assert!(took < Duration::from_secs(3), "reported in {took:?}");
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(html.contains("Squeal was predicted 60 times") && html.contains("Stability maps at the worst moments"));
    for part in ["<script", "src=", "href=", "@import", "url("] {
        assert!(!html.contains(part), "it needs something else: {part}");
    }
    assert!(html.len() < 5_000_000, "{} bytes", html.len());
    let csv = std::fs::read_to_string(out.join("events.csv")).unwrap();
    assert_eq!(csv.lines().count(), 61);
}

/// Nobody, one, twenty pages of which one never reads, and nobody again, in one run.
#[test]
fn pages_do_not_slow_the_node() {
    if !measures() {
        return;
    }
    let _alone = alone();
    const PHASE: Duration = Duration::from_secs(5);
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&["--rate", "1000", "--record", directory.path().to_str().unwrap()]);
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
    let mut heard = HashMap::new();
    let mut latencies: Vec<Vec<f64>> = vec![vec![]; phases.len()];
    for entry in Recording::open(&session).unwrap().messages() {
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => drop(heard.insert(input.seq, entry.log_time_ns)),
            Recorded::Known(Payload::Prediction(prediction)) => {
                let Some(&at) = heard.get(&prediction.input_seq) else { continue };
                if let Some(phase) = phases.iter().position(|&(_, from, to)| (from..to).contains(&at)) {
                    latencies[phase].push(entry.log_time_ns.saturating_sub(at) as f64 * 1e-3);
                }
            }
            _ => {}
        }
    }
    let told: Vec<(usize, f64, f64, f64)> = phases
        .iter()
        .zip(&mut latencies)
        .map(|((count, ..), latencies)| {
            latencies.sort_by(f64::total_cmp);
            let quantile = |q: f64| latencies[(q * (latencies.len() - 1) as f64) as usize];
            (*count, latencies.len() as f64 / PHASE.as_secs_f64(), quantile(0.5), quantile(0.99))
        })
        .collect();
    for (count, rate, median, p99) in &told {
        println!("{count:>2} pages: {rate:.0} predictions/s, latency {median:.0} us median, {p99:.0} us p99");
    }
    for (count, rate, median, _) in &told {
        // A machine busy with something else delays some inputs past the end of a phase.
        assert!((950.0..1050.0).contains(rate), "{count} pages: {rate} predictions/s");
        // Twice what it is without a page is more than any machine's noise and less than any wait for a page.
        assert!(*median < 2.0 * told[0].2 + 100.0, "{count} pages: {median} us, without {} us", told[0].2);
    }
}

/// Every path of the Foxglove layout names a topic and a field that there is.
#[test]
fn the_foxglove_layout_names_what_there_is() {
    use squealcast::wire::schema::Topic;
    let text = include_str!("../launch/foxglove-layout.json");
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
        let topic = [Topic::OperatingPoint, Topic::Prediction].into_iter().find(|known| known.name() == topic).unwrap();
        let declared = |line: &str| line.split_whitespace().nth(1) == Some(field);
        assert!(topic.definition().lines().any(declared), "{path}");
    }
    for panel in panels.keys() {
        assert!(layout["layout"].to_string().contains(&format!("\"{panel}\"")), "{panel} has no place");
    }
}
