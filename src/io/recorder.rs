//! Records messages on a thread of its own: nobody waits for the disk.
//!
//! A recording is a rosbag2 directory `DIR/squealcast_<UTC time>/` of MCAP files `squealcast_<UTC time>_0.mcap`, `_1` ...
//! and `metadata.yaml`. Each file carries the rig files as attachments, a metadata record and the latched messages, so
//! that it can be replayed alone. While it is written a file is named `*.mcap.active`.

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crossbeam_channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender};
use mcap::records::Metadata;

use super::{
    bag::{self, FileSummary},
    message::Message,
    record_walker::Attachment,
    recording_file::{Disk, FileSystem, RecordingFile, WriteError},
    recover::{self, ACTIVE, Outcome, Recovery},
};
use crate::{rig::RigFile, wire::schema::Topic};

/// The name of the metadata record each file carries. Its keys: `session_id`, `squealcast_version`, `rig_name`,
/// `rig_content_hash`, `split_index`, `started_utc`.
pub const METADATA_NAME: &str = "squealcast";

/// A new file after a failure wants this much space, so that it does not fail at once again.
const WANTED_FREE_BYTES: u64 = 32 << 20;

/// What to record, where, and how.
#[derive(Clone, Debug)]
pub struct RecorderConfig {
    /// The recording's directory is made in this one, which is made too if need be.
    pub directory: PathBuf,
    pub rig_name: String,
    pub rig_content_hash: String,
    /// Attached to every file.
    pub rig_files: Vec<RigFile>,
    /// Tells recordings of one run from others.
    pub session_id: String,
    /// A file that has grown to this size, bytes, is followed by another.
    pub split_bytes: u64,
    /// A file that spans this much log time is followed by another.
    pub split_duration: Duration,
    /// Messages that may wait for the disk; more are dropped and counted.
    pub queue_messages: usize,
    /// A killed process loses this much at most.
    pub flush_interval: Duration,
    /// A power failure loses this much at most.
    pub sync_interval: Duration,
    /// After a failure a new file is tried this often.
    pub retry_interval: Duration,
    /// Where bytes go.
    pub disk: Arc<dyn Disk>,
}

impl RecorderConfig {
    /// The usual settings: files of 1 GiB or an hour, 8192 messages, flush every 0.5 s, fdatasync every 2 s.
    pub fn new(directory: impl Into<PathBuf>) -> Self {
        Self {
            directory: directory.into(),
            rig_name: String::new(),
            rig_content_hash: String::new(),
            rig_files: Vec::new(),
            session_id: format!("{:032x}", rand::random::<u128>()),
            split_bytes: 1 << 30,
            split_duration: Duration::from_secs(3600),
            queue_messages: 8192,
            flush_interval: Duration::from_millis(500),
            sync_interval: Duration::from_secs(2),
            retry_interval: Duration::from_secs(2),
            disk: Arc::new(FileSystem),
        }
    }
}

/// Why nothing is recorded, or not everything was.
#[derive(Debug, thiserror::Error)]
pub enum RecorderError {
    #[error("cannot record into {}: {source}", .path.display())]
    Directory { path: PathBuf, source: io::Error },
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("recording failed: {reason}; {written} messages written, {dropped} lost")]
    Failed { reason: String, written: u64, dropped: u64 },
    #[error("the recorder did not finish within {0:?}: the disk does not answer; what is written can be recovered")]
    Timeout(Duration),
    #[error("the recorder's thread ended unexpectedly; what is written can be recovered")]
    Panicked,
}

/// Whether messages reach the disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum State {
    Recording,
    /// They do not, and why; a new file is begun when there is space again.
    Failed(String),
    Finished,
}

