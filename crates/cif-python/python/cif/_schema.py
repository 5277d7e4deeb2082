"""The USD schema ``CifInstanceAPI``, and before USD 26.3 that of splats, made known to USD."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

#: Holds ``plugInfo.json`` and ``generatedSchema.usda``, the same as ``schemas/cif`` of the repository.
FOLDER = Path(__file__).parent / "schema"

#: The same of ``ParticleField3DGaussianSplat``, for a USD that has none. A newer one opens no stage with it.
SPLATS = FOLDER / "splats"
_HAS_SPLATS = (26, 3)

_VARIABLE = "PXR_PLUGINPATH_NAME"


def register() -> None:
    """Let USD find the schemas, whether it is loaded already or not.

    Before USD is loaded the search path of its plugins is extended, which costs nothing and reaches child
    processes; after that its registry is told. A registry of schemas that is in use already stays as it is:
    stages open all the same. The schema of splats stays in this process, where the version of USD is known.
    """
    known = [path for path in os.environ.get(_VARIABLE, "").split(os.pathsep) if path]
    if str(FOLDER) not in known:
        os.environ[_VARIABLE] = os.pathsep.join([*known, str(FOLDER)])
    with _without_current_folder():
        if "pxr" not in sys.modules and not _is_old():
            return
        try:
            from pxr import Plug, Usd
        except ImportError:
            return
    folders = [FOLDER, SPLATS] if Usd.GetVersion()[1:] < _HAS_SPLATS else [FOLDER]
    Plug.Registry().RegisterPlugins([str(folder) for folder in folders])


@contextmanager
def _without_current_folder() -> Iterator[None]:
    """Import what is installed: relative entries of the search path are the current folder."""
    before = sys.path[:]
    sys.path[:] = [entry for entry in before if Path(entry).is_absolute()]
    try:
        yield
    finally:
        sys.path[:] = before


def _is_old() -> bool:
    """Return true where the usd-core that is installed, and not loaded yet, has no splats."""
    found = find_spec("pxr")
    if found is None or found.origin is None:
        return False
    for about in Path(found.origin).parents[1].glob("usd_core-*.dist-info"):
        version = re.match(r"usd_core-(\d+)\.(\d+)", about.name)
        return version is not None and (int(version[1]), int(version[2])) < _HAS_SPLATS
    return False
