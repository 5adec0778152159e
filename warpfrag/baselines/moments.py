"""Moment-based order-independent transparency with power moments (Münstermann et al., PACMCGIT 1(1), 2018).

The absorbance of a pixel, -log T(z), rises by a step at every fragment. Moments of that distribution are additive, so
they can be summed in any order:

    a_i = min(-log(1 - A_i), 10),   b_0 = sum_i a_i,   b_k = sum_i a_i z_i^k / b_0     (k = 1 ... n; z_i in -1 ... 1)

From them the absorbance up to a depth z is bounded. Among the distributions on n/2 + 1 points with these moments, one
has a point at z: the canonical one. If z_j are its other points, w_j their weights and w that of z, the absorbance lies
between what is before z, and that plus w; the overestimation beta chooses a value in between:

    T(z) = exp(-b_0 (sum_{z_j < z} w_j + beta w))
    C = A sum_i C_i T(z_i) / sum_i A_i T(z_i),   A = 1 - exp(-b_0)                     (C_i premultiplied)

The paper finds the points as roots of a polynomial of degree m = n/2. Here they come from eigenvalues: one formula for
every n, and no division by a leading coefficient that may vanish. With the m x m Hankel matrices of the moments about z

    N_ij = b_{i+j+1} - z b_{i+j},   G_ij = b_{i+j+2} - 2 z b_{i+j+1} + z^2 b_{i+j} = (L L^T)_ij

L^-1 N L^-T has the eigenvalues 1/(z_j - z), and if q_j is the first component of an eigenvector of length one, then
w_j = (L_00 q_j / (z_j - z))^2. A point at infinity is the eigenvalue 0, with no weight. (The other canonical points are
the Gauss points of the measure weighted by (z' - z)^2, whose moments are G.)
"""

from typing import Any, Literal, NamedTuple

import numpy as np

from warpfrag.analysis.absorbance import fragments_of_pixel
from warpfrag.baselines.inputs import array_module, exact_image, owners, range_of_depths, ratio, sum_pixels
from warpfrag.fragments import Fragments

# What moments are moved towards, and how far: safely inside of what moments can be (the paper's, for
# single precision; rounding in double precision is far below).
BIAS_TARGET = {
    4: (0.0, 0.375, 0.0, 0.375),
    6: (0.0, 0.48, 0.0, 0.451, 0.0, 0.45),
    8: (0.0, 0.75, 0.0, 0.676666667, 0.0, 0.63, 0.0, 0.60030303),
}
BIAS = {4: 5e-7, 6: 5e-6, 8: 5e-5}
LEAST_BIAS = 1e-10
# An opaque fragment has infinite absorbance: cut at 10, a transmittance of 5e-5. Fragments more transparent than
# LEAST_OPACITY are left out, and pixels that absorb less than LEAST_ABSORBANCE take every transmittance as 1.
MOST_ABSORBANCE = 10.0
LEAST_OPACITY = 1e-7
LEAST_ABSORBANCE = 0.00100050033
# Fragments that are reconstructed at a time: bounds the memory.
CHUNK = 1 << 18


class _Moments(NamedTuple):
    """Moments of every pixel, and how depths were warped for them."""

    total: Any  # (P, 1): b_0
    normalized: Any  # (P, n + 1): 1, b_1, ... b_n
    near: float
    far: float


def moment_based(
    fragments: Fragments,
    *,
    moments: Literal[4, 6, 8] = 4,
    overestimation: float = 0.25,
    bias: float | None = None,
    depth_range: tuple[float, float] | None = None,
) -> Any:
    """Blend with a transmittance that is reconstructed from power moments (Münstermann et al. 2018).

    With an overestimation of 0 exact for up to `moments / 2` depths in a pixel, but for the bias. Opacities of 1 come
    out as 1 - exp(-10). Emission without opacity is left out. Differentiable in colour, opacity and depth.

    Args:
        fragments: what to blend, in any order, NumPy or torch.
        moments: number of power moments, 4, 6 or 8.
        overestimation: 0 takes the lower, 1 the upper bound of the absorbance at a fragment; the paper's is 0.25.
        bias: how far moments are moved towards fixed ones (1e-10 ... 1); default the paper's for single precision.
        depth_range: depths that -1 and 1 stand for, on a logarithmic scale; default those of all fragments, held fixed.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the fragments.

    Raises:
        TypeError: the fragments are Warp arrays.
        ValueError: an option does not exist, or values are not finite or out of range.
    """
    _check(moments, overestimation, bias)
    exact_image(fragments)
    xp = array_module(fragments)
    kept = _moments(xp, fragments, moments, bias, depth_range)
    owner = owners(fragments)
    rgba = _double(fragments.rgba)
    blended = []
    for begin in range(0, fragments.count, CHUNK):
        part = slice(begin, begin + CHUNK)
        z = _warped(xp, _double(fragments.depth[part]), kept.near, kept.far)
        visible = _transmittance(xp, kept.total[owner[part]], kept.normalized[owner[part]], z, overestimation)
        seen = xp.where(rgba[part, 3:] < LEAST_OPACITY, 0.0, visible)
        blended.append(rgba[part] * seen)
    sums = sum_pixels(xp.concatenate([rgba[:0], *blended]), owner, fragments.pixel_count)
    opacity = -xp.expm1(-kept.total)
    image = xp.concatenate([opacity * ratio(xp, sums[:, :3], sums[:, 3:]), opacity], 1)
    return _like(image, fragments.rgba).reshape((*fragments.shape, 4))


