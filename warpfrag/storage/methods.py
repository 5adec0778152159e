"""All methods to capture fragments, by name: what each takes, what it may lose, and how much memory its paper says.

Formulas are those of Table 1 of the peeling paper (Vasilakis and Fudos 2013), in words of 4 bytes a pixel for modern
hardware, and of section IV of the paper of the dynamic fragment buffer (Maule et al. 2012), there for fragments of two
words. K: slots (or buckets); n: fragments of a pixel, on average; N: most of them; c: share of pixels that are covered;
C: most fragments of equal depth of a pixel, on average; d: words of an occupancy map.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from math import ceil
from typing import Any, NamedTuple, get_args

from warpfrag.errors import check_choice, check_whole, shorten, suggest
from warpfrag.storage.kept import INDEX_BYTES
from warpfrag.storage.method import Storage
from warpfrag.storage.request import MOST_DEPTH_BITS, Cull, Options, Request

_PEELS = ("depth_bits", "max_passes")
_FRONT = (*_PEELS, "cull_objects")
_POOL = ("pool", "grow")


class Counted(NamedTuple):
    """What the formulas of the papers depend on; letters as above."""

    n: float
    most: int
    covered: float
    coplanar: float


@dataclass(frozen=True)
class Method:
    """A way to capture fragments.

    Attributes:
        home: where its storage is made: module and name in it.
        loses: what it may lose; empty for nothing.
        formula: the memory of its paper, words.
        words: the same as a function of the options and of what is counted.
        options: the options that it takes.
        defaults: those that are not those of `Options`.
    """

    home: str
    loses: str
    formula: str
    words: Callable[[Options, Counted], float]
    options: tuple[str, ...] = ()
    defaults: tuple[tuple[str, Any], ...] = ()


_EQUAL = "all but one fragment of equal depth"
_BEYOND = "fragments beyond the slots"
_EQUAL_BEYOND = "fragments of equal depth beyond the slots"


def _slots(options: Options, packed: int) -> int:
    return options.slots * (packed if options.packed else 1)


def _map(options: Options) -> int:
    return options.words + 3 if options.cull else 0


METHODS: dict[str, Method] = {
    "dfb": Method("lists.DYNAMIC", "", "2 c N", lambda o, s: 2 * s.covered * s.most),
    "dxdfb": Method("lists.DIRECTX", "", "2 · 8", lambda o, s: 16),
    "s_buffer": Method("lists.SCATTERED", "", "2 n + 3", lambda o, s: 2 * s.n + 3),
    "fixed_array": Method("first.fixed_array", _BEYOND, "2 K + 2", lambda o, s: 2 * o.slots + 2, ("slots",)),
    "linked_list": Method("linked.linked_list", "", "3 n + 3", lambda o, s: 3 * s.n + 3, _POOL),
    "paged_list": Method(
        "linked.paged_list",
        "",
        "2 c ⌈N / page⌉ page",
        lambda o, s: 2 * s.covered * ceil(s.most / o.page) * o.page,
        (*_POOL, "page"),
    ),
    "f2b": Method("peeling.f2b", _EQUAL, "3", lambda o, s: 3, _FRONT),
    "f2b2": Method("peeling.f2b2", _EQUAL, "3", lambda o, s: 3, _FRONT),
    "f2b_2p": Method("coplanar.f2b_2p", "", "10", lambda o, s: 10, _FRONT),
    "f2b_3p": Method("coplanar.f2b_3p", "", "10", lambda o, s: 10, _FRONT),
    "f2b_ll": Method("coplanar.f2b_ll", "", "2 C + 4", lambda o, s: 2 * s.coplanar + 4, (*_FRONT, *_POOL)),
    "f2b_fab": Method(
        "coplanar.f2b_fab", _EQUAL_BEYOND, "K + 4", lambda o, s: _slots(o, 4) + 4, (*_FRONT, "slots", "packed")
    ),
    "f2b_kb": Method(
        "coplanar.f2b_kb", _EQUAL_BEYOND, "K + 3", lambda o, s: _slots(o, 4) + 3, (*_FRONT, "slots", "packed")
    ),
    "dual": Method("peeling.dual", _EQUAL, "6", lambda o, s: 6, _PEELS),
    "dual_2p": Method("coplanar.dual_2p", "", "20", lambda o, s: 20, _PEELS),
    "dual_ll": Method("coplanar.dual_ll", "", "2 · 2 C + 6", lambda o, s: 4 * s.coplanar + 6, (*_PEELS, *_POOL)),
    "dual_fab": Method(
        "coplanar.dual_fab", _EQUAL_BEYOND, "K + 6", lambda o, s: _slots(o, 4) + 6, (*_PEELS, "slots", "packed")
    ),
    "bun": Method("buckets.bun", _EQUAL, "4 K + 2", lambda o, s: 4 * o.buckets + 2, (*_PEELS, "buckets")),
    "bad": Method("buckets.bad", _EQUAL, "6 K + 3", lambda o, s: 6 * o.buckets + 3, (*_PEELS, "buckets", "words")),
    "bun_ll": Method("buckets.bun_ll", "", "3 n + 8", lambda o, s: 3 * s.n + 8, (*_POOL, "buckets", "depth_bits")),
    "kb": Method(
        "nearest.kb",
        _BEYOND,
        "2 K + 2",
        lambda o, s: 2 * _slots(o, 2) + 2 + _map(o),
        ("slots", "packed", "hazard", "depth_bits", "cull", "words"),
    ),
    "multi_kb": Method(
        "nearest.multi_kb", _EQUAL_BEYOND, "2 K + 2", lambda o, s: 2 * _slots(o, 2) + 2, (*_FRONT, "slots", "packed")
    ),
    "srab": Method(
        "first.srab",
        _BEYOND,
        "3 K + 2",
        lambda o, s: 3 * o.slots + 2,
        ("slots", "max_passes"),
        (("max_passes", 1),),
    ),
    "k_plus_array": Method(
        "nearest.k_plus_array",
        _BEYOND,
        "2 K + 2, as the k-buffer; d + 3 for a map",
        lambda o, s: 2 * o.slots + 2 + _map(o),
        ("slots", "depth_bits", "cull", "words"),
    ),
    "k_plus_heap": Method(
        "nearest.k_plus_heap",
        _BEYOND,
        "2 K + 2, as the k-buffer; d + 3 for a map",
        lambda o, s: 2 * o.slots + 2 + _map(o),
        ("slots", "depth_bits", "cull", "words"),
        (("slots", 32),),
    ),
}


def check_method(name: Any, options: Mapping[str, Any]) -> Options:
    """Return the options of a method, checked.

    Raises:
        TypeError: an option that the method does not take, or a value of the wrong type.
        ValueError: a method that does not exist, or a value that is out of its range or does not go with another.
    """
    check_choice("method", name, tuple(METHODS))
    method = METHODS[name]
    for option in options:
        if option not in method.options:
            taken = suggest(option, method.options) if method.options else "it takes no options"
            raise TypeError(f"{option}: got {shorten(options[option])}, expected no such option of {name} ({taken})")
    checked = Options(**{**dict(method.defaults), **options})
    for option in ("slots", "page", "buckets", "hazard", "words"):
        check_whole(option, getattr(checked, option), 1)
    for option in ("pool", "max_passes"):
        if getattr(checked, option) is not None:
            check_whole(option, getattr(checked, option), 1)
    if checked.depth_bits is not None:
        check_whole("depth_bits", checked.depth_bits, 1, MOST_DEPTH_BITS)
    for option in ("grow", "packed", "cull_objects"):
        if not isinstance(getattr(checked, option), bool):
            raise TypeError(f"{option}: got {shorten(getattr(checked, option))}, expected True or False")
    if checked.cull is not None:
        check_choice("cull", checked.cull, get_args(Cull))
        # A map of no more buckets than slots culls nothing.
        check_whole("words", checked.words, checked.slots * (2 if checked.packed else 1) // 32 + 1)
    for option in ("cull", "cull_objects"):
        if getattr(checked, option) and checked.depth_bits is not None:
            raise ValueError(
                f"depth_bits: got {checked.depth_bits} with {option}, expected None (it culls by depths as they are)"
            )
    return checked


def storage_of(name: str, request: Request) -> Storage:
    """Return the storage of a method, given what is asked of it."""
    module, attribute = METHODS[name].home.split(".")
    made = getattr(import_module(f"warpfrag.storage.{module}"), attribute)
    return made if isinstance(made, Storage) else made(request)


def losses(name: str, options: Options) -> str:
    """Word what a method may lose with these options; empty for nothing."""
    words = [METHODS[name].loses] if METHODS[name].loses else []
    if "grow" in METHODS[name].options and not options.grow:
        words.append("what finds no room in the pool")
    if options.max_passes is not None:
        words.append("what is left after the last pass")
    return "; ".join(words)


def paper_bytes(name: str, options: Options, counted: Counted, pixel_count: int) -> int:
    """Return how much memory the paper of a method says that it takes [bytes]."""
    return round(METHODS[name].words(options, counted) * pixel_count * INDEX_BYTES)
