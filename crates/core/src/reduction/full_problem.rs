//! The eigenvalue problem of a full model at one operating point: products with its matrices, the shift-inverted
//! operator for Krylov-Schur, and residuals of the roots found around a shift.

use faer::linalg::solvers::Solve as _;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, MatRef, c64};

use super::contact_solver::{Coupled, Shifted};
use super::coverage::{Found, SAME};
use super::engine::Engine;
use super::full_model::{FullModel, LowRank};
use super::full_root::{CoveredDisc, FullProgress, FullRoot, FullVectors};
use super::krylov::{Number, random};
use super::krylov_schur::{Iteration, Largest};
use super::precision::Precision;
use super::refinement::Stalled;
use super::sparse::{entries, one_norm, symmetric_times, times_transposed, transposed};
use super::{ReductionError, SparseMatrix, weighted_sum};
use crate::physics::Situation;

/// Largest residual of an eigenpair of the inverse, relative to its `θ`.
const KRYLOV_LIMIT: f64 = 1e-12;
/// Number of roots sought around each shift.
pub(super) const WANTED: usize = 48;
/// Largest scaled residual of a root, see [`FullRoot::residual`]. An eigenpair `(θ, x)` of the inverse with residual
/// `e` has the residual `Q(s) e/θ` in the original problem. That is at most [`KRYLOV_LIMIT`] times the norms at the
/// shift. They differ from the norms at the root by the mass term only, which weighs no more than the stiffness, and so
/// are at most twice as large. Linearisation doubles the bound again, because both halves of the vector contribute.
const RESIDUAL_LIMIT: f64 = 4.0 * KRYLOV_LIMIT;
/// Imaginary part, relative to `|λ|`, below which a root counts as static.
const REAL: f64 = 1e-9;
/// `|λ²|`, relative to that of the shift, below which a root is a rigid-body mode and counts as 0.
const FLOATING: f64 = 1e-10;
/// Number of columns whose residuals are computed at a time.
const TOGETHER: usize = 8;
const ZERO: c64 = c64::new(0.0, 0.0);

/// `Q(s)⁻¹ b`, or `Q(s)⁻ᵀ b` if the second argument is true.
type Solve<'a> = dyn Fn(MatRef<'_, c64>, bool) -> Result<Mat<c64>, ReductionError> + 'a;

/// The assembled `M`, `C`, `K`, and `Cᵀ`, `Kᵀ`, from whose columns products with `C` and `K` are gathered.
struct Assembled {
    matrices: [SparseMatrix; 3],
    transposed: [SparseMatrix; 2],
}

/// A full model at one operating point.
pub(super) struct Problem<'a> {
    pub what: &'a str,
    model: &'a FullModel,
    here: Situation,
    vectors: FullVectors,
    pub undamped: bool,
    low_rank: LowRank,
    /// `None` for a model of parts joined by contact.
    assembled: Option<Assembled>,
    /// 1-norms of `M`, `C`, `K`; estimates for a model of parts.
    norms: [f64; 3],
    /// Magnitude of growth rate that the discs must cover, 1/s.
    growth_per_s: f64,
    /// Number of roots sought around a shift.
    pub wanted: usize,
}

