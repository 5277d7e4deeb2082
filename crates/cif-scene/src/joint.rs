//! Joints between the parts of a node: a door on its hinge, a drawer on its rails.

use cif_field::tracks::{Joint, NO_GROUP};
use cif_field::{Field, JointKind};
use cif_geometry::RigidTransform;
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::graph::{Part, PartsMotion, PoseSample, pose_at};

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

/// Parts of an instance that the field ties by joints.
#[derive(Clone, Debug)]
pub(crate) struct ToldParts {
    /// Part of every row of the instance; 0 is the base.
    pub(crate) labels: Vec<usize>,
    /// The parts beside the base, of label 1 on.
    pub(crate) parts: Vec<ToldPart>,
}

/// A part on a joint.
#[derive(Clone, Debug)]
pub(crate) struct ToldPart {
    /// Its frame, with the axes of the world at the reference time and the origin on the axis, at the sampled times.
    pub(crate) poses: Vec<RigidTransform>,
    /// The joint in that frame.
    pub(crate) joint: PartJoint,
}

impl ToldParts {
    /// The parts of an instance with these rows; `None` where no joint ties any of them to others.
    pub(crate) fn of(field: &Field, rows: &[u32], times: &[f64]) -> Option<Self> {
        let tracks = field.tracks.as_ref()?;
        let group_of = |row: &u32| tracks.group_of[*row as usize];
        let mut jointed: Vec<u32> = rows.iter().map(group_of).filter(|group| *group != NO_GROUP).collect();
        jointed.sort_unstable();
        jointed.dedup();
        jointed.retain(|group| tracks.groups[*group as usize].joint.is_some());
        let label_of = |group: u32| jointed.iter().position(|of| *of == group).map_or(0, |place| place + 1);
        let labels: Vec<usize> = rows.iter().map(|row| label_of(group_of(row))).collect();
        if jointed.is_empty() || !labels.contains(&0) {
            return None;
        }
        let part = |group: &u32| {
            let of = &tracks.groups[*group as usize];
            let Joint { base, kind, axis } = of.joint?;
            let (rest, _) = of.pose(times[0]);
            let pose = |time: &f64| {
                let (rotation, translation) = of.pose(*time);
                let turn: DQuat = (rotation * rest.conjugate()).normalize();
                RigidTransform { rotation: DMat3::from_quat(turn), translation }
            };
            let joint = PartJoint { base: label_of(base), kind, axis: rest * axis, anchor: DVec3::ZERO };
            Some(ToldPart { poses: times.iter().map(pose).collect(), joint })
        };
        Some(Self { labels, parts: jointed.iter().filter_map(part).collect() })
    }
}
