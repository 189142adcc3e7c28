//! Identifies the contact stiffness from natural frequencies: the common factor on all contact pairs that fits
//! targets best.
//!
//! ```text
//! e_i(k) = f_i(k) / f_i* - 1,   rms(k) = sqrt(Σ e_i² / m) -> min
//! ```
//!
//! over the first `m` natural frequencies at rest, in ascending order like the targets. The curve over several
//! decades of `k` is kept. Its minimum is flat where the frequencies depend little on the stiffness. The sensitivity
//! measures this dependence:
//!
//! ```text
//! S = sqrt(Σ (d ln f_i / d ln k)² / m):   a relative error ε of the frequencies leaves k uncertain by about ε / S
//! ```
//!
//! Source: the paper's Figs. 12 and 13.
//!
//! Targets at several loads also determine how the stiffness follows the load: [`identify_exponent`] fits factor and
//! exponent by the method of Levenberg and Marquardt, with the standard error of the exponent from
//!
//! ```text
//! cov = rms² m / (m - 2) (Jᵀ J)⁻¹,   J = d ln f_i / d (ln factor, exponent)
//! ```

/// Search range on both sides of the present stiffness, in decades.
const DECADES: f64 = 4.0;
/// Points of the curve per decade.
const PER_DECADE: usize = 10;
/// Half step in `ln k` of the central difference for the sensitivity.
const SENSITIVITY_STEP: f64 = 0.01;
/// Final bracket width of the minimisation, in decades. A smooth minimum is only determined to half of the digits
/// anyway.
const BRACKET: f64 = 1e-9;
/// Precision of the ends of the range, relative to their distance from the minimum.
const RANGE_PRECISION: f64 = 1e-3;
/// Half step of the central differences by `ln factor` and exponent.
const SLOPE_STEP: f64 = 1e-4;
/// Change of `ln factor` and exponent at which they have converged.
const CONVERGED: f64 = 1e-9;
/// Damping of the first step of Levenberg and Marquardt's method, relative to the diagonal.
const FIRST_DAMPING: f64 = 1e-3;
/// Largest number of its steps.
const MOST_STEPS: usize = 60;
/// `(3 - sqrt 5) / 2`.
const GOLDEN: f64 = 0.381_966_011_250_105_1;

/// Errors of the frequencies for one stiffness.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// Factor on the stiffness of every pair.
    pub factor: f64,
    /// `f_i`, Hz, one for each target.
    pub frequencies_hz: Vec<f64>,
    /// Root mean square of `e_i`.
    pub rms_error: f64,
    /// Mean of `|e_i|`.
    pub mean_error: f64,
    /// Largest `|e_i|`.
    pub largest_error: f64,
}

/// The best stiffness and how well it is determined.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// The trial with the smallest root mean square error.
    pub best: Trial,
    /// Factors between which the error stays below twice its minimum; `None` where it does not reach that in the
    /// search range.
    pub doubled: [Option<f64>; 2],
    /// `S`: relative change of the frequencies per relative change of the stiffness.
    pub sensitivity: f64,
    /// The trials over the search range, ascending in the factor.
    pub curve: Vec<Trial>,
}

