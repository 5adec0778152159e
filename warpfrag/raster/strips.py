"""Strips: pieces of a triangle's rows, small enough that a large triangle does not keep one thread busy.

What is summed up by strip and corner is then summed up by vertex, in the order of the triangles and of their strips: no
sum depends on the number of threads.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch
from warpfrag.raster.cover import Area, rows_of_window

wp.set_module_options({"enable_backward": False})

# Pixels of a strip's box: some 0.1 ms of work.
STRIP_PIXELS = wp.constant(1024)
MOST_STRIPS = 2**31 - 1


@dataclass(frozen=True)
class Strips:
    """The strips of all triangles, one triangle after the other.

    Attributes:
        ends: where each triangle's strips end, (N,) int32.
        faces: the triangle of each strip, (S,) int32.
    """

    ends: wp.array
    faces: wp.array

    @property
    def count(self) -> int:
        """Number of strips, S."""
        return self.faces.shape[0]


@wp.func
def rows_of_strip(left: int, right: int) -> int:
    """Return how many rows a strip of a triangle has, given the columns of its box."""
    return wp.max(1, STRIP_PIXELS // wp.max(1, right - left))


@wp.func
def first_strip(strip_ends: wp.array[int], face: int) -> int:
    """Return the first strip of a triangle."""
    first = int(0)
    if face > 0:
        first = strip_ends[face - 1]
    return first


@wp.func
def area_of_strip(box: wp.vec4i, number: int, width: int) -> Area:
    """Return the rows of strip number `number` of a triangle, given its box and the width of the window."""
    rows = rows_of_strip(box[2], box[3])
    top = box[0] + number * rows
    return rows_of_window(top, wp.min(top + rows, box[1]), width)


@wp.kernel(module="unique", enable_backward=False)
def count_strips(span: Span, boxes: wp.array[wp.vec4i], counts: wp.array[int]):
    """Count the strips of each triangle.

    Args:
        span: the triangles.
        boxes: rows [top, bottom) and columns [left, right), (N,).
        counts: output, (N,).
    """
    for face in range(span.begin + wp.tid(), span.end, span.stride):
        box = boxes[face]
        rows = rows_of_strip(box[2], box[3])
        counts[face] = (box[1] - box[0] + rows - 1) // rows


@wp.kernel(module="unique", enable_backward=False)
def number_strips(span: Span, strip_ends: wp.array[int], strip_faces: wp.array[int]):
    """Write the triangle of each strip.

    Args:
        span: the triangles.
        strip_ends: where each triangle's strips end, (N,).
        strip_faces: output, (S,).
    """
    for face in range(span.begin + wp.tid(), span.end, span.stride):
        for strip in range(first_strip(strip_ends, face), strip_ends[face]):
            strip_faces[strip] = face


@wp.kernel(module="unique", enable_backward=False)
def find_begins(span: Span, ascending: wp.array[int], begins: wp.array[int]):
    """Write where each value's run begins in ascending values; a value that does not occur has the next one's.

    Args:
        span: the positions.
        ascending: the values, (n,).
        begins: output, by value, and n after the last one that may occur.
    """
    for position in range(span.begin + wp.tid(), span.end, span.stride):
        value_before = int(-1)
        if position > 0:
            value_before = ascending[position - 1]
        last = ascending[position]
        for value in range(value_before + 1, last + 1):
            begins[value] = position
        if position == ascending.shape[0] - 1:
            for value in range(last + 1, begins.shape[0]):
                begins[value] = position + 1


def strip_counts(boxes: wp.array) -> tuple[wp.array, int]:
    """Return the number of strips of each triangle, given its box, (N,) int32, and their sum."""
    counts = wp.empty(boxes.shape[0], dtype=int, device=boxes.device)
    launch(count_strips, boxes.shape[0], [as_vectors(boxes), counts], boxes.device)
    return counts, int(counts.numpy().sum(dtype=np.int64))


def cut_strips(boxes: wp.array) -> Strips:
    """Cut triangles into strips, given their boxes, (N, 4) int32.

    Raises:
        ValueError: there are more strips than 32-bit numbers can count.
    """
    counts, total = strip_counts(boxes)
    if total > MOST_STRIPS:
        raise ValueError(f"capture: got {total} strips of triangles, expected at most {MOST_STRIPS}")
    ends = wp.empty_like(counts)
    faces = wp.empty(total, dtype=int, device=boxes.device)
    if counts.shape[0]:
        wp.utils.array_scan(counts, ends, inclusive=True)
    launch(number_strips, boxes.shape[0], [ends, faces], boxes.device)
    return Strips(ends, faces)


def corners_by_vertex(corners: wp.array, vertex_count: int) -> tuple[wp.array, wp.array]:
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
