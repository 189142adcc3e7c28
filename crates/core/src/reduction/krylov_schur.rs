//! Largest eigenpairs of an unsymmetric operator: block Arnoldi with Krylov-Schur restarts.
//!
//! ```text
//! C V = V H + W R E_lastᵀ,   Vᴴ V = I,   H = U T Uᴴ   =>   C (V Z) = (V Z) ZᴴHZ + W (R E_lastᵀ Z)
//! ```
//!
//! The eigenvalues of `T` are ordered by magnitude, and `Z` spans the first columns of `U`, an invariant subspace of
//! `H`. A full basis is thus truncated to its best part without breaking the recurrence. A block finds multiple
//! eigenvalues. Every new vector is orthogonalised twice against all previous ones. The basis of a real operator stays
//! real: the retained subspace is closed under conjugation, so its projector `Re(U Uᴴ)` has a real basis.
//!
//! Source: Stewart, "A Krylov-Schur algorithm for large eigenproblems", SIAM J. Matrix Anal. Appl. 23 (2002) 601-614;
//! Zhou, Saad, "Block Krylov-Schur method for large symmetric eigenvalue problems", Numer. Algorithms 47 (2008)
//! 341-359.

use faer::{Mat, MatRef, c64};

use super::ReductionError;
use super::krylov::{Basis, Number, random};
use super::schur::Schur;

/// Block size: number of vectors added per step.
pub(super) const BLOCK: usize = 4;
/// Share of the stretch to be covered from which on a few more pairs are cheaper than another shift.
const NEARLY: f64 = 0.9;
/// Largest number of restarts.
const MOST_RESTARTS: usize = 40;
/// Length of a vector, relative to what it was, below which its remainder outside its own block is made orthogonal to the
/// earlier blocks again: an error of orthogonality grows by the inverse of this.
const REMAINDER: f64 = 0.1;
/// Relative difference of magnitudes below which two eigenvalues are a pair that a restart must not separate.
const TOGETHER: f64 = 1e-9;

/// Converged eigenpairs in descending magnitude.
pub(super) struct Largest {
    pub theta: Vec<c64>,
    /// Eigenvectors, `n×theta.len()`, 2-norm 1.
    pub vectors: Mat<c64>,
}

/// Parameters of the iteration.
pub(super) struct Iteration<'a> {
    /// Name of the system in errors.
    pub what: &'a str,
    /// Size `n` of the operator.
    pub dimension: usize,
    /// Number of pairs wanted.
    pub count: usize,
    /// Largest residual of a pair, relative to its `θ`.
    pub residual_limit: f64,
    /// Seed of the random start block.
    pub seed: u64,
}

/// Largest size of a basis for `count` pairs.
pub(super) fn capacity(dimension: usize, count: usize) -> usize {
    (3 * count + 4 * BLOCK).min(dimension / BLOCK * BLOCK)
}

/// Largest number of pairs returned where `count` are wanted.
pub(super) fn most_found(count: usize) -> usize {
    count + count / 2
}

