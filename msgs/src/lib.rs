//! The messages of squealcast: what a rig sends to the node and what the node publishes.
//!
//! Every list is here once: the messages with their CDR encoding on ROS 2 and in recordings (this module), the topics
//! with their MCAP schemas ([`schema`]), their types as ROS 2 describes and hashes them ([`type_description`]), and the
//! fixed-size forms in shared memory ([`shm`]). The `.msg` files of the ROS 2
//! package `squealcast_msgs` are in the same folder; the structs match them field by field.
//!
//! A program that sends conditions over ROS 2 or writes them to a recording encodes an [`OperatingPoint`]:
//!
//! ```
//! use squealcast_msgs::{Header, OperatingPoint, Time, from_cdr, to_cdr};
//!
//! let conditions = OperatingPoint {
//!     header: Header { stamp: Time::from_ns(1_700_000_000_000_000_000), frame_id: "rig".to_owned() },
//!     seq: 1,
//!     normal_load_n: 500.0,
//!     disc_speed_rad_s: 13.0,
//!     friction_coefficient: 0.35,
//! };
//! let bytes = to_cdr(&conditions)?;
//! assert_eq!(from_cdr::<OperatingPoint>(&bytes)?, conditions);
//! # Ok::<(), squealcast_msgs::CdrError>(())
//! ```
//!
//! `examples/shared_memory_client.rs` sends conditions over shared memory and prints the predictions.

#![warn(missing_docs)]

mod listed;
pub mod schema;
pub mod shm;
pub mod type_description;

pub use cdr_encoding::Error as CdrError;
use serde::{Deserialize, Serialize};

/// Topic names in recordings, and on ROS 2 for a node in the namespace `/`.
pub mod topic {
    /// Operating points, received by the node.
    pub const OPERATING_POINT: &str = "/rig/operating_point";
    /// Measured vibration, received by the node; it does not affect predictions.
    pub const VIBRATION: &str = "/rig/vibration";
    /// Temperature of the contact, received by the node; the rig follows it.
    pub const TEMPERATURE: &str = "/rig/temperature";
    /// Samples of microphones and accelerometers, received by the node; they do not affect predictions.
    pub const WAVEFORM: &str = "/rig/waveform";
    /// Predictions, published by the node.
    pub const PREDICTION: &str = "/squealcast/prediction";
    /// Description of the node's rig; transient local.
    pub const RIG: &str = "/squealcast/rig";
    /// Session events. They are meant for recordings and need not be transient local.
    pub const SESSION_EVENT: &str = "/squealcast/session_event";
    /// Sensitivities of predictions to conditions and contact.
    pub const SENSITIVITY: &str = "/squealcast/sensitivity";
    /// Squeals found in the samples, published by the node.
    pub const HEARD: &str = "/squealcast/heard";
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

/// Largest number of samples in a [`Waveform`].
pub const MAX_WAVEFORM_SAMPLES: usize = 1 << 14;

/// Longest name of a channel of a [`Waveform`], bytes.
pub const MAX_CHANNEL_BYTES: usize = 128;

/// `builtin_interfaces/Time`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Time {
    /// Whole seconds since the Unix epoch.
    pub sec: i32,
    /// Nanoseconds within the second, below 10⁹.
    pub nanosec: u32,
}

/// `std_msgs/Header`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// Time of measurement.
    pub stamp: Time,
    /// Source of the measurement; `simulated` marks a simulated rig.
    pub frame_id: String,
}

/// `squealcast_msgs/OperatingPoint`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OperatingPoint {
    /// The stamp is the time of measurement.
    pub header: Header,
    /// Sequence number; a gap means lost inputs.
    pub seq: u64,
    /// Normal load, N.
    pub normal_load_n: f64,
    /// Disc speed, rad/s; its sign is the direction of rotation.
    pub disc_speed_rad_s: f64,
    /// Measured friction coefficient.
    pub friction_coefficient: f64,
}

/// `squealcast_msgs/Vibration`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Vibration {
    /// The stamp is the time of measurement.
    pub header: Header,
    /// Frequency of the highest peak of the spectrum, Hz.
    pub frequency_hz: f64,
    /// Level of that peak, dB; the reference is that of the instrument.
    pub level_db: f64,
}

