"""Exact merging: all slabs of a pixel at once, instead of one after the other.

All fronts and backs cut the ray into intervals. In each, the parts of the slabs that fill it are mixed, and intervals
are composited by over: colour = sum_k P_k c_k with P_k the transmittance before interval k. A connected run of
overlapping slabs becomes a layer; what does not fit into `max_layers` is composited into the last one.

The result does not depend on any sequence: it is symmetric in the fragments, and continuous in depth and thickness
while t > 0. The cost of a pixel is that of sorting plus one step for every pair of an interval and a slab in it.

The opacity of a layer is that of its fragments, 1 - prod T_i, and has a gradient in nothing else. For the colour the
way back sweeps twice. First it records P_k, tau_k and <g, c_k>, from which follows <g, B_k>, B the colour behind. Then,
with dL/dc_k = P_k g and dL/dtau_k = P_k <g, B_k>, it takes the adjoint of each interval. Each thread has memory for
the fragments of one pixel. Differentiable in colour, opacity, depth, thickness, opacity sum and beta (also by
fragment); the order of the boundaries, runs and what falls into the tail are held fixed.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.operators import Operator
from warpfrag.arrays.precisions import kernels
from warpfrag.arrays.scratch import ROW_GAP, fill_rows, row_bytes
from warpfrag.fragments import LAYER_OUTPUTS, Fragments
from warpfrag.resolve.exact.interval import blend, blend_adjoint, move_boundary
from warpfrag.resolve.exact.sweep import (
    BETA_FRAGMENT,
    BETA_ONE,
    BETA_PIXEL,
    BY_INTERVAL,
    FORWARD_SCRATCH,
    IntervalScratch,
    Sweep,
    advance,
    fragment_beta,
    in_progress,
    leave,
    load_pixel,
    nearest_depth,
)
from warpfrag.resolve.options import MERGE_INPUTS, MergeOptions, merge_inputs, sum_beta
from warpfrag.resolve.pixel import valid_beta
from warpfrag.resolve.sinks import LAYERS, Seen, Sink
from warpfrag.resolve.walk import MIX_KINDS, lists_to_resolve
from warpfrag.slabs.lists import (
    FragmentGradients,
    FragmentLists,
    fragment_gradients,
    longest_list,
    no_invalid,
    report_invalid,
    store_gradient,
    valid_fragment,
)
from warpfrag.slabs.slab import Slab, finite

wp.set_module_options({"enable_backward": False})

BETA_SHAPES = {"one": BETA_ONE, "pixel": BETA_PIXEL, "fragment": BETA_FRAGMENT}


@dataclass(frozen=True)
class ExactOptions:
    """How many layers, how they mix, and whether beta is "one", by "pixel" or by "fragment"; see `resolve`."""

    max_layers: int
    mix: str
    beta_per: str

    def sizes(self) -> dict[str, int]:
        """Return the number of layers."""
        return {"M": self.max_layers}


@kernels
def exact_fwd(number: Any, mix: int, beta_per: int, sink: Sink) -> Any:
    """Return the kernel that resolves pixels into a sink, all slabs at once."""
    slab, sweep_type, seen_type, out_type = Slab[number], Sweep[number], Seen[number], sink.arrays[number]
    put, finish = sink.put, sink.finish

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        scratch: IntervalScratch[number],
        invalid: wp.array2d(dtype=int),
        out: out_type,
    ):
        """Resolve pixels.

        Args:
            span: pixels.
            lists: their fragments.
            scratch: scratch memory, a row for each thread.
            invalid: output: what `no_invalid` says, (threads, 2).
            out: output: the sink's arrays.
        """
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = lists.offsets[pixel]
            count = lists.offsets[pixel + 1] - begin
            nearest = nearest_depth(lists, begin, count)
            load_pixel(lists, begin, count, nearest, scratch, base)
            for fragment in range(begin, begin + count):
                if not valid_fragment(lists, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                if not valid_beta(fragment_beta(lists, pixel, fragment, beta_per)):
                    wp.atomic_min(invalid, span.worker, 1, wp.where(beta_per == BETA_FRAGMENT, fragment, pixel))
            seen = seen_type()
            seen.through = number(1.0)
            running = slab()
            running.transmittance = number(1.0)
            opacity_sum = number(0.0)
            through = number(1.0)
            first = number(0.0)
            layer = int(-1)
            sweep = sweep_type()
            # At most two intervals a fragment, whatever is in the arrays.
            steps = int(0)
            while in_progress(sweep, count) and steps < 2 * count:
                steps += 1
                sweep = advance(sweep, scratch, base, count, layer < lists.max_layers - 1)
                if sweep.fresh:
                    # In the tail a run goes on behind what its layer has already.
                    through = running.transmittance
                    if layer < lists.max_layers - 1:
                        if layer >= 0:
                            seen = put(out, seen, running, opacity_sum, pixel, layer)
                        layer += 1
                        running = slab()
                        running.transmittance = number(1.0)
                        first = sweep.begin
                        opacity_sum = number(0.0)
                        through = number(1.0)
                for position in range(sweep.entered, sweep.following):
                    running.opacity += running.transmittance * scratch.fragment[base + position].opacity
                    running.transmittance *= scratch.fragment[base + position].transmittance
                part_color, tau, part_sum = blend(sweep, lists, pixel, scratch, base, mix, beta_per)
                running.color += through * part_color
                through *= tau
                opacity_sum += part_sum
                running.back = nearest + sweep.end
                running.thickness = sweep.end - first
                sweep = leave(sweep, scratch, base)
            if layer >= 0:
                seen = put(out, seen, running, opacity_sum, pixel, layer)
            finish(out, seen, pixel, layer + 1, lists.max_layers)

    return kernel


@wp.func(inline=True)
def layer_gradient(grads: Any, pixel: int, layer: int, zero: Any):
    """Return the gradient in a layer's colour."""
    color = wp.vector(zero, zero, zero)
    if grads.rgba.shape[0] > 0:
        rgba = grads.rgba[pixel, layer]
        color = wp.vector(rgba[0], rgba[1], rgba[2])
    return color


