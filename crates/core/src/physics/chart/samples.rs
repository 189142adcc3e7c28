//! Solved points of a box: roots with slopes and curvatures along the axes, and the connection of roots from point to
//! point.

use faer::{Mat, c64};

use super::derivatives::{Change, Derivatives, PAIRS, pairs};
use super::pieces::Pieces;
use super::{Axis, MAX_AXES, lateral};
use crate::physics::model::Model;
use crate::physics::operating_point::OperatingPoint;
use crate::physics::solver::{ROUNDING, Solver};
use crate::physics::spectrum::{SolveError, Spectrum, Vectors};
use crate::physics::steady_contact::Situation;
use crate::physics::traces::{Exact, Traces, trace, trace_of_product};
use crate::physics::tracking::{continue_roots, tracked};
use crate::sampling::radical_inverse;

/// Condition number of a root above which its slope and curvature are too inaccurate to be used.
const SOUND_CONDITION: f64 = 2e3;
/// Step of a central difference of the laws, in the coordinate of an axis. Truncation and rounding are both near
/// 1e-11.
const STEP: f64 = 1e-5;
/// Step of a second difference, relative to half the width of the box. Rounding is near 1e-10 of a law, and a
/// curvature has less than a hundredth of the weight of a value.
const WIDE_STEP: f64 = 1e-3;

/// Step of a difference of slopes of a model with a contact state, relative to half the width of the box. A slope is
/// known to about 1e-13, so rounding is near 1e-9 and truncation near 1e-8 of a slope.
const STATE_STEP: f64 = 2e-4;

/// A solved point.
pub struct Sample {
    /// Coordinates of the point.
    pub at: [f64; MAX_AXES],
    /// Its spectrum, without left vectors.
    pub spectrum: Spectrum,
    /// Value of each followed root: `λ²` of an undamped model, `λ` of a damped one.
    pub z: Vec<c64>,
    /// Slope of each root along each axis, and its second derivatives along each pair of axes.
    pub slopes: Vec<[c64; MAX_AXES]>,
    pub curvatures: Vec<[c64; PAIRS]>,
    /// Condition number of each root.
    pub conditions: Vec<f64>,
    /// Exact sums of first and second powers of all roots, with their slopes and curvatures.
    pub totals: Exact,
    pub total_slopes: [[f64; 2]; MAX_AXES],
    pub total_curvatures: [[f64; 2]; PAIRS],
    /// Rounding error of a well-conditioned root.
    pub rounding: f64,
}

impl Sample {
    /// Whether the slope and curvature of root `k` can be used.
    pub fn is_sound(&self, k: usize) -> bool {
        self.conditions[k] <= SOUND_CONDITION && self.has_curvature(k)
    }

    /// Whether root `k` has a finite curvature. It has none where a law is undefined nearby or a multiple root is
    /// defective.
    pub fn has_curvature(&self, k: usize) -> bool {
        self.curvatures[k].iter().all(|curvature| curvature.is_finite())
    }
}

/// Exact sums of powers of the roots at a point, with slopes and curvatures.
struct Totals {
    totals: Exact,
    total_slopes: [[f64; 2]; MAX_AXES],
    total_curvatures: [[f64; 2]; PAIRS],
}

/// Solves at points of a box.
pub struct Sampler<'a> {
    pub model: &'a Model,
    pub traces: Traces,
    pub axes: Vec<Axis>,
    pub low: [f64; MAX_AXES],
    pub high: [f64; MAX_AXES],
    /// Supplies the conditions that no axis sets.
    pub base: OperatingPoint,
}

