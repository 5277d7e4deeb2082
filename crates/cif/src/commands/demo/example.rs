//! The example inside of the command, a capture and a scene that was trained on it, and how it gets into a folder.

use std::fs;
use std::path::{Path, PathBuf};

use cif_output::Removed;

use crate::commands::shared::command_line;
use crate::error::Error;
use crate::lock::Lock;
use crate::output;

/// Name of the folder of the capture.
pub(super) const NAME: &str = "tabletop-mini";

/// Name that the folder has until all files are in it.
const UNFINISHED: &str = ".tabletop-mini.new";

/// Names below the folder, with `/`, and contents of all files: of `examples/tabletop-mini` at the time of the build,
/// none where that was not there.
const FILES: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/capture.rs"));

/// `examples/tabletop-mini.cif` at the time of the build, where it was there.
const SCENE: Option<&[u8]> = include!(concat!(env!("OUT_DIR"), "/scene.rs"));

/// Puts the capture into a folder, which is made where it is missing, and returns its place. A capture that is there
/// already has to be the same; files that were added to it stay.
///
/// # Errors
/// When this build has no example, the folder holds something else, a file of the capture is another, or the file system
/// refuses.
pub(super) fn put_into(folder: &Path) -> Result<PathBuf, Error> {
    put_files_into(FILES, folder)
}

/// Puts the trained scene next to the capture, unless it is there.
///
/// # Errors
/// When this build has none, another file has its place, or the file system refuses.
pub(super) fn put_scene_into(folder: &Path) -> Result<PathBuf, Error> {
    let Some(bytes) = SCENE else {
        return Err(Error::failed(
            "this build of cif has no trained scene: examples/tabletop-mini.cif was not there when it was built",
            "train one: leave out --trained",
        ));
    };
    let scene = folder.join(NAME).with_extension("cif");
    if !scene.exists() {
        output::write_file(&scene, bytes)?;
    } else if !is_same(&scene, bytes) {
        return Err(Error::failed(
            format!("{} is not the scene of the example", scene.display()),
            "it is kept; remove or rename it, or name another folder: cif demo -o DIR",
        ));
    }
    Ok(scene)
}

fn put_files_into(files: &[(&str, &[u8])], folder: &Path) -> Result<PathBuf, Error> {
    let capture = folder.join(NAME);
    if files.is_empty() {
        return Err(Error::failed(
            "this build of cif has no example: the folder examples/tabletop-mini was not there when it was built",
            format!(
                "install a wheel, pip install cif4d, or build in the repository; a capture of yours: {}",
                command_line(&["train", "CAPTURE", "-o", "scene.cif", "--preset", "draft"])
            ),
        ));
    }
    if folder.exists() && !folder.is_dir() {
        return Err(Error::failed(
            format!("{} is a file; the demo needs a folder", folder.display()),
            "choose another name with -o",
        ));
    }
    output::check_new_folder(&folder.join(NAME))?;
    fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
    // Two demos in one folder do not meet half a capture.
    let _lock = Lock::wait(&capture)?;
    if capture.exists() {
        check(files, &capture)?;
    } else {
        refuse_strangers(folder)?;
        unpack(files, &capture)?;
    }
    Ok(capture)
}

/// Refuses a folder that holds anything but what a demo that was killed may leave.
fn refuse_strangers(folder: &Path) -> Result<(), Error> {
    let ours = [UNFINISHED.to_owned(), format!(".{NAME}.lock")];
    for entry in fs::read_dir(folder).map_err(Error::io("read the folder", folder))? {
        let name = entry.map_err(Error::io("read the folder", folder))?.file_name();
        if !ours.iter().any(|known| name == known.as_str()) {
            return Err(Error::failed(
                format!(
                    "{} holds other files already, such as {}",
                    folder.display(),
                    Path::new(&name).display()
                ),
                "name a new folder: cif demo -o DIR",
            ));
        }
    }
    Ok(())
}

/// Writes all files, into a folder that gets its name when it is whole.
fn unpack(files: &[(&str, &[u8])], capture: &Path) -> Result<(), Error> {
    let unfinished = Removed::new(capture.with_file_name(UNFINISHED));
    if unfinished.path().exists() {
        fs::remove_dir_all(unfinished.path()).map_err(Error::io("remove", unfinished.path()))?;
    }
    for (name, bytes) in files {
        let path = unfinished.path().join(name);
        let parent = cif_output::folder_of(&path);
        fs::create_dir_all(&parent).map_err(Error::io("create the folder", &parent))?;
        fs::write(&path, bytes).map_err(Error::io("write", &path))?;
    }
    fs::rename(unfinished.path(), capture).map_err(Error::io("make", capture))
}

/// Checks that a capture has all files as they are here.
fn check(files: &[(&str, &[u8])], capture: &Path) -> Result<(), Error> {
    match files.iter().find(|(name, bytes)| !is_same(&capture.join(name), bytes)) {
        None => Ok(()),
        Some((name, _)) => Err(Error::failed(
            format!("{} is not the file of the example", capture.join(name).display()),
            format!(
                "it is kept; remove {} to have the capture made again, or name another folder: cif demo -o DIR",
                capture.display()
            ),
        )),
    }
}

/// True where a file has these contents.
fn is_same(path: &Path, bytes: &[u8]) -> bool {
    cif_input::read(path).is_ok_and(|found| found == bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FEW: &[(&str, &[u8])] = &[("camera/0.json", b"{}"), ("dataset.json", b"[]")];

    #[test]
    fn a_capture_is_there_whole_or_not_at_all() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("a/demo");
        // As a killed one leaves it.
        fs::create_dir_all(folder.join(UNFINISHED).join("camera")).unwrap();
        fs::write(folder.join(UNFINISHED).join("old.json"), "old").unwrap();
        let capture = put_files_into(FEW, &folder).unwrap();
        let names = |folder: &Path| {
            let mut names: Vec<_> =
                fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
            names.sort();
            names
        };
        assert_eq!(names(&folder), [NAME]);
        assert_eq!(names(&capture), ["camera", "dataset.json"]);
        assert_eq!(fs::read(capture.join("camera/0.json")).unwrap(), b"{}");
        // What is added stays, what differs is named.
        fs::write(capture.join("mine.txt"), "mine").unwrap();
        put_files_into(FEW, &folder).unwrap();
        assert!(capture.join("mine.txt").exists());
        fs::write(capture.join("dataset.json"), "[1]").unwrap();
        let error = put_files_into(FEW, &folder).unwrap_err();
        assert!(error.to_string().contains("dataset.json is not the file of the example"), "{error}");
        assert_eq!(fs::read(capture.join("dataset.json")).unwrap(), b"[1]");
    }

    #[test]
    fn folders_of_others_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("thesis.tex"), "x").unwrap();
        let error = put_files_into(FEW, folder.path()).unwrap_err();
        assert!(error.to_string().contains("thesis.tex"), "{error}");
        let error = put_files_into(FEW, &folder.path().join("thesis.tex")).unwrap_err();
        assert!(error.to_string().contains("is a file"), "{error}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_build_without_the_example_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let error = put_files_into(&[], &folder.path().join("demo")).unwrap_err();
        assert!(error.with_help().contains("no example") && error.with_help().contains("cif4d"), "{error}");
        assert!(!folder.path().join("demo").exists());
    }
}
