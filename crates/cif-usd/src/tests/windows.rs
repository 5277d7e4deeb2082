//! Windows of one capture as a stage with value clips.

use std::path::Path;

use cif_scene::{CaptureFrame, LabelQuery, Motion, SceneGraph, UpAxis, joined};
use serde_json::json;

use super::scenes::Maker;
use super::{python, session};
use crate::{ExportOptions, Payloads, ReadOptions, export, query, read_scene};

/// Time codes that each window sees.
const SEEN: [(i32, i32); 3] = [(0, 7), (4, 13), (10, 15)];

/// Three windows with the same objects, of which each has other splats.
fn windows(seed: u64) -> SceneGraph {
    let window = |k: usize| {
        let codes = (SEEN[k].0..=SEEN[k].1).map(f64::from).collect();
        let mut graph = Maker::at(seed + 100 * k as u64, codes).scene();
        (graph.up_axis, graph.meters_per_unit) = (UpAxis::Z, 1.0);
        graph.frame = CaptureFrame::default();
        graph
    };
    joined((0..3).map(window).collect()).unwrap().0
}

/// Values of every prim of splats at every time code, by the graph.
fn expected(graph: &SceneGraph) -> serde_json::Value {
    let mut all = Vec::new();
    for code in &graph.time_codes.samples {
        let window = graph.windows.iter().rev().find(|window| window.start <= *code).unwrap();
        for (joined, node) in graph.nodes.iter().zip(&window.nodes) {
            // The graph of a window has the splats; the path of their frame is that of the joined node.
            let placed: Vec<[f64; 3]> =
                node.splats_at(*code).means.iter().map(|mean| mean.to_array()).collect();
            let pose = joined.world_transform(*code);
            all.push(json!({
                "code": code, "prim": format!("/World/{}/{}_splats", joined.name, joined.name),
                "local": placed, "origin": pose.translation.to_array(),
                "colors": node.splats.sh_coefficients.len() / 3, "degree": node.splats.sh_degree,
                "seen": joined.is_visible(*code),
            }));
        }
    }
    json!(all)
}

fn check(path: &Path, graph: &SceneGraph) {
    let file = path.with_extension("json");
    std::fs::write(&file, expected(graph).to_string()).unwrap();
    python(
        path,
        r#"
import json, math
from pxr import Usd, UsdGeom
stage = Usd.Stage.Open(path)
lengths = {}
for want in json.load(open(path.rsplit(".", 1)[0] + ".json")):
    prim = stage.GetPrimAtPath(want["prim"])
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat", want["prim"]
    time = Usd.TimeCode(want["code"])
    get = lambda name: prim.GetAttribute(name).Get(time)
    count = len(want["local"])
    lengths.setdefault(want["prim"], set()).add(count)
    positions = get("positions")
    assert len(positions) == count, (want["prim"], want["code"], len(positions), count)
    for found, expected in zip(positions, want["local"]):
        assert math.dist(found, expected) < 1e-5, (want["prim"], want["code"], found, expected)
    for name in ("orientations", "scales", "opacities"):
        assert len(get(name)) == count, (name, want["code"])
    assert len(get("radiance:sphericalHarmonicsCoefficients")) == want["colors"]
    assert get("radiance:sphericalHarmonicsDegree") == want["degree"]
    assert len(get("extent")) == 2
    variables = UsdGeom.PrimvarsAPI(prim)
    for name in ("displayColor", "cif:occupancy", "cif:identity", "cif:row"):
        variable = variables.GetPrimvar(name)
        assert variable, name
        assert len(variable.ComputeFlattened(time)) == count, (name, want["code"])
    for name in ("cif:instanceIds", "cif:instanceShares"):
        assert len(variables.GetPrimvar(name).Get(time)) == 4 * count, (name, want["code"])
    parent = UsdGeom.Xformable(prim.GetParent())
    place = parent.ComputeLocalToWorldTransform(time).ExtractTranslation()
    assert math.dist(place, want["origin"]) < 1e-9, (want["code"], place, want["origin"])
    hint = prim.GetParent().GetAttribute("extentsHint")
    if hint.HasAuthoredValue():
        assert len(hint.Get(time)) >= 2
    seen = UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.inherited
    assert seen == want["seen"], (want["prim"], want["code"])
assert any(len(counts) > 1 for counts in lengths.values()), lengths
# Where no time is asked for, the first window shows.
for prim in {want["prim"] for want in json.load(open(path.rsplit(".", 1)[0] + ".json"))}:
    prim = stage.GetPrimAtPath(prim)
    assert len(prim.GetAttribute("positions").Get()) == len(prim.GetAttribute("positions").Get(0))
"#,
    );
}

