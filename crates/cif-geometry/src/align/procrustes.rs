//! Robust rigid alignment of two point sets (Kabsch 1976, iteratively re-weighted).

use glam::{DMat3, DVec3};
use nalgebra::Matrix3;

use crate::RigidTransform;
use crate::stats::weighted_quantile;

/// Re-weighting rounds at most.
const ROUNDS: usize = 40;
/// The re-weighting kernel is this many weighted median residuals wide.
const KERNEL_WIDTH: f64 = 2.5;
/// Below this ratio of the second to the first singular value the points lie on a line and fix no rotation.
const COLLINEAR: f64 = 1e-9;

/// `target_from_source` that minimises the weighted sum of squared distances; a proper rotation always.
///
/// Points without extent, or all on one line, fix no rotation: `rotation` is kept then and only the
/// translation is fitted. Weights are 0 or more; when all are 0 the result is `None`.
#[must_use]
pub fn weighted_procrustes(
    source: &[DVec3],
    target: &[DVec3],
    weights: &[f64],
    rotation: DMat3,
) -> Option<RigidTransform> {
    let total: f64 = weights.iter().sum();
    if !(total > 0.0 && total.is_finite()) {
        return None;
    }
    let mean = |points: &[DVec3]| {
        points.iter().zip(weights).fold(DVec3::ZERO, |sum, (point, weight)| sum + *point * *weight) / total
    };
    let (source_mean, target_mean) = (mean(source), mean(target));
    let mut covariance = DMat3::ZERO;
    for ((s, t), weight) in source.iter().zip(target).zip(weights) {
        let (s, t) = ((*s - source_mean) * *weight, *t - target_mean);
        covariance.x_axis += s * t.x;
        covariance.y_axis += s * t.y;
        covariance.z_axis += s * t.z;
    }
    let rotation = rotation_of(&covariance).unwrap_or(rotation);
    Some(RigidTransform { rotation, translation: target_mean - rotation * source_mean })
}

/// The rotation nearest to a matrix, in the Frobenius norm; `None` where the matrix fixes none.
#[must_use]
pub fn polar_rotation(matrix: &DMat3) -> Option<DMat3> {
    rotation_of(&matrix.transpose())
}

/// Rotation R that maximises `trace(R H)` for `H = sum w s t^T`; `None` when H fixes none.
fn rotation_of(covariance: &DMat3) -> Option<DMat3> {
    let h = Matrix3::from_column_slice(&covariance.to_cols_array());
    if !h.iter().all(|value| value.is_finite()) {
        return None;
    }
    let svd = h.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    if svd.singular_values[1] <= COLLINEAR * svd.singular_values[0] || svd.singular_values[0] <= 0.0 {
        return None;
    }
    // Singular values are sorted, so the last axis is the one that costs least to mirror.
    let sign = (v_t.transpose() * u.transpose()).determinant().signum();
    let r = v_t.transpose() * Matrix3::from_diagonal(&[1.0, 1.0, sign].into()) * u.transpose();
    let columns: [f64; 9] = r.as_slice().try_into().ok()?;
    Some(DMat3::from_cols_array(&columns))
}

/// As [`weighted_procrustes`], but points that move differently from the bulk lose their say.
///
/// Starts from the better of the plain fit and `initial`, then re-weights with the Geman-McClure kernel
/// `1 / (1 + (r / c)^2)^2`, c = 2.5 weighted median residuals, until the fit is stationary. Stands up to nearly half
/// of the weight being outliers.
#[must_use]
pub fn robust_procrustes(
    source: &[DVec3],
    target: &[DVec3],
    weights: &[f64],
    initial: RigidTransform,
) -> RigidTransform {
    let Some(plain) = weighted_procrustes(source, target, weights, initial.rotation) else {
        return initial;
    };
    let spread = source
        .iter()
        .zip(weights)
        .map(|(point, weight)| if *weight > 0.0 { point.length() } else { 0.0 })
        .fold(0.0, f64::max);
    let floor = (1e-7 * spread).max(f64::MIN_POSITIVE);
    let median = |fit: &RigidTransform| weighted_quantile(&residuals(fit, source, target), weights, 0.5);
    let mut fit = if median(&initial) < median(&plain) { initial } else { plain };
    let mut reweighted = vec![0.0; weights.len()];
    for _ in 0..ROUNDS {
        let distances = residuals(&fit, source, target);
        let kernel = (KERNEL_WIDTH * weighted_quantile(&distances, weights, 0.5)).max(floor);
        for ((out, weight), distance) in reweighted.iter_mut().zip(weights).zip(&distances) {
            *out = weight / (1.0 + (distance / kernel).powi(2)).powi(2);
        }
        let Some(next) = weighted_procrustes(source, target, &reweighted, fit.rotation) else {
            return fit;
        };
        let change = (next.translation - fit.translation).length()
            + spread * frobenius(&(next.rotation - fit.rotation));
        fit = next;
        if change <= floor {
            break;
        }
    }
    fit
}

