//! ROS 2: the node `/squealcast`, and its mirror, a rig that publishes conditions and hears predictions.
//!
//! A node that runs for long holds its [`Ros2`] in a child process, [`process::Ros2Process`]: a datagram can make RustDDS allocate
//! without bound. What ends with its task (`simulate`, `replay`) holds it itself.
//!
//! Pure Rust DDS underneath (RustDDS): no ROS 2 installation is needed. Publishing works from any thread and never
//! waits. A peer that was killed is only forgotten after its lease; who listens should look at sequence numbers.

mod discovery;
mod ears;
mod frame;
mod link;
mod loopback;
pub mod process;
mod qos_conflicts;
pub mod side;

use std::env;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use ros2_client::{MessageTypeName, NodeOptions, ParameterValue, Publisher};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use self::discovery::Discovery;
use self::link::{Durability, Link, MAX_UNANSWERED};
use super::heard::{Bus, Counts, Heard};
use super::ros_args::{RosArgs, USE_SIM_TIME};
use crate::wire::schema::Topic;
use crate::wire::{DiagnosticArray, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent, Vibration, topic};

/// The name of the node, before remapping.
pub const NODE_NAME: &str = "squealcast";
/// The name of the mirror's node, before remapping.
pub const SOURCE_NODE_NAME: &str = "rig";

/// How notes about ROS 2 begin.
const NOTE: &str = "ROS 2: ";

/// The largest domain whose ports exist.
const MAX_DOMAIN_ID: u16 = 232;

/// How to join the ROS 2 network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ros2Options {
    /// 0 to 232; peers of another domain do not exist.
    pub domain_id: u16,
    /// Announces itself on 127.0.0.1 only, and hears what comes in by the loopback interface only.
    pub loopback_only: bool,
    /// Names and remappings.
    pub args: RosArgs,
}

