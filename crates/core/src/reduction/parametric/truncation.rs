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
const SHARE: f64 = 0.4;
/// Number of times that roots gain weight before more vectors are taken.
const MOST_WEIGHTINGS: i32 = 3;
/// Fraction of the limit that weights aim at: errors would approach the limit itself from above.
const AIM: f64 = 0.8;
/// Fraction of the limit above which an error is watched.
const NEAR: f64 = 0.3;
/// Number of interpolations in a row before the interval of the number of vectors is halved.
const MOST_INTERPOLATIONS: usize = 3;

/// What a smaller basis must hold at one operating point.
struct Target {
    here: Situation,
    /// Roots of the wide model that may count.
    roots: Vec<c64>,
    /// The counted ones, each with its weight.
    counted: Vec<(c64, f64)>,
    /// Real and imaginary parts of their right and left vectors with their [`Condition::scales`], in the span: four columns each.
    vectors: Mat<f64>,
    /// Whether the roots of the last basis compared here had errors near the limit: the next one is compared here first.
    watched: bool,
    last: RootMatch,
}

impl Building<'_, '_> {
    /// Projects the model on the fewest vectors that hold its roots at all `points`; the number is found by
    /// interpolation of the logarithm of the error, and by bisection.
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
        let unweighted = covariance(size, &targets);
        let first_axes = axes(&unweighted)?;
        let mut attempt = |count: usize| -> Result<(Projected, f64), ReductionError> {
            for target in &mut targets {
                target.counted.iter_mut().for_each(|(_, weight)| *weight = 1.0);
                target.watched = true;
            }
            let mut covariance = unweighted.clone();
            let (mut weightings, mut before) = (0, f64::INFINITY);
            let (smaller, worst) = loop {
                let weighted = if weightings > 0 { Some(axes(&covariance)?) } else { None };
                // Ascending: the last ones lead.
                let axes = weighted.as_ref().unwrap_or(&first_axes);
                let mut leading = axes.subcols(size - count, count).to_owned();
                back.solve_in_place(leading.as_mut());
                let smaller = wide.restricted(leading.as_ref())?;
                let worst = self.compare(&smaller, &mut targets, limit)?;
                // What is left of the error if every weighting still allowed gains as much as the last one did.
                let reachable = worst * (worst / before).powi(MOST_WEIGHTINGS - weightings);
                if worst <= limit || worst == f64::INFINITY || reachable > limit {
                    break (smaller, worst);
                }
                covariance += gained(size, &mut targets, AIM * limit);
                (weightings, before) = (weightings + 1, worst);
            };
            progress(ParametricStep::Cut { vectors: count, worst });
            if count <= self.request.most_vectors {
                best_allowed = best_allowed.min(worst);
            }
            Ok((smaller, worst))
        };
        // A basis needs at least as many vectors as counted roots.
        let few = most_counted.min(size - 1);
        let (enough, found) = fewest(few, size, limit, &mut attempt)?;
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
                watched: true,
                last: RootMatch::default(),
            })
        })
    }

    /// Largest error of a root of `smaller` at the targets. Once it exceeds `limit` at a watched one, the others are left out.
    fn compare(&self, smaller: &Projected, targets: &mut [Target], limit: f64) -> Result<f64, ReductionError> {
        let model = self.model(smaller)?;
        let (watched, others): (Vec<usize>, Vec<usize>) = (0..targets.len()).partition(|&k| targets[k].watched);
        let mut worst = 0.0_f64;
        for indices in [watched, others] {
            let compared = on_points(&model, &indices, &|solver, &k| {
                let reduced = solver.solve_in(&model, &targets[k].here, Vectors::None).map_err(solve_failed)?;
                Ok(match_roots(&targets[k].roots, &comparable_of(&reduced), self.request.counted))
            })?;
            for (k, last) in indices.into_iter().zip(compared) {
                worst = worst.max(last.worst());
                targets[k].watched = last.worst() > NEAR * limit;
                targets[k].last = last;
            }
            if worst > limit {
                break;
            }
        }
        Ok(worst)
    }
}

