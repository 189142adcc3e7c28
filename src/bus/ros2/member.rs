//! The node as the process that contains it sees it, whether it is on DDS or on Zenoh.

use super::{Ros2, Ros2Error};
use crate::bus::{Counts, Outgoing};
use crate::msgs::SessionEvent;
use crate::msgs::schema::Topic;

/// A node that has joined. It leaves when it is dropped.
pub trait Member {
    /// Its full name, after remapping.
    fn full_name(&self) -> String;

    /// A counter that grows as long as the node can receive.
    fn beats(&self) -> u64;

    /// Publishes a message without blocking, unless its topic is published by rigs.
    ///
    /// # Errors
    /// [`Ros2Error::Publish`].
    fn publish(&self, message: Outgoing<'_>) -> Result<(), Ros2Error>;

    /// Number of readers of a topic that it publishes.
    fn readers(&self, topic: Topic) -> usize;

    /// Number of known publishers of operating points.
    fn operating_point_writers(&self) -> usize;

    /// Counts of operating points so far.
    fn counts(&self) -> Counts;

    /// Counts of blocks of samples so far.
    fn waveform_counts(&self) -> Counts;

    /// Replaces the publisher of predictions, whose history is full. Returns whether that can help: where a slow reader
    /// delays nobody, there is nothing to replace.
    ///
    /// # Errors
    /// The publisher cannot be made.
    fn renew_prediction_publisher(&mut self) -> Result<bool, Ros2Error> {
        Ok(false)
    }

    /// Takes over a parameter that was set elsewhere, without passing it on.
    fn take_setting(&self, event: &SessionEvent);

    /// Drops the publisher that was replaced.
    fn retire(&mut self) {}
}

impl Member for Ros2 {
    fn full_name(&self) -> String {
        Self::full_name(self)
    }

    fn beats(&self) -> u64 {
        Self::beats(self)
    }

    fn publish(&self, message: Outgoing<'_>) -> Result<(), Ros2Error> {
        match message {
            Outgoing::Prediction(message) => self.publish_prediction(message),
            Outgoing::RigInfo(message) => self.publish_rig(message),
            Outgoing::SessionEvent(message) => self.publish_session_event(message),
            Outgoing::Sensitivity(message) => self.publish_sensitivity(message),
            Outgoing::Diagnostics(message) => self.publish_diagnostics(message),
            Outgoing::Heard(message) => self.publish_heard(message),
            Outgoing::Log(severity, text) => self.log(severity, text),
            // Published by the rig.
            Outgoing::OperatingPoint(_) | Outgoing::Vibration(_) | Outgoing::Waveform(_) | Outgoing::Temperature(_) => {
                Ok(())
            }
        }
    }

    fn readers(&self, topic: Topic) -> usize {
        Self::readers(self, topic)
    }

    fn operating_point_writers(&self) -> usize {
        Self::operating_point_writers(self)
    }

    fn counts(&self) -> Counts {
        Self::counts(self)
    }

    fn waveform_counts(&self) -> Counts {
        Self::waveform_counts(self)
    }

    fn renew_prediction_publisher(&mut self) -> Result<bool, Ros2Error> {
        Self::renew_prediction_publisher(self).map(|()| true)
    }

    fn take_setting(&self, event: &SessionEvent) {
        Self::take_setting(self, event);
    }

    fn retire(&mut self) {
        Self::retire(self);
    }
}
