//! A file that left comes home: as a scene of its own, and with its edits onto the scene that it came from.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use cif_field::{Field, Heads, Identities, Instance, RecordedCamera};
use cif_render::synthetic::{SyntheticConfig, generate};
use cif_scene::{Motion, MotionModel, PoseSample, SceneGraph, SceneOptions};
use cif_test::command::{Run, run};
use glam::{DQuat, DVec3};
use serde_json::{Value, json};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

fn parsed(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// A field as training leaves it: three objects side by side that a learned deformation moves, seen by a camera.
fn learned() -> Field {
    let heads = Heads { position: true, scale: false, rotation: true, opacity: false, sh: false };
    let config = SyntheticConfig {
        seed: 3,
        gaussians: 150,
        instances: 3,
        width: 64,
        height: 48,
        heads: Some(heads),
        screen_size: (0.02, 0.06),
    };
    let mut scene = generate(&config);
    let field = &mut scene.field;
    let mut by_x: Vec<usize> = (0..field.len()).collect();
    by_x.sort_by(|a, b| field.gaussians.means[*a][0].total_cmp(&field.gaussians.means[*b][0]));
    let mut owner = vec![0_u16; field.len()];
    for (place, row) in by_x.into_iter().enumerate() {
        owner[row] = (place / 50) as u16;
    }
    let mut identities = Identities::empty();
    owner.iter().for_each(|owner| identities.push_certain(Some(*owner)));
    field.identities = Some(identities);
    field.instances = ["red mug", "cereal box", "spoon"]
        .iter()
        .enumerate()
        .map(|(k, label)| Instance {
            id: k as u16 + 1,
            label: (*label).into(),
            category: "thing".into(),
            taxonomies: Default::default(),
        })
        .collect();
    field.cameras =
        vec![RecordedCamera { name: "left".into(), time_index: 0, trained: true, camera: scene.camera }];
    scene.field
}

/// `base.cif`, a camera file, and the graph that was exported from it.
fn setting(folder: &Path) -> (Field, SceneGraph) {
    let field = learned();
    field.save(folder.join("base.cif")).unwrap();
    let camera = field.cameras[0].camera;
    let world = camera.camera_from_world.inverse();
    let row = |k: usize| {
        let r = world.rotation.row(k);
        [r.x, r.y, r.z, world.translation[k]]
    };
    let view = json!([{
        "name": "left", "width": camera.width, "height": camera.height,
        "focal_px": camera.focal_px.to_array(), "principal_px": camera.principal_px.to_array(),
        "world_from_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
    }]);
    fs::write(folder.join("left.json"), view.to_string()).unwrap();
    let options = SceneOptions { most_expensive_motion: MotionModel::Rigid, ..SceneOptions::default() };
    let graph = cif_scene::build(&field, &options).unwrap();
    (field, graph)
}

fn write_glb(graph: &SceneGraph, path: &Path) {
    cif_gltf::export(graph, path, cif_gltf::ExportOptions::default()).unwrap();
}

fn picture(folder: &Path, scene: &str, output: &str, time: f64) -> Vec<u8> {
    cif(folder, &format!("render {scene} --camera left.json --time {}% -o {output}", 100.0 * time))
        .succeeds();
    image::open(folder.join(output).join("rgb/left.png")).unwrap().into_rgb8().into_raw()
}

/// What someone does in another tool: moves and renames the mug, throws the box away.
fn edit(graph: &mut SceneGraph) {
    let mug = &mut graph.nodes[0];
    let shift = DVec3::new(0.3, 0.1, 0.0);
    mug.pivot += shift;
    if let cif_scene::Motion::Rigid(track) = &mut mug.motion {
        track.iter_mut().for_each(|pose| pose.translation += shift);
    }
    mug.label = "blue mug".into();
    let cereal = graph.nodes.iter().position(|node| node.label == "cereal box").unwrap();
    graph.nodes.remove(cereal);
}

#[test]
fn edits_come_home_and_the_result_does_all_that_a_scene_does() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let (base, mut graph) = setting(path);
    write_glb(&graph, &path.join("exported.glb"));
    edit(&mut graph);
    write_glb(&graph, &path.join("edited.glb"));

    // Untouched, the file changes nothing.
    let same = cif(path, "import exported.glb --base base.cif -o same.cif").succeeds();
    assert!(same.stdout.contains("no differences"), "{}", same.stdout);
    assert_eq!(Field::load(path.join("same.cif")).unwrap(), base);

    let imported = cif(path, "import edited.glb --base base.cif -o edited.cif").succeeds();
    for words in ["relabelled \"red mug\" -> \"blue mug\"", "moved 0.3162", "removed", "2 objects differ"] {
        assert!(imported.stdout.contains(words), "{words} in {}", imported.stdout);
    }
    let edited = Field::load(path.join("edited.cif")).unwrap();
    assert_eq!(edited.len(), 100);
    assert_eq!(edited.deformation, base.deformation, "what was learned is kept");
    let labels: Vec<&str> = edited.instances.iter().map(|instance| instance.label.as_str()).collect();
    assert_eq!(labels, ["blue mug", "spoon"]);
    // The mug moves as it was learned to, elsewhere; the spoon is where it was.
    let expected = base.gather(
        &base
            .members(0)
            .into_iter()
            .chain(base.members(2))
            .collect::<std::collections::BTreeSet<u32>>()
            .into_iter()
            .collect::<Vec<u32>>(),
    );
    for time in [0.0, 0.4, 1.0] {
        let (a, b) = (expected.deformed(time), edited.deformed(time));
        for row in 0..100 {
            let shift = if edited.members(0).contains(&(row as u32)) { [0.3, 0.1, 0.0] } else { [0.0; 3] };
            for axis in 0..3 {
                assert!((a.means[row][axis] + shift[axis] - b.means[row][axis]).abs() < 1e-5, "row {row}");
            }
        }
    }

    // It renders, queries, exports and compares.
    assert_ne!(picture(path, "base.cif", "before", 0.4), picture(path, "edited.cif", "after", 0.4));
    let found = cif(path, "query edited.cif --label blue* --json").succeeds().stdout;
    assert!(found.contains("blue mug"), "{found}");
    cif(path, "export edited.cif --report --motion rigid").succeeds();
    let changes = parsed(&cif(path, "diff base.cif edited.cif --json").succeeds().stdout);
    let objects = changes["objects"].as_array().unwrap();
    assert_eq!(objects.len(), 2, "{changes:#}");
    assert_eq!((&objects[0]["id"], &objects[1]["kind"]), (&json!(1), &json!("removed")));
    assert!(cif(path, "diff edited.cif edited.cif").succeeds().stdout.contains("no differences"));
    // An exported file and the scene that it came from are compared by rows.
    assert!(cif(path, "diff base.cif exported.glb").succeeds().stdout.contains("no differences"));

    // Recorded motion cannot be trained.
    cif_test::capture::write(&path.join("table"), 4);
    cif(path, "train table -o more.cif --from edited.cif").fails(1, &[]);
}

