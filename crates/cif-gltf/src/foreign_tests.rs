//! Files of other programs, and damaged ones.

use std::path::{Path, PathBuf};

use base64::Engine;
use cif_scene::{Motion, SceneGraph, Splats};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::testing::Numbers;
use crate::{EXTENSION, read_scene};

/// A file in the making: JSON next to one buffer.
struct File {
    json: Value,
    bytes: Vec<u8>,
}

impl File {
    fn new() -> Self {
        Self {
            json: json!({
                "asset": { "version": "2.0" }, "extensionsUsed": [EXTENSION], "scene": 0,
                "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0, "name": "thing" }],
                "meshes": [], "accessors": [], "bufferViews": [], "buffers": [{}],
            }),
            bytes: Vec::new(),
        }
    }

    fn push(&mut self, list: &str, value: Value) -> usize {
        let list = self.json[list].as_array_mut().unwrap();
        list.push(value);
        list.len() - 1
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let offset = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        self.push("bufferViews", json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() }))
    }

    fn accessor(
        &mut self,
        bytes: &[u8],
        component: u32,
        kind: &str,
        count: usize,
        normalized: bool,
    ) -> usize {
        let view = self.view(bytes);
        let accessor = json!({
            "bufferView": view, "componentType": component, "type": kind, "count": count, "normalized": normalized
        });
        self.push("accessors", accessor)
    }

    fn floats(&mut self, values: &[f32], kind: &str) -> usize {
        let width = match kind {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.accessor(&bytes, 5126, kind, values.len() / width, false)
    }

    /// A mesh of one primitive with these splats.
    fn mesh(&mut self, splats: &Splats) -> usize {
        let position = self.floats(splats.means.as_flattened(), "VEC3");
        let turns: Vec<f32> = splats.orientations.iter().flat_map(|&[w, x, y, z]| [x, y, z, w]).collect();
        let mut attributes = json!({ "POSITION": position });
        let mut set =
            |name: &str, accessor: usize| attributes[format!("{EXTENSION}:{name}")] = json!(accessor);
        set("ROTATION", self.floats(&turns, "VEC4"));
        set("SCALE", self.floats(splats.scales.as_flattened(), "VEC3"));
        set("OPACITY", self.floats(&splats.opacities, "SCALAR"));
        let count = (usize::from(splats.sh_degree) + 1).pow(2);
        for degree in 0..=usize::from(splats.sh_degree) {
            for order in 0..2 * degree + 1 {
                let at = 3 * (degree * degree + order);
                let rows = splats.sh_coefficients.chunks_exact(3 * count);
                let values: Vec<f32> = rows.flat_map(|row| row[at..at + 3].to_vec()).collect();
                set(&format!("SH_DEGREE_{degree}_COEF_{order}"), self.floats(&values, "VEC3"));
            }
        }
        let settings = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
        let primitive = json!({ "mode": 0, "attributes": attributes, "extensions": { EXTENSION: settings } });
        self.push("meshes", json!({ "name": "mesh", "primitives": [primitive] }))
    }

    fn with(splats: &Splats) -> Self {
        let mut file = Self::new();
        file.mesh(splats);
        file
    }

    fn attributes(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]["attributes"]
    }

    fn accessor_of(&mut self, name: &str) -> &mut Value {
        let index = self.attributes()[name].as_u64().unwrap() as usize;
        &mut self.json["accessors"][index]
    }

    /// A key track of node 0.
    fn animate(&mut self, path: &str, interpolation: &str, times: &[f32], values: &[f32], kind: &str) {
        let input = self.floats(times, "SCALAR");
        let output = self.floats(values, kind);
        if self.json["animations"].is_null() {
            self.json["animations"] = json!([{ "channels": [], "samplers": [] }]);
        }
        let animation = &mut self.json["animations"][0];
        let samplers = animation["samplers"].as_array_mut().unwrap();
        samplers.push(json!({ "input": input, "output": output, "interpolation": interpolation }));
        let sampler = samplers.len() - 1;
        let channel = json!({ "sampler": sampler, "target": { "node": 0, "path": path } });
        animation["channels"].as_array_mut().unwrap().push(channel);
    }

    fn data_uri(&self) -> String {
        let engine = base64::engine::general_purpose::STANDARD;
        format!("data:application/octet-stream;base64,{}", engine.encode(&self.bytes))
    }

    /// JSON with the buffer inside.
    fn text(&mut self) -> Vec<u8> {
        if self.json["buffers"][0]["byteLength"].is_null() {
            self.json["buffers"][0]["byteLength"] = json!(self.bytes.len());
        }
        if self.json["buffers"][0]["uri"].is_null() {
            self.json["buffers"][0]["uri"] = json!(self.data_uri());
        }
        self.json.to_string().into_bytes()
    }

    fn read(&mut self) -> Result<SceneGraph, String> {
        let text = self.text();
        read_bytes(&text)
    }

    fn fails(&mut self, says: &[&str]) {
        let error = self.read().unwrap_err();
        for words in says {
            assert!(error.contains(words), "'{words}' is not in: {error}");
        }
    }
}

