//! The serde form of rig files: every key, checked only for its type.

use serde::Deserialize;

use super::RigError;
use super::certificate::Certificate;
use super::temperature::RawTemperature;
pub use super::warning::Warning;
use crate::files::input_file;

/// The format of rig files and full models that this program reads. A file without the key `format` has format 1.
pub const FORMAT: i64 = 1;

/// Calls `$define` with the tables that rig files and full models share, each of which has defaults, then with the rest.
macro_rules! with_common_tables {
    ($define:ident! { $($rest:tt)* }) => {
        $define! {
            [
                reference: RawReference,
                band: RawBand,
                search: RawSearch,
                friction: RawFriction,
                load: RawLoad,
                limits: RawLimits,
                warning: Warning,
                chart: RawChart,
            ]
            $($rest)*
        }
    };
}

/// Declares the tables that rig files and full models share.
macro_rules! define_common {
    ([$($table:ident: $type:ident,)*]) => {
        /// The tables that rig files and full models share.
        #[derive(Clone, Debug)]
        pub struct Common { $(pub $table: $type,)* }

        impl Common {
            /// Their names.
            pub const TABLES: &[&str] = &[$(stringify!($table)),*];
        }
    };
}

/// Declares a file with the common tables and tables of its own.
macro_rules! define_file {
    ([$($table:ident: $type:ident,)*] $(#[$doc:meta])* $name:ident { $($own:ident: $own_type:ty,)* }) => {
        $(#[$doc])*
        #[derive(Debug, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            pub name: String,
            /// Format of the file; [`crate::rig::raw::parse`] has checked it.
            #[serde(default, rename = "format")]
            _format: Option<i64>,
            $(#[serde(default)] pub $table: $crate::rig::raw::$type,)*
            $(pub $own: $own_type,)*
        }

        impl $name {
            /// A copy of the common tables.
            pub fn common(&self) -> $crate::rig::raw::Common {
                $crate::rig::raw::Common { $($table: self.$table.clone(),)* }
            }
        }
    };
}

pub(crate) use {define_file, with_common_tables};

with_common_tables!(define_common! {});
with_common_tables!(define_file! {
    /// A whole rig file.
    RawRig {
        pad: Option<RawSubstructure>,
        disc: Option<RawSubstructure>,
        contact: Option<Vec<RawContact>>,
        contact_patch: Option<Vec<RawPatch>>,
        system: Option<RawSystem>,
        residual: Option<RawResidual>,
        contact_state: Option<RawContactState>,
        temperature: Option<RawTemperature>,
        basis: Option<RawBasis>,
        reduction: Option<Certificate>,
    }
});

/// Declares a table in which every key has a default.
macro_rules! table_with_defaults {
    ($(#[$doc:meta])* $name:ident { $($field:ident: $type:ty = $default:expr,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Debug, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name { $(pub $field: $type,)* }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default,)* }
            }
        }
    };
}

table_with_defaults! {
    /// `[reference]`; defaults are the paper's test conditions.
    RawReference { normal_load_n: f64 = 500.0, disc_speed_rad_s: f64 = 13.0, friction_coefficient: f64 = 0.35, }
}
table_with_defaults! {
    /// `[band]`.
    RawBand { max_hz: Option<f64> = None, }
}
table_with_defaults! {
    /// `[search]`.
    RawSearch { mu_max: f64 = 2.0, instability_threshold: f64 = 1e-6, }
}
table_with_defaults! {
    /// `[friction]`.
    RawFriction {
        slope_s_per_m: f64 = 0.0,
        stribeck_drop: f64 = 0.0,
        stribeck_speed_m_s: Option<f64> = None,
        stribeck_exponent: f64 = 2.0,
        lateral_damping: bool = false,
    }
}
table_with_defaults! {
    /// `[load]`: `k = k_ref (N / reference_n)^exponent`.
    RawLoad { exponent: f64 = 0.0, reference_n: f64 = 500.0, }
}
table_with_defaults! {
    /// `[limits]`: closed ranges of the inputs that the node accepts.
    RawLimits {
        normal_load_n: [f64; 2] = [0.0, 1e6],
        disc_speed_rad_s: [f64; 2] = [-1e4, 1e4],
        friction_coefficient: [f64; 2] = [0.0, 2.0],
    }
}
table_with_defaults! {
    /// `[chart]`: the box of conditions that the chart covers.
    RawChart {
        normal_load_n: [f64; 2] = [50.0, 2000.0],
        disc_speed_rad_s: [f64; 2] = [1.0, 60.0],
        tolerance: f64 = 1e-8,
    }
}

/// `[pad]` or `[disc]`: matrices written out, or a file of modal data.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawSubstructure {
    pub mass: Option<Vec<Vec<f64>>>,
    pub stiffness: Option<Vec<Vec<f64>>>,
    pub modal: Option<String>,
    pub damping_ratio: Option<OneOrMany>,
    pub modes: Option<RawModes>,
}

