//! WAV files of measured sound or acceleration: RIFF, RF64 and BW64, with integers of 16, 24 and 32 bits and floating
//! point numbers of 32 and 64 bits.
//!
//! A file is read in pieces, so its size is not limited. The end of a recording that was cut off is missing, which
//! [`Wav::missing_bytes`] states.
//!
//! Source: EBU Tech 3306, "MBWF/RF64: an extended file format for audio", version 1.1 (2009), which includes RIFF/WAVE;
//! Microsoft, "Multiple channel audio data and WAVE files" (2007), for `WAVE_FORMAT_EXTENSIBLE`.

use std::io::{self, Read, Seek, SeekFrom, Write};

/// Most channels.
pub const MOST_CHANNELS: u16 = 64;
/// Most chunks before the samples.
const MOST_CHUNKS: usize = 1000;
/// Format codes of the chunk `fmt `.
const INTEGER: u16 = 1;
const FLOAT: u16 = 3;
const EXTENSIBLE: u16 = 0xfffe;
/// The size of a chunk whose size is elsewhere or was not known when it was written.
const NO_SIZE: u32 = u32::MAX;

/// How samples are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    Integer16,
    Integer24,
    Integer32,
    Float32,
    Float64,
}

/// A WAV file that is being read.
#[derive(Debug)]
pub struct Wav<R> {
    file: String,
    reader: R,
    pub encoding: Encoding,
    pub channels: u16,
    pub sample_rate_hz: u32,
    /// Samples of each channel.
    pub frames: u64,
    /// Bytes of samples that the file claims and does not have.
    pub missing_bytes: u64,
    /// Samples of each channel that were read.
    read: u64,
    /// Position of the next byte.
    position: u64,
    bytes: Vec<u8>,
}

/// Why a WAV file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum WavError {
    #[error("{file}, byte {position}: {source}")]
    Read { file: String, position: u64, source: io::Error },
    #[error("{file}, byte {position}: {found}, expected {expected}")]
    Expected { file: String, position: u64, found: String, expected: String },
}

impl Encoding {
    /// Bytes of a sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::Integer16 => 2,
            Self::Integer24 => 3,
            Self::Integer32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }

    /// Description for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Integer16 => "16 bit",
            Self::Integer24 => "24 bit",
            Self::Integer32 => "32 bit",
            Self::Float32 => "32 bit float",
            Self::Float64 => "64 bit float",
        }
    }

    /// A sample from its bytes; integers in parts of full scale.
    fn decode(self, bytes: &[u8]) -> f32 {
        match (self, bytes) {
            (Self::Integer16, &[a, b]) => f32::from(i16::from_le_bytes([a, b])) / 32_768.0,
            (Self::Integer24, &[a, b, c]) => (i32::from_le_bytes([0, a, b, c]) >> 8) as f32 / 8_388_608.0,
            (Self::Integer32, &[a, b, c, d]) => i32::from_le_bytes([a, b, c, d]) as f32 / 2_147_483_648.0,
            (Self::Float32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]),
            (Self::Float64, &[a, b, c, d, e, f, g, h]) => f64::from_le_bytes([a, b, c, d, e, f, g, h]) as f32,
            (_, other) => unreachable!("{} bytes for a sample of {} bytes", other.len(), self.bytes()),
        }
    }
}

