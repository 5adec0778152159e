"""What resolving and compositing take in common: their options, beta, and checks of values."""

import math
from collections.abc import Callable, Sequence
from typing import Any, get_args

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.legacy import dtype_name, kind_of, vectors
from warpfrag.fragments import Fragments
from warpfrag.resolve.walk import (
    MERGE_EXACT,
    MERGE_NONE,
    MERGE_ORDER_INDEPENDENT,
    MERGE_SMOOTH,
    NO_FRAGMENT,
    Gradients32,
    Gradients64,
    Pixels32,
    Pixels64,
    Scratch32,
    Scratch64,
)
from warpfrag.scene.names import Merge, Mix
from warpfrag.slabs.operators import MIX_AVERAGE, MIX_OPACITY, MIX_OPTICAL_DEPTH
from warpfrag.slabs.slab import LOG_FLOOR, LOG_OPAQUE, Slab32, Slab64

MERGES = {
    "none": MERGE_NONE,
    "smooth": MERGE_SMOOTH,
    "order_independent": MERGE_ORDER_INDEPENDENT,
    "exact": MERGE_EXACT,
}
MIXES = {"opacity": MIX_OPACITY, "average": MIX_AVERAGE, "optical_depth": MIX_OPTICAL_DEPTH}

# The structures of each precision. (Any: kernels take these as types of arguments.)
SLABS: dict[Any, Any] = {wp.float32: Slab32, wp.float64: Slab64}
PIXELS: Any = {wp.float32: Pixels32, wp.float64: Pixels64}
GRADIENTS: Any = {wp.float32: Gradients32, wp.float64: Gradients64}
SCRATCH: Any = {wp.float32: Scratch32, wp.float64: Scratch64}

# Unused entries between the rows of scratch memory: two threads that write the same cache line slow each other down.
ROW_GAP = 32

# Tensors and options that operators on fragments share, in this order.
FRAGMENT_TENSORS = ("rgba", "depth", "thickness", "offsets", "beta", "opacity_sum")
FRAGMENT_DIFFERENTIABLE = ("rgba", "depth", "thickness", "beta", "opacity_sum")
MERGE_OPTIONS = {"max_layers": "int", "merge": "str", "mix": "str"}
# Most dimensions that a wp.array has.
WARP_DIMENSIONS = 4


