//! Fewer samples of a track, inside an error bound that is measured on the splats.
//!
//! A sample may be left out when interpolation between its kept neighbours (linear in translation, spherical
//! in rotation) puts the splats near enough to where the sample has them. The distance is the weighted RMS
//! over the node's splats, in closed form from the first two moments of their shape.
//!
//! Why the bound holds: the decisive residual of a time is an RMS over the splats that are not outliers. By
//! the triangle inequality of RMS values, model residual + interpolation error bounds the residual of the
//! reduced track, where the interpolation error is taken over the same splats; over all splats it is larger by
//! at most `sqrt(total weight / weight without outliers)`, by which [`allowances`] are reduced.

use cif_geometry::RigidTransform;
use glam::{DMat3, DVec3};

use crate::PoseSample;
use crate::graph::TimeResidual;
use crate::graph::pose_at;

/// Part of the slack that samples may use up; the rest is for rounding to single precision.
const USED_SLACK: f64 = 0.999;

/// Weighted mean and covariance of a shape, which determine how far apart two poses put it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Moments {
    mean: DVec3,
    covariance: DMat3,
}

impl Moments {
    /// Moments of points in their local frame; without weight all points count the same.
    #[must_use]
    pub fn of(points: &[DVec3], weights: &[f64]) -> Self {
        let total: f64 = weights.iter().sum();
        let even = 1.0 / points.len().max(1) as f64;
        let weight = |k: usize| if total > 0.0 { weights[k] / total } else { even };
        let mean = points.iter().enumerate().map(|(k, point)| weight(k) * *point).sum::<DVec3>();
        let mut covariance = DMat3::ZERO;
        for (k, point) in points.iter().enumerate() {
            let d = *point - mean;
            covariance += weight(k) * DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        }
        Self { mean, covariance }
    }

    /// Weighted RMS distance between the shape under two poses.
    #[must_use]
    pub fn deviation(&self, a: &RigidTransform, b: &RigidTransform) -> f64 {
        let turn = a.rotation - b.rotation;
        let shift = turn * self.mean + a.translation - b.translation;
        let spread = turn * self.covariance * turn.transpose();
        let trace = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
        (shift.length_squared() + trace.max(0.0)).sqrt()
    }
}

/// RMS deviation over all splats that every sampled time can still take: what the model's residual leaves of
/// the tolerance. Where a model misses the tolerance (because no better one was allowed), its worst residual
/// takes the tolerance's place, so that reduction never makes the worst time worse.
#[must_use]
pub fn allowances(residuals: &[TimeResidual], tolerance: f64) -> Vec<f64> {
    let bound = residuals.iter().fold(tolerance, |bound, residual| bound.max(residual.decisive));
    residuals
        .iter()
        .map(|residual| {
            USED_SLACK * (bound - residual.decisive).max(0.0) * residual.inlier_share.max(0.0).sqrt()
        })
        .collect()
}

/// Ascending positions of `count` samples that suffice: the first, the last, and between them as few as
/// stepping as far as possible each time gives. `fits(first, last)` says whether all samples between two kept
/// ones may go; it is asked for neighbours too, but they always fit.
#[must_use]
pub fn kept(count: usize, mut fits: impl FnMut(usize, usize) -> bool) -> Vec<usize> {
    let mut kept = vec![0; count.min(1)];
    let mut from = 0;
    while from + 1 < count {
        // Doubles the step while it fits, then halves the interval in which the largest one lies.
        let (mut good, mut step) = (from + 1, 2);
        let mut bad = count;
        while from + step < count {
            if fits(from, from + step) {
                good = from + step;
                step *= 2;
            } else {
                bad = from + step;
                break;
            }
        }
        if bad == count && good < count - 1 && fits(from, count - 1) {
            good = count - 1;
        }
        while good + 1 < bad {
            let middle = good.midpoint(bad);
            if middle < count && fits(from, middle) {
                good = middle;
            } else {
                bad = middle;
            }
        }
        kept.push(good);
        from = good;
    }
    kept
}

/// The track with as few samples as the allowances permit; `deviation(sample, pose)` is the RMS distance
/// between a sample's own pose and an interpolated one. Quaternions of successive samples stay in one
/// hemisphere.
#[must_use]
pub fn reduce(
    track: &[PoseSample],
    allowances: &[f64],
    deviation: impl Fn(usize, &RigidTransform) -> f64,
) -> Vec<PoseSample> {
    let positions = kept(track.len(), |first, last| {
        let ends = [track[first], track[last]];
        (first + 1..last).all(|inner| {
            let pose = pose_at(&ends, DVec3::ZERO, track[inner].time_code).transform();
            deviation(inner, &pose) <= allowances[inner]
        })
    });
    let mut reduced: Vec<PoseSample> = positions.into_iter().map(|position| track[position]).collect();
    one_hemisphere(&mut reduced);
    reduced
}

