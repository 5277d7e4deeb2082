//! Errors of writing and reading glTF files.

use std::path::PathBuf;

use cif_scene::files::FileError;

/// Why a glTF file cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GltfError {
    /// Reading or writing failed, as it can with any format.
    #[error(transparent)]
    File(#[from] FileError),
    /// Not a file name of glTF.
    #[error(
        "{path}: the ending decides the kind of file; use .glb (one file) or .gltf (text next to a .bin)"
    )]
    Extension {
        /// Given path.
        path: PathBuf,
    },
    /// A folder has the name of the file.
    #[error("{path} is a folder; give a file name")]
    IsFolder {
        /// The folder.
        path: PathBuf,
    },
    /// Motion that glTF cannot hold.
    #[error(
        "{node} moves splat by splat, which glTF holds of {most} splats at most; build the scene with parts or rigid as the most expensive motion",
        most = cif_scene::LOOSE_SPLATS
    )]
    Dense {
        /// Name of the node.
        node: String,
    },
    /// A graph that no file can hold.
    #[error("{node} cannot be written: {what}")]
    Inconsistent {
        /// Name of the node or camera.
        node: String,
        /// The problem.
        what: String,
    },
    /// More than a `.glb` can hold.
    #[error("{path} would have {bytes} bytes, but a .glb ends at 4 GiB; write a .gltf instead")]
    TooLarge {
        /// Output.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
    /// The file is no glTF, or damaged.
    #[error("{path} is not readable as glTF: {reason}")]
    Unreadable {
        /// Given path.
        path: PathBuf,
        /// Problem and remedy.
        reason: String,
    },
    /// An object of the file is wrong.
    #[error("{path}: {object}: {what}")]
    Invalid {
        /// Given path.
        path: PathBuf,
        /// Node, mesh or accessor, with its index.
        object: String,
        /// Problem and remedy.
        what: String,
    },
    /// An extension that must be understood and is not.
    #[error("{path} cannot be read without the extension {extension}{note}; {fix}")]
    UnknownExtension {
        /// Given path.
        path: PathBuf,
        /// Its name.
        extension: String,
        /// Purpose of the extension in parentheses; empty where it is not known.
        note: String,
        /// Remedy.
        fix: String,
    },
    /// Nothing to read.
    #[error(
        "{path} holds no Gaussian splats ({found}); a mesh primitive with KHR_gaussian_splatting is expected"
    )]
    NoSplats {
        /// Given path.
        path: PathBuf,
        /// Contents that were found instead.
        found: String,
    },
}
