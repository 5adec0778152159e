"""What a storage is: stages that any producer feeds, here linked lists and a peeling, and what they may take."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from capture_scenes import perspective, quad, scene, soup

from warpfrag.arrays.precisions import Array, Array2, Number, in_precisions
from warpfrag.capture.surfaces import surfaces_of
from warpfrag.raster.ray import Window
from warpfrag.storage.lists import DYNAMIC, sort_lists
from warpfrag.storage.method import (
    PixelLists,
    Room,
    Stage,
    Storage,
    count_fragments,
    fill,
    for_each_pixel,
    offsets_of,
    scan_counts,
)

wp.set_module_options({"enable_backward": False})


def room_for(triangles, reserve=lambda *told: None) -> Room:
    """Return the room of a storage of triangles."""
    pixel_count = triangles.window.pixel_count
    return Room(pixel_count, triangles.points.dtype, triangles.device, reserve, counts=count_fragments(triangles))


@in_precisions
class Linked:
    """Nodes (workers, nodes), the head of each pixel's list, and the lists that become of them."""

    head: Array[wp.int32]
    counts: Array[wp.int32]
    used: Array[wp.int32]
    following: Array2[wp.int32]
    item: Array2[wp.int32]
    depth: Array2[Number]
    offsets: Array[wp.int32]
    items: Array[wp.int32]
    depths: Array[Number]


@wp.func(inline=True)
def no_nodes(lists: Any, worker: int, pixel: int):
    """Begin with an empty list."""
    lists.head[pixel] = -1
    lists.counts[pixel] = 0


@wp.func(inline=True)
def push(lists: Any, worker: int, pixel: int, item: int, depth: Any):
    """Put a fragment in front of its pixel's list, in a node of the worker's own."""
    node = wp.atomic_add(lists.used, worker, 1)
    if node < lists.item.shape[1]:
        lists.item[worker, node] = item
        lists.depth[worker, node] = depth
        lists.following[worker, node] = lists.head[pixel]
        lists.head[pixel] = node * lists.item.shape[0] + worker
        lists.counts[pixel] = lists.counts[pixel] + 1


@wp.func(inline=True)
def unlink(lists: Any, worker: int, pixel: int):
    """Write a list to its place among all."""
    place = lists.offsets[pixel]
    address = lists.head[pixel]
    while address >= 0:
        node = address // lists.item.shape[0]
        owner = address - node * lists.item.shape[0]
        lists.items[place] = lists.item[owner, node]
        lists.depths[place] = lists.depth[owner, node]
        address = lists.following[owner, node]
        place += 1


def new_nodes(lists: Any, room: Room, count: int) -> None:
    """Allocate so many nodes for each worker."""
    room.reserve(room.workers * count * 12, f"{room.workers * count} nodes", 0)
    lists.used = wp.zeros(room.workers, dtype=int, device=room.device)
    lists.following = wp.empty((room.workers, count), dtype=int, device=room.device)
    lists.item = wp.empty((room.workers, count), dtype=int, device=room.device)
    lists.depth = wp.empty((room.workers, count), dtype=room.number, device=room.device)


def allocate_linked(room: Room) -> Any:
    """Allocate lists with too few nodes."""
    lists = Linked[room.number]()
    lists.head = wp.empty(room.pixel_count, dtype=int, device=room.device)
    lists.counts = wp.empty(room.pixel_count, dtype=int, device=room.device)
    new_nodes(lists, room, 1000)
    return lists


def more_nodes(lists: Any, room: Room) -> bool:
    """Double the nodes where they were too few, and repeat."""
    count = lists.item.shape[1]
    if lists.used.numpy().max() <= count:
        return False
    new_nodes(lists, room, 2 * count)
    return True


def collect_linked(lists: Any, room: Room) -> PixelLists:
    """Unlink the lists."""
    lists.offsets, total = offsets_of(lists.counts)
    lists.items = wp.empty(total, dtype=int, device=room.device)
    lists.depths = wp.empty(total, dtype=room.number, device=room.device)
    for_each_pixel(lists, unlink, room)
    return PixelLists(lists.offsets, lists.items, lists.depths)


LINKED = Storage("linked", Linked, allocate_linked, (Stage(push, before=no_nodes, repeat=more_nodes),), collect_linked)


@in_precisions
class Peeled:
    """By pixel the depth of the last layer, and the nearest fragment behind it; by worker how many there are."""

    behind: Array[Number]
    depth: Array[Number]
    item: Array[wp.int32]
    found: Array[wp.int32]


