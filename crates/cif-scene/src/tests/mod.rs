use cif_field::{Field, Gaussians, Identities, Instance, SortMetric, Timeline};
use cif_geometry::RigidTransform;
use glam::{DMat3, DQuat, DVec3};

use super::*;

const FRAMES: usize = 9;

fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}

/// `objects` clouds of 60 Gaussians in a row along x, each its own instance, occupancy 0.9; plus 40
/// background Gaussians with the occupancy of the start and stray identities.
fn field(objects: usize) -> Field {
    let mut gaussians = Gaussians::default();
    let mut identities = Identities::default();
    let steps = DVec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5);
    let mut push = |centre: DVec3, spread: f64, k: usize, occupancy: f32, owner: usize| {
        let at = centre + ((steps * (k + 1) as f64).fract() - 0.5) * spread;
        gaussians.means.push(at.to_array().map(|v| v as f32));
        gaussians.log_scales.push([-5.0, -4.5, -4.0]);
        gaussians.quaternions.push([1.0, 0.1 * k as f32, -0.2, 0.3]);
        gaussians.opacity_logits.push(logit(0.8));
        gaussians.occupancy_logits.push(logit(occupancy));
        gaussians.sh_coefficients.push([0.25; 48]);
        identities.labels.push(owner as u16);
        // What belongs to nothing was hardly seen inside masks.
        identities.log_estimates.push(if occupancy < 0.05 { 0.05_f32.ln() } else { 0.0 });
        identities.log_calibrations.push(0.0);
        identities.row_offsets.push(identities.labels.len() as u32);
    };
    for object in 0..objects {
        for k in 0..60 {
            push(DVec3::X * object as f64, 0.4, k, 0.9, object);
        }
    }
    for k in 0..40 {
        push(DVec3::new(0.0, 3.0, 0.0), 2.0, k, 0.02, 0);
    }
    Field {
        gaussians,
        deformation: None,
        tracks: None,
        identities: Some(identities),
        instances: (0..objects)
            .map(|k| Instance {
                id: k as u16 + 1,
                label: "red mug".into(),
                category: "mug".into(),
                taxonomies: Default::default(),
            })
            .collect(),
        timeline: Timeline {
            times: (0..FRAMES).map(|k| k as f64 / (FRAMES - 1) as f64).collect(),
            frames_per_second: 24.0,
        },
        cameras: Vec::new(),
        sh_degree: 2,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

fn pose(time: f64) -> RigidTransform {
    RigidTransform {
        rotation: DMat3::from_axis_angle(DVec3::new(0.2, 1.0, -0.4).normalize(), 4.0 * time),
        translation: DVec3::new(time, 0.5 * time * time, -0.3 * time),
    }
}

/// Moves rows of a field.
fn moved(field: &Field, rows: std::ops::Range<usize>, by: &RigidTransform) -> Gaussians {
    let mut gaussians = field.gaussians.clone();
    let turn = vectors::quaternion_of(&by.rotation).map(|v| v as f32);
    for row in rows {
        let at = by.apply(vectors::vector(gaussians.means[row]));
        gaussians.means[row] = at.to_array().map(|v| v as f32);
        gaussians.quaternions[row] = cif_geometry::quaternion::multiply(turn, gaussians.quaternions[row]);
    }
    gaussians
}

fn pseudo_noise(row: usize, time: f64, axis: usize) -> f32 {
    (((row * 7919 + axis * 104_729) as f64 * 0.618 + time * 977.0).fract() - 0.5) as f32
}

#[test]
fn a_rigid_instance_gets_its_track() {
    let field = field(2);
    let mut source = |time: f64| moved(&field, 60..120, &pose(time));
    let all_samples = SceneOptions { reduce_keys: false, ..SceneOptions::default() };
    let graph = build_from(&field, &mut source, &all_samples).unwrap();
    let models: Vec<_> = graph.nodes.iter().map(|node| (node.name.as_str(), node.model())).collect();
    assert_eq!(
        models,
        [
            ("red_mug_001", MotionModel::Static),
            ("red_mug_002", MotionModel::Rigid),
            ("background", MotionModel::Static)
        ]
    );
    let node = &graph.nodes[1];
    for (frame, time) in graph.time_codes.times.iter().enumerate() {
        let expected = pose(*time).compose(&RigidTransform { translation: node.pivot, ..pose(0.0) });
        let found = node.world_transform(frame as f64);
        assert!((found.translation - expected.translation).length() < 1e-6, "frame {frame}");
        let turn = DQuat::from_mat3(&found.rotation).angle_between(DQuat::from_mat3(&expected.rotation));
        assert!(turn < 1e-5, "frame {frame}: {turn}");
    }
    assert!(node.report.residual.max < 1e-6 && node.report.residual.orientation_rms_degrees < 0.1);
    assert!(node.report.static_residual.rms > 0.1);
    let track = node.track();
    assert!(track.windows(2).all(|pair| pair[0].rotation.dot(pair[1].rotation) > 0.0), "one hemisphere");
    let halfway = node.world_transform(0.5).translation;
    assert!((halfway - track[0].translation.lerp(track[1].translation, 0.5)).length() < 1e-12);
}

#[test]
fn stragglers_do_not_spoil_a_rigid_instance() {
    let field = field(1);
    let mut source = |time: f64| {
        let mut gaussians = moved(&field, 0..60, &pose(time));
        gaussians.means[7] = field.gaussians.means[7];
        gaussians.means[31][2] += 5.0 * time as f32;
        gaussians
    };
    let graph = build_from(&field, &mut source, &SceneOptions::default()).unwrap();
    assert_eq!(graph.nodes[0].model(), MotionModel::Rigid);
    let report = &graph.nodes[0].report;
    assert!(report.residual.decisive < 1e-3 && report.residual.max > 1.0, "{report:?}");
    assert!(report.residual.outlier_share > 0.02 && report.residual.outlier_share < 0.05, "{report:?}");
    let found = graph.nodes[0].world_transform(8.0).translation;
    assert!((found - pose(1.0).apply(graph.nodes[0].pivot)).length() < 1e-3);
}

#[test]
fn what_passes_over_an_instance_at_rest_leaves_with_the_moving_background() {
    let field = field(1);
    let passing = |rows: std::ops::Range<usize>, far: f32| {
        let field = &field;
        move |time: f64| {
            let mut gaussians = field.gaussians.clone();
            rows.clone().for_each(|row| gaussians.means[row][2] += far * time as f32);
            gaussians
        }
    };
    let nodes = |mut source: &dyn Fn(f64) -> Gaussians,
                 options: &SceneOptions|
     -> Vec<(String, MotionModel, usize)> {
        let graph = build_from(&field, &mut source, options).unwrap();
        graph.nodes.iter().map(|node| (node.name.clone(), node.model(), node.splats.len())).collect()
    };
    let node = |name: &str, model: MotionModel, splats: usize| (name.to_owned(), model, splats);
    let at_most = |model| SceneOptions { most_expensive_motion: model, ..SceneOptions::default() };
    let (defaults, parts, rigid) =
        (SceneOptions::default(), at_most(MotionModel::Parts), at_most(MotionModel::Rigid));
    let whole = node("red_mug_001", MotionModel::Static, 60);
    // A shadow of two splats, which moves as it was trained.
    let shadow = nodes(&passing(10..12, 3.0), &defaults);
    assert!(shadow.contains(&node("red_mug_001", MotionModel::Static, 58)), "{shadow:?}");
    assert!(shadow.contains(&node("background_moving", MotionModel::Dense, 2)), "{shadow:?}");
    // A few may each have a path of their own even where nothing else may: grown, and turned, as they were trained.
    let apart = |time: f64| {
        let mut gaussians = field.gaussians.clone();
        gaussians.means[10][2] += 3.0 * time as f32;
        gaussians.means[11][0] += 4.0 * time as f32;
        gaussians.means[12][1] -= 5.0 * (time * (1.0 - time)) as f32;
        gaussians.log_scales[12][1] += time as f32;
        gaussians
    };
    let graph = build_from(&field, &mut { apart }, &parts).unwrap();
    let shadow = graph.nodes.iter().find(|node| node.name == "background_moving").unwrap();
    assert_eq!((shadow.model(), shadow.splats.len()), (MotionModel::Dense, 3));
    assert!(shadow.report.residual.max < 1e-6, "{:?}", shadow.report.residual);
    // No more than trembles, or where nothing but bodies may move, they stay with the instance.
    let trembling = nodes(&passing(10..12, 0.01), &defaults);
    assert!(trembling.contains(&whole), "{trembling:?}");
    let frozen = nodes(&passing(10..12, 3.0), &rigid);
    assert!(frozen.contains(&whole), "{frozen:?}");
    // So many are a part that moves.
    let part = nodes(&passing(10..30, 3.0), &defaults);
    assert!(part.iter().all(|(name, _, splats)| name != "red_mug_001" || *splats == 60), "{part:?}");
}

#[test]
fn noise_inside_the_tolerance_is_static_and_averaged() {
    let field = field(1);
    let mut source = |time: f64| {
        let mut gaussians = field.gaussians.clone();
        for row in 0..60 {
            for axis in 0..3 {
                gaussians.means[row][axis] += 0.004 * pseudo_noise(row, time, axis);
            }
        }
        gaussians
    };
    let loose = SceneOptions { tolerance: Tolerance::Percent(1.0), ..SceneOptions::default() };
    let graph = build_from(&field, &mut source, &loose).unwrap();
    assert_eq!(graph.nodes[0].model(), MotionModel::Static);
    let strict = SceneOptions { tolerance: Tolerance::Absolute(1e-4), ..SceneOptions::default() };
    let graph = build_from(&field, &mut source, &strict).unwrap();
    assert_eq!(graph.nodes[0].model(), MotionModel::Dense);
    let limited = SceneOptions { most_expensive_motion: MotionModel::Rigid, ..strict };
    let graph = build_from(&field, &mut source, &limited).unwrap();
    assert_eq!(graph.nodes[0].model(), MotionModel::Rigid);
    assert!(graph.nodes[0].report.residual.decisive > 1e-4, "the loss is reported");
}

#[test]
fn bending_is_dense_and_reproduces_the_trained_splats() {
    let field = field(1);
    let bend = |time: f64| {
        let mut gaussians = moved(&field, 0..60, &pose(time));
        for row in 0..60 {
            gaussians.means[row][2] += (time as f32) * 4.0 * field.gaussians.means[row][0].powi(2);
            gaussians.log_scales[row][0] += 0.2 * time as f32;
        }
        gaussians
    };
    let options = SceneOptions { reduce_keys: false, max_parts: 2, ..SceneOptions::default() };
    let graph = build_from(&field, &mut { bend }, &options).unwrap();
    let node = &graph.nodes[0];
    let Motion::Dense(dense) = &node.motion else { panic!("{:?}", node.report) };
    assert_eq!((dense.samples.len(), dense.track.len()), (FRAMES, FRAMES));
    for (sample, time) in dense.samples.iter().zip(&graph.time_codes.times) {
        let expected = bend(*time);
        let world_from_local = node.world_transform(sample.time_code);
        for (k, &row) in node.splats.rows.iter().enumerate() {
            let at = world_from_local.apply(vectors::vector(sample.means[k]));
            assert!((at - vectors::vector(expected.means[row as usize])).length() < 1e-5);
        }
        assert!(sample.scales.is_some(), "scales change");
        let again = crate::shape::extent::ellipsoid_bounds(
            &RigidTransform::IDENTITY,
            &sample.means,
            &sample.orientations,
            sample.scales.as_ref().unwrap(),
        );
        assert_eq!(again, sample.extent);
    }
    assert_eq!(node.splats.means, dense.samples[0].means, "defaults are the first sample");
}

#[test]
fn what_the_masks_never_spoke_for_is_background() {
    let mut field = field(2);
    // Inside the first object and never seen: enclosed. Without neighbours of its instance: background.
    field.gaussians.means[5] = [0.0, 0.0, 0.0];
    field.gaussians.occupancy_logits[5] = logit(0.02);
    field.gaussians.occupancy_logits[50] = logit(0.02);
    field.gaussians.means[50] = [0.0, 3.1, 0.0];
    let massive = SceneOptions { background_threshold: 0.05, ..SceneOptions::default() };
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &massive).unwrap();
    let counts: Vec<_> = graph.nodes.iter().map(|node| node.splats.len()).collect();
    assert_eq!(counts, [59, 60, 41]);
    assert!(graph.nodes[0].splats.rows.contains(&5));
    assert_eq!(graph.nodes[2].kind, NodeKind::Background);
    // Faint occupancy alone leaves nothing behind: what the masks show of a Gaussian decides.
    let all = SceneOptions::default();
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &all).unwrap();
    let counts: Vec<_> = graph.nodes.iter().map(|node| node.splats.len()).collect();
    assert_eq!(counts, [60, 60, 40]);

    field.identities = None;
    field.instances.clear();
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &all).unwrap();
    assert_eq!(graph.nodes.len(), 1);
    assert_eq!(graph.nodes[0].name, "background");
}

