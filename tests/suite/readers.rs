//! Recordings as commands read them: of other programs, without predictions, several at a time; their predictions,
//! verified, reported and played.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use crate::program::{self, PATIENCE, command, folder, launch, run, text, write};
use squealcast::bus::received::Received;
use squealcast::bus::shm::{ShmOptions, ShmReader};
use squealcast::msgs::schema::{MESSAGE_ENCODING, SCHEMA_ENCODING, Topic};
use squealcast::msgs::shm::{OperatingPointForm, SensitivityForm};
use squealcast::msgs::{Header, OperatingPoint, Sensitivity, SessionEventKind, Time, Vibration};
use squealcast::offline::verify::{Charts, verify};
use squealcast::recording::mcap_file::{FileSystem, RecordingFile};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Entry, Recorded, Recording};
use squealcast::rig::Rig;

const S: u64 = 1_000_000_000;
/// Start of the recordings made here, ns since the epoch.
const T0: u64 = 1_700_000_000 * S;

fn point(seq: u64, stamp_ns: u64, normal_load_n: f64, friction_coefficient: f64) -> Payload {
    let stamp = Time::from_ns(stamp_ns as i64);
    let header = Header { stamp, frame_id: "rig".to_owned() };
    Payload::OperatingPoint(OperatingPoint { header, seq, normal_load_n, disc_speed_rad_s: 13.0, friction_coefficient })
}

/// A message of a recording: topic, schema text, log time and payload.
struct Written {
    topic: String,
    schema: String,
    log_time_ns: u64,
    payload: Payload,
}

fn written(topic: &str, log_time_ns: u64, payload: Payload) -> Written {
    Written { topic: topic.to_owned(), schema: payload.topic().schema(), log_time_ns, payload }
}

/// A recording as another program writes it: topics of any name, no rig.
fn bag(path: &Path, messages: &[Written]) -> String {
    let mut file = RecordingFile::create(path, ".part", Arc::new(FileSystem)).expect("a file");
    for Written { topic, schema, log_time_ns, payload } in messages {
        let kind = Some((payload.topic().type_name(), SCHEMA_ENCODING, schema.as_bytes()));
        let channel = file.channel(topic, kind, MESSAGE_ENCODING, &Default::default()).expect("a channel");
        let cdr = payload.to_cdr().expect("encoded");
        file.write(channel, 0, *log_time_ns, *log_time_ns, &cdr).expect("written");
    }
    file.finish().expect("finished");
    text(path)
}

/// Copies a recording with its rig, each message as `change` leaves it.
fn copy(from: &Path, to: &Path, mut change: impl FnMut(&mut Entry)) {
    let recording = Recording::open(from).expect("a recording");
    let mut file = RecordingFile::create(to, ".part", Arc::new(FileSystem)).expect("a file");
    recording.attachments().iter().for_each(|attachment| file.attach(attachment).expect("attached"));
    recording.metadata().iter().for_each(|metadata| file.write_metadata(metadata).expect("written"));
    for mut entry in recording.messages() {
        change(&mut entry);
        let from = &entry.channel;
        let schema = from.schema.as_ref().map(|s| (s.name.as_str(), s.encoding.as_str(), s.data.as_slice()));
        let channel = file.channel(&from.topic, schema, &from.message_encoding, &from.metadata).expect("a channel");
        let cdr = match &entry.message {
            Recorded::Known(payload) => payload.to_cdr().expect("encoded"),
            other => panic!("{other:?}"),
        };
        file.write(channel, entry.sequence, entry.log_time_ns, entry.publish_time_ns, &cdr).expect("written");
    }
    file.finish().expect("finished");
}

fn payloads(path: &Path) -> Vec<(u64, Payload)> {
    let known = |entry: Entry| match entry.message {
        Recorded::Known(payload) => (entry.log_time_ns, payload),
        other => panic!("{other:?}"),
    };
    Recording::open(path).expect("a recording").messages().map(known).collect()
}

