//! Time histories in the Universal File Format: datasets 58, as text and binary (58b). Other datasets, and functions
//! other than time histories, are skipped.
//!
//! The increment of time has six digits in such a file, so the sample rate is the roundest number within its precision.
//!
//! Source: Structural Dynamics Research Laboratory, University of Cincinnati, "Universal File Formats for Modal
//! Analysis Testing", datasets 58 and 58b.

use super::samples::{FileChannel, MOST_CHANNELS, SamplesError, roundest_rate};

/// The line before and after each dataset.
const DELIMITER: &str = "-1";
/// Lines of text before the values.
const HEADER_LINES: usize = 11;
/// Relative precision of a number with six digits that begins with 1.
const PRECISION: f64 = 5e-6;
/// Function type of a time history, and the specific data type of time.
const TIME_HISTORY: &str = "1";

struct Lines<'a> {
    file: &'a str,
    bytes: &'a [u8],
    /// Position of the next byte.
    at: usize,
    /// Number of lines read.
    read: usize,
}

/// How the values of a dataset are written.
enum Values {
    Text,
    Binary { little_endian: bool, bytes: usize },
}

/// Whether the bytes begin like a Universal File.
pub fn is_universal_file(bytes: &[u8]) -> bool {
    let first = bytes.split(|&byte| byte == b'\n').find(|line| !line.trim_ascii().is_empty());
    first.is_some_and(|line| line.trim_ascii() == DELIMITER.as_bytes())
}

/// Reads the time histories of a file.
///
/// # Errors
/// [`SamplesError`], naming the line, what is there and what was expected.
pub fn read(file: &str, bytes: &[u8]) -> Result<Vec<FileChannel>, SamplesError> {
    let mut lines = Lines { file, bytes, at: 0, read: 0 };
    let mut channels = vec![];
    while lines.find_delimiter() {
        let number = lines.expect("the number of a dataset")?;
        let words: Vec<&str> = number.split_whitespace().collect();
        let values = match words[..] {
            ["58"] => Some(Values::Text),
            ["58b", ref layout @ ..] => Some(lines.binary(layout)?),
            ["58", "b", ref layout @ ..] => Some(lines.binary(layout)?),
            _ => None,
        };
        match values {
            Some(values) => channels.extend(lines.time_history(&values)?),
            None => {
                if !lines.find_delimiter() {
                    return Err(lines.refused("the end of the file".to_owned(), "a line `-1` after a dataset"));
                }
            }
        }
        if channels.len() > MOST_CHANNELS {
            return Err(lines.refused(format!("{} time histories", channels.len()), "at most 64"));
        }
    }
    if channels.is_empty() {
        return Err(lines.refused("no time history".to_owned(), "a dataset 58 of function type 1, time response"));
    }
    Ok(channels)
}

impl<'a> Lines<'a> {
    /// The next line without its end; `None` after the last one. Text that is not ASCII is replaced.
    fn advance(&mut self) -> Option<String> {
        let rest = self.bytes.get(self.at..).filter(|rest| !rest.is_empty())?;
        let length = rest.iter().position(|&byte| byte == b'\n').unwrap_or(rest.len());
        let line = &rest[..length];
        self.at += length + 1;
        self.read += 1;
        // Longer lines are no part of the format; they are not copied.
        Some(String::from_utf8_lossy(&line[..line.len().min(1024)]).trim_end_matches('\r').to_owned())
    }

    fn expect(&mut self, expected: &str) -> Result<String, SamplesError> {
        self.advance().ok_or_else(|| self.refused("the end of the file".to_owned(), expected))
    }

    /// Whether there is a delimiter; the next line is the one after it.
    fn find_delimiter(&mut self) -> bool {
        while let Some(line) = self.advance() {
            if line.trim() == DELIMITER {
                return true;
            }
        }
        false
    }

    fn refused(&self, found: String, expected: &str) -> SamplesError {
        let place = format!("line {}", self.read.max(1));
        SamplesError::Expected { file: self.file.to_owned(), place, found, expected: expected.to_owned() }
    }

