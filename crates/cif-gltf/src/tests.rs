//! Round trips and what comes of edited files.

use std::path::Path;

use cif_scene::{
    CaptureFrame, Motion, MotionModel, NodeKind, PoseSample, SceneGraph, UpAxis, VisibilitySample,
};
use glam::{DMat3, DVec3};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::testing::{Numbers, Recipe, recipes, scene};

fn recipe() -> Recipe {
    Recipe {
        seed: 7,
        nodes: 4,
        splats: 5,
        sh_degree: 3,
        frames: 6,
        first_frame: 10,
        up_axis: UpAxis::Z,
        meters_per_unit: 1.0,
        frame: CaptureFrame::default(),
    }
}

fn round_trip(graph: &SceneGraph, name: &str) -> SceneGraph {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    let summary = export(graph, &path, ExportOptions::default()).unwrap();
    let bytes: u64 = summary.files.iter().map(|file| file.metadata().unwrap().len()).sum();
    assert_eq!(summary.bytes, bytes);
    read_scene(&path).unwrap()
}

/// The graph with its poses rounded to single precision, in which glTF holds them.
fn rounded(mut graph: SceneGraph) -> SceneGraph {
    let round = |v: DVec3| v.as_vec3().as_dvec3();
    let pose = |pose: &mut PoseSample| {
        pose.translation = round(pose.translation);
        pose.rotation = pose.rotation.as_quat().as_dquat();
    };
    for node in &mut graph.nodes {
        match &mut node.motion {
            Motion::Static => {}
            Motion::Rigid(track) => track.iter_mut().for_each(pose),
            Motion::Parts(motion) => {
                motion.track.iter_mut().for_each(pose);
                motion.parts.iter_mut().flat_map(|part| &mut part.track).for_each(pose);
            }
            // Dense motion is compared by what it places.
            Motion::Dense(_) => {}
        }
    }
    graph
}

/// Cameras to single precision and everything else exactly; the box of parts is derived.
fn assert_same(written: &SceneGraph, read: &SceneGraph) {
    let mut expected = rounded(written.clone());
    let mut found = read.clone();
    for (a, b) in expected.cameras.iter_mut().zip(&mut found.cameras) {
        assert_eq!((&a.name, &a.label, a.samples.len()), (&b.name, &b.label, b.samples.len()));
        for (a, b) in a.samples.iter_mut().zip(&b.samples) {
            let (from, to) = (a.camera.camera_from_world, b.camera.camera_from_world);
            assert!((from.translation - to.translation).length() < 2e-6, "{from:?} {to:?}");
            let turn: DMat3 = from.rotation - to.rotation;
            assert!(turn.to_cols_array().iter().all(|v| v.abs() < 1e-6), "{from:?} {to:?}");
            a.camera.camera_from_world = to;
        }
    }
    for (a, b) in expected.nodes.iter_mut().zip(&mut found.nodes) {
        if let Motion::Parts(_) = a.motion {
            a.extent = b.extent;
        }
        assert_eq!(a, b);
    }
    assert_eq!(expected, found);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn scenes_come_back_as_they_were_written(recipe in recipes(), text: bool) {
        let graph = scene(recipe);
        let read = round_trip(&graph, if text { "a b%.gltf" } else { "scene.glb" });
        assert_same(&graph, &read);
        // A second time nothing is rounded any more.
        let again = round_trip(&read, "scene.glb");
        prop_assert_eq!(&again.nodes, &read.nodes);
    }
}

/// Writes a scene as `.gltf`, changes its JSON, and reads it.
fn edited(graph: &SceneGraph, edit: impl FnOnce(&mut Value)) -> Result<SceneGraph, GltfError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.gltf");
    export(graph, &path, ExportOptions::default()).unwrap();
    edit_file(&path, edit);
    read_scene(&path)
}

fn edit_file(path: &Path, edit: impl FnOnce(&mut Value)) {
    let mut json: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    edit(&mut json);
    std::fs::write(path, json.to_string()).unwrap();
}

fn node_index(json: &Value, name: &str) -> usize {
    json["nodes"].as_array().unwrap().iter().position(|node| node["name"] == name).unwrap()
}