#[test]
fn a_file_becomes_a_scene_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let (base, graph) = setting(path);
    write_glb(&graph, &path.join("exported.glb"));
    let imported = cif(path, "import exported.glb -o own.cif").succeeds();
    assert!(imported.stderr.contains("--base"), "{}", imported.stderr);
    let own = Field::load(path.join("own.cif")).unwrap();
    assert!(own.deformation.is_none());
    assert_eq!(own.instances, base.instances);
    // What moves rigidly needs no tolerance.
    let exact = SceneOptions {
        most_expensive_motion: MotionModel::Rigid,
        tolerance: cif_scene::Tolerance::Absolute(1e-5),
        ..SceneOptions::default()
    };
    let again = cif_scene::build(&own, &exact).unwrap();
    write_glb(&again, &path.join("again.glb"));
    cif(path, "import again.glb -o again.cif").succeeds();
    assert!(cif(path, "diff own.cif again.glb").succeeds().stdout.contains("no differences"));
    let (a, b) = (picture(path, "own.cif", "own", 0.5), picture(path, "again.cif", "again", 0.5));
    let off = a.iter().zip(&b).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(off * 200 < a.len(), "{off} of {} values differ", a.len());
    cif(path, "eval own.cif table").fails(1, &["table"]);
}

#[test]
fn exports_are_checked_against_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let mut field = learned();
    let camera = field.cameras[0].clone();
    let seen = |time_index| RecordedCamera { time_index, ..camera.clone() };
    field.cameras = (0..field.timeline.times.len()).map(seen).collect();
    field.save(path.join("base.cif")).unwrap();
    let check = |line: &str| {
        let run = cif(path, &format!("export base.cif {line} --check --json --force")).succeeds();
        parsed(&run.stdout)["check"].as_array().unwrap().clone()
    };
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("no number: {value}"));

    // A close export loses next to nothing, of any object; a PLY shows its moment.
    let close = check("--gltf out.glb --ply out.ply --ply-time 100%");
    let [gltf, ply] = &close[..] else { panic!("{close:#?}") };
    let views = field.cameras.len().min(12);
    assert_eq!((&gltf["format"], &gltf["against_scene"]["views"]), (&json!("gltf"), &json!(views)));
    let scene = &gltf["against_scene"];
    assert!(number(&scene["psnr"]) > 30.0 && number(&scene["miou"]) > 90.0, "{gltf:#}");
    let labels: Vec<&str> =
        scene["objects"].as_array().unwrap().iter().filter_map(|object| object["label"].as_str()).collect();
    assert_eq!(labels, ["everything else", "red mug", "cereal box", "spoon"]);
    let last = field.timeline.times.len() - 1;
    assert_eq!(ply["time_code"].as_f64(), Some(last as f64));
    assert!(ply["against_scene"]["psnr"].as_f64().is_none_or(|psnr| psnr > 40.0), "{ply:#}");
    assert!(ply["against_scene"]["miou"].is_null(), "no objects, no IoU: {ply:#}");
    assert!(gltf["held_out"].is_null() && number(&gltf["seconds"]) > 0.0);

    // One that stands still, or holds another time than is asked for, is reported.
    let still = &check("--gltf still.glb --motion static --check-views 2")[0]["against_scene"];
    assert_eq!(still["views"], json!(2));
    assert!(number(&still["psnr"]) < number(&scene["psnr"]) - 3.0, "{still:#}");
    let part = &check(&format!("--gltf part.glb --frames {last}:{last}"))[0]["against_scene"];
    assert_eq!(part["views"], json!(1));
    assert!(part["psnr"].as_f64().is_none_or(|psnr| psnr > 40.0), "{part:#}");

    let stdout = cif(path, "export base.cif --gltf reported.glb --check").succeeds().stdout;
    assert!(stdout.contains("reported.glb read back in") && stdout.contains("cereal box"), "{stdout}");
    cif(path, "export base.cif --report --check").fails(2, &["--check", "--gltf"]);
    cif(path, "export base.cif --ply all --ply-split --check").fails(2, &["--ply-split"]);
    cif(path, "export base.cif --gltf a.glb --capture .").fails(2, &["--check"]);
    Field { cameras: Vec::new(), ..field }.save(path.join("unseen.cif")).unwrap();
    cif(path, "export unseen.cif --gltf a.glb --check").fails(1, &["no cameras", "--capture"]);
    assert!(!path.join("a.glb").exists());
}