    /// The layout of binary values: byte order, format of numbers, lines of text, bytes.
    fn binary(&self, words: &[&str]) -> Result<Values, SamplesError> {
        let expected = "byte order 1 or 2, number format 2 (IEEE 754), 11 lines of text and a number of bytes";
        match words {
            [order @ ("1" | "2"), "2", "11", bytes, ..] => match bytes.parse() {
                Ok(bytes) => Ok(Values::Binary { little_endian: *order == "1", bytes }),
                Err(_) => Err(self.refused(format!("`{bytes}` bytes"), expected)),
            },
            _ => Err(self.refused(format!("`{}`", words.join(" ")), expected)),
        }
    }

    /// A number of a line in columns.
    fn number<T: std::str::FromStr>(&self, line: &str, columns: [usize; 2], what: &str) -> Result<T, SamplesError> {
        let text = column(line, columns);
        text.replace(['D', 'd'], "E").parse().map_err(|_| {
            self.refused(format!("`{text}`"), &format!("{what} in columns {} to {}", columns[0] + 1, columns[1]))
        })
    }

    /// A dataset 58; `None` if it is no time history.
    fn time_history(&mut self, values: &Values) -> Result<Option<FileChannel>, SamplesError> {
        let header: Vec<String> =
            (0..HEADER_LINES).map(|_| self.expect("the 11 lines before the values")).collect::<Result<_, _>>()?;
        let first_line = self.read - HEADER_LINES;
        let at = |line: usize| Lines { read: first_line + line, ..*self };
        let function = &header[5];
        let data = &header[6];
        let kind: u32 = at(7).number(data, [0, 10], "a type of values")?;
        let count: usize = at(7).number(data, [10, 20], "the number of values")?;
        let is_history = column(function, [0, 5]) == TIME_HISTORY;
        let bytes_each = match kind {
            2 => 4,
            4 => 8,
            5 => 8,
            6 => 16,
            other => return Err(at(7).refused(format!("values of type {other}"), "2, 4, 5 or 6")),
        };
        if let Values::Binary { bytes, .. } = *values {
            let spacing: u32 = at(7).number(data, [20, 30], "a spacing")?;
            if spacing == 1 && Some(bytes) != count.checked_mul(bytes_each) {
                return Err(at(7).refused(format!("{count} values in {bytes} bytes"), "as many as fit the bytes"));
            }
        }
        if !is_history {
            self.skip(values)?;
            return Ok(None);
        }
        if !matches!(kind, 2 | 4) {
            return Err(at(7).refused(format!("values of type {kind}"), "2 or 4 (real) in a time history"));
        }
        let spacing: u32 = at(7).number(data, [20, 30], "a spacing")?;
        if spacing != 1 {
            return Err(at(7).refused(format!("spacing {spacing}"), "1 (even)"));
        }
        let increment_s: f64 = at(7).number(data, [43, 56], "the increment of time")?;
        if !(increment_s.is_finite() && increment_s > 0.0) {
            return Err(at(7).refused(format!("an increment of {increment_s} s"), "more than 0"));
        }
        let samples = match *values {
            Values::Text => self.text_values(count)?,
            Values::Binary { little_endian, bytes } => self.binary_values(kind, little_endian, bytes)?,
        };
        let unit = column(&header[8], [47, 67]).parse().ok();
        let name = [header[0].trim(), column(function, [31, 41])]
            .into_iter()
            .find(|name| !name.is_empty() && !name.eq_ignore_ascii_case("none"))
            .map_or_else(String::new, str::to_owned);
        Ok(Some(FileChannel { name, sample_rate_hz: roundest_rate(1.0 / increment_s, PRECISION), unit, samples }))
    }

