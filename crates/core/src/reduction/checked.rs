//! Checks of what a foreign engine gives: solves by their residuals, modes by their products `Φᵀ M Φ`. The residuals and
//! the number of modes are checked for every engine (`normal_modes`), as are the residuals of roots (`full_problem`).

use faer::Mat;

use super::ReductionError;
use super::engine::{Eigenpairs, Engine, Factor};
use super::pencil::Pencil;
use super::sparse::{one_norm, symmetric_times};

/// Largest `|A x - b|` of a solve, relative to `|A| |x| + |b|`.
const SOLVE_LIMIT: f64 = 1e-13;
/// Largest entry of `Φᵀ M Φ - I`. An error of it enters residual flexibility multiplied by the residual of a mode.
const ORTHOGONAL: f64 = 1e-8;

/// The factor of `K + s M` by `engine`; its solves are checked if the engine is foreign.
///
/// # Errors
/// As [`Engine::definite`].
pub(super) fn definite<'a>(
    engine: &'a dyn Engine,
    pencil: &'a Pencil<'_>,
    shift: f64,
) -> Result<Option<Box<dyn Factor<f64> + 'a>>, ReductionError> {
    let factor = engine.definite(pencil, shift)?;
    if !engine.foreign() {
        return Ok(factor);
    }
    let norm = one_norm(pencil.stiffness) + shift.abs() * one_norm(pencil.mass);
    Ok(factor.map(|factor| Box::new(Checked { factor, pencil, shift, norm }) as Box<dyn Factor<f64>>))
}

/// A factor of `A = K + s M` whose solves are checked.
struct Checked<'a> {
    factor: Box<dyn Factor<f64> + 'a>,
    pencil: &'a Pencil<'a>,
    shift: f64,
    /// `|A|`.
    norm: f64,
}

impl Factor<f64> for Checked<'_> {
    fn solve(&self, rhs: &mut Mat<f64>, transposed: bool) -> Result<(), ReductionError> {
        let b = rhs.clone();
        self.factor.solve(rhs, transposed)?;
        let r = self.pencil.shifted_times(self.shift, rhs.as_ref()) - &b;
        for column in 0..b.ncols() {
            let parts = self.norm * rhs.col(column).norm_l2() + b.col(column).norm_l2();
            let value = r.col(column).norm_l2() / parts.max(f64::MIN_POSITIVE);
            if value.is_nan() || value > SOLVE_LIMIT {
                let reason = format!("a solve leaves |A x - b| = {value:.3e} of its parts, limit {SOLVE_LIMIT:.1e}");
                return Err(ReductionError::Engine { what: self.pencil.what.to_owned(), reason });
            }
        }
        Ok(())
    }
}

impl Eigenpairs<'_> {
    /// Checks that there are at least `count` pairs, in ascending order, whose vectors are orthonormal in `M`: a pair
    /// that is listed twice would stand for one that is missing.
    ///
    /// # Errors
    /// [`ReductionError::Engine`].
    pub(super) fn check(&self, pencil: &Pencil<'_>, count: usize) -> Result<(), ReductionError> {
        let found = self.omega_squared.len();
        let wrong = |reason: String| Err(ReductionError::Engine { what: pencil.what.to_owned(), reason });
        if found < count || self.phi.shape() != (pencil.dimension(), found) {
            let (rows, columns) = self.phi.shape();
            return wrong(format!(
                "{found} modes with vectors {rows}x{columns} came back, expected at least {count} of {} rows",
                pencil.dimension()
            ));
        }
        // Written so that NaN is refused.
        if !self.omega_squared.is_sorted() || !self.omega_squared.iter().all(|square| square.is_finite()) {
            return wrong("the squares of the frequencies that came back do not ascend".to_owned());
        }
        let gram = self.phi.transpose() * symmetric_times(pencil.mass, self.phi.as_ref());
        let off = (gram - Mat::<f64>::identity(found, found)).norm_max();
        if off.is_nan() || off > ORTHOGONAL {
            return wrong(format!(
                "products of modes with the mass matrix are off by {off:.3e}, limit {ORTHOGONAL:.1e}"
            ));
        }
        Ok(())
    }
}
