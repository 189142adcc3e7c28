//! `[pad]` and `[disc]`: matrices, nodes and rows of a substructure.

use std::collections::{HashMap, HashSet};
use std::io::BufRead;
use std::path::Path;

use super::coordinates::{self, Label};
use super::entries::{Entries, MOST_ROWS};
use super::files::Files;
use super::raw::RawPart;
use super::tables::{self, Nodes};
use super::{DampedModes, INTERNAL, PartGeometry};
use crate::reduction::{Asymmetry, FullPart, PartTurning, SparseMatrix, first_asymmetry};
use crate::rig::raw::OneOrMany;
use crate::rig::settings::{MOST_COORDINATES, at_most, within};
use crate::rig::{RigError, lines, matrix_market};

/// A part with its nodes and rows.
pub struct Part {
    pub part: FullPart,
    pub geometry: PartGeometry,
    /// Its nodes by label.
    pub nodes: Nodes,
    /// Row of each node index and direction.
    pub row_of: HashMap<(usize, usize), usize>,
    /// `α`, 1/s, and `β`, s, of Rayleigh damping `α M + β K`.
    pub rayleigh: [f64; 2],
    /// Matrices of a disc that turns.
    pub turning: PartTurning,
}

/// Property that a matrix must have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Property {
    /// Symmetric, with a complete diagonal that is not negative.
    Stiffness,
    /// Symmetric, with a complete diagonal above 0.
    Mass,
    Symmetric,
    /// Mirrored entries have opposite signs.
    Skew,
}

/// A matrix and the file it was read from.
struct Read<'a> {
    field: String,
    file: &'a str,
    matrix: SparseMatrix,
    row_of: &'a HashMap<Label, usize>,
}

/// Required properties of a matrix file, known before it is read.
pub struct Expected<'a> {
    pub rows: usize,
    /// The file or field that determines the number of rows, for errors.
    pub source: &'a str,
    /// Row of each label.
    pub row_of: &'a HashMap<Label, usize>,
    /// Labels known to be constrained; they have no row.
    pub held: &'a mut HashSet<Label>,
}

/// Reads the part called `name`.
///
/// # Errors
/// [`RigError`].
pub fn read(files: &mut Files, name: &str, raw: &RawPart) -> Result<Part, RigError> {
    let toml = files.toml.clone();
    let field = |key: &str| format!("{name}.{key}");
    let scale = raw.units.of_lengths();
    let nodes = files.read(&field("nodes"), &raw.nodes, |input| match extension(&raw.nodes).as_str() {
        "inp" => coordinates::deck_nodes(&raw.nodes, input, scale),
        _ => tables::nodes(&raw.nodes, input, scale),
    })?;
    let rows_file = raw.rows.as_deref().unwrap_or(&raw.stiffness);
    let labels = match &raw.rows {
        Some(file) => files.read(&field("rows"), file, |input| match extension(file).as_str() {
            "dof" => coordinates::dof(file, input),
            _ => tables::rows(file, input),
        })?,
        None => files.read(&field("stiffness"), rows_file, |input| coordinates::rows_of(rows_file, input))?,
    };
    let row_of_label: HashMap<Label, usize> = labels.iter().enumerate().map(|(row, label)| (*label, row)).collect();
    let internal = extension(rows_file) == "dof";
    let (rows, row_of) = placed(rows_file, &labels, &nodes, &raw.nodes, internal)?;
    let mut held = HashSet::new();
    let mut matrix = |key: &str, file: &str, property: Property| -> Result<SparseMatrix, RigError> {
        let field = field(key);
        let expected = Expected { rows: rows.len(), source: rows_file, row_of: &row_of_label, held: &mut held };
        let matrix = self::matrix(files, &field, file, raw.units.of_matrices(), Some(expected))?;
        let read = Read { field, file, matrix, row_of: &row_of_label };
        read.check(files, property)?;
        Ok(read.matrix)
    };
    let stiffness = matrix("stiffness", &raw.stiffness, Property::Stiffness)?;
    let mass = matrix("mass", &raw.mass, Property::Mass)?;
    let mut optional = |key: &str, file: &Option<String>, property: Property| {
        file.as_ref().map(|file| matrix(key, file, property)).transpose()
    };
    let turning = PartTurning {
        gyroscopic: optional("gyroscopic", &raw.gyroscopic, Property::Skew)?,
        spin: optional("spin", &raw.spin, Property::Symmetric)?,
        stress_stiffening: optional("stress_stiffening", &raw.stress_stiffening, Property::Symmetric)?,
    };
    let given = [("rayleigh_alpha_per_s", raw.rayleigh_alpha_per_s), ("rayleigh_beta_s", raw.rayleigh_beta_s)];
    for (key, value) in given {
        within(&toml, &field(key), value, value >= 0.0, "at least 0")?;
    }
    let loss_factor = within(&toml, &field("loss_factor"), raw.loss_factor, raw.loss_factor >= 0.0, "at least 0")?;
    if loss_factor != 0.0 {
        return Err(RigError::Kind {
            file: toml,
            field: field("loss_factor"),
            value: format!("is {loss_factor}, but a complex stiffness K (1 + i eta) has no real equation of motion"),
            limit: format!("damping_ratio = {} for the same damping of every mode of the part", 0.5 * loss_factor),
        });
    }
    let interface = interface(&toml, &field("interface_nodes"), &raw.interface_nodes, &nodes, &raw.nodes)?;
    let not_negative = |field: &str, value: f64| within(&toml, field, value, value >= 0.0, "at least 0");
    let damping_ratio = match &raw.damping_ratio {
        None => DampedModes::None,
        Some(OneOrMany::One(ratio)) => DampedModes::Every(not_negative(&field("damping_ratio"), *ratio)?),
        Some(OneOrMany::Many(ratios)) => {
            at_most(&toml, &field("damping_ratio"), ratios.len(), MOST_COORDINATES.min(rows.len()))?;
            for (mode, &ratio) in ratios.iter().enumerate() {
                not_negative(&field(&format!("damping_ratio[{mode}]")), ratio)?;
            }
            DampedModes::Lowest(ratios.clone())
        }
    };
    Ok(Part {
        part: FullPart { name: name.to_owned(), mass, stiffness },
        geometry: PartGeometry { nodes_m: nodes.positions.clone(), rows, interface, damping_ratio },
        nodes,
        row_of,
        rayleigh: given.map(|(_, value)| value),
        turning,
    })
}

