//! Finds the line that names the columns, and their units in it or in the line below.

use super::rows::Row;
use super::{Column, Field, LogError, LogOptions};

pub(super) struct Header {
    pub line: usize,
    pub separator: u8,
    /// All names in the line.
    pub cells: Vec<String>,
    pub columns: Vec<Column>,
    /// Offset at which the lines below begin, bytes.
    pub end: usize,
}

/// The first line that contains the names of all required columns.
pub(super) fn find_header(text: &str, options: &LogOptions) -> Result<Header, LogError> {
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
        if options.constants.iter().any(|(constant, _)| *constant == field) {
            continue;
        }
        let column = |index: usize, unit: String, reversed: bool| Column {
            field,
            header: cells.get(index).cloned().unwrap_or_default(),
            unit,
            reversed,
            index,
            factor: 1.0,
        };
        if let Some((_, wanted)) = options.columns.iter().find(|(mapped, _)| *mapped == field) {
            match wanted_column(cells, wanted) {
                Some((index, reversed)) => {
                    let (_, unit) = split_unit(wanted);
                    columns.push(column(index, unit.unwrap_or_default(), reversed));
                }
                None => {
                    trouble.get_or_insert(LogError::NoSuchColumn { line, field, header: wanted.clone() });
                }
            }
            continue;
        }
        let is_mapped = |index: usize| {
            options.columns.iter().any(|(_, wanted)| wanted_column(cells, wanted).is_some_and(|(at, _)| at == index))
        };
        let mut found = cells.iter().enumerate().filter(|(index, _)| !is_mapped(*index));
        let mut found = found.by_ref().filter_map(|(index, cell)| Some((index, recognise(cell, field)?)));
        if let Some((index, unit)) = found.next() {
            if let Some((second, _)) = found.next() {
                if field.is_optional() {
                    continue;
                }
                trouble.get_or_insert(LogError::TwoColumns {
                    line,
                    field,
                    first: cells.get(index).cloned().unwrap_or_default(),
                    second: cells.get(second).cloned().unwrap_or_default(),
                });
            }
            columns.push(column(index, unit, false));
        }
    }
    let found = columns.len();
    let is_constant = |field| options.constants.iter().any(|(constant, _)| *constant == field);
    let has = |field| is_constant(field) || columns.iter().any(|column| column.field == field);
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

/// The index of the column called `wanted`, and whether its sign is reversed: `wanted` is then `-` and its name.
fn wanted_column(cells: &[String], wanted: &str) -> Option<(usize, bool)> {
    let called = |name: &str| cells.iter().position(|cell| cell == name.trim());
    let reversed = || Some((called(wanted.trim().strip_prefix('-')?)?, true));
    called(wanted).map(|index| (index, false)).or_else(reversed)
}

/// How to choose an unused column for a missing field whose unit it has, or a constant where there is none. The choice is
/// left to the user, since a force may be normal or tangential.
fn hint(field: Field, free: &[&String]) -> Option<String> {
    let has_unit =
        |unit: String| !unit.is_empty() && (field.unit(&unit).is_some() || field.sliding_unit(&unit).is_some());
    match free.iter().find(|cell| split_unit(cell).1.is_some_and(has_unit)) {
        Some(column) => Some(format!("; if {column:?} is {field}, use --column '{field}={column}'")),
        None if matches!(field, Field::NormalLoadN | Field::DiscSpeedRadS) => {
            Some(format!("; if it is the same in every line, use --constant {field}=VALUE"))
        }
        None => None,
    }
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

/// Whether the line below the header contains units: no cell begins with a digit, and some cells are units.
pub(super) fn is_unit_row(row: &Row, columns: &[Column]) -> bool {
    let cells = || columns.iter().filter_map(|column| Some((column, row.cells.get(column.index)?)));
    let bare = |cell: &str| cell.trim_matches(['[', ']', '(', ')']).trim().to_owned();
    cells()
        .all(|(column, cell)| column.field.unit(&bare(cell)).is_some() || !cell.contains(|c: char| c.is_ascii_digit()))
        && cells()
            .any(|(column, cell)| column.field.unit(&bare(cell)).is_some_and(|(unit, _)| unit.len() > 1 || unit == "N"))
}

pub(super) fn with_units(row: &Row, mut columns: Vec<Column>) -> Result<Vec<Column>, LogError> {
    for column in &mut columns {
        if column.unit.is_empty() {
            column.unit = row.cell(column)?.trim_matches(['[', ']', '(', ')']).trim().to_owned();
        }
    }
    Ok(columns)
}

/// Whether times are dates: the first one contains a `:`, or a `-` that is neither a sign nor part of an exponent.
pub(super) fn is_iso(first: &Row, columns: &[Column]) -> bool {
    let first = first.time_text(columns);
    first.contains(':') || first.char_indices().any(|(at, c)| c == '-' && at >= 4 && !first.contains(['e', 'E']))
}

/// Sets the factor of a column's unit; an error if a required unit is missing.
pub(super) fn resolve_unit(column: &mut Column, line: usize, iso: bool, options: &LogOptions) -> Result<(), LogError> {
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
    let sign = if column.reversed { -1.0 } else { 1.0 };
    match (field.unit(&column.unit), field.sliding_unit(&column.unit), options.radius_m) {
        (Some((_, factor)), ..) => column.factor = sign * factor,
        (None, Some((_, factor)), Some(radius_m)) => column.factor = sign * factor / radius_m,
        (None, Some((unit, _)), None) => {
            return Err(LogError::NoRadius { line, column: column.header.clone(), unit });
        }
        (None, None, _) => {
            let known = field.units().iter().chain(field.sliding_units());
            let known: Vec<&str> =
                known.map(|(unit, _)| *unit).filter(|unit| !["rad_s", "Fx"].contains(unit)).collect();
            return Err(LogError::Unit {
                line,
                column: column.header.clone(),
                field,
                unit: column.unit.clone(),
                known: known.join(", "),
            });
        }
    }
    Ok(())
}
