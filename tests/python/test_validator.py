"""NVIDIA's validator has nothing to say against what `cif export` writes.

Runs where CIF_TEST_VALIDATOR names a Python that has `omniverse-asset-validator` and usd-core: see
tests/README.md.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import cif
import pytest
from small_stage import write_cabinet

PYTHON = os.environ.get("CIF_TEST_VALIDATOR")
pytestmark = pytest.mark.skipif(
    not PYTHON,
    reason="CIF_TEST_VALIDATOR names no Python with omniverse-asset-validator: see tests/README.md",
)

# The rules of splats are off by default. Roots that are text hold poses so that people can read them.
VALIDATE = """
import sys
import omni.asset_validator as validator
from omni.capabilities import Requirements
engine = validator.ValidationEngine()
engine.enable_requirement(Requirements.VG_035)
issues = [issue for path in sys.argv[1:] for issue in engine.validate(path).issues()]
text = "UsdAsciiPerformanceChecker"
found = [str(issue) for issue in issues if not (issue.rule and issue.rule.__name__ == text)]
print("\\n".join(found))
sys.exit(bool(found))
"""


def valid(*paths: Path) -> None:
    run = subprocess.run([PYTHON, "-c", VALIDATE, *paths], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


def test_default_export_is_valid(stage_path: Path) -> None:
    valid(stage_path)


@pytest.mark.parametrize("program", ["mujoco", "newton", "blender"])
def test_presets_are_valid(program: str, tmp_path: Path) -> None:
    scene, path = tmp_path / "cabinet.cif", tmp_path / "cabinet.usda"
    assert cif.run(["import", str(write_cabinet(tmp_path / "made.usda")), "-o", str(scene)]) == 0
    assert cif.run(["export", str(scene), str(path), "--for", program]) == 0
    valid(path)