#[test]
fn mistakes_are_explained_and_nothing_is_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let (mut base, mut graph) = setting(path);
    edit(&mut graph);
    write_glb(&graph, &path.join("edited.glb"));
    base.instances[2].label = "fork".into();
    base.save(path.join("other.cif")).unwrap();
    let before = fs::read(path.join("other.cif")).unwrap();
    cif(path, "import edited.glb --base other.cif -o new.cif").fails(1, &["another scene", "--force-base"]);
    cif(path, "import edited.glb --base base.cif -o other.cif").fails(1, &["other.cif exists", "--force"]);
    assert_eq!(fs::read(path.join("other.cif")).unwrap(), before);
    cif(path, "import edited.glb --base base.cif -o new.usda").fails(2, &[".cif"]);
    cif(path, "import edited.txt -o new.cif").fails(2, &["edited.txt", ".glb"]);
    cif(path, "import missing.glb -o new.cif").fails(1, &["missing.glb"]);
    cif(path, "import base.cif -o new.cif").fails(2, &["scene of cif already"]);
    cif(path, "import edited.glb --force-base -o new.cif").fails(2, &["--base"]);
    cif(path, "diff base.cif nothing.abc").fails(2, &["nothing.abc"]);
    assert!(!path.join("new.cif").exists());
    cif(path, "import edited.glb --base other.cif --force-base -o new.cif").succeeds();
    // A file that says nothing of where it came from.
    graph.origin = cif_scene::Origin::default();
    write_glb(&graph, &path.join("theirs.glb"));
    cif(path, "import theirs.glb --base base.cif -o newer.cif").fails(1, &["theirs.glb does not say"]);
}

/// Size and channels of an EXR file.
fn channels(path: &Path) -> (usize, usize, BTreeMap<String, Vec<f32>>) {
    let image = exr::prelude::read_first_flat_layer_from_file(path).unwrap();
    let size = image.layer_data.size;
    let list = image.layer_data.channel_data.list.iter();
    let channels = list.map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect())).collect();
    (size.width(), size.height(), channels)
}

