//! Lowest real modes of a large sparse system by shift-invert block Lanczos.
//!
//! With `A = K + s M` positive definite, `A⁻¹ M` is self-adjoint in the inner product of `M` and has the eigenvalues
//! `θ = 1 / (ω² + s)`, largest for the lowest modes. Lanczos vectors are kept `M`-orthonormal against all before them,
//! twice, so no ghosts appear; a block catches multiple frequencies; and the inertia of `K - σ M` at a gap above the
//! wanted modes counts them (Sylvester), so that a missed one is an error.
//!
//! Source: Grimes, Lewis, Simon, "A shifted block Lanczos algorithm for solving sparse symmetric generalized
//! eigenproblems", SIAM J. Matrix Anal. Appl. 15 (1994) 228-272.

use std::sync::Arc;

use faer::sparse::linalg::cholesky::SymbolicCholesky;
use faer::{Mat, MatRef};

use super::dense::{fix_signs, symmetric_eigen};
use super::sparse::{Ldlt, analyse, entries, times, weighted_sum, worst_asymmetry};
use super::{DEFINITE_TOLERANCE, ReductionError, SparseMatrix, whiten};

/// Vectors that enter the basis together.
const BLOCK: usize = 6;
/// Residual of `A⁻¹ M` a mode may have, relative to its `θ`, in the norm of `M`.
const RESIDUAL_LIMIT: f64 = 1e-12;
/// Two neighbouring `ω²` this far apart, relative to their size, leave room for a Sturm count between them.
const GAP: f64 = 1e-7;
/// Below this many degrees of freedom a dense solve is at least as fast.
const DENSE_BELOW: usize = 400;
/// Above this ratio of `θ` the shift is moved: small `θ` would drown in the rounding of the largest.
const WIDEST_SPREAD: f64 = 1e6;

/// Lowest modes of a symmetric system that need not be stable.
#[derive(Clone, Debug)]
pub struct SparseModes {
    /// `ω²`, rad²/s², ascending; negative where the stiffness is not semidefinite.
    pub omega_squared: Vec<f64>,
    /// `Φ`, degrees of freedom by modes, kg^-1/2, `Φᵀ M Φ = I`.
    pub phi: Mat<f64>,
}

/// The `count` lowest modes of `K φ = ω² M φ`, both sparse, symmetric, `n×n`, `M` positive definite.
///
/// `what` is how errors name the system.
///
/// # Errors
/// [`ReductionError`]: `Shape`, `Unsymmetric`, `Indefinite`, `ModeCount`, `NoShift`, `NotConverged`, `MissedModes`,
/// `Factorisation`.
pub fn lowest_modes(
    what: &str,
    mass: &SparseMatrix,
    stiffness: &SparseMatrix,
    count: usize,
) -> Result<SparseModes, ReductionError> {
    let n = mass.nrows();
    check("mass", what, mass, n)?;
    check("stiffness", what, stiffness, n)?;
    if count == 0 || count > n {
        return Err(ReductionError::ModeCount {
            what: format!("{what}.modes"),
            value: format!("{count} modes"),
            limit: format!("1 to {n}"),
        });
    }
    let pencil = Pencil::new(what, mass, stiffness)?;
    if n < DENSE_BELOW || 3 * count > n {
        return pencil.dense(count);
    }
    let mut shift = pencil.positive_definite_shift()?;
    for attempt in 0.. {
        let ritz = pencil.lanczos(shift, count, attempt as u64)?;
        let spread = (ritz.squares[count - 1] + shift) / (ritz.squares[0] + shift);
        if spread > WIDEST_SPREAD && attempt == 0 {
            shift = ritz.squares[count - 1] / WIDEST_SPREAD.sqrt();
            continue;
        }
        match pencil.count_below_gap(&ritz, count) {
            Ok(()) => return Ok(ritz.into_modes(count)),
            // Another start vector, before giving up.
            Err(ReductionError::MissedModes { .. }) if attempt < 3 => {}
            Err(error) => return Err(error),
        }
    }
    unreachable!("the loop ends by returning");
}

