"""The formulas: how two slabs become one, and the adjoints of that.

Merging two slabs takes the gains x, y, v: which share of its opacity a slab gains in one piece of its length (eq. 4).
For overlapping slabs a, b with a.z <= b.z the pieces are: the front part of one alone, gaining 1 - x or 1 - y - v; the
rest of a (x) mixed with as much of b (y); the rest of b (v). Order-independent merging is x = y = 1, v = 0. With

    D_a = T_a + A_a x,   D_2 = T_b + A_b v,   D_1 = D_2 + A_b y       (transmittance up to the rest of a, b, the mix)

a piece's part of the slab has opacity gain / D, and over multiplies by D again: the merged colour is
(1 - x + mixed_a) C_a + (1 - y - v + mixed_b + T_a v) C_b, a sum of positive terms in which no D divides.

An adjoint `..._adjoint(g, ...)` returns the vector-Jacobian product of its operator with the cotangent g. It treats a,
t and l as independent: their sum is the derivative in opacity. All functions are generic over `Slab32` and `Slab64`.
Equation numbers are those of the fragment-merging paper.
"""

from typing import Any

import warp as wp

from warpfrag.slabs.slab import (
    LOG_OPAQUE,
    NEGLIGIBLE,
    SERIES_OPACITY,
    WEIGHT_LIMIT,
    depth_per_opacity,
    depth_per_opacity_gradient,
    divide,
    series,
    series_gradient,
    slab,
)

wp.set_module_options({"enable_backward": False})

MIX_OPACITY = wp.constant(0)
MIX_AVERAGE = wp.constant(1)
MIX_OPTICAL_DEPTH = wp.constant(2)


@wp.func(inline=True)
def over(a: Any, b: Any):
    """Return slab a over slab b; the slab reaches from a's front to b's back (Algorithm 1, tail handling)."""
    opacity = a.a + a.t * b.a
    weight = divide(a.a * a.w + b.a * b.w, opacity, type(opacity)(1.0))
    return slab(a.c + a.t * b.c, opacity, a.t * b.t, a.l + b.l, weight, a.f, b.z)


@wp.func(inline=True)
def over_adjoint(g: Any, a: Any, b: Any):
    """Return the gradients in a and b of <g, over(a, b)>."""
    opacity = a.a + a.t * b.a
    weight = divide(a.a * a.w + b.a * b.w, opacity, type(opacity)(1.0))
    g_sum = divide(g.w, opacity, type(opacity)(0.0))
    g_opacity = g.a - g_sum * weight
    g_t = wp.dot(g.c, b.c) + g_opacity * b.a + g.t * b.t
    g_a = slab(g.c, g_opacity + g_sum * a.w, g_t, g.l, g_sum * a.a, g.f, type(opacity)(0.0))
    g_b = slab(a.t * g.c, g_opacity * a.t + g_sum * b.w, g.t * a.t, g.l, g_sum * b.a, type(opacity)(0.0), g.z)
    return g_a, g_b


@wp.func(inline=True)
def per_length(s: Any):
    """Return 1 / thickness."""
    return type(s.z)(1.0) / (s.z - s.f)


@wp.func(inline=True)
def relative_lengths(a: Any, b: Any):
    """Return the lengths of the pieces relative to their slabs, a = [a0 | a1], b = [b0 | b1 | b2]; a0 = 0 or b0 = 0."""
    inner = wp.max(a.f, b.f)
    per_b = per_length(b)
    a0 = type(inner)(0.0)
    a1 = type(inner)(1.0)
    if a.f < b.f:
        per_a = per_length(a)
        a0 = (inner - a.f) * per_a
        a1 = (a.z - inner) * per_a
    return a0, a1, (inner - b.f) * per_b, (a.z - inner) * per_b, (b.z - a.z) * per_b


@wp.func(inline=True)
def sfm_powers(a: Any, b: Any, floor: Any):
    """Return what the optical model (eq. 2) lets through up to the two cuts of overlapping slabs, a.z <= b.z.

    The front cut lies in the slab that begins first, where the other begins; the back cut in b, where a ends. Apart
    from the operators because exponentials are dear: the way back reuses them.
    """
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    # a0 or b0 is zero: one exponential serves both.
    front = wp.exp(a0 * wp.max(a.l, floor) + b0 * wp.max(b.l, floor))
    back = wp.exp((type(floor)(1.0) - b2) * wp.max(b.l, floor))
    if b2 <= type(floor)(0.0) and b.l < floor:
        back = b.t
    return front, back


@wp.func(inline=True)
def optical_gain(a: Any, r0: Any, r1: Any, power0: Any, power1: Any):
    """Return (A(r1) - A(r0))/A in the optical model; power0 and power1 are T^r0 and T^r1."""
    if a < type(a)(SERIES_OPACITY):
        return series(a, r1) - series(a, r0)
    return (power0 - power1) / a