@wp.func(inline=True)
def show_intervals(sweep: Any, lists: Any, pixel: int, scratch: Any, base: int, grads: Any, mix: int, beta_per: int):
    """Sweep once: record of each interval what is before it, what it passes, and <g, its colour>.

    Returns:
        The number of intervals, and the last layer.
    """
    count = lists.offsets[pixel + 1] - lists.offsets[pixel]
    zero = type(sweep.end)(0.0)
    layer = int(-1)
    through = type(sweep.end)(1.0)
    clear = type(sweep.end)(1.0)
    g = wp.vector(zero, zero, zero)
    steps = int(0)
    while in_progress(sweep, count) and steps < 2 * count:
        sweep = advance(sweep, scratch, base, count, layer < lists.max_layers - 1)
        if sweep.fresh:
            through = clear
            if layer < lists.max_layers - 1:
                layer += 1
                through = type(zero)(1.0)
                clear = type(zero)(1.0)
                g = layer_gradient(grads, pixel, layer, zero)
        for position in range(sweep.entered, sweep.following):
            scratch.others[base + position] = clear
            scratch.fragment_layer[base + position] = layer
            clear *= scratch.fragment[base + position].transmittance
        part_color, tau, part_sum = blend(sweep, lists, pixel, scratch, base, mix, beta_per)
        scratch.through[2 * base + steps] = through
        scratch.tau[2 * base + steps] = tau
        scratch.behind[2 * base + steps] = wp.dot(g, part_color)
        scratch.layer[2 * base + steps] = layer
        through *= tau
        sweep = leave(sweep, scratch, base)
        steps += 1
    return steps, layer


@wp.func(inline=True)
def look_behind(scratch: Any, base: int, interval_count: int, last_layer: int, zero: Any):
    """Turn <g, colour> of each interval into <g, B>, B the colour behind it in its layer: B_{k-1} = c_k + tau_k B_k."""
    behind = type(zero)(0.0)
    following_layer = int(last_layer)
    for back in range(interval_count):
        at = 2 * base + interval_count - 1 - back
        if scratch.layer[at] != following_layer:
            behind = type(zero)(0.0)
        following_layer = scratch.layer[at]
        visible = scratch.behind[at]
        scratch.behind[at] = behind
        behind = visible + scratch.tau[at] * behind


