//! Kind 1: substructures given as matrices in the rig file, contact pairs given as rows over their degrees of freedom.

use std::sync::Arc;

use faer::Mat;

use super::contact_state::{Load, StateTable};
use super::raw::{RawContact, RawSubstructure};
use super::settings::{Settings, finite, spread, within};
use super::{Built, Contact, RigError, SideShapes};
use crate::physics::{ContactLaw, ContactPairs, Law, Model, ResidualFlexibility, Stribeck, Term};
use crate::reduction::{Modes, free_interface_modes};

/// Modes of one side with their damping ratios.
pub(super) struct Side {
    pub modes: Modes,
    pub damping_ratio: Vec<f64>,
}

/// Builds the model of a rig of kind 1 in `n = i + j` modal coordinates: `i` of the pad, then `j` of the disc.
///
/// # Errors
/// [`RigError`].
pub(super) fn build(
    file: &str,
    pad: &RawSubstructure,
    disc: Option<&RawSubstructure>,
    contacts: &[RawContact],
    state: Option<StateTable>,
    settings: &Settings,
) -> Result<Built, RigError> {
    let pad = substructure(file, "pad", pad)?;
    let disc = disc.map(|disc| substructure(file, "disc", disc)).transpose()?;
    let pairs = contact_pairs(file, contacts, &pad.modes, disc.as_ref().map(|disc| &disc.modes))?;
    let state = state
        .map(|state| {
            let load = state.load_on_inline(&pad.modes, disc.as_ref().map(|disc| &disc.modes))?;
            Ok((state, load))
        })
        .transpose()?;
    let joint = Joint { pairs, residual: None, state };
    assemble(file, "inline substructures (kind 1)", &pad, disc.as_ref(), joint, settings, Terms::default())
}

/// Terms of a model in addition to modes, modal damping ratios and contact pairs.
#[derive(Default)]
pub(super) struct Terms {
    pub stiffness: Vec<Term>,
    pub damping: Vec<Term>,
    /// A line for [`super::Rig::describe`] each.
    pub contents: Vec<String>,
}

/// The contact in three lines of text: its pairs, the law of their stiffness, and that they are always closed.
pub(super) fn describe_contact(pairs: &ContactPairs, law: &ContactLaw) -> Vec<String> {
    // Friction is described with the damping, if at all.
    let ContactLaw { exponent, reference_n, slope_s_per_m: _, stribeck: _, lateral_damping: _ } = *law;
    vec![
        describe_pairs(pairs),
        match exponent {
            0.0 => "stiffness  of the contact, independent of the load".to_owned(),
            exponent => format!("stiffness  of the contact times (load / {reference_n} N)^{exponent}"),
        },
        "state      every pair always closed: springs that push and pull".to_owned(),
    ]
}

/// Friction that falls with speed, if it does: its law, and its slope at the reference speed.
pub(super) fn describe_falling_friction(pairs: &ContactPairs, settings: &Settings) -> Option<String> {
    let law = settings.contact_law;
    let Stribeck { drop, speed_m_s, exponent } = law.stribeck?;
    let speed = settings.reference.disc_speed_rad_s;
    let slopes = pairs.radius_m.iter().map(|radius| law.falling_slope(speed.abs() * radius));
    let (low, high) = slopes.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), s| (low.min(s), high.max(s)));
    Some(format!(
        "friction   falls with the sliding speed v by {drop} (1 - exp(-(v / {speed_m_s} m/s)^{exponent})): slope \
         {low:.3e} to {high:.3e} s/m at {speed} rad/s"
    ))
}

/// Number, stiffness and damping of the contact pairs.
pub(super) fn describe_pairs(pairs: &ContactPairs) -> String {
    format!(
        "contact    {} pairs, in all {:.6e} N/m, {:.6e} N s/m",
        pairs.stiffness_n_per_m.len(),
        pairs.stiffness_n_per_m.iter().sum::<f64>(),
        pairs.damping_n_s_per_m.iter().sum::<f64>()
    )
}

/// How pad and disc are joined.
pub(super) struct Joint {
    pub pairs: ContactPairs,
    /// Residual flexibility of the truncated modes, with which the contact acts in series.
    pub residual: Option<ResidualFlexibility>,
    /// `[contact_state]` with its load; `None` if the pairs are always closed.
    pub state: Option<(StateTable, Load)>,
}

