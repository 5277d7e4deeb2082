//! Messages of a command on stderr besides its answer: notes and outcomes, which `--quiet` leaves out, and warnings,
//! which stay. Answers go to stdout.

use std::borrow::Cow;
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

/// A text without control characters, which names of files may hold and terminals obey: they are written as in `\u{1b}`.
pub(crate) fn plain(text: &str) -> Cow<'_, str> {
    let is_odd = |letter: char| letter.is_control() && letter != '\n' && letter != '\t';
    if !text.contains(is_odd) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len());
    for letter in text.chars() {
        if is_odd(letter) { shown.extend(letter.escape_default()) } else { shown.push(letter) }
    }
    Cow::Owned(shown)
}

/// Prints a line on stderr unless the command is quiet: what was done, and what comes next.
macro_rules! outcome {
    ($($message:tt)*) => {
        if !$crate::messages::is_quiet() {
            eprintln!("{}", $crate::messages::plain(&format!($($message)*)));
        }
    };
}

/// Prints a note on stderr unless the command is quiet: a finding that nothing needs to be done about.
macro_rules! note {
    ($($message:tt)*) => {
        if !$crate::messages::is_quiet() {
            eprintln!("note: {}", $crate::messages::plain(&format!($($message)*)));
        }
    };
}

/// Prints a warning on stderr.
macro_rules! warning {
    ($($message:tt)*) => {
        eprintln!("warning: {}", $crate::messages::plain(&format!($($message)*)))
    };
}

pub(crate) use {note, outcome, warning};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_do_not_command_terminals() {
        assert_eq!(plain("walk \u{1b}[31m.jpg\nnext\tline"), "walk \\u{1b}[31m.jpg\nnext\tline");
        assert!(matches!(plain("tasse é.jpg"), Cow::Borrowed(_)));
        let message = crate::Error::plain("a\u{7}.jpg: damaged").to_string();
        assert_eq!(message, "a\\u{7}.jpg: damaged");
    }
}
