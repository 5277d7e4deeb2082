"""Parts that `make dist` made: each is what it says, installs in an empty environment, and works there.

`make test-dist` runs them, in any Python that has pytest. CIF_TEST_DIST names the folder of the parts; without
it they are skipped. Pythons that are not installed, and machines without a wheel, are skipped by name.
CIF_TEST_CONTAINER=require fails where no program builds containers, else those tests are skipped.
"""

from __future__ import annotations

import ast
import gzip
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# How the parts are made.
RELEASE = ROOT / ".ci" / "release"
DIST = Path(os.environ.get("CIF_TEST_DIST", ""))
pytestmark = pytest.mark.skipif(
    "CIF_TEST_DIST" not in os.environ, reason="CIF_TEST_DIST names no folder of make dist: see tests/README.md"
)

PYTHONS = ["python3.10", "python3.11", "python3.13"]
OLDEST_GLIBC = (2, 28)
#: Numbers of machines in the header of a library.
MACHINES = {"x86_64": 62, "aarch64": 183}
# Seconds of training, with masks and motion.
FEW_STEPS = {
    "stages.coarse": "20",
    "stages.fine": "20",
    "stages.instance": "20",
    "model.max_initial_points": "1500",
    "motion.rehearsal": "10",
    "motion.rigid": "false",
}
Command = Callable[..., str]


def only(pattern: str) -> Path:
    found = sorted(DIST.glob(pattern))
    assert len(found) == 1, f"{pattern}: {[path.name for path in found]}"
    return found[0]


def works(*command: str) -> bool:
    """True where a program is there and ends well."""
    return (
        bool(shutil.which(command[0]))
        and not subprocess.run(command, capture_output=True, check=False).returncode
    )


def run(*command: str | Path, folder: Path | None = None, **more: str) -> str:
    """Run a command without what this environment adds to Python, to USD and to cif; return what it prints."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not re.match(r"CIF_|PYTHON|PXR|VIRTUAL_ENV|ORT_", name)
    }
    done = subprocess.run(
        command, cwd=folder, env=environment | more, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def wheels() -> dict[str, Path]:
    """Return the wheels, by machine."""
    found = {path.name.split("manylinux_2_28_")[-1].removesuffix(".whl"): path for path in DIST.glob("*.whl")}
    assert found and set(found) <= set(MACHINES), list(found)
    return found


def wheel_of_this_machine() -> Path:
    machine = platform.machine()
    if machine not in wheels():
        pytest.skip(f"there is no wheel for {machine}")
    return wheels()[machine]


def first_commands(cif: Command, capture: str, folder: str) -> None:
    """Run what a user runs first: a capture is trained, exported as USD and asked for an object."""
    version = only("cif-*-source.tar.gz").name.split("-")[1]
    assert version in cif("--version")
    assert "80" in cif("info", capture)
    settings = [word for key, value in FEW_STEPS.items() for word in ("--set", f"{key}={value}")]
    cif("train", capture, "-o", f"{folder}/scene.cif", "--preset", "draft", *settings)
    cif("export", f"{folder}/scene.cif", "--usd", f"{folder}/out.usda")
    found = json.loads(cif("query", f"{folder}/out.usda", "--label", "red mug", "--json"))
    assert [answer["path"] for answer in found] == ["/World/red_mug_001"]


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source archive, unpacked."""
    folder = tmp_path_factory.mktemp("sources")
    with tarfile.open(only("cif-*-source.tar.gz")) as archive:
        archive.extractall(folder, filter="data")
    (inside,) = folder.iterdir()
    return inside


def test_every_file_has_its_checksum() -> None:
    lines = (DIST / "SHA256SUMS").read_text().splitlines()
    listed = dict(reversed(line.split("  ", 1)) for line in lines)
    assert listed == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in DIST.iterdir()
        if path.name != "SHA256SUMS"
    }


def test_the_source_archive_is_that_of_its_commit() -> None:
    path = only("cif-*-source.tar.gz")
    assert path.read_bytes()[3:8] == bytes(5), "the header has a name or a time"
    with tarfile.open(path) as archive:
        entries = archive.getmembers()
        commit = archive.pax_headers["comment"]
    assert len({entry.mtime for entry in entries}) == 1
    assert {(entry.uid, entry.gid) for entry in entries} == {(0, 0)}
    prefix = path.name.removesuffix("-source.tar.gz") + "/"
    names = [entry.name.removeprefix(prefix) for entry in entries]
    assert {"Cargo.lock", "pyproject.toml", "LICENSE", "Makefile"} <= set(names)
    assert not [name for name in names if re.match(r"target/|\.git/|out/", name)]
    again = subprocess.run(
        ["git", "-C", ROOT, "archive", "--format=tar", f"--prefix={prefix}", commit],
        capture_output=True,
        check=False,
    )
    if again.returncode:
        pytest.skip(f"this repository has no commit {commit}")
    assert again.stdout == gzip.decompress(path.read_bytes())


