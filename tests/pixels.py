"""Seeded random pixels for tests: ragged fragments of many pixels, with every degenerate case mixed in, or none.

Depths and thicknesses are multiples of 2^-10 below 2^13, and colours and opacities are float32 numbers, so all values
and all boundaries `depth - thickness` are exact in single precision too: order and overlap come out the same in both.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

GRID = 2.0**-10
"""Spacing of depths: boundaries up to 2^13 are exact in the 24 bits of float32."""

KINDS = (
    "empty",
    "many",
    "transparent",
    "emissive",
    "opaque",
    "nearly_opaque",
    "nearly_transparent",
    "thin",
    "equal_depths",
    "equal_fronts",
    "identical",
    "touching",
    "nested",
    "chain",
    "far_apart",
)
"""The degenerate cases: those of whole pixels, of opacity, of extent."""

PLACED_BY_ANOTHER = {"equal_depths", "equal_fronts", "identical", "touching", "nested"}

SPECIAL_OPACITY = {
    "transparent": 0.0,
    "emissive": 0.0,
    "opaque": 1.0,
    "nearly_opaque": 1.0 - 1e-7,
    "nearly_transparent": 1e-7,
}


class Pixels(NamedTuple):
    """Fragments of many pixels in submission order, float64."""

    rgba: np.ndarray  # (F, 4)
    depth: np.ndarray  # (F,)
    thickness: np.ndarray  # (F,)
    offsets: np.ndarray  # (P + 1,) int32


def random_pixels(seed: int, pixel_count: int = 64, most: int = 8, *, without: tuple[str, ...] = ()) -> Pixels:
    """Draw pixels of up to `most` fragments; each pixel has up to three of `KINDS` but those named in `without`.

    Pixels of the kind "many" have up to 64 fragments.
    """
    unknown = set(without) - set(KINDS)
    if unknown:
        raise ValueError(f"unknown kinds {sorted(unknown)}, expected some of {KINDS}")
    rng = np.random.default_rng(seed)
    allowed = [kind for kind in KINDS if kind not in without]
    pixels = []
    for _ in range(pixel_count):
        kinds = (
            set(rng.choice(allowed, size=min(rng.integers(0, 4), len(allowed)), replace=False)) if allowed else set()
        )
        fragment_count = 0 if "empty" in kinds else rng.integers(1, (64 if "many" in kinds else most) + 1)
        depth, thickness = draw_extents(rng, fragment_count, kinds)
        order = rng.permutation(fragment_count)
        pixels.append((draw_rgba(rng, fragment_count, kinds), depth[order], thickness[order]))
    return join(pixels)


def generic_pixels(
    seed: int, pixel_count: int = 16, most: int = 6, *, opaque: bool = False, margin: float = 16 * GRID
) -> Pixels:
    """Draw pixels in general position, where everything is differentiable.

    All boundaries of a pixel are `margin` or more apart, no thickness is zero and opacities lie in 0.05 … 0.95; with
    `opaque`, about a third of them is exactly 1.
    """
    rng = np.random.default_rng(seed)
    pixels = []
    for _ in range(pixel_count):
        fragment_count = rng.integers(1, most + 1)
        depth, thickness = draw_extents(rng, fragment_count, set())
        boundaries = np.concatenate([depth - thickness, depth])
        order = np.argsort(boundaries, kind="stable")
        for before, after in pairwise(order):
            # Pushing later boundaries back keeps their order, so fronts stay in front of their backs.
            boundaries[after] = max(boundaries[after], boundaries[before] + margin)
        front, depth = np.split(boundaries, 2)
        rgba = draw_rgba(rng, fragment_count, {"opaque"} if opaque else set())
        pixels.append((rgba, depth, depth - front))
    return join(pixels)


def draw_extents(rng: np.random.Generator, fragment_count: int, kinds: set[str]) -> tuple[np.ndarray, np.ndarray]:
    """Draw depths and thicknesses of a pixel on the grid, placing some of them by another as `kinds` says."""
    depth = on_grid(rng.uniform(2.0, 6.0, fragment_count))
    thickness = on_grid(rng.uniform(0.0, 1.0, fragment_count) * rng.choice([0.2, 1.0, 2.0])) + GRID
    if "far_apart" in kinds:
        depth = on_grid(depth * rng.choice([1.0, 10.0, 1000.0], fragment_count))
    if "chain" in kinds:
        # Each slab overlaps only the next.
        depth, thickness = 1.0 + 0.5 * np.arange(1, fragment_count + 1), np.full(fragment_count, 0.625)
    for fragment in range(1, fragment_count):
        other = rng.integers(fragment)
        front = depth[other] - thickness[other]
        chosen = rng.choice(
            sorted(kinds & {"equal_depths", "equal_fronts", "identical", "touching", "nested", ""} | {""})
        )
        if chosen == "equal_depths":
            depth[fragment] = depth[other]
        elif chosen == "equal_fronts":
            depth[fragment] = front + thickness[fragment]
        elif chosen == "identical":
            depth[fragment], thickness[fragment] = depth[other], thickness[other]
        elif chosen == "touching":
            depth[fragment] = depth[other] + thickness[fragment]
        elif chosen == "nested":
            thickness[fragment] = on_grid(thickness[other] * rng.uniform(0.1, 0.6))
            depth[fragment] = depth[other] - on_grid(thickness[other] * rng.uniform(0.0, 0.3))
    if "thin" in kinds:
        thickness = np.where(rng.random(fragment_count) < 0.5, 0.0, thickness)
    return depth, thickness


def draw_rgba(rng: np.random.Generator, fragment_count: int, kinds: set[str]) -> np.ndarray:
    """Draw premultiplied colours, about a third of the opacities of each degenerate kind."""
    opacity = rng.uniform(0.05, 0.95, fragment_count)
    for kind in sorted(kinds & SPECIAL_OPACITY.keys()):
        opacity = np.where(rng.random(fragment_count) < 1.0 / 3.0, SPECIAL_OPACITY[kind], opacity)
    color = rng.uniform(0.0, 1.0, (fragment_count, 3)) * opacity[:, None]
    if "emissive" in kinds:
        color[opacity == 0.0] = rng.uniform(0.0, 1.0, (int(np.sum(opacity == 0.0)), 3))
    return np.column_stack([color, opacity]).astype(np.float32).astype(np.float64)


def on_grid(values: np.ndarray) -> np.ndarray:
    """Round to multiples of `GRID`."""
    return np.round(np.asarray(values) / GRID) * GRID


def join(pixels: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Pixels:
    """Put the fragments of all pixels behind one another."""
    offsets = np.cumsum([0] + [len(depth) for _, depth, _ in pixels]).astype(np.int32)
    rgba, depth, thickness = (np.concatenate(column) for column in zip(*pixels, strict=True))
    return Pixels(rgba, depth, thickness, offsets)
