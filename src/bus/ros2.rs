//! ROS 2: the node `/squealcast`, and its counterpart, a rig that publishes operating points and receives predictions.
//!
//! A long-running node holds its [`Ros2`] in a child process, [`process::Ros2Process`], because a datagram can make
//! RustDDS allocate without bound. Short-lived commands (`simulate`, `replay`) hold it themselves.
//!
//! The DDS implementation is RustDDS, in pure Rust: no ROS 2 installation is needed. Publishing works from any thread
//! and never blocks. A killed peer is only forgotten after its lease, so receivers should check sequence numbers.

mod connection;
mod discovery;
mod frame;
mod lifecycle;
mod link;
mod loopback;
pub mod member;
mod parameters;
pub mod process;
mod qos_conflicts;
pub mod side;
mod subscriptions;

use std::env;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use ros2_client::{Message, MessageTypeName, ParameterValue, Publisher, ServiceTypeName};
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use self::connection::{Ros2NodeConnection, Ros2ReplayConnection};
pub use self::parameters::{Accepted, Describe, Parameters, Validate};

use self::discovery::Discovery;
use self::link::{Durability, Link, MAX_ANSWER, MAX_BLOCKS_WAITING, MAX_UNANSWERED, MAX_WAITING};
use super::lifecycle::State;
use super::log::{Line, ROSOUT, Severity};
use super::managed::Changed;
use super::received::{Counters, Counts, Received};
use super::ros_args::{RosArgs, RosArgsError};
use super::{Bus, type_descriptions};
use crate::msgs::schema::Topic;
use crate::msgs::{
    DiagnosticArray, Heard, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent, SessionEventKind,
    Temperature, Vibration, Waveform, topic,
};

/// Name of the node before remapping.
pub const NODE_NAME: &str = "squealcast";
/// Name of the rig's node before remapping.
pub const SOURCE_NODE_NAME: &str = "rig";

/// Name of the node of a replay.
pub(super) const REPLAY_NODE_NAME: &str = "squealcast_replay";

/// Prefix of notes about ROS 2 on standard error.
pub(super) const NOTE: &str = "ROS 2: ";

/// The largest domain id whose ports are valid.
const MAX_DOMAIN_ID: u16 = 232;

/// What carries ROS 2.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Middleware {
    /// DDS, in the form of RustDDS.
    #[default]
    Dds,
    /// Zenoh, as rmw_zenoh uses it.
    Zenoh,
}

impl Middleware {
    /// The bus of messages received over it.
    pub fn bus(self) -> Bus {
        match self {
            Self::Dds => Bus::Ros2,
            Self::Zenoh => Bus::Zenoh,
        }
    }

    /// What a node calls the process that contains it.
    pub(super) fn side(self) -> &'static str {
        match self {
            Self::Dds => "the ROS 2 side",
            Self::Zenoh => "the Zenoh side",
        }
    }
}

/// How to join the ROS 2 network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ros2Options {
    pub middleware: Middleware,
    /// Domain id, 0 to 232. Peers of other domains are invisible.
    pub domain_id: u16,
    /// Announce on 127.0.0.1 only, and receive through the loopback interface only.
    pub loopback_only: bool,
    /// Names and remappings.
    pub args: RosArgs,
    /// The node has its lifecycle services elsewhere: it is joined over DDS too.
    pub is_managed_elsewhere: bool,
}

impl Ros2Options {
    /// Over DDS. The given domain, else that of `ROS_DOMAIN_ID`, else 0. Restricted to loopback if requested here or by
    /// `ROS_AUTOMATIC_DISCOVERY_RANGE` or `ROS_LOCALHOST_ONLY`.
    ///
    /// # Errors
    /// A domain that is not a number or exceeds 232; a variable whose value is invalid or not supported.
    pub fn new(domain_id: Option<u16>, loopback_only: bool, args: RosArgs) -> Result<Self, Ros2Error> {
        let domain_id = domain(domain_id)?;
        let discovery = Discovery::from_variables(|name| env::var(name).ok())?;
        for warning in &discovery.warnings {
            note!("{NOTE}{warning}");
        }
        let loopback_only = loopback_only || discovery.loopback_only;
        Ok(Self { middleware: Middleware::Dds, domain_id, loopback_only, args, is_managed_elsewhere: false })
    }

