//! The settings of a session, which can be changed while the node runs, with their validation.

use crate::rig::Rig;

/// Thresholds of levels, dead-bands for reuse, and the silence timeout.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// WARN if the margin to the nearest end of a window is below this.
    pub warn_margin: f64,
    /// SQUEAL if a mode's damping ratio falls below this.
    pub squeal_damping_ratio: f64,
    /// SQUEAL ends when every damping ratio exceeds the limit by at least this.
    pub squeal_hysteresis: f64,
    /// FAULT after this much silence, s.
    pub silence_timeout_s: f64,
    /// Dead-band of load: the previous prediction is reused for changes up to this, N.
    pub dead_band_load_n: f64,
    /// Dead-band of speed: the previous prediction is reused for changes up to this, rad/s.
    pub dead_band_speed_rad_s: f64,
    /// Dead-band of the friction coefficient: the previous prediction is reused for changes up to this.
    pub dead_band_friction: f64,
    /// Largest relative change of load or speed from those of the stability map for which its windows are still used.
    pub map_tolerance: f64,
}

/// Why a setting was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SettingError {
    #[error("no parameter `{name}`; there are {known}")]
    Unknown { name: String, known: String },
    #[error("parameter `{name}` = {value}: expected a number from {low} to {high}")]
    OutOfRange { name: String, value: f64, low: f64, high: f64 },
}

/// A parameter: name, description and closed range.
pub struct Parameter {
    pub name: &'static str,
    pub description: &'static str,
    pub low: f64,
    pub high: f64,
    field: fn(&mut Settings) -> &mut f64,
}

/// All parameters of a session. Names carry units.
pub const PARAMETERS: [Parameter; 8] = [
    Parameter {
        name: "warn_margin",
        description: "WARN when the margin to the critical friction coefficient is below this",
        low: 0.0,
        high: 100.0,
        field: |s| &mut s.warn_margin,
    },
    Parameter {
        name: "squeal_damping_ratio",
        description: "SQUEAL when a mode's damping ratio falls below this (negative: growing)",
        low: -1.0,
        high: 1.0,
        field: |s| &mut s.squeal_damping_ratio,
    },
    Parameter {
        name: "squeal_hysteresis",
        description: "SQUEAL ends when every damping ratio is above its limit by this much",
        low: 0.0,
        high: 1.0,
        field: |s| &mut s.squeal_hysteresis,
    },
    Parameter {
        name: "silence_timeout_s",
        description: "FAULT after this much silence, in seconds",
        low: 1e-3,
        high: 1e6,
        field: |s| &mut s.silence_timeout_s,
    },
    Parameter {
        name: "dead_band_load_n",
        description: "changes of load up to this reuse the previous prediction, in N",
        low: 0.0,
        high: 1e6,
        field: |s| &mut s.dead_band_load_n,
    },
    Parameter {
        name: "dead_band_speed_rad_s",
        description: "changes of disc speed up to this reuse the previous prediction, in rad/s",
        low: 0.0,
        high: 1e4,
        field: |s| &mut s.dead_band_speed_rad_s,
    },
    Parameter {
        name: "dead_band_friction",
        description: "changes of friction coefficient up to this reuse the previous prediction",
        low: 0.0,
        high: 10.0,
        field: |s| &mut s.dead_band_friction,
    },
    Parameter {
        name: "map_tolerance",
        description: "relative change of load or speed after which windows of instability no longer count",
        low: 0.0,
        high: 1.0,
        field: |s| &mut s.map_tolerance,
    },
];

/// Looks up a parameter and checks `value` against its range.
///
/// # Errors
/// [`SettingError`] for an unknown name or a value outside the range.
pub fn validate(name: &str, value: f64) -> Result<&'static Parameter, SettingError> {
    let Some(parameter) = PARAMETERS.iter().find(|p| p.name == name) else {
        let known: Vec<_> = PARAMETERS.iter().map(|p| p.name).collect();
        return Err(SettingError::Unknown { name: name.to_owned(), known: known.join(", ") });
    };
    let (low, high) = (parameter.low, parameter.high);
    if (low..=high).contains(&value) {
        Ok(parameter)
    } else {
        Err(SettingError::OutOfRange { name: name.to_owned(), value, low, high })
    }
}

impl Settings {
    /// The initial settings of a session with `rig`.
    pub fn for_rig(rig: &Rig) -> Self {
        Self {
            warn_margin: rig.warning.margin,
            squeal_damping_ratio: rig.warning.damping_ratio,
            squeal_hysteresis: rig.warning.hysteresis,
            silence_timeout_s: rig.warning.silence_s,
            dead_band_load_n: 0.0,
            dead_band_speed_rad_s: 0.0,
            dead_band_friction: 0.0,
            map_tolerance: 0.01,
        }
    }

    /// Changes one setting.
    ///
    /// # Errors
    /// [`SettingError`], in which case nothing is changed.
    pub fn set(&mut self, name: &str, value: f64) -> Result<(), SettingError> {
        *(validate(name, value)?.field)(self) = value;
        Ok(())
    }

    /// All settings, by name.
    pub fn values(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let mut copy = *self;
        PARAMETERS.iter().map(move |p| (p.name, *(p.field)(&mut copy)))
    }
}