fn read_bytes(bytes: &[u8]) -> Result<SceneGraph, String> {
    let (_folder, path) = placed(bytes);
    read_scene(&path).map_err(|error| error.to_string())
}

fn placed(bytes: &[u8]) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("foreign file.gltf");
    std::fs::write(&path, bytes).unwrap();
    (folder, path)
}

fn splats(count: usize, degree: u8) -> Splats {
    Numbers::new(11).splats(count, degree, 0)
}

fn covariance(splats: &Splats, k: usize) -> DMat3 {
    let [w, x, y, z] = splats.orientations[k].map(f64::from);
    let scale = DVec3::from_array(splats.scales[k].map(f64::from));
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()) * DMat3::from_diagonal(scale);
    axes * axes.transpose()
}

/// Every splat of the node stands in the world where `matrix` puts it.
fn assert_placed(before: &Splats, graph: &SceneGraph, time_code: f64, matrix: &DAffine3) {
    let node = &graph.nodes[0];
    let world = node.world_transform(time_code);
    for k in 0..before.len() {
        let mean = |splats: &Splats| DVec3::from_array(splats.means[k].map(f64::from));
        let (expected, found) = (matrix.transform_point3(mean(before)), world.apply(mean(&node.splats)));
        assert!((expected - found).length() < 1e-5, "{expected} {found}");
        let expected = matrix.matrix3 * covariance(before, k) * matrix.matrix3.transpose();
        let found = world.rotation * covariance(&node.splats, k) * world.rotation.transpose();
        let size = expected.to_cols_array().iter().fold(0.0_f64, |all, value| all.max(value.abs()));
        assert!(
            (expected - found).to_cols_array().iter().all(|v| v.abs() < 1e-5 * size),
            "{expected} {found}"
        );
    }
}

#[test]
fn a_plain_file_is_read_exactly() {
    let splats = splats(4, 2);
    let graph = File::with(&splats).read().unwrap();
    let read = &graph.nodes[0].splats;
    assert_eq!(
        (&read.means, &read.orientations, &read.scales),
        (&splats.means, &splats.orientations, &splats.scales)
    );
    assert_eq!((&read.opacities, &read.sh_coefficients), (&splats.opacities, &splats.sh_coefficients));
    assert_eq!((read.occupancies.as_slice(), read.rows.as_slice()), (&[1.0; 4][..], &[0, 1, 2, 3][..]));
    assert_eq!((graph.nodes[0].label.as_str(), graph.nodes[0].name.as_str()), ("thing", "thing_001"));
    assert_eq!(graph.nodes[0].motion, Motion::Static);
    assert_eq!(graph.origin, cif_scene::Origin::default());
}

