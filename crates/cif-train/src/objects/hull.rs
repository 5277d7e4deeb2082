//! Points inside the masks of an object, from which its Gaussians start.

use std::collections::BTreeMap;

use glam::DVec3;
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;

use super::shape::{Pose, Shape};
use super::view::{ObjectView, Seen};
use crate::phases::Phases;

/// Points of an object, in its frame.
pub(super) struct Hull {
    /// Metres.
    places: Vec<[f32; 3]>,
    /// In [0, 1], by point.
    colors: Vec<[f32; 3]>,
    /// Size of the object, metres.
    size: f64,
}

impl Hull {
    /// Gaussians at the points, which are drawn from a distance `near` from the camera on.
    pub(super) fn shape(&self, near: f32, phases: &Phases) -> Option<Shape> {
        Shape::new(&self.places, &self.colors, self.size, near, phases)
    }
}

/// Points inside the masks of all times under some poses, about as many as `count`: of an object of this size, metres,
/// within a bound in its frame; `None` where there are few.
pub(super) fn hull(
    views: &[ObjectView],
    poses: &BTreeMap<usize, Pose>,
    size: f64,
    bound: Option<&dyn Fn(DVec3) -> bool>,
    count: usize,
    rng: &mut Pcg64,
) -> Option<Hull> {
    /// Candidates, and the times that they are looked at.
    const CANDIDATES: usize = 6000;
    const TIMES: usize = 12;
    let spread = (poses.len() / TIMES).max(1);
    let all = || poses.keys().step_by(spread).flat_map(|t| views.iter().filter(|view| view.time_index == *t));
    let mut looked: Vec<&ObjectView> = all().filter(|view| !view.cut && view.visible >= 0.6).collect();
    if looked.is_empty() {
        looked = all().collect();
    }
    let mut found: Vec<(f64, [f32; 3], [f32; 3])> = Vec::with_capacity(CANDIDATES);
    for _ in 0..CANDIDATES {
        let direction = loop {
            let d = DVec3::from(std::array::from_fn(|_| rng.random::<f64>() * 2.0 - 1.0));
            if d.length_squared() <= 1.0 {
                break d;
            }
        };
        let place = 1.25 * size * direction;
        if bound.is_some_and(|bound| !bound(place)) {
            continue;
        }
        let (mut inside, mut outside, mut color) = (0.0_f64, 0.0_f64, [0.0_f32; 3]);
        for view in &looked {
            let pose = &poses[&view.time_index];
            match view.at(pose.rotation * place + pose.translation) {
                Seen::Object(seen) => {
                    inside += 1.0;
                    (0..3).for_each(|k| color[k] += seen[k]);
                }
                Seen::Nothing => outside += 1.0,
                Seen::Other | Seen::Outside => {}
            }
        }
        let share = inside / (inside + outside).max(1.0);
        if inside > 0.0 {
            let color = color.map(|sum| sum / inside as f32);
            found.push((share, place.to_array().map(|value| value as f32), color));
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let good = found.iter().filter(|(share, ..)| *share > 0.8).count().max(count).min(found.len());
    let mut taken: Vec<usize> = (0..good).collect();
    taken.shuffle(rng);
    taken.truncate(count);
    let places: Vec<[f32; 3]> = taken.iter().map(|k| found[*k].1).collect();
    let colors: Vec<[f32; 3]> = taken.iter().map(|k| found[*k].2).collect();
    (places.len() >= 8).then_some(Hull { places, colors, size })
}
