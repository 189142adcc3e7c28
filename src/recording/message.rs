//! Recorded messages of all topics of the node.

use crate::msgs::{
    self, CdrError, DiagnosticArray, Heard, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent,
    Temperature, Time, Vibration, Waveform, schema::Topic,
};

/// The content of a recorded message; its variant determines the topic.
#[derive(Clone, Debug, PartialEq)]
pub enum Payload {
    OperatingPoint(OperatingPoint),
    Prediction(Prediction),
    SessionEvent(SessionEvent),
    RigInfo(RigInfo),
    Sensitivity(Sensitivity),
    Diagnostics(DiagnosticArray),
    Vibration(Vibration),
    Waveform(Waveform),
    Heard(Heard),
    Temperature(Temperature),
}

impl Payload {
    /// The topic of the message.
    pub fn topic(&self) -> Topic {
        match self {
            Self::OperatingPoint(_) => Topic::OperatingPoint,
            Self::Prediction(_) => Topic::Prediction,
            Self::SessionEvent(_) => Topic::SessionEvent,
            Self::RigInfo(_) => Topic::RigInfo,
            Self::Sensitivity(_) => Topic::Sensitivity,
            Self::Diagnostics(_) => Topic::Diagnostics,
            Self::Vibration(_) => Topic::Vibration,
            Self::Waveform(_) => Topic::Waveform,
            Self::Heard(_) => Topic::Heard,
            Self::Temperature(_) => Topic::Temperature,
        }
    }

    /// The stamp, for modification; `None` for the description of a rig, which has none.
    pub fn stamp_mut(&mut self) -> Option<&mut Time> {
        match self {
            Self::OperatingPoint(message) => Some(&mut message.header.stamp),
            Self::Prediction(message) => Some(&mut message.header.stamp),
            Self::SessionEvent(message) => Some(&mut message.header.stamp),
            Self::RigInfo(_) => None,
            Self::Sensitivity(message) => Some(&mut message.header.stamp),
            Self::Diagnostics(message) => Some(&mut message.header.stamp),
            Self::Vibration(message) => Some(&mut message.header.stamp),
            Self::Waveform(message) => Some(&mut message.header.stamp),
            Self::Heard(message) => Some(&mut message.header.stamp),
            Self::Temperature(message) => Some(&mut message.header.stamp),
        }
    }

    /// The CDR encoding, including the encapsulation header.
    ///
    /// # Errors
    ///
    /// Content that CDR cannot represent, such as a string longer than 4 GiB.
    pub fn to_cdr(&self) -> Result<Vec<u8>, CdrError> {
        match self {
            Self::OperatingPoint(message) => msgs::to_cdr(message),
            Self::Prediction(message) => msgs::to_cdr(message),
            Self::SessionEvent(message) => msgs::to_cdr(message),
            Self::RigInfo(message) => msgs::to_cdr(message),
            Self::Sensitivity(message) => msgs::to_cdr(message),
            Self::Diagnostics(message) => msgs::to_cdr(message),
            Self::Vibration(message) => msgs::to_cdr(message),
            Self::Waveform(message) => msgs::to_cdr(message),
            Self::Heard(message) => msgs::to_cdr(message),
            Self::Temperature(message) => msgs::to_cdr(message),
        }
    }

    /// Decodes a message of a topic from CDR bytes.
    ///
    /// # Errors
    ///
    /// The bytes are not a message of that type.
    pub fn from_cdr(topic: Topic, cdr: &[u8]) -> Result<Self, CdrError> {
        Ok(match topic {
            Topic::OperatingPoint => Self::OperatingPoint(msgs::from_cdr(cdr)?),
            Topic::Prediction => Self::Prediction(msgs::from_cdr(cdr)?),
            Topic::SessionEvent => Self::SessionEvent(msgs::from_cdr(cdr)?),
            Topic::RigInfo => Self::RigInfo(msgs::from_cdr(cdr)?),
            Topic::Sensitivity => Self::Sensitivity(msgs::from_cdr(cdr)?),
            Topic::Diagnostics => Self::Diagnostics(msgs::from_cdr(cdr)?),
            Topic::Vibration => Self::Vibration(msgs::from_cdr(cdr)?),
            Topic::Waveform => Self::Waveform(msgs::from_cdr(cdr)?),
            Topic::Heard => Self::Heard(msgs::from_cdr(cdr)?),
            Topic::Temperature => Self::Temperature(msgs::from_cdr(cdr)?),
        })
    }
}

/// A message for the recorder.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// When it was received or made, ns since the epoch; determines the order of a recording. The recorder raises it by
    /// the minimum that makes log times increase strictly.
    pub log_time_ns: u64,
    /// When it was sent, ns since the epoch.
    pub publish_time_ns: u64,
    pub payload: Payload,
}
