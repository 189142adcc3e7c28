//! Forms of sampled sound and of squeal found in it.

use iceoryx2::prelude::ZeroCopySend;

use super::{Form, FormError, header};
use crate::{Heard, MAX_CHANNEL_BYTES, MAX_WAVEFORM_SAMPLES, Waveform, heard_quantity, heard_state, heard_verdict};

/// Longest unit of a [`Waveform`] in shared memory, bytes.
pub const UNIT_BYTES: usize = 16;

/// Longest sensitivity of a [`Waveform`] in shared memory, bytes.
pub const SENSITIVITY_BYTES: usize = 32;

/// A [`Waveform`]: the user header of a slice of samples, of f32, at most 16384.
///
/// | `squealcast/Waveform/1` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (of the first sample, since the epoch) | 0 | i64 |
/// | `sample_rate_hz` | 8 | f64 |
/// | `channel_len` (0..=128) | 16 | u8 |
/// | `unit_len` (0..=16) | 17 | u8 |
/// | `sensitivity_len` (0..=32) | 18 | u8 |
/// | zero | 19 | u8 × 5 |
/// | `channel` (UTF-8, zero-filled) | 24 | u8 × 128 |
/// | `unit` (UTF-8, zero-filled) | 152 | u8 × 16 |
/// | `sensitivity` (UTF-8, zero-filled) | 168 | u8 × 32 |
/// | *size 200, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Waveform/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct WaveformHeader {
    pub stamp_ns: i64,
    pub sample_rate_hz: f64,
    pub channel_len: u8,
    pub unit_len: u8,
    pub sensitivity_len: u8,
    pub zero: [u8; 5],
    pub channel: [u8; MAX_CHANNEL_BYTES],
    pub unit: [u8; UNIT_BYTES],
    pub sensitivity: [u8; SENSITIVITY_BYTES],
}

impl Default for WaveformHeader {
    fn default() -> Self {
        Self {
            stamp_ns: 0,
            sample_rate_hz: 0.0,
            channel_len: 0,
            unit_len: 0,
            sensitivity_len: 0,
            zero: [0; 5],
            channel: [0; MAX_CHANNEL_BYTES],
            unit: [0; UNIT_BYTES],
            sensitivity: [0; SENSITIVITY_BYTES],
        }
    }
}

impl WaveformHeader {
    /// The service that carries samples; its event service has the same name.
    pub const SERVICE: &'static str = "rig/waveform";
    /// Blocks that may wait for a reader before it loses the oldest: more than a second of four channels at 51.2 kHz in
    /// blocks of 1024.
    pub const WAITING_BLOCKS: usize = 256;

    /// The header of a message.
    ///
    /// # Errors
    /// Too many samples, or a text that does not fit its field.
    pub fn from_message(message: &Waveform) -> Result<Self, FormError> {
        let Waveform { header, channel, sample_rate_hz, unit, sensitivity, samples } = message;
        if samples.len() > MAX_WAVEFORM_SAMPLES {
            return Err(FormError::SampleCount { found: samples.len() });
        }
        let (channel, channel_len) = text_field("channel", channel)?;
        let (unit, unit_len) = text_field("unit", unit)?;
        let (sensitivity, sensitivity_len) = text_field("sensitivity", sensitivity)?;
        Ok(Self {
            stamp_ns: header.stamp.as_ns(),
            sample_rate_hz: *sample_rate_hz,
            channel_len,
            unit_len,
            sensitivity_len,
            zero: [0; 5],
            channel,
            unit,
            sensitivity,
        })
    }

    /// The message with these samples.
    ///
    /// # Errors
    /// Too many samples, or a field that does not hold a valid value.
    pub fn to_message(&self, samples: &[f32]) -> Result<Waveform, FormError> {
        if samples.len() > MAX_WAVEFORM_SAMPLES {
            return Err(FormError::SampleCount { found: samples.len() });
        }
        Ok(Waveform {
            header: header(self.stamp_ns)?,
            channel: field_text("channel", &self.channel, self.channel_len)?,
            sample_rate_hz: self.sample_rate_hz,
            unit: field_text("unit", &self.unit, self.unit_len)?,
            sensitivity: field_text("sensitivity", &self.sensitivity, self.sensitivity_len)?,
            samples: samples.to_vec(),
        })
    }
}

/// A [`Heard`].
///
/// | `squealcast/Heard/1` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (of the onset) | 0 | i64 |
/// | `end_ns` | 8 | i64 |
/// | `prediction_stamp_ns` | 16 | i64 |
/// | `number` | 24 | u64 |
/// | `harmonic_of` | 32 | u64 |
/// | `input_seq` | 40 | u64 |
/// | `frequency_hz` | 48 | f64 |
/// | `level_db` | 56 | f64 |
/// | `peak_level_db` | 64 | f64 |
/// | `prominence_db` | 72 | f64 |
/// | `growth_rate_per_s` (rate, low, high) | 80 | f64 × 3 |
/// | `predicted_frequency_hz` | 104 | f64 |
/// | `predicted_growth_rate_per_s` | 112 | f64 |
/// | `harmonic_order` | 120 | u32 |
/// | `mode_id` | 124 | u32 |
/// | `state` (0 or 1) | 128 | u8 |
/// | `verdict` (0..=3) | 129 | u8 |
/// | `quantity` (0 or 1) | 130 | u8 |
/// | `cut` (0 or 1: at the onset, at the end) | 131 | u8 × 2 |
/// | `channel_len` (0..=128) | 133 | u8 |
/// | zero | 134 | u8 × 2 |
/// | `channel` (UTF-8, zero-filled) | 136 | u8 × 128 |
/// | *size 264, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Heard/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct HeardForm {
    pub stamp_ns: i64,
    pub end_ns: i64,
    pub prediction_stamp_ns: i64,
    pub number: u64,
    pub harmonic_of: u64,
    pub input_seq: u64,
    pub frequency_hz: f64,
    pub level_db: f64,
    pub peak_level_db: f64,
    pub prominence_db: f64,
    pub growth_rate_per_s: [f64; 3],
    pub predicted_frequency_hz: f64,
    pub predicted_growth_rate_per_s: f64,
    pub harmonic_order: u32,
    pub mode_id: u32,
    pub state: u8,
    pub verdict: u8,
    pub quantity: u8,
    pub cut: [u8; 2],
    pub channel_len: u8,
    pub zero: [u8; 2],
    pub channel: [u8; MAX_CHANNEL_BYTES],
}

