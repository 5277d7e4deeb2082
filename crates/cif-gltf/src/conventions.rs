//! Every difference between our conventions and glTF's, in one place.
//!
//! | quantity | ours | glTF |
//! |---|---|---|
//! | world | up axis declared, `meters_per_unit`, `frame` | +y up, metres: the node [`WORLD`] turns, scales and places what is below it |
//! | quaternions | (w, x, y, z) | (x, y, z, w) |
//! | time | time codes | seconds since the first time code |
//! | cameras | x right, y down, z forward; pixels | x right, y up, -z forward; vertical angle and aspect |
//! | colours of points | display-referred sRGB | linear |
//! | hidden | visibility samples | `KHR_node_visibility`, animated through `KHR_animation_pointer`; for players that know neither scale [`HIDDEN_SCALE`], stepped |
//!
//! Data below the node `World` stays in the axes and units it was trained in, so that neither splats nor their
//! spherical harmonics are touched on the way out.

use cif_geometry::{PinholeCamera, RigidTransform};
use cif_scene::{CaptureFrame, UpAxis};
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Name of the node that everything hangs from.
pub const WORLD: &str = "World";
/// Scale of a node that cannot be seen: 0 has no inverse and some engines show such nodes unscaled.
pub const HIDDEN_SCALE: f32 = 1e-6;
/// Nearest drawn depth, metres.
pub const NEAR_METERS: f64 = 0.01;
/// Height in pixels that cameras without a recorded resolution are given.
pub const DEFAULT_CAMERA_HEIGHT: u32 = 720;

/// Turns the camera frame (y down, z forward) into glTF's (y up, z backward), and back.
const FLIP: DMat3 = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);

/// Rotation (x, y, z, w) that brings an up axis to +y.
#[must_use]
pub fn world_rotation(up_axis: UpAxis) -> [f32; 4] {
    match up_axis {
        UpAxis::Y => [0.0, 0.0, 0.0, 1.0],
        UpAxis::Z => [-std::f32::consts::FRAC_1_SQRT_2, 0.0, 0.0, std::f32::consts::FRAC_1_SQRT_2],
    }
}

/// Pose of the root node: what brings the frame of a scene into glTF's world (metres, +y up).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RootPose {
    /// Metres.
    pub translation: DVec3,
    /// As [`world_rotation`].
    pub rotation: DQuat,
    /// Metres per unit of the scene.
    pub scale: f64,
}

/// The pose of the root node of a scene that lies so in the world of its capture.
#[must_use]
pub fn gltf_from_scene(up_axis: UpAxis, meters_per_unit: f64, frame: &CaptureFrame) -> RootPose {
    let rotation = DQuat::from_array(world_rotation(up_axis).map(f64::from)).normalize();
    RootPose {
        translation: rotation * (meters_per_unit * DVec3::from(frame.offset)),
        rotation,
        scale: meters_per_unit / frame.scale,
    }
}

/// (x, y, z, w) in single precision.
#[must_use]
pub fn gltf_quaternion(rotation: DQuat) -> [f32; 4] {
    rotation.to_array().map(|value| value as f32)
}

/// The rotation that (x, y, z, w) stands for; `None` for a quaternion of no length or with values that are not
/// finite. Numbers that are of unit length up to single precision are taken as they are.
#[must_use]
pub fn rotation(xyzw: [f64; 4]) -> Option<DQuat> {
    let quaternion = DQuat::from_array(xyzw);
    let length = quaternion.length();
    if !length.is_finite() || length < cif_geometry::quaternion::MIN_NORM {
        return None;
    }
    Some(if (length - 1.0).abs() < 1e-6 { quaternion } else { quaternion.normalize() })
}

/// Seconds of a time code.
#[must_use]
pub fn seconds(time_code: f64, first: f64, frames_per_second: f64) -> f32 {
    ((time_code - first) / frames_per_second) as f32
}

