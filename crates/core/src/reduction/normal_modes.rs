//! Lowest real modes of a large sparse symmetric system.
//!
//! With `A = K + s M = L Lᵀ` positive definite, `C = L⁻¹ M L⁻ᵀ` is symmetric with the eigenvalues `θ = 1 / (ω² + s)`,
//! the largest of which belong to the lowest modes. The eigenvectors `y` of `C` give `φ = L⁻ᵀ y / √θ`. A small shift
//! `s` keeps `A` definite when there are rigid-body modes. The inertia of `K - σ M` counts the modes below `σ`
//! (Sylvester's law), which detects missed modes.

use faer::Mat;

use super::dense::{fix_signs, symmetric_eigen};
use super::engine::{CountedBy, Eigenpairs, Engine, GAP, Lowest, Progress, gap_after};
use super::lanczos::capacity;
use super::own_engine::{OwnEngine, TOGETHER};
use super::pencil::{Llt, Pencil};
use super::sparse::{one_norm, symmetric_times};
use super::{ReductionError, SparseMatrix, whiten};

/// Largest scaled residual `|K φ - ω² M φ| / ((|K| + |ω²| |M|) |φ|)` of a mode, with 1-norms of the matrices.
const BACKWARD_LIMIT: f64 = 1e-12;
/// Below this many degrees of freedom a dense solve is at least as fast.
const DENSE_BELOW: usize = 400;
/// The first shift `s` to try, relative to `tr K / tr M`.
const FIRST_SHIFT: f64 = 3e-9;
/// Largest ratio of the wanted `θ`. Above it the shift is increased, because small `θ` would lose digits to the
/// rounding of the largest.
const WIDEST_SPREAD: f64 = 1e6;

/// Which modes to compute.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Wanted {
    /// The modes of lowest frequency, as many as given.
    Lowest(usize),
    /// All modes with `ω` below this, rad/s.
    Below(f64),
    /// All modes below `below_rad_s`, whose number [`Analysed::count_below`] has already determined.
    Counted {
        /// Number of modes.
        modes: usize,
        /// All of them are below this angular frequency, rad/s.
        below_rad_s: f64,
    },
}

/// Lowest modes of a symmetric system, which may be statically unstable.
#[derive(Clone, Debug)]
pub struct SparseModes {
    /// `ω²`, rad²/s², ascending; negative values occur if the stiffness is indefinite.
    pub omega_squared: Vec<f64>,
    /// `Φ`, degrees of freedom by modes, kg^-1/2, mass-normalised: `Φᵀ M Φ = I`.
    pub phi: Mat<f64>,
    /// Scaled residual `|K φ - ω² M φ| / ((|K| + |ω²| |M|) |φ|)` of every mode, with 2-norms of vectors and 1-norms of
    /// matrices.
    pub residuals: Vec<f64>,
}

/// The `count` lowest modes of `K φ = ω² M φ`: [`normal_modes`] without a memory limit.
///
/// # Errors
/// As [`normal_modes`].
pub fn lowest_modes(
    what: &str,
    mass: &SparseMatrix,
    stiffness: &SparseMatrix,
    count: usize,
) -> Result<SparseModes, ReductionError> {
    normal_modes(what, mass, stiffness, Wanted::Lowest(count), None, &mut |_| {})
}

/// The lowest modes of `K φ = ω² M φ` with sparse, symmetric `n×n` matrices: `mass` `M`, kg, and `stiffness` `K`, N/m.
/// `M` must be positive definite; for systems that are not solved densely, positive semidefinite with a positive
/// diagonal is enough.
///
/// `what` names the system in errors. `memory_limit_bytes` limits the memory taken in addition to what is already held;
/// the estimated need is compared with it before the work starts. `progress` receives the progress.
///
/// # Errors
/// [`ReductionError`]: `Shape`, `NotFinite`, `Unsymmetric`, `Indefinite`, `ModeCount`, `Memory`, `NoShift`,
/// `NotConverged`, `Residual`, `MissedModes`, `Factorisation`.
pub fn normal_modes(
    what: &str,
    mass: &SparseMatrix,
    stiffness: &SparseMatrix,
    wanted: Wanted,
    memory_limit_bytes: Option<usize>,
    progress: &mut dyn FnMut(Progress),
) -> Result<SparseModes, ReductionError> {
    Analysed::new(&OwnEngine, what, mass, stiffness)?.modes(wanted, memory_limit_bytes, progress)
}

