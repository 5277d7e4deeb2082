//! Affine transforms baked into splats.

use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::{HarmonicsRotation, coefficient_count};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

/// Relative deviation from a rotation below which a matrix counts as one.
const RIGID: f64 = 1e-6;

/// Rotation and translation of an affine transform, and what is left: `affine = rigid * rest`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Split {
    pub(super) rotation: DQuat,
    pub(super) translation: DVec3,
    /// Symmetric where the transform does not mirror.
    pub(super) rest: DMat3,
}

/// Polar decomposition. A mirroring transform keeps its mirror in the rest.
pub(super) fn split(affine: &DAffine3) -> Split {
    let rotation = proper(nearest_orthogonal(&affine.matrix3));
    let quaternion = quaternion_of(&rotation);
    Split {
        rotation: quaternion,
        translation: affine.translation,
        rest: DMat3::from_quat(quaternion).transpose() * affine.matrix3,
    }
}

/// Whether nothing but a rotation is left of a linear map.
pub(super) fn is_identity(matrix: &DMat3) -> bool {
    (*matrix - DMat3::IDENTITY).to_cols_array().iter().all(|value| value.abs() < RIGID)
}

fn to_nalgebra(matrix: &DMat3) -> Matrix3<f64> {
    Matrix3::from_column_slice(&matrix.to_cols_array())
}

fn to_glam(matrix: &Matrix3<f64>) -> DMat3 {
    let mut columns = [0.0; 9];
    columns.copy_from_slice(matrix.as_slice());
    DMat3::from_cols_array(&columns)
}

/// Nearest orthogonal matrix, mirroring where `matrix` does.
fn nearest_orthogonal(matrix: &DMat3) -> DMat3 {
    let svd = to_nalgebra(matrix).svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => to_glam(&(u * v_t)),
        _ => DMat3::IDENTITY,
    }
}

/// The same without the mirror.
fn proper(orthogonal: DMat3) -> DMat3 {
    if orthogonal.determinant() < 0.0 { -orthogonal } else { orthogonal }
}

fn quaternion_of(rotation: &DMat3) -> DQuat {
    let rotation = Rotation3::from_matrix_unchecked(to_nalgebra(rotation));
    let unit = UnitQuaternion::from_rotation_matrix(&rotation);
    DQuat::from_xyzw(unit.i, unit.j, unit.k, unit.w).normalize()
}

/// Bakes a transform into splats: means, covariances, and spherical harmonics turned by its nearest rotation.
pub(super) struct Bake {
    affine: DAffine3,
    harmonics: HarmonicsRotation<f64>,
    /// Rotation and factor where the transform is a rotation with uniform scale, without mirror.
    similarity: Option<([f64; 4], f64)>,
}

impl Bake {
    pub(super) fn new(affine: DAffine3) -> Self {
        let orthogonal = nearest_orthogonal(&affine.matrix3);
        let rows = orthogonal.transpose().to_cols_array_2d();
        let factor = affine.matrix3.determinant().abs().cbrt();
        let uniform = factor > 0.0
            && orthogonal.determinant() > 0.0
            && is_identity(&(orthogonal.transpose() * affine.matrix3 * (1.0 / factor)));
        let similarity = uniform.then(|| {
            let q = quaternion_of(&orthogonal);
            ([q.w, q.x, q.y, q.z], factor)
        });
        Self { affine, harmonics: HarmonicsRotation::new(rows), similarity }
    }

    /// Centres.
    pub(super) fn means(&self, means: &mut [[f32; 3]]) {
        for mean in means {
            let moved = self.affine.transform_point3(DVec3::from_array(mean.map(f64::from)));
            *mean = moved.to_array().map(|value| value as f32);
        }
    }

    /// Orientations and standard deviations: `A R S S R^T A^T` is taken apart again.
    pub(super) fn shapes(&self, orientations: &mut [[f32; 4]], scales: &mut [[f32; 3]]) {
        for (orientation, scale) in orientations.iter_mut().zip(scales) {
            let q = orientation.map(f64::from);
            if let Some((turn, factor)) = self.similarity {
                *orientation = quaternion::multiply(turn, q).map(|value| value as f32);
                *scale = scale.map(|value| (f64::from(value) * factor) as f32);
                continue;
            }
            let rotation = DMat3::from_quat(DQuat::from_xyzw(q[1], q[2], q[3], q[0]).normalize());
            let axes = self.affine.matrix3
                * rotation
                * DMat3::from_diagonal(DVec3::from_array(scale.map(f64::from)));
            let svd = to_nalgebra(&axes).svd(true, false);
            let Some(u) = svd.u else { continue };
            let q = quaternion_of(&proper(to_glam(&u)));
            *orientation = [q.w, q.x, q.y, q.z].map(|value| value as f32);
            *scale = [0, 1, 2].map(|axis| (svd.singular_values[axis] as f32).max(f32::MIN_POSITIVE));
        }
    }

