"""Contents of the wheel: `cif demo` with its example, and what `cif --version` shows of the build."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cif

ROOT = Path(__file__).parents[2]
WITHOUT_USD = "import sys; sys.modules['pxr'] = None; import cif; sys.exit(cif.run(sys.argv[1:]))"


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True)


def test_the_version_shows_what_was_built_in(tmp_path: Path) -> None:
    short = run(tmp_path, "-m", "cif", "-V")
    assert short.stdout == f"cif {cif.__version__}\n", short
    long = run(tmp_path, "-m", "cif", "--version").stdout
    assert long.startswith(short.stdout), long
    rows = dict(re.split(r" +", row, maxsplit=1) for row in long.splitlines())
    assert {"usd", "onnx"} <= set(rows["features"].split(", ")), long
    assert rows["SIMD"], long
    assert re.fullmatch(r"[0-9a-f]{7,}(-dirty)?", rows.get("commit", "0123456")), long


def test_a_demo_exports_usd(tmp_path: Path) -> None:
    done = run(tmp_path, "-m", "cif", "demo", "--trained", "--no-view")
    assert done.returncode == 0, done.stderr
    demo = tmp_path / "cif-demo"
    names = {path.name for path in demo.iterdir()}
    assert names >= {"tabletop-mini", "tabletop-mini.cif", "tabletop-mini.usda"}, names
    scene = ROOT / "examples" / "tabletop-mini.cif"
    assert (demo / "tabletop-mini.cif").read_bytes() == scene.read_bytes()
    assert len(cif.query_stage(demo / "tabletop-mini.usda", "red mug")) == 1


def test_without_usd_a_demo_exports_gltf(tmp_path: Path) -> None:
    done = run(tmp_path, "-c", WITHOUT_USD, "demo", "--trained", "--no-view", "-o", "demo")
    assert done.returncode == 0, done.stderr
    assert "pip install 'cif4d[usd]'" in done.stderr and "exported as glTF" in done.stderr, done.stderr
    assert (tmp_path / "demo" / "tabletop-mini.glb").exists()