fn check(field: &str, what: &str, matrix: &SparseMatrix, n: usize) -> Result<(), ReductionError> {
    let what = format!("{what}.{field}");
    let (rows, columns) = matrix.shape();
    if rows != n || columns != n || n == 0 {
        return Err(ReductionError::Shape { what, rows, columns, expected: n.max(1) });
    }
    if let Some((row, column, value)) = entries(matrix).find(|(_, _, value)| !value.is_finite()) {
        return Err(ReductionError::NotFinite { what, row, column, value });
    }
    match worst_asymmetry(matrix) {
        None => Ok(()),
        Some((row, column, value, mirrored, limit)) => {
            Err(ReductionError::Unsymmetric { what, row, column, value, mirrored, limit })
        }
    }
}

/// `K - σ M` for many `σ`, analysed once.
struct Pencil<'a> {
    what: &'a str,
    mass: &'a SparseMatrix,
    stiffness: &'a SparseMatrix,
    symbolic: Arc<SymbolicCholesky<usize>>,
}

impl<'a> Pencil<'a> {
    /// Checks that `M` is positive definite and analyses the pattern of `K + M`.
    fn new(what: &'a str, mass: &'a SparseMatrix, stiffness: &'a SparseMatrix) -> Result<Self, ReductionError> {
        let pattern = weighted_sum(mass.nrows(), &[(1.0, stiffness), (1.0, mass)])?;
        let symbolic = analyse(what, &pattern)?;
        let pencil = Self { what, mass, stiffness, symbolic };
        let field = format!("{what}.mass");
        // The pattern of K + M holds that of M; zeros of K fill the rest.
        let factor =
            Ldlt::new(&field, &pencil.symbolic, &weighted_sum(mass.nrows(), &[(0.0, stiffness), (1.0, mass)])?)?;
        for (row, value) in factor.pivots() {
            let limit = DEFINITE_TOLERANCE * mass.as_ref().get(row, row).copied().unwrap_or(0.0).max(0.0);
            if value.is_nan() || value <= limit {
                return Err(ReductionError::Indefinite { what: field, row, value, limit });
            }
        }
        Ok(pencil)
    }

    /// `K + s M`, factored.
    fn factor(&self, shift: f64) -> Result<Ldlt, ReductionError> {
        let sum = weighted_sum(self.mass.nrows(), &[(1.0, self.stiffness), (shift, self.mass)])?;
        Ldlt::new(self.what, &self.symbolic, &sum)
    }

    /// The smallest of a few shifts that make `K + s M` positive definite, rad²/s².
    fn positive_definite_shift(&self) -> Result<f64, ReductionError> {
        let trace = |matrix: &SparseMatrix| entries(matrix).filter(|e| e.0 == e.1).map(|e| e.2.abs()).sum::<f64>();
        let typical = (trace(self.stiffness) / trace(self.mass)).max(f64::MIN_POSITIVE);
        let mut shift = typical * 1e-8;
        while shift < typical * 1e5 {
            if self.factor(shift).is_ok_and(|factor| factor.negative_pivots() == 0) {
                return Ok(shift);
            }
            shift *= 100.0;
        }
        Err(ReductionError::NoShift { what: self.what.to_owned(), value: shift })
    }

    /// All modes by a dense solve, for small systems.
    fn dense(&self, count: usize) -> Result<SparseModes, ReductionError> {
        let whitening = whiten(&format!("{}.mass", self.what), self.mass.to_dense().as_ref())?;
        let stiffness = self.stiffness.to_dense();
        let (squares, vectors) = symmetric_eigen(self.what, whitening.congruence(stiffness.as_ref(), true).as_ref())?;
        let mut phi = vectors.subcols(0, count).to_owned();
        whitening.back(&mut phi);
        fix_signs(&mut phi);
        Ok(SparseModes { omega_squared: squares[..count].to_vec(), phi })
    }

