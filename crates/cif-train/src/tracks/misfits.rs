//! Frames that contradict the others: a wrong camera, or masks that belong to another frame, show nearly every
//! instance where no other frame sees it.

use std::collections::BTreeMap;

use cif_geometry::Ray;
use glam::{DMat3, DVec3};

use super::{FEWEST, Observation};

/// Instances that a frame must show to be judged; a single one may have moved.
const FEWEST_INSTANCES: usize = 2;
/// Largest share of the frames that can be wrong; beyond, nobody knows which are right.
const MOST: f64 = 0.25;
/// Smallest miss that counts as typical, in radii of the mask, and in pixels.
const TYPICAL_RADII: f64 = 0.1;
const TYPICAL_PX: f64 = 1.0;
/// Rounds of reweighting.
const ROUNDS: usize = 24;

/// Indices of the frames whose masks contradict the others, ascending. `frames` hold what [`super::observe`]
/// found in each.
///
/// Every instance has a point that most of its masks are seen around, and a median angle by which they miss it:
/// next to none for what stands still, more for what moves. A frame contradicts when more than half of its
/// instances, two or more, miss by over `limit` times their median miss and by more than their own size.
/// None do when that is so of more than a quarter of all frames.
#[must_use]
pub fn misfits(frames: &[BTreeMap<u16, Observation>], limit: f64) -> Vec<usize> {
    let mut of_label: BTreeMap<u16, Vec<(usize, &Observation)>> = BTreeMap::new();
    for (frame, seen) in frames.iter().enumerate() {
        for (label, observation) in seen {
            of_label.entry(*label).or_default().push((frame, observation));
        }
    }
    let mut excesses: Vec<Vec<f64>> = vec![Vec::new(); frames.len()];
    for seen in of_label.values().filter(|seen| seen.len() >= FEWEST) {
        let observations: Vec<&Observation> = seen.iter().map(|(_, observation)| *observation).collect();
        let Some(point) = middle_point(&observations) else { continue };
        let misses: Vec<f64> = observations.iter().map(|o| miss(o, point)).collect();
        let mut sorted = misses.clone();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        for ((frame, o), miss) in seen.iter().zip(misses) {
            let focal = o.camera.focal_px.min_element();
            let radius = o.radius_px() / focal;
            let typical = median.max(TYPICAL_RADII * radius).max(TYPICAL_PX / focal);
            excesses[*frame].push(if miss > radius { miss / typical } else { 0.0 });
        }
    }
    let contradicts = |excesses: &mut Vec<f64>| {
        excesses.sort_by(f64::total_cmp);
        excesses.len() >= FEWEST_INSTANCES && excesses[(excesses.len() - 1) / 2] > limit
    };
    let judged = excesses.iter().filter(|excesses| excesses.len() >= FEWEST_INSTANCES).count();
    let found: Vec<usize> = (0..frames.len()).filter(|frame| contradicts(&mut excesses[*frame])).collect();
    if found.len() as f64 <= MOST * judged as f64 { found } else { Vec::new() }
}

/// Angle between the direction of a mask's centre and that of a point, radians.
fn miss(o: &Observation, point: DVec3) -> f64 {
    o.camera.ray(o.centroid_px).angle_between(point - o.camera.centre())
}

/// The point with the least sum of distances from the rays through the masks' centres, as lines: some wrong rays
/// do not move it. `None` where the rays are parallel.
fn middle_point(observations: &[&Observation]) -> Option<DVec3> {
    let lines: Vec<Ray> = observations.iter().map(|o| o.ray()).collect();
    let mut weights = vec![1.0; lines.len()];
    let mut point = DVec3::ZERO;
    for _ in 0..ROUNDS {
        let (mut normal, mut right, mut total) = (DMat3::ZERO, DVec3::ZERO, 0.0);
        for (ray, weight) in lines.iter().zip(&weights) {
            normal += ray.across() * *weight;
            right += ray.across() * ray.origin * *weight;
            total += weight;
        }
        if normal.determinant() <= 1e-12 * total.powi(3) {
            return None;
        }
        point = normal.inverse() * right;
        let distances: Vec<f64> = lines.iter().map(|ray| ray.distance(point)).collect();
        // No ray may take everything.
        let least = 1e-6 + 1e-3 * distances.iter().sum::<f64>() / distances.len() as f64;
        for (weight, distance) in weights.iter_mut().zip(&distances) {
            *weight = least / distance.max(least);
        }
    }
    point.is_finite().then_some(point)
}