fn predictions(path: &Path) -> Vec<squealcast::msgs::Prediction> {
    let prediction = |(_, payload)| match payload {
        Payload::Prediction(prediction) => Some(prediction),
        _ => None,
    };
    payloads(path).into_iter().filter_map(prediction).collect()
}

/// Predicts a recording or log with `nine-dof-case-2`; the recording that came of it.
fn predicted(input: &str, out: &Path, more: &[&str]) -> PathBuf {
    let args = ["predict-log", input, "--rig", "nine-dof-case-2", "-o", &text(out)];
    let done = run(args.iter().chain(more)).exits(0);
    PathBuf::from(done.stdout.trim())
}

// --- recordings without predictions ----------------------------------------------------------------------------------------

#[test]
fn a_log_is_predicted_in_its_own_time() {
    let folder = folder();
    let log = "Zeit [s];Normalkraft [kN];Drehzahl [1/min];Reibwert [-];Mikrofon [dB]\n\
               0,000;0,5;120;0,30;50\n0,010;0,5;120;0,30;50\n5,010;0,5;120;0,60;90\n5,020;0,5;120;0,20;50\n";
    let log = write(folder.path(), "log.csv", log);
    let out = text(&folder.path().join("log.mcap"));
    let imported = run(["import", &log, "-o", &out]).exits(0);
    let imported = imported
        .complains("normal_load_n from column \"Normalkraft [kN]\" in kN")
        .complains("time_s from column \"Zeit [s]\" in s")
        .complains("left out: \"Mikrofon [dB]\"");
    imported.complains(&format!("squealcast predict-log {out} --rig RIG -o DIR"));
    // What cannot be shown yet says which command makes it so.
    let report = text(&folder.path().join("report"));
    for args in [&["report", &out, "-o", &report][..], &["view", &out], &["replay", "--verify", &out]] {
        run(args).exits(1).complains("holds no predictions").complains(&format!("squealcast predict-log {out}"));
    }

    let from_log = predicted(&log, &folder.path().join("a"), &[]);
    let from_recording = predicted(&out, &folder.path().join("b"), &[]);
    // As text, for NaN is not equal to itself.
    let all = |path: &Path| format!("{:?}", payloads(path));
    assert_eq!(all(&from_log), all(&from_recording), "read from the log, or imported before");
    run(["replay", "--verify", &text(&from_log)])
        .exits(0)
        .says("4 inputs, 4 of them predicted; 5 predictions identical");
    // Two files of one folder that nothing declares to be one recording are two.
    let logs = folder.path().join("logs");
    std::fs::create_dir(&logs).expect("a folder");
    for name in ["monday.mcap", "tuesday.mcap"] {
        run(["import", &log, "-o", &text(&logs.join(name))]).exits(0);
    }
    let both = run(["predict-log", &text(&logs), "--rig", "nine-dof-case-2", "-o", &text(&folder.path().join("d"))]);
    let both = both.exits(0).complains("monday.mcap: 4 operating points").complains("tuesday.mcap: 4 operating points");
    assert_eq!(both.stdout.lines().count(), 2, "{}", both.stdout);
    let charted = predicted(&out, &folder.path().join("c"), &["--chart"]);
    let verified = run(["replay", "--verify", "--no-chart-cache", &text(&charted)]).exits(0);
    verified.says("4 inputs, 4 of them predicted; 5 predictions identical");

    // Stamps and log times are the log's; 1 s after the second input there is silence.
    let start = 946_684_800 * S;
    let inputs: Vec<(u64, i64)> = payloads(&from_log)
        .into_iter()
        .filter_map(|(log_ns, payload)| match payload {
            Payload::OperatingPoint(input) => Some((log_ns, input.header.stamp.as_ns())),
            _ => None,
        })
        .collect();
    for ((log_ns, stamp_ns), offset_ms) in inputs.into_iter().zip([0, 10, 5010, 5020]) {
        assert_eq!(stamp_ns, (start + offset_ms * 1_000_000) as i64);
        // The recorder makes log times differ by a nanosecond.
        assert!((log_ns as i64 - stamp_ns) < 100, "{log_ns} for {stamp_ns}");
    }
    let found: Vec<(i64, u8)> =
        predictions(&from_log).iter().map(|p| ((p.header.stamp.as_ns() - start as i64) / 1_000_000, p.level)).collect();
    // Case 2 is unstable from 0.3559 on, and warns 0.05 before.
    assert_eq!(found, [(0, 0), (10, 0), (1010, 3), (5010, 2), (5020, 0)]);
    assert!(predictions(&from_log).iter().all(|p| !p.reason.contains("pending")), "no margin has to wait here");
    run(["report", &text(&from_log), "-o", &report]).exits(0);
    let events = std::fs::read_to_string(folder.path().join("report/events.csv")).expect("events");
    let duration = |row: &str| row.split(',').nth(4).and_then(|cell| cell.parse::<f64>().ok());
    let squeal = events.lines().find(|row| row.contains("SQUEAL")).and_then(duration).expect("one squeal");
    assert!((squeal - 0.01).abs() < 1e-6, "{events}");
}

