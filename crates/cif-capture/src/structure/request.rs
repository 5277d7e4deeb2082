//! Images whose poses are to be found.

use std::path::Path;

use super::pairs::Order;
use crate::frames::Shot;

/// Which images share a lens.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lenses {
    /// All of one size: cameras of one make, at one zoom.
    #[default]
    PerSize,
    /// Those of one camera.
    PerCamera,
}

/// Images whose poses are to be found.
#[derive(Clone, Copy)]
pub struct Request<'a> {
    /// Images, ordered by camera and then by time.
    pub shots: &'a [Shot],
    /// Folder of `NAME.png` for the name of every image, in which black is left out.
    pub masks: Option<&'a Path>,
    /// How images follow each other.
    pub order: Order,
    /// Which of them share a lens.
    pub lenses: Lenses,
    /// Focal length to start from, pixels; that of EXIF else, where there is one.
    pub focal_px: Option<f64>,
    /// True where every camera moves, though its images may show otherwise.
    pub moving: bool,
    /// Folder for files of this request.
    pub work: &'a Path,
    /// Folder of features and matches, which later requests of the same images take up.
    pub kept: &'a Path,
    /// Threads for features and matches; poses do not depend on it.
    pub threads: usize,
}
