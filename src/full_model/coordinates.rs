//! Text matrices of CalculiX and Abaqus: one entry per line, and the labels of rows.
//!
//! Lines of three values hold row, column, entry (CalculiX `.sti`, `.mas`; Abaqus `FORMAT=COORDINATE`). Lines of five
//! hold node, direction, node, direction, entry (Abaqus `FORMAT=MATRIX INPUT` and `LABELS`). Values are separated by
//! commas or spaces; lines that begin with `*` are skipped. If only one triangle is listed, the matrix is symmetric.
//! CalculiX lists the `node.direction` of each row in its `.dof` file.
//!
//! Source: Dhondt, "CalculiX CrunchiX user's manual version 2.20", *FREQUENCY, parameter SOLVER=MATRIXSTORAGE; Abaqus
//! analysis user's guide, "Generating structural matrices".

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::BufRead;

use super::entries::{Entries, MOST_ROWS};
use super::tables::Nodes;
use crate::rig::RigError;
use crate::rig::lines::{Lines, found, refuse};

/// A diagonal entry of at least this marks a constrained row: Abaqus writes boundary conditions this way.
const HELD: f64 = 1e35;

/// The label of a row: node label, and direction from 0.
pub type Label = (u64, usize);

/// An entry as listed in a file; rows and columns are numbered from 0.
enum Listed {
    Numbers(usize, usize, f64),
    Labels(Label, Label, f64),
}

/// Calls `each` with the line number and content of every entry.
fn scan(
    file: &str,
    input: impl BufRead,
    mut each: impl FnMut(usize, Listed) -> Result<(), RigError>,
) -> Result<(), RigError> {
    let mut lines = Lines::new(file, input);
    let mut form = None;
    while let Some((line, content)) = lines.advance()? {
        if content.is_empty() || content.starts_with('*') {
            continue;
        }
        let mut words = [""; 6];
        let mut count = 0;
        for word in content.split([',', ' ', '\t']).filter(|word| !word.is_empty()).take(6) {
            words[count] = word;
            count += 1;
        }
        let refuse = |field: &str, word: &str, limit: &str| refuse(file, line, field, found(word), limit);
        let value = |word: &str| match word.replace(['D', 'd'], "e").parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(refuse("value", word, "a finite number")),
        };
        let number = |field: &str, word: &str| match word.parse::<usize>() {
            Ok(number) if (1..=MOST_ROWS).contains(&number) => Ok(number),
            _ => Err(refuse(field, word, "a whole number from 1 on")),
        };
        let direction = |word: &str| match word.parse::<usize>() {
            Ok(number @ 1..=6) => Ok(number - 1),
            _ => Err(refuse("direction", word, "1 to 6")),
        };
        // Every line must have as many values as the first: a truncated line of labels could pass for one of row
        // numbers.
        let first = *form.get_or_insert(count);
        if count != first {
            return Err(refuse("entry", content, &format!("{first} values, as in the first line")));
        }
        let listed = match count {
            3 => Listed::Numbers(number("row", words[0])? - 1, number("column", words[1])? - 1, value(words[2])?),
            5 => {
                let label = |k: usize| Ok((number("node", words[k])? as u64, direction(words[k + 1])?));
                Listed::Labels(label(0)?, label(2)?, value(words[4])?)
            }
            _ => {
                let limit = "row, column and value, or node, direction, node, direction and value";
                return Err(refuse("entry", content, limit));
            }
        };
        each(line, listed)?;
    }
    Ok(())
}

/// The rows of a matrix that lists labels, ascending, without constrained rows.
///
/// # Errors
/// [`RigError::Line`].
pub fn rows_of(file: &str, input: impl BufRead) -> Result<Vec<Label>, RigError> {
    let mut held: BTreeMap<Label, bool> = BTreeMap::new();
    scan(file, input, |line, listed| match listed {
        Listed::Labels(row, column, value) => {
            *held.entry(row).or_default() |= row == column && value >= HELD;
            held.entry(column).or_default();
            Ok(())
        }
        Listed::Numbers(..) => {
            let limit = "node, direction, node, direction and value, or `rows` with node and direction of every number";
            Err(refuse(file, line, "entry", "has a row number".to_owned(), limit))
        }
    })?;
    Ok(held.into_iter().filter(|(_, held)| !held).map(|(label, _)| label).collect())
}

/// Reads a matrix of `n` rows; `row_of` maps labels to rows. Returns the entries and the sign of the mirrored triangle
/// if only one is listed.
///
/// A label without a row must be constrained. Labels constrained in this matrix are added to `held`. Any other unknown
/// label is an error, since it usually means that a file was truncated.
///
/// # Errors
/// [`RigError::Line`], also for a label that is neither in `rows_file` nor constrained.
pub fn read(
    file: &str,
    input: impl BufRead,
    (n, rows_file): (usize, &str),
    row_of: &HashMap<Label, usize>,
    held: &mut HashSet<Label>,
) -> Result<(Entries, Option<i8>), RigError> {
    let mut entries = Entries::default();
    let mut without_row: HashMap<Label, usize> = HashMap::new();
    let (mut below, mut above) = (false, false);
    scan(file, input, |line, listed| {
        let (row, column, value) = match listed {
            Listed::Numbers(row, column, value) => {
                for (what, index) in [("row", row), ("column", column)] {
                    if index >= n {
                        return Err(refuse(file, line, what, found(&(index + 1).to_string()), &format!("1 to {n}")));
                    }
                }
                (row, column, value)
            }
            Listed::Labels(row, column, value) => match (row_of.get(&row), row_of.get(&column)) {
                (Some(&row), Some(&column)) => (row, column, value),
                (row_known, column_known) => {
                    if row == column && value >= HELD {
                        held.insert(row);
                    }
                    for (label, known) in [(row, row_known), (column, column_known)] {
                        if known.is_none() {
                            without_row.entry(label).or_insert(line);
                        }
                    }
                    // A constrained degree of freedom does not move: its entries are dropped.
                    return Ok(());
                }
            },
        };
        below |= row > column;
        above |= row < column;
        entries.push(row, column, value);
        Ok(())
    })?;
    // The first line, so that the error does not depend on the order of a hash map.
    let unknown = without_row.into_iter().filter(|(label, _)| !held.contains(label)).min_by_key(|&(_, line)| line);
    if let Some(((node, direction), line)) = unknown {
        let value = format!("is at node {node}, direction {}", direction + 1);
        let limit = format!("a row of {rows_file}, or one that the stiffness constrains; the files may be truncated");
        return Err(refuse(file, line, "entry", value, &limit));
    }
    Ok((entries, if below && above { None } else { Some(1) }))
}

