"""What a storage is: what each pixel does with the fragments that it is given, and what is left of them in the end.

A storage is a structure of arrays and a few functions in stages; a producer walks over the fragments and calls these.
One stage is one pass over all fragments:

    visit(storage, worker, pixel, item, depth)      before(storage, worker, pixel)      after(storage, worker, pixel)

as in `warpfrag.raster.cover`: a pixel belongs to one thread at a time where passes are in order of submission, and
always on the CPU. What else a stage writes, such as nodes from a pool, belongs to the worker; on CUDA all threads are
worker 0, and take from its pool by atomics. A new method to store or peel fragments is a `Storage`; shading, gradients,
sorting and memory limits are those of all.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import launch, worker_count
from warpfrag.raster.cover import Order, cover, each_pixel
from warpfrag.raster.triangles import RasterTriangles

wp.set_module_options({"enable_backward": False})

MOST_FRAGMENTS = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Room:
    """For whom a storage is, and how much it may take.

    Attributes:
        pixel_count: number of pixels, P.
        number: Warp type of depths.
        device: where.
        reserve: `(bytes, what, fragment_count)`: told before anything is allocated how much a storage will take, for
            what, and of how many fragments it knows already; raises `MemoryError` if that is too much.
        keep_depths: whether the depths of fragments are to be kept beside them.
        counts: number of fragments of each pixel, (P,) int32; for storages that are `counted`.
        serial: whether there is one worker on the CPU, whatever the number of threads.
    """

    pixel_count: int
    number: Any
    device: wp.Device
    reserve: Callable[[int, str, int], None]
    keep_depths: bool = True
    counts: wp.array | None = None
    serial: bool = False

    @property
    def workers(self) -> int:
        """Number of workers, who are numbered from 0."""
        if self.serial:
            return 1
        return worker_count(self.pixel_count, self.device, 0) if self.device.is_cpu else 1


@dataclass(frozen=True, eq=False)
class PixelLists:
    """The fragments of each pixel.

    Attributes:
        offsets: pixel p has the entries offsets[p] : offsets[p + 1], (P + 1,) int32.
        items: what each is, such as a triangle, (F,) int32.
        depths: distance from the eye along the pixel's ray [scene units], (F,), or empty.
        as_submitted: whether the entries of a pixel are in order of submission.
    """

    offsets: wp.array
    items: wp.array
    depths: wp.array
    as_submitted: bool = False


@dataclass(frozen=True, eq=False)
class Stage:
    """One pass over all fragments.

    Attributes:
        visit: called for each fragment.
        before: called for each pixel before its fragments, or None.
        after: called for each pixel after its fragments, or None.
        order: in which a pixel's fragments come: "any", or that of "submission".
        repeat: `(arrays, room) -> bool`, called on the host after the pass: whether to make it once more; may allocate
            more. None: never.
    """

    visit: wp.Function
    before: wp.Function | None = None
    after: wp.Function | None = None
    order: Order = "any"
    repeat: Callable[[Any, Room], bool] | None = None


@dataclass(frozen=True, eq=False)
class Storage:
    """A way to store fragments.

    Attributes:
        name: what it is called.
        arrays: its structure, in both precisions.
        allocate: `(room) -> arrays`: reserves and allocates them.
        stages: the passes, in order.
        collect: `(arrays, room)`: what is left: `PixelLists`, which the rest of a capture takes, or slots.
        loses: whether there may be fragments that it drops.
        counted: whether it wants to know each pixel's number of fragments beforehand, which is a pass of its own.
        serial: whether it needs one worker for the whole image on the CPU, as which fragments it drops would else
            depend on the number of threads.
    """

    name: str
    arrays: Any
    allocate: Callable[[Room], Any]
    stages: tuple[Stage, ...]
    collect: Callable[[Any, Room], Any]
    loses: bool = False
    counted: bool = False
    serial: bool = False


def fill(storage: Storage, triangles: RasterTriangles, room: Room) -> Any:
    """Store what triangles cover, and return what the storage collects.

    Raises:
        MemoryError: the storage would take more than the room allows.
    """
    room = replace(room, serial=storage.serial)
    arrays = storage.allocate(room)
    for stage in storage.stages:
        again = True
        while again:
            cover(triangles, arrays, stage.visit, stage.before, stage.after, stage.order, room.workers)
            again = stage.repeat is not None and stage.repeat(arrays, room)
    return storage.collect(arrays, room)


def for_each_pixel(arrays: Any, function: wp.Function, room: Room) -> None:
    """Call `function(storage, worker, pixel)` for each pixel."""
    workers = room.workers if room.device.is_cpu else None
    launch(each_pixel(arrays._cls, function), room.pixel_count, [arrays], room.device, workers)


@wp.struct
class Counts:
    """Number of fragments of each pixel, (P,)."""

    counts: wp.array[wp.int32]


@wp.func(inline=True)
def count_one(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Count a fragment."""
    wp.atomic_add(storage.counts, pixel, 1)


def count_fragments(triangles: RasterTriangles) -> wp.array:
    """Return how many triangles cover each pixel centre, (P,) int32."""
    arrays = Counts()
    arrays.counts = wp.zeros(triangles.window.pixel_count, dtype=int, device=triangles.device)
    cover(triangles, arrays, count_one)
    return arrays.counts


def total_of(counts: wp.array) -> int:
    """Return the number of all fragments.

    Raises:
        ValueError: there are more than 32-bit offsets can count.
    """
    total = int(counts.numpy().sum(dtype=np.int64))
    if total > MOST_FRAGMENTS:
        raise ValueError(
            f"capture: got {total} fragments, expected at most {MOST_FRAGMENTS}; capture fewer rows at a time"
        )
    return total


def scan_counts(counts: wp.array) -> tuple[wp.array, int]:
    """Return where each pixel's fragments begin, as `starts[pixel + 1]` (P + 1,), and their number.

    Storing moves the starts on to the ends: then they are the offsets of `Fragments`.

    Raises:
        ValueError: there are more fragments than 32-bit offsets can count.
    """
    return _scan(counts, inclusive=False)


def offsets_of(counts: wp.array) -> tuple[wp.array, int]:
    """Return the offsets of lists of so many fragments (P + 1,), and the number of all.

    Raises:
        ValueError: there are more fragments than 32-bit offsets can count.
    """
    return _scan(counts, inclusive=True)


def _scan(counts: wp.array, *, inclusive: bool) -> tuple[wp.array, int]:
    total = int(counts.numpy().sum(dtype=np.int64))
    if total > MOST_FRAGMENTS:
        raise ValueError(
            f"capture: got {total} fragments, expected at most {MOST_FRAGMENTS}; capture fewer rows at a time"
        )
    scanned = wp.zeros(counts.shape[0] + 1, dtype=int, device=counts.device)
    if counts.shape[0]:
        wp.utils.array_scan(counts, scanned[1:], inclusive=inclusive)
    return scanned, total
