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

from warpfrag.resolve.walk import MERGE_NONE, load_slab
from warpfrag.slabs.operators import optical_gain_adjoint
from warpfrag.slabs.slab import (
    LOG_OPAQUE,
    NEGLIGIBLE,
    SERIES_OPACITY,
    Slab32,
    Slab64,
    divide,
    log_transmittance,
    series,
)

wp.set_module_options({"enable_backward": False})

BETA_ONE = wp.constant(0)
BETA_PIXEL = wp.constant(1)
BETA_FRAGMENT = wp.constant(2)


@wp.struct
class Sweep32:
    """Where a sweep is: the interval `begin` ... `end` and the numbers of the boundaries there.

    Positions `entered : following` came in with it; it is filled by the active ones, or by the `surfaces` at positions
    from `entered` on, if that is not zero. `fresh` tells that a run begins with it.
    """

    begin: wp.float32
    end: wp.float32
    begin_boundary: wp.int32
    end_boundary: wp.int32
    entered: wp.int32
    following: wp.int32
    active: wp.int32
    surfaces: wp.int32
    fresh: wp.bool


@wp.struct
class Sweep64:
    """`Sweep32` in double precision."""

    begin: wp.float64
    end: wp.float64
    begin_boundary: wp.int32
    end_boundary: wp.int32
    entered: wp.int32
    following: wp.int32
    active: wp.int32
    surfaces: wp.int32
    fresh: wp.bool


@wp.struct
class Strip32:
    """A thread's memory of one pixel; each thread has a row of `length` entries, twice that for intervals.

    By position in the order of fronts: `order`: fragment; `fragment`: it as a slab; `rest`: share of its opacity behind
    the begin of the present interval. The way back alone needs the others: `r`, `power`: relative length and T^r up to
    there; `next_...`: the same of the interval's end; `share`, `pass_`, `weight`: a part's `part_share`, mix weight;
    `prefix`, `veil`: transmittance and opacity of the interval's members before it; `cut`: gradient of `rest`; `grad`,
    `grad_beta`: its own; `others`: transmittance of the fragments of its layer before it; `run`: its layer.
    `active`: positions of the active fragments. By interval: `through`, `tau`: transmittance before it and of it;
    `behind`: product of its colour, later of the colour behind it, and the cotangent; `layer`: its layer.
    """

    length: wp.int32
    order: wp.array[wp.int32]
    active: wp.array[wp.int32]
    fragment: wp.array[Slab32]
    rest: wp.array[wp.float32]
    r: wp.array[wp.float32]
    power: wp.array[wp.float32]
    next_rest: wp.array[wp.float32]
    next_r: wp.array[wp.float32]
    next_power: wp.array[wp.float32]
    share: wp.array[wp.float32]
    pass_: wp.array[wp.float32]
    weight: wp.array[wp.float32]
    prefix: wp.array[wp.float32]
    veil: wp.array[wp.float32]
    cut: wp.array[wp.float32]
    grad: wp.array[Slab32]
    grad_beta: wp.array[wp.float32]
    others: wp.array[wp.float32]
    run: wp.array[wp.int32]
    through: wp.array[wp.float32]
    tau: wp.array[wp.float32]
    behind: wp.array[wp.float32]
    layer: wp.array[wp.int32]


@wp.struct
class Strip64:
    """`Strip32` in double precision."""

    length: wp.int32
    order: wp.array[wp.int32]
    active: wp.array[wp.int32]
    fragment: wp.array[Slab64]
    rest: wp.array[wp.float64]
    r: wp.array[wp.float64]
    power: wp.array[wp.float64]
    next_rest: wp.array[wp.float64]
    next_r: wp.array[wp.float64]
    next_power: wp.array[wp.float64]
    share: wp.array[wp.float64]
    pass_: wp.array[wp.float64]
    weight: wp.array[wp.float64]
    prefix: wp.array[wp.float64]
    veil: wp.array[wp.float64]
    cut: wp.array[wp.float64]
    grad: wp.array[Slab64]
    grad_beta: wp.array[wp.float64]
    others: wp.array[wp.float64]
    run: wp.array[wp.int32]
    through: wp.array[wp.float64]
    tau: wp.array[wp.float64]
    behind: wp.array[wp.float64]
    layer: wp.array[wp.int32]


@wp.func(inline=True)
def front_of(pixels: Any, fragment: int):
    """Return the front boundary; that of a slab too thin to be divided is its back."""
    z = pixels.depth[fragment]
    front = z - pixels.thickness[fragment]
    if z - front > type(z)(NEGLIGIBLE):
        return front
    return z


@wp.func(inline=True)
def enters_before(pixels: Any, i: int, j: int):
    """Tell whether fragment i comes before j: by front, then depth (surfaces before slabs), then submission."""
    front_i = front_of(pixels, i)
    front_j = front_of(pixels, j)
    if front_i != front_j:
        return front_i < front_j
    z_i = pixels.depth[i]
    z_j = pixels.depth[j]
    if z_i != z_j:
        return z_i < z_j
    return i < j


