//! Random points for captures that bring none.

use cif_geometry::rays::nearest_point;
use cif_geometry::{PinholeCamera, Ray};
use glam::{DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Points drawn in a customary box (methods reference 1.1).
const IN_BOX: usize = 2_000;

/// Points drawn where the cameras look.
const IN_VIEW: usize = 10_000;

/// Draws per requested point before giving up on unseen places.
const ATTEMPTS: usize = 50;

/// The same capture always gets the same points.
const SEED: u64 = 0x5eed;

/// Uniform random points that at least one camera sees.
///
/// With `half_edge`, 2 000 points in the box of that half edge around the origin, as synthetic captures have
/// it. Otherwise 10 000 points in a box around the place that the cameras look at, as wide as what they see
/// there. Fewer when the cameras see little of the box; the whole box when they see nothing of it.
pub(crate) fn draw(cameras: &[PinholeCamera], half_edge: Option<f64>) -> Vec<[f64; 3]> {
    let (centre, half, count) = match half_edge {
        Some(half) => (DVec3::ZERO, half, IN_BOX),
        None => {
            let (centre, half) = viewed_box(cameras);
            (centre, half, IN_VIEW)
        }
    };
    let mut random = Pcg64Mcg::seed_from_u64(SEED);
    let mut uniform = || {
        let unit: [f64; 3] = random.random();
        centre + half * (2.0 * DVec3::from_array(unit) - 1.0)
    };
    let mut points = Vec::with_capacity(count);
    for _ in 0..count * ATTEMPTS {
        if points.len() == count {
            break;
        }
        let point = uniform();
        if cameras.iter().any(|camera| camera.pixel_of(point).is_some()) {
            points.push(point.to_array());
        }
    }
    if points.is_empty() {
        points.extend((0..count).map(|_| uniform().to_array()));
    }
    points
}

/// Centre and half edge of the box that the cameras look at.
///
/// The centre is the point nearest to all optical axes (least squares); where axes are parallel or meet behind
/// a camera, a point ahead of the mean camera. The half edge is the half width of the widest view there.
fn viewed_box(cameras: &[PinholeCamera]) -> (DVec3, f64) {
    let count = cameras.len().max(1) as f64;
    let mean: DVec3 = cameras.iter().map(PinholeCamera::centre).sum::<DVec3>() / count;
    let spread = cameras.iter().map(|camera| camera.centre().distance(mean)).fold(0.0, f64::max);
    let axes = cameras.iter().map(|camera| (Ray::new(camera.centre(), camera.forward()), 1.0));
    let crossing = nearest_point(axes, 1e-6 * count.powi(3));
    let ahead = |point: &DVec3| {
        point.is_finite() && cameras.iter().all(|camera| camera.forward().dot(*point - camera.centre()) > 0.0)
    };
    let centre = crossing.filter(ahead).unwrap_or_else(|| {
        let direction: DVec3 = cameras.iter().map(PinholeCamera::forward).sum();
        let distance = if spread > 0.0 { 3.0 * spread } else { 1.0 };
        mean + direction.try_normalize().unwrap_or(DVec3::Z) * distance
    });
    let half = cameras
        .iter()
        .map(|camera| {
            let view =
                DVec2::new(f64::from(camera.width), f64::from(camera.height)) / (2.0 * camera.focal_px);
            view.max_element() * camera.forward().dot(centre - camera.centre()).abs()
        })
        .fold(0.0, f64::max);
    (centre, if half > 0.0 && half.is_finite() { half } else { 1.0 })
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;
    use glam::DMat3;

    use super::*;

    fn camera_at(centre: DVec3, target: DVec3) -> PinholeCamera {
        let forward = (target - centre).try_normalize().unwrap();
        let right = DVec3::Y.cross(forward).try_normalize().unwrap();
        let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
        PinholeCamera {
            width: 40,
            height: 30,
            focal_px: DVec2::splat(40.0),
            principal_px: DVec2::new(20.0, 15.0),
            camera_from_world: RigidTransform { rotation, translation: -(rotation * centre) },
        }
    }

    #[test]
    fn points_lie_where_the_cameras_look() {
        let target = DVec3::new(1.0, 2.0, 3.0);
        let cameras: Vec<_> = [DVec3::X, -DVec3::X, DVec3::Z, -DVec3::Z]
            .iter()
            .map(|offset| camera_at(target + *offset * 4.0, target))
            .collect();
        let (centre, half) = viewed_box(&cameras);
        assert!(centre.distance(target) < 1e-9 && (half - 2.0).abs() < 1e-9, "{centre} {half}");
        let points = draw(&cameras, None);
        assert_eq!(points.len(), IN_VIEW);
        assert_eq!(points, draw(&cameras, None));
        for p in &points {
            assert!((DVec3::from_array(*p) - target).abs().max_element() < 2.0 + 1e-5);
        }
    }

    #[test]
    fn parallel_cameras_still_get_points() {
        let cameras: Vec<_> = (0..3)
            .map(|k| camera_at(DVec3::new(f64::from(k), 0.0, 0.0), DVec3::new(f64::from(k), 0.0, 9.0)))
            .collect();
        assert!(!draw(&cameras, None).is_empty());
        assert!(!draw(&cameras[..1], None).is_empty());
    }

    #[test]
    fn a_customary_box_is_clipped_to_the_views() {
        let cameras = [camera_at(DVec3::new(0.0, 0.0, -2.0), DVec3::ZERO)];
        let points = draw(&cameras, Some(1.3));
        assert_eq!(points.len(), IN_BOX);
        assert!(points.iter().flatten().all(|v| v.abs() <= 1.3));
        // Looking away: nothing of the box is seen, but there are points.
        let away = [camera_at(DVec3::new(0.0, 0.0, -2.0), DVec3::new(0.0, 0.0, -9.0))];
        assert_eq!(draw(&away, Some(1.3)).len(), IN_BOX);
    }
}
