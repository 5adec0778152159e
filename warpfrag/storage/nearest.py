"""The K nearest fragments of each pixel.

    kb              the k-buffer (Bavoil et al. 2007): sorted slots that every fragment reads, modifies and writes
    multi_kb        the same again behind the last peeled depth, until nothing is left (Liu et al. 2009)
    k_plus_array    the k+-buffer (Vasilakis and Fudos 2014): the farthest first, so that one look culls; the rest as
                    they come
    k_plus_heap     the same, as a heap with the farthest on top, for more slots

Fragments come in order of submission: of equals the first stay. On a GPU several fragments of a pixel may read the
k-buffer before any of them writes it, and the last write wins (a read-modify-write hazard). That is simulated: with
`hazard` = g it is as if of each g that follow one another only the last had come.

`multi_kb` peels whole layers: where its slots end in the middle of one, that is left to the next pass, unless it has
more fragments than there are slots.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, Array2, Number, in_precisions
from warpfrag.storage.kept import INDEX_BYTES, Kept, Log, allocate_kept, clear_slots, kept_bytes, put
from warpfrag.storage.method import Room, Stage, Storage
from warpfrag.storage.occupancy import FILL_MAPS, Occupancy, allocate_occupancy, is_culled, occupancy_bytes
from warpfrag.storage.request import Keys, Request, key_of

wp.set_module_options({"enable_backward": False})

# Slots that one of unpacked attributes makes where these are packed.
PACKED = 2


@in_precisions
class Nearest:
    """The slots of each pixel, their `ranks` (keys, (P, K)), and how many are filled, (P,).

    Of multi_kb: the key `last` up to which all is peeled, and the least key that was `dropped`, (P,). Of hazards: the
    fragment that was the last to read, `waiting` and `waiting_depth`, and how many `readers` there were, (P,).
    """

    keys: Keys
    occupancy: Occupancy
    kept: Kept
    ranks: Array2[Number]
    filled: Array[wp.int32]
    last: Array[Number]
    dropped: Array[Number]
    waiting: Array[wp.int32]
    waiting_depth: Array[Number]
    readers: Array[wp.int32]
    hazard: wp.int32


@wp.func(inline=True)
def set_rank(storage: Any, pixel: int, slot: int, item: int, depth: Any, key: Any):
    """Write a slot and its rank."""
    put(storage.kept, pixel, slot, item, depth)
    storage.ranks[pixel, slot] = key


@wp.func(inline=True)
def copy_slot(storage: Any, pixel: int, source: int, target: int):
    """Copy a slot and its rank."""
    depth = storage.kept.depths[pixel, source]
    set_rank(storage, pixel, target, storage.kept.items[pixel, source], depth, storage.ranks[pixel, source])


@wp.func(inline=True)
def drop(storage: Any, pixel: int, key: Any):
    """Note the key of a fragment that has no slot."""
    if storage.dropped.shape[0] > 0:
        storage.dropped[pixel] = wp.min(storage.dropped[pixel], key)


@wp.func(inline=True)
def insert_sorted(storage: Any, pixel: int, item: int, depth: Any, key: Any):
    """Insert a fragment behind those that are as near; the farthest leaves."""
    slots = storage.kept.items.shape[1]
    filled = storage.filled[pixel]
    enters = bool(True)
    if filled == slots:
        enters = key < storage.ranks[pixel, slots - 1]
        if enters:
            drop(storage, pixel, storage.ranks[pixel, slots - 1])
            filled -= 1
        else:
            drop(storage, pixel, key)
    if enters:
        slot = int(filled)
        while slot > 0 and storage.ranks[pixel, slot - 1] > key:
            copy_slot(storage, pixel, slot - 1, slot)
            slot -= 1
        set_rank(storage, pixel, slot, item, depth, key)
        storage.filled[pixel] = filled + 1


@wp.func(inline=True)
def is_farther(storage: Any, pixel: int, slot: int, other: int):
    """Tell whether a slot has a farther fragment than another; of equals the later one."""
    farther = storage.ranks[pixel, slot] > storage.ranks[pixel, other]
    if storage.ranks[pixel, slot] == storage.ranks[pixel, other]:
        farther = storage.kept.items[pixel, slot] > storage.kept.items[pixel, other]
    return farther


@wp.func(inline=True)
def swap_slots(storage: Any, pixel: int, slot: int, other: int):
    """Exchange two slots."""
    item = storage.kept.items[pixel, slot]
    depth = storage.kept.depths[pixel, slot]
    key = storage.ranks[pixel, slot]
    copy_slot(storage, pixel, other, slot)
    set_rank(storage, pixel, other, item, depth, key)


@wp.func(inline=True)
def insert_farthest_first(storage: Any, pixel: int, item: int, depth: Any, key: Any):
    """Insert a fragment; once all slots are filled the first one has the farthest, which a nearer one replaces."""
    slots = storage.kept.items.shape[1]
    filled = storage.filled[pixel]
    search = bool(False)
    if filled < slots:
        set_rank(storage, pixel, filled, item, depth, key)
        storage.filled[pixel] = filled + 1
        search = filled + 1 == slots
    elif key < storage.ranks[pixel, 0]:
        set_rank(storage, pixel, 0, item, depth, key)
        search = True
    if search:
        farthest = int(0)
        for slot in range(1, slots):
            if is_farther(storage, pixel, slot, farthest):
                farthest = slot
        if farthest != 0:
            swap_slots(storage, pixel, 0, farthest)


@wp.func(inline=True)
def insert_in_heap(storage: Any, pixel: int, item: int, depth: Any, key: Any):
    """Insert a fragment; no slot has a nearer one than the two below it, so that the farthest is on top."""
    slots = storage.kept.items.shape[1]
    filled = storage.filled[pixel]
    if filled < slots:
        slot = int(filled)
        set_rank(storage, pixel, slot, item, depth, key)
        storage.filled[pixel] = filled + 1
        while slot > 0 and is_farther(storage, pixel, slot, (slot - 1) // 2):
            swap_slots(storage, pixel, slot, (slot - 1) // 2)
            slot = (slot - 1) // 2
    elif key < storage.ranks[pixel, 0]:
        set_rank(storage, pixel, 0, item, depth, key)
        slot = int(0)
        sinking = bool(slots > 1)
        while sinking:
            below = 2 * slot + 1
            if below + 1 < slots and is_farther(storage, pixel, below + 1, below):
                below += 1
            sinking = is_farther(storage, pixel, below, slot)
            if sinking:
                swap_slots(storage, pixel, slot, below)
                slot = below
                sinking = 2 * slot + 1 < slots


@wp.func(inline=True)
def begin_pixel(storage: Any, worker: int, pixel: int):
    """Empty the slots of a pixel."""
    storage.filled[pixel] = 0
    clear_slots(storage.kept, pixel)
    if storage.dropped.shape[0] > 0:
        storage.dropped[pixel] = type(storage.dropped[pixel])(wp.inf)
    if storage.readers.shape[0] > 0:
        storage.readers[pixel] = 0


@cache
def insert_stage(insert: wp.Function) -> Stage:
    """Return the stage that inserts fragments by a rule, with hazards where these are wanted."""

    @wp.func(inline=True)
    def visit(storage: Any, worker: int, pixel: int, item: int, depth: Any):
        key = key_of(storage.keys, pixel, depth)
        seen = not is_culled(storage.occupancy, pixel, depth)
        if storage.last.shape[0] > 0:
            seen = key > storage.last[pixel]
        if seen:
            if storage.readers.shape[0] > 0:
                storage.waiting[pixel] = item
                storage.waiting_depth[pixel] = depth
                storage.readers[pixel] = storage.readers[pixel] + 1
                if storage.readers[pixel] == storage.hazard:
                    storage.readers[pixel] = 0
                    insert(storage, pixel, item, depth, key)
            else:
                insert(storage, pixel, item, depth, key)

    @wp.func(inline=True)
    def write_last(storage: Any, worker: int, pixel: int):
        if storage.readers.shape[0] > 0 and storage.readers[pixel] > 0:
            depth = storage.waiting_depth[pixel]
            insert(storage, pixel, storage.waiting[pixel], depth, key_of(storage.keys, pixel, depth))

    return Stage(visit, begin_pixel, write_last, order="submission")


@wp.func(inline=True)
def end_layers(storage: Any, worker: int, pixel: int):
    """Give back a layer that is not complete, and note up to where the pixel is peeled."""
    filled = storage.filled[pixel]
    if filled > 0:
        farthest = storage.ranks[pixel, filled - 1]
        if storage.dropped[pixel] == farthest and storage.ranks[pixel, 0] < farthest:
            while storage.ranks[pixel, filled - 1] == farthest:
                filled -= 1
                storage.kept.items[pixel, filled] = -1
            farthest = storage.ranks[pixel, filled - 1]
        storage.last[pixel] = farthest


def kb(request: Request) -> Storage:
    """Return the k-buffer."""
    return _nearest("kb", request, insert_sorted)


def k_plus_array(request: Request) -> Storage:
    """Return the k+-buffer of an array."""
    return _nearest("k_plus_array", request, insert_farthest_first)


def k_plus_heap(request: Request) -> Storage:
    """Return the k+-buffer of a heap."""
    return _nearest("k_plus_heap", request, insert_in_heap)


def multi_kb(request: Request) -> Storage:
    """Return the k-buffer of several passes."""
    return _nearest("multi_kb", request, insert_sorted, several=True)


def _nearest(name: str, request: Request, insert: wp.Function, *, several: bool = False) -> Storage:
    log, options = Log(), request.options
    slots = options.slots * (PACKED if options.packed else 1)
    words = options.words if options.cull else 0
    hazards = options.hazard > 1

    def allocate(room: Room) -> Any:
        count, number, device = room.pixel_count, room.number, room.device
        size = wp.types.type_size_in_bytes(number)
        held = slots * size + INDEX_BYTES + occupancy_bytes(words, number)
        held += (2 * size if several else 0) + (2 * INDEX_BYTES + size if hazards else 0)
        log.begin(kept_bytes(room, slots) + held * count)
        room.reserve(log.held, f"{slots} slots for each of {count} pixels", 0)
        arrays = Nearest[number]()
        arrays.keys, arrays.hazard = request.keys(), options.hazard
        arrays.occupancy = allocate_occupancy(count, words, slots, number, device)
        arrays.kept = allocate_kept(room, slots)
        arrays.ranks = wp.empty((count, slots), dtype=number, device=device)
        arrays.filled = wp.zeros(count, dtype=int, device=device)
        if several:
            arrays.last = wp.full(count, -wp.inf, dtype=number, device=device)
            arrays.dropped = wp.empty(count, dtype=number, device=device)
        if hazards:
            arrays.waiting, arrays.readers = (wp.zeros(count, dtype=int, device=device) for _ in range(2))
            arrays.waiting_depth = wp.zeros(count, dtype=number, device=device)
        return arrays

    def repeat(arrays: Any, room: Room) -> bool:
        log.passes += 1
        log.take(room, arrays.kept)
        if not several:
            return False
        left = arrays.dropped.numpy() < wp.inf
        if request.hide is not None:
            last = arrays.last.numpy()
            last[~left] = wp.inf
            request.hide(last)
        return request.allows(log.passes) and bool(left.any())

    stage = insert_stage(insert)
    after = end_layers if several else stage.after
    insertion = Stage(stage.visit, stage.before, after, order="submission", repeat=repeat)
    stages = (*(FILL_MAPS if words else ()), insertion)
    return Storage(name, Nearest, allocate, stages, lambda arrays, room: log.lists(room), loses=True)
