//! Reference roots to about thirty digits, against which the dense roots are checked. They are obtained from the
//! dense roots by series and iterations in double-double arithmetic (Dekker 1971; Wilkinson 1963 for iterative
//! refinement).
//!
//! Roots that rounding does not separate are refined together. Let `A(z) = z I + K` or `z² I + z C + K`, `m` the mean
//! of `k` roots and `W` an orthonormal basis of their shapes:
//!
//! ```text
//! [ A(z)  s W ] [ X(z) ]   [ 0 ]
//! [ Wᴴ     0  ] [ F(z) ] = [ I ],     det F(z) = 0 at the roots,
//! ```
//!
//! The bordered matrix is regular near these roots, even where they merge. The Taylor series of `F` about `m`
//! therefore converges like the ratio of the distance to these roots and the distance to the next one (Beyn and
//! Thümmler 2009 for the bordering).

use faer::linalg::solvers::Solve;
use faer::{Mat, MatRef, c64};

use super::synthetic::Uniform;
use crate::physics::Spectrum;

/// An unevaluated sum `high + low` of two floating-point numbers.
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

/// A complex number in double-double precision.
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

    fn minus(self, other: Self) -> Self {
        Self { re: self.re.minus(other.re), im: self.im.minus(other.im) }
    }

    fn scaled(self, factor: f64) -> Self {
        let factor = Double::from(factor);
        Self { re: self.re.times(factor), im: self.im.times(factor) }
    }

    /// `1 / self`, by one Newton step from the inverse in double precision.
    fn inverse(self) -> Self {
        let guess = Self::from(self.rounded().inv());
        guess.times(Self::from(c64::new(2.0, 0.0)).minus(self.times(guess)))
    }

    fn rounded(self) -> c64 {
        c64::new(self.re.high + self.re.low, self.im.high + self.im.low)
    }
}

/// A root, or several that rounding does not separate, with the errors of the dense values.
#[derive(Clone, Debug)]
pub struct Refined {
    /// Indices of the roots in the spectrum.
    pub members: Vec<usize>,
    /// Exact minus dense value of each root: of `λ²` for an undamped model, of `λ` for a damped one.
    pub errors: Vec<c64>,
    /// Exact minus dense value of their mean.
    pub mean_error: c64,
    /// Discriminant of a pair, `((z₁ - z₂)/2)²`; 0 for any other number of roots.
    pub discriminant: c64,
}

/// Maximum number of roots refined together.
pub const MAX_TOGETHER: usize = 4;
/// Roots closer than this many times their bounds are refined together.
const APART: f64 = 100.0;
/// Roots closer than this, relative, are refined together too: the bordered matrix of one of them would be almost
/// singular.
const CLOSE: f64 = 1e-9;

/// Groups the modes of `spectrum` that their bounds do not clearly separate.
pub fn clusters(spectrum: &Spectrum) -> Vec<Vec<usize>> {
    let mut clusters: Vec<Vec<usize>> = vec![];
    for k in 0..spectrum.mode_count {
        let near = |&j: &usize| {
            let gap = (solved_for(spectrum, j) - solved_for(spectrum, k)).norm();
            gap <= (APART * bound(spectrum, j).max(bound(spectrum, k))).max(CLOSE * solved_for(spectrum, k).norm())
        };
        let (with, mut without): (Vec<_>, Vec<_>) =
            clusters.into_iter().partition(|cluster: &Vec<usize>| cluster.iter().any(near));
        let mut joined: Vec<usize> = with.concat();
        joined.push(k);
        without.push(joined);
        clusters = without;
    }
    clusters
}

/// The eigenvalue that was computed: `λ²` of an undamped model, `λ` of a damped one.
pub fn solved_for(spectrum: &Spectrum, k: usize) -> c64 {
    if spectrum.undamped { spectrum.roots[k].square } else { spectrum.roots[k].lambda }
}

/// Bound of the error of that eigenvalue.
pub fn bound(spectrum: &Spectrum, k: usize) -> f64 {
    if spectrum.undamped { spectrum.roots[k].error.square } else { spectrum.roots[k].error.omega }
}

