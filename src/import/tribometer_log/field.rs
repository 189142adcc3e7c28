//! The quantities of a log: their column names and units.

use std::{f64::consts::TAU, fmt};

use crate::msgs::listed;

listed! {
    /// A quantity in a column; the name contains the unit in which it is stored.
    pub enum Field {
        /// Time of measurement.
        Time,
        NormalLoadN,
        DiscSpeedRadS,
        FrictionCoefficient,
        /// Alternative to the friction coefficient, which is then this force over the normal load.
        FrictionForceN,
        /// Temperature of the contact. A log need not have it.
        TemperatureC,
    }
}

impl Field {
    /// Name in options and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Time => "time_s",
            Self::NormalLoadN => "normal_load_n",
            Self::DiscSpeedRadS => "disc_speed_rad_s",
            Self::FrictionCoefficient => "friction_coefficient",
            Self::FrictionForceN => "friction_force_n",
            Self::TemperatureC => "temperature_c",
        }
    }

    /// The field of a [`name`](Self::name).
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|field| field.name() == name)
    }

    /// Whether a log can do without it, and without an alternative. A column that is not certain to hold it is omitted.
    pub fn is_optional(self) -> bool {
        match self {
            Self::TemperatureC => true,
            Self::Time | Self::NormalLoadN | Self::DiscSpeedRadS | Self::FrictionCoefficient | Self::FrictionForceN => {
                false
            }
        }
    }

    /// Usual column names, words joined by `_`.
    pub(super) fn synonyms(self) -> &'static [&'static str] {
        match self {
            Self::Time => &[
                "time",
                "t",
                "timestamp",
                "time_stamp",
                "datetime",
                "date_time",
                "stamp",
                "elapsed",
                "zeit",
                "zeitstempel",
                "datum_zeit",
            ],
            Self::NormalLoadN => &[
                "normal_load",
                "load",
                "normal_force",
                "force_normal",
                "fn",
                "f_n",
                "normalkraft",
                "contact_force",
                "axial_force",
                "axial_load",
                "anpresskraft",
                "axialkraft",
                "nominal_load",
                "daq_fz",
            ],
            Self::DiscSpeedRadS => &[
                "disc_speed",
                "disk_speed",
                "speed",
                "rotational_speed",
                "rotation_speed",
                "angular_speed",
                "angular_velocity",
                "omega",
                "ω",
                "drehzahl",
                "rpm",
                "sliding_speed",
                "linear_speed",
                "max_linear_speed",
                "gleitgeschwindigkeit",
                "rotary_velocity",
            ],
            Self::FrictionCoefficient => &[
                "friction_coefficient",
                "coefficient_of_friction",
                "friction",
                "mu",
                "μ",
                "cof",
                "reibwert",
                "reibungszahl",
                "reibungskoeffizient",
                "daq_cof",
            ],
            Self::FrictionForceN => &[
                "friction_force",
                "tangential_force",
                "ft",
                "f_t",
                "ff",
                "f_f",
                "reibkraft",
                "reibungskraft",
                "daq_fx",
            ],
            Self::TemperatureC => &["temperature", "contact_temperature", "temperatur", "kontakttemperatur"],
        }
    }

    /// Accepted units with their value in the stored unit; of time in ns.
    pub(super) fn units(self) -> &'static [(&'static str, f64)] {
        // Forces in grams and kilograms are those of standard gravity, 9.80665 m/s².
        const FORCES: &[(&str, f64)] = &[
            ("N", 1.0),
            ("daN", 10.0),
            ("kN", 1e3),
            ("mN", 1e-3),
            ("g", 9.80665e-3),
            ("gf", 9.80665e-3),
            ("kg", 9.80665),
            ("kgf", 9.80665),
            ("kp", 9.80665),
            ("lbf", 4.4482216152605),
        ];
        match self {
            Self::Time => {
                &[("s", 1e9), ("sec", 1e9), ("ms", 1e6), ("us", 1e3), ("ns", 1.0), ("min", 60e9), ("h", 3600e9)]
            }
            Self::NormalLoadN | Self::FrictionForceN => FORCES,
            Self::DiscSpeedRadS => &[
                ("rad/s", 1.0),
                ("rad_s", 1.0),
                ("rpm", TAU / 60.0),
                ("1/min", TAU / 60.0),
                ("min-1", TAU / 60.0),
                ("min^-1", TAU / 60.0),
                ("U/min", TAU / 60.0),
                ("rev/min", TAU / 60.0),
                ("Hz", TAU),
                ("rev/s", TAU),
                ("deg/s", TAU / 360.0),
            ],
            // The force that Rtec tribometers divide by the load is named where others have a unit.
            Self::FrictionCoefficient => &[("-", 1.0), ("1", 1.0), ("", 1.0), ("Fx", 1.0)],
            Self::TemperatureC => &[("°C", 1.0), ("C", 1.0), ("degC", 1.0), ("deg C", 1.0)],
        }
    }

    /// Accepted units of the sliding speed with their value in m/s, for disc speeds.
    pub(super) fn sliding_units(self) -> &'static [(&'static str, f64)] {
        match self {
            Self::DiscSpeedRadS => &[("m/s", 1.0), ("mm/s", 1e-3), ("mm/sec", 1e-3)],
            Self::Time | Self::NormalLoadN | Self::FrictionCoefficient | Self::FrictionForceN | Self::TemperatureC => {
                &[]
            }
        }
    }

    /// The unit that a text names, with its value in the stored unit.
    pub(super) fn unit(self, text: &str) -> Option<(&'static str, f64)> {
        named(self.units(), text)
    }

    /// The unit of the sliding speed that a text names, with its value in m/s.
    pub(super) fn sliding_unit(self, text: &str) -> Option<(&'static str, f64)> {
        named(self.sliding_units(), text)
    }
}

/// The unit that a text names: written as in the list, or else with other capitals, unless these mean another prefix.
fn named(units: &'static [(&'static str, f64)], text: &str) -> Option<(&'static str, f64)> {
    let text = text.trim().replace(['µ', 'μ'], "u");
    let exact = units.iter().find(|(unit, _)| *unit == text);
    let alike = || units.iter().find(|(unit, _)| unit.eq_ignore_ascii_case(&text) && text != "MN");
    exact.or_else(alike).copied()
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
