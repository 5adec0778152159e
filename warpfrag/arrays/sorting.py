"""Sorting the short lists of a pixel inside a kernel: Shell's sort, with the comparison as an ingredient.

The gaps are Knuth's (1, 4, 13, …): short lists start at gap 1, an insertion sort. What is sorted are the numbers in an
array `order`; a number's key is looked up when it is picked up, or lies in an array beside `order` and moves with it.
"""

from functools import cache
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def stays(data: Any, source: int, target: int):
    """Move no key: it is looked up by number."""
    pass


@wp.func(inline=True)
def is_known(data: Any, at: int, key: Any):
    """Store no key: it is looked up by number."""
    pass


@cache
def shell_sort(
    key_at: wp.Function, precedes: wp.Function, move: wp.Function = stays, store: wp.Function = is_known
) -> wp.Function:
    """Return the function `(data, order, base, count)` that sorts `order[base : base + count]`.

    Args:
        key_at: `(data, at, number)` returns the key of the number at a place of `order`.
        precedes: `(data, number, key, other_at, other)` tells whether a number that was picked up comes before another.
        move: `(data, source, target)` moves a key that lies beside its number.
        store: `(data, at, key)` stores it.
    """

    @wp.func(inline=True)
    def sort(data: Any, order: wp.array[wp.int32], base: int, count: int):
        gap = int(1)
        while 9 * gap < count:
            gap = 3 * gap + 1
        while gap > 0:
            for position in range(gap, count):
                number = order[base + position]
                key = key_at(data, base + position, number)
                j = int(position)
                while j >= gap and precedes(data, number, key, base + j - gap, order[base + j - gap]):
                    order[base + j] = order[base + j - gap]
                    move(data, base + j - gap, base + j)
                    j -= gap
                order[base + j] = number
                store(data, base + j, key)
            gap = gap // 3

    return sort
