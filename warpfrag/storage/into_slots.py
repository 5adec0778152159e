"""The k-buffer as a storage: fragments go into the K slots of their pixel as they come, whoever produces them.

`slots.py` has the rules. What a fragment looks like is up to its producer, a `Source`, which is asked no more than is
needed: for the front once a fragment is known not to be culled, for the colour once it is known to enter a slot.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, get_args

import warp as wp

from warpfrag.arrays.precisions import in_precisions
from warpfrag.errors import check_choice, check_whole
from warpfrag.storage.method import Room, Stage, Storage
from warpfrag.storage.occupancy import (
    FILL_MAPS,
    TALLY_ALL,
    TALLY_BEHIND,
    TALLY_OCCUPANCY,
    Occupancy,
    allocate_occupancy,
    is_culled,
    occupancy_bytes,
    tally,
)
from warpfrag.storage.slots import Slots, finish_slots, insert, is_beyond, slots_in

wp.set_module_options({"enable_backward": False})

KMerge = Literal["none", "order_independent"]
Tail = Literal["mix", "discard"]

# Of a slot: colour and opacity, depth, z-thickness, opacity sum: numbers.
SLOT_NUMBERS = 7


def check_kbuffer(slots: Any, merge: Any, tail: Any) -> None:
    """Raise for a number of slots, a merge or a tail that does not exist."""
    check_choice("merge", merge, get_args(KMerge))
    check_choice("tail", tail, get_args(Tail))
    check_whole("slots", slots, 1)


def kbuffer_bytes(pixel_count: int, slots: int, number: Any = wp.float32, map_words: int = 0) -> int:
    """Return the memory of a k-buffer: of its layers, and of the occupancy maps while they are captured [bytes].

    Args:
        pixel_count: number of pixels.
        slots: slots of a pixel, K.
        number: Warp type of the numbers.
        map_words: words of a pixel's occupancy map; 0 for none.
    """
    size = wp.types.type_size_in_bytes(number)
    return pixel_count * (slots * SLOT_NUMBERS * size + 4 + occupancy_bytes(map_words, number))


@dataclass(frozen=True, eq=False)
class Source:
    """Where a k-buffer gets to know what a fragment looks like.

    Attributes:
        arrays: its structure in both precisions.
        locate: `(arrays, pixel, item) -> place`: whatever the other two take.
        front: `(arrays, pixel, item, place, depth)`: the front depth, in the precision of `depth`.
        color: `(arrays, pixel, item, place, depth)`: colour times weight and opacity, and the opacity sum.
    """

    arrays: Any
    locate: wp.Function
    front: wp.Function
    color: wp.Function


@cache
def kbuffer_arrays(source: Source) -> Any:
    """Return the structure of a k-buffer that is fed by a source."""
    arrays = source.arrays

    @in_precisions
    class KBuffer:
        """Slots, occupancy maps, and what the source knows."""

        slots: Slots
        occupancy: Occupancy
        source: arrays

    return KBuffer


@wp.func(inline=True)
def empty_slots(storage: Any, worker: int, pixel: int):
    """Begin with no slot taken."""
    storage.slots.count[pixel] = 0


@wp.func(inline=True)
def finish(storage: Any, worker: int, pixel: int):
    """Turn the slots of a pixel into its layers."""
    finish_slots(storage.slots, pixel)


@cache
def insert_stage(source: Source, merging: bool, culling: bool, counting: bool) -> Stage:
    """Return the stage that streams fragments into the slots.

    Args:
        source: what fragments look like.
        merging: whether a front counts; else it is the depth.
        culling: whether there are occupancy maps.
        counting: whether fragments are counted.
    """
    locate, front_of, color_of = source.locate, source.front, source.color
    merges, culls, counts = int(merging), int(culling), int(counting)

    @wp.func(inline=True)
    def visit(storage: Any, worker: int, pixel: int, item: int, depth: Any):
        if counts != 0:
            tally(storage.occupancy, TALLY_ALL, pixel)
        culled = bool(False)
        if culls != 0:
            culled = is_culled(storage.occupancy, pixel, depth)
        if culled:
            if counts != 0:
                tally(storage.occupancy, TALLY_OCCUPANCY, pixel)
        else:
            place = locate(storage.source, pixel, item)
            front = depth
            if merges != 0:
                front = front_of(storage.source, pixel, item, place, depth)
            if is_beyond(storage.slots, pixel, front):
                if counts != 0:
                    tally(storage.occupancy, TALLY_BEHIND, pixel)
            else:
                rgba, opacity_sum = color_of(storage.source, pixel, item, place, depth)
                insert(storage.slots, pixel, 0, rgba, opacity_sum, front, depth)

    return Stage(visit, before=empty_slots, after=finish, order="submission")


def kbuffer_storage(
    source: Source,
    arrays: Any,
    layers: Any,
    *,
    merge: str,
    tail: str,
    map_words: int = 0,
    tally_rows: wp.array | None = None,
) -> Storage:
    """Return the storage that turns fragments into given layers.

    Args:
        source: what fragments look like.
        arrays: what the source knows.
        layers: `LAYER_OUTPUTS` as attributes, to be filled.
        merge: "none" or "order_independent".
        tail: "mix" or "discard".
        map_words: words of 32 bits of a pixel's occupancy map; 0 for no culling by it.
        tally_rows: zeros (`TALLY_ROWS`, P), to count fragments in; None for no count.
    """
    structure = kbuffer_arrays(source)

    def allocate(room: Room) -> Any:
        slots = layers.depth.shape[1]
        room.reserve(
            kbuffer_bytes(room.pixel_count, slots, room.number, map_words),
            f"{slots} slots for each of {room.pixel_count} pixels",
            0,
        )
        buffer = structure[room.number]()
        buffer.source, buffer.slots = arrays, slots_in(layers, tail)
        occupancy = allocate_occupancy(room.pixel_count, map_words, buffer.slots.core, room.number, room.device)
        if tally_rows is not None:
            occupancy.tally = tally_rows
        buffer.occupancy = occupancy
        return buffer

    stages = (
        *(FILL_MAPS if map_words else ()),
        insert_stage(source, merge != "none", map_words > 0, tally_rows is not None),
    )
    return Storage("kbuffer", structure, allocate, stages, lambda buffer, room: layers, loses=True)
