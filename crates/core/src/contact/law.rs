//! Contact laws: pressure against closure of a pair.

use super::spline::{PressureTable, TableError};

/// Steps of the scalar solve in [`PressureLaw::shared_closure`] and [`PressureLaw::closure_at`].
const SCALAR_STEPS: usize = 80;

/// A contact law: force per unit area (or per unit of the pair's factor) as a function of the closure `δ`, the
/// penetration of the undeformed surfaces, positive where they overlap.
///
/// With areas in m² the values are pressures in Pa; with a factor of 1 per pair they are forces in N.
#[derive(Clone, Debug, PartialEq)]
pub enum PressureLaw {
    /// `p = k δ` for `δ > 0`, else 0. The tangent jumps where a pair opens.
    Linear {
        /// `k`, N/m³ (N/m with a factor of 1), positive.
        stiffness: f64,
    },
    /// `p = k d_0 (δ / d_0)^m` for `δ > 0`, else 0. With a roughness height `σ > 0`, `δ` is replaced by
    /// `σ ln(1 + e^{δ/σ})`, which tends to `δ` for `δ ≫ σ` and to `σ e^{δ/σ}` for `δ ≪ -σ`; the law is then analytic and
    /// positive everywhere.
    Power {
        /// `k`, N/m³: secant stiffness at `d_0`, positive.
        stiffness: f64,
        /// `d_0`, m, positive.
        reference_m: f64,
        /// `m`, at least 1: 1.5 for a Hertz-like contact, 2 usual for friction material.
        exponent: f64,
        /// `σ`, m; 0 for the law with a sharp onset.
        roughness_m: f64,
    },
    /// `p = p_0 e^{δ/σ}`: rough surfaces. Analytic; every pair carries a force, however small, at any closure.
    Exponential {
        /// `p_0`, Pa: pressure at closure 0, positive.
        pressure: f64,
        /// `σ`, m: roughness height, positive.
        roughness_m: f64,
    },
    /// A measured curve.
    Table(PressureTable),
}

/// Value and derivatives of a contact law at a closure.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LawValue {
    /// `p`, Pa.
    pub pressure: f64,
    /// `dp/dδ`, Pa/m; 0 where a pair with a sharp onset is open.
    pub tangent: f64,
    /// `d²p/dδ²`, Pa/m².
    pub curvature: f64,
}

/// How smooth a contact law is, which limits how smooth roots are as functions of load and friction coefficient.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Smoothness {
    /// The tangent jumps where a pair opens, and so do roots.
    TangentJumps,
    /// The tangent is continuous with a kink where a pair opens.
    TangentKinks,
    /// Twice continuously differentiable.
    TwiceDifferentiable,
    /// Analytic.
    Analytic,
}

/// Why a contact law is invalid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LawError {
    /// A parameter is outside its range.
    #[error("{field} is {value}, expected {limit}")]
    Value {
        /// The parameter.
        field: &'static str,
        /// Its value.
        value: f64,
        /// The range expected.
        limit: &'static str,
    },
    /// The table is invalid.
    #[error(transparent)]
    Table(#[from] TableError),
}

impl PressureLaw {
    /// Checks the parameters of the law.
    ///
    /// # Errors
    /// [`LawError::Value`].
    pub fn check(&self) -> Result<(), LawError> {
        let holds = |field, value: f64, holds: bool, limit| {
            if value.is_finite() && holds { Ok(()) } else { Err(LawError::Value { field, value, limit }) }
        };
        let positive = |field, value: f64| holds(field, value, value > 0.0, "more than 0");
        match *self {
            Self::Linear { stiffness } => positive("stiffness", stiffness),
            Self::Power { stiffness, reference_m, exponent, roughness_m } => {
                positive("stiffness", stiffness)?;
                positive("reference_m", reference_m)?;
                holds("exponent", exponent, (1.0..=10.0).contains(&exponent), "1 to 10")?;
                holds("roughness_m", roughness_m, roughness_m >= 0.0, "at least 0")
            }
            Self::Exponential { pressure, roughness_m } => {
                positive("pressure", pressure)?;
                positive("roughness_m", roughness_m)
            }
            Self::Table(_) => Ok(()),
        }
    }

