"""Walking through the fragments of a pixel: sort them, let the running slab take one after the other, and back.

The steps are Algorithm 1 of the fragment-merging paper. A step either starts a new layer, merges the next slab into the
running one, or adds it to the tail. Which of the three happens, and the order, is a discrete choice: the adjoint holds
it fixed. The way back needs the running slab before each step; `replay` recomputes all of them into scratch memory that
belongs to the thread, so the forward pass stores nothing for the gradient.

Kernels are made for one way to merge and mix: those are constants in them, and as every function here is inlined, the
compiler drops the branches that are not taken.
"""

from typing import Any

import warp as wp

from warpfrag.slabs.operators import ofm, ofm_adjoint, over, over_adjoint, sfm, sfm_adjoint, sfm_powers
from warpfrag.slabs.slab import NEGLIGIBLE, WEIGHT_LIMIT, Slab32, Slab64, divide, log_transmittance, overlap, slab

wp.set_module_options({"enable_backward": False})

MERGE_NONE = wp.constant(0)
MERGE_SMOOTH = wp.constant(1)
MERGE_ORDER_INDEPENDENT = wp.constant(2)
MERGE_EXACT = wp.constant(3)

STEP_START = wp.constant(0)
STEP_MERGE = wp.constant(1)
STEP_TAIL = wp.constant(2)

NO_FRAGMENT = wp.constant(2147483647)


@wp.struct
class Pixels32:
    """The fragments of all pixels. `opacity_sum` may be empty; `floor` is the least log T of a slab that is divided."""

    rgba: wp.array[wp.vec4f]
    depth: wp.array[wp.float32]
    thickness: wp.array[wp.float32]
    offsets: wp.array[wp.int32]
    beta: wp.array[wp.float32]
    opacity_sum: wp.array[wp.float32]
    floor: wp.float32
    max_layers: wp.int32


@wp.struct
class Pixels64:
    """`Pixels32` in double precision."""

    rgba: wp.array[wp.vec4d]
    depth: wp.array[wp.float64]
    thickness: wp.array[wp.float64]
    offsets: wp.array[wp.int32]
    beta: wp.array[wp.float64]
    opacity_sum: wp.array[wp.float64]
    floor: wp.float64
    max_layers: wp.int32


@wp.struct
class Gradients32:
    """Gradients of the fragments and, per pixel, of beta; those nobody wants are empty."""

    rgba: wp.array[wp.vec4f]
    depth: wp.array[wp.float32]
    thickness: wp.array[wp.float32]
    beta: wp.array[wp.float32]
    opacity_sum: wp.array[wp.float32]


@wp.struct
class Gradients64:
    """`Gradients32` in double precision."""

    rgba: wp.array[wp.vec4d]
    depth: wp.array[wp.float64]
    thickness: wp.array[wp.float64]
    beta: wp.array[wp.float64]
    opacity_sum: wp.array[wp.float64]


@wp.struct
class Scratch32:
    """A thread's record of one pixel, by position in depth order; each thread has a row of `length` entries.

    `order`: fragment; `step`: what happened to it; `fragment`: it as a slab; `running`: the running slab after it;
    `front`, `back`: its `step_powers`; `through`: transmittance of all layers before the running one.
    """

    length: wp.int32
    order: wp.array[wp.int32]
    step: wp.array[wp.int32]
    fragment: wp.array[Slab32]
    running: wp.array[Slab32]
    front: wp.array[wp.float32]
    back: wp.array[wp.float32]
    through: wp.array[wp.float32]


@wp.struct
class Scratch64:
    """`Scratch32` in double precision."""

    length: wp.int32
    order: wp.array[wp.int32]
    step: wp.array[wp.int32]
    fragment: wp.array[Slab64]
    running: wp.array[Slab64]
    front: wp.array[wp.float64]
    back: wp.array[wp.float64]
    through: wp.array[wp.float64]


