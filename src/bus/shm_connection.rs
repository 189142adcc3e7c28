//! Shared memory as a bus: the ports of a node, of a rig and of a replay.

use std::sync::Arc;

use super::Bus;
use super::connection::{BusError, Connection, Outgoing, Report, Sink};
use super::shm::{
    ShmError, ShmHeard, ShmInput, ShmOptions, ShmOutput, ShmSensitivity, ShmSource, ShmTemperatureInput,
    ShmTemperatureSource, ShmVibrationInput, ShmVibrationSource, ShmWriter,
};
use super::shm_waveform::{ShmWaveformInput, ShmWaveformSource};
use crate::msgs::schema::Topic;
use crate::msgs::shm::Form;

/// The ports of a program that has joined shared memory. Topics without a port are neither published nor received.
#[derive(Default)]
pub struct ShmConnection {
    predictions: Option<ShmOutput>,
    sensitivities: Option<ShmSensitivity>,
    operating_points: Option<ShmSource>,
    vibrations: Option<ShmVibrationSource>,
    temperatures: Option<ShmTemperatureSource>,
    waveforms: Option<ShmWaveformSource>,
    heard: Option<ShmHeard>,
    inputs: Option<ShmInput>,
    vibration_inputs: Option<ShmVibrationInput>,
    temperature_inputs: Option<ShmTemperatureInput>,
    waveform_inputs: Option<ShmWaveformInput>,
    /// Number of readers of each topic with a history at the last report.
    readers: [usize; 3],
}

impl ShmConnection {
    /// The ports of a node: publishes predictions, sensitivities and squeals found in sound, and receives into `sink` if it takes inputs.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn of_node(options: &ShmOptions, sink: &Arc<dyn Sink>) -> Result<Self, ShmError> {
        let mut ports = Self {
            predictions: Some(ShmOutput::new(options)?),
            sensitivities: Some(ShmSensitivity::new(options)?),
            heard: Some(ShmHeard::new(options)?),
            ..Self::default()
        };
        if sink.takes_inputs() {
            let [inputs, vibrations, temperatures, waveforms] = std::array::from_fn(|_| sink.clone());
            ports.inputs = Some(ShmInput::spawn_with_backlog(options, move |received, more_waits| {
                inputs.operating_point(received, !more_waits);
            })?);
            ports.vibration_inputs =
                Some(ShmVibrationInput::spawn(options, move |received| vibrations.vibration(received))?);
            ports.temperature_inputs =
                Some(ShmTemperatureInput::spawn(options, move |received| temperatures.temperature(received))?);
            ports.waveform_inputs =
                Some(ShmWaveformInput::spawn(options, move |received| waveforms.waveform(received))?);
        }
        Ok(ports)
    }

    /// The ports of a rig: publishes operating points and, if the rig measures them, vibration and sound.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn of_rig(options: &ShmOptions, measures_vibration: bool, measures_sound: bool) -> Result<Self, ShmError> {
        Ok(Self {
            vibrations: measures_vibration.then(|| ShmVibrationSource::new(options)).transpose()?,
            waveforms: measures_sound.then(|| ShmWaveformSource::new(options)).transpose()?,
            operating_points: Some(ShmSource::new(options)?),
            ..Self::default()
        })
    }

    /// The ports of a replay: publishes every topic that has a form in shared memory.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn of_replay(options: &ShmOptions) -> Result<Self, ShmError> {
        Ok(Self {
            predictions: Some(ShmOutput::new(options)?),
            sensitivities: Some(ShmSensitivity::new(options)?),
            operating_points: Some(ShmSource::new(options)?),
            vibrations: Some(ShmVibrationSource::new(options)?),
            temperatures: Some(ShmTemperatureSource::new(options)?),
            waveforms: Some(ShmWaveformSource::new(options)?),
            heard: Some(ShmHeard::new(options)?),
            ..Self::default()
        })
    }
}

impl Connection for ShmConnection {
    fn bus(&self) -> Bus {
        Bus::Shm
    }

    fn publish(&mut self, message: Outgoing<'_>) -> Result<(), BusError> {
        match message {
            Outgoing::OperatingPoint(message) => publish(self.operating_points.as_ref(), message),
            Outgoing::Prediction(message) => publish(self.predictions.as_ref(), message),
            Outgoing::Sensitivity(message) => publish(self.sensitivities.as_ref(), message),
            Outgoing::Vibration(message) => publish(self.vibrations.as_ref(), message),
            Outgoing::Temperature(message) => publish(self.temperatures.as_ref(), message),
            Outgoing::Heard(message) => publish(self.heard.as_ref(), message),
            Outgoing::Waveform(message) => {
                if let Some(waveforms) = &self.waveforms {
                    waveforms.publish(message)?;
                }
                Ok(())
            }
            // These have no form in shared memory.
            Outgoing::SessionEvent(_) | Outgoing::RigInfo(_) | Outgoing::Diagnostics(_) | Outgoing::Log(..) => Ok(()),
        }
    }

    fn readers(&self, topic: Topic) -> usize {
        match topic {
            Topic::OperatingPoint => readers(self.operating_points.as_ref()),
            Topic::Prediction => readers(self.predictions.as_ref()),
            Topic::Sensitivity => readers(self.sensitivities.as_ref()),
            Topic::Vibration => readers(self.vibrations.as_ref()),
            Topic::Temperature => readers(self.temperatures.as_ref()),
            Topic::Heard => readers(self.heard.as_ref()),
            Topic::Waveform => self.waveforms.as_ref().map_or(0, ShmWaveformSource::readers),
            Topic::SessionEvent | Topic::RigInfo | Topic::Diagnostics => 0,
        }
    }

    /// Hands new readers the latest messages. Returns the counts of the receiver, and a warning if other nodes publish
    /// predictions on the same service: readers cannot distinguish them.
    fn report(&mut self) -> Report {
        let others = self.predictions.as_ref().map_or(0, ShmOutput::other_writers);
        let service = self.predictions.as_ref().map_or("", ShmOutput::service);
        let [of_predictions, of_sensitivities, of_heard] = &mut self.readers;
        meet(self.predictions.as_ref(), of_predictions);
        meet(self.sensitivities.as_ref(), of_sensitivities);
        meet(self.heard.as_ref(), of_heard);
        let warning = || {
            format!(
                "{others} more publish on the service {service} over shared memory, whose readers get the predictions \
                 of all; --shm-prefix keeps nodes apart"
            )
        };
        Report {
            counts: self.inputs.as_ref().map(ShmInput::counts),
            waveform_counts: self.waveform_inputs.as_ref().map(ShmWaveformInput::counts),
            warnings: (others > 0).then(warning).into_iter().collect(),
            ..Report::default()
        }
    }
}

fn publish<F: Form>(writer: Option<&ShmWriter<F>>, message: &F::Message) -> Result<(), BusError> {
    if let Some(writer) = writer {
        writer.publish(message)?;
    }
    Ok(())
}

/// Hands the latest messages to readers that have come since there were `known`.
fn meet<F: Form>(writer: Option<&ShmWriter<F>>, known: &mut usize) {
    let Some(writer) = writer else { return };
    let now = writer.readers();
    // A reader that cannot be connected is tried again with the next message.
    if now > *known {
        let _ = writer.meet_readers();
    }
    *known = now;
}

fn readers<F: Form>(writer: Option<&ShmWriter<F>>) -> usize {
    writer.map_or(0, ShmWriter::readers)
}
