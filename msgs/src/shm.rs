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
//!
//! Samples are a slice of f32, at most 16384, with this user header:
//!
//! | `squealcast/Waveform/1` | offset | type |
//! |---|---|---|
//! | `stamp_ns` (of the first sample, since the epoch) | 0 | i64 |
//! | `sample_rate_hz` | 8 | f64 |
//! | `channel_len` (0..=128) | 16 | u8 |
//! | `unit_len` (0..=16) | 17 | u8 |
//! | `sensitivity_len` (0..=32) | 18 | u8 |
//! | zero | 19 | u8 × 5 |
//! | `channel` (UTF-8, zero-filled) | 24 | u8 × 128 |
//! | `unit` (UTF-8, zero-filled) | 152 | u8 × 16 |
//! | `sensitivity` (UTF-8, zero-filled) | 168 | u8 × 32 |
//! | *size 200, alignment 8* | | |
//!
//! | `squealcast/Heard/1` | offset | type |
//! |---|---|---|
//! | `stamp_ns` (of the onset) | 0 | i64 |
//! | `end_ns` | 8 | i64 |
//! | `prediction_stamp_ns` | 16 | i64 |
//! | `number` | 24 | u64 |
//! | `harmonic_of` | 32 | u64 |
//! | `input_seq` | 40 | u64 |
//! | `frequency_hz` | 48 | f64 |
//! | `level_db` | 56 | f64 |
//! | `peak_level_db` | 64 | f64 |
//! | `prominence_db` | 72 | f64 |
//! | `growth_rate_per_s` (rate, low, high) | 80 | f64 × 3 |
//! | `predicted_frequency_hz` | 104 | f64 |
//! | `predicted_growth_rate_per_s` | 112 | f64 |
//! | `harmonic_order` | 120 | u32 |
//! | `mode_id` | 124 | u32 |
//! | `state` (0 or 1) | 128 | u8 |
//! | `verdict` (0..=3) | 129 | u8 |
//! | `quantity` (0 or 1) | 130 | u8 |
//! | `cut` (0 or 1: at the onset, at the end) | 131 | u8 × 2 |
//! | `channel_len` (0..=128) | 133 | u8 |
//! | zero | 134 | u8 × 2 |
//! | `channel` (UTF-8, zero-filled) | 136 | u8 × 128 |
//! | *size 264, alignment 8* | | |

use iceoryx2::prelude::ZeroCopySend;
use thiserror::Error;

use super::{
    Derivatives, Header, Heard, MAX_CHANNEL_BYTES, MAX_MODES, MAX_WAVEFORM_SAMPLES, Mode, ModeSensitivity,
    OperatingPoint, PairSensitivity, Prediction, Sensitivity, Time, Vibration, Waveform, heard_quantity, heard_state,
    heard_verdict, level, sensitivity_law,
};

/// Largest number of pairs in a sensitivity: the most that its modes can form.
pub const MAX_PAIRS: usize = MAX_MODES / 2;

/// Bytes of [`Prediction::reason`] that are carried; longer reasons are truncated.
pub const REASON_BYTES: usize = 128;

/// Longest unit of a [`Waveform`] in shared memory, bytes.
pub const UNIT_BYTES: usize = 16;

/// Longest sensitivity of a [`Waveform`] in shared memory, bytes.
pub const SENSITIVITY_BYTES: usize = 32;

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

/// `squealcast/Waveform/1`: the user header of a slice of samples.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Waveform/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
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

/// `squealcast/Heard/1`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Heard/1")]
#[expect(missing_docs, reason = "the tables above document every field")]
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
