//! Numbers as text for people.

use std::fmt;

/// A number with so many significant digits, plain where that is readable, `-` where it is not known.
#[derive(Clone, Copy, Debug)]
pub struct Significant(pub f64, pub usize);

impl fmt::Display for Significant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(value, digits) = *self;
        if value == 0.0 {
            return f.write_str("0");
        }
        if !value.is_finite() {
            return f.write_str("-");
        }
        let magnitude = value.abs().log10().floor();
        if (-4.0..digits as f64).contains(&magnitude) {
            let decimals = (digits as f64 - 1.0 - magnitude).max(0.0) as usize;
            write!(f, "{value:.decimals$}")
        } else {
            write!(f, "{value:.*e}", digits.saturating_sub(3))
        }
    }
}

/// [`Significant`] as a string.
pub fn significant(value: f64, digits: usize) -> String {
    Significant(value, digits).to_string()
}

/// As [`significant`], and 0 for a value within the bound `error` of its own error: its digits are rounding noise.
pub fn above_error(value: f64, error: f64, digits: usize) -> String {
    if value.abs() <= error { "0".to_owned() } else { significant(value, digits) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_those_that_are_asked_for() {
        let cases = [(739.812647, 5, "739.81"), (-0.000512, 3, "-0.000512"), (1.5e-7, 4, "1.5e-7"), (f64::NAN, 3, "-")];
        for (value, digits, text) in cases {
            assert_eq!(Significant(value, digits).to_string(), text);
        }
    }

    #[test]
    fn values_within_their_rounding_bound_are_shown_as_zero() {
        assert_eq!(above_error(-1.7e-13, 2e-12, 5), "0");
        assert_eq!(above_error(-0.25, 2e-12, 5), "-0.25000");
        assert_eq!(above_error(1e-13, f64::NAN, 5), "1.00e-13", "without a bound every digit is shown");
        assert_eq!(above_error(f64::NAN, 1.0, 5), "-");
    }
}
