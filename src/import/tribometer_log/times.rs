//! Converts times of a log to ns since the epoch.

use jiff::civil::DateTime;

/// A decimal number of units of `unit_ns`, in ns. Exact, whereas `f64` would lose the nanoseconds of times since the
/// epoch.
pub fn decimal_ns(text: &str, unit_ns: i64) -> Option<i64> {
    if text.contains(['e', 'E']) {
        let ns = (text.parse::<f64>().ok()? * unit_ns as f64).round();
        return (ns.abs() < i64::MAX as f64).then_some(ns as i64);
    }
    let (negative, digits) = match text.strip_prefix('-') {
        Some(digits) => (true, digits),
        None => (false, text.trim_start_matches('+')),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let whole: i128 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
    let fraction = fraction.get(..fraction.len().min(18))?;
    let parts: i128 = if fraction.is_empty() { 0 } else { fraction.parse().ok()? };
    let scale = 10_i128.checked_pow(u32::try_from(fraction.len()).ok()?)?;
    let unit = i128::from(unit_ns);
    let ns = whole.checked_mul(unit)?.checked_add((parts * unit + scale / 2) / scale)?;
    i64::try_from(if negative { -ns } else { ns }).ok()
}

/// Whether `builtin_interfaces/Time` can represent a time, with its `int32` seconds. Times before 1970 are mistakes.
pub fn is_stamp(ns: &i64) -> bool {
    (0..(1 << 31) * 1_000_000_000).contains(ns)
}

/// A date and time in ns since the epoch: ISO 8601, or day, month and year separated by points; UTC if no offset is
/// given. Dates with slashes are refused, since the order of day and month differs between countries.
pub fn date_ns(cell: &str) -> Option<i64> {
    let text = cell.trim().replacen(',', ".", 1);
    let with_points = || {
        let formats = ["%d.%m.%Y %H:%M:%S%.f", "%d.%m.%YT%H:%M:%S%.f", "%d.%m.%Y %H:%M"];
        formats.iter().find_map(|format| DateTime::strptime(format, &text).ok())
    };
    let stamp = match text.parse::<jiff::Timestamp>() {
        Ok(stamp) => stamp,
        Err(_) => {
            let civil = text.parse::<DateTime>().ok().or_else(with_points)?;
            civil.to_zoned(jiff::tz::TimeZone::UTC).ok()?.timestamp()
        }
    };
    i64::try_from(stamp.as_nanosecond()).ok().filter(is_stamp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn german_dates_are_read_as_iso_ones() {
        let iso = date_ns("2025-12-31T13:45:07.123Z");
        assert!(iso.is_some());
        for german in ["31.12.2025 13:45:07,123", "31.12.2025 13:45:07.123", " 31.12.2025T13:45:07,123 "] {
            assert_eq!(date_ns(german), iso, "{german}");
        }
        assert_eq!(date_ns("1.2.2025 03:04"), date_ns("2025-02-01 03:04:00"));
        for refused in ["12/31/2025 13:45:07", "31.13.2025 13:45:07", "31.12.25 13:45:07", "31.12.2025", "13:45:07"] {
            assert_eq!(date_ns(refused), None, "{refused}");
        }
    }
}
