"""The gradient of shading: from fragments to the corners of their triangles.

Triangles are walked through once more, in strips of rows small enough that a large triangle does not keep one thread busy. A
strip finds its fragments in the lists of the pixels that it covers and sums up their gradients, in row-major order, per corner;
then every vertex sums the corners of its triangles, in the order of the triangles. No two threads write one address, and no sum
depends on the number of threads.

The gradient of a fragment is that of scalar functions, <cotangent, output>, which Warp differentiates: colour, texel, thickness,
and the barycentric coordinates last.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.capture.raster import prepare_triangles
from warpfrag.capture.ray import (
    ONE,
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
from warpfrag.capture.shade import (
    OBJECT_IN_P,
    OBJECT_MAP,
    SHADE_DIFFERENTIABLE,
    SHADE_OPTIONS,
    SHADE_OUTPUTS,
    SHADE_TENSORS,
    hit_weights,
    premultiplied,
    present,
    shade_forward,
    shade_output_like,
    thickness_scale,
)
from warpfrag.capture.strips import cut_strips, first_at_least, gather_corners, rows_of_strip
from warpfrag.capture.texture import Lookup, load_rgba, load_uv, look_up, mix3, texel_between
from warpfrag.interop.launch import Span, launch
from warpfrag.interop.operator import Operator

wp.set_module_options({"enable_backward": False})


@wp.func
def color_pair(
    g: wp.vec4d, l_b: wp.float64, l_c: wp.float64, a: wp.vec4d, b: wp.vec4d, c: wp.vec4d, texel: wp.vec4d
) -> wp.float64:
    return wp.dot(g, premultiplied(l_b, l_c, a, b, c, texel))


@wp.func
def texel_pair(
    g: wp.vec4d, l_b: wp.float64, l_c: wp.float64, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, at: Lookup
) -> wp.float64:
    """Return <g, texel>."""
    return wp.dot(g, texel_between(l_b, l_c, a, b, c, at))


@wp.func
def thickness_pair(
    g: wp.float64, own: wp.float64, depth: wp.float64, in_p: int, near: wp.float64, far: wp.float64
) -> wp.float64:
    return g * own * thickness_scale(depth, in_p, near, far)


@wp.func
def mix_pair(
    g: wp.float64, a: wp.float64, b: wp.float64, c: wp.float64, l_b: wp.float64, l_c: wp.float64
) -> wp.float64:
    return g * mix3(a, b, c, l_b, l_c)


@wp.func
def hit_pair(
    g: wp.vec3d,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    x: wp.float64,
    y: wp.float64,
    scale: wp.float64,
    perspective: int,
) -> wp.float64:
    return wp.dot(g, hit_weights(a, b, c, x, y, scale, perspective))


@wp.func
def find_fragment(fragment_face: wp.array[int], begin: int, end: int, face: int) -> int:
    """Return the fragment of a triangle in a pixel's list, or -1."""
    for fragment in range(begin, end):
        if fragment_face[fragment] == face:
            return fragment
    return -1


