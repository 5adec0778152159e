"""What arrays a scene is assembled in: kind, precision and device, decided once from the overrides."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from warpfrag.arrays.kinds import NUMPY, Kind, dtype_name, kind_of
from warpfrag.errors import shorten
from warpfrag.scene.parameters import Parameter, check_name
from warpfrag.scene.scene import Scene

Precision = Literal["float32", "float64"]


@dataclass(frozen=True)
class Frame:
    """What arrays a scene is assembled in.

    Attributes:
        kind: the kind of arrays.
        precision: of all but coordinates.
        like: an array of that kind and precision, on its device.
    """

    kind: Kind
    precision: Precision
    like: Any

    @staticmethod
    def of(overrides: Mapping[str, Any], known: Mapping[str, Parameter]) -> "Frame":
        """Return the frame that a set of overrides asks for.

        Raises:
            TypeError: arrays of two libraries.
            ValueError: arrays on different devices.
        """
        arrays, kinds, devices = {}, {}, {}
        for name, value in overrides.items():
            kind = kind_of(value)
            if kind is not None and kind is not NUMPY:
                arrays[name], kinds[kind.name], devices[str(kind.device_of(value))] = value, name, name
        if len(kinds) > 1:
            (kind_name, name), (other, other_name) = list(kinds.items())[:2]
            raise TypeError(f"parameters: got {name} of {kind_name} and {other_name} of {other}, expected one library")
        if len(devices) > 1:
            (device, name), (other, other_name) = list(devices.items())[:2]
            raise ValueError(f"parameters: got {name} on {device} and {other_name} on {other}, expected one device")
        asking = [*arrays.values()]
        # Vertices that an object keeps in float64 say where it stands (far away), and nothing of the image.
        asking += [v for n, v in overrides.items() if isinstance(v, np.ndarray) and not known[n].keeps_float64]
        precision: Precision = "float64" if any(dtype_name(value) == "float64" for value in asking) else "float32"
        kind = kind_of(next(iter(arrays.values()))) if arrays else NUMPY
        assert kind is not None
        like = kind.astype(next(iter(arrays.values())), precision) if arrays else np.zeros(0, precision)
        return Frame(kind, precision, like)

    def array(self, value: Any) -> Any:
        """Return a number or an array in this kind and precision."""
        if self.kind.owns(value):
            return self.kind.astype(value, self.precision)
        return self.kind.asarray(np.asarray(value), self.like)

    def double(self, value: Any) -> Any:
        """Return a number or an array in this kind, in float64."""
        if self.kind.owns(value):
            return self.kind.astype(value, "float64")
        return self.kind.asarray(np.asarray(value, np.float64), self.kind.astype(self.like, "float64"))


def checked_overrides(
    scene: Scene, parameters: Mapping[str, Any], known: Mapping[str, Parameter]
) -> tuple[Scene, dict[str, Any]]:
    """Return the overrides as arrays or plain numbers, and the scene in the units that texts among them say."""
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters: got {type(parameters).__name__}, expected a mapping from names to values")
    for name in parameters:
        check_name(name, known, "parameters")
    scene, parameters = scene.in_units_of(parameters)
    return scene, {name: _checked_array(name, value) for name, value in parameters.items()}


def _checked_array(name: str, value: Any) -> Any:
    kind = kind_of(value)
    if kind is not None and kind is not NUMPY and kind.xp is not None:
        if dtype_name(value) not in ("float32", "float64"):
            expected = f"a {kind.type_name} of float32 or float64"
            raise ValueError(f"{name}: got a {kind.type_name} of {dtype_name(value)}, expected {expected}")
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float, list, tuple, np.ndarray, np.number)):
        got = type(value).__module__ + "." + type(value).__name__
        raise TypeError(f"{name}: got {got}, expected a number, a NumPy array or a torch tensor")
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: got {shorten(value)}, expected numbers")
    # A plain number or list says nothing about precision: it stays Python's.
    return value
