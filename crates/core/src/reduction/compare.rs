//! Comparison of a reduced model with the full one: roots at operating points, and windows of instability over the
//! friction coefficient.
//!
//! Roots are paired one to one, nearest first. An unstable full root whose partner is stable or absent is *missed*. An
//! unstable reduced root whose partner is stable or absent is *invented*.
//!
//! Windows of the full model are computed from a projection of it. The basis consists of right and left vectors at a
//! few friction coefficients. Vectors at window ends are added, a few at a time, until all ends stay fixed. Window ends
//! then have full accuracy, although `λ` itself has only half the digits near a merging point. Finally the projection
//! is checked against the full model at friction coefficients between the samples, because a mode absent from every
//! sample would otherwise go unnoticed.

use faer::{Mat, c64};

use super::ReductionError;
use super::full_model::FullModel;
use super::full_order::FullSolver;
use super::full_root::{FullProgress, FullSpectrum, FullVectors};
use super::matching::pair_off;
use crate::physics::{
    MapError, MapOptions, Model, ModelError, OperatingPoint, SolveError, Solver, StabilityMap, Vectors, Window,
};
use crate::sampling::radical_inverse;

/// Length, relative to the vector, of its component outside the basis below which it is not added. With right and left
/// vectors in the basis the error of a root is of the order of the square of this.
const NEW: f64 = 1e-6;
/// Damping ratio above which a root is assumed unable to become unstable; its vectors are not added.
const DAMPED: f64 = 0.05;
/// Change of the friction coefficient of a window end below which it is converged.
const STILL: f64 = 1e-8;
/// Number of window ends at which vectors are added per round.
const ADDED: usize = 3;
/// Largest number of rounds.
const MOST_ROUNDS: usize = 16;
/// Number of friction coefficients at which the projection is checked against the full model once the window ends have
/// converged.
const CHECKS: usize = 2;
/// Largest relative error of a root in that check.
const CHECKED: f64 = 1e-6;
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

/// Windows of instability of a full model at the load and speed of `p`, for friction coefficients from 0 to
/// `options.mu_max`. `band_rad_s` is the end of the band in rad/s, `options.band_max_hz` the same in Hz.
///
/// # Errors
/// [`CompareError`].
pub fn full_windows(
    model: &FullModel,
    solver: &mut FullSolver<'_>,
    p: &OperatingPoint,
    band_rad_s: f64,
    options: &MapOptions,
    progress: &mut dyn FnMut(FullProgress),
) -> Result<Vec<Window>, CompareError> {
    let mut basis = Basis { columns: Mat::zeros(model.dimension(), 0) };
    let mut roots = 0;
    let mut sample = |mu: f64, columns: usize| -> Result<FullSpectrum, ReductionError> {
        // Memory: adding vectors takes the columns and a grown copy of them; projecting takes the columns, products
        // with them and the new basis.
        let columns = size_of::<f64>() * model.dimension() * (columns + 4 * roots);
        solver.make_room(FullVectors::Both, roots, 2 * columns, 3 * columns)?;
        let found = solver.roots(&p.with_friction(mu), 1.1 * band_rad_s, FullVectors::Both, progress)?;
        roots = roots.max(found.roots.len());
        Ok(found)
    };
    let last = model.last_friction(p, options.mu_max);
    let mut next: Vec<f64> = [0.0, 0.5, 1.0].iter().map(|share| share * last).collect();
    let (mut sampled, mut ends): (Vec<f64>, Vec<f64>) = (vec![], vec![]);
    let (mut moved, mut error) = (f64::INFINITY, f64::INFINITY);
    // 1/4, 3/4, 1/8, ...
    let mut checks = (2..).map(|index| last * radical_inverse(index, 2));
    let (rounds, limit) = (MOST_ROUNDS, CHECKED);
    #[cfg(test)]
    let (rounds, limit) = tests::spoilt(rounds, limit);
    for _ in 0..rounds {
        for mu in std::mem::take(&mut next) {
            basis.add(&sample(mu, basis.columns.ncols())?);
            sampled.push(mu);
        }
        let reduced = model.project(basis.columns.as_ref())?.model(model.contact_law)?;
        let mut dense = Solver::new(reduced.dimension());
        let map = StabilityMap::build(&reduced, &mut dense, p, options)?;
        let found: Vec<f64> = map.windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten().collect();
        moved = if found.len() == ends.len() {
            found.iter().zip(&ends).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        } else {
            f64::INFINITY
        };
        next = farthest(&found, &sampled);
        ends = found;
        if moved < STILL || next.is_empty() {
            moved = 0.0;
            error = 0.0;
            for mu in checks.by_ref().take(CHECKS) {
                let found = sample(mu, basis.columns.ncols())?;
                let of_projection = reduced_roots(&reduced, &mut dense, &p.with_friction(mu))?;
                error = error.max(error_of_projection(&found, &of_projection, band_rad_s));
                basis.add(&found);
                sampled.push(mu);
            }
            if error <= limit {
                return Ok(map.windows);
            }
        }
    }
    Err(if moved < STILL {
        CompareError::NotHeld { error, rounds, limit }
    } else {
        CompareError::NotStill { moved, rounds, limit: STILL }
    })
}