@cache
def _strip_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def shade_bwd(
        span: Span,
        rays: Rays,
        points: wp.array2d(dtype=scalar),
        rgba: wp.array2d(dtype=scalar),
        thickness: wp.array(dtype=scalar),
        maps: wp.array2d(dtype=scalar),
        corners: wp.array2d(dtype=int),
        fragment_face: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        object_id: wp.array(dtype=int),
        objects: wp.array2d(dtype=int),
        uv: wp.array2d(dtype=float),
        texture_id: wp.array(dtype=int),
        texels: wp.array2d(dtype=float),
        textures: wp.array2d(dtype=int),
        grad_fragment_rgba: wp.array2d(dtype=scalar),
        grad_fragment_depth: wp.array(dtype=scalar),
        grad_fragment_thickness: wp.array(dtype=scalar),
        boxes: wp.array2d(dtype=int),
        strip_ends: wp.array(dtype=int),
        grad_points: wp.array2d(dtype=wp.vec3d),
        grad_rgba: wp.array2d(dtype=wp.vec4d),
        grad_thickness: wp.array2d(dtype=wp.float64),
    ):
        for strip in range(span.begin + wp.tid(), span.end, span.stride):
            face = first_at_least(strip_ends, strip + 1)
            number = strip
            if face > 0:
                number -= strip_ends[face - 1]
            left = boxes[face, 2]
            right = boxes[face, 3]
            strip_rows = rows_of_strip(left, right)
            top = boxes[face, 0] + number * strip_rows
            i = corners[face, 0]
            j = corners[face, 1]
            k = corners[face, 2]
            a = load_point(points, i)
            b = load_point(points, j)
            c = load_point(points, k)
            rgba_a = load_rgba(rgba, i)
            rgba_b = load_rgba(rgba, j)
            rgba_c = load_rgba(rgba, k)
            own_a = wp.float64(thickness[i])
            own_b = wp.float64(thickness[j])
            own_c = wp.float64(thickness[k])
            item = object_id[face]
            map = objects[item, OBJECT_MAP]
            in_p = objects[item, OBJECT_IN_P]
            texture = int(-1)
            uv_a = wp.vec2d()
            uv_b = wp.vec2d()
            uv_c = wp.vec2d()
            if texture_id.shape[0] > 0:
                texture = texture_id[face]
                uv_a = load_uv(uv, i)
                uv_b = load_uv(uv, j)
                uv_c = load_uv(uv, k)
            sum_a = wp.vec3d()
            sum_b = wp.vec3d()
            sum_c = wp.vec3d()
            sum_rgba_a = wp.vec4d()
            sum_rgba_b = wp.vec4d()
            sum_rgba_c = wp.vec4d()
            sum_own_a = wp.float64(0.0)
            sum_own_b = wp.float64(0.0)
            sum_own_c = wp.float64(0.0)
            wide = is_wide(rays, a, b, c, left, right)
            for row in range(top, wp.min(top + strip_rows, boxes[face, 1])):
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
                        hit = hit_weights(a, b, c, x, y, rays.scale, rays.perspective)
                        l_b = hit[0]
                        l_c = hit[1]
                        along = stretch(x, y, rays.scale, rays.perspective)
                        grad_b = wp.float64(0.0)
                        grad_c = wp.float64(0.0)
                        grad_depth = wp.float64(0.0)
                        if grad_fragment_depth.shape[0] > 0:
                            grad_depth = wp.float64(grad_fragment_depth[fragment])
                        if grad_fragment_rgba.shape[0] > 0:
                            g = load_rgba(grad_fragment_rgba, fragment)
                            texel = wp.vec4d(ONE, ONE, ONE, ONE)
                            at = look_up(texels, textures, texture, mix3(uv_a, uv_b, uv_c, l_b, l_c))
                            if texture >= 0:
                                texel = texel_between(l_b, l_c, uv_a, uv_b, uv_c, at)
                            # What is not needed goes to a name of its type: _4 is a vec4d, and so on.
                            _4, color_b, color_c, to_a, to_b, to_c, to_texel = wp.grad(color_pair)(
                                g, l_b, l_c, rgba_a, rgba_b, rgba_c, texel
                            )
                            sum_rgba_a += to_a
                            sum_rgba_b += to_b
                            sum_rgba_c += to_c
                            grad_b += color_b
                            grad_c += color_c
                            if texture >= 0:
                                _4, texel_b, texel_c, _2, _2, _2, _at = wp.grad(texel_pair)(
                                    to_texel, l_b, l_c, uv_a, uv_b, uv_c, at
                                )
                                grad_b += texel_b
                                grad_c += texel_c
                        if grad_fragment_thickness.shape[0] > 0:
                            own = mix3(own_a, own_b, own_c, l_b, l_c)
                            if map >= 0:
                                own = wp.float64(maps[map, rays.first_row * rays.width + pixel])
                            _1, to_own, own_depth, _i, _1, _1 = wp.grad(thickness_pair)(
                                wp.float64(grad_fragment_thickness[fragment]),
                                own, hit[2] * along, in_p, rays.near, rays.far,
                            )  # fmt: skip
                            grad_depth += own_depth
                            if map < 0:
                                _1, own_to_a, own_to_b, own_to_c, own_l_b, own_l_c = wp.grad(mix_pair)(
                                    to_own, own_a, own_b, own_c, l_b, l_c
                                )
                                sum_own_a += own_to_a
                                sum_own_b += own_to_b
                                sum_own_c += own_to_c
                                grad_b += own_l_b
                                grad_c += own_l_c
                        if grad_points.shape[0] > 0:
                            _3, hit_a, hit_b, hit_c, _1, _1, _1, _i = wp.grad(hit_pair)(
                                wp.vec3d(grad_b, grad_c, grad_depth * along),
                                a, b, c, x, y, rays.scale, rays.perspective,
                            )  # fmt: skip
                            sum_a += hit_a
                            sum_b += hit_b
                            sum_c += hit_c
            if grad_points.shape[0] > 0:
                grad_points[strip, 0] = sum_a
                grad_points[strip, 1] = sum_b
                grad_points[strip, 2] = sum_c
            if grad_rgba.shape[0] > 0:
                grad_rgba[strip, 0] = sum_rgba_a
                grad_rgba[strip, 1] = sum_rgba_b
                grad_rgba[strip, 2] = sum_rgba_c
            if grad_thickness.shape[0] > 0:
                grad_thickness[strip, 0] = sum_own_a
                grad_thickness[strip, 1] = sum_own_b
                grad_thickness[strip, 2] = sum_own_c

    return shade_bwd


