"""How much memory a capture takes, and how much it may take: predicted after the count, before anything is stored.

Everything that grows with the scene or the image is counted: surfaces, triangles, fragments, images, and on the way
back their gradients. (Not counted: the scene itself, and scratch memory of threads.)
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpfrag.capture.surfaces import CameraSurfaces
from warpfrag.errors import check_number
from warpfrag.raster.strips import strip_counts
from warpfrag.raster.triangles import RasterTriangles

# Triangle, object and primitive of a fragment [bytes]; then colour and opacity, depth, z-thickness: numbers.
FRAGMENT_INDICES = 12
FRAGMENT_NUMBERS = 6
# Count of a pixel's fragments and where they begin [bytes].
PIXEL_INDICES = 8
# What an image is put over its background by, and what the gradient of that takes, beside both: numbers of a pixel.
BACKGROUND_NUMBERS = 9
BACKGROUND_GRADIENT_NUMBERS = 12
# Corners and box of a triangle, and what listing it by band takes for a moment; of an entry of the lists [bytes].
TRIANGLE_BYTES = 28 + 40
LISTED_BYTES = 4 + 24
# Position, colour and opacity, thickness of a vertex: numbers.
VERTEX_NUMBERS = 8
# On the way back: the gradient of a vertex in float64, in its world, and that of the vertex given [bytes].
VERTEX_CHAIN_BYTES = 2 * 3 * 8
# Sums of the gradients of three corners, all in float64, of a strip, and its triangle [bytes].
STRIP_BYTES = 3 * 8 * (3 + 4 + 1) + 4
# Sorting a triangle's three corners by vertex: two arrays of twice the length; its strips [bytes].
CORNER_SORT_BYTES = 3 * 2 * 2 * 4 + 8


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


def fragment_bytes(number: type, gradient: bool) -> int:
    """Return the bytes a fragment takes, with its gradient if that is wanted."""
    size = wp.types.type_size_in_bytes(number)
    return FRAGMENT_INDICES + FRAGMENT_NUMBERS * size * (2 if gradient else 1)


@dataclass(frozen=True)
class CaptureSizes:
    """How much there is to capture.

    Attributes:
        number: Warp type of the numbers.
        vertex_count: number of vertices.
        triangle_count: number of triangles.
        listed: entries of the lists of triangles by band of rows.
        strip_count: strips that these are cut into on the way back; 0 where none is wanted.
        pixel_count: number of pixels.
        map_entries: entries of all thickness maps.
    """

    number: Any
    vertex_count: int
    triangle_count: int
    listed: int
    strip_count: int
    pixel_count: int
    map_entries: int

    @staticmethod
    def of(triangles: RasterTriangles, surfaces: CameraSurfaces) -> "CaptureSizes":
        """Return the sizes of triangles of surfaces."""
        strip_count = strip_counts(triangles.boxes)[1] if surfaces.differentiable else 0
        listed = triangles.count if triangles.listed is None else triangles.listed.shape[0]
        map_entries = 0 if surfaces.maps is None else math.prod(surfaces.maps.shape)
        sizes = (surfaces.points.shape[0], triangles.count, listed, strip_count, triangles.window.pixel_count)
        return CaptureSizes(surfaces.number, *sizes, map_entries)

    @property
    def surface_bytes(self) -> int:
        """Memory of the surfaces and of their triangles [bytes]."""
        numbers = self.vertex_count * VERTEX_NUMBERS + self.map_entries
        lists = self.triangle_count * TRIANGLE_BYTES + self.listed * LISTED_BYTES
        return numbers * wp.types.type_size_in_bytes(self.number) + lists

    @property
    def gradient_bytes(self) -> int:
        """Memory that gradients by vertex and map take, those of a part and their sum so far [bytes]."""
        numbers = 2 * (self.vertex_count * VERTEX_NUMBERS + self.map_entries)
        chain = self.vertex_count * (VERTEX_CHAIN_BYTES + 4)
        strips = self.strip_count * STRIP_BYTES + self.triangle_count * CORNER_SORT_BYTES
        return numbers * wp.types.type_size_in_bytes(self.number) + chain + strips


@dataclass(frozen=True)
class Budget:
    """What a capture may take, and what it takes.

    Attributes:
        number: Warp type of the numbers.
        gradient: whether gradients are wanted.
        image: whether fragments become an image; else they are the result.
        layer: memory of a pixel's layers, where these are stored [bytes].
        fixed: memory whatever the number of fragments, images included [bytes].
        allowed: the limit [bytes].
    """

    number: Any
    gradient: bool
    image: bool
    layer: int
    fixed: int
    allowed: float

    @staticmethod
    def of(
        sizes: CaptureSizes,
        memory_limit: float | None,
        surfaces: CameraSurfaces,
        *,
        image: bool = False,
        layer: int = 0,
    ) -> "Budget":
        """Return the budget of a capture of surfaces under a limit.

        Args:
            sizes: how much there is to capture.
            memory_limit: the limit [bytes]; default half of what is free.
            surfaces: the surfaces.
            image: whether fragments become an image.
            layer: memory of a pixel's layers, where these are stored [bytes].
        """
        gradient = surfaces.differentiable
        fixed = sizes.surface_bytes + (sizes.gradient_bytes if gradient else 0)
        if image:
            # The image, and its gradient or its parts.
            fixed += 2 * 4 * wp.types.type_size_in_bytes(sizes.number) * sizes.pixel_count
        allowed = allowed_memory(memory_limit, surfaces.device)
        return Budget(sizes.number, gradient, image, layer * (2 if gradient else 1), fixed, allowed)

    def needed(self, fragment_count: Any, pixel_count: int) -> Any:
        """Return the memory of fragments and their pixels [bytes], beside what is fixed; counts may be an array."""
        size = wp.types.type_size_in_bytes(self.number)
        shaded = fragment_count * fragment_bytes(self.number, gradient=False)
        differentiated = fragment_count * fragment_bytes(self.number, gradient=True)
        pixels = pixel_count * (PIXEL_INDICES + self.layer)
        if not self.image:
            return pixels + (differentiated if self.gradient else shaded)
        if not self.gradient:
            return pixels + np.maximum(shaded, pixel_count * BACKGROUND_NUMBERS * size)
        return pixels + np.maximum(shaded + pixel_count * BACKGROUND_GRADIENT_NUMBERS * size, differentiated)

    def allows(self, fragment_count: int, pixel_count: int) -> bool:
        """Tell whether there is memory for so many fragments in so many pixels."""
        return self.fixed + self.needed(fragment_count, pixel_count) <= self.allowed

    def check(self, fragment_count: int, pixel_count: int, what: str, storage: int = 0) -> None:
        """Raise unless there is memory for fragments and their pixels, or for a storage of so many bytes.

        Raises:
            MemoryError: there is not.
        """
        needed = self.fixed + max(storage, self.needed(fragment_count, pixel_count))
        if needed > self.allowed:
            refuse(needed, self.allowed, what)


def split_rows(
    row_counts: np.ndarray, row_bytes: np.ndarray, allowed: float, fixed: float = 0.0
) -> list[tuple[int, int]]:
    """Cut an image into as few bands of rows [begin, end) as memory allows, from the top.

    Args:
        row_counts: fragments of each row, (H,).
        row_bytes: memory of each row [bytes], (H,).
        allowed: memory of a band and of what is fixed [bytes].
        fixed: memory of what is fixed [bytes].

    Raises:
        MemoryError: a single row needs more.
    """
    worst = int(row_bytes.argmax())
    if fixed + row_bytes[worst] > allowed:
        refuse(fixed + row_bytes[worst], allowed, f"row {worst} with its {row_counts[worst]} fragments")
    bands = []
    begin, used = 0, fixed
    for row, needed in enumerate(row_bytes):
        if used + needed > allowed:
            bands.append((begin, row))
            begin, used = row, fixed
        used += needed
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
