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
    """A file, capture, field or stage is invalid; the message names it and the remedy."""

class Camera:
    """A pinhole camera: x right, y down, z forward; the centre of the first pixel is (0.5, 0.5).

    Width, height, focal lengths and principal point are in pixels; camera_from_world is a `[4, 4]` pose. By
    default the principal point is the middle of the image, and the pose the identity.
    """

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
    def width(self) -> int:
        """Width, pixels."""
    @property
    def height(self) -> int:
        """Height, pixels."""
    @property
    def focal(self) -> tuple[float, float]:
        """Focal lengths (x, y), pixels."""
    @property
    def principal(self) -> tuple[float, float]:
        """Principal point (x, y), pixels."""
    @property
    def camera_from_world(self) -> NDArray[np.float64]:
        """Pose, float64 `[4, 4]`: takes column vectors of the world to the camera; read-only."""
    def resized(self, width: int, height: int) -> Camera:
        """Return the same view at another resolution."""

class Dataset:
    """A capture, understood: frames, cameras, times, masks, instances, initial points."""

    @property
    def root(self) -> Path:
        """Folder of the capture."""
    @property
    def layout(self) -> str:
        """Layout that the folder was read as."""
    @property
    def times(self) -> list[float]:
        """Captured times, normalised to [0, 1]."""
    @property
    def instances(self) -> list[dict[str, Any]]:
        """id (value in the masks), label and category of every instance."""
    @property
    def warnings(self) -> list[str]:
        """Oddities that were met when the capture was read."""
    @property
    def notes(self) -> list[str]:
        """Findings and decisions of reading, such as what is left out, one sentence each."""
    @property
    def frames(self) -> list[dict[str, Any]]:
        """name, camera_name, time, time_index, split, group, image and mask of every frame."""
    @property
    def points(self) -> NDArray[np.float32]:
        """Initial points, float32 `[P, 3]`; read-only."""
    @property
    def point_colors(self) -> NDArray[np.uint8]:
        """Colours of the initial points, uint8 `[P, 3]`; read-only."""
    def __len__(self) -> int: ...
    def camera(self, index: int) -> Camera:
        """Return the camera of a frame."""
    def load_frame(
        self, index: int, background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ) -> dict[str, NDArray[Any] | None]:
        """Load image, uint8 `[H, W, 3]`, and mask, uint16 `[H, W]` (None without one), of a frame.

        Transparent pixels show the background.
        """
    def show(self, index: int = 0, *, what: Literal["rgb", "instance-color"] = "rgb") -> Picture:
        """Draw a frame as a picture, which notebooks show.

        what is "rgb" or "instance-color" (the mask in the colours of its instances).
        """
    def _repr_html_(self) -> str: ...
    def summary(self) -> dict[str, Any]:
        """Return counts of everything, for a first look."""

class SceneOptions(TypedDict, total=False):
    """Options of an exported scene, whatever the format."""

    tolerance: str | float
    """Largest error of a motion that is fitted, where no poses are recorded: "0.2%" of the size of the object (the
    default), or world units."""
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
    """Leave out samples that interpolation reproduces: inside the tolerance, or up to rounding where poses are recorded.
    On by default."""
    hulls_per_instance: int
    """Most convex colliders of an object; by default 1."""
    background_hulls: int
    """Most convex colliders of the background; by default 0."""
    frames: tuple[int, int] | None
    """First and last frame; by default all."""
    frame_step: int
    """Every how many frames motion is sampled."""
    up_axis: Literal["y", "z"]
    """Axis to declare; the data is not turned. By default that of the imported file, else z."""
    meters_per_unit: float
    """Metres per world unit; by default that of the imported file, else 1."""
    proxy_points: int
    """Most points of the stand-in of an object; 0 for none."""
    bake_blur: bool
    """Widen splats by the filter of the renderer, for viewers without one; off by default."""

