//! Objects whose motion is known, rendered and found again.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::tracks::RotationEvidence;
use cif_geometry::PixelGrid;
use glam::{DQuat, DVec3};
use rand::RngExt;

use super::bend;
use super::fit::Fit;
use super::grow::grow;
use super::mend::{mend, onto_masks};
use super::object::Object;
use super::outlines;
use super::parts::{self, InPlace};
use super::plane::{self, Plane};
use super::shape::Pose;
use super::split::SplitViews;
use super::start::{Fitted, fit_object};
use super::testing::{
    self, Cameras, FLOOR, TIMES, camera, jumping, moving, patches, rig, solid, sphere_places, views,
    views_in_masks, views_of_groups, with_objects,
};
use super::view::ObjectView;
use crate::phases::Phases;
use crate::random::{Purpose, stream};

fn fit(views: &[ObjectView]) -> Fitted {
    fit_on(Some(&FLOOR), views).unwrap()
}

fn fit_on(plane: Option<&Plane>, views: &[ObjectView]) -> Option<Fitted> {
    with_objects(plane, views, |objects| fit_object(objects).unwrap())
}

/// Largest error of turns relative to the first pose, degrees, and mean error of displacements, metres.
fn errors(found: &BTreeMap<usize, (DQuat, DVec3)>, truth: &[(DQuat, DVec3)]) -> (f64, f64) {
    let (start, first) = found.iter().next().map(|(time, pose)| (*time, *pose)).unwrap();
    let last = truth[start];
    let (mut turn, mut shift) = (0.0_f64, 0.0);
    for (time, (rotation, place)) in found {
        let expected = truth[*time].0 * last.0.inverse();
        let actual = *rotation * first.0.inverse();
        turn = turn.max(actual.angle_between(expected).to_degrees());
        // The middle of what was found need not be that of the truth.
        let offset = first.0.inverse() * (last.1 - first.1);
        shift += (*rotation * offset + *place - truth[*time].1).length();
    }
    (turn, shift / found.len() as f64)
}

/// An object in its true poses at some times, made of so many Gaussians.
fn in_true_poses<'a>(
    object: &Object<'a>,
    truth: &[(DQuat, DVec3)],
    times: impl IntoIterator<Item = usize>,
    gaussians: usize,
) -> Fit<'a> {
    let pose = |time: usize| (time, Pose { rotation: truth[time].0, translation: truth[time].1 });
    let poses = times.into_iter().map(pose).collect();
    let shape = object.hull(&poses, gaussians, &mut object.rng()).unwrap();
    object.fit(poses, shape, object.rng())
}

fn sides(half: DVec3) -> Vec<DVec3> {
    testing::sides(half, 9)
}

fn box_places() -> Vec<DVec3> {
    sides(DVec3::splat(0.045))
}

#[test]
fn a_textured_box_that_slides_and_turns_is_found() {
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let share = k as f64 / (TIMES - 1) as f64;
            let share = share * share * (3.0 - 2.0 * share);
            (DQuat::from_rotation_z(1.4 * share), DVec3::new(-0.2 + 0.4 * share, 0.1 * share, 0.05))
        })
        .collect();
    let fitted = fit(&views(solid(&box_places(), patches, 0.006), &truth, moving));
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(turn < 4.0 && shift < 0.008, "{turn} deg, {shift} m, {}", fitted.way);
    assert_eq!(fitted.rotation, RotationEvidence::Observed);
    assert!(fitted.error < 0.1, "{}", fitted.error);
}

#[test]
fn what_slides_unevenly_is_judged_by_its_looks_and_not_by_where_it_is_between() {
    let pose = |k: usize| {
        // At times that are left out it is ahead of the middle of their neighbours by more than half a step.
        let ahead = if k % 4 == 2 { 0.6 } else { 0.0 };
        let share = (k as f64 + ahead) / (TIMES - 1) as f64;
        (DQuat::from_rotation_z(1.4 * share), DVec3::new(-0.2 + 0.4 * share, 0.1 * share, 0.05))
    };
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(pose).collect();
    let fitted = fit(&views(solid(&box_places(), patches, 0.006), &truth, moving));
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(turn < 4.0 && shift < 0.008, "{turn} deg, {shift} m, {}", fitted.way);
    assert_eq!(fitted.rotation, RotationEvidence::Observed);
    assert!(fitted.error < 0.05, "{}", fitted.error);
}

