//! Reads text files line by line, with one line in memory at a time.

use std::io::BufRead;

use super::RigError;

/// Longest accepted line, bytes.
const LONGEST: usize = 1 << 20;

/// The numbered lines of a text file.
pub struct Lines<'a, R> {
    file: &'a str,
    input: R,
    bytes: Vec<u8>,
    text: String,
    number: usize,
}

impl<'a, R: BufRead> Lines<'a, R> {
    /// `file` names the file in errors.
    pub fn new(file: &'a str, input: R) -> Self {
        Self { file, input, bytes: vec![], text: String::new(), number: 0 }
    }

    /// The next line, trimmed, with its number (from 1); `None` after the last one.
    ///
    /// # Errors
    /// [`RigError::Line`] if the line cannot be read or is too long.
    pub fn advance(&mut self) -> Result<Option<(usize, &str)>, RigError> {
        self.bytes.clear();
        let mut limited = std::io::Read::take(&mut self.input, LONGEST as u64);
        let read = limited.read_until(b'\n', &mut self.bytes).map_err(|error| RigError::Line {
            file: self.file.to_owned(),
            line: self.number + 1,
            field: "line".to_owned(),
            value: format!("cannot be read: {error}"),
            limit: "a readable file".to_owned(),
        })?;
        if read == 0 {
            return Ok(None);
        }
        self.number += 1;
        if read == LONGEST {
            return Err(self.refuse("line", format!("is longer than {LONGEST} bytes"), "lines of text"));
        }
        self.text.clear();
        match std::str::from_utf8(&self.bytes) {
            Ok(text) => self.text.push_str(text),
            Err(_) => self.text.push_str(&String::from_utf8_lossy(&self.bytes)),
        }
        Ok(Some((self.number, self.text.trim())))
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
