//! Stages that cannot be read, each with an error that names the prim or file and the fix.

use std::fs;
use std::path::{Path, PathBuf};

use cif_scene::files::FileError;
use cif_scene::{LabelQuery, ObjectQuery};

use super::{python, scenes::Maker, session};
use crate::{
    ExportOptions, ReadOptions, UsdError, export, query, read_scene, read_scene_with, relabel, search,
};

/// One splat prim of two splats under /World/Thing, with `change` made to it before saving.
pub(super) fn stage_with(folder: &Path, change: &str) -> PathBuf {
    let path = folder.join("thing.usda");
    let program = format!(
        "
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSemantics, UsdVol, Vt
stage = Usd.Stage.CreateNew(path)
UsdGeom.SetStageUpAxis(stage, 'Z')
UsdGeom.SetStageMetersPerUnit(stage, 1)
world = UsdGeom.Xform.Define(stage, '/World')
stage.SetDefaultPrim(world.GetPrim())
thing = UsdGeom.Xform.Define(stage, '/World/Thing')
splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, '/World/Thing/Cloud')
prim = splats.GetPrim()
splats.CreatePositionsAttr([(0, 0, 0), (1, 2, 3)])
splats.CreateOrientationsAttr([Gf.Quatf(1, 0, 0, 0), Gf.Quatf(0.6, 0.8, 0, 0)])
splats.CreateScalesAttr([(0.1, 0.2, 0.3), (0.3, 0.2, 0.1)])
splats.CreateOpacitiesAttr([0.5, 1])
splats.CreateRadianceSphericalHarmonicsDegreeAttr(0)
sh = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr([(1, 0, 0), (0, 1, 0)])
sh.SetMetadata('elementSize', 1)
{change}
stage.Save()
"
    );
    python(&path, &program);
    path
}

#[test]
fn splats_that_make_no_sense_are_named() {
    let _session = session();
    let cases = [
        (
            "splats.GetPositionsAttr().Set([(0, 0, 0), (1, float('nan'), 3)])",
            "/World/Thing/Cloud: position 1 is not finite",
        ),
        (
            "splats.GetOrientationsAttr().Set([Gf.Quatf(0, 0, 0, 0), Gf.Quatf(1, 0, 0, 0)])",
            "orientation 0 (0, 0, 0, 0) has no direction; make it a unit",
        ),
        ("splats.GetOrientationsAttr().Set([Gf.Quatf(1, 0, 0, 0)])", "2 positions, but 1 orientations"),
        ("splats.GetScalesAttr().Set([(1, 1, 1)] * 3)", "2 positions, but 3 scales"),
        (
            "splats.GetScalesAttr().Set([(1, 1, 1), (-1, 1, 1)])",
            "scale 1 [-1.0, 1.0, 1.0] is no standard deviation",
        ),
        ("splats.GetScalesAttr().Clear()", "no scales"),
        ("splats.GetOpacitiesAttr().Set([0.5, 7])", "opacity 1 is 7; opacities are probabilities"),
        ("splats.GetOpacitiesAttr().Set([0.5])", "2 positions, but 1 opacities"),
        (
            "splats.GetRadianceSphericalHarmonicsDegreeAttr().Set(9)",
            "radiance:sphericalHarmonicsDegree is 9; degrees 0 to 3",
        ),
        (
            "splats.GetRadianceSphericalHarmonicsDegreeAttr().Set(-1)",
            "radiance:sphericalHarmonicsDegree is -1",
        ),
        (
            "splats.GetRadianceSphericalHarmonicsDegreeAttr().Set(2)",
            "2 positions, but 2 coefficients of degree 2, which has 9 per splat",
        ),
        ("sh.SetMetadata('elementSize', 1000000000)", "elementSize of the coefficients is 1000000000"),
        ("sh.Set([(1, 0, 0)] * 5)", "2 positions, but 5 coefficients of degree 0"),
        ("sh.Set([(1, 0, 0), (float('inf'), 0, 0)])", "coefficient of splat 1 is not finite"),
        ("splats.GetPositionsAttr().Clear()", "holds no splats"),
        ("prim.SetActive(False)", "holds no splats"),
        ("stage.RemovePrim('/World/Thing')", "holds no splats"),
        (
            "stage.RemovePrim('/World/Thing')\nstage.DefinePrim('/World/Ball', 'Sphere')",
            "with positions; it has prims of type Sphere",
        ),
        (
            "stage.RemovePrim('/World/Thing')\nstage.DefinePrim('/World/V', 'Volume')\n\
             stage.DefinePrim('/World/V/density', 'OmniNuRecFieldAsset')",
            "NuRec's, whose splats USD does not describe: export them as ParticleField3DGaussianSplat, or as .ply",
        ),
        ("thing.AddScaleOp().Set(Gf.Vec3f(1, 0, 1))", "its transform flattens everything"),
        ("UsdGeom.SetStageMetersPerUnit(stage, 0)", "metersPerUnit is 0"),
        (
            "splats.GetPositionsAttr().Set([(0, 0, 0), (1, 2, 3)], 1)\nsplats.GetPositionsAttr().Set([(0, 0, 0)], 2)\n",
            "1 positions, but 2 scales at time code 2",
        ),
        (
            "a = UsdGeom.PrimvarsAPI(prim).CreatePrimvar('cif:row', Sdf.ValueTypeNames.IntArray, 'vertex')\na.Set([1, 2])\na.SetIndices([0, 7])",
            "an index of primvars:cif:row is outside its 2 values",
        ),
        (
            "a = UsdGeom.PrimvarsAPI(prim).CreatePrimvar('cif:occupancy', Sdf.ValueTypeNames.FloatArray, 'vertex')\na.Set([1, -2])",
            "primvars:cif:occupancy 1 is -2",
        ),
    ];
    for (change, expected) in cases {
        let folder = tempfile::tempdir().unwrap();
        let path = stage_with(folder.path(), change);
        let error = read_scene(&path).unwrap_err().to_string();
        assert!(error.contains(expected) && error.contains("thing.usda"), "{change}: {error}");
    }
}

