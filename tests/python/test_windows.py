"""A long capture in windows of time: trained one by one, scored, and exported as one stage."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cif
import pytest
from pxr import Usd, UsdGeom

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "tabletop-mini"
CIF = Path(sys.executable).with_name("cif")

SETTINGS = (
    "--iterations-coarse 5 --iterations-fine 20 --iterations-instance 5 --max-gaussians 800 "
    "--set model.spatial_resolution=[8,8,8] --set motion.rehearsal=5 --set motion.rigid=false "
    "--set motion.parts=false"
)


def run(*words: str | Path, code: int = 0) -> str:
    done = subprocess.run([CIF, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a batch of two windows of the example, whose 72 times are divided in the middle."""
    folder = tmp_path_factory.mktemp("windows")
    plan = folder / "plan.toml"
    plan.write_text(
        f'captures = ["{EXAMPLE}"]\n[train]\nwindows = 2\noptions = "{SETTINGS}"\n[eval]\npictures = false\n'
        '[export]\nfiles = ["walk.usda"]\n'
    )
    run("batch", plan)
    return folder / "results" / "scenes" / "tabletop-mini"


def test_each_window_is_scored_on_its_own_frames(batch: Path) -> None:
    all_frames = json.loads((EXAMPLE / "dataset.json").read_text())["val_ids"]
    scored = [json.loads((batch / f"run.window00{k}" / "scores.json").read_text()) for k in (1, 2)]
    counts = [scores["frames"] for scores in scored]
    # An eighth of 36 times is shared on each side.
    assert all(0 < count < len(all_frames) for count in counts), counts
    assert sum(counts) >= len(all_frames)
    for scores in scored:
        assert scores["psnr"] > 10
    for number, codes in ((1, [0, 40]), (2, [31, 71])):
        facts = json.loads(run("info", batch / f"run.window00{number}" / "scene.cif", "--json"))
        assert (facts["window"], facts["time_codes"]) == (f"{number}/2", codes)


def test_the_stage_has_one_path_of_each_object_and_splats_of_each_window(batch: Path) -> None:
    assert "walk.usda" in (batch.parents[1] / "index.html").read_text()
    stage = Usd.Stage.Open(str(batch / "run" / "walk.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 71)
    splats = [prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat"]
    assert any(prim.GetName().startswith("background") for prim in splats)
    changed = 0
    for prim in splats:
        counts = {}
        for code in (0, 17, 35, 36, 50, 71):
            values = [prim.GetAttribute(name).Get(code) for name in ("positions", "opacities", "scales")]
            assert len({len(value) for value in values}) == 1
            counts[code] = len(values[0])
        assert counts[0] == counts[17] == counts[35] and counts[36] == counts[50] == counts[71]
        changed += counts[35] != counts[36]
        assert UsdGeom.Xformable(prim.GetParent()).ComputeLocalToWorldTransform(40)
    assert changed
    cameras = [prim for prim in stage.Traverse() if prim.GetTypeName() == "Camera"]
    assert cameras


def test_python_takes_windows_too(batch: Path) -> None:
    part = cif.open_dataset(EXAMPLE, window="2/2")
    assert len(part.times) == 41
    with pytest.raises(ValueError, match="2/4 is the second of four"):
        cif.open_dataset(EXAMPLE, window="3/2")
    field, changes = cif.import_scene(batch / "run" / "walk.usda", window="1/2")
    assert changes is None and len(field.times) == 36
    scores = cif.evaluate(batch / "run.window002" / "scene.cif", EXAMPLE)
    of_command = json.loads((batch / "run.window002" / "scores.json").read_text())
    assert scores["frames"] == of_command["frames"]


def test_objects_are_found_and_what_one_scene_cannot_hold_is_refused(batch: Path, tmp_path: Path) -> None:
    stage = batch / "run" / "walk.usda"
    first, second = (batch / f"run.window00{k}" / "scene.cif" for k in (1, 2))
    other = tmp_path / "other.cif"
    capture = tmp_path / "elsewhere"
    shutil.copytree(EXAMPLE, capture)
    run("train", capture, "-o", other, "--window", "2/2", *SETTINGS.split())
    assert "red mug" in run("query", stage, "--label", "*")
    assert "--window 1/2" in run("import", stage, "-o", tmp_path / "a.cif", code=1)
    paths = run("query", stage, "--label", "red mug", "--trajectory", "-").splitlines()
    assert len([line for line in paths if ",red mug," in line]) == 72
    run("import", stage, "--window", "2/2", "-o", tmp_path / "second.cif")
    facts = json.loads(run("info", tmp_path / "second.cif", "--json"))
    assert facts["time_codes"] == [36, 71]
    (tmp_path / "second.cif").unlink()
    cases = {
        "give each once": [first, first, "a.usda"],
        "does not hold several windows": [first, second, "a.glb"],
        "no file to write": [first, second, "--report"],
        "a stage with a file for each": [first, second, "a.usdz"],
        "was trained on the capture": [first, other, "a.usda"],
        "--check is about one scene": [first, second, "a.usda", "--check"],
    }
    for said, words in cases.items():
        paths = [tmp_path / word if word in ("a.usda", "a.usdz", "a.glb") else word for word in words]
        done = subprocess.run([CIF, "export", *map(str, paths)], capture_output=True, text=True)
        assert done.returncode != 0 and said in done.stderr, (said, done.stderr)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "other.cif", "other.train.toml"]


def test_make_goes_from_a_capture_to_one_stage_and_repeats_nothing(tmp_path: Path) -> None:
    config = tmp_path / "small.toml"
    config.write_text(
        "[stages]\ncoarse = 5\nfine = 20\ninstance = 5\n[densify]\nmax_gaussians = 800\n"
        "[model]\nspatial_resolution = [8, 8, 8]\n[motion]\nrehearsal = 5\nrigid = false\nparts = false\n"
    )
    made = tmp_path / "made"
    words = ("make", EXAMPLE, "-o", made, "--windows", "2", "--config", config)
    run(*words)
    results = ["scene.window001.cif", "scene.window002.cif", "scene.usda"]
    times = [(made / name).stat().st_mtime_ns for name in results]
    stage = Usd.Stage.Open(str(made / "scene.usda"))
    world = Usd.ClipsAPI(stage.GetPrimAtPath("/World"))
    assert [start for start, _ in world.GetClipActive()] == [0, 36]
    run(*words)
    assert [(made / name).stat().st_mtime_ns for name in results] == times
