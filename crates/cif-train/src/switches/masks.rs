//! Masks of a frame as they are compared, and the frames of a camera in order.

use std::collections::BTreeMap;
use std::ops::Range;

use cif_geometry::PixelGrid;

use super::colors::Colors;
use super::pieces::{Piece, pieces};
use super::place::Place;

/// Pixels below which a mask is too small to be looked at.
const FEWEST: usize = 8;

/// Captured times between two frames of which one says something of the other.
const NEAR: usize = 3;

/// A mask of one frame.
#[derive(Clone, Debug)]
pub(super) struct Mask {
    /// Label in the mask file.
    pub label: u16,
    pub pixels: usize,
    pub colors: Colors,
    pub place: Place,
    /// Its pieces, the largest first.
    pub pieces: Vec<Piece>,
}

impl Mask {
    fn of(label: u16, pieces: Vec<Piece>) -> Self {
        let parts = || pieces.iter().map(|piece| (&piece.colors, piece.pixels as f64));
        let place = pieces.iter().fold(Place::default(), |place, piece| place.with(&piece.place));
        let pixels = pieces.iter().map(|piece| piece.pixels).sum();
        Self { label, pixels, colors: Colors::mean(parts()), place, pieces }
    }

    /// The mask without some of its pieces, and the first pixels of the parts of these.
    pub(super) fn split(&self, without: &[bool]) -> (Self, Vec<u32>) {
        let (mut kept, mut left_out) = (Vec::new(), Vec::new());
        for (piece, without) in self.pieces.iter().zip(without) {
            if *without {
                left_out.extend(&piece.firsts);
            } else {
                kept.push(piece.clone());
            }
        }
        (Self::of(self.label, kept), left_out)
    }
}

/// Masks of a frame by the label that each of them has now.
pub(super) type Now<'a> = BTreeMap<u16, &'a Mask>;

/// The masks of a frame.
pub(crate) struct Seen {
    camera: String,
    time: usize,
    pub(super) masks: Vec<Mask>,
}

impl Seen {
    /// The masks, if there are any, of an image that a camera took at a time of the capture.
    pub(crate) fn of(
        image: &PixelGrid<[u8; 3]>,
        labels: Option<&PixelGrid<u16>>,
        camera: &str,
        time: usize,
    ) -> Self {
        let mut seen = Self { camera: camera.to_owned(), time, masks: Vec::new() };
        let Some(labels) = labels else { return seen };
        let masks = pieces(image, labels).into_iter().map(|(label, pieces)| Mask::of(label, pieces));
        seen.masks.extend(masks.filter(|mask| mask.pixels >= FEWEST));
        seen
    }
}

/// Frames of one camera in the order of their times.
pub(super) struct Sequence {
    pub frames: Vec<usize>,
    pub times: Vec<usize>,
}

impl Sequence {
    /// Those of every camera.
    pub(super) fn all(frames: &[Seen]) -> Vec<Self> {
        let mut cameras: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (k, frame) in frames.iter().enumerate() {
            cameras.entry(&frame.camera).or_default().push(k);
        }
        let in_order = |mut of: Vec<usize>| {
            of.sort_by_key(|k| frames[*k].time);
            Self { times: of.iter().map(|k| frames[*k].time).collect(), frames: of }
        };
        cameras.into_values().map(in_order).collect()
    }

    pub(super) fn len(&self) -> usize {
        self.frames.len()
    }

    /// True where a frame follows that before it closely.
    pub(super) fn follows(&self, at: usize) -> bool {
        at > 0 && self.times[at] - self.times[at - 1] <= NEAR
    }

    /// The frames around one that follow each other closely and are `shown`; `None` where no frame close to them is known
    /// not to be.
    pub(super) fn moment(&self, at: usize, shown: impl Fn(usize) -> bool) -> Option<Range<usize>> {
        let (mut from, mut to) = (at, at + 1);
        while self.follows(from) && shown(from - 1) {
            from -= 1;
        }
        while to < self.len() && self.follows(to) && shown(to) {
            to += 1;
        }
        (self.follows(from) || (to < self.len() && self.follows(to))).then_some(from..to)
    }

    /// The frames closely before and after one.
    pub(super) fn near(&self, at: usize) -> Vec<usize> {
        let before = self.follows(at).then(|| at - 1);
        let after = (at + 1 < self.len() && self.follows(at + 1)).then_some(at + 1);
        before.into_iter().chain(after).collect()
    }
}
