//! Envelope of one tone: when it passes a level, and how fast it grows.
//!
//! The samples are multiplied by `e^(-2πi f t)` and averaged over short windows. That is much finer in time than a frame
//! of the spectrum, and narrow enough to be free of other tones and most of the noise.

use std::f64::consts::TAU;

/// Length of the blocks whose sums the windows are made of, s.
const BLOCK_S: f64 = 0.5e-3;
/// Lengths of the Hann windows in blocks, the longest first: 32 ms to 2 ms.
const WINDOWS: [usize; 5] = [64, 32, 16, 8, 4];
/// Windows overlap by all but this share of their length.
const STEPS_PER_WINDOW: usize = 4;
/// Noise bandwidth of a Hann window, in reciprocals of its length.
const NOISE_BANDWIDTH: f64 = 1.5;
/// The growth is fitted where the mean square exceeds that of the noise by this factor (10 dB) ...
const ABOVE_NOISE: f64 = 10.0;
/// ... up to this share of the saturated mean square (-10 dB), from where on growth is slower.
const BELOW_SATURATION: f64 = 0.1;
/// Going back in time, growth begins where the mean square is higher than later on by this factor (6 dB).
const HIGHER_BEFORE: f64 = 4.0;
/// Fewest points of a fit, half a window apart, and the least range of levels they span, dB.
const FEWEST_POINTS: usize = 5;
const LEAST_SPAN_DB: f64 = 6.0;
/// Faster growth, in e-folds of the amplitude per window, is that of the window itself.
const FASTEST_PER_WINDOW: f64 = 3.0;
/// A rate whose interval of confidence is wider than this share of it to either side is not stated.
const LEAST_CONFIDENCE: f64 = 0.3;
/// Largest mean square of the residuals, in units of the variance that the weights state: 0.2 in the logarithm of the
/// amplitude (1.7 dB) where there is no noise. What grows otherwise, such as a tone that is switched on, has no rate.
const LARGEST_MISFIT: f64 = 100.0;
/// Standard deviation of the logarithm of the amplitude that is not noise: what the model of constant growth leaves.
const MODEL_DEVIATION: f64 = 0.02;

/// Growth of a tone from the noise up to saturation: amplitude proportional to `e^(σ t)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Growth {
    /// `σ`, 1/s.
    pub rate_per_s: f64,
    /// Interval of 95 % confidence, 1/s.
    pub low_per_s: f64,
    pub high_per_s: f64,
    /// Range of levels it was fitted over, dB.
    pub span_db: f64,
}

/// A tone in samples, demodulated.
pub struct Envelope {
    /// Averages over blocks of `x e^(-2πi f t)`.
    blocks: Vec<[f64; 2]>,
    block_s: f64,
    /// One-sided power spectral density of the noise around the tone, per Hz.
    noise_density: f64,
}

/// Mean squares of the tone in windows of one length, each a quarter of a window after the one before.
struct Windowed {
    mean_squares: Vec<f64>,
    step_s: f64,
    length_s: f64,
    /// Mean square of the noise.
    noise: f64,
}

/// Straight line `y = intercept + slope x` through weighted points.
struct Line {
    slope: f64,
    intercept: f64,
    /// Half of the interval of 95 % confidence of the slope.
    half_width: f64,
    /// Mean square of the residuals, weighted.
    misfit: f64,
}

impl Envelope {
    /// The tone of `frequency_hz` in `samples`, with noise of `noise_density` per Hz around it.
    pub fn new(
        samples: impl ExactSizeIterator<Item = f64>,
        sample_rate_hz: f64,
        frequency_hz: f64,
        noise_density: f64,
    ) -> Self {
        let size = (BLOCK_S * sample_rate_hz).round().max(4.0) as usize;
        let turns = frequency_hz / sample_rate_hz;
        let (step_sin, step_cos) = (TAU * turns).sin_cos();
        let mut blocks = Vec::with_capacity(samples.len() / size);
        let ([mut re, mut im], [mut cos, mut sin]) = ([0.0; 2], [1.0, 0.0]);
        for (index, sample) in samples.enumerate() {
            if index % size == 0 {
                // Anew for each block, so that rounding errors of the rotation do not add up.
                (sin, cos) = (TAU * (turns * index as f64).fract()).sin_cos();
                (re, im) = (0.0, 0.0);
            }
            re += sample * cos;
            im -= sample * sin;
            (cos, sin) = (cos * step_cos - sin * step_sin, sin * step_cos + cos * step_sin);
            if index % size == size - 1 {
                blocks.push([re / size as f64, im / size as f64]);
            }
        }
        Self { blocks, block_s: size as f64 / sample_rate_hz, noise_density }
    }

