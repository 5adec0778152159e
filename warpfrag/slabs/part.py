"""Parts of a slab: which share of its opacity a piece of its length gains (fragment merging, eq. 1-5).

In the optical model (beta = 0, eq. 2) the front part of relative length r has the opacity 1 - T^r, a share of
(1 - T^r)/A; in the linear one (beta = 1) a share of r. For two overlapping slabs a, b with a.back <= b.back the pieces
are

    a = [a0 | a1],  b = [b0 | b1 | b2]:  a1 and b1 lie in one place, b2 behind a, and a0 or b0 is empty

and their gains are 1 - x or 1 - y - v for the first, x and y for what is mixed, v for the rest of b.
"""

from typing import Any

import warp as wp

from warpfrag.slabs.slab import LOG_OPAQUE, SERIES_OPACITY, begins_first

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def series(opacity: Any, r: Any):
    """Return (1 - (1 - A)^r)/A for small A: the binomial series, to A^6."""
    one = type(opacity)(1.0)
    total = type(opacity)(1.0)
    for i in range(6):
        k = type(opacity)(6 - i)
        total = one + (k - r) / (k + one) * opacity * total
    return r * total


@wp.func(inline=True)
def series_gradient(opacity: Any, r: Any):
    """Return the derivatives of `series` in A and in r."""
    one = type(opacity)(1.0)
    total = type(opacity)(1.0)
    by_opacity = type(opacity)(0.0)
    by_r = type(opacity)(0.0)
    for i in range(6):
        k = type(opacity)(6 - i)
        factor = (k - r) / (k + one)
        by_opacity = factor * (total + opacity * by_opacity)
        by_r = opacity * (factor * by_r - total / (k + one))
        total = one + factor * opacity * total
    return r * by_opacity, total + r * by_r


@wp.func(inline=True)
def optical_gain(opacity: Any, r0: Any, r1: Any, power0: Any, power1: Any):
    """Return (A(r1) - A(r0))/A in the optical model; power0 and power1 are T^r0 and T^r1."""
    if opacity < type(opacity)(SERIES_OPACITY):
        return series(opacity, r1) - series(opacity, r0)
    return (power0 - power1) / opacity


@wp.func(inline=True)
def optical_gain_adjoint(g: Any, opacity: Any, log_t: Any, r: Any, power: Any, floor: Any):
    """Return gradients in A, log T and r of <g, (1 - T^r)/A>, the gain up to r; power is T^r."""
    zero = type(g)(0.0)
    if opacity < type(g)(SERIES_OPACITY):
        by_opacity, by_r = series_gradient(opacity, r)
        return g * by_opacity, zero, g * by_r
    if log_t < floor and r >= type(g)(1.0):
        return zero, zero, zero
    g_power = -g / opacity
    g_exponent = g_power * power
    slope = wp.max(log_t, floor)
    if slope <= type(g)(LOG_OPAQUE):
        # Opaque from its front on, where that is does not matter.
        slope = zero
    return (
        g_power * (type(g)(1.0) - power) / opacity,
        wp.where(log_t > floor, g_exponent * r, zero),
        g_exponent * slope,
    )


@wp.func(inline=True)
def relative_lengths(a: Any, b: Any):
    """Return the lengths of the pieces relative to their slabs, a = [a0 | a1], b = [b0 | b1 | b2]; a0 = 0 or b0 = 0.

    With e = t_b - (z_b - z_a), how far a reaches into b: a0 = (t_a - e)/t_a, a1 = e/t_a, b1 = e/t_b where a begins
    first, else b0 = (e - t_a)/t_b, b1 = t_a/t_b; b2 = (z_b - z_a)/t_b.
    """
    one = type(a.back)(1.0)
    between = b.back - a.back
    into = b.thickness - between
    per_b = one / b.thickness
    a0 = type(a.back)(0.0)
    a1 = type(a.back)(1.0)
    b0 = type(a.back)(0.0)
    b1 = into * per_b
    if begins_first(a, b):
        per_a = one / a.thickness
        a0 = (a.thickness - into) * per_a
        a1 = into * per_a
    else:
        b0 = (into - a.thickness) * per_b
        b1 = a.thickness * per_b
    return a0, a1, b0, b1, between * per_b


@wp.func(inline=True)
def relative_lengths_adjoint(g_first: Any, g_a1: Any, g_b1: Any, g_b2: Any, a: Any, b: Any):
    """Return the gradients in the thicknesses of a and b and in z_b - z_a of `relative_lengths`.

    `g_first` is the gradient in the length of the piece that is in front, a0 or b0. That of each quotient goes to its
    numerator, and minus the quotient times as much to its denominator.
    """
    one = type(a.back)(1.0)
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    per_b = one / b.thickness
    g_between = g_b2 * per_b
    if begins_first(a, b):
        per_a = one / a.thickness
        # a0 = (t_a - into)/t_a, a1 = into/t_a, b1 = into/t_b
        g_into = (g_a1 - g_first) * per_a + g_b1 * per_b
        g_ta = g_first * per_a - (g_first * a0 + g_a1 * a1) * per_a
        g_tb = g_into - (g_b1 * b1 + g_b2 * b2) * per_b
        return g_ta, g_tb, g_between - g_into
    # b0 = (into - t_a)/t_b, b1 = t_a/t_b; a1 = 1
    g_into = g_first * per_b
    g_tb = g_into - (g_first * b0 + g_b1 * b1 + g_b2 * b2) * per_b
    return (g_b1 - g_first) * per_b, g_tb, g_between - g_into


@wp.func(inline=True)
def sfm_powers(a: Any, b: Any, floor: Any):
    """Return what the optical model (eq. 2) lets through up to the two cuts of overlapping slabs, a.back <= b.back.

    The front cut lies in the slab that begins first, where the other begins; the back cut in b, where a ends. Apart
    from the operators because exponentials are dear: the way back reuses them.
    """
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    # a0 or b0 is zero: one exponential serves both.
    through_front = wp.exp(a0 * wp.max(a.log_transmittance, floor) + b0 * wp.max(b.log_transmittance, floor))
    through_back = wp.exp((type(floor)(1.0) - b2) * wp.max(b.log_transmittance, floor))
    if b2 <= type(floor)(0.0) and b.log_transmittance < floor:
        through_back = b.transmittance
    return through_front, through_back


@wp.func(inline=True)
def optical_gains(a: Any, b: Any, through_front: Any, through_back: Any):
    """Return the gains x, y, v of two overlapping slabs, a.back <= b.back, for beta = 0, given their `sfm_powers`."""
    one = type(through_front)(1.0)
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    a_first = begins_first(a, b)
    return (
        optical_gain(a.opacity, a0, one, wp.where(a_first, through_front, one), a.transmittance),
        optical_gain(b.opacity, b0, one - b2, wp.where(a_first, one, through_front), through_back),
        optical_gain(b.opacity, one - b2, one, through_back, b.transmittance),
    )