/// Why the stiffness could not be identified.
#[derive(Debug, PartialEq, thiserror::Error)]
pub enum IdentificationError<E> {
    /// The model has fewer natural frequencies than there are targets.
    #[error("{found} natural frequencies, expected at least the {expected} of the targets")]
    TooFew {
        /// The number found.
        found: usize,
        /// The number expected.
        expected: usize,
    },
    /// A target is no frequency.
    #[error("target {index} is {value} Hz, expected a finite frequency above 0")]
    Target {
        /// Index of the target.
        index: usize,
        /// The target, Hz.
        value: f64,
    },
    /// The error is smallest at the end of the search range, so there is no minimum in it.
    #[error("the error still falls at {factor:e} times the present stiffness, the end of the search")]
    AtTheEnd {
        /// Factor on the present stiffness at that end.
        factor: f64,
    },
    /// The frequencies do not determine the exponent.
    #[error("the targets do not determine the exponent of the load: the frequencies hardly depend on it")]
    Undetermined,
    /// The best exponent is at an end of its range.
    #[error("the error still falls at an exponent of {exponent}, the end of its range")]
    ExponentAtTheEnd {
        /// The exponent at that end.
        exponent: f64,
    },
    /// The exponent did not converge.
    #[error("the exponent has not converged after {steps} steps")]
    NoConvergence {
        /// Number of steps.
        steps: usize,
    },
    /// The natural frequencies could not be computed.
    #[error(transparent)]
    Model(#[from] E),
}

/// Finds the factor that fits `targets_hz`. `frequencies` returns the natural frequencies at rest for a factor, Hz, in the
/// order of the targets: ascending, one load after the other. Those beyond the targets are not used.
///
/// # Errors
/// [`IdentificationError`].
pub fn identify<E>(
    targets_hz: &[f64],
    frequencies: &mut dyn FnMut(f64) -> Result<Vec<f64>, E>,
) -> Result<Identified, IdentificationError<E>> {
    check(targets_hz)?;
    let mut trial = |exponent: f64| -> Result<Trial, IdentificationError<E>> {
        let factor = 10.0_f64.powf(exponent);
        let mut frequencies_hz = frequencies(factor)?;
        if frequencies_hz.len() < targets_hz.len() || targets_hz.is_empty() {
            let (found, expected) = (frequencies_hz.len(), targets_hz.len().max(1));
            return Err(IdentificationError::TooFew { found, expected });
        }
        frequencies_hz.truncate(targets_hz.len());
        let errors: Vec<f64> =
            frequencies_hz.iter().zip(targets_hz).map(|(f, target)| (f / target - 1.0).abs()).collect();
        let m = errors.len() as f64;
        Ok(Trial {
            factor,
            frequencies_hz,
            rms_error: (errors.iter().map(|e| e * e).sum::<f64>() / m).sqrt(),
            mean_error: errors.iter().sum::<f64>() / m,
            largest_error: errors.iter().copied().fold(0.0, f64::max),
        })
    };
    let step = 1.0 / PER_DECADE as f64;
    let count = (2.0 * DECADES / step).round() as usize;
    let exponent = |index: usize| -DECADES + step * index as f64;
    let curve = (0..=count).map(|index| trial(exponent(index))).collect::<Result<Vec<_>, _>>()?;
    let lowest = (0..=count).min_by(|&a, &b| curve[a].rms_error.total_cmp(&curve[b].rms_error)).unwrap_or(0);
    if lowest == 0 || lowest == count {
        return Err(IdentificationError::AtTheEnd { factor: curve[lowest].factor });
    }
    // Golden-section search between the neighbours of the lowest point.
    let (mut low, mut high) = (exponent(lowest - 1), exponent(lowest + 1));
    let mut best = (exponent(lowest), curve[lowest].clone());
    while high - low > BRACKET {
        let at = if high - best.0 > best.0 - low {
            best.0 + GOLDEN * (high - best.0)
        } else {
            best.0 - GOLDEN * (best.0 - low)
        };
        let tried = trial(at)?;
        let end = if tried.rms_error < best.1.rms_error { std::mem::replace(&mut best, (at, tried)).0 } else { at };
        if end < best.0 { low = end } else { high = end }
    }
    let (at, best) = best;
    let limit = 2.0 * best.rms_error;
    let mut crossing = |beyond: Option<usize>| -> Result<Option<f64>, IdentificationError<E>> {
        let Some(beyond) = beyond else { return Ok(None) };
        let (mut inside, mut outside) = (at, exponent(beyond));
        while (outside - inside).abs() > (RANGE_PRECISION * (inside - at).abs()).max(BRACKET) {
            let middle = 0.5 * (inside + outside);
            if trial(middle)?.rms_error > limit { outside = middle } else { inside = middle }
        }
        Ok(Some(10.0_f64.powf(inside)))
    };
    let above = |index: &usize| curve[*index].rms_error > limit;
    let doubled = [
        crossing((0..=count).rev().filter(|&index| exponent(index) < at).find(above))?,
        crossing((0..=count).filter(|&index| exponent(index) > at).find(above))?,
    ];
    let sensitivity = {
        let step = SENSITIVITY_STEP / std::f64::consts::LN_10;
        let (softer, stiffer) = (trial(at - step)?, trial(at + step)?);
        let moved = stiffer.frequencies_hz.iter().zip(&softer.frequencies_hz);
        let squares = moved.map(|(stiff, soft)| ((stiff / soft).ln() / (2.0 * SENSITIVITY_STEP)).powi(2));
        (squares.sum::<f64>() / targets_hz.len() as f64).sqrt()
    };
    Ok(Identified { best, doubled, sensitivity, curve })
}

fn check<E>(targets_hz: &[f64]) -> Result<(), IdentificationError<E>> {
    let wrong = |(_, value): &(usize, &f64)| !value.is_finite() || **value <= 0.0;
    match targets_hz.iter().enumerate().find(wrong) {
        Some((index, &value)) => Err(IdentificationError::Target { index, value }),
        None => Ok(()),
    }
}

/// Factor on the stiffness and exponent of the load that fit best.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IdentifiedExponent {
    /// Factor on the stiffness of every pair.
    pub factor: f64,
    /// Exponent of the load.
    pub exponent: f64,
    /// Standard error of the exponent; `None` with fewer than three targets.
    pub exponent_standard_error: Option<f64>,
    /// Root mean square of `ln(f_i / f_i*)`.
    pub rms_error: f64,
}

