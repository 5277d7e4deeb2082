//! Similarity transforms between worlds, and the one that fits places best.

use cif_geometry::RigidTransform;
use cif_geometry::transform::angle_between;
use glam::{DMat3, DVec3};
use nalgebra::Matrix3;

use crate::poses::Poses;

/// `x -> scale * rotation * x + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Above 0.
    pub scale: f64,
    /// Orthonormal, determinant +1.
    pub rotation: DMat3,
    /// Applied last.
    pub translation: DVec3,
}

impl Similarity {
    /// Nothing changes.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Moves a point.
    #[must_use]
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// Moves a camera, which stays rigid.
    #[must_use]
    pub fn camera(&self, world_from_camera: &RigidTransform) -> RigidTransform {
        RigidTransform {
            rotation: self.rotation * world_from_camera.rotation,
            translation: self.apply(world_from_camera.translation),
        }
    }

    /// The similarity that brings `from` nearest to `to` in the sense of least squares; `None` for fewer than
    /// two pairs, or where the places coincide. Places on one line leave the turn about it open.
    ///
    /// Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    /// IEEE TPAMI 13(4), 1991, equations 38 to 42.
    #[must_use]
    pub fn fitting(from: &[DVec3], to: &[DVec3]) -> Option<Self> {
        if from.len() < 2 || from.len() != to.len() {
            return None;
        }
        let (a, b) = (middle(from), middle(to));
        let mut covariance = Matrix3::<f64>::zeros();
        for (p, q) in from.iter().zip(to) {
            let (p, q) = ((*p - a).to_array(), (*q - b).to_array());
            covariance += Matrix3::from_fn(|i, j| q[i] * p[j]);
        }
        let variance: f64 = from.iter().map(|p| p.distance_squared(a)).sum();
        if !(variance > 0.0 && covariance.iter().all(|value| value.is_finite())) {
            return None;
        }
        let svd = covariance.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        let mut signs = [1.0, 1.0, 1.0];
        if u.determinant() * v_t.determinant() < 0.0 {
            // Singular values come in descending order.
            signs[2] = -1.0;
        }
        let turned = u * Matrix3::from_diagonal(&signs.into()) * v_t;
        let rotation = DMat3::from_cols_array(&std::array::from_fn(|k| turned[(k % 3, k / 3)]));
        let scale = (0..3).map(|k| svd.singular_values[k] * signs[k]).sum::<f64>() / variance;
        (scale > 0.0).then(|| Self { scale, rotation, translation: b - scale * (rotation * a) })
    }
}

/// Mean of places.
pub(crate) fn middle(places: &[DVec3]) -> DVec3 {
    places.iter().sum::<DVec3>() / places.len().max(1) as f64
}

/// Root mean square distance of places from their mean.
pub(crate) fn spread(places: &[DVec3]) -> f64 {
    let middle = middle(places);
    let sum: f64 = places.iter().map(|place| place.distance_squared(middle)).sum();
    (sum / places.len().max(1) as f64).sqrt()
}

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
    angles.sort_by(f64::total_cmp);
    Some(Difference {
        images: common.len(),
        places: (squares / common.len() as f64).sqrt() / spread(&to),
        median_angle: angles[angles.len() / 2],
    })
}

#[cfg(test)]
pub(crate) mod tests {
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
    fn a_similarity_is_found_again() {
        let from: Vec<DVec3> =
            arc(9).images.values().map(|pose| pose.world_from_camera.translation).collect();
        let to: Vec<DVec3> = from.iter().map(|place| somewhere().apply(*place)).collect();
        let found = Similarity::fitting(&from, &to).unwrap();
        assert!((found.scale - 2.7).abs() < 1e-9);
        assert!((found.rotation - somewhere().rotation).to_cols_array().iter().all(|d| d.abs() < 1e-9));
        assert!((found.translation - somewhere().translation).length() < 1e-8);
        // A mirrored set has no better fit than a rotation.
        let mirrored: Vec<DVec3> = from.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
        let found = Similarity::fitting(&from, &mirrored).unwrap();
        assert!((found.rotation.determinant() - 1.0).abs() < 1e-9);
        assert!(Similarity::fitting(&from[..1], &to[..1]).is_none());
        assert!(Similarity::fitting(&[DVec3::ONE; 4], &to[..4]).is_none());
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
