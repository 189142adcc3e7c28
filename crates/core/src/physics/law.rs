//! Laws: the scalar factors of the terms of a model, as functions of the operating point.
//!
//! Everything that depends on which law a term has is here, in one `match` over all laws each: its value, its
//! derivatives, the conditions it depends on, and whether contact stiffness and damping scale it.

use std::sync::Arc;

use super::operating_point::{ContactState, OperatingPoint};
use super::stribeck::Stribeck;
use crate::chebyshev;

/// The scalar factor of a term, as a function of the operating point. Where its condition (contact closed, or
/// sliding) does not hold, the factor is 0.
#[derive(Clone, Debug)]
pub enum Law {
    /// `1` at every operating point.
    Constant,
    /// `κ(N) = (N / N_ref)^α` while the contact is closed.
    ContactStiffness,
    /// `s μ κ(N)` while the contact slides; `s` is the sign of the disc speed.
    FrictionStiffness,
    /// `1` while the contact is closed.
    ContactDamping,
    /// `s μ` while the contact slides.
    FrictionDamping,
    /// `N` while the contact slides; the matrix contains the slope `dμ/dv`.
    FrictionSlope,
    /// `N μ'(|Ω| ρ)` while the contact slides, with the slope of [`ContactLaw::stribeck`] at the radius `ρ`; 0 without
    /// it.
    FallingFriction {
        /// `ρ`, m.
        radius_m: f64,
    },
    /// `μ N / |ω|` while the contact slides.
    LateralFriction,
    /// `x T_k(x / r)` with `x = s μ`, while the contact slides. A sum of such terms expands `f(x) - f(0)` of a smooth
    /// function `f`. Undefined for `|μ| > r`.
    FrictionChebyshev {
        /// Degree `k` of the polynomial.
        degree: usize,
        /// Largest `|μ|` of the expansion, `r`.
        range: f64,
    },
    /// `Ω^p` of the disc speed `Ω` with its sign, rad/s, in any contact state: gyroscopic terms (`p = 1`) and spin
    /// terms (`p = 2`) of a disc that turns in the frame of the pad.
    DiscSpeed {
        /// Exponent `p`.
        power: u8,
    },
    /// `Ω^p` while the contact is closed.
    DiscSpeedInContact {
        /// Exponent `p`.
        power: u8,
    },
    /// `Ω^p x T_k(x / r)`, the product of [`Law::DiscSpeed`] and [`Law::FrictionChebyshev`].
    DiscSpeedChebyshev {
        /// Exponent `p`.
        power: u8,
        /// Degree `k` of the polynomial.
        degree: usize,
        /// Largest `|μ|` of the expansion, `r`.
        range: f64,
    },
    /// Any other function, given as an expression in the rig file.
    Custom(CustomLaw),
}

/// A law supplied by the caller, with the conditions it depends on.
#[derive(Clone)]
pub struct CustomLaw {
    /// The expression as written in the rig file.
    pub text: String,
    /// Evaluates the law. It receives a friction coefficient of 0 where the contact does not slide.
    pub evaluate: Arc<dyn Fn(&OperatingPoint) -> f64 + Send + Sync>,
    /// Whether its value changes with the normal load.
    pub depends_on_load: bool,
    /// Whether its value changes with the disc speed.
    pub depends_on_speed: bool,
    /// Whether its value changes with the friction coefficient.
    pub depends_on_friction: bool,
}

impl std::fmt::Debug for CustomLaw {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("CustomLaw").field(&self.text).finish()
    }
}

impl Law {
    /// Value of the law at `p` for the contact parameters `contact`. A model without contact pairs (`has_contact` is
    /// false) is always closed.
    pub fn value(&self, contact: &ContactLaw, has_contact: bool, p: &OperatingPoint) -> f64 {
        let state = p.state_of_contact(has_contact);
        let closed = state != ContactState::Open;
        let sliding = state == ContactState::Sliding;
        let when = |holds: bool, value: f64| if holds { value } else { 0.0 };
        let (load, mu) = (p.normal_load_n, p.friction_coefficient);
        let stiffening = || match contact.exponent {
            0.0 => 1.0,
            exponent => (load / contact.reference_n).powf(exponent),
        };
        match self {
            Self::Constant => 1.0,
            Self::ContactStiffness => when(closed, stiffening()),
            Self::FrictionStiffness => when(sliding, p.disc_speed_rad_s.signum() * mu * stiffening()),
            Self::ContactDamping => when(closed, 1.0),
            Self::FrictionDamping => when(sliding, p.disc_speed_rad_s.signum() * mu),
            Self::FrictionSlope => when(sliding, load),
            Self::FallingFriction { radius_m } => {
                when(sliding, load * contact.falling_slope(p.disc_speed_rad_s.abs() * radius_m))
            }
            Self::LateralFriction => when(sliding, mu * load / p.disc_speed_rad_s.abs()),
            Self::FrictionChebyshev { degree, range } => {
                let x = p.disc_speed_rad_s.signum() * mu;
                when(sliding, chebyshev::odd_at_zero(x, *degree, *range))
            }
            Self::DiscSpeed { power } => p.disc_speed_rad_s.powi(i32::from(*power)),
            Self::DiscSpeedInContact { power } => when(closed, p.disc_speed_rad_s.powi(i32::from(*power))),
            Self::DiscSpeedChebyshev { power, degree, range } => {
                let x = p.disc_speed_rad_s.signum() * mu;
                let turning = p.disc_speed_rad_s.powi(i32::from(*power));
                when(sliding, turning * chebyshev::odd_at_zero(x, *degree, *range))
            }
            Self::Custom(custom) => (custom.evaluate)(&if sliding { *p } else { p.with_friction(0.0) }),
        }
    }

