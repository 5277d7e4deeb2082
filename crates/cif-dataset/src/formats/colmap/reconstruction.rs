//! A reconstruction as its files give it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use crate::files::points::RawPoints;

/// A row of `cameras`.
pub(super) struct Camera {
    pub(super) model: String,
    pub(super) size: [f64; 2],
    pub(super) params: Vec<f64>,
}

/// A row of `images`.
pub(super) struct Image {
    pub(super) name: String,
    /// (w, x, y, z), world to camera.
    pub(super) rotation: [f64; 4],
    pub(super) translation: [f64; 3],
    pub(super) camera: u32,
}

/// A reconstruction as its three files give it.
pub(super) struct Reconstruction {
    pub(super) cameras: BTreeMap<u32, Camera>,
    pub(super) cameras_path: PathBuf,
    pub(super) images: Vec<Image>,
    pub(super) images_path: PathBuf,
    pub(super) points: RawPoints,
    pub(super) points_path: PathBuf,
}
