"""What a pass captures, in a few slots of each pixel, and what all passes have captured so far.

The slots of a pass are emptied into a log in the memory of the host, which in the end becomes the lists of the pixels.
"""

from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.precisions import Array2, Number, in_precisions
from warpfrag.storage.method import PixelLists, Room

wp.set_module_options({"enable_backward": False})

INDEX_BYTES = 4


@in_precisions
class Kept:
    """Slots of each pixel, (P, K): `items`, such as triangles, -1 where a slot is empty, and their `depths`."""

    items: Array2[wp.int32]
    depths: Array2[Number]


def kept_bytes(room: Room, slots: int) -> int:
    """Return the memory of so many slots a pixel [bytes]."""
    return room.pixel_count * slots * (INDEX_BYTES + wp.types.type_size_in_bytes(room.number))


def allocate_kept(room: Room, slots: int) -> Any:
    """Return empty slots."""
    kept = Kept[room.number]()
    kept.items = wp.full((room.pixel_count, slots), -1, dtype=int, device=room.device)
    kept.depths = wp.empty((room.pixel_count, slots), dtype=room.number, device=room.device)
    return kept


@wp.func(inline=True)
def put(kept: Any, pixel: int, slot: int, item: int, depth: Any):
    """Write a slot."""
    kept.items[pixel, slot] = item
    kept.depths[pixel, slot] = depth


@wp.func(inline=True)
def clear_slots(kept: Any, pixel: int):
    """Empty the slots of a pixel."""
    for slot in range(kept.items.shape[1]):
        kept.items[pixel, slot] = -1


class Log:
    """Fragments that passes have captured.

    Attributes:
        count: their number.
        passes: passes that have been logged.
        held: memory that the method holds beside the log, and beside its pool [bytes].
        pooled: memory of its pool of nodes, if it has one [bytes].
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self, held: int = 0) -> None:
        """Forget everything."""
        self.count, self.passes, self.held, self.pooled = 0, 0, held, 0
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, room: Room, pixels: np.ndarray, items: np.ndarray, depths: np.ndarray) -> None:
        """Add fragments of any pixels.

        Raises:
            MemoryError: there are more than the room allows.
        """
        self.count += len(items)
        entry_bytes = 2 * INDEX_BYTES + wp.types.type_size_in_bytes(room.number)
        room.reserve(self.held + self.pooled + self.count * entry_bytes, f"{self.count} fragments", self.count)
        self._parts.append((pixels.astype(np.int32), items, depths))

    def take(self, room: Room, kept: Any) -> None:
        """Add what is in the slots of a pass."""
        items = kept.items.numpy()
        pixels, slots = np.nonzero(items >= 0)
        self.add(room, pixels, items[pixels, slots], kept.depths.numpy()[pixels, slots])

    def lists(self, room: Room) -> PixelLists:
        """Return all fragments as the lists of their pixels, those of a pixel as they were added."""
        number = np.float64 if room.number is wp.float64 else np.float32
        nothing = (np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, number))
        pixels, items, depths = (np.concatenate(parts) for parts in zip(nothing, *self._parts, strict=True))
        order = np.argsort(pixels, kind="stable")
        offsets = np.cumsum([0, *np.bincount(pixels, minlength=room.pixel_count)]).astype(np.int32)
        own_depths = depths[order] if room.keep_depths else nothing[2]

        def there(array: np.ndarray, dtype: Any) -> wp.array:
            return wp.array(array, dtype=dtype, device=room.device)

        return PixelLists(there(offsets, int), there(items[order], int), there(own_depths, room.number))
