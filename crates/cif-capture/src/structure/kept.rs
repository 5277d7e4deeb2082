//! Features and matches that outlive a run, for the next one to go on from.

use std::path::{Path, PathBuf};

/// Names of databases, of their journals, and of those that are not whole.
const BEGINNINGS: [&str; 2] = ["features-", "matches-"];
const ENDINGS: [&str; 5] = [".db", ".db-journal", ".db-wal", ".db-shm", ".part"];

/// The folder for features and matches of a capture that is written to `place`: next to it, under its name.
#[must_use]
pub fn kept_beside(place: &Path) -> PathBuf {
    let mut name = place.as_os_str().to_owned();
    name.push("-features");
    PathBuf::from(name)
}

/// True where a folder has features or matches.
#[must_use]
pub fn has_kept(folder: &Path) -> bool {
    files(folder).next().is_some()
}

/// Removes features and matches, and their folder unless something else lies there.
pub fn remove_kept(folder: &Path) {
    // What cannot be removed is taken up by the next run, or removed by hand.
    for file in files(folder) {
        let _ = std::fs::remove_file(file);
    }
    let _ = std::fs::remove_dir(folder);
}

fn files(folder: &Path) -> impl Iterator<Item = PathBuf> {
    let is_own = |path: &PathBuf| {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        BEGINNINGS.iter().any(|beginning| name.starts_with(beginning))
            && ENDINGS.iter().any(|ending| name.ends_with(ending))
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    entries.filter_map(|entry| Some(entry.ok()?.path())).filter(is_own)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_was_kept_is_removed() {
        let base = tempfile::tempdir().unwrap();
        let folder = kept_beside(&base.path().join("table"));
        assert!(folder.ends_with("table-features") && !has_kept(&folder));
        std::fs::create_dir(&folder).unwrap();
        let write = |name: &str| std::fs::write(folder.join(name), "").unwrap();
        for name in
            ["features-4.2.1-480-0.db", "matches-a-b.db", "matches-a-c.part", "matches-a-b.db-journal"]
        {
            write(name);
        }
        assert!(has_kept(&folder));
        write("notes.txt");
        remove_kept(&folder);
        let left: Vec<_> =
            std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left, ["notes.txt"]);
        std::fs::remove_file(folder.join("notes.txt")).unwrap();
        remove_kept(&folder);
        assert!(!folder.exists());
    }
}