/// Rolls without slip, with a radius up to the middle of its outermost Gaussians and their thickness.
fn rolling(radius: f64) -> Vec<(DQuat, DVec3)> {
    (0..TIMES)
        .map(|k| {
            let way = 0.4 * k as f64 / (TIMES - 1) as f64;
            (DQuat::from_rotation_y(way / radius), DVec3::new(-0.2 + way, 0.0, radius))
        })
        .collect()
}

#[test]
fn a_textured_ball_is_found_to_roll_and_a_plain_one_is_assumed_to() {
    let truth = rolling(0.057);
    let textured = fit(&views(solid(&sphere_places(0.05), patches, 0.006), &truth, moving));
    let (turn, shift) = errors(&textured.poses, &truth);
    assert!(turn < 25.0 && shift < 0.01, "{turn} deg, {shift} m, {}", textured.way);
    assert!(textured.way.starts_with("rolls"), "{}", textured.way);
    let plain = fit(&views(solid(&sphere_places(0.05), |_| [0.8, 0.5, 0.2], 0.006), &truth, moving));
    assert_eq!(plain.rotation, RotationEvidence::Assumed, "{}, {}", plain.way, plain.error);
    assert!(plain.way.starts_with("rolls"), "{}", plain.way);
    let (turn, shift) = errors(&plain.poses, &truth);
    // Nothing but its outline, of 30 pixels, shows how far it went: 400 degrees.
    assert!(turn < 60.0 && shift < 0.015, "{turn} deg, {shift} m");
}

#[test]
fn what_is_at_rest_is_left_alone() {
    let at_rest = vec![(DQuat::from_rotation_z(0.4), DVec3::new(0.05, 0.02, 0.05)); TIMES];
    assert!(fit_on(Some(&FLOOR), &views(solid(&box_places(), patches, 0.006), &at_rest, moving)).is_none());
}

/// Views of a solid in masks that lie up to some pixels beside it, on another side of it every time.
fn rough_views(solid: Gaussians, poses: &[(DQuat, DVec3)], cameras: Cameras, most: usize) -> Vec<ObjectView> {
    let mut rng = stream(0, Purpose::Objects, 4);
    let masks = |labels: PixelGrid<u16>| {
        let [right, down]: [usize; 2] = std::array::from_fn(|_| rng.random_range(0..=most));
        let mut moved = labels.map(|_| 0);
        let shift = down * labels.width as usize + right;
        moved.pixels[shift..].copy_from_slice(&labels.pixels[..labels.pixels.len() - shift]);
        moved
    };
    let groups = vec![0; solid.len()];
    views_in_masks(solid, groups, &[poses.to_vec()], cameras, masks)
}

#[test]
fn what_is_at_rest_in_rough_masks_is_left_alone() {
    let at_rest = vec![(DQuat::from_rotation_z(0.4), DVec3::new(0.05, 0.02, 0.05)); TIMES];
    let views = rough_views(solid(&box_places(), patches, 0.006), &at_rest, jumping, 4);
    let found = fit_on(Some(&FLOOR), &views);
    assert!(found.is_none(), "{}", found.unwrap().way);
}

#[test]
fn what_is_at_rest_and_cut_at_all_times_is_left_alone() {
    let beside: Cameras = |time| vec![camera(0.9 + 0.2 * time as f64 / TIMES as f64)];
    let right = DVec3::new(1.0_f64.cos(), 1.0_f64.sin(), 0.0);
    let at_rest = vec![(DQuat::IDENTITY, 0.31 * right + 0.05 * DVec3::Z); TIMES];
    let views = views(solid(&box_places(), patches, 0.006), &at_rest, beside);
    assert!(views.iter().all(|view| view.cut));
    let found = fit_on(Some(&FLOOR), &views);
    assert!(found.is_none(), "{:?}", found.map(|found| (found.way, found.error, found.unturned)));
}

#[test]
#[ignore = "long: make test-long"]
fn what_comes_to_rest_as_soon_as_it_is_seen_is_followed_to_the_border() {
    let right = DVec3::new(0.5_f64.cos(), 0.5_f64.sin(), 0.0);
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let way = [0.35, 0.31, 0.25].get(k).copied().unwrap_or(0.2);
            (DQuat::IDENTITY, way * right + 0.05 * DVec3::Z)
        })
        .collect();
    let views = views(solid(&box_places(), patches, 0.006), &truth, moving);
    assert!(views.iter().all(|view| view.cut == (view.time_index < 3)));
    let fitted = fit(&views);
    let early = fitted.poses.range(..3).map(|(time, pose)| (time, pose.1 - fitted.reference.1));
    let errors: Vec<f64> =
        early.map(|(time, shift)| (shift - (truth[*time].1 - truth[TIMES - 1].1)).length()).collect();
    assert!(errors.len() == 3 && errors.iter().all(|error| *error < 0.02), "{errors:?}");
}

