//! Benches of a plan, taken apart by the commands themselves.

use std::path::Path;

use cif_batch::{Benches, Part};

use crate::commands::bench;

/// The benches of this command.
pub(super) struct Commands;

impl Benches for Commands {
    fn parts(&self, words: &[String], folder: &Path) -> Result<Vec<Part>, cif_batch::Error> {
        bench::parts(words, folder).map_err(|error| {
            let help = miette::Diagnostic::help(&error).map(|help| help.to_string());
            cif_batch::Error::refused(
                error.to_string(),
                help.unwrap_or_else(|| "see cif bench --help".to_owned()),
            )
        })
    }
}
