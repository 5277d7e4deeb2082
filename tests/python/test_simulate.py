"""The example that lets objects fall in Newton: what falls lands, what is recorded is followed.

Runs in an environment with Newton; the example says which.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_stage import FRAMES, write_simulation

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
sys.path.insert(0, str(EXAMPLES))
sys.path.insert(0, str(EXAMPLES.parent / "plugin" / "blender"))

pytestmark = pytest.mark.filterwarnings("default")


@pytest.fixture(scope="module")
def simulate():
    pytest.importorskip("newton", reason="Newton is not installed here: see examples/simulate_newton.py")
    import simulate_newton

    return simulate_newton


def run(simulate, path: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> Path:
    out = path.with_name("fallen.usda")
    monkeypatch.setattr(sys, "argv", ["simulate_newton.py", str(path), "-o", str(out), *options])
    assert simulate.main() == 0
    return out


def tracks(path: Path) -> dict:
    from cif_scene.io.read import read_scene

    return {instance.name: instance.track for instance in read_scene(path).instances}


def test_what_falls_lands_on_the_table(simulate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = run(simulate, write_simulation(tmp_path / "small.usda"), monkeypatch, "--dynamic", "cube")
    fallen, before = tracks(out), tracks(tmp_path / "small.usda")
    cube = fallen["cube_001"]
    np.testing.assert_allclose(cube.translations[0], [0, 0, 0], atol=1e-6)
    # Free fall at first: 1/72 s^2 of the gravity after two frames of 1/12 s.
    assert cube.translations[2, 2] == pytest.approx(-9.81 / 72, rel=0.02)
    assert cube.translations[-1, 2] == pytest.approx(-0.5 + 0.12, abs=0.01)
    assert np.abs(cube.translations[:, :2]).max() < 0.02
    np.testing.assert_allclose(fallen["pusher_002"].translations, before["pusher_002"].translations)
    np.testing.assert_allclose(fallen["step_003"].translations, before["step_003"].translations)
    assert list(cube.codes) == list(range(FRAMES))


def test_layer_is_small_and_relative(simulate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pxr import Sdf

    out = run(simulate, write_simulation(tmp_path / "small.usda"), monkeypatch, "--dynamic", "cube")
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert list(layer.subLayerPaths) == ["./small.usda"]
    assert [child.name for child in layer.GetPrimAtPath("/World").nameChildren] == ["cube_001"]


def test_colliders_that_miss_their_splats_are_told(
    simulate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_simulation(tmp_path / "small.usda")
    path.write_text(path.read_text().replace("0.12, 0.12)", "0.12, -0.05)"))
    out = tmp_path / "fallen.usda"
    monkeypatch.setattr(sys, "argv", ["simulate_newton.py", str(path), "-o", str(out), "--dynamic", "cube"])
    assert simulate.main() == 1
    assert "hold" in capsys.readouterr().out


def test_names_that_fit_nothing_are_refused(simulate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_simulation(tmp_path / "small.usda")
    monkeypatch.setattr(sys, "argv", ["x", str(path), "-o", str(tmp_path / "o.usda"), "--dynamic", "teapot"])
    with pytest.raises(SystemExit, match="teapot"):
        simulate.main()
    assert not (tmp_path / "o.usda").exists()
