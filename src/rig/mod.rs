//! Rig files: raw form, validation, embedded rigs.
//!
//! A rig file is TOML (`raw`). Its tables determine which of three kinds it is, and it is built into a [`Rig`]:
//!
//! - `inline`: substructures given as matrices;
//! - `modal`: modes of substructures from a finite-element program (`npz` or `uff`), joined by contact pairs (`patch`);
//! - `system`: a sum of matrices (`matrix_market`), each times a `scale`.
//!
//! Files it refers to are read by name through `source`, so a rig can be read from a directory or from the attachments
//! of a recording.

mod basis;
mod certificate;
pub(crate) mod contact_state;
mod embedded;
mod error;
mod inline;
mod interpolation;
pub(crate) mod lines;
pub mod matrix_market;
mod modal;
mod modal_data;
pub mod npz;
pub(crate) mod patch;
pub(crate) mod raw;
mod residual;
pub mod scale;
pub(crate) mod settings;
mod source;
pub(crate) mod system;
pub mod temperature;
pub mod uff;
mod warning;

use std::sync::Arc;

use faer::Mat;

use crate::contact::{PressureLaw, Statics};
use crate::files::input_file;
use crate::physics::{ContactPairs, ContactState, Model, OperatingPoint, ResidualFlexibility};

pub use certificate::Certificate;
pub use contact_state::read_table as read_pressures;
pub use embedded::{EMBEDDED, Embedded};
pub use error::RigError;
pub use modal_data::{ModalData, Residual};
pub use patch::Pair;
pub use residual::{SideResidual, between_patches};
pub use settings::Settings;
pub use temperature::Temperature;
pub use warning::Warning;

use source::Source;

/// A rig: its model and its settings, checked and complete.
#[derive(Clone, Debug)]
pub struct Rig {
    /// Name of the rig.
    pub name: String,
    /// Equation of motion, mass-normalised.
    pub model: Model,
    /// Contact pairs; `None` for a system of matrices.
    pub contact: Option<Contact>,
    /// `[reference]`: the default operating point.
    pub reference: OperatingPoint,
    /// `[band] max_hz`: modes above are neither listed nor judged. With residual flexibility, at most the cut-off.
    pub band_max_hz: Option<f64>,
    /// `[search] mu_max`: windows of instability are sought in `[0, mu_max]`.
    pub mu_max: f64,
    /// `[search] instability_threshold`: a root is unstable if `σ` exceeds this times `|λ|`.
    pub instability_threshold: f64,
    /// `[limits]`: the inputs that the node accepts.
    pub limits: Limits,
    /// `[warning]`: when the node warns.
    pub warning: Warning,
    /// `[chart]`: the box of conditions that the chart covers.
    pub chart: ChartRange,
    /// `[temperature]`: the temperature that the rig has, and what follows it.
    pub temperature: Option<Temperature>,
    /// Path of the rig file; `None` for a rig read from memory.
    pub path: Option<std::path::PathBuf>,
    /// SHA-256 of the rig file and all files it refers to, hexadecimal.
    pub content_hash: String,
    /// The rig file, then the files it refers to, under the names it uses.
    pub files: Vec<RigFile>,
    /// Description of the rig's contents, one line each, for [`Rig::describe`].
    pub contents: Vec<String>,
    /// `[reduction]`: errors of the rig against the full model it was reduced from.
    pub reduction: Option<Certificate>,
    /// `[basis] tolerance`: the largest `|Δλ|/|λ|` allowed when the basis was made.
    pub basis_tolerance: Option<f64>,
    /// `[basis]`: range of conditions that the basis was sampled over.
    pub made_for: Option<MadeFor>,
    /// Shapes of the sides, for pictures; empty if only generalised coordinates are known.
    pub shapes: Vec<SideShapes>,
    /// Axis of the disc, for pictures; `None` without a `[[contact_patch]]`.
    pub disc_axis: Option<DiscAxis>,
}

/// Axis of the disc, from the first `[[contact_patch]]`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct DiscAxis {
    pub axis_point_m: [f64; 3],
    /// Direction of the axis, of any length. At positive speed the disc turns about it by the right-hand rule.
    pub axis_direction: [f64; 3],
    /// Normal from disc to pad, of any length.
    pub normal: [f64; 3],
}

