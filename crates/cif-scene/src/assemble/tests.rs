use std::collections::BTreeMap;

use glam::{DAffine3, DQuat, DVec3};

use super::*;
use crate::graph::{
    Appearance, AppearanceSample, MotionModel, MotionReport, Origin, Part, Splats, VisibilitySample,
};

fn splats(count: usize, degree: u8) -> Splats {
    let floats = 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
    Splats {
        means: (0..count).map(|k| [k as f32, 0.0, 0.0]).collect(),
        orientations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        scales: vec![[0.1; 3]; count],
        opacities: vec![0.5; count],
        sh_degree: degree,
        sh_coefficients: vec![0.25; count * floats],
        occupancies: vec![0.5; count],
        identity_probabilities: vec![1.0; count],
        identities: Vec::new(),
        rows: vec![Splats::NO_ROW; count],
    }
}

fn prim(place: &str, identity: Identity) -> Prim {
    Prim { identity, ..Prim::still(place.to_owned(), "mug".to_owned(), splats(2, 0)) }
}

fn recorded(id: u16, original: bool) -> Identity {
    Identity::Recorded { id, index: Some(usize::from(id) + 4), original }
}

fn graph(prims: Vec<Prim>) -> SceneGraph {
    assemble(Prims { prims, ..Prims::default() }).unwrap()
}

fn pose(time_code: f64, x: f64) -> PoseSample {
    PoseSample { time_code, translation: DVec3::X * x, rotation: DQuat::IDENTITY }
}

fn moving(samples: Vec<PoseSample>) -> Track {
    Track { rest: samples[0], samples }
}

fn kinds(graph: &SceneGraph) -> Vec<NodeKind> {
    graph.nodes.iter().map(|node| node.kind).collect()
}

#[test]
fn ids_that_are_recorded_stay_and_others_are_free_ones() {
    let prims = vec![
        prim("a", Identity::New),
        prim("b", recorded(1, true)),
        prim("c", Identity::Background),
        prim("d", Identity::New),
    ];
    let graph = assemble(Prims { prims, reserved: BTreeMap::from([(2, 9)]), ..Prims::default() }).unwrap();
    let instance = |id, index| NodeKind::Instance { id, index };
    assert_eq!(kinds(&graph), [instance(3, 10), instance(1, 5), NodeKind::Background, instance(4, 11)]);
    let names: Vec<&str> = graph.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["mug_003", "mug_001", "background", "mug_004"]);
}

#[test]
fn copies_keep_their_id_or_get_another() {
    let named = |place: &str, original| Prim {
        name: PrimName::Exported("mug_001".to_owned()),
        ..prim(place, recorded(1, original))
    };
    let copies = |copies| {
        let prims = vec![named("a", false), named("b", true), named("c", false)];
        assemble(Prims { prims, copies, ..Prims::default() }).unwrap()
    };
    let kept = copies(Copies::Keep);
    assert!(kept.nodes.iter().all(|node| node.kind == NodeKind::Instance { id: 1, index: 5 }));
    assert_eq!(kept.warnings, ["a is a copy of b (instance 1)", "c is a copy of b (instance 1)"]);
    assert_eq!(kept.nodes[1].name, "mug_001_2", "names are unique all the same");
    let renumbered = copies(Copies::Renumber);
    assert_eq!(renumbered.nodes[2].kind, NodeKind::Instance { id: 3, index: 7 });
    assert_eq!(renumbered.nodes[2].name, "mug_003");
    assert_eq!(renumbered.warnings[0], "b repeats mug_001: it becomes the instance 2");
}

#[test]
fn more_objects_than_ids_are_refused() {
    let prims = (0..=u16::MAX)
        .map(|k| Prim { pieces: Vec::new(), ..prim(&format!("thing {k}"), Identity::New) })
        .collect();
    let error = assemble(Prims { prims, ..Prims::default() }).unwrap_err();
    assert_eq!(error.place, "thing 65535");
}

#[test]
fn two_backgrounds_are_two_nodes_unless_one_is_a_copy() {
    let background =
        |name: &str| Prim { name: PrimName::Exported(name.to_owned()), ..prim(name, Identity::Background) };
    let prims = vec![background("background"), background("background_moving"), background("background")];
    let graph = assemble(Prims { prims, copies: Copies::Renumber, ..Prims::default() }).unwrap();
    assert_eq!(
        kinds(&graph),
        [NodeKind::Background, NodeKind::Background, NodeKind::Instance { id: 1, index: 0 }]
    );
}

