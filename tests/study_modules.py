"""Modules of studies, which are no part of the package, for tests."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


@contextmanager
def study_modules(folder: Path, names: Sequence[str], brought: Sequence[str] = ()) -> Iterator[SimpleNamespace]:
    """Import modules from a study's folder, and forget them at the end of the block.

    Args:
        folder: the study's folder.
        names: the modules.
        brought: further ones that these import from studies.
    """
    before = list(sys.path)
    sys.path.insert(0, str(folder))
    try:
        yield SimpleNamespace(**{name: __import__(name) for name in names})
    finally:
        sys.path[:] = before
        for name in (*names, *brought):
            sys.modules.pop(name, None)
