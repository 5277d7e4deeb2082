//! Windows cut out of motion that is known over all times.

use cif_geometry::spherical_harmonics::HarmonicsRotation;
use cif_geometry::{Bounds, RigidTransform};
use glam::{DMat3, DQuat, DVec3};

use super::*;
use crate::graph::{AppearanceSample, DenseMotion, DenseSample, Part, PartsMotion, PoseSample, Splats};
use crate::testing::{self, Numbers, graph_of};
use crate::vectors::quaternion_of;

/// Time codes that two windows see; the second begins at 12.
const SEEN: [std::ops::RangeInclusive<usize>; 2] = [0..=13, 10..=23];

fn node_of(id: u16, label: &str, splats: Splats, motion: Motion) -> Node {
    Node {
        kind: NodeKind::Instance { id, index: usize::from(id) },
        name: naming::instance_name(label, id),
        report: MotionReport::unfitted(&splats, &motion),
        splats,
        motion,
        ..testing::node_of(&[], [0.0; 3])
    }
}

fn turn(axis: DVec3, angle: f64) -> DMat3 {
    DMat3::from_axis_angle(axis.normalize(), angle)
}

/// Where the object really is.
fn world_from_object(code: f64) -> RigidTransform {
    RigidTransform {
        rotation: turn(DVec3::new(0.2, 1.0, 0.4), 0.11 * code),
        translation: DVec3::new(0.05 * code, (0.2 * code).sin(), 0.3),
    }
}

fn splats(count: usize, seed: u64, object_from_local: &RigidTransform) -> Splats {
    let mut numbers = Numbers::new(seed);
    let mut splats = Splats { sh_degree: 2, ..Splats::default() };
    let local_from_object = object_from_local.inverse();
    let harmonics = HarmonicsRotation::from_quaternion(
        quaternion_of(&local_from_object.rotation).map(|component| component as f32),
    );
    for row in 0..count {
        splats.means.push(local_from_object.apply(0.2 * numbers.vector()).as_vec3().to_array());
        let q = quaternion_of(&local_from_object.rotation);
        splats.orientations.push(q.map(|component| component as f32));
        splats.scales.push([0.01, 0.02, 0.03]);
        splats.opacities.push(0.8);
        splats.occupancies.push(0.9);
        splats.identity_probabilities.push(1.0);
        splats.rows.push(row as u32);
        splats.sh_coefficients.extend((0..27).map(|_| numbers.next() as f32));
    }
    harmonics.rotate_all(&mut splats.sh_coefficients, 2);
    splats
}

/// A window's view of the object: its frame is anywhere in it, and its poses lie off by `error`.
fn seen(
    window: usize,
    object_from_local: &RigidTransform,
    error: impl Fn(f64) -> RigidTransform,
) -> SceneGraph {
    let codes: Vec<f64> = SEEN[window].clone().map(|code| code as f64).collect();
    let pose = |code: &f64| {
        PoseSample::new(*code, &error(*code).compose(&world_from_object(*code)).compose(object_from_local))
    };
    let track: Vec<PoseSample> = codes.iter().map(pose).collect();
    let node = node_of(7, "thing", splats(5, 3, object_from_local), Motion::Rigid(track));
    graph_at(vec![node], codes)
}

fn graph_at(nodes: Vec<Node>, codes: Vec<f64>) -> SceneGraph {
    let mut graph = graph_of(nodes);
    let (first, last) = (codes[0], codes[codes.len() - 1]);
    let times = codes.iter().map(|code| (code - first) / (last - first)).collect();
    graph.time_codes = TimeCodes { samples: codes, times, frames_per_second: 30.0 };
    graph.cameras.clear();
    graph
}

fn anywhere() -> RigidTransform {
    RigidTransform {
        rotation: turn(DVec3::new(1.0, -0.3, 0.5), 2.1),
        translation: DVec3::new(0.1, -0.2, 0.05),
    }
}

fn exact(_: f64) -> RigidTransform {
    RigidTransform::IDENTITY
}