impl Sampler<'_> {
    /// The operating point at coordinates `x`.
    pub fn point(&self, x: &[f64; MAX_AXES]) -> OperatingPoint {
        let mut p = self.base;
        for (axis, &x) in self.axes.iter().zip(x) {
            axis.place(&mut p, x);
        }
        p
    }

    /// The pieces of a contact law that is not analytic.
    pub fn pieces(&self) -> Option<Pieces<'_>> {
        Pieces::new(self.model, &self.axes, self.base)
    }

    /// Solves at coordinates `x`.
    ///
    /// # Errors
    /// [`SolveError`].
    pub fn solve(&self, solver: &mut Solver, x: &[f64; MAX_AXES]) -> Result<Sample, SolveError> {
        let n = self.model.dimension();
        let point = self.point(x);
        let mut spectrum = solver.solve(self.model, &point, Vectors::Both)?;
        let left = std::mem::replace(&mut spectrum.left, Mat::new());
        let count = tracked(&spectrum);
        let value = |k: usize| if spectrum.undamped { spectrum.roots[k].square } else { spectrum.roots[k].lambda };
        let z: Vec<c64> = (0..count).map(value).collect();
        let axes = self.axes.len();
        let with_state = self.model.statics().is_some();
        let (first, second) = if with_state {
            self.changes_with_state(x, &spectrum.situation())?
        } else {
            let first = (0..axes).map(|axis| self.change(&[self.difference(x, axis)]));
            let second = pairs(axes).map(|pair| self.change(&self.second_difference(x, pair)));
            (first.collect::<Result<Vec<_>, _>>()?, second.collect::<Result<Vec<_>, _>>()?)
        };
        let Derivatives { slopes, curvatures } = Derivatives::new(&spectrum, left.as_ref(), &first, &second);
        let Totals { totals, total_slopes, total_curvatures } = if with_state {
            self.totals_with_state(&spectrum.situation(), spectrum.undamped, &first, &second)?
        } else {
            self.totals(x, &point)
        };
        let conditions = (0..count)
            .map(|k| {
                let size = (0..n).map(|i| left[(i, k)].norm_sqr()).sum::<f64>().sqrt();
                if spectrum.undamped { size } else { 2.0 * z[k].norm() * size }
            })
            .collect();
        Ok(Sample {
            at: *x,
            z,
            slopes,
            curvatures,
            conditions,
            totals,
            total_slopes,
            total_curvatures,
            rounding: ROUNDING * f64::EPSILON * spectrum.matrix_norm,
            spectrum,
        })
    }

    /// The exact sums at `point`, which has coordinates `x`.
    fn totals(&self, x: &[f64; MAX_AXES], point: &OperatingPoint) -> Totals {
        let axes = self.axes.len();
        let total = |p: &OperatingPoint| self.traces.at(self.model, p).powers;
        let mut total_slopes = [[0.0; 2]; MAX_AXES];
        for (axis, slope) in total_slopes[..axes].iter_mut().enumerate() {
            let Difference { below, above, per } = self.difference(x, axis);
            let (below, above) = (total(&below), total(&above));
            *slope = std::array::from_fn(|k| (above[k] - below[k]) * per);
        }
        let mut total_curvatures = [[0.0; 2]; PAIRS];
        for (curvature, pair) in total_curvatures.iter_mut().zip(pairs(axes)) {
            for Difference { below, above, per } in self.second_difference(x, pair) {
                let (below, above) = (total(&below), total(&above));
                (0..2).for_each(|k| curvature[k] += (above[k] - below[k]) * per);
            }
        }
        Totals { totals: self.traces.at(self.model, point), total_slopes, total_curvatures }
    }

    /// First and second derivatives of the matrices of a model with a contact state, which follows the conditions.
    /// Slopes follow from the derivatives of the state; second derivatives are central differences of slopes, and NaN where
    /// these lie on different pieces of the contact law.
    fn changes_with_state(
        &self,
        x: &[f64; MAX_AXES],
        here: &Situation,
    ) -> Result<(Vec<Change>, Vec<Change>), SolveError> {
        let axes = self.axes.len();
        let first = (0..axes).map(|axis| self.slope_with_state(here, axis)).collect::<Result<Vec<_>, _>>()?;
        let pieces = self.pieces();
        let mut second = vec![];
        for b in 0..axes {
            let step = 0.5 * STATE_STEP * (self.high[b] - self.low[b]);
            let beside = [-step, step].map(|step| {
                let mut beside = *x;
                if self.axes[b].involves_speed() {
                    beside[b] = x[b].clamp(self.low[b] + step.abs(), self.high[b] - step.abs());
                }
                beside[b] += step;
                self.model.at(&self.point(&beside))
            });
            let [below, above] = beside;
            let (below, above) = (below?, above?);
            let agree = |there: &Situation| match (&pieces, here.state(), there.state()) {
                (Some(pieces), Some(here), Some(there)) => pieces.agree(here, there),
                (Some(_), _, _) | (None, _, _) => true,
            };
            let bent = !(agree(&below) && agree(&above));
            for a in 0..=b {
                if bent {
                    let n = self.model.dimension();
                    second.push([0, 1].map(|_| Some(Mat::full(n, n, f64::NAN))));
                    continue;
                }
                let (below, above) = (self.slope_with_state(&below, a)?, self.slope_with_state(&above, a)?);
                let quotient = |below: Mat<f64>, above: Mat<f64>| (above - below) * faer::Scale(0.5 / step);
                let parts = below.into_iter().zip(above).map(|(below, above)| below.zip(above));
                let mut parts = parts.map(|part| part.map(|(below, above)| quotient(below, above)));
                second.push([parts.next().flatten(), parts.next().flatten()]);
            }
        }
        Ok((first, second))
    }

    /// The derivatives of the matrices along an axis at `here`.
    fn slope_with_state(&self, here: &Situation, axis: usize) -> Result<Change, SolveError> {
        let n = self.model.dimension();
        let [mut stiffness, mut damping] = [Mat::zeros(n, n), Mat::zeros(n, n)];
        let (parameter, per) = self.axes[axis].derivative(here.point());
        self.model.assemble_derivative_at(here, parameter, &mut stiffness, &mut damping)?;
        Ok([Some(stiffness * faer::Scale(per)), Some(damping * faer::Scale(per))])
    }

    /// The exact sums of a model with a contact state, from its matrices and their derivatives.
    fn totals_with_state(
        &self,
        here: &Situation,
        undamped: bool,
        first: &[Change],
        second: &[Change],
    ) -> Result<Totals, SolveError> {
        let n = self.model.dimension();
        let [mut stiffness, mut damping] = [Mat::zeros(n, n), Mat::zeros(n, n)];
        self.model.assemble_at(here, &mut stiffness, &mut damping)?;
        let zero = Mat::zeros(n, n);
        let each =
            |change: &Change| change.each_ref().map(|part| part.as_ref().map_or_else(|| zero.clone(), Mat::clone));
        let first: Vec<[Mat<f64>; 2]> = first.iter().map(each).collect();
        let mut total_slopes = [[0.0; 2]; MAX_AXES];
        for (slope, [k, c]) in total_slopes.iter_mut().zip(&first) {
            *slope = if undamped {
                [-trace(k), 2.0 * trace_of_product(&stiffness, k)]
            } else {
                [-trace(c), 2.0 * trace_of_product(&damping, c) - 2.0 * trace(k)]
            };
        }
        let mut total_curvatures = [[0.0; 2]; PAIRS];
        for ((curvature, change), [a, b]) in total_curvatures.iter_mut().zip(second).zip(pairs(self.axes.len())) {
            let ([k, c], [k_a, c_a], [k_b, c_b]) = (each(change), &first[a], &first[b]);
            *curvature = if undamped {
                [-trace(&k), 2.0 * (trace_of_product(k_a, k_b) + trace_of_product(&stiffness, &k))]
            } else {
                let bent = trace_of_product(c_a, c_b) + trace_of_product(&damping, &c);
                [-trace(&c), 2.0 * bent - 2.0 * trace(&k)]
            };
        }
        Ok(Totals { totals: Exact::of(&stiffness, &damping, !undamped), total_slopes, total_curvatures })
    }

    /// The sum of differences of the stiffness and of the damping; `None` for a matrix that does not change.
    fn change(&self, differences: &[Difference]) -> Result<Change, SolveError> {
        let n = self.model.dimension();
        let mut sums: Change = [None, None];
        let [mut stiffness, mut damping] = [Mat::zeros(n, n), Mat::zeros(n, n)];
        for Difference { below, above, per } in differences {
            let changes = self.model.assemble_difference(below, above, *per, &mut stiffness, &mut damping)?;
            let parts = sums.iter_mut().zip([&stiffness, &damping]).zip(changes);
            for ((sum, part), _) in parts.filter(|(_, changes)| *changes) {
                *sum = Some(sum.take().map_or_else(|| part.clone(), |sum| sum + part));
            }
        }
        Ok(sums)
    }

    /// The central difference along an axis at `x`, with both points inside the box; those of lateral damping may be outside.
    fn difference(&self, x: &[f64; MAX_AXES], axis: usize) -> Difference {
        let (mut below, mut above) = (*x, *x);
        if self.axes[axis] == Axis::LateralDamping {
            (below[axis], above[axis]) = (x[axis] - lateral::STEP, x[axis] + lateral::STEP);
        } else {
            below[axis] = (x[axis] - STEP).max(self.low[axis]);
            above[axis] = (x[axis] + STEP).min(self.high[axis]);
        }
        let per = 1.0 / (above[axis] - below[axis]);
        Difference { below: self.point(&below), above: self.point(&above), per }
    }

    /// The differences whose sum is the second derivative along axes `a` and `b` at `x`. In friction and load, laws
    /// are defined slightly beyond the box. At an end of an axis of speed the derivative is taken one step inside.
    fn second_difference(&self, x: &[f64; MAX_AXES], [a, b]: [usize; 2]) -> [Difference; 2] {
        let step = |k: usize| match self.axes[k] {
            Axis::LateralDamping => lateral::STEP,
            Axis::Friction | Axis::Load | Axis::Speed | Axis::LoadOverSpeed => {
                0.5 * WIDE_STEP * (self.high[k] - self.low[k])
            }
        };
        let mut centre = *x;
        for k in [a, b].into_iter().filter(|&k| self.axes[k].involves_speed()) {
            centre[k] = x[k].clamp(self.low[k] + step(k), self.high[k] - step(k));
        }
        let at = |along_a: f64, along_b: f64| {
            let mut x = centre;
            x[a] += along_a * step(a);
            x[b] += along_b * step(b);
            self.point(&x)
        };
        let per = 1.0 / (step(a) * step(b));
        let upper_and_lower = if a == b {
            [(at(0.0, 0.0), at(1.0, 0.0), per), (at(-1.0, 0.0), at(0.0, 0.0), -per)]
        } else {
            [(at(-1.0, 1.0), at(1.0, 1.0), 0.25 * per), (at(-1.0, -1.0), at(1.0, -1.0), -0.25 * per)]
        };
        upper_and_lower.map(|(below, above, per)| Difference { below, above, per })
    }

    /// Solves at all `points` with several solvers in parallel; the samples are in the order of the points.
    ///
    /// # Errors
    /// [`SolveError`] of the first point that failed.
    pub fn solve_all(&self, solvers: &mut [Solver], points: &[[f64; MAX_AXES]]) -> Result<Vec<Sample>, SolveError> {
        if let [solver] = solvers {
            return points.iter().map(|x| self.solve(solver, x)).collect();
        }
        let share = points.len().div_ceil(solvers.len()).max(1);
        std::thread::scope(|scope| {
            let workers: Vec<_> = solvers
                .iter_mut()
                .zip(points.chunks(share))
                .map(|(solver, points)| {
                    scope.spawn(move || points.iter().map(|x| self.solve(solver, x)).collect::<Result<Vec<_>, _>>())
                })
                .collect();
            let mut all = Vec::with_capacity(points.len());
            for worker in workers {
                match worker.join() {
                    Ok(samples) => all.extend(samples?),
                    Err(panic) => std::panic::resume_unwind(panic),
                }
            }
            Ok(all)
        })
    }
}