    /// Over Zenoh. Who is found depends on the settings of the session, not on the variables of DDS.
    ///
    /// # Errors
    /// A domain that is not a number or exceeds 232; a program built without Zenoh.
    pub fn over_zenoh(domain_id: Option<u16>, loopback_only: bool, args: RosArgs) -> Result<Self, Ros2Error> {
        if !super::zenoh::BUILT_IN {
            return Err(Ros2Error::NoZenoh);
        }
        let domain_id = domain(domain_id)?;
        Ok(Self { middleware: Middleware::Zenoh, domain_id, loopback_only, args, is_managed_elsewhere: false })
    }
}

/// The given domain, else that of `ROS_DOMAIN_ID`, else 0.
fn domain(given: Option<u16>) -> Result<u16, Ros2Error> {
    let domain_id = match (given, env::var("ROS_DOMAIN_ID")) {
        (Some(domain_id), _) => domain_id,
        (None, Ok(text)) if !text.trim().is_empty() => {
            text.trim().parse().map_err(|_| Ros2Error::DomainId(text.clone()))?
        }
        _ => 0,
    };
    if domain_id > MAX_DOMAIN_ID { Err(Ros2Error::DomainId(domain_id.to_string())) } else { Ok(domain_id) }
}

/// Why ROS 2 failed.
#[derive(Debug, Error)]
pub enum Ros2Error {
    #[error("ROS domain {0:?}, expected 0 to {MAX_DOMAIN_ID}")]
    DomainId(String),
    #[error("{variable}={value}: {reason}")]
    Discovery { variable: &'static str, value: String, reason: &'static str },
    #[error("{name:?} is no name of ROS 2: {reason}")]
    Name { name: String, reason: String },
    #[error("ROS node {name}: {reason}")]
    Node { name: String, reason: String },
    #[error("ROS topic {name}: {reason}")]
    Topic { name: String, reason: String },
    #[error(transparent)]
    Args(#[from] RosArgsError),
    #[error("ROS thread: {0}")]
    Thread(#[from] std::io::Error),
    #[error("Zenoh: {0}")]
    Zenoh(String),
    #[error("this program was built without Zenoh (--no-default-features)")]
    NoZenoh,
    #[error("not published on {topic}: {reason}")]
    Publish { topic: &'static str, reason: String },
    /// The error reported by the process of the ROS 2 side, or why that cannot be started.
    #[error("{0}")]
    Side(String),
}

/// What a node has beside operating points and the measured vibration.
struct Beside {
    temperature: Box<dyn FnMut(Received<Temperature>) + Send>,
    /// Blocks of samples of microphones and accelerometers.
    waveform: Box<dyn FnMut(Received<Waveform>) + Send>,
    /// The state in which the node starts, and what gets every later one.
    state: State,
    changed: Changed,
}

/// The node's side: receives operating points, the measured vibration, temperatures and samples, and publishes all other
/// topics.
pub struct Ros2 {
    // Declared first, because publishers must be dropped before the node.
    prediction: Publisher<Prediction>,
    /// The previous publisher, kept until its readers have found the present one.
    retired: Option<Publisher<Prediction>>,
    max_unanswered: i32,
    rig: Publisher<RigInfo>,
    session_event: Publisher<SessionEvent>,
    sensitivity: Publisher<Sensitivity>,
    diagnostics: Publisher<DiagnosticArray>,
    heard: Publisher<Heard>,
    /// `None` if the user has switched it off.
    rosout: Option<Publisher<Line>>,
    /// Counts of the blocks of samples.
    waveform_counters: Arc<Counters>,
    beats: Arc<AtomicU64>,
    /// Whether changes of parameters are passed on.
    started: Arc<AtomicBool>,
    link: Link<OperatingPoint>,
}

impl Ros2 {
    /// Joins the network and starts the node's thread. On that thread `sink` gets every operating point and `vibration`
    /// every measured vibration.
    ///
    /// # Errors
    /// Invalid names, an initial value that `validate` refuses, or an error of DDS.
    pub fn start(
        options: &Ros2Options,
        parameters: Parameters,
        sink: impl FnMut(Received<OperatingPoint>) + Send + 'static,
        vibration: impl FnMut(Received<Vibration>) + Send + 'static,
    ) -> Result<Self, Ros2Error> {
        Self::start_with(options, parameters, MAX_UNANSWERED, sink, vibration, None)
    }

    /// As [`Self::start`]. Publishing a prediction fails once a reader has left `max_unanswered` of them
    /// unacknowledged. With `beside`, temperatures and samples are received too, and the node is managed.
    fn start_with(
        options: &Ros2Options,
        parameters: Parameters,
        max_unanswered: i32,
        sink: impl FnMut(Received<OperatingPoint>) + Send + 'static,
        vibration: impl FnMut(Received<Vibration>) + Send + 'static,
        beside: Option<Beside>,
    ) -> Result<Self, Ros2Error> {
        let started = Arc::new(AtomicBool::new(false));
        let mut link = Link::join(options, NODE_NAME, parameters, started.clone())?;
        let prediction = prediction_publisher(&mut link, max_unanswered)?;
        let rig = link.publisher(topic::RIG, ours("RigInfo"), Durability::TransientLocal, MAX_UNANSWERED)?;
        let session_event =
            link.publisher(topic::SESSION_EVENT, ours("SessionEvent"), Durability::Volatile, MAX_UNANSWERED)?;
        let sensitivity =
            link.publisher(topic::SENSITIVITY, ours("Sensitivity"), Durability::Volatile, MAX_UNANSWERED)?;
        let diagnostics_type = MessageTypeName::new("diagnostic_msgs", "DiagnosticArray");
        let diagnostics = link.publisher(topic::DIAGNOSTICS, diagnostics_type, Durability::Volatile, MAX_UNANSWERED)?;
        let heard = link.publisher(topic::HEARD, ours("Heard"), Durability::Volatile, MAX_UNANSWERED)?;
        let rosout = link.rosout()?;
        let vibration = link.aside(topic::VIBRATION, ours("Vibration"), MAX_WAITING, vibration, Arc::default())?;
        let waveform_counters = Arc::<Counters>::default();
        let counters = waveform_counters.clone();
        let beside = beside
            .map(|Beside { temperature, waveform, state, changed }| {
                let kind = MessageTypeName::new("sensor_msgs", "Temperature");
                let temperature = link.aside(topic::TEMPERATURE, kind, MAX_WAITING, temperature, Arc::default())?;
                let waveform = link.aside(topic::WAVEFORM, ours("Waveform"), MAX_BLOCKS_WAITING, waveform, counters)?;
                let lifecycle = lifecycle::add(&mut link, state, changed)?;
                Ok::<_, Ros2Error>((temperature, waveform, lifecycle))
            })
            .transpose()?;
        let (package, name) = type_descriptions::SERVICE_TYPE;
        let kind = ServiceTypeName::new(package, name);
        let types = link.service(type_descriptions::SERVICE, &kind, |request| {
            type_descriptions::short_answer(&request, MAX_ANSWER)
        })?;
        let beats = Arc::new(AtomicU64::new(0));
        let beating = beats.clone();
        let aside = Box::pin(async move {
            let beside = async {
                if let Some((temperature, waveform, lifecycle)) = beside {
                    tokio::join!(temperature, waveform, lifecycle);
                }
            };
            tokio::join!(vibration, beside, types, beat(&beating));
        });
        link.listen(topic::OPERATING_POINT, ours("OperatingPoint"), |point| point.seq, sink, Some(aside))?;
        started.store(true, Ordering::Release);
        Ok(Self {
            prediction,
            retired: None,
            max_unanswered,
            rig,
            session_event,
            sensitivity,
            diagnostics,
            heard,
            rosout,
            waveform_counters,
            beats,
            started,
            link,
        })
    }

    /// Publishes a prediction without blocking.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`], as for the other topics: a reader has left more than a minute's worth of messages
    /// unacknowledged.
    pub fn publish_prediction(&self, prediction: &Prediction) -> Result<(), Ros2Error> {
        publish(&self.prediction, topic::PREDICTION, prediction)
    }

    /// Replaces the publisher of predictions, whose history is full because a reader does not acknowledge. The other
    /// readers take a moment to find the new publisher. Until [`Self::retire`] drops the old one, it continues to
    /// retransmit lost samples.
    ///
    /// # Errors
    /// An error of DDS.
    pub fn renew_prediction_publisher(&mut self) -> Result<(), Ros2Error> {
        let renewed = prediction_publisher(&mut self.link, self.max_unanswered)?;
        self.retired = Some(std::mem::replace(&mut self.prediction, renewed));
        Ok(())
    }

    /// Drops the previous publisher of predictions with the samples it kept for its readers.
    pub fn retire(&mut self) {
        self.retired = None;
    }

    /// Publishes the description of the rig, which is kept for late subscribers.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_rig(&self, rig: &RigInfo) -> Result<(), Ros2Error> {
        publish(&self.rig, topic::RIG, rig)
    }

    /// Publishes a session event.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_session_event(&self, event: &SessionEvent) -> Result<(), Ros2Error> {
        publish(&self.session_event, topic::SESSION_EVENT, event)
    }

    /// Takes over a parameter that was set elsewhere, without passing it on.
    pub fn take_setting(&self, event: &SessionEvent) {
        if SessionEventKind::of(event) != Some(SessionEventKind::Parameter) {
            return;
        }
        let value = ParameterValue::Double(event.value);
        // Peers set parameters under this lock too.
        let node = self.link.node();
        if node.get_parameter(&event.name).is_some_and(|present| present != value) {
            self.started.store(false, Ordering::Release);
            // The session has validated it.
            let _ = node.set_parameter(&event.name, value);
            self.started.store(true, Ordering::Release);
        }
    }

    /// Publishes sensitivities.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_sensitivity(&self, sensitivity: &Sensitivity) -> Result<(), Ros2Error> {
        publish(&self.sensitivity, topic::SENSITIVITY, sensitivity)
    }

