//! A root of a full sparse system with both of its vectors, by inverse iteration from a guess.
//!
//! ```text
//! Q(λ) x = 0,   yᴴ Q(λ) = 0,   Q(λ) = λ² M + λ C + K
//! x <- Q(s)⁻¹ Q'(s) x,   y <- Q(s)⁻ᴴ Q'(s)ᴴ y,   λ <- λ - yᴴ Q(λ) x / yᴴ Q'(λ) x
//! ```
//!
//! One sparse factor at the guess `s` serves both sides. The two-sided quotient makes the error of `λ` the product of
//! those of `x` and `y`.
//!
//! Source: Tisseur, Meerbergen, "The quadratic eigenvalue problem", SIAM Review 43 (2001) 235-286, section 5.

use faer::linalg::solvers::SolveCore;
use faer::sparse::linalg::solvers::{Lu, SymbolicLu};
use faer::sparse::{SparseColMat, Triplet};
use faer::{Conj, Mat, MatRef, c64};

use super::lanczos::random_block;
use super::sparse::{entries, one_norm, times, transposed};
use super::{FullModel, FullSource, ReductionError, SparseMatrix, full_order_roots};
use crate::physics::OperatingPoint;

/// Steps of inverse iteration after which a guess is given up.
const MOST_STEPS: usize = 8;
/// Residual that ends the iteration, relative to the size of the parts.
const SMALL: f64 = 1e-14;
/// Residual a pair may have, relative to the size of its parts.
const RESIDUAL_LIMIT: f64 = 1e-12;

/// A root with its vectors.
#[derive(Clone, Debug)]
pub struct Eigenpair {
    /// `λ`, 1/s.
    pub lambda: c64,
    /// `x`, `n×1`, of 2-norm 1.
    pub right: Mat<c64>,
    /// `y`, `n×1`, of 2-norm 1: `yᴴ Q(λ) = 0`.
    pub left: Mat<c64>,
    /// The larger of `|Q(λ) x|` and `|yᴴ Q(λ)|` over `|λ|² |M| + |λ| |C| + |K|`, 1-norms of matrices.
    pub residual: f64,
}

/// `M`, `C` and `K` at an operating point, ready to be factored at many shifts.
pub struct Quadratic {
    what: String,
    matrices: [SparseMatrix; 3],
    transposed: [SparseMatrix; 3],
    norms: [f64; 3],
    symbolic: SymbolicLu<usize>,
}

impl Quadratic {
    /// Analyses the common pattern of `mass`, `damping` and `stiffness`, each `n×n` in kg, N·s/m and N/m.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`].
    pub fn new(what: &str, matrices: [SparseMatrix; 3]) -> Result<Self, ReductionError> {
        let failed = |reason: String| ReductionError::Factorisation { what: what.to_owned(), reason };
        let one = c64::new(1.0, 0.0);
        let pattern = sum(&matrices, [one; 3]).map_err(failed)?;
        let symbolic = SymbolicLu::try_new(pattern.symbolic()).map_err(|error| failed(format!("{error:?}")))?;
        let norms = [0, 1, 2].map(|k| one_norm(&matrices[k]));
        let transposed = [transposed(&matrices[0])?, transposed(&matrices[1])?, transposed(&matrices[2])?];
        Ok(Self { what: what.to_owned(), matrices, transposed, norms, symbolic })
    }

    fn failed(&self, reason: String) -> ReductionError {
        ReductionError::Factorisation { what: self.what.clone(), reason }
    }

