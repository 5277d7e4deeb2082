//! Rotations from (w, x, y, z) quaternions, with derivative. Source: methods reference 3.1 and 3.2 step 7.

use crate::Real;

/// Below this norm a quaternion carries no rotation and its Gaussian is skipped.
pub const MIN_NORM: f64 = 1e-6;

/// Norm of a raw quaternion.
pub fn norm<R: Real>(q: [R; 4]) -> R {
    (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt()
}

/// `q / |q|`, or `None` when the norm is below [`MIN_NORM`] or not finite.
pub fn try_normalize<R: Real>(q: [R; 4]) -> Option<[R; 4]> {
    let n = norm(q);
    if n.is_finite() && n >= R::of(MIN_NORM) { Some(q.map(|c| c / n)) } else { None }
}

/// Rotation matrix `[row][column]` of a unit quaternion.
pub fn to_rotation<R: Real>([w, x, y, z]: [R; 4]) -> [[R; 3]; 3] {
    let (one, two) = (R::one(), R::of(2.0));
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// Gradient of the raw quaternion `q` from the gradient `v_r[row][column]` of its rotation matrix.
pub fn to_rotation_backward<R: Real>(q: [R; 4], v_r: [[R; 3]; 3]) -> [R; 4] {
    let n = norm(q);
    let unit = q.map(|c| c / n);
    let [w, x, y, z] = unit;
    let two = R::of(2.0);
    let g = [
        two * (x * (v_r[2][1] - v_r[1][2]) + y * (v_r[0][2] - v_r[2][0]) + z * (v_r[1][0] - v_r[0][1])),
        two * (-two * x * (v_r[1][1] + v_r[2][2])
            + y * (v_r[1][0] + v_r[0][1])
            + z * (v_r[2][0] + v_r[0][2])
            + w * (v_r[2][1] - v_r[1][2])),
        two * (x * (v_r[1][0] + v_r[0][1]) - two * y * (v_r[0][0] + v_r[2][2])
            + z * (v_r[2][1] + v_r[1][2])
            + w * (v_r[0][2] - v_r[2][0])),
        two * (x * (v_r[2][0] + v_r[0][2]) + y * (v_r[2][1] + v_r[1][2]) - two * z * (v_r[0][0] + v_r[1][1])
            + w * (v_r[1][0] - v_r[0][1])),
    ];
    let radial = unit[0] * g[0] + unit[1] * g[1] + unit[2] * g[2] + unit[3] * g[3];
    std::array::from_fn(|k| (g[k] - unit[k] * radial) / n)
}

/// Hamilton product `a b`: the rotation b first, then a.
pub fn multiply<R: Real>(a: [R; 4], b: [R; 4]) -> [R; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivative_matches_central_differences() {
        let q = [0.8_f64, -0.3, 0.5, 0.2];
        let v_r = [[0.3, -1.0, 0.2], [0.7, 0.1, -0.4], [0.9, -0.6, 0.5]];
        let value = |q: [f64; 4]| {
            let r = to_rotation(try_normalize(q).unwrap());
            (0..9).map(|k| r[k / 3][k % 3] * v_r[k / 3][k % 3]).sum::<f64>()
        };
        let analytic = to_rotation_backward(q, v_r);
        for k in 0..4 {
            let (mut lower, mut upper) = (q, q);
            lower[k] -= 1e-6;
            upper[k] += 1e-6;
            let numerical = (value(upper) - value(lower)) / 2e-6;
            assert!((numerical - analytic[k]).abs() < 1e-8, "{k}: {numerical} vs {}", analytic[k]);
        }
    }

    #[test]
    fn product_composes_rotations() {
        let a = try_normalize([0.9_f64, 0.1, -0.4, 0.2]).unwrap();
        let b = try_normalize([0.2_f64, 0.7, 0.3, -0.5]).unwrap();
        let (ra, rb, rab) = (to_rotation(a), to_rotation(b), to_rotation(multiply(a, b)));
        for i in 0..3 {
            for j in 0..3 {
                let expected: f64 = (0..3).map(|k| ra[i][k] * rb[k][j]).sum();
                assert!((rab[i][j] - expected).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_vanishing_quaternion_has_no_rotation() {
        assert!(try_normalize([0.0_f32; 4]).is_none());
        assert!(try_normalize([f32::NAN, 0.0, 0.0, 1.0]).is_none());
    }
}
