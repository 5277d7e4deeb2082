"""Let objects of an exported stage fall, with Newton on the CPU, and write where they went as a USD layer.

In an environment of its own, because Newton's importer needs a usd-core older than 26.9:

    pip install newton==1.8.0 newton-usd-schemas==0.6.0 warp-lang==1.19.0 usd-core==26.8 scipy numpy
    python examples/simulate_newton.py table.usda -o fallen.usda --dynamic "red mug" --dynamic "*ball"

and back in the environment of cif:

    cif import fallen.usda --base table.cif -o fallen.cif

Every instance of a stage written by `cif export` has a variant set `physics`: *kinematic* ones follow the
recorded motion, *none* only stand in the way, *dynamic* ones fall. The stage is loaded with the chosen
variants; recorded motion is played by this program, because simulators read poses at the default time only. A
plane stands for the table, which is background and has no collider unless `--background-hulls` gave it some.

The layer has the stage as its sublayer and holds the poses of what fell, so that it opens anywhere as the scene
with the simulated motion, Blender included.
"""

from __future__ import annotations

import argparse
import fnmatch
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import newton
import numpy as np
import warp as wp
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

SPLATS = "ParticleField3DGaussianSplat"
STEPS_PER_SECOND = 480
"""Simulation steps; contacts of small things are stiff."""
SETTLING = 60
"""Steps that overlapping colliders get to part before time runs."""
ENCLOSED = 0.9
"""Least share of an instance's opacity inside its colliders; hulls leave out what strays."""
FOLLOWS = 1e-4
"""Largest distance of a kinematic body from its track, stage units."""


@dataclass
class Poses:
    """Where one body was, in the world: a row per recorded frame."""

    translations: list[np.ndarray]
    rotations: list[np.ndarray]
    """Quaternions (x, y, z, w), as Newton has them."""


