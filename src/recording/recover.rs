//! Repairs interrupted recordings.
//!
//! Everything readable is written to a new file, which replaces the interrupted one once it is on the disk. An original
//! that contains unreadable data is kept as `*.mcap.damaged`.

use std::{
    collections::{BTreeMap, HashMap},
    fs::{File, TryLockError},
    io,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use crate::files::input_file;

use super::bag::{self, FileSummary, TopicInfo};
use super::mcap_file::{RecordingFile, WriteError, with_suffix};
use super::reader::{RecordingError, mcap_files, no_files, open_walker};
use super::record_walker::{Damage, Depth, Item, RecordWalker};
use crate::files::whole_file::{folder_of, sync_folder};

/// Suffix of a file being recorded.
pub const ACTIVE: &str = ".active";
const DAMAGED: &str = ".damaged";
/// How long a file must stay locked to be in use. A file that has been closed stays locked for some milliseconds if its
/// process was just starting another: between `fork` and `exec` the child has the parent's open files.
const LOCK_WAIT: Duration = Duration::from_secs(1);

/// Why a recording cannot be repaired.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    #[error(transparent)]
    Read(#[from] RecordingError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("{}: cannot replace {}, which exists", .interrupted.display(), .finished.display())]
    TargetExists { interrupted: PathBuf, finished: PathBuf },
}

/// Result of repairing one file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recovery {
    /// Its name before the repair.
    pub original: PathBuf,
    pub outcome: Outcome,
}

/// See [`Recovery`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It was finished and undamaged. An interrupted renaming was completed.
    Complete { path: PathBuf, messages: u64 },
    /// Everything readable is now in a finished file.
    Restored(Restored),
    /// It contained nothing, not even the start of a recording, and was removed.
    Empty,
    /// It was named as a recording in progress but is not one. It was renamed and is ignored from now on.
    SetAside { path: PathBuf },
    /// A running process is writing it.
    InUse,
}

/// Counts of restored and lost messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Restored {
    /// The finished file.
    pub path: PathBuf,
    pub messages: u64,
    pub attachments: u64,
    /// First and last log time, ns.
    pub span_ns: Option<(u64, u64)>,
    /// Damage of the original.
    pub damage: Vec<Damage>,
    /// The original, kept if it contained unreadable data.
    pub kept_original: Option<PathBuf>,
}

impl Restored {
    /// Whether the original contained unreadable data.
    pub fn loses_data(&self) -> bool {
        self.damage.iter().any(|damage| damage.loses_data)
    }
}

/// Results of repairing several files. A file that cannot be repaired does not prevent the repair of others.
#[derive(Debug, Default)]
pub struct RecoveryReport {
    pub recoveries: Vec<Recovery>,
    /// Errors of the files that could not be repaired; these files are unchanged.
    pub errors: Vec<RecoverError>,
}

impl RecoveryReport {
    /// Number of messages in the restored files.
    pub fn messages_restored(&self) -> u64 {
        self.restored().map(|restored| restored.messages).sum()
    }

    /// Whether any original contained unreadable data.
    pub fn loses_data(&self) -> bool {
        self.restored().any(Restored::loses_data)
    }

    fn restored(&self) -> impl Iterator<Item = &Restored> {
        self.recoveries.iter().filter_map(|recovery| match &recovery.outcome {
            Outcome::Restored(restored) => Some(restored),
            Outcome::Complete { .. } | Outcome::Empty | Outcome::SetAside { .. } | Outcome::InUse => None,
        })
    }
}

/// Repairs a file, or every `*.mcap` and `*.mcap.active` file in a directory and in its immediate subdirectories.
/// `metadata.yaml` is rewritten where files of its directory changed.
///
/// # Errors
///
/// The path cannot be read or contains no recording. Errors of single files are in the report.
pub fn recover(path: &Path) -> Result<RecoveryReport, RecoverError> {
    let is_directory = std::fs::metadata(path).map_err(|source| read_error(path, source))?.is_dir();
    if !is_directory {
        return Ok(recover_files(&[path.to_owned()]));
    }
    let files = files_below(path).map_err(|source| read_error(path, source))?;
    if files.is_empty() {
        return Err(no_files(path).into());
    }
    Ok(recover_files(&files))
}

