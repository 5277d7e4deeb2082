//! YouTube-VIS JSON: videos whose annotations are objects, each with a run-length code or polygons per frame,
//! or null where it is not seen.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::coco::{Category, covers_nothing, shape_of, text_of};
use super::frames::FrameNames;
use super::picture::{Content, Listing, Picture, Piece, Place};
use crate::Error;
use crate::files::json;

#[derive(Deserialize)]
struct File {
    videos: Vec<Video>,
    annotations: Vec<Annotation>,
    #[serde(default)]
    categories: Vec<Category>,
}

#[derive(Deserialize)]
struct Video {
    id: Value,
    file_names: Vec<String>,
    width: Option<u32>,
    height: Option<u32>,
}

#[derive(Deserialize)]
struct Annotation {
    id: Value,
    video_id: Value,
    #[serde(default)]
    category_id: Value,
    /// Per frame of the video.
    segmentations: Vec<Value>,
}

pub(super) fn list(source: &Path, frames: &FrameNames) -> Result<Listing, Error> {
    let file: File = json::read(source)?;
    let video = video_of(&file, source, frames)?;
    let categories: BTreeMap<Option<String>, &str> =
        file.categories.iter().map(|category| (text_of(&category.id), category.name.as_str())).collect();
    let mut result = Listing::default();
    if file.videos.len() > 1 {
        let note = format!("video {} of {} in the file", video.id, file.videos.len());
        result.notes.push(note);
    }
    let mut pieces: Vec<Vec<Piece>> = video.file_names.iter().map(|_| Vec::new()).collect();
    let of_video = file.annotations.iter().filter(|annotation| annotation.video_id == video.id);
    for annotation in of_video {
        let place = Place::entry(source, format!("annotation {}", annotation.id));
        let key = text_of(&annotation.id).ok_or_else(|| place.error("it has no id; add one"))?;
        let category = match text_of(&annotation.category_id) {
            None => None,
            key => Some(*categories.get(&key).ok_or_else(|| {
                let id = &annotation.category_id;
                place.error(format!("its category_id {id} is not in the list of the file"))
            })?),
        };
        if annotation.segmentations.len() != pieces.len() {
            return Err(place.error(format!(
                "it has {} segmentations, its video {} frames; give one per frame, null where the object is not seen",
                annotation.segmentations.len(),
                pieces.len()
            )));
        }
        let object = result.objects.enter(&key, category).map_err(|problem| place.error(problem))?;
        let seen = annotation.segmentations.iter().zip(&mut pieces).zip(&video.file_names);
        for ((segmentation, pieces), name) in
            seen.filter(|((segmentation, _), _)| !covers_nothing(segmentation))
        {
            let place = Place::entry(source, format!("annotation {} in {name}", annotation.id));
            let shape = shape_of(segmentation).map_err(|problem| place.error(problem))?;
            pieces.push(Piece { object, layer: 0, place, shape });
        }
    }
    for (name, pieces) in video.file_names.iter().zip(pieces) {
        let place = Place::entry(source, format!("frame {name}"));
        let size = video.width.zip(video.height);
        let content = Content::Pieces(pieces);
        result.pictures.push(Picture { name: name.clone(), place, size, content });
    }
    Ok(result)
}

/// The video of the capture: the only one, or the one whose frames are named as those of the capture.
fn video_of<'a>(file: &'a File, source: &Path, frames: &FrameNames) -> Result<&'a Video, Error> {
    if let [video] = file.videos.as_slice() {
        return Ok(video);
    }
    let is_shown = |video: &&Video| {
        let names: BTreeSet<&str> = video.file_names.iter().map(String::as_str).collect();
        frames.reach(&names).0 == names.len()
    };
    let shown: Vec<&Video> = file.videos.iter().filter(is_shown).collect();
    match shown.as_slice() {
        [video] => Ok(video),
        _ => Err(Error::invalid(
            source,
            format!(
                "it holds {} videos, of which {} have frames named as those of the capture; keep the one that the \
                 capture is of",
                file.videos.len(),
                shown.len()
            ),
        )),
    }
}
