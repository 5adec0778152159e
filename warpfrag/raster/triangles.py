"""The dynamic fragment buffer (Maule et al. 2012): count the fragments of each pixel, prefix sum, store, sort.

Each pass is a function of its own. `rasterize` serves both the count and the store, so that they agree. On CUDA a
thread takes a triangle and pixels are shared by atomic counters; then the sort makes the order deterministic. On the
CPU a piece of work is a run of pixels, and goes through all triangles that may cover them: no two threads touch one
pixel, and the fragments of a pixel come in the order of submission.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import vectors
from warpfrag.raster.ray import (
    Rays,
    Window,
    before,
    bounds,
    centre_x,
    centre_y,
    columns_of_row,
    hit_depth,
    is_wide,
    load_point,
    stretch,
)

wp.set_module_options({"enable_backward": False})

MOST_FRAGMENTS = 2**31 - 1
# Rows of a band: few, so that a piece of work looks at few triangles that it does not cover; not so few that most
# triangles lie in several.
BAND_ROWS = wp.constant(16)


@dataclass(frozen=True)
class Triangles:
    """What rasterising takes.

    Attributes:
        points: corners in camera space, float32 or float64, (V, 3).
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


@cache
def _prepare_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def prepare(
        span: Span,
        points: wp.array(dtype=wp.types.vector(3, scalar)),
        faces: wp.array(dtype=wp.vec3i),
        rays: Rays,
        corners: wp.array(dtype=wp.vec3i),
        boxes: wp.array(dtype=wp.vec4i),
    ):
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

    return prepare


def prepare_triangles(points: wp.array, faces: wp.array, window: Window) -> Triangles:
    """Order the corners of each triangle and find the box of pixels that it may cover.

    Args:
        points: corners in camera space, float32 or float64, (V, 3).
        faces: indices into `points`, (N, 3) int32.
        window: the pixels.
    """
    device = points.device
    corners = wp.empty(faces.shape, dtype=int, device=device)
    boxes = wp.empty((faces.shape[0], 4), dtype=int, device=device)
    inputs = [vectors(points), vectors(faces), window.rays(), vectors(corners), vectors(boxes)]
    launch(_prepare_kernel(points.dtype), faces.shape[0], inputs, device)
    listed = band_begins = None
    if device.is_cpu:
        lists = list_by_band(boxes.numpy(), window.row_count)
        listed, band_begins = (wp.array(array, dtype=int, device=device, copy=False) for array in lists)
    return Triangles(points, corners, boxes, window, listed, band_begins)


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


@cache
def _rasterize_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def rasterize(
        span: Span,
        span_is_pixels: int,
        points: wp.array(dtype=wp.types.vector(3, scalar)),
        corners: wp.array(dtype=wp.vec3i),
        boxes: wp.array(dtype=wp.vec4i),
        listed: wp.array(dtype=int),
        band_begins: wp.array(dtype=int),
        rays: Rays,
        slots: wp.array(dtype=int),
        fragment_face: wp.array(dtype=int),
        fragment_depth: wp.array(dtype=scalar),
    ):
        first_pixel = int(0)
        end_pixel = rays.width * rays.row_count
        first_band = int(0)
        end_band = int(1)
        if span_is_pixels != 0:
            first_pixel = span.begin
            end_pixel = span.end
            first_band = first_pixel // rays.width // BAND_ROWS
            end_band = (end_pixel - 1) // rays.width // BAND_ROWS + 1
        for band in range(first_band, end_band):
            first_row = first_pixel // rays.width
            end_row = (end_pixel - 1) // rays.width + 1
            begin = span.begin + wp.tid()
            end = span.end
            stride = span.stride
            if span_is_pixels != 0:
                first_row = wp.max(first_row, band * BAND_ROWS)
                end_row = wp.min(end_row, (band + 1) * BAND_ROWS)
                begin = band_begins[band]
                end = band_begins[band + 1]
                stride = 1
            for item in range(begin, end, stride):
                face = item
                if span_is_pixels != 0:
                    face = listed[item]
                box = boxes[face]
                left = box[2]
                right = box[3]
                top = wp.max(box[0], first_row)
                bottom = wp.min(box[1], end_row)
                if top < bottom:
                    corner = corners[face]
                    a = load_point(points, corner[0])
                    b = load_point(points, corner[1])
                    c = load_point(points, corner[2])
                    wide = is_wide(rays, a, b, c, left, right)
                    for row in range(top, bottom):
                        y = centre_y(rays, row)
                        columns = wp.vec2i(left, right)
                        if wide:
                            columns = columns_of_row(rays, a, b, c, y, left, right)
                        row_pixel = row * rays.width
                        for column in range(
                            wp.max(columns[0], first_pixel - row_pixel), wp.min(columns[1], end_pixel - row_pixel)
                        ):
                            x = centre_x(rays, column)
                            depth = hit_depth(rays, a, b, c, x, y)
                            if depth > wp.float64(0.0):
                                slot = wp.atomic_add(slots, row_pixel + column, 1)
                                if slot < fragment_face.shape[0]:
                                    fragment_face[slot] = face
                                if slot < fragment_depth.shape[0]:
                                    along = stretch(x, y, rays.scale, rays.perspective)
                                    fragment_depth[slot] = scalar(depth * along)

    return rasterize


