//! Tables of times: which image was taken when.

use std::collections::BTreeMap;
use std::path::Path;

use crate::Error;
use crate::frames::Shot;

/// Reads a table of two columns, name and seconds, divided by commas, semicolons, tabs or spaces; a first line
/// without a number is a heading. Names may leave out folder and ending.
///
/// # Errors
/// When the file cannot be read, or a line does not hold a name and a number.
pub fn read(path: &Path) -> Result<BTreeMap<String, f64>, Error> {
    let text = cif_input::read_text(path).map_err(Error::io("read", path))?;
    let text = String::from_utf8_lossy(&text);
    let mut times = BTreeMap::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        // The last column is the time: names may have spaces.
        let parts = line.rsplit_once([',', ';', '\t']).or_else(|| line.rsplit_once(' '));
        let value =
            parts.and_then(|(_, time)| time.trim().parse().ok()).filter(|time: &f64| time.is_finite());
        match (parts, value) {
            (Some((name, _)), Some(time)) => {
                times.insert(name.trim().trim_matches('"').to_owned(), time);
            }
            _ if number == 0 => {}
            _ => {
                return Err(Error::refused(
                    format!("{}: line {}: {line:?} is no name and time", path.display(), number + 1),
                    "write one image per line: its name, a comma and its time in seconds",
                ));
            }
        }
    }
    Ok(times)
}

/// The entry of a table that belongs to an image: by full name, by name without ending or folder, or, where
/// one key alone fits, by its path without ending in some folder, then by name without both.
pub(crate) fn entry<'a, T>(table: &'a BTreeMap<String, T>, name: &str) -> Option<&'a T> {
    let file = file_of(name);
    let keys = [name, without_ending(name), file, without_ending(file)];
    // The table may have folders and endings that the capture lacks.
    let alone = |fits: &dyn Fn(&str) -> bool| {
        let mut found = table.iter().filter(|(key, _)| fits(key)).map(|(_, value)| value);
        found.next().filter(|_| found.next().is_none())
    };
    keys.iter()
        .find_map(|key| table.get(*key))
        .or_else(|| alone(&|key| is_below(without_ending(key), without_ending(name))))
        .or_else(|| alone(&|key| without_ending(file_of(key)) == without_ending(file)))
}

/// True where a path is another one, or that in some folder.
fn is_below(path: &str, other: &str) -> bool {
    path.strip_suffix(other).is_some_and(|folder| folder.is_empty() || folder.ends_with(['/', '\\']))
}

fn file_of(name: &str) -> &str {
    name.rsplit(['/', '\\']).next().unwrap_or(name)
}

fn without_ending(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, ending)) if !ending.contains('/') => stem,
        _ => name,
    }
}

/// Gives every image its time of a table.
///
/// # Errors
/// When an image is not in it.
pub fn apply(times: &BTreeMap<String, f64>, path: &Path, shots: &mut [Shot]) -> Result<(), Error> {
    for shot in shots {
        shot.time = Some(*entry(times, &shot.name).ok_or_else(|| {
            Error::refused(
                format!("{}: it has no time of {}", path.display(), shot.name),
                "give every image a time, or none",
            )
        })?);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_of_several_kinds_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("times.csv");
        std::fs::write(&path, "name,seconds\na.png,0.5\n\"my photo.jpg\", 1.25\n# no\n\nc 2\nd;3\n").unwrap();
        let times = read(&path).unwrap();
        assert_eq!(times.len(), 4);
        for (name, time) in [("a.png", 0.5), ("cam/a.png", 0.5), ("my photo.jpg", 1.25), ("c.jpg", 2.0)] {
            assert_eq!(entry(&times, name), Some(&time), "{name}");
        }
        assert_eq!(entry(&times, "a.jpg"), Some(&0.5), "another ending");
        assert_eq!(entry(&times, "e.png"), None);
        let rig = BTreeMap::from([("left/1.png".to_owned(), 1), ("right/1.png".to_owned(), 2)]);
        assert_eq!(entry(&rig, "1.png"), None, "two fit alike");
        assert_eq!((entry(&rig, "right/1.jpg"), entry(&rig, "right/1.png")), (Some(&2), Some(&2)));
        let rig = BTreeMap::from([("images/left/1.png".to_owned(), 1), ("images/right/1.png".to_owned(), 2)]);
        assert_eq!((entry(&rig, "left/1.jpg"), entry(&rig, "ft/1.jpg")), (Some(&1), None), "in a folder");
        std::fs::write(&path, "a.png,0.5\nb.png,soon\n").unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("line 2"), "{error}");
    }
}
