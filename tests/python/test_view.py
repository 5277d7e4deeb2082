"""Pages that Python opens."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from pathlib import Path

import cif
import pytest

CAPTURE = Path(__file__).parents[2] / "examples" / "tabletop-mini"


def read(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=20) as answer:
        return answer.read()


def test_a_field_is_shown_until_its_page_is_closed(field: cif.Field) -> None:
    with cif.view(field, open_browser=False) as page:
        assert page.address.startswith("http://127.0.0.1:") and page.address in repr(page)
        assert page.address in page._repr_html_()
        assert b"<canvas" in read(page.address)
        document = json.loads(read(page.address + "scene.json"))
        assert {node["label"] for node in document["nodes"]} >= {"red mug", "toy car", "green napkin"}
    with pytest.raises(urllib.error.URLError):
        read(page.address)


def test_paths_and_datasets_are_shown_too(field: cif.Field, tmp_path: Path) -> None:
    dataset = cif.open_dataset(CAPTURE)
    with cif.view(dataset, open_browser=False) as page:
        assert len(json.loads(read(page.address + "scene.json"))["views"]) == len(dataset)
    scene = tmp_path / "scene.cif"
    field.save(scene)
    with cif.view(scene, capture=CAPTURE, open_browser=False) as page:
        assert json.loads(read(page.address + "scene.json"))["views"]
    with pytest.raises(cif.CifError, match=r"nothing\.cif"):
        cif.view(tmp_path / "nothing.cif", open_browser=False)


def test_pages_are_written_as_files(field: cif.Field, tmp_path: Path) -> None:
    scene = tmp_path / "scene.cif"
    field.save(scene)
    page = tmp_path / "scene.html"
    assert cif.run(["export", scene, page]) == 0
    assert page.read_text().startswith("<!doctype html>\n<!-- cif ")
    assert cif.run(["import", page, "-o", tmp_path / "back.cif"]) != 0
    assert cif.run(["export", scene, page, "--force", "--check"]) != 0
