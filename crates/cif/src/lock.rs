//! Locks on files to be written, so that two commands never write the same one at a time.
//!
//! A lock of the system is one that it releases however the process ends. Not every file system that machines share has such
//! locks, and some have them for each machine alone (NFS that is mounted with `nolock`, most of what is mounted by FUSE), so
//! that a lock that is granted says nothing about other machines. Whoever holds one therefore also gives signs of life in the
//! lock file, and whoever finds a file of another machine waits for one.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Seek, Write};
use std::path::Path;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use cif_output::{Removed, folder_of};

use crate::error::Error;
use crate::interrupt;

/// Times that a lock file which another process is removing is opened again.
const ATTEMPTS: usize = 16;

/// Time that a short change of a file waits for others to end, which take seconds; chosen.
const PATIENCE: Duration = Duration::from_secs(30);

/// Pause between two tries.
const PAUSE: Duration = Duration::from_millis(50);

/// Time between two signs of life.
const SIGN: Duration = Duration::from_secs(5);

/// Time without a sign after which a process of another machine is taken for dead: two signs may be late.
const SILENCE: Duration = Duration::from_secs(15);

/// Time in which a process that has made a lock file has written into it.
const BEGINNING: Duration = Duration::from_secs(1);

/// Longest line that is shown of a lock file.
const LONGEST_LINE: u64 = 200;

/// A file that is locked for this process: as long as it lives. Held as a lock on `.NAME.lock` next to the file, which is
/// removed in the end.
#[derive(Debug)]
pub struct Lock {
    /// Ended before the file is removed.
    _signs: Signs,
    /// Removed while it is still locked, so that nobody else's is.
    _removed: Removed,
    /// Open for as long as it is locked.
    _file: File,
}

/// Outcome of one try.
#[derive(Debug)]
pub enum Attempt {
    /// It is locked for this process.
    Taken(Lock),
    /// Another process holds it.
    Held,
}

/// Reasons why a file is not locked.
enum Busy {
    /// Another process has it.
    Held(Error),
    Failed(Error),
}

impl Lock {
    /// Locks `target`, which need not exist.
    ///
    /// # Errors
    /// When another process holds it, which is named, or the lock file cannot be made.
    pub fn take(target: &Path) -> Result<Self, Error> {
        Self::attempt(target, SILENCE).map_err(|(Busy::Held(error) | Busy::Failed(error))| error)
    }