/// The contact of a model made of substructures.
#[derive(Clone, Debug)]
pub struct Contact {
    /// The contact pairs, in the coordinates of the model.
    pub pairs: ContactPairs,
    /// Residual flexibility of the truncated modes at the pairs, if used.
    pub residual: Option<ResidualFlexibility>,
    /// Places of the pairs, for pictures; empty if they have none.
    pub places: Vec<PairPlace>,
}

/// Where a contact pair is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairPlace {
    /// Position of the node of the pad, m.
    pub at_m: [f64; 3],
    /// Normal from disc to pad.
    pub normal: [f64; 3],
}

/// How the contact stiffness follows the load.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoadExponent {
    /// Table of the rig file that holds it: `load`, the exponent of the load in the stiffness, or `contact_state`, that of
    /// the closure in the force.
    pub table: &'static str,
    /// The exponent.
    pub value: f64,
    /// The range that it may have.
    pub range: [f64; 2],
}

/// Displacement shapes of one side in the coordinates of the model.
#[derive(Clone, Debug)]
pub struct SideShapes {
    /// `pad` or `disc`.
    pub name: &'static str,
    /// Index of the model's coordinate that corresponds to the first column of `phi`.
    pub first_coordinate: usize,
    /// `Φ`: degrees of freedom by coordinates, kg^-1/2. If `nodes_m` is not empty, rows are x, y and z of each node.
    pub phi: Mat<f64>,
    /// Positions of the interface nodes, m; empty if the degrees of freedom have no positions.
    pub nodes_m: Vec<[f64; 3]>,
}

/// A file of a rig: name and content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RigFile {
    /// Relative path, as written in the rig file.
    pub name: String,
    pub bytes: Vec<u8>,
}

/// Closed ranges of the inputs that a node accepts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    pub normal_load_n: [f64; 2],
    pub disc_speed_rad_s: [f64; 2],
    pub friction_coefficient: [f64; 2],
}

/// Why an operating point is outside the limits of the rig.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum OutOfLimits {
    #[error("{name} is {value}, expected a finite number")]
    NotFinite { name: &'static str, value: f64 },
    #[error("{name} is {value}, expected {low} to {high}")]
    Range { name: &'static str, value: f64, low: f64, high: f64 },
}

impl Limits {
    /// Checks that every condition of `point` is finite and within its limits.
    ///
    /// # Errors
    /// [`OutOfLimits`], naming the first condition that is not.
    pub fn check(&self, point: &OperatingPoint) -> Result<(), OutOfLimits> {
        let checks = [
            ("normal_load_n", point.normal_load_n, self.normal_load_n),
            ("disc_speed_rad_s", point.disc_speed_rad_s, self.disc_speed_rad_s),
            ("friction_coefficient", point.friction_coefficient, self.friction_coefficient),
        ];
        for (name, value, [low, high]) in checks {
            if !value.is_finite() {
                return Err(OutOfLimits::NotFinite { name, value });
            }
            if !(low..=high).contains(&value) {
                return Err(OutOfLimits::Range { name, value, low, high });
            }
        }
        Ok(())
    }
}

/// Closed ranges of the conditions that the basis of a rig was sampled over; `None` if the file does not give one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MadeFor {
    pub friction_coefficient: Option<[f64; 2]>,
    pub normal_load_n: Option<[f64; 2]>,
    pub disc_speed_rad_s: Option<[f64; 2]>,
}

/// Ranges of load and speed that the chart covers, and its tolerance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChartRange {
    pub normal_load_n: [f64; 2],
    pub disc_speed_rad_s: [f64; 2],
    /// Largest relative error of `λ²` on the chart.
    pub tolerance: f64,
}

