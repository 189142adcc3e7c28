//! The values in a line: numbers, times and their order.

use super::rows::Row;
use super::times::{date_ns, decimal_ns, is_stamp};
use super::{Column, Field, LogError, LogOptions, Sample};

/// The order of the lines in time.
#[derive(Default)]
pub(super) struct Clock {
    /// Line and stamp of the sample before.
    last: Option<(usize, i64)>,
    /// Time between the two samples before, ns.
    interval_ns: i64,
    /// Added to the times of the log, since they began again.
    shift_ns: i64,
}

impl Clock {
    /// The sample with its stamp after that of the one before.
    ///
    /// # Errors
    /// It is not later, and times do not `restart`.
    pub(super) fn place(
        &mut self,
        mut sample: Sample,
        row: &Row,
        columns: &[Column],
        restart: bool,
    ) -> Result<Sample, LogError> {
        let written_ns = sample.stamp_ns;
        sample.stamp_ns = written_ns.saturating_add(self.shift_ns);
        if let Some((before, last_ns)) = self.last {
            if sample.stamp_ns <= last_ns {
                if !restart || self.interval_ns == 0 {
                    return Err(LogError::NotLater { line: row.line, before, value: row.time_text(columns) });
                }
                sample.stamp_ns = last_ns.saturating_add(self.interval_ns);
                self.shift_ns = sample.stamp_ns.saturating_sub(written_ns);
            }
            self.interval_ns = sample.stamp_ns.saturating_sub(last_ns);
        }
        self.last = Some((row.line, sample.stamp_ns));
        Ok(sample)
    }
}

/// Detects the decimal sign. A cell that contains both comma and point decides: the last one is the decimal sign.
/// Otherwise cells with only one of them decide, unless both kinds occur.
pub(super) fn decimal_sign(
    rows: impl Iterator<Item = Result<Row, LogError>>,
    columns: &[Column],
    iso: bool,
) -> Result<char, LogError> {
    let mut comma: Option<(usize, String)> = None;
    let mut point: Option<(usize, String)> = None;
    for row in rows {
        let row = row?;
        for column in columns.iter().filter(|column| !(iso && column.field == Field::Time)) {
            let cell = row.cells.get(column.index).unwrap_or_default();
            let seen = match (cell.rfind(','), cell.rfind('.')) {
                (Some(c), Some(p)) if c > p => &mut comma,
                (Some(_), None) => &mut comma,
                (None, None) => continue,
                _ => &mut point,
            };
            seen.get_or_insert_with(|| (row.line, cell.to_owned()));
        }
        if let (Some((comma_line, comma)), Some((point_line, point))) = (&comma, &point) {
            let (comma, point) = (comma.clone(), point.clone());
            return Err(LogError::Decimal { comma, comma_line: *comma_line, point, point_line: *point_line });
        }
    }
    Ok(if comma.is_some() { ',' } else { '.' })
}

const DATE: &str = "an ISO 8601 time, or one as 31.12.2025 13:45:07, between 1970 and 2038";