impl<'a> Problem<'a> {
    pub fn new(
        what: &'a str,
        model: &'a FullModel,
        here: Situation,
        vectors: FullVectors,
        by_parts: bool,
        undamped: bool,
        growth_per_s: f64,
    ) -> Result<Self, ReductionError> {
        let wanted = WANTED;
        if by_parts {
            let low_rank = model.low_rank(&here);
            let largest = |matrix: &dyn Fn(usize) -> f64| (0..model.parts.len()).map(matrix).fold(0.0, f64::max);
            // 1-norm of one contact pair: `|leftᵀ k right|₁ ≤ |k| |left|₁ |right|∞`. The largest pair represents the
            // sum, because pairs share few columns.
            let pairs = |weights: &[f64]| {
                let size = |k: usize| {
                    let left: f64 = low_rank.left[k].iter().map(|(_, weight)| weight.abs()).sum();
                    let right = low_rank.right[k].iter().map(|(_, weight)| weight.abs()).fold(0.0, f64::max);
                    weights[k].abs() * left * right
                };
                (0..weights.len()).map(size).fold(0.0, f64::max)
            };
            let norms = [
                largest(&|part| one_norm(&model.parts[part].mass)),
                pairs(&low_rank.damping),
                largest(&|part| one_norm(&model.parts[part].stiffness)) + pairs(&low_rank.stiffness),
            ];
            let undamped = low_rank.damping.iter().all(|value| *value == 0.0);
            return Ok(Self {
                what,
                model,
                here,
                vectors,
                undamped,
                low_rank,
                assembled: None,
                norms,
                growth_per_s,
                wanted,
            });
        }
        let matrices = model.matrices_in(&here)?;
        let [_, damping, stiffness] = &matrices;
        let transposed = [transposed(damping)?, transposed(stiffness)?];
        // Upper bound of the 1-norm of `W diag(r) Wᵀ`: the largest sum over its columns.
        let (modes, rates) = model.modal_factors();
        let sizes: Vec<f64> = modes.col_iter().zip(&rates).map(|(column, rate)| rate * column.norm_l1()).collect();
        let column = |i: usize| sizes.iter().enumerate().map(|(j, size)| size * modes[(i, j)].abs()).sum::<f64>();
        let of_modes = (0..modes.nrows()).map(column).fold(0.0, f64::max);
        let norms = [one_norm(&matrices[0]), one_norm(&matrices[1]) + of_modes, one_norm(&matrices[2])];
        let low_rank = LowRank::default();
        Ok(Self {
            what,
            model,
            here,
            vectors,
            undamped,
            low_rank,
            assembled: Some(Assembled { matrices, transposed }),
            norms,
            growth_per_s,
            wanted,
        })
    }

    /// `(a M + b C + c K) X`, or `(a M + b C + c K)ᵀ X` if `transposed`.
    fn times(&self, [a, b, c]: [c64; 3], x: MatRef<'_, c64>, transposed: bool) -> Mat<c64> {
        let k = x.ncols();
        // Real matrices multiply the real and imaginary parts as separate columns.
        let parts = Mat::from_fn(x.nrows(), 2 * k, |i, j| if j < k { x[(i, j)].re } else { x[(i, j - k)].im });
        let product = |which: usize| match (&self.assembled, which) {
            (Some(assembled), _) => {
                let Assembled { matrices, transposed: [damping, stiffness] } = assembled;
                let of = match which {
                    1 if !transposed => damping,
                    2 if !transposed => stiffness,
                    _ => &matrices[which],
                };
                let product = times_transposed(of, parts.as_ref());
                if which == 1 && !self.model.modal_damping.is_empty() {
                    product + self.model.modal_damping_times(parts.as_ref())
                } else {
                    product
                }
            }
            (None, 0) => self.model.mass_times(parts.as_ref()),
            (None, 1) => self.model.damping_times(&self.here, parts.as_ref(), transposed),
            (None, _) => self.model.stiffness_times(&self.here, parts.as_ref(), transposed),
        };
        let mut sum = Mat::<c64>::zeros(x.nrows(), k);
        for (which, factor) in [a, b, c].into_iter().enumerate().filter(|(_, factor)| *factor != ZERO) {
            let of = product(which);
            for j in 0..k {
                for i in 0..x.nrows() {
                    sum[(i, j)] += factor * c64::new(of[(i, j)], of[(i, k + j)]);
                }
            }
        }
        sum
    }