impl Ros2Options {
    /// The given domain, or that of `ROS_DOMAIN_ID`, or 0; on loopback alone if that is asked for here or by
    /// `ROS_AUTOMATIC_DISCOVERY_RANGE` or `ROS_LOCALHOST_ONLY`.
    ///
    /// # Errors
    /// A domain that is no number or beyond 232; a variable whose value is none, or cannot be done.
    pub fn new(domain_id: Option<u16>, loopback_only: bool, args: RosArgs) -> Result<Self, Ros2Error> {
        let domain_id = match (domain_id, env::var("ROS_DOMAIN_ID")) {
            (Some(domain_id), _) => domain_id,
            (None, Ok(text)) if !text.trim().is_empty() => {
                text.trim().parse().map_err(|_| Ros2Error::DomainId(text.clone()))?
            }
            _ => 0,
        };
        if domain_id > MAX_DOMAIN_ID {
            return Err(Ros2Error::DomainId(domain_id.to_string()));
        }
        let discovery = Discovery::from_variables(|name| env::var(name).ok())?;
        for warning in &discovery.warnings {
            note!("{NOTE}{warning}");
        }
        Ok(Self { domain_id, loopback_only: loopback_only || discovery.loopback_only, args })
    }
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
    #[error("ROS thread: {0}")]
    Thread(#[from] std::io::Error),
    #[error("not published on {topic}: {reason}")]
    Publish { topic: &'static str, reason: String },
    /// What the process of the ROS 2 side says, or why it cannot be started.
    #[error("{0}")]
    Side(String),
}

/// Judges a parameter's value before it is taken; the text of a refusal is what the peer gets to read.
pub type Validate = Box<dyn Fn(&str, f64) -> Result<(), String> + Send + Sync>;
/// Gets a parameter's value after it was taken.
pub type Accepted = Box<dyn Fn(&str, f64) + Send + Sync>;

/// The parameters of the node.
pub struct Parameters {
    /// Names and the values they start with (see [`RosArgs::parameters`]).
    pub values: Vec<(String, f64)>,
    /// Asked for every value, those to start with included.
    pub validate: Validate,
    /// Gets every value that a peer has set, after it passed; runs on the node's thread.
    pub accepted: Accepted,
}

impl Parameters {
    /// No parameters.
    pub fn none() -> Self {
        Self { values: Vec::new(), validate: Box::new(|_, _| Ok(())), accepted: Box::new(|_, _| ()) }
    }

    /// Node options with these parameters. Values reach `accepted` only once `started` is set: until then the node
    /// sets the values it was given.
    fn declare(self, started: Arc<AtomicBool>) -> NodeOptions {
        let Self { values, validate, accepted } = self;
        let options = NodeOptions::new()
            .enable_rosout(true)
            .start_parameter_services(true)
            .parameter_validator(Box::new(move |name, value| match value {
                ParameterValue::Double(value) if !value.is_finite() => Err(format!("{name}: {value} is not finite")),
                ParameterValue::Double(value) => validate(name, *value),
                ParameterValue::NotSet => Err(format!("{name} cannot be removed")),
                _ => Err(format!("{name} is a double")),
            }))
            .parameter_set_action(Box::new(move |name, value| {
                if let (ParameterValue::Double(value), true) = (value, started.load(Ordering::Acquire)) {
                    accepted(name, *value);
                }
                Ok(())
            }));
        values
            .iter()
            .filter(|(name, _)| name != USE_SIM_TIME)
            .fold(options, |options, (name, value)| options.declare_parameter(name, ParameterValue::Double(*value)))
    }
}

/// The node's side: hears operating points and the measured vibration, publishes everything else.
pub struct Ros2 {
    // First: publishers go before the node.
    prediction: Publisher<Prediction>,
    /// The publisher before it, while its readers find the present one.
    retired: Option<Publisher<Prediction>>,
    max_unanswered: i32,
    rig: Publisher<RigInfo>,
    session_event: Publisher<SessionEvent>,
    sensitivity: Publisher<Sensitivity>,
    diagnostics: Publisher<DiagnosticArray>,
    beats: Arc<AtomicU64>,
    link: Link<OperatingPoint>,
}

impl Ros2 {
    /// Joins the network and starts the node's thread; every operating point goes to `sink`, every measured vibration to
    /// `vibration`, on that thread.
    ///
    /// # Errors
    /// Names that are none, a value that `validate` refuses, or whatever DDS refuses.
    pub fn start(
        options: &Ros2Options,
        parameters: Parameters,
        sink: impl FnMut(Heard<OperatingPoint>) + Send + 'static,
        vibration: impl FnMut(Heard<Vibration>) + Send + 'static,
    ) -> Result<Self, Ros2Error> {
        Self::start_with(options, parameters, MAX_UNANSWERED, sink, vibration)
    }

    /// As [`Self::start`]; publishing a prediction fails once a reader has left `max_unanswered` unacknowledged.
    fn start_with(
        options: &Ros2Options,
        parameters: Parameters,
        max_unanswered: i32,
        sink: impl FnMut(Heard<OperatingPoint>) + Send + 'static,
        vibration: impl FnMut(Heard<Vibration>) + Send + 'static,
    ) -> Result<Self, Ros2Error> {
        let started = Arc::new(AtomicBool::new(false));
        let mut link = Link::join(options, NODE_NAME, parameters.declare(Arc::clone(&started)))?;
        let prediction = prediction_publisher(&mut link, max_unanswered)?;
        let rig = link.publisher(topic::RIG, ours("RigInfo"), Durability::TransientLocal, MAX_UNANSWERED)?;
        let session_event =
            link.publisher(topic::SESSION_EVENT, ours("SessionEvent"), Durability::Volatile, MAX_UNANSWERED)?;
        let sensitivity =
            link.publisher(topic::SENSITIVITY, ours("Sensitivity"), Durability::Volatile, MAX_UNANSWERED)?;
        let diagnostics_type = MessageTypeName::new("diagnostic_msgs", "DiagnosticArray");
        let diagnostics = link.publisher(topic::DIAGNOSTICS, diagnostics_type, Durability::Volatile, MAX_UNANSWERED)?;
        let vibration = link.aside(topic::VIBRATION, ours("Vibration"), vibration)?;
        let beats = Arc::new(AtomicU64::new(0));
        let beating = beats.clone();
        let aside = Box::pin(async move {
            tokio::join!(vibration, beat(&beating));
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
            beats,
            link,
        })
    }

    /// Publishes a prediction, without waiting.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`], as for the others: more than a minute's worth waits for a reader that does not answer.
    pub fn publish_prediction(&self, prediction: &Prediction) -> Result<(), Ros2Error> {
        publish(&self.prediction, topic::PREDICTION, prediction)
    }

    /// Puts another publisher of predictions in the place of the present one, which has no room left because a reader does not
    /// acknowledge. The other readers take a moment to find it; the present one repairs until then, when
    /// [`Self::retire`] drops it.
    ///
    /// # Errors
    /// Whatever DDS refuses.
    pub fn renew_prediction_publisher(&mut self) -> Result<(), Ros2Error> {
        let renewed = prediction_publisher(&mut self.link, self.max_unanswered)?;
        self.retired = Some(std::mem::replace(&mut self.prediction, renewed));
        Ok(())
    }

    /// Drops the publisher of predictions before the present one, and what it kept for readers.
    pub fn retire(&mut self) {
        self.retired = None;
    }

    /// Publishes what the node predicts for; kept for readers that come later.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_rig(&self, rig: &RigInfo) -> Result<(), Ros2Error> {
        publish(&self.rig, topic::RIG, rig)
    }

    /// Publishes what else shaped predictions.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_session_event(&self, event: &SessionEvent) -> Result<(), Ros2Error> {
        publish(&self.session_event, topic::SESSION_EVENT, event)
    }

