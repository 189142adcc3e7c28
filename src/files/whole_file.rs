//! Files that appear under their name either complete or not at all, even if the process or the machine stops.
//!
//! A file is written under a random name in the same folder, synced to the disk and renamed. Then its folder is synced,
//! so that the new name survives a power failure. No other module does this. Recordings in progress, which are useful
//! before they are complete, are handled by [`crate::recording::mcap_file`].

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rustix::fs::OFlags;
use tempfile::TempPath;

/// Why a file was not written.
#[derive(Debug, thiserror::Error)]
pub enum WholeFileError {
    #[error("{}: cannot write: {source}", path.display())]
    Write { path: PathBuf, source: io::Error },
    #[error("{}: not the name of a file", path.display())]
    NoName { path: PathBuf },
    #[error("{}: exists and is not a regular file; expected a new name, or a file that may be replaced", path.display())]
    NotAFile { path: PathBuf },
}

/// Temporary files of this process that are not finished.
static BEGUN: Mutex<Vec<PathBuf>> = Mutex::new(vec![]);
/// Held while files that belong together are renamed.
static NAMING: Mutex<()> = Mutex::new(());

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // A list of paths is always consistent.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes all unfinished files of a process that is about to end. From now on no file can be begun or renamed.
pub fn remove_begun() {
    let (naming, mut begun) = (lock(&NAMING), lock(&BEGUN));
    // A file that cannot be removed must not prevent the removal of others.
    begun.drain(..).for_each(|path| drop(fs::remove_file(path)));
    std::mem::forget((naming, begun));
}

/// Suffix of a temporary file. Its name is a dot, the final name, a dot, [`RANDOM`] random letters and this suffix.
const SUFFIX: &str = ".part";
const RANDOM: usize = 6;
/// Age above which an unlocked temporary file counts as left behind by a killed process.
const LEFTOVER_AGE: Duration = Duration::from_secs(60);

/// A file being written under a temporary name, locked (`flock`). It is removed when dropped.
#[derive(Debug)]
pub struct WholeFile {
    file: File,
    /// `None` once the file has its final name.
    temporary: Option<TempPath>,
    path: PathBuf,
}

impl WholeFile {
    /// Begins a file that is named `path` when finished. The temporary file is always new, never an existing link or
    /// file. Temporary files left by killed processes are removed.
    ///
    /// # Errors
    /// [`WholeFileError`].
    pub fn create(path: &Path) -> Result<Self, WholeFileError> {
        let name = path.file_name().ok_or_else(|| WholeFileError::NoName { path: path.to_owned() })?;
        // The target of a link decides: `/dev/stdout` is a link.
        if fs::metadata(path).is_ok_and(|there| !there.is_file()) {
            return Err(WholeFileError::NotAFile { path: path.to_owned() });
        }
        let mut start = OsString::from(".");
        start.push(name);
        start.push(".");
        let folder = folder_of(path);
        remove_leftovers(folder, &start);
        let mut begun = lock(&BEGUN);
        let created = tempfile::Builder::new()
            .prefix(&start)
            .suffix(SUFFIX)
            .rand_bytes(RANDOM)
            .permissions(Permissions::from_mode(0o666)) // less the umask, as any new file
            .tempfile_in(folder);
        let (file, temporary) = created.map_err(|source| write_error(path, source))?.into_parts();
        begun.push(temporary.to_path_buf());
        // Some file systems have no locks; there only the age identifies remains.
        let _ = file.try_lock();
        Ok(Self { file, temporary: Some(temporary), path: path.to_owned() })
    }

    /// The open temporary file.
    pub fn as_file(&self) -> &File {
        &self.file
    }

    /// Syncs the file to the disk, replaces any file with the final name, and syncs the folder.
    ///
    /// # Errors
    /// [`WholeFileError`]; an existing file of that name is then unchanged.
    pub fn finish(self) -> Result<(), WholeFileError> {
        let path = self.path.clone();
        self.sync()?;
        let naming = lock(&NAMING);
        self.rename()?;
        drop(naming);
        sync_folder(folder_of(&path)).map_err(|source| write_error(&path, source))
    }

    /// As [`finish`](Self::finish), for a file that continues to grow under its final name, which must be free. Nothing
    /// is synced yet.
    ///
    /// # Errors
    /// [`WholeFileError`].
    pub fn name_unfinished(mut self) -> Result<File, WholeFileError> {
        let at = |source| write_error(&self.path, source);
        let file = self.file.try_clone().map_err(at)?;
        let named = self.take_temporary().map(|temporary| temporary.persist_noclobber(&self.path));
        named.unwrap_or(Ok(())).map_err(|error| write_error(&self.path, error.error))?;
        Ok(file)
    }

