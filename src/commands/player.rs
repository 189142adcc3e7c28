//! Publishes recorded messages on the live buses.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::buses::Buses;
use crate::bus::{Connection, Outgoing};
use crate::msgs::schema::Topic;
use crate::recording::message::Payload;

/// Time without a new reader after which waiting for readers ends.
const SETTLED: Duration = Duration::from_millis(500);

/// The buses to which a recording is played.
pub struct Player(Vec<Box<dyn Connection>>);

impl Player {
    /// Joins the buses.
    ///
    /// # Errors
    /// A bus cannot be joined, or all are switched off.
    pub fn join(buses: &Buses) -> anyhow::Result<Self> {
        Ok(Self(buses.join_as_replay()?))
    }

    /// Number of readers of a topic on all buses joined.
    fn readers(&self, topic: Topic) -> usize {
        self.0.iter().map(|bus| bus.readers(topic)).sum()
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
    pub fn publish(&mut self, payload: &Payload) -> anyhow::Result<()> {
        for bus in &mut self.0 {
            bus.publish(outgoing(payload))?;
        }
        Ok(())
    }
}

/// A message as buses publish it.
fn outgoing(payload: &Payload) -> Outgoing<'_> {
    match payload {
        Payload::OperatingPoint(message) => Outgoing::OperatingPoint(message),
        Payload::Prediction(message) => Outgoing::Prediction(message),
        Payload::SessionEvent(message) => Outgoing::SessionEvent(message),
        Payload::RigInfo(message) => Outgoing::RigInfo(message),
        Payload::Sensitivity(message) => Outgoing::Sensitivity(message),
        Payload::Diagnostics(message) => Outgoing::Diagnostics(message),
        Payload::Vibration(message) => Outgoing::Vibration(message),
        Payload::Waveform(message) => Outgoing::Waveform(message),
        Payload::Heard(message) => Outgoing::Heard(message),
        Payload::Temperature(message) => Outgoing::Temperature(message),
    }
}
