"""Scenes in a browser, served by a process of their own."""

from __future__ import annotations

import atexit
import html
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from ._native import CifError, Dataset, Field

__all__ = ["Page", "view"]


class Page:
    """A page that `view` serves until it is closed, or this process ends."""

    def __init__(
        self, address: str, process: subprocess.Popen[str], folder: tempfile.TemporaryDirectory[str] | None
    ):
        self.address = address
        self._process = process
        self._folder = folder
        atexit.register(self.close)

    def close(self) -> None:
        """End the page."""
        atexit.unregister(self.close)
        self._process.terminate()
        self._process.communicate()
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Page({self.address})"

    def _repr_html_(self) -> str:
        address = html.escape(self.address)
        return f'<a href="{address}" target="_blank" rel="noopener noreferrer">{address}</a>'


def view(
    scene: Field | Dataset | str | os.PathLike[str],
    *,
    capture: str | os.PathLike[str] | None = None,
    open_browser: bool = True,
) -> Page:
    """Show a scene, an exported file or a capture in a browser, as `cif view` does.

    scene is a field, a dataset, or the path of a scene, a stage, a glTF file, a PLY or a capture; capture is
    compared with the scene. The page is there until it is closed or this process ends.
    """
    folder = None
    if isinstance(scene, Field):
        folder = tempfile.TemporaryDirectory(prefix="cif-view-")
        path = Path(folder.name) / "field.cif"
        scene.save(path)
    else:
        path = Path(scene.root) if isinstance(scene, Dataset) else Path(scene)
    command = [sys.executable, "-m", "cif", "view", os.fspath(path)]
    if capture is not None:
        command += ["--capture", os.fspath(capture)]
    if not open_browser:
        command.append("--no-open")
    # A file, because a pipe that nobody reads would fill up in time.
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        if address:
            return Page(address, process, folder)
        process.communicate()
        errors.seek(0)
        told = errors.read().strip()
    if folder is not None:
        folder.cleanup()
    raise CifError(told or "cif view ended before its page was there")