    /// Ritz pairs of `(K + s M)⁻¹ M`, at least one more than `count` converged.
    fn lanczos(&self, shift: f64, count: usize, seed: u64) -> Result<Ritz, ReductionError> {
        let n = self.mass.nrows();
        let factor = self.factor(shift)?;
        let mut space = Space::new(n);
        let mut block = random_block(n, BLOCK, seed);
        factor.solve(block.as_mut());
        space.append(self.mass, block, seed);
        let mut next_check = count + count / 2 + 4 * BLOCK;
        loop {
            // One step: W = A⁻¹ M V_last, made M-orthonormal against everything; T gains its coefficients.
            let mut w = space.last_mass_times();
            factor.solve(w.as_mut());
            let built = space.size();
            let exhausted = built + BLOCK > n;
            let remainder = space.project_out(&mut w, self.mass);
            if built >= next_check || exhausted {
                let ritz = space.ritz(self.what, remainder.as_ref(), shift)?;

                // Some modes beyond the wanted ones must have converged, up to a gap that a Sturm count can use.
                let converged = ritz.residuals.iter().take_while(|residual| **residual < RESIDUAL_LIMIT).count();
                if exhausted || (converged > count && gap_after(&ritz.squares[..converged], count).is_some()) {
                    if converged <= count {
                        return Err(ReductionError::NotConverged {
                            what: self.what.to_owned(),
                            mode: converged,
                            value: ritz.residuals.get(converged).copied().unwrap_or(f64::NAN),
                            limit: RESIDUAL_LIMIT,
                            vectors: built,
                        });
                    }
                    return Ok(ritz.assembled(&space, converged));
                }
                next_check = built + (count / 8).max(2 * BLOCK);
            }
            space.append(self.mass, w, seed);
        }
    }

    /// Compares the modes found below a gap with the inertia of `K - σ M` there.
    fn count_below_gap(&self, ritz: &Ritz, count: usize) -> Result<(), ReductionError> {
        let Some(found) = gap_after(&ritz.squares, count) else {
            return Err(ReductionError::MissedModes {
                what: self.what.to_owned(),
                found: ritz.squares.len(),
                counted: 0,
                below: f64::NAN,
            });
        };
        let below = 0.5 * (ritz.squares[found - 1] + ritz.squares[found]);
        let counted = self.factor(-below)?.negative_pivots();
        if counted == found {
            return Ok(());
        }
        Err(ReductionError::MissedModes { what: self.what.to_owned(), found, counted, below })
    }
}

/// The smallest number of values, at least `count`, after which a gap follows.
fn gap_after(squares: &[f64], count: usize) -> Option<usize> {
    let largest = squares.iter().fold(0.0, |largest: f64, square| largest.max(square.abs()));
    (count..squares.len()).find(|&k| squares[k] - squares[k - 1] > GAP * squares[k].abs().max(1e-6 * largest))
}

/// Approximate eigenpairs of the projected operator, lowest `ω²` first.
struct Ritz {
    squares: Vec<f64>,
    residuals: Vec<f64>,
    vectors: Mat<f64>,
}

impl Ritz {
    /// The first `converged` pairs with their vectors over the degrees of freedom.
    fn assembled(self, space: &Space, converged: usize) -> Self {
        let vectors = space.basis.subcols(0, self.vectors.nrows()) * self.vectors.subcols(0, converged);
        let squares = self.squares[..converged].to_vec();
        Self { squares, residuals: self.residuals[..converged].to_vec(), vectors }
    }

    fn into_modes(self, count: usize) -> SparseModes {
        let mut phi = self.vectors.subcols(0, count).to_owned();
        fix_signs(&mut phi);
        SparseModes { omega_squared: self.squares[..count].to_vec(), phi }
    }
}

/// `M`-orthonormal Lanczos vectors `V`, with `M V` and `T = Vᵀ M A⁻¹ M V`.
struct Space {
    basis: Mat<f64>,
    mass_basis: Mat<f64>,
    projected: Mat<f64>,
    size: usize,
}

impl Space {
    fn new(n: usize) -> Self {
        Self { basis: Mat::zeros(n, 0), mass_basis: Mat::zeros(n, 0), projected: Mat::zeros(0, 0), size: 0 }
    }

    fn size(&self) -> usize {
        self.size
    }

    /// `M V` of the last block.
    fn last_mass_times(&self) -> Mat<f64> {
        self.mass_basis.subcols(self.size - BLOCK, BLOCK).to_owned()
    }

