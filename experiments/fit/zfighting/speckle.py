"""How much two planes speckle at a thickness, and the smallest multiple of P(z) at which they do not.

A pixel speckles if it is further than 1/255 (linear light, worst channel) from what it were at the same thickness
without noise in the depths. Speckle is gone if no more than a pixel in a thousand is left.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from planes import BUFFERS, Pair, Setting, make_pair

import warpfrag as wf

VISIBLE = 1.0 / 255.0
FEW = 1e-3
# Multiples of P(z) between which the smallest is sought, and how closely [relative].
SMALLEST, LARGEST, CLOSE = 2.0**-10, 2.0**18, 5e-3
# Ways to merge: the name, "merge", beta.
WAYS = {"OFM": ("order_independent", 1.0), "SFM": ("smooth", 1.0), "SFM, β = 0": ("smooth", 0.0)}


@dataclass(frozen=True)
class Case:
    """What was found in a setting.

    Attributes:
        setting: where the planes are.
        smallest: the smallest multiple of P(z) without speckle, by way of merging and kind of depth buffer.
    """

    setting: Setting
    smallest: dict[str, dict[str, float]]


def composite(pair: Pair, depth: np.ndarray, multiple: float, merge: Any, beta: float) -> np.ndarray:
    """Composite the planes with given depths, `multiple` P(z) thick, in the precision of the depths; (H W, 4)."""
    setting = pair.setting
    thickness = multiple * wf.z_resolution(depth, 1.0, setting.far, setting.bits)
    offsets = np.arange(setting.size**2 + 1, dtype=np.int32) * 2
    fragments = wf.Fragments(pair.rgba.astype(depth.dtype), depth, thickness, offsets, (setting.size**2,))
    return wf.composite(fragments, beta, merge=merge)


def clean_image(pair: Pair, multiple: float, merge: Any, beta: float) -> np.ndarray:
    """Return the image without noise; of coplanar planes it is the same for every multiple, way and beta."""
    if pair.setting.offset == 0.0:
        merge, multiple = "order_independent", 1.0
    return composite(pair, pair.true_depth, multiple, merge, beta)


def deviation(
    pair: Pair, buffer: str, multiple: float, merge: str, beta: float = 1.0, clean: np.ndarray | None = None
) -> np.ndarray:
    """Return how far each pixel is from the image without noise, in its worst channel; (H W,)."""
    if clean is None:
        clean = clean_image(pair, multiple, merge, beta)
    return np.abs(composite(pair, pair.depths[buffer], multiple, merge, beta) - clean).max(axis=-1)


def smallest_multiple(pair: Pair, buffer: str, way: str) -> float:
    """Return the smallest multiple of P(z) at which coplanar planes do not speckle; 0 where they never do."""
    merge, beta = WAYS[way]
    clean = clean_image(pair, 1.0, merge, beta)

    def speckles(multiple: float) -> bool:
        return float(np.mean(deviation(pair, buffer, multiple, merge, beta, clean) > VISIBLE)) > FEW

    if not speckles(SMALLEST):
        return 0.0
    low, high = SMALLEST, LARGEST
    while high > low * (1.0 + CLOSE):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if speckles(middle) else (low, middle)
    return high


def clear_from(pair: Pair, buffer: str, way: str, multiples: Sequence[float]) -> float:
    """Return the smallest of ascending multiples from which on no plane speckles; 0 where none of them does.

    Planes that are apart speckle where the thickness is about their distance, and need not where it is less.
    """
    clear = 0.0
    for multiple in reversed(multiples):
        if np.mean(deviation(pair, buffer, multiple, *WAYS[way]) > VISIBLE) > FEW:
            return clear
        clear = multiple
    return 0.0


def examine(setting: Setting, buffers: Sequence[str] = BUFFERS, ways: Sequence[str] = ("OFM", "SFM")) -> Case:
    """Find the smallest multiples of a setting."""
    pair = make_pair(setting)
    return Case(setting, {way: {name: smallest_multiple(pair, name, way) for name in buffers} for way in ways})


def left_over(pair: Pair, buffer: str, way: str, multiples: Iterable[float]) -> np.ndarray:
    """Return share of speckled pixels, and the deviation that one in a thousand passes, at multiples; (n, 2)."""
    rows = []
    for multiple in multiples:
        off = deviation(pair, buffer, multiple, *WAYS[way])
        rows.append((np.mean(off > VISIBLE), np.quantile(off, 1.0 - FEW)))
    return np.array(rows)


def offset_curve(base: Setting, buffer: str, way: str, multiple: float, offsets: Iterable[float]) -> np.ndarray:
    """Return the root mean square deviation of planes that are `offsets` P(z) apart; thickness 0 is no merging."""
    merge, beta = WAYS[way] if multiple else ("none", 1.0)
    pairs = (make_pair(replace(base, offset=float(offset))) for offset in offsets)
    return np.array([np.sqrt(np.mean(deviation(pair, buffer, multiple, merge, beta) ** 2)) for pair in pairs])
