use cif_geometry::{quaternion, spherical_harmonics};
use glam::DMat3;

use super::*;
use crate::gaussians::SH_FLOATS;
use crate::{Field, Gaussians, testing};

fn close(a: &[f32], b: &[f32], tolerance: f32) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance)
}

fn color(sh: &[f32; SH_FLOATS], direction: DVec3) -> [f64; 3] {
    let basis = spherical_harmonics::basis(direction.to_array(), 3);
    std::array::from_fn(|c| (0..16).map(|m| basis[m] * f64::from(sh[3 * m + c])).sum())
}

#[test]
fn a_pose_carries_places_turns_orientations_and_colours() {
    let field = testing::tracked_field(24, 3);
    let without = Field { tracks: None, ..field.clone() };
    // Half way between the poses at 0.25 and 0.75.
    let time = 0.5;
    let (posed, plain) = (field.deformed(time), without.deformed(time));
    let group = &field.tracks.as_ref().unwrap().groups[0];
    let axis = DVec3::new(1.0, 2.0, 2.0) / 3.0;
    let turn = DQuat::from_axis_angle(axis, (0.9 - 0.6) / 2.0);
    let place = DVec3::new(0.3 + 0.5, -0.2, 0.1 * (0.9 - 0.6) / 2.0);
    for row in (0..24).step_by(4) {
        let mean = DVec3::from_array(plain.means[row].map(f64::from));
        let expected = turn * (mean - group.pivot) + place;
        assert!(close(&posed.means[row], &expected.as_vec3().to_array(), 1e-6), "{row}");
        let rotation = |gaussians: &Gaussians| {
            let rows = quaternion::to_rotation(gaussians.unit_quaternion(row).unwrap().map(f64::from));
            DMat3::from_cols_array_2d(&rows).transpose()
        };
        let error = DMat3::from_quat(turn) * rotation(&plain) - rotation(&posed);
        assert!(error.to_cols_array().iter().all(|value| value.abs() < 1e-5));
        for direction in [DVec3::X, DVec3::new(0.36, -0.48, 0.8)] {
            let (before, after) = (
                color(&plain.sh_coefficients[row], direction),
                color(&posed.sh_coefficients[row], turn * direction),
            );
            for channel in 0..3 {
                assert!((before[channel] - after[channel]).abs() < 1e-5, "{before:?} {after:?}");
            }
        }
    }
    // Without a group nothing changes.
    for row in (3..24).step_by(4) {
        assert_eq!(posed.means[row], plain.means[row]);
        assert_eq!(posed.sh_coefficients[row], plain.sh_coefficients[row]);
    }
}

#[test]
fn opacities_and_colours_follow_their_samples() {
    let mut field = testing::tracked_field(24, 3);
    let tracks = field.tracks.as_mut().unwrap();
    let samples = tracks.groups[0].opacities.as_mut().unwrap();
    // Members 0 and 1 go from 0 to 1 and from 1 to 0.
    (samples.values[0], samples.values[1]) = (0.0, 1.0);
    (samples.values[6], samples.values[7]) = (1.0, 0.0);
    for (time, first) in [(0.0, 0.0), (0.25, 0.0), (0.375, 0.25), (0.5, 0.5), (0.75, 1.0), (1.0, 1.0)] {
        let posed = field.deformed(time);
        assert!((posed.opacity(0) - first).abs() < 1e-6, "{time}: {}", posed.opacity(0));
        assert!((posed.opacity(4) - (1.0 - first)).abs() < 1e-6);
        assert!(posed.opacity_logits.iter().all(|logit| logit.is_finite()));
    }
    // Colours are sampled before the pose turns them: take the pose away, and they are as sampled.
    let tracks = field.tracks.as_mut().unwrap();
    tracks.groups[2].poses.clear();
    let colors = tracks.groups[2].colors.clone().unwrap();
    let posed = field.deformed(0.25);
    for (member, row) in (2..24).step_by(4).enumerate() {
        let expected: [f32; SH_FLOATS] =
            std::array::from_fn(|k| 0.75 * colors.values[member][k] + 0.25 * colors.values[6 + member][k]);
        assert!(close(&posed.sh_coefficients[row], &expected, 1e-6), "{row}");
    }
    assert!(field.moves());
    // Rows take their samples along.
    let some = field.tracks.as_ref().unwrap().gather(&[4, 0, 0]);
    assert_eq!(some.groups[0].opacities.as_ref().unwrap().values, [1.0, 0.0, 0.0, 0.0, 1.0, 1.0]);
    let mut regrouped = field.tracks.clone().unwrap();
    regrouped.regroup(&[4], "taken", DVec3::ZERO, |group| group);
    assert_eq!(regrouped.groups[3].opacities.as_ref().unwrap().values, [1.0, 0.0]);
    assert_eq!(regrouped.groups[0].opacities.as_ref().unwrap().members(), 5);
    regrouped.validate(24).unwrap();
    regrouped.groups[0].opacities.as_mut().unwrap().values[0] = 1.5;
    assert!(regrouped.validate(24).unwrap_err().to_string().contains("opacity 1.5"));
}

