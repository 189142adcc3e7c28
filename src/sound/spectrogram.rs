//! A spectrogram of bounded size: the highest levels of short-time spectra in columns of time and rows of frequency.
//!
//! Frames of about 40 ms, half a frame apart, are transformed; for a part shown in detail, of a length that resolves its
//! time and frequency equally well ([`Spectrogram::part`]). A cell holds the highest level of the bins and frames in it, so
//! a short or narrow tone stays visible at any scale. Next to the cells a column holds the highest weighted level in the band
//! of squeal, [`Column::level_db`].

use std::collections::VecDeque;

use super::spectrum::{Spectra, frame_length};
use super::waveform::stamp_ns;
use super::weighting::power_weight;
use super::{Channel, ChannelError, Quantity};

/// Largest number of rows.
const MOST_ROWS: usize = 520;
/// Highest frequency shown, Hz.
const TOP_HZ: f64 = 20_000.0;
/// Length of the first columns, ns.
const COLUMN_NS: i64 = 50_000_000;
/// Shortest and longest frame of a part shown in detail, s.
const PART_FRAMES_S: (f64, f64) = (0.005, 0.16);
/// The most frames of a part that overlap.
const MOST_OVERLAP: usize = 16;
/// A step of a cell, dB.
pub const STEP_DB: f64 = 0.75;
/// Samples count as continuous up to this difference of their stamps, ns.
const GAP_NS: u64 = 5_000_000;
/// Sum of the power of a sinusoid over the bins of a Hann window: its equivalent noise bandwidth in bins.
const NOISE_BANDWIDTH: f64 = 1.5;

/// Levels in an interval of time.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// The column begins `index` column lengths after the epoch.
    pub index: i64,
    /// Highest level of each row, from the lowest frequency up: `lowest_db + STEP_DB * cell`; 0 is at or below that.
    pub cells: Vec<u8>,
    /// Highest level of the band in a frame: dB(A) for sound, dB for acceleration.
    pub level_db: f32,
}

/// The spectrogram of one channel.
pub struct Spectrogram {
    channel: Channel,
    quantity: Quantity,
    factor: f64,
    spectra: Spectra,
    band_hz: [f64; 2],
    rows: Rows,
    /// Samples from the beginning of a frame to that of the next.
    hop: usize,
    /// Weight of each bin in the level of the band.
    weights: Vec<f64>,
    /// Samples of the frames to come, and the time of the first.
    pending: Vec<f32>,
    pending_ns: i64,
    column_ns: i64,
    capacity: usize,
    /// Whether columns get longer, so that all are kept.
    coarsens: bool,
    columns: VecDeque<Column>,
}

/// Rows of equally many bins.
#[derive(Clone, Copy, Debug)]
struct Rows {
    bin_hz: f64,
    first_bin: usize,
    bins_per_row: usize,
    count: usize,
}

impl Rows {
    /// As few bins in a row as possible, from one frequency to another, of spectra with `bins` bins.
    fn new(low_hz: f64, high_hz: f64, bin_hz: f64, bins: usize) -> Self {
        let first_bin = ((low_hz / bin_hz).round() as usize).min(bins - 1);
        let shown = ((high_hz / bin_hz).round() as usize).clamp(first_bin, bins - 1) - first_bin + 1;
        let bins_per_row = shown.div_ceil(MOST_ROWS);
        Self { bin_hz, first_bin, bins_per_row, count: shown.div_ceil(bins_per_row) }
    }

    /// Lower frequency of a row: half a bin below the middle of its first bin.
    fn low_hz(&self, row: usize) -> f64 {
        ((self.first_bin + row * self.bins_per_row) as f64 - 0.5) * self.bin_hz
    }
}

/// A stretch of time and frequency to be shown in detail.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    pub from_ns: i64,
    pub to_ns: i64,
    pub low_hz: f64,
    pub high_hz: f64,
}

impl Part {
    /// Samples in a frame, a power of two: near `√(T / F)` of the part's length `T` and height `F`, so that it has as many
    /// frames as rows.
    fn frame_length(&self, sample_rate_hz: f64) -> usize {
        let (shortest_s, longest_s) = PART_FRAMES_S;
        let length_s = (self.to_ns - self.from_ns) as f64 * 1e-9;
        let frame_s = (length_s / (self.high_hz - self.low_hz)).sqrt().clamp(shortest_s, longest_s);
        1 << (frame_s * sample_rate_hz).log2().round().max(4.0) as u32
    }
}

