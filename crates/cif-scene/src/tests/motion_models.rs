//! Motion models of whole scenes: parts, reduced keys, and what neither may break.

use proptest::prelude::*;

use super::*;

/// Turns rows about a hinge.
fn hinged(axis: DVec3, hinge: DVec3, angle: f64) -> RigidTransform {
    let rotation = DMat3::from_axis_angle(axis, angle);
    RigidTransform { rotation, translation: hinge - rotation * hinge }
}

/// One object of three bodies: a base that follows `base`, a lid on a hinge, and a drawer that slides out.
fn cabinet(field: &Field, base: impl Fn(f64) -> RigidTransform) -> impl Fn(f64) -> Gaussians {
    let field = field.clone();
    move |time| {
        let base = base(time);
        let lid = base.compose(&hinged(DVec3::X, DVec3::new(0.0, 0.2, 0.2), -1.5 * time));
        let drawer = base.compose(&RigidTransform {
            translation: DVec3::Y * -0.3 * (3.0 * time).sin(),
            ..RigidTransform::IDENTITY
        });
        let mut gaussians = field.gaussians.clone();
        for row in 0..60 {
            let pose = [base, lid, drawer][body(row)];
            let moved = super::moved(&field, row..row + 1, &pose);
            gaussians.means[row] = moved.means[row];
            gaussians.quaternions[row] = moved.quaternions[row];
        }
        gaussians
    }
}

/// The first 30 Gaussians are the base, then 18 of the lid, then 12 of the drawer.
fn body(row: usize) -> usize {
    match row {
        0..30 => 0,
        30..48 => 1,
        _ => 2,
    }
}

/// An object whose bodies lie apart: lid on top, drawer in front.
fn cabinet_field() -> Field {
    let mut field = field(1);
    for row in 0..60 {
        let shift = [DVec3::ZERO, DVec3::Z * 0.45, DVec3::Y * -0.45][body(row)];
        let at = vectors::vector(field.gaussians.means[row]) + shift;
        field.gaussians.means[row] = at.to_array().map(|v| v as f32);
    }
    field
}

fn assert_consistent(graph: &SceneGraph) {
    for node in &graph.nodes {
        let count = node.splats.len();
        assert_eq!(
            [node.splats.orientations.len(), node.splats.scales.len(), node.splats.rows.len()],
            [count; 3]
        );
        assert!(node.splats.means.iter().flatten().all(|value| value.is_finite()), "{}", node.name);
        let finite = |track: &[PoseSample]| {
            track.iter().all(|s| s.translation.is_finite() && s.rotation.is_normalized())
                && track.windows(2).all(|pair| {
                    pair[0].time_code < pair[1].time_code && pair[0].rotation.dot(pair[1].rotation) >= 0.0
                })
        };
        assert!(finite(node.track()), "{}", node.name);
        if let Motion::Parts(motion) = &node.motion {
            assert!(motion.parts.len() >= 2);
            let mut next = 0;
            for part in &motion.parts {
                assert_eq!(part.splats.start, next, "parts partition the splats in order");
                assert!(part.splats.end > next && finite(&part.track), "{}", part.name);
                next = part.splats.end;
            }
            assert_eq!(next, count);
            assert_eq!(node.report.parts, motion.parts.len());
        }
    }
}

/// Largest trimmed RMS distance of a node's splats from the source, over the sampled times.
fn decisive(graph: &SceneGraph, node: &Node, source: &dyn Fn(f64) -> Gaussians) -> f64 {
    let codes = graph.time_codes.samples.iter().zip(&graph.time_codes.times);
    codes
        .map(|(&code, &time)| {
            let trained = source(time);
            let distances: Vec<f64> = node
                .splats_at(code)
                .means
                .iter()
                .zip(&node.splats.rows)
                .map(|(mean, &row)| mean.distance(vectors::vector(trained.means[row as usize])))
                .collect();
            motion::residuals::trimmed_rms(&distances, &vec![1.0; distances.len()], 0.05).0
        })
        .fold(0.0, f64::max)
}

