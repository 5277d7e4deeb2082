//! COCO JSON: annotations of objects with run-length codes or polygons.
//!
//! Objects are distinguished by `track_id` (or `instance_id`, also in `attributes`, as CVAT writes them); without, the
//! category is the object, of which a picture then may have one.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::picture::{Content, Listing, Picture, Piece, Place, Shape};
use super::{polygon, runs};
use crate::Error;
use crate::files::json;
use crate::formats::some_of;

#[derive(Deserialize)]
struct File {
    images: Vec<Image>,
    annotations: Vec<Annotation>,
    #[serde(default)]
    categories: Vec<Category>,
}

#[derive(Deserialize)]
struct Image {
    id: Value,
    file_name: String,
    width: Option<u32>,
    height: Option<u32>,
}

#[derive(Deserialize)]
struct Annotation {
    #[serde(default)]
    id: Value,
    image_id: Value,
    #[serde(default)]
    category_id: Value,
    #[serde(default)]
    segmentation: Value,
    #[serde(default)]
    track_id: Value,
    #[serde(default)]
    instance_id: Value,
    #[serde(default)]
    attributes: Value,
    #[serde(default)]
    segments_info: Value,
}

#[derive(Deserialize)]
pub(super) struct Category {
    pub(super) id: Value,
    pub(super) name: String,
}

/// An id, number or text, as text; `None` where there is none.
pub(super) fn text_of(id: &Value) -> Option<String> {
    match id {
        Value::Number(number) => Some(number.to_string()),
        Value::String(text) if !text.trim().is_empty() => Some(text.trim().to_owned()),
        _ => None,
    }
}

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let file: File = json::read(source)?;
    if file.annotations.iter().any(|annotation| annotation.segments_info.is_array()) {
        return Err(Error::invalid(
            source,
            "its objects are in pictures (COCO panoptic), which this file only describes; give the folder of these",
        ));
    }
    let categories: BTreeMap<Option<String>, &str> =
        file.categories.iter().map(|category| (text_of(&category.id), category.name.as_str())).collect();
    let mut result = Listing::default();
    let mut place_of: BTreeMap<Option<String>, usize> = BTreeMap::new();
    for (index, image) in file.images.iter().enumerate() {
        if place_of.insert(text_of(&image.id), index).is_some() {
            return Err(Error::invalid(source, format!("image id {} is listed twice; keep one", image.id)));
        }
    }
    let mut pieces: Vec<Vec<Piece>> = file.images.iter().map(|_| Vec::new()).collect();
    let mut untracked = BTreeSet::new();
    let (mut boxes, mut boxed) = (Vec::new(), BTreeSet::new());
    for annotation in &file.annotations {
        if covers_nothing(&annotation.segmentation) {
            boxes.push(annotation.id.to_string());
            boxed.extend(place_of.get(&text_of(&annotation.image_id)).copied());
            continue;
        }
        let place = Place::entry(source, format!("annotation {}", annotation.id));
        let unknown =
            |what: &str, id: &Value| place.error(format!("its {what} {id} is not in the list of the file"));
        let image = *place_of
            .get(&text_of(&annotation.image_id))
            .ok_or_else(|| unknown("image_id", &annotation.image_id))?;
        let category = match text_of(&annotation.category_id) {
            None => None,
            key => {
                Some(*categories.get(&key).ok_or_else(|| unknown("category_id", &annotation.category_id))?)
            }
        };
        let track = [&annotation.track_id, &annotation.instance_id]
            .into_iter()
            .chain(["track_id", "instance_id"].iter().filter_map(|key| annotation.attributes.get(key)))
            .find_map(text_of);
        let key = match (track, category) {
            (Some(track), _) => track,
            (None, Some(category)) => {
                if !untracked.insert((image, category)) {
                    return Err(place.error(format!(
                        "image {} has several annotations of {category:?} and no track_id says which object each is; \
                         add track_id, the same in all images that show the object",
                        file.images[image].file_name
                    )));
                }
                category.to_owned()
            }
            (None, None) => return Err(place.error("it has neither track_id nor category_id; add one")),
        };
        let object = result.objects.enter(&key, category).map_err(|problem| place.error(problem))?;
        let shape = shape_of(&annotation.segmentation).map_err(|problem| place.error(problem))?;
        pieces[image].push(Piece { object, layer: 0, place, shape });
    }
    result.notes.extend(note_of_boxes(source, &boxes, file.annotations.len())?);
    // An image of boxes alone does not say that it shows nothing.
    let drawn =
        |(index, (_, pieces)): &(usize, (Image, Vec<Piece>))| !pieces.is_empty() || !boxed.contains(index);
    for (_, (image, pieces)) in file.images.into_iter().zip(pieces).enumerate().filter(drawn) {
        let place = Place::entry(source, format!("image {}", image.file_name));
        let size = image.width.zip(image.height);
        let content = Content::Pieces(pieces);
        result.pictures.push(Picture { name: image.file_name, place, size, content });
    }
    Ok(result)
}

