//! Poses that the field records, as they are.
//!
//! A node whose Gaussians are all of rigid groups of its instance moves by the poses of these, whatever the tolerance,
//! and its splats are those of the field as they are stored: nothing is fitted. Several groups are parts, tied by the
//! joints of the field. Poses are taken at the sampled times; those that interpolation gives back up to rounding may be
//! left out.

use std::collections::BTreeSet;

use cif_field::{Field, Gaussians, Joint, TrackGroup};
use glam::DVec3;

use super::choose::{Chosen, ChosenParts, RigidPart};
use super::group::{MeanShape, MovingGroup};
use super::keys;
use crate::graph::{
    MotionModel, PartJoint, PoseSample, ResidualStatistics, SceneOptions, TimeCodes, pose_at,
};

/// Poses that differ by less are the same: world units, and radians.
const ROUNDING: f64 = 1e-9;

/// The rigid groups that the rows of an instance (a dense index) are of, ascending; none where some row is of no such
/// group, where the groups do not move, and where their motion is more than the options allow. `instance_of` gives the
/// instance of every group.
pub(crate) fn groups_of(
    field: &Field,
    instance_of: &[Option<usize>],
    instance: usize,
    rows: &[u32],
    options: &SceneOptions,
) -> Vec<u32> {
    let Some(tracks) = &field.tracks else { return Vec::new() };
    let is_rigid =
        |group: &TrackGroup| group.dense.is_none() && (!group.deformed || field.deformation.is_none());
    let group_of = |row: &u32| {
        let group = tracks.group(*row as usize)?;
        (instance_of[group] == Some(instance) && is_rigid(&tracks.groups[group])).then_some(group as u32)
    };
    let groups: Option<BTreeSet<u32>> = rows.iter().map(group_of).collect();
    let groups = Vec::from_iter(groups.unwrap_or_default());
    let model = if groups.len() > 1 { MotionModel::Parts } else { MotionModel::Rigid };
    let moves = groups.iter().any(|group| tracks.groups[*group as usize].poses.len() > 1);
    if moves && model <= options.most_expensive_motion { groups } else { Vec::new() }
}

/// The recorded motion of a node with [`MovingGroup::recorded`] groups; `None` without. `reference` are the Gaussians at
/// the first sampled time. Takes the groups away from a node that does not move at the sampled times.
pub(crate) fn motion(
    field: &Field,
    node: &mut MovingGroup,
    reference: &Gaussians,
    time_codes: &TimeCodes,
    options: &SceneOptions,
) -> Option<Chosen> {
    let tracks = field.tracks.as_ref()?;
    let full: Vec<Vec<PoseSample>> =
        node.recorded.iter().map(|group| sampled(&tracks.groups[*group as usize], time_codes)).collect();
    let leader = full.first()?;
    if full.iter().all(|track| is_constant(track)) {
        node.recorded.clear();
        node.static_shape = MeanShape::of(reference, &node.rows, |_| node.pivot);
        return Some(Chosen::Static);
    }
    node.pivot = leader[0].translation;
    let thin = |track: Vec<PoseSample>, rest: DVec3| {
        if options.reduce_keys { thinned(&track, rest) } else { track }
    };
    let mut parts: Vec<RigidPart> = Vec::new();
    // Part of every group, and the origin of the part among the Gaussians as they are stored.
    let mut places: Vec<(usize, DVec3)> = Vec::new();
    for (group, world) in node.recorded.iter().zip(&full) {
        let of = &tracks.groups[*group as usize];
        let in_node = relative(leader, world);
        let pivot = in_node[0].translation;
        let turned = in_node[0].rotation.xyz().length() > ROUNDING;
        if !parts.is_empty() && of.joint.is_none() && is_constant(&in_node) && !turned {
            // What is fixed to the first part is one with it.
            places.push((0, of.pivot - pivot));
            continue;
        }
        let joint = of.joint.and_then(|Joint { base, kind, axis }| {
            let (base, _) = places[node.recorded.iter().position(|other| *other == base)?];
            Some(PartJoint { base, kind, axis, anchor: DVec3::ZERO })
        });
        places.push((parts.len(), of.pivot));
        parts.push(RigidPart { pivot, track: thin(in_node, pivot), joint, ..RigidPart::default() });
    }
    let place_of = |row: u32| {
        let place = node.recorded.binary_search(&tracks.group_of[row as usize]);
        places[place.expect("rows of a recorded node are of its groups")]
    };
    let mut order: Vec<u32> = (0..node.rows.len() as u32).collect();
    order.sort_by_key(|position| place_of(node.rows[*position as usize]).0);
    let shape = |positions: &[u32]| {
        let rows: Vec<u32> = positions.iter().map(|position| node.rows[*position as usize]).collect();
        MeanShape::of(&field.gaussians, &rows, |row| place_of(row).1)
    };
    let track = thin(leader.clone(), node.pivot);
    if parts.len() == 1 {
        node.rigid_shape = shape(&order);
        return Some(Chosen::Rigid(track));
    }
    let mut end = 0;
    for (number, part) in parts.iter_mut().enumerate() {
        let count = |position: &&u32| place_of(node.rows[**position as usize]).0 == number;
        part.splats = end..end + order.iter().filter(count).count();
        end = part.splats.end;
        part.shape = shape(&order[part.splats.clone()]);
    }
    Some(Chosen::Parts(ChosenParts { track, order, parts, residual: ResidualStatistics::default() }))
}