#[test]
fn hidden_objects_say_so_by_the_extensions_of_visibility() {
    let mut graph = scene(recipe());
    let codes = graph.time_codes.samples.clone();
    let sample = |code: usize, visible| VisibilitySample { time_code: codes[code], visible };
    graph.nodes[0].visibility = vec![sample(0, false), sample(2, true)];
    let mut used = Vec::new();
    // A player that knows only the extensions, not the scale that stands in for them.
    let by_extensions = edited(&graph, |json| {
        used = json["extensionsUsed"].as_array().unwrap().clone();
        let index = node_index(json, &graph.nodes[0].name);
        let node = json["nodes"][index].as_object_mut().unwrap();
        assert_eq!(node["extensions"], json!({ "KHR_node_visibility": { "visible": false } }));
        node.remove("scale").unwrap();
        let channels = json["animations"][0]["channels"].as_array_mut().unwrap();
        channels.retain(|channel| channel["target"]["path"] != "scale");
        let pointers = channels.iter().filter(|channel| channel["target"]["path"] == "pointer");
        assert!(pointers.clone().all(|channel| channel["target"].get("node").is_none()));
        let pointed = format!("/nodes/{index}/extensions/KHR_node_visibility/visible");
        let named = |channel: &Value| {
            channel["target"]["extensions"]["KHR_animation_pointer"]["pointer"] == json!(pointed)
        };
        assert_eq!(pointers.filter(|channel| named(channel)).count(), 1);
    });
    assert!(used.contains(&json!("KHR_node_visibility")) && used.contains(&json!("KHR_animation_pointer")));
    assert_eq!(by_extensions.unwrap().nodes[0].visibility, graph.nodes[0].visibility);
    assert_same(&graph, &round_trip(&graph, "scene.glb"));
}

#[test]
fn a_far_scene_stands_in_the_world_of_its_capture() {
    let frame = CaptureFrame { offset: [3e6, -2e5, 40.0], scale: 0.1 };
    let graph = scene(Recipe { frame, meters_per_unit: 0.5, ..recipe() });
    let mut root = Value::Null;
    let read = edited(&graph, |json| root = json["nodes"][node_index(json, "World")].clone()).unwrap();
    assert_same(&graph, &read);
    // Metres, +y up: half of the offset, turned; a unit of the scene is ten of the capture's half metres.
    assert!(root["translation"].to_string().len() > 20, "double precision: {root}");
    for (value, expected) in root["translation"].as_array().unwrap().iter().zip([1.5e6, 20.0, 1e5]) {
        assert!((value.as_f64().unwrap() - expected).abs() < 1e-6, "{root}");
    }
    assert_eq!(root["scale"], json!([5.0, 5.0, 5.0]));
    assert_eq!(root["extras"]["cif"]["frame"], json!(frame));
    // A root that is moved takes everything along, in units of the scene.
    let moved = edited(&graph, |json| {
        let root = node_index(json, "World");
        json["nodes"][root]["translation"][0] = json!(1.5e6 + 10.0);
    })
    .unwrap();
    assert!(
        moved.warnings.iter().any(|warning| warning.contains("\"World\" was moved")),
        "{:?}",
        moved.warnings
    );
    for (a, b) in graph.nodes.iter().zip(&moved.nodes) {
        let code = graph.time_codes.start();
        let apart = b.world_transform(code).translation - a.world_transform(code).translation;
        assert!((apart - 2.0 * DVec3::X).length() < 0.05, "{apart}");
    }
    let nowhere = edited(&graph, |json| {
        let root = node_index(json, "World");
        json["nodes"][root]["extras"]["cif"]["frame"]["scale"] = json!(0.0);
    });
    assert!(nowhere.unwrap_err().to_string().contains("places the scene nowhere"));
    // Ordinary scenes say nothing of it.
    edited(&scene(recipe()), |json| {
        let root = &json["nodes"][node_index(json, "World")];
        assert!(root.get("translation").is_none() && root["extras"]["cif"].get("frame").is_none(), "{root}");
    })
    .unwrap();
}

