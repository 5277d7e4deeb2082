//! Motion of the objects of a scene, as it was trained or imported.

use std::f64::consts::PI;

use cif_field::tracks::TrackGroup;
use cif_field::{Field, JointKind, RotationEvidence};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Motion of an object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "lowercase")]
pub(in crate::commands) enum ObjectMotion {
    /// Nothing moves it.
    Static,
    /// It moves as one body, by poses over time.
    Rigid {
        /// Poses.
        poses: usize,
        /// Largest distance of its centre from the first pose, units of the capture.
        moves: f64,
        /// Largest turn from the first pose, degrees.
        turns_deg: f64,
        /// Evidence for its rotation; `None` where none was recorded.
        rotation: Option<RotationEvidence>,
        /// True where it is hidden at some times.
        #[serde(default)]
        hidden: bool,
    },
    /// A base, and parts that joints tie to it.
    Parts {
        /// Parts on joints.
        joints: Vec<JointMotion>,
    },
    /// Each of its Gaussians follows recorded samples.
    Dense {
        /// Samples.
        samples: usize,
    },
    /// The deformation moves so many of its Gaussians.
    Free {
        /// Gaussians that it moves.
        moving: usize,
    },
}

/// A part on a joint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(in crate::commands) struct JointMotion {
    /// Kind of the joint.
    joint: JointKind,
    /// Unit direction, world.
    axis: [f64; 3],
    /// A point of the axis, units of the capture.
    through: [f64; 3],
    /// Least and largest value: degrees, or units of the capture.
    range: [f64; 2],
    /// Gaussians of the part.
    gaussians: usize,
}

impl ObjectMotion {
    /// Motion of the Gaussians `rows` of a field: that of the recorded motion which most of them follow, else that of
    /// the deformation.
    pub(in crate::commands) fn of(field: &Field, rows: &[u32]) -> Self {
        let joints = joints(field, rows);
        if !joints.is_empty() {
            return Self::Parts { joints };
        }
        if let Some(group) = followed(field, rows) {
            if let Some(dense) = group.dense.as_ref().filter(|dense| dense.times.len() > 1) {
                return Self::Dense { samples: dense.times.len() };
            }
            if group.poses.len() > 1 {
                return rigid(group, 1.0 / field.record.frame.scale);
            }
        }
        let moving = |row: &&u32| {
            let deformed = field.deformation.as_ref().is_some_and(|motion| !motion.is_still(**row as usize));
            deformed && group_of(field, **row).is_none_or(|group| group.deformed)
        };
        match rows.iter().filter(moving).count() {
            0 => Self::Static,
            moving => Self::Free { moving },
        }
    }
}

/// As in `rigid, 20 poses, moves 0.431, turns 170.2 deg, rotation observed`.
impl std::fmt::Display for ObjectMotion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Static => f.write_str("static"),
            Self::Rigid { poses, moves, turns_deg, rotation, hidden } => {
                write!(f, "rigid, {poses} poses, moves {moves:.3}, turns {turns_deg:.1} deg")?;
                rotation.map_or(Ok(()), |rotation| write!(f, ", rotation {rotation}"))?;
                f.write_str(if *hidden { ", hidden at some times" } else { "" })
            }
            Self::Parts { joints } => {
                f.write_str("parts")?;
                for JointMotion { joint, axis, range, .. } in joints {
                    let unit = if *joint == JointKind::Revolute { " deg" } else { "" };
                    let digits = if *joint == JointKind::Revolute { 1 } else { 3 };
                    let [x, y, z] = axis.map(|value| unsigned_zero(value, 2));
                    let [low, high] = range.map(|value| unsigned_zero(value, digits));
                    write!(f, ", {joint} joint along ({x:.2}, {y:.2}, {z:.2})")?;
                    write!(f, " from {low:.digits$} to {high:.digits$}{unit}")?;
                }
                Ok(())
            }
            Self::Dense { samples } => write!(f, "dense, {samples} samples"),
            Self::Free { moving } => write!(f, "free, {moving} Gaussians move"),
        }
    }
}

/// The value, but 0 in place of what shows as "-0" with so many digits.
fn unsigned_zero(value: f64, digits: usize) -> f64 {
    if value.abs() < 0.5 * 0.1_f64.powi(digits as i32) { 0.0 } else { value }
}

fn group_of(field: &Field, row: u32) -> Option<&TrackGroup> {
    let tracks = field.tracks.as_ref()?;
    tracks.groups.get(*tracks.group_of.get(row as usize)? as usize)
}

/// Parts on joints among the rows of an object.
fn joints(field: &Field, rows: &[u32]) -> Vec<JointMotion> {
    let Some(tracks) = &field.tracks else { return Vec::new() };
    let frame = &field.record.frame;
    let of_group = |group: usize| {
        let (joint, values) = tracks.joint_values(group)?;
        let gaussians = rows.iter().filter(|row| tracks.group(**row as usize) == Some(group)).count();
        let unit = if joint.kind == JointKind::Revolute { 180.0 / PI } else { 1.0 / frame.scale };
        let range = values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
            [low.min(unit * value), high.max(unit * value)]
        });
        let place = tracks.groups[group].pivot / frame.scale + DVec3::from_array(frame.offset);
        let (axis, through) = (joint.axis.to_array(), place.to_array());
        (gaussians > 0).then_some(JointMotion { joint: joint.kind, axis, through, range, gaussians })
    };
    (0..tracks.groups.len()).filter_map(of_group).collect()
}

/// The group that more than half of the rows belong to.
pub(in crate::commands) fn followed<'a>(field: &'a Field, rows: &[u32]) -> Option<&'a TrackGroup> {
    let groups = &field.tracks.as_ref()?.groups;
    let in_group = |group: &&TrackGroup| {
        let own = rows.iter().filter(|row| group_of(field, **row).is_some_and(|of| std::ptr::eq(of, *group)));
        2 * own.count() > rows.len()
    };
    groups.iter().find(in_group)
}

fn rigid(group: &TrackGroup, world_per_unit: f64) -> ObjectMotion {
    let first = &group.poses[0];
    let largest = |value: &dyn Fn(usize) -> f64| (1..group.poses.len()).map(value).fold(0.0, f64::max);
    ObjectMotion::Rigid {
        poses: group.poses.len(),
        moves: largest(&|k| group.poses[k].translation.distance(first.translation)) * world_per_unit,
        turns_deg: largest(&|k| group.poses[k].rotation.angle_between(first.rotation)).to_degrees(),
        rotation: group.rotation,
        hidden: group.visibility.iter().any(|step| !step.visible),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_show_no_negative_zero() {
        let joints = vec![JointMotion {
            joint: JointKind::Revolute,
            axis: [-0.001, 0.0, -1.0],
            through: [0.0; 3],
            range: [-0.03, 27.5],
            gaussians: 100,
        }];
        assert_eq!(
            ObjectMotion::Parts { joints }.to_string(),
            "parts, revolute joint along (0.00, 0.00, -1.00) from 0.0 to 27.5 deg"
        );
    }
}
