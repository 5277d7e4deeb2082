//! Stages that others wrote.

use cif_scene::{Motion, NodeKind, SceneGraph, Splats, UpAxis};
use glam::{DMat3, DQuat, DVec3};

use super::damaged::stage_with;
use super::session;
use crate::read_scene;

fn read(change: &str) -> SceneGraph {
    let folder = tempfile::tempdir().unwrap();
    read_scene(&stage_with(folder.path(), change)).unwrap()
}

/// World centre and covariance of a splat at a time code.
fn world(graph: &SceneGraph, node: usize, splat: usize, time_code: f64) -> (DVec3, DMat3) {
    let node = &graph.nodes[node];
    let mut transform = node.world_transform(time_code);
    let (mut mean, mut q, mut s) =
        (node.splats.means[splat], node.splats.orientations[splat], node.splats.scales[splat]);
    match &node.motion {
        Motion::Dense(dense) => {
            let sample = dense.samples.iter().find(|sample| sample.time_code == time_code).unwrap();
            (mean, q) = (sample.means[splat], sample.orientations[splat]);
            s = sample.scales.as_ref().map_or(s, |scales| scales[splat]);
        }
        Motion::Parts(motion) => {
            let part = motion.parts.iter().find(|part| part.splats.contains(&splat)).unwrap();
            let pose = cif_scene::graph::pose_at(&part.track, part.pivot, time_code);
            transform = transform.compose(&pose.transform());
        }
        _ => {}
    }
    let axes = transform.rotation
        * DMat3::from_quat(DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into()).normalize())
        * DMat3::from_diagonal(DVec3::from_array(s.map(f64::from)));
    (transform.apply(DVec3::from_array(mean.map(f64::from))), axes * axes.transpose())
}

/// The second splat of `stage_with` after an affine map.
fn expected(map: DMat3, shift: DVec3) -> (DVec3, DMat3) {
    let axes = map
        * DMat3::from_quat(DQuat::from_xyzw(0.8, 0.0, 0.0, 0.6))
        * DMat3::from_diagonal(DVec3::new(0.3, 0.2, 0.1));
    (map * DVec3::new(1.0, 2.0, 3.0) + shift, axes * axes.transpose())
}

fn assert_there(found: (DVec3, DMat3), expected: (DVec3, DMat3), case: &str) {
    assert!((found.0 - expected.0).length() < 1e-5, "{case}: {} {}", found.0, expected.0);
    let spread = (found.1 - expected.1).to_cols_array();
    assert!(spread.iter().all(|value| value.abs() < 1e-5), "{case}: {spread:?}");
}