type Rows = (Vec<(usize, usize)>, HashMap<(usize, usize), usize>);

/// Replaces the node label of every row by the index of the node. Returns the rows and the inverse map.
fn placed(
    file: &str,
    labels: &[(u64, usize)],
    nodes: &Nodes,
    nodes_file: &str,
    internal: bool,
) -> Result<Rows, RigError> {
    let (mut rows, mut row_of) = (vec![], HashMap::new());
    for (row, &(label, direction)) in labels.iter().enumerate() {
        let refuse = |value: String, limit: String| {
            let (file, field) = (file.to_owned(), format!("row {row}"));
            Err(RigError::Range { file, field, value, limit })
        };
        let node = match nodes.place(label) {
            Some(node) => node,
            // CalculiX assigns the incompatible modes of its bricks to separate nodes.
            None if internal => {
                rows.push((INTERNAL, direction));
                continue;
            }
            None => return refuse(format!("at node {label}"), format!("a node of {nodes_file}")),
        };
        if let Some(before) = row_of.insert((node, direction), row) {
            return refuse(format!("node {label} again, as row {before}"), "every direction of a node once".to_owned());
        }
        rows.push((node, direction));
    }
    Ok((rows, row_of))
}

/// Indices of the interface nodes.
fn interface(toml: &str, field: &str, labels: &[u64], nodes: &Nodes, nodes_file: &str) -> Result<Vec<usize>, RigError> {
    let refuse = |field: String, value: String, limit: String| {
        Err(RigError::Range { file: toml.to_owned(), field, value, limit })
    };
    if labels.is_empty() {
        return refuse(field.to_owned(), "empty".to_owned(), "at least one node".to_owned());
    }
    let (mut places, mut seen) = (vec![], HashMap::new());
    for (index, &label) in labels.iter().enumerate() {
        let field = format!("{field}[{index}]");
        let Some(place) = nodes.place(label) else {
            return refuse(field, label.to_string(), format!("a node of {nodes_file}"));
        };
        if seen.insert(place, index).is_some() {
            return refuse(field, format!("{label} again"), "every node at most once".to_owned());
        }
        places.push(place);
    }
    Ok(places)
}

/// Reads a square matrix and multiplies it by `factor`; `expected` are its required properties.
///
/// # Errors
/// [`RigError`].
pub fn matrix(
    files: &mut Files,
    field: &str,
    file: &str,
    factor: f64,
    expected: Option<Expected<'_>>,
) -> Result<SparseMatrix, RigError> {
    let toml = files.toml.clone();
    files.read(field, file, |input| {
        let expected = match expected {
            Some(Expected { rows, source, row_of, held }) if !is_matrix_market(input) => {
                let (entries, mirrored) = coordinates::read(file, input, (rows, source), row_of, held)?;
                return Ok(entries.compress(rows, mirrored, factor));
            }
            expected => expected,
        };
        let mut entries = Entries::default();
        let size = matrix_market::read_entries(file, input, |row, column, value| {
            if row.max(column) < MOST_ROWS {
                entries.push(row, column, value);
            }
        })?;
        let n = size.rows;
        let limit = match expected {
            _ if size.columns != n || n == 0 || n >= MOST_ROWS => format!("a square matrix of 1 to {MOST_ROWS} rows"),
            Some(Expected { rows, source, .. }) if rows != n => format!("{rows}x{rows}, as {source}"),
            // Checked before memory for n columns is allocated.
            None if entries.len() < n => "an entry on every place of the diagonal".to_owned(),
            _ => return Ok(entries.compress(n, size.mirrored, factor)),
        };
        let value = format!("{n}x{} with {} entries ({file})", size.columns, entries.len());
        Err(RigError::Shape { file: toml, field: field.to_owned(), value, limit })
    })
}