/// `sensor_msgs/Temperature`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Temperature {
    /// The stamp is the time of measurement.
    pub header: Header,
    /// Temperature of the contact, °C.
    pub temperature: f64,
    /// Its variance, K²; 0 if unknown. It is recorded and not used.
    pub variance: f64,
}

/// `squealcast_msgs/Waveform`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Waveform {
    /// The stamp is the time of the first sample.
    pub header: Header,
    /// Name of the channel, at most [`MAX_CHANNEL_BYTES`].
    pub channel: String,
    /// Samples per second.
    pub sample_rate_hz: f64,
    /// Unit of the samples: `Pa`, `m/s²`, `g`, `V` or `FS`.
    pub unit: String,
    /// Output of the sensor for samples in V or FS, such as `50 mV/Pa`; else empty.
    pub sensitivity: String,
    /// At most [`MAX_WAVEFORM_SAMPLES`].
    pub samples: Vec<f32>,
}

/// `squealcast_msgs/Heard`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Heard {
    /// The stamp is the time of the onset.
    pub header: Header,
    /// Channel of the samples in which the squeal was found.
    pub channel: String,
    /// Counts the squeals of the channel.
    pub number: u64,
    /// One of [`heard_state`].
    pub state: u8,
    /// End of the squeal; while it lasts, the latest time at which it was found.
    pub end_stamp: Time,
    /// Whether samples are missing at the onset.
    pub cut_at_onset: bool,
    /// Whether samples are missing at the end.
    pub cut_at_end: bool,
    /// Mean frequency of the steady part, Hz.
    pub frequency_hz: f64,
    /// One of [`heard_quantity`].
    pub quantity: u8,
    /// Level of the steady part, dB(A) re 20 µPa or dB re 1 µm/s².
    pub level_db: f64,
    /// Highest level, dB.
    pub peak_level_db: f64,
    /// Ratio of the tone to the noise in its bin at the onset, dB.
    pub prominence_db: f64,
    /// Growth rate at the onset, 1/s; NaN if it cannot be measured.
    pub growth_rate_per_s: f64,
    /// Lower end of its 95 % confidence interval, 1/s.
    pub growth_rate_low_per_s: f64,
    /// Upper end of its 95 % confidence interval, 1/s.
    pub growth_rate_high_per_s: f64,
    /// Of a harmonic: its order, at least 2; else 0.
    pub harmonic_order: u32,
    /// Of a harmonic: number of the fundamental; else 0.
    pub harmonic_of: u64,
    /// One of [`heard_verdict`].
    pub verdict: u8,
    /// Of a hit: identity of the mode that was predicted to squeal; else 0.
    pub mode_id: u32,
    /// Of a hit: frequency of that mode, Hz; else NaN.
    pub predicted_frequency_hz: f64,
    /// Of a hit: growth rate of that mode, 1/s; else NaN.
    pub predicted_growth_rate_per_s: f64,
    /// Sequence number of the prediction that the squeal is compared with.
    pub input_seq: u64,
    /// Stamp of that prediction; zero without one.
    pub prediction_stamp: Time,
}

/// The values of [`Heard::state`].
pub mod heard_state {
    /// The squeal lasts.
    pub const BEGAN: u8 = 0;
    /// The squeal is over.
    pub const ENDED: u8 = 1;
}

/// The values of [`Heard::quantity`].
pub mod heard_quantity {
    /// Levels in dB(A) re 20 µPa.
    pub const SOUND_PRESSURE: u8 = 0;
    /// Levels in dB re 1 µm/s².
    pub const ACCELERATION: u8 = 1;
}

/// The values of [`Heard::verdict`].
pub mod heard_verdict {
    /// A mode was predicted to squeal at this frequency.
    pub const HIT: u8 = 0;
    /// No mode was.
    pub const MISS: u8 = 1;
    /// A harmonic of another squeal, not judged separately.
    pub const HARMONIC: u8 = 2;
    /// There is no prediction for this time.
    pub const NOT_JUDGED: u8 = 3;

