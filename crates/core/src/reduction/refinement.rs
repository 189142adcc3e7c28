//! Iterative refinement of solves with an approximate factor.
//!
//! ```text
//! x ← F⁻¹ b;   r = b - A x,   d = F⁻¹ r,   x ← x + d
//! ```
//!
//! `F` is `A` with the rounding errors of single precision. The error of `x` falls by the same ratio with every step, until
//! the rounding errors of `r` in double precision are left: `x` is then as good as that of a factor in double precision.
//!
//! Source: Higham, "Accuracy and stability of numerical algorithms" (2002), chapter 12; Langou et al., "Exploiting the
//! performance of 32 bit floating point arithmetic in obtaining 64 bit accuracy", SC'06 (2006).

use faer::{Mat, MatRef};

use super::krylov::Number;

/// The error to reach, relative to that of a solve without refinement: 256 times the ratio of the rounding errors of double
/// and of single precision. An entry of the factor is rounded once, but one of `r` is a sum of hundreds of products.
const GAIN: f64 = 256.0 * f64::EPSILON / f32::EPSILON as f64;
/// Largest ratio of two corrections, one after the other. Above it, the factor is too far from the matrix.
const SLOWEST: f64 = 0.25;

/// A solve whose corrections do not shrink.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stalled {
    /// `|d| / |x|`.
    pub(super) correction: f64,
    /// The last correction relative to the one before it.
    pub(super) ratio: f64,
}

impl Stalled {
    /// What happened, for an error.
    pub(super) fn reason(self) -> String {
        let Self { correction, ratio } = self;
        format!(
            "a factor in single precision is too inaccurate: a correction of {correction:.1e} is {ratio:.1e} of the one \
             before it, limit {SLOWEST}; with more memory, factors are kept in double precision"
        )
    }
}

/// `A⁻¹ B`, where `solve` returns `F⁻¹ R` and `times` returns `A X`.
///
/// The corrections shrink by `ρ` at each step, so that `ρ |d|` of error is left after the last one. The steps end once that
/// is at most [`GAIN`] times the first correction, in every column.
///
/// # Errors
/// [`Stalled`] if corrections shrink by less than [`SLOWEST`] before that, or are not finite.
pub(super) fn refined<T: Number>(
    b: MatRef<'_, T>,
    times: impl Fn(MatRef<'_, T>) -> Mat<T>,
    solve: impl Fn(MatRef<'_, T>) -> Mat<T>,
) -> Result<Mat<T>, Stalled> {
    let mut x = solve(b);
    // Of each column, relative to `x`. The whole of `x` is a correction of 0.
    let (mut first, mut before) = (vec![], vec![1.0; b.ncols()]);
    loop {
        let d = solve((b - times(x.as_ref())).as_ref());
        x += &d;
        let relative = |column: usize| match d.col(column).norm_l2() {
            0.0 => 0.0,
            size => size / x.col(column).norm_l2(),
        };
        let now: Vec<f64> = (0..b.ncols()).map(relative).collect();
        if first.is_empty() {
            first.clone_from(&now);
        }
        // `min` makes infinity of what is not a number.
        let ratio = |column: usize| (now[column] / before[column]).min(f64::INFINITY);
        let left = |column: usize| ratio(column).min(1.0) * now[column];
        let done = |column: usize| now[column] == 0.0 || left(column) <= GAIN * first[column];
        let open = (0..b.ncols()).filter(|&column| !done(column));
        let slowest = open.max_by(|&a, &b| ratio(a).total_cmp(&ratio(b)));
        let Some(slowest) = slowest else { return Ok(x) };
        if ratio(slowest) > SLOWEST {
            return Err(Stalled { correction: now[slowest], ratio: ratio(slowest) });
        }
        before = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `A` is diagonal; `F` differs from it by at most `error` of each entry.
    fn solved(error: f64) -> (Result<Mat<f64>, Stalled>, Mat<f64>, usize) {
        let n = 50;
        let a = |i: usize| 10.0_f64.powi(i as i32 % 9);
        let f = |i: usize| a(i) * (1.0 + error * (i as f64).sin());
        // A column of zeros has the solution 0.
        let b = Mat::from_fn(n, 3, |i, j| if j == 1 { 0.0 } else { a(i) * (1.0 + (i * (j + 2)) as f64).cos() });
        let divided = |x: MatRef<'_, f64>, by: &dyn Fn(usize) -> f64| Mat::from_fn(n, 3, |i, j| x[(i, j)] / by(i));
        let solves = std::cell::Cell::new(0);
        let found = refined(
            b.as_ref(),
            |x| Mat::from_fn(n, 3, |i, j| a(i) * x[(i, j)]),
            |r| {
                solves.set(solves.get() + 1);
                divided(r, &f)
            },
        );
        (found, divided(b.as_ref(), &a), solves.get())
    }

    /// The error falls by `ρ`, at most `error / (1 - error)`, with every solve; `ρ^k ≤ 2^-21` for a solve and `k` corrections.
    #[test]
    fn solves_are_refined_to_double_precision() {
        for error in [1e-3, 1e-2, 0.1] {
            let (found, expected, solves) = solved(error);
            let corrections = (GAIN.ln() / (error / (1.0 - error)).ln()).ceil() as usize;
            assert!(solves <= 2 + corrections, "{error}: {solves}");
            let error_left = (found.unwrap() - &expected).norm_max() / expected.norm_max();
            assert!(error_left < 2.0 * GAIN * error, "{error}: {error_left:e}");
        }
    }

    #[test]
    fn a_factor_too_far_from_the_matrix_is_refused() {
        for error in [0.5, 3.0, f64::NAN] {
            let stalled = solved(error).0.unwrap_err();
            assert!(stalled.ratio > SLOWEST, "{error}: {stalled:?}");
        }
        assert!(solved(0.5).0.unwrap_err().reason().contains("in single precision is too inaccurate"));
    }
}
