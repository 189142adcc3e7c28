//! Rigs that follow the temperature of their contact: predictions, sweeps, maps, sessions.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::bus::{PATIENCE, wait_until};
use crate::program::{self, folder, json, run, text, write};
use squealcast::bus::{Bus, Received, Sink};
use squealcast::msgs::{Header, OperatingPoint, Prediction, SessionEventKind, Temperature, Time};
use squealcast::node::{Inlet, Node, Outputs, Watch};
use squealcast::offline::{self, Measured, Quantity};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};
use squealcast::recording::recorder::{Recorder, RecorderConfig};
use squealcast::rig::Rig;
use squealcast::session::settings::Settings;

/// The rig of the paper with soft, damped contact and falling friction, whose contact softens from 20 to 220 °C.
pub fn softening(folder: &Path) -> String {
    let nine = std::fs::read_to_string(program::launch("nine-dof-case-2.toml")).expect("the rig");
    let table = "\n[temperature]\nreference_c = 20.0\ncontact_stiffness = [[20.0, 1.0], [220.0, 0.5]]\n";
    write(folder, "softening.toml", &(nine + table))
}

/// The same rig with the stiffness of every contact pair multiplied by `factor` in the file, and no table.
fn softer(folder: &Path, factor: f64) -> String {
    let nine = std::fs::read_to_string(program::launch("nine-dof-case-2.toml")).expect("the rig");
    let scaled = nine.lines().map(|line| match line.split_once("stiffness_n_per_m = ") {
        Some((before, value)) => {
            let value: f64 = value.split('#').next().unwrap_or_default().trim().parse().expect("a stiffness");
            format!("{before}stiffness_n_per_m = {:e}", factor * value)
        }
        None => line.to_owned(),
    });
    write(folder, "softer.toml", &scaled.collect::<Vec<_>>().join("\n"))
}

/// The factor is a power of two, so both rigs hold the same bits.
#[test]
fn a_factor_is_the_same_as_another_stiffness_in_the_file() {
    let folder = folder();
    let (softening, softer) = (softening(folder.path()), softer(folder.path(), 0.5));
    for mu in ["0.1", "0.4", "0.9"] {
        let hot = json(["predict", &softening, "--temperature", "220", "--mu", mu, "--json"]);
        let written = json(["predict", &softer, "--mu", mu, "--json"]);
        assert_eq!(hot["modes"], written["modes"]);
        assert_eq!(hot["temperature_c"], 220.0);
        assert!(written.get("temperature_c").is_none());
        let cold = json(["predict", &softening, "--mu", mu, "--json"]);
        assert_eq!(cold["modes"], json(["predict", "nine-dof-case-2", "--mu", mu, "--json"])["modes"], "at 20 °C");
        assert_ne!(cold["modes"], hot["modes"]);
    }
    let critical = |args: &[&str]| json(args)["critical_friction"].as_f64();
    let hot = critical(&["critical", &softening, "--temperature", "220", "--json"]);
    assert_eq!(hot, critical(&["critical", &softer, "--json"]));
    assert_ne!(hot, critical(&["critical", &softening, "--json"]));
    run(["predict", &softening, "--temperature", "300"])
        .exits(0)
        .says("300 °C")
        .says("temperature beyond the tables of the rig: factors of their ends");
    run(["check", &softening]).exits(0).says("contact stiffness times 1 at 20 °C to 0.5 at 220 °C");
}

