//! The axis of lateral friction: its damping coefficient `d = μ N / |ω|`.
//!
//! If the speed matters to lateral friction only, the roots are functions of friction coefficient, load and `d`. At low
//! speeds under high loads `d` moves them most: over the speed, boxes would have to be small along all three axes there,
//! and over `d` along one.
//!
//! Conditions do not fill a box of these coordinates, because `d` is between `μ N / v_max` and `μ N / v_min`. Boxes that
//! hold no conditions are left out, and the others are trimmed to those they hold. Points of a trimmed box may still be
//! beyond the speeds, some at `μ = 0` with `d > 0`, which no speed gives. The roots are analytic there, and a model that has
//! `d` in place of the speed is solved.

use std::sync::Arc;

use super::MAX_AXES;
use crate::physics::law::{CustomLaw, Law};
use crate::physics::model::Model;
use crate::physics::operating_point::OperatingPoint;

/// Disc speed that stands for `d = 0`, rad/s: the contact slides there, and at steps of differences below it.
const OFFSET: f64 = 1.0;
/// Step of differences along `d`. Laws are linear and the totals quadratic in it, so central differences are exact.
pub const STEP: f64 = 0.5;

/// Moves `p`, a point of a model [`in_place_of_speed`], to `d`.
pub fn place(p: &mut OperatingPoint, d: f64) {
    p.disc_speed_rad_s = (OFFSET + d).copysign(p.disc_speed_rad_s);
}

/// The same model with `d` in place of the speed; see [`place`]. `None` if the speed matters to anything but lateral
/// friction, or the load to nothing else.
pub fn in_place_of_speed(model: &Model) -> Option<Model> {
    let on_load_and_speed = |law: &Law| law.depends_on_load_and_speed(model.contact_law());
    let is_lateral = |law: &Law| matches!(law, Law::LateralFriction);
    let laws = || model.stiffness.iter().chain(&model.damping).map(|known| &known.term.law);
    let by_load = laws().any(|law| !is_lateral(law) && on_load_and_speed(law).0);
    let by_speed = laws().any(|law| !is_lateral(law) && on_load_and_speed(law).1);
    if model.statics().is_some() || !laws().any(is_lateral) || by_speed || !by_load {
        return None;
    }
    let mut model = model.clone();
    for known in model.damping.iter_mut().filter(|known| is_lateral(&known.term.law)) {
        known.term.law = Law::Custom(CustomLaw {
            text: "μ N / |ω|".to_owned(),
            evaluate: Arc::new(|p| p.disc_speed_rad_s.abs() - OFFSET),
            depends_on_load: false,
            depends_on_speed: true,
            depends_on_friction: false,
        });
    }
    Some(model.finished())
}

/// Lowest and highest disc speed of a chart, rad/s, without their sign: `d` lies between `μ N / high` and `μ N / low`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Speeds {
    pub low: f64,
    pub high: f64,
}

/// A corner of a box: friction coefficient, logarithm of the load, and `d`.
type Corner = [f64; MAX_AXES];

impl Speeds {
    /// Whether it holds the speed of `p`.
    pub fn hold(&self, p: &OperatingPoint) -> bool {
        (self.low..=self.high).contains(&p.disc_speed_rad_s.abs())
    }

    /// Range of `d` of all conditions with friction coefficients and loads in a box.
    pub fn range(&self, low: &OperatingPoint, high: &OperatingPoint) -> [f64; 2] {
        let force = |p: &OperatingPoint| p.friction_coefficient * p.normal_load_n;
        [force(low) / self.high, force(high) / self.low]
    }