impl Iteration<'_> {
    /// Computes the largest eigenpairs of `apply`: at least `count`, or fewer if the converged `θ` cover all that is to be
    /// covered, 1 of it by `covered`, or the basis spans the whole (or an invariant) space. It computes a few more if they
    /// nearly cover it. `progress` receives the number of vectors built and of converged pairs.
    ///
    /// # Errors
    /// [`ReductionError`]: `NotConverged`, `Factorisation`; those of `apply`.
    pub(super) fn run<T: Number>(
        &self,
        apply: &dyn Fn(Mat<T>) -> Result<Mat<T>, ReductionError>,
        covered: &dyn Fn(&[c64]) -> f64,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Largest, ReductionError> {
        let capacity = capacity(self.dimension, self.count);
        let mut space = Space::<T>::new(self.dimension, capacity);
        let start = apply(random::<T>(self.dimension, BLOCK, self.seed))?;
        space.append(start, None, self.seed);
        let mut next_check = (3 * self.count / 2).min(capacity);
        let (mut restarts, mut built) = (0, BLOCK);
        // Size of the basis and number of converged pairs at the last check.
        let mut last = (0, 0);
        loop {
            let mut w = apply(space.basis.last_block(BLOCK))?;
            let before = w.norm_l2();
            space.project_out(&mut w);
            let whole = space.basis.size() + BLOCK > self.dimension || w.norm_l2() < 1e-14 * before;
            let full = space.basis.size() + BLOCK > capacity || whole;
            if full || space.basis.size() >= next_check {
                let remainder = T::inner(w.as_ref(), w.as_ref());
                let limit = if whole { f64::INFINITY } else { self.residual_limit };
                let ritz = space.ritz(self.what, remainder.as_ref(), limit)?;
                let converged = ritz.converged;
                progress(built, converged);
                let theta: Vec<c64> = (0..converged).map(|k| ritz.schur.value(k)).collect();
                let covered = if converged > 0 { covered(&theta) } else { 0.0 };
                let most = converged >= most_found(self.count) || restarts == MOST_RESTARTS;
                let counted = converged >= self.count && (covered < NEARLY || most);
                if counted || whole || covered >= 1.0 {
                    let found = converged.min(most_found(self.count));
                    return Ok(Largest { vectors: space.vectors(&ritz, found), theta: theta[..found].to_vec() });
                }
                if full && restarts == MOST_RESTARTS {
                    return Err(ReductionError::NotConverged {
                        what: self.what.to_owned(),
                        mode: converged,
                        value: ritz.next_residual,
                        limit: self.residual_limit,
                        vectors: built,
                    });
                }
                if full {
                    let coupling = space.restart(&ritz, (self.count + capacity) / 2)?;
                    restarts += 1;
                    next_check = space.basis.size() + self.count / 2;
                    last = (space.basis.size(), converged);
                    space.append(w, Some(coupling), self.seed);
                    built += BLOCK;
                    continue;
                }
                // A check takes as long as several steps. Convergence accelerates: the next check comes halfway to where
                // its present rate leads.
                let (grown, gained) = (space.basis.size() - last.0, converged.saturating_sub(last.1).max(1));
                let expected = self.count.saturating_sub(converged) * grown / gained;
                next_check = space.basis.size() + (expected / 2).clamp(self.count / 2, self.count).max(BLOCK);
                last = (space.basis.size(), converged);
            }
            space.append(w, None, self.seed);
            built += BLOCK;
        }
    }
}

/// Ordered Schur form of the projected operator.
struct Ritz {
    schur: Schur,
    /// Number of the largest Ritz pairs whose residuals are within the limit.
    converged: usize,
    /// Residual of the next one, relative to its `θ`; 0 if all are within it.
    next_residual: f64,
}

/// Orthonormal basis `V` and the projected operator `H = Vᴴ C V`.
struct Space<T: Number> {
    basis: Basis<T>,
    projected: Mat<c64>,
}

impl<T: Number> Space<T> {
    fn new(n: usize, capacity: usize) -> Self {
        Self { basis: Basis::new(n, capacity), projected: Mat::zeros(capacity, capacity) }
    }

    /// Orthogonalises `w = C V_last` against the basis, twice, and adds the coefficients to `H`.
    fn project_out(&mut self, w: &mut Mat<T>) {
        let (size, projected) = (self.basis.size(), &mut self.projected);
        self.basis.project_out(w, |coefficients| {
            for j in 0..BLOCK {
                for i in 0..size {
                    projected[(i, size - BLOCK + j)] += coefficients[(i, j)].complex();
                }
            }
        });
    }