/// Repairs the remains of interrupted processes (`*.mcap.active`) in a record directory and its immediate
/// subdirectories. Finished files are not examined.
///
/// # Errors
///
/// The directory cannot be read.
pub fn recover_leftovers(directory: &Path) -> Result<RecoveryReport, RecoverError> {
    let mut leftovers = files_below(directory).map_err(|source| read_error(directory, source))?;
    leftovers.retain(|path| is_active(path));
    Ok(recover_files(&leftovers))
}

fn recover_files(files: &[PathBuf]) -> RecoveryReport {
    let mut report = RecoveryReport::default();
    for file in files {
        match recover_file(file) {
            Ok(recovery) => report.recoveries.push(recovery),
            Err(error) => report.errors.push(error),
        }
    }
    let mut changed: Vec<&Path> = Vec::new();
    for Recovery { original, outcome } in &report.recoveries {
        let directory = folder_of(original);
        let listed = match outcome {
            Outcome::InUse => true,
            Outcome::Complete { path, .. } => path == original && directory.join(bag::METADATA_FILE).exists(),
            Outcome::Restored(_) | Outcome::Empty | Outcome::SetAside { .. } => false,
        };
        if !listed && is_bag(directory, original) && !changed.contains(&directory) {
            changed.push(directory);
        }
    }
    for directory in changed {
        if let Err(error) = rewrite_metadata(directory) {
            report.errors.push(error);
        }
    }
    report
}

/// Whether `metadata.yaml` may be written into a directory: it already exists, or the directory has the name of its
/// files. The directory of a single file elsewhere stays as it is.
fn is_bag(directory: &Path, file: &Path) -> bool {
    let named_alike = || {
        let directory = directory.file_name()?.to_str()?;
        file.file_name()?.to_str()?.strip_prefix(directory)?.strip_prefix('_')
    };
    directory.join(bag::METADATA_FILE).exists() || named_alike().is_some()
}

/// Locks a file, unless another process keeps it locked for [`LOCK_WAIT`].
fn locked(file: &File) -> io::Result<bool> {
    let begun = Instant::now();
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(true),
            Err(TryLockError::WouldBlock) if begun.elapsed() < LOCK_WAIT => thread::sleep(LOCK_WAIT / 100),
            Err(TryLockError::WouldBlock) => return Ok(false),
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
}

fn recover_file(path: &Path) -> Result<Recovery, RecoverError> {
    let recovery = |outcome| Recovery { original: path.to_owned(), outcome };
    let lock = input_file::open(path, input_file::ANY_SIZE).map_err(|source| read_error(path, source))?;
    if !locked(&lock).map_err(|source| read_error(path, source))? {
        return Ok(recovery(Outcome::InUse));
    }
    let target = finished_name(path);
    if target != path && target.exists() {
        return Err(RecoverError::TargetExists { interrupted: path.to_owned(), finished: target });
    }
    if lock.metadata().map_err(|source| read_error(path, source))?.len() == 0 && is_active(path) {
        remove(path)?;
        return Ok(recovery(Outcome::Empty));
    }

    // The first pass reads everything: an undamaged file is left as it is.
    let mut walker = match open_walker(path, Depth::Messages) {
        Err(RecordingError::NotMcap { .. }) if is_active(path) => {
            let kept = free_name(&with_suffix(&target, DAMAGED));
            rename(path, &kept)?;
            return Ok(recovery(Outcome::SetAside { path: kept }));
        }
        walker => walker?,
    };
    let messages = walker.by_ref().filter(|item| matches!(item, Item::Message(_))).count() as u64;
    if walker.damage().is_empty() {
        if target != path {
            rename(path, &target)?;
        }
        return Ok(recovery(Outcome::Complete { path: target, messages }));
    }

    let mut copy = RecordingFile::create_whole(&target)?;
    let mut walker = open_walker(path, Depth::Messages)?;
    let attachments = match copy_items(&mut walker, &mut copy) {
        Ok(attachments) => attachments,
        Err(error) => {
            copy.abandon();
            return Err(error.into());
        }
    };
    let damage = walker.damage().to_vec();
    let loses_data = damage.iter().any(|damage| damage.loses_data);
    let kept_original = loses_data.then(|| free_name(&with_suffix(&target, DAMAGED)));
    let summary = copy.finish_after(|| match &kept_original {
        Some(kept) => keep_as(path, kept),
        None => Ok(()),
    })?;
    if target != path {
        remove(path)?;
    }
    let restored = Restored {
        path: target,
        messages: summary.messages(),
        attachments,
        span_ns: summary.span_ns,
        damage,
        kept_original,
    };
    Ok(recovery(Outcome::Restored(restored)))
}

