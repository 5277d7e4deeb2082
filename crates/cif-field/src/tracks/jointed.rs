//! Poses of parts on joints, and the values of these.

use glam::{DQuat, DVec3};

use super::joint::{Joint, JointKind};
use super::{TrackGroup, TrackPose, Tracks};

impl Tracks {
    /// Joint of a group with its values at the poses of the group: radians, without jumps of a whole turn, or lengths
    /// in world units; `None` for a group without a joint.
    #[must_use]
    pub fn joint_values(&self, group: usize) -> Option<(Joint, Vec<f64>)> {
        let of = self.groups.get(group)?;
        let joint = of.joint?;
        let base = &self.groups[joint.base as usize];
        let mut values: Vec<f64> = Vec::with_capacity(of.poses.len());
        for pose in &of.poses {
            let mut value =
                joint.value((pose.rotation, pose.translation), of.pivot, base.pivot, base.pose(pose.time));
            if let (JointKind::Revolute, Some(last)) = (joint.kind, values.last()) {
                value += ((last - value) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
            }
            values.push(value);
        }
        Some((joint, values))
    }

    /// Puts the poses of all parts with joints onto their joints: to the nearest value each.
    pub fn hold_joints(&mut self) {
        for group in 0..self.groups.len() {
            let Some((joint, values)) = self.joint_values(group) else { continue };
            let (before, rest) = self.groups.split_at_mut(group);
            let (base, of) = (&before[joint.base as usize], &mut rest[0]);
            let pivot = of.pivot;
            let mut last: Option<DQuat> = None;
            for (pose, value) in of.poses.iter_mut().zip(values) {
                let (mut rotation, translation) = joint.pose(value, pivot, base.pivot, base.pose(pose.time));
                if last.is_some_and(|last| last.dot(rotation) < 0.0) {
                    rotation = -rotation;
                }
                last = Some(rotation);
                (pose.rotation, pose.translation) = (rotation, translation);
            }
        }
    }
}

impl TrackGroup {
    /// A part that moves on another group, of the same instance, by a joint through `pivot`; `values` by strictly
    /// ascending time.
    ///
    /// # Panics
    /// When the base is none of `groups`.
    #[must_use]
    pub fn jointed(
        name: impl Into<String>,
        pivot: DVec3,
        joint: Joint,
        values: &[(f64, f64)],
        groups: &[Self],
    ) -> Self {
        let base = &groups[joint.base as usize];
        let pose = |(time, value): &(f64, f64)| {
            let (rotation, translation) = joint.pose(*value, pivot, base.pivot, base.pose(*time));
            TrackPose { time: *time, translation, rotation }
        };
        let mut poses: Vec<TrackPose> = values.iter().map(pose).collect();
        for k in 1..poses.len() {
            if poses[k].rotation.dot(poses[k - 1].rotation) < 0.0 {
                poses[k].rotation = -poses[k].rotation;
            }
        }
        let still = Self::still(name, pivot);
        Self { instance: base.instance, deformed: false, poses, joint: Some(joint), ..still }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moving_base() -> TrackGroup {
        let pose = |time: f64| TrackPose {
            time,
            translation: DVec3::new(time, -0.5 * time, 0.2),
            rotation: DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.0 * time),
        };
        let poses = vec![pose(0.0), pose(0.25), pose(0.75), pose(1.0)];
        TrackGroup { poses, deformed: false, ..TrackGroup::still("arm", DVec3::new(0.1, 0.2, 0.3)) }
    }

    fn joint(kind: JointKind) -> Joint {
        Joint { base: 0, kind, axis: DVec3::new(2.0, -1.0, 2.0) / 3.0 }
    }

    #[test]
    fn values_come_back_from_poses_beyond_half_a_turn() {
        for kind in [JointKind::Revolute, JointKind::Prismatic] {
            let values = [(0.0, 0.0), (0.25, 1.5), (0.5, 3.0), (0.75, 4.5), (1.0, -0.5 + 4.5)];
            let groups = vec![moving_base()];
            let part = TrackGroup::jointed("hand", DVec3::new(0.4, 0.0, 0.1), joint(kind), &values, &groups);
            let tracks = Tracks { group_of: Vec::new(), groups: [groups, vec![part]].concat() };
            let (found, again) = tracks.joint_values(1).unwrap();
            assert_eq!(found, joint(kind));
            assert!(tracks.joint_values(0).is_none());
            for ((_, expected), value) in values.iter().zip(again) {
                assert!((expected - value).abs() < 1e-12, "{kind}: {value} is not {expected}");
            }
        }
    }

    #[test]
    fn what_leaves_its_joint_is_put_back_to_the_nearest_value() {
        for kind in [JointKind::Revolute, JointKind::Prismatic] {
            let values = [(0.0, 0.1), (0.25, 0.4), (1.0, 0.7)];
            let groups = vec![moving_base()];
            let part = TrackGroup::jointed("hand", DVec3::new(0.4, 0.0, 0.1), joint(kind), &values, &groups);
            let held = Tracks { group_of: Vec::new(), groups: [groups, vec![part]].concat() };
            let mut loose = held.clone();
            let base = loose.groups[0].pose(0.25);
            // Off the axis in both ways, and in the base.
            let across = DVec3::new(1.0, 2.0, 0.0) / 5.0_f64.sqrt();
            let pose = &mut loose.groups[1].poses[1];
            pose.rotation = (pose.rotation * DQuat::from_axis_angle(across, 0.05)).normalize();
            pose.translation += base.0 * (0.03 * across);
            loose.groups[0].poses[0].translation.x += 0.2;
            loose.hold_joints();
            let (_, values) = loose.joint_values(1).unwrap();
            assert!((values[1] - 0.4).abs() < 2e-3, "{kind}: {values:?}");
            let mut again = loose.clone();
            again.hold_joints();
            for (a, b) in again.groups[1].poses.iter().zip(&loose.groups[1].poses) {
                assert!(a.translation.distance(b.translation) < 1e-12, "{kind}");
                assert!(a.rotation.angle_between(b.rotation) < 1e-7, "{kind}");
            }
            // The part follows its base.
            let moved = loose.groups[1].poses[0].translation - held.groups[1].poses[0].translation;
            let expected = match kind {
                JointKind::Revolute => DVec3::X * 0.2,
                JointKind::Prismatic => {
                    let axis = joint(kind).axis;
                    let back = held.groups[0].poses[0].rotation.conjugate() * (DVec3::X * 0.2);
                    DVec3::X * 0.2 - held.groups[0].poses[0].rotation * (axis * axis.dot(back))
                }
            };
            assert!(moved.distance(expected) < 1e-12, "{kind}: {moved} is not {expected}");
        }
    }
}