    fn sync(&self) -> Result<(), WholeFileError> {
        self.file.sync_all().map_err(|source| write_error(&self.path, source))
    }

    fn rename(mut self) -> Result<(), WholeFileError> {
        let named = self.take_temporary().map(|temporary| temporary.persist(&self.path));
        named.unwrap_or(Ok(())).map_err(|error| write_error(&self.path, error.error))
    }

    /// The temporary name, removed from the list of [`remove_begun`].
    fn take_temporary(&mut self) -> Option<TempPath> {
        let temporary = self.temporary.take()?;
        lock(&BEGUN).retain(|begun| *begun != *temporary);
        Some(temporary)
    }
}

impl Drop for WholeFile {
    fn drop(&mut self) {
        drop(self.take_temporary());
    }
}

/// Removes temporary files in `folder` whose names begin with `start` and which killed processes left behind.
fn remove_leftovers(folder: &Path, start: &OsStr) {
    let ours = |name: &OsStr| {
        let random =
            name.as_bytes().strip_prefix(start.as_bytes()).and_then(|rest| rest.strip_suffix(SUFFIX.as_bytes()));
        random.is_some_and(|random| random.len() == RANDOM)
    };
    for entry in fs::read_dir(folder).into_iter().flatten().flatten().filter(|entry| ours(&entry.file_name())) {
        let path = entry.path();
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let Ok(file) = OpenOptions::new().read(true).custom_flags(flags).open(&path) else { continue };
        let modified = file.metadata().and_then(|left| left.modified());
        let old = modified.is_ok_and(|at| at.elapsed().is_ok_and(|age| age > LEFTOVER_AGE));
        if old && file.try_lock().is_ok() {
            let _ = fs::remove_file(&path);
        }
    }
}

/// Writes a file either completely or not at all.
///
/// # Errors
/// [`WholeFileError`]; an existing file at `path` is then unchanged.
pub fn write_whole(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>,
) -> Result<(), WholeFileError> {
    let whole = WholeFile::create(path)?;
    let mut writer = BufWriter::with_capacity(1 << 20, whole.as_file());
    let written = write(&mut writer).and_then(|()| writer.flush());
    // After an error the buffered rest must not be written.
    drop(writer.into_parts());
    written.map_err(|source| write_error(path, source))?;
    whole.finish()
}

/// Writes files that belong together. The last one names the others: it appears after them, and none of them remains
/// without it.
///
/// # Errors
/// [`WholeFileError`] of the first file that cannot be written.
pub fn write_together<'a>(files: impl IntoIterator<Item = (PathBuf, &'a [u8])>) -> Result<(), WholeFileError> {
    let mut written = vec![];
    for (path, bytes) in files {
        let whole = WholeFile::create(&path)?;
        whole.as_file().write_all(bytes).map_err(|source| write_error(&path, source))?;
        whole.sync()?;
        written.push(whole);
    }
    let last = written.len().saturating_sub(1);
    let mut new = vec![];
    let naming = lock(&NAMING);
    let named = written.into_iter().enumerate().try_for_each(|(k, whole)| {
        let path = whole.path.clone();
        let at = |source| write_error(&path, source);
        // The names of the other files must be on the disk before that of the last.
        if k == last {
            sync_folder(folder_of(&path)).map_err(at)?;
        }
        // A file that already existed may belong to other files too, so it is not removed on failure.
        new.extend((!path.exists()).then(|| path.clone()));
        whole.rename()?;
        if k == last { sync_folder(folder_of(&path)).map_err(at) } else { Ok(()) }
    });
    if named.is_err() {
        new.iter().for_each(|path| drop(fs::remove_file(path)));
    }
    drop(naming);
    named
}

/// Syncs a folder, so that new names in it survive a power failure.
///
/// # Errors
/// Errors of `fsync`, unless the file system does not support it for folders.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    sync_open_folder(&File::open(folder)?)
}

