//! Sound with squeals whose onset, frequency, level and growth are known: unstable modes that grow at given rates from
//! a small amplitude up to a limit cycle and decay afterwards, over noise.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use serde::Serialize;

use super::Quantity;
use super::weighting::power_weight;
use crate::random::Random;

/// Steps of the integral of the frequency weighting over the band.
const INTEGRAL_STEPS: u32 = 2000;

/// Levels are A-weighted, dB(A) re 20 µPa.
#[derive(Clone, Debug, PartialEq)]
pub struct SoundSettings {
    pub sample_rate_hz: f64,
    pub seed: u64,
    /// Level of a mode in its limit cycle.
    pub saturated_db: f64,
    /// Level from which modes grow and to which they decay; nothing sounds there.
    pub initial_db: f64,
    /// Level of the background noise, white, in the band.
    pub noise_db: f64,
    pub band_hz: [f64; 2],
    /// The onset of a squeal is where its level passes this one.
    pub threshold_db: f64,
    /// Level of the second, third, … harmonic relative to the fundamental, dB.
    pub harmonics_db: Vec<f64>,
}

impl Default for SoundSettings {
    fn default() -> Self {
        Self {
            sample_rate_hz: 51_200.0,
            seed: 1,
            saturated_db: 95.0,
            initial_db: 30.0,
            noise_db: 65.0,
            band_hz: [1250.0, 16_000.0],
            threshold_db: 70.0,
            harmonics_db: vec![],
        }
    }
}

/// A mode for some time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drive {
    pub mode_id: u32,
    pub frequency_hz: f64,
    /// Positive: it grows and saturates. Negative: it decays.
    pub growth_rate_per_s: f64,
}

/// A squeal in simulated sound: a stretch in which a mode is above the threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Planted {
    pub mode_id: u32,
    /// Time since the first sample.
    pub onset_s: f64,
    /// `None` if it lasts to the end of the sound.
    pub end_s: Option<f64>,
    /// Mean, weighted with the power.
    pub frequency_hz: f64,
    /// Highest level.
    pub level_db: f64,
    /// Growth rate of the mode at the onset; less than 0 if it was above the threshold before.
    pub growth_rate_per_s: f64,
}

/// A generator of sound. Equal settings and drives give equal samples.
#[derive(Clone, Debug)]
pub struct SimulatedSound {
    settings: SoundSettings,
    random: Random,
    noise_deviation: f64,
    voices: BTreeMap<u32, Voice>,
    /// Index of the next sample.
    index: u64,
    planted: Vec<Planted>,
}

#[derive(Clone, Copy, Debug)]
struct Voice {
    amplitude: f64,
    /// In turns.
    phase: f64,
    sounding: Option<Sounding>,
}

/// A squeal that lasts.
#[derive(Clone, Copy, Debug)]
struct Sounding {
    onset_s: f64,
    growth_rate_per_s: f64,
    power: f64,
    power_times_hz: f64,
    highest_db: f64,
}

impl SimulatedSound {
    /// Sound that begins with silence and noise.
    pub fn new(settings: SoundSettings) -> Self {
        // White noise of variance s² has the density 2 s² / f_s; its weighted mean square in the band is that times the
        // integral of the weighting.
        let [low, high] = settings.band_hz;
        let high = high.min(0.5 * settings.sample_rate_hz);
        let step = (high - low) / f64::from(INTEGRAL_STEPS);
        let weights = (0..INTEGRAL_STEPS).map(|k| weight(low + (f64::from(k) + 0.5) * step));
        let integral: f64 = step * weights.sum::<f64>();
        let variance = mean_square(settings.noise_db) * settings.sample_rate_hz / (2.0 * integral);
        let random = Random::new(settings.seed);
        let noise_deviation = variance.sqrt();
        Self { settings, random, noise_deviation, voices: BTreeMap::new(), index: 0, planted: vec![] }
    }