/// The line of an entry or of its mirror image; the last line if neither is listed.
///
/// # Errors
/// [`RigError::Line`].
pub fn line_of(
    file: &str,
    input: impl BufRead,
    row_of: &HashMap<Label, usize>,
    (row, column): (usize, usize),
) -> Result<usize, RigError> {
    let (mut found, mut last) = (None, 1);
    scan(file, input, |line, listed| {
        let place = match listed {
            Listed::Numbers(row, column, _) => (Some(row), Some(column)),
            Listed::Labels(row, column, _) => (row_of.get(&row).copied(), row_of.get(&column).copied()),
        };
        if found.is_none() && (place == (Some(row), Some(column)) || place == (Some(column), Some(row))) {
            found = Some(line);
        }
        last = line;
        Ok(())
    })?;
    Ok(found.unwrap_or(last))
}

/// Reads a CalculiX `.dof` file: the `node.direction` of each row.
///
/// # Errors
/// [`RigError::Line`].
pub fn dof(file: &str, input: impl BufRead) -> Result<Vec<Label>, RigError> {
    let mut lines = Lines::new(file, input);
    let mut rows = vec![];
    while let Some((line, content)) = lines.advance()? {
        if content.is_empty() {
            continue;
        }
        let label = content.split_once('.').and_then(|(node, direction)| {
            let direction = direction.parse::<usize>().ok().filter(|direction| (1..=6).contains(direction))?;
            Some((node.parse::<u64>().ok()?, direction - 1))
        });
        match label {
            Some(label) => rows.push(label),
            None => return Err(refuse(file, line, "row", found(content), "node.direction, the direction from 1 to 6")),
        }
    }
    Ok(rows)
}

/// Reads the nodes of a CalculiX or Abaqus deck, the lines below `*NODE`. Lengths are multiplied by `scale`.
///
/// # Errors
/// [`RigError::Line`], also for nodes in another coordinate system than the global one.
pub fn deck_nodes(file: &str, input: impl BufRead, scale: f64) -> Result<Nodes, RigError> {
    let mut lines = Lines::new(file, input);
    let (mut labels, mut positions, mut seen) = (vec![], vec![], HashMap::new());
    let mut inside = false;
    while let Some((line, content)) = lines.advance()? {
        if content.starts_with("**") || content.is_empty() {
            continue;
        }
        if let Some(keyword) = content.strip_prefix('*') {
            let mut words = keyword.split(',').map(str::trim);
            let keyword = words.next().unwrap_or("");
            inside = keyword.eq_ignore_ascii_case("NODE");
            let mut system =
                words.filter_map(|word| word.split_once('=')).map(|(key, value)| (key.trim(), value.trim()));
            let turned =
                |(key, value): (&str, &str)| key.eq_ignore_ascii_case("SYSTEM") && !value.eq_ignore_ascii_case("R");
            if keyword.eq_ignore_ascii_case("SYSTEM") || inside && system.any(turned) {
                return Err(refuse(file, line, "nodes", found(content), "nodes in the global rectangular system"));
            }
            continue;
        }
        if !inside {
            continue;
        }
        let cells: Vec<&str> = content.split(',').map(str::trim).filter(|cell| !cell.is_empty()).collect();
        let node = cells.first().and_then(|label| label.parse::<u64>().ok());
        let coordinates: Vec<f64> = cells.iter().skip(1).filter_map(|cell| cell.parse().ok()).collect();
        match (node, coordinates.as_slice()) {
            (Some(label), &[x, y, z]) if [x, y, z].iter().all(|value| value.is_finite()) && cells.len() == 4 => {
                if let Some(before) = seen.insert(label, line) {
                    let limit = format!("every node once; line {before} has it too");
                    return Err(refuse(file, line, "node", found(&label.to_string()), &limit));
                }
                labels.push(label);
                positions.push([scale * x, scale * y, scale * z]);
            }
            _ => return Err(refuse(file, line, "node", found(content), "a node and three finite coordinates")),
        }
    }
    if labels.is_empty() {
        return Err(lines.refuse("nodes", "are missing".to_owned(), "lines below *NODE"));
    }
    Ok(Nodes::new(&labels, positions))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_of_another_coordinate_system_are_refused() {
        let read = |text: &str| deck_nodes("a.inp", text.as_bytes(), 1.0).map(|nodes| nodes.positions);
        assert_eq!(read("*NODE, NSET=ALL, SYSTEM=R\n1, 1., 0., 0.\n").unwrap(), [[1.0, 0.0, 0.0]]);
        for (text, line) in [("*Node, System=C\n1, 1., 0., 0.\n", 1), ("** part\n*SYSTEM\n0., 0., 1.\n", 2)] {
            let refused = read(text).unwrap_err().to_string();
            assert!(refused.contains(&format!("a.inp, line {line}: nodes is `")), "{refused}");
        }
    }
}