#[test]
fn sweeps_and_maps_go_over_the_temperature() {
    let folder = folder();
    let rig = softening(folder.path());
    let at = |name: &str| text(&folder.path().join(name));
    let (csv, svg) = (at("sweep.csv"), at("sweep.svg"));
    run(["sweep", &rig, "--temperature", "20:220:100", "--mu", "0.4", "--csv", &csv, "--svg", &svg]).exits(0);
    let rows = std::fs::read_to_string(&csv).expect("the table");
    let mut rows = rows.lines();
    assert_eq!(
        rows.next(),
        Some(
            "normal_load_n,disc_speed_rad_s,friction_coefficient,temperature_c,mode_id,frequency_hz,growth_rate_per_s,\
             damping_ratio"
        )
    );
    let rows: Vec<Vec<f64>> =
        rows.map(|row| row.split(',').map(|cell| cell.parse().expect("a number")).collect()).collect();
    for celsius in [20.0, 120.0, 220.0] {
        let swept: Vec<f64> = rows.iter().filter(|row| row[3] == celsius).map(|row| row[5]).collect();
        let at = celsius.to_string();
        let predicted = json(["predict", &rig, "--temperature", &at, "--mu", "0.4", "--json"]);
        let modes = predicted["modes"].as_array().expect("modes");
        assert_eq!(swept, modes.iter().map(|mode| mode["frequency_hz"].as_f64().expect("Hz")).collect::<Vec<_>>());
    }
    assert!(std::fs::read_to_string(&svg).expect("the figure").contains("temperature, °C"));

    // Along the temperature edges are found by bisection, along friction by a stability map: the same curve.
    let (map, edges) = (at("map.csv"), at("edges.csv"));
    for (y, x) in [("mu=0.2:0.6", "temperature=20:220"), ("load=400:600", "temperature=20:220")] {
        run([
            "map", &rig, "--x", x, "--y", y, "--mu", "0.4", "--points", "5x3", "--csv", &map, "--edges", &edges,
            "--quiet",
        ])
        .exits(0);
        let table = std::fs::read_to_string(&map).expect("the table");
        assert_eq!(table.lines().count(), 1 + 15, "{table}");
        assert!(table.starts_with("normal_load_n,disc_speed_rad_s,friction_coefficient,temperature_c,unstable_modes"));
        for edge in std::fs::read_to_string(&edges).expect("the edges").lines().skip(1) {
            let edge: Vec<&str> = edge.split(',').collect();
            let found = json(["critical", &rig, "--temperature", edge[3], "--load", edge[0], "--json"]);
            let mu: f64 = edge[2].parse().expect("a friction coefficient");
            let windows = found["windows"].as_array().expect("windows");
            let ends =
                windows.iter().flat_map(|window| [window["mu_from"].as_f64(), window["mu_to"].as_f64()]).flatten();
            let nearest = ends.map(|end| (end - mu).abs()).fold(f64::INFINITY, f64::min);
            assert!(nearest < 1e-5, "{edge:?} is {nearest} from the end of a window");
        }
    }
}

#[test]
fn a_temperature_of_a_rig_without_one_is_refused() {
    for args in [
        &["predict", "nine-dof", "--temperature", "20"][..],
        &["sweep", "nine-dof", "--temperature", "20:30:1"],
        &["map", "nine-dof", "--x", "temperature=20:30", "--points", "2x2"],
        &["critical", "nine-dof", "--temperature", "20"],
    ] {
        run(args).exits(1).complains("`temperature` is missing; expected the table [temperature]");
    }
    let folder = folder();
    let rig = softening(folder.path());
    run(["predict", &rig, "--temperature", "-300"]).exits(1).complains("-273.15 to 3000 °C");
    run(["sweep", &rig, "--temperature", "20:4000:100"]).exits(1).complains("-273.15 to 3000 °C");
}

// --- sessions --------------------------------------------------------------------------------------------------------

const START_NS: i64 = 1_704_067_200_000_000_000;

fn header(after_ms: i64) -> Header {
    Header { stamp: Time::from_ns(START_NS + after_ms * 1_000_000), frame_id: String::new() }
}

fn conditions(seq: u64, friction_coefficient: f64) -> OperatingPoint {
    let (normal_load_n, disc_speed_rad_s) = (500.0, 13.0);
    OperatingPoint { header: header(10 * seq as i64), seq, normal_load_n, disc_speed_rad_s, friction_coefficient }
}

fn temperature(after_ms: i64, celsius: f64) -> Temperature {
    Temperature { header: header(after_ms), temperature: celsius, variance: 0.0 }
}

/// The temperatures of the session events of a recording, and its predictions.
fn events_and_predictions(path: &Path) -> (Vec<f64>, Vec<Prediction>) {
    let (mut events, mut predictions) = (vec![], vec![]);
    for entry in Recording::open(path).expect("a recording").messages() {
        match entry.message {
            Recorded::Known(Payload::SessionEvent(event))
                if SessionEventKind::of(&event) == Some(SessionEventKind::Temperature) =>
            {
                events.push(event.value);
            }
            Recorded::Known(Payload::Prediction(prediction)) => predictions.push(prediction),
            _ => {}
        }
    }
    (events, predictions)
}

