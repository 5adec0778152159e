"""The walk through the fragments of a pixel: sorted, the running slab takes one after the other; and the way back.

    running = fragment 0;  for each following fragment, in order of depth:
        overlapping:             running = sfm(running, following)       (or ofm)
        M - 1 layers not full:   put out running, running = following
        else:                    running = over(running, following)      (tail)

The way back needs the running slab before each step; `replay` recomputes all of them into scratch memory that belongs
to the thread, so the forward pass stores nothing for the gradient. Then the steps' vector-Jacobian products are applied
in reverse. Which fragments merge, their order and what falls into the tail are held fixed.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.precisions import kernels
from warpfrag.arrays.scratch import ROW_GAP, fill_rows, row_bytes
from warpfrag.resolve.options import MergeOptions, sum_beta
from warpfrag.resolve.pixel import Replay, pixel_beta, sort_pixel, valid_beta
from warpfrag.resolve.sinks import Seen, Sink
from warpfrag.resolve.steps import (
    MERGE_NONE,
    MERGE_ORDER_INDEPENDENT,
    MERGE_SMOOTH,
    STEP_START,
    choose_step,
    step_powers,
    take_step,
    take_step_adjoint,
)
from warpfrag.slabs.lists import (
    FragmentGradients,
    FragmentLists,
    fragment_gradients,
    fragment_lists,
    load_slab,
    longest_list,
    no_invalid,
    report_invalid,
    store_gradient,
    valid_fragment,
)
from warpfrag.slabs.mix import MIX_AVERAGE, MIX_OPACITY, MIX_OPTICAL_DEPTH
from warpfrag.slabs.slab import LOG_FLOOR, LOG_OPAQUE, Slab, finite

wp.set_module_options({"enable_backward": False})

MERGE_KINDS = {"none": MERGE_NONE, "smooth": MERGE_SMOOTH, "order_independent": MERGE_ORDER_INDEPENDENT}
MIX_KINDS = {"opacity": MIX_OPACITY, "average": MIX_AVERAGE, "optical_depth": MIX_OPTICAL_DEPTH}


@kernels
def resolve_fwd(number: Any, merge: int, mix: int, sink: Sink) -> Any:
    """Return the kernel that resolves pixels into a sink."""
    slab, seen_type, out_type, put, finish = Slab[number], Seen[number], sink.arrays[number], sink.put, sink.finish

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        order: wp.array(dtype=int),
        length: int,
        invalid: wp.array2d(dtype=int),
        out: out_type,
    ):
        """Resolve pixels.

        Args:
            span: pixels.
            lists: their fragments, and how they merge.
            order: scratch memory, `length` for each thread.
            length: of a thread's row.
            invalid: output: what `no_invalid` says, (threads, 2).
            out: output: the sink's arrays.
        """
        base = (span.worker + wp.tid()) * length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = lists.offsets[pixel]
            count = lists.offsets[pixel + 1] - begin
            beta = pixel_beta(lists, pixel)
            wants_log = merge == MERGE_SMOOTH or mix == MIX_OPTICAL_DEPTH
            if not valid_beta(beta):
                wp.atomic_min(invalid, span.worker, 1, pixel)
            sort_pixel(lists, begin, count, order, base)
            running = slab()
            seen = seen_type()
            seen.through = number(1.0)
            layer = int(0)
            for position in range(count):
                fragment = order[base + position]
                if not valid_fragment(lists, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                following = load_slab(lists, fragment, running, wants_log)
                step = int(STEP_START)
                if position > 0:
                    step = choose_step(running, following, layer, lists.max_layers, merge)
                if step == STEP_START:
                    if position > 0:
                        seen = put(out, seen, running, running.opacity * running.weight, pixel, layer)
                        layer += 1
                    running = following
                else:
                    through_front, through_back = step_powers(step, running, following, merge, lists.floor)
                    running = take_step(step, running, following, beta, through_front, through_back, merge, mix)
            if count > 0:
                seen = put(out, seen, running, running.opacity * running.weight, pixel, layer)
                layer += 1
            finish(out, seen, pixel, layer, lists.max_layers)

    return kernel


@wp.func(inline=True)
def replay(lists: Any, pixel: int, merge: int, mix: int, scratch: Any, base: int):
    """Walk through a pixel's fragments, record every position in `scratch`, and return the number of layers."""
    begin = lists.offsets[pixel]
    count = lists.offsets[pixel + 1] - begin
    beta = pixel_beta(lists, pixel)
    wants_log = merge == MERGE_SMOOTH or mix == MIX_OPTICAL_DEPTH
    sort_pixel(lists, begin, count, scratch.order, base)
    layer = int(0)
    through = type(beta)(1.0)
    running = type(scratch.running[base])()
    for position in range(count):
        following = load_slab(lists, scratch.order[base + position], running, wants_log)
        step = int(STEP_START)
        if position > 0:
            step = choose_step(running, following, layer, lists.max_layers, merge)
        if step == STEP_START:
            if position > 0:
                layer += 1
                through *= running.transmittance
            running = following
        else:
            through_front, through_back = step_powers(step, running, following, merge, lists.floor)
            running = take_step(step, running, following, beta, through_front, through_back, merge, mix)
            scratch.through_front[base + position] = through_front
            scratch.through_back[base + position] = through_back
        scratch.step[base + position] = step
        scratch.fragment[base + position] = following
        scratch.running[base + position] = running
        scratch.through[base + position] = through
    return wp.where(count > 0, layer + 1, 0)