#[test]
fn quantised_attributes_are_decoded() {
    let mut file = File::with(&splats(2, 0));
    let turn: Vec<u8> =
        [0_i16, 0, 23_170, 23_170, -32_768, 0, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let rotation = file.accessor(&turn, 5122, "VEC4", 2, true);
    let bytes: Vec<u8> = [1_u16, 2, 3, 0, 5, 6].iter().flat_map(|v| v.to_le_bytes()).collect();
    let scale = file.accessor(&bytes, 5123, "VEC3", 2, false);
    let opacity = file.accessor(&[255, 51], 5121, "SCALAR", 2, true);
    // Positions of bytes, each in four.
    let view = file.view(&[1, 2, 253, 0, 0, 0, 127, 0]);
    file.json["bufferViews"][view]["byteStride"] = json!(4);
    let position = file
        .push("accessors", json!({ "bufferView": view, "componentType": 5120, "type": "VEC3", "count": 2 }));
    let attributes = file.attributes();
    attributes["POSITION"] = json!(position);
    attributes[format!("{EXTENSION}:ROTATION")] = json!(rotation);
    attributes[format!("{EXTENSION}:SCALE")] = json!(scale);
    attributes[format!("{EXTENSION}:OPACITY")] = json!(opacity);
    file.json["extensionsRequired"] = json!(["KHR_mesh_quantization", "KHR_materials_unlit"]);
    let graph = file.read().unwrap();
    let read = &graph.nodes[0].splats;
    assert_eq!(read.means, [[1.0, 2.0, -3.0], [0.0, 0.0, 127.0]]);
    assert_eq!(read.scales[0], [1.0, 2.0, 3.0]);
    assert_eq!(read.scales[1][0], 0.0, "a flat splat stays flat");
    assert_eq!(read.opacities, [1.0, 0.2]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    assert!((read.orientations[0][0] - half).abs() < 1e-6 && (read.orientations[0][3] - half).abs() < 1e-6);
    assert_eq!(read.orientations[1], [0.0, -1.0, 0.0, 0.0]);
}

#[test]
fn sparse_and_interleaved_accessors_are_read() {
    let splats = splats(3, 0);
    let mut file = File::with(&splats);
    // Opacities: zeros with one value put in, at index 2.
    let indices = file.view(&[2]);
    let values = file.view(&0.75_f32.to_le_bytes());
    let sparse = file.push(
        "accessors",
        json!({ "componentType": 5126, "type": "SCALAR", "count": 3, "sparse": {
            "count": 1, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values } } }),
    );
    // Positions and scales in one view.
    let rows = splats.means.iter().zip(&splats.scales);
    let bytes: Vec<u8> = rows
        .flat_map(|(mean, scale)| mean.iter().chain(scale).flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
        .collect();
    let view = file.view(&bytes);
    file.json["bufferViews"][view]["byteStride"] = json!(24);
    let at = |offset: usize| json!({ "bufferView": view, "byteOffset": offset, "componentType": 5126, "type": "VEC3", "count": 3 });
    let (position, scale) = (file.push("accessors", at(0)), file.push("accessors", at(12)));
    let attributes = file.attributes();
    attributes["POSITION"] = json!(position);
    attributes[format!("{EXTENSION}:SCALE")] = json!(scale);
    attributes[format!("{EXTENSION}:OPACITY")] = json!(sparse);
    let read = file.read().unwrap().nodes.remove(0).splats;
    assert_eq!(
        (read.means, read.scales, read.opacities),
        (splats.means, splats.scales, vec![0.0, 0.0, 0.75])
    );
}

#[test]
fn hierarchies_scales_and_mirrors_are_worked_in() {
    let splats = splats(5, 3);
    let mut file = File::with(&splats);
    let parent = DAffine3::from_scale_rotation_translation(
        DVec3::new(2.0, 0.5, -1.0),
        DQuat::from_rotation_y(0.7),
        DVec3::new(1.0, 2.0, 3.0),
    );
    let child = DAffine3::from_scale_rotation_translation(
        DVec3::new(1.5, 1.0, 0.3),
        DQuat::from_rotation_x(-1.1),
        DVec3::new(0.0, -1.0, 0.5),
    );
    let matrix = glam::DMat4::from(child).to_cols_array();
    file.json["nodes"] = json!([
        { "name": "group", "translation": [1.0, 2.0, 3.0], "scale": [2.0, 0.5, -1.0],
          "rotation": [0.0, 0.35_f64.sin(), 0.0, 0.35_f64.cos()], "children": [1] },
        { "mesh": 0, "matrix": matrix },
    ]);
    let graph = file.read().unwrap();
    assert_eq!(graph.nodes[0].label, "group", "the nearest name");
    assert_placed(&splats, &graph, 0.0, &(parent * child));
    let Motion::Rigid(track) = &graph.nodes[0].motion else { panic!("{:?}", graph.nodes[0].motion) };
    assert_eq!(track.len(), 1, "turned, but still");
}

#[test]
fn several_primitives_and_meshes_become_objects() {
    let mut file = File::with(&splats(2, 1));
    let second = file.mesh(&splats(3, 3));
    let primitive = file.json["meshes"][second]["primitives"][0].clone();
    file.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(primitive);
    file.json["nodes"] =
        json!([{ "name": "a", "mesh": 0 }, { "name": "a", "mesh": 1, "translation": [0.0, 0.0, 4.0] }]);
    file.json["scenes"] = json!([{ "nodes": [0, 1] }]);
    let graph = file.read().unwrap();
    let shapes: Vec<(usize, u8)> =
        graph.nodes.iter().map(|node| (node.splats.len(), node.splats.sh_degree)).collect();
    assert_eq!(shapes, [(5, 3), (3, 3)], "the highest degree of a mesh counts for all of it");
    assert!(graph.nodes[0].splats.sh_coefficients[12..48].iter().all(|value| *value == 0.0));
    let names: Vec<&str> = graph.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["a_001", "a_002"]);
    assert_eq!(graph.nodes[1].pivot, DVec3::Z * 4.0);
    assert_eq!(graph.nodes[1].splats.rows, [5, 6, 7]);
}

#[test]
fn curves_are_followed() {
    let splats = splats(2, 0);
    let mut file = File::with(&splats);
    // A parabola as a spline: x = t^2, with tangents 2 t.
    let spline = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0];
    file.animate("translation", "CUBICSPLINE", &[0.0, 1.0], &spline, "VEC3");
    let half = std::f32::consts::FRAC_1_SQRT_2;
    file.animate("rotation", "LINEAR", &[0.0, 1.0], &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, half, half], "VEC4");
    let steps = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0];
    file.animate("scale", "STEP", &[0.0, 0.25, 0.5], &steps, "VEC3");
    let graph = file.read().unwrap();
    let node = &graph.nodes[0];
    for frame in 0..=24 {
        let t = f64::from(frame) / 24.0;
        let pose = node.world_transform(f64::from(frame));
        assert!((pose.translation - DVec3::X * t * t).length() < 1e-6, "{t}: {pose:?}");
        let turned = pose.rotation * DVec3::X;
        let angle = t * std::f64::consts::FRAC_PI_2;
        assert!((turned - DVec3::new(angle.cos(), angle.sin(), 0.0)).length() < 1e-6, "{t}: {turned}");
        assert_eq!(node.is_visible(f64::from(frame)), !(6..12).contains(&frame), "{frame}");
    }
    assert_eq!((graph.time_codes.start(), graph.time_codes.end()), (0.0, 24.0));
    assert!(graph.warnings.is_empty(), "{:?}", graph.warnings);
}