/// Seen by one of several cameras, whose border cuts it, where it stands before it goes.
#[test]
fn what_one_camera_sees_a_part_of_is_found_where_it_is() {
    let place = |time: usize| DVec3::new((0.02 * (time as f64 - 8.0)).clamp(0.0, 0.24) - 0.1, 0.0, 0.045);
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
    let mut views = views(solid(&sphere_places(0.045), patches, 0.006), &truth, rig);
    let camera = views[0].camera_key;
    views.retain(|view| view.time_index > 11 || view.camera_key == camera);
    for view in views.iter_mut().filter(|view| view.time_index <= 11) {
        (view.cut, view.visible) = (true, 0.05);
    }
    with_objects(Some(&FLOOR), &views, |objects| {
        let mut fit = in_true_poses(&objects[0], &truth, 12..TIMES, 150);
        let known: Vec<usize> = (0..views.len()).filter(|view| views[*view].time_index > 11).collect();
        fit.steps(&known, 200, |_| (1.0, 0.0, 0));
        grow(&mut fit, &objects[0].outline.path);
        for time in 0..12 {
            let error = (fit.poses[&time].translation - place(time)).length();
            assert!(error < 0.006, "{time}: {error} m");
        }
    });
}

#[test]
#[ignore = "long: make test-long"]
fn what_shows_a_broader_side_is_not_lifted() {
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            // Its end is seen for a while.
            let share = (k as f64 / 15.0 - 1.0).max(0.0);
            let place = DVec3::new(0.12 - 0.24 * share, 0.2 * share - 0.1, 0.045);
            (DQuat::from_rotation_z(0.8 + 1.8 * share), place)
        })
        .collect();
    let long = sides(DVec3::new(0.04, 0.1, 0.04));
    let views = views(solid(&long, patches, 0.006), &truth, moving);
    let lifted =
        outlines::outlines(&views, Some(&FLOOR), TIMES).iter().any(|outline| !outline.air.is_empty());
    assert!(lifted, "its size alone would tell that it is lifted");
    let (turn, shift) = errors(&fit(&views).poses, &truth);
    assert!(turn < 6.0 && shift < 0.025, "{turn} deg, {shift} m");
}

/// A box that stands, falls over its edge, and lies.
fn falling() -> Vec<(DQuat, DVec3)> {
    let edge = DVec3::new(0.03, 0.0, 0.0);
    (0..TIMES)
        .map(|k| {
            let share = ((k as f64 - 12.0) / 6.0).clamp(0.0, 1.0);
            let turn = DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2 * share * share);
            (turn, edge + turn * (DVec3::new(0.0, 0.0, 0.08) - edge) + 0.005 * DVec3::Z)
        })
        .collect()
}

#[test]
#[ignore = "long: make test-long"]
fn what_falls_over_is_followed() {
    let truth = falling();
    let tall = sides(DVec3::new(0.03, 0.03, 0.08));
    let fitted = fit(&views(solid(&tall, patches, 0.006), &truth, moving));
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(turn < 15.0 && shift < 0.02, "{turn} deg, {shift} m, {}", fitted.way);
}

#[test]
fn a_plate_that_turns_in_place_is_found_by_its_texture() {
    let mut rng = stream(0, Purpose::Objects, 12);
    let places: Vec<DVec3> = (0..1500)
        .map(|_| {
            let (radius, angle) =
                (0.09 * rng.random::<f64>().sqrt(), std::f64::consts::TAU * rng.random::<f64>());
            DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.0)
        })
        .collect();
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let angle = 2.3 * k as f64 / (TIMES - 1) as f64;
            (DQuat::from_rotation_z(angle), DVec3::new(0.03, -0.02, 0.012))
        })
        .collect();
    let fitted = fit(&views(solid(&places, patches, 0.005), &truth, moving));
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(fitted.way.contains("in place"), "{}", fitted.way);
    assert!(turn < 8.0 && shift < 0.008, "{turn} deg, {shift} m");
}

