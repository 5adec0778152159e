"""The slots of a bounded k-buffer, and how one more fragment enters them (fragment merging section 4.2; k+-buffer).

A slot holds sums, so that mixing costs a few additions and its fragments may come in any order:

    q = sum C_i w_i,   A = 1 - prod (1 - A_i),   S = sum S_i,   front = min f_i,   z = max z_i,   w_i = S_i / A_i

and its colour is q A / S in the end. Slots live in the arrays of `Layers` themselves: until `finish_slots`, `rgba`
holds (q, A) and `thickness` the front. There is no memory of a pixel's fragments beyond these.

Core slots do not overlap, so they are kept in depth order: slot number n - 1 is the farthest kept (the first slot of a
max array), and whatever a fragment overlaps is a run of slots. The tail, once in use, lies behind all of them.

    z > front of the tail in use:           into the tail
    slots first : end overlap it:           one slot of all of them
    a core slot is free:                    it goes there
    else, of it and the farthest core slot: the nearer stays, by (z, front, arrival); the other goes into the tail

Without merging every front counts as z: points do not overlap.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.precisions import Array, Array2, Number, Vector4, in_precisions

wp.set_module_options({"enable_backward": False})

# Added to a pixel's number of core slots when its tail is in use; the tail's own place is the last slot.
TAIL_IN_USE = wp.constant(1 << 30)
# Parent of a fragment that was dropped, or whose slot was; slot s is written as OWNS_SLOT - s.
DROPPED = wp.constant(-1)
OWNS_SLOT = wp.constant(-2)


@in_precisions
class Slots:
    """Slots of all pixels, (P, K): `rgba` and `front` as said above; `core` of them are no tail, `tail` is 0 or 1.

    Only the way back keeps `owner` (P, K), the fragment that a slot began with, and `parent`, by fragment of a pixel:
    the one whose slot it went into.
    """

    rgba: Array2[Vector4]
    depth: Array2[Number]
    front: Array2[Number]
    opacity_sum: Array2[Number]
    count: Array[wp.int32]
    core: wp.int32
    tail: wp.int32
    owner: Array2[wp.int32]
    parent: Array[wp.int32]


def slots_in(layers: Any, tail: str) -> Any:
    """Return the slots that live in the arrays of layers, with attributes of (P, K, 4), (P, K) and (P,)."""
    slots = Slots[layers.depth.dtype]()
    slots.rgba, slots.depth, slots.front = as_vectors(layers.rgba), layers.depth, layers.thickness
    slots.opacity_sum, slots.count = layers.opacity_sum, layers.count
    slots.tail = int(tail == "mix")
    slots.core = layers.depth.shape[1] - slots.tail
    return slots


@wp.func(inline=True)
def set_slot(slots: Any, pixel: int, slot: int, rgba: Any, s: Any, front: Any, z: Any):
    """Write a slot."""
    slots.rgba[pixel, slot] = rgba
    slots.opacity_sum[pixel, slot] = s
    slots.front[pixel, slot] = front
    slots.depth[pixel, slot] = z


@wp.func(inline=True)
def mix_into(slots: Any, pixel: int, slot: int, rgba: Any, s: Any, front: Any, z: Any):
    """Mix into a slot (order-independent merging)."""
    own = slots.rgba[pixel, slot]
    opacity = own[3] + (type(s)(1.0) - own[3]) * rgba[3]
    slots.rgba[pixel, slot] = wp.vector(own[0] + rgba[0], own[1] + rgba[1], own[2] + rgba[2], opacity)
    slots.opacity_sum[pixel, slot] = slots.opacity_sum[pixel, slot] + s
    slots.front[pixel, slot] = wp.min(slots.front[pixel, slot], front)
    slots.depth[pixel, slot] = wp.max(slots.depth[pixel, slot], z)


@wp.func(inline=True)
def move_slot(slots: Any, pixel: int, source: int, target: int):
    """Copy a slot to another place of its pixel."""
    slots.rgba[pixel, target] = slots.rgba[pixel, source]
    slots.opacity_sum[pixel, target] = slots.opacity_sum[pixel, source]
    slots.front[pixel, target] = slots.front[pixel, source]
    slots.depth[pixel, target] = slots.depth[pixel, source]
    if slots.owner.shape[0] > 0:
        slots.owner[pixel, target] = slots.owner[pixel, source]


@wp.func(inline=True)
def begin_slot(slots: Any, pixel: int, slot: int, fragment: int):
    """Note that a fragment has a slot of its own."""
    if slots.owner.shape[0] > 0:
        slots.owner[pixel, slot] = fragment


@wp.func(inline=True)
def join_slot(slots: Any, pixel: int, slot: int, fragment: int):
    """Note that a fragment, and all that joined it, went into a slot."""
    if slots.owner.shape[0] > 0:
        slots.parent[fragment] = slots.owner[pixel, slot]


@wp.func(inline=True)
def is_beyond(slots: Any, pixel: int, front: Any):
    """Tell whether a fragment will be dropped: all slots are taken, none is a tail, and it lies behind them."""
    beyond = bool(False)
    if slots.tail == 0 and slots.count[pixel] == slots.core:
        beyond = slots.depth[pixel, slots.core - 1] <= front
    return beyond


@wp.func(inline=True)
def insert(slots: Any, pixel: int, fragment: int, rgba: Any, s: Any, front: Any, z: Any):
    """Stream one more fragment into a pixel's slots.

    Args:
        slots: where to.
        pixel: of which pixel.
        fragment: its number, if the way back is to know where it went.
        rgba: colour times weight, and opacity.
        s: opacity sum.
        front: front depth, or z without merging.
        z: back depth.
    """
    last = slots.depth.shape[1] - 1
    core_count = slots.count[pixel]
    tail_in_use = core_count >= TAIL_IN_USE
    if tail_in_use:
        core_count -= TAIL_IN_USE
    behind = bool(False)
    if tail_in_use:
        behind = z > slots.front[pixel, last]
    if behind:
        join_slot(slots, pixel, last, fragment)
        mix_into(slots, pixel, last, rgba, s, front, z)
    else:
        first = int(0)
        while first < core_count and slots.depth[pixel, first] <= front:
            first += 1
        end = int(first)
        while end < core_count and slots.front[pixel, end] < z:
            end += 1
        if end > first:
            join_slot(slots, pixel, first, fragment)
            mix_into(slots, pixel, first, rgba, s, front, z)
            for slot in range(first + 1, end):
                if slots.owner.shape[0] > 0:
                    join_slot(slots, pixel, first, slots.owner[pixel, slot])
                mix_into(
                    slots, pixel, first, slots.rgba[pixel, slot], slots.opacity_sum[pixel, slot],
                    slots.front[pixel, slot], slots.depth[pixel, slot],
                )  # fmt: skip
            gone = end - first - 1
            if gone > 0:
                for slot in range(end, core_count):
                    move_slot(slots, pixel, slot, slot - gone)
                slots.count[pixel] = slots.count[pixel] - gone
        else:
            full = core_count == slots.core
            if full and slots.tail != 0:
                # What leaves the core, the fragment itself or the farthest slot, lies behind all that stays.
                if first == core_count:
                    if tail_in_use:
                        join_slot(slots, pixel, last, fragment)
                        mix_into(slots, pixel, last, rgba, s, front, z)
                    else:
                        begin_slot(slots, pixel, last, fragment)
                        set_slot(slots, pixel, last, rgba, s, front, z)
                else:
                    far = core_count - 1
                    if tail_in_use:
                        if slots.owner.shape[0] > 0:
                            join_slot(slots, pixel, last, slots.owner[pixel, far])
                        mix_into(
                            slots, pixel, last, slots.rgba[pixel, far], slots.opacity_sum[pixel, far],
                            slots.front[pixel, far], slots.depth[pixel, far],
                        )  # fmt: skip
                    else:
                        move_slot(slots, pixel, far, last)
                if not tail_in_use:
                    slots.count[pixel] = core_count + TAIL_IN_USE
            elif full and slots.owner.shape[0] > 0:
                if first == core_count:
                    slots.parent[fragment] = DROPPED
                else:
                    slots.parent[slots.owner[pixel, core_count - 1]] = DROPPED
            if not full:
                slots.count[pixel] = slots.count[pixel] + 1
            if not full or first < core_count:
                last_moved = wp.where(full, core_count - 1, core_count)
                for moved in range(last_moved - first):
                    move_slot(slots, pixel, last_moved - 1 - moved, last_moved - moved)
                begin_slot(slots, pixel, first, fragment)
                set_slot(slots, pixel, first, rgba, s, front, z)


@wp.func(inline=True)
def finish_slots(slots: Any, pixel: int):
    """Turn the slots of a pixel into its layers: in depth order, zero past their number."""
    layer_count = slots.count[pixel]
    if layer_count >= TAIL_IN_USE:
        layer_count -= TAIL_IN_USE
        move_slot(slots, pixel, slots.depth.shape[1] - 1, layer_count)
        layer_count += 1
    slots.count[pixel] = layer_count
    for layer in range(layer_count):
        own = slots.rgba[pixel, layer]
        s = slots.opacity_sum[pixel, layer]
        if s > type(s)(0.0) and own[3] > type(s)(0.0):
            scale = own[3] / s
            slots.rgba[pixel, layer] = wp.vector(scale * own[0], scale * own[1], scale * own[2], own[3])
        slots.front[pixel, layer] = slots.depth[pixel, layer] - slots.front[pixel, layer]
    for unused in range(layer_count, slots.depth.shape[1]):
        zero = type(slots.depth[pixel, unused])(0.0)
        set_slot(slots, pixel, unused, wp.vector(zero, zero, zero, zero), zero, zero, zero)
