//! A parametric basis: tens of vectors on which a reduced model keeps the roots of the full model over a whole box of
//! operating points.
//!
//! ```text
//! Q(λ, p) = λ² M + λ C(p) + K(p),   Q x = 0,   yᴴ Q = 0
//! V = span{Re x, Im x, Re y, Im y at sampled points},   Vᵀ Q(λ, p) V z = 0,   wᴴ Vᵀ Q(λ, p) V = 0
//! |Δλ| ≈ |(V w)-residual|_S⁻¹ |(V z)-residual|_S⁻¹ / |wᴴ Vᵀ Q' V z|,   S = sym K + σ M
//! ```
//!
//! With right and left eigenvectors in the span, the error of a root is of second order: the product of the right and
//! the left residual. The basis is built in three steps:
//!
//! 1. Greedy sampling. The full model is solved at the training point with the largest error estimate, and its vectors
//!    are added. The estimate is scaled by the largest ratio of true error to estimate observed so far.
//! 2. Truncation. A singular value decomposition of the sampled vectors, in the norm of `S`, is cut to the fewest
//!    leading vectors that hold the tolerance at all training points. Each vector is scaled so that an omitted
//!    component counts by the change of the root that it causes.
//! 3. Validation. At held-out points all roots of the full model are compared with those of the reduced one. A point
//!    that fails becomes a sample, and new held-out points are drawn.
//!
//! Load-dependent contact stiffness is a term like any other, and load is sampled like friction. Splitting every vector
//! into one per substructure would make the basis valid for any contact stiffness, but needs more vectors. Example: a
//! tribometer of 5049 degrees of freedom, friction coefficients of 0 to 1, loads of 50 to 2000 N, exponent 1/3,
//! tolerance 1e-6, four sampled points each. Unsplit vectors: 69, error 1.4e-7 at the held-out points. Split vectors:
//! 93, error 2.8e-7.
//!
//! # Source
//! Gräbner, Mehrmann, Quraishi, Schröder, von Wagner, "Numerical methods for parametric model reduction in the
//! simulation of disk brake squeal", ZAMM 96 (2016) 1388-1405 (right vectors); Benner, Gugercin, Willcox, "A survey of
//! projection-based model reduction methods for parametric dynamical systems", SIAM Review 57 (2015) 483-531 (greedy).

use faer::linalg::solvers::Solve;
use faer::{Mat, MatRef, c64};

use super::dense::symmetric_eigen;
use super::full_model::{FullModel, Projected};
use super::matching::{Counted, RootMatch, match_roots};
use super::operating_box::OperatingBox;
use super::pencil::Pencil;
use super::sparse::{SparseMatrix, transposed};
use super::{FullProgress, FullSolver, FullSpectrum, FullVectors, ReductionError, weighted_sum};
use crate::physics::{Model, OperatingPoint, Solver, Spectrum, Vectors};

/// Fraction of the tolerance that the estimate must meet at training points, so that held-out points meet the
/// tolerance.
const TRAINING_SHARE: f64 = 0.3;
/// Factor on the end of the band up to which vectors are taken: roots slightly beyond it may enter the band elsewhere
/// in the box.
const BAND_MARGIN: f64 = 1.02;
/// Factor on a negative growth floor down to which vectors are taken, for the same reason.
const FLOOR_MARGIN: f64 = 1.5;
/// A vector is not added if its component outside the span is below this times the square root of the tolerance.
const NEGLIGIBLE: f64 = 0.01;
/// Components of a vector below this, relative to its length, are rounding errors: the square root of the resolution of
/// a Gram matrix.
const ROUNDED: f64 = 1e-7;
/// Square root of the shift `σ` of `S`, relative to the end of the band. The shift only makes `S` definite where the
/// model has rigid-body modes.
const SHIFT: f64 = 0.05;
/// Number of columns multiplied with `S` at a time.
const TOGETHER: usize = 16;
/// Number of roots whose residuals are computed at a time.
const ROOTS_TOGETHER: usize = 8;
/// Number of copies of their columns held meanwhile: the vectors, three products in two memory layouts, two of the
/// residuals, and three during the solve.
const ESTIMATING: usize = 12;
/// Largest number of rounds of validation.
const MOST_ROUNDS: usize = 4;

