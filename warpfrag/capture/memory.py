"""How much memory a capture takes, and how much it may take: predicted after the count, before anything is stored."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from warpfrag.capture.surfaces import CameraSurfaces
from warpfrag.errors import check_number
from warpfrag.raster.triangles import RasterTriangles

# Triangle, object and primitive of a fragment [bytes]; then colour and opacity, depth, z-thickness: numbers.
FRAGMENT_INDICES = 12
FRAGMENT_NUMBERS = 6
# Sums of the gradients of three corners, all in float64 [bytes]: position, colour and opacity, thickness.
STRIP_BYTES = 3 * 8 * (3 + 4 + 1)
# Sorting a triangle's three corners by vertex: two arrays of twice the length [bytes].
CORNER_SORT_BYTES = 3 * 2 * 2 * 4


def free_memory(device: wp.Device) -> int | None:
    """Return the memory that is free for this process on a device [bytes], or None where the system does not say."""
    if not device.is_cpu:
        return device.free_memory
    found = [_available(), _left_in_group()]
    return min((amount for amount in found if amount is not None), default=None)


def _available() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _left_in_group() -> int | None:
    """Return what the container's limit leaves (cgroup version 2)."""
    try:
        limit, used = (Path(f"/sys/fs/cgroup/memory.{name}").read_text().strip() for name in ("max", "current"))
        return None if limit == "max" else max(0, int(limit) - int(used))
    except (OSError, ValueError):
        return None


def allowed_memory(memory_limit: float | None, device: wp.Device) -> float:
    """Return the limit of a capture [bytes]: the given one, or half of the free memory.

    Raises:
        TypeError: the limit is no number.
        ValueError: the limit is not above 0.
    """
    if memory_limit is None:
        free = free_memory(device)
        return float("inf") if free is None else 0.5 * free
    return check_number("memory_limit", memory_limit, above=0.0)


def fragment_bytes(scalar: type, gradient: bool) -> int:
    """Return the bytes a fragment takes, with its gradient if that is wanted."""
    size = 4 if scalar is wp.float32 else 8
    return FRAGMENT_INDICES + FRAGMENT_NUMBERS * size * (2 if gradient else 1)


@dataclass(frozen=True)
class CaptureSizes:
    """How much there is to capture.

    Attributes:
        triangle_count: number of triangles.
        listed: entries of the lists of triangles by band of rows; those of all triangles where there are none.
    """

    triangle_count: int
    listed: int

    @staticmethod
    def of(triangles: RasterTriangles) -> "CaptureSizes":
        """Return the sizes of triangles."""
        count = triangles.count
        return CaptureSizes(count, count if triangles.listed is None else triangles.listed.shape[0])

    def fixed_bytes(self, gradient: bool) -> int:
        """Return the bytes that a capture takes whatever the number of fragments."""
        fixed = 28 * self.triangle_count + 4 * self.listed
        if gradient:
            fixed += STRIP_BYTES * min(self.listed, self.triangle_count) + CORNER_SORT_BYTES * self.triangle_count
        return fixed


def split_rows(row_counts: np.ndarray, row_bytes: float, fragment_size: int, allowed: float) -> list[tuple[int, int]]:
    """Cut an image into as few bands of rows [begin, end) as memory allows, from the top.

    Args:
        row_counts: fragments of each row, (H,).
        row_bytes: memory of a row without fragments [bytes].
        fragment_size: memory of a fragment [bytes].
        allowed: memory of a band [bytes].

    Raises:
        MemoryError: a single row needs more.
    """
    needed = row_counts.astype(np.float64) * fragment_size + row_bytes
    worst = int(needed.argmax())
    if needed[worst] > allowed:
        refuse(needed[worst], allowed, f"row {worst} with its {row_counts[worst]} fragments")
    bands = []
    begin, used = 0, 0.0
    for row, bytes in enumerate(needed):
        if used + bytes > allowed:
            bands.append((begin, row))
            begin, used = row, 0.0
        used += bytes
    return [*bands, (begin, len(row_counts))]


def refuse(needed: float, allowed: float, what: str) -> None:
    """Raise the error that `what` needs more memory than allowed."""
    raise MemoryError(
        f"capture: {what} would take {_readable(needed)}, expected at most {_readable(allowed)} (memory_limit; half of "
        "the free memory by default)"
    )


def _readable(bytes: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if abs(bytes) < 1024:
            return f"{bytes:.4g} {unit}"
        bytes /= 1024
    return f"{bytes:.4g} GiB"


@dataclass(frozen=True)
class Budget:
    """What a capture may take, and takes already.

    Attributes:
        fixed: memory whatever the number of fragments [bytes].
        fragment: memory of a fragment, with its gradient if that is wanted [bytes].
        allowed: the limit [bytes].
    """

    fixed: int
    fragment: int
    allowed: float

    @staticmethod
    def of(sizes: CaptureSizes, memory_limit: float | None, surfaces: CameraSurfaces) -> "Budget":
        """Return the budget of a capture of surfaces under a limit."""
        gradient = surfaces.differentiable
        size = fragment_bytes(surfaces.number, gradient)
        return Budget(sizes.fixed_bytes(gradient), size, allowed_memory(memory_limit, surfaces.device))

    def allows(self, fragment_count: int) -> bool:
        """Tell whether there is memory for so many fragments."""
        return self.fixed + fragment_count * self.fragment <= self.allowed

    def reserve(self, storage: int, what: str, fragment_count: int) -> None:
        """Raise if a storage of so many bytes, or the fragments that are to come of it, need too much memory."""
        needed = self.fixed + max(storage, fragment_count * self.fragment)
        if needed > self.allowed:
            refuse(needed, self.allowed, what)
