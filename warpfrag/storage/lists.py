"""The dynamic fragment buffer (Maule et al. 2012): count the fragments of each pixel, prefix sum, store, sort.

Counts and stored fragments come from the same walk, so that they agree. On CUDA a pixel's fragments come in any order;
then the sort makes it deterministic. On the CPU they come in order of submission.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.launch import launch
from warpfrag.arrays.precisions import Array, Number, in_precisions
from warpfrag.arrays.sorting import shell_sort
from warpfrag.raster.cover import each_pixel
from warpfrag.storage.method import PixelLists, Room, Stage, Storage, scan_counts

wp.set_module_options({"enable_backward": False})

INDEX_BYTES = 4


@in_precisions
class ListArrays:
    """Where each pixel's next fragment goes, (P,); `PixelLists`; and 0."""

    following: Array[wp.int32]
    offsets: Array[wp.int32]
    items: Array[wp.int32]
    depths: Array[Number]
    zero: Number


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


@wp.func(inline=True)
def depth_of(lists: Any, at: int, item: int):
    """Return the depth that lies beside an item; 0 without depths."""
    depth = lists.zero
    if lists.depths.shape[0] > 0:
        depth = lists.depths[at]
    return depth


@wp.func(inline=True)
def precedes(lists: Any, item: int, depth: Any, other_at: int, other: int):
    """Tell whether a fragment comes before another: by depth, then by submission."""
    other_depth = depth_of(lists, other_at, other)
    if depth != other_depth:
        return depth < other_depth
    return item < other


@wp.func(inline=True)
def move_depth(lists: Any, source: int, target: int):
    """Move a depth with its item."""
    if lists.depths.shape[0] > 0:
        lists.depths[target] = lists.depths[source]


@wp.func(inline=True)
def store_depth(lists: Any, at: int, depth: Any):
    """Put a depth beside its item."""
    if lists.depths.shape[0] > 0:
        lists.depths[at] = depth


_sort = shell_sort(depth_of, precedes, move_depth, store_depth)


@wp.func(inline=True)
def sort_pixel(storage: Any, worker: int, pixel: int):
    """Sort the fragments of a pixel."""
    begin = storage.offsets[pixel]
    _sort(storage, storage.items, begin, storage.offsets[pixel + 1] - begin)


def sort_lists(lists: PixelLists) -> None:
    """Sort each pixel's fragments in place: by depth, then as submitted; without depths as submitted."""
    count, device = lists.items.shape[0], lists.items.device
    if count == 0 or (lists.depths.shape[0] == 0 and lists.as_submitted):
        return
    arrays = ListArrays[lists.depths.dtype]()
    arrays.offsets, arrays.items, arrays.depths = lists.offsets, lists.items, lists.depths
    launch(each_pixel(arrays._cls, sort_pixel), lists.offsets.shape[0] - 1, [arrays], device)
