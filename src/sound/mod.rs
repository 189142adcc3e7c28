//! Hears squeal: a pure, deterministic detector of squeal in sampled sound or acceleration.
//!
//! [`waveform`] is what the detector hears: samples of one channel with their rate, unit and time. Nothing here reads a
//! file, a bus or a clock; time comes from the stamps of the samples.

pub mod waveform;

pub use waveform::{Calibration, Channel, ChannelError, Quantity, Sensitivity, Unit, Waveform};
