//! The buses and the recorder that a node publishes to. A message that a bus refuses is counted; the node never waits.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant};

use crate::bus::received::Counts;
use crate::bus::ros2::NODE_NAME;
use crate::bus::ros2::process::{Health, Ros2Process};
use crate::bus::shm::{ShmInput, ShmOutput, ShmSensitivity, ShmVibrationInput};
use crate::msgs::{DiagnosticArray, Prediction, RigInfo, Sensitivity, SessionEvent};
use crate::recording::message::{Message, Payload};
use crate::recording::recorder::RecorderHandle;
use crate::system::clock::Reading;

/// The buses and the recorder of a node; each is optional.
#[derive(Default)]
pub struct Outputs {
    pub shm: Option<ShmOutput>,
    pub shm_sensitivity: Option<ShmSensitivity>,
    pub shm_input: Option<ShmInput>,
    pub shm_vibration: Option<ShmVibrationInput>,
    pub ros2: Option<Ros2Process>,
    pub recorder: Option<RecorderHandle>,
    pub node_name: NodeName,
    /// Inputs lost because the channel was full.
    pub lost_inputs: Arc<AtomicU64>,
    /// Messages that could not be published, and the latest reason since the last report.
    pub failures: u64,
    pub last_failure: Option<String>,
    /// State of the ROS 2 side at the last report.
    pub ros2_before: Health,
    /// Predictions that were not encoded for ROS 2 because they had no reader there.
    pub encodings_skipped: u64,
    /// Whether predictions have readers on ROS 2.
    pub ros2_readers: Readers,
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

/// Whether a ROS 2 topic has readers. The answer is cached, since asking takes locks.
#[derive(Default)]
pub struct Readers {
    asked: Option<Instant>,
    any: bool,
}

/// How long the answer is cached. A new reader may miss what is published in this time.
const LOOK_FOR_READERS_EVERY: Duration = Duration::from_millis(20);

impl Readers {
    fn any(&mut self, count: impl FnOnce() -> usize) -> bool {
        if self.asked.is_none_or(|asked| asked.elapsed() >= LOOK_FOR_READERS_EVERY) {
            (self.asked, self.any) = (Some(Instant::now()), count() > 0);
        }
        self.any
    }
}

impl Outputs {
    /// Records a message that was received or made at `at`. Its log time is the monotonic one, its publish time the
    /// wall clock.
    pub fn record(&self, at: Reading, payload: Payload) {
        if let Some(recorder) = &self.recorder {
            let publish_time_ns = u64::try_from(at.wall_ns).unwrap_or(0);
            // A message that does not fit the recorder's queue is counted there.
            recorder.record(Message { log_time_ns: at.log_ns(), publish_time_ns, payload });
        }
    }

    /// Publishes a prediction over shared memory.
    pub fn prediction_to_shm(&mut self, prediction: &Prediction) {
        if let Some(Err(error)) = self.shm.as_ref().map(|shm| shm.publish(prediction)) {
            self.failed(&error);
        }
    }

    /// Publishes a prediction over ROS 2 and records it.
    pub fn prediction(&mut self, prediction: &Prediction) {
        if let Some(ros2) = &self.ros2 {
            if !self.ros2_readers.any(|| ros2.prediction_readers()) {
                self.encodings_skipped += 1;
            } else if let Err(error) = ros2.publish_prediction(prediction) {
                self.failed(&error);
            }
        }
        if self.recorder.is_some() {
            self.record(Reading::now(), Payload::Prediction(prediction.clone()));
        }
    }

    pub fn session_event(&mut self, event: SessionEvent) {
        if let Some(Err(error)) = self.ros2.as_ref().map(|ros2| ros2.publish_session_event(&event)) {
            self.failed(&error);
        }
        self.record(Reading::now(), Payload::SessionEvent(event));
    }

    pub fn rig_info(&mut self, info: &RigInfo) {
        if let Some(Err(error)) = self.ros2.as_ref().map(|ros2| ros2.publish_rig(info)) {
            self.failed(&error);
        }
        self.record(Reading::now(), Payload::RigInfo(info.clone()));
    }

    /// Whether sensitivities have a reader or are recorded.
    pub fn want_sensitivities(&self) -> bool {
        self.recorder.is_some()
            || self.shm_sensitivity.as_ref().is_some_and(|shm| shm.readers() > 0)
            || self.ros2.as_ref().is_some_and(|ros2| ros2.sensitivity_readers() > 0)
    }

    pub fn sensitivity(&mut self, sensitivity: Sensitivity) {
        if let Some(Err(error)) = self.shm_sensitivity.as_ref().map(|shm| shm.publish(&sensitivity)) {
            self.failed(&error);
        }
        if let Some(Err(error)) = self.ros2.as_ref().map(|ros2| ros2.publish_sensitivity(&sensitivity)) {
            self.failed(&error);
        }
        self.record(Reading::now(), Payload::Sensitivity(sensitivity));
    }

    pub fn diagnostics(&mut self, diagnostics: DiagnosticArray) {
        if let Some(Err(error)) = self.ros2.as_ref().map(|ros2| ros2.publish_diagnostics(&diagnostics)) {
            self.failed(&error);
        }
        self.record(Reading::now(), Payload::Diagnostics(diagnostics));
    }

    /// A warning if other nodes publish predictions over shared memory too: readers cannot tell them apart.
    pub fn other_nodes(&self) -> Option<String> {
        let shm = self.shm.as_ref()?;
        let others = shm.other_writers();
        (others > 0).then(|| {
            format!(
                "{others} more publish on the service {} over shared memory, whose readers get the predictions of all; \
                 --shm-prefix keeps nodes apart",
                shm.service()
            )
        })
    }

    /// Counts of the receiving side of each bus.
    pub fn counts(&self) -> Vec<(&'static str, Counts)> {
        let shm = self.shm_input.as_ref().map(|shm| ("shm", shm.counts()));
        let ros2 = self.ros2.as_ref().map(|ros2| ("ros2", ros2.counts()));
        shm.into_iter().chain(ros2).collect()
    }

    /// State of the ROS 2 side, and its problems since the last report.
    pub fn ros2_health(&mut self) -> Option<(Health, Vec<String>)> {
        let now = self.ros2.as_ref()?.health();
        let before = std::mem::replace(&mut self.ros2_before, now.clone());
        let mut wrong = vec![];
        if now.falls > before.falls {
            wrong.push(format!("the ROS 2 side fell and is started again: {}", now.last_fall));
        } else if !now.up {
            wrong.push(format!("the ROS 2 side is down: {}", now.last_fall));
        }
        if now.refused > before.refused {
            wrong.push(format!("{} messages {}", now.refused - before.refused, now.last_refusal));
        }
        Some((now, wrong))
    }

    fn failed(&mut self, error: &dyn std::fmt::Display) {
        self.failures += 1;
        self.last_failure = Some(error.to_string());
    }
}
