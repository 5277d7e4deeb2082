"""A stage as plain arrays, read by attribute name, so that a USD without splat schemas can do it too.

Layout of what `cif export` writes: an Xform per object with labels and motion; under it, or under its rigid
parts, `ParticleField3DGaussianSplat` prims. Stages by others are taken as they come: every splat prim belongs
to its nearest labelled ancestor, or to its parent.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from . import tracks
from .scene import Camera, Fade, Instance, Piece, Scene, Splats, SplatSamples, Visibility

SPLAT_TYPE = "ParticleField3DGaussianSplat"
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
DEGREE = "radiance:sphericalHarmonicsDegree"
CLASS_LABELS = "semantics:labels:class"
INSTANCE_LABELS = "semantics:labels:instance"
USER_LABEL = "userProperties:label"
MARK = "cif"
"""Key in `customLayerData` of layers that cif wrote."""
ROOT = "/World"
"""The prim that places such a scene in the world of its capture."""
LEFT_OUT = ("cif:label", "cif:category", "cif:motion:report")
"""Properties of our schema that are found elsewhere, or are too long to show."""
MAX_SHEAR = 1e-4

Span = tuple[float, float]
"""Time codes of a window: its first, and that of the next one."""


class StageError(ValueError):
    """A stage that cannot be shown; the message names the file or prim and what is wrong."""


def open_stage(path: str | Path) -> Usd.Stage:
    """Open a stage with all payloads; raises `StageError` where USD cannot."""
    path = Path(path)
    if not path.is_file():
        raise StageError(f"{path}: no such file")
    try:
        stage = Usd.Stage.Open(str(path.resolve()))
    except Exception as error:  # USD raises its own error class, which differs between builds
        raise StageError(f"{path}: USD cannot read it: {error}") from error
    return stage


def home(stage: Usd.Stage) -> Usd.Prim | None:
    """The prim whose frame is worked in; `None` is the world.

    A scene that cif placed far from the origin is kept in the frame of its root: Blender's single precision
    would not hold it where it stands.
    """
    for layer in stage.GetLayerStack(False):
        mark = layer.customLayerData.get(MARK)
        if mark is not None:
            root = stage.GetPrimAtPath(ROOT) if "captureOffset" in mark else None
            return root if root else None
    return None


def read_scene(path: str | Path, harmonics: bool = True, arrays: bool = True) -> Scene:
    """Read a stage; without `harmonics` only degree 0, without `arrays` no splats but poses and labels.

    Raises `StageError` for all that cannot be shown, whatever USD or numpy say of it.
    """
    try:
        return _scene(path, harmonics, arrays)
    except StageError:
        raise
    except (TypeError, ValueError, RuntimeError) as error:  # values of other types, text that is no Unicode
        raise StageError(f"{path}: it is damaged ({error}); export it again") from error


def _scene(path: str | Path, harmonics: bool, arrays: bool) -> Scene:
    stage = open_stage(path)
    warnings: list[str] = []
    splats = [prim for prim in stage.Traverse() if prim.GetTypeName() == SPLAT_TYPE and _is_drawn(prim)]
    if not splats:
        raise StageError(f"{path}: holds no {SPLAT_TYPE} prims; was it written by `cif export`?")
    owned: dict[Sdf.Path, list[Usd.Prim]] = {}
    for prim in splats:
        owned.setdefault(_owner(prim).GetPath(), []).append(prim)
    root = home(stage)
    instances = [
        _instance(stage.GetPrimAtPath(owner), prims, root, harmonics, arrays, warnings)
        for owner, prims in owned.items()
    ]
    cameras = [_camera(prim, root) for prim in stage.Traverse() if prim.GetTypeName() == "Camera"]
    return Scene(
        path=str(path),
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        meters_per_unit=float(UsdGeom.GetStageMetersPerUnit(stage)),
        frames_per_second=float(stage.GetTimeCodesPerSecond()),
        start=float(stage.GetStartTimeCode()),
        end=float(stage.GetEndTimeCode()),
        background_color=_background(stage),
        instances=instances,
        cameras=cameras,
        warnings=warnings,
    )


def _value(prim: Usd.Prim, name: str, time: Usd.TimeCode | None = None) -> object:
    """Value of an attribute at the default time, or at its first sample where it has nothing else."""
    attribute = prim.GetAttribute(name)
    if not attribute:
        return None
    value = attribute.Get() if time is None else attribute.Get(time)
    if value is None and attribute.GetNumTimeSamples():
        value = attribute.Get(attribute.GetTimeSamples()[0])
    return value


def _is_drawn(prim: Usd.Prim) -> bool:
    """False for stand-ins and guides: the purpose of a prim is its own, else that of the nearest above it."""
    while prim and not prim.IsPseudoRoot():
        purpose = prim.GetAttribute("purpose")
        if purpose and purpose.HasAuthoredValue():
            return str(purpose.Get()) not in ("proxy", "guide")
        prim = prim.GetParent()
    return True


def _labels(prim: Usd.Prim, name: str) -> list[str]:
    return [str(label) for label in (_value(prim, name) or [])]


def _owner(splats: Usd.Prim) -> Usd.Prim:
    """The prim that an artist would call the object."""
    ancestors = []
    prim = splats
    while prim and not prim.IsPseudoRoot():
        ancestors.append(prim)
        prim = prim.GetParent()
    for name in (INSTANCE_LABELS, CLASS_LABELS, USER_LABEL):
        for prim in ancestors:
            if _value(prim, name):
                return prim
    root = splats.GetStage().GetDefaultPrim()
    if len(ancestors) > 1 and ancestors[1] != root and UsdGeom.Xformable(ancestors[1]):
        return ancestors[1]
    return splats


def _instance(
    prim: Usd.Prim,
    splats: list[Usd.Prim],
    root: Usd.Prim | None,
    harmonics: bool,
    arrays: bool,
    warnings: list[str],
) -> Instance:
    classes = _labels(prim, CLASS_LABELS)
    ancestor = prim
    while not classes and (ancestor := ancestor.GetParent()) and not ancestor.IsPseudoRoot():
        classes = _labels(ancestor, CLASS_LABELS)
    user_label = _value(prim, USER_LABEL)
    display_name = str(user_label or prim.GetDisplayName() or (classes[-1] if classes else prim.GetName()))
    instance = _labels(prim, INSTANCE_LABELS)
    visibility = _visibility(splats[0] if len(splats) == 1 else prim)
    pieces = [
        Piece(
            path=str(piece.GetPath()),
            name=_frame(prim, piece).GetName() if span is None else f"window_{number + 1}",
            frame=str(_frame(prim, piece).GetPath()),
            splats=_splats(piece, harmonics, span) if arrays else EMPTY,
            track=_track(piece, prim, warnings),
            visibility=shown,
        )
        for piece in splats
        for number, span in enumerate(_windows(piece))
        if (shown := None if span is None else _during(visibility, span)) is None or shown.visible.any()
    ]
    return Instance(
        path=str(prim.GetPath()),
        name=prim.GetName(),
        label=classes[0] if classes else display_name,
        display_name=display_name,
        instance=instance[0] if instance else prim.GetName(),
        track=_track(prim, root, warnings),
        pieces=pieces,
        visibility=visibility,
        data=_data(prim),
    )


def _windows(prim: Usd.Prim) -> list[Span | None]:
    """Windows of time in which a prim has splats of its own; one `None` where it has the same at all times."""
    marks = [layer.customLayerData.get(MARK) or {} for layer in prim.GetStage().GetLayerStack()]
    if not any(mark.get("windows") for mark in marks):
        return [None]
    ancestor = prim
    while ancestor and not ancestor.IsPseudoRoot():
        active = Usd.ClipsAPI(ancestor).GetClipActive() or []
        if len(active) > 1:
            starts = [float(start) for start, _ in active]
            return list(itertools.pairwise([*starts, np.inf]))
        ancestor = ancestor.GetParent()
    return [None]


def _during(visibility: Visibility, span: Span) -> Visibility:
    """Visibility inside a window of time, and none outside."""
    first, end = span
    inside = (visibility.codes > first) & (visibility.codes < end)
    at_first = visibility.visible[max(np.searchsorted(visibility.codes, first, side="right") - 1, 0)]
    # Before it begins; a code that no frame has.
    codes = [first - 1.0, first, *visibility.codes[inside]]
    visible = [False, at_first, *visibility.visible[inside]]
    if np.isfinite(end):
        codes, visible = [*codes, end], [*visible, False]
    return Visibility(np.array(codes, np.float64), np.array(visible, bool))


def _frame(owner: Usd.Prim, piece: Usd.Prim) -> Usd.Prim:
    """The prim that moves a splat prim within its instance: the part it lies in, or itself."""
    parent = piece.GetParent()
    return parent if piece != owner and parent != owner else piece


def _data(prim: Usd.Prim) -> dict[str, float | int | str]:
    """What `CifInstanceAPI` says of an instance, as `motion_model` for `cif:motion:model`."""
    found: dict[str, float | int | str] = {}
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        if not name.startswith("cif:") or name in LEFT_OUT:
            continue
        key = name.removeprefix("cif:").replace(":", "_")
        value = attribute.Get()
        if isinstance(value, int | float | str):
            found[key] = value
        elif value is not None and len(value) == 2:  # a range
            found[f"{key}_first"], found[f"{key}_last"] = (int(item) for item in value)
    return found


def _sample_codes(prim: Usd.Prim, stop: Usd.Prim | None) -> np.ndarray:
    """Time codes at which the transform of a prim changes, up to and without `stop`."""
    codes: set[float] = set()
    while prim and prim != stop and not prim.IsPseudoRoot():
        if xformable := UsdGeom.Xformable(prim):
            codes.update(xformable.GetTimeSamples())
            if xformable.GetResetXformStack():
                break
        prim = prim.GetParent()
    return np.array(sorted(codes), dtype=np.float64)


def _track(prim: Usd.Prim, relative_to: Usd.Prim | None, warnings: list[str]) -> tracks.Track:
    """Poses of a prim in the world, or in the frame of an ancestor."""
    if prim == relative_to:
        return tracks.STILL
    codes = _sample_codes(prim, relative_to)
    times = [Usd.TimeCode(code) for code in codes] or [Usd.TimeCode.Default()]
    matrices = []
    cache = UsdGeom.XformCache()
    for time in times:
        cache.SetTime(time)
        matrix = np.array(cache.GetLocalToWorldTransform(prim)).T
        if relative_to:
            ancestor = np.array(cache.GetLocalToWorldTransform(relative_to)).T
            if abs(np.linalg.det(ancestor)) < 1e-300:
                raise StageError(
                    f"{relative_to.GetPath()}: its transform flattens space; give it a scale above 0"
                )
            matrix = np.linalg.solve(ancestor, matrix)
        matrices.append(matrix)
    stacked = np.stack(matrices)
    if not np.isfinite(stacked).all():
        raise StageError(f"{prim.GetPath()}: its transform holds values that are not finite")
    if tracks.shear(stacked) > MAX_SHEAR:
        warnings.append(f"{prim.GetPath()}: its transform shears, which is left out")
    return tracks.from_matrices(codes if len(codes) else np.zeros(1), stacked)


def _visibility(prim: Usd.Prim) -> Visibility:
    """When a prim and all its ancestors can be seen."""
    codes: set[float] = set()
    ancestor = prim
    while ancestor and not ancestor.IsPseudoRoot():
        if imageable := UsdGeom.Imageable(ancestor):
            codes.update(imageable.GetVisibilityAttr().GetTimeSamples())
        ancestor = ancestor.GetParent()
    times = [Usd.TimeCode(code) for code in sorted(codes)] or [Usd.TimeCode.Default()]
    imageable = UsdGeom.Imageable(prim)
    visible = np.array([imageable.ComputeVisibility(time) != "invisible" for time in times])
    changes = np.flatnonzero(np.r_[True, visible[1:] != visible[:-1]])
    return Visibility(np.array(sorted(codes) or [0.0], dtype=np.float64)[changes], visible[changes])


def _attribute(prim: Usd.Prim, name: str) -> Usd.Attribute | None:
    """The attribute in single precision, or in half precision where only that is there."""
    for candidate in (name, f"{name}h"):
        attribute = prim.GetAttribute(candidate)
        if attribute and attribute.HasAuthoredValue():
            return attribute
    return None


def _array(prim: Usd.Prim, attribute: Usd.Attribute, columns: int, code: float | None = None) -> np.ndarray:
    """Values [N, columns] (or [N]) as float32; quaternions come as (x, y, z, w)."""
    value = attribute.Get() if code is None else attribute.Get(code)
    if value is None and (codes := attribute.GetTimeSamples()):
        value = attribute.Get(codes[0])
    array = np.asarray(value if value is not None else [], dtype=np.float32)
    if not np.isfinite(array).all():
        raise StageError(f"{prim.GetPath()}: {attribute.GetName()} holds values that are not finite")
    return array.reshape(-1, columns) if columns > 1 else array.reshape(-1)


def _quaternions(prim: Usd.Prim, attribute: Usd.Attribute, code: float | None = None) -> np.ndarray:
    xyzw = _array(prim, attribute, 4, code)
    norms = np.linalg.norm(xyzw, axis=1, keepdims=True)
    if (norms < 1e-12).any():
        raise StageError(f"{prim.GetPath()}: {attribute.GetName()} holds quaternions of length 0")
    return (xyzw / norms)[:, [3, 0, 1, 2]]


def _splats(prim: Usd.Prim, harmonics: bool, span: Span | None) -> Splats:
    at = None if span is None else span[0]

    def needed(name: str) -> Usd.Attribute:
        attribute = _attribute(prim, name)
        if attribute is None:
            raise StageError(f"{prim.GetPath()}: {name} has no value")
        return attribute

    def sized(values: np.ndarray, name: str) -> np.ndarray:
        if len(values) != count:
            raise StageError(f"{prim.GetPath()}: {name} has {len(values)} values for {count} positions")
        return values

    position, rotation, scale = (needed(name) for name in ("positions", "orientations", "scales"))
    positions = _array(prim, position, 3, at)
    count = len(positions)
    occupancy = UsdGeom.PrimvarsAPI(prim).GetPrimvar("cif:occupancy")
    time = Usd.TimeCode.Default() if at is None else Usd.TimeCode(at)
    occupancies = (
        np.asarray(occupancy.ComputeFlattened(time), np.float32) if occupancy.HasAuthoredValue() else None
    )
    codes = sorted({code for attribute in (position, rotation, scale) for code in _codes(attribute, span)})
    samples = None
    if len(codes) > 1:
        samples = SplatSamples(
            codes=np.array(codes, dtype=np.float64),
            positions=[sized(_array(prim, position, 3, code), "positions") for code in codes],
            rotations=_hemispheres(
                [sized(_quaternions(prim, rotation, code), "orientations") for code in codes]
            ),
            scales=[sized(_array(prim, scale, 3, code), "scales") for code in codes]
            if len(_codes(scale, span)) > 1
            else None,
        )
    return Splats(
        positions=positions,
        rotations=sized(_quaternions(prim, rotation, at), "orientations"),
        scales=sized(_array(prim, scale, 3, at), "scales"),
        opacities=sized(_array(prim, needed("opacities"), 1, at), "opacities"),
        harmonics=_harmonics(prim, count, harmonics, at),
        occupancies=None if occupancies is None else sized(occupancies, "primvars:cif:occupancy"),
        samples=samples,
        fade=_fade(prim, needed("opacities"), count, span),
    )


def _codes(attribute: Usd.Attribute, span: Span | None) -> list[float]:
    """Time codes of the samples of an attribute, of one window where there are several."""
    codes = attribute.GetTimeSamples()
    return codes if span is None else [code for code in codes if span[0] <= code < span[1]]


def _fade(prim: Usd.Prim, attribute: Usd.Attribute, count: int, span: Span | None) -> Fade | None:
    """Opacities over time, where they change."""
    codes = _codes(attribute, span)
    if len(codes) < 2:
        return None
    opacities = [_array(prim, attribute, 1, code) for code in codes]
    for code, values in zip(codes, opacities, strict=True):
        if len(values) != count:
            raise StageError(
                f"{prim.GetPath()}: {len(values)} opacities for {count} positions at time code {code:g}"
            )
    return Fade(np.array(codes, dtype=np.float64), opacities)


def _hemispheres(rotations: list[np.ndarray]) -> list[np.ndarray]:
    """Signs such that each quaternion is close to the one of the sample before."""
    for before, after in itertools.pairwise(rotations):
        after *= np.where(np.einsum("ij,ij->i", before, after) < 0, -1.0, 1.0).astype(np.float32)[:, None]
    return rotations


def _harmonics(prim: Usd.Prim, count: int, all_bands: bool, at: float | None) -> np.ndarray:
    """Coefficients [N, K, 3]; one band from `displayColor`, else grey, where there are none."""
    from .color import BAND_0

    attribute = _attribute(prim, COEFFICIENTS)
    if attribute is None:
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor")
        time = Usd.TimeCode.Default() if at is None else Usd.TimeCode(at)
        colors = np.asarray(primvar.ComputeFlattened(time) if primvar.HasAuthoredValue() else [], np.float32)
        colors = colors.reshape(-1, 3)
        if len(colors) != count:
            colors = np.broadcast_to(colors[:1] if len(colors) else np.float32(0.5), (count, 3))
        return ((colors - 0.5) / BAND_0).astype(np.float32)[:, None, :]
    degree = _value(prim, DEGREE)
    if degree is None:
        degree = 3  # fallback of the schema
    if degree not in (0, 1, 2, 3):
        raise StageError(f"{prim.GetPath()}: {DEGREE} is {degree}; 0 to 3 can be shown")
    bands = (degree + 1) ** 2
    flat = _array(prim, attribute, 3, at)
    if len(flat) != count * bands:
        raise StageError(
            f"{prim.GetPath()}: {COEFFICIENTS} has {len(flat)} values; degree {degree} with {count} splats "
            f"needs {count * bands}"
        )
    coefficients = flat.reshape(count, bands, 3)
    return coefficients if all_bands else coefficients[:, :1]


EMPTY = Splats(
    positions=np.zeros((0, 3), np.float32),
    rotations=np.zeros((0, 4), np.float32),
    scales=np.zeros((0, 3), np.float32),
    opacities=np.zeros(0, np.float32),
    harmonics=np.zeros((0, 1, 3), np.float32),
    occupancies=None,
    samples=None,
    fade=None,
)
"""Stands for arrays that were not asked for."""


def _camera(prim: Usd.Prim, root: Usd.Prim | None) -> Camera:
    camera = UsdGeom.Camera(prim)
    names = ("focalLength", "horizontalAperture", "horizontalApertureOffset", "verticalApertureOffset")
    codes = sorted({code for name in names for code in prim.GetAttribute(name).GetTimeSamples()})
    views = [camera.GetCamera(code) for code in codes] or [camera.GetCamera(Usd.TimeCode.Default())]
    width = [view.horizontalAperture for view in views]
    if min(width) <= 0 or min(view.focalLength for view in views) <= 0:
        raise StageError(f"{prim.GetPath()}: focalLength and horizontalAperture must be above 0")
    shift = [
        (view.horizontalApertureOffset / w, view.verticalApertureOffset / w)
        for view, w in zip(views, width, strict=True)
    ]
    size = tuple(_value(prim, f"userProperties:image{side}") for side in ("Width", "Height"))
    clipping = _value(prim, "clippingRange")
    return Camera(
        path=str(prim.GetPath()),
        name=prim.GetName(),
        display_name=prim.GetDisplayName() or prim.GetName(),
        track=_track(prim, root, []),
        lens_codes=np.array(codes or [0.0]),
        focal=np.array([view.focalLength / w for view, w in zip(views, width, strict=True)]),
        shift=np.array(shift),
        aspect=float(views[0].verticalAperture / width[0]),
        size=(int(size[0]), int(size[1])) if all(size) else None,
        clipping=(float(clipping[0]), float(clipping[1])),
    )


def _background(stage: Usd.Stage) -> tuple[float, float, float]:
    """Colour behind everything from the strongest layer that says one; black otherwise."""
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        ours = layer.customLayerData.get("cif")
        if isinstance(ours, dict) and (color := ours.get("backgroundColor")) is not None:
            return (float(color[0]), float(color[1]), float(color[2]))
    return (0.0, 0.0, 0.0)
