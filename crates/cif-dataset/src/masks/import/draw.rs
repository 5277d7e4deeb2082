//! Which object a pixel belongs to.

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;

use super::coverage::Coverage;
use super::picture::{Content, Picture, Piece, Place, Shape};
use super::{mattes, polygon, runs, tracker};
use crate::Error;
use crate::files::exr::Headers;
use crate::files::mask;
use crate::orientation::Turn;
use crate::sizes::same_aspect;

/// The mask of a frame.
pub struct Drawn {
    /// Id of every pixel, 0 for unlabelled, at the size of the frame.
    pub ids: PixelGrid<u16>,
    /// Pixels that several objects claimed.
    pub disputed: u64,
    /// Width and height of the source, of which the ids are the nearest pixels where the frame has another size.
    pub size: (u32, u32),
}

/// The mask of a picture, drawn at its own size and brought to that of its frame by nearest neighbour. `ids` are those of
/// the objects.
///
/// # Errors
/// When a file is damaged, has another aspect than the frame, or parts of the picture differ in size.
pub(super) fn draw(picture: &Picture, frame: (u32, u32), turn: Turn, ids: &[u16]) -> Result<Drawn, Error> {
    let check = |size| check_aspect(&picture.place, turn.seen_size(size, frame), frame);
    if let Some(stated) = picture.size {
        check(stated)?;
    }
    let (drawn, disputed) = match &picture.content {
        Content::Values(path, table) => {
            let objects = tracker::decode(path, table)?;
            (objects.map(|object| object.map_or(0, |object| ids[object])), 0)
        }
        Content::Ids(table, values) => {
            let id = |value: &u16| table[usize::from(*value)].map_or(0, |object| ids[object]);
            let size = picture.size.unwrap_or(frame);
            (PixelGrid::from_pixels(size.0, size.1, values.iter().map(id).collect()), 0)
        }
        Content::Pieces(pieces) => {
            let mut size = picture.size;
            for piece in pieces {
                size = size.map_or_else(|| size_of(&piece.shape), |size| Ok(Some(size)))?;
            }
            let size = size.unwrap_or(frame);
            check(size)?;
            check_stated(&picture.place, size, frame)?;
            draw_pieces(pieces, size, ids, KEPT_BYTES)?
        }
    };
    check((drawn.width, drawn.height))?;
    let drawn = turn.seen(drawn, frame);
    let size = (drawn.width, drawn.height);
    Ok(Drawn { ids: mask::nearest_resize(&drawn, frame.0, frame.1), disputed, size })
}

/// Size of the picture that a shape is drawn in, where the shape says it.
fn size_of(shape: &Shape) -> Result<Option<(u32, u32)>, Error> {
    Ok(match shape {
        Shape::Polygons(_) => None,
        Shape::Runs(_, stated) => *stated,
        Shape::File(path) => Some(mask::size(path)?),
        Shape::Matte(matte) => Some(Headers::read(&matte.path)?.size),
    })
}

/// Adds the pixels that a piece covers.
fn cover(piece: &Piece, coverage: &mut Coverage) -> Result<(), Error> {
    let size = (coverage.width, coverage.height);
    let add = |grid: &PixelGrid<bool>, coverage: &mut Coverage| {
        check_size(&piece.place, (grid.width, grid.height), size)?;
        for (at, _) in (0..).zip(&grid.pixels).filter(|(_, covered)| **covered) {
            coverage.add(at..at + 1);
        }
        Ok(())
    };
    match &piece.shape {
        Shape::Polygons(outlines) => {
            polygon::cover(outlines, coverage);
            Ok(())
        }
        Shape::Runs(code, stated) => {
            if let Some(stated) = stated {
                check_size(&piece.place, *stated, size)?;
            }
            runs::cover(code, coverage).map_err(|problem| piece.place.error(problem))
        }
        Shape::File(path) => add(&mask::decode_matte(path)?, coverage),
        Shape::Matte(matte) => add(&mattes::decode(matte)?, coverage),
    }
}

/// Bytes of coverages that are kept until they are drawn; of more objects, those beyond are decoded a second time.
const KEPT_BYTES: u64 = 1 << 27;

/// Pieces of one object on one layer.
struct Thing<'a> {
    layer: i64,
    object: usize,
    pieces: Vec<&'a Piece>,
    pixels: u64,
    coverage: Option<Coverage>,
}

impl<'a> Thing<'a> {
    fn cover(&self, coverage: &mut Coverage) -> Result<(), Error> {
        coverage.clear();
        self.pieces.iter().try_for_each(|piece| cover(piece, coverage))
    }

    /// The things of a picture, in the order of their first pieces.
    fn of(pieces: &'a [Piece]) -> Vec<Self> {
        let mut things: Vec<Self> = Vec::new();
        let mut known: BTreeMap<(i64, usize), usize> = BTreeMap::new();
        for piece in pieces {
            let (layer, object) = (piece.layer, piece.object);
            let place = *known.entry((layer, object)).or_insert(things.len());
            if place == things.len() {
                things.push(Self { layer, object, pieces: Vec::new(), pixels: 0, coverage: None });
            }
            things[place].pieces.push(piece);
        }
        things
    }
}