#[test]
fn a_gaussian_mostly_seen_outside_masks_is_background() {
    let mut field = field(1);
    field.identities.as_mut().unwrap().log_estimates[3] = 0.2_f32.ln();
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    assert!(!graph.nodes[0].splats.rows.contains(&3));
}

#[test]
fn an_object_narrower_than_its_gaussians_keeps_the_best_of_them() {
    let mut field = field(1);
    let rows = field.identities.as_mut().unwrap();
    let entries = rows.log_estimates.len();
    rows.log_estimates.fill(0.25_f32.ln());
    rows.log_estimates[0] = 0.4_f32.ln();
    rows.log_estimates[1] = 0.35_f32.ln();
    assert!(entries > 2);
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    let owned = &graph.nodes[0].splats.rows;
    assert!(owned.contains(&0) && owned.contains(&1), "{owned:?}");
    // Where even the best was hardly seen in a mask, nothing is.
    field.identities.as_mut().unwrap().log_estimates.fill(0.01_f32.ln());
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    assert_eq!(graph.nodes.len(), 1);
    assert_eq!(graph.nodes[0].kind, NodeKind::Background);
}

#[test]
fn untrained_occupancy_falls_back_to_opacity() {
    let mut field = field(1);
    field.gaussians.occupancy_logits.fill(logit(0.02));
    let massive = SceneOptions { background_threshold: 0.05, ..SceneOptions::default() };
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &massive).unwrap();
    assert_eq!(graph.nodes[0].splats.len(), 60);
}

