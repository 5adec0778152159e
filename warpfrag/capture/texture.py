"""Textures: bilinear lookups in images that repeat, differentiable in the place (which four texels is held fixed)."""

from typing import Any

import warp as wp

from warpfrag.raster.ray import ONE

wp.set_module_options({"enable_backward": False})


@wp.func
def mix3(a: Any, b: Any, c: Any, l_b: wp.float64, l_c: wp.float64):
    """Interpolate; exact where all three corners have the same value."""
    return a + l_b * (b - a) + l_c * (c - a)


@wp.func
def load_rgba(rgba: Any, vertex: int) -> wp.vec4d:
    """Return a colour and opacity in double precision."""
    return wp.vec4d(rgba[vertex])


@wp.func
def load_uv(uv: wp.array[wp.vec2f], vertex: int) -> wp.vec2d:
    """Return the texture coordinates of a vertex in double precision."""
    return wp.vec2d(uv[vertex])


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
    """Return texture coordinates in texels from the centre of the upper left one."""
    half = wp.float64(0.5)
    return wp.vec2d(uv[0] * size[0] - half, (ONE - uv[1]) * size[1] - half)


@wp.func
def load_texel(
    texels: wp.array[wp.vec4f], textures: wp.array[wp.vec3i], texture: int, row: int, column: int
) -> wp.vec4d:
    """Return a texel of an image that repeats; row and column are at least 0."""
    image = textures[texture]
    return load_rgba(texels, image[0] + (row % image[1]) * image[2] + column % image[2])


@wp.func
def look_up(texels: wp.array[wp.vec4f], textures: wp.array[wp.vec3i], texture: int, uv: wp.vec2d) -> Lookup:
    """Return what `texel_between` takes, for a place in texture coordinates."""
    at = Lookup()
    image = textures[texture]
    at.size = wp.vec2d(wp.float64(image[2]), wp.float64(image[1]))
    place = texture_place(uv, at.size)
    at.before = wp.vec2d(wp.floor(place[0]), wp.floor(place[1]))
    # Repeating as float first: uv may be far outside what an int32 holds.
    column = int(at.before[0] - wp.floor(at.before[0] / at.size[0]) * at.size[0])
    row = int(at.before[1] - wp.floor(at.before[1] / at.size[1]) * at.size[1])
    at.upper_left = load_texel(texels, textures, texture, row, column)
    at.upper_right = load_texel(texels, textures, texture, row, column + 1)
    at.lower_left = load_texel(texels, textures, texture, row + 1, column)
    at.lower_right = load_texel(texels, textures, texture, row + 1, column + 1)
    return at


@wp.func
def texel_between(uv: wp.vec2d, at: Lookup) -> wp.vec4d:
    """Interpolate bilinearly between the four texels of a lookup."""
    place = texture_place(uv, at.size)
    x = place[0] - at.before[0]
    y = place[1] - at.before[1]
    upper = at.upper_left + x * (at.upper_right - at.upper_left)
    lower = at.lower_left + x * (at.lower_right - at.lower_left)
    return upper + y * (lower - upper)
