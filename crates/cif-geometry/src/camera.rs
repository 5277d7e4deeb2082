//! Ideal pinhole cameras. Lenses and skew are removed when a capture is read (see [`crate::lens`]).

use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::RigidTransform;

/// Most columns, and most rows, of an image.
pub const MAX_IMAGE_SIDE: u32 = 1 << 16;

/// Most pixels of an image: 16 384 x 16 384, of which colours in single precision take 3 GiB.
pub const MAX_IMAGE_PIXELS: u64 = 1 << 28;

/// Refuses sizes that no image of cif has: none or more than [`MAX_IMAGE_SIDE`] columns or rows, more than
/// [`MAX_IMAGE_PIXELS`] pixels. Called on sizes from a file or a caller before memory is taken for pixels.
///
/// # Errors
/// The problem, with the size and the limit.
pub fn check_image_size(width: u32, height: u32) -> Result<(), String> {
    let pixels = u64::from(width) * u64::from(height);
    if pixels == 0 {
        Err(format!("an image of {width} x {height} pixels has none"))
    } else if width.max(height) > MAX_IMAGE_SIDE {
        Err(format!(
            "an image of {width} x {height} pixels has a side of {}, more than the {MAX_IMAGE_SIDE} that are possible",
            width.max(height)
        ))
    } else if pixels > MAX_IMAGE_PIXELS {
        Err(format!(
            "an image of {width} x {height} pixels has {pixels}, more than the {MAX_IMAGE_PIXELS} (as of 16384 x \
             16384) that are possible"
        ))
    } else {
        Ok(())
    }
}

/// A pinhole camera without skew or distortion.
///
/// `pixel = focal_px * (x / z, y / z) + principal_px` for a point (x, y, z) in the camera frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PinholeCamera {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Focal lengths (fx, fy), pixels.
    pub focal_px: DVec2,
    /// Principal point (cx, cy), pixels; the centre of the first pixel is (0.5, 0.5).
    pub principal_px: DVec2,
    /// World to camera, metres.
    #[doc(alias = "viewmat")]
    #[doc(alias = "w2c")]
    pub camera_from_world: RigidTransform,
}

impl PinholeCamera {
    /// Camera centre in the world.
    #[must_use]
    pub fn centre(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }

    /// The camera on the path to another one: the shortest turn, a straight line of centres and intermediate
    /// intrinsics, `ratio` being 0 here and 1 there. Image sizes are those of this one.
    #[must_use]
    pub fn toward(&self, other: &Self, ratio: f64) -> Self {
        let poses = [self, other].map(|camera| camera.camera_from_world.inverse());
        let [from, to] = poses.map(|pose| DQuat::from_mat3(&pose.rotation));
        let world_from_camera = RigidTransform {
            rotation: DMat3::from_quat(from.slerp(to, ratio)),
            translation: poses[0].translation.lerp(poses[1].translation, ratio),
        };
        Self {
            focal_px: self.focal_px.lerp(other.focal_px, ratio),
            principal_px: self.principal_px.lerp(other.principal_px, ratio),
            camera_from_world: world_from_camera.inverse(),
            ..*self
        }
    }

    /// Viewing direction (camera +z) in the world, unit.
    #[must_use]
    pub fn forward(&self) -> DVec3 {
        self.camera_from_world.rotation.row(2)
    }

    /// Pixel position and depth z of a world point; `None` at or behind the camera plane.
    #[must_use]
    pub fn project(&self, point_in_world: DVec3) -> Option<(DVec2, f64)> {
        let p = self.camera_from_world.apply(point_in_world);
        (p.z > 0.0).then(|| (self.focal_px * DVec2::new(p.x, p.y) / p.z + self.principal_px, p.z))
    }

    /// Column and row of the pixel that shows a world point; `None` where it is behind the camera or beyond the
    /// image.
    #[must_use]
    pub fn pixel_of(&self, point_in_world: DVec3) -> Option<[u32; 2]> {
        let (pixel, _) = self.project(point_in_world)?;
        let size = DVec2::new(f64::from(self.width), f64::from(self.height));
        let inside = pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all();
        inside.then_some([pixel.x as u32, pixel.y as u32])
    }

