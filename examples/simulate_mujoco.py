"""Let objects of an exported stage fall, with MuJoCo, and write where they went as a USD layer.

In an environment of its own:

    pip install "mujoco[usd]==4.0.0"
    cif export table.cif table.usda --for mujoco
    python examples/simulate_mujoco.py table.usda -o fallen.usda --dynamic "red mug" --dynamic "*ball"

and back in the environment of cif:

    cif import fallen.usda --base table.cif -o fallen.cif

MuJoCo's importer makes every body one that falls, and reads poses at the default time only. This program makes
the *kinematic* bodies of the stage mocap bodies and moves them along their recorded tracks; *none* only stand
in the way, *dynamic* ones fall. Parts on joints fall as an articulation. Any stage written by `cif export` will
do: where it has no ground of its own, a plane is added.

The layer has the stage as its sublayer and holds the poses of what fell, so that it opens anywhere as the scene
with the simulated motion, Blender included.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from pxr import Sdf, Usd
from simulated_stage import Poses, arguments, begin, bodies_of, finish, is_kinematic, pose_at

FOLLOWS = 1e-6
"""Largest distance of a mocap body from its track, stage units."""


def main() -> int:
    """Simulate, check, write."""
    job = begin(arguments(__doc__), Path(__file__).name)
    model, driven = load(job.stage, job.added_ground, job.up)
    recorded, drift = simulate(model, job.stage, job.falling, driven, job.frames)
    print(f"kinematic bodies follow their tracks to {drift:.1e}")

    def words(path: Sdf.Path, _: Poses, fall: str) -> str:
        return f"{float(model.body(str(path)).mass[0]):.3f} kg {fall}"

    return finish(job, recorded, drift <= FOLLOWS, words)


def load(stage: Usd.Stage, ground: float | None, up: int) -> tuple[mujoco.MjModel, dict[Sdf.Path, int]]:
    """The model of a stage with its chosen variants, and the mocap bodies by path."""
    with tempfile.TemporaryDirectory() as folder:
        # MuJoCo opens files; the session layer holds what is switched off.
        path = Path(folder) / "chosen.usda"
        chosen = Sdf.Layer.CreateNew(str(path))
        chosen.TransferContent(stage.GetRootLayer())
        chosen.subLayerPaths.clear()
        for name in stage.GetRootLayer().subLayerPaths:
            chosen.subLayerPaths.append(name)
        for prim in stage.TraverseAll():
            if not prim.IsActive():
                Sdf.CreatePrimInLayer(chosen, prim.GetPath()).active = False
        chosen.Save()
        spec = mujoco.MjSpec.from_file(str(path))
    driven = []
    for body in list(spec.bodies):
        path = Sdf.Path(body.name) if body.name.startswith("/") else None
        if path is None or not is_kinematic(stage, path):
            continue
        for joint in list(body.joints):
            spec.delete(joint)
        body.mocap = True
        driven.append(path)
    if ground is not None:
        plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1])
        plane.pos[up] = ground
        plane.quat = [1, 0, 0, 0] if up == 2 else [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
    model = spec.compile()
    shapes = f"{model.nbody - 1} bodies, {len(driven)} of them on tracks, {model.ngeom} shapes"
    print(shapes)
    return model, {path: int(model.body(str(path)).mocapid[0]) for path in driven}


def simulate(
    model: mujoco.MjModel,
    stage: Usd.Stage,
    falling: list[Sdf.Path],
    driven: dict[Sdf.Path, int],
    frames: np.ndarray,
) -> tuple[dict[Sdf.Path, Poses], float]:
    """Poses of what falls at every frame, and the worst distance of a mocap body from its track."""
    data = mujoco.MjData(model)
    bodies = {Sdf.Path(model.body(k).name): k for k in range(1, model.nbody)}
    falling = [body for path in falling for body in bodies_of(path, bodies)]
    seconds = 1.0 / stage.GetTimeCodesPerSecond()
    steps = max(1, round(seconds / model.opt.timestep))
    model.opt.timestep = seconds / steps
    for path in falling:
        start(model, data, stage, path)
    recorded = {path: Poses([], []) for path in falling}
    drift = 0.0
    for frame in frames:
        for step in range(steps):
            poses = {path: pose_at(stage, path, frame + step / steps) for path in driven}
            for path, pose in poses.items():
                data.mocap_pos[driven[path]] = pose[:3]
                data.mocap_quat[driven[path]] = pose[[6, 3, 4, 5]]
            if step == 0:
                mujoco.mj_forward(model, data)
                for path, record in recorded.items():
                    record.translations.append(data.xpos[bodies[path]].copy())
                    record.rotations.append(data.xquat[bodies[path]][[1, 2, 3, 0]].copy())
                if frame == frames[-1]:
                    break
            mujoco.mj_step(model, data)
            for path, pose in poses.items():
                drift = max(drift, float(np.abs(data.xpos[bodies[path]] - pose[:3]).max()))
    return recorded, drift


def start(model: mujoco.MjModel, data: mujoco.MjData, stage: Usd.Stage, path: Sdf.Path) -> None:
    """Give a body the velocity that the stage has for it; MuJoCo's importer leaves it out."""
    body = model.body(str(path))
    joint = int(body.jntadr[0])
    velocity = stage.GetPrimAtPath(path).GetAttribute("physics:velocity").Get()
    turning = stage.GetPrimAtPath(path).GetAttribute("physics:angularVelocity").Get()
    if velocity is None or joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        return
    mujoco.mj_forward(model, data)
    turn = data.xmat[body.id].reshape(3, 3)
    angular = np.radians(np.array(turning if turning is not None else (0, 0, 0), float))
    # Stages give the velocity of the centre of mass, MuJoCo wants that of the origin, and turns of its frame.
    arm = data.xpos[body.id] - data.xipos[body.id]
    at = int(model.jnt_dofadr[joint])
    data.qvel[at : at + 3] = np.array(velocity, float) + np.cross(angular, arm)
    data.qvel[at + 3 : at + 6] = turn.T @ angular


if __name__ == "__main__":
    sys.exit(main())
