"""Weighted blended order-independent transparency (McGuire and Bavoil, JCGT 2(2), 2013).

Colours are averaged with weights that fall off with depth, in place of being sorted:

    C = A * sum_i C_i w_i / sum_i A_i w_i,   A = 1 - prod_i (1 - A_i)      (C_i premultiplied)

with one of the paper's weights (z in scene units, d the depth in the window, 0 ... 1):

    (7)   w = A clamp(10   / (1e-5 + (z/5)^2  + (z/200)^6), 1e-2, 3e3)
    (8)   w = A clamp(10   / (1e-5 + (z/10)^3 + (z/200)^6), 1e-2, 3e3)
    (9)   w = A clamp(0.03 / (1e-5 + (z/200)^4),            1e-2, 3e3)
    (10)  w = A max(1e-2, 3e3 (1 - d)^3)

The weight's own factor A comes on top of the premultiplied one, as in the paper. Everything is differentiable.
"""

from typing import Any, Literal

from warpfrag.baselines.inputs import array_module, exact_image, owners, range_of_depths, ratio, sum_pixels
from warpfrag.fragments import Fragments

# Beyond this depth, (10) in units of the near plane, weights are at their lower limit: cut there no power overflows.
_FARTHEST = 1e4


def weighted_blended(
    fragments: Fragments,
    *,
    equation: Literal[7, 8, 9, 10] = 7,
    depth_range: tuple[float, float] | None = None,
) -> Any:
    """Average the fragments of each pixel with weights that depend on depth (McGuire and Bavoil 2013).

    Exact for one fragment, and for any number of equal colour; its opacity always is. Differentiable in colour, opacity
    and depth.

    Args:
        fragments: what to blend, in any order, NumPy or torch.
        equation: which of the paper's weights, by their numbers. (7) to (9) are made for depths of 0.1 to 500 units.
        depth_range: near and far plane, for equation 10; default the range of all depths, held fixed.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the fragments.

    Raises:
        TypeError: the fragments are Warp arrays.
        ValueError: an option does not exist, or values are not finite or out of range.
    """
    if equation not in (7, 8, 9, 10):
        raise ValueError(f"equation: got {equation!r}, expected 7, 8, 9 or 10")
    exact = exact_image(fragments)
    xp = array_module(fragments)
    opacity = exact[..., 3:]
    near, far = range_of_depths(fragments, depth_range) if equation == 10 else (0.0, 0.0)
    color, own = fragments.rgba[:, :3], fragments.rgba[:, 3:]
    weight = own * _falloff(xp, fragments.depth, equation, near, far)[:, None]
    sums = sum_pixels(xp.concatenate([color * weight, own * weight], 1), owners(fragments), fragments.pixel_count)
    average = ratio(xp, sums[:, :3], sums[:, 3:]).reshape((*fragments.shape, 3))
    return xp.concatenate([opacity * average, opacity], -1)


def _falloff(xp: Any, depth: Any, equation: int, near: float, far: float) -> Any:
    if equation == 10:
        if far <= near:
            # All at the same depth are at its front.
            return 3e3 + 0.0 * depth
        # Depth in the window of a perspective camera, 1 - d. In units of the near plane no square overflows.
        relative = xp.clip(depth, near, min(far, _FARTHEST * near)) / near
        clear = (1.0 / relative - near / far) / (1.0 - near / far)
        return xp.clip(3e3 * clear**3, 1e-2, 3e3)
    z = xp.clip(abs(depth), 0.0, _FARTHEST)
    if equation == 7:
        return xp.clip(10.0 / (1e-5 + (z / 5.0) ** 2 + (z / 200.0) ** 6), 1e-2, 3e3)
    if equation == 8:
        return xp.clip(10.0 / (1e-5 + (z / 10.0) ** 3 + (z / 200.0) ** 6), 1e-2, 3e3)
    return xp.clip(0.03 / (1e-5 + (z / 200.0) ** 4), 1e-2, 3e3)
