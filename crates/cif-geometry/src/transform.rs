//! Rigid transforms between frames, named `a_from_b`.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// `point_in_a = rotation * point_in_b + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RigidTransform {
    /// Orthonormal, determinant +1.
    pub rotation: DMat3,
    /// Origin of b, in a.
    pub translation: DVec3,
}

impl RigidTransform {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// `b_from_a`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// `a_from_c` from `self = a_from_b` and `b_from_c`.
    #[must_use]
    pub fn compose(&self, b_from_c: &Self) -> Self {
        Self {
            rotation: self.rotation * b_from_c.rotation,
            translation: self.rotation * b_from_c.translation + self.translation,
        }
    }

    /// Maps a point of b into a.
    #[must_use]
    pub fn apply(&self, point_in_b: DVec3) -> DVec3 {
        self.rotation * point_in_b + self.translation
    }

    /// Largest deviation of `rotation^T rotation` from the identity; infinite when the determinant is
    /// negative, NaN entries give NaN.
    #[must_use]
    pub fn orthonormality_error(&self) -> f64 {
        let gram = self.rotation.transpose() * self.rotation - DMat3::IDENTITY;
        let worst = gram
            .to_cols_array()
            .iter()
            .fold(0.0_f64, |worst, value| if value.is_nan() { f64::NAN } else { worst.max(value.abs()) });
        if self.rotation.determinant() < 0.0 { f64::INFINITY } else { worst }
    }
}

/// Angle of the rotation that turns one rotation into the other, radians, 0 to pi; exact near zero, where the arc
/// cosine of the trace is not.
#[must_use]
pub fn angle_between(a: &DMat3, b: &DMat3) -> f64 {
    let chord = (*a - *b).to_cols_array().iter().map(|value| value * value).sum::<f64>().sqrt();
    2.0 * (chord / 8.0_f64.sqrt()).min(1.0).asin()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_undoes() {
        let t = RigidTransform {
            rotation: DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7),
            translation: DVec3::new(1.0, -2.0, 0.5),
        };
        let p = DVec3::new(0.3, 0.1, 9.0);
        assert!((t.inverse().apply(t.apply(p)) - p).length() < 1e-12);
        assert!((t.compose(&t.inverse()).translation).length() < 1e-12);
        assert!(t.orthonormality_error() < 1e-12);
    }

    #[test]
    fn a_mirror_is_not_rigid() {
        let mirror = RigidTransform {
            rotation: DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0)),
            ..RigidTransform::IDENTITY
        };
        assert!(mirror.orthonormality_error().is_infinite());
    }

    #[test]
    fn angles_are_exact_small_and_large() {
        let a = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, -1.0).normalize(), 0.4);
        for angle in [0.0, 1e-9, 0.3, 2.0, std::f64::consts::PI] {
            let b = a * DMat3::from_rotation_z(angle);
            assert!((angle_between(&a, &b) - angle).abs() < 1e-7 * angle.max(1e-3), "{angle}");
        }
    }
}
