//! The form of sensitivities.

use iceoryx2::prelude::ZeroCopySend;

use super::{Form, FormError, header};
use crate::{Derivatives, MAX_MODES, ModeSensitivity, PairSensitivity, Sensitivity, sensitivity_law};

/// Largest number of pairs in a sensitivity: the most that its modes can form.
pub const MAX_PAIRS: usize = MAX_MODES / 2;

/// One mode of a [`SensitivityForm`]. Derivatives have the order of those of the form.
///
/// | mode sensitivity | offset | type |
/// |---|---|---|
/// | `id` | 0 | u32 |
/// | `law` (0 or 1) | 4 | u32 |
/// | `frequency_hz` | 8 | f64 × 5 |
/// | `growth_rate_per_s` | 48 | f64 × 5 |
/// | *size 88, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("squealcast/ModeSensitivity/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct ModeSensitivityForm {
    pub id: u32,
    pub law: u32,
    pub frequency_hz: [f64; 5],
    pub growth_rate_per_s: [f64; 5],
}

/// One pair of a [`SensitivityForm`]. Derivatives have the order of those of the form.
///
/// | pair sensitivity | offset | type |
/// |---|---|---|
/// | `first_id` | 0 | u32 |
/// | `second_id` | 4 | u32 |
/// | `squares` (0 or 1) | 8 | u32 |
/// | zero | 12 | u32 |
/// | `mean` (real, imaginary) | 16 | f64 × 2 |
/// | `discriminant` (real, imaginary) | 32 | f64 × 2 |
/// | `mean_derivatives` (real, then imaginary) | 48 | f64 × 10 |
/// | `discriminant_derivatives` (real, then imaginary) | 128 | f64 × 10 |
/// | *size 208, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("squealcast/PairSensitivity/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
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

/// A [`Sensitivity`]. Derivatives are with respect to friction coefficient, normal load, disc speed, contact stiffness and
/// contact damping, in this order.
///
/// | `squealcast/Sensitivity/1` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (of the input) | 0 | i64 |
/// | `input_seq` | 8 | u64 |
/// | `normal_load_n` | 16 | f64 |
/// | `disc_speed_rad_s` | 24 | f64 |
/// | `friction_coefficient` | 32 | f64 |
/// | `nearest_window_end` | 40 | f64 |
/// | `nearest_window_end_derivatives` | 48 | f64 × 5 |
/// | `mode_count` (0..=64) | 88 | u32 |
/// | `pair_count` (0..=32) | 92 | u32 |
/// | `modes` (zero-filled) | 96 | mode sensitivity × 64 |
/// | `pairs` (zero-filled) | 5728 | pair sensitivity × 32 |
/// | *size 12384, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Sensitivity/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
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
