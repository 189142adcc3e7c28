//! Sessions of the real binary: simulated, run, recorded, replayed, verified, recovered, imported.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::program::{Running, command, files_below, folder, launch, promised, run, text, until, write};
use squealcast::msgs::SessionEventKind;
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};
use tempfile::TempDir;

// --- recordings ------------------------------------------------------------------------------------------------------

/// The one `.mcap` file below a directory.
fn mcap(directory: &Path) -> PathBuf {
    let found: Vec<PathBuf> =
        files_below(directory).into_iter().filter(|path| path.extension().is_some_and(|e| e == "mcap")).collect();
    assert_eq!(found.len(), 1, "{found:?}");
    found.into_iter().next().expect("one")
}

/// Records `duration` seconds of the paper's test in no time; the folder and its file.
fn recorded(rig: &str, duration: &str) -> (TempDir, PathBuf) {
    let folder = folder();
    let directory = text(folder.path());
    run(["simulate", "--record", &directory, "--rig", rig, "--duration", duration]).exits(0);
    let file = mcap(folder.path());
    (folder, file)
}

#[test]
fn a_recording_verifies_and_another_rig_differs() {
    let (folder, file) = recorded("nine-dof-case-2", "25");
    let verified = run(["replay", "--verify", &text(&file)]).exits(0);
    // 25 s at 100 Hz, each input answered.
    verified.says("2500 inputs, 2500 of them predicted; 2500 predictions identical, 0 different, 0 missing, 0 extra");
    // The directory of the recording does as well, and naming the rig that was recorded changes nothing.
    let directory = text(file.parent().expect("its directory"));
    run(["replay", "--verify", &directory, "--rig", "nine-dof-case-2"]).exits(0).says("2500 predictions identical");

    let other = run(["replay", "--verify", &text(&file), "--rig", "nine-dof"]).exits(3);
    let other = other
        .says("0 predictions identical, 2500 different, 0 missing, 0 extra")
        .says("stability maps or charts differ");
    // The largest differences are reported: case 1 against case 2, 1 against 0.7071 rad/s of their first modes alone.
    let sensitivity =
        other.stdout.split("frequency ").nth(1).expect("largest differences").split(' ').next().expect("a number");
    assert!(sensitivity.parse::<f64>().expect("a number") > 0.3, "{sensitivity}");
    other.says("seq 0: recorded");
    drop(folder);
}

/// A rig whose contact stiffens with load, its load on the way: the ends of its windows are carried along, and a replay
/// carries them along the same.
#[test]
fn a_moving_load_carries_the_windows_along() {
    let folder = folder();
    let rig = std::fs::read_to_string(launch("nine-dof-case-2.toml")).expect("an embedded rig");
    let rig = write(folder.path(), "stiffening.toml", &format!("{rig}\n[load]\nexponent = 0.4\n"));
    let profile = "[[point]]\ntime_s = 0.0\nnormal_load_n = 500.0\ndisc_speed_rad_s = 13.0\nfriction_coefficient = 0.3\n\
                   [[point]]\ntime_s = 2.0\nnormal_load_n = 510.0\ndisc_speed_rad_s = 13.0\nfriction_coefficient = 0.3\n";
    let profile = write(folder.path(), "rising.toml", profile);
    let out = text(folder.path());
    run(["simulate", "--profile", &profile, "--rig", &rig, "--rate", "50", "--duration", "2", "--record", &out])
        .exits(0);
    let file = mcap(folder.path());
    let events = |kind: SessionEventKind| {
        let recording = Recording::open(&file).expect("a recording");
        let of_kind = recording.messages().filter(|entry| match &entry.message {
            Recorded::Known(Payload::SessionEvent(event)) => event.kind == kind.number(),
            _ => false,
        });
        of_kind.count()
    };
    assert!(events(SessionEventKind::StabilityMap) >= 2 && events(SessionEventKind::WindowEnds) >= 5);
    run(["replay", "--verify", &text(&file)]).exits(0).says("0 different, 0 missing, 0 extra");
}

