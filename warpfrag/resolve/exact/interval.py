"""What the parts in one interval become: the mix of any number of parts, and its adjoint.

With q_i the share of its slab's opacity that part i has and tau_i its transmittance (`part_share`), a_i = A_i q_i,

    colour = scale * sum C_i q_i v_i,   tau = prod tau_i,   opacity sum = sum w_i a_i

    mix "opacity":        v_i = w_i,               scale = (1 - tau) / sum a_i v_i     (fragment merging, eq. 8)
    mix "optical_depth":  v_i = -log(tau_i) / a_i, the same; of opaque parts, if there are, the mean

1 - tau is summed up from the opacities in front, not subtracted. The adjoint needs 1 - scale and the like, which vanish
with the opacities as their divisor does: they too are sums of small numbers, so thin and empty parts keep their digits.

Surfaces are mixed among themselves. On the way back the slabs around them take part with no length: this makes the
derivative in a surface's thickness the limit of that in a small one, as for smooth merging.
"""

from typing import Any

import warp as wp

from warpfrag.resolve.exact.sweep import cut_slab, cut_slab_adjoint, fragment_beta, light_to, part_share
from warpfrag.slabs.operators import MIX_OPTICAL_DEPTH
from warpfrag.slabs.slab import (
    NEGLIGIBLE,
    SERIES_OPACITY,
    WEIGHT_LIMIT,
    depth_per_opacity,
    depth_per_opacity_gradient,
    divide,
    slab,
)

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def member(sweep: Any, strip: Any, base: int, slot: int):
    """Return the position of a member of the present interval: the active slabs, then the surfaces."""
    if slot < sweep.active:
        return strip.active[base + slot]
    return sweep.entered + slot - sweep.active


@wp.func(inline=True)
def part_weight(s: Any, opacity: Any, passed: Any, mix: int):
    """Return a part's weight in the mix, and whether it is opaque, where that settles it."""
    if mix == MIX_OPTICAL_DEPTH:
        if passed <= type(passed)(NEGLIGIBLE):
            return type(passed)(1.0), True
        return depth_per_opacity(opacity, passed), False
    return s.w, False


@wp.func(inline=True)
def blend(sweep: Any, pixels: Any, pixel: int, strip: Any, base: int, mix: int, beta_per: int):
    """Return colour, transmittance and opacity sum of the present interval; its members move on to its end."""
    zero = type(sweep.end)(0.0)
    one = type(sweep.end)(1.0)
    color = wp.vector(zero, zero, zero)
    opaque_color = wp.vector(zero, zero, zero)
    opaque_count = int(0)
    opacity = type(sweep.end)(0.0)
    tau = type(sweep.end)(1.0)
    total = type(sweep.end)(0.0)
    opacity_sum = type(sweep.end)(0.0)
    first = wp.where(sweep.surfaces > 0, sweep.active, 0)
    count = sweep.active + sweep.surfaces
    for slot in range(first, count):
        position = member(sweep, strip, base, slot)
        s = strip.fragment[base + position]
        beta = fragment_beta(pixels, pixel, strip.order[base + position], beta_per)
        r, power, rest = cut_slab(s, sweep.end, beta, pixels.floor)
        share, passed = part_share(s, strip.rest[base + position], rest)
        strip.rest[base + position] = rest
        a = s.a * share
        if count - first > 1:
            weight, opaque = part_weight(s, a, passed, mix)
            if opaque:
                opaque_count += 1
                opaque_color += share * s.c
            color += share * weight * s.c
            total += a * weight
        else:
            color = share * s.c
        opacity += tau * a
        tau *= passed
        opacity_sum += a * s.w
    if opaque_count > 0:
        color = opaque_color / type(sweep.end)(opaque_count)
    elif count - first > 1:
        color = wp.min(divide(opacity, total, one), type(sweep.end)(WEIGHT_LIMIT)) * color
    return color, tau, opacity_sum


@wp.func(inline=True)
def absorption_slope(u: Any, tau: Any, scale: Any):
    """Return the derivative of scale = (1 - e^-u)/u, given tau = e^-u."""
    if u < type(u)(SERIES_OPACITY):
        sum = type(u)(1.0)
        for i in range(6):
            n = type(u)(6 - i)
            sum = type(u)(1.0) - u * (n + type(u)(1.0)) / (n * (n + type(u)(2.0))) * sum
        return type(u)(-0.5) * sum
    return (tau - scale) / u