    /// The name of a verdict.
    pub fn name(verdict: u8) -> &'static str {
        match verdict {
            HIT => "hit",
            MISS => "miss",
            HARMONIC => "harmonic",
            _ => "not judged",
        }
    }
}

/// `squealcast_msgs/Mode`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Mode {
    /// Identity of the mode; it stays the same as conditions change.
    pub id: u32,
    /// `|Im λ| / 2π`, Hz.
    pub frequency_hz: f64,
    /// `Re λ`, 1/s; positive if the mode grows.
    pub growth_rate_per_s: f64,
    /// `-Re λ / |λ|`.
    pub damping_ratio: f64,
    /// The pad's share in the mode, 0 to 1; NaN if unknown.
    pub pad_participation: f64,
    /// Scaled residual of the eigenpair; for a charted root, a bound of it.
    pub residual: f64,
    /// Bound of the error of `frequency_hz`, Hz; NaN if unknown.
    pub frequency_error_hz: f64,
    /// Bound of the error of `growth_rate_per_s`, 1/s; NaN if unknown.
    pub growth_rate_error_per_s: f64,
}

/// `squealcast_msgs/Prediction`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// Header of the input; the stamp is its time of measurement.
    pub header: Header,
    /// Sequence number of the input.
    pub input_seq: u64,
    /// One of [`level`].
    pub level: u8,
    /// Whether the last prediction was kept because the conditions stayed within the dead-band.
    pub reused: bool,
    /// Number of unstable modes in the band.
    pub unstable_modes: u32,
    /// Growth rate of the fastest growing mode, 1/s.
    pub max_growth_rate_per_s: f64,
    /// Frequency of the fastest growing mode, Hz, if it is unstable; else NaN.
    pub worst_frequency_hz: f64,
    /// End of a window of instability nearest to the friction coefficient; NaN if there is none or it is not known yet.
    pub critical_friction: f64,
    /// Distance to `critical_friction`: positive outside a window, negative inside.
    pub friction_margin: f64,
    /// Bound of the error of the margin; NaN if unknown.
    pub friction_margin_error: f64,
    /// The limit that decided the level, and notes.
    pub reason: String,
    /// Modes of the band in ascending frequency; of more than [`MAX_MODES`], those that grow fastest.
    pub modes: Vec<Mode>,
}

/// `squealcast_msgs/Derivatives`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Derivatives {
    /// With respect to the friction coefficient.
    pub by_friction_coefficient: f64,
    /// With respect to the normal load, per N.
    pub by_normal_load_n: f64,
    /// With respect to the disc speed, per rad/s.
    pub by_disc_speed_rad_s: f64,
    /// With respect to the logarithm of a factor on the stiffness of all contact pairs; NaN without contact pairs.
    pub by_contact_stiffness: f64,
    /// With respect to the logarithm of a factor on the damping of all contact pairs; NaN without contact pairs.
    pub by_contact_damping: f64,
}

/// `squealcast_msgs/ModeSensitivity`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ModeSensitivity {
    /// Identity of the mode.
    pub id: u32,
    /// One of [`sensitivity_law`].
    pub law: u8,
    /// Derivatives of the frequency, Hz.
    pub frequency_hz: Derivatives,
    /// Derivatives of the growth rate, 1/s.
    pub growth_rate_per_s: Derivatives,
}

/// The values of [`ModeSensitivity::law`].
pub mod sensitivity_law {
    /// Root and conditions are related linearly to first order.
    pub const LINEAR: u8 = 0;
    /// Too close to merging for a tangent; the law of the pair is in [`Sensitivity::pairs`](super::Sensitivity::pairs).
    pub const SQUARE_ROOT: u8 = 1;
}

