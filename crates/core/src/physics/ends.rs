//! The ends of the windows of instability at loads and speeds near those of a stability map.
//!
//! An end is a zero of a condition `F(μ, p)`: the discriminant of a pair, a growth rate, or the square of a static
//! root. It therefore moves with load, speed and contact by `dμ/dp = -F_p / F_μ`. At another load and speed, Newton's
//! method started from the extrapolated end converges in two or three solves.

use super::critical::{Window, WindowKind};
use super::law::Parameter;
use super::model::Model;
use super::model_error::ModelError;
use super::operating_point::OperatingPoint;
use super::sensitivity::{of_pair, of_roots};
use super::solver::Solver;
use super::spectrum::{SolveError, Spectrum, Vectors};
use super::stability_map::{MapError, StabilityMap};
use super::steady_contact::{Situation, changed_pairs};
use crate::contact::StateSlope;

/// Largest relative change of load and speed over which ends are extrapolated with an error bound.
pub const REACH: f64 = 0.02;

/// Where roots jump or bend as pairs open, ends are followed over REACH, half of it, and so on down to this change.
const SHORTEST: f64 = REACH / 32.0;
/// Maximum number of Newton steps.
const STEPS: usize = 12;
/// Newton's method stops after a step shorter than this, relative.
const NEAR: f64 = 1e-9;
/// Longest Newton step accepted, in friction coefficient.
const LONGEST: f64 = 0.1;
/// Relative distance from the merging point at which a pair is evaluated. At the merging point both roots have the
/// same vector; near it the discriminant has the same slope, and the difference of the roots has more accurate
/// digits.
const OFFSET: f64 = 1e-10;
/// Error of the closure of a contact pair, relative to the largest closure: the residual of a state is at most 1e-11,
/// and near rounding in most.
const CLOSURE_ERROR: f64 = 1e-12;
/// The conditions other than friction that change while a rig runs; ends are extrapolated in them.
const MOVING: [Parameter; 2] = [Parameter::Load, Parameter::Speed];

/// The condition that is zero at an end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Condition {
    /// The discriminant of a pair.
    Discriminant(u32, u32),
    /// The growth rate of a damped mode.
    Growth(u32),
    /// The square of a root of an undamped model.
    Square(u32),
    /// The static root of a damped model that is nearest to zero.
    Static,
    /// The closure of this contact pair: the pair opens or closes, and the roots jump.
    Jump(usize),
    /// No condition: the end is the edge of the searched range.
    Edge,
}

/// An end of a window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct End {
    condition: Condition,
    /// Friction coefficient.
    pub mu: f64,
    /// Bound of the error of `mu`; NaN if unknown.
    pub error: f64,
    /// Derivatives of `mu` with respect to load (1/N), speed (s/rad), and contact stiffness and contact damping (per
    /// relative change), in the order of [`Parameter::ALL`] from the second on.
    pub slope: [f64; 4],
    /// Second derivatives of `mu` with respect to load and speed.
    curvature: [[f64; 2]; 2],
    /// Largest relative change of load and speed over which it is extrapolated with an error bound: [`REACH`], or less
    /// where roots jump or bend as contact pairs open and close.
    reach: [f64; 2],
}

/// The ends of all windows of a map, at one load and speed.
#[derive(Clone, Debug, PartialEq)]
pub struct Ends {
    /// Load and speed; the friction coefficient is not used.
    pub point: OperatingPoint,
    /// For every window of the map, in the map's order: its lower end and, unless the window is open, its upper end.
    pub windows: Vec<(End, Option<End>)>,
}

/// The end of a window of instability that is nearest to a friction coefficient.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearestEnd {
    /// Index of the window in the map.
    pub window: usize,
    /// Whether this is the lower end of the window.
    pub is_start: bool,
    /// Whether the present friction coefficient lies in any window, this one or another.
    pub inside: bool,
    /// The friction coefficient of the end.
    pub mu: f64,
    /// Distance from the present friction coefficient to the end, negative inside a window.
    pub margin: f64,
    /// Bound of the error of `mu` and `margin`; NaN if unknown.
    pub error: f64,
}

/// A value with a bound of its error; the bound is NaN if unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounded {
    /// The value.
    pub value: f64,
    /// Bound of its error, in the same unit; NaN if unknown.
    pub error: f64,
}

