//! Reads the records of one MCAP file from start to end, even if it is damaged.
//!
//! The readers of the `mcap` crate refuse a file without a summary, and trust the lengths they find inside chunks and
//! records: a name that claims 4 GiB makes them allocate 4 GiB. This reader goes from record to record and trusts no
//! length beyond the bytes present. It opens chunks itself: it checks their CRC before it returns messages, and reads
//! as much as possible of a truncated chunk. After a chunk with internal damage it continues, and it lists all damage.
//!
//! Memory and time are bounded, whatever a file claims. One chunk is open at a time, and its records are read one by
//! one on demand. What exceeds one of the limits below is skipped and counts as damage.

use std::{
    collections::{BTreeMap, HashMap},
    fs::File,
    io::{self, BufReader, Read},
    ops::RangeInclusive,
    path::Path,
    sync::Arc,
};

use bytes::Bytes;
use mcap::{
    MAGIC,
    records::{Metadata, op},
};

use crate::files::input_file;

/// Largest chunk that is opened, in bytes of its records. Recorders close their chunks at about 1 MB, at the latest
/// after one large message.
const MAX_CHUNK_BYTES: u64 = 32 << 20;
/// Limit on the unpacked size of all chunks of a file: this multiple of the file's length, and at least the second
/// number, bytes.
const MOST_TIMES_FILE: (u64, u64) = (1000, 64 << 20);
/// Largest schema or metadata record, bytes.
const MAX_TEXT_BYTES: u64 = 1 << 20;
/// Largest channel record, bytes.
const MAX_CHANNEL_BYTES: u64 = 64 << 10;
/// Limit on all schemas and channels of a file, in bytes of their records.
const MAX_KEPT_BYTES: usize = 16 << 20;
/// Estimated memory of a channel as a multiple of its record, because its metadata is kept in a tree.
const CHANNEL_OVERHEAD: usize = 8;
/// Number of unreadable records after which the rest of a chunk is skipped.
const MAX_UNREADABLE: usize = 20;
/// Number of entries in the damage list of a file, and their length in characters.
const MAX_DAMAGE: usize = 100;
const MAX_DAMAGE_CHARS: usize = 300;
/// Allowance of a chunk's compressed form over the size of its records, header included, bytes.
const CHUNK_OVERHEAD: u64 = 1 << 20;

/// A schema as stored in the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Schema {
    pub name: String,
    pub encoding: String,
    pub data: Vec<u8>,
}

/// A channel as stored in the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    pub id: u16,
    pub topic: String,
    pub message_encoding: String,
    pub metadata: BTreeMap<String, String>,
    pub schema: Option<Arc<Schema>>,
}

/// A file attached to the recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attachment {
    pub log_time_ns: u64,
    pub create_time_ns: u64,
    pub name: String,
    pub media_type: String,
    pub data: Vec<u8>,
}

/// A message before decoding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawMessage {
    pub channel: Arc<Channel>,
    pub sequence: u32,
    pub log_time_ns: u64,
    pub publish_time_ns: u64,
    /// Shares the memory of its chunk.
    pub data: Bytes,
}

/// An element of a file, in file order.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    Message(RawMessage),
    Attachment(Attachment),
    Metadata(Metadata),
}

/// Damage of a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("byte {offset}: {what}")]
pub struct Damage {
    /// Offset of the record concerned.
    pub offset: u64,
    pub what: String,
    /// Whether messages or attachments may be lost. Damage of indexes or of the summary loses none.
    pub loses_data: bool,
}

/// How much of a file is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// Everything, including messages.
    Messages,
    /// Everything but chunks and messages: attachments, metadata, the channels listed in the summary, and the end of
    /// the file.
    Structure,
}

/// Iterator over the [`Item`]s of a file. It ends at the end of the file or where nothing more can be read; the reason
/// is in [`damage`](Self::damage).
#[derive(Debug)]
pub struct RecordWalker {
    input: BufReader<File>,
    length: u64,
    offset: u64,
    depth: Depth,
    /// Chunks without messages of these log times are not opened.
    log_times_ns: Option<RangeInclusive<u64>>,
    state: State,
    /// Read but not returned yet.
    next: Option<Item>,
    chunk: Option<OpenChunk>,
    /// Bytes of the records of all chunks opened so far.
    unpacked: u64,
    /// Bytes of the records of all schemas and channels, including overheads.
    kept: usize,
    schemas: HashMap<u16, Arc<Schema>>,
    channels: HashMap<u16, Arc<Channel>>,
    damage: Vec<Damage>,
}