#[test]
fn stepped_motion_holds_until_the_next_key() {
    let mut file = File::with(&splats(2, 0));
    file.animate("translation", "STEP", &[0.0, 1.0], &[0.0, 0.0, 0.0, 5.0, 0.0, 0.0], "VEC3");
    let graph = file.read().unwrap();
    let x = |code: f64| graph.nodes[0].world_transform(code).translation.x;
    assert_eq!((x(0.0), x(23.9), x(24.0)), (0.0, 0.0, 5.0));
}

#[test]
fn a_moving_parent_carries_what_hangs_from_it() {
    let splats = splats(2, 0);
    let mut file = File::with(&splats);
    file.json["nodes"] =
        json!([{ "name": "cart", "children": [1] }, { "mesh": 0, "translation": [1.0, 0.0, 0.0] }]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    file.animate("rotation", "LINEAR", &[0.0, 1.0], &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, half, half], "VEC4");
    let graph = file.read().unwrap();
    let end = graph.nodes[0].world_transform(24.0).translation;
    assert!((end - DVec3::Y).length() < 1e-6, "{end}");
}

#[test]
fn linear_colours_become_display_colours() {
    let mut file = File::with(&splats(1, 0));
    let band = 0.282_094_8;
    let values = file.floats(&[(0.214_041_1 - 0.5) / band, 0.0, (1.0 - 0.5) / band], "VEC3");
    file.attributes()[format!("{EXTENSION}:SH_DEGREE_0_COEF_0")] = json!(values);
    file.json["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["colorSpace"] =
        json!("lin_rec709_display");
    let graph = file.read().unwrap();
    let colors = graph.nodes[0].splats.base_colors()[0];
    assert!((colors[0] - 0.5).abs() < 1e-4 && (colors[2] - 1.0).abs() < 1e-4, "{colors:?}");
    assert!(graph.warnings.iter().any(|warning| warning.contains("linear")));
}

#[test]
fn perspective_cameras_are_read() {
    let mut file = File::with(&splats(1, 0));
    file.json["cameras"] = json!([
        { "type": "perspective", "perspective": { "yfov": 0.8, "aspectRatio": 1.5, "znear": 0.1 } },
        { "type": "orthographic", "orthographic": { "xmag": 1.0, "ymag": 1.0, "znear": 0.1, "zfar": 9.0 } },
    ]);
    file.json["nodes"].as_array_mut().unwrap().extend([
        json!({ "name": "front view", "camera": 0, "translation": [0.0, 0.0, 5.0] }),
        json!({ "name": "plan", "camera": 1 }),
    ]);
    file.json["scenes"] = json!([{ "nodes": [0, 1, 2] }]);
    let graph = file.read().unwrap();
    assert_eq!(graph.cameras.len(), 1);
    let camera = &graph.cameras[0].samples[0].camera;
    assert_eq!(graph.cameras[0].name, "front_view");
    assert!((camera.centre() - DVec3::Z * 5.0).length() < 1e-9);
    assert!((camera.forward() - DVec3::NEG_Z).length() < 1e-9, "glTF looks along -z");
    let (pixel, _) = camera.project(DVec3::new(0.0, 5.0 * 0.4_f64.tan(), 0.0)).unwrap();
    assert!(pixel.y.abs() < 1e-3 && (pixel.x - 540.0).abs() < 1e-3, "upper edge in the middle: {pixel}");
    assert!(graph.warnings.iter().any(|warning| warning.contains("plan")));
}

#[test]
fn buffers_beside_the_file_are_read_and_none_elsewhere() {
    let mut file = File::with(&splats(2, 0));
    let bytes = file.bytes.clone();
    file.json["buffers"][0]["byteLength"] = json!(bytes.len());
    let mut with_uri = |uri: &str| {
        file.json["buffers"][0]["uri"] = json!(uri);
        let (folder, path) = placed(&file.json.to_string().into_bytes());
        std::fs::create_dir(folder.path().join("data")).unwrap();
        std::fs::write(folder.path().join("data/my buffer.bin"), &bytes).unwrap();
        std::fs::write(folder.path().join("short.bin"), &bytes[1..]).unwrap();
        (folder, read_scene(&path).map_err(|error| error.to_string()))
    };
    assert_eq!(with_uri("data/my%20buffer.bin").1.unwrap().nodes[0].splats.len(), 2);
    let cases = [
        ("../secret.bin", "leaves the folder"),
        ("data/../../secret.bin", "leaves the folder"),
        ("%2e%2e/secret.bin", "leaves the folder"),
        ("/etc/passwd", "leaves the folder"),
        ("https://example.org/a.bin", "put that file next to this one"),
        ("file:///etc/passwd", "put that file next to this one"),
        ("absent.bin", "cannot be read"),
        ("data", "it is a folder"),
        ("short.bin", "cut off"),
        ("data:application/octet-stream;base64,@@", "not base64"),
        ("data:nothing", "no data"),
        ("data:application/octet-stream;base64,AAAA", "cut off"),
    ];
    for (uri, says) in cases {
        let error = with_uri(uri).1.unwrap_err();
        assert!(error.contains(says) && error.contains("buffer 0"), "{uri}: {error}");
    }
}

#[cfg(unix)]
#[test]
fn links_do_not_lead_out_of_the_folder() {
    let mut file = File::with(&splats(1, 0));
    let outside = tempfile::tempdir().unwrap();
    std::fs::write(outside.path().join("a.bin"), &file.bytes).unwrap();
    file.json["buffers"][0] = json!({ "byteLength": file.bytes.len(), "uri": "link.bin" });
    let (folder, path) = placed(&file.json.to_string().into_bytes());
    std::os::unix::fs::symlink(outside.path().join("a.bin"), folder.path().join("link.bin")).unwrap();
    let error = read_scene(&path).unwrap_err().to_string();
    assert!(error.contains("leaves the folder"), "{error}");
}

/// One damage to a good file, and the words of the message.
type Damage = (fn(&mut File), &'static [&'static str]);

