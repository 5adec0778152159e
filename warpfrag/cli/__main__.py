"""`python -m warpfrag.cli` is the command line, as `python -m warpfrag` is."""

import sys

from warpfrag.cli import main

if __name__ == "__main__":
    sys.exit(main())