#[test]
fn topics_decide_which_conditions_are_predicted() {
    let folder = folder();
    let conditions = |topic: &str, load: f64| -> Vec<Written> {
        let at = |k: u64| written(topic, T0 + k * 10_000_000, point(k, T0 + k * 10_000_000, load, 0.3));
        (0..5).map(at).collect()
    };
    let loads = |path: &Path| -> Vec<f64> {
        let load = |(_, payload)| match payload {
            Payload::OperatingPoint(input) => Some(input.normal_load_n),
            _ => None,
        };
        payloads(path).into_iter().filter_map(load).collect()
    };
    let mut both = conditions("/brake1/operating_point", 111.0);
    both.extend(conditions("/rig/operating_point", 222.0));
    let both = bag(&folder.path().join("both.mcap"), &both);
    let out = |name: &str| folder.path().join(name);
    assert_eq!(loads(&predicted(&both, &out("own"), &[])), [222.0; 5]);
    let chosen = predicted(&both, &out("chosen"), &["--read-topic", "/brake1/operating_point"]);
    assert_eq!(loads(&chosen), [111.0; 5]);
    run(["replay", "--verify", &text(&chosen)]).exits(0).says("5 inputs, 5 of them predicted");

    // The only one of its type has another name: it is named, not taken.
    let other = bag(&out("other.mcap"), &conditions("/brake1/operating_point", 111.0));
    let failed = run(["predict-log", &other, "--rig", "nine-dof-case-2", "-o", &text(&out("x"))]).exits(1);
    let failed = failed.complains("/brake1/operating_point is not read").complains("--read-topic");
    failed.complains("holds no operating points");
    // A namespace is no other name, unless there are two.
    let one = bag(&out("one.mcap"), &conditions("/cell2/rig/operating_point", 333.0));
    assert_eq!(loads(&predicted(&one, &out("one"), &[])), [333.0; 5]);
    let mut two = conditions("/cell1/rig/operating_point", 1.0);
    two.extend(conditions("/cell2/rig/operating_point", 2.0));
    let two = bag(&out("two.mcap"), &two);
    let failed = run(["predict-log", &two, "--rig", "nine-dof-case-2", "-o", &text(&out("x"))]).exits(1);
    failed.complains("/cell1/rig/operating_point, /cell2/rig/operating_point are not read");
}

#[test]
fn an_unreadable_topic_is_reported_with_the_reason() {
    let folder = folder();
    let prediction = squealcast::msgs::Prediction { input_seq: 0, ..Default::default() };
    let schema = Topic::Prediction.schema().replace("float64 friction_margin_error\n", "");
    let messages = [
        written("/rig/operating_point", T0, point(0, T0, 500.0, 0.3)),
        Written { schema, ..written("/squealcast/prediction", T0 + 1, Payload::Prediction(prediction)) },
    ];
    let older = bag(&folder.path().join("older.mcap"), &messages);
    let why = "/squealcast/prediction is not read: squealcast_msgs/msg/Prediction has other fields in this version of \
               squealcast: the recorded one has no `float64 friction_margin_error`";
    let out = text(&folder.path().join("report"));
    for args in [
        &["report", &older, "-o", &out, "--rig", "nine-dof"][..],
        &["view", &older, "--rig", "nine-dof"],
        &["replay", "--verify", &older, "--rig", "nine-dof"],
    ] {
        run(args).exits(1).complains(why).complains("no prediction");
    }
    run(["replay", &older, "--no-ros", "--shm-prefix", "test-older/", "--wait", "0"]).exits(0).complains(why);
}