/// Requirements of a parametric basis.
#[derive(Clone, Debug)]
pub struct ParametricRequest {
    /// Box of operating points over which the basis must be valid.
    pub range: OperatingBox,
    /// Which roots must meet the tolerance.
    pub counted: Counted,
    /// Largest `|Δλ|/|λ|` of a counted root.
    pub tolerance: f64,
    /// Number of training points, at which the error is estimated, in addition to the corners and the middle of the
    /// box.
    pub training: usize,
    /// Number of held-out points for validation.
    pub held_out: usize,
    /// Largest number of sampled points.
    pub most_samples: usize,
    /// Largest number of vectors in the basis.
    pub most_vectors: usize,
}

/// Progress of the construction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ParametricStep {
    /// Estimated bytes needed in addition to the memory in use before the solver was made.
    Planned {
        /// The bytes.
        bytes: usize,
    },
    /// Progress of a solve of the full model.
    Solving(FullProgress),
    /// The error has been estimated at `done` of `of` training points.
    Estimating {
        /// Number of points done.
        done: usize,
        /// Number of points in all.
        of: usize,
    },
    /// A solve of the full model at a sampled point starts.
    Sampling {
        /// The sampled point.
        point: OperatingPoint,
        /// Its number, from 1.
        sample: usize,
    },
    /// The sampled point has `roots` roots within band and growth floor, margins included, and the span now has
    /// `vectors` vectors. `true_over_estimate` is the largest ratio of true error to estimate at this point; NaN
    /// without estimates.
    Sampled {
        /// Number of roots.
        roots: usize,
        /// Number of vectors of the span.
        vectors: usize,
        /// Largest ratio of true error to estimate.
        true_over_estimate: f64,
    },
    /// The error has been estimated at all training points. `worst` is the largest scaled estimate of `|Δλ|/|λ|`.
    Estimated {
        /// Largest estimate, relative.
        worst: f64,
        /// Number of vectors of the span.
        vectors: usize,
    },
    /// A basis of `vectors` leading vectors has the error `worst` at the training points.
    Cut {
        /// Number of vectors kept.
        vectors: usize,
        /// Largest estimate with them, relative.
        worst: f64,
    },
    /// A held-out point, the `done`th of `of`, was solved and compared.
    HeldOut {
        /// The held-out point.
        point: OperatingPoint,
        /// Largest error there, relative.
        worst: f64,
        /// Number of points done.
        done: usize,
        /// Number of points in all.
        of: usize,
    },
}

/// A held-out point and its comparison of full and reduced roots.
#[derive(Clone, Debug)]
pub struct HeldOut {
    /// The operating point.
    pub point: OperatingPoint,
    /// Full and reduced roots, paired.
    pub comparison: RootMatch,
}

/// A parametric basis and its validation.
#[derive(Clone, Debug)]
pub struct ParametricBasis {
    /// The full model projected on the basis.
    pub projected: Projected,
    /// Points at which the full model was solved for vectors.
    pub sampled: Vec<OperatingPoint>,
    /// Validation at the held-out points.
    pub held_out: Vec<HeldOut>,
    /// Largest observed ratio of true error to estimate, at least 1.
    pub true_over_estimate: f64,
}

impl ParametricBasis {
    /// Largest `|Δλ|/|λ|` at the held-out points; infinite if a root was missed or invented.
    pub fn worst(&self) -> f64 {
        self.held_out.iter().map(|held| held.comparison.worst()).fold(0.0, f64::max)
    }
}