#[test]
fn unusable_gaussians_are_left_out_and_reported() {
    let mut field = field(1);
    field.gaussians.means[0][1] = f32::NAN;
    field.gaussians.log_scales[1][0] = f32::NAN;
    field.gaussians.quaternions[2] = [0.0; 4];
    field.gaussians.opacity_logits[3] = -20.0;
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    assert_eq!(graph.nodes[0].splats.len(), 56);
    assert!(graph.warnings.iter().any(|warning| warning.starts_with("3 Gaussians")), "{:?}", graph.warnings);
    field.record.unknown = Some("the capture does not know the metre".to_owned());
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    assert_eq!(graph.warnings[0], "the capture does not know the metre");
    field.gaussians.opacity_logits.fill(-20.0);
    let error = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap_err();
    assert!(matches!(error, SceneError::NoGaussians { invalid: 3, invisible: 97, .. }), "{error}");
}

#[test]
fn damaged_fields_are_refused() {
    let good = field(1);
    let mut broken = Vec::new();
    let mut damage = |change: &dyn Fn(&mut Field)| {
        let mut field = good.clone();
        change(&mut field);
        broken.push(field);
    };
    damage(&|field| field.gaussians.log_scales.truncate(3));
    damage(&|field| field.instances.clear());
    damage(&|field| field.timeline.times.clear());
    damage(&|field| field.timeline.times.reverse());
    damage(&|field| field.sh_degree = 4);
    damage(&|field| field.identities = field.identities.as_ref().map(|rows| rows.gather(&[0])));
    for field in broken {
        let error = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default());
        assert!(matches!(error, Err(SceneError::Inconsistent { .. })), "{error:?}");
    }
}