@cache
def _maps_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def maps_bwd(
        span: Span,
        rays: Rays,
        fragment_face: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        object_id: wp.array(dtype=int),
        objects: wp.array2d(dtype=int),
        points: wp.array2d(dtype=scalar),
        corners: wp.array2d(dtype=int),
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
                    if objects[item, OBJECT_MAP] == map:
                        hit = hit_weights(
                            load_point(points, corners[face, 0]),
                            load_point(points, corners[face, 1]),
                            load_point(points, corners[face, 2]),
                            x, y, rays.scale, rays.perspective,
                        )  # fmt: skip
                        depth = hit[2] * stretch(x, y, rays.scale, rays.perspective)
                        scale = thickness_scale(depth, objects[item, OBJECT_IN_P], rays.near, rays.far)
                        sum += scale * wp.float64(grad_fragment_thickness[fragment])
                grad_maps[map, rays.first_row * rays.width + pixel] = scalar(sum)

    return maps_bwd


def shade_backward(
    inputs: Sequence[wp.array | None],
    grad_outputs: Sequence[wp.array | None],
    grad_inputs: Sequence[wp.array | None],
    **options: Any,
) -> None:
    """Fill those gradients of `SHADE_TENSORS` that are not None, given those of `SHADE_OUTPUTS`."""
    arguments = present(inputs)
    points, corners, fragment_face, offsets, object_id, objects = (arguments[at] for at in (0, 4, 5, 6, 7, 8))
    device, window = points.device, Window(**options)
    grads = [
        grad if grad is not None else wp.empty((0,) * ndim, dtype=points.dtype, device=device)
        for grad, ndim in zip(grad_outputs[:3], (2, 1, 1), strict=True)
    ]
    to_points, to_rgba, to_thickness, to_maps = grad_inputs[:4]
    if to_maps is not None:
        to_maps.zero_()
        if grad_outputs[2] is not None and fragment_face.shape[0]:
            fixed = [fragment_face, offsets, object_id, objects, points, corners]
            inputs = [window.rays(), *fixed, grads[2], to_maps]
            launch(_maps_kernel(points.dtype), window.pixel_count, inputs, device)
    targets = [array for array in (to_points, to_rgba, to_thickness) if array is not None]
    if not targets:
        return
    triangles = prepare_triangles(points, corners, window)
    strip_ends, strip_count = cut_strips(triangles.boxes)
    if strip_count == 0 or fragment_face.shape[0] == 0:
        for array in targets:
            array.zero_()
        return
    sums = [
        wp.empty((0 if target is None else strip_count, 3), dtype=dtype, device=device)
        for target, dtype in ((to_points, wp.vec3d), (to_rgba, wp.vec4d), (to_thickness, wp.float64))
    ]
    inputs = [window.rays(), *arguments, *grads, triangles.boxes, strip_ends, *sums]
    launch(_strip_kernel(points.dtype), strip_count, inputs, device)
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
