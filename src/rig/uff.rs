//! Modes of a substructure in the Universal File Format: datasets 15 or 2411 (nodes), 55 (normal modes), 164 (units).
//!
//! A Universal File is text in fixed columns, with every dataset between two lines of `-1`. Shapes are scaled to unit
//! modal mass, which the file must give. Lengths and masses are converted to SI if the file gives units. The nodes of
//! the substructure are those for which a shape has values, in the order of the nodes' dataset. A node that a mode does
//! not list has zero displacement in it. A hysteretic loss factor `η` is converted to the viscous damping ratio `η/2`,
//! which is equivalent at resonance.
//!
//! Source: Structural Dynamics Research Laboratory, University of Cincinnati, "Universal File Formats for Modal
//! Analysis Testing".

use std::borrow::Cow;
use std::collections::HashMap;
use std::f64::consts::TAU;

use super::RigError;
use super::modal_data::ModalData;
use crate::reduction::PartMatrices;

/// The line before and after each dataset.
const DELIMITER: &str = "-1";

/// A mode in the units of the file.
struct Mode {
    omega_rad_s: f64,
    modal_mass: f64,
    damping_ratio: f64,
    /// Displacement by node label.
    shape: HashMap<u64, [f64; 3]>,
}

/// A node in the units of the file.
struct Node {
    label: u64,
    position: [f64; 3],
}

/// The units of the file in SI.
struct Units {
    length_m: f64,
    force_n: f64,
}

/// Longest accepted line, bytes.
const LONGEST_LINE: usize = 64 << 10;

/// The lines of a file.
struct Lines<'a> {
    file: &'a str,
    /// Bytes not yet read; `None` after the last line.
    rest: Option<&'a [u8]>,
    /// Number of lines read.
    read: usize,
    dataset: String,
}

/// Reads a Universal File.
///
/// # Errors
/// [`RigError::Line`], naming the line, its content and what was expected.
pub fn read(file: &str, bytes: &[u8]) -> Result<ModalData, RigError> {
    let bytes = bytes.strip_suffix(b"\n").unwrap_or(bytes);
    let mut lines = Lines { file, rest: Some(bytes), read: 0, dataset: String::new() };
    let (mut nodes, mut modes) = (Vec::<Node>::new(), Vec::<Mode>::new());
    let mut units = Units { length_m: 1.0, force_n: 1.0 };
    while let Some(number) = lines.next_dataset()? {
        match number.as_str() {
            "15" => nodes.extend(lines.nodes(1)?),
            "2411" => nodes.extend(lines.nodes(2)?),
            "55" => modes.extend(lines.mode()?),
            "164" => units = lines.units()?,
            _ => lines.skip()?,
        }
    }
    let whole = |field: &str, value: &str, limit: &str| lines.refused(lines.read, field, value, limit);
    if nodes.is_empty() {
        return Err(whole("nodes", "are missing", "a dataset 15 or 2411"));
    }
    if modes.is_empty() {
        return Err(whole("modes", "are missing", "a dataset 55 of analysis type 2, normal modes"));
    }
    let mut seen = HashMap::new();
    for (index, node) in nodes.iter().enumerate() {
        if seen.insert(node.label, index).is_some() {
            return Err(whole(&format!("node {}", node.label), "is there twice", "every node once"));
        }
    }
    let mut moving = vec![false; nodes.len()];
    for mode in &modes {
        for label in mode.shape.keys() {
            match seen.get(label) {
                Some(&index) => moving[index] = true,
                None => {
                    let limit = "a place for it in a dataset 15 or 2411";
                    return Err(whole(&format!("node {label}"), "has a mode shape only", limit));
                }
            }
        }
    }
    let nodes: Vec<&Node> = nodes.iter().zip(&moving).filter(|(_, moving)| **moving).map(|(node, _)| node).collect();
    if nodes.is_empty() {
        return Err(whole("mode shapes", "have no values", "values at nodes"));
    }
    let mass_kg = units.force_n / units.length_m;
    let scale: Vec<f64> = modes.iter().map(|mode| 1.0 / (mode.modal_mass * mass_kg).sqrt()).collect();
    let phi = nodes
        .iter()
        .flat_map(|node| (0..3).map(move |axis| (node.label, axis)))
        .flat_map(|(label, axis)| {
            let values = modes.iter().zip(&scale);
            values.map(move |(mode, scale)| mode.shape.get(&label).map_or(0.0, |shape| shape[axis] * scale))
        })
        .collect();
    let damped = modes.iter().any(|mode| mode.damping_ratio != 0.0);
    Ok(ModalData {
        omega_rad_s: modes.iter().map(|mode| mode.omega_rad_s).collect(),
        phi,
        nodes_m: nodes.iter().map(|node| node.position.map(|value| value * units.length_m)).collect(),
        damping_ratio: damped.then(|| modes.iter().map(|mode| mode.damping_ratio).collect()),
        mass_share: None,
        load: None,
        matrices: PartMatrices::default(),
        residual: None,
    })
}