    /// Number of readers of the sensitivities, including killed ones whose lease has not expired.
    pub fn sensitivity_readers(&self) -> usize {
        self.sensitivity.get_subscription_count(&self.link.node())
    }

    /// Publishes diagnostics.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_diagnostics(&self, diagnostics: &DiagnosticArray) -> Result<(), Ros2Error> {
        publish(&self.diagnostics, topic::DIAGNOSTICS, diagnostics)
    }

    /// Publishes a squeal found in sound.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_heard(&self, heard: &Heard) -> Result<(), Ros2Error> {
        publish(&self.heard, topic::HEARD, heard)
    }

    /// Writes a line to `/rosout`, unless the user wants only more severe ones.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn log(&self, severity: Severity, text: &str) -> Result<(), Ros2Error> {
        let Some(rosout) = self.rosout.as_ref().filter(|_| self.link.logs(severity)) else { return Ok(()) };
        publish(rosout, ROSOUT, &Line::new(&self.full_name(), severity, text))
    }

    /// Number of readers of the predictions, including killed ones whose lease has not expired. A [`Ros2Source`] counts
    /// twice: it has a reliable and a best-effort reader.
    pub fn prediction_readers(&self) -> usize {
        self.prediction.get_subscription_count(&self.link.node())
    }

    /// Number of readers of a topic published here, including killed ones whose lease has not expired.
    pub fn readers(&self, topic: Topic) -> usize {
        let node = &self.link.node();
        match topic {
            Topic::Prediction => self.prediction.get_subscription_count(node),
            Topic::RigInfo => self.rig.get_subscription_count(node),
            Topic::SessionEvent => self.session_event.get_subscription_count(node),
            Topic::Sensitivity => self.sensitivity.get_subscription_count(node),
            Topic::Diagnostics => self.diagnostics.get_subscription_count(node),
            Topic::Heard => self.heard.get_subscription_count(node),
            // Published by the rig.
            Topic::OperatingPoint | Topic::Vibration | Topic::Waveform | Topic::Temperature => 0,
        }
    }

    /// Number of known publishers of operating points, including killed ones whose lease has not expired. Messages sent
    /// by a peer before it is known here may be lost.
    pub fn operating_point_writers(&self) -> usize {
        self.link.writers()
    }

    /// Counts of operating points so far.
    pub fn counts(&self) -> Counts {
        self.link.counts()
    }

    /// Counts of the blocks of samples so far. Blocks have no sequence numbers: their stamps show what is missing.
    pub fn waveform_counts(&self) -> Counts {
        self.waveform_counters.counts()
    }

    /// A counter that grows ten times a second while the receiving thread is running.
    pub fn beats(&self) -> u64 {
        self.beats.load(Ordering::Relaxed)
    }

    /// The node's full name, after remapping.
    pub fn full_name(&self) -> String {
        self.link.node().fully_qualified_name()
    }

    /// Leaves the network, as dropping does.
    pub fn stop(self) {}
}

