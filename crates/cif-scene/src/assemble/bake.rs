//! Affine maps taken apart into a pose and what is left, and baked into splats: poses of a graph only turn and move.

use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::{HarmonicsRotation, coefficient_count};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

use super::PoseSample;
use crate::Splats;

/// Relative deviation below which a matrix counts as a rotation, or as a multiple of the identity.
const RIGID: f64 = 1e-6;
/// Ratio of the smallest to the largest singular value below which a map counts as flat.
const FLAT: f64 = 1e-12;

/// An affine map `rotation * stretch`, and then moved by `translation`.
#[derive(Clone, Copy, Debug)]
pub struct Decomposed {
    /// Image of the origin.
    pub translation: DVec3,
    /// Unit.
    pub rotation: DQuat,
    /// Symmetric; of negative determinant where the map mirrors, which is then a mirror through the origin.
    pub stretch: DMat3,
}

impl Decomposed {
    /// Polar decomposition; `None` where the map flattens everything or is not finite.
    #[must_use]
    pub fn of(map: &DAffine3) -> Option<Self> {
        if !map.is_finite() {
            return None;
        }
        let svd = to_nalgebra(&map.matrix3).svd(true, true);
        if svd.singular_values.min() <= FLAT * svd.singular_values.max() {
            return None;
        }
        let (_, orthogonal) = svd.to_polar()?;
        let orthogonal = to_glam(&orthogonal);
        let rotation = quaternion_of(orthogonal);
        let stretch = orthogonal.transpose() * map.matrix3 * orthogonal.determinant().signum();
        Some(Self { translation: map.translation, rotation, stretch })
    }

    /// Edge length of the unit cube's image.
    #[must_use]
    pub fn size(&self) -> f64 {
        self.stretch.determinant().abs().cbrt()
    }

    /// The pose at a time code, without the stretch.
    #[must_use]
    pub fn pose(&self, time_code: f64) -> PoseSample {
        PoseSample { time_code, translation: self.translation, rotation: self.rotation }
    }
}

/// The factor of a matrix that is a multiple of the identity.
#[must_use]
pub fn uniform(matrix: &DMat3) -> Option<f64> {
    let factor = matrix.x_axis.x;
    let rest = *matrix - DMat3::from_diagonal(DVec3::splat(factor));
    let same = rest.to_cols_array().iter().all(|value| value.abs() <= RIGID * factor.abs());
    (same && factor != 0.0).then_some(factor)
}

/// True when a matrix differs from the identity by rounding only.
#[must_use]
pub fn is_identity(matrix: &DMat3) -> bool {
    (*matrix - DMat3::IDENTITY).to_cols_array().iter().all(|value| value.abs() < RIGID)
}

fn to_nalgebra(matrix: &DMat3) -> Matrix3<f64> {
    Matrix3::from_column_slice(&matrix.to_cols_array())
}

fn to_glam(matrix: &Matrix3<f64>) -> DMat3 {
    DMat3::from_cols_slice(matrix.as_slice())
}

/// Rotation of an orthogonal matrix, which may mirror through the origin besides.
fn quaternion_of(orthogonal: DMat3) -> DQuat {
    DQuat::from_mat3(&(orthogonal * orthogonal.determinant().signum())).normalize()
}

/// A map that is applied to splats: means, covariances, and spherical harmonics turned by the nearest orthogonal
/// matrix. Light that left in a direction leaves in the same direction after a stretch, as engines draw it.
pub struct Bake {
    map: DAffine3,
    /// `None` where nothing turns or mirrors.
    harmonics: Option<HarmonicsRotation<f64>>,
    /// Rotation (`None` where nothing turns) and factor of a map that stretches all axes alike.
    similarity: Option<(Option<[f64; 4]>, f64)>,
}

impl Bake {
    /// A map that flattens nothing.
    #[must_use]
    pub fn new(map: DAffine3) -> Self {
        if let Some(factor) = uniform(&map.matrix3) {
            // Nothing is turned, so that numbers stay as they are.
            let mirror = DMat3::IDENTITY * -1.0;
            let harmonics = (factor < 0.0).then(|| HarmonicsRotation::new(mirror.to_cols_array_2d()));
            return Self { map, harmonics, similarity: Some((None, factor.abs())) };
        }
        let polar = to_nalgebra(&map.matrix3).svd(true, true).to_polar();
        let orthogonal = polar.map_or(DMat3::IDENTITY, |(_, orthogonal)| to_glam(&orthogonal));
        let factor = map.matrix3.determinant().abs().cbrt();
        let similarity = is_identity(&(orthogonal.transpose() * map.matrix3 * (1.0 / factor))).then(|| {
            let q = quaternion_of(orthogonal);
            (Some([q.w, q.x, q.y, q.z]), factor)
        });
        let rows = orthogonal.transpose().to_cols_array_2d();
        let harmonics = (!is_identity(&orthogonal)).then(|| HarmonicsRotation::new(rows));
        Self { map, harmonics, similarity }
    }

