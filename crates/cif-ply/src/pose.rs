//! Splats of a scene as they stand in the world at a moment.

use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::HarmonicsRotation;
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_scene::graph::pose_at;
use cif_scene::{Motion, Node, PoseSample, Splats, UpAxis};
use glam::{DQuat, DVec3};
use std::ops::Range;

/// The splats of a node at a time code, world frame: centres, orientations and spherical harmonics are turned with
/// the node and its parts, opacities and colours are those of the time. Dense motion takes its nearest sample.
/// Visibility does not count.
#[must_use]
pub fn world_splats(node: &Node, time_code: f64) -> Splats {
    let pose = pose_at(node.track(), node.pivot, time_code);
    let mut splats = node.splats.clone();
    if let Some(opacities) = node.appearance.opacities_at(time_code) {
        splats.opacities = opacities;
    }
    if let Some(coefficients) = node.appearance.colors_at(time_code) {
        splats.sh_coefficients = coefficients;
    }
    let all = 0..splats.len();
    match &node.motion {
        Motion::Static | Motion::Rigid(_) => place(&mut splats, all, &pose),
        Motion::Parts(motion) => {
            for part in &motion.parts {
                let inner = pose_at(&part.track, part.pivot, time_code);
                let together = PoseSample {
                    time_code,
                    translation: pose.rotation * inner.translation + pose.translation,
                    rotation: pose.rotation * inner.rotation,
                };
                place(&mut splats, part.splats.clone(), &together);
            }
        }
        Motion::Dense(motion) => {
            let distance = |code: f64| (code - time_code).abs();
            let nearest =
                motion.samples.iter().min_by(|a, b| distance(a.time_code).total_cmp(&distance(b.time_code)));
            if let Some(sample) = nearest {
                splats.means.clone_from(&sample.means);
                splats.orientations.clone_from(&sample.orientations);
                if let Some(scales) = &sample.scales {
                    splats.scales.clone_from(scales);
                }
            }
            place(&mut splats, all, &pose);
        }
    }
    splats
}

/// Turns a whole scene about the origin so that another of its axes is up.
pub(crate) fn turn_up(splats: &mut Splats, from: UpAxis, to: UpAxis) {
    let axis = |up| match up {
        UpAxis::Y => DVec3::Y,
        UpAxis::Z => DVec3::Z,
    };
    let rotation = DQuat::from_rotation_arc(axis(from), axis(to));
    let all = 0..splats.len();
    place(splats, all, &PoseSample { time_code: 0.0, translation: DVec3::ZERO, rotation });
}

/// Brings splats of a range into the frame that `pose` stands in.
fn place(splats: &mut Splats, range: Range<usize>, pose: &PoseSample) {
    for mean in &mut splats.means[range.clone()] {
        let local = DVec3::from_array(mean.map(f64::from));
        *mean = (pose.rotation * local + pose.translation).to_array().map(|value| value as f32);
    }
    if pose.rotation == DQuat::IDENTITY {
        return;
    }
    let turn = pose.rotation.normalize();
    let turn = [turn.w, turn.x, turn.y, turn.z];
    for orientation in &mut splats.orientations[range.clone()] {
        *orientation = quaternion::multiply(turn, orientation.map(f64::from)).map(|value| value as f32);
    }
    let stride = 3 * coefficient_count(splats.sh_degree);
    let coefficients = &mut splats.sh_coefficients[range.start * stride..range.end * stride];
    HarmonicsRotation::from_quaternion(turn.map(|value| value as f32))
        .rotate_all(coefficients, splats.sh_degree);
}
