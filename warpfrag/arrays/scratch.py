"""Scratch memory: rows of arrays that belong to a thread each, sized from the fields of a structure."""

from collections.abc import Iterable, Mapping
from typing import Any

import warp as wp

# Unused entries between rows: two threads that write the same cache line slow each other down.
ROW_GAP = 32


def field_types(structure: Any, names: Iterable[str] | None = None) -> dict[str, Any]:
    """Return the element types of a structure's array fields by name, of all or of some."""
    arrays = {name: field.type for name, field in structure.vars.items() if isinstance(field.type, wp.array)}
    return {name: arrays[name].dtype for name in (arrays if names is None else names)}


def row_bytes(structure: Any, lengths: Mapping[str, int]) -> int:
    """Return the memory of one thread's rows [bytes], given the length of each array's."""
    types = field_types(structure, lengths)
    return sum(length * wp.types.type_size_in_bytes(types[name]) for name, length in lengths.items())


def fill_rows(scratch: Any, rows: int, lengths: Mapping[str, int], device: wp.Device) -> None:
    """Give arrays of a structure so many rows, of the given lengths, one after the other."""
    types = field_types(scratch._cls, lengths)
    for name, length in lengths.items():
        setattr(scratch, name, wp.empty(rows * length, dtype=types[name], device=device))
