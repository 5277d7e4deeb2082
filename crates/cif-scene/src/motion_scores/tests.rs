use std::f64::consts::FRAC_PI_2;

use cif_dataset::CaptureFrame;
use cif_geometry::{Bounds, RigidTransform};
use glam::{DMat4, DQuat};

use super::*;
use crate::{DenseMotion, DenseSample, Motion, PoseSample, SceneOptions, Splats, testing};

/// Mask id of the instance.
const ID: u16 = 2;

/// A graph with one node, of splats without turn and of this size, that moves so over some frames.
fn graph(means: &[DVec3], scale: f32, motion: Motion, frames: usize) -> SceneGraph {
    let mut graph = crate::build(&testing::recorded_field(1, 1), &SceneOptions::default()).unwrap();
    graph.nodes.truncate(1);
    graph.time_codes.samples = (0..frames).map(|frame| frame as f64).collect();
    graph.time_codes.times = times(frames);
    let node = &mut graph.nodes[0];
    assert!(matches!(node.kind, NodeKind::Instance { id: ID, .. }));
    node.pivot = DVec3::ZERO;
    node.motion = motion;
    node.splats = Splats {
        means: means.iter().map(|mean| mean.as_vec3().to_array()).collect(),
        orientations: vec![[1.0, 0.0, 0.0, 0.0]; means.len()],
        scales: vec![[scale; 3]; means.len()],
        opacities: vec![1.0; means.len()],
        ..Splats::default()
    };
    graph
}

fn times(frames: usize) -> Vec<f64> {
    (0..frames).map(|frame| frame as f64 / (frames - 1) as f64).collect()
}

/// Corners of a cube of side 0.2 around the origin.
fn corners() -> Vec<DVec3> {
    (0..8)
        .map(|k| DVec3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2)) * 0.2 - 0.1)
        .collect()
}

/// The instance as it moves in truth: centres of the sides of the cube are followed.
fn truth(kind: &str, poses: &[RigidTransform]) -> MotionTruth {
    let centres =
        [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z].map(|axis| axis * 0.1);
    let around =
        |pose: &RigidTransform| Bounds::around(corners().into_iter().map(|corner| pose.apply(corner)));
    let motion = TrueMotion {
        label: "cube".into(),
        kind: kind.into(),
        // The object is modelled in units of its own.
        world_from_object: poses
            .iter()
            .map(|pose| {
                DMat4::from_mat3_translation(pose.rotation, pose.translation)
                    * DMat4::from_scale(DVec3::splat(0.1))
            })
            .collect(),
        boxes: poses.iter().map(around).collect(),
        points: centres.map(|centre| poses.iter().map(|pose| pose.apply(centre)).collect()).to_vec(),
    };
    MotionTruth { times: times(poses.len()), instances: BTreeMap::from([(ID, motion)]) }
}

fn track(poses: &[RigidTransform]) -> Vec<PoseSample> {
    poses.iter().enumerate().map(|(step, pose)| PoseSample::new(step as f64, pose)).collect()
}

fn shifts(count: usize, step: DVec3) -> Vec<RigidTransform> {
    (0..count).map(|k| RigidTransform { translation: step * k as f64, ..RigidTransform::IDENTITY }).collect()
}

/// Poses that turn about an axis and travel.
fn travels() -> Vec<RigidTransform> {
    let axis = DVec3::new(1.0, 2.0, -0.5).normalize();
    let pose = |k: usize| RigidTransform {
        rotation: DMat3::from_axis_angle(axis, 0.3 * k as f64),
        translation: DVec3::new(0.1, -0.05, 0.02) * k as f64,
    };
    (0..5).map(pose).collect()
}

/// Scores where the instance is seen at all of the steps.
fn scores(graph: &SceneGraph, truth: &MotionTruth) -> MotionScores {
    motion_scores(graph, truth, &BTreeMap::from([(ID, (0..truth.times.len()).collect())]))
}

#[track_caller]
fn near(value: Option<f64>, expected: f64, tolerance: f64) {
    assert!(value.is_some_and(|value| (value - expected).abs() <= tolerance), "{value:?} {expected}");
}

