//! Parts of an instance that its field ties by joints.

use std::collections::BTreeMap;

use cif_field::Field;
use cif_field::tracks::{Joint, NO_GROUP};
use cif_geometry::RigidTransform;
use glam::{DMat3, DQuat, DVec3};

use crate::PartJoint;

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
    use cif_field::JointKind;

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