    /// Derivative of [`Law::value`] with respect to `parameter`: per unit of the friction coefficient, per N, per rad/s,
    /// or per relative change of contact stiffness or damping. Custom laws are differentiated by central differences.
    pub fn derivative(&self, contact: &ContactLaw, has_contact: bool, p: &OperatingPoint, parameter: Parameter) -> f64 {
        use Parameter::{ContactDamping, ContactStiffness, Friction, Load, Speed};
        let state = p.state_of_contact(has_contact);
        let value = self.value(contact, has_contact, p);
        // The factor of the friction coefficient; evaluated at `μ = 1` because `μ` may be zero.
        let per_friction = || self.value(contact, has_contact, &p.with_friction(1.0));
        // The value is 0 where nothing slides, and load or speed may be zero there.
        let ratio = |value: f64, by: f64| if value == 0.0 { 0.0 } else { value / by };
        match self {
            Self::Constant => 0.0,
            Self::ContactStiffness => match parameter {
                Load => ratio(value * contact.exponent, p.normal_load_n),
                ContactStiffness => value,
                Friction | Speed | ContactDamping => 0.0,
            },
            Self::FrictionStiffness => match parameter {
                Friction => per_friction(),
                Load => ratio(value * contact.exponent, p.normal_load_n),
                ContactStiffness => value,
                Speed | ContactDamping => 0.0,
            },
            Self::ContactDamping => match parameter {
                ContactDamping => value,
                Friction | Load | Speed | ContactStiffness => 0.0,
            },
            Self::FrictionDamping => match parameter {
                Friction => per_friction(),
                ContactDamping => value,
                Load | Speed | ContactStiffness => 0.0,
            },
            Self::FrictionSlope => match parameter {
                Load => ratio(value, p.normal_load_n),
                Friction | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Self::FallingFriction { radius_m } => match parameter {
                Load => ratio(value, p.normal_load_n),
                Speed if state == ContactState::Sliding => {
                    let v = p.disc_speed_rad_s.abs() * radius_m;
                    let bend = contact.stribeck.map_or(0.0, |stribeck| stribeck.slope_per_speed(v));
                    p.normal_load_n * bend * radius_m * p.disc_speed_rad_s.signum()
                }
                Friction | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Self::LateralFriction => match parameter {
                Friction => per_friction(),
                Load => ratio(value, p.normal_load_n),
                Speed => ratio(-value, p.disc_speed_rad_s),
                ContactStiffness | ContactDamping => 0.0,
            },
            Self::FrictionChebyshev { degree, range } => match parameter {
                Friction if value.is_finite() && state == ContactState::Sliding => {
                    let sign = p.disc_speed_rad_s.signum();
                    sign * chebyshev::odd_at_zero_slope(sign * p.friction_coefficient, *degree, *range)
                }
                Friction | Load | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Self::DiscSpeed { power } => match parameter {
                Speed => power_slope(p.disc_speed_rad_s, *power),
                Friction | Load | ContactStiffness | ContactDamping => 0.0,
            },
            Self::DiscSpeedInContact { power } => match parameter {
                Speed if state != ContactState::Open => power_slope(p.disc_speed_rad_s, *power),
                Friction | Load | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Self::DiscSpeedChebyshev { power, degree, range } => {
                let expansion = Self::FrictionChebyshev { degree: *degree, range: *range };
                match parameter {
                    Speed => power_slope(p.disc_speed_rad_s, *power) * expansion.value(contact, has_contact, p),
                    Friction => {
                        p.disc_speed_rad_s.powi(i32::from(*power))
                            * expansion.derivative(contact, has_contact, p, Friction)
                    }
                    Load | ContactStiffness | ContactDamping => 0.0,
                }
            }
            Self::Custom(custom) => custom.derivative(p, parameter, |p| self.value(contact, has_contact, p)),
        }
    }

    /// Whether the value depends on the load and on the speed, apart from opening, stopping and reversing: `(load,
    /// speed)`.
    pub fn depends_on_load_and_speed(&self, contact: &ContactLaw) -> (bool, bool) {
        match self {
            Self::Constant | Self::ContactDamping | Self::FrictionDamping | Self::FrictionChebyshev { .. } => {
                (false, false)
            }
            Self::ContactStiffness | Self::FrictionStiffness => (contact.exponent != 0.0, false),
            Self::FrictionSlope => (true, false),
            Self::FallingFriction { .. } | Self::LateralFriction => (true, true),
            Self::DiscSpeed { .. } | Self::DiscSpeedInContact { .. } | Self::DiscSpeedChebyshev { .. } => (false, true),
            Self::Custom(custom) => (custom.depends_on_load, custom.depends_on_speed),
        }
    }

    /// Whether a common factor on the stiffness or the damping of all contact pairs multiplies the terms with this law
    /// or leaves them as they are. It does neither to the expansions of a contact with residual flexibility, whose
    /// derivatives with respect to these factors are therefore not available.
    pub(super) fn is_linear_in_contact(&self) -> bool {
        match self {
            Self::Constant
            | Self::ContactStiffness
            | Self::FrictionStiffness
            | Self::ContactDamping
            | Self::FrictionDamping
            | Self::FrictionSlope
            | Self::FallingFriction { .. }
            | Self::LateralFriction
            | Self::DiscSpeed { .. }
            | Self::DiscSpeedInContact { .. }
            | Self::Custom(_) => true,
            Self::FrictionChebyshev { .. } | Self::DiscSpeedChebyshev { .. } => false,
        }
    }
}

impl CustomLaw {
    /// Derivative of `value` by a central difference with a relative step of 1e-6.
    fn derivative(&self, p: &OperatingPoint, parameter: Parameter, value: impl Fn(&OperatingPoint) -> f64) -> f64 {
        let (depends, at, least) = match parameter {
            Parameter::Friction => (self.depends_on_friction, p.friction_coefficient, 1.0),
            Parameter::Load => (self.depends_on_load, p.normal_load_n, 1e-3),
            Parameter::Speed => (self.depends_on_speed, p.disc_speed_rad_s, 1e-3),
            Parameter::ContactStiffness | Parameter::ContactDamping => return 0.0,
        };
        if !depends {
            return 0.0;
        }
        let step = 1e-6 * at.abs().max(least);
        let moved = |to: f64| {
            let mut moved = *p;
            parameter.condition(&mut moved).into_iter().for_each(|condition| *condition = to);
            value(&moved)
        };
        let (up, down) = (moved(at + step), moved(at - step));
        // A law may be undefined for negative friction coefficients; the difference is then one-sided.
        if down.is_finite() { (up - down) / (2.0 * step) } else { (up - value(p)) / step }
    }
}

/// Derivative of `Ω^p` with respect to `Ω`.
fn power_slope(speed: f64, power: u8) -> f64 {
    match power {
        0 => 0.0,
        power => f64::from(power) * speed.powi(i32::from(power) - 1),
    }
}

/// Parameters of contact and friction: how both depend on load and speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactLaw {
    /// `α` in `k = k_ref (N / N_ref)^α`: 0 for a linear spring, 1/3 for Hertzian, 1 for exponential contact.
    pub exponent: f64,
    /// `N_ref`, N.
    pub reference_n: f64,
    /// `dμ/dv` at every speed, s/m; negative where friction falls with speed. The slope of `stribeck` is added to it.
    pub slope_s_per_m: f64,
    /// Friction that falls with the sliding speed of each pair.
    pub stribeck: Option<Stribeck>,
    /// Whether the friction force follows the direction of the sliding velocity, and so damps motion along `b`.
    pub lateral_damping: bool,
}

impl Default for ContactLaw {
    fn default() -> Self {
        Self { exponent: 0.0, reference_n: 500.0, slope_s_per_m: 0.0, stribeck: None, lateral_damping: false }
    }
}

impl ContactLaw {
    /// Slope of [`Self::stribeck`] at the sliding speed `v_m_s`, s/m; 0 without it.
    pub fn falling_slope(&self, v_m_s: f64) -> f64 {
        self.stribeck.map_or(0.0, |stribeck| stribeck.slope(v_m_s))
    }
}

/// The parameter of a derivative.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parameter {
    /// The friction coefficient.
    Friction,
    /// The normal load, N.
    Load,
    /// The disc speed, rad/s.
    Speed,
    /// The logarithm of a common factor on the stiffness of all contact pairs, so that derivatives are per relative
    /// change.
    ContactStiffness,
    /// The logarithm of a common factor on the damping of all contact pairs.
    ContactDamping,
}

impl Parameter {
    /// All parameters, in the order in which derivatives are listed.
    pub const ALL: [Self; 5] = [Self::Friction, Self::Load, Self::Speed, Self::ContactStiffness, Self::ContactDamping];

    /// The condition of `p` that this parameter is; `None` for a parameter of the contact pairs.
    pub(super) fn condition(self, p: &mut OperatingPoint) -> Option<&mut f64> {
        match self {
            Self::Friction => Some(&mut p.friction_coefficient),
            Self::Load => Some(&mut p.normal_load_n),
            Self::Speed => Some(&mut p.disc_speed_rad_s),
            Self::ContactStiffness | Self::ContactDamping => None,
        }
    }
}
