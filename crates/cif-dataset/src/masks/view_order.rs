//! In which order a tracker sees the cameras of a rig.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use crate::Dataset;

/// Order of the views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewOrder {
    /// By camera name.
    #[default]
    Name,
    /// From one end of the first principal axis of the camera centres, always on to the nearest unvisited one.
    Greedy,
}

/// Camera names in order, and the sum of the distances between consecutive camera centres in metres.
///
/// A moving camera counts with the mean of its centres.
#[must_use]
pub fn ordered_views(dataset: &Dataset, order: ViewOrder) -> (Vec<String>, f64) {
    let mut views: Vec<(String, DVec3, usize)> = Vec::new();
    for frame in &dataset.frames {
        let centre = frame.camera.centre();
        match views.iter_mut().find(|(name, ..)| *name == frame.camera_name) {
            Some((_, sum, count)) => (*sum, *count) = (*sum + centre, *count + 1),
            None => views.push((frame.camera_name.clone(), centre, 1)),
        }
    }
    views.sort_by(|a, b| a.0.cmp(&b.0));
    let centres: Vec<DVec3> = views.iter().map(|(_, sum, count)| *sum / *count as f64).collect();
    let indices = match order {
        ViewOrder::Name => (0..views.len()).collect(),
        ViewOrder::Greedy => greedy(&centres),
    };
    let length = indices.windows(2).map(|pair| centres[pair[0]].distance(centres[pair[1]])).sum();
    (indices.into_iter().map(|index| views[index].0.clone()).collect(), length)
}

/// Nearest-neighbour tour from the end of the principal axis whose view comes first by name; ties go to the
/// lower index.
fn greedy(centres: &[DVec3]) -> Vec<usize> {
    let mut left: Vec<usize> = (0..centres.len()).collect();
    let axis = principal_axis(centres);
    let along = |index: &usize| centres[*index].dot(axis);
    let low = left.iter().copied().min_by(|a, b| along(a).total_cmp(&along(b)));
    let high = left.iter().copied().min_by(|a, b| along(b).total_cmp(&along(a)));
    let Some(mut current) = low.into_iter().chain(high).min() else { return Vec::new() };
    let mut tour = Vec::with_capacity(centres.len());
    loop {
        left.retain(|index| *index != current);
        tour.push(current);
        let distance = |index: &usize| centres[current].distance(centres[*index]);
        match left.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b))) {
            Some(next) => current = next,
            None => return tour,
        }
    }
}

/// Direction of the largest spread, by power iteration from the point farthest from the mean.
fn principal_axis(points: &[DVec3]) -> DVec3 {
    let mean = points.iter().sum::<DVec3>() / points.len().max(1) as f64;
    let mut covariance = DMat3::ZERO;
    let mut axis = DVec3::ZERO;
    for point in points {
        let d = *point - mean;
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        if d.length() > axis.length() {
            axis = d;
        }
    }
    for _ in 0..200 {
        match (covariance * axis).try_normalize() {
            Some(next) => axis = next,
            None => break,
        }
    }
    axis
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn greedy_walks_along_the_rig() {
        // Names in shuffled places along a slightly bent line.
        let along = [3.0, 0.0, 4.0, 1.0, 2.0];
        let centres: Vec<DVec3> = along.iter().map(|x: &f64| DVec3::new(*x, 0.1 * x * x, 0.0)).collect();
        let tour = greedy(&centres);
        // Both ends are views 1 and 2; the first by name starts.
        assert_eq!(tour, vec![1, 3, 4, 0, 2]);
    }

    #[test]
    fn coincident_cameras_keep_their_order() {
        assert_eq!(greedy(&[DVec3::ONE; 3]), vec![0, 1, 2]);
        assert!(greedy(&[]).is_empty());
    }
}