#[test]
fn the_same_command_records_the_same_predictions() {
    let messages = |path: &Path| -> Vec<Vec<u8>> {
        Recording::open(path).expect("a recording").messages().map(|entry| entry.cdr.to_vec()).collect()
    };
    let ((_a, first), (_b, second)) = (recorded("nine-dof-4+2", "2"), recorded("nine-dof-4+2", "2"));
    let (first, second) = (messages(&first), messages(&second));
    // 200 inputs and predictions, the rig, ten settings, one map.
    assert_eq!(first.len(), 200 + 200 + 1 + 10 + 1);
    assert!(first == second, "recorded bytes differ");
}

#[test]
fn a_truncated_recording_is_reported_and_recovered() {
    let (_folder, file) = recorded("nine-dof-case-2", "10");
    let bytes = std::fs::read(&file).expect("the recording");
    let elsewhere = folder();
    let cut = elsewhere.path().join("cut_0.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() * 2 / 3]).expect("a file");

    // Readable messages verify, but the loss is reported and the exit code is not 0.
    let verified = run(["replay", "--verify", &text(&cut)]).exits(3).complains("damaged").complains("cut_0.mcap");
    let identical: u64 = verified
        .stdout
        .split(';')
        .nth(1)
        .and_then(|s| s.trim().split(' ').next())
        .expect("a count")
        .parse()
        .expect("a number");
    assert!(identical > 0 && identical < 1000, "{}", verified.stdout);
    verified.says("0 different");

    let recovered = run(["recover", &text(&cut)]).exits(3).says("restored").says("cut_0.mcap");
    assert!(recovered.stdout.contains("kept as"), "{}", recovered.stdout);
    // The restored messages form a valid recording.
    let verified = run(["replay", "--verify", &text(&cut)]).exits(0);
    assert_eq!(verified.stderr, "");
    verified.says(&format!("{identical} predictions identical, 0 different"));
    run(["recover", &text(&cut)]).exits(0).says("complete");
    // An untouched one needs nothing.
    run(["recover", &text(&file)]).exits(0).says("complete");
    assert_eq!(std::fs::read(&file).expect("the recording"), bytes);
}

#[test]
fn a_log_with_decimal_commas_becomes_a_recording() {
    let folder = folder();
    let log = "Zeit [s];Normalkraft [kN];Drehzahl [1/min];Reibwert [-]\n\
               0,000;0,5;120;0,35\n0,010;0,4995;121,5;0,3525\n1,25;0,25;-60;1,0\n";
    let (log, out) = (write(folder.path(), "log.csv", log), text(&folder.path().join("log.mcap")));
    run(["import", &log, "-o", &out]).exits(0).complains("3 operating points");
    let recording = Recording::open(Path::new(&out)).expect("a recording");
    assert_eq!(recording.damage(), []);
    let points: Vec<_> = recording
        .messages()
        .filter_map(|entry| match entry.message {
            Recorded::Known(Payload::OperatingPoint(point)) => Some(point),
            _ => None,
        })
        .collect();
    // 1 kN = 1000 N; 120 turns a minute = 4π rad/s; a relative time counts from where the log begins.
    let expected = [(0, 500.0, 2.0 * TAU, 0.35), (10, 499.5, 2.025 * TAU, 0.3525), (1250, 250.0, -TAU, 1.0)];
    assert_eq!(points.len(), expected.len());
    let start = points[0].header.stamp.as_ns();
    for (seq, (point, (ms, load, speed, mu))) in points.iter().zip(expected).enumerate() {
        assert_eq!((point.seq, point.header.stamp.as_ns() - start), (seq as u64, ms * 1_000_000));
        // One multiplication by the unit's factor each, itself rounded once or twice.
        assert!((point.normal_load_n - load).abs() <= 1e-12 && (point.disc_speed_rad_s - speed).abs() <= 1e-14 * 16.0);
        assert_eq!(point.friction_coefficient, mu);
    }
    // It holds conditions, no predictions: nothing to verify. And it is not replaced unasked.
    run(["replay", "--verify", &out, "--rig", "nine-dof"]).exits(1).complains("no predictions");
    run(["import", &log, "-o", &out]).exits(1).complains("log.mcap");
    run(["import", &log, "-o", &out, "--overwrite"]).exits(0);

    let bad =
        write(folder.path(), "bad.csv", "time_s;load_N;speed_rad_s;mu\n0;500;13;0,3\n1;five;13;0,3\n2;500;13;0,3\n");
    let out = text(&folder.path().join("bad.mcap"));
    run(["import", &bad, "-o", &out]).exits(1).complains("bad.csv").complains("line 3").complains("five");
    assert!(!Path::new(&out).exists(), "nothing is left of an import that failed");
    run(["import", &bad, "-o", &out, "--skip-bad-lines"]).exits(3).complains("1 line left out").complains("five");
    assert_eq!(Recording::open(Path::new(&out)).expect("a recording").messages().count(), 2);
}

// --- the node --------------------------------------------------------------------------------------------------------

/// A prefix of shared-memory services that no other test, and no other run of the tests, uses.
fn prefix(name: &str) -> String {
    format!("test-{name}-{}/", std::process::id())
}

/// Bytes below a directory: a recording that grows has something in it.
fn size(directory: &Path) -> u64 {
    files_below(directory).iter().filter_map(|path| path.metadata().ok()).map(|file| file.len()).sum()
}

/// A finished recording: no file left in writing, and every prediction comes out the same, off a chart that is not the one the
/// node kept.
fn check_finished(directory: &Path) {
    let names: Vec<String> = files_below(directory).iter().map(|path| text(path)).collect();
    assert!(!names.iter().any(|name| name.ends_with(".active")), "{names:?}");
    let verified = run(["replay", "--verify", "--no-chart-cache", &text(directory)]).exits(0);
    verified.says("0 different, 0 missing, 0 extra");
}

#[test]
fn signals_end_the_demo_with_a_finished_recording() {
    let folder = folder();
    let prefix = prefix("demo");
    // A rig of small files, so that most of the recording are predictions.
    let args = ["demo", "nine-dof-case-2", "--no-ros", "--shm-prefix", &prefix, "--record", &text(folder.path())];
    let mut sessions: Vec<PathBuf> = vec![];
    for signal in ["INT", "TERM"] {
        let running = Running::start(command(args));
        let before = size(folder.path());
        // Flushed every 0.5 s: something was predicted and written.
        until("the recording to grow", || size(folder.path()) > before + 20_000);
        let ended = running.signal(signal).exits(0).complains("recording into").complains("recorded ").says("seq ");
        assert!(!ended.stderr.contains("not recorded"), "{}", ended.stderr);
        // A second start in the same directory makes a separate recording.
        let mut now: Vec<PathBuf> = std::fs::read_dir(folder.path())
            .expect("the folder")
            .map(|entry| entry.expect("an entry").path())
            .collect();
        now.retain(|path| !sessions.contains(path));
        assert_eq!(now.len(), 1, "one directory for each session: {now:?}");
        check_finished(&now[0]);
        sessions.append(&mut now);
    }
}

/// The first sensitivities in a session, finished or not, that know the nearest end of a window.
fn sensitivity_with_an_end(session: &Path) -> Option<squealcast::msgs::Sensitivity> {
    let recording = Recording::open(session).ok()?;
    recording.messages().find_map(|entry| match entry.message {
        Recorded::Known(Payload::Sensitivity(sensitivity)) if !sensitivity.nearest_window_end.is_nan() => {
            Some(sensitivity)
        }
        _ => None,
    })
}

/// The session that was begun last.
fn newest(directory: &Path) -> PathBuf {
    let entries = std::fs::read_dir(directory).expect("the folder").map(|entry| entry.expect("an entry").path());
    entries.max_by_key(|path| std::fs::metadata(path).and_then(|data| data.modified()).expect("times")).expect("one")
}

#[test]
fn a_node_predicts_inputs_of_shared_memory_until_it_is_stopped() {
    let folder = folder();
    let (prefix, profile) = (
        prefix("run"),
        "[[point]]\ntime_s = 0.0\nnormal_load_n = 500.0\ndisc_speed_rad_s = 13.0\nfriction_coefficient = 0.5\n",
    );
    let profile = write(folder.path(), "steady.toml", profile);
    let directory = folder.path().join("recordings");
    let bus = ["--no-ros", "--shm-prefix", &prefix];
    for signal in ["TERM", "INT"] {
        let node = ["run", "nine-dof", "--record", &text(&directory)];
        let node = Running::start(command(node.iter().copied().chain(bus)));
        let source = ["simulate", "--rate", "200", "--profile", &profile];
        let source = Running::start(command(source.iter().copied().chain(bus)));
        let before = if directory.exists() { size(&directory) } else { 0 };
        until("the recording to grow", || directory.exists() && size(&directory) > before + 20_000);
        // The first sensitivities may come before the map that knows where windows end; they are published again every second.
        until("sensitivities with an end of a window", || sensitivity_with_an_end(&newest(&directory)).is_some());
        source.signal(signal).exits(0);
        node.signal(signal).exits(0).says("OK");
    }
    let sessions: Vec<PathBuf> =
        std::fs::read_dir(&directory).expect("the folder").map(|entry| entry.expect("an entry").path()).collect();
    assert_eq!(sessions.len(), 2, "{sessions:?}");
    for session in sessions {
        check_finished(&session);
        let recording = Recording::open(&session).expect("a recording");
        // The rig was charted while it ran, and sensitivities were published.
        let kinds: Vec<SessionEventKind> = recording
            .messages()
            .filter_map(|entry| match entry.message {
                Recorded::Known(Payload::SessionEvent(event)) => SessionEventKind::of(&event),
                _ => None,
            })
            .collect();
        for kind in [SessionEventKind::Chart, SessionEventKind::StabilityMap] {
            assert!(kinds.contains(&kind), "{kinds:?}");
        }
        let sensitivity = sensitivity_with_an_end(&session).expect("it was waited for");
        assert!((sensitivity.nearest_window_end - 0.82001495938185).abs() < 1e-10, "{sensitivity:?}");
        assert_eq!((sensitivity.modes.len(), sensitivity.nearest_window_end_derivatives.by_normal_load_n), (9, 0.0));
        let predictions = recording.messages().filter_map(|entry| match entry.message {
            Recorded::Known(Payload::Prediction(prediction)) if prediction.level != 3 => Some(prediction),
            _ => None,
        });
        // Case 1 is stable at 0.5; once the map is there the margin is that to 0.82001495938185.
        let last = predictions.last().expect("predictions");
        assert_eq!((last.level, last.unstable_modes, last.modes.len()), (0, 0, 9));
        assert!((last.friction_margin - 0.32001495938185).abs() < 1e-10, "{}", last.friction_margin);
    }
}

#[test]
fn nothing_starts_with_a_rig_that_cannot_be_read() {
    let folder = folder();
    let directory = text(&folder.path().join("recordings"));
    for rig in ["no-such-rig", "/nowhere/rig.toml"] {
        for command in ["run", "demo"] {
            let prefix = prefix("nothing");
            let args = [command, rig, "--no-ros", "--shm-prefix", &prefix, "--record", &directory];
            let failed = run(args).exits(1).complains(rig);
            assert!(!failed.stderr.contains("recording into"), "{}", failed.stderr);
        }
        run(["simulate", "--record", &directory, "--rig", rig]).exits(1).complains(rig);
    }
    assert!(!Path::new(&directory).exists(), "a recording was begun");
    // A directory that cannot be written to is a failure before the node runs, too.
    let occupied = write(folder.path(), "occupied", "a file");
    run(["demo", "--no-ros", "--no-shm", "--record", &occupied]).exits(1).complains("occupied");
}

#[test]
fn a_demo_of_set_duration_ends_by_itself() {
    let folder = folder();
    let started = Instant::now();
    let args = ["demo", "nine-dof", "--no-ros", "--no-shm", "--duration", "1", "--rate", "200"];
    let demo = run(args.into_iter().chain(["--record", &text(folder.path())])).exits(0);
    assert!(started.elapsed() >= Duration::from_secs(1), "{:?}", started.elapsed());
    promised("a demo of 1 s", started.elapsed(), Duration::from_secs(5));
    demo.says("seq ");
    let session = mcap(folder.path()).parent().expect("its directory").to_owned();
    check_finished(&session);
    // 1 s at 200 Hz; every input was received.
    run(["replay", "--verify", &text(&session)]).exits(0).says("200 inputs, ");
}
