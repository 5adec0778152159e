"""Mixes: what two parts in one place become (fragment merging, eq. 6-8; zSlab, eq. 4.1-4.4).

Of slabs a and b, with gains x, y, v (see `part`), the parts that are mixed have the opacities A_a x / D_a and
A_b y / D_1, where

    D_a = T_a + A_a x,   D_2 = T_b + A_b v,   D_1 = D_2 + A_b y       (transmittance up to the rest of a, b, the mix)

Over multiplies by D again, so the mixed parts show `mixed_a` C_a + `mixed_b` C_b with no D to divide by:

    opacity, optical_depth:  mixed_a = D_1 x v_a scale,  mixed_b = D_a y v_b scale   (v: weights of the mix)
                             scale = (D_1 A_a x + T_a A_b y) / (D_1 A_a x v_a + D_a A_b y v_b)
    average:                 mixed_a = x (D_1 - A_b y / 2),  mixed_b = y (D_a - A_a x / 2)
"""

from typing import Any

import warp as wp

from warpfrag.slabs.slab import LOG_OPAQUE, NEGLIGIBLE, SERIES_OPACITY, divide

wp.set_module_options({"enable_backward": False})

MIX_OPACITY = wp.constant(0)
MIX_AVERAGE = wp.constant(1)
MIX_OPTICAL_DEPTH = wp.constant(2)


@wp.func(inline=True)
def depth_per_opacity(opacity: Any, transmittance: Any):
    """Return u/A, the optical depth -log(1 - A) per opacity; 1 where A = 0."""
    if opacity < type(opacity)(SERIES_OPACITY):
        total = type(opacity)(0.0)
        for i in range(7):
            total = type(opacity)(1.0) / type(opacity)(7 - i) + opacity * total
        return total
    return -wp.log(transmittance) / opacity


@wp.func(inline=True)
def depth_per_opacity_gradient(opacity: Any, transmittance: Any):
    """Return the derivatives of `depth_per_opacity` in A and in 1 - A."""
    if opacity < type(opacity)(SERIES_OPACITY):
        total = type(opacity)(0.0)
        for i in range(6):
            total = type(opacity)(6 - i) / type(opacity)(7 - i) + opacity * total
        return total, type(opacity)(0.0)
    return wp.log(transmittance) / (opacity * opacity), type(opacity)(-1.0) / (transmittance * opacity)


@wp.func(inline=True)
def light_to_parts(a: Any, b: Any, x: Any, y: Any, v: Any):
    """Return D_a, D_1 and D_2: what the slabs let through up to the rest of a, the mix in b, the rest of b."""
    d_2 = b.transmittance + b.opacity * v
    return a.transmittance + a.opacity * x, d_2 + b.opacity * y, d_2


@wp.func(inline=True)
def opaque_count(s: Any):
    """Return how many opaque fragments an opaque slab was mixed of: their logarithms of no transmittance add."""
    return wp.max(s.log_transmittance / type(s.opacity)(LOG_OPAQUE), type(s.opacity)(1.0))