/// Builds a parametric basis of `full`; `solver` is a solver of the same model.
///
/// # Errors
/// [`ReductionError`]: `Range`; `Tolerance` if the tolerance cannot be held within the limits of the request; those of
/// the solves.
pub fn parametric_basis(
    full: &FullModel,
    solver: &mut FullSolver<'_>,
    request: &ParametricRequest,
    progress: &mut dyn FnMut(ParametricStep),
) -> Result<ParametricBasis, ReductionError> {
    request.range.check()?;
    let most_roots = solver.count_below(BAND_MARGIN * request.counted.band_rad_s)?;
    let metric = Metric::new(full, request);
    let assembled = if solver.has_parts() { None } else { Some(metric.assembled()?) };
    let pencil = assembled.as_ref().map(|[mass, stiffness]| Pencil::new("full model", mass, stiffness)).transpose()?;
    let mut build = Building {
        full,
        solver,
        request,
        metric,
        pencil,
        most_roots,
        span: Mat::zeros(full.dimension(), 0),
        snapshots: vec![],
        sampled: vec![],
        known: vec![],
        true_over_estimate: 1.0,
    };
    let planned = build.make_room()?;
    progress(ParametricStep::Planned { bytes: planned });
    let mut corners = request.range.corners_and_middle();
    let middle = corners.pop().expect("a middle");
    let opposite = corners.last().copied().unwrap_or(middle);
    for point in [middle, opposite] {
        build.sample(point, None, progress)?;
    }
    let mut first = 0;
    let mut training: Vec<OperatingPoint> = corners;
    training.extend(request.range.spread(first, request.training));
    first += request.training;
    let failed = |value: f64, vectors: usize, samples: usize| ReductionError::Tolerance {
        what: "parametric basis".to_owned(),
        value,
        limit: request.tolerance,
        vectors,
        samples,
    };
    let mut last = f64::INFINITY;
    for _ in 0..MOST_ROUNDS {
        let wide = build.enrich(&training, progress)?;
        let projected = build.cut(&wide, &training, progress)?;
        drop(wide);
        let model = build.model(&projected)?;
        let mut held_out = vec![];
        let mut worst = 0.0_f64;
        for point in request.range.spread(first, request.held_out) {
            let band_rad_s = BAND_MARGIN * request.counted.band_rad_s;
            let report = &mut |step| progress(ParametricStep::Solving(step));
            let full = build.solver.roots(&point, band_rad_s, FullVectors::None, report)?;
            let roots = full.roots.iter().map(|root| root.lambda).filter(|lambda| lambda.im > 0.0).collect::<Vec<_>>();
            let reduced = oscillating(&build.solve(&model, &point, Vectors::None)?);
            let comparison = match_roots(&roots, &reduced, request.counted);
            worst = worst.max(comparison.worst());
            let (done, of, worst) = (held_out.len() + 1, request.held_out, comparison.worst());
            progress(ParametricStep::HeldOut { point, worst, done, of });
            held_out.push(HeldOut { point, comparison });
        }
        first += request.held_out;
        if worst <= request.tolerance {
            let (sampled, true_over_estimate) = (build.sampled, build.true_over_estimate);
            return Ok(ParametricBasis { projected, sampled, held_out, true_over_estimate });
        }
        last = worst;
        for held in held_out.iter().filter(|held| held.comparison.worst() > request.tolerance) {
            if build.sampled.len() == request.most_samples {
                return Err(failed(worst, projected.omega_squared.len(), build.sampled.len()));
            }
            build.sample(held.point, None, progress)?;
        }
    }
    Err(failed(last, build.span.ncols(), build.sampled.len()))
}

/// The metric `S = sym K + σ M` at the middle of the box, without friction.
struct Metric<'a> {
    full: &'a FullModel,
    middle: OperatingPoint,
    sigma: f64,
}

impl<'a> Metric<'a> {
    fn new(full: &'a FullModel, request: &ParametricRequest) -> Self {
        let middle = request.range.at([0.5; 3]).with_friction(0.0);
        Self { full, middle, sigma: (SHIFT * request.counted.band_rad_s).powi(2) }
    }

    /// `M` and `sym K`.
    fn assembled(&self) -> Result<[SparseMatrix; 2], ReductionError> {
        let [mass, _, stiffness] = self.full.matrices_at(&self.middle)?;
        let symmetric = weighted_sum(self.full.dimension(), &[(0.5, &stiffness), (0.5, &transposed(&stiffness)?)])?;
        Ok([mass, symmetric])
    }

    fn times(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        let mut product = Mat::zeros(x.nrows(), x.ncols());
        for first in (0..x.ncols()).step_by(TOGETHER) {
            let columns = TOGETHER.min(x.ncols() - first);
            let x = x.subcols(first, columns);
            let mut sum = faer::Scale(self.sigma) * self.full.mass_times(x);
            for transposed in [false, true] {
                sum += faer::Scale(0.5) * self.full.stiffness_times(&self.middle, x, transposed);
            }
            product.subcols_mut(first, columns).copy_from(sum);
        }
        product
    }