/// `squealcast_msgs/PairSensitivity`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PairSensitivity {
    /// Identity of one mode.
    pub first_id: u32,
    /// Identity of the other mode.
    pub second_id: u32,
    /// Whether `z` is `λ²` (undamped rigs); otherwise it is `λ`.
    pub squares: bool,
    /// Real part of the mean of both `z`.
    pub mean_real: f64,
    /// Imaginary part of the mean of both `z`.
    pub mean_imaginary: f64,
    /// Real part of the square of half the difference of both `z`.
    pub discriminant_real: f64,
    /// Imaginary part of the square of half the difference of both `z`.
    pub discriminant_imaginary: f64,
    /// Derivatives of `mean_real`.
    pub mean_real_derivatives: Derivatives,
    /// Derivatives of `mean_imaginary`.
    pub mean_imaginary_derivatives: Derivatives,
    /// Derivatives of `discriminant_real`.
    pub discriminant_real_derivatives: Derivatives,
    /// Derivatives of `discriminant_imaginary`.
    pub discriminant_imaginary_derivatives: Derivatives,
}

/// `squealcast_msgs/Sensitivity`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sensitivity {
    /// Header of the input it was computed for.
    pub header: Header,
    /// Sequence number of that input.
    pub input_seq: u64,
    /// Normal load of that input, N.
    pub normal_load_n: f64,
    /// Disc speed of that input, rad/s.
    pub disc_speed_rad_s: f64,
    /// Friction coefficient of that input.
    pub friction_coefficient: f64,
    /// End of a window of instability nearest to the friction coefficient; NaN if unknown.
    pub nearest_window_end: f64,
    /// Derivatives of that end; 0 with respect to the friction coefficient.
    pub nearest_window_end_derivatives: Derivatives,
    /// The modes of the prediction.
    pub modes: Vec<ModeSensitivity>,
    /// Pairs of modes that are close to merging.
    pub pairs: Vec<PairSensitivity>,
}

/// The values of [`Prediction::level`].
pub mod level {
    /// No mode is close to instability.
    pub const OK: u8 = 0;
    /// An unstable window or low damping is near.
    pub const WARN: u8 = 1;
    /// A mode grows.
    pub const SQUEAL: u8 = 2;
    /// No prediction could be made.
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
    /// Name of the rig.
    pub name: String,
    /// SHA-256 of the rig file and of every file it refers to.
    pub content_hash: String,
    /// Version of the program.
    pub version: String,
    /// Number of modes.
    pub mode_count: u32,
    /// Highest frequency that is listed and judged, Hz.
    pub band_max_hz: f64,
    /// Errors of the rig against the full model it was reduced from, as text; empty if unknown.
    pub reduction: String,
}

/// `squealcast_msgs/SessionEvent`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SessionEvent {
    /// The stamp of the event.
    pub header: Header,
    /// The number of a [`SessionEventKind`].
    pub kind: u8,
    /// Of a parameter: its name.
    pub name: String,
    /// Of a parameter: its value. Of a temperature: the temperature, °C.
    pub value: f64,
    /// Of a stability map or window ends: the load they hold for, N.
    pub normal_load_n: f64,
    /// Of a stability map or window ends: the disc speed they hold for, rad/s.
    pub disc_speed_rad_s: f64,
    /// Of a stability map, window ends or a chart: hash of the content.
    pub hash: String,
}

listed! {
    /// What a [`SessionEvent`] records.
    pub enum SessionEventKind {
        /// A setting changed.
        Parameter,
        /// No input arrived in time.
        Silence,
        /// A stability map was computed.
        StabilityMap,
        /// A chart was completed.
        Chart,
        /// Ends of windows were computed.
        WindowEnds,
        /// The rig was built for another temperature.
        Temperature,
    }
}

impl SessionEventKind {
    /// Its number in [`SessionEvent::kind`], as in `SessionEvent.msg`. Numbers are never reused.
    pub fn number(self) -> u8 {
        match self {
            Self::Parameter => 0,
            Self::Silence => 1,
            Self::StabilityMap => 2,
            Self::Chart => 3,
            Self::WindowEnds => 4,
            Self::Temperature => 5,
        }
    }

    /// The kind of `event`; `None` if its number is unknown, as of a recording by a later version.
    pub fn of(event: &SessionEvent) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.number() == event.kind)
    }
}

/// `diagnostic_msgs/DiagnosticArray`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticArray {
    /// The stamp is the time of publication.
    pub header: Header,
    /// One entry per component.
    pub status: Vec<DiagnosticStatus>,
}

