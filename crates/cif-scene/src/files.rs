//! File-system checks that all formats share: the place of an output, and errors of reading and writing.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

pub use cif_output::folder_of;

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
    /// A link to another folder, where the files that the output names would not be found through the link.
    #[error(
        "{path} is a link to {target}; files that it names lie beside it and would not be found through the link: name \
         the target itself"
    )]
    LinkElsewhere {
        /// Output.
        path: PathBuf,
        /// Where the link leads.
        target: PathBuf,
    },
    /// Writing failed.
    #[error("{path} could not be written: {source}")]
    Write {
        /// Output.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// Reading failed.
    #[error("{path} cannot be read: {source}")]
    Read {
        /// Given path.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
}

/// The folder that a file is to be written into.
///
/// # Errors
/// When it does not exist.
pub fn existing_folder(path: &Path) -> Result<PathBuf, FileError> {
    let folder = folder_of(path);
    if folder.is_dir() { Ok(folder) } else { Err(FileError::NoFolder { folder, path: path.to_owned() }) }
}

/// The file that an output is written to: where links lead, which stay. `with_others`: the output names files that
/// are written beside it.
///
/// # Errors
/// When something that is no file is there, or a link leaves the folder of files that belong together.
pub fn target_of(path: &Path, with_others: bool) -> Result<PathBuf, FileError> {
    let target =
        cif_output::target(path).map_err(|source| FileError::Write { path: path.to_owned(), source })?;
    let folder = |path: &Path| folder_of(path).canonicalize().ok();
    if with_others && folder(&target) != folder(path) {
        return Err(FileError::LinkElsewhere { path: path.to_owned(), target });
    }
    Ok(target)
}

/// True when a file can be read and begins with these bytes: the mark by which a format knows its own files.
#[must_use]
pub fn begins_with(path: &Path, mark: &[u8]) -> bool {
    let mut head = Vec::new();
    let read = File::open(path).and_then(|file| file.take(mark.len() as u64).read_to_end(&mut head));
    read.is_ok() && head == mark
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_folders_are_reported() {
        assert_eq!(existing_folder(Path::new("a.glb")).unwrap(), Path::new("."));
        let error = existing_folder(Path::new("no such/place/a.glb")).unwrap_err().to_string();
        assert!(error.starts_with("no such/place: no such folder; create it first"), "{error}");
    }
}
