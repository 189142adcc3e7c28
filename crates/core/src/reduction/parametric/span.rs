//! The span of eigenvectors of the full model, scaled by what they are worth for its roots.

use faer::{Mat, MatRef, c64};

use super::super::dense::symmetric_eigen;
use super::super::full_model::FullModel;
use super::super::{FullSpectrum, ReductionError, whiten};
use super::condition::Condition;
use super::metric::Metric;

/// Components of a vector below this, relative to its length, are rounding errors: the square root of the resolution of
/// a Gram matrix.
const ROUNDED: f64 = 1e-7;

/// A growing basis of right and left eigenvectors.
pub struct Span<'a> {
    full: &'a FullModel,
    pub metric: Metric<'a>,
    /// `S`-orthonormal vectors, `n×r`.
    pub vectors: Mat<f64>,
}

impl<'a> Span<'a> {
    /// A span without vectors.
    pub fn new(full: &'a FullModel, metric: Metric<'a>) -> Self {
        Self { full, metric, vectors: Mat::zeros(full.dimension(), 0) }
    }

    /// Number of vectors.
    pub fn size(&self) -> usize {
        self.vectors.ncols()
    }

    /// Number of columns of length `n` that memory holds while `added` columns are added, the span included: the span
    /// grows by reallocation, and the new columns take five copies.
    pub fn columns_held(&self, added: usize) -> usize {
        2 * (self.size() + added) + 5 * added
    }

    /// Adds the components outside the span of right and left vectors of the `chosen` roots. Without a component of length
    /// `d` in both, a root is off by about `d²`, relative to itself; components below `least` are left out.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`].
    pub fn add(&mut self, spectrum: FullSpectrum, chosen: &[usize], least: f64) -> Result<(), ReductionError> {
        let mut rest = self.scaled(&spectrum, chosen);
        drop(spectrum);
        for _ in 0..2 {
            let step = self.vectors.transpose() * self.metric.times(rest.as_ref());
            rest -= &self.vectors * &step;
        }
        let gram = self.metric.gram(&rest);
        let (squares, vectors) = symmetric_eigen("basis", gram.as_ref())?;
        let least = least.max(ROUNDED);
        let kept: Vec<usize> = (0..squares.len()).rev().filter(|&k| squares[k] > least * least).collect();
        if kept.is_empty() {
            return Ok(());
        }
        let turn = Mat::from_fn(vectors.nrows(), kept.len(), |i, k| vectors[(i, kept[k])] / squares[kept[k]].sqrt());
        let mut added = &rest * &turn;
        drop(rest);
        // The Gram matrix leaves rounding errors of orthogonality; two passes remove them.
        for _ in 0..2 {
            let step = self.vectors.transpose() * self.metric.times(added.as_ref());
            added -= &self.vectors * &step;
            let gram = self.metric.gram(&added);
            whiten("basis", gram.as_ref())?.right(&mut added);
        }
        let before = std::mem::replace(&mut self.vectors, Mat::new());
        self.vectors = hstack(before.as_ref(), added.as_ref());
        Ok(())
    }

    /// Real and imaginary parts of right and left vectors with their [`Condition::scales`], `n×(4·chosen)`.
    fn scaled(&self, spectrum: &FullSpectrum, chosen: &[usize]) -> Mat<f64> {
        let n = self.full.dimension();
        let mut columns = Mat::<f64>::zeros(n, 4 * chosen.len());
        for (k, &root) in chosen.iter().enumerate() {
            let lambda = spectrum.roots[root].lambda;
            // Real and imaginary parts of x, then of y.
            let of_root = Mat::<f64>::from_fn(n, 4, |i, j| {
                let value = if j < 2 { spectrum.right[(i, root)] } else { spectrum.left[(i, root)] };
                if j % 2 == 0 { value.re } else { value.im }
            });
            let of_mass = self.full.mass_times(of_root.as_ref());
            let of_damping = self.full.damping_times(&spectrum.here, of_root.as_ref(), false);
            let at = |m: &Mat<f64>, i: usize, side: usize| c64::new(m[(i, 2 * side)], m[(i, 2 * side + 1)]);
            let slope: c64 = (0..n)
                .map(|i| at(&of_root, i, 1).conj() * (lambda * 2.0 * at(&of_mass, i, 0) + at(&of_damping, i, 0)))
                .sum();
            let length = |side: usize| -> f64 {
                (0..n).map(|i| (at(&of_root, i, side).conj() * at(&of_mass, i, side)).re).sum::<f64>().sqrt()
            };
            let lengths = [length(0), length(1)];
            for (side, scale) in Condition::new(lambda, lengths, slope).scales().into_iter().enumerate() {
                let scaled = faer::Scale(scale) * of_root.subcols(2 * side, 2);
                // A left vector of a dense solve is not finite where `yᴴ x` is exactly zero.
                if scaled.is_all_finite() {
                    columns.subcols_mut(4 * k + 2 * side, 2).copy_from(scaled);
                }
            }
        }
        columns
    }
}

/// `[a b]`.
fn hstack(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Mat<f64> {
    let mut both = Mat::zeros(a.nrows(), a.ncols() + b.ncols());
    both.subcols_mut(0, a.ncols()).copy_from(a);
    both.subcols_mut(a.ncols(), b.ncols()).copy_from(b);
    both
}

#[cfg(test)]
mod tests {
    use super::super::super::test_models::chains;
    use super::*;
    use crate::physics::{ContactLaw, OperatingPoint};
    use crate::reduction::{FullSolver, FullVectors};

    /// A left vector that is not finite is left out; the others are added.
    #[test]
    fn a_vector_that_is_not_finite_is_left_out() {
        let full = chains(5.0, ContactLaw::default());
        let point = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 7.0, friction_coefficient: 0.4 };
        let mut solver = FullSolver::new("chains", &full, None, &mut |_| {}).unwrap();
        let mut found = solver.roots(&point, 900.0, FullVectors::Both, &mut |_| {}).unwrap();
        found.left.col_mut(2).fill(c64::new(f64::NAN, f64::NAN));
        let metric = Metric::new(&full, full.at(&point).unwrap(), 900.0);
        let mut span = Span::new(&full, metric);
        let chosen: Vec<usize> = (0..found.roots.len()).collect();
        span.add(found, &chosen, 1e-5).unwrap();
        assert!(span.size() > chosen.len() && span.vectors.is_all_finite());
        let gram = span.metric.gram(&span.vectors);
        assert!((gram - Mat::<f64>::identity(span.size(), span.size())).norm_max() < 1e-10);
    }
}
