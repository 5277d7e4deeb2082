//! Output files and folders: checked before the work starts, written whole or not at all.

use std::fs;
use std::io::Write;
use std::path::Path;

use cif_scene::files::folder_of;
use tempfile::NamedTempFile;

use crate::error::Error;

/// Checks that `path` can be written and that nothing there would be lost.
///
/// # Errors
/// When the folder is missing or refuses files, when `path` is a folder, or exists without `overwrite`.
pub fn check_file(path: &Path, overwrite: bool) -> Result<(), Error> {
    if path.is_dir() {
        return Err(Error::failed(
            format!("{} is a folder; a file is to be written there", path.display()),
            format!("name a file, for example {}", path.join("scene.cif").display()),
        ));
    }
    if path.exists() && !overwrite {
        return Err(Error::failed(
            format!("{} exists and is not overwritten", path.display()),
            "give --force to replace it, or choose another name",
        ));
    }
    let folder = folder_of(path);
    if !folder.is_dir() {
        return Err(Error::failed(
            format!("the folder {} for {} does not exist", folder.display(), path.display()),
            format!("create it first: mkdir -p {}", folder.display()),
        ));
    }
    probe(&folder)
}

/// Creates `path` as a folder to write into; one that holds files already needs `overwrite`.
///
/// # Errors
/// When it cannot be created or written, or holds files and `overwrite` is off.
pub fn check_folder(path: &Path, overwrite: bool) -> Result<(), Error> {
    if path.exists() && !path.is_dir() {
        return Err(Error::failed(
            format!("{} is a file; a folder is to be written there", path.display()),
            "choose another name with -o",
        ));
    }
    fs::create_dir_all(path).map_err(Error::io("create the folder", path))?;
    let mut entries = fs::read_dir(path).map_err(Error::io("read the folder", path))?;
    if entries.next().is_some() && !overwrite {
        return Err(Error::failed(
            format!("the folder {} is not empty; files in it could be overwritten", path.display()),
            "give --force to write into it all the same, or choose another folder",
        ));
    }
    probe(path)
}

/// Writes a whole file through a temporary one in the same folder, so that a failure leaves the old one.
///
/// # Errors
/// When the file system refuses, for example because the disk is full.
pub fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let mut file = temporary(&folder_of(path)).map_err(Error::io("write to the folder of", path))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(Error::io("write", path))?;
    file.persist(path).map_err(|error| Error::io("replace", path)(error.error))?;
    Ok(())
}

fn probe(folder: &Path) -> Result<(), Error> {
    temporary(folder).map(drop).map_err(|source| Error::Failed {
        message: format!("cannot write to the folder {}: {source}", folder.display()),
        help: Some("check its permissions and the free space, or choose another folder".to_owned()),
    })
}

fn temporary(folder: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".cif-");
    // Temporary files are private by default; the result should have the usual permissions.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn existing_files_need_force() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cif");
        check_file(&path, false).unwrap();
        write_file(&path, b"one").unwrap();
        assert!(check_file(&path, false).unwrap_err().to_string().contains("a.cif exists"));
        check_file(&path, true).unwrap();
        write_file(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
    }

    #[test]
    fn missing_folders_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let error = check_file(&folder.path().join("no/where.cif"), true).unwrap_err();
        assert!(error.to_string().contains("does not exist"), "{error}");
    }

    #[test]
    fn folders_with_files_need_force() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("pictures");
        check_folder(&target, false).unwrap();
        fs::write(target.join("x"), "x").unwrap();
        assert!(check_folder(&target, false).is_err());
        check_folder(&target, true).unwrap();
        assert!(check_folder(&target.join("x"), true).unwrap_err().to_string().contains("is a file"));
    }
}
