//! The participants: a node, a rig and a replay.

use super::Receivers;
use super::node::{Offered, ZenohNode};
use crate::bus::lifecycle::State;
use crate::bus::managed::{Changed, Managed};
use crate::bus::ros2::member::Member;
use crate::bus::ros2::{NODE_NAME, Parameters, REPLAY_NODE_NAME, Ros2Error, Ros2Options, SOURCE_NODE_NAME};
use crate::bus::{Bus, BusError, Connection, Counts, Outgoing};
use crate::msgs::SessionEvent;
use crate::msgs::schema::Topic;

/// Topics that a node publishes.
const OF_NODE: [Topic; 6] =
    [Topic::Prediction, Topic::RigInfo, Topic::SessionEvent, Topic::Sensitivity, Topic::Diagnostics, Topic::Heard];
/// Topics that a rig publishes.
const OF_RIG: [Topic; 4] = [Topic::OperatingPoint, Topic::Vibration, Topic::Temperature, Topic::Waveform];

/// Joins as a node with these parameters, which starts in `state` and receives what `receivers` take. `changed` gets every
/// state into which a peer brings it.
///
/// # Errors
/// Settings or names that are not valid, or an error of Zenoh.
pub fn member(
    options: &Ros2Options,
    receivers: Receivers,
    parameters: Parameters,
    state: State,
    changed: Changed,
) -> Result<Box<dyn Member>, Ros2Error> {
    let managed = (!options.is_managed_elsewhere).then(|| Managed::new(state, changed));
    let offered = Offered { parameters, managed };
    Ok(Box::new(ZenohNode::join(options, NODE_NAME, &OF_NODE, receivers, Some(offered))?))
}

/// Joins as a rig, which publishes what it measures.
///
/// # Errors
/// As [`member`].
pub fn rig(options: &Ros2Options) -> Result<Box<dyn Connection>, Ros2Error> {
    Ok(Box::new(ZenohNode::join(options, SOURCE_NODE_NAME, &OF_RIG, Receivers::default(), None)?))
}

/// Joins as a replay, which publishes the messages of a rig and of its node.
///
/// # Errors
/// As [`member`].
pub fn replay(options: &Ros2Options) -> Result<Box<dyn Connection>, Ros2Error> {
    let published = [&OF_RIG[..], &OF_NODE].concat();
    let options = Ros2Options { args: options.args.clone().renamed(REPLAY_NODE_NAME), ..options.clone() };
    Ok(Box::new(ZenohNode::join(&options, REPLAY_NODE_NAME, &published, Receivers::default(), None)?))
}

impl Connection for ZenohNode {
    fn bus(&self) -> Bus {
        Bus::Zenoh
    }

    fn publish(&mut self, message: Outgoing<'_>) -> Result<(), BusError> {
        Ok(Self::publish(self, message)?)
    }

    fn readers(&self, topic: Topic) -> usize {
        Self::readers(self, topic)
    }
}

impl Member for ZenohNode {
    fn full_name(&self) -> String {
        Self::full_name(self)
    }

    fn beats(&self) -> u64 {
        Self::beats(self)
    }

    fn publish(&self, message: Outgoing<'_>) -> Result<(), Ros2Error> {
        Self::publish(self, message)
    }

    fn readers(&self, topic: Topic) -> usize {
        Self::readers(self, topic)
    }

    fn operating_point_writers(&self) -> usize {
        self.writers(Topic::OperatingPoint)
    }

    fn counts(&self) -> Counts {
        Self::counts(self)
    }

    fn waveform_counts(&self) -> Counts {
        Self::waveform_counts(self)
    }

    fn take_setting(&self, event: &SessionEvent) {
        Self::take_setting(self, event);
    }
}
