//! Our own export comes back as it was.

use cif_field::{JointKind, RotationEvidence};
use cif_scene::{
    CaptureFrame, LabelQuery, Motion, MotionModel, NodeKind, ObjectQuery, PartJoint, SceneGraph, VolumeOf,
};
use glam::DVec3;
use proptest::prelude::*;

use super::scenes::Maker;
use super::{python, session};
use crate::{ExportOptions, Payloads, ReadOptions, export, read_scene};

/// Where scenes lie: at the origin, far from it, in other units, or both.
const FRAMES: [CaptureFrame; 4] = [
    CaptureFrame { offset: [0.0; 3], scale: 1.0 },
    CaptureFrame { offset: [3.1e6, -2.7e5, 41.25], scale: 1.0 },
    CaptureFrame { offset: [0.0; 3], scale: 10.0 },
    CaptureFrame { offset: [-4.4e7, 1.3e8, 0.1], scale: 1e-3 },
];

/// Cameras to the precision of USD's lenses, everything else exactly.
fn assert_same(read: &SceneGraph, written: &SceneGraph) {
    assert_eq!(read.cameras.len(), written.cameras.len());
    for (a, b) in read.cameras.iter().zip(&written.cameras) {
        assert_eq!((&a.name, &a.label, a.samples.len()), (&b.name, &b.label, b.samples.len()));
        for (a, b) in a.samples.iter().zip(&b.samples) {
            assert_eq!(a.time_code, b.time_code);
            assert!((a.exposure - b.exposure).abs() < 1e-6, "{} {}", a.exposure, b.exposure);
            let (a, b) = (&a.camera, &b.camera);
            assert_eq!((a.width, a.height), (b.width, b.height));
            assert!((a.focal_px - b.focal_px).length() < 1e-4, "{a:?} {b:?}");
            assert!((a.principal_px - b.principal_px).length() < 1e-4, "{a:?} {b:?}");
            let difference = a.camera_from_world.compose(&b.camera_from_world.inverse());
            assert!(difference.translation.length() < 1e-6, "{difference:?}");
            let turn = difference.rotation - glam::DMat3::IDENTITY;
            assert!(turn.to_cols_array().iter().all(|value| value.abs() < 1e-6), "{difference:?}");
        }
    }
    for (a, b) in read.nodes.iter().zip(&written.nodes) {
        assert_eq!(a.motion, b.motion, "{}", b.name);
        assert_eq!(a, b, "{}", b.name);
    }
    let read = SceneGraph { cameras: written.cameras.clone(), ..read.clone() };
    assert_eq!(&read, written);
}

fn round_trip(written: &SceneGraph, name: &str, options: ExportOptions) -> SceneGraph {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    export(written, &path, options).unwrap();
    read_scene(&path).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn scenes_come_back_exactly(seed: u64, kind in 0..6_usize, levels_of_detail: bool, frame in 0..4_usize) {
        let _session = session();
        let written = SceneGraph { frame: FRAMES[frame], ..Maker::new(seed).scene() };
        let (name, payloads) = [
            ("a.usda", Payloads::ByKind),
            ("a.usda", Payloads::SingleFile),
            ("a.usdc", Payloads::ByKind),
            ("a.usdc", Payloads::Separate),
            ("a.usdz", Payloads::ByKind),
            ("b.c.usda", Payloads::ByKind),
        ][kind];
        let options = ExportOptions { payloads, levels_of_detail, ..ExportOptions::default() };
        assert_same(&round_trip(&written, name, options), &written);
    }
}

#[test]
fn what_was_read_is_written_the_same() {
    let _session = session();
    let written = Maker::new(7).scene();
    let read = round_trip(&written, "a.usdc", ExportOptions::default());
    let again = round_trip(&read, "a.usda", ExportOptions::default());
    assert_same(&again, &read);
}

#[test]
fn the_evidence_for_rotations_stands_on_the_prim() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let mut scene = Maker::new(9).scene();
    let evidence = [Some(RotationEvidence::Observed), Some(RotationEvidence::Assumed), None];
    scene.nodes.iter_mut().zip(evidence).for_each(|(node, rotation)| node.report.rotation = rotation);
    export(&scene, &path, ExportOptions::default()).unwrap();
    let names: Vec<&str> = scene.nodes.iter().map(|node| node.name.as_str()).take(3).collect();
    let program = format!(
        "
from pxr import Usd
stage = Usd.Stage.Open(path)
names = {names:?}
seen, assumed, unknown = (stage.GetPrimAtPath('/World/' + n).GetAttribute('cif:motion:rotation') for n in names)
assert (seen.Get(), assumed.Get()) == ('observed', 'assumed')
assert not unknown.HasAuthoredValue()
seen.Set('assumed')
stage.Save()
"
    );
    python(&path, &program);
    // Of what the prim and its report say, the prim counts.
    let read = read_scene(&path).unwrap();
    let read: Vec<_> = read.nodes.iter().map(|node| node.report.rotation).take(3).collect();
    assert_eq!(read, [evidence[1], evidence[1], None]);
}

