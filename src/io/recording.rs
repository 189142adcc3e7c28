//! Reads recordings: finished, interrupted, cut or damaged, our own or another ROS 2 program's.

use std::{
    collections::VecDeque,
    io,
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::Arc,
    thread::JoinHandle,
};

use bytes::Bytes;
use crossbeam_channel::{Receiver, Sender, bounded};
use mcap::records::Metadata;

use super::{
    message::Payload,
    record_walker::{Attachment, Channel, Damage, Depth, Item, RawMessage, RecordWalker},
};
use crate::wire::schema::{MESSAGE_ENCODING, SCHEMA_ENCODING, Topic, same_fields};

/// Messages read at a time, at most of chunks that unpack to the second number of bytes, and how many times ahead of their
/// use.
const BATCH: usize = 512;
const BATCH_BYTES: u64 = 8 << 20;
const BATCHES_AHEAD: usize = 2;
/// What the attachments of a recording may take together, each counted once.
const MAX_ATTACHMENT_BYTES: usize = 2 << 30;

/// Why a recording cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    #[error("{}: {source}", .path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}: not an MCAP file: it does not begin with its magic bytes", .path.display())]
    NotMcap { path: PathBuf },
    #[error("{}: holds no *.mcap and no *.mcap.active file", .path.display())]
    NoFiles { path: PathBuf },
}

/// How a recording is read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Operating points are taken from this topic alone. Without it from every topic of their type, whatever its name.
    pub operating_point_topic: Option<String>,
}

/// A message of a recording.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Topic, type and encoding as recorded.
    pub channel: Arc<Channel>,
    pub sequence: u32,
    pub log_time_ns: u64,
    pub publish_time_ns: u64,
    /// As recorded, encapsulation header included.
    pub cdr: Bytes,
    pub message: Recorded,
}

/// What an [`Entry`] holds.
#[derive(Clone, Debug, PartialEq)]
pub enum Recorded {
    /// One of the node's messages.
    Known(Payload),
    /// One of the node's messages by its type, but it cannot be decoded, and why.
    Unreadable(String),
    /// Anything else.
    Other,
}

/// Damage, and the file that has it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}: {damage}", .file.display())]
pub struct FileDamage {
    pub file: PathBuf,
    pub damage: Damage,
}

/// A recording: one file, or a directory of the files it was split into.
#[derive(Debug)]
pub struct Recording {
    files: Vec<PathBuf>,
    options: ReadOptions,
    attachments: Vec<Attachment>,
    metadata: Vec<Metadata>,
    damage: Vec<FileDamage>,
}

impl Recording {
    /// Opens a file or directory.
    ///
    /// # Errors
    ///
    /// A path that cannot be read, holds no recording, or is no MCAP file. Damage is no error: see [`Self::damage`].
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Self::open_with(path, ReadOptions::default())
    }

    /// Opens a file or directory with options.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub fn open_with(path: &Path, options: ReadOptions) -> Result<Self, RecordingError> {
        let files = files_of(path)?;
        let mut recording =
            Self { files: Vec::new(), options, attachments: Vec::new(), metadata: Vec::new(), damage: Vec::new() };
        for file in &files {
            let mut walker = open_walker(file, Depth::Structure)?;
            for item in walker.by_ref() {
                match item {
                    // Every file of a split recording carries them again.
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
                    Item::Metadata(metadata) => recording.metadata.push(metadata),
                    Item::Message(_) => {}
                }
            }
            recording.damage.extend(located(file, walker.damage()));
        }
        recording.files = files;
        Ok(recording)
    }

    /// The files, in order.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// The files within it, such as those of the rig; each once, in the order they were written.
    pub fn attachments(&self) -> &[Attachment] {
        &self.attachments
    }

    /// Its metadata records, in order.
    pub fn metadata(&self) -> &[Metadata] {
        &self.metadata
    }

    /// A value of the metadata the recorder writes (see [`super::recorder::METADATA_NAME`]), of the first file.
    pub fn session_metadata(&self, key: &str) -> Option<&str> {
        let record = self.metadata.iter().find(|record| record.name == super::recorder::METADATA_NAME)?;
        record.metadata.get(key).map(String::as_str)
    }

    /// What opening found wrong: a file that was not finished, was cut, or has unreadable attachments. Damage inside
    /// chunks is found by reading them: [`Messages::damage`].
    pub fn damage(&self) -> &[FileDamage] {
        &self.damage
    }

    /// Whether opening found every file finished.
    pub fn is_complete(&self) -> bool {
        self.damage.is_empty()
    }

    /// All messages in the order they were written, which for our own recordings is ascending log time.
    pub fn messages(&self) -> Messages<'_> {
        let (batches, received) = bounded(BATCHES_AHEAD);
        let files = self.files.clone();
        // Chunks are decompressed there while messages are decoded and used here. It ends when nobody receives.
        let reader = std::thread::spawn(move || read_ahead(&files, &batches));
        Messages {
            recording: self,
            reader: Some(reader),
            batches: received,
            raw: VecDeque::new(),
            judged: Vec::new(),
            damage: Vec::new(),
        }
    }
}

/// Messages that follow each other, and what was found wrong before, between and behind them.
#[derive(Debug, Default)]
struct Batch {
    raw: VecDeque<RawMessage>,
    damage: Vec<FileDamage>,
}