#[test]
fn a_plain_scan_is_background() {
    let _session = session();
    let graph = read("");
    assert_eq!(graph.nodes.len(), 1);
    assert_eq!(graph.nodes[0].kind, NodeKind::Background);
    assert_eq!((graph.up_axis, graph.meters_per_unit), (UpAxis::Z, 1.0));
    assert_eq!(graph.nodes[0].splats.rows, [Splats::NO_ROW; 2]);
    assert_eq!(graph.nodes[0].splats.orientations[1], [0.6, 0.8, 0.0, 0.0]);
    assert_eq!(graph.nodes[0].splats.sh_coefficients, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    assert!(graph.origin.field_fingerprint.is_none() && graph.origin.options.is_none());
    assert_there(world(&graph, 0, 1, 0.0), expected(DMat3::IDENTITY, DVec3::ZERO), "plain");
}

#[test]
fn labels_models_and_names_make_instances() {
    let _session = session();
    let graph = read(
        "
labels = UsdSemantics.LabelsAPI.Apply(thing.GetPrim(), 'class')
labels.CreateLabelsAttr(['mug', 'my mug'])
Sdf.CopySpec(stage.GetRootLayer(), '/World/Thing', stage.GetRootLayer(), '/World/Other')
stage.GetPrimAtPath('/World/Other').GetAttribute('semantics:labels:class').Set(['cup'])
stage.GetPrimAtPath('/World/Other').SetDisplayName('Grandma')
copy = UsdGeom.Xform.Define(stage, '/World/Model')
Usd.ModelAPI(copy).SetKind('component')
for name in 'ab':
    Sdf.CopySpec(stage.GetRootLayer(), '/World/Thing/Cloud', stage.GetRootLayer(), '/World/Model/' + name)
Sdf.CopySpec(stage.GetRootLayer(), '/World/Thing/Cloud', stage.GetRootLayer(), '/World/Loose')
",
    );
    let told: Vec<_> = graph
        .nodes
        .iter()
        .map(|node| (node.name.as_str(), node.label.as_str(), node.category.as_str(), node.splats.len()))
        .collect();
    assert_eq!(
        told,
        [
            ("Thing", "my mug", "mug", 2),
            ("Other", "Grandma", "cup", 2),
            ("Model", "Model", "Model", 4),
            ("Loose", "Loose", "Loose", 2),
        ]
    );
    let ids: Vec<_> = graph.nodes.iter().map(|node| node.kind).collect();
    let instance = |id, index| NodeKind::Instance { id, index };
    assert_eq!(ids, [instance(1, 0), instance(2, 1), instance(3, 2), instance(4, 3)]);
}

#[test]
fn nested_static_transforms_are_followed() {
    let _session = session();
    let turn = DMat3::from_rotation_z(0.5_f64.to_degrees().to_radians());
    let cases = [
        (
            "world.AddTranslateOp().Set(Gf.Vec3d(1, 0, 0))\nthing.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))",
            DMat3::IDENTITY * 2.0,
            DVec3::X,
        ),
        (
            "thing.AddScaleOp().Set(Gf.Vec3f(1, 3, 0.5))",
            DMat3::from_diagonal(DVec3::new(1.0, 3.0, 0.5)),
            DVec3::ZERO,
        ),
        (
            "thing.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))",
            DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)),
            DVec3::ZERO,
        ),
        (
            "thing.AddRotateZOp().Set(28.64788975654116)\nUsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(1, 2, 1))\nworld.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))",
            turn * DMat3::from_diagonal(DVec3::new(1.0, 2.0, 1.0)),
            DVec3::Z * 5.0,
        ),
        (
            "m = Gf.Matrix4d(1)\nm.SetTranslateOnly((0, 7, 0))\nm[1, 0] = 0.5\nthing.AddTransformOp().Set(m)",
            DMat3::from_cols(DVec3::X, DVec3::new(0.5, 1.0, 0.0), DVec3::Z),
            DVec3::Y * 7.0,
        ),
    ];
    for (change, map, shift) in cases {
        let graph = read(change);
        assert_there(world(&graph, 0, 1, 0.0), expected(map, shift), change);
        assert_eq!(graph.nodes[0].splats.sh_coefficients, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    }
}

