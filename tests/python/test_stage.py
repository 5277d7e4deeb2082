"""What an exported stage holds, read by usd-core."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cif
import numpy as np
import pytest
from conftest import CAR, FRAMES, NAPKIN, PER_OBJECT, TIMES, turn
from pxr import Gf, Usd, UsdGeom, UsdSemantics, UsdUtils, UsdValidation

NODES = ["red_mug_001", "toy_car_002", "green_napkin_007", "background"]
SPLAT_ATTRIBUTES = [
    "positions",
    "orientations",
    "scales",
    "opacities",
    "extent",
    "radiance:sphericalHarmonicsCoefficients",
]


@pytest.fixture
def stage(stage_path: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(stage_path))


def splats_of(stage: Usd.Stage, name: str) -> Usd.Prim:
    return stage.GetPrimAtPath(f"/World/{name}/{name}_splats")


def rotations(xyzw: np.ndarray) -> np.ndarray:
    x, y, z, w = xyzw.T.astype(np.float64)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def world_splats(stage: Usd.Stage, name: str, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres and covariances in the world."""
    prim = splats_of(stage, name)
    get = lambda attribute: np.array(prim.GetAttribute(attribute).Get(time), np.float64)  # noqa: E731
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time))
    means = np.c_[get("positions"), np.ones(len(get("positions")))] @ matrix
    axes = matrix[:3, :3].T @ rotations(get("orientations"))
    return means[:, :3], np.einsum("nij,nj,nkj->nik", axes, get("scales") ** 2, axes)


def test_metadata(stage: Usd.Stage) -> None:
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, FRAMES - 1)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 12
    assert stage.GetRootLayer().customLayerData["cif"]["layout"] == 2


def test_one_prim_per_object(stage: Usd.Stage) -> None:
    names = [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()]
    assert names == [*NODES, "Cameras", "PhysicsScene"]
    counts = [len(splats_of(stage, name).GetAttribute("positions").Get()) for name in NODES]
    assert counts == [PER_OBJECT] * 3 + [100]
    mug = stage.GetPrimAtPath("/World/red_mug_001")
    assert mug.GetDisplayName() == "red mug"
    assert mug.GetAttribute("userProperties:label").Get() == "red mug"
    assert Usd.ModelAPI(mug).GetKind() == "component"
    applied = mug.GetMetadata("apiSchemas").GetAddedOrExplicitItems()
    assert "CifInstanceAPI" in applied
    assert "SemanticsLabelsAPI:wikidata_qcode" in applied
    assert list(mug.GetAttribute("semantics:labels:wikidata_qcode").Get()) == ["Q81727"]
    assert mug.GetAttribute("cif:motion:model").Get() == "static"
    assert (mug.GetAttribute("cif:id").Get(), mug.GetAttribute("cif:kind").Get()) == (1, "instance")
    assert mug.GetVariantSets().GetVariantSet("lod").GetVariantSelection() == "full"


def test_motion_model_is_the_cheapest(stage: Usd.Stage) -> None:
    for name, sampled, dense in [
        ("red_mug_001", 0, 0),
        ("toy_car_002", FRAMES, 0),
        ("green_napkin_007", FRAMES, FRAMES),
        ("background", 0, 0),
    ]:
        xform = UsdGeom.Xformable(stage.GetPrimAtPath(f"/World/{name}"))
        assert [op.GetOpName() for op in xform.GetOrderedXformOps()] == [
            "xformOp:translate",
            "xformOp:orient",
        ]
        for op in xform.GetOrderedXformOps():
            assert op.GetNumTimeSamples() == sampled, name
        for attribute in ["positions", "orientations", "extent"]:
            assert splats_of(stage, name).GetAttribute(attribute).GetNumTimeSamples() == dense, name
        for attribute in ["scales", "opacities", "radiance:sphericalHarmonicsCoefficients"]:
            assert splats_of(stage, name).GetAttribute(attribute).GetNumTimeSamples() == 0, name


def centre_of_mass(mesh: Usd.Prim) -> np.ndarray:
    """Of a closed mesh of triangles, filled evenly, in its own frame."""
    corners = np.array(mesh.GetAttribute("points").Get(), np.float64)
    a, b, c = corners[np.array(mesh.GetAttribute("faceVertexIndices").Get()).reshape(-1, 3)].swapaxes(0, 1)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    return np.einsum("i,ij->j", volumes, a + b + c) / 4 / volumes.sum()