    /// How smooth the law is over all closures.
    pub fn smoothness(&self) -> Smoothness {
        match *self {
            Self::Linear { .. } => Smoothness::TangentJumps,
            Self::Exponential { .. } => Smoothness::Analytic,
            Self::Power { roughness_m, .. } if roughness_m > 0.0 => Smoothness::Analytic,
            Self::Power { exponent, .. } if exponent <= 1.0 => Smoothness::TangentJumps,
            Self::Power { exponent, .. } if exponent <= 2.0 => Smoothness::TangentKinks,
            Self::Power { .. } => Smoothness::TwiceDifferentiable,
            Self::Table(ref table) => table.smoothness(),
        }
    }

    /// The closures at which the law is not analytic, in ascending order.
    pub fn breaks(&self) -> &[f64] {
        match *self {
            Self::Linear { .. } => &[0.0],
            Self::Power { roughness_m: 0.0, .. } => &[0.0],
            Self::Power { .. } | Self::Exponential { .. } => &[],
            Self::Table(ref table) => table.breaks(),
        }
    }

    /// Whether the force of a pair is exactly 0 below some closure. Otherwise every pair carries a force at any closure.
    pub fn opens(&self) -> bool {
        match *self {
            Self::Linear { .. } => true,
            Self::Power { roughness_m, .. } => roughness_m == 0.0,
            Self::Exponential { .. } => false,
            Self::Table(ref table) => table.opens(),
        }
    }

    /// Pressure, tangent and curvature at the closure `delta_m`. The pressure is infinite where it overflows.
    pub fn at(&self, delta_m: f64) -> LawValue {
        match *self {
            Self::Linear { stiffness } => {
                if delta_m > 0.0 {
                    LawValue { pressure: stiffness * delta_m, tangent: stiffness, curvature: 0.0 }
                } else {
                    LawValue::default()
                }
            }
            Self::Power { stiffness, reference_m, exponent, roughness_m } => {
                // Effective closure and its derivatives.
                let (closure, slope, bend) = if roughness_m > 0.0 {
                    softened(delta_m, roughness_m)
                } else if delta_m > 0.0 {
                    (delta_m, 1.0, 0.0)
                } else {
                    return LawValue::default();
                };
                if closure == 0.0 {
                    return LawValue::default();
                }
                let ratio = closure / reference_m;
                let tangent = exponent * stiffness * ratio.powf(exponent - 1.0);
                let curvature = match exponent {
                    1.0 => 0.0,
                    _ => exponent * (exponent - 1.0) * stiffness / reference_m * ratio.powf(exponent - 2.0),
                };
                LawValue {
                    pressure: stiffness * reference_m * ratio.powf(exponent),
                    tangent: tangent * slope,
                    // Far below a rounded onset one factor is very large and another very small; multiplied in this order,
                    // nothing overflows.
                    curvature: curvature * slope * slope + tangent * bend,
                }
            }
            Self::Exponential { pressure, roughness_m } => {
                let pressure = pressure * (delta_m / roughness_m).exp();
                let tangent = pressure / roughness_m;
                LawValue { pressure, tangent, curvature: tangent / roughness_m }
            }
            Self::Table(ref table) => table.at(delta_m),
        }
    }

    /// The closure at which the pressure is `pressure > 0`.
    pub fn closure_at(&self, pressure: f64) -> f64 {
        match *self {
            Self::Linear { stiffness } => pressure / stiffness,
            Self::Exponential { pressure: at_zero, roughness_m } => roughness_m * (pressure / at_zero).ln(),
            Self::Power { stiffness, reference_m, exponent, roughness_m } => {
                let closure = reference_m * (pressure / (stiffness * reference_m)).powf(1.0 / exponent);
                if roughness_m > 0.0 {
                    // Inverse of σ ln(1 + e^{δ/σ}).
                    closure + roughness_m * (-(-closure / roughness_m).exp_m1()).ln()
                } else {
                    closure
                }
            }
            Self::Table(ref table) => table.closure_at(pressure),
        }
    }

