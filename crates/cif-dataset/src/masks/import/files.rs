//! A picture file per object and frame, as SAM 2 and matte renders are stored: `FRAME/OBJECT.png` or `OBJECT/FRAME.png`
//! in folders, `OBJECT.FRAME.exr` or `OBJECT_FRAME.png` without.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::files_below::files_below;
use super::frames::FrameNames;
use super::picture::{Content, Listing, Matte, Picture, Piece, Place, Shape};
use crate::Error;
use crate::files::listing;

/// Which half of a name is the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    FrameThenObject,
    ObjectThenFrame,
}

/// Endings of masks of one object.
pub(super) const ENDINGS: [&str; 2] = ["png", "exr"];

/// Frame and object of a name in one order: the folders and the file, or the halves around its last dot or underscore.
fn split(name: &str, order: Order) -> Option<(&str, &str)> {
    let frame_and_object = |(first, last)| match order {
        Order::FrameThenObject => (first, last),
        Order::ObjectThenFrame => (last, first),
    };
    let halves = match order {
        Order::FrameThenObject => name.rsplit_once('/'),
        Order::ObjectThenFrame => name.split_once('/'),
    };
    halves.or_else(|| name.rsplit_once(['.', '_'])).map(frame_and_object)
}

/// The order in which names stand for more frames of the capture; `None` where neither is one.
///
/// # Errors
/// When both do alike.
pub(super) fn order_of(names: &[&String], frames: &FrameNames) -> Result<Option<Order>, String> {
    let reach = |order| {
        let stated: Option<BTreeSet<&str>> =
            names.iter().map(|name| split(name, order).map(|(frame, _)| frame)).collect();
        stated.map_or((0, 0), |stated| frames.reach(&stated))
    };
    let (first, last) = (reach(Order::FrameThenObject), reach(Order::ObjectThenFrame));
    let of = |first: usize, last: usize| match first.cmp(&last) {
        std::cmp::Ordering::Greater => Ok(Some(Order::FrameThenObject)),
        std::cmp::Ordering::Less => Ok(Some(Order::ObjectThenFrame)),
        std::cmp::Ordering::Equal if first == 0 => Ok(None),
        std::cmp::Ordering::Equal => Err(
            "its names could be frames that hold objects or objects that hold frames; say which with --from \
             frame-folders or --from object-folders"
                .to_owned(),
        ),
    };
    if first.0 + last.0 > 0 { of(first.0, last.0) } else { of(first.1, last.1) }
}

/// True where names in an order are of one object.
pub(super) fn one_object(names: &[&String], order: Order) -> bool {
    let objects: BTreeSet<_> =
        names.iter().map(|name| split(name, order).map(|(_, object)| object)).collect();
    objects.len() == 1
}

pub(super) fn list(source: &Path, order: Order) -> Result<Listing, Error> {
    let files = files_below(source, &ENDINGS)?;
    let mut parts: BTreeMap<String, Vec<(String, PathBuf)>> = BTreeMap::new();
    let mut keys = BTreeSet::new();
    for (name, path) in files {
        let (frame, object) = split(&name, order).ok_or_else(|| {
            Error::invalid(
                &path,
                "neither its folders nor its name tell frame and object: FRAME/OBJECT.png, OBJECT/FRAME.png or \
                 OBJECT.FRAME.png is expected",
            )
        })?;
        // Numbers in the order of numbers, before names.
        keys.insert((object.parse::<u64>().unwrap_or(u64::MAX), object.to_owned()));
        parts.entry(frame.to_owned()).or_default().push((object.to_owned(), path));
    }
    let mut result = Listing::default();
    for (_, key) in keys {
        result.objects.enter(&key, None).map_err(|problem| Error::invalid(source, problem))?;
    }
    for (name, parts) in parts {
        let place = Place::file(&parts[0].1);
        let mut pieces = Vec::new();
        for (object, path) in parts {
            let object =
                result.objects.enter(&object, None).map_err(|problem| Error::invalid(&path, problem))?;
            let place = Place::file(&path);
            let shape = if listing::has_extension(&path, &["exr"]) {
                Shape::Matte(Matte { path, channel: None })
            } else {
                Shape::File(path)
            };
            pieces.push(Piece { object, layer: 0, place, shape });
        }
        result.pictures.push(Picture { name, place, size: None, content: Content::Pieces(pieces) });
    }
    Ok(result)
}
