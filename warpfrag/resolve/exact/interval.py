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

from warpfrag.resolve.exact.cut import cut_slab, cut_slab_adjoint, light_to, part_share
from warpfrag.resolve.exact.sweep import fragment_beta
from warpfrag.slabs.mix import MIX_OPTICAL_DEPTH, depth_per_opacity, depth_per_opacity_gradient
from warpfrag.slabs.slab import NEGLIGIBLE, SERIES_OPACITY, WEIGHT_LIMIT, divide

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def position_of(sweep: Any, scratch: Any, base: int, slot: int):
    """Return the position of a member of the present interval: the active slabs, then the surfaces."""
    if slot < sweep.active:
        return scratch.active[base + slot]
    return sweep.entered + slot - sweep.active


@wp.func(inline=True)
def part_weight(s: Any, opacity: Any, passed: Any, mix: int):
    """Return a part's weight in the mix, and whether it is opaque, where that settles it."""
    if mix == MIX_OPTICAL_DEPTH:
        if passed <= type(passed)(NEGLIGIBLE):
            return type(passed)(1.0), True
        return depth_per_opacity(opacity, passed), False
    return s.weight, False


@wp.func(inline=True)
def blend(sweep: Any, lists: Any, pixel: int, scratch: Any, base: int, mix: int, beta_per: int):
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
        position = position_of(sweep, scratch, base, slot)
        s = scratch.fragment[base + position]
        beta = fragment_beta(lists, pixel, scratch.order[base + position], beta_per)
        r, power, rest = cut_slab(s, sweep.end, beta, lists.floor)
        share, passed = part_share(s, scratch.rest[base + position], rest)
        scratch.rest[base + position] = rest
        opacity_of_part = s.opacity * share
        if count - first > 1:
            weight, opaque = part_weight(s, opacity_of_part, passed, mix)
            if opaque:
                opaque_count += 1
                opaque_color += share * s.color
            color += share * weight * s.color
            total += opacity_of_part * weight
        else:
            color = share * s.color
        opacity += tau * opacity_of_part
        tau *= passed
        opacity_sum += opacity_of_part * s.weight
    if opaque_count > 0:
        color = opaque_color / type(sweep.end)(opaque_count)
    elif count - first > 1:
        color = wp.min(divide(opacity, total, one), type(sweep.end)(WEIGHT_LIMIT)) * color
    return color, tau, opacity_sum


@wp.func(inline=True)
def absorption_slope(u: Any, tau: Any, scale: Any):
    """Return the derivative of scale = (1 - e^-u)/u, given tau = e^-u."""
    if u < type(u)(SERIES_OPACITY):
        total = type(u)(1.0)
        for i in range(6):
            n = type(u)(6 - i)
            total = type(u)(1.0) - u * (n + type(u)(1.0)) / (n * (n + type(u)(2.0))) * total
        return type(u)(-0.5) * total
    return (tau - scale) / u


@wp.func(inline=True)
def cut_member(g: Any, sweep: Any, lists: Any, pixel: int, scratch: Any, base: int, slot: int, mix: int, beta_per: int):
    """Write what a member's part is in the present interval, and where it is cut at the interval's end.

    Returns:
        Opacity, transmittance and weight of the part, <g, C q v>, and whether it is opaque.
    """
    at = base + position_of(sweep, scratch, base, slot)
    s = scratch.fragment[at]
    if sweep.surfaces > 0 and slot < sweep.active:
        # Slabs around surfaces take part with no length.
        scratch.next_cut[at] = scratch.cut[at]
        scratch.next_power[at] = scratch.power[at]
        scratch.next_rest[at] = scratch.rest[at]
    else:
        beta = fragment_beta(lists, pixel, scratch.order[at], beta_per)
        cut, power, rest = cut_slab(s, sweep.end, beta, lists.floor)
        scratch.next_cut[at] = cut
        scratch.next_power[at] = power
        scratch.next_rest[at] = rest
    share, passed = part_share(s, scratch.rest[at], scratch.next_rest[at])
    a = s.opacity * share
    weight, opaque = part_weight(s, a, passed, mix)
    scratch.share[at] = share
    scratch.passed[at] = passed
    scratch.weight[at] = weight
    return a, passed, weight, share * weight * wp.dot(g, s.color), opaque


@wp.func(inline=True)
def cut_members(g: Any, sweep: Any, lists: Any, pixel: int, scratch: Any, base: int, mix: int, beta_per: int):
    """Write what all members' parts are in the present interval, and what is in front of each.

    Returns:
        How many are opaque; opacity and transmittance of the interval, sum a v, the sum of a (1 - scale without its
        common divisor) for the mix by opacity, and <g, sum C q v>.
    """
    one = type(sweep.end)(1.0)
    opaque_count = int(0)
    opacity = type(sweep.end)(0.0)
    tau = type(sweep.end)(1.0)
    total = type(sweep.end)(0.0)
    missing = type(sweep.end)(0.0)
    g_scale = type(sweep.end)(0.0)
    for slot in range(sweep.active + sweep.surfaces):
        a, passed, weight, shown, opaque = cut_member(g, sweep, lists, pixel, scratch, base, slot, mix, beta_per)
        at = base + position_of(sweep, scratch, base, slot)
        scratch.transmittance_before[at] = tau
        scratch.opacity_before[at] = opacity
        if opaque:
            opaque_count += 1
        g_scale += shown
        total += a * weight
        missing += a * (weight - one + opacity)
        opacity += tau * a
        tau *= passed
    return opaque_count, opacity, tau, total, missing, g_scale


