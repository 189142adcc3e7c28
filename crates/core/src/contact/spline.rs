//! A measured curve of pressure against closure, interpolated monotonically and twice continuously differentiable.
//!
//! Between two points at distance `h` with secant slope `Δ`, slopes `d_0` and `d_1` at the ends and `θ` from 0 to 1, the
//! curve is the rational quadratic
//!
//! ```text
//! p(θ)  = p_0 + (p_1 - p_0) (Δ θ² + d_0 θ(1-θ)) / Q,   Q = Δ + (d_0 + d_1 - 2Δ) θ(1-θ)
//! p'(θ) = Δ² (d_1 θ² + 2Δ θ(1-θ) + d_0 (1-θ)²) / Q²
//! ```
//!
//! `Q = Δ (θ² + (1-θ)²) + (d_0 + d_1) θ(1-θ)` is positive, and so is `p'`, for any positive slopes: the curve is monotone
//! whatever the data. The slopes follow from continuity of the second derivative: one quadratic per point with exactly
//! one positive root, solved by Gauss-Seidel steps.
//!
//! Below the first point the curve continues as an exponential `p_0 e^{(δ - δ_0) d_0 / p_0}` if the first pressure is
//! positive. If it is 0, the first interval is a power law `p_1 θ^m`, and pairs are open below it. Above the last point,
//! where the second derivative is 0, the curve continues as a line; no state may lie there.
//!
//! Source: Gregory and Delbourgo 1982; Delbourgo and Gregory 1983, IMA Journal of Numerical Analysis 3.

use super::law::{LawValue, Smoothness};

/// Largest change of a slope, relative, at which the Gauss-Seidel steps end, and most of these steps.
const SLOPE_CHANGE: f64 = 4.0 * f64::EPSILON;
const MOST_STEPS: usize = 10_000;

/// Pressure against closure: see the module.
#[derive(Clone, Debug, PartialEq)]
pub struct PressureTable {
    closure_m: Vec<f64>,
    pressure: Vec<f64>,
    /// Slopes at the points. The first one is not used if the first interval is a power law.
    slope: Vec<f64>,
    /// `m` of the power law in the first interval, if the first pressure is 0.
    toe: Option<f64>,
}

/// Why a table is not a contact law.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TableError {
    /// The two lists differ in length.
    #[error("{closures} closures and {pressures} pressures, expected as many of each")]
    Lengths {
        /// Number of closures.
        closures: usize,
        /// Number of pressures.
        pressures: usize,
    },
    /// Too few points.
    #[error("{found} points, expected at least {limit}")]
    Points {
        /// Number of points.
        found: usize,
        /// Smallest number accepted.
        limit: usize,
    },
    /// A value of a point is outside its range.
    #[error("point {point}: {field} is {value}, expected {limit}")]
    Value {
        /// Index of the point.
        point: usize,
        /// Closure or pressure.
        field: &'static str,
        /// The value.
        value: f64,
        /// The range expected.
        limit: String,
    },
    /// The stiffness of a pair would jump as it closes.
    #[error(
        "the curve leaves 0 like the power {exponent} of the closure, expected more than 1: a pair would close with a jump of \
         its stiffness; a first pressure above 0 or further points near 0 change it"
    )]
    Toe {
        /// Exponent of the closure at 0.
        exponent: f64,
    },
    /// The slopes of the interpolation did not converge.
    #[error("slopes of the interpolation changed by {change:.1e} in the last of {steps} steps, limit {limit:.1e}")]
    Slopes {
        /// Their change in the last step, relative.
        change: f64,
        /// Number of steps.
        steps: usize,
        /// Largest change accepted.
        limit: f64,
    },
}

