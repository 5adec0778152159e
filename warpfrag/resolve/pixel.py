"""One pixel: its fragments sorted by depth, its beta, and the memory that a thread has for the way back."""

from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, Number, in_precisions
from warpfrag.arrays.sorting import shell_sort
from warpfrag.slabs.slab import Slab

wp.set_module_options({"enable_backward": False})


@in_precisions
class Replay:
    """A thread's record of one pixel, by position in depth order; each thread has a row of `length` entries.

    `order`: fragment; `step`: what happened to it; `fragment`: it as a slab; `running`: the running slab after it;
    `through_front`, `through_back`: its `step_powers`; `through`: transmittance of all layers before the running one.
    """

    length: wp.int32
    order: Array[wp.int32]
    step: Array[wp.int32]
    fragment: Array[Slab]
    running: Array[Slab]
    through: Array[Number]
    through_front: Array[Number]
    through_back: Array[Number]


@wp.func(inline=True)
def depth_of(lists: Any, at: int, fragment: int):
    """Return the depth of a fragment."""
    return lists.depth[fragment]


@wp.func(inline=True)
def precedes(lists: Any, i: int, depth: Any, at: int, j: int):
    """Tell whether fragment i, of this depth, comes before j: by depth, then front, then submission."""
    other_depth = lists.depth[j]
    if depth != other_depth:
        return depth < other_depth
    thickness_i = lists.thickness[i]
    thickness_j = lists.thickness[j]
    if thickness_i != thickness_j:
        return thickness_i > thickness_j
    return i < j


_sort = shell_sort(depth_of, precedes)


@wp.func(inline=True)
def sort_pixel(lists: Any, begin: int, count: int, order: wp.array[wp.int32], base: int):
    """Write the fragments of a pixel to `order`, sorted: one comparison each if they are already."""
    ordered = bool(True)
    for position in range(count):
        fragment = begin + position
        order[base + position] = fragment
        if position > 0 and precedes(lists, fragment, lists.depth[fragment], base, fragment - 1):
            ordered = False
    if not ordered:
        _sort(lists, order, base, count)


@wp.func(inline=True)
def pixel_beta(lists: Any, pixel: int):
    """Return beta, which is one for all or one for each pixel."""
    return lists.beta[wp.where(lists.beta.shape[0] > 1, pixel, 0)]


@wp.func(inline=True)
def valid_beta(beta: Any):
    """Tell whether a beta is in range."""
    return beta >= type(beta)(0.0) and beta <= type(beta)(1.0)
