//! Writes one MCAP file: under a temporary name and locked, in whole chunks, and renamed when finished.

use std::{
    collections::{BTreeMap, HashMap},
    ffi::OsString,
    fmt, fs,
    fs::File,
    io::{self, BufWriter, Write},
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
    sync::Arc,
};

use mcap::{
    McapError, WriteOptions, Writer,
    records::{MessageHeader, Metadata},
    write::NoSeek,
};

use super::bag::{FileSummary, QOS_KEY, TYPE_HASH_KEY, TopicInfo};
use super::record_walker::Attachment;
use crate::files::whole_file::{WholeFile, WholeFileError, folder_of, sync_open_folder};
use crate::msgs::schema::{MESSAGE_ENCODING, SCHEMA_ENCODING, Topic};

/// A chunk is closed by the first message after this many bytes; including that message it stays below 768 KiB.
const CHUNK_BYTES: u64 = 640 << 10;

/// Why a file cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    #[error("{}: {source}", .path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}: {source}", .path.display())]
    Mcap { path: PathBuf, source: McapError },
    #[error("{}: exists already", .path.display())]
    Exists { path: PathBuf },
    #[error(transparent)]
    Whole(#[from] WholeFileError),
}

impl WriteError {
    pub(super) fn io(path: &Path, source: io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }
}

/// The disk that is written to; tests replace it, for example by a full one.
pub trait Disk: fmt::Debug + Send + Sync {
    /// Writes some of `bytes`.
    ///
    /// # Errors
    ///
    /// As [`Write::write`].
    fn write(&self, file: &File, bytes: &[u8]) -> io::Result<usize>;

    /// Makes the written data survive a power failure.
    ///
    /// # Errors
    ///
    /// As [`File::sync_data`].
    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_data()
    }

    /// Free space on the file system of a directory, bytes.
    ///
    /// # Errors
    ///
    /// The file system cannot be queried.
    fn free_bytes(&self, directory: &Path) -> io::Result<u64>;
}

/// The file system of the machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct FileSystem;

impl Disk for FileSystem {
    fn write(&self, mut file: &File, bytes: &[u8]) -> io::Result<usize> {
        file.write(bytes)
    }

    fn free_bytes(&self, directory: &Path) -> io::Result<u64> {
        let status = rustix::fs::statvfs(directory)?;
        Ok(status.f_bavail.saturating_mul(status.f_frsize))
    }
}

/// A file on a [`Disk`] that counts the bytes written.
#[derive(Debug)]
struct CountedFile {
    file: File,
    disk: Arc<dyn Disk>,
    bytes: Arc<std::sync::atomic::AtomicU64>,
}

impl Write for CountedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.disk.write(&self.file, bytes)?;
        self.bytes.fetch_add(written as u64, std::sync::atomic::Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A channel of a [`RecordingFile`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ChannelId(u16);

/// Whether the temporary name still refers to the file being written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Whereabouts {
    InPlace,
    /// Its directory was moved to this path.
    Moved(PathBuf),
    /// The file was removed: everything written to it is lost.
    Removed,
}

/// How the file gets its final name.
enum Naming {
    /// It has its temporary name, under which others can find it, in this directory.
    Active(File),
    /// It has no visible name until it is finished.
    Whole(WholeFile),
}

/// A file being written.
///
/// Chunks are collected in memory and written as a whole. A process that is killed therefore leaves complete chunks,
/// and not an open one of length `u64::MAX` as seeking writers do. The file is locked (`flock`) while it is written, so
/// that no other process recovers it.
pub struct RecordingFile {
    writer: Writer<NoSeek<BufWriter<CountedFile>>>,
    file: File,
    disk: Arc<dyn Disk>,
    bytes: Arc<std::sync::atomic::AtomicU64>,
    temporary: PathBuf,
    path: PathBuf,
    naming: Naming,
    topics: HashMap<ChannelId, TopicInfo>,
    /// Channels of the node's own topics.
    own: HashMap<Topic, ChannelId>,
    summary: FileSummary,
}

impl fmt::Debug for RecordingFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RecordingFile").field("temporary", &self.temporary).finish_non_exhaustive()
    }
}

