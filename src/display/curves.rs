//! Curves of a stability map: frequency and growth rate of every mode in the band over the friction coefficient.
//!
//! Between the nodes of the map, `λ²` is interpolated by cubic polynomials through values and first derivatives. Where
//! two undamped modes merge, `λ²` is not smooth, but the mean and the discriminant of the pair are:
//!
//! ```text
//! s = (λ₁² + λ₂²)/2,   d = ((λ₁² - λ₂²)/2)²,   λ² = s ± √d
//! ```

use std::collections::{BTreeMap, BTreeSet};

use faer::c64;
use serde::Serialize;

use crate::physics::StabilityMap;
use crate::physics::stability_map::Node as MapNode;

/// The curves of one stability map.
#[derive(Clone, Debug, Serialize)]
pub struct Curves {
    /// Load and speed of the map.
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    /// Friction coefficients, ascending.
    pub mu: Vec<f64>,
    /// One curve for each mode that is in the band at some friction coefficient.
    pub modes: Vec<Curve>,
    pub windows: Vec<WindowShown>,
    pub critical_friction: Option<f64>,
    /// Windows narrower than this may have been missed.
    pub resolution: f64,
    pub complete: bool,
}

/// A mode along [`Curves::mu`]; `null` where it does not exist.
#[derive(Clone, Debug, Serialize)]
pub struct Curve {
    pub id: u32,
    pub frequency_hz: Vec<Option<f32>>,
    pub growth_rate_per_s: Vec<Option<f32>>,
}

/// A window of instability.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WindowShown {
    pub mu_from: f64,
    /// `null` if the window is open at the end of the range.
    pub mu_to: Option<f64>,
    pub frequency_hz: f64,
    pub kind: &'static str,
    pub mode_ids: Vec<u32>,
}

/// Number of intervals drawn at most; of a finer map, nodes are skipped.
const MOST_INTERVALS: usize = 700;
/// Number of points over the range of friction coefficients, at least.
const POINTS: f64 = 300.0;
/// Number of points in an interval in which modes merge, denser towards the merging point.
const AT_MERGING: usize = 24;

impl Curves {
    /// The curves of `map` for modes up to `band_max_hz`.
    pub fn new(map: &StabilityMap, band_max_hz: Option<f64>) -> Self {
        let stride = map.nodes.len().div_ceil(MOST_INTERVALS).max(1);
        let last = map.nodes.len().saturating_sub(1);
        let nodes: Vec<&MapNode> =
            (0..map.nodes.len()).filter(|k| k % stride == 0 || *k == last).map(|k| &map.nodes[k]).collect();
        let in_band = |hz: f64| band_max_hz.is_none_or(|max_hz| hz <= max_hz);
        let ids: BTreeSet<u32> = nodes
            .iter()
            .flat_map(|node| node.spectrum.roots.iter().zip(&node.ids))
            .filter(|(root, _)| in_band(root.frequency_hz()))
            .filter_map(|(_, id)| *id)
            .collect();
        let range = nodes.first().zip(nodes.last()).map_or(0.0, |(first, last)| last.mu() - first.mu());
        // The beginning of instability matters most: at least 40 points up to there.
        let critical = map.critical_friction().filter(|&mu| mu > 0.0).unwrap_or(range);
        let spacing = (range / POINTS).min(critical / 40.0).max(range / 4000.0);

        let mut mu = vec![];
        let mut squares: BTreeMap<u32, Vec<Option<c64>>> = ids.iter().map(|&id| (id, vec![])).collect();
        for pair in nodes.windows(2) {
            let interval = Interval::new(pair[0], pair[1], &ids);
            for at in interval.points(spacing) {
                mu.push(at);
                for (id, curve) in &mut squares {
                    curve.push(interval.square(*id, at));
                }
            }
        }
        if let Some(last) = nodes.last() {
            mu.push(last.mu());
            for (id, curve) in &mut squares {
                curve.push(last.find(*id).map(|k| last.spectrum.roots[k].square));
            }
        }
        let modes = squares
            .into_iter()
            .map(|(id, squares)| {
                let lambda: Vec<Option<c64>> = squares.into_iter().map(|square| square.map(root)).collect();
                let part = |of: &dyn Fn(c64) -> f64| lambda.iter().map(|l| l.map(|l| of(l) as f32)).collect();
                Curve {
                    id,
                    frequency_hz: part(&|lambda| lambda.im / std::f64::consts::TAU),
                    growth_rate_per_s: part(&|lambda| lambda.re),
                }
            })
            .collect();
        Self {
            normal_load_n: map.point.normal_load_n,
            disc_speed_rad_s: map.point.disc_speed_rad_s,
            mu,
            modes,
            windows: map
                .windows
                .iter()
                .map(|window| WindowShown {
                    mu_from: window.mu_from,
                    mu_to: window.mu_to,
                    frequency_hz: window.frequency_hz,
                    kind: window.kind.name(),
                    mode_ids: window.mode_ids.clone(),
                })
                .collect(),
            critical_friction: map.critical_friction(),
            resolution: map.resolution,
            complete: map.complete,
        }
    }
}

