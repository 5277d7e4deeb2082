//! Motion of a graph against followed surface points, as trackers are measured.
//!
//! A point of an instance at a first time is carried to another by the splats of the node: the mean over its four
//! nearest splats at the first time, each moving the point by its own pose. First times are eight, spread evenly over
//! those at which the instance was seen, and other times are all others at which it was. At times at which it was not
//! seen nobody can know where it is, so they do not count. Rotations of symmetric objects are not excused: their
//! followed points distinguish them.
//!
//! | module | answers |
//! |---|---|
//! | `carry` | where splats take a point |
//! | `opacity_box` | the box of the splats, and its overlap with the true one |
//! | `claims` | whether rotations are as nodes claim them |

mod carry;
mod claims;
mod opacity_box;

use std::collections::BTreeMap;

use cif_dataset::{MotionTruth, TrueMotion};
use cif_geometry::stats::median;
use cif_geometry::transform::angle_between;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Serialize;

use self::carry::{Anchored, Placed};
pub use self::claims::{Claims, Verdicts};
use crate::{MotionModel, Node, NodeKind, SceneGraph};
use cif_field::RotationEvidence;
use cif_geometry::align::procrustes::{polar_rotation, weighted_procrustes};

/// First times of an instance at most.
const FIRST_TIMES: usize = 8;

/// Mean path of the followed points, metres, above which an instance moves.
const LEAST_PATH: f64 = 1e-4;

/// Errors of motion. Distances are of followed surface points in the world, over all pairs of times; `None` is
/// nothing to measure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MotionErrors {
    /// Mean distance between carried and true points, millimetres.
    pub error_mm: Option<f64>,
    /// The same as a share of the size of the object, percent: of the diagonal of its true box at the last time at which
    /// it was seen.
    pub error_of_size: Option<f64>,
    /// `error_mm` had nothing moved, millimetres: what there was to explain.
    pub rest_mm: Option<f64>,
    /// Share of carried points nearer than 10 mm to the true ones, percent.
    pub within_10_mm: Option<f64>,
    /// The same for 20 mm.
    pub within_20_mm: Option<f64>,
    /// The same for 50 mm.
    pub within_50_mm: Option<f64>,
    /// Median over the pairs of times of the angle between the true rotation and that of the best rigid motion of the
    /// carried points, degrees; of rigid instances that move.
    pub rotation_deg: Option<f64>,
    /// Mean over the times of the intersection over union of the box of the splats (one standard deviation each,
    /// without the outermost 2 % of the opacity on each side) with the true one, percent.
    pub box_iou: Option<f64>,
}

/// Motion of an instance with followed points.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InstanceMotion {
    /// Mask id.
    pub id: u16,
    /// Human name.
    pub label: String,
    /// True kind of motion: `static`, `rigid`, `articulated` or `deforming`.
    pub truth: String,
    /// True when its points move at all.
    pub moves: bool,
    /// Motion model of its node; `None` where it has none.
    pub model: Option<MotionModel>,
    /// Evidence that its node claims for its rotations; `None` where it claims none.
    pub claim: Option<RotationEvidence>,
    /// Splats of its node.
    pub splats: usize,
    /// Times at which it was seen.
    pub times: usize,
    /// Largest true rotation since the first time at which it was seen, degrees; of rigid instances that move.
    pub turned_deg: Option<f64>,
    /// Errors; nothing is measured without a node, or where it was seen at fewer than two times.
    #[serde(flatten)]
    pub errors: MotionErrors,
}

/// Mean errors of several instances.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MeanMotion {
    /// Instances that were measured.
    pub instances: usize,
    /// Means over the instances, each over those that have the value.
    #[serde(flatten)]
    pub errors: MotionErrors,
}

/// Motion of all instances with followed points.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MotionScores {
    /// Means over the instances that move; `None` where none was measured.
    pub moving: Option<MeanMotion>,
    /// Means over the instances that stand still.
    pub resting: Option<MeanMotion>,
    /// Rotations of the rigid instances that turn, by what their nodes claim of them.
    pub claims: Claims,
    /// Every instance, ascending id.
    pub instances: Vec<InstanceMotion>,
}

