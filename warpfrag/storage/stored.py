"""Stored fragments as a producer: they go into a storage as they are in the lists of their pixels."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.precisions import kernels
from warpfrag.raster.cover import nothing
from warpfrag.slabs.lists import FragmentLists, no_invalid, report_invalid, valid_fragment
from warpfrag.storage.method import Room, Storage

wp.set_module_options({"enable_backward": False})


@kernels
def visit_lists(number: Any, structure: Any, visit: Any, before: Any, after: Any) -> Any:
    """Return the kernel that visits stored fragments."""

    def kernel(
        span: Span, lists: FragmentLists[number], arrays: structure, invalid: wp.array2d(dtype=int)
    ):  # fmt: skip
        """Visit the fragments of each pixel, in order.

        Args:
            span: the pixels.
            lists: the fragments.
            arrays: output, the storage.
            invalid: output, see `no_invalid`.
        """
        storage = arrays
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            before(storage, span.worker, pixel)
            for fragment in range(lists.offsets[pixel], lists.offsets[pixel + 1]):
                if not valid_fragment(lists, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                visit(storage, span.worker, pixel, fragment, lists.depth[fragment])
            after(storage, span.worker, pixel)

    return kernel


def stream(storage: Storage, lists: Any, room: Room, inputs: SimpleNamespace) -> Any:
    """Store fragments, and return what the storage collects.

    Args:
        storage: where to.
        lists: the fragments, `FragmentLists`.
        room: how much it may take.
        inputs: the arrays that the lists were made of.

    Raises:
        ValueError: a fragment has values that are not finite or out of range.
    """
    arrays = storage.allocate(room)
    rows = worker_count(room.pixel_count, room.device, 0)
    for stage in storage.stages:
        again = True
        while again:
            functions = (stage.visit, stage.before or nothing, stage.after or nothing)
            invalid = no_invalid(rows, room.device)
            kernel = visit_lists(room.number, arrays._cls, *functions)
            launch(kernel, room.pixel_count, [lists, arrays, invalid], room.device, rows)
            report_invalid(invalid, inputs)
            again = stage.repeat is not None and stage.repeat(arrays, room)
    return storage.collect(arrays, room)
