//! Residual flexibility and residual inertia: the quasi-static response of the truncated modes at the contact.
//!
//! ```text
//! R = Σ φ φᵀ / ω²,   Q = Σ φ φᵀ / ω⁴
//! ```
//!
//! The sums are over the truncated modes, with `φ` restricted to the degrees of freedom of the contact. The truncated
//! modes themselves are not computed. With `A = K + s M`, the kept modes `Φ`, and loads `F` that these do not see,
//!
//! ```text
//! X = A⁻¹ (F - M Φ Φᵀ F),   R_s = Fᵀ X,   Q_s = -dR_s/ds = Xᵀ M X
//! ```
//!
//! The factor is that of the modes where its shift is small enough. `R_s` and `Q_s` differ from `R` and `Q` by powers of
//! `s/ω²`: in `R = R_s + s Q_s` each truncated mode has a relative error of `(s/ω²)²`, in `Q` of `2 s/ω²`. With `s` below
//! [`REUSED`] of the last kept `ω²`, that is 2.5e-11 for the lowest truncated mode, whose share of `R` is small, and
//! rigid-body modes need no special treatment.
//!
//! A foreign engine solves for some loads at a time, once for `R_s` and once more for `Q_s = Fᵀ A⁻¹ M X`.
//!
//! Source: MacNeal 1971; Rubin 1975.

use faer::Mat;

use super::ReductionError;
use super::checked::definite;
use super::engine::Progress;
use super::normal_modes::{Analysed, SparseModes};
use super::pencil::Llt;
use super::sparse::{SparseMatrix, symmetric_times};
use super::unit_loads::Responses;

/// The shift `s` of a factor made for residuals, relative to the last kept `ω²`.
const SHIFT: f64 = 1e-6;
/// Largest shift of a factor of the modes with which residuals are computed, relative to the last kept `ω²`.
const REUSED: f64 = 5e-6;
/// Largest `ω²` of a rigid-body mode (a rounding error), relative to the largest ratio of diagonal entries of stiffness
/// and mass.
const RIGID: f64 = 1e-13;
/// Number of loads solved at a time.
const TOGETHER: usize = 32;

/// Residuals between degrees of freedom of the contact, in the order requested.
#[derive(Clone, Debug)]
pub struct Residual {
    /// Residual flexibility `R`, m/N, symmetric.
    pub flexibility: Mat<f64>,
    /// Residual inertia `Q`, s²·m/N, symmetric.
    pub inertia: Mat<f64>,
}