/// A pillar on the floor that turns all the time.
fn turning_pillar(
    radians: f64,
    color: impl Fn(DVec3) -> [f32; 3],
    cameras: Cameras,
) -> (Vec<ObjectView>, Vec<(DQuat, DVec3)>) {
    let mut rng = stream(0, Purpose::Objects, 13);
    let places: Vec<DVec3> = (0..6000)
        .map(|_| {
            let angle = std::f64::consts::TAU * rng.random::<f64>();
            DVec3::new(0.04 * angle.cos(), 0.04 * angle.sin(), 0.16 * rng.random::<f64>() - 0.08)
        })
        .collect();
    let pose = |k: usize| {
        let place = DVec3::new(0.02, -0.03, 0.085);
        (DQuat::from_rotation_z(radians * k as f64 / (TIMES - 1) as f64), place)
    };
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(pose).collect();
    (views(solid(&places, color, 0.005), &truth, cameras), truth)
}

#[test]
fn a_pillar_that_turns_is_found_by_its_texture_and_left_at_rest_without() {
    for (radians, cameras, most) in [(-4.0, rig as Cameras, 8.0), (1.8, moving as Cameras, 15.0)] {
        let (views, truth) = turning_pillar(radians, patches, cameras);
        let fitted = fit(&views);
        let (turn, shift) = errors(&fitted.poses, &truth);
        assert!(fitted.way.contains("texture"), "{}", fitted.way);
        assert!(turn < most && shift < 0.004, "{turn} deg, {shift} m");
        assert_eq!(fitted.rotation, RotationEvidence::Observed);
        let at_rest = turning_pillar(0.0, patches, cameras).0;
        let plain = turning_pillar(radians, |_| [0.7, 0.4, 0.2], cameras).0;
        for views in [at_rest, plain] {
            let found = fit_on(Some(&FLOOR), &views);
            assert!(found.is_none(), "{}", found.unwrap().way);
        }
    }
}

/// Seen by one of several cameras, whose border leaves a sliver of it, where it stands before it is thrown.
#[test]
fn what_the_border_nearly_hides_at_first_is_found_where_it_is() {
    let right = DVec3::new(0.5_f64.cos(), 0.5_f64.sin(), 0.0);
    let place = |time: usize| {
        let thrown = (time as f64 - 6.6).clamp(0.0, 4.0);
        (0.345 - 0.1 * thrown) * right + (0.045 + 0.1 * thrown * (1.0 - thrown / 4.0)) * DVec3::Z
    };
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
    let cameras: Cameras = |_| [0.5, 2.0, 4.0].map(camera).to_vec();
    let mut views = views(solid(&sphere_places(0.045), patches, 0.006), &truth, cameras);
    let first = views[0].camera_key;
    views.retain(|view| view.time_index > 6 || view.camera_key == first);
    let slivers = views.iter().filter(|view| view.time_index <= 6 && view.cut && view.visible < 0.5);
    assert_eq!(slivers.count(), 7);
    with_objects(Some(&FLOOR), &views, |objects| {
        let mut fit = in_true_poses(&objects[0], &truth, 7..TIMES, 150);
        let known: Vec<usize> = (0..views.len()).filter(|view| views[*view].time_index > 6).collect();
        fit.steps(&known, 200, |_| (1.0, 0.0, 0));
        // A path that bends little leads beyond where it stood.
        let onward = |time: usize| place(7) + (7.0 - time as f64) * (place(7) - place(8));
        let path = |time: usize| (time, if time < 7 { onward(time) } else { place(time) });
        grow(&mut fit, &(0..TIMES).map(path).collect());
        for time in 0..7 {
            let error = (fit.poses[&time].translation - place(time)).length();
            assert!(error < 0.012, "{time}: {error} m");
        }
    });
}

#[test]
fn an_object_that_the_border_cuts_is_followed_from_where_it_is_seen_best() {
    // It comes in from beside the image, and stops as soon as all of it is seen.
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let share = k as f64 / (TIMES - 1) as f64;
            (DQuat::from_rotation_z(0.3 * share), DVec3::new(-0.05, -0.55 + 0.35 * share, 0.05))
        })
        .collect();
    let cameras: Cameras = |_| vec![camera(1.3)];
    let views = views(solid(&box_places(), patches, 0.006), &truth, cameras);
    let whole = views.iter().filter(|view| view.is_reliable()).count();
    assert!((1..8).contains(&whole), "{whole} of {} views show all of it", views.len());
    let mut fitted = fit(&views);
    assert!(fitted.way.starts_with("followed"), "{}", fitted.way);
    let most = views.iter().map(ObjectView::area).fold(0.0, f64::max);
    for view in views.iter().filter(|view| view.area() < 0.3 * most) {
        fitted.poses.remove(&view.time_index);
    }
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(turn < 8.0 && shift < 0.015, "{turn} deg, {shift} m over {} times", fitted.poses.len());
}