/// `[contact_state]`: contact pairs that open and close with the state of steady sliding.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawContactState {
    pub law: String,
    pub measured: String,
    pub exponent: Option<f64>,
    pub reference_m: Option<f64>,
    pub roughness_m: Option<f64>,
    pub pressure_pa: Option<f64>,
    /// Name of a CSV file.
    pub table: Option<String>,
    pub area_m2: Option<OneOrMany>,
    pub gap_m: Option<OneOrMany>,
    pub load_pad: Option<Vec<f64>>,
    pub load_coordinates: Option<Vec<f64>>,
    pub residual_gap_m_per_n: Option<OneOrMany>,
    /// Name of an `.npz` archive, for a shared basis.
    pub statics: Option<String>,
    /// Name of a CSV or Matrix Market file, for a full model.
    pub load_file: Option<String>,
    /// Labels of nodes of the pad of a full model, and the direction of the load on them.
    pub load_nodes: Option<Vec<u64>>,
    pub load_direction: Option<[f64; 3]>,
    /// Factor on the closures of `table` at the temperature of the rig.
    #[serde(skip)]
    pub table_closures_times: Option<f64>,
}

/// `[residual]`: residual flexibility between the contact pairs.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawResidual {
    /// Name of an `.npz` archive.
    pub pairs: String,
}

/// One value for all, or one for each.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged, expecting = "expected a number or a list of numbers")]
pub enum OneOrMany {
    One(f64),
    Many(Vec<f64>),
}

/// The `k` lowest modes, or a list of modes counted from 0.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged, expecting = "expected a number of modes or a list of modes counted from 0")]
pub enum RawModes {
    Lowest(usize),
    Indices(Vec<usize>),
}

/// `[[contact]]`: one pair between inline substructures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawContact {
    pub pad_normal: Vec<f64>,
    pub pad_sliding: Vec<f64>,
    pub disc_normal: Option<Vec<f64>>,
    pub disc_sliding: Option<Vec<f64>>,
    pub pad_lateral: Option<Vec<f64>>,
    pub disc_lateral: Option<Vec<f64>>,
    #[serde(default)]
    pub stiffness_n_per_m: f64,
    #[serde(default)]
    pub damping_n_s_per_m: f64,
    #[serde(default)]
    pub radius_m: f64,
}

/// `[[contact_patch]]`: contact between modal substructures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawPatch {
    pub axis_point_m: [f64; 3],
    pub axis_direction: [f64; 3],
    pub normal: [f64; 3],
    pub stiffness_n_per_m: OneOrMany,
    #[serde(default = "no_damping")]
    pub damping_n_s_per_m: OneOrMany,
    pub pad_nodes: Option<Vec<usize>>,
    pub disc_nodes: Option<Vec<usize>>,
    pub search_distance_m: Option<f64>,
}

fn no_damping() -> OneOrMany {
    OneOrMany::One(0.0)
}

/// `[system]`: sums of matrices, each times a scale.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawSystem {
    pub mass: String,
    pub modes: Option<usize>,
    #[serde(default)]
    pub damping: Vec<RawTerm>,
    #[serde(default)]
    pub stiffness: Vec<RawTerm>,
}