/// Measures the motion of a graph.
///
/// `seen` has the steps of `truth` at which each instance was seen, ascending, by mask id; see
/// [`MotionTruth::seen_steps`]. Steps that the graph does not sample do not count. Whether a node is visible does not
/// matter.
#[must_use]
pub fn motion_scores(
    graph: &SceneGraph,
    truth: &MotionTruth,
    seen: &BTreeMap<u16, Vec<usize>>,
) -> MotionScores {
    let codes = &graph.time_codes;
    let frames: Vec<usize> = codes.samples.iter().map(|code| *code as usize).collect();
    let steps = truth.steps_at(&codes.times, &frames);
    let code_of: BTreeMap<usize, f64> =
        steps.iter().zip(&codes.samples).filter_map(|(step, code)| Some(((*step)?, *code))).collect();
    let followed: Vec<(&u16, &TrueMotion)> =
        truth.instances.iter().filter(|(_, motion)| !motion.points.is_empty()).collect();
    let instances: Vec<InstanceMotion> = followed
        .into_par_iter()
        .map(|(id, motion)| {
            let node = graph
                .nodes
                .iter()
                .find(|node| matches!(node.kind, NodeKind::Instance { id: own, .. } if own == *id));
            let times: Vec<Time> = seen
                .get(id)
                .into_iter()
                .flatten()
                .filter_map(|step| Some(Time { step: *step, code: *code_of.get(step)? }))
                .collect();
            instance(graph, node, *id, motion, &times)
        })
        .collect();
    MotionScores {
        moving: mean(&instances, true),
        resting: mean(&instances, false),
        claims: Claims::of(instances.iter().filter_map(|instance| {
            Some((instance.turned_deg?, instance.errors.rotation_deg?, instance.claim))
        })),
        instances,
    }
}

/// A time on both sides.
#[derive(Clone, Copy)]
struct Time {
    /// Step of the known motion.
    step: usize,
    /// Time code of the graph.
    code: f64,
}

fn instance(
    graph: &SceneGraph,
    node: Option<&Node>,
    id: u16,
    motion: &TrueMotion,
    times: &[Time],
) -> InstanceMotion {
    let moves = path(motion) > LEAST_PATH;
    let turn = |from: &Time, to: &Time| {
        (moves && motion.kind == "rigid").then(|| true_turn(motion, from.step, to.step)).flatten()
    };
    let turns = times
        .iter()
        .filter_map(|time| Some(angle_between(&DMat3::IDENTITY, &turn(&times[0], time)?).to_degrees()));
    InstanceMotion {
        id,
        label: motion.label.clone(),
        truth: motion.kind.clone(),
        moves,
        model: node.map(Node::model),
        claim: node.and_then(|node| node.report.rotation),
        splats: node.map_or(0, |node| node.splats.len()),
        times: times.len(),
        turned_deg: turns.reduce(f64::max),
        errors: match node.filter(|node| times.len() >= 2 && !node.splats.is_empty()) {
            Some(node) => errors(graph, node, motion, times, &turn),
            None => MotionErrors::default(),
        },
    }
}

