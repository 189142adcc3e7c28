//! First and second derivatives of roots along the axes of a chart, from left and right vectors.

use faer::{Mat, MatRef, c64};

use super::MAX_AXES;
use crate::physics::spectrum::Spectrum;
use crate::physics::tracking::tracked;

/// Maximum number of unordered pairs of axes, an axis with itself included.
pub const PAIRS: usize = MAX_AXES * (MAX_AXES + 1) / 2;

/// Every pair `(a, b)` of axes with `a ≤ b`, at index `b (b + 1) / 2 + a`.
pub fn pairs(axes: usize) -> impl Iterator<Item = [usize; 2]> {
    (0..axes).flat_map(|b| (0..=b).map(move |a| [a, b]))
}

/// Derivatives of stiffness and damping, `n×n`; `None` for a matrix that does not change.
pub type Change = [Option<Mat<f64>>; 2];

/// Derivatives of every followed root `z`: `λ²` of an undamped model, `λ` of a damped one. NaN or infinite where a
/// root is multiple or the matrices have no derivative.
pub struct Derivatives {
    /// First derivatives along each axis.
    pub slopes: Vec<[c64; MAX_AXES]>,
    /// Second derivatives along the [`pairs`] of axes.
    pub curvatures: Vec<[c64; PAIRS]>,
}

impl Derivatives {
    /// Computes the derivatives from those of the matrices: `first` along each axis, `second` along each pair of
    /// axes. `left` holds the left vectors, `n×roots`.
    ///
    /// With `Qₐ = λ Cₐ + Kₐ` and the sum over every other root `j`, complex conjugates included: `λₐ = -yᴴ Qₐ x` and
    ///
    /// `λ_ab = -yᴴ Q_ab x - λₐ yᴴ C_b x - λ_b yᴴ Cₐ x - 2 λₐ λ_b yᴴ x + Σ (Uₐ V_b + U_b Vₐ) / (λ - λⱼ)`,
    /// `Uₐ = yᴴ Qₐ xⱼ + λₐ (λ - λⱼ) yᴴ xⱼ`, `Vₐ = yⱼᴴ Qₐ x + λₐ (λ - λⱼ) yⱼᴴ x`,
    ///
    /// from `Q(λ)⁻¹ = Σ xⱼ yⱼᴴ / (λ - λⱼ)` and `yⱼᴴ C x = -(λ + λⱼ) yⱼᴴ x` (Lancaster, "On eigenvalues of matrices
    /// dependent on a parameter", Numer. Math. 6, 1964, for the linear problem). For an undamped model `λ²` takes the
    /// place of `λ`, and only the terms that contain `Q` remain.
    pub fn new(spectrum: &Spectrum, left: MatRef<'_, c64>, first: &[Change], second: &[Change]) -> Self {
        let undamped = spectrum.undamped;
        let value = |k: usize| if undamped { spectrum.roots[k].square } else { spectrum.roots[k].lambda };
        let (axes, count) = (first.len(), tracked(spectrum));
        let sides = Sides { right: parts(spectrum.shapes.as_ref()), left: parts(left) };
        let each = |change: &Change, of: &dyn Fn(&Mat<f64>) -> Products| change.each_ref().map(|m| m.as_ref().map(of));
        let first: Vec<[Option<Products>; 2]> =
            first.iter().map(|change| each(change, &|matrix| sides.products(Some(matrix)))).collect();
        let second: Vec<[Option<Vec<c64>>; 2]> = second
            .iter()
            .map(|change| change.each_ref().map(|m| m.as_ref().map(|matrix| sides.diagonal(matrix, count))))
            .collect();
        // `yᴴ x` of all pairs; only a damped model needs it.
        let overlaps = (!undamped).then(|| sides.products(None));

        let (mut slopes, mut curvatures) = (vec![[c64::ZERO; MAX_AXES]; count], vec![[c64::ZERO; PAIRS]; count]);
        for (i, (slope, curvature)) in slopes.iter_mut().zip(&mut curvatures).enumerate() {
            let z = value(i);
            for axis in 0..axes {
                slope[axis] = -weighed(&first[axis], z, |products| products.plain[(i, i)]);
            }
            for ((curvature, [a, b]), second) in curvature.iter_mut().zip(pairs(axes)).zip(&second) {
                *curvature = -weighed(second, z, |diagonal| diagonal[i]);
                if let Some(overlaps) = &overlaps {
                    let damping = |axis: usize| first[axis][1].as_ref().map_or(c64::ZERO, |m| m.plain[(i, i)]);
                    *curvature -= slope[a] * damping(b)
                        + slope[b] * damping(a)
                        + 2.0 * slope[a] * slope[b] * overlaps.plain[(i, i)];
                }
            }
            let others = (0..spectrum.roots.len()).filter(|&j| j != i).map(|j| (j, false));
            // In a damped model the complex conjugate of every mode is a root too.
            let images = (0..if undamped { 0 } else { spectrum.mode_count }).map(|j| (j, true));
            for (j, mirrored) in others.chain(images) {
                let gap = z - if mirrored { value(j).conj() } else { value(j) };
                let (mut u, mut v) = ([c64::ZERO; MAX_AXES], [c64::ZERO; MAX_AXES]);
                for axis in 0..axes {
                    u[axis] = weighed(&first[axis], z, |products| products.to(i, j, mirrored));
                    v[axis] = weighed(&first[axis], z, |products| products.from(j, i, mirrored));
                    if let Some(overlaps) = &overlaps {
                        u[axis] += slope[axis] * gap * overlaps.to(i, j, mirrored);
                        v[axis] += slope[axis] * gap * overlaps.from(j, i, mirrored);
                    }
                }
                let per = 1.0 / gap;
                for (curvature, [a, b]) in curvature.iter_mut().zip(pairs(axes)) {
                    let product = u[a] * v[b] + u[b] * v[a];
                    // Uncoupled roots may be equal: the gap is zero then.
                    if product != c64::ZERO {
                        *curvature += product * per;
                    }
                }
            }
        }
        Self { slopes, curvatures }
    }
}

