"""Losses: how far an image is from its reference, in linear light.

With the residual f, each a mean over all pixels and channels: l2: f²; huber: f²/2 up to delta, then
delta·(|f| − delta/2); l1: |f|, rounded off below 1e-3 like Huber's, since least squares weighs each residual by 1/|f|.

ssim is 1 minus the mean structural similarity (Wang et al. 2004, eq. 13) of each channel, with their constants:

    SSIM = (2·μx·μy + C1)·(2·σxy + C2) / ((μx² + μy² + C1)·(σx² + σy² + C2)),  C1 = 0.01², C2 = 0.03²

for values from 0 to 1, with moments under a Gaussian window of 11 pixels and σ = 1.5 that lies wholly in the image.
Along a side shorter than 11 pixels the window has the largest odd size that fits.

With scales, a loss is the mean of itself over the levels of an image pyramid (`pyramid`). All of it is differentiable
in the image.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import NUMPY, kind_of
from warpfrag.errors import check_number, check_whole, shorten

ROBUST = ("l2", "l1", "huber")
LOSSES = (*ROBUST, "ssim")

# A quarter of a step of an 8-bit image: absolute values are rounded off below it.
L1_ROUNDING = 1e-3
# Wang et al. 2004, section III-C.
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class RobustLoss:
    """A loss as least squares sees it: `factor` times the mean of rho, where rho is f², or 2·delta·|f| − delta² beyond.

    Attributes:
        delta: where rho becomes linear; infinite for l2.
        factor: from the mean of rho to the loss.
    """

    delta: float
    factor: float

    @staticmethod
    def named(name: str, delta: float) -> "RobustLoss":
        """Return the loss of a study."""
        if name == "l2":
            return RobustLoss(np.inf, 1.0)
        return RobustLoss(L1_ROUNDING, 0.5 / L1_ROUNDING) if name == "l1" else RobustLoss(delta, 0.5)

    def rho(self, residual: Any) -> Any:
        """Return rho of each residual, an array or a tensor."""
        size = abs(residual)
        if np.isinf(self.delta):
            return size * size
        inner = size.clip(None, self.delta)
        return inner * (2.0 * size - inner)

    def weight(self, residual: np.ndarray) -> np.ndarray:
        """Return the weight of each residual in the normal equations, d rho / d f²."""
        if np.isinf(self.delta):
            return np.ones_like(residual)
        return self.delta / np.maximum(np.abs(residual), self.delta)


@dataclass(frozen=True)
class ImageLoss:
    """A weighted sum of losses, averaged over the levels of an image pyramid.

    Attributes:
        terms: names and weights.
        delta: where Huber's loss becomes linear.
        scales: most levels of the pyramid, the image itself among them.
    """

    terms: tuple[tuple[str, float], ...]
    delta: float
    scales: int = 1

    @staticmethod
    def of(loss: str | Mapping[str, float], delta: float, scales: int = 1) -> "ImageLoss":
        """Return a loss by name, or the weighted sum of several.

        Raises:
            ValueError: an unknown name, a weight that is not above 0, or scales below 1.
            TypeError: a weight that is no number, or scales that are no whole number.

        Example:
            >>> ImageLoss.of({"l1": 0.8, "ssim": 0.2}, delta=0.1, scales=3).robust is None
            True
        """
        weights = loss if isinstance(loss, Mapping) else {str(loss): 1.0}
        names = ", ".join(f'"{name}"' for name in LOSSES)
        expected = f"one of {names}, or some of them with weights"
        if not weights:
            raise ValueError(f"loss: got no names, expected {expected}")
        for name, weight in weights.items():
            if name not in LOSSES:
                raise ValueError(f"loss: got {shorten(name)}, expected {expected}")
            check_number(f"loss.{name}", weight, above=0.0)
        check_whole("scales", scales, 1)
        return ImageLoss(tuple((name, float(weight)) for name, weight in weights.items()), delta, scales)

    @property
    def robust(self) -> RobustLoss | None:
        """The loss of each level as least squares sees it; None if it is another than l2, l1 or huber alone."""
        (name, weight), *others = self.terms
        return RobustLoss.named(name, self.delta) if not others and name in ROBUST and weight == 1.0 else None

    def __call__(self, image: Any, reference: Any) -> Any:
        """Return the loss, a float64 tensor without dimensions.

        Args:
            image: a tensor (H, W, C); the loss is differentiable in it.
            reference: a tensor of the same shape.
        """
        if image.shape != reference.shape:
            raise ValueError(f"image: got shape {tuple(image.shape)}, expected {tuple(reference.shape)}")
        levels = zip(pyramid(image.double(), self.scales), pyramid(reference.double(), self.scales), strict=True)
        losses = [self._at_one_scale(*level) for level in levels]
        return sum(losses[1:], losses[0]) / len(losses)

    def _at_one_scale(self, image: Any, reference: Any) -> Any:
        total: Any = 0.0
        for name, weight in self.terms:
            if name == "ssim":
                value = 1.0 - ssim(image, reference)
            else:
                robust = RobustLoss.named(name, self.delta)
                value = robust.rho(image - reference).mean() * robust.factor
            total = total + weight * value
        return total


def pyramid(image: Any, scales: int) -> Iterator[Any]:
    """Yield the image, then each level halved, at most `scales` of them; the level of a single pixel is the last.

    Args:
        image: an array or a tensor (H, W, …), not empty.
        scales: most levels.
    """
    yield image
    for _ in range(scales - 1):
        if image.shape[0] == image.shape[1] == 1:
            return
        image = halve(image)
        yield image


def halve(image: Any) -> Any:
    """Average an image over boxes of 2 × 2 pixels.

    The last row or column of an odd size is a box of its own, half as large. The map is linear and the same for every
    channel, so that it halves derivatives of an image just as well.

    Args:
        image: an array (H, W, …) or a tensor.

    Returns:
        An image of (⌈H/2⌉, ⌈W/2⌉, …), alike to the bit for arrays and tensors.
    """
    concatenate = (kind_of(image) or NUMPY).xp.concatenate
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    rows = 0.5 * (image[0:height:2] + image[1:height:2])
    if height < image.shape[0]:
        rows = concatenate((rows, image[height:]))
    columns = 0.5 * (rows[:, 0:width:2] + rows[:, 1:width:2])
    return concatenate((columns, rows[:, width:]), 1) if width < image.shape[1] else columns


def ssim(image: Any, reference: Any) -> Any:
    """Return the mean structural similarity over windows and channels: 1 for equal images, at least −1.

    Args:
        image: a float64 tensor (H, W, C).
        reference: another.
    """
    import torch

    x, y = image.movedim(-1, 0), reference.movedim(-1, 0)
    # Apart, as what concerns the reference alone needs no gradient.
    mean_x, square_x, product = _window_means(torch.stack([x, x * x, x * y]))
    mean_y, square_y = _window_means(torch.stack([y, y * y]))
    means = mean_x * mean_y
    squares = mean_x * mean_x + mean_y * mean_y
    similar = (2.0 * means + SSIM_C1) * (2.0 * (product - means) + SSIM_C2)
    return (similar / ((squares + SSIM_C1) * (square_x + square_y - squares + SSIM_C2))).mean()


def _window_means(maps: Any) -> Any:
    """Average maps (K, C, H, W) under the window, one axis after the other."""
    import torch

    count, channels, height, width = maps.shape
    means = maps.reshape(count * channels, 1, height, width)
    rows, columns = (torch.as_tensor(_window(size), device=maps.device) for size in (height, width))
    means = torch.nn.functional.conv2d(means, rows.view(1, 1, -1, 1))
    means = torch.nn.functional.conv2d(means, columns.view(1, 1, 1, -1))
    return means.reshape(count, channels, *means.shape[-2:])


def _window(size: int) -> np.ndarray:
    """Return the window's weights along a side of so many pixels; they sum to 1."""
    reach = (min(size, SSIM_WINDOW) - 1) // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SSIM_SIGMA) ** 2)
    return weights / weights.sum()


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio of the colours [dB], in linear light with peak 1; inf where they are equal.

    Args:
        image: (H, W, 3 or 4); an opacity plays no part.
        reference: the same of another image, with opacity or without.
        mask: the pixels that count, (H, W) bool; None for all.

    Raises:
        ValueError: the images have different sizes.
    """
    if image.shape[:2] != reference.shape[:2]:
        got, expected = (f"{shape[1]} × {shape[0]}" for shape in (image.shape, reference.shape))
        raise ValueError(f"image: got {got} pixels, expected {expected} like the reference")
    error = np.asarray(image[..., :3], np.float64) - np.asarray(reference[..., :3], np.float64)
    mean_square = float(np.mean(np.square(error if mask is None else error[mask])))
    return -10.0 * math.log10(mean_square) if mean_square > 0.0 else math.inf
