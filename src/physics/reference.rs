//! Roots to about thirty digits, to measure the others against: Newton's method from a dense root, residuals in
//! double-double arithmetic (Dekker 1971; Wilkinson 1963 for the refinement).

use faer::linalg::solvers::Solve;
use faer::{Mat, MatRef, c64};

/// An unevaluated sum `high + low` of two numbers.
#[derive(Clone, Copy, Debug, Default)]
struct Double {
    high: f64,
    low: f64,
}

impl Double {
    fn sum(a: f64, b: f64) -> Self {
        let high = a + b;
        let part = high - a;
        Self { high, low: (a - (high - part)) + (b - part) }
    }

    fn product(a: f64, b: f64) -> Self {
        let high = a * b;
        Self { high, low: a.mul_add(b, -high) }
    }

    fn plus(self, other: Self) -> Self {
        let sum = Self::sum(self.high, other.high);
        let low = Self::sum(self.low, other.low);
        let first = Self::sum(sum.high, sum.low + low.high);
        Self::sum(first.high, first.low + low.low)
    }

    fn times(self, other: Self) -> Self {
        let product = Self::product(self.high, other.high);
        Self::sum(product.high, product.low + self.high * other.low + self.low * other.high)
    }

    fn minus(self, other: Self) -> Self {
        self.plus(Self { high: -other.high, low: -other.low })
    }

    fn from(value: f64) -> Self {
        Self { high: value, low: 0.0 }
    }
}

/// A complex number of doubled precision.
#[derive(Clone, Copy, Debug, Default)]
struct Complex {
    re: Double,
    im: Double,
}

impl Complex {
    fn from(value: c64) -> Self {
        Self { re: Double::from(value.re), im: Double::from(value.im) }
    }

    fn plus(self, other: Self) -> Self {
        Self { re: self.re.plus(other.re), im: self.im.plus(other.im) }
    }

    fn times(self, other: Self) -> Self {
        Self {
            re: self.re.times(other.re).minus(self.im.times(other.im)),
            im: self.re.times(other.im).plus(self.im.times(other.re)),
        }
    }

    fn scaled(self, factor: f64) -> Self {
        let factor = Double::from(factor);
        Self { re: self.re.times(factor), im: self.im.times(factor) }
    }

    fn rounded(self) -> c64 {
        c64::new(self.re.high + self.re.low, self.im.high + self.im.low)
    }
}

/// What a root is compared in: the number that was solved for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unknown {
    /// `z = λ²` of `(z I + K) x = 0`.
    Square,
    /// `λ` of `(λ² I + λ C + K) x = 0`.
    Root,
}

/// The exact root of `K` (and `C`) near `z` with shape near `x`, less `z`: the error of `z`, to about ten digits.
/// `None` where Newton's method does not converge, as at a merging point.
pub fn error_of(
    unknown: Unknown,
    stiffness: MatRef<'_, f64>,
    damping: MatRef<'_, f64>,
    z: c64,
    x: &[c64],
) -> Option<c64> {
    let n = x.len();
    // The largest entry is held at 1.
    let fixed = (0..n).max_by(|&a, &b| x[a].norm().total_cmp(&x[b].norm()))?;
    let mut shape: Vec<Complex> = x.iter().map(|&entry| Complex::from(entry / x[fixed])).collect();
    let mut root = Complex::from(z);
    let mut last = f64::INFINITY;
    for _ in 0..12 {
        let (residual, slope) = residual(unknown, stiffness, damping, root, &shape);
        let at = root.rounded();
        let jacobian = Mat::<c64>::from_fn(n, n, |i, j| {
            if j == fixed {
                return slope[i];
            }
            let (k, c) = (stiffness[(i, j)], damping[(i, j)]);
            let diagonal = if i == j { if unknown == Unknown::Square { at } else { at * at } } else { c64::ZERO };
            diagonal + k + if unknown == Unknown::Square { c64::ZERO } else { at * c }
        });
        let right = Mat::<c64>::from_fn(n, 1, |i, _| -residual[i]);
        let step = jacobian.partial_piv_lu().solve(&right);
        for j in 0..n {
            let correction = Complex::from(step[(j, 0)]);
            if j == fixed {
                root = root.plus(correction);
            } else {
                shape[j] = shape[j].plus(correction);
            }
        }
        let size = step[(fixed, 0)].norm();
        if !size.is_finite() {
            return None;
        }
        if size <= 1e-24 * at.norm() || (size >= 0.1 * last && size <= 1e-20 * at.norm()) {
            return Some(root.plus(Complex::from(-z)).rounded());
        }
        last = size;
    }
    None
}