    /// Appends `count` samples in Pa, during which the modes `drives` grow or decay; modes that are not among them decay
    /// by `decay_per_s`.
    ///
    /// The amplitude of a growing mode follows `da/dt = σ a (1 - a²/A²)`, the normal form of a Hopf bifurcation, whose
    /// solution is `a = A / √(1 + (A²/a0² - 1) e^(-2σt))`.
    pub fn advance(&mut self, drives: &[Drive], decay_per_s: f64, count: usize, samples: &mut Vec<f32>) {
        for drive in drives {
            let initial = amplitude(self.settings.initial_db, drive.frequency_hz);
            let new = Voice { amplitude: initial, phase: 0.0, sounding: None };
            self.voices.entry(drive.mode_id).or_insert(new);
        }
        let mut sum: Vec<f64> = (0..count).map(|_| self.noise_deviation * self.random.normal()).collect();
        let from_s = self.index as f64 / self.settings.sample_rate_hz;
        for (&mode_id, voice) in &mut self.voices {
            let driven = drives.iter().find(|drive| drive.mode_id == mode_id);
            let Some(drive) = driven.copied().or_else(|| voice.fading(mode_id, decay_per_s)) else { continue };
            voice.sound(&self.settings, &drive, from_s, &mut sum, &mut self.planted);
        }
        samples.extend(sum.iter().map(|&sample| sample as f32));
        self.index += count as u64;
    }

    /// The squeals so far in the order of their onsets.
    pub fn planted(&self) -> Vec<Planted> {
        let lasting = self.voices.iter().filter_map(|(&id, voice)| Some(voice.sounding?.planted(id, None)));
        let mut all: Vec<Planted> = self.planted.iter().copied().chain(lasting).collect();
        all.sort_by(|a, b| a.onset_s.total_cmp(&b.onset_s));
        all
    }
}

impl Voice {
    /// A mode that is no longer driven decays at its last frequency; `None` if it has never sounded.
    fn fading(&self, mode_id: u32, decay_per_s: f64) -> Option<Drive> {
        let Sounding { power, power_times_hz, .. } = self.sounding?;
        Some(Drive { mode_id, frequency_hz: power_times_hz / power, growth_rate_per_s: -decay_per_s.abs() })
    }

    fn sound(
        &mut self,
        settings: &SoundSettings,
        drive: &Drive,
        from_s: f64,
        sum: &mut [f64],
        planted: &mut Vec<Planted>,
    ) {
        let Drive { mode_id, frequency_hz, growth_rate_per_s: sigma } = *drive;
        let [saturated, initial, threshold] = [settings.saturated_db, settings.initial_db, settings.threshold_db]
            .map(|level_db| amplitude(level_db, frequency_hz));
        let harmonics: Vec<f64> = settings.harmonics_db.iter().map(|db| 10.0_f64.powf(0.05 * db)).collect();
        let (dt, turns) = (1.0 / settings.sample_rate_hz, frequency_hz / settings.sample_rate_hz);
        let factor = (if sigma > 0.0 { -2.0 * sigma } else { sigma } * dt).exp();
        for (k, out) in sum.iter_mut().enumerate() {
            if sigma > 0.0 {
                let ratio = saturated / self.amplitude;
                self.amplitude = saturated / (1.0 + (ratio * ratio - 1.0) * factor).sqrt();
            } else {
                self.amplitude = (self.amplitude * factor).max(initial);
            }
            self.phase = (self.phase + turns).fract();
            if self.amplitude > initial {
                *out += self.amplitude * (TAU * self.phase).sin();
                for (order, relative) in (2_u32..).zip(&harmonics) {
                    *out += self.amplitude * relative * (TAU * self.phase * f64::from(order)).sin();
                }
            }
            let power = self.amplitude * self.amplitude;
            if self.amplitude >= threshold {
                let onset_s = from_s + k as f64 * dt;
                let new = Sounding {
                    onset_s,
                    growth_rate_per_s: sigma,
                    power: 0.0,
                    power_times_hz: 0.0,
                    highest_db: f64::MIN,
                };
                let sounding = self.sounding.get_or_insert(new);
                sounding.power += power;
                sounding.power_times_hz += power * frequency_hz;
                sounding.highest_db = sounding.highest_db.max(level_db(self.amplitude, frequency_hz));
            } else if let Some(sounding) = self.sounding.take() {
                planted.push(sounding.planted(mode_id, Some(from_s + k as f64 * dt)));
            }
        }
    }
}

