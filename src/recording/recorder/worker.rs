//! The recorder's thread: writes the messages of the queue into successive files.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::{Arc, atomic::Ordering::Relaxed},
    time::{Duration, Instant},
};

use crossbeam_channel::{Receiver, RecvTimeoutError};
use mcap::records::Metadata;

use super::{Command, FORMAT, METADATA_NAME, RecorderConfig, RecorderError, Shared, State, chain, make_directory};
use crate::msgs::{SessionEventKind, schema::Topic};
use crate::recording::bag::{self, FileSummary};
use crate::recording::mcap_file::{RecordingFile, Whereabouts, WriteError};
use crate::recording::message::{Message, Payload};
use crate::recording::record_walker::Attachment;
use crate::recording::recover::ACTIVE;

/// Free space required before a new file is begun after a failure, bytes, so that it does not fail again at once.
const WANTED_FREE_BYTES: u64 = 32 << 20;

/// A message that is repeated at the beginning of each file.
#[derive(Clone, Debug)]
struct Repeated {
    topic: Topic,
    publish_time_ns: u64,
    cdr: Vec<u8>,
}

/// Messages that a replay needs before the first input, in the order in which a session receives them. The newest message of each
/// kind is repeated at the beginning of each file.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum InForce {
    Rig,
    Setting(String),
    Temperature,
    StabilityMap,
    /// The window ends of that map.
    WindowEnds,
    Chart,
}

impl InForce {
    fn of(payload: &Payload) -> Option<Self> {
        match payload {
            Payload::RigInfo(_) => Some(Self::Rig),
            Payload::SessionEvent(event) => match SessionEventKind::of(event)? {
                SessionEventKind::Parameter => Some(Self::Setting(event.name.clone())),
                SessionEventKind::Temperature => Some(Self::Temperature),
                SessionEventKind::StabilityMap => Some(Self::StabilityMap),
                SessionEventKind::WindowEnds => Some(Self::WindowEnds),
                SessionEventKind::Chart => Some(Self::Chart),
                // A silence ends with the next input.
                SessionEventKind::Silence => None,
            },
            Payload::OperatingPoint(_)
            | Payload::Prediction(_)
            | Payload::Sensitivity(_)
            | Payload::Diagnostics(_)
            | Payload::Vibration(_)
            | Payload::Waveform(_)
            | Payload::Heard(_)
            | Payload::Temperature(_) => None,
        }
    }

    /// Those that no longer hold once this one changes: window ends belong to their map, and everything that was computed
    /// belongs to the rig at its temperature.
    fn outdates(&self) -> &'static [Self] {
        match self {
            Self::StabilityMap => &[Self::WindowEnds],
            Self::Temperature => &[Self::StabilityMap, Self::WindowEnds, Self::Chart],
            Self::Rig | Self::Setting(_) | Self::WindowEnds | Self::Chart => &[],
        }
    }
}

/// A file that is no longer written to.
#[derive(Clone, Debug)]
struct Closed {
    path: PathBuf,
    messages: u64,
    bytes: u64,
    finished: bool,
}

/// State of the recorder's thread.
pub(super) struct Worker {
    config: RecorderConfig,
    shared: Arc<Shared>,
    /// The recording's directory and its name, once created.
    directory: Option<(PathBuf, String)>,
    file: Option<RecordingFile>,
    next_split: u32,
    /// The finished files of `directory`, listed in its `metadata.yaml`.
    listed: Vec<FileSummary>,
    /// The files of all directories, in order.
    closed: Vec<Closed>,
    /// Messages in `file` since the last flush; a failure would lose them.
    unflushed: u64,
    unsynced: bool,
    last_log_time_ns: Option<u64>,
    /// First log time of `file`.
    file_start_ns: Option<u64>,
    sequences: BTreeMap<Topic, u32>,
    in_force: BTreeMap<InForce, Repeated>,
    /// Whether `file` contains no message yet.
    begins: bool,
}

