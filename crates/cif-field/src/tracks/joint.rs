//! Joints: parts of an object that turn about an axis of another part, or slide along one.
//!
//! The Gaussians of all parts are stored as they are at the value 0. With the pose G of the base, a part is carried by
//! G J(v), where J(v) turns by v radians about the axis through the pivot of the part, or shifts by v along it.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Ties a group to another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Joint {
    /// The group that it moves on: an earlier one of [`super::Tracks::groups`].
    pub base: u32,
    /// Freedom of the joint.
    pub kind: JointKind,
    /// Unit direction through [`super::TrackGroup::pivot`], world as the Gaussians are stored.
    pub axis: DVec3,
}

/// Freedom of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JointKind {
    /// Turns about the axis.
    Revolute,
    /// Slides along the axis.
    Prismatic,
}

impl std::fmt::Display for JointKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Revolute => "revolute",
            Self::Prismatic => "prismatic",
        })
    }
}

impl Joint {
    /// Turn and place of a part around `pivot`, with its base at a pose (turn, and where `base_pivot` is).
    #[must_use]
    pub fn pose(&self, value: f64, pivot: DVec3, base_pivot: DVec3, base: (DQuat, DVec3)) -> (DQuat, DVec3) {
        let (turn, shift) = match self.kind {
            JointKind::Revolute => (DQuat::from_axis_angle(self.axis, value), DVec3::ZERO),
            JointKind::Prismatic => (DQuat::IDENTITY, value * self.axis),
        };
        ((base.0 * turn).normalize(), base.0 * (pivot + shift - base_pivot) + base.1)
    }

    /// The value whose pose is nearest to a given one: radians in (-pi, pi], or a length.
    #[must_use]
    pub fn value(&self, pose: (DQuat, DVec3), pivot: DVec3, base_pivot: DVec3, base: (DQuat, DVec3)) -> f64 {
        let back = base.0.conjugate();
        match self.kind {
            JointKind::Revolute => {
                let turn = back * pose.0;
                let sign = if turn.w < 0.0 { -1.0 } else { 1.0 };
                2.0 * (sign * turn.xyz().dot(self.axis)).atan2(sign * turn.w)
            }
            JointKind::Prismatic => (back * (pose.1 - base.1) + base_pivot - pivot).dot(self.axis),
        }
    }
}
