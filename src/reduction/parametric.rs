//! A parametric basis: tens of vectors on which a full model has the roots it has, over a box of operating points.
//!
//! ```text
//! Q(λ, p) = λ² M + λ C(p) + K(p),   Q x = 0,   yᴴ Q = 0
//! V = span{Re x, Im x, Re y, Im y at sampled points},   Vᵀ Q(λ, p) V z = 0,   wᴴ Vᵀ Q(λ, p) V = 0
//! |Δλ| ≈ |(V w)-residual|_S⁻¹ |(V z)-residual|_S⁻¹ / |wᴴ Vᵀ Q' V z|,   S = sym K + σ M
//! ```
//!
//! With right and left vectors in the span the error of a root is the product of two small things. Three steps:
//!
//! 1. Greedy: where the estimate over a training set is worst, the full model is solved and its vectors are added. The
//!    estimate is scaled by the largest ratio of true error to estimate that the solves have shown.
//! 2. The vectors found, each at its own weight, are cut to the fewest that hold the tolerance at all training points:
//!    singular value decomposition in the norm of `S`, in which a part left out counts as it moves the root.
//! 3. Held-out points: every root of the full model there against those on the basis. A point that fails is added to the
//!    sampled ones, and other points are held out.
//!
//! # Source
//! Gräbner, Mehrmann, Quraishi, Schröder, von Wagner, "Numerical methods for parametric model reduction in the simulation
//! of disk brake squeal", ZAMM 96 (2016) 1388-1405 (right vectors); Benner, Gugercin, Willcox, "A survey of
//! projection-based model reduction methods for parametric dynamical systems", SIAM Review 57 (2015) 483-531 (greedy).

use faer::linalg::solvers::Solve;
use faer::{Mat, MatRef, c64};

use super::dense::symmetric_eigen;
use super::full_model::{FullModel, Projected};
use super::matching::{Counted, RootMatch, match_roots};
use super::operating_box::OperatingBox;
use super::pencil::{Llt, Pencil};
use super::sparse::{SparseMatrix, times, transposed};
use super::{FullSolver, FullSpectrum, FullVectors, ReductionError, weighted_sum};
use crate::physics::{Model, OperatingPoint, Solver, Spectrum, Vectors};

/// Share of the tolerance that training points must hold, so that held-out ones do.
const TRAINING_SHARE: f64 = 0.3;
/// Vectors are taken from roots a little beyond the band and the growth floor: they may cross it elsewhere in the box.
const BAND_MARGIN: f64 = 1.02;
const FLOOR_MARGIN: f64 = 1.5;
/// A vector whose part outside the span is below this times the square root of the tolerance adds nothing.
const NEGLIGIBLE: f64 = 0.01;
/// Largest part of the band at which the shift `σ` of `S` lies: it only keeps rigid motions from being free.
const SHIFT: f64 = 0.05;
/// Times that held-out points may fail before it is given up.
const MOST_ROUNDS: usize = 4;

/// What is asked of a parametric basis.
#[derive(Clone, Debug)]
pub struct ParametricRequest {
    pub range: OperatingBox,
    pub counted: Counted,
    /// Largest `|Δλ|/|λ|` of a root that counts.
    pub tolerance: f64,
    /// Points at which the estimate is computed, beside the corners of the box and its middle.
    pub training: usize,
    /// Points held out.
    pub held_out: usize,
    /// Points of the full model after which it is given up.
    pub most_samples: usize,
    /// Vectors after which it is given up.
    pub most_vectors: usize,
    /// Each substructure's rows of every vector become a vector of their own. Where contact stiffness varies with load, load
    /// is sampled like everything else, and that is enough: a tribometer of 5049 degrees of freedom over 50 to 2000 N
    /// (exponent 1/3) needs 67 vectors for 1e-6 unsplit, 90 split, from the same four points.
    pub split: bool,
}

/// What is being done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ParametricStep {
    /// The full model is solved at a point.
    Sampling { point: OperatingPoint, sample: usize },
    /// It had this many roots that count; the span has this many vectors; the estimate there was so many times too small.
    Sampled { roots: usize, vectors: usize, true_over_estimate: f64 },
    /// The estimate has been computed at all training points; this is the worst, scaled.
    Estimated { worst: f64, vectors: usize },
    /// So many vectors leave this error at the training points.
    Cut { vectors: usize, worst: f64 },
    /// A held-out point was solved.
    HeldOut { point: OperatingPoint, worst: f64 },
}

