"""The gradient of shading: from a fragment's colour, opacity, depth and z-thickness to its triangle's corners.

C = A s, A = s_A, s = (sum l_i c_i) m:   dL/ds = (A dL/dC, dL/dA + <dL/dC, s>);  dL/dc_i = l_i m dL/ds
l = E / T, T = sum E:                    dL/dE_i = (dL/dl_i - sum l_j dL/dl_j) / T
E_a = b x c, ...:                        dL/da = dL/dE_c (b_y, -b_x) - dL/dE_b (c_y, -c_x)
"""

from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, Number, Vector4, in_precisions
from warpfrag.capture.interpolation import hit_weights, map_thickness, thickness_scale
from warpfrag.capture.surfaces import OBJECT_IN_P, OBJECT_MAP
from warpfrag.capture.texture import Lookup, load_rgba, load_uv, look_up, mix3, texel_between, texture_place
from warpfrag.raster.ray import ONE, Rays, edge_functions, load_point, seen_from, stretch
from warpfrag.scene.depth_resolution import DEPTH_STEP, depth_resolution_slope

wp.set_module_options({"enable_backward": False})

# An interpolated value that is farther than this outside of its range was extrapolated, and clamped; no rounding does
# that.
SLACK = wp.constant(wp.float64(1e-9))


@wp.struct
class CornerGradients:
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
class CornerValues:
    """What the three corners of a triangle have, and the triangle's thickness map, unit and texture."""

    point_a: wp.vec3d
    point_b: wp.vec3d
    point_c: wp.vec3d
    rgba_a: wp.vec4d
    rgba_b: wp.vec4d
    rgba_c: wp.vec4d
    thickness_a: wp.float64
    thickness_b: wp.float64
    thickness_c: wp.float64
    uv_a: wp.vec2d
    uv_b: wp.vec2d
    uv_c: wp.vec2d
    map: wp.int32
    in_p: wp.int32
    texture: wp.int32


