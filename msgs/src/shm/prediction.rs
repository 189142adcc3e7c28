//! The form of predictions.

use iceoryx2::prelude::ZeroCopySend;

use super::{Form, FormError, header};
use crate::{MAX_MODES, Mode, Prediction, level};

/// Bytes of [`Prediction::reason`] that are carried; longer reasons are truncated.
pub const REASON_BYTES: usize = 128;

/// One mode of a [`PredictionForm`].
///
/// | mode | offset | type |
/// |---|---|---|
/// | `id` | 0 | u32 |
/// | zero | 4 | u32 |
/// | `frequency_hz` | 8 | f64 |
/// | `growth_rate_per_s` | 16 | f64 |
/// | `damping_ratio` | 24 | f64 |
/// | `pad_participation` | 32 | f64 |
/// | `residual` | 40 | f64 |
/// | `frequency_error_hz` | 48 | f64 |
/// | `growth_rate_error_per_s` | 56 | f64 |
/// | *size 64, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Mode/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct ModeForm {
    pub id: u32,
    pub zero: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
    pub damping_ratio: f64,
    pub pad_participation: f64,
    pub residual: f64,
    pub frequency_error_hz: f64,
    pub growth_rate_error_per_s: f64,
}

/// A [`Prediction`].
///
/// | `squealcast/Prediction/2` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (of the input) | 0 | i64 |
/// | `input_seq` | 8 | u64 |
/// | `max_growth_rate_per_s` | 16 | f64 |
/// | `worst_frequency_hz` | 24 | f64 |
/// | `critical_friction` | 32 | f64 |
/// | `friction_margin` | 40 | f64 |
/// | `friction_margin_error` | 48 | f64 |
/// | `unstable_modes` | 56 | u32 |
/// | `mode_count` (0..=64) | 60 | u32 |
/// | `level` (0..=3) | 64 | u8 |
/// | `reused` (0 or 1) | 65 | u8 |
/// | `reason_len` (0..=128) | 66 | u8 |
/// | zero | 67 | u8 × 5 |
/// | `reason` (UTF-8, zero-filled) | 72 | u8 × 128 |
/// | `modes` (zero-filled) | 200 | mode × 64 |
/// | *size 4296, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Prediction/2")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct PredictionForm {
    pub stamp_ns: i64,
    pub input_seq: u64,
    pub max_growth_rate_per_s: f64,
    pub worst_frequency_hz: f64,
    pub critical_friction: f64,
    pub friction_margin: f64,
    pub friction_margin_error: f64,
    pub unstable_modes: u32,
    pub mode_count: u32,
    pub level: u8,
    pub reused: u8,
    pub reason_len: u8,
    pub zero: [u8; 5],
    pub reason: [u8; REASON_BYTES],
    pub modes: [ModeForm; MAX_MODES],
}

impl Form for PredictionForm {
    type Message = Prediction;
    const SERVICE: &'static str = "squealcast/prediction";
    const WAITING_SAMPLES: usize = 1024;

    fn from_message(message: &Prediction) -> Result<Self, FormError> {
        let Prediction {
            header,
            input_seq,
            level,
            reused,
            unstable_modes,
            max_growth_rate_per_s,
            worst_frequency_hz,
            critical_friction,
            friction_margin,
            friction_margin_error,
            reason,
            modes,
        } = message;
        if modes.len() > MAX_MODES {
            return Err(FormError::ModeCount { found: modes.len() });
        }
        if *level > level::FAULT {
            return Err(FormError::Level(*level));
        }
        let mode_count = modes.len() as u32;
        let mut forms = [ModeForm::default(); MAX_MODES];
        for (form, mode) in forms.iter_mut().zip(modes) {
            *form = ModeForm::from(mode);
        }
        let cut = cut_at_char(reason, REASON_BYTES).as_bytes();
        let mut reason = [0; REASON_BYTES];
        for (to, from) in reason.iter_mut().zip(cut) {
            *to = *from;
        }
        Ok(Self {
            stamp_ns: header.stamp.as_ns(),
            input_seq: *input_seq,
            max_growth_rate_per_s: *max_growth_rate_per_s,
            worst_frequency_hz: *worst_frequency_hz,
            critical_friction: *critical_friction,
            friction_margin: *friction_margin,
            friction_margin_error: *friction_margin_error,
            unstable_modes: *unstable_modes,
            mode_count,
            level: *level,
            reused: (*reused).into(),
            reason_len: cut.len() as u8,
            zero: [0; 5],
            reason,
            modes: forms,
        })
    }

    fn to_message(&self) -> Result<Prediction, FormError> {
        let found = self.mode_count as usize;
        let modes = self.modes.get(..found).ok_or(FormError::ModeCount { found })?;
        let reason = self.reason.get(..usize::from(self.reason_len)).ok_or(FormError::ReasonLength(self.reason_len))?;
        let reason = std::str::from_utf8(reason).map_err(|e| FormError::ReasonUtf8 { valid_up_to: e.valid_up_to() })?;
        if self.level > level::FAULT {
            return Err(FormError::Level(self.level));
        }
        if self.reused > 1 {
            return Err(FormError::Reused(self.reused));
        }
        Ok(Prediction {
            header: header(self.stamp_ns)?,
            input_seq: self.input_seq,
            level: self.level,
            reused: self.reused == 1,
            unstable_modes: self.unstable_modes,
            max_growth_rate_per_s: self.max_growth_rate_per_s,
            worst_frequency_hz: self.worst_frequency_hz,
            critical_friction: self.critical_friction,
            friction_margin: self.friction_margin,
            friction_margin_error: self.friction_margin_error,
            reason: reason.to_owned(),
            modes: modes.iter().map(Mode::from).collect(),
        })
    }

    fn seq(&self) -> u64 {
        self.input_seq
    }
}

impl From<&Mode> for ModeForm {
    fn from(mode: &Mode) -> Self {
        Self {
            id: mode.id,
            zero: 0,
            frequency_hz: mode.frequency_hz,
            growth_rate_per_s: mode.growth_rate_per_s,
            damping_ratio: mode.damping_ratio,
            pad_participation: mode.pad_participation,
            residual: mode.residual,
            frequency_error_hz: mode.frequency_error_hz,
            growth_rate_error_per_s: mode.growth_rate_error_per_s,
        }
    }
}

impl From<&ModeForm> for Mode {
    fn from(form: &ModeForm) -> Self {
        Self {
            id: form.id,
            frequency_hz: form.frequency_hz,
            growth_rate_per_s: form.growth_rate_per_s,
            damping_ratio: form.damping_ratio,
            pad_participation: form.pad_participation,
            residual: form.residual,
            frequency_error_hz: form.frequency_error_hz,
            growth_rate_error_per_s: form.growth_rate_error_per_s,
        }
    }
}

/// The longest prefix of `text` with at most `limit` bytes that ends at a character boundary.
fn cut_at_char(text: &str, limit: usize) -> &str {
    let end = (0..=limit.min(text.len())).rev().find(|&end| text.is_char_boundary(end)).unwrap_or(0);
    text.get(..end).unwrap_or_default()
}
