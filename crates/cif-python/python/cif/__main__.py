"""The ``cif`` command: ``cif ...`` or ``python -m cif ...``."""

from __future__ import annotations

import signal
import sys

from . import _native


def main() -> int:
    """Run the command line and return its exit code."""
    # Python only notes Ctrl-C and acts on it between its own instructions, of which there are none while Rust
    # works. The system's default ends the process at once; commands that save first install their own handler.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _native.main(["cif", *sys.argv[1:]])


if __name__ == "__main__":
    import cif4d

    broken = cif4d.problem()
    sys.exit(f"Error: {broken}" if broken else main())
