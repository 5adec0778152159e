"""Over: one slab in front of another."""

from typing import Any

import warp as wp

from warpfrag.slabs.slab import NEGLIGIBLE, divide

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def over(a: Any, b: Any):
    """Return slab a over slab b; the slab reaches from a's front to b's back (Algorithm 1, tail handling)."""
    opacity = a.opacity + a.transmittance * b.opacity
    weight = divide(a.opacity * a.weight + b.opacity * b.weight, opacity, type(opacity)(1.0))
    # Behind an opaque slab nothing counts, see `opaque_count`.
    log_t = wp.where(a.transmittance > type(opacity)(NEGLIGIBLE), b.log_transmittance, type(opacity)(0.0))
    return type(a)(
        a.color + a.transmittance * b.color,
        opacity,
        a.transmittance * b.transmittance,
        a.log_transmittance + log_t,
        weight,
        a.thickness + (b.back - a.back),
        b.back,
    )


@wp.func(inline=True)
def over_adjoint(g: Any, a: Any, b: Any):
    """Return the gradients in a and b of <g, over(a, b)>.

    The weight is S/A with S = A_a w_a + A_b w_b: `g_sum` is the gradient in S, and -`g_sum` w what A has of it.
    """
    zero = type(g.opacity)(0.0)
    opacity = a.opacity + a.transmittance * b.opacity
    weight = divide(a.opacity * a.weight + b.opacity * b.weight, opacity, type(opacity)(1.0))
    g_sum = divide(g.weight, opacity, zero)
    g_opacity = g.opacity - g_sum * weight
    g_transmittance = wp.dot(g.color, b.color) + g_opacity * b.opacity + g.transmittance * b.transmittance
    g_a = type(a)(
        g.color,
        g_opacity + g_sum * a.weight,
        g_transmittance,
        g.log_transmittance,
        g_sum * a.opacity,
        g.thickness,
        -g.thickness,
    )
    g_b = type(a)(
        a.transmittance * g.color,
        g_opacity * a.transmittance + g_sum * b.weight,
        g.transmittance * a.transmittance,
        g.log_transmittance,
        g_sum * b.opacity,
        zero,
        g.back + g.thickness,
    )
    return g_a, g_b
