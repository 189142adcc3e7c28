//! Greedy sampling: the full model is solved at the point with the largest error estimate, and its right and left
//! vectors extend the span.

use faer::c64;

use super::super::full_model::{FullModel, Projected};
use super::super::matching::Counted;
use super::super::pencil::Pencil;
use super::super::{FullSolver, FullSpectrum, FullVectors, ReductionError, on_threads, threads_for};
use super::condition::Condition;
use super::request::{ParametricRequest, ParametricStep};
use super::span::Span;
use crate::physics::{Model, OperatingPoint, SolveError, Solver, Spectrum, Vectors};

/// Fraction of the tolerance that the estimate must meet at training points, so that held-out points meet the
/// tolerance.
const TRAINING_SHARE: f64 = 0.3;
/// Factor on the end of the band up to which vectors are taken: roots slightly beyond it may enter the band elsewhere
/// in the box.
pub const BAND_MARGIN: f64 = 1.02;
/// Factor on a negative growth floor down to which vectors are taken, for the same reason.
const FLOOR_MARGIN: f64 = 1.5;
/// A vector is not added if its component outside the span is below this times the square root of the tolerance.
const NEGLIGIBLE: f64 = 0.1;
/// Largest number of threads that compute residuals, each with memory of its own.
pub const ESTIMATORS: usize = 4;
/// Number of roots whose residuals a thread computes at a time.
pub const ROOTS_TOGETHER: usize = 8;
/// Number of copies of their columns held meanwhile: the vectors, three products in two memory layouts, two of the
/// residuals, and three during the solve.
const ESTIMATING: usize = 12;

/// Reduced roots, each with the estimate of its relative error `|Δλ|/|λ|`.
pub type Estimates = Vec<(c64, f64)>;

/// A parametric basis under construction.
pub struct Building<'a, 'm> {
    pub full: &'a FullModel,
    pub solver: &'a mut FullSolver<'m>,
    pub request: &'a ParametricRequest,
    /// Factorises `S` for models that are not just parts joined by contact; `None` for those that are.
    pub pencil: Option<Pencil<'a>>,
    /// Estimated number of roots in the band.
    pub most_roots: usize,
    pub span: Span<'a>,
    pub sampled: Vec<OperatingPoint>,
    pub true_over_estimate: f64,
}

impl Building<'_, '_> {
    pub fn model(&self, projected: &Projected) -> Result<Model, ReductionError> {
        projected.model(self.full.contact_law).map_err(|error| solve_failed(error.into()))
    }

    /// Checks the memory limit for one more sample; returns the bytes needed in all.
    ///
    /// A sample adds four columns per root: real and imaginary parts of the right and the left vector. During a solve
    /// of the full model or an estimate, memory holds the span, the basis of the reduced model and, while the latter is
    /// computed, a copy. Adding columns takes five copies of them and a second copy of the span, which grows by
    /// reallocation. The truncation takes the span, the basis of the reduced model and two candidate bases.
    pub fn make_room(&mut self) -> Result<usize, ReductionError> {
        let column = size_of::<f64>() * self.full.dimension();
        let columns = 4 * self.most_roots;
        let span = self.span.size() + columns;
        let extended = self.span.columns_held(columns);
        let estimators = if self.pencil.is_some() { threads_for(ESTIMATORS) } else { 1 };
        let estimated = 2 * span + estimators * ESTIMATING * 4 * ROOTS_TOGETHER;
        let (held_by_caller, other) = (3 * span * column, (4 * span).max(extended).max(estimated) * column);
        self.solver.make_room(FullVectors::Both, self.most_roots, held_by_caller, other)
    }

