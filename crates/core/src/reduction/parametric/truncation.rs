//! Truncation of the sampled vectors to the fewest that hold the tolerance.

use faer::linalg::solvers::Solve;
use faer::{Mat, c64};

use super::super::ReductionError;
use super::super::dense::symmetric_eigen;
use super::super::full_model::Projected;
use super::super::matching::match_roots;
use super::request::ParametricStep;
use super::sampling::{Building, oscillating};
use crate::physics::{OperatingPoint, Vectors};

impl Building<'_, '_> {
    /// Projects the model on the fewest leading singular vectors of the snapshots that hold the tolerance at all
    /// training points; the number is found by bisection.
    pub fn cut(
        &self,
        wide: &Projected,
        training: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Projected, ReductionError> {
        let model = self.model(wide)?;
        let mut references = self.known.clone();
        for point in training.iter().filter(|point| !self.sampled.contains(point)) {
            references.push((*point, oscillating(&self.solve(&model, point, Vectors::None)?)));
        }
        let size = self.span.ncols();
        let mut covariance = Mat::<f64>::zeros(size, size);
        for block in &self.snapshots {
            let all = Mat::from_fn(size, block.ncols(), |i, j| if i < block.nrows() { block[(i, j)] } else { 0.0 });
            covariance += &all * all.transpose();
        }
        let covariance = Mat::from_fn(size, size, |i, j| covariance[(i.max(j), i.min(j))]);
        let (_, vectors) = symmetric_eigen("parametric basis", covariance.as_ref())?;
        // Change of coordinates from the span to `wide.basis`.
        let turn = self.span.transpose() * self.metric.times(wide.basis.as_ref());
        let mut leading = Mat::from_fn(size, size, |i, k| vectors[(i, size - 1 - k)]);
        turn.partial_piv_lu().solve_in_place(leading.as_mut());
        let mut best_allowed = f64::INFINITY;
        let mut attempt = |count: usize| -> Result<(Projected, f64), ReductionError> {
            let smaller = wide.restricted(leading.subcols(0, count))?;
            let model = self.model(&smaller)?;
            let mut worst = 0.0_f64;
            for (point, roots) in &references {
                let reduced = oscillating(&self.solve(&model, point, Vectors::None)?);
                worst = worst.max(match_roots(roots, &reduced, self.request.counted).worst());
                if worst == f64::INFINITY {
                    break;
                }
            }
            progress(ParametricStep::Cut { vectors: count, worst });
            if count <= self.request.most_vectors {
                best_allowed = best_allowed.min(worst);
            }
            Ok((smaller, worst))
        };
        let limit = 0.5 * self.request.tolerance;
        let (mut enough, mut found) = (size, None);
        let counted = self.request.counted;
        let counting = |roots: &Vec<c64>| roots.iter().filter(|lambda| counted.counts(**lambda)).count();
        // A basis needs at least as many vectors as counted roots.
        let mut few = self.known.iter().map(|(_, roots)| counting(roots)).max().unwrap_or(0).min(size - 1);
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
}