#[test]
fn recordings_in_other_formats_are_named() {
    let folder = folder();
    let made = |name: &str, file: &str, bytes: &[u8]| {
        let directory = folder.path().join(name);
        std::fs::create_dir(&directory).expect("a folder");
        std::fs::write(directory.join("metadata.yaml"), "rosbag2_bagfile_information:\n").expect("written");
        std::fs::write(directory.join(file), bytes).expect("written");
        [text(&directory), text(&directory.join(file))]
    };
    let sqlite = made("sqlite", "a_0.db3", b"SQLite format 3\0rest");
    let whole = made("whole", "a_0.mcap.zstd", &[0x28, 0xb5, 0x2f, 0xfd, 0, 0]);
    for (paths, named) in [(sqlite, "sqlite3"), (whole, "compressed as a whole")] {
        for path in paths {
            for args in [&["replay", "--verify", &path][..], &["view", &path], &["recover", &path]] {
                run(args).exits(1).complains(named).complains("ros2 bag convert");
            }
        }
    }
    // Message by message: the frame of a compressed message where CDR should be.
    let path = folder.path().join("messages.mcap");
    let mut file = RecordingFile::create(&path, ".part", Arc::new(FileSystem)).expect("a file");
    let channel = file.own_channel(Topic::Prediction).expect("a channel");
    for k in 0..3 {
        file.write(channel, 0, T0 + k, T0 + k, &[0x28, 0xb5, 0x2f, 0xfd, 0x20, 0, 1, 0, 0]).expect("written");
    }
    file.finish().expect("finished");
    let failed = run(["view", &text(&path), "--rig", "nine-dof"]).exits(1);
    failed.complains("3 messages cannot be decoded").complains("compressed message by message; `ros2 bag convert`");
}

/// Recordings that older programs made, each with the sentence that says what is not read of it.
#[test]
fn recordings_of_older_versions_are_read_or_the_reason_is_given() {
    let folder = folder();
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/recordings");
    // Without the margin's error bound a prediction is not one of today's.
    let oldest = text(&data.join("without_margin_error.mcap"));
    let out = text(&folder.path().join("oldest"));
    for args in [&["report", &oldest, "-o", &out][..], &["view", &oldest], &["replay", "--verify", &oldest]] {
        let failed = run(args).exits(1).complains("holds no prediction that can be read");
        failed.complains("/squealcast/prediction is not read").complains("has no `float64 friction_margin_error`");
    }
    // Predictions have the fields of today, but other reasons: they are read, and verification reports the differences.
    let older = text(&data.join("without_reduction.mcap"));
    let out = folder.path().join("older");
    let unread = "/squealcast/rig is not read";
    run(["report", &older, "-o", &text(&out)]).exits(0).complains(unread).complains("has no `string reduction`");
    assert!(std::fs::read_to_string(out.join("report.html")).expect("a report").contains("nine-dof-case-2"));
    let verified = run(["replay", "--verify", &older, "--no-chart-cache"]).exits(3).complains(unread);
    verified.says("200 inputs, 200 of them predicted").says("0 missing, 0 extra");
}

