//! Reads the files of a rig by name and keeps their contents.

use sha2::{Digest, Sha256};

use super::{RigError, RigFile};
use crate::text::hex::hex;

/// Access to the files that a rig file refers to.
pub struct Source<'a> {
    /// Name of the rig file, for errors.
    pub rig_file: String,
    read: &'a dyn Fn(&str) -> Result<Vec<u8>, String>,
    limit: String,
    files: Vec<RigFile>,
}

impl<'a> Source<'a> {
    /// `read` returns the bytes of a file, or the reason why it cannot; `limit` says in errors what was expected.
    pub fn new(rig_file: RigFile, read: &'a dyn Fn(&str) -> Result<Vec<u8>, String>, limit: &str) -> Self {
        Self { rig_file: rig_file.name.clone(), read, limit: limit.to_owned(), files: vec![rig_file] }
    }

    /// The bytes of file `name`, which `field` of the rig file refers to. Each file is read once.
    ///
    /// # Errors
    /// [`RigError::MissingFile`].
    pub fn read(&mut self, field: &str, name: &str) -> Result<&[u8], RigError> {
        // The first file is the rig file itself, which nothing refers to.
        let position = match self.files.iter().skip(1).position(|file| file.name == name) {
            Some(position) => position + 1,
            None => {
                let bytes = (self.read)(name).map_err(|reason| RigError::MissingFile {
                    file: self.rig_file.clone(),
                    field: field.to_owned(),
                    value: name.to_owned(),
                    reason,
                    limit: self.limit.clone(),
                })?;
                self.files.push(RigFile { name: name.to_owned(), bytes });
                self.files.len() - 1
            }
        };
        Ok(&self.files[position].bytes)
    }

    /// SHA-256 over name and content of every file, each preceded by its length, hexadecimal.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        for file in &self.files {
            for part in [file.name.as_bytes(), &file.bytes] {
                hasher.update((part.len() as u64).to_le_bytes());
                hasher.update(part);
            }
        }
        hex(&hasher.finalize())
    }

    pub fn into_files(self) -> Vec<RigFile> {
        self.files
    }
}
