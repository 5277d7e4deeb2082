//! Tables of times: which image was taken when.

use std::collections::BTreeMap;
use std::path::Path;

use crate::Error;
use crate::frames::Shot;

/// Reads a table of two columns, name and seconds, divided by commas, semicolons, tabs or spaces; a first line without
/// a number is a heading. Names may leave out folder and ending.
///
/// # Errors
/// When the file cannot be read, or a line does not hold a name and a number.
pub fn read(path: &Path) -> Result<BTreeMap<String, f64>, Error> {
    let text = cif_input::read(path).map_err(Error::io("read", path))?;
    let text = String::from_utf8_lossy(&text);
    let mut times = BTreeMap::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim().trim_start_matches('\u{feff}');
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        // The last column is the time: names may have spaces.
        let parts = line.rsplit_once([',', ';', '\t']).or_else(|| line.rsplit_once(' '));
        let value = parts.and_then(|(_, time)| time.trim().parse().ok()).filter(|time: &f64| time.is_finite());
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

/// The entry of a table that belongs to an image: by full name, by name without folder, or without ending.
pub(crate) fn entry<'a, T>(table: &'a BTreeMap<String, T>, name: &str) -> Option<&'a T> {
    let stem = |name: &'a str| name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let file = name.rsplit('/').next().unwrap_or(name);
    let without = |name: &str| name.rsplit_once('.').map_or(name.to_owned(), |(stem, _)| stem.to_owned());
    [name.to_owned(), without(name), file.to_owned(), without(file)]
        .iter()
        .find_map(|key| table.get(key))
        // The table may have the endings that the capture lacks, or others.
        .or_else(|| table.iter().find(|(key, _)| stem(key) == without(file)).map(|(_, value)| value))
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
        std::fs::write(&path, "a.png,0.5\nb.png,soon\n").unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("line 2"), "{error}");
    }
}
