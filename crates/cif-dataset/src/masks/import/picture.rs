//! Content of a source: objects, and pictures that show them, not decoded yet.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::frames::Task;
use super::objects::Objects;
use super::runs;
use crate::Error;

/// A picture of a source: a frame of the capture in the words of another tool.
pub(super) struct Picture {
    /// Name of its frame, as the source has it: a path without ending, or a number.
    pub(super) name: String,
    /// File, or entry of a file, for messages.
    pub(super) place: Place,
    /// Width and height that the source states.
    pub(super) size: Option<(u32, u32)>,
    pub(super) content: Content,
}

/// A place in a source, for messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) file: PathBuf,
    /// Entry of the file, such as `annotation 12`; empty where the file is all.
    pub(super) entry: String,
}

impl Place {
    pub(super) fn file(path: &Path) -> Self {
        Self { file: path.to_owned(), entry: String::new() }
    }

    pub(super) fn entry(path: &Path, entry: impl Into<String>) -> Self {
        Self { file: path.to_owned(), entry: entry.into() }
    }

    /// An error at this place.
    pub(super) fn error(&self, problem: impl std::fmt::Display) -> Error {
        let entry = if self.entry.is_empty() { String::new() } else { format!("{}: ", self.entry) };
        Error::invalid(&self.file, format!("{entry}{problem}"))
    }
}

/// Objects and pictures that a reader lists of a source.
#[derive(Default)]
pub(super) struct Listing {
    pub(super) objects: Objects,
    pub(super) pictures: Vec<Picture>,
    /// The frames of a video that numbers of pictures count, where they are not all of them.
    pub(super) task: Option<Task>,
    pub(super) notes: Vec<String>,
}

/// Parts of a picture.
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

/// A matte: a channel of an EXR file.
pub(super) struct Matte {
    pub(super) path: PathBuf,
    /// Name of the channel with those of part and layer; `None` for the one of a file that holds a single matte.
    pub(super) channel: Option<String>,
}

/// Meaning of the values and colours of the pictures.
pub(super) enum Table {
    /// Objects by value.
    Values(BTreeMap<u16, usize>),
    /// Objects by colour.
    Colors(BTreeMap<[u8; 3], usize>),
}
