//! Truncation of the sampled vectors to the fewest that hold the tolerance.

use faer::linalg::solvers::Solve;
use faer::{Mat, c64};

use super::super::ReductionError;
use super::super::dense::symmetric_eigen;
use super::super::full_model::Projected;
use super::super::matching::{RootMatch, match_roots};
use super::condition::Condition;
use super::request::ParametricStep;
use super::sampling::{Building, comparable_of, on_points, solve_failed};
use crate::physics::{OperatingPoint, Situation, Vectors};

/// Fraction of the tolerance by which the roots may differ from those of the wide model.
const SHARE: f64 = 0.5;
/// Number of times that roots gain weight before more vectors are taken.
const MOST_WEIGHTINGS: usize = 3;

/// What a smaller basis must hold at one operating point.
struct Target {
    here: Situation,
    /// Roots of the wide model that may count.
    roots: Vec<c64>,
    /// The counted ones, each with its weight.
    counted: Vec<(c64, f64)>,
    /// Real and imaginary parts of their right and left vectors with their [`Condition::scales`], in the span: four columns each.
    vectors: Mat<f64>,
}

impl Building<'_, '_> {
    /// Projects the model on the fewest vectors that hold its roots at all `points`; the number is found by bisection.
    pub fn cut(
        &self,
        wide: &Projected,
        points: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Projected, ReductionError> {
        let size = self.span.size();
        // Change of coordinates from `wide.basis` to the span.
        let turn = self.span.vectors.transpose() * self.span.metric.times(wide.basis.as_ref());
        let mut targets = self.targets(wide, points, &turn)?;
        let back = turn.partial_piv_lu();
        let most_counted = targets.iter().map(|target| target.counted.len()).max().unwrap_or(0);
        let mut best_allowed = f64::INFINITY;
        let limit = SHARE * self.request.tolerance;
        let mut attempt = |count: usize| -> Result<(Projected, f64), ReductionError> {
            let mut best: Option<(Projected, f64)> = None;
            for target in &mut targets {
                target.counted.iter_mut().for_each(|(_, weight)| *weight = 1.0);
            }
            for _ in 0..=MOST_WEIGHTINGS {
                let mut leading = leading(size, count, &targets)?;
                back.solve_in_place(leading.as_mut());
                let smaller = wide.restricted(leading.as_ref())?;
                let worst = self.weigh(&smaller, &mut targets, limit)?;
                if best.as_ref().is_none_or(|(_, before)| worst < *before) {
                    best = Some((smaller, worst));
                }
                if worst <= limit || worst == f64::INFINITY {
                    break;
                }
            }
            let (smaller, worst) = best.expect("at least one weighting");
            progress(ParametricStep::Cut { vectors: count, worst });
            if count <= self.request.most_vectors {
                best_allowed = best_allowed.min(worst);
            }
            Ok((smaller, worst))
        };
        let (mut enough, mut found) = (size, None);
        // A basis needs at least as many vectors as counted roots.
        let mut few = most_counted.min(size - 1);
        while enough > few + 1 {
            let middle = (enough + few) / 2;
            let (smaller, worst) = attempt(middle)?;
            if worst <= limit {
                (enough, found) = (middle, Some(smaller));
            } else {
                few = middle;
            }
        }
        let chosen = match found {
            Some(smaller) => smaller,
            None => attempt(enough)?.0,
        };
        if enough > self.request.most_vectors {
            let most = self.request.most_vectors;
            let (limit, samples) = (self.request.tolerance, self.sampled.len());
            return Err(ReductionError::Tolerance {
                what: format!("parametric basis of at most {most} vectors, {enough} are needed"),
                value: best_allowed,
                limit,
                vectors: most,
                samples,
            });
        }
        Ok(chosen)
    }

    /// Solves the wide model at `points`; `turn` is the change of its coordinates to the span.
    fn targets(
        &self,
        wide: &Projected,
        points: &[OperatingPoint],
        turn: &Mat<f64>,
    ) -> Result<Vec<Target>, ReductionError> {
        let model = self.model(wide)?;
        on_points(&model, points, &|solver, point| {
            let spectrum = solver.solve(&model, point, Vectors::Both).map_err(solve_failed)?;
            let chosen = self.counted(&spectrum);
            let mut vectors = Mat::zeros(model.dimension(), 4 * chosen.len());
            for (k, &root) in chosen.iter().enumerate() {
                let scales = Condition::of(&spectrum, root).scales();
                let [right, left] = [&spectrum.shapes, &spectrum.left].map(|shapes| shapes.col(root));
                for i in 0..model.dimension() {
                    for (side, value) in [right[i], left[i]].into_iter().enumerate() {
                        vectors[(i, 4 * k + 2 * side)] = scales[side] * value.re;
                        vectors[(i, 4 * k + 2 * side + 1)] = scales[side] * value.im;
                    }
                }
            }
            Ok(Target {
                here: spectrum.situation(),
                roots: comparable_of(&spectrum),
                counted: chosen.iter().map(|&k| (spectrum.roots[k].lambda, 1.0)).collect(),
                vectors: turn * vectors,
            })
        })
    }

    /// Largest error of a root of `smaller` at the targets. Every root whose error exceeds `limit` gains weight.
    fn weigh(&self, smaller: &Projected, targets: &mut [Target], limit: f64) -> Result<f64, ReductionError> {
        let model = self.model(smaller)?;
        let comparisons = on_points(&model, targets, &|solver, target| {
            let reduced = solver.solve_in(&model, &target.here, Vectors::None).map_err(solve_failed)?;
            Ok(match_roots(&target.roots, &comparable_of(&reduced), self.request.counted))
        })?;
        let worst = comparisons.iter().map(RootMatch::worst).fold(0.0, f64::max);
        for (target, comparison) in targets.iter_mut().zip(comparisons).filter(|_| worst < f64::INFINITY) {
            for (lambda, error) in comparison.errors {
                let of_root = target.counted.iter_mut().filter(|(of, _)| *of == lambda);
                of_root.for_each(|(_, weight)| *weight *= (error / limit).max(1.0));
            }
        }
        Ok(worst)
    }
}

/// The `count` leading left singular vectors of the weighted vectors of all targets, `size×count`.
fn leading(size: usize, count: usize, targets: &[Target]) -> Result<Mat<f64>, ReductionError> {
    let mut covariance = Mat::<f64>::zeros(size, size);
    for target in targets {
        let weighted =
            Mat::from_fn(size, target.vectors.ncols(), |i, j| target.counted[j / 4].1 * target.vectors[(i, j)]);
        covariance += &weighted * target.vectors.transpose();
    }
    let covariance = Mat::from_fn(size, size, |i, j| covariance[(i.max(j), i.min(j))]);
    let (_, vectors) = symmetric_eigen("parametric basis", covariance.as_ref())?;
    Ok(Mat::from_fn(size, count, |i, k| vectors[(i, size - 1 - k)]))
}
