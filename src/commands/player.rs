//! Publishes recorded messages on the live buses.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};

use crate::bus::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use crate::bus::shm::{ShmOptions, ShmOutput, ShmSensitivity, ShmSource, ShmVibrationSource};
use crate::msgs::schema::Topic;
use crate::recording::message::Payload;

/// Time without a new reader after which waiting for readers ends.
const SETTLED: Duration = Duration::from_millis(500);

/// Number of the replay's own readers of a topic on ROS 2: a reliable and a best-effort one.
const OWN_READERS: usize = 2;

/// The buses to which a recording is played.
pub struct Player {
    shm: Option<Shm>,
    ros2: Option<(Ros2Source, Ros2)>,
}

struct Shm {
    inputs: ShmSource,
    vibrations: ShmVibrationSource,
    predictions: ShmOutput,
    sensitivities: ShmSensitivity,
}

impl Player {
    /// Joins the buses.
    ///
    /// # Errors
    /// A bus cannot be joined, or none was requested.
    pub fn join(shm: Option<ShmOptions>, ros2: Option<Ros2Options>) -> anyhow::Result<Self> {
        ensure!(shm.is_some() || ros2.is_some(), "nothing to play to: both --no-shm and --no-ros are given");
        let ports = |shm| {
            anyhow::Ok(Shm {
                inputs: ShmSource::new(shm)?,
                vibrations: ShmVibrationSource::new(shm)?,
                predictions: ShmOutput::new(shm)?,
                sensitivities: ShmSensitivity::new(shm)?,
            })
        };
        let shm = shm.as_ref().map(ports).transpose();
        let ros2 = ros2.map(|mut ros2| {
            let source = Ros2Source::start(&ros2, |_| {})?;
            // The default node name remains free for a node that receives the messages.
            ros2.args = ros2.args.renamed("squealcast_replay");
            anyhow::Ok((source, Ros2::start(&ros2, Parameters::none(), |_| {}, |_| {})?))
        });
        Ok(Self {
            shm: shm.context("shared memory; --no-shm stays off it")?,
            ros2: ros2.transpose().context("ROS 2; --no-ros stays off it")?,
        })
    }

    /// Number of readers of a topic on all buses joined.
    fn readers(&self, topic: Topic) -> usize {
        let shm = self.shm.as_ref().map_or(0, |shm| match topic {
            Topic::OperatingPoint => shm.inputs.readers(),
            Topic::Vibration => shm.vibrations.readers(),
            Topic::Prediction => shm.predictions.readers(),
            Topic::Sensitivity => shm.sensitivities.readers(),
            Topic::SessionEvent | Topic::RigInfo | Topic::Diagnostics => 0, // no shared-memory form
        });
        // The replay's rig and node receive each other's messages.
        let ros2 = self.ros2.as_ref().map_or(0, |(rig, node)| match topic {
            Topic::OperatingPoint => rig.readers().saturating_sub(OWN_READERS),
            Topic::Vibration => rig.vibration_readers().saturating_sub(OWN_READERS),
            Topic::Prediction => node.readers(topic).saturating_sub(OWN_READERS),
            Topic::Sensitivity | Topic::SessionEvent | Topic::RigInfo | Topic::Diagnostics => node.readers(topic),
        });
        shm + ros2
    }

    /// Waits until one of `topics` has a reader and no new one has appeared for half a second, so that no reader misses
    /// the first messages. Returns whether there is a reader. The first reader is awaited for at most `limit`, and not
    /// after `stopped`.
    pub fn wait_for_readers(&self, topics: &[Topic], limit: Duration, stopped: &AtomicBool) -> bool {
        let started = Instant::now();
        let (mut known, mut changed) = (0, started);
        while !stopped.load(Ordering::Relaxed) {
            let readers = topics.iter().map(|topic| self.readers(*topic)).sum();
            if readers != known {
                (known, changed) = (readers, Instant::now());
            }
            if known == 0 && started.elapsed() >= limit {
                return false;
            }
            if known > 0 && changed.elapsed() >= SETTLED {
                return true;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        known > 0
    }

    /// Publishes a message.
    ///
    /// # Errors
    /// A bus refuses the message.
    pub fn publish(&self, payload: &Payload) -> anyhow::Result<()> {
        if let Some(shm) = &self.shm {
            match payload {
                Payload::OperatingPoint(message) => drop(shm.inputs.publish(message)?),
                Payload::Prediction(message) => drop(shm.predictions.publish(message)?),
                Payload::Vibration(message) => drop(shm.vibrations.publish(message)?),
                Payload::Sensitivity(message) => drop(shm.sensitivities.publish(message)?),
                // These have no shared-memory form.
                Payload::SessionEvent(_) | Payload::RigInfo(_) | Payload::Diagnostics(_) => {}
            }
        }
        if let Some((inputs, others)) = &self.ros2 {
            match payload {
                Payload::OperatingPoint(message) => inputs.publish(message)?,
                Payload::Prediction(message) => others.publish_prediction(message)?,
                Payload::SessionEvent(message) => others.publish_session_event(message)?,
                Payload::RigInfo(message) => others.publish_rig(message)?,
                Payload::Sensitivity(message) => others.publish_sensitivity(message)?,
                Payload::Diagnostics(message) => others.publish_diagnostics(message)?,
                Payload::Vibration(message) => inputs.publish_vibration(message)?,
            }
        }
        Ok(())
    }
}
