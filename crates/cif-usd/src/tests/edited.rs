//! Our own export after others had it in their hands.

use std::path::Path;

use cif_scene::{CaptureFrame, Motion, Node, NodeKind, SceneGraph};
use glam::DVec3;

use super::{python, scenes::Maker, session};
use crate::{ExportOptions, export, read_scene};

/// The scene before, and after `edits` in a layer over it, which see the composed stage as `stage`.
fn edited(edits: &str) -> (SceneGraph, SceneGraph) {
    edited_at(CaptureFrame::default(), edits)
}

/// As [`edited`], of a scene that lies elsewhere in the world.
fn edited_at(frame: CaptureFrame, edits: &str) -> (SceneGraph, SceneGraph) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let before = SceneGraph { frame, ..Maker::new(21).scene() };
    export(&before, &path, ExportOptions::default()).unwrap();
    let over = folder.path().join("over.usda");
    // As Blender leaves it: a layer of its own with no word on axis, unit and time.
    let program = format!(
        "
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
layer = Sdf.Layer.CreateNew(path)
layer.subLayerPaths.append('./a.usda')
stage = Usd.Stage.Open(layer)
get = lambda name: stage.GetPrimAtPath('/World/' + name)
{edits}
layer.Save()
"
    );
    python(&over, &program);
    let after = read_over(&over);
    (before, after)
}

fn read_over(path: &Path) -> SceneGraph {
    read_scene(path).unwrap()
}

fn node<'a>(graph: &'a SceneGraph, name: &str) -> &'a Node {
    graph.nodes.iter().find(|node| node.name == name).unwrap()
}

#[test]
fn an_empty_layer_changes_nothing() {
    let _session = session();
    let (before, after) = edited("");
    assert_eq!(after.nodes, before.nodes);
    assert_eq!((after.up_axis, after.meters_per_unit), (before.up_axis, before.meters_per_unit));
    assert_eq!(after.time_codes, before.time_codes);
    assert_eq!(after.origin, before.origin);
}

#[test]
fn stand_ins_of_earlier_stages_are_read() {
    let _session = session();
    // Points without an instancer around them.
    let (before, after) = edited(
        "
for proxy in [prim for prim in stage.Traverse() if prim.GetTypeName() == 'PointInstancer']:
    for attribute in proxy.GetPrimAtPath('Prototypes/Points').GetAuthoredAttributes():
        attribute.FlattenTo(proxy)
    stage.OverridePrim(proxy.GetPath().AppendChild('Prototypes')).SetActive(False)
    proxy.SetTypeName('Points')
",
    );
    assert!(before.nodes.iter().any(|node| node.proxy.is_some()));
    assert_eq!(after.nodes, before.nodes);
}

#[test]
fn edits_of_a_far_scene_are_seen_from_its_own_frame() {
    let _session = session();
    let frame = CaptureFrame { offset: [3.1e6, -2.7e5, 41.25], scale: 0.01 };
    // The root moves by 2 in the world, which is 0.02 of the scene.
    let (before, after) = edited_at(
        frame,
        "
op = UsdGeom.Xformable(stage.GetPrimAtPath('/World')).GetOrderedXformOps()[0]
op.Set(op.Get() + Gf.Vec3d(2, 0, 0))
",
    );
    assert_eq!(after.frame, frame);
    for (a, b) in before.nodes.iter().zip(&after.nodes) {
        let (a, b) = (a.world_transform(0.0), b.world_transform(0.0));
        assert!((b.translation - a.translation - DVec3::X * 0.02).length() < 1e-9, "{a:?} {b:?}");
        assert!((b.rotation - a.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-6));
    }
    // What is added next to the root is placed in the world.
    let (before, after) = edited_at(
        frame,
        "
prim = stage.DefinePrim('/Visitor', 'ParticleField3DGaussianSplat')
prim.CreateAttribute('positions', Sdf.ValueTypeNames.Point3fArray).Set(Vt.Vec3fArray([(0, 0, 0)]))
prim.CreateAttribute('scales', Sdf.ValueTypeNames.Float3Array).Set(Vt.Vec3fArray([(1, 1, 1)]))
prim.CreateAttribute('orientations', Sdf.ValueTypeNames.QuatfArray).Set(Vt.QuatfArray([Gf.Quatf(1, 0, 0, 0)]))
prim.CreateAttribute('opacities', Sdf.ValueTypeNames.FloatArray).Set(Vt.FloatArray([0.5]))
UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(3.1e6 + 100, -2.7e5, 41.25))
",
    );
    assert_eq!(after.nodes.len(), before.nodes.len() + 1);
    assert_eq!(after.nodes[..before.nodes.len()], before.nodes);
    let visitor = after.nodes.last().unwrap();
    assert!((visitor.pivot - DVec3::X).length() < 1e-9, "{:?}", visitor.pivot);
    assert!(visitor.splats.scales[0].iter().all(|scale| (scale - 0.01).abs() < 1e-7));
}

#[test]
fn a_layer_with_its_own_rate_retimes_what_is_below() {
    let _session = session();
    let (before, after) = edited("layer.timeCodesPerSecond = 25");
    let codes: Vec<f64> = before.time_codes.samples.iter().map(|code| code * 2.0).collect();
    assert_eq!((after.time_codes.samples, after.time_codes.frames_per_second), (codes, 25.0));
    let times: Vec<f64> = after.nodes[1].track().iter().map(|sample| sample.time_code).collect();
    let twice: Vec<f64> = before.nodes[1].track().iter().map(|sample| sample.time_code * 2.0).collect();
    assert_eq!(times, twice);
}

