//! stdout and stderr, whose readers may leave while the command works.
//!
//! The macros here stand in for those of the standard library, which panic then. Messages that nobody reads any more are
//! dropped and the work goes on; what else keeps an answer from stdout, such as a full disk behind it, is the command's
//! failure in the end.

use std::fmt::Arguments;
use std::io::{self, ErrorKind, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::error::Error;

/// The first failure to write to stdout.
static FAILURE: Mutex<Option<io::Error>> = Mutex::new(None);

/// Prints on stdout.
macro_rules! print {
    ($($words:tt)*) => { $crate::streams::answer(format_args!($($words)*)) };
}

/// Prints a line on stdout.
macro_rules! println {
    () => { print!("\n") };
    ($($words:tt)*) => { print!("{}\n", format_args!($($words)*)) };
}

/// Prints on stderr.
macro_rules! eprint {
    ($($words:tt)*) => { $crate::streams::message(format_args!($($words)*)) };
}

/// Prints a line on stderr.
macro_rules! eprintln {
    () => { eprint!("\n") };
    ($($words:tt)*) => { eprint!("{}\n", format_args!($($words)*)) };
}

/// True where the process ends when a reader of its stdout or stderr has left.
static ENDS: AtomicBool = AtomicBool::new(false);

/// From here on the process ends by SIGPIPE when a reader of its stdout or stderr has left, as programs do by default: for
/// commands that do nothing but print. Readers of other pipes are programs that it started itself, whose end it reports.
pub(crate) fn end_with_reader() {
    ENDS.store(true, Ordering::Relaxed);
}

/// Writes to stdout.
pub(crate) fn answer(words: Arguments<'_>) {
    let mut stdout = io::stdout().lock();
    keep_failure(stdout.write_fmt(words));
}

/// Writes to stderr, whose failures reach nobody.
pub(crate) fn message(words: Arguments<'_>) {
    // In one piece, so that lines of threads and of children do not mix.
    if io::stderr().write_all(words.to_string().as_bytes()).is_err_and(|error| is_reader_gone(&error)) {
        reader_left();
    }
}

/// Checks that all answers went out.
///
/// # Errors
/// When stdout refused one for another reason than that its reader left.
pub(crate) fn check() -> Result<(), Error> {
    keep_failure(io::stdout().flush());
    let failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take();
    failure.map_or(Ok(()), |error| Err(Error::plain(format!("cannot write to stdout: {error}"))))
}

fn keep_failure(done: io::Result<()>) {
    match done {
        Err(error) if is_reader_gone(&error) => reader_left(),
        Err(error) => {
            FAILURE.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
        Ok(()) => {}
    }
}

fn is_reader_gone(error: &io::Error) -> bool {
    error.kind() == ErrorKind::BrokenPipe
}

/// Ends a process that only prints, without what it has not finished.
fn reader_left() {
    if ENDS.load(Ordering::Relaxed) {
        cif_output::abandon();
        #[cfg(unix)]
        let _ = signal_hook::low_level::emulate_default_handler(signal_hook::consts::SIGPIPE);
    }
}
