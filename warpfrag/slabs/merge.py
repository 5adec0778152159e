"""Merging two slabs: smooth (SFM) and order-independent (OFM), and the adjoints (fragment merging, section 3.2).

A merge takes the gains x, y, v: which share of its opacity a slab gains in one piece of its length (see `part`). For
overlapping slabs a, b with a.back <= b.back the pieces are: the front part of one alone, gaining 1 - x or 1 - y - v;
the rest of a (x) mixed with as much of b (y); the rest of b (v). Order-independent merging is x = y = 1, v = 0. A
piece's part of the slab has opacity gain / D, with the D of `mix`, and over multiplies by D again: the merged colour is
(1 - x + mixed_a) C_a + (1 - y - v + mixed_b + T_a v) C_b, a sum of positive terms in which no D divides.

An adjoint `..._adjoint(g, ...)` returns the vector-Jacobian product of its operator with the cotangent g.
"""

from typing import Any

import warp as wp

from warpfrag.slabs.mix import (
    MIX_AVERAGE,
    MIX_OPTICAL_DEPTH,
    average_adjoint,
    light_to_parts,
    mixed_shares,
    weighted_adjoint,
)
from warpfrag.slabs.part import optical_gain_adjoint, optical_gains, relative_lengths, relative_lengths_adjoint
from warpfrag.slabs.slab import NEGLIGIBLE, WEIGHT_LIMIT, begins_first, divide

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def merge(a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return the slab that a and b become, given their gains (mix: eq. 6-8, zSlab eq. 4.1-4.4)."""
    one = type(x)(1.0)
    zero = type(x)(0.0)
    d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
    mixed_a, mixed_b = mixed_shares(a, b, x, y, v, mix)
    share_a = one - x + mixed_a
    share_b = one - y - v + mixed_b + a.transmittance * v
    sum_a = one - x + divide(x, d_a, zero)
    sum_b = one - y - v + divide(y, d_1, zero) + divide(v, d_2, zero)
    opacity = a.opacity + a.transmittance * b.opacity
    weight = divide(a.opacity * a.weight * sum_a + b.opacity * b.weight * sum_b, opacity, one)
    return type(a)(
        share_a * a.color + share_b * b.color,
        opacity,
        a.transmittance * b.transmittance,
        merged_log(a, b, x, y, v, mix),
        wp.min(weight, type(x)(WEIGHT_LIMIT)),
        wp.max(a.thickness + (b.back - a.back), b.thickness),
        b.back,
    )


@wp.func(inline=True)
def merged_log(a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return the logarithm of the transmittance; where that is none it counts those that are seen, `opaque_count`."""
    log_t = a.log_transmittance + b.log_transmittance
    if mix == MIX_OPTICAL_DEPTH:
        d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
        a_alone = d_a <= type(x)(NEGLIGIBLE)
        b_alone = d_1 <= type(x)(NEGLIGIBLE)
        mixed_opaque_a = a.transmittance <= d_a * type(x)(NEGLIGIBLE)
        mixed_opaque_b = d_2 <= d_1 * type(x)(NEGLIGIBLE)
        if a_alone or (mixed_opaque_a and not mixed_opaque_b):
            log_t = a.log_transmittance
        elif b_alone or (mixed_opaque_b and not mixed_opaque_a):
            log_t = b.log_transmittance
    return log_t


@wp.func(inline=True)
def merge_adjoint(g: Any, a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return gradients in a, b, x, y and v. Every local g_n is the gradient in the n of `merge`."""
    one = type(x)(1.0)
    zero = type(x)(0.0)
    d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
    # The colour: share_a = 1 - x + mixed_a,  share_b = 1 - y - v + mixed_b + T_a v.
    g_share_a = wp.dot(g.color, a.color)
    g_share_b = wp.dot(g.color, b.color)
    g_v = g_share_b * (a.transmittance - one)
    g_at = g_share_b * v
    g_aw = zero
    g_bw = zero
    g_d2 = zero
    if mix == MIX_AVERAGE:
        g_mx, g_my, g_xa, g_yb, g_da, g_d1 = average_adjoint(g_share_a, g_share_b, a, b, x, y, v)
    else:
        g_mx, g_my, g_xa, g_yb, g_da, g_d1, g_d2, g_at, g_aw, g_bw = weighted_adjoint(
            g_share_a, g_share_b, a, b, x, y, v, mix, g_at
        )
    g_x = g_mx - g_share_a
    g_y = g_my - g_share_b
    # The weight: (A_a w_a sum_a + A_b w_b sum_b) / opacity,  sum_a = 1 - x + p,  sum_b = 1 - y - v + q + r.
    p = divide(x, d_a, zero)
    q = divide(y, d_1, zero)
    r = divide(v, d_2, zero)
    sum_a = one - x + p
    sum_b = one - y - v + q + r
    opacity = a.opacity + a.transmittance * b.opacity
    weight = divide(a.opacity * a.weight * sum_a + b.opacity * b.weight * sum_b, opacity, one)
    g_sum = zero
    if weight < type(x)(WEIGHT_LIMIT):
        g_sum = divide(g.weight, opacity, zero)
    g_opacity = g.opacity - g_sum * weight
    g_p = divide(g_sum * a.opacity * a.weight, d_a, zero)
    g_q = divide(g_sum * b.opacity * b.weight, d_1, zero)
    g_r = divide(g_sum * b.opacity * b.weight, d_2, zero)
    g_x += g_p - g_sum * a.opacity * a.weight
    g_y += g_q - g_sum * b.opacity * b.weight
    g_v += g_r - g_sum * b.opacity * b.weight
    g_da -= g_p * p
    g_d1 -= g_q * q
    # D_a = T_a + x_a,  D_1 = D_2 + y_b,  D_2 = T_b + A_b v,  x_a = A_a x,  y_b = A_b y.
    g_d2 += g_d1 - g_r * r
    g_yb += g_d1
    g_xa += g_da
    g_x += g_xa * a.opacity
    g_y += g_yb * b.opacity
    g_v += g_d2 * b.opacity
    g_aa = g_opacity + g_sum * a.weight * sum_a + g_xa * x
    g_ba = g_opacity * a.transmittance + g_sum * b.weight * sum_b + g_yb * y + g_d2 * v
    g_at += g_opacity * b.opacity + g.transmittance * b.transmittance + g_da
    g_bt = g.transmittance * a.transmittance + g_d2
    g_aw += g_sum * a.opacity * sum_a
    g_bw += g_sum * b.opacity * sum_b
    mixed_a, mixed_b = mixed_shares(a, b, x, y, v, mix)
    share_a = one - x + mixed_a
    share_b = one - y - v + mixed_b + a.transmittance * v
    # t = max(t_a + z_b - z_a, t_b),  z = z_b.
    log_t = g.log_transmittance
    g_ta = wp.where(begins_first(a, b), g.thickness, zero)
    g_a = type(a)(share_a * g.color, g_aa, g_at, log_t, g_aw, g_ta, -g_ta)
    g_b = type(a)(share_b * g.color, g_ba, g_bt, log_t, g_bw, g.thickness - g_ta, g.back + g_ta)
    return g_a, g_b, g_x, g_y, g_v


@wp.func(inline=True)
def ofm(a: Any, b: Any, mix: int):
    """Return the order-independent merging of two slabs (section 3.2.2): they are mixed whole."""
    one = type(a.opacity)(1.0)
    return merge(a, b, one, one, type(a.opacity)(0.0), mix)


@wp.func(inline=True)
def ofm_adjoint(g: Any, a: Any, b: Any, mix: int):
    """Return the gradients in a and b of <g, ofm(a, b)>."""
    one = type(a.opacity)(1.0)
    g_a, g_b, g_x, g_y, g_v = merge_adjoint(g, a, b, one, one, type(a.opacity)(0.0), mix)
    return g_a, g_b


@wp.func(inline=True)
def sfm(a: Any, b: Any, beta: Any, mix: int, through_front: Any, through_back: Any):
    """Return the smooth merging of two overlapping slabs, a.back <= b.back (eq. 4-5), given their `sfm_powers`."""
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    x, y, v = optical_gains(a, b, through_front, through_back)
    optical = type(beta)(1.0) - beta
    return merge(a, b, beta * a1 + optical * x, beta * b1 + optical * y, beta * b2 + optical * v, mix)


@wp.func(inline=True)
def sfm_adjoint(g: Any, a: Any, b: Any, beta: Any, mix: int, floor: Any, through_front: Any, through_back: Any):
    """Return the gradients in a, b and beta of `sfm`, in which the powers are no constants."""
    one = type(beta)(1.0)
    zero = type(beta)(0.0)
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    x, y, v = optical_gains(a, b, through_front, through_back)
    optical = one - beta
    g_a, g_b, g_x, g_y, g_v = merge_adjoint(
        g, a, b, beta * a1 + optical * x, beta * b1 + optical * y, beta * b2 + optical * v, mix
    )
    g_beta = g_x * (a1 - x) + g_y * (b1 - y) + g_v * (b2 - v)
    # The gains are differences of the gain up to a cut, which is constant at the ends of a slab.
    a_first = begins_first(a, b)
    g_front = -optical * wp.where(a_first, g_x, g_y)
    g_back = optical * (g_y - g_v)
    first_opacity = wp.where(a_first, a.opacity, b.opacity)
    first_log_t = wp.where(a_first, a.log_transmittance, b.log_transmittance)
    front_opacity, front_log_t, g_r0 = optical_gain_adjoint(
        g_front, first_opacity, first_log_t, a0 + b0, through_front, floor
    )
    back_opacity, back_log_t, g_r1 = optical_gain_adjoint(
        g_back, b.opacity, b.log_transmittance, one - b2, through_back, floor
    )
    g_ta, g_tb, g_between = relative_lengths_adjoint(g_r0, beta * g_x, beta * g_y, beta * g_v - g_r1, a, b)
    more_a = type(a)(
        g_a.color,
        g_a.opacity + wp.where(a_first, front_opacity, zero),
        g_a.transmittance,
        g_a.log_transmittance + wp.where(a_first, front_log_t, zero),
        g_a.weight,
        g_a.thickness + g_ta,
        g_a.back - g_between,
    )
    more_b = type(a)(
        g_b.color,
        g_b.opacity + wp.where(a_first, zero, front_opacity) + back_opacity,
        g_b.transmittance,
        g_b.log_transmittance + wp.where(a_first, zero, front_log_t) + back_log_t,
        g_b.weight,
        g_b.thickness + g_tb,
        g_b.back + g_between,
    )
    return more_a, more_b, g_beta
