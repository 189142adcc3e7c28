//! Rigs on a basis of the whole full model (`[basis]`): their model, and a summary of what `[basis]` records.

use std::sync::Arc;

use faer::Mat;

use super::contact_state::StateTable;
use super::inline::{describe_contact, describe_falling_friction, free_frequencies};
use super::modal::Part;
use super::patch::Pair;
use super::raw::RawBasis;
use super::settings::{Settings, within};
use super::{Built, Contact, RigError, SideShapes};
use crate::contact::Statics;
use crate::physics::{ContactPairs, Law, Model, Term};

/// Builds the model of pad and disc that share `k` coordinates, the vectors `V` of a basis of the whole full model:
///
/// ```text
/// K(μ) = diag(Ω²) + κ(N) (B_n + s μ B_t)ᵀ K_c B_n,   B = d·V_p - T d·V_d
/// ```
///
/// `κ` is the load law of the contact stiffness, `s` the sign of the disc speed and `d` a direction of each pair.
/// `values` are stiffness (N/m) and damping (N s/m) of the pairs. With a contact `state` the pairs follow the states of its
/// statics.
///
/// # Errors
/// [`RigError::Kind`] if there is no disc, if the natural frequencies of the two sides differ, if coordinates are
/// deselected, or if a side brings damping ratios or residual flexibility, which belong to modes of a single part;
/// [`RigError::Model`].
pub(super) fn build(
    file: &str,
    pad: &Part,
    disc: Option<&Part>,
    pairs: &[Pair],
    values: [Vec<f64>; 2],
    state: Option<(StateTable, Arc<Statics>)>,
    settings: &Settings,
) -> Result<Built, RigError> {
    let refuse = |field: &str, value: &str, limit: &str| {
        let (file, field, value, limit) = (file.to_owned(), field.to_owned(), value.to_owned(), limit.to_owned());
        Err(RigError::Kind { file, field, value, limit })
    };
    let Some(disc) = disc else {
        return refuse("basis.shared", "is true together with a rigid disc", "[disc], or no [basis]");
    };
    for (name, part) in [("pad", pad), ("disc", disc)] {
        if part.selected.len() != part.data.omega_rad_s.len() {
            return refuse(&format!("{name}.modes"), "omits coordinates of a shared basis", "all of them");
        }
        if part.side.damping_ratio.iter().any(|ratio| *ratio != 0.0) {
            return refuse(
                &format!("{name}.damping_ratio"),
                "is given for a shared basis",
                "modes of the part, or none",
            );
        }
        if part.data.residual.is_some() {
            return refuse(
                &format!("{name}.modal"),
                "holds a residual, which cannot be combined with a shared basis",
                "modes of the part",
            );
        }
    }
    let omega_rad_s = &pad.side.modes.omega_rad_s;
    if *omega_rad_s != disc.side.modes.omega_rad_s {
        let value = "other frequencies than those of pad.modal";
        return refuse("disc.modal", value, "the same coordinates on both sides of a shared basis");
    }
    let k = omega_rad_s.len();
    let row = |direction: &dyn Fn(&Pair) -> [f64; 3]| {
        Mat::from_fn(pairs.len(), k, |row, column| {
            let (pair, d) = (&pairs[row], direction(&pairs[row]));
            let of_disc = pair.disc.iter().map(|&(node, weight)| weight * disc.along(node, column, d)).sum::<f64>();
            pad.along(pair.pad_node, column, d) - of_disc
        })
    };
    let [stiffness_n_per_m, damping_n_s_per_m] = values;
    let contact = ContactPairs {
        normal: row(&|pair| pair.normal),
        sliding: row(&|pair| pair.sliding),
        lateral: row(&|pair| pair.lateral),
        stiffness_n_per_m,
        damping_n_s_per_m,
        radius_m: pairs.iter().map(|pair| pair.radius_m).collect(),
    };
    let free = Term {
        matrix: Mat::from_fn(k, k, |i, j| if i == j { omega_rad_s[i] * omega_rad_s[i] } else { 0.0 }),
        law: Law::Constant,
    };
    let law = settings.contact_law;
    // Both sides have all coordinates.
    let terms = super::modal::terms(file, k, pad, Some((disc, 0)))?;
    let stiffness = std::iter::once(free).chain(terms.stiffness).collect();
    let model = Model::new(k, stiffness, terms.damping, law, None)
        .and_then(|model| match &state {
            Some((_, statics)) => model.with_steady_contact(&contact, statics.clone(), None),
            None => model.with_contact(&contact),
        })
        .and_then(|model| match &pad.data.mass_share {
            // The model takes its coordinates in ascending frequency.
            Some(share) => model.with_pad_mass(Mat::from_fn(k, k, |i, j| share[(pad.selected[i], pad.selected[j])])),
            None => Ok(model),
        })
        .map_err(|source| RigError::Model { file: file.to_owned(), source })?;
    let mut contents = vec![
        "kind       pad and disc on a shared basis (kind 2)".to_owned(),
        format!("vectors    {k}, of the full model"),
    ];
    contents.extend(match &state {
        Some((state, statics)) => state.describe("statics", statics, &contact, settings)?,
        None => describe_contact(&contact, &law),
    });
    contents.extend(describe_falling_friction(&contact, settings));
    contents.extend(free_frequencies("vectors", omega_rad_s));
    contents.extend(terms.contents);
    let shapes = ["pad", "disc"]
        .map(|name| SideShapes { name, first_coordinate: 0, phi: Mat::zeros(0, k), nodes_m: vec![] })
        .into();
    let contact = Some(Contact { pairs: contact, residual: None, places: vec![] });
    Ok(Built { model, contact, contents, shapes, band_max_hz: settings.band_max_hz })
}

impl RawBasis {
    /// The contents of `[basis]` in one or two lines of text.
    ///
    /// # Errors
    /// [`RigError::NotFinite`], [`RigError::Range`].
    pub(super) fn describe(&self, file: &str) -> Result<Vec<String>, RigError> {
        let positive = |field: &str, value: Option<f64>| {
            value.map(|value| within(file, &format!("basis.{field}"), value, value >= 0.0, "at least 0")).transpose()
        };
        let tolerance = positive("tolerance", self.tolerance)?;
        let error = positive("largest_error", self.largest_error)?;
        let mut lines = vec![];
        if let (Some(tolerance), Some(error), Some(points)) = (tolerance, error, self.held_out) {
            lines.push(format!(
                "basis      |dlambda|/|lambda| at most {error:.1e} at {points} held-out points, {tolerance:.1e} required"
            ));
        }
        let ranges: Vec<String> = [
            ("friction coefficient", self.friction_coefficient),
            ("normal load, N", self.normal_load_n),
            ("disc speed, rad/s", self.disc_speed_rad_s),
        ]
        .into_iter()
        .filter_map(|(what, range)| range.map(|[low, high]| format!("{what} {low} to {high}")))
        .collect();
        if !ranges.is_empty() {
            lines.push(format!("made for   {}", ranges.join("; ")));
        }
        Ok(lines)
    }
}