#[test]
fn damaged_files_say_what_is_wrong() {
    let name = |name: &str| format!("{EXTENSION}:{name}");
    let damages: Vec<Damage> = vec![
        (|f| f.json["asset"]["version"] = json!("1.0"), &["glTF 1.0"]),
        (|f| f.json["accessors"] = json!("none"), &["does not follow glTF 2.0"]),
        (
            |f| f.attributes()["POSITION"] = json!(99),
            &["mesh 0 \"mesh\", POSITION, accessor 99", "has 8 accessors"],
        ),
        (|f| drop(f.attributes().as_object_mut().unwrap().remove("POSITION")), &["POSITION is missing"]),
        (|f| f.accessor_of("POSITION")["count"] = json!(1_000_000_000), &["node 0", "1000000000 splats"]),
        (|f| f.accessor_of("POSITION")["count"] = json!(u64::MAX), &["18446744073709551615"]),
        (|f| f.accessor_of("POSITION")["count"] = json!(99), &["accessor 0", "do not fit"]),
        (|f| f.accessor_of("POSITION")["count"] = json!(2), &["3 values for 2 splats"]),
        (|f| f.accessor_of("POSITION")["type"] = json!("VEC2"), &["elements of 3 numbers"]),
        (|f| f.accessor_of("POSITION")["componentType"] = json!(7), &["none of glTF"]),
        (|f| f.accessor_of("POSITION")["bufferView"] = json!(70), &["buffer view 70"]),
        (|f| f.accessor_of("POSITION")["byteOffset"] = json!(u64::MAX), &["do not fit"]),
        (|f| f.json["bufferViews"][0]["buffer"] = json!(4), &["buffer 4"]),
        (|f| f.json["bufferViews"][0]["byteOffset"] = json!(1_000_000), &["buffer 0 ends at"]),
        (|f| f.json["bufferViews"][0]["byteStride"] = json!(4), &["every 4 bytes"]),
        (
            |f| drop(f.accessor_of("POSITION").as_object_mut().unwrap().remove("bufferView")),
            // Zeros are positions as good as any.
            &[],
        ),
        (
            |f| {
                let accessor = f.accessor_of("POSITION");
                accessor.as_object_mut().unwrap().remove("bufferView");
                accessor["count"] = json!(1_000_000_000);
            },
            &["1000000000"],
        ),
        (|f| f.json["buffers"][0]["byteLength"] = json!(1_000_000), &["buffer 0", "cut off"]),
        (
            |f| f.json["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]),
            &["KHR_draco_mesh_compression", "unpack"],
        ),
        (|f| f.json["extensionsRequired"] = json!(["EXT_meshopt_compression"]), &["meshopt"]),
        (|f| f.json["extensionsRequired"] = json!(["KHR_gaussian_splatting_compression_spz_2"]), &["SPZ"]),
        (|f| f.json["extensionsRequired"] = json!(["VENDOR_magic"]), &["VENDOR_magic", "without it"]),
        (
            |f| {
                f.json["meshes"][0]["primitives"][0]["attributes"] = json!({ "POSITION": 0 });
                f.json["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] =
                    json!({ "KHR_gaussian_splatting_compression_spz_2": { "bufferView": 0 } });
            },
            &["SPZ"],
        ),
        (|f| f.json["nodes"][0]["mesh"] = json!(5), &["node 0 \"thing\"", "mesh 5"]),
        (|f| f.json["nodes"][0]["children"] = json!([0]), &["node 0", "hangs from itself"]),
        (|f| f.json["nodes"][0]["children"] = json!([8]), &["child 8"]),
        (|f| f.json["scene"] = json!(3), &["scene 3"]),
        (|f| f.json["scenes"][0]["nodes"] = json!([0, 0]), &["twice"]),
        (|f| f.json["scenes"][0]["nodes"] = json!([9]), &["node 9"]),
        (
            |f| f.json["nodes"][0]["rotation"] = json!([0.0, 0.0, 0.0, 0.0]),
            &["node 0 \"thing\"", "no length"],
        ),
        (|f| f.json["nodes"][0]["translation"] = json!([1e300, 0.0, 0.0]), &["node 0", "not finite"]),
        (|f| f.json["nodes"][0]["scale"] = json!([0.0, 1.0, 1.0]), &["no Gaussian splats"]),
        (
            |f| f.json["meshes"][0]["primitives"][0]["extensions"] = json!({}),
            &["no Gaussian splats", "1 meshes"],
        ),
        (|f| f.json["nodes"] = json!([{}]), &["no Gaussian splats"]),
        (|f| f.animate("translation", "LINEAR", &[1.0, 0.5], &[0.0; 6], "VEC3"), &["channel 0", "ascending"]),
        (
            |f| f.animate("translation", "LINEAR", &[0.0, 0.5], &[0.0; 9], "VEC3"),
            &["channel 0", "3 values for 2"],
        ),
        (|f| f.animate("translation", "LINEAR", &[0.0], &[f32::NAN; 3], "VEC3"), &["key 0 is not finite"]),
        (|f| f.animate("rotation", "LINEAR", &[0.0], &[0.0; 4], "VEC4"), &["key 0 has no length"]),
        (|f| f.animate("translation", "WOBBLE", &[0.0], &[0.0; 3], "VEC3"), &["interpolation"]),
    ];
    for (number, (damage, says)) in damages.iter().enumerate() {
        let mut file = File::with(&splats(3, 0));
        // The positions are the first accessor; eight with those of the animation's tests.
        file.floats(&[0.0], "SCALAR");
        file.floats(&[0.0], "SCALAR");
        file.floats(&[0.0], "SCALAR");
        damage(&mut file);
        if says.is_empty() {
            file.read().unwrap_or_else(|error| panic!("damage {number}: {error}"));
        } else {
            file.fails(says);
        }
    }
    let values: [(&str, &str, Vec<f32>, &str); 5] = [
        ("ROTATION", "VEC4", vec![0.0; 12], "no length"),
        ("SCALE", "VEC3", vec![0.1, 0.1, -0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1], "1 of 9 values are negative"),
        ("OPACITY", "SCALAR", vec![0.5, 0.5, 1.5], "splat 2 is not between 0 and 1"),
        ("OPACITY", "SCALAR", vec![0.5, f32::NAN, 0.5], "splat 1"),
        ("SH_DEGREE_0_COEF_0", "VEC3", vec![f32::INFINITY; 9], "not finite"),
    ];
    for (attribute, kind, values, says) in values {
        let mut file = File::with(&splats(3, 0));
        let accessor = file.floats(&values, kind);
        file.attributes()[name(attribute)] = json!(accessor);
        file.fails(&[says, attribute, "mesh 0"]);
    }
    let mut file = File::with(&splats(3, 2));
    file.attributes().as_object_mut().unwrap().remove(&name("SH_DEGREE_2_COEF_3"));
    file.fails(&["SH_DEGREE_2_COEF_3", "degrees must be whole"]);
}

#[test]
fn a_mesh_placed_ever_so_often_does_not_fill_the_memory() {
    let mut file = File::with(&splats(500, 0));
    file.json["nodes"] = (0..30_000).map(|_| json!({ "mesh": 0 })).collect();
    file.json["scenes"] = json!([{ "nodes": (0..30_000).collect::<Vec<u32>>() }]);
    file.fails(&["place meshes less often"]);
}

#[test]
fn damaged_containers_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path: &Path = &folder.path().join("scene.glb");
    let recipe = crate::testing::Recipe {
        seed: 1,
        nodes: 2,
        splats: 3,
        sh_degree: 1,
        frames: 3,
        first_frame: 0,
        up_axis: cif_scene::UpAxis::Z,
        meters_per_unit: 1.0,
        frame: cif_scene::CaptureFrame::default(),
    };
    crate::export(&crate::testing::scene(recipe), path, crate::ExportOptions::default()).unwrap();
    let whole = std::fs::read(path).unwrap();
    // Cut anywhere, or with any byte of the headers changed, the file is read or refused, never a panic.
    for length in (0..whole.len()).step_by(97).chain([0, 4, 11, 12, 19, 20, 21, whole.len() - 1]) {
        std::fs::write(path, &whole[..length]).unwrap();
        let error = read_scene(path).unwrap_err().to_string();
        assert!(error.contains("scene.glb"), "{error}");
    }
    for at in 0..20 {
        for value in [0, 1, 127, 255] {
            let mut bytes = whole.clone();
            bytes[at] = value;
            std::fs::write(path, &bytes).unwrap();
            drop(read_scene(path));
        }
    }
    std::fs::write(path, &whole).unwrap();
    read_scene(path).unwrap();
    for bytes in [&b""[..], b"{", b"[]", b"{\"asset\":{}}", b"\xff\xfe"] {
        assert!(read_bytes(bytes).is_err());
    }
}

#[test]
fn files_full_of_noise_do_not_panic() {
    let mut numbers = Numbers::new(5);
    let text = String::from_utf8(File::with(&splats(3, 1)).text()).unwrap();
    for _ in 0..300 {
        // Numbers in the JSON are replaced by others.
        let mut noisy = text.clone();
        for _ in 0..3 {
            let start = noisy.find("data:").unwrap_or(0);
            let uri = start..start + noisy[start..].find('"').unwrap_or(0);
            let outside = |at: &usize| !uri.contains(at);
            let digits: Vec<usize> = noisy
                .char_indices()
                .filter(|(_, c)| c.is_ascii_digit())
                .map(|(at, _)| at)
                .filter(outside)
                .collect();
            let at = digits[numbers.between(0.0, digits.len() as f64) as usize];
            let by = ["0", "7", "99", "-1", "1e9", "4294967295", "18446744073709551615", "null", "0.5"];
            noisy.replace_range(at..=at, by[numbers.between(0.0, by.len() as f64) as usize]);
        }
        drop(read_bytes(noisy.as_bytes()));
    }
}

#[test]
fn far_places_of_nodes_are_kept_to_a_millimetre() {
    let splats = splats(3, 0);
    let at = DVec3::new(500_123.251, 215.377, -4_649_776.129);
    for value in [
        json!({ "mesh": 0, "translation": at.to_array() }),
        json!({ "mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, at.x, at.y, at.z, 1] }),
    ] {
        let mut file = File::with(&splats);
        file.json["nodes"] = json!([value]);
        let graph = file.read().unwrap();
        assert!(!graph.frame.is_identity() && graph.warnings[0].contains("origin"), "{:?}", graph.warnings);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("back.glb");
        crate::export(&graph, &path, crate::ExportOptions::default()).unwrap();
        for graph in [graph, read_scene(&path).unwrap()] {
            for (mean, before) in graph.nodes[0].splats_at(0.0).means.iter().zip(&splats.means) {
                let found = graph.frame.capture_from_dataset(*mean);
                let expected = at + DVec3::from_array(before.map(f64::from));
                assert!((found - expected).length() < 1e-4, "{found} {expected}");
            }
        }
    }
}

#[test]
fn visibility_by_pointer_is_read() {
    let hidden = || {
        let mut file = File::with(&splats(2, 0));
        let extensions = json!({ "KHR_node_visibility": { "visible": false } });
        file.json["nodes"] = json!([{ "mesh": 0, "extensions": extensions }]);
        file
    };
    assert!(!hidden().read().unwrap().nodes[0].is_visible(0.0));
    let mut file = hidden();
    let input = file.floats(&[0.0, 0.25, 0.5], "SCALAR");
    let output = file.accessor(&[1, 0, 1, 0], 5121, "SCALAR", 3, false);
    let pointer = |pointer: &str| json!({ "path": "pointer", "extensions": { "KHR_animation_pointer": { "pointer": pointer } } });
    let visible = pointer("/nodes/0/extensions/KHR_node_visibility/visible");
    let shift = file.floats(&[0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 4.0, 0.0], "VEC3");
    file.json["animations"] = json!([{
        "samplers": [
            { "input": input, "output": output, "interpolation": "STEP" },
            { "input": input, "output": shift, "interpolation": "LINEAR" },
        ],
        "channels": [
            { "sampler": 0, "target": visible },
            { "sampler": 1, "target": pointer("/nodes/0/translation") },
            { "sampler": 1, "target": pointer("/materials/0/alphaCutoff") },
        ],
    }]);
    file.json["extensionsRequired"] = json!(["KHR_animation_pointer"]);
    file.json["extensionsUsed"].as_array_mut().unwrap().push(json!("KHR_animation_pointer"));
    let graph = file.read().unwrap();
    for frame in 0..=12 {
        assert_eq!(graph.nodes[0].is_visible(f64::from(frame)), !(6..12).contains(&frame), "{frame}");
    }
    assert!((graph.nodes[0].world_transform(6.0).translation - DVec3::Y * 2.0).length() < 1e-6);
    file.json["animations"][0]["channels"][0]["target"] =
        pointer("/nodes/7/extensions/KHR_node_visibility/visible");
    file.fails(&["channel 0", "is not in the file"]);
}

#[test]
fn logarithmic_scales_of_drafts_are_read_or_named() {
    let splats = splats(3, 0);
    let set = |file: &mut File, values: &[f32]| {
        let accessor = file.floats(values, "VEC3");
        file.attributes()[format!("{EXTENSION}:SCALE")] = json!(accessor);
    };
    let logs: Vec<f32> = splats.scales.iter().flatten().map(|scale| scale.ln()).collect();
    let mut file = File::with(&splats);
    set(&mut file, &logs);
    let graph = file.read().unwrap();
    assert!(graph.warnings[0].contains("logarithms"), "{:?}", graph.warnings);
    let scales = graph.nodes[0].splats.scales.as_flattened().iter().zip(splats.scales.as_flattened());
    assert!(scales.into_iter().all(|(a, b)| (a - b).abs() < 1e-5 * b));
    // All of them above a metre: only the program that wrote them shows it.
    let large = [0.5, 1.0, 1.5, 0.5, 1.0, 1.5, 0.5, 1.0, 1.5];
    for (generator, expected) in [
        ("splat-transform 2.6.0", 0.5_f32.exp()),
        ("splat-transform v1.10.2", 0.5_f32.exp()),
        ("splat-transform 2.6.1", 0.5),
        ("another 1.0.0", 0.5),
    ] {
        let mut file = File::with(&splats);
        file.json["asset"]["generator"] = json!(generator);
        set(&mut file, &large);
        let found = file.read().unwrap().nodes[0].splats.scales[0][0];
        assert!((found - expected).abs() < 1e-6, "{generator}: {found}");
    }
    let mut file = File::with(&splats);
    let attributes = file.attributes().as_object_mut().unwrap();
    for name in ["ROTATION", "SCALE"] {
        let accessor = attributes.remove(&format!("{EXTENSION}:{name}")).unwrap();
        attributes.insert(format!("_{name}"), accessor);
    }
    file.fails(&["early draft"]);
}

#[test]
fn flat_splats_stay_flat() {
    let mut splats = splats(3, 0);
    splats.scales.iter_mut().for_each(|scale| scale[1] = 0.0);
    let graph = File::with(&splats).read().unwrap();
    assert_eq!(graph.nodes[0].splats.scales, splats.scales);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("back.glb");
    crate::export(&graph, &path, crate::ExportOptions::default()).unwrap();
    assert_eq!(read_scene(&path).unwrap().nodes[0].splats.scales, splats.scales);
}