/// Display-referred sRGB value in [0, 1] to linear light (IEC 61966-2-1).
#[must_use]
pub fn linear_from_srgb(value: f32) -> f32 {
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Pose of a camera as glTF holds it: centre, and rotation of its axes (x right, y up, -z forward).
#[must_use]
pub fn gltf_camera_pose(camera: &PinholeCamera) -> (DVec3, DQuat) {
    let world_from_camera = camera.camera_from_world.inverse();
    (world_from_camera.translation, DQuat::from_mat3(&(world_from_camera.rotation * FLIP)).normalize())
}

/// `camera_from_world` of a glTF camera pose.
#[must_use]
pub fn camera_from_world(translation: DVec3, rotation: DQuat) -> RigidTransform {
    let rotation = DMat3::from_quat(rotation.normalize()) * FLIP;
    RigidTransform { rotation, translation }.inverse()
}

/// Vertical angle of view (radians) and width over height of a camera; where the principal point lies is lost.
#[must_use]
pub fn perspective(width: u32, height: u32, focal_px: DVec2) -> (f64, f64) {
    let size = DVec2::new(f64::from(width), f64::from(height)) / focal_px;
    (2.0 * (size.y / 2.0).atan(), size.x / size.y)
}

/// Image size and focal lengths of a perspective camera that says only what glTF knows.
#[must_use]
pub fn intrinsics(yfov: f64, aspect: f64) -> (u32, u32, DVec2) {
    let height = DEFAULT_CAMERA_HEIGHT;
    let width = (f64::from(height) * aspect).round().clamp(1.0, 1e5) as u32;
    let focal_y = f64::from(height) / 2.0 / (yfov / 2.0).tan();
    (width, height, DVec2::new(focal_y * f64::from(width) / (f64::from(height) * aspect), focal_y))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> PinholeCamera {
        PinholeCamera {
            width: 640,
            height: 480,
            focal_px: DVec2::new(500.0, 450.0),
            principal_px: DVec2::new(320.0, 240.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::from_axis_angle(DVec3::new(1.0, 0.4, -0.2).normalize(), 1.1),
                translation: DVec3::new(0.3, -0.2, 2.0),
            },
        }
    }

    #[test]
    fn a_z_up_world_stands_upright() {
        let turn = DQuat::from_array(world_rotation(UpAxis::Z).map(f64::from));
        assert!((turn * DVec3::Z - DVec3::Y).length() < 1e-6);
        assert!((turn * DVec3::X - DVec3::X).length() < 1e-6);
        assert!((turn * DVec3::Y - DVec3::NEG_Z).length() < 1e-6, "right-handed");
    }

    #[test]
    fn gltf_sees_points_at_the_same_pixels() {
        let ours = camera();
        let (translation, rotation) = gltf_camera_pose(&ours);
        let (yfov, aspect) = perspective(640, 480, ours.focal_px);
        for offset in [DVec3::ZERO, DVec3::new(0.3, 0.2, -0.1), DVec3::new(-0.2, 0.25, 0.4)] {
            let point = ours.centre() + ours.forward() * 2.0 + offset;
            let (pixel, _) = ours.project(point).unwrap();
            // The projection of the glTF specification, section 3.10.3: y up, -z forward.
            let p = rotation.inverse() * (point - translation);
            let t = (yfov / 2.0).tan();
            let device = DVec2::new(p.x / (aspect * t), p.y / t) / -p.z;
            let same = DVec2::new((device.x + 1.0) / 2.0 * 640.0, (1.0 - device.y) / 2.0 * 480.0);
            assert!((pixel - same).length() < 1e-9, "{pixel} {same}");
        }
        let back = camera_from_world(translation, rotation).compose(&ours.camera_from_world.inverse());
        assert!(back.translation.length() < 1e-12);
        assert!((back.rotation - DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-12));
    }

    #[test]
    fn angles_and_focal_lengths_are_inverse() {
        let (width, height, focal) = intrinsics(0.8, 1.25);
        assert_eq!((width, height), (900, 720));
        let (yfov, aspect) = perspective(width, height, focal);
        assert!((yfov - 0.8).abs() < 1e-12 && (aspect - 1.25).abs() < 1e-12);
    }

    #[test]
    fn quaternions_without_a_direction_are_refused() {
        assert!(rotation([0.0; 4]).is_none());
        assert!(rotation([f64::NAN, 0.0, 0.0, 1.0]).is_none());
        assert_eq!(rotation([0.0, 0.0, 0.0, 2.0]).unwrap(), DQuat::IDENTITY);
    }
}