fn read_ahead(files: &[PathBuf], batches: &Sender<Batch>) {
    for file in files {
        let mut walker = match open_walker(file, Depth::Messages) {
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
        let mut told = 0;
        loop {
            let (mut raw, before) = (VecDeque::new(), walker.unpacked_bytes());
            let last = loop {
                match walker.next() {
                    None => break true,
                    Some(Item::Message(message)) => raw.push_back(message),
                    Some(Item::Attachment(_) | Item::Metadata(_)) => {}
                }
                // Messages hold the memory of their chunks.
                if raw.len() == BATCH || walker.unpacked_bytes() - before >= BATCH_BYTES {
                    break false;
                }
            };
            let damage = located(file, &walker.damage()[told..]).collect();
            told = walker.damage().len();
            if batches.send(Batch { raw, damage }).is_err() {
                return;
            }
            if last {
                break;
            }
        }
    }
}

/// The messages of a [`Recording`], as far as they can be read.
#[derive(Debug)]
pub struct Messages<'a> {
    recording: &'a Recording,
    reader: Option<JoinHandle<()>>,
    batches: Receiver<Batch>,
    raw: VecDeque<RawMessage>,
    /// What was found of each channel: comparing its fields with ours for every message would take most of the time.
    judged: Vec<(Arc<Channel>, Readable)>,
    damage: Vec<FileDamage>,
}

impl Messages<'_> {
    /// What was found wrong so far; complete once the iterator has ended. Messages are given out up to the damage, and
    /// from behind it where a single chunk is damaged.
    pub fn damage(&self) -> &[FileDamage] {
        &self.damage
    }

    fn entry(&mut self, raw: RawMessage) -> Entry {
        let known = self.judged.iter().position(|(channel, _)| Arc::ptr_eq(channel, &raw.channel));
        let known = known.unwrap_or_else(|| {
            let readable = judge(&raw.channel, self.recording.options.operating_point_topic.as_deref());
            self.judged.push((raw.channel.clone(), readable));
            self.judged.len() - 1
        });
        let message = decode(&raw, &self.judged[known].1);
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
                return None;
            };
            self.raw = batch.raw;
            self.damage.extend(batch.damage);
        }
    }
}

/// Whether the messages of a channel can be read.
#[derive(Debug)]
enum Readable {
    As(Topic),
    Not(String),
    Other,
}

fn judge(channel: &Channel, operating_point_topic: Option<&str>) -> Readable {
    let Some(schema) = &channel.schema else { return Readable::Other };
    let Some(topic) = Topic::of_type(&schema.name) else { return Readable::Other };
    if topic == Topic::OperatingPoint && operating_point_topic.is_some_and(|wanted| wanted != channel.topic) {
        return Readable::Other;
    }
    if channel.message_encoding != MESSAGE_ENCODING {
        return Readable::Not(format!("encoding {:?}: only {MESSAGE_ENCODING:?} is read", channel.message_encoding));
    }
    if schema.encoding == SCHEMA_ENCODING && !same_fields(topic.definition(), &String::from_utf8_lossy(&schema.data)) {
        return Readable::Not(format!("{} has other fields in this recording", schema.name));
    }
    Readable::As(topic)
}

fn decode(raw: &RawMessage, readable: &Readable) -> Recorded {
    match readable {
        Readable::Other => Recorded::Other,
        Readable::Not(reason) => Recorded::Unreadable(reason.clone()),
        Readable::As(topic) => match Payload::from_cdr(*topic, &raw.data) {
            Ok(payload) => Recorded::Known(payload),
            Err(error) => Recorded::Unreadable(format!("{}: {error}", topic.type_name())),
        },
    }
}

fn located<'a>(file: &'a Path, damage: &'a [Damage]) -> impl Iterator<Item = FileDamage> + use<'a> {
    damage.iter().map(|damage| FileDamage { file: file.to_owned(), damage: damage.clone() })
}

pub(super) fn open_walker(path: &Path, depth: Depth) -> Result<RecordWalker, RecordingError> {
    match RecordWalker::open(path, depth) {
        Ok(Some(walker)) => Ok(walker),
        Ok(None) => Err(RecordingError::NotMcap { path: path.to_owned() }),
        Err(source) => Err(RecordingError::Io { path: path.to_owned(), source }),
    }
}

/// The files of a recording in order: itself, or the MCAP files of a directory by their split number.
fn files_of(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let io_error = |source| RecordingError::Io { path: path.to_owned(), source };
    if !std::fs::metadata(path).map_err(io_error)?.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let files = mcap_files(path).map_err(io_error)?;
    if files.is_empty() {
        return Err(RecordingError::NoFiles { path: path.to_owned() });
    }
    Ok(files)
}

/// The `*.mcap` and `*.mcap.active` files of a directory in the order of their split numbers, then of their names.
pub(super) fn mcap_files(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        let Some(name) = path.file_name().and_then(|name| name.to_str()) else { continue };
        let Some(stem) = name.strip_suffix(".active").unwrap_or(name).strip_suffix(".mcap") else { continue };
        let (base, index) = match stem.rsplit_once('_').map(|(base, index)| (base, index.parse::<u64>())) {
            Some((base, Ok(index))) => (base.to_owned(), index),
            _ => (stem.to_owned(), 0),
        };
        if path.is_file() {
            files.push((base, index, path));
        }
    }
    files.sort();
    Ok(files.into_iter().map(|(_, _, path)| path).collect())
}