/// A brake that heats up by 10 K/s, offline: the rig follows in steps of the dead-band, and every prediction is the one that
/// `predict` makes at the temperature of the rig.
#[test]
fn an_offline_session_follows_the_temperature_and_replays_to_the_same_bits() {
    let folder = folder();
    let file = softening(folder.path());
    let rig = Arc::new(Rig::load(&file).expect("the rig"));
    let measured = (0..200u64).flat_map(|seq| {
        let hotter = (seq % 5 == 0).then(|| temperature(10 * seq as i64, 20.0 + 0.1 * seq as f64));
        let input = conditions(seq, 0.4 + 1e-4 * seq as f64);
        hotter.map(Quantity::Temperature).into_iter().chain([Quantity::Conditions(input)])
    });
    let measured: Vec<Measured> = measured.map(Measured::at_its_stamp).collect();
    let points = measured.iter().filter_map(|measured| match &measured.quantity {
        Quantity::Conditions(input) => Some(squealcast::session::conditions(input)),
        _ => None,
    });
    let out = folder.path().join("session");
    let predicted =
        offline::record(&rig, None, points, measured.iter().cloned(), None, &out).expect("recorded").directory;
    let (events, predictions) = events_and_predictions(&predicted);
    // Steps of 0.5 K: the first one that is more than 2 K away is 2.5 K away.
    assert_eq!(events.len(), 7, "{events:?}");
    for (k, celsius) in (1..).zip(&events) {
        assert!((celsius - 20.0 - 2.5 * f64::from(k)).abs() < 1e-9, "{events:?}");
    }
    assert_eq!(predictions.len(), 200);
    for (seq, of_rig) in [(0, 20.0), (24, 20.0), (25, events[0]), (49, events[0]), (199, events[6])] {
        let (mu, at) = ((0.4 + 1e-4 * seq as f64).to_string(), of_rig.to_string());
        let expected = json(["predict", &file, "--temperature", &at, "--mu", &mu, "--json"]);
        let expected: Vec<f64> = expected["modes"]
            .as_array()
            .expect("modes")
            .iter()
            .map(|m| m["frequency_hz"].as_f64().expect("Hz"))
            .collect();
        let found: Vec<f64> = predictions[seq].modes.iter().map(|mode| mode.frequency_hz).collect();
        assert_eq!(found, expected, "{seq}");
        assert!(predictions[seq].friction_margin.is_finite(), "the map of the rig was ready: {:?}", predictions[seq]);
    }
    run(["replay", "--verify", &text(&predicted)]).exits(0).says("200 predictions identical, 0 different");
    // Predicted again from the recording: the same events and predictions.
    let again = text(&folder.path().join("again"));
    run(["predict-log", &text(&predicted), "--rig", &file, "--output", &again]).exits(0);
    let again = std::fs::read_dir(&again).expect("the folder").next().expect("a session").expect("readable").path();
    let (events_again, predictions_again) = events_and_predictions(&again);
    assert_eq!(events_again, events);
    assert_eq!(format!("{predictions_again:?}"), format!("{predictions:?}"));
    // The other way round, a rig without the table takes no notice.
    run(["replay", "--verify", &text(&predicted), "--rig", "nine-dof-case-2"])
        .exits(1)
        .complains("cannot build the rig at 22.5 °C")
        .complains("`temperature` is missing");
}

/// A node on its own thread that records into files of a few messages each.
struct Live {
    inlet: Inlet,
    watch: Watch,
    node: std::thread::JoinHandle<Outputs>,
    recorder: Recorder,
    seq: u64,
}

impl Live {
    fn start(rig: &str, to: &Path, change: impl FnOnce(&mut Settings), charted: bool) -> Self {
        let rig = Arc::new(Rig::load(rig).expect("the rig"));
        let recorder = Recorder::start(RecorderConfig {
            rig_name: rig.name.clone(),
            rig_content_hash: rig.content_hash.clone(),
            rig_files: rig.files.clone(),
            split_bytes: 4_000,
            flush_interval: Duration::from_millis(10),
            ..RecorderConfig::new(to)
        })
        .expect("a recorder");
        let mut settings = Settings { silence_timeout_s: 1e6, ..Settings::for_rig(&rig) };
        change(&mut settings);
        let (watch, outputs) = (Watch::default(), Outputs { recorder: Some(recorder.handle()), ..Default::default() });
        let (node, inlet) = Node::new(rig, settings, watch.clone());
        let node = if charted { node.with_chart(None) } else { node };
        let node = std::thread::spawn(move || node.run(outputs));
        Self { inlet, watch, node, recorder, seq: 0 }
    }

