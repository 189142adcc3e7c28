//! Reads recordings: finished, interrupted, truncated or damaged; from this program or other ROS 2 programs.

use std::{
    collections::VecDeque,
    io::{self, Read},
    ops::RangeInclusive,
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::Arc,
    thread::JoinHandle,
};

use bytes::Bytes;
use crossbeam_channel::{Receiver, Sender, bounded};
use mcap::records::Metadata;

use super::bag;
use super::message::Payload;
use super::record_walker::{Attachment, Channel, Damage, Depth, Item, RawMessage, RecordWalker};
use super::recorder::{FORMAT, METADATA_NAME};
use super::topics::{ChoiceError, RecordedTopics, Unread};
use crate::files::input_file;
use crate::msgs::{CdrError, schema::Topic};

/// Messages are read ahead in batches: the largest number of messages in a batch, the unpacked bytes after which a
/// batch ends, and the number of batches kept ahead.
const BATCH: usize = 512;
const BATCH_BYTES: u64 = 8 << 20;
const BATCHES_AHEAD: usize = 2;
/// Limit on all attachments of a recording together, each counted once, bytes.
const MAX_ATTACHMENT_BYTES: usize = 2 << 30;

/// First bytes of files and messages in other formats.
const SQLITE_MAGIC: &[u8] = b"SQLite format 3\0";
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
const LZ4_MAGIC: [u8; 4] = [0x04, 0x22, 0x4d, 0x18];

/// Why a recording cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    #[error("{}: {source}", .path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}: not an MCAP file: it does not begin with its magic bytes", .path.display())]
    NotMcap { path: PathBuf },
    #[error("{}: a recording in the sqlite3 format, expected MCAP; `ros2 bag convert` converts it", .path.display())]
    Sqlite { path: PathBuf },
    #[error(
        "{}: an MCAP file that was compressed as a whole, expected one as it is or with compressed chunks; `ros2 bag convert` \
         converts it",
        .path.display()
    )]
    Compressed { path: PathBuf },
    #[error("{}: holds no *.mcap and no *.mcap.active file", .path.display())]
    NoFiles { path: PathBuf },
    #[error(
        "{}: a recording of format {found}, expected {expected} or earlier, which this version of squealcast reads",
        .path.display()
    )]
    Format { path: PathBuf, found: String, expected: u32 },
    #[error("{}: {source}", .path.display())]
    Choice { path: PathBuf, source: ChoiceError },
}

/// Options for reading a recording.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Recorded topics to read instead of the node's own topics of the same types; see [`RecordedTopics`].
    pub topics: Vec<String>,
}

/// A message of a recording.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Topic, type and encoding as recorded.
    pub channel: Arc<Channel>,
    pub sequence: u32,
    pub log_time_ns: u64,
    pub publish_time_ns: u64,
    /// CDR bytes as recorded, including the encapsulation header.
    pub cdr: Bytes,
    pub message: Recorded,
}

/// The content of an [`Entry`].
#[derive(Clone, Debug, PartialEq)]
pub enum Recorded {
    /// One of the node's messages.
    Known(Payload),
    /// A message that has the type of one of the node's but cannot be decoded, and why.
    Unreadable(String),
    /// Anything else.
    Other,
}

/// Damage, with the file it was found in.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}: {damage}", .file.display())]
pub struct FileDamage {
    pub file: PathBuf,
    pub damage: Damage,
}

/// A recording: a single file, or the files of a split recording in a directory.
#[derive(Debug)]
pub struct Recording {
    files: Vec<PathBuf>,
    topics: RecordedTopics,
    attachments: Vec<Attachment>,
    metadata: Vec<Metadata>,
    damage: Vec<FileDamage>,
}

