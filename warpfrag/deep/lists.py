"""Lists of fragments put together, sorted, and divided by object."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import dtype_name, kind_named
from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.deep.gather import MOST_LISTS, gather, gathered
from warpfrag.errors import shorten
from warpfrag.fragments import Fragments
from warpfrag.slabs.lists import longest_list

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def add_run(offsets: wp.array[int], pixel: int, first_number: int, index: wp.array[int], at: int):
    """Write the numbers of a pixel's fragments of one image; return where those of the next go."""
    if offsets.shape[0] > 0:
        for fragment in range(offsets[pixel], offsets[pixel + 1]):
            index[at] = first_number + fragment
            at += 1
    return at


@wp.func(inline=True)
def is_possible(offsets: wp.array[int], count: int, pixel: int):
    """Tell whether a pixel's fragments can be those of an image that has so many."""
    if offsets.shape[0] > 0:
        begin = offsets[pixel]
        end = offsets[pixel + 1]
        return begin >= 0 and (pixel > 0 or begin == 0) and end >= begin and end <= count
    return True


@wp.kernel(module="unique", enable_backward=False)
def interleave(
    span: Span,
    first: wp.array[int],
    second: wp.array[int],
    third: wp.array[int],
    fourth: wp.array[int],
    counts: wp.vec4i,
    index: wp.array[int],
    offsets: wp.array[int],
    invalid: wp.array[int],
):
    """Number the fragments of up to four images, pixel by pixel those of the first, then those of the second, ….

    Args:
        span: pixels.
        first: offsets of the first image, (P + 1,).
        second: offsets of the second image, (P + 1,), or empty.
        third: the same.
        fourth: the same.
        counts: number of fragments of each.
        index: output: which fragment comes where.
        offsets: output: those of the result, (P + 1,).
        invalid: output: by thread, 1 if a pixel's fragments are impossible; nothing is written for that pixel.
    """
    for pixel in range(span.begin + wp.tid(), span.end, span.stride):
        possible = is_possible(first, counts[0], pixel) and is_possible(second, counts[1], pixel)
        if not (possible and is_possible(third, counts[2], pixel) and is_possible(fourth, counts[3], pixel)):
            invalid[span.worker] = 1
            continue
        at = first[pixel]
        if second.shape[0] > 0:
            at += second[pixel]
        if third.shape[0] > 0:
            at += third[pixel]
        if fourth.shape[0] > 0:
            at += fourth[pixel]
        at = add_run(first, pixel, 0, index, at)
        at = add_run(second, pixel, counts[0], index, at)
        at = add_run(third, pixel, counts[0] + counts[1], index, at)
        at = add_run(fourth, pixel, counts[0] + counts[1] + counts[2], index, at)
        offsets[pixel + 1] = at


def concat(*fragments: Fragments, renumber: bool = False) -> Fragments:
    """Put fragments of one pixel grid together: in each pixel those of the first, then those of the second, and so on.

    Differentiable in `rgba`, `depth`, `thickness` and `opacity_sum` of all. Where one of them has opacity sums the
    others' are their opacities, which is what they stand for. Ids are kept only where all have them.

    Args:
        *fragments: of one grid, kind of array, precision and device.
        renumber: whether the object ids of each but the first are counted on from the largest before, so that no two
            images share one; by default ids stay what they are. Without effect where an image has none.

    Returns:
        The fragments of all, with offsets and ids in int32.

    Raises:
        TypeError: something is no `Fragments`, there are none, or kinds or precisions differ.
        ValueError: grids or devices differ, or offsets do not fit the fragments.

    Example:
        >>> both = wf.concat(wf.read_deep("smoke.exr"), wf.read_deep("ship.exr"))
        >>> image = wf.composite(both, merge="exact", mix="optical_depth", beta=0.0)
    """
    if not fragments:
        raise TypeError("fragments: got none, expected at least one Fragments")
    for number, each in enumerate(fragments, 1):
        check_alike(f"fragments {number}", each, fragments[0])
    listed = _renumbered(fragments) if renumber else list(fragments)
    while len(listed) > 1:
        listed = [_together(listed[at : at + MOST_LISTS]) for at in range(0, len(listed), MOST_LISTS)]
    return listed[0]


