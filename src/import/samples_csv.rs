//! Samples as text in columns: a header with units, a column of times, and a column for each channel.
//!
//! Cells are separated by semicolons, tabs or commas; with the first two, decimals may have commas. The header names
//! each column with its unit in brackets: `time [s]`, `microphone [Pa]`, `pad (m/s²)`. A column whose unit is neither of
//! sound nor of acceleration is omitted. Times must be evenly spaced.

use super::samples::{FileChannel, MOST_CHANNELS, SamplesError, roundest_rate};
use crate::sound::Unit;

/// A column of samples.
struct Column {
    index: usize,
    channel: FileChannel,
}

/// Reads the channels of a file, and the columns it omits.
///
/// # Errors
/// [`SamplesError`], naming the line, what is there and what was expected.
pub fn read(file: &str, bytes: &[u8]) -> Result<(Vec<FileChannel>, Vec<String>), SamplesError> {
    let refused = |line: usize, found: String, expected: &str| SamplesError::Expected {
        file: file.to_owned(),
        place: format!("line {line}"),
        found,
        expected: expected.to_owned(),
    };
    let text = std::str::from_utf8(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)).map_err(|error| {
        let line = 1 + bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count();
        let expected = "a WAV file, a Universal File, or text in columns (UTF-8)";
        refused(line, "bytes that are no text".to_owned(), expected)
    })?;
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let expected = "a WAV file, a Universal File, or a header such as time [s],microphone [Pa]";
    let Some((header_line, header)) = lines.next() else {
        return Err(refused(1, "an empty file".to_owned(), expected));
    };
    let separator = [';', '\t', ','].into_iter().find(|&separator| header.contains(separator));
    let Some(separator) = separator else {
        return Err(refused(header_line + 1, format!("`{}`", shortened(header)), expected));
    };
    let cells: Vec<(&str, Option<&str>)> = header.split(separator).map(name_and_unit).collect();
    let is_time = |name: &str| {
        let name = name.to_lowercase();
        ["time", "t", "zeit"].contains(&&*name) || name.starts_with("time")
    };
    let time = cells.iter().position(|(name, _)| is_time(name));
    let Some(time) = time else {
        return Err(refused(header_line + 1, format!("`{}`", shortened(header)), "a column of times: time [s]"));
    };
    let second = match cells[time].1 {
        None | Some("s") => 1.0,
        Some("ms") => 1e-3,
        Some(other) => return Err(refused(header_line + 1, format!("times in {other}"), "s or ms")),
    };
    let (mut columns, mut omitted): (Vec<Column>, Vec<String>) = (vec![], vec![]);
    for (index, &(name, unit)) in cells.iter().enumerate().filter(|(index, _)| *index != time) {
        let known = unit.map(str::parse::<Unit>).transpose();
        match known {
            Ok(unit) => {
                let channel = FileChannel { name: name.to_owned(), sample_rate_hz: 0.0, unit, samples: vec![] };
                columns.push(Column { index, channel });
            }
            Err(error) => omitted.push(format!("column `{name}`: {error}")),
        }
    }
    if columns.is_empty() || columns.len() > MOST_CHANNELS {
        let found = format!("{} columns of samples", columns.len());
        return Err(refused(header_line + 1, found, "1 to 64, in Pa, m/s², g, V or FS"));
    }
    let decimal_comma = separator != ',';
    let number = |line: usize, cell: Option<&str>| {
        let text = cell.unwrap_or_default().trim();
        let parsed = if decimal_comma { text.replace(',', ".").parse() } else { text.parse::<f64>() };
        parsed.map_err(|_| refused(line + 1, format!("`{}`", shortened(text)), "a number"))
    };
    let mut times = Times::default();
    for (line, row) in lines {
        let cells: Vec<&str> = row.split(separator).collect();
        times.push(second * number(line, cells.get(time).copied())?, line + 1);
        times.digits(cells[time], second);
        for column in &mut columns {
            column.channel.samples.push(number(line, cells.get(column.index).copied())? as f32);
        }
    }
    let rate_hz = times.rate_hz().map_err(|(line, found, expected)| refused(line, found, &expected))?;
    let channels = columns.into_iter().map(|column| FileChannel { sample_rate_hz: rate_hz, ..column.channel });
    Ok((channels.collect(), omitted))
}

/// Times of samples, s, with their lines.
#[derive(Default)]
struct Times {
    times: Vec<f64>,
    first_line: usize,
    lines_between: usize,
    /// Half a unit of the last decimal, s.
    resolution_s: f64,
}

impl Times {
    fn push(&mut self, time_s: f64, line: usize) {
        if self.times.is_empty() {
            self.first_line = line;
        }
        self.lines_between = line;
        self.times.push(time_s);
    }

    /// Takes note of the decimals of a time.
    fn digits(&mut self, cell: &str, second: f64) {
        let (mantissa, exponent) = cell.trim().split_once(['e', 'E']).unwrap_or((cell.trim(), "0"));
        let decimals = mantissa.rsplit_once(['.', ',']).map_or(0, |(_, decimals)| decimals.len());
        let exponent = exponent.parse::<i32>().unwrap_or(0).clamp(-300, 300);
        self.resolution_s = 0.5 * second * 10.0_f64.powi(exponent - i32::try_from(decimals).unwrap_or(300).min(300));
    }

