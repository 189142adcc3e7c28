//! Recordings end to end: recorded messages are read back after faults of the process, the disk or the file.

use std::{
    fs, io,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use crate::program;
use crate::records::*;
use proptest::prelude::*;
use squealcast::import::{ImportOptions, import};
use squealcast::msgs::schema::Topic;
use squealcast::msgs::{DiagnosticArray, DiagnosticStatus, Header, KeyValue, SessionEvent, Time};
use squealcast::recording::message::{Message, Payload};
use squealcast::recording::reader::{Entry, ReadOptions, Recorded, Recording};
use squealcast::recording::recorder::{Recorder, RecorderConfig, State};
use squealcast::recording::recover::{Outcome, Recovery, recover};
use tempfile::TempDir;

fn others() -> Vec<Message> {
    let header = Header { stamp: Time { sec: 5, nanosec: 6 }, frame_id: String::new() };
    let event = SessionEvent { header: header.clone(), name: "dead_band".to_owned(), value: 1.0, ..Default::default() };
    let values = vec![KeyValue { key: "queue".to_owned(), value: "0".to_owned() }];
    let status = DiagnosticStatus { level: 1, name: "recorder".to_owned(), values, ..Default::default() };
    [Payload::SessionEvent(event), Payload::Diagnostics(DiagnosticArray { header, status: vec![status] })]
        .into_iter()
        .map(|payload| Message { log_time_ns: T0, publish_time_ns: 7, payload })
        .collect()
}

/// Records `count` operating points, each with its prediction, behind one message of every other kind.
fn record(config: RecorderConfig, count: u64) -> (PathBuf, Vec<Message>) {
    let recorder = Recorder::start(RecorderConfig { queue_messages: 1 << 20, ..config }).unwrap();
    let mut messages = vec![rig_info()];
    messages.extend(others());
    for seq in 0..count {
        let log_time_ns = T0 + seq * 2_000_000;
        messages.extend([point(seq, log_time_ns), prediction(seq, log_time_ns)]);
    }
    for message in &messages {
        assert!(recorder.record(message.clone()));
    }
    let finished = recorder.finish(LIMIT).unwrap();
    assert_eq!((finished.status.state, finished.status.dropped_queue_full), (State::Finished, 0));
    (finished.directory, messages)
}

fn payloads(entries: &[Entry]) -> Vec<&Payload> {
    let payload = |entry: &'_ Entry| match &entry.message {
        Recorded::Known(_) => true,
        other => panic!("{other:?}"),
    };
    entries.iter().filter(|entry| payload(entry)).filter_map(|entry| known(entry)).collect()
}

fn only_file(directory: &Path) -> PathBuf {
    let recording = Recording::open(directory).unwrap();
    let [file] = recording.files() else { panic!("{:?}", recording.files()) };
    file.clone()
}

#[test]
fn recorded_messages_are_read_back() {
    let temp = TempDir::new().unwrap();
    let (directory, messages) = record(config(temp.path()), 500);
    let entries = read(&directory);
    assert_eq!(payloads(&entries), messages.iter().map(|message| &message.payload).collect::<Vec<_>>());
    for (entry, message) in entries.iter().zip(&messages) {
        assert_eq!(entry.cdr, message.payload.to_cdr().unwrap());
        assert_eq!(entry.publish_time_ns, message.publish_time_ns);
        assert!(entry.log_time_ns >= message.log_time_ns && entry.log_time_ns < message.log_time_ns + 10);
    }
    assert!(entries.windows(2).all(|pair| pair[0].log_time_ns < pair[1].log_time_ns), "file order is replay order");

    let recording = Recording::open(&directory).unwrap();
    let names: Vec<_> = recording.attachments().iter().map(|file| (file.name.as_str(), file.data.len())).collect();
    assert_eq!(names, [("rig.toml", 18), ("M.mtx", 256)]);
    assert_eq!(recording.session_metadata("rig_name"), Some("nine-dof"));
    assert_eq!(recording.session_metadata("split_index"), Some("0"));
    assert_eq!(recording.session_metadata("format"), Some("1"));
    assert!(directory.join("metadata.yaml").exists());
    assert_eq!(recover(&directory).unwrap().recoveries.len(), 1);
}

