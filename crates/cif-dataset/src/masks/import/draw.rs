//! Which object a pixel belongs to.

use std::path::PathBuf;
use std::sync::Arc;

use cif_geometry::PixelGrid;

use super::mattes::Matte;
use super::tracker::Table;
use super::{Drawn, Picture, Place, check_aspect, check_size, mattes, polygon, runs, tracker};
use crate::Error;
use crate::files::{exr_header, mask};
use crate::orientation::Turn;

/// What a picture consists of.
pub(super) enum Content {
    /// A file with a value or a colour per pixel.
    Values(PathBuf, Arc<Table>),
    /// Values, row by row, at the stated size, and the objects that they stand for.
    Ids(Arc<Vec<Option<usize>>>, Vec<u16>),
    /// Objects one by one, which may overlap.
    Pieces(Vec<Piece>),
}

/// A part of an object in a picture.
pub(super) struct Piece {
    /// Index into the objects of the source.
    pub(super) object: usize,
    /// Pieces on higher layers cover those below.
    pub(super) layer: i64,
    pub(super) place: Place,
    pub(super) shape: Shape,
}

/// Which pixels a piece covers.
pub(super) enum Shape {
    /// Outlines whose areas add up; corners in pixels from the top left corner of the picture.
    Polygons(Vec<Vec<[f64; 2]>>),
    /// Run-length code and the size that it is for, where the source says it.
    Runs(runs::Code, Option<(u32, u32)>),
    /// Picture file of one object: covered where it is white or opaque by a half.
    File(PathBuf),
    /// Channel of an EXR file, covered from a half on.
    Matte(Matte),
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
            draw_pieces(pieces, size, ids)?
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
        Shape::Matte(matte) => Some(exr_header::read(&matte.path)?.1),
    })
}

/// Pixels that a piece covers, as places in the picture row by row, ascending.
fn covered(piece: &Piece, size: (u32, u32)) -> Result<Vec<u32>, Error> {
    let of_grid = |grid: PixelGrid<bool>| -> Result<Vec<u32>, Error> {
        check_size(&piece.place, (grid.width, grid.height), size)?;
        Ok((0..).zip(&grid.pixels).filter(|(_, covered)| **covered).map(|(at, _)| at).collect())
    };
    match &piece.shape {
        Shape::Polygons(outlines) => Ok(polygon::fill(outlines, size)),
        Shape::Runs(code, stated) => {
            if let Some(stated) = stated {
                check_size(&piece.place, *stated, size)?;
            }
            runs::covered(code, size).map_err(|problem| piece.place.error(problem))
        }
        Shape::File(path) => of_grid(mask::decode_matte(path)?),
        Shape::Matte(matte) => of_grid(mattes::decode(matte)?),
    }
}

fn draw_pieces(pieces: &[Piece], size: (u32, u32), ids: &[u16]) -> Result<(PixelGrid<u16>, u64), Error> {
    // Pieces of one object are one thing on their layer: their sizes add up.
    let mut things: Vec<(i64, usize, Vec<u32>)> = Vec::new();
    for piece in pieces {
        let pixels = covered(piece, size)?;
        match things.iter_mut().find(|(layer, object, _)| (*layer, *object) == (piece.layer, piece.object)) {
            Some((_, _, known)) => {
                known.extend(pixels);
                known.sort_unstable();
                known.dedup();
            }
            None => things.push((piece.layer, piece.object, pixels)),
        }
    }
    // Stable: of equal ones the later is drawn later.
    things.sort_by_key(|(layer, _, pixels)| (*layer, std::cmp::Reverse(pixels.len())));
    let mut grid = PixelGrid::filled(size.0, size.1, 0_u16);
    let mut disputed = vec![false; grid.pixels.len()];
    for (_, object, pixels) in things {
        for at in pixels {
            let pixel = &mut grid.pixels[at as usize];
            disputed[at as usize] |= *pixel != 0 && *pixel != ids[object];
            *pixel = ids[object];
        }
    }
    let disputed = disputed.iter().filter(|disputed| **disputed).count() as u64;
    Ok((grid, disputed))
}
