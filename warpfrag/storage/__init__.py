"""Storages: what a pixel does with the fragments that it is given.

The room is also a public name, `wf.storage`: of what stands on it, in `capture`, it knows where that is, and no more.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Captured": "warpfrag.capture.captured",
    "Culling": "warpfrag.capture.bounded",
    "capture": "warpfrag.capture.captured",
    "capture_kbuffer": "warpfrag.capture.bounded",
    "count_culled": "warpfrag.capture.bounded",
    "kbuffer_bytes": "warpfrag.storage.into_slots",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warpfrag.storage' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