/// Errors of the roots `members` of `spectrum`, to about ten digits, relative to the exact roots of `K` and `C`, both
/// `n×n`. `None` if the iteration fails.
pub fn refine(
    stiffness: MatRef<'_, f64>,
    damping: MatRef<'_, f64>,
    spectrum: &Spectrum,
    members: &[usize],
) -> Option<Refined> {
    let k = members.len();
    if k == 0 || k > MAX_TOGETHER {
        return None;
    }
    let values: Vec<c64> = members.iter().map(|&j| solved_for(spectrum, j)).collect();
    let mean = values.iter().sum::<c64>() / k as f64;
    let pencil = Pencil { stiffness, damping, undamped: spectrum.undamped, at: Complex::from(mean) };
    let basis = orthonormal(spectrum, members);
    let series = pencil.series(&basis, 4 * k - 1)?;
    let polynomial = determinant(&series);
    let given: Vec<Complex> = values.iter().map(|&z| Complex::from(z).minus(pencil.at)).collect();
    let exact = matched(&given, roots_near(&polynomial, &given)?);
    let errors: Vec<Complex> = exact.iter().zip(&given).map(|(exact, given)| exact.minus(*given)).collect();
    let sum = errors.iter().fold(Complex::default(), |sum, &error| sum.plus(error));
    let discriminant = match exact.as_slice() {
        &[a, b] => {
            let half = a.minus(b).scaled(0.5);
            half.times(half).rounded()
        }
        _ => c64::ZERO,
    };
    Some(Refined {
        members: members.to_vec(),
        errors: errors.into_iter().map(Complex::rounded).collect(),
        mean_error: sum.rounded() / k as f64,
        discriminant,
    })
}

/// The matrix function `A(z)` near the point `at`.
struct Pencil<'a> {
    stiffness: MatRef<'a, f64>,
    damping: MatRef<'a, f64>,
    undamped: bool,
    at: Complex,
}

/// A column vector in double-double precision.
type Vector = Vec<Complex>;

impl Pencil<'_> {
    /// `A x₀ + A' x₁ + ½A'' x₂`, with `A` and its derivatives at the point.
    fn apply(&self, x0: &[Complex], x1: Option<&Vector>, x2: Option<&Vector>) -> Vector {
        let n = x0.len();
        // `C` multiplies `z x₀ + x₁`; the mass contributes `z (z x₀ + x₁) + z x₁ + x₂`.
        let shifted = |i: usize| self.at.times(x0[i]).plus(x1.map_or(Complex::default(), |x| x[i]));
        let velocity: Vector = (0..n).map(shifted).collect();
        let mut out: Vector = if self.undamped {
            velocity.clone()
        } else {
            let rest = |i: usize| {
                let first = x1.map_or(Complex::default(), |x| self.at.times(x[i]));
                first.plus(x2.map_or(Complex::default(), |x| x[i]))
            };
            (0..n).map(|i| self.at.times(velocity[i]).plus(rest(i))).collect()
        };
        for j in 0..n {
            let (stiffness, damping) = (self.stiffness.col(j), self.damping.col(j));
            for (i, out) in out.iter_mut().enumerate() {
                *out = out.plus(x0[j].scaled(stiffness[i]));
                if !self.undamped && damping[i] != 0.0 {
                    *out = out.plus(velocity[j].scaled(damping[i]));
                }
            }
        }
        out
    }

    /// Taylor coefficients of `F` up to `degree`; each is `k×k`, stored row by row.
    fn series(&self, basis: &[Vec<c64>], degree: usize) -> Option<Vec<Vec<Complex>>> {
        let (n, k) = (self.stiffness.nrows(), basis.len());
        let at = self.at.rounded();
        let scale = self.stiffness.norm_l2();
        let bordered = Mat::<c64>::from_fn(n + k, n + k, |i, j| match (i < n, j < n) {
            (true, true) => {
                let mass = if self.undamped { at } else { at * at };
                let rest = if self.undamped { c64::ZERO } else { at * self.damping[(i, j)] };
                rest + self.stiffness[(i, j)] + if i == j { mass } else { c64::ZERO }
            }
            (true, false) => basis[j - n][i] * scale,
            (false, true) => basis[i - n][j].conj() * scale,
            (false, false) => c64::ZERO,
        });
        let factor = bordered.partial_piv_lu();
        let mut series: Vec<Vec<Complex>> = vec![];
        let (mut before, mut last): (Vec<Vector>, Vec<Vector>) = (vec![], vec![]);
        for order in 0..=degree {
            let mut coefficient = vec![Complex::default(); k * k];
            let mut columns = vec![];
            for column in 0..k {
                let mut x = vec![Complex::default(); n];
                let mut f = vec![Complex::default(); k];
                let mut previous = f64::INFINITY;
                for _ in 0..30 {
                    let top = self.apply(&x, last.get(column), before.get(column));
                    let right = Mat::<c64>::from_fn(n + k, 1, |i, _| {
                        if i < n {
                            let border = (0..k).fold(Complex::default(), |sum, j| {
                                sum.plus(f[j].times(Complex::from(basis[j][i])).scaled(scale))
                            });
                            return -top[i].plus(border).rounded();
                        }
                        let row = &basis[i - n];
                        let wanted = if order == 0 && i - n == column { 1.0 } else { 0.0 };
                        let found = row.iter().zip(&x).fold(Complex::from(c64::new(-wanted, 0.0)), |sum, (w, x)| {
                            sum.plus(x.times(Complex::from(w.conj())))
                        });
                        -found.rounded() * scale
                    });
                    let step = factor.solve(&right);
                    x.iter_mut().enumerate().for_each(|(i, x)| *x = x.plus(Complex::from(step[(i, 0)])));
                    f.iter_mut().enumerate().for_each(|(i, f)| *f = f.plus(Complex::from(step[(n + i, 0)])));
                    let size = step.norm_l2();
                    let whole = x.iter().chain(&f).map(|x| x.rounded().norm_sqr()).sum::<f64>().sqrt();
                    if !size.is_finite() {
                        return None;
                    }
                    if size <= 1e-28 * whole || (size >= 0.1 * previous && size <= 1e-17 * whole) {
                        previous = 0.0;
                        break;
                    }
                    previous = size;
                }
                if previous != 0.0 {
                    return None; // the bordered matrix is as good as singular
                }
                (0..k).for_each(|row| coefficient[row * k + column] = f[row]);
                columns.push(x);
            }
            series.push(coefficient);
            before = std::mem::replace(&mut last, columns);
        }
        Some(series)
    }
}

