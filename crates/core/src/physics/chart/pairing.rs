//! Pairing of charted roots with those of a dense solve.

use crate::physics::solver::ROUNDING;
use crate::physics::spectrum::{Root, Spectrum};
use crate::physics::tracking::tracked;

/// For each charted root, the nearest dense root and the difference as a fraction of the sum of both bounds. Each
/// dense root is used once; `None` if none is left.
pub(crate) fn partners(modes: &[Root], spectrum: &Spectrum) -> Vec<Option<(usize, f64)>> {
    let rounding = ROUNDING * f64::EPSILON * spectrum.matrix_norm;
    let mut left: Vec<usize> = (0..tracked(spectrum)).collect();
    let partner = |root: &Root| {
        let off = |k: usize| (spectrum.roots[k].square - root.square).norm();
        let at = (0..left.len()).min_by(|&a, &b| off(left[a]).total_cmp(&off(left[b])))?;
        let nearest = left.swap_remove(at);
        let dense = spectrum.roots[nearest].error.square;
        let slack = if spectrum.undamped { rounding } else { 2.0 * root.lambda.norm() * rounding };
        let limit = root.error.square + if dense.is_finite() { dense } else { slack };
        Some((nearest, if off(nearest) == 0.0 { 0.0 } else { off(nearest) / limit }))
    };
    modes.iter().map(partner).collect()
}

/// Whether an error is within its bound, given as a fraction of it; false for NaN.
pub(crate) fn within(share: f64) -> bool {
    share <= 1.0
}

/// Whether every charted root has a dense root within the bounds of both, each dense root used once.
pub(crate) fn within_bounds(modes: &[Root], spectrum: &Spectrum) -> bool {
    partners(modes, spectrum).iter().all(|partner| partner.is_some_and(|(_, share)| within(share)))
}
