//! ROS 2 as a bus: the connections of a node, of a rig and of a replay.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::process::{Health, Ros2Process, Sinks};
use super::{Middleware, Parameters, REPLAY_NODE_NAME, Ros2, Ros2Error, Ros2Options, Ros2Source};
use crate::bus::lifecycle::State;
use crate::bus::{Bus, BusError, Connection, Outgoing, Report, Sink};
use crate::msgs::schema::Topic;

/// The connection of a long-running node, whose ROS 2 side is a child process.
pub struct Ros2NodeConnection {
    middleware: Middleware,
    process: Ros2Process,
    readers: Readers,
    encodings_skipped: u64,
    /// State at the last report.
    health_before: Health,
}

impl Ros2NodeConnection {
    /// Starts the ROS 2 side with these initial `parameters`, in this `state`, and passes what it receives to `sink`.
    ///
    /// # Errors
    /// As [`Ros2Process::start`].
    pub fn start(
        options: &Ros2Options,
        parameters: Vec<(String, f64)>,
        state: State,
        sink: &Arc<dyn Sink>,
    ) -> Result<Self, Ros2Error> {
        let middleware = options.middleware;
        let [inputs, vibrations, temperatures, waveforms, changes, states] = std::array::from_fn(|_| sink.clone());
        let sinks = Sinks {
            // The thread that receives from the child process serves all topics: it must not be held up.
            input: Box::new(move |received| {
                if inputs.takes_inputs() {
                    inputs.operating_point(received, false);
                }
            }),
            vibration: Box::new(move |received| {
                if vibrations.takes_inputs() {
                    vibrations.vibration(received);
                }
            }),
            temperature: Box::new(move |received| {
                if temperatures.takes_inputs() {
                    temperatures.temperature(received);
                }
            }),
            waveform: Box::new(move |received| {
                if waveforms.takes_inputs() {
                    waveforms.waveform(received);
                }
            }),
            parameter: Box::new(move |name, value| changes.parameter(name, value)),
            lifecycle: Box::new(move |state| states.lifecycle(state)),
            fell: Box::new(move |why| note!("{} ended and is restarted: {why}", middleware.side())),
        };
        Ok(Self {
            middleware,
            process: Ros2Process::start(options, parameters, state, sinks)?,
            readers: Readers::default(),
            encodings_skipped: 0,
            health_before: Health::default(),
        })
    }
}

impl Connection for Ros2NodeConnection {
    fn bus(&self) -> Bus {
        self.middleware.bus()
    }

    fn publish(&mut self, message: Outgoing<'_>) -> Result<(), BusError> {
        match message {
            Outgoing::Prediction(message) => {
                if self.readers.any(|| self.process.prediction_readers()) {
                    self.process.publish_prediction(message)?;
                } else {
                    self.encodings_skipped += 1;
                }
            }
            Outgoing::SessionEvent(message) => self.process.publish_session_event(message)?,
            Outgoing::RigInfo(message) => self.process.publish_rig(message)?,
            Outgoing::Sensitivity(message) => self.process.publish_sensitivity(message)?,
            Outgoing::Diagnostics(message) => self.process.publish_diagnostics(message)?,
            Outgoing::Heard(message) => self.process.publish_heard(message)?,
            Outgoing::Log(severity, text) => self.process.log(severity, text)?,
            // Published by the rig.
            Outgoing::OperatingPoint(_) | Outgoing::Vibration(_) | Outgoing::Waveform(_) | Outgoing::Temperature(_) => {
            }
        }
        Ok(())
    }

    fn readers(&self, topic: Topic) -> usize {
        match topic {
            Topic::Prediction => self.process.prediction_readers(),
            Topic::Sensitivity => self.process.sensitivity_readers(),
            // The child process does not report readers of these.
            Topic::OperatingPoint
            | Topic::Vibration
            | Topic::Waveform
            | Topic::Temperature
            | Topic::SessionEvent
            | Topic::RigInfo
            | Topic::Diagnostics
            | Topic::Heard => 0,
        }
    }

    fn report(&mut self) -> Report {
        let (now, side) = (self.process.health(), self.middleware.side());
        let before = std::mem::replace(&mut self.health_before, now.clone());
        let mut warnings = vec![];
        if now.falls > before.falls {
            warnings.push(format!("{side} ended and is restarted: {}", now.last_fall));
        } else if !now.up {
            warnings.push(format!("{side} is down: {}", now.last_fall));
        }
        if now.refused > before.refused {
            warnings.push(format!("{} messages {}", now.refused - before.refused, now.last_refusal));
        }
        let [falls, process, refused] = match self.middleware {
            Middleware::Dds => ["ros2_side_falls", "ros2_side_process", "ros2_refused"],
            Middleware::Zenoh => ["zenoh_side_falls", "zenoh_side_process", "zenoh_refused"],
        };
        Report {
            counts: Some(self.process.counts()),
            waveform_counts: Some(self.process.waveform_counts()),
            encodings_skipped: self.encodings_skipped,
            restarts: now.falls,
            values: vec![
                (falls, now.falls.to_string()),
                (process, now.process_id.to_string()),
                (refused, now.refused.to_string()),
            ],
            warnings,
        }
    }
}