def moment_transmittance(
    fragments: Fragments,
    pixel: tuple[int, ...],
    depth: Any,
    *,
    moments: Literal[4, 6, 8] = 4,
    overestimation: float = 0.25,
    bias: float | None = None,
    depth_range: tuple[float, float] | None = None,
) -> np.ndarray:
    """Return the transmittance along one pixel's ray that `moment_based` reconstructs, for drawing.

    Args:
        fragments: all fragments of the image: the default depth range is theirs.
        pixel: index into the pixel grid, (row, column).
        depth: where to evaluate it [scene units], (D,).
        moments: see `moment_based`.
        overestimation: see `moment_based`.
        bias: see `moment_based`.
        depth_range: see `moment_based`.

    Returns:
        Transmittance, (D,) float64, in NumPy. Outside of the depth range it is that of its ends.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an option does not exist, or values are out of range.
    """
    array_module(fragments)
    _check(moments, overestimation, bias)
    near, far = range_of_depths(fragments, depth_range)
    alone = fragments_of_pixel(fragments, pixel)
    kept = _moments(np, alone, moments, bias, (near, far))
    z = _warped(np, np.asarray(depth, np.float64).reshape(-1), near, far)
    total, normalized = (np.repeat(values, len(z), 0) for values in (kept.total, kept.normalized))
    return _transmittance(np, total, normalized, z, overestimation)[:, 0]


def _check(moments: int, overestimation: float, bias: float | None) -> None:
    if moments not in BIAS:
        raise ValueError(f"moments: got {moments!r}, expected 4, 6 or 8")
    if not 0.0 <= overestimation <= 1.0:
        raise ValueError(f"overestimation: got {overestimation}, expected a number from 0 to 1")
    if bias is not None and not LEAST_BIAS <= bias <= 1.0:
        raise ValueError(f"bias: got {bias}, expected a number from {LEAST_BIAS} to 1")


def _moments(
    xp: Any, fragments: Fragments, count: int, bias: float | None, depth_range: tuple[float, float] | None
) -> _Moments:
    near, far = range_of_depths(fragments, depth_range)
    opacity = _double(fragments.rgba[:, 3])
    # Cut before the logarithm: after it, the gradient of an opaque fragment would be 0 times infinity.
    most = -np.expm1(-MOST_ABSORBANCE)
    absorbance = xp.where(opacity < LEAST_OPACITY, 0.0, -xp.log1p(-xp.clip(opacity, 0.0, most)))
    z = _warped(xp, _double(fragments.depth), near, far)
    powers = xp.stack([absorbance * z**k for k in range(count + 1)], 1)
    sums = sum_pixels(powers, owners(fragments), fragments.pixel_count)
    total = sums[:, :1]
    # Pixels that absorb too little are not reconstructed; the moments of a spread-out distribution stand in.
    enough = total >= LEAST_ABSORBANCE
    target = xp.stack([0.0 * total[:, 0] + moment for moment in (1.0, *BIAS_TARGET[count])], 1)
    normalized = xp.where(enough, sums / xp.where(enough, total, 1.0), target)
    amount = BIAS[count] if bias is None else bias
    return _Moments(total, (1.0 - amount) * normalized + amount * target, near, far)


def _warped(xp: Any, depth: Any, near: float, far: float) -> Any:
    """Return depths on a logarithmic scale from -1 to 1."""
    if near == far:
        return 0.0 * depth
    return 2.0 * xp.log(xp.clip(depth, near, far) / near) / np.log(far / near) - 1.0


def _transmittance(xp: Any, total: Any, b: Any, z: Any, overestimation: float) -> Any:
    """Reconstruct transmittance (F, 1) at depths z (F,) from the moments total (F, 1), b (F, n + 1)."""
    size = (b.shape[1] - 1) // 2
    sums = np.add.outer(np.arange(size), np.arange(size))
    z = z[:, None, None]
    low, middle, high = (b[:, sums + step] for step in (0, 1, 2))
    root = xp.linalg.cholesky(high - 2.0 * z * middle + z * z * low)
    inverse = xp.linalg.inv(root)
    inverse_distance, vectors = xp.linalg.eigh(inverse @ (middle - z * low) @ xp.swapaxes(inverse, 1, 2))
    weights = (root[:, :1, 0] * vectors[:, 0, :] * inverse_distance) ** 2
    before = xp.where(inverse_distance < 0.0, weights, 0.0).sum(1)[:, None]
    at = 1.0 - weights.sum(1)[:, None]
    share = xp.clip(before + overestimation * at, 0.0, 1.0)
    return xp.where(total < LEAST_ABSORBANCE, 1.0, xp.exp(-total * share))


def _double(array: Any) -> Any:
    return array.astype(np.float64) if isinstance(array, np.ndarray) else array.double()


def _like(array: Any, like: Any) -> Any:
    return array.astype(like.dtype) if isinstance(like, np.ndarray) else array.to(like.dtype)
