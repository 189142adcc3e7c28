//! Real modes of dense symmetric systems, and the Cholesky factor of the mass matrix.

use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Mat, MatRef, Par, Side};

use super::{DEFINITE_TOLERANCE, ReductionError, SEMIDEFINITE_TOLERANCE, SYMMETRY_TOLERANCE};

/// Selection of the modes of a substructure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModeSelection {
    /// All modes.
    All,
    /// The modes of lowest frequency, as many as given.
    Lowest(usize),
    /// The modes with these indices, counted from 0 in ascending frequency.
    Indices(Vec<usize>),
}

impl ModeSelection {
    /// Indices selected out of `available` modes, ascending; `what` names the field in errors.
    ///
    /// # Errors
    /// [`ReductionError::ModeCount`] if the selection is empty, exceeds the available modes, or repeats one.
    pub fn indices(&self, what: &str, available: usize) -> Result<Vec<usize>, ReductionError> {
        let refuse =
            |value: String, limit: String| Err(ReductionError::ModeCount { what: what.to_owned(), value, limit });
        match self {
            Self::All => Ok((0..available).collect()),
            Self::Lowest(count) if *count == 0 || *count > available => {
                refuse(format!("{count} modes"), format!("1 to {available}"))
            }
            Self::Lowest(count) => Ok((0..*count).collect()),
            Self::Indices(list) => {
                let mut sorted = list.clone();
                sorted.sort_unstable();
                if sorted.is_empty() {
                    return refuse("an empty list".to_owned(), "at least one mode".to_owned());
                }
                if let Some(&beyond) = sorted.iter().find(|&&index| index >= available) {
                    return refuse(format!("mode {beyond}"), format!("0 to {}", available.saturating_sub(1)));
                }
                if let Some(pair) = sorted.windows(2).find(|pair| pair[0] == pair[1]) {
                    return refuse(format!("mode {} twice", pair[0]), "every mode at most once".to_owned());
                }
                Ok(sorted)
            }
        }
    }
}

/// Real modes in ascending order of frequency.
#[derive(Clone, Debug)]
pub struct Modes {
    /// `ω`, rad/s, one per mode; 0 for rigid-body modes.
    pub omega_rad_s: Vec<f64>,
    /// `Φ`, degrees of freedom by modes, kg^-1/2, mass-normalised: `Φᵀ M Φ = I`. The largest entry of each column is
    /// positive.
    pub phi: Mat<f64>,
}

/// Real modes of a substructure with free contact interface, `K φ = ω² M φ`.
///
/// `mass`, kg, and `stiffness`, N/m, are `n×n` and symmetric. `mass` must be positive definite and `stiffness` positive
/// semidefinite; rigid-body modes have `ω = 0`. `what` names the substructure in errors.
///
/// # Errors
/// [`ReductionError`]: `Shape`, `NotFinite`, `Unsymmetric`, `Indefinite`, `NegativeStiffness`, `ModeCount`.
pub fn free_interface_modes(
    what: &str,
    mass: MatRef<'_, f64>,
    stiffness: MatRef<'_, f64>,
    selection: &ModeSelection,
) -> Result<Modes, ReductionError> {
    let (what_mass, what_stiffness) = (format!("{what}.mass"), format!("{what}.stiffness"));
    let whitening = whiten(&what_mass, mass)?;
    let stiffness = symmetrised(&what_stiffness, stiffness)?;
    if stiffness.nrows() != mass.nrows() {
        let (rows, columns) = stiffness.shape();
        return Err(ReductionError::Shape { what: what_stiffness, rows, columns, expected: mass.nrows() });
    }
    let chosen = selection.indices(&format!("{what}.modes"), mass.nrows())?;
    let (squares, vectors) = symmetric_eigen(&what_stiffness, whitening.congruence(stiffness.as_ref(), true).as_ref())?;
    let limit = -SEMIDEFINITE_TOLERANCE * squares.iter().fold(0.0, |largest: f64, s| largest.max(s.abs()));
    if let Some((mode, &value)) = squares.iter().enumerate().find(|&(_, &s)| s < limit) {
        return Err(ReductionError::NegativeStiffness { what: what_stiffness, mode, value, limit });
    }
    let mut phi = Mat::from_fn(vectors.nrows(), chosen.len(), |row, column| vectors[(row, chosen[column])]);
    whitening.back(&mut phi);
    fix_signs(&mut phi);
    Ok(Modes { omega_rad_s: chosen.iter().map(|&mode| squares[mode].max(0.0).sqrt()).collect(), phi })
}

