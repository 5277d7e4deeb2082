//! Rotations from raw (w, x, y, z) quaternions, with derivative, a Gaussian per lane; the plain formulas are those of
//! [`cif_geometry::quaternion`].

use fearless_simd::prelude::*;
use fearless_simd::{f32x16, mask32x16};

use super::gaussian_lanes::Matrix;
use super::pixels::splat;

/// A raw quaternion of each lane, and what normalises it.
#[derive(Clone, Copy)]
pub(super) struct Rotation<S: Simd> {
    unit: [f32x16<S>; 4],
    inverse_norm: f32x16<S>,
}

impl<S: Simd> Rotation<S> {
    /// With the lanes that have a rotation at all.
    #[inline(always)]
    pub(super) fn new(simd: S, [w, x, y, z]: [f32x16<S>; 4]) -> (Self, mask32x16<S>) {
        let norm = w.mul_add(w, x.mul_add(x, y.mul_add(y, z * z))).sqrt();
        let some = norm.is_finite() & norm.simd_ge(splat(simd, cif_geometry::quaternion::MIN_NORM as f32));
        let inverse_norm = splat(simd, 1.0) / norm;
        let unit = [w / norm, x / norm, y / norm, z / norm];
        (Self { unit, inverse_norm }, some)
    }

    #[inline(always)]
    pub(super) fn matrix(&self, simd: S) -> Matrix<S> {
        let [w, x, y, z] = self.unit;
        let (one, two) = (splat(simd, 1.0), splat(simd, 2.0));
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, xz, yz) = (x * y, x * z, y * z);
        let (wx, wy, wz) = (w * x, w * y, w * z);
        [
            [one - two * (yy + zz), two * (xy - wz), two * (xz + wy)],
            [two * (xy + wz), one - two * (xx + zz), two * (yz - wx)],
            [two * (xz - wy), two * (yz + wx), one - two * (xx + yy)],
        ]
    }

    /// Gradient of the raw quaternion from that of the matrix.
    #[inline(always)]
    pub(super) fn backward(&self, simd: S, v: &Matrix<S>) -> [f32x16<S>; 4] {
        let [w, x, y, z] = self.unit;
        let two = splat(simd, 2.0);
        // Antisymmetric and symmetric parts.
        let (a0, a1, a2) = (v[2][1] - v[1][2], v[0][2] - v[2][0], v[1][0] - v[0][1]);
        let (s0, s1, s2) = (v[2][1] + v[1][2], v[0][2] + v[2][0], v[1][0] + v[0][1]);
        let g = [
            two * (x * a0 + y * a1 + z * a2),
            two * (y * s2 + z * s1 + w * a0 - two * x * (v[1][1] + v[2][2])),
            two * (x * s2 + z * s0 + w * a1 - two * y * (v[0][0] + v[2][2])),
            two * (x * s1 + y * s0 + w * a2 - two * z * (v[0][0] + v[1][1])),
        ];
        let radial = w * g[0] + x * g[1] + y * g[2] + z * g[3];
        [
            (g[0] - w * radial) * self.inverse_norm,
            (g[1] - x * radial) * self.inverse_norm,
            (g[2] - y * radial) * self.inverse_norm,
            (g[3] - z * radial) * self.inverse_norm,
        ]
    }
}

#[cfg(test)]
mod tests {
    use cif_geometry::quaternion;
    use fearless_simd::dispatch;

    use super::super::SimdLevel;
    use super::super::gaussian_lanes::splat_matrix;
    use super::*;

    #[test]
    fn rotations_are_those_of_the_plain_formulas() {
        let raw = [0.9_f32, -0.4, 1.3, 0.2];
        let v = [[0.3_f32, -1.0, 0.2], [0.7, 0.1, -0.4], [0.9, -0.6, 0.5]];
        let expected = quaternion::to_rotation(quaternion::try_normalize(raw).unwrap());
        let expected_back = quaternion::to_rotation_backward(raw, v);
        for level in SimdLevel::levels() {
            let (matrix, back) = dispatch!(level, simd => {
                let (rotation, _) = Rotation::new(simd, raw.map(|value| splat(simd, value)));
                let matrix = rotation.matrix(simd).map(|row| row.map(|v| v.to_array()[7]));
                (matrix, rotation.backward(simd, &splat_matrix(simd, v)).map(|v| v.to_array()[7]))
            });
            let pairs = matrix.iter().flatten().zip(expected.iter().flatten());
            for (found, expected) in pairs.chain(back.iter().zip(&expected_back)) {
                assert!((found - expected).abs() < 1e-6, "{level:?}: {found} {expected}");
            }
        }
    }

    #[test]
    fn what_has_no_rotation_is_left_out() {
        for level in SimdLevel::levels() {
            for (raw, expected) in
                [([0.0; 4], 0), ([f32::NAN, 0.0, 0.0, 1.0], 0), ([1e-3, 0.0, 0.0, 0.0], 0xffff)]
            {
                let some = dispatch!(level, simd =>
                    Rotation::new(simd, raw.map(|value| splat(simd, value))).1.to_bitmask());
                assert_eq!(some, expected, "{level:?} {raw:?}");
            }
        }
    }
}
