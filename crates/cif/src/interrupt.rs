//! Requests to stop: Ctrl-C, SIGTERM and SIGHUP where the process is the command's own, else whatever the process
//! asks through a [`Session`].
//!
//! Until a command has something to save, signals end the process with a word, and remove what it has not finished
//! writing.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use crate::error::Error;

/// Time in which a command that saves nothing may end by itself.
const GRACE: Duration = Duration::from_millis(1_500);

/// Until [`watch`], signals end the process at once, and remove what it has not finished writing; those that it was
/// started to ignore, as by `nohup`, stay ignored.
#[cfg(unix)]
fn end_cleanly() {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

    let ignored = ignored_signals();
    let heeded = [SIGHUP, SIGINT, SIGTERM].into_iter().filter(|signal| ignored & (1 << (signal - 1)) == 0);
    // Where this fails, what is left is removed at the next run.
    if let Ok(mut signals) = signal_hook::iterator::Signals::new(heeded) {
        std::thread::spawn(move || {
            if signals.forever().next().is_some() {
                eprintln!("\n{}", last_words());
                end();
            }
        });
    }
}

/// As on Unix, but what is not finished is removed at the next run.
#[cfg(not(unix))]
fn end_cleanly() {}

/// Bit k - 1 for signal k, as far as the system reports it.
#[cfg(unix)]
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}

/// Message of a process that a signal ends.
static LAST_WORDS: Mutex<&str> = Mutex::new("interrupted");

static OWNED: AtomicBool = AtomicBool::new(false);
static SAVES: AtomicBool = AtomicBool::new(false);
static HANDLER: OnceLock<bool> = OnceLock::new();
static REQUESTS: Requests = Requests::new();

/// A request to stop, and the sessions that may be asked.
#[derive(Debug)]
struct Requests {
    requested: AtomicBool,
    sessions: Mutex<usize>,
}

impl Requests {
    const fn new() -> Self {
        Self { requested: AtomicBool::new(false), sessions: Mutex::new(0) }
    }

    /// A session begins without a request, unless others are open.
    fn begin(&self) {
        let mut open = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        if *open == 0 {
            self.requested.store(false, Ordering::SeqCst);
        }
        *open += 1;
    }

    fn end(&self) {
        *self.sessions.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
    }

    /// True where a stop was requested before.
    fn request(&self) -> bool {
        self.requested.swap(true, Ordering::SeqCst)
    }

    fn requested(&self) -> bool {
        self.requested.load(Ordering::SeqCst)
    }
}

/// This process is nothing but the command, which may take its signals and end it.
pub(crate) fn own_process() {
    OWNED.store(true, Ordering::SeqCst);
    end_cleanly();
}

/// True after [`own_process`].
pub(crate) fn is_own_process() -> bool {
    OWNED.load(Ordering::SeqCst)
}

/// Sets the message with which a signal ends the process before the command has something to save.
pub fn set_last_words(message: &'static str) {
    *LAST_WORDS.lock().unwrap_or_else(PoisonError::into_inner) = message;
}

fn last_words() -> &'static str {
    *LAST_WORDS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// From here on a signal asks the command to stop; the process ends 1.5 seconds later at the latest.
pub fn watch() {
    watch_as(false);
}

/// From here on a signal asks the command to stop and to save what it has; a second one ends the process.
pub fn watch_and_save() {
    watch_as(true);
}

/// Watches for a command that saves, or does not: several may run one after the other.
fn watch_as(saves: bool) {
    // Elsewhere signals belong to others.
    if !is_own_process() {
        return;
    }
    SAVES.store(saves, Ordering::SeqCst);
    HANDLER.get_or_init(|| {
        ctrlc::set_handler(|| {
            if REQUESTS.request() {
                end();
            }
            if SAVES.load(Ordering::SeqCst) {
                eprintln!("\nstopping and saving; press Ctrl-C again to quit without saving");
            } else {
                std::thread::sleep(GRACE);
                eprintln!("{}", last_words());
                end();
            }
        })
        .is_ok()
    });
}

/// True where the command is asked to stop.
#[must_use]
pub fn requested() -> bool {
    REQUESTS.requested()
}

/// Goes on, unless the command is asked to stop.
///
/// # Errors
/// After Ctrl-C.
pub fn go_on() -> Result<(), Error> {
    if requested() {
        return Err(Error::Interrupted { message: "interrupted".to_owned(), help: None });
    }
    Ok(())
}

/// A command inside a process of others, which passes requests on. All commands that run at a time share them.
#[derive(Debug)]
pub struct Session(());

impl Session {
    /// Begins without a request, unless other sessions are open.
    #[must_use]
    pub fn begin() -> Self {
        REQUESTS.begin();
        Self(())
    }

    /// Asks the command to stop.
    pub fn request(&self) {
        REQUESTS.request();
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        REQUESTS.end();
    }
}

/// Ends the process as interrupted, without unfinished files.
fn end() -> ! {
    cif_output::abandon();
    // No exit handlers: those of usd-core's libraries must not run while other threads are in them.
    signal_hook::low_level::exit(130);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_last_as_long_as_the_sessions_they_are_meant_for() {
        let requests = Requests::new();
        requests.begin();
        assert!(!requests.requested());
        assert!(!requests.request() && requests.request(), "the second one is distinguished from the first");
        requests.begin();
        assert!(requests.requested(), "one that is being stopped is not forgotten");
        requests.end();
        requests.end();
        requests.begin();
        assert!(!requests.requested());
    }

    #[test]
    fn signals_of_a_process_of_others_are_left_alone() {
        watch_and_save();
        assert!(HANDLER.get().is_none());
    }
}