/// A chunk whose records are being read.
#[derive(Debug)]
struct OpenChunk {
    /// Offset of its record in the file.
    start: u64,
    /// Whether the file ends within the chunk.
    cut: bool,
    records: Bytes,
    unreadable: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Data,
    Summary,
    Ended,
}

impl RecordWalker {
    /// Opens a file at its start. `None` if it is not MCAP, that is, if its first bytes differ from the magic bytes. A
    /// file truncated within the magic bytes counts as a damaged MCAP file.
    ///
    /// # Errors
    ///
    /// Errors of opening or reading the file.
    pub fn open(path: &Path, depth: Depth) -> io::Result<Option<Self>> {
        let file = input_file::open(path, input_file::ANY_SIZE)?;
        let length = file.metadata()?.len();
        let mut walker = Self {
            input: BufReader::with_capacity(128 << 10, file),
            length,
            offset: 0,
            depth,
            log_times_ns: None,
            state: State::Data,
            next: None,
            chunk: None,
            unpacked: 0,
            kept: 0,
            schemas: HashMap::new(),
            channels: HashMap::new(),
            damage: Vec::new(),
        };
        let magic = walker.read(MAGIC.len() as u64)?;
        if !MAGIC.starts_with(&magic) {
            return Ok(None);
        }
        if magic.len() < MAGIC.len() {
            walker.stop(0, "the file ends within its first 8 bytes".to_owned(), true);
        }
        Ok(Some(walker))
    }

