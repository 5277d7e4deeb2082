use glam::DVec3;

use super::*;
use crate::testing::{learned_field, recorded_field};
use crate::{Origin, SceneOptions, build};

fn graph(objects: usize) -> SceneGraph {
    build(&learned_field(objects, 7), &SceneOptions::default()).unwrap()
}

#[test]
fn a_graph_does_not_differ_from_itself() {
    let graph = graph(3);
    let found = diff(&graph, &graph);
    assert!(found.is_empty());
    assert_eq!(found.unchanged, 4);
}

#[test]
fn differences_are_reported_in_words_and_numbers() {
    let before = build(&recorded_field(4, 7), &SceneOptions::default()).unwrap();
    let mut after = before.clone();
    after.nodes[0].pivot += DVec3::new(0.06, 0.0, 0.08);
    after.nodes[0].name = "blue_mug".into();
    after.nodes[1].label = "pot".into();
    after.nodes.remove(2);
    let mut copy = after.nodes[0].clone();
    copy.name = "second_mug".into();
    after.nodes.push(copy);
    let found = diff(&before, &after);
    assert_eq!(found.unchanged, 2);
    let words: Vec<String> = found.objects.iter().map(|object| object.describe().join("; ")).collect();
    assert_eq!(
        words,
        [
            r#"renamed "thing_0_002" -> "blue_mug"; moved 0.1000, turned 0.00 degrees"#,
            r#"relabelled "thing 1" -> "pot""#,
            "removed",
            r#"duplicated, 40 splats; renamed "thing_0_002" -> "second_mug"; moved 0.1000, turned 0.00 degrees"#,
        ]
    );
    let json = serde_json::to_value(&found).unwrap();
    assert_eq!(json["objects"][0]["moved"]["constant"], true);
    assert_eq!(json["objects"][2]["kind"], "removed");
}

#[test]
fn cameras_that_differ_are_reported_and_are_no_edit() {
    let mut field = learned_field(2, 7);
    let first = field.cameras[0].clone();
    for (name, times) in [("left", 0..2), ("right", 0..1), ("gone", 0..1), ("zoomed", 0..1)] {
        field.cameras.extend(times.map(|time_index| cif_field::RecordedCamera {
            name: name.into(),
            time_index,
            ..first.clone()
        }));
    }
    let before = build(&field, &SceneOptions::default()).unwrap();
    let mut after = before.clone();
    // What single precision leaves of them is no difference.
    for sample in after.cameras.iter_mut().flat_map(|track| &mut track.samples) {
        let pose = &mut sample.camera.camera_from_world;
        pose.translation = pose.translation.as_vec3().as_dvec3();
        pose.rotation = pose.rotation.as_mat3().as_dmat3();
    }
    assert_eq!(diff(&before, &after).cameras, []);
    let track = |graph: &SceneGraph, name: &str| graph.cameras.iter().position(|t| t.name == name).unwrap();
    let (left, zoomed) = (track(&after, "left"), track(&after, "zoomed"));
    after.cameras[left].samples[1].camera.camera_from_world.translation.x += 0.01;
    after.cameras[zoomed].samples[0].camera.focal_px *= 1.1;
    let mut new = after.cameras[zoomed].clone();
    new.name = "new".into();
    after.cameras.push(new);
    after.cameras.remove(track(&after, "gone"));
    let found = diff(&before, &after);
    assert!(found.is_empty());
    let mut words: Vec<String> = found.cameras.iter().map(ToString::to_string).collect();
    words.sort();
    assert_eq!(words, ["gone (removed)", "left (moved)", "new (added)", "zoomed (another lens)"]);
}

#[test]
fn files_of_others_are_compared_by_name_and_position() {
    let mut before = graph(2);
    before.origin = Origin::default();
    for node in &mut before.nodes {
        if let NodeKind::Instance { id, .. } = &mut node.kind {
            *id = 0;
        }
    }
    let mut after = before.clone();
    after.nodes.swap(0, 1);
    assert!(diff(&before, &after).is_empty());
    after.nodes[0].splats.opacities[3] *= 0.5;
    let splats = diff(&before, &after).objects[0].splats.unwrap();
    assert_eq!(splats, SplatChanges { faded: 1, ..SplatChanges::default() });
    // Rows of different fields mean different Gaussians.
    let (mut ours, theirs) = (graph(2), graph(2));
    ours.nodes[0].splats.rows.reverse();
    assert!(!diff(&ours, &theirs).is_empty());
    ours.origin.field_fingerprint = Some("another".into());
    assert!(diff(&ours, &theirs).is_empty());
}