@wp.func(inline=True)
def begin_gradients(scratch: Any, base: int, count: int, last_layer: int, pixel: int, grads: Any, zero: Any):
    """Begin every fragment's gradient with that of its layer's opacity, 1 - prod T_i; and its state with its front."""
    clear = type(zero)(1.0)
    following_layer = int(last_layer)
    for back in range(count):
        at = base + count - 1 - back
        own_layer = scratch.fragment_layer[at]
        if own_layer != following_layer:
            clear = type(zero)(1.0)
        following_layer = own_layer
        grad = type(scratch.grad[at])()
        if grads.rgba.shape[0] > 0:
            grad.opacity = grads.rgba[pixel, own_layer][3] * scratch.others[at] * clear
        clear *= scratch.fragment[at].transmittance
        scratch.grad[at] = grad
        scratch.grad_beta[at] = zero
        scratch.grad_rest[at] = zero
        scratch.rest[at] = type(zero)(1.0)
        scratch.cut[at] = zero
        scratch.power[at] = type(zero)(1.0)


@wp.func(inline=True)
def take_back(
    sweep: Any,
    lists: Any,
    pixel: int,
    scratch: Any,
    base: int,
    grads: Any,
    interval_count: int,
    mix: int,
    beta_per: int,
    zero: Any,
):
    """Sweep again: dL/dc_k = P_k g and dL/dtau_k = P_k <g, B_k> go to the fragments, and layers' ends to boundaries."""
    count = lists.offsets[pixel + 1] - lists.offsets[pixel]
    layer = int(-1)
    g = wp.vector(zero, zero, zero)
    g_sum = type(zero)(0.0)
    for interval in range(interval_count):
        at = 2 * base + interval
        sweep = advance(sweep, scratch, base, count, layer < lists.max_layers - 1)
        if scratch.layer[at] != layer:
            layer = scratch.layer[at]
            g = layer_gradient(grads, pixel, layer, zero)
            if grads.opacity_sum.shape[0] > 0:
                g_sum = grads.opacity_sum[pixel, layer]
            if grads.thickness.shape[0] > 0:
                move_boundary(-grads.thickness[pixel, layer], sweep.begin_boundary, scratch, base)
        through = scratch.through[at]
        g_tau = through * scratch.behind[at]
        blend_adjoint(through * g, g_tau, g_sum, sweep, lists, pixel, scratch, base, mix, beta_per)
        sweep = leave(sweep, scratch, base)
        ends_layer = interval == interval_count - 1
        if not ends_layer:
            ends_layer = scratch.layer[at + 1] != layer
        if ends_layer:
            g_back = type(zero)(0.0)
            if grads.depth.shape[0] > 0:
                g_back += grads.depth[pixel, layer]
            if grads.thickness.shape[0] > 0:
                g_back += grads.thickness[pixel, layer]
            move_boundary(g_back, sweep.end_boundary, scratch, base)


@kernels
def exact_bwd(number: Any, mix: int, beta_per: int) -> Any:
    """Return the kernel of the way back from layers."""
    sweep_type, out_type = Sweep[number], LAYERS.arrays[number]

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        scratch: IntervalScratch[number],
        grad_out: out_type,
        grads: FragmentGradients[number],
    ):
        """Take the gradient back through pixels.

        Args:
            span: pixels.
            lists: their fragments.
            scratch: scratch memory, a row for each thread.
            grad_out: gradients of the layers.
            grads: output: gradients of the fragments, and of beta by pixel or fragment.
        """
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = lists.offsets[pixel]
            count = lists.offsets[pixel + 1] - begin
            zero = number(0.0)
            load_pixel(lists, begin, count, nearest_depth(lists, begin, count), scratch, base)
            interval_count, last_layer = show_intervals(
                sweep_type(), lists, pixel, scratch, base, grad_out, mix, beta_per
            )
            look_behind(scratch, base, interval_count, last_layer, zero)
            begin_gradients(scratch, base, count, last_layer, pixel, grad_out, zero)
            take_back(sweep_type(), lists, pixel, scratch, base, grad_out, interval_count, mix, beta_per, zero)
            g_beta = number(0.0)
            for position in range(count):
                fragment = scratch.order[base + position]
                store_gradient(scratch.grad[base + position], lists, fragment, grads)
                g_own = finite(scratch.grad_beta[base + position])
                g_beta += g_own
                if beta_per == BETA_FRAGMENT and grads.beta.shape[0] > 0:
                    grads.beta[fragment] = g_own
            if beta_per != BETA_FRAGMENT and grads.beta.shape[0] > 0:
                grads.beta[pixel] = g_beta

    return kernel


