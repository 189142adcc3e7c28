//! Residual flexibility and residual inertia: the quasi-static response of the truncated modes at the contact.
//!
//! ```text
//! R = Σ φ φᵀ / ω²,   Q = Σ φ φᵀ / ω⁴
//! ```
//!
//! The sums are over the truncated modes, with `φ` restricted to the degrees of freedom of the contact. The truncated
//! modes themselves are not computed. Unit loads `F`, made orthogonal to the kept modes, are applied to `A = K + s M`;
//! a second solve applies the inertia forces of the responses:
//!
//! ```text
//! X = A⁻¹ (F - M Φ Φᵀ F),   R_s = Fᵀ X,   Q_s = Fᵀ A⁻¹ M X = Xᵀ M X
//! ```
//!
//! `Q_s` needs either a second solve per load, or all responses stored in single precision. The latter is faster and
//! takes 4 bytes times the number of degrees of freedom times the number of loads. `R_s` and `Q_s` differ from `R` and
//! `Q` by powers of `s/ω²`. With `s` a millionth of the last kept `ω²`, rigid-body modes need no special treatment, and
//! `R = R_s + s Q_s` is accurate to 1e-12.
//!
//! Source: MacNeal 1971; Rubin 1975.

use faer::Mat;

use super::ReductionError;
use super::checked::definite;
use super::engine::Progress;
use super::normal_modes::{Analysed, SparseModes};
use super::sparse::{SparseMatrix, times};

/// The shift `s`, relative to the last kept `ω²`.
const SHIFT: f64 = 1e-6;
/// Largest `ω²` of a rigid-body mode (a rounding error), relative to the largest ratio of diagonal entries of stiffness
/// and mass.
const RIGID: f64 = 1e-13;
/// Number of loads solved at a time.
const TOGETHER: usize = 32;
/// Number of rows of stored responses multiplied at a time.
const ROWS_TOGETHER: usize = 4096;

/// Method for the residual inertia.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InertiaBy {
    /// `Xᵀ M X` of responses stored in single precision; accurate to 1e-7 of the largest entry.
    KeptAnswers,
    /// A second solve per load.
    SecondSolve,
}

/// Residuals between degrees of freedom of the contact, in the order requested.
#[derive(Clone, Debug)]
pub struct Residual {
    /// Residual flexibility `R`, m/N, symmetric.
    pub flexibility: Mat<f64>,
    /// Residual inertia `Q`, s²·m/N, symmetric.
    pub inertia: Mat<f64>,
}

