//! Errors of writing and reading PLY files.

use std::path::PathBuf;

use cif_scene::files::FileError;

/// Why a PLY file cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlyError {
    /// Reading or writing failed, as it can with any format.
    #[error(transparent)]
    File(#[from] FileError),
    /// Not a file name of PLY.
    #[error(
        "{path}: one file of splats ends in .ply; several files go into a folder (split by object, or a sequence)"
    )]
    Extension {
        /// Given path.
        path: PathBuf,
    },
    /// A folder is where a file is expected, or the reverse.
    #[error("{path} is {found}, but {wanted} is to be written there; choose another name")]
    InTheWay {
        /// Given path.
        path: PathBuf,
        /// The kind of entry that exists: a file or a folder.
        found: &'static str,
        /// The kind of entry that is to be written.
        wanted: &'static str,
    },
    /// Nothing can be seen at that time.
    #[error(
        "no object can be seen at time code {time_code}, so that {path} would be empty; choose another time"
    )]
    NothingVisible {
        /// Output.
        path: PathBuf,
        /// When.
        time_code: f64,
    },
    /// The file is no PLY of splats, or damaged.
    #[error("{path}: {what}")]
    Invalid {
        /// Given path.
        path: PathBuf,
        /// Problem and remedy.
        what: String,
    },
}
