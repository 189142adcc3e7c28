//! Complex eigenvalues of a full sparse system, `(λ² M + λ C + K) x = 0`, `C` and `K` of any symmetry.
//!
//! Around a shift `s` the linearised problem is inverted with one sparse factor of `Q(s) = s² M + s C + K`:
//!
//! ```text
//! (x, y) -> x' = -Q(s)⁻¹ (M y + (C + s M) x),  y' = x + s x',   eigenvalues θ = 1/(λ - s)
//! ```
//!
//! Arnoldi's method finds the largest `θ`: the roots nearest to the shift, and how far from it all of them are found.
//! Shifts follow each other up the imaginary axis until their discs cover the band. A root near the rim of a disc counts
//! where its frequency lies in the disc's own stretch of the axis.
//!
//! Source: Saad, "Numerical methods for large eigenvalue problems" (2011), chapters 6 and 8; Tisseur, Meerbergen, "The
//! quadratic eigenvalue problem", SIAM Review 43 (2001) 235-286.

use faer::linalg::solvers::Solve;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, c64};

use super::lanczos::random_block;
use super::sparse::{entries, one_norm};
use super::{ReductionError, SparseMatrix};

/// Roots that are sought around each shift.
const WANTED: usize = 40;
/// Vectors built around each shift, for each root.
const VECTORS_PER_ROOT: usize = 3;
/// Residual an Arnoldi pair may have, relative to its `θ`.
const ARNOLDI_LIMIT: f64 = 1e-12;
/// Residual a root may have, relative to the size of its parts.
const RESIDUAL_LIMIT: f64 = 1e-12;
/// Half the chord of a disc that counts as covered, relative to its radius: its half width there is 0.31 of it.
const CHORD: f64 = 0.95;
/// Shifts after which the band is given up.
const MOST_SHIFTS: usize = 200;
/// Imaginary part, relative to `|λ|`, below which a root does not oscillate.
const REAL: f64 = 1e-9;

/// A root of the full system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FullRoot {
    /// `λ`, 1/s, with an imaginary part of at least 0.
    pub lambda: c64,
    /// `|(λ² M + λ C + K) x| / ((|λ|² |M| + |λ| |C| + |K|) |x|)`, 1-norms of matrices and 2-norms of vectors.
    pub residual: f64,
}

/// A disc of the complex plane in which every root has converged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoveredDisc {
    /// Its centre `iω`, by `ω` in rad/s.
    pub shift_rad_s: f64,
    /// Its radius, 1/s.
    pub radius: f64,
}

/// The roots of a band and where they were looked for.
#[derive(Clone, Debug)]
pub struct FullSpectrum {
    /// Ascending in frequency.
    pub roots: Vec<FullRoot>,
    /// Ascending; together they cover the imaginary axis from 0 to the end of the band.
    pub discs: Vec<CoveredDisc>,
    /// At every frequency of the band growth rates up to this magnitude were covered, 1/s.
    pub covered_growth_per_s: f64,
}

/// Every root with a frequency from 0 to `band_rad_s`, as far as discs around shifts on the imaginary axis cover it.
///
/// `mass`, `damping`, `stiffness`: `n×n` in kg, N·s/m, N/m. `progress` hears of every disc and how many roots it has.
///
/// # Errors
/// [`ReductionError`]: `Shape`, `Factorisation`, `NotCovered`, `Residual`.
pub fn full_order_roots(
    what: &str,
    [mass, damping, stiffness]: [&SparseMatrix; 3],
    band_rad_s: f64,
    progress: &mut dyn FnMut(CoveredDisc, usize),
) -> Result<FullSpectrum, ReductionError> {
    let n = mass.nrows();
    for (name, matrix) in [("mass", mass), ("damping", damping), ("stiffness", stiffness)] {
        let (rows, columns) = matrix.shape();
        if (rows, columns) != (n, n) {
            return Err(ReductionError::Shape { what: format!("{what}.{name}"), rows, columns, expected: n });
        }
    }
    let system = System { what, mass, damping, stiffness, norms: [mass, damping, stiffness].map(one_norm) };
    let mut found: Vec<(CoveredDisc, Vec<FullRoot>)> = vec![];
    let (mut covered, mut step) = (0.0, band_rad_s / 16.0);
    while covered < band_rad_s {
        if found.len() == MOST_SHIFTS {
            return Err(ReductionError::NotCovered { what: what.to_owned(), covered, band: band_rad_s });
        }
        let (disc, roots) = system.around(covered + step)?;
        progress(disc, roots.len());
        let (low, high) = (disc.shift_rad_s - CHORD * disc.radius, disc.shift_rad_s + CHORD * disc.radius);
        found.push((disc, roots));
        if low > covered {
            step *= 0.4;
            continue;
        }
        covered = high;
        step = 0.85 * disc.radius;
    }
    found.sort_by(|a, b| a.0.shift_rad_s.total_cmp(&b.0.shift_rad_s));
    Ok(assemble(&found, band_rad_s))
}