/// A held-out point and what was found there.
#[derive(Clone, Debug)]
pub struct HeldOut {
    pub point: OperatingPoint,
    pub comparison: RootMatch,
}

/// A basis and how good it is.
#[derive(Clone, Debug)]
pub struct ParametricBasis {
    pub projected: Projected,
    /// Where the full model was solved for vectors.
    pub sampled: Vec<OperatingPoint>,
    pub held_out: Vec<HeldOut>,
    /// Vectors against the largest error at the training points, as far as sizes were tried, ascending.
    pub front: Vec<(usize, f64)>,
    /// Largest ratio of true error to estimate that was seen.
    pub true_over_estimate: f64,
}

impl ParametricBasis {
    /// The largest `|Δλ|/|λ|` at the held-out points; infinite where a root was missed or invented.
    pub fn worst(&self) -> f64 {
        self.held_out.iter().map(|held| held.comparison.worst()).fold(0.0, f64::max)
    }
}

/// Builds a basis of `full`, which `solver` solves.
///
/// # Errors
/// [`ReductionError`]: `Range`, `Tolerance` where it could not be held, those of the solves.
pub fn parametric_basis(
    full: &FullModel,
    solver: &mut FullSolver<'_>,
    request: &ParametricRequest,
    progress: &mut dyn FnMut(ParametricStep),
) -> Result<ParametricBasis, ReductionError> {
    request.range.check()?;
    let metric = Metric::new(full, request)?;
    let factor = metric.factor()?;
    let mut build = Building {
        full,
        solver,
        request,
        metric: &metric,
        factor,
        span: Mat::zeros(full.dimension(), 0),
        snapshots: vec![],
        sampled: vec![],
        known: vec![],
        true_over_estimate: 1.0,
    };
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
        let (projected, front) = build.cut(&wide, &training, progress)?;
        let model = build.model(&projected)?;
        let mut held_out = vec![];
        let mut worst = 0.0_f64;
        for point in request.range.spread(first, request.held_out) {
            let band_rad_s = BAND_MARGIN * request.counted.band_rad_s;
            let full = build.solver.roots(&point, band_rad_s, FullVectors::None, &mut |_| {})?;
            let roots = full.roots.iter().map(|root| root.lambda).filter(|lambda| lambda.im > 0.0).collect::<Vec<_>>();
            let reduced = oscillating(&build.solve(&model, &point, Vectors::None)?);
            let comparison = match_roots(&roots, &reduced, request.counted);
            worst = worst.max(comparison.worst());
            progress(ParametricStep::HeldOut { point, worst: comparison.worst() });
            held_out.push(HeldOut { point, comparison });
        }
        first += request.held_out;
        if worst <= request.tolerance {
            let (sampled, true_over_estimate) = (build.sampled, build.true_over_estimate);
            return Ok(ParametricBasis { projected, sampled, held_out, front, true_over_estimate });
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

/// `S = sym K + σ M` at the middle of the box without friction.
struct Metric {
    mass: SparseMatrix,
    stiffness: SparseMatrix,
    sigma: f64,
}

impl Metric {
    fn new(full: &FullModel, request: &ParametricRequest) -> Result<Self, ReductionError> {
        let middle = request.range.at([0.5; 3]).with_friction(0.0);
        let [mass, _, stiffness] = full.matrices_at(&middle)?;
        let stiffness = weighted_sum(full.dimension(), &[(0.5, &stiffness), (0.5, &transposed(&stiffness)?)])?;
        let sigma = (SHIFT * request.counted.band_rad_s).powi(2);
        Ok(Self { mass, stiffness, sigma })
    }

    fn times(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        times(&self.stiffness, x) + faer::Scale(self.sigma) * times(&self.mass, x)
    }

    /// `Xᵀ S X`, exactly symmetric.
    fn gram(&self, x: &Mat<f64>) -> Mat<f64> {
        let gram = x.transpose() * self.times(x.as_ref());
        Mat::from_fn(gram.nrows(), gram.ncols(), |i, j| 0.5 * (gram[(i, j)] + gram[(j, i)]))
    }

    fn factor(&self) -> Result<Pencil<'_>, ReductionError> {
        Pencil::new("full model", &self.mass, &self.stiffness)
    }
}

fn failed(reason: String) -> ReductionError {
    ReductionError::Factorisation { what: "parametric basis".to_owned(), reason }
}

/// The roots with `ω > 0`.
fn oscillating(spectrum: &Spectrum) -> Vec<c64> {
    spectrum.modes().iter().map(|root| root.lambda).collect()
}

struct Building<'a, 'm> {
    full: &'a FullModel,
    solver: &'a mut FullSolver<'m>,
    request: &'a ParametricRequest,
    metric: &'a Metric,
    factor: Pencil<'a>,
    /// Orthonormal in `S`.
    span: Mat<f64>,
    /// Coefficients of the vectors found in `span`, one block for each point; rows of later vectors are 0.
    snapshots: Vec<Mat<f64>>,
    sampled: Vec<OperatingPoint>,
    /// All roots in the band at the sampled points.
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

    /// Solves the full model at `point` and adds what it finds; `estimates` were the reduced roots there with the
    /// estimates of their errors.
    fn sample(
        &mut self,
        point: OperatingPoint,
        estimates: Option<&[(c64, f64)]>,
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<(), ReductionError> {
        let counted = self.request.counted;
        progress(ParametricStep::Sampling { point, sample: self.sampled.len() + 1 });
        let wanted = Counted {
            band_rad_s: BAND_MARGIN * counted.band_rad_s,
            growth_floor_per_s: counted.growth_floor_per_s - (FLOOR_MARGIN - 1.0) * counted.growth_floor_per_s.abs(),
        };
        let spectrum = self.solver.roots(&point, wanted.band_rad_s, FullVectors::Both, &mut |_| {})?;
        let roots: Vec<c64> = spectrum.roots.iter().map(|root| root.lambda).collect();
        let chosen: Vec<usize> = (0..roots.len()).filter(|&k| wanted.counts(roots[k])).collect();
        let counting: Vec<c64> = chosen.iter().map(|&k| roots[k]).collect();
        let mut ratio = f64::NAN;
        for (reduced, estimate) in estimates.unwrap_or_default() {
            let nearest =
                counting.iter().map(|root| (root - reduced).norm() / root.norm()).fold(f64::INFINITY, f64::min);
            // Rounding of dense and sparse solves says nothing of the estimate.
            if nearest > 1e-11 && nearest < 1e-2 && *estimate > 0.0 {
                ratio = ratio.max(nearest / estimate);
            }
        }
        let columns = self.columns(&point, &spectrum, &chosen)?;
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

    /// Real and imaginary parts of right and left vectors, of such size that a part `d` left out of both moves the root by
    /// about `dᵀ S d` times `|λ|`.
    fn columns(
        &self,
        p: &OperatingPoint,
        spectrum: &FullSpectrum,
        chosen: &[usize],
    ) -> Result<Mat<f64>, ReductionError> {
        let n = self.full.dimension();
        let [mass, damping, _] = self.full.matrices_at(p)?;
        // Real and imaginary parts of x, then of y.
        let mut columns = Mat::<f64>::from_fn(n, 4 * chosen.len(), |i, j| {
            let vectors = if j % 4 < 2 { &spectrum.right } else { &spectrum.left };
            let value = vectors[(i, chosen[j / 4])];
            if j % 2 == 0 { value.re } else { value.im }
        });
        let (of_mass, of_damping) = (times(&mass, columns.as_ref()), times(&damping, columns.as_ref()));
        for (k, &root) in chosen.iter().enumerate() {
            let lambda = spectrum.roots[root].lambda;
            let at =
                |m: &Mat<f64>, i: usize, side: usize| c64::new(m[(i, 4 * k + 2 * side)], m[(i, 4 * k + 2 * side + 1)]);
            let slope: c64 = (0..n)
                .map(|i| at(&columns, i, 1).conj() * (lambda * 2.0 * at(&of_mass, i, 0) + at(&of_damping, i, 0)))
                .sum();
            let length = |side: usize| -> f64 {
                (0..n).map(|i| (at(&columns, i, side).conj() * at(&of_mass, i, side)).re).sum::<f64>().sqrt()
            };
            let lengths = [length(0), length(1)];
            // |y|_M |x|_M / |yᴴ Q' x| is 1/(2|λ|) of a real mode and grows without limit where two roots merge.
            let condition = (lengths[0] * lengths[1] / (slope.norm() * lambda.norm())).sqrt().min(10.0 / lambda.norm());
            for (side, length) in lengths.into_iter().enumerate() {
                let mut part = columns.subcols_mut(4 * k + 2 * side, 2);
                part *= faer::Scale(condition / length);
            }
        }
        if !self.request.split {
            return Ok(columns);
        }
        let (parts, width) = (self.full.parts.len(), columns.ncols());
        let mut apart = Mat::<f64>::zeros(n, parts * width);
        for (k, (part, offset)) in self.full.parts.iter().zip(self.full.offsets()).enumerate() {
            let rows = part.mass.nrows();
            apart.submatrix_mut(offset, k * width, rows, width).copy_from(columns.subrows(offset, rows));
        }
        Ok(apart)
    }

    /// Adds to the span what `columns` have outside of it, and remembers their coefficients.
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
        let gram = self.metric.gram(&rest);
        let (squares, vectors) = symmetric_eigen("parametric basis", gram.as_ref())?;
        let least = NEGLIGIBLE * self.request.tolerance.sqrt();
        let kept: Vec<usize> = (0..squares.len()).rev().filter(|&k| squares[k] > least * least).collect();
        if kept.is_empty() {
            self.snapshots.push(coefficients);
            return Ok(());
        }
        let turn = Mat::from_fn(vectors.nrows(), kept.len(), |i, k| vectors[(i, kept[k])] / squares[kept[k]].sqrt());
        let mut added = &rest * &turn;
        // What the Gram matrix rounds away from orthogonality, twice is enough.
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
        let before = std::mem::replace(&mut self.span, Mat::new());
        self.span = beside(before.as_ref(), added.as_ref());
        Ok(())
    }

    /// Adds points until the scaled estimate holds everywhere; the model on the whole span.
    fn enrich(
        &mut self,
        training: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Projected, ReductionError> {
        loop {
            let projected = self.full.project(self.span.as_ref())?;
            let model = self.model(&projected)?;
            let factor = self
                .factor
                .llt(self.metric.sigma)?
                .ok_or_else(|| failed("the symmetric stiffness with its shift is not positive definite".to_owned()))?;
            let mut worst: Option<(OperatingPoint, Vec<(c64, f64)>, f64)> = None;
            for point in training.iter().filter(|point| !self.sampled.contains(point)) {
                let spectrum = self.solve(&model, point, Vectors::Both)?;
                let estimates = self.estimates(&factor, &projected, &spectrum)?;
                let largest = estimates.iter().map(|(_, estimate)| *estimate).fold(0.0, f64::max);
                if worst.as_ref().is_none_or(|(_, _, before)| largest > *before) {
                    worst = Some((*point, estimates, largest));
                }
            }
            drop(factor);
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
            self.sample(point, Some(&estimates), progress)?;
        }
    }

    /// Every reduced root that counts, with the estimate of its relative error.
    fn estimates(
        &self,
        factor: &Llt<'_>,
        projected: &Projected,
        spectrum: &Spectrum,
    ) -> Result<Vec<(c64, f64)>, ReductionError> {
        let [mass, damping, stiffness] = self.full.matrices_at(&spectrum.point)?;
        let wanted: Vec<usize> =
            (0..spectrum.mode_count).filter(|&k| self.request.counted.counts(spectrum.roots[k].lambda)).collect();
        let (n, m, size) = (self.full.dimension(), wanted.len(), projected.omega_squared.len());
        // Real and imaginary parts of all right, then all left vectors.
        let parts = Mat::from_fn(size, 4 * m, |i, j| {
            let (side, k) = (j / (2 * m), wanted[(j % (2 * m)) / 2]);
            let value = if side == 0 { spectrum.shapes[(i, k)] } else { spectrum.left[(i, k)] };
            if j % 2 == 0 { value.re } else { value.im }
        });
        let vectors = &projected.basis * &parts;
        let (right, left) = (vectors.subcols(0, 2 * m), vectors.subcols(2 * m, 2 * m));
        let on_both = |matrix: &SparseMatrix| -> Result<Mat<f64>, ReductionError> {
            Ok(beside(times(matrix, right).as_ref(), times(&transposed(matrix)?, left).as_ref()))
        };
        let (of_mass, of_damping, of_stiffness) = (on_both(&mass)?, on_both(&damping)?, on_both(&stiffness)?);
        let mut residuals = Mat::<f64>::zeros(n, 4 * m);
        for (j, &k) in wanted.iter().chain(&wanted).enumerate() {
            // yᴴ Q = (Qᴴ y)ᴴ.
            let lambda = if j < m { spectrum.roots[k].lambda } else { spectrum.roots[k].lambda.conj() };
            for i in 0..n {
                let at = |matrix: &Mat<f64>| c64::new(matrix[(i, 2 * j)], matrix[(i, 2 * j + 1)]);
                let value = lambda * (lambda * at(&of_mass) + at(&of_damping)) + at(&of_stiffness);
                residuals[(i, 2 * j)] = value.re;
                residuals[(i, 2 * j + 1)] = value.im;
            }
        }
        let mut solved = residuals.clone();
        factor.solve(solved.as_mut());
        let square = |j: usize| (residuals.col(j).transpose() * solved.col(j)).max(0.0);
        let norm = |j: usize| (square(2 * j) + square(2 * j + 1)).sqrt();
        Ok(wanted
            .iter()
            .enumerate()
            .map(|(j, &k)| {
                let lambda = spectrum.roots[k].lambda;
                // The left vectors of a damped root have yᴴ Q' x = 1, those of an undamped one 2 λ.
                let slope = if spectrum.undamped { 2.0 * lambda.norm() } else { 1.0 };
                (lambda, norm(j) * norm(m + j) / (slope * lambda.norm()))
            })
            .collect())
    }

    /// The model on the fewest leading singular vectors of the snapshots that hold the tolerance at all training points.
    #[allow(clippy::type_complexity)]
    fn cut(
        &self,
        wide: &Projected,
        training: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<(Projected, Vec<(usize, f64)>), ReductionError> {
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
        // From the coordinates of the span to those of `wide`.
        let turn = self.span.transpose() * self.metric.times(wide.basis.as_ref());
        let mut leading = Mat::from_fn(size, size, |i, k| vectors[(i, size - 1 - k)]);
        turn.partial_piv_lu().solve_in_place(leading.as_mut());
        let mut front: Vec<(usize, f64)> = vec![];
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
            front.push((count, worst));
            Ok((smaller, worst))
        };
        let limit = 0.5 * self.request.tolerance;
        let (mut enough, mut found) = (size, None);
        let counted = self.request.counted;
        let counting = |roots: &Vec<c64>| roots.iter().filter(|lambda| counted.counts(**lambda)).count();
        // Fewer vectors than roots cannot do.
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
        front.sort_by_key(|(count, _)| *count);
        if enough > self.request.most_vectors {
            let most = self.request.most_vectors;
            let value =
                front.iter().filter(|(count, _)| *count <= most).map(|(_, worst)| *worst).fold(f64::INFINITY, f64::min);
            let (limit, samples) = (self.request.tolerance, self.sampled.len());
            return Err(ReductionError::Tolerance {
                what: format!("parametric basis of at most {most} vectors, {enough} are needed"),
                value,
                limit,
                vectors: most,
                samples,
            });
        }
        Ok((chosen, front))
    }
}

fn solve_failed(source: crate::physics::SolveError) -> ReductionError {
    ReductionError::Solve { what: "parametric basis".to_owned(), source: Box::new(source) }
}

/// `[a b]`.
fn beside(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Mat<f64> {
    let mut both = Mat::zeros(a.nrows(), a.ncols() + b.ncols());
    both.subcols_mut(0, a.ncols()).copy_from(a);
    both.subcols_mut(a.ncols(), b.ncols()).copy_from(b);
    both
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::ContactLaw;
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
            split: false,
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

    /// On fewer vectors than degrees of freedom the roots of the full model, over load, speed and friction, damped and
    /// unsymmetric; every root that counts is a root of `det Q` within the tolerance, at points held out and at others.
    #[test]
    fn a_basis_holds_its_tolerance_where_it_was_not_sampled() {
        let full = chains(5.0, LAW);
        for split in [false, true] {
            let request = ParametricRequest { split, ..request(1e-6) };
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
                    // A root just above the floor is held like any other; Newton's step is first order in the error.
                    assert!(error <= 1.1e-6, "{:?} {lambda}: {error:e}", held.point);
                }
            }
        }
    }

    #[test]
    fn a_tolerance_that_cannot_be_held_is_an_error() {
        let full = chains(5.0, LAW);
        let few = ParametricRequest { most_vectors: 9, ..request(1e-6) };
        let told = parametric_basis(&full, &mut solver(&full), &few, &mut |_| {}).unwrap_err().to_string();
        assert!(told.contains("at most 9 vectors") && told.contains("limit 1.0e-6"), "{told}");
        let rarely = ParametricRequest { most_samples: 2, ..request(1e-9) };
        let told = parametric_basis(&full, &mut solver(&full), &rarely, &mut |_| {}).unwrap_err().to_string();
        assert!(told.contains("2 operating points"), "{told}");
    }
}
