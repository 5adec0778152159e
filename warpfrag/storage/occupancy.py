"""Occupancy maps (Vasilakis and Papaioannou 2015): which fragments cannot be among the K nearest of their pixel.

A pixel's depth range is cut into S = 32 d buckets of equal length, each a bit of d words: 1 if any fragment falls into
it. Up to the bucket of the K-th bit set there are K fragments at least, as no bit stands for less than one (Lemma 2.1):
what lies in a later bucket is not among the K nearest, and need not be shaded. Buckets are compared, not depths: the
bucket never falls as the depth grows, so that rounding cannot cull what is in front.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

WORD_BITS = wp.constant(32)


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
