//! Turns functions written in the basis of [`super::basis`]: the real Wigner D matrices of degrees 1 to 3.
//!
//! Source: J. Ivanic and K. Ruedenberg, "Rotation Matrices for Real Spherical Harmonics. Direct Determination
//! by Recursion", J. Phys. Chem. 100 (1996) 6342, with the corrections of 102 (1998) 9099. Their harmonics have
//! no Condon-Shortley sign, ours have it: entry (m, n) of theirs times `(-1)^(m + n)` is ours.

use crate::{Real, quaternion};

/// Coefficients of a function on the sphere follow a rotation `Q`: `f'(d) = f(Q^T d)`.
///
/// One matrix per degree, `coefficients' = D coefficients`; degree 0 does not change. The matrices are exact
/// polynomials of the rotation's entries, so they are as accurate as it is. Mirrors work too: any orthogonal
/// matrix does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarmonicsRotation<R> {
    degree_1: [[R; 3]; 3],
    degree_2: [[R; 5]; 5],
    degree_3: [[R; 7]; 7],
}

impl<R: Real> HarmonicsRotation<R> {
    /// The matrices of an orthogonal matrix `[row][column]`, `target_from_source`: coefficients in the source
    /// frame become coefficients of the same appearance in the target frame.
    #[must_use]
    pub fn new(rotation: [[R; 3]; 3]) -> Self {
        // Order -1, 0, 1 is y, z, x.
        const AXES: [usize; 3] = [1, 2, 0];
        let first = AXES.map(|row| AXES.map(|column| rotation[row][column]));
        let second: [[R; 5]; 5] = next_degree(&first, &first);
        let third: [[R; 7]; 7] = next_degree(&first, &second);
        Self { degree_1: with_sign(first), degree_2: with_sign(second), degree_3: with_sign(third) }
    }

    /// The matrices of a unit quaternion (w, x, y, z).
    #[must_use]
    pub fn from_quaternion(unit: [R; 4]) -> Self {
        Self::new(quaternion::to_rotation(unit))
    }

    /// Turns the coefficients of one splat in place: `[(degree + 1)^2, 3]`, DC first, RGB inner.
    ///
    /// The degree follows from the length; entries beyond the last whole degree (4, 9 or 16 coefficients) are
    /// left alone.
    pub fn rotate(&self, coefficients: &mut [R]) {
        let count = coefficients.len() / 3;
        if count >= 4 {
            turn(&self.degree_1, &mut coefficients[3..12]);
        }
        if count >= 9 {
            turn(&self.degree_2, &mut coefficients[12..27]);
        }
        if count >= 16 {
            turn(&self.degree_3, &mut coefficients[27..48]);
        }
    }

    /// Turns the coefficients of many splats in place: `[N, (degree + 1)^2, 3]`, splat-major.
    pub fn rotate_all(&self, coefficients: &mut [R], degree: u8) {
        if degree > 0 {
            for splat in coefficients.chunks_exact_mut(3 * super::coefficient_count(degree)) {
                self.rotate(splat);
            }
        }
    }
}

/// `D x` for the three channels of one degree.
fn turn<R: Real, const N: usize>(matrix: &[[R; N]; N], band: &mut [R]) {
    let before: [[R; 3]; N] = std::array::from_fn(|m| std::array::from_fn(|channel| band[3 * m + channel]));
    for (m, row) in matrix.iter().enumerate() {
        for channel in 0..3 {
            band[3 * m + channel] = row.iter().zip(&before).map(|(d, rgb)| *d * rgb[channel]).sum();
        }
    }
}

/// To our sign of odd orders.
fn with_sign<R: Real, const N: usize>(matrix: [[R; N]; N]) -> [[R; N]; N] {
    std::array::from_fn(|m| {
        std::array::from_fn(|n| if (m + n) % 2 == 0 { matrix[m][n] } else { -matrix[m][n] })
    })
}

