"""The lens of a camera as parameters: its opening, and where the line of sight meets the image.

A camera of other values is another camera. To differentiate, points in camera space are moved to where the camera as it
is sees them in the place at which the other one would: x' = x·zoom + w·shift, with w = z (perspective) or 1. At the
values themselves zoom is 1 and shift 0, to the bit. What a ray's direction does to distances along it is held fixed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from warpfrag.arrays.kinds import NUMPY, kind_of
from warpfrag.scene.camera import Camera
from warpfrag.scene.names import CAMERA
from warpfrag.scene.parameters import FOV, HEIGHT, LENS_KINDS, PRINCIPAL, Bounds, Parameter
from warpfrag.scene.rotation import RADIANS


@dataclass(frozen=True)
class Lens:
    """How points in camera space move with the parameters of a lens: derivatives alone.

    Attributes:
        zoom: factor of x and y, a float64 array without dimensions; 1.
        shift_x: how far to the right per w; 0.
        shift_y: how far down per w; 0.
        is_perspective: whether w is the depth.
    """

    zoom: Any
    shift_x: Any
    shift_y: Any
    is_perspective: bool

    def apply(self, points: list[Any]) -> list[Any]:
        """Return the coordinates [x, y, z] of points, moved."""
        x, y, z = points
        w = z if self.is_perspective else 1.0
        return [x * self.zoom + w * self.shift_x, y * self.zoom + w * self.shift_y, z]


def through_lens(
    camera: Camera,
    overrides: Mapping[str, Any],
    known: Mapping[str, Parameter],
    bounds: Bounds,
    double: Callable[[Any], Any],
) -> tuple[Camera, Lens | None]:
    """Return the camera that parameters of its lens make of one, and how points move with them if gradients are taken.

    Args:
        camera: as it is.
        overrides: parameters by name; others than a lens's are passed over.
        known: the scene's parameters.
        bounds: what becomes of values out of range.
        double: turns a value into a float64 array of the kind in which the scene is assembled.
    """
    values: dict[Any, Any] = {}
    for kind in LENS_KINDS:
        name = f"{CAMERA}.{kind.key}"
        if name in overrides:
            values[kind] = known[name].bounded(double(overrides[name]), bounds)
            known[name].check(values[kind])
    if not values:
        return camera, None
    fixed = {kind: (kind_of(value) or NUMPY).to_numpy(value) for kind, value in values.items()}
    fields: dict[str, Any] = {
        str(kind.field): tuple(value.tolist()) if kind.value_shape else float(value) for kind, value in fixed.items()
    }
    changed = replace(camera, **fields)
    array_kind = kind_of(next(iter(values.values()))) or NUMPY
    if not array_kind.records(values.values()):
        return changed, None
    zoom, shift_x, shift_y = double(1.0), double(0.0), double(0.0)
    if FOV in values:
        zoom = zoom + _change(array_kind, 1.0 / array_kind.xp.tan(0.5 * RADIANS * values[FOV]), _cotangent(changed))
    if HEIGHT in values:
        zoom = zoom + _change(array_kind, 1.0 / values[HEIGHT], 1.0 / fields["height"])
    if PRINCIPAL in values:
        scale = changed.focal if changed.is_perspective else 1.0 / changed.pixel_size
        shift = _change(array_kind, values[PRINCIPAL], scale)
        shift_x, shift_y = shift_x + shift[0], shift_y + shift[1]
    return changed, Lens(zoom, shift_x, shift_y, changed.is_perspective)


def _change(kind: Any, value: Any, unit: float) -> Any:
    """Return zero, with the derivative of a value in units."""
    return (value - kind.detach(value)) / unit


def _cotangent(camera: Camera) -> float:
    return 2.0 * camera.focal / camera.size[1]