    /// The closure `δ` with `δ + flexibility · p(δ) = total`: of the `total` approach of two bodies, what a pair in series
    /// with a spring of that `flexibility` takes. A starting point for Newton steps, which do not depend on its last
    /// digits.
    pub(super) fn shared_closure(&self, total: f64, flexibility: f64) -> f64 {
        if let Self::Linear { stiffness } = *self {
            return if total > 0.0 { total / (1.0 + flexibility * stiffness) } else { total };
        }
        let force_share = |delta: f64| flexibility * self.at(delta).pressure;
        let at_total = force_share(total);
        if at_total <= f64::EPSILON * total.abs() * 0.01 {
            return total;
        }
        // The left side grows with δ, so these two enclose the solution; both are finite also where p(total) is not.
        let at_zero = force_share(0.0);
        let (mut low, mut high) =
            if at_zero <= total { (0.0, total) } else { (total.min(0.0) - at_zero, total.min(0.0)) };
        let mut delta = if high.min(total) == total { 0.5 * (low + high) } else { high };
        for _ in 0..SCALAR_STEPS {
            let value = self.at(delta);
            let share = flexibility * value.pressure;
            if delta + share > total {
                high = delta;
            } else {
                low = delta;
            }
            // Newton on ln(flexibility p) = ln(total - δ), nearly linear for powers and exponentials.
            let rest = total - delta;
            let step = if share > 0.0 && rest > 0.0 && share.is_finite() {
                (share / rest).ln() / (value.tangent / value.pressure + 1.0 / rest)
            } else {
                f64::NAN
            };
            let newton = delta - step;
            let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            let moved = (next - delta).abs();
            delta = next;
            if moved <= 1e-15 * delta.abs() || low >= high {
                break;
            }
        }
        delta
    }
}