@wp.func(inline=True)
def precedes(pixels: Any, i: int, j: int):
    """Tell whether fragment i comes before j: by depth, then front, then submission."""
    z_i = pixels.depth[i]
    z_j = pixels.depth[j]
    if z_i != z_j:
        return z_i < z_j
    front_i = z_i - pixels.thickness[i]
    front_j = z_j - pixels.thickness[j]
    if front_i != front_j:
        return front_i < front_j
    return i < j


@wp.func(inline=True)
def sort_pixel(pixels: Any, begin: int, count: int, order: wp.array[wp.int32], base: int):
    """Write the fragments of a pixel to `order`, sorted: one comparison each if they are already, else Shell's.

    The gaps are Knuth's (1, 4, 13, ...); short lists start at gap 1, an insertion sort.
    """
    sorted = bool(True)
    for position in range(count):
        order[base + position] = begin + position
        if position > 0 and precedes(pixels, begin + position, begin + position - 1):
            sorted = False
    if not sorted:
        gap = int(1)
        while 9 * gap < count:
            gap = 3 * gap + 1
        while gap > 0:
            for position in range(gap, count):
                fragment = order[base + position]
                j = int(position)
                while j >= gap and precedes(pixels, fragment, order[base + j - gap]):
                    order[base + j] = order[base + j - gap]
                    j -= gap
                order[base + j] = fragment
            gap = gap // 3


@wp.func(inline=True)
def load_slab(pixels: Any, fragment: int, merge_kind: int):
    """Return a fragment as a slab."""
    rgba = pixels.rgba[fragment]
    a = rgba[3]
    one = type(a)(1.0)
    weight = one
    if pixels.opacity_sum.shape[0] > 0:
        weight = wp.min(divide(pixels.opacity_sum[fragment], a, one), type(a)(WEIGHT_LIMIT))
    log_t = type(a)(0.0)
    if merge_kind == MERGE_SMOOTH:
        # Nothing else reads it, and it costs a third of all the rest.
        log_t = log_transmittance(a)
    z = pixels.depth[fragment]
    front = z - pixels.thickness[fragment]
    if z - front < type(a)(NEGLIGIBLE):
        # A surface: so thin a slab could not be divided.
        front = z
    return slab(wp.vector(rgba[0], rgba[1], rgba[2]), a, one - a, log_t, weight, front, z)


@wp.func(inline=True)
def store_grad(g: Any, pixels: Any, fragment: int, grads: Any):
    """Write the gradient of a fragment, given that of the slab that `load_slab` made of it."""
    a = pixels.rgba[fragment][3]
    zero = type(a)(0.0)
    t = type(a)(1.0) - a
    grad_a = g.a - g.t
    if t > zero:
        grad_a -= g.l / t
    if pixels.opacity_sum.shape[0] > 0:
        grad_sum = zero
        if divide(pixels.opacity_sum[fragment], a, zero) < type(a)(WEIGHT_LIMIT):
            grad_sum = divide(g.w, a, zero)
            grad_a -= divide(grad_sum * pixels.opacity_sum[fragment], a, zero)
        if grads.opacity_sum.shape[0] > 0:
            grads.opacity_sum[fragment] = grad_sum
    if grads.rgba.shape[0] > 0:
        grads.rgba[fragment] = wp.vector(g.c[0], g.c[1], g.c[2], grad_a)
    if grads.depth.shape[0] > 0:
        grads.depth[fragment] = g.z + g.f
    if grads.thickness.shape[0] > 0:
        grads.thickness[fragment] = -g.f


@wp.func(inline=True)
def valid_fragment(pixels: Any, fragment: int):
    """Tell whether a fragment's values are finite and in range."""
    rgba = pixels.rgba[fragment]
    t = pixels.thickness[fragment]
    zero = type(t)(0.0)
    # Zero times everything: one NaN or infinity anywhere makes the sum NaN.
    sum = zero * rgba[0] + zero * rgba[1] + zero * rgba[2] + zero * (pixels.depth[fragment] - t)
    if pixels.opacity_sum.shape[0] > 0:
        opacity_sum = pixels.opacity_sum[fragment]
        sum += zero * opacity_sum
        if opacity_sum < zero:
            return False
    return sum == zero and rgba[3] >= zero and rgba[3] <= type(t)(1.0) and t >= zero