/// PSNR between the first picture and the second one fetched along `factor` times the motion vectors of the
/// first, over the pixels that move.
fn fetched(folder: &Path, views: &str, factor: f64) -> f64 {
    let (width, height, first) = channels(&folder.join(views).join("exr/a.exr"));
    let (_, _, second) = channels(&folder.join(views).join("exr/b.exr"));
    let (mut squares, mut count) = (0.0, 0_usize);
    for y in 0..height {
        for x in 0..width {
            let at = y * width + x;
            // u to the right, v up.
            let (u, v) = (f64::from(first["forward.u"][at]), -f64::from(first["forward.v"][at]));
            if u.hypot(v) < 0.5 {
                continue;
            }
            let (u, v) = (x as f64 + factor * u, y as f64 + factor * v);
            let inside = u >= 0.0 && v >= 0.0 && u < (width - 1) as f64 && v < (height - 1) as f64;
            if !inside {
                continue;
            }
            let (left, top) = (u.floor() as usize, v.floor() as usize);
            let (right_share, low_share) = (u.fract(), v.fract());
            for name in ["R", "G", "B"] {
                let pixel = |x: usize, y: usize| f64::from(second[name][y * width + x]);
                let row = |y: usize| pixel(left, y) * (1.0 - right_share) + pixel(left + 1, y) * right_share;
                let color = row(top) * (1.0 - low_share) + row(top + 1) * low_share;
                squares += (color - f64::from(first[name][at])).powi(2);
                count += 1;
            }
        }
    }
    assert!(count > 300, "{views}: {count} values move");
    -10.0 * (squares / count as f64).log10()
}

#[test]
fn motion_vectors_lead_from_one_frame_to_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let (_, mut graph) = setting(path);
    // The mug drives to the side, in front of everything else; the rest stands still.
    let still = graph.time_codes.start();
    let end = graph.time_codes.end();
    graph.nodes.retain(|node| node.label == "red mug");
    for node in &mut graph.nodes {
        let sample = |time_code: f64, shift: DVec3| PoseSample {
            time_code,
            translation: node.pivot + shift,
            rotation: DQuat::from_rotation_z(0.2 * shift.length()),
        };
        node.motion = Motion::Rigid(vec![sample(still, DVec3::ZERO), sample(end, DVec3::new(0.6, 0.2, 0.1))]);
    }
    let field = cif_scene::field_from_graph(&graph, "a test").unwrap();
    field.save(path.join("driven.cif")).unwrap();

    let view: Value = parsed(&fs::read_to_string(path.join("left.json")).unwrap());
    let views = |first: (&str, f64, f64), second: (&str, f64, f64)| {
        let one = |(name, time, aside): (&str, f64, f64)| {
            let mut view = view[0].clone();
            view["name"] = name.into();
            view["time"] = time.into();
            let x = view["world_from_camera"][0][3].as_f64().unwrap();
            view["world_from_camera"][0][3] = (x + aside).into();
            view
        };
        json!([one(first), one(second)]).to_string()
    };
    for (name, what) in [
        ("object", views(("a", 0.2, 0.0), ("b", 0.5, 0.0))),
        ("camera", views(("a", 0.2, 0.0), ("b", 0.2, 0.15))),
        ("both", views(("a", 0.2, 0.0), ("b", 0.5, 0.15))),
    ] {
        fs::write(path.join(format!("{name}.json")), what).unwrap();
        let line = format!("render driven.cif --camera {name}.json -o {name} --exr --exr-color display");
        cif(path, &line).succeeds();
        let [against, none, along] = [-1.0, 0.0, 1.0].map(|factor| fetched(path, name, factor));
        assert!(along > none + 6.0, "{name}: {along} dB along the vectors, {none} dB without");
        assert!(none > against + 1.0, "{name}: {none} dB without, {against} dB the other way");
    }
    // Nothing moves between two pictures of the same moment.
    fs::write(path.join("same.json"), views(("a", 0.2, 0.0), ("b", 0.2, 0.0))).unwrap();
    cif(path, "render driven.cif --camera same.json -o same --exr").succeeds();
    let (_, _, first) = channels(&path.join("same/exr/a.exr"));
    for name in ["forward.u", "forward.v"] {
        assert!(first[name].iter().all(|value| value.abs() < 1e-3), "{name}");
    }
}
