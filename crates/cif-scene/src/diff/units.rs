//! The rigid units of a node and how they moved between two graphs.

use glam::{DQuat, DVec3};

use crate::graph::{Motion, PoseSample, pose_at};
use crate::{Node, SceneGraph};

/// Distances below this part of `1 + |position|` are none, world units.
pub(crate) const SAME_PLACE: f64 = 1e-5;

/// Turns below this are none, radians.
pub(crate) const SAME_TURN: f64 = 1e-4;

/// Splats of a node that share a frame: the node's, or a part's.
#[derive(Clone, Debug)]
pub(crate) struct Unit<'a> {
    node: &'a Node,
    part: Option<&'a crate::Part>,
    /// Its splats in the node.
    pub(crate) splats: std::ops::Range<usize>,
}

impl Unit<'_> {
    /// Name of the part; empty for a whole node.
    pub(crate) fn name(&self) -> &str {
        self.part.map_or("", |part| &part.name)
    }

    /// `world_from_unit` at a time code.
    pub(crate) fn pose(&self, code: f64) -> PoseSample {
        let node = pose_at(self.node.track(), self.node.pivot, code);
        let pose = match self.part {
            None => node,
            Some(part) => {
                let part = pose_at(&part.track, part.pivot, code);
                PoseSample {
                    time_code: code,
                    translation: node.rotation * part.translation + node.translation,
                    rotation: node.rotation * part.rotation,
                }
            }
        };
        PoseSample { rotation: pose.rotation.normalize(), ..pose }
    }
}

/// The units of a node, which hold all its splats.
pub(crate) fn units(node: &Node) -> Vec<Unit<'_>> {
    match &node.motion {
        Motion::Parts(parts) => parts
            .parts
            .iter()
            .map(|part| Unit { node, part: Some(part), splats: part.splats.clone() })
            .collect(),
        _ => vec![Unit { node, part: None, splats: 0..node.splats.len() }],
    }
}

/// Units of two nodes that correspond: whole nodes, or parts of one name; `None` where they do not.
pub(crate) fn matching<'a>(first: &'a Node, second: &'a Node) -> Option<Vec<(Unit<'a>, Unit<'a>)>> {
    let (a, b) = (units(first), units(second));
    if a.len() != b.len() {
        return None;
    }
    a.into_iter()
        .map(|unit| {
            let other = b.iter().find(|other| other.name() == unit.name())?.clone();
            Some((unit, other))
        })
        .collect()
}

/// Every time code at which a graph or a node has a sample, ascending.
pub(crate) fn key_codes(graphs: &[&SceneGraph], nodes: &[&Node]) -> Vec<f64> {
    let mut codes: Vec<f64> =
        graphs.iter().flat_map(|graph| graph.time_codes.samples.iter().copied()).collect();
    for node in nodes {
        codes.extend(node.track().iter().map(|key| key.time_code));
        if let Motion::Parts(parts) = &node.motion {
            codes.extend(parts.parts.iter().flat_map(|part| &part.track).map(|key| key.time_code));
        }
    }
    codes.retain(|code| code.is_finite());
    codes.sort_by(f64::total_cmp);
    codes.dedup();
    codes
}

/// Displacement of a unit, largest over the time codes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Delta {
    /// Largest distance of its origin, world units.
    pub(crate) translation: f64,
    /// Largest turn, radians.
    pub(crate) rotation: f64,
    /// True when `after * before^-1` is the same at all times.
    pub(crate) constant: bool,
}

/// `after * before^-1` at a time code.
pub(crate) fn step(before: &Unit<'_>, after: &Unit<'_>, code: f64) -> (DQuat, DVec3) {
    let (a, b) = (before.pose(code), after.pose(code));
    let rotation = (b.rotation * a.rotation.conjugate()).normalize();
    (rotation, b.translation - rotation * a.translation)
}

/// Displacement of a unit over the time codes; `None` for no more than rounding.
pub(crate) fn delta(before: &Unit<'_>, after: &Unit<'_>, codes: &[f64]) -> Option<Delta> {
    let turn = |a: DQuat, b: DQuat| 2.0 * (a * b.conjugate()).xyz().length().min(1.0).asin();
    let first = step(before, after, *codes.first()?);
    let mut delta = Delta { translation: 0.0, rotation: 0.0, constant: true };
    let mut differs = false;
    for &code in codes {
        let (a, b) = (before.pose(code), after.pose(code));
        let (translation, rotation) =
            ((b.translation - a.translation).length(), turn(b.rotation, a.rotation));
        let near = SAME_PLACE * (1.0 + a.translation.length());
        differs |= !(translation <= near && rotation <= SAME_TURN);
        delta.translation = delta.translation.max(translation);
        delta.rotation = delta.rotation.max(rotation);
        let expected = first.0 * a.translation + first.1;
        delta.constant &= (expected - b.translation).length() <= near
            && turn(b.rotation, first.0 * a.rotation) <= SAME_TURN;
    }
    differs.then_some(delta)
}
