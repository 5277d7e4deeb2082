"""Build the extension, a zip that Blender installs: `python plugin/blender/build.py [OUT_FOLDER]`."""

from __future__ import annotations

import re
import sys
import zipfile
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent / "cif_scene"
LICENCE = PACKAGE.parents[2] / "LICENSE"
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every entry, so that the same sources give the same file."""


def build(folder: Path) -> Path:
    """Write `<id>-<version>.zip` into a folder; its path."""
    manifest = (PACKAGE / "blender_manifest.toml").read_text(encoding="utf-8")
    name, version = (_value(manifest, key) for key in ("id", "version"))
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{name}-{version}.zip"
    scratch = target.with_suffix(".zip.part")
    files = sorted(
        path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".toml", ".md") and path.is_file()
    )
    entries = {path.relative_to(PACKAGE).as_posix(): path for path in files} | {LICENCE.name: LICENCE}
    with zipfile.ZipFile(scratch, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in entries.items():
            entry = zipfile.ZipInfo(name, EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, path.read_bytes())
    return scratch.replace(target)


def _value(manifest: str, key: str) -> str:
    found = re.search(rf'^{key} = "([^"]+)"$', manifest, re.MULTILINE)
    if found is None:
        sys.exit(f"{PACKAGE / 'blender_manifest.toml'}: has no {key}")
    return found[1]


if __name__ == "__main__":
    print(build(Path(sys.argv[1] if len(sys.argv) > 1 else "out")))
