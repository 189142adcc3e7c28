//! `[contact_state]` of rigs reduced from a full model: its law, with the load and the statics in the coordinates of the rig.

use faer::Mat;
use sha2::{Digest, Sha256};

use super::error::ExportError;
use super::rig::{HASH_DIGITS, by_rows, lower_triangle, packed, rig_name};
use crate::contact::{RigidMotions, StaticResponse, Statics};
use crate::full_model::FullModelFile;
use crate::reduction::{Kept, SparseRow};
use crate::rig::RigFile;
use crate::text::hex::hex;

/// The table `[contact_state]` of a rig, and the files it names.
#[derive(Clone, Debug)]
pub struct StateOfRig {
    /// The table.
    pub table: toml::Table,
    /// The files.
    pub files: Vec<RigFile>,
}

/// `[contact_state]` of a rig of the modes `kept` of pad and disc: the load on the modes of the pad and, if the rig has
/// residual flexibility, what the truncated modes add to the response of the gaps. `None` if the pairs of `full` are always
/// closed.
pub fn state_on_modes(full: &FullModelFile, kept: &[Kept]) -> Option<StateOfRig> {
    let (state, steady) = (full.state.as_ref()?, full.model.contact.as_ref()?.steady.as_ref()?);
    let (mut table, file) = state.for_rig();
    let modes = &kept.first()?.modes;
    let along = |row: &SparseRow, mode: usize| -> f64 {
        // The pad is the first part: its rows are the first of all.
        let of_pad = row.iter().filter(|(index, _)| *index < modes.phi.nrows());
        of_pad.map(|&(index, weight)| weight * modes.phi[(index, mode)]).sum()
    };
    let count = modes.omega_squared.len();
    let load: Vec<f64> = (0..count).map(|mode| along(&steady.load, mode)).collect();
    if kept.iter().any(|kept| kept.residual.is_some()) {
        let response = &steady.statics.parts().response;
        let rigid = rigid_modes(&modes.omega_squared, &response.rigid);
        let residual = |(pair, whole): (usize, &f64)| {
            let row = &full.model.contact.as_ref().map_or(&[][..], |contact| &contact.normal)[pair];
            let of_mode = |mode: usize| along(row, mode) * load[mode] / modes.omega_squared[mode];
            whole - (rigid..count).map(of_mode).sum::<f64>()
        };
        let gaps: Vec<f64> = response.gap_per_load.iter().enumerate().map(residual).collect();
        table.insert("residual_gap_m_per_n".to_owned(), gaps.into());
    }
    table.insert("load_coordinates".to_owned(), load.into());
    Some(StateOfRig { table, files: file.into_iter().collect() })
}

/// Number of modes of the pad that are rigid motions: at most `rigid` in all, all far below the others.
fn rigid_modes(omega_squared: &[f64], rigid: &RigidMotions) -> usize {
    let largest = omega_squared.last().copied().unwrap_or(0.0);
    let low = omega_squared.iter().take(rigid.load.len()).take_while(|square| **square <= RIGID * largest);
    low.count()
}

/// `ω²` up to this share of the largest one belong to rigid motions.
const RIGID: f64 = 1e-9;

/// `[contact_state]` of a rig on a shared basis, called `file`: its statics are those of the full model. `None` if the pairs
/// of `full` are always closed.
///
/// # Errors
/// [`ExportError::Bytes`].
pub fn state_on_basis(file: &str, full: &FullModelFile) -> Result<Option<StateOfRig>, ExportError> {
    let (Some(state), Some(statics)) = (&full.state, full.model.statics()) else { return Ok(None) };
    let (mut table, pressures) = state.for_rig();
    let bytes = archive(statics)
        .map_err(|source| ExportError::Bytes { what: "archive of the static response".to_owned(), source })?;
    let hash = hex(&Sha256::digest(&bytes));
    let name = format!("{}-statics-{}.npz", rig_name(file), &hash[..HASH_DIGITS]);
    table.insert("statics".to_owned(), name.as_str().into());
    let files = std::iter::once(RigFile { name, bytes }).chain(pressures).collect();
    Ok(Some(StateOfRig { table, files }))
}

/// The static response between the contact pairs as an archive that a rig on a shared basis reads.
fn archive(statics: &Statics) -> std::io::Result<Vec<u8>> {
    let StaticResponse { normal_flexibility, sliding_flexibility, gap_per_load, rigid } = &statics.parts().response;
    let (c, r) = (gap_per_load.len(), rigid.load.len());
    let mut arrays = vec![
        ("flexibility_normal", vec![c * (c + 1) / 2], lower_triangle(normal_flexibility)),
        ("flexibility_sliding", vec![c, c], by_rows(sliding_flexibility)),
        ("gap_per_load", vec![c], gap_per_load.clone()),
    ];
    if r > 0 {
        let motions = |rows: &Mat<f64>| (vec![c, r], by_rows(rows));
        let [(shape, normal), (_, sliding)] = [&rigid.normal, &rigid.sliding].map(motions);
        arrays.push(("rigid_normal", shape.clone(), normal));
        arrays.push(("rigid_sliding", shape, sliding));
        arrays.push(("rigid_load", vec![r], rigid.load.clone()));
    }
    packed(&arrays)
}