/// True where there is a box at most, or outlines of one or two corners, as tools write of strokes that were drawn by mistake.
pub(super) fn covers_nothing(segmentation: &Value) -> bool {
    segmentation.is_null() || segmentation.as_array().is_some_and(|outlines| outlines.iter().all(is_stroke))
}

/// True for the corners of a point or a line.
fn is_stroke(outline: &Value) -> bool {
    let numbers = outline.as_array().map(Vec::len);
    matches!(numbers, Some(2 | 4))
}

/// The note on annotations without a mask, of `all`.
///
/// # Errors
/// When there are no others.
pub(super) fn note_of_boxes(source: &Path, boxes: &[String], all: usize) -> Result<Option<String>, Error> {
    if boxes.is_empty() {
        return Ok(None);
    }
    if boxes.len() == all {
        let problem = format!(
            "none of its {all} annotations has a segmentation that covers anything, perhaps boxes only; export masks or \
             polygons"
        );
        return Err(Error::invalid(source, problem));
    }
    Ok(Some(format!(
        "{} annotations have no segmentation that covers anything, perhaps boxes only, and were left out: {}",
        boxes.len(),
        some_of(boxes.iter().map(String::as_str))
    )))
}

/// The pixels of a segmentation: outlines, or a run-length code by columns, as numbers or text.
pub(super) fn shape_of(segmentation: &Value) -> Result<Shape, String> {
    const EXPECTED: &str =
        "its segmentation is neither polygons ([[x, y, ...]]) nor a run-length code ({\"size\", \"counts\"})";
    match segmentation {
        Value::Array(outlines) if !outlines.is_empty() => {
            let outline = |value: &Value| {
                let numbers: Vec<f64> =
                    serde_json::from_value(value.clone()).map_err(|_| EXPECTED.to_owned())?;
                polygon::corners(&numbers)
            };
            let outlines = outlines.iter().filter(|outline| !is_stroke(outline));
            Ok(Shape::Polygons(outlines.map(outline).collect::<Result<_, _>>()?))
        }
        Value::Object(code) => {
            let size: [u32; 2] = code
                .get("size")
                .and_then(|size| serde_json::from_value(size.clone()).ok())
                .ok_or("its run-length code has no size [height, width]")?;
            let counts = match code.get("counts") {
                Some(Value::String(text)) => runs::from_text(text)?,
                Some(list @ Value::Array(_)) => serde_json::from_value(list.clone())
                    .map_err(|_| "broken run-length code: a run is no whole number".to_owned())?,
                _ => return Err(EXPECTED.to_owned()),
            };
            Ok(Shape::Runs(runs::Code::Columns(counts), Some((size[1], size[0]))))
        }
        _ => Err(EXPECTED.to_owned()),
    }
}
