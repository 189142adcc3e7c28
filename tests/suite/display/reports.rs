//! Reports and views of recordings, and the layout for Foxglove.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use super::{Shown, alone, browse, browser_ready, measures};
use crate::program::measuring;

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

/// Several recordings have a page each, below a number, and are read when they are looked at.
#[test]
fn several_recordings_have_a_page_each() {
    let _alone = alone();
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let rigs = ["nine-dof", "nine-dof-case-2", "nine-dof-3+2", "nine-dof-case-2"];
    for (k, rig) in rigs.iter().enumerate() {
        let simulated = Command::new(env!("CARGO_BIN_EXE_squealcast"))
            .args(["simulate", "--rate", "20", "--duration", "2", "--rig", rig, "--record"])
            .arg(at("made"))
            .output()
            .unwrap();
        assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
        let made = std::fs::read_dir(at("made")).unwrap().next().unwrap().unwrap().path();
        std::fs::rename(made, at(&format!("session-{}", k + 1))).unwrap();
    }
    std::fs::remove_dir(at("made")).unwrap();
    std::fs::create_dir(at("session-9")).unwrap();
    std::fs::write(at("session-9").join("part_0.mcap"), b"\x89MCAP0\r\n").unwrap();

    let shown = Shown::start(&["view", directory.path().to_str().unwrap()]);
    let (status, head, _) = shown.get("/");
    assert!(status == 307 && head.contains("location: /5/"), "{status} {head}");
    let json = |path: &str| -> serde_json::Value { serde_json::from_str(&shown.get(path).2).unwrap() };
    let names = ["session-1", "session-2", "session-3", "session-4", "session-9"];
    assert_eq!(json("/2/recordings.json"), serde_json::json!({ "names": names, "number": 2 }));
    // More than are kept in memory, and back.
    for number in [1, 2, 3, 4, 1] {
        assert_eq!(json(&format!("/{number}/about.json"))["rig"], rigs[number - 1]);
        assert_eq!(json(&format!("/{number}/state.json"))["seq"], 0);
    }
    for none in ["/0/about.json", "/6/about.json", "/x/about.json", "/about.json"] {
        assert_eq!(shown.get(none).0, 404, "{none}");
    }
    let (status, _, reason) = shown.get("/5/about.json");
    assert!(status == 404 && reason.contains("session-9"), "{status} {reason}");
    if browser_ready() {
        let names = serde_json::json!(names).to_string();
        let seen = browse("recordings.mjs", &[&format!("http://{}/", shown.address), &names]);
        assert_eq!(seen["rigs"], serde_json::json!(rigs));
    }
    shown.stop();
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

/// Every path of the Foxglove layout names a topic and a field that there is.
#[test]
fn the_foxglove_layout_names_existing_topics_and_fields() {
    use squealcast::msgs::schema::Topic;
    let text = include_str!("../../../launch/foxglove-layout.json");
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
