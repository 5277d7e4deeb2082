//! Real spherical harmonics with the Condon-Shortley sign, degrees 0 to 3, as 3D Gaussian splatting uses
//! them: `colour = max(0, sum_m basis_m(direction) * coefficient_m + 0.5)`. Source: methods reference 3.1.

mod rotation;

pub use rotation::HarmonicsRotation;

use crate::Real;

/// Coefficients per colour channel at degree 3.
pub const COEFFICIENTS: usize = 16;

/// Basis value of degree 0.
pub const BAND_0: f64 = 0.282_094_791_773_878_14;

/// Basis factor of degree 1, up to its signs.
pub const BAND_1: f64 = 0.488_602_511_902_919_9;
/// Basis factors of degree 2, in order.
pub const BAND_2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
/// Basis factors of degree 3, in order.
pub const BAND_3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Number of coefficients per channel of a degree: `(degree + 1)^2`.
#[must_use]
pub const fn coefficient_count(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// Basis values at the unit direction (x, y, z); entries above `degree` are 0.
pub fn basis<R: Real>([x, y, z]: [R; 3], degree: u8) -> [R; COEFFICIENTS] {
    let c = R::of;
    let mut b = [R::zero(); COEFFICIENTS];
    b[0] = c(BAND_0);
    if degree >= 1 {
        b[1] = -c(BAND_1) * y;
        b[2] = c(BAND_1) * z;
        b[3] = -c(BAND_1) * x;
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[4] = c(BAND_2[0]) * x * y;
        b[5] = c(BAND_2[1]) * y * z;
        b[6] = c(BAND_2[2]) * (c(2.0) * zz - xx - yy);
        b[7] = c(BAND_2[3]) * x * z;
        b[8] = c(BAND_2[4]) * (xx - yy);
        if degree >= 3 {
            b[9] = c(BAND_3[0]) * y * (c(3.0) * xx - yy);
            b[10] = c(BAND_3[1]) * x * y * z;
            b[11] = c(BAND_3[2]) * y * (c(4.0) * zz - xx - yy);
            b[12] = c(BAND_3[3]) * z * (c(2.0) * zz - c(3.0) * xx - c(3.0) * yy);
            b[13] = c(BAND_3[4]) * x * (c(4.0) * zz - xx - yy);
            b[14] = c(BAND_3[5]) * z * (xx - yy);
            b[15] = c(BAND_3[6]) * x * (xx - c(3.0) * yy);
        }
    }
    b
}

/// Gradient of each basis polynomial in free (x, y, z): no unit-norm substitution.
pub fn basis_gradient<R: Real>([x, y, z]: [R; 3], degree: u8) -> [[R; 3]; COEFFICIENTS] {
    let c = R::of;
    let o = R::zero();
    let mut g = [[o; 3]; COEFFICIENTS];
    if degree >= 1 {
        g[1] = [o, -c(BAND_1), o];
        g[2] = [o, o, c(BAND_1)];
        g[3] = [-c(BAND_1), o, o];
    }
    if degree >= 2 {
        let two = c(2.0);
        g[4] = [c(BAND_2[0]) * y, c(BAND_2[0]) * x, o];
        g[5] = [o, c(BAND_2[1]) * z, c(BAND_2[1]) * y];
        g[6] = [-two * c(BAND_2[2]) * x, -two * c(BAND_2[2]) * y, c(4.0 * BAND_2[2]) * z];
        g[7] = [c(BAND_2[3]) * z, o, c(BAND_2[3]) * x];
        g[8] = [two * c(BAND_2[4]) * x, -two * c(BAND_2[4]) * y, o];
        if degree >= 3 {
            let (xx, yy, zz) = (x * x, y * y, z * z);
            let (three, four, six, eight) = (c(3.0), c(4.0), c(6.0), c(8.0));
            g[9] = [c(BAND_3[0]) * six * x * y, c(BAND_3[0]) * three * (xx - yy), o];
            g[10] = [c(BAND_3[1]) * y * z, c(BAND_3[1]) * x * z, c(BAND_3[1]) * x * y];
            g[11] = [
                -two * c(BAND_3[2]) * x * y,
                c(BAND_3[2]) * (four * zz - xx - three * yy),
                c(BAND_3[2]) * eight * y * z,
            ];
            g[12] = [
                -six * c(BAND_3[3]) * x * z,
                -six * c(BAND_3[3]) * y * z,
                c(BAND_3[3]) * three * (two * zz - xx - yy),
            ];
            g[13] = [
                c(BAND_3[4]) * (four * zz - three * xx - yy),
                -two * c(BAND_3[4]) * x * y,
                c(BAND_3[4]) * eight * x * z,
            ];
            g[14] = [two * c(BAND_3[5]) * x * z, -two * c(BAND_3[5]) * y * z, c(BAND_3[5]) * (xx - yy)];
            g[15] = [c(BAND_3[6]) * three * (xx - yy), -six * c(BAND_3[6]) * x * y, o];
        }
    }
    g
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradient_matches_central_differences() {
        let d = [0.36_f64, -0.48, 0.8];
        let g = basis_gradient(d, 3);
        for axis in 0..3 {
            let (mut lower, mut upper) = (d, d);
            lower[axis] -= 1e-6;
            upper[axis] += 1e-6;
            let (l, u) = (basis(lower, 3), basis(upper, 3));
            for m in 0..COEFFICIENTS {
                let numerical = (u[m] - l[m]) / 2e-6;
                assert!((numerical - g[m][axis]).abs() < 1e-8, "{m} {axis}: {numerical} {}", g[m][axis]);
            }
        }
    }

    #[test]
    fn basis_is_orthonormal_on_the_sphere() {
        // Fibonacci points integrate low-degree polynomials to about 1 / count.
        let count = 20_000;
        let mut gram = [[0.0_f64; COEFFICIENTS]; COEFFICIENTS];
        for k in 0..count {
            let z = 1.0 - (2.0 * f64::from(k) + 1.0) / f64::from(count);
            let (s, c) = (f64::from(k) * 2.399_963_229_728_653).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let b = basis([r * c, r * s, z], 3);
            for i in 0..COEFFICIENTS {
                for j in 0..COEFFICIENTS {
                    gram[i][j] += b[i] * b[j] * 4.0 * std::f64::consts::PI / f64::from(count);
                }
            }
        }
        for i in 0..COEFFICIENTS {
            for j in 0..COEFFICIENTS {
                let expected = f64::from(u8::from(i == j));
                assert!((gram[i][j] - expected).abs() < 2e-3, "{i} {j} {}", gram[i][j]);
            }
        }
    }

    #[test]
    fn higher_bands_are_zero_below_their_degree() {
        let b = basis([0.6_f32, 0.0, 0.8], 1);
        assert!(b[4..].iter().all(|v| *v == 0.0));
    }
}