impl Recording {
    /// Opens a recording: a file or a directory.
    ///
    /// # Errors
    ///
    /// The path cannot be read, contains no recording, or is not an MCAP file. Damage is not an error, see
    /// [`Self::damage`]; nor is a topic that cannot be read, see [`Self::topics`].
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Self::open_with(path, ReadOptions::default())
    }

    /// Opens a recording with options.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub fn open_with(path: &Path, options: ReadOptions) -> Result<Self, RecordingError> {
        let files = files_of(path)?;
        let (topics, damage) = (RecordedTopics::default(), Vec::new());
        let mut recording = Self { files: Vec::new(), topics, attachments: Vec::new(), metadata: Vec::new(), damage };
        let mut channels: Vec<Channel> = Vec::new();
        for file in &files {
            let mut walker = open_walker(file, Depth::Structure)?;
            for item in walker.by_ref() {
                match item {
                    // Every file of a split recording repeats the attachments.
                    Item::Attachment(attachment) => {
                        let known = |other: &Attachment| {
                            (&other.name, &other.media_type, &other.data)
                                == (&attachment.name, &attachment.media_type, &attachment.data)
                        };
                        if recording.attachments.iter().any(known) {
                            continue;
                        }
                        let all = recording.attachments.iter().map(|known| known.data.len()).sum::<usize>();
                        if all + attachment.data.len() > MAX_ATTACHMENT_BYTES {
                            let what = format!(
                                "attachment {:?} of {} bytes, with which all have more than the limit of \
                                 {MAX_ATTACHMENT_BYTES}",
                                attachment.name,
                                attachment.data.len()
                            );
                            let damage = Damage { offset: 0, what, loses_data: true };
                            recording.damage.push(FileDamage { file: file.clone(), damage });
                            continue;
                        }
                        recording.attachments.push(attachment);
                    }
                    Item::Metadata(metadata) => {
                        check_format(file, &metadata)?;
                        recording.metadata.push(metadata);
                    }
                    Item::Message(_) => {}
                }
            }
            recording.damage.extend(located(file, walker.damage()));
            // Without a summary the channels are only known after reading all chunks.
            if !walker.damage().is_empty() || walker.channels().next().is_none() {
                walker = open_walker(file, Depth::Messages)?;
                walker.by_ref().for_each(drop);
            }
            for channel in walker.channels() {
                if !channels.iter().any(|known| known.topic == channel.topic && known.schema == channel.schema) {
                    channels.push((**channel).clone());
                }
            }
        }
        let choice = RecordedTopics::decide(&channels, &options.topics);
        recording.topics = choice.map_err(|source| RecordingError::Choice { path: path.to_owned(), source })?;
        recording.files = files;
        Ok(recording)
    }

    /// The files, in order.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// Which recorded topics are read as which of the node's topics, and which are not read.
    pub fn topics(&self) -> &RecordedTopics {
        &self.topics
    }

    /// The attachments, such as the rig files; each once, in recorded order.
    pub fn attachments(&self) -> &[Attachment] {
        &self.attachments
    }

    /// The metadata records, in recorded order.
    pub fn metadata(&self) -> &[Metadata] {
        &self.metadata
    }

    /// A value of the recorder's metadata record (see [`METADATA_NAME`]) in the first file that has
    /// one.
    pub fn session_metadata(&self, key: &str) -> Option<&str> {
        let record = self.metadata.iter().find(|record| record.name == METADATA_NAME)?;
        record.metadata.get(key).map(String::as_str)
    }

    /// Damage found on opening: an unfinished or truncated file, or unreadable attachments. Damage inside chunks is
    /// found when messages are read: [`Messages::damage`].
    pub fn damage(&self) -> &[FileDamage] {
        &self.damage
    }

    /// Whether opening found no damage.
    pub fn is_complete(&self) -> bool {
        self.damage.is_empty()
    }

    /// All messages in recorded order. In recordings of this program their log times ascend.
    pub fn messages(&self) -> Messages<'_> {
        self.read_messages(None)
    }

    /// The messages of some log times, in recorded order. Some before and after them are among those returned: what the
    /// recorder packed together is read together.
    pub fn messages_around(&self, log_times_ns: RangeInclusive<u64>) -> Messages<'_> {
        self.read_messages(Some(log_times_ns))
    }

    fn read_messages(&self, log_times_ns: Option<RangeInclusive<u64>>) -> Messages<'_> {
        let (batches, received) = bounded(BATCHES_AHEAD);
        let files = self.files.clone();
        // This thread decompresses chunks while the caller decodes and uses messages. It ends when the receiver is
        // dropped.
        let reader = std::thread::spawn(move || read_ahead(&files, log_times_ns.as_ref(), &batches));
        Messages {
            recording: self,
            reader: Some(reader),
            batches: received,
            raw: VecDeque::new(),
            judged: Vec::new(),
            undecoded: None,
            damage: Vec::new(),
        }
    }
}

