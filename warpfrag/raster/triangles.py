"""Triangles as the walk over their pixels takes them: corners in order, boxes of pixels, and lists by band of rows."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import Array, Vector3, in_precisions, kernels
from warpfrag.raster.ray import Rays, Window, before, bounds, load_point

wp.set_module_options({"enable_backward": False})

# Rows of a band: few, so that a piece of work looks at few triangles that it does not cover; not so few that most
# triangles lie in several.
BAND_ROWS = wp.constant(16)


@in_precisions
class TriangleArrays:
    """`RasterTriangles` as kernels take them; without lists these are empty."""

    points: Array[Vector3]
    corners: Array[wp.vec3i]
    boxes: Array[wp.vec4i]
    listed: Array[wp.int32]
    band_begins: Array[wp.int32]
    rays: Rays


@dataclass(frozen=True)
class RasterTriangles:
    """Triangles, and which pixels each may cover.

    Attributes:
        points: corners in camera space [scene units], float32 or float64, (V, 3).
        corners: indices into `points`, those of a triangle ordered by their coordinates, (N, 3) int32.
        boxes: rows and columns [top, bottom) x [left, right) of the window that a triangle may cover, (N, 4) int32.
        window: the pixels.
        listed: for each band of rows the triangles whose box reaches into it, int32; None on CUDA.
        band_begins: band b has the triangles listed[band_begins[b] : band_begins[b + 1]], int32; None on CUDA.
    """

    points: wp.array
    corners: wp.array
    boxes: wp.array
    window: Window
    listed: wp.array | None
    band_begins: wp.array | None

    @property
    def device(self) -> wp.Device:
        """Where the arrays are."""
        return self.points.device

    @property
    def count(self) -> int:
        """Number of triangles, N."""
        return self.corners.shape[0]

    def arrays(self, *, by_band: bool) -> Any:
        """Return the triangles as kernels take them; with lists of each band's, which are made if there are none."""
        arrays = TriangleArrays[self.points.dtype]()
        arrays.points, arrays.corners = as_vectors(self.points), as_vectors(self.corners)
        arrays.boxes, arrays.rays = as_vectors(self.boxes), self.window.rays()
        if by_band:
            arrays.listed, arrays.band_begins = (
                (self.listed, self.band_begins) if self.listed is not None else _lists(self.boxes, self.window)
            )
        return arrays


@kernels
def prepare(number: Any) -> Any:
    """Return the kernel that prepares triangles."""

    def kernel(
        span: Span,
        points: wp.array(dtype=wp.types.vector(3, number)),
        faces: wp.array(dtype=wp.vec3i),
        rays: Rays,
        corners: wp.array(dtype=wp.vec3i),
        boxes: wp.array(dtype=wp.vec4i),
    ):
        """Order the corners of each triangle and find its box.

        Args:
            span: the triangles.
            points: camera space [scene units], (V,).
            faces: indices into `points`, (N,).
            rays: the pixels.
            corners: output, the same indices in the order of the points' coordinates, (N,).
            boxes: output, rows [top, bottom) and columns [left, right), (N,).
        """
        for face in range(span.begin + wp.tid(), span.end, span.stride):
            given = faces[face]
            i = given[0]
            j = given[1]
            k = given[2]
            if before(load_point(points, j), load_point(points, i)):
                swapped = i
                i = j
                j = swapped
            if before(load_point(points, k), load_point(points, i)):
                swapped = i
                i = k
                k = swapped
            if before(load_point(points, k), load_point(points, j)):
                swapped = j
                j = k
                k = swapped
            corners[face] = wp.vec3i(i, j, k)
            boxes[face] = bounds(rays, load_point(points, i), load_point(points, j), load_point(points, k))

    return kernel


def prepare_triangles(points: wp.array, faces: wp.array, window: Window) -> RasterTriangles:
    """Order the corners of each triangle and find the box of pixels that it may cover.

    Args:
        points: corners in camera space [scene units], float32 or float64, (V, 3).
        faces: indices into `points`, (N, 3) int32.
        window: the pixels.
    """
    device = points.device
    corners = wp.empty(faces.shape, dtype=int, device=device)
    boxes = wp.empty((faces.shape[0], 4), dtype=int, device=device)
    inputs = [as_vectors(points), as_vectors(faces), window.rays(), as_vectors(corners), as_vectors(boxes)]
    launch(prepare(points.dtype), faces.shape[0], inputs, device)
    listed, band_begins = _lists(boxes, window) if device.is_cpu else (None, None)
    return RasterTriangles(points, corners, boxes, window, listed, band_begins)


def _lists(boxes: wp.array, window: Window) -> list[wp.array]:
    lists = list_by_band(boxes.numpy(), window.row_count)
    return [wp.array(array, dtype=int, device=boxes.device, copy=False) for array in lists]


def list_by_band(boxes: np.ndarray, row_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles of each band of rows, in order of submission, and where each band's begin."""
    rows = int(BAND_ROWS)
    band_count = -(-row_count // rows)
    seen = np.flatnonzero(boxes[:, 1]).astype(np.int32)
    first = boxes[seen, 0] // rows
    spans = (boxes[seen, 1] - 1) // rows + 1 - first
    ends = np.cumsum(spans, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    band = np.repeat(first - (ends - spans), spans) + np.arange(total)
    # NumPy sorts 16-bit keys by radix.
    order = np.argsort(band.astype(np.int16 if band_count < 2**15 else np.int32), kind="stable")
    begins = np.cumsum([0, *np.bincount(band, minlength=band_count)])
    return np.repeat(seen, spans)[order], begins.astype(np.int32)
