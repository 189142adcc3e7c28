//! Records messages on a background thread, so that no sender waits for the disk.
//!
//! A recording is a rosbag2 directory `DIR/squealcast_<UTC time>/` of MCAP files `squealcast_<UTC time>_0.mcap`, `_1`
//! ... and `metadata.yaml`. Each file contains the rig files as attachments and a metadata record. It begins with the
//! rig, settings, stability map, window ends and chart in force, so that it can be replayed alone. While a file is
//! being written it is named `*.mcap.active`. If the directory is moved, its files are finished at their new place. If
//! it is removed, their messages are counted as lost. In both cases the recording continues in a new directory.
//!
//! The log time of a message is [`crate::system::clock::Reading::log_ns`], which does not jump when the wall clock is set.

mod worker;

use std::{
    fs, io,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crossbeam_channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender, TrySendError};

use super::mcap_file::{Disk, FileSystem, WriteError};
use super::message::Message;
use super::recover::{self, Outcome, Recovery};
use crate::files::whole_file::{folder_of, sync_folder};
use crate::rig::RigFile;
use worker::Worker;

/// The format of recordings that this program writes, and the latest that it reads. A recording whose metadata do not say
/// it has format 1.
pub const FORMAT: u32 = 1;

/// Name of the metadata record in each file. Its keys: `format`, `session_id`, `squealcast_version`, `rig_name`,
/// `rig_content_hash`, `split_index`, `started_utc`, and of a node `sound_*`, its definition of squeal in samples.
pub const METADATA_NAME: &str = "squealcast";

/// Capacity of the queue to the recorder, in messages. A node that was stopped and continues receives up to 4096 inputs
/// each from shared memory and ROS 2 at once, and predicts for each of them: 16 384 messages. The capacity is twice
/// that. The largest predictions take 4 KiB each.
pub const QUEUE_MESSAGES: usize = 1 << 15;

/// Configuration of a recorder.
#[derive(Clone, Debug)]
pub struct RecorderConfig {
    /// The directory in which the recording's own directory is created; created itself if missing.
    pub directory: PathBuf,
    pub rig_name: String,
    pub rig_content_hash: String,
    /// Attached to every file.
    pub rig_files: Vec<RigFile>,
    /// Further entries of the metadata record.
    pub metadata: Vec<(String, String)>,
    /// Identifies the recordings of one run.
    pub session_id: String,
    /// File size after which the next file is begun, bytes.
    pub split_bytes: u64,
    /// Log time spanned by a file after which the next file is begun.
    pub split_duration: Duration,
    /// Capacity of the queue to the recorder; messages beyond it are dropped and counted.
    pub queue_messages: usize,
    /// Interval between flushes: the most that is lost if the process is killed.
    pub flush_interval: Duration,
    /// Interval between `fdatasync` calls: the most that is lost in a power failure.
    pub sync_interval: Duration,
    /// Interval between attempts to begin a new file after a failure.
    pub retry_interval: Duration,
    /// The disk that is written to; tests replace it.
    pub disk: Arc<dyn Disk>,
}

impl RecorderConfig {
    /// The default settings: files of at most 1 GiB or one hour, a flush every 0.5 s, `fdatasync` every 2 s.
    pub fn new(directory: impl Into<PathBuf>) -> Self {
        Self {
            directory: directory.into(),
            rig_name: String::new(),
            rig_content_hash: String::new(),
            rig_files: Vec::new(),
            metadata: Vec::new(),
            session_id: format!("{:032x}", rand::random::<u128>()),
            split_bytes: 1 << 30,
            split_duration: Duration::from_secs(3600),
            queue_messages: QUEUE_MESSAGES,
            flush_interval: Duration::from_millis(500),
            sync_interval: Duration::from_secs(2),
            retry_interval: Duration::from_secs(2),
            disk: Arc::new(FileSystem),
        }
    }
}

/// Why recording is impossible or incomplete.
#[derive(Debug, thiserror::Error)]
pub enum RecorderError {
    #[error("cannot record into {}: {source}", .path.display())]
    Directory { path: PathBuf, source: io::Error },
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(
        "recording failed: {reason}; {written} messages written, {dropped} lost; `squealcast recover` repairs its files"
    )]
    Failed { reason: String, written: u64, dropped: u64 },
    #[error("the recorder did not finish within {0:?}: the disk does not respond; written messages can be recovered")]
    Timeout(Duration),
    #[error("the recorder's thread ended unexpectedly; written messages can be recovered")]
    Panicked,
}

