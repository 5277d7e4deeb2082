use glam::{DQuat, DVec3};

use super::*;
use crate::graph::pose_at;
use crate::testing::{MEMBERS, TIMES, learned_field, recorded_field};
use crate::{ChangeKind, Motion, NodeKind, PoseSample, SceneOptions, Splats, Tolerance, VisibilitySample};

fn options() -> SceneOptions {
    SceneOptions { tolerance: Tolerance::Absolute(1e-4), ..SceneOptions::default() }
}

/// A field, its graph, and the graph to be edited.
struct Case {
    base: Field,
    exported: SceneGraph,
    edited: SceneGraph,
}

impl Case {
    fn of(base: Field) -> Self {
        base.validate().unwrap();
        let exported = build(&base, &options()).unwrap();
        Self { base, edited: exported.clone(), exported }
    }

    fn apply(&self) -> (Field, SceneDiff) {
        let (field, changes) = import_edits(&self.base, &self.edited, "edited.usda", false).unwrap();
        field.validate().unwrap();
        assert!(build(&field, &options()).is_ok(), "the result exports again");
        (field, changes)
    }

    /// Rows of a node of the exported graph.
    fn rows(&self, node: usize) -> Vec<usize> {
        self.exported.nodes[node].splats.rows.iter().map(|row| *row as usize).collect()
    }
}

/// Learned and recorded motion.
fn cases() -> [Case; 2] {
    [Case::of(recorded_field(4, 21)), Case::of(learned_field(3, 22))]
}

fn point(field: &Field, time: f64, row: usize) -> DVec3 {
    DVec3::from_array(field.deformed(time).means[row].map(f64::from))
}

/// Puts `turn` and `shift` after the whole motion of a node.
fn move_node(node: &mut Node, turn: DQuat, shift: DVec3) {
    let carry = |pose: &mut PoseSample| {
        pose.translation = turn * pose.translation + shift;
        pose.rotation = turn * pose.rotation;
    };
    if node.track().is_empty() {
        let rest = PoseSample { time_code: 0.0, translation: node.pivot, rotation: DQuat::IDENTITY };
        node.motion = Motion::Rigid(vec![rest]);
    }
    match &mut node.motion {
        Motion::Rigid(track) => track.iter_mut().for_each(carry),
        Motion::Parts(parts) => parts.track.iter_mut().for_each(carry),
        Motion::Dense(dense) => dense.track.iter_mut().for_each(carry),
        Motion::Static => unreachable!("made rigid above"),
    }
    node.pivot = turn * node.pivot + shift;
}

#[test]
fn without_edits_the_field_comes_back_as_it_was() {
    for case in cases() {
        let (field, changes) = case.apply();
        assert!(changes.is_empty(), "{changes:?}");
        assert_eq!(changes.unchanged, case.exported.nodes.len());
        assert_eq!(field, case.base);
    }
}

#[test]
fn rounding_is_no_edit() {
    for mut case in cases() {
        for node in &mut case.edited.nodes {
            // What storing in single precision does.
            node.pivot = node.pivot.as_vec3().as_dvec3();
            if let Motion::Rigid(track) = &mut node.motion {
                for pose in track {
                    pose.translation = pose.translation.as_vec3().as_dvec3();
                    pose.rotation = -pose.rotation.as_quat().as_dquat();
                }
            }
            for orientation in &mut node.splats.orientations {
                *orientation = orientation.map(|v| -v * (1.0 + 1e-7));
            }
        }
        assert_eq!(case.apply().0, case.base);
    }
}

