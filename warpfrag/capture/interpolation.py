"""One fragment: what is interpolated from the corners of its triangle where the ray of its pixel meets that.

    E = edge functions of the pixel's ray;  l_i = E_i / sum E          (perspective-correct barycentric coordinates)
    z = sum l_i z_i;                        depth = z |ray direction|
    A = (sum l_i A_i) m_A;                  C = A (sum l_i c_i) m_c    (m: texel at sum l_i uv_i, bilinear; 1 without)
    t = sum l_i t_i, or the map's pixel;    times P(depth) where t is given in multiples of that

Everything is computed in float64. The gradient is in `warpfrag.capture.corner_gradients`.
"""

from typing import Any

import warp as wp

from warpfrag.capture.surfaces import OBJECT_IN_P, OBJECT_MAP
from warpfrag.capture.texture import load_rgba, load_uv, look_up, mix3, texel_between
from warpfrag.raster.ray import ONE, ZERO, Rays, edge_functions, load_point, planar_depth, seen_from
from warpfrag.scene.depth_resolution import DEPTH_STEP, depth_resolution

wp.set_module_options({"enable_backward": False})


@wp.func
def hit_weights(
    a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, x: wp.float64, y: wp.float64, scale: wp.float64, perspective: int
) -> wp.vec3d:
    """Return the barycentric coordinates of b and c, and the planar depth, where the ray meets the triangle."""
    e = edge_functions(
        seen_from(a, x, y, scale, perspective),
        seen_from(b, x, y, scale, perspective),
        seen_from(c, x, y, scale, perspective),
    )
    scale = ONE / (e[0] + e[1] + e[2])
    return wp.vec3d(e[1] * scale, e[2] * scale, planar_depth(e, a[2], b[2], c[2]))


@wp.func(inline=True)
def hit_of(surface: Any, corner: wp.vec3i, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """Return the `hit_weights` of a triangle, given its corners and how far the pixel is from the image's middle."""
    return hit_weights(
        load_point(surface.points, corner[0]), load_point(surface.points, corner[1]),
        load_point(surface.points, corner[2]), x, y, surface.rays.scale, surface.rays.perspective,
    )  # fmt: skip


@wp.func
def premultiplied(l_b: wp.float64, l_c: wp.float64, a: wp.vec4d, b: wp.vec4d, c: wp.vec4d, texel: wp.vec4d) -> wp.vec4d:
    """Interpolate straight colour and opacity, multiply them with the texel, and the colour with the opacity."""
    s = wp.cw_mul(mix3(a, b, c, l_b, l_c), texel)
    return wp.vec4d(s[0] * s[3], s[1] * s[3], s[2] * s[3], s[3])


@wp.func
def thickness_scale(planar: wp.float64, along: wp.float64, in_p: int, rays: Rays) -> wp.float64:
    """Return the unit of a thickness: 1, or P of the planar depth, which is `along` times as long along the ray."""
    if in_p != 0:
        return depth_resolution(planar, rays.near, rays.far, DEPTH_STEP, rays.perspective) * along
    return ONE


@wp.func(inline=True)
def shade_color(surface: Any, face: int, corner: wp.vec3i, hit: wp.vec3d) -> wp.vec4d:
    """Return a fragment's premultiplied colour and opacity, given its triangle, that one's corners, `hit_weights`."""
    i = corner[0]
    j = corner[1]
    k = corner[2]
    texel = wp.vec4d(ONE, ONE, ONE, ONE)
    if surface.texture_id.shape[0] > 0:
        texture = surface.texture_id[face]
        if texture >= 0:
            place = mix3(load_uv(surface.uv, i), load_uv(surface.uv, j), load_uv(surface.uv, k), hit[0], hit[1])
            texel = texel_between(place, look_up(surface.texels, surface.textures, texture, place))
    s = premultiplied(
        hit[0], hit[1], load_rgba(surface.rgba, i), load_rgba(surface.rgba, j), load_rgba(surface.rgba, k), texel
    )
    # Rounding may leave an interpolated value just outside its range.
    return wp.vec4d(s[0], s[1], s[2], wp.clamp(s[3], ZERO, ONE))


@wp.func(inline=True)
def map_thickness(surface: Any, row: int, pixel: int) -> wp.float64:
    """Return what a thickness map has in a pixel of the window."""
    return wp.float64(surface.maps[row, surface.rays.first_row * surface.rays.width + pixel])


@wp.func(inline=True)
def shade_thickness(
    surface: Any, item: wp.vec3i, corner: wp.vec3i, hit: wp.vec3d, along: wp.float64, pixel: int
) -> wp.float64:
    """Return a fragment's z-thickness, given its row in the table of objects, its triangle's corners and `stretch`."""
    own = mix3(
        wp.float64(surface.thickness[corner[0]]), wp.float64(surface.thickness[corner[1]]),
        wp.float64(surface.thickness[corner[2]]), hit[0], hit[1],
    )  # fmt: skip
    if item[OBJECT_MAP] >= 0:
        own = map_thickness(surface, item[OBJECT_MAP], pixel)
    own *= thickness_scale(hit[2], along, item[OBJECT_IN_P], surface.rays)
    return wp.max(own, ZERO)