/// Cholesky factor `L` of a mass matrix, `M = L Lᵀ`. In the coordinates `y = Lᵀ x` the mass matrix is the identity.
#[derive(Clone, Debug)]
pub struct Whitening {
    lower: Mat<f64>,
}

/// Factorises a mass matrix, `n×n`, symmetric and positive definite; `what` names it in errors.
///
/// # Errors
/// [`ReductionError`]: `Shape`, `NotFinite`, `Unsymmetric`, `Indefinite`.
pub fn whiten(what: &str, mass: MatRef<'_, f64>) -> Result<Whitening, ReductionError> {
    let mass = symmetrised(what, mass)?;
    let indefinite = |row, value, limit| Err(ReductionError::Indefinite { what: what.to_owned(), row, value, limit });
    let factor = match mass.llt(Side::Lower) {
        Ok(factor) => factor,
        Err(faer::linalg::cholesky::llt::factor::LltError::NonPositivePivot { index }) => {
            return indefinite(index, pivot(mass.as_ref(), index), 0.0);
        }
    };
    let lower = factor.L().to_owned();
    for row in 0..mass.nrows() {
        let (value, limit) = (lower[(row, row)] * lower[(row, row)], DEFINITE_TOLERANCE * mass[(row, row)]);
        if value.is_nan() || value <= limit {
            return indefinite(row, value, limit);
        }
    }
    Ok(Whitening { lower })
}

/// Cholesky pivot of `matrix` at `row`, `m_rr - m_rᵀ M⁻¹ m_r` over the preceding rows, for an error.
fn pivot(matrix: MatRef<'_, f64>, row: usize) -> f64 {
    let mut solved = matrix.submatrix(0, row, row, 1).to_owned();
    match matrix.submatrix(0, 0, row, row).llt(Side::Lower) {
        Ok(factor) => faer::linalg::solvers::Solve::solve_in_place(&factor, solved.as_mut()),
        Err(_) => return matrix[(row, row)],
    }
    matrix[(row, row)] - (0..row).map(|k| matrix[(row, k)] * solved[(k, 0)]).sum::<f64>()
}

impl Whitening {
    /// `L⁻¹ A L⁻ᵀ`; exactly symmetric if `symmetric` states that `A` is.
    pub fn congruence(&self, matrix: MatRef<'_, f64>, symmetric: bool) -> Mat<f64> {
        let mut left = matrix.to_owned();
        solve_lower_triangular_in_place(self.lower.as_ref(), left.as_mut(), Par::Seq);
        let mut both = left.transpose().to_owned();
        solve_lower_triangular_in_place(self.lower.as_ref(), both.as_mut(), Par::Seq);
        if symmetric {
            return Mat::from_fn(both.nrows(), both.ncols(), |i, j| both[(i.max(j), i.min(j))]);
        }
        both.transpose().to_owned()
    }

    /// `X L⁻ᵀ` in place. If `L Lᵀ` is the Gram matrix of `X` in some metric, the result is orthonormal in that metric.
    pub fn right(&self, vectors: &mut Mat<f64>) {
        let mut turned = vectors.transpose().to_owned();
        solve_lower_triangular_in_place(self.lower.as_ref(), turned.as_mut(), Par::Seq);
        vectors.copy_from(turned.transpose());
    }

    /// `L⁻ᵀ Y` in place: transforms unit-mass coordinates back to degrees of freedom.
    pub fn back(&self, vectors: &mut Mat<f64>) {
        solve_upper_triangular_in_place(self.lower.transpose(), vectors.as_mut(), Par::Seq);
    }
}

