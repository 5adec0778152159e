"""Sweeping through the boundaries of a pixel's slabs, front to back: which intervals there are and what fills them.

All fronts and backs cut the ray into intervals. Fragments are entered in order of their fronts; those that fill the
present interval are the active ones. Surfaces (t = 0) are entered in an interval of no length by themselves: its
members are the surfaces at one depth, behind what ends there and before what begins there. Where nothing is active a
run of overlapping slabs ends, and a layer with it.

An interval is known by the boundaries at its two ends, numbered 2 p for the front and 2 p + 1 for the back of the
fragment at position p in the order of fronts. Which boundary follows which is a discrete choice that adjoints hold
fixed; of boundaries in one place the first found stands for all.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, Number, in_precisions
from warpfrag.arrays.sorting import shell_sort
from warpfrag.slabs.lists import front_of, load_slab
from warpfrag.slabs.slab import Slab, log_transmittance

wp.set_module_options({"enable_backward": False})

BETA_ONE = wp.constant(0)
BETA_PIXEL = wp.constant(1)
BETA_FRAGMENT = wp.constant(2)


@in_precisions
class Sweep:
    """Where a sweep is: the interval `begin` ... `end` and the numbers of the boundaries there.

    Positions `entered : following` came in with it; it is filled by the active ones, or by the `surfaces` at positions
    from `entered` on, if that is not zero. `fresh` tells that a run begins with it.
    """

    begin: Number
    end: Number
    begin_boundary: wp.int32
    end_boundary: wp.int32
    entered: wp.int32
    following: wp.int32
    active: wp.int32
    surfaces: wp.int32
    fresh: wp.bool


@in_precisions
class IntervalScratch:
    """A thread's memory of one pixel; each thread has a row of `length` entries, twice that for intervals.

    By position in the order of fronts: `order`: fragment; `fragment`: it as a slab; `rest`: share of its opacity behind
    the begin of the present interval. `active`: positions of the active fragments.

    The way back alone needs the others. By position: `cut`, `power`: relative length and T^r up to there; `next_...`:
    the same of the interval's end; `share`, `passed`: a part's `part_share`; `weight`: its weight in the mix;
    `transmittance_before`, `opacity_before`: of the interval's members before it; `grad_rest`: gradient of `rest`;
    `grad`, `grad_beta`: the fragment's own; `others`: transmittance of the fragments of its layer before it;
    `fragment_layer`: its layer. By interval: `through`, `tau`: transmittance before it and of it; `behind`: product of
    its colour, later of the colour behind it, and the cotangent; `layer`: its layer.
    """

    length: wp.int32
    order: Array[wp.int32]
    active: Array[wp.int32]
    fragment: Array[Slab]
    rest: Array[Number]
    cut: Array[Number]
    power: Array[Number]
    next_rest: Array[Number]
    next_cut: Array[Number]
    next_power: Array[Number]
    share: Array[Number]
    passed: Array[Number]
    weight: Array[Number]
    transmittance_before: Array[Number]
    opacity_before: Array[Number]
    grad_rest: Array[Number]
    grad: Array[Slab]
    grad_beta: Array[Number]
    others: Array[Number]
    fragment_layer: Array[wp.int32]
    through: Array[Number]
    tau: Array[Number]
    behind: Array[Number]
    layer: Array[wp.int32]


# The arrays that the way forth takes, and those with an entry for each interval.
FORWARD_SCRATCH = ("order", "active", "fragment", "rest")
BY_INTERVAL = ("through", "tau", "behind", "layer")


@wp.func(inline=True)
def front_at(lists: Any, at: int, fragment: int):
    """Return the front of a fragment."""
    return front_of(lists, fragment)


@wp.func(inline=True)
def enters_before(lists: Any, i: int, front: Any, at: int, j: int):
    """Tell whether fragment i, with this front, comes before j: by front, depth (surfaces first), submission."""
    other_front = front_of(lists, j)
    if front != other_front:
        return front < other_front
    depth_i = lists.depth[i]
    depth_j = lists.depth[j]
    if depth_i != depth_j:
        return depth_i < depth_j
    return i < j


_sort = shell_sort(front_at, enters_before)


@wp.func(inline=True)
def load_pixel(lists: Any, begin: int, count: int, scratch: Any, base: int):
    """Sort the fragments of a pixel by their fronts and load them as slabs."""
    for position in range(count):
        scratch.order[base + position] = begin + position
    _sort(lists, scratch.order, base, count)
    for position in range(count):
        fragment = scratch.order[base + position]
        s = load_slab(lists, fragment, scratch.fragment[base + position], False)
        if s.front < s.back:
            s.log_transmittance = log_transmittance(s.opacity)
        scratch.fragment[base + position] = s
        scratch.rest[base + position] = type(s.opacity)(1.0)


@wp.func(inline=True)
def fragment_beta(lists: Any, pixel: int, fragment: int, beta_per: int):
    """Return the beta of a fragment."""
    index = int(0)
    if beta_per == BETA_PIXEL:
        index = pixel
    if beta_per == BETA_FRAGMENT:
        index = fragment
    return lists.beta[index]


@wp.func(inline=True)
def in_progress(sweep: Any, count: int):
    """Tell whether intervals are left."""
    return sweep.active > 0 or sweep.following < count


@wp.func(inline=True)
def advance(sweep: Any, scratch: Any, base: int, count: int):
    """Return the sweep at the next interval; call `leave` before the one after."""
    sweep.fresh = sweep.active == 0
    sweep.begin = sweep.end
    sweep.begin_boundary = sweep.end_boundary
    sweep.entered = sweep.following
    if sweep.fresh:
        sweep.begin = scratch.fragment[base + sweep.following].front
        sweep.begin_boundary = 2 * sweep.following
    # Among equal fronts surfaces come first: only theirs is their back too.
    at = int(sweep.following)
    while at < count and scratch.fragment[base + at].back == sweep.begin:
        at += 1
    sweep.surfaces = at - sweep.following
    if sweep.surfaces > 0:
        sweep.end = sweep.begin
        sweep.end_boundary = 2 * sweep.entered + 1
        sweep.following = at
        return sweep
    while at < count and scratch.fragment[base + at].front == sweep.begin:
        scratch.active[base + sweep.active] = at
        sweep.active += 1
        at += 1
    sweep.following = at
    sweep.end_boundary = -1
    if at < count:
        sweep.end = scratch.fragment[base + at].front
        sweep.end_boundary = 2 * at
    for slot in range(sweep.active):
        position = scratch.active[base + slot]
        z = scratch.fragment[base + position].back
        if sweep.end_boundary < 0 or z < sweep.end:
            sweep.end = z
            sweep.end_boundary = 2 * position + 1
    return sweep


@wp.func(inline=True)
def leave(sweep: Any, scratch: Any, base: int):
    """Return the sweep without the active slabs that end where the interval ends."""
    kept = int(0)
    for slot in range(sweep.active):
        position = scratch.active[base + slot]
        if scratch.fragment[base + position].back > sweep.end:
            scratch.active[base + kept] = position
            kept += 1
    sweep.active = kept
    return sweep
