//! The recorder when the process, the disk or the directory fails: losses are bounded, counted and reported.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io,
    path::Path,
    process::Command,
    sync::{
        Arc, Condvar, Mutex,
        atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use crate::program::{self, Running, command, files_below, folder, run, text};
use crate::records::*;
use squealcast::msgs::{Header, SessionEvent, SessionEventKind, Time};
use squealcast::recording::mcap_file::{Disk, FileSystem};
use squealcast::recording::message::{Message, Payload};
use squealcast::recording::reader::Recording;
use squealcast::recording::recorder::{QUEUE_MESSAGES, Recorder, RecorderConfig, RecorderError, State};
use squealcast::recording::recover::{Outcome, RecoverError, recover};
use tempfile::TempDir;

fn now_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64
}

/// Waits for what `found` finds.
#[track_caller]
fn until<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let began = Instant::now();
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(began.elapsed() < LIMIT, "waited {LIMIT:?} for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn setting(name: &str, value: f64, stamp_ns: i64) -> Message {
    let header = Header { stamp: Time::from_ns(stamp_ns), ..Default::default() };
    let event = SessionEvent { header, name: name.to_owned(), value, ..Default::default() };
    Message { log_time_ns: T0, publish_time_ns: T0, payload: Payload::SessionEvent(event) }
}

fn base_name(path: &Path) -> String {
    path.file_name().unwrap().to_str().unwrap().to_owned()
}

/// How long threads of this process wait for a processor.
struct Lateness {
    worst_ns: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

impl Lateness {
    fn watch() -> Self {
        let (worst_ns, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (worst, stopped) = (worst_ns.clone(), stop.clone());
        std::thread::spawn(move || {
            const NAP: Duration = Duration::from_millis(5);
            while !stopped.load(Ordering::Relaxed) {
                let began = Instant::now();
                std::thread::sleep(NAP);
                worst.fetch_max((began.elapsed() - NAP).as_nanos() as u64, Ordering::Relaxed);
            }
        });
        Self { worst_ns, stop }
    }

    fn worst(&self) -> Duration {
        Duration::from_nanos(self.worst_ns.load(Ordering::Relaxed))
    }
}

impl Drop for Lateness {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

// --- the process is killed -------------------------------------------------------------------------------------------

/// Kills a recording node `after` it has put something on the disk, recovers its files, and returns how much of the end is
/// lost. Messages that were readable before the kill are all recovered.
fn kill_and_restore(after: Duration) -> Duration {
    let temp = TempDir::new().unwrap();
    let node = Running::start(command(demo(temp.path(), 500)));
    let active = until("something on the disk", || {
        let file = files_below(temp.path()).into_iter().find(|path| path.extension().is_some_and(|e| e == "active"))?;
        (!sequence_numbers(&Recording::open(&file).ok()?.messages().collect::<Vec<_>>()).is_empty()).then_some(file)
    });
    std::thread::sleep(after); // when it is killed, nothing that is waited for
    let live = recover(temp.path()).unwrap().recoveries;
    assert!(live.iter().all(|recovery| recovery.outcome == Outcome::InUse), "{live:?}");
    let readable = sequence_numbers(&Recording::open(&active).unwrap().messages().collect::<Vec<_>>());
    let killed_ns = now_ns();
    drop(node); // SIGKILL

    // The next start repairs it by itself.
    let recorder = Recorder::start(config(temp.path())).unwrap();
    let recovered = until("the repair", || {
        let status = recorder.status();
        assert_eq!(status.unrecovered, [] as [String; 0]);
        status.recovered.first().cloned()
    });
    recorder.finish(LIMIT).unwrap();
    let Outcome::Restored(restored) = recovered.outcome else { panic!("{recovered:?}") };
    let session = restored.path.parent().unwrap();
    let entries = read(session);
    assert_eq!(entries.len() as u64, restored.messages);
    let restored_numbers = sequence_numbers(&entries);
    assert!(restored_numbers.iter().copied().eq(0..restored_numbers.len() as u64), "with a gap");
    assert!(restored_numbers.len() >= readable.len(), "{} of {}", restored_numbers.len(), readable.len());
    assert!(session.join("metadata.yaml").exists());
    assert_eq!(Recording::open(&restored.path).unwrap().attachments().len(), 1, "the rig");
    Duration::from_nanos(killed_ns.saturating_sub(entries.last().unwrap().log_time_ns))
}

/// Half a second between flushes, and the time they take. On a machine where threads wait for a processor so do flushes: what a
/// thread of this test waited for one is granted twice, once for the thread that records and once for the one that flushes.
#[test]
fn a_killed_process_loses_a_second_at_most() {
    let kills = std::env::var("SQUEALCAST_KILLS").map_or(3, |count| count.parse::<u64>().unwrap());
    let mut lost = vec![];
    for k in 0..kills {
        let lateness = Lateness::watch();
        // Spread over four flush intervals.
        lost.push(kill_and_restore(Duration::from_millis(k * 641 % 2000)));
        let limit = Duration::from_secs(1) + 2 * lateness.worst();
        assert!(lost[k as usize] < limit, "kill {k} lost {:?} of at most {limit:?}", lost[k as usize]);
    }
    lost.sort_unstable();
    let (median, most) = (lost[lost.len() / 2], lost[lost.len() - 1]);
    println!("{kills} kills: lost {median:.2?} at the median, {most:.2?} at most");
}

// --- the disk fails --------------------------------------------------------------------------------------------------

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
fn a_full_disk_is_reported_and_predictions_go_on() {
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
            assert!(recorder.record(point(*seq, T0 + *seq * 1000)));
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
        recorder.record(point(seq, T0 + seq * 1000));
        seq += 1;
    }