impl End {
    /// Whether the roots jump here, because a contact pair opens or closes.
    pub fn is_jump(&self) -> bool {
        matches!(self.condition, Condition::Jump(_))
    }

    /// The end extrapolated by `moved`, the change of load (N) and speed (rad/s).
    ///
    /// `μ + μ' δ + δᵀ μ'' δ / 2`. The error bound adds the magnitude of the quadratic term; it is NaN unless
    /// `reached`.
    fn at(&self, moved: [f64; 2], reached: bool) -> Bounded {
        let (mut bend, mut size) = (0.0, 0.0);
        for (j, row) in self.curvature.iter().enumerate() {
            for (k, second) in row.iter().enumerate() {
                let term = 0.5 * second * moved[j] * moved[k];
                bend += term;
                size += term.abs();
            }
        }
        let along = self.slope[0] * moved[0] + self.slope[1] * moved[1];
        Bounded { value: self.mu + along + bend, error: if reached { self.error + size } else { f64::NAN } }
    }
}

impl Ends {
    /// The ends of the windows of `map` at its own load and speed.
    ///
    /// # Errors
    /// [`MapError`].
    pub fn of_map(model: &Model, solver: &mut Solver, map: &StabilityMap) -> Result<Self, MapError> {
        let mut search = Search { model, solver, map };
        let mut windows = vec![];
        for window in &map.windows {
            let from = search.first(window, window.mu_from)?;
            let to = window.mu_to.map(|mu| search.first(window, mu)).transpose()?;
            windows.push((from, to));
        }
        Ok(Self { point: map.point, windows })
    }

    /// The ends of the windows of `map`, recomputed by Newton's method at the load and speed of `point`. `None` if
    /// one of them is not found, or may be another one because contact pairs open or close on the way: a new map is needed
    /// then.
    ///
    /// # Errors
    /// [`MapError`].
    pub fn carried(
        model: &Model,
        solver: &mut Solver,
        map: &StabilityMap,
        point: &OperatingPoint,
    ) -> Result<Option<Self>, MapError> {
        let mut search = Search { model, solver, map };
        let mut windows = vec![];
        for ((from, to), (from_there, to_there)) in map.ends.windows.iter().zip(map.ends.at(point)) {
            let Some(from) = search.carry(from, from_there.value, point)? else { return Ok(None) };
            let to = match to.as_ref().zip(to_there) {
                None => None,
                Some((to, there)) => match search.carry(to, there.value, point)? {
                    None => return Ok(None),
                    found => found,
                },
            };
            // Where roots jump or bend, Newton's method may find another zero.
            let kept = |found: &End, there: Bounded| {
                !search.has_breaks() || (found.mu - there.value).abs() <= there.error + found.error
            };
            if !kept(&from, from_there) || to.zip(to_there).is_some_and(|(to, there)| !kept(&to, there)) {
                return Ok(None);
            }
            let left = |end: End| search.within_reach(end, point);
            windows.push((left(from), to.map(left)));
        }
        Ok(Some(Self { point: point.with_friction(0.0), windows }))
    }

    /// The ends extrapolated to the load and speed of `point`, one entry for each window.
    pub fn at(&self, point: &OperatingPoint) -> impl Iterator<Item = (Bounded, Option<Bounded>)> + Clone {
        let (load, speed) = (self.point.normal_load_n, self.point.disc_speed_rad_s);
        let moved = [point.normal_load_n - load, point.disc_speed_rad_s - speed];
        let at = [load, speed];
        self.windows.iter().map(move |(from, to)| {
            // An end that does not depend on a condition is valid for any value of it.
            let reached = |end: &End| {
                let moves = |k: usize| end.slope[k] != 0.0 || end.curvature[k] != [0.0; 2] || end.reach[k] < REACH;
                (0..2).all(|k| !moves(k) || moved[k].abs() <= end.reach[k] * at[k].abs())
            };
            (from.at(moved, reached(from)), to.as_ref().map(|to| to.at(moved, reached(to))))
        })
    }

