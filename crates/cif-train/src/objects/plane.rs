//! The plane that objects stand on, among the points of the capture.

use glam::{DMat3, DVec3};
use nalgebra::Matrix3;
use rand::RngExt;
use rand_pcg::Pcg64;

/// Draws of three points.
const DRAWS: usize = 400;

/// Points below which no plane is looked for.
const FEWEST: usize = 100;

/// Share of the points that a plane must have.
const LEAST_SHARE: f64 = 0.3;

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
    let mut best: Option<(usize, Plane)> = None;
    for _ in 0..DRAWS {
        let [a, b, c] = std::array::from_fn(|_| points[rng.random_range(0..points.len())]);
        let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
        let plane = Plane { normal, offset: normal.dot(a) };
        let count = near(&plane);
        if best.as_ref().is_none_or(|(most, _)| count > *most) {
            best = Some((count, plane));
        }
    }
    let (_, mut plane) = best?;
    for _ in 0..3 {
        let inside: Vec<DVec3> =
            points.iter().copied().filter(|point| plane.height(*point).abs() < tolerance).collect();
        let centre = inside.iter().sum::<DVec3>() / inside.len().max(1) as f64;
        let mut scatter = DMat3::ZERO;
        for point in &inside {
            let d = *point - centre;
            scatter += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        }
        let eigen = Matrix3::from_column_slice(&scatter.to_cols_array()).symmetric_eigen();
        let smallest = eigen.eigenvalues.imin();
        let axis = eigen.eigenvectors.column(smallest);
        let normal = DVec3::new(axis[0], axis[1], axis[2]).try_normalize()?;
        plane = Plane { normal, offset: normal.dot(centre) };
    }
    let above: f64 = cameras.iter().map(|camera| plane.height(*camera)).sum();
    if above < 0.0 {
        plane = Plane { normal: -plane.normal, offset: -plane.offset };
    }
    (near(&plane) as f64 >= LEAST_SHARE * points.len() as f64).then_some(plane)
}