@wp.func(inline=True)
def cut_adjoint(
    g_share: Any, g_opacity: Any, g_passed: Any, was_active: bool, scratch: Any, at: int, beta: Any, floor: Any
):
    """Take the gradients in a part's share, opacity (by its slab's) and transmittance to its slab and its cuts.

    share = (rest - next_rest) / D, passed = D' / D with D, D' = T + A rest, T + A next_rest. The interval's begin is a
    cut of slabs that were active before: it also ended their part in the interval before, its gradient is complete, and
    goes on to the slab. Others begin there: nothing of them is in front.

    Returns:
        The gradient in the depth of the interval's begin.
    """
    zero = type(g_share)(0.0)
    one = type(g_share)(1.0)
    s = scratch.fragment[at]
    share = scratch.share[at]
    rest = scratch.rest[at]
    next_rest = scratch.next_rest[at]
    before = light_to(s, rest)
    per_before = divide(one, before, zero)
    g_before = -(g_share * share + g_passed * scratch.passed[at]) * per_before
    g_after = g_passed * per_before
    g_rest = g_share * per_before
    g_next_rest = s.opacity * g_after - g_rest
    g_depth = type(g_share)(0.0)
    grad = scratch.grad[at]
    grad.opacity = grad.opacity + g_opacity * share + g_after * next_rest
    grad.transmittance = grad.transmittance + g_after
    if was_active:
        grad.opacity = grad.opacity + g_before * rest
        grad.transmittance = grad.transmittance + g_before
        g_rest += s.opacity * g_before
        cut_opacity, cut_log_t, cut_thickness, cut_back, cut_depth, cut_beta = cut_slab_adjoint(
            g_rest + scratch.grad_rest[at], s, scratch.cut[at], scratch.power[at], beta, floor
        )
        grad.opacity = grad.opacity + cut_opacity
        grad.log_transmittance = grad.log_transmittance + cut_log_t
        grad.thickness = grad.thickness + cut_thickness
        grad.back = grad.back + cut_back
        g_depth = cut_depth
        scratch.grad_beta[at] = scratch.grad_beta[at] + cut_beta
    scratch.grad[at] = grad
    scratch.grad_rest[at] = g_next_rest
    scratch.rest[at] = next_rest
    scratch.cut[at] = scratch.next_cut[at]
    scratch.power[at] = scratch.next_power[at]
    return g_depth


@wp.func(inline=True)
def blend_adjoint(
    g: Any, g_tau: Any, g_sum: Any, sweep: Any, lists: Any, pixel: int, scratch: Any, base: int, mix: int, beta_per: int
):
    """Add the gradients of <g, colour> + g_tau tau + g_sum (opacity sum) to those of the fragments concerned."""
    zero = type(g_tau)(0.0)
    one = type(g_tau)(1.0)
    count = sweep.active + sweep.surfaces
    opaque_count, opacity, tau, total, missing, g_scale = cut_members(
        g, sweep, lists, pixel, scratch, base, mix, beta_per
    )
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
    tau_behind = type(g_tau)(1.0)
    opacity_behind = type(g_tau)(0.0)
    g_depth = type(g_tau)(0.0)
    for back in range(count):
        at = base + position_of(sweep, scratch, base, count - 1 - back)
        s = scratch.fragment[at]
        share = scratch.share[at]
        passed = scratch.passed[at]
        a = s.opacity * share
        weight = scratch.weight[at]
        if count == 1:
            weight = one
        elif opaque_count > 0:
            weight = wp.where(passed <= type(g_tau)(NEGLIGIBLE), one / type(g_tau)(opaque_count), zero)
        projection = wp.dot(g, s.color)
        g_a = g_sum * s.weight
        g_w = g_sum * a
        g_passed = g_tau * scratch.transmittance_before[at] * tau_behind
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
                    others = scratch.opacity_before[at] + scratch.transmittance_before[at] * opacity_behind
                    change = g_scale / total * (weight * missing - (weight - one) - others)
                    g_a += wp.clamp(change, -limit, limit)
                    g_w -= wp.clamp(g_scale * scale * (a / total), -most, most)
        grad = scratch.grad[at]
        grad.color = grad.color + share * weight * scale * g
        grad.weight = grad.weight + g_w
        scratch.grad[at] = grad
        g_share = projection * weight * scale + g_a * s.opacity
        beta = fragment_beta(lists, pixel, scratch.order[at], beta_per)
        was_active = at - base < sweep.entered
        g_depth += cut_adjoint(g_share, g_a, g_passed, was_active, scratch, at, beta, lists.floor)
        opacity_behind = a + passed * opacity_behind
        tau_behind *= passed
    move_boundary(g_depth, sweep.begin_boundary, scratch, base)


@wp.func(inline=True)
def move_boundary(g: Any, boundary: int, scratch: Any, base: int):
    """Add the gradient of a boundary's depth to that of its fragment."""
    at = base + boundary // 2
    grad = scratch.grad[at]
    if boundary % 2 == 1:
        grad.back = grad.back + g
    else:
        grad.back = grad.back + g
        grad.thickness = grad.thickness - g
    scratch.grad[at] = grad