#[test]
fn instances_without_gaussians_are_named() {
    let mut field = field(1);
    field.instances.push(Instance {
        id: 9,
        label: "ghost".into(),
        category: "ghost".into(),
        taxonomies: Default::default(),
    });
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    assert_eq!(graph.omitted, ["ghost"]);
    assert_eq!(graph.nodes.len(), 2);
    // Gaussians that are too faint are counted.
    field.identities.as_mut().unwrap().labels[0..3].fill(1);
    field.gaussians.opacity_logits[0..3].fill(-20.0);
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    assert!(
        graph
            .warnings
            .contains(&"no visible Gaussian belongs to: ghost (3 are too faint to be drawn)".into())
    );
}

#[test]
fn frames_are_captured_numbers() {
    let field = field(1);
    let options = SceneOptions {
        frames: Some(FrameRange { first: 2, last: 7 }),
        frame_step: 3,
        ..SceneOptions::default()
    };
    let mut asked = Vec::new();
    let mut source = |time: f64| {
        asked.push(time);
        moved(&field, 0..60, &pose(time))
    };
    let graph = build_from(&field, &mut source, &options).unwrap();
    assert_eq!(graph.time_codes.samples, [2.0, 5.0, 7.0]);
    assert!(asked.contains(&0.25) && !asked.contains(&0.0));
    assert_eq!(graph.nodes[0].source_frames, (2, 7));
    assert_eq!(graph.nodes[0].track().len(), 3);
    let beyond = SceneOptions { frames: Some(FrameRange { first: 9, last: 12 }), ..SceneOptions::default() };
    assert!(build_from(&field, &mut |_| field.gaussians.clone(), &beyond).is_err());
}

