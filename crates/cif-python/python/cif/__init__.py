"""Consistent Instance Field: captures in, segmented dynamic Gaussian scenes out.

The command line runs in this process: ``cif.run(["train", "captures/table", "-o", "table.cif"])``.
Captures, trained scenes and stages are also here as objects with numpy arrays::

    import cif

    field = cif.train("captures/table", "table.cif", preset="draft", callback=print)
    name, time_index, camera = field.cameras[0]
    picture = field.render(camera, field.times[time_index])["color"]
    path = field.trajectory("red mug")["translations"]
    scores = cif.evaluate(field, "captures/table")
    field.export("table.usdc")
    edited, changes = cif.import_scene("table.usdc", base=field)
    cif.query_stage("table.usdc", "red mug", time_code=12)
    cif.view(field, capture="captures/table")
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import cif4d

from . import _native, _schema
from ._native import (
    Camera,
    CifError,
    Dataset,
    Field,
    Picture,
    __version__,
    diff,
    evaluate,
    import_scene,
    open_dataset,
    query_stage,
    train,
    usd_version,
)
from ._view import Page, view

__all__ = [
    "Camera",
    "CifError",
    "Dataset",
    "Field",
    "Page",
    "Picture",
    "__version__",
    "diff",
    "evaluate",
    "import_scene",
    "open_dataset",
    "query_stage",
    "run",
    "train",
    "usd_version",
    "view",
]

cif4d.warn()
_schema.register()


def run(arguments: Sequence[str | os.PathLike[str]]) -> int:
    """Run a command line such as ``["info", "captures/table"]`` and return its exit code.

    0 is success, 1 a failure that was explained on stderr, 2 a command line that was not understood.

    Signals stay with this process. Ctrl-C stops the command: `train` saves first, so that it can go on with
    ``--resume``, then KeyboardInterrupt is raised.
    """
    return _native.run(["cif", *map(os.fspath, arguments)])
