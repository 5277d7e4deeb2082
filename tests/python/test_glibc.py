"""The library needs nothing that glibc 2.28 lacks, so that `make wheel` can link it for older systems.

Linked on this machine it asks for the newest version of every function, and the machine's own glibc has the
older ones too, back to the first. What that has in no version up to 2.28 was added later.
"""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from cif import _native

OLDEST = (2, 28)

#: Functions of before that glibc 2.33 began to export; until then they were linked in from libc_nonshared.a.
LINKED_IN = {f"{name}{bits}" for name in ["stat", "fstat", "lstat", "fstatat", "mknod"] for bits in ["", "64"]}

pytestmark = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc" or not shutil.which("readelf"), reason="glibc and readelf are needed"
)


def symbols(library: Path, *, defined: bool) -> set[tuple[str, tuple[int, ...]]]:
    """Return functions with their versions of glibc that a library has, or needs in any case."""
    listed = subprocess.run(
        ["readelf", "--dyn-syms", "--wide", library], capture_output=True, text=True, check=True
    )
    found = set()
    for line in listed.stdout.splitlines():
        match = re.search(r" (GLOBAL|WEAK) +\w+ +(\w+) ([\w.]+)@@?GLIBC_([\d.]+)", line)
        if match and (match[2] != "UND") == defined and (defined or match[1] == "GLOBAL"):
            found.add((match[3], tuple(map(int, match[4].split(".")))))
    return found


def too_new(library: Path) -> dict[str, tuple[int, ...]]:
    """Return what a library needs that glibc had not in its oldest version that will do."""
    maps = Path("/proc/self/maps").read_text()
    files = set(re.findall(r"\S+/(?:ld-linux|lib(?:c|m|dl|pthread|rt))[-.]\S*", maps))
    had = {name for file in files for name, version in symbols(Path(file), defined=True) if version <= OLDEST}
    needed = symbols(library, defined=False)
    return {name: v for name, v in needed if v > OLDEST and name not in had | LINKED_IN}


def test_nothing_is_newer_than_glibc_2_28() -> None:
    library = Path(_native.__file__)
    assert any(name == "malloc" for name, _ in symbols(library, defined=False))
    assert too_new(library) == {}


@pytest.mark.skipif(not shutil.which("cc"), reason="a C compiler is needed")
def test_what_is_newer_is_found(tmp_path: Path) -> None:
    source = tmp_path / "new.c"
    source.write_text(
        "#include <math.h>\n#include <stdlib.h>\n"
        "double old(double a) { return hypot(a, a); }\n"
        "unsigned recent(void) { return arc4random(); }\n"
    )
    library = tmp_path / "new.so"
    done = subprocess.run(
        ["cc", "-shared", "-fPIC", "-o", library, source, "-lm"], capture_output=True, text=True
    )
    if done.returncode or "arc4random" in done.stderr:
        pytest.skip("this glibc is older than arc4random")
    assert set(too_new(library)) == {"arc4random"}