impl HeardForm {
    fn check(&self) -> Result<(), FormError> {
        let [cut_at_onset, cut_at_end] = self.cut;
        let limits = [
            ("state", self.state, heard_state::ENDED),
            ("verdict", self.verdict, heard_verdict::NOT_JUDGED),
            ("quantity", self.quantity, heard_quantity::ACCELERATION),
            ("cut_at_onset", cut_at_onset, 1),
            ("cut_at_end", cut_at_end, 1),
        ];
        match limits.into_iter().find(|&(_, value, largest)| value > largest) {
            Some((field, value, largest)) => Err(FormError::Value { field, value, largest }),
            None => Ok(()),
        }
    }
}

impl Form for HeardForm {
    type Message = Heard;
    const SERVICE: &'static str = "squealcast/heard";
    const WAITING_SAMPLES: usize = 1024;

    fn from_message(message: &Heard) -> Result<Self, FormError> {
        let (channel, channel_len) = text_field("channel", &message.channel)?;
        let form = Self {
            stamp_ns: message.header.stamp.as_ns(),
            end_ns: message.end_stamp.as_ns(),
            prediction_stamp_ns: message.prediction_stamp.as_ns(),
            number: message.number,
            harmonic_of: message.harmonic_of,
            input_seq: message.input_seq,
            frequency_hz: message.frequency_hz,
            level_db: message.level_db,
            peak_level_db: message.peak_level_db,
            prominence_db: message.prominence_db,
            growth_rate_per_s: [
                message.growth_rate_per_s,
                message.growth_rate_low_per_s,
                message.growth_rate_high_per_s,
            ],
            predicted_frequency_hz: message.predicted_frequency_hz,
            predicted_growth_rate_per_s: message.predicted_growth_rate_per_s,
            harmonic_order: message.harmonic_order,
            mode_id: message.mode_id,
            state: message.state,
            verdict: message.verdict,
            quantity: message.quantity,
            cut: [message.cut_at_onset.into(), message.cut_at_end.into()],
            channel_len,
            zero: [0; 2],
            channel,
        };
        form.check()?;
        Ok(form)
    }

    fn to_message(&self) -> Result<Heard, FormError> {
        self.check()?;
        let [growth_rate_per_s, growth_rate_low_per_s, growth_rate_high_per_s] = self.growth_rate_per_s;
        Ok(Heard {
            header: header(self.stamp_ns)?,
            channel: field_text("channel", &self.channel, self.channel_len)?,
            number: self.number,
            state: self.state,
            end_stamp: header(self.end_ns)?.stamp,
            cut_at_onset: self.cut[0] == 1,
            cut_at_end: self.cut[1] == 1,
            frequency_hz: self.frequency_hz,
            quantity: self.quantity,
            level_db: self.level_db,
            peak_level_db: self.peak_level_db,
            prominence_db: self.prominence_db,
            growth_rate_per_s,
            growth_rate_low_per_s,
            growth_rate_high_per_s,
            harmonic_order: self.harmonic_order,
            harmonic_of: self.harmonic_of,
            verdict: self.verdict,
            mode_id: self.mode_id,
            predicted_frequency_hz: self.predicted_frequency_hz,
            predicted_growth_rate_per_s: self.predicted_growth_rate_per_s,
            input_seq: self.input_seq,
            prediction_stamp: header(self.prediction_stamp_ns)?.stamp,
        })
    }

    fn seq(&self) -> u64 {
        0
    }
}

/// A text in a field of `N` bytes, and its length.
fn text_field<const N: usize>(field: &'static str, text: &str) -> Result<([u8; N], u8), FormError> {
    let too_long = FormError::TextLength { field, bytes: text.len(), limit: N };
    let length = u8::try_from(text.len()).map_err(|_| too_long.clone())?;
    let mut bytes = [0; N];
    bytes.get_mut(..text.len()).ok_or(too_long)?.copy_from_slice(text.as_bytes());
    Ok((bytes, length))
}

/// The text in a field.
fn field_text(field: &'static str, bytes: &[u8], length: u8) -> Result<String, FormError> {
    let (length, limit) = (usize::from(length), bytes.len());
    let text = bytes.get(..length).ok_or(FormError::TextLength { field, bytes: length, limit })?;
    let text = std::str::from_utf8(text);
    text.map(str::to_owned).map_err(|error| FormError::TextUtf8 { field, valid_up_to: error.valid_up_to() })
}