/// Whether messages are being written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum State {
    Recording,
    /// Messages are not being written, and why. The recorder keeps trying to begin a new file.
    Failed(String),
    Finished,
}

/// Status of a recorder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    pub state: State,
    /// The recording's directory; until that could be created, the record directory.
    pub directory: PathBuf,
    /// Messages in the files. Those of the last half second may still be in memory.
    pub messages_written: u64,
    /// Bytes in the files.
    pub bytes_written: u64,
    /// Messages dropped because the queue was full.
    pub dropped_queue_full: u64,
    /// Messages lost because they could not be written or because their file was removed. Messages since the last flush
    /// before a failure count too, although a recovery may restore some of them.
    pub dropped_failed: u64,
    /// Messages in the queue, and its capacity.
    pub queued: usize,
    pub queue_capacity: usize,
    /// The longest time for which a disk operation held up the queue.
    pub longest_stall: Duration,
    /// The latest error, even if recording has resumed since.
    pub last_error: Option<String>,
    /// Files cut short by a failure; `recover` finishes them.
    pub interrupted: Vec<PathBuf>,
    /// Interrupted recordings in the record directory: those that were repaired, and the errors of those that were not.
    pub recovered: Vec<Recovery>,
    pub unrecovered: Vec<String>,
}

impl Status {
    /// Number of messages that are in no file.
    pub fn dropped(&self) -> u64 {
        self.dropped_queue_full + self.dropped_failed
    }

    /// Why messages are in no file; `None` if none is missing.
    pub fn why_dropped(&self) -> Option<String> {
        let (full, failed) = (self.dropped_queue_full, self.dropped_failed);
        let full = (full > 0).then(|| {
            format!(
                "{full} dropped because the queue of {} messages was full; the disk blocked the recorder for at most {:.1} s",
                self.queue_capacity,
                self.longest_stall.as_secs_f64()
            )
        });
        let failed = (failed > 0).then(|| {
            let error = self.last_error.as_deref().unwrap_or("the recorder had ended");
            format!("{failed} could not be written: {error}")
        });
        let reasons: Vec<String> = full.into_iter().chain(failed).collect();
        (!reasons.is_empty()).then(|| reasons.join("; "))
    }

    /// The current problem to show to users; `None` if there is none.
    pub fn problem(&self) -> Option<String> {
        match (&self.state, self.why_dropped()) {
            (State::Failed(why), _) => Some(format!("not recording: {why}")),
            (State::Recording | State::Finished, Some(why)) => Some(format!("messages not recorded: {why}")),
            (State::Recording | State::Finished, None) => None,
        }
    }
}

/// A finished recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finished {
    pub directory: PathBuf,
    /// In order.
    pub files: Vec<PathBuf>,
    pub status: Status,
}

/// State shared between the recorder's thread and its handles.
#[derive(Debug)]
struct Shared {
    messages_written: AtomicU64,
    bytes_written: AtomicU64,
    dropped_queue_full: AtomicU64,
    dropped_failed: AtomicU64,
    longest_stall_ns: AtomicU64,
    condition: Mutex<Condition>,
}

#[derive(Debug)]
struct Condition {
    state: State,
    directory: PathBuf,
    last_error: Option<String>,
    interrupted: Vec<PathBuf>,
    recovered: Vec<Recovery>,
    unrecovered: Vec<String>,
}

impl Shared {
    fn new(directory: PathBuf) -> Self {
        let condition = Condition {
            state: State::Recording,
            directory,
            last_error: None,
            interrupted: Vec::new(),
            recovered: Vec::new(),
            unrecovered: Vec::new(),
        };
        Self {
            messages_written: AtomicU64::new(0),
            bytes_written: AtomicU64::new(0),
            dropped_queue_full: AtomicU64::new(0),
            dropped_failed: AtomicU64::new(0),
            longest_stall_ns: AtomicU64::new(0),
            condition: Mutex::new(condition),
        }
    }

    fn condition(&self) -> MutexGuard<'_, Condition> {
        self.condition.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn failed(&self, reason: String) {
        let mut condition = self.condition();
        condition.last_error = Some(reason.clone());
        condition.state = State::Failed(reason);
    }
}

enum Command {
    // Boxed, because most slots of the queue are empty.
    Record(Box<Message>),
    Finish,
}

