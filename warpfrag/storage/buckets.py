"""Bucket peeling: the depth range of each pixel cut into B buckets, and all of them peeled at once.

    bun       buckets of equal length; of each the nearest and the farthest fragment a pass (Liu et al. 2009); of
              equals the last that is drawn
    bad       buckets of equal population, by an occupancy map that a pass of its own fills
    bun_ll    buckets of equal length, of each a list of all its fragments, in one pass (Vasilakis and Fudos 2013)

One more pass finds the range. All passes are in order of submission: a pixel belongs to one thread.
"""

from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.precisions import Array, Array2, Number, in_precisions
from warpfrag.storage.kept import INDEX_BYTES, Kept, Log, allocate_kept, clear_slots, kept_bytes, put
from warpfrag.storage.linked import Nodes, Pool, push
from warpfrag.storage.method import Room, Stage, Storage
from warpfrag.storage.occupancy import WORD_BITS, bucket_of, set_bucket
from warpfrag.storage.request import Keys, Request, key_of

wp.set_module_options({"enable_backward": False})


@in_precisions
class Buckets:
    """The buckets of each pixel; what a method does not need is empty.

    `near` and `far`, the range of its keys, (P,). `words` (P, d), which of 32 d equal parts of that are occupied, and
    `edges` (P, B), the first part of each bucket; without them buckets have equal lengths. By bucket, (P, B): keys
    between which nothing is peeled, `low` and `high`, and the `nearest` and `farthest` of those. `left` (P,), whether
    there is more. `kept` has two slots for each bucket, `nodes` B lists for each pixel.
    """

    keys: Keys
    kept: Kept
    nodes: Nodes
    near: Array[Number]
    far: Array[Number]
    words: Array2[wp.uint32]
    edges: Array2[wp.int32]
    low: Array2[Number]
    high: Array2[Number]
    nearest: Array2[Number]
    farthest: Array2[Number]
    left: Array[wp.int32]
    buckets: wp.int32


@wp.func(inline=True)
def clear_range(storage: Any, worker: int, pixel: int):
    """Empty the range of a pixel."""
    storage.near[pixel] = type(storage.near[pixel])(wp.inf)
    storage.far[pixel] = type(storage.far[pixel])(-wp.inf)


