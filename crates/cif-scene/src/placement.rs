//! Where the splats of a node are at any time code.

use cif_geometry::{RigidTransform, quaternion};
use glam::DVec3;

use crate::graph::{DenseMotion, Motion, Node, Part, pose_at};
use crate::vectors::{dot, quaternion_of, vector};

/// Splats of a node at one time; parallel to [`Node::splats`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlacedSplats {
    /// Centres.
    pub means: Vec<DVec3>,
    /// Unit quaternions (w, x, y, z).
    pub orientations: Vec<[f64; 4]>,
    /// Standard deviations.
    pub scales: Vec<[f32; 3]>,
}

impl PlacedSplats {
    pub(crate) fn turned(mut self, target_from_local: &RigidTransform) -> Self {
        let turn = quaternion_of(&target_from_local.rotation);
        for mean in &mut self.means {
            *mean = target_from_local.apply(*mean);
        }
        for orientation in &mut self.orientations {
            *orientation = quaternion::multiply(turn, *orientation);
        }
        self
    }
}

impl Part {
    /// `node_from_part` at a time code, interpolated as [`Node::world_transform`].
    #[must_use]
    pub fn node_transform(&self, time_code: f64) -> RigidTransform {
        pose_at(&self.track, self.pivot, time_code).transform()
    }
}

impl Node {
    /// The splats in the world at a time code, as a viewer places them: between samples centres and scales are
    /// interpolated linearly, orientations linearly and normalised, transforms as in
    /// [`Node::world_transform`]; outside the samples the nearest one holds.
    #[must_use]
    pub fn splats_at(&self, time_code: f64) -> PlacedSplats {
        self.local_splats_at(time_code).turned(&self.world_transform(time_code))
    }

    /// The same in the local frame of the node at that time.
    pub(crate) fn local_splats_at(&self, time_code: f64) -> PlacedSplats {
        match &self.motion {
            Motion::Dense(dense) => local_splats_at(dense, &self.splats.scales, time_code),
            Motion::Parts(motion) => {
                let mut placed = self.resting();
                for part in &motion.parts {
                    let node_from_part = part.node_transform(time_code);
                    let turn = quaternion_of(&node_from_part.rotation);
                    for index in part.splats.clone() {
                        placed.means[index] = node_from_part.apply(placed.means[index]);
                        placed.orientations[index] = quaternion::multiply(turn, placed.orientations[index]);
                    }
                }
                placed
            }
            _ => self.resting(),
        }
    }

    fn resting(&self) -> PlacedSplats {
        PlacedSplats {
            means: self.splats.means.iter().map(|mean| vector(*mean)).collect(),
            orientations: self.splats.orientations.iter().map(|q| q.map(f64::from)).collect(),
            scales: self.splats.scales.clone(),
        }
    }
}

/// Interpolated splats of dense motion, local frame of the time.
pub(crate) fn local_splats_at(
    dense: &DenseMotion,
    resting_scales: &[[f32; 3]],
    time_code: f64,
) -> PlacedSplats {
    let samples = &dense.samples;
    if samples.is_empty() {
        return PlacedSplats::default();
    }
    let after = samples.partition_point(|sample| sample.time_code <= time_code);
    let (a, b) = (&samples[after.max(1) - 1], &samples[after.min(samples.len() - 1)]);
    let fraction = if b.time_code > a.time_code {
        ((time_code - a.time_code) / (b.time_code - a.time_code)).clamp(0.0, 1.0)
    } else {
        0.0
    };
    let scales = match (&a.scales, &b.scales) {
        (Some(a), Some(b)) => {
            let mix = |a: f32, b: f32| (f64::from(a) + fraction * f64::from(b - a)) as f32;
            a.iter().zip(b).map(|(a, b)| std::array::from_fn(|axis| mix(a[axis], b[axis]))).collect()
        }
        _ => resting_scales.to_vec(),
    };
    PlacedSplats {
        means: a.means.iter().zip(&b.means).map(|(a, b)| vector(*a).lerp(vector(*b), fraction)).collect(),
        orientations: a
            .orientations
            .iter()
            .zip(&b.orientations)
            .map(|(a, b)| normalized_lerp(a.map(f64::from), b.map(f64::from), fraction))
            .collect(),
        scales,
    }
}

/// The normalised mixture of two unit quaternions, along the shorter arc.
pub(crate) fn normalized_lerp(a: [f64; 4], b: [f64; 4], fraction: f64) -> [f64; 4] {
    let sign = if dot(a, b) < 0.0 { -1.0 } else { 1.0 };
    let mixed = std::array::from_fn(|k| (1.0 - fraction) * a[k] + fraction * sign * b[k]);
    quaternion::try_normalize(mixed).unwrap_or(a)
}

/// Rotation angle between two unit quaternions, radians.
pub(crate) fn angle_between(a: [f64; 4], b: [f64; 4]) -> f64 {
    2.0 * dot(a, b).abs().min(1.0).acos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quaternions_mix_along_the_shorter_arc() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let (a, b) = ([1.0, 0.0, 0.0, 0.0], [half, half, 0.0, 0.0]);
        let middle = normalized_lerp(a, b.map(|v| -v), 0.5);
        let expected = [(std::f64::consts::PI / 8.0).cos(), (std::f64::consts::PI / 8.0).sin(), 0.0, 0.0];
        assert!(angle_between(middle, expected) < 1e-7, "{middle:?}");
        assert!((angle_between(a, b) - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert_eq!(normalized_lerp(a, [0.0; 4], 1.0), a);
    }
}