/// Passes messages to the recorder; cheap to clone.
#[derive(Clone, Debug)]
pub struct RecorderHandle {
    queue: Sender<Command>,
    shared: Arc<Shared>,
}

impl std::fmt::Debug for Command {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Record(_) => "Record",
            Self::Finish => "Finish",
        })
    }
}

impl RecorderHandle {
    /// Passes a message to the recorder without waiting. If the queue is full or the recorder has finished, the message
    /// is dropped and counted. Returns whether it was accepted.
    pub fn record(&self, message: Message) -> bool {
        let dropped = match self.queue.try_send(Command::Record(Box::new(message))) {
            Ok(()) => return true,
            Err(TrySendError::Full(_)) => &self.shared.dropped_queue_full,
            Err(TrySendError::Disconnected(_)) => &self.shared.dropped_failed,
        };
        dropped.fetch_add(1, Relaxed);
        false
    }

    /// Number of messages in the queue.
    pub fn queued(&self) -> usize {
        self.queue.len()
    }

    /// The current status.
    pub fn status(&self) -> Status {
        let condition = self.shared.condition();
        Status {
            state: condition.state.clone(),
            directory: condition.directory.clone(),
            messages_written: self.shared.messages_written.load(Relaxed),
            bytes_written: self.shared.bytes_written.load(Relaxed),
            dropped_queue_full: self.shared.dropped_queue_full.load(Relaxed),
            dropped_failed: self.shared.dropped_failed.load(Relaxed),
            queued: self.queue.len(),
            queue_capacity: self.queue.capacity().unwrap_or(usize::MAX),
            longest_stall: Duration::from_nanos(self.shared.longest_stall_ns.load(Relaxed)),
            last_error: condition.last_error.clone(),
            interrupted: condition.interrupted.clone(),
            recovered: condition.recovered.clone(),
            unrecovered: condition.unrecovered.clone(),
        }
    }
}

/// A recording in progress. If it is dropped without [`finish`](Self::finish), the files are still finished but errors
/// are not reported.
#[derive(Debug)]
pub struct Recorder {
    handle: RecorderHandle,
    done: Receiver<Vec<PathBuf>>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Creates the recording's directory and first file, and starts the thread. Meanwhile another thread repairs
    /// interrupted recordings in the record directory; see [`Status::recovered`].
    ///
    /// # Errors
    ///
    /// The directory or the first file cannot be written.
    pub fn start(config: RecorderConfig) -> Result<Self, RecorderError> {
        Self::start_unless(config, |_| true)
    }

    /// As [`start`](Self::start), but a full or read-only disk is not an error: recording begins as soon as it is
    /// possible. Until then messages are counted as lost.
    ///
    /// # Errors
    ///
    /// The directory or the first file cannot be written for any other reason.
    pub fn start_when_possible(config: RecorderConfig) -> Result<Self, RecorderError> {
        Self::start_unless(config, |error| !may_pass(error))
    }

