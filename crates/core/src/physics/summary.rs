//! Summary of a spectrum: the modes of the band, and which of them grow.

use super::numbering::{Census, Followed};
use super::spectrum::{Root, Spectrum};
use super::stability_map::StabilityMap;

/// A mode with its identity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mode {
    /// Identity: numbered from 0 in ascending `ω` at `μ = 0`, and followed in `μ` from there.
    pub id: u32,
    /// The root.
    pub root: Root,
}

/// The modes of the band, with number and growth rate of the unstable ones.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Summary {
    /// Modes of the band, ascending in frequency.
    pub modes: Vec<Mode>,
    /// Number of unstable modes of the band and unstable static roots.
    pub unstable_modes: u32,
    /// Largest growth rate of the modes of the band and the static roots, 1/s; `None` if there are neither.
    pub max_growth_rate_per_s: Option<f64>,
    /// Frequency of the fastest growing mode, Hz, 0 for a static root; `None` if nothing is unstable.
    pub worst_frequency_hz: Option<f64>,
    /// Growth rates of the static roots, 1/s, descending.
    pub nonoscillatory_growth_per_s: Vec<f64>,
    /// Work array for numbering.
    followed: Vec<Followed>,
}

impl Summary {
    /// Summarises the modes of `spectrum` up to `band_max_hz`. Identities come from `map`; without a map the modes
    /// are numbered by frequency. A root is unstable if `σ > threshold · |λ|`.
    pub fn of_spectrum(
        spectrum: &Spectrum,
        map: Option<&StabilityMap>,
        band_max_hz: Option<f64>,
        threshold: f64,
    ) -> Self {
        let mut summary = Self::default();
        summary.take_spectrum(spectrum, map, band_max_hz, threshold);
        summary
    }

    /// Does the same as [`Summary::of_spectrum`], reusing the memory of this summary.
    pub fn take_spectrum(
        &mut self,
        spectrum: &Spectrum,
        map: Option<&StabilityMap>,
        band_max_hz: Option<f64>,
        threshold: f64,
    ) {
        self.modes.clear();
        self.modes.extend(spectrum.modes().iter().map(|&root| Mode { id: 0, root }));
        let statics = spectrum.roots[spectrum.mode_count..].iter().copied();
        self.nonoscillatory_growth_per_s.clear();
        self.nonoscillatory_growth_per_s.extend(statics.clone().map(|root| root.lambda.re));
        if spectrum.undamped {
            self.nonoscillatory_growth_per_s.extend(statics.clone().map(|root| 0.0 - root.lambda.re));
        }
        self.judge(statics, band_max_hz, threshold);
        self.number(map, spectrum.point.friction_coefficient, Census::of(spectrum));
    }

    /// Summarises roots read off a chart at friction coefficient `mu`, in any order, reusing the memory of this
    /// summary.
    pub fn take_chart(
        &mut self,
        charted: &[Root],
        mu: f64,
        all: Census,
        map: Option<&StabilityMap>,
        band_max_hz: Option<f64>,
        threshold: f64,
    ) {
        self.modes.clear();
        self.modes.extend(charted.iter().filter(|root| root.oscillates()).map(|&root| Mode { id: 0, root }));
        sort_almost_sorted(&mut self.modes);
        let statics = charted.iter().copied().filter(|root| !root.oscillates());
        // Static roots are charted for undamped models only; each represents both signs.
        self.nonoscillatory_growth_per_s.clear();
        self.nonoscillatory_growth_per_s
            .extend(statics.clone().flat_map(|root| [root.lambda.re, 0.0 - root.lambda.re]));
        self.judge(statics, band_max_hz, threshold);
        self.number(map, mu, all);
    }

    /// Assigns identities to the modes.
    fn number(&mut self, map: Option<&StabilityMap>, mu: f64, all: Census) {
        match map {
            Some(map) => map.number(mu, all, &mut self.modes, &mut self.followed),
            None => self.modes.iter_mut().enumerate().for_each(|(k, mode)| mode.id = k as u32),
        }
    }

    /// Removes modes above the band, then counts unstable roots and finds the fastest growing one.
    fn judge(&mut self, statics: impl Iterator<Item = Root> + Clone, band_max_hz: Option<f64>, threshold: f64) {
        self.modes.retain(|mode| band_max_hz.is_none_or(|max_hz| mode.root.frequency_hz() <= max_hz));
        self.nonoscillatory_growth_per_s.sort_unstable_by(|a, b| b.total_cmp(a));
        let judged = || self.modes.iter().map(|mode| mode.root).chain(statics.clone());
        let fastest = judged().max_by(|a, b| a.lambda.re.total_cmp(&b.lambda.re));
        self.unstable_modes = judged().filter(|root| root.is_unstable(threshold)).count() as u32;
        self.max_growth_rate_per_s = fastest.map(|root| root.lambda.re);
        self.worst_frequency_hz = fastest.filter(|root| root.is_unstable(threshold)).map(|root| root.frequency_hz());
    }

    /// Whether a static root grows.
    pub fn diverges(&self) -> bool {
        self.nonoscillatory_growth_per_s.first().is_some_and(|&growth| growth > 0.0)
    }
}

/// Sorts modes by insertion. Those of a chart are almost sorted, which takes one or two steps each; if it takes many
/// more, a general sort is used.
fn sort_almost_sorted(modes: &mut [Mode]) {
    let order = |a: &Mode, b: &Mode| super::spectrum::order(&a.root, &b.root);
    let mut steps = 8 * modes.len();
    for k in 1..modes.len() {
        let mut at = k;
        while at > 0 && order(&modes[at - 1], &modes[at]).is_gt() {
            modes.swap(at - 1, at);
            at -= 1;
            if steps == 0 {
                modes.sort_unstable_by(order);
                return;
            }
            steps -= 1;
        }
    }
}
