//! Rays, as lines in space: how far points are from them, and where several of them meet.

use glam::{DMat3, DVec2, DVec3};

use crate::PinholeCamera;
use crate::stats::median;

/// Determinant of the summed projections across rays below which [`meeting_point`] takes the rays as parallel.
const PARALLEL: f64 = 1e-9;

/// Fewest rays among which some may be found to miss the others.
const FEWEST_RAYS: usize = 4;

/// Most rays of which all pairs are tried.
const MOST_PAIRED: usize = 32;

/// Distance at which a ray counts half, of that of the middle ray.
const FAR: f64 = 3.0;

/// A ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it starts.
    pub origin: DVec3,
    /// Unit direction.
    pub direction: DVec3,
    across: DMat3,
}

impl Ray {
    /// The ray from a point in a unit direction.
    #[must_use]
    pub fn new(origin: DVec3, direction: DVec3) -> Self {
        let d = direction;
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        Self { origin, direction, across }
    }

    /// The ray from a camera through a pixel position.
    #[must_use]
    pub fn through(camera: &PinholeCamera, pixel: DVec2) -> Self {
        Self::new(camera.centre(), camera.ray(pixel).normalize())
    }

    /// The ray where only how far points are from it along a unit vector counts.
    #[must_use]
    pub fn only_along(self, axis: DVec3) -> Self {
        Self { across: DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z), ..self }
    }

    /// Projection onto the plane across it.
    #[must_use]
    pub fn across(&self) -> DMat3 {
        self.across
    }

    /// Distance of a point from its line.
    #[must_use]
    pub fn distance(&self, point: DVec3) -> f64 {
        (self.across * (point - self.origin)).length()
    }
}

/// The point with the least sum of squared distances from rays, by their weights; `None` where the determinant of the
/// weighted sum of the projections across them is below `least`, as of rays that are about parallel.
#[must_use]
pub fn nearest_point(rays: impl IntoIterator<Item = (Ray, f64)>, least: f64) -> Option<DVec3> {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (ray, weight) in rays {
        let across = weight * ray.across;
        normal += across;
        right += across * ray.origin;
    }
    (normal.determinant().abs() >= least).then(|| normal.inverse() * right)
}

/// The point where rays meet, by their weights; `None` where they are parallel. Of several rays, those that miss the point
/// where most others meet count less.
#[must_use]
pub fn meeting_point(rays: &[(Ray, f64)]) -> Option<DVec3> {
    let nearest = |shares: &[(usize, f64)]| {
        let shared = shares.iter().map(|(k, share)| (rays[*k].0, rays[*k].1 * share));
        nearest_point(shared, PARALLEL)
    };
    let all: Vec<(usize, f64)> = (0..rays.len()).map(|k| (k, 1.0)).collect();
    if rays.len() < FEWEST_RAYS {
        return nearest(&all);
    }
    let distances = |point: DVec3| -> Vec<f64> { rays.iter().map(|(ray, _)| ray.distance(point)).collect() };
    // Of the points where two rays meet, and that where all do, the one that is nearest to the middle ray.
    let paired: Vec<usize> = (0..rays.len()).step_by(rays.len().div_ceil(MOST_PAIRED)).collect();
    let pairs = (0..paired.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
    let pairs = pairs.map(|(a, b)| vec![(paired[a], 1.0), (paired[b], 1.0)]);
    let points = pairs.chain([all]).filter_map(|rays| nearest(&rays));
    let middle = |point: DVec3| median(&mut distances(point)).unwrap_or(0.0);
    let (point, middle) = points.map(|point| (point, middle(point))).min_by(|a, b| a.1.total_cmp(&b.1))?;
    let far = (FAR * middle).max(1e-9);
    let share = |distance: f64| 1.0 / (1.0 + (distance / far).powi(4));
    nearest(&distances(point).into_iter().map(share).enumerate().collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    const POINT: DVec3 = DVec3::new(0.1, -0.2, 0.3);

    /// Rays from places on a circle around the origin that pass a point, each with an offset.
    fn rays(offsets: &[DVec3]) -> Vec<(Ray, f64)> {
        let of = |(k, offset): (usize, &DVec3)| {
            let (sine, cosine) = (1.3 * k as f64).sin_cos();
            let origin = DVec3::new(2.0 * cosine, 2.0 * sine, 1.0);
            (Ray::new(origin, (POINT + *offset - origin).normalize()), 1.0)
        };
        offsets.iter().enumerate().map(of).collect()
    }

    #[test]
    fn distances_are_those_from_lines() {
        let ray = Ray::new(DVec3::X, DVec3::Z);
        assert_eq!(ray.distance(DVec3::new(1.0, 3.0, -7.0)), 3.0);
        assert_eq!(ray.across() * DVec3::new(1.0, 2.0, 3.0), DVec3::new(1.0, 2.0, 0.0));
    }

    #[test]
    fn rays_meet_where_they_cross_unless_they_are_parallel() {
        for count in [2, 3, 5] {
            let rays = rays(&vec![DVec3::ZERO; count]);
            assert!(nearest_point(rays.iter().copied(), 1e-9).unwrap().abs_diff_eq(POINT, 1e-9));
            assert!(meeting_point(&rays).unwrap().abs_diff_eq(POINT, 1e-9));
        }
        let parallel = [DVec3::ZERO, DVec3::X, DVec3::Y].map(|origin| (Ray::new(origin, DVec3::Z), 1.0));
        assert_eq!(nearest_point(parallel, 1e-9), None);
        assert_eq!(meeting_point(&parallel), None);
    }

    #[test]
    fn the_heavier_ray_is_nearer() {
        let rays = [(Ray::new(DVec3::ZERO, DVec3::X), 3.0), (Ray::new(DVec3::Z, DVec3::Y), 1.0)];
        assert!(nearest_point(rays, 1e-9).unwrap().abs_diff_eq(0.25 * DVec3::Z, 1e-12));
    }

    #[test]
    fn rays_that_miss_the_others_do_not_move_the_point() {
        let mut offsets = [DVec3::ZERO; 5];
        (offsets[2], offsets[4]) = (DVec3::new(0.2, 0.0, 0.1), DVec3::new(0.0, 0.1, -0.2));
        let off = |rays: &[(Ray, f64)]| (meeting_point(rays).unwrap() - POINT).length();
        assert!(off(&rays(&offsets)) < 1e-3);
        // Three do not show which misses.
        assert!(off(&rays(&offsets[..3])) > 0.03);
    }
}
