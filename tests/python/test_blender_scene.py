"""The half of the Blender extension that needs Blender: objects from a stage, and edits from objects.

Runs in environments with the `bpy` wheel, each Blender with its own Python: see tests/README.md.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_stage import COUNT, FRAMES, positions, turned, write_stage, write_windows

bpy = pytest.importorskip("bpy", reason="Blender is not installed here: see tests/README.md")
bpy.utils.expose_bundled_modules()
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "plugin" / "blender"))

import cif_scene  # noqa: E402
import import_cif  # noqa: E402
from cif_scene.blender import exporter, interface  # noqa: E402


@pytest.fixture
def path(tmp_path: Path) -> Path:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return write_stage(tmp_path / "small.usda")


@pytest.fixture
def objects(path: Path) -> dict[str, bpy.types.Object]:
    return {obj.name: obj for obj in import_cif.import_stage(path)}


@pytest.fixture
def registered() -> Iterator[None]:
    cif_scene.register()
    yield
    cif_scene.unregister()


def reread(path: Path) -> dict:
    from cif_scene.io.read import read_scene

    return {instance.name: instance for instance in read_scene(path).instances}


def at_frame(frame: float) -> bpy.types.Depsgraph:
    whole = int(np.floor(frame))
    bpy.context.scene.frame_set(whole, subframe=frame - whole)
    return bpy.context.evaluated_depsgraph_get()


def world(obj: bpy.types.Object, frame: float) -> np.ndarray:
    return np.array(obj.evaluated_get(at_frame(frame)).matrix_world)


def ellipsoids(obj: bpy.types.Object, frame: float) -> np.ndarray:
    """Matrices of the drawn ellipsoids in the frame of the object."""
    evaluated = obj.evaluated_get(at_frame(frame)).evaluated_geometry()  # owns what follows
    cloud = evaluated.instances_pointcloud()
    attribute = cloud.attributes["instance_transform"]
    flat = np.empty(len(attribute.data) * 16, np.float32)
    attribute.data.foreach_get("value", flat)
    return flat.reshape(-1, 4, 4).transpose(0, 2, 1)


def drawn(obj: bpy.types.Object, name: str, size: int, frame: float = 0) -> np.ndarray:
    evaluated = obj.evaluated_get(at_frame(frame)).evaluated_geometry()  # owns what follows
    cloud = evaluated.instances_pointcloud()
    attribute = cloud.attributes[name]
    flat = np.empty(len(attribute.data) * size, np.float32)
    attribute.data.foreach_get("vector" if size == 3 else "value", flat)
    return flat.reshape(-1, size)


def test_objects_and_collections(objects: dict) -> None:
    assert set(objects) == {
        "small",
        "red_mug_001",
        "toy_car_002",
        "box_003",
        "box_003.part_00",
        "box_003.part_01",
        "green_napkin_007",
        "ball_008",
        "background",
        "camera_0",
    }
    labels = {"mug", "car", "box", "napkin", "ball", "background", "Cameras"}
    assert {child.name for child in bpy.data.collections["small"].children} == labels
    mug = objects["red_mug_001"]
    assert [mug[key] for key in ("label", "display_name", "instance", "prim_path", "id")] == [
        "mug",
        "red mug",
        "red_mug_001",
        "/World/red_mug_001",
        1,
    ]
    assert mug.users_collection[0].name == "mug"


def test_scene_settings(objects: dict) -> None:
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end) == (0, FRAMES - 1)
    assert scene.render.fps / scene.render.fps_base == 12
    assert (scene.render.resolution_x, scene.render.resolution_y) == (64, 48)
    assert scene.camera == objects["camera_0"]
    color = scene.world.node_tree.nodes["Background"].inputs["Color"].default_value
    np.testing.assert_allclose(color[:3], [0.214041, 0.050876, 1], atol=1e-5)


def test_motion_is_as_recorded_between_keys_too(objects: dict) -> None:
    for frame in (0, 2.5, 7, 8):
        turn = 0.4 * frame
        matrix = world(objects["toy_car_002"], frame)
        np.testing.assert_allclose(matrix[:3, 3], [0.1 * frame, -0.4, 0], atol=1e-5)
        np.testing.assert_allclose(matrix[:2, 0], [np.cos(turn), np.sin(turn)], atol=1e-4)
        lid = world(objects["box_003.part_01"], frame)
        np.testing.assert_allclose(lid[:3, 3], [-0.5, 0.1 * frame, 0.2], atol=1e-5)
        np.testing.assert_allclose(lid[:2, 0], [np.cos(turn / 4), np.sin(turn / 4)], atol=1e-4)


def test_deforming_splats_follow_their_samples(objects: dict) -> None:
    napkin = objects["green_napkin_007"]
    for frame in (0, 3, 8):
        np.testing.assert_allclose(ellipsoids(napkin, frame)[:, :3, 3], positions(5, frame, 2.0), atol=1e-6)
    between = (positions(5, 3, 2.0) + positions(5, 4, 2.0)) / 2
    np.testing.assert_allclose(ellipsoids(napkin, 3.5)[:, :3, 3], between, atol=1e-6)


def test_fading_splats_follow_their_samples(path: Path) -> None:
    first, last = np.full(COUNT, 0.1), np.linspace(0.2, 0.9, COUNT)
    samples = ", ".join(
        f"{code}: [{', '.join(str(value) for value in values)}]" for code, values in ((2, first), (6, last))
    )
    text = path.read_text()
    text = text.replace(
        "float[] opacities", f"float[] opacities.timeSamples = {{ {samples} }}\nfloat[] opacities", 1
    )
    path.write_text(text)
    objects = {obj.name: obj for obj in import_cif.import_stage(path)}
    for frame, expected in ((0, first), (2, first), (5, 0.25 * first + 0.75 * last), (6, last), (8, last)):
        opacity = drawn(objects["red_mug_001"], "splat_opacity", 1, frame)[:, 0]
        np.testing.assert_allclose(opacity, expected, atol=1e-6)
    others = drawn(objects["green_napkin_007"], "splat_opacity", 1, 5)
    np.testing.assert_allclose(others, 0.8, atol=1e-6)


def test_ellipsoids_are_the_gaussians(path: Path) -> None:
    from cif_scene.io.read import read_scene
    from cif_scene.io.tracks import rotation_matrices

    objects = {obj.name: obj for obj in import_cif.import_stage(path, training_blur=False)}
    splats = read_scene(path).instances[0].pieces[0].splats
    matrices = ellipsoids(objects["red_mug_001"], 0)
    assert len(matrices) == COUNT
    np.testing.assert_allclose(matrices[:, :3, 3], splats.positions, atol=1e-6)
    cutoff = np.sqrt(2 * np.log(255 * 0.8))
    axes = rotation_matrices(splats.rotations) * splats.scales[:, None, :] * cutoff
    np.testing.assert_allclose(matrices[:, :3, :3], axes, atol=1e-6)


def test_training_blur_widens_by_the_pixel(objects: dict, path: Path) -> None:
    from cif_scene.io.read import read_scene
    from cif_scene.io.tracks import rotation_matrices

    splats = read_scene(path).instances[0].pieces[0].splats
    turn = rotation_matrices(np.array([turned(0.3)]))[0]
    heights = (splats.positions @ turn.T)[:, 2] + 0.1
    pixel = (2.0 - heights) / 32  # focal length in pixels: half the width
    matrices = ellipsoids(objects["red_mug_001"], 0)[:, :3, :3] / np.sqrt(2 * np.log(255 * 0.8))
    covariances = matrices @ matrices.transpose(0, 2, 1)
    axes = rotation_matrices(splats.rotations) * splats.scales[:, None, :]
    expected = axes @ axes.transpose(0, 2, 1) + 0.3 * (pixel**2)[:, None, None] * np.eye(3)
    np.testing.assert_allclose(covariances, expected, atol=1e-7)


def test_colour_depends_on_the_view(path: Path) -> None:
    from cif_scene.io.color import BAND_0, linear_from_display
    from cif_scene.io.read import read_scene

    text = path.read_text().replace("float3[] radiance", "# float3[] radiance")
    coefficients = np.random.default_rng(0).normal(0, 0.4, (COUNT, 16, 3))
    listed = ", ".join(f"({r}, {g}, {b})" for r, g, b in coefficients.reshape(-1, 3))
    start = text.index("# float3[] radiance")
    end = text.index(")\n}", start)
    text = (
        text[:start]
        + f"float3[] radiance:sphericalHarmonicsCoefficients = [{listed}] (elementSize = 16"
        + text[end:]
    )
    text = text.replace("HarmonicsDegree = 1", "HarmonicsDegree = 3", 1).replace("# float3[]", "float3[]")
    path.write_text(text)
    objects = {obj.name: obj for obj in import_cif.import_stage(path)}
    splats = read_scene(path).instances[0].pieces[0].splats
    matrix = world(objects["red_mug_001"], 0)
    eye = np.linalg.inv(matrix) @ [0, 0, 2, 1]
    x, y, z = ((splats.positions - eye[:3]) / np.linalg.norm(splats.positions - eye[:3], axis=1)[:, None]).T
    # Associated Legendre functions, not the polynomials that the nodes hold.
    basis = [_harmonic(degree, order, x, y, z) for degree in range(4) for order in range(-degree, degree + 1)]
    display = np.maximum(0.5 + np.einsum("kn,nkc->nc", basis, splats.harmonics), 0)
    np.testing.assert_allclose(
        drawn(objects["red_mug_001"], "splat_color", 3), linear_from_display(display), atol=2e-5
    )
    assert basis[0][0] == pytest.approx(BAND_0)


def _harmonic(degree: int, order: int, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Real spherical harmonic with the Condon-Shortley sign, from its definition."""
    from math import factorial, pi, sqrt

    m = abs(order)
    # (-1)^m P_l^m / sin^m by differentiating the Legendre polynomial.
    legendre = np.polynomial.legendre.Legendre.basis(degree).convert(kind=np.polynomial.Polynomial)
    value = (-1) ** m * legendre.deriv(m)(z) if m else legendre(z)
    norm = sqrt((2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m))
    if m:
        around = ((x + 1j * y) ** m).real if order > 0 else ((x + 1j * y) ** m).imag
        value, norm = value * around, norm * sqrt(2)
    return np.broadcast_to(norm * value, x.shape)


