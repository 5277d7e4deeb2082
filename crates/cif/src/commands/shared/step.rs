//! Commands of cif that run one after the other in one process, each shown before it runs.

use std::ffi::OsString;

use super::command_line;
use crate::error::Error;

/// Runs a command line of cif.
pub(in crate::commands) type RunLine = fn(Vec<OsString>) -> Result<(), Error>;

/// Runs a command line of cif, whose words begin with the subcommand, and shows it without the flag `hidden`.
///
/// # Errors
/// Those of the command.
pub(in crate::commands) fn step(
    run_line: RunLine,
    words: Vec<OsString>,
    hidden: Option<&str>,
) -> Result<(), Error> {
    let shown: Vec<String> = words.iter().map(|word| word.to_string_lossy().into_owned()).collect();
    eprintln!("$ {}", command_line(&shown));
    let line = std::iter::once(OsString::from("cif")).chain(words).chain(hidden.map(OsString::from));
    run_line(line.collect())
}
