//! Rig files: raw form, validation, embedded rigs.
//!
//! A rig file is TOML (`raw`), says which of three kinds it is by the tables it has, and is built into a [`Rig`]:
//! `inline` substructures, `modal` substructures of a finite-element program (`npz` or `uff`, touching in a `patch`), or a
//! `system` of matrices (`matrix_market`, times a `scale`). What it refers to is read by name through `source`, so
//! that a recording's attachments serve as well as a directory.

mod basis;
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
pub mod uff;

use faer::Mat;

use crate::certificate::Certificate;
use crate::input_file;
use crate::physics::{ContactPairs, ContactState, Model, OperatingPoint, ResidualFlexibility};

pub use embedded::{EMBEDDED, Embedded};
pub use error::RigError;
pub use modal_data::{ModalData, Residual};
pub use patch::Pair;
pub use residual::{SideResidual, between_patches};
pub use settings::Settings;

use source::Source;

/// Everything the program knows about a rig, ready to predict with.
#[derive(Clone, Debug)]
pub struct Rig {
    /// The rig's own name.
    pub name: String,
    /// Its equation of motion, mass-normalised.
    pub model: Model,
    /// What touches; none for a system of matrices.
    pub contact: Option<Contact>,
    /// `[reference]`: the operating point used where none is given.
    pub reference: OperatingPoint,
    /// `[band] max_hz`: modes above are neither listed nor judged. At most the cut-off of a rig with residual flexibility.
    pub band_max_hz: Option<f64>,
    /// `[search] mu_max`: windows of instability are sought in `[0, mu_max]`.
    pub mu_max: f64,
    /// `[search] instability_threshold`: a root is unstable when `σ` exceeds this times `|λ|`.
    pub instability_threshold: f64,
    /// `[limits]`: what the node accepts as input.
    pub limits: Limits,
    /// `[warning]`: when the node warns.
    pub warning: Warning,
    /// `[chart]`: conditions for which predictions are prepared.
    pub chart: ChartRange,
    /// Where the rig file was read; `None` for a rig from memory.
    pub path: Option<std::path::PathBuf>,
    /// SHA-256 of the rig file and everything it refers to, hexadecimal.
    pub content_hash: String,
    /// The rig file (first) and everything it refers to, by the names it refers to them with.
    pub files: Vec<RigFile>,
    /// What the rig is made of, a line each, for [`Rig::describe`].
    pub contents: Vec<String>,
    /// `[reduction]`: how far it is from the full model it was reduced from.
    pub reduction: Option<Certificate>,
    /// `[basis] tolerance`: the largest `|Δλ|/|λ|` its basis was made to hold.
    pub basis_tolerance: Option<f64>,
    /// `[basis]`: the conditions its basis was made for.
    pub made_for: Option<MadeFor>,
    /// How the coordinates of the model move each side, for pictures; empty where only the coordinates are known.
    pub shapes: Vec<SideShapes>,
    /// Where the disc turns, for pictures; `None` where no `[[contact_patch]]` says it.
    pub disc_axis: Option<DiscAxis>,
}

/// The disc's axis as the first `[[contact_patch]]` gives it.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct DiscAxis {
    pub axis_point_m: [f64; 3],
    /// Positive speed turns right-handed about it; of any length.
    pub axis_direction: [f64; 3],
    /// From disc to pad; of any length.
    pub normal: [f64; 3],
}

/// The contact that a model of substructures was built with.
#[derive(Clone, Debug)]
pub struct Contact {
    /// The pairs, in the coordinates of the model.
    pub pairs: ContactPairs,
    /// What truncated modes do between them, where it is used.
    pub residual: Option<ResidualFlexibility>,
}

/// How a stretch of the model's coordinates moves one side of the rig.
#[derive(Clone, Debug)]
pub struct SideShapes {
    /// `pad` or `disc`.
    pub name: &'static str,
    /// The model's coordinate that belongs to the first column of `phi`.
    pub first_coordinate: usize,
    /// `Φ`: degrees of freedom by coordinates, kg^-1/2; with `nodes_m` three rows for each node.
    pub phi: Mat<f64>,
    /// Positions of the interface nodes, m; empty where degrees of freedom are only numbered.
    pub nodes_m: Vec<[f64; 3]>,
}

/// A file of a rig, as it was read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RigFile {
    /// As the rig file refers to it: a relative path.
    pub name: String,
    pub bytes: Vec<u8>,
}

/// Closed ranges of the inputs a node accepts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    pub normal_load_n: [f64; 2],
    pub disc_speed_rad_s: [f64; 2],
    pub friction_coefficient: [f64; 2],
}

/// A condition outside the rig's limits.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum OutOfLimits {
    #[error("{name} is {value}, expected a finite number")]
    NotFinite { name: &'static str, value: f64 },
    #[error("{name} is {value}, expected {low} to {high}")]
    Range { name: &'static str, value: f64, low: f64, high: f64 },
}

impl Limits {
    /// Whether every condition of `point` is finite and within its limits.
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

/// The conditions that the basis of a rig was made for, as far as its file names them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MadeFor {
    pub friction_coefficient: Option<[f64; 2]>,
    pub normal_load_n: Option<[f64; 2]>,
    pub disc_speed_rad_s: Option<[f64; 2]>,
}

/// Conditions for which predictions are prepared, where the rig depends on them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChartRange {
    pub normal_load_n: [f64; 2],
    pub disc_speed_rad_s: [f64; 2],
    /// Relative error of `λ²` that is asked for.
    pub tolerance: f64,
}

/// When the node warns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Warning {
    /// WARN when the margin to the critical friction is below this.
    pub margin: f64,
    /// SQUEAL when a mode's damping ratio falls below this (negative: growing).
    pub damping_ratio: f64,
    /// SQUEAL ends when every damping ratio is above `damping_ratio` by this much again.
    pub hysteresis: f64,
    /// FAULT after this much silence, s.
    pub silence_s: f64,
}

