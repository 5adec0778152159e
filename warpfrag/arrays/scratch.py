"""Scratch memory: rows of arrays that belong to a thread each, allocated from the fields of a structure."""

from collections.abc import Iterable
from typing import Any

import warp as wp

# Unused entries between rows: two threads that write the same cache line slow each other down.
ROW_GAP = 32


def _element_types(scratch: Any, names: Iterable[str] | None) -> dict[str, Any]:
    fields = {name: field.type for name, field in scratch._cls.vars.items() if isinstance(field.type, wp.array)}
    return {name: fields[name].dtype for name in (fields if names is None else names)}


def row_bytes(scratch: Any, length: int, names: Iterable[str] | None = None, twice: Iterable[str] = ()) -> int:
    """Return the memory of a thread's rows [bytes]; see `fill_rows`."""
    types = _element_types(scratch, names)
    double = set(twice)
    return sum((2 if name in double else 1) * length * wp.types.type_size_in_bytes(t) for name, t in types.items())


def fill_rows(
    scratch: Any,
    rows: int,
    length: int,
    device: wp.Device,
    names: Iterable[str] | None = None,
    twice: Iterable[str] = (),
) -> None:
    """Allocate the arrays of a structure: so many rows, one after the other.

    Args:
        scratch: the structure.
        rows: number of rows, one for each thread.
        length: entries of a row.
        device: where.
        names: which of its arrays; None for all.
        twice: those whose rows have twice the length.
    """
    double = set(twice)
    for name, dtype in _element_types(scratch, names).items():
        setattr(scratch, name, wp.empty(rows * length * (2 if name in double else 1), dtype=dtype, device=device))
