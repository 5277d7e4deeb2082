//! Files of a source by their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::Error;
use crate::files::listing;

/// Files of a folder and its folders with one of these endings, by their path inside without ending, in order of names.
pub(super) fn files_below(folder: &Path, endings: &[&str]) -> Result<BTreeMap<String, PathBuf>, Error> {
    let mut found = BTreeMap::new();
    for path in listing::below(folder)?.into_iter().filter(|path| listing::has_extension(path, endings)) {
        let inside = path.strip_prefix(folder).unwrap_or(&path).with_extension("");
        let name = inside.to_string_lossy().replace('\\', "/");
        if let Some(other) = found.insert(name, path.clone()) {
            return Err(Error::invalid(
                &path,
                format!("{} has the same name; keep one of the two", other.display()),
            ));
        }
    }
    Ok(without_common_folder(found))
}

/// Names without the folders that all of them share, such as the name of the video.
pub(super) fn without_common_folder(mut files: BTreeMap<String, PathBuf>) -> BTreeMap<String, PathBuf> {
    loop {
        let Some(folder) =
            files.keys().next().and_then(|name| name.split_once('/')).map(|(first, _)| format!("{first}/"))
        else {
            return files;
        };
        // One level is kept, since it may name an object or a camera.
        let shared =
            files.keys().all(|name| name.strip_prefix(&folder).is_some_and(|rest| rest.contains('/')));
        if !shared {
            return files;
        }
        files = files.into_iter().map(|(name, path)| (name[folder.len()..].to_owned(), path)).collect();
    }
}
