//! Finds squeal in a stream of samples: tones that are loud enough, exceed the noise and last.
//!
//! Frames of about 40 ms (28 to 57 ms, the power of two nearest to 40 ms), a quarter of that apart, are searched for
//! tones. A tone that lasts `min_duration_s` is a [`Squeal`]. Its onset, end and growth are then measured in the samples
//! with windows of 2 to 32 ms ([`Envelope`]).
//!
//! - Time resolution: of a stationary tone's frequency and level, a frame; of onset, end and growth, the shortest window
//!   that is free of noise. Two tones closer than 2.5 bins of a frame (62 Hz at 51.2 kHz) are one.
//! - Latency: a squeal is announced [`Detector::latency_s`] after its onset at the latest, its growth at most
//!   1.5 s later, and its end `bridge_s` and a frame after its end.
//!
//! The result depends on the samples and their stamps alone, not on the blocks in which they arrive.

use std::collections::{BTreeMap, VecDeque};

use super::envelope::{Envelope, Growth, noise_density};
use super::spectrum::{HOPS_PER_FRAME, Spectra, Tone, frame_length, is_masked};
use super::waveform::stamp_ns;
use super::weighting::power_weight;
use super::{Calibration, Channel, ChannelError, Quantity};

/// Samples that are kept to measure onsets and ends in, s.
const HISTORY_S: f64 = 2.0;
/// Growth is looked for up to this long before a tone exceeds the threshold, s.
const BEFORE_ONSET_S: f64 = 1.0;
/// A tone has saturated if its level has not risen by [`RISE`] for this long, s.
const SETTLED_S: f64 = 0.1;
/// Factor of power (0.5 dB).
const RISE: f64 = 1.122;
/// A tone that goes on rising is measured as if it had saturated after this time, s.
const SATURATES_WITHIN_S: f64 = 1.5;
/// Largest distance of a tone from where it was in the frame before, in bins.
const DRIFT_BINS: f64 = 1.5;
/// Most tones of a frame, and most tones followed at a time.
const MOST_TONES: usize = 64;
/// A squeal is a harmonic if its frequency is this near to a multiple, relative.
const HARMONIC_TOLERANCE: f64 = 0.002;
/// Highest harmonic that is recognised.
const HIGHEST_HARMONIC: u32 = 10;
/// Frames that tell the frequency at the onset.
const EARLY_FRAMES: u64 = 8;
/// The steady part of a squeal: within 3 dB of its highest level, in steps of 0.25 dB.
const STEPS_PER_DB: f64 = 4.0;
const STEADY_STEPS: i32 = 12;
/// A tone in the band between bins is at most 1.42 dB higher than its highest bin.
const SCALLOPING: f64 = 0.72;
/// A stamp further back than this begins a new stream; s.
const LONGEST_OVERLAP_S: f64 = 1.0;
/// Part of the difference between stamp and sample count by which the time of the stream is corrected with each block.
const CLOCK_CORRECTION: f64 = 1.0 / 16.0;
/// Most interruptions that are named; later ones are counted.
pub const MOST_NAMED: usize = 100;

/// Definition of squeal. The defaults are those of SAE J2521: at least 70 dB(A) between 1.25 and 16 kHz.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Least level, dB(A) re 20 µPa or dB re 1 µm/s².
    pub threshold_db: f64,
    /// Lowest and highest frequency.
    pub band_hz: [f64; 2],
    /// A tone must exceed the noise in its bin by this much, dB.
    pub prominence_db: f64,
    /// Least duration, s.
    pub min_duration_s: f64,
    /// Longest interruption within a squeal, s.
    pub bridge_s: f64,
    /// Samples are missing if a stamp is this much later than the previous samples imply, s.
    pub gap_s: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            threshold_db: 70.0,
            band_hz: [1250.0, 16_000.0],
            prominence_db: 12.0,
            min_duration_s: 0.1,
            bridge_s: 0.1,
            gap_s: 0.005,
        }
    }
}

/// Why nothing can be detected with these settings.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DetectorError {
    #[error(transparent)]
    Channel(#[from] ChannelError),
    #[error("`{setting}` is {value}, expected a finite number of {least} to {most}")]
    Setting { setting: &'static str, value: f64, least: f64, most: f64 },
    #[error(
        "channel `{name}`: sampled at {sample_rate_hz} Hz it contains no frequency of the band {} to {} Hz",
        .band_hz[0], .band_hz[1]
    )]
    Band { name: String, sample_rate_hz: f64, band_hz: [f64; 2] },
}

/// A squeal: a tone above the threshold from `onset_ns` to `end_ns`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Squeal {
    /// Counts the squeals of a detector in the order in which they are announced.
    pub number: u64,
    /// When the level of the tone passes the threshold.
    pub onset_ns: i64,
    /// When it falls below; the latest frame, while it lasts.
    pub end_ns: i64,
    /// Whether samples are missing at the onset or the end: at the ends of the stream and at gaps.
    pub cut: [bool; 2],
    /// Mean over the steady part: the frames within 3 dB of the highest level.
    pub frequency_hz: f64,
    /// Level of the mean square of the steady part, dB(A) re 20 µPa or dB re 1 µm/s².
    pub level_db: f64,
    /// Highest level of a frame.
    pub peak_level_db: f64,
    /// Ratio of the tone to the noise in its bin at the onset, dB.
    pub prominence_db: f64,
    /// Growth at the onset; `None` if it cannot be measured.
    pub growth: Option<Growth>,
    /// The squeal of which it is a harmonic.
    pub harmonic: Option<Harmonic>,
}

