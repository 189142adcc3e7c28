//! Kind 2: substructures by their modes at the contact interface, from any finite-element program.

use faer::Mat;

use super::inline::{Side, assemble};
use super::modal_data::ModalData;
use super::patch::{self, Pair};
use super::raw::{RawPatch, RawSubstructure};
use super::residual::{self, SideResidual};
use super::settings::{Settings, spread};
use super::source::Source;
use super::{Built, RigError, basis};
use crate::physics::ContactPairs;
use crate::reduction::Modes;

/// A substructure with the modes that were selected, ascending in frequency.
pub(super) struct Part {
    pub data: ModalData,
    pub selected: Vec<usize>,
    pub side: Side,
}

/// Builds the model of a rig of kind 2: `n = i + j` coordinates, the pad's modes first, or those that both sides share.
///
/// # Errors
/// [`RigError`].
pub(super) fn build(
    source: &mut Source<'_>,
    pad: &RawSubstructure,
    disc: Option<&RawSubstructure>,
    patches: &[RawPatch],
    shared: bool,
    settings: &Settings,
) -> Result<Built, RigError> {
    let pad = part(source, "pad", pad)?;
    let disc = disc.map(|disc| part(source, "disc", disc)).transpose()?;
    let file = source.rig_file.clone();
    let patch::Contacts { pairs, stiffness_n_per_m, damping_n_s_per_m } =
        patch::contacts(&file, patches, &pad.data.nodes_m, disc.as_ref().map(|disc| &*disc.data.nodes_m))?;
    let values = [stiffness_n_per_m, damping_n_s_per_m];
    let mut built = if shared {
        basis::build(&file, &pad, disc.as_ref(), &pairs, values, settings)?
    } else {
        apart(&file, &pad, disc.as_ref(), &pairs, values, settings)?
    };
    for (shapes, part) in built.shapes.iter_mut().zip(std::iter::once(&pad).chain(&disc)) {
        let rows = 3 * part.data.nodes_m.len();
        let entry = |row: usize, mode: usize| part.data.shape(row / 3, part.selected[mode])[row % 3];
        shapes.phi = Mat::from_fn(rows, part.selected.len(), entry);
        shapes.nodes_m.clone_from(&part.data.nodes_m);
    }
    if disc.is_some() {
        let coincident = pairs.iter().filter(|pair| pair.disc.len() == 1).count();
        let interpolated = pairs.len() - coincident;
        built.contents.push(format!(
            "interface  {coincident} pairs of coincident nodes, {interpolated} interpolated on the disc"
        ));
    }
    Ok(built)
}

/// Sides with modes of their own.
fn apart(
    file: &str,
    pad: &Part,
    disc: Option<&Part>,
    pairs: &[Pair],
    [stiffness_n_per_m, damping_n_s_per_m]: [Vec<f64>; 2],
    settings: &Settings,
) -> Result<Built, RigError> {
    let rows = |direction: &dyn Fn(&Pair) -> [f64; 3]| relative_displacement(pairs, direction, pad, disc);
    let contact = ContactPairs {
        normal: rows(&|pair| pair.normal),
        sliding: rows(&|pair| pair.sliding),
        lateral: rows(&|pair| pair.lateral),
        stiffness_n_per_m,
        damping_n_s_per_m,
        radius_m: pairs.iter().map(|pair| pair.radius_m).collect(),
    };
    let pad_residual = pad.residual("pad", file)?;
    let disc_residual = disc.map(|disc| disc.residual("disc", file)).transpose()?;
    let residual = residual::between(pairs, &pad_residual, disc_residual.as_ref(), settings.band_max_hz);
    let mut built = assemble(
        file,
        "modal substructures (kind 2)",
        &pad.side,
        disc.map(|disc| &disc.side),
        &contact,
        settings,
        residual.as_ref().map(|residual| &residual.flexibility),
    )?;
    if let Some(residual) = residual {
        built.contents.push(residual.told);
        built.band_max_hz = Some(residual.band_max_hz);
    }
    Ok(built)
}

