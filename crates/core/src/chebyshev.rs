//! Chebyshev polynomials of one variable, `T_k(cos θ) = cos kθ`.

/// Maximum number of polynomials in the expansion of a function of one variable.
pub const MOST_DEGREES: usize = 32;

/// Chebyshev points of the first kind in `[-1, 1]`, `cos(π (2k + 1) / 2m)`.
pub fn nodes(m: usize) -> Vec<f64> {
    (0..m).map(|k| (std::f64::consts::PI * (2 * k + 1) as f64 / (2 * m) as f64).cos()).collect()
}

/// Coefficients of the interpolating polynomial through `values` at as many [`nodes`].
pub fn coefficients(values: &[f64]) -> Vec<f64> {
    let m = values.len();
    let cosine =
        |degree: usize, k: usize| (std::f64::consts::PI * (degree * (2 * k + 1)) as f64 / (2 * m) as f64).cos();
    let weight = |degree: usize| if degree == 0 { 1.0 } else { 2.0 } / m as f64;
    let sum = |degree: usize| values.iter().enumerate().map(|(k, value)| cosine(degree, k) * value).sum::<f64>();
    (0..m).map(|degree| weight(degree) * sum(degree)).collect()
}

/// Replaces values by [`coefficients`]: grids of `count` [`nodes`] along each of `axes` axes, the first axis running fastest,
/// one grid after the other.
pub fn transform(values: &mut [f64], count: usize, axes: usize) {
    for axis in 0..axes {
        let stride = count.pow(axis as u32);
        for start in (0..values.len()).filter(|index| (index / stride).is_multiple_of(count)) {
            let line: Vec<f64> = (0..count).map(|k| values[start + k * stride]).collect();
            for (k, coefficient) in coefficients(&line).into_iter().enumerate() {
                values[start + k * stride] = coefficient;
            }
        }
    }
}

/// Writes `T_0(x), T_1(x), ..` to `out`.
pub fn polynomials(x: f64, out: &mut [f64]) {
    for k in 0..out.len() {
        out[k] = match k {
            0 => 1.0,
            1 => x,
            _ => 2.0 * x * out[k - 1] - out[k - 2],
        };
    }
}

/// `x T_k(x / range)`; NaN beyond the range, where the expansion is not valid. A margin of 1e-3 allows differences
/// across the end of the range.
pub fn odd_at_zero(x: f64, degree: usize, range: f64) -> f64 {
    let scaled = x / range;
    if scaled.abs() > 1.0 + 1e-3 {
        return f64::NAN;
    }
    let mut values = [0.0; MOST_DEGREES];
    polynomials(scaled, &mut values[..=degree]);
    x * values[degree]
}

/// Derivative of [`odd_at_zero`] with respect to `x`: `T_k(y) + k y U_{k-1}(y)`, `y = x / range`.
pub fn odd_at_zero_slope(x: f64, degree: usize, range: f64) -> f64 {
    let y = x / range;
    if y.abs() > 1.0 + 1e-3 {
        return f64::NAN;
    }
    // `T` and `U` up to the present degree: `U_k = y U_{k-1} + T_k`.
    let (mut before, mut t, mut u) = (y, 1.0, 0.0);
    for _ in 0..degree {
        u = y * u + t;
        (before, t) = (t, 2.0 * y * t - before);
    }
    t + degree as f64 * y * u
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Central differences with step `h` have errors of `h² f'''/6`, below 1e-7 here.
    #[test]
    fn slopes_are_those_of_differences() {
        for degree in 0..6 {
            for x in [-1.7, -0.3, 0.0, 0.9, 1.99] {
                let [up, down] = [x + 1e-5, x - 1e-5].map(|x| odd_at_zero(x, degree, 2.0));
                let slope = odd_at_zero_slope(x, degree, 2.0);
                assert!((slope - (up - down) / 2e-5).abs() < 1e-6, "{degree} {x}: {slope}");
            }
        }
    }
}
