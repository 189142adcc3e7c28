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
//!    are added. The estimate is scaled by the largest ratio of true error to estimate observed so far. Once it holds, the
//!    points whose roots are most sensitive, near merging roots and near divergence, join the training points.
//! 2. Truncation. The model on the sampled vectors is solved at many more points. A singular value decomposition of its
//!    vectors there, in the norm of `S`, is cut to the fewest leading ones that hold the tolerance at all of these points.
//!    Each vector is scaled so that an omitted component counts by the change of the root that it causes; roots that
//!    exceed the tolerance gain weight.
//! 3. Validation. At held-out points all roots of the full model are compared with those of the reduced one. A point
//!    that fails becomes a sample, and new held-out points are drawn.
//!
//! Load-dependent contact stiffness is a term like any other, and load is sampled like friction. Splitting every vector
//! into one per substructure would make the basis valid for any contact stiffness, but needs a third more vectors. Example:
//! a tribometer of 5049 degrees of freedom, friction coefficients of 0 to 1, loads of 50 to 2000 N, exponent 1/3, tolerance
//! 1e-6: 51 vectors, error 9.4e-8 at the held-out points. A decomposition of the vectors at the sampled points only, without
//! weights, needs 69.
//!
//! # Source
//! Gräbner, Mehrmann, Quraishi, Schröder, von Wagner, "Numerical methods for parametric model reduction in the
//! simulation of disk brake squeal", ZAMM 96 (2016) 1388-1405 (right vectors); Benner, Gugercin, Willcox, "A survey of
//! projection-based model reduction methods for parametric dynamical systems", SIAM Review 57 (2015) 483-531 (greedy).

mod condition;
mod estimate;
mod metric;
mod request;
mod sampling;
mod span;
mod truncation;

use super::full_model::{FullModel, Projected};
use super::matching::{RootMatch, match_roots};
use super::pencil::Pencil;
use super::{FullSolver, FullVectors, ReductionError, on_threads, threads_for};
use crate::physics::{Model, OperatingPoint, Solver, Vectors};
pub(super) use metric::Metric;
pub use request::{ParametricRequest, ParametricStep};
use sampling::{BAND_MARGIN, Building, comparable, comparable_of, solve_failed};
pub(super) use span::Span;

/// Largest number of rounds of validation.
const MOST_ROUNDS: usize = 4;

/// Ratio of the numbers of training points and of those that join them because their roots are most sensitive.
const SENSITIVE: usize = 4;

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
        worst_of(&self.held_out)
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
    // Without friction, `K` is nearest to symmetric.
    let middle = full.at(&request.range.at([0.5; 3]).with_friction(0.0))?;
    let mut metric = Metric::new(full, middle, request.counted.band_rad_s);
    let assembled = if solver.has_parts() { None } else { Some(metric.assemble()?) };
    let pencil = assembled.as_ref().map(|[mass, stiffness]| Pencil::new("full model", mass, stiffness)).transpose()?;
    let mut build = Building {
        full,
        solver,
        request,
        pencil,
        most_roots,
        span: Span::new(full, metric),
        sampled: vec![],
        true_over_estimate: 1.0,
    };
    let planned = build.make_room()?;
    progress(ParametricStep::Planned { bytes: planned });
    let mut corners = request.range.corners_and_middle();
    let middle = corners.pop().expect("a middle");
    let opposite = corners.last().copied().unwrap_or(middle);
    build.sample_all(&[middle, opposite], progress)?;
    let mut first = 0;
    let mut training: Vec<OperatingPoint> = corners;
    training.extend(request.range.spread(first, request.training));
    first += request.training;
    // Those before are held out.
    let cutting = request.range.spread(first + MOST_ROUNDS * request.held_out, request.cutting);
    let failed = |value: f64, vectors: usize, samples: usize| ReductionError::Tolerance {
        what: "parametric basis".to_owned(),
        value,
        limit: request.tolerance,
        vectors,
        samples,
    };
    let mut last = f64::INFINITY;
    for _ in 0..MOST_ROUNDS {
        let sensitive = {
            let wide = build.enrich(&training, progress)?;
            build.most_sensitive(&wide, &cutting, request.training / SENSITIVE)?
        };
        let added: Vec<OperatingPoint> = sensitive.into_iter().filter(|point| !training.contains(point)).collect();
        // The others hold already, and the span only grows.
        let wide = build.enrich(&added, progress)?;
        training.extend(added);
        let projected = build.cut(&wide, &[&training[..], &cutting[..]].concat(), progress)?;
        drop(wide);
        let model = build.model(&projected)?;
        let held_out = build.validate(&model, &request.range.spread(first, request.held_out), progress)?;
        let worst = worst_of(&held_out);
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
    Err(failed(last, build.span.size(), build.sampled.len()))
}

