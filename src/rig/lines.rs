//! Reads text files line by line, with one line in memory at a time, in the buffer of the input where it is there as a whole.

use std::io::BufRead;

use super::RigError;

/// Longest accepted line, bytes.
const LONGEST: usize = 1 << 20;

/// The numbered lines of a text file.
pub struct Lines<'a, R> {
    file: &'a str,
    input: R,
    /// Bytes of the input that the last line takes.
    taken: usize,
    /// A line that is not in the buffer of the input as a whole.
    bytes: Vec<u8>,
    /// A line that is not UTF-8, with replacement characters.
    text: String,
    number: usize,
}

impl<'a, R: BufRead> Lines<'a, R> {
    /// `file` names the file in errors.
    pub fn new(file: &'a str, input: R) -> Self {
        Self { file, input, taken: 0, bytes: vec![], text: String::new(), number: 0 }
    }

    /// The next line, trimmed, with its number (from 1); `None` after the last one.
    ///
    /// # Errors
    /// [`RigError::Line`] if the line cannot be read or is too long.
    pub fn advance(&mut self) -> Result<Option<(usize, &str)>, RigError> {
        self.input.consume(std::mem::take(&mut self.taken));
        let unreadable = |error: std::io::Error, number: usize| RigError::Line {
            file: self.file.to_owned(),
            line: number + 1,
            field: "line".to_owned(),
            value: format!("cannot be read: {error}"),
            limit: "a readable file".to_owned(),
        };
        let buffer = self.input.fill_buf().map_err(|error| unreadable(error, self.number))?;
        let length = match memchr::memchr(b'\n', buffer) {
            Some(end) => {
                self.taken = end + 1;
                self.taken
            }
            None => {
                self.bytes.clear();
                let mut limited = std::io::Read::take(&mut self.input, LONGEST as u64);
                limited.read_until(b'\n', &mut self.bytes).map_err(|error| unreadable(error, self.number))?
            }
        };
        if length == 0 {
            return Ok(None);
        }
        self.number += 1;
        if length >= LONGEST {
            return Err(self.refuse("line", format!("is longer than {LONGEST} bytes"), "lines of text"));
        }
        let bytes = if self.taken == 0 {
            &self.bytes[..]
        } else {
            &self.input.fill_buf().map_err(|error| unreadable(error, self.number))?[..length]
        };
        let text = match std::str::from_utf8(bytes) {
            Ok(text) => text,
            Err(_) => {
                self.text = String::from_utf8_lossy(bytes).into_owned();
                &self.text
            }
        };
        Ok(Some((self.number, text.trim())))
    }

    /// An error about the last line read.
    pub fn refuse(&self, field: &str, value: String, limit: &str) -> RigError {
        refuse(self.file, self.number, field, value, limit)
    }
}

/// An error about line `line`.
pub fn refuse(file: &str, line: usize, field: &str, value: String, limit: &str) -> RigError {
    RigError::Line { file: file.to_owned(), line: line.max(1), field: field.to_owned(), value, limit: limit.to_owned() }
}

/// `` is `text` ``, with the text truncated after 40 characters, for error messages.
pub fn found(text: &str) -> String {
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("is `{}...`", &text[..end]),
        None => format!("is `{text}`"),
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufReader, Cursor};

    use super::*;

    /// Lines within the buffer, across its ends, and longer than it; the last one without an end.
    #[test]
    fn lines_are_the_same_for_any_size_of_buffer() {
        let text = b"one \n\n  two\tand three\r\nfo\xffur\n0123456789012345678901234567890123456789\nlast";
        let expected =
            ["one", "", "two\tand three", "fo\u{fffd}ur", "0123456789012345678901234567890123456789", "last"];
        for capacity in [1, 2, 5, 16, 64, 1024] {
            let mut lines = Lines::new("a.mtx", BufReader::with_capacity(capacity, Cursor::new(text)));
            for (index, line) in expected.iter().enumerate() {
                assert_eq!(lines.advance().unwrap(), Some((index + 1, *line)), "{capacity}");
            }
            assert_eq!(lines.advance().unwrap(), None);
        }
    }

    #[test]
    fn a_line_without_an_end_is_refused() {
        for capacity in [100, 2 * LONGEST] {
            let mut lines =
                Lines::new("a.mtx", BufReader::with_capacity(capacity, Cursor::new(vec![b'1'; 2 * LONGEST])));
            assert_eq!(
                lines.advance().unwrap_err().to_string(),
                "a.mtx, line 1: line is longer than 1048576 bytes; expected lines of text"
            );
        }
    }
}
