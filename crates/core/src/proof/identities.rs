//! Compares the identities of charted modes with those of solved ones.

use crate::physics::chart::build::ChartOptions;
use crate::physics::chart::{Chart, Scratch};
use crate::physics::numbering::{gaps, value};
use crate::physics::{MapError, MapOptions, Mode, Model, Solver, StabilityMap, Summary, Traces, Vectors};
use crate::proof::held_out::draw;
use crate::proof::synthetic::Uniform;

/// Result of comparing the identities of charted and solved modes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Agreement {
    /// Number of points at which the chart gave roots.
    pub charted: usize,
    /// Number of points at which it did not.
    pub solved: usize,
    /// Number of modes compared.
    pub modes: usize,
    /// Number of charted modes whose identity disagrees: no solved mode of the same identity lies within the error
    /// bounds of both. A difference in the number of modes counts too.
    pub different: usize,
    /// Number of solved modes with another identity by shape. Modes closer than 1e-3, relative, to another are left
    /// out.
    pub by_shape: usize,
}

/// Compares the identities of charted and solved modes at random points of the box of `charted`: at `each` friction
/// coefficients for each of `places` pairs of load and speed, which have a map of their own.
///
/// # Errors
/// [`MapError`] if a solve fails.
pub fn compare(
    model: &Model,
    mapped: &MapOptions,
    charted: &ChartOptions,
    chart: &Chart,
    [places, each]: [usize; 2],
    seed: u64,
) -> Result<Agreement, MapError> {
    let (traces, mut solver, mut scratch) = (Traces::new(model), Solver::new(model.dimension()), Scratch::default());
    let (mut uniform, mut roots, mut found) = (Uniform::new(seed), vec![], Agreement::default());
    let (mut on_chart, mut dense) = (Summary::default(), Summary::default());
    let (band, threshold) = (mapped.band_max_hz, mapped.instability_threshold);
    for _ in 0..places {
        let at = draw(charted, &mut uniform);
        let map = StabilityMap::build(model, &mut solver, &at, mapped)?;
        for _ in 0..each {
            let p = at.with_friction(draw(charted, &mut uniform).friction_coefficient);
            roots.clear();
            let Ok(all) = chart.evaluate(&p, traces.at(model, &p), &mut scratch, &mut roots) else {
                found.solved += 1;
                continue;
            };
            let mu = p.friction_coefficient;
            let spectrum = solver.solve(model, &p, Vectors::Both).map_err(|source| MapError::Solve { mu, source })?;
            on_chart.take_chart(&roots, mu, all, Some(&map), band, threshold);
            dense.take_spectrum(&spectrum, Some(&map), band, threshold);
            found.charted += 1;
            found.modes += dense.modes.len();
            found.different += dense.modes.len().abs_diff(on_chart.modes.len());
            for mode in &on_chart.modes {
                let same = dense.modes.iter().find(|other| other.id == mode.id);
                let agrees = |other: &Mode| {
                    let limit = mode.root.error.square + other.root.error.square;
                    (mode.root.square - other.root.square).norm() <= limit
                };
                found.different += usize::from(!same.is_some_and(agrees));
            }
            let (by_shape, ids) = (map.identify(&spectrum), map.ids(&spectrum));
            let gaps = gaps(&spectrum);
            let distinct = |k: &usize| gaps[*k] > 1e-3 * value(&spectrum, *k).norm();
            found.by_shape += (0..dense.modes.len()).filter(distinct).filter(|&k| by_shape[k] != ids[k]).count();
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::chart::build::build;
    use crate::physics::{ContactLaw, OperatingPoint};
    use crate::proof::synthetic::{Synthetic, rig};

    /// Rigs without damping, with load-dependent contact stiffness, and with damping. Whatever the box of the chart,
    /// a charted mode has the identity of the solved one, and nearly always the identity found by shape.
    #[test]
    fn charted_modes_have_the_identities_of_solved_ones() {
        let mapped = MapOptions {
            mu_min: 0.0,
            mu_max: 1.0,
            band_max_hz: Some(5e3),
            instability_threshold: 1e-6,
            windows: false,
        };
        let mut all = Agreement::default();
        for seed in 0..9 {
            let kind = seed as usize % 3;
            let contact_law = ContactLaw { exponent: [0.0, 0.3, 0.3][kind], ..Default::default() };
            let damping_ratio = [0.0, 0.0, 2e-3][kind];
            let model = rig(&Synthetic { modes: 14, pairs: 24, damping_ratio, contact_law, seed }).unwrap();
            let point = |friction_coefficient: f64, normal_load_n: f64, disc_speed_rad_s: f64| OperatingPoint {
                normal_load_n,
                disc_speed_rad_s,
                friction_coefficient,
            };
            let charted = ChartOptions {
                low: point(0.07 * kind as f64, 400.0, 10.0),
                high: point(1.0, [401.0, 700.0, 450.0][kind], [11.0, 11.0, 12.0][kind]),
                band_max_hz: Some(5e3),
                tolerance: 1e-8,
                smallest_share: 1e-3,
                max_solves: 3000,
                threads: 1,
            };
            let chart = build(&model, &charted, &|_| true).unwrap();
            let places = [1, 5, 5][kind];
            let found = compare(&model, &mapped, &charted, &chart, [places, 200 / places], seed).unwrap();
            assert_eq!(found.different, 0, "seed {seed}: {found:?}");
            assert!(found.charted > 150, "seed {seed}: {found:?}");
            all.modes += found.modes;
            all.by_shape += found.by_shape;
        }
        assert!(all.modes > 10_000 && 500 * all.by_shape < all.modes, "{all:?}");
    }
}