#[test]
fn selected_variants_are_what_is_read() {
    let _session = session();
    let written = Maker::new(11).scene();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    export(&written, &path, ExportOptions::default()).unwrap();
    super::python(
        &path,
        "
from pxr import Usd
stage = Usd.Stage.Open(path)
for name, lod, physics in [('red_mug_001', 'half', 'none'), ('red_mug_006', 'quarter', 'dynamic'),
                           ('red_mug_011', 'half', 'dynamic')]:
    sets = stage.GetPrimAtPath('/World/' + name).GetVariantSets()
    assert sets.GetVariantSet('lod').GetVariantNames() == ['full', 'half', 'quarter'], name
    assert sorted(sets.GetVariantSet('physics').GetVariantNames()) == ['dynamic', 'kinematic', 'none'], name
    assert sets.GetVariantSelection('lod') == 'full'
    sets.SetSelection('lod', lod)
    sets.SetSelection('physics', physics)
stage.Save()
",
    );
    let read = read_scene(&path).unwrap();
    let counts = |graph: &SceneGraph| graph.nodes.iter().map(|node| node.splats.len()).collect::<Vec<_>>();
    let full = counts(&written);
    let read_counts = counts(&read);
    assert_eq!(read_counts[0], full[0].div_ceil(2));
    assert_eq!(read_counts[1], full[1].div_ceil(4));
    assert_eq!(read_counts[3..], full[3..]);
    assert_eq!(read.nodes[1].splats.sh_degree, 0);
    // Rows lead home from any level of detail.
    for (read, written) in read.nodes.iter().zip(&written.nodes) {
        for (index, row) in read.splats.rows.iter().enumerate() {
            let at = written.splats.rows.iter().position(|other| other == row).unwrap();
            assert_eq!(read.splats.means[index], written.splats.means[at]);
            assert_eq!(
                read.splats.sh_coefficients[index * read.splats.sh_coefficients.len() / read.splats.len()],
                written.splats.sh_coefficients
                    [at * written.splats.sh_coefficients.len() / written.splats.len()]
            );
        }
    }
    assert_eq!(read.nodes[0].motion, written.nodes[0].motion);
    // A dynamic body starts where the recording does.
    let start = &written.nodes[1].track()[0];
    let Motion::Rigid(track) = &read.nodes[1].motion else { panic!("{:?}", read.nodes[1].motion) };
    assert_eq!(
        (track.len(), track[0].translation, track[0].rotation),
        (1, start.translation, start.rotation)
    );
}