@wp.func(inline=True)
def mix_weights(a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return the weights of the two colours of a mix, and whether opaque parts fixed them (then they add up to 1)."""
    zero = type(x)(0.0)
    one = type(x)(1.0)
    if mix == MIX_OPTICAL_DEPTH:
        d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
        t_a = divide(a.transmittance, d_a, zero)
        t_b = divide(d_2, d_1, zero)
        # Opaque parts win; of two of them the mean is taken, each as many times as there are opaque fragments in it.
        opaque_a = t_a <= type(x)(NEGLIGIBLE)
        opaque_b = t_b <= type(x)(NEGLIGIBLE)
        if opaque_a and opaque_b:
            count_a = opaque_count(a)
            share = count_a / (count_a + opaque_count(b))
            return share, one - share, True
        if opaque_a:
            return one, zero, True
        if opaque_b:
            return zero, one, True
        return depth_per_opacity(a.opacity * x / d_a, t_a), depth_per_opacity(b.opacity * y / d_1, t_b), False
    return a.weight, b.weight, False


@wp.func(inline=True)
def mixed_shares(a: Any, b: Any, x: Any, y: Any, v: Any, mix: int):
    """Return `mixed_a` and `mixed_b`: how much the mixed parts show of the two colours."""
    half = type(x)(0.5)
    d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
    x_a = a.opacity * x
    y_b = b.opacity * y
    if mix == MIX_AVERAGE:
        return x * (d_1 - half * y_b), y * (d_a - half * x_a)
    v_a, v_b, opaque = mix_weights(a, b, x, y, v, mix)
    total = d_1 * x_a * v_a + d_a * y_b * v_b
    scale = type(x)(1.0)
    if total > type(x)(NEGLIGIBLE) and not opaque:
        scale = (d_1 * x_a + a.transmittance * y_b) / total
    return d_1 * x * v_a * scale, d_a * y * v_b * scale


@wp.func(inline=True)
def average_adjoint(g_a: Any, g_b: Any, a: Any, b: Any, x: Any, y: Any, v: Any):
    """Return the gradients in x, y, x_a = A_a x, y_b = A_b y, D_a and D_1 of g_a `mixed_a` + g_b `mixed_b` ("average").

    Here and in `weighted_adjoint` x_a, y_b and the D count as independent of x and y: who calls chains them.
    """
    half = type(x)(0.5)
    d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
    g_x = g_a * (d_1 - half * (b.opacity * y))
    g_y = g_b * (d_a - half * (a.opacity * x))
    g_d1 = g_a * x
    g_da = g_b * y
    return g_x, g_y, -half * g_da, -half * g_d1, g_da, g_d1


@wp.func(inline=True)
def weighted_adjoint(g_a: Any, g_b: Any, a: Any, b: Any, x: Any, y: Any, v: Any, mix: int, g_t: Any):
    """Return the gradients of g_a `mixed_a` + g_b `mixed_b`, for the mixes with weights.

    With n = D_1 x_a + T_a y_b and m = D_1 x_a v_a + D_a y_b v_b, scale = n / m: `g_part` is the gradient in n,
    `g_total` that in m.

    Returns:
        Gradients in x, y, x_a, y_b, D_a, D_1, D_2, T_a (added to `g_t`) and the weights of a and b.
    """
    one = type(x)(1.0)
    zero = type(x)(0.0)
    d_a, d_1, d_2 = light_to_parts(a, b, x, y, v)
    x_a = a.opacity * x
    y_b = b.opacity * y
    v_a, v_b, opaque = mix_weights(a, b, x, y, v, mix)
    total = d_1 * x_a * v_a + d_a * y_b * v_b
    scale = one
    g_part = zero
    g_total = zero
    g_limit = zero
    if total > type(x)(NEGLIGIBLE) and not opaque:
        scale = (d_1 * x_a + a.transmittance * y_b) / total
        g_part = (g_a * d_1 * x * v_a + g_b * d_a * y * v_b) / total
        g_total = -g_part * scale
    elif mix == MIX_OPTICAL_DEPTH and not opaque:
        # Here the scale is A/u, which tends to 1 as 1 - (A_a + A_b)/2 of the parts x_a/d_a and y_b/d_1.
        g_limit = -type(x)(0.5) * (g_a * d_1 * x * v_a + g_b * d_a * y * v_b)
    g_x = g_a * d_1 * v_a * scale
    g_y = g_b * d_a * v_b * scale
    g_d1 = g_a * x * v_a * scale + (g_part + g_total * v_a) * x_a
    g_da = g_b * y * v_b * scale + g_total * v_b * y_b
    g_d2 = zero
    g_xa = (g_part + g_total * v_a) * d_1 + divide(g_limit, d_a, zero)
    g_yb = g_part * a.transmittance + g_total * v_b * d_a + divide(g_limit, d_1, zero)
    g_t += g_part * y_b
    g_va = g_a * d_1 * x * scale + g_total * d_1 * x_a
    g_vb = g_b * d_a * y * scale + g_total * d_a * y_b
    g_wa = zero
    g_wb = zero
    if mix == MIX_OPACITY:
        g_wa = g_va
        g_wb = g_vb
    elif not opaque:
        # The weights are those of the parts: opacities x_a/d_a and y_b/d_1, transmittances T_a/d_a and d_2/d_1.
        part_a, part_ta = depth_per_opacity_gradient(x_a / d_a, a.transmittance / d_a)
        part_b, part_tb = depth_per_opacity_gradient(y_b / d_1, d_2 / d_1)
        # Not over the square of d, which may underflow.
        per_da = g_va / d_a
        per_d1 = g_vb / d_1
        g_xa += per_da * part_a
        g_t += per_da * part_ta
        g_da -= per_da * (part_a * (x_a / d_a) + part_ta * (a.transmittance / d_a))
        g_yb += per_d1 * part_b
        g_d1 -= per_d1 * (part_b * (y_b / d_1) + part_tb * (d_2 / d_1))
        g_d2 = per_d1 * part_tb
    return g_x, g_y, g_xa, g_yb, g_da, g_d1, g_d2, g_t, g_wa, g_wb
