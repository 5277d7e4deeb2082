"""Edits made with usd-core come home through the command, and USD that is missing or too old is told."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import cif
import numpy as np
import pytest
from conftest import answer_of, camera_at
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSemantics

REPOSITORY = Path(__file__).resolve().parents[2]
NAMES = ["mug", "bowl", "box", "vase", "spoon", "ball", "book"]
EACH = 40
SHIFT = np.array([0.3, -0.1, 0.2])


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven objects on a circle, and a background."""
    chance = np.random.default_rng(11)
    angles = np.arange(len(NAMES)) * 2 * np.pi / len(NAMES)
    centres = np.repeat(np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1), EACH, axis=0)
    objects = centres + chance.uniform(-0.1, 0.1, centres.shape)
    means = np.concatenate([objects, chance.uniform([-2, -2, -1], [2, 2, -0.5], (60, 3))])
    identities = np.zeros((len(means), len(NAMES)), np.float32)
    owners = np.repeat(np.arange(len(NAMES)), EACH)
    identities[np.arange(len(owners)), owners] = 1
    field = cif.Field.from_arrays(
        means=means.astype(np.float32),
        scales=chance.uniform(0.01, 0.04, means.shape).astype(np.float32),
        quaternions=chance.normal(size=(len(means), 4)).astype(np.float32),
        opacities=np.full(len(means), 0.8, np.float32),
        colors=chance.uniform(0.2, 0.8, means.shape).astype(np.float32),
        occupancies=np.where(np.arange(len(means)) < len(owners), 0.9, 0.02).astype(np.float32),
        identities=identities,
        instances=[{"id": k + 1, "label": name, "category": name} for k, name in enumerate(NAMES)],
        times=[0.0, 0.5, 1.0],
        frames_per_second=12.0,
        cameras=[("hand held", k, camera_at(0.1 * k)) for k in range(3)],
    )
    path = tmp_path_factory.mktemp("base") / "base.cif"
    field.save(path)
    return path


def prim(stage: Usd.Stage, name: str) -> Usd.Prim:
    found = [p for p in stage.GetPrimAtPath("/World").GetChildren() if p.GetName().startswith(name)]
    assert len(found) == 1, name
    return found[0]


def edit(path: Path) -> None:
    """One edit each on six of the objects, as someone at a USD tool makes them."""
    stage = Usd.Stage.Open(str(path))
    layer = stage.GetRootLayer()
    mug = prim(stage, "mug").GetAttribute("xformOp:translate")
    mug.Set(mug.Get() + Gf.Vec3d(*SHIFT))
    bowl = prim(stage, "bowl")
    bowl.SetDisplayName("salad bowl")
    moved = Sdf.BatchNamespaceEdit()
    moved.Add(bowl.GetPath(), bowl.GetPath().ReplaceName("salad_bowl"))
    assert layer.Apply(moved)
    stage.RemovePrim(prim(stage, "box").GetPath())
    vase = prim(stage, "vase").GetPath()
    assert Sdf.CopySpec(layer, vase, layer, vase.ReplaceName("second_vase"))
    copied = stage.GetPrimAtPath(vase.ReplaceName("second_vase")).GetAttribute("xformOp:translate")
    copied.Set(copied.Get() + Gf.Vec3d(0, 0, 1))
    spoon = prim(stage, "spoon")
    splats = stage.GetPrimAtPath(spoon.GetPath().AppendChild(f"{spoon.GetName()}_splats"))
    colours = splats.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert colours.Set([Gf.Vec3f(c[0] + 0.5, c[1], c[2]) for c in colours.Get()])
    UsdGeom.Imageable(prim(stage, "ball")).MakeInvisible()
    stage.Save()


def changes(objects: list[dict]) -> dict[str, dict]:
    """What is said about every object that differs, without what is the same."""
    quiet = {"id", "name", "label", "splat_count", "kind"}
    return {
        f"{change['kind']} {change['label']}": {
            key: value for key, value in change.items() if key not in quiet and value
        }
        for change in objects
    }


