"""What the properties of PLY elements mean: positions, colours and opacities by the names that programs give them."""

import numpy as np

from warpfrag.files.ply import Element
from warpfrag.files.source import Source

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_OPACITIES = ("alpha", "opacity", "a", "diffuse_alpha")


def scalar_columns(element: Element, names: tuple[str, ...]) -> np.ndarray | None:
    """Return scalar properties side by side, (count, names) float64; None unless all are there."""
    if any(name not in element.scalars for name in names):
        return None
    return np.stack([element.scalars[name].astype(np.float64) for name in names], axis=-1)


def color_columns(element: Element) -> np.ndarray | None:
    """Return the colours of an element as shares, (count, 3) float64, sRGB as PLY has them; None without."""
    for names in _COLORS:
        if all(name in element.scalars for name in names):
            return _as_shares(np.stack([element.scalars[name] for name in names], axis=-1))
    return None


def opacity_column(element: Element, source: Source) -> np.ndarray | None:
    """Return the opacities of an element, (count,) float64; None without.

    Those of Gaussian splats, logarithms of odds under the same name, are noted and left out.
    """
    for name in _OPACITIES:
        if name not in element.scalars:
            continue
        shares = _as_shares(element.scalars[name])
        if name == "opacity" and shares.size and not (shares.min() >= 0.0 and shares.max() <= 1.0):
            source.note("opacity: its values are not from 0 to 1, drawn without")
            return None
        return shares
    return None


def _as_shares(values: np.ndarray) -> np.ndarray:
    """Return whole numbers as shares of their type's largest, floats as they are, or of 255 if any is above 1."""
    largest = values.max(initial=0)
    if values.dtype.kind in "iu" and values.dtype.itemsize <= 2:
        scale = float(np.iinfo(values.dtype).max)
    else:
        # Of 32 bits there are only those that hold bytes.
        scale = 255.0 if values.dtype.kind in "iu" or 1.0 < largest <= 255.0 else 1.0
    return values.astype(np.float64) / scale