/// The poses of a group at the sampled times.
fn sampled(group: &TrackGroup, time_codes: &TimeCodes) -> Vec<PoseSample> {
    let codes = time_codes.samples.iter().zip(&time_codes.times);
    let mut track: Vec<PoseSample> = codes
        .map(|(&time_code, &time)| {
            let (rotation, translation) = group.pose(time);
            PoseSample { time_code, translation, rotation: rotation.normalize() }
        })
        .collect();
    keys::one_hemisphere(&mut track);
    track
}

/// Poses in the frame of others at the same times.
fn relative(of: &[PoseSample], track: &[PoseSample]) -> Vec<PoseSample> {
    let in_frame = |(of, pose): (&PoseSample, &PoseSample)| {
        let back = of.rotation.conjugate();
        PoseSample {
            time_code: pose.time_code,
            translation: back * (pose.translation - of.translation),
            rotation: (back * pose.rotation).normalize(),
        }
    };
    let mut relative: Vec<PoseSample> = of.iter().zip(track).map(in_frame).collect();
    keys::one_hemisphere(&mut relative);
    relative
}

/// Distance of two poses: the larger one of world units and radians.
fn off(a: &PoseSample, b: &PoseSample) -> f64 {
    let turn = 2.0 * (a.rotation * b.rotation.conjugate()).xyz().length();
    a.translation.distance(b.translation).max(turn)
}

fn is_constant(track: &[PoseSample]) -> bool {
    track.iter().all(|pose| off(pose, &track[0]) <= ROUNDING)
}

/// The poses that interpolation does not give back; none where all are unturned at `rest`.
fn thinned(track: &[PoseSample], rest: DVec3) -> Vec<PoseSample> {
    if track.iter().all(|pose| off(pose, &pose_at(&[], rest, pose.time_code)) <= ROUNDING) {
        return Vec::new();
    }
    let allowed = vec![ROUNDING; track.len()];
    keys::reduce(track, &allowed, |sample, pose| off(&track[sample], &PoseSample::new(0.0, pose)))
}

#[cfg(test)]
mod tests {
    use cif_field::tracks::TrackPose;
    use glam::DQuat;

    use super::*;
    use crate::field_motion::FieldMotion;
    use crate::testing::{MEMBERS, TIMES, recorded_field};
    use crate::{FrameRange, Motion, MotionSource, Node, Tolerance, build, build_from};