#[test]
fn a_moved_object_moves_at_all_times_and_nothing_else_does() {
    let turn = DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.5);
    for mut case in cases() {
        // Static, rigid, dense, hidden; and dense ones with learned motion.
        for node in 0..case.exported.nodes.len() - 1 {
            case.edited = case.exported.clone();
            move_node(&mut case.edited.nodes[node], turn, DVec3::new(0.1, -0.2, 0.3));
            let (field, changes) = case.apply();
            assert_eq!(changes.objects.len(), 1);
            let moved = changes.objects[0].moved.unwrap();
            assert!(moved.constant && (moved.rotation_degrees - 0.5_f64.to_degrees()).abs() < 1e-3);
            assert_eq!(field.len(), case.base.len());
            assert_eq!(field.deformation, case.base.deformation);
            assert_eq!(field.gaussians, case.base.gaussians);
            let rows = case.rows(node);
            for time in [0.0, 0.33, 1.0] {
                let (before, after) = (case.base.deformed(time), field.deformed(time));
                for row in 0..field.len() {
                    let old = DVec3::from_array(before.means[row].map(f64::from));
                    let new = DVec3::from_array(after.means[row].map(f64::from));
                    let faint = case.base.gaussians.opacity(row) < 0.003;
                    if rows.contains(&row) || (faint && row / MEMBERS == node) {
                        let expected = turn * old + DVec3::new(0.1, -0.2, 0.3);
                        assert!((new - expected).length() < 2e-6, "row {row} at {time}");
                        assert_ne!(after.sh_coefficients[row], before.sh_coefficients[row]);
                    } else {
                        assert_eq!(old, new, "row {row}");
                    }
                    assert_eq!(after.opacity_logits[row], before.opacity_logits[row]);
                }
            }
            // Moved once more, and back: the field follows where it follows already.
            let mut again = Case::of(field);
            move_node(
                &mut again.edited.nodes[node],
                turn.conjugate(),
                turn.conjugate() * -DVec3::new(0.1, -0.2, 0.3),
            );
            let (back, _) = again.apply();
            for time in [0.0, 0.7] {
                let (before, after) = (case.base.deformed(time), back.deformed(time));
                let off = before.means.as_flattened().iter().zip(after.means.as_flattened());
                assert!(off.into_iter().all(|(a, b)| (a - b).abs() < 3e-6));
            }
        }
    }
}

#[test]
fn motion_given_to_an_object_is_put_after_what_it_had() {
    for mut case in cases() {
        let node = case.exported.nodes.len() - 2;
        let mut keys = Vec::new();
        for (code, angle) in [(0.0, 0.0), (2.0, 0.4), (5.0, -0.9)] {
            let pose = pose_at(case.exported.nodes[node].track(), case.exported.nodes[node].pivot, code);
            keys.push(PoseSample {
                time_code: code,
                translation: pose.translation + DVec3::Z * 0.1 * code,
                rotation: DQuat::from_rotation_z(angle) * pose.rotation,
            });
        }
        match &mut case.edited.nodes[node].motion {
            Motion::Dense(dense) => dense.track = keys,
            other => *other = Motion::Rigid(keys),
        }
        let (field, changes) = case.apply();
        assert!(!changes.objects[0].moved.unwrap().constant);
        let row = case.rows(node)[5];
        for (frame, time) in TIMES.iter().enumerate() {
            let code = frame as f64;
            let pose = |graph: &SceneGraph| graph.nodes[node].world_transform(code);
            let (before, after) = (pose(&case.exported), pose(&case.edited));
            let expected = after.apply(before.inverse().apply(point(&case.base, *time, row)));
            assert!((point(&field, *time, row) - expected).length() < 2e-6, "frame {frame}");
        }
    }
}

#[test]
fn labels_names_and_categories_go_to_the_table() {
    let mut case = Case::of(learned_field(3, 4));
    case.edited.nodes[0].label = "blue mug".into();
    case.edited.nodes[0].name = "mug_of_anna".into();
    case.edited.nodes[1].name = "tea_pot_005".into();
    case.edited.nodes[2].category = "box".into();
    let (field, changes) = case.apply();
    let table: Vec<_> = field
        .instances
        .iter()
        .map(|instance| (instance.id, instance.label.as_str(), instance.category.as_str()))
        .collect();
    assert_eq!(table, [(2, "blue mug", "thing"), (5, "tea pot", "thing"), (8, "thing 2", "box")]);
    assert_eq!(changes.objects.len(), 3);
    assert_eq!(field.gaussians, case.base.gaussians);
    assert_eq!(field.record.edits[0]["file"], "edited.usda");
}

#[test]
fn hidden_objects_are_hidden_and_shown_again() {
    for mut case in cases() {
        let last = case.exported.nodes.len() - 2;
        let hide = |time_code, visible| VisibilitySample { time_code, visible };
        case.edited.nodes[0].visibility = vec![hide(0.0, true), hide(3.0, false)];
        // Hidden at first in the recorded scene.
        case.edited.nodes[last].visibility.clear();
        let (field, changes) = case.apply();
        assert!(changes.objects[0].visibility);
        let row = case.rows(0)[0];
        assert_eq!(
            TIMES.map(|time| field.deformed(time).opacity(row) > 0.0),
            [true, true, true, false, false, false]
        );
        let row = case.rows(last)[0];
        assert!(field.deformed(0.0).opacity(row) > 0.0);
        let again = build(&field, &options()).unwrap();
        assert!(again.nodes[0].is_visible(2.0) && !again.nodes[0].is_visible(3.0));
    }
}