#[test]
fn groups_hide_deform_and_stay_as_they_say() {
    let field = testing::tracked_field(24, 4);
    let tracks = field.tracks.as_ref().unwrap();
    for (time, visible) in [(0.0, false), (0.49, false), (0.5, true), (1.0, true)] {
        assert_eq!(tracks.groups[1].is_visible(time), visible, "{time}");
        let posed = field.deformed(time);
        assert_eq!(posed.opacity(1) > 0.0, visible);
        assert_eq!(posed.occupancy(1) > 1e-30, visible);
    }
    // Dense samples replace the shape: members are the rows 1, 5, 9, ...
    let dense = tracks.groups[1].dense.as_ref().unwrap();
    let (early, between, late) = (field.deformed(0.0), field.deformed(0.3), field.deformed(1.0));
    for (member, row) in (1..24).step_by(4).enumerate() {
        assert_eq!(early.means[row], dense.means[member]);
        assert_eq!(late.means[row], dense.means[12 + member]);
        let half: [f32; 3] =
            std::array::from_fn(|k| (dense.means[member][k] + dense.means[6 + member][k]) / 2.0);
        assert!(close(&between.means[row], &half, 1e-6));
        assert_eq!(early.log_scales[row], [-2.0, -3.0, -2.5]);
    }
    // An exempt group is turned, but not deformed: its shape is the same at all times.
    assert_eq!(early.means[2], late.means[2]);
    assert_eq!(early.log_scales[2], field.gaussians.log_scales[2]);
    assert_ne!(early.means[2], field.gaussians.means[2]);
    assert_ne!(early.means[0], late.means[0]);
}

#[test]
fn poses_hold_outside_their_samples() {
    let field = testing::tracked_field(4, 1);
    let group = &field.tracks.as_ref().unwrap().groups[0];
    assert_eq!(group.pose(-3.0), group.pose(0.0));
    assert_eq!(group.pose(0.75), group.pose(9.0));
    assert_eq!(TrackGroup::still("a", DVec3::Y).pose(0.4), (DQuat::IDENTITY, DVec3::Y));
}

#[test]
fn gathered_rows_keep_their_motion() {
    let field = testing::tracked_field(40, 9);
    let sources = [9, 2, 3, 1, 9, 38, 0, 20, 5, 1];
    let gathered = field.gather(&sources);
    gathered.validate().unwrap();
    for time in [0.0, 0.33, 0.8] {
        assert_eq!(gathered.deformed(time), field.deformed(time).gather(&sources), "{time}");
    }
    // Groups without rows are dropped, and the others keep their motion.
    let few = field.gather(&[7, 2, 6]);
    few.validate().unwrap();
    assert_eq!(few.tracks.as_ref().unwrap().groups.len(), 1);
    assert_eq!(few.deformed(0.4), field.deformed(0.4).gather(&[7, 2, 6]));
    assert_eq!(field.gather(&[3, 7]).tracks, None);
}

#[test]
fn regrouped_rows_move_on_their_own_and_the_others_as_before() {
    let field = testing::tracked_field(40, 12);
    let rows = [9, 1, 0, 3, 8, 2];
    let mut changed = field.clone();
    let mut asked = Vec::new();
    changed.tracks.as_mut().unwrap().regroup(&rows, "edited", DVec3::X, |group| {
        asked.push(group.name.clone());
        TrackGroup { visibility: vec![VisibilityStep { time: 0.0, visible: false }], ..group }
    });
    changed.validate().unwrap();
    assert_eq!(asked, ["turning", "late", "added", "edited"]);
    for time in [0.2, 0.7] {
        let (before, after) = (field.deformed(time), changed.deformed(time));
        for row in 0..40 {
            assert_eq!(before.means[row], after.means[row], "row {row}");
            assert_eq!(before.quaternions[row], after.quaternions[row]);
            assert_eq!(after.opacity(row) == 0.0, rows.contains(&(row as u32)) || before.opacity(row) == 0.0);
        }
    }
}

#[test]
fn a_group_that_does_nothing_changes_no_bit() {
    let plain = testing::field(30, 2);
    let tracks = Tracks { group_of: vec![0; 30], groups: vec![TrackGroup::still("all", DVec3::ONE)] };
    assert!(!tracks.moves() && !tracks.at(0.5).changes_anything());
    let tracked = Field { tracks: Some(tracks), ..plain.clone() };
    assert_eq!(tracked.deformed(0.6), plain.deformed(0.6));
}

#[test]
fn broken_tracks_are_refused() {
    type Break = fn(&mut Tracks);
    let breaks: [(&str, Break); 10] = [
        ("`tracks.group_of` has 19 entries", |tracks| {
            tracks.group_of.pop();
        }),
        ("`tracks.group_of` is 3 at row 0", |tracks| tracks.group_of[0] = 3),
        ("track group 0 (\"turning\") has a pose at 0.25 after one at 0.25", |tracks| {
            tracks.groups[0].poses[0].time = 0.25;
        }),
        ("has a pose at the time NaN", |tracks| tracks.groups[0].poses[0].time = f64::NAN),
        ("quaternion is not unit", |tracks| tracks.groups[0].poses[1].rotation.w = f64::NAN),
        ("translation is not finite", |tracks| tracks.groups[0].poses[1].translation.x = f64::INFINITY),
        ("pivot", |tracks| tracks.groups[2].pivot.y = f64::NAN),
        ("has 14 centres for 3 samples of 5 Gaussians", |tracks| {
            tracks.groups[1].dense.as_mut().unwrap().means.pop();
        }),
        ("without samples", |tracks| tracks.groups[1].dense.as_mut().unwrap().times.clear()),
        ("`its log-scales` holds NaN at row 2, column 1", |tracks| {
            tracks.groups[1].dense.as_mut().unwrap().log_scales.as_mut().unwrap()[2][1] = f32::NAN;
        }),
    ];
    for (words, break_it) in breaks {
        let mut field = testing::tracked_field(20, 6);
        field.validate().unwrap();
        break_it(field.tracks.as_mut().unwrap());
        let message = field.validate().unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    }
}
