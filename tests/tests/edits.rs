//! A file that left comes home: as a scene of its own, and with its edits onto the scene that it came from.
#![allow(clippy::unwrap_used)] // Helpers of tests.

use std::fs;
use std::path::Path;

use cif_field::{Field, Heads, Identities, Instance, RecordedCamera};
use cif_render::synthetic::{SyntheticConfig, generate};
use cif_scene::{MotionModel, SceneGraph, SceneOptions};
use cif_test::command::{Run, run};
use glam::DVec3;
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
    owner.iter().for_each(|owner| identities.push_told(Some(*owner)));
    field.identities = Some(identities);
    field.instances = ["red mug", "cereal box", "spoon"]
        .iter()
        .enumerate()
        .map(|(k, label)| Instance { id: k as u16 + 1, label: (*label).into(), category: "thing".into() })
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
    cif(folder, &format!("render {scene} --camera left.json --time {time} -o {output}")).succeeds();
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
    // An exported file beside the scene that it came from is compared by rows.
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