impl Worker {
    pub(super) fn new(config: RecorderConfig, shared: Arc<Shared>) -> Self {
        Self {
            config,
            shared,
            directory: None,
            file: None,
            next_split: 0,
            listed: Vec::new(),
            closed: Vec::new(),
            unflushed: 0,
            unsynced: false,
            last_log_time_ns: None,
            file_start_ns: None,
            sequences: BTreeMap::new(),
            in_force: BTreeMap::new(),
            begins: false,
        }
    }

    /// Handles commands until [`Command::Finish`]; returns the finished files.
    pub(super) fn run(&mut self, commands: &Receiver<Command>) -> Vec<PathBuf> {
        let mut next_flush = Instant::now() + self.config.flush_interval;
        let mut next_sync = Instant::now() + self.config.sync_interval;
        let mut next_retry = Instant::now() + self.config.retry_interval;
        loop {
            let command = commands.recv_deadline(next_flush.min(next_sync));
            let began = Instant::now();
            match command {
                Ok(Command::Record(message)) => self.record(*message),
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
            self.note_stall(began.elapsed());
        }
        self.finish_file();
        let mut condition = self.shared.condition();
        if condition.state == State::Recording {
            condition.state = State::Finished;
        }
        self.closed.iter().filter(|closed| closed.finished).map(|closed| closed.path.clone()).collect()
    }

    /// Stops writing, as if the process had been killed.
    pub(super) fn abandon(&mut self) {
        self.file.take().map(RecordingFile::abandon);
    }

    fn note_stall(&self, stall: Duration) {
        let stall_ns = u64::try_from(stall.as_nanos()).unwrap_or(u64::MAX);
        self.shared.longest_stall_ns.fetch_max(stall_ns, Relaxed);
    }

    fn record(&mut self, message: Message) {
        let topic = message.payload.topic();
        let cdr = match message.payload.to_cdr() {
            Ok(cdr) => cdr,
            Err(error) => {
                self.shared.dropped_failed.fetch_add(1, Relaxed);
                self.shared.condition().last_error = Some(format!("{}: {error}", topic.name()));
                return;
            }
        };
        // A prediction stays in the file of its input. Samples come from another thread, possibly between the two.
        if !matches!(topic, Topic::Prediction | Topic::Waveform) && self.split_is_due(message.log_time_ns) {
            self.finish_file();
            if self.shared.condition().state == State::Recording {
                self.resume();
            }
        }
        if self.file.is_some() && self.begins && topic == Topic::Prediction {
            // Its input is not in this file, and without it the prediction cannot be verified.
            self.shared.dropped_failed.fetch_add(1, Relaxed);
            return;
        }
        if self.file.is_some() && std::mem::take(&mut self.begins) {
            self.repeat(message.log_time_ns);
        }
        if let Some(kind) = InForce::of(&message.payload) {
            for outdated in kind.outdates() {
                self.in_force.remove(outdated);
            }
            let repeated = Repeated { topic, publish_time_ns: message.publish_time_ns, cdr: cdr.clone() };
            self.in_force.insert(kind, repeated);
            if self.file.is_none() {
                return; // not lost: the next file begins with it
            }
        }
        self.append(topic, message.log_time_ns, message.publish_time_ns, &cdr);
    }

    fn split_is_due(&self, log_time_ns: u64) -> bool {
        self.file.as_ref().is_some_and(|file| {
            let span_ns = log_time_ns.saturating_sub(self.file_start_ns.unwrap_or(log_time_ns));
            file.summary().messages() > 0
                && (file.bytes_written() >= self.config.split_bytes
                    || u128::from(span_ns) >= self.config.split_duration.as_nanos())
        })
    }

    /// Repeats the messages in force at the beginning of a file that follows others.
    fn repeat(&mut self, log_time_ns: u64) {
        for Repeated { topic, publish_time_ns, cdr } in self.in_force.values().cloned().collect::<Vec<_>>() {
            if self.file.is_some() {
                self.append(topic, log_time_ns, publish_time_ns, &cdr);
            }
        }
    }

    /// Writes a message. Its log time is raised if necessary, so that log times increase strictly.
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
        let closed: u64 = self.closed.iter().map(|closed| closed.bytes).sum();
        self.shared.bytes_written.store(closed + open, Relaxed);
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

    /// Syncs the flushed data to the disk and checks that the file is still at its place.
    fn sync(&mut self) {
        if !std::mem::take(&mut self.unsynced) {
            return;
        }
        let Some(file) = &self.file else { return };
        if let Err(error) = file.sync() {
            return self.fail(&error);
        }
        match file.whereabouts() {
            Ok(Whereabouts::InPlace) => {}
            Ok(Whereabouts::Moved(_) | Whereabouts::Removed) => {
                self.finish_file();
                self.resume();
            }
            Err(source) => {
                let error = WriteError::io(file.temporary(), source);
                self.fail(&error);
            }
        }
    }

    /// Begins the next file, in a new directory if there is none. Attachments and metadata are written first, so that
    /// they survive a later failure.
    pub(super) fn open(&mut self) -> Result<(), RecorderError> {
        // Messages before the first file are lost: number the files as if those had been one.
        if self.next_split == 0 && !self.in_force.is_empty() {
            self.next_split = 1;
        }
        let known = self.directory.take().filter(|(directory, _)| directory.is_dir());
        let made = known.is_none();
        let (directory, base) = match known {
            Some(known) => known,
            None => {
                self.listed.clear();
                make_directory(&self.config.directory)?
            }
        };
        match self.open_in(&directory, &base) {
            Ok(file) => {
                self.next_split += 1;
                self.file_start_ns = None;
                self.begins = true;
                self.file = Some(file);
                self.shared.condition().directory.clone_from(&directory);
                self.directory = Some((directory, base));
                Ok(())
            }
            Err(error) => {
                if made {
                    // The directory is empty.
                    let _ = fs::remove_dir(&directory);
                } else {
                    self.directory = Some((directory, base));
                }
                Err(error.into())
            }
        }
    }

    fn open_in(&self, directory: &Path, base: &str) -> Result<RecordingFile, WriteError> {
        let path = directory.join(format!("{base}_{}.mcap", self.next_split));
        let mut file = RecordingFile::create(&path, ACTIVE, Arc::clone(&self.config.disk))?;
        match self.write_head(&mut file) {
            Ok(()) => Ok(file),
            Err(error) => {
                // The file contains nothing worth recovering.
                let _ = fs::remove_file(file.abandon());
                Err(error)
            }
        }
    }

    fn write_head(&self, file: &mut RecordingFile) -> Result<(), WriteError> {
        let now = jiff::Timestamp::now();
        let now_ns = u64::try_from(now.as_nanosecond()).unwrap_or(0);
        let entries = [
            ("format", FORMAT.to_string()),
            ("session_id", self.config.session_id.clone()),
            ("squealcast_version", env!("CARGO_PKG_VERSION").to_owned()),
            ("rig_name", self.config.rig_name.clone()),
            ("rig_content_hash", self.config.rig_content_hash.clone()),
            ("split_index", self.next_split.to_string()),
            ("started_utc", now.to_string()),
        ];
        let metadata = entries.into_iter().map(|(key, value)| (key.to_owned(), value));
        let metadata = metadata.chain(self.config.metadata.iter().cloned()).collect();
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

    /// Finishes the open file, even if its directory was moved, and lists it in the `metadata.yaml` there.
    fn finish_file(&mut self) {
        let Some(file) = self.file.take() else { return };
        let at = file.whereabouts();
        if matches!(at, Ok(Whereabouts::Removed)) {
            return self.removed(file);
        }
        let known = self.directory.as_ref().map_or(&self.config.directory, |(directory, _)| directory).clone();
        let (directory, moved) = match at {
            Ok(Whereabouts::Moved(to)) => (to, true),
            Ok(Whereabouts::InPlace | Whereabouts::Removed) | Err(_) => (known, false),
        };
        let messages = file.summary().messages();
        let (bytes, temporary) = (file.bytes_written(), file.temporary().to_owned());
        match file.finish() {
            Ok(summary) => {
                let path = directory.join(&summary.name);
                let bytes = fs::metadata(&path).map_or(bytes, |file| file.len());
                self.unflushed = 0;
                self.unsynced = false;
                self.closed.push(Closed { path, messages, bytes, finished: true });
                self.listed.push(summary);
            }
            Err(error) => {
                let bytes = fs::metadata(&temporary).map_or(bytes, |file| file.len());
                self.interrupted(temporary, messages - self.unflushed, bytes);
                self.fail(&error);
            }
        }
        self.count_bytes();
        if let Err(error) = bag::write_metadata(&directory, &self.listed) {
            self.fail(&error.into());
        }
        if moved {
            self.leave(&directory);
        }
    }

    /// Leaves the recording's directory, which was moved with all its files; the next file is begun in a new one.
    fn leave(&mut self, to: &Path) {
        let Some((from, _)) = self.directory.take() else { return };
        for closed in &mut self.closed {
            if let (Some(folder), Some(name)) = (closed.path.parent(), closed.path.file_name())
                && folder == from
            {
                closed.path = to.join(name);
            }
        }
        let what = format!("{} was moved to {} while it was recorded", from.display(), to.display());
        self.shared.condition().last_error = Some(what);
    }

    /// Counts the messages of a removed file as lost, with those of other files of the recording that were removed with
    /// it.
    fn removed(&mut self, file: RecordingFile) {
        let (messages, path) = (file.summary().messages() - self.unflushed, file.abandon());
        let (there, gone): (Vec<_>, Vec<_>) = self.closed.drain(..).partition(|closed| closed.path.exists());
        self.closed = there;
        let lost = messages + gone.iter().map(|closed| closed.messages).sum::<u64>();
        self.shared.messages_written.fetch_sub(lost, Relaxed);
        self.shared.dropped_failed.fetch_add(lost, Relaxed);
        self.listed.retain(|file| path.with_file_name(&file.name).exists());
        self.shared.condition().interrupted.retain(|interrupted| interrupted.exists());
        self.give_up(format!("{} was removed while it was recorded", path.display()));
    }

    /// Abandons the open file as it is. A new one is begun as soon as possible.
    fn fail(&mut self, error: &WriteError) {
        if let Some(file) = self.file.take() {
            if file.whereabouts().is_ok_and(|at| at == Whereabouts::Removed) {
                return self.removed(file);
            }
            let (messages, bytes) = (file.summary().messages() - self.unflushed, file.bytes_written());
            self.interrupted(file.abandon(), messages, bytes);
        }
        self.give_up(chain(error));
    }

    fn interrupted(&mut self, path: PathBuf, messages: u64, bytes: u64) {
        self.shared.condition().interrupted.push(path.clone());
        self.closed.push(Closed { path, messages, bytes, finished: false });
    }

    /// Counts unflushed messages as lost and sets the reason why recording has failed.
    fn give_up(&mut self, reason: String) {
        let unflushed = std::mem::take(&mut self.unflushed);
        self.shared.messages_written.fetch_sub(unflushed, Relaxed);
        self.shared.dropped_failed.fetch_add(unflushed, Relaxed);
        self.unsynced = false;
        self.count_bytes();
        self.shared.failed(reason);
    }

    /// Begins a new file if there is enough free space.
    fn retry(&mut self) {
        let there = self.config.directory.ancestors().find(|path| path.is_dir());
        let there = there.unwrap_or(Path::new("."));
        if !self.config.disk.free_bytes(there).is_ok_and(|free| free < WANTED_FREE_BYTES) {
            self.resume();
        }
    }

    fn resume(&mut self) {
        match self.open() {
            Ok(()) => self.shared.condition().state = State::Recording,
            Err(error) => self.shared.failed(chain(&error)),
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