@pytest.mark.parametrize("machine", MACHINES)
def test_wheels_hold_a_library_for_their_machine_and_their_licences(machine: str, tmp_path: Path) -> None:
    if machine not in wheels():
        pytest.skip(f"there is no wheel for {machine}")
    path = wheels()[machine]
    assert re.fullmatch(r"cif4d-[\d.]+-cp310-abi3-manylinux_2_28_\w+\.whl", path.name)
    with zipfile.ZipFile(path) as wheel:
        names = set(wheel.namelist())
        library = wheel.read("cif/_native.abi3.so")
        inside = path.name.split("-cp310")[0] + ".dist-info"
        for licence in ["LICENSE", "LICENSE-crates.txt", "LICENSE-rust.html", "LICENSE-zig.txt"]:
            assert wheel.read(f"{inside}/licenses/{licence}") == (DIST / licence).read_bytes()
        sbom = only(f"*-{machine}.cdx.json")
        assert {name for name in names if "/sboms/" in name} == {f"{inside}/sboms/{sbom.name}"}
        assert wheel.read(f"{inside}/sboms/{sbom.name}") == sbom.read_bytes()
    assert int.from_bytes(library[18:20], "little") == MACHINES[machine]
    versions = {tuple(map(int, found.split(b"."))) for found in re.findall(rb"GLIBC_(\d+\.\d+)", library)}
    assert max(versions) <= OLDEST_GLIBC
    for folder in [ROOT, Path(os.environ.get("CARGO_HOME", Path.home() / ".cargo"))]:
        assert f"{folder}/".encode() not in library, f"{folder} is named in the library"


@pytest.mark.parametrize("machine", MACHINES)
def test_the_sbom_lists_what_is_inside_with_licences(machine: str, sources: Path) -> None:
    if machine not in wheels():
        pytest.skip(f"there is no wheel for {machine}")
    text = only(f"*-{machine}.cdx.json").read_text()
    assert not re.search(r"file:///(?!cif/)", text), "it names a folder of the machine that made it"
    bom = json.loads(text)
    components = {component["name"]: component for component in bom["components"]}
    assert {"cif-train", "wgpu", "pyo3", "rust-std", "page", "schemas"} <= set(components)
    assert not {"windows-sys", "objc2"} & set(components), "these are for other systems"
    assert [name for name, component in components.items() if not component.get("licenses")] == []
    # Licences are listed for the same crates.
    licences = (DIST / "LICENSE-crates.txt").read_text()
    for name in ["wgpu", "pyo3", "rayon"]:
        assert f"  {name} {components[name]['version']}" in licences
    with zipfile.ZipFile(wheels()[machine]) as wheel:
        library = wheel.read("cif/_native.abi3.so")
    example = (sources / "examples" / "tabletop-mini" / "metadata.json").read_bytes()
    assert ("tabletop-mini" in components) == (example in library)


@pytest.mark.parametrize(("licence", "allowed"), [("MIT", True), ("GPL-3.0-only", False), ("MPL-2.0", False)])
def test_only_permissive_licences_are_allowed(licence: str, allowed: bool, tmp_path: Path) -> None:
    tool = ROOT / "target" / "dist-tools" / "bin" / "cargo-about"
    if not tool.exists():
        pytest.skip("cargo-about is not in target/dist-tools")
    for name, dependencies in [("above", 'inside = { path = "../inside" }'), ("inside", "")]:
        source = tmp_path / name / "src" / "lib.rs"
        source.parent.mkdir(parents=True)
        source.touch()
        package = f'[package]\nname = "{name}"\nversion = "1.0.0"\nlicense = "{licence}"\n'
        (tmp_path / name / "Cargo.toml").write_text(f"{package}[dependencies]\n{dependencies}\n")
    crates = ["--manifest-path", tmp_path / "above" / "Cargo.toml"]
    files = ["-c", RELEASE / "about.toml", "-o", tmp_path / "out", RELEASE / "about.hbs"]
    command = [tool, "about", "generate", *crates, "--fail", *files]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == allowed, done.stderr
    assert allowed or f'license = "{licence}"' in done.stderr


