//! Scales, shears and mirrors of nodes, worked into splats: a scene's poses only turn and move.

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_scene::Splats;
use glam::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

/// `M = rotation * stretch` with a proper rotation; the stretch is symmetric, and mirrors where M does.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Decomposed {
    pub(crate) translation: DVec3,
    pub(crate) rotation: DQuat,
    pub(crate) stretch: DMat3,
}

impl Decomposed {
    /// Polar decomposition; `None` where the matrix has no inverse.
    pub(crate) fn of(matrix: &DAffine3) -> Option<Self> {
        let linear = Matrix3::from_column_slice(&matrix.matrix3.to_cols_array());
        let svd = linear.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        let largest = svd.singular_values.max();
        if !(largest.is_finite() && svd.singular_values.min() > 1e-12 * largest) {
            return None;
        }
        let mut rotation = u * v_t;
        let mut stretch = v_t.transpose() * Matrix3::from_diagonal(&svd.singular_values) * v_t;
        // A mirror is a turn after a mirror through the origin.
        if rotation.determinant() < 0.0 {
            rotation = -rotation;
            stretch = -stretch;
        }
        let columns = |m: &Matrix3<f64>| DMat3::from_cols_slice(m.as_slice());
        Some(Self {
            translation: matrix.translation,
            rotation: DQuat::from_mat3(&columns(&rotation)).normalize(),
            stretch: columns(&stretch),
        })
    }

    /// Edge length of the unit cube's image.
    pub(crate) fn size(&self) -> f64 {
        self.stretch.determinant().abs().cbrt()
    }
}

/// Applies a stretch to splats in their local frame.
///
/// Covariances become `P C P^T`. Light that left in a direction leaves in the same direction after a positive
/// stretch, as engines draw it; a mirror through the origin changes the sign of the odd bands.
pub(crate) fn stretch(splats: &mut Splats, by: &DMat3) {
    let mirrored = by.determinant() < 0.0;
    if mirrored {
        let stride = 3 * coefficient_count(splats.sh_degree);
        for row in splats.sh_coefficients.chunks_exact_mut(stride) {
            for (index, coefficient) in row.iter_mut().enumerate() {
                let band = (index / 3).isqrt();
                if band % 2 == 1 {
                    *coefficient = -*coefficient;
                }
            }
        }
    }
    for mean in &mut splats.means {
        *mean = (*by * vector(*mean)).to_array().map(|value| value as f32);
    }
    if let Some(factor) = uniform(by) {
        for scale in splats.scales.as_flattened_mut() {
            *scale = (f64::from(*scale) * factor.abs()).max(f64::from(f32::MIN_POSITIVE)) as f32;
        }
        return;
    }
    for (orientation, scale) in splats.orientations.iter_mut().zip(&mut splats.scales) {
        let [w, x, y, z] = orientation.map(f64::from);
        let axes =
            DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()) * DMat3::from_diagonal(vector(*scale));
        let stretched = *by * axes;
        let svd = Matrix3::from_column_slice(&stretched.to_cols_array()).svd(true, false);
        let Some(mut u) = svd.u else { continue };
        // Axes have no sign; a turn has.
        if u.determinant() < 0.0 {
            u = -u;
        }
        let turn = DQuat::from_mat3(&DMat3::from_cols_slice(u.as_slice())).normalize();
        *orientation = [turn.w, turn.x, turn.y, turn.z].map(|value| value as f32);
        *scale = std::array::from_fn(|axis| (svd.singular_values[axis] as f32).max(f32::MIN_POSITIVE));
    }
}

/// The factor of a stretch that is the same along all axes.
pub(crate) fn uniform(stretch: &DMat3) -> Option<f64> {
    let factor = stretch.x_axis.x;
    let rest = *stretch - DMat3::from_diagonal(DVec3::splat(factor));
    let same = rest.to_cols_array().iter().all(|value| value.abs() <= 1e-6 * factor.abs());
    same.then_some(factor)
}

fn vector(values: [f32; 3]) -> DVec3 {
    DVec3::from_array(values.map(f64::from))
}

