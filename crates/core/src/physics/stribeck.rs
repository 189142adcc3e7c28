//! Friction that falls with the sliding speed: the Stribeck law, and its slope at the radii of many contact pairs.
//!
//! Pair `k` slides with `v_k = |Ω| r_k`, so the slope `μ'(|Ω| r_k)` is a different function of the disc speed for every
//! radius, and a model would need a matrix for every pair. The slope is smooth in the radius: polynomials through a few
//! nodes `ρ_j` represent it for all pairs and all disc speeds,
//!
//! ```text
//! μ'(|Ω| r_k) = Σ_j ℓ_j(r_k) μ'(|Ω| ρ_j)
//! ```
//!
//! with the Lagrange polynomials `ℓ_j` of Chebyshev points between the smallest and the largest radius. A model then has
//! one matrix for every node.

use super::model_error::ModelError;
use crate::chebyshev;

/// Most radii at which the slope is evaluated.
const MOST_NODES: usize = 48;
/// Largest error of the slope between the nodes, relative to the steepest slope of the law.
const TOLERANCE: f64 = 1e-13;
/// Number of radii, and number of disc speeds, at which the error is evaluated.
const CHECKED_RADII: usize = 65;
const CHECKED_SPEEDS: usize = 300;
/// `(v/v_s)^δ` beyond which the slope is less than [`TOLERANCE`] of the steepest one at any exponent.
const VANISHED: f64 = 40.0;

/// Friction that falls with the sliding speed `v`: `μ(v) = μ_k + (μ_s - μ_k) e^{-(v/v_s)^δ}`.
///
/// The measured friction coefficient is the friction at the present speed, so only the slope of the law is used.
///
/// # Source
/// D. P. Hess and A. Soom, Journal of Tribology 112 (1990) 147, for `δ = 1`; L. C. Bo and D. Pavelescu, Wear 82 (1982)
/// 277, for any exponent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stribeck {
    /// `μ_s - μ_k`: the fall of the friction coefficient from rest to fast sliding; negative if it rises.
    pub drop: f64,
    /// `v_s`, m/s, above 0.
    pub speed_m_s: f64,
    /// `δ`, at least 1.
    pub exponent: f64,
}

impl Stribeck {
    /// `μ'(v) = -(μ_s - μ_k) δ / v_s · x^(δ-1) e^{-x^δ}` with `x = v / v_s`, s/m, for `v > 0`.
    pub fn slope(&self, v_m_s: f64) -> f64 {
        -self.drop * self.exponent / self.speed_m_s * shape(v_m_s / self.speed_m_s, self.exponent)
    }

    /// `μ''(v) = -(μ_s - μ_k) δ / v_s² · x^(δ-2) (δ - 1 - δ x^δ) e^{-x^δ}`, s²/m², for `v > 0`.
    pub fn slope_per_speed(&self, v_m_s: f64) -> f64 {
        let (x, exponent) = (v_m_s / self.speed_m_s, self.exponent);
        let power = x.powf(exponent);
        let relative = (exponent - 1.0 - exponent * power) / x;
        let steepness = shape(x, exponent);
        if steepness == 0.0 {
            return 0.0;
        }
        -self.drop * exponent / (self.speed_m_s * self.speed_m_s) * steepness * relative
    }

    /// Nodes that represent the slope at the radii of all pairs, each with its shares `ℓ_j(r_k)` in them. As many nodes
    /// as there are different radii represent it exactly.
    ///
    /// # Errors
    /// [`ModelError::StribeckRadii`] if neither the different radii nor Chebyshev points are few enough.
    pub(super) fn nodes(&self, radius_m: &[f64]) -> Result<Vec<Node>, ModelError> {
        let mut different = radius_m.to_vec();
        different.sort_by(f64::total_cmp);
        different.dedup();
        let (Some(&low), Some(&high)) = (different.first(), different.last()) else { return Ok(vec![]) };
        let most = MOST_NODES.min(different.len());
        let mut chosen = (1..most).map(|count| between(low, high, count));
        let nodes = match chosen.find(|nodes| self.error(nodes, low, high) <= TOLERANCE) {
            Some(nodes) => nodes,
            None if different.len() <= MOST_NODES => different,
            None => {
                let (found, limit) = (different.len(), MOST_NODES);
                return Err(ModelError::StribeckRadii { found, low_m: low, high_m: high, limit });
            }
        };
        let weights = barycentric(&nodes);
        let of_pairs: Vec<Vec<f64>> = radius_m.iter().map(|&r| cardinals(&nodes, &weights, r)).collect();
        let node = |(j, &radius_m): (usize, &f64)| Node { radius_m, shares: of_pairs.iter().map(|s| s[j]).collect() };
        Ok(nodes.iter().enumerate().map(node).collect())
    }