    /// Takes everything the basis holds out of `w = A⁻¹ M V_last`, in the inner product of `M` and twice, notes the
    /// coefficients in `T`, and returns the Gram matrix `wᵀ M w` of what remains.
    fn project_out(&mut self, w: &mut Mat<f64>, mass: &SparseMatrix) -> Mat<f64> {
        let first = self.size - BLOCK;
        for _ in 0..2 {
            let coefficients = self.mass_basis.subcols(0, self.size).transpose() * &*w;
            *w -= self.basis.subcols(0, self.size) * &coefficients;
            for column in 0..BLOCK {
                for row in 0..self.size {
                    self.projected[(row, first + column)] += coefficients[(row, column)];
                }
            }
        }
        w.transpose() * times(mass, w.as_ref())
    }

    /// Appends a block after making it orthonormal; a vector that vanishes is replaced by a random one.
    fn append(&mut self, mass: &SparseMatrix, block: Mat<f64>, seed: u64) {
        let n = block.nrows();
        let grown = self.size + BLOCK;
        if self.basis.ncols() < grown {
            let capacity = (2 * grown).min(n + BLOCK).max(16 * BLOCK);
            self.basis.resize_with(n, capacity, |_, _| 0.0);
            self.mass_basis.resize_with(n, capacity, |_, _| 0.0);
        }
        self.projected.resize_with(grown, grown, |_, _| 0.0);
        let block_start = self.size;
        for column in 0..BLOCK {
            let mut vector = block.subcols(column, 1).to_owned();
            // The block is orthogonal to all before it already, unless little is left of a vector within the block.
            let mut from = block_start;
            for attempt in 0..4_u64 {
                let before = mass_norm(mass, vector.as_ref());
                self.make_orthogonal(&mut vector, from);
                let norm = mass_norm(mass, vector.as_ref());
                if from == block_start && norm > 1e-2 * before {
                    break;
                }
                from = 0;
                self.make_orthogonal(&mut vector, from);
                if mass_norm(mass, vector.as_ref()) > 1e-10 * before {
                    break;
                }
                vector = random_block(n, 1, seed ^ (0x9e37 + 4 * self.size as u64 + attempt));
            }
            self.make_orthogonal(&mut vector, from);
            let norm = mass_norm(mass, vector.as_ref());
            vector = faer::Scale(1.0 / norm) * vector;
            self.basis.subcols_mut(self.size, 1).copy_from(&vector);
            self.mass_basis.subcols_mut(self.size, 1).copy_from(times(mass, vector.as_ref()));
            self.size += 1;
        }
    }

    /// Takes out of a vector what the basis holds from its column `from` on.
    fn make_orthogonal(&self, vector: &mut Mat<f64>, from: usize) {
        let held = self.size - from;
        let coefficients = self.mass_basis.subcols(from, held).transpose() * &*vector;
        *vector -= self.basis.subcols(from, held) * coefficients;
    }

    /// Ritz values and residuals, `remainder` being the Gram matrix of the next block.
    fn ritz(&self, what: &str, remainder: MatRef<'_, f64>, shift: f64) -> Result<Ritz, ReductionError> {
        let m = self.size;
        // Columns of T are known from their own step; the upper triangle holds each coupling once.
        let t = Mat::from_fn(m, m, |i, j| self.projected[(i.min(j), i.max(j))]);
        let (theta, vectors) = symmetric_eigen(what, t.as_ref())?;
        let (mut squares, mut residuals, mut order) = (vec![], vec![], vec![]);
        for k in (0..m).rev() {
            let tail = vectors.submatrix(m - BLOCK, k, BLOCK, 1);
            let squared = (tail.transpose() * remainder * tail)[(0, 0)];
            squares.push(1.0 / theta[k] - shift);
            residuals.push(squared.max(0.0).sqrt() / theta[k].abs());
            order.push(k);
        }
        let vectors = Mat::from_fn(m, m, |row, column| vectors[(row, order[column])]);
        Ok(Ritz { squares, residuals, vectors })
    }
}

fn mass_norm(mass: &SparseMatrix, vector: MatRef<'_, f64>) -> f64 {
    (vector.transpose() * times(mass, vector))[(0, 0)].max(0.0).sqrt()
}

