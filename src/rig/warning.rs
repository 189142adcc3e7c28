//! `[warning]`: thresholds of the levels, with which the settings of a session begin.

use serde::Deserialize;

use super::RigError;
use super::settings::within;

/// Declares the keys of `[warning]`, each with its default and its closed range.
macro_rules! thresholds {
    ($($(#[$doc:meta])* $key:ident = $default:expr, from $low:expr, to $high:expr;)*) => {
        /// Thresholds of warnings, as in the table `[warning]`.
        #[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Warning { $($(#[$doc])* pub $key: f64,)* }

        impl Default for Warning {
            fn default() -> Self {
                Self { $($key: $default,)* }
            }
        }

        impl Warning {
            /// The least value of each threshold.
            pub const LEAST: Self = Self { $($key: $low,)* };
            /// The largest value of each threshold.
            pub const MOST: Self = Self { $($key: $high,)* };

            /// Checks that every threshold is within its range; `file` is for errors.
            ///
            /// # Errors
            /// [`RigError::NotFinite`], [`RigError::Range`].
            pub fn check(self, file: &str) -> Result<Self, RigError> {
                let check = |field: &str, value: f64, low: f64, high: f64| {
                    within(file, field, value, (low..=high).contains(&value), &format!("{low} to {high}"))
                };
                $(check(concat!("warning.", stringify!($key)), self.$key, Self::LEAST.$key, Self::MOST.$key)?;)*
                Ok(self)
            }
        }
    };
}

thresholds! {
    /// WARN if the margin to the critical friction coefficient is below this.
    margin = 0.05, from 0.0, to 100.0;
    /// SQUEAL if a mode's damping ratio falls below this (negative: growing).
    damping_ratio = -1e-3, from -1.0, to 1.0;
    /// SQUEAL ends when every damping ratio exceeds `damping_ratio` by at least this.
    hysteresis = 5e-4, from 0.0, to 1.0;
    /// FAULT after this much silence, s.
    silence_s = 1.0, from 1e-3, to 1e6;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_outside_their_range_are_refused_with_it() {
        assert!(Warning::LEAST.check("rig.toml").is_ok() && Warning::MOST.check("rig.toml").is_ok());
        let refused = |warning: Warning| warning.check("rig.toml").map_err(|error| error.to_string());
        let margin = refused(Warning { margin: 100.5, ..Warning::default() });
        assert_eq!(margin.unwrap_err(), "rig.toml: `warning.margin` is 100.5, expected 0 to 100");
        assert!(refused(Warning { silence_s: 0.0, ..Warning::default() }).is_err());
        assert!(refused(Warning { hysteresis: f64::NAN, ..Warning::default() }).is_err());
    }
}
