//! Samples of a microphone or accelerometer: channel, sample rate, unit, calibration and time.

use std::fmt;
use std::str::FromStr;

/// Lowest and highest sample rate that is analysed, Hz. The highest is four times 51.2 kHz.
pub const SAMPLE_RATES_HZ: std::ops::RangeInclusive<f64> = 8_000.0..=204_800.0;
/// Longest name of a channel, bytes.
pub const MAX_NAME_BYTES: usize = 128;
/// Standard acceleration of gravity, m/s² (3rd General Conference on Weights and Measures, 1901).
const STANDARD_GRAVITY_M_S2: f64 = 9.806_65;

/// Consecutive samples of one channel at a constant rate: a whole file, or a block of a live stream.
///
/// Sample `k` was taken at `first_stamp_ns + k / sample_rate_hz`.
#[derive(Clone, Debug, PartialEq)]
pub struct Waveform {
    pub channel: Channel,
    /// Time of the first sample, ns.
    pub first_stamp_ns: i64,
    /// Samples in the unit of the channel.
    pub samples: Vec<f32>,
}

/// Meaning of the samples of a channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    pub name: String,
    pub sample_rate_hz: f64,
    /// Unit of the samples.
    pub unit: Unit,
    /// Output of the sensor per Pa or m/s²; needed for samples in volts or parts of full scale.
    pub sensitivity: Option<Sensitivity>,
}

/// Unit of the samples of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Pa
    Pascal,
    /// m/s²
    MetrePerSecondSquared,
    /// g, 9.80665 m/s²
    StandardGravity,
    /// V
    Volt,
    /// Parts of the range of the converter, -1 to 1: what a WAV file of integers contains.
    FullScale,
}

/// Quantity that a channel measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Quantity {
    /// In Pa; levels in dB re 20 µPa, A-weighted: dB(A).
    SoundPressure,
    /// In m/s²; levels in dB re 1 µm/s², not weighted.
    Acceleration,
}

/// Output of a sensor, in volts or parts of full scale, per Pa or per m/s².
///
/// Parsed from and written as `0.05 V/Pa`, `50 mV/Pa`, `100 mV/g`, `10 mV/(m/s²)`, `0.1 FS/Pa`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensitivity {
    /// Volts or parts of full scale per Pa or per m/s²; more than 0.
    pub value: f64,
    /// [`Unit::Volt`] or [`Unit::FullScale`].
    pub output: Unit,
    pub quantity: Quantity,
}

/// Conversion of samples: `sample * factor` is in Pa or m/s².
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    pub quantity: Quantity,
    pub factor: f64,
}

/// Why a channel cannot be analysed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChannelError {
    #[error("channel `{name}`: `sample_rate_hz` is {sample_rate_hz}, expected {} to {}", SAMPLE_RATES_HZ.start(), SAMPLE_RATES_HZ.end())]
    SampleRate { name: String, sample_rate_hz: f64 },
    #[error("the name of a channel has {bytes} bytes, expected at most {MAX_NAME_BYTES}")]
    Name { bytes: usize },
    #[error("channel `{name}`: its samples are in {unit}; a sensitivity is needed, such as {example}")]
    NoSensitivity { name: String, unit: Unit, example: &'static str },
    #[error("channel `{name}`: its samples are in {unit}, its sensitivity is in {}", .sensitivity.output)]
    Output { name: String, unit: Unit, sensitivity: Sensitivity },
    #[error("channel `{name}`: `sensitivity` is {value}, expected a finite number above 0")]
    Sensitivity { name: String, value: f64 },
}

/// Why a text is not a unit.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unit `{0}`: expected Pa, m/s², g, V or FS (full scale)")]
pub struct UnitError(String);

/// Why a text is not a sensitivity.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "sensitivity `{0}`: expected a number above 0 with its unit, such as 50 mV/Pa, 100 mV/g, 0.01 V/(m/s²) or 0.1 FS/Pa"
)]
pub struct SensitivityError(String);

impl Waveform {
    /// Time of sample `index`, ns; rounded to the nearest nanosecond.
    pub fn stamp_ns(&self, index: usize) -> i64 {
        stamp_ns(self.first_stamp_ns, index as u64, self.channel.sample_rate_hz)
    }

    /// Length, s.
    pub fn duration_s(&self) -> f64 {
        self.samples.len() as f64 / self.channel.sample_rate_hz
    }
}