/// An orthonormal basis of the shapes of `members`, completed by random vectors if the shapes are linearly dependent.
fn orthonormal(spectrum: &Spectrum, members: &[usize]) -> Vec<Vec<c64>> {
    let mut basis: Vec<Vec<c64>> = vec![];
    let mut any = Uniform::new(1);
    for &j in members {
        let mut vector = spectrum.shapes.col_as_slice(j).to_vec();
        loop {
            let before = norm(&vector);
            for _ in 0..2 {
                for unit in &basis {
                    let along: c64 = unit.iter().zip(&vector).map(|(u, v)| u.conj() * v).sum();
                    vector.iter_mut().zip(unit).for_each(|(v, u)| *v -= along * u);
                }
            }
            let after = norm(&vector);
            vector.iter_mut().for_each(|v| *v /= after);
            if after > 1e-12 * before {
                break;
            }
            vector.iter_mut().for_each(|v| *v = c64::new(any.draw(), any.draw()));
        }
        basis.push(vector);
    }
    basis
}

fn norm(vector: &[c64]) -> f64 {
    vector.iter().map(|v| v.norm_sqr()).sum::<f64>().sqrt()
}

/// The determinant of a power series of `k×k` matrices, as a power series, by expansion along the first row.
fn determinant(series: &[Vec<Complex>]) -> Vec<Complex> {
    let degree = series.len();
    let k = series[0].len().isqrt();
    let entry = |row: usize, column: usize| -> Vec<Complex> { series.iter().map(|f| f[row * k + column]).collect() };
    if k == 1 {
        return entry(0, 0);
    }
    let mut sum = vec![Complex::default(); degree];
    for column in 0..k {
        let rest: Vec<usize> =
            (1..k).flat_map(|row| (0..k).filter(move |&c| c != column).map(move |c| row * k + c)).collect();
        let minor: Vec<Vec<Complex>> = series.iter().map(|f| rest.iter().map(|&at| f[at]).collect()).collect();
        let (factor, minor) = (entry(0, column), determinant(&minor));
        let sign = if column % 2 == 0 { 1.0 } else { -1.0 };
        for (i, a) in factor.iter().enumerate() {
            for (j, b) in minor.iter().enumerate().take(degree - i) {
                sum[i + j] = sum[i + j].plus(a.times(*b).scaled(sign));
            }
        }
    }
    sum
}

