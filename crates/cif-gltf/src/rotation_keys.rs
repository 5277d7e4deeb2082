//! Rotation keys so close that viewers which draw straight lines between quaternions turn as the file says.
//!
//! glTF asks for slerp between LINEAR rotation keys; common viewers interpolate the four components and
//! normalise. Both follow the same arc, but at different speeds: over a turn of angle a the two differ by at most
//! 2 max_t |atan2(t sin(a/2), 1 - t + t cos(a/2)) - t a/2| = sqrt(3) / 432 a^3 + O(a^5). Reduced tracks turn by up
//! to half a turn between keys, where that is 8 degrees. So keys on the slerp are written between them, close
//! enough for [`allowed_error`], and the sampler's `extras.cif.inserted` says which they are: reading drops
//! those that still lie where they were put, and a track comes back with the keys it had.

use std::f64::consts::PI;

use cif_scene::MotionReport;
use glam::{DQuat, DVec4};
use serde::{Deserialize, Serialize};

/// Most radians by which a rotation may be off between keys: 0.2 pixels at 500 pixels from a camera's axis, and
/// below a thousandth of an object's size even where a part turns in a turning object.
pub(crate) const LARGEST_ERROR: f64 = 4e-4;
/// Radians below which single precision differs anyway.
const SMALLEST_ERROR: f64 = 1e-6;
/// Share of the tolerance of an object that may be lost at its size's distance from the pivot.
const SHARE_OF_TOLERANCE: f64 = 0.04;
/// A marked key that is further than this from the slerp was changed since: 16 steps of single precision.
const MOVED: f64 = 1e-6;

/// `extras` of an animation sampler.
#[derive(Serialize, Deserialize)]
pub(crate) struct SamplerExtras {
    pub(crate) cif: Inserted,
}

/// Keys of a sampler that are not part of the track.
#[derive(Serialize, Deserialize)]
pub(crate) struct Inserted {
    /// Positions among the keys, ascending.
    pub(crate) inserted: Vec<usize>,
}

/// Keys as they are written.
#[derive(Debug)]
pub(crate) struct Filled {
    /// Seconds.
    pub(crate) seconds: Vec<f32>,
    pub(crate) rotations: Vec<DQuat>,
    /// Positions of the keys that were put between others.
    pub(crate) inserted: Vec<usize>,
}

/// Radians by which the rotation of an object may be off between keys, from its tolerance.
pub(crate) fn allowed_error(report: &MotionReport) -> f64 {
    let share = SHARE_OF_TOLERANCE * report.tolerance / report.size;
    if share.is_finite() && share > 0.0 { share.clamp(SMALLEST_ERROR, LARGEST_ERROR) } else { LARGEST_ERROR }
}

/// Largest angle between keys, radians, for which straight lines are off by no more than `error` radians.
fn largest_turn(error: f64) -> f64 {
    (432.0 / 3.0_f64.sqrt() * error).cbrt().min(PI)
}

/// Puts keys between those of a track wherever it turns too far for straight lines. `seconds` ascend;
/// neighbours in the result are in one hemisphere.
pub(crate) fn filled(seconds: &[f32], rotations: &[DQuat], error: f64) -> Filled {
    let largest = largest_turn(error);
    let mut filled = Filled { seconds: Vec::new(), rotations: Vec::new(), inserted: Vec::new() };
    for (&time, &rotation) in seconds.iter().zip(rotations) {
        if let (Some(&before), Some(&from)) = (filled.seconds.last(), filled.rotations.last()) {
            let to = if from.dot(rotation) < 0.0 { -rotation } else { rotation };
            let turn = 2.0 * from.dot(to).min(1.0).acos();
            let steps = (turn / largest).ceil().max(1.0) as u32;
            let (start, end) = (f64::from(before), f64::from(time));
            for step in 1..steps {
                let at = (start + (end - start) * f64::from(step) / f64::from(steps)) as f32;
                if filled.seconds.last().is_some_and(|last| *last < at) && at < time {
                    filled.inserted.push(filled.seconds.len());
                    filled.seconds.push(at);
                    filled.rotations.push(from.slerp(to, (f64::from(at) - start) / (end - start)));
                }
            }
            filled.rotations.push(to);
        } else {
            filled.rotations.push(rotation);
        }
        filled.seconds.push(time);
    }
    filled
}