    /// Largest error of the interpolation over `nodes` between two radii, over all disc speeds, relative to the steepest
    /// slope of the law.
    fn error(&self, nodes: &[f64], low: f64, high: f64) -> f64 {
        let weights = barycentric(nodes);
        let radii: Vec<f64> =
            (0..CHECKED_RADII).map(|k| low + (high - low) * k as f64 / (CHECKED_RADII - 1) as f64).collect();
        let shares: Vec<Vec<f64>> = radii.iter().map(|&r| cardinals(nodes, &weights, r)).collect();
        // `x = v/v_s` at the largest radius: from nearly 0 to where the slope has vanished at the smallest one.
        let (from, to) = (1e-3, VANISHED.powf(self.exponent.recip()) * high / low);
        let mut largest = 0.0f64;
        for k in 0..CHECKED_SPEEDS {
            let per_radius = from * (to / from).powf(k as f64 / (CHECKED_SPEEDS - 1) as f64) / high;
            let at_nodes: Vec<f64> = nodes.iter().map(|r| shape(per_radius * r, self.exponent)).collect();
            for (r, shares) in radii.iter().zip(&shares) {
                let interpolated: f64 = shares.iter().zip(&at_nodes).map(|(share, value)| share * value).sum();
                largest = largest.max((interpolated - shape(per_radius * r, self.exponent)).abs());
            }
        }
        largest / steepest(self.exponent)
    }
}

/// A radius at which the slope is evaluated, and its share in the slope of every pair.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Node {
    pub radius_m: f64,
    pub shares: Vec<f64>,
}

/// `x^(δ-1) e^{-x^δ}`.
fn shape(x: f64, exponent: f64) -> f64 {
    match (-x.powf(exponent)).exp() {
        0.0 => 0.0,
        decay => x.powf(exponent - 1.0) * decay,
    }
}

/// Largest value of [`shape`], at `x^δ = (δ - 1)/δ`.
fn steepest(exponent: f64) -> f64 {
    shape(((exponent - 1.0) / exponent).powf(exponent.recip()), exponent)
}

/// Chebyshev points between `low` and `high`.
fn between(low: f64, high: f64, count: usize) -> Vec<f64> {
    chebyshev::nodes(count).iter().map(|x| 0.5 * (low + high) + 0.5 * (high - low) * x).collect()
}

/// Barycentric weights `1 / Π (x_j - x_i)` of distinct points, scaled so that they neither overflow nor vanish.
fn barycentric(points: &[f64]) -> Vec<f64> {
    let span = points.iter().fold(0.0f64, |span, x| span.max((x - points[0]).abs()));
    let weight = |(j, x): (usize, &f64)| {
        let others = points.iter().enumerate().filter(|&(i, _)| i != j);
        others.map(|(_, other)| 0.5 * span / (x - other)).product()
    };
    points.iter().enumerate().map(weight).collect()
}