#[test]
fn names_places_and_presence_follow_the_edits() {
    let _session = session();
    let (before, after) = edited(
        "
get('red_mug_001').GetAttribute('userProperties:label').Set('blue mug')
get('red_mug_001').GetAttribute('xformOp:translate').Set(Gf.Vec3d(7, 8, 9))
get('red_mug_006').SetActive(False)
get('red_mug_011').SetDisplayName('tall mug')
UsdGeom.Imageable(get('red_mug_011')).MakeInvisible()
get('red_mug_016').GetAttribute('semantics:labels:class').Set(['cup', 'red \"mug\" \\u00dc'])
",
    );
    assert_eq!(after.nodes.len(), before.nodes.len() - 1);
    assert!(after.nodes.iter().all(|node| node.name != "red_mug_006"));
    let moved = node(&after, "red_mug_001");
    assert_eq!((moved.label.as_str(), moved.pivot), ("blue mug", DVec3::new(7.0, 8.0, 9.0)));
    assert_eq!(moved.splats, node(&before, "red_mug_001").splats);
    assert_eq!(moved.motion, Motion::Static);
    assert_eq!(node(&after, "red_mug_011").label, "tall mug");
    assert!(!node(&after, "red_mug_011").is_visible(0.0));
    assert_eq!(node(&after, "red_mug_016").category, "cup");
    assert_eq!(node(&after, "red_mug_016").label, node(&before, "red_mug_016").label);
    assert_eq!(node(&after, "background"), node(&before, "background"));
}

#[test]
fn any_transform_moves_a_node() {
    let _session = session();
    let (before, after) = edited(
        "
x = UsdGeom.Xformable(get('red_mug_006'))
x.ClearXformOpOrder()
m = Gf.Matrix4d(1)
m.SetTranslateOnly((1, 2, 3))
x.AddTransformOp(opSuffix='edit').Set(m)
UsdGeom.Xformable(stage.GetPrimAtPath('/World')).AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
",
    );
    let (was, is) = (node(&before, "red_mug_001"), node(&after, "red_mug_001"));
    assert!((is.pivot - was.pivot * 2.0).length() < 1e-9, "the world grew: {} {}", is.pivot, was.pivot);
    let grown: Vec<f32> = was.splats.scales.iter().flatten().map(|scale| scale * 2.0).collect();
    assert!(is.splats.scales.iter().flatten().zip(&grown).all(|(a, b)| (a - b).abs() < 1e-6));
    let placed = node(&after, "red_mug_006");
    assert!((placed.world_transform(0.0).translation - DVec3::new(2.0, 4.0, 6.0)).length() < 1e-6);
    assert_eq!(placed.motion, Motion::Static, "its samples are out of force");
}

#[test]
fn copies_by_reference_are_recognised() {
    let _session = session();
    let (before, after) = edited(
        "
Sdf.CreatePrimInLayer(layer, '/World')
copy = stage.DefinePrim('/World/a_second_mug')
copy.GetReferences().AddInternalReference('/World/red_mug_001')
",
    );
    let (copy, original) = (node(&after, "a_second_mug"), node(&before, "red_mug_001"));
    assert_eq!((copy.kind, &copy.splats), (original.kind, &original.splats));
}

#[test]
fn copies_and_colours_are_recognised() {
    let _session = session();
    let (before, after) = edited(
        "
source = stage.GetPrimAtPath('/World/red_mug_001')
flat = stage.Flatten()
Sdf.CreatePrimInLayer(layer, '/World')
Sdf.CopySpec(flat, '/World/red_mug_001', layer, '/World/a_second_mug')
colors = get('red_mug_016/red_mug_016_splats').GetAttribute('primvars:displayColor')
primvar = UsdGeom.Primvar(colors)
values = [Gf.Vec3f(c) for c in primvar.ComputeFlattened()]
values[0] = Gf.Vec3f(0.25, 0.5, 0.75)
primvar.BlockIndices()
colors.Set(Vt.Vec3fArray(values))
",
    );
    let (copy, original) = (node(&after, "a_second_mug"), node(&before, "red_mug_001"));
    assert_eq!((copy.kind, &copy.splats), (original.kind, &original.splats));
    assert!(
        after
            .warnings
            .iter()
            .any(|text| text == "/World/a_second_mug is a copy of /World/red_mug_001 (instance 1)"),
        "{:?}",
        after.warnings
    );
    let (was, is) = (&node(&before, "red_mug_016").splats, &node(&after, "red_mug_016").splats);
    let color = is.base_colors()[0];
    assert!(color.iter().zip([0.25, 0.5, 0.75]).all(|(a, b)| (a - b).abs() < 1e-6), "{color:?}");
    assert_eq!(is.base_colors()[1..], was.base_colors()[1..]);
    assert_eq!(is.sh_coefficients[3..], was.sh_coefficients[3..], "only what was changed");
    assert!(
        after.warnings.iter().any(|text| text.contains("1 splats were recoloured")),
        "{:?}",
        after.warnings
    );
}

#[test]
fn strangers_may_join() {
    let _session = session();
    let (before, after) = edited(
        "
flat = stage.Flatten()
Sdf.CreatePrimInLayer(layer, '/World')
Sdf.CopySpec(flat, '/World/red_mug_001/red_mug_001_splats', layer, '/World/visitor')
for name in ['primvars:cif:row', 'cif:displayColorChecksum']:
    spec = layer.GetPrimAtPath('/World/visitor')
    spec.RemoveProperty(spec.properties[name])
",
    );
    assert_eq!(after.nodes.len(), before.nodes.len() + 1);
    let visitor = node(&after, "visitor");
    assert_eq!(visitor.kind, NodeKind::Instance { id: 2, index: 4 });
    assert!(visitor.splats.rows.iter().all(|&row| row == cif_scene::Splats::NO_ROW));
    assert_eq!(visitor.splats.means, node(&before, "red_mug_001").splats.means);
}
