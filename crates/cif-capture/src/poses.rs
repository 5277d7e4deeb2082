//! Cameras of the images of a capture, and the points that they were found by.

use std::collections::BTreeMap;

use cif_geometry::{LensDistortion, RigidTransform};
use glam::DVec3;

/// A lens that images share.
#[derive(Clone, Debug, PartialEq)]
pub struct Lens {
    /// Width and height that the numbers are of, pixels.
    pub size: (u32, u32),
    /// Focal lengths, pixels.
    pub focal_px: [f64; 2],
    /// Principal point; the centre of the first pixel is at (0.5, 0.5).
    pub principal_px: [f64; 2],
    /// Distortion.
    pub distortion: LensDistortion,
}

impl Lens {
    /// The lens for images of another size: poses of other tools may be of larger ones.
    #[must_use]
    pub fn scaled(&self, size: (u32, u32)) -> Self {
        let [x, y] = [f64::from(size.0) / f64::from(self.size.0), f64::from(size.1) / f64::from(self.size.1)];
        Self {
            size,
            focal_px: [self.focal_px[0] * x, self.focal_px[1] * y],
            principal_px: [self.principal_px[0] * x, self.principal_px[1] * y],
            distortion: self.distortion,
        }
    }
}

#[cfg(test)]
impl Lens {
    /// A lens of small pictures.
    pub(crate) fn small() -> Self {
        Self {
            size: (64, 48),
            focal_px: [60.0; 2],
            principal_px: [32.0, 24.0],
            distortion: LensDistortion::default(),
        }
    }
}

/// Where an image was taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Which of [`Poses::lenses`].
    pub lens: usize,
    /// Camera to world; the camera looks along +z with x right and y down.
    pub world_from_camera: RigidTransform,
    /// Points that tie the image to others; 0 where nothing tells.
    pub points: usize,
}

/// A point of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// In the world.
    pub position: DVec3,
    /// Display-referred.
    pub color: [u8; 3],
}

/// Cameras of images by name, and points, in one world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Poses {
    /// Lenses.
    pub lenses: Vec<Lens>,
    /// Images that have a pose, by [`crate::frames::Shot::name`].
    pub images: BTreeMap<String, Pose>,
    /// Sparse points.
    pub points: Vec<Point>,
    /// Mean distance between where points are seen and where they project, pixels.
    pub reprojection_px: Option<f64>,
}

impl Poses {
    /// Moves everything by a similarity: `x -> scale * rotation * x + translation`.
    pub fn transform(&mut self, similarity: &crate::similarity::Similarity) {
        for pose in self.images.values_mut() {
            pose.world_from_camera = similarity.camera(&pose.world_from_camera);
        }
        for point in &mut self.points {
            point.position = similarity.apply(point.position);
        }
    }

    /// Root mean square distance of the cameras from their middle.
    #[must_use]
    pub fn spread(&self) -> f64 {
        let places: Vec<DVec3> =
            self.images.values().map(|pose| pose.world_from_camera.translation).collect();
        crate::similarity::spread(&places)
    }
}
