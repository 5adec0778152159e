"""The command line."""

from warpfrag.cli.app import main

__all__ = ["main"]
