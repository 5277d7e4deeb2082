//! The judge on solids whose turns are known.

use std::f64::consts::PI;

use glam::{DQuat, DVec3};

use super::super::shape::Pose;
use super::super::testing::{Cameras, TIMES, jumping, moving, patches, rig, solid, sphere_places, views};
use super::Course;
use super::judge::{Judge, Shown, Verdict, shown};

const RADIUS: f64 = 0.06;

/// Share of the sequence that a time is into.
fn share(time: usize) -> f64 {
    time as f64 / (TIMES - 1) as f64
}

/// A course: turns of so many degrees about an axis in all, places by time.
fn course(degrees: f64, axis: DVec3, place: impl Fn(usize) -> DVec3) -> Course {
    let pose = |time: usize| {
        let rotation = DQuat::from_axis_angle(axis, degrees.to_radians() * share(time));
        (time, Pose { rotation, translation: place(time) })
    };
    (0..TIMES).map(pose).collect()
}

fn poses(course: &Course) -> Vec<(DQuat, DVec3)> {
    course.values().map(|pose| (pose.rotation, pose.translation)).collect()
}

/// Courses with turns about an axis, none first, and the verdict about a ball that follows one of them.
fn judged(
    (truth, turns): (f64, &[f64]),
    axis: DVec3,
    place: impl Fn(usize) -> DVec3 + Copy,
    color: fn(DVec3) -> [f32; 3],
    cameras: Cameras,
) -> Verdict {
    let courses: Vec<Course> = turns.iter().map(|degrees| course(*degrees, axis, place)).collect();
    let ball = solid(&sphere_places(RADIUS), color, 0.007);
    let seen = views(ball, &poses(&course(truth, axis, place)), cameras);
    let mut courses = courses.into_iter();
    let mut judge = Judge::new(&seen, RADIUS, courses.next().unwrap()).unwrap();
    judge.add(courses.collect());
    judge.verdict().unwrap()
}

const TURNS: [f64; 9] = [0.0, 45.0, 90.0, 135.0, 180.0, -45.0, -90.0, -135.0, 225.0];

fn stays(_: usize) -> DVec3 {
    DVec3::new(0.0, 0.0, RADIUS)
}

#[test]
fn turns_in_place_are_observed_by_texture_alone() {
    for (k, cameras) in [(3, moving as Cameras), (8, rig as Cameras), (6, jumping as Cameras)] {
        let found = judged((TURNS[k] + 5.0, &TURNS), DVec3::Z, stays, patches, cameras);
        assert!(found.best == k && found.is_observed, "{k}: {found:?}");
    }
}

#[test]
fn what_stays_is_not_seen_to_turn() {
    for cameras in [moving as Cameras, rig as Cameras, jumping as Cameras] {
        let found = judged((0.0, &TURNS), DVec3::Z, stays, patches, cameras);
        assert_eq!(found.best, 0, "{found:?}");
    }
}

#[test]
fn what_rolls_is_not_judged_to_slide_and_the_reverse() {
    let place = |time: usize| DVec3::new(0.3 * share(time) - 0.15, 0.0, RADIUS);
    let rolls = (0.3 / RADIUS) * 180.0 / PI;
    let turns = [0.0, 0.5 * rolls, 0.75 * rolls, rolls, 1.25 * rolls, -rolls];
    for (k, cameras) in [(3, moving as Cameras), (3, rig as Cameras), (0, rig as Cameras)] {
        let found = judged((turns[k], &turns), DVec3::Y, place, patches, cameras);
        assert!(found.best == k && (found.is_observed || k == 0), "{k}: {found:?}");
    }
}

#[test]
fn a_plain_ball_shows_no_turn() {
    for cameras in [moving as Cameras, rig as Cameras] {
        let found = judged((135.0, &TURNS), DVec3::Z, stays, |_| [0.7, 0.5, 0.3], cameras);
        assert!(!found.is_observed || found.best == 0, "{found:?}");
    }
}

#[test]
fn shading_of_a_plain_ball_that_rolls_is_told_from_a_turn() {
    let place = |time: usize| DVec3::new(0.3 * share(time) - 0.15, 0.0, RADIUS);
    let rolls = |degrees: f64| course(degrees, DVec3::Y, place);
    let whole = (0.3 / RADIUS).to_degrees();
    let of = |color: fn(DVec3) -> [f32; 3], claimed: f64| {
        let seen = views(solid(&sphere_places(RADIUS), color, 0.007), &poses(&rolls(whole)), moving);
        shown(
            (&seen, RADIUS),
            &rolls(claimed),
            rolls(0.0),
            [0.5, 0.75, 1.0, 1.25].map(|share| rolls(share * whole)),
        )
    };
    assert_eq!(of(patches, whole), Some(Shown::Turn));
    assert_eq!(of(patches, 0.0), None);
    assert_ne!(of(|_| [0.7, 0.5, 0.3], whole), Some(Shown::Turn));
    assert_ne!(of(|_| [0.7, 0.5, 0.3], 0.0), Some(Shown::Turn));
}
