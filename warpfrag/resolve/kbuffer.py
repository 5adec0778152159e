"""The bounded k-buffer: fragments of a pixel, as they come, into K slots (fragment merging section 4.2, SKB and SKB+OFM).

`slots.py` has the rules. A layer is a function of its members alone, whatever their order:

    q = sum C_i w_i,  A = 1 - prod (1 - A_i),  S = sum S_i,  C = q A/S,  z = max z_i,  t = z - min (z_i - t_i)

so the way back needs no sequence of states. `kbuffer_bwd` streams once more to learn which slot each fragment ended in,
sums up the slots, and gives every member its part. With rest_i = prod (1 - A_j) over the others, and S_i = A_i:

    dC/dC_i = A/S,   dA/dA_i = rest_i,   dS/dA_i = 1
    dC/dA_i = q (rest_i - A/S)/S = q ((S - A)/S - (1 - rest_i))/S

z and the front belong to one member each. S - A = sum A_i (opacity of those before i) is summed up as it stands, for at
small opacities the difference would have lost all digits. Differentiable in colour, opacity, depth, thickness and
opacity sum; which fragments share a slot, and which are dropped, is held fixed.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from warpfrag.fragments import Fragments, Layers
from warpfrag.interop.launch import Span, launch, worker_count
from warpfrag.interop.operator import Operator, apply
from warpfrag.resolve.arguments import GRADIENTS, PIXELS, as_int32, check_choice, longest_list, report_invalid, vectors
from warpfrag.resolve.slots import DROPPED, OWNS_SLOT, SLOTS, TAIL_IN_USE, finish_slots, insert, slots_in
from warpfrag.resolve.walk import NO_FRAGMENT, valid_fragment

wp.set_module_options({"enable_backward": False})

KMerge = Literal["none", "order_independent"]
Tail = Literal["mix", "discard"]

KBUFFER_OPTIONS = {"slots": "int", "merge": "str", "tail": "str"}
LAYER_OUTPUTS = ("rgba", "depth", "thickness", "opacity_sum", "count")

ONE = wp.constant(wp.float64(1.0))
ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class Members:
    """Sums over the members of a slot: of colour times weight, opacity, S - A, S; prod (1 - A) of those below 1.

    `opaque`: number of the others; `back`, `front`: fragments that reach farthest back and front.
    """

    color: wp.vec3d
    opacity: wp.float64
    excess: wp.float64
    opacity_sum: wp.float64
    through: wp.float64
    opaque: wp.int32
    back: wp.int32
    front: wp.int32


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


@wp.func(inline=True)
def slot_of(parent: wp.array[wp.int32], base: int, number: int):
    """Return the slot that a fragment ended in, or -1 if it was dropped; shortens its path for the next."""
    at = int(number)
    above = parent[base + at]
    while above >= 0:
        next = parent[base + above]
        if next >= 0:
            parent[base + at] = next
        at = above
        above = next
    return OWNS_SLOT - above if above != DROPPED else -1


@cache
def _backward_kernel(scalar: Any, merging: int) -> wp.Kernel:
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
        base = row * length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            pass

    return kbuffer_bwd
