//! The judge on solids whose turns are known.

use std::f64::consts::PI;

use glam::{DQuat, DVec3};

use super::super::shape::Pose;
use super::super::testing::{
    Cameras, TIMES, camera, jumping, moving, patches, rig, solid, sphere_places, views,
};
use super::evidence::{Evidence, Look, Pixel};
use super::judge::{Judge, Rivals, Verdict, shown};
use super::painted::Cells;
use super::revolved::Revolving;
use super::shown::Shown;
use super::{Ball, Course};

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
    truth: f64,
    turns: &[f64],
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
    let compared = judge.compared();
    let turns =
        judge.verdict(&compared.layered, &compared.angles).filter(|found| found.is_observed && found.turns);
    turns.or_else(|| judge.verdict(&compared.shaded, &compared.angles)).unwrap()
}

const TURNS: [f64; 9] = [0.0, 45.0, 90.0, 135.0, 180.0, -45.0, -90.0, -135.0, 225.0];

fn stays(_: usize) -> DVec3 {
    DVec3::new(0.0, 0.0, RADIUS)
}

#[test]
fn turns_in_place_are_observed_by_texture_alone() {
    for (k, cameras) in [(3, moving as Cameras), (8, rig as Cameras), (6, jumping as Cameras)] {
        let found = judged(TURNS[k] + 5.0, &TURNS, DVec3::Z, stays, patches, cameras);
        assert!(found.best == k && found.is_observed, "{k}: {found:?}");
    }
}

#[test]
fn what_stays_is_not_seen_to_turn() {
    for cameras in [moving as Cameras, rig as Cameras, jumping as Cameras] {
        let found = judged(0.0, &TURNS, DVec3::Z, stays, patches, cameras);
        assert_eq!(found.best, 0, "{found:?}");
    }
}

/// Turns about the upright axis of a ball that is modelled with some radius: are they shown, and are they its own, by all of
/// it and by each half.
fn shown_turns(turns: Course, radius: f64, cameras: Cameras) -> [bool; 3] {
    let ball = solid(&sphere_places(RADIUS), patches, 0.007);
    let seen = views(ball, &poses(&turns), cameras);
    let evidence = Evidence::of(seen.iter()).unwrap();
    let ball = Ball { centre: stays(0), radius };
    let place =
        |look: &Look<'_>, pixel: &Pixel| ball.outward(look.view.camera.centre(), pixel.ray.normalize());
    let shown = Shown::of(&evidence, Cells::OfBall(24.0), place).unwrap();
    let found = shown.few.turned_about(DVec3::Z);
    let is_shown = shown.errors(&evidence, &found).is_some();
    [is_shown, shown.turns(&evidence, &found), shown.turns_in_halves(&evidence, &found)]
}

#[test]
fn paint_that_slides_over_a_surface_at_another_depth_is_no_turn() {
    let around = |time: usize| vec![camera(3.0 * share(time))];
    let turning = |degrees: f64| course(degrees, DVec3::Z, stays);
    for larger in [1.35, 1.5, 1.8] {
        assert_eq!(shown_turns(turning(0.0), larger * RADIUS, around), [true, false, false], "{larger}");
    }
    assert_eq!(shown_turns(turning(-200.0), RADIUS, moving), [true, true, true]);
}

#[test]
fn what_looks_another_way_from_some_time_on_may_not_have_turned() {
    let mut turns = course(0.0, DVec3::Z, stays);
    for pose in turns.values_mut().skip(TIMES / 2) {
        pose.rotation = DQuat::from_rotation_z(PI / 2.0);
    }
    assert_eq!(shown_turns(turns, RADIUS, moving), [true, false, false]);
}

#[test]
fn what_rolls_is_not_judged_to_slide_and_the_reverse() {
    let place = |time: usize| DVec3::new(0.3 * share(time) - 0.15, 0.0, RADIUS);
    let rolls = (0.3 / RADIUS) * 180.0 / PI;
    let turns = [0.0, 0.5 * rolls, 0.75 * rolls, rolls, 1.25 * rolls, -rolls];
    for (k, cameras) in [(3, moving as Cameras), (3, rig as Cameras), (0, rig as Cameras)] {
        let found = judged(turns[k], &turns, DVec3::Y, place, patches, cameras);
        assert!(found.best == k && (found.is_observed || k == 0), "{k}: {found:?}");
    }
}

