//! Every difference between our conventions and USD's, in one place.
//!
//! | quantity | ours | USD |
//! |---|---|---|
//! | quaternion arrays | (w, x, y, z) | `GfQuatf` memory: (x, y, z, w); text: (w, x, y, z) |
//! | matrices | column vectors, `[row][column]` | row vectors: the transpose |
//! | cameras | x right, y down, z forward | x right, y up, -z forward |
//! | apertures, focal length | pixels | tenths of a world unit |
//! | world axes | as captured | the same; only declared |

use cif_geometry::{PinholeCamera, RigidTransform};
use cif_scene::UpAxis;
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Film width that cameras are given, metres: a full-frame sensor.
pub const FILM_WIDTH_METERS: f64 = 0.036;
/// Nearest drawn depth, metres.
pub const NEAR_METERS: f64 = 0.01;
/// Farthest drawn depth, metres.
pub const FAR_METERS: f64 = 10_000.0;

/// Quaternions in the memory order of `GfQuatf`.
#[must_use]
pub fn quaternion_memory_order(quaternions: &[[f32; 4]]) -> Vec<[f32; 4]> {
    quaternions.iter().map(|&[w, x, y, z]| [x, y, z, w]).collect()
}

/// Token of an up axis.
#[must_use]
pub fn up_axis_token(axis: UpAxis) -> &'static str {
    match axis {
        UpAxis::Y => "Y",
        UpAxis::Z => "Z",
    }
}

/// `[row][column]` for column vectors from the rows of a `GfMatrix4d`.
#[must_use]
pub fn column_vector_matrix(gf: [[f64; 4]; 4]) -> [[f64; 4]; 4] {
    std::array::from_fn(|row| std::array::from_fn(|column| gf[column][row]))
}

/// Pose and lens of a camera, as `UsdGeomCamera` stores them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UsdCamera {
    /// Camera centre, world.
    pub translation: DVec3,
    /// Camera axes in the world: x right, y up, -z forward.
    pub rotation: DQuat,
    /// Focal length, tenths of a world unit.
    pub focal_length: f64,
    /// Film size (width, height), tenths of a world unit.
    pub aperture: DVec2,
    /// Shift of the film against the optical axis, tenths of a world unit; y up.
    pub aperture_offset: DVec2,
    /// Nearest and farthest drawn depth, world units.
    pub clipping_range: DVec2,
}

/// Turns the camera frame (y down, z forward) into USD's (y up, z backward), and back.
const FLIP: DMat3 = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);

/// A pinhole camera as USD holds it. One focal length serves both axes; unequal pixels go into the aperture.
#[must_use]
pub fn usd_camera(camera: &PinholeCamera, meters_per_unit: f64) -> UsdCamera {
    let world_from_camera = camera.camera_from_world.inverse();
    let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
    let width = FILM_WIDTH_METERS / meters_per_unit * 10.0;
    let focal_length = camera.focal_px.x * width / size.x;
    // Film units per pixel, on each axis.
    let per_pixel = focal_length / camera.focal_px;
    let shift = size / 2.0 - camera.principal_px;
    UsdCamera {
        translation: world_from_camera.translation,
        rotation: DQuat::from_mat3(&(world_from_camera.rotation * FLIP)).normalize(),
        focal_length,
        aperture: size * per_pixel,
        aperture_offset: DVec2::new(shift.x, -shift.y) * per_pixel,
        clipping_range: DVec2::new(NEAR_METERS, FAR_METERS) / meters_per_unit,
    }
}

/// The pinhole camera of a USD camera, at an image width; the inverse of [`usd_camera`].
#[must_use]
pub fn pinhole_camera(camera: &UsdCamera, width: u32) -> PinholeCamera {
    let pixels_per_unit = f64::from(width) / camera.aperture.x;
    let height = (camera.aperture.y * pixels_per_unit).round().max(1.0);
    let per_pixel = camera.aperture / DVec2::new(f64::from(width), height);
    let shift = DVec2::new(camera.aperture_offset.x, -camera.aperture_offset.y) / per_pixel;
    let world_from_camera = RigidTransform {
        rotation: DMat3::from_quat(camera.rotation) * FLIP,
        translation: camera.translation,
    };
    PinholeCamera {
        width,
        height: height as u32,
        focal_px: DVec2::splat(camera.focal_length) / per_pixel,
        principal_px: DVec2::new(f64::from(width), height) / 2.0 - shift,
        camera_from_world: world_from_camera.inverse(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> PinholeCamera {
        PinholeCamera {
            width: 640,
            height: 480,
            focal_px: DVec2::new(500.0, 500.0),
            principal_px: DVec2::new(300.0, 250.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::from_axis_angle(DVec3::new(1.0, 0.4, -0.2).normalize(), 1.1),
                translation: DVec3::new(0.3, -0.2, 2.0),
            },
        }
    }

    /// Pixel of a world point by USD's own definition of a camera.
    fn project(usd: &UsdCamera, size: DVec2, point: DVec3) -> DVec2 {
        let p = usd.rotation.inverse() * (point - usd.translation);
        assert!(p.z < 0.0, "in front is -z");
        let film = usd.focal_length * DVec2::new(p.x, p.y) / -p.z;
        let from_left_bottom = (film - (usd.aperture_offset - usd.aperture / 2.0)) / usd.aperture;
        DVec2::new(from_left_bottom.x, 1.0 - from_left_bottom.y) * size
    }

    #[test]
    fn usd_sees_points_at_the_same_pixels() {
        for (focal, mpu) in [(DVec2::new(500.0, 500.0), 1.0), (DVec2::new(500.0, 450.0), 0.01)] {
            let ours = PinholeCamera { focal_px: focal, ..camera() };
            let usd = usd_camera(&ours, mpu);
            for offset in [DVec3::ZERO, DVec3::new(0.3, 0.2, -0.1), DVec3::new(-0.2, 0.25, 0.4)] {
                let point = ours.centre() + ours.forward() * 2.0 + offset;
                let (pixel, _) = ours.project(point).unwrap();
                let same = project(&usd, DVec2::new(640.0, 480.0), point);
                assert!((pixel - same).length() < 1e-9, "{pixel} {same}");
            }
            assert!((usd.aperture.x * mpu / 10.0 - FILM_WIDTH_METERS).abs() < 1e-12);
        }
    }

    #[test]
    fn cameras_round_trip() {
        let back = pinhole_camera(&usd_camera(&camera(), 1.0), 640);
        assert_eq!((back.width, back.height), (640, 480));
        assert!((back.focal_px - camera().focal_px).length() < 1e-9);
        assert!((back.principal_px - camera().principal_px).length() < 1e-9);
        let difference = back.camera_from_world.compose(&camera().camera_from_world.inverse());
        assert!(difference.translation.length() < 1e-12);
        assert!((difference.rotation - DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-12));
    }

    #[test]
    fn quaternions_and_matrices_are_reordered() {
        assert_eq!(quaternion_memory_order(&[[1.0, 2.0, 3.0, 4.0]]), [[2.0, 3.0, 4.0, 1.0]]);
        let mut gf = [[0.0; 4]; 4];
        gf[3][1] = 5.0; // USD keeps the translation in the last row.
        assert_eq!(column_vector_matrix(gf)[1][3], 5.0);
    }
}