class UsdOptions(TypedDict, total=False):
    """Options of USD files."""

    payloads: Literal["by-kind", "separate", "single-file"]
    """Where the arrays of objects go: next to the stage, into it, or (by-kind) next to .usda alone."""
    levels_of_detail: bool
    """Add variants with half and a quarter of the splats; on by default."""
    ground: Literal["none", "auto"] | dict[Literal["at"], float]
    """A plane for simulators: where the objects stand, or at a height; none by default."""
    density: float
    """Density of objects over the volume that their splats fill, kg/m3; 300 by default."""
    weld_kinematic: bool
    """Fix objects on recorded tracks to the world by joints, as MuJoCo needs; off by default."""

class PlyOptions(TypedDict, total=False):
    """Options of PLY files."""

    time_code: float | None
    """The frame that is written; by default the first."""
    turn_up: Literal["y", "z"] | None
    """Turn the scene so that this axis is up; by default it stands as captured."""

class Field:
    """A dynamic Gaussian field with instances: N Gaussians, K instances, T captured times.

    A field does not change: its arrays are copies that numpy refuses to write to. To change one, copy it, and
    make a field of arrays with `from_arrays`.
    """

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

        means, scales (standard deviations) and colors are float32 `[N, 3]`, quaternions `[N, 4]`, opacities and
        occupancies (opacities by default) `[N]`, identities `[N, K]` probabilities, where what a row lacks of 1
        belongs to no instance. instances have id, label and category; cameras are (name, index into times,
        camera).
        """
    def __len__(self) -> int: ...
    @property
    def means(self) -> NDArray[np.float32]:
        """Centres before any motion, float32 `[N, 3]`, in the frame of the field; read-only."""
    @property
    def scales(self) -> NDArray[np.float32]:
        """Standard deviations along the axes before any motion, float32 `[N, 3]`; read-only."""
    @property
    def quaternions(self) -> NDArray[np.float32]:
        """Quaternions (w, x, y, z) before any motion, not normalised, float32 `[N, 4]`; read-only."""
    @property
    def opacities(self) -> NDArray[np.float32]:
        """Opacities in [0, 1], float32 `[N]`; read-only."""
    @property
    def occupancies(self) -> NDArray[np.float32]:
        """Probabilities to exist, in [0, 1], float32 `[N]`; read-only."""
    @property
    def sh_coefficients(self) -> NDArray[np.float32]:
        """Spherical harmonics, float32 `[N, 16, 3]`; those above sh_degree are not in use; read-only."""
    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in use, 0 to 3."""
    @property
    def identities(self) -> NDArray[np.float32] | None:
        """Probability of every instance, float32 `[N, K]`, read-only; None before identities were estimated."""
    @property
    def instances(self) -> list[dict[str, Any]]:
        """id (value in the masks), label and category of every instance, in the order of identities."""
    @property
    def times(self) -> list[float]:
        """Captured times, normalised to [0, 1]."""
    @property
    def frames_per_second(self) -> float:
        """Captured frames per second; the time code of frame k is k."""
    @property
    def cameras(self) -> list[tuple[str, int, Camera]]:
        """(name, index into times, camera) of every captured view."""
    @property
    def provenance(self) -> Any:
        """How the field came about: its run, settings and notes."""
    def at(self, time: float) -> dict[str, NDArray[np.float32]]:
        """Return means, scales, quaternions and opacities as they are at a normalised time."""
    def render(
        self, camera: Camera, time: float = 0.0, *, depth: bool = True, instances: bool = True
    ) -> dict[str, NDArray[Any]]:
        """Render a view at a normalised time, as arrays.

        color is float32 `[H, W, 3]` in [0, 1], alpha `[H, W]`, depth `[H, W]` in units of the field; where the
        field has identities also label (index into instances plus 1, 0 for none), probability, coverage,
        foreground and entropy, `[H, W]` each.
        """
    def show(
        self,
        view: int | Camera | None = None,
        time: float | None = None,
        *,
        what: Literal["rgb", "instance-color", "depth-color"] = "rgb",
    ) -> Picture:
        """Render a view as a picture, which notebooks show.

        view is an index into cameras (by default the first), or a camera; time is normalised, by default that
        of the view, or 0. what is "rgb", "instance-color" (the most probable instance of each pixel) or
        "depth-color" (near is bright).
        """
    def _repr_html_(self) -> str: ...
    def query(self, points: NDArray[np.float64], time: float = 0.0) -> dict[str, NDArray[Any]]:
        """Answer what is at points at a normalised time.

        points are float64 `[P, 3]` in the frame of the field. existence is `[P]`, instance `[P]` (index into
        instances, -1 for none), probabilities `[P, K]`.
        """
    def trajectory(self, label: str) -> dict[str, Any]:
        """Return the path of an object over all captured frames, as arrays.

        label is as in find, and has to fit one object. The answer has instance (unique name), label and class;
        time_codes (captured frame numbers), times (normalised) and seconds (time codes over frames_per_second),
        float64 `[T]`; translations, float64 `[T, 3]`, the origin of the object's frame in the world of the
        capture, in its units: at the first frame the middle of the object; rotations, float64 `[T, 4]`, unit
        quaternions (w, x, y, z) from the object's frame to the world, the identity while it is turned as at the
        first frame, and without jumps of sign; visible, bool `[T]`. An object of parts goes with its largest
        part, one that bends with the rigid body that fits it best. Raises CifError where no object, or more
        than one, carries the label.
        """
    def find(self, label: str, time_code: float | None = None) -> list[dict[str, Any]]:
        """Return the objects that carry a label, each as a dictionary.

        label is a label, class or unique name; `*` stands for any characters, `?` for one, and case does not
        matter. Each has path, class, instance (unique name), label, transform (`[4][4]`, world from object, for
        column vectors) and low and high, the corners of its box in the world of the capture, at a time code
        (captured frame number, by default the first). The first call builds the scene graph, which the field
        keeps. Raises CifError, with the labels there are, where nothing carries it.
        """
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

        The ending decides the format: .usda, .usdc, .usdz (USD), .glb, .gltf (glTF) or .ply (splats). glTF
        holds rigid motion only: what deforms leaves as a few rigid parts; the motion table says what that
        misses. PLY holds all splats as they stand at one frame.

        motion replaces the trained deformation by a function of time that returns means `[N, 3]` and
        quaternions `[N, 4]`. options are those of the format, as in {"payloads": "separate"}; other keyword
        arguments are options of the scene, whatever the format, as in tolerance="0.5%". Unknown ones raise
        ValueError. The answer holds the motion table, sizes and warnings. A file that cif did not write is only
        replaced with force.
        """

class Picture:
    """An 8-bit RGB picture, as drawn by `show`; notebooks show it."""

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """Colours, uint8 `[H, W, 3]`; read-only."""
    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write a PNG file; one that exists is only replaced with force."""
    def _repr_png_(self) -> bytes: ...