def check_options(merge: str, mix: str, max_layers: int) -> None:
    """Raise for a merge, mix or layer number that does not exist."""
    check_choice("merge", merge, get_args(Merge))
    check_choice("mix", mix, get_args(Mix))
    if merge == "exact" and mix == "average":
        raise ValueError(
            "mix: got 'average' with merge 'exact', expected 'opacity' or 'optical_depth' (averages of three parts "
            "depend on their order)"
        )
    if isinstance(max_layers, bool) or not isinstance(max_layers, (int, np.integer)):
        raise TypeError(f"max_layers: got {max_layers!r}, expected a whole number of at least 1")
    if max_layers < 1:
        raise ValueError(f"max_layers: got {max_layers}, expected at least 1")


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise unless `value` is one of `choices`."""
    if value not in choices:
        raise ValueError(f"{name}: got {value!r}, expected one of {', '.join(map(repr, choices))}")


def fragment_inputs(fragments: Fragments, beta: Any, *, dimensions: int, by_fragment: bool = False) -> tuple[Any, ...]:
    """Return the operator inputs `FRAGMENT_TENSORS`, for outputs of so many dimensions beside those of the grid.

    With `by_fragment` beta may also be one value per fragment.
    """
    if not isinstance(fragments, Fragments):
        raise TypeError(f"fragments: got {type(fragments).__name__}, expected Fragments")
    most = WARP_DIMENSIONS - dimensions
    if fragments.kind == "warp" and len(fragments.shape) > most:
        raise ValueError(
            f"fragments: got shape {fragments.shape}, expected at most {most} dimensions: a wp.array has at most "
            f"{WARP_DIMENSIONS}, of which the result takes {dimensions} more"
        )
    return (
        fragments.rgba,
        fragments.depth,
        fragments.thickness,
        as_int32(fragments.offsets),
        beta_array(beta, fragments.rgba, fragments.shape, fragments.count if by_fragment else None),
        fragments.opacity_sum,
    )


def as_int32(array: Any) -> Any:
    """Return an index array as int32, itself if it is so already."""
    if dtype_name(array) == "int32":
        return array
    kind = kind_of(array)
    if kind == "numpy":
        return array.astype(np.int32)
    if kind == "torch":
        return array.int()
    return wp.array(array.numpy().astype(np.int32), device=array.device)


def beta_array(beta: Any, like: Any, shape: tuple[int, ...], fragment_count: int | None = None) -> Any:
    """Return beta as an array of one entry, one per pixel, or one per fragment if that is allowed (has a count).

    It is of the kind and precision of `like`.
    """
    kind = kind_of(like)
    if kind_of(beta) is None:
        if isinstance(beta, bool) or not isinstance(beta, (int, float, np.floating, np.integer)):
            raise TypeError(f"beta: got {type(beta).__name__}, expected a number or an array, 0-d or of shape {shape}")
        if not 0.0 <= beta <= 1.0:
            raise ValueError(f"beta: got {beta}, expected a number from 0 to 1")
        if kind == "torch":
            return like.new_full((1,), float(beta))
        values = np.full(1, beta, dtype_name(like))
        return values if kind == "numpy" else wp.array(values, device=like.device)
    if kind_of(beta) != kind:
        raise TypeError(f"beta: got a {kind_of(beta)} array, expected a {kind} array like the fragments, or a number")
    if dtype_name(beta) != dtype_name(like):
        raise TypeError(f"beta: got dtype {dtype_name(beta)}, expected {dtype_name(like)} like the fragments")
    if kind != "numpy" and beta.device != like.device:
        raise ValueError(f"beta: is on {beta.device}, expected {like.device} like the fragments")
    shapes = [(), tuple(shape)] + ([] if fragment_count is None else [(fragment_count,)])
    if tuple(beta.shape) not in ((1,), *shapes):
        expected = " or ".join(map(str, shapes))
        hint = "" if fragment_count is not None else "; one per fragment goes with merge 'exact'"
        raise ValueError(f"beta: got shape {tuple(beta.shape)}, expected {expected}{hint}")
    return beta.reshape((math.prod(beta.shape),))


class Walk:
    """One launch of a kernel that walks through every pixel's fragments, and the memory it needs.

    Scratch memory has a row for each thread that runs at the same time, of `row_length`.
    """

    def __init__(self, inputs: Sequence[Any], max_layers: int, merge: str, mix: str):
        """Take the operator's inputs `FRAGMENT_TENSORS` and options `MERGE_OPTIONS`."""
        rgba, depth, thickness, offsets, beta, opacity_sum = inputs
        self.inputs = inputs
        self.scalar = rgba.dtype
        self.device = rgba.device
        self.pixel_count = offsets.shape[0] - 1
        self.length = row_length(offsets, rgba.shape[0])
        self.pixels = PIXELS[self.scalar]()
        self.pixels.rgba = vectors(rgba)
        self.pixels.depth = depth
        self.pixels.thickness = thickness
        self.pixels.offsets = offsets
        self.pixels.beta = beta
        if opacity_sum is not None:
            self.pixels.opacity_sum = opacity_sum
        self.pixels.floor = LOG_OPAQUE if mix == "optical_depth" else LOG_FLOOR
        self.pixels.max_layers = max_layers
        # Without merging nothing is mixed: one kernel serves every mix.
        self.choice = (self.scalar, MERGES[merge], MIXES[mix if merge != "none" else "opacity"])

    def optional(self, array: wp.array | None, ndim: int) -> wp.array:
        """Return the array, or an empty one in place of None: kernels skip those."""
        return array if array is not None else wp.empty((0,) * ndim, dtype=self.scalar, device=self.device)

    def forward(self, kernel: Callable[..., wp.Kernel], outputs: Sequence[wp.array]) -> None:
        """Run the kernel made for the merge and mix: on pixels, order, length, invalid, outputs.

        Raises:
            ValueError: it found invalid values.
        """
        rows = worker_count(self.pixel_count, self.device, 4 * self.length)
        order = wp.empty(rows * self.length, dtype=wp.int32, device=self.device)
        invalid = wp.array(np.full((rows, 2), NO_FRAGMENT, np.int32), device=self.device)
        launch(
            kernel(*self.choice),
            self.pixel_count,
            [self.pixels, order, self.length, invalid, *outputs],
            self.device,
            rows,
        )
        report_invalid(invalid, self.inputs)

    def backward(
        self, kernel: Callable[..., wp.Kernel], grads: Sequence[wp.array], grad_inputs: Sequence[wp.array | None]
    ) -> None:
        """Run the kernel made for the merge and mix: on pixels, scratch, output gradients, input gradients."""
        slab = SLABS[self.scalar]
        rows = worker_count(
            self.pixel_count, self.device, (8 + 21 * wp.types.type_size_in_bytes(self.scalar)) * self.length
        )
        scratch = SCRATCH[self.scalar]()
        scratch.length = self.length
        for name, dtype in (
            *(("order", wp.int32), ("step", wp.int32), ("fragment", slab), ("running", slab), ("through", self.scalar)),
            *(("front", self.scalar), ("back", self.scalar)),
        ):
            setattr(scratch, name, wp.empty(rows * self.length, dtype=dtype, device=self.device))
        targets, grad_beta = self.targets(grad_inputs), grad_inputs[4]
        launch(kernel(*self.choice), self.pixel_count, [self.pixels, scratch, *grads, targets], self.device, rows)
        if grad_beta is not None:
            sum_beta(targets.beta, grad_beta)

    def targets(self, grad_inputs: Sequence[wp.array | None]) -> Any:
        """Return where kernels write gradients: the inputs' own arrays, but one value per pixel for beta."""
        grad_rgba, grad_depth, grad_thickness, _, grad_beta, grad_opacity_sum = grad_inputs
        targets = GRADIENTS[self.scalar]()
        if grad_rgba is not None:
            targets.rgba = vectors(grad_rgba)
        if grad_depth is not None:
            targets.depth = grad_depth
        if grad_thickness is not None:
            targets.thickness = grad_thickness
        if grad_opacity_sum is not None:
            targets.opacity_sum = grad_opacity_sum
        if grad_beta is not None:
            targets.beta = wp.empty(self.pixel_count, dtype=self.scalar, device=self.device)
        return targets


