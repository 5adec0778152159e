"""The dynamic fragment buffer (Maule et al. 2012): count the fragments of each pixel, prefix sum, store, sort.

Counts and stored fragments come from the same walk, so that they agree. On CUDA a pixel's fragments come in any order;
then the sort makes it deterministic. On the CPU they come in order of submission.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import Array, Number, in_precisions, kernels
from warpfrag.storage.method import PixelLists, Room, Stage, Storage, scan_counts

wp.set_module_options({"enable_backward": False})

INDEX_BYTES = 4


@in_precisions
class ListArrays:
    """Where each pixel's next fragment goes, (P,), and the fragments: what they are, and their depths, if kept."""

    following: Array[wp.int32]
    offsets: Array[wp.int32]
    items: Array[wp.int32]
    depths: Array[Number]


@wp.func(inline=True)
def store(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Put a fragment behind those of its pixel that are there already."""
    place = wp.atomic_add(storage.following, pixel, 1)
    storage.items[place] = item
    if place < storage.depths.shape[0]:
        storage.depths[place] = depth


def _allocate(room: Room) -> Any:
    starts, total = scan_counts(room.counts)
    depths = total if room.keep_depths else 0
    size = wp.types.type_size_in_bytes(room.number)
    room.reserve(total * INDEX_BYTES + depths * size, f"{total} fragments", total)
    arrays = ListArrays[room.number]()
    # Storing moves the beginnings on to the ends, so that these become the offsets.
    arrays.offsets = starts
    if room.pixel_count:
        arrays.following = starts[1:]
    arrays.items = wp.empty(total, dtype=int, device=room.device)
    arrays.depths = wp.empty(depths, dtype=room.number, device=room.device)
    return arrays


def _collect(arrays: Any, room: Room) -> PixelLists:
    return PixelLists(arrays.offsets, arrays.items, arrays.depths, as_submitted=room.device.is_cpu)


DYNAMIC = Storage("dfb", ListArrays, _allocate, (Stage(store),), _collect, counted=True)


@wp.func
def precedes(depth: Any, item: int, other_depth: Any, other_item: int):
    """Tell whether a fragment comes before another, by depth, then by submission."""
    if depth != other_depth:
        return depth < other_depth
    return item < other_item


@kernels
def sort_pixels(number: Any) -> Any:
    """Return the kernel that sorts the fragments of pixels."""

    def kernel(span: Span, offsets: wp.array(dtype=int), items: wp.array(dtype=int), depths: wp.array(dtype=number)):
        """Sort each pixel's fragments.

        Args:
            span: the pixels.
            offsets: see `PixelLists`, (P + 1,).
            items: output, (F,).
            depths: output, (F,), or empty: then items are sorted as numbers.
        """
        by_depth = depths.shape[0] > 0
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = offsets[pixel]
            count = offsets[pixel + 1] - begin
            # Shell's sort with Knuth's gaps (1, 4, 13, ...); short lists start at gap 1, an insertion sort.
            gap = int(1)
            while 9 * gap < count:
                gap = 3 * gap + 1
            while gap > 0:
                for i in range(gap, count):
                    face = items[begin + i]
                    depth = number(0.0)
                    other_depth = number(0.0)
                    if by_depth:
                        depth = depths[begin + i]
                    j = int(i)
                    moving = bool(True)
                    while moving and j >= gap:
                        other = begin + j - gap
                        if by_depth:
                            other_depth = depths[other]
                        moving = precedes(depth, face, other_depth, items[other])
                        if moving:
                            items[begin + j] = items[other]
                            if by_depth:
                                depths[begin + j] = other_depth
                            j -= gap
                    if j != i:
                        items[begin + j] = face
                        if by_depth:
                            depths[begin + j] = depth
                gap = gap // 3

    return kernel


def sort_lists(lists: PixelLists) -> None:
    """Sort each pixel's fragments in place: by depth, then as submitted; without depths as submitted."""
    count, device = lists.items.shape[0], lists.items.device
    if count == 0 or (lists.depths.shape[0] == 0 and lists.as_submitted):
        return
    inputs = [lists.offsets, lists.items, lists.depths]
    launch(sort_pixels(lists.depths.dtype), lists.offsets.shape[0] - 1, inputs, device)