impl Part {
    /// Displacement of a node along `d` in the `mode`-th of the selected modes.
    pub fn along(&self, node: usize, mode: usize, d: [f64; 3]) -> f64 {
        let shape = self.data.shape(node, self.selected[mode]);
        shape[0] * d[0] + shape[1] * d[1] + shape[2] * d[2]
    }

    /// What the modes that do not take part still do at the contact.
    fn residual(&self, name: &'static str, file: &str) -> Result<SideResidual, RigError> {
        let residual = self.data.residual_beyond(&self.selected).map_err(|mode| RigError::Range {
            file: file.to_owned(),
            field: format!("{name}.modes"),
            value: format!("a selection without mode {mode} of {} rad/s", self.data.omega_rad_s[mode]),
            limit: "one with every rigid-body motion: they have no residual flexibility".to_owned(),
        })?;
        let highest = self.side.modes.omega_rad_s.iter().copied().fold(0.0, f64::max);
        Ok(SideResidual { name, residual, cutoff_hz: highest / std::f64::consts::TAU })
    }
}

/// Reads one side and selects its modes.
fn part(source: &mut Source<'_>, key: &str, raw: &RawSubstructure) -> Result<Part, RigError> {
    let file = source.rig_file.clone();
    let Some(name) = &raw.modal else {
        let (field, limit) = (format!("{key}.modal"), "an .npz, .unv or .uff file".to_owned());
        return Err(RigError::MissingKey { file, field, limit });
    };
    let data = ModalData::read(name, source.read(&format!("{key}.modal"), name)?)?;
    let mut ascending: Vec<usize> = (0..data.omega_rad_s.len()).collect();
    ascending.sort_by(|&a, &b| data.omega_rad_s[a].total_cmp(&data.omega_rad_s[b]));
    let selected: Vec<usize> = raw
        .selection()
        .indices(&format!("{key}.modes"), ascending.len())
        .map_err(|source| RigError::Reduction { file: file.clone(), source })?
        .into_iter()
        .map(|index| ascending[index])
        .collect();
    let damping_ratio = match (&raw.damping_ratio, &data.damping_ratio) {
        (Some(_), Some(_)) => {
            let (field, value) = (format!("{key}.damping_ratio"), format!("is given here and in {name}"));
            return Err(RigError::Kind { file, field, value, limit: "one of the two".to_owned() });
        }
        (Some(values), None) => spread(&file, &format!("{key}.damping_ratio"), values, selected.len(), "modes")?,
        (None, Some(values)) => selected.iter().map(|&mode| values[mode]).collect(),
        (None, None) => vec![0.0; selected.len()],
    };
    let omega_rad_s = selected.iter().map(|&mode| data.omega_rad_s[mode]).collect();
    let modes = Modes { omega_rad_s, phi: Mat::zeros(0, selected.len()) };
    Ok(Part { data, selected, side: Side { modes, damping_ratio } })
}

/// `[d·Φ_p, -T d·Φ_d]`, a row for every pair, `d` its `direction`.
fn relative_displacement(
    pairs: &[Pair],
    direction: &dyn Fn(&Pair) -> [f64; 3],
    pad: &Part,
    disc: Option<&Part>,
) -> Mat<f64> {
    let pad_modes = pad.selected.len();
    let disc_modes = disc.map_or(0, |disc| disc.selected.len());
    Mat::from_fn(pairs.len(), pad_modes + disc_modes, |row, column| {
        let pair = &pairs[row];
        let d = direction(pair);
        match disc {
            Some(disc) if column >= pad_modes => {
                -pair.disc.iter().map(|&(node, weight)| weight * disc.along(node, column - pad_modes, d)).sum::<f64>()
            }
            _ => pad.along(pair.pad_node, column, d),
        }
    })
}
