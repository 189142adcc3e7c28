//! `[contact_state]` of a full model: its load, and the statics of its contact pairs.

use std::collections::HashMap;
use std::io::{BufRead, Read};
use std::sync::Arc;

use super::files::Files;
use super::part::Part;
use super::{FullModelFile, tables};
use crate::files::input_file;
use crate::reduction::{Engine, ReductionError, SparseRow};
use crate::rig::contact_state::{self, StateTable};
use crate::rig::lines::{self, Lines, found};
use crate::rig::raw::RawContactState;
use crate::rig::{RigError, RigFile, matrix_market, read_pressures};

/// Keys of the load of a full model.
const LOAD: [&str; 3] = ["load_nodes", "load_direction", "load_file"];

/// The table `[contact_state]` of a full model, checked as far as it does not depend on the statics.
#[derive(Clone, Debug)]
pub struct FullState {
    table: StateTable,
    /// The key that gives the load.
    key: &'static str,
    /// Generalised force of a load of 1 N over the rows of the pad.
    load: SparseRow,
    /// The keys as written in the file.
    keys: toml::Table,
    /// The CSV file of the contact law, if it is a table.
    pressures: Option<RigFile>,
}

/// Reads the table `[contact_state]` of a full model with this `pad`; `stiffness_n_per_m` is that of each contact pair.
///
/// # Errors
/// [`RigError`].
pub fn read(
    files: &mut Files,
    raw: &RawContactState,
    pad: &Part,
    stiffness_n_per_m: &[f64],
) -> Result<FullState, RigError> {
    let toml = files.toml.clone();
    let mut pressures = None;
    let table = contact_state::check(&toml, raw, &mut |field, name| {
        let bytes = files.read(field, name, |input| whole(name, input))?;
        let read = read_pressures(name, &bytes);
        pressures = Some(RigFile { name: name.to_owned(), bytes });
        read
    })?;
    table.loaded_by("a full model", &LOAD)?;
    table.check_pairs(stiffness_n_per_m)?;
    let (key, load) = match (&raw.load_file, &raw.load_nodes, raw.load_direction) {
        (Some(name), None, None) => ("load_file", load_of_file(files, name, pad)?),
        (None, Some(nodes), Some(direction)) => ("load_nodes", load_on_nodes(&toml, nodes, direction, pad)?),
        (Some(_), ..) => {
            let (field, value) = ("contact_state.load_file".to_owned(), "is given beside other keys of the load");
            let limit = "load_file, or load_nodes with load_direction".to_owned();
            return Err(RigError::Kind { file: toml, field, value: value.to_owned(), limit });
        }
        (None, nodes, _) => {
            let key = if nodes.is_some() { "load_direction" } else { "load_nodes" };
            let limit = "where the load of 1 N presses: load_nodes with load_direction, or load_file".to_owned();
            return Err(RigError::MissingKey { file: toml, field: format!("contact_state.{key}"), limit });
        }
    };
    if load.iter().all(|(_, force)| *force == 0.0) {
        let (field, value) = (format!("contact_state.{key}"), "a load of 0".to_owned());
        return Err(RigError::Range { file: toml, field, value, limit: "the forces of a load of 1 N".to_owned() });
    }
    Ok(FullState { table, key, load, keys: toml::Table::new(), pressures })
}

/// The bytes of a file that is read as a whole.
fn whole(name: &str, input: &mut dyn BufRead) -> Result<Vec<u8>, RigError> {
    let mut bytes = vec![];
    let read = input.take(input_file::TABLE + 1).read_to_end(&mut bytes);
    read.map_err(|error| lines::refuse(name, 1, "line", format!("cannot be read: {error}"), "a readable file"))?;
    if bytes.len() as u64 > input_file::TABLE {
        return Err(RigError::TooLong { file: name.to_owned(), bytes: bytes.len(), limit: input_file::TABLE });
    }
    Ok(bytes)
}

/// A load of 1 N in equal parts on `nodes` of the pad, along `direction`, which may have any length.
fn load_on_nodes(toml: &str, nodes: &[u64], direction: [f64; 3], pad: &Part) -> Result<SparseRow, RigError> {
    let refuse = |field: String, value: String, limit: &str| {
        let (file, field, limit) = (toml.to_owned(), format!("contact_state.{field}"), limit.to_owned());
        Err(RigError::Range { file, field, value, limit })
    };
    let length = direction.iter().map(|component| component * component).sum::<f64>().sqrt();
    if !(length.is_finite() && length > 0.0) {
        return refuse("load_direction".to_owned(), format!("{direction:?}"), "a direction other than 0");
    }
    if nodes.is_empty() {
        return refuse("load_nodes".to_owned(), "empty".to_owned(), "at least one node of the pad");
    }
    let (mut load, mut seen) = (vec![], HashMap::new());
    for (index, &label) in nodes.iter().enumerate() {
        let field = format!("load_nodes[{index}]");
        let Some(node) = pad.nodes.place(label) else { return refuse(field, label.to_string(), "a node of the pad") };
        if seen.insert(label, index).is_some() {
            return refuse(field, format!("{label} again"), "every node at most once");
        }
        for (axis, component) in direction.iter().enumerate().filter(|(_, component)| **component != 0.0) {
            let Some(&row) = pad.row_of.get(&(node, axis)) else {
                let value = format!("{label}, which cannot move along {}", tables::DIRECTIONS[axis]);
                return refuse(field, value, "nodes that move along every component of load_direction");
            };
            load.push((row, component / (length * nodes.len() as f64)));
        }
    }
    Ok(load)
}

