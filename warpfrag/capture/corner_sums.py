"""Sums of corners' gradients: over the fragments of a strip, then over the strips and triangles of a vertex.

No sum depends on the number of threads: a strip's fragments come row by row, a vertex's corners in the order of their
triangles and strips.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import Array, Number, Vector3, Vector4, in_precisions, kernels
from warpfrag.capture.corner_gradients import CornerGradients
from warpfrag.raster.strips import Strips, corners_by_vertex, first_strip

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def add_corners(a: CornerGradients, b: CornerGradients) -> CornerGradients:
    """Return the sum of two."""
    total = CornerGradients()
    total.point_a = a.point_a + b.point_a
    total.point_b = a.point_b + b.point_b
    total.point_c = a.point_c + b.point_c
    total.rgba_a = a.rgba_a + b.rgba_a
    total.rgba_b = a.rgba_b + b.rgba_b
    total.rgba_c = a.rgba_c + b.rgba_c
    total.thickness_a = a.thickness_a + b.thickness_a
    total.thickness_b = a.thickness_b + b.thickness_b
    total.thickness_c = a.thickness_c + b.thickness_c
    return total


@wp.struct
class CornerSums:
    """Gradients by strip and corner, (S, 3); those nobody wants are empty."""

    points: wp.array2d[wp.vec3d]
    rgba: wp.array2d[wp.vec4d]
    thickness: wp.array2d[wp.float64]


@wp.func(inline=True)
def store_corners(sums: CornerSums, strip: int, gradients: CornerGradients):
    """Write what a strip has summed up."""
    if sums.points.shape[0] > 0:
        sums.points[strip, 0] = gradients.point_a
        sums.points[strip, 1] = gradients.point_b
        sums.points[strip, 2] = gradients.point_c
    if sums.rgba.shape[0] > 0:
        sums.rgba[strip, 0] = gradients.rgba_a
        sums.rgba[strip, 1] = gradients.rgba_b
        sums.rgba[strip, 2] = gradients.rgba_c
    if sums.thickness.shape[0] > 0:
        sums.thickness[strip, 0] = gradients.thickness_a
        sums.thickness[strip, 1] = gradients.thickness_b
        sums.thickness[strip, 2] = gradients.thickness_c


@in_precisions
class VertexGradients:
    """Gradients by vertex, (V,); those nobody wants are empty."""

    points: Array[Vector3]
    rgba: Array[Vector4]
    thickness: Array[Number]


@kernels
def gather(number: Any) -> Any:
    """Return the kernel that sums up corners by vertex."""
    vec3, vec4 = wp.types.vector(3, number), wp.types.vector(4, number)

    def kernel(
        span: Span,
        vertex_begins: wp.array(dtype=int),
        corner_numbers: wp.array(dtype=int),
        strip_ends: wp.array(dtype=int),
        sums: CornerSums,
        grads: VertexGradients[number],
    ):
        """Sum up the corners of each vertex, in the order of their triangles and strips.

        Args:
            span: the vertices.
            vertex_begins: vertex v has the entries vertex_begins[v] : vertex_begins[v + 1] of the next, (V + 1,).
            corner_numbers: 3·triangle + corner, (3 N,).
            strip_ends: where each triangle's strips end, (N,).
            sums: gradients by strip and corner.
            grads: output, gradients by vertex.
        """
        for vertex in range(span.begin + wp.tid(), span.end, span.stride):
            sum_point = wp.vec3d()
            sum_rgba = wp.vec4d()
            sum_thickness = wp.float64(0.0)
            for position in range(vertex_begins[vertex], vertex_begins[vertex + 1]):
                face = corner_numbers[position] // 3
                corner = corner_numbers[position] - 3 * face
                for strip in range(first_strip(strip_ends, face), strip_ends[face]):
                    if sums.points.shape[0] > 0:
                        sum_point += sums.points[strip, corner]
                    if sums.rgba.shape[0] > 0:
                        sum_rgba += sums.rgba[strip, corner]
                    if sums.thickness.shape[0] > 0:
                        sum_thickness += sums.thickness[strip, corner]
            if grads.points.shape[0] > 0:
                grads.points[vertex] = vec3(sum_point)
            if grads.rgba.shape[0] > 0:
                grads.rgba[vertex] = vec4(sum_rgba)
            if grads.thickness.shape[0] > 0:
                grads.thickness[vertex] = number(sum_thickness)

    return kernel


def gather_corners(corners: wp.array, strips: Strips, sums: Any, targets: Any) -> None:
    """Sum up gradients by strip and corner to those by vertex.

    Args:
        corners: vertex of each corner, (N, 3) int32.
        strips: the strips of the triangles.
        sums: `CornerSums`; those without a target are empty.
        targets: as attributes the gradients to fill, points (V, 3), rgba (V, 4) and thickness (V,), or None.
    """
    wanted = [array for array in (targets.points, targets.rgba, targets.thickness) if array is not None]
    number, vertex_count = wanted[0].dtype, wanted[0].shape[0]
    grads = VertexGradients[number]()
    if targets.points is not None:
        grads.points = as_vectors(targets.points)
    if targets.rgba is not None:
        grads.rgba = as_vectors(targets.rgba)
    if targets.thickness is not None:
        grads.thickness = targets.thickness
    vertex_begins, corner_numbers = corners_by_vertex(corners, vertex_count)
    launch(gather(number), vertex_count, [vertex_begins, corner_numbers, strips.ends, sums, grads], corners.device)
