"""The fragments of all pixels as kernels take them: loaded as slabs, their gradients stored, their values checked."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import Array, Number, Vector4, in_precisions
from warpfrag.fragments import FRAGMENT_INPUTS
from warpfrag.slabs.slab import THIN, THINNEST, WEIGHT_LIMIT, divide, finite, log_transmittance

wp.set_module_options({"enable_backward": False})

NO_FRAGMENT = wp.constant(2147483647)
# Colours, depths and thicknesses are below the largest number by this factor: what is summed of a pixel is finite too.
HEADROOM = wp.constant(1024.0)


@in_precisions
class FragmentLists:
    """The fragments of all pixels, as in `Fragments`; `opacity_sum` may be empty.

    What resolves them also takes `beta`, one for all, by pixel or by fragment; `floor`, the least log T of a slab that
    is divided; `max_layers`.
    """

    rgba: Array[Vector4]
    depth: Array[Number]
    thickness: Array[Number]
    offsets: Array[wp.int32]
    opacity_sum: Array[Number]
    beta: Array[Number]
    floor: Number
    max_layers: wp.int32


@in_precisions
class FragmentGradients:
    """Gradients of the fragments and, by pixel or fragment, of beta; those nobody wants are empty."""

    rgba: Array[Vector4]
    depth: Array[Number]
    thickness: Array[Number]
    opacity_sum: Array[Number]
    beta: Array[Number]


@wp.func(inline=True)
def load_slab(lists: Any, fragment: int, slab: Any, wants_log: bool):
    """Return a fragment as a slab like `slab`; its log T is 0 unless wanted: it costs a third of all the rest."""
    rgba = lists.rgba[fragment]
    opacity = rgba[3]
    one = type(opacity)(1.0)
    weight = one
    if lists.opacity_sum.shape[0] > 0:
        weight = wp.min(divide(lists.opacity_sum[fragment], opacity, one), type(opacity)(WEIGHT_LIMIT))
    log_t = type(opacity)(0.0)
    if wants_log:
        log_t = log_transmittance(opacity)
    back = lists.depth[fragment]
    thickness = thickness_of(lists, fragment)
    return type(slab)(wp.vector(rgba[0], rgba[1], rgba[2]), opacity, one - opacity, log_t, weight, thickness, back)


@wp.func(inline=True)
def thickness_of(lists: Any, fragment: int):
    """Return the thickness of a fragment; that of a slab too thin to be divided is 0: it is a surface."""
    thickness = lists.thickness[fragment]
    least = wp.max(type(thickness)(THIN) * wp.abs(lists.depth[fragment]), type(thickness)(THINNEST))
    if thickness < least:
        thickness = type(thickness)(0.0)
    return thickness


@wp.func(inline=True)
def store_gradient(g: Any, lists: Any, fragment: int, grads: Any):
    """Write the gradient of a fragment, `finite`, given that of the slab that `load_slab` made of it."""
    opacity = lists.rgba[fragment][3]
    zero = type(opacity)(0.0)
    transmittance = type(opacity)(1.0) - opacity
    g_opacity = g.opacity - g.transmittance
    if transmittance > zero:
        g_opacity -= g.log_transmittance / transmittance
    g_sum = zero
    if lists.opacity_sum.shape[0] > 0:
        opacity_sum = lists.opacity_sum[fragment]
        # The weight is S/A, up to its limit.
        if divide(opacity_sum, opacity, zero) < type(opacity)(WEIGHT_LIMIT):
            g_sum = divide(g.weight, opacity, zero)
            g_opacity -= divide(g_sum * opacity_sum, opacity, zero)
    rgba = wp.vector(g.color[0], g.color[1], g.color[2], g_opacity)
    back = g.back
    thickness = g.thickness
    # One question for all: their sum is finite only if each of them is.
    if not wp.isfinite(rgba[0] + rgba[1] + rgba[2] + rgba[3] + back + thickness + g_sum):
        rgba = wp.vector(finite(rgba[0]), finite(rgba[1]), finite(rgba[2]), finite(rgba[3]))
        back = finite(back)
        thickness = finite(thickness)
        g_sum = finite(g_sum)
    if grads.opacity_sum.shape[0] > 0:
        grads.opacity_sum[fragment] = g_sum
    if grads.rgba.shape[0] > 0:
        grads.rgba[fragment] = rgba
    if grads.depth.shape[0] > 0:
        grads.depth[fragment] = back
    if grads.thickness.shape[0] > 0:
        grads.thickness[fragment] = thickness


@wp.func(inline=True)
def valid_fragment(lists: Any, fragment: int):
    """Tell whether a fragment's values are finite and in range."""
    rgba = lists.rgba[fragment]
    thickness = lists.thickness[fragment]
    zero = type(thickness)(0.0)
    # Zero times everything: one NaN or infinity anywhere makes the sum NaN. And what is nearly infinite is as good as.
    room = type(thickness)(HEADROOM)
    nothing = zero * (room * rgba[0]) + zero * (room * rgba[1]) + zero * (room * rgba[2])
    nothing += zero * (room * lists.depth[fragment]) + zero * (room * thickness)
    if lists.opacity_sum.shape[0] > 0:
        opacity_sum = lists.opacity_sum[fragment]
        nothing += zero * opacity_sum
        if opacity_sum < zero:
            return False
    return nothing == zero and rgba[3] >= zero and rgba[3] <= type(thickness)(1.0) and thickness >= zero


