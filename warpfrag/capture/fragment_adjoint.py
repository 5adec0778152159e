"""The gradient of one fragment's shading: from its colour, opacity, depth and z-thickness to its triangle's corners.

C = A s, A = s_A, s = (sum l_i c_i) m:   dL/ds = (A dL/dC, dL/dA + <dL/dC, s>);  dL/dc_i = l_i m dL/ds
l = E / T, T = sum E:                    dL/dE_i = (dL/dl_i - sum l_j dL/dl_j) / T
E_a = b x c, ...:                        dL/da = dL/dE_c (b_y, -b_x) - dL/dE_b (c_y, -c_x)
"""

from typing import Any

import warp as wp

from warpfrag.capture.shade import OBJECT_IN_P, OBJECT_MAP, hit_weights, thickness_scale
from warpfrag.capture.texture import Lookup, load_rgba, load_uv, look_up, mix3, texel_between, texture_place
from warpfrag.raster.ray import ONE, Rays, edge_functions, load_point, seen_from, stretch
from warpfrag.scene.depth_resolution import DEPTH_STEP, depth_resolution_slope

wp.set_module_options({"enable_backward": False})

# An interpolated value that is farther than this outside of its range was extrapolated, and clamped; no rounding does
# that.
SLACK = wp.constant(wp.float64(1e-9))


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
class Triangle:
    """A triangle as `fragment_adjoint` takes it: what its corners have, its thickness map, unit and texture."""

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


@wp.func(inline=True)
def load_triangle(
    points: Any,
    rgba: Any,
    thickness: Any,
    corners: wp.array[wp.vec3i],
    object_id: wp.array[int],
    objects: wp.array[wp.vec3i],
    uv: wp.array[wp.vec2f],
    texture_id: wp.array[int],
    face: int,
) -> Triangle:
    """Return a triangle."""
    corner = corners[face]
    i = corner[0]
    j = corner[1]
    k = corner[2]
    item = object_id[face]
    own = Triangle()
    own.point_a = load_point(points, i)
    own.point_b = load_point(points, j)
    own.point_c = load_point(points, k)
    own.rgba_a = load_rgba(rgba, i)
    own.rgba_b = load_rgba(rgba, j)
    own.rgba_c = load_rgba(rgba, k)
    own.thickness_a = wp.float64(thickness[i])
    own.thickness_b = wp.float64(thickness[j])
    own.thickness_c = wp.float64(thickness[k])
    own.map = objects[item][OBJECT_MAP]
    own.in_p = objects[item][OBJECT_IN_P]
    own.texture = -1
    if texture_id.shape[0] > 0:
        own.texture = texture_id[face]
        own.uv_a = load_uv(uv, i)
        own.uv_b = load_uv(uv, j)
        own.uv_c = load_uv(uv, k)
    return own


@wp.func(inline=True)
def fragment_adjoint(
    rays: Rays,
    own: Triangle,
    maps: Any,
    texels: wp.array[wp.vec4f],
    textures: wp.array[wp.vec3i],
    grad_fragment_rgba: Any,
    grad_fragment_depth: Any,
    grad_fragment_thickness: Any,
    fragment: int,
    pixel: int,
    x: wp.float64,
    y: wp.float64,
    wants_points: bool,
) -> Corners:
    """Return what the corners of a fragment's triangle get of the fragment's gradients; empty gradients are zeros."""
    to = Corners()
    hit = hit_weights(own.point_a, own.point_b, own.point_c, x, y, rays.scale, rays.perspective)
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
        straight = mix3(own.rgba_a, own.rgba_b, own.rgba_c, l_b, l_c)
        texel = wp.vec4d(ONE, ONE, ONE, ONE)
        at = Lookup()
        place = mix3(own.uv_a, own.uv_b, own.uv_c, l_b, l_c)
        if own.texture >= 0:
            at = look_up(texels, textures, own.texture, place)
            texel = texel_between(place, at)
        s = wp.cw_mul(straight, texel)
        grad_opacity = g[3]
        if s[3] < -SLACK or s[3] > ONE + SLACK:
            grad_opacity = wp.float64(0.0)
        g = wp.vec4d(g[0] * s[3], g[1] * s[3], g[2] * s[3], grad_opacity + g[0] * s[0] + g[1] * s[1] + g[2] * s[2])
        to_straight = wp.cw_mul(g, texel)
        to.rgba_a = (ONE - l_b - l_c) * to_straight
        to.rgba_b = l_b * to_straight
        to.rgba_c = l_c * to_straight
        grad_b += wp.dot(to_straight, own.rgba_b - own.rgba_a)
        grad_c += wp.dot(to_straight, own.rgba_c - own.rgba_a)
        if own.texture >= 0:
            to_place = texel_adjoint(wp.cw_mul(g, straight), place, at)
            grad_b += wp.dot(to_place, own.uv_b - own.uv_a)
            grad_c += wp.dot(to_place, own.uv_c - own.uv_a)
    if grad_fragment_thickness.shape[0] > 0:
        to_own = wp.float64(grad_fragment_thickness[fragment])
        factor = mix3(own.thickness_a, own.thickness_b, own.thickness_c, l_b, l_c)
        if factor < -SLACK * wp.max(wp.max(own.thickness_a, own.thickness_b), own.thickness_c):
            to_own = wp.float64(0.0)
        if own.in_p != 0:
            if own.map >= 0:
                factor = wp.float64(maps[own.map, rays.first_row * rays.width + pixel])
            depth = hit[2] * along
            slope = depth_resolution_slope(depth, rays.near, rays.far, DEPTH_STEP)
            grad_depth += to_own * factor * slope
            to_own *= thickness_scale(depth, own.in_p, rays.near, rays.far)
        if own.map < 0:
            to.thickness_a = (ONE - l_b - l_c) * to_own
            to.thickness_b = l_b * to_own
            to.thickness_c = l_c * to_own
            grad_b += to_own * (own.thickness_b - own.thickness_a)
            grad_c += to_own * (own.thickness_c - own.thickness_a)
    if wants_points:
        to_hit = hit_adjoint(grad_b, grad_c, grad_depth * along, own.point_a, own.point_b, own.point_c, rays, x, y)
        to.point_a = to_hit.a
        to.point_b = to_hit.b
        to.point_c = to_hit.c
    return to