impl Spectrogram {
    /// Keeps everything in at most `capacity` columns, with those that have no samples; their length doubles when necessary. `band_hz` is that of
    /// [`Column::level_db`].
    ///
    /// # Errors
    /// [`ChannelError`]: the channel has no calibration.
    pub fn coarsening(channel: &Channel, band_hz: [f64; 2], capacity: usize) -> Result<Self, ChannelError> {
        Ok(Self { coarsens: true, ..Self::latest(channel, band_hz, COLUMN_NS, capacity)? })
    }

    /// Keeps the time of the latest `capacity` columns, of length `column_ns`.
    ///
    /// # Errors
    /// [`ChannelError`]: the channel has no calibration.
    pub fn latest(channel: &Channel, band_hz: [f64; 2], column_ns: i64, capacity: usize) -> Result<Self, ChannelError> {
        let length = frame_length(channel.sample_rate_hz);
        Self::new(channel, band_hz, (0.0, TOP_HZ), length, length / 2, column_ns, capacity)
    }

    /// Shows a part in detail, in about `columns` columns. It is to be given the samples of that time.
    ///
    /// # Errors
    /// [`ChannelError`]: the channel has no calibration.
    pub fn part(channel: &Channel, band_hz: [f64; 2], part: Part, columns: usize) -> Result<Self, ChannelError> {
        let length = part.frame_length(channel.sample_rate_hz);
        let column_ns = (part.to_ns - part.from_ns) / columns as i64;
        let column = (column_ns as f64 * 1e-9 * channel.sample_rate_hz) as usize;
        let hop = column.clamp((length / MOST_OVERLAP).max(1), length / 2);
        // A frame begins in every column.
        let column_ns = column_ns.max(stamp_ns(0, hop as u64, channel.sample_rate_hz) + 1);
        Self::new(channel, band_hz, (part.low_hz, part.high_hz), length, hop, column_ns, columns + 2)
    }

    fn new(
        channel: &Channel,
        band_hz: [f64; 2],
        shown_hz: (f64, f64),
        length: usize,
        hop: usize,
        column_ns: i64,
        capacity: usize,
    ) -> Result<Self, ChannelError> {
        let calibration = channel.calibration()?;
        let bin_hz = channel.sample_rate_hz / length as f64;
        let frequencies = (0..=length / 2).map(|bin| bin as f64 * bin_hz);
        let weight = |hz: f64| {
            let in_band = (band_hz[0]..=band_hz[1]).contains(&hz);
            if in_band { power_weight(calibration.quantity, hz) / NOISE_BANDWIDTH } else { 0.0 }
        };
        Ok(Self {
            channel: channel.clone(),
            quantity: calibration.quantity,
            factor: calibration.factor,
            spectra: Spectra::new(length),
            band_hz,
            rows: Rows::new(shown_hz.0, shown_hz.1, bin_hz, length / 2 + 1),
            hop,
            weights: frequencies.map(weight).collect(),
            pending: vec![],
            pending_ns: 0,
            column_ns,
            capacity,
            coarsens: false,
            columns: VecDeque::new(),
        })
    }

    pub fn channel(&self) -> &Channel {
        &self.channel
    }

    pub fn quantity(&self) -> Quantity {
        self.quantity
    }

    /// The band of [`Column::level_db`].
    pub fn band_hz(&self) -> [f64; 2] {
        self.band_hz
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows.count
    }

    /// Lower frequency of the first row; half a bin below 0 Hz if that is shown.
    pub fn bottom_hz(&self) -> f64 {
        self.rows.low_hz(0)
    }

    /// Upper frequency of the last row.
    pub fn top_hz(&self) -> f64 {
        self.rows.low_hz(self.rows.count)
    }

    /// Level of a cell of 0, dB, not weighted.
    pub fn lowest_db(&self) -> f64 {
        match self.quantity {
            Quantity::SoundPressure => -20.0,
            Quantity::Acceleration => 20.0,
        }
    }

    pub fn column_ns(&self) -> i64 {
        self.column_ns
    }

    /// The columns in order of time; those without samples are not there.
    pub fn columns(&self) -> &VecDeque<Column> {
        &self.columns
    }

