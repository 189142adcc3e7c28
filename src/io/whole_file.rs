//! Files that appear under their name complete or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use anyhow::Context;

/// Writes a file beside its final name, then renames it: never half a file under the name asked for.
///
/// # Errors
/// What `write` or the file system reports, with the path; what was begun is removed.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> anyhow::Result<()> {
    let name = path.file_name().with_context(|| format!("{}: not the name of a file", path.display()))?;
    let beside = path.with_file_name(format!(".{}.part", name.to_string_lossy()));
    let written = File::create(&beside).and_then(|file| {
        let mut writer = BufWriter::with_capacity(1 << 20, file);
        write(&mut writer)?;
        writer.flush()?;
        fs::rename(&beside, path)
    });
    if written.is_err() {
        // Whether it can be removed or not, the first error is the one to tell.
        let _ = fs::remove_file(&beside);
    }
    written.with_context(|| format!("{}: cannot write", path.display()))
}