/// Window of a time code.
fn window_at(graph: &SceneGraph, code: f64) -> &SceneWindow {
    graph.windows.iter().rev().find(|window| window.start <= code).unwrap()
}

#[test]
fn an_object_goes_on_where_windows_meet_though_their_frames_differ() {
    let graphs = vec![seen(1, &anywhere(), exact), seen(0, &RigidTransform::IDENTITY, exact)];
    let (graph, seams) = joined(graphs).unwrap();
    assert_eq!(graph.time_codes.samples, (0..24).map(f64::from).collect::<Vec<_>>());
    assert_eq!(graph.windows.iter().map(|window| window.start).collect::<Vec<_>>(), [0.0, 12.0]);
    assert_eq!((seams.len(), seams[0].time_code, seams[0].objects.len()), (1, 12.0, 1));
    assert!(seams[0].objects[0].distance < 1e-6 && seams[0].objects[0].degrees < 1e-4, "{seams:?}");
    let truth = splats(5, 3, &RigidTransform::IDENTITY);
    for code in 0..24 {
        let code = f64::from(code);
        let world = graph.nodes[0].world_transform(code);
        let expected = world_from_object(code);
        let shown = &window_at(&graph, code).nodes[0].splats;
        for (mean, truth) in shown.means.iter().zip(&truth.means) {
            let [now, then] = [mean, truth].map(|mean| DVec3::from(mean.map(f64::from)));
            assert!(world.apply(now).distance(expected.apply(then)) < 1e-6, "{code}");
        }
        let colors = |splats: &Splats, pose: &RigidTransform| {
            let mut colors = splats.sh_coefficients.clone();
            let turn = quaternion_of(&pose.rotation).map(|component| component as f32);
            HarmonicsRotation::from_quaternion(turn).rotate_all(&mut colors, 2);
            colors
        };
        for (now, then) in colors(shown, &world).iter().zip(colors(&truth, &expected)) {
            assert!((now - then).abs() < 1e-5, "colours turn with their splats: {now} {then} at {code}");
        }
    }
}

#[test]
fn where_poses_differ_they_go_over_from_one_to_the_other() {
    // What is constant in the object belongs to the frame; what grows with time is left.
    let off = |code: f64| RigidTransform {
        translation: DVec3::new(0.01 * (code - 11.5), 0.0, 0.0),
        ..RigidTransform::IDENTITY
    };
    let graphs = vec![seen(0, &RigidTransform::IDENTITY, exact), seen(1, &anywhere(), off)];
    let (graph, seams) = joined(graphs).unwrap();
    let gap = seams[0].objects[0].distance;
    // 1.5 and 0.5 cm to either side.
    assert!((gap - 0.011).abs() < 0.001, "{gap}");
    let track = graph.nodes[0].track();
    // A centimetre of it is lost from time to time, and a fifth of the gap from one time to the next.
    let step = |a: &PoseSample, b: &PoseSample| {
        let of = |pose: &PoseSample| pose.translation - world_from_object(pose.time_code).translation;
        of(a).distance(of(b))
    };
    for pair in track.windows(2) {
        assert!(
            step(&pair[0], &pair[1]) < 0.014,
            "no jump: {:?}",
            (pair[0].time_code, step(&pair[0], &pair[1]))
        );
        assert!(pair[0].rotation.dot(pair[1].rotation) > 0.0, "one hemisphere");
    }
}