/// How the recorder does.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    pub state: State,
    /// The recording's directory.
    pub directory: PathBuf,
    /// Messages in the files; those of the last half second may still be in memory.
    pub messages_written: u64,
    /// Bytes in the files.
    pub bytes_written: u64,
    /// Messages that found the queue full.
    pub dropped_queue_full: u64,
    /// Messages lost because they could not be written, and those since the last flush before a failure, of which some
    /// may be in what is recovered.
    pub dropped_failed: u64,
    /// Messages that wait for the disk.
    pub queued: usize,
    /// What was last wrong, past failures included.
    pub last_error: Option<String>,
    /// Leftovers of interrupted recordings in the record directory that were repaired, in words for those that were not.
    pub recovered: Vec<Recovery>,
    pub unrecovered: Vec<String>,
}

impl Status {
    /// All messages that are in no file.
    pub fn dropped(&self) -> u64 {
        self.dropped_queue_full + self.dropped_failed
    }
}

/// What a finished recording consists of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finished {
    pub directory: PathBuf,
    /// In order.
    pub files: Vec<PathBuf>,
    pub status: Status,
}

#[derive(Debug)]
struct Shared {
    directory: PathBuf,
    messages_written: AtomicU64,
    bytes_written: AtomicU64,
    dropped_queue_full: AtomicU64,
    dropped_failed: AtomicU64,
    told: Mutex<Told>,
}

#[derive(Debug)]
struct Told {
    state: State,
    last_error: Option<String>,
    recovered: Vec<Recovery>,
    unrecovered: Vec<String>,
}

impl Shared {
    fn told(&self) -> MutexGuard<'_, Told> {
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

enum Command {
    Record(Message),
    Finish,
}

/// Takes messages for the recorder; clone it freely.
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
    /// Hands a message to the recorder and never waits: when the queue is full, or the recorder has finished, the
    /// message is dropped and counted. Whether it was taken.
    pub fn record(&self, message: Message) -> bool {
        let taken = self.queue.try_send(Command::Record(message)).is_ok();
        if !taken {
            self.shared.dropped_queue_full.fetch_add(1, Relaxed);
        }
        taken
    }

    /// How the recorder does.
    pub fn status(&self) -> Status {
        let told = self.shared.told();
        Status {
            state: told.state.clone(),
            directory: self.shared.directory.clone(),
            messages_written: self.shared.messages_written.load(Relaxed),
            bytes_written: self.shared.bytes_written.load(Relaxed),
            dropped_queue_full: self.shared.dropped_queue_full.load(Relaxed),
            dropped_failed: self.shared.dropped_failed.load(Relaxed),
            queued: self.queue.len(),
            last_error: told.last_error.clone(),
            recovered: told.recovered.clone(),
            unrecovered: told.unrecovered.clone(),
        }
    }
}

/// A recording in progress. Dropped without [`finish`](Self::finish) it still ends in order, but nobody hears of errors.
#[derive(Debug)]
pub struct Recorder {
    handle: RecorderHandle,
    done: Receiver<Vec<PathBuf>>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Makes the recording's directory and first file, and starts the thread. Leftovers of interrupted recordings in
    /// the record directory are repaired on another thread meanwhile; see [`Status::recovered`].
    ///
    /// # Errors
    ///
    /// A directory or first file that cannot be written.
    pub fn start(config: RecorderConfig) -> Result<Self, RecorderError> {
        let (directory, base) = make_directory(&config.directory)?;
        let shared = Arc::new(Shared {
            directory: directory.clone(),
            messages_written: AtomicU64::new(0),
            bytes_written: AtomicU64::new(0),
            dropped_queue_full: AtomicU64::new(0),
            dropped_failed: AtomicU64::new(0),
            told: Mutex::new(Told {
                state: State::Recording,
                last_error: None,
                recovered: Vec::new(),
                unrecovered: Vec::new(),
            }),
        });
        let record_directory = config.directory.clone();
        let (queue, commands) = crossbeam_channel::bounded(config.queue_messages.max(1));
        let (done_sender, done) = crossbeam_channel::bounded(1);
        let mut worker = Worker::new(config, directory.clone(), base, Arc::clone(&shared));
        if let Err(error) = worker.open() {
            let _ = fs::remove_dir(&directory);
            return Err(error.into());
        }
        let spawn_error = |source| RecorderError::Directory { path: directory.clone(), source };
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || {
                let files = worker.run(&commands);
                let _ = done_sender.send(files);
            })
            .map_err(spawn_error)?;
        let leftovers = Arc::clone(&shared);
        std::thread::Builder::new()
            .name("recover".to_owned())
            .spawn(move || recover_leftovers(&record_directory, &leftovers))
            .map_err(spawn_error)?;
        Ok(Self { handle: RecorderHandle { queue, shared }, done, thread: Some(thread) })
    }

    /// Something to record with from elsewhere.
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

    /// Writes what is queued and finishes the files, within `limit`.
    ///
    /// # Errors
    ///
    /// Recording has failed and not resumed, something could not be finished, or it took longer than `limit`; what was
    /// written is there, and can be recovered if need be.
    pub fn finish(mut self, limit: Duration) -> Result<Finished, RecorderError> {
        let deadline = Instant::now() + limit;
        match self.handle.queue.send_timeout(Command::Finish, limit) {
            // Disconnected: the thread has ended; below that shows.
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
        // Does nothing when `finish` was called: then the thread has ended.
        if self.handle.queue.send_timeout(Command::Finish, Duration::from_secs(1)).is_ok() || thread.is_finished() {
            let _ = thread.join();
        }
    }
}