/// A squeal at a multiple of the frequency of another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Harmonic {
    /// At least 2.
    pub order: u32,
    /// Number of the squeal that is the fundamental.
    pub of: u64,
}

/// A finding of a detector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Detection {
    /// A tone has lasted long enough. Its values are those so far.
    Began(Squeal),
    /// A squeal is over.
    Ended(Squeal),
}

impl Detection {
    /// The squeal, if it is over.
    pub fn ended(self) -> Option<Squeal> {
        match self {
            Self::Ended(squeal) => Some(squeal),
            Self::Began(_) => None,
        }
    }
}

/// An interruption of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interruption {
    /// Samples are missing; squeals end there.
    Gap { after_ns: i64, samples: u64 },
    /// Samples came twice; the later ones are ignored.
    Overlap { at_ns: i64, samples: u64 },
    /// The stamps went back by more than a second; squeals end there.
    Restart { after_ns: i64, at_ns: i64 },
}

/// Counts of what a detector received.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples searched for squeal.
    pub samples: u64,
    /// Missing samples, at gaps.
    pub missing: u64,
    /// Ignored samples, at overlaps.
    pub repeated: u64,
    /// Samples that are not finite; replaced by 0.
    pub not_finite: u64,
    pub interruptions: u64,
    /// The first [`MOST_NAMED`] interruptions.
    pub named: Vec<Interruption>,
    /// Tones that were not followed because there were more than 64 at a time.
    pub tones_not_followed: u64,
}

/// Finds squeal in the samples of one channel.
pub struct Detector {
    settings: Settings,
    sample_rate_hz: f64,
    calibration: Calibration,
    spectra: Spectra,
    /// First and last bin searched.
    bins: [usize; 2],
    /// Least power of a peak, by bin, from the first one searched.
    least_power: Vec<f64>,
    stream: Option<Stream>,
    tones: Vec<Found>,
    tracks: Vec<Track>,
    /// Squeals that ended lately, as fundamentals of harmonics that last longer.
    ended: VecDeque<Ended>,
    announced: u64,
    counts: Counts,
}

/// Samples without an interruption.
struct Stream {
    /// Time of the first sample.
    start_ns: i64,
    /// Samples received.
    received: u64,
    /// The latest samples, up to twice the length of the history.
    samples: Vec<f32>,
    /// Index of the next frame.
    frame: u64,
}

/// A tone of a frame that is above the threshold.
#[derive(Clone, Copy)]
struct Found {
    tone: Tone,
    frequency_hz: f64,
    /// Mean square with the frequency weighting.
    weighted: f64,
    /// Noise in its bin.
    noise: f64,
}

/// A tone followed from frame to frame.
struct Track {
    first_frame: u64,
    last_frame: u64,
    /// Frames in which it was found.
    hits: u64,
    frequency_hz: f64,
    /// Weighted and plain mean square of the loudest frame.
    highest: f64,
    highest_plain: f64,
    /// Latest frame in which the level rose, and its mean square.
    rose_frame: u64,
    rose_to: f64,
    /// Tone and noise when first found.
    first: Found,
    /// The first frames: the frequency may drift later.
    early: Level,
    /// Frames by level, in steps of 0.25 dB.
    levels: BTreeMap<i32, Level>,
    /// Set when it is announced.
    number: Option<u64>,
    /// Set when it has saturated.
    onset: Option<Onset>,
}

#[derive(Clone, Copy, Default)]
struct Level {
    frames: u64,
    power: f64,
    power_times_hz: f64,
}

#[derive(Clone, Copy)]
struct Onset {
    stamp_ns: i64,
    cut: bool,
    growth: Option<Growth>,
}

struct Ended {
    number: u64,
    frames: [u64; 2],
    frequency_hz: f64,
}

impl Settings {
    /// # Errors
    /// [`DetectorError::Setting`], naming setting, value and limits.
    fn check(&self) -> Result<(), DetectorError> {
        let Self { threshold_db, band_hz: [low, high], prominence_db, min_duration_s, bridge_s, gap_s } = *self;
        let limits = [
            ("threshold_db", threshold_db, -100.0, 300.0),
            ("band_hz", low, 0.0, 1e6),
            ("band_hz", high, low, 1e6),
            ("prominence_db", prominence_db, 3.0, 100.0),
            ("min_duration_s", min_duration_s, 0.0, 10.0),
            ("bridge_s", bridge_s, 0.0, 0.5),
            ("gap_s", gap_s, 0.0, 10.0),
        ];
        match limits.into_iter().find(|&(_, value, least, most)| !(least..=most).contains(&value)) {
            Some((setting, value, least, most)) => Err(DetectorError::Setting { setting, value, least, most }),
            None => Ok(()),
        }
    }
}

