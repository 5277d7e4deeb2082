//! Cameras over time.

use cif_geometry::PinholeCamera;

/// A camera over time.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraTrack {
    /// Unique name, `[A-Za-z0-9_]`.
    pub name: String,
    /// Name in the capture.
    pub label: String,
    /// Views, ascending time codes, at least one.
    pub samples: Vec<CameraSample>,
}

/// A camera at a time code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraSample {
    /// Time code.
    pub time_code: f64,
    /// The view.
    pub camera: PinholeCamera,
    /// How much brighter than the scene has them it records colours, stops.
    pub exposure: f64,
}
