"""The gradient of shading: from fragments to the corners of their triangles.

    C = A s, A = s_A, s = (sum l_i c_i) m:   dL/ds = (A dL/dC, dL/dA + <dL/dC, s>);  dL/dc_i = l_i m dL/ds
    l = E / T, T = sum E:                    dL/dE_i = (dL/dl_i - sum l_j dL/dl_j) / T
    E_a = b x c, ...:                        dL/da = dL/dE_c (b_y, -b_x) - dL/dE_b (c_y, -c_x)

Triangles are walked through once more, in strips of rows small enough that a large triangle does not keep one thread
busy. A strip finds its fragments in the lists of the pixels that it covers and sums up their gradients, in row-major
order, per corner; then every vertex sums the corners of its triangles, in the order of the triangles. No two threads
write one address, and no sum depends on the number of threads.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.capture.precision import DEPTH_STEP, depth_resolution_slope
from warpfrag.capture.raster import prepare_triangles
from warpfrag.capture.ray import (
    ONE,
    ZERO,
    Rays,
    Window,
    centre_x,
    centre_y,
    columns_of_row,
    edge_functions,
    hit_depth,
    is_wide,
    load_point,
    seen_from,
    stretch,
    vectors,
)
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
from warpfrag.capture.strips import cut_strips, gather_corners, rows_of_strip
from warpfrag.capture.texture import Lookup, load_rgba, load_uv, look_up, mix3, texel_between, texture_place
from warpfrag.interop.launch import Span, launch
from warpfrag.interop.operator import Operator

wp.set_module_options({"enable_backward": False})


@wp.struct
class Corners:
    """What the three corners of a triangle get of a gradient: positions, straight colour and opacity, thickness."""

    point_a: wp.vec3d
    point_b: wp.vec3d
    point_c: wp.vec3d
    rgba_a: wp.vec4d
    rgba_b: wp.vec4d
    rgba_c: wp.vec4d
    thickness_a: wp.float64
    thickness_b: wp.float64
    thickness_c: wp.float64


@wp.struct
class Points:
    """Gradients in the positions of the three corners of a triangle."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d


@wp.func
def texel_adjoint(g: wp.vec4d, u: wp.vec2d, at: Lookup) -> wp.vec2d:
    """Return the gradient in the texture coordinates of <g, texel>; u is where the texture is read."""
    place = texture_place(u, at.size)
    x = place[0] - at.before[0]
    y = place[1] - at.before[1]
    upper = at.upper_right - at.upper_left
    lower = at.lower_right - at.lower_left
    down = at.lower_left + x * lower - at.upper_left - x * upper
    return wp.vec2d(wp.dot(g, upper + y * (lower - upper)) * at.size[0], -wp.dot(g, down) * at.size[1])


@wp.func
def turned(g: wp.float64, p: wp.vec2d) -> wp.vec2d:
    """Return the gradient in a of g a × p; in a of g p × a it is the negative."""
    return wp.vec2d(g * p[1], -g * p[0])


@wp.func
def lifted(g: wp.vec2d, g_z: wp.float64, x: wp.float64, y: wp.float64, scale: wp.float64, perspective: int) -> wp.vec3d:
    """Return the gradient in a corner, given that in its place seen from the pixel and that in its depth."""
    if perspective != 0:
        g_z -= x * g[0] + y * g[1]
    return wp.vec3d(scale * g[0], scale * g[1], g_z)