#[test]
fn a_plain_ball_shows_no_turn() {
    for cameras in [moving as Cameras, rig as Cameras] {
        let found = judged(135.0, &TURNS, DVec3::Z, stays, |_| [0.7, 0.5, 0.3], cameras);
        assert!(!found.is_observed || found.best == 0, "{found:?}");
    }
}

#[test]
fn shading_of_a_plain_ball_that_rolls_is_distinguished_from_a_turn() {
    let place = |time: usize| DVec3::new(0.3 * share(time) - 0.15, 0.0, RADIUS);
    let rolls = |degrees: f64| course(degrees, DVec3::Y, place);
    let whole = (0.3 / RADIUS).to_degrees();
    let of = |color: fn(DVec3) -> [f32; 3], claimed: f64| {
        let seen = views(solid(&sphere_places(RADIUS), color, 0.007), &poses(&rolls(whole)), moving);
        let (unturned, others) = (rolls(0.0), Vec::new());
        let rolls: Vec<Course> =
            [0.5, 0.75, 1.0, 1.25].into_iter().map(|share| course(share * whole, DVec3::Y, place)).collect();
        let poses = course(claimed, DVec3::Y, place);
        shown(&seen, RADIUS, &poses, Rivals { unturned, rolls, others, by_outlines: false })
    };
    assert!(of(patches, whole));
    assert!(!of(patches, 0.0));
    assert!(!of(|_| [0.7, 0.5, 0.3], whole));
    assert!(!of(|_| [0.7, 0.5, 0.3], 0.0));
}

/// Size of the Gaussians of a cylinder.
const SPLAT: f64 = 0.0015;

/// Places on a cylinder of this length along the x axis.
fn cylinder(length: f64, radius: f64) -> Vec<DVec3> {
    let around = move |k: usize, radius: f64| {
        let angle = k as f64 / 60.0 * 2.0 * PI;
        DVec3::new(0.0, radius * angle.cos(), radius * angle.sin())
    };
    let ring = move |along: f64, radius: f64| (0..60).map(move |k| DVec3::X * along + around(k, radius));
    let side = (0..=60).flat_map(move |k| ring(length * (f64::from(k) / 60.0 - 0.5), radius));
    let ends = [0.2, 0.4, 0.6, 0.8]
        .into_iter()
        .flat_map(move |share| ring(-0.5 * length, share * radius).chain(ring(0.5 * length, share * radius)));
    side.chain(ends).collect()
}

/// Views of a cylinder that moves across its axis and turns by so much of rolling without slip, its course without turns,
/// and these turns, radians.
fn rolled_cylinder(
    slips: f64,
    color: fn(DVec3) -> [f32; 3],
    cameras: Cameras,
) -> (Vec<super::super::view::ObjectView>, Course, Vec<f64>) {
    let radius = 0.022;
    let place = |time: usize| DVec3::new(0.0, 0.2 * share(time) - 0.1, radius);
    let turns: Vec<f64> = (0..TIMES).map(|time| -slips * 0.2 * share(time) / radius).collect();
    let truth: Vec<(DQuat, DVec3)> =
        turns.iter().enumerate().map(|(time, turn)| (DQuat::from_rotation_x(*turn), place(time))).collect();
    let views = views(solid(&cylinder(0.16, radius - SPLAT), color, SPLAT as f32), &truth, cameras);
    (views, course(0.0, DVec3::X, place), turns)
}

/// Turns of a course about the x axis, radians, each near that of another.
fn about_x(course: &Course, near: &[f64]) -> Vec<f64> {
    let turn = |(pose, near): (&Pose, &f64)| {
        let turn = 2.0 * pose.rotation.x.atan2(pose.rotation.w);
        turn + ((near - turn) / (2.0 * PI)).round() * 2.0 * PI
    };
    course.values().zip(near).map(turn).collect()
}