    /// Scaled residual of every column, see [`FullRoot::residual`]; with `transposed` matrices for left vectors.
    fn residuals(&self, lambdas: &[c64], x: MatRef<'_, c64>, transposed: bool) -> Vec<f64> {
        let mut residuals = vec![];
        let one = c64::new(1.0, 0.0);
        for first in (0..lambdas.len()).step_by(TOGETHER) {
            let width = TOGETHER.min(lambdas.len() - first);
            let chunk = x.subcols(first, width);
            let of = [[one, ZERO, ZERO], [ZERO, one, ZERO], [ZERO, ZERO, one]];
            let [mass, damping, stiffness] = of.map(|factors| self.times(factors, chunk, transposed));
            for j in 0..width {
                let lambda = lambdas[first + j];
                let value = |i: usize| lambda * lambda * mass[(i, j)] + lambda * damping[(i, j)] + stiffness[(i, j)];
                let norm = (0..x.nrows()).map(|i| value(i).norm_sqr()).sum::<f64>().sqrt();
                let rate = lambda.norm();
                let parts = rate * rate * self.norms[0] + rate * self.norms[1] + self.norms[2];
                residuals.push(norm / (parts * chunk.col(j).norm_l2()));
            }
        }
        residuals
    }

    /// Scaled residual of one solve with a random right-hand side at a shift, relative to `|Q| |x| + |b|`.
    ///
    /// # Errors
    /// [`Stalled`] if the factors are in single precision and too inaccurate.
    pub fn solve_residual(&self, shifted: &Shifted) -> Result<f64, Stalled> {
        let s = c64::new(0.0, shifted.square.sqrt());
        let b = random::<c64>(self.model.dimension(), 1, 77);
        let times = |x: MatRef<'_, c64>| self.times([s * s, s, c64::new(1.0, 0.0)], x, false);
        let x = self.coupled(shifted, s, false).solve(b.as_ref(), times)?;
        let r = times(x.as_ref()) - &b;
        let parts = shifted.square * self.norms[0] + s.im * self.norms[1] + self.norms[2];
        Ok(r.norm_l2() / (parts * x.norm_l2() + b.norm_l2()))
    }

