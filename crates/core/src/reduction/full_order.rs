//! Complex eigenvalues of a full model: roots of `(λ² M + λ C + K) x = 0` with `C` and `K` of any symmetry.
//!
//! A shift-and-invert Krylov-Schur iteration (`krylov_schur`) finds the roots nearest to a shift `s = iω`. It also
//! gives the radius within which every root has converged. An undamped model is solved in `κ = -λ²` with a real
//! operator of size `n`:
//!
//! ```text
//! x -> (K - ω² M)⁻¹ M x,   θ = 1/(κ - ω²)
//! ```
//!
//! A damped model is solved in `λ` with the linearised complex operator of size `2n`:
//!
//! ```text
//! (x, y) -> x' = -Q(s)⁻¹ (M y + (C + s M) x),  y' = x + s x',   θ = 1/(λ - s),   Q(s) = s² M + s C + K
//! ```
//!
//! The inverse is applied with symmetric factors of the parts plus a low-rank correction for their contact
//! (`contact_solver`). Models with other terms use a sparse LU. Each new shift is placed in the lowest part of the band
//! that no disc covers yet. A root inside two discs must have been found around both shifts.
//!
//! Source: Saad, "Numerical methods for large eigenvalue problems" (2011), chapters 6 and 8; Tisseur, Meerbergen, "The
//! quadratic eigenvalue problem", SIAM Review 43 (2001) 235-286.

use faer::{Mat, c64};

use super::ReductionError;
use super::contact_solver::{PartBytes, Parts, Shifted};
use super::coverage::{Found, agree, assemble, first_gap};
use super::engine::Engine;
use super::full_model::FullModel;
use super::full_problem::{Problem, WANTED, unit};
use super::full_root::{FullProgress, FullRoot, FullSpectrum, FullVectors};
use super::kept_factors::KeptFactors;
use super::krylov_schur::{BLOCK, capacity, most_found};
use super::own_engine::OwnEngine;
use crate::physics::{self, OperatingPoint, Vectors};

/// Largest residual of a linear solve at a shift, relative to `|Q| |x| + |b|`.
const SOLVE_LIMIT: f64 = 1e-13;
/// Smallest magnitude of growth rate that the discs must cover, relative to the highest angular frequency of the band.
const GROWTH: f64 = 0.02;
/// Largest number of shifts for one band.
const MOST_SHIFTS: usize = 200;
/// Number of blocks a Krylov step holds in memory besides the basis: matrix products in two memory layouts, complex
/// numbers split into real and imaginary columns and joined again, and permuted copies around the factors. Used to
/// estimate memory before factorising.
const WORKING: usize = 12;
/// Number of complex vectors of length `n` held while residuals are computed.
const CHECKING: usize = 64;
/// Number of roots sought where one is wanted.
const FEW: usize = 6;
/// Shift, relative to the frequency of a root that is sought: on the root, the matrix to be factorised would be singular.
const BESIDE: f64 = 1.001;
/// Below this many degrees of freedom a dense solve is faster.
const DENSE_BELOW: usize = 240;

/// Solver for one full model at many operating points. The model is ordered and analysed once. Factors do not depend on
/// the operating point and are kept between solves, except those of a foreign engine.
pub struct FullSolver<'a> {
    engine: &'a dyn Engine,
    what: String,
    model: &'a FullModel,
    /// Of parts joined by contact only; `None` for other models and for foreign engines, which need a sparse LU.
    factors: Option<KeptFactors<'a>>,
    memory_limit_bytes: Option<usize>,
    /// Bytes that the caller holds permanently, see [`FullSolver::held_elsewhere`].
    elsewhere_bytes: usize,
}

impl<'a> FullSolver<'a> {
    /// Orders and analyses `model`, to be solved in this process.
    ///
    /// # Errors
    /// As [`Self::by`].
    pub fn new(
        what: &str,
        model: &'a FullModel,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Self, ReductionError> {
        Self::by(&OwnEngine, what, model, memory_limit_bytes, progress)
    }

