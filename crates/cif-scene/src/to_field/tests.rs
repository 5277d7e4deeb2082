use cif_field::tracks::{Joint, TrackGroup};
use cif_field::{Exposure, JointKind, TimedExposure};
use cif_geometry::spherical_harmonics::HarmonicsRotation;
use cif_geometry::{Bounds, RigidTransform};
use glam::{DQuat, DVec3};

use super::*;
use crate::graph::{DenseMotion, Motion, Node, PoseSample, pose_at};
use crate::testing::{MEMBERS, TIMES, recorded_field};
use crate::vectors::rows_of;
use crate::{MotionModel, SceneOptions, Tolerance, build};

fn options() -> SceneOptions {
    SceneOptions { tolerance: Tolerance::Absolute(1e-4), ..SceneOptions::default() }
}

/// Largest difference of two lists of numbers.
fn off<'a>(a: impl IntoIterator<Item = &'a f32>, b: impl IntoIterator<Item = &'a f32>) -> f32 {
    let (mut a, mut b) = (a.into_iter(), b.into_iter());
    let mut worst = 0.0_f32;
    loop {
        match (a.next(), b.next()) {
            (Some(a), Some(b)) => worst = worst.max((a - b).abs()),
            (None, None) => return worst,
            _ => return f32::INFINITY,
        }
    }
}

fn turned_off(a: &[[f32; 4]], b: &[[f32; 4]]) -> f32 {
    let dots = a.iter().zip(b).map(|(a, b)| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>().abs());
    dots.fold(if a.len() == b.len() { 0.0 } else { f32::INFINITY }, |worst, dot| worst.max(1.0 - dot))
}

