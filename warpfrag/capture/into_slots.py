"""The pass of the bounded capture: triangles are rasterised and shaded straight into the slots of their pixels.

A thread owns a run of pixels and goes through the triangles that may cover them, in order of submission: on the CPU a
run is a piece of the image, on CUDA one pixel. So a pixel's fragments arrive in one order, no two threads share a slot,
and nothing is kept but the slots. For occupancy culling the same walk is made twice before: once for the depth range of
each pixel, once to fill its map.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import vectors
from warpfrag.capture.shade import SHADE_TENSORS, hit_weights, present, shade_color, shade_thickness
from warpfrag.raster.ray import ZERO, Rays, centre_x, centre_y, columns_of_row, hit_depth, is_wide, load_point, stretch
from warpfrag.raster.triangles import BAND_ROWS, Triangles, list_by_band
from warpfrag.storage.occupancy import WORD_BITS, bucket_of, last_bucket, set_bucket
from warpfrag.storage.slots import SLOTS, finish_slots, insert, is_beyond, slots_in

wp.set_module_options({"enable_backward": False})

STAGE_RANGE = wp.constant(0)
STAGE_FILL = wp.constant(1)
STAGE_INSERT = wp.constant(2)

# Rows of the tally: all fragments of a pixel, those that the occupancy map culls, those behind all slots.
TALLY_ALL = wp.constant(0)
TALLY_OCCUPANCY = wp.constant(1)
TALLY_BEHIND = wp.constant(2)
TALLY_ROWS = 3


@wp.struct
class Surface32:
    """The arrays that shading takes, by vertex, face, object and texture."""

    rgba: wp.array[wp.vec4f]
    thickness: wp.array[wp.float32]
    maps: wp.array2d[wp.float32]
    object_id: wp.array[wp.int32]
    objects: wp.array[wp.vec3i]
    uv: wp.array[wp.vec2f]
    texture_id: wp.array[wp.int32]
    texels: wp.array[wp.vec4f]
    textures: wp.array[wp.vec3i]


@wp.struct
class Surface64:
    """`Surface32` in double precision."""

    rgba: wp.array[wp.vec4d]
    thickness: wp.array[wp.float64]
    maps: wp.array2d[wp.float64]
    object_id: wp.array[wp.int32]
    objects: wp.array[wp.vec3i]
    uv: wp.array[wp.vec2f]
    texture_id: wp.array[wp.int32]
    texels: wp.array[wp.vec4f]
    textures: wp.array[wp.vec3i]


@wp.struct
class Occupancy32:
    """Occupancy maps: words (P, d), range of depth (P,), last bucket that is not culled (P,); empty for no culling.

    `tally` (`TALLY_ROWS`, P) counts fragments, or is empty.
    """

    words: wp.array2d[wp.uint32]
    near: wp.array[wp.float32]
    far: wp.array[wp.float32]
    last: wp.array[wp.int32]
    tally: wp.array2d[wp.int32]


@wp.struct
class Occupancy64:
    """`Occupancy32` in double precision."""

    words: wp.array2d[wp.uint32]
    near: wp.array[wp.float64]
    far: wp.array[wp.float64]
    last: wp.array[wp.int32]
    tally: wp.array2d[wp.int32]


SURFACE: Any = {wp.float32: Surface32, wp.float64: Surface64}
OCCUPANCY: Any = {wp.float32: Occupancy32, wp.float64: Occupancy64}


@wp.func(inline=True)
def is_culled(occupancy: Any, pixel: int, z: Any):
    """Tell whether a pixel's occupancy map has enough fragments in front of a depth."""
    culled = bool(False)
    if occupancy.words.shape[0] > 0:
        count = occupancy.words.shape[1] * WORD_BITS
        culled = bucket_of(z, occupancy.near[pixel], occupancy.far[pixel], count) > occupancy.last[pixel]
    return culled


@wp.func(inline=True)
def count_one(occupancy: Any, kind: int, pixel: int):
    """Add a fragment to the tally."""
    if occupancy.tally.shape[0] > 0:
        occupancy.tally[kind, pixel] = occupancy.tally[kind, pixel] + 1