/// At most [`ADDED`] of the `ends`: those farthest from the `sampled` friction coefficients and from each other.
fn farthest(ends: &[f64], sampled: &[f64]) -> Vec<f64> {
    let mut known = sampled.to_vec();
    let mut chosen = vec![];
    while chosen.len() < ADDED {
        let distance = |mu: f64| known.iter().map(|known| (known - mu).abs()).fold(f64::INFINITY, f64::min);
        let Some(&far) = ends.iter().max_by(|a, b| distance(**a).total_cmp(&distance(**b))) else { break };
        if distance(far) <= 1e-3 * STILL {
            break;
        }
        known.push(far);
        chosen.push(far);
    }
    chosen
}

/// Whether a root may become unstable: its damping ratio is below [`DAMPED`].
fn may_grow(lambda: c64) -> bool {
    lambda.re > -DAMPED * lambda.norm()
}

/// Largest `|Δλ| / |λ|` of the full roots in the band that may become unstable; infinite if one of them has no partner.
fn error_of_projection(full: &FullSpectrum, projected: &[c64], band_rad_s: f64) -> f64 {
    let full: Vec<c64> = full.roots.iter().map(|root| root.lambda).filter(|lambda| may_grow(*lambda)).collect();
    let judged = Judged { band_rad_s, instability_threshold: f64::INFINITY, decay_per_s: f64::INFINITY };
    let compared = compare_roots(&full, projected, &judged);
    if compared.unpaired > 0 { f64::INFINITY } else { compared.relative_error() }
}

/// Orthonormal basis of eigenvectors of a full model.
struct Basis {
    columns: Mat<f64>,
}

