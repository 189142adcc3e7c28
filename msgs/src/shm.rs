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
mod tests {
    use std::mem::{align_of, offset_of, size_of};

    use proptest::prelude::*;

    use super::*;

    fn prediction(modes: usize, reason: &str) -> Prediction {
        Prediction {
            header: Header { stamp: Time { sec: 7, nanosec: 8 }, frame_id: String::new() },
            input_seq: u64::MAX,
            level: level::SQUEAL,
            reused: true,
            unstable_modes: 2,
            max_growth_rate_per_s: 12.5,
            worst_frequency_hz: 1750.25,
            critical_friction: 0.4,
            friction_margin: -0.1,
            friction_margin_error: 1e-12,
            reason: reason.to_owned(),
            modes: (0..modes)
                .map(|i| Mode { id: i as u32, frequency_hz: 100.0 * i as f64, residual: 1e-12, ..Mode::default() })
                .collect(),
        }
    }

    /// Peers in other languages map these bytes: sizes and offsets must be those of the tables in the module
    /// documentation.
    #[test]
    fn layout_is_the_documented_one() {
        assert_eq!((size_of::<OperatingPointForm>(), align_of::<OperatingPointForm>()), (40, 8));
        assert_eq!(
            [
                offset_of!(OperatingPointForm, stamp_ns),
                offset_of!(OperatingPointForm, seq),
                offset_of!(OperatingPointForm, normal_load_n),
                offset_of!(OperatingPointForm, disc_speed_rad_s),
                offset_of!(OperatingPointForm, friction_coefficient),
            ],
            [0, 8, 16, 24, 32]
        );
        assert_eq!((size_of::<VibrationForm>(), align_of::<VibrationForm>()), (24, 8));
        assert_eq!(
            [
                offset_of!(VibrationForm, stamp_ns),
                offset_of!(VibrationForm, frequency_hz),
                offset_of!(VibrationForm, level_db),
            ],
            [0, 8, 16]
        );
        assert_eq!((size_of::<ModeForm>(), align_of::<ModeForm>()), (64, 8));
        assert_eq!(
            [
                offset_of!(ModeForm, id),
                offset_of!(ModeForm, zero),
                offset_of!(ModeForm, frequency_hz),
                offset_of!(ModeForm, growth_rate_per_s),
                offset_of!(ModeForm, damping_ratio),
                offset_of!(ModeForm, pad_participation),
                offset_of!(ModeForm, residual),
                offset_of!(ModeForm, frequency_error_hz),
                offset_of!(ModeForm, growth_rate_error_per_s),
            ],
            [0, 4, 8, 16, 24, 32, 40, 48, 56]
        );
        assert_eq!((size_of::<PredictionForm>(), align_of::<PredictionForm>()), (4296, 8));
        assert_eq!(
            [
                offset_of!(PredictionForm, stamp_ns),
                offset_of!(PredictionForm, input_seq),
                offset_of!(PredictionForm, max_growth_rate_per_s),
                offset_of!(PredictionForm, worst_frequency_hz),
                offset_of!(PredictionForm, critical_friction),
                offset_of!(PredictionForm, friction_margin),
                offset_of!(PredictionForm, friction_margin_error),
                offset_of!(PredictionForm, unstable_modes),
                offset_of!(PredictionForm, mode_count),
                offset_of!(PredictionForm, level),
                offset_of!(PredictionForm, reused),
                offset_of!(PredictionForm, reason_len),
                offset_of!(PredictionForm, zero),
                offset_of!(PredictionForm, reason),
                offset_of!(PredictionForm, modes),
            ],
            [0, 8, 16, 24, 32, 40, 48, 56, 60, 64, 65, 66, 67, 72, 200]
        );
    }

    #[test]
    fn sensitivities_come_back_whole_in_the_documented_layout() {
        assert_eq!([size_of::<ModeSensitivityForm>(), size_of::<PairSensitivityForm>()], [88, 208]);
        assert_eq!((size_of::<SensitivityForm>(), align_of::<SensitivityForm>()), (12384, 8));
        let counts = [offset_of!(SensitivityForm, mode_count), offset_of!(SensitivityForm, pair_count)];
        let lists = [offset_of!(SensitivityForm, modes), offset_of!(SensitivityForm, pairs)];
        assert_eq!((counts, lists), ([88, 92], [96, 5728]));
        assert_eq!(offset_of!(PairSensitivityForm, discriminant_derivatives), 128);
        let derivatives = |k: usize| Derivatives::new(std::array::from_fn(|j| (10 * k + j) as f64));
        let mode = |k: usize| ModeSensitivity {
            id: k as u32,
            law: (k % 2) as u8,
            frequency_hz: derivatives(k),
            growth_rate_per_s: derivatives(k + 100),
        };
        let pair = |k: usize| PairSensitivity {
            first_id: k as u32,
            second_id: 1 + k as u32,
            squares: k % 2 == 1,
            mean_real: 1.0,
            mean_imaginary: 2.0,
            discriminant_real: 3.0,
            discriminant_imaginary: 4.0,
            mean_real_derivatives: derivatives(k),
            mean_imaginary_derivatives: derivatives(k + 1),
            discriminant_real_derivatives: derivatives(k + 2),
            discriminant_imaginary_derivatives: derivatives(k + 3),
        };
        let message = Sensitivity {
            header: Header { stamp: Time { sec: 7, nanosec: 8 }, frame_id: String::new() },
            input_seq: 9,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.3,
            nearest_window_end: 0.35,
            nearest_window_end_derivatives: derivatives(7),
            modes: (0..MAX_MODES).map(mode).collect(),
            pairs: (0..MAX_PAIRS).map(pair).collect(),
        };
        let form = SensitivityForm::from_message(&message).expect("fits");
        assert_eq!(form.to_message().expect("is one"), message);
        let refused = |form: SensitivityForm| form.to_message().expect_err("is none");
        assert_eq!(refused(SensitivityForm { pair_count: 33, ..form }), FormError::PairCount { found: 33 });
        let mut bad = form;
        bad.modes[3].law = 2;
        assert_eq!(refused(bad), FormError::Law(2));
    }