    /// The end of the union of all windows that is nearest to the friction coefficient of `point`, at its load and
    /// speed; `None` without windows. An end covered by another window does not count, nor does the open side of a
    /// window that extends beyond the searched range.
    pub fn nearest(&self, point: &OperatingPoint) -> Option<NearestEnd> {
        let mu = point.friction_coefficient;
        let windows = self.at(point);
        let upper = |to: Option<Bounded>| to.map_or(f64::INFINITY, |to| to.value);
        let ends = windows.clone().enumerate().flat_map(|(window, (from, to))| {
            let mut others = windows.clone().enumerate().filter(move |&(j, _)| j != window).map(|(_, other)| other);
            let covered_from = others.clone().any(|(a, b)| a.value < from.value && from.value <= upper(b));
            let covered_to = to.is_some_and(|to| others.any(|(a, b)| a.value <= to.value && to.value < upper(b)));
            let start = Some((window, true, from)).filter(|_| !covered_from);
            [start, to.filter(|_| !covered_to).map(|to| (window, false, to))]
        });
        let distance = |end: &(usize, bool, Bounded)| (end.2.value - mu).abs();
        let (window, is_start, end) = ends.flatten().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        let inside = windows.clone().any(|(from, to)| from.value <= mu && mu <= upper(to));
        let distance = (end.value - mu).abs();
        let margin = if inside { -distance } else { distance };
        Some(NearestEnd { window, is_start, inside, mu: end.value, margin, error: end.error })
    }

    /// The end that `nearest` refers to; `None` if it is the edge of the searched range.
    pub fn end(&self, nearest: &NearestEnd) -> Option<&End> {
        let (from, to) = self.windows.get(nearest.window)?;
        let end = if nearest.is_start { Some(from) } else { to.as_ref() };
        end.filter(|end| end.condition != Condition::Edge)
    }

    /// The bits of every number a prediction can depend on.
    pub fn words(&self) -> impl Iterator<Item = u64> {
        self.windows.iter().flat_map(|(from, to)| std::iter::once(from).chain(to)).flat_map(|end| {
            let numbers = [end.mu, end.error].into_iter().chain(end.slope).chain(end.curvature.into_iter().flatten());
            let shortened = end.reach.into_iter().filter(|reach| *reach < REACH);
            numbers.chain(shortened).map(f64::to_bits)
        })
    }
}

/// Value of a condition, its derivatives in the order of [`Parameter::ALL`] and a bound of its error.
struct Value {
    f: f64,
    slope: [f64; 5],
    error: f64,
}

/// Root finding for ends.
struct Search<'a> {
    model: &'a Model,
    solver: &'a mut Solver,
    map: &'a StabilityMap,
}

