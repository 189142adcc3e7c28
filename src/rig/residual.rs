//! Residual flexibility and inertia between contact pairs, and the frequencies up to which they are valid.
//!
//! ```text
//! R_nn = Σ_sides W_n R W_nᵀ,   R_nt = Σ_sides W_n R W_tᵀ,   Q likewise;   W_d = [d] of the pad, T [d] of the disc
//! ```
//!
//! `W` is built from the same triads and the same interpolation as the displacement rows `B` of the contact.
//!
//! The *cut-off* of a side is its highest kept frequency; that of the rig is the lower of the two. Residual flexibility
//! and inertia are the first two terms of a series in `(ω/ω_cut-off)²` for the truncated modes. The inertial term is
//! used for bands of at most half the cut-off, because closer to it critical friction coefficients would be wrong. No
//! mode above the cut-off is shown.

use faer::Mat;

use super::RigError;
use super::patch::{self, Pair};
use super::raw::RawPatch;
use crate::physics::ResidualFlexibility;

/// The inertial term is used for bands up to this fraction of the cut-off.
const INERTIA_BELOW: f64 = 0.5;

/// Residual flexibility between pairs, and the band it is used in.
pub(super) struct PairResidual {
    pub flexibility: ResidualFlexibility,
    /// `[band] max_hz`, at most the cut-off; the cut-off if not given.
    pub band_max_hz: f64,
    /// A line for [`super::Rig::describe`].
    pub description: String,
}

/// Residual flexibility and inertia of one side, between x, y and z of its nodes.
#[derive(Clone, Copy, Debug)]
pub struct SideResidual<'a> {
    /// Whether this side is the disc.
    pub disc: bool,
    /// `R`, `3c×3c`, m/N.
    pub flexibility: &'a Mat<f64>,
    /// `Q`, `3c×3c`, s²·m/N.
    pub inertia: Option<&'a Mat<f64>>,
}

/// The residual flexibility of `sides` between `pairs`. The inertial term is included if every side has it.
pub(super) fn between(pairs: &[Pair], sides: &[SideResidual<'_>]) -> ResidualFlexibility {
    let c = pairs.len();
    let (mut normal, mut sliding) = (Mat::zeros(c, c), Mat::zeros(c, c));
    let with_inertia = sides.iter().all(|side| side.inertia.is_some());
    let mut inertia = with_inertia.then(|| [Mat::zeros(c, c), Mat::zeros(c, c)]);
    for side in sides {
        let along = |direction: &dyn Fn(&Pair) -> [f64; 3]| weights(pairs, side.disc, direction);
        let (n, t) = (along(&|pair| pair.normal), along(&|pair| pair.sliding));
        let entry = |matrix: &Mat<f64>, left: &[(usize, f64)], right: &[(usize, f64)]| -> f64 {
            let row = |i: usize| right.iter().map(|&(j, weight)| weight * matrix[(i, j)]).sum::<f64>();
            left.iter().map(|&(i, weight)| weight * row(i)).sum()
        };
        let seen = |matrix: &Mat<f64>| {
            // Exactly symmetric by construction, because the solver tests for symmetry.
            let nn = Mat::from_fn(c, c, |i, j| entry(matrix, &n[i.max(j)], &n[i.min(j)]));
            (nn, Mat::from_fn(c, c, |i, j| entry(matrix, &n[i], &t[j])))
        };
        let (nn, nt) = seen(side.flexibility);
        normal += nn;
        sliding += nt;
        if let (Some([inertia_n, inertia_t]), Some(matrix)) = (&mut inertia, side.inertia) {
            let (nn, nt) = seen(matrix);
            *inertia_n += nn;
            *inertia_t += nt;
        }
    }
    ResidualFlexibility { normal, sliding, inertia }
}

/// The residual flexibility of pad and disc between the contact pairs of `patches`, the `[[contact_patch]]` tables of
/// the rig file `file`. `nodes_m` are the interface nodes of each side, m.
///
/// # Errors
/// [`RigError`] if the patches are invalid.
pub fn between_patches(
    file: &str,
    patches: &toml::Value,
    nodes_m: [&[[f64; 3]]; 2],
    sides: &[SideResidual<'_>],
) -> Result<ResidualFlexibility, RigError> {
    let patches: Vec<RawPatch> = patches.clone().try_into().map_err(|error: toml::de::Error| RigError::Kind {
        file: file.to_owned(),
        field: "contact_patch".to_owned(),
        value: format!("cannot be read: {}", error.message()),
        limit: "contact patches".to_owned(),
    })?;
    Ok(between(&patch::contacts(file, &patches, nodes_m[0], Some(nodes_m[1]))?.pairs, sides))
}

/// Restricts `flexibility` to the band it is valid in: clamps `[band] max_hz` to the cut-off and drops the inertial
/// term if the band exceeds half of it, or beside a contact state, which has none. `of` names the modes in the
/// description.
pub(super) fn within_band(
    flexibility: ResidualFlexibility,
    of: &str,
    cutoff_hz: f64,
    band_max_hz: Option<f64>,
    contact_state: bool,
) -> PairResidual {
    let asked_hz = band_max_hz.unwrap_or(cutoff_hz);
    let has_inertia = flexibility.inertia.is_some();
    let inertia = flexibility.inertia.filter(|_| !contact_state && asked_hz <= INERTIA_BELOW * cutoff_hz);
    let inertial = match (inertia.is_some(), has_inertia) {
        (false, true) if contact_state => "without the inertial term, which a contact state does not use".to_owned(),
        (true, _) => "with the inertial term".to_owned(),
        (false, true) => format!("without the inertial term (the band is above {INERTIA_BELOW} of the cut-off)"),
        (false, false) => "no inertial term given".to_owned(),
    };
    let clamped =
        if asked_hz > cutoff_hz { format!(", to which the band of {asked_hz} Hz is cut") } else { String::new() };
    PairResidual {
        flexibility: ResidualFlexibility { inertia, ..flexibility },
        band_max_hz: asked_hz.min(cutoff_hz),
        description: format!("residual   of {of}, {inertial}; cut-off {cutoff_hz:.1} Hz{clamped}"),
    }
}

/// The rows of `W`, `c×3c'` for `c'` nodes of the side, sparse: weights of the nodal displacements in the displacement
/// of each pair along `direction`.
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
