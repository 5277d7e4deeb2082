"""Objects of stages by label, time and place, and under other names."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cif
import cif.usd
import numpy as np
import pytest
from conftest import FRAMES
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdSemantics


def names(prims: list[Usd.Prim]) -> list[str]:
    return [prim.GetName() for prim in prims]


def ask(capfd: pytest.CaptureFixture[str], path: Path, *words: object) -> list[dict]:
    assert cif.run(["query", str(path), "--json", *map(str, words)]) == 0
    return json.loads(capfd.readouterr().out)


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A stage that cif did not write: labels, no splats, a label that changes, an object that hides."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "foreign.usda"))
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(10)
    stage.SetTimeCodesPerSecond(20)
    UsdGeom.Xform.Define(stage, "/Set")
    for name, label in [("Chair", "chair"), ("Lamp", "lamp")]:
        cube = UsdGeom.Cube.Define(stage, f"/Set/{name}")
        cube.CreateSizeAttr(2)
        cube.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
        api = UsdSemantics.LabelsAPI.Apply(cube.GetPrim(), "wikidata")
        api.CreateLabelsAttr().Set([label])
    chair = UsdGeom.Xformable(stage.GetPrimAtPath("/Set/Chair")).AddTranslateOp()
    chair.Set(Gf.Vec3d(0, 0, 1))
    chair.Set(Gf.Vec3d(0, 0, 1), 0)
    chair.Set(Gf.Vec3d(10, 0, 1), 10)
    lamp = stage.GetPrimAtPath("/Set/Lamp")
    UsdGeom.Xformable(lamp).AddTranslateOp().Set(Gf.Vec3d(0, 5, 0))
    state = UsdSemantics.LabelsAPI.Apply(lamp, "state").CreateLabelsAttr()
    state.Set(["off"], 0)
    state.Set(["on"], 6)
    visibility = UsdGeom.Imageable(lamp).CreateVisibilityAttr()
    visibility.Set("inherited", 0)
    visibility.Set("invisible", 8)
    hull = UsdGeom.Mesh.Define(stage, "/Set/Lamp/Hull")
    hull.CreatePointsAttr([(0, 0, 0), (3, 0, 0), (0, 3, 0), (0, 0, 3)])
    hull.CreateFaceVertexCountsAttr([3, 3, 3, 3])
    hull.CreateFaceVertexIndicesAttr([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3])
    hull.CreatePurposeAttr("guide")
    UsdPhysics.MeshCollisionAPI.Apply(hull.GetPrim())
    stage.GetRootLayer().Save()
    return tmp_path / "foreign.usda"


def test_find_returns_prims(stage_path: Path) -> None:
    assert names(cif.usd.find(stage_path, label="*MUG*")) == ["red_mug_001"]
    stage = Usd.Stage.Open(str(stage_path))
    everything = cif.usd.find(stage)
    assert {"red_mug_001", "toy_car_002", "green_napkin_007"} <= set(names(everything))
    assert everything[0].GetStage() == stage
    assert names(cif.usd.find(stage, "car", taxonomy="class", time=3)) == ["toy_car_002"]
    assert cif.usd.find(stage, "car", taxonomy="instance") == []
    assert "red_mug_001_splats" in names(cif.usd.find(stage, "mug", inherited=True))
    labels = cif.usd.labels(stage.GetPrimAtPath("/World/red_mug_001"))
    expected = {"class": ["mug", "red mug"], "instance": ["red_mug_001"], "wikidata_qcode": ["Q81727"]}
    assert labels == expected
    assert names(cif.usd.find(stage, "Q81727", taxonomy="wikidata_qcode")) == ["red_mug_001"]
    with pytest.raises(cif.CifError, match=r"no\.usda: no such file"):
        cif.usd.find("no.usda", "x")


def test_labels_with_brackets_are_found_by_their_own_names(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "shelves.usda"))
    label = "shelf [left] {2}"
    for name, text in [("Left", label), ("Right", "shelf l 2")]:
        prim = stage.DefinePrim(f"/{name}", "Xform")
        UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr().Set([text])
    stage.GetRootLayer().Save()
    assert names(cif.usd.find(stage, label)) == ["Left"]
    assert [found["label"] for found in cif.query_stage(tmp_path / "shelves.usda", label)] == [label]
    assert names(cif.usd.find(stage, "SHELF ?l*")) == ["Left"]


def test_pipes_are_no_stages(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.usda"
    os.mkfifo(pipe)
    with pytest.raises(cif.CifError, match=r"pipe\.usda.*named pipe"):
        cif.query_stage(pipe, "x")
    with pytest.raises(cif.CifError, match=r"pipe\.usda.*named pipe"):
        cif.import_scene(pipe)


def test_find_over_time(foreign: Path) -> None:
    assert names(cif.usd.find(foreign, "chair")) == ["Chair"]
    assert cif.usd.find(foreign, "on", time=3) == []
    assert names(cif.usd.find(foreign, "on", time=Usd.TimeCode(7))) == ["Lamp"]
    assert names(cif.usd.find(foreign, "o*", time=(2, 7))) == ["Lamp"]
    with pytest.raises(cif.CifError, match="earlier time first"):
        cif.usd.find(foreign, "on", time=(7, 2))


def test_query_of_a_foreign_stage(foreign: Path, capfd: pytest.CaptureFixture[str]) -> None:
    chair, lamp = ask(capfd, foreign, "--interval", "0:10")
    assert (chair["path"], chair["label"]) == ("/Set/Chair", "chair")
    assert (chair["low"], chair["high"]) == ([-1, -1, 0], [11, 1, 2])
    assert chair["speed"] == pytest.approx(20)
    assert (chair["volume"], chair["volume_of"]) == (pytest.approx(12 * 2 * 2), "box")
    assert (lamp["volume"], lamp["volume_of"], lamp["speed"]) == (pytest.approx(4.5), "hull", 0)
    (chair,) = ask(capfd, foreign, "--label", "chair", "--time", 5)
    assert np.array(chair["transform"])[:3, 3] == pytest.approx([5, 0, 1])
    assert chair["speed"] == pytest.approx(20)
    # Hidden from time code 8 on, and labelled `on` from 6 on.
    assert [one["path"] for one in ask(capfd, foreign, "--time", 9)] == ["/Set/Chair"]
    assert len(ask(capfd, foreign, "--label", "on", "--interval", "3:7")) == 1
    assert len(ask(capfd, foreign, "--taxonomy", "wikidata", "--label", "*")) == 2
    assert cif.run(["query", str(foreign), "--label", "on", "--time", "3"]) == 1
    assert "off" in capfd.readouterr().err
    assert [one["path"] for one in ask(capfd, foreign, "--point", "0,5,0")] == ["/Set/Lamp"]
    assert ask(capfd, foreign, "--box", "50,50,50,60,60,60") == []


def test_query_of_our_stage_and_scene_agree(
    field: cif.Field, stage_path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    field.save(tmp_path / "scene.cif")
    stage = ask(capfd, stage_path, "--label", "red mug", "--time", 2)
    scene = ask(capfd, tmp_path / "scene.cif", "--label", "red mug", "--time", 2)
    assert stage[0]["path"] == scene[0]["path"] == "/World/red_mug_001"
    assert np.array(stage[0]["transform"]) == pytest.approx(np.array(scene[0]["transform"]), abs=1e-5)
    for key in ["low", "high"]:
        assert stage[0][key] == pytest.approx(scene[0][key], abs=1e-4)
    assert stage[0]["speed"] == scene[0]["speed"] == 0
    # The car drives half a metre along x and a fifth along z in five frames of twelve a second.
    (car,) = ask(capfd, stage_path, "--label", "toy car", "--interval", f"0:{FRAMES - 1}")
    assert car["speed"] > np.hypot(0.5, 0.2) / (FRAMES - 1) * 12 * 0.99


def test_words_of_a_text_find_objects(
    stage_path: Path, foreign: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cif.run(["query", str(stage_path), "--text", "The MUG that is red", "--json"]) == 0
    told = capfd.readouterr()
    assert "word by word" in told.err
    mug, *others = json.loads(told.out)
    assert (mug["path"], mug["chosen"], mug["score"]) == ("/World/red_mug_001", True, 0.4)
    assert not any(other["chosen"] for other in others)
    (lamp,) = ask(capfd, foreign, "--text", "a lamp", "--box", "-9,-9,-9,9,9,9")
    assert lamp["path"] == "/Set/Lamp"
    assert cif.run(["query", str(stage_path), "--text", "teapot"]) == 1
    assert "no object" in capfd.readouterr().err
    assert cif.run(["query", str(stage_path), "--text", "mug", "--models", str(tmp_path)]) == 1
    assert "no models.toml" in capfd.readouterr().err


def test_embeddings_leave_and_come_back(
    stage_path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    # As cif embed leaves them, here by hand.
    stage = Usd.Stage.Open(str(stage_path))
    edited = tmp_path / "edited.usda"
    stage.Export(str(edited))
    stage = Usd.Stage.Open(str(edited))
    mug = stage.GetPrimAtPath("/World/red_mug_001")
    mug.CreateAttribute("cif:embedding", Sdf.ValueTypeNames.FloatArray).Set([0.6, -0.8])
    mug.CreateAttribute("cif:embedding:model", Sdf.ValueTypeNames.String).Set("clip")
    car = stage.GetPrimAtPath("/World/toy_car_002")
    car.CreateAttribute("cif:embedding", Sdf.ValueTypeNames.FloatArray).Set([3.0, 4.0])
    car.CreateAttribute("cif:embedding:model", Sdf.ValueTypeNames.String).Set("clip")
    stage.GetRootLayer().Save()
    assert cif.run(["query", str(edited), "--text", "mug"]) == 0
    assert "embeddings are compared by models" in capfd.readouterr().err
    assert cif.run(["import", str(edited), "-o", str(tmp_path / "back.cif")]) == 0
    capfd.readouterr()
    assert cif.run(["info", str(tmp_path / "back.cif"), "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    # Only directions of length 1 count.
    assert facts["embeddings"] == {"model": "clip", "instances": 1}
    out = tmp_path / "again.usda"
    assert cif.run(["export", str(tmp_path / "back.cif"), "--usd", str(out)]) == 0
    stage = Usd.Stage.Open(str(out))
    again = stage.GetPrimAtPath("/World/red_mug_001")
    assert list(again.GetAttribute("cif:embedding").Get()) == pytest.approx([0.6, -0.8])
    assert again.GetAttribute("cif:embedding:model").Get() == "clip"


def test_labels_are_edited_in_place(
    stage_path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "edited"
    shutil.copytree(stage_path.parent, folder)
    path = folder / stage_path.name
    if path.suffix == ".usdz":
        assert cif.run(["label", str(path), "--instance", "1", "blue mug"]) == 1
        assert "unpack the package" in capfd.readouterr().err
        return
    old = Usd.Stage.Open(str(path))
    before = np.array(
        old.GetPrimAtPath("/World/toy_car_002/toy_car_002_splats").GetAttribute("positions").Get(2)
    )
    del old
    assert cif.run(["label", str(path), "--instance", "1", "blue mug"]) == 0
    capfd.readouterr()
    assert sorted(folder.iterdir()) == sorted(folder / old.name for old in stage_path.parent.iterdir())
    stage = Usd.Stage.Open(str(path))
    mug = stage.GetPrimAtPath("/World/red_mug_001")
    assert cif.usd.labels(mug)["class"] == ["blue mug", "mug"]
    assert list(UsdSemantics.LabelsAPI(mug, "class").GetLabelsAttr().Get()) == ["mug", "blue mug"]
    assert (mug.GetDisplayName(), mug.GetAttribute("userProperties:label").Get()) == ("blue mug",) * 2
    positions = stage.GetPrimAtPath("/World/toy_car_002/toy_car_002_splats").GetAttribute("positions").Get(2)
    assert np.array_equal(before, np.array(positions))
    (found,) = ask(capfd, path, "--label", "blue mug")
    assert (found["label"], found["class"], found["instance"]) == ("blue mug", "mug", "red_mug_001")

    assert cif.run(["label", str(path), "--instance", "77", "x"]) == 1
    assert "/World/toy_car_002" in capfd.readouterr().err
    other = tmp_path / ("other.usda" if path.suffix == ".usdc" else "other.usdc")
    assert cif.run(["label", str(path), "--instance", "1", "x", "-o", str(other)]) == 2
    assert "do not change what a file is" in capfd.readouterr().err and not other.exists()


def test_labels_of_foreign_prims_and_of_layers_beside(
    foreign: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "named.usda"
    arguments = ["label", str(foreign), "--instance", "/Set/Chair", "throne", "-o", str(out)]
    assert cif.run(arguments) == 0
    assert names(cif.usd.find(out, "throne")) == ["Chair"]
    assert cif.usd.find(foreign, "throne") == []

    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.GetRootLayer().subLayerPaths.append("foreign.usda")
    stage.GetRootLayer().Save()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    arguments[1], arguments[-1] = str(tmp_path / "shot.usda"), str(elsewhere / "shot.usda")
    assert cif.run(arguments) == 1
    assert "same folder" in capfd.readouterr().err
    assert list(elsewhere.iterdir()) == []
    arguments[-1] = str(tmp_path / "shot2.usda")
    assert cif.run(arguments) == 0
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "shot2.usda"))
    assert layer.GetPrimAtPath("/Set/Chair") is not None