impl Search<'_> {
    /// Spectrum at the load and speed of `point` and friction coefficient `mu`.
    fn solve(&mut self, point: &OperatingPoint, mu: f64) -> Result<Spectrum, MapError> {
        let solved = self.solver.solve(self.model, &point.with_friction(mu), Vectors::Right);
        solved.map_err(|source| MapError::Solve { mu, source })
    }

    /// The end of `window` at `mu`, where the map found it, with error bound, slopes and curvatures.
    fn first(&mut self, window: &Window, mu: f64) -> Result<End, MapError> {
        let edge = [self.map.nodes.first(), self.map.nodes.last()].iter().flatten().any(|node| node.mu() == mu);
        let condition = if edge { Condition::Edge } else { self.condition(window, mu)? };
        let end = End { condition, mu, error: 0.0, slope: [0.0; 4], curvature: [[0.0; 2]; 2], reach: [REACH; 2] };
        if edge {
            return Ok(end);
        }
        let map = self.map;
        let unknown = End { error: f64::NAN, ..end };
        let near = |found: &End| (found.mu - mu).abs() < 1e-6;
        let mut found = self.carry(&end, mu, &map.point)?.filter(near);
        if found.is_none()
            && let Some(pair) = self.opening(mu)
        {
            let end = End { condition: Condition::Jump(pair), ..end };
            found = self.carry(&end, mu, &map.point)?.filter(near);
        }
        let Some(mut end) = found else { return Ok(unknown) };
        // The value of the map is at least as accurate.
        end.mu = mu;
        let depends: [bool; 2] = self.model.depends_on_load_and_speed().into();
        for k in (0..2).filter(|&k| depends[k]) {
            if self.has_breaks() {
                (end.curvature[k], end.reach[k]) = self.followed(&end, k)?;
            } else {
                let Some((_, curvature)) = self.probe(&end, k, REACH)? else { return Ok(unknown) };
                end.curvature[k] = curvature;
            }
        }
        Ok(end)
    }

    /// Whether roots jump or bend at some load.
    fn has_breaks(&self) -> bool {
        self.model.statics().is_some_and(|statics| !statics.parts().law.breaks().is_empty())
    }

    /// The end where load or speed (`k`) are larger by the share `share`, and its second derivatives with respect to that
    /// condition and both.
    fn probe(&mut self, end: &End, k: usize, share: f64) -> Result<Option<(End, [f64; 2])>, MapError> {
        let mut probe = self.map.point;
        let at = MOVING[k].condition(&mut probe).expect("load and speed are conditions");
        let step = share * *at;
        *at += step;
        let guess = end.mu + end.slope[k] * step;
        let there = self.carry(end, guess, &probe)?;
        Ok(there.map(|there| (there, std::array::from_fn(|j| (there.slope[j] - end.slope[j]) / step))))
    }

    /// Second derivatives of an end with respect to load or speed (`k`) and both, and the largest relative change over which
    /// an extrapolation with them is within its bound on both sides. None is, where a pair opens that near: 0 then.
    fn followed(&mut self, end: &End, k: usize) -> Result<([f64; 2], f64), MapError> {
        let mut share = REACH;
        while share >= SHORTEST {
            let sides = [self.probe(end, k, share)?, self.probe(end, k, -share)?];
            if let [Some((above, curvature)), Some((below, _))] = sides {
                let at = if k == 0 { self.map.point.normal_load_n } else { self.map.point.disc_speed_rad_s };
                let mut bent = *end;
                bent.curvature[k][k] = curvature[k];
                let holds = |there: &End, share: f64| {
                    let moved = std::array::from_fn(|j| if j == k { share * at } else { 0.0 });
                    let expected = bent.at(moved, true);
                    (there.mu - expected.value).abs() <= expected.error + there.error
                };
                if holds(&above, share) && holds(&below, -share) {
                    return Ok((curvature, share));
                }
            }
            share /= 2.0;
        }
        Ok(([0.0; 2], 0.0))
    }

    /// `end`, carried to `point`, with what is left there of the reach that was checked at the map. Without jumps and kinks
    /// it is the same everywhere.
    fn within_reach(&self, mut end: End, point: &OperatingPoint) -> End {
        if self.has_breaks() && end.condition != Condition::Edge {
            let (here, there) = (&self.map.point, point);
            let moved = [
                (there.normal_load_n - here.normal_load_n) / there.normal_load_n,
                (there.disc_speed_rad_s - here.disc_speed_rad_s) / there.disc_speed_rad_s,
            ];
            let depends: [bool; 2] = self.model.depends_on_load_and_speed().into();
            for k in (0..2).filter(|&k| depends[k]) {
                end.reach[k] = (end.reach[k] - moved[k].abs()).max(0.0);
            }
        }
        end
    }

    /// The contact pair that opens or closes at `mu`, at the load and speed of the map.
    fn opening(&self, mu: f64) -> Option<usize> {
        let step = OFFSET * mu.abs().max(1e-3);
        let beside = |mu: f64| self.model.at(&self.map.point.with_friction(mu)).ok()?.state;
        let (below, above) = (beside(mu - step)?, beside(mu + step)?);
        let size = |pair: &usize| below.closure_m[*pair].abs();
        changed_pairs(&below, &above).min_by(|a, b| size(a).total_cmp(&size(b)))
    }

    /// The condition that is zero at the end `mu` of `window`.
    fn condition(&mut self, window: &Window, mu: f64) -> Result<Condition, MapError> {
        Ok(match (window.kind, window.mode_ids.as_slice()) {
            (WindowKind::Coalescence, &[a, b]) => Condition::Discriminant(a, b),
            (WindowKind::ZeroGrowth, &[a]) => Condition::Growth(a),
            (WindowKind::Divergence, &[a]) => {
                let map = self.map;
                let spectrum = self.solve(&map.point, mu)?;
                let ids = map.identify(&spectrum);
                let at = ids.iter().position(|&id| id == Some(a));
                let square = at.map(|k| spectrum.roots[k].square);
                // If the divergence ends by merging with another root on the real axis, that root is closer than
                // zero.
                let partner = square.and_then(|z| {
                    let others = (0..spectrum.roots.len()).filter(|&j| Some(j) != at);
                    let distance = |j: usize| (spectrum.roots[j].square - z).norm();
                    others.min_by(|&i, &j| distance(i).total_cmp(&distance(j))).filter(|&j| distance(j) < z.norm())
                });
                match partner.and_then(|j| ids[j]) {
                    Some(b) => Condition::Discriminant(a, b),
                    None => Condition::Square(a),
                }
            }
            (WindowKind::Coalescence | WindowKind::ZeroGrowth | WindowKind::Divergence, _) => Condition::Static,
        })
    }

    /// The end at the load and speed of `point`, by Newton's method from `mu`; `None` if it does not converge.
    fn carry(&mut self, end: &End, mut mu: f64, point: &OperatingPoint) -> Result<Option<End>, MapError> {
        if end.condition == Condition::Edge {
            return Ok(Some(*end));
        }
        let unit = mu.abs().max(1e-3);
        for _ in 0..STEPS {
            let value = match self.value(end.condition, point, mu)? {
                Some(value) => value,
                None => {
                    // Exactly at the merging point both roots have the same vector; evaluate near it.
                    mu += OFFSET * unit;
                    let Some(value) = self.value(end.condition, point, mu)? else { return Ok(None) };
                    value
                }
            };
            let step = -value.f / value.slope[0];
            if step.is_nan() || step.abs() > LONGEST {
                return Ok(None);
            }
            mu += step;
            // The remaining error is of the order of this step squared.
            if step.abs() <= NEAR * unit {
                let Some(near) = self.value(end.condition, point, mu + OFFSET * unit)? else { return Ok(None) };
                let slope = std::array::from_fn(|k| -near.slope[k + 1] / near.slope[0]);
                let error = value.error / near.slope[0].abs() + 4.0 * f64::EPSILON * unit;
                return Ok(Some(End { mu, error, slope, ..*end }));
            }
        }
        Ok(None)
    }

    /// The condition at `mu`; `None` if a root is not found or its derivatives are not available.
    fn value(&mut self, condition: Condition, point: &OperatingPoint, mu: f64) -> Result<Option<Value>, MapError> {
        if let Condition::Jump(pair) = condition {
            return Ok(self.model.at(&point.with_friction(mu)).ok().and_then(|here| closure(&here, pair)));
        }
        let spectrum = match self.solve(point, mu) {
            // There is no end without a state of steady sliding.
            Err(MapError::Solve { source: SolveError::Model(ModelError::State(_)), .. }) => return Ok(None),
            solved => solved?,
        };
        let ids = self.map.identify(&spectrum);
        let find = |id: u32| ids.iter().position(|&other| other == Some(id));
        let single = |k: usize| {
            let found = of_roots(self.model, &spectrum, &[k]).ok()?;
            found.first().map(|root| (root.slope.map(|slope| slope.re), root.error))
        };
        Ok(match condition {
            Condition::Discriminant(a, b) => find(a).zip(find(b)).and_then(|(i, j)| {
                let pair = of_pair(self.model, &spectrum, i, j).ok()?;
                let slope = pair.discriminant_slope.map(|slope| slope.re);
                Some(Value { f: pair.discriminant.re, slope, error: pair.discriminant_error })
            }),
            Condition::Growth(a) => find(a)
                .and_then(|k| single(k).map(|(slope, error)| Value { f: spectrum.roots[k].lambda.re, slope, error })),
            Condition::Square(a) => find(a)
                .and_then(|k| single(k).map(|(slope, error)| Value { f: spectrum.roots[k].square.re, slope, error })),
            Condition::Static => {
                let size = |k: &usize| spectrum.roots[*k].lambda.norm();
                let nearest = (spectrum.mode_count..spectrum.roots.len()).min_by(|a, b| size(a).total_cmp(&size(b)));
                nearest.and_then(|k| {
                    single(k).map(|(slope, error)| Value { f: spectrum.roots[k].lambda.re, slope, error })
                })
            }
            Condition::Jump(_) | Condition::Edge => None,
        })
    }
}