#[test]
fn several_cameras_follow_an_object_that_is_lifted_and_tilted() {
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let share = k as f64 / (TIMES - 1) as f64;
            let turn = DQuat::from_axis_angle(DVec3::new(0.6, 0.8, 0.0), 1.5 * share);
            (turn, DVec3::new(-0.1 + 0.2 * share, 0.05 * share, 0.05 + 0.15 * share))
        })
        .collect();
    let views = views(solid(&box_places(), patches, 0.006), &truth, rig);
    // Nothing needs to be known of what it stood on.
    let fitted = fit_on(None, &views).unwrap();
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(turn < 3.0 && shift < 0.004, "{turn} deg, {shift} m, {}", fitted.way);
    assert_eq!(fitted.rotation, RotationEvidence::Observed);
}

#[test]
#[ignore = "long: make test-long"]
fn one_camera_follows_an_object_from_where_it_stood_to_its_other_side() {
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let share = ((k as f64 - 7.0) / 15.0).clamp(0.0, 1.0);
            let turn = DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2 * share);
            let height = 0.05 + 0.4 * share * (1.0 - share);
            (turn, DVec3::new(-0.08 + 0.16 * share, 0.05 * share, height))
        })
        .collect();
    let fitted = fit(&views(solid(&box_places(), patches, 0.006), &truth, moving));
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(fitted.way.starts_with("followed"), "{}", fitted.way);
    assert!(turn < 10.0 && shift < 0.015, "{turn} deg, {shift} m");
}

/// Lifted and tilted meanwhile, and flat, so that it looks no larger.
fn lifted_and_tilted() -> (Vec<ObjectView>, Vec<(DQuat, DVec3)>) {
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let share = ((k as f64 - 8.0) / 14.0).clamp(0.0, 1.0);
            let up = (std::f64::consts::PI * share).sin();
            let turn = DQuat::from_rotation_y(0.9 * up);
            (turn, DVec3::new(-0.05 + 0.1 * share, 0.0, 0.045 + 0.1 * up))
        })
        .collect();
    let flat = sides(DVec3::new(0.06, 0.06, 0.03));
    (views(solid(&flat, patches, 0.006), &truth, moving), truth)
}

#[test]
fn supports_hold_objects_whose_distance_nothing_else_shows() {
    let truth: Vec<(DQuat, DVec3)> =
        (0..TIMES).map(|k| (DQuat::IDENTITY, DVec3::new(0.1 - 0.006 * k as f64, 0.0, 0.045))).collect();
    // Of every outline that it may have: rays of several cameras or sides show it, and it is held.
    let held = |cameras: Cameras| -> Vec<(bool, bool)> {
        let views = views(solid(&sphere_places(0.045), patches, 0.006), &truth, cameras);
        with_objects(Some(&FLOOR), &views, |objects| {
            let of = |object: &Object<'_>| {
                let path = &object.outline.path;
                let times: Vec<usize> = path.keys().copied().collect();
                let starts = object.starts(path, &times).unwrap();
                let fit = object.started(&starts.poses[0], path).unwrap();
                (object.outline.is_surrounded, fit.is_held())
            };
            objects.iter().map(of).collect()
        })
    };
    assert!(held(moving).contains(&(false, true)));
    assert!(held(rig).iter().all(|(_, held)| !held));
    let jumping = held(jumping);
    assert!(jumping.contains(&(true, false)) && !jumping.contains(&(true, true)), "{jumping:?}");
}

#[test]
fn what_is_lifted_and_tilted_is_followed_off_its_support() {
    let (views, truth) = lifted_and_tilted();
    with_objects(Some(&FLOOR), &views, |objects| {
        assert!(objects[0].outline.air.is_empty(), "its size alone would tell that it is lifted");
        let begun = objects[0].begun().unwrap().unwrap();
        let poses = begun.fit.poses.iter().map(|(time, pose)| (*time, (pose.rotation, pose.translation)));
        let (turn, shift) = errors(&poses.collect(), &truth);
        assert!(begun.way.in_words().starts_with("followed"), "{}", begun.way.in_words());
        assert!(turn < 12.0 && shift < 0.02, "{turn} deg, {shift} m");
    });
}