def _rasterize(triangles: Triangles, slots: wp.array, fragment_face: wp.array, fragment_depth: wp.array) -> None:
    nothing = _nothing(int, triangles.device)
    lists, size = (nothing, nothing), triangles.corners.shape[0]
    by_pixels = triangles.listed is not None
    if by_pixels:
        lists, size = (triangles.listed, triangles.band_begins), triangles.window.pixel_count
    inputs = [
        *(int(by_pixels), vectors(triangles.points), vectors(triangles.corners), vectors(triangles.boxes)),
        *(*lists, triangles.window.rays(), slots, fragment_face, fragment_depth),
    ]
    launch(_rasterize_kernel(triangles.points.dtype), size, inputs, triangles.device)


def _nothing(dtype: Any, device: wp.Device) -> wp.array:
    return wp.empty(0, dtype=dtype, device=device)


def count_fragments(triangles: Triangles) -> wp.array:
    """Return how many triangles cover each pixel centre, (P,) int32."""
    counts = wp.zeros(triangles.window.pixel_count, dtype=int, device=triangles.device)
    nothing = _nothing(int, triangles.device), _nothing(triangles.points.dtype, triangles.device)
    _rasterize(triangles, counts, *nothing)
    return counts


def scan_counts(counts: wp.array) -> tuple[wp.array, int]:
    """Return where each pixel's fragments begin, as `starts[pixel + 1]` (P + 1,), and their number.

    `store_fragments` moves the starts on to the ends: then they are the offsets of `Fragments`.

    Raises:
        ValueError: there are more fragments than 32-bit offsets can count.
    """
    total = int(counts.numpy().sum(dtype=np.int64))
    if total > MOST_FRAGMENTS:
        raise ValueError(f"capture: {total} fragments, expected at most {MOST_FRAGMENTS}; capture fewer rows at a time")
    starts = wp.zeros(counts.shape[0] + 1, dtype=int, device=counts.device)
    if counts.shape[0]:
        wp.utils.array_scan(counts, starts[1:], inclusive=False)
    return starts, total


def store_fragments(triangles: Triangles, starts: wp.array, total: int, depths: bool) -> tuple[wp.array, wp.array]:
    """Store the triangle of each fragment, and its depth if `depths`; turns `starts` into offsets.

    Returns:
        Triangle (F,) int32 and distance from the eye along the ray [scene units] (F,), or an empty array.
    """
    fragment_face = wp.empty(total, dtype=int, device=triangles.device)
    fragment_depth = wp.empty(total if depths else 0, dtype=triangles.points.dtype, device=triangles.device)
    if total:
        _rasterize(triangles, starts[1:], fragment_face, fragment_depth)
    return fragment_face, fragment_depth


@wp.func
def precedes(depth: Any, face: int, other_depth: Any, other_face: int):
    """Tell whether a fragment comes before another, by depth, then triangle."""
    if depth != other_depth:
        return depth < other_depth
    return face < other_face


@cache
def _sort_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def sort_pixels(
        span: Span, offsets: wp.array(dtype=int), faces: wp.array(dtype=int), depths: wp.array(dtype=scalar)
    ):
        by_depth = depths.shape[0] > 0
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = offsets[pixel]
            count = offsets[pixel + 1] - begin
            # Shell's sort with Knuth's gaps (1, 4, 13, ...); short lists start at gap 1, an insertion sort.
            gap = int(1)
            while 9 * gap < count:
                gap = 3 * gap + 1
            while gap > 0:
                for i in range(gap, count):
                    face = faces[begin + i]
                    depth = scalar(0.0)
                    other_depth = scalar(0.0)
                    if by_depth:
                        depth = depths[begin + i]
                    j = int(i)
                    moving = bool(True)
                    while moving and j >= gap:
                        other = begin + j - gap
                        if by_depth:
                            other_depth = depths[other]
                        moving = precedes(depth, face, other_depth, faces[other])
                        if moving:
                            faces[begin + j] = faces[other]
                            if by_depth:
                                depths[begin + j] = other_depth
                            j -= gap
                    if j != i:
                        faces[begin + j] = face
                        if by_depth:
                            depths[begin + j] = depth
                gap = gap // 3

    return sort_pixels


def sort_fragments(offsets: wp.array, faces: wp.array, depths: wp.array) -> None:
    """Sort each pixel's fragments in place: by depth, then triangle; without depths by triangle, as submitted."""
    if faces.shape[0] == 0 or (depths.shape[0] == 0 and faces.device.is_cpu):
        return
    launch(_sort_kernel(depths.dtype), offsets.shape[0] - 1, [offsets, faces, depths], faces.device)
