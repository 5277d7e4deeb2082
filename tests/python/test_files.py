"""Files that are there, missing, foreign or broken."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cif
import pytest
from pxr import Usd


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
def test_our_own_files_are_replaced(field: cif.Field, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"scene.{suffix}"
    first = field.export(path)
    again = field.export(path, proxy_points=0)
    there = contents(tmp_path)
    assert again["bytes"] < first["bytes"] and sum(map(len, there.values())) == again["bytes"]
    assert {name.split("/")[0] for name in there} <= {path.name, "scene.payloads"}, "nothing is left behind"


def test_foreign_files_are_kept(field: cif.Field, tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "theirs.usda"))
    stage.DefinePrim("/Precious")
    stage.Save()
    (tmp_path / "broken.usdc").write_bytes(b"no stage at all")
    before = contents(tmp_path)
    for name in before:
        with pytest.raises(cif.CifError, match=rf"{name} exists and was not written by cif"):
            field.export(tmp_path / name)
    assert contents(tmp_path) == before
    field.export(tmp_path / "broken.usdc", force=True)
    assert Usd.Stage.Open(str(tmp_path / "broken.usdc")).GetDefaultPrim()


def test_outputs_that_cannot_be(field: cif.Field, tmp_path: Path) -> None:
    (tmp_path / "folder.usda").mkdir()
    for name, message in [
        ("scene.obj", r"use \.usda"),
        ("scene", r"use \.usda"),
        ("missing/scene.usda", "no such folder"),
        ("folder.usda", "is a folder"),
    ]:
        with pytest.raises(cif.CifError, match=message):
            field.export(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.usda"]


def test_options_of_an_export(field: cif.Field, tmp_path: Path) -> None:
    for name, keywords, message in [
        ("a.usda", {"tolerence": "1%"}, r"unknown field `tolerence`, expected .*`tolerance`"),
        ("a.usda", {"most_expensive_motion": "slow"}, r"`slow`, expected .*`rigid`"),
        ("a.usda", {"options": {"payload": "separate"}}, r"'payload' is no option of USD; known: payloads"),
        ("a.usda", {"options": {"payloads": "far"}}, r"`far`, expected .*`by-kind`"),
        ("a.glb", {"options": {"payloads": "separate"}}, r"no option of glTF; known: none"),
    ]:
        with pytest.raises(ValueError, match=message):
            field.export(tmp_path / name, **keywords)
    assert not list(tmp_path.iterdir())
    field.export(tmp_path / "a.usdc", options={"payloads": "separate", "levels_of_detail": False})
    assert any((tmp_path / "a.usdc.payloads").iterdir())
    coarse = field.export(tmp_path / "b.usdc", tolerance=0.5, frames=(0, 1), up_axis="y")
    assert coarse["samples"] == 2
    assert field.export(tmp_path / "a.ply", options={"time_code": 1})["samples"] == 1


def test_inputs_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(cif.CifError, match=r"none\.usda: no such file"):
        cif.query_stage(tmp_path / "none.usda", "mug")
    (tmp_path / "text.usda").write_text("hello")
    with pytest.raises(cif.CifError, match=r"text\.usda cannot be opened"):
        cif.query_stage(tmp_path / "text.usda", "mug")
    with pytest.raises(cif.CifError, match=r"none\.cif"):
        cif.Field.load(tmp_path / "none.cif")
    with pytest.raises(cif.CifError, match="nowhere"):
        cif.open_dataset(tmp_path / "nowhere")


def test_stages_of_others_can_be_queried(tmp_path: Path) -> None:
    text = """#usda 1.0
    def Xform "Car" (prepend apiSchemas = ["SemanticsLabelsAPI:kind"]) {
        token[] semantics:labels:kind = ["sedan"]
    }
    """
    (tmp_path / "theirs.usda").write_text(text)
    (found,) = cif.query_stage(tmp_path / "theirs.usda", "sedan")
    assert found["path"] == "/Car" and found["low"] is None


def test_queries_stay_in_the_folder(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = """#usda 1.0
    (
        defaultPrim = "Car"
    )
    def Xform "Car" (prepend apiSchemas = ["SemanticsLabelsAPI:class"]) {
        token[] semantics:labels:class = ["sedan"]
    }
    """
    (tmp_path / "library.usda").write_text(text)
    shot = tmp_path / "shots" / "shot.usda"
    shot.parent.mkdir()
    shot.write_text('#usda 1.0\ndef "Hero" (references = @../library.usda@) {\n}\n')
    with pytest.raises(cif.CifError, match="outside the folder"):
        cif.query_stage(shot, "sedan")
    (found,) = cif.query_stage(shot, "sedan", follow_external=True)
    assert found["path"] == "/Hero"
    assert cif.run(["query", str(shot), "--label", "sedan"]) == 1
    said = capfd.readouterr().err
    assert "../library.usda" in said and "--follow-external" in said, said
    assert cif.run(["query", str(shot), "--label", "sedan", "--follow-external"]) == 0
    assert "/Hero" in capfd.readouterr().out


def test_messages_of_usd_are_shown_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = """#usda 1.0
    def Xform "Car" (
        prepend apiSchemas = ["SemanticsLabelsAPI:class"]
        references = </Garage>
    ) {
        token[] semantics:labels:class = ["sedan"]
    }
    """
    stage = tmp_path / "theirs.usda"
    stage.write_text(text)
    for _ in range(2):
        cif.query_stage(stage, "sedan")
        assert cif.run(["query", str(stage), "--label", "sedan"]) == 0
    said = capfd.readouterr().err
    (line,) = [line for line in said.splitlines() if "Unresolved reference" in line]
    assert line.startswith("warning: USD: In </Car>") and "</Garage>" in line and "0x" not in line
    (tmp_path / "other.usda").write_text(text)
    cif.query_stage(tmp_path / "other.usda", "sedan")
    assert "other.usda@</Garage>" in capfd.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="the test locks as Unix does")
@pytest.mark.parametrize("name", ["scene.cif", "scene.usda", "scene.glb", "scene.ply"])
def test_files_wait_for_others_that_write_them(field: cif.Field, tmp_path: Path, name: str) -> None:
    import fcntl

    path = tmp_path / name
    write = (lambda: field.save(path)) if name.endswith(".cif") else (lambda: field.export(path))
    with (tmp_path / f".{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        writer = threading.Thread(target=write)
        writer.start()
        # Without waiting, it would be done by then.
        writer.join(1.0)
        assert writer.is_alive() and contents(tmp_path).keys() == {f".{name}.lock"}
    writer.join()
    assert path.stat().st_size > 0 and not (tmp_path / f".{name}.lock").exists()


def test_motion_errors_stop_an_export(field: cif.Field, tmp_path: Path) -> None:
    def broken(time: float) -> None:
        raise KeyError(f"no frame at {time}")

    with pytest.raises(KeyError, match="no frame"):
        field.export(tmp_path / "scene.usda", motion=broken)
    with pytest.raises(ValueError, match="must return float32"):
        field.export(tmp_path / "scene.usda", motion=lambda _: (field.means[:3], field.quaternions))
    with pytest.raises(cif.CifError, match="tolerance"):
        field.export(tmp_path / "scene.usda", tolerance="much")
    assert not list(tmp_path.iterdir())


def test_a_reader_that_leaves_is_no_fault() -> None:
    capture = Path(__file__).parents[2] / "examples" / "tabletop-mini"
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "cif", "info", str(capture)]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert ended.returncode == -signal.SIGPIPE, ended.stderr
    assert b"panicked" not in ended.stderr