#[cfg(test)]
mod tests {
    use cif_geometry::spherical_harmonics;

    use super::*;

    fn covariance(splats: &Splats) -> DMat3 {
        let [w, x, y, z] = splats.orientations[0].map(f64::from);
        let axes =
            DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)) * DMat3::from_diagonal(vector(splats.scales[0]));
        axes * axes.transpose()
    }

    fn splat() -> Splats {
        let turn = DQuat::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 0.9);
        Splats {
            means: vec![[0.3, -0.2, 0.5]],
            orientations: vec![[turn.w, turn.x, turn.y, turn.z].map(|v| v as f32)],
            scales: vec![[0.1, 0.02, 0.3]],
            opacities: vec![1.0],
            sh_degree: 3,
            sh_coefficients: (0..48).map(|k| (k as f32 * 0.37).sin()).collect(),
            ..Splats::default()
        }
    }

    fn close(a: &DMat3, b: &DMat3, tolerance: f64) {
        let difference = *a - *b;
        assert!(difference.to_cols_array().iter().all(|v| v.abs() < tolerance), "{a} {b}");
    }

    #[test]
    fn matrices_are_taken_apart_and_put_together() {
        let sheared =
            DMat3::from_cols(DVec3::new(1.0, 0.2, 0.0), DVec3::new(0.4, 2.0, 0.1), DVec3::new(0.0, 0.3, 0.5));
        for linear in [sheared, sheared * DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0))] {
            let matrix = DAffine3 { matrix3: linear, translation: DVec3::X };
            let parts = Decomposed::of(&matrix).unwrap();
            close(&(DMat3::from_quat(parts.rotation) * parts.stretch), &linear, 1e-12);
            close(&parts.stretch, &parts.stretch.transpose(), 1e-12);
            assert!((parts.size() - linear.determinant().abs().cbrt()).abs() < 1e-12);
        }
        assert!(Decomposed::of(&DAffine3::from_scale(DVec3::new(1.0, 0.0, 1.0))).is_none());
    }

    #[test]
    fn covariances_follow_the_stretch() {
        let by =
            DMat3::from_cols(DVec3::new(1.5, 0.2, 0.0), DVec3::new(0.2, 0.7, 0.1), DVec3::new(0.0, 0.1, 2.0));
        let before = splat();
        let mut after = before.clone();
        stretch(&mut after, &by);
        close(&covariance(&after), &(by * covariance(&before) * by.transpose()), 1e-7);
        assert!((vector(after.means[0]) - by * vector(before.means[0])).length() < 1e-7);
        let mut uniform = before.clone();
        stretch(&mut uniform, &DMat3::from_diagonal(DVec3::splat(2.0)));
        assert_eq!(uniform.orientations, before.orientations);
        assert_eq!(uniform.scales[0], [0.2, 0.04, 0.6]);
    }

    #[test]
    fn a_mirrored_splat_looks_the_same_from_the_mirrored_side() {
        // M = rotation * stretch mirrors x; what was seen along d is now seen along M d.
        let mirror = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        let parts = Decomposed::of(&DAffine3::from_mat3(mirror)).unwrap();
        let before = splat();
        let mut after = before.clone();
        stretch(&mut after, &parts.stretch);
        let color = |splats: &Splats, direction: DVec3| {
            let basis = spherical_harmonics::basis(direction.to_array(), 3);
            (0..16).map(|k| basis[k] * f64::from(splats.sh_coefficients[3 * k])).sum::<f64>()
        };
        for direction in [DVec3::X, DVec3::new(0.6, 0.0, 0.8), DVec3::new(-0.36, 0.48, 0.8)] {
            let seen = mirror * direction;
            // In the local frame, which the rotation carries.
            let local = parts.rotation.inverse() * seen;
            assert!((color(&before, direction) - color(&after, local)).abs() < 1e-6);
        }
        close(
            &(DMat3::from_quat(parts.rotation)
                * covariance(&after)
                * DMat3::from_quat(parts.rotation).transpose()),
            &(mirror * covariance(&before) * mirror.transpose()),
            1e-7,
        );
    }
}