/// Ids of the pixels of a picture, and how many several objects claim; coverages of up to `left` bytes are kept.
fn draw_pieces(
    pieces: &[Piece],
    size: (u32, u32),
    ids: &[u16],
    mut left: u64,
) -> Result<(PixelGrid<u16>, u64), Error> {
    let mut things = Thing::of(pieces);
    let mut scratch = Coverage::none(size);
    for thing in &mut things {
        thing.cover(&mut scratch)?;
        thing.pixels = scratch.count();
        let bytes = u64::from(size.0) * u64::from(size.1) / 8;
        if bytes <= left {
            left -= bytes;
            thing.coverage = Some(std::mem::replace(&mut scratch, Coverage::none(size)));
        }
    }
    // Stable: of equal ones the later is drawn later.
    things.sort_by_key(|thing| (thing.layer, std::cmp::Reverse(thing.pixels)));
    let mut grid = PixelGrid::filled(size.0, size.1, 0_u16);
    let mut disputed = Coverage::none(size);
    for thing in things {
        let coverage = match &thing.coverage {
            Some(coverage) => coverage,
            None => {
                thing.cover(&mut scratch)?;
                &scratch
            }
        };
        let id = ids[thing.object];
        for at in coverage.places() {
            let pixel = &mut grid.pixels[at];
            if *pixel != 0 && *pixel != id {
                disputed.add(at as u64..at as u64 + 1);
            }
            *pixel = id;
        }
    }
    Ok((grid, disputed.count()))
}

/// Refuses a size of another aspect than that of the frame.
fn check_aspect(place: &Place, size: (u32, u32), frame: (u32, u32)) -> Result<(), Error> {
    if size.0 > 0 && size.1 > 0 && same_aspect(size, frame) {
        return Ok(());
    }
    Err(place.error(format!(
        "{} x {} pixels, its frame has {} x {}: another aspect; export the masks at the size of the images or of their \
         video",
        size.0, size.1, frame.0, frame.1
    )))
}

/// Most pixels of a source for one of its frame: captures are kept reduced by 8 at the most, along both sides.
const MOST_PIXELS: u64 = 64;

/// Refuses a size that a source only states, where drawing it would take far more memory than its frame.
fn check_stated(place: &Place, size: (u32, u32), frame: (u32, u32)) -> Result<(), Error> {
    let pixels = |(width, height): (u32, u32)| u64::from(width) * u64::from(height);
    let most = pixels(frame).saturating_mul(MOST_PIXELS);
    if pixels(size) <= most {
        return Ok(());
    }
    Err(place.error(format!(
        "it states {} x {} = {} pixels, more than {MOST_PIXELS} times the {} x {} of its frame ({most}); export the masks \
         at the size of the images or of their video",
        size.0,
        size.1,
        pixels(size),
        frame.0,
        frame.1
    )))
}

/// Refuses a part of a picture that has another size.
fn check_size(place: &Place, size: (u32, u32), picture: (u32, u32)) -> Result<(), Error> {
    if size == picture {
        return Ok(());
    }
    Err(place.error(format!(
        "{} x {} pixels, other masks of its frame {} x {}; export them at one size",
        size.0, size.1, picture.0, picture.1
    )))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// A rectangle of an object.
    fn piece(object: usize, layer: i64, [left, top, right, bottom]: [f64; 4]) -> Piece {
        let corners = vec![[left, top], [right, top], [right, bottom], [left, bottom]];
        Piece {
            object,
            layer,
            place: Place::file(Path::new("made.json")),
            shape: Shape::Polygons(vec![corners]),
        }
    }

    #[test]
    fn objects_that_are_decoded_twice_are_drawn_as_those_that_are_kept() {
        let size = (70, 40);
        let mut pieces = vec![piece(0, 0, [0.0, 0.0, 60.0, 40.0]), piece(1, 0, [10.0, 10.0, 30.0, 30.0])];
        // Thousands of pieces of one object are one thing, over what is larger and under the higher layer.
        pieces.extend((0..5000).map(|k| {
            let (x, y) = (f64::from(k % 25), f64::from(k % 20));
            piece(2, 0, [20.0 + x, 5.0 + y, 21.0 + x, 6.0 + y])
        }));
        pieces.push(piece(3, 1, [0.0, 0.0, 5.0, 5.0]));
        let ids = [7, 8, 9, 10];
        let kept = draw_pieces(&pieces, size, &ids, KEPT_BYTES).unwrap();
        let (grid, disputed) = &kept;
        assert_eq!(
            [(1, 1), (12, 12), (20, 5), (55, 35), (65, 1)].map(|(x, y)| *grid.at(x, y)),
            [10, 8, 9, 7, 0]
        );
        let pixels = |id: u16| grid.pixels.iter().filter(|found| **found == id).count();
        assert_eq!((pixels(9), pixels(10)), (100, 25));
        assert_eq!(*disputed, 400 + 25 + 100 - 30);
        assert_eq!(draw_pieces(&pieces, size, &ids, 0).unwrap(), kept);
        assert_eq!(draw_pieces(&pieces, size, &ids, 800).unwrap(), kept);
    }
}