/// The rig's side: publishes operating points, measured vibration, temperatures and samples, receives predictions.
pub struct Ros2Source {
    operating_point: Publisher<OperatingPoint>,
    vibration: Publisher<Vibration>,
    temperature: Publisher<Temperature>,
    waveform: Publisher<Waveform>,
    link: Link<Prediction>,
}

impl Ros2Source {
    /// Joins the network and starts the node's thread, on which `sink` gets every prediction.
    ///
    /// # Errors
    /// Invalid names, or an error of DDS.
    pub fn start(
        options: &Ros2Options,
        sink: impl FnMut(Received<Prediction>) + Send + 'static,
    ) -> Result<Self, Ros2Error> {
        let mut link = Link::join(options, SOURCE_NODE_NAME, Parameters::none(), Arc::new(AtomicBool::new(true)))?;
        let operating_point =
            link.publisher(topic::OPERATING_POINT, ours("OperatingPoint"), Durability::Volatile, MAX_UNANSWERED)?;
        let vibration = link.publisher(topic::VIBRATION, ours("Vibration"), Durability::Volatile, MAX_UNANSWERED)?;
        let kind = MessageTypeName::new("sensor_msgs", "Temperature");
        let temperature = link.publisher(topic::TEMPERATURE, kind, Durability::Volatile, MAX_UNANSWERED)?;
        let waveform = link.publisher(topic::WAVEFORM, ours("Waveform"), Durability::Volatile, MAX_BLOCKS_WAITING)?;
        link.listen(topic::PREDICTION, ours("Prediction"), |prediction| prediction.input_seq, sink, None)?;
        Ok(Self { operating_point, vibration, temperature, waveform, link })
    }