    fn windowed(&self, blocks: usize) -> Windowed {
        let weights = hann(blocks);
        let total: f64 = weights.iter().sum();
        let mean_square = |window: &[[f64; 2]]| {
            let part =
                |k: usize| window.iter().zip(&weights).map(|(block, weight)| weight * block[k]).sum::<f64>() / total;
            // The average of a cosine of amplitude a is a/2, its mean square a²/2.
            2.0 * (part(0).powi(2) + part(1).powi(2))
        };
        let length_s = blocks as f64 * self.block_s;
        Windowed {
            mean_squares: self.blocks.windows(blocks).step_by(blocks / STEPS_PER_WINDOW).map(mean_square).collect(),
            step_s: length_s / STEPS_PER_WINDOW as f64,
            length_s,
            noise: self.noise_density * NOISE_BANDWIDTH / length_s,
        }
    }

    /// The shortest window in which noise is 10 dB below `mean_square`; else the longest.
    fn finest(&self, mean_square: f64) -> Windowed {
        let quiet = |blocks: &&usize| {
            let length_s = **blocks as f64 * self.block_s;
            ABOVE_NOISE * self.noise_density * NOISE_BANDWIDTH / length_s <= mean_square
        };
        self.windowed(*WINDOWS.iter().rev().find(quiet).unwrap_or(&WINDOWS[0]))
    }

    /// Time in s after the first sample at which the mean square rises above `mean_square`; the last such time before the
    /// tone is found above it at or after `from_s`. `None` if it is above from the first sample on, or never.
    pub fn rises_above(&self, mean_square: f64, from_s: f64) -> Option<f64> {
        let windowed = self.finest(mean_square);
        let values = &windowed.mean_squares;
        let from = windowed.index(from_s);
        let above = (from..values.len()).find(|&j| values[j] >= mean_square)?;
        let below = (0..above).rev().find(|&j| values[j] < mean_square)?;
        Some(windowed.crossing_s(below, below + 1, mean_square))
    }

    /// Time in s after the first sample at which the mean square falls below `mean_square`; the first such time after
    /// the tone is found above it at or before `from_s`. `None` if it is above up to the last sample, or never.
    pub fn falls_below(&self, mean_square: f64, from_s: f64) -> Option<f64> {
        let windowed = self.finest(mean_square);
        let values = &windowed.mean_squares;
        let from = windowed.index(from_s);
        let above = (0..values.len().min(from + 1)).rev().find(|&j| values[j] >= mean_square)?;
        let below = (above + 1..values.len()).find(|&j| values[j] < mean_square)?;
        Some(windowed.crossing_s(below - 1, below, mean_square))
    }

    /// Growth of the tone that is saturated at a mean square of `saturated` and has grown through its range around
    /// `near_s`, with the time at which the growing tone passes `mean_square`. `None` if growth is too short, too fast or
    /// too noisy to be measured.
    ///
    /// The logarithm of the amplitude, less the noise, is fitted by a straight line, weighted by the variance that the
    /// noise gives it. The longest window is used that fits 2.5 times into the growth and in which the amplitude grows by
    /// at most `e³`.
    pub fn growth(&self, saturated: f64, near_s: f64, mean_square: f64) -> Option<(Growth, f64)> {
        WINDOWS.iter().find_map(|&blocks| {
            let windowed = self.windowed(blocks);
            let (from, to) = windowed.growing(saturated, near_s)?;
            let range = (from..=to).rev().step_by(STEPS_PER_WINDOW / 2).filter_map(|j| windowed.point(j));
            let points: Vec<[f64; 3]> = range.collect();
            let values = &windowed.mean_squares;
            let span_db = 10.0 * (values[to] / values[from]).log10();
            if points.len() < FEWEST_POINTS || span_db < LEAST_SPAN_DB {
                return None;
            }
            let line = fit(&points)?;
            let Line { slope, intercept, half_width, misfit } = line;
            if half_width > LEAST_CONFIDENCE * slope || slope * windowed.length_s > FASTEST_PER_WINDOW {
                return None;
            }
            if misfit > LARGEST_MISFIT {
                return None;
            }
            // A window sees the average of the growing amplitude, which exceeds the amplitude at its middle.
            let gain = window_gain(&hann(blocks), slope * self.block_s);
            let passes_s = (0.5 * mean_square.ln() + gain.ln() - intercept) / slope;
            let growth =
                Growth { rate_per_s: slope, low_per_s: slope - half_width, high_per_s: slope + half_width, span_db };
            Some((growth, passes_s))
        })
    }
}

