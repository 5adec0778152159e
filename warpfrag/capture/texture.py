"""Textures: bilinear lookups in images that repeat, differentiable in the place (which four texels is held fixed)."""

from typing import Any

import warp as wp

from warpfrag.capture.ray import ONE

wp.set_module_options({"enable_backward": False})


@wp.func
def mix3(a: Any, b: Any, c: Any, l_b: wp.float64, l_c: wp.float64):
    """Interpolate; exact where all three corners have the same value."""
    return a + l_b * (b - a) + l_c * (c - a)


@wp.func
def load_rgba(rgba: Any, vertex: int) -> wp.vec4d:
    return wp.vec4d(
        wp.float64(rgba[vertex, 0]),
        wp.float64(rgba[vertex, 1]),
        wp.float64(rgba[vertex, 2]),
        wp.float64(rgba[vertex, 3]),
    )


@wp.func
def load_uv(uv: wp.array2d[float], vertex: int) -> wp.vec2d:
    return wp.vec2d(wp.float64(uv[vertex, 0]), wp.float64(uv[vertex, 1]))


@wp.struct
class Lookup:
    """Where a texture is read: its size, the texel before the place, and the four around it.

    The place is (l · u · width − 1/2, (1 − l · v) · height − 1/2); texel (0, 0) is the upper left one.
    """

    size: wp.vec2d
    before: wp.vec2d
    upper_left: wp.vec4d
    upper_right: wp.vec4d
    lower_left: wp.vec4d
    lower_right: wp.vec4d


@wp.func
def texture_place(uv: wp.vec2d, size: wp.vec2d) -> wp.vec2d:
    half = wp.float64(0.5)
    return wp.vec2d(uv[0] * size[0] - half, (ONE - uv[1]) * size[1] - half)


@wp.func
def load_texel(texels: wp.array2d[float], textures: wp.array2d[int], texture: int, row: int, column: int) -> wp.vec4d:
    """Return a texel of an image that repeats."""
    height = textures[texture, 1]
    width = textures[texture, 2]
    row = row % height
    column = column % width
    row = wp.where(row < 0, row + height, row)
    column = wp.where(column < 0, column + width, column)
    return load_rgba(texels, textures[texture, 0] + row * width + column)


@wp.func
def look_up(texels: wp.array2d[float], textures: wp.array2d[int], texture: int, uv: wp.vec2d) -> Lookup:
    """Return what `texel_between` takes; nothing but zeros for texture -1."""
    lookup = Lookup()
    if texture >= 0:
        lookup.size = wp.vec2d(wp.float64(textures[texture, 2]), wp.float64(textures[texture, 1]))
        place = texture_place(uv, lookup.size)
        lookup.before = wp.vec2d(wp.floor(place[0]), wp.floor(place[1]))
        # Repeating as float first: uv may be far outside what an int32 holds.
        column = int(lookup.before[0] - wp.floor(lookup.before[0] / lookup.size[0]) * lookup.size[0])
        row = int(lookup.before[1] - wp.floor(lookup.before[1] / lookup.size[1]) * lookup.size[1])
        lookup.upper_left = load_texel(texels, textures, texture, row, column)
        lookup.upper_right = load_texel(texels, textures, texture, row, column + 1)
        lookup.lower_left = load_texel(texels, textures, texture, row + 1, column)
        lookup.lower_right = load_texel(texels, textures, texture, row + 1, column + 1)
    return lookup


@wp.func
def texel_between(
    l_b: wp.float64, l_c: wp.float64, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, at: Lookup
) -> wp.vec4d:
    """Interpolate bilinearly between the four texels of a lookup, at the uv interpolated from the corners."""
    place = texture_place(mix3(a, b, c, l_b, l_c), at.size)
    x = place[0] - at.before[0]
    y = place[1] - at.before[1]
    upper = at.upper_left + x * (at.upper_right - at.upper_left)
    lower = at.lower_left + x * (at.lower_right - at.lower_left)
    return upper + y * (lower - upper)
