//! Where coordinates lie in the world of a capture.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::{PinholeCamera, RigidTransform};

/// Where a dataset lies in the coordinates of its capture: `x_dataset = scale * (x_capture - offset)`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CaptureFrame {
    /// Origin of the dataset, in the units of the capture.
    pub offset: [f64; 3],
    /// Dataset units per unit of the capture.
    pub scale: f64,
}

impl Default for CaptureFrame {
    fn default() -> Self {
        Self { offset: [0.0; 3], scale: 1.0 }
    }
}

impl CaptureFrame {
    /// True when the dataset has the coordinates of its capture.
    #[must_use]
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// True when the frame can be used: finite numbers, a scale above 0.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.offset.iter().all(|value| value.is_finite()) && self.scale.is_normal() && self.scale > 0.0
    }

    /// A point of the capture in the dataset.
    #[must_use]
    pub fn dataset_from_capture(&self, point: DVec3) -> DVec3 {
        self.scale * (point - DVec3::from(self.offset))
    }

    /// A point of the dataset in the capture.
    #[must_use]
    pub fn capture_from_dataset(&self, point: DVec3) -> DVec3 {
        point / self.scale + DVec3::from(self.offset)
    }

    /// A camera of the capture in the dataset: it sees the same picture, in other units of depth.
    #[must_use]
    pub fn camera(&self, camera: &PinholeCamera) -> PinholeCamera {
        let RigidTransform { rotation, translation } = camera.camera_from_world;
        let translation = self.scale * (rotation * DVec3::from(self.offset) + translation);
        PinholeCamera { camera_from_world: RigidTransform { rotation, translation }, ..*camera }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec2};

    use super::*;

    #[test]
    fn cameras_see_the_same_picture_in_the_frame() {
        let frame = CaptureFrame { offset: [3e4, -2e4, 1e4], scale: 1e-3 };
        let camera = PinholeCamera {
            width: 40,
            height: 30,
            focal_px: DVec2::new(42.0, 40.0),
            principal_px: DVec2::new(20.0, 15.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(-0.2),
                translation: DVec3::new(-2.5e4, 1.8e4, -2e4),
            },
        };
        let point =
            camera.centre() + camera.camera_from_world.inverse().rotation * DVec3::new(100.0, -50.0, 900.0);
        let (pixel, depth) = camera.project(point).unwrap();
        let (same, closer) = frame.camera(&camera).project(frame.dataset_from_capture(point)).unwrap();
        assert!((pixel - same).length() < 1e-8, "{pixel} {same}");
        assert!((closer / depth / frame.scale - 1.0).abs() < 1e-9);
        let back = frame.capture_from_dataset(frame.dataset_from_capture(point));
        assert!((back - point).length() < 1e-9);
    }
}