#[test]
fn splats_hold_the_degree_in_use_and_extents_hold_the_splats() {
    let field = field(1);
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    let node = &graph.nodes[0];
    assert_eq!(node.splats.sh_coefficients.len(), 60 * 9 * 3);
    for (mean, scale) in node.splats.means.iter().zip(&node.splats.scales) {
        let at = vectors::vector(*mean);
        let reach = f64::from(3.0 * scale.iter().copied().fold(f32::INFINITY, f32::min)) * 0.999;
        assert!((at - reach).cmpge(node.extent.low).all() && (at + reach).cmple(node.extent.high).all());
    }
    assert!(node.splats.means.iter().all(|mean| mean.iter().all(|v| v.abs() < 0.3)), "local frame");
}

#[test]
fn bands_of_zeros_are_not_written_and_what_stands_still_has_no_samples() {
    let mut field = crate::testing::learned_field(3, 8);
    field.sh_degree = 3;
    let members = field.members(1);
    for (row, coefficients) in field.gaussians.sh_coefficients.iter_mut().enumerate() {
        let used = if members.contains(&(row as u32)) { 12 } else { 3 };
        coefficients[..used].fill(0.2);
        coefficients[used..].fill(0.0);
    }
    // The network moves the second object only.
    let n = field.len();
    let still: Vec<bool> = (0..n as u32).map(|row| !members.contains(&row)).collect();
    field.deformation.as_mut().unwrap().still = still;
    let graph = build(&field, &SceneOptions::default()).unwrap();
    let mut found = 0;
    for node in &graph.nodes {
        let moves = !matches!(node.motion, Motion::Static);
        let is_second = node.splats.rows.iter().all(|row| members.contains(row));
        assert_eq!(moves, is_second, "{}", node.name);
        assert_eq!(node.splats.sh_degree, u8::from(is_second), "{}", node.name);
        let floats = if is_second { 12 } else { 3 };
        assert_eq!(node.splats.sh_coefficients.len(), floats * node.splats.rows.len());
        found += usize::from(is_second);
    }
    assert_eq!(found, 1);
}

#[test]
fn labels_are_found_by_any_case_and_by_wildcards() {
    let field = field(2);
    let graph = build_from(&field, &mut |time| moved(&field, 60..120, &pose(time)), &SceneOptions::default());
    let graph = graph.unwrap();
    let ask = |pattern: &str, time_code| {
        query(&graph, &LabelQuery { pattern: pattern.into(), time_code }, "scene.cif")
    };
    assert_eq!(ask("RED mug", None).unwrap().len(), 2);
    assert_eq!(ask("red_mug_00?", None).unwrap()[1].instance, "red_mug_002");
    assert_eq!(ask("mug", None).unwrap()[0].path, "/World/red_mug_001");
    let later = ask("*_002", Some(8.0)).unwrap();
    let expected = graph.nodes[1].world_transform(8.0).translation;
    assert_eq!([0, 1, 2].map(|row| later[0].transform[row][3]), expected.to_array());
    let error = ask("teapot", None).unwrap_err().to_string();
    assert!(error.contains("teapot") && error.contains("scene.cif") && error.contains("red mug"), "{error}");
    let error = ask("red_mug_00[2]", None).unwrap_err().to_string();
    assert!(
        error.contains("no object is labelled 'red_mug_00[2]'"),
        "brackets stand for themselves: {error}"
    );
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let field = field(3);
    let run = |threads| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            build_from(&field, &mut |time| moved(&field, 60..180, &pose(time)), &SceneOptions::default())
                .unwrap()
        })
    };
    assert_eq!(run(1), run(4));
}

mod motion_models;
mod nodes;
