//! Errors of models and of what is made with them: each names the file or tensor and the way out.

use std::io;
use std::path::{Path, PathBuf};

/// Models could not be read or run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Something about the models keeps them from being used.
    #[error("{problem}")]
    Refused {
        /// The problem, naming the file and the tensor.
        problem: String,
        /// Remedy.
        fix: String,
    },
    /// The file system refused.
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
    pub(crate) fn refused(problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Refused { problem: problem.into(), fix: fix.into() }
    }

    /// Turns an error of the system into one that names the file.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
