//! The point where rays through the middles of masks meet.

use cif_geometry::PinholeCamera;
use glam::{DVec2, DVec3};

use super::view::{ObjectView, median};
use crate::tracks::{distance_to_ray, nearest_to_rays};

/// Determinant up to which rays count as parallel.
const PARALLEL: f64 = 1e-9;

/// Fewest rays of which some may be told to miss the others, most of which pairs are tried, and the distance, in middle
/// ones, at which a ray counts half.
const FEWEST_RAYS: usize = 4;
const MOST_PAIRED: usize = 32;
const FAR: f64 = 3.0;

/// The point nearest to rays through the middles of masks, by weights; `None` where they are parallel. Of several rays,
/// those that miss the point where most others meet count less: masks that show more than the object, or another.
pub(super) fn meeting_point<'a>(views: impl Iterator<Item = (&'a ObjectView, f64)>) -> Option<DVec3> {
    meeting_of_rays(&views.map(|(view, weight)| (&view.camera, view.centroid, weight)).collect::<Vec<_>>())
}

/// The same of rays through pixels of cameras, by weights.
pub(super) fn meeting_of_rays(rays: &[(&PinholeCamera, DVec2, f64)]) -> Option<DVec3> {
    let nearest = |shares: &[(usize, f64)]| {
        let shared = shares.iter().map(|(k, share)| (rays[*k].0, rays[*k].1, rays[*k].2 * share));
        nearest_to_rays(shared, PARALLEL)
    };
    let all: Vec<(usize, f64)> = (0..rays.len()).map(|k| (k, 1.0)).collect();
    if rays.len() < FEWEST_RAYS {
        return nearest(&all);
    }
    let distances = |point: DVec3| -> Vec<f64> {
        rays.iter().map(|(camera, pixel, _)| distance_to_ray(camera, *pixel, point)).collect()
    };
    // Of the points where two rays meet, and that where all do, the one that is nearest to the middle ray.
    let paired: Vec<usize> = (0..rays.len()).step_by(rays.len().div_ceil(MOST_PAIRED)).collect();
    let pairs = (0..paired.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
    let pairs = pairs.map(|(a, b)| vec![(paired[a], 1.0), (paired[b], 1.0)]);
    let points = pairs.chain([all]).filter_map(|rays| nearest(&rays));
    let middle = |point: DVec3| median(&mut distances(point));
    let (point, middle) = points.map(|point| (point, middle(point))).min_by(|a, b| a.1.total_cmp(&b.1))?;
    let far = (FAR * middle).max(1e-9);
    let share = |distance: f64| 1.0 / (1.0 + (distance / far).powi(4));
    nearest(&distances(point).into_iter().map(share).enumerate().collect::<Vec<_>>())
}