/// `DIR/squealcast_<UTC time>`, and its name. A second recording within the second gets `-2` behind it.
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
            Ok(()) => return Ok((path, base)),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && attempt < 1000 => attempt += 1,
            Err(error) => return Err(failed(&path)(error)),
        }
    }
}

fn recover_leftovers(directory: &Path, shared: &Shared) {
    let result = recover::recover_leftovers(directory);
    let mut told = shared.told();
    match result {
        Ok(report) => {
            // In use: our own file, or another process's.
            let recoveries = report.recoveries.into_iter();
            told.recovered.extend(recoveries.filter(|recovery| recovery.outcome != Outcome::InUse));
            told.unrecovered.extend(report.errors.iter().map(|error| chain(error)));
        }
        Err(error) => told.unrecovered.push(chain(&error)),
    }
}

/// The last message of a latched topic.
#[derive(Clone, Debug)]
struct Latched {
    log_time_ns: u64,
    publish_time_ns: u64,
    cdr: Vec<u8>,
}

/// What the thread works with.
struct Worker {
    config: RecorderConfig,
    directory: PathBuf,
    base: String,
    shared: Arc<Shared>,
    file: Option<RecordingFile>,
    next_split: u32,
    finished: Vec<FileSummary>,
    /// Bytes in files that are closed.
    closed_bytes: u64,
    /// Messages in `file` that a failure would lose.
    unflushed: u64,
    unsynced: bool,
    last_log_time_ns: Option<u64>,
    /// First log time of `file`.
    file_start_ns: Option<u64>,
    sequences: BTreeMap<Topic, u32>,
    latched: BTreeMap<Topic, Latched>,
}

impl Worker {
    fn new(config: RecorderConfig, directory: PathBuf, base: String, shared: Arc<Shared>) -> Self {
        Self {
            config,
            directory,
            base,
            shared,
            file: None,
            next_split: 0,
            finished: Vec::new(),
            closed_bytes: 0,
            unflushed: 0,
            unsynced: false,
            last_log_time_ns: None,
            file_start_ns: None,
            sequences: BTreeMap::new(),
            latched: BTreeMap::new(),
        }
    }

