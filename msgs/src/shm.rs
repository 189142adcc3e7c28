//! Fixed-size shared-memory forms of the messages, field by field, without `frame_id`.
//!
//! Peers in any language may map these bytes, so the layout is part of the interface: native byte order, no implicit
//! padding, and a type name that ends in a version. Every change of the layout increases the version.
//!
//! | `squealcast/OperatingPoint/1` | offset | type |
//! |---|---|---|
//! | `stamp_ns` (since the epoch) | 0 | i64 |
//! | `seq` | 8 | u64 |
//! | `normal_load_n` | 16 | f64 |
//! | `disc_speed_rad_s` | 24 | f64 |
//! | `friction_coefficient` | 32 | f64 |
//! | *size 40, alignment 8* | | |
//!
//! | `squealcast/Prediction/2` | offset | type |
//! |---|---|---|
//! | `stamp_ns` (of the input) | 0 | i64 |
//! | `input_seq` | 8 | u64 |
//! | `max_growth_rate_per_s` | 16 | f64 |
//! | `worst_frequency_hz` | 24 | f64 |
//! | `critical_friction` | 32 | f64 |
//! | `friction_margin` | 40 | f64 |
//! | `friction_margin_error` | 48 | f64 |
//! | `unstable_modes` | 56 | u32 |
//! | `mode_count` (0..=64) | 60 | u32 |
//! | `level` (0..=3) | 64 | u8 |
//! | `reused` (0 or 1) | 65 | u8 |
//! | `reason_len` (0..=128) | 66 | u8 |
//! | zero | 67 | u8 × 5 |
//! | `reason` (UTF-8, zero-filled) | 72 | u8 × 128 |
//! | `modes` (zero-filled) | 200 | mode × 64 |
//! | *size 4296, alignment 8* | | |
//!
//! | `squealcast/Vibration/1` | offset | type |
//! |---|---|---|
//! | `stamp_ns` (since the epoch) | 0 | i64 |
//! | `frequency_hz` | 8 | f64 |
//! | `level_db` | 16 | f64 |
//! | *size 24, alignment 8* | | |
//!
//! | mode | offset | type |
//! |---|---|---|
//! | `id` | 0 | u32 |
//! | zero | 4 | u32 |
//! | `frequency_hz` | 8 | f64 |
//! | `growth_rate_per_s` | 16 | f64 |
//! | `damping_ratio` | 24 | f64 |
//! | `pad_participation` | 32 | f64 |
//! | `residual` | 40 | f64 |
//! | `frequency_error_hz` | 48 | f64 |
//! | `growth_rate_error_per_s` | 56 | f64 |
//! | *size 64, alignment 8* | | |
//!
//! | `squealcast/Sensitivity/1` | offset | type |
//! |---|---|---|
//! | `stamp_ns` (of the input) | 0 | i64 |
//! | `input_seq` | 8 | u64 |
//! | `normal_load_n` | 16 | f64 |
//! | `disc_speed_rad_s` | 24 | f64 |
//! | `friction_coefficient` | 32 | f64 |
//! | `nearest_window_end` | 40 | f64 |
//! | `nearest_window_end_derivatives` | 48 | f64 × 5 |
//! | `mode_count` (0..=64) | 88 | u32 |
//! | `pair_count` (0..=32) | 92 | u32 |
//! | `modes` (zero-filled) | 96 | mode sensitivity × 64 |
//! | `pairs` (zero-filled) | 5728 | pair sensitivity × 32 |
//! | *size 12384, alignment 8* | | |
//!
//! Derivatives are with respect to friction coefficient, normal load, disc speed, contact stiffness and contact
//! damping, in this order.
//!
//! | mode sensitivity | offset | type |
//! |---|---|---|
//! | `id` | 0 | u32 |
//! | `law` (0 or 1) | 4 | u32 |
//! | `frequency_hz` | 8 | f64 × 5 |
//! | `growth_rate_per_s` | 48 | f64 × 5 |
//! | *size 88, alignment 8* | | |
//!
//! | pair sensitivity | offset | type |
//! |---|---|---|
//! | `first_id` | 0 | u32 |
//! | `second_id` | 4 | u32 |
//! | `squares` (0 or 1) | 8 | u32 |
//! | zero | 12 | u32 |
//! | `mean` (real, imaginary) | 16 | f64 × 2 |
//! | `discriminant` (real, imaginary) | 32 | f64 × 2 |
//! | `mean_derivatives` (real, then imaginary) | 48 | f64 × 10 |
//! | `discriminant_derivatives` (real, then imaginary) | 128 | f64 × 10 |
//! | *size 208, alignment 8* | | |

