//! Clusters of roots, represented by symmetric functions, which stay analytic where the roots themselves merge.
//!
//! A cluster of `k` roots `z` is represented by its mean `c` and the monic polynomial `P(w) = Π (w - (z - c))`, whose
//! coefficient of `w^(k-1)` is zero. These are `k` numbers: real for an undamped model, where the cluster is closed
//! under conjugation, otherwise complex.

use faer::c64;

use crate::physics::spectrum::{magnitude, square_root};

/// Maximum number of roots of a cluster.
pub const MAX_SIZE: usize = 8;

/// Maximum number of roots of a cluster in a chart over `axes` conditions. Over three, a heavily damped root passes many
/// others before it meets the one that it merges with.
pub fn max_size(axes: usize) -> usize {
    if axes < 3 { 4 } else { MAX_SIZE }
}

/// The symmetric functions of the roots `z`: their mean, then the coefficients of `w^(k-2) .. w^0`.
pub fn symmetric_functions(z: &[c64]) -> Vec<c64> {
    let mean = z.iter().sum::<c64>() / z.len() as f64;
    let mut polynomial = vec![c64::new(1.0, 0.0)];
    for &root in z {
        polynomial.push(c64::ZERO);
        for k in (1..polynomial.len()).rev() {
            let below = polynomial[k - 1];
            polynomial[k] -= (root - mean) * below;
        }
    }
    std::iter::once(mean).chain(polynomial.into_iter().skip(2)).collect()
}

/// Slopes of the [`symmetric_functions`] of roots `z` with slopes `dz`.
pub fn symmetric_slopes(z: &[c64], dz: &[c64]) -> Vec<c64> {
    let mut slopes = vec![c64::ZERO; z.len()];
    slopes[0] = mean(dz);
    add_first_order(&mut slopes, z, dz);
    slopes
}

/// Second derivatives of the [`symmetric_functions`] along two axes `a` and `b`, of roots `z` with slopes `dza` and
/// `dzb` and second derivatives `ddz`.
pub fn symmetric_curvatures(z: &[c64], dza: &[c64], dzb: &[c64], ddz: &[c64]) -> Vec<c64> {
    let mut curvatures = vec![c64::ZERO; z.len()];
    curvatures[0] = mean(ddz);
    add_first_order(&mut curvatures, z, ddz);
    // The product terms, in which two factors of the polynomial change.
    let (drift_a, drift_b) = (mean(dza), mean(dzb));
    for (i, a) in dza.iter().enumerate() {
        for (j, b) in dzb.iter().enumerate().filter(|&(j, _)| j != i) {
            for (curvature, coefficient) in curvatures[1..].iter_mut().zip(product_without(z, &[i, j])) {
                *curvature += (a - drift_a) * (b - drift_b) * coefficient;
            }
        }
    }
    curvatures
}

fn mean(z: &[c64]) -> c64 {
    z.iter().sum::<c64>() / z.len() as f64
}

/// Adds the change of the polynomial's coefficients that is linear in the change `dz` of the roots.
fn add_first_order(coefficients: &mut [c64], z: &[c64], dz: &[c64]) {
    let drift = mean(dz);
    for (i, &dz) in dz.iter().enumerate() {
        for (change, coefficient) in coefficients[1..].iter_mut().zip(&product_without(z, &[i])[1..]) {
            *change -= (dz - drift) * coefficient;
        }
    }
}

/// Coefficients of the product of the factors `w - (z - c)`, without those in `left_out`, highest power first.
fn product_without(z: &[c64], left_out: &[usize]) -> Vec<c64> {
    let centre = mean(z);
    let mut others = vec![c64::new(1.0, 0.0)];
    for (_, &root) in z.iter().enumerate().filter(|(j, _)| !left_out.contains(j)) {
        others.push(c64::ZERO);
        for k in (1..others.len()).rev() {
            let below = others[k - 1];
            others[k] -= (root - centre) * below;
        }
    }
    others
}

/// Writes the roots of a cluster of `functions.len()` roots, each with an error bound, from its symmetric functions
/// and their error bounds.
///
/// If the coefficients have errors of at most `δ_m`, then `ρ = Σ δ_m |w|^(k-m)` bounds the true polynomial at a
/// computed root `w`. A true root lies within `k ρ / |P'(w)|` and within `ρ^(1/k)` of it (Laguerre; Henrici 1974,
/// 6.4). At a merging point only the second bound is finite: half the digits remain.
pub fn roots(functions: &[c64], errors: &[f64], out: &mut [(c64, f64); MAX_SIZE]) {
    let k = functions.len();
    let mean = functions[0];
    if k == 1 {
        out[0] = (mean, errors[0]);
        return;
    }
    let w = offsets(functions);
    for i in 0..k {
        let (mut rho, mut slope) = (0.0, c64::new(1.0, 0.0));
        let size = magnitude(w[i]);
        for (m, error) in errors.iter().enumerate().skip(1) {
            rho += error * size.powi((k - 1 - m) as i32);
        }
        for (j, &other) in w[..k].iter().enumerate() {
            if j != i {
                slope *= w[i] - other;
            }
        }
        let far = k as f64 * rho / magnitude(slope);
        let near = if k == 2 { rho.sqrt() } else { rho.powf(1.0 / k as f64) };
        let spread = if rho == 0.0 { 0.0 } else { far.min(near) };
        out[i] = (mean + w[i], errors[0] + spread);
    }
}