    fn coupled<'s>(&self, shifted: &'s Shifted, s: c64, transposed: bool) -> Coupled<'s, c64> {
        let weight = |(k, c): (&f64, &f64)| c64::new(*k, 0.0) + s * *c;
        let weights = self.low_rank.stiffness.iter().zip(&self.low_rank.damping).map(weight).collect();
        shifted.couple(&self.low_rank, weights, transposed)
    }

    fn stalled(&self, stalled: Stalled) -> ReductionError {
        ReductionError::Factorisation { what: self.what.to_owned(), reason: stalled.reason() }
    }

    /// The roots nearest to a shift, for a model of parts joined by contact.
    pub fn around_parts(
        &mut self,
        shifted: &Shifted,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let (square, omega) = (shifted.square, shifted.square.sqrt());
        if !self.undamped {
            let s = c64::new(0.0, omega);
            // Solvers with `Q(s)` and with its transpose, each set up once.
            let (forward, backward) = (self.coupled(shifted, s, false), self.coupled(shifted, s, true));
            let solve = |b: MatRef<'_, c64>, transposed: bool| {
                let solver = if transposed { &backward } else { &forward };
                let times = |x: MatRef<'_, c64>| self.times([s * s, s, c64::new(1.0, 0.0)], x, transposed);
                solver.solve(b, times).map_err(|stalled| self.stalled(stalled))
            };
            return self.linearised(omega, gap, &solve, progress);
        }
        let coupled = [false, true]
            .map(|transposed| shifted.couple::<f64>(&self.low_rank, self.low_rank.stiffness.clone(), transposed));
        let inverse = |x: Mat<f64>, transposed: bool| {
            let b = self.model.mass_times(x.as_ref());
            let times = |x: MatRef<'_, f64>| {
                self.model.stiffness_times(&self.here, x, transposed) - faer::Scale(square) * self.model.mass_times(x)
            };
            coupled[usize::from(transposed)].solve(b.as_ref(), times).map_err(|stalled| self.stalled(stalled))
        };
        self.around(omega, gap, &inverse, &|theta| undamped_roots(theta, square), progress)
    }

    /// The roots nearest to `iω` of an undamped model, for assembled matrices.
    fn around_undamped(
        &self,
        engine: &dyn Engine,
        omega: f64,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let Some(Assembled { matrices: [mass, _, stiffness], .. }) = &self.assembled else {
            unreachable!("a system has its matrices");
        };
        let square = omega * omega;
        let sum = weighted_sum(mass.nrows(), &[(1.0, stiffness), (-square, mass)])?;
        let factor = engine.real(self.what, &sum)?;
        drop(sum);
        progress(FullProgress::Factored { shift_rad_s: omega, precision: Precision::Double });
        let inverse = |x: Mat<f64>, transposed: bool| {
            let mut b = symmetric_times(mass, x.as_ref());
            factor.solve(&mut b, transposed)?;
            Ok(b)
        };
        self.around(omega, gap, &inverse, &|theta| undamped_roots(theta, square), progress)
    }

    /// The roots nearest to a shift, for assembled matrices.
    pub fn around_system(
        &mut self,
        engine: &dyn Engine,
        omega: f64,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        if self.undamped {
            return self.around_undamped(engine, omega, gap, progress);
        }
        let Some(Assembled { matrices: [mass, damping, stiffness], .. }) = &self.assembled else {
            unreachable!("a system has its matrices");
        };
        let failed = |reason: String| ReductionError::Factorisation { what: self.what.to_owned(), reason };
        let (n, s) = (mass.nrows(), c64::new(0.0, omega));
        let triplets: Vec<Triplet<usize, usize, c64>> = [(s * s, mass), (s, damping), (c64::new(1.0, 0.0), stiffness)]
            .into_iter()
            .flat_map(|(weight, matrix)| entries(matrix).map(move |(i, j, value)| Triplet::new(i, j, weight * value)))
            .collect();
        let sum = SparseColMat::try_new_from_triplets(n, n, &triplets).map_err(|error| failed(format!("{error:?}")))?;
        drop(triplets);
        let factor = engine.complex(self.what, &sum)?;
        drop(sum);
        progress(FullProgress::Factored { shift_rad_s: omega, precision: Precision::Double });
        let sparse = |b: MatRef<'_, c64>, transposed: bool| {
            let mut x = b.to_owned();
            factor.solve(&mut x, transposed)?;
            Ok::<_, ReductionError>(x)
        };
        if self.model.modal_damping.is_empty() {
            return self.linearised(omega, gap, &sparse, progress);
        }
        // Woodbury: (A + W S Wᵀ)⁻¹ b = A⁻¹ b - Z (I + S Wᵀ Z)⁻¹ S Wᵀ A⁻¹ b,  Z = A⁻¹ W,  S = diag(2 ζ ω s).
        let (modes, rates) = self.model.modal_factors();
        let modes = Mat::from_fn(n, modes.ncols(), |i, j| c64::new(modes[(i, j)], 0.0));
        let weighted =
            |along: Mat<c64>| Mat::from_fn(along.nrows(), along.ncols(), |i, j| s * rates[i] * along[(i, j)]);
        let correction = |transposed: bool| {
            let responses = sparse(modes.as_ref(), transposed)?;
            let coupled = weighted(modes.transpose() * &responses) + Mat::<c64>::identity(rates.len(), rates.len());
            Ok::<_, ReductionError>((responses, coupled.partial_piv_lu()))
        };
        let corrections = [correction(false)?, correction(true)?];
        let solve = |b: MatRef<'_, c64>, transposed: bool| {
            let x = sparse(b, transposed)?;
            let (responses, coupled) = &corrections[usize::from(transposed)];
            let mut along = weighted(modes.transpose() * &x);
            coupled.solve_in_place(along.as_mut());
            Ok(x - responses * along)
        };
        self.linearised(omega, gap, &solve, progress)
    }

    /// The roots nearest to `iω` by the linearised problem. `solve` returns `Q(iω)⁻¹ b`, or `Q(iω)⁻ᵀ b` if its second
    /// argument is true.
    fn linearised(
        &self,
        omega: f64,
        gap: [f64; 2],
        solve: &Solve<'_>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let n = self.model.dimension();
        let (s, one) = (c64::new(0.0, omega), c64::new(1.0, 0.0));
        // Velocities are divided by ω, so that both halves of a vector have similar magnitude.
        let inverse = |v: Mat<c64>, transposed: bool| {
            let (x, y) = (v.subrows(0, n), v.subrows(n, n));
            let b = self.times([c64::new(-omega, 0.0), ZERO, ZERO], y, transposed)
                + self.times([-s, -one, ZERO], x, transposed);
            let next = solve(b.as_ref(), transposed)?;
            Ok(Mat::from_fn(2 * n, v.ncols(), |i, j| {
                if i < n { next[(i, j)] } else { (x[(i - n, j)] + s * next[(i - n, j)]) / omega }
            }))
        };
        let lambdas_of = |theta: c64| {
            let lambda = s + 1.0 / theta;
            if lambda.im < -REAL * lambda.norm() { vec![] } else { vec![c64::new(lambda.re, lambda.im.max(0.0))] }
        };
        self.around(omega, gap, &inverse, &lambdas_of, progress)
    }

    /// The roots nearest to `iω`, from the largest eigenvalues `θ` of `inverse`; `lambdas_of` maps `θ` to roots. The
    /// operator is real of size `n`, in `κ`, or complex of size `2n`, in `λ`. Left vectors are computed as eigenvectors
    /// of the transposed problem.
    fn around<T: Number>(
        &self,
        omega: f64,
        gap: [f64; 2],
        inverse: &dyn Fn(Mat<T>, bool) -> Result<Mat<T>, ReductionError>,
        lambdas_of: &dyn Fn(c64) -> Vec<c64>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let n = self.model.dimension();
        let dimension = if T::REAL { n } else { 2 * n };
        let disc_of = |theta: &[c64]| {
            let radius = theta.last().map_or(0.0, |last| 1.0 / last.norm());
            CoveredDisc { shift_rad_s: omega, radius, squared: T::REAL }
        };
        let mut run = |transposed: bool, wanted: usize| {
            let iteration = Iteration {
                what: self.what,
                dimension,
                count: wanted,
                residual_limit: KRYLOV_LIMIT,
                seed: if transposed { 2 } else { 1 },
            };
            let covered =
                |theta: &[c64]| if transposed { 0.0 } else { disc_of(theta).share_of(gap, self.growth_per_s) };
            let Largest { theta, vectors } =
                iteration.run::<T>(&|x| inverse(x, transposed), &covered, &mut |vectors, converged| {
                    progress(FullProgress::Iterated { shift_rad_s: omega, vectors, converged, wanted });
                })?;
            let vectors = if T::REAL { vectors } else { vectors.subrows(0, n).to_owned() };
            Ok::<_, ReductionError>(Largest { theta, vectors })
        };
        let found = run(false, self.wanted.min(dimension / 4))?;
        let disc = disc_of(&found.theta);
        let left = match self.vectors {
            FullVectors::Both => Some(run(true, found.theta.len())?),
            FullVectors::None => None,
        };
        self.finish(disc, found, left, lambdas_of)
    }

    /// Roots with their residuals and the requested vectors.
    ///
    /// # Errors
    /// [`ReductionError`]: `Residual`; `MissedRoot` if a root has no partner among those of the transposed problem.
    fn finish(
        &self,
        disc: CoveredDisc,
        found: Largest,
        left: Option<Largest>,
        lambdas_of: &dyn Fn(c64) -> Vec<c64>,
    ) -> Result<Found, ReductionError> {
        let n = self.model.dimension();
        let listed = |theta: &[c64]| -> Vec<(c64, usize)> {
            theta
                .iter()
                .enumerate()
                .flat_map(|(k, &theta)| lambdas_of(theta).into_iter().map(move |lambda| (lambda, k)))
                .collect()
        };
        let roots = listed(&found.theta);
        let gathered = |vectors: &Mat<c64>, columns: &[usize]| {
            unit(Mat::from_fn(n, columns.len(), |i, j| vectors[(i, columns[j])]))
        };
        let columns: Vec<usize> = roots.iter().map(|(_, k)| *k).collect();
        let right = gathered(&found.vectors, &columns);
        drop(found);
        let lambdas: Vec<c64> = roots.iter().map(|(lambda, _)| *lambda).collect();
        let residuals = self.checked(&lambdas, &right, false)?;
        let left = match left {
            None => Mat::zeros(n, 0),
            Some(left) => {
                let mut of_left = listed(&left.theta);
                // Near merging roots, the roots of the transposed problem differ by the square root of rounding errors.
                let (mut columns, mut own) = (vec![], vec![]);
                for lambda in &lambdas {
                    let off = |other: &(c64, usize)| (other.0 - lambda).norm();
                    let nearest = (0..of_left.len()).min_by(|&a, &b| off(&of_left[a]).total_cmp(&off(&of_left[b])));
                    match nearest.filter(|&k| off(&of_left[k]) < SAME * lambda.norm().max(disc.shift_rad_s * SAME)) {
                        Some(k) => {
                            let (lambda, column) = of_left.swap_remove(k);
                            own.push(lambda);
                            columns.push(column);
                        }
                        None => {
                            return Err(ReductionError::MissedRoot {
                                what: format!("{} (transposed)", self.what),
                                growth_per_s: lambda.re,
                                omega_rad_s: lambda.im,
                                found: disc.shift_rad_s,
                                missed: disc.shift_rad_s,
                            });
                        }
                    }
                }
                let mut vectors = gathered(&left.vectors, &columns);
                drop(left);
                self.checked(&own, &vectors, true)?;
                // uᵀ Q = 0: yᴴ Q = 0 with y the conjugate of u.
                vectors.col_iter_mut().for_each(|column| column.iter_mut().for_each(|value| *value = value.conj()));
                vectors
            }
        };
        let roots =
            lambdas.into_iter().zip(residuals).map(|(lambda, residual)| FullRoot { lambda, residual }).collect();
        let right = if self.vectors == FullVectors::None { Mat::zeros(n, 0) } else { right };
        Ok(Found { disc, roots, right, left })
    }

    /// Residuals of all pairs.
    ///
    /// # Errors
    /// [`ReductionError::Residual`] for the first one above [`RESIDUAL_LIMIT`].
    fn checked(&self, lambdas: &[c64], x: &Mat<c64>, transposed: bool) -> Result<Vec<f64>, ReductionError> {
        let residuals = self.residuals(lambdas, x.as_ref(), transposed);
        match residuals.iter().enumerate().find(|(_, value)| value.is_nan() || **value > RESIDUAL_LIMIT) {
            None => Ok(residuals),
            Some((mode, &value)) => {
                Err(ReductionError::Residual { what: self.what.to_owned(), mode, value, limit: RESIDUAL_LIMIT })
            }
        }
    }
}

/// The roots of an undamped model for an eigenvalue `θ` of `(K - ω² M)⁻¹ M`, with `ω² = square`. `±λ` share a vector:
/// oscillating roots are listed once, static ones with both signs.
fn undamped_roots(theta: c64, square: f64) -> Vec<c64> {
    let kappa = 1.0 / theta + square;
    if kappa.norm() < FLOATING * square {
        return vec![ZERO];
    }
    let root = (-kappa).sqrt();
    let root = if root.im < 0.0 { -root } else { root };
    if root.im > REAL * root.norm() { vec![root] } else { vec![c64::new(root.re, 0.0), c64::new(-root.re, 0.0)] }
}

/// Scales every column to 2-norm 1.
pub(super) fn unit(mut vectors: Mat<c64>) -> Mat<c64> {
    for k in 0..vectors.ncols() {
        let norm = vectors.col(k).norm_l2();
        vectors.col_mut(k).iter_mut().for_each(|value| *value /= norm);
    }
    vectors
}