@wp.struct
class CornerPositions:
    """Gradients in the positions of the three corners of a triangle."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d


@in_precisions
class ShadedGradients:
    """Gradients of shaded fragments, (F,); those that are zeros are empty."""

    rgba: Array[Vector4]
    depth: Array[Number]
    thickness: Array[Number]


@wp.func
def texel_adjoint(g: wp.vec4d, u: wp.vec2d, lookup: Lookup) -> wp.vec2d:
    """Return the gradient in the texture coordinates of <g, texel>; u is where the texture is read."""
    place = texture_place(u, lookup.size)
    x = place[0] - lookup.before[0]
    y = place[1] - lookup.before[1]
    upper = lookup.upper_right - lookup.upper_left
    lower = lookup.lower_right - lookup.lower_left
    down = lookup.lower_left + x * lower - lookup.upper_left - x * upper
    return wp.vec2d(wp.dot(g, upper + y * (lower - upper)) * lookup.size[0], -wp.dot(g, down) * lookup.size[1])


@wp.func
def cross_gradient(g: wp.float64, p: wp.vec2d) -> wp.vec2d:
    """Return the gradient in a of g a × p; in a of g p × a it is the negative."""
    return wp.vec2d(g * p[1], -g * p[0])


@wp.func
def into_camera_space(
    g: wp.vec2d, g_z: wp.float64, x: wp.float64, y: wp.float64, scale: wp.float64, perspective: int
) -> wp.vec3d:
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
) -> CornerPositions:
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
    at_a = cross_gradient(e_c, seen_b) - cross_gradient(e_b, seen_c)
    at_b = cross_gradient(e_a, seen_c) - cross_gradient(e_c, seen_a)
    at_c = cross_gradient(e_b, seen_a) - cross_gradient(e_a, seen_b)
    gradients = CornerPositions()
    gradients.a = into_camera_space(at_a, g_z * (ONE - l_b - l_c), x, y, rays.scale, rays.perspective)
    gradients.b = into_camera_space(at_b, g_z * l_b, x, y, rays.scale, rays.perspective)
    gradients.c = into_camera_space(at_c, g_z * l_c, x, y, rays.scale, rays.perspective)
    return gradients


@wp.func(inline=True)
def load_corners(surface: Any, face: int) -> CornerValues:
    """Return what the corners of a triangle have."""
    corner = surface.corners[face]
    i = corner[0]
    j = corner[1]
    k = corner[2]
    item = surface.objects[surface.object_id[face]]
    triangle = CornerValues()
    triangle.point_a = load_point(surface.points, i)
    triangle.point_b = load_point(surface.points, j)
    triangle.point_c = load_point(surface.points, k)
    triangle.rgba_a = load_rgba(surface.rgba, i)
    triangle.rgba_b = load_rgba(surface.rgba, j)
    triangle.rgba_c = load_rgba(surface.rgba, k)
    triangle.thickness_a = wp.float64(surface.thickness[i])
    triangle.thickness_b = wp.float64(surface.thickness[j])
    triangle.thickness_c = wp.float64(surface.thickness[k])
    triangle.map = item[OBJECT_MAP]
    triangle.in_p = item[OBJECT_IN_P]
    triangle.texture = -1
    if surface.texture_id.shape[0] > 0:
        triangle.texture = surface.texture_id[face]
        triangle.uv_a = load_uv(surface.uv, i)
        triangle.uv_b = load_uv(surface.uv, j)
        triangle.uv_c = load_uv(surface.uv, k)
    return triangle


@wp.func(inline=True)
def fragment_adjoint(
    surface: Any,
    triangle: CornerValues,
    grads: Any,
    fragment: int,
    pixel: int,
    x: wp.float64,
    y: wp.float64,
    wants_points: bool,
) -> CornerGradients:
    """Return what the corners of a fragment's triangle get of the fragment's gradients.

    Args:
        surface: what was shaded.
        triangle: the fragment's triangle.
        grads: gradients of all fragments; empty ones are zeros.
        fragment: which fragment.
        pixel: of which pixel of the window.
        x: how far right of the image's middle that lies [pixels].
        y: how far below it [pixels].
        wants_points: whether the gradient in the positions is wanted.
    """
    rays = surface.rays
    gradients = CornerGradients()
    hit = hit_weights(triangle.point_a, triangle.point_b, triangle.point_c, x, y, rays.scale, rays.perspective)
    l_b = hit[0]
    l_c = hit[1]
    along = stretch(x, y, rays.scale, rays.perspective)
    grad_b = wp.float64(0.0)
    grad_c = wp.float64(0.0)
    grad_depth = wp.float64(0.0)
    if grads.depth.shape[0] > 0:
        grad_depth = wp.float64(grads.depth[fragment])
    if grads.rgba.shape[0] > 0:
        # C = A s, A = s_A, s = straight colour and opacity times texel.
        g = load_rgba(grads.rgba, fragment)
        straight = mix3(triangle.rgba_a, triangle.rgba_b, triangle.rgba_c, l_b, l_c)
        texel = wp.vec4d(ONE, ONE, ONE, ONE)
        lookup = Lookup()
        place = mix3(triangle.uv_a, triangle.uv_b, triangle.uv_c, l_b, l_c)
        if triangle.texture >= 0:
            lookup = look_up(surface.texels, surface.textures, triangle.texture, place)
            texel = texel_between(place, lookup)
        s = wp.cw_mul(straight, texel)
        grad_opacity = g[3]
        if s[3] < -SLACK or s[3] > ONE + SLACK:
            grad_opacity = wp.float64(0.0)
        g = wp.vec4d(g[0] * s[3], g[1] * s[3], g[2] * s[3], grad_opacity + g[0] * s[0] + g[1] * s[1] + g[2] * s[2])
        grad_straight = wp.cw_mul(g, texel)
        gradients.rgba_a = (ONE - l_b - l_c) * grad_straight
        gradients.rgba_b = l_b * grad_straight
        gradients.rgba_c = l_c * grad_straight
        grad_b += wp.dot(grad_straight, triangle.rgba_b - triangle.rgba_a)
        grad_c += wp.dot(grad_straight, triangle.rgba_c - triangle.rgba_a)
        if triangle.texture >= 0:
            grad_place = texel_adjoint(wp.cw_mul(g, straight), place, lookup)
            grad_b += wp.dot(grad_place, triangle.uv_b - triangle.uv_a)
            grad_c += wp.dot(grad_place, triangle.uv_c - triangle.uv_a)
    if grads.thickness.shape[0] > 0:
        grad_own = wp.float64(grads.thickness[fragment])
        factor = mix3(triangle.thickness_a, triangle.thickness_b, triangle.thickness_c, l_b, l_c)
        if factor < -SLACK * wp.max(wp.max(triangle.thickness_a, triangle.thickness_b), triangle.thickness_c):
            grad_own = wp.float64(0.0)
        if triangle.in_p != 0:
            if triangle.map >= 0:
                factor = map_thickness(surface, triangle.map, pixel)
            # t = factor P(z) along: by the distance z along, its derivative is factor P'(z).
            slope = depth_resolution_slope(hit[2], rays.near, rays.far, DEPTH_STEP, rays.perspective)
            grad_depth += grad_own * factor * slope
            grad_own *= thickness_scale(hit[2], along, triangle.in_p, rays)
        if triangle.map < 0:
            gradients.thickness_a = (ONE - l_b - l_c) * grad_own
            gradients.thickness_b = l_b * grad_own
            gradients.thickness_c = l_c * grad_own
            grad_b += grad_own * (triangle.thickness_b - triangle.thickness_a)
            grad_c += grad_own * (triangle.thickness_c - triangle.thickness_a)
    if wants_points:
        positions = hit_adjoint(
            grad_b, grad_c, grad_depth * along, triangle.point_a, triangle.point_b, triangle.point_c, rays, x, y
        )
        gradients.point_a = positions.a
        gradients.point_b = positions.b
        gradients.point_c = positions.c
    return gradients