/// Copies everything readable; returns the number of attachments.
fn copy_items(walker: &mut RecordWalker, copy: &mut RecordingFile) -> Result<u64, WriteError> {
    let mut channels = HashMap::new();
    let mut attachments = 0;
    for item in walker {
        match item {
            Item::Attachment(attachment) => {
                copy.attach(&attachment)?;
                attachments += 1;
            }
            Item::Metadata(metadata) => copy.write_metadata(&metadata)?,
            Item::Message(message) => {
                let channel = match channels.get(&message.channel.id) {
                    Some(channel) => *channel,
                    None => {
                        let from = &message.channel;
                        let schema = from.schema.as_ref();
                        let schema = schema.map(|s| (s.name.as_str(), s.encoding.as_str(), s.data.as_slice()));
                        let channel = copy.channel(&from.topic, schema, &from.message_encoding, &from.metadata)?;
                        channels.insert(from.id, channel);
                        channel
                    }
                };
                copy.write(channel, message.sequence, message.log_time_ns, message.publish_time_ns, &message.data)?;
            }
        }
    }
    Ok(attachments)
}

/// Writes `metadata.yaml` for the finished files of a directory.
fn rewrite_metadata(directory: &Path) -> Result<(), RecoverError> {
    let mut summaries = Vec::new();
    for path in mcap_files(directory).map_err(|source| read_error(directory, source))? {
        if !is_active(&path) {
            summaries.push(summarize(&path)?);
        }
    }
    bag::write_metadata(directory, &summaries).map_err(WriteError::from)?;
    Ok(())
}

/// Counts a file's messages.
fn summarize(path: &Path) -> Result<FileSummary, RecoverError> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let mut summary = FileSummary { name, ..FileSummary::default() };
    let mut topics: BTreeMap<u16, TopicInfo> = BTreeMap::new();
    for item in open_walker(path, Depth::Messages)? {
        let Item::Message(message) = item else { continue };
        let channel = &message.channel;
        let topic = topics.entry(channel.id).or_insert_with(|| {
            let type_name = channel.schema.as_ref().map(|schema| schema.name.as_str());
            TopicInfo::of_channel(&channel.topic, type_name, &channel.message_encoding, &channel.metadata)
        });
        summary.count(topic, message.log_time_ns);
    }
    Ok(summary)
}

fn files_below(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = mcap_files(directory)?;
    let mut below = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if path.is_dir() {
            below.push(path);
        }
    }
    below.sort();
    for directory in below {
        files.extend(mcap_files(&directory)?);
    }
    Ok(files)
}

fn is_active(path: &Path) -> bool {
    path.as_os_str().as_encoded_bytes().ends_with(ACTIVE.as_bytes())
}

fn finished_name(path: &Path) -> PathBuf {
    if is_active(path) { path.with_extension("") } else { path.to_owned() }
}

/// `path`, or `path` with the suffix `.2`, `.3` ... if it is taken.
fn free_name(path: &Path) -> PathBuf {
    if !path.exists() {
        return path.to_owned();
    }
    (2_u32..)
        .map(|n| with_suffix(path, &format!(".{n}")))
        .find(|path| !path.exists())
        .unwrap_or_else(|| path.to_owned())
}

fn rename(from: &Path, to: &Path) -> Result<(), WriteError> {
    std::fs::rename(from, to).and_then(|()| sync_folder(folder_of(to))).map_err(|source| WriteError::io(to, source))
}

/// Adds a second name to a file, so that it survives the replacement of the first. If the file system has no hard
/// links, the file is renamed.
fn keep_as(path: &Path, kept: &Path) -> Result<(), WriteError> {
    match std::fs::hard_link(path, kept) {
        Ok(()) => Ok(()),
        Err(_) => rename(path, kept),
    }
}

/// Removes a file whose content has been copied; it may already be gone.
fn remove(path: &Path) -> Result<(), RecordingError> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(read_error(path, error)),
        _ => Ok(()),
    }
}

fn read_error(path: &Path, source: io::Error) -> RecordingError {
    RecordingError::Io { path: path.to_owned(), source }
}
