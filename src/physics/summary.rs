//! What a spectrum says about the modes of a rig's band.

use super::spectrum::{Root, Spectrum};

/// A mode with its identity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mode {
    /// Identity: ascending `ω` at `μ = 0`, from 0, continued in `μ`.
    pub id: u32,
    /// Its root.
    pub root: Root,
}

/// The modes of the band, and how many of them grow, how fast.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Modes of the band, ascending in frequency.
    pub modes: Vec<Mode>,
    /// Unstable modes of the band and growing static roots.
    pub unstable_modes: u32,
    /// The largest growth rate of a mode of the band or of a static root, 1/s; `None` without any.
    pub max_growth_rate_per_s: Option<f64>,
    /// Frequency of the fastest growing mode, Hz, 0 for a static root; `None` where nothing is unstable.
    pub worst_frequency_hz: Option<f64>,
    /// Growth rates of the roots that do not oscillate, 1/s, descending.
    pub nonoscillatory_growth_per_s: Vec<f64>,
}

impl Summary {
    /// Summarises `spectrum`, whose roots have identities `ids`, for modes up to `band_max_hz`; a root is unstable
    /// when `σ > threshold · |λ|`.
    pub fn of_spectrum(spectrum: &Spectrum, ids: &[Option<u32>], band_max_hz: Option<f64>, threshold: f64) -> Self {
        let id = |k: usize| ids.get(k).copied().flatten().unwrap_or(k as u32);
        let modes = spectrum.modes().iter().enumerate().map(|(k, root)| Mode { id: id(k), root: *root }).collect();
        let statics = &spectrum.roots[spectrum.mode_count..];
        Self::new(modes, statics, spectrum.nonoscillatory_growth_per_s(), band_max_hz, threshold)
    }

    /// Summarises roots read off a chart, in any order.
    pub fn of_chart(charted: &[Mode], band_max_hz: Option<f64>, threshold: f64) -> Self {
        let mut modes: Vec<Mode> = charted.iter().filter(|mode| mode.root.oscillates()).copied().collect();
        modes.sort_by(|a, b| super::spectrum::order(&a.root, &b.root));
        let statics: Vec<Root> = charted.iter().map(|mode| mode.root).filter(|root| !root.oscillates()).collect();
        // Only those of undamped models are charted, each for both signs.
        let mut growth: Vec<f64> = statics.iter().flat_map(|root| [root.lambda.re, 0.0 - root.lambda.re]).collect();
        growth.sort_by(|a, b| b.total_cmp(a));
        Self::new(modes, &statics, growth, band_max_hz, threshold)
    }

    fn new(
        mut modes: Vec<Mode>,
        statics: &[Root],
        nonoscillatory_growth_per_s: Vec<f64>,
        band_max_hz: Option<f64>,
        threshold: f64,
    ) -> Self {
        modes.retain(|mode| band_max_hz.is_none_or(|max_hz| mode.root.frequency_hz() <= max_hz));
        let judged = || modes.iter().map(|mode| &mode.root).chain(statics);
        let fastest = judged().max_by(|a, b| a.lambda.re.total_cmp(&b.lambda.re));
        Self {
            unstable_modes: judged().filter(|root| root.is_unstable(threshold)).count() as u32,
            max_growth_rate_per_s: fastest.map(|root| root.lambda.re),
            worst_frequency_hz: fastest.filter(|root| root.is_unstable(threshold)).map(Root::frequency_hz),
            nonoscillatory_growth_per_s,
            modes,
        }
    }

    /// The fastest growing static root, if it grows.
    pub fn diverges(&self) -> bool {
        self.nonoscillatory_growth_per_s.first().is_some_and(|&growth| growth > 0.0)
    }
}