impl Analysed<'_> {
    /// Estimated bytes that residuals for `loads` loads need in addition to [`Self::held_bytes`], including `count`
    /// modes.
    pub fn bytes_for_residual(&self, count: usize, loads: usize, inertia_by: InertiaBy) -> usize {
        // The modes and their products with M; for one set of loads: loads, responses, products and permuted copies.
        let columns = 2 * count + 5 * TOGETHER;
        let kept = if inertia_by == InertiaBy::KeptAnswers { size_of::<f32>() * loads } else { 0 };
        let vectors = self.pencil.dimension() * (size_of::<f64>() * columns + kept);
        // Both results and reordered copies of them.
        let between = 4 * size_of::<f64>() * loads * loads;
        if self.engine.foreign() {
            return between + vectors;
        }
        self.pencil.factor_bytes() + between + vectors.max(self.pencil.factoring_bytes())
    }

    /// Residual flexibility and inertia of the modes that `modes` omits, between the degrees of freedom `rows`. `None`
    /// denotes a fixed degree of freedom, whose rows and columns are 0. `progress` receives the progress.
    ///
    /// # Errors
    /// [`ReductionError`]: `OnlyRigid` if all kept modes are rigid-body modes, which give no scale for the shift;
    /// `NegativeStiffness` if a kept mode is unstable; `NoShift`; `Factorisation`; `Engine`.
    pub fn residual(
        &self,
        modes: &SparseModes,
        rows: &[Option<usize>],
        inertia_by: InertiaBy,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Residual, ReductionError> {
        let pencil = &self.pencil;
        let (what, mass, n) = (pencil.what, pencil.mass, pencil.dimension());
        let shift = self.shift(modes)?;
        let factor = definite(self.engine, pencil, shift)?
            .ok_or(ReductionError::NoShift { what: what.to_owned(), value: shift })?;
        progress(Progress::Factored { shift });
        let free: Vec<usize> = rows.iter().flatten().copied().collect();
        let phi = modes.phi.as_ref();
        let inertia_of_modes = times(mass, phi);
        // Removes components of the kept modes that rounding reintroduces, above all rigid-body ones.
        let freed = |mut x: Mat<f64>| {
            let back = inertia_of_modes.transpose() * &x;
            x -= phi * back;
            x
        };
        let [mut flexibility, mut inertia] = [0, 1].map(|_| Mat::<f64>::zeros(free.len(), free.len()));
        let seen = |matrix: &mut Mat<f64>, x: &Mat<f64>, first: usize| {
            for load in 0..x.ncols() {
                for (place, &row) in free.iter().enumerate() {
                    matrix[(place, first + load)] = x[(row, load)];
                }
            }
        };
        let mut answers: Vec<Mat<f32>> = vec![];
        for (chunk, loaded) in free.chunks(TOGETHER).enumerate() {
            let kept = Mat::from_fn(phi.ncols(), loaded.len(), |mode, load| -phi[(loaded[load], mode)]);
            let mut x = &inertia_of_modes * kept;
            for (load, &row) in loaded.iter().enumerate() {
                x[(row, load)] += 1.0;
            }
            factor.solve(&mut x, false)?;
            x = freed(x);
            seen(&mut flexibility, &x, chunk * TOGETHER);
            match inertia_by {
                InertiaBy::KeptAnswers => answers.push(Mat::from_fn(n, x.ncols(), |i, j| x[(i, j)] as f32)),
                InertiaBy::SecondSolve => {
                    let mut again = times(mass, x.as_ref());
                    factor.solve(&mut again, false)?;
                    seen(&mut inertia, &freed(again), chunk * TOGETHER);
                }
            }
            let solved = chunk * TOGETHER + loaded.len();
            progress(Progress::Loaded { solved, loads: free.len() });
        }
        drop(factor);
        if inertia_by == InertiaBy::KeptAnswers {
            inertia = inertia_of_answers(mass, &answers, free.len());
        }
        let shifted = |i: usize, j: usize| flexibility[(i, j)] + shift * inertia[(i, j)];
        Ok(Residual { flexibility: over_rows(rows, &shifted), inertia: over_rows(rows, &|i, j| inertia[(i, j)]) })
    }

    /// The shift of the factor, from the highest of the kept modes.
    fn shift(&self, modes: &SparseModes) -> Result<f64, ReductionError> {
        let (what, mass, stiffness) = (self.pencil.what, self.pencil.mass, self.pencil.stiffness);
        let last = modes.omega_squared.last().copied().unwrap_or(0.0);
        let diagonal = |matrix: &SparseMatrix, k: usize| matrix.get(k, k).copied().unwrap_or(0.0);
        let largest =
            (0..self.pencil.dimension()).map(|k| diagonal(stiffness, k) / diagonal(mass, k)).fold(0.0, f64::max);
        if last <= RIGID * largest {
            return Err(ReductionError::OnlyRigid { what: what.to_owned(), modes: modes.omega_squared.len() });
        }
        let limit = -super::SEMIDEFINITE_TOLERANCE * last.abs();
        if let Some((mode, &value)) = modes.omega_squared.iter().enumerate().find(|(_, square)| **square < limit) {
            return Err(ReductionError::NegativeStiffness { what: format!("{what}.stiffness"), mode, value, limit });
        }
        Ok(SHIFT * last)
    }
}

/// Residual inertia between `loads` loads from the answers to them, `Xᵀ M X`.
fn inertia_of_answers(mass: &SparseMatrix, answers: &[Mat<f32>], loads: usize) -> Mat<f64> {
    let mut inertia = Mat::zeros(loads, loads);
    for (chunk, right) in answers.iter().enumerate() {
        let right = times(mass, Mat::from_fn(mass.nrows(), right.ncols(), |i, j| f64::from(right[(i, j)])).as_ref());
        for (other, left) in answers.iter().enumerate().skip(chunk) {
            let product = product_of(left, &right);
            for j in 0..product.ncols() {
                for i in 0..product.nrows() {
                    let (i, j, value) = (other * TOGETHER + i, chunk * TOGETHER + j, product[(i, j)]);
                    inertia[(i, j)] = value;
                    inertia[(j, i)] = value;
                }
            }
        }
    }
    inertia
}

/// The symmetric part of `entry` between the degrees of freedom `rows`; 0 for fixed ones (`None`), which have no entry.
fn over_rows(rows: &[Option<usize>], entry: &dyn Fn(usize, usize) -> f64) -> Mat<f64> {
    let mut position = 0;
    let place: Vec<Option<usize>> = rows
        .iter()
        .map(|row| {
            row.map(|_| {
                position += 1;
                position - 1
            })
        })
        .collect();
    Mat::from_fn(rows.len(), rows.len(), |i, j| match (place[i], place[j]) {
        (Some(i), Some(j)) => 0.5 * (entry(i, j) + entry(j, i)),
        (None, _) | (_, None) => 0.0,
    })
}

