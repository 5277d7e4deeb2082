//! Frames of a camera, and their masks.

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;

use crate::Error;

/// A frame whose ids are known.
#[derive(Clone, Debug, PartialEq)]
pub struct Keyframe {
    /// Ids, 0 = unlabelled; of the aspect of the images.
    pub ids: PixelGrid<u16>,
    /// Confidence of every pixel, 0 to 1, at the size of `ids`; `None` for painted ones, which are certain.
    pub confidence: Option<PixelGrid<f32>>,
}

impl Keyframe {
    /// A frame that was painted.
    #[must_use]
    pub fn painted(ids: PixelGrid<u16>) -> Self {
        Self { ids, confidence: None }
    }
}

/// Frames of one camera, in order of time.
pub struct Clip<'a> {
    /// Number of frames.
    pub frames: usize,
    /// Loads the image of a frame; all have one size.
    pub image: &'a (dyn Fn(usize) -> Result<PixelGrid<[u8; 3]>, Error> + Sync),
    /// Frames whose ids are known.
    pub keyframes: &'a BTreeMap<usize, Keyframe>,
    /// True to stop with [`Error::Stopped`]; asked several times a second.
    pub stop: &'a (dyn Fn() -> bool + Sync),
}

/// The mask of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    /// Ids, 0 = unlabelled, at the size of the image.
    pub ids: PixelGrid<u16>,
    /// Probability that the id is right, in units of 1 / 255; 255 everywhere in painted keyframes.
    pub confidence: PixelGrid<u8>,
}