#[test]
fn moved_renamed_deleted_and_copied_objects_come_home() {
    let graph = scene(recipe());
    let read = edited(&graph, |json| {
        // thing_001 stands still: moved and renamed.
        let moved = node_index(json, "thing_001");
        json["nodes"][moved]["translation"] = json!([5.0, 6.0, 7.0]);
        json["nodes"][moved]["name"] = json!("blue mug");
        // thing_003 is deleted, thing_000 copied.
        let (deleted, copied) = (node_index(json, "thing_003"), node_index(json, "thing_000"));
        let world = node_index(json, "World");
        let mut copy = json["nodes"][copied].clone();
        copy["name"] = json!("thing_000.001");
        let nodes = json["nodes"].as_array_mut().unwrap();
        nodes.push(copy);
        let added = nodes.len() - 1;
        let children = json["nodes"][world]["children"].as_array_mut().unwrap();
        children.retain(|child| *child != json!(deleted));
        children.push(json!(added));
    })
    .unwrap();
    let names: Vec<&str> = read.nodes.iter().map(|node| node.label.as_str()).collect();
    assert_eq!(names, ["thing_000 杯", "thing_001 杯", "thing_002 杯", "thing_000 杯", "background 杯"]);
    assert_eq!(read.nodes[1].name, "blue_mug", "the label is left to whoever applies the edit");
    assert_eq!(read.nodes[1].pivot, DVec3::new(5.0, 6.0, 7.0));
    assert_eq!(read.nodes[1].motion, Motion::Static);
    assert_eq!(read.nodes[3].splats, read.nodes[0].splats, "rows identify what was copied");
    let ids: Vec<NodeKind> = read.nodes.iter().map(|node| node.kind).collect();
    assert_eq!(ids[3], NodeKind::Instance { id: 2, index: 3 }, "an id of its own: {ids:?}");
    assert!(read.warnings.iter().any(|warning| warning.contains("repeats thing_000")), "{:?}", read.warnings);
}

#[test]
fn turned_and_scaled_objects_come_home() {
    let graph = scene(recipe());
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let read = edited(&graph, |json| {
        let node = node_index(json, "thing_001");
        json["nodes"][node]["rotation"] = json!([0.0, 0.0, half, half]);
        json["nodes"][node]["scale"] = json!([2.0, 2.0, 2.0]);
    })
    .unwrap();
    let (before, after) = (&graph.nodes[1], &read.nodes[1]);
    let Motion::Rigid(track) = &after.motion else { panic!("{:?}", after.motion) };
    assert_eq!(track.len(), 1);
    assert!((track[0].rotation * DVec3::X - DVec3::Y).length() < 1e-6);
    assert_eq!(after.splats.scales[0], before.splats.scales[0].map(|scale| 2.0 * scale));
    assert_eq!(after.splats.sh_coefficients, before.splats.sh_coefficients);
}

#[test]
fn a_moved_world_moves_everything() {
    let graph = scene(recipe());
    let read = edited(&graph, |json| {
        let world = node_index(json, "World");
        // +y of glTF is +z of the scene.
        json["nodes"][world]["translation"] = json!([0.0, 1.0, 0.0]);
    })
    .unwrap();
    for (before, after) in graph.nodes.iter().zip(&read.nodes) {
        for code in [10.0, 14.0, 20.0] {
            let (a, b) = (before.world_transform(code), after.world_transform(code));
            assert!((a.translation + DVec3::Z - b.translation).length() < 1e-5, "{a:?} {b:?}");
            assert!((a.rotation - b.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-5));
        }
        assert_eq!(before.splats.scales.len(), after.splats.scales.len());
    }
    assert!(read.warnings.iter().any(|warning| warning.contains("was moved")));
}

/// Numbers of an accessor of floats.
fn floats(json: &Value, bytes: &[u8], accessor: &Value) -> Vec<f64> {
    let accessor = &json["accessors"][accessor.as_u64().unwrap() as usize];
    let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
    let start = view["byteOffset"].as_u64().unwrap() as usize;
    let end = start + view["byteLength"].as_u64().unwrap() as usize;
    bytes[start..end].chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap()))).collect()
}

