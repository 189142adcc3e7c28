//! Error estimates of the reduced roots: the product of the norms of the right and the left residual.

use faer::{Mat, c64};

use super::super::ReductionError;
use super::super::checked::definite;
use super::super::full_model::Projected;
use super::super::krylov::random_block;
use super::super::{on_threads, threads_for};
use super::condition::slope;
use super::request::ParametricStep;
use super::sampling::{Building, ESTIMATORS, Estimates, ROOTS_TOGETHER, on_points, solve_failed};
use crate::physics::{Model, OperatingPoint, Spectrum, Vectors};

/// `S⁻¹ B`.
type Inverse<'a> = dyn Fn(Mat<f64>) -> Result<Mat<f64>, ReductionError> + Sync + 'a;

impl Building<'_, '_> {
    /// Point with the largest estimate, all estimates there, and the largest one; `None` without points.
    pub fn worst_estimate(
        &mut self,
        model: &Model,
        projected: &Projected,
        points: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Option<(OperatingPoint, Estimates, f64)>, ReductionError> {
        let sigma = self.span.metric.sigma;
        self.solver.factor_at(sigma)?;
        let shifted = self.solver.factors_at(sigma);
        let coupled = shifted.map(|shifted| {
            let low_rank = self.full.low_rank(&self.span.metric.here);
            let weights = low_rank.stiffness.clone();
            shifted.couple::<f64>(&low_rank, weights, false)
        });
        // Estimates take unrefined solves. A refined one fails unless corrections are at most a quarter of the solution.
        if let Some(coupled) = coupled.as_ref().filter(|coupled| coupled.is_single()) {
            let b = random_block(self.full.dimension(), 1, 5);
            coupled.solve(b.as_ref(), |x| self.span.metric.times(x)).map_err(|stalled| failed(stalled.reason()))?;
        }
        let factor =
            match &self.pencil {
                Some(pencil) => Some(definite(self.solver.engine(), pencil, sigma)?.ok_or_else(|| {
                    failed("the symmetric stiffness with its shift is not positive definite".to_owned())
                })?),
                None => None,
            };
        let inverse = |mut b: Mat<f64>| match (&coupled, &factor) {
            // Estimates need one digit; the solve above showed that the factors have it.
            (Some(coupled), _) => Ok(coupled.solve_unrefined(b.as_ref())),
            (None, Some(factor)) => {
                factor.solve(&mut b, false)?;
                Ok(b)
            }
            (None, None) => unreachable!("a model without parts has a pencil"),
        };
        let mut worst: Option<(OperatingPoint, Estimates, f64)> = None;
        let this = &*self;
        // As many spectra are in memory as there are threads.
        for (chunk, points_of_chunk) in points.chunks(threads_for(points.len())).enumerate() {
            let done = chunk * threads_for(points.len());
            progress(ParametricStep::Estimating { done, of: points.len() });
            let spectra = on_points(model, points_of_chunk, &|solver, point| {
                solver.solve(model, point, Vectors::Both).map_err(solve_failed)
            })?;
            // Products with parts and solves with their factors share the cores themselves.
            let estimators = if this.pencil.is_some() { ESTIMATORS } else { 1 };
            let mut threads = vec![(); threads_for(spectra.len()).min(estimators)];
            let estimates = on_threads(&mut threads, &spectra, &mut |()| (), &|(), spectrum, _| {
                this.estimates(&inverse, projected, spectrum)
            })?;
            for (point, estimates) in points_of_chunk.iter().zip(estimates) {
                let largest = estimates.iter().map(|(_, estimate)| *estimate).fold(0.0, f64::max);
                if worst.as_ref().is_none_or(|(_, _, before)| largest > *before) {
                    worst = Some((*point, estimates, largest));
                }
            }
        }
        Ok(worst)
    }

    /// Indices of the counted roots of a spectrum.
    pub fn counted(&self, spectrum: &Spectrum) -> Vec<usize> {
        (0..spectrum.roots.len()).filter(|&k| self.request.counted.counts(spectrum.roots[k].lambda)).collect()
    }

    /// Error estimate of every counted reduced root.
    fn estimates(
        &self,
        inverse: &Inverse<'_>,
        projected: &Projected,
        spectrum: &Spectrum,
    ) -> Result<Estimates, ReductionError> {
        let wanted = self.counted(spectrum);
        let mut norms: [Vec<f64>; 2] = [vec![], vec![]];
        for (left, (norms, shapes)) in norms.iter_mut().zip([&spectrum.shapes, &spectrum.left]).enumerate() {
            for roots in wanted.chunks(ROOTS_TOGETHER) {
                norms.extend(self.residual_norms(inverse, projected, spectrum, shapes, roots, left == 1)?);
            }
        }
        let estimate = |(j, &k): (usize, &usize)| {
            let lambda = spectrum.roots[k].lambda;
            (lambda, norms[0][j] * norms[1][j] / (slope(spectrum, k).norm() * lambda.norm()))
        };
        Ok(wanted.iter().enumerate().map(estimate).collect())
    }

    /// `S⁻¹`-norms of the residuals `Q V z` or, for left vectors, `Qᴴ V w`, one per root.
    fn residual_norms(
        &self,
        inverse: &Inverse<'_>,
        projected: &Projected,
        spectrum: &Spectrum,
        shapes: &Mat<c64>,
        roots: &[usize],
        left: bool,
    ) -> Result<Vec<f64>, ReductionError> {
        let (size, here) = (projected.omega_squared.len(), spectrum.situation());
        // Real and imaginary parts.
        let parts = Mat::from_fn(size, 2 * roots.len(), |i, j| {
            let value = shapes[(i, roots[j / 2])];
            if j % 2 == 0 { value.re } else { value.im }
        });
        let vectors = &projected.basis * &parts;
        let of_mass = self.full.mass_times(vectors.as_ref());
        let of_damping = self.full.damping_times(&here, vectors.as_ref(), left);
        let mut residuals = self.full.stiffness_times(&here, vectors.as_ref(), left);
        for (j, &k) in roots.iter().enumerate() {
            // yᴴ Q = (Qᴴ y)ᴴ.
            let lambda = if left { spectrum.roots[k].lambda.conj() } else { spectrum.roots[k].lambda };
            for i in 0..residuals.nrows() {
                let at = |matrix: &Mat<f64>| c64::new(matrix[(i, 2 * j)], matrix[(i, 2 * j + 1)]);
                let value = lambda * (lambda * at(&of_mass) + at(&of_damping)) + at(&residuals);
                residuals[(i, 2 * j)] = value.re;
                residuals[(i, 2 * j + 1)] = value.im;
            }
        }
        let solved = inverse(residuals.clone())?;
        let square = |j: usize| residuals.col(j).transpose() * solved.col(j);
        // A negative square is a rounding error. NaN becomes infinity, because taking a maximum would ignore NaN.
        let size = |square: f64| if square.is_nan() { f64::INFINITY } else { square.max(0.0).sqrt() };
        Ok((0..roots.len()).map(|j| size(square(2 * j) + square(2 * j + 1))).collect())
    }
}

fn failed(reason: String) -> ReductionError {
    ReductionError::Factorisation { what: "parametric basis".to_owned(), reason }
}
