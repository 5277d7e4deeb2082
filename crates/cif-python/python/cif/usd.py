"""Objects of USD stages by label, through usd-core itself.

Works on every stage with semantic labels (``UsdSemantics.LabelsAPI``), whoever wrote it::

    import cif.usd

    for prim in cif.usd.find("table.usda", label="mug*", time=36):
        print(prim.GetPath())
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Union

from ._native import CifError, LabelPattern

if find_spec("pxr") is None:
    raise ImportError("cif.usd needs USD, which is not installed: pip install 'cif4d[usd]'", name="pxr")

if TYPE_CHECKING:
    from pxr import Usd

Time = Union[None, float, tuple[float, float], "Usd.TimeCode"]

__all__ = ["find", "labels"]

# Stages opened by path, with what their files looked like then.
_opened: dict[Path, tuple[tuple[int, int, int], Usd.Stage]] = {}


def find(
    stage: Usd.Stage | str | os.PathLike[str],
    label: str | None = None,
    *,
    time: Time = None,
    taxonomy: str | None = None,
    inherited: bool = False,
) -> list[Usd.Prim]:
    """Return the prims that carry a label, in stage order.

    ``label`` is a pattern (``*`` and ``?`` are wildcards; case does not matter) for any label of the prim:
    its class, its human label or its unique name; ``None`` takes every labelled prim. ``taxonomy`` lets only
    labels of one taxonomy count, such as ``"class"`` or ``"instance"``. Labels are those at ``time``: a time
    code, a ``(first, last)`` interval in which they hold at any time, or by default the default time. With
    ``inherited`` the prims below a labelled prim count too.

    A stage given by path stays open, because prims do not outlive their stage; asked again, it is read again
    where its file has changed. Open it yourself to decide how long it lives.
    """
    opened = _open(stage)
    pattern = None if label is None else LabelPattern(label)
    found = []
    for prim, by_taxonomy in _walk(opened, time, inherited):
        names = [
            name
            for key, values in by_taxonomy.items()
            if taxonomy is None or key == taxonomy
            for name in values
        ]
        if any(pattern is None or pattern.matches(name) for name in names):
            found.append(prim)
    return found


def labels(prim: Usd.Prim, time: Time = None) -> dict[str, list[str]]:
    """Return the labels that a prim itself carries, by taxonomy, sorted."""
    from pxr import UsdSemantics

    span = _span(time)
    return {
        taxonomy: sorted(
            str(label) for label in UsdSemantics.LabelsQuery(taxonomy, span).ComputeUniqueDirectLabels(prim)
        )
        for taxonomy in map(str, UsdSemantics.LabelsAPI.GetDirectTaxonomies(prim))
    }


def _open(stage: Usd.Stage | str | os.PathLike[str]) -> Usd.Stage:
    from pxr import Tf, Usd

    if isinstance(stage, Usd.Stage):
        return stage
    path = Path(stage).absolute()
    if not path.is_file():
        raise CifError(f"{stage}: no such file")
    status = path.stat()
    stamp = (status.st_mtime_ns, status.st_size, status.st_ino)
    known = _opened.get(path)
    try:
        if known is None:
            opened = Usd.Stage.Open(str(path))
        else:
            opened = known[1]
            if known[0] != stamp:
                opened.Reload()
    except Tf.ErrorException as error:
        raise CifError(f"{stage} cannot be opened as a USD stage: {error}") from error
    _opened[path] = (stamp, opened)
    return opened


def _span(time: Time) -> object:
    from pxr import Gf, Usd

    if time is None:
        return Usd.TimeCode.Default()
    if isinstance(time, Usd.TimeCode):
        return time
    if isinstance(time, tuple):
        first, last = time
        if first > last:
            raise CifError(f"the interval {time} ends before it begins; give the earlier time first")
        return Gf.Interval(first, last)
    return Usd.TimeCode(time)


def _walk(stage: Usd.Stage, time: Time, inherited: bool) -> Iterable[tuple[Usd.Prim, dict[str, list[str]]]]:
    from pxr import UsdSemantics

    span = _span(time)
    # A query remembers what it has seen: one per taxonomy for the whole walk.
    queries: dict[str, UsdSemantics.LabelsQuery] = {}
    for prim in stage.Traverse():
        if inherited:
            taxonomies = UsdSemantics.LabelsAPI.ComputeInheritedTaxonomies(prim)
        else:
            taxonomies = UsdSemantics.LabelsAPI.GetDirectTaxonomies(prim)
        by_taxonomy = {}
        for taxonomy in map(str, taxonomies):
            if taxonomy not in queries:
                queries[taxonomy] = UsdSemantics.LabelsQuery(taxonomy, span)
            query = queries[taxonomy]
            if inherited:
                names = query.ComputeUniqueInheritedLabels(prim)
            else:
                names = query.ComputeUniqueDirectLabels(prim)
            by_taxonomy[taxonomy] = [str(name) for name in names]
        yield prim, by_taxonomy