    fn heat(&self, celsius: f64) {
        let measured = temperature(10 * self.seq as i64, celsius);
        self.inlet.temperature(Received::now(Bus::Shm, measured.clone()));
        // The copy that comes over the other bus is ignored.
        self.inlet.temperature(Received::now(Bus::Ros2, measured));
    }

    /// Sends an input and waits for its prediction.
    fn ask(&mut self) -> Prediction {
        let seq = self.seq;
        self.seq += 1;
        let friction_coefficient = 0.3 + 0.2 * ((seq % 50) as f64 / 50.0);
        self.inlet.operating_point(Received::now(Bus::Shm, conditions(seq, friction_coefficient)), false);
        let answered = || self.watch.snapshot().prediction.is_some_and(|prediction| prediction.input_seq == seq);
        wait_until("a prediction", answered);
        self.watch.snapshot().prediction.expect("one")
    }

    /// Asks until the rig has this temperature and its map.
    fn follows(&mut self, celsius: f64) {
        let began = std::time::Instant::now();
        loop {
            let prediction = self.ask();
            let seen = self.watch.snapshot();
            let of_rig = seen.rig.and_then(|rig| rig.temperature_c());
            if of_rig == Some(celsius) && prediction.friction_margin.is_finite() {
                return;
            }
            assert!(began.elapsed() < PATIENCE, "the rig is at {of_rig:?} °C, not at {celsius}");
        }
    }

    /// Asks until the recorder has begun another file.
    fn reaches_another_file(&mut self) {
        let files = |live: &Self| program::files_below(&live.recorder.status().directory).len();
        let (began, before) = (std::time::Instant::now(), files(self));
        while files(self) == before {
            assert!(began.elapsed() < PATIENCE, "no further file");
            self.ask();
        }
    }

    fn finish(self) -> std::path::PathBuf {
        self.inlet.stop();
        self.node.join().expect("it ended");
        self.recorder.finish(PATIENCE).expect("finished").directory
    }
}

#[test]
fn a_node_follows_the_temperature_and_its_recording_replays_to_the_same_bits_as_does_each_file() {
    let folder = folder();
    let rig = softening(folder.path());
    let mut live = Live::start(&rig, &folder.path().join("live"), |_| {}, true);
    let cold = loop {
        let prediction = live.ask();
        if prediction.friction_margin.is_finite() {
            break prediction;
        }
    };
    live.heat(21.9); // inside the dead-band
    for celsius in [60.0, 61.0, 150.0, 90.0, 20.5] {
        live.heat(celsius);
        if celsius != 61.0 {
            live.follows(celsius);
        }
        live.reaches_another_file();
    }
    live.heat(f64::NAN);
    live.heat(1e6);
    let last = live.ask();
    assert!((last.critical_friction - cold.critical_friction).abs() > 1e-4, "20.5 °C, within the dead-band of no rig");
    let recording = live.finish();
    let (mut events, predictions) = events_and_predictions(&recording);
    events.dedup(); // each file begins with the one in force
    assert_eq!(events, [60.0, 150.0, 90.0, 20.5]);
    let whole = run(["replay", "--verify", &text(&recording), "--no-chart-cache"]).exits(0);
    whole.says(&format!("{} predictions identical, 0 different, 0 missing, 0 extra", predictions.len()));
    // The last file may hold nothing but diagnostics.
    let predicts = |path: &std::path::PathBuf| {
        path.extension().is_some_and(|extension| extension == "mcap") && !events_and_predictions(path).1.is_empty()
    };
    let files: Vec<_> = program::files_below(&recording).into_iter().filter(predicts).collect();
    assert!(files.len() > 2, "{files:?}");
    let (begins_with, _) = events_and_predictions(&files[files.len() - 1]);
    assert!(begins_with.first().is_some_and(|celsius| events.contains(celsius)), "the one in force: {begins_with:?}");
    for file in files {
        run(["replay", "--verify", &text(&file), "--no-chart-cache"]).exits(0).says(" 0 different, 0 missing, 0 extra");
    }
    let out = folder.path().join("report");
    run(["report", &text(&recording), "-o", &text(&out)]).exits(0);
    let html = std::fs::read_to_string(out.join("report.html")).expect("the report");
    assert!(html.contains("rig at another temperature") && html.contains("150 °C"));
}

