"""MuJoCo takes what `cif export` writes: shapes, masses, bodies that stand, fall and are moved, joints.

Runs where CIF_TEST_MUJOCO names a Python that has `mujoco[usd]`, which needs an older USD than cif: see
tests/README.md.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import cif
import numpy as np
import pytest
from small_stage import write_cabinet

PYTHON = os.environ.get("CIF_TEST_MUJOCO")
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "simulate_mujoco.py"
pytestmark = pytest.mark.skipif(
    not PYTHON, reason="CIF_TEST_MUJOCO names no Python that has mujoco[usd]: see tests/README.md"
)

SIMULATE = """
import json, sys, mujoco
from pxr import Sdf
path, steps, chosen = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
if chosen:
    layer = Sdf.Layer.CreateNew(path + ".chosen.usda")
    layer.subLayerPaths.append(path)
    layer.defaultPrim = "World"
    for prim in chosen:
        Sdf.CreatePrimInLayer(layer, prim).variantSelections["physics"] = "dynamic"
    layer.Save()
    path = layer.realPath
model = mujoco.MjSpec.from_file(path).compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
start = data.xpos.tolist()
for _ in range(steps):
    mujoco.mj_step(model, data)
json.dump({
    "bodies": [model.body(k).name for k in range(model.nbody)],
    "masses": model.body_mass.tolist(),
    "shapes": {model.geom(k).name: int(model.geom_type[k]) for k in range(model.ngeom)},
    "mesh": int(mujoco.mjtGeom.mjGEOM_MESH),
    "plane": int(mujoco.mjtGeom.mjGEOM_PLANE),
    "joints": {model.joint(k).name: [*model.jnt_range[k].tolist(), float(data.qpos[model.jnt_qposadr[k]])]
               for k in range(model.njnt) if model.joint(k).name},
    "gravity": model.opt.gravity.tolist(),
    "time": data.time,
    "start": start,
    "end": data.xpos.tolist(),
}, sys.stdout)
"""


def simulated(path: Path, steps: int = 200, dynamic: tuple[str, ...] = ()) -> dict:
    run = subprocess.run(
        [PYTHON, "-c", SIMULATE, path, str(steps), *dynamic], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert np.isfinite(found["end"]).all()
    for key in ("masses", "start", "end"):
        found[key] = dict(zip(found["bodies"], found[key], strict=True))
    return found


def exported(field: cif.Field, path: Path, *flags: str) -> Path:
    scene = path.with_suffix(".cif")
    field.save(scene)
    assert cif.run(["export", str(scene), str(path), *flags]) == 0
    return path


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> cif.Field:
    """A cabinet with a door and a drawer on joints."""
    folder = tmp_path_factory.mktemp("cabinet")
    made = write_cabinet(folder / "made.usda")
    assert cif.run(["import", str(made), "-o", str(folder / "cabinet.cif")]) == 0
    return cif.Field.load(folder / "cabinet.cif")


def test_default_export_loads_and_steps(stage_path: Path) -> None:
    found = simulated(stage_path)
    # What moves is a body, what stands is part of the world.
    assert sorted(found["bodies"]) == ["/World/green_napkin_007", "/World/toy_car_002", "world"]
    # Hulls alone: neither splats nor the points that stand in for them are shapes.
    objects = ("green_napkin_007", "red_mug_001", "toy_car_002")
    assert found["shapes"] == {f"/World/{name}/Collider": found["mesh"] for name in objects}
    np.testing.assert_allclose(found["gravity"], [0, 0, -9.81], atol=1e-6)
    assert found["time"] == pytest.approx(0.4)
    np.testing.assert_allclose(found["start"]["/World/toy_car_002"], [1, 0, 0], atol=0.2)


def test_masses_are_those_of_what_is_filled(field: cif.Field, motion, tmp_path: Path) -> None:
    masses = {}
    for density in (300, 600):
        path = tmp_path / f"{density}.usda"
        field.export(path, motion=motion, options={"density": float(density), "weld_kinematic": True})
        masses[density] = simulated(path, 1)["masses"]["/World/toy_car_002"]
    # A sparse cloud in 0.4 x 0.4 x 0.4.
    assert 0.25 * 300 * 0.4**3 < masses[300] < 1.3 * 300 * 0.4**3
    assert masses[600] == pytest.approx(2 * masses[300], rel=1e-5)


def test_for_mujoco_nothing_falls_unasked(field: cif.Field, motion, tmp_path: Path) -> None:
    path = tmp_path / "held.usda"
    options = {"ground": "auto", "weld_kinematic": True}
    field.export(path, motion=motion, proxy_points=0, options=options)
    held = simulated(path, 500)
    for name in ("/World/toy_car_002", "/World/green_napkin_007"):
        np.testing.assert_allclose(held["end"][name], held["start"][name], atol=1e-9)
    assert held["shapes"]["/World/Ground"] == held["plane"]
    loose = simulated(path, 500, dynamic=("/World/toy_car_002",))
    fell = np.subtract(loose["end"]["/World/toy_car_002"], loose["start"]["/World/toy_car_002"])
    # On the background, 0.5 to 1 below the objects.
    assert -1.5 < fell[2] < -0.1
    np.testing.assert_allclose(
        loose["end"]["/World/green_napkin_007"], loose["start"]["/World/green_napkin_007"], atol=1e-9
    )


def test_parts_on_joints_stand_and_fall(cabinet: cif.Field, tmp_path: Path) -> None:
    path = exported(cabinet, tmp_path / "cabinet.usda", "--for", "mujoco")
    bodies = {f"/World/cabinet_001/part_0{part}" for part in range(3)}
    held = simulated(path, 500)
    assert set(held["bodies"]) == {*bodies, "world"} and held["joints"] == {}
    for body in bodies:
        np.testing.assert_allclose(held["end"][body], held["start"][body], atol=1e-9)
    loose = simulated(path, 1000, dynamic=("/World/cabinet_001",))
    assert set(loose["bodies"]) == {*bodies, "world"}
    assert len(loose["joints"]) == 2
    (door,) = (limits for name, limits in loose["joints"].items() if name.endswith("part_01"))
    (drawer,) = (limits for name, limits in loose["joints"].items() if name.endswith("part_02"))
    np.testing.assert_allclose(door[:2], [0, 0.8], atol=1e-3)
    np.testing.assert_allclose(drawer[:2], [0, 0.16], atol=1e-3)
    # Limits are soft.
    assert -0.05 < door[2] < 0.85 and -0.02 < drawer[2] < 0.18
    for body in bodies:
        assert loose["end"][body][2] < loose["start"][body][2] - 0.1
        assert loose["end"][body][2] > 0


def test_example_moves_what_was_recorded(cabinet: cif.Field, tmp_path: Path) -> None:
    path = exported(cabinet, tmp_path / "cabinet.usda", "--for", "mujoco")
    for chosen, driven in (([], 3), (["--dynamic", "cabinet"], 0)):
        out = tmp_path / f"{driven}.usda"
        command = [PYTHON, EXAMPLE, path, "-o", out, *chosen]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout + run.stderr
        assert f"3 bodies, {driven} of them on tracks" in run.stdout
        assert out.is_file()