/// The zeros of a polynomial, lowest coefficient first, nearest to `guesses`, by simultaneous Newton steps with
/// mutual repulsion (Aberth 1973).
fn roots_near(polynomial: &[Complex], guesses: &[Complex]) -> Option<Vec<Complex>> {
    let mut roots = guesses.to_vec();
    let size = |z: Complex| z.rounded().norm();
    // Scale of the zeros: `|p₀/p_k|^(1/k)`.
    let k = guesses.len();
    let scale = (size(polynomial[0]) / size(polynomial[k])).powf(1.0 / k as f64);
    let scale = roots.iter().map(|&z| size(z)).fold(scale, f64::max);
    if scale == 0.0 {
        return Some(roots);
    }
    for (i, root) in roots.iter_mut().enumerate() {
        // Equal initial values would never separate.
        let angle = 1.0 + std::f64::consts::TAU * i as f64 / k as f64;
        *root = root.plus(Complex::from(c64::new(angle.cos(), angle.sin()) * (1e-3 * scale)));
    }
    for round in 0..200 {
        let mut largest: f64 = 0.0;
        for i in 0..k {
            let (mut value, mut slope) = (Complex::default(), Complex::default());
            for &coefficient in polynomial.iter().rev() {
                slope = slope.times(roots[i]).plus(value);
                value = value.times(roots[i]).plus(coefficient);
            }
            if size(value) == 0.0 {
                continue;
            }
            let repelled = (0..k)
                .filter(|&j| j != i)
                .fold(slope.times(value.inverse()), |sum, j| sum.minus(roots[i].minus(roots[j]).inverse()));
            let step = repelled.inverse();
            if !size(step).is_finite() {
                return None;
            }
            roots[i] = roots[i].minus(step);
            largest = largest.max(size(step));
        }
        // At a multiple zero only half of the thirty digits remain, and each step only halves the distance.
        if largest <= 1e-26 * scale || (round > 100 && largest <= 1e-8 * scale) {
            return Some(roots);
        }
    }
    None
}

/// `exact` in the order of `given`: the assignment with the smallest total distance.
fn matched(given: &[Complex], exact: Vec<Complex>) -> Vec<Complex> {
    let cost = |order: &[Complex]| -> f64 {
        order.iter().zip(given).map(|(exact, given)| exact.minus(*given).rounded().norm()).sum()
    };
    permutations(exact).into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap_or_default()
}

