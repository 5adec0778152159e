"""Linked lists: fragments of a pixel as nodes from one pool (Yang et al. 2010), or as pages of a few (Crassin 2010).

    linked_list    a node a fragment; its link leads to the fragment that came before it
    paged_list     a page for every few fragments of a pixel

Nobody knows beforehand how many fragments there will be. A pool that overflows is doubled and the pass repeated (as
Maule et al. do), or what finds no room is lost, and counted. On the CPU a worker takes pages from a part of the pool of
its own; a pool that does not grow has one worker, so that what it loses does not depend on the number of threads: it
keeps what comes first, bands of rows one after the other, in order of submission in each. (On CUDA it is the first to
come, which may be others in every run.)
"""

from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import SMALLEST_PIECE
from warpfrag.arrays.precisions import Array, Array2, Number, in_precisions
from warpfrag.arrays.scratch import ROW_GAP
from warpfrag.storage.kept import INDEX_BYTES, Log
from warpfrag.storage.method import Room, Stage, Storage
from warpfrag.storage.request import Request

wp.set_module_options({"enable_backward": False})

# Fragments a pixel that a pool has room for where nothing else is asked for.
POOL_PER_PIXEL = 2
# Columns of the counters.
TAKEN = wp.constant(0)
LOST = wp.constant(1)


@in_precisions
class Nodes:
    """Lists of pages.

    By list: `heads`, its newest page or -1, and `sizes`, its number of entries. By page: `following`, the page before
    it or -1, and `items` and `depths` of its entries. By worker: `counters`, pages taken and fragments lost. A worker
    may take `share` pages.
    """

    heads: Array[wp.int32]
    sizes: Array[wp.int32]
    following: Array[wp.int32]
    items: Array2[wp.int32]
    depths: Array2[Number]
    counters: Array2[wp.int32]
    share: wp.int32


@wp.func(inline=True)
def push(nodes: Any, worker: int, number: int, item: int, depth: Any):
    """Add a fragment to a list that belongs to one thread."""
    place = nodes.sizes[number] % nodes.items.shape[1]
    page = nodes.heads[number]
    if place == 0:
        taken = wp.atomic_add(nodes.counters, worker, TAKEN, 1)
        if taken < nodes.share:
            nodes.following[worker * nodes.share + taken] = page
            page = worker * nodes.share + taken
            nodes.heads[number] = page
        else:
            page = -1
            wp.atomic_add(nodes.counters, worker, LOST, 1)
    if page >= 0:
        nodes.items[page, place] = item
        nodes.depths[page, place] = depth
        nodes.sizes[number] = nodes.sizes[number] + 1


@wp.func(inline=True)
def push_node(nodes: Any, worker: int, number: int, item: int, depth: Any):
    """Add a fragment to a list, of pages of one, that several threads may add to."""
    taken = wp.atomic_add(nodes.counters, worker, TAKEN, 1)
    if taken < nodes.share:
        node = worker * nodes.share + taken
        nodes.items[node, 0] = item
        nodes.depths[node, 0] = depth
        nodes.following[node] = wp.atomic_exch(nodes.heads, number, node)
        wp.atomic_add(nodes.sizes, number, 1)
    else:
        wp.atomic_add(nodes.counters, worker, LOST, 1)


