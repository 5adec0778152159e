"""Files that are there whole or not at all: written under another name in the same folder, then renamed."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Give a name to write to, and rename it to `path` at the end of the block; after an error nothing is left.

    Args:
        path: the file to write or replace; its folder exists.

    Yields:
        A name in the same folder with the same suffix.
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield partial
        # On disk before the rename is: else a power cut could leave the new name on an empty file.
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove what a killed process left behind in a folder."""
    for partial in folder.glob(".*.partial*"):
        partial.unlink(missing_ok=True)
