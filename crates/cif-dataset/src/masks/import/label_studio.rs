//! JSON export of Label Studio: brushes and polygons per task. The label is the object: regions of one label in a picture
//! are one object, because the export does not say which region of another picture is the same thing.

use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::picture::{Content, Listing, Picture, Piece, Place, Shape};
use super::{polygon, runs};
use crate::Error;
use crate::files::{json, listing};

#[derive(Deserialize)]
struct Task {
    #[serde(default)]
    id: Value,
    #[serde(default)]
    file_upload: Option<String>,
    #[serde(default)]
    data: serde_json::Map<String, Value>,
    annotations: Vec<Annotation>,
}

#[derive(Deserialize)]
struct Annotation {
    #[serde(default)]
    was_cancelled: bool,
    #[serde(default)]
    ground_truth: bool,
    result: Vec<Region>,
}

#[derive(Deserialize)]
struct Region {
    #[serde(default)]
    id: Value,
    #[serde(default, rename = "type")]
    kind: String,
    #[serde(default)]
    original_width: Option<u32>,
    #[serde(default)]
    original_height: Option<u32>,
    #[serde(default)]
    image_rotation: f64,
    #[serde(default)]
    value: Value,
}

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let tasks: Vec<Task> = json::read(source)?;
    let mut result = Listing::default();
    let (mut several, mut others) = (0, 0);
    for task in &tasks {
        let place = Place::entry(source, format!("task {}", task.id));
        let finished = || task.annotations.iter().filter(|annotation| !annotation.was_cancelled);
        let Some(chosen) =
            finished().find(|annotation| annotation.ground_truth).or_else(|| finished().next_back())
        else {
            continue;
        };
        several += usize::from(finished().count() > 1);
        let name = image_of(task).ok_or_else(|| {
            place.error("nothing in its data names one image file; export the tasks with their images' names")
        })?;
        let (mut pieces, mut size) = (Vec::new(), None);
        for region in &chosen.result {
            let place = Place::entry(source, format!("task {}, region {}", task.id, region.id));
            let shape = match shape_of(region) {
                Ok(Some(shape)) => shape,
                Ok(None) => {
                    others += usize::from(!matches!(region.kind.as_str(), "labels" | "choices" | "textarea"));
                    continue;
                }
                Err(problem) => return Err(place.error(problem)),
            };
            let label = label_of(region, &chosen.result)
                .ok_or_else(|| place.error("it has no label, or several; give it one"))?;
            let object =
                result.objects.enter(&label, Some(&label)).map_err(|problem| place.error(problem))?;
            size = size.or(region.original_width.zip(region.original_height));
            pieces.push(Piece { object, layer: 0, place, shape });
        }
        result.pictures.push(Picture { name, place, size, content: Content::Pieces(pieces) });
    }
    if several > 0 {
        result.notes.push(format!(
            "{several} tasks have several annotations: that of the ground truth is taken, else the last"
        ));
    }
    if others > 0 {
        result.notes.push(format!("{others} regions are neither brushes nor polygons and were left out"));
    }
    Ok(result)
}

/// Name of the image of a task, without the letters that Label Studio puts before the names of uploaded files.
fn image_of(task: &Task) -> Option<String> {
    let mut images = task.data.values().filter_map(Value::as_str).filter(|text| {
        let text = text.split(['?', '#']).next().unwrap_or_default();
        listing::is_image(Path::new(text)) || text.ends_with("local-files/")
    });
    let stated = match (images.next(), images.next()) {
        (Some(image), None) => image,
        _ => task.file_upload.as_deref()?,
    };
    // `/data/local-files/?d=folder/000012.png`, `/data/upload/3/1f2e3d4c-000012.png`.
    let path = stated.rsplit_once("?d=").map_or(stated, |(_, path)| path);
    let path = path.split(['?', '#']).next().unwrap_or_default();
    let path = path.rsplit_once("://").map_or(path, |(_, path)| path).trim_start_matches('/');
    let (folder, file) = path.rsplit_once('/').unwrap_or(("", path));
    let uploaded = |file: &str| {
        let (letters, rest) = file.split_once('-')?;
        let is_hash = letters.len() == 8 && letters.bytes().all(|byte| byte.is_ascii_hexdigit());
        is_hash.then(|| rest.to_owned())
    };
    Some(match uploaded(file) {
        Some(name) => name,
        None if folder.is_empty() => file.to_owned(),
        None => format!("{folder}/{file}"),
    })
}

/// The label of a region: its own, else that of the entry of labels with its id.
fn label_of(region: &Region, all: &[Region]) -> Option<String> {
    let own = |region: &Region| {
        let lists = ["brushlabels", "polygonlabels", "labels"];
        let labels = lists.iter().find_map(|list| region.value.get(list)?.as_array())?;
        match labels.as_slice() {
            [Value::String(label)] => Some(label.clone()),
            _ => None,
        }
    };
    own(region).or_else(|| {
        let same = |other: &&Region| !region.id.is_null() && other.id == region.id;
        all.iter().filter(same).find_map(own)
    })
}

/// The pixels of a region; `None` where it is neither a brush nor a polygon.
fn shape_of(region: &Region) -> Result<Option<Shape>, String> {
    let size = region.original_width.zip(region.original_height);
    let upright = |shape: Shape| {
        if region.image_rotation == 0.0 {
            return Ok(Some(shape));
        }
        Err("its image was rotated while labelling; label the image as it is in the capture".to_owned())
    };
    if region.kind == "labels" {
        return Ok(None);
    }
    if let Some(code) = region.value.get("rle") {
        let bytes = serde_json::from_value(code.clone())
            .map_err(|_| "broken brush code: a list of bytes is expected".to_owned())?;
        return upright(Shape::Runs(runs::Code::Brush(bytes), size));
    }
    let Some(points) = region.value.get("points").filter(|_| region.kind.starts_with("polygon")) else {
        return Ok(None);
    };
    let points: Vec<[f64; 2]> =
        serde_json::from_value(points.clone()).map_err(|_| "its points are no list of [x, y]".to_owned())?;
    let (width, height) = size.ok_or("it has no original_width and original_height")?;
    // Percent of the picture.
    let pixels: Vec<f64> = points
        .iter()
        .flat_map(|[x, y]| [x / 100.0 * f64::from(width), y / 100.0 * f64::from(height)])
        .collect();
    upright(Shape::Polygons(vec![polygon::corners(&pixels)?]))
}