@wp.func(inline=True)
def optical_gain_adjoint(g: Any, a: Any, l: Any, r: Any, power: Any, floor: Any):  # noqa: E741
    """Return gradients in A, log T and r of <g, (1 - T^r)/A>, the gain up to r; power is T^r."""
    zero = type(g)(0.0)
    if a < type(g)(SERIES_OPACITY):
        by_a, by_r = series_gradient(a, r)
        return g * by_a, zero, g * by_r
    if l < floor and r >= type(g)(1.0):
        return zero, zero, zero
    g_power = -g / a
    g_exponent = g_power * power
    slope = wp.max(l, floor)
    if slope <= type(g)(LOG_OPAQUE):
        # Opaque from its front on, where that is does not matter.
        slope = zero
    return (
        g_power * (type(g)(1.0) - power) / a,
        wp.where(l > floor, g_exponent * r, zero),
        g_exponent * slope,
    )


@wp.func(inline=True)
def optical_gains(a: Any, b: Any, front: Any, back: Any):
    """Return the gains x, y, v of two overlapping slabs, a.z <= b.z, for beta = 0; front, back are `sfm_powers`."""
    one = type(front)(1.0)
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    a_first = a.f < b.f
    return (
        optical_gain(a.a, a0, one, wp.where(a_first, front, one), a.t),
        optical_gain(b.a, b0, one - b2, wp.where(a_first, one, front), back),
        optical_gain(b.a, one - b2, one, back, b.t),
    )


@wp.func(inline=True)
def mix_weights(a: Any, b: Any, x: Any, y: Any, d_a: Any, d_1: Any, d_2: Any, mix: int):
    """Return the weights of the two colours of a mix, and whether opaque parts fixed them (then they add up to 1)."""
    zero = type(x)(0.0)
    one = type(x)(1.0)
    half = type(x)(0.5)
    if mix == MIX_OPTICAL_DEPTH:
        t_a = divide(a.t, d_a, zero)
        t_b = divide(d_2, d_1, zero)
        # Opaque parts win; two of them are averaged.
        opaque_a = t_a <= type(x)(NEGLIGIBLE)
        opaque_b = t_b <= type(x)(NEGLIGIBLE)
        if opaque_a and opaque_b:
            return half, half, True
        if opaque_a:
            return one, zero, True
        if opaque_b:
            return zero, one, True
        return depth_per_opacity(a.a * x / d_a, t_a), depth_per_opacity(b.a * y / d_1, t_b), False
    return a.w, b.w, False


