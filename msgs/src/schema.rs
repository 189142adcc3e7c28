//! The `ros2msg` schemas of the messages, as stored in recordings.
//!
//! As `ros2 bag record` writes it, a schema is the text of the `.msg` file followed by every message it refers to. Each
//! of those is preceded by a line of 80 `=` and a line `MSG: package/Type`.

use crate::type_description::TypeDescription;
use crate::{listed, topic};

listed! {
    /// A topic that the node records, with its type, schema and quality of service. Recordings list them in this order.
    #[derive(PartialOrd, Ord)]
    pub enum Topic {
        /// [`topic::OPERATING_POINT`]
        OperatingPoint,
        /// [`topic::PREDICTION`]
        Prediction,
        /// [`topic::SESSION_EVENT`]
        SessionEvent,
        /// [`topic::RIG`]
        RigInfo,
        /// [`topic::SENSITIVITY`]
        Sensitivity,
        /// [`topic::DIAGNOSTICS`]
        Diagnostics,
        /// [`topic::VIBRATION`]
        Vibration,
        /// [`topic::WAVEFORM`]
        Waveform,
        /// [`topic::HEARD`]
        Heard,
        /// [`topic::TEMPERATURE`]
        Temperature,
    }
}

const HEADER: (&str, &str) = (
    "std_msgs/Header",
    "# Standard metadata for higher-level stamped data types.\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
);
const TIME: (&str, &str) = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
const MODE: (&str, &str) = ("squealcast_msgs/Mode", include_str!("../msg/Mode.msg"));
const DERIVATIVES: (&str, &str) = ("squealcast_msgs/Derivatives", include_str!("../msg/Derivatives.msg"));
const MODE_SENSITIVITY: (&str, &str) = ("squealcast_msgs/ModeSensitivity", include_str!("../msg/ModeSensitivity.msg"));
const PAIR_SENSITIVITY: (&str, &str) = ("squealcast_msgs/PairSensitivity", include_str!("../msg/PairSensitivity.msg"));
const DIAGNOSTIC_STATUS: (&str, &str) = (
    "diagnostic_msgs/DiagnosticStatus",
    "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\nstring hardware_id\n\
     KeyValue[] values\n",
);
const KEY_VALUE: (&str, &str) = ("diagnostic_msgs/KeyValue", "string key\nstring value\n");
const TEMPERATURE: &str = "std_msgs/Header header\n# Degrees Celsius.\nfloat64 temperature\n# 0 is interpreted as \
                           variance unknown.\nfloat64 variance\n";
const DIAGNOSTIC_ARRAY: &str = "std_msgs/Header header\nDiagnosticStatus[] status\n";

