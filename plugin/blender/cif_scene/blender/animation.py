"""Keyframes from tracks. Frames are time codes; between keys everything is linear or held."""

from __future__ import annotations

import bpy
import numpy as np

CONSTANT, LINEAR = 0, 1
"""Values of `Keyframe.interpolation` as `foreach_set` wants them."""


def curve(
    owner: bpy.types.ID, data_path: str, index: int, codes: np.ndarray, values: np.ndarray, mode: int = LINEAR
) -> None:
    """Add one F-curve with keys at `codes` to the owner's action, which is made where there is none."""
    channels = _channels(owner)
    curve = channels.fcurves.new(data_path, index=index)
    curve.keyframe_points.add(len(codes))
    pairs = np.stack([np.asarray(codes, np.float32), np.asarray(values, np.float32)], -1)
    curve.keyframe_points.foreach_set("co", pairs.ravel())
    curve.keyframe_points.foreach_set("interpolation", np.full(len(codes), mode, np.uint8))
    curve.update()


def curves(owner: bpy.types.ID, data_path: str, codes: np.ndarray, values: np.ndarray) -> None:
    """One linear F-curve per column of `values` [T, C]."""
    for index in range(values.shape[1]):
        curve(owner, data_path, index, codes, values[:, index])


def _channels(owner: bpy.types.ID) -> bpy.types.ActionChannelbag:
    """Channels of the owner's action, in the layered form of Blender 4.4 and newer."""
    animation = owner.animation_data or owner.animation_data_create()
    if animation.action is None:
        action = bpy.data.actions.new(owner.name)
        slot = action.slots.new(id_type=owner.id_type, name=owner.name)
        action.layers.new("Motion").strips.new(type="KEYFRAME")
        animation.action = action
        animation.action_slot = slot
    strip = animation.action.layers[0].strips[0]
    return strip.channelbag(animation.action_slot, ensure=True)


def fcurves(owner: bpy.types.ID) -> list[bpy.types.FCurve]:
    """All F-curves of an object, empty where it is not animated."""
    animation = owner.animation_data
    if animation is None or animation.action is None or animation.action_slot is None:
        return []
    found = []
    for layer in animation.action.layers:
        for strip in layer.strips:
            channels = strip.channelbag(animation.action_slot)
            found.extend(channels.fcurves if channels else [])
    return found