    /// Adds samples, the first of them taken at `first_stamp_ns`. After a gap, and where time went back, frames begin
    /// anew.
    pub fn push(&mut self, first_stamp_ns: i64, samples: &[f32]) {
        let rate_hz = self.channel.sample_rate_hz;
        let due_ns = stamp_ns(self.pending_ns, self.pending.len() as u64, rate_hz);
        if self.pending.is_empty() || first_stamp_ns.abs_diff(due_ns) > GAP_NS {
            self.pending.clear();
            self.pending_ns = first_stamp_ns;
        }
        self.pending.extend(samples.iter().map(|&sample| if sample.is_finite() { sample } else { 0.0 }));
        let (length, start_ns) = (self.spectra.length(), self.pending_ns);
        let mut first = 0;
        while first + length <= self.pending.len() {
            self.frame(first, stamp_ns(start_ns, (first + length / 2) as u64, rate_hz));
            first += self.hop;
        }
        self.pending.drain(..first);
        self.pending_ns = stamp_ns(start_ns, first as u64, rate_hz);
    }

    /// Adds the frame that begins with the pending sample `first`; `middle_ns` is the time of its middle.
    fn frame(&mut self, first: usize, middle_ns: i64) {
        let (factor, lowest_db) = (self.factor, self.lowest_db());
        let samples = &self.pending[first..first + self.spectra.length()];
        let power = self.spectra.power(samples.iter().map(|&sample| factor * f64::from(sample)));
        let reference = self.quantity.reference().powi(2);
        let in_band: f64 = power.iter().zip(&self.weights).map(|(power, weight)| weight * power).sum();
        let rows = power[self.rows.first_bin..].chunks(self.rows.bins_per_row).take(self.rows.count);
        let highest = rows.map(|bins| bins.iter().copied().fold(0.0, f64::max));
        let cell = |power: f64| ((10.0 * (power / reference).log10() - lowest_db) / STEP_DB).round() as u8;
        let level_db = (10.0 * (in_band / reference).log10()) as f32;
        let cells = highest.map(cell).collect();
        self.add(middle_ns, Column { index: 0, cells, level_db });
    }

    fn add(&mut self, time_ns: i64, mut column: Column) {
        column.index = time_ns.div_euclid(self.column_ns);
        match self.columns.back_mut() {
            // A time before the latest column is put into the latest.
            Some(last) if last.index >= column.index => return last.merge(&column),
            _ => self.columns.push_back(column),
        }
        while self.span() > self.capacity as i64 {
            if self.coarsens {
                self.coarsen();
            } else {
                self.columns.pop_front();
            }
        }
    }

    /// Columns from the first to the last, with those between them that have no samples.
    pub fn span(&self) -> i64 {
        self.columns.front().zip(self.columns.back()).map_or(0, |(first, last)| last.index - first.index + 1)
    }

    /// Doubles the length of the columns.
    fn coarsen(&mut self) {
        self.column_ns *= 2;
        let mut coarse: VecDeque<Column> = VecDeque::with_capacity(self.capacity + 1);
        for mut column in self.columns.drain(..) {
            column.index = column.index.div_euclid(2);
            match coarse.back_mut().filter(|last| last.index == column.index) {
                Some(last) => last.merge(&column),
                None => coarse.push_back(column),
            }
        }
        self.columns = coarse;
    }
}

