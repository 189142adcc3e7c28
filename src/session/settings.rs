//! The settings of a session, which can be changed while the node runs, with their validation.

use crate::rig::{Rig, Warning};

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

/// Declares the settings: name, initial value, closed range and description. Initial values may use the thresholds of
/// the rig, all of which are named first.
macro_rules! settings {
    (of $rig:pat, $($name:ident = $initial:expr, from $low:expr, to $high:expr, $description:literal;)*) => {
        /// Thresholds of levels, dead-bands, and the timeouts of inputs.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct Settings { $(#[doc = $description] pub $name: f64,)* }

        /// All parameters of a session, one for each of its [`Settings`]. Names carry units.
        pub const PARAMETERS: [Parameter; [$(stringify!($name)),*].len()] = [$(Parameter {
            name: stringify!($name),
            description: $description,
            low: $low,
            high: $high,
            field: |settings| &mut settings.$name,
        },)*];

        impl Settings {
            /// The initial settings of a session with `rig`.
            pub fn for_rig(rig: &Rig) -> Self {
                let $rig = rig.warning;
                Self { $($name: $initial,)* }
            }
        }
    };
}

settings! {
    of Warning { margin, damping_ratio, hysteresis, silence_s },
    warn_margin = margin, from Warning::LEAST.margin, to Warning::MOST.margin,
        "WARN when the margin to the critical friction coefficient is below this";
    squeal_damping_ratio = damping_ratio, from Warning::LEAST.damping_ratio, to Warning::MOST.damping_ratio,
        "SQUEAL when a mode's damping ratio falls below this (negative: growing)";
    squeal_hysteresis = hysteresis, from Warning::LEAST.hysteresis, to Warning::MOST.hysteresis,
        "SQUEAL ends when every damping ratio is above its limit by this much";
    silence_timeout_s = silence_s, from Warning::LEAST.silence_s, to Warning::MOST.silence_s,
        "FAULT after this much silence, in seconds";
    dead_band_load_n = 0.0, from 0.0, to 1e6,
        "changes of load up to this reuse the previous prediction, in N";
    dead_band_speed_rad_s = 0.0, from 0.0, to 1e4,
        "changes of disc speed up to this reuse the previous prediction, in rad/s";
    dead_band_friction = 0.0, from 0.0, to 10.0,
        "changes of friction coefficient up to this reuse the previous prediction";
    dead_band_temperature_k = 2.0, from 0.1, to 1000.0,
        "changes of temperature up to this keep the rig as it is, in K";
    temperature_timeout_s = 30.0, from 0.1, to 1e6,
        "a temperature older than this is stale, in seconds";
    map_tolerance = 0.01, from 0.0, to 1.0,
        "relative change of load or speed after which windows of instability no longer count";
}

/// The parameter of this name.
pub fn find(name: &str) -> Option<&'static Parameter> {
    PARAMETERS.iter().find(|parameter| parameter.name == name)
}

/// Looks up a parameter and checks `value` against its range.
///
/// # Errors
/// [`SettingError`] for an unknown name or a value outside the range.
pub fn validate(name: &str, value: f64) -> Result<&'static Parameter, SettingError> {
    let Some(parameter) = find(name) else {
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