impl MadeFor {
    /// Whether `p` is outside the sampled range. Load and speed count only if the coefficients of `model` depend on
    /// them: then vectors sampled at one value need not be accurate at another.
    fn is_left_at(&self, model: &Model, p: &OperatingPoint) -> bool {
        let outside =
            |range: Option<[f64; 2]>, value: f64| range.is_some_and(|[low, high]| value < low || value > high);
        let (load, speed) = model.depends_on_load_and_speed();
        let friction = match model.contact_state(p) {
            ContactState::Open => return true,
            ContactState::NotSliding => 0.0,
            ContactState::Sliding => p.disc_speed_rad_s.signum() * p.friction_coefficient,
        };
        outside(self.friction_coefficient, friction)
            || load && outside(self.normal_load_n, p.normal_load_n)
            || speed && outside(self.disc_speed_rad_s, p.disc_speed_rad_s.abs())
    }
}

impl Rig {
    /// Loads the embedded rig of that name ([`EMBEDDED`]), otherwise the rig file at that path.
    ///
    /// # Errors
    /// [`RigError`], naming file, field, value and limit.
    pub fn load(name_or_path: &str) -> Result<Self, RigError> {
        if let Some(embedded) = Embedded::named(name_or_path) {
            return Self::from_files(&embedded.files());
        }
        let path = std::path::Path::new(name_or_path);
        let bytes = input_file::read(path, input_file::TOML).map_err(|error| RigError::NoSuchRig {
            value: name_or_path.to_owned(),
            reason: error.to_string(),
            limit: Embedded::names(),
        })?;
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let directory = path.parent().unwrap_or(std::path::Path::new(""));
        let rig = Self::build(
            RigFile { name, bytes },
            &|name| input_file::read(&directory.join(name), input_file::RIG_PART).map_err(|error| error.to_string()),
            "a readable file, relative to the rig file",
            None,
        )?;
        Ok(Self { path: Some(path.to_owned()), ..rig })
    }

    /// Reads a rig from files in memory: first the rig file, then all files it refers to, under the names it uses.
    ///
    /// # Errors
    /// [`RigError`], naming file, field, value and limit.
    pub fn from_files(files: &[RigFile]) -> Result<Self, RigError> {
        Self::from_files_at(files, None)
    }

    fn from_files_at(files: &[RigFile], temperature_c: Option<f64>) -> Result<Self, RigError> {
        let (first, others) = files.split_first().ok_or_else(|| RigError::NoSuchRig {
            value: "no files at all".to_owned(),
            reason: "the list of files is empty".to_owned(),
            limit: Embedded::names(),
        })?;
        let read = |name: &str| match others.iter().find(|file| file.name == name) {
            Some(file) => Ok(file.bytes.clone()),
            None => Err("it is not among the files of the rig".to_owned()),
        };
        let names: Vec<&str> = others.iter().map(|file| file.name.as_str()).collect();
        let limit =
            if names.is_empty() { "a file of the rig".to_owned() } else { format!("one of {}", names.join(", ")) };
        Self::build(first.clone(), &read, &limit, temperature_c)
    }