/// The closure of a contact pair, which is zero where the pair opens or closes.
fn closure(here: &Situation, pair: usize) -> Option<Value> {
    let state = here.state()?;
    let sign = here.point().disc_speed_rad_s.signum();
    let along = |slope: &StateSlope| slope.closure[pair];
    let (friction, stiffness) = (sign * along(&state.per_friction), along(&state.per_stiffness));
    let slope = [friction, along(&state.per_load), 0.0, stiffness, 0.0];
    let largest = state.closure_m.iter().fold(0.0, |largest: f64, closure| largest.max(closure.abs()));
    Some(Value { f: state.closure_m[pair], slope, error: CLOSURE_ERROR * largest })
}

#[cfg(test)]
mod tests {
    use super::super::law::ContactLaw;
    use super::super::stability_map::MapOptions;
    use super::super::stribeck::Stribeck;
    use super::super::test_models::{REFERENCE, hulten, nine_dof};
    use super::*;
    use crate::proof::synthetic::{Synthetic, Uniform, rig};

    const OPTIONS: MapOptions =
        MapOptions { mu_min: 0.0, mu_max: 2.0, band_max_hz: None, instability_threshold: 1e-6, windows: true };

    fn map(model: &Model, point: &OperatingPoint) -> StabilityMap {
        StabilityMap::build(model, &mut Solver::new(model.dimension()), point, &OPTIONS).expect("it can be mapped")
    }