#[test]
fn motion_that_is_recovered_has_no_error() {
    let poses = travels();
    let graph = graph(&corners(), 1e-9, Motion::Rigid(track(&poses)), 5);
    let scores = scores(&graph, &truth("rigid", &poses));
    let found = &scores.instances[0];
    assert_eq!((found.id, found.times, found.splats, found.moves), (ID, 5, 8, true));
    assert_eq!((found.truth.as_str(), found.model), ("rigid", Some(MotionModel::Rigid)));
    near(found.errors.error_mm, 0.0, 1e-6);
    near(found.errors.rotation_deg, 0.0, 1e-6);
    near(found.turned_deg, 1.2_f64.to_degrees(), 1e-9);
    near(found.errors.box_iou, 100.0, 1e-4);
    let within = [found.errors.within_10_mm, found.errors.within_20_mm, found.errors.within_50_mm];
    assert_eq!(within, [Some(100.0); 3]);
    assert!(found.errors.rest_mm.unwrap() > 100.0);
    let moving = scores.moving.unwrap();
    assert_eq!((moving.instances, moving.errors), (1, found.errors));
    assert_eq!(scores.resting, None);
}

#[test]
fn a_still_graph_leaves_the_whole_path_unexplained() {
    let graph = graph(&corners(), 1e-9, Motion::Static, 3);
    // Pairs of three times are 15, 15, 15, 15, 30 and 30 mm apart.
    let found = scores(&graph, &truth("rigid", &shifts(3, DVec3::X * 0.015))).instances[0].errors;
    near(found.error_mm, 20.0, 1e-9);
    near(found.rest_mm, 20.0, 1e-9);
    // Of a cube of side 200 mm.
    near(found.error_of_size, 100.0 * 20.0 / (200.0 * 3.0_f64.sqrt()), 1e-9);
    assert_eq!(found.within_10_mm, Some(0.0));
    near(found.within_20_mm, 400.0 / 6.0, 1e-9);
    assert_eq!(found.within_50_mm, Some(100.0));
    near(found.rotation_deg, 0.0, 1e-6);
    // Boxes of side 200 that are 0, 15 and 30 apart.
    let iou = |apart: f64| (200.0 - apart) / (200.0 + apart);
    near(found.box_iou, 100.0 * (1.0 + iou(15.0) + iou(30.0)) / 3.0, 1e-4);
}

#[test]
fn rotations_that_are_missed_are_reported_in_degrees() {
    let turn =
        |angle: f64| RigidTransform { rotation: DMat3::from_rotation_z(angle), ..RigidTransform::IDENTITY };
    let graph = graph(&corners(), 1e-9, Motion::Static, 2);
    let found = scores(&graph, &truth("rigid", &[turn(0.0), turn(FRAC_PI_2)])).instances.remove(0);
    near(found.errors.rotation_deg, 90.0, 1e-6);
    near(found.turned_deg, 90.0, 1e-6);
    // A quarter turn about z moves four of the six points by the root of two times 100 mm.
    near(found.errors.error_mm, 100.0 * 2.0_f64.sqrt() * 4.0 / 6.0, 1e-6);
    // A cube does not show it, but its points do. What deforms has no rotation.
    near(found.errors.box_iou, 100.0, 1e-4);
    let found = scores(&graph, &truth("deforming", &[turn(0.0), turn(FRAC_PI_2)])).instances.remove(0);
    assert_eq!((found.errors.rotation_deg, found.turned_deg), (None, None));
    near(found.errors.error_mm, 100.0 * 2.0_f64.sqrt() * 4.0 / 6.0, 1e-6);
}

