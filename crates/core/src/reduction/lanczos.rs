//! Largest eigenpairs of a symmetric operator by block Lanczos with thick restart.
//!
//! ```text
//! C V = V T + W E_lastᵀ,   VᵀV = I,   T s = θ s   =>   |C V s - θ V s| = |W s_last|
//! ```
//!
//! Every new vector is orthogonalised twice against all previous ones, which prevents spurious copies of eigenvalues. A
//! block finds multiple eigenvalues. A full basis is restarted from its best Ritz vectors; the residual block `W`
//! continues the recurrence unchanged.
//!
//! Source: Grimes, Lewis, Simon, "A shifted block Lanczos algorithm for solving sparse symmetric generalized
//! eigenproblems", SIAM J. Matrix Anal. Appl. 15 (1994) 228-272; Wu, Simon, "Thick-restart Lanczos method for large
//! symmetric eigenvalue problems", SIAM J. Matrix Anal. Appl. 22 (2000) 602-616.

use faer::{Mat, MatRef};

use super::ReductionError;
use super::dense::symmetric_eigen;
use super::krylov::{Basis, random_block};

/// Block size: number of vectors added per step.
pub(super) const BLOCK: usize = 6;
/// Largest number of restarts.
const MOST_RESTARTS: usize = 60;

/// Converged eigenpairs, largest `θ` first.
pub(super) struct Largest {
    pub theta: Vec<f64>,
    /// Orthonormal eigenvectors, `n×theta.len()`. The matrix keeps the memory allocated for the whole basis.
    pub vectors: Mat<f64>,
}

/// Parameters of the iteration.
pub(super) struct Iteration<'a> {
    /// Name of the system in errors.
    pub what: &'a str,
    /// Size `n` of the operator.
    pub dimension: usize,
    /// Number of pairs wanted, at least.
    pub count: usize,
    /// Largest size of the basis.
    pub capacity: usize,
    /// Largest residual of a pair, relative to its `θ`.
    pub residual_limit: f64,
    /// Seed of the random start block.
    pub seed: u64,
}

/// Largest size of a basis for `count` pairs: nearly three times as many vectors, so that few restarts are needed.
pub(super) fn capacity(dimension: usize, count: usize) -> usize {
    (11 * count / 4 + 8 * BLOCK).min(dimension / BLOCK * BLOCK)
}

impl Iteration<'_> {
    /// Computes the largest eigenpairs of `apply` until `enough` accepts the converged `θ`. `progress` receives the
    /// number of vectors built and of converged pairs.
    ///
    /// # Errors
    /// [`ReductionError`]: `NotConverged`, `Factorisation`.
    pub(super) fn run(
        &self,
        apply: &dyn Fn(Mat<f64>) -> Mat<f64>,
        enough: &dyn Fn(&[f64]) -> bool,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Largest, ReductionError> {
        let mut space = Space::new(self.dimension, self.capacity);
        space.append(apply(random_block(self.dimension, BLOCK, self.seed)), self.seed);
        let mut next_check = self.count + self.count / 2 + 4 * BLOCK;
        let (mut restarts, mut built) = (0, BLOCK);
        loop {
            let mut w = apply(space.basis.last_block(BLOCK));
            let remainder = space.project_out(&mut w);
            let full = space.basis.size() + BLOCK > self.capacity;
            if full || space.basis.size() >= next_check {
                let ritz = space.ritz(self.what, remainder.as_ref())?;
                let good = |k: &usize| ritz.residuals[*k] < self.residual_limit;
                let converged = (0..ritz.theta.len()).take_while(good).count();
                progress(built, converged);
                if enough(&ritz.theta[..converged]) {
                    // Reuse the memory of the basis, which is the peak.
                    space.basis.recombine(ritz.vectors.subcols(0, converged));
                    let vectors = space.basis.into_vectors();
                    return Ok(Largest { theta: ritz.theta[..converged].to_vec(), vectors });
                }
                if full && (restarts == MOST_RESTARTS || self.capacity + BLOCK > self.dimension) {
                    return Err(ReductionError::NotConverged {
                        what: self.what.to_owned(),
                        mode: converged,
                        value: ritz.residuals[converged.min(ritz.residuals.len() - 1)],
                        limit: self.residual_limit,
                        vectors: built,
                    });
                }
                if full {
                    space.restart(&ritz, (self.count + self.capacity) / 2);
                    restarts += 1;
                }
                next_check = space.basis.size() + (self.count / 8).max(2 * BLOCK);
            }
            space.append(w, self.seed);
            built += BLOCK;
        }
    }
}