/// Mean error of the turns that are found, radians; both are relative to the first.
fn rolled_error(slips: f64, color: fn(DVec3) -> [f32; 3], cameras: Cameras) -> f64 {
    let (seen, course, truth) = rolled_cylinder(slips, color, cameras);
    let revolving = Revolving::new(seen.iter(), 0.08, &course, DVec3::Z, Some(0.022)).unwrap();
    let found = about_x(&revolving.rolled(-DVec3::X).unwrap(), &truth);
    let error = |(turn, truth): (&f64, &f64)| (turn - found[0] - truth).abs();
    found.iter().zip(&truth).map(error).sum::<f64>() / TIMES as f64
}

#[test]
fn what_rolls_on_its_side_shows_how_far_by_its_paint() {
    for (cameras, slips) in [(moving as Cameras, 1.0), (rig as Cameras, 1.0), (jumping as Cameras, 0.93)] {
        let error = rolled_error(slips, patches, cameras);
        assert!(error < 0.2, "{slips}: {error}");
    }
    // Without paint its radius decides, which is known to a voxel.
    let plain = rolled_error(1.0, |_| [0.7, 0.5, 0.3], rig);
    assert!(plain < 1.0, "{plain} of 10 radians");
}

#[test]
fn what_lies_is_a_solid_of_revolution_about_no_upright_axis() {
    let (seen, course, _) = rolled_cylinder(1.0, patches, moving);
    let revolving = Revolving::new(seen.iter(), 0.08, &course, DVec3::Z, None).unwrap();
    let [lying, upright] = [-DVec3::X, DVec3::Z].map(|axis| revolving.covered(axis));
    assert!(lying > 0.85 && upright < 0.5, "{lying}, {upright}");
    // What stands is none about an axis across its way.
    let place = |time: usize| DVec3::new(0.0, 0.2 * share(time) - 0.1, 0.08);
    let course = self::course(0.0, DVec3::Z, place);
    let standing: Vec<DVec3> = cylinder(0.16, 0.03).iter().map(|p| DVec3::new(p.z, p.y, p.x)).collect();
    let seen = views(solid(&standing, patches, 0.003), &poses(&course), moving);
    let revolving = Revolving::new(seen.iter(), 0.08, &course, DVec3::Z, None).unwrap();
    let [lying, upright] = [-DVec3::X, DVec3::Z].map(|axis| revolving.covered(axis));
    assert!(upright > 0.85 && lying < 0.7, "{lying}, {upright}");
}

/// True where a box that stands and is turned by so many degrees on its way is judged to turn as claimed.
fn box_is_shown(truth: f64, claimed: f64, color: fn(DVec3) -> [f32; 3], by_outlines: bool) -> bool {
    let place = |time: usize| DVec3::new(0.3 * share(time) - 0.15, 0.0, 0.05);
    let of = |degrees: f64| course(degrees, DVec3::Z, place);
    let half = DVec3::new(0.035, 0.07, 0.05);
    let places: Vec<DVec3> = sphere_places(1.0).iter().map(|p| half * (*p / p.abs().max_element())).collect();
    let seen = views(solid(&places, color, 0.005), &poses(&of(truth)), moving);
    let others = (-6..=6).filter(|k| *k != 0).map(|k| of(30.0 * f64::from(k))).collect();
    let rivals = Rivals { unturned: of(0.0), rolls: Vec::new(), others, by_outlines };
    shown(&seen, half.max_element(), &of(claimed), rivals)
}

#[test]
fn outlines_show_how_a_plain_box_turns_where_poses_follow_them() {
    let plain = |_| [0.6, 0.6, 0.6];
    assert!(box_is_shown(130.0, 130.0, plain, true));
    assert!(!box_is_shown(130.0, 40.0, plain, true));
    assert!(!box_is_shown(130.0, 130.0, plain, false), "light alone");
}
