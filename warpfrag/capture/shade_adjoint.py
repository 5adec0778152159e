"""The gradient of shading: from fragments to the vertices and thickness maps.

What one fragment gives to its triangle's corners is in `fragment_adjoint`. Triangles are walked through once more, in
strips of rows small enough that a large triangle does not keep one thread busy. A strip finds its fragments in the
lists of the pixels that it covers and sums up their gradients, in row-major order, per corner; then every vertex sums
the corners of its triangles, in the order of the triangles. No two threads write one address, and no sum depends on the
number of threads.

`SHADE_COVERED` shades what was covered with the vertices elsewhere: strips then look for fragments there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import Operator, vectors
from warpfrag.capture.fragment_adjoint import Corners, fragment_adjoint, load_triangle
from warpfrag.capture.shade import (
    OBJECT_IN_P,
    OBJECT_MAP,
    SHADE_DIFFERENTIABLE,
    SHADE_OPTIONS,
    SHADE_OUTPUTS,
    SHADE_TENSORS,
    hit_weights,
    present,
    shade_forward,
    shade_output_like,
    thickness_scale,
)
from warpfrag.raster.ray import (
    ZERO,
    Rays,
    Window,
    centre_x,
    centre_y,
    columns_of_row,
    hit_depth,
    is_wide,
    load_point,
    stretch,
)
from warpfrag.raster.strips import cut_strips, gather_corners, rows_of_strip
from warpfrag.raster.triangles import prepare_triangles

wp.set_module_options({"enable_backward": False})


@wp.func
def find_fragment(fragment_face: wp.array[int], begin: int, end: int, face: int) -> int:
    """Return the fragment of a triangle in a pixel's list, or -1."""
    for fragment in range(begin, end):
        if fragment_face[fragment] == face:
            return fragment
    return -1


@cache
def _strip_kernel(scalar: Any, moved: int) -> wp.Kernel:
    """Return the kernel; `moved` where coverage was found with the vertices elsewhere, at `covered`."""

    @wp.kernel(module="unique", enable_backward=False)
    def shade_bwd(
        span: Span,
        rays: Rays,
        points: wp.array(dtype=wp.types.vector(3, scalar)),
        rgba: wp.array(dtype=wp.types.vector(4, scalar)),
        thickness: wp.array(dtype=scalar),
        maps: wp.array2d(dtype=scalar),
        corners: wp.array(dtype=wp.vec3i),
        fragment_face: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        object_id: wp.array(dtype=int),
        objects: wp.array(dtype=wp.vec3i),
        uv: wp.array(dtype=wp.vec2f),
        texture_id: wp.array(dtype=int),
        texels: wp.array(dtype=wp.vec4f),
        textures: wp.array(dtype=wp.vec3i),
        grad_fragment_rgba: wp.array(dtype=wp.types.vector(4, scalar)),
        grad_fragment_depth: wp.array(dtype=scalar),
        grad_fragment_thickness: wp.array(dtype=scalar),
        covered: wp.array(dtype=wp.vec3d),
        boxes: wp.array(dtype=wp.vec4i),
        strip_ends: wp.array(dtype=int),
        strip_faces: wp.array(dtype=int),
        grad_points: wp.array2d(dtype=wp.vec3d),
        grad_rgba: wp.array2d(dtype=wp.vec4d),
        grad_thickness: wp.array2d(dtype=wp.float64),
    ):
        for strip in range(span.begin + wp.tid(), span.end, span.stride):
            face = strip_faces[strip]
            number = strip
            if face > 0:
                number -= strip_ends[face - 1]
            box = boxes[face]
            left = box[2]
            right = box[3]
            strip_rows = rows_of_strip(left, right)
            top = box[0] + number * strip_rows
            own = load_triangle(points, rgba, thickness, corners, object_id, objects, uv, texture_id, face)
            a = own.point_a
            b = own.point_b
            c = own.point_c
            if moved != 0:
                corner = corners[face]
                a = load_point(covered, corner[0])
                b = load_point(covered, corner[1])
                c = load_point(covered, corner[2])
            sum = Corners()
            wide = is_wide(rays, a, b, c, left, right)
            for row in range(top, wp.min(top + strip_rows, box[1])):
                y = centre_y(rays, row)
                columns = wp.vec2i(left, right)
                if wide:
                    columns = columns_of_row(rays, a, b, c, y, left, right)
                for column in range(columns[0], columns[1]):
                    x = centre_x(rays, column)
                    fragment = int(-1)
                    pixel = row * rays.width + column
                    if hit_depth(rays, a, b, c, x, y) > ZERO:
                        fragment = find_fragment(fragment_face, offsets[pixel], offsets[pixel + 1], face)
                    if fragment >= 0:
                        to = fragment_adjoint(
                            rays, own, maps, texels, textures,
                            grad_fragment_rgba, grad_fragment_depth, grad_fragment_thickness,
                            fragment, pixel, x, y, grad_points.shape[0] > 0,
                        )  # fmt: skip
                        sum.point_a += to.point_a
                        sum.point_b += to.point_b
                        sum.point_c += to.point_c
                        sum.rgba_a += to.rgba_a
                        sum.rgba_b += to.rgba_b
                        sum.rgba_c += to.rgba_c
                        sum.thickness_a += to.thickness_a
                        sum.thickness_b += to.thickness_b
                        sum.thickness_c += to.thickness_c
            if grad_points.shape[0] > 0:
                grad_points[strip, 0] = sum.point_a
                grad_points[strip, 1] = sum.point_b
                grad_points[strip, 2] = sum.point_c
            if grad_rgba.shape[0] > 0:
                grad_rgba[strip, 0] = sum.rgba_a
                grad_rgba[strip, 1] = sum.rgba_b
                grad_rgba[strip, 2] = sum.rgba_c
            if grad_thickness.shape[0] > 0:
                grad_thickness[strip, 0] = sum.thickness_a
                grad_thickness[strip, 1] = sum.thickness_b
                grad_thickness[strip, 2] = sum.thickness_c

    return shade_bwd


