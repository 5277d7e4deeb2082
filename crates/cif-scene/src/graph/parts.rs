//! Motion of a few rigid parts, and the joints between them: a door on its hinge, a drawer on its rails.

use cif_field::JointKind;
use cif_geometry::{Bounds, RigidTransform};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::pose::{PoseSample, pose_at};

/// A few rigid parts under one node.
#[derive(Clone, Debug, PartialEq)]
pub struct PartsMotion {
    /// Path of the node's local frame, which follows its first part; empty where it stays at the pivot.
    pub track: Vec<PoseSample>,
    /// The parts, at least two. Their [`Part::splats`] partition [`Node::splats`] in order.
    pub parts: Vec<Part>,
}

/// One rigid part of a node.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Unique within the node, `[A-Za-z0-9_]`, e.g. `part_00`.
    pub name: String,
    /// Range of [`Node::splats`]; these splats are in the part's own frame.
    pub splats: std::ops::Range<usize>,
    /// Origin of the part's frame at the reference time, in the node's local frame.
    pub pivot: DVec3,
    /// Poses `node_from_part`, ascending time codes; empty where the part stays at its pivot.
    pub track: Vec<PoseSample>,
    /// Box of the 3-sigma ellipsoids, part frame.
    pub extent: Bounds,
    /// Ties it to another part; `None` where its poses are free.
    pub joint: Option<PartJoint>,
}

/// Ties a part of a node to another part of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PartJoint {
    /// Position of the part that it moves on, in [`PartsMotion::parts`].
    pub base: usize,
    /// Freedom of the joint.
    pub kind: JointKind,
    /// Unit direction of the axis, frame of the part.
    pub axis: DVec3,
    /// A point of the axis, frame of the part.
    pub anchor: DVec3,
}

impl Part {
    /// `node_from_part` at the first key, or at the pivot without keys.
    #[must_use]
    pub fn at_first(&self) -> RigidTransform {
        let rest = RigidTransform { translation: self.pivot, ..RigidTransform::IDENTITY };
        self.track.first().map_or(rest, PoseSample::transform)
    }
}

impl PartsMotion {
    /// Pose of a part in the frame of the one that its joint is on; `None` without a joint.
    #[must_use]
    pub fn on_base(&self, part: usize, time_code: f64) -> Option<PoseSample> {
        let base = self.parts.get(self.parts[part].joint?.base)?;
        let at = |part: &Part| pose_at(&part.track, part.pivot, time_code).transform();
        Some(PoseSample::new(time_code, &at(base).inverse().compose(&at(&self.parts[part]))))
    }

    /// The same at the first key of any part, which is what files show where nothing is sampled.
    #[must_use]
    pub fn at_first(&self, part: usize) -> Option<PoseSample> {
        let keys = self.parts.iter().flat_map(|part| &part.track).map(|key| key.time_code);
        self.on_base(part, keys.min_by(f64::total_cmp).unwrap_or(0.0))
    }

    /// Range of the values of the joint of a part over all keys, from the pose at the first of them: radians, or world
    /// units; `None` without a joint.
    #[must_use]
    pub fn joint_range(&self, part: usize) -> Option<[f64; 2]> {
        let joint = self.parts[part].joint?;
        let base = self.parts.get(joint.base)?;
        let mut codes: Vec<f64> =
            base.track.iter().chain(&self.parts[part].track).map(|key| key.time_code).collect();
        codes.sort_by(f64::total_cmp);
        codes.dedup();
        let first = self.at_first(part)?;
        let (mut range, mut last) = ([0.0_f64; 2], 0.0);
        for code in codes {
            let pose = self.on_base(part, code)?;
            let back = first.rotation.conjugate();
            let value = match joint.kind {
                JointKind::Revolute => {
                    let turn = back * pose.rotation;
                    let value = 2.0 * turn.xyz().dot(joint.axis).atan2(turn.w);
                    value + ((last - value) / std::f64::consts::TAU).round() * std::f64::consts::TAU
                }
                JointKind::Prismatic => (back * (pose.translation - first.translation)).dot(joint.axis),
            };
            range = [range[0].min(value), range[1].max(value)];
            last = value;
        }
        Some(range)
    }
}