def test_dynamic_bodies_start_as_the_object_moved(stage: Usd.Stage) -> None:
    """UsdPhysics wants the velocity of the centre of mass in the space of the prim's transform, and degrees."""
    car = stage.GetPrimAtPath("/World/toy_car_002")
    before, after = (UsdGeom.Xformable(car).ComputeLocalToWorldTransform(k) for k in [0, 1])
    centre = Gf.Vec3d(*centre_of_mass(stage.GetPrimAtPath("/World/toy_car_002/Collider")))
    assert centre.GetLength() > 1e-4
    # In a layer of its own: others read the same file.
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        car.GetVariantSet("physics").SetVariantSelection("dynamic")
    linear, angular = (
        np.array(car.GetAttribute(f"physics:{name}").Get()) for name in ["velocity", "angularVelocity"]
    )
    expected = 12 * np.array(after.Transform(centre) - before.Transform(centre))
    assert np.allclose(linear, expected, atol=1e-4 * np.linalg.norm(expected))
    # 2.5 radians about z over all frames.
    assert np.allclose(angular, [0, 0, np.degrees(2.5) * 12 / (FRAMES - 1)], atol=0.5)
    assert not car.GetAttribute("physics:kinematicEnabled").Get()


def test_every_sampled_attribute_has_a_default(stage: Usd.Stage) -> None:
    sampled = 0
    for prim in stage.Traverse():
        for attribute in prim.GetAuthoredAttributes():
            if attribute.GetNumTimeSamples():
                sampled += 1
                assert attribute.Get(Usd.TimeCode.Default()) is not None, attribute.GetPath()
                assert attribute.GetTimeSamples() == [float(k) for k in range(FRAMES)]
    assert sampled > 5


def test_splats_are_where_the_motion_puts_them(stage: Usd.Stage, field: cif.Field, motion) -> None:
    unit = field.quaternions / np.linalg.norm(field.quaternions, axis=1, keepdims=True)
    for code, time in enumerate(TIMES):
        means, quaternions = motion(time)
        unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        axes = rotations(unit[:, [1, 2, 3, 0]])
        covariances = np.einsum("nij,nj,nkj->nik", axes, field.scales.astype(np.float64) ** 2, axes)
        for name, rows in [("toy_car_002", CAR), ("green_napkin_007", NAPKIN)]:
            there, spread = world_splats(stage, name, code)
            assert np.abs(there - means[rows]).max() < 1e-5, (name, code)
            assert np.abs(spread - covariances[rows]).max() < 1e-7, (name, code)


