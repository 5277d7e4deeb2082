//! Stages that others wrote.

use cif_scene::{LabelQuery, Motion, NodeKind, ObjectQuery, SceneGraph, Splats, UpAxis};
use glam::{DMat3, DQuat, DVec3};

use super::damaged::stage_with;
use super::session;
use crate::{ExportOptions, ReadOptions, export, query, read_scene, relabel, search};

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
    let found: Vec<_> = graph
        .nodes
        .iter()
        .map(|node| (node.name.as_str(), node.label.as_str(), node.category.as_str(), node.splats.len()))
        .collect();
    assert_eq!(
        found,
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
    assert_eq!(track.len(), 11, "every frame: angles beyond a half turn are not the shorter arc");
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
fn axis_unit_and_colours_are_reported() {
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

#[test]
fn stages_are_played_at_the_rate_that_usd_plays_them_at() {
    let _session = session();
    let keys = "
op = thing.AddTranslateOp()
for t in (101, 131):
    op.Set(Gf.Vec3d(t, 0, 0), t)
";
    for (says, expected) in [
        ("", 24.0),
        ("stage.SetFramesPerSecond(60)", 60.0),
        ("stage.SetTimeCodesPerSecond(48)\nstage.SetFramesPerSecond(60)", 48.0),
    ] {
        let graph = read(&format!("{keys}{says}"));
        assert_eq!(graph.time_codes.frames_per_second, expected, "{says}");
        assert_eq!(graph.time_codes.samples, [101.0, 131.0]);
        let field = cif_scene::field_from_graph(&graph, "a.usda").unwrap();
        let back = cif_scene::build(&field, &cif_scene::SceneOptions::default()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.usda");
        export(&back, &path, ExportOptions::default()).unwrap();
        let again = read_scene(&path).unwrap();
        assert_eq!((again.time_codes.start(), again.time_codes.end()), (101.0, 131.0));
        assert!(
            (again.nodes[0].boxes().world(131.0).low.x - graph.nodes[0].boxes().world(131.0).low.x).abs()
                < 1e-4
        );
    }
}

#[test]
fn stand_ins_and_guides_are_no_objects() {
    let _session = session();
    let graph = read(
        "
for name, purpose in [('Drawn', 'render'), ('Light', 'proxy'), ('Help', 'guide')]:
    group = UsdGeom.Xform.Define(stage, '/World/' + name)
    group.CreatePurposeAttr(purpose)
    Sdf.CopySpec(stage.GetRootLayer(), '/World/Thing/Cloud', stage.GetRootLayer(), f'/World/{name}/Cloud')
",
    );
    assert_eq!(graph.nodes.len(), 2);
    assert!(graph.nodes.iter().all(|node| node.splats.len() == 2));
    let purposes: Vec<&String> =
        graph.warnings.iter().filter(|warning| warning.contains("purpose")).collect();
    assert_eq!(purposes.len(), 2, "{:?}", graph.warnings);
    assert!(purposes[0].starts_with("/World/Light/Cloud: its purpose is proxy"), "{purposes:?}");
}

#[test]
fn colours_of_other_spaces_become_display_values() {
    let _session = session();
    let color = |graph: &SceneGraph| graph.nodes[0].splats.base_colors()[0];
    let linear = "sh.Set([((v - 0.5) / 0.28209479,) * 3 for v in (0.2, 0.5)])\n";
    let api = |prim: &str, space: &str| {
        format!("Usd.ColorSpaceAPI.Apply({prim}).CreateColorSpaceNameAttr('{space}')\n")
    };
    let cases = [
        (String::new(), 0.2, 0),
        (api("prim", "lin_rec709_scene"), 0.484_529, 1),
        (api("world.GetPrim()", "lin_rec709_scene"), 0.484_529, 1),
        ("sh.SetColorSpace('lin_rec2020_scene')\n".to_owned(), 0.484_529, 1),
        (api("prim", "srgb_rec709_scene"), 0.2, 0),
        (api("prim", "raw"), 0.2, 0),
        (api("prim", "my_own"), 0.2, 1),
    ];
    for (says, expected, count) in cases {
        let graph = read(&format!("{linear}{says}"));
        let found = color(&graph);
        assert!(found.iter().all(|value| (value - expected).abs() < 1e-4), "{says}: {found:?}");
        let warnings = graph.warnings.iter().filter(|warning| warning.contains("colour")).count();
        assert_eq!(warnings, count, "{says}: {:?}", graph.warnings);
    }
    // Another primary is another colour, and colours of any numbers are taken by their range.
    let graph =
        read(&format!("{linear}sh.Set([(1.0, -1.0, -1.0)] * 2)\n{}", api("prim", "lin_rec2020_scene")));
    let [red, green, _] = color(&graph);
    assert!(red > 0.95 && green < 0.5, "{red} {green}");
    let graph = read("sh.Clear()\nsplats.CreateDisplayColorPrimvar('constant').Set([(255, 51, 0)])\n");
    assert!(color(&graph).iter().zip([1.0, 0.2, 0.0]).all(|(a, b)| (a - b).abs() < 1e-5));
    assert!(graph.warnings[0].contains("up to 255"), "{:?}", graph.warnings);
    let grey = "sh.Clear()\nsplats.CreateDisplayColorPrimvar('constant').Set([(0.2, 0.2, 0.2)])\n";
    let graph = read(&format!("{grey}{}", api("prim", "lin_rec709_scene")));
    assert!((color(&graph)[0] - 0.484_529).abs() < 1e-4);
}

#[test]
fn labels_inside_of_instances_and_of_earlier_tools_are_found() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = stage_with(
        folder.path(),
        "
shared = stage.CreateClassPrim('/_shared')
Sdf.CopySpec(stage.GetRootLayer(), '/World/Thing', stage.GetRootLayer(), '/_shared/Mug')
stage.RemovePrim('/World/Thing')
UsdSemantics.LabelsAPI.Apply(stage.GetPrimAtPath('/_shared/Mug'), 'class').CreateLabelsAttr(['mug'])
for k in range(3):
    copy = UsdGeom.Xform.Define(stage, f'/World/Copy{k}')
    copy.AddTranslateOp().Set(Gf.Vec3d(3 * k, 0, 0))
    copy.GetPrim().GetReferences().AddInternalReference('/_shared')
    copy.GetPrim().SetInstanceable(True)
for k, key in enumerate(['semanticData', 'semanticLabel']):
    Sdf.CopySpec(stage.GetRootLayer(), '/_shared/Mug/Cloud', stage.GetRootLayer(), f'/World/Old{k}')
    old = stage.GetPrimAtPath(f'/World/Old{k}')
    for end, value in (('semanticType', 'class'), (key, 'cup')):
        old.CreateAttribute(f'semantic:Semantics_{k}:params:{end}', Sdf.ValueTypeNames.String).Set(value)
",
    );
    let labelled = |path: &std::path::Path, label: &str| -> Vec<String> {
        let asked = LabelQuery { pattern: label.to_owned(), time_code: None };
        let found = query(path, &asked, ReadOptions::default()).unwrap();
        let object_query = ObjectQuery { label: Some(label.to_owned()), ..ObjectQuery::default() };
        let searched = search(path, &object_query, ReadOptions::default()).unwrap();
        let paths: Vec<String> = found.into_iter().map(|object| object.path).collect();
        assert_eq!(paths, searched.into_iter().map(|object| object.found.path).collect::<Vec<_>>());
        paths
    };
    assert_eq!(labelled(&path, "mug"), ["/World/Copy0/Mug", "/World/Copy1/Mug", "/World/Copy2/Mug"]);
    assert_eq!(labelled(&path, "cup"), ["/World/Old0", "/World/Old1"]);
    let labels = |path: &std::path::Path| -> Vec<String> {
        read_scene(path).unwrap().nodes.into_iter().map(|node| node.label).collect()
    };
    assert_eq!(labels(&path), ["mug", "mug", "mug", "cup", "cup"]);
    relabel(&path, &path, "/World/Copy1/Mug", "jug", None).unwrap();
    let done = relabel(&path, &path, "/World/Old0", "glass", None).unwrap();
    assert_eq!(done.before, "cup");
    assert_eq!(labels(&path), ["mug", "jug", "mug", "glass", "cup"]);
    assert_eq!(labelled(&path, "jug"), ["/World/Copy1/Mug"]);
    assert_eq!(labelled(&path, "cup"), ["/World/Old1"]);
}

#[test]
fn a_stage_far_from_its_origin_keeps_its_places() {
    let _session = session();
    let at = DVec3::new(500_123.25, 4_649_776.125, 215.5);
    let place = format!("Gf.Vec3d({}, {}, {})", at.x, at.y, at.z);
    let matrix = "Gf.Matrix4d(1).SetTranslate";
    for far in [
        format!("world.AddTranslateOp().Set({place})"),
        format!("UsdGeom.Xformable(prim).AddTransformOp().Set({matrix}({place}))"),
        format!("thing.AddTransformOp().Set({matrix}({place}))\nUsd.ModelAPI(thing).SetKind('component')"),
        format!(
            "
spec = stage.GetRootLayer().GetPrimAtPath('/World/Thing/Cloud')
del spec.properties['positions']
doubles = Sdf.AttributeSpec(spec, 'positions', Sdf.ValueTypeNames.Point3dArray)
doubles.default = Vt.Vec3dArray([{place}, {place} + Gf.Vec3d(1, 2, 3)])
"
        ),
    ] {
        let graph = read(&far);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.usda");
        export(&graph, &path, ExportOptions::default()).unwrap();
        for graph in [graph, read_scene(&path).unwrap()] {
            let (mean, _) = world(&graph, 0, 1, 0.0);
            let found = graph.frame.capture_from_dataset(mean);
            let expected = at + DVec3::new(1.0, 2.0, 3.0);
            assert!((found - expected).length() < 1e-5, "{far}: {found} {expected}");
        }
    }
}

#[test]
fn flat_splats_of_a_stage_stay_flat() {
    let _session = session();
    let graph = read("splats.GetScalesAttr().Set([(0.1, 0.2, 0), (0.3, 0, 0.1)])");
    let scales = [[0.1, 0.2, 0.0], [0.3, 0.0, 0.1]];
    assert_eq!(graph.nodes[0].splats.scales, scales);
    let field = cif_scene::field_from_graph(&graph, "a.usda").unwrap();
    let back = cif_scene::build(&field, &cif_scene::SceneOptions::default()).unwrap();
    assert!(!back.warnings.iter().any(|warning| warning.contains("left out")), "{:?}", back.warnings);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("b.usda");
    export(&back, &path, ExportOptions::default()).unwrap();
    for (a, b) in read_scene(&path).unwrap().nodes[0].splats.scales.iter().zip(scales) {
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-6 * b), "{a:?} {b:?}");
    }
}