    /// Coefficients `[N, (degree + 1)^2, 3]`.
    pub(super) fn harmonics(&self, coefficients: &mut [f32], degree: u8) {
        for splat in coefficients.chunks_exact_mut(3 * coefficient_count(degree)) {
            let mut turned = [0.0; 48];
            let turned = &mut turned[..splat.len()];
            turned.iter_mut().zip(&*splat).for_each(|(to, from)| *to = f64::from(*from));
            self.harmonics.rotate(turned);
            splat.iter_mut().zip(&*turned).for_each(|(to, from)| *to = *from as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn covariance(orientation: [f32; 4], scale: [f32; 3]) -> DMat3 {
        let [w, x, y, z] = orientation.map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
            * DMat3::from_diagonal(DVec3::from_array(scale.map(f64::from)));
        axes * axes.transpose()
    }

    #[test]
    fn covariances_follow_any_affine_map() {
        let turn = DMat3::from_axis_angle(DVec3::new(0.3, -1.0, 0.5).normalize(), 1.1);
        let maps = [
            turn,
            turn * 2.5,
            turn * DMat3::from_diagonal(DVec3::new(1.0, 3.0, 0.5)),
            DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)) * turn,
            DMat3::from_cols(DVec3::X, DVec3::new(0.7, 1.0, 0.0), DVec3::Z) * turn,
        ];
        let (q, s) = ([0.8, 0.2, -0.4, 0.4], [0.3_f32, 0.1, 0.02]);
        for map in maps {
            let bake = Bake::new(DAffine3::from_mat3_translation(map, DVec3::ONE));
            let (mut orientations, mut scales, mut means) = ([q], [s], [[1.0, 2.0, 3.0]]);
            bake.shapes(&mut orientations, &mut scales);
            bake.means(&mut means);
            let expected = map * covariance(q, s) * map.transpose();
            let difference = covariance(orientations[0], scales[0]) - expected;
            assert!(difference.to_cols_array().iter().all(|d| d.abs() < 1e-6), "{map:?} {difference:?}");
            let norm: f32 = orientations[0].iter().map(|c| c * c).sum();
            assert!((norm - 1.0).abs() < 1e-5, "{norm}");
            let moved = map * DVec3::new(1.0, 2.0, 3.0) + DVec3::ONE;
            assert!((DVec3::from_array(means[0].map(f64::from)) - moved).length() < 1e-5);
        }
    }

    #[test]
    fn splitting_keeps_the_product() {
        let map = DMat3::from_axis_angle(DVec3::Y, 0.7) * DMat3::from_diagonal(DVec3::new(2.0, -1.0, 0.5));
        let parts = split(&DAffine3::from_mat3_translation(map, DVec3::X));
        let product = DMat3::from_quat(parts.rotation) * parts.rest;
        assert!((product - map).to_cols_array().iter().all(|d| d.abs() < 1e-9));
        assert!(!is_identity(&parts.rest));
        let rigid = split(&DAffine3::from_mat3_translation(DMat3::from_axis_angle(DVec3::X, 3.0), DVec3::X));
        assert!(is_identity(&rigid.rest), "{:?}", rigid.rest);
    }

    #[test]
    fn colours_turn_with_the_map() {
        use cif_geometry::spherical_harmonics;
        let map = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)) * DMat3::from_axis_angle(DVec3::Z, 0.9);
        let mut coefficients: Vec<f32> = (0..48).map(|k| ((k * 7 % 11) as f32 - 5.0) * 0.1).collect();
        let before = coefficients.clone();
        Bake::new(DAffine3::from_mat3(map)).harmonics(&mut coefficients, 3);
        let value = |sh: &[f32], direction: DVec3| {
            let basis = spherical_harmonics::basis(direction.to_array(), 3);
            (0..16).map(|k| basis[k] * f64::from(sh[3 * k])).sum::<f64>()
        };
        for direction in [DVec3::X, DVec3::new(0.3, -0.5, 0.8).normalize()] {
            assert!((value(&before, direction) - value(&coefficients, map * direction)).abs() < 1e-5);
        }
    }
}
