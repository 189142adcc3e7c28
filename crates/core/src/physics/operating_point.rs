//! Operating points and the contact state they imply.

/// Disc speed below which the contact does not slide and friction does no work, rad/s.
pub const SLIDING_SPEED_RAD_S: f64 = 0.01;

/// An operating point `p`: normal load, disc speed, friction coefficient.
///
/// A negative speed is rotation in the opposite direction, which reverses the sliding direction `t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OperatingPoint {
    /// Total normal load, N. Each contact pair carries this divided by the number of pairs.
    pub normal_load_n: f64,
    /// Disc speed about the axis of the contact patch, right-handed, rad/s.
    pub disc_speed_rad_s: f64,
    /// Coulomb friction coefficient, dimensionless.
    pub friction_coefficient: f64,
}

/// State of the contact between pad and disc at an operating point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ContactState {
    /// Closed and sliding: springs and friction act.
    Sliding,
    /// Closed, but slower than [`SLIDING_SPEED_RAD_S`]: springs act, the friction coefficient is taken as 0.
    NotSliding,
    /// No normal load: neither springs nor friction act.
    Open,
}

impl OperatingPoint {
    /// State of the contact at this operating point.
    pub fn contact_state(&self) -> ContactState {
        if self.normal_load_n <= 0.0 {
            ContactState::Open
        } else if self.disc_speed_rad_s.abs() < SLIDING_SPEED_RAD_S {
            ContactState::NotSliding
        } else {
            ContactState::Sliding
        }
    }

    /// State of a contact that never opens, at any load.
    pub fn state_closed(&self) -> ContactState {
        Self { normal_load_n: 1.0, ..*self }.contact_state()
    }

    /// State of the contact of a model: that of [`Self::contact_state`] if it has contact pairs, else always closed.
    pub fn state_of_contact(&self, has_contact: bool) -> ContactState {
        if has_contact { self.contact_state() } else { self.state_closed() }
    }

    /// The same load and speed with another friction coefficient.
    pub fn with_friction(self, friction_coefficient: f64) -> Self {
        Self { friction_coefficient, ..self }
    }

    /// Whether all three values are finite.
    pub fn is_finite(&self) -> bool {
        self.normal_load_n.is_finite() && self.disc_speed_rad_s.is_finite() && self.friction_coefficient.is_finite()
    }
}

impl ContactState {
    /// Note for the user about a contact that does not slide; `None` for a sliding one.
    pub fn note(self) -> Option<&'static str> {
        match self {
            Self::Sliding => None,
            Self::NotSliding => Some("not sliding: friction coefficient taken as 0"),
            Self::Open => Some("contact open: no normal load"),
        }
    }
}