impl Topic {
    /// The topic's name on ROS 2 and in recordings.
    pub fn name(self) -> &'static str {
        match self {
            Self::OperatingPoint => topic::OPERATING_POINT,
            Self::Prediction => topic::PREDICTION,
            Self::SessionEvent => topic::SESSION_EVENT,
            Self::RigInfo => topic::RIG,
            Self::Sensitivity => topic::SENSITIVITY,
            Self::Diagnostics => topic::DIAGNOSTICS,
            Self::Vibration => topic::VIBRATION,
            Self::Waveform => topic::WAVEFORM,
            Self::Heard => topic::HEARD,
            Self::Temperature => topic::TEMPERATURE,
        }
    }

    /// The ROS 2 name of the message type, `package/msg/Type`.
    pub fn type_name(self) -> &'static str {
        match self {
            Self::OperatingPoint => "squealcast_msgs/msg/OperatingPoint",
            Self::Prediction => "squealcast_msgs/msg/Prediction",
            Self::SessionEvent => "squealcast_msgs/msg/SessionEvent",
            Self::RigInfo => "squealcast_msgs/msg/RigInfo",
            Self::Sensitivity => "squealcast_msgs/msg/Sensitivity",
            Self::Diagnostics => "diagnostic_msgs/msg/DiagnosticArray",
            Self::Vibration => "squealcast_msgs/msg/Vibration",
            Self::Waveform => "squealcast_msgs/msg/Waveform",
            Self::Heard => "squealcast_msgs/msg/Heard",
            Self::Temperature => "sensor_msgs/msg/Temperature",
        }
    }

    /// Whether the message type belongs to this project.
    pub fn is_own_type(self) -> bool {
        self.type_name().starts_with("squealcast_msgs/")
    }

    /// Whether late subscribers get the last message (`TRANSIENT_LOCAL`).
    pub fn is_latched(self) -> bool {
        match self {
            Self::RigInfo => true,
            Self::OperatingPoint
            | Self::Prediction
            | Self::SessionEvent
            | Self::Sensitivity
            | Self::Diagnostics
            | Self::Vibration
            | Self::Waveform
            | Self::Heard
            | Self::Temperature => false,
        }
    }

    /// The text of the `.msg` file of the topic's type.
    pub fn definition(self) -> &'static str {
        match self {
            Self::OperatingPoint => include_str!("../msg/OperatingPoint.msg"),
            Self::Prediction => include_str!("../msg/Prediction.msg"),
            Self::SessionEvent => include_str!("../msg/SessionEvent.msg"),
            Self::RigInfo => include_str!("../msg/RigInfo.msg"),
            Self::Sensitivity => include_str!("../msg/Sensitivity.msg"),
            Self::Diagnostics => DIAGNOSTIC_ARRAY,
            Self::Vibration => include_str!("../msg/Vibration.msg"),
            Self::Waveform => include_str!("../msg/Waveform.msg"),
            Self::Heard => include_str!("../msg/Heard.msg"),
            Self::Temperature => TEMPERATURE,
        }
    }

    /// The messages it refers to, as `package/Type` and text.
    fn dependencies(self) -> &'static [(&'static str, &'static str)] {
        match self {
            Self::OperatingPoint
            | Self::SessionEvent
            | Self::Vibration
            | Self::Waveform
            | Self::Heard
            | Self::Temperature => &[HEADER, TIME],
            Self::Prediction => &[HEADER, TIME, MODE],
            Self::RigInfo => &[],
            Self::Sensitivity => &[HEADER, TIME, MODE_SENSITIVITY, PAIR_SENSITIVITY, DERIVATIVES],
            Self::Diagnostics => &[HEADER, TIME, DIAGNOSTIC_STATUS, KEY_VALUE],
        }
    }

    /// The complete schema, in the encoding [`SCHEMA_ENCODING`].
    pub fn schema(self) -> String {
        let mut text = self.definition().to_owned();
        for (name, definition) in self.dependencies() {
            text.push_str(&format!("{:=<80}\nMSG: {name}\n{definition}", ""));
        }
        text
    }

    /// The description of the topic's type.
    pub fn type_description(self) -> TypeDescription {
        // A test describes them all.
        TypeDescription::of_message(self.type_name(), self.definition(), self.dependencies()).expect("our definitions")
    }

    /// The hash of the topic's type (REP-2016), as ROS 2 announces it.
    pub fn type_hash(self) -> String {
        self.type_description().hash()
    }

    /// The definitions of the type and of all types it refers to, as `package/msg/Type` and the text of the `.msg` file.
    pub fn definitions(self) -> Vec<(String, &'static str)> {
        let others = self.dependencies().iter().map(|(name, text)| (name.replacen('/', "/msg/", 1), *text));
        std::iter::once((self.type_name().to_owned(), self.definition())).chain(others).collect()
    }

    /// The quality of service of the publisher, in the form that channels and `metadata.yaml` require; the two must
    /// agree. Values are integers, since older versions of `rosbags` and `ros2 bag` do not read names.
    pub fn qos_profiles(self) -> String {
        let durability = if self.is_latched() { 1 } else { 2 };
        let depth = if self.is_latched() { 1 } else { topic::DEPTH };
        let forever = "sec: 2147483647\n    nsec: 4294967295";
        format!(
            "- history: 1\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n  deadline:\n    {forever}\n  \
             lifespan:\n    {forever}\n  liveliness: 1\n  liveliness_lease_duration:\n    {forever}\n  \
             avoid_ros_namespace_conventions: false"
        )
    }
}

/// MCAP name of the encoding of [`Topic::schema`].
pub const SCHEMA_ENCODING: &str = "ros2msg";
/// MCAP name of the encoding of messages.
pub const MESSAGE_ENCODING: &str = "cdr";

