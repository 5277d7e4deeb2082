//! Sources of a capture: videos and folders of photographs, one per camera.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::Error;

/// Endings of videos, for folders that hold several.
const VIDEO_ENDINGS: [&str; 10] = ["mp4", "mov", "m4v", "mkv", "avi", "webm", "mts", "mpg", "mpeg", "wmv"];

/// Endings of images that can be read.
const IMAGE_ENDINGS: [&str; 3] = ["png", "jpg", "jpeg"];

/// Recording of one camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// Name of the camera: a folder of that name holds its images.
    pub camera: String,
    /// Video, or folder of photographs.
    pub path: PathBuf,
    /// Photographs in name order; `None` for a video.
    pub photographs: Option<Vec<PathBuf>>,
}

impl Source {
    /// Name of the video or folder, without those that it lies in.
    pub(crate) fn file_name(&self) -> String {
        self.path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_else(|| self.camera.clone())
    }
}

fn has_ending(path: &Path, endings: &[&str]) -> bool {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    ending.is_some_and(|ending| endings.contains(&ending.as_str()))
}

/// Files of a folder with these endings, in name order, without hidden ones.
fn files(folder: &Path, endings: &[&str]) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io("read", folder))? {
        let path = entry.map_err(Error::io("read", folder))?.path();
        let is_hidden = path.file_name().is_none_or(|name| name.to_string_lossy().starts_with('.'));
        if !is_hidden && path.is_file() && has_ending(&path, endings) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The cameras of inputs: a video or a folder, each also as `NAME=PATH`. A folder of photographs is one
/// camera, a folder of videos one camera per video, and a folder of folders of photographs one camera per
/// folder.
///
/// # Errors
/// When an input is missing or holds neither images nor videos, or two cameras have one name.
pub fn sources(inputs: &[String]) -> Result<Vec<Source>, Error> {
    let mut found = Vec::new();
    for input in inputs {
        // A path that exists wins over a name, so that `a=b.mp4` can be given.
        let (name, path) = match input.split_once('=') {
            Some((name, path)) if !Path::new(input).exists() => (Some(name.to_owned()), PathBuf::from(path)),
            _ => (None, PathBuf::from(input)),
        };
        found.extend(of_input(name, path)?);
    }
    let mut names = BTreeSet::new();
    for source in &found {
        cif_output::check_name(&source.camera).map_err(|problem| {
            Error::refused(
                format!(
                    "{}: its camera cannot be called {:?}: {problem}",
                    source.path.display(),
                    source.camera
                ),
                "name it, as in cam01=PATH",
            )
        })?;
        if source.camera.contains('/') || !names.insert(source.camera.clone()) {
            return Err(Error::refused(
                format!("{}: another camera is called {:?} too", source.path.display(), source.camera),
                "give every camera a name of its own, as in left=PATH right=PATH",
            ));
        }
    }
    Ok(found)
}

fn of_input(name: Option<String>, path: PathBuf) -> Result<Vec<Source>, Error> {
    let shown = path.display();
    if path.is_file() {
        if has_ending(&path, &IMAGE_ENDINGS) {
            return Err(Error::refused(
                format!("{shown}: one photograph is no capture"),
                "give the folder that holds the photographs",
            ));
        }
        let camera = name.unwrap_or_else(|| stem(&path));
        return Ok(vec![Source { camera, path, photographs: None }]);
    }
    if !path.is_dir() {
        return Err(Error::refused(
            format!("{shown}: there is no such file or folder"),
            "give a video or a folder of photographs",
        ));
    }
    let photographs = files(&path, &IMAGE_ENDINGS)?;
    if !photographs.is_empty() {
        let absolute = std::path::absolute(&path).map_err(Error::io("find", &path))?;
        let camera = name.unwrap_or_else(|| last_name(&absolute));
        return Ok(vec![Source { camera, path, photographs: Some(photographs) }]);
    }
    let prefix = name.map_or(String::new(), |name| name + "-");
    let videos = files(&path, &VIDEO_ENDINGS)?;
    if !videos.is_empty() {
        let source =
            |path: PathBuf| Source { camera: prefix.clone() + &stem(&path), path, photographs: None };
        return Ok(videos.into_iter().map(source).collect());
    }
    let mut folders = Vec::new();
    for entry in std::fs::read_dir(&path).map_err(Error::io("read", &path))? {
        folders.push(entry.map_err(Error::io("read", &path))?.path());
    }
    folders.sort();
    let mut found = Vec::new();
    for folder in folders.into_iter().filter(|folder| folder.is_dir()) {
        let photographs = files(&folder, &IMAGE_ENDINGS)?;
        if !photographs.is_empty() {
            found.push(Source {
                camera: prefix.clone() + &last_name(&folder),
                path: folder,
                photographs: Some(photographs),
            });
        }
    }
    if found.is_empty() {
        return Err(Error::refused(
            format!("{shown}: it holds neither photographs (png, jpg, jpeg) nor videos"),
            "give the folder that holds them; convert other formats first, as with ffmpeg or ImageMagick",
        ));
    }
    Ok(found)
}

fn stem(path: &Path) -> String {
    path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default()
}

fn last_name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_else(|| "camera".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(found: &[Source]) -> Vec<(&str, Option<usize>)> {
        found.iter().map(|s| (s.camera.as_str(), s.photographs.as_ref().map(Vec::len))).collect()
    }

    fn write(path: &Path) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }

    #[test]
    fn cameras_come_from_files_folders_and_names() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in
            ["walk.mp4", "photos/b.JPG", "photos/a.png", "photos/.c.png", "rig/l/1.png", "rig/r/1.png"]
        {
            write(&at(name));
        }
        for name in ["videos/one.MOV", "videos/two.mp4", "videos/notes.txt"] {
            write(&at(name));
        }
        let of = |inputs: &[String]| sources(inputs);
        let text = |name: &str| at(name).display().to_string();
        assert_eq!(names(&of(&[text("walk.mp4")]).unwrap()), [("walk", None)]);
        assert_eq!(names(&of(&[format!("left={}", text("photos"))]).unwrap()), [("left", Some(2))]);
        assert_eq!(names(&of(&[text("rig")]).unwrap()), [("l", Some(1)), ("r", Some(1))]);
        assert_eq!(names(&of(&[text("videos")]).unwrap()), [("one", None), ("two", None)]);
        let error = of(&[text("walk.mp4"), text("walk.mp4")]).unwrap_err().to_string();
        assert!(error.contains("another camera"), "{error}");
        for (input, expected) in [("none", "no such file"), ("photos/a.png", "one photograph")] {
            let error = of(&[text(input)]).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
        std::fs::create_dir(at("empty")).unwrap();
        assert!(of(&[text("empty")]).unwrap_err().to_string().contains("neither photographs"));
    }
}
