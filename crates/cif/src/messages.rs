//! What a command says on stderr besides its answer: notes and outcomes, which `--quiet` leaves out, and warnings,
//! which stay. Answers go to stdout.

use std::sync::atomic::{AtomicBool, Ordering};

/// True while a command runs that shall be quiet. One per process, as stderr is.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Sets whether notes, outcomes and progress are left out from now on.
pub(crate) fn set_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

/// True where notes, outcomes and progress are left out.
#[must_use]
pub(crate) fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// Prints a line on stderr unless the command is quiet: what was done, and what comes next.
macro_rules! outcome {
    ($($message:tt)*) => {
        if !$crate::messages::is_quiet() {
            eprintln!($($message)*);
        }
    };
}

/// Prints a note on stderr unless the command is quiet: a finding that nothing needs to be done about.
macro_rules! note {
    ($($message:tt)*) => {
        if !$crate::messages::is_quiet() {
            eprintln!("note: {}", format_args!($($message)*));
        }
    };
}

pub(crate) use {note, outcome};