    #[test]
    fn type_names_carry_a_version() {
        let names = unsafe {
            [
                <OperatingPointForm as ZeroCopySend>::type_name(),
                <PredictionForm as ZeroCopySend>::type_name(),
                <ModeForm as ZeroCopySend>::type_name(),
                <VibrationForm as ZeroCopySend>::type_name(),
            ]
        };
        let expected =
            ["squealcast/OperatingPoint/1", "squealcast/Prediction/2", "squealcast/Mode/1", "squealcast/Vibration/1"];
        assert_eq!(names, expected);
    }

    #[test]
    fn predictions_come_back_whole() {
        for modes in [0, 1, MAX_MODES] {
            let message = prediction(modes, "margin pending");
            let form = PredictionForm::from_message(&message).expect("fits");
            assert_eq!(form.to_message().expect("is one"), message);
        }
    }

    #[test]
    fn nan_keeps_its_bits() {
        let message = Prediction { critical_friction: f64::NAN, ..prediction(0, "") };
        let back = PredictionForm::from_message(&message).expect("fits").to_message().expect("is one");
        assert_eq!(back.critical_friction.to_bits(), message.critical_friction.to_bits());
    }

    #[test]
    fn a_long_reason_is_cut_between_characters() {
        // 127 bytes, then a character of two bytes that does not fit into 128.
        let reason = format!("{}ä tail", "x".repeat(127));
        let form = PredictionForm::from_message(&prediction(0, &reason)).expect("fits");
        assert_eq!(form.reason_len, 127);
        assert_eq!(form.to_message().expect("is one").reason, "x".repeat(127));
        let exact = "y".repeat(REASON_BYTES);
        let form = PredictionForm::from_message(&prediction(0, &exact)).expect("fits");
        assert_eq!(form.to_message().expect("is one").reason, exact);
    }

    #[test]
    fn messages_that_do_not_fit_are_refused() {
        assert_eq!(PredictionForm::from_message(&prediction(65, "")), Err(FormError::ModeCount { found: 65 }));
        let bad_level = Prediction { level: 4, ..prediction(0, "") };
        assert_eq!(PredictionForm::from_message(&bad_level), Err(FormError::Level(4)));
    }

    #[test]
    fn bytes_that_are_no_message_are_refused() {
        let good = PredictionForm::from_message(&prediction(2, "why")).expect("fits");
        let refused = |form: PredictionForm| form.to_message().expect_err("is none");
        assert_eq!(refused(PredictionForm { mode_count: 65, ..good }), FormError::ModeCount { found: 65 });
        assert_eq!(refused(PredictionForm { level: 9, ..good }), FormError::Level(9));
        assert_eq!(refused(PredictionForm { reused: 2, ..good }), FormError::Reused(2));
        assert_eq!(refused(PredictionForm { reason_len: 129, ..good }), FormError::ReasonLength(129));
        let mut broken = good;
        broken.reason[1] = 0xff;
        assert_eq!(refused(broken), FormError::ReasonUtf8 { valid_up_to: 1 });
        assert_eq!(refused(PredictionForm { stamp_ns: i64::MAX, ..good }), FormError::Stamp(i64::MAX));
    }

    proptest! {
        #[test]
        fn operating_points_come_back_whole(
            sec: i32, nanosec in 0u32..1_000_000_000, seq: u64, load: u64, speed: u64, friction: u64,
        ) {
            let message = OperatingPoint {
                header: Header { stamp: Time { sec, nanosec }, frame_id: String::new() },
                seq,
                normal_load_n: f64::from_bits(load),
                disc_speed_rad_s: f64::from_bits(speed),
                friction_coefficient: f64::from_bits(friction),
            };
            let back = OperatingPointForm::from_message(&message).expect("fits").to_message().expect("is one");
            prop_assert_eq!(back.header, message.header);
            prop_assert_eq!(back.seq, seq);
            prop_assert_eq!(
                [back.normal_load_n, back.disc_speed_rad_s, back.friction_coefficient].map(f64::to_bits),
                [load, speed, friction]
            );
        }

        #[test]
        fn no_bytes_panic(stamp_ns: i64, mode_count: u32, level: u8, reused: u8, reason_len: u8, byte: u8) {
            let good = PredictionForm::from_message(&prediction(3, "")).expect("fits");
            let reason = [byte; REASON_BYTES];
            let _ = PredictionForm { stamp_ns, mode_count, level, reused, reason_len, reason, ..good }.to_message();
        }

        #[test]
        fn any_reason_is_carried_up_to_a_character(reason: String) {
            let form = PredictionForm::from_message(&prediction(0, &reason)).expect("fits");
            let back = form.to_message().expect("is one").reason;
            prop_assert!(reason.starts_with(&back));
            prop_assert!(back == reason || back.len() + 4 > REASON_BYTES);
        }
    }
}