def test_visibility_is_animated(objects: dict) -> None:
    ball = objects["ball_008"]
    for frame, hidden in ((0, True), (2, True), (3, False), (8, False)):
        at_frame(frame)
        assert (ball.hide_render, ball.hide_viewport) == (hidden, hidden)


def test_up_axis_and_unit(tmp_path: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    path = write_stage(tmp_path / "small.usda", up_axis="Y", meters_per_unit=0.01)
    objects = {obj.name: obj for obj in import_cif.import_stage(path)}
    np.testing.assert_allclose(world(objects["toy_car_002"], 8)[:3, 3], [0.008, 0, -0.004], atol=1e-7)
    assert exporter.collect_edits(path) == []


def test_untouched_scene_has_no_edits(objects: dict, path: Path) -> None:
    assert exporter.collect_edits(path) == []


def test_edits_by_hand_come_back(objects: dict, path: Path) -> None:
    before = reread(path)
    mug, car, lid = (objects[name] for name in ("red_mug_001", "toy_car_002", "box_003.part_01"))
    mug.location.z += 0.25
    mug["display_name"] = "blue mug"
    objects["background"].name = "studio"
    copy = car.copy()
    bpy.data.collections["car"].objects.link(copy)
    copy.location.y += 1
    copy["label"] = "racer"
    lid.location.z += 0.1
    bpy.data.objects.remove(objects["green_napkin_007"])
    objects["ball_008"].hide_set(True)
    out = import_cif.export_edits(path, path.with_name("edits.usda"))
    assert objects["ball_008"].hide_get()
    after = reread(out)
    assert set(after) == set(before) - {"green_napkin_007"} | {"toy_car_002_001"}
    codes = np.linspace(0, 8, 17)

    def shift(name: str, source: str) -> np.ndarray:
        return after[name].track.matrices(codes) - before[source].track.matrices(codes)

    np.testing.assert_allclose(shift("red_mug_001", "red_mug_001")[:, :3, 3], [[0, 0, 0.25]] * 17, atol=1e-6)
    np.testing.assert_allclose(shift("toy_car_002_001", "toy_car_002")[:, :3, 3], [[0, 1, 0]] * 17, atol=1e-5)
    assert np.abs(shift("toy_car_002_001", "toy_car_002")[:, :3, :3]).max() < 1e-4
    assert np.abs(shift("toy_car_002", "toy_car_002")).max() == 0
    assert after["red_mug_001"].display_name == "blue mug"
    assert after["background"].display_name == "studio"
    assert (after["toy_car_002_001"].label, after["toy_car_002"].label) == ("racer", "car")
    assert not after["ball_008"].visibility.visible.any()
    part = after["box_003"].pieces[1].track.matrices(codes) - before["box_003"].pieces[1].track.matrices(codes)
    np.testing.assert_allclose(part[:, :3, 3], [[0, 0, 0.1]] * 17, atol=1e-5)


def test_recoloured_splats_come_back(objects: dict, path: Path) -> None:
    from cif_scene.blender import nodes
    from cif_scene.io.color import BAND_0, display_from_linear, linear_from_display
    from pxr import Usd, UsdGeom

    mug, car, lid = (objects[name] for name in ("red_mug_001", "toy_car_002", "box_003.part_01"))
    factor = np.array([0.5, 1.0, 2.0])
    nodes.set_input(mug.modifiers["Splats"], nodes.TINT, (*factor, 1.0))
    nodes.set_input(lid.modifiers["Splats"], nodes.TINT, (0.0, 0.0, 0.0, 1.0))
    car.data.attributes["colour"].data[3].color = (0.0, 1.0, 0.25, 1.0)
    copy = objects["ball_008"].copy()
    bpy.data.collections["ball"].objects.link(copy)
    nodes.set_input(copy.modifiers["Splats"], nodes.TINT, (1.0, 0.0, 1.0, 1.0))
    edits = {(edit.path, edit.copy_name): edit for edit in exporter.collect_edits(path)}
    assert set(edits) == {
        ("/World/red_mug_001", None),
        ("/World/toy_car_002", None),
        ("/World/box_003", None),
        ("/World/ball_008", copy.name),
    }
    assert all(edit.track is None for edit in edits.values()), "nothing moved"
    stage = Usd.Stage.Open(str(import_cif.export_edits(path, path.with_name("edits.usda"))))
    red = np.clip(0.5 + BAND_0 * np.array([1.2, -1.0, -1.2]), 0, None)

    def colors(prim: str) -> np.ndarray:
        primvar = UsdGeom.Primvar(stage.GetPrimAtPath(f"/World/{prim}").GetAttribute("primvars:displayColor"))
        assert primvar.GetInterpolation() == "vertex"
        return np.array(primvar.ComputeFlattened())

    expected = display_from_linear(linear_from_display(red) * factor)
    np.testing.assert_allclose(colors("red_mug_001/Splats"), [expected] * COUNT, atol=1e-5)
    painted = colors("toy_car_002/Splats")
    np.testing.assert_allclose(painted[3], display_from_linear(np.array([0, 1, 0.25])), atol=1e-5)
    np.testing.assert_allclose(np.delete(painted, 3, 0), [red] * (COUNT - 1), atol=1e-6)
    part = reread(path)["box_003"].pieces[1].path
    np.testing.assert_allclose(colors(part.removeprefix("/World/")), 0, atol=1e-6)
    np.testing.assert_allclose(colors("ball_008_001/Splats")[:, 1], 0, atol=1e-6)
    # White again: nothing is left of it.
    for obj in (mug, lid):
        nodes.set_input(obj.modifiers["Splats"], nodes.TINT, (1.0, 1.0, 1.0, 1.0))
    assert {edit.path for edit in exporter.collect_edits(path)} == {"/World/toy_car_002", "/World/ball_008"}
    # Colours of other vertices mean nothing.
    car.data.attributes.remove(car.data.attributes["colour"])
    with pytest.raises(exporter.EditError, match="'colour'"):
        exporter.collect_edits(path)


def test_a_tint_shows(objects: dict) -> None:
    from cif_scene.blender import material, nodes

    mug = objects["red_mug_001"]
    before = drawn(mug, material.COLOR, 3)
    nodes.set_input(mug.modifiers["Splats"], nodes.TINT, (0.5, 1.0, 0.25, 1.0))
    mug.update_tag()
    np.testing.assert_allclose(drawn(mug, material.COLOR, 3), before * [0.5, 1.0, 0.25], atol=1e-6)


def test_panel_shows_the_tint(objects: dict) -> None:
    from cif_scene.blender import nodes

    nodes.set_input(objects["red_mug_001"].modifiers["Splats"], nodes.TINT, (0.5, 1.0, 0.25, 1.0))
    # A layout that keeps what it is to show: a struct and a path in it.
    shown: list[tuple[bpy.types.bpy_struct, str]] = []
    ignored = lambda *_, **__: SimpleNamespace()  # noqa: E731
    layout = SimpleNamespace(prop=lambda owner, path, text: shown.append((owner, path)), operator=ignored)
    layout.row, layout.box, layout.label = lambda **_: layout, lambda: layout, ignored
    panel = SimpleNamespace(layout=layout, _button=ignored, _buttons=ignored)
    interface.CifPanel.draw(panel, bpy.context)
    tints = {owner.id_data.name: owner.path_resolve(path) for owner, path in shown if "name" not in path}
    assert {name: tuple(tint) for name, tint in tints.items()} == {
        "red_mug_001": (0.5, 1.0, 0.25, 1.0),
        "toy_car_002": (1.0, 1.0, 1.0, 1.0),
        "green_napkin_007": (1.0, 1.0, 1.0, 1.0),
        "ball_008": (1.0, 1.0, 1.0, 1.0),
        "background": (1.0, 1.0, 1.0, 1.0),
    }


def test_edits_survive_saving(objects: dict, path: Path, tmp_path: Path) -> None:
    objects["toy_car_002"].rotation_quaternion = turned(0.5)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    after = reread(import_cif.export_edits(path, tmp_path / "edits.usda"))["toy_car_002"].track
    # Turned about itself: the path stays, the recorded turn goes on from there.
    matrices = after.matrices(np.array([0.0, 8.0]))
    np.testing.assert_allclose(matrices[1, :3, 3], [0.8, -0.4, 0], atol=1e-5)
    np.testing.assert_allclose(matrices[:, 0, 0], [np.cos(0.5), np.cos(3.7)], atol=1e-4)


def test_moving_the_whole_import_is_no_edit(objects: dict, path: Path) -> None:
    objects["small"].location = (3, 2, 1)
    objects["small"].rotation_quaternion = turned(0.7)
    assert exporter.collect_edits(path) == []


def test_blender_itself_imports_stand_ins(path: Path) -> None:
    bpy.ops.wm.usd_import(filepath=str(path), import_proxy=True)
    shown = [
        (each.object.original, each.matrix_world.translation.copy())
        for each in at_frame(0).object_instances
        if each.is_instance and each.parent.name == "Proxy"
    ]
    assert [(cloud.type, cloud.name) for cloud, _ in shown] == [("POINTCLOUD", "Points")]
    cloud, place = shown[0]
    np.testing.assert_allclose(place, [0.5, 0, 0.1], atol=1e-6)
    points = cloud.data.attributes
    found = np.empty(3 * COUNT, np.float32)
    points["position"].data.foreach_get("vector", found)
    np.testing.assert_allclose(found.reshape(-1, 3), positions(1), atol=1e-6)
    assert {point.value for point in points["radius"].data} == {np.float32(0.02)}
    np.testing.assert_allclose(points["displayColor"].data[0].color[:3], [0.8, 0.2, 0.2], atol=1e-6)


def test_scene_without_import_is_refused(path: Path) -> None:
    with pytest.raises(exporter.EditError, match="no CIF scene"):
        import_cif.export_edits(path, path.with_name("edits.usda"))


def test_operators(registered: None, path: Path) -> None:
    assert bpy.ops.import_scene.cif(filepath=str(path)) == {"FINISHED"}
    objects = bpy.data.objects
    bpy.ops.object.cif_instance(action="SELECT", label="box")
    assert [obj.name for obj in bpy.context.selected_objects] == ["box_003"]
    bpy.ops.object.cif_instance(action="HIDE", target="box_003")
    assert objects["box_003.part_01"].hide_get()
    assert objects["box_003.part_01"].hide_render
    bpy.ops.object.cif_instance(action="HIDE", target="box_003")
    assert not objects["box_003.part_01"].hide_get()
    bpy.ops.object.cif_instance(action="ISOLATE", label="mug")
    assert [obj.name for obj in interface.instances(bpy.context) if not obj.hide_get()] == ["red_mug_001"]
    bpy.ops.object.cif_instance(action="ISOLATE", label="mug")
    assert not any(obj.hide_get() for obj in interface.instances(bpy.context))
    objects["red_mug_001"].location.x += 1
    out = path.with_name("edits.usda")
    assert bpy.ops.export_scene.cif_edits(filepath=str(out)) == {"FINISHED"}
    np.testing.assert_allclose(reread(out)["red_mug_001"].track.translations[0], [1.5, 0, 0.1], atol=1e-6)


def test_showing_again_keeps_recorded_visibility(registered: None, path: Path) -> None:
    bpy.ops.import_scene.cif(filepath=str(path))
    for _ in range(2):
        bpy.ops.object.cif_instance(action="HIDE", target="ball_008")
    assert exporter.collect_edits(path) == []


def test_operator_names_what_is_wrong(registered: None, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="no such file"):
        bpy.ops.import_scene.cif(filepath=str(tmp_path / "missing.usda"))


def cycles_frame(path: Path) -> np.ndarray:
    """The current frame as [48, 64, 3], top row first, one sample at the centre of every pixel."""
    scene = bpy.context.scene
    scene.cycles.device, scene.cycles.samples = "CPU", 1
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    return np.array(image.pixels[:]).reshape(48, 64, 4)[::-1, :, :3]


def splatted(path: Path, frame: float) -> np.ndarray:
    """The same frame by the definition: projected Gaussians blended front to back, display-referred."""
    from cif_scene.io.color import BAND_0
    from cif_scene.io.read import read_scene
    from cif_scene.io.tracks import rotation_matrices

    scene = read_scene(path)
    camera = np.linalg.inv(scene.cameras[0].track.matrices(np.array([frame]))[0])
    code = np.array([frame])
    centres, covariances, colors = [], [], []
    for instance in scene.instances:
        shown = np.searchsorted(instance.visibility.codes, frame, side="right") - 1
        if not instance.visibility.visible[max(shown, 0)]:
            continue
        for piece in instance.pieces:
            matrix = camera @ instance.track.matrices(code)[0] @ piece.track.matrices(code)[0]
            splats = piece.splats
            places = splats.positions if splats.samples is None else splats.samples.positions[int(frame)]
            axes = matrix[:3, :3] @ rotation_matrices(splats.rotations) * splats.scales[:, None, :]
            centres.append(places @ matrix[:3, :3].T + matrix[:3, 3])
            covariances.append(axes @ axes.transpose(0, 2, 1))
            colors.append(np.maximum(0.5 + BAND_0 * splats.harmonics[:, 0], 0))
    p, covariance, color = (np.concatenate(rows) for rows in (centres, covariances, colors))
    focal, depth = 32.0, -p[:, 2]
    zero = 0 * depth
    jacobian = np.array(
        [[focal / depth, zero, focal * p[:, 0] / depth**2], [zero, focal / depth, focal * p[:, 1] / depth**2]]
    )
    jacobian = jacobian.transpose(2, 0, 1)
    flat = jacobian @ covariance @ jacobian.transpose(0, 2, 1) + 0.3 * np.eye(2)
    conics = np.linalg.inv(flat)
    pixel = np.stack(np.meshgrid(np.arange(64) + 0.5 - 32 + 0.05 * 64, 24 - np.arange(48) - 0.5), -1)
    image, clear = np.zeros((48, 64, 3)), np.ones((48, 64))
    for k in np.argsort(depth):
        offset = pixel - focal * p[k, :2] / depth[k]
        alpha = 0.8 * np.exp(-0.5 * np.einsum("yxi,ij,yxj->yx", offset, conics[k], offset))
        alpha[alpha < 1 / 255] = 0
        image += (clear * alpha)[:, :, None] * color[k]
        clear *= 1 - alpha
    return np.clip(image + clear[:, :, None] * [0.5, 0.25, 1], 0, 1)


@pytest.mark.parametrize("frame", [0, 5])
def test_cycles_draws_what_was_trained(path: Path, tmp_path: Path, frame: int) -> None:
    import_cif.import_stage(path, display_blending=True)
    bpy.context.scene.frame_set(frame)
    error = cycles_frame(tmp_path / "frame.png") - splatted(path, frame)
    # 8-bit rounding alone is 0.002; a pixel more or less where a splat ends is 1/255.
    assert np.sqrt((error**2).mean()) < 0.003
    assert np.abs(error).max() < 0.02


def test_cycles_shows_ellipsoids(path: Path, tmp_path: Path) -> None:
    import_cif.import_stage(path, discs=False)
    pixels = cycles_frame(tmp_path / "frame.png")
    # World behind, red splats on it: the mug stands right of the middle; the film's centre is shifted right.
    np.testing.assert_allclose(pixels[45, 60], [0.5, 0.25, 1], atol=0.01)
    red = (pixels[:, :, 0] > 0.6) & (pixels[:, :, 2] < 0.5)
    assert 20 < red.sum() < 1500
    column = round(32 + 32 * 0.5 / 1.9 - 0.05 * 64)
    assert red[20:29, column - 3 : column + 4].any()


def test_windows_show_one_after_the_other(tmp_path: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    objects = {obj.name: obj for obj in import_cif.import_stage(write_windows(tmp_path))}
    pieces = [objects[f"mug_001.window_{number}"] for number in (1, 2)]
    assert [len(piece.data.vertices) for piece in pieces] == [20, 12]
    assert all(piece.parent == objects["mug_001"] for piece in pieces)
    for frame in range(9):
        bpy.context.scene.frame_set(frame)
        shown = [not piece.hide_render for piece in pieces]
        assert shown == [frame in (2, 3, 4), frame >= 5], frame