/// Refuses a file whose metadata say that it has a format this program does not read.
fn check_format(file: &Path, metadata: &Metadata) -> Result<(), RecordingError> {
    let found = metadata.metadata.get("format").filter(|_| metadata.name == METADATA_NAME);
    match found {
        Some(found) if !found.parse().is_ok_and(|format: u32| (1..=FORMAT).contains(&format)) => {
            Err(RecordingError::Format { path: file.to_owned(), found: format!("{found:.20}"), expected: FORMAT })
        }
        _ => Ok(()),
    }
}

/// Consecutive messages, and the damage found before, between and after them.
#[derive(Debug, Default)]
struct Batch {
    raw: VecDeque<RawMessage>,
    damage: Vec<FileDamage>,
}

fn read_ahead(files: &[PathBuf], log_times_ns: Option<&RangeInclusive<u64>>, batches: &Sender<Batch>) {
    for file in files {
        let walker = match log_times_ns {
            None => RecordWalker::open(file, Depth::Messages),
            Some(log_times_ns) => RecordWalker::open_between(file, log_times_ns.clone()),
        };
        let mut walker = match opened(file, walker) {
            Ok(walker) => walker,
            Err(error) => {
                let damage = Damage { offset: 0, what: error.to_string(), loses_data: true };
                let damage = vec![FileDamage { file: file.clone(), damage }];
                if batches.send(Batch { damage, ..Batch::default() }).is_err() {
                    return;
                }
                continue;
            }
        };
        let mut reported = 0;
        loop {
            let (mut raw, before) = (VecDeque::new(), walker.unpacked_bytes());
            let last = loop {
                match walker.next() {
                    None => break true,
                    Some(Item::Message(message)) => raw.push_back(message),
                    Some(Item::Attachment(_) | Item::Metadata(_)) => {}
                }
                // Messages keep the memory of their chunks alive.
                if raw.len() == BATCH || walker.unpacked_bytes() - before >= BATCH_BYTES {
                    break false;
                }
            };
            let damage = located(file, &walker.damage()[reported..]).collect();
            reported = walker.damage().len();
            if batches.send(Batch { raw, damage }).is_err() {
                return;
            }
            if last {
                break;
            }
        }
    }
}

/// How a channel is treated: as one of the node's topics, as another program's topic (ignored), or as unreadable.
type Judgement = Result<Option<Topic>, Unread>;

/// Iterator over the readable messages of a [`Recording`].
#[derive(Debug)]
pub struct Messages<'a> {
    recording: &'a Recording,
    reader: Option<JoinHandle<()>>,
    batches: Receiver<Batch>,
    raw: VecDeque<RawMessage>,
    /// What each channel was found to be. Comparing its fields for every message would take most of the time.
    judged: Vec<(Arc<Channel>, Judgement)>,
    /// Number of messages that could not be decoded, and the error of the first.
    undecoded: Option<(u64, String)>,
    damage: Vec<FileDamage>,
}