pub(super) fn sample(
    row: &Row,
    columns: &[Column],
    decimal: char,
    iso: bool,
    absolute: &mut Option<bool>,
    options: &LogOptions,
) -> Result<Sample, LogError> {
    let mut sample = with_constants(options)?;
    for column in columns {
        let cell = row.cell(column)?;
        let wrong = |expected| LogError::Value {
            line: row.line,
            column: column.header.clone(),
            value: cell.to_owned(),
            expected,
        };
        if column.field == Field::Time {
            sample.stamp_ns = if iso {
                date_ns(cell).ok_or_else(|| wrong(DATE))?
            } else {
                let text = plain_number(cell, decimal).ok_or_else(|| wrong("a number"))?;
                let ns = decimal_ns(&text, column.factor as i64).ok_or_else(|| wrong("a time in range"))?;
                let from_epoch = *absolute.get_or_insert(ns >= 1_000_000_000 * 1_000_000_000);
                let stamp = if from_epoch { Some(ns) } else { ns.checked_add(options.start_ns) };
                stamp.filter(is_stamp).ok_or_else(|| wrong("a time between 1970 and 2038"))?
            };
            continue;
        }
        // Thermometers are slower than loads: an empty cell is no measurement.
        if column.field.is_optional() && cell.is_empty() {
            continue;
        }
        let number = plain_number(cell, decimal).and_then(|text| text.parse::<f64>().ok());
        let value = number.filter(|value| value.is_finite()).ok_or_else(|| wrong("a finite number"))? * column.factor;
        let (target, range) = match column.field {
            Field::NormalLoadN => (&mut sample.normal_load_n, Some(options.normal_load_n)),
            Field::DiscSpeedRadS => (&mut sample.disc_speed_rad_s, Some(options.disc_speed_rad_s)),
            Field::FrictionCoefficient => (&mut sample.friction_coefficient, None),
            Field::TemperatureC => {
                check(row, column, value, options.temperature_c)?;
                sample.temperature_c = Some(value);
                continue;
            }
            // Columns are in the order of `Field::ALL`, so the load is already known. Without load there is no contact
            // and the friction coefficient is meaningless.
            Field::FrictionForceN | Field::Time => {
                let friction = if sample.normal_load_n == 0.0 { 0.0 } else { value / sample.normal_load_n };
                check(row, column, friction, options.friction_coefficient)?;
                sample.friction_coefficient = friction;
                continue;
            }
        };
        *target = value;
        check(row, column, value, range.unwrap_or(options.friction_coefficient))?;
    }
    Ok(sample)
}

/// A sample with the quantities that have the same value in every line.
pub(super) fn with_constants(options: &LogOptions) -> Result<Sample, LogError> {
    let mut sample = Sample {
        stamp_ns: 0,
        normal_load_n: 0.0,
        disc_speed_rad_s: 0.0,
        friction_coefficient: 0.0,
        temperature_c: None,
    };
    for &(field, value) in &options.constants {
        let (target, [min, max]) = match field {
            Field::NormalLoadN => (&mut sample.normal_load_n, options.normal_load_n),
            Field::DiscSpeedRadS => (&mut sample.disc_speed_rad_s, options.disc_speed_rad_s),
            Field::FrictionCoefficient => (&mut sample.friction_coefficient, options.friction_coefficient),
            Field::TemperatureC => (sample.temperature_c.insert(value), options.temperature_c),
            Field::Time | Field::FrictionForceN => return Err(LogError::NoConstant { field }),
        };
        *target = value;
        if !(min..=max).contains(&value) {
            return Err(LogError::Constant { field, value, min, max });
        }
    }
    Ok(sample)
}

fn check(row: &Row, column: &Column, value: f64, [min, max]: [f64; 2]) -> Result<(), LogError> {
    if (min..=max).contains(&value) {
        Ok(())
    } else {
        Err(LogError::Limit { line: row.line, column: column.header.clone(), value, min, max })
    }
}

/// A number with a decimal point and without thousands separators; `None` if the cell is not a number.
fn plain_number(cell: &str, decimal: char) -> Option<String> {
    let thousands = if decimal == ',' { '.' } else { ',' };
    let cell = cell.trim();
    let (whole, fraction) = match cell.split_once(decimal) {
        Some((whole, fraction)) => (whole, Some(fraction)),
        None => (cell, None),
    };
    let mut groups = whole.split(thousands);
    let first = groups.next()?;
    let mut text = first.to_owned();
    for group in groups {
        let digits = group.len() == 3 && group.bytes().all(|byte| byte.is_ascii_digit());
        let before = first.trim_start_matches(['+', '-']);
        if !digits || before.is_empty() || before.len() > 3 {
            return None;
        }
        text.push_str(group);
    }
    if let Some(fraction) = fraction {
        text.push('.');
        text.push_str(fraction);
    }
    // Must begin with a digit: `f64` would also accept "inf" and "nan".
    let body = text.trim_start_matches(['+', '-']);
    (body.starts_with(|c: char| c.is_ascii_digit() || c == '.') && text.parse::<f64>().is_ok()).then_some(text)
}