    /// `Xᵀ S X`, exactly symmetric.
    fn gram(&self, x: &Mat<f64>) -> Mat<f64> {
        let gram = x.transpose() * self.times(x.as_ref());
        Mat::from_fn(gram.nrows(), gram.ncols(), |i, j| 0.5 * (gram[(i, j)] + gram[(j, i)]))
    }
}

/// `S⁻¹ B`.
type Inverse<'a> = dyn Fn(Mat<f64>) -> Mat<f64> + 'a;

fn failed(reason: String) -> ReductionError {
    ReductionError::Factorisation { what: "parametric basis".to_owned(), reason }
}

/// The roots with `ω > 0`.
fn oscillating(spectrum: &Spectrum) -> Vec<c64> {
    spectrum.modes().iter().map(|root| root.lambda).collect()
}

/// Reduced roots, each with the estimate of its relative error `|Δλ|/|λ|`.
type Estimates = Vec<(c64, f64)>;

struct Building<'a, 'm> {
    full: &'a FullModel,
    solver: &'a mut FullSolver<'m>,
    request: &'a ParametricRequest,
    metric: Metric<'a>,
    /// Factorises `S` for models that are not just parts joined by contact; `None` for those that are.
    pencil: Option<Pencil<'a>>,
    /// Estimated number of roots in the band.
    most_roots: usize,
    /// `S`-orthonormal vectors, `n×r`.
    span: Mat<f64>,
    /// Coefficients in `span` of the vectors of each sampled point, one block per point. Rows of vectors that joined
    /// the span later are absent and count as 0.
    snapshots: Vec<Mat<f64>>,
    sampled: Vec<OperatingPoint>,
    /// All oscillating roots in the band at the sampled points.
    known: Vec<(OperatingPoint, Vec<c64>)>,
    true_over_estimate: f64,
}

impl Building<'_, '_> {
    fn model(&self, projected: &Projected) -> Result<Model, ReductionError> {
        projected.model(self.full.contact_law).map_err(|error| solve_failed(error.into()))
    }

    fn solve(&self, model: &Model, p: &OperatingPoint, vectors: Vectors) -> Result<Spectrum, ReductionError> {
        Solver::new(model.dimension()).solve(model, p, vectors).map_err(solve_failed)
    }

    /// Checks the memory limit for one more sample; returns the bytes needed in all.
    ///
    /// A sample adds four columns per root: real and imaginary parts of the right and the left vector. During a solve
    /// of the full model or an estimate, memory holds the span, the basis of the reduced model and, while the latter is
    /// computed, a copy. Adding columns takes five copies of them and a second copy of the span, which grows by
    /// reallocation. The truncation takes the span, the basis of the reduced model and two candidate bases.
    fn make_room(&mut self) -> Result<usize, ReductionError> {
        let column = size_of::<f64>() * self.full.dimension();
        let columns = 4 * self.most_roots;
        let span = self.span.ncols() + columns;
        let extended = 2 * span + 5 * columns;
        let estimated = 2 * span + ESTIMATING * 4 * ROOTS_TOGETHER;
        let (held_by_caller, other) = (3 * span * column, (4 * span).max(extended).max(estimated) * column);
        self.solver.make_room(FullVectors::Both, self.most_roots, held_by_caller, other)
    }

