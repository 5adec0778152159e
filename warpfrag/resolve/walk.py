"""Walking through the fragments of a pixel: sort them, let the running slab take one after the other, and back.

The steps are Algorithm 1 of the fragment-merging paper. A step either starts a new layer, merges the next slab into the
running one, or adds it to the tail. Which of the three happens, and the order, is a discrete choice: the adjoint holds
it fixed. The way back needs the running slab before each step; `replay` recomputes all of them into scratch memory that
belongs to the thread, so the forward pass stores nothing for the gradient.
"""

from typing import Any

import warp as wp

from warpfrag.operators import (
    add_gains_gradient,
    log_transmittance,
    merge,
    merge_adjoint,
    over,
    over_adjoint,
    overlap,
    slab,
    smooth_gains,
    smooth_gains_adjoint,
)

wp.set_module_options({"enable_backward": False})

MERGE_NONE = wp.constant(0)
MERGE_SMOOTH = wp.constant(1)
MERGE_ORDER_INDEPENDENT = wp.constant(2)

STEP_START = wp.constant(0)
STEP_MERGE = wp.constant(1)
STEP_TAIL = wp.constant(2)

NO_FRAGMENT = wp.constant(2147483647)


@wp.func
def precedes(depth: Any, thickness: Any, i: int, j: int):
    """Tell whether fragment i comes before j: by depth, then front, then submission."""
    if depth[i] != depth[j]:
        return depth[i] < depth[j]
    front_i = depth[i] - thickness[i]
    front_j = depth[j] - thickness[j]
    if front_i != front_j:
        return front_i < front_j
    return i < j


@wp.func
def sort_pixel(depth: Any, thickness: Any, begin: int, end: int, order: wp.array2d[int], row: int):
    """Write the fragments begin : end to `order[row]`, sorted: one comparison each if they are already, else Shell's.

    The gaps are Knuth's (1, 4, 13, ...); short lists start at gap 1, an insertion sort.
    """
    sorted = bool(True)
    for fragment in range(begin, end):
        order[row, fragment - begin] = fragment
        if fragment > begin:
            sorted = sorted and not precedes(depth, thickness, fragment, fragment - 1)
    if not sorted:
        count = end - begin
        gap = int(1)
        while 9 * gap < count:
            gap = 3 * gap + 1
        while gap > 0:
            for i in range(gap, count):
                fragment = order[row, i]
                j = int(i)
                while j >= gap and precedes(depth, thickness, fragment, order[row, j - gap]):
                    order[row, j] = order[row, j - gap]
                    j -= gap
                order[row, j] = fragment
            gap = gap // 3


@wp.func
def load_slab(rgba: Any, depth: Any, thickness: Any, opacity_sum: Any, fragment: int):
    """Return a fragment as a slab."""
    a = rgba[fragment, 3]
    one = type(a)(1.0)
    weight = one
    if opacity_sum.shape[0] > 0 and a > type(a)(0.0):
        weight = opacity_sum[fragment] / a
    z = depth[fragment]
    c = wp.vector(rgba[fragment, 0], rgba[fragment, 1], rgba[fragment, 2])
    return slab(c, a, one - a, log_transmittance(a), weight, z - thickness[fragment], z)


@wp.func
def store_grad(
    grad: Any,
    fragment: int,
    rgba: Any,
    opacity_sum: Any,
    grad_rgba: Any,
    grad_depth: Any,
    grad_thickness: Any,
    grad_opacity_sum: Any,
):
    """Write the gradient of a fragment, given that of the slab that `load_slab` made of it; empty arrays are skipped."""
    a = rgba[fragment, 3]
    zero = type(a)(0.0)
    t = type(a)(1.0) - a
    grad_a = grad.a - grad.t
    if t > zero:
        grad_a -= grad.l / t
    if opacity_sum.shape[0] > 0:
        grad_sum = zero
        if a > zero:
            grad_sum = grad.w / a
            grad_a -= grad_sum * opacity_sum[fragment] / a
        if grad_opacity_sum.shape[0] > 0:
            grad_opacity_sum[fragment] = grad_sum
    if grad_rgba.shape[0] > 0:
        grad_rgba[fragment, 0] = grad.c[0]
        grad_rgba[fragment, 1] = grad.c[1]
        grad_rgba[fragment, 2] = grad.c[2]
        grad_rgba[fragment, 3] = grad_a
    if grad_depth.shape[0] > 0:
        grad_depth[fragment] = grad.z + grad.f
    if grad_thickness.shape[0] > 0:
        grad_thickness[fragment] = -grad.f


