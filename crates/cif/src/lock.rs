//! Locks on files to be written, so that two commands never write the same one at a time.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use cif_output::{Removed, folder_of};

use crate::error::Error;

/// Times that a lock file which another process is removing is opened again.
const ATTEMPTS: usize = 16;

/// Time that a short change of a file waits for others to end, which take seconds; chosen.
const PATIENCE: Duration = Duration::from_secs(30);

/// Pause between two tries.
const PAUSE: Duration = Duration::from_millis(50);

/// Longest line that is shown of a lock file.
const LONGEST_LINE: u64 = 200;

/// A file that is locked for this process: the system releases it however the process ends. Held as a lock on
/// `.NAME.lock` next to the file, which is removed in the end.
#[derive(Debug)]
pub struct Lock {
    /// Removed while it is still locked, so that nobody else's is.
    _removed: Removed,
    /// Open for as long as it is locked.
    _file: File,
}

/// Outcome of one try.
#[derive(Debug)]
pub enum Attempt {
    /// It is locked for this process; `None`, with a note, where the file system has no locks.
    Taken(Option<Lock>),
    /// Another process holds it.
    Held,
}

/// Ways in which a lock is not had.
enum Busy {
    /// Another process has it.
    Held(Error),
    Failed(Error),
}

impl Lock {
    /// Locks `target`, which need not exist; `None`, with a note, where the file system has no locks.
    ///
    /// # Errors
    /// When another process holds it, which is named, or the lock file cannot be made.
    pub fn take(target: &Path) -> Result<Option<Self>, Error> {
        Self::attempt(target).map_err(|(Busy::Held(error) | Busy::Failed(error))| error)
    }

    /// As [`Self::take`], where that another process holds it is no error.
    ///
    /// # Errors
    /// When the lock file cannot be made.
    pub fn attempt_once(target: &Path) -> Result<Attempt, Error> {
        match Self::attempt(target) {
            Ok(lock) => Ok(Attempt::Taken(lock)),
            Err(Busy::Held(_)) => Ok(Attempt::Held),
            Err(Busy::Failed(error)) => Err(error),
        }
    }

    /// As [`Self::take`], waiting for other commands to end: for a file that is read, changed and written again, from before
    /// it is read.
    ///
    /// # Errors
    /// As [`Self::take`], when another process still holds it after half a minute.
    pub fn wait(target: &Path) -> Result<Option<Self>, Error> {
        let begun = Instant::now();
        loop {
            match Self::attempt(target) {
                Err(Busy::Held(_)) if begun.elapsed() < PATIENCE => std::thread::sleep(PAUSE),
                done => return done.map_err(|(Busy::Held(error) | Busy::Failed(error))| error),
            }
        }
    }

    fn attempt(target: &Path) -> Result<Option<Self>, Busy> {
        // By whatever name, a file is locked once.
        let real = if target.is_symlink() { target.canonicalize().ok() } else { None };
        let real = real.as_deref().unwrap_or(target);
        let name = real.file_name().unwrap_or_default().to_string_lossy();
        let path = folder_of(real).join(format!(".{name}.lock"));
        for _ in 0..ATTEMPTS {
            let opened = cif_output::open_own(&path).map_err(Error::io("use the lock file", &path));
            let mut file = opened.map_err(Busy::Failed)?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Err(Busy::Held(held(target, &path, &mut file))),
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
            let host = cif_system::host::host();
            let host = if host.is_empty() { host } else { format!(" on {host}") };
            let holder =
                format!("process {}{host}, since {}\n", std::process::id(), written(SystemTime::now()));
            file.set_len(0)
                .and_then(|()| file.rewind())
                .and_then(|()| file.write_all(holder.as_bytes()))
                .and_then(|()| file.flush())
                .map_err(|error| {
                    // Of a full disk; nobody else has it.
                    let _ = std::fs::remove_file(&path);
                    Busy::Failed(Error::io("write the lock file", &path)(error))
                })?;
            // Whoever held it before may have removed the file since it was opened.
            if std::fs::read_to_string(&path).is_ok_and(|now| now == holder) {
                return Ok(Some(Self { _removed: Removed::new(path), _file: file }));
            }
        }
        Err(Busy::Held(Error::failed(
            format!("cannot lock {}: other commands keep starting and ending on it", target.display()),
            "try again when they are done",
        )))
    }
}

/// A time as lock files have it; clocks that are set outside of the years 1970 to 9999 read as the nearest of these.
fn written(time: SystemTime) -> String {
    let last = SystemTime::UNIX_EPOCH + Duration::from_secs(253_402_300_799);
    humantime::format_rfc3339_micros(time.clamp(SystemTime::UNIX_EPOCH, last)).to_string()
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
    fn clocks_may_be_set_to_any_year() {
        let century = Duration::from_secs(100 * 365 * 86_400);
        assert_eq!(written(SystemTime::UNIX_EPOCH - century), "1970-01-01T00:00:00.000000Z");
        assert!(written(SystemTime::UNIX_EPOCH + 90 * century).starts_with("9999-12-31"));
    }

    #[test]
    fn a_file_is_locked_once_and_nothing_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("a.cif");
        let lock = Lock::take(&target).unwrap().unwrap();
        let refused = Lock::take(&target).unwrap_err().to_string();
        assert!(
            refused.contains(&format!("(process {} on ", std::process::id())) && refused.contains(", since "),
            "{refused}"
        );
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
    fn a_planted_lock_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let precious = folder.path().join("precious");
        std::fs::write(&precious, "precious").unwrap();
        std::os::unix::fs::symlink(&precious, folder.path().join(".a.cif.lock")).unwrap();
        let refused = Lock::take(&folder.path().join("a.cif")).unwrap_err().to_string();
        assert!(refused.contains(".a.cif.lock") && refused.contains("it is a link"), "{refused}");
        assert_eq!(std::fs::read_to_string(&precious).unwrap(), "precious");
    }

    #[test]
    fn a_change_waits_for_another_to_end() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("count");
        std::fs::write(&target, "0").unwrap();
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    let _lock = Lock::wait(&target).unwrap().unwrap();
                    let count: u32 = std::fs::read_to_string(&target).unwrap().parse().unwrap();
                    std::thread::sleep(PAUSE);
                    std::fs::write(&target, (count + 1).to_string()).unwrap();
                });
            }
        });
        assert_eq!(std::fs::read_to_string(&target).unwrap(), "4");
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
