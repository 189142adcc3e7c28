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
        }
    }

    /// The field of a [`name`](Self::name).
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|field| field.name() == name)
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
            ],
            Self::FrictionForceN => {
                &["friction_force", "tangential_force", "ft", "f_t", "ff", "f_f", "reibkraft", "reibungskraft"]
            }
        }
    }

    /// Accepted units with their value in the stored unit; of time in ns.
    pub(super) fn units(self) -> &'static [(&'static str, f64)] {
        const FORCES: &[(&str, f64)] = &[("N", 1.0), ("daN", 10.0), ("kN", 1e3)];
        match self {
            Self::Time => &[("s", 1e9), ("ms", 1e6), ("us", 1e3), ("ns", 1.0), ("min", 60e9), ("h", 3600e9)],
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
            Self::FrictionCoefficient => &[("-", 1.0), ("1", 1.0), ("", 1.0)],
        }
    }

    pub(super) fn unit(self, text: &str) -> Option<(&'static str, f64)> {
        let text = text.trim().replace(['µ', 'μ'], "u");
        let exact = self.units().iter().find(|(unit, _)| *unit == text);
        exact.or_else(|| self.units().iter().find(|(unit, _)| unit.eq_ignore_ascii_case(&text))).copied()
    }
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
