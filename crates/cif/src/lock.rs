//! Locks on files to be written, so that two commands never write the same one at a time.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use cif_scene::files::folder_of;

use crate::error::Error;

/// Times that a lock file which another process is removing is opened again.
const ATTEMPTS: usize = 16;

/// Longest line that is shown of a lock file.
const LONGEST_LINE: u64 = 200;

/// A file that is locked for this process: the system releases it however the process ends. Held as a lock on
/// `.NAME.lock` beside the file, which is removed in the end.
#[derive(Debug)]
pub struct Lock {
    /// Open for as long as it is locked.
    _file: File,
    path: PathBuf,
}

impl Lock {
    /// Locks `target`, which need not exist; `None`, with a note, where the file system has no locks.
    ///
    /// # Errors
    /// When another process holds it, which is named, or the lock file cannot be made.
    pub fn take(target: &Path) -> Result<Option<Self>, Error> {
        // By whatever name, a file is locked once.
        let real = if target.is_symlink() { target.canonicalize().ok() } else { None };
        let real = real.as_deref().unwrap_or(target);
        let name = real.file_name().unwrap_or_default().to_string_lossy();
        let path = folder_of(real).join(format!(".{name}.lock"));
        for _ in 0..ATTEMPTS {
            let mut file = OpenOptions::new()
                .create(true)
                .read(true)
                .write(true)
                .truncate(false)
                .open(&path)
                .map_err(Error::io("create the lock file", &path))?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Err(held(target, &path, &mut file)),
                Err(TryLockError::Error(error)) => {
                    eprintln!(
                        "note: the folder of {} has no file locks ({error}); a second run to the same file is \
                         noticed only when it has saved",
                        target.display()
                    );
                    // Others cannot lock it either.
                    let _ = std::fs::remove_file(&path);
                    return Ok(None);
                }
            }
            let holder = format!(
                "process {}, since {}\n",
                std::process::id(),
                humantime::format_rfc3339_micros(SystemTime::now())
            );
            file.set_len(0)
                .and_then(|()| file.rewind())
                .and_then(|()| file.write_all(holder.as_bytes()))
                .and_then(|()| file.flush())
                .map_err(Error::io("write the lock file", &path))?;
            // Whoever held it before may have removed the file since it was opened.
            if std::fs::read_to_string(&path).is_ok_and(|now| now == holder) {
                return Ok(Some(Self { _file: file, path }));
            }
        }
        Err(Error::failed(
            format!("cannot lock {}: other commands keep starting and ending on it", target.display()),
            "try again when they are done",
        ))
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Still locked, so that nobody else's is removed.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Another process holds the lock.
fn held(target: &Path, path: &Path, file: &mut File) -> Error {
    let mut line = String::new();
    // Some systems do not let a locked file be read.
    let _ = file.take(LONGEST_LINE).read_to_string(&mut line);
    let line = line.trim();
    let holder = if line.starts_with("process ") && !line.contains('\n') {
        format!(" ({line})")
    } else {
        String::new()
    };
    Error::failed(
        format!("another command{holder} is writing {}; it holds {}", target.display(), path.display()),
        "wait for it, stop it, or choose another name with -o",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_locked_once_and_nothing_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("a.cif");
        let lock = Lock::take(&target).unwrap().unwrap();
        let refused = Lock::take(&target).unwrap_err().to_string();
        assert!(refused.contains(&format!("(process {}, since ", std::process::id())), "{refused}");
        assert!(Lock::take(&folder.path().join("b.cif")).unwrap().is_some());
        drop(lock);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        // What a killed process leaves behind locks nothing.
        std::fs::write(folder.path().join(".a.cif.lock"), "process 1, since long ago\n").unwrap();
        drop(Lock::take(&target).unwrap().unwrap());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[cfg(unix)]
    #[test]
    fn a_link_is_locked_as_what_it_points_to() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link] = ["a.cif", "link.cif"].map(|name| folder.path().join(name));
        std::fs::write(&file, "a").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        let _lock = Lock::take(&file).unwrap().unwrap();
        assert!(Lock::take(&link).is_err());
    }
}