    /// Solves the full model at `point` and adds its vectors to the span. `estimates` are the reduced roots at that
    /// point with their error estimates, if known; they calibrate the estimate.
    fn sample(
        &mut self,
        point: OperatingPoint,
        estimates: Option<&[(c64, f64)]>,
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<(), ReductionError> {
        let counted = self.request.counted;
        self.make_room()?;
        progress(ParametricStep::Sampling { point, sample: self.sampled.len() + 1 });
        let wanted = Counted {
            band_rad_s: BAND_MARGIN * counted.band_rad_s,
            growth_floor_per_s: counted.growth_floor_per_s - (FLOOR_MARGIN - 1.0) * counted.growth_floor_per_s.abs(),
        };
        let report = &mut |step| progress(ParametricStep::Solving(step));
        let spectrum = self.solver.roots(&point, wanted.band_rad_s, FullVectors::Both, report)?;
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
        let columns = self.columns(&point, &spectrum, &chosen);
        drop(spectrum);
        self.extend(columns)?;
        if ratio.is_finite() {
            self.true_over_estimate = self.true_over_estimate.max(ratio);
        }
        self.sampled.push(point);
        self.known.push((point, roots.into_iter().filter(|lambda| lambda.im > 0.0).collect()));
        progress(ParametricStep::Sampled {
            roots: counting.len(),
            vectors: self.span.ncols(),
            true_over_estimate: ratio,
        });
        Ok(())
    }

    /// Real and imaginary parts of right and left vectors, `n×(4·chosen)`. They are scaled so that a component `d`
    /// omitted from both moves the root by about `dᵀ S d` times `|λ|`.
    fn columns(&self, p: &OperatingPoint, spectrum: &FullSpectrum, chosen: &[usize]) -> Mat<f64> {
        let n = self.full.dimension();
        let mut columns = Mat::<f64>::zeros(n, 4 * chosen.len());
        for (k, &root) in chosen.iter().enumerate() {
            let lambda = spectrum.roots[root].lambda;
            // Real and imaginary parts of x, then of y.
            let of_root = Mat::<f64>::from_fn(n, 4, |i, j| {
                let value = if j < 2 { spectrum.right[(i, root)] } else { spectrum.left[(i, root)] };
                if j % 2 == 0 { value.re } else { value.im }
            });
            let of_mass = self.full.mass_times(of_root.as_ref());
            let of_damping = self.full.damping_times(p, of_root.as_ref(), false);
            let at = |m: &Mat<f64>, i: usize, side: usize| c64::new(m[(i, 2 * side)], m[(i, 2 * side + 1)]);
            let slope: c64 = (0..n)
                .map(|i| at(&of_root, i, 1).conj() * (lambda * 2.0 * at(&of_mass, i, 0) + at(&of_damping, i, 0)))
                .sum();
            let length = |side: usize| -> f64 {
                (0..n).map(|i| (at(&of_root, i, side).conj() * at(&of_mass, i, side)).re).sum::<f64>().sqrt()
            };
            let lengths = [length(0), length(1)];
            // `|y|_M |x|_M / |yᴴ Q' x|` is `1/(2|λ|)` for a real mode and unbounded where two roots merge, hence the
            // cap.
            let condition = (lengths[0] * lengths[1] / (slope.norm() * lambda.norm())).sqrt().min(10.0 / lambda.norm());
            for (side, length) in lengths.into_iter().enumerate() {
                let scaled = faer::Scale(condition / length) * of_root.subcols(2 * side, 2);
                columns.subcols_mut(4 * k + 2 * side, 2).copy_from(scaled);
            }
        }
        columns
    }

    /// Extends the span by the components of `columns` outside it, and stores the coefficients of `columns`.
    fn extend(&mut self, columns: Mat<f64>) -> Result<(), ReductionError> {
        let held = self.span.ncols();
        let mut coefficients = Mat::<f64>::zeros(held, columns.ncols());
        let mut rest = columns;
        for _ in 0..2 {
            let step = self.span.transpose() * self.metric.times(rest.as_ref());
            rest -= &self.span * &step;
            coefficients += step;
        }
        let weighted = self.metric.times(rest.as_ref());
        let gram = rest.transpose() * &weighted;
        let gram = Mat::from_fn(gram.nrows(), gram.ncols(), |i, j| 0.5 * (gram[(i, j)] + gram[(j, i)]));
        let (squares, vectors) = symmetric_eigen("parametric basis", gram.as_ref())?;
        let least = (NEGLIGIBLE * self.request.tolerance.sqrt()).max(ROUNDED);
        let kept: Vec<usize> = (0..squares.len()).rev().filter(|&k| squares[k] > least * least).collect();
        if kept.is_empty() {
            self.snapshots.push(coefficients);
            return Ok(());
        }
        let turn = Mat::from_fn(vectors.nrows(), kept.len(), |i, k| vectors[(i, kept[k])] / squares[kept[k]].sqrt());
        let mut added = &rest * &turn;
        drop(rest);
        // The Gram matrix leaves rounding errors of orthogonality; two passes remove them.
        for _ in 0..2 {
            let step = self.span.transpose() * self.metric.times(added.as_ref());
            added -= &self.span * &step;
            let gram = self.metric.gram(&added);
            super::whiten("parametric basis", gram.as_ref())?.right(&mut added);
        }
        let more = added.transpose() * &weighted;
        let all = Mat::from_fn(held + kept.len(), coefficients.ncols(), |i, j| {
            if i < held { coefficients[(i, j)] } else { more[(i - held, j)] }
        });
        self.snapshots.push(all);
        drop(weighted);
        let before = std::mem::replace(&mut self.span, Mat::new());
        self.span = hstack(before.as_ref(), added.as_ref());
        Ok(())
    }

    /// Samples points until the scaled estimate holds at all training points; returns the model projected on the whole
    /// span.
    fn enrich(
        &mut self,
        training: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Projected, ReductionError> {
        loop {
            let projected = self.full.project(self.span.as_ref())?;
            let model = self.model(&projected)?;
            let points: Vec<OperatingPoint> =
                training.iter().filter(|point| !self.sampled.contains(point)).copied().collect();
            let worst = self.worst_estimate(&model, &projected, &points, progress)?;
            let Some((point, estimates, largest)) = worst else { return Ok(projected) };
            let scaled = largest * self.true_over_estimate;
            progress(ParametricStep::Estimated { worst: scaled, vectors: self.span.ncols() });
            if scaled <= TRAINING_SHARE * self.request.tolerance {
                return Ok(projected);
            }
            if self.sampled.len() == self.request.most_samples {
                return Err(ReductionError::Tolerance {
                    what: "parametric basis (estimated)".to_owned(),
                    value: scaled,
                    limit: TRAINING_SHARE * self.request.tolerance,
                    vectors: self.span.ncols(),
                    samples: self.sampled.len(),
                });
            }
            drop(projected);
            self.sample(point, Some(&estimates), progress)?;
        }
    }

    /// Point with the largest estimate, all estimates there, and the largest one; `None` without points.
    fn worst_estimate(
        &mut self,
        model: &Model,
        projected: &Projected,
        points: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Option<(OperatingPoint, Estimates, f64)>, ReductionError> {
        let sigma = self.metric.sigma;
        self.solver.factor_at(sigma)?;
        let shifted = self.solver.factors_at(sigma);
        let coupled = shifted.map(|shifted| {
            let low_rank = self.full.low_rank(&self.metric.middle);
            let weights = low_rank.stiffness.clone();
            shifted.couple::<f64>(&low_rank, weights, false)
        });
        let llt =
            match &self.pencil {
                Some(pencil) => Some(pencil.llt(sigma)?.ok_or_else(|| {
                    failed("the symmetric stiffness with its shift is not positive definite".to_owned())
                })?),
                None => None,
            };
        let inverse = |mut b: Mat<f64>| match (&coupled, &llt) {
            (Some(coupled), _) => coupled.solve(b.as_ref()),
            (None, Some(llt)) => {
                llt.solve(b.as_mut());
                b
            }
            (None, None) => unreachable!("a model without parts has a pencil"),
        };
        let mut worst: Option<(OperatingPoint, Estimates, f64)> = None;
        for (done, point) in points.iter().enumerate() {
            progress(ParametricStep::Estimating { done, of: points.len() });
            let spectrum = self.solve(model, point, Vectors::Both)?;
            let estimates = self.estimates(&inverse, projected, &spectrum);
            let largest = estimates.iter().map(|(_, estimate)| *estimate).fold(0.0, f64::max);
            if worst.as_ref().is_none_or(|(_, _, before)| largest > *before) {
                worst = Some((*point, estimates, largest));
            }
        }
        Ok(worst)
    }

    /// Error estimate of every counted reduced root.
    fn estimates(&self, inverse: &Inverse<'_>, projected: &Projected, spectrum: &Spectrum) -> Estimates {
        let counts = |k: &usize| self.request.counted.counts(spectrum.roots[*k].lambda);
        let wanted: Vec<usize> = (0..spectrum.mode_count).filter(counts).collect();
        let norms = [&spectrum.shapes, &spectrum.left].map(|shapes| -> Vec<f64> {
            let left = std::ptr::eq(shapes, &spectrum.left);
            let chunks = wanted.chunks(ROOTS_TOGETHER);
            chunks.flat_map(|roots| self.residual_norms(inverse, projected, spectrum, shapes, roots, left)).collect()
        });
        let estimate = |(j, &k): (usize, &usize)| {
            let lambda = spectrum.roots[k].lambda;
            // Left vectors are normalised to `yᴴ Q' x = 1` for a damped spectrum; for an undamped one `yᴴ Q' x = 2λ`.
            let slope = if spectrum.undamped { 2.0 * lambda.norm() } else { 1.0 };
            (lambda, norms[0][j] * norms[1][j] / (slope * lambda.norm()))
        };
        wanted.iter().enumerate().map(estimate).collect()
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
    ) -> Vec<f64> {
        let (size, p) = (projected.omega_squared.len(), &spectrum.point);
        // Real and imaginary parts.
        let parts = Mat::from_fn(size, 2 * roots.len(), |i, j| {
            let value = shapes[(i, roots[j / 2])];
            if j % 2 == 0 { value.re } else { value.im }
        });
        let vectors = &projected.basis * &parts;
        let of_mass = self.full.mass_times(vectors.as_ref());
        let of_damping = self.full.damping_times(p, vectors.as_ref(), left);
        let mut residuals = self.full.stiffness_times(p, vectors.as_ref(), left);
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
        let solved = inverse(residuals.clone());
        let square = |j: usize| residuals.col(j).transpose() * solved.col(j);
        // A negative square is a rounding error. NaN becomes infinity, because taking a maximum would ignore NaN.
        let size = |square: f64| if square.is_nan() { f64::INFINITY } else { square.max(0.0).sqrt() };
        (0..roots.len()).map(|j| size(square(2 * j) + square(2 * j + 1))).collect()
    }

    /// Projects the model on the fewest leading singular vectors of the snapshots that hold the tolerance at all
    /// training points; the number is found by bisection.
    fn cut(
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

fn solve_failed(source: crate::physics::SolveError) -> ReductionError {
    ReductionError::Solve { what: "parametric basis".to_owned(), source: Box::new(source) }
}

/// `[a b]`.
fn hstack(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Mat<f64> {
    let mut both = Mat::zeros(a.nrows(), a.ncols() + b.ncols());
    both.subcols_mut(0, a.ncols()).copy_from(a);
    both.subcols_mut(a.ncols(), b.ncols()).copy_from(b);
    both
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::ContactLaw;
    use crate::reduction::PartTurning;
    use crate::reduction::test_models::chains;

    const LAW: ContactLaw =
        ContactLaw { exponent: 0.5, reference_n: 500.0, slope_s_per_m: -0.01, lateral_damping: true };

    fn request(tolerance: f64) -> ParametricRequest {
        ParametricRequest {
            range: OperatingBox {
                friction_coefficient: [0.0, 1.0],
                normal_load_n: [100.0, 1000.0],
                disc_speed_rad_s: [5.0, 20.0],
            },
            counted: Counted { band_rad_s: 900.0, growth_floor_per_s: -20.0 },
            tolerance,
            training: 10,
            held_out: 4,
            most_samples: 20,
            most_vectors: 70,
        }
    }

    fn solver(full: &FullModel) -> FullSolver<'_> {
        FullSolver::new("chains", full, None, &mut |_| {}).unwrap()
    }

    /// `|Δλ|` of Newton's step for `det Q(λ) = 0`, `Δλ = -1 / tr(Q⁻¹ Q')`, by dense complex arithmetic.
    fn newton_step(full: &FullModel, p: &OperatingPoint, lambda: c64) -> f64 {
        let [mass, damping, stiffness] = full.matrices_at(p).unwrap().map(|matrix| matrix.to_dense());
        let n = mass.nrows();
        let q = Mat::from_fn(n, n, |i, j| lambda * (lambda * mass[(i, j)] + damping[(i, j)]) + stiffness[(i, j)]);
        let slope = Mat::from_fn(n, n, |i, j| lambda * 2.0 * mass[(i, j)] + damping[(i, j)]);
        let solved = q.partial_piv_lu().solve(&slope);
        1.0 / (0..n).map(|i| solved[(i, i)]).sum::<c64>().norm()
    }

    /// A damped, unsymmetric model over load, speed and friction: every counted root of the reduced model is a root of
    /// `det Q` within the tolerance at the held-out points, with fewer vectors than degrees of freedom.
    #[test]
    fn a_basis_holds_its_tolerance_where_it_was_not_sampled() {
        let full = chains(5.0, LAW);
        let request = request(1e-6);
        let basis = parametric_basis(&full, &mut solver(&full), &request, &mut |_| {}).unwrap();
        let count = basis.projected.omega_squared.len();
        assert!(count < 70, "{count} vectors for {} degrees of freedom", full.dimension());
        assert!(basis.worst() <= 1e-6 && basis.held_out.len() == 4);
        assert!(basis.true_over_estimate < 10.0, "{}", basis.true_over_estimate);
        let model = basis.projected.model(LAW).unwrap();
        for held in &basis.held_out {
            assert!(held.comparison.errors.len() > 5, "{:?}", held.comparison);
            let reduced = Solver::new(count).solve(&model, &held.point, Vectors::None).unwrap();
            for lambda in oscillating(&reduced).into_iter().filter(|lambda| request.counted.counts(*lambda)) {
                let error = newton_step(&full, &held.point, lambda) / lambda.norm();
                // Roots just above the growth floor meet the tolerance too. Newton's step equals the error to first
                // order.
                assert!(error <= 1.1e-6, "{:?} {lambda}: {error:e}", held.point);
            }
        }
    }

    /// The same for a disc that turns, with Rayleigh damping of the pad: rotation shifts the roots by far more than the
    /// tolerance, and its projection stays exactly skew.
    #[test]
    fn a_basis_holds_its_tolerance_over_the_speed_of_a_turning_disc() {
        let mut full = chains(0.0, ContactLaw::default());
        let n = full.parts[1].mass.nrows();
        let triplet = |i: usize, j: usize, value: f64| faer::sparse::Triplet::new(i, j, value);
        let mut entries = [vec![], vec![]];
        for i in 0..n - 1 {
            let value = 1.0 + (i as f64).sin();
            entries[0].extend([triplet(i, i + 1, value), triplet(i + 1, i, -value)]);
            entries[1].push(triplet(i, i, value));
        }
        let [gyroscopic, spin] = entries.map(|list| SparseMatrix::try_new_from_triplets(n, n, &list).ok());
        full.turn(1, &PartTurning { gyroscopic, spin, stress_stiffening: None }).unwrap();
        full.damp(0, 0.5, 1e-7).unwrap();
        let mut request = request(1e-6);
        request.range.disc_speed_rad_s = [1.0, 60.0];
        let basis = parametric_basis(&full, &mut solver(&full), &request, &mut |_| {}).unwrap();
        assert!(basis.worst() <= 1e-6 && basis.projected.omega_squared.len() < 70);
        let model = basis.projected.model(full.contact_law).unwrap();
        let modes =
            |p: &OperatingPoint| oscillating(&Solver::new(model.dimension()).solve(&model, p, Vectors::None).unwrap());
        let mut errors = vec![];
        for (speed, friction) in [(0.0, 0.0), (7.0, 0.9), (60.0, 0.35)] {
            let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: speed, friction_coefficient: friction };
            for lambda in modes(&p).into_iter().filter(|lambda| request.counted.counts(*lambda)) {
                errors.push(newton_step(&full, &p, lambda) / lambda.norm());
            }
        }
        let worst = errors.iter().copied().fold(0.0, f64::max);
        assert!(errors.len() > 15 && worst < 2e-6, "{} roots, {worst:e}", errors.len());
        let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 1.0, friction_coefficient: 0.0 };
        let [slow, fast] = [1.0, 60.0].map(|disc_speed_rad_s| modes(&OperatingPoint { disc_speed_rad_s, ..p }));
        assert!((slow[3] - fast[3]).norm() > 1e-3 * slow[3].norm(), "{} {}", slow[3], fast[3]);
        let gyroscopic = full.matrices_of_part(1, basis.projected.basis.subrows(40, n)).gyroscopic.unwrap();
        assert_eq!(gyroscopic, faer::Scale(-1.0) * gyroscopic.transpose());
        assert!(gyroscopic.norm_max() > 0.0);
    }

    #[test]
    fn a_tolerance_that_cannot_be_held_is_an_error() {
        let full = chains(5.0, LAW);
        let few = ParametricRequest { most_vectors: 9, ..request(1e-6) };
        let message =
            parametric_basis(&full, &mut solver(&full), &few, &mut |_| {}).map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("at most 9 vectors") && message.contains("limit 1.0e-6"), "{message}");
        // A tolerance below the rounding of a dense solve.
        let rarely = ParametricRequest { most_samples: 2, ..request(1e-16) };
        let message =
            parametric_basis(&full, &mut solver(&full), &rarely, &mut |_| {}).map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("2 operating points"), "{message}");
    }
}