    // Space again: the next file.
    disk.0.store(1 << 30, Ordering::SeqCst);
    wait(|state| *state == State::Recording, &mut seq);
    let resumed = seq;
    while seq < resumed + 100 {
        recorder.record(point(seq, T0 + seq * 1000));
        seq += 1;
    }
    let finished = recorder.finish(LIMIT).unwrap();
    let status = &finished.status;
    assert!(status.last_error.is_some() && status.dropped_failed > 50, "{status:?}");
    // The rig info is written once more at the start of the second file.
    assert_eq!(status.messages_written + status.dropped(), seq + 2, "{status:?}");
    assert_eq!(finished.files.len(), 1);
    let [interrupted] = &status.interrupted[..] else { panic!("{status:?}") };
    assert!(interrupted.ends_with(format!("{}_0.mcap.active", base_name(&finished.directory))), "{interrupted:?}");

    // Messages of the first file on the disk are not lost either.
    let recovered = recover(&finished.directory).unwrap().recoveries;
    assert_eq!(recovered.len(), 2);
    let entries = read(&finished.directory);
    assert!(entries.len() as u64 >= status.messages_written);
    assert!(matches!(known(&entries[0]), Some(Payload::RigInfo(_))));

    // Full to the end: an error.
    disk.0.store(30_000, Ordering::SeqCst);
    let recorder = Recorder::start(config).unwrap();
    for seq in 0..5000 {
        recorder.record(point(seq, T0 + seq * 1000));
    }
    let error = recorder.finish(LIMIT).unwrap_err();
    assert!(matches!(error, RecorderError::Failed { .. }), "{error}");

