"""The USD schema ``CifInstanceAPI``, made known to usd-core."""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: Holds ``plugInfo.json`` and ``generatedSchema.usda``, the same as ``schemas/cif`` of the repository.
FOLDER = Path(__file__).parent / "schema"
_VARIABLE = "PXR_PLUGINPATH_NAME"


def register() -> None:
    """Let usd-core find the schema, whether it is loaded already or not.

    Before usd-core is loaded the search path of its plugins is extended, which costs nothing and reaches child
    processes; after that its registry is told. A registry of schemas that is in use already stays as it is:
    stages open all the same.
    """
    known = [path for path in os.environ.get(_VARIABLE, "").split(os.pathsep) if path]
    if str(FOLDER) not in known:
        os.environ[_VARIABLE] = os.pathsep.join([*known, str(FOLDER)])
    if "pxr" in sys.modules:
        try:
            from pxr import Plug
        except ImportError:
            return
        Plug.Registry().RegisterPlugins(str(FOLDER))
