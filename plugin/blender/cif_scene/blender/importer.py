"""A whole scene as collections, objects, cameras and a world."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ..io.color import linear_from_display
from ..io.scene import Camera, Instance, Piece, Scene, Visibility
from ..io.tracks import Track
from . import animation, nodes
from .splats import add_modifier, splat_mesh

FILM_MM = 36.0
"""Width of the film that cameras are given; only its ratio to the focal length shows."""
NEAR_METERS = 0.2
"""Depth below which training draws nothing."""
STAGE, PRIMS, PRIM, PART, IMPORTED = "cif_stage", "cif_prims", "prim_path", "cif_part", "cif_imported_name"
"""Custom properties that edits are found by: on the root the file of the stage and the prims that were
imported; on an object its prim, the splat prim of a part, and the name that it was given."""


Look = dict[str, float | bool | tuple[float, ...]]
"""Inputs of the nodes by name."""


@dataclass(frozen=True)
class Options:
    """What to import, and how it shall look."""

    harmonics: bool = True
    """Colours that depend on the view, as seen from the scene's camera; otherwise one colour per splat."""
    training_blur: bool = True
    """Widen splats by the blur that training adds on the image, and draw nothing close to the camera."""
    discs: bool = True
    """Render what the camera sees of the Gaussians, as discs that face it; otherwise ellipsoids, as in the
    viewport."""
    display_blending: bool = False
    """Blend display-referred colours, as training does, and show them without a view transform. Closer to the
    renders of cif, but other objects in the scene then look wrong."""
    set_scene: bool = True
    """Set the scene's frames, camera, resolution, world and render settings from the stage."""


@dataclass
class Imported:
    """What an import created."""

    root: bpy.types.Object
    collection: bpy.types.Collection
    objects: list[bpy.types.Object] = field(default_factory=list)
    """Objects of instances and their parts."""
    cameras: list[bpy.types.Object] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    """What could not be kept, one sentence each."""


def import_scene(path: str | Path, **options: bool) -> Imported:
    """Read a stage and create its objects in the current Blender scene; options as `Options` names them."""
    bpy.utils.expose_bundled_modules()
    from ..io.read import read_scene

    chosen = Options(**options)
    return build(read_scene(path, harmonics=chosen.harmonics), chosen)


def build(scene: Scene, options: Options) -> Imported:
    """Create everything in the current Blender scene."""
    name = Path(scene.path).stem
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new(name, None)
    root.empty_display_size = 0.1
    root.scale = (scene.meters_per_unit,) * 3
    root.rotation_mode = "QUATERNION"
    if scene.up_axis == "Y":
        root.rotation_quaternion = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
    root[STAGE] = str(Path(scene.path).resolve())
    root[PRIMS] = json.dumps([instance.path for instance in scene.instances])
    collection.objects.link(root)
    imported = Imported(root, collection, warnings=scene.warnings)
    by_label: dict[str, bpy.types.Collection] = {}
    look = _look(scene, options)
    for instance in scene.instances:
        if instance.label not in by_label:
            by_label[instance.label] = bpy.data.collections.new(instance.label)
            collection.children.link(by_label[instance.label])
        for obj in _instance(instance, root, options, look):
            by_label[instance.label].objects.link(obj)
            imported.objects.append(obj)
    if scene.cameras:
        cameras = bpy.data.collections.new("Cameras")
        collection.children.link(cameras)
        for camera in scene.cameras:
            obj = _camera(camera, root, scene.meters_per_unit)
            cameras.objects.link(obj)
            imported.cameras.append(obj)
    if options.set_scene:
        _set_scene(scene, imported, options)
    return imported


def _instance(
    instance: Instance, root: bpy.types.Object, options: Options, look: Look
) -> list[bpy.types.Object]:
    """The object of an instance, and one per part where it has several."""
    single = len(instance.pieces) == 1 and instance.pieces[0].track.is_identity
    if single:
        obj = _splats(instance.name, instance.pieces[0], options, look)
        objects = [obj]
    else:
        obj = bpy.data.objects.new(instance.name, None)
        obj.empty_display_size = 0.05
        objects = [obj]
        for piece in instance.pieces:
            part = _splats(f"{instance.name}.{piece.name}", piece, options, look)
            part.parent = obj
            place(part, piece.track)
            if piece.visibility is None:
                part[PART] = piece.path
            objects.append(part)
    obj.parent = root
    place(obj, instance.track)
    for key, value in instance.data.items():
        obj[key] = value
    obj[PRIM] = instance.path
    obj["instance"] = instance.instance
    obj[IMPORTED] = obj.name
    of_windows = [piece.visibility for piece in instance.pieces] if not single else []
    for each, visibility in itertools.zip_longest(objects, [None, *of_windows]):
        each["label"] = instance.label
        each["display_name"] = instance.display_name
        _hide(each, visibility or instance.visibility)
    return objects


def _splats(name: str, piece: Piece, options: Options, look: Look) -> bpy.types.Object:
    mesh = splat_mesh(name, piece.splats, options.harmonics)
    obj = bpy.data.objects.new(name, mesh)
    add_modifier(obj, piece.splats, look)
    return obj