impl PressureTable {
    /// Interpolates `pressure` (Pa, or N for pairs with a factor of 1) at `closure_m` (m), at least three points, both
    /// strictly ascending, the first pressure at least 0.
    ///
    /// # Errors
    /// [`TableError`].
    pub fn new(closure_m: &[f64], pressure: &[f64]) -> Result<Self, TableError> {
        let points = closure_m.len();
        if points != pressure.len() {
            return Err(TableError::Lengths { closures: points, pressures: pressure.len() });
        }
        if points < 3 {
            return Err(TableError::Points { found: points, limit: 3 });
        }
        for (field, values) in [("closure", closure_m), ("pressure", pressure)] {
            let mut last = None;
            for (point, &value) in values.iter().enumerate() {
                let holds = value.is_finite() && last.is_none_or(|last| value > last);
                let limit = match last {
                    _ if field == "pressure" && point == 0 && value < 0.0 => "at least 0".to_owned(),
                    _ if holds => {
                        last = Some(value);
                        continue;
                    }
                    Some(last) => format!("a finite number above {last}"),
                    None => "a finite number".to_owned(),
                };
                return Err(TableError::Value { point, field, value, limit });
            }
        }
        let step: Vec<f64> = closure_m.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let secant: Vec<f64> = pressure.windows(2).zip(&step).map(|(pair, h)| (pair[1] - pair[0]) / h).collect();
        if let Some(point) = secant.iter().position(|slope| !slope.is_finite() || *slope <= 0.0) {
            let limit = "a finite positive slope to the next point".to_owned();
            return Err(TableError::Value { point, field: "slope", value: secant[point], limit });
        }
        let slope = slopes(&step, &secant, pressure[0])?;
        let toe = (pressure[0] == 0.0).then(|| slope[1] / secant[0]);
        if let Some(exponent) = toe.filter(|exponent| *exponent <= 1.0) {
            return Err(TableError::Toe { exponent });
        }
        Ok(Self { closure_m: closure_m.to_vec(), pressure: pressure.to_vec(), slope, toe })
    }

    /// The same pressures at closures that are `factor > 0` times as large.
    ///
    /// # Errors
    /// [`TableError`] if a closure or a slope is then out of range.
    pub fn with_closures_times(&self, factor: f64) -> Result<Self, TableError> {
        let closure_m: Vec<f64> = self.closure_m.iter().map(|closure| factor * closure).collect();
        Self::new(&closure_m, &self.pressure)
    }

    /// The closure of the last point, m.
    pub fn last_closure_m(&self) -> f64 {
        self.closure_m[self.closure_m.len() - 1]
    }

    pub(super) fn opens(&self) -> bool {
        self.toe.is_some()
    }

    /// The points at which pieces meet.
    pub(super) fn breaks(&self) -> &[f64] {
        &self.closure_m
    }

    pub(super) fn smoothness(&self) -> Smoothness {
        match self.toe {
            Some(exponent) if exponent <= 2.0 => Smoothness::TangentKinks,
            Some(_) | None => Smoothness::TwiceDifferentiable,
        }
    }

    pub(super) fn at(&self, delta: f64) -> LawValue {
        let (first, last) = (self.closure_m[0], self.closure_m.len() - 1);
        if delta >= self.closure_m[last] {
            let (start, tangent) = (self.closure_m[last], self.slope[last]);
            return LawValue { pressure: self.pressure[last] + tangent * (delta - start), tangent, curvature: 0.0 };
        }
        if delta <= first {
            if self.toe.is_some() {
                return LawValue::default();
            }
            let rate = self.slope[0] / self.pressure[0];
            let pressure = self.pressure[0] * ((delta - first) * rate).exp();
            return LawValue { pressure, tangent: pressure * rate, curvature: pressure * rate * rate };
        }
        let i = self.closure_m.partition_point(|x| *x <= delta) - 1;
        let h = self.closure_m[i + 1] - self.closure_m[i];
        let (p0, p1) = (self.pressure[i], self.pressure[i + 1]);
        let theta = (delta - self.closure_m[i]) / h;
        if let Some(m) = self.toe.filter(|_| i == 0) {
            return LawValue {
                pressure: p1 * theta.powf(m),
                tangent: m * p1 / h * theta.powf(m - 1.0),
                curvature: m * (m - 1.0) * p1 / (h * h) * theta.powf(m - 2.0),
            };
        }
        let secant = (p1 - p0) / h;
        let (d0, d1, rest) = (self.slope[i], self.slope[i + 1], 1.0 - theta);
        let cross = theta * rest;
        let quotient = secant * (theta * theta + rest * rest) + (d0 + d1) * cross;
        let top = d1 * theta * theta + 2.0 * secant * cross + d0 * rest * rest;
        let top_slope = 2.0 * (d1 * theta + secant * (rest - theta) - d0 * rest);
        let quotient_slope = (d0 + d1 - 2.0 * secant) * (rest - theta);
        let scale = (secant / quotient).powi(2);
        LawValue {
            pressure: p0 + (p1 - p0) * (secant * theta * theta + d0 * cross) / quotient,
            tangent: scale * top,
            curvature: scale * (top_slope - 2.0 * top * quotient_slope / quotient) / h,
        }
    }