/// Real and imaginary parts of all right and all left vectors.
struct Sides {
    right: [Mat<f64>; 2],
    left: [Mat<f64>; 2],
}

fn parts(vectors: MatRef<'_, c64>) -> [Mat<f64>; 2] {
    let all = |part: fn(&c64) -> f64| Mat::from_fn(vectors.nrows(), vectors.ncols(), |i, j| part(&vectors[(i, j)]));
    [all(|z| z.re), all(|z| z.im)]
}

impl Sides {
    /// `yᵢᴴ M xⱼ` and `yᵢᵀ M xⱼ` of all pairs of roots; `M` is the identity if not given.
    fn products(&self, matrix: Option<&Mat<f64>>) -> Products {
        let moved = matrix.map(|matrix| self.right.each_ref().map(|part| matrix * part));
        let [wr, wi] = moved.as_ref().unwrap_or(&self.right);
        let [yr, yi] = &self.left;
        let (rr, ii) = (yr.transpose() * wr, yi.transpose() * wi);
        let (ri, ir) = (yr.transpose() * wi, yi.transpose() * wr);
        let all = |f: &dyn Fn(usize, usize) -> c64| Mat::from_fn(rr.nrows(), rr.ncols(), f);
        Products {
            plain: all(&|i, j| c64::new(rr[(i, j)] + ii[(i, j)], ri[(i, j)] - ir[(i, j)])),
            transposed: all(&|i, j| c64::new(rr[(i, j)] - ii[(i, j)], ri[(i, j)] + ir[(i, j)])),
        }
    }

    /// `yᵢᴴ M xᵢ` of the first `count` roots.
    fn diagonal(&self, matrix: &Mat<f64>, count: usize) -> Vec<c64> {
        let [wr, wi] = self.right.each_ref().map(|part| matrix * part.get(.., ..count));
        let [yr, yi] = &self.left;
        let along = |k: usize| {
            let term = |i: usize| c64::new(yr[(i, k)], -yi[(i, k)]) * c64::new(wr[(i, k)], wi[(i, k)]);
            (0..wr.nrows()).map(term).sum()
        };
        (0..count).map(along).collect()
    }
}

/// `yᵢᴴ M xⱼ` and `yᵢᵀ M xⱼ`; the second is needed for complex conjugate roots, whose vectors are conjugate.
struct Products {
    plain: Mat<c64>,
    transposed: Mat<c64>,
}

impl Products {
    /// `yᵢᴴ M xⱼ`, with the complex conjugate of root `j` if `mirrored`.
    fn to(&self, i: usize, j: usize, mirrored: bool) -> c64 {
        if mirrored { self.transposed[(i, j)].conj() } else { self.plain[(i, j)] }
    }

    /// `yⱼᴴ M xᵢ`, with the complex conjugate of root `j` if `mirrored`.
    fn from(&self, j: usize, i: usize, mirrored: bool) -> c64 {
        if mirrored { self.transposed[(j, i)] } else { self.plain[(j, i)] }
    }
}

/// `of(stiffness) + z of(damping)`, the value of `of` for `Qₐ = Kₐ + z Cₐ`; a matrix that does not change counts as
/// zero.
fn weighed<T>(change: &[Option<T>; 2], z: c64, of: impl Fn(&T) -> c64) -> c64 {
    let [stiffness, damping] = change.each_ref().map(|part| part.as_ref().map_or(c64::ZERO, &of));
    stiffness + z * damping
}