#[test]
fn timelines_hold_every_sample_once() {
    let mut mug = prim("a", Identity::New);
    mug.track = moving(vec![pose(2.0, 0.0), pose(6.0, 1.0)]);
    mug.visibility = vec![VisibilitySample { time_code: 4.0, visible: false }];
    let timeline = Timeline::Sampled { codes: vec![2.0, 10.0], start: 0.0, frames_per_second: 24.0 };
    let graph = assemble(Prims { prims: vec![mug], timeline, ..Prims::default() }).unwrap();
    assert_eq!(graph.time_codes.samples, [2.0, 4.0, 6.0, 10.0]);
    assert_eq!(graph.time_codes.times, [0.0, 0.25, 0.5, 1.0]);
    assert_eq!(graph.nodes[0].source_frames, (0, 3));
    assert_eq!(super::tests::graph(vec![prim("a", Identity::New)]).time_codes.samples, [0.0]);
}

#[test]
fn pieces_become_one_or_parts() {
    let mut mug = prim("a", Identity::New);
    let still = mug.pieces.remove(0);
    let moved = Piece {
        name: "lid".to_owned(),
        splats: splats(1, 1),
        placement: Placement::Rigid {
            track: moving(vec![pose(0.0, 3.0), pose(1.0, 5.0)]),
            baked: Some(DAffine3::from_scale(DVec3::splat(2.0))),
        },
        pivot: Some(DVec3::X),
        ..still.clone()
    };
    mug.pieces = vec![Piece { name: "lid".to_owned(), ..still }, moved];
    mug.color_codes = vec![0.0];
    mug.pieces[0].colors = vec![vec![0.5; 6]];
    mug.pieces[1].colors = vec![vec![1.0; 12]];
    let whole = graph(vec![mug.clone()]).nodes.remove(0);
    assert_eq!(whole.model(), MotionModel::Static);
    assert_eq!(whole.splats.means, [[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]);
    assert_eq!(whole.splats.sh_coefficients.len(), 3 * 12, "filled up to degree 1");
    assert_eq!(whole.mean_occupancy, 0.5);
    assert!((whole.extent.high.x - 3.6).abs() < 1e-6, "{:?}", whole.extent);
    let parts = graph(vec![Prim { in_parts: true, ..mug }]).nodes.remove(0);
    let Motion::Parts(motion) = &parts.motion else { panic!("{:?}", parts.motion) };
    let part = |part: &Part| (part.name.clone(), part.splats.clone(), part.pivot, part.track.len());
    assert_eq!(part(&motion.parts[0]), ("lid".to_owned(), 0..2, DVec3::ZERO, 0));
    assert_eq!(part(&motion.parts[1]), ("lid_2".to_owned(), 2..3, DVec3::X, 2));
    assert_eq!(parts.splats.means[2], [0.0; 3], "parts keep frames of their own");
    assert!((parts.extent.high.x - 3.6).abs() < 1e-6, "as at the first time: {:?}", parts.extent);
    assert_eq!((parts.report.parts, parts.report.samples), (2, 2));
    let mut values = vec![0.5; 3];
    values.resize(12, 0.0);
    let values = [values.clone(), values, vec![1.0; 12]].concat();
    let expected =
        Appearance { opacities: Vec::new(), colors: vec![AppearanceSample { time_code: 0.0, values }] };
    assert_eq!(parts.appearance, expected);
}

#[test]
fn what_deforms_is_baked_at_every_time() {
    let mut mug = prim("a", Identity::New);
    let grows = |time: f64| (time, DAffine3::from_scale(DVec3::splat(1.0 + time)));
    let shape = |w: f32| Shape {
        means: vec![[1.0, 0.0, 0.0]; 2],
        orientations: vec![[w, 0.0, 0.0, 0.0]; 2],
        scales: vec![[0.1; 3]; 2],
    };
    mug.shape_codes = vec![0.0, 1.0];
    mug.scales_change = true;
    mug.pieces[0].placement = Placement::Sampled(vec![grows(0.0), grows(1.0)]);
    mug.pieces[0].shapes = vec![shape(1.0), shape(-1.0)];
    let node = graph(vec![mug]).nodes.remove(0);
    let Motion::Dense(dense) = &node.motion else { panic!("{:?}", node.motion) };
    assert_eq!(dense.samples[1].means[0], [2.0, 0.0, 0.0]);
    assert_eq!(dense.samples[1].scales.as_ref().unwrap()[0], [0.2; 3]);
    assert_eq!(dense.samples[1].orientations[0], [1.0, 0.0, 0.0, 0.0], "in one hemisphere");
    assert!((dense.samples[1].extent.high.x - 2.6).abs() < 1e-6);
}

#[test]
fn recorded_pivots_and_reports_count_while_they_hold() {
    let at = |x: f64| Track { rest: pose(0.0, x), samples: Vec::new() };
    let pivot = DVec3::new(0.1, 0.0, 0.0);
    let one = |track: Track, keeps_pose| {
        let mut mug = prim("a", Identity::New);
        let report = MotionReport {
            model: MotionModel::Rigid,
            seconds: 7.0,
            ..MotionReport::unfitted(&mug.pieces[0].splats, &Motion::Static)
        };
        mug = Prim { track, keeps_pose, pivot: Some(pivot), report: Some(report), ..mug };
        graph(vec![mug]).nodes.remove(0)
    };
    assert_eq!(one(at(f64::from(0.1_f32)), false).pivot, pivot, "the same in single precision");
    let still = one(at(0.2), false);
    assert_eq!((still.pivot.x, still.report.model, still.report.seconds), (0.2, MotionModel::Static, 0.0));
    let kept = one(at(0.2), true);
    assert_eq!((kept.pivot, kept.track().len(), kept.report.seconds), (pivot, 1, 7.0));
}

/// World places of the splats of a graph at a time code.
fn places(graph: &SceneGraph, time_code: f64) -> Vec<DVec3> {
    let splats = graph.nodes.iter().flat_map(|node| node.splats_at(time_code).means);
    splats.map(|mean| graph.frame.capture_from_dataset(mean)).collect()
}

#[test]
fn far_objects_get_an_origin_of_their_own() {
    let at = DVec3::new(500_123.25, 4_649_776.125, 215.5);
    let far = |time_code: f64, x: f64| PoseSample {
        time_code,
        translation: at + DVec3::X * x,
        rotation: DQuat::from_rotation_z(0.5 * time_code),
    };
    let tracks =
        [Track { rest: far(0.0, 0.0), samples: Vec::new() }, moving(vec![far(0.0, 0.0), far(1.0, 0.3)])];
    let below = |map| {
        let mut found = prim("below", Identity::New);
        found.pieces[0].placement = map;
        found
    };
    let mut prims: Vec<Prim> =
        tracks.into_iter().map(|track| Prim { track, ..prim("above", Identity::New) }).collect();
    prims.push(below(Placement::still(Some(DAffine3::from_translation(at)))));
    prims.push(below(Placement::Rigid { track: moving(vec![far(0.0, 0.0), far(1.0, 0.3)]), baked: None }));
    for prim in prims {
        let map = |code: f64| {
            let pose = prim.track.at(code);
            let map = DAffine3::from_rotation_translation(pose.rotation, pose.translation);
            map * prim.pieces[0].placement.at(code)
        };
        let in_parts =
            matches!(&prim.pieces[0].placement, Placement::Rigid { track, .. } if !track.is_identity());
        let expected: Vec<Vec<DVec3>> = [0.0, 1.0]
            .map(|code| (0..2).map(|k| map(code).transform_point3(DVec3::X * f64::from(k))).collect())
            .to_vec();
        let graph = assemble(Prims { prims: vec![Prim { in_parts, ..prim }], ..Prims::default() }).unwrap();
        assert!(!graph.frame.is_identity() && graph.warnings[0].contains("origin"), "{:?}", graph.warnings);
        for (code, expected) in [0.0, 1.0].into_iter().zip(expected) {
            for (found, place) in places(&graph, code).iter().zip(&expected) {
                assert!((*found - *place).length() < 1e-5, "{found} {place}");
            }
        }
    }
    // Near ones, those of files of ours, and what is as large as far away stay where they are.
    let rest = PoseSample { time_code: 0.0, translation: DVec3::X * 900.0, rotation: DQuat::IDENTITY };
    let track = Track { rest, samples: Vec::new() };
    assert!(graph(vec![Prim { track, ..prim("a", Identity::New) }]).frame.is_identity());
    let track = Track { rest: far(0.0, 0.0), samples: Vec::new() };
    let prims = vec![Prim { track: track.clone(), ..prim("a", Identity::New) }, prim("b", Identity::New)];
    assert!(graph(prims).frame.is_identity());
    let origin = Origin { field_fingerprint: Some("f".to_owned()), options: None };
    let prims = vec![Prim { track, ..prim("a", Identity::New) }];
    assert!(assemble(Prims { prims, origin, ..Prims::default() }).unwrap().frame.is_identity());
}

#[test]
fn flat_splats_stay_flat_below_uneven_scales() {
    let mut found = prim("a", Identity::New);
    found.pieces[0].splats.scales = vec![[0.1, 0.2, 0.0]; 2];
    found.pieces[0].splats.orientations = vec![[0.8, 0.6, 0.0, 0.0]; 2];
    let stretch = glam::DMat3::from_diagonal(DVec3::new(1.0, 3.0, 0.5));
    found.pieces[0].placement = Placement::still(Some(DAffine3::from_mat3(stretch)));
    let scales = graph(vec![found]).nodes[0].splats.scales[0];
    assert_eq!(scales.iter().filter(|scale| **scale == 0.0).count(), 1, "{scales:?}");
}
