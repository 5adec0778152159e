"""Shading: the colour, opacity, depth and z-thickness of fragments, interpolated from the corners of their triangles.

    E = edge functions of the pixel's ray;  l_i = E_i / sum E          (perspective-correct barycentric coordinates)
    z = sum l_i z_i;                        depth = z |ray direction|
    A = (sum l_i A_i) m_A;                  C = A (sum l_i c_i) m_c    (m: texel at sum l_i uv_i, bilinear; 1 without)
    t = sum l_i t_i, or the map's pixel;    times P(depth) where t is given in multiples of that

Differentiable in the corners' positions, colour, opacity and thickness and in the thickness maps. Held fixed: which
pixels a triangle covers, the order of the fragments, and which four texels a lookup takes (its place between them is
not). Everything is computed in float64 and stored in the precision of the inputs.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import vectors
from warpfrag.capture.texture import load_rgba, load_uv, look_up, mix3, texel_between
from warpfrag.raster.ray import (
    ONE,
    ZERO,
    Rays,
    Window,
    centre_x,
    centre_y,
    edge_functions,
    load_point,
    planar_depth,
    seen_from,
    stretch,
)
from warpfrag.scene.depth_resolution import DEPTH_STEP, depth_resolution

wp.set_module_options({"enable_backward": False})

# Columns of the table of objects.
OBJECT_FIRST_FACE = wp.constant(0)
OBJECT_MAP = wp.constant(1)
OBJECT_IN_P = wp.constant(2)

SHADE_TENSORS = (
    *("points", "rgba", "thickness", "maps", "corners", "fragment_face", "offsets", "object_id", "objects"),
    *("uv", "texture_id", "texels", "textures"),
)
_VECTORS = ("points", "rgba", "corners", "objects", "uv", "texels", "textures")
SHADE_DIFFERENTIABLE = ("points", "rgba", "thickness", "maps")
SHADE_OUTPUTS = ("rgba", "depth", "thickness", "object_id", "primitive_id")
SHADE_OPTIONS = {
    **{"scale": "float", "perspective": "int", "near": "float", "far": "float"},
    **{"width": "int", "height": "int", "first_row": "int", "row_count": "int"},
}


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


@wp.func
def premultiplied(l_b: wp.float64, l_c: wp.float64, a: wp.vec4d, b: wp.vec4d, c: wp.vec4d, texel: wp.vec4d) -> wp.vec4d:
    """Interpolate straight colour and opacity, multiply them with the texel, and the colour with the opacity."""
    s = wp.cw_mul(mix3(a, b, c, l_b, l_c), texel)
    return wp.vec4d(s[0] * s[3], s[1] * s[3], s[2] * s[3], s[3])


@wp.func
def thickness_scale(depth: wp.float64, in_p: int, near: wp.float64, far: wp.float64) -> wp.float64:
    """Return the unit of a thickness: 1, or P(depth)."""
    if in_p != 0:
        return depth_resolution(depth, near, far, DEPTH_STEP)
    return ONE


@wp.func(inline=True)
def shade_color(
    rgba: Any,
    uv: wp.array[wp.vec2f],
    texture_id: wp.array[int],
    texels: wp.array[wp.vec4f],
    textures: wp.array[wp.vec3i],
    face: int,
    corner: wp.vec3i,
    hit: wp.vec3d,
) -> wp.vec4d:
    """Return a fragment's premultiplied colour and opacity, given its triangle, that one's corners, `hit_weights`."""
    i = corner[0]
    j = corner[1]
    k = corner[2]
    texel = wp.vec4d(ONE, ONE, ONE, ONE)
    if texture_id.shape[0] > 0:
        texture = texture_id[face]
        if texture >= 0:
            place = mix3(load_uv(uv, i), load_uv(uv, j), load_uv(uv, k), hit[0], hit[1])
            texel = texel_between(place, look_up(texels, textures, texture, place))
    s = premultiplied(hit[0], hit[1], load_rgba(rgba, i), load_rgba(rgba, j), load_rgba(rgba, k), texel)
    # Rounding may leave an interpolated value just outside its range.
    return wp.vec4d(s[0], s[1], s[2], wp.clamp(s[3], ZERO, ONE))


@wp.func(inline=True)
def shade_thickness(
    rays: Rays,
    thickness: Any,
    maps: Any,
    object: wp.vec3i,
    corner: wp.vec3i,
    hit: wp.vec3d,
    depth: wp.float64,
    pixel: int,
) -> wp.float64:
    """Return a fragment's z-thickness, given its row in the table of objects, its triangle's corners and its depth."""
    own = mix3(
        wp.float64(thickness[corner[0]]), wp.float64(thickness[corner[1]]), wp.float64(thickness[corner[2]]),
        hit[0], hit[1],
    )  # fmt: skip
    if object[OBJECT_MAP] >= 0:
        own = wp.float64(maps[object[OBJECT_MAP], rays.first_row * rays.width + pixel])
    own *= thickness_scale(depth, object[OBJECT_IN_P], rays.near, rays.far)
    return wp.max(own, ZERO)


@cache
def _forward_kernel(scalar: Any) -> wp.Kernel:
    vec3, vec4 = wp.types.vector(3, scalar), wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def shade_fwd(
        span: Span,
        rays: Rays,
        points: wp.array(dtype=vec3),
        rgba: wp.array(dtype=vec4),
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
        fragment_rgba: wp.array(dtype=vec4),
        fragment_depth: wp.array(dtype=scalar),
        fragment_thickness: wp.array(dtype=scalar),
        fragment_object: wp.array(dtype=int),
        fragment_primitive: wp.array(dtype=int),
    ):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            row = pixel // rays.width
            column = pixel - row * rays.width
            x = centre_x(rays, column)
            y = centre_y(rays, row)
            along = stretch(x, y, rays.scale, rays.perspective)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                face = fragment_face[fragment]
                corner = corners[face]
                hit = hit_weights(
                    load_point(points, corner[0]), load_point(points, corner[1]), load_point(points, corner[2]),
                    x, y, rays.scale, rays.perspective,
                )  # fmt: skip
                depth = hit[2] * along
                item = object_id[face]
                object = objects[item]
                shaded = shade_color(rgba, uv, texture_id, texels, textures, face, corner, hit)
                own = shade_thickness(rays, thickness, maps, object, corner, hit, depth, pixel)
                fragment_rgba[fragment] = vec4(shaded)
                fragment_depth[fragment] = scalar(depth)
                fragment_thickness[fragment] = scalar(own)
                fragment_object[fragment] = item
                fragment_primitive[fragment] = face - object[OBJECT_FIRST_FACE]

    return shade_fwd


def shade_output_like(inputs: Sequence[Any], **options: Any) -> list[tuple[tuple[int, ...], str]]:
    """Return the shapes and kinds of `SHADE_OUTPUTS`."""
    count = inputs[5].shape[0]
    return [((count, 4), "float"), ((count,), "float"), ((count,), "float"), ((count,), "int32"), ((count,), "int32")]


def present(inputs: Sequence[Any]) -> list[wp.array]:
    """Return the inputs `SHADE_TENSORS` as kernels take them, with empty arrays in place of None: those are skipped."""
    points = inputs[0]
    kinds = {"maps": ((0, 0), points.dtype), "uv": ((0, 2), wp.float32), "texture_id": ((0,), wp.int32)}
    kinds |= {"texels": ((0, 4), wp.float32), "textures": ((0, 3), wp.int32)}
    arrays = []
    for name, array in zip(SHADE_TENSORS, inputs, strict=True):
        if array is None:
            shape, dtype = kinds[name]
            array = wp.empty(shape, dtype=dtype, device=points.device)
        arrays.append(vectors(array) if name in _VECTORS else array)
    return arrays


def shade_forward(inputs: Sequence[Any], outputs: Sequence[Any], **options: Any) -> None:
    """Shade the fragments: `inputs` are `SHADE_TENSORS`, `outputs` `SHADE_OUTPUTS`, `options` those of a `Window`."""
    points = inputs[0]
    if outputs[0].shape[0]:
        window = Window(**options)
        arguments = [window.rays(), *present(inputs), vectors(outputs[0]), *outputs[1:]]
        launch(_forward_kernel(points.dtype), window.pixel_count, arguments, points.device)
