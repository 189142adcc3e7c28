//! The samples of files as blocks with stamps, in the order in which they are complete.
//!
//! A block is read when it is asked for, so WAV files of any length take little memory.

use super::samples::{SampleFile, SamplesError};
use crate::msgs::{Header, Time, Waveform};
use crate::sound::Channel;
use crate::sound::search::end_ns;
use crate::sound::waveform::stamp_ns;

/// Samples of a block: 80 ms at 51.2 kHz.
const BLOCK: usize = 4096;

/// Channels of a file with one sample rate, which are read together.
struct Stream {
    file: SampleFile,
    channels: Vec<Channel>,
    /// Time of the first sample.
    start_ns: i64,
    read: u64,
    /// The latest block of each channel, the first channel last.
    blocks: Vec<Waveform>,
    buffers: Vec<Vec<f32>>,
}

/// The blocks of several files.
#[derive(Default)]
pub struct SoundBlocks {
    streams: Vec<Stream>,
    error: Option<SamplesError>,
}

/// Time at which a marker is found in a file, s after its first sample; `None` if it is not found: the first sample of the
/// channel `index` that reaches `level`, in the unit of the file, after one that does not. A negative level is reached from
/// above.
///
/// # Errors
/// The file cannot be read.
pub fn marker_s(file: &mut SampleFile, index: usize, level: f32) -> Result<Option<f64>, SamplesError> {
    let reaches = |sample: f32| if level < 0.0 { sample <= level } else { sample >= level };
    let mut samples = vec![vec![]; file.channel_count()];
    let (mut read, mut before) = (0_u64, true);
    while file.read(BLOCK, &mut samples)? > 0 {
        for &sample in &samples[index] {
            let now = reaches(sample);
            if now && !before {
                return Ok(Some(read as f64 / file.sample_rate_hz(index)));
            }
            (before, read) = (now, read + 1);
        }
        samples.iter_mut().for_each(Vec::clear);
    }
    Ok(None)
}

/// A block of samples, or something else that was measured.
pub enum Beside<T> {
    Samples(Waveform),
    Other(T),
}

/// Joins `others`, each with its time in ns, and blocks of samples in the order of time. A block comes when it is complete,
/// before others of that time.
pub fn join<T>(others: impl Iterator<Item = (i64, T)>, blocks: &mut SoundBlocks) -> impl Iterator<Item = Beside<T>> {
    let mut others = others.peekable();
    std::iter::from_fn(move || {
        let end_ns = blocks.next_end_ns();
        if end_ns.is_some_and(|end_ns| others.peek().is_none_or(|(time_ns, _)| end_ns <= *time_ns)) {
            return blocks.next().map(Beside::Samples);
        }
        others.next().map(|(_, other)| Beside::Other(other))
    })
}

impl SoundBlocks {
    /// Adds a file with its `channels`, whose first samples were taken at `start_ns`.
    pub fn add(&mut self, file: SampleFile, channels: Vec<Channel>, start_ns: i64) {
        let mut channels = channels.into_iter();
        for file in file.by_rate() {
            let channels: Vec<Channel> = channels.by_ref().take(file.channel_count()).collect();
            let buffers = vec![vec![]; channels.len()];
            self.streams.push(Stream { file, channels, start_ns, read: 0, blocks: vec![], buffers });
        }
    }

    /// Whether there is no file.
    pub fn is_empty(&self) -> bool {
        self.streams.is_empty()
    }

    /// Why the files could not be read to their ends, once.
    pub fn take_error(&mut self) -> Option<SamplesError> {
        self.error.take()
    }

    /// When the next block is complete, ns; `None` without further blocks.
    pub fn next_end_ns(&mut self) -> Option<i64> {
        self.earliest().map(|(end_ns, _)| end_ns)
    }

    /// The end of the next block and the index of its stream.
    fn earliest(&mut self) -> Option<(i64, usize)> {
        for stream in self.streams.iter_mut().filter(|stream| stream.blocks.is_empty()) {
            if let Err(error) = stream.fill() {
                self.error.get_or_insert(error);
            }
        }
        if self.error.is_some() {
            return None;
        }
        let next = self.streams.iter().enumerate();
        next.filter_map(|(index, stream)| Some((end_ns(stream.blocks.last()?), index))).min()
    }
}

