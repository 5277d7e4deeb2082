//! Splats of every sampled time for nodes that deform, and fewer of them inside an error bound.

use cif_geometry::{RigidTransform, quaternion};

use crate::field_motion::frames::Frame;
use crate::graph::DenseSample;
use crate::motion::group::MovingGroup;
use crate::motion::keys;
use crate::motion::residuals::trimmed_rms;
use crate::placement::{angle_between, normalized_lerp};
use crate::shape::extent;
use crate::shape::flat;
use crate::shape::proxy::systematic;
use crate::vectors::{dot, quaternion_of, vector};

/// Relative change of a scale over time that makes scales sampled.
const SAME_SCALE: f64 = 1e-4;
/// Splats that samples to leave out are looked for with; the bound is then checked on all.
const SEARCHED: usize = 8192;

/// The splats of a group at one time, in the local frame `pose` of that time.
pub(crate) fn sample(
    group: &MovingGroup,
    gaussians: &Frame,
    pose: &RigidTransform,
    time_code: f64,
    previous: Option<&DenseSample>,
) -> DenseSample {
    let local = pose.inverse();
    let turn = quaternion_of(&local.rotation);
    let mut means = Vec::with_capacity(group.rows.len());
    let mut orientations = Vec::with_capacity(group.rows.len());
    let mut scales = Vec::with_capacity(group.rows.len());
    for (k, &row) in group.rows.iter().enumerate() {
        let row = row as usize;
        means.push(local.apply(vector(gaussians.means[row])).to_array().map(|value| value as f32));
        let before = previous.map(|sample| sample.orientations[k]);
        let unit = quaternion::try_normalize(gaussians.quaternions[row].map(f64::from));
        let orientation = match unit {
            Some(unit) => {
                let turned = quaternion::multiply(turn, unit);
                let reference = before.map_or([1.0, 0.0, 0.0, 0.0], |before| before.map(f64::from));
                let sign = if dot(turned, reference) < 0.0 { -1.0 } else { 1.0 };
                turned.map(|component| (sign * component) as f32)
            }
            None => before.unwrap_or([1.0, 0.0, 0.0, 0.0]),
        };
        orientations.push(orientation);
        scales.push(gaussians.log_scales[row].map(|log| flat::scale(log.into())));
    }
    let extent = extent::ellipsoid_bounds(&RigidTransform::IDENTITY, &means, &orientations, &scales);
    DenseSample { time_code, means, orientations, scales: Some(scales), extent }
}

/// Scales that never change need no samples.
pub(crate) fn drop_constant_scales(samples: &mut [DenseSample]) {
    let Some((first, rest)) = samples.split_first() else { return };
    let Some(first) = &first.scales else { return };
    let same = |a: &[f32; 3], b: &[f32; 3]| {
        a.iter().zip(b).all(|(a, b)| f64::from((a - b).abs()) <= SAME_SCALE * f64::from(*a))
    };
    let constant = rest
        .iter()
        .filter_map(|sample| sample.scales.as_ref())
        .all(|scales| scales.iter().zip(first).all(|(scale, first)| same(first, scale)));
    if constant {
        for sample in samples {
            sample.scales = None;
        }
    }
}

/// Leaves out samples that interpolation between the kept ones reproduces: the trimmed RMS distance of the
/// splats stays within `tolerance` at every sample. A splat's distance is made up of how far its centre is off,
/// how far a turn moves the end of its longest axis, and how far its scales are off.
pub(crate) fn reduce(
    samples: Vec<DenseSample>,
    weights: &[f64],
    trim: f64,
    tolerance: f64,
) -> Vec<DenseSample> {
    let all: Vec<u32> = (0..weights.len() as u32).collect();
    let searched = if all.len() <= SEARCHED { all.clone() } else { systematic(&all, weights, SEARCHED) };
    let fits = |first: usize, last: usize, splats: &[u32]| {
        (first + 1..last).all(|inner| {
            let (a, b) = (&samples[first], &samples[last]);
            error(a, b, &samples[inner], splats, weights, trim, tolerance) <= tolerance
        })
    };
    let mut kept = keys::kept(samples.len(), |first, last| fits(first, last, &searched));
    if searched.len() < all.len() {
        // What only the others show to be wrong is halved until all of them agree.
        let mut position = 0;
        while position + 1 < kept.len() {
            let (first, last) = (kept[position], kept[position + 1]);
            if last - first > 1 && !fits(first, last, &all) {
                kept.insert(position + 1, first.midpoint(last));
            } else {
                position += 1;
            }
        }
    }
    let mut kept = kept.into_iter().peekable();
    samples
        .into_iter()
        .enumerate()
        .filter_map(|(index, sample)| kept.next_if_eq(&index).map(|_| sample))
        .collect()
}

