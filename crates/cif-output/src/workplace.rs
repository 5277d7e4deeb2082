//! Folders for temporary files of a command, in the system's folder for these.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use crate::shared::{check_private, open_own};
use crate::unfinished::Removed;

/// File in a workplace that the process locks whose it is.
const LOCK: &str = ".lock";

/// A folder for temporary files that nobody else reads or writes. It goes when this is dropped and by
/// [`crate::abandon`]; that of a process that was killed goes when the next one with the same prefix is made.
#[derive(Debug)]
pub struct Workplace {
    removed: Removed,
    /// Locked for as long as the folder is used.
    _lock: File,
}

impl Workplace {
    /// Makes a folder whose name begins with `prefix`, which ends in `-`.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn create(prefix: &str) -> io::Result<Self> {
        Self::inside(&std::env::temp_dir(), prefix)
    }

    fn inside(place: &Path, prefix: &str) -> io::Result<Self> {
        sweep(place, prefix);
        let mut builder = tempfile::Builder::new();
        builder.prefix(prefix).rand_bytes(12);
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o700));
        loop {
            let path = builder.tempdir_in(place)?.keep();
            let removed = Removed::new(path);
            let lock = match open_own(&removed.path().join(LOCK)) {
                // Another process took it for a dead one's before it was locked, and removed it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                lock => lock?,
            };
            let is_taken = matches!(lock.try_lock(), Err(fs::TryLockError::WouldBlock));
            if !is_taken && removed.path().join(LOCK).exists() {
                return Ok(Self { removed, _lock: lock });
            }
        }
    }

    /// The folder.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.removed.path()
    }
}

/// Removes the workplaces of this user's dead processes.
fn sweep(place: &Path, prefix: &str) {
    for entry in fs::read_dir(place).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let path: PathBuf = entry.path();
        let is_ours =
            name.to_str().is_some_and(|name| name.starts_with(prefix)) && check_private(&path).is_ok();
        // One without a lock is being made, or is something else.
        if !is_ours || !path.join(LOCK).exists() {
            continue;
        }
        if open_own(&path.join(LOCK)).is_ok_and(|lock| lock.try_lock().is_ok()) {
            // What cannot be removed now is tried again the next time.
            let _ = fs::remove_dir_all(&path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workplaces_of_dead_processes_go_and_those_of_living_ones_stay() {
        let place = tempfile::tempdir().unwrap();
        let names = || fs::read_dir(place.path()).unwrap().count();
        let living = Workplace::inside(place.path(), "cif-a-").unwrap();
        fs::write(living.path().join("frame.png"), "x").unwrap();
        let dead = Workplace::inside(place.path(), "cif-a-").unwrap();
        fs::write(dead.path().join("frame.png"), "x").unwrap();
        // As when it is killed: the lock goes, the folder stays. To close the file is not enough, as a process that
        // another test has just begun may share it for a moment.
        let Workplace { removed, _lock: lock } = dead;
        lock.unlock().unwrap();
        std::mem::forget(removed);
        fs::create_dir(place.path().join("cif-a-mine")).unwrap();
        let other = Workplace::inside(place.path(), "cif-b-").unwrap();
        assert_eq!(names(), 4, "another command's");
        let next = Workplace::inside(place.path(), "cif-a-").unwrap();
        assert_eq!(names(), 4, "the dead one's is gone");
        assert!(living.path().join("frame.png").exists());
        drop([living, other, next]);
        assert_eq!(names(), 1, "what is not ours stays");
    }
}