#[test]
fn times_that_hardly_show_it_are_off_the_support_between_times_that_are() {
    let (views, truth) = lifted_and_tilted();
    let hidden = [3, 8, 14, 15, 16];
    with_objects(Some(&FLOOR), &views, |objects| {
        let mut fit =
            in_true_poses(&objects[0], &truth, (0..TIMES).filter(|time| !hidden.contains(time)), 150);
        fit.air = (9..21).filter(|time| !hidden.contains(time)).collect();
        grow(&mut fit, &(0..TIMES).map(|time| (time, truth[time].1)).collect());
        assert_eq!(fit.poses.len(), TIMES);
        let mut air = fit.air.clone();
        air.sort_unstable();
        assert_eq!(air, (9..21).collect::<Vec<_>>());
    });
}

#[test]
#[ignore = "long: make test-long"]
fn a_bar_that_rolls_about_its_long_axis_is_found_by_its_texture() {
    let mut rng = stream(0, Purpose::Objects, 14);
    let places: Vec<DVec3> = (0..2500)
        .map(|_| {
            let angle = std::f64::consts::TAU * rng.random::<f64>();
            DVec3::new(0.025 * angle.cos(), 0.22 * (rng.random::<f64>() - 0.5), 0.025 * angle.sin())
        })
        .collect();
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let way = 0.2 * k as f64 / (TIMES - 1) as f64;
            (DQuat::from_rotation_y(way / 0.03), DVec3::new(-0.1 + way, 0.0, 0.03))
        })
        .collect();
    let fitted = fit(&views(solid(&places, patches, 0.005), &truth, moving));
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(fitted.way.starts_with("rolls"), "{}", fitted.way);
    assert!(turn < 15.0 && shift < 0.006, "{turn} deg, {shift} m");
}

/// Poses of a solid that turns a little from time to time, some of them turned, after they were mended.
fn mended(
    solid: Gaussians,
    jumped: std::ops::Range<usize>,
    turn: DQuat,
) -> (Vec<(DQuat, DVec3)>, BTreeMap<usize, Pose>) {
    let place = |k: usize| DVec3::new(0.006 * k as f64 - 0.09, 0.0, 0.05);
    let truth: Vec<(DQuat, DVec3)> =
        (0..TIMES).map(|k| (DQuat::from_rotation_z(0.04 * k as f64), place(k))).collect();
    let views = views(solid, &truth, moving);
    let poses = with_objects(Some(&FLOOR), &views, |objects| {
        let mut fit = in_true_poses(&objects[0], &truth, 0..TIMES, 300);
        for time in jumped {
            let pose = fit.poses.get_mut(&time).unwrap();
            *pose = Pose { rotation: turn * pose.rotation, ..*pose };
        }
        let all: Vec<usize> = (0..views.len()).collect();
        fit.steps(&all, 600, |_| (1.0, 0.0, 0));
        mend(&mut fit, &Phases::default()).unwrap();
        fit.poses
    });
    (truth, poses)
}

#[test]
fn poses_that_jump_are_mended_from_both_sides() {
    let (truth, poses) = mended(solid(&box_places(), patches, 0.006), 12..17, DQuat::from_rotation_y(1.0));
    let turns = poses.iter().map(|(time, pose)| pose.rotation.angle_between(truth[*time].0).to_degrees());
    let turns: Vec<f64> = turns.collect();
    assert!(turns.iter().all(|turn| *turn < 8.0), "{turns:.0?}");
}

#[test]
fn poses_aside_of_their_masks_move_onto_them() {
    let place = |k: usize| DVec3::new(0.006 * k as f64 - 0.09, 0.0, 0.05);
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|k| (DQuat::IDENTITY, place(k))).collect();
    for cameras in [moving as Cameras, rig] {
        let views = views(solid(&box_places(), patches, 0.006), &truth, cameras);
        let errors = with_objects(Some(&FLOOR), &views, |objects| {
            let mut fit = in_true_poses(&objects[0], &truth, 0..TIMES, 300);
            let all: Vec<usize> = (0..views.len()).collect();
            fit.steps(&all, 600, |_| (1.0, 0.0, 0));
            // As a smooth path passes by where something bounces.
            fit.poses.get_mut(&9).unwrap().translation += DVec3::new(0.0, 0.0, 0.2);
            let error = |fit: &Fit<'_>| (fit.poses[&9].translation - truth[9].1).length();
            let before = fit.poses.clone();
            onto_masks(&mut fit, &Phases::default()).unwrap();
            let kept = (0..TIMES).filter(|time| *time != 9 && fit.poses[time] == before[time]).count();
            (error(&fit), kept)
        });
        assert!(errors.0 < 0.012 && errors.1 == TIMES - 1, "{errors:?}");
    }
}