impl RecordingFile {
    /// Begins a file that is named `path` + `suffix` until it is finished and `path` afterwards. It can thus be read
    /// and recovered before it is finished.
    ///
    /// # Errors
    ///
    /// [`WriteError::Exists`] if either name is taken; errors of writing.
    pub fn create(path: &Path, suffix: &str, disk: Arc<dyn Disk>) -> Result<Self, WriteError> {
        let temporary = with_suffix(path, suffix);
        for taken in [path, &temporary] {
            if taken.exists() {
                return Err(WriteError::Exists { path: taken.to_owned() });
            }
        }
        // Locked before it gets the name that others look for.
        let file = WholeFile::create(&temporary)?.name_unfinished()?;
        let folder = folder_of(path);
        let directory = File::open(folder).map_err(|source| WriteError::io(folder, source))?;
        let begun = Self::begin(file, temporary.clone(), path, Naming::Active(directory), disk);
        begun.inspect_err(|_| drop(fs::remove_file(&temporary)))
    }

    /// Begins a file that appears as `path` when it is finished, replacing any file of that name.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn create_whole(path: &Path) -> Result<Self, WriteError> {
        let whole = WholeFile::create(path)?;
        let file = whole.as_file().try_clone().map_err(|source| WriteError::io(path, source))?;
        Self::begin(file, path.to_owned(), path, Naming::Whole(whole), Arc::new(FileSystem))
    }

    fn begin(
        file: File,
        temporary: PathBuf,
        path: &Path,
        naming: Naming,
        disk: Arc<dyn Disk>,
    ) -> Result<Self, WriteError> {
        let bytes = Arc::default();
        let same = file.try_clone().map_err(|source| WriteError::io(&temporary, source))?;
        let counted = CountedFile { file: same, disk: Arc::clone(&disk), bytes: Arc::clone(&bytes) };
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("squealcast ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_BYTES))
            .compression_threads(0)
            .disable_seeking(true);
        let created = options.create(NoSeek::new(BufWriter::new(counted)));
        let writer = created.map_err(|source| located(&temporary, source))?;
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let summary = FileSummary { name, ..FileSummary::default() };
        let (path, topics) = (path.to_owned(), HashMap::new());
        Ok(Self { writer, file, disk, bytes, temporary, path, naming, topics, own: HashMap::new(), summary })
    }

    /// Whether the file is still at its place.
    ///
    /// # Errors
    ///
    /// The file system cannot be queried.
    pub fn whereabouts(&self) -> io::Result<Whereabouts> {
        let own = self.file.metadata()?;
        let same = match fs::symlink_metadata(&self.temporary) {
            Ok(there) => Some((there.dev(), there.ino()) == (own.dev(), own.ino())),
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => None,
            Err(error) => return Err(error),
        };
        Ok(match (own.nlink(), same) {
            (0, None | Some(false)) => Whereabouts::Removed,
            (_, None) => Whereabouts::Moved(self.directory()),
            // Inode numbers are not stable on every file system.
            (_, Some(_)) => Whereabouts::InPlace,
        })
    }

    /// The current path of its directory, even if that was moved.
    fn directory(&self) -> PathBuf {
        let moved = match &self.naming {
            Naming::Active(directory) => {
                fs::read_link(format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(directory))).ok()
            }
            Naming::Whole(_) => None,
        };
        moved.unwrap_or_else(|| folder_of(&self.path).to_owned())
    }

    /// The temporary name.
    pub fn temporary(&self) -> &Path {
        &self.temporary
    }

    /// Summary of the content so far.
    pub fn summary(&self) -> &FileSummary {
        &self.summary
    }

    /// Bytes written so far, without the open chunk.
    pub fn bytes_written(&self) -> u64 {
        self.bytes.load(std::sync::atomic::Ordering::Relaxed)
    }

    /// Adds an attachment. To be called before the first message, so that a truncated file still contains it.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn attach(&mut self, attachment: &Attachment) -> Result<(), WriteError> {
        let Attachment { log_time_ns, create_time_ns, name, media_type, data } = attachment;
        let attachment = mcap::Attachment {
            log_time: *log_time_ns,
            create_time: *create_time_ns,
            name: name.clone(),
            media_type: media_type.clone(),
            data: data.into(),
        };
        self.writer.attach(&attachment).map_err(|source| located(&self.temporary, source))
    }

    /// Adds a metadata record.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn write_metadata(&mut self, metadata: &Metadata) -> Result<(), WriteError> {
        self.writer.write_metadata(metadata).map_err(|source| located(&self.temporary, source))
    }

    /// The channel of one of the node's own topics, created on first use.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn own_channel(&mut self, topic: Topic) -> Result<ChannelId, WriteError> {
        if let Some(&known) = self.own.get(&topic) {
            return Ok(known);
        }
        let metadata =
            BTreeMap::from([(QOS_KEY.to_owned(), topic.qos_profiles()), (TYPE_HASH_KEY.to_owned(), topic.type_hash())]);
        let schema = Some((topic.type_name(), SCHEMA_ENCODING, topic.schema()));
        let schema = schema.as_ref().map(|(name, encoding, text)| (*name, *encoding, text.as_bytes()));
        let channel = self.channel(topic.name(), schema, MESSAGE_ENCODING, &metadata)?;
        self.own.insert(topic, channel);
        Ok(channel)
    }

    /// The channel with these properties, created on first use. `schema` is name, encoding and text.
    ///
    /// # Errors
    ///
    /// Errors of writing; more than 65535 channels or schemas.
    pub fn channel(
        &mut self,
        topic: &str,
        schema: Option<(&str, &str, &[u8])>,
        message_encoding: &str,
        metadata: &BTreeMap<String, String>,
    ) -> Result<ChannelId, WriteError> {
        let at = |source| located(&self.temporary, source);
        let schema_id = match schema {
            Some((name, encoding, text)) => self.writer.add_schema(name, encoding, text).map_err(at)?,
            None => 0,
        };
        let id = ChannelId(self.writer.add_channel(schema_id, topic, message_encoding, metadata).map_err(at)?);
        self.topics.entry(id).or_insert_with(|| {
            TopicInfo::of_channel(topic, schema.map(|(name, _, _)| name), message_encoding, metadata)
        });
        Ok(id)
    }

    /// Appends a message.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn write(
        &mut self,
        channel: ChannelId,
        sequence: u32,
        log_time_ns: u64,
        publish_time_ns: u64,
        data: &[u8],
    ) -> Result<(), WriteError> {
        let header =
            MessageHeader { channel_id: channel.0, sequence, log_time: log_time_ns, publish_time: publish_time_ns };
        self.writer.write_to_known_channel(&header, data).map_err(|source| located(&self.temporary, source))?;
        if let Some(topic) = self.topics.get(&channel) {
            self.summary.count(topic, log_time_ns);
        }
        Ok(())
    }

    /// Closes the chunk and passes all data to the operating system, so that they survive the end of the process.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        self.writer.flush().map_err(|source| located(&self.temporary, source))
    }

    /// Syncs the flushed data to the disk, so that they survive a power failure.
    ///
    /// # Errors
    ///
    /// Errors of `fdatasync`.
    pub fn sync(&self) -> Result<(), WriteError> {
        self.disk.sync(&self.file).map_err(|source| WriteError::io(&self.temporary, source))
    }

    /// Writes the summary, syncs all data to the disk and gives the file its final name, even if its directory was
    /// moved.
    ///
    /// # Errors
    ///
    /// Errors of writing. The file then keeps its temporary name and is unlocked.
    pub fn finish(self) -> Result<FileSummary, WriteError> {
        self.finish_after(|| Ok(()))
    }

    /// As [`finish`](Self::finish), calling `before_naming` when the file is complete except for its name.
    ///
    /// # Errors
    ///
    /// As [`finish`](Self::finish), and those of `before_naming`.
    pub fn finish_after(
        mut self,
        before_naming: impl FnOnce() -> Result<(), WriteError>,
    ) -> Result<FileSummary, WriteError> {
        let finished = self.writer.finish().map(drop);
        // Not dropped: `Drop` would try again and ignore errors.
        let mut buffered = self.writer.into_inner().into_inner();
        if let Err(source) = finished.and_then(|()| Ok(buffered.flush()?)) {
            drop(buffered.into_parts());
            return Err(located(&self.temporary, source));
        }
        let at = |source| WriteError::io(&self.temporary, source);
        self.file.sync_all().map_err(at)?;
        before_naming()?;
        match self.naming {
            Naming::Whole(whole) => whole.finish()?,
            Naming::Active(directory) => {
                let [from, to] = [&self.temporary, &self.path].map(|path| path.file_name().unwrap_or_default());
                let renamed = rustix::fs::renameat(&directory, from, &directory, to).map_err(io::Error::from);
                renamed.and_then(|()| sync_open_folder(&directory)).map_err(at)?;
            }
        }
        Ok(self.summary)
    }

    /// Closes the file as it is on the disk, without writing more. It keeps its temporary name if it has one.
    pub fn abandon(self) -> PathBuf {
        drop(self.writer.into_inner().into_inner().into_parts());
        self.temporary
    }
}

fn located(path: &Path, source: McapError) -> WriteError {
    match source {
        McapError::Io(source) => WriteError::io(path, source),
        source => WriteError::Mcap { path: path.to_owned(), source },
    }
}

/// `path` with `suffix` appended to its name.
pub(super) fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name: OsString = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}