def tidy(fragments: Fragments) -> Fragments:
    """Sort the fragments of each pixel by depth, nearer fronts first, and leave out those without opacity and colour.

    Differentiable as `concat` is. Slabs that overlap stay whole: merging them is what `resolve` and `composite` do.

    Returns:
        The fragments, with offsets and ids in int32.
    """
    host = _checked(fragments).numpy()
    kept = np.flatnonzero((host.rgba != 0.0).any(axis=1))
    pixel, depth = host.pixel[kept], host.depth[kept]
    order = np.lexsort((depth - host.thickness[kept], depth, pixel))
    return gathered(fragments, kept[order], pixel[order])


def split(fragments: Fragments) -> dict[int, Fragments]:
    """Divide fragments by the object that they belong to; `concat` of the parts has all of them again.

    Differentiable as `concat` is.

    Returns:
        By object id, in ascending order, the fragments of that object on the same grid.

    Raises:
        ValueError: the fragments have no object ids.
    """
    if _checked(fragments).object_id is None:
        raise ValueError("fragments: got none with object_id, expected fragments that know their object")
    host = fragments.numpy()
    pixel = host.pixel
    parts = {}
    for number in np.unique(host.object_id):
        own = np.flatnonzero(host.object_id == number)
        parts[int(number)] = gathered(fragments, own, pixel[own])
    return parts


def _checked(fragments: Any) -> Fragments:
    """Return fragments whose offsets fit.

    Raises:
        TypeError: it is no `Fragments`.
        ValueError: the offsets do not fit.
    """
    if not isinstance(fragments, Fragments):
        raise TypeError(f"fragments: got {shorten(fragments)}, expected Fragments")
    kind = kind_named(fragments.kind)
    longest_list(kind.to_warp(kind.astype(fragments.offsets, "int32")), fragments.count)
    return fragments


def check_alike(name: str, each: Any, first: Fragments) -> None:
    """Raise unless fragments have the grid, kind, precision and device of the first.

    Raises:
        TypeError: they are no `Fragments`, or of another kind or precision.
        ValueError: grid or device differ.
    """
    if not isinstance(each, Fragments):
        raise TypeError(f"{name}: got {shorten(each)}, expected Fragments")
    if each.shape != first.shape:
        sizes = ["×".join(map(str, shape)) for shape in (each.shape, first.shape)]
        raise ValueError(f"{name}: got a grid of {sizes[0]} pixels, expected {sizes[1]} like the first")
    own, expected = kind_named(each.kind), kind_named(first.kind)
    if own is not expected:
        raise TypeError(f"{name}: got {own.name} arrays, expected {expected.name} ones like the first")
    if dtype_name(each.rgba) != dtype_name(first.rgba):
        raise TypeError(f"{name}: got {dtype_name(each.rgba)}, expected {dtype_name(first.rgba)} like the first")
    if own.device_of(each.rgba) != own.device_of(first.rgba):
        raise ValueError(f"{name}: got them on {each.rgba.device}, expected {first.rgba.device} like the first")


def _renumbered(fragments: Sequence[Fragments]) -> list[Fragments]:
    if any(each.object_id is None for each in fragments):
        return list(fragments)
    renumbered, first_free = [], 0
    for each in fragments:
        kind = kind_named(each.kind)
        ids = kind.to_numpy(each.object_id) + first_free
        first_free = max(first_free, int(ids.max(initial=-1)) + 1)
        renumbered.append(replace(each, object_id=kind.asarray(ids, each.object_id)))
    return renumbered


def _together(images: Sequence[Fragments]) -> Fragments:
    """Put up to `MOST_LISTS` images together, which are known to be alike."""
    kind, first = kind_named(images[0].kind), images[0]
    if len(images) == 1:
        return first
    with kind.in_order(first.rgba):
        ends: list[Any] = [kind.to_warp(kind.astype(each.offsets, "int32")) for each in images]
        device, absent = ends[0].device, MOST_LISTS - len(images)
        ends += [wp.empty(0, dtype=wp.int32, device=device)] * absent
        counts = [each.count for each in images]
        index = wp.empty(sum(counts), dtype=wp.int32, device=device)
        offsets = wp.zeros(first.pixel_count + 1, dtype=wp.int32, device=device)
        rows = worker_count(first.pixel_count, device, 0)
        invalid = wp.zeros(rows, dtype=wp.int32, device=device)
        arguments = [*ends, wp.vec4i(*counts, *[0] * absent), index, offsets, invalid]
        launch(interleave, first.pixel_count, arguments, device, rows)
        if invalid.numpy().any() or offsets[-1:].numpy()[0] != sum(counts):
            for each in images:
                _checked(each)
    return gather(images, kind.from_warp(index), kind.from_warp(offsets))