    /// Prepares `model` to be solved by `engine`.
    ///
    /// `what` names the model in errors. `memory_limit_bytes` limits the memory taken in addition to what is already
    /// held; the estimated need is compared with it before the work starts.
    ///
    /// # Errors
    /// [`ReductionError`]: `Shape`, `NotFinite`, `Unsymmetric`, `Indefinite`, `Memory`, `Factorisation`.
    pub fn by(
        engine: &'a dyn Engine,
        what: &str,
        model: &'a FullModel,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Self, ReductionError> {
        let has_terms = !(model.stiffness.is_empty() && model.damping.is_empty() && model.modal_damping.is_empty());
        let by_parts = !has_terms && model.contact.is_some() && !engine.foreign();
        let factors = if by_parts { Some(KeptFactors::new(Parts::new(model)?)) } else { None };
        let what = what.to_owned();
        let mut solver = Self { engine, what, model, factors, memory_limit_bytes, elsewhere_bytes: 0 };
        let bytes = solver.make_room(FullVectors::None, 0, 0, 0)?;
        progress(FullProgress::Analysed { bytes });
        Ok(solver)
    }

    /// The same with factors in single precision, whatever the memory.
    #[cfg(test)]
    pub(super) fn in_single_precision(mut self) -> Self {
        self.factors.iter_mut().for_each(|factors| factors.precision = super::precision::Precision::Single);
        self
    }

    /// Calls `work` with `threads` solvers of the same model, one for each thread; each may take an equal share of the
    /// memory. If that is too little, `work` is called again with this solver alone: `is_of_memory` recognises the error.
    ///
    /// This solver works alone from the start if it keeps factors, which threads cannot share, or if a foreign engine
    /// solves, whose ranks need the processors.
    ///
    /// # Errors
    /// Those of `work`.
    pub fn for_threads<R, E>(
        &mut self,
        threads: usize,
        is_of_memory: impl Fn(&E) -> bool,
        mut work: impl FnMut(&mut [Self]) -> Result<R, E>,
    ) -> Result<R, E> {
        if threads > 1 && !self.has_parts() && !self.engine.foreign() {
            let solver = |_| Self {
                engine: self.engine,
                what: self.what.clone(),
                model: self.model,
                factors: None,
                memory_limit_bytes: self.memory_limit_bytes.map(|limit| limit / threads),
                elsewhere_bytes: self.elsewhere_bytes,
            };
            let mut solvers: Vec<Self> = (0..threads).map(solver).collect();
            let found = work(&mut solvers);
            if !found.as_ref().is_err_and(is_of_memory) {
                return found;
            }
        }
        work(std::slice::from_mut(self))
    }

    /// Counts `bytes`, allocated by the caller since the solver was made, towards the memory limit from now on.
    pub fn held_elsewhere(&mut self, bytes: usize) {
        self.elsewhere_bytes = bytes;
    }

    /// Estimated memory of a model that is not just parts joined by contact, with one factor.
    fn system_bytes(&self) -> PartBytes {
        if self.engine.foreign() {
            return PartBytes { held: 0, factors: 0, factoring: 0 };
        }
        // The fill of a sparse LU is not known in advance: 400 entries a column are assumed, at most a tenth of a full matrix.
        // For each damped mode, a real vector and two complex ones are held as well.
        let n = self.model.dimension();
        let modes: usize = self.model.modal_damping.iter().map(|damping| damping.rates_per_s.len()).sum();
        let factors = size_of::<c64>() * ((n * n / 10).min(400 * n) + 5 * n * modes / 2);
        PartBytes { held: 0, factors, factoring: 0 }
    }