/// Checks that a matrix is finite, square and symmetric, and returns the mean of both triangles.
fn symmetrised(what: &str, matrix: MatRef<'_, f64>) -> Result<Mat<f64>, ReductionError> {
    let (rows, columns) = matrix.shape();
    if rows != columns || rows == 0 {
        return Err(ReductionError::Shape { what: what.to_owned(), rows, columns, expected: rows.max(1) });
    }
    for row in 0..rows {
        for column in 0..columns {
            let value = matrix[(row, column)];
            if !value.is_finite() {
                return Err(ReductionError::NotFinite { what: what.to_owned(), row, column, value });
            }
        }
    }
    let limit = SYMMETRY_TOLERANCE * matrix.norm_max();
    for row in 0..rows {
        for column in 0..row {
            let (value, mirrored) = (matrix[(row, column)], matrix[(column, row)]);
            if (value - mirrored).abs() > limit {
                return Err(ReductionError::Unsymmetric { what: what.to_owned(), row, column, value, mirrored, limit });
            }
        }
    }
    Ok(Mat::from_fn(rows, columns, |i, j| 0.5 * (matrix[(i, j)] + matrix[(j, i)])))
}

/// Eigenvalues, ascending, and orthonormal eigenvectors of an exactly symmetric matrix; `what` names it in errors.
///
/// The matrix is first scaled to entries near 1, by a power of two, which is exact. faer 0.24 deflates with an absolute
/// tolerance near 1e-16, which would lose half the digits of a matrix with entries near 1e-6.
pub(super) fn symmetric_eigen(what: &str, matrix: MatRef<'_, f64>) -> Result<(Vec<f64>, Mat<f64>), ReductionError> {
    let failed = |reason: String| ReductionError::Factorisation { what: what.to_owned(), reason };
    let largest = matrix.norm_max();
    let scale = if largest > 0.0 { largest.log2().floor().clamp(-900.0, 900.0).exp2() } else { 1.0 };
    let scaled = Mat::from_fn(matrix.nrows(), matrix.ncols(), |i, j| matrix[(i, j)] / scale);
    let eigen = scaled
        .self_adjoint_eigen(Side::Lower)
        .map_err(|error| failed(format!("the symmetric eigenvalue iteration failed: {error:?}")))?;
    let values: Vec<f64> = eigen.S().column_vector().iter().map(|value| value * scale).collect();
    if let Some(value) = values.iter().find(|value| !value.is_finite()) {
        return Err(failed(format!("the symmetric eigenvalue iteration gave {value}")));
    }
    Ok((values, eigen.U().to_owned()))
}