    /// Orthonormalises a block, `W = Q R`, and appends `Q`. `R` couples it to the previous block; after a restart,
    /// `coupling` couples `W` to the whole basis. A vector that vanishes is replaced by a random one without coupling.
    fn append(&mut self, block: Mat<T>, coupling: Option<Mat<c64>>, seed: u64) {
        let (n, start) = (block.nrows(), self.basis.size());
        let mut r = Mat::<c64>::zeros(BLOCK, BLOCK);
        let whole = block.norm_l2();
        for column in 0..BLOCK {
            let mut vector = block.subcols(column, 1).to_owned();
            let before = vector.norm_l2();
            for _ in 0..2 {
                let within = self.basis.make_orthogonal(&mut vector, start);
                (0..column).for_each(|i| r[(i, column)] += within[(i, 0)].complex());
            }
            let mut norm = vector.norm_l2();
            if norm > 1e-13 * whole {
                // A small remainder is no longer orthogonal to the earlier blocks, as the whole vector was.
                if norm < REMAINDER * before {
                    (0..2).for_each(|_| drop(self.basis.make_orthogonal(&mut vector, 0)));
                    norm = vector.norm_l2();
                }
                r[(column, column)] = c64::new(norm, 0.0);
            }
            let mut attempt = 0;
            while norm <= 1e-13 * whole {
                vector = random::<T>(n, 1, seed ^ (0x9e37 + 8 * self.basis.size() as u64 + attempt));
                self.basis.make_orthogonal(&mut vector, 0);
                self.basis.make_orthogonal(&mut vector, 0);
                norm = vector.norm_l2();
                attempt += 1;
                if norm > 1e-6 {
                    break;
                }
            }
            Basis::normalise(&mut vector);
            self.basis.push(&vector);
        }
        let joined = match coupling {
            // `W = Q R`: multiply by `R` to convert the coupling of `W` to that of `Q`.
            Some(of_w) => &r * of_w,
            None => r,
        };
        if start >= joined.ncols() {
            let first = start - joined.ncols();
            self.projected.submatrix_mut(start, first, BLOCK, joined.ncols()).copy_from(&joined);
        }
    }

    /// Ordered Schur form of `H`, and how many Ritz pairs have residuals, relative to their `θ`, of at most `limit`;
    /// `remainder` is the Gram matrix of the next block.
    fn ritz(&self, what: &str, remainder: MatRef<'_, T>, limit: f64) -> Result<Ritz, ReductionError> {
        let m = self.basis.size();
        let failed = || ReductionError::Factorisation {
            what: what.to_owned(),
            reason: format!("the eigenvalues of a projection on {m} vectors did not converge"),
        };
        let mut schur = Schur::new(self.projected.submatrix(0, 0, m, m)).ok_or_else(failed)?;
        schur.sort();
        let residual = |k: usize| {
            let tail = schur.last_rows_of_vector(k, BLOCK);
            let sum: c64 = (0..BLOCK)
                .flat_map(|i| (0..BLOCK).map(move |j| (i, j)))
                .map(|(i, j)| tail[(i, 0)].conj() * remainder[(i, j)].complex() * tail[(j, 0)])
                .sum();
            sum.re.max(0.0).sqrt() / schur.value(k).norm()
        };
        let bad = (0..m).map(|k| (k, residual(k))).find(|&(_, residual)| residual > limit || residual.is_nan());
        let (converged, next_residual) = bad.unwrap_or((m, 0.0));
        Ok(Ritz { schur, converged, next_residual })
    }

    /// The Ritz vectors of the `count` largest Ritz values.
    fn vectors(&self, ritz: &Ritz, count: usize) -> Mat<c64> {
        let mut mixed = Mat::<c64>::zeros(self.basis.size(), count);
        for k in 0..count {
            mixed.subcols_mut(k, 1).copy_from(ritz.schur.vector(k));
        }
        self.basis.combined(mixed.as_ref())
    }

