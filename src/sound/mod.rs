//! Finds squeal in sampled sound or acceleration; pure and deterministic.
//!
//! - [`waveform`]: samples of one channel with their rate, unit and time.
//! - [`spectrum`]: short-time spectra and the tones in them; [`weighting`]: A-weighting.
//! - [`spectrogram`]: a picture of bounded size.
//! - [`envelope`]: onset, end and growth of one tone; [`detector`]: squeals in a stream of samples.
//! - [`matching`]: predictions scored against squeal in sound.
//! - [`in_force`]: the same while the rig runs, against the prediction in force.
//! - [`search`]: one channel searched, compared and reported, in the node and offline.
//! - [`simulated`]: sound with squeals whose properties are known.
//!
//! Nothing here reads a file, a bus or a clock; time comes from the stamps of the samples.

pub mod detector;
pub mod envelope;
pub mod in_force;
pub mod matching;
pub mod search;
pub mod simulated;
pub mod spectrogram;
pub mod spectrum;
pub mod waveform;
pub mod weighting;

pub use detector::{Counts, Detection, Detector, DetectorError, Harmonic, Interruption, Settings, Squeal};
pub use envelope::Growth;
pub use waveform::{Calibration, Channel, ChannelError, Quantity, Sensitivity, Unit, Waveform};
