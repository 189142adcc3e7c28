//! Coverage of a frequency band by discs around shifts, consistency of overlapping discs, and assembly of the spectrum.

use faer::{Mat, MatRef, c64};

use super::ReductionError;
use super::full_root::{CoveredDisc, FullRoot, FullSpectrum};
use crate::physics::Situation;

/// Largest distance, relative to `|λ|`, of two computed values of the same root: ten times the square root of the
/// residual limit of an eigenpair, because merging roots are only that accurate.
pub(super) const SAME: f64 = 1e-5;

/// Roots and vectors found around one shift.
pub(super) struct Found {
    pub disc: CoveredDisc,
    pub roots: Vec<FullRoot>,
    pub right: Mat<c64>,
    pub left: Mat<c64>,
}

/// Lowest uncovered stretch of the band, rad/s; `found` is in ascending order of shifts.
pub(super) fn first_gap(found: &[Found], band_rad_s: f64) -> Option<[f64; 2]> {
    let mut covered = 0.0;
    for [low, high] in found.iter().map(|found| found.disc.stretch_rad_s()) {
        if low > covered {
            return Some([covered, low.min(band_rad_s)]);
        }
        covered = high.max(covered);
        if covered >= band_rad_s {
            return None;
        }
    }
    (covered < band_rad_s).then_some([covered, band_rad_s])
}

/// Checks that every root inside two neighbouring discs was found around both shifts.
///
/// # Errors
/// [`ReductionError::MissedRoot`].
pub(super) fn agree(what: &str, found: &[Found]) -> Result<(), ReductionError> {
    for (a, b) in found.iter().zip(found.iter().skip(1)).flat_map(|(a, b)| [(a, b), (b, a)]) {
        let mut free: Vec<c64> = b.roots.iter().map(|root| root.lambda).collect();
        for root in a.roots.iter().filter(|root| a.disc.holds(root.lambda) && b.disc.holds(root.lambda)) {
            let near = |lambda: &c64| (*lambda - root.lambda).norm() <= SAME * root.lambda.norm();
            match free.iter().position(near) {
                Some(index) => {
                    free.swap_remove(index);
                }
                None => {
                    return Err(ReductionError::MissedRoot {
                        what: what.to_owned(),
                        growth_per_s: root.lambda.re,
                        omega_rad_s: root.lambda.im,
                        found: a.disc.shift_rad_s,
                        missed: b.disc.shift_rad_s,
                    });
                }
            }
        }
    }
    Ok(())
}

/// Joins the discs into one spectrum. Neighbouring discs are separated at a frequency, and every root is taken from the
/// disc on its side.
pub(super) fn assemble(here: Situation, found: &[Found], band_rad_s: f64) -> FullSpectrum {
    let mut chosen: Vec<(FullRoot, usize, usize)> = vec![];
    let (mut from, mut half_width) = (0.0, f64::INFINITY);
    for (index, part) in found.iter().enumerate() {
        let [_, high] = part.disc.stretch_rad_s();
        let to: f64 = match found.get(index + 1) {
            // The middle of the overlap.
            Some(next) => {
                let [low, _] = next.disc.stretch_rad_s();
                (0.5 * (high.min(next.disc.shift_rad_s) + low.max(part.disc.shift_rad_s))).max(from).min(band_rad_s)
            }
            None => band_rad_s,
        };
        let last = index + 1 == found.len();
        for (k, root) in part.roots.iter().enumerate() {
            let omega = root.lambda.im;
            if omega < from || omega > to || (omega == to && !last) {
                continue;
            }
            // A root at the separating frequency may have been taken from the disc below already.
            let again = |other: &(FullRoot, usize, usize)| {
                other.1 != index && (other.0.lambda - root.lambda).norm() <= SAME * root.lambda.norm()
            };
            if (omega - from).abs() > SAME * from || !chosen.iter().any(again) {
                chosen.push((*root, index, k));
            }
        }
        half_width = half_width.min(part.disc.growth_per_s(from)).min(part.disc.growth_per_s(to));
        from = to;
    }
    chosen.sort_by(|a, b| a.0.lambda.im.total_cmp(&b.0.lambda.im).then(a.0.lambda.re.total_cmp(&b.0.lambda.re)));
    let n = found.first().map_or(0, |found| found.right.nrows());
    let gather = |of: &dyn Fn(&Found) -> MatRef<'_, c64>| {
        let there = found.iter().all(|found| of(found).ncols() == found.roots.len());
        let mut gathered = Mat::<c64>::zeros(n, if there { chosen.len() } else { 0 });
        for column in 0..gathered.ncols() {
            let (_, part, k) = chosen[column];
            for i in 0..n {
                gathered[(i, column)] = of(&found[part])[(i, k)];
            }
        }
        gathered
    };
    FullSpectrum {
        here,
        right: gather(&|found| found.right.as_ref()),
        left: gather(&|found| found.left.as_ref()),
        roots: chosen.iter().map(|(root, ..)| *root).collect(),
        discs: found.iter().map(|found| found.disc).collect(),
        covered_growth_per_s: half_width,
    }
}