fn errors(
    graph: &SceneGraph,
    node: &Node,
    motion: &TrueMotion,
    times: &[Time],
    turn: &dyn Fn(&Time, &Time) -> Option<DMat3>,
) -> MotionErrors {
    let points_at = |step: usize| motion.points.iter().map(|track| track[step]).collect::<Vec<DVec3>>();
    let anchored: Vec<(Time, Vec<DVec3>, Anchored)> = first_times(times)
        .map(|first| {
            let points = points_at(first.step);
            let anchored = Anchored::new(&Placed::of(graph, node, first.code), &points);
            (first, points, anchored)
        })
        .collect();
    let (mut overlaps, mut angles) = (0.0, Vec::new());
    let (mut error, mut rest, mut within, mut count) = (0.0, 0.0, [0_usize; 3], 0_usize);
    for time in times {
        let placed = Placed::of(graph, node, time.code);
        overlaps += opacity_box::overlap(&placed.opacity_box(), &motion.boxes[time.step]);
        let truth = points_at(time.step);
        for (first, points, anchored) in anchored.iter().filter(|(first, ..)| first.step != time.step) {
            let carried = anchored.carried(&placed);
            for ((carried, truth), point) in carried.iter().zip(&truth).zip(points) {
                let distance_mm = 1e3 * carried.distance(*truth);
                error += distance_mm;
                rest += 1e3 * point.distance(*truth);
                for (within, limit_mm) in within.iter_mut().zip([10.0, 20.0, 50.0]) {
                    *within += usize::from(distance_mm < limit_mm);
                }
                count += 1;
            }
            if let Some(turn) = turn(first, time) {
                let weights = vec![1.0; points.len()];
                let found = weighted_procrustes(points, &carried, &weights, DMat3::IDENTITY);
                angles.extend(found.map(|found| angle_between(&found.rotation, &turn).to_degrees()));
            }
        }
    }
    let share = |value: f64| Some(value / count as f64);
    let percent = |within: usize| share(100.0 * within as f64);
    let last = &motion.boxes[times[times.len() - 1].step];
    MotionErrors {
        error_mm: share(error),
        error_of_size: share(100.0 * error / (1e3 * last.size().length())),
        rest_mm: share(rest),
        within_10_mm: percent(within[0]),
        within_20_mm: percent(within[1]),
        within_50_mm: percent(within[2]),
        rotation_deg: median(&mut angles),
        box_iou: Some(100.0 * overlaps / times.len() as f64),
    }
}

/// Eight times, or all if there are fewer, from the first to the last.
fn first_times(times: &[Time]) -> impl Iterator<Item = Time> + '_ {
    let count = times.len().min(FIRST_TIMES);
    (0..count).map(move |k| times[k * (times.len() - 1) / (count - 1).max(1)])
}

/// Largest mean distance of the followed points from where they are at the first step, metres.
fn path(motion: &TrueMotion) -> f64 {
    let steps = motion.points.first().map_or(0, Vec::len);
    let mean = |step: usize| {
        let distances = motion.points.iter().map(|track| track[0].distance(track[step]));
        distances.sum::<f64>() / motion.points.len() as f64
    };
    (0..steps).map(mean).fold(0.0, f64::max)
}

/// Rotation of an object between two steps; `None` where its matrix cannot be inverted.
fn true_turn(motion: &TrueMotion, from: usize, to: usize) -> Option<DMat3> {
    let [from, to] = [from, to].map(|step| DMat3::from_mat4(motion.world_from_object[step]));
    polar_rotation(&(to * from.try_inverse()?))
}

/// Means over the measured instances that move, or that stand still.
fn mean(instances: &[InstanceMotion], moves: bool) -> Option<MeanMotion> {
    let of = |value: fn(&MotionErrors) -> Option<f64>| {
        let group = instances.iter().filter(|instance| instance.moves == moves);
        let values: Vec<f64> = group.filter_map(|instance| value(&instance.errors)).collect();
        (!values.is_empty()).then(|| (values.len(), values.iter().sum::<f64>() / values.len() as f64))
    };
    let mean = |value: fn(&MotionErrors) -> Option<f64>| of(value).map(|(_, mean)| mean);
    Some(MeanMotion {
        instances: of(|errors| errors.error_mm)?.0,
        errors: MotionErrors {
            error_mm: mean(|errors| errors.error_mm),
            error_of_size: mean(|errors| errors.error_of_size),
            rest_mm: mean(|errors| errors.rest_mm),
            within_10_mm: mean(|errors| errors.within_10_mm),
            within_20_mm: mean(|errors| errors.within_20_mm),
            within_50_mm: mean(|errors| errors.within_50_mm),
            rotation_deg: mean(|errors| errors.rotation_deg),
            box_iou: mean(|errors| errors.box_iou),
        },
    })
}

#[cfg(test)]
mod tests;