/// How the fields of `theirs` differ from those of `ours`, both `ros2msg` schemas; `None` if they are the same.
/// Comments, blank lines, spacing and constants are ignored. Of the nested messages only the project's own are
/// compared: those of ROS 2 do not change but are written in several ways.
pub fn field_difference(ours: &str, theirs: &str) -> Option<String> {
    let theirs = messages(theirs);
    for (name, fields) in messages(ours) {
        if !name.is_empty() && !name.starts_with("squealcast_msgs/") {
            continue;
        }
        let short = |name: &str| name.rsplit('/').next().unwrap_or_default().to_owned();
        let place =
            if name.is_empty() { "the recorded one".to_owned() } else { format!("the recorded {}", short(name)) };
        let Some((_, recorded)) = theirs.iter().find(|(other, _)| short(other) == short(name)) else {
            return Some(format!("{place} is not there"));
        };
        if let Some(missing) = fields.iter().find(|field| !recorded.contains(field)) {
            return Some(format!("{place} has no `{missing}`"));
        }
        if let Some(more) = recorded.iter().find(|field| !fields.contains(field)) {
            return Some(format!("{place} has `{more}`"));
        }
        if *recorded != fields {
            return Some(format!("{place} has them in another order"));
        }
    }
    None
}

/// The messages of a schema with their names and fields; the first one has no name.
fn messages(text: &str) -> Vec<(&str, Vec<String>)> {
    let mut found: Vec<(&str, Vec<String>)> = vec![("", vec![])];
    for line in text.lines().map(|line| line.split('#').next().unwrap_or_default().trim()) {
        if let Some(name) = line.strip_prefix("MSG:") {
            found.push((name.trim(), vec![]));
            continue;
        }
        // A constant, or the separator between two messages.
        if line.contains('=') {
            continue;
        }
        let mut words: Vec<&str> = line.split_whitespace().collect();
        // `std_msgs/Header`, `std_msgs/msg/Header` and `Header` are the same type.
        let Some(kind) = words.first_mut() else { continue };
        *kind = kind.rsplit('/').next().unwrap_or(kind);
        if let Some((_, fields)) = found.last_mut() {
            fields.push(words.join(" "));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_referenced_message_is_defined() {
        for topic in Topic::ALL {
            let schema = topic.schema();
            let own_package = topic.type_name().split('/').next().unwrap_or_default();
            let defined: Vec<&str> = schema.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
            for line in schema.lines().map(|line| line.split('#').next().unwrap_or_default()) {
                let Some(kind) = line.split_whitespace().next().map(|kind| kind.trim_end_matches("[]")) else {
                    continue;
                };
                if !kind.starts_with(|c: char| c.is_ascii_uppercase()) && !kind.contains('/') || line.contains("===") {
                    continue;
                }
                let full = if kind.contains('/') { kind.to_owned() } else { format!("{own_package}/{kind}") };
                assert!(
                    line.starts_with("MSG:") || defined.contains(&full.as_str()),
                    "{topic:?}: {full} is not defined"
                );
            }
        }
    }

    #[test]
    fn the_recorded_quality_of_service_is_that_of_the_publishers() {
        for topic in Topic::ALL {
            let (depth, durability) = if topic == Topic::RigInfo { (1, 1) } else { (64, 2) };
            let begin = format!("- history: 1\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n");
            assert!(topic.qos_profiles().starts_with(&begin), "{}", topic.qos_profiles());
        }
    }

    #[test]
    fn comments_and_constants_do_not_make_a_schema_differ() {
        let ours = Topic::Prediction.schema();
        let theirs: String = ours.lines().filter(|l| !l.starts_with('#')).map(|l| format!("{l}  # note\n\n")).collect();
        assert_eq!(field_difference(&ours, &theirs), None);
        assert_eq!(field_difference("std_msgs/msg/Header header\n", "std_msgs/Header   header"), None);
        let without = ours.replace("bool reused\n", "");
        assert_eq!(field_difference(&ours, &without).as_deref(), Some("the recorded one has no `bool reused`"));
        let order = field_difference("float64 a\nfloat64 b", "float64 b\nfloat64 a");
        assert_eq!(order.as_deref(), Some("the recorded one has them in another order"));
    }
}