@wp.func
def hit_adjoint(
    g_b: wp.float64,
    g_c: wp.float64,
    g_z: wp.float64,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    rays: Rays,
    x: wp.float64,
    y: wp.float64,
) -> Points:
    """Return the gradient in the corners' positions of <g, (l_b, l_c, z)>, what `hit_weights` returns."""
    seen_a = seen_from(a, x, y, rays.scale, rays.perspective)
    seen_b = seen_from(b, x, y, rays.scale, rays.perspective)
    seen_c = seen_from(c, x, y, rays.scale, rays.perspective)
    e = edge_functions(seen_a, seen_b, seen_c)
    inverse = ONE / (e[0] + e[1] + e[2])
    l_b = e[1] * inverse
    l_c = e[2] * inverse
    g_b += g_z * (b[2] - a[2])
    g_c += g_z * (c[2] - a[2])
    mean = g_b * l_b + g_c * l_c
    e_a = -mean * inverse
    e_b = (g_b - mean) * inverse
    e_c = (g_c - mean) * inverse
    to_a = turned(e_c, seen_b) - turned(e_b, seen_c)
    to_b = turned(e_a, seen_c) - turned(e_c, seen_a)
    to_c = turned(e_b, seen_a) - turned(e_a, seen_b)
    to = Points()
    to.a = lifted(to_a, g_z * (ONE - l_b - l_c), x, y, rays.scale, rays.perspective)
    to.b = lifted(to_b, g_z * l_b, x, y, rays.scale, rays.perspective)
    to.c = lifted(to_c, g_z * l_c, x, y, rays.scale, rays.perspective)
    return to


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
            corner = corners[face]
            i = corner[0]
            j = corner[1]
            k = corner[2]
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
            map = objects[item][OBJECT_MAP]
            in_p = objects[item][OBJECT_IN_P]
            texture = int(-1)
            uv_a = wp.vec2d()
            uv_b = wp.vec2d()
            uv_c = wp.vec2d()
            if texture_id.shape[0] > 0:
                texture = texture_id[face]
                uv_a = load_uv(uv, i)
                uv_b = load_uv(uv, j)
                uv_c = load_uv(uv, k)
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
                            # C = A s, A = s_A, s = straight colour and opacity times texel.
                            g = load_rgba(grad_fragment_rgba, fragment)
                            straight = mix3(rgba_a, rgba_b, rgba_c, l_b, l_c)
                            texel = wp.vec4d(ONE, ONE, ONE, ONE)
                            at = Lookup()
                            place = mix3(uv_a, uv_b, uv_c, l_b, l_c)
                            if texture >= 0:
                                at = look_up(texels, textures, texture, place)
                                texel = texel_between(place, at)
                            s = wp.cw_mul(straight, texel)
                            g = wp.vec4d(
                                g[0] * s[3], g[1] * s[3], g[2] * s[3], g[3] + g[0] * s[0] + g[1] * s[1] + g[2] * s[2]
                            )
                            to_straight = wp.cw_mul(g, texel)
                            sum.rgba_a += (ONE - l_b - l_c) * to_straight
                            sum.rgba_b += l_b * to_straight
                            sum.rgba_c += l_c * to_straight
                            grad_b += wp.dot(to_straight, rgba_b - rgba_a)
                            grad_c += wp.dot(to_straight, rgba_c - rgba_a)
                            if texture >= 0:
                                to_place = texel_adjoint(wp.cw_mul(g, straight), place, at)
                                grad_b += wp.dot(to_place, uv_b - uv_a)
                                grad_c += wp.dot(to_place, uv_c - uv_a)
                        if grad_fragment_thickness.shape[0] > 0:
                            to_own = wp.float64(grad_fragment_thickness[fragment])
                            if in_p != 0:
                                own = mix3(own_a, own_b, own_c, l_b, l_c)
                                if map >= 0:
                                    own = wp.float64(maps[map, rays.first_row * rays.width + pixel])
                                depth = hit[2] * along
                                slope = depth_resolution_slope(depth, rays.near, rays.far, DEPTH_STEP)
                                grad_depth += to_own * own * slope
                                to_own *= thickness_scale(depth, in_p, rays.near, rays.far)
                            if map < 0:
                                sum.thickness_a += (ONE - l_b - l_c) * to_own
                                sum.thickness_b += l_b * to_own
                                sum.thickness_c += l_c * to_own
                                grad_b += to_own * (own_b - own_a)
                                grad_c += to_own * (own_c - own_a)
                        if grad_points.shape[0] > 0:
                            to = hit_adjoint(grad_b, grad_c, grad_depth * along, a, b, c, rays, x, y)
                            sum.point_a += to.a
                            sum.point_b += to.b
                            sum.point_c += to.c
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
    **options: Any,
) -> None:
    """Fill those gradients of `SHADE_TENSORS` that are not None, given those of `SHADE_OUTPUTS`."""
    points, corners, fragment_face = inputs[0], inputs[4], inputs[5]
    device, window = points.device, Window(**options)
    arguments = present(inputs)
    grads = [
        grad if grad is not None else wp.empty(shape, dtype=points.dtype, device=device)
        for grad, shape in zip(grad_outputs[:3], ((0, 4), (0,), (0,)), strict=True)
    ]
    grads[0] = vectors(grads[0])
    to_points, to_rgba, to_thickness, to_maps = grad_inputs[:4]
    if to_maps is not None:
        to_maps.zero_()
        if grad_outputs[2] is not None and fragment_face.shape[0]:
            fixed = [arguments[SHADE_TENSORS.index(name)] for name in _MAPS_TENSORS]
            launch(_maps_kernel(points.dtype), window.pixel_count, [window.rays(), *fixed, grads[2], to_maps], device)
    targets = [array for array in (to_points, to_rgba, to_thickness) if array is not None]
    if not targets:
        return
    triangles = prepare_triangles(points, corners, window)
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
        _strip_kernel(points.dtype),
        strip_count,
        [window.rays(), *arguments, *grads, vectors(triangles.boxes), strip_ends, strip_faces, *sums],
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