    // Full from the start: an error at once, and no files.
    let empty = TempDir::new().unwrap();
    disk.0.store(100, Ordering::SeqCst);
    let config = RecorderConfig { disk, ..RecorderConfig::new(empty.path()) };
    assert!(matches!(Recorder::start(config), Err(RecorderError::Write(_))));
    assert_eq!(fs::read_dir(empty.path()).unwrap().count(), 0);
}

/// A live node predicts on, says why nothing is recorded, and records as soon as there is space: from then on everything, and first
/// what is in force.
#[test]
fn a_disk_that_is_full_at_the_start_is_recorded_to_when_it_is_not() {
    let temp = TempDir::new().unwrap();
    let disk = Arc::new(SmallDisk(AtomicI64::new(100)));
    let config = RecorderConfig {
        disk: Arc::clone(&disk) as Arc<dyn Disk>,
        flush_interval: Duration::from_millis(10),
        retry_interval: Duration::from_millis(20),
        ..config(temp.path())
    };
    let recorder = Recorder::start_when_possible(config).unwrap();
    let status = recorder.status();
    assert!(status.problem().is_some_and(|why| why.contains("No space left on device")), "{status:?}");
    assert_eq!(fs::read_dir(temp.path()).unwrap().count(), 0, "no session without a recording");
    for message in [rig_info(), setting("warn_margin", 0.1, 1), setting("warn_margin", 0.2, 2)] {
        recorder.record(message);
    }
    (0..10).for_each(|seq| assert!(recorder.record(point(seq, T0 + seq))));
    until("the inputs to be lost", || (recorder.status().dropped() == 10).then_some(()));
    disk.0.store(1 << 30, Ordering::SeqCst);
    until("a recording", || (recorder.status().state == State::Recording).then_some(()));
    // The answer to an input that is lost: nothing could verify it.
    recorder.record(prediction(9, T0 + 9));
    (10..20).for_each(|seq| assert!(recorder.record(point(seq, T0 + seq))));
    let finished = recorder.finish(LIMIT).unwrap();
    let entries = read(&finished.directory);
    assert_eq!(sequence_numbers(&entries), (10..20).collect::<Vec<_>>());
    assert_eq!(finished.status.dropped(), 11, "settings and rig are not lost");
    assert!(!entries.iter().any(|entry| matches!(known(entry), Some(Payload::Prediction(_)))));
    let first: Vec<_> = entries.iter().take(2).map(|entry| known(entry).cloned().unwrap()).collect();
    assert_eq!(first, [rig_info().payload, setting("warn_margin", 0.2, 2).payload]);

    // Any other reason is permanent, so it is reported without waiting.
    let occupied = temp.path().join("occupied");
    fs::write(&occupied, "").unwrap();
    let error = Recorder::start_when_possible(RecorderConfig::new(&occupied)).unwrap_err();
    assert!(matches!(error, RecorderError::Directory { .. }), "{error}");
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
fn a_disk_that_hangs_does_not_delay_predictions() {
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
    // If it waited here, the disk would never be released.
    while recorder.record(point(seq, T0 + seq * 1000)) {
        (taken, seq) = (taken + 1, seq + 1);
        assert!(seq < 10_000_000, "the queue has no bound");
    }
    disk.hang(false);
    let finished = recorder.finish(LIMIT).unwrap();
    assert_eq!((finished.status.messages_written, finished.status.dropped_queue_full), (taken, 1));
    let why = finished.status.why_dropped().unwrap();
    assert!(why.starts_with(&format!("1 dropped because the queue of {QUEUE_MESSAGES} messages was full")), "{why}");
    assert!(sequence_numbers(&read(&finished.directory)).into_iter().eq(0..seq), "not those that were taken");
}

/// A disk that does not answer holds up no end either.
#[test]
fn a_recorder_that_does_not_finish_is_left() {
    let temp = TempDir::new().unwrap();
    let disk = Arc::new(HangingDisk::default());
    let config = RecorderConfig { disk: Arc::clone(&disk) as Arc<dyn Disk>, ..config(temp.path()) };
    let recorder = Recorder::start(config).unwrap();
    disk.hang(true);
    recorder.record(point(0, T0));
    let limit = Duration::from_millis(200);
    let error = recorder.finish(limit).unwrap_err();
    disk.hang(false);
    assert!(matches!(error, RecorderError::Timeout(waited) if waited == limit), "{error}");
}

/// A disk that counts its operations and panics on demand.
#[derive(Debug, Default)]
struct CountingDisk {
    writes: AtomicI64,
    syncs: AtomicI64,
    panics: AtomicBool,
}

impl Disk for CountingDisk {
    fn write(&self, file: &File, bytes: &[u8]) -> io::Result<usize> {
        assert!(!self.panics.load(Ordering::SeqCst), "asked to");
        self.writes.fetch_add(1, Ordering::SeqCst);
        FileSystem.write(file, bytes)
    }

    fn sync(&self, file: &File) -> io::Result<()> {
        self.syncs.fetch_add(1, Ordering::SeqCst);
        FileSystem.sync(file)
    }

    fn free_bytes(&self, path: &Path) -> io::Result<u64> {
        FileSystem.free_bytes(path)
    }
}

/// A few messages are far from a chunk: they get to the disk because time passes.
#[test]
fn messages_are_flushed_and_put_on_the_disk_as_time_passes() {
    let temp = TempDir::new().unwrap();
    let disk = Arc::new(CountingDisk::default());
    let config = RecorderConfig {
        disk: Arc::clone(&disk) as Arc<dyn Disk>,
        flush_interval: Duration::from_millis(20),
        sync_interval: Duration::from_millis(60),
        ..config(temp.path())
    };
    let recorder = Recorder::start(config).unwrap();
    let counts = || (disk.writes.load(Ordering::SeqCst), disk.syncs.load(Ordering::SeqCst));
    let at_rest = || {
        until("the recorder to be at rest", || {
            let before = counts();
            std::thread::sleep(Duration::from_millis(200));
            (counts() == before).then_some(before)
        })
    };
    for seq in 0..3 {
        let (_, syncs) = at_rest();
        recorder.record(point(seq, T0 + seq));
        until_on_the_disk(temp.path(), &(0..=seq).collect::<Vec<_>>());
        until("the message to be synced", || (counts().1 > syncs).then_some(()));
    }
    // With nothing to write nothing is done.
    at_rest();
    recorder.finish(LIMIT).unwrap();
}

/// Waits until the file that is being recorded holds inputs of just these sequence numbers.
fn until_on_the_disk(directory: &Path, expected: &[u64]) {
    until("the messages on the disk", || {
        let active = files_below(directory).into_iter().next()?;
        let recording = Recording::open(&active).ok()?;
        (sequence_numbers(&recording.messages().collect::<Vec<_>>()) == expected).then_some(())
    });
}

#[test]
fn a_recorder_panic_is_reported_and_its_files_are_recovered() {
    let temp = TempDir::new().unwrap();
    let disk = Arc::new(CountingDisk::default());
    let config = RecorderConfig {
        disk: Arc::clone(&disk) as Arc<dyn Disk>,
        flush_interval: Duration::from_millis(10),
        ..config(temp.path())
    };
    let recorder = Recorder::start(config).unwrap();
    recorder.record(point(0, T0));
    until_on_the_disk(temp.path(), &[0]);
    disk.panics.store(true, Ordering::SeqCst);
    recorder.record(point(1, T0 + 1));
    until("the end of the recorder", || matches!(recorder.status().state, State::Failed(_)).then_some(()));
    until("messages to be refused", || (!recorder.record(point(2, T0 + 2))).then_some(()));
    assert!(recorder.status().dropped() > 0);
    assert!(matches!(recorder.finish(LIMIT), Err(RecorderError::Panicked)));
    assert_eq!(recover(temp.path()).unwrap().messages_restored(), 1);
}

/// A finished file is never replaced by the content of an interrupted one of the same name.
#[test]
fn an_interrupted_file_does_not_replace_a_finished_one() {
    let temp = TempDir::new().unwrap();
    let recorder = Recorder::start(config(temp.path())).unwrap();
    recorder.record(point(0, T0));
    let finished = recorder.finish(LIMIT).unwrap().files.remove(0);
    let bytes = fs::read(&finished).unwrap();
    let mut interrupted = finished.clone().into_os_string();
    interrupted.push(".active");
    fs::write(&interrupted, &bytes[..bytes.len() / 2]).unwrap();
    let report = recover(temp.path()).unwrap();
    assert!(matches!(&report.errors[..], [RecoverError::TargetExists { .. }]), "{report:?}");
    assert_eq!(fs::read(&finished).unwrap(), bytes);
    assert_eq!(fs::read(&interrupted).unwrap(), &bytes[..bytes.len() / 2]);
}

// --- the directory goes ----------------------------------------------------------------------------------------------

/// Short intervals: changes of the directory are noticed immediately.
fn attentive(directory: &Path) -> RecorderConfig {
    RecorderConfig {
        flush_interval: Duration::from_millis(5),
        sync_interval: Duration::from_millis(200),
        retry_interval: Duration::from_millis(20),
        ..config(directory)
    }
}

/// Records inputs until something is seen; the number of the next.
fn record_until(recorder: &Recorder, mut seq: u64, what: &str, seen: impl Fn() -> bool) -> u64 {
    until(what, || {
        assert!(recorder.record(point(seq, T0 + seq * 1000)));
        seq += 1;
        seen().then_some(())
    });
    seq
}

#[test]
fn a_directory_that_is_removed_is_made_again_and_the_loss_is_counted() {
    let temp = TempDir::new().unwrap();
    let records = temp.path().join("records");
    let recorder = Recorder::start(attentive(&records)).unwrap();
    recorder.record(rig_info());
    let seq = record_until(&recorder, 0, "something on the disk", || recorder.status().bytes_written > 2000);
    fs::remove_dir_all(&records).unwrap();
    let seq = record_until(&recorder, seq, "the loss", || recorder.status().dropped() > 0);
    let seq = record_until(&recorder, seq, "messages", || recorder.status().messages_written > 20);
    let finished = recorder.finish(LIMIT).unwrap();
    let status = &finished.status;
    assert!(status.why_dropped().is_some_and(|why| why.contains("was removed while it was recorded")), "{status:?}");
    // All inputs, and the rig once more: in a file or counted as lost.
    assert_eq!(status.messages_written + status.dropped(), seq + 2, "{status:?}");
    let entries = read(&finished.directory);
    assert_eq!(entries.len() as u64, status.messages_written);
    let numbers = sequence_numbers(&entries);
    assert!(numbers.iter().copied().eq(seq - numbers.len() as u64..seq), "{numbers:?} of {seq}");

    // Removed and not noticed before the end: an error, not a recording that is nowhere.
    let recorder = Recorder::start(config(&records)).unwrap();
    (0..5).for_each(|seq| assert!(recorder.record(point(seq, T0 + seq))));
    let directory = recorder.status().directory;
    until("the messages", || (recorder.status().messages_written == 5).then_some(()));
    fs::remove_dir_all(directory).unwrap();
    let error = recorder.finish(LIMIT).unwrap_err();
    assert!(matches!(error, RecorderError::Failed { written: 0, dropped: 5, .. }), "{error}");
}

#[test]
fn a_directory_that_is_moved_keeps_its_files_and_nothing_is_lost() {
    let temp = TempDir::new().unwrap();
    let recorder = Recorder::start(attentive(temp.path())).unwrap();
    recorder.record(rig_info());
    let (first, moved) = (recorder.status().directory, temp.path().join("moved"));
    let seq = record_until(&recorder, 0, "something on the disk", || recorder.status().bytes_written > 2000);
    fs::rename(&first, &moved).unwrap();
    let seq = record_until(&recorder, seq, "the move", || recorder.status().last_error.is_some());
    let seq = record_until(&recorder, seq, "a new directory", || recorder.status().directory.exists());
    let finished = recorder.finish(LIMIT).unwrap();
    let status = &finished.status;
    assert_eq!((&status.state, status.dropped()), (&State::Finished, 0), "{status:?}");
    assert!(status.last_error.as_ref().is_some_and(|what| what.contains("was moved to")), "{status:?}");
    assert_eq!(finished.files.len(), 2);
    assert!(finished.files.iter().all(|file| file.exists()), "{:?}", finished.files);
    assert!(moved.join("metadata.yaml").exists());
    let mut numbers = sequence_numbers(&read(&moved));
    numbers.extend(sequence_numbers(&read(&finished.directory)));
    assert!(numbers.iter().copied().eq(0..seq), "{numbers:?} of {seq}");
}

// --- signals and limits ----------------------------------------------------------------------------------------------

fn demo(directory: &Path, rate: u32) -> Vec<String> {
    let options = ["demo", "nine-dof-case-2", "--no-ros", "--no-shm", "--no-display", "--no-chart", "--plain"];
    let mut args: Vec<String> = options.map(str::to_owned).to_vec();
    args.extend(["--rate".to_owned(), rate.to_string(), "--record".to_owned(), text(directory)]);
    args
}

fn written(directory: &Path) -> u64 {
    files_below(directory).iter().filter_map(|path| path.metadata().ok()).map(|file| file.len()).sum()
}

fn grows(directory: &Path) {
    let before = written(directory);
    until("the recording to grow", || (written(directory) > before + 20_000).then_some(()));
}

fn check_finished(directory: &Path) {
    let names: Vec<String> = files_below(directory).iter().map(|path| text(path)).collect();
    assert!(!names.is_empty() && !names.iter().any(|name| name.ends_with(".active")), "{names:?}");
    let session = files_below(directory).remove(0).parent().unwrap().to_owned();
    run(["replay", "--verify", &text(&session)]).exits(0).says("0 different, 0 missing, 0 extra");
}

#[test]
fn a_terminal_that_goes_away_ends_a_recording_cleanly() {
    let folder = folder();
    let running = Running::start(command(demo(folder.path(), 100)));
    grows(folder.path());
    running.signal("HUP").exits(0).complains("recorded ");
    check_finished(folder.path());
}

#[test]
fn a_hangup_that_is_ignored_from_the_start_stays_ignored() {
    let folder = folder();
    let mut shell = Command::new("sh");
    shell
        .args(["-c", "trap '' HUP; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_squealcast")])
        .args(demo(folder.path(), 100));
    let running = Running::start(shell);
    grows(folder.path());
    running.send("HUP");
    grows(folder.path());
    running.signal("TERM").exits(0);
    check_finished(folder.path());
}

/// A Ctrl-C reaches a launcher and the node alike, and the launcher passes its own on.
#[test]
fn quick_signals_end_a_recording_cleanly_however_many() {
    for (more, signal) in [(0, "INT"), (0, "TERM"), (1, "TERM"), (10, "INT")] {
        let folder = folder();
        let running = Running::start(command(demo(folder.path(), 100)));
        grows(folder.path());
        running.send("INT");
        (0..more).for_each(|_| running.send("INT"));
        running.signal(signal).exits(0).complains("recorded ");
        check_finished(folder.path());
    }
}

/// `ulimit -f` is a full disk for one file at a time.
#[test]
fn a_limit_of_file_sizes_begins_another_file() {
    let folder = folder();
    let mut shell = Command::new("sh");
    // In units of 512 B, or of 1 KiB where `sh` is another shell.
    shell
        .args(["-c", "ulimit -f 150; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_squealcast")])
        .args(demo(folder.path(), 100));
    let running = Running::start(shell);
    let numbered = |number: &str| {
        files_below(folder.path()).iter().any(|path| base_name(path).contains(&format!("_{number}.mcap"))).then_some(())
    };
    until("another file", || numbered("1"));
    grows(folder.path());
    let ended = running.signal("INT").exits(3).complains("File too large").complains("squealcast recover");
    assert!(ended.stderr.contains("messages were not recorded"), "{}", ended.stderr);
    run(["recover", &text(folder.path())]);
    assert!(files_below(folder.path()).iter().all(|path| path.extension().is_none_or(|end| end != "active")));
    let session = files_below(folder.path()).remove(0).parent().unwrap().to_owned();
    assert!(!sequence_numbers(&read(&session)).is_empty());
}

#[test]
fn a_start_that_fails_leaves_no_session() {
    let folder = folder();
    let records = folder.path().join("records");
    let prefix = "too-long/".repeat(100);
    run(["run", "nine-dof", "--no-ros", "--shm-prefix", &prefix, "--no-display", "--record", &text(&records)]).exits(1);
    assert!(!records.exists(), "{:?}", files_below(&records));
}

// --- files of one session --------------------------------------------------------------------------------------------

/// Each file begins with the rig, settings, map, ends and chart in force, so that it verifies by itself; a replay of the whole
/// session skips them.
#[test]
fn each_file_of_a_session_verifies_by_itself() {
    let folder = folder();
    let whole = folder.path().join("whole");
    run(["simulate", "--record", &text(&whole), "--rig", "nine-dof-4+2", "--duration", "12"]).exits(0);
    let recording = Recording::open(files_below(&whole)[0].parent().unwrap()).unwrap();
    let config = RecorderConfig {
        rig_name: "nine-dof-4+2".to_owned(),
        rig_content_hash: recording.session_metadata("rig_content_hash").unwrap().to_owned(),
        rig_files: recording
            .attachments()
            .iter()
            .map(|file| program::rig_file(&file.name, file.data.clone()))
            .collect(),
        split_duration: Duration::from_secs(3),
        queue_messages: 1 << 20,
        ..RecorderConfig::new(folder.path().join("split"))
    };
    let recorder = Recorder::start(config).unwrap();
    for entry in recording.messages() {
        let payload = known(&entry).unwrap().clone();
        let [log_time_ns, publish_time_ns] = [entry.log_time_ns, entry.publish_time_ns];
        assert!(recorder.record(Message { log_time_ns, publish_time_ns, payload }));
    }
    let finished = recorder.finish(LIMIT).unwrap();
    assert_eq!(finished.files.len(), 4);
    let all = run(["replay", "--verify", &text(&finished.directory)]).exits(0);
    all.says("1200 predictions identical, 0 different, 0 missing, 0 extra");
    let settings = |file: &Path| -> BTreeSet<String> {
        let recording = Recording::open(file).unwrap();
        let name = |payload: &Payload| match payload {
            Payload::SessionEvent(event) if event.kind == SessionEventKind::Parameter.number() => {
                Some(event.name.clone())
            }
            _ => None,
        };
        recording.messages().filter_map(|entry| name(known(&entry)?)).collect()
    };
    let initial = settings(&finished.files[0]);
    assert!(initial.contains("warn_margin"), "{initial:?}");
    for (number, file) in finished.files.iter().enumerate() {
        assert_eq!(settings(file), initial, "file {number}");
        let one = run(["replay", "--verify", &text(file)]).exits(0).says("300 predictions identical, 0 different");
        assert_eq!(one.stderr.contains("begins in the middle of a session"), number > 0, "{}", one.stderr);
    }
}