/// The root `λ` of `λ²` with `ω ≥ 0`, and with `σ ≥ 0` if `ω = 0`.
pub(super) fn root(square: c64) -> c64 {
    let root = square.sqrt();
    if root.im < 0.0 || (root.im == 0.0 && root.re < 0.0) { -root } else { root }
}

/// Two neighbouring nodes and the cubics between them.
struct Interval<'a> {
    left: &'a MapNode,
    right: &'a MapNode,
    merging: Vec<Merging>,
}

/// A pair of undamped modes that merges or separates within an interval.
struct Merging {
    ids: (u32, u32),
    /// `s` and `d` at both ends, with their derivatives.
    mean: [(c64, c64); 2],
    discriminant: [(f64, f64); 2],
    /// Sign of the first mode's distance from the mean: that of `√d` where the pair is separate, that of `i√-d` where
    /// it is merged.
    sign: (f64, f64),
}

impl<'a> Interval<'a> {
    fn new(left: &'a MapNode, right: &'a MapNode, ids: &BTreeSet<u32>) -> Self {
        let mut interval = Self { left, right, merging: vec![] };
        if left.spectrum.undamped && right.spectrum.undamped {
            let all: Vec<u32> = ids.iter().copied().collect();
            for (k, &first) in all.iter().enumerate() {
                let partner = |node| partner(node, first);
                let second = match (partner(left), partner(right)) {
                    (None, Some(second)) | (Some(second), None) => second,
                    _ => continue,
                };
                if all[..k].contains(&second) {
                    continue;
                }
                interval.merging.extend(interval.merging_of(first, second));
            }
        }
        interval
    }

    fn merging_of(&self, first: u32, second: u32) -> Option<Merging> {
        let [left, right] = [self.left, self.right].map(|node| {
            let (a, b) = (node.find(first)?, node.find(second)?);
            let (roots, slopes) = (&node.spectrum.roots, &node.spectrum.friction_sensitivity);
            let (half, half_slope) = (0.5 * (roots[a].square - roots[b].square), 0.5 * (slopes[a] - slopes[b]));
            let mean = (0.5 * (roots[a].square + roots[b].square), 0.5 * (slopes[a] + slopes[b]));
            Some((half, mean, ((half * half).re, (2.0 * half * half_slope).re)))
        });
        let (left, right) = (left?, right?);
        let (apart, merged) = if left.2.0 > 0.0 { (left.0, right.0) } else { (right.0, left.0) };
        (left.2.0 * right.2.0 < 0.0).then_some(Merging {
            ids: (first, second),
            mean: [left.1, right.1],
            discriminant: [left.2, right.2],
            sign: (apart.re.signum(), merged.im.signum()),
        })
    }

    fn step(&self) -> f64 {
        self.right.mu() - self.left.mu()
    }

    /// Friction coefficients to draw, measured from the left end, without the right end.
    fn points(&self, spacing: f64) -> Vec<f64> {
        let (from, step) = (self.left.mu(), self.step());
        let count = (step / spacing).ceil().max(1.0) as usize;
        let mut points: Vec<f64> = (0..count).map(|k| from + step * k as f64 / count as f64).collect();
        for merging in &self.merging {
            let at = merging.at(step);
            for k in -(AT_MERGING as i32)..=AT_MERGING as i32 {
                let share = f64::from(k) / AT_MERGING as f64;
                let reach = if k < 0 { at } else { step - at };
                points.push(from + at + share * share.abs() * reach);
            }
        }
        points.retain(|&mu| mu >= from && mu < from + step);
        points.sort_by(f64::total_cmp);
        points.dedup();
        points
    }

    /// `λ²` of a mode at `mu`.
    fn square(&self, id: u32, mu: f64) -> Option<c64> {
        let (at, step) = (mu - self.left.mu(), self.step());
        if let Some(merging) = self.merging.iter().find(|m| m.ids.0 == id || m.ids.1 == id) {
            let side = if merging.ids.0 == id { 1.0 } else { -1.0 };
            return Some(merging.square(at, step, side));
        }
        let end = |node: &MapNode| {
            let k = node.find(id)?;
            Some((node.spectrum.roots[k].square, *node.spectrum.friction_sensitivity.get(k)?))
        };
        match (end(self.left), end(self.right)) {
            (Some(left), Some(right)) => Some(cubic(left, right, step, at)),
            (Some(left), None) if at == 0.0 => Some(left.0),
            _ => None,
        }
    }
}