#[test]
fn viewers_that_do_not_slerp_turn_objects_as_the_file_says() {
    // Random tracks turn by up to half a turn between their keys.
    let graph = scene(Recipe { nodes: 8, frames: 9, ..recipe() });
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.gltf");
    export(&graph, &path, ExportOptions::default()).unwrap();
    let json: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    let bytes = std::fs::read(path.with_extension("bin")).unwrap();
    let animation = &json["animations"][0];
    let (mut checked, mut inserted) = (0, 0);
    for channel in animation["channels"].as_array().unwrap() {
        if channel["target"]["path"] != "rotation" {
            continue;
        }
        let name =
            json["nodes"][channel["target"]["node"].as_u64().unwrap() as usize]["name"].as_str().unwrap();
        let Some(node) = graph.nodes.iter().find(|node| node.name == name) else { continue };
        let sampler = &animation["samplers"][channel["sampler"].as_u64().unwrap() as usize];
        inserted += sampler["extras"]["cif"]["inserted"].as_array().map_or(0, Vec::len);
        let times = floats(&json, &bytes, &sampler["input"]);
        let values = floats(&json, &bytes, &sampler["output"]);
        let allowed = 1.02 * rotation_keys::allowed_error(&node.report) + 1e-6;
        for (key, ends) in times.windows(2).enumerate() {
            for t in [0.11, 0.21, 0.5, 0.79, 0.93] {
                // What PlayCanvas does: component by component, then to unit length.
                let at = |k: usize| glam::DVec4::from_slice(&values[4 * k..4 * k + 4]);
                let drawn = glam::DQuat::from_vec4(at(key).lerp(at(key + 1), t)).normalize();
                let code = 10.0 + 30.0 * (ends[0] + t * (ends[1] - ends[0]));
                let meant = cif_scene::graph::pose_at(node.track(), node.pivot, code).rotation;
                let apart = meant.inverse() * drawn;
                let angle = 2.0 * DVec3::new(apart.x, apart.y, apart.z).length().asin();
                assert!(angle < allowed, "{name} at {code}: {angle} > {allowed}");
                checked += 1;
            }
        }
    }
    assert!(checked > 100 && inserted > 50, "{checked} {inserted}");
}

#[test]
fn splats_with_paths_of_their_own_come_back() {
    for (frames, changes) in [(6, true), (6, false), (1, true)] {
        let mut graph = scene(Recipe { frames, ..recipe() });
        let mut numbers = Numbers::new(3);
        let node = graph.nodes.last_mut().unwrap();
        let motion = numbers.dense(&mut node.splats, &graph.time_codes.samples, changes);
        node.report.model = MotionModel::Dense;
        node.motion = Motion::Dense(motion.clone());
        let written = graph.nodes.last().unwrap();
        let read = round_trip(&graph, "scene.glb");
        let node = read.nodes.last().unwrap();
        if frames == 1 {
            // Nothing moves: how it stands is a pose of its splats.
            assert_eq!(node.splats.len(), written.splats.len());
            continue;
        }
        let Motion::Dense(back) = &node.motion else { panic!("{:?}", node.model()) };
        assert_eq!(back.samples.len(), motion.samples.len());
        let near = |a: &[f32], b: &[f32], what: &str| {
            assert!(a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-6), "{what}");
        };
        for (a, b) in motion.samples.iter().zip(&back.samples) {
            assert_eq!(a.time_code, b.time_code);
            near(a.means.as_flattened(), b.means.as_flattened(), "means");
            for (a, b) in a.orientations.iter().zip(&b.orientations) {
                let cosine: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                near(&a.map(|value| value * cosine.signum()), b, "orientations");
            }
            let scales = a.scales.as_ref().unwrap_or(&written.splats.scales);
            near(scales.as_flattened(), b.scales.as_ref().unwrap().as_flattened(), "scales");
        }
        near(&written.splats.sh_coefficients, &node.splats.sh_coefficients, "colours");
        assert_eq!(written.splats.rows, node.splats.rows);
        assert_eq!(written.report, node.report);
    }
}

#[test]
fn dense_motion_of_many_splats_is_refused() {
    let mut graph = scene(Recipe { splats: cif_scene::LOOSE_SPLATS, ..recipe() });
    let codes = graph.time_codes.samples.clone();
    let refused = |graph: &SceneGraph| {
        let folder = tempfile::tempdir().unwrap();
        let error = export(graph, &folder.path().join("scene.glb"), ExportOptions::default()).unwrap_err();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        error.to_string()
    };
    let node = &mut graph.nodes[0];
    let motion = Numbers::new(3).dense(&mut node.splats, &codes, true);
    node.motion = Motion::Dense(motion.clone());
    let error = refused(&graph);
    assert!(error.starts_with("thing_000 moves splat by splat, which glTF holds of 200"), "{error}");
    graph.nodes.remove(0);
    let last = graph.nodes.last_mut().unwrap();
    let mut wrong = Numbers::new(3).dense(&mut last.splats, &codes, true);
    wrong.samples[1].means.pop();
    last.motion = Motion::Dense(wrong);
    assert!(refused(&graph).contains("samples do not fit to its splats"));
}