@wp.func(inline=True)
def map_hit(stage: int, occupancy: Any, pixel: int, z: Any):
    """Take a fragment's depth into its pixel's range, or into its occupancy map."""
    if stage == STAGE_RANGE:
        occupancy.near[pixel] = wp.min(occupancy.near[pixel], z)
        occupancy.far[pixel] = wp.max(occupancy.far[pixel], z)
    else:
        count = occupancy.words.shape[1] * WORD_BITS
        bucket = bucket_of(z, occupancy.near[pixel], occupancy.far[pixel], count)
        set_bucket(occupancy.words, pixel, bucket)


@wp.func(inline=True)
def stream_hit(
    surface: Any,
    slots: Any,
    occupancy: Any,
    rays: Rays,
    face: int,
    corner: wp.vec3i,
    hit: wp.vec3d,
    depth: wp.float64,
    z: Any,
    pixel: int,
    merging: int,
):
    """Shade a fragment as far as it is needed, and stream it into the slots of its pixel; z is its rounded depth."""
    count_one(occupancy, TALLY_ALL, pixel)
    if is_culled(occupancy, pixel, z):
        count_one(occupancy, TALLY_OCCUPANCY, pixel)
    else:
        front = z
        if merging != 0:
            object = surface.objects[surface.object_id[face]]
            own = shade_thickness(rays, surface.thickness, surface.maps, object, corner, hit, depth, pixel)
            front = z - type(z)(own)
        if is_beyond(slots, pixel, front):
            count_one(occupancy, TALLY_BEHIND, pixel)
        else:
            shaded = shade_color(
                surface.rgba, surface.uv, surface.texture_id, surface.texels, surface.textures, face, corner, hit
            )
            opacity = type(z)(shaded[3])
            color = wp.vector(type(z)(shaded[0]), type(z)(shaded[1]), type(z)(shaded[2]), opacity)
            insert(slots, pixel, 0, color, opacity, front, z)


@wp.func(inline=True)
def begin_stage(stage: int, occupancy: Any, pixel: int):
    """Clear what a stage fills."""
    if stage == STAGE_RANGE:
        occupancy.near[pixel] = type(occupancy.near[pixel])(wp.inf)
        occupancy.far[pixel] = type(occupancy.far[pixel])(-wp.inf)
        for word in range(occupancy.words.shape[1]):
            occupancy.words[pixel, word] = wp.uint32(0)


