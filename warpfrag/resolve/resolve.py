"""The resolve pass: N fragments of a pixel become at most M layers (fragment merging, Algorithm 1).

    running = fragment 0;  for each following fragment, in order of depth:
        overlapping:             running = sfm(running, following)       (or ofm)
        M - 1 layers not full:   put out running, running = following
        else:                    running = over(running, following)      (tail)

The gradient of a step is the operator's own vector-Jacobian product, applied in reverse order to the states that
`resolve_bwd` recomputes. Differentiable in colour, opacity, depth, thickness, opacity sum and beta; which fragments
merge, their order, and what falls into the tail are held fixed.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span
from warpfrag.arrays.legacy import Operator, apply
from warpfrag.fragments import Fragments, Layers
from warpfrag.resolve.arguments import (
    FRAGMENT_DIFFERENTIABLE,
    FRAGMENT_TENSORS,
    GRADIENTS,
    MERGE_OPTIONS,
    PIXELS,
    SCRATCH,
    Merge,
    Mix,
    Walk,
    check_options,
    fragment_inputs,
)
from warpfrag.resolve.exact.exact import RESOLVE_EXACT, apply_exact
from warpfrag.resolve.walk import (
    STEP_START,
    choose_step,
    load_slab,
    pixel_beta,
    replay,
    sort_pixel,
    step_powers,
    store_grad,
    take_step,
    take_step_adjoint,
    valid_beta,
    valid_fragment,
    zero_slab,
)

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def store_layer(s: Any, pixel: int, layer: int, rgba: Any, depth: Any, thickness: Any, opacity_sum: Any):
    """Write a slab as a layer of a pixel."""
    rgba[pixel, layer, 0] = s.c[0]
    rgba[pixel, layer, 1] = s.c[1]
    rgba[pixel, layer, 2] = s.c[2]
    rgba[pixel, layer, 3] = s.a
    depth[pixel, layer] = s.z
    thickness[pixel, layer] = s.z - s.f
    opacity_sum[pixel, layer] = s.a * s.w


@wp.func(inline=True)
def load_layer_grad(s: Any, pixel: int, layer: int, rgba: Any, depth: Any, thickness: Any, opacity_sum: Any):
    """Return the cotangent of a layer's slab s, given those of the layer's outputs; empty arrays stand for zeros."""
    zero = type(s.a)(0.0)
    g = zero_slab(zero)
    if rgba.shape[0] > 0:
        g.c = wp.vector(rgba[pixel, layer, 0], rgba[pixel, layer, 1], rgba[pixel, layer, 2])
        g.a = rgba[pixel, layer, 3]
    if depth.shape[0] > 0:
        g.z = depth[pixel, layer]
    if thickness.shape[0] > 0:
        g.z = g.z + thickness[pixel, layer]
        g.f = -thickness[pixel, layer]
    if opacity_sum.shape[0] > 0:
        g.a = g.a + opacity_sum[pixel, layer] * s.w
        g.w = opacity_sum[pixel, layer] * s.a
    return g


@cache
def _forward_kernel(scalar: Any, merge_kind: int, mix: int) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def resolve_fwd(
        span: Span,
        pixels: PIXELS[scalar],
        order: wp.array(dtype=int),
        length: int,
        invalid: wp.array2d(dtype=int),
        rgba: wp.array3d(dtype=scalar),
        depth: wp.array2d(dtype=scalar),
        thickness: wp.array2d(dtype=scalar),
        opacity_sum: wp.array2d(dtype=scalar),
        layer_count: wp.array(dtype=int),
    ):
        base = (span.worker + wp.tid()) * length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            count = pixels.offsets[pixel + 1] - begin
            beta = pixel_beta(pixels, pixel)
            if not valid_beta(pixels, pixel):
                wp.atomic_min(invalid, span.worker, 1, pixel)
            sort_pixel(pixels, begin, count, order, base)
            running = zero_slab(scalar(0.0))
            layer = int(0)
            for position in range(count):
                fragment = order[base + position]
                if not valid_fragment(pixels, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                following = load_slab(pixels, fragment, merge_kind)
                step = int(STEP_START)
                if position > 0:
                    step = choose_step(running, following, layer, pixels.max_layers, merge_kind)
                if step == STEP_START:
                    if position > 0:
                        store_layer(running, pixel, layer, rgba, depth, thickness, opacity_sum)
                        layer += 1
                    running = following
                else:
                    front, back = step_powers(step, running, following, merge_kind, pixels.floor)
                    running = take_step(step, running, following, beta, front, back, merge_kind, mix)
            if count > 0:
                store_layer(running, pixel, layer, rgba, depth, thickness, opacity_sum)
                layer += 1
            layer_count[pixel] = layer
            for unused in range(layer, pixels.max_layers):
                store_layer(zero_slab(scalar(0.0)), pixel, unused, rgba, depth, thickness, opacity_sum)

    return resolve_fwd


@cache
def _backward_kernel(scalar: Any, merge_kind: int, mix: int) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def resolve_bwd(
        span: Span,
        pixels: PIXELS[scalar],
        scratch: SCRATCH[scalar],
        grad_rgba: wp.array3d(dtype=scalar),
        grad_depth: wp.array2d(dtype=scalar),
        grad_thickness: wp.array2d(dtype=scalar),
        grad_opacity_sum: wp.array2d(dtype=scalar),
        grads: GRADIENTS[scalar],
    ):
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            count = pixels.offsets[pixel + 1] - pixels.offsets[pixel]
            beta = pixel_beta(pixels, pixel)
            layer = replay(pixels, pixel, merge_kind, mix, scratch, base)
            g = zero_slab(scalar(0.0))
            g_beta = scalar(0.0)
            ends_layer = bool(True)
            for back in range(count):
                at = base + count - 1 - back
                step = scratch.step[at]
                if ends_layer:
                    layer -= 1
                    g = load_layer_grad(
                        scratch.running[at], pixel, layer, grad_rgba, grad_depth, grad_thickness, grad_opacity_sum
                    )
                ends_layer = step == STEP_START
                g_fragment = g
                if step != STEP_START:
                    g_running, g_following, g_step = take_step_adjoint(
                        step,
                        g,
                        scratch.running[at - 1],
                        scratch.fragment[at],
                        beta,
                        scratch.front[at],
                        scratch.back[at],
                        merge_kind,
                        mix,
                        pixels.floor,
                    )
                    g = g_running
                    g_fragment = g_following
                    g_beta += g_step
                store_grad(g_fragment, pixels, scratch.order[at], grads)
            if grads.beta.shape[0] > 0:
                grads.beta[pixel] = g_beta

    return resolve_bwd


def _output_like(inputs: Sequence[Any], max_layers: int, merge: str, mix: str) -> list[tuple[tuple[int, ...], str]]:
    pixel_count = inputs[3].shape[0] - 1
    per_layer = ((pixel_count, max_layers), "float")
    return [((pixel_count, max_layers, 4), "float"), per_layer, per_layer, per_layer, ((pixel_count,), "int32")]


def _forward(inputs: Sequence[Any], outputs: Sequence[Any], **options: Any) -> None:
    walk = Walk(inputs, **options)
    walk.forward(_forward_kernel, outputs)


def _backward(inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], **options: Any) -> None:
    walk = Walk(inputs, **options)
    grads = [walk.optional(grad, ndim) for grad, ndim in zip(grad_outputs[:4], (3, 2, 2, 2), strict=True)]
    walk.backward(_backward_kernel, grads, grad_inputs)


_RESOLVE = Operator(
    name="resolve",
    tensors=FRAGMENT_TENSORS,
    differentiable=FRAGMENT_DIFFERENTIABLE,
    outputs=("rgba", "depth", "thickness", "opacity_sum", "count"),
    output_like=_output_like,
    forward=_forward,
    backward=_backward,
    options=MERGE_OPTIONS,
)


def resolve(
    fragments: Fragments,
    beta: Any = 1.0,
    max_layers: int = 8,
    merge: Merge = "smooth",
    mix: Mix = "opacity",
) -> Layers:
    """Merge the fragments of every pixel into at most `max_layers` layers (fragment merging, Algorithm 1).

    Differentiable in the fragments' colour, opacity, depth, thickness and opacity sum, and in beta; which fragments
    merge, their order, and what falls into the tail are held fixed.

    Args:
        fragments: what to merge, in any order.
        beta: how a slab fills up from its front to its back (eq. 4): 0 optically (exponential), 1 linearly. A number
            from 0 to 1, a 0-d array, or one value per pixel; with "exact" also one per fragment, (F,).
        max_layers: largest number M of layers per pixel; what does not fit is composited into the last.
        merge: "smooth" subdivides overlapping slabs one after the other (SFM); "exact" subdivides all at once, which is
            symmetric in the fragments and continuous in depth and thickness; "order_independent" mixes overlapping
            slabs whole (OFM); "none" keeps every fragment by itself.
        mix: weights of the colours of mixed parts: "opacity" (fragment merging, eq. 8), "average" (zSlab eq. 4.4) or
            "optical_depth" (as deep images are flattened). "average" does not go with "exact".

    Returns:
        The layers, in the kind and precision of the fragments' arrays.

    Raises:
        TypeError: an argument is of the wrong type, or beta of another kind or precision than the fragments.
        ValueError: an option does not exist, or values are not finite or out of range.
    """
    check_options(merge, mix, max_layers)
    if merge == "exact":
        arrays = apply_exact(RESOLVE_EXACT, fragments, beta, dimensions=2, max_layers=max_layers, mix=mix)
    else:
        options = {"max_layers": max_layers, "merge": merge, "mix": mix}
        arrays = apply(_RESOLVE, fragment_inputs(fragments, beta, dimensions=2), **options)
    rgba, depth, thickness, opacity_sum, count = arrays
    grid = fragments.shape
    return Layers(
        rgba.reshape((*grid, max_layers, 4)),
        depth.reshape((*grid, max_layers)),
        thickness.reshape((*grid, max_layers)),
        opacity_sum.reshape((*grid, max_layers)),
        count.reshape(grid),
    )