    /// Solves the full model at `point` and adds its vectors to the span. `estimates` are the reduced roots at that
    /// point with their error estimates, if known; they calibrate the estimate.
    pub fn sample(
        &mut self,
        point: OperatingPoint,
        estimates: Option<&[(c64, f64)]>,
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<(), ReductionError> {
        self.make_room()?;
        progress(ParametricStep::Sampling { point, sample: self.sampled.len() + 1 });
        let band_rad_s = self.wanted().band_rad_s;
        let report = &mut |step| progress(ParametricStep::Solving(step));
        let spectrum = self.solver.roots(&point, band_rad_s, FullVectors::Both, report)?;
        self.take(point, spectrum, estimates, progress)
    }

    /// Samples several `points`, at once if the solvers do not share the cores themselves and memory allows it.
    pub fn sample_all(
        &mut self,
        points: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<(), ReductionError> {
        let apart = self.pencil.is_some() && !self.solver.engine().foreign();
        let spectra = if apart { self.spectra(points, progress) } else { Ok(vec![]) };
        match spectra {
            Ok(spectra) if spectra.len() == points.len() => {
                let mut found = points.iter().zip(spectra);
                found.try_for_each(|(&point, spectrum)| self.take(point, spectrum, None, progress))
            }
            Ok(_) | Err(ReductionError::Memory { .. }) => {
                points.iter().try_for_each(|&point| self.sample(point, None, progress))
            }
            Err(error) => Err(error),
        }
    }

    /// The spectra at `points` with their vectors, each thread solving at some of them.
    fn spectra(
        &mut self,
        points: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Vec<FullSpectrum>, ReductionError> {
        self.make_room()?;
        let (n, roots, band_rad_s) = (self.full.dimension(), self.most_roots, self.wanted().band_rad_s);
        let held = points.len() * 2 * roots * n * size_of::<c64>();
        for (index, &point) in points.iter().enumerate() {
            progress(ParametricStep::Sampling { point, sample: self.sampled.len() + 1 + index });
        }
        let is_of_memory = |error: &ReductionError| matches!(error, ReductionError::Memory { .. });
        self.solver.for_threads(threads_for(points.len()), is_of_memory, |solvers| {
            for solver in &mut *solvers {
                solver.make_room(FullVectors::Both, roots, held, 0)?;
            }
            on_threads(solvers, points, progress, &|solver, point, report| {
                let report = &mut |step| report(ParametricStep::Solving(step));
                solver.roots(point, band_rad_s, FullVectors::Both, report)
            })
        })
    }

    /// Roots whose vectors are taken.
    fn wanted(&self) -> Counted {
        let counted = self.request.counted;
        Counted {
            band_rad_s: BAND_MARGIN * counted.band_rad_s,
            growth_floor_per_s: counted.growth_floor_per_s - (FLOOR_MARGIN - 1.0) * counted.growth_floor_per_s.abs(),
        }
    }

    /// Adds the vectors of a sample to the span.
    fn take(
        &mut self,
        point: OperatingPoint,
        spectrum: FullSpectrum,
        estimates: Option<&[(c64, f64)]>,
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<(), ReductionError> {
        let wanted = self.wanted();
        let roots: Vec<c64> = spectrum.roots.iter().map(|root| root.lambda).collect();
        let chosen: Vec<usize> = (0..roots.len()).filter(|&k| wanted.counts(roots[k])).collect();
        let counting: Vec<c64> = chosen.iter().map(|&k| roots[k]).collect();
        let mut ratio = f64::NAN;
        for (reduced, estimate) in estimates.unwrap_or_default() {
            let nearest =
                counting.iter().map(|root| (root - reduced).norm() / root.norm()).fold(f64::INFINITY, f64::min);
            // Errors at the level of rounding, and wrong pairs, do not calibrate the estimate.
            if nearest > 1e-11 && nearest < 1e-2 && *estimate > 0.0 {
                ratio = ratio.max(nearest / estimate);
            }
        }
        self.most_roots = self.most_roots.max(chosen.len());
        self.span.add(spectrum, &chosen, NEGLIGIBLE * self.request.tolerance.sqrt())?;
        if ratio.is_finite() {
            self.true_over_estimate = self.true_over_estimate.max(ratio);
        }
        self.sampled.push(point);
        progress(ParametricStep::Sampled {
            roots: counting.len(),
            vectors: self.span.size(),
            true_over_estimate: ratio,
        });
        Ok(())
    }

    /// Samples points until the scaled estimate holds at all training points; returns the model projected on the whole
    /// span.
    pub fn enrich(
        &mut self,
        training: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Projected, ReductionError> {
        loop {
            let projected = self.full.project(self.span.vectors.as_ref())?;
            let model = self.model(&projected)?;
            let points: Vec<OperatingPoint> =
                training.iter().filter(|point| !self.sampled.contains(point)).copied().collect();
            let worst = self.worst_estimate(&model, &projected, &points, progress)?;
            let Some((point, estimates, largest)) = worst else { return Ok(projected) };
            let scaled = largest * self.true_over_estimate;
            progress(ParametricStep::Estimated { worst: scaled, vectors: self.span.size() });
            if scaled <= TRAINING_SHARE * self.request.tolerance {
                return Ok(projected);
            }
            if self.sampled.len() == self.request.most_samples {
                return Err(ReductionError::Tolerance {
                    what: "parametric basis (estimated)".to_owned(),
                    value: scaled,
                    limit: TRAINING_SHARE * self.request.tolerance,
                    vectors: self.span.size(),
                    samples: self.sampled.len(),
                });
            }
            drop(projected);
            self.sample(point, Some(&estimates), progress)?;
        }
    }

    /// The `count` of `points` at which a counted root of the `wide` model changes most, relative to itself, with the
    /// matrices: where two roots merge, and where a frequency goes to zero.
    pub fn most_sensitive(
        &self,
        wide: &Projected,
        points: &[OperatingPoint],
        count: usize,
    ) -> Result<Vec<OperatingPoint>, ReductionError> {
        let model = self.model(wide)?;
        let mut ranked = on_points(&model, points, &|solver, point| {
            let spectrum = solver.solve(&model, point, Vectors::Both).map_err(solve_failed)?;
            let conditions = self.counted(&spectrum).into_iter().map(|root| Condition::of(&spectrum, root).relative);
            Ok((conditions.fold(0.0, f64::max), *point))
        })?;
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        Ok(ranked.into_iter().take(count).map(|(_, point)| point).collect())
    }
}

/// Work on one item, with a dense solver of its thread.
type AtPoint<'a, T, R> = dyn Fn(&mut Solver, &T) -> Result<R, ReductionError> + Sync + 'a;

/// Applies `work` to all items, each thread with a solver of the size of `model`. Results are in the order of the items.
pub fn on_points<T: Sync, R: Send>(
    model: &Model,
    items: &[T],
    work: &AtPoint<'_, T, R>,
) -> Result<Vec<R>, ReductionError> {
    let mut solvers: Vec<Solver> = (0..threads_for(items.len())).map(|_| Solver::new(model.dimension())).collect();
    on_threads(&mut solvers, items, &mut |()| (), &|solver, item, _| work(solver, item))
}

/// The roots with `ω > 0`, and static ones that grow.
pub fn comparable(roots: impl Iterator<Item = c64>) -> Vec<c64> {
    roots.filter(|lambda| lambda.im > 0.0 || lambda.im == 0.0 && lambda.re > 0.0).collect()
}

/// Those of a reduced model. Of an undamped one, a growing static root stands for a decaying one too.
pub fn comparable_of(spectrum: &Spectrum) -> Vec<c64> {
    comparable(spectrum.roots.iter().map(|root| root.lambda))
}

pub fn solve_failed(source: SolveError) -> ReductionError {
    ReductionError::Solve { what: "parametric basis".to_owned(), source: Box::new(source) }
}
