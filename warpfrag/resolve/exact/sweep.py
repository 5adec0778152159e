"""Sweeping through the boundaries of a pixel's slabs, front to back: which intervals there are and what fills them.

All fronts and backs cut the ray into intervals. Fragments are entered in order of their fronts; those that fill the
present interval are the active ones. Surfaces (t = 0) are entered in an interval of no length by themselves: its
members are the surfaces at one depth, behind what ends there and before what begins there. Where nothing is active a
run of overlapping slabs ends, and a layer with it.

An interval is known by the boundaries at its two ends, numbered 2 p for the front and 2 p + 1 for the back of the
fragment at position p in the order of fronts. Which boundary follows which is a discrete choice that adjoints hold
fixed; those in one place follow one another too, so that every derivative is one that the function has to one side.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, Number, in_precisions
from warpfrag.arrays.sorting import shell_sort
from warpfrag.slabs.lists import load_slab
from warpfrag.slabs.slab import Slab, log_transmittance

wp.set_module_options({"enable_backward": False})

BETA_ONE = wp.constant(0)
BETA_PIXEL = wp.constant(1)
BETA_FRAGMENT = wp.constant(2)


@in_precisions
class Sweep:
    """Where a sweep is: the interval `begin` ... `end` and the numbers of the boundaries there.

    Positions `entered : following` came in with it; it is filled by the active ones, or by the `surfaces` at positions
    from `entered` on, if that is not zero. `fresh` tells that a run begins with it. Of the active slabs `last` has the
    nearest back, and the `farthest` back of all lies there.
    """

    begin: Number
    end: Number
    begin_boundary: wp.int32
    end_boundary: wp.int32
    entered: wp.int32
    following: wp.int32
    active: wp.int32
    surfaces: wp.int32
    last: wp.int32
    farthest: Number
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
def front(s: Any):
    """Return where a slab begins."""
    return s.back - s.thickness


@wp.func(inline=True)
def front_at(scratch: Any, at: int, number: int):
    """Return where a slab begins."""
    return front(scratch.fragment[number])


@wp.func(inline=True)
def enters_before(scratch: Any, i: int, front_i: Any, at: int, j: int):
    """Tell whether slab i, with this front, comes before j: by front, depth (surfaces first), submission."""
    front_j = front(scratch.fragment[j])
    if front_i != front_j:
        return front_i < front_j
    back_i = scratch.fragment[i].back
    back_j = scratch.fragment[j].back
    if back_i != back_j:
        return back_i < back_j
    return i < j


_sort = shell_sort(front_at, enters_before)


@wp.func(inline=True)
def load_from(lists: Any, fragment: int, slab: Any, nearest: Any):
    """Return a fragment as a slab like `slab`, its depth counted from `nearest`."""
    s = load_slab(lists, fragment, slab, False)
    s.back = s.back - nearest
    if s.back - s.thickness == s.back:
        # So thin a slab has no front of its own here.
        s.thickness = type(s.back)(0.0)
    return s


@wp.func(inline=True)
def nearest_depth(lists: Any, begin: int, count: int):
    """Return the depth of the nearest fragment of a pixel; 0 where there is none."""
    nearest = type(lists.floor)(0.0)
    if count > 0:
        nearest = lists.depth[begin]
    for fragment in range(begin + 1, begin + count):
        nearest = wp.min(nearest, lists.depth[fragment])
    return nearest


@wp.func(inline=True)
def load_pixel(lists: Any, begin: int, count: int, nearest: Any, scratch: Any, base: int):
    """Sort the fragments of a pixel by their fronts and load them as slabs, whose depths are counted from `nearest`.

    Boundaries are compared and subtracted: counted from the eye, those of thin slabs far away would have lost their
    digits.
    """
    for number in range(count):
        scratch.order[base + number] = base + number
        scratch.fragment[base + number] = load_from(lists, begin + number, scratch.fragment[base + number], nearest)
    _sort(scratch, scratch.order, base, count)
    for position in range(count):
        fragment = begin + scratch.order[base + position] - base
        scratch.order[base + position] = fragment
        s = load_from(lists, fragment, scratch.fragment[base + position], nearest)
        if s.thickness > type(s.back)(0.0):
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
def enter_front(sweep: Any, scratch: Any, base: int, count: int):
    """Return the sweep with the slab active whose front begins the interval, if one does."""
    at = int(sweep.following)
    if at < count and sweep.begin_boundary == 2 * at:
        scratch.active[base + sweep.active] = at
        sweep.active += 1
        sweep.following = at + 1
        if sweep.last < 0 or scratch.fragment[base + at].back < scratch.fragment[base + sweep.last].back:
            sweep.last = at
        sweep.farthest = wp.max(sweep.farthest, scratch.fragment[base + at].back)
    return sweep


@wp.func(inline=True)
def advance(sweep: Any, scratch: Any, base: int, count: int, apart: bool):
    """Return the sweep at the next interval; call `leave` before the one after.

    Boundaries in one place come one after the other, with intervals of no length between: backs, then surfaces, which
    share one interval, then fronts. But a surface at the back of a slab comes before that, where they are in one run
    anyway, or runs need not be told `apart`: so it is seen by the slab, and has its derivative in thickness.
    """
    sweep.fresh = sweep.active == 0
    sweep.begin = sweep.end
    sweep.begin_boundary = sweep.end_boundary
    sweep.entered = sweep.following
    if sweep.fresh:
        sweep.begin = front(scratch.fragment[base + sweep.following])
        sweep.begin_boundary = 2 * sweep.following
    # The nearest and the farthest back among the active slabs.
    sweep.last = -1
    sweep.farthest = sweep.begin
    for slot in range(sweep.active):
        position = scratch.active[base + slot]
        back = scratch.fragment[base + position].back
        if sweep.last < 0 or back < scratch.fragment[base + sweep.last].back:
            sweep.last = position
        sweep.farthest = wp.max(sweep.farthest, back)
    ends_here = bool(False)
    if sweep.last >= 0:
        ends_here = scratch.fragment[base + sweep.last].back == sweep.begin
    # Among equal fronts surfaces come first: only theirs is their back too.
    at = int(sweep.following)
    if not ends_here or sweep.farthest > sweep.begin or not apart:
        while at < count and scratch.fragment[base + at].back == sweep.begin:
            at += 1
    sweep.surfaces = at - sweep.following
    sweep.following = at
    if sweep.surfaces > 0:
        sweep.end = sweep.begin
        sweep.end_boundary = 2 * sweep.entered + 1
        return sweep
    if not ends_here:
        sweep = enter_front(sweep, scratch, base, count)
    sweep.end = scratch.fragment[base + sweep.last].back
    sweep.end_boundary = 2 * sweep.last + 1
    if sweep.following < count:
        following = scratch.fragment[base + sweep.following]
        surface_first = following.back == sweep.end and (sweep.farthest > sweep.end or not apart)
        if front(following) < sweep.end or (surface_first and front(following) == sweep.end):
            sweep.end = front(following)
            sweep.end_boundary = 2 * sweep.following
    return sweep


@wp.func(inline=True)
def leave(sweep: Any, scratch: Any, base: int):
    """Return the sweep without the slab whose back ends the interval, if one does."""
    if sweep.surfaces == 0 and sweep.end_boundary % 2 == 1:
        kept = int(0)
        for slot in range(sweep.active):
            position = scratch.active[base + slot]
            if position != sweep.end_boundary // 2:
                scratch.active[base + kept] = position
                kept += 1
        sweep.active = kept
    return sweep
