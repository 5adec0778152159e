"""Pixels of extreme values, drawn in bulk: every combination of empty, opaque, denormal, thin, huge and equal ones."""

import numpy as np
from pixels import Pixels

OPACITIES = [0.0, 1.0, 1e-7, 1.0 - 1e-7, 1e-4, 0.02, 0.0199, 0.5, 1e-20, 1e-30, 1e-38, 1e-42]
DEPTHS = [0.0, 1e-38, 1e-20, 1e-6, 1.0, 1.0, 1.1, 1.5, 2.0, 2.5, 3.0, 1e3, 1e6, 1e20, -1.0, -1e6]
THICKNESSES = [0.0, 1e-45, 1e-38, 1e-30, 1e-20, 1e-7, 1e-3, 0.1, 1.0, 1.0, 2.0, 3.0, 1e3, 1e6, 1e20]
BETAS = [0.0, 1.0, 1e-42, 1e-30, 1e-7, 1.0 - 1e-7, 0.5]
WEIGHTS = [0.0, 1e-30, 1e-3, 0.5, 1.0, 3.0, 1e6]


def extreme_pixels(seed: int, pixel_count: int, most: int = 12) -> tuple[Pixels, np.ndarray, np.ndarray]:
    """Draw pixels of up to `most` fragments, an opacity sum and a beta for each fragment; three in five are extreme."""
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(rng.integers(0, most + 1, pixel_count))]).astype(np.int32)
    count = int(offsets[-1])

    def draw(extremes: list[float], highest: float) -> np.ndarray:
        return np.where(rng.random(count) < 0.6, rng.choice(extremes, count), rng.uniform(0.0, highest, count))

    opacity = draw(OPACITIES, 1.0)
    color = rng.uniform(0.0, 1.0, (count, 3)) * opacity[:, None]
    # The others emit, as a fragment of no opacity may.
    color = np.where(rng.random((count, 1)) < 0.7, color, rng.choice([0.0, 1e-30, 1.0, 1e3], (count, 3)))
    pixels = Pixels(np.column_stack([color, opacity]), draw(DEPTHS, 4.0), draw(THICKNESSES, 3.0), offsets)
    return pixels, opacity * draw(WEIGHTS, 4.0), draw(BETAS, 1.0)