impl MadeFor {
    /// Whether `p` is outside, as far as what changes there matters to `model`: a vector held at one load need not hold at another.
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
    /// Loads the embedded rig of that name ([`EMBEDDED`]), else the rig file at that path.
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
        )?;
        Ok(Self { path: Some(path.to_owned()), ..rig })
    }

    /// The same from files in memory: the rig file first, then everything it refers to by the names it uses.
    ///
    /// # Errors
    /// [`RigError`], naming file, field, value and limit.
    pub fn from_files(files: &[RigFile]) -> Result<Self, RigError> {
        let (first, others) = files.split_first().ok_or_else(|| RigError::NoSuchRig {
            value: "no files at all".to_owned(),
            reason: "the list of files is empty".to_owned(),
            limit: Embedded::names(),
        })?;
        let read = |name: &str| match others.iter().find(|file| file.name == name) {
            Some(file) => Ok(file.bytes.clone()),
            None => Err("it is not among the files given".to_owned()),
        };
        let names: Vec<&str> = others.iter().map(|file| file.name.as_str()).collect();
        let limit =
            if names.is_empty() { "a file given along".to_owned() } else { format!("one of {}", names.join(", ")) };
        Self::build(first.clone(), &read, &limit)
    }

    fn build(rig_file: RigFile, read: &dyn Fn(&str) -> Result<Vec<u8>, String>, limit: &str) -> Result<Self, RigError> {
        let raw: raw::RawRig = raw::parse(&rig_file.name, &rig_file.bytes)?;
        let mut source = Source::new(rig_file, read, limit);
        let settings = settings::check(&source.rig_file, &raw)?;
        let mut built = match settings::kind(&source.rig_file, &raw)? {
            settings::Kind::Inline { pad, disc, contacts } => {
                inline::build(&source.rig_file, pad, disc, contacts, &settings)?
            }
            settings::Kind::Modal { pad, disc, patches } => {
                modal::build(&mut source, pad, disc, patches, &raw, &settings)?
            }
            settings::Kind::System(system) => system::build(&mut source, system, &settings)?,
        };
        if let Some(basis) = &raw.basis {
            built.contents.extend(basis.describe(&source.rig_file)?);
        }
        let disc_axis = raw.contact_patch.iter().flatten().next().map(|patch| DiscAxis {
            axis_point_m: patch.axis_point_m,
            axis_direction: patch.axis_direction,
            normal: patch.normal,
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
            path: None,
            content_hash: source.content_hash(),
            files: source.into_files(),
            contents: built.contents.into_iter().chain(raw.reduction.as_ref().map(Certificate::told)).collect(),
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

    /// What to know of a prediction at `p`: what the contact does there, and whether the rig's basis was made for it.
    pub fn notes(&self, p: &OperatingPoint) -> impl Iterator<Item = &'static str> {
        let beyond = self.made_for.is_some_and(|made_for| made_for.is_left_at(&self.model, p));
        let beyond = beyond.then_some("beyond the conditions that the basis was made for");
        self.model.contact_state(p).note().into_iter().chain(beyond)
    }

    /// The stiffness of the rig's contact pairs as its file lists it, N/m: one value, or one for each pair of a patch.
    pub fn contact_stiffness_n_per_m(&self) -> Vec<f64> {
        let mut listed = vec![];
        self.visit_contact_stiffness(&mut |value| {
            listed.push(value);
            value
        });
        listed
    }

    /// The same rig with the stiffness of every contact pair multiplied by `factor`.
    ///
    /// # Errors
    /// [`RigError`]: the rig's own files are at fault, or `factor` takes the stiffness out of range.
    pub fn with_contact_stiffness_times(&self, factor: f64) -> Result<Self, RigError> {
        let Some(text) = self.visit_contact_stiffness(&mut |value| factor * value) else { return Ok(self.clone()) };
        let mut files = self.files.clone();
        files[0].bytes = text.into_bytes();
        Self::from_files(&files)
    }

    /// Its model at a friction coefficient of 0, and no other, with the stiffness of every contact pair multiplied by
    /// `factor`: nothing is read or fitted again.
    ///
    /// # Errors
    /// [`RigError::Model`]: `factor` takes the contact out of range.
    pub fn at_rest_with_contact_stiffness_times(&self, factor: f64) -> Result<Model, RigError> {
        let Some(Contact { pairs, residual }) = &self.contact else { return Ok(self.model.clone()) };
        let mut pairs = pairs.clone();
        pairs.stiffness_n_per_m.iter_mut().for_each(|stiffness| *stiffness *= factor);
        let free = self.model.without_contact();
        match residual {
            Some(residual) => free.with_flexible_contact_at_rest(&pairs, residual),
            None => free.with_contact(&pairs),
        }
        .map_err(|source| RigError::Model { file: self.name.clone(), source })
    }

    /// The text of the rig file with every contact stiffness replaced by what `change` makes of it.
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

    /// What the rig is and holds, a few lines for people.
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

/// Replaces a number, or every number of a list.
fn change_numbers(value: &mut toml::Value, change: &mut dyn FnMut(f64) -> f64) {
    if let toml::Value::Array(values) = value {
        values.iter_mut().for_each(|value| change_numbers(value, change));
    } else if let Some(number) = value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64)) {
        *value = toml::Value::Float(change(number));
    }
}

/// What each kind of rig builds.
struct Built {
    model: Model,
    contact: Option<Contact>,
    contents: Vec<String>,
    shapes: Vec<SideShapes>,
    /// `[band] max_hz`, lower where the model ends below.
    band_max_hz: Option<f64>,
}