    /// Publishes an operating point without blocking.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish(&self, point: &OperatingPoint) -> Result<(), Ros2Error> {
        publish(&self.operating_point, topic::OPERATING_POINT, point)
    }

    /// Publishes a measured vibration without blocking.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_vibration(&self, vibration: &Vibration) -> Result<(), Ros2Error> {
        publish(&self.vibration, topic::VIBRATION, vibration)
    }

    /// Publishes a temperature of the contact without blocking.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_temperature(&self, temperature: &Temperature) -> Result<(), Ros2Error> {
        publish(&self.temperature, topic::TEMPERATURE, temperature)
    }

    /// Number of readers of the temperature, including killed ones whose lease has not expired. A node counts twice.
    pub fn temperature_readers(&self) -> usize {
        self.temperature.get_subscription_count(&self.link.node())
    }

    /// Publishes a block of samples without blocking.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_waveform(&self, waveform: &Waveform) -> Result<(), Ros2Error> {
        publish(&self.waveform, topic::WAVEFORM, waveform)
    }

    /// Number of readers of the samples, including killed ones whose lease has not expired. A node counts twice.
    pub fn waveform_readers(&self) -> usize {
        self.waveform.get_subscription_count(&self.link.node())
    }

    /// Number of readers of the operating points, including killed ones whose lease has not expired. A node counts
    /// twice: it has a reliable and a best-effort reader.
    pub fn readers(&self) -> usize {
        self.operating_point.get_subscription_count(&self.link.node())
    }

    /// Number of readers of the vibration, including killed ones whose lease has not expired. A node counts twice.
    pub fn vibration_readers(&self) -> usize {
        self.vibration.get_subscription_count(&self.link.node())
    }

    /// Number of known publishers of predictions, including killed ones whose lease has not expired.
    pub fn prediction_writers(&self) -> usize {
        self.link.writers()
    }

    /// Counts of predictions so far.
    pub fn counts(&self) -> Counts {
        self.link.counts()
    }

    /// Leaves the network, as dropping does.
    pub fn stop(self) {}
}

impl Message for type_descriptions::Request {}
impl Message for type_descriptions::Response {}

fn prediction_publisher(
    link: &mut Link<OperatingPoint>,
    max_unanswered: i32,
) -> Result<Publisher<Prediction>, Ros2Error> {
    link.publisher(topic::PREDICTION, ours("Prediction"), Durability::Volatile, max_unanswered)
}

/// A message type of `squealcast_msgs`.
fn ours(name: &str) -> MessageTypeName {
    MessageTypeName::new("squealcast_msgs", name)
}

fn publish<M: Serialize + Clone>(publisher: &Publisher<M>, topic: &'static str, message: &M) -> Result<(), Ros2Error> {
    publisher
        .publish(message.clone())
        .map_err(|error| Ros2Error::Publish { topic, reason: error.forget_data().to_string() })
}

/// Counts up while the thread it runs on is not blocked.
async fn beat(beats: &AtomicU64) {
    loop {
        beats.fetch_add(1, Ordering::Relaxed);
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// A message received over ROS 2 now.
fn received<M>(message: M) -> Received<M> {
    Received::now(Bus::Ros2, message)
}
