//! Which tool a file or folder of masks comes from.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::Value;

use super::files_below::files_below;
use super::frames::FrameNames;
use super::{arrays, files, mattes, tracker};
use crate::Error;
use crate::files::{json, listing};

/// Sources of masks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceKind {
    /// A picture per frame, whose values or colours are objects: DEVA and other trackers.
    Tracker,
    /// `FRAME/OBJECT.png`: a picture per object, as SAM 2 and matte renders are stored.
    FrameFolders,
    /// `OBJECT/FRAME.png`, or `OBJECT.FRAME.exr` in one folder.
    ObjectFolders,
    /// An EXR file per frame with a channel per object, as Nuke writes mattes.
    Mattes,
    /// NumPy arrays of ids.
    Arrays,
    /// COCO JSON.
    Coco,
    /// JSON of YouTube-VIS: videos, and objects with a mask per frame.
    YoutubeVis,
    /// JSON export of Label Studio.
    LabelStudio,
    /// XML 1.1 of CVAT, for images or video.
    Cvat,
}

impl SourceKind {
    /// The kind in words.
    #[must_use]
    pub fn described(self) -> &'static str {
        match self {
            Self::Tracker => "a tracker, a picture per frame",
            Self::FrameFolders => "single objects, FRAME/OBJECT",
            Self::ObjectFolders => "single objects, OBJECT/FRAME",
            Self::Mattes => "EXR mattes, a channel per object",
            Self::Arrays => "NumPy arrays of ids",
            Self::Coco => "COCO JSON",
            Self::YoutubeVis => "YouTube-VIS JSON",
            Self::LabelStudio => "a Label Studio export",
            Self::Cvat => "a CVAT export",
        }
    }
}

/// The kind of a source by what it holds.
///
/// # Errors
/// When nothing fits, several kinds do, or it is a Cryptomatte, which needs no import.
pub(super) fn recognise(source: &Path, frames: &FrameNames) -> Result<SourceKind, Error> {
    if source.is_dir() { of_folder(source, frames) } else { of_file(source) }
}

fn of_file(source: &Path) -> Result<SourceKind, Error> {
    let is = |endings: &[&str]| listing::has_extension(source, endings);
    if is(&["json"]) {
        return of_json(source);
    }
    if is(&["xml"]) {
        return Ok(SourceKind::Cvat);
    }
    if is(&arrays::ENDINGS) {
        return Ok(SourceKind::Arrays);
    }
    let fix = if is(&["zip"]) {
        "unpack it and give what was in it"
    } else if is(&files::ENDINGS) {
        "give the folder of the pictures"
    } else {
        "give a folder of PNG, EXR or NumPy files, a JSON file of COCO, YouTube-VIS or Label Studio, or an XML file of CVAT"
    };
    Err(Error::invalid(source, format!("not known as masks; {fix}")))
}

fn of_json(source: &Path) -> Result<SourceKind, Error> {
    let value: Value = json::read(source)?;
    let has = |value: &Value, key: &str| value.get(key).is_some_and(Value::is_array);
    if has(&value, "images") && has(&value, "annotations") {
        return Ok(SourceKind::Coco);
    }
    if has(&value, "videos") && has(&value, "annotations") {
        return Ok(SourceKind::YoutubeVis);
    }
    if value.as_array().is_some_and(|tasks| tasks.iter().any(|task| has(task, "annotations"))) {
        return Ok(SourceKind::LabelStudio);
    }
    if has(&value, "shapes") && value.get("imagePath").is_some() {
        return Err(Error::invalid(
            source,
            "LabelMe's file of one picture; convert all of them to one COCO file, as labelme2coco and X-AnyLabeling's export do",
        ));
    }
    Err(Error::invalid(
        source,
        "neither COCO (an object with images and annotations), YouTube-VIS (with videos and annotations), nor a JSON export \
         of Label Studio (a list of tasks with annotations); export it in one of these",
    ))
}

fn of_folder(source: &Path, frames: &FrameNames) -> Result<SourceKind, Error> {
    if source.join("Annotations").is_dir() || source.join("pred.json").is_file() {
        return Ok(SourceKind::Tracker);
    }
    let invalid = |problem: String| Error::invalid(source, problem);
    let mut found = Vec::new();
    for (kind, endings) in [
        (SourceKind::Arrays, &arrays::ENDINGS[..]),
        (SourceKind::Mattes, &["exr"]),
        (SourceKind::Tracker, &["png"]),
    ] {
        let files = files_below(source, endings)?;
        if !files.is_empty() {
            found.push((kind, files));
        }
    }
    let (kind, pictures) = match (found.pop(), found.pop()) {
        (Some(one), None) => one,
        (Some(_), Some(_)) => {
            return Err(invalid("it holds several kinds of masks; say which with --from".to_owned()));
        }
        (None, _) => return of_only_text(source),
    };
    if kind == SourceKind::Arrays {
        return Ok(kind);
    }
    if kind == SourceKind::Mattes
        && let Some(first) = pictures.values().next()
        && mattes::is_cryptomatte(first)?
    {
        return Err(Error::invalid(
            first,
            format!(
                "this is a Cryptomatte, which needs no import: read it with --masks {}",
                source.display()
            ),
        ));
    }
    // A picture per frame where whole names are different frames; else two halves of a name are frame and object.
    let whole: BTreeSet<usize> = pictures.keys().filter_map(|name| frames.whole(name)).collect();
    if whole.len() == pictures.len() {
        return Ok(kind);
    }
    let names: Vec<&String> = pictures.keys().collect();
    let single = names.iter().all(|name| !name.contains('/'));
    let plain = |name: &&String| name.bytes().all(|byte| byte.is_ascii_digit());
    if !whole.is_empty() && single || names.iter().all(plain) {
        return Ok(kind);
    }
    match files::order_of(&names, frames).map_err(invalid)? {
        // A name that all pictures begin with is that of the video, where values may distinguish objects; so is a folder of
        // theirs, and a word behind all frames, where they do.
        Some(order)
            if kind == SourceKind::Tracker
                && files::one_object(&names, order)
                && (single && order == files::Order::ObjectThenFrame
                    || tracker::has_several(pictures.values())?) =>
        {
            Ok(kind)
        }
        Some(files::Order::FrameThenObject) => Ok(SourceKind::FrameFolders),
        Some(files::Order::ObjectThenFrame) => Ok(SourceKind::ObjectFolders),
        None => Ok(kind),
    }
}

/// A folder with nothing but annotations in a file.
fn of_only_text(source: &Path) -> Result<SourceKind, Error> {
    let texts: Vec<_> = listing::entries(source)?
        .into_iter()
        .filter(|path| listing::has_extension(path, &["json", "xml"]))
        .collect();
    Err(Error::invalid(
        source,
        match texts.as_slice() {
            [] => {
                "no PNG, EXR, NumPy, JSON or XML file in it; give the folder or file of the masks".to_owned()
            }
            [file, ..] => {
                format!("no pictures of masks in it; give the file of annotations itself: {}", file.display())
            }
        },
    ))
}
