//! The plane that objects stand on, among the points of the capture, or among those below the objects.

use glam::{DMat3, DVec3};
use nalgebra::Matrix3;
use rand::RngExt;
use rand_pcg::Pcg64;

use super::view::median;

/// Draws of three points.
const DRAWS: usize = 400;

/// Points below which no plane is looked for.
const FEWEST: usize = 100;

/// Share of the points that a plane must have.
const LEAST_SHARE: f64 = 0.3;

/// Distance from a plane within which rough points are on it, of that from the cameras, and the least standard deviation
/// along it, of that distance.
const ROUGH: f64 = 0.01;
const SPREAD: f64 = 5.0;

/// Cosine of the angle between a plane of rough points and the way up, from which objects can stand on it.
const LEVEL: f64 = 0.3;

/// `normal . X = offset`, the normal towards the cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Plane {
    pub(crate) normal: DVec3,
    pub(super) offset: f64,
}

impl Plane {
    /// Height of a point above it.
    pub(crate) fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.offset
    }

    /// The same plane, its normal towards most of the cameras.
    fn towards(self, cameras: &[DVec3]) -> Self {
        let above: f64 = cameras.iter().map(|camera| self.height(*camera)).sum();
        if above < 0.0 { Self { normal: -self.normal, offset: -self.offset } } else { self }
    }

    /// Parameter of a ray where it is `height` above the plane; `None` where it does not come down to it.
    pub(super) fn meet(&self, origin: DVec3, ray: DVec3, height: f64) -> Option<f64> {
        let slope = self.normal.dot(ray);
        (slope < -1e-6).then(|| (self.offset + height - self.normal.dot(origin)) / slope)
    }
}

/// The plane of most points, by random draws and three rounds of least squares; `None` where no plane has enough of
/// them.
pub(super) fn support(points: &[DVec3], cameras: &[DVec3], tolerance: f64, mut rng: Pcg64) -> Option<Plane> {
    if points.len() < FEWEST {
        return None;
    }
    let near = |plane: &Plane| points.iter().filter(|point| plane.height(**point).abs() < tolerance).count();
    let mut plane = drawn(points, &mut rng, |plane| -(near(plane) as f64))?;
    for _ in 0..3 {
        (plane, _) = fitted(points, &plane, tolerance)?;
    }
    (near(&plane) as f64 >= LEAST_SHARE * points.len() as f64).then(|| plane.towards(cameras))
}

/// The plane of rough points, as structure from motion gives them; `None` where no plane has enough of them, where these
/// lie on a line, or where nothing can stand on it.
pub(super) fn rough_support(points: &[DVec3], cameras: &[DVec3], up: DVec3, rng: Pcg64) -> Option<Plane> {
    let camera = cameras.iter().sum::<DVec3>() / cameras.len().max(1) as f64;
    let tolerance =
        ROUGH * median(&mut points.iter().map(|point| point.distance(camera)).collect::<Vec<_>>());
    let plane = support(points, cameras, tolerance, rng)?;
    let (_, spread) = fitted(points, &plane, tolerance)?;
    (spread > SPREAD * tolerance && plane.normal.dot(up) > LEVEL).then_some(plane)
}

/// The best of the planes through three points that are drawn, by the smallest score.
fn drawn(points: &[DVec3], rng: &mut Pcg64, score: impl Fn(&Plane) -> f64) -> Option<Plane> {
    let mut best: Option<(f64, Plane)> = None;
    for _ in 0..DRAWS {
        let [a, b, c] = std::array::from_fn(|_| points[rng.random_range(0..points.len())]);
        let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
        let plane = Plane { normal, offset: normal.dot(a) };
        let score = score(&plane);
        if best.as_ref().is_none_or(|(least, _)| score < *least) {
            best = Some((score, plane));
        }
    }
    best.map(|(_, plane)| plane)
}

/// The plane by least squares of the points within a distance of another, and the standard deviation of these along its
/// shorter axis.
fn fitted(points: &[DVec3], plane: &Plane, distance: f64) -> Option<(Plane, f64)> {
    let inside: Vec<DVec3> =
        points.iter().copied().filter(|point| plane.height(*point).abs() < distance).collect();
    let count = inside.len().max(1) as f64;
    let centre = inside.iter().sum::<DVec3>() / count;
    let mut scatter = DMat3::ZERO;
    for point in &inside {
        let d = *point - centre;
        scatter += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let eigen = Matrix3::from_column_slice(&scatter.to_cols_array()).symmetric_eigen();
    let axis = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let normal = DVec3::new(axis[0], axis[1], axis[2]).try_normalize()?;
    let mut values: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
    let spread = (median(&mut values) / count).max(0.0).sqrt();
    Some((Plane { normal, offset: normal.dot(centre) }, spread))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};

    const CAMERAS: [DVec3; 2] = [DVec3::new(0.0, -2.0, 1.0), DVec3::new(0.5, -2.0, 1.2)];

    /// Points of a floor that scatter, and a third as many above it.
    fn rough(scatter: f64) -> Vec<DVec3> {
        let mut rng = stream(0, Purpose::Objects, 2);
        let mut any = |size: f64| size * (2.0 * rng.random::<f64>() - 1.0);
        let floor: Vec<DVec3> = (0..300).map(|_| DVec3::new(any(1.0), any(0.5), any(scatter))).collect();
        let above = (0..100).map(|_| DVec3::new(any(1.0), any(0.5), 0.1 + any(0.1)));
        floor.into_iter().chain(above.collect::<Vec<_>>()).collect()
    }

    #[test]
    fn points_that_scatter_tell_a_plane_that_strict_ones_do_not() {
        let rng = || stream(0, Purpose::Objects, 0);
        let points = rough(0.01);
        assert_eq!(support(&points, &CAMERAS, 0.002, rng()), None);
        let plane = rough_support(&points, &CAMERAS, DVec3::Z, rng()).unwrap();
        assert!(plane.normal.z > 0.999 && plane.height(DVec3::ZERO).abs() < 0.004, "{plane:?}");
        // A wall, a cloud, a line, and too few.
        assert_eq!(rough_support(&points, &CAMERAS, DVec3::Y, rng()), None);
        assert_eq!(rough_support(&rough(0.3), &CAMERAS, DVec3::Z, rng()), None);
        let line: Vec<DVec3> =
            points.iter().map(|point| DVec3::new(point.x, 0.01 * point.y, point.z)).collect();
        assert_eq!(rough_support(&line, &CAMERAS, DVec3::Z, rng()), None);
        assert_eq!(rough_support(&points[..50], &CAMERAS, DVec3::Z, rng()), None);
    }
}
