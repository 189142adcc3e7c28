//! Reads the files of a full model, each in one pass, and hashes them meanwhile on a thread of its own.

use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, SyncSender};

use sha2::{Digest, Sha256};

use crate::files::input_file;
use crate::rig::RigError;
use crate::text::hex::hex;

/// Size of the read buffer, bytes.
const CHUNK: usize = 1 << 20;
/// Number of chunks that may wait to be hashed.
const WAITING: usize = 4;

/// The TOML file of a full model and the files it refers to, with their hashes.
pub struct Files {
    /// Name of the TOML file, for errors.
    pub toml: String,
    directory: PathBuf,
    digests: Vec<(String, [u8; 32])>,
}

impl Files {
    /// The TOML file at `path` with this content.
    pub fn new(path: &Path, toml: &[u8]) -> Self {
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let digests = vec![(name.clone(), Sha256::digest(toml).into())];
        Self { toml: name, directory: path.parent().unwrap_or(Path::new("")).to_owned(), digests }
    }

    /// Reads further files at the same time, on another thread; [`Self::append`] then takes their hashes.
    pub fn beside(&self) -> Self {
        Self { toml: self.toml.clone(), directory: self.directory.clone(), digests: vec![] }
    }

    /// Adds the hashes of the files that `beside` read.
    pub fn append(&mut self, beside: Self) {
        for (name, digest) in beside.digests {
            self.add(name, digest);
        }
    }

    /// Adds the hash of a file, unless the file is known.
    fn add(&mut self, name: String, digest: [u8; 32]) {
        if !self.digests.iter().any(|(known, _)| *known == name) {
            self.digests.push((name, digest));
        }
    }

    /// Opens the file `name`, which `field` refers to, and returns the result of `work` on it. The first time, its hash
    /// is recorded.
    ///
    /// # Errors
    /// [`RigError::MissingFile`] and those of `work`.
    pub fn read<T>(
        &mut self,
        field: &str,
        name: &str,
        work: impl FnOnce(&mut dyn BufRead) -> Result<T, RigError>,
    ) -> Result<T, RigError> {
        let missing = |error: io::Error| RigError::MissingFile {
            file: self.toml.clone(),
            field: field.to_owned(),
            value: name.to_owned(),
            reason: error.to_string(),
            limit: "a readable file, relative to the TOML file".to_owned(),
        };
        let path = self.directory.join(name);
        let file = input_file::open(&path, input_file::FULL_MODEL_PART).map_err(missing)?;
        let (made, digest) = std::thread::scope(|scope| {
            let (to_hasher, chunks) = mpsc::sync_channel::<Vec<u8>>(WAITING);
            let hasher = scope.spawn(|| chunks.into_iter().fold(Sha256::new(), Sha256::chain_update).finalize());
            let mut reader = BufReader::with_capacity(CHUNK, Copied { inner: file, to_hasher });
            let made = work(&mut reader)?;
            // The hash covers the whole file, even if `work` did not read to the end.
            io::copy(&mut reader, &mut io::sink()).map_err(missing)?;
            drop(reader);
            Ok((made, hasher.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)).into()))
        })?;
        self.add(name.to_owned(), digest);
        Ok(made)
    }

    /// The names of all files read, the TOML file first.
    pub fn names(&self) -> Vec<&str> {
        self.digests.iter().map(|(name, _)| name.as_str()).collect()
    }

    /// SHA-256 over names and hashes of all files, hexadecimal.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        for (name, digest) in &self.digests {
            hasher.update((name.len() as u64).to_le_bytes());
            hasher.update(name.as_bytes());
            hasher.update(digest);
        }
        hex(&hasher.finalize())
    }
}

/// A reader that sends a copy of everything read through it to the thread that hashes.
struct Copied<R> {
    inner: R,
    to_hasher: SyncSender<Vec<u8>>,
}

impl<R: Read> Read for Copied<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(buffer)?;
        // The hasher receives until this reader is dropped.
        self.to_hasher.send(buffer[..count].to_vec()).map_err(io::Error::other)?;
        Ok(count)
    }
}