_MAPS_TENSORS = ("points", "corners", "fragment_face", "offsets", "object_id", "objects")


@cache
def _maps_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def maps_bwd(
        span: Span,
        rays: Rays,
        points: wp.array(dtype=wp.types.vector(3, scalar)),
        corners: wp.array(dtype=wp.vec3i),
        fragment_face: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        object_id: wp.array(dtype=int),
        objects: wp.array(dtype=wp.vec3i),
        grad_fragment_thickness: wp.array(dtype=scalar),
        grad_maps: wp.array2d(dtype=scalar),
    ):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            row = pixel // rays.width
            x = centre_x(rays, pixel - row * rays.width)
            y = centre_y(rays, row)
            for map in range(grad_maps.shape[0]):
                sum = wp.float64(0.0)
                for fragment in range(offsets[pixel], offsets[pixel + 1]):
                    face = fragment_face[fragment]
                    item = object_id[face]
                    if objects[item][OBJECT_MAP] == map:
                        hit = hit_weights(
                            load_point(points, corners[face][0]),
                            load_point(points, corners[face][1]),
                            load_point(points, corners[face][2]),
                            x, y, rays.scale, rays.perspective,
                        )  # fmt: skip
                        depth = hit[2] * stretch(x, y, rays.scale, rays.perspective)
                        scale = thickness_scale(depth, objects[item][OBJECT_IN_P], rays.near, rays.far)
                        sum += scale * wp.float64(grad_fragment_thickness[fragment])
                grad_maps[map, rays.first_row * rays.width + pixel] = scalar(sum)

    return maps_bwd


def shade_backward(
    inputs: Sequence[Any],
    grad_outputs: Sequence[Any],
    grad_inputs: Sequence[Any],
    covered: wp.array | None = None,
    **options: Any,
) -> None:
    """Fill those gradients of `SHADE_TENSORS` that are not None, given those of `SHADE_OUTPUTS`.

    Args:
        inputs: what was shaded.
        grad_outputs: gradients of rgba, depth and thickness of the fragments, None for zeros.
        grad_inputs: the gradients to fill.
        covered: where the vertices were when coverage was found, (V, 3) float64; None where they are.
        options: those of a `Window`.
    """
    points, corners, fragment_face = inputs[0], inputs[4], inputs[5]
    device, window = points.device, Window(**options)
    arguments = present(inputs)
    grads = [
        grad if grad is not None else wp.empty(shape, dtype=points.dtype, device=device)
        for grad, shape in zip(grad_outputs[:3], ((0, 4), (0,), (0,)), strict=True)
    ]
    grads[0] = vectors(grads[0])
    elsewhere = wp.empty((0, 3), dtype=wp.float64, device=device) if covered is None else covered
    to_points, to_rgba, to_thickness, to_maps = grad_inputs[:4]
    if to_maps is not None:
        to_maps.zero_()
        if grad_outputs[2] is not None and fragment_face.shape[0]:
            fixed = [arguments[SHADE_TENSORS.index(name)] for name in _MAPS_TENSORS]
            launch(_maps_kernel(points.dtype), window.pixel_count, [window.rays(), *fixed, grads[2], to_maps], device)
    targets = [array for array in (to_points, to_rgba, to_thickness) if array is not None]
    if not targets:
        return
    triangles = prepare_triangles(points if covered is None else covered, corners, window)
    strip_ends, strip_faces = cut_strips(triangles.boxes)
    strip_count = strip_faces.shape[0]
    if strip_count == 0 or fragment_face.shape[0] == 0:
        for array in targets:
            array.zero_()
        return
    sums = [
        wp.empty((0 if target is None else strip_count, 3), dtype=dtype, device=device)
        for target, dtype in ((to_points, wp.vec3d), (to_rgba, wp.vec4d), (to_thickness, wp.float64))
    ]
    launch(
        _strip_kernel(points.dtype, int(covered is not None)),
        strip_count,
        [
            *(window.rays(), *arguments, *grads, vectors(elsewhere)),
            *(vectors(triangles.boxes), strip_ends, strip_faces, *sums),
        ],
        device,
    )
    gather_corners(corners, strip_ends, sums, (to_points, to_rgba, to_thickness), points.dtype)


SHADE = Operator(
    name="shade",
    tensors=SHADE_TENSORS,
    differentiable=SHADE_DIFFERENTIABLE,
    outputs=SHADE_OUTPUTS,
    output_like=shade_output_like,
    forward=shade_forward,
    backward=shade_backward,
    options=SHADE_OPTIONS,
)


def _covered_forward(inputs: Sequence[Any], outputs: Sequence[Any], **options: Any) -> None:
    shade_forward(inputs[:-1], outputs, **options)


def _covered_backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], **options: Any
) -> None:
    shade_backward(inputs[:-1], grad_outputs, grad_inputs[:-1], covered=inputs[-1], **options)


SHADE_COVERED = replace(
    SHADE,
    name="shade_covered",
    tensors=(*SHADE_TENSORS, "covered"),
    forward=_covered_forward,
    backward=_covered_backward,
)
