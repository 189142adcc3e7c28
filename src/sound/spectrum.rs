//! Short-time power spectra: frames of samples under a Hann window, and the tones in them.

use std::f64::consts::PI;
use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{RealFftPlanner, RealToComplex};

/// Length of a frame that is aimed at, s; the length in samples is the power of two nearest to it.
const FRAME_S: f64 = 0.04;
/// Frames overlap by all but this share of their length.
pub const HOPS_PER_FRAME: usize = 4;
/// A tone within this many bins of a stronger one is not separated from it.
pub const SEPARATION_BINS: f64 = 2.5;
/// A tone must exceed the side lobes of a stronger one by this factor of power (10 dB).
const ABOVE_SIDE_LOBES: f64 = 10.0;
/// The bins around a peak from which the noise floor is taken: at least and at most this far away.
const FLOOR_BINS: (usize, usize) = (3, 32);

/// Spectra of frames of one length.
pub struct Spectra {
    plan: Arc<dyn RealToComplex<f64>>,
    /// `w_i = sin²(π i / N)`, the periodic Hann window.
    window: Vec<f64>,
    windowed: Vec<f64>,
    scratch: Vec<Complex<f64>>,
    bins: Vec<Complex<f64>>,
    power: Vec<f64>,
    sorted: Vec<f64>,
}

/// A sinusoid in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tone {
    /// Frequency in bins: a fractional index of the spectrum.
    pub bin: f64,
    /// Mean square.
    pub power: f64,
}

/// Samples in a frame at a sample rate: the power of two nearest to 40 ms, which is 28 to 57 ms.
pub fn frame_length(sample_rate_hz: f64) -> usize {
    1 << (FRAME_S * sample_rate_hz).log2().round().max(4.0) as u32
}

impl Spectra {
    /// Spectra of frames of `length` samples; even, at least 16.
    pub fn new(length: usize) -> Self {
        assert!(length.is_multiple_of(2) && length >= 16, "frames of {length} samples");
        let plan = RealFftPlanner::new().plan_fft_forward(length);
        let window = (0..length).map(|i| (PI * i as f64 / length as f64).sin().powi(2)).collect();
        let (windowed, bins, scratch) = (plan.make_input_vec(), plan.make_output_vec(), plan.make_scratch_vec());
        Self { power: vec![0.0; bins.len()], plan, window, windowed, scratch, bins, sorted: vec![] }
    }

    /// Samples in a frame.
    pub fn length(&self) -> usize {
        self.window.len()
    }

    /// The one-sided power spectrum of a frame: `P_k = 2 |Σ w_i x_i e^(-2πi ki/N)|² / (Σ w_i)²`, without the factor 2 in
    /// the first and last bin. A sinusoid at the frequency of bin `k` has its mean square there.
    pub fn power(&mut self, frame: impl ExactSizeIterator<Item = f64>) -> &[f64] {
        assert_eq!(frame.len(), self.window.len(), "samples of a frame");
        for ((out, weight), sample) in self.windowed.iter_mut().zip(&self.window).zip(frame) {
            *out = weight * sample;
        }
        self.plan
            .process_with_scratch(&mut self.windowed, &mut self.bins, &mut self.scratch)
            .expect("the buffers have the lengths of the plan");
        // Σ w_i = N/2.
        let scale = 8.0 / (self.window.len() as f64).powi(2);
        for (power, bin) in self.power.iter_mut().zip(&self.bins) {
            *power = scale * bin.norm_sqr();
        }
        let last = self.power.len() - 1;
        self.power[0] *= 0.5;
        self.power[last] *= 0.5;
        &self.power
    }

    /// The tone whose peak is at bin `k` of the latest spectrum, not the first or last bin.
    ///
    /// The three magnitudes at and next to the peak of a Hann window give the fraction `δ` of a bin exactly, if the tone
    /// is stationary and alone: `δ = 2 (A_+ - A_-) / (2 A_0 + A_+ + A_-)`. The mean square follows from the shape of
    /// the main lobe, `W(δ) = sin(πδ) / (πδ (1 - δ²))`.
    ///
    /// # Source
    /// The magnitudes are samples of `W`, so `A_± / A_0 = (1 ± δ) / (2 ∓ δ)`; both ratios together give `δ`. With one
    /// neighbour it is T. Grandke, "Interpolation algorithms for discrete Fourier transforms of weighted signals", IEEE
    /// Trans. Instrum. Meas. 32 (1983), equation 14.
    pub fn tone(&self, k: usize) -> Tone {
        let [below, at, above] = [k - 1, k, k + 1].map(|bin| self.power[bin].sqrt());
        let total = 2.0 * at + above + below;
        let delta = if total > 0.0 { (2.0 * (above - below) / total).clamp(-1.0, 1.0) } else { 0.0 };
        Tone { bin: k as f64 + delta, power: self.power[k] / main_lobe(delta).powi(2) }
    }