impl Windowed {
    /// The window whose middle is nearest to a time.
    fn index(&self, time_s: f64) -> usize {
        ((time_s - 0.5 * self.length_s) / self.step_s).round().max(0.0) as usize
    }

    /// Time of the middle of a window.
    fn time_s(&self, index: usize) -> f64 {
        index as f64 * self.step_s + 0.5 * self.length_s
    }

    /// Where the level passes that of `mean_square` between two neighbouring windows.
    fn crossing_s(&self, first: usize, second: usize, mean_square: f64) -> f64 {
        let [a, b] = [first, second].map(|j| self.mean_squares[j].max(f64::MIN_POSITIVE).ln());
        let share = if a == b { 0.5 } else { ((mean_square.ln() - a) / (b - a)).clamp(0.0, 1.0) };
        self.time_s(first) + share * self.step_s
    }

    /// First and last window of the growth.
    fn growing(&self, saturated: f64, near_s: f64) -> Option<(usize, usize)> {
        let values = &self.mean_squares;
        let (low, high) = (ABOVE_NOISE * self.noise, BELOW_SATURATION * saturated);
        let near = self.index(near_s);
        let mut last = (near..values.len()).find(|&j| values[j] >= high)?;
        while last > 0 && values[last] >= high {
            last -= 1;
        }
        let (mut lowest, mut first) = (values[last], last);
        for j in (0..last).rev() {
            if values[j] < low || values[j] > HIGHER_BEFORE * lowest {
                break;
            }
            if values[j] < lowest {
                (lowest, first) = (values[j], j);
            }
        }
        (first < last && lowest >= low).then_some((first, last))
    }

    /// Time, logarithm of the amplitude less the noise, and its weight.
    fn point(&self, index: usize) -> Option<[f64; 3]> {
        let mean_square = self.mean_squares[index];
        let tone = mean_square - self.noise;
        let variance = 0.5 * self.noise / mean_square + MODEL_DEVIATION * MODEL_DEVIATION;
        (tone > 0.0).then(|| [self.time_s(index), 0.5 * tone.ln(), 1.0 / variance])
    }
}

/// One-sided power spectral density per Hz of noise with this mean square in a bin of a frame.
pub fn noise_density(bin_noise: f64, frame_s: f64) -> f64 {
    bin_noise * frame_s / NOISE_BANDWIDTH
}

/// Weights of a Hann window at the middles of its blocks.
fn hann(blocks: usize) -> Vec<f64> {
    (0..blocks).map(|i| (0.5 * TAU * (i as f64 + 0.5) / blocks as f64).sin().powi(2)).collect()
}

/// Average over the window of an amplitude that grows by `e^rate` from block to block, 1 at its middle.
fn window_gain(weights: &[f64], rate: f64) -> f64 {
    let middle = 0.5 * (weights.len() as f64 - 1.0);
    let sum: f64 = weights.iter().enumerate().map(|(i, weight)| weight * (rate * (i as f64 - middle)).exp()).sum();
    sum / weights.iter().sum::<f64>()
}

/// Weighted least squares through points `[x, y, weight]`. The variance is the larger of the one that the weights state and
/// the one of the residuals.
fn fit(points: &[[f64; 3]]) -> Option<Line> {
    let freedom = points.len().checked_sub(2).filter(|&freedom| freedom > 0)?;
    let total: f64 = points.iter().map(|[.., w]| w).sum();
    let mean = |k: usize| points.iter().map(|point| point[2] * point[k]).sum::<f64>() / total;
    let [x_mean, y_mean] = [mean(0), mean(1)];
    let x_square: f64 = points.iter().map(|[x, _, w]| w * (x - x_mean).powi(2)).sum();
    let slope = points.iter().map(|[x, y, w]| w * (x - x_mean) * (y - y_mean)).sum::<f64>() / x_square;
    let intercept = y_mean - slope * x_mean;
    let residuals: f64 = points.iter().map(|[x, y, w]| w * (y - intercept - slope * x).powi(2)).sum();
    let misfit = residuals / freedom as f64;
    let variance = misfit.max(1.0) / x_square;
    let half_width = student_95(freedom) * variance.sqrt();
    (slope.is_finite() && half_width.is_finite()).then_some(Line { slope, intercept, half_width, misfit })
}