    fn start_unless(config: RecorderConfig, fatal: fn(&RecorderError) -> bool) -> Result<Self, RecorderError> {
        let shared = Arc::new(Shared::new(config.directory.clone()));
        let record_directory = config.directory.clone();
        let (queue, commands) = crossbeam_channel::bounded(config.queue_messages.max(1));
        let (done_sender, done) = crossbeam_channel::bounded(1);
        let mut worker = Worker::new(config, Arc::clone(&shared));
        match worker.open() {
            Err(error) if fatal(&error) => return Err(error),
            Err(error) => shared.failed(chain(&error)),
            Ok(()) => {}
        }
        let spawn_error = |source| RecorderError::Directory { path: record_directory.clone(), source };
        let ended = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || match catch_unwind(AssertUnwindSafe(|| worker.run(&commands))) {
                Ok(files) => drop(done_sender.send(files)),
                Err(_) => {
                    ended.failed("internal error in the recorder".to_owned());
                    // Not dropped: dropping would write again.
                    let _ = catch_unwind(AssertUnwindSafe(|| worker.abandon()));
                }
            })
            .map_err(spawn_error)?;
        let (leftovers, directory) = (Arc::clone(&shared), record_directory.clone());
        std::thread::Builder::new()
            .name("recover".to_owned())
            .spawn(move || recover_leftovers(&directory, &leftovers))
            .map_err(spawn_error)?;
        Ok(Self { handle: RecorderHandle { queue, shared }, done, thread: Some(thread) })
    }

    /// A handle through which other threads record.
    pub fn handle(&self) -> RecorderHandle {
        self.handle.clone()
    }

    /// See [`RecorderHandle::record`].
    pub fn record(&self, message: Message) -> bool {
        self.handle.record(message)
    }

    /// See [`RecorderHandle::status`].
    pub fn status(&self) -> Status {
        self.handle.status()
    }

    /// Writes the queued messages and finishes the files, within `limit`.
    ///
    /// # Errors
    ///
    /// Recording has failed and not resumed, a file could not be finished, or `limit` was exceeded. What was written
    /// remains and can be recovered if necessary.
    pub fn finish(mut self, limit: Duration) -> Result<Finished, RecorderError> {
        let deadline = Instant::now() + limit;
        match self.handle.queue.send_timeout(Command::Finish, limit) {
            // Disconnected: the thread has ended, which is detected below.
            Ok(()) | Err(SendTimeoutError::Disconnected(_)) => {}
            Err(SendTimeoutError::Timeout(_)) => {
                self.thread = None;
                return Err(RecorderError::Timeout(limit));
            }
        }
        let files = match self.done.recv_deadline(deadline) {
            Ok(files) => files,
            Err(RecvTimeoutError::Timeout) => {
                self.thread = None;
                return Err(RecorderError::Timeout(limit));
            }
            Err(RecvTimeoutError::Disconnected) => return Err(RecorderError::Panicked),
        };
        let status = self.handle.status();
        match &status.state {
            State::Failed(reason) => Err(RecorderError::Failed {
                reason: reason.clone(),
                written: status.messages_written,
                dropped: status.dropped(),
            }),
            State::Recording | State::Finished => Ok(Finished { directory: status.directory.clone(), files, status }),
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        let Some(thread) = self.thread.take() else { return };
        // Has no effect after `finish`, since the thread has then ended.
        if self.handle.queue.send_timeout(Command::Finish, Duration::from_secs(1)).is_ok() || thread.is_finished() {
            let _ = thread.join();
        }
    }
}

/// Whether a disk error may be temporary, for example until space is freed.
fn may_pass(error: &RecorderError) -> bool {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, ReadOnlyFilesystem, StorageFull};
    const EIO: i32 = 5;
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if let Some(error) = error.downcast_ref::<io::Error>() {
            let passing = [FileTooLarge, QuotaExceeded, ReadOnlyFilesystem, StorageFull].contains(&error.kind());
            return passing || error.raw_os_error() == Some(EIO);
        }
        cause = error.source();
    }
    false
}

/// Creates `DIR/squealcast_<UTC time>` and returns it with its name. A second recording within the same second gets the
/// suffix `-2`.
fn make_directory(record_directory: &Path) -> Result<(PathBuf, String), RecorderError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| RecorderError::Directory { path, source }
    };
    fs::create_dir_all(record_directory).map_err(failed(record_directory))?;
    let name = format!("squealcast_{}", jiff::Timestamp::now().strftime("%Y-%m-%dT%H-%M-%SZ"));
    let mut attempt = 1;
    loop {
        let base = if attempt == 1 { name.clone() } else { format!("{name}-{attempt}") };
        let path = record_directory.join(&base);
        match fs::create_dir(&path) {
            Ok(()) => {
                sync_folder(folder_of(&path)).map_err(failed(&path))?;
                return Ok((path, base));
            }
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && attempt < 1000 => attempt += 1,
            Err(error) => return Err(failed(&path)(error)),
        }
    }
}

fn recover_leftovers(directory: &Path, shared: &Shared) {
    // The directory could not be created yet, so nothing can be left in it.
    if !directory.exists() {
        return;
    }
    let result = recover::recover_leftovers(directory);
    let mut condition = shared.condition();
    match result {
        Ok(report) => {
            // In use: our own file, or that of another process.
            let recoveries = report.recoveries.into_iter();
            condition.recovered.extend(recoveries.filter(|recovery| recovery.outcome != Outcome::InUse));
            condition.unrecovered.extend(report.errors.iter().map(|error| chain(error)));
        }
        Err(error) => condition.unrecovered.push(chain(&error)),
    }
}

/// The message of an error with those of its causes.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let words = error.to_string();
        if !text.ends_with(&words) {
            text = format!("{text}: {words}");
        }
        cause = error.source();
    }
    text
}