@pytest.fixture(params=PYTHONS)
def environment(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """An empty environment of a Python."""
    python = request.param
    # A name on the PATH may be one that pyenv only refuses.
    if not works(python, "-c", ""):
        pytest.skip(f"{python} is not installed")
    run(python, "-m", "venv", tmp_path / "environment")
    return tmp_path / "environment" / "bin"


def test_the_wheel_installs_and_works(environment: Path, sources: Path, tmp_path: Path) -> None:
    wheel = wheel_of_this_machine()
    run(environment / "pip", "install", "--quiet", "--disable-pip-version-check", f"{wheel}[usd]")

    def cif(*words: str) -> str:
        return run(environment / "cif", *words, folder=tmp_path)

    first_commands(cif, str(sources / "examples" / "tabletop-mini"), str(tmp_path))
    cif("demo", "--budget", "20s", "--no-view")
    assert (tmp_path / "cif-demo" / "scene.usda").exists()


def test_the_extension_has_what_blender_installs() -> None:
    with zipfile.ZipFile(only("cif_scene-*.zip")) as archive:
        names = archive.namelist()
        assert {"__init__.py", "blender_manifest.toml", "LICENSE"} <= set(names)
        for name in names:
            if name.endswith(".py"):
                ast.parse(archive.read(name).decode(), feature_version=(3, 11))


INSTALL = """
import sys, bpy, addon_utils
path, folder = sys.argv[1:]
repository = bpy.context.preferences.extensions.repos.new(name="empty", module="empty", custom_directory=folder)
bpy.ops.extensions.package_install_files(filepath=path, repo="empty", enable_on_install=True)
assert addon_utils.check("bl_ext.empty.cif_scene") == (True, True), addon_utils.check("bl_ext.empty.cif_scene")
assert bpy.ops.import_scene.cif.get_rna_type(), "the importer is not there"
"""


def test_the_extension_installs_in_blender(tmp_path: Path) -> None:
    pythons = sorted((ROOT / ".venv").glob("bpy-*/bin/python"))
    if not pythons:
        pytest.skip("no Blender: make test-blender brings it")
    for python in pythons:
        folder = tmp_path / python.parts[-3]
        folder.mkdir()
        run(python, "-c", INSTALL, only("cif_scene-*.zip"), folder, BLENDER_USER_RESOURCES=str(folder / "user"))


def builder() -> str | None:
    """Return the program that builds containers here; one with a daemon has to reach it."""
    return next((name for name in ["podman", "docker", "buildah"] if works(name, "info")), None)


@pytest.fixture(params=["cpu", "vulkan"])
def container(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Command]:
    """The command in a container whose folder /data is `tmp_path / "data"`."""
    program = builder()
    if program is None and os.environ.get("CIF_TEST_CONTAINER") != "require":
        pytest.skip("neither podman, docker nor buildah builds containers here")
    assert program, "CIF_TEST_CONTAINER=require: neither podman, docker nor buildah builds containers here"
    wheel_of_this_machine()
    image = f"cif-test-dist:{request.param}"
    extras = [] if platform.machine() == "x86_64" else ["--build-arg", "EXTRAS=usd"]
    run(
        program, "build", "-f", RELEASE / "Containerfile", "--target", request.param, "-t", image, *extras, DIST
    )
    data = tmp_path / "data"
    data.mkdir()
    # The user of the image writes here, who is not the one that runs the tests.
    data.chmod(0o777)
    if program != "buildah":
        yield lambda *words: run(program, "run", "--rm", "-v", f"{data}:/data", image, *words)
        run(program, "rmi", image)
        return
    name = run(program, "from", image).strip()

    def command(*words: str) -> str:
        # `buildah run` passes over the entry point.
        start = json.loads(run(program, "inspect", name))["OCIv1"]["config"]["Entrypoint"]
        return run(program, "run", "-v", f"{data}:/data", name, "--", *start, *words)

    yield command
    run(program, "rm", name)
    run(program, "rmi", image)


def test_the_container_works(container: Command, sources: Path, tmp_path: Path) -> None:
    shutil.copytree(sources / "examples" / "tabletop-mini", tmp_path / "data" / "tabletop-mini")
    first_commands(container, "tabletop-mini", ".")
    assert (tmp_path / "data" / "scene.cif").stat().st_uid == 1000
    container("render", "scene.cif", "--path", "orbit", "-o", "orbit.mp4")
    assert (tmp_path / "data" / "orbit.mp4").stat().st_size > 0


@pytest.mark.parametrize("container", ["vulkan"], indirect=True)
def test_the_container_has_vulkan(container: Command) -> None:
    assert "Vulkan" in container("info", "--gpu")
