"""What the benchmarks have in common: interleaved timing, memory, random fragments, tables."""

import ctypes
import gc
import os
import re
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def quiet_warp() -> None:
    """Keep Warp's notes about devices and modules out of the tables; call it before importing warpfrag."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING


def set_threads(count: int) -> None:
    """Let warpfrag and torch run on this many CPU threads."""
    import torch

    os.environ["WARPFRAG_THREADS"] = str(count)
    torch.set_num_threads(count)


def medians(functions: Mapping[str, Callable[[], Any]], repetitions: int) -> dict[str, float]:
    """Return the median time of each function [s], after a call of each that is not counted.

    Repetitions are interleaved, so that a slow moment of the machine hits all functions alike.
    """
    for function in functions.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repetitions):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def memory_growth(function: Callable[[], Any]) -> tuple[int, int]:
    """Return by how much the process grew while a function ran, and by how much with its result alive [bytes].

    Linux with glibc only: free memory is given back and the peak of the resident memory is reset first.
    """
    gc.collect()
    # What malloc has kept back of freed memory would hide what the function takes.
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    before = _resident("VmRSS")
    result = function()
    peak, after = _resident("VmHWM"), _resident("VmRSS")
    del result
    return max(0, peak - before), max(0, after - before)


def _resident(name: str) -> int:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    if found is None:
        raise RuntimeError(f"/proc/self/status has no {name}")
    return 1024 * int(found[1])


def random_pixels(pixel_count: int, per_pixel: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float32 fragments sorted in depth: rgba (P, N, 4), depth (P, N), thickness (P, N).

    Slabs are as long as the distance of two fragments on average, so that about half of all steps merge.
    """
    generator = np.random.default_rng(seed)
    shape = (pixel_count, per_pixel)
    opacity = generator.uniform(0.05, 0.95, (*shape, 1)).astype(np.float32)
    color = generator.random((*shape, 3), dtype=np.float32)
    depth = np.sort(1.0 + generator.random(shape, dtype=np.float32), axis=1)
    thickness = generator.random(shape, dtype=np.float32) * np.float32(2.0 / per_pixel)
    return np.concatenate([color * opacity, opacity], axis=2), depth, thickness


def ragged(rgba: Any, depth: Any, thickness: Any) -> Any:
    """Return `random_pixels` (NumPy arrays or torch tensors) as `Fragments`, in one row of pixels, sharing memory."""
    import warpfrag as wf

    pixel_count, per_pixel = depth.shape
    offsets = np.arange(pixel_count + 1, dtype=np.int32) * per_pixel
    if not isinstance(rgba, np.ndarray):
        import torch

        offsets = torch.from_numpy(offsets)
    return wf.Fragments(rgba.reshape(-1, 4), depth.reshape(-1), thickness.reshape(-1), offsets, (1, pixel_count))


def show(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    widths = [max(len(row[i]) for row in (columns, *rows)) for i in range(len(columns))]
    print(f"\n{title}\n")
    for row in (columns, ["-" * width for width in widths], *rows):
        print("| " + " | ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) + " |")


def milliseconds(seconds: float | None) -> str:
    """Write a time, or a dash for one that was not taken."""
    return "-" if seconds is None else f"{1e3 * seconds:.2f} ms"


def ratio(numerator: float | None, denominator: float | None) -> str:
    """Write a ratio, or a dash where there is none."""
    return "-" if numerator is None or not denominator else f"{numerator / denominator:.2f}"