#[test]
fn sampled_transforms_become_tracks_parts_or_samples() {
    let _session = session();
    // Rigid, with a static uneven scale below the moving prim.
    let graph = read(
        "
op = thing.AddRotateZOp()
for t, angle in [(0, 0), (10, 270)]:
    op.Set(angle, t)
UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(1, 2, 1))
",
    );
    let Motion::Rigid(track) = &graph.nodes[0].motion else { panic!("{:?}", graph.nodes[0].motion) };
    assert_eq!(track.len(), 11, "every frame: angles beyond a half turn are no straight way");
    let scale = DMat3::from_diagonal(DVec3::new(1.0, 2.0, 1.0));
    for frame in [0.0_f64, 3.0, 10.0] {
        let turn = DMat3::from_rotation_z((27.0 * frame).to_radians());
        assert_there(world(&graph, 0, 1, frame), expected(turn * scale, DVec3::ZERO), "rigid");
    }
    // Growing: nothing rigid.
    let graph = read(
        "
op = thing.AddScaleOp()
for t, scale in [(0, 1), (4, 3)]:
    op.Set(Gf.Vec3f(scale, 1, 1), t)
",
    );
    assert!(matches!(graph.nodes[0].motion, Motion::Dense(_)), "{:?}", graph.nodes[0].motion);
    for frame in [0.0, 4.0] {
        let map = DMat3::from_diagonal(DVec3::new(1.0 + frame / 2.0, 1.0, 1.0));
        assert_there(world(&graph, 0, 1, frame), expected(map, DVec3::ZERO), "growing");
    }
    // Two prims that move apart under one model.
    let graph = read(
        "
Usd.ModelAPI(thing).SetKind('component')
Sdf.CopySpec(stage.GetRootLayer(), '/World/Thing/Cloud', stage.GetRootLayer(), '/World/Thing/Second')
op = UsdGeom.Xformable(stage.GetPrimAtPath('/World/Thing/Second')).AddTranslateOp()
op.Set(Gf.Vec3d(0, 0, 0), 0)
op.Set(Gf.Vec3d(0, 4, 0), 2)
",
    );
    let Motion::Parts(motion) = &graph.nodes[0].motion else { panic!("{:?}", graph.nodes[0].motion) };
    assert_eq!(motion.parts.iter().map(|part| part.name.as_str()).collect::<Vec<_>>(), ["Cloud", "Second"]);
    assert_there(world(&graph, 0, 1, 2.0), expected(DMat3::IDENTITY, DVec3::ZERO), "still part");
    assert_there(world(&graph, 0, 3, 2.0), expected(DMat3::IDENTITY, DVec3::Y * 4.0), "moving part");
    assert_eq!(graph.time_codes.samples, [0.0, 2.0]);
}

#[test]
fn half_precision_and_deformation_are_read() {
    let _session = session();
    let graph = read(
        "
for name in ['positions', 'orientations', 'scales', 'opacities', 'radiance:sphericalHarmonicsCoefficients']:
    prim.GetAttribute(name).Clear()
prim.GetAttribute('positionsh').Set([(0, 0, 0), (1, 2, 3)])
prim.GetAttribute('positionsh').Set([(0, 0, 0), (1, 2, 3)], 0)
prim.GetAttribute('positionsh').Set([(0, 0, 0), (1, 2, 4)], 5)
prim.GetAttribute('orientationsh').Set(Vt.QuathArray([Gf.Quath(1, 0, 0, 0), Gf.Quath(0.6, 0.8, 0, 0)]))
prim.GetAttribute('scalesh').Set([(0.1, 0.2, 0.3), (0.3, 0.2, 0.1)])
prim.GetAttribute('opacitiesh').Set([0.5, 1])
splats.GetRadianceSphericalHarmonicsDegreeAttr().Set(1)
prim.GetAttribute('radiance:sphericalHarmonicsCoefficientsh').Set([(k, 0, 0) for k in range(8)])
",
    );
    let node = &graph.nodes[0];
    let Motion::Dense(dense) = &node.motion else { panic!("{:?}", node.motion) };
    assert_eq!(dense.samples[1].means[1], [1.0, 2.0, 4.0]);
    assert_eq!((node.splats.sh_degree, node.splats.sh_coefficients[12]), (1, 4.0));
    let norm: f32 = node.splats.orientations[1].iter().map(|component| component * component).sum();
    assert!((norm - 1.0).abs() < 1e-6, "unit again after rounding: {norm}");
    assert!((node.splats.scales[0][0] - 0.1).abs() < 1e-4);
}

#[test]
fn axis_unit_and_colours_are_told() {
    let _session = session();
    let graph = read(
        "
UsdGeom.SetStageUpAxis(stage, 'Y')
UsdGeom.SetStageMetersPerUnit(stage, 0.01)
sh.Clear()
splats.CreateDisplayColorPrimvar('constant').Set([(1, 0.5, 0)])
",
    );
    assert_eq!((graph.up_axis, graph.meters_per_unit), (UpAxis::Y, 0.01));
    let colors = graph.nodes[0].splats.base_colors();
    for color in colors {
        assert!(color.iter().zip([1.0, 0.5, 0.0]).all(|(a, b)| (a - b).abs() < 1e-6), "{color:?}");
    }
}
