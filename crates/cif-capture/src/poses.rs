//! Cameras of the images of a capture, and the points that they were found by.

use std::collections::BTreeMap;

use cif_geometry::{LensDistortion, RigidTransform};
use glam::{DMat3, DVec3};

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

    /// The lens of the image turned clockwise by a quarter; without skew.
    fn turned(&self) -> Self {
        let [p1, p2] = self.distortion.tangential;
        Self {
            size: (self.size.1, self.size.0),
            focal_px: [self.focal_px[1], self.focal_px[0]],
            principal_px: [f64::from(self.size.1) - self.principal_px[1], self.principal_px[0]],
            // (p2, p1) is a direction in the image, and turns with it.
            distortion: LensDistortion { tangential: [p2, -p1], ..self.distortion },
        }
    }
}

/// Lens and place of a camera, in the world, for its image turned clockwise by quarters: the same rays.
pub(crate) fn turned(
    lens: &Lens,
    world_from_camera: RigidTransform,
    quarters: u32,
) -> (Lens, RigidTransform) {
    // What was right of the image is below, what was below is left.
    let stored_from_turned = DMat3::from_cols(-DVec3::Y, DVec3::X, DVec3::Z);
    (0..quarters).fold((lens.clone(), world_from_camera), |(lens, pose), _| {
        (lens.turned(), RigidTransform { rotation: pose.rotation * stored_from_turned, ..pose })
    })
}

/// Root mean square distance of places from their mean.
pub(crate) fn spread(places: &[DVec3]) -> f64 {
    let middle = places.iter().sum::<DVec3>() / places.len().max(1) as f64;
    let sum: f64 = places.iter().map(|place| place.distance_squared(middle)).sum();
    (sum / places.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    #[test]
    fn a_turned_camera_sees_the_turned_image() {
        let lens = Lens {
            size: (64, 48),
            focal_px: [60.0, 55.0],
            principal_px: [30.0, 25.0],
            distortion: LensDistortion {
                radial: [-0.1, 0.02, 0.0, 0.0],
                tangential: [0.01, -0.02],
                skew_px: 0.0,
            },
        };
        let place = RigidTransform {
            rotation: DMat3::from_rotation_y(0.3) * DMat3::from_rotation_x(0.2),
            translation: DVec3::new(1.0, 2.0, 3.0),
        };
        let pixel = |(lens, place): &(Lens, RigidTransform), point: DVec3| {
            let p = place.inverse().apply(point);
            let p = lens.distortion.distort(DVec2::new(p.x, p.y) / p.z);
            p * DVec2::from_array(lens.focal_px) + DVec2::from_array(lens.principal_px)
        };
        let point = place.apply(DVec3::new(0.3, -0.2, 1.5));
        let stored = pixel(&turned(&lens, place, 0), point);
        for (quarters, expected) in [
            (1, DVec2::new(48.0 - stored.y, stored.x)),
            (2, DVec2::new(64.0 - stored.x, 48.0 - stored.y)),
            (3, DVec2::new(stored.y, 64.0 - stored.x)),
        ] {
            let found = pixel(&turned(&lens, place, quarters), point);
            assert!((found - expected).length() < 1e-9, "{quarters}: {found} {expected}");
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
    /// Points that tie the image to others; 0 where that is not known.
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
    pub fn transform(&mut self, similarity: &cif_geometry::Similarity) {
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
        spread(&places)
    }
}