impl Column {
    fn merge(&mut self, other: &Self) {
        self.level_db = self.level_db.max(other.level_db);
        for (cell, other) in self.cells.iter_mut().zip(&other.cells) {
            *cell = (*cell).max(*other);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::sound::Unit;

    const S: i64 = 1_000_000_000;

    fn channel() -> Channel {
        Channel { name: "m".to_owned(), sample_rate_hz: 51_200.0, unit: Unit::Pascal, sensitivity: None }
    }

    /// 1 Pa of amplitude, which is 90.97 dB re 20 µPa, between two times.
    fn tone(seconds: f64, hz: f64, from_s: f64, to_s: f64) -> Vec<f32> {
        let sample = |k: u32| {
            let t = f64::from(k) / 51_200.0;
            if (from_s..to_s).contains(&t) { (TAU * hz * t).sin() as f32 } else { 0.0 }
        };
        (0..(seconds * 51_200.0) as u32).map(sample).collect()
    }

    /// A tone at the centre of a bin has its level in the cell of its time and frequency. Half-overlapping frames of 40 ms
    /// touch at most the columns beside it. The band's level has the A-weighting of 2.5 kHz, 1.3 dB after the table of IEC
    /// 61672-1, to 0.1 dB.
    #[test]
    fn a_tone_is_at_its_time_and_frequency_with_its_level() {
        let mut found = Spectrogram::coarsening(&channel(), [1250.0, 16_000.0], 1000).unwrap();
        for (k, block) in tone(10.0, 2500.0, 4.0, 6.0).chunks(777).enumerate() {
            found.push(100 * S + stamp_ns(0, 777 * k as u64, 51_200.0), block);
        }
        // Bins of 25 Hz, two in a row, up to that of 20 kHz.
        assert_eq!((found.rows(), found.column_ns()), (401, COLUMN_NS));
        assert_eq!((found.bottom_hz(), found.top_hz()), (-12.5, 20_037.5));
        let row = (2512.5 / 50.0) as usize;
        for column in found.columns() {
            let from_s = (column.index * COLUMN_NS - 100 * S) as f64 * 1e-9;
            let level_db = found.lowest_db() + STEP_DB * f64::from(column.cells[row]);
            if (4.05..5.9).contains(&from_s) {
                assert!((level_db - 90.97).abs() <= 0.5 * STEP_DB + 0.01, "{level_db} dB at {from_s} s");
                let loudest = (0..401).max_by_key(|&row| column.cells[row]).unwrap();
                assert!(loudest.abs_diff(row) <= 1, "row {loudest}");
                assert!((f64::from(column.level_db) - 90.97 - 1.3).abs() < 0.1, "{}", column.level_db);
            }
            if !(3.9..6.05).contains(&from_s) {
                assert_eq!(column.cells[row], 0, "at {from_s} s");
            }
        }
    }

    /// In detail, the onset of a tone is within a frame and a column of its time, and its frequency in its row, at the level
    /// of the whole. The frame is the power of two nearest to `√(2 s / 2 kHz)` = 32 ms: 2048 samples, bins of 25 Hz.
    #[test]
    fn a_part_has_finer_columns_and_rows() {
        let part = Part { from_ns: 3 * S, to_ns: 5 * S, low_hz: 1510.0, high_hz: 3510.0 };
        let mut found = Spectrogram::part(&channel(), [1250.0, 16_000.0], part, 200).unwrap();
        found.push(3 * S, &tone(10.0, 2500.0, 4.0, 6.0)[3 * 51_200..5 * 51_200]);
        assert_eq!((found.rows(), found.bottom_hz(), found.top_hz()), (81, 1487.5, 3512.5));
        // 2 s in 200 columns, and not shorter than the 512 samples between frames, 10 ms.
        assert_eq!(found.column_ns(), 10_000_001);
        assert_eq!(found.span(), found.columns().len() as i64, "no column is empty");
        let row = ((2500.0 - found.bottom_hz()) / 25.0) as usize;
        let level_db = |column: &Column| found.lowest_db() + STEP_DB * f64::from(column.cells[row]);
        let loud: Vec<&Column> = found.columns().iter().filter(|column| level_db(column) > 84.97).collect();
        assert!((loud[0].index - 400).abs() <= 2, "half the amplitude, 6 dB less, at the onset: {}", loud[0].index);
        let last = loud[loud.len() - 1];
        assert!((level_db(last) - 90.97).abs() <= 0.5 * STEP_DB + 0.01, "{} dB", level_db(last));
        let loudest = (0..81).max_by_key(|&row| last.cells[row]).unwrap();
        assert_eq!(loudest, row);
    }

    #[test]
    fn everything_fits_the_capacity_and_the_loudest_survives() {
        let mut found = Spectrogram::coarsening(&channel(), [1250.0, 16_000.0], 50).unwrap();
        found.push(0, &tone(30.0, 5000.0, 20.0, 20.2));
        assert!(found.columns().len() <= 50 && found.columns().len() > 25, "{}", found.columns().len());
        assert_eq!(found.column_ns(), 800_000_000);
        let loud = |column: &&Column| column.cells[100] > 130;
        let times: Vec<i64> = found.columns().iter().filter(loud).map(|column| column.index).collect();
        assert_eq!(times, [25], "20 to 20.8 s");
        let mut latest = Spectrogram::latest(&channel(), [1250.0, 16_000.0], S / 10, 50).unwrap();
        latest.push(0, &tone(30.0, 5000.0, 20.0, 20.2));
        assert_eq!((latest.columns().len(), latest.columns().back().map(|column| column.index)), (50, Some(299)));
    }

    /// No frame spans a gap: the samples before it and after it are no tone together.
    #[test]
    fn frames_begin_anew_after_a_gap() {
        let mut found = Spectrogram::coarsening(&channel(), [1250.0, 16_000.0], 1000).unwrap();
        found.push(0, &tone(0.03, 2500.0, 0.0, 1.0));
        found.push(S, &tone(0.03, 2500.0, 0.0, 1.0));
        assert!(found.columns().is_empty(), "neither part has a whole frame");
        let mut wrong = tone(0.1, 2500.0, 0.0, 1.0);
        wrong[100] = f32::NAN;
        found.push(2 * S, &wrong);
        assert!(!found.columns().is_empty());
    }
}
