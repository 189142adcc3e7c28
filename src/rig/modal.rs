//! Kind 2: substructures given by their modes at the contact interface, from any finite-element program.

use std::sync::Arc;

use faer::Mat;

use super::contact_state::{self, StateTable};
use super::inline::{Joint, Side, Terms, assemble};
use super::modal_data::{ModalData, Residual};
use super::patch::{self, Pair};
use super::raw::{RawPatch, RawResidual, RawRig, RawSubstructure};
use super::residual::{self, SideResidual};
use super::settings::{MOST_COORDINATES, Settings, at_most, spread};
use super::source::Source;
use super::{Built, PairPlace, RigError, basis, npz};
use crate::physics::{ContactPairs, Law, ResidualFlexibility, Term};
use crate::reduction::{Modes, PartMatrices};

/// A substructure and its selected modes, in ascending frequency.
pub(super) struct Part {
    pub data: ModalData,
    pub selected: Vec<usize>,
    pub side: Side,
}

/// Builds the model of a rig of kind 2, in `n = i + j` modal coordinates (`i` of the pad, then `j` of the disc) or in
/// coordinates that both sides share.
///
/// # Errors
/// [`RigError`].
pub(super) fn build(
    source: &mut Source<'_>,
    pad: &RawSubstructure,
    disc: Option<&RawSubstructure>,
    patches: &[RawPatch],
    raw: &RawRig,
    settings: &Settings,
) -> Result<Built, RigError> {
    let shared = raw.basis.as_ref().is_some_and(|basis| basis.shared);
    let pad = part(source, "pad", pad)?;
    let disc = disc.map(|disc| part(source, "disc", disc)).transpose()?;
    let file = source.rig_file.clone();
    let modes = pad.selected.len() + disc.as_ref().map_or(0, |disc| disc.selected.len());
    at_most(&file, "modes", modes, MOST_COORDINATES)?;
    let patch::Contacts { pairs, stiffness_n_per_m, damping_n_s_per_m } =
        patch::contacts(&file, patches, &pad.data.nodes_m, disc.as_ref().map(|disc| &*disc.data.nodes_m))?;
    let values = [stiffness_n_per_m, damping_n_s_per_m];
    let given = raw.residual.as_ref().map(|raw| given(source, raw, &pad, disc.as_ref(), pairs.len())).transpose()?;
    let state = contact_state::read(source, raw)?;
    let mut built = if shared {
        if given.is_some() {
            let (field, limit) = ("residual".to_owned(), "modes of the parts, or none".to_owned());
            return Err(RigError::Kind {
                file,
                field,
                value: "cannot be combined with a shared basis".to_owned(),
                limit,
            });
        }
        let on_basis = |state: StateTable| {
            let statics = state.statics_on_basis(source, &values[0], settings)?;
            Ok::<_, RigError>((state, Arc::new(statics)))
        };
        let state = state.map(on_basis).transpose()?;
        basis::build(&file, &pad, disc.as_ref(), &pairs, values, state, settings)?
    } else {
        apart(&file, &pad, disc.as_ref(), &pairs, values, given, state, settings)?
    };
    for (shapes, part) in built.shapes.iter_mut().zip(std::iter::once(&pad).chain(&disc)) {
        let rows = 3 * part.data.nodes_m.len();
        let entry = |row: usize, mode: usize| part.data.shape(row / 3, part.selected[mode])[row % 3];
        shapes.phi = Mat::from_fn(rows, part.selected.len(), entry);
        shapes.nodes_m.clone_from(&part.data.nodes_m);
    }
    if let Some(contact) = &mut built.contact {
        let place = |pair: &Pair| PairPlace { at_m: pad.data.nodes_m[pair.pad_node], normal: pair.normal };
        contact.places = pairs.iter().map(place).collect();
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

/// Builds the model of sides that have separate modal coordinates.
#[expect(clippy::too_many_arguments, reason = "what a rig of modes is made of, each given once")]
fn apart(
    file: &str,
    pad: &Part,
    disc: Option<&Part>,
    pairs: &[Pair],
    [stiffness_n_per_m, damping_n_s_per_m]: [Vec<f64>; 2],
    given: Option<ResidualFlexibility>,
    state: Option<StateTable>,
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
    let sides: Vec<(&'static str, &Part)> =
        std::iter::once(("pad", pad)).chain(disc.map(|disc| ("disc", disc))).collect();
    let known = match given {
        Some(given) => Some((given, "the contact pairs".to_owned())),
        None => of_sides(file, pairs, &sides)?,
    };
    let cutoff_hz = sides.iter().map(|(_, part)| part.cutoff_hz()).fold(f64::INFINITY, f64::min);
    let residual =
        known.map(|(known, of)| residual::within_band(known, &of, cutoff_hz, settings.band_max_hz, state.is_some()));
    let (flexibility, description) = match residual {
        Some(residual) => (Some(residual.flexibility), Some((residual.description, residual.band_max_hz))),
        None => (None, None),
    };
    let state = state
        .map(|state| {
            let load =
                state.load_on_modes(pad, disc.map_or(0, |disc| disc.selected.len()), pairs, flexibility.is_some())?;
            Ok((state, load))
        })
        .transpose()?;
    let pad_modes = pad.selected.len();
    let n = pad_modes + disc.map_or(0, |disc| disc.selected.len());
    let terms = terms(file, n, pad, disc.map(|disc| (disc, pad_modes)))?;
    let (kind, disc) = ("modal substructures (kind 2)", disc.map(|disc| &disc.side));
    let joint = Joint { pairs: contact, residual: flexibility, state };
    let mut built = assemble(file, kind, &pad.side, disc, joint, settings, terms)?;
    if let Some((description, band_max_hz)) = description {
        built.contents.push(description);
        built.band_max_hz = Some(band_max_hz);
    }
    Ok(built)
}

/// The terms of damping and rotation of pad and disc, over `n` coordinates: `C += C_part + 2 Ω H`, `K -= Ω² L`. `disc`
/// is the disc with its first coordinate.
///
/// # Errors
/// [`RigError::Kind`] if the pad has terms of rotation: in its own frame it does not turn.
pub(super) fn terms(file: &str, n: usize, pad: &Part, disc: Option<(&Part, usize)>) -> Result<Terms, RigError> {
    let PartMatrices { gyroscopic, spin, .. } = &pad.data.matrices;
    if gyroscopic.is_some() || spin.is_some() {
        let value = "holds `gyroscopic` or `spin` of the pad, which does not turn".to_owned();
        let (file, field, limit) = (file.to_owned(), "pad.modal".to_owned(), "these arrays in disc.modal".to_owned());
        return Err(RigError::Kind { file, field, value, limit });
    }
    let mut terms = Terms::default();
    for (name, part, first) in std::iter::once(("pad", pad, 0)).chain(disc.map(|(disc, first)| ("disc", disc, first))) {
        let range = first..first + part.selected.len();
        let over_all = |matrix: &Mat<f64>, factor: f64| {
            Mat::from_fn(n, n, |i, j| {
                let inside = range.contains(&i) && range.contains(&j);
                if inside { factor * matrix[(part.selected[i - first], part.selected[j - first])] } else { 0.0 }
            })
        };
        let PartMatrices { damping, gyroscopic, spin } = &part.data.matrices;
        if let Some(damping) = damping {
            terms.damping.push(Term { matrix: over_all(damping, 1.0), law: Law::Constant });
            terms.contents.push(format!("damping    matrix of the {name}"));
        }
        if let Some(gyroscopic) = gyroscopic {
            terms.damping.push(Term { matrix: over_all(gyroscopic, 2.0), law: Law::DiscSpeed { power: 1 } });
        }
        if let Some(spin) = spin {
            terms.stiffness.push(Term { matrix: over_all(spin, -1.0), law: Law::DiscSpeed { power: 2 } });
        }
        let known = [("gyroscopic", gyroscopic), ("spin", spin)];
        let known: Vec<&str> = known.into_iter().filter_map(|(term, matrix)| matrix.as_ref().map(|_| term)).collect();
        if !known.is_empty() {
            terms.contents.push(format!("rotation   {} terms of the {name}", known.join(" and ")));
        }
    }
    Ok(terms)
}

impl Part {
    /// Displacement of `node` along the direction `d` in the `mode`-th selected mode, kg^-1/2.
    pub fn along(&self, node: usize, mode: usize, d: [f64; 3]) -> f64 {
        let shape = self.data.shape(node, self.selected[mode]);
        shape[0] * d[0] + shape[1] * d[1] + shape[2] * d[2]
    }

    /// Residual flexibility of all modes that are not selected, at the contact interface.
    ///
    /// # Errors
    /// [`RigError::Range`] if a rigid-body motion is not selected.
    fn residual(&self, name: &'static str, file: &str) -> Result<Option<Residual>, RigError> {
        self.data.residual_beyond(&self.selected).map_err(|mode| RigError::Range {
            file: file.to_owned(),
            field: format!("{name}.modes"),
            value: format!("a selection without mode {mode} of {} rad/s", self.data.omega_rad_s[mode]),
            limit: "one with every rigid-body motion: they have no residual flexibility".to_owned(),
        })
    }

    /// Highest natural frequency of the selected modes, Hz.
    fn cutoff_hz(&self) -> f64 {
        self.side.modes.omega_rad_s.iter().copied().fold(0.0, f64::max) / std::f64::consts::TAU
    }
}

/// Residual flexibility between `pairs`, from the modal data of the sides, and the names of the sides that have it;
/// `None` if neither has it.
fn of_sides(
    file: &str,
    pairs: &[Pair],
    sides: &[(&'static str, &Part)],
) -> Result<Option<(ResidualFlexibility, String)>, RigError> {
    let mut known = vec![];
    for &(name, part) in sides {
        known.extend(part.residual(name, file)?.map(|residual| (name, residual)));
    }
    if known.is_empty() {
        return Ok(None);
    }
    let of_sides: Vec<SideResidual<'_>> = known
        .iter()
        .map(|(name, residual)| SideResidual {
            disc: *name == "disc",
            flexibility: &residual.flexibility,
            inertia: residual.inertia.as_ref(),
        })
        .collect();
    let between = residual::between(pairs, &of_sides);
    let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
    Ok(Some((between, names.join(" and "))))
}

/// Reads `[residual]`: residual flexibility given directly between the contact pairs.
fn given(
    source: &mut Source<'_>,
    raw: &RawResidual,
    pad: &Part,
    disc: Option<&Part>,
    pairs: usize,
) -> Result<ResidualFlexibility, RigError> {
    let file = source.rig_file.clone();
    for (name, part) in std::iter::once(("pad", pad)).chain(disc.map(|disc| ("disc", disc))) {
        if part.data.residual.is_some() {
            let (field, value) =
                (format!("{name}.modal"), "holds a residual, which cannot be combined with [residual]".to_owned());
            return Err(RigError::Kind { file, field, value, limit: "one of the two".to_owned() });
        }
        if part.selected.len() != part.data.omega_rad_s.len() {
            let (field, value) = (format!("{name}.modes"), "omits modes that [residual] does not contain".to_owned());
            return Err(RigError::Kind { file, field, value, limit: "all of them".to_owned() });
        }
    }
    npz::read_pair_residual(&raw.pairs, source.read("residual.pairs", &raw.pairs)?, pairs)
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

/// Rows `[d·Φ_p, -T d·Φ_d]` of relative displacement, one per pair, along the direction `d` of the pair.
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