impl<'a> Lines<'a> {
    /// An error at a line, counted from 1.
    fn refused(&self, line: usize, field: &str, value: &str, limit: &str) -> RigError {
        let (file, field, value, limit) = (self.file.to_owned(), field.to_owned(), value.to_owned(), limit.to_owned());
        RigError::Line { file, line, field, value, limit }
    }

    /// An error at the last line read.
    fn refused_here(&self, field: &str, value: &str, limit: &str) -> RigError {
        self.refused(self.read, &format!("dataset {}: {field}", self.dataset), value, limit)
    }

    /// The next line of the file; `None` after the last one.
    fn advance(&mut self) -> Result<Option<Cow<'a, str>>, RigError> {
        let Some(rest) = self.rest else { return Ok(None) };
        let mut parts = rest.splitn(2, |byte| *byte == b'\n');
        let line = parts.next().unwrap_or_default();
        self.rest = parts.next();
        self.read += 1;
        if line.len() > LONGEST_LINE {
            let value = format!("is {} bytes long", line.len());
            return Err(self.refused(self.read, "line", &value, &format!("at most {LONGEST_LINE}")));
        }
        Ok(Some(String::from_utf8_lossy(line)))
    }

    /// Reads up to the next dataset and returns its number; `None` at the end of the file.
    fn next_dataset(&mut self) -> Result<Option<String>, RigError> {
        while let Some(line) = self.advance()? {
            match line.trim() {
                "" => {}
                DELIMITER => {
                    let number = self.advance()?.map_or_else(String::new, |line| line.trim().to_owned());
                    // The header of a binary variant has a letter after the number, followed by further numbers.
                    let first = number.split_whitespace().next().unwrap_or("").to_owned();
                    if first.is_empty() || !first.starts_with(|c: char| c.is_ascii_digit()) {
                        let value = format!("is `{}`", shown(&number));
                        return Err(self.refused(
                            self.read,
                            "number of a dataset",
                            &value,
                            "a number after a line of -1",
                        ));
                    }
                    self.dataset.clone_from(&first);
                    return Ok(Some(first));
                }
                other => {
                    let value = format!("is `{}`", shown(other));
                    return Err(self.refused(self.read, "line between datasets", &value, "-1, as in a Universal File"));
                }
            }
        }
        Ok(None)
    }

    /// The next line of the dataset; `None` at its end.
    fn line(&mut self) -> Result<Option<String>, RigError> {
        if let Some(line) = self.advance()? {
            let line = line.trim_end_matches('\r');
            return Ok((line.trim() != DELIMITER).then(|| line.to_owned()));
        }
        Err(self.refused(self.read, &format!("dataset {}", self.dataset), "has no end", "a line of -1"))
    }

    /// The next line of the dataset, an error if the dataset ends here; `what` names it.
    fn required(&mut self, what: &str) -> Result<String, RigError> {
        match self.line()? {
            Some(line) => Ok(line),
            None => Err(self.refused_here(what, "is missing", "a line with it before the dataset ends")),
        }
    }

    fn skip(&mut self) -> Result<(), RigError> {
        while self.line()?.is_some() {}
        Ok(())
    }

    /// Splits a line into columns of the given widths. If they do not parse as numbers, splits it at spaces.
    fn fields(&self, line: &str, widths: &[usize]) -> Vec<String> {
        let mut start = 0;
        let columns: Vec<String> = widths
            .iter()
            .map(|width| {
                let column = line.get(start..line.len().min(start + width)).unwrap_or("").trim().to_owned();
                start += width;
                column
            })
            .collect();
        let rest = line.get(start..).unwrap_or("").trim();
        if rest.is_empty() && columns.iter().all(|column| number(column).is_some()) {
            return columns;
        }
        line.split_whitespace().map(str::to_owned).collect()
    }

    /// The numbers of a line, at least `least` of them.
    fn numbers(&self, line: &str, what: &str, widths: &[usize], least: usize) -> Result<Vec<f64>, RigError> {
        let fields = self.fields(line, widths);
        if fields.len() < least {
            let value = format!("has {} numbers (`{}`)", fields.len(), shown(line));
            return Err(self.refused_here(what, &value, &format!("at least {least}")));
        }
        let parsed = |field: &String| match number(field) {
            Some(value) if value.is_finite() => Ok(value),
            _ => Err(self.refused_here(what, &format!("is `{}`", shown(field)), "a finite number")),
        };
        fields.iter().map(parsed).collect()
    }

    /// Converts `value` to a non-negative integer.
    fn count(&self, what: &str, value: f64) -> Result<u64, RigError> {
        if value >= 0.0 && value.fract() == 0.0 && value < 1e15 {
            return Ok(value as u64);
        }
        Err(self.refused_here(what, &format!("is {value}"), "a whole number of at least 0"))
    }

    /// An error at the last line read unless `holds`.
    fn must(&self, holds: bool, what: &str, value: f64, limit: &str) -> Result<(), RigError> {
        if holds { Ok(()) } else { Err(self.refused_here(what, &format!("is {value}"), limit)) }
    }

    /// Reads dataset 15 (one line per node) or 2411 (two lines per node).
    fn nodes(&mut self, lines_each: usize) -> Result<Vec<Node>, RigError> {
        let mut nodes = vec![];
        while let Some(line) = self.line()? {
            let (head, position) = if lines_each == 1 {
                let all = self.numbers(&line, "node", &[10, 10, 10, 10, 13, 13, 13], 7)?;
                (all[..4].to_vec(), all[4..7].to_vec())
            } else {
                let head = self.numbers(&line, "node", &[10; 4], 4)?;
                let line = self.required("position of a node")?;
                (head, self.numbers(&line, "position of a node", &[25; 3], 3)?)
            };
            let label = self.count("label of a node", head[0])?;
            for (what, system) in [("definition", head[1]), ("displacement", head[2])] {
                // Both 0 and 1 are used for the global Cartesian system.
                if system != 0.0 && system != 1.0 {
                    let value = format!("of node {label} is {system}");
                    return Err(self.refused_here(
                        &format!("{what} coordinate system"),
                        &value,
                        "0 or 1, the global one",
                    ));
                }
            }
            nodes.push(Node { label, position: [position[0], position[1], position[2]] });
        }
        Ok(nodes)
    }

    /// Reads dataset 164. The file gives the factors to divide by to obtain SI units.
    fn units(&mut self) -> Result<Units, RigError> {
        self.required("units")?;
        let line = self.required("factors of units")?;
        let factors = self.numbers(&line, "factors of units", &[25; 3], 2)?;
        if let Some(factor) = factors[..2].iter().find(|factor| **factor <= 0.0) {
            return Err(self.refused_here("factors of units", &format!("are {factor}"), "more than 0"));
        }
        self.skip()?;
        Ok(Units { length_m: 1.0 / factors[0], force_n: 1.0 / factors[1] })
    }

    /// Reads dataset 55; `None` for anything but normal modes.
    fn mode(&mut self) -> Result<Option<Mode>, RigError> {
        for line in 1..=5 {
            self.required(&format!("identification line {line}"))?;
        }
        let line = self.required("kind of data")?;
        let kind = self.numbers(&line, "kind of data", &[10; 6], 6)?;
        let [_, analysis, characteristic, quantity, data_type, per_node] = kind[..] else {
            return Err(self.refused_here("kind of data", &format!("has {} numbers", kind.len()), "6"));
        };
        if analysis != 2.0 {
            self.skip()?;
            return Ok(None);
        }
        self.must(data_type == 2.0, "type of data", data_type, "2, real values")?;
        self.must(
            [2.0, 3.0].contains(&characteristic),
            "characteristic of data",
            characteristic,
            "2 or 3, translations",
        )?;
        self.must([0.0, 1.0, 8.0].contains(&quantity), "quantity", quantity, "8, displacements")?;
        self.must([3.0, 6.0].contains(&per_node), "number of values per node", per_node, "3 or 6")?;
        let line = self.required("whole numbers of the mode")?;
        let whole = self.numbers(&line, "whole numbers of the mode", &[10; 4], 4)?;
        self.must(whole[1] >= 2.0, "number of values of the mode", whole[1], "at least 2: frequency and modal mass")?;
        let wanted = (whole[1] as usize).min(4);
        let line = self.required("frequency and modal mass")?;
        let real = self.numbers(&line, "frequency and modal mass", &vec![13; wanted], wanted)?;
        let (frequency_hz, modal_mass) = (real[0], real[1]);
        self.must(frequency_hz >= 0.0, "frequency", frequency_hz, "at least 0 Hz")?;
        self.must(modal_mass > 0.0, "modal mass", modal_mass, "more than 0 (1 where shapes are mass-normalised)")?;
        let damping_ratio = real.get(2).copied().unwrap_or(0.0) + 0.5 * real.get(3).copied().unwrap_or(0.0);
        let mut shape = HashMap::new();
        let per_node = per_node as usize;
        while let Some(line) = self.line()? {
            let label = self.numbers(&line, "node of a shape", &[10], 1)?;
            let label = self.count("node of a shape", label[0])?;
            let line = self.required("values at a node")?;
            let values = self.numbers(&line, "values at a node", &vec![13; per_node], per_node)?;
            if shape.insert(label, [values[0], values[1], values[2]]).is_some() {
                let value = format!("is {label} again");
                return Err(self.refused_here("node of a shape", &value, "every node at most once"));
            }
        }
        Ok(Some(Mode { omega_rad_s: TAU * frequency_hz, modal_mass, damping_ratio, shape }))
    }
}

/// Parses a number as written by Fortran or C.
fn number(text: &str) -> Option<f64> {
    text.replace(['D', 'd'], "E").parse().ok()
}

/// The first 60 characters of a text, for errors.
fn shown(text: &str) -> String {
    text.chars().take(60).map(|c| if c.is_control() { '.' } else { c }).collect()
}