    /// Everything about splats.
    pub fn splats(&self, splats: &mut Splats) {
        self.means(&mut splats.means);
        self.shapes(&mut splats.orientations, &mut splats.scales);
        self.harmonics(&mut splats.sh_coefficients, splats.sh_degree);
    }

    /// Centres.
    pub fn means(&self, means: &mut [[f32; 3]]) {
        for mean in means {
            let moved = self.map.transform_point3(DVec3::from_array(mean.map(f64::from)));
            *mean = moved.to_array().map(|value| value as f32);
        }
    }

    /// Orientations and standard deviations: `A R S S R^T A^T` is taken apart again.
    pub fn shapes(&self, orientations: &mut [[f32; 4]], scales: &mut [[f32; 3]]) {
        for (orientation, scale) in orientations.iter_mut().zip(scales) {
            let q = orientation.map(f64::from);
            if let Some((turn, factor)) = self.similarity {
                if let Some(turn) = turn {
                    *orientation = quaternion::multiply(turn, q).map(|value| value as f32);
                }
                *scale = scale.map(|value| (f64::from(value) * factor) as f32);
                continue;
            }
            let rotation = DMat3::from_quat(DQuat::from_xyzw(q[1], q[2], q[3], q[0]).normalize());
            let axes =
                self.map.matrix3 * rotation * DMat3::from_diagonal(DVec3::from_array(scale.map(f64::from)));
            let svd = to_nalgebra(&axes).svd(true, false);
            let Some(u) = svd.u else { continue };
            // Axes have no sign; a turn has.
            let q = quaternion_of(to_glam(&u));
            *orientation = [q.w, q.x, q.y, q.z].map(|value| value as f32);
            // A flat splat stays flat: what is left of its thickness is rounding.
            let flat = scale.iter().filter(|scale| **scale == 0.0).count();
            let mut sizes = [0, 1, 2].map(|axis| svd.singular_values[axis] as f32);
            let mut thinnest = [0, 1, 2];
            thinnest.sort_by(|a, b| sizes[*a].total_cmp(&sizes[*b]));
            thinnest[..flat].iter().for_each(|axis| sizes[*axis] = 0.0);
            *scale = sizes;
        }
    }