impl Analysed<'_> {
    /// Estimated bytes that residuals need in addition to [`Self::held_bytes`], including `count` modes.
    pub fn bytes_for_residual(&self, count: usize) -> usize {
        let (n, loads, float) = (self.pencil.dimension(), self.contact.len(), size_of::<f64>());
        // Both results, what they are computed from, and temporaries.
        let between = 10 * float * loads.pow(2);
        if self.engine.foreign() {
            // The modes and their products with M; for one set of loads: loads, responses, products and permuted copies.
            return between + n * float * (2 * count + 5 * TOGETHER);
        }
        let responding = Llt::response_bytes(&self.pencil, loads, count).max(self.pencil.factoring_bytes());
        between + n * float * count + self.pencil.factor_bytes() + responding
    }

    /// Residual flexibility and inertia of the modes that `modes` omits, between the degrees of freedom `rows`, those of
    /// [`Self::with_contact`]. `None` denotes a fixed degree of freedom, whose rows and columns are 0. `progress` receives
    /// the progress.
    ///
    /// # Errors
    /// [`ReductionError`]: `OnlyRigid` if all kept modes are rigid-body modes, which give no scale for the shift;
    /// `NegativeStiffness` if a kept mode is unstable; `NoShift`; `Factorisation`; `Engine`.
    pub fn residual(
        &self,
        modes: &SparseModes,
        rows: &[Option<usize>],
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Residual, ReductionError> {
        self.residual_at(None, None, modes, rows, progress)
    }

    /// As [`Self::residual`], with the shift of the modes, and their factor, where they serve.
    pub(super) fn residual_at(
        &self,
        shift: Option<f64>,
        factor: Option<Llt<'_>>,
        modes: &SparseModes,
        rows: &[Option<usize>],
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Residual, ReductionError> {
        let (anew, largest) = self.shifts(modes)?;
        let reused = shift.filter(|shift| *shift <= largest);
        let shift = reused.unwrap_or(anew);
        let [flexibility, inertia] = if self.engine.foreign() {
            self.by_solves(modes, shift, progress)?
        } else {
            let factor = match factor.filter(|_| reused.is_some()) {
                Some(factor) => factor,
                None => {
                    let no_shift = || ReductionError::NoShift { what: self.pencil.what.to_owned(), value: shift };
                    let factor = self.pencil.llt(shift)?.ok_or_else(no_shift)?;
                    progress(Progress::Factored { shift });
                    factor
                }
            };
            self.by_responses(&factor, modes, shift, progress)?
        };
        let shifted = |i: usize, j: usize| flexibility[(i, j)] + shift * inertia[(i, j)];
        Ok(Residual {
            flexibility: self.over_rows(rows, &shifted),
            inertia: self.over_rows(rows, &|i, j| inertia[(i, j)]),
        })
    }

    /// `R_s` and `Q_s` between the rows of the contact, from the factor of `K + s M`.
    fn by_responses(
        &self,
        factor: &Llt<'_>,
        modes: &SparseModes,
        shift: f64,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<[Mat<f64>; 2], ReductionError> {
        let loads = self.contact.len();
        if loads == 0 {
            return Ok([0, 1].map(|_| Mat::zeros(0, 0)));
        }
        let Responses { at_contact, inertia, of_modes } = factor.responses(shift, &self.contact, modes.phi.as_ref())?;
        progress(Progress::Loaded { solved: loads, loads });
        // Removes components of the kept modes that rounding reintroduces, above all rigid-body ones: `X - Φ Bᵀ X`.
        let phi = Mat::from_fn(loads, modes.phi.ncols(), |load, mode| modes.phi[(self.contact[load], mode)]);
        Ok([at_contact - phi * &of_modes, inertia - of_modes.transpose() * &of_modes])
    }

    /// `R_s` and `Q_s` between the rows of the contact, by two solves for each of them.
    fn by_solves(
        &self,
        modes: &SparseModes,
        shift: f64,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<[Mat<f64>; 2], ReductionError> {
        let (pencil, free) = (&self.pencil, &self.contact);
        let factor = definite(self.engine, pencil, shift)?
            .ok_or(ReductionError::NoShift { what: pencil.what.to_owned(), value: shift })?;
        progress(Progress::Factored { shift });
        let phi = modes.phi.as_ref();
        let inertia_of_modes = symmetric_times(pencil.mass, phi);
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
        for (chunk, loaded) in free.chunks(TOGETHER).enumerate() {
            let kept = Mat::from_fn(phi.ncols(), loaded.len(), |mode, load| -phi[(loaded[load], mode)]);
            let mut x = &inertia_of_modes * kept;
            for (load, &row) in loaded.iter().enumerate() {
                x[(row, load)] += 1.0;
            }
            factor.solve(&mut x, false)?;
            x = freed(x);
            seen(&mut flexibility, &x, chunk * TOGETHER);
            let mut again = symmetric_times(pencil.mass, x.as_ref());
            factor.solve(&mut again, false)?;
            seen(&mut inertia, &freed(again), chunk * TOGETHER);
            let solved = chunk * TOGETHER + loaded.len();
            progress(Progress::Loaded { solved, loads: free.len() });
        }
        Ok([flexibility, inertia])
    }

    /// The symmetric part of `entry` between the degrees of freedom `rows`; 0 for fixed ones (`None`), which have no
    /// entry.
    fn over_rows(&self, rows: &[Option<usize>], entry: &dyn Fn(usize, usize) -> f64) -> Mat<f64> {
        let place: Vec<Option<usize>> =
            rows.iter().map(|row| row.and_then(|row| self.contact.binary_search(&row).ok())).collect();
        Mat::from_fn(rows.len(), rows.len(), |i, j| match (place[i], place[j]) {
            (Some(i), Some(j)) => 0.5 * (entry(i, j) + entry(j, i)),
            (None, _) | (_, None) => 0.0,
        })
    }

    /// The shift of a factor for residuals, and the largest one of a factor that serves too, from the highest kept mode.
    fn shifts(&self, modes: &SparseModes) -> Result<(f64, f64), ReductionError> {
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
        Ok((SHIFT * last, REUSED * last))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{ModeSelection, OwnEngine, Precision, Wanted, free_interface_modes, lowest_modes};
    use super::*;
    use crate::spoil::{Spoil, with};
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
        let rows = [Some(3)];
        let analysed = Analysed::with_contact(&OwnEngine, "pad", &mass, &stiffness, &rows).unwrap();
        let residual = |count: usize| {
            let kept = lowest_modes("pad", &mass, &stiffness, count).unwrap();
            analysed.residual(&kept, &rows, &mut |_| {})
        };
        assert_eq!(residual(1).unwrap_err(), ReductionError::OnlyRigid { what: "pad".to_owned(), modes: 1 });
        residual(2).unwrap();
    }

    /// A factor is used only if it solves a known equation, and sums over subtrees only if they hold for a known combination.
    #[test]
    fn spoilt_factors_and_sums_are_refused_by_their_checks() {
        let (mass, stiffness) = chain(420);
        let rows = [Some(3), Some(200)];
        let analysed = Analysed::with_contact(&OwnEngine, "pad", &mass, &stiffness, &rows).unwrap();
        let kept = analysed.modes(Wanted::Lowest(9), None, &mut |_| {}).unwrap();
        let (shift, _) = analysed.shifts(&kept).unwrap();
        let refused = |error: ReductionError| match error {
            ReductionError::Factorisation { what, reason } => what == "pad" && reason.contains("limit"),
            _ => false,
        };
        for spoilt in [Spoil::Factor, Spoil::Share] {
            let found = with(spoilt, || analysed.residual(&kept, &rows, &mut |_| {}));
            assert!(refused(found.unwrap_err()), "{spoilt:?}");
        }
        assert!(refused(with(Spoil::Factor, || analysed.pencil.llt(shift)).err().unwrap()));
        // Far from the rigid motion: the condition of `K + s M` is a few thousand.
        let shift = analysed.pencil.typical_square() * 1e-3;
        for precision in [Precision::Double, Precision::Single] {
            let spoilt = with(Spoil::Factor, || analysed.pencil.ldlt(shift, precision));
            assert!(refused(spoilt.err().unwrap()), "{precision:?}");
            assert!(analysed.pencil.ldlt(shift, precision).is_ok(), "{precision:?}");
        }
        analysed.residual(&kept, &rows, &mut |_| {}).unwrap();
    }

    #[test]
    fn a_free_chain_against_all_its_modes() {
        let n = 420;
        let (mass, stiffness) = chain(n);
        let kept = lowest_modes("pad", &mass, &stiffness, 20).unwrap();
        let rows = [Some(3), None, Some(200), Some(n - 1)];
        let analysed = Analysed::with_contact(&OwnEngine, "pad", &mass, &stiffness, &rows).unwrap();
        let found = analysed.residual(&kept, &rows, &mut |_| {}).unwrap();
        let (shift, _) = analysed.shifts(&kept).unwrap();
        let factor = analysed.pencil.llt(shift).unwrap().unwrap();
        let solved = analysed.by_solves(&kept, shift, &mut |_| {}).unwrap();
        let responses = analysed.by_responses(&factor, &kept, shift, &mut |_| {}).unwrap();
        for (solved, found) in solved.iter().zip(&responses) {
            assert!((solved - found).norm_max() < 1e-10 * solved.norm_max());
        }
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