    /// The smallest box that holds the conditions of a box; `None` if it holds none. Friction coefficients must not be
    /// negative.
    pub fn trimmed(&self, low: &Corner, high: &Corner) -> Option<(Corner, Corner)> {
        let [mut mu, mut load, mut d] = [0, 1, 2].map(|k| [low[k], high[k]]);
        load = load.map(f64::exp);
        let full = load;
        // `v_min d ≤ μ N ≤ v_max d` bounds each of the three by the others. A second round applies the bounds of the first.
        for _ in 0..2 {
            d[1] = d[1].min(mu[1] * load[1] / self.low);
            mu[0] = mu[0].max(self.low * d[0] / load[1]);
            load[0] = load[0].max(self.low * d[0] / mu[1]);
            d[0] = d[0].max(mu[0] * load[0] / self.high);
            mu[1] = mu[1].min(self.high * d[1] / load[0]);
            load[1] = load[1].min(self.high * d[1] / mu[0]);
        }
        // An end that has not moved keeps its bits.
        let end = |k: usize, at: f64| if load[k] == full[k] { at } else { load[k].ln() };
        let ends = [end(0, low[1]), end(1, high[1])];
        let is_box = [mu, ends, d].iter().all(|[low, high]| low < high);
        is_box.then_some(([mu[0], ends[0], d[0]], [mu[1], ends[1], d[1]]))
    }

    /// Volume of the conditions in a box: in friction coefficient, load and speed.
    pub fn volume(&self, low: &Corner, high: &Corner) -> f64 {
        let (loads, area) = ([low[1].exp(), high[1].exp()], high[0] - low[0]);
        // `∫∫ min(μ N / d, v) dμ dN`
        let slower = |d: f64, v: f64| {
            if d <= 0.0 {
                return v * area * (loads[1] - loads[0]);
            }
            let upto = |mu: f64| capped_product(mu, loads[1], v * d) - capped_product(mu, loads[0], v * d);
            (upto(high[0]) - upto(low[0])) / d
        };
        let beyond = |d: f64| slower(d, self.high) - slower(d, self.low);
        (beyond(low[2]) - beyond(high[2])).max(0.0)
    }
}

