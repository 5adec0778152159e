"""What a cut in a slab leaves of it: the shares of opacity, and their adjoint (fragment merging, eq. 2-4)."""

from typing import Any

import warp as wp

from warpfrag.slabs.part import optical_gain_adjoint, series
from warpfrag.slabs.slab import LOG_OPAQUE, SERIES_OPACITY, divide, finite

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def optical_rest(s: Any, r: Any, power: Any):
    """Return the share of a slab's opacity behind the relative length r in the optical model (eq. 2)."""
    if s.opacity < type(r)(SERIES_OPACITY):
        return type(r)(1.0) - series(s.opacity, r)
    return (power - s.transmittance) / s.opacity


@wp.func(inline=True)
def cut_slab(s: Any, depth: Any, beta: Any, floor: Any):
    """Return where a depth cuts a slab: relative length r, T^r, and the share of its opacity behind (eq. 4)."""
    one = type(depth)(1.0)
    zero = type(depth)(0.0)
    if depth >= s.back:
        return one, s.transmittance, zero
    r = (depth - s.back + s.thickness) / s.thickness
    if r <= zero:
        return zero, one, one
    exponent = wp.max(s.log_transmittance, floor)
    power = zero
    if exponent > type(depth)(LOG_OPAQUE):
        power = wp.exp(r * exponent)
    return r, power, beta * (one - r) + (one - beta) * optical_rest(s, r, power)


@wp.func(inline=True)
def cut_slab_adjoint(g: Any, s: Any, r: Any, power: Any, beta: Any, floor: Any):
    """Return the gradients in A, log T, t, z, the depth and beta of <g, share behind the cut>.

    r = (depth - z + t)/t: its derivative is 1/t in the depth, -1/t in z and (1 - r)/t in t.
    """
    one = type(g)(1.0)
    g_opacity, g_log_t, g_r = optical_gain_adjoint(-(one - beta) * g, s.opacity, s.log_transmittance, r, power, floor)
    g_depth = finite((g_r - beta * g) / s.thickness)
    g_beta = g * (one - r - optical_rest(s, r, power))
    return g_opacity, g_log_t, g_depth * (one - r), -g_depth, g_depth, g_beta


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
        return s.transmittance + s.opacity * rest
    return type(rest)(1.0)