    /// Truncates the basis to about `keep` vectors, which span the Schur vectors of the largest Ritz values. Returns
    /// the coupling of the next block `W` to them.
    fn restart(&mut self, ritz: &Ritz, keep: usize) -> Result<Mat<c64>, ReductionError> {
        let m = self.basis.size();
        let size = |k: usize| ritz.schur.value(k).norm();
        // Do not separate a conjugate pair.
        let mut keep = keep.min(m - BLOCK);
        while keep > 1 && (size(keep - 1) - size(keep)).abs() < TOGETHER * size(keep) {
            keep -= 1;
        }
        let kept = T::basis_of(ritz.schur.u.subcols(0, keep))?;
        let z = Mat::from_fn(m, keep, |i, j| kept[(i, j)].complex());
        self.basis.recombine(kept.as_ref());
        let projected = z.adjoint() * (self.projected.submatrix(0, 0, m, m) * &z);
        self.projected.fill(c64::new(0.0, 0.0));
        self.projected.submatrix_mut(0, 0, keep, keep).copy_from(&projected);
        Ok(z.subrows(m - BLOCK, BLOCK).to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A block-diagonal real operator with eigenvalues `a ± b i`, every block twice, largest first. The basis needs
    /// restarts.
    #[test]
    fn double_complex_pairs_of_a_real_operator() {
        let blocks = 400;
        let value = |block: usize| {
            let size = 1.0 / (1 + block / 2) as f64;
            c64::new(0.8 * size, if (block / 2).is_multiple_of(3) { 0.0 } else { 0.5 * size })
        };
        let apply = |x: Mat<f64>| {
            Ok(Mat::from_fn(2 * blocks, x.ncols(), |i, j| {
                let (block, c) = (i / 2, value(i / 2));
                let (p, q) = (x[(2 * block, j)], x[(2 * block + 1, j)]);
                if i % 2 == 0 { c.re * p + 2.0 * c.im * q } else { c.re * q - 0.5 * c.im * p }
            }))
        };
        let iteration = Iteration { what: "test", dimension: 2 * blocks, count: 16, residual_limit: 1e-12, seed: 0 };
        let mut most = 0;
        let found = iteration.run::<f64>(&apply, &|_| 0.0, &mut |built, _| most = built).unwrap();
        assert!(most > capacity(2 * blocks, 16), "no restart was needed: {most}");
        let mut expected: Vec<c64> = (0..blocks).flat_map(|block| [value(block), value(block).conj()]).collect();
        expected.sort_by(|a, b| b.norm().total_cmp(&a.norm()));
        for theta in &found.theta {
            let nearest =
                expected.iter().enumerate().min_by(|a, b| (a.1 - theta).norm().total_cmp(&(b.1 - theta).norm()));
            let (index, nearest) = nearest.map(|(i, value)| (i, *value)).unwrap();
            // The blocks are non-normal by a factor of 2.
            assert!((nearest - theta).norm() < 1e-11, "{theta} {nearest}");
            expected.remove(index);
        }
        // No larger eigenvalue was missed.
        let last = found.theta.last().unwrap().norm();
        assert!(expected[0].norm() <= last * (1.0 + 1e-9), "{} {last}", expected[0]);
        for (k, theta) in found.theta.iter().enumerate() {
            let x = found.vectors.subcols(k, 1);
            let part = |im: bool| Mat::from_fn(2 * blocks, 1, |i, _| if im { x[(i, 0)].im } else { x[(i, 0)].re });
            let (re, im) = (apply(part(false)).unwrap(), apply(part(true)).unwrap());
            let residual = Mat::from_fn(2 * blocks, 1, |i, _| c64::new(re[(i, 0)], im[(i, 0)]) - theta * x[(i, 0)]);
            assert!(residual.norm_l2() < 1e-11);
        }
    }

    /// Vectors of which little is left beside those before them are orthonormal to a modest multiple of `ε`: those of an
    /// operator with eigenvalues `10^(-k/8)`, and blocks whose vectors differ by `1e-9`.
    #[test]
    fn vectors_stay_orthonormal_where_little_of_them_is_left() {
        let (n, most) = (200, 60);
        let mut space = Space::<f64>::new(n, most);
        let apply = |x: Mat<f64>| Mat::from_fn(n, x.ncols(), |i, j| 10_f64.powf(-(i as f64) / 8.0) * x[(i, j)]);
        space.append(apply(random::<f64>(n, BLOCK, 5)), None, 5);
        while space.basis.size() < most {
            let next = apply(space.basis.last_block(BLOCK));
            let alike = Mat::from_fn(n, BLOCK, |i, j| next[(i, 0)] + 1e-9 * next[(i, j)]);
            let mut w = if space.basis.size() < most / 2 { next } else { alike };
            space.project_out(&mut w);
            space.append(w, None, 5);
        }
        let vectors = space.basis.last_block(most);
        let off = (vectors.transpose() * &vectors - Mat::<f64>::identity(most, most)).norm_max();
        assert!(off < 100.0 * f64::EPSILON, "{off:e}");
    }
}