#[test]
fn files_that_are_no_stages_are_named() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let none = folder.path().join("none.usdc");
    assert!(matches!(read_scene(&none), Err(UsdError::NotFound { .. })));
    for (name, bytes) in [
        ("text.usda", &b"hello"[..]),
        ("short.usdc", b"PXR-USDC\0\0"),
        ("zip.usdz", b"PK\x03\x04"),
        ("empty.usda", b""),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        let error = read_scene(&path).unwrap_err();
        assert!(matches!(error, UsdError::Unreadable { .. }), "{name}: {error}");
        assert!(error.to_string().contains(name), "{error}");
    }
}

#[test]
fn claims_beyond_the_file_are_refused() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("claim.usdc");
    python(
        &path,
        "
import numpy as np, struct
from pxr import Usd, UsdVol, Vt
n, chance = 1000, np.random.default_rng(1)
stage = Usd.Stage.CreateNew(path)
splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, '/S')
of = lambda columns: chance.random((n, columns), dtype=np.float32)
splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(of(3)))
splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(of(3)))
stage.Save()
del stage, splats
data = bytearray(open(path, 'rb').read())
at = data.find(struct.pack('<Q', n))
assert at > 0
data[at:at + 8] = struct.pack('<Q', 10**9)
open(path, 'wb').write(data)
",
    );
    let error = read_scene(&path).unwrap_err().to_string();
    assert!(error.contains("/S: positions cannot be read") && error.contains("out-of-bounds"), "{error}");
}

#[test]
fn cut_files_are_refused() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("whole.usdc");
    export(&Maker::new(5).scene(), &path, ExportOptions::default()).unwrap();
    let whole = fs::read(&path).unwrap();
    for share in [1, 10, 50, 90, 99] {
        let cut = folder.path().join(format!("cut{share}.usdc"));
        fs::write(&cut, &whole[..whole.len() * share / 100]).unwrap();
        let error = read_scene(&cut).unwrap_err();
        assert!(matches!(error, UsdError::Unreadable { .. }), "{share}: {error}");
    }
}