def main() -> int:
    """Simulate, check, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="layer to write, .usda or .usdc")
    parser.add_argument("--dynamic", action="append", default=[], metavar="LABEL", help="let these fall; globs")
    parser.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "LAST"), help="default: all")
    parser.add_argument("--ground", type=float, help="height of the table (default: found in the background)")
    parser.add_argument(
        "--drop", type=float, default=0.0, help="lift what falls by this much first, stage units"
    )
    parser.add_argument("--force", action="store_true", help="replace the output")
    options = parser.parse_args()
    if options.output.exists() and not options.force:
        sys.exit(f"{options.output}: exists; --force replaces it")
    if not options.stage.is_file():
        sys.exit(f"{options.stage}: no such file")
    wp.config.quiet = True
    layer, stage = layer_over(options.stage, options.output)
    falling = choose(stage, options.dynamic)
    if options.dynamic and not falling:
        sys.exit(f"no instance with a physics variant is called {' or '.join(options.dynamic)}")
    failed = not check_colliders(stage)
    up = 1 if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else 2
    ground = options.ground if options.ground is not None else ground_height(stage, falling, up)
    print(f"ground at {ground:.4f}")
    first, last = options.frames or (int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode()))
    recorded, drift = simulate(stage, falling, ground, up, np.arange(first, last + 1), options.drop)
    print(f"kinematic bodies follow their tracks to {drift:.1e}")
    failed |= drift > FOLLOWS
    for path, poses in recorded.items():
        write_poses(stage, stage.GetPrimAtPath(path), poses, first)
        fell = poses.translations[0][up] - poses.translations[-1][up]
        low = lowest(stage, path, up, last)
        rest = np.linalg.norm(poses.translations[-1] - poses.translations[-2]) if last > first else 0.0
        print(f"{path}: fell by {fell:.4f}, lowest point {low - ground:+.4f} over ground, last step {rest:.1e}")
        failed |= not np.isfinite([fell, low]).all()
    save(layer, options.output)
    print(f"wrote {options.output}")
    return int(failed)


def layer_over(base: Path, out: Path) -> tuple[Sdf.Layer, Usd.Stage]:
    """An empty layer over a stage, and the stage that both make; edits go into the layer."""
    under = Sdf.Layer.FindOrOpen(str(base.resolve()))
    # Beside the output, so that relative paths are those of the finished file.
    layer = Sdf.Layer.CreateAnonymous(out.suffix)
    for key in under.pseudoRoot.ListInfoKeys():
        if key not in ("subLayers", "subLayerOffsets", "customLayerData", "documentation", "comment"):
            layer.pseudoRoot.SetInfo(key, under.pseudoRoot.GetInfo(key))
    layer.customLayerData = {"cifEdits": {"layout": 1, "generator": "simulate_newton.py"}}
    layer.subLayerPaths.append(str(base.resolve()))
    return layer, Usd.Stage.Open(layer)


def save(layer: Sdf.Layer, out: Path) -> None:
    """Write the layer with a path to the stage that is relative to it."""
    base = layer.subLayerPaths[0]
    layer.subLayerPaths[0] = "./" + Path(os.path.relpath(base, out.resolve().parent)).as_posix()
    scratch = out.with_name(f".{out.name}.part{out.suffix}")
    layer.Export(str(scratch))
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


def simulate(
    stage: Usd.Stage, falling: list[Sdf.Path], ground: float, up: int, frames: np.ndarray, drop: float
) -> tuple[dict[Sdf.Path, Poses], float]:
    """Poses of what falls at every frame, and the worst distance of a kinematic body from its track."""
    builder = newton.ModelBuilder(up_axis=newton.Axis[UsdGeom.GetStageUpAxis(stage)])
    loaded = builder.add_usd(stage)
    builder.add_ground_plane(height=ground)
    model = builder.finalize(device="cpu")
    bodies = {Sdf.Path(str(path)): index for path, index in loaded["path_body_map"].items()}
    driven = {path: index for path, index in bodies.items() if is_kinematic(stage, path)}
    falling = [body for path in falling for body in bodies_of(path, bodies)]
    print(f"{len(bodies)} bodies, {len(driven)} of them on tracks, {model.shape_count} shapes")
    solver = newton.solvers.SolverXPBD(model, iterations=8)
    pipeline = newton.CollisionPipeline(model)
    contacts, control = pipeline.contacts(), model.control()
    now, after = model.state(), model.state()
    steps = max(1, round(STEPS_PER_SECOND / stage.GetTimeCodesPerSecond()))
    seconds = 1.0 / stage.GetTimeCodesPerSecond() / steps
    start = now.body_q.numpy().copy()  # on the CPU, `numpy()` shares the memory of the state
    for path in falling:
        start[bodies[path], up] += drop
    now.body_q.assign(start)
    # Hulls of captured things overlap a little; let them part before time runs, or they would be shot apart.
    velocities = now.body_qd.numpy().copy()
    gravity = model.gravity.numpy().copy()
    model.gravity.zero_()
    for _ in range(SETTLING):
        now.body_qd.zero_()
        now.clear_forces()
        pipeline.collide(now, contacts)
        solver.step(now, after, control, contacts, seconds)
        now, after = after, now
    model.gravity.assign(gravity)
    now.body_qd.assign(velocities)
    for path in falling:
        moved = np.linalg.norm(now.body_q.numpy()[bodies[path], :3] - start[bodies[path], :3])
        print(f"{path}: parted from what it overlapped by {moved:.4f}")
    recorded = {path: Poses([], []) for path in falling}
    drift = 0.0
    for frame in frames:
        poses = now.body_q.numpy()
        for path, record in recorded.items():
            record.translations.append(poses[bodies[path], :3].astype(np.float64))
            record.rotations.append(poses[bodies[path], 3:].astype(np.float64))
        if frame == frames[-1]:
            break
        for step in range(steps):
            tracks = {i: pose_at(stage, path, frame + step / steps) for path, i in driven.items()}
            if tracks:
                poses = now.body_q.numpy()
                for index, pose in tracks.items():
                    poses[index] = pose
                now.body_q.assign(poses)
            now.clear_forces()
            pipeline.collide(now, contacts)
            solver.step(now, after, control, contacts, seconds)
            now, after = after, now
            for index, pose in tracks.items():
                drift = max(drift, float(np.abs(now.body_q.numpy()[index, :3] - pose[:3]).max()))
    return recorded, drift


def bodies_of(path: Sdf.Path, bodies: dict[Sdf.Path, int]) -> list[Sdf.Path]:
    """The bodies of an instance: itself, or its parts where joints tie them."""
    found = [path] if path in bodies else [body for body in bodies if body.HasPrefix(path)]
    if not found:
        sys.exit(f"{path}: Newton made no body of it; does it have a collider?")
    return found


def is_kinematic(stage: Usd.Stage, path: Sdf.Path) -> bool:
    """Whether a body follows its recorded motion."""
    return bool(UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath(path)).GetKinematicEnabledAttr().Get())


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


if __name__ == "__main__":
    sys.exit(main())