#[track_caller]
fn assert_same(a: &SceneGraph, b: &SceneGraph) {
    assert_eq!(a.nodes.len(), b.nodes.len());
    assert_eq!(a.time_codes, b.time_codes);
    assert_eq!(a.cameras, b.cameras);
    assert_eq!((a.background_color, a.sort_metric), (b.background_color, b.sort_metric));
    for (a, b) in a.nodes.iter().zip(&b.nodes) {
        let name = &a.name;
        assert_eq!((&a.kind, name, &a.label, &a.category), (&b.kind, &b.name, &b.label, &b.category));
        assert_eq!((a.model(), &a.visibility), (b.model(), &b.visibility), "{name}");
        assert_eq!(a.splats.len(), b.splats.len(), "{name}");
        let (s, t) = (&a.splats, &b.splats);
        assert!(off(s.means.as_flattened(), t.means.as_flattened()) < 2e-6, "{name}");
        assert!(turned_off(&s.orientations, &t.orientations) < 1e-6, "{name}");
        assert!(off(s.scales.as_flattened(), t.scales.as_flattened()) < 1e-6, "{name}");
        assert!(off(&s.opacities, &t.opacities) < 1e-6, "{name}");
        assert!(off(&s.occupancies, &t.occupancies) < 1e-6, "{name}");
        assert!(off(&s.sh_coefficients, &t.sh_coefficients) < 3e-6, "{name}");
        for code in [0.0, 1.0, 2.5, 4.0, 5.0] {
            let (p, q) = (a.world_transform(code), b.world_transform(code));
            assert!((p.translation - q.translation).length() < 2e-6, "{name} at {code}");
            let turn = p.rotation - q.rotation;
            assert!(turn.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{name} at {code}");
        }
        if let (Motion::Dense(a), Motion::Dense(b)) = (&a.motion, &b.motion) {
            assert_eq!(a.samples.len(), b.samples.len());
            for (a, b) in a.samples.iter().zip(&b.samples) {
                assert_eq!(a.time_code, b.time_code);
                assert!(off(a.means.as_flattened(), b.means.as_flattened()) < 2e-6, "{name}");
                assert!(turned_off(&a.orientations, &b.orientations) < 1e-6, "{name}");
                let (s, t) = (a.scales.as_ref().unwrap(), b.scales.as_ref().unwrap());
                assert!(off(s.as_flattened(), t.as_flattened()) < 1e-6, "{name}");
            }
        }
    }
}

#[test]
fn a_graph_keeps_its_place_in_the_world() {
    let mut field = recorded_field(2, 5);
    let frame = crate::CaptureFrame { offset: [3e6, -2e5, 40.0], scale: 0.01 };
    field.record.frame = frame;
    let graph = build(&field, &options()).unwrap();
    assert_eq!(graph.frame, frame);
    let back = field_from_graph(&graph, "far.usda").unwrap();
    assert_eq!(build(&back, &options()).unwrap().frame, frame);
    // Edits of a file that lies elsewhere are not taken for edits of this scene.
    let mut edited = graph.clone();
    edited.frame.offset[0] += 1.0;
    let message = crate::import_edits(&field, &edited, "moved.usda", false).unwrap_err().to_string();
    assert!(message.contains("moved.usda") && message.contains("export the base again"), "{message}");
    edited.frame = frame;
    assert!(crate::import_edits(&field, &edited, "same.usda", false).unwrap().1.is_empty());
}

#[test]
fn flat_splats_stay_flat() {
    let mut graph = build(&recorded_field(3, 5), &options()).unwrap();
    for node in &mut graph.nodes {
        node.splats.scales.iter_mut().for_each(|scale| scale[1] = 0.0);
        if let Motion::Dense(dense) = &mut node.motion {
            let sampled = dense.samples.iter_mut().filter_map(|sample| sample.scales.as_mut());
            sampled.flatten().for_each(|scale| scale[1] = 0.0);
        }
    }
    let back = field_from_graph(&graph, "flat.usda").unwrap();
    back.validate().unwrap();
    let again = build(&back, &options()).unwrap();
    let third = build(&field_from_graph(&again, "flat.usda").unwrap(), &options()).unwrap();
    assert!(!again.warnings.iter().any(|warning| warning.contains("left out")), "{:?}", again.warnings);
    assert_same(&again, &third);
    let scales = || again.nodes.iter().flat_map(|node| &node.splats.scales);
    assert!(scales().count() > 0 && scales().all(|scale| scale[1] == 0.0 && scale[0] > 0.0));
}

#[test]
fn unit_axis_and_time_codes_of_a_file_are_those_of_its_exports() {
    let mut graph = build(&recorded_field(2, 5), &options()).unwrap();
    (graph.up_axis, graph.meters_per_unit) = (crate::UpAxis::Y, 0.01);
    for (first, step) in [(101.0, 1.0), (-20.0, 1.0), (0.5, 2.5)] {
        let mut graph = graph.clone();
        let code = |code: f64| first + step * code;
        let codes = &mut graph.time_codes;
        codes.samples.iter_mut().for_each(|sample| *sample = code(*sample));
        for node in &mut graph.nodes {
            node.visibility.iter_mut().for_each(|sample| sample.time_code = code(sample.time_code));
            if let Motion::Rigid(track) = &mut node.motion {
                track.iter_mut().for_each(|pose| pose.time_code = code(pose.time_code));
            }
        }
        for sample in graph.cameras.iter_mut().flat_map(|track| &mut track.samples) {
            sample.time_code = code(sample.time_code);
        }
        let back = field_from_graph(&graph, "a.usda").unwrap();
        let again = build(&back, &options()).unwrap();
        assert_eq!((again.up_axis, again.meters_per_unit), (crate::UpAxis::Y, 0.01));
        assert_eq!(again.time_codes.samples, graph.time_codes.samples);
        assert_eq!(again.cameras, graph.cameras);
        for (a, b) in graph.nodes.iter().zip(&again.nodes) {
            assert_eq!(a.visibility, b.visibility);
            let codes = |node: &Node| node.track().iter().map(|pose| pose.time_code).collect::<Vec<_>>();
            assert_eq!(codes(a), codes(b), "{}", a.name);
        }
        let asked = SceneOptions { up_axis: Some(crate::UpAxis::Z), meters_per_unit: Some(1.0), ..options() };
        let asked = build(&back, &asked).unwrap();
        assert_eq!((asked.up_axis, asked.meters_per_unit), (crate::UpAxis::Z, 1.0));
    }
}

#[test]
fn a_graph_comes_back_as_the_graph_it_was() {
    for seed in 0..6 {
        let field = recorded_field(1 + seed as usize, seed);
        field.validate().unwrap();
        let graph = build(&field, &options()).unwrap();
        let back = field_from_graph(&graph, "scene.usda").unwrap();
        assert_eq!(back.len(), field.len());
        assert_eq!(back.instances, field.instances);
        assert_eq!(back.timeline, field.timeline);
        assert_eq!(back.record.notes["imported"]["exported_from"], field.fingerprint());
        let again = build(&back, &options()).unwrap();
        assert_same(&graph, &again);
        // What is posed is the same at every frame, hidden or not.
        for time in TIMES {
            let (a, b) = (field.deformed(time), back.deformed(time));
            let rows: Vec<usize> =
                graph.nodes.iter().flat_map(|node| &node.splats.rows).map(|row| *row as usize).collect();
            for (new, old) in rows.into_iter().enumerate() {
                assert!(off(&a.means[old], &b.means[new]) < 5e-5, "row {old} at {time}");
                // Colours turn with the frame of a node; these dense samples sway without turning colours.
                let sways = field.tracks.as_ref().unwrap().group(old) == Some(2);
                let colors = off(&a.sh_coefficients[old], &b.sh_coefficients[new]);
                assert!(sways || colors < 1e-4, "row {old} at {time}");
                assert_eq!(a.opacity(old) == 0.0, b.opacity(new) == 0.0);
            }
        }
    }
}

#[test]
fn every_kind_of_motion_is_there_and_the_comparison_can_fail() {
    let graph = build(&recorded_field(4, 3), &options()).unwrap();
    let models: Vec<_> = graph.nodes.iter().map(Node::model).collect();
    use MotionModel::{Dense, Rigid, Static};
    assert_eq!(models, [Static, Rigid, Dense, Static, Static]);
    assert_eq!(graph.nodes[3].visibility.len(), 2);
    assert!(!graph.nodes[3].is_visible(1.0) && graph.nodes[3].is_visible(2.0));
    let mut moved = graph.clone();
    moved.nodes[0].pivot.x += 1e-4;
    assert!(std::panic::catch_unwind(|| assert_same(&graph, &moved)).is_err());
}

/// The rigid node of a scene of two objects, as two parts of which the second opens like a lid.
fn with_parts(graph: &mut SceneGraph) {
    let Motion::Rigid(track) = graph.nodes[1].motion.clone() else { panic!("the second object is rigid") };
    let node = &mut graph.nodes[1];
    let half = node.splats.len() / 2;
    let lid = |code: f64| PoseSample {
        time_code: code,
        translation: DVec3::new(0.02, 0.0, 0.05),
        rotation: DQuat::from_rotation_x(0.3 * code),
    };
    let part = |name: &str, splats, pivot, track| crate::Part {
        name: name.to_owned(),
        splats,
        pivot,
        track,
        extent: Bounds::EMPTY,
        joint: None,
    };
    let parts = vec![
        part("part_00", 0..half, DVec3::new(0.0, 0.1, 0.0), Vec::new()),
        part("part_01", half..node.splats.len(), DVec3::ZERO, vec![lid(1.0), lid(5.0)]),
    ];
    node.motion = Motion::Parts(crate::PartsMotion { track, parts });
}

#[test]
fn parts_move_as_node_and_part_say() {
    let mut graph = build(&recorded_field(2, 8), &options()).unwrap();
    with_parts(&mut graph);
    let field = field_from_graph(&graph, "parts.glb").unwrap();
    let node = &graph.nodes[1];
    let Motion::Parts(parts) = &node.motion else { unreachable!() };
    let first = graph.nodes[0].splats.len();
    for (frame, time) in TIMES.iter().enumerate() {
        let posed = field.deformed(*time);
        for part in &parts.parts {
            let in_node = pose_at(&part.track, part.pivot, frame as f64).transform();
            let world: RigidTransform = node.world_transform(frame as f64).compose(&in_node);
            for splat in part.splats.clone() {
                let expected = world.apply(DVec3::from_array(node.splats.means[splat].map(f64::from)));
                let found = DVec3::from_array(posed.means[first + splat].map(f64::from));
                assert!((expected - found).length() < 1e-6, "{} at {frame}", part.name);
            }
        }
    }
}

#[test]
fn a_turned_still_object_is_turned_once_with_its_colours() {
    let mut graph = build(&recorded_field(1, 2), &options()).unwrap();
    let turn = DQuat::from_rotation_y(0.8);
    let node = &mut graph.nodes[0];
    node.motion = Motion::Rigid(vec![PoseSample { time_code: 0.0, translation: DVec3::X, rotation: turn }]);
    let field = field_from_graph(&graph, "turned.glb").unwrap();
    assert_eq!(field.tracks, None, "nothing moves");
    let mut sh = graph.nodes[0].splats.sh_coefficients[..48].to_vec();
    HarmonicsRotation::new(rows_of(turn)).rotate(&mut sh);
    assert!(off(&sh, &field.gaussians.sh_coefficients[0]) < 1e-6);
    let expected = turn * DVec3::from_array(graph.nodes[0].splats.means[0].map(f64::from)) + DVec3::X;
    assert!(off(&expected.as_vec3().to_array(), &field.gaussians.means[0]) < 1e-6);
}

#[test]
fn opacities_of_0_and_1_and_odd_ids_survive() {
    let mut graph = build(&recorded_field(3, 4), &options()).unwrap();
    graph.nodes[0].splats.opacities[..3].copy_from_slice(&[0.0, 1.0, f32::MIN_POSITIVE]);
    graph.nodes[0].splats.occupancies.clear();
    for (node, id) in [(0, 0), (1, 7), (2, 7)] {
        graph.nodes[node].kind = NodeKind::Instance { id, index: 0 };
    }
    let field = field_from_graph(&graph, "odd.ply").unwrap();
    assert_eq!([0, 1].map(|row| field.gaussians.opacity(row)), [0.0, 1.0]);
    assert_eq!(field.gaussians.occupancy(1), 1.0, "no occupancies: opacities");
    let ids: Vec<u16> = field.instances.iter().map(|instance| instance.id).collect();
    assert_eq!(ids, [1, 7, 2]);
}

#[test]
fn files_of_others_have_an_unseen_background() {
    let mut graph = build(&recorded_field(1, 4), &options()).unwrap();
    graph.origin = crate::Origin::default();
    let field = field_from_graph(&graph, "theirs.glb").unwrap();
    assert!((field.gaussians.occupancy(MEMBERS) - 0.02).abs() < 1e-6);
    // Without instances there are no identities, and what is there is there.
    graph.nodes.remove(0);
    let field = field_from_graph(&graph, "theirs.glb").unwrap();
    assert_eq!((field.identities.is_none(), field.instances.len()), (true, 0));
    assert!((field.gaussians.occupancy(0) - graph.nodes[0].splats.occupancies[0]).abs() < 1e-6);
}

#[test]
fn broken_graphs_are_refused_by_name() {
    type Break = fn(&mut SceneGraph);
    let breaks: [(&str, Break); 9] = [
        ("thing_0_002", |graph| drop(graph.nodes[0].splats.scales.split_off(3))),
        ("scale is below 0", |graph| graph.nodes[0].splats.scales[2][1] = -1.0),
        ("opacity", |graph| graph.nodes[0].splats.opacities[2] = f32::NAN),
        ("degree 4", |graph| graph.nodes[0].splats.sh_degree = 4),
        ("means", |graph| graph.nodes[0].splats.means[0][0] = f32::INFINITY),
        ("has no samples", |graph| {
            graph.nodes[1].motion = Motion::Dense(DenseMotion { track: Vec::new(), samples: Vec::new() });
        }),
        ("does not ascend", |graph| {
            let Motion::Rigid(track) = &mut graph.nodes[1].motion else { unreachable!() };
            track.swap(0, 1);
        }),
        ("its parts hold 20 of 40", |graph| {
            with_parts(graph);
            let Motion::Parts(parts) = &mut graph.nodes[1].motion else { unreachable!() };
            parts.parts.pop();
        }),
        ("time codes do not ascend", |graph| graph.time_codes.times[1] = 0.0),
    ];
    let graph = build(&recorded_field(2, 4), &options()).unwrap();
    for (words, break_it) in breaks {
        let mut graph = graph.clone();
        break_it(&mut graph);
        let message = field_from_graph(&graph, "broken.usda").unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    }
}

#[test]
fn joints_leave_with_their_parts_and_come_back() {
    for kind in [JointKind::Revolute, JointKind::Prismatic] {
        let mut field = recorded_field(4, 7);
        let tracks = field.tracks.as_mut().unwrap();
        let base = tracks.groups.iter().position(|group| group.poses.len() > 1).unwrap() as u32;
        let rows: Vec<usize> =
            (0..field.gaussians.len()).filter(|row| tracks.group_of[*row] == base).collect();
        tracks.groups[base as usize].deformed = false;
        let pivot = tracks.groups[base as usize].pivot + DVec3::new(0.1, 0.05, 0.0);
        let joint = Joint { base, kind, axis: DVec3::new(0.6, 0.0, 0.8) };
        let values: Vec<(f64, f64)> = TIMES.iter().map(|time| (*time, 0.2 + 0.9 * time)).collect();
        let part = TrackGroup::jointed("part", pivot, joint, &values, &tracks.groups);
        rows[rows.len() / 2..].iter().for_each(|row| tracks.group_of[*row] = tracks.groups.len() as u32);
        tracks.groups.push(part);
        field.validate().unwrap();
        let graph = build(&field, &options()).unwrap();
        let has_joint = |part: &crate::Part| part.joint.is_some();
        let parts = graph.nodes.iter().find_map(|node| match &node.motion {
            Motion::Parts(motion) if motion.parts.iter().any(has_joint) => Some(motion),
            _ => None,
        });
        let parts = parts.unwrap();
        assert_eq!(parts.parts.len(), 2, "{kind}");
        let found = parts.parts[1].joint.unwrap();
        assert_eq!((found.base, found.kind, found.anchor), (0, kind, DVec3::ZERO));
        let [low, high] = parts.joint_range(1).unwrap();
        let most = 0.9 * (TIMES[TIMES.len() - 1] - TIMES[0]);
        assert!(low.abs() < 1e-9 && (high - most).abs() < 1e-9, "{kind}: {low} to {high}, not {most}");
        // The part stays on its axis at all keys.
        let first = parts.at_first(1).unwrap();
        for key in &parts.parts[1].track {
            let pose = parts.on_base(1, key.time_code).unwrap();
            let moved = pose.translation - first.translation;
            let across = moved - found.axis * found.axis.dot(moved);
            let off = if kind == JointKind::Revolute { moved.length() } else { across.length() };
            let turn = (first.rotation.conjugate() * pose.rotation).xyz();
            assert!(off < 1e-9, "{kind}: {off} from the axis");
            assert!(turn.cross(found.axis).length() < 1e-9, "{kind}: turned by {turn}");
        }
        let back = field_from_graph(&graph, "memory").unwrap().tracks.unwrap();
        let group = back.groups.iter().position(|group| group.joint.is_some()).unwrap();
        let (joint, values) = back.joint_values(group).unwrap();
        assert_eq!(joint.kind, kind);
        assert!((joint.axis.length() - 1.0).abs() < 1e-9);
        let last = values[values.len() - 1];
        assert!((last - most).abs() < 1e-6, "{kind}: {last}, not {most}");
    }
}

#[test]
fn cameras_that_adapt_come_back_with_their_exposures() {
    let mut field = recorded_field(2, 5);
    let name = field.cameras[0].name.clone();
    let times: Vec<f64> = field.timeline.times.clone();
    let timed = |(k, time): (usize, &f64)| TimedExposure {
        time: *time,
        exposure: Exposure::of_stops(0.1 * k as f64 - 0.2),
    };
    let series: Vec<TimedExposure> = times.iter().enumerate().map(timed).collect();
    field.record.drawing.exposures_in_time.insert(name.clone(), series.clone());
    let graph = build(&field, &options()).unwrap();
    let track = graph.cameras.iter().find(|track| track.label == name).unwrap();
    assert!(track.samples.iter().any(|sample| (sample.exposure + 0.2).abs() < 1e-6), "{track:?}");
    assert!(
        graph
            .cameras
            .iter()
            .filter(|track| track.label != name)
            .all(|track| track.samples[0].exposure == 0.0)
    );
    let back = field_from_graph(&graph, "a.usda").unwrap();
    for sample in &track.samples {
        let time = time_in_field(&graph, sample.time_code).unwrap();
        let found = back.record.drawing.exposure(&name, time).unwrap();
        assert!((found.stops() - sample.exposure).abs() < 1e-6, "{found:?} for {}", sample.exposure);
    }
}
