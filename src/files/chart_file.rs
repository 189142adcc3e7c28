//! Stores charts on disk, complete or unfinished, so that each rig is charted only once. There is one file for each
//! content of a rig.
//!
//! The file consists of a magic line, the SHA-256 of what follows, the key, and the words of the chart, little-endian.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::whole_file::{WholeFileError, folder_of, write_whole};
use crate::files::input_file;
use crate::physics::Chart;
use crate::physics::chart::{BUILDER, FORMAT};
use crate::text::hex::hex;

/// First line of the file.
const MAGIC: &[u8] = b"squealcast chart\n";
const HASH: usize = 32;

/// The file for the chart of one rig.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChartFile {
    path: PathBuf,
    key: [u8; HASH],
}

/// Why a chart file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ChartFileError {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{}: damaged, or not a chart of this rig", path.display())]
    Foreign { path: PathBuf },
    #[error(transparent)]
    Write(#[from] WholeFileError),
}

impl ChartFile {
    /// The chart file of the rig with `content_hash`, read from `rig_file`. It is `<rig>.<hash>.chart` in the folder of
    /// the rig file. For an embedded rig, or if that folder is not writable, it is in the cache folder. `None` without
    /// a usable folder.
    pub fn locate(rig_name: &str, rig_file: Option<&Path>, content_hash: &str) -> Option<Self> {
        let key = key(content_hash, &BUILDER);
        let short = hex(&key[..8]);
        let name = |stem: &str| format!("{stem}.{short}.chart");
        let next_to_rig = rig_file.and_then(|file| {
            let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            let writable = rustix::fs::access(folder, rustix::fs::Access::WRITE_OK).is_ok();
            Some(folder.join(name(&file.file_stem()?.to_string_lossy()))).filter(|_| writable)
        });
        let cached = || Some(cache_folder()?.join(name(&rig_name.replace(['/', '\\'], "_"))));
        next_to_rig.or_else(cached).map(|path| Self { path, key })
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Loads the chart; `None` if there is no file.
    ///
    /// # Errors
    /// [`ChartFileError`].
    pub fn load(&self) -> Result<Option<Chart>, ChartFileError> {
        let bytes = match input_file::read(&self.path, input_file::CHART) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(ChartFileError::Io { path: self.path.clone(), source }),
        };
        let chart = self.decode(&bytes).ok_or_else(|| ChartFileError::Foreign { path: self.path.clone() })?;
        Ok(Some(chart))
    }

    fn decode(&self, bytes: &[u8]) -> Option<Chart> {
        let (hash, body) = bytes.strip_prefix(MAGIC)?.split_first_chunk::<HASH>()?;
        let words = body.strip_prefix(&self.key)?;
        if Sha256::digest(body).as_slice() != hash || words.len() % 8 != 0 {
            return None;
        }
        let words: Vec<u64> = words.as_chunks::<8>().0.iter().map(|chunk| u64::from_le_bytes(*chunk)).collect();
        Chart::from_words(&words)
    }

    /// Saves `chart`, creating the folder if necessary.
    ///
    /// # Errors
    /// [`ChartFileError::Io`] for the folder, [`ChartFileError::Write`] for the file.
    pub fn save(&self, chart: &Chart) -> Result<(), ChartFileError> {
        let mut body = self.key.to_vec();
        body.extend(chart.words().into_iter().flat_map(u64::to_le_bytes));
        let folder = folder_of(&self.path);
        fs::create_dir_all(folder).map_err(|source| ChartFileError::Io { path: folder.to_owned(), source })?;
        // Replace a named pipe or similar.
        if fs::metadata(&self.path).is_ok_and(|there| !there.is_file()) {
            let _ = fs::remove_file(&self.path);
        }
        write_whole(&self.path, |out| {
            out.write_all(MAGIC)?;
            out.write_all(&Sha256::digest(&body))?;
            out.write_all(&body)
        })?;
        Ok(())
    }
}

/// The key of a chart: a hash of the rig's content and of the sources of the builder.
fn key(content_hash: &str, builder: &[&str]) -> [u8; HASH] {
    let hash = Sha256::new()
        .chain_update(content_hash)
        .chain_update(FORMAT.to_le_bytes())
        .chain_update(env!("CARGO_PKG_VERSION"));
    builder.iter().fold(hash, |hash, source| hash.chain_update(source)).finalize().into()
}

/// `$XDG_CACHE_HOME/squealcast`, or `~/.cache/squealcast`.
fn cache_folder() -> Option<PathBuf> {
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let cache = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(cache.join("squealcast"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::chart::Scratch;
    use crate::physics::chart::build::{ChartOptions, build};
    use crate::physics::{OperatingPoint, Traces};
    use crate::proof::synthetic::{Synthetic, rig};

    #[test]
    fn a_chart_of_another_builder_has_another_key() {
        let mut older = BUILDER;
        assert_eq!(key("content", &older), key("content", &BUILDER));
        older[3] = "fn roots() {}";
        assert_ne!(key("content", &older), key("content", &BUILDER));
        assert_ne!(key("content", &BUILDER), key("other", &BUILDER));
    }

    /// A loaded chart equals the saved one to the last bit. A damaged file or one of another rig is refused.
    #[test]
    fn keeps_a_chart() {
        let law = crate::physics::ContactLaw { exponent: 0.3, ..Default::default() };
        let synthetic = Synthetic { modes: 8, pairs: 12, damping_ratio: 0.0, contact_law: law, seed: 3 };
        let model = rig(&synthetic).unwrap();
        let at = |friction_coefficient, normal_load_n| OperatingPoint {
            normal_load_n,
            disc_speed_rad_s: 10.0,
            friction_coefficient,
        };
        let options = ChartOptions {
            low: at(0.0, 50.0),
            high: at(1.0, 2000.0),
            band_max_hz: None,
            tolerance: 1e-8,
            smallest_share: 1e-3,
            max_solves: 10_000,
            threads: 1,
        };
        let chart = build(&model, &options, &|_| true).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let rig_file = folder.path().join("rig.toml");
        let file = ChartFile::locate("rig", Some(&rig_file), "content").unwrap();
        assert!(file.load().unwrap().is_none());
        file.save(&chart).unwrap();
        let loaded = file.load().unwrap().expect("it was saved");
        assert_eq!(loaded.words(), chart.words());
        let (p, traces) = (at(0.41, 777.0), Traces::new(&model));
        let roots = |chart: &Chart| {
            let mut roots = vec![];
            chart.evaluate(&p, traces.at(&model, &p), &mut Scratch::default(), &mut roots).map(|_| format!("{roots:?}"))
        };
        assert_eq!(roots(&loaded), roots(&chart));
        let other =
            ChartFile { path: file.path.clone(), ..ChartFile::locate("rig", Some(&rig_file), "other").unwrap() };
        assert!(matches!(other.load(), Err(ChartFileError::Foreign { .. })));
        let mut bytes = fs::read(file.path()).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(file.path(), &bytes).unwrap();
        assert!(matches!(file.load(), Err(ChartFileError::Foreign { .. })));
        fs::write(file.path(), &bytes[..100]).unwrap();
        assert!(matches!(file.load(), Err(ChartFileError::Foreign { .. })));
        // A named pipe without a writer: loading fails, and saving replaces it by the chart.
        fs::remove_file(file.path()).unwrap();
        rustix::fs::mkfifoat(rustix::fs::CWD, file.path(), rustix::fs::Mode::RWXU).unwrap();
        assert!(file.load().unwrap_err().to_string().ends_with("is a named pipe, expected a regular file"));
        file.save(&chart).unwrap();
        assert!(file.load().unwrap().is_some());
    }
}