#[test]
fn rotations_count_by_what_is_claimed_of_them() {
    let turned = |degrees: f64| RigidTransform {
        rotation: DMat3::from_rotation_z(degrees.to_radians()),
        ..RigidTransform::IDENTITY
    };
    let claims = |found: f64, truth_deg: f64, kind: &str, claim| {
        let motion = Motion::Rigid(track(&[RigidTransform::IDENTITY, turned(found)]));
        let mut graph = graph(&corners(), 1e-9, motion, 2);
        graph.nodes[0].report.rotation = claim;
        scores(&graph, &truth(kind, &[RigidTransform::IDENTITY, turned(truth_deg)])).claims
    };
    let (observed, assumed) = (Some(RotationEvidence::Observed), Some(RotationEvidence::Assumed));
    let (right, wrong) = (Verdicts { right: 1, wrong: 0 }, Verdicts { right: 0, wrong: 1 });
    let none = Claims::default();
    assert_eq!(claims(76.0, 90.0, "rigid", observed), Claims { observed: right, ..none });
    assert_eq!(claims(74.0, 90.0, "rigid", observed), Claims { observed: wrong, ..none });
    assert_eq!(claims(90.0, 90.0, "rigid", assumed), Claims { assumed: right, ..none });
    assert_eq!(claims(0.0, 90.0, "rigid", assumed), Claims { assumed: wrong, ..none });
    assert_eq!(claims(90.0, 90.0, "rigid", None), Claims { none: right, ..none });
    assert_eq!(claims(0.0, 90.0, "rigid", None), Claims { none: wrong, ..none });
    // What hardly turns is right without turning, and what deforms has no rotation.
    assert_eq!(claims(0.0, 19.0, "rigid", observed), none);
    assert_eq!(claims(0.0, 90.0, "deforming", observed), none);
}

#[test]
fn points_are_carried_by_the_orientation_of_splats() {
    // One splat in the middle that turns a quarter.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let sample = |time_code: f64, orientation: [f32; 4]| DenseSample {
        time_code,
        means: vec![[0.0; 3]],
        orientations: vec![orientation],
        scales: None,
        extent: Bounds::EMPTY,
    };
    let samples = vec![sample(0.0, [1.0, 0.0, 0.0, 0.0]), sample(1.0, [half, 0.0, 0.0, half])];
    let graph = graph(&[DVec3::ZERO], 0.1, Motion::Dense(DenseMotion { track: Vec::new(), samples }), 2);
    let quarter = RigidTransform { rotation: DMat3::from_rotation_z(FRAC_PI_2), ..RigidTransform::IDENTITY };
    let found = scores(&graph, &truth("rigid", &[RigidTransform::IDENTITY, quarter])).instances[0].errors;
    near(found.error_mm, 0.0, 1e-4);
    near(found.rotation_deg, 0.0, 1e-4);
    near(found.box_iou, 100.0, 1e-4);
}

#[test]
fn four_nearest_splats_carry_a_point() {
    // Four splats at the corners of a square around the origin, and a fifth that runs away.
    let square = [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y].map(|axis| axis * 0.01);
    let means: Vec<DVec3> = square.into_iter().chain([DVec3::Z]).collect();
    let sample = |time_code: f64, means: &[DVec3]| DenseSample {
        time_code,
        means: means.iter().map(|mean| mean.as_vec3().to_array()).collect(),
        orientations: vec![[1.0, 0.0, 0.0, 0.0]; means.len()],
        scales: None,
        extent: Bounds::EMPTY,
    };
    // The first of the four moves by 40 mm, so that their mean moves by 10.
    let mut later = means.clone();
    later[0] += DVec3::Z * 0.04;
    later[4] += DVec3::X;
    let samples = vec![sample(0.0, &means), sample(1.0, &later)];
    let graph = graph(&means, 0.01, Motion::Dense(DenseMotion { track: Vec::new(), samples }), 2);
    let mut truth = truth("static", &[RigidTransform::IDENTITY; 2]);
    truth.instances.get_mut(&ID).unwrap().points = vec![vec![DVec3::ZERO; 2]];
    let scores = scores(&graph, &truth);
    near(scores.instances[0].errors.error_mm, 10.0, 1e-5);
    near(scores.instances[0].errors.rest_mm, 0.0, 0.0);
    assert!(!scores.instances[0].moves && scores.moving.is_none() && scores.resting.is_some());
}

#[test]
fn times_at_which_nothing_is_seen_do_not_count() {
    let graph = graph(&corners(), 1e-9, Motion::Static, 3);
    let truth = truth("rigid", &shifts(3, DVec3::X * 0.015));
    let seen = |steps: &[usize]| BTreeMap::from([(ID, steps.to_vec())]);
    let found = &motion_scores(&graph, &truth, &seen(&[0, 1])).instances[0];
    near(found.errors.error_mm, 15.0, 1e-9);
    assert_eq!(found.times, 2);
    for unseen in [seen(&[1]), BTreeMap::new()] {
        let scores = motion_scores(&graph, &truth, &unseen);
        assert_eq!(scores.instances[0].errors, MotionErrors::default());
        assert_eq!((scores.moving, scores.resting), (None, None));
    }
}