    /// World-space direction (not normalised, z = 1 in the camera frame) through a pixel position.
    #[must_use]
    pub fn ray(&self, pixel: DVec2) -> DVec3 {
        let xy = (pixel - self.principal_px) / self.focal_px;
        self.camera_from_world.rotation.transpose() * DVec3::new(xy.x, xy.y, 1.0)
    }

    /// The same view at another resolution; pixels are scaled, the field of view is kept.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let factor =
            DVec2::new(f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self {
            width,
            height,
            focal_px: self.focal_px * factor,
            principal_px: self.principal_px * factor,
            camera_from_world: self.camera_from_world,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> PinholeCamera {
        PinholeCamera {
            width: 64,
            height: 48,
            focal_px: DVec2::new(50.0, 55.0),
            principal_px: DVec2::new(30.0, 25.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::from_rotation_y(0.3),
                translation: DVec3::new(0.1, 0.2, 2.0),
            },
        }
    }

    #[test]
    fn cameras_in_between_see_what_both_look_at() {
        let point = DVec3::new(0.1, -0.2, 0.3);
        let around = |angle: f64| {
            let rotation = DMat3::from_rotation_y(angle);
            let camera_from_world =
                RigidTransform { rotation, translation: DVec3::Z * 2.0 - rotation * point };
            PinholeCamera { camera_from_world, ..camera() }
        };
        let (from, to) = (around(-0.2), around(0.4));
        let between = from.toward(&to, 0.5);
        let (pixel, depth) = between.project(point).unwrap();
        assert!((pixel - camera().principal_px).length() < 1e-9 && depth < 2.0 && depth > 1.8);
        assert!((between.centre() - (from.centre() + to.centre()) / 2.0).length() < 1e-12);
        let same = from.toward(&to, 0.0);
        assert!(
            (same.centre() - from.centre()).length() < 1e-12
                && (same.forward() - from.forward()).length() < 1e-9
        );
    }

    #[test]
    fn ray_passes_through_the_projected_point() {
        let camera = camera();
        let point = DVec3::new(0.4, -0.3, 1.5);
        let (pixel, depth) = camera.project(point).unwrap();
        assert!((camera.centre() + camera.ray(pixel) * depth - point).length() < 1e-12);
    }

    #[test]
    fn a_pixel_shows_what_lies_before_it_only() {
        let camera = camera();
        let along = |pixel, depth| camera.centre() + camera.ray(pixel) * depth;
        assert_eq!(camera.pixel_of(along(DVec2::new(63.9, 0.1), 2.0)), Some([63, 0]));
        assert_eq!(camera.pixel_of(along(DVec2::new(64.1, 0.1), 2.0)), None);
        assert_eq!(camera.pixel_of(along(DVec2::new(63.9, -0.1), 2.0)), None);
        assert_eq!(camera.pixel_of(along(DVec2::new(31.5, 20.5), -2.0)), None);
    }

    #[test]
    fn images_have_pixels_within_limits() {
        for (width, height) in [(1, 1), (1920, 1080), (65_536, 4096), (16_384, 16_384), (1, 65_536)] {
            assert_eq!(check_image_size(width, height), Ok(()), "{width} x {height}");
        }
        for (width, height, reason) in [
            (0, 48, "0 x 48 pixels has none"),
            (60_000, 60_000, "has 3600000000, more than the 268435456"),
            (65_537, 1, "a side of 65537, more than the 65536"),
            (u32::MAX, u32::MAX, "a side of 4294967295"),
        ] {
            let problem = check_image_size(width, height).unwrap_err();
            assert!(problem.contains(reason), "{problem}");
        }
    }

    #[test]
    fn resizing_scales_pixels() {
        let camera = camera();
        let point = DVec3::new(0.4, -0.3, 1.5);
        let (pixel, _) = camera.project(point).unwrap();
        let (half, _) = camera.resized(32, 24).project(point).unwrap();
        assert!((pixel / 2.0 - half).length() < 1e-12);
    }

    #[test]
    fn points_behind_do_not_project() {
        assert!(camera().project(DVec3::new(0.0, 0.0, -5.0)).is_none());
    }
}