    /// As [`Self::take`], where that another process holds it is no error.
    ///
    /// # Errors
    /// When the lock file cannot be made.
    pub fn attempt_once(target: &Path) -> Result<Attempt, Error> {
        match Self::attempt(target, SILENCE) {
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
    pub fn wait(target: &Path) -> Result<Self, Error> {
        let begun = Instant::now();
        loop {
            match Self::attempt(target, SILENCE) {
                Err(Busy::Held(_)) if begun.elapsed() < PATIENCE => std::thread::sleep(PAUSE),
                done => return done.map_err(|(Busy::Held(error) | Busy::Failed(error))| error),
            }
        }
    }

    fn attempt(target: &Path, silence: Duration) -> Result<Self, Busy> {
        // By whatever name, a file is locked once.
        let real = if target.is_symlink() { target.canonicalize().ok() } else { None };
        let real = real.as_deref().unwrap_or(target);
        let name = real.file_name().unwrap_or_default().to_string_lossy();
        let path = folder_of(real).join(format!(".{name}.lock"));
        for _ in 0..ATTEMPTS {
            let (file, is_new) =
                open(&path).map_err(Error::io("use the lock file", &path)).map_err(Busy::Failed)?;
            let is_locked = match file.try_lock() {
                Ok(()) => true,
                Err(TryLockError::WouldBlock) => return Err(Busy::Held(held(target, &path))),
                // The file system has no locks.
                Err(TryLockError::Error(_)) => false,
            };
            if !is_new {
                let left = fs::read_to_string(&path).unwrap_or_default();
                // The system knows the processes of this machine.
                let is_dead = is_locked && is_of(&left, &cif_system::host::host());
                match if is_dead { Watched::Silent } else { watch(&path, &left, silence) } {
                    Watched::Silent => {}
                    Watched::Ended => continue,
                    Watched::Alive => return Err(Busy::Held(held(target, &path))),
                }
            }
            let holder = Holder::this();
            holder.sign(&file).map_err(|error| {
                // Of a full disk; nobody else has it.
                let _ = fs::remove_file(&path);
                Busy::Failed(Error::io("write the lock file", &path)(error))
            })?;
            // Whoever held it before may have removed the file since it was opened.
            if fs::read_to_string(&path).is_ok_and(|now| now.starts_with(&holder.line)) {
                let signs = Signs::begin(holder, &file)
                    .map_err(Error::io("write the lock file", &path))
                    .map_err(Busy::Failed)?;
                return Ok(Self { _signs: signs, _removed: Removed::new(path), _file: file });
            }
        }
        Err(Busy::Held(Error::failed(
            format!("cannot lock {}: other commands keep starting and ending on it", target.display()),
            "try again when they are done",
        )))
    }
}

/// Opens a lock file, and says whether it was made: by one machine only, where several share the folder.
fn open(path: &Path) -> io::Result<(File, bool)> {
    match OpenOptions::new().create_new(true).read(true).write(true).open(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            cif_output::open_own(path).map(|file| (file, false))
        }
        made => made.map(|file| (file, true)),
    }
}

/// A process that holds a lock.
struct Holder {
    /// Its number, machine and beginning, as the first line of the lock file.
    line: String,
}

impl Holder {
    fn this() -> Self {
        let host = cif_system::host::host();
        let host = if host.is_empty() { host } else { format!(" on {host}") };
        Self { line: format!("process {}{host}, since {}\n", std::process::id(), written(SystemTime::now())) }
    }

