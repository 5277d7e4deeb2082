//! An image of a capture.

use std::path::PathBuf;

use cif_dataset::FrameSource;
use cif_dataset::orientation::Orientation;

use crate::picture::Impression;

/// One image of a capture.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Camera that took it, of [`Source::camera`](crate::source::Source::camera).
    pub camera: String,
    /// Path below the folder of images, with `/` and extension.
    pub name: String,
    /// Where the image lies.
    pub file: PathBuf,
    /// Seconds since its camera's first frame, plus the offset of the camera; `None` for photographs without times.
    pub time: Option<f64>,
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// How the pixels of a photograph were turned to be upright, by its EXIF.
    pub turned: Orientation,
    /// Its looks from afar.
    pub impression: Impression,
    /// Photograph, or frame of a video, that it was made of; `None` where it is not known.
    pub source: Option<FrameSource>,
}
