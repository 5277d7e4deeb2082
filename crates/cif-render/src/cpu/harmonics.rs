//! The basis of spherical harmonics and its gradient, a direction per lane; the plain formulas are those of
//! [`cif_geometry::spherical_harmonics`].

use cif_geometry::spherical_harmonics::{BAND_0, BAND_1, BAND_2, BAND_3, COEFFICIENTS};
use fearless_simd::f32x16;
use fearless_simd::prelude::*;

use super::gaussian_lanes::Vector;
use super::pixels::splat;

/// Factors of a band in single precision.
const fn single<const N: usize>(factors: [f64; N]) -> [f32; N] {
    let mut single = [0.0; N];
    let mut k = 0;
    while k < N {
        single[k] = factors[k] as f32;
        k += 1;
    }
    single
}

const FIRST: f32 = BAND_1 as f32;
const SECOND: [f32; 5] = single(BAND_2);
const THIRD: [f32; 7] = single(BAND_3);

/// Basis values at a unit direction; entries above `degree` are 0.
#[inline(always)]
pub(super) fn basis<S: Simd>(simd: S, [x, y, z]: Vector<S>, degree: u8) -> [f32x16<S>; COEFFICIENTS] {
    let mut b = [splat(simd, 0.0); COEFFICIENTS];
    b[0] = splat(simd, BAND_0 as f32);
    if degree >= 1 {
        b[1] = y * -FIRST;
        b[2] = z * FIRST;
        b[3] = x * -FIRST;
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[4] = x * y * SECOND[0];
        b[5] = y * z * SECOND[1];
        b[6] = (zz * 2.0 - xx - yy) * SECOND[2];
        b[7] = x * z * SECOND[3];
        b[8] = (xx - yy) * SECOND[4];
        if degree >= 3 {
            b[9] = y * (xx * 3.0 - yy) * THIRD[0];
            b[10] = x * y * z * THIRD[1];
            b[11] = y * (zz * 4.0 - xx - yy) * THIRD[2];
            b[12] = z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * THIRD[3];
            b[13] = x * (zz * 4.0 - xx - yy) * THIRD[4];
            b[14] = z * (xx - yy) * THIRD[5];
            b[15] = x * (xx - yy * 3.0) * THIRD[6];
        }
    }
    b
}

/// Sum of the gradients of the basis polynomials in free (x, y, z), each times its entry of `v`.
#[inline(always)]
pub(super) fn basis_backward<S: Simd>(
    simd: S,
    [x, y, z]: Vector<S>,
    degree: u8,
    v: &[f32x16<S>; COEFFICIENTS],
) -> Vector<S> {
    let mut g = [splat(simd, 0.0); 3];
    if degree >= 1 {
        g = [v[3] * -FIRST, v[1] * -FIRST, v[2] * FIRST];
    }
    if degree >= 2 {
        let [a, b, c, d, e] = [
            v[4] * SECOND[0],
            v[5] * SECOND[1],
            v[6] * (2.0 * SECOND[2]),
            v[7] * SECOND[3],
            v[8] * (2.0 * SECOND[4]),
        ];
        g[0] += a * y - c * x + d * z + e * x;
        g[1] += a * x + b * z - c * y - e * y;
        g[2] += b * y + c * z * 2.0 + d * x;
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, xz, yz) = (x * y, x * z, y * z);
        let difference = xx - yy;
        let [a, b, c] = [v[9] * (3.0 * THIRD[0]), v[10] * THIRD[1], v[11] * THIRD[2]];
        let [d, e, f, h] =
            [v[12] * (3.0 * THIRD[3]), v[13] * THIRD[4], v[14] * THIRD[5], v[15] * (3.0 * THIRD[6])];
        g[0] += a * xy * 2.0 + b * yz - c * xy * 2.0 - d * xz * 2.0
            + e * (zz * 4.0 - xx * 3.0 - yy)
            + f * xz * 2.0
            + h * difference;
        g[1] += a * difference + b * xz + c * (zz * 4.0 - xx - yy * 3.0)
            - d * yz * 2.0
            - e * xy * 2.0
            - f * yz * 2.0
            - h * xy * 2.0;
        g[2] += b * xy + c * yz * 8.0 + d * (zz * 2.0 - xx - yy) + e * xz * 8.0 + f * difference;
    }
    g
}

#[cfg(test)]
mod tests {
    use cif_geometry::spherical_harmonics;
    use fearless_simd::dispatch;

    use super::super::SimdLevel;
    use super::super::gaussian_lanes::splat_vector;
    use super::*;

    #[test]
    fn basis_and_gradient_are_those_of_the_plain_formulas() {
        let direction = [0.36_f32, -0.48, 0.8];
        let v: [f32; COEFFICIENTS] = std::array::from_fn(|k| (k as f32 * 1.7 + 0.4).sin());
        for level in SimdLevel::levels() {
            for degree in 0..=3 {
                let (found, back) = dispatch!(level, simd => {
                    let at = splat_vector(simd, direction);
                    let v = v.map(|value| splat(simd, value));
                    let back = basis_backward(simd, at, degree, &v);
                    (basis(simd, at, degree).map(|b| b.to_array()[5]), back.map(|v| v.to_array()[5]))
                });
                let expected = spherical_harmonics::basis(direction, degree);
                let gradient = spherical_harmonics::basis_gradient(direction, degree);
                for (found, expected) in found.iter().zip(expected) {
                    assert!((found - expected).abs() < 1e-6, "{level:?} {degree}: {found} {expected}");
                }
                for (axis, found) in back.iter().enumerate() {
                    let expected: f32 = (0..COEFFICIENTS).map(|k| gradient[k][axis] * v[k]).sum();
                    assert!((found - expected).abs() < 1e-5, "{level:?} {degree}: {found} {expected}");
                }
            }
        }
    }
}
