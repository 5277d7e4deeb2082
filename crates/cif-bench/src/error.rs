//! Errors of measurements.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Why something cannot be measured or reported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// Action that failed, as in `read` or `write`.
        action: &'static str,
        /// To which file or folder.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Anything else; the message carries its own advice.
    #[error("{0}")]
    Failed(String),
}

impl Error {
    pub(crate) fn plain(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }

    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// Writes a file whole or not at all.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    cif_output::write(path, bytes).map_err(Error::io("write", path))
}
