"""`python -m warpfrag` is the command line, for launchers that start a module, such as torchrun."""

import sys

from warpfrag.cli import main

if __name__ == "__main__":
    sys.exit(main())
