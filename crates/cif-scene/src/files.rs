//! What every format has to do with the file system: where a file goes, and why it cannot.

use std::io;
use std::path::{Path, PathBuf};

/// Why a file cannot be read or written, whatever its format.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FileError {
    /// The folder of the output is missing.
    #[error("{folder}: no such folder; create it first (for {path})")]
    NoFolder {
        /// Missing folder.
        folder: PathBuf,
        /// Output in it.
        path: PathBuf,
    },
    /// A file that cif did not write is in the way.
    #[error("{path} exists and was not written by cif; choose another name, or replace it with --force")]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// Writing failed.
    #[error("{path} could not be written: {source}")]
    Write {
        /// Output.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// Reading failed.
    #[error("{path} cannot be read: {source}")]
    Read {
        /// Given path.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
}

/// Folder of a file; `.` for a bare name.
#[must_use]
pub fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
        _ => PathBuf::from("."),
    }
}

/// The folder that a file is to be written into.
///
/// # Errors
/// When it does not exist.
pub fn existing_folder(path: &Path) -> Result<PathBuf, FileError> {
    let folder = folder_of(path);
    if folder.is_dir() { Ok(folder) } else { Err(FileError::NoFolder { folder, path: path.to_owned() }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bare_names_lie_here_and_missing_folders_are_told() {
        assert_eq!(folder_of(Path::new("a.glb")), Path::new("."));
        assert_eq!(folder_of(Path::new("b/a.glb")), Path::new("b"));
        assert_eq!(existing_folder(Path::new("a.glb")).unwrap(), Path::new("."));
        let error = existing_folder(Path::new("no such/place/a.glb")).unwrap_err().to_string();
        assert!(error.starts_with("no such/place: no such folder; create it first"), "{error}");
    }
}
