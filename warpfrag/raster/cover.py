"""The walk over the pixels that triangles cover.

There is one, `triangle_walk`; what becomes of a covered pixel is an ingredient of it and of the kernels around it:

    visit(storage, worker, pixel, item, depth)

with a structure of arrays `storage`, the triangle `item`, and `depth`, the distance of the hit from the eye along the
pixel's ray, in the precision of the triangles. `before` and `after`, `f(storage, worker, pixel)`, frame the visits of a
pixel. A visit may take its storage as `wp.ref[...]`, and then keep state in it, which lasts as long as a thread's
piece of work (its arguments are then of certain types, none `Any`).

CPU atomics are plain reads and writes, so a thread owns a run of pixels there and goes through all triangles that may
cover them, in order of submission: no two threads touch one pixel, and what else they write belongs to a `worker`, of
which no two run at the same time. On CUDA atomics serve, and all threads are worker 0. There, in any order, a thread
takes a triangle, and shares its pixels with others; in order of submission it owns one pixel.
"""

from functools import cache
from typing import Any, Literal

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import kernels
from warpfrag.raster.ray import ZERO, centre_x, centre_y, columns_of_row, hit_depth, is_wide, load_point, stretch
from warpfrag.raster.triangles import BAND_ROWS, RasterTriangles, TriangleArrays

wp.set_module_options({"enable_backward": False})

Order = Literal["any", "submission"]


@wp.struct
class Area:
    """Rows [first_row, end_row), and of those the pixels [first_pixel, end_pixel), counted row by row."""

    first_row: wp.int32
    end_row: wp.int32
    first_pixel: wp.int32
    end_pixel: wp.int32


@wp.func
def rows_of_window(first: int, end: int, width: int) -> Area:
    """Return the area of whole rows [first, end) of a window."""
    area = Area()
    area.first_row = first
    area.end_row = end
    area.first_pixel = first * width
    area.end_pixel = end * width
    return area


@wp.func(inline=True)
def nothing(storage: Any, worker: int, pixel: int):
    """Do nothing before or after a pixel's visits."""


@cache
def triangle_walk(number: Any, structure: Any, visit: Any) -> wp.Function:
    """Return the function that visits the pixels of an area whose centres a triangle covers, row by row.

    Args:
        number: precision of the depths.
        structure: type of the storage.
        visit: what is called for each of them.
    """

    @wp.func(inline=True)
    def walk(storage: wp.ref[structure], worker: int, triangles: TriangleArrays[number], face: int, area: Area):
        rays = triangles.rays
        box = triangles.boxes[face]
        top = wp.max(box[0], area.first_row)
        bottom = wp.min(box[1], area.end_row)
        left = box[2]
        right = box[3]
        if area.end_row - area.first_row == 1:
            left = wp.max(left, area.first_pixel - area.first_row * rays.width)
            right = wp.min(right, area.end_pixel - area.first_row * rays.width)
        if top < bottom and left < right:
            corner = triangles.corners[face]
            a = load_point(triangles.points, corner[0])
            b = load_point(triangles.points, corner[1])
            c = load_point(triangles.points, corner[2])
            wide = is_wide(rays, a, b, c, left, right)
            for row in range(top, bottom):
                y = centre_y(rays, row)
                columns = wp.vec2i(left, right)
                if wide:
                    columns = columns_of_row(rays, a, b, c, y, left, right)
                row_pixel = row * rays.width
                begin = wp.max(columns[0], area.first_pixel - row_pixel)
                for column in range(begin, wp.min(columns[1], area.end_pixel - row_pixel)):
                    x = centre_x(rays, column)
                    depth = hit_depth(rays, a, b, c, x, y)
                    if depth > ZERO:
                        along = stretch(x, y, rays.scale, rays.perspective)
                        visit(storage, worker, row_pixel + column, face, number(depth * along))

    return walk