#[test]
fn splats_of_every_window_show_at_its_time_and_objects_keep_one_path() {
    let _session = session();
    for (seed, name) in [(3, "a.usda"), (8, "a.usdc")] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        let graph = windows(seed);
        let summary = export(&graph, &path, ExportOptions::default()).unwrap();
        assert_eq!(summary.samples, 16);
        check(&path, &graph);
        // Written again over itself, and elsewhere: nothing is left behind, nothing points back.
        export(&graph, &path, ExportOptions::default()).unwrap();
        let moved = folder.path().join("moved");
        std::fs::create_dir(&moved).unwrap();
        for entry in std::fs::read_dir(folder.path()).unwrap() {
            let entry = entry.unwrap();
            if entry.path() != moved {
                std::fs::rename(entry.path(), moved.join(entry.file_name())).unwrap();
            }
        }
        check(&moved.join(name), &graph);
        let label_query = LabelQuery { pattern: graph.nodes[1].label.clone(), time_code: Some(12.0) };
        let found = query(&moved.join(name), &label_query, ReadOptions::default()).unwrap();
        assert!(found.iter().any(|found| found.instance == graph.nodes[1].name), "{found:?}");
        let read = read_scene(&moved.join(name)).unwrap();
        assert_same(&read, &graph);
        for (index, window) in graph.windows.iter().enumerate() {
            let alone = cif_scene::window_alone(&read, index).unwrap();
            let codes = alone.time_codes.samples.clone();
            assert_eq!(codes[0], window.start);
            let field = cif_scene::field_from_graph(&alone, name).unwrap();
            assert_eq!(field.time_codes(), codes);
            assert_eq!(field.len(), window.nodes.iter().map(|node| node.splats.len()).sum::<usize>());
        }
        let error = cif_scene::field_from_graph(&read, name).unwrap_err().to_string();
        assert!(error.contains("3 windows of time"), "{error}");
    }
}

/// Paths as USD keeps them, and splats exactly.
fn assert_same(read: &SceneGraph, written: &SceneGraph) {
    assert_eq!(read.windows.len(), written.windows.len());
    assert_eq!(read.nodes.len(), written.nodes.len());
    for (read, written) in read.nodes.iter().zip(&written.nodes) {
        assert_eq!((&read.name, &read.kind), (&written.name, &written.kind));
        for code in 0..16 {
            let code = f64::from(code);
            let [a, b] = [read, written].map(|node| node.world_transform(code));
            assert!(a.translation.distance(b.translation) < 1e-9, "{} {code}", read.name);
            assert!((a.rotation - b.rotation).to_cols_array().iter().all(|value| value.abs() < 1e-6));
            assert_eq!(read.is_visible(code), written.is_visible(code), "{} {code}", read.name);
        }
    }
    for (read, written) in read.windows.iter().zip(&written.windows) {
        assert_eq!(read.start, written.start);
        for (read, written) in read.nodes.iter().zip(&written.nodes) {
            assert_eq!(read.splats, written.splats, "{}", read.name);
            assert_eq!(read.appearance, written.appearance, "{}", read.name);
            let [a, b] = [read, written].map(|node| match &node.motion {
                Motion::Dense(dense) => dense.samples.as_slice(),
                _ => &[],
            });
            assert_eq!(a.len(), b.len(), "{}", read.name);
            // Quaternions are made unit again.
            for (a, b) in a.iter().zip(b) {
                assert_eq!((a.time_code, &a.means, &a.scales), (b.time_code, &b.means, &b.scales));
                let turns = a.orientations.as_flattened().iter().zip(b.orientations.as_flattened());
                assert!(turns.into_iter().all(|(a, b)| (a - b).abs() < 1e-6), "{}", read.name);
            }
        }
    }
}

#[test]
fn windows_need_files_of_their_own() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let graph = windows(5);
    let single = ExportOptions { payloads: Payloads::SingleFile, ..ExportOptions::default() };
    for (name, options) in [("a.usda", single), ("a.usdz", ExportOptions::default())] {
        let error = export(&graph, &folder.path().join(name), options).unwrap_err().to_string();
        assert!(error.contains("a file for each"), "{error}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}
