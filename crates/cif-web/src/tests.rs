//! What pages hold of scenes, and what they do not let through.

use std::collections::BTreeMap;

use cif_field::SortMetric;
use cif_geometry::{Bounds, PinholeCamera, RigidTransform, UpAxis};
use cif_scene::{
    Appearance, AppearanceSample, CameraSample, CameraTrack, CaptureFrame, DenseMotion, DenseSample,
    ExportOptions, Motion, MotionReport, Node, NodeKind, Origin, Part, PartsMotion, PoseSample, ReadOptions,
    SceneFormat, SceneGraph, Splats, TimeCodes, VisibilitySample,
};
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::arrays::tests::read;
use crate::describe::{describe, up};
use crate::document::Kind;
use crate::{Html, export};

const HTML: Html = Html { color };

fn color(id: u16) -> [u8; 3] {
    [id as u8, 7, 9]
}

/// Splats along a line, of degree 1.
fn splats(count: usize) -> Splats {
    let along = |k: usize| k as f32 / count as f32;
    Splats {
        means: (0..count).map(|k| [along(k), 1.0 - along(k), 0.25]).collect(),
        orientations: vec![[0.5, 0.5, -0.5, 0.5]; count],
        scales: (0..count).map(|k| [0.01, 0.02 + 0.01 * along(k), 0.0]).collect(),
        opacities: (0..count).map(along).collect(),
        sh_degree: 1,
        sh_coefficients: (0..12 * count).map(|k| (k % 7) as f32 / 7.0 - 0.4).collect(),
        occupancies: vec![1.0; count],
        identity_probabilities: vec![1.0; count],
        identities: Vec::new(),
        rows: vec![Splats::NO_ROW; count],
    }
}

fn node(id: u16, label: &str, splats: Splats, motion: Motion) -> Node {
    Node {
        kind: NodeKind::Instance { id, index: id.into() },
        name: format!("thing_{id:03}"),
        label: label.into(),
        category: "thing".into(),
        taxonomies: BTreeMap::new(),
        embedding: None,
        pivot: DVec3::new(1.0, 2.0, 3.0),
        report: MotionReport::unfitted(&splats, &motion),
        motion,
        splats,
        appearance: Appearance::default(),
        proxy: None,
        colliders: Vec::new(),
        visibility: vec![VisibilitySample { time_code: 3.0, visible: false }],
        extent: Bounds::EMPTY,
        source_frames: (0, 4),
        mean_occupancy: 1.0,
    }
}

fn pose(time_code: f64, x: f64) -> PoseSample {
    PoseSample { time_code, translation: DVec3::X * x, rotation: DQuat::from_rotation_z(x) }
}

/// A rigid object, one of parts, one that deforms and fades, and a camera.
fn graph() -> SceneGraph {
    let rigid = node(1, "red mug", splats(8), Motion::Rigid(vec![pose(0.0, 0.0), pose(4.0, 1.0)]));
    let part = |name: &str, splats, track| Part {
        name: name.into(),
        splats,
        pivot: DVec3::Y,
        track,
        extent: Bounds::EMPTY,
        joint: None,
    };
    let moving = vec![pose(0.0, 0.0), pose(4.0, 0.5)];
    let parts = vec![part("part_00", 0..3, Vec::new()), part("part_01", 3..8, moving)];
    let box_of_two =
        node(2, "</script><b>box", splats(8), Motion::Parts(PartsMotion { track: Vec::new(), parts }));
    let still = splats(6);
    let sample = |time_code: f64, shift: f32| DenseSample {
        time_code,
        means: still.means.iter().map(|mean| [mean[0] + shift, mean[1], mean[2] - shift]).collect(),
        orientations: still.orientations.clone(),
        scales: None,
        extent: Bounds::EMPTY,
    };
    let dense = DenseMotion { track: Vec::new(), samples: vec![sample(0.0, 0.0), sample(4.0, 0.3)] };
    let mut jelly = node(3, "jelly", still.clone(), Motion::Dense(dense));
    jelly.appearance.opacities = vec![
        AppearanceSample { time_code: 0.0, values: vec![1.0; 6] },
        AppearanceSample { time_code: 4.0, values: vec![0.5; 6] },
    ];
    let camera = PinholeCamera {
        width: 64,
        height: 48,
        focal_px: DVec2::splat(60.0),
        principal_px: DVec2::new(32.0, 24.0),
        camera_from_world: RigidTransform {
            rotation: DMat3::IDENTITY,
            translation: DVec3::new(0.0, 0.0, 5.0),
        },
    };
    SceneGraph {
        up_axis: UpAxis::Y,
        meters_per_unit: 0.01,
        frame: CaptureFrame::default(),
        time_codes: TimeCodes {
            samples: vec![0.0, 2.0, 4.0],
            times: vec![0.0, 0.5, 1.0],
            frames_per_second: 12.0,
        },
        nodes: vec![rigid, box_of_two, jelly],
        windows: Vec::new(),
        cameras: vec![CameraTrack {
            name: "cam".into(),
            label: "front".into(),
            samples: vec![CameraSample { time_code: 0.0, camera, exposure: 0.0 }],
        }],
        background_color: [0.0, 0.5, 1.0],
        sort_metric: SortMetric::Distance,
        antialiased: Some(true),
        near: Some(0.05),
        omitted: Vec::new(),
        warnings: Vec::new(),
        origin: Origin::default(),
    }
}