/// Messages of some log times are read without the chunks elsewhere; of a file without a summary, everything is.
#[test]
fn messages_around_log_times_are_found_without_reading_everything() {
    let temp = TempDir::new().unwrap();
    // About 12 chunks of 1 MB.
    let (directory, _) = record(config(temp.path()), 10_000);
    let all = read(&directory);
    let (from, to) = (T0 + 9_000_000_000, T0 + 11_000_000_000);
    let inside = |entries: &[Entry]| -> Vec<(u64, Vec<u8>)> {
        let inside = entries.iter().filter(|entry| (from..=to).contains(&entry.log_time_ns));
        inside.map(|entry| (entry.log_time_ns, entry.cdr.to_vec())).collect()
    };
    assert!(inside(&all).len() > 1000);
    let around = |path: &Path| Recording::open(path).unwrap().messages_around(from..=to).collect::<Vec<Entry>>();
    let some = around(&directory);
    assert_eq!(inside(&some), inside(&all));
    assert!(some.len() < all.len() / 2, "{} of {} messages were read", some.len(), all.len());
    assert!(some.iter().all(|entry| matches!(entry.message, Recorded::Known(_))));

    let bytes = fs::read(only_file(&directory)).unwrap();
    let cut = temp.path().join("cut.mcap");
    fs::write(&cut, &bytes[..bytes.len() - 100]).unwrap();
    let some = around(&cut);
    assert_eq!((inside(&some), some.len()), (inside(&all), all.len()));
}

#[test]
fn a_recording_is_split_by_size_and_by_duration() {
    let temp = TempDir::new().unwrap();
    for config in [
        RecorderConfig { split_bytes: 1, ..config(temp.path()) },
        RecorderConfig { split_duration: Duration::from_secs(1), ..config(temp.path()) },
    ] {
        let by_size = config.split_bytes == 1;
        let (directory, _) = record(config, if by_size { 20 } else { 1800 });
        let recording = Recording::open(&directory).unwrap();
        // By duration: 3.6 s in files of 1 s. By size: three messages and 20 inputs with their predictions in a file each, so
        // numeric order counts (`_10` is behind `_9`).
        assert_eq!(recording.files().len(), if by_size { 23 } else { 4 });
        for file in recording.files() {
            let part = Recording::open(file).unwrap();
            assert_eq!(part.attachments().len(), 2);
            assert!(matches!(known(&part.messages().next().unwrap()), Some(Payload::RigInfo(_))), "{file:?}");
        }
        let entries = read(&directory);
        assert!(entries.windows(2).all(|pair| pair[0].log_time_ns < pair[1].log_time_ns));
        assert_eq!(sequence_numbers(&entries), (0..if by_size { 20 } else { 1800 }).collect::<Vec<_>>());
        assert_eq!(recording.attachments().len(), 2);
    }
}

/// A file with several chunks, as bytes.
fn small_recording(temp: &TempDir) -> (PathBuf, Vec<u8>) {
    let (directory, _) = record(config(temp.path()), 2000);
    let file = only_file(&directory);
    let bytes = fs::read(&file).unwrap();
    (file, bytes)
}

#[test]
fn a_file_cut_at_any_byte_is_read_up_to_the_cut() {
    let temp = TempDir::new().unwrap();
    let (file, bytes) = small_recording(&temp);
    let whole: Vec<_> = read(&file).into_iter().map(|entry| entry.cdr).collect();
    let path = temp.path().join("cut.mcap");
    let step = (bytes.len() / 400).max(1);
    let dense = |near: usize| near.saturating_sub(60)..(near + 60).min(bytes.len());
    let cuts = (0..bytes.len()).step_by(step).chain(dense(0)).chain(dense(600)).chain(dense(bytes.len()));
    let (mut previous, mut most) = (0, 0);
    for cut in cuts {
        fs::write(&path, &bytes[..cut]).unwrap();
        let recording = Recording::open(&path).unwrap();
        assert!(!recording.is_complete(), "cut at {cut}");
        let mut messages = recording.messages();
        let got: Vec<_> = messages.by_ref().map(|entry| entry.cdr).collect();
        assert!(!messages.damage().is_empty());
        assert!(whole.starts_with(&got), "cut at {cut}");
        if cut > previous && got.len() < most {
            panic!("fewer messages at {cut} than at {previous}");
        }
        (previous, most) = (cut, got.len());
        if cut > 2000 {
            assert_eq!(recording.attachments().len(), 2, "cut at {cut}");
        }
        if cut % 7 == 0 && cut > 0 {
            let recovered = recover(&path).unwrap().recoveries;
            let [recovery] = recovered.as_slice() else { panic!("{recovered:?}") };
            let Outcome::Restored(restored) = &recovery.outcome else { panic!("{recovery:?}") };
            assert_eq!(restored.messages, got.len() as u64);
            assert_eq!(restored.kept_original.is_some(), restored.loses_data());
            assert_eq!(read(&path).len(), got.len());
            if let Some(kept) = &restored.kept_original {
                assert_eq!(fs::read(kept).unwrap(), &bytes[..cut]);
                fs::remove_file(kept).unwrap();
            }
        }
    }
    assert_eq!(most, whole.len(), "a cut within the summary loses no message");
}

