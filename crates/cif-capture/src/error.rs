//! Errors of making captures: each names the file and the remedy.

use std::io;
use std::path::Path;

/// A capture could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file of a capture could not be read or written.
    #[error(transparent)]
    Dataset(#[from] cif_dataset::Error),
    /// The input prevents it, or the operating system does.
    #[error(transparent)]
    System(#[from] cif_system::Error),
    /// The images of a camera share nothing that moves, so that they show no depth.
    #[error("{problem}")]
    StandsStill {
        /// The problem, naming the camera.
        problem: String,
        /// Remedy.
        fix: String,
    },
    /// The caller asked to stop.
    #[error("interrupted")]
    Stopped,
}

impl Error {
    /// A problem and its remedy.
    pub fn refused(problem: impl Into<String>, fix: impl Into<String>) -> Self {
        cif_system::Error::refused(problem, fix).into()
    }

    /// A camera that stands still, and the remedy.
    pub(crate) fn stands_still(problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::StandsStill { problem: problem.into(), fix: fix.into() }
    }

    /// Turns an error of the system into one that names the file.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let named = cif_system::Error::io(action, path);
        move |source| named(source).into()
    }
}
