//! Reads a tribometer log: delimited text with named columns, with units in their names or in the next line.
//!
//! Pure: text in, samples out. Formats differ between programs, so the separator (`;`, tab, `,`), the decimal sign,
//! lines before the header, a byte order mark and Latin-1 are detected. An ambiguity is an error; nothing is guessed.

mod field;
mod times;

use std::borrow::Cow;

pub use field::Field;
use times::{date_ns, decimal_ns, is_stamp};

/// Longest line accepted, bytes.
const LONGEST_LINE: usize = 64 << 10;

/// Why a log is invalid. Lines are counted from 1.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LogError {
    #[error("no line names the columns needed: {missing} not found; line {line} comes closest: {header:?}{hint}")]
    NoHeader { line: usize, header: String, missing: String, hint: String },
    #[error("line {line}: no column is called {header:?}, which {field} is to be read from")]
    NoSuchColumn { line: usize, field: Field, header: String },
    #[error("line {line}: both {first:?} and {second:?} may be {field}: choose one with --column {field}=NAME")]
    TwoColumns { line: usize, field: Field, first: String, second: String },
    #[error("line {line}, column {column:?}: unit {unit:?} of {field} is not one of {known}")]
    Unit { line: usize, column: String, field: Field, unit: String, known: String },
    #[error(
        "both decimal commas and decimal points: {comma:?} in line {comma_line}, {point:?} in line {point_line}: \
         choose one with --decimal"
    )]
    Decimal { comma: String, comma_line: usize, point: String, point_line: usize },
    #[error("line {line}, column {column:?}: {value:?} is not {expected}")]
    Value { line: usize, column: String, value: String, expected: &'static str },
    #[error("line {line}, column {column:?}: {value} is outside of {min} to {max}")]
    Limit { line: usize, column: String, value: f64, min: f64, max: f64 },
    #[error("line {line}: time {value:?} is not later than that of line {before}")]
    NotLater { line: usize, before: usize, value: String },
    #[error("line {line}: {cells} cells, where column {column:?} is the {number}th")]
    Short { line: usize, cells: usize, column: String, number: usize },
    #[error("line {line}: {reason}")]
    Text { line: usize, reason: String },
    #[error("no samples below line {line}")]
    NoSamples { line: usize },
}

/// Options for reading a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogOptions {
    /// Columns chosen by their name in the log instead of by the usual names. The unit is the one in the column name,
    /// else the one in the field's name.
    pub columns: Vec<(Field, String)>,
    /// `,` or `.`; `None` detects it.
    pub decimal: Option<char>,
    /// Origin of relative times, ns since the epoch. Times of a billion seconds or more count from the epoch itself.
    pub start_ns: i64,
    /// Accepted ranges, ends included, in the units of the field names.
    pub normal_load_n: [f64; 2],
    pub disc_speed_rad_s: [f64; 2],
    pub friction_coefficient: [f64; 2],
    /// Skip invalid lines instead of refusing the log.
    pub skip_bad_lines: bool,
}

impl Default for LogOptions {
    /// The default origin of relative times is 2000-01-01, so that an import always gives the same recording.
    fn default() -> Self {
        Self {
            columns: Vec::new(),
            decimal: None,
            start_ns: 946_684_800_000_000_000,
            normal_load_n: [0.0, 1e6],
            disc_speed_rad_s: [-1e4, 1e4],
            friction_coefficient: [0.0, 2.0],
            skip_bad_lines: false,
        }
    }
}

/// The operating point in one line of the log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// ns since the epoch.
    pub stamp_ns: i64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
}

/// A column that is used.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    pub field: Field,
    /// Its name in the log.
    pub header: String,
    /// Empty if it has none (dates, friction coefficients).
    pub unit: String,
    index: usize,
    factor: f64,
}

/// The content of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct TribometerLog {
    pub samples: Vec<Sample>,
    pub columns: Vec<Column>,
    /// Names of the columns that are not used, without empty names.
    pub left_out: Vec<String>,
    pub separator: char,
    pub decimal: char,
    /// Number of lines skipped, and the error of the first.
    pub skipped: usize,
    pub first_skipped: Option<LogError>,
}