    #[test]
    fn the_margin_is_the_distance_to_the_nearest_end_of_the_union() {
        let end = |mu| End {
            condition: Condition::Edge,
            mu,
            error: 0.0,
            slope: [0.0; 4],
            curvature: [[0.0; 2]; 2],
            reach: [REACH; 2],
        };
        let ends = |windows: &[(f64, Option<f64>)]| Ends {
            point: REFERENCE,
            windows: windows.iter().map(|&(from, to)| (end(from), to.map(end))).collect(),
        };
        assert_eq!(ends(&[]).nearest(&REFERENCE), None);
        let overlapping = ends(&[(0.2, Some(0.5)), (0.4, Some(0.7)), (1.5, None)]);
        let touching = ends(&[(0.2, Some(0.5)), (0.5, Some(0.7)), (1.5, None), (1.6, None)]);
        // Friction coefficient, the nearest end, the margin to it.
        let expected = [(0.1, 0.2, 0.1), (0.44, 0.2, -0.24), (0.6, 0.7, -0.1), (0.9, 0.7, 0.2), (1.75, 1.5, -0.25)];
        for (mu, end, margin) in expected {
            for ends in [&overlapping, &touching] {
                let found = ends.nearest(&REFERENCE.with_friction(mu)).unwrap();
                assert!(found.mu == end && (found.margin - margin).abs() < 1e-15, "{mu}: {found:?}");
                assert_eq!((found.inside, found.is_start), (margin < 0.0, end == 0.2 || end == 1.5), "{mu}: {found:?}");
            }
        }
    }

    /// An end that moves with the load has a bound up to a change of [`REACH`], and none beyond. An end that does not
    /// move has a bound everywhere.
    #[test]
    fn beyond_its_reach_an_end_has_no_bound() {
        let end = |slope: f64| End {
            condition: Condition::Discriminant(0, 1),
            mu: 0.5,
            error: 1e-12,
            slope: [slope, 0.0, 0.0, 0.0],
            curvature: [[0.0; 2]; 2],
            reach: [REACH; 2],
        };
        for (slope, load, known) in [(1e-4, 1.019, true), (1e-4, 1.021, false), (1e-4, 0.979, false), (0.0, 2.0, true)]
        {
            let ends = Ends { point: REFERENCE, windows: vec![(end(slope), None)] };
            let point = OperatingPoint { normal_load_n: load * REFERENCE.normal_load_n, ..REFERENCE };
            let found = ends.nearest(&point).unwrap();
            assert!((found.mu - (0.5 + slope * (load - 1.0) * REFERENCE.normal_load_n)).abs() < 1e-15);
            assert_eq!(found.error == 1e-12, known, "{load}: {found:?}");
            assert!(known || found.error.is_nan(), "{load}: {found:?}");
        }
    }

    /// At a merging point the error bound of an end holds against 30-digit arithmetic; it is of the size of rounding,
    /// not zero.
    #[test]
    fn the_bound_of_an_end_holds_where_modes_merge() {
        let map = map(&nine_dof(2.0, 2.0, 5.0), &REFERENCE);
        let nearest = map.ends.nearest(&REFERENCE.with_friction(0.3)).unwrap();
        // The reference value has 14 digits.
        assert!((nearest.mu - 0.35592805826058).abs() <= nearest.error + 1e-14, "{nearest:?}");
        assert!(nearest.error > f64::EPSILON && nearest.error < 1e-11, "{nearest:?}");
        let next = map.next_window(&map.ends, &REFERENCE.with_friction(0.3)).unwrap();
        assert_eq!((next.end, next.window), (nearest, &map.windows[0]));
        assert_eq!(next.frequency_hz, map.windows[0].frequency_hz);
    }

