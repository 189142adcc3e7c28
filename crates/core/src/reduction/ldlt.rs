//! The factor `P A Pᵀ = L D Lᵀ` of a matrix on the pattern of a pencil, kept in double or in single precision.

use std::sync::Arc;

use faer::sparse::linalg::cholesky::SymbolicCholesky;
use faer::{Mat, MatMut, MatRef};

use super::ReductionError;
use super::elimination_tree::Tree;
use super::fronts::Fronts;
use super::pencil::{Pencil, forward, supernodal};
use super::precision::{Precision, Real, Values};
use super::triangle::Triangle;

impl Pencil<'_> {
    /// The factor `L D Lᵀ` of a matrix on the pattern of the pencil, not probed.
    pub(super) fn factored(&self, fronts: &Fronts<'_>, precision: Precision) -> Result<Ldlt, ReductionError> {
        let mut values = Values::zeros(self.factor_entries(), precision).ok_or_else(|| self.no_memory())?;
        fronts.ldlt(&mut values).map_err(|_| self.broken())?;
        #[cfg(test)]
        if crate::spoil::spoilt(crate::spoil::Spoil::Factor) {
            match &mut values {
                Values::Double(values) => values[1] *= 1.0 + 1e-6,
                // Refinement mends small errors.
                Values::Single(values) => values[1] *= 1e6,
            }
        }
        Ok(Ldlt { symbolic: self.symbolic.clone(), tree: self.tree.clone(), values })
    }
}

/// The factor `P A Pᵀ = L D Lᵀ`; vectors are in the order of elimination.
pub(super) struct Ldlt {
    symbolic: Arc<SymbolicCholesky<usize>>,
    tree: Arc<Tree>,
    values: Values,
}

impl Ldlt {
    /// The row eliminated at each position of the elimination order.
    pub(super) fn order(&self) -> &[usize] {
        forward(&self.symbolic)
    }

    /// The pivots, the diagonal of `D`.
    pub(super) fn pivots(&self) -> Vec<f64> {
        match &self.values {
            Values::Double(values) => self.triangle(values).diagonal(),
            Values::Single(values) => self.triangle(values).diagonal(),
        }
    }

    /// Trailing block of `L` for the `count` rows eliminated last, dense.
    pub(super) fn trailing(&self, count: usize) -> Mat<f64> {
        match &self.values {
            Values::Double(values) => self.triangle(values).trailing(count),
            Values::Single(values) => self.triangle(values).trailing(count),
        }
    }

    /// `L⁻¹ Z` in place.
    pub(super) fn forward(&self, z: MatMut<'_, f64>) {
        match &self.values {
            Values::Double(values) => self.triangle(values).forward(z),
            Values::Single(values) => in_single(z, |z| self.triangle(values).forward(z)),
        }
    }

    /// `L⁻ᵀ Z` in place.
    pub(super) fn backward(&self, z: MatMut<'_, f64>) {
        match &self.values {
            Values::Double(values) => self.triangle(values).backward(z),
            Values::Single(values) => in_single(z, |z| self.triangle(values).backward(z)),
        }
    }

    /// `A⁻¹ B` as exactly as the factor is kept.
    pub(super) fn solve(&self, b: MatRef<'_, f64>) -> Mat<f64> {
        let (order, pivots) = (self.order(), self.pivots());
        let mut z = Mat::from_fn(b.nrows(), b.ncols(), |i, j| b[(order[i], j)]);
        self.forward(z.as_mut());
        z.col_iter_mut().for_each(|column| column.iter_mut().zip(&pivots).for_each(|(value, pivot)| *value /= pivot));
        self.backward(z.as_mut());
        let mut x = Mat::zeros(b.nrows(), b.ncols());
        for j in 0..b.ncols() {
            order.iter().enumerate().for_each(|(position, &row)| x[(row, j)] = z[(position, j)]);
        }
        x
    }

    /// `L`, to solve with.
    fn triangle<'t, T: Real>(&'t self, values: &'t [T]) -> Triangle<'t, T> {
        Triangle { supernodes: supernodal(&self.symbolic), tree: &self.tree, values, unit: true }
    }
}

/// Calls `solve` with the columns of `z` in single precision, each scaled to a largest entry of 1: the numbers of a small
/// residual would be lost below the smallest of that precision.
fn in_single(mut z: MatMut<'_, f64>, solve: impl FnOnce(MatMut<'_, f32>)) {
    let sizes: Vec<f64> = z.as_ref().col_iter().map(|column| column.norm_max().max(f64::MIN_POSITIVE)).collect();
    let mut single = Mat::from_fn(z.nrows(), z.ncols(), |i, j| (z[(i, j)] / sizes[j]) as f32);
    solve(single.as_mut());
    for (j, size) in sizes.iter().enumerate() {
        z.as_mut()
            .col_mut(j)
            .iter_mut()
            .zip(single.col_as_slice(j))
            .for_each(|(to, value)| *to = size * value.double());
    }
}

#[cfg(test)]
mod tests {
    use super::super::fronts::tests::cube;
    use super::*;

    /// Numbers below the smallest of single precision, 1e-45, are solved for like others: powers of two scale exactly.
    #[test]
    fn small_right_sides_keep_their_digits_in_single_precision() {
        let [mass, stiffness] = cube(6);
        let n = mass.nrows();
        let pencil = Pencil::new("cube", &mass, &stiffness).unwrap();
        let ldlt = pencil.ldlt(3.0, Precision::Single).unwrap();
        // The first column is 0.
        let b = Mat::from_fn(n, 2, |i, j| j as f64 * (i as f64).sin());
        let small = 2.0_f64.powi(-200);
        let [of_small, of_all] = [small, 1.0].map(|scale| ldlt.solve((faer::Scale(scale) * &b).as_ref()));
        assert!(of_all.norm_max() > 0.0);
        assert_eq!(of_small, faer::Scale(small) * of_all);
    }
}
