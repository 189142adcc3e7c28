//! Errors of writing models to files.

use std::io;

use crate::fem::{FemError, TurningError};
use crate::files::whole_file::WholeFileError;

/// Why a model could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A part could not be assembled.
    #[error("{part}")]
    Assembly {
        /// Name of the part.
        part: String,
        /// Why.
        source: FemError,
    },
    /// The matrices of a turning part could not be computed.
    #[error("{part}")]
    Turning {
        /// Name of the part.
        part: String,
        /// Why.
        source: TurningError,
    },
    /// The folder could not be made.
    #[error("{folder}: the folder cannot be created")]
    Folder {
        /// The folder.
        folder: String,
        /// Why.
        source: io::Error,
    },
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] WholeFileError),
    /// Matrices or arrays could not be put into the bytes of a file.
    #[error("{what} cannot be written")]
    Bytes {
        /// The matrix, or whose arrays.
        what: String,
        /// Why.
        source: io::Error,
    },
    /// A table could not be written as TOML.
    #[error("{what} cannot be written as TOML")]
    Toml {
        /// The table.
        what: &'static str,
        /// Why.
        source: toml::ser::Error,
    },
    /// A term of a system follows a law that a rig file cannot express there.
    #[error("{key} term {index} follows {law}; expected a constant or an expression in a [system]")]
    Law {
        /// `stiffness` or `damping`.
        key: &'static str,
        /// Index of the term.
        index: usize,
        /// The law.
        law: String,
    },
    /// The stiffness matrix of a part is indefinite beyond rounding.
    #[error("{file}: `{field}` has a mode of {value:.3e} rad^2/s^2; expected at least {limit:.1e}")]
    Indefinite {
        /// The file of the matrix.
        file: String,
        /// The field of the full model that names it.
        field: String,
        /// The most negative `ω²` found, rad²/s².
        value: f64,
        /// The most negative `ω²` accepted, rad²/s².
        limit: f64,
    },
}
