"""Peeling that minds equal depths (Vasilakis and Fudos 2013): what is done with all fragments of a layer.

    -2p, -3p      two of a layer at a time, those of the least and the greatest id in between the last pair; the next
                  layer once no more than two are left. All fragments, in memory of fixed size
    -ll           all of them at once, as a list that the next layer uses again
    -fab, -kb     the first K of them, by a counter, or by a search for a free slot; 4 K where attributes are packed

from the front (`f2b_`) or from both ends (`dual_`). By two passes a layer, or pair, three for -3p; `f2b_2p` and
`dual_2p` find the next depth while they take fragments, so that they make one pass more at the start.
"""

from typing import Any

import warp as wp

from warpfrag.storage.kept import put
from warpfrag.storage.linked import push
from warpfrag.storage.method import Storage
from warpfrag.storage.peeling import Method, peeling
from warpfrag.storage.request import Request

wp.set_module_options({"enable_backward": False})

# Slots that one of unpacked attributes makes where these are packed, 8 bits a channel.
PACKED = 4


@wp.func(inline=True)
def take_pair(storage: Any, worker: int, pixel: int, side: int, item: int, depth: Any):
    """Take the fragments of the least and the greatest id."""
    if item == storage.least[side, pixel]:
        put(storage.kept, pixel, 2 * side, item, depth)
    elif item == storage.most[side, pixel]:
        put(storage.kept, pixel, 2 * side + 1, item, depth)


@wp.func(inline=True)
def take_all(storage: Any, worker: int, pixel: int, side: int, item: int, depth: Any):
    """Take every fragment into the list of its side."""
    push(storage.nodes, worker, side * storage.current.shape[1] + pixel, item, depth)


@wp.func(inline=True)
def take_counted(storage: Any, worker: int, pixel: int, side: int, item: int, depth: Any):
    """Take the first fragments, as many as there are slots."""
    slots = storage.kept.items.shape[1] // storage.current.shape[0]
    taken = storage.count[side, pixel]
    if taken < slots:
        put(storage.kept, pixel, side * slots + taken, item, depth)
        storage.count[side, pixel] = taken + 1


@wp.func(inline=True)
def take_free(storage: Any, worker: int, pixel: int, side: int, item: int, depth: Any):
    """Take a fragment into the first slot that is free."""
    slots = storage.kept.items.shape[1] // storage.current.shape[0]
    slot = int(side * slots)
    end = slot + slots
    while slot < end and storage.kept.items[pixel, slot] >= 0:
        slot += 1
    if slot < end:
        put(storage.kept, pixel, slot, item, depth)


def f2b_2p(request: Request) -> Storage:
    """Return peeling by pairs of ids, two passes a pair."""
    return peeling(Method("f2b_2p", take_pair, by_id=True, fused=True, slots=2, loses=False), request)


def f2b_3p(request: Request) -> Storage:
    """Return peeling by pairs of ids, three passes a pair."""
    return peeling(Method("f2b_3p", take_pair, by_id=True, slots=2, loses=False), request)


def dual_2p(request: Request) -> Storage:
    """Return dual peeling by pairs of ids."""
    return peeling(Method("dual_2p", take_pair, sides=2, by_id=True, fused=True, slots=2, loses=False), request)


def f2b_ll(request: Request) -> Storage:
    """Return peeling with a list of each layer."""
    return peeling(Method("f2b_ll", take_all, slots=0, loses=False), request)


def dual_ll(request: Request) -> Storage:
    """Return dual peeling with lists of both layers."""
    return peeling(Method("dual_ll", take_all, sides=2, slots=0, loses=False), request)


def f2b_fab(request: Request) -> Storage:
    """Return peeling with an array for each layer."""
    return peeling(Method("f2b_fab", take_counted, slots=_slots(request)), request)


def f2b_kb(request: Request) -> Storage:
    """Return peeling with the slots of a k-buffer for each layer."""
    return peeling(Method("f2b_kb", take_free, slots=_slots(request)), request)


def dual_fab(request: Request) -> Storage:
    """Return dual peeling with an array for both layers."""
    return peeling(Method("dual_fab", take_counted, sides=2, slots=_slots(request)), request)


def _slots(request: Request) -> int:
    return request.options.slots * (PACKED if request.options.packed else 1)