    /// Takes commands until told to finish; the finished files.
    fn run(&mut self, commands: &Receiver<Command>) -> Vec<PathBuf> {
        let mut next_flush = Instant::now() + self.config.flush_interval;
        let mut next_sync = Instant::now() + self.config.sync_interval;
        let mut next_retry = Instant::now();
        loop {
            match commands.recv_deadline(next_flush.min(next_sync)) {
                Ok(Command::Record(message)) => self.record(message),
                Ok(Command::Finish) | Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {}
            }
            let now = Instant::now();
            if now >= next_flush {
                self.flush();
                next_flush = now + self.config.flush_interval;
            }
            if now >= next_sync {
                self.sync();
                next_sync = now + self.config.sync_interval;
            }
            if self.file.is_none() && now >= next_retry {
                self.retry();
                next_retry = Instant::now() + self.config.retry_interval;
            }
        }
        self.finish_file();
        let mut told = self.shared.told();
        if told.state == State::Recording {
            told.state = State::Finished;
        }
        self.finished.iter().map(|file| self.directory.join(&file.name)).collect()
    }

    fn record(&mut self, message: Message) {
        let topic = message.payload.topic();
        let cdr = match message.payload.to_cdr() {
            Ok(cdr) => cdr,
            Err(error) => {
                self.shared.dropped_failed.fetch_add(1, Relaxed);
                self.shared.told().last_error = Some(format!("{}: {error}", topic.name()));
                return;
            }
        };
        let due = self.file.as_ref().is_some_and(|file| {
            let span_ns = message.log_time_ns.saturating_sub(self.file_start_ns.unwrap_or(message.log_time_ns));
            file.summary().messages() > 0
                && (file.bytes_written() >= self.config.split_bytes
                    || u128::from(span_ns) >= self.config.split_duration.as_nanos())
        });
        if due {
            self.finish_file();
            if self.file.is_none()
                && self.shared.told().state == State::Recording
                && let Err(error) = self.open()
            {
                self.fail(&error);
            }
        }
        if topic.is_latched() {
            let Message { log_time_ns, publish_time_ns, .. } = message;
            self.latched.insert(topic, Latched { log_time_ns, publish_time_ns, cdr: cdr.clone() });
        }
        self.append(topic, message.log_time_ns, message.publish_time_ns, &cdr);
    }

    /// Writes a message with a log time later than that of the one before.
    fn append(&mut self, topic: Topic, log_time_ns: u64, publish_time_ns: u64, cdr: &[u8]) {
        let log_time_ns = match self.last_log_time_ns {
            Some(last) => log_time_ns.max(last.saturating_add(1)),
            None => log_time_ns,
        };
        let Some(file) = &mut self.file else {
            self.shared.dropped_failed.fetch_add(1, Relaxed);
            return;
        };
        let sequence = self.sequences.entry(topic).or_insert(0);
        let written = file
            .own_channel(topic)
            .and_then(|channel| file.write(channel, *sequence, log_time_ns, publish_time_ns, cdr));
        match written {
            Ok(()) => {
                *sequence = sequence.wrapping_add(1);
                self.last_log_time_ns = Some(log_time_ns);
                self.file_start_ns.get_or_insert(log_time_ns);
                self.unflushed += 1;
                self.unsynced = true;
                self.shared.messages_written.fetch_add(1, Relaxed);
                self.count_bytes();
            }
            Err(error) => {
                self.shared.dropped_failed.fetch_add(1, Relaxed);
                self.fail(&error);
            }
        }
    }

    fn count_bytes(&self) {
        let open = self.file.as_ref().map_or(0, RecordingFile::bytes_written);
        self.shared.bytes_written.store(self.closed_bytes + open, Relaxed);
    }

    fn flush(&mut self) {
        if self.unflushed == 0 {
            return;
        }
        match self.file.as_mut().map(RecordingFile::flush) {
            Some(Err(error)) => self.fail(&error),
            Some(Ok(())) => self.unflushed = 0,
            None => {}
        }
        self.count_bytes();
    }

    fn sync(&mut self) {
        if !std::mem::take(&mut self.unsynced) {
            return;
        }
        if let Some(Err(error)) = self.file.as_ref().map(RecordingFile::sync) {
            self.fail(&error);
        }
    }

