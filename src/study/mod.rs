//! Parameter studies: many cases of one rig, full model or tribometer, or many recordings, in one table.
//!
//! Pure: which cases there are and what varies in them (`file`, `parameter`, `design`, `sobol`), where a number is put (`key`),
//! which cases a shard computes and which files hold them (`plan`), and tables (`table`). A case is computed by `subject` and
//! `recordings`. `run` computes the cases on all cores and writes them in files of some cases each; a file that is there is
//! never computed again. `merge` makes one table of them.

mod design;
mod figure;
mod file;
mod key;
mod merge;
mod parameter;
mod parquet_file;
mod plan;
mod properties;
mod recordings;
mod run;
mod sobol;
mod subject;
mod table;

pub use figure::figure;
pub use file::Study;
pub use merge::{Merged, merge};
pub use parquet_file::{Reader, TableError, Writer};
pub use plan::{Plan, Shard};
pub use run::{Ended, Running, TABLE, run};
pub use table::{Cell, Cells, Column, Kind, Table};

use crate::figures::plot::PlotError;
use crate::files::whole_file::WholeFileError;
use crate::recording::reader::RecordingError;
use crate::rig::RigError;

/// Format of the files of a study, in their metadata.
const FORMAT: &str = "1";

/// Columns of every table: the number of the case, whether it was computed, why not, and how long it took.
pub const CASE: &str = "case";
pub const STATUS: &str = "status";
pub const REASON: &str = "reason";
pub const TIME: &str = "time_s";

/// What a case was: a value of [`STATUS`].
pub const DONE: &str = "done";
pub const FAILED: &str = "failed";

/// Why a study cannot be read, computed or merged.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    #[error(transparent)]
    File(Box<RigError>),
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Table(#[from] TableError),
    #[error(transparent)]
    Write(#[from] WholeFileError),
    #[error("{folder}: {source}")]
    Folder { folder: String, source: std::io::Error },
    #[error("{file}: {difference}; {advice}")]
    AnotherStudy { file: String, difference: String, advice: &'static str },
    #[error("{folder}: holds no cases of a study")]
    NoCases { folder: String },
    #[error("{missing} of {cases} cases are missing: {named}")]
    Missing { missing: u64, cases: u64, named: String },
    #[error("cases {named} are in {first} and in {second}")]
    Double { named: String, first: String, second: String },
    #[error("{file}: has no column of numbers `{column}`; expected one of {columns}")]
    NoColumn { file: String, column: String, columns: String },
    #[error("{file}: no case has a value of {columns}")]
    NothingToDraw { file: String, columns: String },
    #[error(transparent)]
    Plot(#[from] PlotError),
    #[error("stopped")]
    Stopped,
}

impl From<RigError> for StudyError {
    fn from(error: RigError) -> Self {
        Self::File(Box::new(error))
    }
}

/// What makes two files parts of one study: they can be merged only if all of it is equal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// Hash of the study file.
    pub study_sha256: String,
    /// Hash of the rig or full model with all its files, or of names and sizes of the recordings.
    pub inputs_sha256: String,
    /// Version of the program.
    pub version: String,
    pub cases: u64,
    pub cases_per_file: u64,
}

impl Identity {
    /// The metadata of a file, which also hold the text of the study.
    fn metadata(&self, study: &str) -> Vec<(String, String)> {
        let own = [
            ("format", FORMAT.to_owned()),
            ("study_sha256", self.study_sha256.clone()),
            ("inputs_sha256", self.inputs_sha256.clone()),
            ("version", self.version.clone()),
            ("cases", self.cases.to_string()),
            ("cases_per_file", self.cases_per_file.to_string()),
            ("study", study.to_owned()),
        ];
        own.map(|(key, value)| (metadata_key(key), value)).into()
    }

    /// The identity in the metadata of a file; `None` if it is not a study's.
    fn of(reader: &Reader) -> Option<Self> {
        let value = |key: &str| reader.metadata(&metadata_key(key)).map(str::to_owned);
        if value("format")? != FORMAT {
            return None;
        }
        Some(Self {
            study_sha256: value("study_sha256")?,
            inputs_sha256: value("inputs_sha256")?,
            version: value("version")?,
            cases: value("cases")?.parse().ok()?,
            cases_per_file: value("cases_per_file")?.parse().ok()?,
        })
    }

    /// What differs from another identity, in words; `None` if nothing does.
    fn difference(&self, other: &Self) -> Option<String> {
        if self == other {
            return None;
        }
        let short = |hash: &str| hash.get(..12).unwrap_or(hash).to_owned();
        Some(if self.study_sha256 != other.study_sha256 {
            let (own, other) = (short(&self.study_sha256), short(&other.study_sha256));
            format!("made by another study file (hash {own}, not {other})")
        } else if self.inputs_sha256 != other.inputs_sha256 {
            let (own, other) = (short(&self.inputs_sha256), short(&other.inputs_sha256));
            format!("made from other files of the rig, full model or recordings (hash {own}, not {other})")
        } else {
            format!("made by squealcast {}, not {}", self.version, other.version)
        })
    }
}

fn metadata_key(key: &str) -> String {
    format!("squealcast.{key}")
}
