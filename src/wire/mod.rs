//! The messages of `msgs/`: their form on ROS 2 and in recordings, and their shared-memory forms.
//!
//! The structs below match the `.msg` files field by field; serde gives their CDR encoding.

pub mod schema;
pub mod shm;

use serde::{Deserialize, Serialize};

use crate::physics;

/// Topic names in recordings, and on ROS 2 for a node in the namespace `/`.
pub mod topic {
    /// Operating points, received by the node.
    pub const OPERATING_POINT: &str = "/rig/operating_point";
    /// Measured vibration, received by the node; it does not affect predictions.
    pub const VIBRATION: &str = "/rig/vibration";
    /// Predictions, published by the node.
    pub const PREDICTION: &str = "/squealcast/prediction";
    /// Description of the node's rig; transient local.
    pub const RIG: &str = "/squealcast/rig";
    /// Session events. They are meant for recordings and need not be transient local.
    pub const SESSION_EVENT: &str = "/squealcast/session_event";
    /// Sensitivities of predictions to conditions and contact.
    pub const SENSITIVITY: &str = "/squealcast/sensitivity";
    /// Diagnostics of the node.
    pub const DIAGNOSTICS: &str = "/diagnostics";

    /// History depth of a publisher, in messages; 1 on [`RIG`].
    pub const DEPTH: i32 = 64;

    /// The topic name relative to the node's namespace, as the node requests it from ROS 2. Diagnostics alone stay
    /// absolute: by ROS convention they are one topic for all namespaces.
    pub fn relative(topic: &str) -> &str {
        if topic == DIAGNOSTICS { topic } else { topic.trim_start_matches('/') }
    }
}

/// Largest number of modes in a [`Prediction`].
pub const MAX_MODES: usize = 64;

/// `builtin_interfaces/Time`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Time {
    pub sec: i32,
    pub nanosec: u32,
}

/// `std_msgs/Header`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    pub stamp: Time,
    pub frame_id: String,
}

/// `squealcast_msgs/OperatingPoint`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OperatingPoint {
    pub header: Header,
    pub seq: u64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
}

/// `squealcast_msgs/Vibration`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Vibration {
    pub header: Header,
    pub frequency_hz: f64,
    pub level_db: f64,
}

/// `squealcast_msgs/Mode`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Mode {
    pub id: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
    pub damping_ratio: f64,
    pub pad_participation: f64,
    pub residual: f64,
    pub frequency_error_hz: f64,
    pub growth_rate_error_per_s: f64,
}

/// `squealcast_msgs/Prediction`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    pub header: Header,
    pub input_seq: u64,
    pub level: u8,
    pub reused: bool,
    pub unstable_modes: u32,
    pub max_growth_rate_per_s: f64,
    pub worst_frequency_hz: f64,
    pub critical_friction: f64,
    pub friction_margin: f64,
    pub friction_margin_error: f64,
    pub reason: String,
    pub modes: Vec<Mode>,
}

/// `squealcast_msgs/Derivatives`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Derivatives {
    pub by_friction_coefficient: f64,
    pub by_normal_load_n: f64,
    pub by_disc_speed_rad_s: f64,
    pub by_contact_stiffness: f64,
    pub by_contact_damping: f64,
}

/// `squealcast_msgs/ModeSensitivity`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ModeSensitivity {
    pub id: u32,
    pub law: u8,
    pub frequency_hz: Derivatives,
    pub growth_rate_per_s: Derivatives,
}

/// The values of [`ModeSensitivity::law`].
pub mod sensitivity_law {
    pub const LINEAR: u8 = 0;
    pub const SQUARE_ROOT: u8 = 1;
}

/// `squealcast_msgs/PairSensitivity`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PairSensitivity {
    pub first_id: u32,
    pub second_id: u32,
    pub squares: bool,
    pub mean_real: f64,
    pub mean_imaginary: f64,
    pub discriminant_real: f64,
    pub discriminant_imaginary: f64,
    pub mean_real_derivatives: Derivatives,
    pub mean_imaginary_derivatives: Derivatives,
    pub discriminant_real_derivatives: Derivatives,
    pub discriminant_imaginary_derivatives: Derivatives,
}

/// `squealcast_msgs/Sensitivity`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sensitivity {
    pub header: Header,
    pub input_seq: u64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    pub nearest_window_end: f64,
    pub nearest_window_end_derivatives: Derivatives,
    pub modes: Vec<ModeSensitivity>,
    pub pairs: Vec<PairSensitivity>,
}

/// The values of [`Prediction::level`].
pub mod level {
    pub const OK: u8 = 0;
    pub const WARN: u8 = 1;
    pub const SQUEAL: u8 = 2;
    pub const FAULT: u8 = 3;

