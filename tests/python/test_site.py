"""The pages and their site: every link leads somewhere, every command is understood, and what can run is run.

Commands are the lines of shell blocks that begin with `cif`. All of them are given to the command in an empty
folder, where nothing but a wrong argument ends with exit code 2. Then the commands of each page run in order,
with SUBSTITUTIONS, in a folder that has what GIVEN lists, but for those that NOT_RUN excuses.
"""

from __future__ import annotations

import html.parser
import importlib.util
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SITE = ROOT / "target" / "site"
CIF = Path(sys.executable).with_name("cif")
CAPTURE = ROOT / "examples" / "tabletop-mini"

spec = importlib.util.spec_from_file_location("site_of_docs", DOCS / "site.py")
site = importlib.util.module_from_spec(spec)
spec.loader.exec_module(site)

PAGES = [
    ROOT / "README.md",
    *sorted(page for page in DOCS.rglob("*.md") if "reference" not in page.parts),
    *(ROOT / name for name in ["examples/README.md", "plugin/README.md", "schemas/README.md"]),
    *sorted((ROOT / "plugin").glob("*/README.md")),
]
GUIDES = sorted((DOCS / "guides").glob("*.md"))
START = DOCS / "guides" / "start.md"

SUBSTITUTIONS = [
    # A few steps. Fits of objects would take a minute, and motion makes exports and queries five times as long.
    (
        r"^cif train (?!.*--(from|resume))",
        "cif train --iterations-coarse 20 --iterations-fine 20 --iterations-instance 20 --downscale 2 "
        "--effects none,+instances ",
    ),
    (r"^cif train (?=.*--from)", "cif train --iterations-instance 5 --downscale 2 "),
    # A page opens no browser, here.
    (r"^cif view ", "cif view --no-open "),
    (r" --view\b(?!=)", " --view=address"),
    # Stages that pages export are there already, for their other commands.
    (r"^cif export ", "cif export --force "),
    (r"--size \d+x\d+", "--size 64x48"),
]
"""Changes of commands of pages before they run: pattern, replacement."""

NOT_RUN = {
    r"\bphone\.mp4\b|\bleft\.mp4\b": "there is no video",
    r"(?<!captures/)\btable/": "made of a video",
    r"^cif (bench|demo)\b": "takes minutes",
    r"--models\b": "there are no models",
}
"""Commands that pages have and that are only parsed: pattern, reason."""


NO_FFMPEG = "ffmpeg, which makes films, is not on the PATH"


class Command(NamedTuple):
    """A command of a page."""

    page: Path
    line: str

    def words(self) -> list[str]:
        """Its arguments, without redirections."""
        words = shlex.split(self.line, comments=True)[1:]
        return words[: words.index(">")] if ">" in words else words

    def to_run(self) -> Command:
        """It with its substitutions."""
        line = self.line
        for pattern, replacement in SUBSTITUTIONS:
            line = re.sub(pattern, replacement, line)
        return Command(self.page, line)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, *languages: str) -> list[str]:
    """The code blocks of a page in some languages."""
    return [
        text
        for language, text in re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
        if language in languages
    ]


def commands(page: Path) -> list[Command]:
    """The commands of a page, in order."""
    text = "".join(blocks(page, "sh", "bash", "console")).replace("\\\n", " ")
    lines = [part.strip().removeprefix("$ ") for line in text.splitlines() for part in line.split(" && ")]
    return [Command(page, line) for line in lines if line.startswith("cif ")]


COMMANDS = [command for page in PAGES for command in commands(page)]


def run(words: list[str], folder: Path, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [CIF, *words],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
        **options,
    )


def test_pages_have_commands() -> None:
    assert len(COMMANDS) > 60
    assert all(commands(page) for page in GUIDES)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_are_understood(page: Path, tmp_path: Path) -> None:
    # Arguments are judged before files are read, of which there are none.
    (tmp_path / "captures/table").mkdir(parents=True)
    for command in commands(page):
        words = command.words()
        # It needs no files, and would train.
        done = run([*words, "--help"] if words[0] == "demo" else words, tmp_path)
        assert done.returncode in (0, 1), f"{command.line}\n{done.stderr}"