    /// Opens a file to read the chunks with messages of some log times. They need the channels that the other chunks
    /// define: those of the summary. Without a summary all chunks are read.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub fn open_between(path: &Path, log_times_ns: RangeInclusive<u64>) -> io::Result<Option<Self>> {
        let (Some(mut structure), Some(mut walker)) =
            (Self::open(path, Depth::Structure)?, Self::open(path, Depth::Messages)?)
        else {
            return Ok(None);
        };
        structure.by_ref().for_each(drop);
        if structure.damage.is_empty() && !structure.channels.is_empty() {
            walker.log_times_ns = Some(log_times_ns);
            (walker.schemas, walker.channels, walker.kept) = (structure.schemas, structure.channels, structure.kept);
        }
        Ok(Some(walker))
    }

    /// Damage found so far; complete once the iterator has ended.
    pub fn damage(&self) -> &[Damage] {
        &self.damage
    }

    /// Bytes of records unpacked so far. The messages returned share their memory.
    pub fn unpacked_bytes(&self) -> u64 {
        self.unpacked
    }

    /// Channels found so far; complete once the iterator has ended.
    pub fn channels(&self) -> impl Iterator<Item = &Arc<Channel>> {
        self.channels.values()
    }

    /// Reads at most `length` bytes, fewer at the end of the file. Memory is only allocated for bytes that exist.
    fn read(&mut self, length: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::with_capacity(length.min(self.length.saturating_sub(self.offset)) as usize);
        (&mut self.input).take(length).read_to_end(&mut bytes)?;
        self.offset += bytes.len() as u64;
        Ok(bytes)
    }

    /// Adds to the damage list. Once it is full, one last entry says that there is more; another one is added if data
    /// are lost only after that.
    fn note(&mut self, offset: u64, mut what: String, loses_data: bool) {
        if self.damage.len() >= MAX_DAMAGE {
            let said = |damage: &Damage| damage.loses_data || !loses_data;
            if self.damage.len() > MAX_DAMAGE && self.damage[MAX_DAMAGE..].iter().any(said) {
                return;
            }
            what = format!("more damage than the {MAX_DAMAGE} listed");
        }
        if let Some((end, _)) = what.char_indices().nth(MAX_DAMAGE_CHARS) {
            what.truncate(end);
            what.push_str("...");
        }
        self.damage.push(Damage { offset, what, loses_data });
    }

    fn stop(&mut self, offset: u64, what: String, loses_data: bool) {
        self.note(offset, what, loses_data);
        self.state = State::Ended;
    }

    /// Reads the next record of the file.
    fn step(&mut self) -> io::Result<()> {
        let start = self.offset;
        let data = self.state == State::Data;
        let head = self.read(9)?;
        let (opcode, length) = match Fields(&head).opcode_and_length() {
            Some(head) => head,
            None if head.is_empty() => {
                let what = if data { "the file was not finished" } else { "the file ends without a footer" };
                // The file was cut between two records: no data in the file are lost.
                self.stop(start, what.to_owned(), false);
                return Ok(());
            }
            None => {
                self.stop(start, "the file ends within the head of a record".to_owned(), data);
                return Ok(());
            }
        };
        let there = self.length.saturating_sub(self.offset);
        let matters = data && !matches!(opcode, op::MESSAGE_INDEX | op::DATA_END);
        if length > there {
            if opcode == op::CHUNK && data && self.depth == Depth::Messages && there <= largest(opcode) {
                let body = Bytes::from(self.read(there)?);
                self.chunk(start, &body, true);
            }
            let name = opcode_name(opcode);
            self.stop(start, format!("{name} of {length} bytes, of which the file has {there}"), matters);
            return Ok(());
        }
        let skipped = match opcode {
            op::CHUNK if data && length >= 16 && self.is_elsewhere()? => true,
            op::CHUNK | op::MESSAGE => self.depth == Depth::Structure || !data,
            op::SCHEMA | op::CHANNEL => !data && self.depth == Depth::Messages,
            op::ATTACHMENT | op::METADATA => !data,
            op::DATA_END | op::FOOTER => false,
            _ => true,
        };
        let too_large = length > largest(opcode);
        if too_large && !skipped {
            let what = format!("{} of {length} bytes, more than the limit of {}", opcode_name(opcode), largest(opcode));
            self.note(start, what, matters);
        }
        if skipped || too_large {
            self.input.seek_relative(i64::try_from(length).map_err(io::Error::other)?)?;
            self.offset += length;
            return Ok(());
        }
        let body = Bytes::from(self.read(length)?);
        if body.len() as u64 != length {
            self.stop(start, "the file became shorter while it was read".to_owned(), matters);
            return Ok(());
        }
        match opcode {
            op::CHUNK => self.chunk(start, &body, false),
            op::ATTACHMENT => match attachment(body) {
                Ok(attachment) => self.next = Some(Item::Attachment(attachment)),
                Err(what) => self.note(start, what, true),
            },
            op::DATA_END => self.state = State::Summary,
            op::FOOTER => self.end(start)?,
            _ => {
                if opcode == op::MESSAGE {
                    self.unpacked += length;
                }
                if let Err(what) = self.record(opcode, &body) {
                    self.note(start, what, data);
                }
            }
        }
        Ok(())
    }

    /// Whether the chunk that follows has no message of the log times that are read.
    fn is_elsewhere(&mut self) -> io::Result<bool> {
        let Some(wanted) = &self.log_times_ns else { return Ok(false) };
        // The first and the last log time are the first fields of a chunk.
        let mut times = [0; 16];
        self.input.read_exact(&mut times)?;
        self.input.seek_relative(-16)?;
        let mut fields = Fields(&times);
        Ok(fields.u64().zip(fields.u64()).is_some_and(|(first, last)| last < *wanted.start() || first > *wanted.end()))
    }

    fn end(&mut self, start: u64) -> io::Result<()> {
        let was_summary = self.state == State::Summary;
        self.state = State::Ended;
        if !was_summary {
            self.note(start, "footer within the data".to_owned(), true);
        }
        let end = self.offset;
        if self.read(MAGIC.len() as u64)? != MAGIC {
            self.note(end, "the file does not end with its magic bytes".to_owned(), false);
        } else if self.offset < self.length {
            self.note(self.offset, format!("{} bytes behind the end", self.length - self.offset), false);
        }
        Ok(())
    }

    /// Opens a chunk; `cut` says that the file ends within it.
    fn chunk(&mut self, start: u64, body: &Bytes, cut: bool) {
        let mut fields = Fields(body);
        let Some(header) = ChunkHeader::read(&mut fields) else {
            if !cut {
                self.note(start, "chunk with an unreadable header".to_owned(), true);
            }
            return;
        };
        let Fields(rest) = fields;
        let compressed = match usize::try_from(header.compressed_bytes).ok().and_then(|length| rest.get(..length)) {
            Some(compressed) => compressed,
            None if cut => rest,
            None => {
                let what = format!("chunk of {} bytes in a record of {}", header.compressed_bytes, body.len());
                return self.note(start, what, true);
            }
        };
        let (times, at_least) = MOST_TIMES_FILE;
        let budget = self.length.saturating_mul(times).max(at_least);
        let claimed = header.uncompressed_bytes;
        // A chunk that claims too much on its own is refused below, since its claim may be damaged.
        if !cut && claimed <= MAX_CHUNK_BYTES && self.unpacked.saturating_add(claimed) > budget {
            let what = format!(
                "chunk of {claimed} bytes, with which a file of {} unpacks to more than the limit of {budget}; what \
                 follows is not read",
                self.length
            );
            return self.stop(start, what, true);
        }
        let limit = MAX_CHUNK_BYTES.min(budget.saturating_sub(self.unpacked));
        let (records, trouble) = decompress(&header.compression, body, compressed, claimed, limit, cut);
        self.unpacked += records.len() as u64;
        if !cut {
            if let Some(what) = trouble {
                return self.note(start, what, true);
            }
            let crc = crc32fast::hash(&records);
            if header.crc != 0 && header.crc != crc {
                let what = format!("chunk with CRC {crc:08x} where {:08x} was written", header.crc);
                return self.note(start, what, true);
            }
        }
        self.chunk = Some(OpenChunk { start, cut, records, unreadable: 0 });
    }

    /// Reads an open chunk up to its next message or its end.
    fn step_in(&mut self, mut chunk: OpenChunk) {
        while self.next.is_none() && !chunk.records.is_empty() {
            let mut fields = Fields(&chunk.records);
            let Some((opcode, record)) = fields.record() else {
                if !chunk.cut {
                    self.note(chunk.start, "chunk that ends within a record".to_owned(), true);
                }
                return;
            };
            let (record, rest) = (chunk.records.slice_ref(record), chunk.records.slice_ref(fields.0));
            chunk.records = rest;
            if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
                continue;
            }
            if let Err(what) = self.record(opcode, &record) {
                self.note(chunk.start, format!("in a chunk: {what}"), true);
                chunk.unreadable += 1;
                if chunk.unreadable == MAX_UNREADABLE {
                    let what = format!("in a chunk: {MAX_UNREADABLE} unreadable records; the rest of it is not read");
                    return self.note(chunk.start, what, true);
                }
            }
        }
        if !chunk.records.is_empty() {
            self.chunk = Some(chunk);
        }
    }

    /// Processes a record other than a chunk or an attachment.
    fn record(&mut self, opcode: u8, body: &Bytes) -> Result<(), String> {
        if body.len() as u64 > largest(opcode) {
            let limit = largest(opcode);
            return Err(format!("{} of {} bytes, more than the limit of {limit}", opcode_name(opcode), body.len()));
        }
        let unreadable = || format!("unreadable {}", opcode_name(opcode));
        let mut fields = Fields(body);
        match opcode {
            op::SCHEMA => {
                let (id, schema) = fields.schema().ok_or_else(unreadable)?;
                match self.schemas.get(&id) {
                    _ if id == 0 => return Err("schema with the number 0".to_owned()),
                    Some(known) if **known == schema => {}
                    Some(known) => return Err(format!("schema {id} is both {} and {}", known.name, schema.name)),
                    None => {
                        self.keep(body.len())?;
                        self.schemas.insert(id, Arc::new(schema));
                    }
                }
            }
            op::CHANNEL => {
                let (schema_id, mut channel) = fields.channel().ok_or_else(unreadable)?;
                if schema_id != 0 {
                    let schema = self.schemas.get(&schema_id).cloned();
                    channel.schema = Some(schema.ok_or_else(|| {
                        format!("channel {} refers to schema {schema_id}, which is not there", channel.topic)
                    })?);
                }
                match self.channels.get(&channel.id) {
                    Some(known) if **known == channel => {}
                    Some(known) => {
                        return Err(format!("channel {} is both {} and {}", channel.id, known.topic, channel.topic));
                    }
                    None => {
                        self.keep(CHANNEL_OVERHEAD * body.len())?;
                        self.channels.insert(channel.id, Arc::new(channel));
                    }
                }
            }
            op::MESSAGE => {
                let (channel, sequence, log_time_ns, publish_time_ns) = fields.message().ok_or_else(unreadable)?;
                let known = self.channels.get(&channel);
                let channel =
                    known.ok_or_else(|| format!("message {sequence} on channel {channel}, which is not there"))?;
                if self.depth == Depth::Messages {
                    self.next = Some(Item::Message(RawMessage {
                        channel: Arc::clone(channel),
                        sequence,
                        log_time_ns,
                        publish_time_ns,
                        data: body.slice_ref(fields.0),
                    }));
                }
            }
            op::METADATA => {
                let (name, metadata) =
                    fields.string().and_then(|name| Some((name, fields.map()?))).ok_or_else(unreadable)?;
                self.next = Some(Item::Metadata(Metadata { name, metadata }));
            }
            _ => {}
        }
        Ok(())
    }

    /// Adds to the memory counted for schemas and channels; an error if it exceeds the limit.
    fn keep(&mut self, bytes: usize) -> Result<(), String> {
        if self.kept + bytes > MAX_KEPT_BYTES {
            return Err(format!("schemas and channels of more than the limit of {MAX_KEPT_BYTES} bytes"));
        }
        self.kept += bytes;
        Ok(())
    }
}

