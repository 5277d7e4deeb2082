"""What `cif export` writes has NVIDIA's SimReady features of placed, simulated and labelled objects.

Runs where CIF_TEST_SIMREADY names a Python that has `simready-foundation-tier-core` and usd-core: see
tests/README.md.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import cif
import pytest
from small_stage import write_cabinet

PYTHON = os.environ.get("CIF_TEST_SIMREADY")
pytestmark = pytest.mark.skipif(
    not PYTHON,
    reason="CIF_TEST_SIMREADY names no Python with simready-foundation-tier-core: see tests/README.md",
)

# Grasps and physics materials (FET_005) are nothing that a capture shows; colliders of Newton and MuJoCo
# (FET_003_NEWTON, FET_003_MUJOCO) need schemas of theirs, and both read those of USD.
FEATURES = {
    "placed": "FET_001_STANDARD-1.0.1",
    "rigid bodies": "FET_003_STANDARD-0.2.0",
    "rigid bodies in PhysX": "FET_003_PHYSX-0.4.0",
    "bodies on joints": "FET_004_STANDARD-0.2.0",
    "labels": "FET_011_STANDARD-0.2.0",
}

# Prints the codes of requirements that the feature has, and what is found against them. Splats are no meshes.
VALIDATE = """
import json, sys
from pathlib import Path
import simready.foundation.tier_core as tier
import simready.foundation.tier_core.capabilities
from simready.foundation.tier_core.requirements import Requirements
import usd_validation_nvidia as validation
by_code = {requirement.code: requirement for requirement in Requirements}
by_code |= {requirement.code: requirement for requirement in validation.RequirementsRegistry().values()}
feature = json.loads((Path(tier.__file__).parent / "features" / (sys.argv[1] + ".json")).read_text())
engine = validation.ValidationEngine(init_rules=False)
codes = []
for code in feature["requirements"]:
    code = code if code in by_code else "com.nvidia.simready." + code
    engine.enable_requirement(by_code[code])
    codes.append(code)
issues = engine.validate(sys.argv[2]).issues()
issues = [issue for issue in issues if not getattr(issue.requirement, "code", "").endswith("VG.MESH.001")]
print(json.dumps({"codes": codes, "issues": [str(issue) for issue in issues]}))
"""


def found(feature: str, path: Path) -> dict[str, list[str]]:
    run = subprocess.run([PYTHON, "-c", VALIDATE, feature, path], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.parametrize("feature", FEATURES.values(), ids=FEATURES.keys())
def test_default_export_has_the_feature(feature: str, stage_path: Path) -> None:
    answer = found(feature, stage_path)
    assert answer["codes"] and not answer["issues"], answer


def exported(folder: Path, program: str) -> Path:
    """A cabinet with a drawer and a door, as exported for a program."""
    scene, path = folder / "cabinet.cif", folder / "cabinet.usda"
    assert cif.run(["import", str(write_cabinet(folder / "made.usda")), "-o", str(scene)]) == 0
    assert cif.run(["export", str(scene), str(path), "--for", program]) == 0
    return path


@pytest.mark.parametrize("program", ["isaac", "newton", "mujoco"])
def test_presets_have_bodies_on_joints(program: str, tmp_path: Path) -> None:
    path = exported(tmp_path, program)
    for feature in ("rigid bodies", "bodies on joints", "labels"):
        assert not found(FEATURES[feature], path)["issues"], feature


def test_what_is_missing_is_found(tmp_path: Path) -> None:
    path = exported(tmp_path, "isaac")
    text = path.read_text()
    labels = '"SemanticsLabelsAPI:class", "SemanticsLabelsAPI:instance", '
    assert labels in text
    path.write_text(text.replace(labels, ""))
    assert found(FEATURES["labels"], path)["issues"]