/// The roots of a cluster minus their mean.
pub fn offsets(functions: &[c64]) -> [c64; MAX_SIZE] {
    let mut w = [c64::ZERO; MAX_SIZE];
    match functions.len() {
        0 | 1 => {}
        2 => {
            let half = square_root(-functions[1]);
            (w[0], w[1]) = (half, -half);
        }
        k => simultaneous(&functions[1..], &mut w[..k]),
    }
    w
}

/// All roots of `w^k + a_0 w^(k-2) + a_1 w^(k-3) + ..` simultaneously (Aberth 1973).
fn simultaneous(a: &[c64], w: &mut [c64]) {
    let k = w.len();
    let radius = a.iter().enumerate().map(|(m, a)| a.norm().powf(1.0 / (m + 2) as f64)).fold(0.0, f64::max);
    if radius == 0.0 {
        w.fill(c64::ZERO);
        return;
    }
    for (i, w) in w.iter_mut().enumerate() {
        let angle = std::f64::consts::TAU * (i as f64 + 0.3) / k as f64;
        *w = c64::new(radius * angle.cos(), radius * angle.sin());
    }
    for _ in 0..60 {
        let mut largest: f64 = 0.0;
        for i in 0..k {
            // Horner's scheme for `P` and `P'`; the coefficient of `w^(k-1)` is zero.
            let (mut p, mut slope) = (c64::new(1.0, 0.0), c64::ZERO);
            for m in 0..k {
                slope = slope * w[i] + p;
                p = p * w[i] + if m == 0 { c64::ZERO } else { a[m - 1] };
            }
            if p == c64::ZERO {
                continue;
            }
            let newton = p / slope;
            let repulsion: c64 =
                (0..k).filter(|&j| j != i && w[j] != w[i]).map(|j| c64::new(1.0, 0.0) / (w[i] - w[j])).sum();
            let step = newton / (c64::new(1.0, 0.0) - newton * repulsion);
            if step.re.is_finite() && step.im.is_finite() {
                w[i] -= step;
                largest = largest.max(step.norm());
            }
        }
        if largest <= 4.0 * f64::EPSILON * radius {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Roots to symmetric functions and back: clusters of one to eight roots, merging pairs included.
    #[test]
    fn there_and_back() {
        let z = |re: f64, im: f64| c64::new(re, im);
        let cases = [
            vec![z(-4.0, 0.0)],
            vec![z(-4.0, 1e-3), z(-4.0, -1e-3)],
            vec![z(-4.0, 0.0), z(-4.1, 0.0), z(-3.7, 0.0)],
            vec![z(-4.0, 0.2), z(-4.0, -0.2), z(-3.7, 0.0)],
            vec![z(-4.0, 0.2), z(-4.0, -0.2), z(-3.7, 0.1), z(-3.7, -0.1)],
            (0..8).map(|k| z(-4.0 + 0.1 * f64::from(k % 3), 0.15 * f64::from(k))).collect(),
        ];
        for roots_in in cases {
            let functions = symmetric_functions(&roots_in);
            let mut out = [(c64::ZERO, 0.0); MAX_SIZE];
            roots(&functions, &vec![1e-15; functions.len()], &mut out);
            for &root in &roots_in {
                let (nearest, bound) = out[..roots_in.len()]
                    .iter()
                    .min_by(|a, b| (a.0 - root).norm().total_cmp(&(b.0 - root).norm()))
                    .copied()
                    .unwrap();
                assert!((nearest - root).norm() < 1e-11, "{nearest} is not {root}");
                // The bound does not include the rounding of the mean, 4 ε.
                assert!((nearest - root).norm() <= bound + 2e-15, "{nearest}, {root}: bound {bound}");
            }
        }
    }

    /// Symmetric functions off by their bounds, in every combination of signs: the bound of some computed root contains
    /// each true one, also where roots merge and move by the square or cube root of the error.
    #[test]
    fn bounds_hold_for_functions_off_by_theirs() {
        const ERROR: f64 = 1e-9;
        for offsets in [&[0.0, 0.0][..], &[-1e-4, 1e-4], &[-0.1, 0.1], &[0.0, 0.0, 0.0], &[-1e-3, 0.0, 1e-3]] {
            let exact: Vec<c64> = offsets.iter().map(|w| c64::new(-4.0 + w, 0.0)).collect();
            let functions = symmetric_functions(&exact);
            let errors = vec![ERROR; functions.len()];
            for signs in 0..1 << functions.len() {
                let off = |m: usize| if signs >> m & 1 == 1 { 0.99 * ERROR } else { -0.99 * ERROR };
                let moved: Vec<c64> = functions.iter().enumerate().map(|(m, f)| f + off(m)).collect();
                let mut out = [(c64::ZERO, 0.0); MAX_SIZE];
                roots(&moved, &errors, &mut out);
                let found = &out[..exact.len()];
                for root in &exact {
                    let held = found.iter().any(|(z, bound)| (z - root).norm() <= *bound);
                    assert!(held, "{root} of {offsets:?}, signs {signs:b}: {found:?}");
                }
            }
        }
    }
}
