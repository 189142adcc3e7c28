//! Roots of a full model in a frequency band, the discs that were searched for them, and the progress of the search.

use faer::{Mat, c64};

use super::precision::Precision;
use crate::physics::Situation;

/// Half the stretch of the imaginary axis that a disc counts as covering, relative to its radius. At the ends of that
/// stretch the half width of the disc is 0.31 of its radius.
const CHORD: f64 = 0.95;

/// Which eigenvectors to compute.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FullVectors {
    /// No vectors.
    None,
    /// Right vectors `x` and left vectors `y`: `(λ² M + λ C + K) x = 0`, `yᴴ (λ² M + λ C + K) = 0`.
    Both,
}

/// A root of the full model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FullRoot {
    /// `λ`, 1/s, with an imaginary part of at least 0.
    pub lambda: c64,
    /// Scaled residual `|(λ² M + λ C + K) x| / ((|λ|² |M| + |λ| |C| + |K|) |x|)`, with 1-norms of matrices and 2-norms
    /// of vectors.
    pub residual: f64,
}

/// The roots of a frequency band and the discs that were searched.
#[derive(Clone, Debug)]
pub struct FullSpectrum {
    /// The operating point with its contact state.
    pub here: Situation,
    /// Ascending in frequency.
    pub roots: Vec<FullRoot>,
    /// Right eigenvectors, `n×roots`, 2-norm 1; no columns unless requested.
    pub right: Mat<c64>,
    /// Left eigenvectors, `n×roots`, 2-norm 1; no columns unless requested.
    pub left: Mat<c64>,
    /// Discs in ascending order of their shifts. Together they cover the imaginary axis from 0 to the end of the band.
    /// Empty for a small model solved densely, which yields all roots.
    pub discs: Vec<CoveredDisc>,
    /// Magnitude of growth rate, 1/s, up to which every root was found at every frequency of the band.
    pub covered_growth_per_s: f64,
}

/// Progress of a full solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FullProgress {
    /// The model is ordered and symbolically analysed. `bytes` is a lower estimate of the memory needed in addition to
    /// memory already in use.
    Analysed {
        /// The bytes.
        bytes: usize,
    },
    /// The matrix at this shift, rad/s, is factorised.
    Factored {
        /// The shift, rad/s.
        shift_rad_s: f64,
        /// How the factor is kept.
        precision: Precision,
    },
    /// Krylov vectors built so far around the shift, and how many of the wanted roots have converged.
    Iterated {
        /// The shift, rad/s.
        shift_rad_s: f64,
        /// Number of vectors built.
        vectors: usize,
        /// Number of converged roots.
        converged: usize,
        /// Number of roots wanted.
        wanted: usize,
    },
    /// A disc is complete and contains `roots` roots.
    Covered {
        /// The disc.
        disc: CoveredDisc,
        /// Number of roots in it.
        roots: usize,
    },
}

/// Disc around a shift within which every root has converged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoveredDisc {
    /// Angular frequency `ω` of the shift, rad/s. The centre is `λ = iω`, or `-λ² = ω²` if `squared`.
    pub shift_rad_s: f64,
    /// Radius in the `λ` plane, 1/s, or in the `λ²` plane, 1/s², if `squared`.
    pub radius: f64,
    /// The disc lies in the `λ²` plane, as for undamped models.
    pub squared: bool,
}

impl CoveredDisc {
    /// Covered stretch of the imaginary axis, rad/s.
    pub fn stretch_rad_s(&self) -> [f64; 2] {
        let (omega, half) = (self.shift_rad_s, CHORD * self.radius);
        if self.squared {
            let square = omega * omega;
            let low = if half >= square { 0.0 } else { (square - half).sqrt() };
            return [low, (square + half).sqrt()];
        }
        [(omega - half).max(0.0), omega + half]
    }

    /// Largest magnitude of growth rate covered at the frequency `omega`, rad/s; 1/s.
    pub fn growth_per_s(&self, omega: f64) -> f64 {
        if self.radius == f64::INFINITY {
            return f64::INFINITY;
        }
        if self.squared {
            // |ω² - σ² - ω₀² - 2 i σ ω|² < ρ², quadratic in σ².
            let (a, b) = (omega * omega, self.shift_rad_s * self.shift_rad_s);
            return ((4.0 * a * b + self.radius * self.radius).sqrt() - a - b).max(0.0).sqrt();
        }
        let off = (omega - self.shift_rad_s).abs().min(self.radius);
        (self.radius * self.radius - off * off).sqrt()
    }

    /// The share of the stretch `[from, to]` around the shift, rad/s, that the disc covers on the side where it covers less;
    /// 1 only if it covers all of it with growth rates up to `growth`, 1/s, in magnitude.
    pub(super) fn share_of(&self, [from, to]: [f64; 2], growth: f64) -> f64 {
        let ([low, high], middle) = (self.stretch_rad_s(), self.shift_rad_s);
        let enough = self.growth_per_s(from).min(self.growth_per_s(to)) >= growth;
        if low <= from && high >= to && enough {
            return 1.0;
        }
        let share = |covered: f64, whole: f64| if whole > 0.0 { covered / whole } else { 1.0 };
        share(middle - low, middle - from).min(share(high - middle, to - middle)).min(1.0 - f64::EPSILON)
    }

    /// Whether `λ` lies in the disc shrunk by [`CHORD`].
    pub(super) fn holds(&self, lambda: c64) -> bool {
        let centre = c64::new(0.0, self.shift_rad_s);
        let distance = if self.squared { (lambda * lambda - centre * centre).norm() } else { (lambda - centre).norm() };
        distance < CHORD * self.radius
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a disc of radius 50 around 100 covers 52.5 to 147.5, and growth rates up to 30 at 60 and at 140.
    #[test]
    fn a_disc_covers_a_share_of_a_stretch() {
        let disc = CoveredDisc { shift_rad_s: 100.0, radius: 50.0, squared: false };
        let share = |from: f64, to: f64, growth: f64| disc.share_of([from, to], growth);
        assert_eq!(share(60.0, 140.0, 29.0), 1.0);
        let (too_wide, too_low, one_sided) =
            (share(60.0, 140.0, 31.0), share(0.0, 140.0, 0.0), share(100.0, 195.0, 0.0));
        assert!(too_wide < 1.0 && (too_low - 0.475).abs() < 1e-12 && (one_sided - 0.5).abs() < 1e-12);
        assert_eq!(share(100.0, 100.0, 1.0), 1.0);
    }
}
