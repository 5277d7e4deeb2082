//! Names of outputs: an ending that belongs to another kind of file is refused where the arguments are read, with the
//! name or the command that does what was meant.

use std::path::{Path, PathBuf};

use clap::builder::{PathBufValueParser, TypedValueParser};

use crate::formats::FORMATS;

/// Endings of films, which ffmpeg makes of the pictures of `cif render`.
const FILMS: [&str; 6] = ["mp4", "mov", "mkv", "webm", "avi", "gif"];

/// Endings of files that are no folders, other than those of films and of scenes.
const FILES: [&str; 13] =
    ["png", "jpg", "jpeg", "exr", "json", "jsonl", "csv", "html", "md", "toml", "npz", "zip", "svg"];

/// A trained scene, `.cif`.
pub(crate) fn scene() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| check_scene(&path).map(|()| path))
}

/// The report of a command, `.json` or a stream.
pub(crate) fn report() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| {
        if crate::report::is_file(path.as_os_str(), "json") {
            return Ok(path);
        }
        let better = path.with_extension("json");
        Err(format!("a JSON document is written there; end its name in .json: {}", better.display()))
    })
}

/// A log of JSON lines, `.jsonl`, or any text that is no output of another kind.
pub(crate) fn log() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| {
        let kind = ending(&path);
        let belongs_elsewhere =
            kind == "cif" || kind == "json" || is_exchanged(&path) || is_of(&kind, &FILMS);
        if !belongs_elsewhere {
            return Ok(path);
        }
        let better = path.with_extension("jsonl");
        Err(format!(
            "lines of JSON are written there, one per event; end its name in .jsonl: {}",
            better.display()
        ))
    })
}

/// A folder: any name but that of a file.
pub(crate) fn folder() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| check_folder(&path).map(|()| path))
}

/// A folder, or a film.
pub(crate) fn folder_or_film() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new()
        .try_map(|path| if is_film(&path) { Ok(path) } else { check_folder(&path).map(|()| path) })
}

/// True where the name is that of a film, and no folder has it.
pub(crate) fn is_film(path: &Path) -> bool {
    is_of(&ending(path), &FILMS) && !path.is_dir()
}

/// A file of an exchange format, or a trained scene.
pub(crate) fn exchanged_or_scene() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| {
        if FORMATS.iter().any(|format| format.writes(&path)) || ending(&path) == "cif" {
            return Ok(path);
        }
        let endings: Vec<String> = FORMATS
            .iter()
            .flat_map(|format| format.about().endings.iter().filter(|ending| ending.written))
            .map(|ending| format!(".{}", ending.name))
            .collect();
        Err(format!("the ending decides the format: {}", endings.join(", ")))
    })
}

fn check_scene(path: &Path) -> Result<(), String> {
    let kind = ending(path);
    if kind == "cif" {
        return Ok(());
    }
    let better = if path.is_dir() { path.join("scene.cif") } else { path.with_extension("cif") };
    let better = better.display();
    let then = match FORMATS.iter().find(|format| format.writes(path)) {
        Some(format) => {
            format!(", then `cif export {better} {}` makes the {} file", path.display(), format.about().name)
        }
        None => String::new(),
    };
    Err(format!("a scene is written there; end its name in .cif: {better}{then}"))
}

fn check_folder(path: &Path) -> Result<(), String> {
    let kind = ending(path);
    let is_file = kind == "cif" || is_exchanged(path) || is_of(&kind, &FILMS) || is_of(&kind, &FILES);
    if !is_file || path.is_dir() {
        return Ok(());
    }
    let better = path.with_extension("");
    let better = better.display();
    Err(format!("a folder of files is written there; give it a name without .{kind}: {better}"))
}

/// The ending of a name, in lower case without the dot.
pub(crate) fn ending(path: &Path) -> String {
    path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default()
}

fn is_of(kind: &str, kinds: &[&str]) -> bool {
    kinds.contains(&kind)
}

fn is_exchanged(path: &Path) -> bool {
    FORMATS.iter().any(|format| format.recognises(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_end_in_cif() {
        assert!(check_scene(Path::new("a/table.CIF")).is_ok());
        let error = check_scene(Path::new("x.ply")).unwrap_err();
        assert!(error.contains("cif export x.cif x.ply") && error.contains("PLY"), "{error}");
        let error = check_scene(Path::new("table")).unwrap_err();
        assert!(error.ends_with("end its name in .cif: table.cif"), "{error}");
    }

    #[test]
    fn folders_have_no_name_of_a_file_unless_they_are_there() {
        for name in ["out", "captures/table.v2", "a.b", ".hidden", "../x"] {
            assert!(check_folder(Path::new(name)).is_ok(), "{name}");
        }
        for name in ["out.cif", "out.usda", "out.PNG", "report.html", "masks.json"] {
            assert!(check_folder(Path::new(name)).is_err(), "{name}");
        }
        let error = check_folder(Path::new("films/out.mp4")).unwrap_err();
        assert!(error.ends_with("without .mp4: films/out"), "{error}");
        assert!(is_film(Path::new("films/out.MP4")) && !is_film(Path::new("films")));
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("odd.png");
        std::fs::create_dir(&place).unwrap();
        assert!(check_folder(&place).is_ok());
    }
}
