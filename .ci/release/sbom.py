"""Complete the SBOM of a wheel: `sbom.py IN OUT RUSTC ZIG`, the last two as these tools print their versions.

cargo-cyclonedx lists crates, and names ours by their folder on this machine. Here they get names without it,
and what is inside the library and is no crate is added. Run in the sources that the wheel is built from.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def inside(rustc: str, zig: str) -> list[tuple[str, str, str, str, str]]:
    """Return kind, name, version, licence and description of what is inside and is no crate."""
    either, llvm = "MIT OR Apache-2.0", "Apache-2.0 WITH LLVM-exception"
    found = [
        ("library", "rust-std", rustc.split()[1], either, "Rust's own library: LICENSE-rust.html"),
        ("library", "compiler-rt", zig, "MIT", "Zig's functions that compilers call: LICENSE-zig.txt"),
        ("library", "libunwind", zig, llvm, "LLVM's, which Zig brings: LICENSE-zig.txt"),
        ("file", "page", "", "Apache-2.0", "the page of cif view, plugin/web"),
        ("file", "schemas", "", "Apache-2.0", "USD schemas, cif/schema"),
    ]
    build = Path("crates/cif/build.rs")
    if build.exists() and "tabletop-mini" in build.read_text(encoding="utf-8"):
        found.append(("data", "tabletop-mini", "", "CC0-1.0", "capture and scene of cif demo"))
    return found


def main() -> None:
    """Read, complete and write."""
    source, target, rustc, zig = sys.argv[1:]
    here = f"path+file://{Path.cwd()}/"
    bom = json.loads(Path(source).read_text(encoding="utf-8").replace(here, "path+file:///cif/"))
    root = bom["metadata"]["component"]
    added = []
    for kind, name, version, licence, description in inside(rustc, zig):
        component = {"type": kind, "bom-ref": f"inside:{name}", "name": name}
        if version:
            component["version"] = version
        added.append(component | {"description": description, "licenses": [{"expression": licence}]})
    bom["components"] += added
    for dependency in bom["dependencies"]:
        if dependency["ref"] == root["bom-ref"]:
            dependency["dependsOn"] = dependency.get("dependsOn", []) + [each["bom-ref"] for each in added]
    bom["dependencies"] += [{"ref": each["bom-ref"]} for each in added]
    Path(target).write_text(json.dumps(bom, indent=2) + "\n", encoding="utf-8")


main()