/// Two-sided 95 % quantile of Student's t. By its expansion in `1/ν` from 9 degrees of freedom on (Abramowitz and Stegun
/// 26.7.5), below 1e-3 off there.
fn student_95(freedom: usize) -> f64 {
    const FEW: [f64; 8] = [12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306];
    let z: f64 = 1.959_964;
    let n = freedom as f64;
    match FEW.get(freedom.wrapping_sub(1)) {
        Some(&quantile) => quantile,
        None => {
            z + (z.powi(3) + z) / (4.0 * n)
                + (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / (96.0 * n * n)
                + (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / (384.0 * n.powi(3))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 51_200.0;

    /// A tone of 2345 Hz whose amplitude is a function of time.
    fn envelope(duration_s: f64, amplitude: impl Fn(f64) -> f64) -> Envelope {
        let count = (duration_s * RATE_HZ) as usize;
        let samples = (0..count).map(|i| {
            let t = i as f64 / RATE_HZ;
            amplitude(t) * (TAU * 2345.0 * t + 0.3).cos()
        });
        Envelope::new(samples, RATE_HZ, 2345.0, 1e-16)
    }

    /// Amplitude `e^(σ(t - 0.5))` up to 1: its mean square passes 0.005 (amplitude 0.1) at `0.5 - ln 10 / σ`. What is left
    /// of the doubled frequency in windows of 2 to 32 ms, and the sharp bend at saturation, of which the last windows see
    /// up to half their length, decide the tolerances: 0.2 % and 0.1 ms.
    #[test]
    fn growth_and_its_passage_through_a_level_are_those_of_an_exponential() {
        for sigma in [20.0, 60.0, 200.0, 500.0_f64] {
            let envelope = envelope(1.0, |t| (sigma * (t - 0.5)).exp().min(1.0));
            let (growth, passes_s) = envelope.growth(0.5, 0.5, 0.005).expect("it grows");
            assert!((growth.rate_per_s / sigma - 1.0).abs() < 2e-3, "{growth:?}, expected {sigma}");
            assert!(growth.low_per_s < sigma && sigma < growth.high_per_s, "{growth:?}");
            let expected = 0.5 - 10.0_f64.ln() / sigma;
            assert!((passes_s - expected).abs() < 1e-4, "{passes_s}, expected {expected}");
            assert!(growth.span_db > 10.0);
        }
        let sudden = envelope(0.2, |t| if t < 0.1 { 1e-6 } else { 1.0 });
        assert_eq!(sudden.growth(0.5, 0.1, 0.005), None, "faster than the windows");
    }

    /// A tone that is switched passes any level within a window of 2 ms.
    #[test]
    fn levels_are_passed_when_the_tone_is_switched() {
        let switched = envelope(0.5, |t| if (0.1..0.4).contains(&t) { 1.0 } else { 0.01 });
        let rises = switched.rises_above(0.1, 0.12).expect("it rises");
        let falls = switched.falls_below(0.1, 0.38).expect("it falls");
        assert!((rises - 0.1).abs() < 1e-3 && (falls - 0.4).abs() < 1e-3, "{rises} {falls}");
        assert_eq!((switched.rises_above(0.6, 0.2), switched.falls_below(0.6, 0.2)), (None, None), "never that loud");
        let throughout = envelope(0.5, |_| 1.0);
        assert_eq!((throughout.rises_above(0.1, 0.2), throughout.falls_below(0.1, 0.2)), (None, None));
        assert_eq!(envelope(0.0005, |_| 1.0).growth(0.5, 0.1, 0.1), None, "shorter than a window");
    }

    /// Quantiles from tables of Student's distribution.
    #[test]
    fn students_quantiles_are_those_of_the_tables() {
        for (freedom, quantile) in [(1, 12.706), (8, 2.306), (9, 2.262), (12, 2.179), (30, 2.042), (120, 1.980)] {
            assert!((student_95(freedom) - quantile).abs() < 1e-3, "{freedom}: {}", student_95(freedom));
        }
    }
}