    /// Coefficients `[N, (degree + 1)^2, 3]`.
    pub fn harmonics(&self, coefficients: &mut [f32], degree: u8) {
        let Some(harmonics) = &self.harmonics else { return };
        for splat in coefficients.chunks_exact_mut(3 * coefficient_count(degree)) {
            let mut turned = [0.0; 48];
            let turned = &mut turned[..splat.len()];
            turned.iter_mut().zip(&*splat).for_each(|(to, from)| *to = f64::from(*from));
            harmonics.rotate(turned);
            splat.iter_mut().zip(&*turned).for_each(|(to, from)| *to = *from as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use cif_geometry::spherical_harmonics;

    use super::*;

    fn covariance(orientation: [f32; 4], scale: [f32; 3]) -> DMat3 {
        let [w, x, y, z] = orientation.map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
            * DMat3::from_diagonal(DVec3::from_array(scale.map(f64::from)));
        axes * axes.transpose()
    }

    fn splat() -> Splats {
        Splats {
            means: vec![[1.0, 2.0, 3.0]],
            orientations: vec![[0.8, 0.2, -0.4, 0.4]],
            scales: vec![[0.3, 0.1, 0.02]],
            sh_degree: 3,
            sh_coefficients: (0..48).map(|k| ((k * 7 % 11) as f32 - 5.0) * 0.1).collect(),
            ..Splats::default()
        }
    }

    fn color(splats: &Splats, direction: DVec3) -> f64 {
        let basis = spherical_harmonics::basis(direction.to_array(), 3);
        (0..16).map(|k| basis[k] * f64::from(splats.sh_coefficients[3 * k])).sum::<f64>()
    }

    fn close(a: &DMat3, b: &DMat3, tolerance: f64) {
        let difference = *a - *b;
        assert!(difference.to_cols_array().iter().all(|v| v.abs() < tolerance), "{a} {b}");
    }

    fn turn() -> DMat3 {
        DMat3::from_axis_angle(DVec3::new(0.3, -1.0, 0.5).normalize(), 1.1)
    }

    #[test]
    fn maps_are_taken_apart_and_put_together() {
        let sheared =
            DMat3::from_cols(DVec3::new(1.0, 0.2, 0.0), DVec3::new(0.4, 2.0, 0.1), DVec3::new(0.0, 0.3, 0.5));
        let mirrored = sheared * DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        for linear in [sheared, mirrored, turn()] {
            let parts = Decomposed::of(&DAffine3::from_mat3_translation(linear, DVec3::X)).unwrap();
            close(&(DMat3::from_quat(parts.rotation) * parts.stretch), &linear, 1e-12);
            close(&parts.stretch, &parts.stretch.transpose(), 1e-12);
            assert!((parts.size() - linear.determinant().abs().cbrt()).abs() < 1e-12);
            assert_eq!(is_identity(&parts.stretch), linear == turn());
        }
        assert!(Decomposed::of(&DAffine3::from_scale(DVec3::new(1.0, 0.0, 1.0))).is_none());
        assert!(Decomposed::of(&DAffine3::from_scale(DVec3::new(1.0, f64::NAN, 1.0))).is_none());
    }

    #[test]
    fn covariances_follow_any_affine_map() {
        let turn = turn();
        let maps = [
            turn,
            turn * 2.5,
            turn * -2.5,
            turn * DMat3::from_diagonal(DVec3::new(1.0, 3.0, 0.5)),
            DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)) * turn,
            DMat3::from_cols(DVec3::X, DVec3::new(0.7, 1.0, 0.0), DVec3::Z) * turn,
            DMat3::from_cols(DVec3::new(1.5, 0.2, 0.0), DVec3::new(0.2, 0.7, 0.1), DVec3::new(0.0, 0.1, 2.0)),
        ];
        for map in maps {
            let (before, mut after) = (splat(), splat());
            Bake::new(DAffine3::from_mat3_translation(map, DVec3::ONE)).splats(&mut after);
            let expected = map * covariance(before.orientations[0], before.scales[0]) * map.transpose();
            close(&covariance(after.orientations[0], after.scales[0]), &expected, 1e-6);
            let norm: f32 = after.orientations[0].iter().map(|c| c * c).sum();
            assert!((norm - 1.0).abs() < 1e-5, "{norm}");
            let moved = map * DVec3::new(1.0, 2.0, 3.0) + DVec3::ONE;
            assert!((DVec3::from_array(after.means[0].map(f64::from)) - moved).length() < 1e-5);
        }
    }

    #[test]
    fn growing_alone_changes_sizes_only() {
        let (before, mut after) = (splat(), splat());
        Bake::new(DAffine3::from_scale(DVec3::splat(2.0))).splats(&mut after);
        assert_eq!(after.orientations, before.orientations);
        assert_eq!(after.sh_coefficients, before.sh_coefficients);
        assert_eq!(after.scales[0], before.scales[0].map(|scale| 2.0 * scale));
    }

    #[test]
    fn colours_turn_with_the_map() {
        let mirror = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        for map in [mirror * DMat3::from_axis_angle(DVec3::Z, 0.9), DMat3::IDENTITY * -3.0, turn() * 2.0] {
            let (before, mut after) = (splat(), splat());
            Bake::new(DAffine3::from_mat3(map)).splats(&mut after);
            for direction in [DVec3::X, DVec3::new(0.3, -0.5, 0.8).normalize()] {
                let seen = (map * direction).normalize();
                assert!((color(&before, direction) - color(&after, seen)).abs() < 1e-5, "{map}");
            }
        }
    }

    #[test]
    fn a_mirrored_splat_looks_the_same_from_the_mirrored_side() {
        // M = rotation * stretch mirrors x; what was seen along d is now seen along M d.
        let mirror = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        let parts = Decomposed::of(&DAffine3::from_mat3(mirror)).unwrap();
        let (before, mut after) = (splat(), splat());
        Bake::new(DAffine3::from_mat3(parts.stretch)).splats(&mut after);
        for direction in [DVec3::X, DVec3::new(0.6, 0.0, 0.8), DVec3::new(-0.36, 0.48, 0.8)] {
            // In the local frame, which the rotation carries.
            let local = parts.rotation.inverse() * (mirror * direction);
            assert!((color(&before, direction) - color(&after, local)).abs() < 1e-6);
        }
    }
}
