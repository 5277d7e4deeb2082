"""Files that versions of cif wrote are read by this one: `tests/formats/VERSION/`.

Those of a version that has none are written, which fails once; those that are there stay.
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import cif
import numpy as np
import pytest
from conftest import LABELS, TIMES, answer_of, make_field, motion_of

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLE = REPOSITORY / "examples" / "tabletop-mini"
FORMATS = REPOSITORY / "tests" / "formats"
SCENE = ["scene.usda", "scene.usdc", "scene.glb"]
PLY = "scene.ply"
UNFINISHED = "unfinished.cif"
TINY = [
    *("--iterations-coarse", "4", "--iterations-fine", "4", "--iterations-instance", "2"),
    *(
        "--set",
        "model.max_initial_points=60",
        "--set",
        "model.spatial_resolution=[4,4,4]",
        "--set",
        "model.width=8",
    ),
    *("--set", "motion.rigid=false", "--set", "motion.parts=false"),
]


def write(folder: Path) -> None:
    """The same scene in every format that is read, and a training run that was stopped."""
    folder.mkdir(parents=True)
    scene = make_field()
    scene.save(folder / "scene.cif")
    for name in SCENE:
        scene.export(folder / name, motion=motion_of(scene))
    scene.export(folder / PLY)
    words = ["train", EXAMPLE, *TINY, "--stop-after", "4", "-o", folder / UNFINISHED]
    assert cif.run([*map(str, words)]) == 0


def folders() -> list[Path]:
    version = FORMATS / metadata.version("cif4d")
    if not version.exists():
        write(version)
        pytest.fail(f"{version} was missing and is written; keep it")
    return sorted(FORMATS.iterdir())


@pytest.fixture(params=folders(), ids=lambda folder: folder.name)
def folder(request: pytest.FixtureRequest) -> Path:
    """Files of one version."""
    return request.param


@pytest.mark.parametrize("name", SCENE)
def test_scenes_in_motion_are_read(
    folder: Path, name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    home = tmp_path / "home.cif"
    answer_of(capfd, "import", folder / name, "-o", home)
    found, was = cif.Field.load(home), cif.Field.load(folder / "scene.cif")
    instances = [(each["id"], each["label"], each["category"]) for each in found.instances]
    assert instances == [(each["id"], each["label"], each["category"]) for each in LABELS]
    # glTF has no motion that deforms.
    bends = {"scene.glb": [2]}.get(name, [])
    for time in TIMES:
        moved = motion_of(was)(time)[0]
        for instance in set(range(3)) - set(bends):
            rows = [field.identities[:, instance] > 0.5 for field in (found, was)]
            positions = [found.at(time)["means"][rows[0]], moved[rows[1]]]
            assert len(positions[0]) == len(positions[1])
            apart = np.linalg.norm(positions[0][:, None] - positions[1], axis=2)
            assert apart.min(axis=0).max() < 2e-3 and apart.min(axis=1).max() < 2e-3


def test_splats_are_read(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    answer_of(capfd, "import", folder / PLY, "-o", tmp_path / "home.cif")
    found, was = cif.Field.load(tmp_path / "home.cif"), cif.Field.load(folder / "scene.cif")
    np.testing.assert_allclose(found.means, was.means, atol=1e-6)


def test_training_goes_on(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / UNFINISHED
    path.write_bytes((folder / UNFINISHED).read_bytes())
    assert cif.run(["train", str(EXAMPLE), "--resume", "-o", str(path)]) == 0
    printed = capfd.readouterr().err
    assert "fine: 4 steps" in printed and "coarse:" not in printed
    assert answer_of(capfd, "info", path)["gaussians"] > 0
