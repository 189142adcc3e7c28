//! Solved points of a box: roots, their slopes along the axes, and which root is which from point to point.

use faer::{Mat, c64};

use super::{Axis, MAX_AXES};
use crate::physics::model::{Exact, Model, Traces};
use crate::physics::operating_point::OperatingPoint;
use crate::physics::solver::{ROUNDING, Solver};
use crate::physics::spectrum::{SolveError, Spectrum, Vectors};
use crate::physics::tracking::{continue_roots, tracked};

/// Condition of a root above which its slope has lost too many digits.
const SOUND_CONDITION: f64 = 2e3;
/// Step of a central difference of the laws, in the coordinate of an axis: truncation and rounding are both near 1e-11.
const STEP: f64 = 1e-5;

/// A solved point.
pub struct Sample {
    /// Its coordinates.
    pub at: [f64; MAX_AXES],
    /// What was found there; the left vectors are gone.
    pub spectrum: Spectrum,
    /// Each tracked root: `λ²` of an undamped model, `λ` of a damped one.
    pub z: Vec<c64>,
    /// Their slopes along each axis.
    pub slopes: Vec<[c64; MAX_AXES]>,
    /// Their condition numbers.
    pub conditions: Vec<f64>,
    /// The sums of first and second powers of all roots and what else is known exactly; the slopes of the sums.
    pub totals: Exact,
    pub total_slopes: [[f64; 2]; MAX_AXES],
    /// What rounding can do to a well-conditioned root.
    pub rounding: f64,
}

impl Sample {
    /// Whether the slope of root `k` can be used.
    pub fn is_sound(&self, k: usize) -> bool {
        self.conditions[k] <= SOUND_CONDITION
    }
}

/// Solves at points of a box.
pub struct Sampler<'a> {
    pub model: &'a Model,
    pub traces: Traces,
    pub axes: Vec<Axis>,
    pub low: [f64; MAX_AXES],
    pub high: [f64; MAX_AXES],
    /// What no axis sets.
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

    /// Solves at `x`.
    ///
    /// # Errors
    /// [`SolveError`].
    pub fn solve(&self, solver: &mut Solver, x: &[f64; MAX_AXES]) -> Result<Sample, SolveError> {
        let n = self.model.dimension();
        let point = self.point(x);
        let mut spectrum = solver.solve(self.model, &point, Vectors::Both)?;
        let left = std::mem::replace(&mut spectrum.left, Mat::new());
        let count = tracked(&spectrum);
        let shapes = spectrum.shapes.get(.., ..count);
        let (re, im) =
            (Mat::from_fn(n, count, |i, j| shapes[(i, j)].re), Mat::from_fn(n, count, |i, j| shapes[(i, j)].im));
        let value = |k: usize| if spectrum.undamped { spectrum.roots[k].square } else { spectrum.roots[k].lambda };
        let z: Vec<c64> = (0..count).map(value).collect();
        let mut slopes = vec![[c64::ZERO; MAX_AXES]; count];
        let mut total_slopes = [[0.0; 2]; MAX_AXES];
        let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
        for axis in 0..self.axes.len() {
            let (mut below, mut above) = (*x, *x);
            below[axis] = (x[axis] - STEP).max(self.low[axis]);
            above[axis] = (x[axis] + STEP).min(self.high[axis]);
            let per = 1.0 / (above[axis] - below[axis]);
            let (below, above) = (self.point(&below), self.point(&above));
            let changes = self.model.assemble_difference(&below, &above, per, &mut stiffness, &mut damping)?;
            let (before, after) = (self.traces.at(self.model, &below), self.traces.at(self.model, &above));
            total_slopes[axis] = [0, 1].map(|k| (after.powers[k] - before.powers[k]) * per);
            for (matrix, is_damping) in [(&stiffness, false), (&damping, true)] {
                if !changes[usize::from(is_damping)] {
                    continue;
                }
                let (re, im) = (matrix * &re, matrix * &im);
                for (k, slopes) in slopes.iter_mut().enumerate() {
                    let along: c64 = (0..n).map(|i| left[(i, k)].conj() * c64::new(re[(i, k)], im[(i, k)])).sum();
                    slopes[axis] -= if is_damping { z[k] * along } else { along };
                }
            }
        }
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
            conditions,
            totals: self.traces.at(self.model, &point),
            total_slopes,
            rounding: ROUNDING * f64::EPSILON * spectrum.matrix_norm,
            spectrum,
        })
    }

    /// Solves at all of `points`, spread over `solvers`, in their order.
    ///
    /// # Errors
    /// [`SolveError`] of the first that failed.
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

/// `count` points of `[-1, 1]^axes`, far from each other and from `taken` in the angles `θ`, `x = cos θ`: there the points
/// that serve polynomials are evenly spread. Corners are among them: there an expansion is farthest from what it was fitted to,
/// and what it leaves out is largest.
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

/// The digits of `index` in `base`, mirrored at the point (van der Corput 1935; Halton 1960).
pub(crate) fn radical_inverse(mut index: usize, base: usize) -> f64 {
    let (mut value, mut digit) = (0.0, 1.0 / base as f64);
    while index > 0 {
        value += digit * (index % base) as f64;
        index /= base;
        digit /= base as f64;
    }
    value
}

/// Which root of each sample continues which of `samples[start]`, carried from sample to nearest sample:
/// `[sample][branch]`. `None` where a root is lost.
pub fn follow(samples: &[&Sample], units: &[[f64; MAX_AXES]], start: usize) -> Option<Vec<Vec<usize>>> {
    let count = samples[start].z.len();
    if samples.iter().any(|sample| sample.z.len() != count) {
        return None;
    }
    let mut known: Vec<Option<Vec<usize>>> = vec![None; samples.len()];
    known[start] = Some((0..count).collect());
    let distance = |a: usize, b: usize| (0..MAX_AXES).map(|k| (units[a][k] - units[b][k]).powi(2)).sum::<f64>();
    // For each sample not yet known the nearest that is.
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