#[test]
fn instances_without_a_node_are_listed_without_scores() {
    let mut graph = graph(&corners(), 1e-9, Motion::Static, 3);
    graph.nodes.clear();
    let scores = scores(&graph, &truth("rigid", &shifts(3, DVec3::X)));
    let found = &scores.instances[0];
    assert_eq!((found.model, found.splats, found.errors), (None, 0, MotionErrors::default()));
    assert_eq!(scores.moving, None);
}

#[test]
fn motion_is_measured_in_the_world_of_the_capture() {
    // The scene lies around (2e3, 0, -30), in units of 10 of the capture's.
    let frame = CaptureFrame { offset: [2e3, 0.0, -30.0], scale: 0.1 };
    let place = |pose: RigidTransform| RigidTransform {
        translation: pose.translation + DVec3::from(frame.offset),
        ..pose
    };
    let poses: Vec<RigidTransform> = travels().into_iter().map(place).collect();
    let inside: Vec<RigidTransform> = poses
        .iter()
        .map(|pose| RigidTransform { translation: frame.dataset_from_capture(pose.translation), ..*pose })
        .collect();
    let means: Vec<DVec3> = corners().into_iter().map(|corner| corner * frame.scale).collect();
    let mut graph = graph(&means, 1e-9, Motion::Rigid(track(&inside)), 5);
    graph.frame = frame;
    let found = scores(&graph, &truth("rigid", &poses)).instances[0].errors;
    near(found.error_mm, 0.0, 1e-5);
    near(found.rotation_deg, 0.0, 1e-4);
    near(found.box_iou, 100.0, 1e-3);
}

#[test]
fn first_times_are_eight_from_the_first_to_the_last() {
    let times = |count: usize| (0..count).map(|step| Time { step, code: 0.0 }).collect::<Vec<_>>();
    let steps = |count: usize| first_times(&times(count)).map(|time| time.step).collect::<Vec<_>>();
    assert_eq!(steps(72), [0, 10, 20, 30, 40, 50, 60, 71]);
    assert_eq!(steps(3), [0, 1, 2]);
    assert_eq!(steps(1), [0]);
}

#[test]
fn boxes_reach_one_standard_deviation_without_the_outermost_opacity() {
    let quarter = DQuat::from_rotation_z(FRAC_PI_2);
    let reach = opacity_box::reach(quarter, DVec3::new(0.3, 0.1, 0.2));
    assert!(reach.abs_diff_eq(DVec3::new(0.1, 0.3, 0.2), 1e-12), "{reach}");
    let eighth = opacity_box::reach(DQuat::from_rotation_z(FRAC_PI_2 / 2.0), DVec3::new(0.3, 0.1, 0.2));
    assert!((eighth.x - 0.05_f64.sqrt()).abs() < 1e-12, "{eighth}");
    // Of 100 equal splats at 0 to 99, those at 1 and 98 complete 2 % on their side.
    let line: Vec<DVec3> = (0..100).map(|k| DVec3::X * f64::from(k)).collect();
    let found = opacity_box::around(&line, &[DVec3::splat(0.5); 100], &[1.0; 100]);
    assert_eq!(found, Bounds { low: DVec3::new(0.5, -0.5, -0.5), high: DVec3::new(98.5, 0.5, 0.5) });
    // A faint splat far away does not count.
    let far = [DVec3::ZERO, DVec3::X, DVec3::X * 50.0];
    let found = opacity_box::around(&far, &[DVec3::splat(0.5); 3], &[1.0, 1.0, 0.01]);
    assert_eq!((found.low.x, found.high.x), (-0.5, 1.5));
}

#[test]
fn boxes_overlap_by_hand() {
    let cube = Bounds { low: DVec3::ZERO, high: DVec3::ONE };
    let shifted = Bounds { low: DVec3::X * 0.5, high: DVec3::new(1.5, 1.0, 1.0) };
    let apart = Bounds { low: DVec3::X * 2.0, high: DVec3::new(3.0, 1.0, 1.0) };
    assert!((opacity_box::overlap(&cube, &shifted) - 1.0 / 3.0).abs() < 1e-12);
    assert_eq!(opacity_box::overlap(&cube, &apart), 0.0);
    assert_eq!(opacity_box::overlap(&cube, &cube), 1.0);
}