#[test]
fn foreign_files_are_not_replaced() {
    let graph = scene(recipe());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.glb");
    export(&graph, &path, ExportOptions::default()).unwrap();
    export(&graph, &path, ExportOptions::default()).expect("ours may be replaced");
    std::fs::write(&path, b"glTF and something else").unwrap();
    let error = export(&graph, &path, ExportOptions::default()).unwrap_err();
    assert!(error.to_string().contains("was not written by cif"), "{error}");
    assert_eq!(std::fs::read(&path).unwrap(), b"glTF and something else");
    export(&graph, &path, ExportOptions { force: true, ..ExportOptions::default() }).unwrap();
    let text = folder.path().join("other.gltf");
    std::fs::write(text.with_extension("bin"), b"precious").unwrap();
    let error = export(&graph, &text, ExportOptions::default()).unwrap_err();
    assert!(error.to_string().contains("other.bin exists"), "{error}");
    for (name, says) in [("scene.usd", "the ending decides"), ("no/scene.glb", "no such folder")] {
        let error = check_target(&folder.path().join(name), ExportOptions::default()).unwrap_err();
        assert!(error.to_string().contains(says), "{error}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "no temporary file is left");
}

#[test]
fn values_that_cannot_be_drawn_are_refused() {
    let mut graph = scene(recipe());
    graph.nodes[1].splats.means[0][1] = f32::NAN;
    let folder = tempfile::tempdir().unwrap();
    let error = export(&graph, &folder.path().join("a.glb"), ExportOptions::default()).unwrap_err();
    assert!(error.to_string().contains("thing_001 cannot be written"), "{error}");
}

#[test]
fn labels_change_and_everything_else_stays() {
    let graph = scene(recipe());
    let instance = graph.nodes.iter().find(|node| node.kind != NodeKind::Background).unwrap();
    let NodeKind::Instance { id, .. } = instance.kind else { unreachable!() };
    for ending in ["glb", "gltf"] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(format!("scene.{ending}"));
        export(&graph, &path, ExportOptions::default()).unwrap();
        let before = read_scene(&path).unwrap();
        let files = || std::fs::read_dir(folder.path()).unwrap().count();
        let count = files();
        let done = relabel(&path, &path, &id.to_string(), "blaue Tasse \u{676f}", Some("mug")).unwrap();
        assert_eq!((&done.object, &done.before), (&instance.name, &instance.label));
        assert_eq!(files(), count, "no temporary file is left");
        let mut expected = before.clone();
        for node in expected.nodes.iter_mut().filter(|node| node.name == instance.name) {
            node.label = "blaue Tasse \u{676f}".to_owned();
            node.category = "mug".to_owned();
        }
        assert_eq!(read_scene(&path).unwrap(), expected);

        // Into another file, by name; a file next to a .gltf is not found from elsewhere.
        let copy = folder.path().join(format!("copy.{ending}"));
        relabel(&path, &copy, &instance.name, "cup", None).unwrap();
        assert!(
            read_scene(&copy).unwrap().nodes.iter().any(|node| node.label == "cup" && node.category == "mug")
        );
        let elsewhere = tempfile::tempdir().unwrap();
        let moved =
            relabel(&path, &elsewhere.path().join(format!("a.{ending}")), &instance.name, "cup", None);
        assert_eq!(moved.is_ok(), ending == "glb");

        let message = relabel(&path, &path, "60000", "x", None).unwrap_err().to_string();
        assert!(message.contains("60000") && message.contains(&instance.name), "{message}");
        let message = relabel(&path, Path::new("a.txt"), &instance.name, "x", None).unwrap_err().to_string();
        assert!(message.contains("another ending"), "{message}");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..40]).unwrap();
        assert!(relabel(&path, &path, &instance.name, "x", None).is_err());
        assert_eq!(std::fs::read(&path).unwrap(), bytes[..40], "nothing is touched");
    }
}