    /// Builds a rig at `temperature_c`, by default that of its reference.
    fn build(
        rig_file: RigFile,
        read: &dyn Fn(&str) -> Result<Vec<u8>, String>,
        limit: &str,
        temperature_c: Option<f64>,
    ) -> Result<Self, RigError> {
        let mut raw: raw::RawRig = raw::parse(&rig_file.name, &rig_file.bytes)?;
        let mut temperature = Temperature::read(&rig_file.name, &raw)?;
        if let (Some(temperature), Some(present_c)) = (&mut temperature, temperature_c) {
            *temperature = temperature.at(present_c);
            temperature.apply(&mut raw);
        }
        let mut source = Source::new(rig_file, read, limit);
        let settings = settings::check(&source.rig_file, &raw.common())?;
        let mut built = match settings::kind(&source.rig_file, &raw)? {
            settings::Kind::Inline { pad, disc, contacts } => {
                let state = contact_state::read(&mut source, &raw)?;
                inline::build(&source.rig_file, pad, disc, contacts, state, &settings)?
            }
            settings::Kind::Modal { pad, disc, patches } => {
                modal::build(&mut source, pad, disc, patches, &raw, &settings)?
            }
            settings::Kind::System(system) => system::build(&mut source, system, &settings)?,
        };
        if let Some(basis) = &raw.basis {
            built.contents.extend(basis.describe(&source.rig_file)?);
        }
        built.contents.extend(temperature.iter().flat_map(Temperature::describe));
        let disc_axis = raw.contact_patch.iter().flatten().next().map(|patch| DiscAxis {
            axis_point_m: patch.axis_point_m,
            axis_direction: patch.axis_direction,
            normal: patch.normal,
        });
        let certified = raw.reduction.as_ref().map(|reduction| match built.model.statics() {
            Some(_) if reduction.max_force_error.is_none() => {
                format!("{}; with every pair always closed", reduction.summary())
            }
            _ => reduction.summary(),
        });
        Ok(Self {
            name: raw.name,
            model: built.model,
            contact: built.contact,
            reference: settings.reference,
            band_max_hz: built.band_max_hz,
            mu_max: settings.mu_max,
            instability_threshold: settings.instability_threshold,
            limits: settings.limits,
            warning: settings.warning,
            chart: settings.chart,
            temperature,
            path: None,
            content_hash: source.content_hash(),
            files: source.into_files(),
            contents: built.contents.into_iter().chain(certified).collect(),
            reduction: raw.reduction,
            basis_tolerance: raw.basis.as_ref().and_then(|basis| basis.tolerance),
            made_for: raw.basis.as_ref().map(|basis| MadeFor {
                friction_coefficient: basis.friction_coefficient,
                normal_load_n: basis.normal_load_n,
                disc_speed_rad_s: basis.disc_speed_rad_s,
            }),
            shapes: built.shapes,
            disc_axis,
        })
    }