#[cfg(test)]
mod tests {
    use super::super::tests::camera;
    use super::*;

    /// Where a frame's camera is, and where it is said to be.
    type Turn = fn(usize) -> (f64, f64);

    /// Four resting instances and one that travels, seen by one moving camera.
    fn frames(turn: Turn) -> Vec<BTreeMap<u16, Observation>> {
        let places = [[0.3, 0.2, 0.05], [-0.4, 0.1, 0.1], [0.0, -0.3, 0.2], [0.2, 0.5, 0.0]];
        (0..40)
            .map(|k| {
                let (is, stated) = turn(k);
                let travelling = DVec3::new(0.5 - 0.02 * k as f64, 0.3, 0.06);
                let centres = places.map(DVec3::from).into_iter().chain([travelling]);
                let observation = |centre: DVec3| {
                    let (centroid_px, _) = camera(is).project(centre).unwrap();
                    Observation {
                        time_index: k,
                        camera: camera(stated),
                        centroid_px,
                        area_px: 300.0,
                        cut: [false; 2],
                        contact_depth: None,
                    }
                };
                centres.enumerate().map(|(k, centre)| (k as u16 + 1, observation(centre))).collect()
            })
            .collect()
    }

    const SOUND: Turn = |k| (0.01 * k as f64, 0.01 * k as f64);

    #[test]
    fn a_wrong_camera_is_found_and_what_travels_is_none() {
        assert_eq!(misfits(&frames(SOUND), 20.0), [0_usize; 0]);
        let wrong = frames(|k| (0.01 * k as f64, 0.01 * k as f64 + if k == 17 { 1.5 } else { 0.0 }));
        assert_eq!(misfits(&wrong, 20.0), [17]);
        let two = frames(|k| (0.01 * k as f64, 0.01 * k as f64 - if k % 20 == 3 { 0.5 } else { 0.0 }));
        assert_eq!(misfits(&two, 20.0), [3, 23]);
    }

    #[test]
    fn a_moved_object_a_swap_and_a_wobble_are_no_wrong_camera() {
        let mut frames = frames(SOUND);
        let (a, b) = (frames[9][&1], frames[9][&2]);
        frames[9].insert(1, b);
        frames[9].insert(2, a);
        for (k, frame) in frames.iter_mut().enumerate() {
            for observation in frame.values_mut() {
                observation.centroid_px.x += 2.0 * (k as f64 * 1.7).sin();
            }
        }
        assert_eq!(misfits(&frames, 20.0), [0_usize; 0]);
    }

    #[test]
    fn nobody_is_accused_when_too_many_differ_or_too_little_is_seen() {
        let many = frames(|k| (0.01 * k as f64, 0.01 * k as f64 + if k % 3 == 0 { 1.0 } else { 0.0 }));
        assert_eq!(misfits(&many, 20.0), [0_usize; 0]);
        let mut few = frames(|k| (0.01 * k as f64, 0.01 * k as f64 + if k == 17 { 1.5 } else { 0.0 }));
        few.iter_mut().for_each(|frame| frame.retain(|label, _| *label == 1));
        assert_eq!(misfits(&few, 20.0), [0_usize; 0]);
        assert_eq!(misfits(&few[..3], 20.0), [0_usize; 0]);
        assert_eq!(misfits(&[], 20.0), [0_usize; 0]);
    }
}
