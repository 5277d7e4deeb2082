"""Processes: those that are forked, and the folder that one runs in."""

from __future__ import annotations

import multiprocessing
import shutil
import subprocess
import sys
from pathlib import Path

import cif
import pytest

CAPTURE = Path(__file__).parents[2] / "examples" / "tabletop-mini"

FORKS = """
import multiprocessing
import sys

import cif


def frames(capture):
    try:
        return len(cif.open_dataset(capture))
    except cif.CifError as error:
        return str(error)


def in_process(method, capture):
    with multiprocessing.get_context(method).Pool(1) as pool:
        return pool.apply_async(frames, [capture]).get(300)


if __name__ == "__main__":
    capture = sys.argv[1]
    print(in_process("fork", capture))
    print(frames(capture))
    print(in_process("fork", capture))
    print(in_process("spawn", capture))
"""


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="nothing forks here")
def test_work_in_a_fork_of_a_process_that_has_worked_is_refused(tmp_path: Path) -> None:
    script = tmp_path / "forks.py"
    script.write_text(FORKS)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", script, CAPTURE], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done
    before, here, after, spawned = done.stdout.splitlines()
    assert before == here == spawned == str(len(cif.open_dataset(CAPTURE))), done.stdout
    assert "forked" in after and 'get_context("spawn")' in after, after


def plant(folder: Path, *packages: str) -> None:
    """Packages that tell by a file that they were imported."""
    for package in packages:
        (folder / package).mkdir(parents=True)
        code = "import pathlib\npathlib.Path(__file__).with_name('ran').touch()\nraise ImportError('planted')\n"
        (folder / package / "__init__.py").write_text(code)


def test_packages_of_the_current_folder_are_not_imported(field: cif.Field, tmp_path: Path) -> None:
    field.save(tmp_path / "scene.cif")
    here = tmp_path / "here"
    plant(here, "pxr", "numpy", "json", "onnxruntime", "pycolmap")
    # One that claims to be old has its schemas registered when the module is imported.
    (here / "usd_core-24.1.dist-info").mkdir()
    words = ["-m", "cif", "export", "../scene.cif", "--usd", "scene.usda"]
    done = subprocess.run([sys.executable, *words], cwd=here, capture_output=True, text=True)
    assert done.returncode == 0 and (here / "scene.usda").exists(), done
    for package in ["numpy", "json"]:
        # A program that Python runs from the current folder takes these from it by itself.
        (here / package).rename(here / f"no_{package}")
    code = "import cif; print(cif.usd_version(), len(cif.query_stage('scene.usda', 'toy car')))"
    done = subprocess.run([sys.executable, "-c", code], cwd=here, capture_output=True, text=True)
    assert done.stdout == f"{cif.usd_version()} 1\n", done
    assert not list(here.glob("*/ran"))


MANIFEST = """
[embedder]
name = "any"
size = 32

[embedder.image]
model = "picture.onnx"
inputs = { image = "pixels" }
outputs = { embedding = "embedding" }

[embedder.text]
model = "text.onnx"
tokenizer = "words.json"
inputs = { tokens = "ids" }
outputs = { embedding = "embedding" }
"""


@pytest.mark.skipif(sys.platform == "win32" or not shutil.which("cc"), reason="no C compiler")
def test_a_model_that_ends_the_runtime_ends_nothing_else(
    field: cif.Field, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    library = tmp_path / "library.so"
    source = Path(__file__).parents[1] / "src" / "ending_runtime.c"
    subprocess.run(["cc", "-shared", "-fPIC", source, "-o", library], check=True)
    monkeypatch.setenv("ORT_DYLIB_PATH", str(library))
    field.save(tmp_path / "scene.cif")
    before = (tmp_path / "scene.cif").read_bytes()
    models = tmp_path / "models"
    models.mkdir()
    (models / "models.toml").write_text(MANIFEST)
    for name in ["picture.onnx", "text.onnx", "words.json"]:
        (models / name).touch()
    words = ["embed", str(tmp_path / "scene.cif"), "--capture", str(CAPTURE), "--models", str(models)]
    # In this process, which goes on, and in one that is the command.
    assert cif.run(words) == 1
    here = capfd.readouterr().err
    command = subprocess.run([sys.executable, "-m", "cif", *words], capture_output=True, text=True, check=False)
    assert command.returncode == 1
    for said in [here, command.stderr]:
        assert said.count("Error") == 1 and "SIGABRT" in said, said
        assert "picture.onnx cannot be loaded: it ended the process that ran it" in said, said
    assert (tmp_path / "scene.cif").read_bytes() == before