impl Messages<'_> {
    /// Damage found so far; complete once the iterator has ended. If a single chunk is damaged, the messages before and
    /// after it are returned.
    pub fn damage(&self) -> &[FileDamage] {
        &self.damage
    }

    fn entry(&mut self, raw: RawMessage) -> Entry {
        let known = self.judged.iter().position(|(channel, _)| Arc::ptr_eq(channel, &raw.channel));
        let known = known.unwrap_or_else(|| {
            self.judged.push((raw.channel.clone(), self.recording.topics.read_as(&raw.channel)));
            self.judged.len() - 1
        });
        let message = match &self.judged[known].1 {
            Ok(None) => Recorded::Other,
            Ok(Some(topic)) => match Payload::from_cdr(*topic, &raw.data) {
                Ok(payload) => Recorded::Known(payload),
                Err(error) => {
                    let reason = format!("{}: {}", raw.channel.topic, undecodable(&raw.data, &error));
                    self.undecoded.get_or_insert_with(|| (0, reason.clone())).0 += 1;
                    Recorded::Unreadable(reason)
                }
            },
            // Reported once for the whole recording.
            Err(unread) => Recorded::Unreadable(unread.to_string()),
        };
        Entry {
            channel: raw.channel,
            sequence: raw.sequence,
            log_time_ns: raw.log_time_ns,
            publish_time_ns: raw.publish_time_ns,
            cdr: raw.data,
            message,
        }
    }
}

impl Iterator for Messages<'_> {
    type Item = Entry;

    fn next(&mut self) -> Option<Entry> {
        loop {
            if let Some(raw) = self.raw.pop_front() {
                return Some(self.entry(raw));
            }
            let Ok(batch) = self.batches.recv() else {
                if let Err(panic) = self.reader.take()?.join() {
                    resume_unwind(panic);
                }
                if let (Some((count, first)), Some(file)) = (self.undecoded.take(), self.recording.files.first()) {
                    let what = format!("{count} messages cannot be decoded, the first: {first}");
                    self.damage
                        .push(FileDamage { file: file.clone(), damage: Damage { offset: 0, what, loses_data: true } });
                }
                return None;
            };
            self.raw = batch.raw;
            self.damage.extend(batch.damage);
        }
    }
}

/// Why a message cannot be decoded.
fn undecodable(data: &[u8], error: &CdrError) -> String {
    if data.starts_with(&ZSTD_MAGIC) {
        return "compressed message by message; `ros2 bag convert` decompresses it".to_owned();
    }
    error.to_string()
}

fn located<'a>(file: &'a Path, damage: &'a [Damage]) -> impl Iterator<Item = FileDamage> + use<'a> {
    damage.iter().map(|damage| FileDamage { file: file.to_owned(), damage: damage.clone() })
}

pub(super) fn open_walker(path: &Path, depth: Depth) -> Result<RecordWalker, RecordingError> {
    opened(path, RecordWalker::open(path, depth))
}

fn opened(path: &Path, walker: io::Result<Option<RecordWalker>>) -> Result<RecordWalker, RecordingError> {
    match walker {
        Ok(Some(walker)) => Ok(walker),
        Ok(None) => Err(not_mcap(path)),
        Err(source) => Err(RecordingError::Io { path: path.to_owned(), source }),
    }
}

/// The error for a file that is not MCAP, by what it appears to be.
fn not_mcap(path: &Path) -> RecordingError {
    let mut head = Vec::new();
    let read = input_file::open(path, input_file::ANY_SIZE).and_then(|file| file.take(16).read_to_end(&mut head));
    let path = path.to_owned();
    match read {
        Err(source) => RecordingError::Io { path, source },
        Ok(_) if head.starts_with(SQLITE_MAGIC) => RecordingError::Sqlite { path },
        Ok(_) if head.starts_with(&ZSTD_MAGIC) || head.starts_with(&LZ4_MAGIC) => RecordingError::Compressed { path },
        Ok(_) => RecordingError::NotMcap { path },
    }
}

