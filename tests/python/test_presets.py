"""Exports for the programs that open them: `cif export --for PROGRAM`."""

from __future__ import annotations

import json
from pathlib import Path

import cif
import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics
from small_stage import write_cabinet

FLAGS = {
    "mujoco": "--ground auto --weld-kinematic --proxy-points 0",
    "newton": "--ground auto --proxy-points 0",
    "isaac": "--ground auto --proxy-points 0",
    "blender": "--bake-blur",
    "web": "--hulls 0 --proxy-points 0 --ply-up y",
}


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cabinet")
    made = write_cabinet(folder / "made.usda")
    assert cif.run(["import", str(made), "-o", str(folder / "cabinet.cif")]) == 0
    return folder / "cabinet.cif"


@pytest.fixture(scope="module")
def scene(field: cif.Field, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.cif"
    field.save(path)
    return path


def export(scene: Path, out: Path, *flags: str) -> Path:
    assert cif.run(["export", str(scene), str(out), *flags]) == 0
    return out


def paths(stage: Usd.Stage) -> list[str]:
    return [str(prim.GetPath()) for prim in stage.Traverse()]


def opened(path: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(path))


def test_help_tells_what_presets_set(capfd: pytest.CaptureFixture[str]) -> None:
    assert cif.run(["export", "--help"]) == 0
    told = " ".join(capfd.readouterr().out.split())
    for name, flags in FLAGS.items():
        assert f"{name}: {flags}" in told, told


def test_mujoco_gets_a_ground_and_what_is_recorded_is_held(
    cabinet: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    found = opened(export(cabinet, tmp_path / "held.usda", "--for", "mujoco"))
    assert f"--for mujoco is {FLAGS['mujoco']}" in capfd.readouterr().err
    plane = found.GetPrimAtPath("/World/Ground")
    assert plane.IsA(UsdGeom.Plane) and plane.HasAPI(UsdPhysics.CollisionAPI)
    # The floor is at 0.
    assert UsdGeom.Xformable(plane).GetLocalTransformation().ExtractTranslation()[2] == pytest.approx(
        0, abs=0.02
    )
    for part in range(3):
        body = f"/World/cabinet_001/part_0{part}"
        hold = UsdPhysics.FixedJoint(found.GetPrimAtPath(f"{body}/Hold"))
        assert hold.GetBody1Rel().GetTargets() == [body] and not hold.GetBody0Rel().GetTargets()
        place = (
            UsdGeom.Xformable(found.GetPrimAtPath(body)).ComputeLocalToWorldTransform(0).ExtractTranslation()
        )
        np.testing.assert_allclose(hold.GetLocalPos0Attr().Get(), place, atol=1e-6)
    (joint,) = (path for path in paths(found) if path.endswith("Joint_part_01"))
    assert UsdPhysics.Joint(found.GetPrimAtPath(joint)).GetExcludeFromArticulationAttr().Get()
    assert not any(path.endswith("/Proxy") for path in paths(found))


def test_flags_overrule_presets(cabinet: Path, tmp_path: Path) -> None:
    flags = ["--ground", "none", "--weld-kinematic=false", "--proxy-points", "9"]
    found = opened(export(cabinet, tmp_path / "free.usda", "--for", "mujoco", *flags))
    assert "/World/Ground" not in paths(found)
    assert not any(path.endswith("/Hold") for path in paths(found))
    assert any(path.endswith("/Proxy") for path in paths(found))
    at = opened(export(cabinet, tmp_path / "at.usda", "--for", "newton", "--ground", "-0.25"))
    matrix = UsdGeom.Xformable(at.GetPrimAtPath("/World/Ground")).GetLocalTransformation()
    assert matrix.ExtractTranslation()[2] == -0.25


def test_articulations_have_their_root_on_a_body(cabinet: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(export(cabinet, tmp_path / "a.usda")))
    cabinet_prim = stage.GetPrimAtPath("/World/cabinet_001")
    cabinet_prim.GetVariantSet("physics").SetVariantSelection("dynamic")
    roots = [prim.GetName() for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
    assert roots == ["part_00"]


def test_masses_are_told_and_follow_the_density(
    cabinet: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    masses = {}
    for density in (300, 600):
        capfd.readouterr()
        path = tmp_path / f"{density}.usda"
        export(cabinet, path, "--density", str(density), "--json")
        told = json.loads(capfd.readouterr().out)["masses"]
        (masses[density],) = (row["kilograms"] for row in told if row["name"] == "cabinet_001")
        stage = opened(path)
        written = [
            UsdPhysics.MassAPI(prim).GetMassAttr().Get()
            for prim in stage.Traverse()
            if prim.HasAPI(UsdPhysics.CollisionAPI)
        ]
        assert sum(written) == pytest.approx(masses[density], rel=1e-5)
    # Three sparse clouds in 0.2 x 0.2 x 0.2 each.
    assert 0.2 < masses[300] / (300 * 3 * 0.2**3) < 2
    assert masses[600] == pytest.approx(2 * masses[300])
    assert cif.run(["export", str(cabinet), str(tmp_path / "no.usda"), "--density", "0"]) == 2
    assert "above 0" in capfd.readouterr().err


def test_blender_gets_the_blur_of_pixels(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cloud = "/World/red_mug_001/red_mug_001_splats"
    sizes = {}
    for name, flags in {
        "sharp": [],
        "blurred": ["--for", "blender"],
        "off": ["--for", "blender", "--bake-blur=false"],
    }.items():
        found = opened(export(scene, tmp_path / f"{name}.usda", *flags))
        sizes[name] = np.array(found.GetPrimAtPath(cloud).GetAttribute("scales").Get(), np.float64)
    np.testing.assert_array_equal(sizes["off"], sizes["sharp"])
    # Cameras with a focal length of 59 pixels stand 4 away, one of them farther.
    added = (sizes["blurred"] ** 2 - sizes["sharp"] ** 2) / 0.3
    assert (np.sqrt(added) > 3.8 / 59).all() and (np.sqrt(added) < 5.5 / 59).all()
    assert np.ptp(added, axis=1).max() < 1e-4
    assert cif.run(["export", str(scene), str(tmp_path / "x.usda"), "--for", "blender", "--check"]) == 2
    assert "--bake-blur=false" in capfd.readouterr().err


def test_the_web_gets_y_up(scene: Path, tmp_path: Path) -> None:
    out = export(scene, tmp_path / "web.ply", "--for", "web")
    assert b"comment turned up y\n" in out.read_bytes()[:2000]
    other = export(scene, tmp_path / "captured.ply")
    points = {}
    for path in (out, other):
        head, rows = path.read_bytes().split(b"end_header\n", 1)
        count = int(head.split(b"element vertex ")[1].split(b"\n")[0])
        points[path] = np.frombuffer(rows, "<f4").reshape(count, -1)[:, :3]
    x, y, z = points[other].T
    np.testing.assert_allclose(points[out], np.stack([x, z, -y], 1), atol=1e-6)
    # It comes home as captured.
    back = tmp_path / "back.cif"
    assert cif.run(["import", str(out), "-o", str(back)]) == 0
    np.testing.assert_allclose(cif.Field.load(back).means, points[other], atol=1e-5)