#[test]
fn deforming_objects_and_parts_are_where_their_window_has_them() {
    let local = RigidTransform::IDENTITY;
    let codes: Vec<f64> = SEEN[0].clone().map(|code| code as f64).collect();
    let bent = splats(4, 5, &local);
    let sample = |code: f64| DenseSample {
        time_code: code,
        means: bent.means.iter().map(|mean| [mean[0], mean[1] + 0.01 * code as f32, mean[2]]).collect(),
        orientations: bent.orientations.clone(),
        scales: None,
        extent: Bounds::EMPTY,
    };
    let dense = DenseMotion { track: vec![], samples: vec![sample(0.0), sample(5.0), sample(13.0)] };
    let part = |range: std::ops::Range<usize>, angle: f64| Part {
        name: format!("part_{:02}", range.start),
        splats: range,
        pivot: DVec3::ZERO,
        track: [0.0, 13.0]
            .map(|code| PoseSample {
                time_code: code,
                translation: DVec3::new(0.02 * code, 0.0, 0.1),
                rotation: DQuat::from_axis_angle(DVec3::Z, angle * code),
            })
            .to_vec(),
        extent: Bounds::EMPTY,
        joint: None,
    };
    let parts = PartsMotion { track: vec![], parts: vec![part(0..2, 0.0), part(2..4, 0.1)] };
    let first = vec![
        node_of(1, "jelly", bent.clone(), Motion::Dense(dense)),
        node_of(2, "box", bent.clone(), Motion::Parts(parts)),
    ];
    let mut fading = node_of(1, "jelly", splats(6, 8, &anywhere()), Motion::Static);
    fading.appearance.opacities = [10.0, 23.0]
        .map(|code| AppearanceSample { time_code: code, values: vec![0.1 * code as f32; 6] })
        .to_vec();
    let second = vec![fading, node_of(2, "box", bent, Motion::Static)];
    let codes_2: Vec<f64> = SEEN[1].clone().map(|code| code as f64).collect();
    let graphs = [graph_at(first, codes), graph_at(second, codes_2)];
    let (graph, _) = joined(graphs.to_vec()).unwrap();
    for place in 0..2 {
        for code in 0..24 {
            let window = usize::from(code >= 12);
            let code = f64::from(code);
            let expected = graphs[window].nodes[place].splats_at(code);
            let shown = &graph.windows[window].nodes[place];
            let placed = shown.local_splats_at(code).turned(&graph.nodes[place].world_transform(code));
            for (now, then) in placed.means.iter().zip(&expected.means) {
                // Poses are mixed where both windows see them; these agree on where the frame is.
                assert!(now.distance(*then) < 1e-5, "{place} {code}: {now} {then}");
            }
        }
    }
    let fading = &graph.windows[1].nodes[0].appearance.opacities;
    assert_eq!(fading.iter().map(|sample| sample.time_code).collect::<Vec<_>>(), [12.0, 23.0]);
    assert!((fading[0].values[0] - 1.2).abs() < 1e-6);
    assert_eq!(graph.nodes[1].report.model, MotionModel::Dense);
}

#[test]
fn an_object_that_one_window_lacks_is_hidden_meanwhile() {
    let thing = |graph: SceneGraph, id| {
        let mut graph = graph;
        graph.nodes.push(node_of(id, "late", splats(3, 9, &RigidTransform::IDENTITY), Motion::Static));
        graph
    };
    let (before, after) = (seen(0, &RigidTransform::IDENTITY, exact), seen(1, &anywhere(), exact));
    let (graph, seams) = joined(vec![before, thing(after, 9)]).unwrap();
    assert_eq!(graph.nodes.len(), 2);
    let late = &graph.nodes[1];
    assert!(!late.is_visible(11.0) && late.is_visible(12.0));
    assert_eq!(
        graph.windows[0].nodes[1].splats, graph.windows[1].nodes[1].splats,
        "as in the nearest window"
    );
    assert_eq!(seams[0].objects.len(), 1, "nothing to compare with");
    assert!(graph.nodes[0].visibility.is_empty());
}

#[test]
fn scenes_that_are_no_windows_of_one_capture_are_refused() {
    let window = |first: i32, last: i32| {
        graph_at(seen(0, &RigidTransform::IDENTITY, exact).nodes, (first..=last).map(f64::from).collect())
    };
    let other_unit = SceneGraph { meters_per_unit: 0.01, ..window(10, 23) };
    for (graphs, said) in [
        (vec![window(0, 13)], "there is one"),
        (vec![window(0, 13), window(15, 23)], "none of them has the frames between 13 and 15"),
        (vec![window(0, 13), window(0, 13)], "give each once"),
        (vec![window(0, 13), window(2, 12)], "give each once"),
        (vec![window(0, 13), other_unit], "unit"),
    ] {
        let error = joined(graphs).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}
