//! Windows of instability of a full model.
//!
//! They are computed from a projection of it. The basis consists of right and left vectors at a few friction
//! coefficients. Where a growth rate crosses zero, the ends are then moved to where the full model's root there crosses
//! it. Otherwise vectors at window ends are added, a few at a time, until all ends stay fixed. Window ends thus have full
//! accuracy, although `λ` itself has only half the digits near a merging point. Finally the projection is checked
//! against the full model at friction coefficients between the samples, because a mode absent from every sample would
//! otherwise go unnoticed.

use faer::{MatRef, c64};

use super::ReductionError;
use super::compare::{CompareError, Judged, compare_roots, reduced_roots};
use super::full_model::FullModel;
use super::full_order::FullSolver;
use super::full_root::{FullProgress, FullSpectrum, FullVectors};
use super::parametric::{Metric, Span};
use crate::physics::{MapOptions, Model, OperatingPoint, Solver, StabilityMap, Vectors, Window};
use crate::sampling::radical_inverse;

/// Components outside the basis below which a vector is not added, see [`Span::add`], where ends are moved to those of the
/// full model: half the square root of [`CHECKED`].
const NEW: f64 = 5e-4;
/// The same where ends must stay fixed: the square of it is far below [`STILL`].
const NEW_AT_ENDS: f64 = 1e-5;
/// Damping ratio above which a root is assumed unable to become unstable; its vectors are not added.
const DAMPED: f64 = 0.05;
/// Change of the friction coefficient of a window end below which it is converged.
const STILL: f64 = 1e-8;
/// Number of window ends at which vectors are added per round.
const ADDED: usize = 3;
/// Largest number of Newton's steps to an end of the full model.
const MOST_STEPS: usize = 4;
/// Bound of the relative error of `dσ/dμ` of a projection whose vectors lack at most [`NEW`] and whose root is held: what
/// remains of the distance to an end after a step.
const SLOPE_ERROR: f64 = 0.1;
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
    let mut metric = Metric::new(model, model.at(&p.with_friction(0.0))?, band_rad_s);
    if !solver.has_parts() {
        metric.assemble()?;
    }
    let mut span = Span::new(model, metric);
    // Undamped roots merge at the ends.
    let mut least = if model.is_undamped() { NEW_AT_ENDS } else { NEW };
    let mut roots = 0;
    let mut sample = |solver: &mut FullSolver<'_>, mu: f64, vectors: FullVectors, span: &Span<'_>| {
        // Projecting takes the columns, products with them and the new basis.
        let column = size_of::<f64>() * model.dimension();
        let (held, added) = (span.size(), 4 * roots);
        let between = span.columns_held(added).max(3 * (held + added));
        solver.make_room(vectors, roots, column * 2 * held, column * between)?;
        let found = solver.roots(&p.with_friction(mu), 1.1 * band_rad_s, vectors, progress)?;
        roots = roots.max(found.roots.len());
        Ok::<_, ReductionError>(found)
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
            let found = sample(solver, mu, FullVectors::Both, &span)?;
            let chosen = chosen(&found);
            span.add(found, &chosen, least)?;
            sampled.push(mu);
        }
        let projected = Projection::new(model, span.vectors.as_ref(), p)?;
        let mut dense = Solver::new(projected.model.dimension());
        let map = StabilityMap::of_windows(&projected.model, &mut dense, p, options)?;
        let found: Vec<f64> = map.windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten().collect();
        let polished = projected.polished(solver, &mut dense, &map.windows)?;
        moved = if polished.is_some() {
            0.0
        } else if found.len() == ends.len() {
            found.iter().zip(&ends).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        } else {
            f64::INFINITY
        };
        least = NEW_AT_ENDS;
        next = farthest(&found, &sampled);
        ends = found;
        if moved < STILL || next.is_empty() {
            moved = 0.0;
            error = 0.0;
            let mut unheld = vec![];
            for mu in checks.by_ref().take(CHECKS) {
                let found = sample(solver, mu, FullVectors::None, &span)?;
                let of_projection = reduced_roots(&projected.model, &mut dense, &p.with_friction(mu))?;
                let off = error_of_projection(&found, &of_projection, band_rad_s);
                unheld.extend((off > limit).then_some(mu));
                error = error.max(off);
            }
            if error <= limit {
                return Ok(polished.unwrap_or(map.windows));
            }
            next.extend(unheld);
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

    /// The `windows` with the ends of the full model. `None` where no growth rate crosses zero at an end, because roots merge,
    /// are static or jump there, or where the root of the full model is farther off than [`CHECKED`].
    fn polished(
        &self,
        solver: &mut FullSolver<'_>,
        dense: &mut Solver,
        windows: &[Window],
    ) -> Result<Option<Vec<Window>>, CompareError> {
        let mut polished = windows.to_vec();
        for window in &mut polished {
            let Some((mu, hz)) = self.end(solver, dense, window.mu_from, window.frequency_hz)? else { return Ok(None) };
            (window.mu_from, window.frequency_hz) = (mu, hz);
            if let Some((mu, hz)) = window.mu_to.zip(window.frequency_to_hz) {
                let Some((mu, hz)) = self.end(solver, dense, mu, hz)? else { return Ok(None) };
                (window.mu_to, window.frequency_to_hz) = (Some(mu), Some(hz));
            }
        }
        Ok(Some(polished))
    }

    /// Friction coefficient and frequency (Hz) at which a growth rate `σ` of the full model crosses zero, by Newton's
    /// method from an end of the projection at `mu` and `frequency_hz`, with the slope `dσ/dμ` of the projection.
    fn end(
        &self,
        solver: &mut FullSolver<'_>,
        dense: &mut Solver,
        mut mu: f64,
        frequency_hz: f64,
    ) -> Result<Option<(f64, f64)>, CompareError> {
        let nearest_to = |of: c64| move |a: &c64, b: &c64| (a - of).norm().total_cmp(&(b - of).norm());
        let omega = std::f64::consts::TAU * frequency_hz;
        let spectrum = dense.solve(&self.model, &self.point.with_friction(mu), Vectors::Both)?;
        let lambdas: Vec<c64> = spectrum.roots.iter().map(|root| root.lambda).collect();
        let distance = |k: &usize| (lambdas[*k] - c64::new(0.0, omega)).norm();
        let nearest = (0..lambdas.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let Some(root) = nearest.filter(|_| omega > 0.0 && !spectrum.undamped) else { return Ok(None) };
        let lambda = lambdas[root];
        let slope = spectrum.friction_sensitivity[root] / (lambda * 2.0);
        if lambda.re.abs() > slope.re.abs() * STILL {
            return Ok(None);
        }
        for _ in 0..MOST_STEPS {
            let full = solver.nearest(&self.point.with_friction(mu), lambda.im)?;
            let found = full.into_iter().map(|found| found.lambda).min_by(nearest_to(lambda));
            let Some(found) = found.filter(|found| (found - lambda).norm() <= CHECKED * lambda.norm()) else {
                return Ok(None);
            };
            let step = -found.re / slope.re;
            mu += step;
            if SLOPE_ERROR * step.abs() < STILL {
                return Ok(Some((mu, (found.im + slope.im * step) / std::f64::consts::TAU)));
            }
        }
        Ok(None)
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

/// The roots whose vectors are added.
fn chosen(found: &FullSpectrum) -> Vec<usize> {
    (0..found.roots.len()).filter(|&k| may_grow(found.roots[k].lambda)).collect()
}

#[cfg(test)]
mod tests {
    use faer::Mat;

    use super::super::compare::compare_windows;
    use super::super::full_order::tests::{point, touching};
    use super::*;
    use crate::physics::ContactLaw;

    /// The span of vectors of all spectra `found`.
    fn span_of(model: &FullModel, band_rad_s: f64, found: Vec<FullSpectrum>, least: f64) -> Span<'_> {
        let mut span = Span::new(model, Metric::new(model, model.at(&point(0.0)).unwrap(), band_rad_s));
        for found in found {
            let chosen = chosen(&found);
            span.add(found, &chosen, least).unwrap();
        }
        span
    }

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

        // A narrow band keeps the basis far from complete.
        let judged = Judged { band_rad_s: 250.0, ..JUDGED };
        let found = solver.roots(&at(500.0, 0.45), judged.band_rad_s, FullVectors::Both, &mut |_| {}).unwrap();
        let span = span_of(&model, judged.band_rad_s, vec![found], NEW_AT_ENDS);
        assert!(span.size() < n / 3, "{} columns", span.size());
        let reduced = model.project(span.vectors.as_ref()).unwrap().model(law).unwrap();
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

    /// Where growth rates cross zero, ends of the windows of a projection are moved to those of a dense model of all degrees
    /// of freedom, from which they are farther off than is allowed. A projection that lacks modes is refused, and so are
    /// ends at which roots merge.
    #[test]
    fn ends_are_moved_to_those_of_the_full_model() {
        let band = 700.0;
        let options = MapOptions {
            mu_min: 0.0,
            mu_max: 1.0,
            band_max_hz: Some(band / std::f64::consts::TAU),
            instability_threshold: 1e-6,
            windows: true,
        };
        let mut measured = vec![];
        for (damping, samples) in [(0.3, &[0.0, 0.5, 1.0][..]), (0.3, &[0.8]), (0.0, &[0.0, 0.5, 1.0])] {
            let model = touching(24, damping, ContactLaw::default());
            let n = model.dimension();
            let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
            let mut solve = |mu: f64| solver.roots(&point(mu), band, FullVectors::Both, &mut |_| {}).unwrap();
            let found: Vec<FullSpectrum> = samples.iter().map(|&mu| solve(mu)).collect();
            let span = span_of(&model, band, found, NEW);
            let projection = Projection::new(&model, span.vectors.as_ref(), &point(0.0)).unwrap();
            let map = |model: &Model| {
                StabilityMap::build(model, &mut Solver::new(model.dimension()), &point(0.0), &options).unwrap().windows
            };
            let windows = map(&projection.model);
            let mut dense = Solver::new(projection.model.dimension());
            let polished = projection.polished(&mut solver, &mut dense, &windows).unwrap();
            let whole = model.project(Mat::<f64>::identity(n, n).as_ref()).unwrap().model(model.contact_law).unwrap();
            let off = |windows: &[Window]| {
                let compared = compare_windows(&map(&whole), windows);
                assert!(!compared.pairs.is_empty() && compared.missed.is_empty(), "{compared:?}");
                compared.friction_error(1.0)
            };
            measured.push((off(&windows), polished.map(|polished| off(&polished))));
        }
        let [(before, Some(after)), (poor, None), (_, None)] = measured[..] else { panic!("{measured:?}") };
        // Both maps refine their ends to 1e-10.
        assert!(before > STILL && after < 0.02 * STILL, "{measured:?}");
        assert!(poor > 100.0 * STILL, "{measured:?}");
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
            let found: Vec<FullSpectrum> = samples.iter().map(|&(mu, band)| solve(mu, band)).collect();
            let span = span_of(&model, band, found, NEW_AT_ENDS);
            let reduced = model.project(span.vectors.as_ref()).unwrap().model(model.contact_law).unwrap();
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
