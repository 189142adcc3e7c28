//! Recordings end to end: what was recorded is read back, whatever happened to the process, the disk or the file.

mod program;

use std::{
    fs::{self, File},
    io::{self, BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::{
        Arc, Condvar, Mutex,
        atomic::{AtomicI64, Ordering},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use proptest::prelude::*;
use squealcast::{
    io::{
        import::{ImportOptions, import},
        message::{Message, Payload},
        recorder::{Recorder, RecorderConfig, RecorderError, State},
        recording::{Entry, ReadOptions, Recorded, Recording},
        recording_file::{Disk, FileSystem},
        recover::{Outcome, recover},
    },
    rig::RigFile,
    wire::{
        DiagnosticArray, DiagnosticStatus, Header, KeyValue, Mode, OperatingPoint, Prediction, RigInfo, SessionEvent,
        Time, schema::Topic,
    },
};
use tempfile::TempDir;

/// The start of the recordings made here, ns since the epoch.
const T0: u64 = 1_700_000_000_000_000_000;
const LIMIT: Duration = Duration::from_secs(120);

fn point(seq: u64, log_time_ns: u64) -> Message {
    let stamp = Time::from_ns(log_time_ns as i64);
    let point = OperatingPoint {
        header: Header { stamp, frame_id: "rig".to_owned() },
        seq,
        normal_load_n: 500.0 + (seq as f64 * 0.37).sin(),
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.3 + 1e-4 * (seq % 1000) as f64,
    };
    Message { log_time_ns, publish_time_ns: log_time_ns, payload: Payload::OperatingPoint(point) }
}

fn prediction(seq: u64, log_time_ns: u64) -> Message {
    let mode = |id: u32| Mode {
        id,
        frequency_hz: 1000.0 * f64::from(id) + (seq as f64).sqrt(),
        growth_rate_per_s: -(f64::from(id) + seq as f64).sin(),
        damping_ratio: 0.01,
        pad_participation: 0.5,
        residual: 1e-14,
        frequency_error_hz: f64::INFINITY,
        growth_rate_error_per_s: -0.0,
    };
    let prediction = Prediction {
        header: Header { stamp: Time::from_ns(log_time_ns as i64), frame_id: String::new() },
        input_seq: seq,
        level: 2,
        reused: seq % 2 == 1,
        unstable_modes: 1,
        max_growth_rate_per_s: 1.5,
        worst_frequency_hz: 2000.0,
        critical_friction: 0.31,
        friction_margin: -0.02,
        friction_margin_error: 1e-10,
        reason: "ä reason".to_owned(),
        modes: (0..9).map(mode).collect(),
    };
    Message { log_time_ns, publish_time_ns: log_time_ns, payload: Payload::Prediction(prediction) }
}

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

fn rig_info() -> Message {
    let info = RigInfo {
        name: "nine-dof".to_owned(),
        content_hash: "c0ffee".to_owned(),
        version: "0.1.0".to_owned(),
        mode_count: 9,
        band_max_hz: 20_000.0,
        reduction: "0 missed".to_owned(),
    };
    Message { log_time_ns: T0, publish_time_ns: T0, payload: Payload::RigInfo(info) }
}

fn config(directory: &Path) -> RecorderConfig {
    let rig_files = vec![
        RigFile { name: "rig.toml".to_owned(), bytes: b"name = \"nine-dof\"\n".to_vec() },
        RigFile { name: "M.mtx".to_owned(), bytes: (0..=255).collect() },
    ];
    RecorderConfig { rig_name: "nine-dof".to_owned(), rig_files, ..RecorderConfig::new(directory) }
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

fn known(entry: &Entry) -> Option<&Payload> {
    match &entry.message {
        Recorded::Known(payload) => Some(payload),
        _ => None,
    }
}

fn sequence_numbers<'a>(entries: impl IntoIterator<Item = &'a Entry>) -> Vec<u64> {
    let seq = |entry: &'a Entry| match known(entry) {
        Some(Payload::OperatingPoint(point)) => Some(point.seq),
        _ => None,
    };
    entries.into_iter().filter_map(seq).collect()
}

fn read(path: &Path) -> Vec<Entry> {
    let recording = Recording::open(path).unwrap();
    assert!(recording.is_complete(), "{:?}", recording.damage());
    let mut messages = recording.messages();
    let entries: Vec<Entry> = messages.by_ref().collect();
    assert_eq!(messages.damage(), []);
    entries
}

fn only_file(directory: &Path) -> PathBuf {
    let recording = Recording::open(directory).unwrap();
    let [file] = recording.files() else { panic!("{:?}", recording.files()) };
    file.clone()
}

#[test]
fn what_was_recorded_is_read_back() {
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
    assert!(directory.join("metadata.yaml").exists());
    assert_eq!(recover(&directory).unwrap().recoveries.len(), 1);
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
        // By duration: 3.6 s in files of 1 s. By size: every message its own file, so numeric order counts (`_10` is
        // behind `_9`).
        assert_eq!(recording.files().len(), if by_size { 43 } else { 4 });
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

/// Not a test of its own: what `a_killed_process_loses_less_than_a_second` starts and kills.
#[test]
fn recording_child() {
    let Ok(directory) = std::env::var("SQUEALCAST_TEST_RECORD") else { return };
    let recorder = Recorder::start(config(Path::new(&directory))).unwrap();
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64;
    recorder.record(Message { log_time_ns: now, ..rig_info() });
    let start = Instant::now();
    for seq in 0.. {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64;
        recorder.record(point(seq, now));
        recorder.record(prediction(seq, now));
        if seq == 0 {
            println!("\nrecording");
            io::stdout().flush().unwrap();
        }
        std::thread::sleep((start + Duration::from_millis(2) * seq as u32).saturating_duration_since(Instant::now()));
        assert!(start.elapsed() < 2 * LIMIT, "nobody killed this process");
    }
}

#[test]
fn a_killed_process_loses_less_than_a_second() {
    for milliseconds in [200, 1600, 2900] {
        let temp = TempDir::new().unwrap();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "recording_child", "--nocapture"])
            .env("SQUEALCAST_TEST_RECORD", temp.path())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut output = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        while line.trim() != "recording" {
            line.clear();
            assert_ne!(output.read_line(&mut line).unwrap(), 0, "the recording process ended");
        }
        std::thread::sleep(Duration::from_millis(milliseconds));
        let live = recover(temp.path()).unwrap().recoveries;
        assert!(live.iter().all(|recovery| recovery.outcome == Outcome::InUse), "{live:?}");
        let killed = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64;
        child.kill().unwrap();
        child.wait().unwrap();

        // The next start repairs it by itself.
        let recorder = Recorder::start(config(temp.path())).unwrap();
        let deadline = Instant::now() + LIMIT;
        let recovered = loop {
            let status = recorder.status();
            assert_eq!(status.unrecovered, [] as [String; 0]);
            match status.recovered.as_slice() {
                [recovery] => break recovery.clone(),
                _ => assert!(Instant::now() < deadline, "{status:?}"),
            }
            std::thread::sleep(Duration::from_millis(10));
        };
        recorder.finish(LIMIT).unwrap();
        let Outcome::Restored(restored) = recovered.outcome else { panic!("{recovered:?}") };
        let entries = read(restored.path.parent().unwrap());
        assert_eq!(entries.len() as u64, restored.messages);
        let seqs = sequence_numbers(&entries);
        assert_eq!(seqs, (0..seqs.len() as u64).collect::<Vec<_>>());
        let last = entries.last().map_or(killed - milliseconds * 1_000_000, |entry| entry.log_time_ns);
        let lost_ms = killed.saturating_sub(last) / 1_000_000;
        eprintln!("killed after {milliseconds} ms: {} messages restored, the last {lost_ms} ms lost", entries.len());
        program::promised("what a kill loses", Duration::from_millis(lost_ms), Duration::from_secs(1));
        assert!(restored.path.parent().unwrap().join("metadata.yaml").exists());
        assert_eq!(Recording::open(&restored.path).unwrap().attachments().len(), 2);
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

/// A disk on which only so much can be written.
#[derive(Debug)]
struct SmallDisk(AtomicI64);

impl Disk for SmallDisk {
    fn write(&self, file: &File, bytes: &[u8]) -> io::Result<usize> {
        let space = self.0.load(Ordering::SeqCst);
        if space <= 0 {
            return Err(io::Error::from_raw_os_error(28)); // ENOSPC
        }
        // As a real one: the last write fits in part.
        let written = FileSystem.write(file, &bytes[..bytes.len().min(space as usize)])?;
        self.0.fetch_sub(written as i64, Ordering::SeqCst);
        Ok(written)
    }

    fn free_bytes(&self, _: &Path) -> io::Result<u64> {
        Ok(self.0.load(Ordering::SeqCst).max(0) as u64)
    }
}

#[test]
fn a_full_disk_stops_nobody_and_is_told() {
    let temp = TempDir::new().unwrap();
    let disk = Arc::new(SmallDisk(AtomicI64::new(60_000)));
    let config = RecorderConfig {
        disk: Arc::clone(&disk) as Arc<dyn Disk>,
        flush_interval: Duration::from_millis(10),
        retry_interval: Duration::from_millis(20),
        ..config(temp.path())
    };
    let recorder = Recorder::start(config.clone()).unwrap();
    recorder.record(rig_info());
    let wait = |wanted: fn(&State) -> bool, seq: &mut u64| {
        let deadline = Instant::now() + LIMIT;
        while !wanted(&recorder.status().state) {
            assert!(recorder.record(prediction(*seq, T0 + *seq * 1000)));
            *seq += 1;
            std::thread::sleep(Duration::from_micros(200));
            assert!(Instant::now() < deadline, "{:?}", recorder.status());
        }
    };
    let mut seq = 0;
    wait(|state| matches!(state, State::Failed(_)), &mut seq);
    let status = recorder.status();
    let State::Failed(reason) = &status.state else { panic!() };
    assert!(reason.contains("No space left on device"), "{reason}");
    for _ in 0..50 {
        recorder.record(prediction(seq, T0 + seq * 1000));
        seq += 1;
    }

    // Space again: the next file.
    disk.0.store(1 << 30, Ordering::SeqCst);
    wait(|state| *state == State::Recording, &mut seq);
    let resumed = seq;
    while seq < resumed + 100 {
        recorder.record(prediction(seq, T0 + seq * 1000));
        seq += 1;
    }
    let finished = recorder.finish(LIMIT).unwrap();
    let status = &finished.status;
    assert!(status.last_error.is_some() && status.dropped_failed > 50, "{status:?}");
    // The rig info is written once more at the start of the second file.
    assert_eq!(status.messages_written + status.dropped(), seq + 2, "{status:?}");
    assert_eq!(finished.files.len(), 1);

    // What was on the disk of the first file is not lost either.
    let recovered = recover(&finished.directory).unwrap().recoveries;
    assert_eq!(recovered.len(), 2);
    let entries = read(&finished.directory);
    assert!(entries.len() as u64 >= status.messages_written);
    assert!(matches!(known(&entries[0]), Some(Payload::RigInfo(_))));

    // Full to the end: an error.
    disk.0.store(30_000, Ordering::SeqCst);
    let recorder = Recorder::start(config).unwrap();
    for seq in 0..5000 {
        recorder.record(prediction(seq, T0 + seq * 1000));
    }
    let error = recorder.finish(LIMIT).unwrap_err();
    assert!(matches!(error, RecorderError::Failed { .. }), "{error}");

    // Full from the start: an error at once, and nothing left behind.
    let empty = TempDir::new().unwrap();
    disk.0.store(100, Ordering::SeqCst);
    let config = RecorderConfig { disk, ..RecorderConfig::new(empty.path()) };
    assert!(matches!(Recorder::start(config), Err(RecorderError::Write(_))));
    assert_eq!(fs::read_dir(empty.path()).unwrap().count(), 0);
}

/// A disk on which a write ends only once it is let go on.
#[derive(Debug, Default)]
struct HangingDisk {
    hangs: Mutex<bool>,
    goes_on: Condvar,
}

impl HangingDisk {
    fn hang(&self, hangs: bool) {
        *self.hangs.lock().unwrap() = hangs;
        self.goes_on.notify_all();
    }
}

impl Disk for HangingDisk {
    fn write(&self, file: &File, bytes: &[u8]) -> io::Result<usize> {
        drop(self.goes_on.wait_while(self.hangs.lock().unwrap(), |hangs| *hangs).unwrap());
        FileSystem.write(file, bytes)
    }

    fn free_bytes(&self, path: &Path) -> io::Result<u64> {
        FileSystem.free_bytes(path)
    }
}

/// Recording never waits: the disk hangs until more was recorded than the queue holds, and all of that by one thread.
#[test]
fn a_disk_that_hangs_holds_nobody_up() {
    let temp = TempDir::new().unwrap();
    let disk = Arc::new(HangingDisk::default());
    let config = RecorderConfig {
        disk: Arc::clone(&disk) as Arc<dyn Disk>,
        flush_interval: Duration::from_millis(10),
        ..config(temp.path())
    };
    let recorder = Recorder::start(config).unwrap();
    recorder.record(rig_info());
    disk.hang(true);
    let mut taken = 1;
    let mut seq = 0;
    // Were it to wait, nobody would let the disk go on.
    while recorder.record(point(seq, T0 + seq * 1000)) {
        (taken, seq) = (taken + 1, seq + 1);
        assert!(seq < 10_000_000, "the queue has no bound");
    }
    disk.hang(false);
    let finished = recorder.finish(LIMIT).unwrap();
    assert_eq!((finished.status.messages_written, finished.status.dropped_queue_full), (taken, 1));
    assert!(sequence_numbers(&read(&finished.directory)).into_iter().eq(0..seq), "not those that were taken");
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
    fs::write(temp.path().join("session.mcap.importing.part"), "of an import that was killed").unwrap();
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
    let installed = concat!(env!("CARGO_MANIFEST_DIR"), "/target/peers/bin/python");
    let default = if Path::new(installed).exists() { installed } else { "python3" };
    let python = std::env::var("SQUEALCAST_PEERS_PYTHON").unwrap_or_else(|_| default.to_owned());
    let imports = Command::new(&python).args(["-c", "import mcap.reader, mcap_ros2.decoder, rosbags.rosbag2"]).output();
    if !imports.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: {python} has no mcap, mcap-ros2-support and rosbags");
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