@wp.func
def valid_fragment(rgba: Any, depth: Any, thickness: Any, fragment: int):
    """Tell whether a fragment's values are finite and in range."""
    a = rgba[fragment, 3]
    zero = type(a)(0.0)
    # Adding zero times everything: one NaN or infinity anywhere makes the sum NaN.
    sum = zero * (rgba[fragment, 0] + rgba[fragment, 1] + rgba[fragment, 2] + depth[fragment] + thickness[fragment])
    return sum == zero and a >= zero and a <= type(a)(1.0) and thickness[fragment] >= zero


@wp.func
def choose_step(running: Any, following: Any, layer: int, max_layers: int, merge_kind: int):
    """Return what happens to the slab that follows the running one, which is to become layer number `layer`."""
    if merge_kind != MERGE_NONE and overlap(running, following):
        return STEP_MERGE
    if layer < max_layers - 1:
        return STEP_START
    return STEP_TAIL


@wp.func
def take_step(step: int, a: Any, b: Any, beta: Any, merge_kind: int, mix: int, floor: Any):
    """Return the running slab after a step that is not a start."""
    if step == STEP_TAIL:
        return over(a, b)
    x = type(beta)(1.0)
    y = type(beta)(1.0)
    v = type(beta)(0.0)
    if merge_kind == MERGE_SMOOTH:
        x, y, v = smooth_gains(a, b, beta, floor)
    return merge(a, b, x, y, v, mix)


@wp.func
def take_step_adjoint(step: int, g: Any, a: Any, b: Any, beta: Any, merge_kind: int, mix: int, floor: Any):
    """Return the gradients in a, b and beta of <g, take_step(step, a, b, ...)>."""
    zero = type(beta)(0.0)
    if step == STEP_TAIL:
        over_a, over_b = over_adjoint(g, a, b)
        return over_a, over_b, zero
    x = type(beta)(1.0)
    y = type(beta)(1.0)
    v = type(beta)(0.0)
    if merge_kind == MERGE_SMOOTH:
        x, y, v = smooth_gains(a, b, beta, floor)
    merge_a, merge_b, g_x, g_y, g_v = merge_adjoint(g, a, b, x, y, v, mix)
    if merge_kind != MERGE_SMOOTH:
        return merge_a, merge_b, zero
    gains_a, gains_b, g_beta = smooth_gains_adjoint(g_x, g_y, g_v, a, b, beta, floor)
    return add_gains_gradient(merge_a, gains_a), add_gains_gradient(merge_b, gains_b), g_beta


@wp.func
def zero_slab(zero: Any):
    """Return the slab whose every component is the given zero; its type sets the precision."""
    return slab(wp.vector(zero, zero, zero), zero, zero, zero, zero, zero, zero)


@wp.func
def replay(
    rgba: Any,
    depth: Any,
    thickness: Any,
    opacity_sum: Any,
    begin: int,
    end: int,
    beta: Any,
    max_layers: int,
    merge_kind: int,
    mix: int,
    floor: Any,
    order: wp.array2d[int],
    steps: wp.array2d[int],
    states: Any,
    through: Any,
    row: int,
):
    """Walk through a pixel's fragments and keep, per position: step, running slab after it, transmittance up to its layer.

    Returns the number of layers.
    """
    sort_pixel(depth, thickness, begin, end, order, row)
    layer = int(0)
    transmittance = type(beta)(1.0)
    for position in range(end - begin):
        following = load_slab(rgba, depth, thickness, opacity_sum, order[row, position])
        step = int(STEP_START)
        if position > 0:
            step = choose_step(states[row, position - 1], following, layer, max_layers, merge_kind)
        if step == STEP_START:
            if position > 0:
                layer += 1
                transmittance *= states[row, position - 1].t
            states[row, position] = following
        else:
            states[row, position] = take_step(step, states[row, position - 1], following, beta, merge_kind, mix, floor)
        steps[row, position] = step
        through[row, position] = transmittance
    return wp.where(end > begin, layer + 1, 0)

