"""What changed since the import: the objects of the scene against the stage that they came from."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ..io.color import BAND_0, display_from_linear, linear_from_display
from ..io.scene import Instance, Scene, Visibility
from ..io.tracks import Track, from_matrices
from . import animation, splats
from .importer import IMPORTED, PART, PRIM, PRIMS, STAGE

MOVED = 1e-5
"""Smallest change of place that counts, share of the distance from the origin plus one unit."""
TURNED = 1e-4
"""Smallest change of an axis that counts; Blender keeps single precision."""
RECOLOURED = 1e-4
"""Smallest change of a linear colour or a tint that counts."""


class EditError(RuntimeError):
    """The scene does not fit the stage; the message says why."""


def export_edits(stage_path: str | Path, out_path: str | Path, force: bool = False) -> Path:
    """Write what changed in the current scene as a layer over the stage; the written file."""
    bpy.utils.expose_bundled_modules()
    from ..io.edits import write_edits

    return write_edits(stage_path, out_path, collect_edits(stage_path), force)


def collect_edits(stage_path: str | Path) -> list:
    """Differences between the current scene and a stage as `io.edits.Edit`, in the order of the stage."""
    bpy.utils.expose_bundled_modules()
    from ..io.edits import Edit
    from ..io.read import read_scene

    scene = read_scene(stage_path, arrays=False)
    root = _root(stage_path)
    known = set(json.loads(root[PRIMS]))
    objects = _objects(root, known)
    codes = _codes(scene)
    poses = _sample([root, *(obj for group in objects.values() for obj in _with_parts(group))], codes)
    edits = []
    for instance in scene.instances:
        if instance.path not in known:
            continue
        group = objects.get(instance.path, [])
        kept = _original(group)
        if kept is None:
            edits.append(Edit(instance.path, deleted=True))
        for obj in group:
            edit = _edit(instance, obj, root, codes, poses, copied=obj != kept)
            if edit is not None:
                edits.append(edit)
    recolored = {
        instance.path: [obj for obj in objects.get(instance.path, []) if _is_recolored(obj)]
        for instance in scene.instances
    }
    if any(recolored.values()):
        return _with_colors(edits, stage_path, recolored, objects)
    return edits


def _root(stage_path: str | Path) -> bpy.types.Object:
    """The empty that the stage was imported under."""
    roots = [obj for obj in bpy.context.scene.objects if STAGE in obj]
    wanted = str(Path(stage_path).resolve())
    exact = [obj for obj in roots if obj[STAGE] == wanted]
    if not roots:
        raise EditError("no CIF scene here: its root, an empty with the name of the stage, is gone")
    if len(exact) == 1:
        return exact[0]
    if len(roots) == 1:  # the stage was moved
        return roots[0]
    raise EditError(
        f"{wanted}: imported {len(exact)} times here; keep one import per scene to export its edits"
    )


def _objects(root: bpy.types.Object, known: set[str]) -> dict[str, list[bpy.types.Object]]:
    """Objects by the prim that they show, copies included, in the order of their names."""
    found: dict[str, list[bpy.types.Object]] = {}
    for obj in sorted(bpy.context.scene.objects, key=lambda obj: obj.name):
        above = obj
        while above.parent is not None:
            above = above.parent
        # What hangs under another import belongs to that one.
        if obj.get(PRIM) in known and (above == root or STAGE not in above):
            found.setdefault(obj[PRIM], []).append(obj)
    return found


def _with_parts(group: list[bpy.types.Object]) -> Iterator[bpy.types.Object]:
    for obj in group:
        yield obj
        yield from (child for child in obj.children if PART in child)


def _original(group: list[bpy.types.Object]) -> bpy.types.Object | None:
    """The object that was imported; the others are copies of it."""
    same = [obj for obj in group if obj.name == obj.get(IMPORTED)]
    return (same or group or [None])[0]


def _codes(scene: Scene) -> np.ndarray:
    """Whole frames of the range and every recorded sample."""
    recorded = [instance.track.codes for instance in scene.instances if len(instance.track.codes) > 1]
    frames = np.arange(np.floor(scene.start), np.ceil(scene.end) + 1)
    return np.unique(np.concatenate([frames, *recorded]))


def _sample(objects: list[bpy.types.Object], codes: np.ndarray) -> dict[bpy.types.Object, np.ndarray]:
    """World matrices [T, 4, 4] of objects at time codes, constraints and parents included."""
    poses = {obj: np.empty((len(codes), 4, 4)) for obj in objects}
    scene = bpy.context.scene
    before = scene.frame_current, scene.frame_subframe
    with _all_evaluated(objects):
        for place, code in enumerate(codes):
            whole = int(np.floor(code))
            scene.frame_set(whole, subframe=float(code - whole))
            depsgraph = bpy.context.evaluated_depsgraph_get()
            for obj, matrices in poses.items():
                matrices[place] = np.array(obj.evaluated_get(depsgraph).matrix_world)
    scene.frame_set(before[0], subframe=before[1])
    return poses


@contextlib.contextmanager
def _all_evaluated(objects: list[bpy.types.Object]) -> Iterator[None]:
    """Blender does not move what is hidden; and it need not build splats to tell where they are."""
    with contextlib.ExitStack() as restore:

        def set_for_now(owner: object, name: str, value: bool) -> None:
            restore.callback(setattr, owner, name, getattr(owner, name))
            setattr(owner, name, value)

        for obj in objects:
            for curve in animation.fcurves(obj):
                if curve.data_path == "hide_viewport" and not curve.mute:
                    set_for_now(curve, "mute", True)
            for modifier in obj.modifiers:
                set_for_now(modifier, "show_viewport", False)
            eye = obj.name in bpy.context.view_layer.objects and obj.hide_get()
            set_for_now(obj, "hide_viewport", False)
            if eye:
                restore.callback(obj.hide_set, True)
                obj.hide_set(False)
        yield


def _is_recolored(obj: bpy.types.Object) -> bool:
    """Whether colours of an object or its parts were tinted or painted over."""
    meshes = [each for each in (obj, *obj.children) if each.type == "MESH" and splats.COLORS in each.data]
    return any(
        np.abs(splats.tint(each) - 1.0).max() > RECOLOURED
        or splats.checksum(each.data) != each.data[splats.COLORS]
        for each in meshes
    )


def _with_colors(
    edits: list,
    stage_path: str | Path,
    recolored: dict[str, list[bpy.types.Object]],
    objects: dict[str, list[bpy.types.Object]],
) -> list:
    """The edits, with the colours of what was recoloured."""
    from ..io.edits import Edit
    from ..io.read import read_scene

    done = []
    left = list(edits)
    for instance in read_scene(stage_path, harmonics=False).instances:
        kept = _original(objects.get(instance.path, []))
        for obj in objects.get(instance.path, []):
            name = None if obj == kept else obj.name
            mine = [edit for edit in left if (edit.path, edit.copy_name) == (instance.path, name)]
            left = [edit for edit in left if edit not in mine]
            edit = mine[0] if mine else Edit(instance.path, copy_name=name)
            if obj in recolored[instance.path]:
                edit = dataclasses.replace(edit, colors=dict(_colors(instance, obj)))
            if mine or edit.colors:
                done.append(edit)
        gone = [edit for edit in left if edit.path == instance.path]
        left = [edit for edit in left if edit not in gone]
        done += gone
    return done + left


def _colors(instance: Instance, obj: bpy.types.Object) -> Iterator[tuple[str, object]]:
    """New display-referred colours by splat prim: which splats, and how they look."""
    from ..io.edits import Colors

    parts = {child[PART]: child for child in obj.children if PART in child}
    for piece in instance.pieces:
        if piece.visibility is not None:
            raise EditError(
                f"{obj.name}: its splats change from window to window, and new colours of them cannot be kept; "
                "undo that, or set the tint back to white"
            )
        each = parts.get(piece.path) if parts else obj
        if each is None or each.type != "MESH" or splats.COLORS not in each.data:
            continue
        before = linear_from_display(0.5 + BAND_0 * piece.splats.harmonics[:, 0])
        now = splats.colors(each.data)
        if now is None or len(now) != len(before):
            raise EditError(
                f"{each.name}: its vertices or its attribute 'colour' are not those that were imported, "
                "so that its colours cannot be told; undo that, or set the tint back to white"
            )
        now = now * splats.tint(each)
        changed = np.flatnonzero(np.abs(now - before).max(1) > RECOLOURED)
        if len(changed):
            yield piece.path, Colors(changed, display_from_linear(now[changed]).astype(np.float32))


def _edit(
    instance: Instance,
    obj: bpy.types.Object,
    root: bpy.types.Object,
    codes: np.ndarray,
    poses: dict[bpy.types.Object, np.ndarray],
    copied: bool,
):
    """What changed of one object; `None` for nothing."""
    from ..io.edits import Edit

    world = np.linalg.solve(poses[root], poses[obj])
    evaluated = obj.name in bpy.context.view_layer.objects
    name = str(obj.get("display_name", instance.display_name))
    if name == instance.display_name and not copied and obj.name != obj.get(IMPORTED):
        name = obj.name
    label = str(obj.get("label", instance.label))
    edit = Edit(
        path=instance.path,
        copy_name=obj.name if copied else None,
        track=_changed(instance.track, codes, world) if evaluated else None,
        label=label if label != instance.label else None,
        display_name=name if name != instance.display_name else None,
        visibility=_visibility(instance, obj, codes),
        parts=list(_part_edits(instance, obj, codes, poses)),
    )
    nothing = Edit(instance.path)
    return None if edit == nothing else edit


def _part_edits(
    instance: Instance, obj: bpy.types.Object, codes: np.ndarray, poses: dict[bpy.types.Object, np.ndarray]
) -> Iterator:
    """Edits of the rigid parts of one object."""
    from ..io.edits import Edit

    present = {child[PART]: child for child in obj.children if PART in child}
    if obj.type != "EMPTY":
        return
    for piece in instance.pieces:
        # Windows move with their object.
        if piece.visibility is not None:
            continue
        child = present.get(piece.path)
        if child is None:
            yield Edit(piece.frame, deleted=True)
        elif (track := _changed(piece.track, codes, np.linalg.solve(poses[obj], poses[child]))) is not None:
            yield Edit(piece.frame, track=track)


def _changed(recorded: Track, codes: np.ndarray, matrices: np.ndarray) -> Track | None:
    """The poses as a track where they are not the recorded ones."""
    expected = recorded.matrices(codes)
    reach = MOVED * (1.0 + np.abs(expected[:, :3, 3]).max())
    moved = np.abs(matrices[:, :3, 3] - expected[:, :3, 3]).max() > reach
    turned = np.abs(matrices[:, :3, :3] - expected[:, :3, :3]).max() > TURNED
    return from_matrices(codes, matrices) if moved or turned else None


def _visibility(instance: Instance, obj: bpy.types.Object, codes: np.ndarray) -> Visibility | None:
    """When the object shows, where that is not as in the stage: hidden by eye, or in renders."""
    shown = obj.name in bpy.context.view_layer.objects and not obj.hide_get()
    curves = [curve for curve in animation.fcurves(obj) if curve.data_path == "hide_render" and not curve.mute]
    visible = (
        np.array([not (curves[0].evaluate(code) if curves else obj.hide_render) for code in codes]) & shown
    )
    recorded = instance.visibility
    after = np.maximum(np.searchsorted(recorded.codes, codes, side="right") - 1, 0)
    if (visible == recorded.visible[after]).all():
        return None
    changes = np.flatnonzero(np.r_[True, visible[1:] != visible[:-1]])
    return Visibility(codes[changes], visible[changes])