impl<R: Read + Seek> Wav<R> {
    /// Reads the header of `file`, up to the first sample.
    ///
    /// # Errors
    /// [`WavError`], naming file, position, what is there and what was expected.
    pub fn open(file: &str, reader: R) -> Result<Self, WavError> {
        let mut wav = Self {
            file: file.to_owned(),
            reader,
            encoding: Encoding::Integer16,
            channels: 0,
            sample_rate_hz: 0,
            frames: 0,
            missing_bytes: 0,
            read: 0,
            position: 0,
            bytes: vec![],
        };
        let length = wav.reader.seek(SeekFrom::End(0)).map_err(|source| wav.failed(source))?;
        wav.reader.rewind().map_err(|source| wav.failed(source))?;
        let riff = wav.take::<12>(length, "the header of a WAV file: RIFF, a size and WAVE")?;
        let is_long = [b"RF64", b"BW64"].iter().any(|id| riff.starts_with(*id));
        if !(is_long || riff.starts_with(b"RIFF")) || &riff[8..] != b"WAVE" {
            return Err(wav.expected(0, printable(&riff), "a WAV file: RIFF, RF64 or BW64, a size and WAVE"));
        }
        let (mut block, mut long_data) = (None, None);
        for _ in 0..MOST_CHUNKS {
            let at = wav.position;
            let header = wav.take::<8>(length, "a chunk `data` with the samples")?;
            let size = u32_at(&header, 4);
            match &header[..4] {
                b"fmt " => {
                    block = Some(wav.format(length, size)?);
                    wav.skip(at + 8, u64::from(size), length)?;
                }
                b"ds64" => {
                    let sizes = wav.take::<16>(length, "the sizes of a chunk `ds64`")?;
                    long_data = Some(u64::from(u32_at(&sizes, 8)) | u64::from(u32_at(&sizes, 12)) << 32);
                    wav.skip(at + 8, u64::from(size), length)?;
                }
                b"data" => {
                    let Some(block) = block else {
                        return Err(wav.expected(at, "a chunk `data`".to_owned(), "a chunk `fmt ` before it"));
                    };
                    let there = length - wav.position;
                    // A program that was cut off has not come to write the size.
                    let claimed = match (size, long_data) {
                        (NO_SIZE, Some(size)) => size,
                        (0 | NO_SIZE, _) => there,
                        _ => u64::from(size),
                    };
                    let available = claimed.min(there);
                    wav.frames = available / block;
                    wav.missing_bytes = claimed - wav.frames * block;
                    return Ok(wav);
                }
                _ => wav.skip(at + 8, u64::from(size), length)?,
            }
        }
        Err(wav.expected(wav.position, format!("{MOST_CHUNKS} other chunks"), "a chunk `data`"))
    }

    /// Reads the chunk `fmt ` of `size` bytes; returns the bytes of one sample of all channels.
    fn format(&mut self, length: u64, size: u32) -> Result<u64, WavError> {
        let at = self.position;
        let what = "the 16 bytes of a chunk `fmt `";
        if size < 16 {
            return Err(self.expected(at - 4, format!("a size of {size}"), "at least 16"));
        }
        let format = self.take::<16>(length, what)?;
        let [mut code, channels, block, bits] = [0, 2, 12, 14].map(|at| u16_at(&format, at));
        if code == EXTENSIBLE {
            if size < 40 {
                return Err(self.expected(at - 4, format!("a size of {size}"), "at least 40 for an extensible format"));
            }
            let extension = self.take::<24>(length, "the 24 bytes of an extensible format")?;
            code = u16_at(&extension, 8);
        }
        self.encoding = match (code, bits) {
            (INTEGER, 16) => Encoding::Integer16,
            (INTEGER, 24) => Encoding::Integer24,
            (INTEGER, 32) => Encoding::Integer32,
            (FLOAT, 32) => Encoding::Float32,
            (FLOAT, 64) => Encoding::Float64,
            _ => {
                let found = format!("format {code} with {bits} bits");
                return Err(self.expected(
                    at,
                    found,
                    "integers (1) of 16, 24 or 32 bits or floats (3) of 32 or 64 bits",
                ));
            }
        };
        if channels == 0 || channels > MOST_CHANNELS {
            return Err(self.expected(at + 2, format!("{channels} channels"), &format!("1 to {MOST_CHANNELS}")));
        }
        let bytes = self.encoding.bytes() * usize::from(channels);
        if usize::from(block) != bytes {
            return Err(self.expected(at + 12, format!("a block of {block} bytes"), &format!("{bytes} bytes")));
        }
        (self.channels, self.sample_rate_hz) = (channels, u32_at(&format, 4));
        Ok(bytes as u64)
    }

