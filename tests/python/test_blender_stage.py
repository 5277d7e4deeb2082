"""The half of the Blender extension that needs no Blender: stages in, layers of edits out."""

from __future__ import annotations

import re
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from small_stage import (
    COUNT,
    FRAMES,
    RED_BAND_0,
    orientations,
    positions,
    scales,
    turned,
    write_stage,
    write_windows,
)

PLUGIN = Path(__file__).resolve().parents[2] / "plugin" / "blender"
sys.path.insert(0, str(PLUGIN))

import build as extension  # noqa: E402
from cif_scene.io import color, edits, read, scene, tracks  # noqa: E402
from cif_scene.io.edits import Edit  # noqa: E402


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_stage(tmp_path / "small.usda")


@pytest.fixture
def small(path: Path) -> scene.Scene:
    return read.read_scene(path)


def by_name(small: scene.Scene) -> dict[str, scene.Instance]:
    return {instance.name: instance for instance in small.instances}


def test_stage_as_a_whole(small: scene.Scene) -> None:
    assert (small.start, small.end, small.frames_per_second) == (0, FRAMES - 1, 12)
    assert (small.up_axis, small.meters_per_unit) == ("Z", 1)
    assert small.background_color == (0.5, 0.25, 1)
    assert [instance.name for instance in small.instances] == [
        "red_mug_001",
        "toy_car_002",
        "box_003",
        "green_napkin_007",
        "ball_008",
        "background",
    ]
    assert small.warnings == []


def test_labels_and_ids(small: scene.Scene) -> None:
    mug = by_name(small)["red_mug_001"]
    assert (mug.label, mug.display_name, mug.instance) == ("mug", "red mug", "red_mug_001")
    assert mug.data == {"id": 1, "motion_model": "rigid", "sourceFrames_first": 0, "sourceFrames_last": 8}
    assert by_name(small)["background"].data == {}


def test_splats_come_as_authored(small: scene.Scene) -> None:
    splats = by_name(small)["red_mug_001"].pieces[0].splats
    assert splats.count == COUNT
    np.testing.assert_allclose(splats.positions, positions(1), atol=1e-7)
    np.testing.assert_allclose(splats.scales, scales(1), rtol=1e-6)
    np.testing.assert_allclose(splats.rotations, orientations(1), atol=1e-6)
    np.testing.assert_allclose(splats.harmonics[:, 0], np.tile(RED_BAND_0, (COUNT, 1)), rtol=1e-6)
    assert splats.harmonics.shape == (COUNT, 4, 3)
    assert splats.samples is None


def test_tracks(small: scene.Scene) -> None:
    car = by_name(small)["toy_car_002"].track
    middle = car.matrices(np.array([2.5]))[0]
    np.testing.assert_allclose(middle[:3, 3], [0.25, -0.4, 0], atol=1e-6)
    np.testing.assert_allclose(middle[:2, 0], [np.cos(1.0), np.sin(1.0)], atol=1e-6)
    assert not by_name(small)["red_mug_001"].track.moves