use iceoryx2::prelude::ZeroCopySend;
use thiserror::Error;

use super::{
    Derivatives, Header, MAX_MODES, Mode, ModeSensitivity, OperatingPoint, PairSensitivity, Prediction, Sensitivity,
    Time, Vibration, level, sensitivity_law,
};

/// Largest number of pairs in a sensitivity: the most that its modes can form.
pub const MAX_PAIRS: usize = MAX_MODES / 2;

/// Bytes of [`Prediction::reason`] that are carried; longer reasons are truncated.
pub const REASON_BYTES: usize = 128;

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

/// `squealcast/OperatingPoint/1`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/OperatingPoint/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
pub struct OperatingPointForm {
    pub stamp_ns: i64,
    pub seq: u64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
}

/// `squealcast/Vibration/1`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Vibration/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
pub struct VibrationForm {
    pub stamp_ns: i64,
    pub frequency_hz: f64,
    pub level_db: f64,
}

/// One mode of a [`PredictionForm`].
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Mode/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
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

/// `squealcast/Prediction/2`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Prediction/2")]
#[expect(missing_docs, reason = "the tables above document every field")]
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

impl Form for OperatingPointForm {
    type Message = OperatingPoint;
    const SERVICE: &'static str = "rig/operating_point";
    // A rig that was held up sends all measurements of that time at once.
    const WAITING_SAMPLES: usize = 4096;

    fn from_message(message: &OperatingPoint) -> Result<Self, FormError> {
        Ok(Self {
            stamp_ns: message.header.stamp.as_ns(),
            seq: message.seq,
            normal_load_n: message.normal_load_n,
            disc_speed_rad_s: message.disc_speed_rad_s,
            friction_coefficient: message.friction_coefficient,
        })
    }

    fn to_message(&self) -> Result<OperatingPoint, FormError> {
        Ok(OperatingPoint {
            header: header(self.stamp_ns)?,
            seq: self.seq,
            normal_load_n: self.normal_load_n,
            disc_speed_rad_s: self.disc_speed_rad_s,
            friction_coefficient: self.friction_coefficient,
        })
    }

    fn seq(&self) -> u64 {
        self.seq
    }
}

impl Form for VibrationForm {
    type Message = Vibration;
    const SERVICE: &'static str = "rig/vibration";
    const WAITING_SAMPLES: usize = 1024;

    fn from_message(message: &Vibration) -> Result<Self, FormError> {
        let Vibration { header, frequency_hz, level_db } = message;
        Ok(Self { stamp_ns: header.stamp.as_ns(), frequency_hz: *frequency_hz, level_db: *level_db })
    }

    fn to_message(&self) -> Result<Vibration, FormError> {
        let Self { stamp_ns, frequency_hz, level_db } = *self;
        Ok(Vibration { header: header(stamp_ns)?, frequency_hz, level_db })
    }