#[test]
fn articulated_bodies_become_their_parts() {
    let field = cabinet_field();
    let source = cabinet(&field, pose);
    let graph = build_from(&field, &mut { &source }, &SceneOptions::default()).unwrap();
    assert_consistent(&graph);
    let node = &graph.nodes[0];
    let Motion::Parts(motion) = &node.motion else { panic!("{:?}", node.report) };
    let bodies: Vec<Vec<usize>> = motion
        .parts
        .iter()
        .map(|part| {
            let mut bodies: Vec<usize> =
                node.splats.rows[part.splats.clone()].iter().map(|&row| body(row as usize)).collect();
            bodies.dedup();
            bodies
        })
        .collect();
    assert_eq!(bodies, [[0], [1], [2]], "one body each, largest first");
    assert!(node.report.residual.decisive <= node.report.tolerance, "{:?}", node.report);
    assert!(decisive(&graph, node, &source) <= node.report.tolerance);
    assert!(node.report.rigid_residual.unwrap().decisive > 5.0 * node.report.tolerance);
    // The node carries the base, so that the base needs no track of its own.
    assert!(motion.parts[0].track.is_empty() && !motion.parts[1].track.is_empty(), "{motion:?}");
    assert!(node.report.residual.orientation_rms_degrees < 1.0);
    let names: Vec<&str> = motion.parts.iter().map(|part| part.name.as_str()).collect();
    assert_eq!(names, ["part_00", "part_01", "part_02"]);
    // Every part has its hull, in its own frame.
    assert_eq!(node.colliders.iter().map(|hull| hull.part).collect::<Vec<_>>(), [Some(0), Some(1), Some(2)]);
    assert!(node.boxes().world(8.0).size().min_element() > 0.0);
}

#[test]
fn a_standing_base_needs_no_samples_at_all() {
    let field = cabinet_field();
    let source = cabinet(&field, |_| RigidTransform::IDENTITY);
    let graph = build_from(&field, &mut { &source }, &SceneOptions::default()).unwrap();
    let Motion::Parts(motion) = &graph.nodes[0].motion else { panic!("{:?}", graph.nodes[0].report) };
    assert!(motion.parts.len() == 3 && motion.track.is_empty() && motion.parts[0].track.is_empty());
    let full = SceneOptions { reduce_keys: false, ..SceneOptions::default() };
    let all = build_from(&field, &mut { &source }, &full).unwrap();
    assert!(graph.nodes[0].report.samples < all.nodes[0].report.samples);
    assert!(all.nodes[0].report.residual.decisive < 1e-5);
}

#[test]
fn without_dense_motion_the_best_parts_leave_and_the_loss_is_reported() {
    let field = field(1);
    let source = |time: f64| {
        let mut gaussians = moved(&field, 0..60, &pose(time));
        for row in 0..60 {
            gaussians.means[row][2] += (time as f32) * 6.0 * field.gaussians.means[row][0].powi(2);
        }
        gaussians
    };
    let with = |most_expensive_motion, max_parts| {
        let tolerance = Tolerance::Percent(0.2);
        let options = SceneOptions { most_expensive_motion, max_parts, tolerance, ..SceneOptions::default() };
        let graph = build_from(&field, &mut { source }, &options).unwrap();
        assert_consistent(&graph);
        let node = &graph.nodes[0];
        let found = decisive(&graph, node, &source);
        let reported = node.report.residual.decisive;
        assert!((found - reported).abs() < 0.1 * reported + 1e-6, "{found} {:?}", node.report);
        (node.model(), node.report.residual.decisive, node.report.tolerance)
    };
    let rigid = with(MotionModel::Rigid, 8);
    let two = with(MotionModel::Parts, 2);
    let eight = with(MotionModel::Parts, 8);
    let dense = with(MotionModel::Dense, 8);
    assert_eq!([rigid.0, two.0, eight.0], [MotionModel::Rigid, MotionModel::Parts, MotionModel::Parts]);
    assert_eq!(dense.0, MotionModel::Dense);
    assert!(two.1 < 0.8 * rigid.1 && eight.1 < 0.7 * two.1, "{rigid:?} {two:?} {eight:?}");
    assert!(eight.1 > eight.2, "the loss is reported");
    assert!(dense.1 <= dense.2, "{dense:?}");
}

