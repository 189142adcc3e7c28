//! The tables common to all kinds of rig, and how the kind of a rig is determined.

use super::raw::{
    Common, OneOrMany, RawContact, RawFriction, RawLoad, RawModes, RawPatch, RawRig, RawSubstructure, RawSystem,
};
use super::{ChartRange, Limits, RigError, Warning};
use crate::physics::{ContactLaw, OperatingPoint, Stribeck};
use crate::reduction::ModeSelection;

/// Largest number of coordinates of a model: a prediction that is not charted solves a dense eigenvalue problem of this
/// size.
pub const MOST_COORDINATES: usize = 3000;
/// Most matrices of a system, and most contact patches. Each refers to files, so a short rig file could name many.
pub const MOST_TERMS: usize = 100;

/// The common tables, checked.
#[derive(Clone, Debug)]
pub struct Settings {
    pub reference: OperatingPoint,
    pub band_max_hz: Option<f64>,
    pub mu_max: f64,
    pub instability_threshold: f64,
    pub contact_law: ContactLaw,
    pub limits: Limits,
    pub warning: Warning,
    pub chart: ChartRange,
}

impl Settings {
    /// Largest absolute friction coefficient that is ever predicted: the largest of `[search] mu_max` and `[limits]`.
    pub fn largest_friction(&self) -> f64 {
        self.limits.friction_coefficient.iter().fold(self.mu_max, |largest, mu| largest.max(mu.abs()))
    }
}