    /// Notes for a prediction at `p`: the state of the contact, whether `p` or the temperature is outside the range of the
    /// rig's basis, and whether the temperature is outside the tables of `[temperature]`.
    pub fn notes(&self, p: &OperatingPoint) -> impl Iterator<Item = &'static str> {
        let softened = self.temperature.as_ref().is_some_and(|t| t.factors().contact_stiffness != 1.0);
        let beyond = self.made_for.is_some_and(|made_for| softened || made_for.is_left_at(&self.model, p));
        let beyond = beyond.then_some("beyond the conditions that the basis was made for");
        let heat = self.temperature.as_ref().is_some_and(Temperature::is_beyond_a_table);
        let heat = heat.then_some("temperature beyond the tables of the rig: factors of their ends");
        self.model.contact_state(p).note().into_iter().chain(beyond).chain(heat)
    }

    /// Contact stiffness as listed in the rig file, N/m: one value per contact or patch, or one per pair of a patch.
    pub fn contact_stiffness_n_per_m(&self) -> Vec<f64> {
        let mut listed = vec![];
        self.visit_contact_stiffness(&mut |value| {
            listed.push(value);
            value
        });
        listed
    }

    /// Checks that the contact stiffness of the rig file determines the contact forces.
    ///
    /// # Errors
    /// [`RigError::Kind`] if the law of the rig's `[contact_state]` has no stiffness.
    pub fn has_stiffness_to_scale(&self) -> Result<(), RigError> {
        let law = match self.model.statics().map(|statics| &statics.parts().law) {
            None => return Ok(()),
            Some(PressureLaw::Linear { .. } | PressureLaw::Power { .. } | PressureLaw::Exponential { .. }) => {
                return Ok(());
            }
            Some(PressureLaw::Table(_)) => "table",
        };
        Err(RigError::Kind {
            file: self.name.clone(),
            field: "contact_state.law".to_owned(),
            value: format!("is \"{law}\", in which no stiffness can be changed"),
            limit: "linear, power or exponential".to_owned(),
        })
    }

    /// Whether the stiffness of the contact at a load is inversely proportional to the roughness height of its law.
    fn stiffens_with_smoothness(&self) -> bool {
        match self.model.statics().map(|statics| &statics.parts().law) {
            Some(PressureLaw::Exponential { .. }) => true,
            Some(PressureLaw::Linear { .. } | PressureLaw::Power { .. } | PressureLaw::Table(_)) | None => false,
        }
    }

    /// The stiffness that [`Self::with_contact_stiffness_times`] multiplies, of each pair: that of the rig file; of an
    /// exponential law the tangent stiffness at the load `normal_load_n` without friction.
    ///
    /// # Errors
    /// [`RigError::ContactState`] if there is no state without friction.
    pub fn stiffness_to_scale(&self, normal_load_n: f64) -> Result<Vec<f64>, RigError> {
        match self.model.statics().filter(|_| self.stiffens_with_smoothness()) {
            None => Ok(self.contact_stiffness_n_per_m()),
            Some(statics) => {
                let refused = |source| RigError::ContactState { file: self.name.clone(), source };
                Ok(statics.state(normal_load_n, 0.0).map_err(refused)?.tangent_n_per_m)
            }
        }
    }

    /// The same rig with the stiffness of every contact pair multiplied by `factor`. That of an exponential law is
    /// proportional to the force of the pair over the roughness height, which is divided.
    ///
    /// # Errors
    /// [`RigError`] if the rig's own files cannot be read again, if `factor` takes the stiffness out of range, or if the
    /// law of its `[contact_state]` has no stiffness.
    pub fn with_contact_stiffness_times(&self, factor: f64) -> Result<Self, RigError> {
        self.has_stiffness_to_scale()?;
        let text = if self.stiffens_with_smoothness() {
            self.with_roughness(&mut |height| height / factor)
        } else {
            self.visit_contact_stiffness(&mut |value| factor * value)
        };
        let Some(text) = text else { return Ok(self.clone()) };
        let mut files = self.files.clone();
        files[0].bytes = text.into_bytes();
        Self::from_files_at(&files, self.temperature_c())
    }

    /// The model with the stiffness of every contact pair multiplied by `factor`, valid only at a friction coefficient
    /// of 0. Faster than [`Rig::with_contact_stiffness_times`]: no file is read, and a flexible contact is not fitted
    /// over `μ`.
    ///
    /// # Errors
    /// [`RigError::Model`], [`RigError::ContactState`] if `factor` takes the contact out of range; [`RigError::Kind`] if
    /// the law of the rig's `[contact_state]` has no stiffness.
    pub fn at_rest_with_contact_stiffness_times(&self, factor: f64) -> Result<Model, RigError> {
        let Some(Contact { pairs, residual, places: _ }) = &self.contact else { return Ok(self.model.clone()) };
        self.has_stiffness_to_scale()?;
        let mut pairs = pairs.clone();
        // The damping of an exponential law is a property of the material, not of its roughness height.
        if !self.stiffens_with_smoothness() {
            pairs.stiffness_n_per_m.iter_mut().for_each(|stiffness| *stiffness *= factor);
        }
        let free = self.model.without_contact();
        match (self.model.statics(), residual) {
            (Some(statics), residual) => {
                let mut parts = statics.parts().clone();
                match &mut parts.law {
                    PressureLaw::Exponential { roughness_m, .. } => *roughness_m /= factor,
                    PressureLaw::Linear { .. } | PressureLaw::Power { .. } | PressureLaw::Table(_) => {
                        parts.area.iter_mut().for_each(|stiffness| *stiffness *= factor);
                    }
                }
                let statics =
                    Statics::new(parts).map_err(|source| RigError::ContactState { file: self.name.clone(), source })?;
                free.with_steady_contact(&pairs, Arc::new(statics), residual.as_ref())
            }
            (None, Some(residual)) => free.with_flexible_contact_at_rest(&pairs, residual),
            (None, None) => free.with_contact(&pairs),
        }
        .map_err(|source| RigError::Model { file: self.name.clone(), source })
    }

    /// The exponent with which the contact stiffness of the rig follows the load or the closure, with the range that it may
    /// have; `None` for laws without one.
    pub fn load_exponent(&self) -> Option<LoadExponent> {
        match self.model.statics().map(|statics| &statics.parts().law) {
            Some(PressureLaw::Power { exponent, .. }) => {
                Some(LoadExponent { table: "contact_state", value: *exponent, range: [1.0, 10.0] })
            }
            Some(PressureLaw::Linear { .. } | PressureLaw::Exponential { .. } | PressureLaw::Table(_)) => None,
            None => match &self.contact {
                // A flexible contact has a stiffness independent of the load.
                Some(Contact { residual: None, .. }) => {
                    let value = self.model.contact_law().exponent;
                    Some(LoadExponent { table: "load", value, range: [-1.0, 2.0] })
                }
                Some(Contact { residual: Some(_), .. }) | None => None,
            },
        }
    }

    /// The same rig with another [`Self::load_exponent`].
    ///
    /// # Errors
    /// [`RigError`] if the rig's own files cannot be read again.
    pub fn with_load_exponent(&self, exponent: f64) -> Result<Self, RigError> {
        let changed = self.load_exponent().and_then(|LoadExponent { table: name, .. }| {
            let text = std::str::from_utf8(&self.files.first()?.bytes).ok()?;
            let mut table: toml::Table = text.parse().ok()?;
            let of_load = table.entry(name).or_insert_with(|| toml::Table::new().into());
            of_load.as_table_mut()?.insert("exponent".to_owned(), exponent.into());
            Some(table.to_string())
        });
        let Some(text) = changed else { return Ok(self.clone()) };
        let mut files = self.files.clone();
        files[0].bytes = text.into_bytes();
        Self::from_files_at(&files, self.temperature_c())
    }

    /// The text of the rig file with `change` applied to the roughness height of its law; `None` if the file cannot be parsed.
    fn with_roughness(&self, change: &mut dyn FnMut(f64) -> f64) -> Option<String> {
        let text = std::str::from_utf8(&self.files.first()?.bytes).ok()?;
        let mut table: toml::Table = text.parse().ok()?;
        change_numbers(table.get_mut("contact_state")?.get_mut("roughness_m")?, change);
        Some(table.to_string())
    }

    /// The text of the rig file with `change` applied to every contact stiffness; `None` if the file cannot be parsed.
    fn visit_contact_stiffness(&self, change: &mut dyn FnMut(f64) -> f64) -> Option<String> {
        let text = std::str::from_utf8(&self.files.first()?.bytes).ok()?;
        let mut table: toml::Table = text.parse().ok()?;
        for key in ["contact", "contact_patch"] {
            for contact in table.get_mut(key).and_then(toml::Value::as_array_mut).into_iter().flatten() {
                if let Some(stiffness) = contact.get_mut("stiffness_n_per_m") {
                    change_numbers(stiffness, change);
                }
            }
        }
        Some(table.to_string())
    }

    /// A description of the rig, in a few lines of text.
    pub fn describe(&self) -> String {
        let mut lines = vec![format!("rig        {}", self.name)];
        lines.extend(self.contents.iter().cloned());
        lines.push(match self.band_max_hz {
            Some(max_hz) => format!("band       up to {max_hz} Hz"),
            None => "band       all modes".to_owned(),
        });
        lines.push(format!("search     friction coefficient 0 to {}", self.mu_max));
        lines.push(format!(
            "reference  {} N, {} rad/s, friction coefficient {}",
            self.reference.normal_load_n, self.reference.disc_speed_rad_s, self.reference.friction_coefficient
        ));
        let names: Vec<&str> = self.files.iter().map(|file| file.name.as_str()).collect();
        lines.push(format!("files      {}", names.join(", ")));
        lines.push(format!("hash       {}", self.content_hash));
        lines.join("\n")
    }
}

/// Applies `change` to a number, or to every number of a list.
fn change_numbers(value: &mut toml::Value, change: &mut dyn FnMut(f64) -> f64) {
    if let toml::Value::Array(values) = value {
        values.iter_mut().for_each(|value| change_numbers(value, change));
    } else if let Some(number) = value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64)) {
        *value = toml::Value::Float(change(number));
    }
}

/// The result of building a rig of any kind.
struct Built {
    model: Model,
    contact: Option<Contact>,
    contents: Vec<String>,
    shapes: Vec<SideShapes>,
    /// `[band] max_hz`, or the cut-off of the model if that is lower.
    band_max_hz: Option<f64>,
}