/// Builds the model of both sides: `K = diag(ω²)` and `C = diag(2 ζ ω)`, with `terms`, joined by the contact pairs.
pub(super) fn assemble(
    file: &str,
    kind: &str,
    pad: &Side,
    disc: Option<&Side>,
    joint: Joint,
    settings: &Settings,
    terms: Terms,
) -> Result<Built, RigError> {
    let Joint { pairs, residual, state } = joint;
    let contact_law = settings.contact_law;
    let sides: Vec<&Side> = std::iter::once(pad).chain(disc).collect();
    let omega: Vec<f64> = sides.iter().flat_map(|side| side.modes.omega_rad_s.iter().copied()).collect();
    let zeta: Vec<f64> = sides.iter().flat_map(|side| side.damping_ratio.iter().copied()).collect();
    let n = omega.len();
    let diagonal = |value: &dyn Fn(usize) -> f64| Term {
        matrix: Mat::from_fn(n, n, |i, j| if i == j { value(i) } else { 0.0 }),
        law: Law::Constant,
    };
    let stiffness = diagonal(&|k| omega[k] * omega[k]);
    let damping = diagonal(&|k| 2.0 * zeta[k] * omega[k]);
    let pad_modes = pad.modes.omega_rad_s.len();
    let (mut stiffness, mut damping) = (vec![stiffness], vec![damping]);
    stiffness.extend(terms.stiffness);
    damping.extend(terms.damping);
    let statics = state
        .as_ref()
        .map(|(state, load)| state.statics(&omega, &pairs, residual.as_ref(), load, settings).map(Arc::new))
        .transpose()?;
    let model = Model::new(n, stiffness, damping, contact_law, Some(pad_modes))
        .and_then(|model| match (&statics, &residual) {
            (Some(statics), residual) => model.with_steady_contact(&pairs, statics.clone(), residual.as_ref()),
            (None, Some(residual)) => model.with_flexible_contact(&pairs, residual, settings.largest_friction()),
            (None, None) => model.with_contact(&pairs),
        })
        .map_err(|source| RigError::Model { file: file.to_owned(), source })?;

    let mut contents = vec![
        format!("kind       {kind}"),
        format!(
            "modes      {pad_modes} of the pad, {}",
            match disc {
                Some(disc) => format!("{} of the disc", disc.modes.omega_rad_s.len()),
                None => "the disc rigid".to_owned(),
            }
        ),
    ];
    contents.extend(match (&state, &statics) {
        (Some((state, load)), Some(statics)) => state.describe(load.field, statics, &pairs, settings)?,
        (None, _) | (_, None) => describe_contact(&pairs, &contact_law),
    });
    for (name, side) in ["pad", "disc"].into_iter().zip(&sides) {
        contents.extend(free_frequencies(name, &side.modes.omega_rad_s));
    }
    let damped = zeta.iter().filter(|zeta| **zeta != 0.0).count();
    contents.push(format!(
        "damping    {damped} of {n} modes; friction slope {} s/m, lateral friction {}",
        contact_law.slope_s_per_m,
        if contact_law.lateral_damping { "on" } else { "off" }
    ));
    contents.extend(describe_falling_friction(&pairs, settings));
    contents.extend(terms.contents);
    let mut first_coordinate = 0;
    let mut shapes = vec![];
    for (name, side) in ["pad", "disc"].into_iter().zip(sides) {
        shapes.push(SideShapes { name, first_coordinate, phi: side.modes.phi.clone(), nodes_m: vec![] });
        first_coordinate += side.modes.omega_rad_s.len();
    }
    let contact = Some(Contact { pairs, residual, places: vec![] });
    Ok(Built { model, contact, contents, shapes, band_max_hz: settings.band_max_hz })
}

/// The lowest and the highest natural frequency of a part without contact, as a line of text. A wrong unit shows in
/// them.
pub(super) fn free_frequencies(name: &str, omega_rad_s: &[f64]) -> Option<String> {
    let hz = omega_rad_s.iter().map(|omega| omega / std::f64::consts::TAU);
    let (low, high) = hz.fold((f64::INFINITY, 0.0f64), |(low, high), hz| (low.min(hz), high.max(hz)));
    (low <= high).then(|| format!("{name:<10} natural frequencies {low:.1} to {high:.1} Hz without contact"))
}

/// Computes the modes of one inline substructure.
fn substructure(file: &str, side: &str, raw: &RawSubstructure) -> Result<Side, RigError> {
    let matrix = |key: &str, rows: &Option<Vec<Vec<f64>>>| match rows {
        Some(rows) => dense(file, &format!("{side}.{key}"), rows),
        None => Err(RigError::MissingKey {
            file: file.to_owned(),
            field: format!("{side}.{key}"),
            limit: "a list of rows".to_owned(),
        }),
    };
    let (mass, stiffness) = (matrix("mass", &raw.mass)?, matrix("stiffness", &raw.stiffness)?);
    let modes = free_interface_modes(side, mass.as_ref(), stiffness.as_ref(), &raw.selection())
        .map_err(|source| RigError::Reduction { file: file.to_owned(), source })?;
    let count = modes.omega_rad_s.len();
    let damping_ratio = match &raw.damping_ratio {
        Some(values) => spread(file, &format!("{side}.damping_ratio"), values, count, "modes")?,
        None => vec![0.0; count],
    };
    Ok(Side { modes, damping_ratio })
}