/// Numbers in [-1, 1), the same on every run (SplitMix64, Steele et al. 2014).
fn random_block(n: usize, columns: usize, seed: u64) -> Mat<f64> {
    let mut state = seed.wrapping_mul(0x2545_f491_4f6c_dd1d).wrapping_add(0x1234_5678);
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    };
    Mat::from_fn(n, columns, |_, _| next())
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::sparse::Triplet;

    /// A square membrane of `side × side` points: `ω² = 4 - 2 cos(pπ/(s+1)) - 2 cos(qπ/(s+1))`, nearly all double.
    fn membrane(side: usize, mass_of: f64) -> (SparseMatrix, SparseMatrix, Vec<f64>) {
        let at = |x: usize, y: usize| x * side + y;
        let (mut stiffness, mut mass, mut expected) = (vec![], vec![], vec![]);
        for x in 0..side {
            for y in 0..side {
                stiffness.push(Triplet::new(at(x, y), at(x, y), 4.0));
                mass.push(Triplet::new(at(x, y), at(x, y), mass_of));
                for (x2, y2) in [(x + 1, y), (x, y + 1)] {
                    if x2 < side && y2 < side {
                        stiffness.push(Triplet::new(at(x, y), at(x2, y2), -1.0));
                        stiffness.push(Triplet::new(at(x2, y2), at(x, y), -1.0));
                    }
                }
                let half = |k: usize| 2.0 - 2.0 * ((k + 1) as f64 * std::f64::consts::PI / (side + 1) as f64).cos();
                expected.push((half(x) + half(y)) / mass_of);
            }
        }
        expected.sort_by(f64::total_cmp);
        let n = side * side;
        let build = |t: &[_]| SparseMatrix::try_new_from_triplets(n, n, t).unwrap();
        (build(&mass), build(&stiffness), expected)
    }

    #[test]
    fn double_frequencies_of_a_square_membrane() {
        let (mass, stiffness, expected) = membrane(30, 1e-7);
        let modes = lowest_modes("system", &mass, &stiffness, 40).unwrap();
        for (found, expected) in modes.omega_squared.iter().zip(&expected) {
            assert!((found / expected - 1.0).abs() < 1e-11, "{found} {expected}");
        }
        let gram = modes.phi.transpose() * times(&mass, modes.phi.as_ref());
        assert!((gram - Mat::<f64>::identity(40, 40)).norm_max() < 1e-12);
        let inertia = times(&mass, modes.phi.as_ref());
        let stiff = times(&stiffness, modes.phi.as_ref());
        let residual = Mat::from_fn(900, 40, |i, k| stiff[(i, k)] - modes.omega_squared[k] * inertia[(i, k)]);
        // `A r` grows by the norm of K, 8, over what the iteration tolerates.
        assert!(residual.norm_max() < 8.0 * 1e-10 * modes.phi.norm_max(), "{:e}", residual.norm_max());
    }

    #[test]
    fn a_free_and_an_unstable_membrane() {
        let (mass, stiffness, expected) = membrane(25, 2.0);
        // Lowered by a multiple of the mass: the first modes become negative, one of them zero.
        let lowered = weighted_sum(625, &[(1.0, &stiffness), (-expected[3], &mass)]).unwrap();
        let modes = lowest_modes("system", &mass, &lowered, 12).unwrap();
        for (found, expected_here) in modes.omega_squared.iter().zip(&expected) {
            assert!((found - (expected_here - expected[3])).abs() < 1e-11, "{found}");
        }
    }

    #[test]
    fn small_systems_go_the_dense_way() {
        let (mass, stiffness, expected) = membrane(5, 0.5);
        let modes = lowest_modes("system", &mass, &stiffness, 25).unwrap();
        for (found, expected) in modes.omega_squared.iter().zip(&expected) {
            assert!((found / expected - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn an_indefinite_or_unsymmetric_matrix_is_named() {
        let (mut mass, stiffness, _) = membrane(25, 2.0);
        mass.val_mut()[7] = -1.0;
        assert_eq!(
            lowest_modes("system", &mass, &stiffness, 12).unwrap_err(),
            ReductionError::Indefinite { what: "system.mass".into(), row: 7, value: -1.0, limit: 0.0 }
        );
        let (mass, mut stiffness, _) = membrane(25, 2.0);
        stiffness.val_mut()[1] = -1.5;
        assert!(matches!(
            lowest_modes("system", &mass, &stiffness, 12).unwrap_err(),
            ReductionError::Unsymmetric { what, row: 1, column: 0, value, .. } if what == "system.stiffness" && value == -1.5
        ));
    }
}