@wp.func(inline=True)
def begin_layer(layer: Any, worker: int, pixel: int):
    """Begin with nothing."""
    layer.depth[pixel] = type(layer.depth[pixel])(wp.inf)
    layer.item[pixel] = -1


@wp.func(inline=True)
def keep_nearest(layer: Any, worker: int, pixel: int, item: int, depth: Any):
    """Keep the nearest fragment behind the last layer."""
    if depth > layer.behind[pixel] and depth < layer.depth[pixel]:
        layer.depth[pixel] = depth
        layer.item[pixel] = item


@wp.func(inline=True)
def end_layer(layer: Any, worker: int, pixel: int):
    """Go on behind this layer."""
    layer.behind[pixel] = layer.depth[pixel]
    if layer.item[pixel] >= 0:
        layer.found[worker] = layer.found[worker] + 1


def peeling(layers: list[np.ndarray]) -> Storage:
    """Return front-to-back peeling that appends the triangles of each layer to a list."""

    def allocate(room: Room) -> Any:
        layer = Peeled[room.number]()
        layer.behind = wp.zeros(room.pixel_count, dtype=room.number, device=room.device)
        layer.depth = wp.empty(room.pixel_count, dtype=room.number, device=room.device)
        layer.item = wp.empty(room.pixel_count, dtype=int, device=room.device)
        layer.found = wp.zeros(room.workers, dtype=int, device=room.device)
        return layer

    def any_left(layer: Any, room: Room) -> bool:
        found = bool(layer.found.numpy().any())
        layer.found.zero_()
        if found:
            layers.append(layer.item.numpy().copy())
        return found

    stage = Stage(keep_nearest, before=begin_layer, after=end_layer, order="submission", repeat=any_left)
    return Storage("front-to-back", Peeled, allocate, (stage,), lambda layer, room: None, loses=True)


def triangles_of(setting):
    """Return the triangles of a scene."""
    return surfaces_of(setting, setting.camera).triangles(Window.of(setting.camera))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_linked_lists_hold_the_same_fragments(threads, monkeypatch):
    """Nodes of each worker's own, doubled until they are enough; sorted, the lists are those of the dynamic buffer."""
    monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
    triangles = triangles_of(scene(perspective((60, 50)), soup(1, 60), quad(2.0), quad(2.0, name="twin")))
    told: list[tuple] = []
    expected = fill(DYNAMIC, triangles, room_for(triangles))
    found = fill(LINKED, triangles, room_for(triangles, lambda *one: told.append(one)))
    assert len(told) > 2
    assert [nodes for nodes, _, _ in told[1:]] == [2 * nodes for nodes, _, _ in told[:-1]]
    for lists in (found, expected):
        sort_lists(lists)
    for name in ("offsets", "items", "depths"):
        np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(expected, name).numpy())


def test_peeling_repeats_until_nothing_is_left():
    """Layer by layer, front-to-back peeling finds all fragments of distinct depths, in the order of the sorted ones."""
    triangles = triangles_of(scene(perspective((40, 30)), soup(3, 40)))
    lists = fill(DYNAMIC, triangles, room_for(triangles))
    sort_lists(lists)
    layers: list[np.ndarray] = []
    fill(peeling(layers), triangles, room_for(triangles))
    counts = np.diff(lists.offsets.numpy())
    assert len(layers) == counts.max() > 5
    peeled = np.stack(layers, 1)
    np.testing.assert_array_equal(peeled[peeled >= 0], lists.items.numpy())


def test_room_is_told_before_anything_is_allocated():
    """A storage says how much it will take, and of how many fragments it knows; what is refused is not stored."""
    triangles = triangles_of(scene(perspective((8, 6)), quad(2.0), quad(3.0, name="other")))
    told = []

    def refuse(*one):
        told.append(one)
        raise MemoryError("no")

    with pytest.raises(MemoryError, match="no"):
        fill(DYNAMIC, triangles, room_for(triangles, refuse))
    assert told == [(96 * (4 + 4), "96 fragments", 96)]


def test_too_many_fragments_for_offsets_are_refused():
    """More fragments than int32 counts are an error, not an overflow."""
    with pytest.raises(ValueError, match="4294967294 fragments, expected at most 2147483647"):
        scan_counts(wp.array(np.full(2, 2**31 - 1, np.int32), device="cpu"))
