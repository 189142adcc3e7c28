//! Forms of what a rig measures.

use iceoryx2::prelude::ZeroCopySend;

use super::{Form, FormError, header};
use crate::{OperatingPoint, Temperature, Vibration};

/// An [`OperatingPoint`].
///
/// | `squealcast/OperatingPoint/1` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (since the epoch) | 0 | i64 |
/// | `seq` | 8 | u64 |
/// | `normal_load_n` | 16 | f64 |
/// | `disc_speed_rad_s` | 24 | f64 |
/// | `friction_coefficient` | 32 | f64 |
/// | *size 40, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/OperatingPoint/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct OperatingPointForm {
    pub stamp_ns: i64,
    pub seq: u64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
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

/// A [`Vibration`].
///
/// | `squealcast/Vibration/1` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (since the epoch) | 0 | i64 |
/// | `frequency_hz` | 8 | f64 |
/// | `level_db` | 16 | f64 |
/// | *size 24, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Vibration/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct VibrationForm {
    pub stamp_ns: i64,
    pub frequency_hz: f64,
    pub level_db: f64,
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

/// A [`Temperature`].
///
/// | `squealcast/Temperature/1` | offset | type |
/// |---|---|---|
/// | `stamp_ns` (since the epoch) | 0 | i64 |
/// | `temperature_c` | 8 | f64 |
/// | `variance_k2` (0 if unknown) | 16 | f64 |
/// | *size 24, alignment 8* | | |
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("squealcast/Temperature/1")]
#[expect(missing_docs, reason = "the table above documents every field")]
pub struct TemperatureForm {
    pub stamp_ns: i64,
    pub temperature_c: f64,
    pub variance_k2: f64,
}

impl Form for TemperatureForm {
    type Message = Temperature;
    const SERVICE: &'static str = "rig/temperature";
    const WAITING_SAMPLES: usize = 1024;

    fn from_message(message: &Temperature) -> Result<Self, FormError> {
        let Temperature { header, temperature, variance } = message;
        Ok(Self { stamp_ns: header.stamp.as_ns(), temperature_c: *temperature, variance_k2: *variance })
    }

    fn to_message(&self) -> Result<Temperature, FormError> {
        let Self { stamp_ns, temperature_c, variance_k2 } = *self;
        Ok(Temperature { header: header(stamp_ns)?, temperature: temperature_c, variance: variance_k2 })
    }

    fn seq(&self) -> u64 {
        0
    }
}
