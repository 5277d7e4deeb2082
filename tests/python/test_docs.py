"""What is public is documented, the stub agrees with it, and links of pages lead somewhere."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
from pathlib import Path

import cif
import cif.usd
import pytest
from cif import _native

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "crates" / "cif-python"
spec = importlib.util.spec_from_file_location("stubs", PACKAGE / "stubs.py")
stubs = importlib.util.module_from_spec(spec)
spec.loader.exec_module(stubs)


@pytest.mark.parametrize("name", sorted(stubs.public(_native)))
def test_help_has_words(name: str) -> None:
    text = stubs.words(stubs.public(_native)[name])
    assert len(text.split()) > 1 and text.split("\n")[0].endswith("."), f"{name}: {text!r}"


def test_python_itself_is_documented() -> None:
    for module in [cif, cif.usd]:
        for name in module.__all__:
            if name != "__version__":
                assert inspect.getdoc(getattr(module, name)), name


def test_the_stub_says_the_same() -> None:
    stub = stubs.STUB.read_text()
    assert stubs.with_docs(stub, _native) == stub, "run `make stubs`"


def test_the_stub_has_the_same_names_and_parameters() -> None:
    nodes = stubs.documented(ast.parse(stubs.STUB.read_text()), _native)
    public = stubs.public(_native)
    assert set(nodes) == set(public)
    for name, node in nodes.items():
        if isinstance(node, ast.ClassDef) or inspect.isgetsetdescriptor(public[name]):
            continue
        value = public[name].__func__ if isinstance(public[name], staticmethod) else public[name]
        parameters = list(inspect.signature(value).parameters.values())
        arguments = node.args
        by_name = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
        by_place = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        assert by_name == [argument.arg for argument in arguments.kwonlyargs], name
        assert by_place == [argument.arg for argument in arguments.args], name
        defaults = [default for default in [*arguments.defaults, *arguments.kw_defaults] if default]
        assert sum(p.default is not p.empty for p in parameters) == len(defaults), name


def anchors(page: Path) -> set[str]:
    """Names of the headings of a page, as links to them are spelt."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


PAGES = [
    *ROOT.glob("*.md"),
    *(
        p
        for f in ["docs", "crates", "examples", "plugin", "schemas", "tests"]
        for p in (ROOT / f).rglob("*.md")
    ),
]


@pytest.mark.parametrize("page", sorted(PAGES), ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{link}: no such file"
        assert not anchor or anchor in anchors(target), f"{link}: no such heading"


def test_the_list_of_pages_has_all_of_them() -> None:
    listed = set(
        re.findall(r"^\| \[[^]]+\]\(([^)]+)\)", (ROOT / "docs" / "README.md").read_text(), re.MULTILINE)
    )
    docs = ROOT / "docs"
    pages = [*docs.glob("*.md"), *(docs / "guides").glob("*.md")]
    assert listed == {page.relative_to(docs).as_posix() for page in pages} - {"README.md", "SUMMARY.md"}