    /// Skips the values of a dataset and its delimiter.
    fn skip(&mut self, values: &Values) -> Result<(), SamplesError> {
        if let Values::Binary { bytes, .. } = *values {
            self.take(bytes)?;
        }
        if self.find_delimiter() {
            Ok(())
        } else {
            Err(self.refused("the end of the file".to_owned(), "a line `-1` after a dataset"))
        }
    }

    fn text_values(&mut self, count: usize) -> Result<Vec<f32>, SamplesError> {
        // A value takes at least two bytes.
        let mut samples = Vec::with_capacity(count.min((self.bytes.len() - self.at.min(self.bytes.len())) / 2));
        let expected = format!("{count} values");
        while samples.len() < count {
            let Some(line) = self.advance() else {
                return Err(self.refused(format!("{} values and the end of the file", samples.len()), &expected));
            };
            if line.trim() == DELIMITER {
                return Err(self.refused(format!("{} values", samples.len()), &expected));
            }
            for word in line.split_whitespace() {
                let value: f64 =
                    word.replace(['D', 'd'], "E").parse().map_err(|_| self.refused(format!("`{word}`"), "a number"))?;
                if samples.len() == count {
                    return Err(self.refused(format!("more than {count} values"), &expected));
                }
                samples.push(value as f32);
            }
        }
        self.end()?;
        Ok(samples)
    }

    fn binary_values(&mut self, kind: u32, little_endian: bool, bytes: usize) -> Result<Vec<f32>, SamplesError> {
        let values = self.take(bytes)?;
        let single = |value: &[u8; 4]| match little_endian {
            true => f32::from_le_bytes(*value),
            false => f32::from_be_bytes(*value),
        };
        let double = |value: &[u8; 8]| match little_endian {
            true => f64::from_le_bytes(*value) as f32,
            false => f64::from_be_bytes(*value) as f32,
        };
        let samples = match kind {
            2 => values.as_chunks().0.iter().map(single).collect(),
            _ => values.as_chunks().0.iter().map(double).collect(),
        };
        self.end()?;
        Ok(samples)
    }

    fn take(&mut self, bytes: usize) -> Result<&'a [u8], SamplesError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let values = rest.get(..bytes).ok_or_else(|| {
            self.refused(format!("{} bytes up to the end of the file", rest.len()), &format!("{bytes} bytes of values"))
        })?;
        self.at += bytes;
        Ok(values)
    }

    /// The delimiter after the values.
    fn end(&mut self) -> Result<(), SamplesError> {
        let mut line = self.expect("a line `-1` after a dataset")?;
        if line.trim().is_empty() {
            line = self.expect("a line `-1` after a dataset")?;
        }
        if line.trim() == DELIMITER { Ok(()) } else { Err(self.refused(format!("`{}`", line.trim()), "`-1`")) }
    }
}