/// Approximate eigenpairs of the projected operator, largest `θ` first.
struct Ritz {
    theta: Vec<f64>,
    /// Residuals, relative to `θ`.
    residuals: Vec<f64>,
    vectors: Mat<f64>,
}

/// Orthonormal basis `V` and the projected operator `T = Vᵀ C V`.
struct Space {
    basis: Basis<f64>,
    projected: Mat<f64>,
}

impl Space {
    fn new(n: usize, capacity: usize) -> Self {
        Self { basis: Basis::new(n, capacity), projected: Mat::zeros(capacity, capacity) }
    }

    /// Orthogonalises `w = C V_last` against the basis, twice, and adds the coefficients to `T`. Returns the Gram
    /// matrix `wᵀ w` of the remainder.
    fn project_out(&mut self, w: &mut Mat<f64>) -> Mat<f64> {
        let size = self.basis.size();
        let mut column = self.projected.submatrix_mut(0, size - BLOCK, size, BLOCK);
        self.basis.project_out(w, |coefficients| column += coefficients);
        w.transpose() * &*w
    }

    /// Orthonormalises a block and appends it. A vector that vanishes is replaced by a random one.
    fn append(&mut self, block: Mat<f64>, seed: u64) {
        let n = block.nrows();
        let block_start = self.basis.size();
        for column in 0..BLOCK {
            let mut vector = block.subcols(column, 1).to_owned();
            // The block is already orthogonal to the basis, unless cancellation within the block leaves little of a
            // vector.
            let mut from = block_start;
            for attempt in 0..4_u64 {
                let before = vector.norm_l2();
                self.basis.make_orthogonal(&mut vector, from);
                if from == block_start && vector.norm_l2() > 1e-2 * before {
                    break;
                }
                from = 0;
                self.basis.make_orthogonal(&mut vector, from);
                if vector.norm_l2() > 1e-10 * before {
                    break;
                }
                vector = random_block(n, 1, seed ^ (0x9e37 + 4 * self.basis.size() as u64 + attempt));
            }
            self.basis.make_orthogonal(&mut vector, from);
            Basis::normalise(&mut vector);
            self.basis.push(&vector);
        }
    }

    /// Ritz pairs and their residuals; `remainder` is the Gram matrix of the next block.
    fn ritz(&self, what: &str, remainder: MatRef<'_, f64>) -> Result<Ritz, ReductionError> {
        let m = self.basis.size();
        // Each column of T is computed in its own step, so that the upper triangle holds every coefficient once.
        let t = Mat::from_fn(m, m, |i, j| self.projected[(i.min(j), i.max(j))]);
        let (theta, vectors) = symmetric_eigen(what, t.as_ref())?;
        let residual = |k: usize| {
            let tail = vectors.submatrix(m - BLOCK, k, BLOCK, 1);
            (tail.transpose() * remainder * tail)[(0, 0)].max(0.0).sqrt() / theta[k].abs()
        };
        Ok(Ritz {
            theta: theta.iter().rev().copied().collect(),
            residuals: (0..m).rev().map(residual).collect(),
            vectors: Mat::from_fn(m, m, |row, column| vectors[(row, m - 1 - column)]),
        })
    }

    /// Restarts from the `keep` best Ritz vectors; the recurrence continues with the remainder of the last block.
    fn restart(&mut self, ritz: &Ritz, keep: usize) {
        self.basis.recombine(ritz.vectors.subcols(0, keep));
        self.projected.fill(0.0);
        for (k, theta) in ritz.theta[..keep].iter().enumerate() {
            self.projected[(k, k)] = *theta;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_basis_too_small_for_one_run_is_restarted() {
        // A diagonal operator, every eigenvalue double: 1/1², 1/1², 1/2², 1/2², ...
        let n = 600;
        let theta = |i: usize| 1.0 / ((1 + i / 2) as f64);
        let apply = |mut x: Mat<f64>| {
            x.row_iter_mut().enumerate().for_each(|(i, row)| row.iter_mut().for_each(|value| *value *= theta(i)));
            x
        };
        let iteration =
            Iteration { what: "test", dimension: n, count: 12, capacity: 36, residual_limit: 1e-12, seed: 0 };
        let mut most = 0;
        let found = iteration.run(&apply, &|theta| theta.len() >= 12, &mut |built, _| most = built).unwrap();
        assert!(most > 72, "no restart was needed: {most} vectors");
        for (k, found) in found.theta[..12].iter().enumerate() {
            // The error of an eigenvalue is at most the residual.
            assert!((found - theta(k)).abs() < 1e-12, "{k}: {found}");
        }
        let gram = found.vectors.transpose() * &found.vectors;
        let size = gram.nrows();
        assert!((gram - Mat::<f64>::identity(size, size)).norm_max() < 1e-13);
    }
}
