//! An error that names the file or the thing at fault, and the remedy.

use std::io;
use std::path::{Path, PathBuf};

/// Something could not be done.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Something about the input prevents it.
    #[error("{problem}")]
    Refused {
        /// The problem, naming the file and the part of it.
        problem: String,
        /// Remedy.
        fix: String,
    },
    /// The operating system reported an error.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// Action that failed, as in `read` or `write`.
        action: &'static str,
        /// File or folder.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
}

impl Error {
    /// A problem and its remedy.
    pub fn refused(problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Refused { problem: problem.into(), fix: fix.into() }
    }

    /// Turns an error of the operating system into one that names the file.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
