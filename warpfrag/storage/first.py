"""The first fragments of each pixel as they arrive, in an array of fixed length.

fixed_array    the first L (FreePipe, Liu et al. 2010; FAB and B3D, Crassin 2010)
srab           the first K by the stencil test (stencil-routed A-buffer, Myers and Bavoil 2007); one more pass for
               every K that follow, where those are allowed
"""

from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, in_precisions
from warpfrag.storage.kept import INDEX_BYTES, Kept, Log, allocate_kept, clear_slots, kept_bytes, put
from warpfrag.storage.method import Room, Stage, Storage
from warpfrag.storage.request import Request

wp.set_module_options({"enable_backward": False})


@in_precisions
class First:
    """Slots; how many fragments of each pixel came, (P,); and how many of these were captured by earlier passes."""

    kept: Kept
    arrived: Array[wp.int32]
    begin: wp.int32


@wp.func(inline=True)
def begin_pixel(storage: Any, worker: int, pixel: int):
    """Begin without fragments."""
    storage.arrived[pixel] = 0
    clear_slots(storage.kept, pixel)


@wp.func(inline=True)
def arrive(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Capture a fragment if it is this pass's turn, and if there is a slot."""
    slot = storage.arrived[pixel] - storage.begin
    if slot >= 0 and slot < storage.kept.items.shape[1]:
        put(storage.kept, pixel, slot, item, depth)
    storage.arrived[pixel] = storage.arrived[pixel] + 1


def fixed_array(request: Request) -> Storage:
    """Return the storage of one array of fixed length for each pixel."""
    return _first("fixed_array", request, several=False)


def srab(request: Request) -> Storage:
    """Return the stencil-routed A-buffer."""
    return _first("srab", request, several=True)


def _first(name: str, request: Request, *, several: bool) -> Storage:
    log, slots = Log(), request.options.slots

    def allocate(room: Room) -> Any:
        log.begin(kept_bytes(room, slots) + INDEX_BYTES * room.pixel_count)
        room.reserve(log.held, f"{slots} slots for each of {room.pixel_count} pixels", 0)
        arrays = First[room.number]()
        arrays.kept = allocate_kept(room, slots)
        arrays.arrived = wp.empty(room.pixel_count, dtype=int, device=room.device)
        return arrays

    def repeat(arrays: Any, room: Room) -> bool:
        log.take(room, arrays.kept)
        log.passes += 1
        arrays.begin = log.passes * slots
        more = several and int(arrays.arrived.numpy().max(initial=0)) > arrays.begin
        return more and request.allows(log.passes)

    stage = Stage(arrive, begin_pixel, order="submission", repeat=repeat)
    return Storage(name, First, allocate, (stage,), lambda arrays, room: log.lists(room), loses=True)