/// A sparse symmetric system `K - σ M`, checked, ordered and symbolically analysed: ready to compute its modes and
/// residuals.
pub struct Analysed<'a> {
    pub(super) pencil: Pencil<'a>,
    pub(super) engine: &'a dyn Engine,
    /// The rows at the contact, each once, eliminated last.
    pub(super) contact: Vec<usize>,
}

impl<'a> Analysed<'a> {
    /// Analyses a system that `engine` will solve; see [`normal_modes`].
    ///
    /// # Errors
    /// [`ReductionError`]: `Shape`, `NotFinite`, `Unsymmetric`, `Indefinite`, `Factorisation`.
    pub fn new(
        engine: &'a dyn Engine,
        what: &'a str,
        mass: &'a SparseMatrix,
        stiffness: &'a SparseMatrix,
    ) -> Result<Self, ReductionError> {
        Self::with_contact(engine, what, mass, stiffness, &[])
    }

    /// Like [`Self::new`], ready for [`Self::residual`] between the rows `contact`.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_contact(
        engine: &'a dyn Engine,
        what: &'a str,
        mass: &'a SparseMatrix,
        stiffness: &'a SparseMatrix,
        contact: &[Option<usize>],
    ) -> Result<Self, ReductionError> {
        let mut contact: Vec<usize> = contact.iter().flatten().copied().collect();
        contact.sort_unstable();
        contact.dedup();
        Ok(Self { pencil: Pencil::with_last(what, mass, stiffness, &contact)?, engine, contact })
    }

    /// Bytes held in addition to the two given matrices.
    pub fn held_bytes(&self) -> usize {
        self.pencil.held_bytes()
    }

    /// Estimated bytes needed for `count` modes in addition to [`Self::held_bytes`]: the factor, plus the larger of the
    /// memory to compute it and the vectors of the iteration.
    pub fn bytes_for(&self, count: usize) -> usize {
        let n = self.pencil.dimension();
        // The basis, and temporaries: a block and its products, or a set of vectors transformed back at the end.
        let vectors = size_of::<f64>() * n * (capacity(n, count) + AT_A_TIME * TOGETHER);
        // After the factor is freed: the modes, a copy of them, and their products with K and M.
        let finished = size_of::<f64>() * n * 4 * count;
        if self.engine.foreign() {
            return finished;
        }
        (self.pencil.factor_bytes() + vectors.max(self.pencil.factoring_bytes())).max(finished)
    }

    /// Number of entries of a factor.
    pub fn factor_entries(&self) -> usize {
        self.pencil.factor_entries()
    }

    /// Number of modes below `square`, rad²/s², from the inertia of `K - σ M`, and whose factor it is of: ours, if
    /// `memory_limit_bytes` allow it, else the engine's.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `Engine`.
    pub fn count_below(
        &self,
        square: f64,
        memory_limit_bytes: Option<usize>,
    ) -> Result<(usize, CountedBy), ReductionError> {
        let bytes = self.pencil.factoring_bytes();
        if !self.engine.foreign() || memory_limit_bytes.is_none_or(|limit| bytes <= limit) {
            return Ok((self.pencil.count_below(square)?, CountedBy::Us));
        }
        Ok((self.engine.count_below(&self.pencil, square)?, CountedBy::Engine))
    }

    /// The lowest modes; see [`normal_modes`].
    ///
    /// # Errors
    /// [`ReductionError`]: `ModeCount`, `Memory`, `NoShift`, `NotConverged`, `Residual`, `MissedModes`,
    /// `Factorisation`.
    pub fn modes(
        &self,
        wanted: Wanted,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<SparseModes, ReductionError> {
        Ok(self.modes_and_factor(wanted, false, memory_limit_bytes, progress)?.0)
    }

    /// [`Self::modes`], the shift `s` they were computed with and, if it is to be kept, the factor of `K + s M`. A small system
    /// has no shift, and a foreign engine no factor here.
    pub(super) fn modes_and_factor(
        &self,
        wanted: Wanted,
        keep: bool,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(SparseModes, Option<f64>, Option<Llt<'_>>), ReductionError> {
        let pencil = &self.pencil;
        let (what, n) = (pencil.what, pencil.dimension());
        let analysing = |count: usize| Progress::Analysed {
            factor_entries: self.factor_entries(),
            bytes: self.held_bytes() + self.bytes_for(count),
        };
        let check = |analysed: Progress| match (analysed, memory_limit_bytes) {
            (Progress::Analysed { bytes, .. }, Some(limit)) if bytes > limit => {
                Err(ReductionError::Memory { what: what.to_owned(), bytes, limit })
            }
            _ => Ok(()),
        };
        // Without a known count, check only whether there is memory for the factor that counting needs.
        let analysed = analysing(match wanted {
            Wanted::Lowest(count) | Wanted::Counted { modes: count, .. } => count,
            Wanted::Below(_) => 0,
        });
        progress(analysed);
        check(analysed)?;
        let count = match wanted {
            Wanted::Lowest(count) | Wanted::Counted { modes: count, .. } => count,
            Wanted::Below(omega_rad_s) => {
                let below = omega_rad_s * omega_rad_s;
                let (modes, by) = self.count_below(below, memory_limit_bytes)?;
                progress(Progress::Counted { modes, below, by });
                progress(analysing(modes));
                check(analysing(modes))?;
                modes
            }
        };
        if count == 0 || count > n {
            let value = match wanted {
                Wanted::Lowest(count) => format!("{count} modes"),
                Wanted::Below(omega_rad_s) | Wanted::Counted { below_rad_s: omega_rad_s, .. } => {
                    format!("modes below {omega_rad_s} rad/s (there is none)")
                }
            };
            let limit = format!("1 to {n} modes");
            return Err(ReductionError::ModeCount { what: format!("{what}.modes"), value, limit });
        }
        let cutoff = match wanted {
            Wanted::Lowest(_) => None,
            Wanted::Below(omega_rad_s) | Wanted::Counted { below_rad_s: omega_rad_s, .. } => {
                Some(omega_rad_s * omega_rad_s)
            }
        };
        if n < DENSE_BELOW || 3 * count > n {
            return Ok((finish(pencil, dense(pencil, count)?)?, None, None));
        }
        let mut shift = pencil.typical_square() * FIRST_SHIFT;
        for attempt in 0.. {
            let wanted = Lowest { first_shift: shift, count, cutoff, attempt };
            let mut found = self.engine.lowest(pencil, &wanted, progress)?;
            let factor = found.factor.take().filter(|_| keep);
            if self.engine.foreign() {
                found.check(pencil, count)?;
            }
            shift = found.shift;
            let squares = &found.omega_squared;
            let spread = (squares[count - 1] + shift) / (squares[0] + shift);
            if spread > WIDEST_SPREAD && attempt == 0 {
                shift = squares[count - 1] / WIDEST_SPREAD.sqrt();
                continue;
            }
            let counted = match cutoff {
                Some(below) => complete_below_cutoff(pencil, squares, count, below),
                None => self.complete_below_gap(squares, count, memory_limit_bytes, progress),
            };
            match counted {
                Ok(()) => return Ok((finish(pencil, found.first(count))?, Some(shift), factor)),
                // Retry with another start block before giving up.
                Err(ReductionError::MissedModes { .. }) if attempt < 3 => {}
                Err(error) => return Err(error),
            }
        }
        unreachable!("the loop ends by returning");
    }

    /// Checks that the number of modes below the first gap after `count` equals the inertia count of `K - σ M` there.
    fn complete_below_gap(
        &self,
        squares: &[f64],
        count: usize,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), ReductionError> {
        let what = self.pencil.what;
        let missed =
            |found, counted, below| Err(ReductionError::MissedModes { what: what.to_owned(), found, counted, below });
        let Some(found) = gap_after(squares, count) else { return missed(squares.len(), 0, f64::NAN) };
        let below = 0.5 * (squares[found - 1] + squares[found]);
        let (counted, by) = self.count_below(below, memory_limit_bytes)?;
        progress(Progress::Counted { modes: counted, below, by });
        if counted == found { Ok(()) } else { missed(found, counted, below) }
    }
}

/// Number of copies of them held meanwhile: the input, permuted to the order of elimination, during the solve, and
/// permuted back.
const AT_A_TIME: usize = 4;

/// The `count` lowest modes by a dense solve, for small systems.
fn dense<'p>(pencil: &'p Pencil<'_>, count: usize) -> Result<Eigenpairs<'p>, ReductionError> {
    let whitening = whiten(&format!("{}.mass", pencil.what), pencil.mass.to_dense().as_ref())?;
    let stiffness = pencil.stiffness.to_dense();
    let (squares, vectors) = symmetric_eigen(pencil.what, whitening.congruence(stiffness.as_ref(), true).as_ref())?;
    let mut phi = vectors.subcols(0, count).to_owned();
    whitening.back(&mut phi);
    Ok(Eigenpairs { omega_squared: squares[..count].to_vec(), phi, shift: 0.0, factor: None })
}

/// Checks that the `count` lowest modes found all lie below the cut-off `σ`, where the inertia of `K - σ M` counted as
/// many. A missed mode would let one from above the cut-off take its place.
fn complete_below_cutoff(pencil: &Pencil<'_>, squares: &[f64], count: usize, below: f64) -> Result<(), ReductionError> {
    let found = squares.iter().filter(|square| **square < below + GAP * below.abs()).count();
    if found >= count {
        return Ok(());
    }
    Err(ReductionError::MissedModes { what: pencil.what.to_owned(), found, counted: count, below })
}

/// Normalises signs and computes the scaled residual of every mode explicitly.
///
/// # Errors
/// [`ReductionError::Residual`].
fn finish(pencil: &Pencil<'_>, found: Eigenpairs<'_>) -> Result<SparseModes, ReductionError> {
    let Eigenpairs { omega_squared, mut phi, .. } = found;
    fix_signs(&mut phi);
    #[cfg(test)]
    if crate::spoil::spoilt(crate::spoil::Spoil::Vector) {
        phi[(0, 0)] += 1e-3 * phi.norm_max();
    }
    let (stiffness, mass) = (one_norm(pencil.stiffness), one_norm(pencil.mass));
    let mut residual = symmetric_times(pencil.stiffness, phi.as_ref());
    let inertia = symmetric_times(pencil.mass, phi.as_ref());
    let mut residuals = vec![];
    for (mode, &square) in omega_squared.iter().enumerate() {
        let mut column = residual.col_mut(mode);
        column -= faer::Scale(square) * inertia.col(mode);
        let value = column.norm_l2() / ((stiffness + square.abs() * mass) * phi.col(mode).norm_l2());
        if value.is_nan() || value > BACKWARD_LIMIT {
            return Err(ReductionError::Residual { what: pencil.what.to_owned(), mode, value, limit: BACKWARD_LIMIT });
        }
        residuals.push(value);
    }
    Ok(SparseModes { omega_squared, phi, residuals })
}

#[cfg(test)]
mod tests {
    use super::super::sparse::{times, weighted_sum};
    use super::*;
    use faer::sparse::Triplet;

    /// A square membrane of `side × side` points: `ω² = (4 - 2 cos(pπ/(s+1)) - 2 cos(qπ/(s+1))) / mass_of` with
    /// `s = side`; nearly all are double.
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
        // The residual in `K` and `M` exceeds that of the iteration by the norm of K, 8.
        assert!(residual.norm_max() < 8.0 * 1e-10 * modes.phi.norm_max(), "{:e}", residual.norm_max());
    }

    #[test]
    fn a_free_and_an_unstable_membrane() {
        let (mass, stiffness, expected) = membrane(25, 2.0);
        // Subtracting a multiple of the mass makes the first `ω²` negative, and one of them zero.
        let lowered = weighted_sum(625, &[(1.0, &stiffness), (-expected[3], &mass)]).unwrap();
        let modes = lowest_modes("system", &mass, &lowered, 12).unwrap();
        for (found, expected_here) in modes.omega_squared.iter().zip(&expected) {
            assert!((found - (expected_here - expected[3])).abs() < 1e-11, "{found}");
        }
    }

    #[test]
    fn modes_below_a_cut_off_are_counted_first() {
        let (mass, stiffness, expected) = membrane(30, 1e-7);
        // Between the 17th and the 18th frequency, where a pair ends; rad/s.
        let cutoff = (0.5 * (expected[16] + expected[17])).sqrt();
        let below = expected.iter().filter(|square| **square < cutoff * cutoff).count();
        let mut reports = vec![];
        let modes =
            normal_modes("pad", &mass, &stiffness, Wanted::Below(cutoff), None, &mut |p| reports.push(p)).unwrap();
        assert_eq!(modes.omega_squared.len(), below);
        assert!(modes.residuals.iter().all(|residual| *residual < 1e-12));
        assert!(
            reports.contains(&Progress::Counted { modes: below, below: cutoff * cutoff, by: CountedBy::Us }),
            "{reports:?}"
        );
        let none = normal_modes("pad", &mass, &stiffness, Wanted::Below(1.0), None, &mut |_| {}).unwrap_err();
        assert_eq!(
            none.to_string(),
            "pad.modes: modes below 1 rad/s (there is none) requested, expected 1 to 900 modes"
        );
    }

    #[test]
    fn more_memory_than_allowed_is_refused_before_the_work() {
        let (mass, stiffness, _) = membrane(30, 1e-7);
        let mut reports = vec![];
        let refused =
            normal_modes("disc", &mass, &stiffness, Wanted::Lowest(40), Some(1 << 20), &mut |p| reports.push(p));
        let Err(ReductionError::Memory { bytes, limit, .. }) = refused else { panic!("{refused:?}") };
        // At least a basis of 3·40 + 48 vectors of 900 numbers.
        assert!(bytes > 168 * 900 * 8 && limit == 1 << 20, "{bytes} {limit}");
        assert!(matches!(reports[..], [Progress::Analysed { .. }]), "{reports:?}");
    }

    /// The inertia count detects a mode that every attempt of the iteration misses, both for a given number of modes
    /// and for a cut-off.
    #[test]
    fn a_lost_mode_is_missed_by_the_inertia() {
        use crate::spoil::{Spoil, with};
        let (mass, stiffness, expected) = membrane(30, 1e-7);
        let cutoff = (0.5 * (expected[16] + expected[17])).sqrt();
        for wanted in [Wanted::Lowest(20), Wanted::Below(cutoff)] {
            let found = with(Spoil::Mode, || normal_modes("pad", &mass, &stiffness, wanted, None, &mut |_| {}));
            let missed = matches!(&found, Err(ReductionError::MissedModes { what, .. }) if what == "pad");
            assert!(missed, "{:?}", found.map(|modes| modes.omega_squared));
        }
    }

    /// A falsified mode is rejected by its residual, from the iteration and from the dense solve.
    #[test]
    fn a_wrong_mode_is_refused_by_its_residual() {
        use crate::spoil::{Spoil, with};
        for (side, count) in [(30, 20), (5, 10)] {
            let (mass, stiffness, _) = membrane(side, 0.5);
            let found = with(Spoil::Vector, || lowest_modes("disc", &mass, &stiffness, count));
            let Err(ReductionError::Residual { what, mode: 0, value, limit }) = found else { panic!("{side}") };
            assert!(what == "disc" && value > limit && limit == BACKWARD_LIMIT);
            assert!(lowest_modes("disc", &mass, &stiffness, count).is_ok());
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

    /// A semidefinite mass with blocks `M = [1 1; 1 1]` for pairs of points. Condensed by hand, `M` acts on the sum of
    /// a pair only: `K⁻¹ M` and its projection on the sums have the same non-zero eigenvalues `1/ω²`.
    #[test]
    fn a_semidefinite_mass_has_as_many_modes_as_its_rank() {
        let (_, stiffness, _) = membrane(25, 1.0);
        let n = 625;
        let mut triplets = vec![];
        for first in (0..n).step_by(2) {
            let pair = if first + 1 < n { vec![first, first + 1] } else { vec![first] };
            triplets.extend(pair.iter().flat_map(|&i| pair.iter().map(move |&j| Triplet::new(i, j, 1.0))));
        }
        let mass = SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap();
        let found = lowest_modes("system", &mass, &stiffness, 20).unwrap();
        let sums = Mat::from_fn(n, n.div_ceil(2), |i, j| if i / 2 == j { 1.0 } else { 0.0 });
        let inverse = faer::linalg::solvers::Solve::solve(&stiffness.to_dense().partial_piv_lu(), &sums);
        let condensed = sums.transpose() * inverse;
        let (squares, _) = symmetric_eigen("condensed", condensed.as_ref()).unwrap();
        for (square, inverse) in found.omega_squared.iter().zip(squares.iter().rev()) {
            assert!((square * inverse - 1.0).abs() < 1e-10, "{square} {inverse}");
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
