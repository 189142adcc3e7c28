//! Files that appear under their name complete or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::Context;

/// Files that are being written, where they are until they are whole.
static BEGUN: Mutex<Vec<PathBuf>> = Mutex::new(vec![]);

fn begun() -> MutexGuard<'static, Vec<PathBuf>> {
    // A list of paths is never half changed.
    BEGUN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes what is not whole yet, for a process that is about to end.
pub fn remove_begun() {
    // One that cannot be removed must not keep the others.
    begun().drain(..).for_each(|path| drop(fs::remove_file(path)));
}

/// Where a file is while it is being written.
///
/// # Errors
/// `path` does not end with a name.
fn beside(path: &Path) -> anyhow::Result<PathBuf> {
    let name = path.file_name().with_context(|| format!("{}: not the name of a file", path.display()))?;
    Ok(path.with_file_name(format!(".{}.part", name.to_string_lossy())))
}

/// Writes a file beside its final name, then renames it: never half a file under the name asked for.
///
/// # Errors
/// What `write` or the file system reports, with the path; what was begun is removed.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> anyhow::Result<()> {
    let beside = beside(path)?;
    begun().push(beside.clone());
    let written = File::create(&beside).and_then(|file| {
        let mut writer = BufWriter::with_capacity(1 << 20, file);
        write(&mut writer)?;
        writer.flush()?;
        fs::rename(&beside, path)
    });
    begun().retain(|path| *path != beside);
    if written.is_err() {
        // Whether it can be removed or not, the first error is the one to tell.
        let _ = fs::remove_file(&beside);
    }
    written.with_context(|| format!("{}: cannot write", path.display()))
}
