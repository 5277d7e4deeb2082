"""What a stage says, as plain arrays. Quaternions are (w, x, y, z); lengths are stage units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .tracks import Track


@dataclass(frozen=True)
class SplatSamples:
    """Splats that deform: arrays parallel to the time codes and, inside, to the splats."""

    codes: np.ndarray
    """Ascending time codes, [T]."""
    positions: list[np.ndarray]
    """Centres, T arrays of [N, 3] float32."""
    rotations: list[np.ndarray]
    """Unit quaternions, T arrays of [N, 4] float32."""
    scales: list[np.ndarray] | None
    """Standard deviations, T arrays of [N, 3] float32; `None` while they stay the same."""


@dataclass(frozen=True)
class Fade:
    """Opacities of splats over time, linear in between."""

    codes: np.ndarray
    """Ascending time codes, [T]."""
    opacities: list[np.ndarray]
    """Opacities in [0, 1], T arrays of [N] float32."""


@dataclass(frozen=True)
class Splats:
    """Gaussians of one prim in the prim's own frame."""

    positions: np.ndarray
    """Centres, [N, 3] float32."""
    rotations: np.ndarray
    """Unit quaternions, [N, 4] float32."""
    scales: np.ndarray
    """Standard deviations along the axes, [N, 3] float32."""
    opacities: np.ndarray
    """Opacities in [0, 1], [N] float32."""
    harmonics: np.ndarray
    """Spherical-harmonics coefficients, [N, (degree + 1)^2, 3] float32; raw, degree 0 first."""
    occupancies: np.ndarray | None
    """Probability to be part of an instance's surface, [N] float32; `None` where the stage does not say."""
    samples: SplatSamples | None
    """The splats over time; `None` while they keep their places in the prim's frame."""
    fade: Fade | None
    """Opacities over time; `None` while they stay the same."""

    @property
    def count(self) -> int:
        """Number of splats."""
        return len(self.positions)


@dataclass(frozen=True)
class Visibility:
    """When something can be seen; each state holds until the next."""

    codes: np.ndarray
    """Ascending time codes, [T]; a single one where nothing changes."""
    visible: np.ndarray
    """State from each code on, [T] bool."""


@dataclass(frozen=True)
class Piece:
    """One splat prim of an instance, or what it holds during one window of time."""

    path: str
    """Path of the splat prim."""
    name: str
    """Name that tells it from its siblings, e.g. `part_00` or `window_1`."""
    frame: str
    """Path of the prim that moves it within the instance: its parent, or the splat prim itself."""
    splats: Splats
    track: Track
    """Poses in the frame of the instance."""
    visibility: Visibility | None = None
    """When it shows, where splats change from window to window of a long capture; else `None`."""


@dataclass(frozen=True)
class Instance:
    """One object of the scene, or the background."""

    path: str
    """Path of the prim that carries label and motion."""
    name: str
    """Name of that prim, e.g. `red_mug_001`."""
    label: str
    """First class label, e.g. `mug`."""
    display_name: str
    """What a person calls it, e.g. `red mug`."""
    instance: str
    """Label in the taxonomy `instance`, unique in the scene."""
    track: Track
    """Poses in the world of the stage, or in the frame of its root where that is far (`read.home`)."""
    pieces: list[Piece]
    visibility: Visibility
    data: dict[str, float | int | str] = field(default_factory=dict)
    """What else the stage says of it: id, motion model, residuals, mean occupancy."""


@dataclass(frozen=True)
class Camera:
    """A recorded camera; it looks along its own -z axis, y is up."""

    path: str
    name: str
    display_name: str
    track: Track
    lens_codes: np.ndarray
    """Time codes of the lens, [T]; a single one where it does not change."""
    focal: np.ndarray
    """Focal length over the width of the film, [T]."""
    shift: np.ndarray
    """Shift of the film's centre right and up over the width of the film, [T, 2]."""
    aspect: float
    """Height of the film over its width."""
    size: tuple[int, int] | None
    """Width and height of the recorded images, pixels."""
    clipping: tuple[float, float]
    """Nearest and farthest drawn depth."""


@dataclass(frozen=True)
class Scene:
    """A whole stage."""

    path: str
    """File of the root layer."""
    up_axis: str
    """`Y` or `Z`."""
    meters_per_unit: float
    frames_per_second: float
    start: float
    """First time code."""
    end: float
    """Last time code."""
    background_color: tuple[float, float, float]
    """Colour behind everything, display-referred."""
    instances: list[Instance]
    cameras: list[Camera]
    warnings: list[str]
    """What could not be kept, one sentence each."""