/// `σ ln(1 + e^{x/σ})` with its first and second derivative.
fn softened(x: f64, sigma: f64) -> (f64, f64, f64) {
    let ratio = x / sigma;
    if ratio > 0.0 {
        let tail = (-ratio).exp();
        let slope = 1.0 / (1.0 + tail);
        (x + sigma * tail.ln_1p(), slope, slope * slope * tail / sigma)
    } else {
        let head = ratio.exp();
        let rest = 1.0 / (1.0 + head);
        (sigma * head.ln_1p(), head * rest, head * rest * rest / sigma)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn laws() -> Vec<PressureLaw> {
        let power =
            |exponent, roughness_m| PressureLaw::Power { stiffness: 2e11, reference_m: 1e-5, exponent, roughness_m };
        let table = |first| PressureTable::new(&[0.0, 2e-6, 5e-6, 1e-5, 4e-5], &[first, 1e5, 4e5, 1.2e6, 2e7]).unwrap();
        vec![
            PressureLaw::Linear { stiffness: 2e11 },
            power(1.0, 0.0),
            power(1.5, 0.0),
            power(2.0, 0.0),
            power(3.0, 0.0),
            power(1.0, 1e-6),
            power(1.5, 1e-6),
            power(2.0, 3e-7),
            PressureLaw::Exponential { pressure: 1e4, roughness_m: 2e-6 },
            PressureLaw::Table(table(0.0)),
            PressureLaw::Table(table(1e4)),
        ]
    }

    /// Central differences with a step of 1e-4 of a micrometre; a third derivative of `p/σ³` leaves an error of
    /// `(1e-10/1e-6)²` of the value, rounding one of 1e-16/1e-4.
    #[test]
    fn derivatives_agree_with_differences() {
        let step = 1e-10;
        for law in laws() {
            for delta in [-9e-6, -1e-6, 3e-7, 1.3e-6, 4.1e-6, 8e-6, 2.2e-5, 3.6e-5] {
                let [low, at, high] = [delta - step, delta, delta + step].map(|x| law.at(x));
                let tangent = (high.pressure - low.pressure) / (2.0 * step);
                let curvature = (high.tangent - low.tangent) / (2.0 * step);
                let close = |found: f64, expected: f64, scale: f64| (found - expected).abs() <= 1e-5 * scale;
                assert!(close(at.tangent, tangent, at.tangent.abs()), "{law:?} {delta}: {at:?} {tangent}");
                assert!(close(at.curvature, curvature, at.curvature.abs() + at.tangent / 1e-5), "{law:?} {delta}");
            }
        }
    }

    #[test]
    fn laws_are_monotone_and_open_where_they_say() {
        for law in laws() {
            law.check().unwrap();
            let mut last = 0.0;
            for k in -400..400 {
                let value = law.at(f64::from(k) * 1e-7);
                assert!(value.pressure >= last && value.tangent >= 0.0, "{law:?} {k}: {value:?}");
                assert!(k > 0 || !law.opens() || value == LawValue::default(), "{law:?} {k}: {value:?}");
                last = value.pressure;
            }
        }
    }

    #[test]
    fn closures_are_found_again() {
        for law in laws() {
            for pressure in [1e-3, 10.0, 3e4, 2e5, 7e6] {
                let delta = law.closure_at(pressure);
                let found = law.at(delta);
                // An error of one rounding in δ moves the pressure by the tangent times that.
                let tolerance = 1e-13 * (pressure + found.tangent * (delta.abs() + 1e-6));
                assert!((found.pressure - pressure).abs() <= tolerance, "{law:?} {pressure}: {found:?} at {delta}");
                for flexibility in [1e-14, 1e-10, 1e-6, 1.0] {
                    for total in [-3e-4, -1e-6, 0.0, 1e-9, 2e-6, 1e-4, 1e-2] {
                        let delta = law.shared_closure(total, flexibility);
                        let left = delta + flexibility * law.at(delta).pressure;
                        let slope = 1.0 + flexibility * law.at(delta).tangent;
                        let tolerance = 1e-12 * (total.abs() + slope * delta.abs() + 1e-9);
                        assert!((left - total).abs() <= tolerance, "{law:?} {flexibility} {total}: {delta} {left}");
                    }
                }
            }
        }
    }

    /// A law rounded over a vanishing roughness height is the sharp one; the rounded closure is ln 2 of that height at 0.
    #[test]
    fn rounding_vanishes_with_the_roughness() {
        let power = |roughness_m| PressureLaw::Power { stiffness: 2e11, reference_m: 1e-5, exponent: 2.0, roughness_m };
        for delta in [1e-6, 1e-5] {
            let [sharp, rounded] = [power(0.0), power(1e-8)].map(|law| law.at(delta));
            assert!((sharp.pressure / rounded.pressure - 1.0).abs() < 1e-12);
            assert!((sharp.tangent / rounded.tangent - 1.0).abs() < 1e-12);
        }
        let expected = 2e11 * 1e-5 * (1e-8 * std::f64::consts::LN_2 / 1e-5f64).powi(2);
        assert!((power(1e-8).at(0.0).pressure / expected - 1.0).abs() < 1e-14);
        assert!(power(1e-8).at(-1.0).pressure == 0.0 && power(1e-8).at(-1e-6).pressure > 0.0);
    }

    #[test]
    fn invalid_parameters_are_refused() {
        let power =
            |exponent, roughness_m| PressureLaw::Power { stiffness: 1.0, reference_m: 1.0, exponent, roughness_m };
        for law in [
            PressureLaw::Linear { stiffness: 0.0 },
            PressureLaw::Linear { stiffness: f64::NAN },
            power(0.9, 0.0),
            power(2.0, -1.0),
            PressureLaw::Exponential { pressure: 1.0, roughness_m: f64::INFINITY },
        ] {
            assert!(matches!(law.check(), Err(LawError::Value { .. })), "{law:?}");
        }
    }
}