/// `diagnostic_msgs/DiagnosticStatus`; level OK=0, WARN=1, ERROR=2, STALE=3.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    /// OK=0, WARN=1, ERROR=2, STALE=3.
    pub level: u8,
    /// Component.
    pub name: String,
    /// Summary.
    pub message: String,
    /// Name of the rig.
    pub hardware_id: String,
    /// Details.
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/KeyValue`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyValue {
    /// Name of the value.
    pub key: String,
    /// The value as text.
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

    /// From derivatives with respect to friction coefficient, normal load, disc speed, contact stiffness and contact
    /// damping.
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

    /// In the order of [`Derivatives::new`].
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

/// The CDR encoding of a message: encapsulation header `00 01 00 00`, then little-endian CDR.
pub fn to_cdr<M: Serialize>(message: &M) -> Result<Vec<u8>, CdrError> {
    let mut bytes = vec![];
    write_cdr(message, &mut bytes)?;
    Ok(bytes)
}

/// Replaces the content of `bytes` by the encoding of [`to_cdr`], reusing their memory.
///
/// # Errors
/// As [`to_cdr`].
pub fn write_cdr<M: Serialize>(message: &M, bytes: &mut Vec<u8>) -> Result<(), CdrError> {
    bytes.clear();
    bytes.extend([0, 1, 0, 0]);
    cdr_encoding::to_writer::<_, byteorder::LittleEndian, _>(bytes, message)
}

/// Decodes a message from CDR bytes with encapsulation header, in either byte order.
pub fn from_cdr<M: for<'de> Deserialize<'de>>(bytes: &[u8]) -> Result<M, CdrError> {
    match bytes {
        [0, 0, _, _, payload @ ..] => Ok(cdr_encoding::from_bytes::<M, byteorder::BigEndian>(payload)?.0),
        [0, 1, _, _, payload @ ..] => Ok(cdr_encoding::from_bytes::<M, byteorder::LittleEndian>(payload)?.0),
        _ => Err(CdrError::Message("no plain CDR encapsulation header".to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rosidl_generates_every_message_file() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let list = std::fs::read_to_string(folder.join("CMakeLists.txt")).expect("the list");
        let files = std::fs::read_dir(folder.join("msg")).expect("the messages");
        let names = files.map(|file| file.expect("a file").file_name().into_string().expect("UTF-8"));
        let missing: Vec<String> = names.filter(|name| !list.contains(&format!("\"msg/{name}\""))).collect();
        assert_eq!(missing, [""; 0], "not in CMakeLists.txt");
        for topic in schema::Topic::ALL.into_iter().filter(|topic| topic.is_own_type()) {
            let name = topic.type_name().rsplit('/').next().unwrap_or_default();
            let file = std::fs::read_to_string(folder.join(format!("msg/{name}.msg"))).expect("its file");
            assert_eq!(file, topic.definition(), "{topic:?}");
        }
    }

    /// `STABILITY_MAP` of `StabilityMap`.
    fn constant_name(variant: &str) -> String {
        let mut name = String::new();
        for letter in variant.chars() {
            if letter.is_uppercase() && !name.is_empty() {
                name.push('_');
            }
            name.extend(letter.to_uppercase());
        }
        name
    }

    #[test]
    fn session_events_have_the_kinds_of_their_message_file() {
        let file = include_str!("../msg/SessionEvent.msg");
        let defined: Vec<&str> = file.lines().filter_map(|line| line.strip_prefix("uint8 ")).collect();
        let kinds =
            SessionEventKind::ALL.map(|kind| format!("{}={}", constant_name(&format!("{kind:?}")), kind.number()));
        // The last line is the field itself.
        assert_eq!(defined, [&kinds.each_ref().map(String::as_str)[..], &["kind"]].concat());
        for kind in SessionEventKind::ALL {
            let event = SessionEvent { kind: kind.number(), ..Default::default() };
            assert_eq!(SessionEventKind::of(&event), Some(kind));
        }
        assert_eq!(SessionEventKind::of(&SessionEvent { kind: u8::MAX, ..Default::default() }), None);
    }
}