/// `P(z) x` and `P'(z) x`.
fn residual(
    unknown: Unknown,
    stiffness: MatRef<'_, f64>,
    damping: MatRef<'_, f64>,
    z: Complex,
    x: &[Complex],
) -> (Vec<c64>, Vec<c64>) {
    let n = x.len();
    let factor = if unknown == Unknown::Square { z } else { z.times(z) };
    let (mut value, mut slope) = (Vec::with_capacity(n), Vec::with_capacity(n));
    for i in 0..n {
        let mut kx = Complex::default();
        let mut cx = Complex::default();
        for (j, &entry) in x.iter().enumerate() {
            kx = kx.plus(entry.scaled(stiffness[(i, j)]));
            if unknown == Unknown::Root {
                cx = cx.plus(entry.scaled(damping[(i, j)]));
            }
        }
        let sum = kx.plus(factor.times(x[i]));
        if unknown == Unknown::Square {
            value.push(sum.rounded());
            slope.push(x[i].rounded());
        } else {
            value.push(sum.plus(z.times(cx)).rounded());
            slope.push(z.times(x[i]).scaled(2.0).plus(cx).rounded());
        }
    }
    (value, slope)
}

#[cfg(test)]
mod tests {
    use faer::mat;

    use super::super::model::ContactLaw;
    use super::super::spectrum::{Solver, Vectors};
    use super::super::synthetic::{Synthetic, rig};
    use super::super::test_models::{REFERENCE, random_rig};
    use super::*;

    /// `√2` to thirty digits: the error of the nearest double is known.
    #[test]
    fn finds_what_a_double_lacks() {
        let stiffness = mat![[0.0, -2.0], [-1.0, 0.0]]; // its eigenvalue √2 has the vector (-√2, 1)
        let none = Mat::zeros(2, 2);
        let z = c64::new(-std::f64::consts::SQRT_2, 0.0);
        let x = [c64::new(-std::f64::consts::SQRT_2, 0.0), c64::new(1.0, 0.0)];
        let error = error_of(Unknown::Square, stiffness.as_ref(), none.as_ref(), z, &x).expect("it converges");
        // √2 = 1.4142135623730950488016887242097, its double is 1.4142135623730951454746218587388.
        assert!((error.re - 9.667_293_313_452_91e-17).abs() < 1e-26, "{error}");
    }

    /// Every root of random and of synthetic rigs, undamped and damped, is within its bound of the root to thirty digits;
    /// and the bounds are not idle: most are within a few thousand of the error.
    #[test]
    fn dense_roots_are_within_their_bounds() {
        let mut ratios = vec![];
        for seed in 0..36 {
            let damping = [0.0, 1e-3, 3e-2][seed as usize % 3];
            let model = if seed < 24 {
                random_rig(seed, 6 + seed as usize % 5, 3, damping)
            } else {
                let contact_law = ContactLaw::default();
                rig(&Synthetic { modes: 20, pairs: 12, damping_ratio: damping, contact_law, seed }).unwrap()
            };
            let n = model.dimension();
            let (mut k, mut c) = (Mat::zeros(n, n), Mat::zeros(n, n));
            for step in 0..8 {
                let p = REFERENCE.with_friction(0.13 * f64::from(step));
                let structure = model.assemble(&p, &mut k, &mut c).unwrap();
                let unknown = if structure.damped { Unknown::Root } else { Unknown::Square };
                let spectrum = Solver::new(n).solve(&model, &p, Vectors::Both).unwrap();
                for (j, root) in spectrum.modes().iter().enumerate() {
                    let shape: Vec<c64> = (0..n).map(|i| spectrum.shapes[(i, j)]).collect();
                    let z = if structure.damped { root.lambda } else { root.square };
                    let Some(error) = error_of(unknown, k.as_ref(), c.as_ref(), z, &shape) else { continue };
                    let (error, bound) = if structure.damped {
                        (error.norm(), root.error.omega)
                    } else {
                        (error.norm(), root.error.square)
                    };
                    assert!(error <= bound, "seed {seed}, {p:?}, root {j}: off by {error:e}, bound {bound:e}");
                    ratios.push(bound / error.max(1e-3 * bound * f64::EPSILON));
                }
            }
        }
        ratios.sort_by(f64::total_cmp);
        assert!(ratios.len() > 2000, "{} roots were compared", ratios.len());
        assert!(ratios[ratios.len() / 2] < 5e3, "the median bound is {} times the error", ratios[ratios.len() / 2]);
    }
}
