//! Measures a squeal in the samples: onset, growth, end, and of which other squeal it is a harmonic.

use super::results::{Harmonic, Squeal};
use super::track::{Onset, Track};
use super::{Detector, HISTORY_S};
use crate::sound::Growth;
use crate::sound::envelope::{Envelope, noise_density};
use crate::sound::waveform::stamp_ns;
use crate::sound::weighting::power_weight;

/// Growth is looked for up to this long before a tone exceeds the threshold, s.
const BEFORE_ONSET_S: f64 = 1.0;
/// A squeal is a harmonic if its frequency is this near to a multiple, relative.
const HARMONIC_TOLERANCE: f64 = 0.002;
/// Highest harmonic that is recognised.
const HIGHEST_HARMONIC: u32 = 10;

impl Detector {
    /// The squeal of a track that is announced, up to now or to its end.
    pub(super) fn squeal(&self, index: usize, end: Option<(i64, bool)>) -> Option<Squeal> {
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

    pub(super) fn measure_onset(&self, index: usize) -> Onset {
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

    pub(super) fn measure_end(&self, index: usize) -> (i64, bool) {
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
    pub(super) fn harmonic(&self, index: usize, frequency_hz: f64) -> Option<Harmonic> {
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