/// `∫∫ min(x y, c) dx dy` over `0 ≤ x ≤ a`, `0 ≤ y ≤ b`.
fn capped_product(a: f64, b: f64, c: f64) -> f64 {
    let all = a * b;
    if all <= c { 0.25 * all * all } else { c * all - 0.75 * c * c - 0.5 * c * c * (all / c).ln() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::law::ContactLaw;
    use crate::physics::solver::Solver;
    use crate::physics::spectrum::Vectors;
    use crate::proof::synthetic::{Synthetic, Uniform, rig};

    const SPEEDS: Speeds = Speeds { low: 1.0, high: 60.0 };

    /// Boxes in `μ`, `ln N` and `d`: whole, at the lowest speed, at the highest one, inside.
    fn boxes() -> [(Corner, Corner); 4] {
        let load = |newton: f64| newton.ln();
        [
            ([0.0, load(50.0), 0.0], [1.0, load(2000.0), 2000.0]),
            ([0.2, load(900.0), 500.0], [0.9, load(2000.0), 1500.0]),
            ([0.3, load(300.0), 0.5], [0.9, load(900.0), 4.0]),
            ([0.5, load(800.0), 40.0], [0.7, load(900.0), 80.0]),
        ]
    }

    /// Conditions uniformly distributed over friction coefficient, load and speed.
    fn conditions(count: usize) -> Vec<OperatingPoint> {
        let mut uniform = Uniform::new(4);
        let mut between = |low: f64, high: f64| low + 0.5 * (uniform.draw() + 1.0) * (high - low);
        let mut one = || OperatingPoint {
            friction_coefficient: between(0.0, 1.0),
            normal_load_n: between(50.0, 2000.0),
            disc_speed_rad_s: between(SPEEDS.low, SPEEDS.high),
        };
        (0..count).map(|_| one()).collect()
    }

    fn coordinates(p: &OperatingPoint) -> Corner {
        let d = p.friction_coefficient * p.normal_load_n / p.disc_speed_rad_s;
        [p.friction_coefficient, p.normal_load_n.ln(), d]
    }

    fn holds((low, high): &(Corner, Corner), x: &Corner) -> bool {
        (0..3).all(|k| (low[k]..=high[k]).contains(&x[k]))
    }

    /// The share of random conditions in a box is its share of the volume, within four standard deviations.
    #[test]
    fn the_volume_is_the_share_of_conditions() {
        const COUNT: usize = 200_000;
        let all: Vec<Corner> = conditions(COUNT).iter().map(coordinates).collect();
        let whole = 1.0 * (2000.0 - 50.0) * (60.0 - 1.0);
        for (low, high) in boxes() {
            let share = SPEEDS.volume(&low, &high) / whole;
            let counted = all.iter().filter(|x| holds(&(low, high), x)).count() as f64 / COUNT as f64;
            let deviation = (share * (1.0 - share).max(0.0) / COUNT as f64).sqrt();
            assert!((share - counted).abs() <= 4.0 * deviation + 1e-12, "{low:?} {high:?}: {share} is not {counted}");
            assert!(share > 1e-4, "enough conditions to count: {share}");
        }
    }

    /// A trimmed box holds all conditions of the box, and some on each of its faces. On a face, which is connected, `μ N - v_min d`
    /// and `v_max d - μ N` are both at least 0 somewhere if each of them is, because where the second is negative the first is
    /// positive; and both are largest at corners.
    #[test]
    fn trimmed_boxes_hold_all_conditions_and_no_more() {
        for (low, high) in boxes() {
            let (near, far) = SPEEDS.trimmed(&low, &high).expect("it holds conditions");
            let mut uniform = Uniform::new(9);
            for _ in 0..50_000 {
                let x: Corner = std::array::from_fn(|k| low[k] + 0.5 * (uniform.draw() + 1.0) * (high[k] - low[k]));
                let speed = x[0] * x[1].exp() / x[2];
                let is_condition = (SPEEDS.low..=SPEEDS.high).contains(&speed);
                assert!(!is_condition || holds(&(near, far), &x), "{x:?} is not in {near:?} {far:?}");
            }
            for (k, face) in (0..3).flat_map(|k| [(k, near[k]), (k, far[k])]) {
                let corner = |bits: usize| -> Corner {
                    std::array::from_fn(|j| if j == k { face } else { [near[j], far[j]][bits >> j & 1] })
                };
                let forces = || (0..8).map(corner).map(|x| (x[0] * x[1].exp(), x[2]));
                let rounding = 1e-12 * 2000.0;
                assert!(forces().any(|(force, d)| force - SPEEDS.low * d >= -rounding), "axis {k}, {face}");
                assert!(forces().any(|(force, d)| SPEEDS.high * d - force >= -rounding), "axis {k}, {face}");
            }
        }
    }

    #[test]
    fn boxes_beyond_the_speeds_hold_no_conditions() {
        let load = |newton: f64| newton.ln();
        // `d` above `μ N / v_min = 100`, and below `μ N / v_max = 25`.
        for (low, high) in [
            ([0.0, load(50.0), 101.0], [1.0, load(100.0), 200.0]),
            ([0.8, load(1875.0), 1.0], [1.0, load(2000.0), 24.9]),
        ] {
            assert_eq!(SPEEDS.trimmed(&low, &high), None);
            assert!(SPEEDS.volume(&low, &high) <= 1e-9);
        }
    }

    /// The model with `d` in place of the speed has the roots of the model, whichever way the disc turns.
    #[test]
    fn the_model_in_place_of_speed_has_the_same_roots() {
        let contact_law =
            ContactLaw { exponent: 1.0 / 3.0, slope_s_per_m: -0.02, lateral_damping: true, ..Default::default() };
        let model = rig(&Synthetic { modes: 8, pairs: 6, damping_ratio: 5e-3, contact_law, seed: 1 }).unwrap();
        let other = in_place_of_speed(&model).expect("the speed matters to lateral friction only");
        let mut solver = Solver::new(8);
        for mut p in conditions(5) {
            for sign in [1.0, -1.0] {
                p.disc_speed_rad_s = sign * p.disc_speed_rad_s.abs();
                let mut moved = p;
                place(&mut moved, coordinates(&p)[2].abs());
                let [one, two] = [(&model, p), (&other, moved)]
                    .map(|(model, p)| solver.solve(model, &p, Vectors::Both).expect("it solves"));
                for (a, b) in one.roots.iter().zip(&two.roots) {
                    assert!((a.lambda - b.lambda).norm() <= a.error.omega + b.error.omega, "{a:?} is not {b:?}");
                }
            }
        }
        // Without a law of its own of the load, friction coefficient and load over speed are enough.
        let contact_law = ContactLaw { lateral_damping: true, ..Default::default() };
        let model = rig(&Synthetic { modes: 8, pairs: 6, damping_ratio: 5e-3, contact_law, seed: 1 }).unwrap();
        assert!(in_place_of_speed(&model).is_none());
    }
}
