"""The module in a notebook: arrays, rendering, queries, the command in process."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import cif
import numpy as np
import pytest
from conftest import CAR, PER_OBJECT, TIMES, turn

CAPTURE = Path(__file__).parents[2] / "examples" / "tabletop-mini"


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


LARGE = """
import resource, sys
import cif, numpy as np
field = cif.Field.load(sys.argv[1])
camera = field.cameras[0][2].resized(16384, 16384)
points = np.zeros((50_000_000, 3))
size = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmSize"))
resource.setrlimit(resource.RLIMIT_AS, ((size + 1_000_000) * 1024,) * 2)
for work in [lambda: field.render(camera), lambda: field.show(camera), lambda: field.query(points)]:
    try:
        work()
    except cif.CifError as error:
        print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="free memory is known on Linux")
def test_arrays_that_memory_does_not_hold_are_refused(field: cif.Field, tmp_path: Path) -> None:
    field.save(tmp_path / "scene.cif")
    command = [sys.executable, "-c", LARGE, str(tmp_path / "scene.cif")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    render, show, query = run.stdout.splitlines()
    assert "10.7 GB" in render and "16384 x 16384 pixels x 10 values x 4 bytes" in render
    assert "4.3 GB" in show and "pixels x 4 values" in show
    assert "1.2 GB" in query and "50000000 points x 3 instances x 8 bytes" in query


def test_arrays_of_what_does_not_change_are_read_only(field: cif.Field) -> None:
    _, _, camera = field.cameras[0]
    named = ["means", "scales", "quaternions", "opacities", "occupancies", "sh_coefficients", "identities"]
    for array in [*(getattr(field, name) for name in named), camera.camera_from_world]:
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0
    with pytest.raises(AttributeError):
        field.means = np.zeros((3, 3), np.float32)
    # Answers are the caller's own.
    field.at(0.5)["means"][:] = 0
    field.render(camera)["color"][:] = 0
    copy = field.means.copy()
    copy[:] = 0
    assert field.means.any()


@pytest.fixture(scope="module")
def moving(field: cif.Field, motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The field with its motion recorded, as a .cif file."""
    folder = tmp_path_factory.mktemp("moving")
    field.export(folder / "scene.usda", motion=motion)
    recorded, _ = cif.import_scene(folder / "scene.usda")
    recorded.save(folder / "scene.cif")
    return folder / "scene.cif"


def check_path(times: np.ndarray, translations: np.ndarray, rotations: np.ndarray, start: np.ndarray) -> None:
    """The way of the car in conftest: it turns about z of the world, and drives."""
    for time, translation, rotation in zip(times, translations, rotations, strict=True):
        matrix, quaternion = turn(2.5 * time)
        assert translation == pytest.approx(matrix @ start + [0.5 * time, 0, 0.2 * time], abs=2e-3)
        assert rotation == pytest.approx(quaternion, abs=2e-3)


def test_a_trajectory_is_one_call(moving: Path) -> None:
    field = cif.Field.load(moving)
    path = field.trajectory("toy car")
    assert (path["instance"], path["label"], path["class"]) == ("toy_car_002", "toy car", "car")
    assert path["time_codes"].tolist() == list(range(len(TIMES))) and path["times"] == pytest.approx(TIMES)
    assert path["seconds"] == pytest.approx(path["time_codes"] / 12)
    assert path["visible"].dtype == bool and path["visible"].all()
    check_path(path["times"], path["translations"], path["rotations"], path["translations"][0])
    for code in [0, 3, 5]:
        (found,) = field.find("toy car", code)
        assert path["translations"][code] == pytest.approx(np.array(found["transform"])[:3, 3])
    still = field.trajectory("red mug")
    assert np.ptp(still["translations"], axis=0) == pytest.approx(0)
    assert still["rotations"][:, 0] == pytest.approx(1)
    with pytest.raises(cif.CifError, match=r"fits 4 objects: .*toy_car_002.*; name one"):
        field.trajectory("*")
    with pytest.raises(cif.CifError, match="known labels"):
        field.trajectory("teapot")


def test_trajectories_as_csv(moving: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    field = cif.Field.load(moving)
    expected = field.trajectory("toy car")
    out = tmp_path / "car.csv"
    ask = ["query", moving, "--label", "toy car", "--trajectory"]
    assert cif.run([*ask, out]) == 0
    capfd.readouterr()
    assert cif.run(ask) == 0
    assert capfd.readouterr().out == out.read_text()
    # The word after the flag is its file where it ends in .csv alone.
    assert cif.run(["query", "--trajectory", moving, "--label", "toy car"]) == 0
    assert capfd.readouterr().out == out.read_text()
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["object"], row["label"], row["class"]) for row in rows} == {("toy_car_002", "toy car", "car")}
    columns = {
        "frame": expected["time_codes"],
        "time": expected["times"],
        "seconds": expected["seconds"],
        "x": expected["translations"][:, 0],
        "z": expected["translations"][:, 2],
        "qw": expected["rotations"][:, 0],
        "qz": expected["rotations"][:, 3],
        "visible": expected["visible"],
    }
    for name, values in columns.items():
        assert [float(row[name]) for row in rows] == values.tolist(), name
    # The stage it came from has the same path.
    assert cif.run(["query", moving.with_suffix(".usda"), "--label", "toy car", "--trajectory"]) == 0
    stage = list(csv.DictReader(capfd.readouterr().out.splitlines()))
    for name in ["frame", "x", "y", "z", "qw", "qz"]:
        values = [float(row[name]) for row in rows]
        assert [float(row[name]) for row in stage] == pytest.approx(values, abs=1e-3), name

    before = out.read_bytes()
    assert cif.run([*ask, out]) == 1 and out.read_bytes() == before
    assert "--force" in capfd.readouterr().err
    assert cif.run([*ask, out, "--force"]) == 0
    assert cif.run([*ask, tmp_path / "car.json"]) == 2 and ".csv" in capfd.readouterr().err
    assert cif.run([*ask, "--time", "0.5"]) == 2
    assert cif.run(["query", moving, "--label", "teapot", "--trajectory"]) == 1


def test_pictures_for_notebooks(field: cif.Field, tmp_path: Path) -> None:
    _, _, camera = field.cameras[2]
    picture = field.show(2)
    assert picture.pixels.shape == (48, 64, 3) and picture.pixels.dtype == np.uint8
    color = field.render(camera, TIMES[2])["color"]
    assert np.abs(picture.pixels - 255 * color.clip(0, 1)).max() <= 0.5
    assert np.array_equal(field.show(camera, TIMES[2]).pixels, picture.pixels)
    assert (
        field.show(what="instance-color").pixels.std() > 0 and field.show(what="depth-color").pixels.std() > 0
    )
    data = picture._repr_png_()
    assert data.startswith(b"\x89PNG\r\n")
    picture.save(tmp_path / "view.png")
    assert (tmp_path / "view.png").read_bytes().startswith(b"\x89PNG\r\n")
    with pytest.raises(cif.CifError, match="exists"):
        picture.save(tmp_path / "view.png")
    picture.save(tmp_path / "view.png", force=True)
    with pytest.raises(cif.CifError, match=r"\.png"):
        picture.save(tmp_path / "view.jpg")
    with pytest.raises(ValueError, match="choose rgb"):
        field.show(what="color")
    with pytest.raises(IndexError, match="view 99 of 7"):
        field.show(99)


def test_tables_for_notebooks(field: cif.Field) -> None:
    table = field._repr_html_()
    for text in ["340 Gaussians", "<td>red mug</td>", "<td>napkin</td>", f"<td>{PER_OBJECT}</td>"]:
        assert text in table, table
    assert table.startswith('<img src="data:image/png;base64,iVBOR')
    arrays = {name: np.ones((1, 3), np.float32) for name in ["means", "scales", "colors"]}
    hostile = cif.Field.from_arrays(
        **arrays,
        quaternions=np.ones((1, 4), np.float32),
        opacities=np.full(1, 0.5, np.float32),
        instances=[{"id": 1, "label": "<b>&mug"}],
    )
    assert "<td>&lt;b&gt;&amp;mug</td>" in hostile._repr_html_()
    dataset = cif.open_dataset(CAPTURE)
    summary = dataset.summary()
    shown = dataset._repr_html_()
    assert f"<td>frames</td><td>{summary['frames']}</td>" in shown
    assert shown.startswith('<img src="data:image/png;base64,iVBOR')
    image = dataset.load_frame(3)["image"]
    assert np.array_equal(dataset.show(3).pixels, image)
    mask = next(k for k, frame in enumerate(dataset.frames) if frame["mask"])
    shown = dataset.show(mask, what="instance-color").pixels
    ids = dataset.load_frame(mask)["mask"]
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) == len(np.unique(ids))
    with pytest.raises(IndexError):
        dataset.show(10_000)


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