#[test]
fn parts_that_hardly_move_rest_where_the_model_misses_the_tolerance() {
    // The base drifts by `drift` in all; lid and drawer bend, so that no rigid part follows them inside the tolerance.
    let field = cabinet_field();
    let source = |drift: f64| {
        let base = move |time: f64| RigidTransform {
            translation: DVec3::new(drift * time, 0.0, 0.0),
            ..RigidTransform::IDENTITY
        };
        let cabinet = cabinet(&field, base);
        let field = &field;
        move |time: f64| {
            let mut gaussians = cabinet(time);
            for row in 30..60 {
                gaussians.means[row][2] += (time as f32) * 6.0 * field.gaussians.means[row][0].powi(2);
            }
            gaussians
        }
    };
    let parts_of = |drift: f64| {
        let source = source(drift);
        let options = SceneOptions {
            most_expensive_motion: MotionModel::Parts,
            max_parts: 3,
            ..SceneOptions::default()
        };
        let graph = build_from(&field, &mut { &source }, &options).unwrap();
        assert_consistent(&graph);
        let node = &graph.nodes[0];
        assert!(node.report.residual.decisive > node.report.tolerance, "{:?}", node.report);
        let found = decisive(&graph, node, &source);
        assert!(
            (found - node.report.residual.decisive).abs() < 0.1 * found,
            "the error of standing still is reported"
        );
        let Motion::Parts(motion) = &node.motion else { panic!("{:?}", node.report) };
        for part in &motion.parts {
            let still = part.track.iter().all(|pose| {
                (pose.translation - part.pivot).length() < 1e-9 && pose.rotation.xyz().length() < 1e-9
            });
            assert!(part.track.is_empty() || !still, "{} has keys, but does not move", part.name);
        }
        (
            motion.track.len(),
            motion.parts[0].track.len(),
            node.report.residual.decisive,
            node.report.tolerance,
        )
    };
    let (track, leader, still, tolerance) = parts_of(0.0);
    assert_eq!((track, leader), (0, 0));
    let (track, leader, resting, _) = parts_of(0.3 * tolerance);
    assert_eq!((track, leader), (0, 0), "less than the model misses shows nothing");
    assert!(resting < still + 0.5 * tolerance, "{resting} {still}");
    let (track, leader, ..) = parts_of(5.0 * tolerance);
    assert!(track >= 2 && leader == 0, "{track}");
}

#[test]
fn rigid_keys_are_few_and_inside_the_tolerance() {
    let field = field(1);
    let source = |time: f64| moved(&field, 0..60, &pose(time * 0.3));
    let full = SceneOptions { reduce_keys: false, ..SceneOptions::default() };
    let all = build_from(&field, &mut { source }, &full).unwrap();
    assert_eq!(all.nodes[0].track().len(), FRAMES);
    let mut previous = FRAMES + 1;
    for percent in [0.01, 0.3, 1.0, 5.0] {
        let tolerance = Tolerance::Percent(percent);
        let options = SceneOptions { tolerance, ..SceneOptions::default() };
        let graph = build_from(&field, &mut { source }, &options).unwrap();
        let node = &graph.nodes[0];
        assert_eq!(node.model(), MotionModel::Rigid);
        let track = node.track();
        assert!(track.len() <= previous && track.len() >= 2, "{percent}: {}", track.len());
        assert_eq!((track[0].time_code, track[track.len() - 1].time_code), (0.0, 8.0));
        let found = decisive(&graph, node, &source);
        assert!(found <= node.report.tolerance, "{percent}: {found} {:?}", node.report);
        let reported = node.report.residual.decisive;
        assert!((found - reported).abs() < 0.1 * reported + 1e-6, "{found} {reported}");
        previous = track.len();
    }
    assert!(previous < FRAMES);
}

#[test]
fn dense_samples_are_few_and_inside_the_tolerance() {
    let field = field(1);
    // Fast at first, slow later: later samples may go.
    let source = |time: f64| {
        let mut gaussians = field.gaussians.clone();
        for row in 0..60 {
            let amount = if time < 0.5 { (20.0 * time).sin() } else { (10.0_f64).sin() };
            gaussians.means[row][2] += amount as f32 * 4.0 * field.gaussians.means[row][0].powi(2);
        }
        gaussians
    };
    let options = SceneOptions { max_parts: 2, ..SceneOptions::default() };
    let graph = build_from(&field, &mut { source }, &options).unwrap();
    let node = &graph.nodes[0];
    let Motion::Dense(dense) = &node.motion else { panic!("{:?}", node.report) };
    assert!((3..FRAMES).contains(&dense.samples.len()), "{}", dense.samples.len());
    assert_eq!((dense.samples[0].time_code, dense.samples[dense.samples.len() - 1].time_code), (0.0, 8.0));
    let found = decisive(&graph, node, &source);
    assert!(found <= node.report.tolerance && found > 0.0, "{found} {:?}", node.report);
    let between = node.boxes().world(6.5).size();
    assert!((between - node.boxes().world(8.0).size()).length() < 0.05, "{between}");
}

