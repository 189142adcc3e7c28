//! Opens files from users with a size limit, so that no file can exhaust the memory or time of the machine, whatever it
//! claims to contain.
//!
//! Every reader of files opens them here. Anything that is not a regular file (a directory, a named pipe, a device such
//! as `/dev/zero`) or exceeds its limit is refused before it is read. Sizes that a file *claims* are checked against
//! the bytes present before memory is allocated for them. The readers use at most this much memory:
//!
//! | file | size limit | memory of its reader, at most |
//! |---|---|---|
//! | rig file, full model, profile, configuration (TOML) | [`TOML`] | about 100 times the file; 80 levels of nesting |
//! | ROS parameter file (YAML) | [`PARAMETERS`] | 64 levels of nesting, no aliases |
//! | modes and residuals of a rig (`.npz`) | [`RIG_PART`] | max(64 MiB, 100 times the file), up to 1 GiB |
//! | modes of a rig (`.unv`, `.uff`) | [`RIG_PART`] | about 10 times the file; lines of 64 KiB |
//! | matrices of a rig (Matrix Market) | [`RIG_PART`] | about 16 times the file |
//! | table of contact pressures of a rig (CSV) | [`RIG_PART`] | twice the file; lines of 1 MiB, 1000 points |
//! | matrices, nodes and rows of a full model | [`FULL_MODEL_PART`] | about 20 times the file; lines of 1 MiB |
//! | table of contact pressures of a full model (CSV) | [`TABLE`] | 3 times the file; 1000 points |
//! | tribometer log | [`LOG`] | about 12 times the file; lines of 64 KiB |
//! | study (TOML) | [`TOML`] | about 100 times the file, and 80 MB for a Latin hypercube |
//! | table of a study (Parquet) | [`STUDY_TABLE`] | about 12 times the file, for each column that is read |
//! | target frequencies | [`TARGETS`] | about 10 times the file |
//! | WAV file | none: read in pieces | 20 MiB for each channel, of at most 64 |
//! | Universal File and CSV file of samples | [`SAMPLES`] | 8 times the file |
//! | chart | [`CHART`] | 3 times the file |
//! | recording (MCAP) | none: read in pieces | 256 MiB and an attachment, see [`crate::recording::record_walker`] |

use std::fs::{File, FileType, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;

/// Rig files, full models, profiles and configuration files.
pub const TOML: u64 = 1 << 20;
/// ROS parameter files.
pub const PARAMETERS: u64 = 1 << 20;
/// Files that a rig file refers to, and attachments of recordings, which may be such files.
pub const RIG_PART: u64 = 512 << 20;
/// Files that a full model refers to; they are read line by line.
pub const FULL_MODEL_PART: u64 = 16 << 30;
/// Tables of contact pressures that a full model refers to.
pub const TABLE: u64 = 1 << 20;
/// Logs of a tribometer.
pub const LOG: u64 = 512 << 20;
/// Samples of sound and acceleration, other than WAV files.
pub const SAMPLES: u64 = 1 << 30;
/// Natural frequencies to which a rig is fitted.
pub const TARGETS: u64 = 1 << 20;
/// Tables of studies, which are read column by column.
pub const STUDY_TABLE: u64 = 2 << 30;
/// Charts on disk.
pub const CHART: u64 = 1 << 30;
/// For files that are read in pieces.
pub const ANY_SIZE: u64 = u64::MAX;

/// Why a file is refused. It is the inner error of an [`io::Error`]; the caller names the file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    #[error("is {0}, expected a regular file")]
    NotAFile(&'static str),
    #[error("is {bytes} bytes long, expected at most {limit}")]
    TooLong { bytes: u64, limit: u64 },
}

impl From<Refused> for io::Error {
    fn from(refused: Refused) -> Self {
        Self::new(io::ErrorKind::InvalidInput, refused)
    }
}

/// Opens a regular file of at most `limit` bytes. Never blocks: a named pipe without a writer is refused like any
/// other.
///
/// # Errors
/// Errors of opening; [`Refused`].
pub fn open(path: &Path, limit: u64) -> io::Result<File> {
    let flags = rustix::fs::OFlags::NONBLOCK | rustix::fs::OFlags::NOCTTY;
    let file = OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(Refused::NotAFile(kind(metadata.file_type())).into());
    }
    let bytes = metadata.len();
    if bytes > limit { Err(Refused::TooLong { bytes, limit }.into()) } else { Ok(file) }
}

/// Reads a regular file of at most `limit` bytes, even if it grows meanwhile.
///
/// # Errors
/// Errors of opening and reading; [`Refused`].
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = open(path, limit)?;
    let mut bytes = Vec::with_capacity(file.metadata()?.len().min(limit) as usize);
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    let length = bytes.len() as u64;
    if length > limit { Err(Refused::TooLong { bytes: length, limit }.into()) } else { Ok(bytes) }
}

/// As [`read`], as text.
///
/// # Errors
/// As [`read`], and bytes that are not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    String::from_utf8(read(path, limit)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}

fn kind(file_type: FileType) -> &'static str {
    if file_type.is_dir() {
        "a directory"
    } else if file_type.is_fifo() {
        "a named pipe"
    } else if file_type.is_socket() {
        "a socket"
    } else {
        "a device"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(path: &Path, limit: u64) -> String {
        read(path, limit).unwrap_err().to_string()
    }

    #[test]
    fn irregular_and_oversized_files_are_refused_before_reading() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        std::fs::write(&path, b"12345").unwrap();
        assert_eq!(read(&path, 5).unwrap(), b"12345");
        assert_eq!(refusal(&path, 4), "is 5 bytes long, expected at most 4");
        // A sparse file of 8 TiB takes no disk space and must take no memory.
        let hole = folder.path().join("hole");
        std::fs::File::create(&hole).unwrap().set_len(8 << 40).unwrap();
        assert_eq!(refusal(&hole, RIG_PART), "is 8796093022208 bytes long, expected at most 536870912");
        assert_eq!(refusal(folder.path(), 4), "is a directory, expected a regular file");
        assert_eq!(refusal(Path::new("/dev/zero"), 4), "is a device, expected a regular file");
        let pipe = folder.path().join("pipe");
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RWXU).unwrap();
        assert_eq!(refusal(&pipe, 4), "is a named pipe, expected a regular file");
        assert_eq!(read(&folder.path().join("none"), 4).unwrap_err().kind(), io::ErrorKind::NotFound);
        // Files of /proc have size 0, whatever they contain.
        assert_eq!(refusal(Path::new("/proc/self/environ"), 0), "is 1 bytes long, expected at most 0");
    }
}
