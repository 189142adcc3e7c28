//! Walks the records of one MCAP file, however damaged, from start to end.
//!
//! The readers of the `mcap` crate refuse a file without its summary, and trust lengths they find inside chunks. This
//! one goes from record to record, believes no length beyond the bytes that are there, opens chunks itself (checking
//! their CRC before any message is given out, and taking what it can from a chunk cut short), goes on behind a chunk
//! that is damaged inside, and says what was damaged.

use std::{
    borrow::Cow,
    collections::{BTreeMap, HashMap, VecDeque},
    fs::File,
    io::{self, BufReader, Read},
    path::Path,
    sync::Arc,
};

use bytes::Bytes;
use mcap::{
    MAGIC,
    records::{Metadata, Record, op},
};

/// No chunk may hold more than this, whatever it says.
const MAX_CHUNK_BYTES: u64 = 256 << 20;

/// A schema as its file has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Schema {
    pub name: String,
    pub encoding: String,
    pub data: Vec<u8>,
}

/// A channel as its file has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    pub id: u16,
    pub topic: String,
    pub message_encoding: String,
    pub metadata: BTreeMap<String, String>,
    pub schema: Option<Arc<Schema>>,
}

/// A file within the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attachment {
    pub log_time_ns: u64,
    pub create_time_ns: u64,
    pub name: String,
    pub media_type: String,
    pub data: Vec<u8>,
}

/// A message not yet decoded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawMessage {
    pub channel: Arc<Channel>,
    pub sequence: u32,
    pub log_time_ns: u64,
    pub publish_time_ns: u64,
    /// Shares the memory of the chunk it came in.
    pub data: Bytes,
}

/// What a file holds, in its order.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    Message(RawMessage),
    Attachment(Attachment),
    Metadata(Metadata),
}

/// Something wrong with a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("byte {offset}: {what}")]
pub struct Damage {
    /// Of the record concerned.
    pub offset: u64,
    pub what: String,
    /// Whether messages or attachments may be lost; damage of indexes and of the summary loses none.
    pub loses_data: bool,
}

/// Whether chunks are opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// Everything is read.
    Messages,
    /// Chunks and messages are passed over unread: attachments, metadata and where the file ends.
    Structure,
}

/// Iterator over the [`Item`]s of a file. It ends at the end of the file or where nothing more can be read; then
/// [`damage`](Self::damage) tells.
#[derive(Debug)]
pub struct RecordWalker {
    input: BufReader<File>,
    length: u64,
    offset: u64,
    depth: Depth,
    state: State,
    queue: VecDeque<Item>,
    schemas: HashMap<u16, Arc<Schema>>,
    channels: HashMap<u16, Arc<Channel>>,
    damage: Vec<Damage>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Data,
    Summary,
    Ended,
}

