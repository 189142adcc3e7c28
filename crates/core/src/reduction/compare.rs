//! Comparison of a reduced model with the full one: roots at operating points, and windows of instability over the
//! friction coefficient.
//!
//! Roots are paired one to one, nearest first. An unstable full root whose partner is stable or absent is *missed*. An
//! unstable reduced root whose partner is stable or absent is *invented*.

use faer::c64;

use super::ReductionError;
use super::matching::pair_off;
use crate::physics::{MapError, Model, ModelError, OperatingPoint, SolveError, Solver, Vectors, Window};

/// Largest distance of paired roots, relative to `|λ|`.
const PAIRED: f64 = 0.2;

/// Error of a comparison.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CompareError {
    /// A solve of the full model failed.
    #[error("full model: {0}")]
    Full(#[from] ReductionError),
    /// The full model projected on its own vectors is no valid model.
    #[error("full model on its own vectors: {0}")]
    Basis(#[from] ModelError),
    /// A solve of the reduced model failed.
    #[error("reduced model: {0}")]
    Reduced(#[from] SolveError),
    /// A stability map failed.
    #[error("windows of instability: {0}")]
    Map(#[from] MapError),
    /// The window ends of the full model did not converge.
    #[error("ends of windows of the full model still move by {moved:.1e} after {rounds} rounds, limit {limit:.1e}")]
    NotStill {
        /// Largest movement in the last round.
        moved: f64,
        /// Number of rounds.
        rounds: usize,
        /// Largest movement accepted.
        limit: f64,
    },
    /// The full model on its own vectors is not accurate enough between the samples.
    #[error(
        "full model on its own vectors is off by {error:.1e} between the friction coefficients that they are of, after \
         {rounds} rounds, limit {limit:.1e}"
    )]
    NotHeld {
        /// Largest relative error of a root.
        error: f64,
        /// Number of rounds.
        rounds: usize,
        /// Largest error accepted.
        limit: f64,
    },
}

/// Scope and threshold of a comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// Highest frequency, rad/s.
    pub band_rad_s: f64,
    /// A root is unstable if its growth rate `σ` exceeds this times `|λ|`.
    pub instability_threshold: f64,
    /// Full roots that decay faster than this are not compared, 1/s.
    pub decay_per_s: f64,
}

/// Comparison of the roots of both models at one operating point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Comparison {
    /// Pairs of full root and reduced root, in the order of the full roots.
    pub pairs: Vec<(c64, c64)>,
    /// Unstable roots of the full model without an unstable partner.
    pub missed: Vec<c64>,
    /// Unstable roots of the reduced model without an unstable partner.
    pub invented: Vec<c64>,
    /// Number of full roots within the scope that have no partner.
    pub unpaired: usize,
}

impl Comparison {
    /// Largest relative frequency error `|Δf| / f`; 0 without oscillating pairs.
    pub fn frequency_error(&self) -> f64 {
        let of =
            |(full, reduced): &(c64, c64)| if full.im > 0.0 { (full.im - reduced.im).abs() / full.im } else { 0.0 };
        self.pairs.iter().map(of).fold(0.0, f64::max)
    }

    /// Largest error of a growth rate `|Δσ|`, 1/s.
    pub fn growth_error_per_s(&self) -> f64 {
        self.pairs.iter().map(|(full, reduced)| (full.re - reduced.re).abs()).fold(0.0, f64::max)
    }

    /// Largest relative error of a root `|Δλ| / |λ|`.
    pub fn relative_error(&self) -> f64 {
        let of = |(full, reduced): &(c64, c64)| (full - reduced).norm() / full.norm().max(f64::MIN_POSITIVE);
        self.pairs.iter().map(of).fold(0.0, f64::max)
    }
}

/// Compares the roots of a full and of a reduced model.
pub fn compare_roots(full: &[c64], reduced: &[c64], judged: &Judged) -> Comparison {
    let unstable = |lambda: c64| lambda.re > judged.instability_threshold * lambda.norm();
    let mut distances = vec![];
    for (i, a) in full.iter().enumerate().filter(|(_, lambda)| lambda.im <= judged.band_rad_s) {
        for (j, b) in reduced.iter().enumerate() {
            let distance = (a - b).norm();
            if distance < PAIRED * a.norm() {
                distances.push((distance, i, j));
            }
        }
    }
    let of_full = pair_off(distances, full.len());
    let mut comparison = Comparison::default();
    for (i, &lambda) in full.iter().enumerate().filter(|(_, lambda)| lambda.im <= judged.band_rad_s) {
        let partner = of_full[i].map(|j| reduced[j]);
        if unstable(lambda) && !partner.is_some_and(unstable) {
            comparison.missed.push(lambda);
        }
        if lambda.re < -judged.decay_per_s {
            continue;
        }
        match partner {
            Some(partner) => comparison.pairs.push((lambda, partner)),
            None => comparison.unpaired += 1,
        }
    }
    for (j, &lambda) in reduced.iter().enumerate() {
        // A reduced root just above the band may belong to a full root that was not computed.
        let partner = of_full.iter().position(|partner| *partner == Some(j)).map(|i| full[i]);
        if unstable(lambda) && !partner.is_some_and(unstable) && (partner.is_some() || lambda.im <= judged.band_rad_s) {
            comparison.invented.push(lambda);
        }
    }
    comparison
}

