//! The rig that a recording contains.

use super::reader::Recording;
use crate::rig::{Rig, RigError, RigFile};

/// Why a recording gives no rig.
#[derive(Debug, thiserror::Error)]
pub enum RecordedRigError {
    #[error("the recording names no rig; name one with --rig")]
    Unnamed,
    #[error("the recording contains no rig file; name one with --rig")]
    NoFile,
    #[error(transparent)]
    Rig(Box<RigError>),
    #[error("the recorded rig has hash {found}, expected {expected} of the metadata")]
    Hash { found: String, expected: String },
}

/// The rig contained in a recording.
///
/// # Errors
/// [`RecordedRigError`].
pub fn recorded_rig(recording: &Recording) -> Result<Rig, RecordedRigError> {
    let expected = recording.session_metadata("rig_content_hash").ok_or(RecordedRigError::Unnamed)?;
    let file = |name: &str, bytes: &[u8]| RigFile { name: name.to_owned(), bytes: bytes.to_vec() };
    let files: Vec<RigFile> =
        recording.attachments().iter().map(|attachment| file(&attachment.name, &attachment.data)).collect();
    if files.is_empty() {
        return Err(RecordedRigError::NoFile);
    }
    let rig = Rig::from_files(&files).map_err(|error| RecordedRigError::Rig(Box::new(error)))?;
    if rig.content_hash != expected {
        return Err(RecordedRigError::Hash { found: rig.content_hash, expected: expected.to_owned() });
    }
    Ok(rig)
}
