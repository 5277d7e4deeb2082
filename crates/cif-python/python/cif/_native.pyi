"""Types and documentation of the native half of cif; docstrings come from the Rust code (`make stubs`).

Conventions: right-handed world in metres; cameras look along +z with x right and y down; quaternions are
(w, x, y, z); times are normalised to [0, 1]; time codes are captured frame numbers; colours are as captured.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

__version__: str

class CifError(Exception):
    """A file, capture, field or stage is not as it should be; the message names it and the way out."""

class Camera:
    """A pinhole camera; the centre of the first pixel is (0.5, 0.5)."""

    def __init__(
        self,
        width: int,
        height: int,
        focal: tuple[float, float],
        principal: tuple[float, float] | None = None,
        camera_from_world: NDArray[np.float64] | None = None,
    ) -> None:
        """Make a camera from pixels and a [4, 4] pose; by default central principal point, identity."""
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def focal(self) -> tuple[float, float]: ...
    @property
    def principal(self) -> tuple[float, float]: ...
    @property
    def camera_from_world(self) -> NDArray[np.float64]: ...
    def resized(self, width: int, height: int) -> Camera:
        """Return the same view at another resolution."""

class Dataset:
    """A capture, understood: frames, cameras, times, masks, instances, initial points."""

    @property
    def root(self) -> Path: ...
    @property
    def layout(self) -> str: ...
    @property
    def times(self) -> list[float]: ...
    @property
    def instances(self) -> list[dict[str, Any]]: ...
    @property
    def warnings(self) -> list[str]: ...
    @property
    def notes(self) -> list[str]:
        """Findings and decisions of reading, such as what is left out, one sentence each."""
    @property
    def frames(self) -> list[dict[str, Any]]:
        """name, camera_name, time, time_index, split, group, image and mask of every frame."""
    @property
    def points(self) -> NDArray[np.float32]:
        """Initial points [P, 3]."""
    @property
    def point_colors(self) -> NDArray[np.uint8]:
        """Colours of the initial points [P, 3]."""
    def __len__(self) -> int: ...
    def camera(self, index: int) -> Camera:
        """Return the camera of a frame."""
    def load_frame(
        self, index: int, background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ) -> dict[str, NDArray[Any] | None]:
        """Load image uint8 [H, W, 3] and mask uint16 [H, W] (None without one); alpha goes onto background."""
    def show(self, index: int = 0, *, what: Literal["rgb", "instance-color"] = "rgb") -> Picture: ...
    def _repr_html_(self) -> str: ...
    def summary(self) -> dict[str, Any]:
        """Return counts of everything, for a first look."""

class SceneOptions(TypedDict, total=False):
    """Options of an exported scene, whatever the format."""

    tolerance: str | float
    """Largest error of a simplified motion: "0.2%" of the size of the object (the default), or world units."""
    appearance_tolerance: float
    """Largest RMS error of opacities and colours that change over time; 0 keeps them at every frame."""
    most_expensive_motion: Literal["static", "rigid", "parts", "dense"]
    min_opacity: float
    """Splats below this opacity are left out; by default 1/255."""
    min_occupancy: float
    """Splats below this occupancy are left out."""
    background_threshold: float
    """Splats with less instance mass are background too."""
    max_parts: int
    """Most rigid parts of an object."""
    reduce_keys: bool
    """Leave out samples that interpolation reproduces inside the tolerance; on by default."""
    hulls_per_instance: int
    """Most convex colliders of an object; by default 1."""
    background_hulls: int
    """Most convex colliders of the background; by default 0."""
    frames: tuple[int, int] | None
    """First and last frame; by default all."""
    frame_step: int
    """Every how many frames motion is sampled."""
    up_axis: Literal["y", "z"]
    """Axis to declare; the data is not turned."""
    meters_per_unit: float
    proxy_points: int
    """Most points of the stand-in of an object; 0 for none."""

class UsdOptions(TypedDict, total=False):
    """Options of USD files."""

    payloads: Literal["by-kind", "separate", "single-file"]
    """Where the arrays of objects go: beside the stage, into it, or (by-kind) beside .usda alone."""
    levels_of_detail: bool
    """Add variants with half and a quarter of the splats; on by default."""

class PlyOptions(TypedDict, total=False):
    """Options of PLY files."""

    time_code: float | None
    """The frame that is written; by default the first."""

class Field:
    """A dynamic Gaussian field with instances: N Gaussians, K instances."""

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Field:
        """Read a .cif file."""
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a .cif file, replacing an older one only once the new one is complete."""
    @staticmethod
    def from_arrays(
        *,
        means: NDArray[np.float32],
        scales: NDArray[np.float32],
        quaternions: NDArray[np.float32],
        opacities: NDArray[np.float32],
        colors: NDArray[np.float32],
        occupancies: NDArray[np.float32] | None = None,
        identities: NDArray[np.float32] | None = None,
        instances: list[dict[str, Any]] | None = None,
        times: Sequence[float] = (0.0,),
        frames_per_second: float = 24.0,
        cameras: Sequence[tuple[str, int, Camera]] | None = None,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> Field:
        """Make a static field.

        [N, 3] means, standard deviations and colours, [N, 4] quaternions, [N] opacities and occupancies
        (opacities by default), [N, K] identity probabilities, where what a row lacks of 1 belongs to no
        instance; instances have id, label and category; cameras are (name, index into times, camera).
        """
    def __len__(self) -> int: ...
    @property
    def means(self) -> NDArray[np.float32]:
        """Canonical centres [N, 3]."""
    @property
    def scales(self) -> NDArray[np.float32]:
        """Canonical standard deviations [N, 3]."""
    @property
    def quaternions(self) -> NDArray[np.float32]:
        """Canonical quaternions [N, 4], not normalised."""
    @property
    def opacities(self) -> NDArray[np.float32]:
        """Opacities [N]."""
    @property
    def occupancies(self) -> NDArray[np.float32]:
        """Occupancies [N]."""
    @property
    def sh_coefficients(self) -> NDArray[np.float32]:
        """Spherical harmonics [N, 16, 3]; those above sh_degree are not in use."""
    @property
    def sh_degree(self) -> int: ...
    @property
    def identities(self) -> NDArray[np.float32] | None:
        """Identity probabilities [N, K]; None before identities were estimated."""
    @property
    def instances(self) -> list[dict[str, Any]]:
        """id, label and category of every instance."""
    @property
    def times(self) -> list[float]:
        """Normalised captured times."""
    @property
    def frames_per_second(self) -> float: ...
    @property
    def cameras(self) -> list[tuple[str, int, Camera]]:
        """(name, index into times, camera) of every captured view."""
    @property
    def provenance(self) -> Any:
        """How the field came about."""
    def at(self, time: float) -> dict[str, NDArray[np.float32]]:
        """Return means, scales, quaternions and opacities moved to a time."""
    def render(
        self, camera: Camera, time: float = 0.0, *, depth: bool = True, instances: bool = True
    ) -> dict[str, NDArray[Any]]:
        """Render a view.

        color [H, W, 3] and alpha; depth in metres; label (index into instances plus 1, 0 for none),
        probability, coverage, foreground and entropy where the field has identities.
        """
    def show(
        self,
        view: int | Camera | None = None,
        time: float | None = None,
        *,
        what: Literal["rgb", "instance-color", "depth-color"] = "rgb",
    ) -> Picture:
        """Render a view as a picture."""
    def _repr_html_(self) -> str: ...
    def query(self, points: NDArray[np.float64], time: float = 0.0) -> dict[str, NDArray[Any]]:
        """Tell what is at points [P, 3]: existence [P], instance [P] (-1 for none), probabilities [P, K]."""
    def trajectory(self, label: str) -> dict[str, Any]: ...
    def find(self, label: str, time_code: float | None = None) -> list[dict[str, Any]]:
        """Return objects by label, class or name (see LabelPattern): path, transform, low, high."""
    def export(
        self,
        path: str | os.PathLike[str],
        *,
        motion: Callable[[float], tuple[NDArray[np.float32], NDArray[np.float32]]] | None = None,
        options: UsdOptions | PlyOptions | None = None,
        force: bool = False,
        **scene: Unpack[SceneOptions],
    ) -> dict[str, Any]:
        """Write the scene with one prim or node per object.

        The ending decides the format: .usda, .usdc, .usdz (USD), .glb, .gltf (glTF) or .ply (splats).
        glTF holds rigid motion only: what deforms leaves as a few rigid parts; the motion table says what that
        misses. PLY holds all splats as they stand at one frame.

        motion replaces the trained deformation by a function of time that returns means [N, 3] and quaternions
        [N, 4]. options are those of the format, as in {"payloads": "separate"}; other keyword arguments are
        options of the scene, whatever the format, as in tolerance="0.5%". Unknown ones raise ValueError. The
        answer holds the motion table, sizes and warnings. A file that cif did not write is only replaced with
        force.
        """

class Picture:
    """An 8-bit RGB picture."""

    @property
    def pixels(self) -> NDArray[np.uint8]: ...
    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None: ...
    def _repr_png_(self) -> bytes: ...

def main(arguments: Sequence[str | os.PathLike[str]]) -> int:
    """Run the command line in a process that is nothing but the command, which takes its signals."""

def run(arguments: Sequence[str | os.PathLike[str]]) -> int:
    """Run the command line; the first argument is the name of the program. Signals stay with the process."""

def train(
    dataset: Dataset | str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    preset: Literal["draft", "standard", "paper"] | None = None,
    effects: str | None = None,
    settings: dict[str, Any] | None = None,
    seed: int | None = None,
    backend: Literal["cpu", "wgpu", "auto"] = "cpu",
    callback: Callable[[dict[str, Any]], bool | None] | None = None,
    resume: bool = False,
    force: bool = False,
) -> Field:
    """Train a field on a capture, and return it.

    dataset is an opened capture or its folder. With output, a .cif file, the run is saved there every five
    minutes, at the end of each stage and in the end, its settings beside it; without, it is only returned.

    preset is "draft", "standard" (the default) or "paper"; effects says which effects are trained, "auto" (as
    the capture calls for), "all" or "none", then single ones on or off, as in "auto,-instances". settings are
    single settings by their keys in the settings file, dotted or as dictionaries: {"stages.fine": 500} or
    {"stages": {"fine": 500}}. seed makes runs repeatable: same seed and settings, same field. backend is "cpu",
    "wgpu" (a GPU) or "auto".

    callback is called in this thread with a dictionary for each event of the run; its "event" is
    "stage_started", "step" (every report.step_every steps: stage, iteration, iterations, loss, psnr, gaussians,
    eta_s), "evaluated", "warning", "finished" and more. When it returns False the run stops and the field as it
    is then is returned. An exception in it stops the run and is raised, as is KeyboardInterrupt on Ctrl-C. In
    all three cases the run is saved to output first, and resume=True goes on with it, with the settings of the
    file.

    An output that exists is refused without force or resume. Raises CifError when the capture, a setting or the
    output is not as it should be. Other Python threads run meanwhile.
    """

def evaluate(
    scene: Field | str | os.PathLike[str],
    capture: Dataset | str | os.PathLike[str],
    *,
    split: Literal["val", "train"] = "val",
    masks: str | os.PathLike[str] | None = None,
    downscale: int | None = None,
) -> dict[str, Any]:
    """Score a scene."""

def open_dataset(
    path: str | os.PathLike[str],
    masks: str | os.PathLike[str] | None = None,
    downscale: int | None = None,
) -> Dataset:
    """Open a capture; masks name a folder inside it or anywhere."""

class LabelPattern:
    """A label to look for: ``*`` stands for any characters and ``?`` for one; case does not matter."""

    def __init__(self, text: str) -> None: ...
    def matches(self, label: str) -> bool:
        """Tell whether a label is spelled so."""

def query_stage(
    path: str | os.PathLike[str],
    label: str,
    time_code: float | None = None,
    *,
    follow_external: bool = False,
) -> list[dict[str, Any]]:
    """Return the prims that carry a label (see LabelPattern); an unknown label lists the known ones.

    Layers outside the folder of the stage are read with ``follow_external`` alone.
    """

def import_scene(
    path: str | os.PathLike[str], *, base: Field | None = None, force_base: bool = False
) -> tuple[Field, dict[str, Any] | None]:
    """Read a USD, glTF or PLY file as a field.

    With ``base``, the field that the file was exported from, what was changed in the file is applied to it, and
    the second value lists the edits as ``diff`` does; otherwise it is None. ``force_base`` takes a base that
    the file was not exported from.
    """

def diff(before: str | os.PathLike[str], after: str | os.PathLike[str]) -> dict[str, Any]:
    """Compare two scenes, stages or glTF files object by object.

    ``objects`` lists those that differ: what happened (``kind``), how far they moved over time, names, labels,
    visibility, and counts of splats; ``unchanged`` counts the others.
    """

def usd_version() -> str:
    """Return the version of the usd-core in use, e.g. 26.11."""
