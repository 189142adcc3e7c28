//! Finds squeal in a stream of samples: tones that are loud enough, exceed the noise and last.
//!
//! Frames of about 40 ms (28 to 57 ms, the power of two nearest to 40 ms), a quarter of that apart, are searched for
//! tones. A tone that lasts `min_duration_s` is a [`Squeal`]. Its onset, end and growth are then measured in the samples
//! with windows of 2 to 32 ms ([`Envelope`](super::envelope::Envelope)).
//!
//! - Time resolution: of a stationary tone's frequency and level, a frame; of onset, end and growth, the shortest window
//!   that is free of noise. Two tones closer than 2.5 bins of a frame (62 Hz at 51.2 kHz) are one.
//! - Latency: a squeal is announced [`Detector::latency_s`] after its onset at the latest, its growth at most
//!   1.5 s later, and its end `bridge_s` and a frame after its end.
//!
//! The result depends on the samples and their stamps alone, not on the blocks in which they arrive.

mod measure;
mod results;
mod track;

use std::collections::VecDeque;

use super::spectrum::{HOPS_PER_FRAME, Spectra, Tone, frame_length, is_masked};
use super::waveform::stamp_ns;
use super::weighting::power_weight;
use super::{Calibration, Channel, ChannelError, Quantity};
pub use results::{Counts, Detection, Harmonic, Interruption, MOST_NAMED, Squeal};
use track::{Ended, Found, Track};

/// Samples that are kept to measure onsets and ends in, s.
const HISTORY_S: f64 = 2.0;
/// A tone has saturated if its level has not risen by 0.5 dB for this long, s.
const SETTLED_S: f64 = 0.1;
/// A tone that goes on rising is measured as if it had saturated after this time, s.
const SATURATES_WITHIN_S: f64 = 1.5;
/// Largest distance of a tone from where it was in the frame before, in bins.
const DRIFT_BINS: f64 = 1.5;
/// Most tones of a frame, and most tones followed at a time.
const MOST_TONES: usize = 64;
/// A tone in the band between bins is at most 1.42 dB higher than its highest bin.
const SCALLOPING: f64 = 0.72;
/// A stamp further back than this begins a new stream; s.
const LONGEST_OVERLAP_S: f64 = 1.0;
/// Part of the difference between stamp and sample count by which the time of the stream is corrected with each block.
const CLOCK_CORRECTION: f64 = 1.0 / 16.0;

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

impl Settings {
    /// The settings by name. Frequencies are in Hz, levels in dB, times in s.
    pub fn values_mut(&mut self) -> [(&'static str, &mut f64); 7] {
        let Self { threshold_db, band_hz: [low, high], prominence_db, min_duration_s, bridge_s, gap_s } = self;
        [
            ("threshold_db", threshold_db),
            ("band_low_hz", low),
            ("band_high_hz", high),
            ("prominence_db", prominence_db),
            ("min_duration_s", min_duration_s),
            ("bridge_s", bridge_s),
            ("gap_s", gap_s),
        ]
    }

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

    /// The interruptions named since the last call. A stream without end is thereby named completely.
    pub fn take_interruptions(&mut self) -> Vec<Interruption> {
        std::mem::take(&mut self.counts.named)
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
}

impl Stream {
    /// Position of a sample of the stream among those that are kept.
    fn position(&self, sample: u64) -> usize {
        let oldest = self.received - self.samples.len() as u64;
        assert!((oldest..=self.received).contains(&sample), "sample {sample} is not kept");
        (sample - oldest) as usize
    }
}

#[cfg(test)]
mod tests;