/// Whether a topic has readers. The answer is cached, since asking takes locks.
#[derive(Default)]
struct Readers {
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

impl Connection for Ros2Source {
    fn bus(&self) -> Bus {
        Bus::Ros2
    }

    fn publish(&mut self, message: Outgoing<'_>) -> Result<(), BusError> {
        match message {
            Outgoing::OperatingPoint(message) => Self::publish(self, message)?,
            Outgoing::Vibration(message) => self.publish_vibration(message)?,
            Outgoing::Waveform(message) => self.publish_waveform(message)?,
            Outgoing::Temperature(message) => self.publish_temperature(message)?,
            // Published by the node.
            Outgoing::Prediction(_)
            | Outgoing::SessionEvent(_)
            | Outgoing::RigInfo(_)
            | Outgoing::Sensitivity(_)
            | Outgoing::Diagnostics(_)
            | Outgoing::Heard(_)
            | Outgoing::Log(..) => {}
        }
        Ok(())
    }

    fn readers(&self, topic: Topic) -> usize {
        match topic {
            Topic::OperatingPoint => Self::readers(self),
            Topic::Vibration => self.vibration_readers(),
            Topic::Waveform => self.waveform_readers(),
            Topic::Temperature => self.temperature_readers(),
            Topic::Prediction
            | Topic::SessionEvent
            | Topic::RigInfo
            | Topic::Sensitivity
            | Topic::Diagnostics
            | Topic::Heard => 0,
        }
    }
}

/// Number of the replay's own readers of a topic: a reliable and a best-effort one.
const OWN_READERS: usize = 2;

/// The connection of a replay, which stands for the rig and for its node.
pub struct Ros2ReplayConnection {
    rig: Ros2Source,
    node: Ros2,
}

impl Ros2ReplayConnection {
    /// Joins the network with two nodes. Neither has the default name of a node, so that one can receive the messages.
    ///
    /// # Errors
    /// Invalid names, or an error of DDS.
    pub fn start(options: &Ros2Options) -> Result<Self, Ros2Error> {
        let rig = Ros2Source::start(options, |_| {})?;
        let options = Ros2Options { args: options.args.clone().renamed(REPLAY_NODE_NAME), ..options.clone() };
        Ok(Self { rig, node: Ros2::start(&options, Parameters::none(), |_| {}, |_| {})? })
    }
}

impl Connection for Ros2ReplayConnection {
    fn bus(&self) -> Bus {
        Bus::Ros2
    }

    fn publish(&mut self, message: Outgoing<'_>) -> Result<(), BusError> {
        match message {
            Outgoing::OperatingPoint(message) => self.rig.publish(message)?,
            Outgoing::Vibration(message) => self.rig.publish_vibration(message)?,
            Outgoing::Prediction(message) => self.node.publish_prediction(message)?,
            Outgoing::SessionEvent(message) => self.node.publish_session_event(message)?,
            Outgoing::RigInfo(message) => self.node.publish_rig(message)?,
            Outgoing::Sensitivity(message) => self.node.publish_sensitivity(message)?,
            Outgoing::Diagnostics(message) => self.node.publish_diagnostics(message)?,
            Outgoing::Waveform(message) => self.rig.publish_waveform(message)?,
            Outgoing::Temperature(message) => self.rig.publish_temperature(message)?,
            Outgoing::Heard(message) => self.node.publish_heard(message)?,
            Outgoing::Log(severity, text) => self.node.log(severity, text)?,
        }
        Ok(())
    }

    fn readers(&self, topic: Topic) -> usize {
        // The two nodes receive each other's messages.
        match topic {
            Topic::OperatingPoint => self.rig.readers().saturating_sub(OWN_READERS),
            Topic::Vibration => self.rig.vibration_readers().saturating_sub(OWN_READERS),
            Topic::Prediction => self.node.readers(topic).saturating_sub(OWN_READERS),
            // The replay itself receives neither samples nor temperatures.
            Topic::Waveform => self.rig.waveform_readers(),
            Topic::Temperature => self.rig.temperature_readers(),
            Topic::Sensitivity | Topic::SessionEvent | Topic::RigInfo | Topic::Diagnostics | Topic::Heard => {
                self.node.readers(topic)
            }
        }
    }
}