/// The matrix of degree `l = (N - 1) / 2` from those of degree 1 and `l - 1`; `M = N - 2`.
fn next_degree<R: Real, const M: usize, const N: usize>(
    first: &[[R; 3]; 3],
    previous: &[[R; M]; M],
) -> [[R; N]; N] {
    let degree = (N as i32 - 1) / 2;
    let at = |m: i32, n: i32| previous[(m + degree - 1) as usize][(n + degree - 1) as usize];
    // P of the paper, table 2.
    let product = |i: i32, m: i32, n: i32| {
        let row = first[(i + 1) as usize];
        if n == degree {
            row[2] * at(m, degree - 1) - row[0] * at(m, 1 - degree)
        } else if n == -degree {
            row[2] * at(m, 1 - degree) + row[0] * at(m, degree - 1)
        } else {
            row[1] * at(m, n)
        }
    };
    // u U + v V + w W of the paper, tables 1 and 2.
    let entry = |m: i32, n: i32| {
        let (l, size) = (degree, m.abs());
        let below = if n.abs() == l { 2 * l * (2 * l - 1) } else { (l + n) * (l - n) };
        let root = |above: i32| R::of((f64::from(above) / f64::from(below)).sqrt());
        let mut sum = R::zero();
        if size < l {
            sum += root((l + m) * (l - m)) * product(0, m, n);
        }
        let v = R::of(0.5) * root((l + size - 1) * (l + size));
        let two = R::of(std::f64::consts::SQRT_2);
        sum += match m {
            0 => -two * v * (product(1, 1, n) + product(-1, -1, n)),
            1 => two * v * product(1, 0, n),
            -1 => two * v * product(-1, 0, n),
            _ if m > 0 => v * (product(1, m - 1, n) - product(-1, 1 - m, n)),
            _ => v * (product(1, m + 1, n) + product(-1, -m - 1, n)),
        };
        if size > 0 && size < l - 1 {
            let w = R::of(0.5) * root((l - size - 1) * (l - size));
            sum -= w * if m > 0 {
                product(1, m + 1, n) + product(-1, -m - 1, n)
            } else {
                product(1, m - 1, n) - product(-1, 1 - m, n)
            };
        }
        sum
    };
    std::array::from_fn(|m| std::array::from_fn(|n| entry(m as i32 - degree, n as i32 - degree)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spherical_harmonics::basis;

    /// Numbers in [-1, 1) without chance.
    fn sequence(seed: u32) -> impl FnMut() -> f64 {
        let mut state = u64::from(seed).wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        }
    }

    fn unit<const N: usize>(next: &mut impl FnMut() -> f64) -> [f64; N] {
        let v: [f64; N] = std::array::from_fn(|_| next());
        let norm = v.iter().map(|c| c * c).sum::<f64>().sqrt();
        v.map(|c| c / norm)
    }

    fn apply(matrix: [[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
        matrix.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum())
    }

    fn color(coefficients: &[f64], direction: [f64; 3], degree: u8) -> [f64; 3] {
        let values = basis(direction, degree);
        std::array::from_fn(|channel| {
            coefficients.chunks_exact(3).zip(values).map(|(rgb, b)| rgb[channel] * b).sum()
        })
    }

    #[test]
    fn turned_coefficients_give_the_turned_function() {
        for seed in 0..50 {
            let mut next = sequence(seed);
            let mut rotation = quaternion::to_rotation(unit::<4>(&mut next));
            if seed % 5 == 4 {
                rotation = rotation.map(|row| row.map(|value| -value));
            }
            let degree = (seed % 4) as u8;
            let count = 3 * crate::spherical_harmonics::coefficient_count(degree);
            let before: Vec<f64> = (0..count).map(|_| next()).collect();
            let mut after = before.clone();
            HarmonicsRotation::new(rotation).rotate(&mut after);
            for _ in 0..20 {
                let direction = unit::<3>(&mut next);
                let expected = color(&before, direction, degree);
                let found = color(&after, apply(rotation, direction), degree);
                for channel in 0..3 {
                    assert!(
                        (expected[channel] - found[channel]).abs() < 1e-13,
                        "seed {seed} degree {degree}: {expected:?} {found:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn rotations_compose_and_the_identity_changes_nothing() {
        let mut next = sequence(7);
        let (a, b) = (unit::<4>(&mut next), unit::<4>(&mut next));
        let before: [f64; 48] = std::array::from_fn(|_| next());
        let (mut twice, mut once, mut same) = (before, before, before);
        HarmonicsRotation::from_quaternion(b).rotate(&mut twice);
        HarmonicsRotation::from_quaternion(a).rotate(&mut twice);
        HarmonicsRotation::from_quaternion(quaternion::multiply(a, b)).rotate(&mut once);
        HarmonicsRotation::from_quaternion([1.0, 0.0, 0.0, 0.0]).rotate(&mut same);
        for k in 0..48 {
            assert!((twice[k] - once[k]).abs() < 1e-13, "{k}");
            assert!((same[k] - before[k]).abs() < 1e-15, "{k}");
        }
    }

    #[test]
    fn single_precision_keeps_single_precision() {
        let mut next = sequence(3);
        let q = unit::<4>(&mut next);
        let before: [f64; 48] = std::array::from_fn(|_| next());
        let (mut double, mut single) = (before, before.map(|v| v as f32));
        HarmonicsRotation::from_quaternion(q).rotate(&mut double);
        HarmonicsRotation::from_quaternion(q.map(|v| v as f32)).rotate(&mut single);
        for k in 0..48 {
            assert!((double[k] - f64::from(single[k])).abs() < 3e-6, "{k}");
        }
    }

    #[test]
    fn many_splats_turn_as_one_by_one_and_the_dc_stays() {
        let mut next = sequence(11);
        let rotation = HarmonicsRotation::from_quaternion(unit::<4>(&mut next));
        let before: Vec<f64> = (0..3 * 3 * 9).map(|_| next()).collect();
        let (mut all, mut single) = (before.clone(), before.clone());
        rotation.rotate_all(&mut all, 2);
        single.chunks_exact_mut(27).for_each(|splat| rotation.rotate(splat));
        assert_eq!(all, single);
        for (splat, original) in all.chunks_exact(27).zip(before.chunks_exact(27)) {
            assert_eq!(splat[..3], original[..3]);
            assert_ne!(splat[3..], original[3..]);
        }
        let mut constant = [0.25, 0.5, 0.75];
        rotation.rotate_all(&mut constant, 0);
        assert_eq!(constant, [0.25, 0.5, 0.75]);
    }
}
