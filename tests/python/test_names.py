"""The distribution is cif4d; another one, cif, brings a module of the same name."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import cif
import pytest

REPOSITORY = Path(__file__).parents[2]
FIX = "pip uninstall cif && pip install --force-reinstall --no-deps cif4d"


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder of packages with ours in it, as pip installs them."""
    folder = tmp_path / "site"
    folder.mkdir()
    library = next(path for path in Path(cif.__file__).parent.glob("_native.*") if path.suffix != ".pyi")
    for name in ["cif", "cif4d"]:
        files = Path(cif.__file__).parents[1] / name
        shutil.copytree(files, folder / name, ignore=shutil.ignore_patterns("__pycache__", library.name))
    (folder / "cif" / library.name).symlink_to(library)
    return folder


def add_other(site: Path) -> None:
    """Put the metadata of the other distribution there."""
    about = site / "cif-0.0.6.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: cif\nVersion: 0.0.6\n")


def python(site: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site)}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment)


COMMAND = "import sys, cif4d; sys.argv = ['cif', '--version']; sys.exit(cif4d.main())"


def test_the_distribution_is_called_cif4d() -> None:
    (script,) = [point for point in metadata.distribution("cif4d").entry_points if point.name == "cif"]
    assert script.value == "cif4d:main"
    required = metadata.requires("cif4d") or []
    assert [re.match(r"[\w-]+", one)[0] for one in required if "extra" not in one] == ["numpy"]
    extras = metadata.metadata("cif4d").get_all("Provides-Extra")
    assert {"usd", "capture", "vision"} <= set(extras)


def test_alone_nothing_is_said(site: Path) -> None:
    for code in ["import cif; cif.Field", COMMAND]:
        done = python(site, "-W", "error", "-c", code)
        assert done.returncode == 0 and not done.stderr, done


def test_another_distribution_beside_ours_is_reported(site: Path) -> None:
    add_other(site)
    done = python(site, "-c", "import cif; print(cif.Field.__name__)")
    assert done.stdout == "Field\n" and "'cif 0.0.6'" in done.stderr and FIX in done.stderr, done
    done = python(site, "-c", COMMAND)
    assert done.returncode == 0 and cif.__version__ in done.stdout, done
    assert done.stderr.count("'cif 0.0.6'") == 1 and FIX in done.stderr, done


@pytest.mark.parametrize("theirs", ["", "raise ImportError('No module named statsmodels')\n", None])
def test_a_module_that_was_replaced_is_an_error(site: Path, theirs: str | None) -> None:
    add_other(site)
    if theirs is None:
        (site / "cif" / "__init__.py").unlink()
    else:
        (site / "cif" / "__init__.py").write_text(theirs)
    for words in [("-c", COMMAND), ("-m", "cif4d", "--version"), ("-m", "cif", "--version")]:
        if words[1] == "cif" and theirs != "":
            # Python itself says what it fails on before any file of ours.
            continue
        done = python(site, *words)
        assert done.returncode == 1 and not done.stdout, done
        assert "'cif 0.0.6'" in done.stderr and FIX in done.stderr and "Traceback" not in done.stderr, done


def test_what_was_lost_with_the_other_is_an_error(site: Path) -> None:
    # As `pip uninstall cif` leaves ours.
    (site / "cif" / "__init__.py").unlink()
    done = python(site, "-m", "cif4d", "--version")
    assert done.returncode == 1 and "missing" in done.stderr and FIX in done.stderr, done


def test_without_usd_the_extra_is_named() -> None:
    code = "import sys; sys.modules['pxr'] = None; import cif; print(cif.Field.__name__); import cif.usd"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "Field\n" and done.returncode == 1, done
    assert "pip install 'cif4d[usd]'" in done.stderr, done


def test_every_hint_names_our_distribution() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a checkout")
    hint = re.compile(r"pip install[^\n]*\bcif(?!4d)\b(?!/)[\[ '\"`]")
    for name in filter(None, listed.stdout.split("\0")):
        path = REPOSITORY / name
        if path.suffix in {".md", ".rs", ".py", ".toml", ".sh"} and path != Path(__file__):
            text = path.read_text()
            assert not hint.search(text), f"{name}: {hint.search(text)[0]}"
