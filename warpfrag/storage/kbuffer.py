"""The bounded k-buffer: fragments of a pixel, as they come, into K slots (fragment merging 4.2: SKB and SKB+OFM).

`slots.py` has the rules. A layer is a function of its members alone, whatever their order:

    q = sum C_i w_i,  A = 1 - prod (1 - A_i),  S = sum S_i,  C = q A/S,  z = max z_i,  t = z - min (z_i - t_i)

so the way back needs no sequence of states. `kbuffer_bwd` streams once more to learn which slot each fragment ended in,
sums up the slots, and gives every member its part (`slot_sums.py`); z and the front belong to one member each.
Differentiable in colour, opacity, depth, thickness and opacity sum; which fragments share a slot, and which are
dropped, is held fixed.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.operators import Operator
from warpfrag.arrays.precisions import kernels
from warpfrag.arrays.scratch import ROW_GAP
from warpfrag.fragments import FRAGMENT_INPUTS, LAYER_OUTPUTS, Fragments, Layers, as_layers, fragment_inputs
from warpfrag.slabs.lists import (
    FragmentGradients,
    FragmentLists,
    fragment_gradients,
    fragment_lists,
    longest_list,
)
from warpfrag.storage.into_slots import (
    SLOT_NUMBERS,
    KMerge,
    Source,
    Tail,
    check_kbuffer,
    kbuffer_storage,
)
from warpfrag.storage.method import Room
from warpfrag.storage.slot_sums import ZERO, SlotSums, layer_of, member_adjoint, no_sums, with_member
from warpfrag.storage.slots import OWNS_SLOT, TAIL_IN_USE, Slots, insert, slots_in
from warpfrag.storage.stored import stream

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class KBufferOptions:
    """Options of a k-buffer of stored fragments; see `kbuffer`."""

    slots: int
    merge: str
    tail: str

    def sizes(self) -> dict[str, int]:
        """Return the size of outputs that no input has."""
        return {"M": self.slots}


@wp.func(inline=True)
def locate(lists: Any, pixel: int, fragment: int):
    """Return where a stored fragment is."""
    return fragment


@wp.func(inline=True)
def front_of(lists: Any, pixel: int, fragment: int, place: int, depth: Any):
    """Return the front of a stored fragment."""
    return depth - lists.thickness[place]


@wp.func(inline=True)
def color_of(lists: Any, pixel: int, fragment: int, place: int, depth: Any):
    """Return the colour times weight and opacity of a stored fragment, and its opacity sum."""
    rgba = lists.rgba[place]
    s = rgba[3]
    weighted = rgba
    if lists.opacity_sum.shape[0] > 0:
        s = lists.opacity_sum[place]
        if rgba[3] > type(s)(0.0):
            weight = s / rgba[3]
            weighted = wp.vector(weight * rgba[0], weight * rgba[1], weight * rgba[2], rgba[3])
    return weighted, s


STORED = Source(FragmentLists, locate, front_of, color_of)


@wp.func(inline=True)
def name_owners(slots: Any, row: int):
    """Write of each slot in use, the tail last, that its owner owns it; return their number."""
    count = slots.count[row]
    if count >= TAIL_IN_USE:
        count -= TAIL_IN_USE
        slots.owner[row, count] = slots.owner[row, slots.core]
        count += 1
    for layer in range(count):
        slots.parent[slots.owner[row, layer]] = OWNS_SLOT - layer
    return count


@kernels
def kbuffer_bwd(number: Any, merging: bool) -> Any:
    """Return the kernel of the way back from layers to fragments."""
    vec4 = wp.types.vector(4, number)
    merges = int(merging)

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        slots: Slots[number],
        length: int,
        slot_sums: wp.array2d(dtype=SlotSums),
        layers: Slots[number],
        grads: FragmentGradients[number],
    ):
        """Give every fragment its part of the gradient of the layer that it ended in.

        Args:
            span: the pixels.
            lists: the fragments.
            slots: scratch memory, a row of K slots for each thread, with owners and parents.
            length: entries of a thread's row of parents.
            slot_sums: scratch memory, a row of K for each thread.
            layers: gradients of the layers; `front` is that of thickness; empty ones are zeros.
            grads: output, gradients of the fragments.
        """
        row = span.worker + wp.tid()
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = lists.offsets[pixel]
            end = lists.offsets[pixel + 1]
            # The numbers of the pixel's fragments in the thread's part of `parent`.
            shift = row * length - begin
            slots.count[row] = 0
            for fragment in range(begin, end):
                depth = lists.depth[fragment]
                front = depth
                if merges != 0:
                    front = front_of(lists, pixel, fragment, fragment, depth)
                weighted, opacity_sum = color_of(lists, pixel, fragment, fragment, depth)
                insert(slots, row, shift + fragment, weighted, opacity_sum, front, depth)
            for layer in range(name_owners(slots, row)):
                slot_sums[row, layer] = no_sums()
            for fragment in range(begin, end):
                layer = layer_of(slots.parent, shift + fragment)
                if layer >= 0:
                    slot_sums[row, layer] = with_member(slot_sums[row, layer], lists, fragment, merges)
            for fragment in range(begin, end):
                layer = layer_of(slots.parent, shift + fragment)
                grad_rgba = wp.vec4d()
                grad_sum = ZERO
                grad_depth = number(0.0)
                grad_thickness = number(0.0)
                if layer >= 0:
                    sums = slot_sums[row, layer]
                    g = wp.vec4d()
                    if layers.rgba.shape[0] > 0:
                        g = wp.vec4d(layers.rgba[pixel, layer])
                    g_sum = ZERO
                    if layers.opacity_sum.shape[0] > 0:
                        g_sum = wp.float64(layers.opacity_sum[pixel, layer])
                    grad_rgba, grad_sum = member_adjoint(sums, g, g_sum, lists, fragment)
                    if sums.back == fragment and layers.depth.shape[0] > 0:
                        grad_depth += layers.depth[pixel, layer]
                    if layers.front.shape[0] > 0:
                        if sums.back == fragment:
                            grad_depth += layers.front[pixel, layer]
                        if sums.front == fragment:
                            grad_depth -= layers.front[pixel, layer]
                            if merges != 0:
                                grad_thickness = layers.front[pixel, layer]
                if grads.rgba.shape[0] > 0:
                    grads.rgba[fragment] = vec4(grad_rgba)
                if grads.depth.shape[0] > 0:
                    grads.depth[fragment] = grad_depth
                if grads.thickness.shape[0] > 0:
                    grads.thickness[fragment] = grad_thickness
                if grads.opacity_sum.shape[0] > 0:
                    grads.opacity_sum[fragment] = number(grad_sum)

    return kernel


def _forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: KBufferOptions) -> None:
    longest_list(inputs.offsets, inputs.rgba.shape[0])
    lists = fragment_lists(inputs)
    storage = kbuffer_storage(STORED, lists, outputs, merge=options.merge, tail=options.tail)
    # The layers are there already; there is nothing to reserve.
    room = Room(inputs.offsets.shape[0] - 1, inputs.rgba.dtype, inputs.rgba.device, lambda *told: None)
    stream(storage, lists, room, inputs)


def kbuffer_backward(
    inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: KBufferOptions
) -> None:
    """Fill those gradients of the fragments that are not None, given those of the layers."""
    number, device = inputs.rgba.dtype, inputs.rgba.device
    pixel_count, slots = inputs.offsets.shape[0] - 1, options.slots
    length = longest_list(inputs.offsets, inputs.rgba.shape[0]) + ROW_GAP
    slot_bytes = SLOT_NUMBERS * wp.types.type_size_in_bytes(number) + 4 + wp.types.type_size_in_bytes(SlotSums)
    rows = worker_count(pixel_count, device, 4 * length + slots * slot_bytes)
    layers = SimpleNamespace(
        rgba=wp.empty((rows, slots, 4), dtype=number, device=device),
        **{
            name: wp.empty((rows, slots), dtype=number, device=device) for name in ("depth", "thickness", "opacity_sum")
        },
        count=wp.empty(rows, dtype=int, device=device),
    )
    scratch = slots_in(layers, options.tail)
    scratch.owner = wp.empty((rows, slots), dtype=int, device=device)
    scratch.parent = wp.empty(rows * length, dtype=int, device=device)
    slot_sums = wp.empty((rows, slots), dtype=SlotSums, device=device)
    layer_grads = layer_gradients(grads, number)
    arguments = [fragment_lists(inputs), scratch, length, slot_sums, layer_grads, fragment_gradients(targets, number)]
    launch(kbuffer_bwd(number, options.merge != "none"), pixel_count, arguments, device, rows)


def layer_gradients(grads: SimpleNamespace, number: Any) -> Any:
    """Return the gradients of layers that are not None as the arrays of `Slots`; `front` is that of thickness."""
    found = Slots[number]()
    if grads.rgba is not None:
        found.rgba = as_vectors(grads.rgba)
    for field, name in (("depth", "depth"), ("front", "thickness"), ("opacity_sum", "opacity_sum")):
        if getattr(grads, name) is not None:
            setattr(found, field, getattr(grads, name))
    return found


KBUFFER = Operator(
    name="kbuffer",
    inputs=FRAGMENT_INPUTS,
    outputs=LAYER_OUTPUTS,
    options=KBufferOptions,
    forward=_forward,
    backward=kbuffer_backward,
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
    options = KBufferOptions(int(slots), merge, tail)
    return as_layers(apply(KBUFFER, fragment_inputs(fragments, dimensions=2), options), fragments.shape)
