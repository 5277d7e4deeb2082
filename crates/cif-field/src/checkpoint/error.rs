//! Why a `.cif` file could not be read or written.

use std::io;
use std::path::PathBuf;

use crate::FieldError;

/// Failure to read or write a `.cif` file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The file is missing or may not be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file does not begin as a safetensors file.
    #[error("{} is not a cif scene (not a safetensors file): give a .cif file that cif wrote", path.display())]
    NotSafetensors {
        /// The file.
        path: PathBuf,
    },
    /// A safetensors file of other software.
    #[error(
        "{} is not a cif scene: it is a safetensors file without `cif.format`; give a .cif file that cif wrote",
        path.display()
    )]
    NotAScene {
        /// The file.
        path: PathBuf,
    },
    /// The file ends early, e.g. after an interrupted copy.
    #[error("{} is cut short: {found} of {expected} bytes; copy it again", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Bytes that the header announces.
        expected: u64,
        /// Bytes there are.
        found: u64,
    },
    /// There are bytes after the last tensor.
    #[error("{} is damaged: {found} bytes where its header announces {expected}; copy it again", path.display())]
    TrailingBytes {
        /// The file.
        path: PathBuf,
        /// Bytes that the header announces.
        expected: u64,
        /// Bytes there are.
        found: u64,
    },
    /// A later cif wrote the file in a layout that this one does not know.
    #[error(
        "{} has format {found}, written by cif {writer}; this is cif {}, which reads formats up to {}: use cif \
         {writer} or later",
        path.display(),
        env!("CARGO_PKG_VERSION"),
        super::FORMAT
    )]
    NewerFormat {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u64,
        /// Version of the cif that wrote it.
        writer: String,
    },
    /// The header is not what cif writes.
    #[error("{} is damaged: {problem}; copy it again, or train again", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// The problem.
        problem: String,
    },
    /// A tensor is missing, of the wrong type or shape, or not known.
    #[error("{} is damaged: tensor `{tensor}` {problem}; copy it again, or train again", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The problem, as the predicate of the message.
        problem: String,
    },
    /// The file's values break a rule of [`crate::Field`].
    #[error("{} holds a broken scene: {source}", path.display())]
    InvalidField {
        /// The file.
        path: PathBuf,
        /// The broken rule.
        source: FieldError,
    },
    /// The scene to be saved breaks a rule of [`crate::Field`]; nothing was written.
    #[error("the scene was not saved as {}, because it could not be read back: {source}", path.display())]
    Unsaveable {
        /// The file that was to be written.
        path: PathBuf,
        /// The broken rule.
        source: FieldError,
    },
    /// The file could not be written; an older file of that name is unchanged.
    #[error("cannot save {}: {problem}", path.display())]
    Write {
        /// The file that was to be written.
        path: PathBuf,
        /// Problem and remedy.
        problem: String,
        /// Error of the operating system, where there is one.
        source: Option<io::Error>,
    },
}

impl CheckpointError {
    /// A write failure in words: which folder, and what to do.
    pub(super) fn writing(path: &std::path::Path, source: io::Error) -> Self {
        let folder = cif_output::folder_of(path);
        let folder = folder.display();
        let problem = match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge => {
                format!("no space for it in {folder} ({source}); free some, or save elsewhere")
            }
            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
                format!("{folder} may not be written ({source}); save elsewhere, or change its permissions")
            }
            io::ErrorKind::NotFound => format!("the folder {folder} does not exist; create it first"),
            io::ErrorKind::NotADirectory => format!("{folder} is not a folder"),
            _ => source.to_string(),
        };
        Self::Write { path: path.to_owned(), problem, source: Some(source) }
    }
}
