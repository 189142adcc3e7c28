//! Why a rig could not be loaded: the file, the field, its value and what was expected.

use crate::contact::StaticsError;
use crate::physics::ModelError;
use crate::reduction::ReductionError;

/// An error in a rig file or in a file it refers to. Rows, columns, nodes and modes are counted from 0, lines from 1.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RigError {
    #[error("{value}: neither a readable rig file ({reason}) nor one of the embedded rigs, expected {limit}")]
    NoSuchRig { value: String, reason: String, limit: String },
    #[error("{value}: cannot be read: {reason}; expected {limit}")]
    NoSuchFile { value: String, reason: String, limit: String },
    #[error("{file}: {field} = \"{value}\" cannot be read: {reason}; expected {limit}")]
    MissingFile { file: String, field: String, value: String, reason: String, limit: String },
    #[error("{file}: is {bytes} bytes long, expected at most {limit}")]
    TooLong { file: String, bytes: usize, limit: u64 },
    #[error("{file}, line {line}: {value}; expected {limit}")]
    Syntax { file: String, line: usize, value: String, limit: String },
    #[error("{file}, line {line}: unknown key `{field}`; expected {limit}")]
    UnknownKey { file: String, line: usize, field: String, limit: String },
    #[error("{file}: `{field}` is missing; expected {limit}")]
    MissingKey { file: String, field: String, limit: String },
    #[error("{file}: `format` is {value}, expected {limit}, the format that this version of squealcast reads")]
    Format { file: String, value: i64, limit: i64 },
    #[error("{file}: `{field}` {value}; expected {limit}")]
    Kind { file: String, field: String, value: String, limit: String },
    #[error("{file}: `{field}` has shape {value}, expected {limit}")]
    Shape { file: String, field: String, value: String, limit: String },
    #[error("{file}: `{field}` is {value}, expected a finite number")]
    NotFinite { file: String, field: String, value: f64 },
    #[error("{file}: `{field}` is {value}, expected {limit}")]
    Range { file: String, field: String, value: String, limit: String },
    #[error("{file}: `{field}` = \"{value}\": {reason}; expected {limit}")]
    Scale { file: String, field: String, value: String, reason: String, limit: String },
    #[error("{file}, line {line}: {field} {value}; expected {limit}")]
    Line { file: String, line: usize, field: String, value: String, limit: String },
    #[error("{file}: array `{field}` {value}; expected {limit}")]
    Npz { file: String, field: String, value: String, limit: String },
    #[error(
        "{file}: `{field}`: pad node {node} at ({}, {}, {}) m finds no partner on the disc: {value}, expected {limit}",
        position_m[0], position_m[1], position_m[2]
    )]
    NoPartner { file: String, field: String, node: usize, position_m: Box<[f64; 3]>, value: String, limit: String },
    #[error(
        "{file}: `{field}`: pad node {node} at ({}, {}, {}) m has no sliding direction: {value}, expected {limit}",
        position_m[0], position_m[1], position_m[2]
    )]
    NoTriad { file: String, field: String, node: usize, position_m: Box<[f64; 3]>, value: String, limit: String },
    #[error("{file}: {source}")]
    Reduction { file: String, source: ReductionError },
    #[error("{file}: {source}")]
    Model { file: String, source: ModelError },
    #[error("{file}: `contact_state`: {source}")]
    ContactState { file: String, source: StaticsError },
}