/// Finds factor and exponent that fit `targets_hz` best, from `start`, an exponent in `range` with the factor that fits it.
/// `frequencies` returns the natural frequencies for a factor and an exponent, as for [`identify`].
///
/// # Errors
/// [`IdentificationError`].
pub fn identify_exponent<E>(
    targets_hz: &[f64],
    start: (f64, f64),
    range: [f64; 2],
    frequencies: &mut dyn FnMut(f64, f64) -> Result<Vec<f64>, E>,
) -> Result<IdentifiedExponent, IdentificationError<E>> {
    check(targets_hz)?;
    let m = targets_hz.len();
    let mut errors = |[ln_factor, exponent]: [f64; 2]| -> Result<Vec<f64>, IdentificationError<E>> {
        let found = frequencies(ln_factor.exp(), exponent)?;
        if found.len() < m || m < 2 {
            return Err(IdentificationError::TooFew { found: found.len(), expected: m.max(2) });
        }
        Ok(found.iter().zip(targets_hz).map(|(f, target)| (f / target).ln()).collect())
    };
    let sum = |errors: &[f64]| errors.iter().map(|e| e * e).sum::<f64>();
    let mut at = [start.0.ln(), start.1.clamp(range[0], range[1])];
    let mut here = errors(at)?;
    let mut damping = FIRST_DAMPING;
    for _ in 0..MOST_STEPS {
        let [a, b] = slopes(at, range, &mut errors)?;
        let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
        let (aa, ab, bb) = (dot(&a, &a), dot(&a, &b), dot(&b, &b));
        let determinant = aa * bb - ab * ab;
        // Slopes are accurate to about the square of their step.
        if aa.is_nan() || bb.is_nan() || determinant <= SLOPE_STEP * SLOPE_STEP * aa * bb {
            return Err(IdentificationError::Undetermined);
        }
        let (ga, gb) = (dot(&a, &here), dot(&b, &here));
        let (da, db) = (aa * (1.0 + damping), bb * (1.0 + damping));
        let scale = da * db - ab * ab;
        let step = [(ab * gb - db * ga) / scale, (ab * ga - da * gb) / scale];
        let next = [at[0] + step[0], (at[1] + step[1]).clamp(range[0], range[1])];
        let moved = (next[0] - at[0]).abs().max((next[1] - at[1]).abs());
        let there = errors(next)?;
        let better = sum(&there) < sum(&here);
        if better {
            (at, here) = (next, there);
            damping *= 0.1;
        } else {
            damping *= 10.0;
        }
        if moved < CONVERGED {
            if range.contains(&at[1]) {
                return Err(IdentificationError::ExponentAtTheEnd { exponent: at[1] });
            }
            let variance = (m > 2).then(|| sum(&here) / (m - 2) as f64 * aa / determinant);
            return Ok(IdentifiedExponent {
                factor: at[0].exp(),
                exponent: at[1],
                exponent_standard_error: variance.map(f64::sqrt),
                rms_error: (sum(&here) / m as f64).sqrt(),
            });
        }
    }
    Err(IdentificationError::NoConvergence { steps: MOST_STEPS })
}