@kernels
def cover_by_pixels(number: Any, structure: Any, visit: Any, before: Any, after: Any) -> Any:
    """Return the kernel in which a thread owns pixels."""
    walk = triangle_walk(number, structure, visit)

    def kernel(span: Span, triangles: TriangleArrays[number], arrays: structure):
        """Visit what covers each pixel, in order of submission.

        Args:
            span: the pixels; a stride above 1 means CUDA, and runs of one pixel.
            triangles: with lists by band.
            arrays: output, the storage.
        """
        storage = arrays
        width = triangles.rays.width
        run = wp.where(span.stride == 1, span.end - span.begin, 1)
        step = wp.where(span.stride == 1, run, span.stride)
        for first_pixel in range(span.begin + wp.tid(), span.end, step):
            end_pixel = wp.min(first_pixel + run, span.end)
            for pixel in range(first_pixel, end_pixel):
                before(storage, span.worker, pixel)
            first_row = first_pixel // width
            end_row = (end_pixel - 1) // width + 1
            area = Area()
            area.first_pixel = first_pixel
            area.end_pixel = end_pixel
            for band in range(first_row // BAND_ROWS, (end_row - 1) // BAND_ROWS + 1):
                area.first_row = wp.max(first_row, band * BAND_ROWS)
                area.end_row = wp.min(end_row, (band + 1) * BAND_ROWS)
                for item in range(triangles.band_begins[band], triangles.band_begins[band + 1]):
                    walk(storage, span.worker, triangles, triangles.listed[item], area)
            for pixel in range(first_pixel, end_pixel):
                after(storage, span.worker, pixel)

    return kernel


@kernels
def cover_by_triangles(number: Any, structure: Any, visit: Any) -> Any:
    """Return the kernel in which a thread takes triangles."""
    walk = triangle_walk(number, structure, visit)

    def kernel(span: Span, triangles: TriangleArrays[number], arrays: structure):
        """Visit what each triangle covers; threads meet at the same pixels.

        Args:
            span: the triangles.
            triangles: without lists.
            arrays: output, the storage.
        """
        storage = arrays
        rays = triangles.rays
        for face in range(span.begin + wp.tid(), span.end, span.stride):
            walk(storage, span.worker, triangles, face, rows_of_window(0, rays.row_count, rays.width))

    return kernel


@kernels
def each_pixel(structure: Any, function: Any) -> Any:
    """Return the kernel that calls a function for each pixel."""

    def kernel(span: Span, arrays: structure):
        """Call a function for each pixel.

        Args:
            span: the pixels.
            arrays: output, the storage.
        """
        storage = arrays
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            function(storage, span.worker, pixel)

    return kernel


def cover(
    triangles: RasterTriangles,
    arrays: Any,
    visit: Any,
    before: Any = None,
    after: Any = None,
    order: Order = "any",
    workers: int | None = None,
) -> None:
    """Visit every pixel that triangles cover.

    Args:
        triangles: the triangles.
        arrays: the storage, a structure of their precision.
        visit: called for each triangle and pixel.
        before: called for each pixel before its visits, or None.
        after: called for each pixel after its visits, or None.
        order: in which a pixel's visits come: "any", or that of "submission".
        workers: number of workers that the storage is made for, on the CPU; default as many as there are threads.
    """
    number, structure, device = triangles.points.dtype, arrays._cls, triangles.device
    pixel_count = triangles.window.pixel_count
    if triangles.listed is not None or order == "submission":
        kernel = cover_by_pixels(number, structure, visit, before or nothing, after or nothing)
        launch(
            kernel, pixel_count, [triangles.arrays(by_band=True), arrays], device, workers if device.is_cpu else None
        )
        return
    if before is not None:
        launch(each_pixel(structure, before), pixel_count, [arrays], device)
    kernel = cover_by_triangles(number, structure, visit)
    launch(kernel, triangles.count, [triangles.arrays(by_band=False), arrays], device)
    if after is not None:
        launch(each_pixel(structure, after), pixel_count, [arrays], device)
