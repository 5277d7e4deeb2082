//! Screen-space motion of Gaussians between two views, from which motion vectors are blended.

use cif_geometry::PinholeCamera;
use glam::{DVec2, DVec3};

/// Depth up to which a point that passes the camera is followed, metres.
const NEAR: f64 = 1e-3;

/// Screen motion of every point, pixels, x right and y down: from where `camera` sees `means` to where
/// `next_camera` sees `next_means`. A point that ends behind the next camera is followed, on a straight line in
/// the frame of the camera, up to the camera's plane; one that starts behind `camera` does not count and gets 0.
#[must_use]
pub fn screen_motion(
    camera: &PinholeCamera,
    means: &[[f32; 3]],
    next_camera: &PinholeCamera,
    next_means: &[[f32; 3]],
) -> Vec<[f32; 2]> {
    let point = |mean: &[f32; 3]| DVec3::from_array(mean.map(f64::from));
    let on_screen =
        |camera: &PinholeCamera, p: DVec3| camera.focal_px * p.truncate() / p.z + camera.principal_px;
    means
        .iter()
        .zip(next_means)
        .map(|(mean, next_mean)| {
            let start = camera.camera_from_world.apply(point(mean));
            let mut end = next_camera.camera_from_world.apply(point(next_mean));
            if start.z <= NEAR {
                return [0.0; 2];
            }
            if end.z < NEAR {
                end = start.lerp(end, (start.z - NEAR) / (start.z - end.z));
            }
            let motion: DVec2 = on_screen(next_camera, end) - on_screen(camera, start);
            motion.to_array().map(|value| value as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;
    use glam::DMat3;

    use super::*;

    fn camera(x: f64) -> PinholeCamera {
        PinholeCamera {
            width: 64,
            height: 48,
            focal_px: DVec2::new(50.0, 40.0),
            principal_px: DVec2::new(30.0, 25.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::IDENTITY,
                translation: DVec3::new(-x, 0.0, 0.0),
            },
        }
    }

    #[test]
    fn points_and_cameras_both_move_the_picture() {
        let mean = [[0.0, 0.0, 2.0]];
        let moved = screen_motion(&camera(0.0), &mean, &camera(0.0), &[[0.4, 0.1, 2.0]]);
        assert_eq!(moved, [[10.0, 2.0]]);
        let panned = screen_motion(&camera(0.0), &mean, &camera(0.4), &mean);
        assert_eq!(panned, [[-10.0, 0.0]]);
    }

    #[test]
    fn points_that_pass_the_camera_stay_finite() {
        let motion = screen_motion(&camera(0.0), &[[0.1, 0.0, 1.0]], &camera(0.0), &[[0.1, 0.0, -1.0]]);
        assert!(motion[0][0] > 100.0 && motion[0][0].is_finite(), "{motion:?}");
        assert_eq!(screen_motion(&camera(0.0), &[[0.1, 0.0, -1.0]], &camera(0.0), &[[0.0; 3]]), [[0.0; 2]]);
    }
}