def test_parts_move_in_the_frame_of_their_instance(small: scene.Scene) -> None:
    box = by_name(small)["box_003"]
    body, lid = box.pieces
    assert (body.name, lid.name, lid.frame) == ("part_00", "part_01", "/World/box_003/part_01")
    assert body.track.is_identity
    np.testing.assert_allclose(lid.track.matrices(np.array([4.0]))[0][:3, 3], [0, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(lid.track.rotations[4], turned(0.4), atol=1e-6)
    np.testing.assert_allclose(box.track.matrices(np.array([4.0]))[0][:3, 3], [-0.5, 0.4, 0], atol=1e-6)


def test_deforming_splats(small: scene.Scene) -> None:
    samples = by_name(small)["green_napkin_007"].pieces[0].splats.samples
    assert samples is not None
    assert list(samples.codes) == list(range(FRAMES))
    np.testing.assert_allclose(samples.positions[5], positions(5, 5, 2.0), atol=1e-6)
    assert samples.scales is None


def test_visibility_keeps_changes_only(small: scene.Scene) -> None:
    ball = by_name(small)["ball_008"].visibility
    assert list(ball.codes) == [0, 3]
    assert list(ball.visible) == [False, True]
    assert len(by_name(small)["red_mug_001"].visibility.codes) == 1


def test_cameras(small: scene.Scene) -> None:
    (camera,) = small.cameras
    assert camera.size == (64, 48)
    np.testing.assert_allclose(camera.focal, [0.5])
    np.testing.assert_allclose(camera.shift, [[0.05, 0]], atol=1e-7)
    np.testing.assert_allclose(camera.track.translations[8], [0, 0, 2.8])


def test_without_arrays_poses_are_the_same(path: Path, small: scene.Scene) -> None:
    light = read.read_scene(path, arrays=False)
    assert light.instances[0].pieces[0].splats.count == 0
    np.testing.assert_array_equal(light.instances[1].track.rotations, small.instances[1].track.rotations)


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (r"float\[\] opacities = \[0.8, ", "float[] opacities = [", "opacities has 19 values for 20 positions"),
        (r"HarmonicsDegree = 1", "HarmonicsDegree = 7", "is 7"),
        (r"quatf\[\] orientations = \[\([^)]*\)", "quatf[] orientations = [(0, 0, 0, 0)", "length 0"),
        (r"float3\[\] scales = \[\([^)]*\)", "float3[] scales = [(nan, 1, 1)", "not finite"),
        (r"point3f\[\] positions = ", "point3f[] places = ", "positions has no value"),
        (r"elementSize = 4", "elementSize = 1", None),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(
    tmp_path: Path, pattern: str, replacement: str, message: str | None
) -> None:
    path = write_stage(tmp_path / "bad.usda")
    text = path.read_text()
    changed = re.sub(pattern, replacement, text, count=1)
    assert changed != text
    path.write_text(changed)
    if message is None:  # the element size is a hint for viewers; the lengths count
        read.read_scene(path)
        return
    with pytest.raises(read.StageError, match=message) as caught:
        read.read_scene(path)
    assert "/World/red_mug_001/Splats" in str(caught.value)


def test_files_that_are_no_stages(tmp_path: Path) -> None:
    with pytest.raises(read.StageError, match="no such file"):
        read.read_scene(tmp_path / "missing.usda")
    broken = tmp_path / "broken.usda"
    broken.write_text("not a stage")
    with pytest.raises(read.StageError, match=r"broken\.usda"):
        read.read_scene(broken)
    empty = tmp_path / "empty.usda"
    empty.write_text('#usda 1.0\ndef Xform "World" {}\n')
    with pytest.raises(read.StageError, match="holds no ParticleField3DGaussianSplat"):
        read.read_scene(empty)


def test_stand_ins_and_guides_are_left_out(path: Path) -> None:
    whole = by_name(read.read_scene(path))
    text = path.read_text()
    head = 'def ParticleField3DGaussianSplat "Splats"'
    for purpose, count in (("proxy", len(whole) - 1), ("guide", len(whole) - 1), ("render", len(whole))):
        at = text.index("{", text.index(head)) + 1
        path.write_text(f'{text[:at]}\nuniform token purpose = "{purpose}"\n{text[at:]}')
        assert len(read.read_scene(path).instances) == count, purpose


def test_damaged_values_are_one_clear_error(path: Path) -> None:
    text = path.read_text()
    number = "double semantics:labels:class = 3"
    changed, count = re.subn(r"token\[\] semantics:labels:class = .*", number, text)
    assert count
    path.write_text(changed)
    with pytest.raises(read.StageError, match=r"small\.usda: it is damaged"):
        read.read_scene(path)
    label = rb'semantics:labels:class = \["\w+'
    changed, count = re.subn(label, lambda found: found[0] + bytes([255, 254]), text.encode())
    assert count
    path.with_name("text.usda").write_bytes(changed)
    with pytest.raises(read.StageError, match=r"text\.usda"):
        read.read_scene(path.with_name("text.usda"))


def test_colour_curves_are_inverse() -> None:
    values = np.linspace(0, 2, 41)
    np.testing.assert_allclose(color.display_from_linear(color.linear_from_display(values)), values, atol=1e-9)
    np.testing.assert_allclose(color.linear_from_display(np.array(0.5)), 0.21404114, atol=1e-7)


def test_decomposition_inverts_composition() -> None:
    chance = np.random.default_rng(3)
    rotations = chance.normal(size=(50, 4))
    rotations = tracks.one_hemisphere(rotations / np.linalg.norm(rotations, axis=1, keepdims=True))
    track = tracks.Track(
        np.arange(50.0), chance.normal(size=(50, 3)), rotations, chance.uniform(0.2, 3, (50, 3)) * [-1, 1, 1]
    )
    matrices = track.matrices(track.codes)
    back = tracks.from_matrices(track.codes, matrices)
    np.testing.assert_allclose(back.matrices(track.codes), matrices, atol=1e-12)
    np.testing.assert_allclose(back.scales, track.scales, atol=1e-12)
    assert tracks.shear(matrices) < 1e-12
    sheared = matrices.copy()
    sheared[0, :3, 1] += sheared[0, :3, 0]
    assert tracks.shear(sheared) > 0.1


def test_refined_keys_follow_the_turn() -> None:
    wide = tracks.Track(
        np.array([0.0, 10.0]), np.zeros((2, 3)), np.array([turned(0), turned(2.5)]), np.ones((2, 3))
    )
    refined = wide.refined()
    assert list(refined.codes) == list(range(11))
    codes = np.linspace(0, 10, 101)
    # What a tool shows that interpolates components and normalises.
    shown = np.stack([np.interp(codes, refined.codes, refined.rotations[:, i]) for i in range(4)], -1)
    shown /= np.linalg.norm(shown, axis=1, keepdims=True)
    expected = wide.matrices(codes)[:, :3, :3]
    assert np.abs(tracks.rotation_matrices(shown) - expected).max() < 1e-3
    coarse = np.stack([np.interp(codes, wide.codes, wide.rotations[:, i]) for i in range(4)], -1)
    coarse /= np.linalg.norm(coarse, axis=1, keepdims=True)
    assert np.abs(tracks.rotation_matrices(coarse) - expected).max() > 0.02


def test_thinned_keeps_what_is_needed() -> None:
    codes = np.arange(21.0)
    places = np.c_[np.where(codes < 10, codes, 20 - codes), np.zeros((21, 2))]
    track = tracks.Track(codes, places, np.tile([1.0, 0, 0, 0], (21, 1)), np.ones((21, 3)))
    thin = tracks.thinned(track)
    assert list(thin.codes) == [0, 10, 20]
    np.testing.assert_allclose(thin.matrices(codes), track.matrices(codes), atol=1e-6)
    still = tracks.Track(codes, 0 * places, track.rotations, track.scales)
    assert len(tracks.thinned(still).codes) == 1


def moved(track: tracks.Track, by: tuple[float, float, float]) -> tracks.Track:
    return tracks.Track(track.codes, track.translations + by, track.rotations, track.scales)


def test_edits_come_back_through_the_layer(path: Path, small: scene.Scene) -> None:
    found = by_name(small)
    mug, car, box = (found[name] for name in ("red_mug_001", "toy_car_002", "box_003"))
    lid = box.pieces[1]
    out = edits.write_edits(
        path,
        path.with_name("edits.usda"),
        [
            Edit(mug.path, track=moved(mug.track, (0, 0, 0.25)), display_name="blue mug"),
            Edit(car.path, copy_name="toy_car_002.001", track=moved(car.track, (0, 1, 0)), label="racer"),
            Edit(box.path, parts=[Edit(lid.frame, track=moved(lid.track, (0, 0, 0.1)))]),
            Edit(found["green_napkin_007"].path, deleted=True),
            Edit(
                found["background"].path,
                visibility=scene.Visibility(np.array([0.0]), np.array([False])),
            ),
        ],
    )
    edited = by_name(read.read_scene(out))
    assert set(edited) == set(found) - {"green_napkin_007"} | {"toy_car_002_001"}
    assert (edited["red_mug_001"].display_name, edited["red_mug_001"].label) == ("blue mug", "mug")
    np.testing.assert_allclose(
        edited["red_mug_001"].track.translations, mug.track.translations + np.array([0, 0, 0.25])
    )
    copy = edited["toy_car_002_001"]
    assert (copy.label, copy.display_name, copy.instance) == ("racer", "toy car", "toy_car_002_001")
    codes = np.linspace(0, 8, 33)
    shift = copy.track.matrices(codes) - car.track.matrices(codes)
    assert np.abs(shift[:, :3, 3] - [0, 1, 0]).max() < 1e-5
    assert np.abs(shift[:, :3, :3]).max() < 1e-5
    assert copy.pieces[0].splats.count == COUNT
    np.testing.assert_allclose(edited["toy_car_002"].track.matrices(codes), car.track.matrices(codes))
    np.testing.assert_allclose(
        edited["box_003"].pieces[1].track.translations[0], lid.track.translations[0] + [0, 0, 0.1], atol=1e-6
    )
    assert not edited["background"].visibility.visible.any()
    # The stage itself is as it was.
    assert by_name(read.read_scene(path))["red_mug_001"].display_name == "red mug"


def test_semantics_follow_a_new_name(path: Path) -> None:
    from pxr import Usd

    out = edits.write_edits(
        path, path.with_name("e.usda"), [Edit("/World/red_mug_001", display_name="blue mug")]
    )
    stage = Usd.Stage.Open(str(out))
    prim = stage.GetPrimAtPath("/World/red_mug_001")
    assert list(prim.GetAttribute("semantics:labels:class").Get()) == ["mug", "blue mug"]
    assert prim.GetDisplayName() == "blue mug"
    assert prim.GetAttribute("userProperties:label").Get() == "blue mug"


def test_colours_go_over_splats_that_have_no_display_colours(path: Path) -> None:
    from pxr import Usd

    splats = "/World/red_mug_001/Splats"
    green = edits.Colors(np.array([2]), np.array([[0.0, 1.0, 0.25]], np.float32))
    out = edits.write_edits(
        path, path.with_name("e.usda"), [Edit("/World/red_mug_001", colors={splats: green})]
    )
    stage = Usd.Stage.Open(str(out))
    shown = np.array(stage.GetPrimAtPath(splats).GetAttribute("primvars:displayColor").Get())
    np.testing.assert_allclose(shown[2], [0, 1, 0.25])
    red = np.clip(0.5 + color.BAND_0 * np.array(RED_BAND_0), 0, None)
    np.testing.assert_allclose(np.delete(shown, 2, 0), [red] * (COUNT - 1), atol=1e-6)


def test_a_still_pose_hides_the_recorded_track(path: Path, small: scene.Scene) -> None:
    car = by_name(small)["toy_car_002"]
    still = tracks.Track(np.zeros(1), np.array([[1.0, 2, 3]]), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)))
    out = edits.write_edits(path, path.with_name("e.usdc"), [Edit(car.path, track=still)])
    after = by_name(read.read_scene(out))["toy_car_002"].track
    np.testing.assert_allclose(after.matrices(np.array([0.0, 5.0]))[:, :3, 3], [[1, 2, 3]] * 2)