/// A square matrix from its rows; `field` names it in errors.
fn dense(file: &str, field: &str, rows: &[Vec<f64>]) -> Result<Mat<f64>, RigError> {
    let n = rows.len();
    let shape = |field: String, value: String, limit: String| {
        Err(RigError::Shape { file: file.to_owned(), field, value, limit })
    };
    if n == 0 {
        return shape(field.to_owned(), "0 rows".to_owned(), "at least one".to_owned());
    }
    for (index, row) in rows.iter().enumerate() {
        if row.len() != n {
            return shape(
                format!("{field}[{index}]"),
                format!("{} values", row.len()),
                format!("{n}, as many as rows"),
            );
        }
        for (column, &value) in row.iter().enumerate() {
            finite(file, &format!("{field}[{index}][{column}]"), value)?;
        }
    }
    Ok(Mat::from_fn(n, n, |i, j| rows[i][j]))
}

/// The contact pairs of all `[[contact]]` tables, with rows `[pad_row Φ_p, -disc_row Φ_d]` of relative displacement.
fn contact_pairs(
    file: &str,
    contacts: &[RawContact],
    pad: &Modes,
    disc: Option<&Modes>,
) -> Result<ContactPairs, RigError> {
    let n = pad.phi.ncols() + disc.map_or(0, |disc| disc.phi.ncols());
    let mut rows = [vec![], vec![], vec![]];
    let (mut stiffness_n_per_m, mut damping_n_s_per_m, mut radius_m) = (vec![], vec![], vec![]);
    for (index, contact) in contacts.iter().enumerate() {
        let field = |key: &str| format!("contact[{index}].{key}");
        let along = [
            ("normal", Some(&contact.pad_normal), contact.disc_normal.as_ref(), true),
            ("sliding", Some(&contact.pad_sliding), contact.disc_sliding.as_ref(), true),
            ("lateral", contact.pad_lateral.as_ref(), contact.disc_lateral.as_ref(), false),
        ];
        for (rows, (along, pad_row, disc_row, required)) in rows.iter_mut().zip(along) {
            let mut row = modal_row(file, &field(&format!("pad_{along}")), pad_row, Some(pad), required, 1.0)?;
            row.extend(modal_row(file, &field(&format!("disc_{along}")), disc_row, disc, required, -1.0)?);
            rows.push(row);
        }
        let checked = |key: &str, value: f64| within(file, &field(key), value, value >= 0.0, "at least 0");
        stiffness_n_per_m.push(checked("stiffness_n_per_m", contact.stiffness_n_per_m)?);
        damping_n_s_per_m.push(checked("damping_n_s_per_m", contact.damping_n_s_per_m)?);
        radius_m.push(checked("radius_m", contact.radius_m)?);
    }
    let [normal, sliding, lateral] = rows.map(|rows| Mat::from_fn(rows.len(), n, |row, column| rows[row][column]));
    Ok(ContactPairs { normal, sliding, lateral, stiffness_n_per_m, damping_n_s_per_m, radius_m })
}

/// `sign · row Φ` of one side. Empty for a rigid side, zero for an optional row that is not given.
pub(super) fn modal_row(
    file: &str,
    field: &str,
    row: Option<&Vec<f64>>,
    side: Option<&Modes>,
    required: bool,
    sign: f64,
) -> Result<Vec<f64>, RigError> {
    let (file, field) = (file.to_owned(), field.to_owned());
    let (row, side) = match (row, side) {
        (None, None) => return Ok(vec![]),
        (None, Some(side)) if !required => return Ok(vec![0.0; side.phi.ncols()]),
        (None, Some(side)) => {
            let limit = format!("a row over {} degrees of freedom", side.phi.nrows());
            return Err(RigError::MissingKey { file, field, limit });
        }
        (Some(_), None) => {
            let (value, limit) = ("is given for a rigid disc".to_owned(), "[disc], or no row for it".to_owned());
            return Err(RigError::Kind { file, field, value, limit });
        }
        (Some(row), Some(side)) => (row, side),
    };
    let n = side.phi.nrows();
    if row.len() != n {
        let (value, limit) = (format!("{} values", row.len()), format!("one for each of {n} degrees of freedom"));
        return Err(RigError::Shape { file, field, value, limit });
    }
    for (index, &value) in row.iter().enumerate() {
        finite(&file, &format!("{field}[{index}]"), value)?;
    }
    let modal =
        |mode: usize| sign * row.iter().enumerate().map(|(dof, value)| value * side.phi[(dof, mode)]).sum::<f64>();
    Ok((0..side.phi.ncols()).map(modal).collect())
}
