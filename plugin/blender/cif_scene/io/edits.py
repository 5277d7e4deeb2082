"""A layer over a stage that says what changed: what an artist did, without touching the stage itself.

The layer has the stage as its sublayer, so that opening the layer shows the edited scene, and
`cif import LAYER --base scene.cif` brings the edits home. Values are written next to samples, because
simulators and validators read the default time.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from .color import BAND_0
from .read import CLASS_LABELS, COEFFICIENTS, INSTANCE_LABELS, USER_LABEL, StageError, home, open_stage
from .scene import Visibility
from .tracks import Track, from_matrices, thinned

DISPLAY_COLOR = "primvars:displayColor"
MARK = "cifEdits"
"""Key in `customLayerData` that marks a layer as one of edits, which may be replaced by newer ones."""
TRANSFORM_OPS = ("xformOp:translate", "xformOp:orient", "xformOp:scale")


@dataclass(frozen=True)
class Colors:
    """New colours of some splats of a prim."""

    splats: np.ndarray
    """Which ones, [N] int."""
    display: np.ndarray
    """Their display-referred colours, [N, 3] float32."""


@dataclass(frozen=True)
class Edit:
    """What changed of one prim; `None` is unchanged."""

    path: str
    """Prim of the stage."""
    copy_name: str | None = None
    """Wanted name of a copy next to that prim; the edit then describes the copy."""
    deleted: bool = False
    track: Track | None = None
    """New poses as `Instance` has them, or in the frame of the instance for a part."""
    label: str | None = None
    """New first class label."""
    display_name: str | None = None
    """New human name."""
    visibility: Visibility | None = None
    parts: list[Edit] = field(default_factory=list)
    """Edits of prims below; their `path` is that in the stage, also in a copy."""
    colors: dict[str, Colors] = field(default_factory=dict)
    """New colours by splat prim of the stage."""


def write_edits(
    stage_path: str | Path, out_path: str | Path, edits: Sequence[Edit], force: bool = False
) -> Path:
    """Write a layer that applies edits to a stage; its path. Raises `StageError` where that cannot be."""
    out = Path(out_path).resolve()
    base = Path(stage_path).resolve()
    if out.suffix not in (".usda", ".usdc"):
        raise StageError(f"{out}: edits are written as .usda or .usdc")
    if out == base:
        raise StageError(f"{out}: is the stage itself; give the edits another name")
    if not out.parent.is_dir():
        raise StageError(f"{out.parent}: no such folder")
    if out.exists() and not force and not _is_edits(out):
        raise StageError(f"{out}: exists and holds no edits; choose another name or remove it")
    stage = open_stage(base)
    layer = Sdf.Layer.CreateAnonymous(out.suffix)
    _metadata(layer, stage, base, out)
    names = _NewNames(stage)
    with Sdf.ChangeBlock():
        for edit in edits:
            _apply(layer, stage, edit, names)
    handle, scratch = tempfile.mkstemp(prefix=".cif-edits-", suffix=out.suffix, dir=out.parent)
    os.close(handle)
    try:
        if not layer.Export(scratch):
            raise StageError(f"{out}: USD could not write it")
        Path(scratch).replace(out)
    finally:
        Path(scratch).unlink(missing_ok=True)
    if opened := Sdf.Layer.Find(str(out)):
        opened.Reload(force=True)
    return out


def _is_edits(path: Path) -> bool:
    try:
        return MARK in Sdf.Layer.OpenAsAnonymous(str(path), metadataOnly=True).customLayerData
    except Exception:  # what USD cannot read was not written by us
        return False


def _metadata(layer: Sdf.Layer, stage: Usd.Stage, base: Path, out: Path) -> None:
    """What a viewer asks of the root layer: it is not taken from sublayers."""
    try:
        relative = Path(os.path.relpath(base, out.parent)).as_posix()
        layer.subLayerPaths.append(relative if relative.startswith(".") else f"./{relative}")
    except ValueError:  # another drive
        layer.subLayerPaths.append(base.as_posix())
    root = stage.GetRootLayer()
    for key in root.pseudoRoot.ListInfoKeys():
        if key not in ("subLayers", "subLayerOffsets", "customLayerData", "documentation", "comment"):
            layer.pseudoRoot.SetInfo(key, root.pseudoRoot.GetInfo(key))
    layer.customLayerData = {MARK: {"layout": 1}}


class _NewNames:
    """Names of copies: valid, and not taken by a sibling."""

    def __init__(self, stage: Usd.Stage) -> None:
        self.stage = stage
        self.given: set[Sdf.Path] = set()

    def beside(self, path: Sdf.Path, wanted: str) -> Sdf.Path:
        stem = re.sub(r"[^A-Za-z0-9_]", "_", wanted)
        stem = stem if re.match(r"[A-Za-z_]", stem) else f"_{stem}"
        number = 1
        candidate = path.ReplaceName(stem)
        while candidate in self.given or self.stage.GetPrimAtPath(candidate):
            number += 1
            candidate = path.ReplaceName(f"{stem}_{number}")
        self.given.add(candidate)
        return candidate


def _apply(layer: Sdf.Layer, stage: Usd.Stage, edit: Edit, names: _NewNames) -> None:
    source = Sdf.Path(edit.path)
    prim = stage.GetPrimAtPath(source)
    if not prim:
        raise StageError(f"{edit.path}: is not in the stage")
    target = source
    if edit.copy_name is not None:
        target = names.beside(source, edit.copy_name)
    spec = Sdf.CreatePrimInLayer(layer, target)
    if edit.deleted:
        spec.SetInfo("active", False)
        return
    if edit.copy_name is not None:
        spec.specifier = Sdf.SpecifierDef
        spec.typeName = prim.GetTypeName()
        spec.referenceList.prependedItems = [Sdf.Reference(primPath=source)]
        # The prim that is copied may be deleted itself.
        spec.SetInfo("active", True)
        _set(spec, INSTANCE_LABELS, Sdf.ValueTypeNames.TokenArray, [target.name])
    if edit.label is not None or edit.display_name is not None:
        _rename(spec, prim, edit)
    if edit.track is not None:
        _transform(spec, prim, edit.track, relative_to=home(stage))
    if edit.visibility is not None:
        _visibility(spec, edit.visibility)
    for part in edit.parts:
        below = Sdf.Path(part.path)
        part_prim = stage.GetPrimAtPath(below)
        if not part_prim:
            raise StageError(f"{part.path}: is not in the stage")
        part_spec = Sdf.CreatePrimInLayer(layer, below.ReplacePrefix(source, target))
        if part.deleted:
            part_spec.SetInfo("active", False)
        if part.track is not None:
            _transform(part_spec, part_prim, part.track, relative_to=prim)
    for path, colors in edit.colors.items():
        below = Sdf.Path(path)
        splats = stage.GetPrimAtPath(below)
        if not splats:
            raise StageError(f"{path}: is not in the stage")
        _recolor(Sdf.CreatePrimInLayer(layer, below.ReplacePrefix(source, target)), splats, colors)


def _set(
    spec: Sdf.PrimSpec,
    name: str,
    kind: Sdf.ValueTypeName,
    value: object,
    samples: Sequence[tuple[float, object]] = (),
    variability: Sdf.Variability = Sdf.VariabilityVarying,
) -> None:
    """Author an attribute: default value and samples."""
    attribute = Sdf.AttributeSpec(spec, name, kind, variability)
    attribute.default = value
    for code, sample in samples:
        spec.layer.SetTimeSample(attribute.path, code, sample)


def _rename(spec: Sdf.PrimSpec, prim: Usd.Prim, edit: Edit) -> None:
    """Semantics, display name and the user property that importers without semantics keep."""
    attribute = prim.GetAttribute(CLASS_LABELS)
    classes = [str(label) for label in (attribute.Get() if attribute else None) or []]
    before = str(prim.GetAttribute(USER_LABEL).Get() or prim.GetDisplayName() or prim.GetName())
    if edit.display_name is not None:
        spec.SetInfo("displayName", edit.display_name)
        attribute = Sdf.AttributeSpec(spec, USER_LABEL, Sdf.ValueTypeNames.String)
        attribute.custom = True
        attribute.default = edit.display_name
        # The class of an object stays, unless it is nothing but its name.
        classes = [edit.display_name if label == before else label for label in classes]
        if edit.display_name not in classes:
            classes.append(edit.display_name)
    if edit.label is not None:
        classes = [edit.label, *(label for label in classes[1:] if label != edit.label)]
    if "SemanticsLabelsAPI:class" not in prim.GetAppliedSchemas():
        listed = Sdf.TokenListOp()
        listed.prependedItems = ["SemanticsLabelsAPI:class"]
        spec.SetInfo("apiSchemas", listed)
    _set(spec, CLASS_LABELS, Sdf.ValueTypeNames.TokenArray, classes)


def _recolor(spec: Sdf.PrimSpec, splats: Usd.Prim, colors: Colors) -> None:
    """Display colours: cif takes those that differ from what it wrote as the colour of the splats."""
    primvar = UsdGeom.Primvar(splats.GetAttribute(DISPLAY_COLOR))
    flattened = primvar.ComputeFlattened() if primvar else None
    values = np.array([] if flattened is None else flattened, np.float32).reshape(-1, 3)
    count = len(splats.GetAttribute("positions").Get() or [])
    if len(values) != count:  # by others, who need not write it
        first = np.array(splats.GetAttribute(COEFFICIENTS).Get(), np.float32).reshape(count, -1, 3)[:, 0]
        values = np.clip(0.5 + BAND_0 * first, 0.0, None).astype(np.float32)
    values[colors.splats] = colors.display
    _set(spec, DISPLAY_COLOR, Sdf.ValueTypeNames.Color3fArray, Vt.Vec3fArray.FromNumpy(values))
    spec.properties[DISPLAY_COLOR].SetInfo("interpolation", "vertex")
    indices = Sdf.AttributeSpec(spec, f"{DISPLAY_COLOR}:indices", Sdf.ValueTypeNames.IntArray)
    indices.default = Sdf.ValueBlock()


def _transform(spec: Sdf.PrimSpec, prim: Usd.Prim, track: Track, relative_to: Usd.Prim | None = None) -> None:
    """Poses as translate, orient and, where it is not 1, scale, in the frame of the prim's parent."""
    local = thinned(_in_parent(prim, track, relative_to))
    ops = list(TRANSFORM_OPS[:2])
    if not np.allclose(local.scales, 1.0, rtol=0, atol=1e-6):
        ops.append(TRANSFORM_OPS[2])
    values = {
        "xformOp:translate": (
            Sdf.ValueTypeNames.Double3,
            [Gf.Vec3d(*map(float, v)) for v in local.translations],
        ),
        "xformOp:orient": (Sdf.ValueTypeNames.Quatf, [Gf.Quatf(*map(float, q)) for q in local.rotations]),
        "xformOp:scale": (Sdf.ValueTypeNames.Float3, [Gf.Vec3f(*map(float, s)) for s in local.scales]),
    }
    for op in ops:
        kind, poses = values[op]
        # A default value alone hides all samples of weaker layers.
        samples = list(zip(map(float, local.codes), poses, strict=True)) if len(poses) > 1 else []
        _set(spec, op, kind, poses[0], samples)
    _set(spec, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, ops, variability=Sdf.VariabilityUniform)


def _in_parent(prim: Usd.Prim, track: Track, relative_to: Usd.Prim | None) -> Track:
    """The track in the frame of the prim's parent."""
    parent = prim.GetParent()
    if parent == relative_to or parent.IsPseudoRoot():
        return track
    cache = UsdGeom.XformCache()
    matrices = track.matrices(track.codes)
    for place, code in enumerate(track.codes):
        cache.SetTime(Usd.TimeCode(float(code)))
        frame = np.array(cache.GetLocalToWorldTransform(parent)).T
        if relative_to is not None:
            frame = np.linalg.solve(np.array(cache.GetLocalToWorldTransform(relative_to)).T, frame)
        matrices[place] = np.linalg.solve(frame, matrices[place])
    return from_matrices(track.codes, matrices)


def _visibility(spec: Sdf.PrimSpec, visibility: Visibility) -> None:
    words = ["inherited" if visible else "invisible" for visible in visibility.visible]
    samples = list(zip(map(float, visibility.codes), words, strict=True)) if len(words) > 1 else []
    _set(spec, "visibility", Sdf.ValueTypeNames.Token, words[0], samples)