/// The difference quotient `(f(above) - f(below)) per`.
struct Difference {
    below: OperatingPoint,
    above: OperatingPoint,
    per: f64,
}

/// `count` points of `[-1, 1]^axes` that are far from each other and from `taken`, measured in the angles `θ` with
/// `x = cos θ`: points evenly spread in `θ` suit polynomials. Corners are candidates too, because the truncation
/// error of an expansion is largest there.
pub fn spread(axes: usize, taken: &[[f64; MAX_AXES]], count: usize) -> Vec<[f64; MAX_AXES]> {
    let angle = |unit: f64| unit.clamp(-1.0, 1.0).acos();
    let pi = std::f64::consts::PI;
    let corner = |bits: usize| std::array::from_fn(|k| if bits >> k & 1 == 1 { pi } else { 0.0 });
    let inside =
        |index: usize| std::array::from_fn(|k| if k < axes { pi * radical_inverse(index, [2, 3, 5][k]) } else { 0.0 });
    let candidates: Vec<[f64; MAX_AXES]> =
        (0..1 << axes).map(corner).chain((1..=16 * count.max(8)).map(inside)).collect();
    let distance = |a: &[f64; MAX_AXES], b: &[f64; MAX_AXES]| (0..axes).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
    let mut nearest: Vec<f64> = candidates
        .iter()
        .map(|c| taken.iter().map(|unit| distance(c, &unit.map(angle))).fold(f64::INFINITY, f64::min))
        .collect();
    (0..count)
        .map(|_| {
            let far = (0..candidates.len()).max_by(|&a, &b| nearest[a].total_cmp(&nearest[b])).unwrap_or(0);
            for (nearest, candidate) in nearest.iter_mut().zip(&candidates) {
                *nearest = nearest.min(distance(candidate, &candidates[far]));
            }
            std::array::from_fn(|k| if k < axes { candidates[far][k].cos() } else { 0.0 })
        })
        .collect()
}