def test_poses_go_into_the_frame_of_the_parent(tmp_path: Path) -> None:
    path = write_stage(tmp_path / "small.usda")
    path.write_text(
        path.read_text().replace(
            'def Xform "World" (kind = "assembly")\n{',
            'def Xform "World" (kind = "assembly")\n{\ndouble3 xformOp:translate = (0, 0, 7)\n'
            'uniform token[] xformOpOrder = ["xformOp:translate"]\n',
        )
    )
    mug = by_name(read.read_scene(path))["red_mug_001"]
    np.testing.assert_allclose(mug.track.translations[0], [0.5, 0, 7.1])
    out = edits.write_edits(path, tmp_path / "e.usda", [Edit(mug.path, track=moved(mug.track, (1, 0, 0)))])
    after = by_name(read.read_scene(out))["red_mug_001"]
    np.testing.assert_allclose(after.track.translations[0], [1.5, 0, 7.1])


def test_nothing_of_others_is_overwritten(path: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.usda"
    foreign.write_text("#usda 1.0\n")
    with pytest.raises(read.StageError, match="holds no edits"):
        edits.write_edits(path, foreign, [])
    with pytest.raises(read.StageError, match="is the stage itself"):
        edits.write_edits(path, path, [])
    with pytest.raises(read.StageError, match="written as"):
        edits.write_edits(path, tmp_path / "edits.obj", [])
    assert foreign.read_text() == "#usda 1.0\n"
    ours = edits.write_edits(path, tmp_path / "ours.usda", [])
    edits.write_edits(path, ours, [Edit("/World/red_mug_001", deleted=True)])
    assert "red_mug_001" not in by_name(read.read_scene(ours))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["foreign.usda", "ours.usda", "small.usda"]


def test_unknown_prims_are_refused(path: Path) -> None:
    with pytest.raises(read.StageError, match="/World/teapot: is not in the stage"):
        edits.write_edits(path, path.with_name("e.usda"), [Edit("/World/teapot", deleted=True)])
    assert not path.with_name("e.usda").exists()


def test_what_cif_exports_is_read(stage_path: Path) -> None:
    found = by_name(read.read_scene(stage_path))
    assert set(found) == {"red_mug_001", "toy_car_002", "green_napkin_007", "background"}
    assert found["toy_car_002"].track.moves
    assert found["red_mug_001"].pieces[0].splats.samples is None
    assert found["green_napkin_007"].pieces[0].splats.samples is not None


def test_extension_is_whole(tmp_path: Path) -> None:
    archive = extension.build(tmp_path)
    assert archive.read_bytes() == extension.build(tmp_path / "again").read_bytes()
    with zipfile.ZipFile(archive) as opened:
        names = opened.namelist()
        manifest = opened.read("blender_manifest.toml").decode()
    assert {"__init__.py", "blender/importer.py", "io/read.py"} <= set(names)
    assert not [name for name in names if "__pycache__" in name]
    tomllib = pytest.importorskip("tomllib", reason="needs Python 3.11")
    values = tomllib.loads(manifest)
    # Blender refuses a manifest without these.
    assert values["schema_version"] == "1.0.0"
    assert re.fullmatch(r"[a-z][a-z0-9_]+", values["id"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", values["version"])
    assert values["type"] == "add-on"
    assert len(values["tagline"]) <= 64
    assert not values["tagline"].endswith(".")
    assert values["license"] == ["SPDX:Apache-2.0"]
    assert tuple(map(int, values["blender_version_min"].split("."))) >= (4, 5, 0)
    assert set(values["permissions"]) <= {"files", "network", "clipboard", "camera", "microphone"}
    assert all(len(reason) <= 64 and not reason.endswith(".") for reason in values["permissions"].values())
    assert values["maintainer"]
    assert values["name"]


def test_far_scenes_are_worked_on_in_their_own_frame(path: Path, small: scene.Scene, tmp_path: Path) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom

    # As `cif export` writes captures far from their origin and in other units.
    far = tmp_path / "far.usda"
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.Export(str(far))
    layer = Sdf.Layer.FindOrOpen(str(far))
    layer.customLayerData = {"cif": {"captureOffset": Gf.Vec3d(3e6, -2e5, 40), "captureScale": 0.01}}
    stage = Usd.Stage.Open(layer)
    root = UsdGeom.Xformable(stage.GetPrimAtPath("/World"))
    root.AddTranslateOp().Set(Gf.Vec3d(3e6, -2e5, 40))
    root.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(100, 100, 100))
    layer.Save()

    read_far = read.read_scene(far)
    for near, other in zip(small.instances, read_far.instances, strict=True):
        np.testing.assert_allclose(other.track.translations, near.track.translations, atol=1e-8)
        np.testing.assert_allclose(other.track.scales, near.track.scales, atol=1e-8)
    for near, other in zip(small.cameras, read_far.cameras, strict=True):
        np.testing.assert_allclose(other.track.translations, near.track.translations, atol=1e-8)

    # What is moved there moves in the frame of the root, which stays.
    mug = by_name(read_far)["red_mug_001"]
    lifted = mug.track.matrices(np.zeros(1))
    lifted[:, :3, 3] += [0, 0, 0.25]
    edit = Edit(path=mug.path, track=tracks.from_matrices(np.zeros(1), lifted))
    out = edits.write_edits(far, tmp_path / "edits.usda", [edit])
    moved = by_name(read.read_scene(out))["red_mug_001"].track
    np.testing.assert_allclose(moved.translations[0], mug.track.translations[0] + [0, 0, 0.25], atol=1e-8)
    opened = Usd.Stage.Open(str(out))
    world = UsdGeom.XformCache().GetLocalToWorldTransform(opened.GetPrimAtPath(mug.path))
    np.testing.assert_allclose(
        np.array(world.ExtractTranslation()),
        np.array([3e6, -2e5, 40]) + 100 * (mug.track.translations[0] + [0, 0, 0.25]),
        atol=1e-6,
    )


def test_windows_of_a_long_capture_are_pieces_that_show_one_after_the_other(tmp_path: Path) -> None:
    (mug,) = read.read_scene(write_windows(tmp_path)).instances
    first, second = mug.pieces
    assert (first.name, second.name) == ("window_1", "window_2")
    assert (first.splats.count, second.splats.count) == (20, 12)
    assert first.splats.samples is None
    np.testing.assert_array_equal(second.splats.samples.codes, [5, 8])
    np.testing.assert_allclose(second.splats.samples.positions[1][:, 2], 0.3, rtol=1e-6)
    assert mug.track.moves

    def shown(piece: scene.Piece) -> list[bool]:
        codes = piece.visibility.codes
        return [
            bool(piece.visibility.visible[max(np.searchsorted(codes, code, side="right") - 1, 0)])
            for code in range(9)
        ]

    assert shown(first) == [code in (2, 3, 4) for code in range(9)]
    assert shown(second) == [code >= 5 for code in range(9)]
