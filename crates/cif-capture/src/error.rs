//! Errors of making captures: each names the file and the way out.

use std::io;
use std::path::{Path, PathBuf};

/// A capture could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file of a capture could not be read or written.
    #[error(transparent)]
    Dataset(#[from] cif_dataset::Error),
    /// Something about the input keeps a capture from being made.
    #[error("{problem}")]
    Refused {
        /// The problem, naming the file.
        problem: String,
        /// Remedy.
        fix: String,
    },
    /// The images of a camera share nothing that moves, so that they show no depth.
    #[error("{problem}")]
    StandsStill {
        /// The problem, naming the camera.
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
    /// The caller asked to stop.
    #[error("interrupted")]
    Stopped,
}

impl Error {
    /// A problem and its remedy.
    pub fn refused(problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Refused { problem: problem.into(), fix: fix.into() }
    }

    /// A camera that stands still, and the remedy.
    pub(crate) fn stands_still(problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::StandsStill { problem: problem.into(), fix: fix.into() }
    }

    /// Turns an error of the system into one that names the file.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
