//! Numbers as text for people.

/// A number with `digits` significant digits, plain where that is readable; a dash where it is not known.
pub fn significant(value: f64, digits: usize) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    if !value.is_finite() {
        return "-".to_owned();
    }
    let magnitude = value.abs().log10().floor();
    if (-4.0..digits as f64).contains(&magnitude) {
        let decimals = (digits as f64 - 1.0 - magnitude).max(0.0) as usize;
        format!("{value:.decimals$}")
    } else {
        format!("{value:.*e}", digits.saturating_sub(3))
    }
}

/// As [`significant`], and 0 for a value within the bound `error` of its own error: its digits are rounding noise.
pub fn above_error(value: f64, error: f64, digits: usize) -> String {
    if value.abs() <= error { "0".to_owned() } else { significant(value, digits) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_noise_is_zero_and_what_exceeds_its_bound_is_not() {
        assert_eq!(above_error(-1.7e-13, 2e-12, 5), "0");
        assert_eq!(above_error(-0.25, 2e-12, 5), "-0.25000");
        assert_eq!(above_error(1e-13, f64::NAN, 5), "1.00e-13", "without a bound every digit stands");
        assert_eq!(above_error(f64::NAN, 1.0, 5), "-");
    }
}