impl Detector {
    /// A detector for a channel.
    ///
    /// # Errors
    /// [`DetectorError`]: a channel without calibration, settings outside their limits, a band above half the sample
    /// rate.
    pub fn new(channel: &Channel, settings: Settings) -> Result<Self, DetectorError> {
        let calibration = channel.calibration()?;
        settings.check()?;
        let sample_rate_hz = channel.sample_rate_hz;
        let length = frame_length(sample_rate_hz);
        let bin_hz = sample_rate_hz / length as f64;
        let [low, high] = settings.band_hz;
        // The three bins of a tone are between the first and the last of the spectrum.
        let bins = [(low / bin_hz).floor().max(2.0) as usize, ((high / bin_hz).ceil() as usize).min(length / 2 - 2)];
        if bins[0] > bins[1] {
            let name = channel.name.clone();
            return Err(DetectorError::Band { name, sample_rate_hz, band_hz: settings.band_hz });
        }
        let mut detector = Self {
            settings,
            sample_rate_hz,
            calibration,
            spectra: Spectra::new(length),
            bins,
            least_power: vec![],
            stream: None,
            tones: vec![],
            tracks: vec![],
            ended: VecDeque::new(),
            announced: 0,
            counts: Counts::default(),
        };
        let least = SCALLOPING * detector.threshold();
        let weight = |bin: usize| power_weight(calibration.quantity, bin as f64 * bin_hz);
        // The weight varies by less than 0.1 dB between a peak and the nearest bin; the exact limit is applied later.
        detector.least_power = (bins[0]..=bins[1]).map(|bin| 0.95 * least / weight(bin)).collect();
        Ok(detector)
    }

    /// The measured quantity.
    pub fn quantity(&self) -> Quantity {
        self.calibration.quantity
    }

    /// The band that is searched: that of the settings, up to half the sample rate.
    pub fn band_hz(&self) -> [f64; 2] {
        let [low, high] = self.settings.band_hz;
        [low, high.min(self.bins[1] as f64 * self.bin_hz())]
    }

    /// Length of a frame, s.
    pub fn frame_s(&self) -> f64 {
        self.spectra.length() as f64 / self.sample_rate_hz
    }

    /// Longest time from the onset of a squeal to its announcement, s: its least duration, a frame, and the distance of
    /// two frames.
    pub fn latency_s(&self) -> f64 {
        self.settings.min_duration_s + self.frame_s() + 2.0 * self.hop_s()
    }