def test_a_flag_that_does_not_exist_is_found(tmp_path: Path) -> None:
    for line in ["cif train captures/table -o a.cif --presett draft", "cif query --labl x", "cif vew"]:
        assert run(Command(ROOT, line).words(), tmp_path).returncode == 2, line


def flags_of(subcommands: str, known: dict[str, set[str]]) -> set[str]:
    """The long flags in the help of a command."""
    if subcommands not in known:
        done = run([*subcommands.split(), "--help"], ROOT)
        known[subcommands] = set(re.findall(r"--[a-z][a-z-]*", done.stdout)) if done.returncode == 0 else set()
    return known[subcommands]


def test_flags_in_sentences_exist() -> None:
    known: dict[str, set[str]] = {}
    for page in PAGES:
        sentences = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        for line in re.findall(r"`(cif [a-z][^`]*)`", sentences):
            words = line.split()[1:]
            depth = 2 if words[0] in ("masks", "bench") and words[1:] and words[1].isalpha() else 1
            flags = set(re.findall(r"--[a-z][a-z-]*", line))
            assert flags <= flags_of(" ".join(words[:depth]), known), f"{name_of(page)}: {line}"


def train(folder: Path) -> Path:
    """A scene of the example capture, as the shortest training makes it."""
    command = Command(ROOT, f"cif train '{CAPTURE}' -o table.cif --preset draft")
    done = run(command.to_run().words(), folder)
    assert done.returncode == 0, done.stderr
    return folder / "table.cif"


def edits_of(name: str) -> Callable[[Path], None]:
    """Writes a layer of edits over table.usda, in which the toy car is gone."""

    def write(folder: Path) -> None:
        (folder / name).write_text(
            '#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@table.usda@]\n)\n'
            'over "World"\n{\n    over "toy_car_009" (\n        active = false\n    )\n    {\n    }\n}\n'
        )

    return write


def exported(name: str) -> Callable[[Path], None]:
    """Writes the scene in another format."""

    def write(folder: Path) -> None:
        assert run(["export", "table.cif", name], folder).returncode == 0

    return write


def plan(folder: Path) -> None:
    """Writes the plan of the page on batches, with a few steps, one preset and one seed."""
    text = blocks(DOCS / "batch.md", "toml")[0]
    steps = " ".join(f"--iterations-{stage} 5" for stage in ("coarse", "fine", "instance"))
    text = re.sub(r"(preset|seed) = \[(.*?),.*\]", r"\1 = [\2]", text)
    text = text.replace("[train]", f'[train]\noptions = "{steps} --downscale 2 --effects none,+instances"')
    (folder / "plan.toml").write_text(text)


GIVEN: dict[str, Callable[[Path], object]] = {
    "examples": lambda folder: (folder / "examples").symlink_to(ROOT / "examples"),
    "captures": lambda folder: (folder / "captures").mkdir(),
    "captures/table": lambda folder: (folder / "captures/table").symlink_to(CAPTURE),
    "table.cif": lambda folder: None,
    "scene.cif": lambda folder: shutil.copyfile(folder / "table.cif", folder / "scene.cif"),
    "table.usda": exported("table.usda"),
    "out.usda": exported("out.usda"),
    "table_edits.usda": edits_of("table_edits.usda"),
    "fallen.usda": edits_of("fallen.usda"),
    "fox.ply": exported("fox.ply"),
    "plan.toml": plan,
}
"""Inputs of commands of pages: the name there, and what makes it in a folder that has a trained table.cif."""