/// Whether a file is a recording, according to its first bytes; otherwise it may be a log.
///
/// # Errors
/// The file cannot be read, is a recording in another format, or is one by its name only.
pub fn is_recording(path: &Path) -> Result<bool, RecordingError> {
    let io_error = |source| RecordingError::Io { path: path.to_owned(), source };
    let mut head = Vec::new();
    let file = input_file::open(path, input_file::ANY_SIZE).map_err(io_error)?;
    file.take(mcap::MAGIC.len() as u64).read_to_end(&mut head).map_err(io_error)?;
    if head == mcap::MAGIC {
        return Ok(true);
    }
    match not_mcap(path) {
        RecordingError::NotMcap { .. } if split_name(path).is_none() => Ok(false),
        error => Err(error),
    }
}

/// The recordings at a path. A file, or a directory with the files of one recording, is itself one recording. Otherwise
/// these are the recordings in its subdirectories, or the single files directly in it, in order of name.
///
/// # Errors
/// The path cannot be read or contains no recording.
pub fn recordings_at(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let io_error = |source| RecordingError::Io { path: path.to_owned(), source };
    if !std::fs::metadata(path).map_err(io_error)?.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let own = mcap_files(path).map_err(io_error)?;
    if !own.is_empty() {
        let mut bases: Vec<String> = own.iter().filter_map(|file| split_name(file)).map(|(base, _)| base).collect();
        bases.dedup();
        // Files with different names and without `metadata.yaml` are separate recordings.
        let apart = bases.len() == own.len() && !path.join(bag::METADATA_FILE).exists();
        return Ok(if apart { own } else { vec![path.to_owned()] });
    }
    let mut below = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io_error)? {
        let directory = entry.map_err(io_error)?.path();
        if directory.is_dir() && mcap_files(&directory).is_ok_and(|files| !files.is_empty()) {
            below.push(directory);
        }
    }
    below.sort();
    if below.is_empty() { Err(no_files(path)) } else { Ok(below) }
}

/// The error for a directory without a recording.
pub(super) fn no_files(path: &Path) -> RecordingError {
    let entries = std::fs::read_dir(path).into_iter().flatten().filter_map(Result::ok).map(|entry| entry.path());
    let foreign = entries.filter(|file| file.is_file()).map(|file| not_mcap(&file));
    let known =
        |error: &RecordingError| matches!(error, RecordingError::Sqlite { .. } | RecordingError::Compressed { .. });
    foreign.into_iter().find(known).unwrap_or(RecordingError::NoFiles { path: path.to_owned() })
}

/// The files of a recording: the file itself, or the MCAP files of a directory in order of split number.
fn files_of(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let io_error = |source| RecordingError::Io { path: path.to_owned(), source };
    if !std::fs::metadata(path).map_err(io_error)?.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let files = mcap_files(path).map_err(io_error)?;
    if files.is_empty() { Err(no_files(path)) } else { Ok(files) }
}

/// The name of the recording that a file belongs to, and its split number; `None` for other files.
fn split_name(path: &Path) -> Option<(String, u64)> {
    let name = path.file_name()?.to_str()?;
    let stem = name.strip_suffix(".active").unwrap_or(name).strip_suffix(".mcap")?;
    Some(match stem.rsplit_once('_').map(|(base, index)| (base, index.parse::<u64>())) {
        Some((base, Ok(index))) => (base.to_owned(), index),
        _ => (stem.to_owned(), 0),
    })
}

/// The `*.mcap` and `*.mcap.active` files of a directory, ordered by split number, then by name.
pub(super) fn mcap_files(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if let Some((base, index)) = split_name(&path).filter(|_| path.is_file()) {
            files.push((base, index, path));
        }
    }
    files.sort();
    Ok(files.into_iter().map(|(_, _, path)| path).collect())
}
