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

/// Files of a folder and the folders below it, in order of their paths, without hidden ones.
///
/// A link to a folder is followed unless it leads up, to a folder that it lies in, or lies itself in a folder that was
/// reached by a link: so no folder is walked more than once per link.
///
/// # Errors
/// When a folder cannot be read.
pub(crate) fn below(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut files = Vec::new();
    let mut folders = vec![(folder.to_owned(), false)];
    while let Some((current, linked)) = folders.pop() {
        for path in entries(&current)? {
            if !path.is_dir() {
                files.push(path);
            } else if !path.is_symlink() {
                folders.push((path, linked));
            } else if !linked && !leads_up(&path, &current) {
                folders.push((path, true));
            }
        }
    }
    files.sort();
    Ok(files)
}

/// True where a link leads to the folder that it lies in, or above.
fn leads_up(link: &Path, folder: &Path) -> bool {
    match (link.canonicalize(), folder.canonicalize()) {
        (Ok(to), Ok(folder)) => folder.starts_with(to),
        _ => true,
    }
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

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn walks_follow_links_but_no_loops() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        for name in ["a/0.png", "b/c/1.png", ".hidden/2.png"] {
            std::fs::create_dir_all(root.join(name).parent().unwrap()).unwrap();
            std::fs::write(root.join(name), "").unwrap();
        }
        // Up in one step or several, and round between two folders.
        for (to, link) in [
            (".", "self"),
            (".", "again"),
            ("../..", "b/c/up"),
            ("../b", "a/other"),
            ("../a", "b/other"),
            ("a", "d"),
        ] {
            symlink(to, root.join(link)).unwrap();
        }
        let found = below(root).unwrap();
        let names: Vec<_> =
            found.iter().map(|path| path.strip_prefix(root).unwrap().to_str().unwrap()).collect();
        assert_eq!(names, ["a/0.png", "a/other/c/1.png", "b/c/1.png", "b/other/0.png", "d/0.png"]);
    }
}