impl Basis {
    /// Adds the real and imaginary parts of right and left vectors, as far as they are outside the span.
    fn add(&mut self, found: &FullSpectrum) {
        let n = self.columns.nrows();
        for vectors in [&found.right, &found.left] {
            for k in (0..vectors.ncols()).filter(|&k| may_grow(found.roots[k].lambda)) {
                // Rotates the phase so that a real vector times a complex factor becomes real.
                let square: c64 = (0..n).map(|i| vectors[(i, k)] * vectors[(i, k)]).sum();
                let turn =
                    if square.norm() > 0.0 { (square / square.norm()).sqrt().conj() } else { c64::new(1.0, 0.0) };
                for imaginary in [false, true] {
                    let part = |i: usize| {
                        let value = vectors[(i, k)] * turn;
                        if imaginary { value.im } else { value.re }
                    };
                    let mut column = Mat::from_fn(n, 1, |i, _| part(i));
                    for _ in 0..2 {
                        let held = self.columns.transpose() * &column;
                        column -= &self.columns * held;
                    }
                    let norm = column.norm_l2();
                    // Relative to the vector, whose length is 1.
                    if norm > NEW {
                        let last = self.columns.ncols();
                        self.columns.resize_with(n, last + 1, |i, _| column[(i, 0)] / norm);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::full_order::tests::{point, touching};
    use super::*;
    use crate::physics::{ContactLaw, WindowKind};

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

    /// Windows of the full model agree with those of a dense model of all its degrees of freedom. A basis from one load
    /// reproduces the roots at that load and fails at another, where the contact is stiffer.
    #[test]
    fn a_basis_made_at_one_load_is_caught_at_another() {
        let law = ContactLaw { exponent: 1.0, ..ContactLaw::default() };
        let model = touching(42, 0.0, law);
        let n = model.dimension();
        let band = 700.0;
        let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
        let at = |load: f64, mu: f64| OperatingPoint { normal_load_n: load, ..point(mu) };
        let options = MapOptions {
            mu_min: 0.0,
            mu_max: 1.0,
            band_max_hz: Some(band / std::f64::consts::TAU),
            instability_threshold: 1e-6,
            windows: true,
        };
        let mut windows =
            |p: &OperatingPoint| full_windows(&model, &mut solver, p, band, &options, &mut |_| {}).unwrap();
        let of_full = windows(&at(500.0, 0.0));
        let whole = model.project(Mat::<f64>::identity(n, n).as_ref()).unwrap().model(law).unwrap();
        let map = StabilityMap::build(&whole, &mut Solver::new(n), &at(500.0, 0.0), &options).unwrap();
        let compared = compare_windows(&map.windows, &of_full);
        assert!(!compared.pairs.is_empty(), "no window at all");
        assert!(compared.missed.is_empty() && compared.invented.is_empty(), "{compared:?}");
        // The map refines window ends to 1e-10; those of the full model converge to 1e-8.
        let error = compared.friction_error(options.mu_max);
        assert!(error < 2.0 * STILL, "{error:e}");

        let mut basis = Basis { columns: Mat::zeros(n, 0) };
        // A narrow band keeps the basis far from complete.
        let judged = Judged { band_rad_s: 250.0, ..JUDGED };
        basis.add(&solver.roots(&at(500.0, 0.45), judged.band_rad_s, FullVectors::Both, &mut |_| {}).unwrap());
        assert!(basis.columns.ncols() < n / 3, "{} columns", basis.columns.ncols());
        let reduced = model.project(basis.columns.as_ref()).unwrap().model(law).unwrap();
        let mut dense = Solver::new(reduced.dimension());
        let mut error = |load: f64| {
            let p = at(load, 0.45);
            let full = solver.roots(&p, judged.band_rad_s, FullVectors::None, &mut |_| {}).unwrap();
            let full: Vec<c64> = full.roots.iter().map(|root| root.lambda).collect();
            let compared = compare_roots(&full, &reduced_roots(&reduced, &mut dense, &p).unwrap(), &judged);
            assert_eq!(compared.unpaired, 0);
            compared.relative_error()
        };
        let (own, other) = (error(500.0), error(2000.0));
        // At its own load the basis contains the exact vectors.
        assert!(own < 1e-9 && other > 1e-6, "{own:e} {other:e}");
    }

    /// Rounds and limit under fault injection.
    pub(super) fn spoilt(rounds: usize, limit: f64) -> (usize, f64) {
        use crate::spoil::{Spoil, spoilt};
        if spoilt(Spoil::Rounds) {
            (1, limit)
        } else if spoilt(Spoil::Held) {
            (6, 0.0)
        } else {
            (rounds, limit)
        }
    }

    #[test]
    fn windows_that_still_move_and_projections_that_are_off_are_errors() {
        use crate::spoil::{Spoil, with};
        let model = touching(42, 0.0, ContactLaw::default());
        let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
        let band = 700.0;
        let band_max_hz = Some(band / std::f64::consts::TAU);
        let options = MapOptions { mu_min: 0.0, mu_max: 1.0, band_max_hz, instability_threshold: 1e-6, windows: true };
        let mut windows = || full_windows(&model, &mut solver, &point(0.0), band, &options, &mut |_| {});
        let moving = with(Spoil::Rounds, &mut windows);
        assert!(matches!(moving, Err(CompareError::NotStill { rounds: 1, .. })), "{moving:?}");
        let off = with(Spoil::Held, &mut windows);
        assert!(matches!(off, Err(CompareError::NotHeld { rounds: 6, error, .. }) if error > 0.0), "{off:?}");
    }

    #[test]
    fn the_next_samples_are_at_ends_far_from_earlier_samples() {
        assert_eq!(farthest(&[0.1, 0.3, 0.31, 0.5, 0.9], &[0.0, 0.5, 1.0]), [0.3, 0.1, 0.9]);
        assert_eq!(farthest(&[0.5, 0.5], &[0.0, 0.5, 1.0]), [0.0; 0]);
    }

    /// The check between samples covers every root that may become unstable.
    #[test]
    fn an_incomplete_projection_is_reported() {
        let model = touching(42, 0.0, ContactLaw::default());
        let band = 700.0;
        let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
        let mut solve = |mu: f64, band: f64| solver.roots(&point(mu), band, FullVectors::Both, &mut |_| {}).unwrap();
        let checked = solve(0.4, band);
        let mut error = |samples: &[(f64, f64)]| {
            let mut basis = Basis { columns: Mat::zeros(model.dimension(), 0) };
            samples.iter().for_each(|&(mu, band)| basis.add(&solve(mu, band)));
            let reduced = model.project(basis.columns.as_ref()).unwrap().model(model.contact_law).unwrap();
            let roots = reduced_roots(&reduced, &mut Solver::new(reduced.dimension()), &point(0.4)).unwrap();
            error_of_projection(&checked, &roots, band)
        };
        // Samples: the lower half of the band only, one friction coefficient, and the three that [`full_windows`]
        // starts with.
        let (half, one, three) =
            (error(&[(0.0, 0.5 * band)]), error(&[(0.0, band)]), error(&[(0.0, band), (0.5, band), (1.0, band)]));
        assert!(half > 1e-3 && one > CHECKED && three < one, "{half:e} {one:e} {three:e}");
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
