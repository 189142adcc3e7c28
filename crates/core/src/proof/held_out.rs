//! Compares charts with dense solves at held-out points.

use faer::c64;

use crate::physics::chart::build::ChartOptions;
use crate::physics::chart::pairing::{partners, within};
use crate::physics::chart::{Chart, MERGING, NotCharted, Scratch};
use crate::physics::tracking::tracked;
use crate::physics::{Model, OperatingPoint, Root, SolveError, Solver, Spectrum, Traces, Vectors};
use crate::proof::synthetic::Uniform;

/// Result of a comparison.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HoldOut {
    /// Number of points at which the chart gave roots.
    pub charted: usize,
    /// Number of points without a leaf.
    pub not_converged: usize,
    /// Number of points at which the charted roots violate the traces.
    pub incomplete: usize,
    /// Number of charted roots that differ from their dense root by more than the bounds of both.
    pub violations: usize,
    /// The largest difference from a dense root, divided by the sum of both bounds.
    pub largest_share: f64,
    /// Largest relative error of `λ²` away from merging points, where the nearest root is at least `MERGING` away,
    /// relative.
    pub largest_error: f64,
    /// The 99th percentile of these errors.
    pub p99_error: f64,
    /// Largest relative error of the mean `λ²` of two merging roots.
    pub largest_mean_error: f64,
    /// Largest error bound relative to `|λ²|`, away from merging points.
    pub largest_bound: f64,
}

/// A random operating point of the box, uniformly distributed in each condition.
pub(crate) fn draw(options: &ChartOptions, uniform: &mut Uniform) -> OperatingPoint {
    let mut between = |low: f64, high: f64| low + 0.5 * (uniform.draw() + 1.0) * (high - low);
    let ChartOptions { low, high, .. } = options;
    OperatingPoint {
        friction_coefficient: between(low.friction_coefficient, high.friction_coefficient),
        normal_load_n: between(low.normal_load_n, high.normal_load_n),
        disc_speed_rad_s: between(low.disc_speed_rad_s, high.disc_speed_rad_s),
    }
}

/// Compares `chart` with dense solves at `conditions` random operating points of the box of `options`.
///
/// # Errors
/// [`SolveError`] if a dense solve fails.
pub fn hold_out(
    model: &Model,
    options: &ChartOptions,
    chart: &Chart,
    conditions: usize,
    seed: u64,
) -> Result<HoldOut, SolveError> {
    let traces = Traces::new(model);
    let mut solver = Solver::new(model.dimension());
    let (mut scratch, mut modes) = (Scratch::default(), vec![]);
    let mut uniform = Uniform::new(seed);
    let mut found = HoldOut::default();
    let mut errors = vec![];
    for _ in 0..conditions {
        let p = draw(options, &mut uniform);
        modes.clear();
        match chart.evaluate(&p, traces.at(model, &p), &mut scratch, &mut modes) {
            Err(NotCharted::NotConverged | NotCharted::Outside) => found.not_converged += 1,
            Err(NotCharted::Incomplete { .. }) => found.incomplete += 1,
            Ok(_) => {
                found.charted += 1;
                found.compare(&modes, &solver.solve(model, &p, Vectors::Both)?, &mut errors);
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    found.largest_error = errors.last().copied().unwrap_or(0.0);
    found.p99_error = errors.get(errors.len() * 99 / 100).copied().unwrap_or(0.0);
    Ok(found)
}

impl HoldOut {
    fn compare(&mut self, modes: &[Root], spectrum: &Spectrum, errors: &mut Vec<f64>) {
        let dense: Vec<c64> = spectrum.roots[..tracked(spectrum)].iter().map(|root| root.square).collect();
        let partners = partners(modes, spectrum);
        let mut charted: Vec<Option<c64>> = vec![None; dense.len()];
        for (mode, partner) in modes.iter().zip(&partners) {
            let Some((k, share)) = *partner else {
                self.violations += 1;
                continue;
            };
            charted[k] = Some(mode.square);
            self.violations += usize::from(!within(share));
            self.largest_share = self.largest_share.max(share);
        }
        for (mode, partner) in modes.iter().zip(&partners) {
            let Some((k, _)) = *partner else { continue };
            let (root, size) = (dense[k], dense[k].norm());
            let gap = |&j: &usize| (dense[j] - root).norm();
            let nearest = (0..dense.len()).filter(|&j| j != k).min_by(|a, b| gap(a).total_cmp(&gap(b)));
            match nearest.filter(|j| gap(j) < MERGING * size) {
                None => {
                    errors.push((mode.square - root).norm() / size);
                    self.largest_bound = self.largest_bound.max(mode.error.square / size);
                }
                Some(j) => {
                    if let Some(other) = charted[j] {
                        let off = 0.5 * (mode.square + other - root - dense[j]).norm() / size;
                        self.largest_mean_error = self.largest_mean_error.max(off);
                    }
                }
            }
        }
    }
}
