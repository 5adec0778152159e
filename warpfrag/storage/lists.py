"""One list of exact length for each pixel: count its fragments, find where its list begins, store, sort.

    dfb         the dynamic fragment buffer (Maule et al. 2012): one prefix sum over the counts
    dxdfb       the deep frame buffer of the DirectX SDK: a prefix sum by log2 P passes over all counts
    s_buffer    the S-buffer (Vasilakis and Fudos 2012): pixels take their lists from a few shared counters, so that
                only these are summed up; lists are in arbitrary order in memory

Counts and stored fragments come from the same walk, so that they agree. On CUDA a pixel's fragments come in any order;
then the sort makes it deterministic. On the CPU they come in order of submission.
"""

from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import Array, Number, in_precisions, kernels
from warpfrag.arrays.sorting import shell_sort
from warpfrag.raster.cover import each_pixel
from warpfrag.storage.method import PixelLists, Room, Stage, Storage, scan_counts, total_of

wp.set_module_options({"enable_backward": False})

INDEX_BYTES = 4
# Counters of the S-buffer, of which pixels take their lists.
SHARED_COUNTERS = wp.constant(32)


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


def _allocate_lists(room: Room, starts: wp.array, total: int, copies: int = 1) -> Any:
    """Return lists that begin at `starts[pixel + 1]`, where there is room for them, or so many copies of them."""
    depths = total if room.keep_depths else 0
    size = wp.types.type_size_in_bytes(room.number)
    room.reserve(copies * (total * INDEX_BYTES + depths * size), f"{total} fragments", total)
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


DYNAMIC = Storage(
    "dfb",
    ListArrays,
    lambda room: _allocate_lists(room, *scan_counts(room.counts)),
    (Stage(store),),
    _collect,
    counted=True,
)


@kernels
def add_shifted() -> Any:
    """Return the kernel of one pass of a prefix sum."""

    def kernel(span: Span, sums: wp.array(dtype=int), distance: int, longer: wp.array(dtype=int)):
        """Add to each sum the one that ends where it begins, so that it reaches over twice as many counts.

        Args:
            span: the pixels.
            sums: over `distance` counts each, or all there are, (P,).
            distance: number of counts.
            longer: output, over twice as many, (P,).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            value = sums[pixel]
            if pixel >= distance:
                value += sums[pixel - distance]
            longer[pixel] = value

    return kernel


def _allocate_doubling(room: Room) -> Any:
    total, pixel_count = total_of(room.counts), room.pixel_count
    sums, longer = wp.clone(room.counts), wp.empty_like(room.counts)
    distance = 1
    while distance < pixel_count:
        launch(add_shifted(), pixel_count, [sums, distance, longer], room.device)
        sums, longer, distance = longer, sums, 2 * distance
    starts = wp.zeros(pixel_count + 1, dtype=int, device=room.device)
    if pixel_count > 1:
        wp.copy(starts[2:], sums[: pixel_count - 1])
    return _allocate_lists(room, starts, total)


DIRECTX = Storage("dxdfb", ListArrays, _allocate_doubling, (Stage(store),), _collect, counted=True)


@kernels
def take_lists(base: bool) -> Any:
    """Return the kernel in which pixels take lists from counters, or add to these where the counter's own begin."""
    adds = int(base)

    def kernel(span: Span, counts: wp.array(dtype=int), counters: wp.array(dtype=int), starts: wp.array(dtype=int)):
        """Give every pixel with fragments a list.

        Args:
            span: the pixels.
            counts: fragments of each pixel, (P,).
            counters: entries that each counter has given away, or where its entries begin, (`SHARED_COUNTERS`,).
            starts: where the list of each pixel begins among those of its counter, or of all, (P,).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            counter = pixel % SHARED_COUNTERS
            if adds != 0:
                starts[pixel] = starts[pixel] + counters[counter]
            elif counts[pixel] > 0:
                starts[pixel] = wp.atomic_add(counters, counter, counts[pixel])

    return kernel


def _allocate_scattered(room: Room) -> Any:
    total, pixel_count = total_of(room.counts), room.pixel_count
    starts = wp.zeros(pixel_count + 1, dtype=int, device=room.device)
    counters = wp.zeros(int(SHARED_COUNTERS), dtype=int, device=room.device)
    begins = wp.empty_like(counters)
    if pixel_count:
        own = [room.counts, counters, starts[1:]]
        # Pixels share counters, so one thread of the CPU goes through all of them.
        launch(take_lists(False), pixel_count, own, room.device, 1 if room.device.is_cpu else None)
        wp.utils.array_scan(counters, begins, inclusive=False)
        launch(take_lists(True), pixel_count, [room.counts, begins, starts[1:]], room.device)
    return _allocate_lists(room, starts, total, copies=2)


@wp.struct
class Moved:
    """Where the lists of all pixels end, (P + 1,), and where they are to begin, (P + 1,)."""

    ends: wp.array[wp.int32]
    offsets: wp.array[wp.int32]


@kernels
def gather_lists(number: Any) -> Any:
    """Return the kernel that puts lists in the order of their pixels."""

    def kernel(
        span: Span,
        moved: Moved,
        scattered: ListArrays[number],
        items: wp.array(dtype=int),
        depths: wp.array(dtype=number),
    ):
        """Copy the list of each pixel.

        Args:
            span: the pixels.
            moved: where lists are, and where they go.
            scattered: the lists.
            items: output, (F,).
            depths: output, (F,), or empty.
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = moved.offsets[pixel]
            count = moved.offsets[pixel + 1] - begin
            source = moved.ends[pixel + 1] - count
            for entry in range(count):
                items[begin + entry] = scattered.items[source + entry]
                if depths.shape[0] > 0:
                    depths[begin + entry] = scattered.depths[source + entry]

    return kernel


def _collect_scattered(arrays: Any, room: Room) -> PixelLists:
    moved = Moved()
    moved.ends = arrays.offsets
    # After a pixel's beginning comes the next one's, and in the end that of none.
    starts, total = scan_counts(room.counts)
    moved.offsets = wp.full(room.pixel_count + 1, total, dtype=int, device=room.device)
    if room.pixel_count:
        wp.copy(moved.offsets[: room.pixel_count], starts[1:])
    items, depths = wp.empty_like(arrays.items), wp.empty_like(arrays.depths)
    launch(gather_lists(room.number), room.pixel_count, [moved, arrays, items, depths], room.device)
    return PixelLists(moved.offsets, items, depths, as_submitted=room.device.is_cpu)


SCATTERED = Storage("s_buffer", ListArrays, _allocate_scattered, (Stage(store),), _collect_scattered, counted=True)


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
