//! Names of frames and views, which become parts of paths.

use std::io;
use std::path::{Component, Path, PathBuf};

/// Checks that `name`, parts separated by `/`, stays inside any folder that it is joined to.
///
/// # Errors
/// The problem, as the predicate of a sentence: `is an absolute path`.
pub fn check_name(name: &str) -> Result<(), &'static str> {
    if name.is_empty() {
        return Err("is empty");
    }
    if name.chars().any(char::is_control) {
        return Err("holds control characters");
    }
    if name.starts_with(['/', '\\']) || Path::new(name).is_absolute() {
        return Err("is an absolute path");
    }
    // Scenes and captures travel between systems: a backslash separates folders on some of them.
    for part in name.split(['/', '\\']) {
        match part {
            "" => return Err("has an empty part"),
            "." | ".." => return Err("has . or .. as a part"),
            _ => {}
        }
    }
    if Path::new(name).components().any(|part| !matches!(part, Component::Normal(_))) {
        return Err("is no relative path");
    }
    Ok(())
}

/// The path of the output `name` with an extension in `folder`.
///
/// # Errors
/// As [`check_name`].
pub fn inside(folder: &Path, name: &str, extension: &str) -> io::Result<PathBuf> {
    check_name(name).map_err(|problem| {
        io::Error::new(io::ErrorKind::InvalidInput, format!("the name {name:?} {problem}"))
    })?;
    Ok(folder.join(format!("{name}.{extension}")))
}

/// Checks the name of a taxonomy of labels: it becomes part of names of properties in USD, and must not be one of those
/// that scenes write for every object.
///
/// # Errors
/// The problem and its remedy, as the predicate of a sentence.
pub fn check_taxonomy(name: &str) -> Result<(), &'static str> {
    let mut letters = name.chars();
    let first = letters.next().is_some_and(|letter| letter.is_ascii_alphabetic() || letter == '_');
    if !first || !letters.all(|letter| letter.is_ascii_alphanumeric() || letter == '_') {
        return Err(
            "is no name in USD; use letters, digits and _, not beginning with a digit: wikidata_qcode",
        );
    }
    if matches!(name, "class" | "instance") {
        return Err("is taken: class holds category and label, instance the unique name; use another one");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn taxonomies_are_identifiers_that_are_free() {
        for name in ["wikidata_qcode", "coco", "_a1", "ADE20K"] {
            assert_eq!(check_taxonomy(name), Ok(()), "{name}");
        }
        for name in ["", "1a", "wikidata-qcode", "a:b", "a b", "ü", "class", "instance"] {
            assert!(check_taxonomy(name).is_err(), "{name:?}");
        }
    }

    #[test]
    fn names_stay_in_their_folder() {
        let folder = Path::new("out");
        for name in ["000012", "cam03/0007", "a.b", "..a", "a b", "Küche/1"] {
            assert_eq!(inside(folder, name, "png").unwrap(), Path::new(&format!("out/{name}.png")));
        }
        for name in
            ["", "/etc/x", "../x", "a/../../x", "..", ".", "a//b", "a/", "\\x", "a\\..\\..\\x", "a\n", "\0"]
        {
            let error = inside(folder, name, "png").unwrap_err().to_string();
            assert!(error.contains("the name"), "{name:?}: {error}");
        }
        #[cfg(windows)]
        assert!(check_name("C:x").is_err());
    }
}