#[test]
fn missing_and_distant_layers_are_refused() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("inner");
    fs::create_dir(&inner).unwrap();
    let path = inner.join("a.usda");
    let written = Maker::new(5).scene();
    export(&written, &path, ExportOptions::default()).unwrap();
    let payloads = inner.join("a.payloads");
    // The folder leaves: a link to it is as far away as its target.
    let away = folder.path().join("away");
    fs::rename(&payloads, &away).unwrap();
    let error = read_scene(&path).unwrap_err();
    let UsdError::MissingAsset { asset, .. } = &error else { panic!("{error}") };
    assert!(asset.ends_with(".usdc") && error.to_string().contains("does not exist"), "{error}");
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(&away, &payloads).unwrap();
        let error = read_scene(&path).unwrap_err();
        assert!(matches!(error, UsdError::ExternalAsset { .. }), "{error}");
        assert!(error.to_string().contains("--follow-external"), "{error}");
        fs::remove_file(&payloads).unwrap();
    }
    fs::rename(&away, &payloads).unwrap();
    // An override elsewhere that sublayers the stage.
    let over = folder.path().join("inner/sub/over.usda");
    fs::create_dir(over.parent().unwrap()).unwrap();
    fs::write(&over, "#usda 1.0\n(\n    subLayers = [@../a.usda@]\n)\n").unwrap();
    assert!(matches!(read_scene(&over), Err(UsdError::ExternalAsset { .. })));
    let read = read_scene_with(&over, ReadOptions { follow_external: true }).unwrap();
    assert_eq!(read.nodes, written.nodes);
    // Queries look at no more files than reading does.
    let (everything, stars) =
        (ObjectQuery::default(), LabelQuery { pattern: "*".to_owned(), time_code: None });
    let refused = search(&over, &everything, ReadOptions::default()).unwrap_err();
    assert!(matches!(refused, UsdError::ExternalAsset { .. }), "{refused}");
    let refused = query(&over, &stars, ReadOptions::default()).unwrap_err();
    assert!(matches!(refused, UsdError::ExternalAsset { .. }), "{refused}");
    let everywhere = ReadOptions { follow_external: true };
    // A search leaves out what is hidden at its time.
    assert!(!search(&over, &everything, everywhere).unwrap().is_empty());
    assert_eq!(query(&over, &stars, everywhere).unwrap().len(), written.nodes.len());
    // The same from above needs no permission.
    let over = folder.path().join("over.usda");
    fs::write(&over, "#usda 1.0\n(\n    subLayers = [@inner/a.usda@]\n)\n").unwrap();
    assert_eq!(read_scene(&over).unwrap().nodes, written.nodes);
}

/// A splat prim, as text.
const SPLAT: &str = "def ParticleField3DGaussianSplat \"s\"\n{\npoint3f[] positions = [(0, 0, 0)]\n\
                     quatf[] orientations = [(1, 0, 0, 0)]\nfloat3[] scales = [(1, 1, 1)]\nfloat[] opacities = [1]\n\
                     }\n";

#[test]
fn prims_that_are_nested_too_deep_are_refused_before_usd_follows_them() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, levels: usize| {
        let path = folder.path().join(name);
        let text = ["def Xform \"a\"\n{\n".repeat(levels), SPLAT.to_owned(), "}\n".repeat(levels)].concat();
        fs::write(&path, format!("#usda 1.0\n{text}")).unwrap();
        path
    };
    let sound = read_scene(&write("sound.usda", 400)).unwrap();
    assert_eq!(sound.nodes.len(), 1);
    let deep = write("deep.usda", 15_000);
    let over = folder.path().join("over.usda");
    fs::write(&over, "#usda 1.0\n(\nsubLayers = [@deep.usda@]\n)\n").unwrap();
    let binary = folder.path().join("binary.usdc");
    python(
        &binary,
        "
from pxr import Sdf
layer = Sdf.Layer.CreateAnonymous('.usdc')
Sdf.CreatePrimInLayer(layer, '/a' * 600).specifier = Sdf.SpecifierDef
layer.Export(path)
",
    );
    for path in [&deep, &over, &binary] {
        for error in [
            read_scene(path).unwrap_err(),
            search(path, &ObjectQuery::default(), ReadOptions::default()).unwrap_err(),
            relabel(path, path, "a", "mug", None).unwrap_err(),
        ] {
            assert!(matches!(error, UsdError::TooDeep { limit: 500, .. }), "{error}");
            assert!(error.to_string().contains("500 levels"), "{error}");
        }
    }
    assert!(read_scene(&deep).unwrap_err().to_string().contains("nested 15003 deep"));
}