impl Iterator for SoundBlocks {
    type Item = Waveform;

    fn next(&mut self) -> Option<Waveform> {
        let (_, index) = self.earliest()?;
        self.streams[index].blocks.pop()
    }
}

impl Stream {
    /// Reads the next block of every channel; none at the end of the file.
    fn fill(&mut self) -> Result<(), SamplesError> {
        self.buffers.iter_mut().for_each(Vec::clear);
        let count = self.file.read(BLOCK, &mut self.buffers)?;
        for (channel, samples) in self.channels.iter().zip(&self.buffers).filter(|(_, samples)| !samples.is_empty()) {
            let stamp = Time::from_ns(stamp_ns(self.start_ns, self.read, channel.sample_rate_hz));
            self.blocks.push(Waveform {
                header: Header { stamp, frame_id: String::new() },
                channel: channel.name.clone(),
                sample_rate_hz: channel.sample_rate_hz,
                unit: channel.unit.to_string(),
                sensitivity: channel.sensitivity.map(|sensitivity| sensitivity.to_string()).unwrap_or_default(),
                samples: samples.clone(),
            });
        }
        self.blocks.reverse();
        self.read += count as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::samples::FileChannel;
    use crate::sound::Unit;

    fn file(rates_hz: &[f64], seconds: f64) -> (SampleFile, Vec<Channel>) {
        let channel = |&sample_rate_hz: &f64| {
            let count = (seconds * sample_rate_hz) as usize;
            let samples = (0..count).map(|k| if k * 4 / count == 2 { -1.0 } else { k as f32 / count as f32 }).collect();
            FileChannel { name: String::new(), sample_rate_hz, unit: Some(Unit::Pascal), samples }
        };
        let channels = rates_hz.iter().map(channel).collect();
        let meaning = rates_hz.iter().zip('a'..).map(|(&sample_rate_hz, name)| Channel {
            name: name.to_string(),
            sample_rate_hz,
            unit: Unit::Pascal,
            sensitivity: None,
        });
        (SampleFile::Loaded { format: "test", channels, omitted: vec![], read: 0 }, meaning.collect())
    }

    #[test]
    fn blocks_of_all_rates_come_in_order_and_hold_every_sample() {
        let rates = [8_000.0, 51_200.0, 100_000.0];
        let mut blocks = SoundBlocks::default();
        let (source, channels) = file(&rates, 2.0);
        blocks.add(source, channels, 5_000_000_000);
        let (mut ends, mut samples) = (vec![], [0, 0, 0]);
        while let Some(next_ns) = blocks.next_end_ns() {
            let block = blocks.next().unwrap();
            let channel = block.channel.bytes().next().unwrap() - b'a';
            let first = samples[usize::from(channel)];
            let due_ns = 5e9 + first as f64 / rates[usize::from(channel)] * 1e9;
            assert!((block.header.stamp.as_ns() as f64 - due_ns).abs() <= 1.0);
            samples[usize::from(channel)] += block.samples.len();
            assert_eq!(end_ns(&block), next_ns);
            ends.push(next_ns);
        }
        assert!(ends.is_sorted() && blocks.next().is_none());
        assert_eq!(samples, [16_000, 102_400, 200_000]);
    }

    /// The samples rise from 0 to 1, but for the third quarter, where they are -1.
    #[test]
    fn markers_are_found_where_a_sample_first_reaches_the_level() {
        let marker = |level: f32| marker_s(&mut file(&[10_000.0], 2.0).0, 0, level).unwrap();
        assert_eq!(marker(0.25), Some(0.5));
        assert_eq!(marker(-0.5), Some(1.0));
        assert_eq!(marker(0.8), Some(1.6));
        assert_eq!(marker(1.5), None);
        assert_eq!(marker(-2.0), None);
        // At the first sample the level is already reached: the marker is where it is reached again.
        assert_eq!(marker(0.0), Some(1.5));
    }
}