    /// Counts of received samples.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    fn bin_hz(&self) -> f64 {
        1.0 / self.frame_s()
    }

    fn hop(&self) -> usize {
        self.spectra.length() / HOPS_PER_FRAME
    }

    fn hop_s(&self) -> f64 {
        self.frame_s() / HOPS_PER_FRAME as f64
    }

    /// Mean square at the threshold, with the frequency weighting.
    fn threshold(&self) -> f64 {
        self.calibration.quantity.reference().powi(2) * 10.0_f64.powf(0.1 * self.settings.threshold_db)
    }

    fn level_db(&self, mean_square: f64) -> f64 {
        self.calibration.quantity.level_db(mean_square.sqrt())
    }

    /// Takes the next block of samples, the first of them taken at `first_stamp_ns`. Findings are appended to
    /// `found`.
    pub fn push(&mut self, first_stamp_ns: i64, samples: &[f32], found: &mut Vec<Detection>) {
        let skipped = self.place(first_stamp_ns, samples.len(), found);
        for chunk in samples[skipped..].chunks(self.hop()) {
            self.receive(chunk, found);
        }
    }

    /// Ends the stream; squeals that last end with it.
    pub fn finish(&mut self, found: &mut Vec<Detection>) {
        for index in 0..self.tracks.len() {
            self.close(index, found);
        }
        self.tracks.clear();
        self.ended.clear();
        self.stream = None;
    }

    /// Compares the stamp of a block of `length` samples with the samples before it; returns how many of its samples
    /// were received before.
    fn place(&mut self, first_stamp_ns: i64, length: usize, found: &mut Vec<Detection>) -> usize {
        let new = Stream { start_ns: first_stamp_ns, received: 0, samples: vec![], frame: 0 };
        let Some(stream) = &mut self.stream else {
            self.stream = Some(new);
            return 0;
        };
        let expected_ns = stamp_ns(stream.start_ns, stream.received, self.sample_rate_hz);
        let late_s = first_stamp_ns.saturating_sub(expected_ns) as f64 * 1e-9;
        let samples = (late_s.abs() * self.sample_rate_hz).round() as u64;
        let (skipped, interruption) = if late_s > self.settings.gap_s {
            self.counts.missing = self.counts.missing.saturating_add(samples);
            (0, Interruption::Gap { after_ns: expected_ns, samples })
        } else if late_s < -LONGEST_OVERLAP_S {
            (0, Interruption::Restart { after_ns: expected_ns, at_ns: first_stamp_ns })
        } else if late_s < -self.settings.gap_s {
            let samples = samples.min(length as u64);
            self.counts.repeated += samples;
            (samples as usize, Interruption::Overlap { at_ns: first_stamp_ns, samples })
        } else {
            // The clocks of converter and stamps differ a little; a difference below half a sample is rounding.
            if late_s.abs() > 0.5 / self.sample_rate_hz {
                stream.start_ns += (CLOCK_CORRECTION * late_s * 1e9) as i64;
            }
            return 0;
        };
        self.counts.interruptions += 1;
        if self.counts.named.len() < MOST_NAMED {
            self.counts.named.push(interruption);
        }
        if !matches!(interruption, Interruption::Overlap { .. }) {
            self.finish(found);
            self.stream = Some(new);
        }
        skipped
    }

    /// At most the samples of one hop.
    fn receive(&mut self, chunk: &[f32], found: &mut Vec<Detection>) {
        let (length, hop) = (self.spectra.length(), self.hop() as u64);
        let kept = self.history_length();
        let Some(stream) = &mut self.stream else { return };
        let not_finite = chunk.iter().filter(|sample| !sample.is_finite()).count();
        self.counts.samples += chunk.len() as u64;
        self.counts.not_finite += not_finite as u64;
        stream.samples.extend(chunk.iter().map(|&sample| if sample.is_finite() { sample } else { 0.0 }));
        stream.received += chunk.len() as u64;
        if stream.samples.len() >= 2 * kept {
            stream.samples.drain(..stream.samples.len() - kept);
        }
        while let Some(stream) = &mut self.stream
            && stream.received >= stream.frame * hop + length as u64
        {
            let frame = stream.frame;
            stream.frame += 1;
            self.search(frame);
            self.follow(frame, found);
        }
    }

    fn history_length(&self) -> usize {
        (HISTORY_S * self.sample_rate_hz) as usize + 2 * self.spectra.length()
    }

    /// Index of the first sample of a frame.
    fn first_sample(&self, frame: u64) -> u64 {
        frame * self.hop() as u64
    }

    /// Finds the tones of a frame, the loudest first.
    fn search(&mut self, frame: u64) {
        let first = self.first_sample(frame);
        let threshold = self.threshold();
        let prominence = 10.0_f64.powf(0.1 * self.settings.prominence_db);
        let Some(stream) = &self.stream else { return };
        let at = stream.position(first);
        let factor = self.calibration.factor;
        let samples = &stream.samples[at..at + self.spectra.length()];
        let power = self.spectra.power(samples.iter().map(|&sample| factor * f64::from(sample)));
        let [low, high] = self.bins;
        let peaks: Vec<usize> = (low..=high)
            .zip(&self.least_power)
            .filter(|&(k, &least)| power[k] >= least && power[k] > power[k - 1] && power[k] >= power[k + 1])
            .map(|(k, _)| k)
            .collect();
        let bin_hz = self.sample_rate_hz / self.spectra.length() as f64;
        self.tones.clear();
        for k in peaks {
            let tone = self.spectra.tone(k);
            let frequency_hz = tone.bin * bin_hz;
            let weighted = tone.power * power_weight(self.calibration.quantity, frequency_hz);
            let [lowest_hz, highest_hz] = self.settings.band_hz;
            if weighted >= threshold && (lowest_hz..=highest_hz).contains(&frequency_hz) {
                self.tones.push(Found { tone, frequency_hz, weighted, noise: 0.0 });
            }
        }
        self.tones.sort_by(|a, b| b.tone.power.total_cmp(&a.tone.power));
        if self.tones.len() > MOST_TONES {
            self.counts.tones_not_followed += (self.tones.len() - MOST_TONES) as u64;
            self.tones.truncate(MOST_TONES);
        }
        let mut kept: Vec<Found> = Vec::with_capacity(self.tones.len());
        for mut found in self.tones.drain(..) {
            let Tone { bin, power } = found.tone;
            if kept.iter().any(|strong| is_masked(bin, power, &strong.tone)) {
                continue;
            }
            found.noise = self.spectra.noise_floor(bin.round() as usize);
            if power >= prominence * found.noise {
                kept.push(found);
            }
        }
        self.tones = kept;
    }

    /// Continues tracks with the tones of a frame, begins new ones, announces squeals and closes what has ended.
    fn follow(&mut self, frame: u64, found: &mut Vec<Detection>) {
        let farthest_hz = DRIFT_BINS * self.bin_hz();
        let mut not_followed = 0;
        for tone in std::mem::take(&mut self.tones) {
            let distance = |track: &Track| (track.frequency_hz - tone.frequency_hz).abs();
            let near = (0..self.tracks.len()).filter(|&index| distance(&self.tracks[index]) <= farthest_hz);
            match near.min_by(|&a, &b| distance(&self.tracks[a]).total_cmp(&distance(&self.tracks[b]))) {
                // Two tones of one frame that are that near are one.
                Some(index) if self.tracks[index].last_frame == frame => {}
                Some(index) => self.tracks[index].continue_with(frame, &tone),
                None if self.tracks.len() < MOST_TONES => self.tracks.push(Track::new(frame, tone)),
                None => not_followed += 1,
            }
        }
        self.counts.tones_not_followed += not_followed;
        for index in 0..self.tracks.len() {
            self.advance(index, frame, found);
        }
        let bridge = (self.settings.bridge_s / self.hop_s()).round() as u64;
        let over = |track: &Track| frame - track.last_frame > bridge;
        for index in 0..self.tracks.len() {
            if over(&self.tracks[index]) {
                self.close(index, found);
            }
        }
        self.tracks.retain(|track| !over(track));
        let oldest = frame.saturating_sub((HISTORY_S / self.hop_s()) as u64);
        self.ended.retain(|ended| ended.frames[1] >= oldest);
    }

    /// Announces a track that has lasted long enough and measures the onset of one that has saturated.
    fn advance(&mut self, index: usize, frame: u64, found: &mut Vec<Detection>) {
        let hop_s = self.hop_s();
        let track = &mut self.tracks[index];
        let lasted = (track.last_frame - track.first_frame) as f64 * hop_s;
        let mostly_there = 2 * track.hits > track.last_frame - track.first_frame;
        let begins = track.number.is_none() && lasted >= self.settings.min_duration_s && mostly_there;
        if begins {
            self.announced += 1;
            track.number = Some(self.announced);
        }
        let settled = (frame - track.rose_frame) as f64 * hop_s >= SETTLED_S
            || (frame - track.first_frame) as f64 * hop_s >= SATURATES_WITHIN_S;
        if track.number.is_some() && track.onset.is_none() && settled {
            self.tracks[index].onset = Some(self.measure_onset(index));
        }
        if begins && let Some(squeal) = self.squeal(index, None) {
            found.push(Detection::Began(squeal));
        }
    }

    /// Ends a track.
    fn close(&mut self, index: usize, found: &mut Vec<Detection>) {
        let Some(number) = self.tracks[index].number else { return };
        if self.tracks[index].onset.is_none() {
            self.tracks[index].onset = Some(self.measure_onset(index));
        }
        let Some(mut squeal) = self.squeal(index, Some(self.measure_end(index))) else { return };
        squeal.harmonic = self.harmonic(index, squeal.frequency_hz);
        let track = &self.tracks[index];
        let frames = [track.first_frame, track.last_frame];
        self.ended.push_back(Ended { number, frames, frequency_hz: squeal.frequency_hz });
        found.push(Detection::Ended(squeal));
    }

    /// The squeal of a track that is announced, up to now or to its end.
    fn squeal(&self, index: usize, end: Option<(i64, bool)>) -> Option<Squeal> {
        let track = &self.tracks[index];
        let number = track.number?;
        let middle_ns = |frame: u64| self.stamp_ns(self.first_sample(frame) + self.spectra.length() as u64 / 2);
        let onset = track.onset.unwrap_or(Onset { stamp_ns: middle_ns(track.first_frame), cut: false, growth: None });
        let (end_ns, end_cut) = end.unwrap_or((middle_ns(track.last_frame), false));
        let (frequency_hz, power) = track.steady();
        Some(Squeal {
            number,
            onset_ns: onset.stamp_ns,
            end_ns: end_ns.max(onset.stamp_ns),
            cut: [onset.cut, end_cut],
            frequency_hz,
            level_db: self.level_db(power),
            peak_level_db: self.level_db(track.highest),
            prominence_db: 10.0 * (track.first.tone.power / track.first.noise.max(f64::MIN_POSITIVE)).log10(),
            growth: onset.growth,
            harmonic: None,
        })
    }

    fn stamp_ns(&self, sample: u64) -> i64 {
        let start_ns = self.stream.as_ref().map_or(0, |stream| stream.start_ns);
        stamp_ns(start_ns, sample, self.sample_rate_hz)
    }

    /// Time of the middle of a frame after sample `first`, s.
    fn middle_s(&self, frame: u64, first: u64) -> f64 {
        let middle = self.first_sample(frame) as f64 + 0.5 * self.spectra.length() as f64;
        (middle - first as f64) / self.sample_rate_hz
    }

    /// The samples from `seconds` before frame `from` up to the end of the latest frame, demodulated at `frequency_hz`,
    /// with the index of the first.
    fn envelope(&self, track: &Track, frequency_hz: f64, from: u64, seconds: f64) -> Option<(Envelope, u64)> {
        let stream = self.stream.as_ref()?;
        let end = self.first_sample(stream.frame.checked_sub(1)?) + self.spectra.length() as u64;
        let oldest = end.saturating_sub((HISTORY_S * self.sample_rate_hz) as u64);
        let first = self.first_sample(from).saturating_sub((seconds * self.sample_rate_hz) as u64).max(oldest);
        let samples = &stream.samples[stream.position(first)..stream.position(end)];
        let factor = self.calibration.factor;
        let samples = samples.iter().map(|&sample| factor * f64::from(sample));
        let noise = noise_density(track.first.noise, self.frame_s());
        Some((Envelope::new(samples, self.sample_rate_hz, frequency_hz, noise), first))
    }

    fn measure_onset(&self, index: usize) -> Onset {
        let track = &self.tracks[index];
        let first_frame_ns = self.stamp_ns(self.first_sample(track.first_frame) + self.spectra.length() as u64 / 2);
        let none = Onset { stamp_ns: first_frame_ns, cut: true, growth: None };
        let frequency_hz = track.early.power_times_hz / track.early.power;
        let Some((envelope, first)) = self.envelope(track, frequency_hz, track.first_frame, BEFORE_ONSET_S) else {
            return none;
        };
        let threshold = self.plain_threshold(frequency_hz);
        let near_s = self.middle_s(track.first_frame, first);
        let fitted = envelope.growth(track.highest_plain, near_s, threshold);
        let in_the_fit = |&(growth, at_s): &(Growth, f64)| {
            // The line holds up to 10 dB below saturation, and is trusted as far below its range as that is wide.
            let range_s = growth.span_db / (20.0 * std::f64::consts::LOG10_E * growth.rate_per_s);
            threshold <= 0.1 * track.highest_plain && (at_s - near_s).abs() <= self.frame_s() + range_s
        };
        let rises = || envelope.rises_above(threshold, near_s).map(|at_s| (at_s, false));
        let passes = fitted.as_ref().filter(|fit| in_the_fit(fit)).map(|&(_, at_s)| (at_s, false)).or_else(rises);
        let (at_s, cut) = passes.unwrap_or((0.0, true));
        let growth = fitted.map(|(growth, _)| growth);
        if cut && first > 0 {
            return Onset { cut: false, growth, ..none };
        }
        Onset { stamp_ns: self.stamp_ns(first) + (at_s * 1e9).round() as i64, cut, growth }
    }

    fn measure_end(&self, index: usize) -> (i64, bool) {
        let track = &self.tracks[index];
        let (first_sample, length) = (self.first_sample(track.last_frame), self.spectra.length() as u64);
        let latest_frame = self.stream.as_ref().map_or(0, |stream| stream.frame.saturating_sub(1));
        let falls =
            self.envelope(track, track.frequency_hz, track.last_frame, self.frame_s()).and_then(|(envelope, first)| {
                let near_s = self.middle_s(track.last_frame, first);
                let at_s = envelope.falls_below(self.plain_threshold(track.frequency_hz), near_s)?;
                Some(self.stamp_ns(first) + (at_s * 1e9).round() as i64)
            });
        match falls {
            Some(end_ns) => (end_ns, false),
            None if latest_frame - track.last_frame <= 1 => (self.stamp_ns(first_sample + length), true),
            None => (self.stamp_ns(first_sample + length / 2), false),
        }
    }

    /// Mean square without frequency weighting of a tone at the threshold.
    fn plain_threshold(&self, frequency_hz: f64) -> f64 {
        self.threshold() / power_weight(self.calibration.quantity, frequency_hz)
    }

    /// The squeal of which the one of a track is a harmonic: that with the lowest order, whose time covers at least half
    /// of its own.
    fn harmonic(&self, index: usize, frequency_hz: f64) -> Option<Harmonic> {
        let own = &self.tracks[index];
        let followed = self
            .tracks
            .iter()
            .filter_map(|track| Some((track.number?, [track.first_frame, track.last_frame], track.steady().0)));
        let ended = self.ended.iter().map(|ended| (ended.number, ended.frames, ended.frequency_hz));
        let candidates = followed.chain(ended).filter_map(|(of, [first, last], fundamental_hz)| {
            let order = (frequency_hz / fundamental_hz).round();
            let is_multiple = (frequency_hz / fundamental_hz / order - 1.0).abs() <= HARMONIC_TOLERANCE;
            let common = (last.min(own.last_frame) + 1).saturating_sub(first.max(own.first_frame));
            let together = 2 * common >= own.last_frame - own.first_frame;
            let harmonic = Harmonic { order: order as u32, of };
            (is_multiple && together && (2..=HIGHEST_HARMONIC).contains(&harmonic.order)).then_some(harmonic)
        });
        candidates.min_by_key(|harmonic| (harmonic.order, harmonic.of))
    }
}