@wp.kernel(module="unique", enable_backward=False)
def list_extent(span: Span, offsets: wp.array[int], fragment_count: int, extent: wp.array2d[int]):
    """Find the longest list; a list that ends before it begins or beyond the fragments is reported by its pixel."""
    longest = int(0)
    for pixel in range(span.begin + wp.tid(), span.end, span.stride):
        begin = offsets[pixel]
        end = offsets[pixel + 1]
        if begin < 0 or end < begin or end > fragment_count:
            wp.atomic_min(extent, span.worker, 1, pixel)
        else:
            longest = wp.max(longest, end - begin)
    wp.atomic_max(extent, span.worker, 0, longest)


def longest_list(offsets: wp.array, fragment_count: int) -> int:
    """Return the largest number of fragments in a pixel.

    Raises:
        ValueError: the offsets do not run from 0 to the number of fragments without stepping back.
    """
    pixel_count = offsets.shape[0] - 1
    device = offsets.device
    extent = wp.array(np.array([[0, NO_FRAGMENT]], np.int32), device=device)
    # A nanosecond a pixel: less than it takes to wake another thread.
    launch(list_extent, pixel_count, [offsets, fragment_count, extent], device, workers=1 if device.is_cpu else None)
    found = extent.numpy()
    pixel = int(found[:, 1].min())
    if pixel != NO_FRAGMENT:
        begin, end = offsets[pixel : pixel + 2].numpy()
        raise ValueError(
            f"offsets: pixel {pixel} has the fragments {begin} : {end}, expected 0 <= begin <= end <= {fragment_count}"
        )
    first, last = (offsets[at : at + 1].numpy()[0] for at in (0, pixel_count))
    if first != 0 or last != fragment_count:
        raise ValueError(f"offsets: run from {first} to {last}, expected from 0 to the {fragment_count} fragments")
    return int(found[:, 0].max())


def row_length(offsets: wp.array, fragment_count: int) -> int:
    """Return the length of a thread's row of scratch memory: the longest list of fragments, and a gap."""
    return longest_list(offsets, fragment_count) + ROW_GAP


def report_invalid(invalid: wp.array, inputs: Sequence[Any], beta_per: str = "pixel") -> None:
    """Raise for the first fragment or pixel that a kernel found to have values out of range.

    Args:
        invalid: one row per thread: lowest invalid fragment, lowest pixel with an invalid beta.
        inputs: the operator's inputs, as `fragment_inputs` orders them.
        beta_per: what the second of a row counts: "pixel", or "fragment".
    """
    # As Python's own: NumPy's 32 bits would overflow in the address of an array's slice.
    fragment, pixel = map(int, invalid.numpy().min(axis=0))
    if fragment != NO_FRAGMENT:
        found = {
            name: array[fragment : fragment + 1].numpy()[0].tolist()
            for name, array in zip(FRAGMENT_TENSORS, inputs, strict=True)
            if array is not None and name not in ("offsets", "beta")
        }
        raise ValueError(
            f"fragments: fragment {fragment} has {', '.join(f'{name} {value}' for name, value in found.items())}, "
            "expected finite values, opacity from 0 to 1, thickness and opacity_sum of at least 0"
        )
    if pixel != NO_FRAGMENT:
        beta = inputs[4].numpy()[min(pixel, inputs[4].shape[0] - 1)]
        raise ValueError(f"beta: got {beta} in {beta_per} {pixel}, expected values from 0 to 1")


def sum_beta(grad_pixels: wp.array, grad_beta: wp.array) -> None:
    """Write the gradient of beta, given that of each pixel; the sum's order does not depend on threads."""
    if grad_beta.shape == grad_pixels.shape:
        wp.copy(grad_beta, grad_pixels)
    elif grad_beta.device.is_cpu:
        grad_beta.numpy()[0] = grad_pixels.numpy().sum(dtype=np.float64)
    else:
        wp.utils.array_sum(grad_pixels, out=grad_beta)