def main(arguments: Sequence[str | os.PathLike[str]]) -> int:
    """Run a command line in a process that is nothing but the command, which takes its signals."""

def run(arguments: Sequence[str | os.PathLike[str]]) -> int:
    """Run a command line, whose first word is the name of the program, and return its exit code.

    Signals stay with the process.
    """

def train(
    dataset: Dataset | str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    preset: Literal["draft", "standard", "best", "paper"] | None = None,
    effects: str | None = None,
    settings: dict[str, Any] | None = None,
    seed: int | None = None,
    backend: Literal["cpu", "wgpu", "auto"] = "cpu",
    callback: Callable[[dict[str, Any]], bool | None] | None = None,
    resume: bool = False,
    force: bool = False,
) -> Field:
    """Train a field on a capture, and return it.

    dataset is an opened capture or its folder. With output, a .cif file, the run is saved there every five minutes,
    at the end of each stage and in the end, its settings next to it; without, it is only returned.

    preset is "draft", "standard" (the default), "best" or "paper"; effects says which effects are trained, "auto" (as the
    capture calls for), "all" or "none", then single ones on or off, as in "auto,-instances". settings are single
    settings by their keys in the settings file, dotted or as dictionaries: {"stages.fine": 500} or {"stages":
    {"fine": 500}}. seed makes runs repeatable: same seed and settings, same field. backend is "cpu", "wgpu" (a GPU)
    or "auto".

    callback is called in this thread with a dictionary for each event of the run; its "event" is "stage_started",
    "stage_ended" (stage, wall_s), "step" (every report.step_every steps: stage, iteration, iterations, loss, psnr,
    gaussians, eta_s), "evaluated", "note", "warning", "finished" and more. Work without steps is reported as
    "phase_started", "phase_progress" (phase, done, total, elapsed_s, eta_s) and "phase_ended" (phase, wall_s, cpu_s),
    from the opening of the capture on. When it returns False the run stops and the field as it is then is returned;
    CifError is raised where it stops before the first step. An exception in it stops the run and is raised, as is
    KeyboardInterrupt on Ctrl-C. In all three cases the run is saved to output first, and resume=True goes on with it,
    with the settings of the file.

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
    """Score a scene on frames of a capture: the scores of `cif eval --json`, as a dictionary.

    scene is a field or a .cif file; a file that another head was trained on is scored by what that head
    decodes. capture is an opened capture or its folder, which masks (a folder) and downscale (by default as
    the scene was trained) say how to open. split is "val", the held-out frames, or "train".

    The answer has frames (their number), psnr, psnr_mean_look (without the exposures of cameras), psnr_color_fitted
    (colours of each image fitted to its truth), psnr_covisible and covisible (percent of pixels), ssim,
    panoptic (quality, segmentation, recognition and iou in percent, pixels without a label being background),
    macc_pix, macc_inst and miou (percent, over labelled pixels), variants (other definitions in use),
    instances (scores of each), groups, per_frame, motion (against known motion, where the capture has it), gaussians,
    render_ms_per_frame, train (of its run: wall_s, iterations and more), warnings, and seconds, which scoring
    took by the clock of the wall. None means that there is nothing to measure. Ctrl-C raises
    KeyboardInterrupt between two frames.
    """

def open_dataset(
    path: str | os.PathLike[str],
    masks: str | os.PathLike[str] | None = None,
    downscale: int | None = None,
    window: str | None = None,
) -> Dataset:
    """Open a capture.

    masks names a folder inside it or anywhere, by default "masks" where it has one; downscale reduces images
    by 1, 2, 4 and so on, by default to the largest stored. window takes one of several windows of time of a long
    capture, "2/4" the second of four.
    """

class LabelPattern:
    """A label to look for: `*` stands for any characters and `?` for one; case does not matter."""

    def __init__(self, text: str) -> None: ...
    def matches(self, label: str) -> bool:
        """Return True where a label is spelled so."""

def query_stage(
    path: str | os.PathLike[str],
    label: str,
    time_code: float | None = None,
    *,
    follow_external: bool = False,
) -> list[dict[str, Any]]:
    """Return the prims of a stage, or nodes of a glTF file, that carry a label, each as a dictionary.

    label is as in Field.find, and so are the answers; an unknown label lists the known ones. Layers outside
    the folder of the stage are read with follow_external alone.
    """

def import_scene(
    path: str | os.PathLike[str],
    *,
    base: Field | None = None,
    force_base: bool = False,
    window: str | None = None,
) -> tuple[Field, dict[str, Any] | None]:
    """Read a USD, glTF or PLY file as a field.

    With base, the field that the file was exported from, what was changed in the file is applied to it, and
    the second value lists the edits as diff does; otherwise it is None. force_base takes a base that the file
    was not exported from. window takes one of several windows of time of a stage, as "2/4".
    """

def diff(before: str | os.PathLike[str], after: str | os.PathLike[str]) -> dict[str, Any]:
    """Compare two scenes, stages or glTF files object by object.

    objects lists those that differ: what happened (kind), how far they moved over time, names, labels,
    visibility, and counts of splats; unchanged counts the others.
    """

def usd_version() -> str:
    """Return the version of the USD in use, e.g. 26.11.

    Raises CifError where there is none, or one older than 25.11.
    """
