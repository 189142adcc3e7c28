//! Chooses the folder for shared memory, and checks that there is enough space.
//!
//! iceoryx2 keeps its files in one folder for the whole machine (`/tmp/iceoryx2`). It belongs to the user who created
//! it, and other users cannot join. If it is not usable, and no iceoryx2 configuration file names another one, all
//! processes of a user take a folder of that user.

use std::ffi::OsStr;
use std::fs::DirBuilder;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::Once;

use iceoryx2::prelude::*;
use rustix::fs::Access;

use super::shm::ShmError;

/// Where the system keeps shared memory.
const MEMORY: &str = "/dev/shm";
/// Free space required there, bytes. If a page cannot be provided when it is first written to, the process dies of
/// SIGBUS without a message.
const LEAST_FREE: u64 = 32 << 20;

/// The iceoryx2 configuration of this process, with `file_prefix` instead of the usual one.
///
/// # Errors
/// [`ShmError::FilePrefix`], [`ShmError::Place`], [`ShmError::NoRoom`].
pub(super) fn config(file_prefix: Option<&str>) -> Result<Config, ShmError> {
    check_room(Path::new(MEMORY), LEAST_FREE)?;
    let mut config = Config::global_config().clone();
    let root = path_of(config.global.root_path());
    let default = path_of(Config::default().global.root_path());
    let user = rustix::process::geteuid().as_raw();
    if root == default
        && let Err(why) = usable(&root, user)
    {
        let (own, prefix) = (PathBuf::from(format!("/tmp/iceoryx2-{user}")), format!("iox2_{user}_"));
        static SAID: Once = Once::new();
        SAID.call_once(|| {
            note!(
                "shared memory: {} {why}; using {} with the prefix {prefix} instead. Programs of other users are not reached; \
                 yours that use iceoryx2 need this root-path and prefix in their iceoryx2.toml",
                root.display(),
                own.display()
            );
        });
        make_own(&own, user)?;
        let path = iceoryx2::prelude::Path::new(own.as_os_str().as_encoded_bytes());
        config.global.set_root_path(&path.map_err(|_| place(&own, "is no path for iceoryx2"))?);
        config.global.prefix = file_name(&prefix)?;
    }
    if let Some(prefix) = file_prefix {
        config.global.prefix = file_name(prefix)?;
    }
    Ok(config)
}

fn file_name(name: &str) -> Result<FileName, ShmError> {
    FileName::new(name.as_bytes()).map_err(|_| ShmError::FilePrefix(name.to_owned()))
}

/// Converts an iceoryx2 path to a standard path.
pub(super) fn path_of(path: &iceoryx2::prelude::Path) -> PathBuf {
    Path::new(OsStr::from_bytes(path.as_bytes())).components().collect()
}

fn place(path: &Path, reason: impl ToString) -> ShmError {
    ShmError::Place { path: path.to_owned(), reason: reason.to_string() }
}

/// Whether `user` can keep files in the machine-wide folder; the error says why not.
fn usable(root: &Path, user: u32) -> Result<(), String> {
    for folder in [root.to_owned(), root.join("nodes"), root.join("services")] {
        let metadata = match folder.symlink_metadata() {
            Ok(metadata) => metadata,
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => return Err(error.to_string()),
        };
        if !metadata.is_dir() {
            return Err("is no folder".to_owned());
        }
        // The owner of the folder can remove and replace files in it.
        if user != 0 && metadata.uid() != user && metadata.uid() != 0 {
            return Err(format!("belongs to user {}", metadata.uid()));
        }
        if rustix::fs::access(&folder, Access::WRITE_OK | Access::EXEC_OK).is_err() {
            return Err("cannot be written to".to_owned());
        }
    }
    Ok(())
}

/// Creates the folder of `user`. An existing one that others can write to is refused.
fn make_own(folder: &Path, user: u32) -> Result<(), ShmError> {
    match DirBuilder::new().mode(0o700).create(folder) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(place(folder, error)),
        _ => {}
    }
    let metadata = folder.symlink_metadata().map_err(|error| place(folder, error))?;
    if !metadata.is_dir() || metadata.uid() != user || metadata.mode() & 0o022 != 0 {
        return Err(place(folder, format!("expected a folder of user {user} that no other user can write to")));
    }
    Ok(())
}

/// Checks that a file system has space for the shared memory.
fn check_room(folder: &Path, limit: u64) -> Result<(), ShmError> {
    // Without the folder iceoryx2 reports the error.
    let Ok(status) = rustix::fs::statvfs(folder) else { return Ok(()) };
    let free = status.f_bavail.saturating_mul(status.f_frsize);
    if free < limit { Err(ShmError::NoRoom { path: folder.to_owned(), free, limit }) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_folder_of_another_user_is_not_used() {
        let folder = tempfile::tempdir().unwrap();
        let user = folder.path().metadata().unwrap().uid();
        assert_eq!(usable(&folder.path().join("none"), user), Ok(()));
        assert_eq!(usable(folder.path(), user), Ok(()));
        let stranger = user + 1000;
        if user != 0 {
            assert_eq!(usable(folder.path(), stranger), Err(format!("belongs to user {user}")));
        }
        assert!(make_own(folder.path(), stranger).is_err());
        std::fs::write(folder.path().join("nodes"), "").unwrap();
        assert_eq!(usable(folder.path(), user), Err("is no folder".to_owned()));
    }

    #[test]
    fn a_users_own_folder_is_private() {
        let folder = tempfile::tempdir().unwrap();
        let user = folder.path().metadata().unwrap().uid();
        let own = folder.path().join("own");
        make_own(&own, user).unwrap();
        assert_eq!(own.metadata().unwrap().mode() & 0o777, 0o700);
        make_own(&own, user).unwrap();
        std::fs::set_permissions(&own, std::fs::Permissions::from_mode(0o777)).unwrap();
        assert!(make_own(&own, user).unwrap_err().to_string().contains("no other user can write to"));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(folder.path(), &link).unwrap();
        assert!(make_own(&link, user).is_err(), "a link planted under the name");
    }

    #[test]
    fn too_little_room_is_an_error_with_both_numbers() {
        assert!(check_room(Path::new("/none"), u64::MAX).is_ok());
        let error = check_room(Path::new("/"), u64::MAX).unwrap_err().to_string();
        assert!(error.contains("/ has ") && error.contains(&format!("expected at least {}", u64::MAX)), "{error}");
    }
}