/// A later format is refused, whatever else could be read.
#[test]
fn a_recording_of_a_later_format_is_refused_by_its_number() {
    let folder = folder();
    let ramp = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/ramp");
    let recording = Recording::open(&ramp).expect("a recording");
    let made = |format: &str| {
        let path = folder.path().join(format!("format-{format}.mcap"));
        let mut file = RecordingFile::create(&path, ".part", Arc::new(FileSystem)).expect("a file");
        for metadata in recording.metadata() {
            let mut metadata = metadata.clone();
            metadata.metadata.insert("format".to_owned(), format.to_owned());
            file.write_metadata(&metadata).expect("written");
        }
        file.finish().expect("finished");
        path
    };
    assert!(Recording::open(&made("1")).is_ok());
    for format in ["2", "0", "one"] {
        let path = text(&made(format));
        let why =
            format!("a recording of format {format}, expected 1 or earlier, which this version of squealcast reads");
        let out = text(&folder.path().join("out"));
        for args in [&["report", &path, "-o", &out][..], &["view", &path], &["replay", "--verify", &path]] {
            run(args).exits(1).complains(&why);
        }
    }
}

// --- several recordings ------------------------------------------------------------------------------------------------------

#[test]
fn commands_take_a_folder_of_sessions() {
    let folder = folder();
    let sessions = text(&folder.path().join("sessions"));
    let simulate = ["simulate", "--record", &sessions, "--rig", "nine-dof-case-2", "--duration", "1"];
    for _ in 0..2 {
        run(simulate).exits(0);
    }
    let mut directories: Vec<String> =
        std::fs::read_dir(&sessions).expect("a folder").map(|entry| text(&entry.expect("one").path())).collect();
    directories.sort();
    let [first, second] = &directories[..] else { panic!("{directories:?}") };
    for args in [&["replay", "--verify", &sessions][..], &["replay", "--verify", first, second]] {
        let verified = run(args).exits(0);
        assert_eq!(verified.stdout.matches("100 predictions identical, 0 different").count(), 2, "{}", verified.stdout);
    }
    let report = folder.path().join("report");
    for _ in 0..2 {
        run(["report", &sessions, "-o", &text(&report)]).exits(0);
    }
    for directory in &directories {
        let name = Path::new(directory).file_name().expect("a name");
        assert!(report.join(name).join("report.html").exists(), "{directory}");
    }
    // One that fails does not keep the others; a command for one says what to give it.
    let empty =
        bag(&folder.path().join("conditions.mcap"), &[written("/rig/operating_point", T0, point(0, T0, 1.0, 0.1))]);
    let failed = run(["replay", "--verify", &empty, first]).exits(1).says("100 predictions identical");
    failed.complains("1 of 2 recordings could not be verified");
    run(["replay", first, second]).exits(1).complains("2 recordings are given, expected one");
    let played = ["replay", &sessions, "--no-ros", "--shm-prefix", "test-several/", "--wait", "0", "--rate", "100"];
    run(played).exits(0).complains("2 recordings: the last by name").complains(second);
}

// --- time ------------------------------------------------------------------------------------------------------------------

#[test]
fn reports_use_the_time_of_the_stamps() {
    let folder = folder();
    let ramp = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/ramp");
    // As if it had been played into a node at ten times the speed, a day later.
    let fast = folder.path().join("fast.mcap");
    let mut first = None;
    copy(&ramp, &fast, |entry| {
        let first = *first.get_or_insert(entry.log_time_ns);
        entry.log_time_ns = first + 86_400 * S + (entry.log_time_ns - first) / 10;
    });
    let events = |input: &Path, name: &str| {
        let out = folder.path().join(name);
        run(["report", &text(input), "-o", &text(&out)]).exits(0);
        std::fs::read_to_string(out.join("events.csv")).expect("events")
    };
    let (slow, fast) = (events(&ramp, "a"), events(&fast, "b"));
    assert!(slow.contains("SQUEAL"), "{slow}");
    assert_eq!(slow, fast);
}

// --- verification ------------------------------------------------------------------------------------------------------------