    /// The sample rate.
    fn rate_hz(&self) -> Result<f64, (usize, String, String)> {
        let count = self.times.len();
        let (Some(first), Some(last), true) = (self.times.first(), self.times.last(), count > 1) else {
            return Err((self.lines_between.max(1), format!("{count} samples"), "at least 2".to_owned()));
        };
        let span_s = last - first;
        let step_s = span_s / (count - 1) as f64;
        if !(step_s.is_finite() && step_s > 0.0) {
            let expected = "times that increase".to_owned();
            return Err((self.lines_between, format!("times from {first} to {last} s"), expected));
        }
        let off = |k: usize| (self.times[k] - (first + k as f64 * step_s)).abs();
        if let Some(k) = (0..count).find(|&k| off(k) > 0.5 * step_s + 2.0 * self.resolution_s) {
            let expected = format!("evenly spaced times: {} s", first + k as f64 * step_s);
            return Err((self.first_line + k, format!("{} s", self.times[k]), expected));
        }
        Ok(roundest_rate(1.0 / step_s, 2.0 * self.resolution_s / span_s + 1e-9))
    }
}

/// The name of a column and its unit, which is in square brackets or parentheses at the end.
fn name_and_unit(cell: &str) -> (&str, Option<&str>) {
    let cell = cell.trim().trim_matches('"');
    for (open, close) in [('[', ']'), ('(', ')')] {
        // The first bracket: units contain parentheses too.
        if let Some((name, unit)) = cell.strip_suffix(close).and_then(|rest| rest.split_once(open)) {
            return (name.trim(), Some(unit.trim()).filter(|unit| !unit.is_empty()));
        }
    }
    (cell, None)
}

fn shortened(text: &str) -> String {
    text.chars().take(60).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_read_with_units_in_either_notation() {
        let text = "time [s],microphone [Pa],load [N],pad (m/s²)\n0,0.5,1,2\n0.0000195,-1e-3,1,3\n0.0000391,2,1,4\n";
        let (channels, omitted) = read("a.csv", text.as_bytes()).expect("read");
        let [first, second] = &channels[..] else { panic!("{channels:?}") };
        // With seven decimals the rate is 51 150.9 Hz within 0.26 %, of which 51 200 is the roundest.
        assert_eq!((&*first.name, first.unit), ("microphone", Some(Unit::Pascal)));
        assert_eq!(first.sample_rate_hz, 51_200.0);
        assert_eq!(first.samples, [0.5, -1e-3, 2.0]);
        assert_eq!((second.unit, &*second.samples), (Some(Unit::MetrePerSecondSquared), &[2.0, 3.0, 4.0][..]));
        assert_eq!(omitted, ["column `load`: unit `N`: expected Pa, m/s², g, V or FS (full scale)"]);
        let text = "\u{feff}Zeit (ms);Mikrofon (Pa)\r\n0,00;1,5\r\n0,02;-2,5\r\n0,04;1\r\n";
        let (channels, _) = read("a.csv", text.as_bytes()).expect("read");
        assert_eq!((channels[0].sample_rate_hz, &*channels[0].samples), (50_000.0, &[1.5, -2.5, 1.0][..]));
    }

    #[test]
    fn the_rate_is_that_of_the_whole_file() {
        let mut text = "time [s],a\n".to_owned();
        for k in 0..51_200 {
            text += &format!("{:.7},0\n", f64::from(k) / 51_200.0);
        }
        let (channels, _) = read("a.csv", text.as_bytes()).expect("read");
        assert_eq!((channels[0].sample_rate_hz, channels[0].unit), (51_200.0, None));
    }

    #[test]
    fn damaged_files_are_refused_with_line_and_expectation() {
        let error = |text: &str| read("a.csv", text.as_bytes()).expect_err("refused").to_string();
        assert!(error("").starts_with("a.csv, line 1: an empty file, expected a WAV file, a Universal File"));
        assert!(error("hello\n").starts_with("a.csv, line 1: `hello`, expected a WAV file"));
        assert!(error("a [Pa],b [Pa]\n").ends_with("expected a column of times: time [s]"));
        assert!(error("time [h],b [Pa]\n").ends_with("times in h, expected s or ms"));
        assert!(error("time [s],load [N]\n0,1\n").contains("0 columns of samples, expected 1 to 64"));
        assert_eq!(error("time [s],b [Pa]\n0,1\n"), "a.csv, line 2: 1 samples, expected at least 2");
        assert_eq!(error("time [s],b [Pa]\n0,1\n1,x\n"), "a.csv, line 3: `x`, expected a number");
        assert_eq!(error("time [s],b [Pa]\n0,1\n1\n"), "a.csv, line 3: ``, expected a number");
        assert!(error("time [s],b [Pa]\n1,1\n1,2\n").contains("times from 1 to 1 s, expected times that increase"));
        let uneven = "time [s],b [Pa]\n0.0,1\n0.1,1\n0.9,1\n1.0,1\n1.1,1\n";
        assert!(error(uneven).contains("line 4: 0.9 s, expected evenly spaced times: 0.55"), "{}", error(uneven));
        let error = read("a.csv", b"time [s],b [Pa]\n0,\xff\n").expect_err("refused").to_string();
        assert!(error.starts_with("a.csv, line 2: bytes that are no text"), "{error}");
    }
}
