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

/// The ratio of the rounding errors of double and of single precision. A correction `d` at most this small, relative to `x`, leaves a
/// residual of at most `|A - F| |d|`, about `2^-23 |A| · 2^-29 |x| = ε |A| |x|`: that of a solve in double precision.
const FLOOR: f64 = f64::EPSILON / f32::EPSILON as f64;
/// The error to reach, relative to that of a solve without refinement. An entry of the factor is rounded once, but one of `r`
/// is a sum of hundreds of products.
const GAIN: f64 = 256.0 * FLOOR;
/// Largest ratio of a correction to the one before it. Above it, the factor is too far from the matrix.
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
/// is at most [`GAIN`] times the first correction, in every column, or rounding errors of `r` keep corrections from shrinking.
///
/// # Errors
/// [`Stalled`] if larger corrections shrink by less than [`SLOWEST`], or are not finite.
pub(super) fn refined<T: Number>(
    b: MatRef<'_, T>,
    times: impl Fn(MatRef<'_, T>) -> Mat<T>,
    solve: impl Fn(MatRef<'_, T>) -> Mat<T>,
) -> Result<Mat<T>, Stalled> {
    let mut x = solve(b);
    // Sizes of corrections relative to `x`, by column. `x` itself counts as the one before the first, with size 1.
    let (mut first, mut before) = (vec![], vec![1.0; b.ncols()]);
    let mut open: Vec<usize> = (0..b.ncols()).collect();
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
        let done = |column: usize| {
            let (ratio, now, first) = (ratio(column), now[column], first[column]);
            now == 0.0 || ratio * now <= GAIN * first || (ratio > SLOWEST && now <= FLOOR)
        };
        // What follows in a finished column are rounding errors of `r`, which do not shrink.
        open.retain(|&column| !done(column));
        let slowest = open.iter().copied().max_by(|&a, &b| ratio(a).total_cmp(&ratio(b)));
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

    /// `A` is diagonal. `F` differs from it by at most `errors` of each entry, one for each column, and products with `A` have other
    /// errors of at most `rounding` each time.
    fn solved(errors: [f64; 3], rounding: f64) -> (Result<Mat<f64>, Stalled>, Mat<f64>, usize) {
        let n = 50;
        let a = |i: usize| 10.0_f64.powi(i as i32 % 9);
        let f = |i: usize, j: usize| a(i) * (1.0 + errors[j] * (i as f64).sin());
        // A column of zeros has the solution 0.
        let b = Mat::from_fn(n, 3, |i, j| if j == 1 { 0.0 } else { a(i) * (1.0 + (i * (j + 2)) as f64).cos() });
        let solves = std::cell::Cell::new(0);
        let found = refined(
            b.as_ref(),
            |x| {
                let seed = n * solves.get();
                Mat::from_fn(n, 3, |i, j| a(i) * x[(i, j)] * (1.0 + rounding * ((seed + i) as f64).cos()))
            },
            |r| {
                solves.set(solves.get() + 1);
                Mat::from_fn(n, 3, |i, j| r[(i, j)] / f(i, j))
            },
        );
        (found, Mat::from_fn(n, 3, |i, j| b[(i, j)] / a(i)), solves.get())
    }

    /// The error falls by `ρ`, at most `error / (1 - error)`, with every solve; `ρ^k ≤ 2^-21` for a solve and `k` corrections.
    #[test]
    fn solves_are_refined_to_double_precision() {
        for error in [1e-3, 1e-2, 0.1] {
            let (found, expected, solves) = solved([error; 3], 0.0);
            let corrections = (GAIN.ln() / (error / (1.0 - error)).ln()).ceil() as usize;
            assert!(solves <= 2 + corrections, "{error}: {solves}");
            let error_left = (found.unwrap() - &expected).norm_max() / expected.norm_max();
            assert!(error_left < 2.0 * GAIN * error, "{error}: {error_left:e}");
        }
    }

    /// Corrections of rounding errors end the steps if they are below 2^-29, and are refused above it. Those of a finished column
    /// do not matter while another is refined.
    #[test]
    fn refinement_ends_at_the_rounding_errors_of_the_residual() {
        for errors in [[1e-6; 3], [1e-7, 0.0, 1e-2]] {
            let rounding = if errors[2] == 1e-2 { 3e-8 } else { 5e-9 };
            let (found, expected, solves) = solved(errors, rounding);
            let error = (found.unwrap() - &expected).norm_max() / expected.norm_max();
            assert!(error < 2.0 * rounding && solves >= 4, "{errors:?}: {error:e} after {solves}");
        }
        let stalled = solved([1e-6; 3], 2e-8).0.unwrap_err();
        assert!(stalled.correction > FLOOR && stalled.ratio > SLOWEST, "{stalled:?}");
    }

    #[test]
    fn a_factor_too_far_from_the_matrix_is_refused() {
        for error in [0.5, 3.0, f64::NAN] {
            let stalled = solved([error; 3], 0.0).0.unwrap_err();
            assert!(stalled.ratio > SLOWEST, "{error}: {stalled:?}");
        }
        assert!(solved([0.5; 3], 0.0).0.unwrap_err().reason().contains("in single precision is too inaccurate"));
    }
}