    pub(super) fn closure_at(&self, pressure: f64) -> f64 {
        let last = self.pressure.len() - 1;
        if pressure >= self.pressure[last] {
            return self.closure_m[last] + (pressure - self.pressure[last]) / self.slope[last];
        }
        if pressure <= self.pressure[0] {
            return match self.toe {
                Some(_) => self.closure_m[0],
                None => self.closure_m[0] + (pressure / self.pressure[0]).ln() * self.pressure[0] / self.slope[0],
            };
        }
        let i = self.pressure.partition_point(|p| *p <= pressure) - 1;
        let h = self.closure_m[i + 1] - self.closure_m[i];
        let (p0, p1) = (self.pressure[i], self.pressure[i + 1]);
        let share = (pressure - p0) / (p1 - p0);
        let theta = match self.toe.filter(|_| i == 0) {
            Some(m) => share.powf(1.0 / m),
            None => {
                // share · Q = Δ θ² + d_0 θ(1-θ), a quadratic in θ.
                let (secant, d0, d1) = ((p1 - p0) / h, self.slope[i], self.slope[i + 1]);
                let linear = d0 - share * (d0 + d1 - 2.0 * secant);
                let square = secant - linear;
                let root = (linear * linear + 4.0 * square * share * secant).max(0.0).sqrt();
                2.0 * share * secant / (linear + root)
            }
        };
        self.closure_m[i] + h * theta
    }
}