/// Values of the Lagrange polynomials of `points` at `x`.
fn cardinals(points: &[f64], weights: &[f64], x: f64) -> Vec<f64> {
    if let Some(at) = points.iter().position(|point| *point == x) {
        return (0..points.len()).map(|j| f64::from(u8::from(j == at))).collect();
    }
    let parts: Vec<f64> = points.iter().zip(weights).map(|(point, weight)| weight / (x - point)).collect();
    let sum: f64 = parts.iter().sum();
    parts.iter().map(|part| part / sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAW: Stribeck = Stribeck { drop: 0.1, speed_m_s: 0.5, exponent: 2.0 };

    /// The slope and its derivative are those of `μ(v)` itself, by central differences. Tolerance: a step of 1e-4 v_s
    /// truncates 1e-8 of the third derivative, rounding is 1e-16 / 1e-4 and 1e-12 respectively.
    #[test]
    fn slopes_are_those_of_the_law() {
        for exponent in [1.0, 1.5, 2.0, 4.0] {
            let law = Stribeck { exponent, ..LAW };
            let mu = |v: f64| 0.3 + law.drop * (-(v / law.speed_m_s).powf(exponent)).exp();
            for v in [0.05, 0.3, 0.5, 0.9, 2.0, 20.0] {
                let step = 1e-4 * law.speed_m_s;
                let slope = (mu(v + step) - mu(v - step)) / (2.0 * step);
                assert!((law.slope(v) - slope).abs() < 1e-6, "{exponent} {v}: {} {slope}", law.slope(v));
                let bend = (law.slope(v + step) - law.slope(v - step)) / (2.0 * step);
                let found = law.slope_per_speed(v);
                assert!((found - bend).abs() < 2e-6 * (1.0 + bend.abs()), "{exponent} {v}: {found} {bend}");
            }
            assert_eq!((law.slope(1e300), law.slope_per_speed(1e300)), (0.0, 0.0));
        }
        // By hand: `-2 · 0.1 / 0.5 · e^-1` at `v = v_s`.
        assert!((LAW.slope(0.5) + 0.4 * (-1.0f64).exp()).abs() < 1e-16);
    }

    /// A few nodes represent the slope of several hundred pairs at speeds between those checked.
    #[test]
    fn few_radii_stand_for_many() {
        for (exponent, low, high) in [(2.0, 0.08, 0.12), (2.0, 0.05, 0.15), (1.0, 0.08, 0.12), (1.5, 0.1, 0.1001)] {
            let law = Stribeck { exponent, ..LAW };
            let radius_m: Vec<f64> =
                (0..294).map(|k| low + (high - low) * (f64::from(k) * 0.618_034).fract()).collect();
            let nodes = law.nodes(&radius_m).expect("few suffice");
            assert!(nodes.len() < 40, "{exponent} {low} {high}: {} nodes", nodes.len());
            let steepest = law.drop * exponent / law.speed_m_s * steepest(exponent);
            for speed in (0..500).map(|k| 0.01 * 1.021f64.powi(k)) {
                let at_nodes: Vec<f64> = nodes.iter().map(|node| law.slope(speed * node.radius_m)).collect();
                for (pair, r) in radius_m.iter().enumerate() {
                    let found: f64 = nodes.iter().zip(&at_nodes).map(|(node, slope)| node.shares[pair] * slope).sum();
                    // The tolerance of the nodes, and as much again for speeds between those at which it was checked.
                    let off = (found - law.slope(speed * r)).abs();
                    assert!(off <= 2.0 * TOLERANCE * steepest, "{exponent} {low} {high} {speed}: {off:e}");
                }
            }
            eprintln!("exponent {exponent}, {low} to {high} m: {} nodes", nodes.len());
        }
    }

    /// Few radii are their own nodes; more than the limit over a range that polynomials do not cover are refused.
    #[test]
    fn few_radii_are_exact_and_too_many_are_refused() {
        let nodes = LAW.nodes(&[0.1, 0.2, 0.1]).expect("two radii");
        let expected = [(0.1, vec![1.0, 0.0, 1.0]), (0.2, vec![0.0, 1.0, 0.0])];
        assert_eq!(nodes, expected.map(|(radius_m, shares)| Node { radius_m, shares }));
        let wide: Vec<f64> = (0..100).map(|k| 1e-5 * 1.12f64.powi(k)).collect();
        assert!(matches!(LAW.nodes(&wide), Err(ModelError::StribeckRadii { found: 100, limit: MOST_NODES, .. })));
    }
}
