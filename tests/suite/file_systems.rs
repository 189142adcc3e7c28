//! Power failures, full and read-only disks, on file systems of the tests' own. Mounting takes root; where it is not possible these
//! tests say so and pass.

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use crate::program::{self, Running, command, files_below, text, until};
use crate::records::*;
use squealcast::files::chart_file::ChartFile;
use squealcast::files::whole_file::{write_together, write_whole};
use squealcast::import::{ImportOptions, import};
use squealcast::recording::bag::{self, FileSummary};
use squealcast::recording::recorder::{Recorder, State};
use squealcast::recording::recover::recover;
use squealcast::rig::Rig;
use squealcast::session::computed::{chart_hash, session_chart};
use tempfile::TempDir;

fn now_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64
}

fn succeeds(program: &str, args: &[&str]) -> bool {
    let status = Command::new(program).args(args).stdout(Stdio::null()).stderr(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}

/// A mounted file system, unmounted when dropped.
struct Mounted {
    folder: PathBuf,
}

impl Mounted {
    /// Mounts with some options; `None`, and a line saying so, where that is not possible.
    fn new(args: &[&str], folder: &Path) -> Option<Self> {
        fs::create_dir_all(folder).unwrap();
        let folder = folder.to_owned();
        let mounted = succeeds("mount", &[args, &[&text(&folder)]].concat());
        if !mounted {
            program::aloud("skipped: this machine does not mount file systems for tests");
        }
        mounted.then_some(Self { folder })
    }

    fn remount(&self, options: &str) {
        assert!(succeeds("mount", &["-o", &format!("remount,{options}"), &text(&self.folder)]));
    }
}

impl Drop for Mounted {
    fn drop(&mut self) {
        let began = Instant::now();
        // Files of a process that was killed are closed a moment later.
        while !succeeds("umount", &[&text(&self.folder)]) {
            assert!(began.elapsed() < LIMIT || std::thread::panicking(), "{:?} stays mounted", self.folder);
            if std::thread::panicking() && began.elapsed() > Duration::from_secs(5) {
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

/// An ext4 file system in a file, behind one block device for as long as it is used: two would each remember what the other replaced.
struct Disk {
    folder: TempDir,
    device: String,
}

impl Disk {
    fn new() -> Option<Self> {
        let folder = TempDir::new().unwrap();
        let image = folder.path().join("image");
        File::create(&image).unwrap().set_len(96 << 20).unwrap();
        let made = succeeds("mkfs.ext4", &["-q", "-F", &text(&image)]) && succeeds("python3", &["-c", "import fcntl"]);
        let attached = Command::new("losetup").args(["--find", "--show", &text(&image)]).output();
        let attached = attached.ok().filter(|output| made && output.status.success());
        let Some(attached) = attached else {
            program::aloud("skipped: no mkfs.ext4, no python3 or no block device for a file");
            return None;
        };
        Some(Self { folder, device: String::from_utf8(attached.stdout).unwrap().trim().to_owned() })
    }

    /// Mounts it when it is no longer mounted: another process may have copied the mount into its own namespace, and
    /// with it the file system that was stopped.
    fn mount(&self) -> Option<Mounted> {
        let began = Instant::now();
        loop {
            let mounted = Mounted::new(&[&self.device], &self.folder.path().join("mounted"))?;
            let probe = mounted.folder.join("probe");
            match fs::write(&probe, "").and_then(|()| fs::remove_file(probe)) {
                Ok(()) => return Some(mounted),
                Err(error) => assert!(began.elapsed() < LIMIT, "{}: {error}", self.device),
            }
            drop(mounted);
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        succeeds("losetup", &["--detach", &self.device]);
    }
}

/// Stops a file system at once, with nothing of what is in memory written: EXT4_IOC_SHUTDOWN without flushing the log, by which file
/// systems are tested for this.
fn cut_power(folder: &Path) {
    let script = "import fcntl, os, struct, sys\n\
                  fcntl.ioctl(os.open(sys.argv[1], os.O_RDONLY), 0x8004587D, struct.pack('I', 2))";
    assert!(succeeds("python3", &["-c", script, &text(folder)]), "the file system does not stop");
}

// --- written files ---------------------------------------------------------------------------------------------------

/// Inputs of the writers, on a file system that stays.
struct Prepared {
    folder: TempDir,
}

/// Inputs in the interrupted recording.
const INTERRUPTED_INPUTS: u64 = 200;
const LOG_LINES: usize = 500;

impl Prepared {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        let rig = Rig::load("nine-dof-case-2").unwrap();
        let chart = session_chart(&rig, 2, &|| true).unwrap();
        let prepared = Self { folder };
        prepared.chart().save(&chart).unwrap();
        let lines: String = (0..LOG_LINES).map(|n| format!("{},500,13,0.3\n", n as f64 * 0.01)).collect();
        fs::write(prepared.log(), "time_s,load_N,speed_rad_s,mu\n".to_owned() + &lines).unwrap();
        let recorder = Recorder::start(config(prepared.folder.path())).unwrap();
        (0..INTERRUPTED_INPUTS).for_each(|seq| assert!(recorder.record(point(seq, T0 + seq))));
        let finished = recorder.finish(LIMIT).unwrap().files.remove(0);
        let bytes = fs::read(finished).unwrap();
        // All messages are there, the end is not.
        fs::write(prepared.interrupted(), &bytes[..bytes.len() - 40]).unwrap();
        prepared
    }

    fn chart(&self) -> ChartFile {
        chart_in(self.folder.path())
    }

    fn log(&self) -> PathBuf {
        self.folder.path().join("log.csv")
    }

    fn interrupted(&self) -> PathBuf {
        self.folder.path().join("interrupted")
    }
}

fn chart_in(folder: &Path) -> ChartFile {
    ChartFile::locate("rig", Some(&folder.join("rig.toml")), "content").unwrap()
}

/// What file number `k` holds: some pages, the last of which shows whether it is whole.
fn content(k: usize) -> Vec<u8> {
    (0..8000).flat_map(|line| format!("{k} {line}\n").into_bytes()).collect()
}

fn listed(k: usize) -> Vec<FileSummary> {
    (0..=k % 50).map(|n| FileSummary { name: format!("{k}_{n}.mcap"), ..FileSummary::default() }).collect()
}

/// Every function by which files get their names.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Writer {
    /// Reports, tables, figures, models.
    Whole,
    /// A rig and its arrays.
    Together,
    Chart,
    /// `metadata.yaml`.
    Metadata,
    Import,
    Recover,
    Recorder,
}

const WRITERS: [Writer; 7] = [
    Writer::Whole,
    Writer::Together,
    Writer::Chart,
    Writer::Metadata,
    Writer::Import,
    Writer::Recover,
    Writer::Recorder,
];

impl Writer {
    /// Writes file number `k` into `folder`.
    fn write(
        self,
        folder: &Path,
        k: usize,
        from: &Path,
        progress: &Progress,
    ) -> Result<(), Box<dyn std::error::Error>> {
        match self {
            Self::Whole => {
                write_whole(&folder.join(format!("{k}.html")), |out| out.write_all(&content(k)))?;
                // Another in the place of one that is there.
                write_whole(&folder.join("report.html"), |out| out.write_all(&content(k)))?;
            }
            Self::Together => {
                let (arrays, rig) = (content(k), content(k + 1));
                let files = [("npz", &arrays), ("toml", &rig)];
                write_together(files.map(|(kind, bytes)| (folder.join(format!("{k}.{kind}")), &bytes[..])))?;
            }
            Self::Chart => {
                let chart = chart_in(from).load()?.ok_or("no chart")?;
                chart_in(folder).save(&chart)?;
            }
            Self::Metadata => bag::write_metadata(folder, &listed(k))?,
            Self::Import => {
                import(&from.join("log.csv"), &folder.join(format!("{k}.mcap")), &ImportOptions::default())?;
            }
            Self::Recover => {
                let session = folder.join(format!("session-{k}"));
                fs::create_dir(&session)?;
                let active = session.join(format!("session-{k}_0.mcap.active"));
                fs::copy(from.join("interrupted"), &active)?;
                // As a recorder leaves it.
                File::open(&active)?.sync_all()?;
                File::open(&session)?.sync_all()?;
                File::open(folder)?.sync_all()?;
                let report = recover(&session)?;
                if let Some(error) = report.errors.into_iter().next() {
                    return Err(error.into());
                }
            }
            Self::Recorder => {
                let recorder = Recorder::start(config(folder))?;
                // Until it fails.
                for seq in (0..).take_while(|_| recorder.status().state == State::Recording) {
                    recorder.record(point(seq, now_ns()));
                    progress.begun.store(true, Ordering::SeqCst);
                    std::thread::sleep(Duration::from_millis(2));
                }
                recorder.finish(LIMIT)?;
            }
        }
        Ok(())
    }

    /// Asserts that what was written up to number `done` is there after a power failure, and that nothing is there in part; what was
    /// lost of a recording.
    fn check(self, folder: &Path, done: Option<usize>, [begun_ns, cut_ns]: [u64; 2], prepared: &Prepared) -> Duration {
        let there = |path: PathBuf, k: usize| {
            let bytes = fs::read(&path).ok();
            assert!(bytes.is_some() || done.is_none_or(|done| k > done), "{path:?} is missing, {done:?} were done");
            bytes
        };
        let last = done.map_or(0, |done| done + 2);
        match self {
            Self::Whole => {
                for k in 0..=last {
                    if let Some(bytes) = there(folder.join(format!("{k}.html")), k) {
                        assert!(bytes == content(k), "report {k}: {} bytes", bytes.len());
                    }
                }
                if let Some(bytes) = there(folder.join("report.html"), 0) {
                    assert!((done.unwrap_or(0)..=last).any(|k| bytes == content(k)), "{} bytes", bytes.len());
                }
            }
            Self::Together => {
                for k in 0..=last {
                    let [rig, arrays] = ["toml", "npz"].map(|kind| there(folder.join(format!("{k}.{kind}")), k));
                    if let Some(rig) = rig {
                        assert!(rig == content(k + 1), "rig {k}: {} bytes", rig.len());
                        assert!(arrays.as_ref().is_some_and(|arrays| *arrays == content(k)), "a rig without arrays");
                    }
                    assert!(arrays.is_none_or(|arrays| arrays == content(k)), "arrays {k}");
                }
            }
            Self::Chart => {
                let chart = chart_in(folder).load().expect("whole or not there");
                assert!(chart.is_some() || done.is_none(), "the chart is missing");
                let kept = prepared.chart().load().unwrap().unwrap();
                assert!(chart.is_none_or(|chart| chart_hash(&chart) == chart_hash(&kept)));
            }
            Self::Metadata => {
                if let Some(bytes) = there(folder.join(bag::METADATA_FILE), 0) {
                    let text = String::from_utf8(bytes).unwrap();
                    let whole = |k| text == bag::metadata_yaml(&listed(k));
                    assert!((done.unwrap_or(0)..=last).any(whole), "{} bytes after {done:?}", text.len());
                }
            }
            Self::Import => {
                for k in 0..=last {
                    let path = folder.join(format!("{k}.mcap"));
                    if there(path.clone(), k).is_some() {
                        assert_eq!(sequence_numbers(&read(&path)).len(), LOG_LINES);
                    }
                }
            }
            Self::Recover => {
                for k in 0..=last {
                    let session = folder.join(format!("session-{k}"));
                    let finished = session.join(format!("session-{k}_0.mcap"));
                    let active = session.join(format!("session-{k}_0.mcap.active"));
                    if there(finished.clone(), k).is_some() {
                        assert_eq!(sequence_numbers(&read(&finished)).len() as u64, INTERRUPTED_INPUTS);
                    } else if k < last && fs::metadata(&active).is_ok_and(|file| file.len() > 0) {
                        // Not restored yet: untouched.
                        assert_eq!(fs::read(&active).unwrap(), fs::read(prepared.interrupted()).unwrap());
                    }
                }
            }
            Self::Recorder => {
                // Nothing at all may be there of what was just begun.
                let report = recover(folder).unwrap_or_default();
                assert!(report.errors.is_empty(), "{report:?}");
                let files = files_below(folder);
                let session = files.iter().find(|path| path.extension().is_some_and(|end| end == "mcap"));
                let entries = session.map(|file| read(file.parent().unwrap())).unwrap_or_default();
                let numbers = sequence_numbers(&entries);
                assert!(numbers.iter().copied().eq(0..numbers.len() as u64), "with a gap");
                let last_ns = entries.last().map_or(begun_ns, |entry| entry.log_time_ns);
                return Duration::from_nanos(cut_ns.saturating_sub(last_ns));
            }
        }
        Duration::ZERO
    }
}

/// Progress of a writer.
#[derive(Default)]
struct Progress {
    begun: AtomicBool,
    /// Files that their writer reported as written.
    done: AtomicUsize,
}

/// Lets `writer` write until the power is cut, and inspects the files when it is back; returns the loss of a recording.
fn power_cut(disk: &Disk, writer: Writer, after: Duration, prepared: &Prepared) -> Option<Duration> {
    let mounted = disk.mount()?;
    let folder = mounted.folder.join("written");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir(&folder).unwrap();
    assert!(succeeds("sync", &["-f", &text(&mounted.folder)]));
    let progress = Arc::new(Progress::default());
    let (seen, into, from) = (progress.clone(), folder, prepared.folder.path().to_owned());
    let writing = std::thread::spawn(move || {
        // Until the power is off, which is an error.
        for k in 0.. {
            if writer.write(&into, k, &from, &seen).is_err() {
                return;
            }
            seen.done.store(k + 1, Ordering::SeqCst);
            seen.begun.store(true, Ordering::SeqCst);
        }
    });
    until("the first file", || progress.begun.load(Ordering::SeqCst));
    let begun_ns = now_ns();
    std::thread::sleep(after); // when the power fails, nothing that is waited for
    let control = mounted.folder.join("control");
    fs::write(&control, content(0)).unwrap();
    let cut_ns = now_ns();
    cut_power(&mounted.folder);
    writing.join().unwrap();
    drop(mounted);

    let mounted = disk.mount()?;
    let control = mounted.folder.join("control");
    // Data that were not flushed to the disk are not there: the power was cut.
    assert!(fs::read(&control).unwrap_or_default().is_empty(), "the file system was not stopped");
    let _ = fs::remove_file(control);
    let done = progress.done.load(Ordering::SeqCst).checked_sub(1);
    Some(writer.check(&mounted.folder.join("written"), done, [begun_ns, cut_ns], prepared))
}

/// `SQUEALCAST_POWER_CUTS=30` cuts more often.
#[test]
fn a_power_failure_leaves_every_file_whole_or_not_there() {
    let cuts = std::env::var("SQUEALCAST_POWER_CUTS").map_or(2, |count| count.parse::<u32>().unwrap());
    let Some(disk) = Disk::new() else { return };
    let prepared = Prepared::new();
    for writer in WRITERS {
        let mut lost = vec![];
        for k in 0..cuts {
            // A recording is put on the disk every 2 s.
            let (step_ms, span_ms) = if writer == Writer::Recorder { (1730, 5000) } else { (37, 400) };
            let after = Duration::from_millis(u64::from(k) * step_ms % span_ms);
            let Some(loss) = power_cut(&disk, writer, after, &prepared) else { return };
            lost.push(loss);
        }
        lost.sort_unstable();
        let (median, most) = (lost[lost.len() / 2], lost[lost.len() - 1]);
        // Two seconds between fdatasyncs, a flush every half second before them; three for a machine that does much else.
        assert!(most < Duration::from_secs(3 + 3), "{writer:?} lost {most:?}");
        if writer == Writer::Recorder {
            program::aloud(&format!(
                "{cuts} power cuts of a recording: lost {median:.2?} at the median, {most:.2?} at most"
            ));
        } else {
            program::aloud(&format!("{cuts} power cuts of {writer:?}: every file whole"));
        }
    }
}

// --- disks that are full or may not be written to ---------------------------------------------------------------------

/// A node that starts on a disk which refuses writes predicts, reports it, and records once the disk accepts data.
#[test]
fn a_node_starts_on_a_disk_that_is_full_or_read_only() {
    let temp = TempDir::new().unwrap();
    let disks = [("size=64k", "size=80m", "No space left"), ("size=80m,ro", "rw", "Read-only file system")];
    for (refusing, accepting, why) in disks {
        let folder = temp.path().join(accepting);
        let Some(mounted) = Mounted::new(&["-t", "tmpfs", "-o", refusing, "test"], &folder) else { return };
        // Full where it may be written to.
        let _ = fs::write(mounted.folder.join("ballast"), vec![0; 1 << 17]);
        let records = mounted.folder.join("records");
        let args =
            ["demo", "nine-dof-case-2", "--no-ros", "--no-shm", "--no-display", "--no-chart", "--plain", "--record"];
        let node = Running::start(command(args.iter().map(|&arg| arg.to_owned()).chain([text(&records)])));
        // It predicts; its notes are read at the end.
        std::thread::sleep(Duration::from_secs(1));
        mounted.remount(accepting);
        let recordings = || if records.exists() { files_below(&records) } else { vec![] };
        until("a recording", || {
            recordings().iter().any(|path| fs::metadata(path).is_ok_and(|file| file.len() > 20_000))
        });
        let ended = node.signal("INT").exits(3).complains("not recording").complains(why).says("seq ");
        assert!(ended.stderr.contains("recorded "), "{}", ended.stderr);
        let files = recordings();
        assert!(files.iter().any(|path| path.extension().is_some_and(|end| end == "mcap")), "{files:?}");
        let session = files[0].parent().unwrap();
        // It begins in the middle of a session: whether that squealed before is not in it, and shows in the first prediction.
        let verified = program::run(["replay", "--verify", &text(session)]).complains("the middle of a session");
        let differ = verified.stdout.split(" predictions identical, ").nth(1).unwrap_or_default();
        assert!(differ.starts_with("0 different") || differ.starts_with("1 different"), "{}", verified.stdout);
        verified.says(" 0 missing, 0 extra");
    }
}
