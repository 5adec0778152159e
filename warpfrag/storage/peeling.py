"""Depth peeling: one layer of each pixel after the other, whatever the number of fragments, by passes over all of them.

    f2b     front to back (Everitt 2001): the nearest fragment behind the last one; of equals the last that is drawn
    f2b2    the same by two passes a layer: depth first, then what lies there
    dual    from both ends at once (Bavoil and Myers 2008); a pixel ends where they meet

What is done with a layer is an ingredient, `take(storage, worker, pixel, side, item, depth)`, called for each fragment
in it; `coplanar.py` has those that lose nothing, or less, where depths are equal. Side 0 peels from the front, side 1
from the back, by depths of the other sign, so that both do the same. All passes are in order of submission: a pixel
belongs to one thread.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.precisions import Array2, Number, in_precisions
from warpfrag.storage.kept import INDEX_BYTES, Kept, Log, allocate_kept, clear_slots, kept_bytes, put
from warpfrag.storage.linked import Nodes, Pool
from warpfrag.storage.method import Room, Stage, Storage, for_each_pixel
from warpfrag.storage.request import Keys, Request, key_of

wp.set_module_options({"enable_backward": False})

# What a pass does: find the depth of the layers, find the ids that are their next to be taken, take from them.
DEPTH = wp.constant(0)
IDS = wp.constant(1)
TAKE = wp.constant(2)
# Above every id.
NO_ID = wp.constant(2**31 - 1)
# A layer of more fragments than this is not yet peeled when its two outermost ids are taken.
PAIR = wp.constant(2)


@in_precisions
class Peel:
    """What peeling knows of each pixel, by side and pixel; what a method does not need is empty.

    Keys, of the sign of the side: `last`, up to which all is peeled; `current`, of the layer; `following`, of the next
    one; infinity where there is none. Of the current layer: ids in between which none has been taken, `low` and
    `high`; the `least` and `most` of these, and their number `count` (or that of the slots that are filled).
    """

    keys: Keys
    kept: Kept
    nodes: Nodes
    last: Array2[Number]
    current: Array2[Number]
    following: Array2[Number]
    low: Array2[wp.int32]
    high: Array2[wp.int32]
    least: Array2[wp.int32]
    most: Array2[wp.int32]
    count: Array2[wp.int32]
    phase: wp.int32


IDENTIFIERS = ("low", "high", "least", "most")


@dataclass(frozen=True, eq=False)
class Method:
    """How layers are peeled.

    Attributes:
        name: what it is called.
        take: what is done with a fragment of the current layers.
        sides: 1 from the front, 2 from both ends.
        by_id: whether two fragments of a layer are taken at a time, by their ids.
        fused: whether the next layers are found while those before are taken, by the same pass.
        slots: slots that a side has for a pass; 0 for lists.
        loses: whether there may be fragments of a layer that are not taken.
    """

    name: str
    take: wp.Function
    sides: int = 1
    by_id: bool = False
    fused: bool = False
    slots: int = 1
    loses: bool = True


@wp.func(inline=True)
def is_between(bounds: Any, pixel: int, key: Any):
    """Tell whether a key lies behind the bound of the front side, and in front of that of the back side if any."""
    return key > bounds[0, pixel] and (bounds.shape[0] == 1 or -key > bounds[1, pixel])


@wp.func(inline=True)
def bring_nearer(keys: Any, pixel: int, side: int, key: Any):
    """Take a key, of the sign of its side, if it is the least so far."""
    keys[side, pixel] = wp.min(keys[side, pixel], key)


@wp.func(inline=True)
def begin_pass(storage: Any, worker: int, pixel: int):
    """Forget what the pass is about to find; a layer with fragments left is still the current one."""
    for side in range(storage.current.shape[0]):
        nothing = type(storage.current[side, pixel])(wp.inf)
        if storage.phase == DEPTH:
            if storage.count[side, pixel] <= PAIR:
                storage.current[side, pixel] = nothing
        elif storage.phase == IDS:
            storage.least[side, pixel] = NO_ID
            storage.most[side, pixel] = -1
            storage.count[side, pixel] = 0
        else:
            storage.following[side, pixel] = nothing
            if storage.low.shape[0] == 0:
                storage.count[side, pixel] = 0
    if storage.phase == TAKE:
        clear_slots(storage.kept, pixel)


@wp.func(inline=True)
def advance(storage: Any, worker: int, pixel: int):
    """Go on to the next layers, or to the ids further inside of those that have fragments left."""
    for side in range(storage.current.shape[0]):
        leaves = bool(False)
        if storage.low.shape[0] > 0:
            leaves = storage.count[side, pixel] > PAIR
            if leaves:
                storage.low[side, pixel] = storage.least[side, pixel]
                storage.high[side, pixel] = storage.most[side, pixel]
            else:
                storage.low[side, pixel] = -1
                storage.high[side, pixel] = NO_ID
        if not leaves:
            storage.last[side, pixel] = storage.current[side, pixel]
            storage.current[side, pixel] = storage.following[side, pixel]
            storage.count[side, pixel] = 0


@cache
def visit_layers(take: wp.Function) -> wp.Function:
    """Return what a pass does with a fragment, given what is done with one of the current layers."""

    @wp.func(inline=True)
    def visit(storage: Any, worker: int, pixel: int, item: int, depth: Any):
        key = key_of(storage.keys, pixel, depth)
        sides = storage.current.shape[0]
        if storage.phase == DEPTH:
            if is_between(storage.last, pixel, key):
                if storage.count[0, pixel] <= PAIR:
                    bring_nearer(storage.current, pixel, 0, key)
                if sides > 1:
                    bring_nearer(storage.current, pixel, 1, -key)
        else:
            # The layer where both sides meet is the front's.
            side = int(-1)
            if key == storage.current[0, pixel]:
                side = 0
            elif sides > 1 and -key == storage.current[1, pixel]:
                side = 1
            if side < 0:
                if storage.phase == TAKE and is_between(storage.current, pixel, key):
                    bring_nearer(storage.following, pixel, 0, key)
                    if sides > 1:
                        bring_nearer(storage.following, pixel, 1, -key)
            elif storage.phase == TAKE:
                take(storage, worker, pixel, side, item, depth)
            elif item > storage.low[side, pixel] and item < storage.high[side, pixel]:
                storage.least[side, pixel] = wp.min(storage.least[side, pixel], item)
                storage.most[side, pixel] = wp.max(storage.most[side, pixel], item)
                storage.count[side, pixel] = storage.count[side, pixel] + 1

    return visit


def next_phase(method: Method, phase: int) -> int:
    """Return what the pass after one of a phase does."""
    if phase == int(IDS):
        return int(TAKE)
    if phase == int(TAKE) and not method.fused:
        return int(DEPTH)
    return int(IDS) if method.by_id else int(TAKE)


def left_of(arrays: Any) -> np.ndarray:
    """Return which pixels have a current layer, (P,)."""
    return np.isfinite(arrays.current.numpy()).any(axis=0)


def hide_peeled(arrays: Any, request: Request) -> None:
    """Have objects left out that every pixel has peeled."""
    if request.hide is not None:
        request.hide(np.where(left_of(arrays), arrays.last.numpy()[0], np.inf))


def allocate_peel(method: Method, request: Request, pool: Pool | None, log: Log) -> Callable[[Room], Any]:
    """Return the function that allocates what a method needs."""

    def allocate(room: Room) -> Any:
        sides, pixel_count = method.sides, room.pixel_count
        indices = ("count", *(IDENTIFIERS if method.by_id else ()))
        size = wp.types.type_size_in_bytes(room.number)
        state = sides * pixel_count * (3 * size + len(indices) * INDEX_BYTES)
        log.begin(state + kept_bytes(room, sides * method.slots))
        room.reserve(log.held, f"peeling {pixel_count} pixels", 0)
        arrays = Peel[room.number]()
        arrays.keys, arrays.phase = request.keys(), int(DEPTH)
        arrays.kept = allocate_kept(room, sides * method.slots)
        for name, value in (("last", -np.inf), ("current", np.inf), ("following", np.inf)):
            setattr(arrays, name, wp.full((sides, pixel_count), value, dtype=room.number, device=room.device))
        for name in indices:
            value = {"low": -1, "high": int(NO_ID)}.get(name, 0)
            setattr(arrays, name, wp.full((sides, pixel_count), value, dtype=int, device=room.device))
        if pool is not None:
            pool.begin()
            arrays.nodes = pool.allocate(room, log)
        return arrays

    return allocate


def peeling(method: Method, request: Request) -> Storage:
    """Return the storage of a method that peels by layers."""
    log = Log()
    pool = None if method.slots else Pool(request, lists=method.sides)

    def repeat(arrays: Any, room: Room) -> bool:
        log.passes += 1
        if arrays.phase == int(TAKE):
            if pool is not None:
                if pool.overflows(arrays, room, log):
                    return request.allows(log.passes)
                pool.log(arrays, room, log)
                pool.empty(arrays.nodes)
            else:
                log.take(room, arrays.kept)
            for_each_pixel(arrays, advance, room)
            hide_peeled(arrays, request)
        arrays.phase = next_phase(method, arrays.phase)
        return request.allows(log.passes) and bool(left_of(arrays).any())

    stage = Stage(visit_layers(method.take), begin_pass, order="submission", repeat=repeat)
    return Storage(
        method.name,
        Peel,
        allocate_peel(method, request, pool, log),
        (stage,),
        lambda arrays, room: log.lists(room),
        loses=method.loses or (pool is not None and not pool.grow) or request.options.max_passes is not None,
        serial=pool is not None and not pool.grow,
    )


@wp.func(inline=True)
def take_last(storage: Any, worker: int, pixel: int, side: int, item: int, depth: Any):
    """Take a fragment in place of those of the layer that were drawn before."""
    put(storage.kept, pixel, side, item, depth)


def f2b2(request: Request) -> Storage:
    """Return front-to-back peeling by two passes a layer."""
    return peeling(Method("f2b2", take_last), request)


def dual(request: Request) -> Storage:
    """Return dual depth peeling."""
    return peeling(Method("dual", take_last, sides=2, fused=True), request)


@wp.func(inline=True)
def begin_nearest(storage: Any, worker: int, pixel: int):
    """Forget the layer before."""
    storage.current[0, pixel] = type(storage.current[0, pixel])(wp.inf)
    storage.count[0, pixel] = 0
    storage.kept.items[pixel, 0] = -1


@wp.func(inline=True)
def keep_nearest(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Keep the nearest fragment behind the last one; of equals the last; count those in layers behind it."""
    key = key_of(storage.keys, pixel, depth)
    if key > storage.last[0, pixel]:
        nearest = storage.current[0, pixel]
        if key > nearest:
            storage.count[0, pixel] = storage.count[0, pixel] + 1
        else:
            if key < nearest and storage.kept.items[pixel, 0] >= 0:
                storage.count[0, pixel] = storage.count[0, pixel] + 1
            storage.current[0, pixel] = key
            put(storage.kept, pixel, 0, item, depth)


@wp.func(inline=True)
def end_nearest(storage: Any, worker: int, pixel: int):
    """Note up to where the pixel is peeled; it is left alone once nothing lies behind."""
    storage.last[0, pixel] = storage.current[0, pixel]
    if storage.count[0, pixel] == 0:
        storage.current[0, pixel] = type(storage.current[0, pixel])(wp.inf)


def f2b(request: Request) -> Storage:
    """Return front-to-back peeling."""
    log = Log()

    def repeat(arrays: Any, room: Room) -> bool:
        log.passes += 1
        log.take(room, arrays.kept)
        hide_peeled(arrays, request)
        return request.allows(log.passes) and bool(left_of(arrays).any())

    stage = Stage(keep_nearest, begin_nearest, end_nearest, order="submission", repeat=repeat)
    allocate = allocate_peel(Method("f2b", take_last), request, None, log)
    return Storage("f2b", Peel, allocate, (stage,), lambda arrays, room: log.lists(room), loses=True)