/// Decodes the text of a log: UTF-8 or UTF-16 according to its byte order mark, else UTF-8, else Latin-1.
pub fn decode_text(bytes: &[u8]) -> Cow<'_, str> {
    let utf16 = |bytes: &[u8], unit: fn([u8; 2]) -> u16| {
        let units = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
        char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect::<String>().into()
    };
    match bytes {
        [0xff, 0xfe, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => utf16(rest, u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
            match std::str::from_utf8(bytes) {
                Ok(text) => text.into(),
                Err(_) => bytes.iter().map(|&byte| char::from(byte)).collect::<String>().into(),
            }
        }
    }
}

/// Reads a log.
///
/// # Errors
///
/// See [`LogError`]; with [`LogOptions::skip_bad_lines`] only errors that concern the whole log.
pub fn parse(text: &str, options: &LogOptions) -> Result<TribometerLog, LogError> {
    check_lines(text)?;
    let header = find_header(text, options)?;
    // The rows are parsed again for each question, one at a time: keeping all would take many times the memory of the
    // text.
    let rows = |skipped: usize| Rows::below(text, &header).skip(skipped);
    let first = rows(0).next().transpose()?;
    let (mut columns, unit_rows) = match first {
        Some(first) if is_unit_row(&first, &header.columns) => (with_units(&first, header.columns.clone())?, 1),
        _ => (header.columns.clone(), 0),
    };
    let iso = rows(unit_rows).next().transpose()?.is_some_and(|first| is_iso(&first, &columns));
    for column in &mut columns {
        resolve_unit(column, header.line, iso, options)?;
    }
    let decimal = match options.decimal {
        Some(sign) => sign,
        None => decimal_sign(rows(unit_rows), &columns, iso)?,
    };

    let read = |index: &usize| columns.iter().any(|column| column.index == *index);
    let left_out = header.cells.iter().enumerate().filter(|(index, cell)| !read(index) && !cell.is_empty());
    let mut log = TribometerLog {
        samples: Vec::new(),
        left_out: left_out.map(|(_, cell)| cell.clone()).collect(),
        columns,
        separator: char::from(header.separator),
        decimal,
        skipped: 0,
        first_skipped: None,
    };
    let mut last: Option<(usize, i64)> = None;
    let mut absolute = None;
    for row in rows(unit_rows) {
        let row = row?;
        let sample = sample(&row, &log.columns, decimal, iso, &mut absolute, options).and_then(|sample| match last {
            Some((before, stamp_ns)) if sample.stamp_ns <= stamp_ns => {
                Err(LogError::NotLater { line: row.line, before, value: row.time_text(&log.columns) })
            }
            _ => Ok(sample),
        });
        match sample {
            Ok(sample) => {
                last = Some((row.line, sample.stamp_ns));
                log.samples.push(sample);
            }
            Err(error) if options.skip_bad_lines => {
                log.skipped += 1;
                log.first_skipped.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    if log.samples.is_empty() {
        return Err(log.first_skipped.unwrap_or(LogError::NoSamples { line: header.line }));
    }
    Ok(log)
}

struct Header {
    line: usize,
    separator: u8,
    /// All names in the line.
    cells: Vec<String>,
    columns: Vec<Column>,
    /// Offset at which the lines below begin, bytes.
    end: usize,
}

/// The first line that contains the names of all required columns.
fn find_header(text: &str, options: &LogOptions) -> Result<Header, LogError> {
    const SEARCHED_LINES: usize = 500;
    let mut closest: Option<(usize, LogError)> = None;
    let mut end = 0;
    for (number, line) in text.split_inclusive('\n').enumerate().take(SEARCHED_LINES) {
        end += line.len();
        for separator in [b';', b'\t', b','] {
            let Some(cells) = split_line(line, separator) else { continue };
            match header_columns(&cells, number + 1, options) {
                Ok(columns) => return Ok(Header { line: number + 1, separator, cells, columns, end }),
                Err((found, error)) if closest.as_ref().is_none_or(|(best, _)| found > *best) => {
                    closest = Some((found, error));
                }
                Err(_) => {}
            }
        }
    }
    let nothing =
        LogError::NoHeader { line: 1, header: String::new(), missing: "time".to_owned(), hint: String::new() };
    Err(closest.map_or(nothing, |(_, error)| error))
}

fn split_line(line: &str, separator: u8) -> Option<Vec<String>> {
    let mut reader = csv::ReaderBuilder::new()
        .delimiter(separator)
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .from_reader(line.as_bytes());
    Some(reader.records().next()?.ok()?.iter().map(str::to_owned).collect())
}

/// The columns of a header line, or the number found and what is missing.
fn header_columns(cells: &[String], line: usize, options: &LogOptions) -> Result<Vec<Column>, (usize, LogError)> {
    let mut columns: Vec<Column> = Vec::new();
    let mut trouble = None;
    for field in Field::ALL {
        let column = |index: usize, unit: String| Column {
            field,
            header: cells.get(index).cloned().unwrap_or_default(),
            unit,
            index,
            factor: 1.0,
        };
        if let Some((_, wanted)) = options.columns.iter().find(|(mapped, _)| *mapped == field) {
            match cells.iter().position(|cell| cell == wanted.trim()) {
                Some(index) => {
                    let (_, unit) = split_unit(wanted);
                    columns.push(column(index, unit.unwrap_or_default()));
                }
                None => {
                    trouble.get_or_insert(LogError::NoSuchColumn { line, field, header: wanted.clone() });
                }
            }
            continue;
        }
        let mapped = |cell: &String| options.columns.iter().any(|(_, wanted)| wanted.trim() == cell);
        let mut found = cells.iter().enumerate().filter(|(_, cell)| !mapped(cell));
        let mut found = found.by_ref().filter_map(|(index, cell)| Some((index, recognise(cell, field)?)));
        if let Some((index, unit)) = found.next() {
            if let Some((second, _)) = found.next() {
                trouble.get_or_insert(LogError::TwoColumns {
                    line,
                    field,
                    first: cells.get(index).cloned().unwrap_or_default(),
                    second: cells.get(second).cloned().unwrap_or_default(),
                });
            }
            columns.push(column(index, unit));
        }
    }
    let found = columns.len();
    let has = |field| columns.iter().any(|column| column.field == field);
    let needed = [Field::Time, Field::NormalLoadN, Field::DiscSpeedRadS].into_iter().filter(|field| !has(*field));
    let friction = !has(Field::FrictionCoefficient) && !has(Field::FrictionForceN);
    let missing: Vec<Field> = needed.chain(friction.then_some(Field::FrictionCoefficient)).collect();
    if !missing.is_empty() {
        let free = |index: usize| columns.iter().all(|column| column.index != index);
        let free: Vec<&String> = cells.iter().enumerate().filter(|(k, _)| free(*k)).map(|(_, cell)| cell).collect();
        let hint = missing.iter().find_map(|field| hint(*field, &free)).unwrap_or_default();
        let name = |field: &Field| match field {
            Field::FrictionCoefficient => format!("{field} or {}", Field::FrictionForceN),
            _ => field.to_string(),
        };
        let missing = missing.iter().map(name).collect::<Vec<_>>().join(", ");
        let header = cells.join(" | ");
        return Err((found, trouble.unwrap_or(LogError::NoHeader { line, header, missing, hint })));
    }
    if let Some(trouble) = trouble {
        return Err((found, trouble));
    }
    if has(Field::FrictionCoefficient) {
        columns.retain(|column| column.field != Field::FrictionForceN);
    }
    Ok(columns)
}

/// How to choose an unused column for a missing field whose unit it has. The choice is left to the user, since a force
/// may be normal or tangential.
fn hint(field: Field, free: &[&String]) -> Option<String> {
    let fits = |cell: &&&String| split_unit(cell).1.is_some_and(|unit| !unit.is_empty() && field.unit(&unit).is_some());
    let column = free.iter().find(fits)?;
    Some(format!("; if {column:?} is {field}, use --column '{field}={column}'"))
}

/// Name and unit of `name [unit]`, `name (unit)`, `name / unit` or `name in unit`.
fn split_unit(cell: &str) -> (&str, Option<String>) {
    let cell = cell.trim();
    for (open, close) in [('[', ']'), ('(', ')'), ('{', '}')] {
        if let Some((name, unit)) = cell.strip_suffix(close).and_then(|cell| cell.rsplit_once(open)) {
            return (name.trim(), Some(unit.trim().to_owned()));
        }
    }
    for between in [" / ", " in "] {
        if let Some((name, unit)) = cell.split_once(between) {
            return (name.trim(), Some(unit.trim().to_owned()));
        }
    }
    (cell, None)
}

/// The unit of a column whose name says that it contains `field`; empty if the name has no unit.
fn recognise(cell: &str, field: Field) -> Option<String> {
    let (name, unit) = split_unit(cell);
    let name = name.to_lowercase().replace('µ', "μ");
    let words: Vec<&str> = name.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).collect();
    let is_name = |words: &[&str]| field.synonyms().contains(&words.join("_").as_str());
    if is_name(&words) {
        return Some(unit.unwrap_or_else(|| if name == "rpm" { name.clone() } else { String::new() }));
    }
    if unit.is_some() {
        return None;
    }
    // `normal_load_n`, `disc_speed_rad_s`: the last one or two words are the unit.
    (1..=2).find_map(|count| {
        let (name, unit) = words.split_at_checked(words.len().checked_sub(count)?)?;
        let unit = unit.join("_");
        (is_name(name) && field.unit(&unit).is_some()).then_some(unit)
    })
}

struct Row {
    line: usize,
    cells: csv::StringRecord,
}

impl Row {
    fn cell(&self, column: &Column) -> Result<&str, LogError> {
        self.cells.get(column.index).ok_or_else(|| LogError::Short {
            line: self.line,
            cells: self.cells.len(),
            column: column.header.clone(),
            number: column.index + 1,
        })
    }

    fn time_text(&self, columns: &[Column]) -> String {
        let time = columns.iter().find(|column| column.field == Field::Time);
        time.and_then(|column| self.cells.get(column.index)).unwrap_or_default().to_owned()
    }
}

/// The rows below the header, without empty ones.
struct Rows<'t> {
    text: &'t str,
    records: csv::StringRecordsIntoIter<&'t [u8]>,
    /// Line number corrected for empty lines and CR LF: the CSV reader counts line breaks before a record and misses
    /// those.
    line: usize,
    counted: usize,
}

impl<'t> Rows<'t> {
    fn below(text: &'t str, header: &Header) -> Self {
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
fn check_lines(text: &str) -> Result<(), LogError> {
    match text.lines().position(|line| line.len() > LONGEST_LINE) {
        Some(at) => Err(LogError::Text { line: at + 1, reason: format!("longer than {LONGEST_LINE} bytes") }),
        None => Ok(()),
    }
}

/// Whether the line below the header contains units: no cell begins with a digit, and some cells are units.
fn is_unit_row(row: &Row, columns: &[Column]) -> bool {
    let cells = || columns.iter().filter_map(|column| Some((column, row.cells.get(column.index)?)));
    let bare = |cell: &str| cell.trim_matches(['[', ']', '(', ')']).trim().to_owned();
    cells()
        .all(|(column, cell)| column.field.unit(&bare(cell)).is_some() || !cell.contains(|c: char| c.is_ascii_digit()))
        && cells()
            .any(|(column, cell)| column.field.unit(&bare(cell)).is_some_and(|(unit, _)| unit.len() > 1 || unit == "N"))
}

fn with_units(row: &Row, mut columns: Vec<Column>) -> Result<Vec<Column>, LogError> {
    for column in &mut columns {
        if column.unit.is_empty() {
            column.unit = row.cell(column)?.trim_matches(['[', ']', '(', ')']).trim().to_owned();
        }
    }
    Ok(columns)
}

/// Whether times are dates: the first one contains a `:`, or a `-` that is neither a sign nor part of an exponent.
fn is_iso(first: &Row, columns: &[Column]) -> bool {
    let first = first.time_text(columns);
    first.contains(':') || first.char_indices().any(|(at, c)| c == '-' && at >= 4 && !first.contains(['e', 'E']))
}

/// Sets the factor of a column's unit; an error if a required unit is missing.
fn resolve_unit(column: &mut Column, line: usize, iso: bool, options: &LogOptions) -> Result<(), LogError> {
    let field = column.field;
    if field == Field::Time && iso {
        column.unit.clear();
        return Ok(());
    }
    let mapped = options.columns.iter().any(|(mapped, _)| *mapped == field);
    if column.unit.is_empty() && mapped {
        // Chosen by the field's name, which contains the unit.
        column.unit = field.units().first().map(|(unit, _)| (*unit).to_owned()).unwrap_or_default();
    }
    match field.unit(&column.unit) {
        Some((_, factor)) => {
            column.factor = factor;
            Ok(())
        }
        None => Err(LogError::Unit {
            line,
            column: column.header.clone(),
            field,
            unit: column.unit.clone(),
            known: field
                .units()
                .iter()
                .map(|(unit, _)| *unit)
                .filter(|unit| *unit != "rad_s")
                .collect::<Vec<_>>()
                .join(", "),
        }),
    }
}

/// Detects the decimal sign. A cell that contains both comma and point decides: the last one is the decimal sign.
/// Otherwise cells with only one of them decide, unless both kinds occur.
fn decimal_sign(
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

fn sample(
    row: &Row,
    columns: &[Column],
    decimal: char,
    iso: bool,
    absolute: &mut Option<bool>,
    options: &LogOptions,
) -> Result<Sample, LogError> {
    let mut sample = Sample { stamp_ns: 0, normal_load_n: 0.0, disc_speed_rad_s: 0.0, friction_coefficient: 0.0 };
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
        let number = plain_number(cell, decimal).and_then(|text| text.parse::<f64>().ok());
        let value = number.filter(|value| value.is_finite()).ok_or_else(|| wrong("a finite number"))? * column.factor;
        let (target, range) = match column.field {
            Field::NormalLoadN => (&mut sample.normal_load_n, Some(options.normal_load_n)),
            Field::DiscSpeedRadS => (&mut sample.disc_speed_rad_s, Some(options.disc_speed_rad_s)),
            Field::FrictionCoefficient => (&mut sample.friction_coefficient, None),
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

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use proptest::prelude::*;

    const T0: i64 = 946_684_800_000_000_000;

    fn read(text: &str) -> Result<TribometerLog, LogError> {
        parse(text, &LogOptions::default())
    }

    fn samples(text: &str) -> Vec<(i64, f64, f64, f64)> {
        let log = read(text).unwrap_or_else(|error| panic!("{error}"));
        let parts = |s: &Sample| (s.stamp_ns - T0, s.normal_load_n, s.disc_speed_rad_s, s.friction_coefficient);
        log.samples.iter().map(parts).collect()
    }

    #[test]
    fn our_own_names() {
        let text = "time_s,normal_load_n,disc_speed_rad_s,friction_coefficient\n0,500,13,0.35\n0.002,501.5,13,0.36\n";
        assert_eq!(samples(text), [(0, 500.0, 13.0, 0.35), (2_000_000, 501.5, 13.0, 0.36)]);
    }

    #[test]
    fn a_german_log_in_latin_1_with_lines_before() {
        let bytes =
            b"Pr\xfcfstand 7\r\nDatum;31.01.2024\r\n\r\nZeit [ms];Normalkraft [kN];Drehzahl (1/min);Reibwert [-]\r\n\
                      0,5;0,5;120;0,35\r\n1,0;1.000,25;-60;0,4\r\n";
        let mut options = LogOptions { normal_load_n: [0.0, 1e7], ..LogOptions::default() };
        let log = parse(&decode_text(bytes), &options).unwrap();
        assert_eq!((log.separator, log.decimal), (';', ','));
        assert_eq!(log.samples[0].stamp_ns, T0 + 500_000);
        assert_eq!(log.samples[0].normal_load_n, 500.0);
        assert!((log.samples[0].disc_speed_rad_s - 4.0 * std::f64::consts::PI).abs() < 1e-12);
        assert_eq!(log.samples[1].normal_load_n, 1_000_250.0);
        options.normal_load_n = [0.0, 1e6];
        let error = parse(&decode_text(bytes), &options).unwrap_err();
        let column = "Normalkraft [kN]".to_owned();
        assert_eq!(error, LogError::Limit { line: 6, column, value: 1_000_250.0, min: 0.0, max: 1e6 });
    }

    #[test]
    fn units_in_the_line_below_tabs_utf_16_and_a_friction_force() {
        let text = "Time\tLoad\tSpeed\tFriction force\ns\tkN\trpm\tN\n0\t0.5\t60\t175\n1\t0\t60\t3\n";
        let mut bytes = vec![0xff, 0xfe];
        bytes.extend(text.encode_utf16().flat_map(u16::to_le_bytes));
        let got = samples(&decode_text(&bytes));
        assert_eq!(got[0].3, 0.35);
        assert!((got[0].2 - TAU).abs() < 1e-12);
        assert_eq!(got[1].3, 0.0, "no load, no contact");
    }

    #[test]
    fn absolute_times_keep_their_nanoseconds() {
        let head = "timestamp,load_n,speed_rad_s,mu\n";
        let first = |line: &str| read(&format!("{head}{line},500,13,0.3\n")).unwrap().samples[0].stamp_ns;
        assert_eq!(first("2024-01-31T12:00:00.123456789Z"), 1_706_702_400_123_456_789);
        assert_eq!(first("2024-01-31T13:00:00.5+01:00"), 1_706_702_400_500_000_000);
        assert_eq!(first("2024-01-31 12:00:00.25"), 1_706_702_400_250_000_000);
        let unix = read("time_s,load_n,speed_rad_s,mu\n1706702400.123456789,500,13,0.3\n").unwrap();
        assert_eq!(unix.samples[0].stamp_ns, 1_706_702_400_123_456_789);
    }

    #[test]
    fn columns_can_be_named() {
        let text = "t,F_norm,n,cof\n0,500,13,0.3\n";
        let columns = vec![
            (Field::Time, "t".to_owned()),
            (Field::NormalLoadN, "F_norm".to_owned()),
            (Field::DiscSpeedRadS, "n".to_owned()),
        ];
        let log = parse(text, &LogOptions { columns: columns.clone(), ..LogOptions::default() }).unwrap();
        assert_eq!(log.samples[0].normal_load_n, 500.0);
        let columns = vec![(Field::NormalLoadN, "F".to_owned())];
        let error =
            parse("t [s],F_norm,speed_rpm,cof\n", &LogOptions { columns, ..LogOptions::default() }).unwrap_err();
        assert!(matches!(error, LogError::NoSuchColumn { field: Field::NormalLoadN, .. }), "{error}");
    }

    #[test]
    fn what_is_wrong_is_named() {
        let head = "time_s,load_n,speed_rad_s,mu\n";
        let error = |lines: &str| read(&format!("{head}{lines}")).unwrap_err().to_string();
        assert_eq!(error("0,500,13,NaN\n"), "line 2, column \"mu\": \"NaN\" is not a finite number");
        assert_eq!(error("0,500,13,0.3\n0,,13,0.3\n"), "line 3, column \"load_n\": \"\" is not a finite number");
        assert_eq!(error("0,500,13,0.3\n\n0,500,13,0.3\n"), "line 4: time \"0\" is not later than that of line 2");
        assert_eq!(error("0,500\n"), "line 2: 2 cells, where column \"speed_rad_s\" is the 3th");
        assert_eq!(error("0,500,13,2.5\n"), "line 2, column \"mu\": 2.5 is outside of 0 to 2");
        assert_eq!(error(""), "no samples below line 1");
        assert!(matches!(read("time_s,load,speed_rpm,mu\n0,1,1,0\n"), Err(LogError::Unit { .. })));
        assert!(matches!(read("time_s,load_n,load_kn,speed_rpm,mu\n"), Err(LogError::TwoColumns { .. })));
        assert!(matches!(read("time_s,speed_rpm,mu\n"), Err(LogError::NoHeader { line: 1, .. })));
        let mixed = "time_s;load_n;speed_rad_s;mu\n0;1.234;13;0,3\n";
        assert!(matches!(read(mixed), Err(LogError::Decimal { .. })));
        let log = parse(mixed, &LogOptions { decimal: Some(','), ..LogOptions::default() }).unwrap();
        assert_eq!(log.samples[0].normal_load_n, 1234.0);
    }

    #[test]
    fn bad_lines_can_be_left_out() {
        let options = LogOptions { skip_bad_lines: true, ..LogOptions::default() };
        let log = parse("time_s,load_n,speed_rad_s,mu\n0,500,13,0.3\n1,x,13,0.3\n2,500,13,0.3\n", &options).unwrap();
        assert_eq!((log.samples.len(), log.skipped), (2, 1));
        assert!(matches!(log.first_skipped, Some(LogError::Value { line: 3, .. })));
    }

    proptest! {
        #[test]
        fn any_bytes_are_an_answer_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = read(&decode_text(&bytes));
        }

        #[test]
        fn any_lines_below_a_header_are_an_answer_or_an_error(text in "[-0-9eE.,;:TZ +\t\"\n\u{e4}]{0,200}") {
            let _ = read(&format!("time_s;load_n;speed_rpm;mu\n{text}"));
            let _ = read(&format!("time_s,load_n,speed_rpm,mu\n{text}"));
        }
    }
}
