"""The command, also where another distribution has replaced ``cif/__main__.py``: ``python -m cif4d``."""

import sys

from . import main

if __name__ == "__main__":
    sys.exit(main())