#[test]
fn what_looks_the_same_from_two_sides_does_not_jump_to_the_other() {
    let plain = solid(&sides(DVec3::new(0.03, 0.06, 0.045)), |_| [0.7, 0.5, 0.2], 0.006);
    let half = DQuat::from_rotation_z(std::f64::consts::PI);
    let (_, poses) = mended(plain, 12..TIMES, half);
    let rotations: Vec<DQuat> = poses.values().map(|pose| pose.rotation).collect();
    let turns: Vec<f64> =
        rotations.windows(2).map(|pair| pair[0].angle_between(pair[1]).to_degrees()).collect();
    assert!(turns.iter().all(|turn| *turn < 15.0), "{turns:.0?}");
}

#[test]
fn a_camera_that_jumps_follows_what_is_thrown_and_spins() {
    let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
        .map(|k| {
            let share = k as f64 / (TIMES - 1) as f64;
            let turn = DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.6 * share);
            (turn, DVec3::new(-0.1 + 0.2 * share, 0.05, 0.05 + 0.4 * share * (1.0 - share)))
        })
        .collect();
    // Neither its support nor its size is known.
    let fitted = fit_on(None, &views(solid(&box_places(), patches, 0.006), &truth, jumping)).unwrap();
    let (turn, shift) = errors(&fitted.poses, &truth);
    assert!(turn < 6.0 && shift < 0.008, "{turn} deg, {shift} m, {}", fitted.way);
    assert!(fitted.error < 0.09, "{}", fitted.error);
}

#[test]
#[ignore = "long: make test-long"]
fn how_a_plain_ball_turns_in_the_air_is_assumed() {
    let place = |k: usize| {
        let share = k as f64 / (TIMES - 1) as f64;
        DVec3::new(-0.1 + 0.2 * share, 0.05, 0.1 + 0.4 * share * (1.0 - share))
    };
    let truth: Vec<(DQuat, DVec3)> =
        (0..TIMES).map(|k| (DQuat::from_rotation_x(0.2 * k as f64), place(k))).collect();
    let plain = solid(&sphere_places(0.05), |_| [0.8, 0.5, 0.2], 0.006);
    let fitted = fit(&views(plain, &truth, jumping));
    assert_eq!(fitted.rotation, RotationEvidence::Assumed, "{}", fitted.way);
    let turns = fitted.poses.values().map(|(rotation, _)| rotation.angle_between(DQuat::IDENTITY));
    assert!(turns.fold(0.0, f64::max) < 1e-6, "{}", fitted.way);
}

#[test]
fn turns_at_times_that_hide_it_go_the_way_of_those_around_them() {
    let truth = rolling(0.057);
    let mut views = views(solid(&sphere_places(0.05), patches, 0.006), &truth, moving);
    // The shortest turn across the gap is the other way round; between 3 and 5 the poses there show it.
    views.retain(|view| view.time_index != 4 && !(8..22).contains(&view.time_index));
    with_objects(Some(&FLOOR), &views, |objects| {
        let gaps = |rolls: Option<f64>| {
            let times = views.iter().map(|view| view.time_index);
            let mut fit = in_true_poses(&objects[0], &truth, times, 300);
            fit.rolls = rolls;
            fit.fill_long_turns();
            let error =
                |(time, pose): (&usize, &Pose)| pose.rotation.angle_between(truth[*time].0).to_degrees();
            assert!(fit.poses.len() == TIMES - 1 && !fit.poses.contains_key(&4));
            fit.poses.iter().map(error).fold(0.0, f64::max)
        };
        assert!(truth[7].0.angle_between(truth[22].0) < 2.8, "{}", truth[7].0.angle_between(truth[22].0));
        assert!(gaps(Some(0.055)) < 10.0, "as it rolls");
        assert!(gaps(None) < 1.0, "as fast as before and after");
    });
}

#[test]
fn one_camera_without_a_support_says_nothing_of_distances() {
    let truth = vec![(DQuat::IDENTITY, DVec3::ZERO); TIMES];
    let views = views(solid(&box_places(), patches, 0.006), &truth, moving);
    assert!(outlines::outlines(&views, None, TIMES).is_empty());
}

