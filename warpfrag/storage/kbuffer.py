"""The bounded k-buffer: fragments of a pixel, as they come, into K slots (fragment merging 4.2: SKB and SKB+OFM).

`slots.py` has the rules. A layer is a function of its members alone, whatever their order:

    q = sum C_i w_i,  A = 1 - prod (1 - A_i),  S = sum S_i,  C = q A/S,  z = max z_i,  t = z - min (z_i - t_i)

so the way back needs no sequence of states. `kbuffer_bwd` streams once more to learn which slot each fragment ended in,
sums up the slots, and gives every member its part (`members.py`); z and the front belong to one member each.
Differentiable in colour, opacity, depth, thickness and opacity sum; which fragments share a slot, and which are
dropped, is held fixed.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.legacy import Operator, apply, vectors
from warpfrag.fragments import Fragments, Layers
from warpfrag.resolve.arguments import (
    GRADIENTS,
    PIXELS,
    check_choice,
    fragment_inputs,
    longest_list,
    report_invalid,
    row_length,
)
from warpfrag.resolve.walk import NO_FRAGMENT, valid_fragment
from warpfrag.storage.slot_sums import ZERO, Members, layer_of, member_adjoint, no_members, with_member
from warpfrag.storage.slots import OWNS_SLOT, SLOTS, TAIL_IN_USE, finish_slots, insert, slots_in

wp.set_module_options({"enable_backward": False})

KMerge = Literal["none", "order_independent"]
Tail = Literal["mix", "discard"]

KBUFFER_OPTIONS = {"slots": "int", "merge": "str", "tail": "str"}
LAYER_OUTPUTS = ("rgba", "depth", "thickness", "opacity_sum", "count")


def check_kbuffer(slots: Any, merge: Any, tail: Any) -> None:
    """Raise for a number of slots, a merge or a tail that does not exist."""
    check_choice("merge", merge, get_args(KMerge))
    check_choice("tail", tail, get_args(Tail))
    if isinstance(slots, bool) or not isinstance(slots, (int, np.integer)):
        raise TypeError(f"slots: got {slots!r}, expected a whole number of at least 1")
    if slots < 1:
        raise ValueError(f"slots: got {slots}, expected at least 1")


@wp.func(inline=True)
def stream_fragment(slots: Any, row: int, number: int, pixels: Any, fragment: int, merging: int):
    """Stream a stored fragment, number `number` of its pixel, into the slots of a row."""
    rgba = pixels.rgba[fragment]
    s = rgba[3]
    weighted = rgba
    if pixels.opacity_sum.shape[0] > 0:
        s = pixels.opacity_sum[fragment]
        if rgba[3] > type(s)(0.0):
            weight = s / rgba[3]
            weighted = wp.vector(weight * rgba[0], weight * rgba[1], weight * rgba[2], rgba[3])
    z = pixels.depth[fragment]
    front = z
    if merging != 0:
        front = z - pixels.thickness[fragment]
    insert(slots, row, number, weighted, s, front, z)


@cache
def _forward_kernel(scalar: Any, merging: int) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def kbuffer_fwd(span: Span, pixels: PIXELS[scalar], slots: SLOTS[scalar], invalid: wp.array2d(dtype=int)):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            slots.count[pixel] = 0
            for fragment in range(begin, pixels.offsets[pixel + 1]):
                if not valid_fragment(pixels, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                stream_fragment(slots, pixel, fragment - begin, pixels, fragment, merging)
            finish_slots(slots, pixel)

    return kbuffer_fwd


@cache
def _backward_kernel(scalar: Any, merging: int) -> wp.Kernel:
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def kbuffer_bwd(
        span: Span,
        pixels: PIXELS[scalar],
        slots: SLOTS[scalar],
        length: int,
        members: wp.array2d(dtype=Members),
        grad_rgba: wp.array3d(dtype=scalar),
        grad_depth: wp.array2d(dtype=scalar),
        grad_thickness: wp.array2d(dtype=scalar),
        grad_opacity_sum: wp.array2d(dtype=scalar),
        grads: GRADIENTS[scalar],
    ):
        row = span.worker + wp.tid()
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            end = pixels.offsets[pixel + 1]
            # The numbers of the pixel's fragments in the thread's part of `parent`.
            shift = row * length - begin
            slots.count[row] = 0
            for fragment in range(begin, end):
                stream_fragment(slots, row, shift + fragment, pixels, fragment, merging)
            layer_count = slots.count[row]
            if layer_count >= TAIL_IN_USE:
                layer_count -= TAIL_IN_USE
                slots.owner[row, layer_count] = slots.owner[row, slots.core]
                layer_count += 1
            for layer in range(layer_count):
                slots.parent[slots.owner[row, layer]] = OWNS_SLOT - layer
                members[row, layer] = no_members()
            for fragment in range(begin, end):
                layer = layer_of(slots.parent, shift + fragment)
                if layer >= 0:
                    members[row, layer] = with_member(members[row, layer], pixels, fragment, merging)
            for fragment in range(begin, end):
                layer = layer_of(slots.parent, shift + fragment)
                to_rgba = wp.vec4d()
                to_sum = ZERO
                to_depth = scalar(0.0)
                to_thickness = scalar(0.0)
                if layer >= 0:
                    m = members[row, layer]
                    g = wp.vec4d()
                    if grad_rgba.shape[0] > 0:
                        g = wp.vec4d(
                            wp.float64(grad_rgba[pixel, layer, 0]),
                            wp.float64(grad_rgba[pixel, layer, 1]),
                            wp.float64(grad_rgba[pixel, layer, 2]),
                            wp.float64(grad_rgba[pixel, layer, 3]),
                        )
                    g_sum = ZERO
                    if grad_opacity_sum.shape[0] > 0:
                        g_sum = wp.float64(grad_opacity_sum[pixel, layer])
                    to_rgba, to_sum = member_adjoint(m, g, g_sum, pixels, fragment)
                    if m.back == fragment and grad_depth.shape[0] > 0:
                        to_depth += grad_depth[pixel, layer]
                    if grad_thickness.shape[0] > 0:
                        if m.back == fragment:
                            to_depth += grad_thickness[pixel, layer]
                        if m.front == fragment:
                            to_depth -= grad_thickness[pixel, layer]
                            if merging != 0:
                                to_thickness = grad_thickness[pixel, layer]
                if grads.rgba.shape[0] > 0:
                    grads.rgba[fragment] = vec4(to_rgba)
                if grads.depth.shape[0] > 0:
                    grads.depth[fragment] = to_depth
                if grads.thickness.shape[0] > 0:
                    grads.thickness[fragment] = to_thickness
                if grads.opacity_sum.shape[0] > 0:
                    grads.opacity_sum[fragment] = scalar(to_sum)

    return kbuffer_bwd


def _pixels(inputs: Sequence[Any]) -> Any:
    rgba, depth, thickness, offsets, opacity_sum = inputs
    pixels = PIXELS[rgba.dtype]()
    pixels.rgba, pixels.depth, pixels.thickness, pixels.offsets = vectors(rgba), depth, thickness, offsets
    if opacity_sum is not None:
        pixels.opacity_sum = opacity_sum
    return pixels


def _output_like(inputs: Sequence[Any], slots: int, merge: str, tail: str) -> list[tuple[tuple[int, ...], str]]:
    return layers_like(inputs[3].shape[0] - 1, slots)


def layers_like(pixel_count: int, slots: int) -> list[tuple[tuple[int, ...], str]]:
    """Return the shapes and kinds of `LAYER_OUTPUTS`."""
    per_slot = ((pixel_count, slots), "float")
    return [((pixel_count, slots, 4), "float"), per_slot, per_slot, per_slot, ((pixel_count,), "int32")]


def _forward(inputs: Sequence[Any], outputs: Sequence[Any], slots: int, merge: str, tail: str) -> None:
    device, offsets = inputs[0].device, inputs[3]
    longest_list(offsets, inputs[0].shape[0])
    pixel_count = offsets.shape[0] - 1
    rows = worker_count(pixel_count, device, 0)
    invalid = wp.array(np.full((rows, 2), NO_FRAGMENT, np.int32), device=device)
    kernel = _forward_kernel(inputs[0].dtype, int(merge != "none"))
    launch(kernel, pixel_count, [_pixels(inputs), slots_in(*outputs, tail=tail), invalid], device, rows)
    report_invalid(invalid, (*inputs[:4], None, inputs[4]))


def kbuffer_backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], slots: int, merge: str, tail: str
) -> None:
    """Fill those gradients of the fragments that are not None, given those of the layers."""
    rgba, _, _, offsets, _ = inputs
    scalar, device, pixel_count = rgba.dtype, rgba.device, offsets.shape[0] - 1
    length = row_length(offsets, rgba.shape[0])
    rows = worker_count(pixel_count, device, 4 * length + slots * (7 * wp.types.type_size_in_bytes(scalar) + 92))
    sizes = zip(LAYER_OUTPUTS, layers_like(rows, slots), strict=True)
    scratch = slots_in(
        *(wp.empty(shape, dtype=scalar if kind == "float" else int, device=device) for _, (shape, kind) in sizes),
        tail=tail,
    )
    scratch.owner = wp.empty((rows, slots), dtype=int, device=device)
    scratch.parent = wp.empty(rows * length, dtype=int, device=device)
    members = wp.empty((rows, slots), dtype=Members, device=device)
    targets = GRADIENTS[scalar]()
    grad_rgba, grad_depth, grad_thickness, _, grad_opacity_sum = grad_inputs
    if grad_rgba is not None:
        targets.rgba = vectors(grad_rgba)
    if grad_depth is not None:
        targets.depth = grad_depth
    if grad_thickness is not None:
        targets.thickness = grad_thickness
    if grad_opacity_sum is not None:
        targets.opacity_sum = grad_opacity_sum
    grads = [
        grad if grad is not None else wp.empty((0,) * ndim, dtype=scalar, device=device)
        for grad, ndim in zip(grad_outputs[:4], (3, 2, 2, 2), strict=True)
    ]
    arguments = [_pixels(inputs), scratch, length, members, *grads, targets]
    launch(_backward_kernel(scalar, int(merge != "none")), pixel_count, arguments, device, rows)


_KBUFFER = Operator(
    name="kbuffer",
    tensors=("rgba", "depth", "thickness", "offsets", "opacity_sum"),
    differentiable=("rgba", "depth", "thickness", "opacity_sum"),
    outputs=LAYER_OUTPUTS,
    output_like=_output_like,
    forward=_forward,
    backward=kbuffer_backward,
    options=KBUFFER_OPTIONS,
)


def kbuffer(fragments: Fragments, slots: int = 8, merge: KMerge = "order_independent", tail: Tail = "mix") -> Layers:
    """Stream the fragments of every pixel, in the order in which they are given, into a k-buffer.

    This is what a renderer that cannot store all fragments would make of them (SKB, with merging SKB+OFM): it merges
    without regard to depth, and once all slots are taken the farthest mix in the last. As long as that tail stays empty
    the order makes no difference. `capture(..., sort=False)` gives fragments in order of submission; `capture_kbuffer`
    captures a scene like this, without ever storing them.

    Differentiable in the fragments' colour, opacity, depth, thickness and opacity sum; which fragments share a slot,
    and which are dropped, is held fixed.

    Args:
        fragments: what to stream.
        slots: number K of slots of each pixel.
        merge: "order_independent" mixes what overlaps (OFM); "none" is the plain k-buffer, in which every thickness
            counts as 0.
        tail: what happens beyond the slots: "mix" keeps the last slot for all that lies behind the others, mixed;
            "discard" drops it, which without merging leaves the K nearest fragments.

    Returns:
        The layers (K per pixel), in the kind and precision of the fragments' arrays.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an option does not exist, or values are not finite or out of range.

    Example:
        >>> fragments = wf.capture(wf.load_scene("scenes/three_spheres.toml"), sort=False)
        >>> wf.kbuffer(fragments, slots=4).depth.shape
        (512, 512, 4)
    """
    check_kbuffer(slots, merge, tail)
    *inputs, _, opacity_sum = fragment_inputs(fragments, 1.0, dimensions=2)
    options = {"slots": int(slots), "merge": merge, "tail": tail}
    return as_layers(apply(_KBUFFER, (*inputs, opacity_sum), **options), fragments.shape, slots)


def as_layers(outputs: Sequence[Any], grid: tuple[int, ...], slots: int) -> Layers:
    """Return `LAYER_OUTPUTS` of all pixels in one row as the layers of a pixel grid."""
    rgba, depth, thickness, opacity_sum, count = outputs
    return Layers(
        rgba.reshape((*grid, slots, 4)),
        depth.reshape((*grid, slots)),
        thickness.reshape((*grid, slots)),
        opacity_sum.reshape((*grid, slots)),
        count.reshape(grid),
    )