    /// Publishes how predictions change with conditions and contact.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_sensitivity(&self, sensitivity: &Sensitivity) -> Result<(), Ros2Error> {
        publish(&self.sensitivity, topic::SENSITIVITY, sensitivity)
    }

    /// How many readers the sensitivities have, those included that were killed less than their lease ago.
    pub fn sensitivity_readers(&self) -> usize {
        self.sensitivity.get_subscription_count(self.link.node())
    }

    /// Publishes how the node does.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_diagnostics(&self, diagnostics: &DiagnosticArray) -> Result<(), Ros2Error> {
        publish(&self.diagnostics, topic::DIAGNOSTICS, diagnostics)
    }

    /// How many readers the predictions have, those included that were killed less than their lease ago. A [`Ros2Source`] has
    /// two: a reliable one and a best-effort one.
    pub fn prediction_readers(&self) -> usize {
        self.prediction.get_subscription_count(self.link.node())
    }

    /// How many readers a topic has that is published here, those included that were killed less than their lease ago.
    pub fn readers(&self, topic: Topic) -> usize {
        let node = self.link.node();
        match topic {
            Topic::Prediction => self.prediction.get_subscription_count(node),
            Topic::RigInfo => self.rig.get_subscription_count(node),
            Topic::SessionEvent => self.session_event.get_subscription_count(node),
            Topic::Sensitivity => self.sensitivity.get_subscription_count(node),
            Topic::Diagnostics => self.diagnostics.get_subscription_count(node),
            // Published by the rig.
            Topic::OperatingPoint | Topic::Vibration => 0,
        }
    }

    /// How many publishers of operating points are known, those included that were killed less than their lease ago.
    /// What a peer sends before it is known here may be lost.
    pub fn operating_point_writers(&self) -> usize {
        self.link.writers()
    }

    /// What was counted of the operating points so far.
    pub fn counts(&self) -> Counts {
        self.link.counts()
    }

    /// A number that grows ten times a second while the thread that hears is well.
    pub fn beats(&self) -> u64 {
        self.beats.load(Ordering::Relaxed)
    }

    /// The node's full name, after remapping.
    pub fn full_name(&self) -> String {
        self.link.node().fully_qualified_name()
    }

    /// Leaves the network; dropping does the same.
    pub fn stop(self) {}
}

