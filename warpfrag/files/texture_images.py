"""Images made ready for surfaces whose images repeat and are looked up bilinearly, whatever a file asks for.

Clamped images are continued at their edges as far as texture coordinates reach, mirrored ones are laid beside their
mirror image, and those without interpolation are enlarged. A cut-off in opacity is applied to the enlarged image after
interpolation, so that its edge is that of the interpolated opacity.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from warpfrag.files.pixels import MOST_PIXELS

Wrap = Literal["repeat", "clamp", "mirror"]
# Enlarged images have at most so many pixels (64 MiB as float32 RGBA); their texels are at most so many times finer.
_ENLARGED_PIXELS = 2**22
_FINEST = 16


@dataclass(frozen=True)
class Sampling:
    """How an image is to be looked up.

    Attributes:
        wrap: what is beyond its edges, along u and v.
        nearest: whether the nearest texel counts, without interpolation.
        cutoff: the least interpolated opacity that is drawn, opaque; None draws opacities as they are.
    """

    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    cutoff: float | None = None


def fitted_image(image: np.ndarray, uv: np.ndarray, sampling: Sampling) -> tuple[np.ndarray, np.ndarray, str]:
    """Bring an image and its coordinates to what repeats and is interpolated.

    Args:
        image: straight linear RGBA, (h, w, 4) float32, row 0 at the top.
        uv: texture coordinates (V, 2), v up.
        sampling: how the image is to be looked up.

    Returns:
        The image and the coordinates to use in their place, and what is left out, in words (nothing as a rule).
    """
    left_out = ""
    uv = np.asarray(uv, dtype=np.float64)
    for axis in (0, 1):
        wrap = sampling.wrap[axis]
        if wrap == "mirror":
            image, uv = _mirrored(image, uv, axis)
        elif wrap == "clamp":
            fitted = _clamped(image, uv, axis)
            if fitted is None:
                left_out = "texture: coordinates too far outside of a clamped image, drawn repeating"
            else:
                image, uv = fitted
    if sampling.cutoff is not None and (image[..., 3].min() < image[..., 3].max()):
        image = _cut_off(image, sampling)
    elif sampling.cutoff is not None:
        image = image.copy()
        image[..., 3] = image[..., 3] >= sampling.cutoff
    if sampling.nearest and sampling.cutoff is None:
        factor = _enlargement(image)
        if factor < 4:
            left_out = left_out or "texture: an image this large without interpolation, drawn with it"
        else:
            image = np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)
    return image, uv.astype(np.float32), left_out


def shared_key(uv: np.ndarray, sampling: Sampling) -> tuple:
    """Return what `fitted_image` depends on but the image: images of the same key are the same."""
    reach = tuple(_reach(uv, axis) for axis in (0, 1) if sampling.wrap[axis] == "clamp")
    return replace(sampling), reach


def _reach(uv: np.ndarray, axis: int) -> tuple[int, int]:
    """Return by how many widths of the image coordinates go beyond its two edges, rounded up."""
    if not len(uv):
        return 0, 0
    lowest, highest = float(uv[:, axis].min()), float(uv[:, axis].max())
    return int(np.ceil(max(0.0, -lowest))), int(np.ceil(max(0.0, highest - 1.0)))


def _mirrored(image: np.ndarray, uv: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    uv = uv.copy()
    uv[:, axis] *= 0.5
    if axis == 0:
        return np.concatenate([image, image[:, ::-1]], axis=1), uv
    # Row 0 is at the top, and v = 0 at the bottom: the upright image is below.
    return np.concatenate([image[::-1], image], axis=0), uv


def _clamped(image: np.ndarray, uv: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray] | None:
    below, above = _reach(uv, axis)
    size = image.shape[1 - axis]
    # One texel more at each end: lookups at the very edge take it for interpolation.
    before, after = below * size + 1, above * size + 1
    whole = before + size + after
    if whole * image.shape[axis] > MOST_PIXELS:
        return None
    pads = [(0, 0), (before, after), (0, 0)] if axis == 0 else [(after, before), (0, 0), (0, 0)]
    uv = uv.copy()
    uv[:, axis] = (uv[:, axis] * size + before) / whole
    return np.pad(image, pads, mode="edge"), uv


def _enlargement(image: np.ndarray) -> int:
    pixels = image.shape[0] * image.shape[1]
    return max(1, min(_FINEST, int((_ENLARGED_PIXELS / pixels) ** 0.5)))


def _cut_off(image: np.ndarray, sampling: Sampling) -> np.ndarray:
    factor = _enlargement(image)
    interpolated = np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)
    if not sampling.nearest and factor > 1:
        for axis in (0, 1):
            interpolated = _between(image if axis == 0 else interpolated, factor, axis)
    interpolated = interpolated if interpolated is not image else image.copy()
    interpolated[..., 3] = interpolated[..., 3] >= sampling.cutoff
    return interpolated


def _between(image: np.ndarray, factor: int, axis: int) -> np.ndarray:
    """Interpolate linearly along an axis at the middles of texels that are `factor` times finer; images repeat."""
    size = image.shape[axis]
    place = (np.arange(size * factor) + 0.5) / factor - 0.5
    first = np.floor(place).astype(np.int64)
    share = (place - first).astype(np.float32).reshape([-1 if dimension == axis else 1 for dimension in range(3)])
    near, far = np.take(image, first % size, axis=axis), np.take(image, (first + 1) % size, axis=axis)
    return near + share * (far - near)
