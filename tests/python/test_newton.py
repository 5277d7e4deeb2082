"""Newton takes what `cif export` writes: bodies that stand and fall, masses, joints.

Runs where CIF_TEST_NEWTON names a Python that has Newton, which needs an older USD than cif: see
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

PYTHON = os.environ.get("CIF_TEST_NEWTON")
pytestmark = pytest.mark.skipif(
    not PYTHON, reason="CIF_TEST_NEWTON names no Python that has Newton: see tests/README.md"
)

SIMULATE = """
import json, sys, newton, warp as wp
from pxr import Usd
path, dynamic = sys.argv[1], sys.argv[2:]
wp.config.quiet = True
stage = Usd.Stage.Open(path)
for prim in dynamic:
    stage.GetPrimAtPath(prim).GetVariantSet("physics").SetVariantSelection("dynamic")
builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
loaded = builder.add_usd(stage)
model = builder.finalize(device="cpu")
bodies = {str(path): index for path, index in loaded["path_body_map"].items()}
solver = newton.solvers.SolverXPBD(model, iterations=8)
pipeline = newton.CollisionPipeline(model)
contacts, now, after = pipeline.contacts(), model.state(), model.state()
start = now.body_q.numpy().copy()
for _ in range(480):
    now.clear_forces()
    pipeline.collide(now, contacts)
    solver.step(now, after, model.control(), contacts, 1 / 480)
    now, after = after, now
end, masses = now.body_q.numpy(), model.body_mass.numpy()
types = {int(newton.JointType.REVOLUTE): "revolute", int(newton.JointType.PRISMATIC): "prismatic"}
found = {
    "bodies": {name: [start[k, :3].tolist(), end[k, :3].tolist(), float(masses[k])]
               for name, k in bodies.items()},
    "joints": sorted(types[kind] for kind in map(int, model.joint_type.numpy()) if kind in types),
    "shapes": list(map(str, model.shape_label)),
}
print(json.dumps(found))
"""


def simulated(path: Path, *dynamic: str) -> dict:
    run = subprocess.run([PYTHON, "-c", SIMULATE, path, *dynamic], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


def test_parts_on_joints_stand_and_fall(tmp_path: Path) -> None:
    scene, path = tmp_path / "cabinet.cif", tmp_path / "cabinet.usda"
    assert cif.run(["import", str(write_cabinet(tmp_path / "made.usda")), "-o", str(scene)]) == 0
    assert cif.run(["export", str(scene), str(path), "--for", "newton"]) == 0
    names = {f"/World/cabinet_001/part_0{part}" for part in range(3)}
    held = simulated(path)
    assert set(held["bodies"]) == names and held["joints"] == []
    assert "/World/Ground" in held["shapes"]
    for start, end, _ in held["bodies"].values():
        np.testing.assert_allclose(end, start, atol=1e-6)
    loose = simulated(path, "/World/cabinet_001")
    assert set(loose["bodies"]) == names and loose["joints"] == ["prismatic", "revolute"]
    for start, end, mass in loose["bodies"].values():
        assert np.isfinite(end).all() and 0 < end[2] < start[2] - 0.1
        # Sparse clouds in 0.2 x 0.2 x 0.2.
        assert 0.15 < mass / (300 * 0.2**3) < 2.0
