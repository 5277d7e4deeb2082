//! Sorted folder listings.

use std::path::{Path, PathBuf};

use crate::Error;

/// Entries of a folder in name order, without hidden ones.
///
/// # Errors
/// When the folder cannot be read.
pub(crate) fn entries(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::read(folder))? {
        let entry = entry.map_err(Error::read(folder))?;
        if !entry.file_name().to_string_lossy().starts_with('.') {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// Image files (png, jpg, jpeg) of a folder in name order; empty when there is no such folder.
///
/// # Errors
/// When the folder cannot be read.
pub(crate) fn images(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    Ok(entries(folder)?.into_iter().filter(|path| is_image(path)).collect())
}

/// Number of image files below a folder, two levels deep (for "not listed" warnings).
///
/// # Errors
/// When a folder cannot be read.
pub(crate) fn count_images_below(folder: &Path) -> Result<usize, Error> {
    let mut count = images(folder)?.len();
    if folder.is_dir() {
        for entry in entries(folder)? {
            if entry.is_dir() {
                count += images(&entry)?.len();
            }
        }
    }
    Ok(count)
}

/// True where a file is there, if only one that its reader will refuse, such as a named pipe.
pub(crate) fn is_there(path: &Path) -> bool {
    path.exists() && !path.is_dir()
}

/// True when the extension is one of an image that can be read.
pub(crate) fn is_image(path: &Path) -> bool {
    has_extension(path, &["png", "jpg", "jpeg"])
}

/// True when the extension is one of these, in any case.
pub(crate) fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension()
        .and_then(|extension| extension.to_str())
        .is_some_and(|extension| extensions.iter().any(|known| extension.eq_ignore_ascii_case(known)))
}

/// File name without extension, as text.
pub(crate) fn stem(path: &Path) -> String {
    path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default()
}

/// The image at `path`, or with an extension added where the capture leaves it out.
pub(crate) fn with_image_extension(path: &Path) -> Option<PathBuf> {
    if is_image(path) && is_there(path) {
        return Some(path.to_owned());
    }
    ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"]
        .iter()
        .map(|extension| {
            let mut name = path.as_os_str().to_owned();
            name.push(".");
            name.push(extension);
            PathBuf::from(name)
        })
        .find(|candidate| is_there(candidate))
}