    /// Goes to the end of a chunk, which is padded to an even size.
    fn skip(&mut self, from: u64, size: u64, length: u64) -> Result<(), WavError> {
        let to = from + size + size % 2;
        if to > length {
            let found = format!("a chunk of {size} bytes, {} of which are there", length - from.min(length));
            return Err(self.expected(from, found, "a chunk `data` behind it"));
        }
        self.position = self.reader.seek(SeekFrom::Start(to)).map_err(|source| self.failed(source))?;
        Ok(())
    }

    fn take<const N: usize>(&mut self, length: u64, expected: &str) -> Result<[u8; N], WavError> {
        let left = length.saturating_sub(self.position);
        if left < N as u64 {
            return Err(self.expected(self.position, format!("{left} bytes up to the end of the file"), expected));
        }
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes).map_err(|source| self.failed(source))?;
        self.position += N as u64;
        Ok(bytes)
    }

    /// Reads the next samples, at most `most` of each channel, and appends them to the vectors, one for each channel.
    /// Returns how many; 0 at the end.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read(&mut self, most: usize, channels: &mut [Vec<f32>]) -> Result<usize, WavError> {
        assert_eq!(channels.len(), usize::from(self.channels), "a vector for each channel");
        let count = (self.frames - self.read).min(most as u64) as usize;
        let size = self.encoding.bytes();
        self.bytes.resize(count * size * channels.len(), 0);
        self.reader.read_exact(&mut self.bytes).map_err(|source| WavError::Read {
            file: self.file.clone(),
            position: self.position,
            source,
        })?;
        for (index, sample) in self.bytes.chunks_exact(size).enumerate() {
            channels[index % usize::from(self.channels)].push(self.encoding.decode(sample));
        }
        self.position += self.bytes.len() as u64;
        self.read += count as u64;
        Ok(count)
    }

    fn failed(&self, source: io::Error) -> WavError {
        WavError::Read { file: self.file.clone(), position: self.position, source }
    }

    fn expected(&self, position: u64, found: String, expected: &str) -> WavError {
        WavError::Expected { file: self.file.clone(), position, found, expected: expected.to_owned() }
    }
}

/// Writes one channel as 32-bit floats.
///
/// # Errors
/// Errors of writing; more than 4 GiB.
pub fn write(out: &mut dyn Write, sample_rate_hz: u32, samples: &[f32]) -> io::Result<()> {
    write_header(out, sample_rate_hz, u32::try_from(samples.len()).map_err(|_| too_long())?)?;
    write_samples(out, samples)
}

fn too_long() -> io::Error {
    io::Error::new(io::ErrorKind::FileTooLarge, "a WAV file holds at most 4 GiB of samples")
}

/// Writes what is in front of `count` samples of one channel, 32-bit floats.
///
/// # Errors
/// Errors of writing; more than 4 GiB.
pub fn write_header(out: &mut dyn Write, sample_rate_hz: u32, count: u32) -> io::Result<()> {
    let data = count.checked_mul(4).ok_or_else(too_long)?;
    let riff = data.checked_add(4 + 26 + 12 + 8).unwrap_or(NO_SIZE);
    out.write_all(b"RIFF")?;
    out.write_all(&riff.to_le_bytes())?;
    out.write_all(b"WAVEfmt ")?;
    out.write_all(&18_u32.to_le_bytes())?;
    for value in [FLOAT, 1] {
        out.write_all(&value.to_le_bytes())?;
    }
    for value in [sample_rate_hz, 4 * sample_rate_hz] {
        out.write_all(&value.to_le_bytes())?;
    }
    for value in [4_u16, 32, 0] {
        out.write_all(&value.to_le_bytes())?;
    }
    // Formats other than integers state their number of samples in a chunk of its own.
    out.write_all(b"fact")?;
    for value in [4, count] {
        out.write_all(&value.to_le_bytes())?;
    }
    out.write_all(b"data")?;
    out.write_all(&data.to_le_bytes())
}

