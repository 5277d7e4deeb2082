"""Let objects of an exported stage fall, with Newton on the CPU, and write where they went as a USD layer.

In an environment of its own, because Newton's importer needs a usd-core older than 26.9:

    pip install newton==1.8.0 newton-usd-schemas==0.6.0 warp-lang==1.19.0 usd-core==26.8 scipy numpy
    python examples/simulate_newton.py table.usda -o fallen.usda --dynamic "red mug" --dynamic "*ball"

and back in the environment of cif:

    cif import fallen.usda --base table.cif -o fallen.cif

Every instance of a stage written by `cif export` has a variant set `physics`: *kinematic* ones follow the
recorded motion, *none* only stand in the way, *dynamic* ones fall. The stage is loaded with the chosen
variants; recorded motion is played by this program, because simulators read poses at the default time only. The
table is background and has no collider unless `--background-hulls` gave it some: a plane stands for it, that of
the stage (`cif export --for newton`) or one of this program.

The layer has the stage as its sublayer and holds the poses of what fell, so that it opens anywhere as the scene
with the simulated motion, Blender included.
"""

from __future__ import annotations

import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp
from pxr import Sdf, Usd, UsdGeom
from simulated_stage import Poses, arguments, begin, bodies_of, finish, is_kinematic, pose_at

STEPS_PER_SECOND = 480
"""Simulation steps; contacts of small things are stiff."""
SETTLING = 60
"""Steps that overlapping colliders get to part before time runs."""
FOLLOWS = 1e-4
"""Largest distance of a kinematic body from its track, stage units."""


def main() -> int:
    """Simulate, check, write."""
    parser = arguments(__doc__)
    parser.add_argument(
        "--drop", type=float, default=0.0, help="lift what falls by this much first, stage units"
    )
    wp.config.quiet = True
    job = begin(parser, Path(__file__).name)
    recorded, drift = simulate(job.stage, job.falling, job.added_ground, job.up, job.frames, job.options.drop)
    print(f"kinematic bodies follow their tracks to {drift:.1e}")

    def words(_: Sdf.Path, poses: Poses, fall: str) -> str:
        places = poses.translations
        rest = np.linalg.norm(places[-1] - places[-2]) if len(places) > 1 else 0.0
        return f"{fall}, last step {rest:.1e}"

    return finish(job, recorded, drift <= FOLLOWS, words)


def simulate(
    stage: Usd.Stage, falling: list[Sdf.Path], ground: float | None, up: int, frames: np.ndarray, drop: float
) -> tuple[dict[Sdf.Path, Poses], float]:
    """Poses of what falls at every frame, and the worst distance of a kinematic body from its track."""
    builder = newton.ModelBuilder(up_axis=newton.Axis[UsdGeom.GetStageUpAxis(stage)])
    loaded = builder.add_usd(stage)
    if ground is not None:
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


if __name__ == "__main__":
    sys.exit(main())
