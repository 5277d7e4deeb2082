//! Mattes in EXR files, as Nuke and renderers write them: a channel per object, covered from one half on.

use std::path::Path;

use cif_geometry::PixelGrid;
use exr::prelude::FlatSamples;

use super::files_below::files_below;
use super::picture::{Content, Listing, Matte, Picture, Piece, Place, Shape};
use crate::Error;
use crate::files::exr::Headers;

/// From this value on, a matte covers a pixel.
const HALF: f32 = 0.5;

/// Names of channels that say nothing about an object.
const COMPONENTS: [&str; 12] =
    ["r", "g", "b", "a", "y", "red", "green", "blue", "alpha", "matte", "mask", "z"];

/// True when the files are Cryptomattes, which are read as masks without import.
pub(super) fn is_cryptomatte(path: &Path) -> Result<bool, Error> {
    Ok(Headers::read(path)?.attributes().any(|(name, _)| name.starts_with("cryptomatte/")))
}

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let mut result = Listing::default();
    for (name, path) in files_below(source, &["exr"])? {
        let mut pieces = Vec::new();
        for (part, channel) in Headers::read(&path)?.channels() {
            let channel = full_name(part.as_deref(), &channel);
            let Some(object) = object_of(&channel) else { continue };
            let object =
                result.objects.enter(&object, None).map_err(|problem| Error::mask(&path, problem))?;
            let place = Place::entry(&path, format!("channel {channel}"));
            let shape = Shape::Matte(Matte { path: path.clone(), channel: Some(channel) });
            pieces.push(Piece { object, layer: 0, place, shape });
        }
        if pieces.is_empty() {
            return Err(Error::mask(
                &path,
                "it has no channel that is named after an object; write one channel per object, or one file per object \
                 (OBJECT.FRAME.exr) and give --from object-folders",
            ));
        }
        result.pictures.push(Picture {
            name,
            place: Place::file(&path),
            size: None,
            content: Content::Pieces(pieces),
        });
    }
    Ok(result)
}

/// Name of a channel with that of its part, where it does not have it already.
fn full_name(part: Option<&str>, channel: &str) -> String {
    match part {
        Some(part) if !part.is_empty() && !channel.starts_with(&format!("{part}.")) => {
            format!("{part}.{channel}")
        }
        _ => channel.to_owned(),
    }
}

/// The object that a channel is of: its last name that is no component. Colours and depth of the beauty are none.
fn object_of(channel: &str) -> Option<String> {
    let is_component = |name: &str| COMPONENTS.contains(&name.to_lowercase().as_str());
    let beauty =
        |name: &str| ["rgb", "rgba", "beauty", "combined", "depth"].contains(&name.to_lowercase().as_str());
    let mut names: Vec<&str> = channel.split('.').collect();
    let color = names
        .last()
        .is_some_and(|name| ["r", "g", "b", "red", "green", "blue"].contains(&name.to_lowercase().as_str()));
    while names.last().is_some_and(|name| is_component(name)) {
        names.pop();
    }
    let object = names.last().filter(|name| !beauty(name))?;
    // Three mattes in the colours of one layer are three objects.
    Some(if color { channel.to_owned() } else { (*object).to_owned() })
}

/// Pixels that a matte covers, at the size of the display window.
///
/// # Errors
/// When the file is damaged, or lacks the channel.
pub(super) fn decode(matte: &Matte) -> Result<PixelGrid<bool>, Error> {
    let path = &matte.path;
    let mut planes = Vec::new();
    for channel in Headers::read(path)?.decode()?.channels() {
        let name = full_name(channel.part.as_deref(), &channel.name);
        if matte.channel.as_ref().is_some_and(|requested| *requested != name) {
            continue;
        }
        let last = name.rsplit('.').next().unwrap_or_default().to_lowercase();
        planes.push((last, channel.plane(samples(channel.samples), false)));
    }
    if let Some(requested) = &matte.channel {
        let (_, plane) =
            planes.pop().ok_or_else(|| Error::mask(path, format!("its channel {requested} is missing")))?;
        return Ok(plane);
    }
    single(planes).ok_or_else(|| Error::mask(path, "it has no channel; export it again"))
}

/// Of a file with one matte: opacity where it varies, else what any other channel covers.
fn single(planes: Vec<(String, PixelGrid<bool>)>) -> Option<PixelGrid<bool>> {
    let is_opacity = |name: &str| matches!(name, "a" | "alpha");
    let varies = |grid: &PixelGrid<bool>| grid.pixels.contains(&true) && grid.pixels.contains(&false);
    let opacity = planes.iter().position(|(name, _)| is_opacity(name));
    if let Some(opacity) = opacity
        && (varies(&planes[opacity].1) || planes.len() == 1)
    {
        return planes.into_iter().nth(opacity).map(|(_, grid)| grid);
    }
    let mut others =
        planes.into_iter().filter(|(name, _)| !is_opacity(name) && name != "z").map(|(_, grid)| grid);
    let mut all = others.next()?;
    for other in others {
        for (covered, more) in all.pixels.iter_mut().zip(&other.pixels) {
            *covered |= *more;
        }
    }
    Some(all)
}

fn samples(samples: &FlatSamples) -> Box<dyn Iterator<Item = bool> + '_> {
    match samples {
        FlatSamples::F16(values) => Box::new(values.iter().map(|value| value.to_f32() >= HALF)),
        FlatSamples::F32(values) => Box::new(values.iter().map(|value| *value >= HALF)),
        FlatSamples::U32(values) => Box::new(values.iter().map(|value| *value != 0)),
    }
}