@kernels
def resolve_bwd(number: Any, merge: int, mix: int, sink: Sink) -> Any:
    """Return the kernel of the way back from a sink."""
    slab, seen_type, out_type, cotangent = Slab[number], Seen[number], sink.arrays[number], sink.cotangent

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        scratch: Replay[number],
        grad_out: out_type,
        grads: FragmentGradients[number],
    ):
        """Take the gradient back through pixels.

        Args:
            span: pixels.
            lists: their fragments, and how they merge.
            scratch: scratch memory, a row for each thread.
            grad_out: gradients of the sink's arrays.
            grads: output: gradients of the fragments, and of beta by pixel, (P,).
        """
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            count = lists.offsets[pixel + 1] - lists.offsets[pixel]
            beta = pixel_beta(lists, pixel)
            layer = replay(lists, pixel, merge, mix, scratch, base)
            behind = seen_type()
            behind.through = number(1.0)
            g = slab()
            g_beta = number(0.0)
            ends_layer = bool(True)
            for back in range(count):
                at = base + count - 1 - back
                step = scratch.step[at]
                if ends_layer:
                    layer -= 1
                    g, behind = cotangent(grad_out, behind, scratch.running[at], scratch.through[at], pixel, layer)
                ends_layer = step == STEP_START
                g_fragment = g
                if step != STEP_START:
                    g_running, g_following, g_step = take_step_adjoint(
                        step,
                        g,
                        scratch.running[at - 1],
                        scratch.fragment[at],
                        beta,
                        scratch.through_front[at],
                        scratch.through_back[at],
                        merge,
                        mix,
                        lists.floor,
                    )
                    g = g_running
                    g_fragment = g_following
                    g_beta += g_step
                store_gradient(g_fragment, lists, scratch.order[at], grads)
            if grads.beta.shape[0] > 0:
                grads.beta[pixel] = finite(g_beta)

    return kernel


def lists_to_resolve(inputs: SimpleNamespace, mix: str, max_layers: int) -> Any:
    """Return fragments as kernels take them that resolve them."""
    lists = fragment_lists(inputs)
    lists.floor = LOG_OPAQUE if mix == "optical_depth" else LOG_FLOOR
    lists.max_layers = max_layers
    return lists


def ingredients(inputs: SimpleNamespace, options: MergeOptions) -> tuple[Any, int, int]:
    """Return number, merge and mix of a kernel; without merging nothing is mixed: one kernel serves every mix."""
    mix = "opacity" if options.merge == "none" else options.mix
    return inputs.rgba.dtype, MERGE_KINDS[options.merge], MIX_KINDS[mix]


def walk_forward(kernel: wp.Kernel, inputs: SimpleNamespace, options: MergeOptions, out: Any) -> None:
    """Run a kernel such as `resolve_fwd` over all pixels.

    Raises:
        ValueError: it found invalid values.
    """
    device, pixel_count = inputs.rgba.device, inputs.offsets.shape[0] - 1
    length = longest_list(inputs.offsets, inputs.rgba.shape[0]) + ROW_GAP
    rows = worker_count(pixel_count, device, 4 * length)
    order = wp.empty(rows * length, dtype=wp.int32, device=device)
    invalid = no_invalid(rows, device)
    lists = lists_to_resolve(inputs, options.mix, options.max_layers)
    launch(kernel, pixel_count, [lists, order, length, invalid, out], device, rows)
    report_invalid(invalid, inputs)


def walk_backward(
    kernel: wp.Kernel, inputs: SimpleNamespace, options: MergeOptions, grad_out: Any, targets: SimpleNamespace
) -> None:
    """Run a kernel such as `resolve_bwd` over all pixels; fills those gradients of the inputs that are not None."""
    number, device, pixel_count = inputs.rgba.dtype, inputs.rgba.device, inputs.offsets.shape[0] - 1
    scratch = Replay[number]()
    scratch.length = longest_list(inputs.offsets, inputs.rgba.shape[0]) + ROW_GAP
    rows = worker_count(pixel_count, device, row_bytes(scratch, scratch.length))
    fill_rows(scratch, rows, scratch.length, device)
    grads = fragment_gradients(targets, number)
    if targets.beta is not None:
        grads.beta = wp.empty(pixel_count, dtype=number, device=device)
    lists = lists_to_resolve(inputs, options.mix, options.max_layers)
    launch(kernel, pixel_count, [lists, scratch, grad_out, grads], device, rows)
    if targets.beta is not None:
        sum_beta(grads.beta, targets.beta)
