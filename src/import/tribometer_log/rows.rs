//! The lines below the header.

use super::header::Header;
use super::{Column, Field, LogError};

/// Longest line accepted, bytes.
const LONGEST_LINE: usize = 64 << 10;

pub(super) struct Row {
    pub line: usize,
    pub cells: csv::StringRecord,
}

impl Row {
    pub(super) fn cell(&self, column: &Column) -> Result<&str, LogError> {
        self.cells.get(column.index).ok_or_else(|| LogError::Short {
            line: self.line,
            cells: self.cells.len(),
            column: column.header.clone(),
            number: column.index + 1,
        })
    }

    pub(super) fn time_text(&self, columns: &[Column]) -> String {
        let time = columns.iter().find(|column| column.field == Field::Time);
        time.and_then(|column| self.cells.get(column.index)).unwrap_or_default().to_owned()
    }
}

/// The rows below the header, without empty ones.
pub(super) struct Rows<'t> {
    text: &'t str,
    records: csv::StringRecordsIntoIter<&'t [u8]>,
    /// Line number corrected for empty lines and CR LF: the CSV reader counts line breaks before a record and misses
    /// those.
    line: usize,
    counted: usize,
}

impl<'t> Rows<'t> {
    pub(super) fn below(text: &'t str, header: &Header) -> Self {
        let text = text.get(header.end..).unwrap_or_default();
        let reader = csv::ReaderBuilder::new()
            .delimiter(header.separator)
            .has_headers(false)
            .flexible(true)
            .trim(csv::Trim::All)
            .from_reader(text.as_bytes());
        Self { text, records: reader.into_records(), line: header.line + 1, counted: 0 }
    }
}

impl Iterator for Rows<'_> {
    type Item = Result<Row, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let cells = match self.records.next()? {
                Ok(cells) => cells,
                Err(error) => return Some(Err(LogError::Text { line: self.line, reason: error.to_string() })),
            };
            let bytes = self.text.as_bytes();
            let position = cells.position().map_or(0, csv::Position::byte) as usize;
            let breaks = bytes.iter().skip(position).take_while(|byte| matches!(byte, b'\r' | b'\n')).count();
            let start = position + breaks;
            self.line += bytes.iter().take(start).skip(self.counted).filter(|byte| **byte == b'\n').count();
            self.counted = start.max(self.counted);
            if cells.iter().any(|cell| !cell.is_empty()) {
                return Some(Ok(Row { line: self.line, cells }));
            }
        }
    }
}

/// Checks that no line is longer than [`LONGEST_LINE`].
pub(super) fn check_lines(text: &str) -> Result<(), LogError> {
    match text.lines().position(|line| line.len() > LONGEST_LINE) {
        Some(at) => Err(LogError::Text { line: at + 1, reason: format!("longer than {LONGEST_LINE} bytes") }),
        None => Ok(()),
    }
}
