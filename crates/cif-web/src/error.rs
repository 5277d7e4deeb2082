//! Errors of writing pages.

use std::path::PathBuf;

use cif_scene::files::FileError;

/// Why a page cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WebError {
    /// Reading or writing failed, as it can with any format.
    #[error(transparent)]
    File(#[from] FileError),
    /// Pages are made to be looked at.
    #[error(
        "{path}: a page is made to be looked at and holds less than the scene; read the .usda, .glb or .cif that it was \
         made of"
    )]
    NotRead {
        /// Given path.
        path: PathBuf,
    },
}