#[test]
fn parts_do_not_depend_on_the_number_of_threads() {
    let field = cabinet_field();
    let source = cabinet(&field, pose);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| build_from(&field, &mut { &source }, &SceneOptions::default()).unwrap())
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn values_that_are_not_finite_at_one_time_do_no_harm() {
    let field = cabinet_field();
    let source = cabinet(&field, pose);
    let poisoned = |time: f64| {
        let mut gaussians = source(time);
        if time > 0.3 && time < 0.6 {
            gaussians.means[3] = [f32::NAN; 3];
            gaussians.quaternions[40] = [f32::INFINITY, 0.0, 0.0, 0.0];
            gaussians.log_scales[50] = [f32::NAN; 3];
        }
        gaussians
    };
    for limit in [MotionModel::Rigid, MotionModel::Parts, MotionModel::Dense] {
        let options = SceneOptions { most_expensive_motion: limit, ..SceneOptions::default() };
        let graph = build_from(&field, &mut { &poisoned }, &options).unwrap();
        assert_consistent(&graph);
        assert!(graph.nodes[0].report.residual.max.is_finite());
        if limit == MotionModel::Parts {
            assert_eq!(graph.nodes[0].model(), MotionModel::Parts);
        }
    }
}

#[test]
fn few_coincident_and_collinear_gaussians_are_fitted() {
    for count in [1_usize, 2, 3, 5, 9] {
        for shape in 0..3 {
            let mut field = field(1);
            let keep: Vec<u32> = (0..count as u32).collect();
            field.gaussians = field.gaussians.gather(&keep);
            field.identities = field.identities.as_ref().map(|rows| rows.gather(&keep));
            for row in 0..count {
                field.gaussians.means[row] = match shape {
                    0 => field.gaussians.means[row],
                    1 => [0.5; 3],
                    _ => [0.1 * row as f32, 0.2 * row as f32, 0.0],
                };
            }
            let source = |time: f64| {
                let mut gaussians = field.gaussians.clone();
                for row in 0..count {
                    let phase = row as f64 * 2.4;
                    gaussians.means[row][0] += (6.0 * time + phase).sin() as f32 - phase.sin() as f32;
                    gaussians.means[row][2] += time as f32 * row as f32;
                }
                gaussians
            };
            for limit in [MotionModel::Rigid, MotionModel::Parts, MotionModel::Dense] {
                let tolerance = Tolerance::Absolute(0.01);
                let options =
                    SceneOptions { most_expensive_motion: limit, tolerance, ..SceneOptions::default() };
                let graph = build_from(&field, &mut { source }, &options).unwrap();
                assert_consistent(&graph);
                let report = &graph.nodes[0].report;
                assert!(report.residual.max.is_finite(), "{count} {shape} {limit}");
                if limit == MotionModel::Dense {
                    assert!(report.residual.decisive <= 0.01 + 1e-6, "{count} {shape} {report:?}");
                }
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// Whatever moves how, the exported scene is inside the tolerance when dense motion is allowed.
    #[test]
    fn the_bound_holds_for_random_motion(
        walk in prop::collection::vec(prop::array::uniform6(-0.2_f64..0.2), FRAMES),
        wobble in 0.0_f64..0.05,
        articulated in any::<bool>(),
        percent in 0.1_f64..5.0,
    ) {
        let field = cabinet_field();
        let source = |time: f64| {
            let step = (time * (FRAMES - 1) as f64).round() as usize;
            let base = walk[..=step].iter().fold(RigidTransform::IDENTITY, |pose, s| {
                let rotation = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(s[0], s[1], s[2])));
                RigidTransform { rotation, translation: DVec3::new(s[3], s[4], s[5]) }.compose(&pose)
            });
            let mut gaussians = if articulated {
                cabinet(&field, |_| base)(time)
            } else {
                moved(&field, 0..60, &base)
            };
            for row in 0..60 {
                for axis in 0..3 {
                    gaussians.means[row][axis] += wobble as f32 * pseudo_noise(row, time, axis);
                }
            }
            gaussians
        };
        let options = SceneOptions { tolerance: Tolerance::Percent(percent), ..SceneOptions::default() };
        let graph = build_from(&field, &mut { source }, &options).unwrap();
        assert_consistent(&graph);
        for node in &graph.nodes {
            let report = &node.report;
            prop_assert!(report.residual.decisive <= report.tolerance * (1.0 + 1e-4) + 1e-6, "{:?}", report);
            let found = decisive(&graph, node, &source);
            prop_assert!((found - report.residual.decisive).abs() < 0.2 * report.tolerance + 1e-6);
        }
    }
}