fn permutations(items: Vec<Complex>) -> Vec<Vec<Complex>> {
    if items.len() < 2 {
        return vec![items];
    }
    (0..items.len())
        .flat_map(|k| {
            let mut rest = items.clone();
            let first = rest.swap_remove(k);
            permutations(rest).into_iter().map(move |mut tail| {
                tail.push(first);
                tail
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use faer::mat;

    use super::*;
    use crate::physics::test_models::{REFERENCE, nine_dof, random_rig};
    use crate::physics::{ContactLaw, Law, Model, OperatingPoint, Solver, Term, Vectors};
    use crate::proof::synthetic::{Synthetic, rig};

    /// The matrices and the spectrum of a model at an operating point.
    fn solved(model: &Model, p: &OperatingPoint) -> (Mat<f64>, Mat<f64>, Spectrum) {
        let n = model.dimension();
        let (mut k, mut c) = (Mat::zeros(n, n), Mat::zeros(n, n));
        model.assemble(p, &mut k, &mut c).unwrap();
        (k, c, Solver::new(n).solve(model, p, Vectors::Both).unwrap())
    }

    fn constant(stiffness: Mat<f64>) -> Model {
        let n = stiffness.nrows();
        let term = Term { matrix: stiffness, law: Law::Constant };
        Model::new(n, vec![term], vec![], ContactLaw::default(), None).unwrap()
    }

    /// `√2` to thirty digits gives the exact error of the dense root.
    #[test]
    fn refines_beyond_double_precision() {
        // `λ² = -2 ± √2`, `√2 = 1.4142135623730950488016887242097`.
        let (k, c, spectrum) = solved(&constant(mat![[2.0, 2.0], [1.0, 2.0]]), &REFERENCE);
        let (high, low) = (std::f64::consts::SQRT_2, -9.667_293_313_452_913e-17);
        for (j, sign) in [(0, 1.0), (1, -1.0)] {
            let refined = refine(k.as_ref(), c.as_ref(), &spectrum, &[j]).expect("it converges");
            // The difference of floating-point numbers within a factor of two is exact (Sterbenz 1974); so is that
            // from -2.
            let expected = sign * high - (spectrum.roots[j].square.re + 2.0) + sign * low;
            assert!((refined.errors[0].re - expected).abs() < 1e-26, "{:?} is not {expected:e}", refined.errors);
        }
    }

    /// Two modes that merge at `w = 0`, `[[4, 1], [w, 4]]`: `λ² = -4 ± √w`, however few digits of it the dense roots
    /// keep.
    #[test]
    fn tells_merging_roots_apart() {
        for w in [0.0, 1e-30, 1e-16, -1e-16, 1e-12, -1e-9] {
            let (k, c, spectrum) = solved(&constant(mat![[4.0, 1.0], [w, 4.0]]), &REFERENCE);
            let refined = refine(k.as_ref(), c.as_ref(), &spectrum, &[0, 1]).expect("it converges");
            // Thirty digits of the matrix give thirty digits of the discriminant, relative to the product of the
            // off-diagonal entries.
            assert!((refined.discriminant - c64::new(w, 0.0)).norm() <= 1e-26, "{w}: {refined:?}");
            for (&j, error) in refined.members.iter().zip(&refined.errors) {
                let exact = spectrum.roots[j].square + error + 4.0;
                assert!((exact * exact - w).norm() <= 1e-15 * exact.norm() + 1e-25, "{w}: {exact}");
            }
        }
    }

    /// Every root of random and synthetic rigs, undamped and damped, merging or not, is within its bound of the
    /// reference root. No root is left out. The bounds are not too loose: most are within a few thousand times the
    /// error.
    #[test]
    fn dense_roots_are_within_their_bounds() {
        let mut ratios = vec![];
        let mut together = 0;
        let mut compare = |model: &Model, p: &OperatingPoint, of: &str| {
            let (k, c, spectrum) = solved(model, p);
            for cluster in clusters(&spectrum) {
                together += usize::from(cluster.len() > 1);
                let refined = refine(k.as_ref(), c.as_ref(), &spectrum, &cluster);
                let refined = refined.unwrap_or_else(|| panic!("{of}, {p:?}: {cluster:?} of {:?}", spectrum.roots));
                for (&j, error) in refined.members.iter().zip(&refined.errors) {
                    let (error, bound) = (error.norm(), bound(&spectrum, j));
                    assert!(error <= bound, "{of}, {p:?}, root {j}: off by {error:e}, bound {bound:e}");
                    ratios.push(bound / error.max(1e-3 * bound * f64::EPSILON));
                }
            }
        };
        for seed in 0..36 {
            let damping = [0.0, 1e-3, 3e-2][seed as usize % 3];
            let model = if seed < 24 {
                random_rig(seed, 6 + seed as usize % 5, 3, damping)
            } else {
                let contact_law = ContactLaw::default();
                rig(&Synthetic { modes: 20, pairs: 12, damping_ratio: damping, contact_law, seed }).unwrap()
            };
            for step in 0..8 {
                compare(&model, &REFERENCE.with_friction(0.13 * f64::from(step)), &format!("seed {seed}"));
            }
        }
        // At and around a merging point of the 9-degree-of-freedom model; 0.82001495938185 by 30-digit arithmetic.
        for exponent in 2..=17 {
            for sign in [-1.0, 1.0] {
                let mu = 0.82001495938185 + sign * 10f64.powi(-exponent);
                compare(&nine_dof(1.0, 1.0, 1.0), &REFERENCE.with_friction(mu), "nine DoF");
            }
        }
        ratios.sort_by(f64::total_cmp);
        assert!(ratios.len() > 2000 && together > 10, "{} roots were compared, {together} together", ratios.len());
        assert!(ratios[ratios.len() / 2] < 5e3, "the median bound is {} times the error", ratios[ratios.len() / 2]);
    }
}
