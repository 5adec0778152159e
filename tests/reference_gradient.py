"""Gradients of the slow reference, to compare adjoints with.

`resolve_gradient` and `image_gradient` perturb every input by an imaginary 1e-30, pixel by pixel: exact to rounding,
valid up to A = 1, A = 0 and t = 0 (there one-sided, from inside the range), with all decisions (order, overlap, tail,
floor, opaque) held fixed. `gradient` knows nothing about its function, and serves to check them and everything else.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from reference import Fragment, composite_pixel, fragment_rows, pixel_fragments, resolve_pixel

STEP = 1e-30
"""Imaginary perturbation: its square vanishes beside any rounding error."""


class Gradients(NamedTuple):
    """Derivatives by each input; `beta` by pixel, `opacity_sum` None where it was not given (then S = A)."""

    rgba: np.ndarray  # (F, 4)
    depth: np.ndarray  # (F,)
    thickness: np.ndarray  # (F,)
    beta: np.ndarray  # (P,)
    opacity_sum: np.ndarray | None  # (F,)


def resolve_gradient(
    rgba, depth, thickness, offsets, beta=1.0, opacity_sum=None, *, cotangents: tuple[np.ndarray | None, ...], **options
) -> Gradients:
    """Pull cotangents of (rgba, depth, thickness, opacity_sum) of the dense layers back to the inputs of `resolve`."""
    dense = [None if cotangent is None else np.asarray(cotangent, dtype=np.float64) for cotangent in cotangents]

    def objective(pixel: int, layers: list[Fragment]) -> float:
        total = 0.0
        for slot, layer in enumerate(layers):
            values = (np.append(layer.color, layer.opacity), *layer[2:5])
            for cotangent, value in zip(dense, values, strict=True):
                if cotangent is not None:
                    total = total + np.sum(cotangent[pixel, slot] * value)
        return total

    return pixelwise_gradient(objective, rgba, depth, thickness, offsets, beta, opacity_sum, **options)


def image_gradient(
    rgba, depth, thickness, offsets, beta=1.0, opacity_sum=None, *, cotangent: np.ndarray, **options
) -> Gradients:
    """Pull the cotangent (P, 4) of the composited image back to the inputs of `resolve`."""

    def objective(pixel: int, layers: list[Fragment]) -> float:
        return np.sum(np.asarray(cotangent[pixel], dtype=np.float64) * composite_pixel(layers))

    return pixelwise_gradient(objective, rgba, depth, thickness, offsets, beta, opacity_sum, **options)


def pixelwise_gradient(
    objective: Callable[[int, list[Fragment]], float], rgba, depth, thickness, offsets, beta, opacity_sum, **options
) -> Gradients:
    """Differentiate a sum over pixels of `objective(pixel, layers)` by complex steps, every decision held fixed."""
    rows = fragment_rows(rgba, depth, thickness, opacity_sum)
    pixel_count = len(offsets) - 1
    betas = np.broadcast_to(np.asarray(beta, dtype=np.float64), (pixel_count,)).tolist()
    grad_rows = np.zeros_like(rows)
    grad_beta = np.zeros(pixel_count)

    def derivative(pixel: int, perturbed_rows: np.ndarray, perturbed_beta: float) -> float:
        layers = resolve_pixel(pixel_fragments(perturbed_rows), perturbed_beta, **options)
        return np.imag(objective(pixel, layers)) / STEP

    for pixel in range(pixel_count):
        own = slice(offsets[pixel], offsets[pixel + 1])
        grad_beta[pixel] = derivative(pixel, rows[own], complex(betas[pixel], STEP))
        for index in np.ndindex(rows[own].shape):
            perturbed = rows[own].astype(np.complex128)
            perturbed[index] += 1j * STEP
            grad_rows[own][index] = derivative(pixel, perturbed, betas[pixel])
    by_sum = None if opacity_sum is None else grad_rows[:, 6]
    return Gradients(grad_rows[:, :4], grad_rows[:, 4], grad_rows[:, 5], grad_beta, by_sum)


def gradient(
    function: Callable[..., np.ndarray | tuple[np.ndarray, ...]],
    arrays: list[np.ndarray],
    cotangents: np.ndarray | tuple[np.ndarray, ...],
    eps: float = 1e-3,
) -> list[np.ndarray]:
    """Differentiate any function of float64 arrays by central differences, extrapolated twice (Richardson).

    The error is of order eps^6 plus 1e-16 / eps; no kink or jump may lie within `eps` of the arrays.
    """
    arrays = [np.asarray(array, dtype=np.float64) for array in arrays]
    cotangents = cotangents if isinstance(cotangents, tuple) else (cotangents,)

    def objective(*perturbed: np.ndarray) -> float:
        values = function(*perturbed)
        values = values if isinstance(values, tuple) else (values,)
        return sum(np.sum(cotangent * value) for cotangent, value in zip(cotangents, values, strict=True))

    def difference(which: int, index: tuple[int, ...], step: float) -> float:
        sides = []
        for sign in (1.0, -1.0):
            perturbed = [array.copy() for array in arrays]
            perturbed[which][index] += sign * step
            sides.append(objective(*perturbed))
        return (sides[0] - sides[1]) / (2.0 * step)

    gradients = [np.zeros_like(array) for array in arrays]
    for which, array in enumerate(arrays):
        for index in np.ndindex(array.shape):
            coarse, middle, fine = (difference(which, index, step) for step in (eps, eps / 2.0, eps / 4.0))
            once_coarse, once_fine = (4.0 * middle - coarse) / 3.0, (4.0 * fine - middle) / 3.0
            gradients[which][index] = (16.0 * once_fine - once_coarse) / 15.0
    return gradients