impl Iterator for RecordWalker {
    type Item = Item;

    fn next(&mut self) -> Option<Item> {
        loop {
            if let Some(item) = self.next.take() {
                return Some(item);
            }
            if let Some(chunk) = self.chunk.take() {
                self.step_in(chunk);
                continue;
            }
            if self.state == State::Ended {
                return None;
            }
            let offset = self.offset;
            if let Err(error) = self.step() {
                self.stop(offset, format!("cannot be read: {error}"), true);
            }
        }
    }
}

struct ChunkHeader {
    uncompressed_bytes: u64,
    crc: u32,
    compression: String,
    compressed_bytes: u64,
}

impl ChunkHeader {
    fn read(fields: &mut Fields) -> Option<Self> {
        let _start_and_end_time = fields.bytes(16)?;
        Some(Self {
            uncompressed_bytes: fields.u64()?,
            crc: fields.u32()?,
            compression: fields.string()?,
            compressed_bytes: fields.u64()?,
        })
    }
}

/// The largest record that is read, by kind, bytes.
fn largest(opcode: u8) -> u64 {
    match opcode {
        op::CHUNK => MAX_CHUNK_BYTES + CHUNK_OVERHEAD,
        op::MESSAGE => MAX_CHUNK_BYTES,
        op::ATTACHMENT => input_file::RIG_PART + MAX_TEXT_BYTES,
        op::CHANNEL => MAX_CHANNEL_BYTES,
        _ => MAX_TEXT_BYTES,
    }
}

