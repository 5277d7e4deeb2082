//! Mattes in EXR files, as Nuke and renderers write them: a channel per object, covered from one half on.

use std::path::Path;

use cif_geometry::PixelGrid;
use exr::meta::MetaData;
use exr::prelude::{FlatSamples, ReadChannels, ReadLayers, Text, read as read_exr};

use super::files_below::files_below;
use super::picture::{Content, Listing, Matte, Picture, Piece, Place, Shape};
use crate::Error;
use crate::files::exr_header;

/// From this value on, a matte covers a pixel.
const HALF: f32 = 0.5;

/// Names of channels that say nothing about an object.
const COMPONENTS: [&str; 12] =
    ["r", "g", "b", "a", "y", "red", "green", "blue", "alpha", "matte", "mask", "z"];

/// Whether the files are Cryptomattes, which are read as masks without import.
pub(super) fn is_cryptomatte(path: &Path) -> Result<bool, Error> {
    let meta = header(path)?;
    let names = meta
        .headers
        .iter()
        .flat_map(|header| header.own_attributes.other.keys().chain(header.shared_attributes.other.keys()));
    Ok(names.into_iter().any(|name| name.to_string().starts_with("cryptomatte/")))
}

fn header(path: &Path) -> Result<MetaData, Error> {
    exr_header::read(path).map(|(meta, _)| meta)
}

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let mut result = Listing::default();
    for (name, path) in files_below(source, &["exr"])? {
        let meta = header(&path)?;
        let mut channels = Vec::new();
        for header in &meta.headers {
            let part = header.own_attributes.layer_name.as_ref().map(Text::to_string);
            channels.extend(
                header
                    .channels
                    .list
                    .iter()
                    .map(|channel| full_name(part.as_deref(), &channel.name.to_string())),
            );
        }
        let mut pieces = Vec::new();
        for channel in channels {
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
    let (meta, size) = exr_header::read(path)?;
    drop(meta);
    let image = read_exr()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .non_parallel()
        .from_file(path)
        .map_err(|error| Error::mask(path, format!("it cannot be decoded ({error}); export it again")))?;
    let window = image.attributes.display_window.position;
    let mut planes = Vec::new();
    for layer in &image.layer_data {
        let part = layer.attributes.layer_name.as_ref().map(Text::to_string);
        for channel in &layer.channel_data.list {
            let name = full_name(part.as_deref(), &channel.name.to_string());
            if matte.channel.as_ref().is_some_and(|wanted| *wanted != name) {
                continue;
            }
            let offset = layer.attributes.layer_position - window;
            let mut plane = PixelGrid::filled(size.0, size.1, false);
            let columns = layer.size.x().max(1);
            for (at, covered) in samples(&channel.sample_data).enumerate() {
                let x = (at % columns) as i64 + i64::from(offset.x());
                let y = (at / columns) as i64 + i64::from(offset.y());
                if covered && (0..i64::from(size.0)).contains(&x) && (0..i64::from(size.1)).contains(&y) {
                    plane.pixels[(y * i64::from(size.0) + x) as usize] = true;
                }
            }
            let last = name.rsplit('.').next().unwrap_or_default().to_lowercase();
            planes.push((last, plane));
        }
    }
    if let Some(wanted) = &matte.channel {
        let (_, plane) =
            planes.pop().ok_or_else(|| Error::mask(path, format!("its channel {wanted} is missing")))?;
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