/// As where a process that has just closed the file is starting another one, which inherits the lock until it has begun.
#[test]
fn a_file_that_stays_locked_for_a_moment_is_repaired() {
    let temp = TempDir::new().unwrap();
    let (file, bytes) = small_recording(&temp);
    fs::write(&file, &bytes[..bytes.len() - 100]).unwrap();
    let locked = fs::File::open(&file).unwrap();
    locked.lock().unwrap();
    let recovered = std::thread::scope(|scope| {
        let recovered = scope.spawn(|| recover(&file).unwrap().recoveries);
        std::thread::sleep(Duration::from_millis(100)); // the moment
        drop(locked);
        recovered.join().unwrap()
    });
    assert!(matches!(recovered[..], [Recovery { outcome: Outcome::Restored(_), .. }]), "{recovered:?}");
}

#[test]
fn a_chunk_that_is_damaged_inside_loses_no_other() {
    let temp = TempDir::new().unwrap();
    let (file, bytes) = small_recording(&temp);
    let whole = read(&file);
    let mut lost_a_chunk_only = 0;
    for at in (0..60).map(|n| bytes.len() * n / 60) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x55;
        fs::write(&file, &damaged).unwrap();
        let Ok(recording) = Recording::open(&file) else { continue };
        let mut messages = recording.messages();
        let entries: Vec<Entry> = messages.by_ref().collect();
        let mut rest = whole.iter();
        assert!(entries.iter().all(|entry| rest.any(|other| other.cdr == entry.cdr)), "byte {at}: wrong content");
        if entries.len() < whole.len() {
            assert!(messages.damage().iter().any(|damage| damage.damage.loses_data), "byte {at}: silent loss");
            lost_a_chunk_only += usize::from(sequence_numbers(&entries).last() == Some(&1999));
        }
    }
    // Most of the file is chunks, of which only damage of the last one loses the last message.
    assert!(lost_a_chunk_only > 10, "{lost_a_chunk_only} of 60");
}

#[test]
fn a_log_becomes_a_recording() {
    let temp = TempDir::new().unwrap();
    let log = temp.path().join("session.csv");
    let output = temp.path().join("session.mcap");
    fs::write(&log, "Zeit [s];Last [kN];Drehzahl [1/min];Reibwert\n0,00;0,5;120;0,35\n").unwrap();
    let error = import(&log, &output, &ImportOptions::default()).unwrap_err().to_string();
    assert!(error.contains("session.csv") && error.contains("normal_load_n not found"), "{error}");
    fs::write(&log, "Zeit [s];Normalkraft [kN];Drehzahl [1/min];Reibwert\n0,00;0,5;120;0,35\n0,01;0,5;120;x\n")
        .unwrap();
    let error = import(&log, &output, &ImportOptions::default()).unwrap_err().to_string();
    assert!(error.contains("line 3, column \"Reibwert\": \"x\""), "{error}");
    assert_eq!(fs::read_dir(temp.path()).unwrap().count(), 1, "nothing half-written");

    fs::write(&log, "Zeit [s];Normalkraft [kN];Drehzahl [1/min];Reibwert\n0,00;0,5;120;0,35\n0,01;0,5;120;0,36\n")
        .unwrap();
    let imported = import(&log, &output, &ImportOptions::default()).unwrap();
    assert_eq!(imported.messages, 2);
    let entries = read(&output);
    let Some(Payload::OperatingPoint(point)) = known(&entries[1]) else { panic!() };
    assert_eq!((point.seq, point.normal_load_n, point.friction_coefficient), (1, 500.0, 0.36));
    assert_eq!(entries[1].log_time_ns, entries[0].log_time_ns + 10_000_000);
    assert!(import(&log, &output, &ImportOptions::default()).is_err(), "nothing is overwritten unasked");
    import(&log, &output, &ImportOptions { overwrite: true, ..ImportOptions::default() }).unwrap();
    assert_eq!(fs::read_dir(temp.path()).unwrap().count(), 2);
}