/// Time of the sample `index` samples after the one taken at `first_stamp_ns`, ns; the largest or smallest `i64` where
/// it would lie beyond.
pub fn stamp_ns(first_stamp_ns: i64, index: u64, sample_rate_hz: f64) -> i64 {
    first_stamp_ns.saturating_add((index as f64 / sample_rate_hz * 1e9).round() as i64)
}

impl Channel {
    /// How samples become Pa or m/s².
    ///
    /// # Errors
    /// A sample rate outside [`SAMPLE_RATES_HZ`], a name of more than [`MAX_NAME_BYTES`], and samples in volts or parts
    /// of full scale without a fitting sensitivity.
    pub fn calibration(&self) -> Result<Calibration, ChannelError> {
        let name = || self.name.clone();
        if self.name.len() > MAX_NAME_BYTES {
            return Err(ChannelError::Name { bytes: self.name.len() });
        }
        if !SAMPLE_RATES_HZ.contains(&self.sample_rate_hz) {
            return Err(ChannelError::SampleRate { name: name(), sample_rate_hz: self.sample_rate_hz });
        }
        let of = |quantity, factor| Ok(Calibration { quantity, factor });
        let example = match self.unit {
            Unit::Pascal => return of(Quantity::SoundPressure, 1.0),
            Unit::MetrePerSecondSquared => return of(Quantity::Acceleration, 1.0),
            Unit::StandardGravity => return of(Quantity::Acceleration, STANDARD_GRAVITY_M_S2),
            Unit::Volt => "50 mV/Pa",
            Unit::FullScale => "0.1 FS/Pa",
        };
        match self.sensitivity {
            None => Err(ChannelError::NoSensitivity { name: name(), unit: self.unit, example }),
            Some(sensitivity) if sensitivity.output != self.unit => {
                Err(ChannelError::Output { name: name(), unit: self.unit, sensitivity })
            }
            Some(Sensitivity { value, .. }) if !(value.is_finite() && value > 0.0) => {
                Err(ChannelError::Sensitivity { name: name(), value })
            }
            Some(Sensitivity { value, quantity, .. }) => of(quantity, 1.0 / value),
        }
    }
}

impl Quantity {
    /// The value of 0 dB: 20 µPa (ISO 1683:2015) or 1 µm/s².
    pub fn reference(self) -> f64 {
        match self {
            Self::SoundPressure => 20e-6,
            Self::Acceleration => 1e-6,
        }
    }

    /// Unit of its levels.
    pub fn level_unit(self) -> &'static str {
        match self {
            Self::SoundPressure => "dB(A) re 20 µPa",
            Self::Acceleration => "dB re 1 µm/s²",
        }
    }

    /// Level of an effective (root-mean-square) value, dB, not weighted.
    pub fn level_db(self, effective_value: f64) -> f64 {
        20.0 * (effective_value / self.reference()).log10()
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Pascal => "Pa",
            Self::MetrePerSecondSquared => "m/s²",
            Self::StandardGravity => "g",
            Self::Volt => "V",
            Self::FullScale => "FS",
        })
    }
}

impl FromStr for Unit {
    type Err = UnitError;

    fn from_str(text: &str) -> Result<Self, UnitError> {
        match text.trim() {
            "Pa" => Ok(Self::Pascal),
            "m/s²" | "m/s^2" | "m/s2" | "m/s**2" => Ok(Self::MetrePerSecondSquared),
            "g" => Ok(Self::StandardGravity),
            "V" => Ok(Self::Volt),
            "FS" => Ok(Self::FullScale),
            other => Err(UnitError(other.to_owned())),
        }
    }
}

impl fmt::Display for Sensitivity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let per = match self.quantity {
            Quantity::SoundPressure => "Pa",
            Quantity::Acceleration => "(m/s²)",
        };
        write!(f, "{} {}/{per}", self.value, self.output)
    }
}

impl FromStr for Sensitivity {
    type Err = SensitivityError;

