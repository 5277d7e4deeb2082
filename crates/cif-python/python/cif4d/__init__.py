"""The distribution cif4d, as installed: its module and command are called ``cif``.

PyPI has another distribution that is called ``cif`` and brings a module of that name. Both put their files
into the same folder: whichever is installed last replaces files of the other, and removing one removes files of
both. Nothing of theirs can replace this module, so it is what looks for them, and what the command starts from.
"""

from __future__ import annotations

import sys
import warnings
from itertools import pairwise
from pathlib import Path


def _leave_current_folder() -> None:
    """Take no modules from the current folder where Python runs the command itself, as ``python -m cif``.

    Python searches that folder first then. Programs that import the module have a search path of their own.
    """
    words = pairwise(sys.orig_argv)
    is_command = any(option == "-m" and module in ("cif", "cif4d") for option, module in words)
    current = Path.cwd()
    if is_command and sys.path[:1] == [str(current)] and Path(__file__).parent.parent != current:
        del sys.path[0]


_leave_current_folder()

#: The file of the module that both distributions have.
_SHARED = Path(__file__).parent.parent / "cif" / "__init__.py"

_FIX = "pip uninstall cif && pip install --force-reinstall --no-deps cif4d"


def _other() -> str | None:
    """Return name and version of another distribution whose files lie among ours."""
    # importlib.metadata finds the same, and takes as long as all the rest of `import cif`.
    for about in _SHARED.parents[1].glob("cif-*-info"):
        name, version = about.name.removesuffix(".dist-info").removesuffix(".egg-info").split("-")[:2]
        return f"{name} {version}"
    return None


def _is_ours() -> bool:
    """Return true where the module that is imported as ``cif`` begins with the file of this distribution."""
    try:
        return b"from ._native import" in _SHARED.read_bytes()
    except OSError:
        return False


def problem() -> str | None:
    """Return what is wrong with the module ``cif`` as it is installed, with the fix; None where it is ours."""
    if _is_ours():
        return None
    other = _other()
    by = f"replaced by those of another distribution, '{other}'" if other else "missing or replaced"
    return f"files of the module cif are {by}: {_SHARED.parent}; to repair it: {_FIX}"


def danger() -> str | None:
    """Return a warning, with the fix, where another distribution has a module ``cif`` in the same place."""
    other = _other()
    if other is None:
        return None
    return (
        f"another distribution, '{other}', has a module cif in the same folder as that of cif4d; updating or "
        f"removing either damages the other. Give it an environment of its own: {_FIX}"
    )


def warn() -> None:
    """Warn of another distribution, as `import cif` does."""
    found = danger()
    if found is not None:
        # At the import statement itself: above are this function and the module cif.
        warnings.warn(found, stacklevel=3)


def main() -> int:
    """Run the command line, unless the module ``cif`` is not ours, and return its exit code."""
    broken = problem()
    if broken is not None:
        print(f"Error: {broken}", file=sys.stderr)
        return 1
    found = danger()
    if found is not None:
        print(f"warning: {found}", file=sys.stderr)
    with warnings.catch_warnings():
        # Said above.
        warnings.filterwarnings("ignore", message="another distribution")
        from cif.__main__ import main as run

    return run()
