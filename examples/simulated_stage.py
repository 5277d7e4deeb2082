"""What the examples of simulators share: a layer over a stage, what falls, colliders, the ground, poses."""

from __future__ import annotations

import argparse
import fnmatch
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

SPLATS = "ParticleField3DGaussianSplat"
ENCLOSED = 0.9
"""Least share of an instance's opacity inside its colliders; hulls leave out what strays."""


@dataclass
class Poses:
    """Where one body was, in the world: a row per recorded frame."""

    translations: list[np.ndarray]
    rotations: list[np.ndarray]
    """Quaternions (x, y, z, w), as Newton has them."""


@dataclass
class Job:
    """A stage with its chosen variants, and what is asked of the simulation."""

    options: argparse.Namespace
    layer: Sdf.Layer
    stage: Usd.Stage
    falling: list[Sdf.Path]
    up: int
    """Axis that is up, 1 or 2."""
    ground: float
    has_plane: bool
    """Whether a plane of the stage stands for the ground."""
    frames: np.ndarray
    failed: bool
    """Whether a check has failed."""

    @property
    def added_ground(self) -> float | None:
        """Height of the plane that the stage lacks."""
        return None if self.has_plane else self.ground


def arguments(description: str) -> argparse.ArgumentParser:
    """The options that all simulators take."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stage", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="layer to write, .usda or .usdc")
    parser.add_argument("--dynamic", action="append", default=[], metavar="LABEL", help="let these fall; globs")
    parser.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "LAST"), help="default: all")
    parser.add_argument("--ground", type=float, help="height of the table (default: the stage's, or found)")
    parser.add_argument("--force", action="store_true", help="replace the output")
    return parser


def begin(parser: argparse.ArgumentParser, generator: str) -> Job:
    """Check the command, open the stage, choose what falls and find the ground."""
    options = parser.parse_args()
    if options.output.exists() and not options.force:
        sys.exit(f"{options.output}: exists; --force replaces it")
    if not options.stage.is_file():
        sys.exit(f"{options.stage}: no such file")
    layer, stage = layer_over(options.stage, options.output, generator)
    falling = choose(stage, options.dynamic)
    if options.dynamic and not falling:
        sys.exit(f"no instance with a physics variant is called {' or '.join(options.dynamic)}")
    failed = not check_colliders(stage)
    up = 1 if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else 2
    ground, has_plane = ground_of(stage, falling, up, options.ground)
    first, last = options.frames or (int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode()))
    frames = np.arange(first, last + 1)
    return Job(options, layer, stage, falling, up, ground, has_plane, frames, failed)


def finish(
    job: Job, recorded: dict[Sdf.Path, Poses], is_on_track: bool, words: Callable[[Sdf.Path, Poses, str], str]
) -> int:
    """Write where everything went, with a line for each that fell; the exit code."""
    failed = job.failed or not is_on_track
    for path, poses in recorded.items():
        write_poses(job.stage, job.stage.GetPrimAtPath(path), poses, int(job.frames[0]))
        fell = poses.translations[0][job.up] - poses.translations[-1][job.up]
        low = lowest(job.stage, path, job.up, int(job.frames[-1]))
        fall = f"fell by {fell:.4f}, lowest point {low - job.ground:+.4f} over ground"
        print(f"{path}: {words(path, poses, fall)}")
        failed |= not np.isfinite([fell, low]).all()
    save(job.layer, job.options.output)
    print(f"wrote {job.options.output}")
    return int(failed)


def layer_over(base: Path, out: Path, generator: str) -> tuple[Sdf.Layer, Usd.Stage]:
    """An empty layer over a stage, and the stage that both make; edits go into the layer."""
    under = Sdf.Layer.FindOrOpen(str(base.resolve()))
    # Beside the output, so that relative paths are those of the finished file.
    layer = Sdf.Layer.CreateAnonymous(out.suffix)
    for key in under.pseudoRoot.ListInfoKeys():
        if key not in ("subLayers", "subLayerOffsets", "customLayerData", "documentation", "comment"):
            layer.pseudoRoot.SetInfo(key, under.pseudoRoot.GetInfo(key))
    layer.customLayerData = {"cifEdits": {"layout": 1, "generator": generator}}
    layer.subLayerPaths.append(str(base.resolve()))
    return layer, Usd.Stage.Open(layer)


def save(layer: Sdf.Layer, out: Path) -> None:
    """Write the layer with a path to the stage that is relative to it."""
    base = layer.subLayerPaths[0]
    # A copy: the stage that is open would look for the relative path where it has no place.
    finished = Sdf.Layer.CreateAnonymous(out.suffix)
    finished.TransferContent(layer)
    finished.subLayerPaths[0] = "./" + Path(os.path.relpath(base, out.resolve().parent)).as_posix()
    scratch = out.with_name(f".{out.name}.part{out.suffix}")
    finished.Export(str(scratch))
    scratch.replace(out)


def choose(stage: Usd.Stage, labels: list[str]) -> list[Sdf.Path]:
    """Select the variant `dynamic` where a label fits; the paths of those instances."""
    chosen = []
    for prim in stage.Traverse():
        if not prim.GetVariantSets().HasVariantSet("physics"):
            continue
        classes = prim.GetAttribute("semantics:labels:class").Get() or []
        names = [prim.GetName(), prim.GetDisplayName(), *map(str, classes)]
        if any(fnmatch.fnmatchcase(name, label) for label in labels for name in names):
            prim.GetVariantSet("physics").SetVariantSelection("dynamic")
            chosen.append(prim.GetPath())
    return chosen


def owner(prim: Usd.Prim) -> Usd.Prim:
    """The instance that a prim lies in."""
    while not prim.GetAttribute("semantics:labels:instance") and not prim.GetParent().IsPseudoRoot():
        prim = prim.GetParent()
    return prim


def is_background(instance: Usd.Prim) -> bool:
    """Whether a prim is what belongs to no instance."""
    return not instance.GetAttribute("cif:id").HasAuthoredValue()


def colliders(stage: Usd.Stage) -> dict[Sdf.Path, list[Usd.Prim]]:
    """Collision meshes by instance."""
    found: dict[Sdf.Path, list[Usd.Prim]] = {}
    for prim in stage.Traverse():
        if prim.HasAPI(UsdPhysics.CollisionAPI) and prim.IsA(UsdGeom.Mesh):
            found.setdefault(owner(prim).GetPath(), []).append(prim)
    return found


def world_points(prim: Usd.Prim, name: str, time: Usd.TimeCode) -> np.ndarray:
    """Points of a prim in the world, [N, 3]."""
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time))
    return np.asarray(prim.GetAttribute(name).Get(time), dtype=np.float64) @ matrix[:3, :3] + matrix[3, :3]


def check_colliders(stage: Usd.Stage) -> bool:
    """Whether the colliders hold the splats of their instances, weighted by opacity; prints a line for each."""
    time = Usd.TimeCode.Default()
    good = True
    for path, meshes in colliders(stage).items():
        instance = stage.GetPrimAtPath(path)
        splats = [prim for prim in Usd.PrimRange(instance) if prim.GetTypeName() == SPLATS]
        if not splats or is_background(instance):
            continue
        points = np.concatenate([world_points(prim, "positions", time) for prim in splats])
        weights = np.concatenate([np.asarray(prim.GetAttribute("opacities").Get()) for prim in splats])
        inside = np.zeros(len(points), dtype=bool)
        for mesh in meshes:
            corners = world_points(mesh, "points", time)
            faces = corners[np.asarray(mesh.GetAttribute("faceVertexIndices").Get()).reshape(-1, 3)]
            normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
            lengths = np.linalg.norm(normals, axis=1)
            faces, normals = faces[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
            slack = 1e-5 * np.ptp(corners, axis=0).max()
            height = points @ normals.T - np.einsum("ij,ij->i", faces[:, 0], normals)
            inside |= (height <= slack).all(1)
        share = float(weights[inside].sum() / weights.sum())
        good &= share >= ENCLOSED
        print(f"{path}: {len(meshes)} colliders hold {share:.1%} of the opacity of {len(points)} splats")
    return good


def ground_of(stage: Usd.Stage, falling: list[Sdf.Path], up: int, asked: float | None) -> tuple[float, bool]:
    """Height of the ground, and whether a plane of the stage (`cif export --ground`) stands for it."""
    height, own = asked, False
    for prim in list(stage.Traverse()):
        if not (prim.IsA(UsdGeom.Plane) and prim.HasAPI(UsdPhysics.CollisionAPI)):
            continue
        if asked is None:
            place = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
            height, own = float(place.ExtractTranslation()[up]), True
        else:
            # Another height is asked for; the session is not part of the layer.
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                prim.SetActive(False)
    if height is None:
        height = ground_height(stage, falling, up)
    print(f"ground at {height:.4f}{', a plane of the stage' if own else ''}")
    return height, own


def ground_height(stage: Usd.Stage, falling: list[Sdf.Path], up: int) -> float:
    """Height of the surface under what falls: where the background is densest within its outline."""
    time = Usd.TimeCode.Default()
    hulls = colliders(stage)
    corners = [world_points(m, "points", time) for path in falling or hulls for m in hulls.get(path, [])]
    splats = [prim for prim in stage.Traverse() if prim.GetTypeName() == SPLATS]
    backgrounds = [prim for prim in splats if is_background(owner(prim))]
    if not corners or not backgrounds:
        return 0.0
    reach = np.concatenate(corners)
    points = np.concatenate([world_points(prim, "positions", time) for prim in backgrounds])
    weights = np.concatenate(
        [
            np.asarray(prim.GetAttribute("opacities").Get())
            * np.sort(np.asarray(prim.GetAttribute("scales").Get()), axis=1)[:, 1:].prod(1)
            for prim in backgrounds
        ]
    )
    size = np.ptp(reach, axis=0).max()
    low, high = reach.min(0) - size, reach.max(0) + size
    across = [axis for axis in range(3) if axis != up]
    near = ((points > low) & (points < high))[:, across].all(1) & (points[:, up] < high[up])
    if not near.any():
        return float(reach[:, up].min())
    heights, weights = points[near, up], weights[near]
    width = 0.05 * size
    # The densest band, then the middle of what it holds.
    centres = np.arange(heights.min(), heights.max() + width, width / 4)
    held = [weights[np.abs(heights - centre) < width / 2].sum() for centre in centres]
    band = np.abs(heights - centres[int(np.argmax(held))]) < width / 2
    return float(np.average(heights[band], weights=weights[band]))


def is_kinematic(stage: Usd.Stage, path: Sdf.Path) -> bool:
    """Whether a body follows its recorded motion."""
    return bool(UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath(path)).GetKinematicEnabledAttr().Get())


def bodies_of(path: Sdf.Path, bodies: dict[Sdf.Path, int]) -> list[Sdf.Path]:
    """The bodies of an instance: itself, or its parts where joints tie them."""
    found = [path] if path in bodies else [body for body in bodies if body.HasPrefix(path)]
    if not found:
        sys.exit(f"{path}: the simulator made no body of it; does it have a collider?")
    return found


def pose_at(stage: Usd.Stage, path: Sdf.Path, code: float) -> np.ndarray:
    """World pose (x, y, z, qx, qy, qz, qw) of a prim at a time code."""
    matrix = UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(Usd.TimeCode(code))
    rotation = matrix.RemoveScaleShear().ExtractRotationQuat()
    return np.array([*matrix.ExtractTranslation(), *rotation.GetImaginary(), rotation.GetReal()], np.float32)


def write_poses(stage: Usd.Stage, prim: Usd.Prim, poses: Poses, first: int) -> None:
    """Author the poses on the prim, in the frame of its parent, beside a default value."""
    parent = UsdGeom.Xformable(prim.GetParent())
    before: np.ndarray | None = None
    translate = prim.CreateAttribute("xformOp:translate", Sdf.ValueTypeNames.Double3)
    orient = prim.CreateAttribute("xformOp:orient", Sdf.ValueTypeNames.Quatf)
    order = prim.CreateAttribute("xformOpOrder", Sdf.ValueTypeNames.TokenArray, False, Sdf.VariabilityUniform)
    order.Set(["xformOp:translate", "xformOp:orient"])
    for number, (place, xyzw) in enumerate(zip(poses.translations, poses.rotations, strict=True)):
        code = Usd.TimeCode(first + number)
        world = Gf.Matrix4d().SetRotate(Gf.Quatd(xyzw[3], *xyzw[:3]))
        world.SetTranslateOnly(Gf.Vec3d(*place))
        local = world * parent.ComputeLocalToWorldTransform(code).GetInverse() if parent else world
        turn = local.RemoveScaleShear().ExtractRotationQuat()
        row = np.array([turn.GetReal(), *turn.GetImaginary()])
        row = -row if before is not None and row @ before < 0 else row
        before = row
        moments = [code] if number else [Usd.TimeCode.Default(), code]
        for moment in moments:
            translate.Set(local.ExtractTranslation(), moment)
            orient.Set(Gf.Quatf(*map(float, row)), moment)


def lowest(stage: Usd.Stage, path: Sdf.Path, up: int, frame: int) -> float:
    """Height of the lowest corner of the colliders of an instance, or of its part, at a frame."""
    hulls = [mesh for meshes in colliders(stage).values() for mesh in meshes if mesh.GetPath().HasPrefix(path)]
    return min(float(world_points(mesh, "points", Usd.TimeCode(frame))[:, up].min()) for mesh in hulls)
