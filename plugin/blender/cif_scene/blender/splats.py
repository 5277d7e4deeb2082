"""The object of one splat prim: vertices with attributes and the modifier that draws them."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import bpy
import numpy as np

from ..io.color import BAND_0, linear_from_display
from ..io.scene import Splats
from . import animation, nodes

MODIFIER = "Splats"
COLORS = "cif_colours"
"""Custom property of a mesh: checksum of its colours as imported, to tell whether they were painted over."""


def splat_mesh(name: str, splats: Splats, harmonics: bool) -> bpy.types.Mesh:
    """A mesh without faces: centres as vertices, everything else as attributes."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(splats.count)
    mesh.attributes["position"].data.foreach_set("vector", _flat(splats.positions))
    store(mesh, "rot", "QUATERNION", splats.rotations)
    store(mesh, "scale", "FLOAT_VECTOR", splats.scales)
    store(mesh, "opacity", "FLOAT", splats.opacities)
    display = np.clip(0.5 + BAND_0 * splats.harmonics[:, 0], 0.0, None)
    store(mesh, "colour", "FLOAT_COLOR", np.c_[linear_from_display(display), np.ones(splats.count)])
    mesh[COLORS] = checksum(mesh)
    if splats.occupancies is not None:
        store(mesh, "occupancy", "FLOAT", splats.occupancies)
    if harmonics:
        for number in range(splats.harmonics.shape[1]):
            store(mesh, f"sh_{number}", "FLOAT_VECTOR", splats.harmonics[:, number])
    if (samples := splats.samples) is not None:
        for number in range(len(samples.codes)):
            store(mesh, f"position_{number}", "FLOAT_VECTOR", samples.positions[number])
            store(mesh, f"rot_{number}", "QUATERNION", samples.rotations[number])
            if samples.scales is not None:
                store(mesh, f"scale_{number}", "FLOAT_VECTOR", samples.scales[number])
    if splats.fade is not None:
        for number, opacities in enumerate(splats.fade.opacities):
            store(mesh, f"opacity_{number}", "FLOAT", opacities)
    mesh.color_attributes.active_color_name = "colour"
    mesh.update()
    return mesh


def add_modifier(
    obj: bpy.types.Object, splats: Splats, look: Mapping[str, float | bool | tuple[float, ...]]
) -> None:
    """Draw the vertices as Gaussians with inputs of the nodes, and play samples of what deforms or fades."""
    modifier = obj.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = nodes.splat_nodes()
    for name, value in look.items():
        nodes.set_input(modifier, name, value)
    for name, samples in ((nodes.SAMPLE, splats.samples), (nodes.FADE, splats.fade)):
        if samples is None:
            continue
        path = nodes.set_input(modifier, name, 0.0)
        numbers = np.arange(len(samples.codes), dtype=np.float64)
        steps = np.diff(samples.codes)
        if np.allclose(steps, steps[0]):
            numbers = numbers[[0, -1]]
        animation.curve(obj, path, 0, samples.codes[numbers.astype(int)], numbers)


def colors(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Linear colours of the vertices, [N, 3] float32; `None` where the attribute is gone or is another."""
    attribute = mesh.attributes.get("colour")
    if attribute is None or attribute.data_type != "FLOAT_COLOR" or attribute.domain != "POINT":
        return None
    flat = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color", flat)
    return flat.reshape(-1, 4)[:, :3]


def checksum(mesh: bpy.types.Mesh) -> str:
    """Checksum of the colours."""
    values = colors(mesh)
    return "" if values is None else f"{zlib.crc32(np.ascontiguousarray(values).tobytes()):08x}"


def tint(obj: bpy.types.Object) -> np.ndarray:
    """Linear colour that the colours of an object are multiplied with, [3]."""
    modifier = obj.modifiers.get(MODIFIER)
    if modifier is None or modifier.node_group is None or modifier.node_group.name != nodes.NAME:
        return np.ones(3)
    owner, path = nodes.input_of(modifier, nodes.TINT)
    return np.array(owner.path_resolve(path)[:3], np.float64)


def store(mesh: bpy.types.Mesh, name: str, kind: str, values: np.ndarray) -> None:
    """Add an attribute of the vertices."""
    attribute = mesh.attributes.new(name, kind, "POINT")
    key = {"FLOAT": "value", "FLOAT_COLOR": "color", "QUATERNION": "value"}.get(kind, "vector")
    attribute.data.foreach_set(key, _flat(values))


def _flat(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float32).ravel()
