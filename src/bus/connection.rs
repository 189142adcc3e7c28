//! The operations of a bus: publish messages, count their readers, report problems, deliver inputs.

use thiserror::Error;

use super::lifecycle::State;
use super::log::Severity;
use super::ros2::Ros2Error;
use super::shm::ShmError;
use super::{Bus, Counts, Received};
use crate::msgs::schema::Topic;
use crate::msgs::{
    DiagnosticArray, Heard, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent, Temperature, Vibration,
    Waveform,
};

/// A message to be published.
#[derive(Clone, Copy, Debug)]
pub enum Outgoing<'a> {
    OperatingPoint(&'a OperatingPoint),
    Prediction(&'a Prediction),
    SessionEvent(&'a SessionEvent),
    RigInfo(&'a RigInfo),
    Sensitivity(&'a Sensitivity),
    Diagnostics(&'a DiagnosticArray),
    Vibration(&'a Vibration),
    Waveform(&'a Waveform),
    Heard(&'a Heard),
    Temperature(&'a Temperature),
    /// A line for the log of the bus.
    Log(Severity, &'a str),
}

/// Why a bus refused to publish a message.
#[derive(Debug, Error)]
pub enum BusError {
    #[error(transparent)]
    Shm(#[from] ShmError),
    #[error(transparent)]
    Ros2(#[from] Ros2Error),
}

/// State of a connection since its last report.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Counts of the operating points received so far; `None` if the connection receives none.
    pub counts: Option<Counts>,
    /// Counts of the blocks of samples received so far; `None` if the connection receives none.
    pub waveform_counts: Option<Counts>,
    /// Number of predictions so far that were not encoded, because they had no reader.
    pub encodings_skipped: u64,
    /// How often so far the bus failed and was started again.
    pub restarts: u64,
    /// Further values for the diagnostics.
    pub values: Vec<(&'static str, String)>,
    /// Problems since the last report.
    pub warnings: Vec<String>,
}

/// A bus that this program has joined. It leaves when the connection is dropped.
pub trait Connection: Send {
    /// Which bus it is.
    fn bus(&self) -> Bus;

    /// Publishes a message without blocking. A message of a topic that this connection does not publish is ignored.
    ///
    /// # Errors
    /// Why the bus refuses the message. A later call may succeed.
    fn publish(&mut self, message: Outgoing<'_>) -> Result<(), BusError>;

    /// Number of readers of a topic other than this program's own, including killed ones whose remains the bus still
    /// keeps. 0 for a topic that this connection does not publish or whose readers it does not count.
    fn readers(&self, topic: Topic) -> usize;

    /// The state since the last report.
    fn report(&mut self) -> Report {
        Report::default()
    }
}

/// Takes what a node receives over its buses. Buses call it on their own threads; it must not block.
pub trait Sink: Send + Sync {
    /// Whether operating points, vibrations, temperatures and samples are wanted. If not, a bus need not receive them.
    fn takes_inputs(&self) -> bool;

    /// Takes an operating point. With `may_predict` the calling thread may be used for the time of a prediction.
    fn operating_point(&self, received: Received<OperatingPoint>, may_predict: bool);

    /// Takes a measured vibration.
    fn vibration(&self, received: Received<Vibration>);

    /// Takes a temperature of the contact.
    fn temperature(&self, received: Received<Temperature>);

    /// Takes a block of samples of a microphone or accelerometer.
    fn waveform(&self, received: Received<Waveform>);

    /// Takes a parameter value that a peer has set and that was validated.
    fn parameter(&self, name: &str, value: f64);

    /// Takes the state into which a peer has brought the node. Messages received later find the node in this state.
    fn lifecycle(&self, state: State);
}