@wp.func(inline=True)
def merge(a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return the slab that a and b become, given their gains (section 3.2; mix: eq. 6-8, zSlab eq. 4.1-4.4)."""
    one = type(x)(1.0)
    zero = type(x)(0.0)
    d_a = a.t + a.a * x
    d_2 = b.t + b.a * v
    d_1 = d_2 + b.a * y
    x_a = a.a * x
    y_b = b.a * y
    if mix == MIX_AVERAGE:
        mixed_a = x * (d_1 - type(x)(0.5) * y_b)
        mixed_b = y * (d_a - type(x)(0.5) * x_a)
    else:
        v_a, v_b, opaque = mix_weights(a, b, x, y, d_a, d_1, d_2, mix)
        total = d_1 * x_a * v_a + d_a * y_b * v_b
        scale = one
        if total > type(x)(NEGLIGIBLE) and not opaque:
            scale = (d_1 * x_a + a.t * y_b) / total
        mixed_a = d_1 * x * v_a * scale
        mixed_b = d_a * y * v_b * scale
    share_a = one - x + mixed_a
    share_b = one - y - v + mixed_b + a.t * v
    sum_a = one - x + divide(x, d_a, zero)
    sum_b = one - y - v + divide(y, d_1, zero) + divide(v, d_2, zero)
    opacity = a.a + a.t * b.a
    weight = wp.min(divide(a.a * a.w * sum_a + b.a * b.w * sum_b, opacity, one), type(x)(WEIGHT_LIMIT))
    c = share_a * a.c + share_b * b.c
    return slab(c, opacity, a.t * b.t, a.l + b.l, weight, wp.min(a.f, b.f), wp.max(a.z, b.z))


@wp.func(inline=True)
def merge_adjoint(g: Any, a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return gradients in a, b, x, y and v. Every local g_n is the gradient in the n of `merge`."""
    one = type(x)(1.0)
    zero = type(x)(0.0)
    half = type(x)(0.5)
    d_a = a.t + a.a * x
    d_2 = b.t + b.a * v
    d_1 = d_2 + b.a * y
    x_a = a.a * x
    y_b = b.a * y
    # share_a = 1 - x + mixed_a,  share_b = 1 - y - v + mixed_b + T_a v
    g_share_a = wp.dot(g.c, a.c)
    g_share_b = wp.dot(g.c, b.c)
    g_x = -g_share_a
    g_y = -g_share_b
    g_v = g_share_b * (a.t - one)
    g_at = g_share_b * v
    g_aw = zero
    g_bw = zero
    g_d2 = zero
    if mix == MIX_AVERAGE:
        mixed_a = x * (d_1 - half * y_b)
        mixed_b = y * (d_a - half * x_a)
        g_x += g_share_a * (d_1 - half * y_b)
        g_y += g_share_b * (d_a - half * x_a)
        g_d1 = g_share_a * x
        g_da = g_share_b * y
        g_yb = -half * g_d1
        g_xa = -half * g_da
    else:
        v_a, v_b, opaque = mix_weights(a, b, x, y, d_a, d_1, d_2, mix)
        total = d_1 * x_a * v_a + d_a * y_b * v_b
        scale = one
        g_part = zero
        g_total = zero
        g_limit = zero
        if total > type(x)(NEGLIGIBLE) and not opaque:
            scale = (d_1 * x_a + a.t * y_b) / total
            g_part = (g_share_a * d_1 * x * v_a + g_share_b * d_a * y * v_b) / total
            g_total = -g_part * scale
        elif mix == MIX_OPTICAL_DEPTH and not opaque:
            # Here the scale is A/u, which tends to 1 as 1 - (A_a + A_b)/2 of the parts x_a/d_a and y_b/d_1.
            g_limit = -half * (g_share_a * d_1 * x * v_a + g_share_b * d_a * y * v_b)
        mixed_a = d_1 * x * v_a * scale
        mixed_b = d_a * y * v_b * scale
        g_x += g_share_a * d_1 * v_a * scale
        g_y += g_share_b * d_a * v_b * scale
        g_d1 = g_share_a * x * v_a * scale + (g_part + g_total * v_a) * x_a
        g_da = g_share_b * y * v_b * scale + g_total * v_b * y_b
        g_xa = (g_part + g_total * v_a) * d_1 + divide(g_limit, d_a, zero)
        g_yb = g_part * a.t + g_total * v_b * d_a + divide(g_limit, d_1, zero)
        g_at += g_part * y_b
        g_va = g_share_a * d_1 * x * scale + g_total * d_1 * x_a
        g_vb = g_share_b * d_a * y * scale + g_total * d_a * y_b
        if mix == MIX_OPACITY:
            g_aw = g_va
            g_bw = g_vb
        elif not opaque:
            part_a, part_ta = depth_per_opacity_gradient(x_a / d_a, a.t / d_a)
            part_b, part_tb = depth_per_opacity_gradient(y_b / d_1, d_2 / d_1)
            # Not over the square of d, which may underflow.
            per_da = g_va / d_a
            per_d1 = g_vb / d_1
            g_xa += per_da * part_a
            g_at += per_da * part_ta
            g_da -= per_da * (part_a * (x_a / d_a) + part_ta * (a.t / d_a))
            g_yb += per_d1 * part_b
            g_d1 -= per_d1 * (part_b * (y_b / d_1) + part_tb * (d_2 / d_1))
            g_d2 = per_d1 * part_tb
    # weight = (A_a w_a sum_a + A_b w_b sum_b) / opacity
    p = divide(x, d_a, zero)
    q = divide(y, d_1, zero)
    r = divide(v, d_2, zero)
    sum_a = one - x + p
    sum_b = one - y - v + q + r
    opacity = a.a + a.t * b.a
    weight = divide(a.a * a.w * sum_a + b.a * b.w * sum_b, opacity, one)
    g_sum = zero
    if weight < type(x)(WEIGHT_LIMIT):
        g_sum = divide(g.w, opacity, zero)
    g_opacity = g.a - g_sum * weight
    g_p = divide(g_sum * a.a * a.w, d_a, zero)
    g_q = divide(g_sum * b.a * b.w, d_1, zero)
    g_r = divide(g_sum * b.a * b.w, d_2, zero)
    g_x += g_p - g_sum * a.a * a.w
    g_y += g_q - g_sum * b.a * b.w
    g_v += g_r - g_sum * b.a * b.w
    g_da -= g_p * p
    g_d1 -= g_q * q
    g_d2 += g_d1 - g_r * r
    g_yb += g_d1
    g_xa += g_da
    g_x += g_xa * a.a
    g_y += g_yb * b.a
    g_v += g_d2 * b.a
    g_aa = g_opacity + g_sum * a.w * sum_a + g_xa * x
    g_ba = g_opacity * a.t + g_sum * b.w * sum_b + g_yb * y + g_d2 * v
    g_at += g_opacity * b.a + g.t * b.t + g_da
    g_bt = g.t * a.t + g_d2
    g_aw += g_sum * a.a * sum_a
    g_bw += g_sum * b.a * sum_b
    share_a = one - x + mixed_a
    share_b = one - y - v + mixed_b + a.t * v
    g_a = slab(share_a * g.c, g_aa, g_at, g.l, g_aw, wp.where(a.f <= b.f, g.f, zero), wp.where(a.z > b.z, g.z, zero))
    g_b = slab(share_b * g.c, g_ba, g_bt, g.l, g_bw, wp.where(a.f <= b.f, zero, g.f), wp.where(a.z > b.z, zero, g.z))
    return g_a, g_b, g_x, g_y, g_v


@wp.func(inline=True)
def ofm(a: Any, b: Any, mix: int):
    """Return the order-independent merging of two slabs (section 3.2.2): they are mixed whole."""
    return merge(a, b, type(a.a)(1.0), type(a.a)(1.0), type(a.a)(0.0), mix)


@wp.func(inline=True)
def ofm_adjoint(g: Any, a: Any, b: Any, mix: int):
    """Return the gradients in a and b of <g, ofm(a, b)>."""
    g_a, g_b, g_x, g_y, g_v = merge_adjoint(g, a, b, type(a.a)(1.0), type(a.a)(1.0), type(a.a)(0.0), mix)
    return g_a, g_b


@wp.func(inline=True)
def sfm(a: Any, b: Any, beta: Any, mix: int, front: Any, back: Any):
    """Return the smooth merging of two overlapping slabs, a.z <= b.z (section 3.2.1, eq. 4-5), given `sfm_powers`."""
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    x, y, v = optical_gains(a, b, front, back)
    optical = type(beta)(1.0) - beta
    return merge(a, b, beta * a1 + optical * x, beta * b1 + optical * y, beta * b2 + optical * v, mix)


@wp.func(inline=True)
def sfm_adjoint(g: Any, a: Any, b: Any, beta: Any, mix: int, floor: Any, front: Any, back: Any):
    """Return the gradients in a, b and beta of `sfm`, in which the powers are no constants."""
    one = type(beta)(1.0)
    zero = type(beta)(0.0)
    a0, a1, b0, b1, b2 = relative_lengths(a, b)
    x, y, v = optical_gains(a, b, front, back)
    optical = one - beta
    g_a, g_b, g_x, g_y, g_v = merge_adjoint(
        g, a, b, beta * a1 + optical * x, beta * b1 + optical * y, beta * b2 + optical * v, mix
    )
    g_beta = g_x * (a1 - x) + g_y * (b1 - y) + g_v * (b2 - v)
    # The gains are differences of the gain up to a cut, which is constant at the ends of a slab.
    a_first = a.f < b.f
    g_front = -optical * wp.where(a_first, g_x, g_y)
    g_back = optical * (g_y - g_v)
    front_a, front_l, g_r0 = optical_gain_adjoint(
        g_front, wp.where(a_first, a.a, b.a), wp.where(a_first, a.l, b.l), a0 + b0, front, floor
    )
    back_a, back_l, g_r1 = optical_gain_adjoint(g_back, b.a, b.l, one - b2, back, floor)
    # Lengths: a0 and b0 reach from the first front to the inner one, a1 and b1 from there to a.z, b2 from a.z to b.z.
    per_a = wp.where(a_first, per_length(a), zero)
    per_b = per_length(b)
    g_a1 = beta * g_x
    g_b1 = beta * g_y
    g_b2 = beta * g_v - g_r1
    g_length_a = -(g_r0 * a0 + g_a1 * a1) * per_a
    g_length_b = -(g_r0 * b0 + g_b1 * b1 + g_b2 * b2) * per_b
    g_outer = -g_r0 * wp.where(a_first, per_a, per_b)
    g_inner = -g_outer - g_a1 * per_a - g_b1 * per_b
    more_a = slab(
        g_a.c,
        g_a.a + wp.where(a_first, front_a, zero),
        g_a.t,
        g_a.l + wp.where(a_first, front_l, zero),
        g_a.w,
        g_a.f + wp.where(a_first, g_outer, g_inner) - g_length_a,
        g_a.z + g_a1 * per_a + g_length_a + (g_b1 - g_b2) * per_b,
    )
    more_b = slab(
        g_b.c,
        g_b.a + wp.where(a_first, zero, front_a) + back_a,
        g_b.t,
        g_b.l + wp.where(a_first, zero, front_l) + back_l,
        g_b.w,
        g_b.f + wp.where(a_first, g_inner, g_outer) - g_length_b,
        g_b.z + g_b2 * per_b + g_length_b,
    )
    return more_a, more_b, g_beta