/// The kind of a rig, determined by its tables.
pub enum Kind<'a> {
    Inline { pad: &'a RawSubstructure, disc: Option<&'a RawSubstructure>, contacts: &'a [RawContact] },
    Modal { pad: &'a RawSubstructure, disc: Option<&'a RawSubstructure>, patches: &'a [RawPatch] },
    System(&'a RawSystem),
}

/// Checks that a value is finite.
pub fn finite(file: &str, field: &str, value: f64) -> Result<f64, RigError> {
    if value.is_finite() {
        Ok(value)
    } else {
        Err(RigError::NotFinite { file: file.into(), field: field.into(), value })
    }
}

/// Checks that a value is finite and that `holds` is true; `limit` says in the error what was expected.
pub fn within(file: &str, field: &str, value: f64, holds: bool, limit: &str) -> Result<f64, RigError> {
    finite(file, field, value)?;
    if holds {
        return Ok(value);
    }
    Err(RigError::Range { file: file.into(), field: field.into(), value: value.to_string(), limit: limit.into() })
}

/// Checks that `count` is at most `limit`.
pub fn at_most(file: &str, field: &str, count: usize, limit: usize) -> Result<(), RigError> {
    if count <= limit {
        return Ok(());
    }
    let (value, limit) = (format!("{count} in number"), format!("at most {limit}"));
    Err(RigError::Range { file: file.into(), field: field.into(), value, limit })
}

/// Checks the common tables.
///
/// # Errors
/// [`RigError::NotFinite`], [`RigError::Range`].
pub fn check(file: &str, raw: &Common) -> Result<Settings, RigError> {
    let number = |field: &str, value: f64| finite(file, field, value);
    let positive = |field: &str, value: f64| within(file, field, value, value > 0.0, "more than 0");
    let not_negative = |field: &str, value: f64| within(file, field, value, value >= 0.0, "at least 0");
    let range = |field: &str, [low, high]: [f64; 2]| {
        number(&format!("{field}[0]"), low)?;
        within(file, &format!("{field}[1]"), high, low <= high, &format!("at least {field}[0] = {low}"))?;
        Ok([low, high])
    };
    let positive_range = |field: &str, [low, high]: [f64; 2]| {
        positive(&format!("{field}[0]"), low)?;
        within(file, &format!("{field}[1]"), high, low < high, &format!("more than {field}[0] = {low}"))?;
        Ok([low, high])
    };
    Ok(Settings {
        reference: OperatingPoint {
            normal_load_n: number("reference.normal_load_n", raw.reference.normal_load_n)?,
            disc_speed_rad_s: number("reference.disc_speed_rad_s", raw.reference.disc_speed_rad_s)?,
            friction_coefficient: number("reference.friction_coefficient", raw.reference.friction_coefficient)?,
        },
        band_max_hz: raw.band.max_hz.map(|value| positive("band.max_hz", value)).transpose()?,
        mu_max: positive("search.mu_max", raw.search.mu_max)?,
        instability_threshold: not_negative("search.instability_threshold", raw.search.instability_threshold)?,
        contact_law: ContactLaw {
            exponent: number("load.exponent", raw.load.exponent)?,
            reference_n: positive("load.reference_n", raw.load.reference_n)?,
            slope_s_per_m: number("friction.slope_s_per_m", raw.friction.slope_s_per_m)?,
            stribeck: stribeck(file, &raw.friction)?,
            lateral_damping: raw.friction.lateral_damping,
        },
        limits: Limits {
            normal_load_n: range("limits.normal_load_n", raw.limits.normal_load_n)?,
            disc_speed_rad_s: range("limits.disc_speed_rad_s", raw.limits.disc_speed_rad_s)?,
            friction_coefficient: range("limits.friction_coefficient", raw.limits.friction_coefficient)?,
        },
        warning: raw.warning.check(file)?,
        chart: ChartRange {
            normal_load_n: positive_range("chart.normal_load_n", raw.chart.normal_load_n)?,
            disc_speed_rad_s: positive_range("chart.disc_speed_rad_s", raw.chart.disc_speed_rad_s)?,
            tolerance: within(
                file,
                "chart.tolerance",
                raw.chart.tolerance,
                (1e-12..=1e-2).contains(&raw.chart.tolerance),
                "1e-12 to 0.01",
            )?,
        },
    })
}

/// The Stribeck law of `[friction]`; `None` if friction does not fall.
fn stribeck(file: &str, raw: &RawFriction) -> Result<Option<Stribeck>, RigError> {
    let drop = finite(file, "friction.stribeck_drop", raw.stribeck_drop)?;
    let exponent = raw.stribeck_exponent;
    within(file, "friction.stribeck_exponent", exponent, (1.0..=10.0).contains(&exponent), "1 to 10")?;
    match raw.stribeck_speed_m_s {
        Some(speed_m_s) => {
            within(file, "friction.stribeck_speed_m_s", speed_m_s, speed_m_s > 0.0, "more than 0")?;
            Ok((drop != 0.0).then_some(Stribeck { drop, speed_m_s, exponent }))
        }
        None if drop == 0.0 => Ok(None),
        None => Err(RigError::MissingKey {
            file: file.to_owned(),
            field: "friction.stribeck_speed_m_s".to_owned(),
            limit: format!("the sliding speed, m/s, over which friction falls by stribeck_drop = {drop}"),
        }),
    }
}

/// Determines which of the three kinds a rig file is.
///
/// # Errors
/// [`RigError::Kind`] if tables or keys of two kinds are mixed, [`RigError::MissingKey`] if one is incomplete.
pub fn kind<'a>(file: &str, raw: &'a RawRig) -> Result<Kind<'a>, RigError> {
    let mixed = |field: &str, value: &str, limit: &str| {
        Err(RigError::Kind { file: file.into(), field: field.into(), value: value.into(), limit: limit.into() })
    };
    let missing = |field: &str, limit: &str| {
        Err(RigError::MissingKey { file: file.into(), field: field.into(), limit: limit.into() })
    };
    if let Some(system) = &raw.system {
        let other = [
            ("pad", raw.pad.is_some()),
            ("disc", raw.disc.is_some()),
            ("contact", raw.contact.is_some()),
            ("contact_patch", raw.contact_patch.is_some()),
        ];
        if let Some((field, _)) = other.iter().find(|(_, present)| *present) {
            return mixed(field, "cannot be combined with [system]", "either [system] or [pad] with its contact");
        }
        let RawFriction { slope_s_per_m, stribeck_drop, stribeck_speed_m_s: _, stribeck_exponent: _, lateral_damping } =
            raw.friction;
        let RawLoad { exponent, reference_n: _ } = raw.load;
        let friction_or_load = [
            ("friction.slope_s_per_m", slope_s_per_m != 0.0),
            ("friction.stribeck_drop", stribeck_drop != 0.0),
            ("friction.lateral_damping", lateral_damping),
            ("load.exponent", exponent != 0.0),
        ];
        if let Some((field, _)) = friction_or_load.iter().find(|(_, set)| *set) {
            return mixed(field, "has nothing to act on in a rig with [system]", "a scale of a matrix instead");
        }
        if raw.contact_state.is_some() {
            return mixed("contact_state", "cannot be combined with [system]", "[pad] with its contact");
        }
        if raw.residual.is_some() {
            return mixed("residual", "cannot be combined with [system]", "[pad] and [disc] with modal");
        }
        if raw.basis.as_ref().is_some_and(|basis| basis.shared) {
            return mixed("basis.shared", "is true together with [system]", "[pad] and [disc] with modal");
        }
        return Ok(Kind::System(system));
    }
    let Some(pad) = &raw.pad else {
        return missing("pad", "[pad] with mass and stiffness, [pad] with modal, or [system]");
    };
    let modal = pad.modal.is_some();
    if !modal && raw.residual.is_some() {
        return mixed("residual", "cannot be combined with inline substructures", "[pad] and [disc] with modal");
    }
    if !modal && raw.basis.is_some() {
        return mixed(
            "basis",
            "cannot be combined with inline substructures",
            "[pad] and [disc] with modal, or [system]",
        );
    }
    for (side, substructure) in [("pad", Some(pad)), ("disc", raw.disc.as_ref())] {
        let Some(substructure) = substructure else { continue };
        let inline = substructure.mass.is_some() || substructure.stiffness.is_some();
        if substructure.modal.is_some() && (inline || !modal) {
            let limit = "mass and stiffness on both sides, or modal on both sides";
            return mixed(&format!("{side}.modal"), "cannot be combined with mass and stiffness", limit);
        }
        if modal && inline {
            let limit = "mass and stiffness on both sides, or modal on both sides";
            return mixed(&format!("{side}.mass"), "cannot be combined with a modal pad", limit);
        }
        if modal && substructure.modal.is_none() {
            return missing(&format!("{side}.modal"), "an .npz, .unv or .uff file");
        }
    }
    match (modal, &raw.contact, &raw.contact_patch) {
        (true, Some(_), _) => mixed("contact", "cannot be combined with modal substructures", "[[contact_patch]]"),
        (false, _, Some(_)) => mixed("contact_patch", "cannot be combined with inline substructures", "[[contact]]"),
        (true, None, Some(patches)) if !patches.is_empty() => Ok(Kind::Modal { pad, disc: raw.disc.as_ref(), patches }),
        (false, Some(contacts), None) if !contacts.is_empty() => {
            Ok(Kind::Inline { pad, disc: raw.disc.as_ref(), contacts })
        }
        (true, ..) => missing("contact_patch", "at least one [[contact_patch]]"),
        (false, ..) => missing("contact", "at least one [[contact]]"),
    }
}

impl RawSubstructure {
    /// The modes that are selected.
    pub fn selection(&self) -> ModeSelection {
        match &self.modes {
            None => ModeSelection::All,
            Some(RawModes::Lowest(count)) => ModeSelection::Lowest(*count),
            Some(RawModes::Indices(list)) => ModeSelection::Indices(list.clone()),
        }
    }
}

/// One finite value for each of `count` items; a single value is repeated. `each` names the items in errors.
///
/// # Errors
/// [`RigError::Shape`], [`RigError::NotFinite`].
pub fn spread(file: &str, field: &str, values: &OneOrMany, count: usize, each: &str) -> Result<Vec<f64>, RigError> {
    let values = match values {
        OneOrMany::One(value) => {
            finite(file, field, *value)?;
            vec![*value; count]
        }
        OneOrMany::Many(values) => values.clone(),
    };
    if values.len() != count {
        let (value, limit) = (format!("{}", values.len()), format!("one value or one for each of {count} {each}"));
        return Err(RigError::Shape { file: file.into(), field: field.into(), value, limit });
    }
    for (index, &value) in values.iter().enumerate() {
        finite(file, &format!("{field}[{index}]"), value)?;
    }
    Ok(values)
}