    /// Mean square of the noise in one bin around bin `k` of the latest spectrum: the median of 3 to 32 bins away on
    /// both sides, divided by `ln 2`. The power of Gaussian noise in a bin is exponentially distributed, with a median of
    /// `ln 2` times its mean.
    pub fn noise_floor(&mut self, k: usize) -> f64 {
        let (nearest, farthest) = FLOOR_BINS;
        let last = self.power.len() - 1;
        self.sorted.clear();
        self.sorted.extend_from_slice(&self.power[k.saturating_sub(farthest).max(1)..k.saturating_sub(nearest).max(1)]);
        self.sorted.extend_from_slice(&self.power[(k + nearest + 1).min(last)..(k + farthest + 1).min(last)]);
        let middle = self.sorted.len() / 2;
        let (_, median, _) = self.sorted.select_nth_unstable_by(middle, f64::total_cmp);
        *median / std::f64::consts::LN_2
    }
}

/// Main lobe of the Hann window `delta` bins off its centre, 1 at the centre.
fn main_lobe(delta: f64) -> f64 {
    let x = PI * delta;
    // Around 0 and ±1 numerator and denominator vanish together.
    if delta.abs() < 1e-6 {
        1.0
    } else if (delta.abs() - 1.0).abs() < 1e-6 {
        0.5
    } else {
        x.sin() / (x * (1.0 - delta * delta))
    }
}

/// Whether a peak of `power` at `bin` may be a side lobe of `strong`, or is not separated from it.
///
/// The side lobes of a Hann window are below `1 / (π d (d² - 1))` of the tone, `d` bins away.
pub fn is_masked(bin: f64, power: f64, strong: &Tone) -> bool {
    let distance = (bin - strong.bin).abs();
    if distance < SEPARATION_BINS {
        return power <= strong.power;
    }
    let side_lobe = 1.0 / (PI * distance * (distance * distance - 1.0));
    power < ABOVE_SIDE_LOBES * strong.power * side_lobe * side_lobe
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spectra_of(length: usize, sample: impl Fn(f64) -> f64) -> Spectra {
        let mut spectra = Spectra::new(length);
        spectra.power((0..length).map(|i| sample(i as f64)));
        spectra
    }

    fn highest(spectra: &Spectra) -> usize {
        let inner = 1..spectra.power.len() - 1;
        inner.max_by(|&a, &b| spectra.power[a].total_cmp(&spectra.power[b])).unwrap()
    }

    #[test]
    fn frames_are_about_40_ms_long() {
        let rates = [8_000.0, 25_600.0, 44_100.0, 48_000.0, 51_200.0, 96_000.0, 204_800.0];
        assert_eq!(rates.map(frame_length), [256, 1024, 2048, 2048, 2048, 4096, 8192]);
    }

    /// A sinusoid of amplitude `a` has the mean square `a²/2`. The interpolation is exact but for the tone's image at
    /// negative frequency, which is 2 · 100 bins away: 1 / (π 200³) = 4e-8 of its amplitude.
    #[test]
    fn tones_between_bins_have_their_frequency_and_mean_square() {
        for fraction in [-0.5, -0.3, 0.0, 1e-9, 0.2, 0.4999] {
            for phase in [0.0, 0.7, 2.0] {
                let bin = 100.0 + fraction;
                let spectra = spectra_of(2048, |i| 3.0 * (2.0 * PI * bin * i / 2048.0 + phase).cos());
                let tone = spectra.tone(highest(&spectra));
                assert!((tone.bin - bin).abs() < 1e-6, "{tone:?}, expected {bin}");
                assert!((tone.power / 4.5 - 1.0).abs() < 1e-6, "{tone:?}, expected 4.5");
            }
        }
    }

    /// The bound of the side lobes against the spectrum of a tone halfway between bins, where they are highest.
    #[test]
    fn side_lobes_are_masked_and_separate_tones_are_not() {
        let spectra = spectra_of(2048, |i| (2.0 * PI * 500.5 * i / 2048.0).cos());
        let strong = spectra.tone(highest(&spectra));
        for k in (2..1023).filter(|&k: &usize| k.abs_diff(500) > 1) {
            assert!(is_masked(k as f64, spectra.power[k], &strong), "bin {k}");
        }
        assert!(!is_masked(504.5, 1e-3 * strong.power, &strong), "30 dB weaker, 4 bins away");
        assert!(!is_masked(600.0, 1e-9 * strong.power, &strong), "90 dB weaker, 100 bins away");
        assert!(is_masked(502.0, strong.power, &strong), "1.5 bins away");
    }

    /// Gaussian noise of unit variance: `1.5 · 2 / N` in every bin on average (the Hann window has a noise bandwidth of
    /// 1.5 bins). The median of 60 bins varies by a fifth; so does its mean over 64 frames, by a fortieth.
    #[test]
    fn the_noise_floor_is_the_mean_power_of_a_bin() {
        use rand::{RngExt, SeedableRng};
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let mut spectra = Spectra::new(1024);
        let floors: Vec<f64> = (0..64)
            .map(|_| {
                let uniform = || random.random_range(-1.0..1.0);
                let noise: Vec<f64> =
                    std::iter::repeat_with(uniform).map(|x: f64| x * 3.0_f64.sqrt()).take(1024).collect();
                spectra.power(noise.into_iter());
                spectra.noise_floor(200)
            })
            .collect();
        let mean = floors.iter().sum::<f64>() / 64.0;
        assert!((mean / (3.0 / 1024.0) - 1.0).abs() < 0.1, "{mean}");
        assert!(spectra.noise_floor(1) > 0.0 && spectra.noise_floor(511) > 0.0);
    }
}