/// Connects the roots of all samples to branches, numbered like the roots of `samples[start]`. Each sample is
/// connected to the nearest sample already done. Returns the root index by `[sample][branch]`, or `None` if a root is
/// lost.
pub fn follow(samples: &[&Sample], units: &[[f64; MAX_AXES]], start: usize) -> Option<Vec<Vec<usize>>> {
    let count = samples[start].z.len();
    if samples.iter().any(|sample| sample.z.len() != count) {
        return None;
    }
    let mut known: Vec<Option<Vec<usize>>> = vec![None; samples.len()];
    known[start] = Some((0..count).collect());
    let distance = |a: usize, b: usize| (0..MAX_AXES).map(|k| (units[a][k] - units[b][k]).powi(2)).sum::<f64>();
    // For every sample, the nearest sample that is already connected, with the squared distance.
    let mut nearest: Vec<(f64, usize)> = (0..samples.len()).map(|k| (distance(k, start), start)).collect();
    for _ in 1..samples.len() {
        let next = (0..samples.len())
            .filter(|&k| known[k].is_none())
            .min_by(|&a, &b| nearest[a].0.total_cmp(&nearest[b].0))?;
        let from = nearest[next].1;
        let link = continue_roots(&samples[from].spectrum, &samples[next].spectrum);
        let mut there = vec![usize::MAX; count];
        for (branch, &root) in known[from].as_ref()?.iter().enumerate() {
            there[branch] = link.source[..count].iter().position(|&source| source == Some(root))?;
        }
        known[next] = Some(there);
        for (k, nearest) in nearest.iter_mut().enumerate() {
            if distance(k, next) < nearest.0 {
                *nearest = (distance(k, next), next);
            }
        }
    }
    known.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::law::ContactLaw;
    use crate::proof::synthetic::{Synthetic, rig};

    /// Curvatures compared with central differences of slopes with step `h = 1e-4`. The differences have errors of
    /// order `h²` (truncation) and `1e-11 / h` (rounding), relative to the change of the root.
    #[test]
    fn curvatures_are_those_of_differences_of_slopes() {
        for (damping_ratio, axes) in
            [(0.0, vec![Axis::Friction, Axis::Load]), (5e-3, vec![Axis::Friction, Axis::Load, Axis::Speed])]
        {
            let contact_law = ContactLaw { exponent: 0.3, ..Default::default() };
            let model = rig(&Synthetic { modes: 12, pairs: 12, damping_ratio, contact_law, seed: 2 }).unwrap();
            let base = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.3 };
            let (low, high) = ([0.0, 4.0, -1.0], [1.0, 7.0, -0.02]);
            let sampler = Sampler { model: &model, traces: Traces::new(&model), axes: axes.clone(), low, high, base };
            let mut solver = Solver::new(12);
            let mut solve = |x: [f64; MAX_AXES]| sampler.solve(&mut solver, &x).expect("it solves");
            for x in [[0.3, 5.5, -0.1], [0.01, 6.9, -0.5]] {
                let here = solve(x);
                let mut compared = 0;
                for (pair, [a, b]) in pairs(axes.len()).enumerate() {
                    let h = 1e-4;
                    let [below, above] = [-h, h].map(|h| {
                        let mut shifted = x;
                        shifted[b] += h;
                        solve(shifted)
                    });
                    let off = |z: c64, other: c64| (z - other).norm();
                    for (k, &z) in here.z.iter().enumerate().filter(|&(k, _)| here.conditions[k] < 100.0) {
                        let shifted = |sample: &Sample| {
                            let nearest = (0..sample.z.len())
                                .min_by(|&i, &j| off(sample.z[i], z).total_cmp(&off(sample.z[j], z)));
                            sample.slopes[nearest.expect("there are roots")][a]
                        };
                        let difference = (shifted(&above) - shifted(&below)) / (2.0 * h);
                        let found = here.curvatures[k][pair];
                        let limit = 1e-4 * (found.norm() + here.slopes[k][a].norm() + 1e-3 * z.norm());
                        assert!(
                            off(found, difference) < limit,
                            "root {k} at {x:?}, axes {a} {b}: {found} is not {difference}"
                        );
                        compared += 1;
                    }
                }
                assert!(compared >= 10, "{compared} compared at {x:?}");
            }
        }
    }
}