@wp.func(inline=True)
def blend_adjoint(
    g: Any, g_tau: Any, g_sum: Any, sweep: Any, pixels: Any, pixel: int, strip: Any, base: int, mix: int, beta_per: int
):
    """Add the gradients of <g, colour> + g_tau tau + g_sum (opacity sum) to those of the fragments concerned."""
    zero = type(g_tau)(0.0)
    one = type(g_tau)(1.0)
    count = sweep.active + sweep.surfaces
    opaque_count = int(0)
    opacity = type(g_tau)(0.0)
    tau = type(g_tau)(1.0)
    total = type(g_tau)(0.0)
    # Of the mix by opacity: sum a_i (1 - scale without its common divisor); of all: <g, sum C_i q_i v_i>.
    missing = type(g_tau)(0.0)
    g_scale = type(g_tau)(0.0)
    for slot in range(count):
        at = base + member(sweep, strip, base, slot)
        s = strip.fragment[at]
        if sweep.surfaces > 0 and slot < sweep.active:
            strip.next_r[at] = strip.r[at]
            strip.next_power[at] = strip.power[at]
            strip.next_rest[at] = strip.rest[at]
        else:
            beta = fragment_beta(pixels, pixel, strip.order[at], beta_per)
            r, power, rest = cut_slab(s, sweep.end, beta, pixels.floor)
            strip.next_r[at] = r
            strip.next_power[at] = power
            strip.next_rest[at] = rest
        share, passed = part_share(s, strip.rest[at], strip.next_rest[at])
        a = s.a * share
        weight, opaque = part_weight(s, a, passed, mix)
        strip.share[at] = share
        strip.pass_[at] = passed
        strip.weight[at] = weight
        strip.prefix[at] = tau
        strip.veil[at] = opacity
        if opaque:
            opaque_count += 1
        g_scale += share * weight * wp.dot(g, s.c)
        total += a * weight
        missing += a * (weight - one + opacity)
        opacity += tau * a
        tau *= passed
    # Where opacity sums far below the opacities leave a thin part all the say, derivatives are beyond any use.
    limit = type(g_tau)(WEIGHT_LIMIT)
    # By itself a part stays as it is, and opaque parts have equal weights.
    varies = count > 1 and opaque_count == 0
    scale = type(g_tau)(1.0)
    slope = type(g_tau)(0.0)
    if varies:
        scale = wp.min(divide(opacity, total, one), limit)
        missing = divide(missing, total, zero)
        if mix == MIX_OPTICAL_DEPTH:
            slope = g_scale * absorption_slope(total, tau, scale)
    suffix = type(g_tau)(1.0)
    suffix_veil = type(g_tau)(0.0)
    g_depth = type(g_tau)(0.0)
    for back in range(count):
        position = member(sweep, strip, base, count - 1 - back)
        at = base + position
        s = strip.fragment[at]
        share = strip.share[at]
        passed = strip.pass_[at]
        rest = strip.rest[at]
        next_rest = strip.next_rest[at]
        a = s.a * share
        weight = strip.weight[at]
        if count == 1:
            weight = one
        elif opaque_count > 0:
            weight = wp.where(passed <= type(g_tau)(NEGLIGIBLE), one / type(g_tau)(opaque_count), zero)
        projection = wp.dot(g, s.c)
        g_share = projection * weight * scale
        g_a = g_sum * s.w
        g_w = g_sum * a
        g_passed = g_tau * strip.prefix[at] * suffix
        if varies:
            g_weight = projection * share * scale
            if mix == MIX_OPTICAL_DEPTH:
                by_a, by_passed = depth_per_opacity_gradient(a, passed)
                g_weight += slope * a
                g_a += slope * weight + g_weight * by_a
                g_passed += g_weight * by_passed
            else:
                most = limit / wp.max(weight, one)
                g_w += wp.clamp(g_weight, -most, most)
                if total > type(g_tau)(NEGLIGIBLE) and scale < limit:
                    # scale = (1 - tau) / total: its derivative is (others - weight * scale) / total.
                    others_veil = strip.veil[at] + strip.prefix[at] * suffix_veil
                    change = g_scale / total * (weight * missing - (weight - one) - others_veil)
                    g_a += wp.clamp(change, -limit, limit)
                    g_w -= wp.clamp(g_scale * scale * (a / total), -most, most)
        g_share += g_a * s.a
        # share = (rest - next_rest) / before, passed = after / before
        before = light_to(s, rest)
        per_before = divide(one, before, zero)
        g_before = -(g_share * share + g_passed * passed) * per_before
        g_after = g_passed * per_before
        g_rest = g_share * per_before
        g_next_rest = s.a * g_after - g_rest
        grad = strip.grad[at]
        grad_a = grad.a + g_a * share + g_after * next_rest
        grad_t = grad.t + g_after
        grad_l = grad.l
        grad_f = grad.f
        grad_z = grad.z
        if rest < one:
            grad_a += g_before * rest
            grad_t += g_before
            g_rest += s.a * g_before
        if strip.r[at] > zero:
            # This cut also ended the interval before.
            beta = fragment_beta(pixels, pixel, strip.order[at], beta_per)
            cut_a, cut_l, cut_f, cut_z, cut_depth, cut_beta = cut_slab_adjoint(
                g_rest + strip.cut[at], s, strip.r[at], strip.power[at], beta, pixels.floor
            )
            grad_a += cut_a
            grad_l += cut_l
            grad_f += cut_f
            grad_z += cut_z
            g_depth += cut_depth
            strip.grad_beta[at] = strip.grad_beta[at] + cut_beta
        grad_c = grad.c + share * weight * scale * g
        strip.grad[at] = slab(grad_c, grad_a, grad_t, grad_l, grad.w + g_w, grad_f, grad_z)
        strip.cut[at] = g_next_rest
        strip.rest[at] = next_rest
        strip.r[at] = strip.next_r[at]
        strip.power[at] = strip.next_power[at]
        suffix_veil = a + passed * suffix_veil
        suffix *= passed
    move_boundary(g_depth, sweep.begin_boundary, strip, base)


@wp.func(inline=True)
def move_boundary(g: Any, boundary: int, strip: Any, base: int):
    """Add the gradient of a boundary's depth to that of its fragment."""
    at = base + boundary // 2
    grad = strip.grad[at]
    if boundary % 2 == 1:
        grad.z = grad.z + g
    else:
        grad.f = grad.f + g
    strip.grad[at] = grad