    /// Bytes of the vectors held at the peak of a solve with `roots` roots in the band: the largest of three phases,
    /// plus the eigenvectors kept for all discs.
    ///
    /// 1. Right vectors: a Krylov basis and the vectors found.
    /// 2. Left vectors, if wanted: the right vectors found, a basis for as many left ones, and the left vectors found.
    /// 3. Residuals: right and left vectors and the products with the matrices.
    ///
    /// Every disc is assumed to contribute at least half of the roots wanted around a shift.
    fn vector_bytes(&self, vectors: FullVectors, roots: usize) -> usize {
        let (n, complex) = (self.model.dimension(), size_of::<c64>());
        // Krylov vectors are real of length `n`, or complex of length `2n`.
        let undamped = self.is_real();
        let (rows, each) = if undamped { (n, size_of::<f64>() * n) } else { (2 * n, complex * 2 * n) };
        let both = vectors == FullVectors::Both;
        let right = most_found(WANTED);
        let left = if both { most_found(right) } else { 0 };
        let forward = each * capacity(rows, WANTED) + complex * rows * right;
        let backward = if both { each * capacity(rows, right) + complex * (n * right + rows * left) } else { 0 };
        let checked = complex * n * (2 * right + left + CHECKING);
        let discs = 1 + 2 * roots / WANTED;
        let found = if both { complex * n * (2 * right * (discs - 1) + 2 * roots) } else { 0 };
        (WORKING * BLOCK * each + forward.max(backward)).max(checked) + found
    }

    /// Checks the memory limit for solves with `roots` roots in the band, drops factors that no longer fit, and returns
    /// the bytes needed with one factor. Factors are kept in single precision from now on if one in double precision does
    /// not fit.
    ///
    /// `held_by_caller` bytes are held by the caller during a solve; `other` bytes are needed between solves. As many factors
    /// are kept as the limit allows.
    ///
    /// # Errors
    /// [`ReductionError::Memory`].
    pub(super) fn make_room(
        &mut self,
        vectors: FullVectors,
        roots: usize,
        held_by_caller: usize,
        other: usize,
    ) -> Result<usize, ReductionError> {
        let (elsewhere, of_vectors) = (self.elsewhere_bytes, self.vector_bytes(vectors, roots));
        let rest = |PartBytes { held, factoring, factors: _ }: PartBytes| {
            held + elsewhere + (factoring.max(of_vectors) + held_by_caller).max(other)
        };
        let limit = self.memory_limit_bytes.unwrap_or(usize::MAX);
        let bytes = match &mut self.factors {
            Some(factors) => factors.make_room(limit, &rest),
            None => {
                let bytes = self.system_bytes();
                rest(bytes) + bytes.factors
            }
        };
        if bytes > limit {
            return Err(ReductionError::Memory { what: self.what.clone(), bytes, limit });
        }
        Ok(bytes)
    }

    /// Number of natural frequencies of the separate parts (contact open) up to `band_rad_s`. Without friction it is an
    /// upper bound for the closed contact too, because contact stiffness only raises frequencies. For models without
    /// separate parts it is the number of roots sought around a shift.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`].
    pub(super) fn count_below(&self, band_rad_s: f64) -> Result<usize, ReductionError> {
        self.factors.as_ref().map_or(Ok(WANTED), |factors| factors.parts.count_below(band_rad_s * band_rad_s))
    }

    /// Factorises `K + sigma M` of the parts, if the model has separate parts. The factors are kept together with those
    /// at shifts.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, also if `K + sigma M` is not positive definite.
    pub(super) fn factor_at(&mut self, sigma: f64) -> Result<(), ReductionError> {
        let Some(factors) = &mut self.factors else { return Ok(()) };
        let index = factors.at(-sigma)?.0;
        if factors.get(index).is_definite() {
            return Ok(());
        }
        let reason = "the symmetric stiffness with its shift is not positive definite".to_owned();
        Err(ReductionError::Factorisation { what: self.what.clone(), reason })
    }

    /// The factors of `K + sigma M` made by [`Self::factor_at`], if they are still kept.
    pub(super) fn factors_at(&self, sigma: f64) -> Option<&Shifted> {
        self.factors.as_ref()?.find(-sigma)
    }

    /// Whether roots are found in `λ²`, with real vectors. Other models than parts joined by contact are not examined for
    /// damping in this process.
    fn is_real(&self) -> bool {
        (self.factors.is_some() || self.engine.foreign()) && self.model.is_undamped()
    }

