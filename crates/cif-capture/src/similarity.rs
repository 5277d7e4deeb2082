//! How far sets of poses are apart, whatever worlds they are in.

use cif_geometry::RigidTransform;
pub use cif_geometry::Similarity;
use cif_geometry::stats::upper_median;
use cif_geometry::transform::angle_between;
use glam::DVec3;

use crate::poses::{Poses, spread};

/// How far two sets of poses are apart once the best similarity is taken out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// Images that have a pose in both.
    pub images: usize,
    /// Root mean square distance of places, as a share of their spread.
    pub places: f64,
    /// Median angle between their orientations, radians.
    pub median_angle: f64,
}

/// Compares poses by the images that both have; `None` where fewer than two are common.
#[must_use]
pub fn difference(a: &Poses, b: &Poses) -> Option<Difference> {
    let common: Vec<(&RigidTransform, &RigidTransform)> = a
        .images
        .iter()
        .filter_map(|(name, pose)| Some((&pose.world_from_camera, &b.images.get(name)?.world_from_camera)))
        .collect();
    let from: Vec<DVec3> = common.iter().map(|pair| pair.0.translation).collect();
    let to: Vec<DVec3> = common.iter().map(|pair| pair.1.translation).collect();
    let similarity = Similarity::fitting(&from, &to)?;
    let squares: f64 = from.iter().zip(&to).map(|(p, q)| similarity.apply(*p).distance_squared(*q)).sum();
    let mut angles: Vec<f64> =
        common.iter().map(|(p, q)| angle_between(&(similarity.rotation * p.rotation), &q.rotation)).collect();
    Some(Difference {
        images: common.len(),
        places: (squares / common.len() as f64).sqrt() / spread(&to),
        median_angle: upper_median(&mut angles)?,
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use glam::DMat3;

    use super::*;
    use crate::poses::{Lens, Pose};

    /// Cameras on an arc around the origin, looking inwards.
    pub(crate) fn arc(count: usize) -> Poses {
        let lens = Lens {
            size: (640, 480),
            focal_px: [600.0, 600.0],
            principal_px: [320.0, 240.0],
            distortion: cif_geometry::LensDistortion::default(),
        };
        let pose = |k: usize| {
            let angle = k as f64 / count as f64 * 2.5;
            let place = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 1.0 + 0.3 * (3.0 * angle).sin());
            let forward = (-place).normalize();
            let right = forward.cross(DVec3::Z).normalize();
            let rotation = DMat3::from_cols(right, forward.cross(right), forward);
            Pose { lens: 0, world_from_camera: RigidTransform { rotation, translation: place }, points: 90 }
        };
        Poses {
            lenses: vec![lens],
            images: (0..count).map(|k| (format!("{k:03}.png"), pose(k))).collect(),
            points: Vec::new(),
            reprojection_px: Some(0.5),
        }
    }

    pub(crate) fn somewhere() -> Similarity {
        Similarity {
            scale: 2.7,
            rotation: DMat3::from_axis_angle(DVec3::new(0.3, -1.0, 0.4).normalize(), 2.1),
            translation: DVec3::new(4.0, -2.0, 11.0),
        }
    }

    #[test]
    fn differences_do_not_hang_on_the_world() {
        let a = arc(12);
        let mut b = a.clone();
        b.transform(&somewhere());
        let same = difference(&a, &b).unwrap();
        assert!(same.images == 12 && same.places < 1e-9 && same.median_angle < 1e-6, "{same:?}");
        let moved = b.images.get_mut("004.png").unwrap();
        moved.world_from_camera.translation += DVec3::X * 0.5 * somewhere().scale;
        let other = difference(&a, &b).unwrap();
        assert!(other.places > 0.02 && other.places < 0.2, "{other:?}");
    }
}
