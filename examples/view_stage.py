"""Draw what a stage written by `cif export` holds, read back through usd-core alone.

    .venv/bin/python examples/view_stage.py out/demo/out.usda out/stage [--time CODE] [--camera NAME]

Every prim's splats are taken at one time code, moved by the prim's own transform, tinted by object, and
rendered from one of the stage's cameras: what other tools will see, apart from the tint.
"""

import argparse
import colorsys
import json
import pathlib
import sys
import tempfile

import cif
import numpy as np
from pxr import Gf, Usd, UsdGeom

SPLATS = "ParticleField3DGaussianSplat"
BAND_0 = 0.28209479177387814
TINT = 0.6


def main() -> int:
    """Draw one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", type=pathlib.Path)
    parser.add_argument("output", type=pathlib.Path, help="folder of the picture")
    parser.add_argument("--time", type=float, help="time code (default: the middle)")
    parser.add_argument("--camera", help="name of a camera prim (default: the first)")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 384), metavar=("WIDTH", "HEIGHT"))
    options = parser.parse_args()

    stage = Usd.Stage.Open(str(options.stage))
    time = options.time
    if time is None:
        time = round((stage.GetStartTimeCode() + stage.GetEndTimeCode()) / 2)
    with tempfile.TemporaryDirectory() as folder:
        scene = pathlib.Path(folder) / "stage.cif"
        views = pathlib.Path(folder) / "views.json"
        splats(stage, time).save(scene)
        views.write_text(json.dumps([view(stage, time, options.camera, options.size)]))
        return cif.run(["render", str(scene), "--camera", str(views), "-o", str(options.output), "--force"])


def splats(stage: Usd.Stage, time: float) -> cif.Field:
    """All splats of the stage at a time code, tinted by object."""
    columns: dict[str, list[np.ndarray]] = {}
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == SPLATS]
    owners = {prim.GetPath(): instance_of(prim) for prim in prims}
    objects = sorted({owner.GetPath() for owner in owners.values() if owner})
    for prim in prims:

        def read(name: str, prim: Usd.Prim = prim) -> np.ndarray:
            return np.array(prim.GetAttribute(name).Get(time), dtype=np.float32)

        world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time)
        turn = world.ExtractRotationQuat()
        degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
        first_band = read("radiance:sphericalHarmonicsCoefficients").reshape(-1, (degree + 1) ** 2, 3)[:, 0]
        colors = np.clip(0.5 + BAND_0 * first_band, 0, 1)
        if owner := owners[prim.GetPath()]:
            hue = objects.index(owner.GetPath()) * 0.618 % 1
            colors = (1 - TINT) * colors + TINT * np.array(colorsys.hsv_to_rgb(hue, 0.8, 1.0))
        xyzw = read("orientations")
        rows = {
            "means": read("positions") @ np.array(world)[:3, :3] + np.array(world.ExtractTranslation()),
            "scales": read("scales"),
            "quaternions": product(turn, xyzw),
            "opacities": read("opacities"),
            "colors": colors,
        }
        for name, values in rows.items():
            columns.setdefault(name, []).append(values.astype(np.float32))
    if not columns:
        sys.exit("the stage holds no splats")
    return cif.Field.from_arrays(**{name: np.concatenate(parts) for name, parts in columns.items()})


def instance_of(prim: Usd.Prim) -> Usd.Prim | None:
    """The instance that a splat prim or the part around it belongs to; none for the background."""
    while not prim.IsPseudoRoot():
        if prim.GetAttribute("cif:id").HasAuthoredValue():
            return prim
        prim = prim.GetParent()
    return None


def product(turn: Gf.Quatd, xyzw: np.ndarray) -> np.ndarray:
    """Rotations `xyzw` followed by `turn`, as (w, x, y, z)."""
    (x, y, z), w = turn.GetImaginary(), turn.GetReal()
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return xyzw[:, [3, 0, 1, 2]] @ matrix.T


def view(stage: Usd.Stage, time: float, name: str | None, size: tuple[int, int]) -> dict:
    """One of the stage's cameras as a view of `cif render`."""
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera) and name in (None, prim.GetName())]
    if not cameras:
        sys.exit("the stage has no such camera")
    camera = UsdGeom.Camera(cameras[0]).GetCamera(time)
    focal = camera.focalLength / camera.horizontalAperture * size[0]
    # USD cameras look along -z with y up; ours along +z with y down.
    world = np.array(camera.transform).T @ np.diag([1.0, -1.0, -1.0, 1.0])
    return {
        "name": cameras[0].GetName(),
        "width": size[0],
        "height": size[1],
        "focal_px": [focal, focal],
        "world_from_camera": world.tolist(),
    }


if __name__ == "__main__":
    sys.exit(main())
