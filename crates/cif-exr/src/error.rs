//! Errors of writing an EXR frame.

use std::path::PathBuf;

/// A frame could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExrError {
    /// The file system refused.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The encoder refused.
    #[error("{}: the frame cannot be encoded: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// Message of the encoder.
        reason: String,
    },
    /// Two objects would have the same id in the Cryptomatte.
    #[error(
        "the names '{first}' and '{second}' have the same Cryptomatte id; rename one of the two with cif label"
    )]
    SameId {
        /// One object.
        first: String,
        /// The other.
        second: String,
    },
}