/// The load of a file: a Matrix Market vector over the rows of the pad, or a table `node,direction,force_n`.
fn load_of_file(files: &mut Files, name: &str, pad: &Part) -> Result<SparseRow, RigError> {
    let (toml, rows) = (files.toml.clone(), pad.part.mass.nrows());
    files.read("contact_state.load_file", name, |mut input| {
        if !super::part::is_matrix_market(&mut input) {
            return load_of_table(name, input, pad);
        }
        let mut forces = vec![0.0; rows];
        let size = matrix_market::read_entries(name, &mut input, |row, column, value| {
            if column == 0 && row < rows {
                forces[row] += value;
            }
        })?;
        if (size.rows, size.columns) != (rows, 1) {
            let (field, value) =
                ("contact_state.load_file".to_owned(), format!("{}x{} ({name})", size.rows, size.columns));
            return Err(RigError::Shape { file: toml, field, value, limit: format!("{rows}x1, the rows of the pad") });
        }
        Ok(forces.into_iter().enumerate().filter(|(_, force)| *force != 0.0).collect())
    })
}

/// Reads a table `node,direction,force_n` of forces of a load of 1 N on the pad; about the axes they are moments, N·m.
fn load_of_table(name: &str, input: impl BufRead, pad: &Part) -> Result<SparseRow, RigError> {
    const HEADER: &str = "node,direction,force_n";
    let mut lines = Lines::new(name, input);
    let header = tables::header(&mut lines)?;
    if header != HEADER {
        return Err(lines.refuse("header", found(&header), HEADER));
    }
    let (mut load, mut seen) = (vec![], HashMap::new());
    while let Some((line, content)) = lines.advance()? {
        if content.is_empty() {
            continue;
        }
        let refuse = |limit: &str| Err(lines::refuse(name, line, "force", found(content), limit));
        let cells: Vec<&str> = content.split(',').map(str::trim).collect();
        let read = match cells[..] {
            [node, direction, force] => (|| {
                let direction = tables::DIRECTIONS.iter().position(|known| *known == direction)?;
                let force = force.parse::<f64>().ok().filter(|force| force.is_finite())?;
                Some((node.parse::<u64>().ok()?, direction, force))
            })(),
            _ => None,
        };
        let Some((label, direction, force)) = read else {
            return refuse("a node, one of x, y, z, rx, ry, rz, and a finite number");
        };
        let row = pad.nodes.place(label).and_then(|node| pad.row_of.get(&(node, direction)));
        let Some(&row) = row else { return refuse("a node of the pad that moves along this direction") };
        if let Some(before) = seen.insert(row, line) {
            return refuse(&format!("every direction of a node once; line {before} has it too"));
        }
        load.push((row, force));
    }
    Ok(load)
}

impl FullState {
    /// The same with the `keys` as written in the file.
    pub fn written_as(self, keys: toml::Table) -> Self {
        Self { keys, ..self }
    }

    /// The table `[contact_state]` of a rig reduced from the full model, without its load, and the file it names.
    pub fn for_rig(&self) -> (toml::Table, Option<RigFile>) {
        let mut table = self.keys.clone();
        table.retain(|key, _| !LOAD.contains(&key));
        (table, self.pressures.clone())
    }

    /// Lines for [`FullModelFile::describe`].
    pub fn describe(&self, pairs: usize) -> [String; 2] {
        let rows = self.load.iter().filter(|(_, force)| *force != 0.0).count();
        let state = format!("state      {pairs} pairs that open and close; the load acts on {rows} degrees of freedom");
        [self.table.describe_law(), state]
    }
}

impl FullModelFile {
    /// Computes the statics of the contact pairs and lets the model follow their states; without `[contact_state]` this
    /// does nothing. `memory_limit_bytes` limits the memory taken in addition to what is already held.
    ///
    /// # Errors
    /// [`RigError::Reduction`], [`RigError::ContactState`], [`RigError::Model`]; [`RigError::Range`] if the load does not
    /// press the pad on the disc.
    pub fn find_statics(&mut self, engine: &dyn Engine, memory_limit_bytes: Option<usize>) -> Result<(), RigError> {
        let (Some(state), Some(contact)) = (&self.state, &self.model.contact) else { return Ok(()) };
        let file = || self.path.display().to_string();
        let failed = |source: ReductionError| RigError::Reduction { file: file(), source };
        let response = self.model.static_response(engine, &state.load, memory_limit_bytes).map_err(failed)?;
        let Some(response) = response else { return Ok(()) };
        let statics = state.table.statics_of(response, &contact.stiffness_n_per_m, &self.settings)?;
        state.table.check_load(state.key, &statics, &self.settings)?;
        let load = state.load.clone();
        let followed = self.model.follow_states(load, Arc::new(statics));
        followed.map_err(|source| RigError::Model { file: self.path.display().to_string(), source })
    }
}
