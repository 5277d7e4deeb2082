"""MuJoCo takes what `cif export` writes by default, and nothing for a shape that is none.

Runs where CIF_TEST_MUJOCO names a Python that has `mujoco[usd]`, which needs an older USD than cif: see
tests/README.md.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

PYTHON = os.environ.get("CIF_TEST_MUJOCO")
pytestmark = pytest.mark.skipif(
    not PYTHON, reason="CIF_TEST_MUJOCO names no Python that has mujoco[usd]: see tests/README.md"
)

SIMULATE = """
import json, sys, mujoco
model = mujoco.MjSpec.from_file(sys.argv[1]).compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
start = data.xpos.tolist()
for _ in range(200):
    mujoco.mj_step(model, data)
json.dump({
    "bodies": [model.body(k).name for k in range(model.nbody)],
    "shapes": {model.geom(k).name: int(model.geom_type[k]) for k in range(model.ngeom)},
    "mesh": int(mujoco.mjtGeom.mjGEOM_MESH),
    "gravity": model.opt.gravity.tolist(),
    "time": data.time,
    "start": start,
    "end": data.xpos.tolist(),
}, sys.stdout)
"""


def test_default_export_loads_and_steps(stage_path: Path) -> None:
    run = subprocess.run([PYTHON, "-c", SIMULATE, stage_path], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    # What moves is a body, what stands is part of the world.
    assert sorted(found["bodies"]) == ["/World/green_napkin_007", "/World/toy_car_002", "world"]
    # Hulls alone: neither splats nor the points that stand in for them are shapes.
    objects = ("green_napkin_007", "red_mug_001", "toy_car_002")
    assert found["shapes"] == {f"/World/{name}/Collider": found["mesh"] for name in objects}
    np.testing.assert_allclose(found["gravity"], [0, 0, -9.81], atol=1e-6)
    assert found["time"] == pytest.approx(0.4)
    assert np.isfinite(found["end"]).all()
    start = dict(zip(found["bodies"], found["start"], strict=True))
    np.testing.assert_allclose(start["/World/toy_car_002"], [1, 0, 0], atol=0.2)