#[test]
fn copies_of_copies_are_counted_before_they_are_made() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, levels: usize, instanceable: bool| {
        let mut text = format!("#usda 1.0\nclass Xform \"P0\"\n{{\n{SPLAT}}}\n");
        for level in 1..=levels {
            let copy = |k: usize| {
                let below = level - 1;
                format!(
                    "def \"c{k}\" (\ninstanceable = {instanceable}\nreferences = </P{below}>\n)\n{{\n}}\n"
                )
            };
            let copies: String = (0..10).map(copy).collect();
            text += &format!("class Xform \"P{level}\"\n{{\n{copies}}}\n");
        }
        text += &format!("def Xform \"World\" (\nreferences = </P{levels}>\n)\n{{\n}}\n");
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        path
    };
    assert_eq!(read_scene(&write("few.usda", 2, true)).unwrap().nodes.len(), 100);
    let instances = write("instances.usda", 8, true);
    assert!(fs::metadata(&instances).unwrap().len() < 6_000);
    let error = read_scene(&instances).unwrap_err();
    let UsdError::TooManyPrims { written: 91, prims, limit: 250_000, .. } = error else { panic!("{error}") };
    assert!(prims > 200_000_000, "{prims}");
    // A query does not look into so many instances, which usd-core composes once.
    assert!(search(&instances, &ObjectQuery::default(), ReadOptions::default()).unwrap().is_empty());
    let copies = write("copies.usda", 8, false);
    let error = search(&copies, &ObjectQuery::default(), ReadOptions::default()).unwrap_err();
    for word in ["copies.usda", "91 that its layers hold", "at most 250000", "brings in 211111111"] {
        assert!(error.to_string().contains(word), "{word} in {error}");
    }
}

#[test]
fn other_layouts_are_refused() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let options = ExportOptions { payloads: crate::Payloads::SingleFile, ..ExportOptions::default() };
    export(&Maker::new(5).scene(), &path, options).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    for (version, expected) in [(1, "export it again"), (99, "use a newer cif")] {
        let other = folder.path().join(format!("layout{version}.usda"));
        fs::write(&other, text.replace("int layout = 2", &format!("int layout = {version}"))).unwrap();
        let error = read_scene(&other).unwrap_err().to_string();
        assert!(error.contains(&format!("in layout {version}")) && error.contains(expected), "{error}");
    }
}

#[test]
fn what_is_not_ours_is_kept() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let scene = Maker::new(5).scene();
    let payloads = folder.path().join("a.payloads");
    fs::create_dir(&payloads).unwrap();
    fs::write(payloads.join("precious.txt"), "keep").unwrap();
    let error = export(&scene, &path, ExportOptions::default()).unwrap_err();
    assert!(
        matches!(&error, UsdError::File(FileError::Foreign { path }) if path.ends_with("a.payloads")),
        "{error}"
    );
    let single = ExportOptions { payloads: crate::Payloads::SingleFile, ..ExportOptions::default() };
    export(&scene, &path, single).unwrap();
    assert!(payloads.join("precious.txt").exists(), "not needed, not ours, not touched");
    export(&scene, &path, ExportOptions { force: true, ..ExportOptions::default() }).unwrap();
    assert!(payloads.join("precious.txt").exists() && payloads.join("background.usdc").exists());
    let summary = export(&scene, &path, single).unwrap();
    let left: Vec<_> = fs::read_dir(&payloads).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left, ["precious.txt"], "payloads that the new stage does not need went with the old one");
    assert_eq!(summary.kept, [payloads.join("precious.txt")]);
    fs::remove_file(payloads.join("precious.txt")).unwrap();
    fs::remove_dir(&payloads).unwrap();
    export(&scene, &path, ExportOptions::default()).unwrap();
    assert!(payloads.is_dir());
    export(&scene, &path, single).unwrap();
    assert!(!payloads.exists(), "and the folder, where nothing else is in it");
    let package = folder.path().join("a.usdz");
    let separate = ExportOptions { payloads: crate::Payloads::Separate, ..ExportOptions::default() };
    let error = export(&scene, &package, separate).unwrap_err();
    assert!(matches!(error, UsdError::PayloadsInPackage { .. }), "{error}");
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left, ["a.usda"], "no scratch is left behind");
}

#[test]
fn stages_of_one_name_keep_their_payloads_apart() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (Maker::new(5).scene(), Maker::new(6).scene());
    let text = folder.path().join("a.usda");
    export(&first, &text, ExportOptions::default()).unwrap();
    let separate = ExportOptions { payloads: crate::Payloads::Separate, ..ExportOptions::default() };
    for (name, options) in
        [("a.usdc", ExportOptions::default()), ("a.usdz", ExportOptions::default()), ("a.usdc", separate)]
    {
        let path = folder.path().join(name);
        export(&second, &path, options).unwrap();
        assert_eq!(read_scene(&path).unwrap().nodes, second.nodes, "{name}");
        assert_eq!(read_scene(&text).unwrap().nodes, first.nodes, "after {name}");
    }
    export(&second, &folder.path().join("a.usdc"), ExportOptions::default()).unwrap();
    let mut left: Vec<_> =
        fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["a.payloads", "a.usda", "a.usdc", "a.usdz"]);
}
