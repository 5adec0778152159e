"""What the baselines have in common: checks of what comes in, and sums over ragged pixels."""

import math
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import common_kind
from warpfrag.composite import composite
from warpfrag.fragments import Fragments


def exact_image(fragments: Fragments) -> Any:
    """Return the image of plain sorted over, (H, W, 4), for its exact opacity; checks every value on the way."""
    if not isinstance(fragments, Fragments):
        raise TypeError(f"fragments: got {type(fragments).__name__}, expected Fragments")
    return composite(fragments, merge="none")


def array_module(fragments: Fragments) -> Any:
    """Return NumPy or torch, whichever made the arrays.

    Raises:
        TypeError: they are Warp arrays, for which the method is not written.
    """
    xp = common_kind({"rgba": fragments.rgba}).xp
    if xp is None:
        raise TypeError(
            "fragments: got Warp arrays, expected NumPy or torch (`fragments.numpy()`, `fragments.torch()`)"
        )
    return xp


def owners(fragments: Fragments) -> Any:
    """Return the pixel that each fragment belongs to, (F,)."""
    kind = common_kind({"rgba": fragments.rgba})
    return kind.asarray(fragments.pixel, fragments.offsets)


def sum_pixels(values: Any, owner: Any, pixel_count: int) -> Any:
    """Add up the values (F, n) of each pixel's fragments: (P, n). Differentiable in `values`."""
    if isinstance(values, np.ndarray):
        sums = np.zeros((pixel_count, values.shape[1]), values.dtype)
        if len(values):
            # One sum from each position where a new pixel begins; empty pixels have none.
            begins = np.flatnonzero(np.diff(owner, prepend=-1))
            sums[owner[begins]] = np.add.reduceat(values, begins)
        return sums
    return values.new_zeros((pixel_count, values.shape[1])).index_add(0, owner, values)


def ratio(xp: Any, numerator: Any, denominator: Any) -> Any:
    """Return the quotient, or 0 where the denominator is not positive; its gradient is 0 there too."""
    positive = denominator > 0
    return xp.where(positive, numerator / xp.where(positive, denominator, 1.0), 0.0)


def range_of_depths(fragments: Fragments, depth_range: tuple[float, float] | None) -> tuple[float, float]:
    """Return the depths between which a method distinguishes, by default those of all fragments of the image.

    Raises:
        ValueError: they are not positive and in order. Both methods that need them work with 1/z or log z.
    """
    if depth_range is None:
        if fragments.count == 0:
            return 1.0, 1.0
        depth = common_kind({"depth": fragments.depth}).detach(fragments.depth)
        near, far = float(depth.min()), float(depth.max())
        if near <= 0.0:
            raise ValueError(f"fragments: got the nearest depth {near}, expected depths above 0 (or give depth_range)")
        return near, far
    near, far = (float(bound) for bound in depth_range)
    if not 0.0 < near <= far < math.inf:
        raise ValueError(f"depth_range: got {depth_range!r}, expected (near, far) with 0 < near <= far")
    return near, far
