//! Fixed-size shared-memory forms of the messages, field by field, without `frame_id`.
//!
//! Peers in any language may map these bytes, so the layout is part of the interface: native byte order, no implicit
//! padding, and a type name that ends in a version. Every change of the layout increases the version. The table of each
//! form is at its structure.

mod conditions;
mod prediction;
mod sensitivity;
mod sound;

pub use conditions::{OperatingPointForm, TemperatureForm, VibrationForm};
pub use prediction::{ModeForm, PredictionForm, REASON_BYTES};
pub use sensitivity::{MAX_PAIRS, ModeSensitivityForm, PairSensitivityForm, SensitivityForm};
pub use sound::{HeardForm, SENSITIVITY_BYTES, UNIT_BYTES, WaveformHeader};

use iceoryx2::prelude::ZeroCopySend;
use thiserror::Error;

use crate::{Header, MAX_MODES, MAX_WAVEFORM_SAMPLES, Time, level};

/// A message that does not fit its shared-memory form, or bytes that are not a message.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum FormError {
    /// The stamp of the form is outside the range of a message stamp.
    #[error("stamp_ns {0} is beyond what a message stamp can hold (seconds as i32)")]
    Stamp(i64),
    /// More modes than the form carries.
    #[error("{found} modes, at most {MAX_MODES} are carried")]
    ModeCount {
        /// Number of modes found.
        found: usize,
    },
    /// More pairs than the form carries.
    #[error("{found} pairs, at most {MAX_PAIRS} are carried")]
    PairCount {
        /// Number of pairs found.
        found: usize,
    },
    /// An unknown law of a sensitivity.
    #[error("law {0}, expected 0 or 1")]
    Law(u32),
    /// A flag that is neither 0 nor 1.
    #[error("squares {0}, expected 0 or 1")]
    Squares(u32),
    /// An unknown level.
    #[error("level {0}, expected 0 to {fault}", fault = level::FAULT)]
    Level(u8),
    /// A flag that is neither 0 nor 1.
    #[error("reused {0}, expected 0 or 1")]
    Reused(u8),
    /// A reason longer than the form carries.
    #[error("reason_len {0}, at most {REASON_BYTES} bytes are carried")]
    ReasonLength(u8),
    /// More samples than a message carries.
    #[error("{found} samples, at most {MAX_WAVEFORM_SAMPLES} are carried")]
    SampleCount {
        /// Number of samples found.
        found: usize,
    },
    /// A text that is longer than its field.
    #[error("{field} has {bytes} bytes, at most {limit} are carried")]
    TextLength {
        /// Name of the field.
        field: &'static str,
        /// Its length.
        bytes: usize,
        /// Length of the field.
        limit: usize,
    },
    /// A text that is not UTF-8.
    #[error("{field} is valid UTF-8 only up to byte {valid_up_to}")]
    TextUtf8 {
        /// Name of the field.
        field: &'static str,
        /// Number of leading bytes that are UTF-8.
        valid_up_to: usize,
    },
    /// A field with a value that has no meaning.
    #[error("{field} {value}, expected 0 to {largest}")]
    Value {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        value: u8,
        /// The largest value that has a meaning.
        largest: u8,
    },
    /// A reason that is not UTF-8.
    #[error("reason is valid UTF-8 only up to byte {valid_up_to}")]
    ReasonUtf8 {
        /// Number of leading bytes that are UTF-8.
        valid_up_to: usize,
    },
}

/// A shared-memory form of a message.
pub trait Form: ZeroCopySend + Copy + std::fmt::Debug + Send + 'static {
    /// The message type of the form.
    type Message: Clone + Send + 'static;
    /// The service that carries the form; its event service has the same name.
    const SERVICE: &'static str;
    /// Samples that may wait for a reader before it loses the oldest: at least a tenth of a second at the highest rate.
    const WAITING_SAMPLES: usize;

    /// Converts a message to its form.
    ///
    /// # Errors
    /// The message does not fit. A long reason is truncated, which is not an error.
    fn from_message(message: &Self::Message) -> Result<Self, FormError>;

    /// Converts a form to its message.
    ///
    /// # Errors
    /// A field does not hold a valid value of the message.
    fn to_message(&self) -> Result<Self::Message, FormError>;

    /// The sequence number by which readers detect gaps; constant if the message has none.
    fn seq(&self) -> u64;
}

/// A header with this stamp. A stamp beyond the range of the message is refused, since it would come back as another
/// time.
fn header(stamp_ns: i64) -> Result<Header, FormError> {
    let stamp = Time::from_ns(stamp_ns);
    if stamp.as_ns() != stamp_ns {
        return Err(FormError::Stamp(stamp_ns));
    }
    Ok(Header { stamp, frame_id: String::new() })
}

#[cfg(test)]
mod tests;