/// Changes the sign of every column so that its largest entry is positive, which makes modes independent of the
/// algorithm.
pub(super) fn fix_signs(phi: &mut Mat<f64>) {
    for column in phi.col_iter_mut() {
        let mut largest = 0.0_f64;
        for &value in column.as_ref().iter() {
            // Among entries equal up to rounding, the first decides.
            if value.abs() > largest.abs() * (1.0 + 1e-9) {
                largest = value;
            }
        }
        if largest < 0.0 {
            column.iter_mut().for_each(|value| *value = -*value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chain() -> (Mat<f64>, Mat<f64>) {
        // Two masses m on a line, springs k to the walls and between: ω² = k/m, 3 k/m.
        (faer::mat![[2.0, 0.0], [0.0, 2.0]], faer::mat![[4.0, -2.0], [-2.0, 4.0]])
    }

    #[test]
    fn two_masses_and_three_springs() {
        let (mass, stiffness) = chain();
        let modes = free_interface_modes("pad", mass.as_ref(), stiffness.as_ref(), &ModeSelection::All).unwrap();
        assert!((modes.omega_rad_s[0] - 1.0).abs() < 1e-15);
        assert!((modes.omega_rad_s[1] - 3.0_f64.sqrt()).abs() < 1e-15);
        assert!((modes.phi.transpose() * &mass * &modes.phi - Mat::<f64>::identity(2, 2)).norm_max() < 1e-15);
        // The first mode is in phase.
        assert!((modes.phi[(0, 0)] - 0.5).abs() < 1e-15 && (modes.phi[(1, 0)] - 0.5).abs() < 1e-15);
    }

    #[test]
    fn a_free_body_has_frequency_zero_to_rounding() {
        let mass = faer::mat![[0.3, 0.0, 0.0], [0.0, 0.7, 0.0], [0.0, 0.0, 1.1]];
        let stiffness = faer::mat![[1e9, -1e9, 0.0], [-1e9, 3e9, -2e9], [0.0, -2e9, 2e9]];
        let modes = free_interface_modes("pad", mass.as_ref(), stiffness.as_ref(), &ModeSelection::All).unwrap();
        // Rounding errors of ω² are below n ε times the largest ω²: 2.6e-8 of the largest ω for n = 3.
        assert!(modes.omega_rad_s[0] < (3.0 * f64::EPSILON).sqrt() * modes.omega_rad_s[2], "{:?}", modes.omega_rad_s);
    }

    #[test]
    fn each_kind_of_bad_matrix_has_its_error() {
        let (mass, stiffness) = chain();
        let modes = |m: &Mat<f64>, k: &Mat<f64>| {
            free_interface_modes("pad", m.as_ref(), k.as_ref(), &ModeSelection::All).unwrap_err()
        };
        let indefinite = modes(&faer::mat![[1.0, 2.0], [2.0, 1.0]], &stiffness);
        assert_eq!(indefinite, ReductionError::Indefinite { what: "pad.mass".into(), row: 1, value: -3.0, limit: 0.0 });
        assert!(matches!(
            modes(&faer::mat![[1.0, 0.5], [0.25, 1.0]], &stiffness),
            ReductionError::Unsymmetric { row: 1, column: 0, value: 0.25, mirrored: 0.5, .. }
        ));
        assert!(matches!(
            modes(&mass, &faer::mat![[1.0, 0.0], [0.0, -4.0]]),
            ReductionError::NegativeStiffness { mode: 0, value, .. } if (value + 2.0).abs() < 1e-14
        ));
        assert!(matches!(
            modes(&mass, &faer::mat![[1.0, 0.0], [1.0, 4.0]]),
            ReductionError::Unsymmetric { what, .. } if what == "pad.stiffness"
        ));
        assert!(matches!(modes(&mass, &faer::mat![[1.0]]), ReductionError::Shape { rows: 1, expected: 2, .. }));
        assert!(matches!(
            modes(&faer::mat![[f64::NAN, 0.0], [0.0, 1.0]], &stiffness),
            ReductionError::NotFinite { row: 0, column: 0, .. }
        ));
    }

    #[test]
    fn selections_are_checked() {
        assert_eq!(ModeSelection::Indices(vec![2, 0]).indices("pad.modes", 3).unwrap(), [0, 2]);
        for (selection, expected) in [
            (ModeSelection::Lowest(0), "pad.modes: 0 modes requested, expected 1 to 3"),
            (ModeSelection::Lowest(4), "pad.modes: 4 modes requested, expected 1 to 3"),
            (ModeSelection::Indices(vec![]), "pad.modes: an empty list requested, expected at least one mode"),
            (ModeSelection::Indices(vec![3]), "pad.modes: mode 3 requested, expected 0 to 2"),
            (ModeSelection::Indices(vec![1, 1]), "pad.modes: mode 1 twice requested, expected every mode at most once"),
        ] {
            assert_eq!(selection.indices("pad.modes", 3).unwrap_err().to_string(), expected);
        }
    }

    #[test]
    fn whitening_keeps_symmetry_exactly_and_the_spectrum() {
        let mass = faer::mat![[4.0, 1.0, 0.3], [1.0, 3.0, 0.2], [0.3, 0.2, 2.0]];
        let symmetric = faer::mat![[2.0, -1.0, 0.1], [-1.0, 2.5, 0.7], [0.1, 0.7, 1.9]];
        let whitening = whiten("system.mass", mass.as_ref()).unwrap();
        let white = whitening.congruence(symmetric.as_ref(), true);
        assert_eq!(white, white.transpose().to_owned());
        let general = whitening.congruence(symmetric.as_ref(), false);
        assert!((&general - &white).norm_max() < 1e-15);
        // det(L⁻¹ A L⁻ᵀ) = det A / det M.
        let expected = symmetric.determinant() / mass.determinant();
        assert!((white.determinant() / expected - 1.0).abs() < 1e-13);
    }
}