    /// The engine that solves.
    pub(super) fn engine(&self) -> &'a dyn Engine {
        self.engine
    }

    /// Whether the model consists of parts joined by contact only, without further terms.
    pub(super) fn has_parts(&self) -> bool {
        self.factors.is_some()
    }

    /// Finds every root at `p` with a frequency from 0 to `band_rad_s` and a growth rate within the discs, see
    /// [`FullSpectrum::covered_growth_per_s`]. Small models are solved densely and yield all roots of the band.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `NotConverged`, `NotCovered`, `MissedRoot`, `Residual`, `State`.
    pub fn roots(
        &mut self,
        p: &OperatingPoint,
        band_rad_s: f64,
        vectors: FullVectors,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<FullSpectrum, ReductionError> {
        if self.model.dimension() < DENSE_BELOW {
            return self.dense(p, band_rad_s, vectors);
        }
        let (what, here, by_parts) = (self.what.clone(), self.model.at(p)?, self.has_parts());
        let mut problem =
            Problem::new(&what, self.model, here.clone(), vectors, by_parts, self.is_real(), GROWTH * band_rad_s)?;
        let mut found: Vec<Found> = vec![];
        while let Some(gap) = first_gap(&found, band_rad_s) {
            #[cfg(not(test))]
            let most = MOST_SHIFTS;
            #[cfg(test)]
            let most = if crate::spoil::spoilt(crate::spoil::Spoil::Shifts) { 1 } else { MOST_SHIFTS };
            if found.len() == most {
                return Err(ReductionError::NotCovered { what: self.what.clone(), covered: gap[0], band: band_rad_s });
            }
            let [low, high] = gap;
            let middle = if problem.undamped { (0.5 * (low * low + high * high)).sqrt() } else { 0.5 * (low + high) };
            let new = self.around(&mut problem, middle, gap, progress)?;
            progress(FullProgress::Covered { disc: new.disc, roots: new.roots.len() });
            found.push(new);
            found.sort_by(|a, b| a.disc.shift_rad_s.total_cmp(&b.disc.shift_rad_s));
        }
        #[cfg(test)]
        if crate::spoil::spoilt(crate::spoil::Spoil::Root) {
            tests::lose_a_root(&mut found);
        }
        agree(&self.what, &found)?;
        Ok(assemble(here, &found, band_rad_s))
    }

    /// The root at `p` nearest to `iω` and perhaps others around it; for a model solved densely, all up to twice `ω`.
    ///
    /// # Errors
    /// As [`Self::roots`].
    pub(super) fn nearest(&mut self, p: &OperatingPoint, omega: f64) -> Result<Vec<FullRoot>, ReductionError> {
        if self.model.dimension() < DENSE_BELOW {
            return Ok(self.dense(p, 2.0 * omega, FullVectors::None)?.roots);
        }
        let (what, here, by_parts) = (self.what.clone(), self.model.at(p)?, self.has_parts());
        let mut problem = Problem::new(&what, self.model, here, FullVectors::None, by_parts, self.is_real(), 0.0)?;
        problem.wanted = FEW;
        let shift = BESIDE * omega;
        Ok(self.around(&mut problem, shift, [omega, shift], &mut |_| {})?.roots)
    }

    /// The roots around `iω` until they cover `gap`, or as many as the problem wants.
    fn around(
        &mut self,
        problem: &mut Problem<'_>,
        omega: f64,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        match &mut self.factors {
            Some(factors) => {
                let index = Self::factored(factors, problem, omega, progress)?;
                problem.around_parts(factors.get(index), gap, progress)
            }
            None => problem.around_system(self.engine, omega, gap, progress),
        }
    }

    /// Index of the factors at the shift: `ω` itself or, if solves there are inaccurate because a root is too near, slightly
    /// above.
    fn factored(
        factors: &mut KeptFactors<'a>,
        problem: &Problem<'_>,
        omega: f64,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<usize, ReductionError> {
        let mut last = String::new();
        for attempt in 0..6 {
            let square = omega * omega * (1.0 + 0.002 * f64::from(attempt));
            let (index, made) = match factors.at(square) {
                Ok(at) => at,
                Err(ReductionError::Factorisation { reason, .. }) => {
                    last = reason;
                    continue;
                }
                Err(error) => return Err(error),
            };
            if let Some(precision) = made {
                progress(FullProgress::Factored { shift_rad_s: square.sqrt(), precision });
            }
            last = match problem.solve_residual(factors.get(index)) {
                Ok(residual) if residual < SOLVE_LIMIT => return Ok(index),
                Ok(residual) => format!("a solve leaves a residual of {residual:.1e}, limit {SOLVE_LIMIT:.1e}"),
                Err(stalled) => stalled.reason(),
            };
            factors.drop(index);
        }
        let reason = format!("L D Lᵀ around {omega} rad/s cannot be used: {last}");
        Err(ReductionError::Factorisation { what: problem.what.to_owned(), reason })
    }

    /// All roots of the band by a dense solve.
    fn dense(&self, p: &OperatingPoint, band_rad_s: f64, vectors: FullVectors) -> Result<FullSpectrum, ReductionError> {
        let n = self.model.dimension();
        let failed = |reason: String| ReductionError::Factorisation { what: self.what.clone(), reason };
        let here = self.model.at(p)?;
        let projected = self.model.project(Mat::<f64>::identity(n, n).as_ref())?;
        let model = projected.model(self.model.contact_law).map_err(|error| failed(error.to_string()))?;
        let which = if vectors == FullVectors::Both { Vectors::Both } else { Vectors::Right };
        let spectrum = physics::Solver::new(n).solve(&model, p, which).map_err(|error| failed(error.to_string()))?;
        let basis = Mat::from_fn(n, n, |i, j| c64::new(projected.basis[(i, j)], 0.0));
        let mut chosen: Vec<(c64, usize)> = vec![];
        for (k, root) in spectrum.roots.iter().enumerate().filter(|(_, root)| root.lambda.im <= band_rad_s) {
            chosen.push((root.lambda, k));
            if spectrum.undamped && root.lambda.re != 0.0 && root.lambda.im == 0.0 {
                chosen.push((-root.lambda, k));
            }
        }
        chosen.sort_by(|a, b| a.0.im.total_cmp(&b.0.im));
        let taken = |shapes: &Mat<c64>| {
            let shapes = Mat::from_fn(n, chosen.len(), |i, j| shapes[(i, chosen[j].1)]);
            unit(&basis * shapes)
        };
        Ok(FullSpectrum {
            here,
            roots: chosen
                .iter()
                .map(|&(lambda, k)| FullRoot { lambda, residual: spectrum.roots[k].residual })
                .collect(),
            right: if vectors == FullVectors::None { Mat::zeros(n, 0) } else { taken(&spectrum.shapes) },
            left: if vectors == FullVectors::Both { taken(&spectrum.left) } else { Mat::zeros(n, 0) },
            discs: vec![],
            covered_growth_per_s: f64::INFINITY,
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::SparseMatrix;
    use super::super::full_model::{FullContact, FullPart, SparseTerm};
    use super::super::precision::Precision;
    use super::*;
    use crate::physics::{ContactLaw, Law, Stribeck};
    use faer::sparse::Triplet;

    fn sparse(n: usize, triplets: &[(usize, usize, f64)]) -> SparseMatrix {
        let triplets: Vec<_> = triplets.iter().map(|&(i, j, value)| Triplet::new(i, j, value)).collect();
        SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap()
    }

    #[test]
    fn a_damped_unsymmetric_system_in_blocks() {
        // Blocks of two: [[a - d, w], [-w, a + d]] with unit mass, damping g; λ² + g λ + κ = 0, κ = a ± sqrt(d² - w²).
        let blocks = 150;
        let (mut mass, mut damping, mut stiffness, mut expected) = (vec![], vec![], vec![], vec![]);
        for b in 0..blocks {
            let a = (100.0 * (b + 1) as f64).powi(2);
            let (d, w, g) = (0.05 * a, if b % 3 == 0 { 0.08 * a } else { 0.03 * a }, 4.0 + (b % 7) as f64);
            let (i, j) = (2 * b, 2 * b + 1);
            for k in [i, j] {
                mass.push((k, k, 1.0));
                damping.push((k, k, g));
            }
            stiffness.extend([(i, i, a - d), (j, j, a + d), (i, j, w), (j, i, -w)]);
            let split = c64::new(d * d - w * w, 0.0).sqrt();
            for kappa in [c64::new(a, 0.0) + split, c64::new(a, 0.0) - split] {
                let root = (c64::new(g * g, 0.0) - kappa * 4.0).sqrt();
                for lambda in [(root - g) * 0.5, (-root - g) * 0.5] {
                    if lambda.im > 0.0 && lambda.im < 8000.0 {
                        expected.push(lambda);
                    }
                }
            }
        }
        let n = 2 * blocks;
        let term = |triplets: &[(usize, usize, f64)]| SparseTerm { matrix: sparse(n, triplets), law: Law::Constant };
        let model = FullModel {
            parts: vec![FullPart { name: "system".into(), mass: sparse(n, &mass), stiffness: sparse(n, &[]) }],
            stiffness: vec![term(&stiffness)],
            damping: vec![term(&damping)],
            modal_damping: vec![],
            contact: None,
            contact_law: ContactLaw::default(),
        };
        let mut solver = FullSolver::new("system", &model, None, &mut |_| {}).unwrap();
        let p = point(0.3);
        let found = solver.roots(&p, 8000.0, FullVectors::Both, &mut |_| {}).unwrap();
        // Flutter pairs have nearly equal imaginary parts, so their order is undefined: compare as sets.
        assert_eq!(found.roots.len(), expected.len());
        for lambda in expected {
            let nearest = found.roots.iter().map(|root| (root.lambda - lambda).norm()).fold(f64::INFINITY, f64::min);
            assert!(nearest < 1e-10 * lambda.norm(), "{lambda}: {nearest:e}");
        }
        assert!(found.discs.len() > 2 && found.covered_growth_per_s > 100.0, "{:?}", found.discs);
        vectors_belong(&model, &p, &found);
    }

    /// Removes one root that lies in two neighbouring discs from the second of them.
    pub(super) fn lose_a_root(found: &mut [Found]) {
        for k in 1..found.len() {
            let (before, disc) = (found[k - 1].disc, found[k].disc);
            let shared = found[k].roots.iter().position(|root| before.holds(root.lambda) && disc.holds(root.lambda));
            if let Some(shared) = shared {
                found[k].roots.remove(shared);
                return;
            }
        }
        panic!("no two discs share a root");
    }

    /// A root missing from one of two overlapping discs is an error that names both shifts. A band that the allowed
    /// number of shifts does not cover is an error too.
    #[test]
    fn a_lost_root_and_a_gap_are_errors() {
        use crate::spoil::{Spoil, with};
        let model = touching(60, 0.0, ContactLaw::default());
        let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
        let mut roots = || solver.roots(&point(0.7), 900.0, FullVectors::None, &mut |_| {});
        let lost = with(Spoil::Root, &mut roots).map(|found| found.roots.len());
        assert!(matches!(lost, Err(ReductionError::MissedRoot { found, missed, .. }) if found != missed), "{lost:?}");
        let gap = with(Spoil::Shifts, &mut roots).map(|found| found.roots.len());
        assert!(matches!(gap, Err(ReductionError::NotCovered { covered, band, .. }) if covered < band), "{gap:?}");
        assert!(roots().is_ok());
    }

    pub(in crate::reduction) fn point(friction_coefficient: f64) -> OperatingPoint {
        OperatingPoint { normal_load_n: 600.0, disc_speed_rad_s: 7.0, friction_coefficient }
    }

    /// Checks that right and left vectors satisfy the full eigenvalue problem to rounding, relative to the norm of
    /// `Q(λ)`.
    fn vectors_belong(model: &FullModel, p: &OperatingPoint, found: &FullSpectrum) {
        let [mass, damping, stiffness] = model.matrices_at(p).unwrap().map(|matrix| matrix.to_dense());
        let n = model.dimension();
        for (k, root) in found.roots.iter().enumerate() {
            let lambda = root.lambda;
            let q = Mat::from_fn(n, n, |i, j| {
                lambda * lambda * mass[(i, j)] + lambda * damping[(i, j)] + c64::new(stiffness[(i, j)], 0.0)
            });
            let (x, y) = (found.right.subcols(k, 1), found.left.subcols(k, 1));
            assert!((&q * x).norm_l2() < 1e-10 * q.norm_l2(), "right of {lambda}");
            assert!((y.adjoint() * &q).norm_l2() < 1e-10 * q.norm_l2(), "left of {lambda}");
        }
    }

    /// Two chains of `nodes` nodes with three degrees of freedom each and different springs per direction, in contact
    /// at every seventh node.
    pub(in crate::reduction) fn touching(nodes: usize, damping: f64, law: ContactLaw) -> FullModel {
        let part = |name: &str, spring: f64, first: f64| {
            let (mut mass, mut stiffness) = (vec![], vec![]);
            for node in 0..nodes {
                for axis in 0..3 {
                    let (i, weight) = (3 * node + axis, 1.0 + 0.3 * ((node + axis) as f64 * first).sin());
                    mass.push((i, i, weight));
                    let k = spring * (1.0 + 0.2 * axis as f64);
                    stiffness.push((i, i, 2.0 * k));
                    if node > 0 {
                        stiffness.extend([(i, i - 3, -k), (i - 3, i, -k)]);
                    }
                    // Weak coupling between directions.
                    let j = 3 * node + (axis + 1) % 3;
                    stiffness.extend([(i, i, 0.05 * k), (j, j, 0.05 * k), (i, j, -0.05 * k), (j, i, -0.05 * k)]);
                }
            }
            FullPart { name: name.into(), mass: sparse(3 * nodes, &mass), stiffness: sparse(3 * nodes, &stiffness) }
        };
        let touching: Vec<usize> = (0..nodes).step_by(7).collect();
        let rows = |axis: usize| {
            let row = |&node: &usize| vec![(3 * node + axis, 1.0), (3 * nodes + 3 * node + axis, -1.0)];
            touching.iter().map(row).collect::<Vec<_>>()
        };
        FullModel {
            parts: vec![part("pad", 1e6, 0.4), part("disc", 1.7e6, 0.9)],
            stiffness: vec![],
            damping: vec![],
            modal_damping: vec![],
            contact: Some(FullContact {
                steady: None,
                normal: rows(1),
                sliding: rows(0),
                lateral: rows(2),
                stiffness_n_per_m: vec![4e5; touching.len()],
                damping_n_s_per_m: vec![damping; touching.len()],
                radius_m: vec![0.1; touching.len()],
            }),
            contact_law: law,
        }
    }

    /// Roots agree with a dense solve of the same matrices, undamped and with every kind of contact damping.
    #[test]
    fn touching_parts_against_a_dense_solve() {
        let law = ContactLaw {
            exponent: 0.5,
            reference_n: 500.0,
            slope_s_per_m: -0.01,
            stribeck: Some(Stribeck { drop: 0.02, speed_m_s: 1.5, exponent: 2.0 }),
            lateral_damping: true,
        };
        for (damping, law) in [(0.0, ContactLaw::default()), (3.0, law)] {
            let model = touching(60, damping, law);
            let n = model.dimension();
            assert!(n > DENSE_BELOW);
            let p = point(0.7);
            let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
            let band = 900.0;
            let found = solver.roots(&p, band, FullVectors::Both, &mut |_| {}).unwrap();
            let projected = model.project(Mat::<f64>::identity(n, n).as_ref()).unwrap();
            let dense = projected.model(model.contact_law).unwrap();
            let spectrum = physics::Solver::new(n).solve(&dense, &p, Vectors::Right).unwrap();
            let expected: Vec<c64> = spectrum.roots.iter().map(|root| root.lambda).filter(|l| l.im <= band).collect();
            assert!(expected.len() > 60, "{}", expected.len());
            assert_eq!(found.roots.len(), expected.len(), "{:?}", found.discs);
            let mut left = expected;
            for root in &found.roots {
                let (index, off) = left
                    .iter()
                    .enumerate()
                    .map(|(index, lambda)| (index, (lambda * lambda - root.lambda * root.lambda).norm()))
                    .min_by(|a, b| a.1.total_cmp(&b.1))
                    .unwrap();
                // Error of the dense solve: ε times the largest `|λ²|`, 1e7, times condition numbers of a few hundred.
                assert!(off < 1e-6, "{} off by {off:e}", root.lambda);
                left.swap_remove(index);
            }
            vectors_belong(&model, &p, &found);
            for root in found.roots.iter().filter(|root| root.lambda.im > 0.0).step_by(7) {
                let omega = root.lambda.im;
                let distance = |roots: &[FullRoot]| {
                    let distances = roots.iter().map(|other| (other.lambda - c64::new(0.0, omega)).norm());
                    distances.fold(f64::INFINITY, f64::min)
                };
                let nearest = solver.nearest(&p, omega).unwrap();
                let off = (distance(&nearest) - distance(&found.roots)).abs();
                assert!(off < 1e-6 && nearest.len() < 20, "{} off by {off:e}", root.lambda);
            }
            // Open contact, and another operating point with the same factors.
            let open = OperatingPoint { normal_load_n: 0.0, ..p };
            assert!(solver.roots(&open, band, FullVectors::None, &mut |_| {}).unwrap().roots.len() > 60);
            let mut made = 0;
            let mut count = |step: FullProgress| made += usize::from(matches!(step, FullProgress::Factored { .. }));
            solver.roots(&point(0.2), 0.2 * band, FullVectors::None, &mut count).unwrap();
            solver.roots(&point(0.3), 0.2 * band, FullVectors::None, &mut count).unwrap();
            assert_eq!(made, 1);
        }
    }

    /// With memory for one factor in single precision, roots and vectors are those of double precision. A wrong factor
    /// in single precision is refused.
    #[test]
    fn factors_in_single_precision_give_the_same_roots() {
        for damping in [0.0, 3.0] {
            let (model, p, band) = (touching(200, damping, ContactLaw::default()), point(0.7), 300.0);
            let solve = |solver: &mut FullSolver<'_>| {
                let mut precisions = vec![];
                let found = solver.roots(&p, band, FullVectors::Both, &mut |step| {
                    if let FullProgress::Factored { precision, .. } = step {
                        precisions.push(precision);
                    }
                });
                (found, precisions)
            };
            let need = |limit: Option<usize>| {
                let mut need = 0;
                let solver = FullSolver::new("full", &model, limit, &mut |step| {
                    if let FullProgress::Analysed { bytes } = step {
                        need = bytes;
                    }
                });
                (solver.unwrap(), need)
            };
            let (mut double, most) = need(None);
            let (expected, precisions) = solve(&mut double);
            let expected = expected.unwrap();
            assert!(!precisions.is_empty() && precisions.iter().all(|precision| *precision == Precision::Double));

            let (mut single, less) = need(Some(most - 1));
            assert!(0 < less && less < most);
            let (found, precisions) = solve(&mut single);
            let found = found.unwrap();
            assert!(!precisions.is_empty() && precisions.iter().all(|precision| *precision == Precision::Single));
            assert!(expected.roots.len() > 20 && found.roots.len() == expected.roots.len());
            for (found, expected) in found.roots.iter().zip(&expected.roots) {
                // Both differ from the roots by their residuals, relative to `|K|`, about 1e7, times condition numbers of a few
                // hundred.
                let off = (found.lambda * found.lambda - expected.lambda * expected.lambda).norm();
                let limit = 1e10 * (found.residual + expected.residual);
                assert!(off < limit, "{} {}: {off:e}, limit {limit:e}", found.lambda, expected.lambda);
            }
            vectors_belong(&model, &p, &found);

            let (mut wrong, _) = need(Some(most - 1));
            let refused = crate::spoil::with(crate::spoil::Spoil::Factor, || solve(&mut wrong).0.map(|_| ()));
            let Err(ReductionError::Factorisation { reason, .. }) = refused else { panic!("{refused:?}") };
            assert!(reason.contains("in single precision is too inaccurate"), "{reason}");
        }
    }

    #[test]
    fn too_little_memory_is_refused() {
        let model = touching(100, 0.0, ContactLaw::default());
        let refused = FullSolver::new("full", &model, Some(1 << 20), &mut |_| {});
        assert!(matches!(refused.err(), Some(ReductionError::Memory { limit: 1_048_576, .. })));
    }
}