/// The text in columns of a line, counted from 0.
fn column(line: &str, [from, to]: [usize; 2]) -> &str {
    let end = line.len().min(to);
    line.get(from.min(end)..end).unwrap_or_default().trim()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sound::Unit;

    fn header(function: u32, kind: u32, count: usize, increment: &str, unit: &str) -> String {
        format!(
            "microphone\nNONE\nNONE\nNONE\nNONE\n{function:5}{:10}{:5}{:10} {:>10}{:10}{:4} {:>10}{:10}{:4}\n\
             {kind:10}{count:10}{:10}{:>13}{increment:>13}{:>13}\n{:10}{:5}{:5}{:5} {:<20} {:<20}\n\
             {:10}{:5}{:5}{:5} {:<20} {unit:<20}\nnone\nnone\n",
            0,
            0,
            0,
            "NONE",
            1,
            3,
            "NONE",
            0,
            0,
            1,
            "0.00000e+00",
            "0.00000e+00",
            17,
            0,
            0,
            0,
            "Time",
            "s",
            15,
            0,
            0,
            0,
            "Pressure"
        )
    }

    fn file(dataset: &str) -> Vec<u8> {
        format!("    -1\n{dataset}    -1\n").into_bytes()
    }

    fn error(bytes: &[u8]) -> String {
        read("a.uff", bytes).expect_err("refused").to_string()
    }

    #[test]
    fn text_and_binary_histories_are_read_with_rate_unit_and_name() {
        let text = header(1, 2, 8, "1.95313e-05", "Pa");
        let values = "  1.00000e+00 -2.50000e+00  0.00000e+00  3.00000e-01  1.00000e-05  2.00000e+00\n  7.0 8.0\n";
        let mut bytes = file(&format!("    58\n{text}{values}"));
        // A dataset of another kind, and a function that is no time history.
        bytes.extend(file("   151\nmodel\n"));
        bytes.extend(file(&format!("    58\n{}  1.0 2.0\n", header(4, 2, 2, "1.0", "Pa"))));
        let binary = header(1, 4, 2, "1.00000e-04", "NONE");
        bytes.extend(format!("    -1\n    58b     2     2          11          16     0     0 0 0\n{binary}").bytes());
        bytes.extend([1.5_f64, -0.25].into_iter().flat_map(f64::to_be_bytes));
        bytes.extend(b"\n    -1\n");
        let channels = read("a.uff", &bytes).expect("read");
        let [first, second] = &channels[..] else { panic!("{channels:?}") };
        // 1 / 1.95313e-5 is 51199.87.
        assert_eq!((&*first.name, first.sample_rate_hz, first.unit), ("microphone", 51_200.0, Some(Unit::Pascal)));
        assert_eq!(first.samples, [1.0, -2.5, 0.0, 0.3, 1e-5, 2.0, 7.0, 8.0]);
        assert_eq!((second.sample_rate_hz, second.unit), (10_000.0, None));
        assert_eq!(second.samples, [1.5, -0.25]);
    }

    #[test]
    fn damaged_files_are_refused_with_line_and_expectation() {
        let of = |kind, count, increment: &str, values: &str| {
            file(&format!("    58\n{}{values}", header(1, kind, count, increment, "Pa")))
        };
        assert_eq!(
            error(b"    -1\n   151\n"),
            "a.uff, line 2: the end of the file, expected a line `-1` after a dataset"
        );
        assert!(error(&file("   151\nx\n")).contains("no time history, expected a dataset 58"));
        assert_eq!(error(&of(2, 3, "1e-4", " 1.0 2.0\n")), "a.uff, line 15: 2 values, expected 3 values");
        assert_eq!(error(&of(2, 1, "1e-4", " 1.0 2.0\n")), "a.uff, line 14: more than 1 values, expected 1 values");
        assert_eq!(error(&of(2, 1, "1e-4", " 1.x\n")), "a.uff, line 14: `1.x`, expected a number");
        assert_eq!(error(&of(2, 1, "0.0", " 1.0\n")), "a.uff, line 9: an increment of 0 s, expected more than 0");
        assert_eq!(
            error(&of(5, 1, "1e-4", " 1.0 1.0\n")),
            "a.uff, line 9: values of type 5, expected 2 or 4 (real) in a time history"
        );
        assert_eq!(error(&of(7, 1, "1e-4", " 1.0\n")), "a.uff, line 9: values of type 7, expected 2, 4, 5 or 6");
        let claims = format!(
            "    -1\n    58b     1     2          11   4000000000     0 0 0 0\n{}",
            header(1, 2, 1_000_000_000, "1e-4", "Pa")
        );
        assert!(
            error(claims.as_bytes())
                .ends_with("0 bytes up to the end of the file, expected 4000000000 bytes of values")
        );
        let short =
            format!("    -1\n    58b     1     2          11   8     0 0 0 0\n{}", header(1, 2, 1, "1e-4", "Pa"));
        assert!(error(short.as_bytes()).contains("1 values in 8 bytes"));
        let big = "    -1\n    58b     1     1          11   8\n";
        assert!(error(big.as_bytes()).contains("expected byte order 1 or 2, number format 2"));
        assert!(is_universal_file(b"\n    -1\n    58\n") && !is_universal_file(b"time,a\n"));
    }
}