@wp.func(inline=True)
def load_strip(pixels: Any, begin: int, count: int, strip: Any, base: int):
    """Sort the fragments of a pixel by their fronts (Shell's sort, gaps 1, 4, 13, ...) and load them as slabs."""
    for position in range(count):
        strip.order[base + position] = begin + position
    gap = int(1)
    while 9 * gap < count:
        gap = 3 * gap + 1
    while gap > 0:
        for position in range(gap, count):
            fragment = strip.order[base + position]
            j = int(position)
            while j >= gap and enters_before(pixels, fragment, strip.order[base + j - gap]):
                strip.order[base + j] = strip.order[base + j - gap]
                j -= gap
            strip.order[base + j] = fragment
        gap = gap // 3
    for position in range(count):
        fragment = strip.order[base + position]
        s = load_slab(pixels, fragment, MERGE_NONE)
        s.f = front_of(pixels, fragment)
        if s.f < s.z:
            s.l = log_transmittance(s.a)
        strip.fragment[base + position] = s
        strip.rest[base + position] = type(s.a)(1.0)


@wp.func(inline=True)
def fragment_beta(pixels: Any, pixel: int, fragment: int, beta_per: int):
    """Return the beta of a fragment."""
    index = int(0)
    if beta_per == BETA_PIXEL:
        index = pixel
    if beta_per == BETA_FRAGMENT:
        index = fragment
    return pixels.beta[index]


@wp.func(inline=True)
def in_progress(sweep: Any, count: int):
    """Tell whether intervals are left."""
    return sweep.active > 0 or sweep.following < count


@wp.func(inline=True)
def advance(sweep: Any, strip: Any, base: int, count: int):
    """Return the sweep at the next interval; call `leave` before the one after."""
    sweep.fresh = sweep.active == 0
    sweep.begin = sweep.end
    sweep.begin_boundary = sweep.end_boundary
    sweep.entered = sweep.following
    if sweep.fresh:
        sweep.begin = strip.fragment[base + sweep.following].f
        sweep.begin_boundary = 2 * sweep.following
    # Among equal fronts surfaces come first: only theirs is their back too.
    at = int(sweep.following)
    while at < count and strip.fragment[base + at].z == sweep.begin:
        at += 1
    sweep.surfaces = at - sweep.following
    if sweep.surfaces > 0:
        sweep.end = sweep.begin
        sweep.end_boundary = 2 * sweep.entered + 1
        sweep.following = at
        return sweep
    while at < count and strip.fragment[base + at].f == sweep.begin:
        strip.active[base + sweep.active] = at
        sweep.active += 1
        at += 1
    sweep.following = at
    sweep.end_boundary = -1
    if at < count:
        sweep.end = strip.fragment[base + at].f
        sweep.end_boundary = 2 * at
    for slot in range(sweep.active):
        position = strip.active[base + slot]
        z = strip.fragment[base + position].z
        if sweep.end_boundary < 0 or z < sweep.end:
            sweep.end = z
            sweep.end_boundary = 2 * position + 1
    return sweep


@wp.func(inline=True)
def leave(sweep: Any, strip: Any, base: int):
    """Return the sweep without the active slabs that end where the interval ends."""
    kept = int(0)
    for slot in range(sweep.active):
        position = strip.active[base + slot]
        if strip.fragment[base + position].z > sweep.end:
            strip.active[base + kept] = position
            kept += 1
    sweep.active = kept
    return sweep


@wp.func(inline=True)
def optical_rest(s: Any, r: Any, power: Any):
    """Return the share of a slab's opacity behind the relative length r in the optical model (eq. 2)."""
    if s.a < type(r)(SERIES_OPACITY):
        return type(r)(1.0) - series(s.a, r)
    return (power - s.t) / s.a


@wp.func(inline=True)
def cut_slab(s: Any, depth: Any, beta: Any, floor: Any):
    """Return where a depth cuts a slab: relative length r, T^r, and the share of its opacity behind (eq. 4)."""
    one = type(depth)(1.0)
    zero = type(depth)(0.0)
    if depth >= s.z:
        return one, s.t, zero
    r = (depth - s.f) / (s.z - s.f)
    exponent = wp.max(s.l, floor)
    power = zero
    if exponent > type(depth)(LOG_OPAQUE):
        power = wp.exp(r * exponent)
    return r, power, beta * (one - r) + (one - beta) * optical_rest(s, r, power)


@wp.func(inline=True)
def cut_slab_adjoint(g: Any, s: Any, r: Any, power: Any, beta: Any, floor: Any):
    """Return the gradients in A, log T, f, z, the depth and beta of <g, share behind the cut>; 0 < r < 1."""
    one = type(g)(1.0)
    a, l, g_r = optical_gain_adjoint(-(one - beta) * g, s.a, s.l, r, power, floor)  # noqa: E741
    g_depth = (g_r - beta * g) / (s.z - s.f)
    g_beta = g * (one - r - optical_rest(s, r, power))
    return a, l, g_depth * (r - one), -g_depth * r, g_depth, g_beta


@wp.func(inline=True)
def part_share(s: Any, rest: Any, next_rest: Any):
    """Return which share of its slab's opacity a part has, and the part's transmittance.

    With D = T + A rest the light up to the part, the share is (rest - next_rest) / D and the part passes D' / D. Behind
    an opaque part nothing is left: it has no share and no effect.
    """
    one = type(rest)(1.0)
    zero = type(rest)(0.0)
    before = light_to(s, rest)
    return divide(rest - next_rest, before, zero), divide(light_to(s, next_rest), before, one)


@wp.func(inline=True)
def light_to(s: Any, rest: Any):
    """Return the transmittance of a slab up to where the given share of its opacity lies behind."""
    if rest < type(rest)(1.0):
        return s.t + s.a * rest
    return type(rest)(1.0)