/// A temperature that is no longer measured is kept, and status and diagnostics say that it is stale.
#[test]
fn a_stale_temperature_is_said() {
    let folder = folder();
    let rig = softening(folder.path());
    let change = |settings: &mut Settings| settings.temperature_timeout_s = 0.1;
    let mut live = Live::start(&rig, folder.path(), change, false);
    live.ask();
    assert!(!live.watch.snapshot().assessment().message.contains("temperature"), "none was ever received");
    live.heat(50.0);
    live.follows(50.0);
    let said = |live: &Live| live.watch.snapshot().assessment().message.contains("the temperature is stale");
    wait_until("staleness", || said(&live));
    live.ask();
    assert!(said(&live) && live.watch.snapshot().rig.expect("one").temperature_c() == Some(50.0), "it is kept");
    live.inlet.send(squealcast::node::Incoming::Parameter { name: "temperature_timeout_s".to_owned(), value: 1e6 });
    wait_until("a longer timeout", || !said(&live));
    live.inlet.send(squealcast::node::Incoming::Parameter { name: "temperature_timeout_s".to_owned(), value: 0.1 });
    // Diagnostics come every second.
    std::thread::sleep(Duration::from_millis(1500));
    let recording = live.finish();
    let warned = Recording::open(&recording).expect("a recording").messages().any(|entry| match entry.message {
        Recorded::Known(Payload::Diagnostics(array)) => {
            array.status.iter().any(|status| status.message.contains("temperature stale: the last one, 50 °C, is"))
        }
        _ => false,
    });
    assert!(warned);
    run(["replay", "--verify", &text(&recording)]).exits(0);
}

/// A log with a temperature, predicted directly and as an imported recording: the same predictions, at its temperatures.
#[test]
fn a_log_with_a_temperature_is_predicted_at_it() {
    let folder = folder();
    let rig = softening(folder.path());
    let lines = (0..60).map(|k| {
        let celsius = if k % 4 == 0 { (20.0 + f64::from(k)).to_string() } else { String::new() };
        format!("{},500,13,{},{celsius}\n", 0.01 * f64::from(k), 0.3 + 0.002 * f64::from(k))
    });
    let head = "time_s,normal_load_n,disc_speed_rad_s,friction_coefficient,temperature_c\n".to_owned();
    let log = write(folder.path(), "stop.csv", &(head + &lines.collect::<String>()));
    let imported = text(&folder.path().join("stop.mcap"));
    run(["import", &log, "--output", &imported]).exits(0).complains("60 operating points").complains("15 temperatures");
    let predicted = |from: &str, to: &str| {
        let out = folder.path().join(to);
        run(["predict-log", from, "--rig", &rig, "--output", &text(&out)]).exits(0);
        std::fs::read_dir(&out).expect("the folder").next().expect("a session").expect("readable").path()
    };
    let (direct, indirect) = (predicted(&log, "direct"), predicted(&imported, "indirect"));
    let (events, predictions) = events_and_predictions(&direct);
    assert_eq!(events, (1..15).map(|k| 20.0 + 4.0 * f64::from(k)).collect::<Vec<_>>());
    assert_eq!(format!("{:?}", (&events, &predictions)), format!("{:?}", events_and_predictions(&indirect)));
    let at = json(["predict", &rig, "--temperature", "76", "--mu", &(0.3 + 0.002 * 59.0).to_string(), "--json"]);
    let expected = at["modes"].as_array().expect("modes").iter().map(|mode| mode["frequency_hz"].as_f64().expect("Hz"));
    assert!(predictions[59].modes.iter().map(|mode| mode.frequency_hz).eq(expected));
    run(["replay", "--verify", &text(&direct)]).exits(0).says("60 predictions identical, 0 different");
}