/// Turns the signs of quaternions so that each is in the hemisphere of the one before.
pub fn one_hemisphere(track: &mut [PoseSample]) {
    for next in 1..track.len() {
        if track[next].rotation.dot(track[next - 1].rotation) < 0.0 {
            track[next].rotation = -track[next].rotation;
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use proptest::prelude::*;

    use super::*;

    fn cloud(count: usize) -> Vec<DVec3> {
        let steps = DVec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5);
        (1..=count).map(|k| (steps * k as f64).fract() - 0.3).collect()
    }

    fn sample(time_code: usize, translation: DVec3, rotation: DQuat) -> PoseSample {
        PoseSample { time_code: time_code as f64, translation, rotation }
    }

    fn rms(points: &[DVec3], weights: &[f64], a: &RigidTransform, b: &RigidTransform) -> f64 {
        let sum: f64 =
            points.iter().zip(weights).map(|(p, w)| w * (a.apply(*p) - b.apply(*p)).length_squared()).sum();
        (sum / weights.iter().sum::<f64>()).sqrt()
    }

    fn reduce_by_shape(
        track: &[PoseSample],
        points: &[DVec3],
        weights: &[f64],
        allowed: f64,
    ) -> Vec<PoseSample> {
        let moments = Moments::of(points, weights);
        reduce(track, &vec![allowed; track.len()], |inner, pose| {
            moments.deviation(&track[inner].transform(), pose)
        })
    }

    #[test]
    fn even_motion_needs_its_ends_only() {
        let track: Vec<PoseSample> = (0..50)
            .map(|k| sample(k, DVec3::X * 0.1 * k as f64, DQuat::from_rotation_y(0.03 * k as f64)))
            .collect();
        let points = cloud(20);
        let reduced = reduce_by_shape(&track, &points, &[1.0; 20], 1e-9);
        assert_eq!(reduced, [track[0], track[49]]);
        assert_eq!(reduce_by_shape(&track[..1], &points, &[1.0; 20], 1.0), track[..1]);
        assert!(reduce_by_shape(&[], &points, &[1.0; 20], 1.0).is_empty());
    }

    #[test]
    fn a_corner_keeps_its_sample_and_no_slack_keeps_all_that_matter() {
        let track: Vec<PoseSample> =
            (0..21).map(|k| sample(k, DVec3::X * (k as f64 - 10.0).abs(), DQuat::IDENTITY)).collect();
        let reduced = reduce_by_shape(&track, &cloud(5), &[1.0; 5], 1e-6);
        assert_eq!(reduced.iter().map(|sample| sample.time_code).collect::<Vec<_>>(), [0.0, 10.0, 20.0]);
    }

    #[test]
    fn more_than_half_a_turn_is_not_cut_short() {
        // 3 turns in 30 steps: the shorter arc between far samples would lose turns.
        let track: Vec<PoseSample> = (0..31)
            .map(|k| sample(k, DVec3::ZERO, DQuat::from_rotation_z(0.2 * std::f64::consts::PI * k as f64)))
            .collect();
        let points = cloud(30);
        let reduced = reduce_by_shape(&track, &points, &[1.0; 30], 0.01);
        assert!(reduced.len() >= 7 && reduced.len() < 16, "{}", reduced.len());
        assert!(reduced.windows(2).all(|pair| pair[0].rotation.dot(pair[1].rotation) >= 0.0));
    }

    #[test]
    fn allowances_are_what_the_model_leaves() {
        let residual = |decisive| TimeResidual { decisive, inlier_share: 0.81 };
        let inside = allowances(&[residual(0.2), residual(1.0)], 1.0);
        assert!((inside[0] - 0.999 * 0.8 * 0.9).abs() < 1e-12 && inside[1] == 0.0);
        let outside = allowances(&[residual(0.5), residual(3.0)], 1.0);
        assert!((outside[0] - 0.999 * 2.5 * 0.9).abs() < 1e-12 && outside[1] == 0.0);
    }

    proptest! {
        /// Moments give the same RMS as the points.
        #[test]
        fn deviations_are_those_of_the_points(
            angles in prop::array::uniform3(-3.0_f64..3.0),
            shift in prop::array::uniform3(-1.0_f64..1.0),
            seed in 0_usize..1000,
        ) {
            let points: Vec<DVec3> = cloud(40).into_iter().map(|p| p + seed as f64 * 0.01).collect();
            let weights: Vec<f64> = (0..40).map(|k| ((k * 7 + seed) % 5) as f64 + 0.1).collect();
            let a = RigidTransform {
                rotation: DMat3::from_euler(glam::EulerRot::XYZ, angles[0], angles[1], angles[2]),
                translation: DVec3::from_array(shift),
            };
            let b = RigidTransform { rotation: DMat3::from_rotation_x(0.3), translation: DVec3::Y };
            let (expected, found) = (rms(&points, &weights, &a, &b), Moments::of(&points, &weights).deviation(&a, &b));
            prop_assert!((expected - found).abs() < 1e-9 * (1.0 + expected), "{expected} {found}");
        }

        /// Random walks: every sample that was left out is reproduced inside its allowance, ends are kept.
        #[test]
        fn reduced_tracks_stay_inside(
            steps in prop::collection::vec(prop::array::uniform6(-0.3_f64..0.3), 1..60),
            allowed in 0.0_f64..0.5,
        ) {
            let (mut translation, mut rotation) = (DVec3::ZERO, DQuat::IDENTITY);
            let track: Vec<PoseSample> = steps
                .iter()
                .enumerate()
                .map(|(k, step)| {
                    translation += DVec3::new(step[0], step[1], step[2]);
                    rotation = (DQuat::from_scaled_axis(DVec3::new(step[3], step[4], step[5])) * rotation).normalize();
                    sample(3 * k, translation, rotation)
                })
                .collect();
            let (points, weights) = (cloud(25), [1.0; 25]);
            let reduced = reduce_by_shape(&track, &points, &weights, allowed);
            prop_assert_eq!(reduced[0], track[0]);
            prop_assert_eq!(reduced[reduced.len() - 1].time_code, track[track.len() - 1].time_code);
            for full in &track {
                let pose = pose_at(&reduced, DVec3::ZERO, full.time_code).transform();
                prop_assert!(rms(&points, &weights, &pose, &full.transform()) <= allowed + 1e-9);
            }
        }
    }
}