/// Takes every root from the disc whose stretch of the axis it lies in.
fn assemble(found: &[(CoveredDisc, Vec<FullRoot>)], band_rad_s: f64) -> FullSpectrum {
    let mut roots: Vec<FullRoot> = vec![];
    let mut from = 0.0;
    let mut half_width = f64::INFINITY;
    for (index, (disc, inside)) in found.iter().enumerate() {
        let high = disc.shift_rad_s + CHORD * disc.radius;
        let to = match found.get(index + 1) {
            // The middle of what both cover.
            Some((next, _)) => (0.5
                * (high.min(next.shift_rad_s) + (next.shift_rad_s - CHORD * next.radius).max(disc.shift_rad_s)))
            .max(from),
            None => band_rad_s,
        };
        let of_disc = inside.iter().filter(|root| (from..to).contains(&root.lambda.im));
        for root in of_disc {
            // One on the border may have been found just before it too.
            let again = |other: &FullRoot| (other.lambda - root.lambda).norm() < 1e-9 * root.lambda.norm();
            if (root.lambda.im - from).abs() > 1e-6 * from || !roots.iter().any(again) {
                roots.push(*root);
            }
        }
        for end in [from, to] {
            let off = (end - disc.shift_rad_s).abs().min(disc.radius);
            half_width = half_width.min((disc.radius * disc.radius - off * off).sqrt());
        }
        from = to;
    }
    roots.sort_by(|a, b| a.lambda.im.total_cmp(&b.lambda.im));
    FullSpectrum { roots, discs: found.iter().map(|(disc, _)| *disc).collect(), covered_growth_per_s: half_width }
}

struct System<'a> {
    what: &'a str,
    mass: &'a SparseMatrix,
    damping: &'a SparseMatrix,
    stiffness: &'a SparseMatrix,
    norms: [f64; 3],
}

