//! The buses and the recorder that a node publishes to. A message that a bus refuses is counted; the node never waits.

use crate::bus::log::Severity;
use crate::bus::ros2::NODE_NAME;
use crate::bus::{Bus, Connection, Outgoing, Report};
use crate::foxglove::LiveView;
use crate::msgs::schema::Topic;
use crate::msgs::{DiagnosticArray, Heard, Prediction, RigInfo, Sensitivity, SessionEvent};
use crate::recording::message::{Message, Payload};
use crate::recording::recorder::RecorderHandle;
use crate::system::clock::Reading;

/// The buses and the recorder of a node.
#[derive(Default)]
pub struct Outputs {
    /// The buses it has joined, in the order in which a message is published to them.
    pub buses: Vec<Box<dyn Connection>>,
    pub recorder: Option<RecorderHandle>,
    pub node_name: NodeName,
    /// The server for Foxglove, which shows what is recorded.
    pub foxglove: Option<LiveView>,
    /// Messages that could not be published, and the latest reason since the last report.
    pub failures: u64,
    pub last_failure: Option<String>,
}

/// The name of a node in diagnostics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeName(String);

impl NodeName {
    /// The node `name` in `namespace`.
    pub fn new(namespace: &str, name: &str) -> Self {
        Self(format!("{namespace}/{name}").trim_start_matches('/').to_owned())
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Default for NodeName {
    fn default() -> Self {
        Self(NODE_NAME.to_owned())
    }
}

/// As [`Outputs::record`], from any thread.
pub(super) fn record(recorder: &RecorderHandle, at: Reading, payload: Payload) {
    let publish_time_ns = u64::try_from(at.wall_ns).unwrap_or(0);
    // A message that does not fit the recorder's queue is counted there.
    recorder.record(Message { log_time_ns: at.log_ns(), publish_time_ns, payload });
}

impl Outputs {
    /// Records and shows a message that was received or made at `at`. Its log time is the monotonic one, its publish time the
    /// wall clock.
    pub fn record(&self, at: Reading, payload: Payload) {
        if let Some(foxglove) = &self.foxglove {
            foxglove.show(at, &payload);
        }
        if let Some(recorder) = &self.recorder {
            record(recorder, at, payload);
        }
    }

    fn publish(&mut self, message: Outgoing<'_>) {
        for bus in &mut self.buses {
            if let Err(error) = bus.publish(message) {
                self.failures += 1;
                self.last_failure = Some(error.to_string());
            }
        }
    }

    /// Publishes a prediction; [`Self::record_prediction`] records it.
    pub fn prediction(&mut self, prediction: &Prediction) {
        self.publish(Outgoing::Prediction(prediction));
    }

    fn is_shown(&self, topic: Topic) -> bool {
        self.foxglove.as_ref().is_some_and(|foxglove| foxglove.is_wanted(topic))
    }

    pub fn record_prediction(&self, prediction: &Prediction) {
        if self.recorder.is_some() || self.is_shown(Topic::Prediction) {
            self.record(Reading::now(), Payload::Prediction(prediction.clone()));
        }
    }

    pub fn session_event(&mut self, event: SessionEvent) {
        self.publish(Outgoing::SessionEvent(&event));
        self.record(Reading::now(), Payload::SessionEvent(event));
    }

    pub fn rig_info(&mut self, info: RigInfo) {
        self.publish(Outgoing::RigInfo(&info));
        self.record(Reading::now(), Payload::RigInfo(info));
    }

    /// Whether sensitivities have a reader, or are recorded or shown.
    pub fn want_sensitivities(&self) -> bool {
        self.recorder.is_some()
            || self.is_shown(Topic::Sensitivity)
            || self.buses.iter().any(|bus| bus.readers(Topic::Sensitivity) > 0)
    }

    pub fn sensitivity(&mut self, sensitivity: Sensitivity) {
        self.publish(Outgoing::Sensitivity(&sensitivity));
        self.record(Reading::now(), Payload::Sensitivity(sensitivity));
    }

    pub fn diagnostics(&mut self, diagnostics: DiagnosticArray) {
        self.publish(Outgoing::Diagnostics(&diagnostics));
        self.record(Reading::now(), Payload::Diagnostics(diagnostics));
    }

    /// Writes a line to the logs of the buses. A line that a bus refuses is not worth a warning.
    pub fn log(&mut self, severity: Severity, text: &str) {
        for bus in &mut self.buses {
            drop(bus.publish(Outgoing::Log(severity, text)));
        }
    }

    pub fn heard(&mut self, heard: Heard) {
        self.publish(Outgoing::Heard(&heard));
        self.record(Reading::now(), Payload::Heard(heard));
    }

    /// The state of each bus since the last report.
    pub fn reports(&mut self) -> Vec<(Bus, Report)> {
        self.buses.iter_mut().map(|bus| (bus.bus(), bus.report())).collect()
    }
}
