//! What the modes left out do between contact pairs, and how far up in frequency it may be trusted.
//!
//! ```text
//! R_nn = Σ_sides W_n R W_nᵀ,   R_nt = Σ_sides W_n R W_tᵀ,   Q alike;   W_d = [d] of the pad, T [d] of the disc
//! ```
//!
//! `W` is what `B` is made of, so that both use the same triads and the same interpolation. Modes are left out above the
//! *cut-off*: of each side its highest frequency kept, the lower of the two for the rig. The residual stands for them by
//! the first two terms of a series in `(ω/ω_cut-off)²`: the inertial term is used for bands of at most half the cut-off,
//! near which it would spoil critical friction coefficients, and no mode above the cut-off is shown.

use faer::Mat;

use super::modal_data::Residual;
use super::patch::Pair;
use crate::physics::ResidualFlexibility;

/// The largest band, relative to the cut-off, for which the inertial term is used.
const INERTIA_BELOW: f64 = 0.5;

/// The residuals of both sides, what they are used for, and up to where.
pub(super) struct PairResidual {
    pub flexibility: ResidualFlexibility,
    /// `[band] max_hz`, or the lower cut-off where the former is not given or higher.
    pub band_max_hz: f64,
    /// A line for [`super::Rig::describe`].
    pub told: String,
}

/// One side: its name, its residual if it came with one, and its cut-off in Hz.
pub(super) struct SideResidual {
    pub name: &'static str,
    pub residual: Option<Residual>,
    pub cutoff_hz: f64,
}

/// Residuals between `pairs`; `None` where neither side has any.
pub(super) fn between(
    pairs: &[Pair],
    pad: &SideResidual,
    disc: Option<&SideResidual>,
    band_max_hz: Option<f64>,
) -> Option<PairResidual> {
    let sides: Vec<&SideResidual> = std::iter::once(pad).chain(disc).collect();
    let known: Vec<&SideResidual> = sides.iter().copied().filter(|side| side.residual.is_some()).collect();
    if known.is_empty() {
        return None;
    }
    let cutoff_hz = sides.iter().map(|side| side.cutoff_hz).fold(f64::INFINITY, f64::min);
    let asked_hz = band_max_hz.unwrap_or(cutoff_hz);
    let has_inertia =
        known.iter().all(|side| side.residual.as_ref().is_some_and(|residual| residual.inertia.is_some()));
    let with_inertia = has_inertia && asked_hz <= INERTIA_BELOW * cutoff_hz;
    let c = pairs.len();
    let (mut normal, mut sliding) = (Mat::zeros(c, c), Mat::zeros(c, c));
    let mut inertia = with_inertia.then(|| [Mat::zeros(c, c), Mat::zeros(c, c)]);
    for (index, side) in sides.iter().enumerate() {
        let Some(residual) = &side.residual else { continue };
        let along = |direction: &dyn Fn(&Pair) -> [f64; 3]| weights(pairs, index == 1, direction);
        let (n, t) = (along(&|pair| pair.normal), along(&|pair| pair.sliding));
        let entry = |matrix: &Mat<f64>, left: &[(usize, f64)], right: &[(usize, f64)]| -> f64 {
            let row = |i: usize| right.iter().map(|&(j, weight)| weight * matrix[(i, j)]).sum::<f64>();
            left.iter().map(|&(i, weight)| weight * row(i)).sum()
        };
        let seen = |matrix: &Mat<f64>| {
            // Symmetric by construction: the solver looks for it.
            let nn = Mat::from_fn(c, c, |i, j| entry(matrix, &n[i.max(j)], &n[i.min(j)]));
            (nn, Mat::from_fn(c, c, |i, j| entry(matrix, &n[i], &t[j])))
        };
        let (nn, nt) = seen(&residual.flexibility);
        normal += nn;
        sliding += nt;
        if let (Some([inertia_n, inertia_t]), Some(matrix)) = (&mut inertia, &residual.inertia) {
            let (nn, nt) = seen(matrix);
            *inertia_n += nn;
            *inertia_t += nt;
        }
    }
    let names: Vec<&str> = known.iter().map(|side| side.name).collect();
    let inertial = match (with_inertia, has_inertia) {
        (true, _) => "with the inertial term".to_owned(),
        (false, true) => format!("without the inertial term (the band is above {INERTIA_BELOW} of the cut-off)"),
        (false, false) => "no inertial term given".to_owned(),
    };
    let clamped =
        if asked_hz > cutoff_hz { format!(", to which the band of {asked_hz} Hz is cut") } else { String::new() };
    let told = format!("residual   of {}, {inertial}; cut-off {cutoff_hz:.1} Hz{clamped}", names.join(" and "));
    let flexibility = ResidualFlexibility { normal, sliding, inertia };
    Some(PairResidual { flexibility, band_max_hz: asked_hz.min(cutoff_hz), told })
}

/// The rows of `W`, `c×3c'`: what a direction of every pair sees of the displacements of a side's nodes.
fn weights(pairs: &[Pair], disc: bool, direction: &dyn Fn(&Pair) -> [f64; 3]) -> Vec<Vec<(usize, f64)>> {
    pairs
        .iter()
        .map(|pair| {
            let along = direction(pair);
            let pad = [(pair.pad_node, 1.0)];
            let nodes: &[(usize, f64)] = if disc { &pair.disc } else { &pad };
            let of_node =
                |&(node, weight): &(usize, f64)| [0, 1, 2].map(|axis| (3 * node + axis, weight * along[axis]));
            nodes.iter().flat_map(of_node).filter(|(_, weight)| *weight != 0.0).collect()
        })
        .collect()
}