/// Whether the remaining input is a Matrix Market file (begins with its banner) or empty.
pub fn is_matrix_market(input: &mut dyn BufRead) -> bool {
    input.fill_buf().is_ok_and(|start| start.is_empty() || start.starts_with(b"%"))
}

/// The extension of a file name, in lower case.
fn extension(name: &str) -> String {
    Path::new(name).extension().map(|extension| extension.to_string_lossy().to_lowercase()).unwrap_or_default()
}

/// Reads a mass matrix and checks it.
///
/// # Errors
/// [`RigError`].
pub fn mass(files: &mut Files, field: &str, file: &str) -> Result<SparseMatrix, RigError> {
    let matrix = matrix(files, field, file, 1.0, None)?;
    let read = Read { field: field.to_owned(), file, matrix, row_of: &HashMap::new() };
    read.check(files, Property::Mass)?;
    Ok(read.matrix)
}

impl Read<'_> {
    /// Checks that the matrix has the `property`.
    fn check(&self, files: &mut Files, property: Property) -> Result<(), RigError> {
        if let Property::Stiffness | Property::Mass = property {
            self.check_diagonal(files, property == Property::Mass)?;
        }
        let (sign, kind, minus) = match property {
            Property::Stiffness | Property::Mass | Property::Symmetric => (1.0, "symmetric", ""),
            Property::Skew => (-1.0, "skew-symmetric", " with opposite signs"),
        };
        let Some(Asymmetry { row, column, value, mirrored, limit }) = first_asymmetry(&self.matrix, sign) else {
            return Ok(());
        };
        let [at, opposite] =
            [(row, column), (column, row)].map(|(row, column)| format!("row {}, column {}", row + 1, column + 1));
        let problem = format!("at {at} is {value}, but {mirrored} at {opposite}");
        let limit = format!("a {kind} matrix; mirrored entries{minus} may differ by {limit:.3e}");
        Err(self.at_line(files, (row, column), problem, &limit))
    }

    /// Checks that the matrix has a complete diagonal, and that no entry there is negative (or zero, for a mass
    /// matrix).
    fn check_diagonal(&self, files: &mut Files, mass: bool) -> Result<(), RigError> {
        let view = self.matrix.as_ref();
        for row in 0..self.matrix.nrows() {
            let listed = view.get(row, row).copied();
            if listed.is_none() {
                let problem = format!("at row {}, column {} is missing up to here", row + 1, row + 1);
                return Err(self.at_line(files, (row, row), problem, "every row on the diagonal; is the file whole?"));
            }
            let value = listed.unwrap_or(0.0);
            if value < 0.0 || (mass && value == 0.0) {
                let limit = if mass { "more than 0 on the diagonal" } else { "at least 0 on the diagonal" };
                let value = format!("at row {}, column {} is {value}", row + 1, row + 1);
                return Err(self.at_line(files, (row, row), value, limit));
            }
        }
        Ok(())
    }

    /// An error about an entry, with the line that lists it.
    fn at_line(&self, files: &mut Files, place: (usize, usize), value: String, limit: &str) -> RigError {
        let found = files.read(&self.field, self.file, |input| {
            if is_matrix_market(input) {
                line_of(self.file, input, place)
            } else {
                coordinates::line_of(self.file, input, self.row_of, place)
            }
        });
        match found {
            Ok(line) => lines::refuse(self.file, line, "entry", value, limit),
            Err(error) => error,
        }
    }
}

/// The line of an entry in a Matrix Market file; the last line if it is not listed.
fn line_of(file: &str, input: impl BufRead, (row, column): (usize, usize)) -> Result<usize, RigError> {
    let mut lines = lines::Lines::new(file, input);
    let (mut size_seen, mut last) = (false, 1);
    while let Some((line, content)) = lines.advance()? {
        if content.is_empty() || content.starts_with('%') {
            continue;
        }
        last = line;
        let mut words = content.split_whitespace().map(|word| word.parse::<usize>().ok());
        let place = (words.next().flatten(), words.next().flatten());
        if size_seen && place == (Some(row + 1), Some(column + 1)) {
            return Ok(line);
        }
        size_seen = true;
    }
    Ok(last)
}