@wp.func(inline=True)
def pixel_beta(pixels: Any, pixel: int):
    """Return beta, which is one for all or one for each pixel."""
    return pixels.beta[wp.where(pixels.beta.shape[0] > 1, pixel, 0)]


@wp.func(inline=True)
def valid_beta(pixels: Any, pixel: int):
    """Tell whether a pixel's beta is in range."""
    beta = pixel_beta(pixels, pixel)
    return beta >= type(beta)(0.0) and beta <= type(beta)(1.0)


@wp.func(inline=True)
def choose_step(running: Any, following: Any, layer: int, max_layers: int, merge_kind: int):
    """Return what happens to the slab that follows the running one, which is to become layer number `layer`."""
    if merge_kind != MERGE_NONE and overlap(running, following):
        return STEP_MERGE
    if layer < max_layers - 1:
        return STEP_START
    return STEP_TAIL


@wp.func(inline=True)
def step_powers(step: int, a: Any, b: Any, merge_kind: int, floor: Any):
    """Return the `sfm_powers` of a step, which is of no other kind if they are to mean anything."""
    one = type(floor)(1.0)
    if step == STEP_MERGE and merge_kind == MERGE_SMOOTH:
        return sfm_powers(a, b, floor)
    return one, one


@wp.func(inline=True)
def take_step(step: int, a: Any, b: Any, beta: Any, front: Any, back: Any, merge_kind: int, mix: int):
    """Return the running slab after a step that is not a start, given its `step_powers`."""
    if step == STEP_TAIL:
        return over(a, b)
    if merge_kind == MERGE_SMOOTH:
        return sfm(a, b, beta, mix, front, back)
    return ofm(a, b, mix)


@wp.func(inline=True)
def take_step_adjoint(
    step: int, g: Any, a: Any, b: Any, beta: Any, front: Any, back: Any, merge_kind: int, mix: int, floor: Any
):
    """Return the gradients in a, b and beta of <g, take_step(...)>."""
    if step == STEP_MERGE and merge_kind == MERGE_SMOOTH:
        return sfm_adjoint(g, a, b, beta, mix, floor, front, back)
    if step == STEP_MERGE:
        ofm_a, ofm_b = ofm_adjoint(g, a, b, mix)
        return ofm_a, ofm_b, type(beta)(0.0)
    over_a, over_b = over_adjoint(g, a, b)
    return over_a, over_b, type(beta)(0.0)


@wp.func(inline=True)
def zero_slab(zero: Any):
    """Return the slab whose every component is the given zero; its type sets the precision."""
    return slab(wp.vector(zero, zero, zero), zero, zero, zero, zero, zero, zero)


@wp.func(inline=True)
def replay(pixels: Any, pixel: int, merge_kind: int, mix: int, scratch: Any, base: int):
    """Walk through a pixel's fragments, record every position in `scratch`, and return the number of layers."""
    begin = pixels.offsets[pixel]
    count = pixels.offsets[pixel + 1] - begin
    beta = pixel_beta(pixels, pixel)
    sort_pixel(pixels, begin, count, scratch.order, base)
    layer = int(0)
    through = type(beta)(1.0)
    running = zero_slab(type(beta)(0.0))
    for position in range(count):
        following = load_slab(pixels, scratch.order[base + position], merge_kind)
        step = int(STEP_START)
        if position > 0:
            step = choose_step(running, following, layer, pixels.max_layers, merge_kind)
        if step == STEP_START:
            if position > 0:
                layer += 1
                through *= running.t
            running = following
        else:
            front, back = step_powers(step, running, following, merge_kind, pixels.floor)
            running = take_step(step, running, following, beta, front, back, merge_kind, mix)
            scratch.front[base + position] = front
            scratch.back[base + position] = back
        scratch.step[base + position] = step
        scratch.fragment[base + position] = following
        scratch.running[base + position] = running
        scratch.through[base + position] = through
    return wp.where(count > 0, layer + 1, 0)