impl Level {
    fn add(&mut self, tone: &Found) {
        self.frames += 1;
        self.power += tone.weighted;
        self.power_times_hz += tone.weighted * tone.frequency_hz;
    }
}

impl Stream {
    /// Position of a sample of the stream among those that are kept.
    fn position(&self, sample: u64) -> usize {
        let oldest = self.received - self.samples.len() as u64;
        assert!((oldest..=self.received).contains(&sample), "sample {sample} is not kept");
        (sample - oldest) as usize
    }
}

impl Track {
    fn new(frame: u64, tone: Found) -> Self {
        let mut track = Self {
            first_frame: frame,
            last_frame: frame,
            hits: 0,
            frequency_hz: tone.frequency_hz,
            highest: 0.0,
            highest_plain: 0.0,
            rose_frame: frame,
            rose_to: 0.0,
            first: tone,
            early: Level::default(),
            levels: BTreeMap::new(),
            number: None,
            onset: None,
        };
        track.continue_with(frame, &tone);
        track
    }

    fn continue_with(&mut self, frame: u64, tone: &Found) {
        self.last_frame = frame;
        self.hits += 1;
        self.frequency_hz = tone.frequency_hz;
        if tone.weighted > self.highest {
            (self.highest, self.highest_plain) = (tone.weighted, tone.tone.power);
        }
        if tone.weighted > RISE * self.rose_to {
            (self.rose_frame, self.rose_to) = (frame, tone.weighted);
        }
        if self.hits <= EARLY_FRAMES {
            self.early.add(tone);
        }
        let step = (STEPS_PER_DB * 10.0 * tone.weighted.log10()).floor() as i32;
        self.levels.entry(step).or_default().add(tone);
    }

