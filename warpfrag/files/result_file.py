"""A fit's `result.json`, read back: the parameters that it found."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.errors import SceneError, shorten, suggest
from warpfrag.files.source import read_regular, wording_of_path

_MOST_BYTES = 256 * 2**20
_MOST_ARRAY_BYTES = 2 * 2**30


def read_found(path: Path, known: Collection[str]) -> dict[str, Any]:
    """Read the parameters that a fit found.

    Args:
        path: its `result.json`; arrays lie in the file beside it that it names.
        known: names of the scene's parameters.

    Returns:
        Floats and float64 arrays by name.

    Raises:
        SceneError: the file cannot be read, or has no parameters of this scene.
    """
    name = wording_of_path(path)
    try:
        content = json.loads(read_regular(path, "the result.json of a fit", _MOST_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        if reason.startswith("got "):
            raise SceneError(f"{name}: {reason}") from None
        raise SceneError(f"{name}: got what is not JSON ({reason}), expected the result.json of a fit") from None
    found = content.get("found") if isinstance(content, dict) else None
    if not isinstance(found, dict) or not found:
        raise SceneError(f'{name}: got no table "found", expected the result.json of a fit')
    values: dict[str, Any] = {}
    for key, value in found.items():
        if key not in known:
            raise SceneError(f"{name}: got the unknown name {shorten(key)}; {suggest(key, known)}")
        values[key] = _value(path, key, value)
    return values


def _value(path: Path, key: str, value: Any) -> Any:
    name = f"{wording_of_path(path)}: found.{key}"
    if isinstance(value, dict):
        value = _array(path, key, value, name)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    if not np.isfinite(array).all():
        raise SceneError(f"{name}: got {shorten(value)}, expected finite numbers")
    return float(array) if array.ndim == 0 else array


def _array(path: Path, key: str, value: dict[str, Any], name: str) -> np.ndarray:
    """Return an array that lies beside the file."""
    file = value.get("file")
    if not isinstance(file, str) or Path(file).name != file:
        raise SceneError(f"{name}: got {shorten(file)} for its file, expected the name of a file beside it")
    beside = path.parent / file
    try:
        read_regular(beside, "the arrays of a fit", _MOST_ARRAY_BYTES)
        with np.load(beside, allow_pickle=False) as arrays:
            return arrays[f"found.{key}"]
    except (OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise SceneError(f"{name}: cannot be read from {wording_of_path(beside)} ({reason})") from error