#[test]
fn the_support_is_found_among_other_points() {
    let mut rng = stream(0, Purpose::Objects, 11);
    let points: Vec<DVec3> = (0..400)
        .map(|k| {
            let p = DVec3::from(std::array::from_fn(|_| 2.0 * rng.random::<f64>() - 1.0));
            if k % 2 == 0 { DVec3::new(p.x, p.y, 0.3 + 0.001 * p.z) } else { p }
        })
        .collect();
    let rng = || stream(0, Purpose::Objects, 0);
    let above = [DVec3::new(0.0, 0.0, 2.0)];
    let found = plane::support(&points, &above, 0.005, rng()).unwrap();
    assert!(found.normal.dot(DVec3::Z) > 0.999 && (found.offset - 0.3).abs() < 0.01, "{found:?}");
    let below = plane::support(&points, &[DVec3::new(0.0, 0.0, -2.0)], 0.005, rng()).unwrap();
    assert!(below.normal.dot(DVec3::Z) < -0.999, "the normal looks at the cameras");
    let loose: Vec<DVec3> = points.iter().copied().skip(1).step_by(2).collect();
    assert!(plane::support(&loose, &above, 0.005, rng()).is_none());
}

#[test]
fn what_folds_on_its_way_is_explained_by_bending_and_a_solid_is_not() {
    let bar = sides(DVec3::new(0.09, 0.02, 0.02));
    let group_of: Vec<u32> = bar.iter().map(|place| u32::from(place.x > 0.0)).collect();
    let gaussians = || solid(&bar, patches, 0.006);
    let way = |k: usize| k as f64 / (TIMES - 1) as f64;
    let at = |k: usize| DVec3::new(-0.2 + 0.4 * way(k), 0.1 * way(k), 0.05);
    let side = |sign: f64, fold: f64| -> Vec<(DQuat, DVec3)> {
        (0..TIMES).map(|k| (DQuat::from_rotation_z(sign * fold * (2.0 * way(k) - 1.0)), at(k))).collect()
    };
    let bent = |fold: f64| {
        let views = views_of_groups(gaussians(), group_of.clone(), &[side(-1.0, fold), side(1.0, fold)], rig);
        with_objects(Some(&FLOOR), &views, |objects| {
            let poses: BTreeMap<usize, Pose> = (0..TIMES).map(|k| (k, Pose::at(at(k)))).collect();
            let mut rng = objects[0].rng();
            let shape = objects[0].hull(&poses, 150, &mut rng).unwrap();
            let mut fit = objects[0].fit(poses, shape, rng);
            let all: Vec<usize> = (0..views.len()).collect();
            let (left_out, train): (Vec<usize>, Vec<usize>) = all.iter().partition(|view| *view % 5 == 2);
            let level = fit.trial_level();
            fit.steps(&train, 300, |_| (1.0, 0.0, level));
            bend::gain(&fit, &SplitViews { train, left_out }, level)
        })
    };
    let (folds, stays) = (bent(0.7), bent(0.0));
    assert!(folds < 0.85, "{folds}");
    assert!(stays > 0.95, "{stays}");
}

#[test]
fn what_is_squashed_where_it_stands_is_given_neither_poses_nor_a_part() {
    const LAYERS: usize = 10;
    let cube: Vec<DVec3> =
        sides(DVec3::splat(0.05)).into_iter().map(|place| place + DVec3::new(0.0, 0.0, 0.05)).collect();
    let layer = |place: &DVec3| ((place.z / 0.1 * LAYERS as f64) as u32).min(LAYERS as u32 - 1);
    let group_of: Vec<u32> = cube.iter().map(layer).collect();
    // Squashed, and pushed aside, the more the higher.
    let poses = |layer: usize| -> Vec<(DQuat, DVec3)> {
        let height = 0.1 * (layer as f64 + 0.5) / LAYERS as f64;
        let pose = |time: usize| {
            let share = (std::f64::consts::PI * time as f64 / TIMES as f64).sin().powi(2);
            (DQuat::IDENTITY, height * share * DVec3::new(0.3, 0.1, -0.4))
        };
        (0..TIMES).map(pose).collect()
    };
    let poses: Vec<_> = (0..LAYERS).map(poses).collect();
    for cameras in [moving as Cameras, rig as Cameras] {
        let views = views_of_groups(solid(&cube, patches, 0.007), group_of.clone(), &poses, cameras);
        assert!(fit_on(Some(&FLOOR), &views).is_none());
        let found = with_objects(Some(&FLOOR), &views, |objects| parts::find(objects[0]).unwrap());
        let Some(InPlace::Bends(found)) = found else { panic!("no bending") };
        let top = DVec3::new(0.0, 0.0, 0.1) - found.place;
        let shifted = [0, TIMES / 2].map(|time| found.shifts.shifted(time, &[top])[0]);
        let truth = 0.1 * DVec3::new(0.3, 0.1, -0.4);
        let off = (shifted[1] - shifted[0] - truth).length();
        // One camera hardly shows what moves towards it.
        assert!(off < 0.4 * truth.length(), "{off}");
    }
}