/// The readable records of a chunk, and the error at which reading stopped. At most `limit` bytes are unpacked.
fn decompress(
    compression: &str,
    body: &Bytes,
    compressed: &[u8],
    claimed: u64,
    limit: u64,
    cut: bool,
) -> (Bytes, Option<String>) {
    if !cut && claimed > limit {
        return (Bytes::new(), Some(format!("chunk of {claimed} bytes, more than the limit of {limit}")));
    }
    let limit = claimed.min(limit);
    let (records, error) = match compression {
        "" => (body.slice_ref(compressed), None),
        "zstd" => match zstd_decoder(compressed) {
            Ok(decoder) => read_until_error(decoder, limit),
            Err(error) => (Bytes::new(), Some(error)),
        },
        "lz4" => read_until_error(lz4_flex::frame::FrameDecoder::new(compressed), limit),
        other => return (Bytes::new(), Some(format!("chunk with the unknown compression {other:?}"))),
    };
    let trouble = match error {
        Some(error) => Some(format!("chunk cannot be decompressed: {error}")),
        None if records.len() as u64 != claimed => {
            Some(format!("chunk of {} bytes where {claimed} were written", records.len()))
        }
        None => None,
    };
    (records, trouble)
}

fn zstd_decoder(compressed: &[u8]) -> io::Result<zstd::stream::read::Decoder<'static, &[u8]>> {
    let mut decoder = zstd::stream::read::Decoder::with_buffer(compressed)?;
    // Limit the decoder's window of previous data, whatever the frame requests.
    decoder.window_log_max(MAX_CHUNK_BYTES.ilog2())?;
    Ok(decoder)
}