@cache
def _stream_kernel(scalar: Any, merging: int) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def stream(
        span: Span,
        first_stage: int,
        rays: Rays,
        boxes: wp.array(dtype=wp.vec4i),
        listed: wp.array(dtype=int),
        band_begins: wp.array(dtype=int),
        points: wp.array(dtype=wp.types.vector(3, scalar)),
        corners: wp.array(dtype=wp.vec3i),
        surface: SURFACE[scalar],
        slots: SLOTS[scalar],
        occupancy: OCCUPANCY[scalar],
    ):
        # A stride above 1 means CUDA: runs of one pixel.
        run = wp.where(span.stride == 1, span.end - span.begin, 1)
        step = wp.where(span.stride == 1, run, span.stride)
        for first_pixel in range(span.begin + wp.tid(), span.end, step):
            end_pixel = wp.min(first_pixel + run, span.end)
            for pixel in range(first_pixel, end_pixel):
                slots.count[pixel] = 0
            run_row = first_pixel // rays.width
            run_end_row = (end_pixel - 1) // rays.width + 1
            for stage in range(first_stage, STAGE_INSERT + 1):
                for pixel in range(first_pixel, end_pixel):
                    begin_stage(stage, occupancy, pixel)
                for band in range(run_row // BAND_ROWS, (run_end_row - 1) // BAND_ROWS + 1):
                    first_row = wp.max(run_row, band * BAND_ROWS)
                    end_row = wp.min(run_end_row, (band + 1) * BAND_ROWS)
                    for item in range(band_begins[band], band_begins[band + 1]):
                        face = listed[item]
                        box = boxes[face]
                        top = wp.max(box[0], first_row)
                        bottom = wp.min(box[1], end_row)
                        left = box[2]
                        right = box[3]
                        if run_end_row - run_row == 1:
                            left = wp.max(left, first_pixel - run_row * rays.width)
                            right = wp.min(right, end_pixel - run_row * rays.width)
                        if top < bottom and left < right:
                            corner = corners[face]
                            a = load_point(points, corner[0])
                            b = load_point(points, corner[1])
                            c = load_point(points, corner[2])
                            wide = is_wide(rays, a, b, c, left, right)
                            for row in range(top, bottom):
                                y = centre_y(rays, row)
                                columns = wp.vec2i(left, right)
                                if wide:
                                    columns = columns_of_row(rays, a, b, c, y, left, right)
                                begin = wp.max(columns[0], first_pixel - row * rays.width)
                                for column in range(begin, wp.min(columns[1], end_pixel - row * rays.width)):
                                    x = centre_x(rays, column)
                                    pixel = row * rays.width + column
                                    if hit_depth(rays, a, b, c, x, y) > ZERO:
                                        hit = hit_weights(a, b, c, x, y, rays.scale, rays.perspective)
                                        depth = hit[2] * stretch(x, y, rays.scale, rays.perspective)
                                        z = scalar(depth)
                                        if stage == STAGE_INSERT:
                                            stream_hit(
                                                surface,
                                                slots,
                                                occupancy,
                                                rays,
                                                face,
                                                corner,
                                                hit,
                                                depth,
                                                z,
                                                pixel,
                                                merging,
                                            )
                                        else:
                                            map_hit(stage, occupancy, pixel, z)
                if stage == STAGE_FILL:
                    for pixel in range(first_pixel, end_pixel):
                        occupancy.last[pixel] = last_bucket(occupancy.words, pixel, slots.core)
            for pixel in range(first_pixel, end_pixel):
                finish_slots(slots, pixel)

    return stream


def stream_triangles(
    triangles: Triangles,
    surfaces: Sequence[wp.array | None],
    outputs: Sequence[wp.array],
    *,
    merge: str,
    tail: str,
    words: int = 0,
    tally: wp.array | None = None,
) -> None:
    """Rasterise and shade all triangles into the slots of their pixels, which become layers.

    Args:
        triangles: what `prepare_triangles` returns.
        surfaces: points, rgba, thickness, maps, and the tables from `object_id` on, of `SHADE_TENSORS`.
        outputs: the arrays of the layers, (P, K, 4), three times (P, K), (P,).
        merge: "none" or "order_independent".
        tail: "mix" or "discard".
        words: words of 32 bits of a pixel's occupancy map; 0 for no culling by it.
        tally: zeros (`TALLY_ROWS`, P), to count fragments in; None for no count.
    """
    device, scalar, window = triangles.device, triangles.points.dtype, triangles.window
    listed, band_begins = triangles.listed, triangles.band_begins
    if listed is None:
        lists = list_by_band(triangles.boxes.numpy(), window.row_count)
        listed, band_begins = (wp.array(array, dtype=int, device=device) for array in lists)
    nothing = wp.empty(0, dtype=int, device=device)
    arrays = present((*surfaces[:4], triangles.corners, nothing, nothing, *surfaces[4:]))
    surface = SURFACE[scalar]()
    for name, array in zip(SHADE_TENSORS, arrays, strict=True):
        if hasattr(surface, name):
            setattr(surface, name, array)
    occupancy = OCCUPANCY[scalar]()
    if words:
        occupancy.words = wp.empty((window.pixel_count, words), dtype=wp.uint32, device=device)
        occupancy.near = wp.empty(window.pixel_count, dtype=scalar, device=device)
        occupancy.far = wp.empty(window.pixel_count, dtype=scalar, device=device)
        occupancy.last = wp.empty(window.pixel_count, dtype=int, device=device)
    if tally is not None:
        occupancy.tally = tally
    arguments = [
        *(int(STAGE_RANGE if words else STAGE_INSERT), window.rays()),
        *(vectors(triangles.boxes), listed, band_begins, arrays[0], arrays[4]),
        *(surface, slots_in(*outputs, tail=tail), occupancy),
    ]
    launch(_stream_kernel(scalar, int(merge != "none")), window.pixel_count, arguments, device)