    /// Mean frequency, Hz, and mean weighted square of the steady part.
    fn steady(&self) -> (f64, f64) {
        let highest = self.levels.keys().next_back().copied().unwrap_or_default();
        let mut sum = Level::default();
        for level in self.levels.range(highest - STEADY_STEPS..).map(|(_, level)| level) {
            sum.frames += level.frames;
            sum.power += level.power;
            sum.power_times_hz += level.power_times_hz;
        }
        (sum.power_times_hz / sum.power, sum.power / sum.frames as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::super::simulated::{Drive, Planted, SimulatedSound, SoundSettings};
    use super::*;
    use crate::sound::Unit;

    const RATE_HZ: f64 = 51_200.0;
    const START_NS: i64 = 1_000_000_000;

    fn channel(sample_rate_hz: f64) -> Channel {
        Channel { name: "microphone".to_owned(), sample_rate_hz, unit: Unit::Pascal, sensitivity: None }
    }

    /// The squeals that ended, in the order of their onsets, from blocks of `size` samples.
    fn squeals(samples: &[f32], size: usize) -> Vec<Squeal> {
        let mut detector = Detector::new(&channel(RATE_HZ), Settings::default()).unwrap();
        let mut found = vec![];
        for (k, block) in samples.chunks(size).enumerate() {
            detector.push(stamp_ns(START_NS, (k * size) as u64, RATE_HZ), block, &mut found);
        }
        detector.finish(&mut found);
        assert_eq!(detector.counts().interruptions, 0);
        ended(&found)
    }

    fn ended(found: &[Detection]) -> Vec<Squeal> {
        let mut ended: Vec<Squeal> = found.iter().copied().filter_map(Detection::ended).collect();
        ended.sort_by_key(|squeal| squeal.onset_ns);
        ended
    }

    /// Modes that grow from 0.3 s to 1.3 s of 2 s, over noise of `noise_db`.
    fn sound(noise_db: f64, harmonics_db: &[f64], modes: &[(f64, f64)]) -> (Vec<f32>, Vec<Planted>) {
        let harmonics_db = harmonics_db.to_vec();
        let mut sound = SimulatedSound::new(SoundSettings { noise_db, harmonics_db, ..Default::default() });
        let drives: Vec<Drive> = (0..)
            .zip(modes)
            .map(|(mode_id, &(frequency_hz, growth_rate_per_s))| Drive { mode_id, frequency_hz, growth_rate_per_s })
            .collect();
        let mut samples = vec![];
        sound.advance(&[], 60.0, 15_360, &mut samples);
        sound.advance(&drives, 60.0, 51_200, &mut samples);
        sound.advance(&[], 60.0, 35_840, &mut samples);
        (samples, sound.planted())
    }

    fn check(squeal: &Squeal, planted: &Planted) {
        let after_s = |stamp_ns: i64| (stamp_ns - START_NS) as f64 * 1e-9;
        let hz = squeal.frequency_hz - planted.frequency_hz;
        assert!(hz.abs() <= f64::max(1.0, 5e-4 * planted.frequency_hz), "{squeal:?}, planted {planted:?}");
        assert!((squeal.level_db - planted.level_db).abs() <= 0.5, "{squeal:?}, planted {planted:?}");
        assert!((after_s(squeal.onset_ns) - planted.onset_s).abs() <= 0.01, "{squeal:?}, planted {planted:?}");
        assert!((after_s(squeal.end_ns) - planted.end_s.unwrap()).abs() <= 0.01, "{squeal:?}, planted {planted:?}");
        let growth = squeal.growth.unwrap_or_else(|| panic!("{squeal:?}, planted {planted:?}"));
        let rate = growth.rate_per_s / planted.growth_rate_per_s;
        assert!((rate - 1.0).abs() <= 0.1, "{squeal:?}, planted {planted:?}");
        assert_eq!(squeal.cut, [false; 2]);
    }

    /// 95 dB(A) over 65 dB(A) of noise, from slow to fast growth, at both ends of the band and between.
    #[test]
    fn planted_squeals_are_found_with_their_values() {
        for (frequency_hz, rate) in [(1300.0, 30.0), (2512.3, 80.0), (6789.0, 200.0), (15_500.0, 400.0)] {
            let (samples, planted) = sound(65.0, &[], &[(frequency_hz, rate)]);
            let found = squeals(&samples, 1024);
            let [squeal] = found[..] else { panic!("{found:?}") };
            check(&squeal, &planted[0]);
            assert_eq!(squeal.harmonic, None);
        }
    }

    #[test]
    fn simultaneous_squeals_are_distinguished() {
        let (samples, planted) = sound(60.0, &[], &[(1900.0, 60.0), (2000.0, 90.0), (5432.1, 150.0)]);
        let found = squeals(&samples, 1024);
        assert_eq!(found.len(), 3, "{found:?}");
        for planted in &planted {
            let near = |squeal: &&Squeal| (squeal.frequency_hz - planted.frequency_hz).abs() < 20.0;
            check(found.iter().find(near).unwrap_or_else(|| panic!("{planted:?} is not among {found:?}")), planted);
        }
    }

    #[test]
    fn harmonics_are_recognised_and_other_tones_are_not() {
        let (samples, _) = sound(60.0, &[-15.0, -20.0], &[(2345.6, 80.0), (6000.0, 80.0)]);
        let mut found = squeals(&samples, 1024);
        found.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
        let orders: Vec<(f64, Option<u32>)> =
            found.iter().map(|s| (s.frequency_hz.round(), s.harmonic.map(|harmonic| harmonic.order))).collect();
        let expected = [(2346.0, None), (4691.0, Some(2)), (6000.0, None), (7037.0, Some(3)), (12_000.0, Some(2))];
        assert_eq!(orders, expected);
        assert!(found[1].harmonic.unwrap().of == found[0].number && found[4].harmonic.unwrap().of == found[2].number);
    }

    #[test]
    fn results_do_not_depend_on_the_blocks() {
        let (samples, _) = sound(75.0, &[-20.0], &[(3000.0, 80.0), (4100.0, 20.0)]);
        let whole = squeals(&samples, samples.len());
        assert!(whole.len() >= 2, "{whole:?}");
        for size in [1, 17, 512, 1000, 4096] {
            assert_eq!(squeals(&samples, size), whole, "blocks of {size}");
        }
    }

    #[test]
    fn noise_alone_and_tones_below_the_threshold_are_no_squeal() {
        // In a bin of 25 Hz, 75 dB of noise in the band are 49 dB: a tone of 66 dB has a standard deviation of 1.2 dB.
        for (saturated_db, noise_db) in [(66.0, 75.0), (31.0, 90.0)] {
            let mut quiet = SimulatedSound::new(SoundSettings { saturated_db, noise_db, ..Default::default() });
            let mut samples = vec![];
            let drive = Drive { mode_id: 0, frequency_hz: 3000.0, growth_rate_per_s: 100.0 };
            quiet.advance(&[drive], 60.0, 5 * 51_200, &mut samples);
            assert_eq!(squeals(&samples, 1024), []);
        }
    }

    #[test]
    fn squeals_at_the_ends_of_a_stream_are_cut_there() {
        let samples: Vec<f32> =
            (0..51_200).map(|i| (std::f64::consts::TAU * 3000.0 * f64::from(i) / RATE_HZ).sin() as f32).collect();
        let found = squeals(&samples, 1024);
        let [squeal] = found[..] else { panic!("{found:?}") };
        assert_eq!((squeal.cut, squeal.growth, squeal.onset_ns), ([true; 2], None, START_NS));
        // Amplitude 1 Pa: 90.97 dB. IEC 61672-1 weights 2.5 kHz by 1.3 dB and 3.15 kHz by 1.2 dB, both rounded.
        assert!(
            (squeal.level_db - 90.97 - 1.22).abs() < 0.08 && (squeal.frequency_hz - 3000.0).abs() < 0.01,
            "{squeal:?}"
        );
        assert!((squeal.end_ns - START_NS - 1_000_000_000).abs() < 20_000_000, "{squeal:?}");
    }

    /// Missing, repeated and invalid samples are counted and named; a squeal ends at a gap and another begins after it.
    #[test]
    fn interruptions_are_counted_and_named() {
        let tone = |i: usize| (std::f64::consts::TAU * 3000.0 * i as f64 / RATE_HZ).sin() as f32;
        let mut detector = Detector::new(&channel(RATE_HZ), Settings::default()).unwrap();
        let mut found = vec![];
        let mut push = |detector: &mut Detector, from: usize, to: usize| {
            let block: Vec<f32> = (from..to).map(|i| if i == 100 { f32::NAN } else { tone(i) }).collect();
            detector.push(stamp_ns(START_NS, from as u64, RATE_HZ), &block, &mut found);
        };
        push(&mut detector, 0, 20_480);
        push(&mut detector, 25_600, 51_200); // 0.1 s missing
        push(&mut detector, 50_688, 61_440); // 512 samples again
        detector.finish(&mut found);
        let at = |index: u64| stamp_ns(START_NS, index, RATE_HZ);
        let counts = detector.counts();
        assert_eq!((counts.missing, counts.repeated, counts.not_finite, counts.interruptions), (5120, 512, 1, 2));
        assert_eq!(counts.samples, 20_480 + 25_600 + 10_752 - 512);
        let gap = Interruption::Gap { after_ns: at(20_480), samples: 5120 };
        assert_eq!(counts.named, [gap, Interruption::Overlap { at_ns: at(50_688), samples: 512 }]);
        let squeals = ended(&found);
        assert_eq!(squeals.len(), 2, "{squeals:?}");
        assert_eq!(squeals.iter().map(|squeal| squeal.cut).collect::<Vec<_>>(), [[true; 2]; 2]);
        assert_eq!(squeals[1].onset_ns, at(25_600));
    }

    /// An announcement comes within the stated latency of the onset.
    #[test]
    fn squeals_are_announced_within_the_latency() {
        let (samples, planted) = sound(65.0, &[], &[(2500.0, 100.0)]);
        let mut detector = Detector::new(&channel(RATE_HZ), Settings::default()).unwrap();
        let mut found = vec![];
        let pushed = samples.chunks(64).enumerate().position(|(k, block)| {
            detector.push(stamp_ns(START_NS, 64 * k as u64, RATE_HZ), block, &mut found);
            !found.is_empty()
        });
        let announced_s = 64.0 * (pushed.unwrap() + 1) as f64 / RATE_HZ;
        let latency_s = announced_s - planted[0].onset_s;
        assert!(
            latency_s > 0.1 && latency_s <= detector.latency_s(),
            "{latency_s} s, stated {} s",
            detector.latency_s()
        );
        assert!(matches!(found[0], Detection::Began(squeal) if (squeal.frequency_hz - 2500.0).abs() < 5.0));
    }

    #[test]
    fn settings_outside_their_limits_are_refused() {
        let error = |settings, rate| Detector::new(&channel(rate), settings).err().expect("refused").to_string();
        let settings = Settings { threshold_db: f64::NAN, ..Default::default() };
        assert_eq!(error(settings, RATE_HZ), "`threshold_db` is NaN, expected a finite number of -100 to 300");
        let settings = Settings { band_hz: [5000.0, 2000.0], ..Default::default() };
        assert_eq!(error(settings, RATE_HZ), "`band_hz` is 2000, expected a finite number of 5000 to 1000000");
        let settings = Settings { band_hz: [5000.0, 6000.0], ..Default::default() };
        let refused = "channel `microphone`: sampled at 8000 Hz it contains no frequency of the band 5000 to 6000 Hz";
        assert_eq!(error(settings, 8000.0), refused);
        let slow = Detector::new(&channel(8000.0), Settings::default()).unwrap();
        assert_eq!(slow.band_hz(), [1250.0, 3937.5]);
    }
}
