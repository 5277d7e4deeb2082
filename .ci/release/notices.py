"""Print the notices of the crates in `cargo metadata` (standard input), which cargo-about leaves out.

Apache-2.0 asks for them beside the licence. Crates that only build or test cif are among them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def main() -> None:
    """Print every file NOTICE of a crate that is not our own."""
    for package in sorted(json.load(sys.stdin)["packages"], key=lambda package: package["id"]):
        if package["source"] is None:
            continue
        for notice in sorted(Path(package["manifest_path"]).parent.glob("NOTICE*")):
            print(f"{'=' * 79}\n{notice.name} of {package['name']} {package['version']}\n{'-' * 79}")
            print(notice.read_text(encoding="utf-8"))


main()
