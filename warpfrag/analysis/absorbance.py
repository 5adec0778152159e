"""Absorbance along a pixel's ray, 1 - T(z): how much of what lies behind a depth is held back in front of it.

    T(z) = prod_i (1 - A_i(r_i)),   r_i = clamp((z - f_i) / t_i, 0, 1)

with A(r), the opacity of the front part of a slab, from eq. 4; a surface without thickness is a step at its depth. The
product holds for overlapping slabs too: however parts are mixed, their transmittances multiply. So for fragments this
is the function that merging approximates, and for layers what it came to (Fig. 13 of the fragment-merging paper).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import kind_of
from warpfrag.errors import check_choice
from warpfrag.fragments import Fragments, Layers, pixel_number
from warpfrag.resolve.resolve import resolve
from warpfrag.scene.names import MIXES, Merge, Mix

# Least transmittance of a slab that is divided, and the number of intervals that draw the curve inside of one.
_FLOOR = 1e-6
_INTERVALS = 32


@dataclass(frozen=True, eq=False)
class Absorbance:
    """The absorbance along one ray: a line through (depth, absorbance), 0 before and constant behind.

    Attributes:
        depth: breakpoints, not decreasing [scene units], (B,) float64; a step is two of equal depth.
        absorbance: the values there, 0 ... 1, not decreasing, (B,) float64.
        slabs: the fragments or layers that absorb, in order of depth, as fragments of one pixel, NumPy float64.
        beta: how each of them fills up from its front to its back, (N,) float64.
        floor: least transmittance of a slab that is divided; 0 where an opaque slab is opaque from its front on.
    """

    depth: np.ndarray
    absorbance: np.ndarray
    slabs: Fragments
    beta: np.ndarray
    floor: float

    def at(self, depth: Any) -> np.ndarray:
        """Return the absorbance at any depths, exactly; a surface at a depth counts there already.

        Args:
            depth: where to evaluate [scene units], of any shape.

        Returns:
            The absorbance, float64, of the shape of `depth`.
        """
        return _absorbance(self.slabs, self.beta, self.floor, np.asarray(depth, np.float64), behind=True)


def absorbance(
    source: Fragments | Layers,
    pixel: tuple[int, ...] | int,
    beta: Any = 1.0,
    *,
    merge: Merge | None = None,
    max_layers: int = 8,
    mix: Mix = "opacity",
) -> Absorbance:
    """Return the absorbance along the ray of one pixel, 1 - transmittance as a function of depth, for drawing.

    Args:
        source: fragments, or layers of any method.
        pixel: index into the pixel grid, (row, column), as in `image[pixel]`; or its number in row-major order.
        beta: how a slab fills up from its front to its back (eq. 4): 0 optically (exponential), 1 linearly. A number, a
            0-d array, or one value per pixel; for fragments that are not merged also one per fragment.
        merge: for fragments: merge them first into layers as `resolve` does; None takes every fragment by itself.
        max_layers: for fragments that are merged: largest number of layers.
        mix: as in `resolve`; with "optical_depth" an opaque slab is opaque from its front on.

    Returns:
        The function, in NumPy float64, detached from any gradient.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.

    Example:
        >>> fragments = wf.Fragments.from_lists([[(0, 0, 0, 0.5, 1.0, 0.0), (0, 0, 0, 0.5, 2.0, 0.0)]], (1, 1))
        >>> wf.absorbance(fragments, (0, 0)).at([0.5, 1.0, 2.0])
        array([0.  , 0.5 , 0.75])
    """
    if not isinstance(source, (Fragments, Layers)):
        raise TypeError(f"source: got {type(source).__name__}, expected Fragments or Layers")
    check_choice("mix", mix, MIXES)
    number = pixel_number(pixel, source.shape)
    if isinstance(source, Layers):
        if merge is not None:
            raise TypeError("merge: got it with Layers, expected Fragments (layers are merged already)")
        slabs, betas = layers_of_pixel(source, pixel), _beta_of_pixel(beta, source, number)
    else:
        slabs, betas = fragments_of_pixel(source, pixel), _beta_of_pixel(beta, source, number)
        if merge is not None:
            if len(np.unique(betas)) > 1:
                raise ValueError("beta: got one value per fragment, which goes with merge=None only")
            one = float(betas[0]) if len(betas) else 1.0
            slabs = layers_of_pixel(resolve(slabs, one, max_layers=max_layers, merge=merge, mix=mix), 0)
            betas = np.full(slabs.count, one)
    order = np.argsort(slabs.depth, kind="stable")
    ordered = {"rgba": slabs.rgba[order], "depth": slabs.depth[order], "thickness": slabs.thickness[order]}
    slabs = Fragments(**ordered, offsets=slabs.offsets, shape=(1, 1))
    floor = 0.0 if mix == "optical_depth" else _FLOOR
    return _trace(slabs, np.broadcast_to(betas, (slabs.count,))[order], floor)


def fragments_of_pixel(fragments: Fragments, pixel: tuple[int, ...] | int) -> Fragments:
    """Return the fragments of one pixel, in the order they have, as NumPy float64 of shape (1, 1).

    Args:
        fragments: those of all pixels.
        pixel: index into the pixel grid, (row, column), or its number.

    Raises:
        ValueError: there is no such pixel.
    """
    return fragments[pixel].numpy().to("float64")


def layers_of_pixel(layers: Layers, pixel: tuple[int, ...] | int) -> Fragments:
    """Return the layers of one pixel as fragments, NumPy float64 of shape (1, 1).

    Args:
        layers: those of all pixels.
        pixel: index into the pixel grid, (row, column), or its number.

    Raises:
        ValueError: there is no such pixel.
    """
    own = layers[pixel].numpy().to("float64")
    count = int(own.count[0, 0])
    rgba, depth, thickness = (array[0, 0, :count] for array in (own.rgba, own.depth, own.thickness))
    return Fragments(rgba, depth, thickness, np.array([0, count], np.int32), (1, 1))


def _beta_of_pixel(beta: Any, source: Fragments | Layers, number: int) -> np.ndarray:
    """Return beta of one pixel, or of each of its fragments."""
    kind = kind_of(beta)
    values = np.asarray(beta if kind is None else kind.to_numpy(beta), np.float64)
    if values.shape == tuple(source.shape):
        values = values.reshape(-1)[number : number + 1]
    elif isinstance(source, Fragments) and values.shape == (source.count,):
        values = values[source.pixel == number]
    elif values.size != 1:
        raise ValueError(f"beta: got shape {values.shape}, expected () or {tuple(source.shape)}")
    if not np.all((values >= 0.0) & (values <= 1.0)):
        raise ValueError(f"beta: got {beta}, expected numbers from 0 to 1")
    return values.reshape(-1)


def _trace(slabs: Fragments, beta: np.ndarray, floor: float) -> Absorbance:
    """Sample the function densely enough for straight lines between the samples."""
    front = slabs.depth - slabs.thickness
    thick = slabs.thickness > 0.0
    bounds = np.unique(np.concatenate([front, slabs.depth]))
    pieces = [bounds[:1]]
    for begin, end in pairwise(bounds):
        inside = bool(np.any(thick & (front <= begin) & (slabs.depth >= end)))
        pieces.append(np.linspace(begin, end, _INTERVALS + 1)[1:] if inside else np.array([end]))
    depth = np.concatenate(pieces)
    before = _absorbance(slabs, beta, floor, depth, behind=False)
    after = _absorbance(slabs, beta, floor, depth, behind=True)
    # Both sides of every step, and of the curve's beginning; elsewhere the two are the same.
    repeats = np.where(after > before, 2, 1)
    doubled, values = np.repeat(depth, repeats), np.repeat(after, repeats)
    values[np.cumsum(repeats) - repeats] = before
    return Absorbance(doubled, values, slabs, beta, floor)


def _absorbance(slabs: Fragments, beta: np.ndarray, floor: float, depth: np.ndarray, *, behind: bool) -> np.ndarray:
    """Evaluate the formula; at a depth itself take the limit from the front, or from `behind`."""
    transmittance = np.ones(depth.shape)
    for a, z, t, b in zip(slabs.rgba[:, 3], slabs.depth, slabs.thickness, beta, strict=True):
        front = z - t
        entered, passed = (depth >= front, depth >= z) if behind else (depth > front, depth > z)
        # A thickness that is lost in the rounding of its depth is none.
        r = np.clip((depth - front) / (z - front), 0.0, 1.0) if z > front else np.zeros(depth.shape)
        least = max(1.0 - a, floor)
        optical = np.where(r > 0.0, least**r, 1.0) if least > 0.0 else np.zeros(depth.shape)
        inside = b * (1.0 - r * a) + (1.0 - b) * optical
        transmittance *= np.where(passed, 1.0 - a, np.where(entered, inside, 1.0))
    return 1.0 - transmittance