#[test]
fn a_far_scene_stands_in_the_world_of_its_capture() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    for (number, frame) in FRAMES.into_iter().enumerate() {
        let graph = SceneGraph { frame, ..Maker::new(5).scene() };
        let path = folder.path().join(format!("{number}.usda"));
        export(&graph, &path, ExportOptions { payloads: Payloads::SingleFile, ..ExportOptions::default() })
            .unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let head = text.split("def Xform \"red_mug_001\"").next().unwrap();
        assert_eq!(head.contains("double3 xformOp:translate"), !frame.is_identity(), "{head}");
        assert_eq!(head.contains("double3 xformOp:scale"), frame.scale != 1.0, "{head}");
        // Queries of the stage and of the graph give the same places in the world.
        let label_query = LabelQuery { pattern: "*".into(), time_code: Some(graph.time_codes.start()) };
        let (stage, scene) = (
            crate::query(&path, &label_query, ReadOptions::default()).unwrap(),
            cif_scene::query(&graph, &label_query, "graph").unwrap(),
        );
        assert_eq!(stage.len(), scene.len());
        for (a, b) in stage.iter().zip(&scene) {
            let scale = 1.0 / frame.scale;
            for (row, other) in a.transform.iter().flatten().zip(b.transform.iter().flatten()) {
                assert!((row - other).abs() < 2e-6 * scale + 1e-15 * row.abs(), "{a:?} {b:?}");
            }
            // Both answer by the body of an object. A background has none: its boxes in stages hold turned boxes, so that they
            // are a little wider.
            if let (Some(low), Some(high), Some(inner), Some(outer)) = (a.low, a.high, b.low, b.high) {
                let size = DVec3::from(outer).distance(inner.into());
                for axis in 0..3 {
                    let (below, above) = (inner[axis] - low[axis], high[axis] - outer[axis]);
                    let wider = if b.path.contains("background") { 2.0 * size } else { 1e-4 * scale };
                    let allowed = -1e-4 * scale..=wider;
                    assert!(allowed.contains(&below) && allowed.contains(&above), "{}: {a:?} {b:?}", b.path);
                }
            }
        }
        let everything = ObjectQuery { label: Some("*".into()), ..ObjectQuery::default() };
        let (stage, scene) = (
            crate::search(&path, &everything, ReadOptions::default()).unwrap(),
            cif_scene::search(&graph, &everything, "graph", str::to_owned).unwrap(),
        );
        for a in &stage {
            let Some(b) = scene.iter().find(|b| a.found.path.ends_with(&b.found.path)) else { continue };
            let same = |a: f64, b: f64| (a - b).abs() <= 1e-3 * a.abs().max(b.abs()) + 1e-6 / frame.scale;
            if let (Some(VolumeOf::Hull), Some(VolumeOf::Hull)) = (a.volume_of, b.volume_of) {
                let (a, b) = (a.volume.unwrap(), b.volume.unwrap());
                assert!((a / b - 1.0).abs() < 1e-3, "{a} {b} {frame:?}");
            }
            assert!(same(a.speed, b.speed), "{a:?} {b:?}");
        }
    }
}

#[test]
fn a_stage_that_is_placed_nowhere_is_refused() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let graph = SceneGraph { frame: FRAMES[3], ..Maker::new(5).scene() };
    export(&graph, &path, ExportOptions::default()).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let scale = "double captureScale = 0.001";
    assert!(text.contains(scale));
    std::fs::write(&path, text.replace(scale, "double captureScale = -1")).unwrap();
    let message = read_scene(&path).unwrap_err().to_string();
    assert!(message.contains("/World") && message.contains("captureScale"), "{message}");
}

#[test]
fn joints_of_parts_leave_between_their_bodies_and_come_back() {
    let _session = session();
    for (kind, prim_type) in
        [(JointKind::Revolute, "PhysicsRevoluteJoint"), (JointKind::Prismatic, "PhysicsPrismaticJoint")]
    {
        let mut made = Maker::new(5);
        let node = NodeKind::Instance { id: 3, index: 0 };
        let mut written = Maker::new(5).scene();
        let mut node = made.node(node, MotionModel::Parts);
        let joint =
            PartJoint { base: 0, kind, axis: DVec3::new(0.6, 0.0, 0.8), anchor: DVec3::new(0.1, 0.2, 0.3) };
        let Motion::Parts(motion) = &mut node.motion else { panic!("parts") };
        motion.parts[1].joint = Some(joint);
        written.nodes = vec![node];
        for colliders in [written.nodes[0].colliders.clone(), Vec::new()] {
            written.nodes[0].colliders = colliders;
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.usda");
            export(&written, &path, ExportOptions::default()).unwrap();
            let text = std::fs::read_to_string(&path).unwrap();
            let name = &written.nodes[0].name;
            for expected in [
                prim_type.to_owned(),
                format!("rel physics:body0 = </World/{name}/part_00>"),
                format!("rel physics:body1 = </World/{name}/part_01>"),
                "physics:lowerLimit".to_owned(),
            ] {
                assert!(text.contains(&expected), "{expected} in {text}");
            }
            // Simulators solve joints that are enabled, and Newton wants these to belong to an articulation.
            let disabled = text.matches("physics:jointEnabled = 0").count();
            let rooted = text.contains("PhysicsArticulationRootAPI");
            assert_eq!((disabled, rooted), (1, !written.nodes[0].colliders.is_empty()), "{text}");
            let read = read_scene(&path).unwrap();
            let Motion::Parts(motion) = &read.nodes[0].motion else { panic!("{:?}", read.nodes[0].motion) };
            let found = motion.parts[1].joint.unwrap();
            assert_eq!((found.base, found.kind), (joint.base, joint.kind));
            assert!(found.axis.distance(joint.axis) < 1e-6, "{}", found.axis);
            assert!(found.anchor.distance(joint.anchor) < 1e-6, "{}", found.anchor);
            assert!(motion.parts[0].joint.is_none());
        }
    }
}