@wp.func(inline=True)
def widen_range(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Take a fragment into the range of its pixel."""
    key = key_of(storage.keys, pixel, depth)
    storage.near[pixel] = wp.min(storage.near[pixel], key)
    storage.far[pixel] = wp.max(storage.far[pixel], key)


@wp.func(inline=True)
def clear_words(storage: Any, worker: int, pixel: int):
    """Empty the occupancy map of a pixel."""
    for word in range(storage.words.shape[1]):
        storage.words[pixel, word] = wp.uint32(0)


@wp.func(inline=True)
def mark_part(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Note that a part of the range is occupied."""
    key = key_of(storage.keys, pixel, depth)
    parts = storage.words.shape[1] * WORD_BITS
    set_bucket(storage.words, pixel, bucket_of(key, storage.near[pixel], storage.far[pixel], parts))


@wp.func(inline=True)
def share_parts(storage: Any, worker: int, pixel: int):
    """Give every bucket the same number of occupied parts: of n, part number r goes to bucket r B / n."""
    occupied = int(0)
    parts = storage.words.shape[1] * WORD_BITS
    for part in range(parts):
        occupied += int((storage.words[pixel, part // WORD_BITS] >> wp.uint32(part % WORD_BITS)) & wp.uint32(1))
    rank = int(0)
    begun = int(0)
    for part in range(parts):
        if (storage.words[pixel, part // WORD_BITS] >> wp.uint32(part % WORD_BITS)) & wp.uint32(1) != wp.uint32(0):
            bucket = rank * storage.buckets // occupied
            while begun <= bucket:
                storage.edges[pixel, begun] = part
                begun += 1
            rank += 1
    while begun < storage.buckets:
        storage.edges[pixel, begun] = parts
        begun += 1


@wp.func(inline=True)
def bucket_at(storage: Any, pixel: int, key: Any) -> int:
    """Return the bucket of a key."""
    bucket = int(0)
    if storage.words.shape[0] > 0:
        part = bucket_of(key, storage.near[pixel], storage.far[pixel], storage.words.shape[1] * WORD_BITS)
        for later in range(1, storage.buckets):
            if storage.edges[pixel, later] <= part:
                bucket = later
    else:
        bucket = bucket_of(key, storage.near[pixel], storage.far[pixel], storage.buckets)
    return bucket


@wp.func(inline=True)
def begin_buckets(storage: Any, worker: int, pixel: int):
    """Forget what the pass before has captured."""
    storage.left[pixel] = 0
    clear_slots(storage.kept, pixel)
    for bucket in range(storage.buckets):
        storage.nearest[pixel, bucket] = type(storage.near[pixel])(wp.inf)
        storage.farthest[pixel, bucket] = type(storage.near[pixel])(-wp.inf)


@wp.func(inline=True)
def keep_outermost(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Keep the nearest and the farthest fragment of a bucket, and note whether others lie between them."""
    key = key_of(storage.keys, pixel, depth)
    bucket = bucket_at(storage, pixel, key)
    if key > storage.low[pixel, bucket] and key < storage.high[pixel, bucket]:
        nearest = storage.nearest[pixel, bucket]
        farthest = storage.farthest[pixel, bucket]
        if key != nearest and key != farthest and nearest < farthest:
            storage.left[pixel] = 1
        if key <= nearest:
            storage.nearest[pixel, bucket] = key
            put(storage.kept, pixel, 2 * bucket, item, depth)
        if key >= farthest:
            storage.farthest[pixel, bucket] = key
            put(storage.kept, pixel, 2 * bucket + 1, item, depth)


@wp.func(inline=True)
def end_buckets(storage: Any, worker: int, pixel: int):
    """Count a single fragment once, and go on inside of what has been captured."""
    for bucket in range(storage.buckets):
        if storage.nearest[pixel, bucket] == storage.farthest[pixel, bucket]:
            storage.kept.items[pixel, 2 * bucket + 1] = -1
        storage.low[pixel, bucket] = storage.nearest[pixel, bucket]
        storage.high[pixel, bucket] = storage.farthest[pixel, bucket]


@wp.func(inline=True)
def link_in_bucket(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Add a fragment to the list of its bucket."""
    bucket = bucket_at(storage, pixel, key_of(storage.keys, pixel, depth))
    push(storage.nodes, worker, bucket * storage.near.shape[0] + pixel, item, depth)


FIND_RANGE = Stage(widen_range, clear_range, order="submission")
FIND_EDGES = Stage(mark_part, clear_words, share_parts, order="submission")


def bun(request: Request) -> Storage:
    """Return the peeling of uniform buckets."""
    return _outermost("bun", request, adaptive=False)


def bad(request: Request) -> Storage:
    """Return the peeling of adaptive buckets."""
    return _outermost("bad", request, adaptive=True)


def _begin(request: Request, room: Room, log: Log, held: int) -> Any:
    """Return buckets with a range, where there is room for that and for what a method holds beside."""
    count, options = room.pixel_count, request.options
    log.begin(held + 2 * count * wp.types.type_size_in_bytes(room.number))
    room.reserve(log.held, f"{options.buckets} buckets for each of {count} pixels", 0)
    arrays = Buckets[room.number]()
    arrays.keys, arrays.buckets = request.keys(), options.buckets
    for name in ("near", "far"):
        setattr(arrays, name, wp.empty(count, dtype=room.number, device=room.device))
    return arrays


def _outermost(name: str, request: Request, *, adaptive: bool) -> Storage:
    log, options = Log(), request.options

    def allocate(room: Room) -> Any:
        count, number, device = room.pixel_count, room.number, room.device
        words = options.words if adaptive else 0
        indices = (1 + words + (options.buckets if adaptive else 0)) * INDEX_BYTES
        held = count * (indices + 4 * options.buckets * wp.types.type_size_in_bytes(number))
        arrays = _begin(request, room, log, held + kept_bytes(room, 2 * options.buckets))
        arrays.kept = allocate_kept(room, 2 * options.buckets)
        for name, value in (("low", -np.inf), ("high", np.inf), ("nearest", np.inf), ("farthest", -np.inf)):
            setattr(arrays, name, wp.full((count, options.buckets), value, dtype=number, device=device))
        arrays.left = wp.zeros(count, dtype=int, device=device)
        if adaptive:
            arrays.words = wp.empty((count, words), dtype=wp.uint32, device=device)
            arrays.edges = wp.empty((count, options.buckets), dtype=int, device=device)
        return arrays

    def repeat(arrays: Any, room: Room) -> bool:
        log.passes += 1
        log.take(room, arrays.kept)
        return request.allows(first + log.passes) and bool(arrays.left.numpy().any())

    before = (FIND_RANGE, FIND_EDGES) if adaptive else (FIND_RANGE,)
    first = len(before)
    peel = Stage(keep_outermost, begin_buckets, end_buckets, order="submission", repeat=repeat)
    return Storage(name, Buckets, allocate, (*before, peel), lambda arrays, room: log.lists(room), loses=True)


def bun_ll(request: Request) -> Storage:
    """Return uniform buckets of lists."""
    log, pool = Log(), Pool(request, lists=request.options.buckets)

    def allocate(room: Room) -> Any:
        pool.begin()
        arrays = _begin(request, room, log, 0)
        arrays.nodes = pool.allocate(room, log)
        return arrays

    def repeat(arrays: Any, room: Room) -> bool:
        return pool.overflows_or_logs(arrays, room, log)

    stages = (FIND_RANGE, Stage(link_in_bucket, order="submission", repeat=repeat))
    return Storage(
        "bun_ll", Buckets, allocate, stages, lambda arrays, room: log.lists(room), not pool.grow, serial=not pool.grow
    )
