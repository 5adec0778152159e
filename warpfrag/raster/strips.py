"""Strips: pieces of a triangle's rows, and the sum over strips and corners to vertices, in a fixed order."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import vectors
from warpfrag.raster.triangles import MOST_FRAGMENTS

wp.set_module_options({"enable_backward": False})

# Pixels of a strip's box: some 0.1 ms of work.
STRIP_PIXELS = wp.constant(1024)


@wp.func
def rows_of_strip(left: int, right: int) -> int:
    """Return how many rows a strip of a triangle has, given the columns of its box."""
    return wp.max(1, STRIP_PIXELS // wp.max(1, right - left))


@wp.kernel(module="unique", enable_backward=False)
def count_strips(span: Span, boxes: wp.array[wp.vec4i], counts: wp.array[int]):
    """Count the strips of each triangle."""
    for face in range(span.begin + wp.tid(), span.end, span.stride):
        box = boxes[face]
        rows = rows_of_strip(box[2], box[3])
        counts[face] = (box[1] - box[0] + rows - 1) // rows


@wp.kernel(module="unique", enable_backward=False)
def number_strips(span: Span, strip_ends: wp.array[int], strip_faces: wp.array[int]):
    """Write the triangle of each strip."""
    for face in range(span.begin + wp.tid(), span.end, span.stride):
        begin = int(0)
        if face > 0:
            begin = strip_ends[face - 1]
        for strip in range(begin, strip_ends[face]):
            strip_faces[strip] = face


@wp.kernel(module="unique", enable_backward=False)
def find_begins(span: Span, sorted: wp.array[int], begins: wp.array[int]):
    """Write where each value's run begins in sorted values; a value that does not occur has the next one's."""
    for position in range(span.begin + wp.tid(), span.end, span.stride):
        before = int(-1)
        if position > 0:
            before = sorted[position - 1]
        last = sorted[position]
        for value in range(before + 1, last + 1):
            begins[value] = position
        if position == sorted.shape[0] - 1:
            for value in range(last + 1, begins.shape[0]):
                begins[value] = position + 1


@cache
def _gather_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        span: Span,
        vertex_begins: wp.array(dtype=int),
        corner_numbers: wp.array(dtype=int),
        strip_ends: wp.array(dtype=int),
        corner_points: wp.array2d(dtype=wp.vec3d),
        corner_rgba: wp.array2d(dtype=wp.vec4d),
        corner_thickness: wp.array2d(dtype=wp.float64),
        grad_points: wp.array2d(dtype=scalar),
        grad_rgba: wp.array2d(dtype=scalar),
        grad_thickness: wp.array(dtype=scalar),
    ):
        for vertex in range(span.begin + wp.tid(), span.end, span.stride):
            sum_point = wp.vec3d()
            sum_rgba = wp.vec4d()
            sum_own = wp.float64(0.0)
            for position in range(vertex_begins[vertex], vertex_begins[vertex + 1]):
                face = corner_numbers[position] // 3
                corner = corner_numbers[position] - 3 * face
                begin = int(0)
                if face > 0:
                    begin = strip_ends[face - 1]
                for strip in range(begin, strip_ends[face]):
                    if corner_points.shape[0] > 0:
                        sum_point += corner_points[strip, corner]
                    if corner_rgba.shape[0] > 0:
                        sum_rgba += corner_rgba[strip, corner]
                    if corner_thickness.shape[0] > 0:
                        sum_own += corner_thickness[strip, corner]
            if grad_points.shape[0] > 0:
                for axis in range(3):
                    grad_points[vertex, axis] = scalar(sum_point[axis])
            if grad_rgba.shape[0] > 0:
                for channel in range(4):
                    grad_rgba[vertex, channel] = scalar(sum_rgba[channel])
            if grad_thickness.shape[0] > 0:
                grad_thickness[vertex] = scalar(sum_own)

    return gather


def gather_corners(
    corners: wp.array, strip_ends: wp.array, sums: Sequence[wp.array], targets: Sequence[wp.array | None], scalar: Any
) -> None:
    """Sum the gradients of the corners, by strip, up to those of the vertices.

    Args:
        corners: vertex of each corner, (N, 3) int32.
        strip_ends: where each triangle's strips end, (N,) int32.
        sums: by strip and corner the gradient of its point, colour and thickness; those without a target are empty.
        targets: the gradients by vertex to fill, (V, 3), (V, 4) and (V,), or None.
        scalar: Warp type of the targets.
    """
    device = corners.device
    vertex_count = next(target.shape[0] for target in targets if target is not None)
    wanted = [
        target if target is not None else wp.empty((0,) * ndim, dtype=scalar, device=device)
        for target, ndim in zip(targets, (2, 2, 1), strict=True)
    ]
    vertex_begins, corner_numbers = _corners_by_vertex(corners, vertex_count)
    launch(_gather_kernel(scalar), vertex_count, [vertex_begins, corner_numbers, strip_ends, *sums, *wanted], device)


def cut_strips(boxes: wp.array) -> tuple[wp.array, wp.array]:
    """Return where each triangle's strips end, counted over all triangles, and the triangle of each strip."""
    device = boxes.device
    counts = wp.empty(boxes.shape[0], dtype=int, device=device)
    launch(count_strips, boxes.shape[0], [vectors(boxes), counts], device)
    count = int(counts.numpy().sum(dtype=np.int64))
    if count > MOST_FRAGMENTS:
        raise ValueError(f"capture: {count} strips of triangles, expected at most {MOST_FRAGMENTS}")
    ends = wp.empty_like(counts)
    faces = wp.empty(count, dtype=int, device=device)
    if counts.shape[0]:
        wp.utils.array_scan(counts, ends, inclusive=True)
    launch(number_strips, boxes.shape[0], [ends, faces], device)
    return ends, faces


def _corners_by_vertex(corners: wp.array, vertex_count: int) -> tuple[wp.array, wp.array]:
    """Return where each vertex's corners begin in the list of their numbers, 3·triangle + corner, and that list."""
    count, device = corners.size, corners.device
    # The sort takes arrays of twice the length.
    vertices = wp.empty(2 * count, dtype=int, device=device)
    numbers = wp.empty(2 * count, dtype=int, device=device)
    wp.copy(vertices, corners.flatten(), count=count)
    wp.copy(numbers, wp.array(np.arange(count, dtype=np.int32), device=device), count=count)
    wp.utils.radix_sort_pairs(vertices, numbers, count)
    begins = wp.empty(vertex_count + 1, dtype=int, device=device)
    launch(find_begins, count, [vertices[:count], begins], device)
    return begins, numbers