def exact_forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: ExactOptions) -> None:
    """Fill the layers of all pixels; raise if there are invalid values."""
    number, device, pixel_count = inputs.rgba.dtype, inputs.rgba.device, inputs.offsets.shape[0] - 1
    scratch = IntervalScratch[number]()
    scratch.length = longest_list(inputs.offsets, inputs.rgba.shape[0]) + ROW_GAP
    rows = worker_count(pixel_count, device, row_bytes(scratch, scratch.length, FORWARD_SCRATCH))
    fill_rows(scratch, rows, scratch.length, device, FORWARD_SCRATCH)
    invalid = no_invalid(rows, device)
    kernel = exact_fwd(number, MIX_KINDS[options.mix], BETA_SHAPES[options.beta_per], LAYERS)
    lists = lists_to_resolve(inputs, options.mix, options.max_layers)
    launch(kernel, pixel_count, [lists, scratch, invalid, LAYERS.fill(outputs, number)], device, rows)
    report_invalid(invalid, inputs, "fragment" if options.beta_per == "fragment" else "pixel")


def exact_backward(
    inputs: SimpleNamespace, grad_outputs: SimpleNamespace, targets: SimpleNamespace, options: ExactOptions
) -> None:
    """Fill those gradients of the inputs that are not None, given those of the layers."""
    number, device, pixel_count = inputs.rgba.dtype, inputs.rgba.device, inputs.offsets.shape[0] - 1
    scratch = IntervalScratch[number]()
    scratch.length = longest_list(inputs.offsets, inputs.rgba.shape[0]) + ROW_GAP
    rows = worker_count(pixel_count, device, row_bytes(scratch, scratch.length, twice=BY_INTERVAL))
    fill_rows(scratch, rows, scratch.length, device, twice=BY_INTERVAL)
    grads = fragment_gradients(targets, number)
    by_fragment = options.beta_per == "fragment"
    if targets.beta is not None:
        grads.beta = targets.beta if by_fragment else wp.empty(pixel_count, dtype=number, device=device)
    kernel = exact_bwd(number, MIX_KINDS[options.mix], BETA_SHAPES[options.beta_per])
    lists = lists_to_resolve(inputs, options.mix, options.max_layers)
    launch(kernel, pixel_count, [lists, scratch, LAYERS.fill(grad_outputs, number), grads], device, rows)
    if targets.beta is not None and not by_fragment:
        sum_beta(grads.beta, targets.beta)


RESOLVE_EXACT = Operator("resolve_exact", MERGE_INPUTS, LAYER_OUTPUTS, exact_forward, exact_backward, ExactOptions)


def exact_inputs(
    fragments: Fragments, beta: Any, options: MergeOptions, *, dimensions: int
) -> tuple[dict[str, Any], ExactOptions]:
    """Return inputs and options of exact merging; beta may also be one value per fragment, (F,).

    Args:
        fragments: what to merge.
        beta: see `resolve`.
        options: see `resolve`.
        dimensions: how many the outputs have beside those of the pixel grid.
    """
    inputs = merge_inputs(fragments, beta, dimensions=dimensions, by_fragment=True)
    beta_per = "one" if inputs["beta"].shape[0] == 1 else "fragment"
    if beta_per == "fragment" and tuple(beta.shape) == tuple(fragments.shape):
        beta_per = "pixel"
    return inputs, ExactOptions(options.max_layers, options.mix, beta_per)