/// A chart, ends of windows or a map that come out with another hash than the recorded one are a difference.
#[test]
fn a_hash_that_differs_is_a_difference() {
    let folder = folder();
    let rig = std::fs::read_to_string(launch("nine-dof-case-2.toml")).expect("an embedded rig");
    let rig = write(
        folder.path(),
        "stiffening.toml",
        &format!("{rig}\n[load]\nexponent = 0.4\n[chart]\nnormal_load_n = [490.0, 520.0]\n"),
    );
    let rising =
        |k: u64| written("/rig/operating_point", T0 + k * S / 10, point(k, T0 + k * S / 10, 500.0 + k as f64, 0.3));
    let input = bag(&folder.path().join("rising.mcap"), &(0..8).map(rising).collect::<Vec<_>>());
    let out = text(&folder.path().join("out"));
    let done = run(["predict-log", &input, "--rig", &rig, "-o", &out, "--chart"]).exits(0);
    let session = PathBuf::from(done.stdout.trim());
    let rig = Arc::new(Rig::load(&rig).expect("a rig"));
    let check =
        |path: &Path| verify(&Recording::open(path).expect("a recording"), &rig, Charts::Kept).expect("verified");
    assert!(check(&session).agrees());
    for kind in [SessionEventKind::StabilityMap, SessionEventKind::WindowEnds, SessionEventKind::Chart] {
        let changed = folder.path().join(format!("{kind:?}.mcap"));
        let mut count = 0;
        copy(&session, &changed, |entry| {
            if let Recorded::Known(Payload::SessionEvent(event)) = &mut entry.message
                && event.kind == kind.number()
                && count == 0
            {
                count = 1;
                event.hash = format!("{}0", &event.hash[1..]);
            }
        });
        assert_eq!(count, 1, "the session has no event of kind {kind:?}");
        let found = check(&changed);
        assert_eq!((found.different_maps, found.different, found.agrees()), (1, 0, false), "kind {kind:?}: {found:?}");
    }
}

/// The recordings of this repository still come out as they were recorded. Another processor may round differently: then
/// frequencies differ in the last digits, and so do hashes.
#[test]
fn the_committed_recordings_verify() {
    let recordings = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings");
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("an embedded rig"));
    let mut count = 0;
    for entry in std::fs::read_dir(&recordings).expect("a folder") {
        let path = entry.expect("one").path();
        if !path.is_dir() {
            continue;
        }
        count += 1;
        let recording = Recording::open(&path).expect("a recording");
        assert_eq!(recording.session_metadata("rig_content_hash"), Some(rig.content_hash.as_str()), "{path:?}");
        let found = verify(&recording, &rig, Charts::Anew).expect("verified");
        assert!(found.predicted >= 200 && found.missing + found.extra == 0, "{path:?}: {found:?}");
        // Near the merging point a root has half the digits: √ε = 1.5e-8 of its frequency, at most 6 rad/s, some times over.
        assert!(found.frequency_difference < 1e-7 && found.growth_rate_difference_per_s < 1e-6, "{path:?}: {found:?}");
        eprintln!("{}: {} of {} identical", path.display(), found.identical, found.predicted);
    }
    assert_eq!(count, 2);
}

// --- playing -----------------------------------------------------------------------------------------------------------------

/// A replay that waits for its reader; ended when dropped.
struct Playing(Child);

impl Playing {
    fn start(args: &[&str]) -> Self {
        let mut child = command(args).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().expect("it starts");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        loop {
            let line = lines.next().expect("it ended").expect("text");
            if line.contains("for a reader") {
                break;
            }
        }
        // Its later output must not block it.
        std::thread::spawn(move || lines.for_each(drop));
        Self(child)
    }
}

