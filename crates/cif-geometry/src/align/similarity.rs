//! Similarity transforms between worlds, and the one that fits places best.

use glam::{DMat3, DVec3};
use nalgebra::Matrix3;

use crate::RigidTransform;

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
        let [a, b] = [from, to].map(|places| places.iter().sum::<DVec3>() / places.len() as f64);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_similarity_is_found_again() {
        let somewhere = Similarity {
            scale: 2.7,
            rotation: DMat3::from_axis_angle(DVec3::new(0.3, -1.0, 0.4).normalize(), 2.1),
            translation: DVec3::new(4.0, -2.0, 11.0),
        };
        let place = |k: usize| {
            let angle = k as f64 / 3.0;
            DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 1.0 + 0.3 * (3.0 * angle).sin())
        };
        let from: Vec<DVec3> = (0..9).map(place).collect();
        let to: Vec<DVec3> = from.iter().map(|place| somewhere.apply(*place)).collect();
        let found = Similarity::fitting(&from, &to).unwrap();
        assert!((found.scale - 2.7).abs() < 1e-9);
        assert!((found.rotation - somewhere.rotation).to_cols_array().iter().all(|d| d.abs() < 1e-9));
        assert!((found.translation - somewhere.translation).length() < 1e-8);
        // A mirrored set has no better fit than a rotation.
        let mirrored: Vec<DVec3> = from.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
        let found = Similarity::fitting(&from, &mirrored).unwrap();
        assert!((found.rotation.determinant() - 1.0).abs() < 1e-9);
        assert!(Similarity::fitting(&from[..1], &to[..1]).is_none());
        assert!(Similarity::fitting(&[DVec3::ONE; 4], &to[..4]).is_none());
    }
}