impl Merging {
    fn discriminant(&self, at: f64, step: f64) -> f64 {
        let [left, right] = self.discriminant.map(|(d, slope)| (c64::from(d), c64::from(slope)));
        cubic(left, right, step, at).re
    }

    /// Where the discriminant vanishes, measured from the left end.
    fn at(&self, step: f64) -> f64 {
        let (mut low, mut high) = (0.0, step);
        let falls = self.discriminant[0].0 > 0.0;
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if (self.discriminant(middle, step) > 0.0) == falls { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    }

    fn square(&self, at: f64, step: f64, side: f64) -> c64 {
        let mean = cubic(self.mean[0], self.mean[1], step, at);
        let d = self.discriminant(at, step);
        // The mean of two real squares or of two conjugate squares is real.
        let mean = c64::from(mean.re);
        if d >= 0.0 {
            mean + c64::from(side * self.sign.0 * d.sqrt())
        } else {
            mean + c64::new(0.0, side * self.sign.1 * (-d).sqrt())
        }
    }
}

/// The identity of the root whose `λ²` is the conjugate of that of `id`, if that is complex.
fn partner(node: &MapNode, id: u32) -> Option<u32> {
    let square = node.spectrum.roots[node.find(id)?].square;
    if square.im == 0.0 {
        return None;
    }
    let near = 1e-9 * square.norm();
    let other = node.spectrum.roots.iter().position(|other| (other.square - square.conj()).norm() <= near)?;
    node.ids[other].filter(|&other| other != id)
}

/// The cubic polynomial with given values and derivatives at 0 and `step`.
fn cubic(left: (c64, c64), right: (c64, c64), step: f64, at: f64) -> c64 {
    let s = at / step;
    let (s2, s3) = (s * s, s * s * s);
    left.0 * (2.0 * s3 - 3.0 * s2 + 1.0)
        + left.1 * (step * (s3 - 2.0 * s2 + s))
        + right.0 * (3.0 * s2 - 2.0 * s3)
        + right.1 * (step * (s3 - s2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::{Solver, Vectors};
    use crate::rig::{EMBEDDED, Rig};
    use crate::session::map_options;

    /// The curves compared with spectra solved at the friction coefficients drawn.
    #[test]
    fn curves_follow_the_modes_between_the_nodes_and_through_mergings() {
        // Rigs whose modes are all in the band.
        for embedded in EMBEDDED.iter().filter(|embedded| embedded.name.starts_with("nine-dof")) {
            let rig = Rig::load(embedded.name).unwrap();
            let name = embedded.name;
            let mut solver = Solver::new(rig.model.dimension());
            let map = StabilityMap::build(&rig.model, &mut solver, &rig.reference, &map_options(&rig)).unwrap();
            let curves = Curves::new(&map, rig.band_max_hz);
            assert!(curves.mu.windows(2).all(|pair| pair[0] < pair[1]));
            assert_eq!(curves.modes.len(), rig.model.dimension());
            assert_eq!(curves.critical_friction, map.critical_friction());
            for (k, &mu) in curves.mu.iter().enumerate() {
                // Between nodes the curves are only for display: the tolerance is a few of 500 pixels, and more where
                // merging modes make the curve vertical.
                let near_merging = curves.windows.iter().any(|window| {
                    [Some(window.mu_from), window.mu_to].into_iter().flatten().any(|end| (end - mu).abs() < 0.02)
                });
                let tolerance = if near_merging { 2e-2 } else { 1e-2 };
                let spectrum = solver.solve(&rig.model, &rig.reference.with_friction(mu), Vectors::Right).unwrap();
                let highest = spectrum.roots.iter().map(|root| root.lambda.norm()).fold(0.0, f64::max);
                for (what, of) in [("frequency", 0), ("growth", 1)] {
                    let mut shown: Vec<f64> = curves
                        .modes
                        .iter()
                        .map(|curve| match of {
                            0 => f64::from(curve.frequency_hz[k].unwrap()) * std::f64::consts::TAU,
                            _ => f64::from(curve.growth_rate_per_s[k].unwrap()),
                        })
                        .collect();
                    let mut solved: Vec<f64> = spectrum
                        .roots
                        .iter()
                        .map(|root| if of == 0 { root.lambda.im } else { root.lambda.re })
                        .collect();
                    shown.sort_by(f64::total_cmp);
                    solved.sort_by(f64::total_cmp);
                    for (shown, solved) in shown.iter().zip(&solved) {
                        let error = (shown - solved).abs() / highest;
                        assert!(error < tolerance, "{name}: {what} at {mu}: {shown}, solved {solved}");
                    }
                }
            }
        }
    }
}