/// As [`sync_folder`] for an open folder, even if it was moved.
///
/// # Errors
/// As [`sync_folder`].
pub fn sync_open_folder(folder: &File) -> io::Result<()> {
    match folder.sync_all() {
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}

/// The folder that contains a file.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn write_error(path: &Path, source: io::Error) -> WholeFileError {
    WholeFileError::Write { path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::time::SystemTime;

    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn bytes_of<'a>(folder: &Path, files: &[(&str, &'a [u8])]) -> Vec<(PathBuf, &'a [u8])> {
        files.iter().map(|(name, bytes)| (folder.join(name), *bytes)).collect()
    }

    #[test]
    fn a_file_that_fails_leaves_the_old_one_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.html");
        write_whole(&path, |out| out.write_all(b"first")).unwrap();
        let error = write_whole(&path, |out| {
            out.write_all(b"second")?;
            Err(io::Error::other("no more"))
        });
        assert_eq!(error.unwrap_err().to_string(), format!("{}: cannot write: no more", path.display()));
        assert_eq!(fs::read(&path).unwrap(), b"first");
        assert_eq!(names(folder.path()), ["report.html"]);
        write_whole(&path, |out| out.write_all(b"second")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        assert_eq!(names(folder.path()), ["report.html"]);
        let mode = fs::metadata(&path).unwrap().permissions().mode() & 0o777;
        let plain = folder.path().join("plain");
        fs::write(&plain, "").unwrap();
        assert_eq!(mode, fs::metadata(plain).unwrap().permissions().mode() & 0o777, "as any new file");
    }

    /// In a shared folder, another user can place a link under any predictable name.
    #[test]
    fn links_that_were_planted_are_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let (victim, path) = (folder.path().join("victim"), folder.path().join("report.html"));
        fs::write(&victim, "precious").unwrap();
        symlink(&victim, folder.path().join(".report.html.part")).unwrap();
        symlink(&victim, folder.path().join(".report.html.abcdef.part")).unwrap();
        symlink(&victim, &path).unwrap();
        write_whole(&path, |out| out.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&victim).unwrap(), b"precious");
        assert!(fs::symlink_metadata(&path).unwrap().is_file(), "the link itself was replaced");
        // Temporary names are unique.
        let [first, second] = [(); 2].map(|()| WholeFile::create(&path).unwrap());
        assert_ne!(first.temporary.as_deref(), second.temporary.as_deref());
    }

    #[test]
    fn only_regular_files_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, rustix::fs::Mode::RUSR, 0).unwrap();
        let link = folder.path().join("stdout");
        symlink("/dev/null", &link).unwrap();
        for path in [&pipe, &link, Path::new("/dev/null"), folder.path()] {
            let error = write_whole(path, |out| out.write_all(b"x")).unwrap_err();
            assert!(matches!(error, WholeFileError::NotAFile { .. }), "{error}");
        }
        assert!(matches!(write_whole(Path::new("/"), |_| Ok(())), Err(WholeFileError::NoName { .. })));
        assert_eq!(names(folder.path()), ["pipe", "stdout"]);
    }

    #[test]
    fn leftovers_of_killed_processes_are_removed_but_not_files_being_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.chart");
        let being_written = WholeFile::create(&path).unwrap();
        let left = |name: &str, old: bool| {
            let file = File::create(folder.path().join(name)).unwrap();
            if old {
                file.set_modified(SystemTime::now() - 2 * LEFTOVER_AGE).unwrap();
            }
        };
        left(".rig.chart.aaaaaa.part", true);
        left(".rig.chart.bbbbbb.part", false);
        left(".rig.chart.toolong.part", true);
        left(".other.chart.aaaaaa.part", true);
        being_written.as_file().set_modified(SystemTime::now() - 2 * LEFTOVER_AGE).unwrap();
        write_whole(&path, |out| out.write_all(b"x")).unwrap();
        being_written.finish().unwrap();
        let expected = [".other.chart.aaaaaa.part", ".rig.chart.bbbbbb.part", ".rig.chart.toolong.part", "rig.chart"];
        assert_eq!(names(folder.path()), expected);
    }

    #[test]
    fn files_that_belong_together_appear_together() {
        let folder = tempfile::tempdir().unwrap();
        // The file that names the others cannot be written, because its folder does not exist.
        write_together(bytes_of(folder.path(), &[("a.npz", b"x"), ("none/rig.toml", b"x")])).unwrap_err();
        assert_eq!(names(folder.path()), [] as [String; 0]);
        // It cannot be renamed, because a folder has taken its name.
        let taken = folder.path().join("rig.toml");
        let whole = WholeFile::create(&taken).unwrap();
        fs::create_dir(&taken).unwrap();
        whole.finish().unwrap_err();
        assert_eq!(names(folder.path()), ["rig.toml"]);
        fs::remove_dir(&taken).unwrap();
        write_together(bytes_of(folder.path(), &[("a.npz", b"x"), ("rig.toml", b"y")])).unwrap();
        assert_eq!(names(folder.path()), ["a.npz", "rig.toml"]);
        assert!(lock(&BEGUN).iter().all(|path| !path.starts_with(folder.path())));
    }
}