impl Drop for Playing {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Everything that has a shared-memory form reaches a reader that comes late, from the first message on; played again, stamps
/// go on.
#[test]
fn a_replay_waits_for_readers_and_its_stamps_never_run_backward() {
    let folder = folder();
    const COUNT: u64 = 200;
    let mut messages = vec![];
    for k in 0..COUNT {
        let at_ns = T0 + k * 1_000_000;
        messages.push(written("/rig/operating_point", at_ns, point(k, at_ns, 500.0, 0.3)));
        let header = Header { stamp: Time::from_ns(at_ns as i64), ..Default::default() };
        let sensitivity = Sensitivity { header: header.clone(), input_seq: k, ..Default::default() };
        messages.push(written("/squealcast/sensitivity", at_ns, Payload::Sensitivity(sensitivity)));
        let vibration = Vibration { header, frequency_hz: 1.0, level_db: 50.0 };
        messages.push(written("/rig/vibration", at_ns, Payload::Vibration(vibration)));
    }
    let path = bag(&folder.path().join("played.mcap"), &messages);
    let prefix = format!("test-playing-{}/", std::process::id());
    let wanted = ["/rig/operating_point", "/squealcast/sensitivity"];
    let args = ["replay", &path, "--no-ros", "--shm-prefix", &prefix, "--plain", "--loop", "--wait", "120", "--topics"];
    let _playing = Playing::start(&[&args[..], &wanted].concat());
    let options = ShmOptions { service_prefix: prefix.clone(), ..Default::default() };
    let (inputs, heard_inputs) = mpsc::channel();
    let (sensitivities, heard_sensitivities) = mpsc::channel();
    let hear_input = move |received: Received<OperatingPoint>| drop(inputs.send(received.message));
    let _inputs = ShmReader::<OperatingPointForm>::spawn(&options, hear_input).expect("a reader");
    let hear_sensitivity = move |received: Received<Sensitivity>| drop(sensitivities.send(received.message));
    let _sensitivities = ShmReader::<SensitivityForm>::spawn(&options, hear_sensitivity).expect("a reader");

    let mut last_ns = 0;
    for k in 0..3 * COUNT {
        let input = heard_inputs.recv_timeout(PATIENCE).expect("an input");
        let sensitivity = heard_sensitivities.recv_timeout(PATIENCE).expect("a sensitivity");
        assert_eq!((input.seq, sensitivity.input_seq), (k % COUNT, k % COUNT), "none is lost");
        assert_eq!(input.header.stamp, sensitivity.header.stamp);
        let stamp_ns = input.header.stamp.as_ns();
        if k < COUNT {
            assert_eq!(stamp_ns as u64, T0 + k * 1_000_000, "the first round is as recorded");
        }
        assert!(stamp_ns > last_ns, "input {k}: {stamp_ns} after {last_ns}");
        last_ns = stamp_ns;
    }
}

/// A node that joins ROS 2 after the replay receives everything it plays.
#[test]
fn a_replay_over_ros_waits_for_a_node() {
    const COUNT: u64 = 200;
    let folder = folder();
    let at = |k: u64| written("/rig/operating_point", T0 + k * 5_000_000, point(k, T0 + k * 5_000_000, 500.0, 0.3));
    let path = bag(&folder.path().join("played.mcap"), &(0..COUNT).map(at).collect::<Vec<_>>());
    // No other test of these uses a domain between 180 and 189.
    let domain = (180 + std::process::id() % 10).to_string();
    let bus = ["--no-shm", "--loopback", "--domain", &domain];
    let mut playing = Playing::start(&[&["replay", &path, "--plain", "--wait", "120"], &bus[..]].concat());
    // Its own two nodes know each other long before, and are not what it waits for.
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(3) {
        assert!(playing.0.try_wait().expect("asked").is_none(), "it did not wait");
        std::thread::sleep(Duration::from_millis(50));
    }
    let out = text(&folder.path().join("recorded"));
    let node = ["run", "nine-dof", "--no-display", "--plain", "--no-chart", "--record", &out];
    let node = program::Running::start(command(node.iter().chain(&bus)));
    assert!(playing.0.wait().expect("it ends").success());
    node.signal("INT").exits(0);
    let recorded =
        program::files_below(Path::new(&out)).into_iter().find(|path| path.extension().is_some_and(|e| e == "mcap"));
    let received = payloads(&recorded.expect("a recording")).into_iter().filter_map(|(_, payload)| match payload {
        Payload::OperatingPoint(input) => Some(input.seq),
        _ => None,
    });
    assert_eq!(received.collect::<Vec<_>>(), (0..COUNT).collect::<Vec<_>>());
}