impl Building<'_, '_> {
    /// Compares all roots of the full model with those of the reduced `model` at held-out `points`.
    fn validate(
        &mut self,
        model: &Model,
        points: &[OperatingPoint],
        progress: &mut dyn FnMut(ParametricStep),
    ) -> Result<Vec<HeldOut>, ReductionError> {
        let counted = self.request.counted;
        let held = size_of::<f64>() * self.full.dimension() * (self.span.size() + model.dimension());
        let (most_roots, of) = (self.most_roots, points.len());
        let points: Vec<(usize, OperatingPoint)> = points.iter().copied().enumerate().collect();
        let is_of_memory = |error: &ReductionError| matches!(error, ReductionError::Memory { .. });
        self.solver.for_threads(threads_for(of), is_of_memory, |solvers| {
            // A solver that works alone has its room from the samples.
            if solvers.len() > 1 {
                for solver in &mut *solvers {
                    solver.make_room(FullVectors::None, most_roots, held, 0)?;
                }
            }
            on_threads(solvers, &points, progress, &|solver, &(index, point), report| {
                let solving = &mut |step| report(ParametricStep::Solving(step));
                let full = solver.roots(&point, BAND_MARGIN * counted.band_rad_s, FullVectors::None, solving)?;
                let roots = comparable(full.roots.iter().map(|root| root.lambda));
                let reduced =
                    Solver::new(model.dimension()).solve(model, &point, Vectors::None).map_err(solve_failed)?;
                let comparison = match_roots(&roots, &comparable_of(&reduced), counted);
                report(ParametricStep::HeldOut { point, worst: comparison.worst(), done: index + 1, of });
                Ok(HeldOut { point, comparison })
            })
        })
    }
}

/// Largest `|Δλ|/|λ|` at held-out points; infinite if a root was missed or invented.
fn worst_of(held_out: &[HeldOut]) -> f64 {
    held_out.iter().map(|held| held.comparison.worst()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use faer::linalg::solvers::Solve;
    use faer::{Mat, c64};

    use super::super::{Counted, OperatingBox, SparseMatrix};
    use super::*;
    use crate::physics::ContactLaw;
    use crate::reduction::PartTurning;
    use crate::reduction::test_models::chains;

    const LAW: ContactLaw =
        ContactLaw { exponent: 0.5, reference_n: 500.0, slope_s_per_m: -0.01, lateral_damping: true, stribeck: None };

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
            cutting: 40,
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
            for lambda in comparable_of(&reduced).into_iter().filter(|lambda| request.counted.counts(*lambda)) {
                let error = newton_step(&full, &held.point, lambda) / lambda.norm();
                // Roots just above the growth floor meet the tolerance too. Newton's step equals the error to first
                // order.
                assert!(error <= 1.1e-6, "{:?} {lambda}: {error:e}", held.point);
            }
        }
    }

    /// The same with factors in single precision, and an error if one is wrong.
    #[test]
    fn a_basis_by_factors_in_single_precision_holds_its_tolerance() {
        use crate::spoil::{Spoil, with};
        let full = chains(5.0, LAW);
        let mut single = solver(&full).in_single_precision();
        let basis = parametric_basis(&full, &mut single, &request(1e-6), &mut |_| {}).unwrap();
        assert!(basis.worst() <= 1e-6 && basis.held_out.len() == 4);
        let mut wrong = solver(&full).in_single_precision();
        let refused = with(Spoil::Factor, || parametric_basis(&full, &mut wrong, &request(1e-6), &mut |_| {}));
        let message = refused.map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("in single precision is too inaccurate"), "{message}");
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
        let modes = |p: &OperatingPoint| {
            comparable_of(&Solver::new(model.dimension()).solve(&model, p, Vectors::None).unwrap())
        };
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
