"""The two data types: `Fragments`, every fragment of every pixel, and `Layers`, the few that they are resolved into."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.arrays.legacy import common_kind, dtype_name, kind_of


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
        return np.repeat(np.arange(self.pixel_count), np.diff(_to_numpy(self.offsets)))

    @property
    def kind(self) -> str:
        """Kind of the arrays: "torch", "warp" or "numpy"."""
        return common_kind({"rgba": self.rgba})

    def numpy(self) -> "Fragments":
        """Return the same fragments as NumPy arrays on the host, detached from any gradient."""
        return Fragments(**{name: _to_numpy(value) for name, value in vars(self).items()})

    def torch(self, device: Any = None) -> "Fragments":
        """Return the same fragments as torch tensors, sharing memory where that is possible."""
        return Fragments(**{name: _to_torch(value, device) for name, value in vars(self).items()})

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

    def numpy(self) -> "Layers":
        """Return the same layers as NumPy arrays on the host, detached from any gradient."""
        return Layers(**{name: _to_numpy(value) for name, value in vars(self).items()})

    def torch(self, device: Any = None) -> "Layers":
        """Return the same layers as torch tensors, sharing memory where that is possible."""
        return Layers(**{name: _to_torch(value, device) for name, value in vars(self).items()})


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
    if kind_of(first) != "numpy":
        for name, array in {**floats, **integers}.items():
            if array is not None and array.device != first.device:
                raise ValueError(f"{name}: is on {array.device}, expected {first.device} like rgba")


def _check_shape(name: str, array: Any, expected: tuple[Any, ...]) -> None:
    if array is not None and tuple(array.shape) != expected:
        raise ValueError(f"{name}: got shape {tuple(array.shape)}, expected {expected}")


def _to_numpy(value: Any) -> Any:
    kind = kind_of(value)
    if kind == "torch":
        return value.detach().cpu().numpy()
    return value.numpy() if kind == "warp" else value


def _to_torch(value: Any, device: Any) -> Any:
    import torch
    import warp as wp

    kind = kind_of(value)
    if kind == "warp":
        value = wp.to_torch(value)
    elif kind == "numpy":
        value = torch.from_numpy(np.ascontiguousarray(value))
    return value.to(device) if kind and device is not None else value