/// Drops the keys that were put between others, unless they were moved since or stand at an end. `values` are
/// (x, y, z, w), one for each time.
pub(crate) fn drop_inserted(times: &mut Vec<f32>, values: &mut Vec<DVec4>, inserted: &[usize]) {
    let count = times.len();
    let mut marked = vec![false; count];
    for &position in inserted.iter().filter(|&&position| position > 0 && position < count.saturating_sub(1)) {
        marked[position] = true;
    }
    let mut dropped = marked.clone();
    let mut kept = 0;
    while let Some(next) = (kept + 1..count).find(|&position| !marked[position]) {
        let (from, to) = (DQuat::from_vec4(values[kept]), DQuat::from_vec4(values[next]));
        let (start, end) = (f64::from(times[kept]), f64::from(times[next]));
        let on_the_arc = (kept + 1..next).all(|position| {
            let part = (f64::from(times[position]) - start) / (end - start);
            let slerp = DVec4::from(from.normalize().slerp(to.normalize(), part));
            let (plus, minus) = (slerp - values[position], slerp + values[position]);
            plus.length().min(minus.length()) <= MOVED
        });
        if !on_the_arc {
            dropped[kept + 1..next].fill(false);
        }
        kept = next;
    }
    let mut keep = dropped.iter().map(|dropped| !dropped);
    times.retain(|_| keep.next().unwrap_or(true));
    let mut keep = dropped.iter().map(|dropped| !dropped);
    values.retain(|_| keep.next().unwrap_or(true));
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// As viewers do that follow the components.
    fn straight(from: DQuat, to: DQuat, t: f64) -> DQuat {
        DQuat::from_vec4(DVec4::from(from).lerp(DVec4::from(to), t)).normalize()
    }

    fn worst(from: DQuat, to: DQuat) -> f64 {
        (1..400)
            .map(|k| {
                let t = f64::from(k) / 400.0;
                let apart = from.slerp(to, t).inverse() * straight(from, to, t);
                2.0 * DVec3::new(apart.x, apart.y, apart.z).length().asin()
            })
            .fold(0.0, f64::max)
    }

    fn turned(angle: f64) -> DQuat {
        DQuat::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), angle) * DQuat::from_rotation_x(0.4)
    }

    #[test]
    fn the_largest_turn_is_off_by_the_error_and_no_less() {
        for error in [LARGEST_ERROR, 1e-5, SMALLEST_ERROR] {
            let found = worst(turned(0.0), turned(largest_turn(error)));
            assert!((found / error - 1.0).abs() < 0.02, "{error}: {found}");
        }
        let degrees = largest_turn(LARGEST_ERROR).to_degrees();
        assert!((degrees - 26.6).abs() < 0.1, "{degrees}");
    }

    #[test]
    fn half_a_turn_is_filled_and_comes_back() {
        let (seconds, rotations) = ([0.0, 0.5, 0.7, 3.0], [0.0, 3.1, 3.3, 0.2].map(turned));
        assert!(worst(rotations[0], rotations[1]) > 0.1, "viewers are far off without");
        let filled = filled(&seconds, &rotations, LARGEST_ERROR);
        assert_eq!(filled.inserted.len(), 6 + 6, "{:?}", filled.inserted);
        for pair in filled.rotations.windows(2) {
            assert!(worst(pair[0], pair[1]) <= 1.01 * LARGEST_ERROR);
        }
        let mut times = filled.seconds.clone();
        let mut values: Vec<DVec4> =
            filled.rotations.iter().map(|q| DVec4::from(*q).as_vec4().as_dvec4()).collect();
        let written = (times.clone(), values.clone());
        drop_inserted(&mut times, &mut values, &filled.inserted);
        assert_eq!(times, seconds);
        for (value, rotation) in values.iter().zip(rotations) {
            assert!(DQuat::from_vec4(*value).dot(rotation).abs() > 1.0 - 1e-7);
        }

        // A key that someone moved stays, with those next to it; marks that make no sense do nothing.
        let (mut times, mut values) = written.clone();
        values[3] = DVec4::from(turned(0.5));
        drop_inserted(&mut times, &mut values, &filled.inserted);
        assert_eq!(times.len(), 4 + 6);
        let (mut times, mut values) = written.clone();
        let last = times.len() - 1;
        drop_inserted(&mut times, &mut values, &[0, last, 99, usize::MAX]);
        assert_eq!((times, values), written);
    }

    #[test]
    fn times_that_single_precision_cannot_part_get_no_key() {
        let start = 1000.0_f32;
        let seconds = [start, start.next_up(), start.next_up().next_up().next_up()];
        let filled = filled(&seconds, &[0.0, 3.0, 0.0].map(turned), LARGEST_ERROR);
        assert!(filled.seconds.windows(2).all(|pair| pair[0] < pair[1]), "{:?}", filled.seconds);
        assert!(filled.inserted.len() <= 1);
    }

    #[test]
    fn the_error_follows_the_tolerance() {
        let report = |tolerance, size| {
            let splats = cif_scene::Splats::default();
            MotionReport { tolerance, size, ..MotionReport::unfitted(&splats, &cif_scene::Motion::Static) }
        };
        assert!((allowed_error(&report(0.001, 1.0)) - 4e-5).abs() < 1e-12);
        assert_eq!(allowed_error(&report(0.5, 1.0)), LARGEST_ERROR);
        assert_eq!(allowed_error(&report(0.0, 1.0)), LARGEST_ERROR, "unknown");
        assert_eq!(allowed_error(&report(1e-9, 1.0)), SMALLEST_ERROR);
        assert_eq!(allowed_error(&report(1.0, 0.0)), LARGEST_ERROR);
    }
}
