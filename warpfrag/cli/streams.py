"""Standard output and standard error: one line for each complaint, and what happens when they are closed or full."""

import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


def open_streams() -> None:
    """Give what is closed (as by `2>&-`) an end to write to, lest a file that is opened later takes its place."""
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is not None:
            continue
        opened = os.open(os.devnull, os.O_WRONLY)
        if opened != descriptor:
            os.dup2(opened, descriptor)
            os.close(opened)
        setattr(sys, name, open(descriptor, "w", encoding="utf-8", closefd=False))  # noqa: SIM115


def complain(text: str, status: int) -> int:
    """Write one line on standard error; return the status."""
    with suppress(OSError, ValueError):
        print(f"warpfrag: {' '.join(text.split())}", file=sys.stderr)
    return status


def close_output(error: OSError | None = None) -> int:
    """Write what is still to be written on standard output.

    Args:
        error: why writing has failed already.

    Returns:
        0, or 2 where it failed, which is said then.
    """
    try:
        sys.stdout.flush()
    except OSError as failure:
        error = error or failure
    if error is None:
        return 0
    # What Python cannot write at its end it would complain about once more.
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return complain(f"standard output: cannot be written ({error.strerror or error})", 2)


@contextmanager
def warnings_on_one_line() -> Iterator[None]:
    """Show warnings as complaints are shown, without Python's line of source."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        complain(f"warning: {message}", 0)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def start_warp(verbose: bool) -> None:
    """Start Warp up; must come before its first use.

    Args:
        verbose: whether Warp's notes about devices and the modules that it compiles are shown.
    """
    import warp as wp

    if verbose:
        wp.init()
        return
    wp.config.log_level = wp.LOG_WARNING
    # That there is no GPU is told by Warp's native half, straight to the file descriptor whatever the level: no matter
    # for a warning.
    with suppress(OSError, ValueError):
        sys.stderr.flush()
    try:
        before = os.dup(2)
    except OSError:
        wp.init()
        return
    with tempfile.TemporaryFile() as told:
        os.dup2(told.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(before, 2)
            os.close(before)
        told.seek(0)
        lines = told.read().decode(errors="replace").splitlines()
    for line in lines:
        if "NVIDIA CUDA driver" not in line:
            complain(line, 0)