/// Trimmed RMS distance between a sample and the interpolation of two others, `a` before and `b` after it; what is certainly inside the
/// tolerance is not trimmed.
fn error(
    a: &DenseSample,
    b: &DenseSample,
    sample: &DenseSample,
    splats: &[u32],
    weights: &[f64],
    trim: f64,
    tolerance: f64,
) -> f64 {
    let fraction = (sample.time_code - a.time_code) / (b.time_code - a.time_code);
    let (mut squares, mut total) = (0.0, 0.0);
    let distances: Vec<f64> = splats
        .iter()
        .map(|&splat| {
            let k = splat as usize;
            let off = vector(a.means[k]).lerp(vector(b.means[k]), fraction) - vector(sample.means[k]);
            let mut square = off.length_squared();
            if let (Some(a), Some(b), Some(scales)) = (&a.scales, &b.scales, &sample.scales) {
                let off = vector(a[k]).lerp(vector(b[k]), fraction) - vector(scales[k]);
                square += off.length_squared();
            }
            if let Some(scales) = &sample.scales {
                let scale = vector(scales[k]);
                let mixed = normalized_lerp(
                    a.orientations[k].map(f64::from),
                    b.orientations[k].map(f64::from),
                    fraction,
                );
                let angle = angle_between(mixed, sample.orientations[k].map(f64::from));
                square += (angle * (scale.max_element() - scale.min_element())).powi(2);
            }
            squares += weights[k] * square;
            total += weights[k];
            square.sqrt()
        })
        .collect();
    if squares <= tolerance * tolerance * total {
        return if total > 0.0 { (squares / total).sqrt() } else { 0.0 };
    }
    let weights: Vec<f64> = splats.iter().map(|&splat| weights[splat as usize]).collect();
    trimmed_rms(&distances, &weights, trim).0
}

#[cfg(test)]
mod tests {
    use cif_geometry::Bounds;
    use proptest::prelude::*;

    use super::*;

    fn samples(times: usize, splats: usize, mean: impl Fn(usize, usize) -> f32) -> Vec<DenseSample> {
        (0..times)
            .map(|time| DenseSample {
                time_code: 2.0 * time as f64,
                means: (0..splats).map(|k| [mean(time, k), k as f32, 0.0]).collect(),
                orientations: vec![[1.0, 0.0, 0.0, 0.0]; splats],
                scales: Some(vec![[0.1, 0.1, 0.2]; splats]),
                extent: Bounds::EMPTY,
            })
            .collect()
    }

    fn codes(samples: &[DenseSample]) -> Vec<f64> {
        samples.iter().map(|sample| sample.time_code).collect()
    }

    #[test]
    fn straight_paths_need_their_ends_and_corners_stay() {
        let straight = samples(30, 5, |time, k| (time * k) as f32);
        assert_eq!(codes(&reduce(straight, &[1.0; 5], 0.0, 1e-4)), [0.0, 58.0]);
        let corner = samples(21, 5, |time, _| (time as f32 - 10.0).abs());
        assert_eq!(codes(&reduce(corner, &[1.0; 5], 0.0, 1e-4)), [0.0, 20.0, 40.0]);
        let all = samples(9, 5, |time, _| (time % 2) as f32);
        assert_eq!(reduce(all.clone(), &[1.0; 5], 0.0, 0.1), all);
    }

    #[test]
    fn turns_and_scales_count() {
        let mut turning = samples(3, 4, |_, _| 0.0);
        turning[1].orientations.fill([0.0, 1.0, 0.0, 0.0]);
        assert_eq!(reduce(turning.clone(), &[1.0; 4], 0.0, 0.05).len(), 3);
        for sample in &mut turning {
            sample.scales = Some(vec![[0.1; 3]; 4]);
        }
        assert_eq!(reduce(turning, &[1.0; 4], 0.0, 0.05).len(), 2, "round splats may turn");
        let mut growing = samples(3, 4, |_, _| 0.0);
        growing[1].scales = Some(vec![[0.1, 0.1, 0.4]; 4]);
        assert_eq!(reduce(growing, &[1.0; 4], 0.0, 0.05).len(), 3);
    }

    #[test]
    fn outliers_within_the_trim_do_not_hold_samples() {
        let jumping = |time: usize, k: usize| if k == 0 { (time % 2) as f32 } else { 0.0 };
        assert_eq!(reduce(samples(20, 40, jumping), &[1.0; 40], 0.05, 0.01).len(), 2);
        assert_eq!(reduce(samples(20, 40, jumping), &[1.0; 40], 0.0, 0.01).len(), 20);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn what_is_left_out_is_reproduced(
            walk in prop::collection::vec(prop::collection::vec(-0.2_f32..0.2, 6), 1..30),
            tolerance in 0.0_f64..0.4,
        ) {
            let mut places = vec![0.0_f32; 6];
            let paths: Vec<Vec<f32>> = walk
                .iter()
                .map(|steps| {
                    for (place, step) in places.iter_mut().zip(steps) {
                        *place += step;
                    }
                    places.clone()
                })
                .collect();
            let full = samples(paths.len(), 6, |time, k| paths[time][k]);
            let reduced = reduce(full.clone(), &[1.0; 6], 0.0, tolerance);
            prop_assert_eq!(&reduced[0], &full[0]);
            prop_assert_eq!(reduced.last(), full.last());
            for sample in &full {
                let after = reduced.partition_point(|kept| kept.time_code <= sample.time_code);
                let (a, b) = (&reduced[after - 1], &reduced[after.min(reduced.len() - 1)]);
                if a.time_code < b.time_code {
                    let fraction = ((sample.time_code - a.time_code) / (b.time_code - a.time_code)) as f32;
                    let squares: f32 = (0..6)
                        .map(|k| {
                            let mixed = a.means[k][0] + fraction * (b.means[k][0] - a.means[k][0]);
                            (mixed - sample.means[k][0]).powi(2)
                        })
                        .sum();
                    prop_assert!(f64::from((squares / 6.0).sqrt()) <= tolerance + 1e-5);
                } else {
                    prop_assert_eq!(&a.means, &sample.means);
                }
            }
        }
    }
}
