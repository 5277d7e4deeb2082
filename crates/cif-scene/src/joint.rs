//! Joints between the parts of a node: a door on its hinge, a drawer on its rails.

use std::collections::BTreeMap;

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

/// Groups on joints by the node that most of their rows are in, given the rows of all nodes: rows that were given to
/// another instance make no part of it.
pub(crate) fn jointed_groups<'a>(field: &Field, nodes: impl Iterator<Item = &'a [u32]>) -> Vec<Vec<u32>> {
    let mut most: BTreeMap<u32, (usize, usize)> = BTreeMap::new();
    let mut count = 0;
    for (node, rows) in nodes.enumerate() {
        count = node + 1;
        let Some(tracks) = &field.tracks else { continue };
        let mut sizes: BTreeMap<u32, usize> = BTreeMap::new();
        for row in rows {
            *sizes.entry(tracks.group_of[*row as usize]).or_default() += 1;
        }
        sizes.retain(|group, _| *group != NO_GROUP && tracks.groups[*group as usize].joint.is_some());
        for (group, size) in sizes {
            let of = most.entry(group).or_insert((node, size));
            *of = if size > of.1 { (node, size) } else { *of };
        }
    }
    let mut groups = vec![Vec::new(); count];
    most.into_iter().for_each(|(group, (node, _))| groups[node].push(group));
    groups
}

impl ToldParts {
    /// The parts of an instance with these rows and these groups on joints; `None` where there are none.
    pub(crate) fn of(field: &Field, rows: &[u32], jointed: &[u32], times: &[f64]) -> Option<Self> {
        let tracks = field.tracks.as_ref()?;
        let group_of = |row: &u32| tracks.group_of[*row as usize];
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{MEMBERS, recorded_field};

    #[test]
    fn strays_of_a_part_are_no_part_of_another_instance() {
        let mut field = recorded_field(2, 1);
        let tracks = field.tracks.as_mut().unwrap();
        tracks.groups[1].joint = Some(Joint { base: 0, kind: JointKind::Revolute, axis: DVec3::Z });
        let members = MEMBERS as u32;
        // Three rows of the part were given to the first instance, and one of its own to the part's.
        let first: Vec<u32> = (0..members).chain(members..members + 3).collect();
        let second: Vec<u32> = (members + 3..2 * members).chain([0]).collect();
        let groups = jointed_groups(&field, [&first[..], &second[..]].into_iter());
        assert_eq!(groups, [vec![], vec![1]]);
        assert!(ToldParts::of(&field, &first, &groups[0], &[0.0, 1.0]).is_none());
        assert!(ToldParts::of(&field, &second, &groups[1], &[0.0, 1.0]).is_some());
    }
}
