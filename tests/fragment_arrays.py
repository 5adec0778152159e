"""Fragments of any kind of array for tests, and the gradients that torch finds through them."""

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import numpy as np
import warp as wp
from pixels import Pixels

from warpfrag import Fragments


def fragments_of(
    pixels: Pixels,
    dtype: str = "float64",
    *,
    kind: str = "numpy",
    device: str = "cpu",
    shape: tuple[int, ...] | None = None,
    opacity_sum: np.ndarray | None = None,
    requires_grad: bool = False,
) -> Fragments:
    """Put pixels into arrays of a kind; without a shape they are one row."""
    shape = (1, len(pixels.offsets) - 1) if shape is None else shape
    floats = [array_of(values, dtype, kind, device, requires_grad) for values in (*pixels[:3], opacity_sum)]
    return Fragments(*floats[:3], array_of(pixels.offsets, "int32", kind, device), shape, opacity_sum=floats[3])


def array_of(values: Any, dtype: str, kind: str, device: str = "cpu", requires_grad: bool = False) -> Any:
    """Make an array of a kind; None stays None."""
    if values is None:
        return None
    values = np.asarray(values, dtype)
    if kind == "numpy":
        return values
    if kind == "warp":
        return wp.array(values, device=device, requires_grad=requires_grad)
    import torch

    return torch.tensor(values, device=device, requires_grad=requires_grad)


def torch_gradients(
    function: Callable[[Fragments, Any], Any],
    pixels: Pixels,
    beta: float | np.ndarray,
    cotangents: Sequence[np.ndarray | None],
    *,
    opacity_sum: np.ndarray | None = None,
    dtype: str = "float64",
    device: str = "cpu",
) -> list[np.ndarray]:
    """Pull cotangents of the outputs of `function(fragments, beta)`, in (P, ...), back to every input.

    Returns:
        The gradients in rgba, depth, thickness, beta of each pixel and, if it is given, opacity_sum.
    """
    import torch

    fragments = fragments_of(pixels, dtype, kind="torch", device=device, opacity_sum=opacity_sum, requires_grad=True)
    beta = np.broadcast_to(beta, (1, len(pixels.offsets) - 1))
    beta = array_of(beta, dtype, "torch", device, requires_grad=True)
    outputs = function(fragments, beta)
    used = [
        (output, torch.as_tensor(cotangent).to(output).reshape(output.shape))
        for output, cotangent in zip(outputs, cotangents, strict=True)
        if cotangent is not None
    ]
    inputs = [fragments.rgba, fragments.depth, fragments.thickness, beta]
    inputs += [] if opacity_sum is None else [fragments.opacity_sum]
    found = torch.autograd.grad([output for output, _ in used], inputs, [cotangent for _, cotangent in used])
    gradients = [gradient.cpu().numpy().astype(np.float64) for gradient in found]
    gradients[3] = gradients[3].reshape(-1)
    return gradients


def ties(pixels: Pixels) -> np.ndarray:
    """Tell for each pixel whether two fragments share a boundary: images have kinks there, two derivatives."""
    tied = []
    for begin, end in zip(pixels.offsets, pixels.offsets[1:], strict=False):
        back = pixels.depth[begin:end]
        front = back - pixels.thickness[begin:end]
        boundaries = list(chain.from_iterable({f, b} for f, b in zip(front.tolist(), back.tolist(), strict=True)))
        tied.append(len(set(boundaries)) < len(boundaries))
    return np.array(tied, bool)


def transmittance(pixels: Pixels) -> np.ndarray:
    """Return for each pixel what passes all of its fragments but the opaque ones."""
    passed = 1.0 - pixels.rgba[:, 3]
    passed[passed == 0.0] = 1.0
    return np.array([passed[b:e].prod() for b, e in zip(pixels.offsets, pixels.offsets[1:], strict=False)])


def has_opaque(pixels: Pixels) -> np.ndarray:
    """Tell for each pixel whether one of its fragments is opaque."""
    opaque = pixels.rgba[:, 3] == 1.0
    return np.array([opaque[b:e].any() for b, e in zip(pixels.offsets, pixels.offsets[1:], strict=False)], bool)


def by_fragment(of_pixel: np.ndarray, pixels: Pixels) -> np.ndarray:
    """Repeat a value of each pixel for each of its fragments."""
    return np.repeat(of_pixel, np.diff(pixels.offsets))
