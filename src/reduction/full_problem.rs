//! A full model at one operating point, and its roots around a shift: products with its matrices, the inverse that Krylov-Schur
//! takes, residuals of what it finds.

use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::Lu;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, MatRef, c64};

use super::contact_solver::{Coupled, Shifted};
use super::coverage::{CoveredDisc, Found, SAME};
use super::full_model::{FullModel, LowRank};
use super::full_order::{FullProgress, FullRoot, FullVectors, WANTED};
use super::krylov_schur::{Iteration, Largest, random};
use super::sparse::{entries, one_norm, times};
use super::{ReductionError, SparseMatrix};
use crate::physics::OperatingPoint;

/// Residual a pair of the inverse may have, relative to its `θ`.
const KRYLOV_LIMIT: f64 = 1e-12;
/// Residual a root may have, relative to the size of its parts. A pair `(θ, x)` of the inverse that leaves `e` leaves `Q(s) e/θ` in the
/// problem itself: at most [`KRYLOV_LIMIT`] times the parts at the shift, which are those at the root but for the mass, of no more weight
/// than the stiffness: twice as much. Linearised, both halves of the vector leave as much.
const RESIDUAL_LIMIT: f64 = 4.0 * KRYLOV_LIMIT;
/// Imaginary part, relative to `|λ|`, below which a root does not oscillate.
const REAL: f64 = 1e-9;
/// `|λ²|`, relative to that of the shift, of a body that floats freely.
const FLOATING: f64 = 1e-10;
/// Columns that residuals are computed of at once.
const TOGETHER: usize = 8;
const ZERO: c64 = c64::new(0.0, 0.0);

/// A full model at one operating point.
pub(super) struct Problem<'a> {
    pub what: &'a str,
    model: &'a FullModel,
    vectors: FullVectors,
    pub undamped: bool,
    low_rank: LowRank,
    /// `M`, `C`, `K` as they are, of a system.
    matrices: Option<[SparseMatrix; 3]>,
    /// 1-norms of `M`, `C`, `K`.
    norms: [f64; 3],
    /// Growth rates that are to be covered, 1/s.
    growth_per_s: f64,
}

impl<'a> Problem<'a> {
    pub fn new(
        what: &'a str,
        model: &'a FullModel,
        p: &OperatingPoint,
        vectors: FullVectors,
        by_parts: bool,
        growth_per_s: f64,
    ) -> Result<Self, ReductionError> {
        if by_parts {
            let low_rank = model.low_rank(p);
            let largest = |matrix: &dyn Fn(usize) -> f64| (0..model.parts.len()).map(matrix).fold(0.0, f64::max);
            // Pair by pair, |leftᵀ k right|₁ is at most |k| |left|₁ |right|∞; pairs share few columns.
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
            return Ok(Self { what, model, vectors, undamped, low_rank, matrices: None, norms, growth_per_s });
        }
        let matrices = model.matrices_at(p)?;
        let norms = [one_norm(&matrices[0]), one_norm(&matrices[1]), one_norm(&matrices[2])];
        let low_rank = LowRank::default();
        Ok(Self { what, model, vectors, undamped: false, low_rank, matrices: Some(matrices), norms, growth_per_s })
    }

    /// `(a M + b C + c K) X`, or with the transposed matrices.
    fn times(&self, [a, b, c]: [c64; 3], x: MatRef<'_, c64>, transposed: bool) -> Mat<c64> {
        let k = x.ncols();
        // Real matrices times real and imaginary parts side by side.
        let parts = Mat::from_fn(x.nrows(), 2 * k, |i, j| if j < k { x[(i, j)].re } else { x[(i, j - k)].im });
        let complex = |of: &Mat<f64>, i: usize, j: usize| c64::new(of[(i, j)], of[(i, k + j)]);
        let mut sum = Mat::<c64>::zeros(x.nrows(), k);
        let mut add = |factor: c64, product: &Mat<f64>, offset: usize| {
            for j in 0..k {
                for i in 0..product.nrows() {
                    sum[(offset + i, j)] += factor * complex(product, i, j);
                }
            }
        };
        match &self.matrices {
            Some(matrices) => {
                for (factor, matrix) in [a, b, c].into_iter().zip(matrices) {
                    if factor != ZERO {
                        let product =
                            if transposed { times_transposed(matrix, &parts) } else { times(matrix, parts.as_ref()) };
                        add(factor, &product, 0);
                    }
                }
            }
            None => {
                for (part, offset) in self.model.parts.iter().zip(self.model.offsets()) {
                    let rows = parts.subrows(offset, part.mass.nrows());
                    for (factor, matrix) in [(a, &part.mass), (c, &part.stiffness)] {
                        if factor != ZERO {
                            add(factor, &times(matrix, rows), offset);
                        }
                    }
                }
                let LowRank { left, right, stiffness, damping } = &self.low_rank;
                let (left, right) = if transposed { (right, left) } else { (left, right) };
                for (pair, row) in right.iter().enumerate() {
                    let weight = c * stiffness[pair] + b * damping[pair];
                    for j in 0..k {
                        let along: c64 = row.iter().map(|&(i, value)| x[(i, j)] * value).sum();
                        left[pair].iter().for_each(|&(i, value)| sum[(i, j)] += weight * along * value);
                    }
                }
            }
        }
        sum
    }