def place(obj: bpy.types.Object, track: Track) -> None:
    """Give an object the poses of a track.

    Recorded motion goes into the *delta* transform: location and rotation stay free, so that an object can be
    moved by hand and keeps its motion.
    """
    obj.rotation_mode = "QUATERNION"
    if not track.moves:
        obj.location, obj.rotation_quaternion = track.translations[0], track.rotations[0]
        obj.scale = track.scales[0]
        return
    refined = track.refined()
    animation.curves(obj, "delta_location", refined.codes, refined.translations)
    animation.curves(obj, "delta_rotation_quaternion", refined.codes, refined.rotations)
    if np.allclose(track.scales, track.scales[0], rtol=0, atol=1e-9):
        obj.scale = track.scales[0]
    else:
        animation.curves(obj, "delta_scale", refined.codes, refined.scales)
    obj.delta_location, obj.delta_rotation_quaternion = track.translations[0], track.rotations[0]


def _hide(obj: bpy.types.Object, visibility: Visibility) -> None:
    """Visibility over time, held between changes."""
    hidden = ~visibility.visible
    obj.hide_render = obj.hide_viewport = bool(hidden[0])
    if len(visibility.codes) > 1:
        for path in ("hide_render", "hide_viewport"):
            animation.curve(obj, path, 0, visibility.codes, hidden.astype(float), animation.CONSTANT)


def _camera(camera: Camera, root: bpy.types.Object, meters_per_unit: float) -> bpy.types.Object:
    """A perspective camera; Blender's and USD's both look along -z with y up."""
    data = bpy.data.cameras.new(camera.name)
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = FILM_MM
    data.lens = camera.focal[0] * FILM_MM
    data.shift_x, data.shift_y = camera.shift[0]
    data.clip_start, data.clip_end = (depth * meters_per_unit for depth in camera.clipping)
    if len(camera.lens_codes) > 1:
        animation.curve(data, "lens", 0, camera.lens_codes, camera.focal * FILM_MM)
        animation.curve(data, "shift_x", 0, camera.lens_codes, camera.shift[:, 0])
        animation.curve(data, "shift_y", 0, camera.lens_codes, camera.shift[:, 1])
    obj = bpy.data.objects.new(camera.name, data)
    obj.parent = root
    poses = camera.track
    place(obj, Track(poses.codes, poses.translations, poses.rotations, np.ones_like(poses.translations)))
    obj["camera_prim"] = camera.path
    obj["display_name"] = camera.display_name
    if camera.size:
        obj["image_width"], obj["image_height"] = camera.size
    return obj


def _look(scene: Scene, options: Options) -> Look:
    """Inputs of the nodes that all splats of a scene share."""
    look: Look = {
        nodes.DISPLAY: options.display_blending,
        nodes.FACING: options.discs,
        nodes.NEAR: NEAR_METERS / scene.meters_per_unit,
    }
    recorded = next((camera for camera in scene.cameras if camera.size), None)
    if recorded is not None and recorded.size is not None:
        half = 0.5 / float(recorded.focal[0])
        look[nodes.VIEW] = (half, half * recorded.aspect, 0.0)
        if options.training_blur:
            look[nodes.BLUR] = 2 * half / recorded.size[0]
    return look


def _set_scene(scene: Scene, imported: Imported, options: Options) -> None:
    target = bpy.context.scene
    target.frame_start, target.frame_end = int(scene.start), int(scene.end)
    rate = scene.frames_per_second
    target.render.fps = max(1, round(rate))
    target.render.fps_base = target.render.fps / rate
    target.world = _world(scene, options)
    target.render.engine = "CYCLES"
    # A ray passes through many faint splats, each a front and a back face.
    target.cycles.transparent_max_bounces = 1024
    # Ending rays by chance would turn what shines through into noise.
    target.cycles.min_transparent_bounces = 1024
    target.cycles.use_denoising = False
    target.view_settings.view_transform = "Raw" if options.display_blending else "Standard"
    target.view_settings.look = "None"
    if imported.cameras:
        target.camera = imported.cameras[0]
        recorded = scene.cameras[0]
        if recorded.size:
            target.render.resolution_x, target.render.resolution_y = recorded.size
            target.render.resolution_percentage = 100
            # Above 1 where recorded pixels are wider than high.
            aspect = recorded.size[1] / recorded.size[0] / recorded.aspect
            target.render.pixel_aspect_x = max(1.0, aspect)
            target.render.pixel_aspect_y = max(1.0, 1.0 / aspect)
    target.frame_set(target.frame_start)


def _world(scene: Scene, options: Options) -> bpy.types.World:
    """The colour behind everything."""
    world = bpy.data.worlds.new(Path(scene.path).stem)
    color = np.asarray(scene.background_color)
    if not options.display_blending:
        color = linear_from_display(color)
    if world.node_tree is None:  # before Blender 5
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (*color, 1.0)
    return world