    /// Begins the next file: attachments and metadata first, so that they survive whatever happens later.
    fn open(&mut self) -> Result<(), WriteError> {
        let path = self.directory.join(format!("{}_{}.mcap", self.base, self.next_split));
        let mut file = RecordingFile::create(&path, ACTIVE, Arc::clone(&self.config.disk))?;
        if let Err(error) = self.write_head(&mut file) {
            // There is nothing in it worth recovering.
            let _ = fs::remove_file(file.abandon());
            return Err(error);
        }
        self.next_split += 1;
        self.file_start_ns = None;
        self.file = Some(file);
        // A file that follows another begins with what late subscribers would get.
        for (topic, latched) in self.latched.clone() {
            self.append(topic, latched.log_time_ns, latched.publish_time_ns, &latched.cdr);
        }
        Ok(())
    }

    fn write_head(&self, file: &mut RecordingFile) -> Result<(), WriteError> {
        let now = jiff::Timestamp::now();
        let now_ns = u64::try_from(now.as_nanosecond()).unwrap_or(0);
        let entries = [
            ("session_id", self.config.session_id.clone()),
            ("squealcast_version", env!("CARGO_PKG_VERSION").to_owned()),
            ("rig_name", self.config.rig_name.clone()),
            ("rig_content_hash", self.config.rig_content_hash.clone()),
            ("split_index", self.next_split.to_string()),
            ("started_utc", now.to_string()),
        ];
        let metadata = entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        file.write_metadata(&Metadata { name: METADATA_NAME.to_owned(), metadata })?;
        for rig_file in &self.config.rig_files {
            file.attach(&Attachment {
                log_time_ns: now_ns,
                create_time_ns: now_ns,
                name: rig_file.name.clone(),
                media_type: media_type(&rig_file.name).to_owned(),
                data: rig_file.bytes.clone(),
            })?;
        }
        file.flush()
    }

    /// Finishes the open file and lists it in `metadata.yaml`.
    fn finish_file(&mut self) {
        let Some(file) = self.file.take() else { return };
        let (bytes, temporary) = (file.bytes_written(), file.temporary().to_owned());
        match file.finish() {
            Ok(summary) => {
                self.closed_bytes += fs::metadata(self.directory.join(&summary.name)).map_or(bytes, |meta| meta.len());
                self.unflushed = 0;
                self.unsynced = false;
                self.finished.push(summary);
            }
            Err(error) => {
                self.closed_bytes += fs::metadata(&temporary).map_or(bytes, |meta| meta.len());
                self.fail(&error);
            }
        }
        self.count_bytes();
        if let Err(error) = bag::write_metadata(&self.directory, &self.finished) {
            self.fail(&WriteError::io(&self.directory.join(bag::METADATA_FILE), error));
        }
    }

    /// Gives the open file up, as it is, until there is space for another.
    fn fail(&mut self, error: &WriteError) {
        if let Some(file) = self.file.take() {
            self.closed_bytes += file.bytes_written();
            file.abandon();
        }
        self.shared.messages_written.fetch_sub(self.unflushed, Relaxed);
        self.shared.dropped_failed.fetch_add(self.unflushed, Relaxed);
        self.unflushed = 0;
        self.unsynced = false;
        self.count_bytes();
        let reason = chain(error);
        let mut told = self.shared.told();
        told.last_error = Some(reason.clone());
        told.state = State::Failed(reason);
    }

    /// Begins another file if there is space for one.
    fn retry(&mut self) {
        if !matches!(self.config.disk.free_bytes(&self.directory), Ok(free) if free >= WANTED_FREE_BYTES) {
            return;
        }
        match self.open() {
            // The latched messages may have failed it again.
            Ok(()) if self.file.is_some() => self.shared.told().state = State::Recording,
            Ok(()) => {}
            Err(error) => self.fail(&error),
        }
    }
}

fn media_type(name: &str) -> &'static str {
    match Path::new(name).extension().and_then(|extension| extension.to_str()) {
        Some("toml") => "application/toml",
        Some("mtx" | "csv" | "txt") => "text/plain",
        _ => "application/octet-stream",
    }
}

/// An error with its causes.
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