def test_colors_are_raw_dc_coefficients(stage: Usd.Stage, field: cif.Field) -> None:
    prim = splats_of(stage, "toy_car_002")
    coefficients = UsdGeom.Primvar(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients"))
    assert (coefficients.GetElementSize(), coefficients.GetInterpolation()) == (1, "vertex")
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    shown = 0.5 + 0.28209479 * np.array(coefficients.Get())
    expected = 0.5 + 0.28209479 * field.sh_coefficients[CAR, 0]
    assert np.abs(shown - expected).max() < 1e-6
    assert np.abs(np.array(prim.GetAttribute("primvars:displayColor").Get()) - expected).max() < 1e-6
    assert prim.GetAttribute("sortingModeHint").Get() == "zDepth"


def test_extents_hold_every_ellipsoid(stage: Usd.Stage) -> None:
    for name in NODES:
        prim = splats_of(stage, name)
        for time in [Usd.TimeCode.Default(), *range(FRAMES)]:
            get = lambda attribute: np.array(prim.GetAttribute(attribute).Get(time), np.float64)  # noqa: B023, E731
            half = 3 * np.sqrt(np.einsum("nij,nj->ni", rotations(get("orientations")) ** 2, get("scales") ** 2))
            low, high = (get("positions") - half).min(0), (get("positions") + half).max(0)
            box = get("extent")
            assert (box[0] <= low + 1e-6).all() and (box[1] >= high - 1e-6).all(), (name, time)
            assert np.abs(box - [low, high]).max() < 1e-5, "tight"


def test_proxies_follow(stage: Usd.Stage) -> None:
    instancer = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/green_napkin_007/Proxy"))
    assert instancer.GetPurposeAttr().Get() == "proxy"
    assert np.abs(np.array(instancer.ComputeInstanceTransformsAtTime(0, 0)) - np.eye(4)).max() == 0
    (target,) = instancer.GetPrototypesRel().GetTargets()
    proxy = UsdGeom.Points(stage.GetPrimAtPath(target))
    # No traversal for shapes finds them: simulators would make bodies of them.
    assert not proxy.GetPrim().IsDefined()
    assert not [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]
    for code in range(FRAMES):
        assert instancer.GetExtentAttr().Get(code) == instancer.ComputeExtentAtTime(code, code)
        splats = np.array(splats_of(stage, "green_napkin_007").GetAttribute("positions").Get(code))
        points = np.array(proxy.GetPointsAttr().Get(code))
        assert np.abs(points - splats).max() == 0, "all of 80 splats are taken, in order"
        low, high = np.array(proxy.GetExtentAttr().Get(code))
        assert (points >= low).all() and (points <= high).all()


def test_labels_are_found_by_queries(stage: Usd.Stage) -> None:
    for time in [Usd.TimeCode.Default(), Usd.TimeCode(0), Gf.Interval(0, FRAMES - 1)]:
        classes = UsdSemantics.LabelsQuery("class", time)
        instances = UsdSemantics.LabelsQuery("instance", time)
        car = stage.GetPrimAtPath("/World/toy_car_002")
        assert classes.HasDirectLabel(car, "car") and classes.HasDirectLabel(car, "toy car")
        assert instances.HasDirectLabel(car, "toy_car_002")
        assert classes.HasInheritedLabel(splats_of(stage, "toy_car_002"), "car")
        assert not classes.HasDirectLabel(car, "mug")


def test_cameras_see_what_was_captured(stage: Usd.Stage, field: cif.Field) -> None:
    assert [prim.GetName() for prim in stage.GetPrimAtPath("/World/Cameras").GetChildren()] == [
        "hand_held",
        "tripod",
    ]
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/World/Cameras/hand_held"))
    tripod = stage.GetPrimAtPath("/World/Cameras/tripod")
    assert UsdGeom.Xformable(tripod).GetTimeSamples() == []
    points = np.array([[0, 0, 0], [0.5, 0.3, 0.4], [-0.4, 1.0, 0.2]], np.float64)
    for _, code, camera in field.cameras[:FRAMES]:
        frustum = prim.GetCamera(code).frustum
        clip = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        pose = camera.camera_from_world
        for point in points:
            x, y, _ = clip.Transform(Gf.Vec3d(*point))
            usd_pixel = [(x + 1) / 2 * camera.width, (1 - y) / 2 * camera.height]
            p = pose[:3, :3] @ point + pose[:3, 3]
            pixel = np.array(camera.focal) * p[:2] / p[2] + camera.principal
            assert np.abs(usd_pixel - pixel).max() < 1e-3, (code, usd_pixel, pixel)


def test_usd_validators_find_nothing(stage: Usd.Stage) -> None:
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(list(registry.GetOrLoadAllValidators()))
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in context.Validate(stage)] == []


def test_packages_are_aligned(stage_path: Path) -> None:
    if stage_path.suffix != ".usdz":
        assert not zipfile.is_zipfile(stage_path)
        return
    with zipfile.ZipFile(stage_path) as package, stage_path.open("rb") as raw:
        for entry in package.infolist():
            assert entry.compress_type == zipfile.ZIP_STORED
            raw.seek(entry.header_offset + 26)
            name, extra = np.frombuffer(raw.read(4), "<u2")
            assert (entry.header_offset + 30 + int(name) + int(extra)) % 64 == 0
    layers, _, unresolved = UsdUtils.ComputeAllDependencies(str(stage_path))
    assert len(layers) == 1 and not unresolved


def test_query_gives_pose_and_box(stage_path: Path, field: cif.Field, motion) -> None:
    time = TIMES[3]
    (found,) = cif.query_stage(stage_path, "TOY c*", time_code=3)
    assert (found["path"], found["class"], found["instance"], found["label"]) == (
        "/World/toy_car_002",
        "car",
        "toy_car_002",
        "toy car",
    )
    transform = np.array(found["transform"])
    assert np.abs(transform[:3, :3] - turn(2.5 * time)[0]).max() < 1e-5
    means, _ = motion(time)
    assert (means[CAR] > found["low"]).all() and (means[CAR] < found["high"]).all()
    rest = np.array(cif.query_stage(stage_path, "car")[0]["transform"])
    assert np.abs(rest[:3, :3] - np.eye(3)).max() < 1e-5, "without a time the default values count"
    assert len(cif.query_stage(stage_path, "*")) == len(NODES)


def test_unknown_labels_list_the_known(stage_path: Path) -> None:
    with pytest.raises(cif.CifError, match=r"'teapot'.*known labels:.*car.*green napkin.*red mug"):
        cif.query_stage(stage_path, "teapot")