fn read_all(path: &Path) {
    if let Ok(recording) = Recording::open(path) {
        let mut messages = recording.messages();
        let _ = messages.by_ref().count();
        let _ = messages.damage();
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_bytes_make_the_reader_panic(
        mutations in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 1_usize..9), 1..6),
        cut in prop::option::of(any::<prop::sample::Index>()),
        plain in any::<bool>(),
    ) {
        let mut bytes = sample_file(plain);
        for (at, value, count) in mutations {
            let at = at.index(bytes.len());
            // Runs of one value make lying lengths.
            let end = (at + count).min(bytes.len());
            bytes[at..end].fill(value);
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        let temp = TempDir::new().unwrap();
        let path = temp.path().join("mutated.mcap");
        fs::write(&path, &bytes).unwrap();
        read_all(&path);
        let _ = recover(&path);
        read_all(&path);
    }

    #[test]
    fn no_record_makes_the_reader_panic(records in prop::collection::vec((0_u8..20, prop::collection::vec(any::<u8>(), 0..80)), 0..8)) {
        let mut bytes = mcap::MAGIC.to_vec();
        for (opcode, body) in records {
            bytes.push(opcode);
            bytes.extend((body.len() as u64).to_le_bytes());
            bytes.extend(body);
        }
        let temp = TempDir::new().unwrap();
        let path = temp.path().join("records.mcap");
        fs::write(&path, &bytes).unwrap();
        read_all(&path);
    }

    #[test]
    fn no_bytes_make_decoding_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), big in any::<bool>()) {
        for topic in Topic::ALL {
            let mut cdr = vec![0, u8::from(!big), 0, 0];
            cdr.extend(&bytes);
            let _ = Payload::from_cdr(topic, &cdr);
            let _ = Payload::from_cdr(topic, &bytes);
        }
    }
}

