"""A small hand-made field with a static, a rigid and a bending object, and its stage."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cif
import numpy as np
import pytest

FRAMES = 6
TIMES = [k / (FRAMES - 1) for k in range(FRAMES)]
PER_OBJECT = 80
LABELS = [
    {"id": 1, "label": "red mug", "category": "mug", "taxonomies": {"wikidata_qcode": "Q81727"}},
    {"id": 2, "label": "toy car", "category": "car"},
    {"id": 7, "label": "green napkin", "category": "napkin"},
]
CAR = slice(PER_OBJECT, 2 * PER_OBJECT)
NAPKIN = slice(2 * PER_OBJECT, 3 * PER_OBJECT)


def turn(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation about z as a matrix and as a (w, x, y, z) quaternion."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return matrix, np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of one quaternion with rows of quaternions."""
    w, x, y, z = a
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return b @ matrix.T


def camera_at(x: float) -> cif.Camera:
    """A camera at (x, -4, 1) that looks along +y."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[:3, 3] = -pose[:3, :3] @ [x, -4, 1]
    return cif.Camera(64, 48, (60.0, 58.0), (30.0, 25.0), pose)


def answer_of(capfd: pytest.CaptureFixture[str], *words: object) -> dict:
    """The JSON that a command prints."""
    capfd.readouterr()
    assert cif.run([*map(str, words), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def make_field() -> cif.Field:
    """Three objects of 80 Gaussians each and a background of 100."""
    chance = np.random.default_rng(5)
    centres = np.repeat([[0, 0, 0], [1, 0, 0], [0, 1, 0]], PER_OBJECT, axis=0)
    objects = centres + chance.uniform(-0.2, 0.2, (3 * PER_OBJECT, 3))
    background = chance.uniform([-2, -2, -1], [2, 2, -0.5], (100, 3))
    means = np.concatenate([objects, background]).astype(np.float32)
    n = len(means)
    quaternions = chance.normal(size=(n, 4)).astype(np.float32)
    identities = np.zeros((n, 3), np.float32)
    identities[np.arange(3 * PER_OBJECT), np.repeat([0, 1, 2], PER_OBJECT)] = 1
    occupancies = np.where(np.arange(n) < 3 * PER_OBJECT, 0.9, 0.02).astype(np.float32)
    return cif.Field.from_arrays(
        means=means,
        scales=chance.uniform(0.01, 0.05, (n, 3)).astype(np.float32),
        quaternions=quaternions,
        opacities=np.full(n, 0.8, np.float32),
        colors=chance.uniform(0, 1, (n, 3)).astype(np.float32),
        occupancies=occupancies,
        identities=identities,
        instances=LABELS,
        times=TIMES,
        frames_per_second=12.0,
        cameras=[("hand held", k, camera_at(0.1 * k)) for k in range(FRAMES)] + [("tripod", 0, camera_at(2.0))],
    )


def motion_of(field: cif.Field) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """The car drives and turns, the napkin bends, everything else rests."""
    means, quaternions = field.means, field.quaternions

    def motion(time: float) -> tuple[np.ndarray, np.ndarray]:
        moved, turned = means.copy(), quaternions.copy()
        matrix, quaternion = turn(2.5 * time)
        moved[CAR] = means[CAR] @ matrix.T + [0.5 * time, 0, 0.2 * time]
        turned[CAR] = multiply(quaternion, quaternions[CAR])
        moved[NAPKIN, 2] += 4 * time * means[NAPKIN, 0] ** 2
        return moved, turned

    return motion


@pytest.fixture(scope="session")
def field() -> cif.Field:
    return make_field()


@pytest.fixture(scope="session")
def motion(field: cif.Field) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    return motion_of(field)


@pytest.fixture(scope="session", params=["usda", "usdc", "usdz"])
def stage_path(
    request: pytest.FixtureRequest, field: cif.Field, motion, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp("stage") / f"scene.{request.param}"
    field.export(path, motion=motion, reduce_keys=False)
    return path