impl Sounding {
    fn planted(&self, mode_id: u32, end_s: Option<f64>) -> Planted {
        let Self { onset_s, growth_rate_per_s, power, power_times_hz, highest_db } = *self;
        let frequency_hz = power_times_hz / power;
        Planted { mode_id, onset_s, end_s, frequency_hz, level_db: highest_db, growth_rate_per_s }
    }
}

fn weight(frequency_hz: f64) -> f64 {
    power_weight(Quantity::SoundPressure, frequency_hz)
}

/// Mean square of a level, Pa².
fn mean_square(level_db: f64) -> f64 {
    Quantity::SoundPressure.reference().powi(2) * 10.0_f64.powf(0.1 * level_db)
}

/// Amplitude of a tone with an A-weighted level, Pa.
fn amplitude(level_db: f64, frequency_hz: f64) -> f64 {
    (2.0 * mean_square(level_db) / weight(frequency_hz)).sqrt()
}

fn level_db(amplitude: f64, frequency_hz: f64) -> f64 {
    Quantity::SoundPressure.level_db((0.5 * amplitude * amplitude * weight(frequency_hz)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mode that grows by 50 1/s from 30 dB towards 90 dB, for 1 s, then decays by 80 1/s.
    fn one_squeal(seed: u64) -> (Vec<f32>, Vec<Planted>) {
        let settings = SoundSettings { seed, saturated_db: 90.0, noise_db: 60.0, ..Default::default() };
        let mut sound = SimulatedSound::new(settings);
        let mut samples = vec![];
        let drive = Drive { mode_id: 3, frequency_hz: 2500.0, growth_rate_per_s: 50.0 };
        sound.advance(&[drive], 80.0, 51_200, &mut samples);
        sound.advance(&[], 80.0, 25_600, &mut samples);
        (samples, sound.planted())
    }

    /// Where `A / √(1 + (A²/a0² - 1) e^(-2σt))` passes the threshold in closed form; a sample is 20 µs.
    #[test]
    fn planted_values_are_those_of_the_closed_form() {
        let (samples, planted) = one_squeal(1);
        assert_eq!(samples.len(), 76_800);
        let [squeal] = planted[..] else { panic!("{planted:?}") };
        let ratio = |db: f64| 10.0_f64.powf(0.1 * db) - 1.0;
        let onset_s = (ratio(60.0) / ratio(20.0)).ln() / 100.0;
        assert!((squeal.onset_s - onset_s).abs() < 3e-5, "{squeal:?}, expected {onset_s}");
        let end_s = 1.0 + 20.0 / (20.0 * std::f64::consts::LOG10_E * 80.0);
        assert!((squeal.end_s.unwrap() - end_s).abs() < 3e-5, "{squeal:?}, expected {end_s}");
        assert!((squeal.level_db - 90.0).abs() < 1e-6 && (squeal.frequency_hz - 2500.0).abs() < 1e-9, "{squeal:?}");
        assert_eq!((squeal.mode_id, squeal.growth_rate_per_s), (3, 50.0));
    }

    #[test]
    fn equal_seeds_give_equal_sound() {
        assert_eq!(one_squeal(1), one_squeal(1));
        assert_ne!(one_squeal(1).0, one_squeal(2).0);
    }

    /// The level of the noise by filtering it: its spectrum times the weighting, summed over the band. A second of noise has
    /// 30 000 degrees of freedom in the band: 0.035 dB of standard deviation.
    #[test]
    fn the_noise_has_its_level_in_the_band() {
        use crate::sound::spectrum::Spectra;
        let mut sound = SimulatedSound::new(SoundSettings { noise_db: 60.0, ..Default::default() });
        let mut samples = vec![];
        sound.advance(&[], 0.0, 51_200, &mut samples);
        let mut spectra = Spectra::new(2048);
        let (frames, _) = samples.as_chunks::<2048>();
        let mut sum = 0.0;
        for frame in frames {
            let power = spectra.power(frame.iter().map(|&sample| f64::from(sample)));
            let band = (50..640).map(|k| power[k] * weight(f64::from(k as u32) * 25.0)).sum::<f64>();
            // A Hann window counts noise 1.5 times.
            sum += band / 1.5 / frames.len() as f64;
        }
        let level_db = Quantity::SoundPressure.level_db(sum.sqrt());
        assert!((level_db - 60.0).abs() < 0.2, "{level_db}");
    }
}