/// Derivatives of the errors by the logarithm of the factor and by the exponent: central differences, within the range.
fn slopes<E>(
    at: [f64; 2],
    range: [f64; 2],
    errors: &mut dyn FnMut([f64; 2]) -> Result<Vec<f64>, IdentificationError<E>>,
) -> Result<[Vec<f64>; 2], IdentificationError<E>> {
    let mut between = |low: [f64; 2], high: [f64; 2], width: f64| -> Result<Vec<f64>, IdentificationError<E>> {
        let (low, high) = (errors(low)?, errors(high)?);
        Ok(high.iter().zip(&low).map(|(high, low)| (high - low) / width).collect())
    };
    let of_factor = between([at[0] - SLOPE_STEP, at[1]], [at[0] + SLOPE_STEP, at[1]], 2.0 * SLOPE_STEP)?;
    let [low, high] = [at[1] - SLOPE_STEP, at[1] + SLOPE_STEP].map(|exponent| exponent.clamp(range[0], range[1]));
    Ok([of_factor, between([at[0], low], [at[0], high], high - low)?])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::convert::Infallible;

    /// Two masses on springs of 1 and 4, joined by a spring of 3 times the factor: `f²` are the eigenvalues of a 2x2
    /// matrix.
    fn pair(factor: f64) -> Result<Vec<f64>, Infallible> {
        let k = 3.0 * factor;
        let (mean, half) = (2.5 + k, (1.5_f64.powi(2) + k * k).sqrt());
        Ok(vec![(mean - half).sqrt(), (mean + half).sqrt()])
    }

    #[test]
    fn the_stiffness_that_made_the_targets_is_found() {
        let targets = pair(7.3).unwrap();
        let found = identify(&targets, &mut pair).unwrap();
        // The error falls linearly to 0 here, so the accuracy is that of the final bracket and of rounding, 1e-16, in
        // the frequencies.
        assert!((found.best.factor / 7.3 - 1.0).abs() < 1e-6, "{}", found.best.factor);
        assert!(found.best.rms_error < 1e-7 && found.curve.len() == 81);
        // Closed form of `d ln f / d ln k` for `f² = 2.5 + k ∓ sqrt(1.5² + k²)`. Differences with a step of 1 % are
        // accurate to its square.
        let k = 3.0_f64 * 7.3;
        let root = (2.25 + k * k).sqrt();
        let slope = |sign: f64| 0.5 * k * (1.0 + sign * k / root) / (2.5 + k + sign * root);
        let expected = ((slope(-1.0).powi(2) + slope(1.0).powi(2)) / 2.0).sqrt();
        assert!((found.sensitivity / expected - 1.0).abs() < 1e-4, "{} {expected}", found.sensitivity);
    }

    #[test]
    fn a_compromise_is_the_least_of_all_and_its_range_doubles_the_error() {
        let targets = [pair(2.0).unwrap()[0], pair(3.0).unwrap()[1]];
        let rms = |factor: f64| {
            let found = pair(factor).unwrap();
            found.iter().zip(&targets).map(|(f, t)| (f / t - 1.0).powi(2) / 2.0).sum::<f64>().sqrt()
        };
        let found = identify(&targets, &mut pair).unwrap();
        let best = found.best.factor;
        assert!((2.0..3.0).contains(&best), "{best}");
        assert!((1..4000).all(|k| rms(1e-3 * f64::from(k)) >= found.best.rms_error * (1.0 - 1e-9)));
        for end in found.doubled.map(Option::unwrap) {
            assert!((rms(end) / found.best.rms_error - 2.0).abs() < 0.01, "{end}");
        }
        assert!(found.doubled[0].unwrap() < best && best < found.doubled[1].unwrap());
    }

    #[test]
    fn unsuitable_targets_are_errors() {
        let stiff = [1.58, 2e4];
        assert_eq!(identify(&stiff, &mut pair), Err(IdentificationError::AtTheEnd { factor: 1e4 }));
        assert_eq!(identify(&[1.0; 3], &mut pair), Err(IdentificationError::TooFew { found: 2, expected: 3 }));
        let negative = [2.0, -1.0];
        assert_eq!(identify(&negative, &mut pair), Err(IdentificationError::Target { index: 1, value: -1.0 }));
    }

    /// Frequencies of the pair at three loads, with a stiffness that follows the load by an exponent.
    fn at_loads(factor: f64, exponent: f64) -> Result<Vec<f64>, Infallible> {
        Ok([0.2_f64, 1.0, 4.0].iter().flat_map(|load| pair(factor * load.powf(exponent)).unwrap()).collect())
    }

    #[test]
    fn the_exponent_that_made_the_targets_is_found() {
        let targets = at_loads(2.5, 0.4).unwrap();
        let found = identify_exponent(&targets, (1.0, 0.0), [-1.0, 2.0], &mut at_loads).unwrap();
        assert!((found.factor / 2.5 - 1.0).abs() < 1e-8 && (found.exponent - 0.4).abs() < 1e-8, "{found:?}");
        assert!(found.rms_error < 1e-9 && found.exponent_standard_error.unwrap() < 1e-8);
        let end = identify_exponent(&targets, (1.0, 0.0), [-0.3, 0.3], &mut at_loads);
        assert_eq!(end, Err(IdentificationError::ExponentAtTheEnd { exponent: 0.3 }));
    }

    /// With errors of one size and both signs the standard error is that of linear regression.
    #[test]
    fn the_standard_error_is_that_of_a_regression() {
        // f = factor * load^exponent is linear in the logarithms.
        let mut power = |factor: f64, exponent: f64| -> Result<Vec<f64>, Infallible> {
            Ok([1.0_f64, 2.0, 4.0, 8.0].iter().map(|load| factor * load.powf(exponent)).collect())
        };
        let off = 1e-3;
        let targets: Vec<f64> = power(3.0, 0.5)
            .unwrap()
            .iter()
            .zip([off, -off, -off, off])
            .map(|(f, e): (&f64, f64)| f * e.exp())
            .collect();
        let found = identify_exponent(&targets, (3.0, 0.0), [-1.0, 2.0], &mut power).unwrap();
        // The errors are orthogonal to 1 and to ln load: sum of squares 4 off², Σ (x - mean)² = 5 ln²2.
        let expected = (4.0 * off * off / 2.0 / 5.0).sqrt() / std::f64::consts::LN_2;
        assert!((found.exponent - 0.5).abs() < 1e-8, "{found:?}");
        assert!((found.exponent_standard_error.unwrap() / expected - 1.0).abs() < 1e-6, "{found:?} {expected}");
    }

    #[test]
    fn targets_at_one_load_do_not_determine_the_exponent() {
        let mut at_one = |factor: f64, exponent: f64| pair(factor * 4.0_f64.powf(exponent));
        let targets = at_one(2.0, 0.3).unwrap();
        let found = identify_exponent(&targets, (1.0, 0.0), [-1.0, 2.0], &mut at_one);
        assert_eq!(found, Err(IdentificationError::Undetermined));
    }
}