#[test]
fn a_deleted_object_is_gone_with_what_nobody_saw_of_it() {
    for case in cases() {
        let mut case = case;
        case.edited.nodes.remove(1);
        let (field, changes) = case.apply();
        assert_eq!(changes.objects[0].kind, ChangeKind::Removed);
        assert_eq!(field.len(), case.base.len() - MEMBERS);
        let ids: Vec<u16> = field.instances.iter().map(|instance| instance.id).collect();
        let expected: Vec<u16> =
            case.base.instances.iter().map(|instance| instance.id).filter(|id| *id != 5).collect();
        assert_eq!(ids, expected);
        // The others stay what and where they were.
        let again = build(&field, &options()).unwrap();
        let left: Vec<&Node> = case.edited.nodes.iter().collect();
        assert_eq!(again.nodes.len(), left.len());
        for (node, expected) in again.nodes.iter().zip(left) {
            assert_eq!((&node.name, node.splats.len()), (&expected.name, expected.splats.len()));
            assert_eq!((node.model(), node.pivot), (expected.model(), expected.pivot));
            assert_eq!(node.splats.means, expected.splats.means);
        }
        // Without any instance there are no identities.
        case.edited.nodes.retain(|node| node.kind == NodeKind::Background);
        let (field, _) = case.apply();
        assert!(field.instances.is_empty() && field.identities.is_none());
    }
}

#[test]
fn a_copy_is_an_instance_of_its_own() {
    for mut case in cases() {
        let node = case.exported.nodes.len() - 2;
        let mut copy = case.edited.nodes[node].clone();
        copy.name = "copy".into();
        copy.label = "copy of a thing".into();
        move_node(&mut copy, DQuat::IDENTITY, DVec3::new(0.0, 2.0, 0.0));
        copy.visibility.clear();
        case.edited.nodes.insert(0, copy);
        let (field, changes) = case.apply();
        assert_eq!((changes.objects.len(), &changes.objects[0].kind), (1, &ChangeKind::Duplicated));
        let rows = case.rows(node);
        assert_eq!(field.len(), case.base.len() + rows.len());
        let new = field.instances.last().unwrap();
        assert_eq!((new.id, new.label.as_str()), (1, "copy of a thing"));
        let instance = field.instances.len() - 1;
        assert_eq!(field.members(instance).len(), rows.len());
        for time in [0.0, 0.6] {
            let posed = field.deformed(time);
            let unhidden =
                cif_render::cpu::Renderer::new(Default::default()).deform_unhidden(&case.base, time);
            for (copied, row) in rows.iter().enumerate() {
                let original = DVec3::from_array(unhidden.means[*row].map(f64::from));
                let found = DVec3::from_array(posed.means[case.base.len() + copied].map(f64::from));
                assert!((found - original - DVec3::Y * 2.0).length() < 2e-5, "{found} {original}");
                assert!(posed.opacity(case.base.len() + copied) > 0.0);
            }
        }
        let again = build(&field, &options()).unwrap();
        assert!(again.nodes.iter().any(|node| node.label == "copy of a thing"));
    }
}

#[test]
fn what_is_added_stays_as_the_file_has_it() {
    for mut case in cases() {
        let mut visitor = build(&recorded_field(2, 99), &options()).unwrap().nodes[1].clone();
        visitor.kind = NodeKind::Instance { id: 5, index: 0 };
        visitor.name = "visitor".into();
        visitor.label = "visitor".into();
        visitor.splats.rows.fill(Splats::NO_ROW);
        move_node(&mut visitor, DQuat::IDENTITY, DVec3::Z * 3.0);
        let expected: Vec<DVec3> = TIMES
            .iter()
            .enumerate()
            .map(|(frame, _)| {
                let local = DVec3::from_array(visitor.splats.means[7].map(f64::from));
                visitor.world_transform(frame as f64).apply(local)
            })
            .collect();
        case.edited.nodes.push(visitor);
        let (field, changes) = case.apply();
        assert_eq!((changes.objects.len(), &changes.objects[0].kind), (1, &ChangeKind::Added));
        assert_eq!(field.instances.last().unwrap().id, 1, "5 is taken");
        let row = case.base.len() + 7;
        for (time, expected) in TIMES.iter().zip(expected) {
            assert!((point(&field, *time, row) - expected).length() < 2e-6);
        }
        assert_eq!(field.deformed(0.4).log_scales[row], field.gaussians.log_scales[row]);
        assert_eq!(
            field.gather(&(0..case.base.len() as u32).collect::<Vec<_>>()).gaussians,
            case.base.gaussians
        );
    }
}

