//! How the node follows the temperature of the contact: the rig is built for it in the background.

use super::{Worker, now_header};
use crate::bus::Received;
use crate::msgs;
use crate::recording::message::Payload;
use crate::rig::temperature;
use crate::session::Event;

impl Worker {
    /// Shows and records a temperature. A rig that follows it and has another one is built for it in the background.
    pub(super) fn temperature(&mut self, received: Received<msgs::Temperature>) {
        // A temperature has no sequence number either.
        let measured = received.message;
        let celsius = measured.temperature;
        if !self.temperature_received_before.is_new(received.bus, measured.header.stamp, celsius.to_bits()) {
            return;
        }
        self.outputs.record(received.at, Payload::Temperature(measured));
        if let Err(refused) = temperature::check(&self.rig.name, "temperature", celsius) {
            self.statistics.refused = Some(refused.to_string());
            return;
        }
        self.watch.temperature(received.at.wall_ns, celsius);
        self.statistics.temperature(celsius);
        self.temperature = Some(celsius);
        self.follow_temperature();
    }

    /// Requests the rig at the latest temperature if that is outside the dead-band of the rig's own.
    pub(super) fn follow_temperature(&mut self) {
        let left = self.temperature.filter(|&celsius| self.session.leaves_temperature(celsius));
        if let Some(celsius) = left.filter(|_| self.temperature_refused != left) {
            self.mapper.request_rig(celsius, self.point);
        }
    }

    /// Hands the rig at another temperature, and its map, to the session.
    pub(super) fn rig_ready(&mut self, celsius: f64, result: Result<Vec<Event>, String>) {
        match result {
            Ok(events) => {
                (self.temperature_refused, self.statistics.temperature_failure) = (None, None);
                for event in events {
                    self.record_and_step(event, now_header());
                }
            }
            Err(reason) => {
                self.temperature_refused = Some(celsius);
                self.statistics.temperature_failure = Some(reason);
            }
        }
        self.task_done(|_| false);
    }
}