/// `[basis]`: the rig is a projection of the full model on a basis. Holds the range of conditions it was sampled over
/// and its errors at held-out points.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawBasis {
    /// Whether pad and disc share their coordinates.
    pub shared: bool,
    pub degrees_of_freedom: Option<usize>,
    pub friction_coefficient: Option<[f64; 2]>,
    pub normal_load_n: Option<[f64; 2]>,
    pub disc_speed_rad_s: Option<[f64; 2]>,
    pub growth_floor_per_s: Option<f64>,
    pub tolerance: Option<f64>,
    pub held_out: Option<usize>,
    pub largest_error: Option<f64>,
}

/// A matrix file and its scale.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawTerm {
    pub matrix: String,
    #[serde(default = "one")]
    pub scale: String,
}

fn one() -> String {
    "1".to_owned()
}

/// The format of a file that does not say its own.
fn first_format() -> i64 {
    1
}

/// The key `format` of a file whose other keys may be unknown.
#[derive(Deserialize)]
struct Versioned {
    #[serde(default = "first_format")]
    format: i64,
}

/// Refuses a file of a format that this program does not read.
///
/// # Errors
/// [`RigError::Format`].
fn check_format(file: &str, format: i64) -> Result<(), RigError> {
    if format == FORMAT {
        return Ok(());
    }
    Err(RigError::Format { file: file.to_owned(), value: format, limit: FORMAT })
}

/// Parses the TOML text of a rig file or of a full model.
///
/// # Errors
/// [`RigError::TooLong`], [`RigError::Syntax`], [`RigError::Format`], [`RigError::UnknownKey`], [`RigError::MissingKey`].
pub fn parse<T: serde::de::DeserializeOwned>(file: &str, bytes: &[u8]) -> Result<T, RigError> {
    if bytes.len() as u64 > input_file::TOML {
        return Err(RigError::TooLong { file: file.to_owned(), bytes: bytes.len(), limit: input_file::TOML });
    }
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let line = 1 + bytes.iter().take(error.valid_up_to()).filter(|byte| **byte == b'\n').count();
        let value = format!("bytes that are not UTF-8 ({error})");
        RigError::Syntax { file: file.to_owned(), line, value, limit: "TOML text".to_owned() }
    })?;
    // First, because a file of a later format may have keys that are unknown here. What is no TOML, or has another type of
    // `format`, is reported below with its line.
    if let Ok(Versioned { format }) = toml::from_str(text) {
        check_format(file, format)?;
    }
    toml::from_str(text).map_err(|error| {
        let span = error.span().unwrap_or_default();
        let line = 1 + bytes.iter().take(span.start).filter(|byte| **byte == b'\n').count();
        explain(file, line, error.message(), text.get(span).unwrap_or_default())
    })
}

/// Translates a message of the TOML parser into the matching [`RigError`].
fn explain(file: &str, line: usize, message: &str, found: &str) -> RigError {
    let file = file.to_owned();
    let quoted = |prefix: &str| message.strip_prefix(prefix).and_then(|rest| rest.split_once('`'));
    if let Some((field, rest)) = quoted("unknown field `") {
        let limit = rest.trim_start_matches(", expected ").to_owned();
        return RigError::UnknownKey { file, line, field: field.to_owned(), limit };
    }
    if let Some((field, _)) = quoted("missing field `") {
        let limit = format!("it in the table of line {line}");
        return RigError::MissingKey { file, field: field.to_owned(), limit };
    }
    // The parser's message for a value that may have one of several types.
    if let Some(limit) = message.strip_prefix("expected ") {
        return RigError::Syntax { file, line, value: format!("the value {found}"), limit: limit.to_owned() };
    }
    match message.split_once(", expected ") {
        Some((value, limit)) => RigError::Syntax { file, line, value: value.to_owned(), limit: limit.to_owned() },
        None => {
            RigError::Syntax { file, line, value: message.trim().replace('\n', ", "), limit: "valid TOML".to_owned() }
        }
    }
}