def fragment_lists(inputs: SimpleNamespace) -> Any:
    """Return an operator's `FRAGMENT_INPUTS`, and its beta if it has one, as `FragmentLists`."""
    lists = FragmentLists[inputs.rgba.dtype]()
    lists.rgba, lists.depth, lists.thickness = as_vectors(inputs.rgba), inputs.depth, inputs.thickness
    lists.offsets = inputs.offsets
    for name in ("opacity_sum", "beta"):
        if getattr(inputs, name, None) is not None:
            setattr(lists, name, getattr(inputs, name))
    return lists


def fragment_gradients(targets: SimpleNamespace, number: Any) -> Any:
    """Return where kernels write the gradients of `FRAGMENT_INPUTS` that are not None; beta's is not set."""
    grads = FragmentGradients[number]()
    if targets.rgba is not None:
        grads.rgba = as_vectors(targets.rgba)
    for name in ("depth", "thickness", "opacity_sum"):
        if getattr(targets, name) is not None:
            setattr(grads, name, getattr(targets, name))
    return grads


@wp.kernel(module="unique", enable_backward=False)
def list_extent(span: Span, offsets: wp.array[int], fragment_count: int, extent: wp.array2d[int]):
    """Find the longest list; a list that ends before it begins or beyond the fragments is reported by its pixel.

    Args:
        span: pixels.
        offsets: where each pixel's fragments begin, (P + 1,).
        fragment_count: number of fragments.
        extent: output: longest list and lowest pixel with an impossible one, (1, 2).
    """
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
            f"offsets: got the fragments {begin} : {end} for pixel {pixel}, expected 0 <= begin <= end <= "
            f"{fragment_count}"
        )
    first, last = (offsets[at : at + 1].numpy()[0] for at in (0, pixel_count))
    if first != 0 or last != fragment_count:
        raise ValueError(
            f"offsets: got a run from {first} to {last}, expected from 0 to the {fragment_count} fragments"
        )
    return int(found[:, 0].max())


def no_invalid(rows: int, device: wp.Device) -> wp.array:
    """Return where kernels report invalid values: by thread the lowest fragment, and the lowest pixel (its beta)."""
    return wp.array(np.full((rows, 2), NO_FRAGMENT, np.int32), device=device)


def report_invalid(invalid: wp.array, inputs: SimpleNamespace, beta_per: str = "pixel") -> None:
    """Raise for the first fragment or pixel that a kernel found to have values out of range.

    Args:
        invalid: what `no_invalid` returned, after the kernel.
        inputs: the operator's inputs.
        beta_per: what the second of a row counts: "pixel", or "fragment".
    """
    # As Python's own: NumPy's 32 bits would overflow in the address of an array's slice.
    fragment, pixel = map(int, invalid.numpy().min(axis=0))
    if fragment != NO_FRAGMENT:
        values = {
            each.name: getattr(inputs, each.name)[fragment : fragment + 1].numpy()[0].tolist()
            for each in FRAGMENT_INPUTS
            if each.gradient and getattr(inputs, each.name) is not None
        }
        most = np.finfo(wp.dtype_to_numpy(inputs.depth.dtype)).max / HEADROOM
        raise ValueError(
            f"fragments: got {', '.join(f'{name} {value}' for name, value in values.items())} in fragment {fragment}, "
            f"expected finite values up to {most:.1e}, opacity from 0 to 1, thickness and opacity_sum of at least 0"
        )
    if pixel != NO_FRAGMENT:
        beta = inputs.beta.numpy()[min(pixel, inputs.beta.shape[0] - 1)]
        raise ValueError(f"beta: got {beta} in {beta_per} {pixel}, expected numbers from 0 to 1")
