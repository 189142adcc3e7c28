//! Matrix Market files: coordinate and array; real and integer; general, symmetric and skew-symmetric.
//!
//! Source: Boisvert, Pozo, Remington, "The Matrix Market exchange formats", NISTIR 5935 (1996).

use std::io::BufRead;

use faer::sparse::Triplet;

use super::RigError;
use super::lines::{Lines, found, refuse};
use crate::reduction::SparseMatrix;

/// The entries of a matrix file, including those mirrored at the diagonal if its header declares a symmetry.
#[derive(Clone, Debug, PartialEq)]
pub struct Listed {
    pub rows: usize,
    pub columns: usize,
    /// `(row, column, value)`, counted from 0. Entries at the same position add up.
    pub entries: Vec<(usize, usize, f64)>,
}

impl Listed {
    /// Converts to compressed sparse columns.
    ///
    /// # Errors
    /// [`RigError::Shape`] if there is not enough memory.
    pub fn to_sparse(&self, file: &str) -> Result<SparseMatrix, RigError> {
        let triplets: Vec<_> =
            self.entries.iter().map(|&(row, column, value)| Triplet::new(row, column, value)).collect();
        SparseMatrix::try_new_from_triplets(self.rows, self.columns, &triplets).map_err(|error| RigError::Shape {
            file: file.to_owned(),
            field: "matrix".to_owned(),
            value: format!("{}x{} ({error:?})", self.rows, self.columns),
            limit: "one that fits into memory".to_owned(),
        })
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Symmetry {
    General,
    Symmetric,
    Skew,
}

/// Dimensions and symmetry of a matrix, from the header of its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    pub rows: usize,
    pub columns: usize,
    /// Sign of the mirrored entries, which the file does not list: `+1` if symmetric, `-1` if skew-symmetric, `None` if
    /// general.
    pub mirrored: Option<i8>,
}

/// Reads a Matrix Market file; `file` names it in errors. Memory is proportional to the entries that are listed, not to
/// the sizes the header claims.
///
/// # Errors
/// [`RigError::Line`].
pub fn read(file: &str, bytes: &[u8]) -> Result<Listed, RigError> {
    let mut entries = vec![];
    let Size { rows, columns, mirrored } = read_entries(file, bytes, |row, column, value| {
        entries.push((row, column, value));
    })?;
    if let Some(sign) = mirrored {
        for index in 0..entries.len() {
            let (row, column, value) = entries[index];
            if row != column {
                entries.push((column, row, f64::from(sign) * value));
            }
        }
    }
    Ok(Listed { rows, columns, entries })
}

/// Reads a Matrix Market file line by line and calls `each` with row, column (from 0) and value of every listed entry,
/// in the order of the file. Entries of symmetric matrices lie on or below the diagonal, of skew-symmetric ones below
/// it.
///
/// # Errors
/// [`RigError::Line`].
pub fn read_entries(
    file: &str,
    input: impl BufRead,
    mut each: impl FnMut(usize, usize, f64),
) -> Result<Size, RigError> {
    let mut lines = Lines::new(file, input);
    let header = lines.advance()?.map(|(_, header)| header.to_owned()).unwrap_or_default();
    let (coordinate, integer, symmetry) =
        read_header(&header).map_err(|(field, value, limit)| refuse(file, 1, field, value, limit))?;
    let size_limit = if coordinate { "rows, columns and entries" } else { "rows and columns" };
    let sizes = loop {
        match lines.advance()? {
            None => return Err(lines.refuse("size", "is missing".to_owned(), size_limit)),
            Some((_, line)) if is_content(line) => break line.to_owned(),
            Some(_) => {}
        }
    };
    let numbers: Option<Vec<usize>> = sizes.split_whitespace().map(|word| word.parse().ok()).collect();
    let (rows, columns, listed) = match (numbers.as_deref(), coordinate) {
        (Some(&[rows, columns, listed]), true) => (rows, columns, listed as u128),
        (Some(&[rows, columns]), false) => (rows, columns, count_of_array(rows, columns, symmetry)),
        _ => return Err(lines.refuse("size", found(&sizes), size_limit)),
    };
    if symmetry != Symmetry::General && rows != columns {
        let limit = "a square matrix, as its header says symmetric";
        return Err(lines.refuse("size", format!("is {rows}x{columns}"), limit));
    }

    let (mut seen, mut array_row, mut array_column) = (0_u128, first_row(0, symmetry), 0_usize);
    while let Some((line, content)) = lines.advance()? {
        if !is_content(content) {
            continue;
        }
        let refuse = |field: &str, value: String, limit: &str| refuse(file, line, field, value, limit);
        if seen == listed {
            let value = format!("go on with {}", &found(content)[3..]);
            return Err(refuse("entries", value, "no more than the size says"));
        }
        seen += 1;
        let mut words = content.split_ascii_whitespace();
        let words = [words.next(), words.next(), words.next(), words.next()];
        let (row, column, word) = match (words, coordinate) {
            ([Some(row), Some(column), Some(word), None], true) => {
                let index = |word: &str, limit: usize, what: &str| match word.parse::<usize>() {
                    Ok(index) if (1..=limit).contains(&index) => Ok(index - 1),
                    _ => Err(refuse(what, found(word), &format!("1 to {limit}"))),
                };
                (index(row, rows, "row")?, index(column, columns, "column")?, word)
            }
            ([Some(word), None, ..], false) => {
                let position = (array_row, array_column);
                array_row += 1;
                // The last column of a skew-symmetric array lists no rows.
                if array_row >= rows {
                    array_column += 1;
                    array_row = first_row(array_column, symmetry);
                }
                (position.0, position.1, word)
            }
            (_, true) => return Err(refuse("entry", found(content), "row, column and value")),
            (_, false) => return Err(refuse("entry", found(content), "one value")),
        };
        let value = if integer { word.parse::<i64>().ok().map(|value| value as f64) } else { word.parse::<f64>().ok() };
        let kind = if integer { "an integer" } else { "a finite number" };
        let value = match value {
            Some(value) if value.is_finite() => value,
            _ => return Err(refuse("value", found(word), kind)),
        };
        let allowed = match symmetry {
            Symmetry::General => true,
            Symmetry::Symmetric => row >= column,
            Symmetry::Skew => row > column,
        };
        if !allowed {
            let place = format!("is at row {}, column {}", row + 1, column + 1);
            let skew = symmetry == Symmetry::Skew;
            let limit = if skew { "one below the diagonal" } else { "one on or below the diagonal" };
            return Err(refuse("entry", place, limit));
        }
        each(row, column, value);
    }
    if seen != listed {
        return Err(lines.refuse("entries", format!("end after {seen}"), &format!("{listed}, as the size says")));
    }
    let mirrored = match symmetry {
        Symmetry::General => None,
        Symmetry::Symmetric => Some(1),
        Symmetry::Skew => Some(-1),
    };
    Ok(Size { rows, columns, mirrored })
}

/// Whether a line is neither empty nor a comment.
fn is_content(line: &str) -> bool {
    !line.is_empty() && !line.starts_with('%')
}

type HeaderError = (&'static str, String, &'static str);

/// Parses `%%MatrixMarket matrix <format> <field> <symmetry>`. Returns whether the format is coordinate, whether the
/// field is integer, and the symmetry.
fn read_header(header: &str) -> Result<(bool, bool, Symmetry), HeaderError> {
    let words: Vec<String> = header.split_whitespace().take(6).map(str::to_ascii_lowercase).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let &[banner, object, format, field, symmetry] = words.as_slice() else {
        let value = found(header);
        return Err((
            "header",
            value,
            "%%MatrixMarket matrix coordinate|array real|integer general|symmetric|skew-symmetric",
        ));
    };
    if banner != "%%matrixmarket" {
        return Err(("banner", found(banner), "%%MatrixMarket"));
    }
    if object != "matrix" {
        return Err(("object", found(object), "matrix"));
    }
    let coordinate = match format {
        "coordinate" => true,
        "array" => false,
        _ => return Err(("format", found(format), "coordinate or array")),
    };
    let integer = match field {
        "real" | "double" => false,
        "integer" => true,
        "complex" => return Err(("field", found(field), "real or integer: complex matrices are not supported")),
        "pattern" => return Err(("field", found(field), "real or integer: a pattern has no values")),
        _ => return Err(("field", found(field), "real or integer")),
    };
    let symmetry = match symmetry {
        "general" => Symmetry::General,
        "symmetric" => Symmetry::Symmetric,
        "skew-symmetric" => Symmetry::Skew,
        "hermitian" => {
            return Err((
                "symmetry",
                found(symmetry),
                "general, symmetric or skew-symmetric: hermitian is for complex matrices",
            ));
        }
        _ => return Err(("symmetry", found(symmetry), "general, symmetric or skew-symmetric")),
    };
    Ok((coordinate, integer, symmetry))
}

/// Number of values that an array file lists.
fn count_of_array(rows: usize, columns: usize, symmetry: Symmetry) -> u128 {
    let (rows, columns) = (rows as u128, columns as u128);
    match symmetry {
        Symmetry::General => rows.saturating_mul(columns),
        Symmetry::Symmetric => rows.saturating_mul(rows.saturating_add(1)) / 2,
        Symmetry::Skew => rows.saturating_mul(rows.saturating_sub(1)) / 2,
    }
}

/// The first row that an array file lists in a column.
fn first_row(column: usize, symmetry: Symmetry) -> usize {
    match symmetry {
        Symmetry::General => 0,
        Symmetry::Symmetric => column,
        Symmetry::Skew => column.saturating_add(1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dense(text: &str) -> Vec<Vec<f64>> {
        let listed = read("a.mtx", text.as_bytes()).unwrap_or_else(|error| panic!("{error}"));
        let mut rows = vec![vec![0.0; listed.columns]; listed.rows];
        for (row, column, value) in listed.entries {
            rows[row][column] += value;
        }
        rows
    }

    #[test]
    fn every_form() {
        let head = "%%MatrixMarket matrix";
        assert_eq!(
            dense(&format!("{head} coordinate real general\n% a comment\n\n 2 3 2\n1 3 1.5e1\n\n%more\n2 1 -2\n")),
            [[0.0, 0.0, 15.0], [-2.0, 0.0, 0.0]]
        );
        assert_eq!(
            dense(&format!("{head} Coordinate Integer Symmetric\r\n2 2 2\r\n1 1 4\r\n2 1 3\r\n")),
            [[4.0, 3.0], [3.0, 0.0]]
        );
        assert_eq!(dense(&format!("{head} coordinate real skew-symmetric\n2 2 1\n2 1 3")), [[0.0, -3.0], [3.0, 0.0]]);
        assert_eq!(dense(&format!("{head} array real general\n2 2\n1\n2\n3\n4\n")), [[1.0, 3.0], [2.0, 4.0]]);
        assert_eq!(
            dense(&format!("{head} array integer symmetric\n3 3\n1\n2\n3\n4\n5\n6\n")),
            [[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]]
        );
        assert_eq!(
            dense(&format!("{head} array real skew-symmetric\n3 3\n1\n2\n3\n")),
            [[0.0, -1.0, -2.0], [1.0, 0.0, -3.0], [2.0, 3.0, 0.0]]
        );
    }

    #[test]
    fn errors_name_line_value_and_limit() {
        let head = "%%MatrixMarket matrix";
        for (text, expected) in [
            (
                "".to_owned(),
                "a.mtx, line 1: header is ``; expected %%MatrixMarket matrix coordinate|array real|integer general|symmetric|skew-symmetric",
            ),
            (
                format!("{head} coordinate pattern general\n1 1 0"),
                "a.mtx, line 1: field is `pattern`; expected real or integer: a pattern has no values",
            ),
            (
                format!("{head} coordinate complex general\n1 1 0"),
                "a.mtx, line 1: field is `complex`; expected real or integer: complex matrices are not supported",
            ),
            (
                format!("{head} coordinate real hermitian\n1 1 0"),
                "a.mtx, line 1: symmetry is `hermitian`; expected general, symmetric or skew-symmetric: hermitian is for complex matrices",
            ),
            (
                format!("{head} coordinate real general\n2 2\n"),
                "a.mtx, line 2: size is `2 2`; expected rows, columns and entries",
            ),
            (format!("{head} coordinate real general\n2 2 1\n3 1 1.0\n"), "a.mtx, line 3: row is `3`; expected 1 to 2"),
            (
                format!("{head} coordinate real general\n2 2 1\n1 0 1.0\n"),
                "a.mtx, line 3: column is `0`; expected 1 to 2",
            ),
            (
                format!("{head} coordinate real general\n2 2 1\n1 1 nan\n"),
                "a.mtx, line 3: value is `nan`; expected a finite number",
            ),
            (
                format!("{head} coordinate integer general\n2 2 1\n1 1 1.5\n"),
                "a.mtx, line 3: value is `1.5`; expected an integer",
            ),
            (
                format!("{head} coordinate real symmetric\n2 2 1\n1 2 1\n"),
                "a.mtx, line 3: entry is at row 1, column 2; expected one on or below the diagonal",
            ),
            (
                format!("{head} coordinate real general\n2 2 2\n1 1 1\n"),
                "a.mtx, line 3: entries end after 1; expected 2, as the size says",
            ),
            (
                format!("{head} coordinate real general\n2 2 1\n1 1 1\n2 2 1\n"),
                "a.mtx, line 4: entries go on with `2 2 1`; expected no more than the size says",
            ),
            (
                format!("{head} array real general\n1000000000000 1000000000000\n1\n"),
                "a.mtx, line 3: entries end after 1; expected 1000000000000000000000000, as the size says",
            ),
            (
                format!("{head} coordinate real symmetric\n2 3 0\n"),
                "a.mtx, line 2: size is 2x3; expected a square matrix, as its header says symmetric",
            ),
        ] {
            assert_eq!(read("a.mtx", text.as_bytes()).unwrap_err().to_string(), expected);
        }
    }
}