/// Slopes at the points for a continuous second derivative. Each equation is `α d² + β d = γ` with positive `α`, `γ`.
fn slopes(step: &[f64], secant: &[f64], first_pressure: f64) -> Result<Vec<f64>, TableError> {
    let last = step.len();
    let mut slope: Vec<f64> = (0..=last)
        .map(|i| match i {
            0 => secant[0],
            i if i == last => secant[last - 1],
            i => (secant[i - 1] * secant[i]).sqrt(),
        })
        .collect();
    let toe = first_pressure == 0.0;
    let mut change = f64::INFINITY;
    for _ in 0..MOST_STEPS {
        change = 0.0;
        for i in usize::from(toe)..=last {
            // The second derivative on the right is 2 (Δ + d - d (d + d_next) / Δ) / h; on the left its negative.
            let (mut square, mut linear, mut constant) = (0.0, 0.0, 0.0);
            if i == 0 {
                // The exponential's is d² / p.
                square += 1.0 / first_pressure;
            } else if i == 1 && toe {
                // The power law's is d (d - Δ) / (h Δ).
                square += 1.0 / (step[0] * secant[0]);
                linear -= 1.0 / step[0];
            } else {
                let (h, delta) = (step[i - 1], secant[i - 1]);
                square += 2.0 / (h * delta);
                linear += 2.0 / h * (slope[i - 1] / delta - 1.0);
                constant += 2.0 * delta / h;
            }
            if i < last {
                let (h, delta) = (step[i], secant[i]);
                square += 2.0 / (h * delta);
                linear += 2.0 / h * (slope[i + 1] / delta - 1.0);
                constant += 2.0 * delta / h;
            }
            let root = (linear * linear + 4.0 * square * constant).sqrt();
            let next = if linear > 0.0 { 2.0 * constant / (linear + root) } else { (root - linear) / (2.0 * square) };
            change = f64::max(change, (next / slope[i] - 1.0).abs());
            slope[i] = next;
        }
        if change <= SLOPE_CHANGE {
            return Ok(slope);
        }
    }
    // Rounding may keep the last digits moving; more than that is a failure.
    let limit = 1e-12;
    if change <= limit { Ok(slope) } else { Err(TableError::Slopes { change, steps: MOST_STEPS, limit }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tables() -> Vec<PressureTable> {
        let x = [-1.0, 0.0, 0.5, 2.0, 2.1, 5.0];
        let y = [0.0, 0.1, 0.5, 4.0, 4.001, 30.0];
        let toe = PressureTable::new(&x, &y).unwrap();
        let mut positive = y;
        positive[0] = 0.02;
        vec![toe, PressureTable::new(&x, &positive).unwrap()]
    }

    #[test]
    fn the_curve_meets_its_points_and_its_derivatives_are_continuous() {
        for table in tables() {
            for (i, (&x, &p)) in table.closure_m.iter().zip(&table.pressure).enumerate() {
                let [left, right] = [x - 1e-12, x + 1e-12].map(|x| table.at(x));
                assert!((table.at(x).pressure - p).abs() < 1e-14 * 30.0);
                let sharp = i == 0 && table.toe.is_some();
                let scale = table.slope.iter().fold(0.0, |a: f64, b| a.max(*b));
                assert!((left.tangent - right.tangent).abs() < 1e-8 * scale, "{i}: {left:?} {right:?}");
                let curvature = left.curvature.abs().max(right.curvature.abs()).max(scale);
                assert!(
                    sharp || (left.curvature - right.curvature).abs() < 1e-8 * curvature,
                    "{i}: {left:?} {right:?}"
                );
            }
            let mut last = 0.0;
            for k in -3000..6000 {
                let found = table.at(f64::from(k) * 1e-3);
                assert!(found.pressure >= last && found.tangent >= 0.0);
                last = found.pressure;
            }
        }
    }

    /// Data of an exponential are interpolated to fourth order in the spacing, except near the last point, whose second
    /// derivative is set to 0.
    #[test]
    fn an_exponential_is_approximated_to_high_order() {
        let error = |n: usize| {
            let x: Vec<f64> = (0..=n).map(|k| 4.0 * k as f64 / n as f64).collect();
            let y: Vec<f64> = x.iter().map(|x| x.exp()).collect();
            let table = PressureTable::new(&x, &y).unwrap();
            (0..200).map(|k| 0.01 * f64::from(k)).map(|x| (table.at(x).pressure - x.exp()).abs()).fold(0.0, f64::max)
        };
        let [coarse, fine] = [20, 40].map(error);
        assert!(fine < 1e-5 && coarse / fine > 10.0, "{coarse} {fine}");
    }

    #[test]
    fn what_is_no_curve_is_refused() {
        let refused = |x: &[f64], y: &[f64]| PressureTable::new(x, y).unwrap_err();
        assert!(matches!(refused(&[0.0, 1.0], &[0.0]), TableError::Lengths { .. }));
        assert!(matches!(refused(&[0.0, 1.0], &[0.0, 1.0]), TableError::Points { found: 2, .. }));
        assert!(matches!(refused(&[0.0, 1.0, 1.0], &[0.0, 1.0, 2.0]), TableError::Value { point: 2, .. }));
        assert!(matches!(refused(&[0.0, 1.0, 2.0], &[0.0, 2.0, 1.0]), TableError::Value { point: 2, .. }));
        assert!(matches!(refused(&[0.0, 1.0, f64::NAN], &[0.0, 2.0, 3.0]), TableError::Value { point: 2, .. }));
        assert!(matches!(refused(&[0.0, 1.0, 2.0], &[-1.0, 2.0, 3.0]), TableError::Value { point: 0, .. }));
        assert!(matches!(refused(&[0.0, 1.0, 2.0], &[0.0, 10.0, 11.0]), TableError::Toe { .. }));
    }
}