@pytest.fixture(scope="session")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that commands of pages find."""
    folder = tmp_path_factory.mktemp("given")
    train(folder)
    for make in GIVEN.values():
        make(folder)
    return folder


def why_not(command: Command) -> str | None:
    """The reason why a command is not run."""
    if shutil.which("ffmpeg") is None and re.search(r" -o \S+\.(mp4|webm|gif)\b", command.line):
        return NO_FFMPEG
    return next((why for pattern, why in NOT_RUN.items() if re.search(pattern, command.line)), None)


def serve(words: list[str], folder: Path) -> None:
    """Runs a command that serves a page until it is stopped, and reads the page."""
    process = subprocess.Popen(
        [CIF, *words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    with process:
        try:
            seen = ""
            for line in process.stdout:
                seen += line
                if address := re.search(r"http://127\.0\.0\.1:\S+", line):
                    with urllib.request.urlopen(address[0], timeout=60) as answer:
                        assert b"<canvas" in answer.read()
                    return
            raise AssertionError(f"{words}: {seen}")
        finally:
            process.send_signal(signal.SIGINT)


def run_here(command: Command, folder: Path) -> None:
    """Runs a command of a page in a folder."""
    words = command.to_run().words()
    if words[0] == "view":
        serve(words, folder)
        return
    if "-o" in words:
        # The scene that the page writes is there, for its other commands.
        output = folder / words[words.index("-o") + 1]
        for file in [output, output.with_suffix(".train.toml")] if output.suffix == ".cif" else []:
            file.unlink(missing_ok=True)
    done = run(words, folder)
    assert done.returncode == 0, f"{command.line}\n{done.stdout}\n{done.stderr}"


def run_python(page: Path, folder: Path) -> None:
    """Runs the Python of a page in a folder."""
    for code in blocks(page, "python"):
        done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, f"{code}\n{done.stderr}"


def test_the_start_runs(tmp_path: Path) -> None:
    GIVEN["examples"](tmp_path)
    assert "mkdir -p out\n" in START.read_text()
    (tmp_path / "out").mkdir()
    for command in commands(START):
        assert why_not(command) in (None, NO_FFMPEG)
        if not why_not(command):
            run_here(command, tmp_path)
    run_python(START, tmp_path)


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page) and page != START], ids=name_of)
def test_commands_run(page: Path, given: Path, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(given, folder, symlinks=True)
    for command in commands(page):
        if not why_not(command):
            run_here(command, folder)
    if page in GUIDES:
        run_python(page, folder)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name_of)
def test_python_is_understood(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, name_of(page), "exec")


def test_pictures_are_small_and_shown() -> None:
    shown = (DOCS / "gallery.md").read_text()
    for picture in (DOCS / "pictures").iterdir():
        assert picture.stat().st_size < 600_000, picture.name
        assert f"(pictures/{picture.name})" in shown


def test_the_site_has_all_pages() -> None:
    listed = site.pages()
    assert len(listed) == len(set(listed))
    pages = {*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "plugin").glob("*/README.md"), *PAGES}
    assert {page.relative_to(ROOT) for page in pages} - {Path("docs/SUMMARY.md")} <= set(listed)


@pytest.mark.parametrize("page", site.pages(), ids=str)
def test_links_hold_on_the_site(page: Path) -> None:
    files: set[Path] = set()
    text = site.with_links_of_the_site(page, set(site.pages()), files)
    for link in site.links(text):
        target = site.normal(ROOT / page.parent / link["path"].replace("index.html", "README.md"))
        assert target in site.pages() or target in files, link[0]


class Names(html.parser.HTMLParser):
    """Ids of a page of the built site, and what it leads to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.targets: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Note what a tag names and leads to."""
        for name, value in attributes:
            if name == "id" and value:
                self.ids.add(value)
            elif value and (name == "src" or (name == "href" and tag == "a")):
                self.targets.append(value)


@pytest.mark.skipif(not SITE.is_dir(), reason="make site was not run")
def test_links_of_the_built_site_lead_somewhere() -> None:
    pages = {path: Names(path) for path in SITE.rglob("*.html") if path.name not in ("404.html", "toc.html")}
    assert len(pages) > 30
    for path, names in pages.items():
        for target in names.targets:
            if re.match(r"[a-z]+:", target):
                continue
            file, _, anchor = urllib.parse.unquote(target).partition("#")
            to = Path(os.path.normpath(path.parent / file)) if file else path
            assert to.is_file(), f"{path.relative_to(SITE)}: {target}: no such file"
            assert not anchor or to not in pages or anchor in pages[to].ids, (
                f"{path.relative_to(SITE)}: {target}: no such heading"
            )