class Pool:
    """The pool of all lists of an image, seen from the host.

    Args:
        request: what is asked for: `pool` and `grow`.
        page: fragments of a page.
        lists: lists of a pixel.

    Attributes:
        lost: fragments that found no room, in all passes that were not repeated.
    """

    def __init__(self, request: Request, page: int = 1, lists: int = 1):
        self.page, self.lists, self.grow = page, lists, request.options.grow
        self._first = request.options.pool
        self.begin()

    def begin(self) -> None:
        """Forget what has happened."""
        self.lost, self._size = 0, self._first

    def bytes(self, room: Room) -> int:
        """Return the memory of the pool and its lists [bytes]."""
        entry = INDEX_BYTES + wp.types.type_size_in_bytes(room.number)
        pages = self._share(room) * _workers(room)
        return pages * (INDEX_BYTES + self.page * entry) + 2 * INDEX_BYTES * self.lists * room.pixel_count

    def allocate(self, room: Room, log: Log) -> Any:
        """Return the nodes, of which the log is told how much they take.

        Raises:
            MemoryError: there is no room for them.
        """
        share = self._share(room)
        pages = share * _workers(room)
        log.pooled = self.bytes(room)
        room.reserve(log.held + log.pooled, f"a pool of {pages * self.page} fragments", log.count)
        nodes = Nodes[room.number]()
        nodes.share = share
        nodes.heads = wp.full(self.lists * room.pixel_count, -1, dtype=int, device=room.device)
        nodes.sizes = wp.zeros(self.lists * room.pixel_count, dtype=int, device=room.device)
        nodes.following = wp.empty(pages, dtype=int, device=room.device)
        nodes.items = wp.empty((pages, self.page), dtype=int, device=room.device)
        nodes.depths = wp.empty((pages, self.page), dtype=room.number, device=room.device)
        nodes.counters = wp.zeros((_workers(room), ROW_GAP), dtype=int, device=room.device)
        return nodes

    def overflows(self, arrays: Any, room: Room, log: Log) -> bool:
        """Tell whether a pass has to be repeated, with nodes that are emptied, and more of them.

        Raises:
            MemoryError: there is no room for more.
        """
        lost = int(arrays.nodes.counters.numpy()[:, int(LOST)].sum())
        if lost and self.grow:
            self._size = 2 * self._share(room) * _workers(room) * self.page
            # The old nodes go before the new ones come.
            arrays.nodes = Nodes[room.number]()
            arrays.nodes = self.allocate(room, log)
            return True
        self.lost += lost
        return False

    def overflows_or_logs(self, arrays: Any, room: Room, log: Log) -> bool:
        """Tell whether a pass has to be repeated; if not, add what it found to a log."""
        if self.overflows(arrays, room, log):
            return True
        self.log(arrays, room, log)
        return False

    def empty(self, nodes: Any) -> None:
        """Begin all lists anew."""
        nodes.heads.fill_(-1)
        nodes.sizes.zero_()
        nodes.counters.zero_()

    def log(self, arrays: Any, room: Room, log: Log) -> None:
        """Add the entries of all lists to a log; list n is one of pixel n modulo P."""
        nodes = arrays.nodes
        heads, following, items, depths = (
            array.numpy() for array in (nodes.heads, nodes.following, nodes.items, nodes.depths)
        )
        lists = np.flatnonzero(heads >= 0)
        page, filled = heads[lists], (nodes.sizes.numpy()[lists] - 1) % self.page + 1
        while len(lists):
            taken = np.arange(self.page) < filled[:, None]
            log.add(room, np.repeat(lists % room.pixel_count, filled), items[page][taken], depths[page][taken])
            older = following[page] >= 0
            lists, page = lists[older], following[page][older]
            # All pages but the newest are full.
            filled = np.full(len(lists), self.page)

    def _share(self, room: Room) -> int:
        size = POOL_PER_PIXEL * room.pixel_count if self._size is None else self._size
        return -(-size // (self.page * _workers(room)))


def _workers(room: Room) -> int:
    """Return how many workers there are work for."""
    return max(1, min(room.workers, room.pixel_count // SMALLEST_PIECE))


@in_precisions
class Linked:
    """The lists of pixels."""

    nodes: Nodes


@wp.func(inline=True)
def link_node(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Add a fragment to the list of its pixel."""
    push_node(storage.nodes, worker, pixel, item, depth)


@wp.func(inline=True)
def link_page(storage: Any, worker: int, pixel: int, item: int, depth: Any):
    """Add a fragment to the newest page of its pixel."""
    push(storage.nodes, worker, pixel, item, depth)


def linked_list(request: Request) -> Storage:
    """Return the storage of linked lists of fragments."""
    return _linked("linked_list", request, 1, Stage(link_node))


def paged_list(request: Request) -> Storage:
    """Return the storage of linked lists of pages."""
    return _linked("paged_list", request, request.options.page, Stage(link_page, order="submission"))


def _linked(name: str, request: Request, page: int, stage: Stage) -> Storage:
    pool, log = Pool(request, page), Log()

    def allocate(room: Room) -> Any:
        pool.begin()
        log.begin()
        arrays = Linked[room.number]()
        arrays.nodes = pool.allocate(room, log)
        return arrays

    def repeat(arrays: Any, room: Room) -> bool:
        return pool.overflows_or_logs(arrays, room, log)

    stages = (Stage(stage.visit, order=stage.order, repeat=repeat),)
    return Storage(
        name, Linked, allocate, stages, lambda arrays, room: log.lists(room), not pool.grow, serial=not pool.grow
    )