impl System<'_> {
    /// `a M + b C + c K`.
    fn sum(&self, [a, b, c]: [c64; 3]) -> Result<SparseColMat<usize, c64>, ReductionError> {
        let n = self.mass.nrows();
        let triplets: Vec<Triplet<usize, usize, c64>> = [(a, self.mass), (b, self.damping), (c, self.stiffness)]
            .into_iter()
            .flat_map(|(weight, matrix)| entries(matrix).map(move |(i, j, value)| Triplet::new(i, j, weight * value)))
            .collect();
        SparseColMat::try_new_from_triplets(n, n, &triplets).map_err(|error| self.failed(format!("{error:?}")))
    }

    fn failed(&self, reason: String) -> ReductionError {
        ReductionError::Factorisation { what: self.what.to_owned(), reason }
    }

    /// The roots nearest to `iω` with an imaginary part of at least 0, and the disc in which there are no others.
    fn around(&self, omega: f64) -> Result<(CoveredDisc, Vec<FullRoot>), ReductionError> {
        let n = self.mass.nrows();
        let (zero, one, s) = (c64::new(0.0, 0.0), c64::new(1.0, 0.0), c64::new(0.0, omega));
        let factor = self
            .sum([s * s, s, one])?
            .sp_lu()
            .map_err(|error| self.failed(format!("the sparse factor at {s} failed: {error:?}")))?;
        let (coupling, mass) = (self.sum([s, one, zero])?, self.sum([one, zero, zero])?);
        // Velocities are divided by ω, so that both halves of a vector weigh alike.
        let apply =
            |v: &Mat<c64>| {
                let (x, y) = (v.subrows(0, n), faer::Scale(c64::new(omega, 0.0)) * v.subrows(n, n));
                let mut next = -(&mass * &y + &coupling * x);
                factor.solve_in_place(next.as_mut());
                Mat::from_fn(2 * n, 1, |i, _| {
                    if i < n { next[(i, 0)] } else { (x[(i - n, 0)] + s * next[(i - n, 0)]) / omega }
                })
            };
        let m = (VECTORS_PER_ROOT * WANTED).min(2 * n);
        let mut basis = Mat::<c64>::zeros(2 * n, m);
        let mut hessenberg = Mat::<c64>::zeros(m, m);
        let start = random_block(2 * n, 2, 1);
        let mut vector = apply(&Mat::from_fn(2 * n, 1, |i, _| c64::new(start[(i, 0)], start[(i, 1)])));
        vector *= faer::Scale(c64::new(1.0 / vector.norm_l2(), 0.0));
        let mut beyond = 0.0;
        let mut size = 0;
        while size < m {
            basis.subcols_mut(size, 1).copy_from(&vector);
            size += 1;
            let mut next = apply(&vector);
            let held = basis.subcols(0, size);
            let before = next.norm_l2();
            for _ in 0..2 {
                let coefficients = held.adjoint() * &next;
                next -= held * &coefficients;
                let mut column = hessenberg.submatrix_mut(0, size - 1, size, 1);
                column += coefficients;
            }
            beyond = next.norm_l2();
            if beyond <= 1e-14 * before || size == m {
                break;
            }
            hessenberg[(size, size - 1)] = c64::new(beyond, 0.0);
            vector = faer::Scale(c64::new(1.0 / beyond, 0.0)) * next;
        }
        let eigen = hessenberg
            .submatrix(0, 0, size, size)
            .eigen()
            .map_err(|error| self.failed(format!("the eigenvalues around {s} did not converge: {error:?}")))?;
        let (theta, vectors) = (eigen.S().column_vector(), eigen.U());
        let mut order: Vec<usize> = (0..size).collect();
        order.sort_by(|&a, &b| theta[b].norm().total_cmp(&theta[a].norm()));
        let converged = |k: &usize| {
            let residual = beyond * vectors[(size - 1, *k)].norm() / vectors.col(*k).norm_l2();
            residual < ARNOLDI_LIMIT * theta[*k].norm()
        };
        let good: Vec<usize> = order.into_iter().take_while(converged).collect();
        let Some(&last) = good.last() else {
            return Err(self.failed(format!("no root converged around {s}")));
        };
        let radius = 1.0 / theta[last].norm();
        let mut roots = vec![];
        for k in good {
            let lambda = s + 1.0 / theta[k];
            if lambda.im < -REAL * lambda.norm() {
                continue;
            }
            let x = basis.submatrix(0, 0, n, size) * vectors.submatrix(0, k, size, 1);
            let r = self.sum([lambda * lambda, lambda, one])? * &x;
            let rate = lambda.norm();
            let parts = rate * rate * self.norms[0] + rate * self.norms[1] + self.norms[2];
            let residual = r.norm_l2() / (parts * x.norm_l2());
            if residual.is_nan() || residual > RESIDUAL_LIMIT {
                let (what, mode, limit) = (self.what.to_owned(), roots.len(), RESIDUAL_LIMIT);
                return Err(ReductionError::Residual { what, mode, value: residual, limit });
            }
            roots.push(FullRoot { lambda: c64::new(lambda.re, lambda.im.max(0.0)), residual });
        }
        Ok((CoveredDisc { shift_rad_s: omega, radius }, roots))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damped_unsymmetric_system_in_blocks() {
        // Blocks of two: [[a - d, w], [-w, a + d]] with unit mass, damping g; λ² + g λ + κ = 0, κ = a ± sqrt(d² - w²).
        let blocks = 150;
        let (mut mass, mut damping, mut stiffness, mut expected) = (vec![], vec![], vec![], vec![]);
        for b in 0..blocks {
            let a = (100.0 * (b + 1) as f64).powi(2);
            let (d, w, g) = (0.05 * a, if b % 3 == 0 { 0.08 * a } else { 0.03 * a }, 4.0 + (b % 7) as f64);
            let (i, j) = (2 * b, 2 * b + 1);
            for k in [i, j] {
                mass.push(Triplet::new(k, k, 1.0));
                damping.push(Triplet::new(k, k, g));
            }
            stiffness
                .extend([(i, i, a - d), (j, j, a + d), (i, j, w), (j, i, -w)].map(|(r, c, v)| Triplet::new(r, c, v)));
            let split = c64::new(d * d - w * w, 0.0).sqrt();
            for kappa in [c64::new(a, 0.0) + split, c64::new(a, 0.0) - split] {
                let root = (c64::new(g * g, 0.0) - kappa * 4.0).sqrt();
                for lambda in [(root - g) * 0.5, (-root - g) * 0.5] {
                    if lambda.im > 0.0 && lambda.im < 8000.0 {
                        expected.push(lambda);
                    }
                }
            }
        }
        expected.sort_by(|a, b| a.im.total_cmp(&b.im));
        let build = |t: &[_]| SparseMatrix::try_new_from_triplets(2 * blocks, 2 * blocks, t).unwrap();
        let (mass, damping, stiffness) = (build(&mass), build(&damping), build(&stiffness));
        let found = full_order_roots("system", [&mass, &damping, &stiffness], 8000.0, &mut |_, _| {}).unwrap();
        // Flutter pairs share their imaginary part but for damping: compared as sets.
        assert_eq!(found.roots.len(), expected.len());
        for lambda in expected {
            let nearest = found.roots.iter().map(|root| (root.lambda - lambda).norm()).fold(f64::INFINITY, f64::min);
            assert!(nearest < 1e-10 * lambda.norm(), "{lambda}: {nearest:e}");
        }
        assert!(found.discs.len() > 2 && found.covered_growth_per_s > 100.0, "{:?}", found.discs);
    }
}
