"""The module in a notebook: arrays, rendering, queries, the command in process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cif
import numpy as np
import pytest
from conftest import CAR, PER_OBJECT, TIMES


def test_fields_survive_files(field: cif.Field, tmp_path: Path) -> None:
    path = tmp_path / "scene.cif"
    field.save(path)
    again = cif.Field.load(path)
    for name in [
        "means",
        "scales",
        "quaternions",
        "opacities",
        "occupancies",
        "sh_coefficients",
        "identities",
    ]:
        assert np.array_equal(getattr(again, name), getattr(field, name)), name
    assert again.instances == field.instances and again.times == TIMES
    assert again.cameras[2][:2] == ("hand held", 2)
    assert len(again) == 3 * PER_OBJECT + 100
    assert field.identities.shape == (len(field), 3)


def test_rendering(field: cif.Field) -> None:
    _, _, camera = field.cameras[0]
    picture = field.render(camera)
    assert picture["color"].shape == (48, 64, 3) and picture["color"].dtype == np.float32
    assert picture["alpha"].max() > 0.5
    assert set(np.unique(picture["label"])) - {0} == {1, 2, 3}
    assert set(field.render(camera, depth=False, instances=False)) == {"color", "alpha"}
    with pytest.raises(ValueError, match="from 0 to 1"):
        field.render(camera, 1.5)


def test_queries(field: cif.Field) -> None:
    answer = field.query(np.array([field.means[CAR][0], [50, 50, 50]], np.float64))
    assert answer["instance"].tolist() == [1, -1]
    assert answer["existence"][0] > 0.8 and answer["existence"][1] == 0
    assert answer["probabilities"].shape == (2, 3)
    (found,) = field.find("toy car")
    assert found["instance"] == "toy_car_002"
    with pytest.raises(cif.CifError, match="known labels"):
        field.find("teapot")


def test_motion_table(field: cif.Field, motion, tmp_path: Path) -> None:
    report = field.export(tmp_path / "a.usdc", motion=motion)
    models = {row["label"]: row["model"] for row in report["motion"]}
    assert models == {
        "red mug": "static",
        "toy car": "rigid",
        "green napkin": "dense",
        "background": "static",
    }
    car = next(row for row in report["motion"] if row["label"] == "toy car")
    assert car["residual"]["max"] < 1e-5 < car["static_residual"]["rms"]
    limited = field.export(tmp_path / "b.usdc", motion=motion, most_expensive_motion="rigid")
    napkin = next(row for row in limited["motion"] if row["label"] == "green napkin")
    assert napkin["model"] == "rigid" and napkin["residual"]["decisive"] > napkin["tolerance"]
    assert limited["bytes"] < report["bytes"]


def test_wrong_arrays_are_named(field: cif.Field) -> None:
    good = {
        "means": np.zeros((2, 3), np.float32),
        "scales": np.ones((2, 3), np.float32),
        "quaternions": np.ones((2, 4), np.float32),
        "opacities": np.full(2, 0.5, np.float32),
        "colors": np.zeros((2, 3), np.float32),
    }
    assert len(cif.Field.from_arrays(**good)) == 2
    for name, bad in [
        ("means", np.zeros((2, 2), np.float32)),
        ("scales", np.zeros((2, 3), np.float32)),
        ("quaternions", np.ones((2, 3), np.float32)),
        ("opacities", np.full(2, 1.5, np.float32)),
    ]:
        with pytest.raises(ValueError, match=name):
            cif.Field.from_arrays(**{**good, name: bad})
    instances = [{"id": 1, "label": "mug"}, {"id": 2, "label": "car"}]
    for wrong in [-0.5, np.nan, np.inf]:
        identities = np.array([[0.5, 0.5], [1.0, wrong]], np.float32)
        with pytest.raises(ValueError, match=r"identities hold .* at row 1, column 1"):
            cif.Field.from_arrays(**good, identities=identities, instances=instances)
    with pytest.raises(cif.CifError, match="NUL"):
        cif.Field.from_arrays(**good, instances=[{"id": 1, "label": "red\0mug"}])
    with pytest.raises(ValueError, match="rotation"):
        cif.Camera(4, 4, (4.0, 4.0), camera_from_world=np.diag([1.0, 1.0, -1.0, 1.0]))
    for width, height, told in [
        (2**32 - 1, 2**32 - 1, "a side of 4294967295, more than the 65536"),
        (60_000, 60_000, "has 3600000000, more than the 268435456"),
        (0, 4, "has none"),
    ]:
        with pytest.raises(ValueError, match=told):
            cif.Camera(width, height, (4.0, 4.0))
        with pytest.raises(ValueError, match=told):
            cif.Camera(4, 4, (4.0, 4.0)).resized(width, height)


def test_the_command_runs_in_process(tmp_path: Path) -> None:
    version = subprocess.run([sys.executable, "-m", "cif", "--version"], capture_output=True, text=True)
    assert version.returncode == 0 and cif.__version__ in version.stdout, version
    missing = subprocess.run(
        [sys.executable, "-m", "cif", "info", tmp_path / "nowhere"], capture_output=True, text=True
    )
    assert missing.returncode == 1 and "nowhere" in missing.stderr, missing
    assert cif.run(["no-such-command"]) == 2


def test_command_exports_and_queries(field: cif.Field, tmp_path: Path) -> None:
    field.save(tmp_path / "scene.cif")
    assert cif.run(["export", tmp_path / "scene.cif", "--usd", tmp_path / "scene.usda"]) == 0
    assert cif.run(["query", tmp_path / "scene.usda", "--label", "toy car", "--time", "0.5"]) == 0
    assert cif.run(["query", tmp_path / "scene.cif", "--label", "toy car", "--time", "0.5"]) == 0
    assert cif.run(["query", tmp_path / "scene.usda", "--label", "teapot"]) == 1
    before = (tmp_path / "scene.usda").read_bytes()
    assert cif.run(["export", tmp_path / "scene.cif", "--usd", tmp_path / "scene.usda"]) == 1
    assert (tmp_path / "scene.usda").read_bytes() == before