impl RecordWalker {
    /// At the start of a file. `None` when it is no MCAP file at all: its first bytes are others than the magic (a file
    /// cut within the magic counts as a damaged MCAP file).
    ///
    /// # Errors
    ///
    /// What opening or reading the file yields.
    pub fn open(path: &Path, depth: Depth) -> io::Result<Option<Self>> {
        let file = File::open(path)?;
        let length = file.metadata()?.len();
        let mut walker = Self {
            input: BufReader::with_capacity(128 << 10, file),
            length,
            offset: 0,
            depth,
            state: State::Data,
            queue: VecDeque::new(),
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

    /// What was found wrong so far; complete once the iterator has ended.
    pub fn damage(&self) -> &[Damage] {
        &self.damage
    }

    /// At most `length` bytes from here, fewer at the end of the file. Memory grows with what is there.
    fn read(&mut self, length: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::with_capacity(length.min(self.length.saturating_sub(self.offset)) as usize);
        (&mut self.input).take(length).read_to_end(&mut bytes)?;
        self.offset += bytes.len() as u64;
        Ok(bytes)
    }

    fn note(&mut self, offset: u64, what: String, loses_data: bool) {
        self.damage.push(Damage { offset, what, loses_data });
    }

    fn stop(&mut self, offset: u64, what: String, loses_data: bool) {
        self.note(offset, what, loses_data);
        self.state = State::Ended;
    }

    /// Reads the next record of the file itself.
    fn step(&mut self) -> io::Result<()> {
        let start = self.offset;
        let data = self.state == State::Data;
        let head = self.read(9)?;
        let (opcode, length) = match Fields(&head).opcode_and_length() {
            Some(head) => head,
            None if head.is_empty() => {
                let what = if data { "the file was not finished" } else { "the file ends without a footer" };
                // Cut between two records: nothing of what is in the file is lost.
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
            if opcode == op::CHUNK && data && self.depth == Depth::Messages {
                let body = self.read(there)?;
                self.chunk(start, &body, true);
            }
            let name = opcode_name(opcode);
            self.stop(start, format!("{name} of {length} bytes, of which the file has {there}"), matters);
            return Ok(());
        }
        let skipped = match opcode {
            op::CHUNK | op::MESSAGE => self.depth == Depth::Structure || !data,
            op::SCHEMA | op::CHANNEL | op::ATTACHMENT | op::METADATA => !data,
            op::DATA_END | op::FOOTER => false,
            _ => true,
        };
        if skipped {
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
            op::DATA_END => self.state = State::Summary,
            op::FOOTER => self.end(start)?,
            _ => {
                if let Err(what) = self.record(opcode, &body) {
                    self.note(start, what, true);
                }
            }
        }
        Ok(())
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

    /// Queues what a chunk holds; `cut`: the file ends within it.
    fn chunk(&mut self, start: u64, body: &[u8], cut: bool) {
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
        let (records, trouble) = decompress(&header.compression, compressed, header.uncompressed_bytes, cut);
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
        let records = Bytes::from(records);
        let mut fields = Fields(&records);
        while !fields.0.is_empty() {
            let Some((opcode, record)) = fields.record() else {
                if !cut {
                    self.note(start, "chunk that ends within a record".to_owned(), true);
                }
                return;
            };
            if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
                continue;
            }
            if let Err(what) = self.record(opcode, &records.slice_ref(record)) {
                self.note(start, format!("in a chunk: {what}"), true);
            }
        }
    }

    /// Takes in a record other than a chunk.
    fn record(&mut self, opcode: u8, body: &Bytes) -> Result<(), String> {
        if opcode == op::ATTACHMENT {
            self.queue.push_back(Item::Attachment(attachment(body)?));
            return Ok(());
        }
        let record =
            mcap::parse_record(opcode, body).map_err(|error| format!("unreadable {}: {error}", opcode_name(opcode)))?;
        match record {
            Record::Schema { header, data } => {
                let schema = Schema { name: header.name, encoding: header.encoding, data: data.into_owned() };
                match self.schemas.get(&header.id) {
                    _ if header.id == 0 => return Err("schema with the number 0".to_owned()),
                    Some(known) if **known == schema => {}
                    Some(known) => {
                        return Err(format!("schema {} is both {} and {}", header.id, known.name, schema.name));
                    }
                    None => drop(self.schemas.insert(header.id, Arc::new(schema))),
                }
            }
            Record::Channel(channel) => {
                let schema = match channel.schema_id {
                    0 => None,
                    id => Some(self.schemas.get(&id).cloned().ok_or_else(|| {
                        format!("channel {} refers to schema {id}, which is not there", channel.topic)
                    })?),
                };
                let channel = Channel {
                    id: channel.id,
                    topic: channel.topic,
                    message_encoding: channel.message_encoding,
                    metadata: channel.metadata,
                    schema,
                };
                match self.channels.get(&channel.id) {
                    Some(known) if **known == channel => {}
                    Some(known) => {
                        return Err(format!("channel {} is both {} and {}", channel.id, known.topic, channel.topic));
                    }
                    None => drop(self.channels.insert(channel.id, Arc::new(channel))),
                }
            }
            Record::Message { header, data } => {
                let channel = self.channels.get(&header.channel_id).ok_or_else(|| {
                    format!("message {} on channel {}, which is not there", header.sequence, header.channel_id)
                })?;
                if self.depth == Depth::Messages {
                    self.queue.push_back(Item::Message(RawMessage {
                        channel: Arc::clone(channel),
                        sequence: header.sequence,
                        log_time_ns: header.log_time,
                        publish_time_ns: header.publish_time,
                        data: match data {
                            Cow::Borrowed(data) => body.slice_ref(data),
                            Cow::Owned(data) => data.into(),
                        },
                    }));
                }
            }
            Record::Metadata(metadata) => self.queue.push_back(Item::Metadata(metadata)),
            _ => {}
        }
        Ok(())
    }
}

impl Iterator for RecordWalker {
    type Item = Item;

    fn next(&mut self) -> Option<Item> {
        loop {
            if let Some(item) = self.queue.pop_front() {
                return Some(item);
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

/// The records of a chunk as far as they can be had, and what stopped that. Memory grows with what comes out.
fn decompress(compression: &str, compressed: &[u8], claimed: u64, cut: bool) -> (Vec<u8>, Option<String>) {
    let limit = if cut { MAX_CHUNK_BYTES } else { claimed.min(MAX_CHUNK_BYTES) };
    if !cut && claimed > limit {
        return (Vec::new(), Some(format!("chunk of {claimed} bytes, more than the limit of {limit}")));
    }
    let (records, error) = match compression {
        "" => (compressed.to_vec(), None),
        "zstd" => match zstd::stream::read::Decoder::with_buffer(compressed) {
            Ok(decoder) => read_until_error(decoder, limit),
            Err(error) => (Vec::new(), Some(error)),
        },
        "lz4" => read_until_error(lz4_flex::frame::FrameDecoder::new(compressed), limit),
        other => return (Vec::new(), Some(format!("chunk with the unknown compression {other:?}"))),
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

fn read_until_error(mut input: impl Read, limit: u64) -> (Vec<u8>, Option<io::Error>) {
    let mut bytes = Vec::new();
    // `read_to_end` keeps what came before an error.
    let error = input.by_ref().take(limit).read_to_end(&mut bytes).err();
    (bytes, error)
}

/// An attachment from its record; `mcap::parse_record` panics on one shorter than its CRC.
fn attachment(body: &[u8]) -> Result<Attachment, String> {
    let mut fields = Fields(body);
    let mut read = || {
        let attachment = Attachment {
            log_time_ns: fields.u64()?,
            create_time_ns: fields.u64()?,
            name: fields.string()?,
            media_type: fields.string()?,
            data: {
                let length = usize::try_from(fields.u64()?).ok()?;
                fields.bytes(length)?.to_vec()
            },
        };
        Some((attachment, body.len() - fields.0.len(), fields.u32()?))
    };
    let (attachment, covered, written) = read().ok_or("attachment shorter than it says")?;
    let crc = crc32fast::hash(body.get(..covered).unwrap_or_default());
    if written != 0 && written != crc {
        return Err(format!("attachment {:?} with CRC {crc:08x} where {written:08x} was written", attachment.name));
    }
    Ok(attachment)
}

/// Bytes that are taken from the front; `None` where they do not suffice.
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