    /// Writes the lines of this process, of which the second is new, where other machines read them.
    fn sign(&self, mut file: &File) -> io::Result<()> {
        let lines = format!("{}alive {}\n", self.line, written(SystemTime::now()));
        file.rewind()?;
        file.write_all(lines.as_bytes())?;
        file.set_len(lines.len() as u64)?;
        file.sync_data()
    }
}

/// True for a lock file that a process of a machine has left, or one without the name of a machine.
fn is_of(left: &str, host: &str) -> bool {
    let line = left.lines().next().unwrap_or_default();
    !left.is_empty()
        && line
            .rsplit_once(", since ")
            .is_none_or(|(process, _)| process.split_once(" on ").is_none_or(|(_, machine)| machine == host))
}

/// The process that has left a lock file, after some time.
#[derive(Debug, PartialEq, Eq)]
enum Watched {
    /// It gave a sign; or nobody waits for one any more.
    Alive,
    /// It has removed the file.
    Ended,
    Silent,
}

/// Waits for a sign in a lock file.
fn watch(path: &Path, left: &str, silence: Duration) -> Watched {
    let silence = if left.is_empty() { silence.min(BEGINNING) } else { silence };
    if silence > BEGINNING {
        eprintln!(
            "note: {} is of {}; waiting up to {} s for a sign that it still runs",
            path.display(),
            left.lines().next().unwrap_or_default(),
            silence.as_secs()
        );
    }
    let begun = Instant::now();
    while begun.elapsed() < silence {
        std::thread::sleep(PAUSE);
        match fs::read_to_string(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Watched::Ended,
            Ok(now) if now == left && !interrupt::requested() => {}
            _ => return Watched::Alive,
        }
    }
    Watched::Silent
}

/// Signs of life of a process, until this is dropped.
#[derive(Debug)]
struct Signs {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Signs {
    fn begin(holder: Holder, file: &File) -> io::Result<Self> {
        let (stop, stopped) = channel();
        let file = file.try_clone()?;
        let thread = std::thread::Builder::new().name("signs of life".to_owned()).spawn(move || {
            while stopped.recv_timeout(SIGN) == Err(RecvTimeoutError::Timeout) {
                // On a full disk the line that is there is written over, and the next sign may succeed.
                let _ = holder.sign(&file);
            }
        })?;
        Ok(Self { stop: Some(stop), thread: Some(thread) })
    }
}

impl Drop for Signs {
    fn drop(&mut self) {
        drop(self.stop.take());
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// A time as lock files have it; clocks that are set outside of the years 1970 to 9999 read as the nearest of these.
fn written(time: SystemTime) -> String {
    let last = SystemTime::UNIX_EPOCH + Duration::from_secs(253_402_300_799);
    humantime::format_rfc3339_micros(time.clamp(SystemTime::UNIX_EPOCH, last)).to_string()
}

/// Another process holds the lock.
fn held(target: &Path, path: &Path) -> Error {
    let mut text = String::new();
    // Some systems do not let a locked file be read.
    let _ = File::open(path).and_then(|file| file.take(LONGEST_LINE).read_to_string(&mut text));
    let line = text.lines().next().unwrap_or_default();
    let holder = if line.starts_with("process ") { format!(" ({line})") } else { String::new() };
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
        let lock = Lock::take(&target).unwrap();
        let refused = Lock::take(&target).unwrap_err().to_string();
        assert!(
            refused.contains(&format!("(process {} on ", std::process::id())) && refused.contains(", since "),
            "{refused}"
        );
        drop(Lock::take(&folder.path().join("b.cif")).unwrap());
        drop(lock);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        // What a killed process leaves behind locks nothing.
        std::fs::write(folder.path().join(".a.cif.lock"), "process 1, since long ago\n").unwrap();
        drop(Lock::take(&target).unwrap());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    /// Lines as [`Holder::sign`] writes them.
    fn lines(machine: &str, sign: u32) -> String {
        format!("process 7 on {machine}, since 2026-01-01T00:00:00Z\nalive {sign}\n")
    }

    #[test]
    fn another_machine_keeps_its_lock_as_long_as_it_gives_signs() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("a.cif");
        let path = folder.path().join(".a.cif.lock");
        // Locks of that machine are not seen here, as on NFS without them.
        fs::write(&path, lines("elsewhere", 0)).unwrap();
        let silence = BEGINNING + 4 * PAUSE;
        std::thread::scope(|scope| {
            let (stop, stopped) = channel::<()>();
            let path = &path;
            scope.spawn(move || {
                let mut sign = 0;
                while stopped.recv_timeout(4 * PAUSE) == Err(RecvTimeoutError::Timeout) {
                    sign += 1;
                    fs::write(path, lines("elsewhere", sign)).unwrap();
                }
            });
            let Err(Busy::Held(refused)) = Lock::attempt(&target, silence) else { panic!("it is held") };
            assert!(refused.to_string().contains("process 7 on elsewhere"), "{refused}");
            drop(stop);
        });
        // It gives none any more.
        let begun = Instant::now();
        let Ok(lock) = Lock::attempt(&target, silence) else { panic!("nobody holds it") };
        assert!(begun.elapsed() >= silence, "it was waited for");
        drop(lock);
        // One that ends while it is waited for takes its file along.
        fs::write(&path, lines("elsewhere", 0)).unwrap();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(4 * PAUSE);
                fs::remove_file(&path).unwrap();
            });
            drop(Lock::take(&target).unwrap());
        });
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_holder_gives_signs() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("a.cif");
        let path = folder.path().join(".a.cif.lock");
        let lock = Lock::take(&target).unwrap();
        let first = fs::read_to_string(&path).unwrap();
        assert!(is_of(&first, &cif_system::host::host()) && !is_of(&first, "elsewhere"), "{first}");
        assert!(!is_of("", "elsewhere"), "it is being written");
        assert_eq!(watch(&path, &first, 2 * SIGN), Watched::Alive);
        let second = fs::read_to_string(&path).unwrap();
        assert_eq!(first.lines().next(), second.lines().next());
        assert_eq!(second.lines().count(), 2);
        drop(lock);
        assert!(!path.exists());
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
                    let _lock = Lock::wait(&target).unwrap();
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
        let _lock = Lock::take(&file).unwrap();
        assert!(Lock::take(&link).is_err());
    }
}