fn read_until_error(mut input: impl Read, limit: u64) -> (Bytes, Option<io::Error>) {
    // A single allocation: a growing buffer would be copied and end up twice as large.
    let mut bytes = Vec::with_capacity(limit as usize);
    // `read_to_end` keeps what was read before an error.
    let error = input.by_ref().take(limit).read_to_end(&mut bytes).err();
    bytes.shrink_to_fit();
    (bytes.into(), error)
}

/// Parses an attachment record.
fn attachment(body: Bytes) -> Result<Attachment, String> {
    let mut fields = Fields(&body);
    let mut read = || {
        let attachment = Attachment {
            log_time_ns: fields.u64()?,
            create_time_ns: fields.u64()?,
            name: fields.string()?,
            media_type: fields.string()?,
            data: vec![],
        };
        let length = usize::try_from(fields.u64()?).ok()?;
        let data = fields.bytes(length)?.len();
        let end = body.len() - fields.0.len();
        Some((attachment, end - data..end, fields.u32()?))
    };
    let (mut attachment, data, written) = read().ok_or("attachment shorter than its length field")?;
    let crc = crc32fast::hash(body.get(..data.end).unwrap_or_default());
    if written != 0 && written != crc {
        return Err(format!("attachment {:?} with CRC {crc:08x} where {written:08x} was written", attachment.name));
    }
    // In place, since it may be large.
    let mut bytes = Vec::from(body);
    bytes.truncate(data.end);
    bytes.drain(..data.start);
    attachment.data = bytes;
    Ok(attachment)
}

/// Parses values from the front of a byte string; `None` if too few bytes are left.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn bytes(&mut self, length: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(head)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.bytes(N)?.try_into().ok()
    }

    fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn string(&mut self) -> Option<String> {
        let length = usize::try_from(self.u32()?).ok()?;
        String::from_utf8(self.bytes(length)?.to_vec()).ok()
    }

    fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    /// A map: its length in bytes, then keys and values in turn. Every key may occur once.
    fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let length = usize::try_from(self.u32()?).ok()?;
        let mut fields = Fields(self.bytes(length)?);
        let mut map = BTreeMap::new();
        while !fields.0.is_empty() {
            let (key, value) = (fields.string()?, fields.string()?);
            if map.insert(key, value).is_some() {
                return None;
            }
        }
        Some(map)
    }

    /// A schema and its id.
    fn schema(&mut self) -> Option<(u16, Schema)> {
        let (id, name, encoding) = (self.u16()?, self.string()?, self.string()?);
        let length = usize::try_from(self.u32()?).ok()?;
        Some((id, Schema { name, encoding, data: self.bytes(length)?.to_vec() }))
    }

    /// The schema id of a channel, and the channel without its schema.
    fn channel(&mut self) -> Option<(u16, Channel)> {
        let (id, schema_id) = (self.u16()?, self.u16()?);
        let (topic, message_encoding, metadata) = (self.string()?, self.string()?, self.map()?);
        Some((schema_id, Channel { id, topic, message_encoding, metadata, schema: None }))
    }

    /// The channel id of a message, its sequence number, log time and publish time. The remaining bytes are its data.
    fn message(&mut self) -> Option<(u16, u32, u64, u64)> {
        Some((self.u16()?, self.u32()?, self.u64()?, self.u64()?))
    }

    fn opcode_and_length(&mut self) -> Option<(u8, u64)> {
        let [opcode] = self.array()?;
        Some((opcode, self.u64()?))
    }

    fn record(&mut self) -> Option<(u8, &'a [u8])> {
        let (opcode, length) = self.opcode_and_length()?;
        Some((opcode, self.bytes(usize::try_from(length).ok()?)?))
    }
}

fn opcode_name(opcode: u8) -> String {
    match opcode {
        op::HEADER => "header".to_owned(),
        op::FOOTER => "footer".to_owned(),
        op::SCHEMA => "schema".to_owned(),
        op::CHANNEL => "channel".to_owned(),
        op::MESSAGE => "message".to_owned(),
        op::CHUNK => "chunk".to_owned(),
        op::MESSAGE_INDEX => "message index".to_owned(),
        op::ATTACHMENT => "attachment".to_owned(),
        op::METADATA => "metadata".to_owned(),
        op::DATA_END => "data end".to_owned(),
        other => format!("record 0x{other:02x}"),
    }
}
