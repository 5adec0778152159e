"""The two data types: `Fragments`, every fragment of every pixel, and `Layers`, the few that they are resolved into."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import Kind, common_kind, dtype_name, kind_named, kind_of
from warpfrag.arrays.operators import Input, Output
from warpfrag.errors import shorten

# Most dimensions that a wp.array has.
WARP_DIMENSIONS = 4

# What operators on fragments take, and what those return that make layers of them.
FRAGMENT_INPUTS = (
    Input("rgba", "F 4", gradient=True),
    Input("depth", "F", gradient=True),
    Input("thickness", "F", gradient=True),
    Input("offsets", "P+1", "int"),
    Input("opacity_sum", "F", gradient=True),
)
LAYER_OUTPUTS = (
    Output("rgba", "P M 4"),
    Output("depth", "P M"),
    Output("thickness", "P M"),
    Output("opacity_sum", "P M"),
    Output("count", "P", "int"),
)


@dataclass(frozen=True, eq=False)
class Fragments:
    """The fragments of an image: for each pixel a list of any length, in any order.

    All arrays are of one kind (torch.Tensor, wp.array or NumPy), on one device, and the floating-point ones of one
    precision (float32 or float64). Differentiable: `rgba`, `depth`, `thickness`, `opacity_sum`.

    Attributes:
        rgba: premultiplied linear colour and opacity (0 ... 1), shape (F, 4).
        depth: back boundary, the original surface: distance from the eye along the pixel's ray [scene units], (F,).
        thickness: z-thickness: the slab reaches from depth - thickness to depth [scene units], at least 0, (F,).
        offsets: pixel p owns the fragments offsets[p] : offsets[p + 1], int32 or int64, (P + 1,).
        shape: the pixel grid, (H, W) or with leading batch dimensions; P is its product, row-major from the top left.
        opacity_sum: opacity sum S of the mix operator; None means a fresh fragment's, its opacity, (F,).
        object_id: which object of the scene a fragment belongs to, int32, (F,).
        primitive_id: which triangle of that object, int32, (F,).

    Raises:
        TypeError: an array is of the wrong kind or dtype.
        ValueError: an array has the wrong shape or device.
    """

    rgba: Any
    depth: Any
    thickness: Any
    offsets: Any
    shape: tuple[int, ...]
    opacity_sum: Any = None
    object_id: Any = None
    primitive_id: Any = None

    def __post_init__(self):
        object.__setattr__(self, "shape", _grid(self.shape))
        floats = {n: getattr(self, n) for n in ("rgba", "depth", "thickness", "opacity_sum")}
        integers = {n: getattr(self, n) for n in ("offsets", "object_id", "primitive_id")}
        _check_arrays(floats, integers, optional=("opacity_sum", "object_id", "primitive_id"))
        count = self.rgba.shape[0] if self.rgba.shape else "F"
        expected = {"rgba": (count, 4), "offsets": (math.prod(self.shape) + 1,)}
        for name, array in {**floats, **integers}.items():
            _check_shape(name, array, expected.get(name, (count,)))

    @property
    def count(self) -> int:
        """Number of fragments, F."""
        return self.rgba.shape[0]

    @property
    def pixel_count(self) -> int:
        """Number of pixels, P."""
        return math.prod(self.shape)

    @property
    def pixel(self) -> np.ndarray:
        """The pixel of each fragment, (F,), a NumPy array."""
        return np.repeat(np.arange(self.pixel_count), np.diff(_in_numpy(self.offsets)))

    @property
    def kind(self) -> str:
        """Kind of the arrays: "torch", "warp" or "numpy"."""
        return _kind(self).name

    def __repr__(self) -> str:
        return f"Fragments({self.count} fragments, {_size_words(self.shape)}, {_array_words(self.rgba)})"

    def __getitem__(self, pixel: Any) -> "Fragments":
        """Return the fragments of one pixel, by its place (row, column), as those of a grid (1, 1); differentiable."""
        number = pixel_number(pixel, self.shape)
        begin, end = map(int, _in_numpy(self.offsets[number : number + 2]))
        own = {name: getattr(self, name) for name in _BY_FRAGMENT}
        parts = {name: None if array is None else array[begin:end] for name, array in own.items()}
        offsets = self.offsets[number : number + 2] if begin == 0 else self.offsets[:0]
        if begin:
            kind = _kind(self)
            offsets = kind.astype(kind.asarray([0, end - begin], self.depth), dtype_name(self.offsets))
        return Fragments(**parts, offsets=offsets, shape=(1, 1))

    def to(self, target: Any) -> "Fragments":
        """Return the same fragments on a device, or in a precision.

        Args:
            target: a device ("cpu", "cuda:0", a `torch.device`), or "float32" or "float64", also as a dtype.
        """
        return replace(self, **_moved(vars(self), target))

    def validate(self) -> None:
        """Check every value, which otherwise happens only where fragments are used.

        Raises:
            ValueError: offsets step back, or a value is not finite or out of its range.
        """
        offsets = _in_numpy(self.offsets)
        steps = np.diff(offsets)
        if offsets[0] != 0 or offsets[-1] != self.count or (steps < 0).any():
            found = f"a run from {offsets[0]} to {offsets[-1]}" if (steps >= 0).all() else "numbers that fall"
            raise ValueError(f"offsets: got {found}, expected numbers that rise from 0 to {self.count}")
        _check_values(self)

    def numpy(self) -> "Fragments":
        """Return the same fragments as NumPy arrays on the host, detached from any gradient."""
        return Fragments(**{name: _in_numpy(value) for name, value in vars(self).items()})

    def torch(self, device: Any = None) -> "Fragments":
        """Return the same fragments as torch tensors, sharing memory where that is possible."""
        return Fragments(**{name: _in_torch(value, device) for name, value in vars(self).items()})

    @staticmethod
    def from_lists(pixels: list[list[tuple]], shape: tuple[int, ...], dtype: Any = np.float32) -> "Fragments":
        """Build NumPy fragments from one list per pixel of tuples (r, g, b, opacity, depth, thickness).

        Args:
            pixels: for each pixel in row-major order its fragments; colours are premultiplied.
            shape: the pixel grid.
            dtype: np.float32 or np.float64.

        Raises:
            ValueError: a fragment has not six values, or there are more or fewer lists than pixels.
        """
        for number, pixel in enumerate(pixels):
            for fragment in pixel:
                if len(fragment) != 6:
                    raise ValueError(
                        f"pixels: pixel {number} has a fragment of {len(fragment)} values, expected 6: "
                        "r, g, b, opacity, depth, thickness"
                    )
        rows = np.array([fragment for pixel in pixels for fragment in pixel], dtype).reshape(-1, 6)
        offsets = np.concatenate([[0], np.cumsum([len(pixel) for pixel in pixels])]).astype(np.int32)
        rgba, depth, thickness = (np.ascontiguousarray(a) for a in (rows[:, :4], rows[:, 4], rows[:, 5]))
        return Fragments(rgba, depth, thickness, offsets, shape)


@dataclass(frozen=True, eq=False)
class Layers:
    """The layers of an image: at most M slabs per pixel in depth order, zero past `count`.

    Attributes:
        rgba: premultiplied linear colour and opacity, (H, W, M, 4); (H, W) stands for any pixel grid.
        depth: back boundary [scene units], (H, W, M).
        thickness: z-thickness [scene units], (H, W, M).
        opacity_sum: opacity sum S, (H, W, M).
        count: number of layers of each pixel, int32, (H, W).

    Raises:
        TypeError: an array is of the wrong kind or dtype.
        ValueError: an array has the wrong shape or device.
    """

    rgba: Any
    depth: Any
    thickness: Any
    opacity_sum: Any
    count: Any

    def __post_init__(self):
        floats = {n: getattr(self, n) for n in ("rgba", "depth", "thickness", "opacity_sum")}
        _check_arrays(floats, {"count": self.count})
        grid = tuple(self.count.shape)
        if len(self.rgba.shape) != len(grid) + 2 or self.rgba.shape[-1] != 4:
            raise ValueError(f"rgba: got shape {tuple(self.rgba.shape)}, expected {(*grid, 'M', 4)}")
        layer_count = self.rgba.shape[-2]
        _check_shape("rgba", self.rgba, (*grid, layer_count, 4))
        for name in ("depth", "thickness", "opacity_sum"):
            _check_shape(name, floats[name], (*grid, layer_count))

    @property
    def shape(self) -> tuple[int, ...]:
        """The pixel grid."""
        return tuple(self.count.shape)

    @property
    def max_layers(self) -> int:
        """Number of layers there is room for, M."""
        return self.rgba.shape[-2]

    @property
    def kind(self) -> str:
        """Kind of the arrays: "torch", "warp" or "numpy"."""
        return _kind(self).name

    def __repr__(self) -> str:
        return f"Layers(up to {self.max_layers} layers, {_size_words(self.shape)}, {_array_words(self.rgba)})"

    def __getitem__(self, pixel: Any) -> "Layers":
        """Return the layers of one pixel, by its place (row, column), as those of a grid (1, 1); differentiable."""
        number, most = pixel_number(pixel, self.shape), self.max_layers
        parts = {}
        for name, array in vars(self).items():
            rest = {"rgba": (most, 4), "count": ()}.get(name, (most,))
            flat = array.reshape((math.prod(self.shape), *rest))
            parts[name] = flat[number : number + 1].reshape((1, 1, *rest))
        return Layers(**parts)

    def to(self, target: Any) -> "Layers":
        """Return the same layers on a device, or in a precision; see `Fragments.to`."""
        return replace(self, **_moved(vars(self), target))

    def validate(self) -> None:
        """Check every value, which otherwise happens only where layers are used.

        Raises:
            ValueError: a count is out of its range, or a value is not finite or out of its range.
        """
        counts = _in_numpy(self.count)
        outside = (counts < 0) | (counts > self.max_layers)
        if outside.any():
            raise ValueError(f"count: got {counts[outside][0]}, expected numbers from 0 to {self.max_layers}")
        _check_values(self)

    def numpy(self) -> "Layers":
        """Return the same layers as NumPy arrays on the host, detached from any gradient."""
        return Layers(**{name: _in_numpy(value) for name, value in vars(self).items()})

    def torch(self, device: Any = None) -> "Layers":
        """Return the same layers as torch tensors, sharing memory where that is possible."""
        return Layers(**{name: _in_torch(value, device) for name, value in vars(self).items()})


def fragment_inputs(fragments: Any, *, dimensions: int) -> dict[str, Any]:
    """Return `FRAGMENT_INPUTS`, for outputs of so many dimensions beside those of the grid."""
    if not isinstance(fragments, Fragments):
        raise TypeError(f"fragments: got {type(fragments).__name__}, expected Fragments")
    most = WARP_DIMENSIONS - dimensions
    if fragments.kind == "warp" and len(fragments.shape) > most:
        raise ValueError(
            f"fragments: got shape {fragments.shape}, expected at most {most} dimensions: a wp.array has at most "
            f"{WARP_DIMENSIONS}, of which the result takes {dimensions} more"
        )
    inputs = {each.name: getattr(fragments, each.name) for each in FRAGMENT_INPUTS}
    return {**inputs, "offsets": as_int32(fragments.offsets)}


def as_int32(array: Any) -> Any:
    """Return an index array as int32, itself if it is so already."""
    kind = kind_of(array)
    assert kind is not None
    return kind.astype(array, "int32")


def as_layers(outputs: SimpleNamespace, grid: tuple[int, ...]) -> Layers:
    """Return `LAYER_OUTPUTS` of all pixels in one row as the layers of a pixel grid."""
    most = outputs.rgba.shape[1]
    return Layers(
        outputs.rgba.reshape((*grid, most, 4)),
        outputs.depth.reshape((*grid, most)),
        outputs.thickness.reshape((*grid, most)),
        outputs.opacity_sum.reshape((*grid, most)),
        outputs.count.reshape(grid),
    )


def pixel_number(pixel: Any, shape: tuple[int, ...]) -> int:
    """Return the number of a pixel in a grid, given its place, such as (row, column), or that number itself.

    Raises:
        ValueError: it lies outside the grid.
    """
    several = isinstance(pixel, (tuple, list))
    place, limits = (tuple(pixel), shape) if several else ((pixel,), (math.prod(shape),))
    whole = all(isinstance(each, (int, np.integer)) and not isinstance(each, bool) for each in place)
    if len(place) != len(limits) or not whole or not all(0 <= a < b for a, b in zip(place, limits, strict=True)):
        raise ValueError(f"pixel: got {shorten(pixel)}, expected a place in the grid of {_size_words(shape)} pixels")
    return int(np.ravel_multi_index(tuple(int(each) for each in place), limits))


_BY_FRAGMENT = ("rgba", "depth", "thickness", "opacity_sum", "object_id", "primitive_id")


def _kind(source: Fragments | Layers) -> Kind:
    return common_kind({"rgba": source.rgba})


def _size_words(shape: tuple[int, ...]) -> str:
    return "×".join(map(str, shape))


def _array_words(array: Any) -> str:
    kind = common_kind({"array": array})
    device = kind.device_of(array)
    return f"{dtype_name(array)}, {kind.name}" + ("" if device is None or str(device) == "cpu" else f" on {device}")


def _moved(values: dict[str, Any], target: Any) -> dict[str, Any]:
    """Return the arrays among the values on a device, or the floats among them in a precision."""
    precision = str(getattr(target, "__name__", target)).removeprefix("torch.")
    arrays = {name: (kind_of(value), value) for name, value in values.items() if kind_of(value) is not None}
    if precision in ("float32", "float64"):
        floats = {name: each for name, each in arrays.items() if dtype_name(each[1]).startswith("float")}
        return {name: kind.astype(value, precision) for name, (kind, value) in floats.items() if kind is not None}
    moved = {}
    for name, (kind, value) in arrays.items():
        if kind is None or kind.name == "numpy":
            raise ValueError(
                f"device: got {shorten(str(target))} for NumPy arrays, expected torch or Warp arrays (`.torch()`)"
            )
        moved[name] = value.to(target)
    return moved


def _check_values(source: Fragments | Layers) -> None:
    ranges = {
        "rgba": (-np.inf, np.inf),
        "depth": (-np.inf, np.inf),
        "thickness": (0, np.inf),
        "opacity_sum": (0, np.inf),
    }
    values = {name: _in_numpy(getattr(source, name)) for name in ranges if getattr(source, name) is not None}
    checks = [(name, array, *ranges[name]) for name, array in values.items()]
    for name, array, low, high in [*checks, ("opacity", values["rgba"][..., 3], 0, 1)]:
        good = np.isfinite(array) & (array >= low) & (array <= high)
        if not good.all():
            expected = "finite numbers" if low == -np.inf else f"finite numbers of at least {low}"
            expected = "numbers from 0 to 1" if high == 1 else expected
            raise ValueError(f"{name}: got {array[~good].flat[0]:g}, expected {expected}")


def _grid(shape: Any) -> tuple[int, ...]:
    sizes = tuple(shape) if isinstance(shape, (tuple, list)) or hasattr(shape, "numel") else (shape,)
    for size in sizes:
        if size is None or isinstance(size, (float, str, bytes)) or not size >= 0:
            raise ValueError(f"shape: got {shape!r}, expected whole numbers of at least 0, (..., H, W)")
    return sizes


def _check_arrays(floats: dict[str, Any], integers: dict[str, Any], optional: tuple[str, ...] = ()) -> None:
    for name, array in {**floats, **integers}.items():
        if array is None and name not in optional:
            raise TypeError(f"{name}: got NoneType, expected a torch.Tensor, wp.array or NumPy array")
    common_kind({**floats, **integers})
    first = floats["rgba"]
    precision = dtype_name(first)
    if precision not in ("float32", "float64"):
        raise TypeError(f"rgba: got dtype {precision}, expected float32 or float64")
    for name, array in floats.items():
        if array is not None and dtype_name(array) != precision:
            raise TypeError(f"{name}: got dtype {dtype_name(array)}, expected {precision} like rgba")
    for name, array in integers.items():
        if array is not None and dtype_name(array) not in ("int32", "int64"):
            raise TypeError(f"{name}: got dtype {dtype_name(array)}, expected int32 or int64")
    kind = common_kind({"rgba": first})
    for name, array in {**floats, **integers}.items():
        if array is not None and kind.device_of(array) != kind.device_of(first):
            raise ValueError(f"{name}: got it on {array.device}, expected {first.device} like rgba")


def _check_shape(name: str, array: Any, expected: tuple[Any, ...]) -> None:
    if array is not None and tuple(array.shape) != expected:
        raise ValueError(f"{name}: got shape {tuple(array.shape)}, expected {expected}")


def _in_numpy(value: Any) -> Any:
    kind = kind_of(value)
    return value if kind is None else kind.to_numpy(value)


def _in_torch(value: Any, device: Any) -> Any:
    kind = kind_of(value)
    if kind is None:
        return value
    torch = kind_named("torch")
    tensor = value if kind is torch else torch.from_warp(kind.to_warp(value))
    return tensor if device is None else tensor.to(device)