fn frobenius(matrix: &DMat3) -> f64 {
    matrix.to_cols_array().iter().map(|value| value * value).sum::<f64>().sqrt()
}

/// Distances `|target - fit(source)|`.
#[must_use]
pub fn residuals(fit: &RigidTransform, source: &[DVec3], target: &[DVec3]) -> Vec<f64> {
    source.iter().zip(target).map(|(s, t)| (*t - fit.apply(*s)).length()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(count: usize) -> Vec<DVec3> {
        // Kronecker sequence: spread out and reproducible.
        let steps = DVec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5);
        (1..=count).map(|k| (steps * k as f64).fract() - 0.5).collect()
    }

    fn motion() -> RigidTransform {
        RigidTransform {
            rotation: DMat3::from_axis_angle(DVec3::new(1.0, -2.0, 0.5).normalize(), 2.1),
            translation: DVec3::new(0.4, -3.0, 1.0),
        }
    }

    fn difference(a: &RigidTransform, b: &RigidTransform) -> f64 {
        frobenius(&(a.rotation - b.rotation)) + (a.translation - b.translation).length()
    }

    #[test]
    fn recovers_a_known_motion() {
        let source = cloud(50);
        let target: Vec<_> = source.iter().map(|p| motion().apply(*p)).collect();
        let weights: Vec<_> = (0..50).map(|k| 1.0 + f64::from(k % 7)).collect();
        let fit = weighted_procrustes(&source, &target, &weights, DMat3::IDENTITY).unwrap();
        assert!(difference(&fit, &motion()) < 1e-12, "{fit:?}");
    }

    #[test]
    fn mirrored_and_flat_clouds_give_rotations() {
        let source = cloud(40);
        let mirrored: Vec<_> = source.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
        let fit = weighted_procrustes(&source, &mirrored, &[1.0; 40], DMat3::IDENTITY).unwrap();
        assert!(fit.orthonormality_error() < 1e-12, "{fit:?}");
        let flat: Vec<_> = source.iter().map(|p| DVec3::new(p.x, p.y, 0.0)).collect();
        let target: Vec<_> = flat.iter().map(|p| motion().apply(*p)).collect();
        let fit = weighted_procrustes(&flat, &target, &[1.0; 40], DMat3::IDENTITY).unwrap();
        assert!(difference(&fit, &motion()) < 1e-9, "{fit:?}");
    }

    #[test]
    fn a_line_keeps_the_given_rotation() {
        let line: Vec<_> = (0..5).map(|k| DVec3::X * f64::from(k)).collect();
        let target: Vec<_> = line.iter().map(|p| *p + DVec3::Y).collect();
        let kept = DMat3::from_rotation_x(0.3);
        let fit = weighted_procrustes(&line, &target, &[1.0; 5], kept).unwrap();
        assert_eq!(fit.rotation, kept);
        assert!((fit.translation - DVec3::Y).length() < 1e-12);
    }

    #[test]
    fn a_third_of_outliers_does_not_move_the_fit() {
        let source = cloud(300);
        let target: Vec<_> = source
            .iter()
            .enumerate()
            .map(|(k, p)| if k % 3 == 0 { *p * 2.0 + DVec3::splat(0.7) } else { motion().apply(*p) })
            .collect();
        let plain = weighted_procrustes(&source, &target, &[1.0; 300], DMat3::IDENTITY).unwrap();
        assert!(difference(&plain, &motion()) > 0.1, "the test has no outliers");
        let fit = robust_procrustes(&source, &target, &[1.0; 300], RigidTransform::IDENTITY);
        assert!(difference(&fit, &motion()) < 1e-4, "{fit:?}");
    }

    #[test]
    fn no_weight_keeps_the_initial_pose() {
        let source = cloud(3);
        let fit = robust_procrustes(&source, &source, &[0.0; 3], motion());
        assert_eq!(fit, motion());
    }
}