    fn seq(&self) -> u64 {
        0
    }
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

/// One mode of a [`SensitivityForm`].
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("squealcast/ModeSensitivity/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
pub struct ModeSensitivityForm {
    pub id: u32,
    pub law: u32,
    pub frequency_hz: [f64; 5],
    pub growth_rate_per_s: [f64; 5],
}

/// One pair of a [`SensitivityForm`].
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("squealcast/PairSensitivity/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
pub struct PairSensitivityForm {
    pub first_id: u32,
    pub second_id: u32,
    pub squares: u32,
    pub zero: u32,
    pub mean: [f64; 2],
    pub discriminant: [f64; 2],
    pub mean_derivatives: [[f64; 5]; 2],
    pub discriminant_derivatives: [[f64; 5]; 2],
}

/// `squealcast/Sensitivity/1`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Sensitivity/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
pub struct SensitivityForm {
    pub stamp_ns: i64,
    pub input_seq: u64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    pub nearest_window_end: f64,
    pub nearest_window_end_derivatives: [f64; 5],
    pub mode_count: u32,
    pub pair_count: u32,
    pub modes: [ModeSensitivityForm; MAX_MODES],
    pub pairs: [PairSensitivityForm; MAX_PAIRS],
}

impl Form for SensitivityForm {
    type Message = Sensitivity;
    const SERVICE: &'static str = "squealcast/sensitivity";
    const WAITING_SAMPLES: usize = 64;

    fn from_message(message: &Sensitivity) -> Result<Self, FormError> {
        let (mode_count, pair_count) = (message.modes.len(), message.pairs.len());
        if mode_count > MAX_MODES {
            return Err(FormError::ModeCount { found: mode_count });
        }
        if pair_count > MAX_PAIRS {
            return Err(FormError::PairCount { found: pair_count });
        }
        let mut modes = [ModeSensitivityForm::default(); MAX_MODES];
        for (form, mode) in modes.iter_mut().zip(&message.modes) {
            *form = ModeSensitivityForm {
                id: mode.id,
                law: mode.law.into(),
                frequency_hz: mode.frequency_hz.values(),
                growth_rate_per_s: mode.growth_rate_per_s.values(),
            };
        }
        let mut pairs = [PairSensitivityForm::default(); MAX_PAIRS];
        for (form, pair) in pairs.iter_mut().zip(&message.pairs) {
            *form = PairSensitivityForm {
                first_id: pair.first_id,
                second_id: pair.second_id,
                squares: pair.squares.into(),
                zero: 0,
                mean: [pair.mean_real, pair.mean_imaginary],
                discriminant: [pair.discriminant_real, pair.discriminant_imaginary],
                mean_derivatives: [pair.mean_real_derivatives.values(), pair.mean_imaginary_derivatives.values()],
                discriminant_derivatives: [
                    pair.discriminant_real_derivatives.values(),
                    pair.discriminant_imaginary_derivatives.values(),
                ],
            };
        }
        Ok(Self {
            stamp_ns: message.header.stamp.as_ns(),
            input_seq: message.input_seq,
            normal_load_n: message.normal_load_n,
            disc_speed_rad_s: message.disc_speed_rad_s,
            friction_coefficient: message.friction_coefficient,
            nearest_window_end: message.nearest_window_end,
            nearest_window_end_derivatives: message.nearest_window_end_derivatives.values(),
            mode_count: mode_count as u32,
            pair_count: pair_count as u32,
            modes,
            pairs,
        })
    }

    fn to_message(&self) -> Result<Sensitivity, FormError> {
        let (mode_count, pair_count) = (self.mode_count as usize, self.pair_count as usize);
        let modes = self.modes.get(..mode_count).ok_or(FormError::ModeCount { found: mode_count })?;
        let pairs = self.pairs.get(..pair_count).ok_or(FormError::PairCount { found: pair_count })?;
        let mode = |form: &ModeSensitivityForm| {
            let law = u8::try_from(form.law).ok().filter(|&law| law <= sensitivity_law::SQUARE_ROOT);
            Ok(ModeSensitivity {
                id: form.id,
                law: law.ok_or(FormError::Law(form.law))?,
                frequency_hz: Derivatives::new(form.frequency_hz),
                growth_rate_per_s: Derivatives::new(form.growth_rate_per_s),
            })
        };
        let pair = |form: &PairSensitivityForm| {
            if form.squares > 1 {
                return Err(FormError::Squares(form.squares));
            }
            Ok(PairSensitivity {
                first_id: form.first_id,
                second_id: form.second_id,
                squares: form.squares == 1,
                mean_real: form.mean[0],
                mean_imaginary: form.mean[1],
                discriminant_real: form.discriminant[0],
                discriminant_imaginary: form.discriminant[1],
                mean_real_derivatives: Derivatives::new(form.mean_derivatives[0]),
                mean_imaginary_derivatives: Derivatives::new(form.mean_derivatives[1]),
                discriminant_real_derivatives: Derivatives::new(form.discriminant_derivatives[0]),
                discriminant_imaginary_derivatives: Derivatives::new(form.discriminant_derivatives[1]),
            })
        };
        Ok(Sensitivity {
            header: header(self.stamp_ns)?,
            input_seq: self.input_seq,
            normal_load_n: self.normal_load_n,
            disc_speed_rad_s: self.disc_speed_rad_s,
            friction_coefficient: self.friction_coefficient,
            nearest_window_end: self.nearest_window_end,
            nearest_window_end_derivatives: Derivatives::new(self.nearest_window_end_derivatives),
            modes: modes.iter().map(mode).collect::<Result<_, _>>()?,
            pairs: pairs.iter().map(pair).collect::<Result<_, _>>()?,
        })
    }

    fn seq(&self) -> u64 {
        self.input_seq
    }
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

/// The longest prefix of `text` with at most `limit` bytes that ends at a character boundary.
fn cut_at_char(text: &str, limit: usize) -> &str {
    let end = (0..=limit.min(text.len())).rev().find(|&end| text.is_char_boundary(end)).unwrap_or(0);
    text.get(..end).unwrap_or_default()
}

#[cfg(test)]
mod tests;