    /// Motion of a field, with the times that were asked for.
    struct Counted<'a>(FieldMotion<'a>, Vec<f64>);

    impl MotionSource for Counted<'_> {
        fn gaussians_at(&mut self, time: f64) -> Gaussians {
            self.1.push(time);
            self.0.gaussians_at(time)
        }

        fn moves_rows(&self, rows: &[u32]) -> bool {
            self.0.moves_rows(rows)
        }

        fn follows_tracks(&self) -> bool {
            self.0.follows_tracks()
        }

        fn fades(&self) -> bool {
            self.0.fades()
        }
    }

    /// Two objects, of which the second is turned about a point and travels.
    fn turning() -> (Field, Vec<(DQuat, DVec3)>) {
        let mut field = recorded_field(2, 5);
        let group = &mut field.tracks.as_mut().unwrap().groups[1];
        group.poses[0].rotation = DQuat::from_rotation_x(0.4);
        let poses = TIMES.map(|time| group.pose(time)).to_vec();
        field.validate().unwrap();
        (field, poses)
    }

    fn assert_poses(node: &Node, poses: &[(DQuat, DVec3)]) {
        for (frame, (rotation, translation)) in poses.iter().enumerate() {
            let found = pose_at(node.track(), node.pivot, frame as f64);
            assert!(found.translation.distance(*translation) < 1e-9, "frame {frame}");
            assert!((found.rotation * rotation.conjugate()).xyz().length() < 1e-9, "frame {frame}");
        }
    }

    #[test]
    fn poses_are_those_of_the_group_and_no_splat_is_moved_to_find_them() {
        let (field, poses) = turning();
        let options = SceneOptions { tolerance: Tolerance::Percent(1000.0), ..SceneOptions::default() };
        let mut source = Counted(FieldMotion::new(&field), Vec::new());
        let graph = build_from(&field, &mut source, &options).unwrap();
        assert_eq!(source.1, [0.0], "the reference alone");
        assert_eq!(graph, build(&field, &options).unwrap());
        let node = &graph.nodes[1];
        assert_eq!((node.model(), node.splats.len()), (MotionModel::Rigid, MEMBERS));
        assert_poses(node, &poses);
        // Splats and their colours are as the field stores them.
        let pivot = field.tracks.as_ref().unwrap().groups[1].pivot;
        for (k, row) in node.splats.rows.iter().map(|row| *row as usize).enumerate() {
            let stored = DVec3::from_array(field.gaussians.means[row].map(f64::from)) - pivot;
            assert!(stored.distance(DVec3::from_array(node.splats.means[k].map(f64::from))) < 1e-7);
            let floats = node.splats.sh_coefficients.len() / MEMBERS;
            let colors = &node.splats.sh_coefficients[k * floats..(k + 1) * floats];
            assert_eq!(colors, &field.gaussians.sh_coefficients[row][..floats]);
        }
        // Only so much motion as is allowed, and only that of the field itself.
        let still = SceneOptions { most_expensive_motion: MotionModel::Static, ..options.clone() };
        assert_eq!(build(&field, &still).unwrap().nodes[1].model(), MotionModel::Static);
        let elsewhere = build_from(&field, &mut |_| field.gaussians.clone(), &options).unwrap();
        assert_eq!(elsewhere.nodes[1].model(), MotionModel::Static);
    }

    #[test]
    fn keys_that_interpolation_gives_back_are_left_out() {
        let (mut field, poses) = turning();
        let all = SceneOptions { reduce_keys: false, ..SceneOptions::default() };
        assert_eq!(build(&field, &all).unwrap().nodes[1].track().len(), TIMES.len());
        let part = SceneOptions { frames: Some(FrameRange { first: 2, last: 4 }), ..SceneOptions::default() };
        let node = &build(&field, &part).unwrap().nodes[1];
        assert!(node.pivot.distance(poses[2].1) < 1e-12);
        assert_eq!(node.track().first().map(|pose| pose.time_code), Some(2.0));
        assert_eq!(node.track().last().map(|pose| pose.time_code), Some(4.0));
        // Even motion between two keys needs these alone, if times are even too.
        field.timeline.times = (0..6).map(|k| f64::from(k) / 5.0).collect();
        let group = &mut field.tracks.as_mut().unwrap().groups[1];
        group.poses = vec![group.poses[0], TrackPose { time: 1.0, ..group.poses[5] }];
        assert_eq!(build(&field, &SceneOptions::default()).unwrap().nodes[1].track().len(), 2);
        // What stays where it is has no keys and is where it is.
        let group = &mut field.tracks.as_mut().unwrap().groups[1];
        group.poses[0] = TrackPose { time: 0.0, ..group.poses[1] };
        let graph = build(&field, &SceneOptions::default()).unwrap();
        assert_eq!(graph.nodes[1].model(), MotionModel::Static);
        let posed = field.deformed(0.5);
        let placed = graph.nodes[1].splats_at(2.0).means;
        for (mean, row) in placed.iter().zip(&graph.nodes[1].splats.rows) {
            let expected = DVec3::from_array(posed.means[*row as usize].map(f64::from));
            assert!(mean.distance(expected) < 1e-6, "row {row}");
        }
    }

    #[test]
    fn groups_that_move_as_one_are_one() {
        let (mut field, poses) = turning();
        let tracks = field.tracks.as_mut().unwrap();
        let second = TrackGroup { name: "second".into(), ..tracks.groups[1].clone() };
        tracks.groups.push(second);
        (MEMBERS + 25..2 * MEMBERS).for_each(|row| tracks.group_of[row] = 2);
        let one = build(&field, &SceneOptions::default()).unwrap();
        assert_eq!((one.nodes[1].model(), one.nodes[1].splats.len()), (MotionModel::Rigid, MEMBERS));
        assert_poses(&one.nodes[1], &poses);
        let around = |field: &Field, graph: &crate::SceneGraph| {
            for (frame, time) in TIMES.iter().enumerate() {
                let (posed, node) = (field.deformed(*time), &graph.nodes[1]);
                for (mean, row) in node.splats_at(frame as f64).means.iter().zip(&node.splats.rows) {
                    let expected = DVec3::from_array(posed.means[*row as usize].map(f64::from));
                    assert!(mean.distance(expected) < 2e-6, "row {row} at {frame}");
                }
            }
        };
        around(&field, &one);
        // Stored elsewhere in the world, but in one with the other.
        let group = &mut field.tracks.as_mut().unwrap().groups[2];
        group.pivot += DVec3::new(0.3, 0.0, 0.1);
        around(&field, &build(&field, &SceneOptions::default()).unwrap());
        // On a path of its own it is a part.
        let group = &mut field.tracks.as_mut().unwrap().groups[2];
        group.poses[3].translation.z += 0.2;
        let two = build(&field, &SceneOptions::default()).unwrap();
        let Motion::Parts(motion) = &two.nodes[1].motion else { panic!("{:?}", two.nodes[1].report) };
        assert_eq!(motion.parts.iter().map(|part| part.splats.len()).collect::<Vec<_>>(), [25, 15]);
        around(&field, &two);
    }
}
