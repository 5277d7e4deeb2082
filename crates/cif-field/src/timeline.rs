//! Captured times and cameras.

use cif_geometry::PinholeCamera;
use serde::{Deserialize, Serialize};

/// The times at which the scene was seen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timeline {
    /// Normalised times in [0, 1], ascending, one per captured frame number.
    pub times: Vec<f64>,
    /// Captured frames per second; 24 where the capture does not say.
    pub frames_per_second: f64,
}

/// A camera of the capture at one of its times.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedCamera {
    /// Name of the camera, shared by all its frames.
    pub name: String,
    /// Index into [`Timeline::times`].
    pub time_index: usize,
    /// True when the frame was trained on.
    pub trained: bool,
    /// The view.
    pub camera: PinholeCamera,
}