    /// The root nearest to `guess`, from the vectors `start = [x, y]` where they are known.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `Residual`.
    pub fn near(&self, guess: c64, start: Option<[MatRef<'_, c64>; 2]>) -> Result<Eigenpair, ReductionError> {
        let n = self.matrices[0].nrows();
        // A guess that is a root to the last digit leaves a singular matrix.
        let shift = guess * (1.0 + 1e-9);
        let one = c64::new(1.0, 0.0);
        let matrix = sum(&self.matrices, [shift * shift, shift, one]).map_err(|reason| self.failed(reason))?;
        let factor = Lu::try_new_with_symbolic(self.symbolic.clone(), matrix.as_ref())
            .map_err(|error| self.failed(format!("the sparse factor at {shift} failed: {error:?}")))?;
        let random = random_block(n, 4, 1);
        let [mut x, mut y] = match start {
            Some(vectors) => vectors.map(|v| v.to_owned()),
            None => [0, 2].map(|c| Mat::from_fn(n, 1, |i, _| c64::new(random[(i, c)], random[(i, c + 1)]))),
        };
        let (mut lambda, mut best) = (guess, None::<Eigenpair>);
        let (mut of_x, mut of_y) = (products(&self.matrices, &x), products(&self.transposed, &y));
        for _ in 0..MOST_STEPS {
            x = Mat::from_fn(n, 1, |i, _| shift * 2.0 * of_x[0][(i, 0)] + of_x[1][(i, 0)]);
            factor.solve_in_place_with_conj(Conj::No, x.as_mut());
            y = Mat::from_fn(n, 1, |i, _| shift.conj() * 2.0 * of_y[0][(i, 0)] + of_y[1][(i, 0)]);
            factor.solve_transpose_in_place_with_conj(Conj::Yes, y.as_mut());
            for v in [&mut x, &mut y] {
                *v *= faer::Scale(c64::new(1.0 / v.norm_l2(), 0.0));
            }
            (of_x, of_y) = (products(&self.matrices, &x), products(&self.transposed, &y));
            let [m, c, k]: [c64; 3] = [0, 1, 2].map(|matrix| (y.adjoint() * &of_x[matrix])[(0, 0)]);
            for _ in 0..2 {
                let slope = lambda * 2.0 * m + c;
                if slope.norm() > 0.0 {
                    lambda -= (lambda * (lambda * m + c) + k) / slope;
                }
            }
            let off = |of: &[Mat<c64>; 3], lambda: c64| {
                let at = |i: usize| lambda * (lambda * of[0][(i, 0)] + of[1][(i, 0)]) + of[2][(i, 0)];
                (0..n).map(|i| at(i).norm_sqr()).sum::<f64>().sqrt()
            };
            let rate = lambda.norm();
            let parts = rate * rate * self.norms[0] + rate * self.norms[1] + self.norms[2];
            let residual = off(&of_x, lambda).max(off(&of_y, lambda.conj())) / parts;
            let stalled =
                best.as_ref().is_some_and(|best| residual > 0.5 * best.residual && best.residual < RESIDUAL_LIMIT);
            if best.as_ref().is_none_or(|best| residual < best.residual) {
                best = Some(Eigenpair { lambda, right: x.clone(), left: y.clone(), residual });
            }
            if residual < SMALL || stalled {
                break;
            }
        }
        let best = best.expect("at least one step");
        if best.residual.is_nan() || best.residual > RESIDUAL_LIMIT {
            let (what, value, limit) = (self.what.clone(), best.residual, RESIDUAL_LIMIT);
            return Err(ReductionError::Residual { what, mode: 0, value, limit });
        }
        Ok(best)
    }
}

/// The roots of a full model by sparse factors of `Q(s)`, for systems of some thousands of degrees of freedom.
pub struct SparseSource<'a> {
    pub full: &'a FullModel,
}

impl FullSource for SparseSource<'_> {
    fn roots(&mut self, p: &OperatingPoint, band_rad_s: f64) -> Result<Vec<c64>, ReductionError> {
        let [mass, damping, stiffness] = self.full.matrices_at(p)?;
        let found = full_order_roots("full model", [&mass, &damping, &stiffness], band_rad_s, &mut |_, _| {})?;
        Ok(found.roots.iter().map(|root| root.lambda).filter(|lambda| lambda.im > 0.0).collect())
    }

    fn pairs(
        &mut self,
        p: &OperatingPoint,
        band_rad_s: f64,
        wanted: &dyn Fn(c64) -> bool,
    ) -> Result<(Vec<c64>, Vec<Eigenpair>), ReductionError> {
        let roots = self.roots(p, band_rad_s)?;
        let quadratic = Quadratic::new("full model", self.full.matrices_at(p)?)?;
        let pairs = roots.iter().filter(|root| wanted(**root)).map(|root| quadratic.near(*root, None));
        let pairs = pairs.collect::<Result<_, _>>()?;
        Ok((roots, pairs))
    }
}