    /// `|(λ² M + λ C + K) x|` relative to the size of its parts, of every column.
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

    /// The residual of one solve at a shift, relative to the size of its parts.
    pub fn solve_residual(&self, shifted: &Shifted) -> f64 {
        let s = c64::new(0.0, shifted.square.sqrt());
        let b = random::<c64>(self.model.dimension(), 1, 77);
        let x = self.coupled(shifted, s, false).solve(b.as_ref());
        let r = self.times([s * s, s, c64::new(1.0, 0.0)], x.as_ref(), false) - &b;
        let parts = shifted.square * self.norms[0] + s.im * self.norms[1] + self.norms[2];
        r.norm_l2() / (parts * x.norm_l2() + b.norm_l2())
    }

    fn coupled<'s>(&self, shifted: &'s Shifted, s: c64, transposed: bool) -> Coupled<'s, c64> {
        let weight = |(k, c): (&f64, &f64)| c64::new(*k, 0.0) + s * *c;
        let weights = self.low_rank.stiffness.iter().zip(&self.low_rank.damping).map(weight).collect();
        shifted.couple(&self.low_rank, weights, transposed)
    }

    /// The roots nearest to a shift of a model of parts.
    pub fn around_parts(
        &mut self,
        shifted: &Shifted,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let (square, omega) = (shifted.square, shifted.square.sqrt());
        if !self.undamped {
            let s = c64::new(0.0, omega);
            // Either way round is made once.
            let (forward, backward) = (self.coupled(shifted, s, false), self.coupled(shifted, s, true));
            let solve =
                |b: MatRef<'_, c64>, transposed: bool| if transposed { backward.solve(b) } else { forward.solve(b) };
            return self.around(omega, gap, &solve, progress);
        }
        let run = |transposed: bool, count: usize, progress: &mut dyn FnMut(FullProgress)| {
            let coupled = shifted.couple::<f64>(&self.low_rank, self.low_rank.stiffness.clone(), transposed);
            let iteration = Iteration {
                what: self.what,
                dimension: self.model.dimension(),
                count,
                residual_limit: KRYLOV_LIMIT,
                seed: if transposed { 2 } else { 1 },
            };
            let enough = |theta: &[c64]| {
                theta.last().is_some_and(|last| {
                    let disc = CoveredDisc { shift_rad_s: omega, radius: 1.0 / last.norm(), squared: true };
                    !transposed && disc.covers(gap, self.growth_per_s)
                })
            };
            iteration.run::<f64>(
                &|x| coupled.solve(self.model.mass_times(x.as_ref()).as_ref()),
                &enough,
                &mut |vectors, converged| progress(FullProgress::Iterated { shift_rad_s: omega, vectors, converged }),
            )
        };
        let found = run(false, WANTED.min(self.model.dimension() / 4), progress)?;
        let radius = found.theta.last().map_or(0.0, |last| 1.0 / last.norm());
        let disc = CoveredDisc { shift_rad_s: omega, radius, squared: true };
        // Both of ±λ have the same vector; those that oscillate are listed once.
        let lambdas_of = |theta: c64| {
            let kappa = 1.0 / theta + square;
            if kappa.norm() < FLOATING * square {
                return vec![ZERO];
            }
            let root = (-kappa).sqrt();
            let root = if root.im < 0.0 { -root } else { root };
            if root.im > REAL * root.norm() {
                vec![root]
            } else {
                vec![c64::new(root.re, 0.0), c64::new(-root.re, 0.0)]
            }
        };
        let left = match self.vectors {
            FullVectors::Both => Some(run(true, found.theta.len(), progress)?),
            _ => None,
        };
        self.finish(disc, found, left, &lambdas_of)
    }

    /// The roots nearest to a shift of a system.
    pub fn around_system(
        &mut self,
        omega: f64,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let Some([mass, damping, stiffness]) = &self.matrices else {
            unreachable!("a system has its matrices");
        };
        let failed = |reason: String| ReductionError::Factorisation { what: self.what.to_owned(), reason };
        let (n, s) = (mass.nrows(), c64::new(0.0, omega));
        let triplets: Vec<Triplet<usize, usize, c64>> = [(s * s, mass), (s, damping), (c64::new(1.0, 0.0), stiffness)]
            .into_iter()
            .flat_map(|(weight, matrix)| entries(matrix).map(move |(i, j, value)| Triplet::new(i, j, weight * value)))
            .collect();
        let sum = SparseColMat::try_new_from_triplets(n, n, &triplets).map_err(|error| failed(format!("{error:?}")))?;
        let factor: Lu<usize, c64> =
            sum.sp_lu().map_err(|error| failed(format!("the sparse factor at {s} failed: {error:?}")))?;
        progress(FullProgress::Factored { shift_rad_s: omega });
        let solve = |b: MatRef<'_, c64>, transposed: bool| {
            let mut x = b.to_owned();
            if transposed {
                factor.solve_transpose_in_place(x.as_mut());
            } else {
                factor.solve_in_place(x.as_mut());
            }
            x
        };
        self.around(omega, gap, &solve, progress)
    }

    /// The roots nearest to `iω` by the linearised problem.
    fn around(
        &self,
        omega: f64,
        gap: [f64; 2],
        solve: &dyn Fn(MatRef<'_, c64>, bool) -> Mat<c64>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let n = self.model.dimension();
        let s = c64::new(0.0, omega);
        let one = c64::new(1.0, 0.0);
        let run = |transposed: bool, count: usize, progress: &mut dyn FnMut(FullProgress)| {
            // Velocities are divided by ω, so that both halves of a vector weigh alike.
            let apply = |v: Mat<c64>| {
                let (x, y) = (v.subrows(0, n), v.subrows(n, n));
                let b = self.times([c64::new(-omega, 0.0), ZERO, ZERO], y, transposed)
                    + self.times([-s, -one, ZERO], x, transposed);
                let next = solve(b.as_ref(), transposed);
                Mat::from_fn(2 * n, v.ncols(), |i, j| {
                    if i < n { next[(i, j)] } else { (x[(i - n, j)] + s * next[(i - n, j)]) / omega }
                })
            };
            let iteration = Iteration {
                what: self.what,
                dimension: 2 * n,
                count,
                residual_limit: KRYLOV_LIMIT,
                seed: if transposed { 2 } else { 1 },
            };
            let enough = |theta: &[c64]| {
                theta.last().is_some_and(|last| {
                    let disc = CoveredDisc { shift_rad_s: omega, radius: 1.0 / last.norm(), squared: false };
                    !transposed && disc.covers(gap, self.growth_per_s)
                })
            };
            let found = iteration.run::<c64>(&apply, &enough, &mut |vectors, converged| {
                progress(FullProgress::Iterated { shift_rad_s: omega, vectors, converged });
            })?;
            let vectors = found.vectors.subrows(0, n).to_owned();
            Ok::<_, ReductionError>(Largest { theta: found.theta, vectors })
        };
        let found = run(false, WANTED.min(n / 2), progress)?;
        let radius = found.theta.last().map_or(0.0, |last| 1.0 / last.norm());
        let disc = CoveredDisc { shift_rad_s: omega, radius, squared: false };
        let left = match self.vectors {
            FullVectors::Both => Some(run(true, found.theta.len(), progress)?),
            _ => None,
        };
        let lambdas_of = |theta: c64| {
            let lambda = s + 1.0 / theta;
            if lambda.im < -REAL * lambda.norm() { vec![] } else { vec![c64::new(lambda.re, lambda.im.max(0.0))] }
        };
        self.finish(disc, found, left, &lambdas_of)
    }

    /// Roots with residuals and the vectors that are wanted.
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
        let lambdas: Vec<c64> = roots.iter().map(|(lambda, _)| *lambda).collect();
        let residuals = self.checked(&lambdas, &right, false)?;
        let left = match left {
            None => Mat::zeros(n, 0),
            Some(left) => {
                let mut of_left = listed(&left.theta);
                // Where roots merge, those of the transposed problem differ by the square root of rounding.
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
                let vectors = gathered(&left.vectors, &columns);
                self.checked(&own, &vectors, true)?;
                // uᵀ Q = 0: yᴴ Q = 0 with y the conjugate of u.
                Mat::from_fn(n, vectors.ncols(), |i, j| vectors[(i, j)].conj())
            }
        };
        let roots =
            lambdas.into_iter().zip(residuals).map(|(lambda, residual)| FullRoot { lambda, residual }).collect();
        let right = if self.vectors == FullVectors::None { Mat::zeros(n, 0) } else { right };
        Ok(Found { disc, roots, right, left })
    }

    /// Residuals, all of them small.
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

/// `Aᵀ X`.
fn times_transposed(matrix: &SparseMatrix, x: &Mat<f64>) -> Mat<f64> {
    let view = matrix.as_ref();
    Mat::from_fn(matrix.ncols(), x.ncols(), |column, j| {
        view.row_idx_of_col(column).zip(view.val_of_col(column)).map(|(row, value)| value * x[(row, j)]).sum()
    })
}

/// Columns scaled to norm 1.
pub(super) fn unit(mut vectors: Mat<c64>) -> Mat<c64> {
    for k in 0..vectors.ncols() {
        let norm = vectors.col(k).norm_l2();
        vectors.col_mut(k).iter_mut().for_each(|value| *value /= norm);
    }
    vectors
}