/// `leftᵀ right`, computed in double precision.
fn product_of(left: &Mat<f32>, right: &Mat<f64>) -> Mat<f64> {
    let mut product = Mat::zeros(left.ncols(), right.ncols());
    for first in (0..left.nrows()).step_by(ROWS_TOGETHER) {
        let rows = ROWS_TOGETHER.min(left.nrows() - first);
        let part = Mat::from_fn(rows, left.ncols(), |i, j| f64::from(left[(first + i, j)]));
        product += part.transpose() * right.subrows(first, rows);
    }
    product
}

#[cfg(test)]
mod tests {
    use super::super::{ModeSelection, OwnEngine, SparseMatrix, free_interface_modes, lowest_modes};
    use super::*;
    use faer::sparse::Triplet;

    /// A free chain of masses with springs that vary along it.
    fn chain(n: usize) -> (SparseMatrix, SparseMatrix) {
        let (mut mass, mut stiffness) = (vec![], vec![]);
        for i in 0..n {
            mass.push(Triplet::new(i, i, 1.0 + 0.5 * (i as f64).sin()));
            if i + 1 < n {
                let spring = 100.0 + 30.0 * (0.1 * i as f64).cos();
                for (row, column, sign) in [(i, i, 1.0), (i + 1, i + 1, 1.0), (i, i + 1, -1.0), (i + 1, i, -1.0)] {
                    stiffness.push(Triplet::new(row, column, sign * spring));
                }
            }
        }
        let build = |t: &[_]| SparseMatrix::try_new_from_triplets(n, n, t).unwrap();
        (build(&mass), build(&stiffness))
    }

    /// A rigid-body mode gives no scale of stiffness for the shift.
    #[test]
    fn nothing_but_rigid_motions_leaves_no_residual() {
        let (mass, stiffness) = chain(420);
        let analysed = Analysed::new(&OwnEngine, "pad", &mass, &stiffness).unwrap();
        let residual = |count: usize| {
            let kept = lowest_modes("pad", &mass, &stiffness, count).unwrap();
            analysed.residual(&kept, &[Some(3)], InertiaBy::SecondSolve, &mut |_| {})
        };
        assert_eq!(residual(1).unwrap_err(), ReductionError::OnlyRigid { what: "pad".to_owned(), modes: 1 });
        residual(2).unwrap();
    }

    #[test]
    fn a_free_chain_against_all_its_modes() {
        let n = 420;
        let (mass, stiffness) = chain(n);
        let kept = lowest_modes("pad", &mass, &stiffness, 20).unwrap();
        let rows = [Some(3), None, Some(200), Some(n - 1)];
        let analysed = Analysed::new(&OwnEngine, "pad", &mass, &stiffness).unwrap();
        let by = |way| analysed.residual(&kept, &rows, way, &mut |_| {}).unwrap();
        let [found, faster] = [InertiaBy::SecondSolve, InertiaBy::KeptAnswers].map(by);
        // `R` depends on the method for `Q` only through `s Q`, a relative 1e-12.
        assert!((&found.flexibility - &faster.flexibility).norm_max() < 1e-12 * found.flexibility.norm_max());
        assert!((&found.inertia - &faster.inertia).norm_max() < 1e-6 * found.inertia.norm_max());
        // Expected: the sum over the other 400 modes of a dense solve. Errors of 1e-12 of a kept mode enter squared.
        // The lowest truncated ω², 1e-2 of the largest (500), is accurate to 1e-11 in the dense solve.
        let all =
            free_interface_modes("pad", mass.to_dense().as_ref(), stiffness.to_dense().as_ref(), &ModeSelection::All)
                .unwrap();
        let sum = |i: usize, j: usize, power: i32| -> f64 {
            (20..n).map(|k| all.phi[(i, k)] * all.phi[(j, k)] / all.omega_rad_s[k].powi(power)).sum()
        };
        for (matrix, power) in [(&found.flexibility, 2), (&found.inertia, 4)] {
            let largest = matrix.norm_max();
            for (a, row) in rows.iter().enumerate() {
                for (b, column) in rows.iter().enumerate() {
                    let expected = if let (Some(i), Some(j)) = (row, column) { sum(*i, *j, power) } else { 0.0 };
                    // `Q` is evaluated at the shift, which changes it by 2e-6.
                    let tolerance = if power == 2 { 1e-10 } else { 3e-6 };
                    let value = matrix[(a, b)];
                    assert!((value - expected).abs() < tolerance * largest, "{power} {a} {b}: {value} {expected}");
                }
            }
        }
    }
}