def check(found: dict, copied: str) -> None:
    assert found["unchanged"] == 3, "the book, the vase that was copied, and the background"
    objects = changes(found["objects"])
    expected = ["changed ball", "changed bowl", "changed mug", "changed spoon", f"{copied} vase", "removed box"]
    assert sorted(objects) == sorted(expected)
    moved = objects["changed mug"].pop("moved")
    assert objects["changed mug"] == {} and moved["constant"]
    assert moved["translation"] == pytest.approx(np.linalg.norm(SHIFT), abs=1e-5)
    assert moved["rotation_degrees"] < 1e-3
    assert objects["changed bowl"].keys() <= {"renamed", "relabelled"}
    assert objects["changed bowl"]["relabelled"] == {"from": "bowl", "to": "salad bowl"}
    assert objects["changed ball"] == {"visibility": True}
    assert objects["removed box"] == {}
    splats = objects["changed spoon"].pop("splats")
    assert objects["changed spoon"] == {}
    assert {key: value for key, value in splats.items() if value} == {"recoloured": EACH}
    if copied == "duplicated":
        copy = objects["duplicated vase"]
        assert copy["moved"]["translation"] == pytest.approx(1.0, abs=1e-5)
        assert "splats" not in copy and "relabelled" not in copy


@pytest.mark.parametrize("name", ["scene.usda", "scene.usdc"])
def test_exactly_the_edits_come_home(
    base: Path, tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path, home = tmp_path / name, tmp_path / "home.cif"
    assert cif.run(["export", str(base), "--usd", str(path)]) == 0
    same = answer_of(capfd, "import", path, "--base", base, "-o", tmp_path / "same.cif")
    assert (same["objects"], same["unchanged"], same["cameras"]) == ([], len(NAMES) + 1, [])
    edit(path)
    listed = answer_of(capfd, "import", path, "--base", base, "-o", home)
    check(listed, "duplicated")
    # Two scenes have no rows in common that tell a copy from a new object.
    check(answer_of(capfd, "diff", base, home), "added")
    # As the file has it, so has the scene, but for names, which follow labels and ids.
    names = changes(answer_of(capfd, "diff", path, home)["objects"])
    assert sorted(names) == ["added vase", "changed salad bowl", "removed vase"]
    assert names["changed salad bowl"].keys() == {"renamed"}
    assert answer_of(capfd, "diff", home, home)["unchanged"] == len(NAMES) + 1, "one less, one more"
    before, after = cif.Field.load(base), cif.Field.load(home)
    np.testing.assert_array_equal(
        after.means[:EACH], before.means[:EACH], "moved by its motion, not its splats"
    )


def test_cameras_and_instancers_are_told(base: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.usda"
    assert cif.run(["export", str(base), "--usd", str(path)]) == 0
    stage = Usd.Stage.Open(str(path))
    camera = next(p for p in stage.Traverse() if p.IsA(UsdGeom.Camera))
    focal = camera.GetAttribute("focalLength")
    focal.Set(2 * focal.Get())
    for code in focal.GetTimeSamples():
        focal.Set(2 * focal.Get(code), code)
    copies = UsdGeom.PointInstancer.Define(stage, "/World/Copies")
    copies.CreatePrototypesRel().SetTargets([prim(stage, "mug").GetPath()])
    copies.CreateProtoIndicesAttr([0, 0])
    copies.CreatePositionsAttr([(0, 0, 1), (0, 0, 2)])
    stage.Save()
    capfd.readouterr()
    assert cif.run(["import", str(path), "--base", str(base), "-o", str(tmp_path / "home.cif"), "--json"]) == 0
    out, err = capfd.readouterr()
    found = json.loads(out)
    assert found["objects"] == [] and [change["kind"] for change in found["cameras"]] == ["lens"]
    assert "cameras stay as they were recorded" in err and "another lens" in err
    assert "/World/Copies: copies made by a point instancer are not read" in err


def stage_with_clips(folder: Path, asset: str, template: bool) -> Path:
    """Two splats whose prim is moved by a value clip: 3 up at time code 0, 5 up at 1."""
    folder.mkdir()
    clip = Sdf.Layer.CreateNew(str(folder / asset.replace("#", "0")))
    moved = Sdf.AttributeSpec(
        Sdf.CreatePrimInLayer(clip, "/World/Thing"), "xformOp:translate", Sdf.ValueTypeNames.Double3
    )
    clip.SetTimeSample(moved.path, 0.0, Gf.Vec3d(0, 0, 3))
    clip.SetTimeSample(moved.path, 1.0, Gf.Vec3d(0, 0, 5))
    clip.Save()
    stage = Usd.Stage.CreateNew(str(folder / "thing.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    thing = UsdGeom.Xform.Define(stage, "/World/Thing")
    UsdSemantics.LabelsAPI.Apply(thing.GetPrim(), "class").CreateLabelsAttr().Set(["thing"])
    thing.AddTranslateOp()
    # By names, since USD has a class for it from 26.3 on.
    splats = stage.DefinePrim("/World/Thing/Cloud", "ParticleField3DGaussianSplat")
    types = Sdf.ValueTypeNames
    for name, kind, value in [
        ("positions", types.Point3fArray, [(0, 0, 0), (0.1, 0, 0)]),
        ("orientations", types.QuatfArray, [Gf.Quatf(1)] * 2),
        ("scales", types.Float3Array, [(0.01, 0.01, 0.01)] * 2),
        ("opacities", types.FloatArray, [1, 1]),
        ("radiance:sphericalHarmonicsDegree", types.Int, 0),
        ("radiance:sphericalHarmonicsCoefficients", types.Float3Array, [(1, 0, 0), (0, 1, 0)]),
    ]:
        splats.CreateAttribute(name, kind).Set(value)
    clips = Usd.ClipsAPI(thing.GetPrim())
    clips.SetClipPrimPath("/World/Thing")
    if template:
        clips.SetClipTemplateAssetPath(asset)
        clips.SetClipTemplateStartTime(0)
        clips.SetClipTemplateEndTime(0)
        clips.SetClipTemplateStride(1)
    else:
        clips.SetClipAssetPaths([Sdf.AssetPath(asset)])
        clips.SetClipActive([(0, 0)])
        clips.SetClipTimes([(0, 0), (1, 1)])
    stage.GetRootLayer().Save()
    return folder / "thing.usda"


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("asset", "template", "height"), [("moves.usda", False, 5.0), ("moves.#.usda", True, 3.0)]
)
def test_value_clips_stay_in_the_folder(
    tmp_path: Path, asset: str, template: bool, height: float, capfd: pytest.CaptureFixture[str]
) -> None:
    def height_of(path: Path, *words: str) -> float:
        home = path.with_suffix(".cif")
        assert cif.run(["import", str(path), "-o", str(home), *words]) == 0
        # A scene of one moment has no other to ask for.
        (found,) = answer_of(capfd, "query", home, "--label", "thing", *([] if template else ["--time", 1]))
        return (found["low"][2] + found["high"][2]) / 2

    assert height_of(stage_with_clips(tmp_path / "inside", f"./{asset}", template)) == pytest.approx(height)
    outside = stage_with_clips(tmp_path / "outside", f"../{asset}", template)
    capfd.readouterr()
    assert cif.run(["import", str(outside), "-o", str(outside.with_suffix(".cif"))]) == 1
    said = capfd.readouterr().err
    assert "outside the folder" in said and "--follow-external" in said and "../moves." in said, said
    assert not outside.with_suffix(".cif").exists()
    assert height_of(outside, "--follow-external") == pytest.approx(height)


def test_missing_value_clips_are_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = stage_with_clips(tmp_path / "gone", "./moves.usda", template=False)
    (path.parent / "moves.usda").unlink()
    assert cif.run(["import", str(path), "-o", str(tmp_path / "home.cif")]) == 1
    assert "moves.usda, which does not exist" in capfd.readouterr().err


def test_prototypes_are_not_objects(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = stage_with_clips(tmp_path / "copies", "./moves.usda", template=False)
    stage = Usd.Stage.Open(str(path))
    copies = UsdGeom.PointInstancer.Define(stage, "/World/Copies")
    Sdf.CopySpec(stage.GetRootLayer(), "/World/Thing/Cloud", stage.GetRootLayer(), "/World/Copies/One")
    copies.CreatePrototypesRel().SetTargets(["/World/Copies/One"])
    copies.CreateProtoIndicesAttr([0, 0])
    copies.CreatePositionsAttr([(0, 0, 1), (0, 0, 2)])
    stage.Save()
    home = tmp_path / "home.cif"
    assert cif.run(["import", str(path), "-o", str(home)]) == 0
    assert "/World/Copies: copies made by a point instancer are not read" in capfd.readouterr().err
    assert len(cif.Field.load(home).means) == 2, "prototypes are not drawn where they stand"


def run_with(pxr: dict[str, str], folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """The command in a process that finds another `pxr`, given as files and what they hold."""
    package = folder / "shadow" / "pxr"
    package.mkdir(parents=True, exist_ok=True)
    for name, text in pxr.items():
        (package / name).write_text(text)
    paths = [str(package.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(
        [sys.executable, "-m", "cif", *map(str, words)], capture_output=True, text=True, env=environment
    )


@pytest.mark.parametrize(
    ("pxr", "message", "fix"),
    [
        (
            {"__init__.py": "raise ModuleNotFoundError(\"No module named 'pxr'\")"},
            "USD cannot be imported",
            "pip install 'cif4d[usd]'",
        ),
        (
            {"__init__.py": "", "Usd.py": "def GetVersion():\n    return (0, 25, 8)\n"},
            "USD 25.8 is too old, 25.11 is the oldest",
            "pip install --upgrade usd-core",
        ),
        (
            {
                "__init__.py": "",
                "Usd.py": "def GetVersion():\n    return (0, 25, 11)\n\n"
                "class SchemaRegistry:\n    def FindConcretePrimDefinition(self, name):\n        return None\n",
            },
            "USD 25.11 has no Gaussian splats",
            "import pxr, then cif",
        ),
    ],
)
def test_usd_that_is_missing_or_too_old_is_told(
    base: Path, tmp_path: Path, pxr: dict[str, str], message: str, fix: str
) -> None:
    (tmp_path / "there.usda").write_text("#usda 1.0\n")
    for words in [
        ["export", base, "--usd", tmp_path / "out.usda"],
        ["import", tmp_path / "there.usda", "-o", tmp_path / "out.cif"],
        ["query", tmp_path / "there.usda", "--label", "*"],
        # Before anything else is made.
        ["make", tmp_path / "walk.mp4", "-o", tmp_path / "made"],
    ]:
        done = run_with(pxr, tmp_path, *words)
        assert done.returncode == 1, done
        assert message in done.stderr and fix in done.stderr, done.stderr
        assert "Traceback" not in done.stderr, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["shadow", "there.usda"]
    # What needs no USD works.
    assert run_with(pxr, tmp_path, "query", base, "--label", "mug").returncode == 0
    assert run_with(pxr, tmp_path, "export", base, "--gltf", tmp_path / "out.glb").returncode == 0


def test_the_package_brings_the_schema() -> None:
    files = {str(file): file for file in metadata.files("cif4d") or []}
    schema = Path(cif.__file__).parent / "schema"
    for name in ["plugInfo.json", "generatedSchema.usda"]:
        theirs = (REPOSITORY / "schemas" / "cif" / name).read_bytes()
        assert (schema / name).read_bytes() == theirs, name
        # An editable installation lists only what leads to the folder.
        if "cif/__init__.py" in files:
            assert f"cif/schema/{name}" in files, sorted(files)
    code = "import cif; from pxr import Plug; print(Plug.Registry().GetPluginWithName('usdCif').path)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert Path(told.stdout.strip()).resolve() == schema.resolve(), told