#[test]
fn a_page_holds_what_the_graph_holds() {
    let graph = graph();
    let paths = [("thing_001".to_owned(), "/Props/Mug".to_owned())].into();
    let page = describe(&graph, "a scene", &paths, color);
    let document = &page.document;
    assert_eq!((document.sort, document.antialiased, document.near), ("distance", true, 0.05));
    assert_eq!((document.timeline.start, document.timeline.end), (0.0, 4.0));
    assert_eq!(document.cameras[0].name, "front");
    let shot = document.cameras[0].samples[0];
    assert_eq!(shot.pose, [0.0, 0.0, -5.0, 1.0, 0.0, 0.0, 0.0]);
    let [mug, parts, jelly] = document.nodes.as_slice() else { panic!("{} nodes", document.nodes.len()) };
    assert_eq!((mug.path.as_str(), parts.path.as_str()), ("/Props/Mug", "/World/thing_002"));
    assert_eq!((mug.kind, mug.id, mug.color), (Kind::Instance, Some(1), [1, 7, 9]));
    assert_eq!(mug.track.codes, [0.0, 4.0]);
    assert_eq!((mug.visibility[0].code, mug.visibility[0].visible), (3.0, false));
    assert_eq!(parts.track.poses, [[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]], "it stays at its pivot");
    assert_eq!(parts.parts.iter().map(|part| (part.first, part.count)).collect::<Vec<_>>(), [(0, 3), (3, 5)]);
    assert_eq!(jelly.opacities.as_ref().unwrap().codes, [0.0, 4.0]);

    let bytes = &page.bytes;
    for (node, original) in document.nodes.iter().zip(&graph.nodes) {
        let (splats, original) = (&node.splats, &original.splats);
        assert_eq!(splats.count, original.len());
        assert_eq!(read(splats.centres, bytes), original.means.as_flattened());
        let near = |stored: Vec<f32>, values: &[f32], most: f32| {
            assert_eq!(stored.len(), values.len());
            for (stored, value) in stored.iter().zip(values) {
                assert!((stored - value).abs() <= most, "{stored} is not {value}");
            }
        };
        near(read(splats.orientations, bytes), original.orientations.as_flattened(), 2e-5);
        near(read(splats.scales, bytes), original.scales.as_flattened(), 1e-4);
        assert_eq!(
            read(splats.opacities, bytes),
            original.opacities,
            "edits of some leave the others as they are"
        );
        let rows: Vec<f32> = read(splats.base, bytes)
            .chunks(3)
            .zip(read(splats.higher.unwrap(), bytes).chunks(9))
            .flat_map(|(base, higher)| base.iter().chain(higher).copied().collect::<Vec<_>>())
            .collect();
        near(rows, &original.sh_coefficients, 3e-3);
    }
    let offsets = read(jelly.deformation.as_ref().unwrap().offsets, bytes);
    assert_eq!(offsets.len(), 2 * 6 * 3);
    assert!((offsets[18] - 0.3).abs() < 1e-5 && offsets[19].abs() < 1e-5 && (offsets[20] + 0.3).abs() < 1e-5);
    let [low, high] = jelly.extent;
    let first = graph.nodes[2].boxes().local(0.0);
    assert!(high[0] > first.high.x + 0.25 && low[2] < first.low.z - 0.25, "the box holds all times");
}

#[test]
fn cameras_say_what_is_up_where_the_declared_axis_is_not() {
    let camera = |rotation: DMat3| PinholeCamera {
        width: 4,
        height: 4,
        focal_px: DVec2::ONE,
        principal_px: DVec2::ONE,
        camera_from_world: RigidTransform { rotation, translation: DVec3::ZERO },
    };
    // Looks along +y with its own y down, and is tilted by 40 degrees.
    let upright = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
    let tilted = DMat3::from_rotation_x(40_f64.to_radians()) * upright;
    assert_eq!(up(UpAxis::Z, [&camera(upright), &camera(tilted)]), [0.0, 0.0, 1.0]);
    assert_eq!(up(UpAxis::Y, []), [0.0, 1.0, 0.0]);
    let found = DVec3::from_array(up(UpAxis::Z, [&camera(DMat3::IDENTITY)]));
    assert!(found.distance(DVec3::NEG_Y) < 1e-12, "{found}");
}

#[test]
fn labels_do_not_end_the_data_of_a_page() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.html");
    let summary = export(&graph(), &path, ExportOptions::default(), color).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!((summary.nodes, summary.splats, summary.bytes), (3, 22, text.len() as u64));
    assert!(text.contains("\\u003c/script>\\u003cb>box") && !text.contains("</script><b>"));
    assert_eq!(text.matches("</script>").count(), 3);
    assert!(text.contains("connect-src 'none'"));
}

#[test]
fn pages_of_others_stay_and_are_not_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("index.html");
    std::fs::write(&path, "<!doctype html>\n<p>mine</p>").unwrap();
    let refused = export(&graph(), &path, ExportOptions::default(), color).unwrap_err().to_string();
    assert!(refused.contains("was not written by cif") && refused.contains("--force"), "{refused}");
    assert!(std::fs::read_to_string(&path).unwrap().contains("mine"));
    export(&graph(), &path, ExportOptions { force: true, ..ExportOptions::default() }, color).unwrap();
    export(&graph(), &path, ExportOptions::default(), color).unwrap();
    let message = HTML.read(&path, ReadOptions::default()).unwrap_err().to_string();
    assert!(message.contains("made to be looked at") && message.contains(".usda"), "{message}");
}