#[test]
fn changed_splats_look_as_the_file_shows_them() {
    for mut case in cases() {
        // The turning object of the recorded scene, a deforming one of the learned scene; moved before.
        move_node(&mut case.edited.nodes[1], DQuat::from_rotation_x(0.8), DVec3::Y);
        let mut case = Case::of(case.apply().0);
        let splats = &mut case.edited.nodes[1].splats;
        splats.sh_coefficients.iter_mut().take(48).enumerate().for_each(|(k, v)| *v += 0.01 * k as f32);
        splats.opacities[1] = 1.0;
        splats.opacities[2] *= 0.5;
        splats.occupancies[3] *= 0.5;
        if !matches!(case.edited.nodes[1].motion, Motion::Dense(_)) {
            case.edited.nodes[1].splats.scales[4] = case.exported.nodes[1].splats.scales[4].map(|s| s * 1.5);
        }
        let (field, changes) = case.apply();
        let counted = changes.objects[0].splats.unwrap();
        assert_eq!((counted.recoloured, counted.faded, counted.reshaped), (1, 3, 0));
        assert_eq!(field.len(), case.base.len());
        let again = build(&field, &options()).unwrap();
        let (found, expected) = (&again.nodes[1].splats, &case.edited.nodes[1].splats);
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(close(&found.sh_coefficients, &expected.sh_coefficients));
        assert!(close(&found.opacities, &expected.opacities));
        assert!(close(&found.occupancies, &expected.occupancies));
        assert!(close(found.scales.as_flattened(), expected.scales.as_flattened()));
    }
}

#[test]
fn splats_that_are_deleted_moved_or_added_within_an_object() {
    for mut case in cases() {
        let node = 1;
        let keep: Vec<usize> = (3..case.exported.nodes[node].splats.len()).collect();
        let mut changed = subset(&case.exported.nodes[node], &keep);
        let shift = [0.0, 0.0, 0.25];
        let raise = |mean: &mut [f32; 3]| mean.iter_mut().zip(shift).for_each(|(value, by)| *value += by);
        raise(&mut changed.splats.means[0]);
        if let Motion::Dense(dense) = &mut changed.motion {
            dense.samples.iter_mut().for_each(|sample| raise(&mut sample.means[0]));
        }
        changed.splats.rows[1] = Splats::NO_ROW;
        case.edited.nodes[node] = changed;
        let (field, changes) = case.apply();
        let counted = changes.objects[0].splats.unwrap();
        assert_eq!((counted.removed, counted.reshaped, counted.added), (4, 1, 1));
        assert_eq!(field.len(), case.base.len() - 3);
        let own = &case.edited.nodes[node];
        let index = instance_of(own).unwrap();
        let owners = field.identities.as_ref().unwrap().argmax();
        assert_eq!(owners[field.len() - 1], Some(index as u16));
        // The raised one is where the file has it, at every frame; new rows are at the end.
        for (frame, time) in TIMES.iter().enumerate() {
            let local = match &own.motion {
                Motion::Dense(dense) => dense.samples[frame].means[0],
                _ => own.splats.means[0],
            };
            let expected = own.world_transform(frame as f64).apply(DVec3::from_array(local.map(f64::from)));
            let found = point(&field, *time, field.len() - 2);
            assert!((found - expected).length() < 1e-5, "frame {frame}: {found} {expected}");
        }
    }
}

#[test]
fn the_wrong_base_is_refused() {
    let mut case = Case::of(recorded_field(2, 1));
    let mut other = case.base.clone();
    other.instances[0].label = "something else".into();
    move_node(&mut case.edited.nodes[0], DQuat::IDENTITY, DVec3::X);
    let error = import_edits(&other, &case.edited, "a.usda", false).unwrap_err().to_string();
    assert!(error.contains("a.usda was exported from another scene"), "{error}");
    let (field, changes) = import_edits(&other, &case.edited, "a.usda", true).unwrap();
    assert!(changes.objects[0].moved.is_some());
    assert_eq!(field.instances[0].label, "thing 0", "the file's label counts");
    case.edited.origin = crate::Origin::default();
    let error = import_edits(&case.base, &case.edited, "b.glb", true).unwrap_err().to_string();
    assert!(error.contains("b.glb does not say"), "{error}");
}