    /// Ends carried to another load and speed agree to 1e-10 with those of a map built there. Extrapolated ends stay
    /// within their bound. Tested on undamped and damped rigs whose stiffness and damping depend on load and speed.
    #[test]
    fn ends_follow_load_and_speed() {
        let laws = [
            (0.0, ContactLaw { exponent: 0.4, ..Default::default() }),
            (
                2e-3,
                ContactLaw {
                    exponent: 0.4,
                    slope_s_per_m: -2e-3,
                    stribeck: Some(Stribeck { drop: 5e-3, speed_m_s: 1.5, exponent: 2.0 }),
                    lateral_damping: true,
                    ..Default::default()
                },
            ),
        ];
        let mut uniform = Uniform::new(5);
        let (mut carried_ends, mut moved_most) = (0, 0.0f64);
        for (law, seed) in (1..=12).map(|seed| (usize::from(seed % 3 == 0), seed)) {
            let (damping_ratio, contact_law) = laws[law];
            let model = rig(&Synthetic { modes: 24, pairs: 12, damping_ratio, contact_law, seed }).unwrap();
            let map = map(&model, &REFERENCE);
            for _ in 0..2 {
                let point = OperatingPoint {
                    normal_load_n: REFERENCE.normal_load_n * (1.0 + 0.01 * uniform.draw()),
                    disc_speed_rad_s: REFERENCE.disc_speed_rad_s * (1.0 + 0.01 * uniform.draw()),
                    ..REFERENCE
                };
                let mut solver = Solver::new(model.dimension());
                let carried = Ends::carried(&model, &mut solver, &map, &point).unwrap().expect("they are found again");
                let there = self::map(&model, &point);
                assert_eq!(there.windows.len(), map.windows.len(), "law {law}, seed {seed}: a window came or went");
                let both = |ends: &Ends, at: &OperatingPoint| -> Vec<Bounded> {
                    ends.at(at).flat_map(|(from, to)| std::iter::once(from).chain(to)).collect()
                };
                let (exact, found, guessed) =
                    (both(&there.ends, &point), both(&carried, &point), both(&map.ends, &point));
                for k in 0..exact.len() {
                    let mu = exact[k].value;
                    assert!((found[k].value - mu).abs() < 1e-10, "law {law}, seed {seed}: {:?} {mu}", found[k]);
                    let limit = guessed[k].error + exact[k].error;
                    assert!((guessed[k].value - mu).abs() <= limit, "law {law}, seed {seed}: {:?} {mu}", guessed[k]);
                    carried_ends += 1;
                    moved_most = moved_most.max((both(&map.ends, &REFERENCE)[k].value - mu).abs());
                }
            }
        }
        assert!(carried_ends > 15 && moved_most > 1e-3, "worth testing: {carried_ends} ends, moved by {moved_most}");
    }

    /// The derivative of an end with respect to contact stiffness agrees with a central difference.
    /// 9-degree-of-freedom model with contact springs stiffer and softer by 1e-4.
    #[test]
    fn ends_follow_the_contact() {
        let step = 1e-4;
        let ends = |stiffer: f64| map(&nine_dof(2.0, 2.0, 5.0 * stiffer), &REFERENCE);
        let (map, up, down) = (ends(1.0), ends(1.0 + step), ends(1.0 - step));
        let slope = map.ends.windows[0].0.slope;
        let difference = (up.windows[0].mu_from - down.windows[0].mu_from) / (2.0 * step);
        assert!((slope[2] - difference).abs() < 1e-6 * difference.abs().max(1.0), "{slope:?} {difference}");
        assert_eq!((slope[0], slope[1], slope[3]), (0.0, 0.0, 0.0), "no load, speed or damping in it");
        assert!(map.ends.windows[0].0.error < 1e-12, "{:?}", map.ends.windows[0]);
    }

    /// Zero growth in Hultén's damped model: the end has an error bound, and carrying it to the same load and speed
    /// leaves it unchanged.
    #[test]
    fn damped_ends_stay() {
        let model = hulten(0.02, 0.10);
        let map = map(&model, &REFERENCE);
        let carried = Ends::carried(&model, &mut Solver::new(2), &map, &REFERENCE).unwrap().expect("it is found");
        let (was, is) = (map.ends.windows[0].0, carried.windows[0].0);
        assert!((was.mu - is.mu).abs() <= was.error + is.error && was.error < 1e-11, "{was:?} {is:?}");
    }
}