    /// The name of a level.
    pub fn name(level: u8) -> &'static str {
        match level {
            OK => "OK",
            WARN => "WARN",
            SQUEAL => "SQUEAL",
            _ => "FAULT",
        }
    }
}

/// `squealcast_msgs/RigInfo`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RigInfo {
    pub name: String,
    pub content_hash: String,
    pub version: String,
    pub mode_count: u32,
    pub band_max_hz: f64,
    pub reduction: String,
}

/// `squealcast_msgs/SessionEvent`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SessionEvent {
    pub header: Header,
    pub kind: u8,
    pub name: String,
    pub value: f64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub hash: String,
}

/// The values of [`SessionEvent::kind`].
pub mod event_kind {
    pub const PARAMETER: u8 = 0;
    pub const SILENCE: u8 = 1;
    pub const STABILITY_MAP: u8 = 2;
    pub const CHART: u8 = 3;
    pub const WINDOW_ENDS: u8 = 4;
}

/// `diagnostic_msgs/DiagnosticArray`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticArray {
    pub header: Header,
    pub status: Vec<DiagnosticStatus>,
}

/// `diagnostic_msgs/DiagnosticStatus`; level OK=0, WARN=1, ERROR=2, STALE=3.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    pub level: u8,
    pub name: String,
    pub message: String,
    pub hardware_id: String,
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/KeyValue`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyValue {
    pub key: String,
    pub value: String,
}

impl Derivatives {
    /// All derivatives unknown (NaN).
    pub const UNKNOWN: Self = Self {
        by_friction_coefficient: f64::NAN,
        by_normal_load_n: f64::NAN,
        by_disc_speed_rad_s: f64::NAN,
        by_contact_stiffness: f64::NAN,
        by_contact_damping: f64::NAN,
    };

    /// From derivatives in the order of [`physics::Parameter::ALL`].
    pub fn new(derivatives: [f64; 5]) -> Self {
        let [friction, load, speed, stiffness, damping] = derivatives;
        Self {
            by_friction_coefficient: friction,
            by_normal_load_n: load,
            by_disc_speed_rad_s: speed,
            by_contact_stiffness: stiffness,
            by_contact_damping: damping,
        }
    }

    /// In the order of [`physics::Parameter::ALL`].
    pub fn values(&self) -> [f64; 5] {
        [
            self.by_friction_coefficient,
            self.by_normal_load_n,
            self.by_disc_speed_rad_s,
            self.by_contact_stiffness,
            self.by_contact_damping,
        ]
    }
}

impl Time {
    /// From nanoseconds since the epoch; saturates outside the range of the message.
    pub fn from_ns(ns: i64) -> Self {
        let sec = ns.div_euclid(1_000_000_000);
        Self { sec: sec.clamp(i32::MIN.into(), i32::MAX.into()) as i32, nanosec: ns.rem_euclid(1_000_000_000) as u32 }
    }

    /// Nanoseconds since the epoch.
    pub fn as_ns(self) -> i64 {
        i64::from(self.sec) * 1_000_000_000 + i64::from(self.nanosec)
    }
}

impl OperatingPoint {
    /// The operating point as the physics uses it.
    pub fn point(&self) -> physics::OperatingPoint {
        physics::OperatingPoint {
            normal_load_n: self.normal_load_n,
            disc_speed_rad_s: self.disc_speed_rad_s,
            friction_coefficient: self.friction_coefficient,
        }
    }
}

/// The CDR encoding of a message: encapsulation header `00 01 00 00`, then little-endian CDR.
pub fn to_cdr<M: Serialize>(message: &M) -> Result<Vec<u8>, cdr_encoding::Error> {
    let mut bytes = vec![];
    write_cdr(message, &mut bytes)?;
    Ok(bytes)
}

/// Replaces the content of `bytes` by the encoding of [`to_cdr`], reusing their memory.
///
/// # Errors
/// As [`to_cdr`].
pub fn write_cdr<M: Serialize>(message: &M, bytes: &mut Vec<u8>) -> Result<(), cdr_encoding::Error> {
    bytes.clear();
    bytes.extend([0, 1, 0, 0]);
    cdr_encoding::to_writer::<_, byteorder::LittleEndian, _>(bytes, message)
}

/// Decodes a message from CDR bytes with encapsulation header, in either byte order.
pub fn from_cdr<M: for<'de> Deserialize<'de>>(bytes: &[u8]) -> Result<M, cdr_encoding::Error> {
    match bytes {
        [0, 0, _, _, payload @ ..] => Ok(cdr_encoding::from_bytes::<M, byteorder::BigEndian>(payload)?.0),
        [0, 1, _, _, payload @ ..] => Ok(cdr_encoding::from_bytes::<M, byteorder::LittleEndian>(payload)?.0),
        _ => Err(cdr_encoding::Error::Message("no plain CDR encapsulation header".to_owned())),
    }
}