/// The rig's side: publishes operating points and its measured vibration, hears predictions.
pub struct Ros2Source {
    operating_point: Publisher<OperatingPoint>,
    vibration: Publisher<Vibration>,
    link: Link<Prediction>,
}

impl Ros2Source {
    /// Joins the network and starts the node's thread; every prediction goes to `sink`, on that thread.
    ///
    /// # Errors
    /// Names that are none, or whatever DDS refuses.
    pub fn start(
        options: &Ros2Options,
        sink: impl FnMut(Heard<Prediction>) + Send + 'static,
    ) -> Result<Self, Ros2Error> {
        let node_options = Parameters::none().declare(Arc::new(AtomicBool::new(true)));
        let mut link = Link::join(options, SOURCE_NODE_NAME, node_options)?;
        let operating_point =
            link.publisher(topic::OPERATING_POINT, ours("OperatingPoint"), Durability::Volatile, MAX_UNANSWERED)?;
        let vibration = link.publisher(topic::VIBRATION, ours("Vibration"), Durability::Volatile, MAX_UNANSWERED)?;
        link.listen(topic::PREDICTION, ours("Prediction"), |prediction| prediction.input_seq, sink, None)?;
        Ok(Self { operating_point, vibration, link })
    }

    /// Publishes an operating point, without waiting.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish(&self, point: &OperatingPoint) -> Result<(), Ros2Error> {
        publish(&self.operating_point, topic::OPERATING_POINT, point)
    }

    /// Publishes a measured vibration, without waiting.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    pub fn publish_vibration(&self, vibration: &Vibration) -> Result<(), Ros2Error> {
        publish(&self.vibration, topic::VIBRATION, vibration)
    }

    /// How many readers the operating points have, those included that were killed less than their lease ago. A node has two:
    /// a reliable one and a best-effort one.
    pub fn readers(&self) -> usize {
        self.operating_point.get_subscription_count(self.link.node())
    }

    /// How many readers the vibration has, those included that were killed less than their lease ago; a node has two.
    pub fn vibration_readers(&self) -> usize {
        self.vibration.get_subscription_count(self.link.node())
    }

    /// How many publishers of predictions are known, those included that were killed less than their lease ago.
    pub fn prediction_writers(&self) -> usize {
        self.link.writers()
    }

    /// What was counted of the predictions so far.
    pub fn counts(&self) -> Counts {
        self.link.counts()
    }

    /// Leaves the network; dropping does the same.
    pub fn stop(self) {}
}

fn prediction_publisher(
    link: &mut Link<OperatingPoint>,
    max_unanswered: i32,
) -> Result<Publisher<Prediction>, Ros2Error> {
    link.publisher(topic::PREDICTION, ours("Prediction"), Durability::Volatile, max_unanswered)
}

/// A type of `squealcast_msgs`.
fn ours(name: &str) -> MessageTypeName {
    MessageTypeName::new("squealcast_msgs", name)
}

fn publish<M: Serialize + Clone>(publisher: &Publisher<M>, topic: &'static str, message: &M) -> Result<(), Ros2Error> {
    publisher
        .publish(message.clone())
        .map_err(|error| Ros2Error::Publish { topic, reason: error.forget_data().to_string() })
}

/// Shows that the thread it runs on is not held up.
async fn beat(beats: &AtomicU64) {
    loop {
        beats.fetch_add(1, Ordering::Relaxed);
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// Everything heard here came over ROS 2.
fn heard<M>(message: M) -> Heard<M> {
    Heard::now(Bus::Ros2, message)
}
