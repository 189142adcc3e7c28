//! CSV tables of the nodes and rows of a part.

use std::collections::HashMap;
use std::io::BufRead;

use crate::rig::RigError;
use crate::rig::lines::{Lines, found};

/// Directions of the rows of a node, in numerical order.
pub const DIRECTIONS: [&str; 6] = ["x", "y", "z", "rx", "ry", "rz"];

/// Positions of nodes, accessible by label.
#[derive(Clone, Debug)]
pub struct Nodes {
    pub positions: Vec<[f64; 3]>,
    /// Index into `positions` of every label. Without labels in the table, nodes are labelled from 0.
    place: HashMap<u64, usize>,
}

impl Nodes {
    /// Nodes from labels and positions, both in the order of the file.
    pub fn new(labels: &[u64], positions: Vec<[f64; 3]>) -> Self {
        Self { place: labels.iter().enumerate().map(|(place, &label)| (label, place)).collect(), positions }
    }

    /// Index of the node with this label.
    pub fn place(&self, label: u64) -> Option<usize> {
        self.place.get(&label).copied()
    }
}

/// Reads a table `x_m,y_m,z_m` or `node,x_m,y_m,z_m`, where `node` is a label. Lengths are multiplied by `scale`.
///
/// # Errors
/// [`RigError::Line`].
pub fn nodes(file: &str, input: impl BufRead, scale: f64) -> Result<Nodes, RigError> {
    let mut lines = Lines::new(file, input);
    let header = header(&mut lines)?;
    let labelled = match header.as_str() {
        "x_m,y_m,z_m" => false,
        "node,x_m,y_m,z_m" => true,
        other => return Err(lines.refuse("header", found(other), "x_m,y_m,z_m or node,x_m,y_m,z_m")),
    };
    let (mut positions, mut labels, mut seen) = (vec![], vec![], HashMap::new());
    while let Some((line, content)) = lines.advance()? {
        if content.is_empty() {
            continue;
        }
        let cells: Vec<&str> = content.split(',').map(str::trim).collect();
        let refuse = |field: &str, text: &str, limit: &str| {
            Err(crate::rig::lines::refuse(file, line, field, found(text), limit))
        };
        let (label, coordinates) = match cells.as_slice() {
            [label, coordinates @ ..] if labelled => match label.parse::<u64>() {
                Ok(label) => (label, coordinates),
                Err(_) => return refuse("node", label, "a whole number"),
            },
            coordinates => (positions.len() as u64, coordinates),
        };
        if coordinates.len() != 3 {
            return refuse("line", content, &format!("{} values, as the header says", if labelled { 4 } else { 3 }));
        }
        let mut position = [0.0; 3];
        for ((value, cell), name) in position.iter_mut().zip(coordinates).zip(["x_m", "y_m", "z_m"]) {
            match cell.parse::<f64>() {
                Ok(number) if number.is_finite() => *value = scale * number,
                _ => return refuse(name, cell, "a finite number"),
            }
        }
        if let Some(before) = seen.insert(label, line) {
            return refuse("node", &label.to_string(), &format!("every node once; line {before} has it too"));
        }
        labels.push(label);
        positions.push(position);
    }
    Ok(Nodes::new(&labels, positions))
}

/// Reads a table `node,direction`: node label and direction of each matrix row.
///
/// # Errors
/// [`RigError::Line`].
pub fn rows(file: &str, input: impl BufRead) -> Result<Vec<(u64, usize)>, RigError> {
    let mut lines = Lines::new(file, input);
    let header = header(&mut lines)?;
    if header != "node,direction" {
        return Err(lines.refuse("header", found(&header), "node,direction"));
    }
    let mut rows = vec![];
    while let Some((line, content)) = lines.advance()? {
        if content.is_empty() {
            continue;
        }
        let row = content.split_once(',').and_then(|(node, direction)| {
            let direction = DIRECTIONS.iter().position(|name| *name == direction.trim())?;
            Some((node.trim().parse::<u64>().ok()?, direction))
        });
        match row {
            Some(row) => rows.push(row),
            None => {
                let limit = "a node and one of x, y, z, rx, ry, rz";
                return Err(crate::rig::lines::refuse(file, line, "row", found(content), limit));
            }
        }
    }
    Ok(rows)
}

/// The first line, with all spaces removed.
pub fn header<R: BufRead>(lines: &mut Lines<'_, R>) -> Result<String, RigError> {
    let header = lines.advance()?.map(|(_, text)| text.chars().filter(|c| !c.is_whitespace()).collect::<String>());
    Ok(header.unwrap_or_default())
}