/// `a M + b C + c K`; entries stay where a weight is 0, so that the pattern is always the same.
fn sum(matrices: &[SparseMatrix; 3], weights: [c64; 3]) -> Result<SparseColMat<usize, c64>, String> {
    let n = matrices[0].nrows();
    let triplets: Vec<Triplet<usize, usize, c64>> = weights
        .into_iter()
        .zip(matrices)
        .flat_map(|(weight, matrix)| entries(matrix).map(move |(i, j, value)| Triplet::new(i, j, weight * value)))
        .collect();
    SparseColMat::try_new_from_triplets(n, n, &triplets).map_err(|error| format!("{error:?}"))
}

/// `M v`, `C v` and `K v`.
fn products(matrices: &[SparseMatrix; 3], v: &Mat<c64>) -> [Mat<c64>; 3] {
    let parts = Mat::from_fn(v.nrows(), 2, |i, j| if j == 0 { v[(i, 0)].re } else { v[(i, 0)].im });
    [0, 1, 2].map(|k| {
        let parts = times(&matrices[k], parts.as_ref());
        Mat::from_fn(v.nrows(), 1, |i, _| c64::new(parts[(i, 0)], parts[(i, 1)]))
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::physics::{ContactLaw, Solver, Vectors};
    use crate::reduction::test_models::{chains, unit};

    /// `|Q(λ) x|` and `|yᴴ Q(λ)|` over the size of the parts, by dense arithmetic.
    pub fn residuals(full: &FullModel, p: &OperatingPoint, pair: &Eigenpair) -> [f64; 2] {
        let [mass, damping, stiffness] = full.matrices_at(p).unwrap().map(|matrix| matrix.to_dense());
        let n = mass.nrows();
        let q =
            Mat::from_fn(n, n, |i, j| pair.lambda * (pair.lambda * mass[(i, j)] + damping[(i, j)]) + stiffness[(i, j)]);
        let size = stiffness.norm_l2();
        [
            (&q * &pair.right).norm_l2() / (size * pair.right.norm_l2()),
            (pair.left.adjoint() * &q).norm_l2() / (size * pair.left.norm_l2()),
        ]
    }

    /// Roots are those of a dense solve on a whole basis; both vectors satisfy their equation.
    #[test]
    fn both_vectors_of_a_damped_unsymmetric_system() {
        let law = ContactLaw { exponent: 0.5, slope_s_per_m: -0.01, lateral_damping: true, ..Default::default() };
        let full = chains(30.0, law);
        let p = OperatingPoint { normal_load_n: 700.0, disc_speed_rad_s: 9.0, friction_coefficient: 0.6 };
        let model = full.project(unit(full.dimension()).as_ref()).unwrap().model(law).unwrap();
        let dense = Solver::new(model.dimension()).solve(&model, &p, Vectors::Right).unwrap();
        let band = 1200.0;
        let expected: Vec<c64> = dense.modes().iter().map(|r| r.lambda).filter(|l| l.im < band).collect();
        let (roots, pairs) = SparseSource { full: &full }.pairs(&p, band, &|_| true).unwrap();
        assert!(expected.len() > 8 && roots.len() == expected.len() && pairs.len() == roots.len(), "{}", roots.len());
        for (pair, expected) in pairs.iter().zip(expected) {
            // Rounding of both solves; no two roots of this model are near each other.
            assert!((pair.lambda - expected).norm() < 1e-10 * expected.norm(), "{} {expected}", pair.lambda);
            assert!(residuals(&full, &p, pair).iter().all(|residual| *residual < 1e-12), "{:?}", pair.lambda);
        }
    }
}