    fn from_str(text: &str) -> Result<Self, SensitivityError> {
        let refused = || SensitivityError(text.to_owned());
        let (output, input) = text.split_once('/').ok_or_else(refused)?;
        let (output, input) = (output.trim(), input.trim().trim_start_matches('(').trim_end_matches(')'));
        let (number, scale, output) = if let Some(number) = output.strip_suffix("mV") {
            (number, 1e-3, Unit::Volt)
        } else if let Some(number) = output.strip_suffix('V') {
            (number, 1.0, Unit::Volt)
        } else if let Some(number) = output.strip_suffix("FS") {
            (number, 1.0, Unit::FullScale)
        } else {
            return Err(refused());
        };
        let (quantity, input) = match input.parse::<Unit>() {
            Ok(Unit::Pascal) => (Quantity::SoundPressure, 1.0),
            Ok(Unit::MetrePerSecondSquared) => (Quantity::Acceleration, 1.0),
            Ok(Unit::StandardGravity) => (Quantity::Acceleration, STANDARD_GRAVITY_M_S2),
            Ok(Unit::Volt | Unit::FullScale) | Err(_) => return Err(refused()),
        };
        let value = number.trim().parse::<f64>().map_err(|_| refused())? * scale / input;
        if value.is_finite() && value > 0.0 { Ok(Self { value, output, quantity }) } else { Err(refused()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(unit: Unit, sensitivity: Option<&str>) -> Channel {
        let sensitivity = sensitivity.map(|text| text.parse().unwrap());
        Channel { name: "microphone".to_owned(), sample_rate_hz: 51_200.0, unit, sensitivity }
    }

    #[test]
    fn calibration_converts_every_unit_to_pa_or_m_per_s2() {
        let factor = |unit, sensitivity| channel(unit, sensitivity).calibration().map(|c| (c.quantity, c.factor));
        let (sound, acceleration) = (Quantity::SoundPressure, Quantity::Acceleration);
        assert_eq!(factor(Unit::Pascal, None), Ok((sound, 1.0)));
        assert_eq!(factor(Unit::MetrePerSecondSquared, None), Ok((acceleration, 1.0)));
        assert_eq!(factor(Unit::StandardGravity, None), Ok((acceleration, 9.80665)));
        assert_eq!(factor(Unit::Volt, Some("50 mV/Pa")), Ok((sound, 20.0)));
        assert_eq!(factor(Unit::FullScale, Some("0.1FS/Pa")), Ok((sound, 10.0)));
        // 98.0665 mV/g are 10 mV/(m/s²): 100 m/s² per volt, up to rounding.
        let (quantity, per_volt) = factor(Unit::Volt, Some("98.0665 mV/g")).unwrap();
        assert!(quantity == acceleration && (per_volt - 100.0).abs() < 1e-10, "{per_volt}");
        assert_eq!("10 mV/(m/s²)".parse::<Sensitivity>().unwrap().to_string(), "0.01 V/(m/s²)");
    }

    #[test]
    fn refusals_name_channel_value_and_limit() {
        let error = |channel: &Channel| channel.calibration().unwrap_err().to_string();
        let slow = Channel { sample_rate_hz: 100.0, ..channel(Unit::Pascal, None) };
        assert_eq!(error(&slow), "channel `microphone`: `sample_rate_hz` is 100, expected 8000 to 204800");
        let nan = Channel { sample_rate_hz: f64::NAN, ..channel(Unit::Pascal, None) };
        assert!(error(&nan).contains("is NaN"));
        assert!(error(&channel(Unit::Volt, None)).ends_with("a sensitivity is needed, such as 50 mV/Pa"));
        assert!(error(&channel(Unit::FullScale, Some("50 mV/Pa"))).ends_with("in FS, its sensitivity is in V"));
        let long = Channel { name: "m".repeat(129), ..channel(Unit::Pascal, None) };
        assert_eq!(error(&long), "the name of a channel has 129 bytes, expected at most 128");
        for text in ["50", "50 mV", "-1 V/Pa", "0 V/Pa", "nan V/Pa", "1 V/V", "1 A/Pa", "V/Pa"] {
            assert!(text.parse::<Sensitivity>().is_err(), "{text}");
        }
        assert_eq!(
            "kN".parse::<Unit>().unwrap_err().to_string(),
            "unit `kN`: expected Pa, m/s², g, V or FS (full scale)"
        );
    }

    #[test]
    fn levels_refer_to_the_standard_values() {
        // 1 Pa is 20 log10(1 / 20e-6) = 93.979 dB.
        assert!((Quantity::SoundPressure.level_db(1.0) - 93.979_400_086_720_37).abs() < 1e-12);
        assert!((Quantity::Acceleration.level_db(1.0) - 120.0).abs() < 1e-12);
    }

    #[test]
    fn stamps_follow_the_rate_and_never_overflow() {
        let waveform =
            Waveform { channel: channel(Unit::Pascal, None), first_stamp_ns: 1_000, samples: vec![0.0; 51_200] };
        assert_eq!(waveform.stamp_ns(25_600), 500_001_000);
        assert!((waveform.duration_s() - 1.0).abs() < 1e-15);
        assert_eq!(stamp_ns(i64::MAX - 5, 51_200, 51_200.0), i64::MAX);
    }
}