/// Writes samples behind their header.
///
/// # Errors
/// Errors of writing.
pub fn write_samples(out: &mut dyn Write, samples: &[f32]) -> io::Result<()> {
    samples.iter().try_for_each(|sample| out.write_all(&sample.to_le_bytes()))
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from(u16_at(bytes, at)) | u32::from(u16_at(bytes, at + 2)) << 16
}

/// The first bytes of a file for people.
fn printable(bytes: &[u8]) -> String {
    format!("\"{}\"", bytes.escape_ascii())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    /// A file of these chunks.
    fn riff(id: &[u8], chunks: &[(&[u8; 4], u32, Vec<u8>)]) -> Vec<u8> {
        let mut bytes = [id, &[0; 4], b"WAVE"].concat();
        for (id, size, content) in chunks {
            bytes.extend([&id[..], &size.to_le_bytes(), content].concat());
        }
        bytes
    }

    fn format(code: u16, channels: u16, bits: u16) -> (&'static [u8; 4], u32, Vec<u8>) {
        let block = channels * bits / 8;
        let mut bytes = [code.to_le_bytes(), channels.to_le_bytes()].concat();
        bytes.extend(48_000_u32.to_le_bytes());
        bytes.extend((48_000 * u32::from(block)).to_le_bytes());
        bytes.extend([block.to_le_bytes(), bits.to_le_bytes()].concat());
        (b"fmt ", bytes.len() as u32, bytes)
    }

    fn read(bytes: &[u8]) -> Result<(Vec<Vec<f32>>, u64), WavError> {
        let mut wav = Wav::open("a.wav", Cursor::new(bytes))?;
        let mut channels = vec![vec![]; usize::from(wav.channels)];
        while wav.read(3, &mut channels)? > 0 {}
        Ok((channels, wav.missing_bytes))
    }

    fn error(bytes: &[u8]) -> String {
        read(bytes).unwrap_err().to_string()
    }

    #[test]
    fn every_encoding_gives_its_values() {
        let samples = |code, bits, data: &[u8]| {
            let bytes = riff(b"RIFF", &[format(code, 1, bits), (b"data", data.len() as u32, data.to_vec())]);
            let (channels, missing) = read(&bytes).unwrap();
            assert_eq!(missing, 0);
            channels[0].clone()
        };
        assert_eq!(samples(1, 16, &[0, 0x40, 0, 0x80, 1, 0]), [0.5, -1.0, 1.0 / 32_768.0]);
        assert_eq!(samples(1, 24, &[0, 0, 0x40, 0, 0, 0x80, 1, 0, 0]), [0.5, -1.0, 1.0 / 8_388_608.0]);
        assert_eq!(samples(1, 32, &[0, 0, 0, 0x40, 0, 0, 0, 0x80]), [0.5, -1.0]);
        assert_eq!(samples(3, 32, &[-2.5_f32, 1e-9].map(f32::to_le_bytes).concat()), [-2.5, 1e-9]);
        assert_eq!(samples(3, 64, &[-2.5_f64, 1e-9].map(f64::to_le_bytes).concat()), [-2.5, 1e-9]);
    }

    #[test]
    fn channels_other_chunks_and_long_forms_are_read() {
        let data: Vec<u8> = (0..10_u16).flat_map(|k| (k * 4096).to_le_bytes()).collect();
        let other = (b"bext", 3, vec![1, 2, 3, 0]);
        let expected = vec![vec![0.0, 0.25, 0.5, 0.75, -1.0], vec![0.125, 0.375, 0.625, 0.875, -0.875]];
        let plain = riff(b"RIFF", &[other.clone(), format(1, 2, 16), other.clone(), (b"data", 20, data.clone())]);
        assert_eq!(read(&plain).unwrap(), (expected.clone(), 0));
        let mut sizes = [0_u64, 20, 5].map(u64::to_le_bytes).concat();
        sizes.extend([0; 4]);
        let long = [(b"ds64", 28, sizes), format(1, 2, 16), (b"data", NO_SIZE, [data.clone(), vec![9; 7]].concat())];
        for id in [b"RF64", b"BW64"] {
            assert_eq!(read(&riff(id, &long)).unwrap(), (expected.clone(), 0));
        }
        // A recorder that was cut off: without a size, or with more than there is.
        for (size, missing) in [(0, 0), (NO_SIZE, 0), (100, 80)] {
            let cut = riff(b"RIFF", &[format(1, 2, 16), (b"data", size, data.clone())]);
            assert_eq!(read(&cut).unwrap(), (expected.clone(), missing));
        }
    }

    #[test]
    fn what_is_written_reads_back() {
        let mut bytes = vec![];
        write(&mut bytes, 51_200, &[0.5, -3.0, 1e-7]).unwrap();
        let wav = Wav::open("a.wav", Cursor::new(&bytes)).unwrap();
        assert_eq!((wav.sample_rate_hz, wav.encoding, wav.frames), (51_200, Encoding::Float32, 3));
        assert_eq!(u32_at(&bytes, 4) as usize, bytes.len() - 8);
        assert_eq!(read(&bytes).unwrap(), (vec![vec![0.5, -3.0, 1e-7]], 0));
    }

    #[test]
    fn damaged_files_are_refused_with_position_and_expectation() {
        let data = (b"data", 4, vec![0; 4]);
        assert_eq!(
            error(b"RIFF"),
            "a.wav, byte 0: 4 bytes up to the end of the file, expected the header of a WAV file: RIFF, a size and WAVE"
        );
        assert!(error(b"ID3\x04 something else").contains("byte 0: \"ID3\\x04 somethi\", expected a WAV file"));
        assert_eq!(
            error(&riff(b"RIFF", &[format(1, 1, 16)])),
            "a.wav, byte 36: 0 bytes up to the end of the file, expected a chunk `data` with the samples"
        );
        assert!(
            error(&riff(b"RIFF", std::slice::from_ref(&data)))
                .contains("byte 12: a chunk `data`, expected a chunk `fmt ` before")
        );
        let refused = |code, channels, bits| error(&riff(b"RIFF", &[format(code, channels, bits), data.clone()]));
        assert!(refused(1, 1, 8).contains("byte 20: format 1 with 8 bits, expected integers (1) of 16, 24 or 32 bits"));
        assert!(refused(85, 2, 16).contains("format 85"), "MP3 in a WAV file");
        assert!(refused(1, 0, 16).contains("byte 22: 0 channels, expected 1 to 64"));
        assert!(refused(1, 65, 16).contains("65 channels, expected 1 to 64"));
        let mut block = riff(b"RIFF", &[format(1, 2, 16), data.clone()]);
        block[32] = 5;
        assert!(error(&block).contains("byte 32: a block of 5 bytes, expected 4 bytes"));
        let short = (b"fmt ", 14, vec![0; 14]);
        assert!(error(&riff(b"RIFF", &[short, data.clone()])).contains("byte 16: a size of 14, expected at least 16"));
        let endless = (b"junk", 4_000_000_000, vec![0; 10]);
        assert!(
            error(&riff(b"RIFF", &[endless])).contains("byte 20: a chunk of 4000000000 bytes, 10 of which are there")
        );
        let many = vec![(b"junk", 0, vec![]); 1001];
        assert!(error(&riff(b"RIFF", &many)).contains("1000 other chunks, expected a chunk `data`"));
    }
}
