//! Tensor Chebyshev interpolation on a box.

/// Polynomials a smooth function of one variable is expanded in at most.
pub const MOST_DEGREES: usize = 32;

/// Nodes per axis by the number of axes: fewer where their number is a power.
pub fn nodes_per_axis(axes: usize) -> usize {
    match axes {
        0 | 1 => 17,
        2 => 9,
        _ => 7,
    }
}

/// Chebyshev points of the first kind in `[-1, 1]`, `cos(π (2k + 1) / 2m)`.
pub fn nodes(m: usize) -> Vec<f64> {
    (0..m).map(|k| (std::f64::consts::PI * (2 * k + 1) as f64 / (2 * m) as f64).cos()).collect()
}

/// `T_0(x) .. T_{m-1}(x)` into `out`.
pub fn polynomials(x: f64, out: &mut [f64]) {
    for k in 0..out.len() {
        out[k] = match k {
            0 => 1.0,
            1 => x,
            _ => 2.0 * x * out[k - 1] - out[k - 2],
        };
    }
}

/// `x T_k(x / range)`; not a number beyond the range, where the expansion it belongs to means nothing. Differences
/// across the end are still taken.
pub fn beside_zero(x: f64, degree: usize, range: f64) -> f64 {
    let scaled = x / range;
    if scaled.abs() > 1.0 + 1e-4 {
        return f64::NAN;
    }
    let mut values = [0.0; MOST_DEGREES];
    polynomials(scaled, &mut values[..=degree]);
    x * values[degree]
}

/// Derivative of [`beside_zero`] with respect to `x`: `T_k(y) + k y U_{k-1}(y)`, `y = x / range`.
pub fn beside_zero_slope(x: f64, degree: usize, range: f64) -> f64 {
    let y = x / range;
    if y.abs() > 1.0 + 1e-4 {
        return f64::NAN;
    }
    // T and U of the degrees so far: U_k = y U_{k-1} + T_k.
    let (mut before, mut t, mut u) = (y, 1.0, 0.0);
    for _ in 0..degree {
        u = y * u + t;
        (before, t) = (t, 2.0 * y * t - before);
    }
    t + degree as f64 * y * u
}

/// Coefficients of the interpolant through `values` at the tensor nodes of `axes` axes with `m` nodes each, axis 0
/// fastest; in place, value by value of the first axis turned into coefficient by coefficient, then the next axis.
pub fn coefficients(values: &mut [f64], m: usize, axes: usize) {
    let transform: Vec<f64> = (0..m)
        .flat_map(|degree| {
            let weight = if degree == 0 { 1.0 } else { 2.0 } / m as f64;
            (0..m).map(move |k| weight * (std::f64::consts::PI * (degree * (2 * k + 1)) as f64 / (2 * m) as f64).cos())
        })
        .collect();
    let mut line = vec![0.0; m];
    for axis in 0..axes {
        let stride = m.pow(axis as u32);
        for start in (0..values.len()).filter(|start| (start / stride).is_multiple_of(m)) {
            for (k, slot) in line.iter_mut().enumerate() {
                *slot = values[start + k * stride];
            }
            for degree in 0..m {
                let row = &transform[degree * m..(degree + 1) * m];
                values[start + degree * stride] = row.iter().zip(&line).map(|(t, v)| t * v).sum();
            }
        }
    }
}

/// The degree along each axis of the coefficient at `index`.
pub fn degrees(index: usize, m: usize, axes: usize) -> impl Iterator<Item = usize> {
    (0..axes).map(move |axis| index / m.pow(axis as u32) % m)
}

/// What interpolation leaves out, estimated from coefficients that fall off geometrically: the sum of those of the two
/// highest degrees along each axis; and the axis that contributes most.
pub fn tail(coefficients: &[f64], m: usize, axes: usize) -> (f64, usize) {
    let mut by_axis = vec![0.0; axes.max(1)];
    for (index, value) in coefficients.iter().enumerate() {
        for (axis, degree) in degrees(index, m, axes).enumerate() {
            if degree + 2 >= m {
                by_axis[axis] += value.abs();
            }
        }
    }
    let worst = (0..by_axis.len()).max_by(|&a, &b| by_axis[a].total_cmp(&by_axis[b])).unwrap_or(0);
    (by_axis.iter().sum(), worst)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Central differences of step h err by h² f'''/6, below 1e-7 here.
    #[test]
    fn slopes_are_those_of_differences() {
        for degree in 0..6 {
            for x in [-1.7, -0.3, 0.0, 0.9, 1.99] {
                let [up, down] = [x + 1e-5, x - 1e-5].map(|x| beside_zero(x, degree, 2.0));
                let slope = beside_zero_slope(x, degree, 2.0);
                assert!((slope - (up - down) / 2e-5).abs() < 1e-6, "{degree} {x}: {slope}");
            }
        }
    }

    /// An analytic function of two variables, interpolated and evaluated elsewhere.
    #[test]
    fn interpolates_in_two_variables() {
        let f = |x: f64, y: f64| (0.7 * x - 0.3 * y).exp() / (3.0 + x * y);
        let m = 16;
        let points = nodes(m);
        let mut values: Vec<f64> = (0..m * m).map(|k| f(points[k % m], points[k / m])).collect();
        coefficients(&mut values, m, 2);
        let (mut tx, mut ty) = (vec![0.0; m], vec![0.0; m]);
        for (x, y) in [(0.3, -0.8), (-0.99, 0.99), (0.0, 0.5)] {
            polynomials(x, &mut tx);
            polynomials(y, &mut ty);
            let sum: f64 = (0..m * m).map(|k| values[k] * tx[k % m] * ty[k / m]).sum();
            // The interpolant converges like (3 + √8)^-m, about 1e-12.
            assert!((sum - f(x, y)).abs() < 1e-11, "{sum} is not {}", f(x, y));
        }
        assert!(tail(&values, m, 2).0 < 1e-9);
    }
}