/// A small file; `plain`: neither compressed nor with CRCs, so that mutations get past those.
fn sample_file(plain: bool) -> Vec<u8> {
    let options = mcap::WriteOptions::new()
        .profile("ros2")
        .compression(if plain { None } else { Some(mcap::Compression::Zstd) })
        .calculate_chunk_crcs(!plain)
        .calculate_attachment_crcs(!plain);
    let mut output = io::Cursor::new(Vec::new());
    let mut writer = options.create(&mut output).unwrap();
    let attachment = mcap::Attachment {
        log_time: 1,
        create_time: 2,
        name: "rig.toml".to_owned(),
        media_type: String::new(),
        data: b"name = 1"[..].into(),
    };
    writer.attach(&attachment).unwrap();
    for (n, message) in [rig_info(), point(1, 10), prediction(1, 11)].into_iter().enumerate() {
        let topic = message.payload.topic();
        let schema = writer.add_schema(topic.type_name(), "ros2msg", topic.schema().as_bytes()).unwrap();
        let channel = writer.add_channel(schema, topic.name(), "cdr", &Default::default()).unwrap();
        let header =
            mcap::records::MessageHeader { channel_id: channel, sequence: 0, log_time: n as u64, publish_time: 0 };
        writer.write_to_known_channel(&header, &message.payload.to_cdr().unwrap()).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    output.into_inner()
}

/// Runs a script of `tests/peers` with the Python that has the peers; `None`, and a line saying so, where it has not.
fn peer(script: &str, arguments: &[&Path]) -> Option<String> {
    let python = program::python();
    if !program::python_has(&python, "mcap.reader, mcap_ros2.decoder, rosbags.rosbag2") {
        return None;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers").join(script);
    let output = Command::new(&python).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}

#[test]
fn others_read_our_recordings() {
    let temp = TempDir::new().unwrap();
    let config = RecorderConfig { split_duration: Duration::from_millis(300), ..config(temp.path()) };
    let (directory, _) = record(config, 400);
    let Some(output) = peer("read_recording.py", &[&directory]) else { return };
    let theirs: serde_json::Value = serde_json::from_str(&output).unwrap();
    let entries = read(&directory);
    for reader in ["mcap", "rosbags"] {
        let theirs = theirs[reader].as_array().unwrap();
        assert_eq!(theirs.len(), entries.len(), "{reader}");
        for (entry, theirs) in entries.iter().zip(theirs) {
            assert_eq!(theirs["topic"], entry.channel.topic, "{reader}");
            assert_eq!(theirs["log_time"], entry.log_time_ns, "{reader}");
            // Floating-point numbers as the text Python and Rust both round-trip.
            let ours = match known(entry).unwrap() {
                Payload::OperatingPoint(m) => serde_json::to_value(m),
                Payload::Prediction(m) => serde_json::to_value(m),
                Payload::SessionEvent(m) => serde_json::to_value(m),
                Payload::RigInfo(m) => serde_json::to_value(m),
                Payload::Sensitivity(m) => serde_json::to_value(m),
                Payload::Diagnostics(m) => serde_json::to_value(m),
                Payload::Vibration(m) => serde_json::to_value(m),
                Payload::Waveform(m) => serde_json::to_value(m),
                Payload::Heard(m) => serde_json::to_value(m),
                Payload::Temperature(m) => serde_json::to_value(m),
            };
            assert_eq!(theirs["message"], ours.unwrap(), "{reader}");
        }
    }
    assert_eq!(theirs["attachments"], serde_json::json!(["rig.toml", "M.mtx"]));
}

#[test]
fn recordings_of_others_are_read() {
    let temp = TempDir::new().unwrap();
    let directory = temp.path().join("foreign");
    if peer("write_recording.py", &[&directory]).is_none() {
        return;
    }
    for path in [directory.clone(), temp.path().join("lz4.mcap"), temp.path().join("plain.mcap")] {
        // Its type alone does not make a topic the node's.
        let unread = Recording::open(&path).unwrap();
        assert_eq!(unread.topics().name_of(Topic::OperatingPoint), None, "{path:?}");
        assert!(unread.topics().unread()[0].to_string().contains("/lab/conditions is not read"), "{path:?}");
        let options = ReadOptions { topics: vec!["/lab/conditions".to_owned()] };
        let recording = Recording::open_with(&path, options).unwrap();
        assert!(recording.is_complete(), "{:?}", recording.damage());
        let entries: Vec<Entry> = recording.messages().collect();
        assert_eq!(sequence_numbers(&entries), (0..100).collect::<Vec<_>>(), "{path:?}");
        let Some(Payload::OperatingPoint(point)) = known(&entries[6]) else { panic!("{:?}", entries[6]) };
        assert_eq!((point.normal_load_n, point.disc_speed_rad_s, point.friction_coefficient), (503.0, 13.0, 0.3));
        assert_eq!(entries.iter().filter(|entry| entry.message == Recorded::Other).count(), 100);

        let options = ReadOptions { topics: vec!["/elsewhere".to_owned()] };
        let error = Recording::open_with(&path, options).unwrap_err().to_string();
        assert!(error.contains("holds no topic /elsewhere") && error.contains("/lab/conditions"), "{error}");
    }
    // As `ros2 bag record` compresses: one message at a time, or whole files; and its older format.
    let compressed = Recording::open(&temp.path().join("foreign-message")).unwrap();
    let mut messages = compressed.messages();
    assert_eq!(sequence_numbers(&messages.by_ref().collect::<Vec<_>>()), [0; 0]);
    let damage = messages.damage().iter().map(ToString::to_string).collect::<String>();
    assert!(damage.contains("100 messages cannot be decoded") && damage.contains("message by message"), "{damage}");
    for (name, named) in [("foreign-file", "compressed as a whole"), ("foreign-sqlite3", "sqlite3")] {
        let error = Recording::open(&temp.path().join(name)).unwrap_err().to_string();
        assert!(error.contains(named) && error.contains("ros2 bag convert"), "{error}");
    }
}
