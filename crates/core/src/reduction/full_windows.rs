//! Windows of instability of a full model.
//!
//! They are computed from a projection of it. The basis consists of right and left vectors at a few friction
//! coefficients. Where a growth rate crosses zero, the full model's root there says how far the end is off. Otherwise
//! vectors at window ends are added, a few at a time, until all ends stay fixed. Window ends then have full accuracy,
//! although `λ` itself has only half the digits near a merging point. Finally the projection is checked against the
//! full model at friction coefficients between the samples, because a mode absent from every sample would otherwise go
//! unnoticed.

use faer::{Mat, MatRef, c64};

use super::ReductionError;
use super::compare::{CompareError, Judged, compare_roots, reduced_roots};
use super::full_model::FullModel;
use super::full_order::FullSolver;
use super::full_root::{FullProgress, FullSpectrum, FullVectors};
use crate::physics::{MapOptions, Model, OperatingPoint, Solver, StabilityMap, Vectors, Window};
use crate::sampling::radical_inverse;

/// Length, relative to the vector, of its component outside the basis below which it is not added. With right and left
/// vectors in the basis the error of a root is of the order of the square of this.
const NEW: f64 = 1e-5;
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
    let mut sample = |solver: &mut FullSolver<'_>, mu: f64, columns: usize| -> Result<FullSpectrum, ReductionError> {
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
            basis.add(&sample(solver, mu, basis.columns.ncols())?);
            sampled.push(mu);
        }
        let projected = Projection::new(model, basis.columns.as_ref(), p)?;
        let mut dense = Solver::new(projected.model.dimension());
        let map = StabilityMap::build(&projected.model, &mut dense, p, options)?;
        let found: Vec<f64> = map.windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten().collect();
        moved = if found.len() == ends.len() {
            found.iter().zip(&ends).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        } else {
            f64::INFINITY
        };
        if moved >= STILL {
            moved = projected.off(solver, &mut dense, &map.windows)?;
        }
        next = farthest(&found, &sampled);
        ends = found;
        if moved < STILL || next.is_empty() {
            moved = 0.0;
            error = 0.0;
            for mu in checks.by_ref().take(CHECKS) {
                let found = sample(solver, mu, basis.columns.ncols())?;
                let of_projection = reduced_roots(&projected.model, &mut dense, &p.with_friction(mu))?;
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

/// The full model projected on its own vectors, at one load and speed.
struct Projection {
    model: Model,
    point: OperatingPoint,
}

impl Projection {
    fn new(full: &FullModel, basis: MatRef<'_, f64>, p: &OperatingPoint) -> Result<Self, CompareError> {
        Ok(Self { model: full.project(basis)?.model(full.contact_law)?, point: *p })
    }

    /// Largest distance, in friction coefficient, of the ends of `windows` from those of the full model, to first order: at
    /// an end of the projection a growth rate `σ` crosses zero, and the root of the full model nearest to it differs by
    /// `Δλ`, which is at most `|Δλ| / |dσ/dμ|` in friction coefficient. Infinite where no growth rate crosses zero: roots
    /// merge, are static or jump there.
    fn off(&self, solver: &mut FullSolver<'_>, dense: &mut Solver, windows: &[Window]) -> Result<f64, CompareError> {
        let mut largest = 0.0_f64;
        let starts = windows.iter().map(|window| (window.mu_from, window.frequency_hz));
        let stops = windows.iter().filter_map(|window| window.mu_to.zip(window.frequency_to_hz));
        for (mu, frequency_hz) in starts.chain(stops) {
            let p = self.point.with_friction(mu);
            let spectrum = dense.solve(&self.model, &p, Vectors::Both)?;
            let omega = std::f64::consts::TAU * frequency_hz;
            let distance = |k: &usize| (spectrum.roots[*k].lambda - c64::new(0.0, omega)).norm();
            let nearest = (0..spectrum.roots.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let Some(root) = nearest.filter(|_| omega > 0.0 && !spectrum.undamped) else { return Ok(f64::INFINITY) };
            let lambda = spectrum.roots[root].lambda;
            let slope = (spectrum.friction_sensitivity[root] / (lambda * 2.0)).re.abs();
            if lambda.re.abs() > slope * STILL {
                return Ok(f64::INFINITY);
            }
            let full = solver.nearest(&p, lambda.im)?;
            let of_full = full.iter().map(|found| found.lambda).min_by(|a, b| {
                let distance = |other: &c64| (other - lambda).norm();
                distance(a).total_cmp(&distance(b))
            });
            let off = of_full.map_or(f64::INFINITY, |found| (found - lambda).norm() / slope);
            // NaN is no distance either.
            largest = if off >= 0.0 { largest.max(off) } else { f64::INFINITY };
        }
        Ok(largest)
    }
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
    use super::super::compare::compare_windows;
    use super::super::full_order::tests::{point, touching};
    use super::*;
    use crate::physics::ContactLaw;

    const JUDGED: Judged = Judged { band_rad_s: 1000.0, instability_threshold: 1e-6, decay_per_s: 20.0 };

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

    /// Where growth rates cross zero, the full model's roots say how far the ends of the windows of a projection
    /// are from those of a dense model of all degrees of freedom: nothing for a good basis, and no less than it is
    /// for a poor one. Ends at which roots merge have no such distance.
    #[test]
    fn roots_of_the_full_model_tell_how_far_ends_are_off() {
        let band = 700.0;
        let options = MapOptions {
            mu_min: 0.0,
            mu_max: 1.0,
            band_max_hz: Some(band / std::f64::consts::TAU),
            instability_threshold: 1e-6,
            windows: true,
        };
        let mut measured = vec![];
        for (damping, samples, share) in
            [(0.3, &[0.0, 0.5, 1.0][..], 1.0), (0.3, &[0.3], 0.3), (0.0, &[0.0, 0.5, 1.0], 1.0)]
        {
            let model = touching(24, damping, ContactLaw::default());
            let n = model.dimension();
            let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
            let mut basis = Basis { columns: Mat::zeros(n, 0) };
            for &mu in samples {
                basis.add(&solver.roots(&point(mu), share * band, FullVectors::Both, &mut |_| {}).unwrap());
            }
            let projection = Projection::new(&model, basis.columns.as_ref(), &point(0.0)).unwrap();
            let map = |model: &Model| {
                StabilityMap::build(model, &mut Solver::new(model.dimension()), &point(0.0), &options).unwrap().windows
            };
            let windows = map(&projection.model);
            let mut dense = Solver::new(projection.model.dimension());
            let off = projection.off(&mut solver, &mut dense, &windows).unwrap();
            let whole = model.project(Mat::<f64>::identity(n, n).as_ref()).unwrap().model(model.contact_law).unwrap();
            let compared = compare_windows(&map(&whole), &windows);
            assert!(!compared.pairs.is_empty() && compared.missed.is_empty(), "{compared:?}");
            measured.push((off, compared.friction_error(1.0)));
        }
        let [(good, good_error), (poor, poor_error), (merging, _)] = measured[..] else { unreachable!() };
        assert!(good < STILL && good_error < 2.0 * STILL, "{measured:?}");
        assert!(poor_error > 100.0 * STILL && poor > 0.5 * poor_error, "{measured:?}");
        assert_eq!(merging, f64::INFINITY);
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
}
