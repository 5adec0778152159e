"""Occupancy maps (Vasilakis and Papaioannou 2015): which fragments cannot be among the K nearest of their pixel.

A pixel's depth range is cut into S = 32 d buckets of equal length, each a bit of d words: 1 if any fragment falls into
it. Up to the bucket of the K-th bit set there are K fragments at least, as no bit stands for less than one (Lemma 2.1):
what lies in a later bucket is not among the K nearest, and need not be shaded. Buckets are compared, not depths: the
bucket never falls as the depth grows, so that rounding cannot cull what is in front.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Array, Array2, Number, in_precisions
from warpfrag.storage.method import Stage

wp.set_module_options({"enable_backward": False})

WORD_BITS = wp.constant(32)

# Rows of the tally: all fragments of a pixel, those that the occupancy map culls, those behind all slots.
TALLY_ALL = wp.constant(0)
TALLY_OCCUPANCY = wp.constant(1)
TALLY_BEHIND = wp.constant(2)
TALLY_ROWS = 3


@in_precisions
class Occupancy:
    """Occupancy maps: words (P, d), range of depth (P,), last bucket that is not culled (P,); empty for no culling.

    `wanted` is K; `tally` (`TALLY_ROWS`, P) counts fragments, or is empty.
    """

    words: Array2[wp.uint32]
    near: Array[Number]
    far: Array[Number]
    last: Array[wp.int32]
    wanted: wp.int32
    tally: Array2[wp.int32]


def allocate_occupancy(pixel_count: int, words: int, wanted: int, number: Any, device: wp.Device) -> Any:
    """Return maps of so many words a pixel, 0 for none, of which the K = `wanted` nearest are not culled."""
    occupancy = Occupancy[number]()
    occupancy.wanted = wanted
    if words:
        occupancy.words = wp.empty((pixel_count, words), dtype=wp.uint32, device=device)
        occupancy.near = wp.empty(pixel_count, dtype=number, device=device)
        occupancy.far = wp.empty(pixel_count, dtype=number, device=device)
        occupancy.last = wp.empty(pixel_count, dtype=int, device=device)
    return occupancy


def occupancy_bytes(words: int, number: Any) -> int:
    """Return the memory of a pixel's map of so many words, 0 for none [bytes]."""
    return 4 * words + 2 * wp.types.type_size_in_bytes(number) + 4 if words else 0


@wp.func(inline=True)
def bucket_of(z: Any, near: Any, far: Any, count: int) -> int:
    """Return the bucket of a depth, of `count` buckets from the nearest to the farthest fragment of the pixel."""
    extent = wp.float64(far) - wp.float64(near)
    bucket = int(0)
    if extent > wp.float64(0.0):
        bucket = int((wp.float64(z) - wp.float64(near)) / extent * wp.float64(count))
    return wp.clamp(bucket, 0, count - 1)


@wp.func(inline=True)
def set_bucket(words: wp.array2d[wp.uint32], pixel: int, bucket: int):
    """Set the bit of a bucket."""
    word = bucket // WORD_BITS
    words[pixel, word] = words[pixel, word] | (wp.uint32(1) << wp.uint32(bucket - word * WORD_BITS))


@wp.func(inline=True)
def last_bucket(words: wp.array2d[wp.uint32], pixel: int, bits: int) -> int:
    """Return the bucket of the `bits`-th bit set, counted by clearing the lowest; the last one if there are fewer."""
    bucket = int(words.shape[1] * WORD_BITS - 1)
    found = int(0)
    for word in range(words.shape[1]):
        left = wp.uint32(words[pixel, word])
        while left != wp.uint32(0) and found < bits:
            rest = left & (left - wp.uint32(1))
            found += 1
            if found == bits:
                bit = int(0)
                while (rest ^ left) >> wp.uint32(bit) != wp.uint32(1):
                    bit += 1
                bucket = word * WORD_BITS + bit
            left = rest
    return bucket


@wp.func(inline=True)
def is_culled(occupancy: Any, pixel: int, depth: Any):
    """Tell whether a pixel's occupancy map has enough fragments in front of a depth."""
    culled = bool(False)
    if occupancy.words.shape[0] > 0:
        count = occupancy.words.shape[1] * WORD_BITS
        culled = bucket_of(depth, occupancy.near[pixel], occupancy.far[pixel], count) > occupancy.last[pixel]
    return culled


@wp.func(inline=True)
def tally(occupancy: Any, row: int, pixel: int):
    """Count a fragment in a row of the tally."""
    if occupancy.tally.shape[0] > 0:
        occupancy.tally[row, pixel] = occupancy.tally[row, pixel] + 1


@wp.func(inline=True)
def clear(storage: Any, worker: int, pixel: int):
    """Empty a pixel's range and map."""
    near = storage.occupancy.near[pixel]
    storage.occupancy.near[pixel] = type(near)(wp.inf)
    storage.occupancy.far[pixel] = type(near)(-wp.inf)
    for word in range(storage.occupancy.words.shape[1]):
        storage.occupancy.words[pixel, word] = wp.uint32(0)


@wp.func(inline=True)
def widen(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Take a depth into its pixel's range."""
    storage.occupancy.near[pixel] = wp.min(storage.occupancy.near[pixel], depth)
    storage.occupancy.far[pixel] = wp.max(storage.occupancy.far[pixel], depth)


@wp.func(inline=True)
def mark(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Set the bit of a depth's bucket."""
    count = storage.occupancy.words.shape[1] * WORD_BITS
    bucket = bucket_of(depth, storage.occupancy.near[pixel], storage.occupancy.far[pixel], count)
    set_bucket(storage.occupancy.words, pixel, bucket)


@wp.func(inline=True)
def find_last(storage: Any, worker: int, pixel: int):
    """Find the last bucket that is not culled."""
    storage.occupancy.last[pixel] = last_bucket(storage.occupancy.words, pixel, storage.occupancy.wanted)


# The passes that fill the maps of a storage, which has them as `occupancy`.
FILL_MAPS = (Stage(widen, before=clear, order="submission"), Stage(mark, after=find_last, order="submission"))
