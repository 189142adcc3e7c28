//! Publishes recorded messages on the live buses.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};

use crate::io::message::Payload;
use crate::io::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use crate::io::shm::{ShmOptions, ShmOutput, ShmSensitivity, ShmSource, ShmVibrationSource};
use crate::wire::schema::Topic;

/// Readers are awaited until no further one has come for so long.
const SETTLED: Duration = Duration::from_millis(500);

/// Readers of a topic that rig or node hears over ROS 2 which are the replay's own: one for reliable publishers and one for others.
const OWN_READERS: usize = 2;

/// What a recording is played to.
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
    /// A bus that cannot be joined; no bus.
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
            // The node's own name stays free for a node that listens.
            ros2.args = ros2.args.renamed("squealcast_replay");
            anyhow::Ok((source, Ros2::start(&ros2, Parameters::none(), |_| {}, |_| {})?))
        });
        Ok(Self {
            shm: shm.context("shared memory; --no-shm stays off it")?,
            ros2: ros2.transpose().context("ROS 2; --no-ros stays off it")?,
        })
    }

    /// How many readers a topic has on the buses joined.
    fn readers(&self, topic: Topic) -> usize {
        let shm = self.shm.as_ref().map_or(0, |shm| match topic {
            Topic::OperatingPoint => shm.inputs.readers(),
            Topic::Vibration => shm.vibrations.readers(),
            Topic::Prediction => shm.predictions.readers(),
            Topic::Sensitivity => shm.sensitivities.readers(),
            Topic::SessionEvent | Topic::RigInfo | Topic::Diagnostics => 0, // no shared-memory form
        });
        // Rig and node hear each other here.
        let ros2 = self.ros2.as_ref().map_or(0, |(rig, node)| match topic {
            Topic::OperatingPoint => rig.readers().saturating_sub(OWN_READERS),
            Topic::Vibration => rig.vibration_readers().saturating_sub(OWN_READERS),
            Topic::Prediction => node.readers(topic).saturating_sub(OWN_READERS),
            Topic::Sensitivity | Topic::SessionEvent | Topic::RigInfo | Topic::Diagnostics => node.readers(topic),
        });
        shm + ros2
    }

    /// Waits until one of `topics` has a reader and no further one has come for half a second, so that none of them loses the
    /// first messages; whether there is one. Waits for the first no longer than `limit`, and for none once `stopped`.
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
    /// A bus refuses it.
    pub fn publish(&self, payload: &Payload) -> anyhow::Result<()> {
        if let Some(shm) = &self.shm {
            match payload {
                Payload::OperatingPoint(message) => drop(shm.inputs.publish(message)?),
                Payload::Prediction(message) => drop(shm.predictions.publish(message)?),
                Payload::Vibration(message) => drop(shm.vibrations.publish(message)?),
                Payload::Sensitivity(message) => drop(shm.sensitivities.publish(message)?),
                // No shared-memory form.
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