/// The least count above `few`, up to `enough`, whose error is within `limit`, and what `attempt` made of it: `None` for
/// `enough` itself, which is assumed to hold. `attempt` returns what it made of a count, and its error.
///
/// The next count is where the logarithm of the error, interpolated between the two nearest counts tried, crosses the
/// limit, and the middle where one of them is not tried yet, or after [`MOST_INTERPOLATIONS`]. Where the error is not
/// monotone, the count found holds and the one below it does not.
fn fewest<T, E>(
    mut few: usize,
    mut enough: usize,
    limit: f64,
    attempt: &mut dyn FnMut(usize) -> Result<(T, f64), E>,
) -> Result<(usize, Option<T>), E> {
    // NaN: not known.
    let (mut error_of_few, mut error_of_enough) = (f64::NAN, f64::NAN);
    let (mut found, mut interpolations) = (None, 0);
    while enough > few + 1 {
        let share = (error_of_few / limit).ln() / (error_of_few / error_of_enough).ln();
        let count = if share.is_finite() && interpolations < MOST_INTERPOLATIONS {
            interpolations += 1;
            (few + (share * (enough - few) as f64) as usize).clamp(few + 1, enough - 1)
        } else {
            interpolations = 0;
            (enough + few) / 2
        };
        let (made, error) = attempt(count)?;
        if error <= limit {
            (enough, error_of_enough, found) = (count, error, Some(made));
        } else {
            (few, error_of_few) = (count, error);
        }
    }
    Ok((enough, found))
}

/// `Σ v vᵀ` over the vectors of all targets, `size×size`.
fn covariance(size: usize, targets: &[Target]) -> Mat<f64> {
    targets.iter().fold(Mat::zeros(size, size), |sum, target| sum + &target.vectors * target.vectors.transpose())
}

/// Gives every root whose error exceeds `aim` the more weight; returns what their vectors add to the covariance.
fn gained(size: usize, targets: &mut [Target], aim: f64) -> Mat<f64> {
    let mut sum = Mat::zeros(size, size);
    for Target { counted, vectors, last, .. } in targets {
        for (lambda, error) in last.errors.iter().filter(|(_, error)| *error > aim) {
            for (k, (_, weight)) in counted.iter_mut().enumerate().filter(|(_, (of, _))| of == lambda) {
                let of_root = vectors.subcols(4 * k, 4);
                let more = *weight * (error / aim - 1.0);
                sum += faer::Scale(more) * (of_root * of_root.transpose());
                *weight += more;
            }
        }
    }
    sum
}

/// Eigenvectors of a covariance, ascending in their eigenvalues.
fn axes(covariance: &Mat<f64>) -> Result<Mat<f64>, ReductionError> {
    let n = covariance.nrows();
    let symmetric = Mat::from_fn(n, n, |i, j| covariance[(i.max(j), i.min(j))]);
    Ok(symmetric_eigen("parametric basis", symmetric.as_ref())?.1)
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use super::*;

    /// Exponential errors, one step, and errors that are infinite for few vectors: the same count as one by one, in at most
    /// four attempts for each halving of the interval.
    #[test]
    fn the_fewest_vectors_are_found_in_few_attempts() {
        let errors: [&dyn Fn(usize) -> f64; 4] = [
            &|count| 10.0_f64.powf(-0.1 * count as f64),
            &|count| if count < 97 { 1.0 } else { 1e-12 },
            &|count| if count < 60 { f64::INFINITY } else { 10.0_f64.powf(-0.09 * count as f64) },
            &|_| 0.0,
        ];
        let (few, enough, limit) = (15, 145, 4e-7);
        for (index, error) in errors.into_iter().enumerate() {
            let expected = (few + 1..enough).find(|&count| error(count) <= limit).unwrap();
            let mut attempts = 0;
            let (count, made) = fewest(few, enough, limit, &mut |count| {
                attempts += 1;
                Ok::<_, Infallible>((count, error(count)))
            })
            .unwrap();
            assert_eq!((count, made), (expected, Some(expected)), "{index}");
            assert!(attempts <= 4 * 8, "{index}: {attempts}");
            // Exponential errors are interpolated to a straight line.
            assert!(index != 0 || attempts <= 5, "{attempts}");
        }
        let nothing = fewest(few, enough, limit, &mut |_| Ok::<_, Infallible>(((), 1.0))).unwrap();
        assert_eq!(nothing, (enough, None));
    }
}