/// Roots of a reduced model at `p`. Static roots of an undamped model are listed with both signs.
///
/// # Errors
/// [`SolveError`].
pub fn reduced_roots(model: &Model, solver: &mut Solver, p: &OperatingPoint) -> Result<Vec<c64>, SolveError> {
    let spectrum = solver.solve(model, p, Vectors::Right)?;
    let mut roots: Vec<c64> = spectrum.roots.iter().map(|root| root.lambda).collect();
    if spectrum.undamped {
        let statics: Vec<c64> = roots[spectrum.mode_count..].iter().map(|lambda| -lambda).collect();
        roots.extend(statics.into_iter().filter(|lambda| lambda.re != 0.0));
    }
    Ok(roots)
}

/// Comparison of the windows of instability of both models.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WindowComparison {
    /// Pairs of a full and a reduced window.
    pub pairs: Vec<(Window, Window)>,
    /// Full windows without a partner.
    pub missed: Vec<Window>,
    /// Reduced windows without a partner.
    pub invented: Vec<Window>,
}

impl WindowComparison {
    /// Largest difference of a window end, in friction coefficient. If only one of two windows ends below `mu_max`, the
    /// difference is taken to `mu_max`, a lower bound.
    pub fn friction_error(&self, mu_max: f64) -> f64 {
        let of = |(full, reduced): &(Window, Window)| {
            let to = match (full.mu_to, reduced.mu_to) {
                (Some(a), Some(b)) => (a - b).abs(),
                (Some(end), None) | (None, Some(end)) => mu_max - end,
                (None, None) => 0.0,
            };
            (full.mu_from - reduced.mu_from).abs().max(to)
        };
        self.pairs.iter().map(of).fold(0.0, f64::max)
    }
}

/// Pairs windows of the same kind whose frequencies differ by at most a fifth, nearest first.
pub fn compare_windows(full: &[Window], reduced: &[Window]) -> WindowComparison {
    let mut distances = vec![];
    for (i, a) in full.iter().enumerate() {
        for (j, b) in reduced.iter().enumerate() {
            let apart = (a.frequency_hz - b.frequency_hz).abs();
            if a.kind == b.kind && apart <= PAIRED * a.frequency_hz.max(b.frequency_hz) {
                distances.push(((a.mu_from - b.mu_from).abs() + apart / a.frequency_hz.max(1.0), i, j));
            }
        }
    }
    let of_full = pair_off(distances, full.len());
    let mut comparison = WindowComparison::default();
    for (window, partner) in full.iter().zip(&of_full) {
        match partner {
            Some(j) => comparison.pairs.push((window.clone(), reduced[*j].clone())),
            None => comparison.missed.push(window.clone()),
        }
    }
    let alone = |(j, _): &(usize, &Window)| !of_full.contains(&Some(*j));
    comparison.invented = reduced.iter().enumerate().filter(alone).map(|(_, window)| window.clone()).collect();
    comparison
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::WindowKind;

    const JUDGED: Judged = Judged { band_rad_s: 1000.0, instability_threshold: 1e-6, decay_per_s: 20.0 };

    #[test]
    fn missed_and_invented_roots_are_counted_separately() {
        let l = c64::new;
        let full = [l(0.0, 100.0), l(5.0, 300.0), l(-5.0, 300.0), l(0.0, 500.0), l(-50.0, 700.0), l(9.0, 1500.0)];
        let reduced = [l(0.0, 101.0), l(0.0, 298.0), l(0.0, 302.0), l(2.0, 501.0), l(-60.0, 710.0)];
        let found = compare_roots(&full, &reduced, &JUDGED);
        assert_eq!(found.missed, [l(5.0, 300.0)]);
        assert_eq!(found.invented, [l(2.0, 501.0)]);
        // Roots that decay fast or lie above the band are not compared.
        assert_eq!((found.pairs.len(), found.unpaired), (4, 0));
        assert!((found.frequency_error() - 0.01).abs() < 1e-12);
        assert_eq!(found.growth_error_per_s(), 5.0);
        let nothing = compare_roots(&full, &[], &JUDGED);
        assert_eq!((nothing.missed.len(), nothing.unpaired), (1, 4));
    }

    #[test]
    fn windows_are_paired_by_kind_and_frequency() {
        let window = |mu_from: f64, frequency_hz: f64| Window {
            mode_ids: vec![],
            mu_from,
            mu_to: None,
            frequency_hz,
            frequency_to_hz: None,
            kind: WindowKind::Coalescence,
        };
        let full = [window(0.2, 500.0), window(0.4, 1700.0)];
        let found = compare_windows(&full, &[window(0.41, 1702.0), window(0.3, 3000.0)]);
        assert_eq!((found.pairs.len(), found.missed.len(), found.invented.len()), (1, 1, 1));
        assert_eq!(found.missed[0].frequency_hz, 500.0);
        assert!((found.friction_error(1.0) - 0.01).abs() < 1e-12);
    }
}
